"""The error of a march from jumps and kinks of V at the horizon between the nodes.

Paths that end at a minimum between two nodes, or on the lower side of a jump, pay the value of a node. A coarser grid
may have the same node next to it, and then the comparison of two grids shows nothing.

Let a, m and b be V at the ends and in the middle of a cell. The second difference a − 2m + b is a quarter of that over
two cells if V is smooth. Otherwise V is changed at the nodes by what the cell may hide:

- at a kink by the error of interpolation m − (a + b)/2, which is the height of a minimum of two lines above its kink;
- at a jump to the smaller of a and b, which moves the jump by up to one cell.

The march carries the change from the horizon to the kept times. To first order it is proportional to the spacing.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import time_stepping
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import cast
from hjbjax.solvers import nested_grids
from hjbjax.solvers.discontinuities import LEAST, SMOOTH


@jax.jit
def _at_horizon(on: Discretisation) -> jax.Array:
    """V at the horizon, (*grid)."""
    return jnp.broadcast_to(time_stepping.terminal(on), on.grid.shape)


def other_samples(on: Discretisation, start: np.ndarray | None, coarse: Grid, extent: float) -> np.ndarray | None:
    """V at the horizon at the nodes of a coarser grid, changed near jumps and kinks, (*coarse); None if it is smooth.

    Args:
      on: the problem at the horizon, on the grid whose error is estimated.
      start: V at the horizon on this grid, if it is not the terminal cost.
      coarse: the coarser grid.
      extent: the range of V: changes of a small fraction of it are ignored.
    """
    double = [count + coarse.intervals(axis) * (axis in coarse.state_axes) for axis, count in enumerate(coarse.shape)]
    fine = nested_grids.with_faces_of(coarse, nested_grids.resized(coarse, double))
    given = None if start is None else nested_grids.restrict(start, on.grid, fine)
    halves = np.asarray(_at_horizon(cast(on.on_grid(fine), on.dtype))) if given is None else given
    value, ratio = nested_grids.restrict(halves, fine, coarse), nested_grids.ratio_of(on.grid, coarse)
    # a cost may be undefined between nodes
    halves = np.where(np.isfinite(halves), halves, nested_grids.prolong(value, coarse, fine))
    lowest, bent = value, np.zeros_like(value)
    for axis in coarse.state_axes:
        line = halves
        for other in coarse.state_axes:
            if other != axis:
                line = np.moveaxis(np.moveaxis(line, other, 0)[::2], 0, other)
        low, bend = (np.moveaxis(each, 0, axis) for each in _hidden(np.moveaxis(line, axis, 0), coarse.periodic[axis]))
        lowest, bent = np.minimum(lowest, low), np.where(np.abs(bend) > np.abs(bent), bend, bent)
    changed = lowest + ratio * bent
    return changed if np.max(np.abs(changed - value)) > ratio * LEAST * extent else None


def _hidden(halves: np.ndarray, periodic: bool) -> tuple[np.ndarray, np.ndarray]:
    """The smaller value across a jump next to each node, and the error of interpolation at a kink; along axis 0."""
    node, middle = halves[::2], halves[1::2]
    ahead = np.roll(node, -1, axis=0)[: len(middle)]
    here = node[: len(middle)]
    step, bend = np.abs(ahead - here), here - 2 * middle + ahead
    nothing = np.full_like(bend[:1], np.nan)
    before, after = (_beside(step, shift, nothing, periodic) for shift in (1, -1))
    turn = np.abs(np.diff(ahead - here, axis=0, prepend=(ahead - here)[-1:] if periodic else nothing))
    # the smaller turn at the two ends of a cell: both contain a jump or kink inside it
    smooth = np.abs(bend) <= SMOOTH * np.nan_to_num(np.fmin(turn, _beside(turn, -1, nothing, periodic)))
    size = np.abs(bend)
    # at an inflection both ends turn little, and the cells next to it bend more
    smooth |= size < np.nan_to_num(np.fmax(*(_beside(size, shift, nothing, periodic) for shift in (1, -1))))
    half = np.maximum(np.abs(middle - here), np.abs(ahead - middle))
    jump = ~smooth & (half > np.nan_to_num(np.fmax(before, after)))
    low = np.where(jump, np.minimum(here, ahead), np.inf)
    bend = np.where(smooth | jump, 0, -bend / 2)
    if periodic:
        below = (np.roll(each, 1, axis=0) for each in (low, bend))
    else:
        ends = np.full_like(nothing, np.inf), np.zeros_like(nothing)
        pairs = list(zip((low, bend), ends, strict=True))
        below = (np.concatenate([end, each]) for each, end in pairs)
        low, bend = (np.concatenate([each, end]) for each, end in pairs)
    low_below, bend_below = below
    return np.minimum(low, low_below), np.where(np.abs(bend_below) > np.abs(bend), bend_below, bend)


def _beside(cells: np.ndarray, shift: int, nothing: np.ndarray, periodic: bool) -> np.ndarray:
    """The entries of the cells before (1) or after (−1) each cell; NaN beyond an end."""
    moved = np.roll(cells, shift, axis=0)
    if not periodic:
        moved[0 if shift > 0 else -1] = nothing[0]
    return moved
