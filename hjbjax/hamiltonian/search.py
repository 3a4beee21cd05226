"""Minimising (or maximising) a function of one action at every node, over each kind of admissible set.

An action is a list of per-node scalars, one per input. Every routine takes an ``objective(action)`` that returns a pair
(value, extra): the value at every node, and data to keep with it (the opponent's answer). ``sign`` is +1 to minimise
and −1 to maximise.
"""

import functools
from collections.abc import Callable, Sequence
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.stencil import PerNode
from hjbjax.problem.types import Scalar

T = TypeVar("T")
Action = list
Objective = Callable[[Action], tuple[jax.Array, list]]
Best: TypeAlias = tuple[jax.Array, Action, list]  # the best value so far, the action there, and the extra there

UNROLL = 80  # largest finite set whose evaluations share one fused kernel; a larger kernel compiles and runs slowly
CHUNK = 20  # evaluations per step of the scan used for larger sets
WRITTEN = 2  # evaluations per step of a loop that searches a continuous set: with 80, programs take three times as long
# to compile and run no faster; with 4, the search of a long function (``zoo.merton``) takes twice as long
TURNED = 2  # rounds of each length in rotated directions
REFINEMENTS = 24  # halvings of the sample spacing: a factor of 2⁻²⁴ is below the rounding of float32


def better(sign: int, challenger: PerNode, incumbent: PerNode) -> PerNode:
    """The nodes where ``challenger`` is strictly better, bool; False where it is NaN."""
    return challenger < incumbent if sign > 0 else challenger > incumbent


def pick(condition: PerNode, first: T, second: T) -> T:
    """``where`` on trees whose leaves broadcast against the nodes."""
    return jax.tree.map(lambda p, q: jnp.where(condition, p, q), first, second)


def enumerate_actions(
    objective: Objective, points: jax.Array, sign: int, *, weight: int = 1, most: int = UNROLL
) -> Best:
    """The best of the rows of ``points``, in order; the first of several equally good rows wins.

    Args:
      objective: see the module.
      points: shape (K, m).
      sign: +1 to minimise, −1 to maximise.
      weight: the number of evaluations that one call of ``objective`` counts as.
      most: the largest number of evaluations to write out.

    Returns:
      The best value, the action there, and the extra there.
    """
    count, inputs = np.shape(points)
    if count * weight <= most:
        return best_of(objective, [[points[k, j] for j in range(inputs)] for k in range(count)], sign, None)
    chunk = max(1, min(CHUNK, most) // weight)
    padded = -(-count // chunk) * chunk  # repeats of the last row, which are never strictly better than it
    rows = jnp.concatenate([points, jnp.broadcast_to(points[-1:], (padded - count, inputs))])
    # only shapes: evaluating the objective before the loop would compile it once more
    value, extra = jax.eval_shape(lambda row: objective(list(row)), points[0])
    everywhere = functools.partial(jnp.full, value.shape, dtype=value.dtype)
    # the worst possible value, so that the first evaluation wins
    best = everywhere(sign * jnp.inf), [everywhere(points[0, j]) for j in range(inputs)], [everywhere(0) for _ in extra]

    def step(best: Best, block: jax.Array) -> tuple[Best, None]:
        return best_of(objective, [[block[k, j] for j in range(inputs)] for k in range(chunk)], sign, best), None

    return jax.lax.scan(step, best, rows.reshape(padded // chunk, chunk, inputs))[0]


def optimum(
    function: Callable[[Action], jax.Array], points: jax.Array, sign: int, *, weight: int = 1, most: int = UNROLL
) -> jax.Array:
    """The best value over the rows of ``points``, without the action, in half the time of a search that keeps it.

    Args:
      function: the value at every node, for an action.
      points: shape (K, m).
      sign: +1 to minimise, −1 to maximise.
      weight: the number of evaluations that one call of ``function`` counts as.
      most: the largest number of evaluations to write out.
    """
    count, inputs = np.shape(points)
    if count * weight > most:
        return enumerate_actions(lambda action: (function(action), []), points, sign, weight=weight, most=most)[0]
    best, *others = (function([points[k, j] for j in range(inputs)]) for k in range(count))
    total = best
    for value in others:  # compare and select are one instruction; min, which propagates NaN, takes five
        best, total = jnp.where(better(sign, value, best), value, best), total + value
    return jnp.where(jnp.isnan(total), total, best)  # the sum is NaN if any value is NaN


def best_of(objective: Objective, actions: Sequence[Action], sign: int, best: Best | None) -> Best:
    """The best of some actions and of ``best``, as returned by ``enumerate_actions``, or None at the beginning."""
    for action in actions:
        value, extra = objective(action)
        chosen = ([jnp.asarray(entry, value.dtype) for entry in action], extra)
        if best is None:
            best = (value, *chosen)
            continue
        wins = better(sign, value, best[0]) | jnp.isnan(value)  # a NaN must not be lost
        best = pick(wins, (value, *chosen), best)
    assert best is not None
    return best


def refine(
    objective: Objective,
    best: Best,
    spacing: Sequence[PerNode],
    project: Callable[[Action], Action],
    sign: int,
    *,
    weight: int = 1,
) -> Best:
    """Pattern search around the best sample, along single inputs and in rotated directions, halving the step.

    Args:
      objective: see the module.
      best: the result of ``enumerate_actions``.
      spacing: distance between neighbouring samples, one number per input.
      project: maps an action to the nearest admissible one.
      sign: +1 to minimise, −1 to maximise.
      weight: the number of evaluations that one call of ``objective`` counts as. If it is a search too, the moves of a
        round are made one by one in a loop, since each move that is written out is compiled separately.
    """
    value, action, extra = best
    dtype, shape = value.dtype, value.shape
    # the carry of a loop has fixed shapes, so actions that are one number for all nodes become arrays first
    best = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, dtype), shape), (value, action, extra))

    table = jnp.asarray(_moves(len(action)), dtype)

    def one_move(move: jax.Array, best: Best) -> Best:
        moved = [entry + part * width for entry, part, width in zip(best[1], move, spacing, strict=True)]
        return best_of(objective, [project(moved)], sign, best)

    def one_round(k: Scalar, best: Best) -> Best:
        for place in range(table.shape[1]):
            best = one_move(table[k, place], best)
        return best

    rounds, moves, inputs = table.shape
    if weight * moves <= WRITTEN:
        return jax.lax.fori_loop(0, rounds, one_round, best)
    return jax.lax.fori_loop(0, rounds * moves, lambda k, best: one_move(table.reshape(-1, inputs)[k], best), best)


def _moves(inputs: int) -> np.ndarray:
    """The moves of every round, (rounds, moves, inputs), in units of the sample spacing, from one half downwards.

    Moves along single inputs get stuck at a kink that runs across several inputs; rotated directions can follow it.
    """
    turns = np.random.default_rng(0).normal(size=(REFINEMENTS * TURNED, inputs, inputs))
    directions = [np.eye(inputs)[None].repeat(REFINEMENTS, 0)[:, None]]
    if inputs > 1:
        directions.append(np.linalg.qr(turns)[0].reshape(REFINEMENTS, TURNED, inputs, inputs))
    lengths = 0.5 ** np.arange(1, REFINEMENTS + 1)
    ways = (lengths[:, None, None, None] * np.concatenate(directions, axis=1)).reshape(-1, inputs, inputs)
    return np.stack([ways, -ways], axis=2).reshape(len(ways), 2 * inputs, inputs)
