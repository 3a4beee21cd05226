"""The optimum of the discrete Hamiltonian over the admissible sets: min, max, min max and max min, node by node.

It is exact if the drift is affine in u, the cost quadratic and the noise independent of u, see ``exact``. For convex
costs any number of inputs and any coupling is allowed (see ``players``). A finite set is enumerated. Otherwise samples
and a pattern search are used, which may miss the optimum: such solves have no certified bounds.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.discretisation.players import SAMPLES, Player
from hjbjax.hamiltonian import exact, search, simplex
from hjbjax.hamiltonian.discrete import DiscreteHamiltonian
from hjbjax.hamiltonian.piecewise import inverse_root
from hjbjax.hamiltonian.search import UNROLL, Action, best_of, enumerate_actions, refine
from hjbjax.problem import sets
from hjbjax.problem.pytree import altered, tie
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Finite, Simplex
from hjbjax.problem.types import Field

INNER = 8  # actions of the second player that are written out inside the search of the first player


def optimise(hamiltonian: DiscreteHamiltonian, isaacs: str | None = None) -> tuple[jax.Array, Action, Action]:
    """min max of H, or max min, as in the problem or ``isaacs``: the value, the control and the disturbance."""
    players = hamiltonian.on.players
    if players.disturbance.admissible is None:
        value, u = best_response(hamiltonian, players.control, lambda u: (u, []))
        return value, u, []
    if players.decoupled:  # H is a sum, so each optimum does not depend on the other player: use any action
        start = _any_action(players.disturbance.admissible)
        _, u = best_response(hamiltonian, players.control, lambda u: (u, start))
        value, d = best_response(hamiltonian, players.disturbance, lambda d: (u, d))
        return value, u, d
    if (isaacs or hamiltonian.on.problem.isaacs) == "upper":
        return _nested(hamiltonian, players.control, players.disturbance, lambda u, d: (u, d))
    value, d, u = _nested(hamiltonian, players.disturbance, players.control, lambda d, u: (u, d))
    return value, u, d


def optimal_value(hamiltonian: DiscreteHamiltonian) -> jax.Array:
    """min max of H, or max min, without the actions, which is faster for a finite set."""
    players = hamiltonian.on.players
    player, admissible = players.control, players.control.admissible
    if players.disturbance.admissible is not None or not isinstance(admissible, Finite):
        return optimise(hamiltonian)[0]
    points = jnp.asarray(admissible.points, hamiltonian.on.dtype)
    return search.optimum(lambda u: hamiltonian.at(u, []), points, player.sign, weight=player.effort)


def missed(hamiltonian: DiscreteHamiltonian) -> tuple[Field, Field]:
    """Bounds on the error of the exact optima of the control and of the disturbance, (*grid) each, cost per unit time.

    Zero except for quadratic programs, see ``exact.optimum_error``. They do not cover optima found by a search.
    """
    players = hamiltonian.on.players
    (control, disturbance), none = players.both, jnp.zeros(hamiltonian.value.shape, hamiltonian.on.dtype)
    if disturbance.admissible is None or players.decoupled:
        u, d = (_any_action(each.admissible) for each in players.both)
        return (
            exact.optimum_error(hamiltonian, control, lambda mine: (mine, d)) if control.programmed else none,
            exact.optimum_error(hamiltonian, disturbance, lambda mine: (u, mine)) if disturbance.programmed else none,
        )
    upper = players.isaacs == "upper"
    first, second = (control, disturbance) if upper else (disturbance, control)
    if not (first.enumerated and second.programmed):
        return none, none
    points = first.admissible.points if isinstance(first.admissible, Finite) else jnp.zeros((1, 0))

    def against(point: jax.Array) -> Field:
        return exact.optimum_error(
            hamiltonian, second, lambda mine: (list(point), mine) if upper else (mine, list(point))
        )

    worst = jnp.max(jax.lax.map(against, jnp.asarray(points, hamiltonian.on.dtype)), 0)
    return (none, worst) if upper else (worst, none)


def best_response(
    hamiltonian: DiscreteHamiltonian, player: Player, join: Callable, most: int = UNROLL
) -> tuple[jax.Array, Action]:
    """One player's optimum against a given action of the other; ``join(mine)`` makes the pair (u, d).

    ``most`` is the largest number of evaluations to write out when sampling.
    """
    if player.admissible is None:
        return hamiltonian.at(*join([])), []
    if player.exact:
        action = exact.exact_optimum(hamiltonian, player, join)
    else:
        start = _admissible(hamiltonian, player, join)
        _, action, _ = _sampled(
            hamiltonian, player, lambda action: (hamiltonian.at(*join(action)), []),
            weight=player.effort, most=most, start=start,
        )  # fmt: skip
    if not hamiltonian.bare:
        action = tie(action)  # otherwise XLA searches twice, for the action and for the value
    return hamiltonian.at(*join(action)), action


def _nested(
    hamiltonian: DiscreteHamiltonian, outer: Player, inner: Player, join: Callable
) -> tuple[jax.Array, Action, Action]:
    """The optimum of the outer player, who moves first and anticipates the inner player's reply."""

    def objective(action: Action) -> tuple[jax.Array, Action]:
        return best_response(hamiltonian, inner, lambda reply: join(action, reply), most=INNER)

    if outer.admissible is None:  # for example a lower game without controls: no player moves first
        value, answer = objective([])
        return value, [], answer
    return _sampled(hamiltonian, outer, objective, weight=inner.weight)


