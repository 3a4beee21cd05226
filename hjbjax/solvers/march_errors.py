"""Estimates of the errors of a march, from marches on a coarser grid with steps twice as long.

The first coarse march has the ends of the caller. Its difference from V is the error of the spacing and of the step in
time together, see ``solution.grid_error``. The second one has other ends. Its difference from the first is the error
of the box, see ``box_error``.

A step ends at every kept time, and cannot be longer than the time between two of them. Where there are only a few steps
from one kept time to the next, the coarse marches keep every second time, and the estimate in between is the larger
one of its two neighbours.
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
from hjbjax.solution import grid_error, nested_grids
from hjbjax.solution.clock import Clock
from hjbjax.solution.grid_error import TwoGrids
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status
from hjbjax.solvers import box_error, march_run, time_probes
from hjbjax.solvers.box_error import BoxError
from hjbjax.solvers.coarser_answer import LOSES, OVER, TOO_FEW
from hjbjax.solvers.result import warn_of_grid
from hjbjax.solvers.setup import march_evaluation

FEW = 4  # steps between two kept times, below which the coarse march keeps every second time
UNSETTLED = "not estimated: the march on the coarser grid did not come to its end"
ONE_STEP = "not estimated: the march took one step, and a coarser one cannot take fewer"

_stable = jax.jit(time_stepping.stable, static_argnames="tableau")


@jax.jit
def _fixed(on: Discretisation) -> tuple[jax.Array, jax.Array]:
    """The fixed nodes and those on the target, bool (*grid) each."""
    found = bellman.obstacles(on)
    return found.fixed, jnp.broadcast_to(found.ended, on.grid.shape)


@dataclasses.dataclass(frozen=True)
class Marched:
    """A march that came to its end, and what is needed to march again.

    Args:
      task: its task, on the caller's grid.
      method: the method as the caller gave it.
      start: the caller's V at the horizon, or None.
      steps: the number of steps that it took.
    """

    task: March
    method: TimeMethod
    start: Nodes | None
    steps: int


class _Coarse(NamedTuple):
    """A coarser grid and how to march on it, or the reason that there is none for the error of the grid.

    Attributes:
      on: the problem on the coarser grid; None where there is nothing to march.
      longer: the steps over those of the finer march.
      kept: the indices of the kept times that are kept again.
      reason: of no estimate of the error of the grid; empty where there is one.
    """

    on: Discretisation | None
    longer: float
    kept: np.ndarray
    reason: str = ""


def with_march_errors(solution: Solution, marched: Marched, clock: Clock) -> Solution:
    """The solution with ``grid_error`` and ``box_error``, or the reasons that there are none; warns where they matter.

    Args:
      solution: of a march that came to its end, at host level.
      marched: how it was made.
      clock: the limits; nothing is estimated once they are exceeded.
    """
    if clock.over() is not None:
        solution.stats["grid_error"] = solution.stats["box_error"] = OVER
        return solution
    clock.phase = "the estimate of the errors"
    task = marched.task
    held, points = _held(task, np.asarray(solution.times))
    coarse = _coarser(marched, np.asarray(solution.times), held)
    first = None if coarse.on is None else _again(marched, coarse, coarse.on, solution, clock)
    solution = _with_grid_error(solution, marched, coarse, (first, held, points))
    return box_error.reported(solution, _box_error(solution, marched, coarse, first, clock))


def _with_grid_error(
    solution: Solution, marched: Marched, coarse: _Coarse, found: tuple[np.ndarray | None, np.ndarray, bool]
) -> Solution:
    """The solution with an estimate of the error of the spacing and of the step, from V on the coarser grid."""
    first, held, points = found
    if coarse.reason or first is None or coarse.on is None:
        solution.stats["grid_error"] = coarse.reason or UNSETTLED
        return solution
    value, grid = np.asarray(solution.value, float), solution.grid
    horizon, highest = float(marched.task.horizon), _highest(marched.task, points)
    errors = np.zeros_like(value)
    for i, before in zip(coarse.kept, first, strict=True):
        if solution.times[i] < horizon:  # V is prescribed at the horizon
            answers = TwoGrids(grid, coarse.on.grid, value[i], before, held[i % len(held)], highest=highest)
            errors[i] = grid_error.estimate(answers)
    warn_of_grid(errors, value, "nodes and steps")
    for i in np.flatnonzero(solution.times < horizon):
        errors[i] += _left(marched, value[i])
    return dataclasses.replace(solution, grid_error=_at_all_times(errors, coarse.kept))


def _box_error(
    solution: Solution, marched: Marched, coarse: _Coarse, first: np.ndarray | None, clock: Clock
) -> BoxError:
    """The difference between two coarse marches that differ in the ends of the box."""
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
    if found.error is None:
        return found
    errors = np.zeros((len(solution.times), *task.grid.shape))
    errors[coarse.kept] = found.error
    return found._replace(error=_at_all_times(errors, coarse.kept))


def _held(task: March, times: np.ndarray) -> tuple[np.ndarray, bool]:
    """The fixed nodes at each kept time, bool (k, *grid), or once for all; and true if a target is a point."""
    problem, grid = task.problem, task.grid
    if problem.target is None and not grid.prescribed("dirichlet"):
        return np.zeros((1, *grid.shape), bool), False
    on = dataclasses.replace(task.on, mesh=None)
    moments = times if problem.time_dependent else times[:1]
    found = [jax.device_get(_fixed(on.at(jnp.asarray(t, on.dtype)))) for t in moments]
    return np.stack([fixed for fixed, _ in found]), any(grid_error.is_a_point(ended) for _, ended in found)


def _coarser(marched: Marched, times: np.ndarray, held: np.ndarray) -> _Coarse:
    """The coarser grid on which the march is made again."""
    task, everything = marched.task, np.arange(len(times))
    grid, others = task.grid, box_error.other_ends(task.problem, task.grid)
    coarse = nested_grids.telling(grid, np.any(held, axis=0))
    if coarse is None:
        reason = TOO_FEW if nested_grids.telling(grid, np.zeros(grid.shape, bool)) is None else LOSES
    elif min(coarse.shape) < task.on.scheme.points and not task.on.scheme.monotone:
        reason = TOO_FEW
    elif marched.steps <= 1 and not task.method.limited:
        reason = ONE_STEP
    else:
        on = dataclasses.replace(task.on.on_grid(coarse), mesh=None)
        kept = _every_second(times, float(task.horizon), marched.steps)
        return _Coarse(on, _longer(marched, times[kept]), kept)
    if others == grid.edges:
        return _Coarse(None, 1.0, everything, reason)
    smaller = box_error.coarse_for_marches(grid)
    if smaller is None:
        return _Coarse(None, 1.0, everything, reason)
    return _Coarse(dataclasses.replace(task.on.chain.on_grid(smaller), mesh=None), 1.0, everything, reason)


def _every_second(times: np.ndarray, horizon: float, steps: int) -> np.ndarray:
    """The indices of the kept times of the coarse march: all, or every second one from the first on."""
    count = len(times)
    lengths = np.diff([*times, horizon])
    lengths = lengths[lengths > 0]
    if count < 2 or not lengths.size or np.min(lengths) * steps >= FEW * (horizon - times[0]):
        return np.arange(count)
    return np.unique([*range(0, count, 2), *((count - 1,) if times[-1] >= horizon else ())])


def _longer(marched: Marched, times: np.ndarray) -> float:
    """How much longer steps become: two, and three for a few implicit ones, since two thirds of three is no half."""
    horizon = float(marched.task.horizon)
    lengths = np.diff([*times, horizon])
    few = np.min(lengths, where=lengths > 0, initial=horizon) * marched.steps < 3 * FEW * (horizon - times[0])
    return 3.0 if few and not marched.task.method.limited else 2.0


def _again(
    marched: Marched, coarse: _Coarse, on: Discretisation, solution: Solution, clock: Clock
) -> np.ndarray | None:
    """V at the times that are kept again, by a march on a coarser grid; None where it does not come to its end."""
    task, on = marched.task, cast(on, on.dtype)
    start = marched.start
    begin = None if start is None else nested_grids.restrict(np.asarray(start), task.grid, on.grid)
    method = marched.method.filled(on, march_evaluation(on.problem, on.grid))
    longer = coarse.longer > 1
    again = dataclasses.replace(
        task, on=on, method=method, obstacles=None, watched=None, limit=_limit(task, on) if longer else task.limit,
        step=_steps(task, coarse.longer) if longer else task.step, checks_rates=longer and task.checks_rates,
        checks_noise=False, checks_gap=False, checks_cut=False, bare=True,
    )  # fmt: skip
    kept = np.asarray(solution.times, float)[coarse.kept]
    slices, _, code = march_run.drive(again, float(task.horizon), kept, begin, clock.beside())
    return slices.value if code is Status.CONVERGED and np.all(np.isfinite(slices.value)) else None


def _steps(task: March, longer: float) -> jax.Array:
    """Steps that are longer by a factor; those that functions of the time made shorter stay, or would miss these."""
    step = jnp.asarray(task.step)
    if step.ndim == 0:
        return longer * step
    return jnp.where(step < float(task.horizon) / time_probes.PARTS * (1 - 1e-6), step, longer * step)


def _limit(task: March, on: Discretisation) -> Number | None:
    """The longest stable step on a coarser grid; None where it is found before every step.

    Where all spacings grow by r, the rates Q fall by r at least, and no program needs to be compiled to know it.
    """
    if task.limit is None or not task.method.limited or not math.isfinite(float(task.limit)):
        return task.limit
    tableau, beta = task.method.tableau, float(task.problem.discount)
    fine, coarse = task.grid, on.grid
    if task.problem.target is not None or any(a == b for a, b in zip(fine.shape, coarse.shape, strict=True)):
        return _stable(on, tableau, jnp.asarray(task.method.courant, on.dtype))
    ratio, limit, share = nested_grids.ratio_of(fine, coarse), float(task.limit), float(task.method.courant)
    if beta == 0 or len(tableau.means) == 1:
        rate = share / limit  # Q + β, see ``longest_step``
        return jnp.asarray(share / ((rate - beta) / ratio + beta), on.dtype)
    rate = share * beta / math.expm1(beta * limit)
    return jnp.asarray(math.log1p(beta * share / ((rate - beta) / ratio + beta)) / beta, on.dtype)


def _highest(task: March, point: bool) -> float:
    """The largest order that the error may have: the least of the orders of the scheme and of the method."""
    if point:
        return grid_error.LEAST
    first = task.on.scheme.stages == 1 or len(task.method.tableau.means) == 1
    return grid_error.FIRST if first else grid_error.SECOND


def _left(marched: Marched, value: np.ndarray) -> float:
    """What implicit steps leave, and what is missed of functions of the time, cost units."""
    missed = float(marched.task.missed) * float(np.max(np.abs(value)))
    if marched.task.method.limited:
        return missed
    tol = marched.method.tol
    return missed + (TOL * min(1.0, float(np.ptp(value))) if tol is None else float(tol))


def _at_all_times(errors: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Errors at all kept times, (k, *grid): the larger of both neighbours where they are not ``known``."""
    for i in np.setdiff1d(np.arange(len(errors)), known):
        errors[i] = np.max(errors[[j for j in (i - 1, i + 1) if j in known]], axis=0)
    return errors
