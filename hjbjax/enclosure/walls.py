"""The influence of the walls at projected ends on the value.

A problem that continues beyond the box differs from the problem with walls only after a path has met an end. Let T(x)
be a lower bound of the time until then, for all admissible controls. By dynamic programming the two values differ at x
by at most e^{−βT(x)} times their largest difference at the ends. T follows from the largest outward speed in every
layer of cells.
"""

from typing import Any

import numpy as np

from hjbjax.enclosure.defect import all_cells
from hjbjax.enclosure.interpolant import Spline
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import ranges
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import Interval, quietly
from hjbjax.tracing.taylor_forms import Form

ROUNDING = 1e-12  # relative, larger than the rounding of all sums below


@quietly
def remaining(problem: Problem, grid: Grid, spline: Spline) -> np.ndarray:
    """The largest discount factor at the time when a path from each node meets a projected end, shape (*grid).

    Args:
      problem: a problem of one player with costs.
      grid: the grid.
      spline: the cells.

    Returns:
      e^{−βT}, rounded upward, with the least discount β in the box; zero without projected ends.
    """
    ends = grid.sides("projected")
    if not ends:
        return np.zeros(grid.shape)
    every = all_cells(spline)
    cells = spline.cells(every)
    x = tf.coordinates(cells.ranges, cells.centres, grid.ndim)
    drift = tf.taylor_forms(problem.drift, x, _any_action(problem.controls))
    (rate,) = tf.taylor_forms(problem.discount, *([x] * callable(problem.discount))).reshape(-1)
    soonest = np.full(grid.shape, np.inf)
    for axis, step in ends:
        outward = drift[axis].range.hi if step > 0 else -drift[axis].range.lo
        speeds = np.broadcast_to(outward, every[0].shape).reshape(spline.shape)
        layers = np.max(np.maximum(speeds, 0), axis=tuple(k for k in range(grid.ndim) if k != axis))
        gaps = np.diff(np.asarray(grid.axis(axis), float)) * (1 - ROUNDING)
        crossing = gaps / np.maximum(layers[1:], layers[:-1])
        along = np.append(np.cumsum(crossing[::-1])[::-1], 0.0) if step > 0 else np.append(0.0, np.cumsum(crossing))
        soonest = np.minimum(soonest, along.reshape([-1 if k == axis else 1 for k in range(grid.ndim)]))
    least = max(float(np.min(rate.range.lo)), 0.0)
    return np.minimum(np.exp(-least * soonest * (1 - ROUNDING)) * (1 + ROUNDING), 1.0)


def _any_action(admissible: Any) -> list[Form]:
    """Every input of the control as one interval."""
    if admissible is None:
        return []
    inputs = [Interval(np.asarray(lo), np.asarray(hi)) for lo, hi in zip(*ranges(admissible), strict=True)]
    return [Form(each, each) for each in inputs]