def _admissible(hamiltonian: DiscreteHamiltonian, player: Player, join: Callable) -> Action | None:
    """At constrained ends, an action of a sampled control that does not leave the box, if one can be found exactly."""
    if hamiltonian.slack is None or player.sign < 0:
        return None
    # without the cost H is the gain, infinite for actions that leave; its minimum is exact for an affine drift
    free = altered(hamiltonian.on.problem, cost=None)
    alone = hamiltonian.asking(free).on.players.control
    return exact.exact_optimum(hamiltonian.asking(free), alone, join) if alone.exact else None


def _sampled(
    hamiltonian: DiscreteHamiltonian,
    player: Player,
    objective: Callable,
    weight: int,
    most: int = UNROLL,
    start: Action | None = None,
) -> Any:
    """The best of samples, refined by a pattern search between them; the best of all actions of a finite set."""
    assert player.admissible is not None
    points = jnp.asarray(sets.samples(player.admissible, SAMPLES), hamiltonian.on.dtype)
    if isinstance(player.admissible, Finite):
        return enumerate_actions(objective, points, player.sign, weight=weight, most=most)
    best = enumerate_actions(objective, points, player.sign, weight=weight, most=search.WRITTEN)
    project = _projection(player.admissible)
    # samples may miss a part of the set in which the drift stays inside, or the action of the last step
    if start is not None:
        best = best_of(objective, [start], player.sign, best)
    if hamiltonian.tried is not None:
        best = best_of(objective, [project(hamiltonian.tried[0 if player.sign > 0 else 1])], player.sign, best)
    return refine(objective, best, sets.spacing(player.admissible, SAMPLES), project, player.sign, weight=weight)


def _projection(admissible: Box | Ball | Simplex) -> Callable[[Action], Action]:
    """The projection of an action onto its set, because a step of the search may leave the set."""
    if isinstance(admissible, Simplex):
        return lambda action: simplex.project(admissible, action)
    if isinstance(admissible, Box):
        return lambda action: [jnp.clip(u, admissible.lo[j], admissible.hi[j]) for j, u in enumerate(action)]

    def onto_ball(action: Action) -> Action:
        shrink = jnp.minimum(1, admissible.radius * inverse_root(sum(u * u for u in action)))
        return [shrink * u for u in action]

    return onto_ball


def _any_action(admissible: AdmissibleSet | None) -> Action:
    """Some action of the set; zero need not belong to it."""
    if admissible is None:
        return []
    if isinstance(admissible, Ball):
        return [jnp.zeros(())] * admissible.dim
    if isinstance(admissible, Simplex):
        return [jnp.asarray(admissible.total / admissible.dim)] * admissible.dim
    first = admissible.lo if isinstance(admissible, Box) else admissible.points[0]
    return [first[j] for j in range(admissible.dim)]
