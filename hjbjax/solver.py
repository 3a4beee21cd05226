"""The front door: ``solve``.

At host level it validates, picks a method, and calls the jitted loop in chunks of about a fifth of a second;
progress, Ctrl-C, time limits and stops at NaN all live between two chunks. Under a tracer the same iteration
runs with a fixed method and none of that, and its value is differentiable.
"""

import contextlib
import dataclasses
import itertools
import math
import sys
import time
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import certificates, checks, hamiltonian, iteration, memory, sensitivity, transfer
from hjbjax.certificates import Certificate
from hjbjax.grid import Grid
from hjbjax.iteration import HISTORY, Method, Nested, PolicyIteration, State, Task, ValueIteration
from hjbjax.preparation import SolveWarning, Verdict, choose, judge, levels, prepare, prepare_jit, prepare_on_host
from hjbjax.problem import Problem
from hjbjax.pytree import is_traced
from hjbjax.schemes import Upwind
from hjbjax.sets import Finite
from hjbjax.solution import Solution, SolveError
from hjbjax.status import Status

CHUNK_SECONDS = 0.2
TRACED_STEPS = 10_000
VANISHING = (1.0, 0.1, 0.01)  # discounts on the way to none, per unit time
WARM_STEPS = 60  # improvements for each of them

_run = jax.jit(iteration.run)


