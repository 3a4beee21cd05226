"""From grid to grid: coarser grids, and values carried to a finer one."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Array, Nodes

FEWEST = 12  # intervals that an axis keeps


def coarser(grid: Grid) -> Grid | None:
    """The grid with every second node of the axes that have enough; None where no axis has.

    Axes with an even number of intervals keep their ends and every second node, so that a node at the origin
    stays one; odd ones are rounded up.
    """
    shape = []
    for axis, count in enumerate(grid.shape):
        intervals = grid.intervals(axis)
        half = (intervals + 1) // 2
        # count - intervals is 1, or 0 on a periodic axis, whose upper end is no node
        shape.append(count - intervals + half if half >= FEWEST else count)
    if tuple(shape) == grid.shape:
        return None
    return dataclasses.replace(grid, shape=tuple(shape))


def prolong(values: Nodes, coarse: Grid, fine: Grid) -> Array:
    """Multilinear interpolation of node values on one grid of a box to the nodes of another grid of that box, (*fine).

    A JAX array for one of JAX, else NumPy's.
    """
    xp: Any = np if isinstance(values, np.ndarray) else jnp
    # axis by axis: 2n gathers in place of 2^n
    for axis, count in enumerate(fine.shape):
        if coarse.shape[axis] == count:
            continue
        # in parts of a coarse interval; on a stretched axis, too, as both grids are images of one uniform axis
        place = np.arange(count) * (coarse.intervals(axis) / fine.intervals(axis))
        cell = np.minimum(place.astype(int), coarse.intervals(axis) - 1)
        weight = xp.asarray((place - cell).reshape([-1 if i == axis else 1 for i in range(fine.ndim)]), values.dtype)
        below = xp.take(values, cell, axis=axis)
        above = xp.take(values, (cell + 1) % coarse.shape[axis], axis=axis)
        values = (1 - weight) * below + weight * above
    return values
