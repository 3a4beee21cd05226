"""The front door: ``solve``.

At host level it validates, picks a method, drives the iteration from grid to grid and reports. Under a tracer the
same iteration runs with a fixed method and none of that, and its value is differentiable.
"""

import contextlib
import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import checks, iteration, memory, nested, sensitivity, survey
from hjbjax.certificates import Certificate
from hjbjax.driver import Clock, drive
from hjbjax.grid import Grid
from hjbjax.iteration import Method, Nested, PolicyIteration, ValueIteration
from hjbjax.preparation import choose, judge, prepare, prepare_on_host
from hjbjax.problem import Problem
from hjbjax.pytree import altered, is_traced
from hjbjax.report import assemble, describe, finish
from hjbjax.schemes import Limited, Scheme, Upwind
from hjbjax.solution import Solution, SolveError
from hjbjax.status import Status

TRACED_STEPS = 10_000


def solve(
    problem: Problem,
    grid: Grid,
    *,
    method: Method | None = None,
    scheme: Scheme = Upwind(),
    tol: float = 1e-3,
    guess: Any = None,
    dtype: Any = None,
    max_steps: int | None = None,
    time_limit: float | None = None,
    throw: bool = True,
    progress: bool | None = None,
    max_memory: int | None = None,
) -> Solution:
    """Solve a stationary problem on a grid.

    min{ max{ β V − H(x, DV, D²V), V − ψ }, V − g } = 0 for the Kushner–Dupuis chain, to a certified error.

    Args:
      problem: the question.
      grid: the nodes.
      method: ``PolicyIteration(...)`` or ``ValueIteration()``; ``None`` picks by the problem.
      scheme: ``Upwind()``, first order and monotone, or ``Limited()``, second order where the value is smooth.
      tol: bound to reach on |V − V_h|, in cost units, V_h the exact solution on the grid. Where no certificate
        exists the solution says so, and the bound is on the residual and on the last step.
      guess: node values to start from, shape (*grid).
      dtype: ``None`` is float64; ``"float32"`` for memory, with a tolerance that float32 can reach.
      max_steps: at most so many steps.
      time_limit: at most so many seconds.
      throw: raise when the solve does not converge; otherwise the status says it.
      progress: a progress bar; ``None`` shows it on a terminal after one second.
      max_memory: bytes that the solve may take, instead of what is free.

    Returns:
      The solution; NumPy arrays at host level. Inside ``jit``, ``vmap`` or ``grad`` its value is traced, and
      differentiable with respect to every number in the problem and the grid.

    Raises:
      ValueError: a question without an answer, or a bad argument.
      MemoryError: a grid that does not fit, before anything is compiled.
      SolveError: no convergence, with the partial solution as ``.solution``.

    Example:
      >>> import hjbjax as hjb
      >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
      >>> solution = hjb.solve(problem, hjb.Grid([-2.0], [2.0], (81,)))
      >>> solution.status.name, solution.error <= 1e-3
      ('CONVERGED', True)
    """
    check_arguments(problem, grid, method, scheme, tol, max_steps, time_limit)
    if is_traced(problem, grid, guess, tol):
        return _solve_traced(problem, grid, method, scheme, tol, guess, dtype, max_steps)
    kind = as_dtype(dtype)
    check_node_values(guess, grid, "solve: the guess")
    method = method or choose(problem, grid, traced=False)
    clock = Clock(max_steps or 10**9, math.inf if time_limit is None else time_limit, progress)
    with jax.enable_x64(kind == np.float64):
        needed = memory.require(problem, grid, method, kind, max_memory)
        checks.shapes(problem, grid, scheme)
        survey.values(problem, grid, kind)
        known = None if guess is None else jnp.asarray(guess, kind)
        start, shapes = nested.start(problem, grid, method, scheme.chain, tol, known, kind, clock)
        inner = method.inner if isinstance(method, Nested) else method
        task, verdict, reached = prepare_on_host(problem, grid, method=inner, scheme=scheme.chain, tol=tol, dtype=kind)
        state, code, residuals = drive(task, nested.warm(task, start, clock), clock)
        if isinstance(scheme, Limited):
            monotone = state.value
            verdict = dataclasses.replace(verdict, certificate=Certificate.RESIDUAL)
            task = dataclasses.replace(task, certificate=Certificate.RESIDUAL, scheme=scheme)
            state, code, residuals = drive(task, monotone, clock)
        solution = finish(task, state, code, reached, residuals, verdict, grid)
        if isinstance(scheme, Limited):
            counted = np.asarray(task.counted)
            apart = np.abs(np.asarray(state.value)[counted] - np.asarray(monotone)[counted])
            solution.stats["from_monotone"] = float(np.max(apart, initial=0))
    solution.stats.update(
        method=describe(method, problem), levels=[*shapes, grid.shape], seconds=clock.stepping,
        compile_seconds=clock.elapsed() - clock.stepping, bytes=needed, tol=tol,
    )  # fmt: skip
    if throw and code is not Status.CONVERGED:
        raise SolveError(f"{code.name}: {solution.message}", solution)
    return solution


