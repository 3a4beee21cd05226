"""Design: the parameters of a system that make a criterion of its value least."""

from collections.abc import Callable
from typing import Any

import jax

from hjbjax.calibration.optimisation import Fit, fit
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import front_door
from hjbjax.solvers.finite_horizon import march
from hjbjax.solvers.stationary import solve
from hjbjax.tracing.closures import refuse_traced


@front_door
def design(
    problem_of: Callable,
    grid: Grid,
    criterion: Callable,
    parameters: Any,
    *,
    horizon: float | None = None,
    solve_options: dict[str, Any] | None = None,
    **options: Any,
) -> Fit:
    """Find the parameters of a system for which a criterion of its optimal value is least.

    Args:
      problem_of: a function of the parameters that returns a Problem.
      grid: the grid on which the problem is solved for each trial.
      criterion: a function of the Solution and of the parameters that returns a number, such as the value at a start
        plus the price of the parameters.
      parameters: the initial parameters, as for ``fit``.

    Keyword Args:
      horizon: march over this horizon, in units of time. Default: solve the stationary problem.
      solve_options: keyword arguments of ``solve`` or ``march``.
      options: keyword arguments of ``fit``: optimiser, steps, bounds, restarts, ...

    Returns:
      A Fit.
    """

    refuse_traced("design", problem_of, criterion, parameters)

    def loss(parameters: Any) -> jax.Array:
        given = solve_options or {}
        problem = problem_of(parameters)
        solution = solve(problem, grid, **given) if horizon is None else march(problem, grid, horizon, **given)
        return criterion(solution, parameters)

    return fit(loss, parameters, **options)
