"""From grid to grid: coarser grids, and values carried to a finer one."""

import dataclasses
from typing import Any

import numpy as np

from hjbjax.problem.grid import Grid

FEWEST = 12  # intervals that an axis keeps


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
    return dataclasses.replace(grid, shape=tuple(shape))


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
