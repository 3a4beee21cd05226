"""Estimates of the errors of a march, from marches on a coarser grid with steps twice as long.

The first coarse march has the caller's ends. Its difference from V is the discretisation error in space and time, see
``solution.grid_error``. The second coarse march has other ends. Its difference from the first is the box error, see
``box_error``.

A step ends at every kept time, so it cannot be longer than the time between two of them. If there are only a few steps
between kept times, the coarse marches keep fewer times. In between, the estimate is the largest one of the nodes near
by at the two neighbouring times.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import bellman, time_stepping
from hjbjax.iteration.time_methods import TOL, TimeMethod
from hjbjax.iteration.time_stepping import March
from hjbjax.problem.pytree import altered, cast
from hjbjax.problem.types import Nodes, Number
from hjbjax.solution.clock import Clock
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status
from hjbjax.solvers import box_error, grid_error, horizon_samples, march_run, nested_grids, time_probes
from hjbjax.solvers.box_error import BoxError
from hjbjax.solvers.coarser_answer import LOSES, OVER, TOO_FEW
from hjbjax.solvers.grid_error import SMEARED_JUMPS, TwoGrids
from hjbjax.solvers.march_discontinuities import error_along_paths
from hjbjax.solvers.result import warn_of_grid
from hjbjax.solvers.setup import march_evaluation

# least number of implicit steps and of explicit steps between two kept times of the coarse march; most of the error of
# implicit steps is that in time, and three of them cannot be halved
FEW, FEWEST = 4, 2
UNSETTLED = "not estimated: the march on the coarser grid did not come to its end"
ONE_STEP = "not estimated: the march took one step, and a coarser one cannot take fewer"

_stable_steps = jax.jit(time_stepping.stable_steps)


@jax.jit
def _fixed(on: Discretisation) -> tuple[jax.Array, jax.Array]:
    """The fixed nodes and the nodes on the target, bool (*grid) each."""
    found = bellman.obstacles(on)
    return found.fixed, jnp.broadcast_to(found.ended, on.grid.shape)


@dataclasses.dataclass(frozen=True)
class Marched:
    """A completed march, and the data needed to repeat it.

    Args:
      task: its task, on the caller's grid.
      method: the caller's method.
      start: the caller's V at the horizon, or None.
      steps: its number of steps.
    """

    task: March
    method: TimeMethod
    start: Nodes | None
    steps: int


class _Coarse(NamedTuple):
    """A coarser grid and the step lengths for it, or the reason why the grid error has no estimate.

    Attributes:
      on: the problem on the coarser grid; None if there is nothing to march.
      longer: the ratio of the steps to the steps of the finer march.
      kept: the indices of the kept times that the coarse march keeps.
      reason: why there is no estimate of the grid error; empty if there is one.
    """

    on: Discretisation | None
    longer: float
    kept: np.ndarray
    reason: str = ""


def with_march_errors(solution: Solution, marched: Marched, clock: Clock) -> Solution:
    """The solution with ``grid_error`` and ``box_error``, or the reasons why there are none; warns if they are large.

    Args:
      solution: the solution of a completed march, at host level.
      marched: the march.
      clock: the limits; there is no estimate once they are exceeded.
    """
    if clock.over() is not None:
        solution.stats["grid_error"] = solution.stats["box_error"] = OVER
        return solution
    clock.phase = "the estimate of the errors"
    task = marched.task
    held, points = _held(task, np.asarray(solution.times))
    coarse = _coarser(marched, np.asarray(solution.times), held)
    first = None if coarse.on is None else _again(marched, coarse, coarse.on, solution, clock)
    other = None if first is None or coarse.reason else _from_other_samples(marched, coarse, solution, clock)
    solution = _with_grid_error(solution, marched, coarse, (first, other), held, points)
    return box_error.reported(solution, _box_error(solution, marched, coarse, first, clock))


def _with_grid_error(
    solution: Solution,
    marched: Marched,
    coarse: _Coarse,
    found: tuple[np.ndarray | None, np.ndarray | None],
    held: np.ndarray,
    points: bool,
) -> Solution:
    """The solution with an estimate of the discretisation error in space and time.

    ``found``: V on the coarser grid, and from other values at the horizon.
    """
    first, other = found
    if coarse.reason or first is None or coarse.on is None:
        solution.stats["grid_error"] = coarse.reason or UNSETTLED
        return solution
    value, grid = np.asarray(solution.value), solution.grid
    horizon, highest = float(marched.task.horizon), _highest(marched.task, points)
    errors = np.zeros_like(value)
    for i, before in zip(coarse.kept, first, strict=True):
        if solution.times[i] < horizon:  # V is prescribed at the horizon
            fixed = held[i % len(held)]
            answers = TwoGrids(grid, coarse.on.grid, value[i], before, fixed, highest=highest, jumps=SMEARED_JUMPS)
            errors[i] = grid_error.estimate_error(answers)
    missed = error_along_paths(solution, marched.task, marched.start, held)
    if missed is not None:
        errors = np.maximum(errors, missed.astype(errors.dtype))
    if other is not None:
        ratio = nested_grids.ratio_of(grid, coarse.on.grid)
        for i, before, changed in zip(coarse.kept, first, other, strict=True):
            hidden = nested_grids.prolong(np.abs(changed - before) / ratio, coarse.on.grid, grid)
            errors[i] = np.maximum(errors[i], hidden)
    warn_of_grid(errors, value, "nodes and steps")
    for i in np.flatnonzero(solution.times < horizon):
        errors[i] += _left(marched, value[i])
    return dataclasses.replace(solution, grid_error=_at_all_times(errors, coarse.kept, solution, marched))


def _box_error(
    solution: Solution, marched: Marched, coarse: _Coarse, first: np.ndarray | None, clock: Clock
) -> BoxError:
    """The difference between two coarse marches with different ends of the box."""
    task, on = marched.task, coarse.on
    others = box_error.other_ends(task.problem, task.grid)
    if others == task.grid.edges:
        return BoxError(None, box_error.CANNOT_MATTER)
    if on is None:
        return BoxError(None, box_error.TOO_MANY)
    if clock.over() is not None:
        return BoxError(None, OVER)
    second = None
    if first is not None:
        second = _again(marched, coarse, on.on_grid(altered(on.grid, edges=others)), solution, clock)
    if first is None or second is None:
        return BoxError(None, box_error.UNSETTLED)
    found = box_error.of_two_marches(first, second, on.grid, np.asarray(solution.value), task.grid)
    if found.error is None or len(coarse.kept) == len(solution.times):
        return found
    errors = np.zeros((len(solution.times), *task.grid.shape), found.error.dtype)
    errors[coarse.kept] = found.error
    return found._replace(error=_at_all_times(errors, coarse.kept, solution, marched))


def _held(task: March, times: np.ndarray) -> tuple[np.ndarray, bool]:
    """The fixed nodes at each kept time, bool (k, *grid), or once for all, and true if a target is a point."""
    problem, grid = task.problem, task.grid
    if problem.target is None and not grid.prescribed("dirichlet"):
        return np.zeros((1, *grid.shape), bool), False
    on = task.on
    moments = times if problem.time_dependent else times[:1]
    found = [jax.device_get(_fixed(on.at(jnp.asarray(t, on.dtype)))) for t in moments]
    return np.stack([fixed for fixed, _ in found]), any(grid_error.is_a_point(ended) for _, ended in found)


def _coarser(marched: Marched, times: np.ndarray, held: np.ndarray) -> _Coarse:
    """The coarser grid for the repeated march."""
    task, everything = marched.task, np.arange(len(times))
    grid, others = task.grid, box_error.other_ends(task.problem, task.grid)
    coarse = nested_grids.comparison_grid(grid, np.any(held, axis=0))
    if coarse is None:
        reason = TOO_FEW if nested_grids.comparison_grid(grid, np.zeros(grid.shape, bool)) is None else LOSES
    elif min(coarse.shape) < task.on.scheme.points and not task.on.scheme.monotone:
        reason = TOO_FEW
    elif marched.steps <= 1 and not task.method.limited:
        reason = ONE_STEP
    else:
        on = task.on.on_grid(coarse)
        kept = _far_apart(times, float(task.horizon), (FEWEST if task.method.limited else FEW) / max(marched.steps, 1))
        return _Coarse(on, _longer(marched, times[kept]), kept)
    if others == grid.edges:
        return _Coarse(None, 1.0, everything, reason)
    smaller = box_error.coarse_for_marches(grid)
    if smaller is None:
        return _Coarse(None, 1.0, everything, reason)
    return _Coarse(task.on.chain.on_grid(smaller), 1.0, everything, reason)


def _far_apart(times: np.ndarray, horizon: float, share: float) -> np.ndarray:
    """The indices of the kept times of the coarse march: the first, and others at least a share of the march apart."""
    least = min(share, 0.5) * (horizon - times[0]) * (1 - 1e-6)
    chosen = [0]
    for k in range(1, len(times)):
        ends = times[k] >= horizon
        if ends or (times[k] - times[chosen[-1]] >= least and horizon - times[k] >= least):
            chosen.append(k)
    return np.array(chosen)


def _longer(marched: Marched, times: np.ndarray) -> float:
    """The ratio of the steps: two, or three for a few implicit steps, since three steps cannot be halved."""
    horizon = float(marched.task.horizon)
    lengths = np.diff([*times, horizon])
    few = np.min(lengths, where=lengths > 0, initial=horizon) * marched.steps < 3 * FEW * (horizon - times[0])
    return 3.0 if few and not marched.task.method.limited else 2.0


def _from_other_samples(marched: Marched, coarse: _Coarse, solution: Solution, clock: Clock) -> np.ndarray | None:
    """The coarse march from other values near the jumps and kinks at the horizon; None if there are none."""
    task, on = marched.task, coarse.on
    if on is None or clock.over() is not None:
        return None
    value, start = np.asarray(solution.value), marched.start
    start = None if start is None else np.asarray(start)
    begin = horizon_samples.other_samples(task.on.at(task.horizon), start, on.grid, float(np.ptp(value)))
    return None if begin is None else _again(marched, coarse, on, solution, clock, begin)


def _again(
    marched: Marched,
    coarse: _Coarse,
    on: Discretisation,
    solution: Solution,
    clock: Clock,
    begin: np.ndarray | None = None,
) -> np.ndarray | None:
    """V at the times that are kept again, by a march on a coarser grid; None if it does not finish.

    ``begin``: V at the horizon on this grid; by default the caller's.
    """
    task, on = marched.task, cast(on, on.dtype)
    start = marched.start
    if begin is None and start is not None:
        begin = nested_grids.restrict(np.asarray(start), task.grid, on.grid)
    method = marched.method.filled(on, march_evaluation(on.problem, on.grid))
    longer = coarse.longer > 1
    again = dataclasses.replace(
        task, on=on, method=method, obstacles=None, watched=None, limit=_limit(task, on) if longer else task.limit,
        step=_steps(task, coarse.longer) if longer else task.step, checks_rates=longer and task.checks_rates,
        checks_noise=False, checks_gap=False, checks_cut=False, bare=True, mesh=None,
    )  # fmt: skip
    kept = np.asarray(solution.times, float)[coarse.kept]
    slices, _, code = march_run.drive_march(again, float(task.horizon), kept, begin, clock.beside())
    return slices.value if code is Status.CONVERGED and np.all(np.isfinite(slices.value)) else None


def _steps(task: March, longer: float) -> np.ndarray:
    """Steps longer by a factor, except steps that were shortened to resolve functions of time."""
    step = np.asarray(task.step)
    if step.ndim == 0:
        return longer * step
    return np.where(step < float(task.horizon) / time_probes.PARTS * (1 - 1e-6), step, longer * step)


def _limit(task: March, on: Discretisation) -> Number | None:
    """The longest stable step on a coarser grid; None if it is computed before every step.

    If all spacings grow by r, the rates Q fall by at least r, so the limit is known without compiling a program.
    """
    if task.limit is None or not task.method.limited or not math.isfinite(float(task.limit)):
        return task.limit
    tableau, beta = task.method.tableau, float(task.problem.discount)
    fine, coarse = task.grid, on.grid
    different = any(getattr(task.problem, name) is not None for name in ("target", "killing", "growth"))
    if different or any(a == b for a, b in zip(fine.shape, coarse.shape, strict=True)):
        return np.asarray(_stable_steps(on, task.method))[1]
    ratio, limit, share = nested_grids.ratio_of(fine, coarse), float(task.limit), float(task.method.courant)
    if beta == 0 or len(tableau.means) == 1:
        rate = share / limit  # Q + β, see ``longest_step``
        return np.asarray(share / ((rate - beta) / ratio + beta), on.dtype)
    rate = share * beta / math.expm1(beta * limit)
    return np.asarray(math.log1p(beta * share / ((rate - beta) / ratio + beta)) / beta, on.dtype)


def _highest(task: March, point: bool) -> float:
    """The largest possible order of the error: the smaller of the orders of scheme and method."""
    if point:
        return grid_error.LEAST
    first = task.on.scheme.stages == 1 or len(task.method.tableau.means) == 1
    return grid_error.FIRST if first else grid_error.SECOND


def _left(marched: Marched, value: np.ndarray) -> float:
    """The algebraic error of implicit steps, plus the error from fast functions of time, cost units."""
    missed = float(marched.task.missed) * float(np.max(np.abs(value)))
    if marched.task.method.limited:
        return missed
    tol = marched.method.tol
    return missed + (TOL * min(1.0, float(np.ptp(value))) if tol is None else float(tol))


def _at_all_times(errors: np.ndarray, known: np.ndarray, solution: Solution, marched: Marched) -> np.ndarray:
    """Errors at all kept times, (k, *grid), from those at the ``known`` ones.

    The error at a time in between is at most the largest at both neighbours near a node: it moves by one cell per step.
    """
    between, times = np.setdiff1d(np.arange(len(errors)), known), solution.times
    if not between.size:  # also a march without a step
        return errors
    per_time = marched.steps / (float(marched.task.horizon) - float(times[0]))
    for i in between:
        near = [k for k in (known[known < i][-1:], known[known > i][:1]) if k.size]
        found = np.max([errors[int(k[0])] for k in near], axis=0)
        for _ in range(math.ceil(max(abs(times[int(k[0])] - times[i]) for k in near) * per_time)):
            found = grid_error.combined(found, solution.grid, np.maximum)
        errors[i] = found
    return errors
