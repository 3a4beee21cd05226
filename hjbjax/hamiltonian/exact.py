"""The exact optimum of the discrete Hamiltonian over a box or a ball: its pieces, read from a problem's functions.

The drift is affine in the player's inputs and the cost separable and quadratic (see ``players``), so that derivatives
at zero give all of their coefficients; ``piecewise`` and ``ball`` tell why the candidates suffice.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.discretisation import correlated_noise
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.hamiltonian.ball import kinked_ball
from hjbjax.hamiltonian.discrete import DiscreteHamiltonian
from hjbjax.hamiltonian.piecewise import Kinked, piecewise_input, piecewise_pair
from hjbjax.hamiltonian.players import Player, players_of, shared
from hjbjax.hamiltonian.search import Action
from hjbjax.problem.sets import Ball, Box
from hjbjax.problem.types import Verdict
from hjbjax.tracing import components


def exact_optimum(hamiltonian: DiscreteHamiltonian, player: Player, join: Callable) -> Action:
    """One player's optimum over a box or a ball against the other's action; ``join(mine)`` makes the pair (u, d)."""
    admissible = player.admissible
    assert isinstance(admissible, (Box, Ball))
    problem, dtype = hamiltonian.on.problem, hamiltonian.on.dtype
    # at zero even if that is not admissible: an affine drift is known by its offset and its slopes there
    zero = [jnp.zeros((), dtype)] * admissible.dim
    u, d = join(zero)
    arguments = problem.arguments(hamiltonian.x, u, d, hamiltonian.on.t)
    parts = hamiltonian.on.drifts(u, d, hamiltonian.x)
    # where drifts are upwinded apart, the noise goes with the control's
    part = 0 if player.sign > 0 else len(parts) - 1
    noise = hamiltonian.on.diffusion(u, d, hamiltonian.x) if part == 0 else {}
    slopes = [
        components.components(player.derivative(problem, problem.drift, j), *arguments, dtype=dtype)
        for j in range(admissible.dim)
    ]
    linear, square = zip(
        *(_cost_coefficients(hamiltonian.on, player, arguments, j) for j in range(admissible.dim)), strict=True
    )

    def piece(i: int, group: Sequence[int]) -> Kinked:
        slope = [slopes[j][i] for j in group]
        return _kinked(hamiltonian, noise, i, parts[part][i], slope[0] if len(group) == 1 else slope)

    if isinstance(admissible, Ball):
        single = [[piece(i, [j]) for i in player.driven[j]] for j in range(admissible.dim)]
        gains = [each[0] if each else None for each in single]
        return kinked_ball(player.sign, admissible.radius, linear, square, gains, curved=any(player.curved))
    action = list(zero)
    for group in player.groups:
        pieces = [piece(i, group) for i in shared(player.driven, group)]
        lo, hi, slope, bend = ([each[j] for j in group] for each in (admissible.lo, admissible.hi, linear, square))
        curved = any(player.curved[j] for j in group)
        if len(group) == 1:
            found = [piecewise_input(player.sign, lo[0], hi[0], slope[0], bend[0], pieces, curved=curved)]
        else:
            found = piecewise_pair(player.sign, lo, hi, slope, bend, pieces, curved=curved)
        for j, u in zip(group, found, strict=True):
            action[j] = u
    return action


def _cost_coefficients(on: Discretisation, player: Player, arguments: tuple, j: int) -> tuple[Any, Any]:
    """l_j and q_j of a cost l_j u + q_j u² + ... by differentiation at zero."""
    cost, none = on.problem.cost, jnp.zeros((), on.dtype)
    if cost is None:
        return none, none
    slope = player.derivative(on.problem, cost, j)
    linear = components.scalar(slope, *arguments, dtype=on.dtype)
    if not player.curved[j]:  # known to be linear: the second derivative would be traced to find a zero
        return linear, none
    return linear, components.scalar(player.derivative(on.problem, slope, j), *arguments, dtype=on.dtype) / 2


def concave_in_a_ball(on: Discretisation) -> bool:
    """True if a cost is concave, for who pays it, in an input of a ball: there the optimum may be missed.

    Of players whose optimum is called exact; see ``ball.kinked_ball``. Host level.
    """
    return any(_in_a_ball(player) for player in players_of(on).both) and bool(_is_concave(on))


def _in_a_ball(player: Player) -> bool:
    """True if the optimum over a ball is that of quadratics."""
    return player.exact and isinstance(player.admissible, Ball) and any(player.curved)


@jax.jit
def _is_concave(on: Discretisation) -> Verdict:
    """True if at some node the square of an input of a ball enters the cost of its player with a negative sign."""
    players, found = players_of(on), jnp.zeros((), bool)
    u, d = ([jnp.zeros((), on.dtype)] * getattr(player.admissible, "dim", 0) for player in players.both)
    arguments = on.problem.arguments(on.coordinates(), u, d, on.t)
    for player in filter(_in_a_ball, players.both):
        for j in range(len(player.driven)):
            found |= jnp.any(player.sign * _cost_coefficients(on, player, arguments, j)[1] < 0)
    return found


def _kinked(
    hamiltonian: DiscreteHamiltonian, noise: dict[tuple[int, int], Any], axis: int, offset: Any, slope: Any
) -> Kinked:
    """The gain of one component as a function of an input: offset, slope, and where its derivative jumps."""
    left = correlated_noise.along_axis(noise, hamiltonian.on.grid, axis)
    return Kinked(lambda f: hamiltonian.gain(axis, f, left), offset, slope, *hamiltonian.kinks(axis, left))
