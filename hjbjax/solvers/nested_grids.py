"""Coarser grids of the same box, and the transfer of values between the grids."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hjbjax.problem.grid import Grid, with_prescriptions_of
from hjbjax.problem.mode_axis import with_modes, without_modes

FEWEST = 12  # least number of intervals per axis of a coarser grid
FEWEST_TELLING = 6  # least number of intervals on a coarser grid that estimates the error of the finer one
FARTHEST = 5  # largest ratio of the spacings of the two grids
ROUNDING = 1e-9  # in units of the spacing
SINGLE = 1e-6  # the same for sums of weights in single precision
BLOCK = 1 << 16  # nodes that are interpolated at a time, which fit into the cache


def coarser(grid: Grid, fewest: int = FEWEST) -> Grid | None:
    """Coarsen the grid by two on every axis that keeps ``fewest`` intervals; None if no axis does.

    Axes with an even number of intervals keep their ends and every second node, so a node at the origin remains a node.
    Odd numbers of intervals are rounded up.
    """
    shape = []
    for axis, count in enumerate(grid.shape):
        intervals = grid.intervals(axis)
        half = (intervals + 1) // 2 if axis in grid.state_axes else 0
        # count - intervals is 1, or 0 on a periodic axis, whose upper end is not a node
        shape.append(count - intervals + half if half >= fewest else count)
    if tuple(shape) == grid.shape:
        return None
    return with_faces_of(grid, resized(grid, shape))


def comparison_grid(grid: Grid, held: np.ndarray, lost: np.ndarray | None = None) -> Grid | None:
    """The coarser grid for the estimate of the error of ``grid``; None if an axis has too few intervals.

    It has about half the intervals per axis. Every fixed node, or a fixed neighbour of it, must lie in a coarse cell
    with a fixed corner, since a grid that loses a one-node target poses another problem. The same holds for the
    unreachable nodes. An axis with two nodes is not coarsened.

    Args:
      grid: the grid.
      held: the nodes with a fixed finite value, bool (*grid).
      lost: the unreachable nodes, bool (*grid); None if there cannot be any. Whether a node is unreachable is known
        only at the nodes of ``grid``, so all coarse nodes are then nodes of ``grid``.
    """
    many = [axis for axis in grid.state_axes if grid.shape[axis] > 2 or grid.periodic[axis]]
    choices = {axis: _fewer(grid.intervals(axis), lost is not None) for axis in many}
    kinds = [held] if lost is None else [held, lost]
    if not choices or not all(choices.values()):
        return None
    coarse = _resized(grid, {axis: tried[0] for axis, tried in choices.items()})
    if not _keeps(kinds, grid, coarse):
        # each axis separately, since there are too many combinations
        kept = {axis: [few for few in tried if _keeps(kinds, grid, _resized(grid, {axis: few}))][:1]
                for axis, tried in choices.items()}  # fmt: skip
        if not all(kept.values()):
            return None
        coarse = _resized(grid, {axis: few for axis, (few,) in kept.items()})
        if not _keeps(kinds, grid, coarse):
            return None
    return with_faces_of(grid, coarse)


def _fewer(intervals: int, nested: bool) -> list[int]:
    """The numbers of intervals to try, best first: half, other divisors, then numbers close to half."""
    half = (intervals + 1) // 2
    if half < FEWEST_TELLING:
        return []
    least = max(math.ceil(intervals / FARTHEST), FEWEST_TELLING)
    divisors = [few for few in range(half, least - 1, -1) if intervals % few == 0]
    if nested:
        return divisors
    close = [few for few in (half, *divisors) if few >= max(least, intervals / 3)]
    near = [few for k in range(1, half // 4 + 1) for few in (half + k, half - k) if few >= least]
    return [*close, *near, *divisors]


def _resized(grid: Grid, intervals: dict[int, int]) -> Grid:
    """The grid with new numbers of intervals on some axes."""
    shape = list(grid.shape)
    for axis, few in intervals.items():
        shape[axis] += few - grid.intervals(axis)
    return resized(grid, shape)


def resized(grid: Grid, shape: Sequence[int]) -> Grid:
    """The grid with another number of nodes per axis of the state."""
    bare = dataclasses.replace(without_modes(grid), shape=tuple(shape)[1 if grid.modes else 0 :])
    return with_modes(bare, grid.modes) if grid.modes else bare


def _keeps(kinds: Sequence[np.ndarray], fine: Grid, coarse: Grid) -> bool:
    """True if the coarser grid keeps each kind of nodes, see ``keeps_nodes``."""
    return all(keeps_nodes(held, fine, coarse) for held in kinds)


def keeps_nodes(held: np.ndarray, fine: Grid, coarse: Grid) -> bool:
    """True if every node of ``held``, or a neighbour of it in ``held``, lies in a coarse cell with a corner in it."""
    if not np.any(held):
        return True
    # in single precision, which is exact for nodes that coincide
    known = prolong(held.astype(np.float32), fine, coarse) > 1 - SINGLE
    kept = held & (prolong(known.astype(np.float32), coarse, fine) > ROUNDING)
    for axis in fine.state_axes:  # a node next to a kept one counts as kept, such as the tip of a disc
        along = np.moveaxis(kept, axis, 0)
        wide = along.copy()
        wide[1:] |= along[:-1]
        wide[:-1] |= along[1:]
        kept = np.moveaxis(wide, 0, axis)
    return bool(np.all(kept[held]))


def ratio_of(fine: Grid, coarse: Grid) -> float:
    """The smallest ratio of the spacings of two grids over the axes on which they differ."""
    ratios = [fine.intervals(axis) / coarse.intervals(axis) for axis in range(fine.ndim)]
    return min((ratio for ratio in ratios if ratio != 1), default=1.0)


def with_faces_of(grid: Grid, coarse: Grid) -> Grid:
    """The coarse grid with the prescribed boundary values of another grid of its box, from the nearest nodes."""

    def at_nodes(values: Any) -> Any:
        for axis in range(coarse.ndim):
            if np.ndim(values) and values.shape[axis] > 1:
                values = np.take(values, places(grid, coarse, axis), axis=axis)
        return values

    return with_prescriptions_of(coarse, grid, at_nodes)


def at_nearest_nodes(values: np.ndarray, fine: Grid, coarse: Grid) -> np.ndarray:
    """Node values of the finer grid at the nodes closest to the coarse nodes, (*coarse)."""
    for axis in range(fine.ndim):
        values = np.take(values, places(fine, coarse, axis), axis=axis)
    return values


def places(fine: Grid, coarse: Grid, axis: int) -> np.ndarray:
    """The indices, along one axis, of the fine nodes closest to the coarse nodes."""
    return np.rint(np.arange(coarse.shape[axis]) * (fine.intervals(axis) / coarse.intervals(axis))).astype(int)


def prolong(values: np.ndarray, coarse: Grid, fine: Grid) -> np.ndarray:
    """Interpolate node values multilinearly from one grid of a box to another grid of that box, (*fine).

    Uses NumPy, which is as fast here and does not need compiling. At most one and a half arrays on the fine grid exist
    at a time.
    """
    if coarse.shape == fine.shape:
        return values
    return prolong_into(np.empty(fine.shape, values.dtype), values, coarse, fine)


def prolong_into(result: np.ndarray, values: np.ndarray, coarse: Grid, fine: Grid) -> np.ndarray:
    """``prolong`` into the array ``result``, (*fine), which is returned."""
    axes = [axis for axis, count in enumerate(fine.shape) if coarse.shape[axis] != count]
    if not axes:
        result[...] = values
    for axis in axes:  # axis by axis: 2n gathers instead of 2^n
        count = fine.shape[axis]
        # in units of the coarse interval, also on a stretched axis, as both grids are images of one uniform axis
        place = np.arange(count) * (coarse.intervals(axis) / fine.intervals(axis))
        cell = np.minimum(place.astype(int), coarse.intervals(axis) - 1)
        weight = np.asarray(place - cell, values.dtype)
        shape = (*values.shape[:axis], count, *values.shape[axis + 1 :])
        wide = result if axis == axes[-1] else np.empty(shape, values.dtype)
        _between(wide, values, axis, (cell, (cell + 1) % coarse.shape[axis]), weight)
        values = wide
    return result


def _between(
    wide: np.ndarray, values: np.ndarray, axis: int, nodes: tuple[np.ndarray, np.ndarray], weight: np.ndarray
) -> None:
    """Set ``wide`` to (1 − w) V[below] + w V[above] along an axis, ``nodes`` = (below, above), in blocks of rows."""
    weight = weight.reshape(-1, *[1] * (values.ndim - axis - 1))
    rows = max(1, BLOCK * len(wide) // wide.size)
    for first in range(0, len(wide), rows):
        part = slice(first, first + rows)
        if axis:
            (below, above), share = (np.take(values[part], each, axis=axis) for each in nodes), weight
        else:
            (below, above), share = (values[each[part]] for each in nodes), weight[part]
        below *= 1 - share
        above *= share
        np.add(below, above, out=wide[part])


def restrict(values: np.ndarray, fine: Grid, coarse: Grid) -> np.ndarray:
    """Node values of one grid at the nodes of a coarser grid of that box, (*coarse); NumPy.

    They are copied where the nodes coincide, and otherwise interpolated by the cubic through four nodes along the axis.
    """
    for axis, count in enumerate(coarse.shape):
        many, few = fine.intervals(axis), coarse.intervals(axis)
        if many % few == 0:
            values = np.take(values, np.arange(count) * (many // few), axis=axis)
            continue
        place = np.arange(count) * (many / few)
        first = np.floor(place).astype(int) - 1
        if not fine.periodic[axis]:  # near an end the four nearest nodes
            first = np.clip(first, 0, fine.shape[axis] - 4)
        total: Any = 0
        for k in range(4):
            others = [j for j in range(4) if j != k]
            weight = np.prod([(place - first - j) / (k - j) for j in others], axis=0)  # Lagrange basis polynomial
            along = weight.reshape([-1 if i == axis else 1 for i in range(fine.ndim)]).astype(values.dtype)
            total = total + along * np.take(values, (first + k) % fine.shape[axis], axis=axis)
        values = total
    return values


def mean_around(values: np.ndarray, fine: Grid, coarse: Grid) -> np.ndarray:
    """The mean of the node values of the finer grid over those closest to each node of the coarser one, (*coarse)."""
    for axis, count in enumerate(coarse.shape):
        many, few = fine.intervals(axis), coarse.intervals(axis)
        nearest = np.rint(np.arange(fine.shape[axis]) * (few / many)).astype(int) % count
        along = np.moveaxis(values, axis, 0)
        total = np.zeros((count, *along.shape[1:]), values.dtype)
        np.add.at(total, nearest, along)
        shape = (-1,) + (1,) * (along.ndim - 1)
        values = np.moveaxis(total / np.bincount(nearest, minlength=count).reshape(shape), 0, axis)
    return values


def apart(value: np.ndarray, other: np.ndarray) -> np.ndarray:
    """|value − other|, zero where it is not finite."""
    with np.errstate(invalid="ignore"):
        change = np.abs(value - other)
    return np.where(np.isfinite(change), change, 0)
