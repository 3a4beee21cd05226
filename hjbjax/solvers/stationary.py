"""The front door: ``solve``.

At host level it validates, picks a method, drives the iteration from grid to grid and reports. Under a tracer the
same iteration runs with a fixed method and none of that, and its value and its policy are differentiable.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation import schemes
from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.schemes import Upwind
from hjbjax.discretisation.semi_lagrangian import PathScheme
from hjbjax.iteration import adjoint, fixed_point
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.iteration.methods import Method, check_method
from hjbjax.markov_chain import admissibility, memory, node_checks, resting
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.parts import spans_processes
from hjbjax.problem.problem import Problem, is_constrained, is_discounted
from hjbjax.problem.pytree import altered, as_one_program, is_traced
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import DType, Nodes, Number, Scalar
from hjbjax.solution import checkpoints, nested_grids
from hjbjax.solution.checkpoints import Checkpoint
from hjbjax.solution.clock import Clock, Stopped, noting_interrupts
from hjbjax.solution.placement import Path
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status
from hjbjax.solvers import host_loop, nested, semi_lagrangian
from hjbjax.solvers.box_error import with_box_error
from hjbjax.solvers.result import assemble, finish, solution_at_start, with_grid_error, with_last_phase
from hjbjax.solvers.setup import (
    COARSEST,
    Assumptions,
    check_on_one_state,
    choose,
    choose_scheme,
    choose_traced_scheme,
    prepare_on_host,
    prepare_traced,
)
from hjbjax.tracing import checks
from hjbjax.tracing.closures import with_settled_functions

# no host looks on inside a transformation: far more steps than policy iteration takes, and an end for all others
TRACED_STEPS = 10_000


@with_settled_functions
def solve(
    problem: Problem,
    grid: Grid,
    *,
    method: Method | None = None,
    scheme: Scheme | PathScheme | None = None,
    tol: float = 1e-3,
    guess: Nodes | None = None,
    dtype: DType | None = None,
    max_steps: int | None = None,
    time_limit: float | None = None,
    throw: bool = True,
    progress: bool | None = None,
    max_memory: int | None = None,
    checkpoint: Path | Checkpoint | None = None,
    resume: bool = False,
    mesh: Mesh | None = None,
) -> Solution:
    """Solve a stationary problem on a grid.

    min{ max{ β V − H(x, DV, D²V), V − ψ }, V − g } = 0 for the Kushner–Dupuis chain, to a certified error.

    Args:
      problem: the question.
      grid: the nodes.
      method: ``PolicyIteration(...)`` or ``ValueIteration()``; ``None`` picks by the problem.
      scheme: ``Upwind()``, first order and monotone; ``Limited()``, second order where the value is smooth; or
        ``Weno5()``, fifth order there, on equal spacings, for a ``tol`` as small as its error; or ``SemiLagrangian()``,
        monotone, for deterministic problems whose optimal paths run along kinks of the value. ``None`` is
        ``Limited()`` where its iteration converges, with an estimate of the grid's error. It is ``Upwind()`` for value
        iteration and tubes without discount, and wherever noise lets central differences be monotone.
      tol: bound to reach on |V − V_h|, in cost units, V_h the exact solution on the grid of the monotone scheme. Where
        no certificate exists the solution says so, and the bound is on the residual and on the last step, as it is for
        the high-order equation; a tube without discount goes on until V no longer changes.
      guess: node values to start from, shape (*grid); not for a tube without discount, which has many fixed points.
      dtype: ``None`` is float64, inside a transformation that of ``float`` there; ``"float32"`` for memory, with a
        tolerance that float32 can reach.
      max_steps: at most so many steps, by each scheme and on each grid.
      time_limit: at most so many seconds, checks and compilation included; what cannot be cut, as one compilation or
        one step, is let come to its end.
      throw: raise when the solve does not converge; otherwise the status says it.
      progress: say each phase as it begins, and show a bar of the steps after a second; ``None``: on a terminal.
      max_memory: bytes that the solve may take, instead of what is free.
      checkpoint: a file for the state of the run, written every minute and at the end, or ``Checkpoint(path, every=)``.
      resume: go on from that file if it is there, to the same bits; host level.
      mesh: divide the nodes over its devices, its i-th axis those along the i-th axis of the grid, as in
        ``jax.make_mesh((4, 2), ("a", "b"))``; host level.

    Returns:
      The solution; NumPy arrays at host level. Inside ``jit``, ``vmap`` or ``grad`` its value and its policy are
      traced, and differentiable with respect to every number in the problem and the grid; a derivative whose linear
      solve does not come to its end is NaN. There a second-order iteration that does not converge leaves the monotone
      answer, and its own code.

    Raises:
      ValueError: a question without an answer, or a bad argument.
      MemoryError: a grid that does not fit, before anything is compiled.
      FileExistsError: the checkpoint exists, without ``resume``.
      FileError: the checkpoint belongs to another question, is in use by another run, or cannot be written.
      SolveError: no convergence, be it by Ctrl-C, with the partial solution as ``.solution``.

    Example:
      >>> import hjbjax as hjb
      >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
      >>> solution = hjb.solve(problem, hjb.Grid([-2.0], [2.0], (81,)))
      >>> solution.status.name, solution.monotone_error <= 1e-3, bool(solution.grid_error.max() <= 1e-3)
      ('CONVERGED', True, True)
    """
    check_limits(max_steps, time_limit)
    check_arguments(problem, grid, method, scheme, tol, guess, paths=True)
    grid.check_indices()  # inside transformations as well, where nobody asks for the memory
    traced, free = is_traced(problem, grid, guess, tol), method is None
    if mesh is not None:
        known = choose(problem, grid, traced=traced, method=method, divided=True)
        mesh = checks.over_devices(mesh, "solve", problem, grid, *filter(None, [scheme]), known, traced=traced)
    if traced:
        if isinstance(scheme, PathScheme):
            raise ValueError(_at_host_level(scheme))
        scheme, sharpen = scheme or choose_traced_scheme(problem, method), scheme is None
        on = Discretisation(problem, grid, scheme, arguments.traced_dtype(dtype, "solve"))
        return _solve_traced(on, method, tol, guess, max_steps, sharpen=sharpen)
    kind = arguments.as_dtype(dtype)
    check_node_values(guess, grid, "solve: the guess")
    grid.check_spacings(kind)
    clock = Clock(max_steps or 10**9, time_limit, progress, together=spans_processes(mesh))
    opened = checkpoints.open_checkpoint(
        checkpoint, [problem], grid, resume=resume, caller="solve", together=clock.together, method=method,
        scheme=scheme, tol=tol, guess=guess, dtype=kind,
    )  # fmt: skip
    if isinstance(scheme, PathScheme):
        with noting_interrupts(clock), host_loop.telling(clock), own_settings(x64=kind == np.float64), opened as kept:
            clock.journal = kept and kept.journal()
            options: Any = {"method": method, "tol": tol, "guess": guess, "max_memory": max_memory}
            solution = semi_lagrangian.solve_on_host(problem, grid, scheme, kind, clock=clock, **options)
        return _ended(with_last_phase(solution, clock), clock, tol, throw=throw)
    method = choose(problem, grid, traced=False, method=method, divided=mesh is not None)
    on, sharpen = Discretisation(problem, grid, scheme or Upwind(subcell=True), kind, mesh=mesh), scheme is None
    # float64 for this call alone: another thread, and the caller's own programs, keep theirs
    with noting_interrupts(clock), host_loop.telling(clock), own_settings(x64=kind == np.float64), opened as kept:
        clock.journal = kept and kept.journal()
        check_on_one_state(problem, grid, on.scheme)  # before the memory, for which functions may be read
        needed = memory.require(problem, grid, method, kind, max_memory)
        with host_loop.with_solution(clock, needed, lambda kept: _partial(on, kept)):
            solution = with_last_phase(solve_on_host(on, method, tol, guess, clock, sharpen=sharpen, free=free), clock)
    solution.stats.setdefault("method", method.described(problem.is_game))
    solution.stats.update(bytes=needed, **({} if mesh is None else {"mesh": mesh.devices.shape}))
    return _ended(solution, clock, tol, throw=throw)


def _ended(solution: Solution, clock: Clock, tol: float, *, throw: bool) -> Solution:
    """The solution with its times; raises ``SolveError`` where it did not converge and that was asked for."""
    solution.stats.update(
        seconds=clock.stepping, compile_seconds=clock.elapsed() - clock.stepping,
        tol=tol, **({} if clock.journal is None else {"checkpoint": clock.journal.file.outcome}),
    )  # fmt: skip
    if throw and solution.status is not Status.CONVERGED:
        raise SolveError(f"{solution.status.name}: {solution.message}", solution)
    return solution


def _partial(on: Discretisation, kept: host_loop.Kept | None) -> Solution:
    """The solution of a run that broke, from the value that outlived it, maybe on a coarser grid; else zero."""
    if kept is None:
        value = np.broadcast_to(np.zeros((), on.dtype), on.grid.shape)  # one zero seen everywhere takes no memory
    else:
        value, grid = kept
        value = value if grid.shape == on.grid.shape else nested_grids.prolong(value, grid, on.grid)
    return solution_at_start(on, value, Status.INTERRUPTED)


def solve_on_host(
    on: Discretisation, method: Method, tol: float, guess: Nodes | None, clock: Clock, *, sharpen: bool, free: bool
) -> Solution:
    """The solution by checks of nodes, preparation, coarser grids and steps, in this order, as the clock allows.

    ``sharpen``: by the scheme that suits the problem, with an estimate of the grid's error. ``free``: nobody asked for
    the method.
    """
    problem, grid = on.problem, on.grid
    start: Nodes | None = None if guess is None else np.asarray(guess, on.dtype)
    try:
        # from cheap to dear: all nodes, the ends of the box, and only then what is compiled for the grid
        node_checks.values(on, clock)
        admissibility.values(problem, grid, on.dtype)
        if sharpen:
            on = dataclasses.replace(on, scheme=choose_scheme(on, method))
            sharpen = on.scheme.subcell  # value iteration and tubes start from nowhere else, on a coarser grid neither
        task, assumptions, reached = prepare_on_host(on.chain, method=method.inner, tol=tol, clock=clock)
    except Stopped as stop:
        return solution_at_start(on, np.zeros(grid.shape) if start is None else np.array(start), stop.status)
    asked_again = sharpen and free and grid.size > COARSEST and not grid.sides("open")
    start, shapes = nested.start(task, on.scheme, method, start, clock, asked_again=asked_again)
    settled = nested.settle(nested.staged(task, on.scheme), assumptions, reached, start, clock)
    about: dict[str, Any] = {"levels": [*shapes, grid.shape]}
    if not on.scheme.monotone and (settled.code is Status.CONVERGED or not sharpen):
        settled = nested.better_of(settled, nested.second_order(settled, on.scheme, clock), clock, sharpen=sharpen)
    settled = nested.plainly(settled)
    solution = finish(settled, grid)
    if sharpen and solution.status is Status.CONVERGED:
        solution = with_grid_error(solution, settled, nested.coarser_answer(settled, clock))
    if solution.status is Status.CONVERGED:
        solution = with_box_error(solution, settled, clock)
    if type(settled.task.method.evaluation) is not type(method.evaluation):
        about["method"] = settled.task.method.described(problem.is_game)
    solution.stats.update(about)
    return solution


@as_one_program
def _solve_traced(
    on: Discretisation, method: Method | None, tol: Number, guess: Nodes | None, max_steps: int | None, *, sharpen: bool
) -> Solution:
    """The solution inside a JAX transformation: no chunks, no files, no exceptions, no checks of values.

    ``sharpen``: nobody asked for the scheme, and the monotone answer stands where another one is not found.
    """
    method = choose(on.problem, on.grid, traced=True, method=method)
    if method.coarsest is not None:
        raise ValueError("solve: Nested(...) runs at host level only; inside jit, vmap and grad use its inner method")
    task, assumptions = prepare_traced(on.chain, method=method, tol=tol)
    # the derivative is that of the fixed point, by the implicit function theorem, and not of the steps that led there
    frozen, most = jax.lax.stop_gradient(task), max_steps or TRACED_STEPS
    start = frozen.start() if guess is None else jax.lax.stop_gradient(jnp.asarray(guess, on.dtype))
    state = fixed_point.run(frozen, fixed_point.begin(frozen, start), most)
    wrong = jnp.zeros((), bool)
    if assumptions.may_rest:
        state, wrong = _without_rests_to_leave(frozen, state)
    solution = _differentiable(task, state, assumptions)
    if not on.scheme.monotone:
        further, assumptions = nested.raised(task, assumptions, on.scheme)
        known = jax.lax.stop_gradient(further)
        state = fixed_point.run(known, fixed_point.begin(known, state.value), most)
        sharp = dataclasses.replace(_differentiable(further, state, assumptions), monotone_error=solution.error)
        solution = _better_of(solution, sharp) if sharpen else sharp
    wrong |= solution.code == Status.NONFINITE
    value = solution.value * jnp.where(wrong, jnp.nan, 1).astype(on.dtype)  # a derivative drops the code: NaN, too
    return altered(solution, value=jnp.where(task.counted, value, jnp.inf) if task.has_lost else value)


def _differentiable(task: Task, state: State, assumptions: Assumptions) -> Solution:
    """The solution of a state, whose value and policy are functions of the numbers in the task."""
    value = adjoint.attach(task, state)
    return altered(assemble(task, adjoint.attach_policy(task, state, value), assumptions), value=value)


def _better_of(plain: Solution, sharp: Solution) -> Solution:
    """The answer of second order; where its iteration did not converge the monotone one, with the code of what failed.

    The host says it in the message, which does not leave a transformation.
    """
    started = plain.code == Status.CONVERGED
    found = started & (sharp.code == Status.CONVERGED)
    names = ("value", "policy", "disturbance", "steps")
    chosen = {
        name: jax.tree.map(functools.partial(jnp.where, found), getattr(sharp, name), getattr(plain, name))
        for name in names
    }
    return altered(sharp, **chosen, code=jnp.where(started, sharp.code, plain.code))


def _at_host_level(scheme: object) -> str:
    """The refusal of a scheme inside a transformation."""
    return f"solve: {type(scheme).__name__}() runs at host level only; inside jit, vmap and grad use Upwind()"


def _without_rests_to_leave(task: Task, state: State) -> tuple[State, Scalar]:
    """The state and a flag: stalled, without bounds, where it pays to leave a held rest node; only the host goes on."""
    pays = resting.leaving_pays(task.on.chain, task.obstacles, task.counted, state.value)
    # under a discount, which may be traced, no node was held for being at rest
    wrong = jnp.any(pays) & (state.code == Status.CONVERGED) & (task.problem.discount == 0)
    gap, infinite = state.bound, jnp.asarray(jnp.inf, state.value.dtype)
    gap = dataclasses.replace(
        gap, below=jnp.where(wrong, 0, gap.below), above=jnp.where(wrong, infinite, gap.above),
        lift=jnp.where(wrong, infinite, gap.lift), error=jnp.where(wrong, infinite, gap.error),
    )  # fmt: skip
    code = jnp.where(wrong, Status.STALLED, state.code).astype(state.code.dtype)
    return dataclasses.replace(state, bound=gap, code=code), wrong


def check_limits(max_steps: object, time_limit: object) -> None:
    """Refuse a number of steps or of seconds that limits no run."""
    if max_steps is not None:
        arguments.count(max_steps, "solve: max_steps")
    if time_limit is not None:
        arguments.positive(time_limit, "solve: time_limit", "in seconds", endless=True)


def check_arguments(
    problem: object, grid: object, method: object, scheme: object, tol: object, guess: object = None,
    *, paths: bool = False, caller: str = "solve",
) -> None:  # fmt: skip
    """Refuse arguments with which no solve can start; needs no values of the problem's functions.

    ``paths``: whether a scheme that follows paths is offered. ``caller``: who got them in another order, or others.
    """
    if not isinstance(problem, Problem) or not isinstance(grid, Grid):
        kinds = f"{type(problem).__name__}, {type(grid).__name__}"
        raise TypeError(f"{caller}: got {kinds}; wanted a Problem and a Grid")
    if method is not None:
        check_method(method, "solve: method")
    if scheme is not None:
        schemes.check(scheme, "solve: scheme", grid, stationary=True, paths=paths)
    arguments.positive(tol, "solve: tol", "in the units of the cost")
    if guess is not None and is_constrained(problem) and is_discounted(problem) is False:
        raise ValueError(
            "solve: without discount a stopping_cost or a running_max has many fixed points, and the one sought is "
            "found from the constraint itself;\nleave out guess, and raise max_steps where they ran out"
        )
    if problem.terminal_cost is not None:
        raise ValueError("solve: a terminal_cost belongs to a finite horizon; a stationary problem has none")
    if problem.time_dependent:
        raise ValueError("solve: a time-dependent problem has no stationary value; it needs a finite horizon")


def check_node_values(values: object, grid: Grid, name: str) -> None:
    """Refuse values that are not one finite real number a node; None passes."""
    if values is None:
        return
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different lengths
        raise ValueError(
            f"{name} is {arguments.shown(values)}; wanted real node values of shape {grid.shape}"
        ) from None
    if array.dtype.kind not in "fiu":  # truth values and complex numbers are none
        raise ValueError(f"{name} holds {array.dtype}; wanted real node values of shape {grid.shape}")
    if array.shape != grid.shape:
        hint = "; it looks transposed" if array.shape == grid.shape[::-1] else ""
        raise ValueError(f"{name} has shape {array.shape}, the grid {grid.shape}{hint}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} is NaN or infinite at {int(np.sum(~np.isfinite(array)))} nodes")
