"""The solutions on the next coarser grid, for the estimate of the grid error.

The estimate is part of the solution. It also ends the second-order iteration, whose last steps would only reduce errors
far below that of the grid. For this the coarser grid is solved first, by both orders.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from hjbjax.iteration.fixed_point import State, Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Nodes
from hjbjax.solution.clock import Clock
from hjbjax.solution.status import Status
from hjbjax.solvers import grid_error, nested_grids
from hjbjax.solvers.coarse_levels import (
    CoarserAnswer,
    answer_of,
    comparison_grid_of,
    fill_unreachable,
    on_coarser,
    values_of,
)
from hjbjax.solvers.settle import Settled
from hjbjax.solvers.stationary_run import iterate

TOO_FEW = f"not estimated: it takes at least {2 * nested_grids.FEWEST_TELLING - 1} intervals per axis"
LOSES = "not estimated: no coarser grid keeps the fixed and the unreachable nodes"
OVER = "not estimated: the limits of the solve were reached"
UNSETTLED = "not estimated: the solve on the coarser grid ended {}"

SHARE = 0.1  # fraction of the estimated grid error that a second-order iteration may leave ...
MOST = 0.01  # ... up to this fraction of the range of V, because next to a jump the estimate is the whole range
ROUGH = 0.03  # fraction of the change by second order at which a coarse solution suffices to estimate the grid error


def coarser_answer(settled: Settled, clock: Clock) -> CoarserAnswer:
    """The solution on the next coarser grid, by the scheme of ``settled`` and started from its value."""
    level = _level(settled.running, clock)
    if isinstance(level, CoarserAnswer):
        return level
    # infinite values are imposed again by the unreachable nodes
    state, code = _iterated(level, _restricted(settled, level), clock)
    if code is not Status.CONVERGED:
        return CoarserAnswer(None, reason=UNSETTLED.format(code.name))
    return answer_of(level, state)


def comparison(chain: Settled, sharp: Settled, clock: Clock) -> tuple[CoarserAnswer, CoarserAnswer, np.ndarray | None]:
    """The solutions of both orders on the next coarser grid, and an estimate of the error of the fine grid.

    The second-order value on the fine grid, which is not known yet, is extrapolated: the change from the monotone value
    is proportional to the spacing.

    Args:
      chain: the monotone solution.
      sharp: the second-order task, whose state is the monotone one.
      clock: the limits.

    Returns:
      The monotone and the second-order answer, and the estimate on the coarser grid, in cost units; None if there is
      none.
    """
    level = _level(sharp.running, clock)
    first = chain.coarser or coarser_answer(chain, clock)
    if isinstance(level, CoarserAnswer) or first.value is None:
        return first, level if isinstance(level, CoarserAnswer) else first, None
    guess = _restricted(chain, level)
    enough = max(float(level.tol), ROUGH * float(np.max(nested_grids.apart(guess, first.value))))
    state, code = _iterated(dataclasses.replace(level, tol=jnp.asarray(np.asarray(enough, guess.dtype))), guess, clock)
    if code is Status.CONVERGED:
        error = _expected_error(chain, level.grid, first.value, values_of(level, state))
        state, code = _iterated(stop_at(level, error, guess), fill_unreachable(level, state), clock)
    if code is not Status.CONVERGED:
        return first, CoarserAnswer(None, reason=UNSETTLED.format(code.name)), None
    second = values_of(level, state)
    return first, CoarserAnswer(level.grid, second), _expected_error(chain, level.grid, first.value, second)


def _expected_error(chain: Settled, coarse: Grid, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The error of the fine grid for the extrapolated second-order value, (*coarse), cost units.

    Args:
      chain: the monotone solution on the fine grid.
      coarse: the coarser grid.
      first, second: the monotone and the second-order values there, infinite at unreachable nodes, (*coarse).
    """
    task, grid = chain.task, chain.task.grid
    value = values_of(task, chain.state)
    change = np.zeros(coarse.shape)
    np.subtract(second, first, out=change, where=np.isfinite(first))
    expected = nested_grids.prolong(change, coarse, grid)  # in place from here on: each array has all nodes
    expected /= nested_grids.ratio_of(grid, coarse)
    expected += value
    fixed = np.broadcast_to(np.asarray(task.obstacles.fixed), grid.shape)
    np.copyto(expected, value, where=fixed)
    return grid_error.estimate_on_coarse(grid_error.TwoGrids(grid, coarse, expected, second, fixed, chain=value))


def stop_at(task: Task, error: np.ndarray, value: np.ndarray) -> Task:
    """The task of a high-order scheme that stops at a ``SHARE`` of an estimate, both in the largest and in the mean.

    Errors of the iteration concentrate near kinks, like errors of the grid. Reducing them takes most of the steps.

    Args:
      task: the task.
      error: the estimate of the grid error, cost units.
      value: finite values of about the same range as V, cost units.
    """
    tolerances = np.minimum(SHARE * np.array([np.max(error), np.mean(error)]), MOST * np.ptp(value))
    weights = float(task.tol) / np.maximum(tolerances, float(task.tol))
    return dataclasses.replace(task, weights=weights.astype(task.tol.dtype))


def remaining_error(task: Task, left: float, error: np.ndarray) -> np.ndarray | float:
    """The error of the iteration for its norm ``left``, spread like the estimate of the grid error, (*grid).

    One number for all nodes if the norm has no mean, or the estimate is zero.
    """
    largest, mean = np.asarray(task.weights, float).tolist()
    if mean == 0 or np.max(error) == 0:
        return left / largest
    return np.minimum(left / largest, left / mean + left / largest * error / np.max(error))


def _level(task: Task, clock: Clock) -> Task | CoarserAnswer:
    """The task on the comparison grid, or the reason why there is none."""
    fine, coarse = task.grid, comparison_grid_of(task)
    if coarse is None:
        few = nested_grids.comparison_grid(fine, np.zeros(fine.shape, bool)) is None
        return CoarserAnswer(None, reason=TOO_FEW if few else LOSES)
    if clock.over() is not None:
        return CoarserAnswer(None, reason=OVER)
    level = on_coarser(task, coarse)
    return CoarserAnswer(None, reason=LOSES) if level is None else level


def _restricted(settled: Settled, level: Task) -> np.ndarray:
    """The value at the nodes of a coarser grid, (*level.grid)."""
    value = fill_unreachable(settled.task, settled.state)
    return nested_grids.restrict(value, settled.task.grid, level.grid).astype(value.dtype)


def _iterated(level: Task, guess: Nodes, clock: Clock) -> tuple[State, Status]:
    """The last state of an iteration on the coarser grid, and its status."""
    state, code, _ = iterate(level, guess, clock)
    return state, code