def solve(
    problem: Problem,
    grid: Grid,
    *,
    method: Method | None = None,
    scheme: Upwind = Upwind(),
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
      scheme: the discretisation.
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
    _check_guess(guess, grid)
    method = method or choose(problem, grid, traced=False)
    clock = _Clock(max_steps or 10**9, math.inf if time_limit is None else time_limit, progress)
    with jax.enable_x64(kind == np.float64):
        needed = memory.require(problem, grid, method, kind, max_memory)
        checks.shapes(problem, grid, scheme)
        checks.values(problem, grid, scheme, kind)
        guess, coarse = _coarse_answer(problem, grid, method, scheme, tol, guess, kind, clock)
        inner = method.inner if isinstance(method, Nested) else method
        task, verdict, reached = prepare_on_host(problem, grid, method=inner, scheme=scheme, tol=tol, dtype=kind)
        state, code, residuals = _drive(task, guess if coarse else _warm(task, guess, clock), clock)
        solution = finish(task, state, code, reached, residuals, verdict, grid)
    solution.stats.update(
        method=repr(method), levels=[*coarse, grid.shape], seconds=clock.elapsed() - clock.compiling,
        compile_seconds=clock.compiling, bytes=needed, tol=tol,
    )  # fmt: skip
    if throw and code is not Status.CONVERGED:
        raise SolveError(f"{code.name}: {solution.message}", solution)
    return solution


class _Clock:
    """The limits of a solve and the time it has taken, compiling apart."""

    def __init__(self, max_steps: int, seconds: float, progress: bool | None):
        self.max_steps, self.seconds, self.progress = max_steps, seconds, progress
        self.began, self.compiling = time.perf_counter(), 0.0

    def elapsed(self) -> float:
        return time.perf_counter() - self.began


def _coarse_answer(
    problem: Problem, grid: Grid, method: Method, scheme: Upwind, tol: float, guess: Any, kind: Any, clock: _Clock
) -> tuple[Any, list]:
    """The guess for the finest grid: the user's, or the answer of the coarser grids, and the shapes of those."""
    if guess is not None or not isinstance(method, Nested):
        return None if guess is None else jnp.asarray(guess, kind), []
    grids = levels(problem, grid, method, scheme, kind)
    value = None
    for coarse, fine in itertools.pairwise(grids):
        verdict = judge(problem, coarse, kind)
        task = prepare_jit(problem, coarse, method=method.inner, scheme=scheme, tol=tol, dtype=kind, verdict=verdict)
        state, _, _ = _drive(task, _warm(task, None, clock) if value is None else value, clock)
        value = transfer.prolong(state.value, coarse, fine)
    return value, [coarse.shape for coarse in grids[:-1]]


def _warm(task: Task, guess: Any, clock: _Clock) -> jax.Array:
    """The guess; without one zero, or without discount the answers for a discount that vanishes.

    From below an undiscounted problem is full of policies that stay where they are at a cost; those of a small
    discount move to the target.
    """
    zero = jnp.zeros(task.grid.shape, task.tol.dtype) if guess is None else guess
    if guess is not None or task.certificate is not Certificate.MULTIPLICATIVE:
        return zero
    for discount in VANISHING:
        problem = dataclasses.replace(task.problem, discount=jnp.asarray(discount, task.tol.dtype))
        softened = dataclasses.replace(task, problem=problem)
        zero = _run(softened, iteration.begin(softened, zero), WARM_STEPS).value
    return zero


def _drive(task: Task, guess: jax.Array, clock: _Clock) -> tuple[State, Status, np.ndarray]:
    """The host's loop: chunks of steps until the state stops running, the steps or the time run out, or Ctrl-C."""
    compiling = time.perf_counter()
    state = jax.block_until_ready(_run(task, iteration.begin(task, guess), 0))  # compiles, and looks at the guess
    clock.compiling += time.perf_counter() - compiling
    residuals, chunk, code = [np.asarray(state.history[:1])], 1, Status(int(state.code))
    with _bar(clock.progress, float(task.tol)) as show:
        try:
            while code is Status.RUNNING:
                done, began = int(state.step), time.perf_counter()
                if done >= clock.max_steps or clock.elapsed() >= clock.seconds:
                    code = Status.MAX_STEPS if done >= clock.max_steps else Status.TIME_LIMIT
                    break
                state = jax.block_until_ready(_run(task, state, int(min(done + chunk, clock.max_steps))))
                took = time.perf_counter() - began
                code, steps = Status(int(state.code)), int(state.step) - done
                residuals.append(np.asarray(state.history[:steps]))
                chunk = int(np.clip(chunk * CHUNK_SECONDS / max(took, 1e-4), 1, min(HISTORY, 8 * chunk)))
                show(steps, float(state.gap.error))
        except KeyboardInterrupt:
            code = Status.INTERRUPTED
    return state, code, np.concatenate(residuals)


@contextlib.contextmanager
def _bar(progress: bool | None, tol: float) -> Any:
    """A progress bar on a terminal after one second; silent elsewhere."""
    if progress is False or (progress is None and not sys.stderr.isatty()):
        yield lambda steps, error: None
        return
    from tqdm import tqdm

    with tqdm(desc="solve", unit=" steps", delay=1, leave=False) as bar:

        def show(steps, error):
            bar.update(steps)
            bar.set_postfix_str(f"error {error:.2e}, tol {tol:.0e}", refresh=False)

        yield show


def finish(
    task: Task,
    state: State,
    code: Status,
    reached: np.ndarray | None,
    residuals: np.ndarray,
    verdict: Verdict,
    grid: Grid,
) -> Solution:
    """The solution in NumPy, with infinite values where the target cannot be reached and no policy where none is."""
    solution = assemble(task, state, verdict)
    gap = _isaacs_gap(task, state)
    lost = ~np.asarray(task.counted)
    arrays = {name: getattr(solution, name) for name in ("value", "lower", "upper", "policy", "disturbance")}
    arrays = {name: None if array is None else np.array(array) for name, array in arrays.items()}
    for array in (arrays["value"], arrays["lower"], arrays["upper"]):
        if array is not None:
            array[lost] = np.inf
    idle = lost if task.problem.target is None else lost | (np.asarray(task.rules.held) & ~_rests(task))
    for array in (arrays["policy"], arrays["disturbance"]):
        if array is not None:
            array[idle] = np.nan
    return Solution(
        **arrays,
        grid=grid,
        code=int(code),
        steps=int(state.step),
        isaacs_gap=gap,
        reached=reached,
        discrete=solution.discrete,
        discrete_disturbance=solution.discrete_disturbance,
        residuals=residuals,
        message=_message(code, task, state, residuals),
        stats={
            "scheme": repr(task.scheme),
            "device": str(jax.devices()[0].device_kind),
            "dtype": str(state.value.dtype),
            "certificate": verdict.sentence,
            "versions": {"jax": jax.__version__, "numpy": np.__version__},
        },
    )


def _rests(task: Task) -> np.ndarray:
    """Held nodes that are no target: rest points, where the policy keeps its meaning."""
    if task.problem.target is None:
        return np.asarray(task.rules.held)
    rules = iteration.bellman.conditions(task.problem, task.grid, task.tol.dtype)
    return np.asarray(task.rules.held & ~rules.held)


def assemble(task: Task, state: State, verdict: Verdict) -> Solution:
    """The solution as it stands in the state; pure."""
    problem = task.problem
    bounds = certificates.bounds(verdict.certificate, state.value, state.gap)
    lower, upper = bounds if bounds is not None else (None, None)
    controls, disturbances = state.policy.controls, state.policy.disturbances
    return Solution(
        value=state.value,
        policy=jnp.stack(controls, axis=-1) if controls else jnp.zeros((*task.grid.shape, 0), state.value.dtype),
        disturbance=jnp.stack(disturbances, axis=-1) if problem.is_game else None,
        code=state.code,
        steps=state.step,
        lower=lower,
        upper=upper,
        grid=task.grid,
        discrete=isinstance(problem.controls, Finite),
        discrete_disturbance=isinstance(problem.disturbances, Finite),
    )


@jax.jit
def _gap_at(task: Task, value: jax.Array) -> tuple[jax.Array, jax.Array]:
    """max over the nodes of min max − max min, and the size of H, at one value function."""
    how = hamiltonian.setting(task.problem, task.grid.ndim, value.dtype)
    here = hamiltonian.local(task.problem, task.grid, value, scheme=task.scheme)
    upper = hamiltonian.optimise(here, how, isaacs="upper")[0]
    lower = hamiltonian.optimise(here, how, isaacs="lower")[0]
    free = task.counted & ~task.rules.held
    size = jnp.maximum(jnp.abs(upper), jnp.abs(lower))
    return jnp.max(jnp.where(free, upper - lower, 0)), jnp.max(jnp.where(free, size, 0))


def _isaacs_gap(task: Task, state: State) -> float | None:
    if not task.problem.is_game:
        return None
    gap, size = (float(number) for number in _gap_at(task, state.value))
    if gap > 0.05 * size:
        warnings.warn(
            f"the Isaacs condition fails: min max and max min of the Hamiltonian differ by up to {gap:.3g} per unit "
            f"time; the value is the {task.problem.isaacs} one, isaacs= gives the other",
            SolveWarning,
            stacklevel=4,
        )
    return gap


def _message(code: Status, task: Task, state: State, residuals: np.ndarray) -> str:
    best, tol = float(state.best[0]), float(task.tol)
    if code is Status.STALLED:
        return f"{code.message} The smallest error was {best:.2g}: a tolerance of {2 * best:.2g} is within reach."
    if code is Status.CONVERGED and task.certificate is Certificate.NONE:
        return f"Residual and last step are at most {tol:.2g}; no certificate bounds the error."
    return code.message


def _solve_traced(
    problem: Problem, grid: Grid, method: Any, scheme: Upwind, tol: Any, guess: Any, dtype: Any, max_steps: Any
) -> Solution:
    """The same iteration inside a JAX transformation: no chunks, no files, no exceptions, no checks of values."""
    kind = jnp.result_type(float) if dtype is None else jnp.dtype(dtype)
    verdict = judge(problem, grid, kind)
    method = method or choose(problem, grid, traced=True)
    task = prepare(problem, grid, method=method, scheme=scheme, tol=tol, dtype=kind, verdict=verdict)
    start = jnp.zeros(grid.shape, kind) if guess is None else jnp.asarray(guess, kind)
    frozen, start = jax.lax.stop_gradient((task, start))
    state = iteration.run(frozen, iteration.begin(frozen, start), max_steps or TRACED_STEPS)
    solution = assemble(task, state, verdict)
    object.__setattr__(solution, "value", sensitivity.attach(task, state))
    return solution


def as_dtype(dtype: Any) -> np.dtype:
    """The floating-point type that a user asked for; None is float64."""
    kind = np.dtype(np.float64 if dtype is None else dtype)
    if kind not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise ValueError(f"dtype: got {dtype!r}, wanted 'float64' or 'float32'")
    return kind


def check_arguments(
    problem: Any, grid: Any, method: Any, scheme: Any, tol: Any, max_steps: Any, time_limit: Any
) -> None:
    """Refuse what no solve can start with; needs no values of the problem's functions."""
    if not isinstance(problem, Problem) or not isinstance(grid, Grid):
        raise TypeError(f"solve: got {type(problem).__name__}, {type(grid).__name__}; wanted a Problem and a Grid")
    if method is not None and not isinstance(method, (ValueIteration, PolicyIteration, Nested)):
        raise TypeError(f"solve: method is {method!r}; wanted hjb.PolicyIteration(...) or hjb.ValueIteration()")
    if not isinstance(scheme, Upwind):
        raise TypeError(f"solve: scheme is {scheme!r}; wanted hjb.Upwind(...)")
    if not is_traced(tol) and not (np.ndim(tol) == 0 and math.isfinite(tol) and tol > 0):
        raise ValueError(f"solve: tol = {tol!r}; wanted a finite number > 0, in the units of the cost")
    if max_steps is not None and (isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1):
        raise ValueError(f"solve: max_steps = {max_steps!r}; wanted a positive integer")
    if time_limit is not None and not (time_limit > 0):
        raise ValueError(f"solve: time_limit = {time_limit!r}; wanted seconds > 0")
    if problem.terminal_cost is not None:
        raise ValueError("solve: a terminal_cost belongs to a finite horizon; a stationary problem has none")
    if problem.time_dependent:
        raise ValueError("solve: a time-dependent problem has no stationary value; it needs a finite horizon")


def _check_guess(guess: Any, grid: Grid) -> None:
    if guess is None:
        return
    values = np.asarray(guess)
    if values.shape != grid.shape:
        hint = "; it looks transposed" if values.shape == grid.shape[::-1] else ""
        raise ValueError(f"solve: the guess has shape {values.shape}, the grid {grid.shape}{hint}")
    if not np.all(np.isfinite(values)):
        raise ValueError(f"solve: the guess is NaN or infinite at {int(np.sum(~np.isfinite(values)))} nodes")
