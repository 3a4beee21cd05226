"""The influence of the walls at projected ends on the value.

A problem that continues beyond the box differs from the problem with walls only after a path has met an end. Let T(x)
be a lower bound of the time until then, for all admissible controls. By dynamic programming the two values differ at x
by at most e^{−βT(x)} times their largest difference at the ends. T follows from the largest outward speed in every
layer of cells.
"""

import numpy as np

from hjbjax.enclosure.cell_functions import any_actions
from hjbjax.enclosure.defect import all_cells
from hjbjax.enclosure.interpolant import Spline
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import quietly

ROUNDING = 1e-12  # relative, larger than the rounding of all sums below


@quietly
def times(problem: Problem, grid: Grid, spline: Spline) -> np.ndarray:
    """A lower bound of the time until any path from each node meets a projected end, shape (*grid).

    Args:
      problem: a problem with costs.
      grid: the grid.
      spline: the cells.

    Returns:
      T, rounded downward; infinite without projected ends.
    """
    ends = grid.sides("projected")
    if not ends:
        return np.full(grid.shape, np.inf)
    cells = spline.cells(all_cells(spline))
    x = tf.coordinates(cells.ranges, cells.centres, grid.ndim)
    drift = tf.taylor_forms(problem.drift, x, *any_actions(problem))
    soonest = np.full(grid.shape, np.inf)
    for axis, step in ends:
        outward = drift[axis].range.hi if step > 0 else -drift[axis].range.lo
        speeds = np.broadcast_to(outward, spline.shape)
        layers = np.max(np.maximum(speeds, 0), axis=tuple(k for k in range(grid.ndim) if k != axis))
        gaps = np.diff(np.asarray(grid.axis(axis), float)) * (1 - ROUNDING)
        crossing = gaps / np.maximum(layers[1:], layers[:-1])
        along = np.append(np.cumsum(crossing[::-1])[::-1], 0.0) if step > 0 else np.append(0.0, np.cumsum(crossing))
        soonest = np.minimum(soonest, along.reshape([-1 if k == axis else 1 for k in range(grid.ndim)]))
    return soonest * (1 - ROUNDING)


@quietly
def remaining(problem: Problem, grid: Grid, spline: Spline) -> np.ndarray:
    """The largest discount factor at the time when a path from each node meets a projected end, shape (*grid).

    Args:
      problem: a problem with costs and a discount.
      grid: the grid.
      spline: the cells.

    Returns:
      e^{−βT}, rounded upward, with the least discount β in the box; zero without projected ends.
    """
    if not grid.sides("projected"):
        return np.zeros(grid.shape)
    cells = spline.cells(all_cells(spline))
    x = tf.coordinates(cells.ranges, cells.centres, grid.ndim)
    (rate,) = tf.taylor_forms(problem.discount, *([x] * callable(problem.discount))).reshape(-1)
    least = max(float(np.min(rate.range.lo)), 0.0)
    share = np.exp(-least * times(problem, grid, spline)) * (1 + ROUNDING)
    return np.where(np.isfinite(share), np.minimum(share, 1.0), 1.0)
