"""The step from the monotone to the second-order solution, and the choice between the two."""

import numpy as np

from hjbjax.discretisation.discretisation import Scheme
from hjbjax.solution.clock import Clock
from hjbjax.solution.status import Status
from hjbjax.solvers import grid_error, nested_grids
from hjbjax.solvers.coarse_levels import fill_unreachable
from hjbjax.solvers.coarser_answer import coarser_answer, comparison, stop_at
from hjbjax.solvers.order import raised
from hjbjax.solvers.settle import Settled
from hjbjax.solvers.stationary_run import iterate

LITTLE = 0.1  # fraction of the range of V by which the second order may change V without further checks


def second_order(settled: Settled, scheme: Scheme, clock: Clock, *, to_grid_error: bool) -> Settled:
    """The solution by a high-order scheme, started from the monotone one, which it keeps as its ``origin``.

    If the clock stops it before its initial evaluation, the monotone solution is returned with the status of the stop.
    ``settled`` may lack its actions. ``to_grid_error`` as in ``raise_order``.
    """
    over = clock.over()
    if over is not None:
        return settled._replace(code=over)
    sharp = raise_order(settled, scheme, clock, to_grid_error=to_grid_error)
    state, ended, residuals = iterate(sharp.running, settled.state.value, clock)
    if not state.progress.has_begun:
        return settled._replace(code=ended)
    return sharp._replace(state=state, code=ended, residuals=residuals)


def raise_order(settled: Settled, scheme: Scheme, clock: Clock, *, to_grid_error: bool) -> Settled:
    """The task of a high-order scheme, with the state of the monotone solution, its ``origin``.

    With ``to_grid_error`` its iteration may stop at a fraction of the grid error. The solutions of both orders on the
    next coarser grid are computed to estimate this error, and kept as ``coarser``.
    """
    task, assumptions = raised(settled.task, settled.assumptions, scheme)
    sharp = settled._replace(task=task, assumptions=assumptions, origin=settled, coarser=None)
    if not to_grid_error:
        return sharp
    first, second, error = comparison(settled, sharp, clock)
    sharp = sharp._replace(origin=settled._replace(coarser=first), coarser=second)
    if error is None:
        return sharp
    return sharp._replace(task=stop_at(task, error, fill_unreachable(settled.task, settled.state)))


def better_of(settled: Settled, sharp: Settled, clock: Clock, *, sharpen: bool) -> Settled:
    """The second-order solution, or, if the caller left the choice (``sharpen``), the monotone one with a note.

    The monotone solution is returned if the second-order iteration did not converge, or if it moved V further than the
    error of the grid explains.
    """
    return (_better_of(settled, sharp, clock) if sharpen else sharp).with_actions()


def _better_of(settled: Settled, sharp: Settled, clock: Clock) -> Settled:
    """The choice of ``better_of`` if the caller left it; the monotone solution may lack its actions."""
    settled = sharp.origin or settled  # together with its answer on the coarser grid
    if sharp.code is not Status.CONVERGED:
        # Ctrl-C leaves the solve unfinished; after a time limit the monotone answer is complete
        code = sharp.code if sharp.code is Status.INTERRUPTED else settled.code
        note = f"The value is of first order, since the second-order iteration ended with {sharp.code.name}."
        return settled._replace(code=code, note=note)
    contradiction = _contradiction(settled, sharp, clock)
    return sharp if contradiction is None else settled._replace(note=contradiction)


def _contradiction(settled: Settled, sharp: Settled, clock: Clock) -> str | None:
    """The note on a second-order solution that contradicts the certified monotone one; None if it does not.

    The error of the monotone solution is its change from the next coarser grid over 2^q − 1, with the least order q =
    ½. Nothing is computed if the second order changed little.
    """
    before, after = fill_unreachable(settled.task, settled.state), fill_unreachable(sharp.task, sharp.state)
    moved = float(np.max(nested_grids.apart(before, after)))
    if moved <= LITTLE * float(np.ptp(before)):
        return None
    found = settled.coarser or coarser_answer(settled, clock)
    if found.grid is None or found.value is None:
        return None
    coarse, value = found.grid, found.value
    change = nested_grids.apart(nested_grids.restrict(before, settled.task.grid, coarse), value)
    explained = float(np.max(change)) / (nested_grids.ratio_of(settled.task.grid, coarse) ** grid_error.LEAST - 1)
    if moved <= explained + float(settled.task.tol):
        return None
    return (
        f"The value is of first order, since the second-order answer differs from this certified one by up "
        f"to {moved:.3g}, of which the grid explains {explained:.3g}."
    )
