"""The solution on the next coarser grid, for the estimate of the error of the grid."""

from typing import NamedTuple

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.solution.clock import Clock
from hjbjax.solution.status import Status
from hjbjax.solvers import nested_grids
from hjbjax.solvers.coarse_levels import comparison_grid_of, fill_unreachable, on_coarser
from hjbjax.solvers.settle import Settled
from hjbjax.solvers.stationary_run import iterate

TOO_FEW = f"not estimated: it takes at least {2 * nested_grids.FEWEST_TELLING - 1} intervals per axis"
LOSES = "not estimated: no coarser grid keeps the fixed and the unreachable nodes"
OVER = "not estimated: the limits of the solve were reached"
UNSETTLED = "not estimated: the solve on the coarser grid ended {}"


class CoarserAnswer(NamedTuple):
    """The solution on a coarser grid, infinite at unreachable nodes, or the reason why there is none."""

    grid: Grid | None
    value: np.ndarray | None = None
    reason: str = ""


def coarser_answer(settled: Settled, clock: Clock) -> CoarserAnswer:
    """The solution on the next coarser grid, by the scheme of ``settled`` and started from its value."""
    task, fine = settled.running, settled.task.grid
    coarse = comparison_grid_of(task)
    if coarse is None:
        few = nested_grids.comparison_grid(fine, np.zeros(fine.shape, bool)) is None
        return CoarserAnswer(None, reason=TOO_FEW if few else LOSES)
    if clock.over() is not None:
        return CoarserAnswer(None, reason=OVER)
    if (level := on_coarser(task, coarse)) is None:
        return CoarserAnswer(None, reason=LOSES)
    value = fill_unreachable(task, settled.state)  # infinite values are imposed again by the unreachable nodes
    state, code, _ = iterate(level, nested_grids.restrict(value, fine, coarse).astype(value.dtype), clock)
    if code is not Status.CONVERGED:
        return CoarserAnswer(None, reason=UNSETTLED.format(code.name))
    return CoarserAnswer(coarse, np.where(np.asarray(level.counted), np.asarray(state.value), np.inf))