def _solve_traced(
    problem: Problem, grid: Grid, method: Any, scheme: Any, tol: Any, guess: Any, dtype: Any, max_steps: Any
) -> Solution:
    """The same iteration inside a JAX transformation: no chunks, no files, no exceptions, no checks of values."""
    if isinstance(scheme, Limited):
        raise ValueError("solve: Limited() runs at host level only; inside jit, vmap and grad use Upwind()")
    kind = jnp.result_type(float) if dtype is None else jnp.dtype(dtype)
    verdict = judge(problem, grid, kind)
    method = method or choose(problem, grid, traced=True)
    if isinstance(method, Nested):
        raise ValueError("solve: Nested(...) runs at host level only; inside jit, vmap and grad use its inner method")
    task = prepare(problem, grid, method=method, scheme=scheme, tol=tol, dtype=kind, verdict=verdict)
    start = jnp.zeros(grid.shape, kind) if guess is None else jnp.asarray(guess, kind)
    frozen, start = jax.lax.stop_gradient((task, start))
    state = iteration.run(frozen, iteration.begin(frozen, start), max_steps or TRACED_STEPS)
    return altered(assemble(task, state, verdict), value=sensitivity.attach(task, state))


def as_dtype(dtype: Any) -> np.dtype:
    """The floating-point type that a user asked for; None is float64."""
    for kind in (np.dtype(np.float64), np.dtype(np.float32)):
        with contextlib.suppress(TypeError):
            if kind == (np.float64 if dtype is None else np.dtype(dtype)):
                return kind
    raise ValueError(f"dtype: got {dtype!r}, wanted 'float64' or 'float32'")


def check_arguments(
    problem: Any, grid: Any, method: Any, scheme: Any, tol: Any, max_steps: Any, time_limit: Any
) -> None:
    """Refuse what no solve can start with; needs no values of the problem's functions."""
    if not isinstance(problem, Problem) or not isinstance(grid, Grid):
        raise TypeError(f"solve: got {type(problem).__name__}, {type(grid).__name__}; wanted a Problem and a Grid")
    if method is not None and not isinstance(method, (ValueIteration, PolicyIteration, Nested)):
        raise TypeError(f"solve: method is {method!r}; wanted hjb.PolicyIteration(...) or hjb.ValueIteration()")
    if not isinstance(scheme, (Upwind, Limited)):
        raise TypeError(f"solve: scheme is {scheme!r}; wanted hjb.Upwind(...) or hjb.Limited()")
    if not is_traced(tol) and not _is_positive(tol):
        raise ValueError(f"solve: tol = {tol!r}; wanted a finite number > 0, in the units of the cost")
    if max_steps is not None and (isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1):
        raise ValueError(f"solve: max_steps = {max_steps!r}; wanted a positive integer")
    if time_limit is not None and not (_is_positive(time_limit) or time_limit == math.inf):
        raise ValueError(f"solve: time_limit = {time_limit!r}; wanted seconds > 0")
    if problem.terminal_cost is not None:
        raise ValueError("solve: a terminal_cost belongs to a finite horizon; a stationary problem has none")
    if problem.time_dependent:
        raise ValueError("solve: a time-dependent problem has no stationary value; it needs a finite horizon")


def _is_positive(number: Any) -> bool:
    return isinstance(number, (int, float, np.number)) and math.isfinite(number) and bool(number > 0)


def check_node_values(values: Any, grid: Grid, name: str) -> None:
    """Refuse what cannot be a value at the nodes; None is none."""
    if values is None:
        return
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} holds {array.dtype}; wanted real node values of shape {grid.shape}")
    if array.shape != grid.shape:
        hint = "; it looks transposed" if array.shape == grid.shape[::-1] else ""
        raise ValueError(f"{name} has shape {array.shape}, the grid {grid.shape}{hint}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} is NaN or infinite at {int(np.sum(~np.isfinite(array)))} nodes")
