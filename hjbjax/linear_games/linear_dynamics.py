"""The matrices of a problem with linear dynamics, x' = A x + B u + C d + c, and its convex terminal cost.

The trace of the drift proves that it is affine in state, control and disturbance together. A terminal cost is convex if
it is one of ``convex``, or a quadratic polynomial with a positive semidefinite matrix, also proved by its trace. Minus
a convex function, as in ``avoid``, exchanges the players: W = −V is the value of the game in which the disturbance
minimises.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.applications.reachability import depth
from hjbjax.linear_games.convex import Conjugated, ConvexFunction, Differentiable, Largest, Quadratic
from hjbjax.linear_games.support import reduced
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.rewards import refuse_rewards
from hjbjax.problem.sets import Box, refuse_unbounded
from hjbjax.problem.settings import own_settings
from hjbjax.tracing.closures import opened
from hjbjax.tracing.dependence import Dependence, dependence

SEMIDEFINITE = 1e-9  # relative size of a negative eigenvalue that counts as rounding
NOTHING = Box([0.0], [0.0])  # the set of a player that is not there

REFUSED = {  # ingredients that the formula does not cover, with the reason
    "cost": "the formula has only a terminal cost",
    "noise": "the formula is for deterministic dynamics",
    "stopping_cost": (
        "for the tube take the least value over all horizons: pass tube=False to reach or avoid, and evaluate\n"
        "value_at(t, x) at several t"
    ),
    "running_max": "pass tube=False to reach or avoid; value_at(t, x) at several t gives the tube of one player",
    "target": "paths end at the horizon; write the target as terminal_cost, see hjb.reach(..., tube=False)",
    "growth": "the formula has no payments over time",
    "modes": "the dynamics must be linear",
}


@pytree_dataclass(static=("exact", "negated", "playing"))
class LinearGame:
    """A game with linear dynamics and a convex terminal cost, seen by the player that minimises it.

    Args:
      drift: A, shape (n, n).
      constant: c, shape (n,).
      own: the matrix of the player that minimises the convex function, shape (n, m).
      own_set: the admissible set of this player.
      other: the matrix of the opponent, shape (n, k).
      other_set: the admissible set of the opponent.
      effective: the set of the minimising player that remains if it also undoes the disturbance; ``own_set`` without
        an opponent, and if there is no such set.
      terminal: the convex function J.
      exact: True if the formula gives the value; otherwise it gives a lower bound of the value of this game.
      negated: True if the players are exchanged, so that V is minus the value of this game.
      playing: True if there is an opponent whom the formula treats apart, because there is no effective set.
    """

    drift: Any
    constant: Any
    own: Any
    own_set: Any
    other: Any
    other_set: Any
    effective: Any
    terminal: ConvexFunction
    exact: bool = True
    negated: bool = False
    playing: bool = False


def linear_game(problem: Problem, states: int | None) -> LinearGame:
    """Read the game from a problem.

    Raises:
      ValueError: the dynamics are not linear, the terminal cost is neither convex nor concave, or another ingredient.
    """
    _check_ingredients(problem)
    terminal, negated = _terminal(problem, states)
    n = terminal.dim
    if states is not None and states != n:
        raise ValueError(f"hopf: got states = {states}, and a terminal cost of {n} states; leave out states")
    drift, constant, own, other = _matrices(problem, n)
    sets = [NOTHING if each is None else each for each in (problem.controls, problem.disturbances)]
    matrices = [own, other]
    if negated:
        sets, matrices = sets[::-1], matrices[::-1]
    alone = not np.any(matrices[1]) if not is_traced(matrices[1]) else problem.disturbances is None and not negated
    effective = sets[0] if alone else None
    if not alone and not is_traced(matrices, sets):
        effective = reduced(sets[0], matrices[0], sets[1], matrices[1])
    return LinearGame(
        drift, constant, matrices[0], sets[0], matrices[1], sets[1], sets[0] if effective is None else effective,
        terminal, exact=effective is not None, negated=negated, playing=effective is None,
    )  # fmt: skip


def _check_ingredients(problem: Problem) -> None:
    """Refuse what the formula does not cover, with the reason."""
    refuse_rewards(problem, "hopf", "the formula is for costs at the horizon")
    for name, why in REFUSED.items():
        if getattr(problem, name) is not None:
            raise ValueError(f"hopf: got a problem with {name}, wanted only a terminal_cost: {why}")
    for name in ("jumps", "pushes"):
        if getattr(problem, name):
            raise ValueError(f"hopf: got a problem with {name}, wanted linear dynamics; march solves it on a grid")
    if callable(problem.discount) or is_traced(problem.discount) or problem.discount != 0:
        raise ValueError(
            "hopf: got a problem with a discount, wanted none: multiply the value by exp(-discount * duration) instead"
        )
    if problem.time_dependent:
        raise ValueError("hopf: got time_dependent=True, wanted matrices A, B and C that do not depend on time")
    if callable(problem.controls):
        raise ValueError("hopf: got bounds of the controls that depend on the state, wanted a fixed convex set")
    if problem.terminal_cost is None:
        raise ValueError("hopf: got a problem without terminal_cost; wanted one, as in hjb.reach(..., tube=False)")
    for admissible in (problem.controls, problem.disturbances):
        refuse_unbounded(admissible, "hopf", "the support function of the set must be finite")


def _terminal(problem: Problem, states: int | None) -> tuple[ConvexFunction, bool]:
    """The convex function, and True if the terminal cost is minus it."""
    cost = problem.terminal_cost
    inner = depth(cost)
    if (found := _of_module(cost if inner is None else inner)) is not None:
        return found, inner is not None
    if not callable(cost):
        raise ValueError(f"hopf: got the terminal cost {cost!r}, wanted a convex function of the state")
    if states is None:
        raise ValueError(
            "hopf: got a terminal cost that is not one of hjb.convex; wanted also states=, the number of states"
        )
    quadratic = _as_quadratic(cost, states)
    if quadratic is not None:
        if _semidefinite(quadratic.matrix):
            return quadratic, False
        if _semidefinite(-quadratic.matrix):
            return Quadratic(states, -quadratic.matrix, -quadratic.slope, -quadratic.offset), True
    why = "whose convexity is not known" if quadratic is None else "whose matrix has eigenvalues of both signs"
    raise ValueError(
        f"hopf: got a terminal cost {why}; wanted a function of hjb.convex (ball, box, ellipsoid, half_space,\n"
        "largest), a convex quadratic polynomial, or hjb.convex.smooth(function, states) to declare it convex"
    )


def _semidefinite(matrix: np.ndarray) -> bool:
    """True if a symmetric matrix is positive semidefinite, up to rounding in the units of each state."""
    diagonal = np.diagonal(matrix)
    used = np.any(matrix != 0, axis=1)
    if np.any(diagonal[used] <= 0):
        return False
    scale = np.where(used, 1 / np.sqrt(np.where(used, diagonal, 1.0)), 0.0)
    return bool(np.linalg.eigvalsh(matrix * np.outer(scale, scale))[0] >= -SEMIDEFINITE)


def _of_module(function: Any) -> ConvexFunction | None:
    """The function of ``convex`` that a problem holds as a ``Partial``; None for another function."""
    while isinstance(function, jax.tree_util.Partial) and len(function.args) == 1 and not function.keywords:
        if isinstance(function.args[0], (Largest, Quadratic, Differentiable, Conjugated)):
            return function.args[0]
        function = function.args[0]
    return None


def _as_quadratic(function: Callable, n: int) -> Quadratic | None:
    """The function as a quadratic polynomial, proved by its trace; None if it is not one or is traced."""
    function = opened(function, jax.ShapeDtypeStruct((n,), np.float64))
    if is_traced(function) or not dependence(function, (n, True), dtype=np.float64).quadratic_in(range(n)):
        return None
    with own_settings(x64=True):
        zero = jnp.zeros(n)
        value, slope = jax.value_and_grad(lambda x: jnp.asarray(function(x), x.dtype))(zero)
        matrix = jax.hessian(lambda x: jnp.asarray(function(x), x.dtype))(zero)
        return Quadratic(n, np.asarray(matrix), np.asarray(slope), -float(value))


def _matrices(problem: Problem, n: int) -> tuple[Any, Any, Any, Any]:
    """A, c, B and C, after a proof that the drift is affine; NumPy unless the drift has traced numbers."""
    m, k = (0 if each is None else each.dim for each in (problem.controls, problem.disturbances))
    lengths = [n, m] + [k] * problem.is_game
    with own_settings(x64=True):
        shapes = [jax.ShapeDtypeStruct((length,), np.float64) for length in lengths]
    drift = opened(problem.drift, *shapes)
    _check_affine(dependence(drift, *((length, True) for length in lengths), dtype=np.float64), n, lengths)

    def rate(*arguments: jax.Array) -> jax.Array:
        return jnp.asarray(drift(*arguments), arguments[0].dtype)

    with own_settings(x64=None if is_traced(drift) else True):
        zeros = [jnp.zeros(length) for length in lengths]
        slopes = jax.jacfwd(rate, tuple(range(len(lengths))))(*zeros)
        found = [slopes[0], rate(*zeros), *slopes[1:]] + [jnp.zeros((n, 0))] * (not problem.is_game)
        # one column of zeros for a player that is not there, because its set has one entry
        found = [jnp.zeros((n, 1)) if np.shape(each) == (n, 0) else each for each in found]
        a, c, b, d = found if is_traced(found) else [np.asarray(each) for each in found]
    return a, c, b, d


def _check_affine(drift: Dependence, n: int, lengths: Sequence[int]) -> None:
    """Refuse a drift with a term that is not affine, and name the term."""
    if len(drift.entries) != n:
        raise ValueError(f"hopf: the drift has {len(drift.entries)} entries, and the terminal cost {n} states")
    names = [f"{letter}[{j}]" for letter, length in zip("xud", lengths, strict=False) for j in range(length)]
    for row, terms in enumerate(drift.entries):
        for term in terms:
            if isinstance(term, frozenset) or len(term) > 1:
                product = (
                    " * ".join(names[j] for j in term)
                    if isinstance(term, tuple)
                    else ", ".join(names[j] for j in sorted(term))
                )
                what = f"the product {product}" if isinstance(term, tuple) else f"a nonlinear function of {product}"
                raise ValueError(
                    f"hopf: entry {row} of the drift has {what}; wanted linear dynamics, x' = A x + B u + C d + c.\n"
                    "march solves nonlinear dynamics on a grid, in up to six states"
                )
