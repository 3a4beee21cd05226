"""Inverse optimal control: the parameters of a problem whose optimal closed loops are nearest to observed ones.

The loss is the mean square of the differences of states and controls, each divided by the standard deviation of its
observations, so that units do not matter. Each path is simulated from its first observed state under the optimal
feedback for the parameters, by the classical Runge–Kutta method with equal steps between two observations. An adaptive
integration of all paths would take a minute to compile together with its derivative. A common factor of all costs
changes no trajectory: fix one of the weights.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.calibration.optimisation import Fit, fit
from hjbjax.feedback.path import Path as ClosedLoop
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door
from hjbjax.problem.types import Array
from hjbjax.solution.solution import Solution
from hjbjax.solvers.finite_horizon import march
from hjbjax.solvers.stationary import solve

KEPT = 41  # times at which the feedback of a march is stored
STAGES = ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6))  # time after the step's begin, and weight


class Observations(NamedTuple):
    """Observed closed loops: times (k,), states (paths, k, n) and controls (paths, k, m); NaN if unknown."""

    times: np.ndarray
    states: np.ndarray
    controls: np.ndarray


@front_door
def fit_trajectories(
    problem_of: Callable,
    grid: Grid,
    trajectories: Sequence[Any],
    parameters: Any,
    *,
    horizon: float | None = None,
    solve_options: dict[str, Any] | None = None,
    substeps: int = 4,
    **options: Any,
) -> Fit:
    """Fit the parameters of a problem to observed closed loops: cost weights, masses, or any other numbers.

    Args:
      problem_of: a function of the parameters that returns a Problem with one player, without noise, whose paths do not
        end before the last observation.
      grid: the grid on which the problem is solved for each trial; it must contain the observed states.
      trajectories: one per path: a Path of ``simulate``, or a tuple (times, states, controls) with shapes (k,), (k, n)
        and (k, m). All have the same times. Use NaN for missing observations; the first state of every path is
        required.
      parameters: the initial parameters, as for ``fit``.

    Keyword Args:
      horizon: march over this horizon, in units of time. Default: solve the stationary problem.
      solve_options: keyword arguments of ``solve`` or ``march``. A march requires the length of its steps, ``step``.
      substeps: Runge–Kutta steps between two observations.
      options: keyword arguments of ``fit``: optimiser, steps, bounds, restarts, ...

    Returns:
      A Fit. Its loss is a mean square in units of the variance of the observations: 0.0025 for noise of 5 %.

    Raises:
      ValueError: trajectories of different times or shapes, or outside the grid.
    """
    seen = _observations(trajectories, grid)
    count = arguments.count(substeps, "fit_trajectories: substeps")
    scales = [_spread(values) for values in (seen.states, seen.controls)]
    known = [np.isfinite(values) for values in (seen.states, seen.controls)]
    periods = np.where(np.array(grid.periodic), np.asarray(grid.hi) - np.asarray(grid.lo), np.inf)

    def loss(parameters: Any) -> jax.Array:
        problem = problem_of(parameters)
        if not isinstance(problem, Problem):
            raise TypeError(f"fit_trajectories: problem_of returned {type(problem).__name__}, wanted a Problem")
        if problem.noise is not None or problem.is_game or problem.modes is not None:
            raise ValueError(
                "fit_trajectories: got noise, modes or a game, wanted a deterministic problem of one player"
            )
        given = solve_options or {}
        if horizon is None:
            solution = solve(problem, grid, **given)
        else:
            solution = march(problem, grid, horizon, times=np.linspace(0.0, horizon, KEPT), **given)
        states, controls = _closed_loops(problem, solution, seen, count)
        apart = states - np.nan_to_num(seen.states)
        apart = apart - jnp.where(jnp.isfinite(periods), periods * jnp.round(apart / periods), 0.0)
        total = jnp.sum(jnp.where(known[0], apart / scales[0], 0.0) ** 2)
        total += jnp.sum(jnp.where(known[1], (controls - np.nan_to_num(seen.controls)) / scales[1], 0.0) ** 2)
        return total / sum(int(each.sum()) for each in known)

    return fit(loss, parameters, **options)


def _closed_loops(problem: Problem, solution: Solution, seen: Observations, count: int) -> tuple[jax.Array, jax.Array]:
    """States and controls of all paths at the observed times, shapes (paths, k, n) and (paths, k, m)."""
    marched = solution.times is not None

    def control(t: Array, x: Array) -> Array:
        return solution.control_at(*((jnp.broadcast_to(t, x.shape[:-1]),) if marched else ()), x, clamp=True)

    def rate(t: Array, x: Array) -> Array:
        each = jax.vmap(lambda x, u: jnp.asarray(problem.drift(*problem.arguments(x, u, t=t)), x.dtype))
        return each(x, control(t, x))

    def interval(x: Any, ends: Any) -> Any:
        h = (ends[1] - ends[0]) / count

        def step(x: Any, k: Any) -> Any:
            def stage(carry: Any, row: Any) -> Any:
                slope, total = carry
                ahead = row[0] * h
                slope = rate(ends[0] + k * h + ahead, x + ahead * slope)
                return (slope, total + row[1] * slope), None

            # one loop over the stages compiles the feedback and its derivative once instead of four times
            (_, total), _ = jax.lax.scan(stage, (jnp.zeros_like(x), jnp.zeros_like(x)), jnp.asarray(STAGES, x.dtype))
            return x + h * total, None

        return jax.lax.scan(step, x, jnp.arange(count))[0], x

    times = jnp.asarray(seen.times - seen.times[0])
    last, before = jax.lax.scan(interval, jnp.asarray(seen.states[:, 0]), jnp.stack([times[:-1], times[1:]], axis=1))
    states = jnp.concatenate([before, last[None]])
    return jnp.moveaxis(states, 0, 1), jnp.moveaxis(control(times[:, None], states), 0, 1)


def _observations(trajectories: Sequence[Any], grid: Grid) -> Observations:
    """The observed closed loops as arrays, after checks."""
    rows = []
    for number, each in enumerate(trajectories):
        if isinstance(each, ClosedLoop):
            each = (each.times, each.states, each.controls)
        if not isinstance(each, Sequence) or len(each) != 3:
            raise TypeError(
                f"fit_trajectories: trajectory {number} is a {type(each).__name__}, wanted a Path of simulate or "
                "(times, states, controls)"
            )
        times, states, controls = (np.asarray(part, float) for part in each)
        if len(controls) == len(times) - 1:  # one control per interval
            controls = np.concatenate([controls, np.full((1, *controls.shape[1:]), np.nan)])
        rows.append((times, states, controls))
    if not rows:
        raise ValueError("fit_trajectories: got no trajectories")
    first = rows[0][0]
    for number, (times, states, controls) in enumerate(rows):
        if times.shape != first.shape or not np.allclose(times, first):
            raise ValueError(f"fit_trajectories: trajectory {number} has other times than the first; resample them")
        if states.shape != (len(times), grid.ndim) or controls.ndim != 2 or len(controls) != len(times):
            raise ValueError(
                f"fit_trajectories: trajectory {number} has states of shape {states.shape} and controls of shape "
                f"{controls.shape}; wanted ({len(times)}, {grid.ndim}) and ({len(times)}, m)"
            )
        if not np.all(np.isfinite(states[0])) or np.any(grid.beyond(states[0])):
            raise ValueError(
                f"fit_trajectories: trajectory {number} starts at {states[0].tolist()}, wanted a state in the grid"
            )
    return Observations(first, np.stack([row[1] for row in rows]), np.stack([row[2] for row in rows]))


def _spread(values: np.ndarray) -> np.ndarray:
    """The standard deviation of each entry over all paths and times; 1 for a constant."""
    found = np.nanstd(values, axis=(0, 1)) if np.any(np.isfinite(values)) else np.zeros(values.shape[-1])
    return np.where(found > 0, found, 1.0)
