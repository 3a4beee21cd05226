"""Two grids of one box: coarser ones, values carried from one to the other, and the error of a value that both tell.

    |V − V_h| ≈ |V_h − V_2h|/(2^q − 1)

by the leading term c h^q of the error. Limited slopes have q = 2 where V is smooth and 1 at kinks, which two grids do
not tell apart: by an order between them the estimate is 1.4 times the error at the one and half of it at the other.
Where optimal paths run along a curve at which the policy jumps V is Hölder continuous and no better, as beside the
switching curve of a minimum time, and q = ½. What the slopes changed of the chain's answer tells that: elsewhere it is
the chain's whole error, of first order, and many times the change from grid to grid. From a target that no cell holds
all of V is off by a low power of h, be the policy what it may.
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import altered

FEWEST = 12  # intervals that an axis keeps
USUAL, BROKEN = 1.65, 0.5  # orders of limited slopes
OTHERS = 1.3  # where the coarser grid has other nodes, as at odd intervals, and one of them may meet a kink
# of the mean change between grids over that between schemes: slopes gain nothing, and where both schemes are one
LARGE, ALIKE = 0.5, 10.0
JUMP = 0.9  # of the range of a control, between neighbours


def coarser(grid: Grid, fewest: int = FEWEST) -> Grid | None:
    """The grid with every second node of the axes that keep ``fewest`` intervals; None where no axis has so many.

    Axes with an even number of intervals keep their ends and every second node, so that a node at the origin
    stays one; odd ones are rounded up.
    """
    shape = []
    for axis, count in enumerate(grid.shape):
        intervals = grid.intervals(axis)
        half = (intervals + 1) // 2
        # count - intervals is 1, or 0 on a periodic axis, whose upper end is no node
        shape.append(count - intervals + half if half >= fewest else count)
    if tuple(shape) == grid.shape:
        return None
    return with_faces_of(grid, dataclasses.replace(grid, shape=tuple(shape)))


def with_faces_of(grid: Grid, coarse: Grid) -> Grid:
    """The coarse grid with the prescribed ends of another grid of its box, at the nearest nodes."""

    def nearest(values: Any) -> Any:
        for axis, count in enumerate(coarse.shape):
            if np.ndim(values) and values.shape[axis] > 1:
                places = np.arange(count) * (grid.intervals(axis) / coarse.intervals(axis))
                values = np.take(values, np.round(places).astype(int), axis=axis)
        return values

    return altered(coarse, faces=jax.tree.map(nearest, grid.faces)) if grid.faces else coarse


def prolong(values: np.ndarray, coarse: Grid, fine: Grid) -> np.ndarray:
    """Multilinear interpolation of node values on one grid of a box to the nodes of another grid of that box, (*fine).

    In NumPy, which is as fast and compiles nothing.
    """
    # axis by axis: 2n gathers in place of 2^n
    for axis, count in enumerate(fine.shape):
        if coarse.shape[axis] == count:
            continue
        # in parts of a coarse interval; on a stretched axis, too, as both grids are images of one uniform axis
        place = np.arange(count) * (coarse.intervals(axis) / fine.intervals(axis))
        cell = np.minimum(place.astype(int), coarse.intervals(axis) - 1)
        weight = np.asarray((place - cell).reshape([-1 if i == axis else 1 for i in range(fine.ndim)]), values.dtype)
        below = np.take(values, cell, axis=axis)
        above = np.take(values, (cell + 1) % coarse.shape[axis], axis=axis)
        values = (1 - weight) * below + weight * above
    return values


def restrict(values: np.ndarray, fine: Grid, coarse: Grid) -> np.ndarray:
    """Node values on one grid at the nodes of a coarser one of that box, (*coarse); NumPy.

    As they are where the nodes are the same, else by the cubic through four nodes along the axis.
    """
    for axis, count in enumerate(coarse.shape):
        many, few = fine.intervals(axis), coarse.intervals(axis)
        if many % few == 0:
            values = np.take(values, np.arange(count) * (many // few), axis=axis)
            continue
        place = np.arange(count) * (many / few)
        first = np.floor(place).astype(int) - 1
        if not fine.periodic[axis]:  # type: ignore[index]  # near an end the four nearest, off the middle
            first = np.clip(first, 0, fine.shape[axis] - 4)
        total: Any = 0
        for k in range(4):
            others = [j for j in range(4) if j != k]
            weight = np.prod([(place - first - j) / (k - j) for j in others], axis=0)  # Lagrange's
            along = weight.reshape([-1 if i == axis else 1 for i in range(fine.ndim)])
            total = total + along * np.take(values, (first + k) % fine.shape[axis], axis=axis)
        values = total
    return values


def apart(value: np.ndarray, other: np.ndarray) -> np.ndarray:
    """|value − other|, zero where that is not finite."""
    with np.errstate(invalid="ignore"):
        change = np.abs(value - other)
    return np.where(np.isfinite(change), change, 0)


def estimated_error(grid: Grid, coarse: Grid, change: np.ndarray, order: float) -> np.ndarray:
    """|V − V_h| at the nodes, about, shape (*grid), in cost units.

    Args:
      grid: the grid.
      coarse: the grid with half of the intervals.
      change: |V_h − V_2h| at the nodes of ``coarse``.
      order: q.
    """
    return prolong(change / (2**order - 1), coarse, grid)


def order_of_slopes(grid: Grid, coarse: Grid, change: np.ndarray, gain: np.ndarray, policy: np.ndarray | None) -> float:
    """q of limited slopes, by what they changed of the chain's answer.

    Args:
      grid: the grid.
      coarse: the grid with half of the intervals.
      change: |V_h − V_2h| at the nodes of ``coarse``, V by limited slopes.
      gain: |V_h − the answer of the chain| on ``grid``.
      policy: the controls on it, shape (*grid, m), NaN where there are none; None without controls.
    """
    moved, gained = np.mean(change), np.mean(gain)
    if LARGE * gained <= moved <= ALIKE * gained and moved > 0 and _jumps(policy):
        return BROKEN
    nested = all(grid.intervals(axis) % coarse.intervals(axis) == 0 for axis in range(grid.ndim))
    return USUAL if nested else OTHERS


def is_a_point(target: np.ndarray) -> bool:
    """True if a target, bool (*grid), holds no more nodes than a cell has; on a line that is no small target."""
    return target.ndim > 1 and 0 < np.sum(target) <= 2**target.ndim


def _jumps(policy: np.ndarray | None) -> bool:
    """True if a control jumps from end to end of its range across a surface: at half as many nodes as a layer has."""
    if policy is None:
        return False
    *shape, _ = policy.shape
    known = policy[np.all(np.isfinite(policy), axis=-1)]
    span = np.ptp(known, axis=0) if len(known) else np.zeros(policy.shape[-1])
    steps = (np.abs(np.diff(policy, axis=axis)) > JUMP * span for axis in range(len(shape)))
    # a comparison with NaN is False, and so is one of a control that never changes
    return bool(sum(np.sum(np.any(step, axis=-1)) for step in steps) >= 0.5 * np.prod(shape) / max(shape))
