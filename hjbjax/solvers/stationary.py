"""Stationary problems: ``solve``.

It validates its arguments, and calls the host, which chooses a method, drives the iteration from grid to grid and
reports. Inside JAX transformations the compiled program calls the host: see ``transformed``.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation import schemes
from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.posing import without_horizon
from hjbjax.discretisation.schemes import Upwind
from hjbjax.iteration.methods import Method, check_method
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid, check_spacings
from hjbjax.problem.layouts import spans_processes
from hjbjax.problem.problem import Problem, is_constrained, is_discounted
from hjbjax.problem.pytree import as_one_program, is_traced
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import DType, Nodes, Number
from hjbjax.solution import checkpoints
from hjbjax.solution.checkpoints import Checkpoint
from hjbjax.solution.clock import Clock, noting_interrupts
from hjbjax.solution.placement import Path
from hjbjax.solution.rewards import with_rewards
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status
from hjbjax.solvers import host_loop, memory, nested_grids, semi_lagrangian, transformed
from hjbjax.solvers.host_solve import Choices, solve_on_host
from hjbjax.solvers.result import solution_at_start, with_last_phase
from hjbjax.solvers.setup import TOL, check_on_one_state, choose, may_raise_order
from hjbjax.solvers.transformed import Asked
from hjbjax.tracing import checks
from hjbjax.tracing.closures import with_settled_functions


@with_rewards
@without_horizon
@with_settled_functions
def solve(
    problem: Problem,
    grid: Grid,
    *,
    method: Method | None = None,
    scheme: Scheme | None = None,
    tol: float | None = None,
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
      problem: the problem.
      grid: the grid.
      method: ``PolicyIteration(...)`` or ``ValueIteration()``; ``None`` chooses by the problem.
      scheme: ``Upwind()``, first order and monotone; ``Limited()``, second order where the value is smooth;
        ``Weno5()``, fifth order there, on equal spacings, if ``tol`` is as small as its error; or ``SemiLagrangian()``,
        monotone, for deterministic problems whose optimal paths follow kinks of the value. ``None`` is ``Limited()`` if
        its iteration converges, with an estimate of the grid error. It is ``Upwind()`` for value iteration, for tubes
        without discount, and if noise makes central differences monotone. If ``method`` is ``None`` too, it is
        ``SemiLagrangian()`` where the chain may be carried past an undiscounted target that paths without noise reach;
        the message of the solution reports this.
      tol: bound on |V − V_h| to reach, in cost units, where V_h is the exact solution on the grid of the monotone
        scheme. Without a certificate, which the solution reports, and for the high-order equation, it bounds the
        residual and the distance to the limit of the iteration. ``None`` is 1e-3; if ``scheme`` is ``None`` too, the
        high-order iteration also stops at a tenth of the estimated grid error. A tube without discount continues
        until V no longer changes.
      guess: initial node values, shape (*grid); not for a tube without discount, which has many fixed points.
      dtype: ``None`` is float64; inside a transformation the result is rounded to the type of ``float`` there.
        ``"float32"`` for memory, with a tolerance that float32 can reach.
      max_steps: largest number of steps for each scheme and grid.
      time_limit: seconds, including checks and compilation; a single compilation or step is not interrupted.
      throw: raise if the solve does not converge, or inside a transformation return NaN; otherwise the status reports
        it.
      progress: print each phase as it begins, and show a bar of the steps after a second; ``None``: on a terminal.
      max_memory: bytes that the solve may use, instead of the free memory.
      checkpoint: a file for the state of the run, written every minute and at the end, or ``Checkpoint(path, every=)``.
      resume: continue from that file if it exists, with the same bits; host level.
      mesh: divide the nodes among its devices; its i-th axis divides the i-th axis of the grid, such as
        ``jax.make_mesh((4, 2), ("a", "b"))``; host level.

    Returns:
      The solution, with NumPy arrays at host level. Inside ``jit``, ``vmap`` and ``grad`` the compiled program calls
      the host, so the result is the same, in the dtype of the transformation. Value and policy are then traced, and
      differentiable with respect to every number in the problem and the grid. If the solve does not converge they and
      their derivatives are NaN, unless ``throw`` is false. A derivative whose linear solve does not converge is NaN
      too. Warnings and messages are lost in a transformation.

    Raises:
      ValueError: the problem has no solution, or an argument is invalid.
      MemoryError: the grid does not fit; raised before anything is compiled.
      FileExistsError: the checkpoint exists, without ``resume``.
      FileError: the checkpoint belongs to another problem, is in use by another run, or cannot be written.
      SolveError: no convergence, or Ctrl-C; the partial solution is ``.solution``.

    Example:
      >>> import hjbjax as hjb
      >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
      >>> solution = hjb.solve(problem, hjb.Grid([-2.0], [2.0], (81,)))
      >>> solution.status.name, solution.monotone_error <= 1e-3, bool(solution.grid_error.max() <= 2e-3)
      ('CONVERGED', True, True)
    """
    check_limits(max_steps, time_limit)
    check_arguments(problem, grid, method, scheme, tol, guess)
    checks.check_indices(grid)  # also inside transformations, where the memory is not checked
    traced, free = is_traced(problem, grid, guess, tol), method is None
    paths = None if scheme is None else scheme.paths
    if mesh is not None:
        known = choose(problem, grid, traced=traced, method=method, divided=True)
        mesh = checks.over_devices(mesh, "solve", problem, grid, *filter(None, [scheme]), known, traced=traced)
    if traced:
        checkpoints.refuse_checkpoint(checkpoint, resume, "solve")
        if paths is not None:
            raise ValueError(
                f"solve: {type(scheme).__name__}() runs at host level only; inside jit, vmap and grad use Upwind()"
            )
        own = arguments.traced_dtype(dtype, "solve")
        inner = np.dtype(np.float64) if dtype is None else own
        x64 = np.float64 in (inner, jnp.result_type(float))
        asked = Asked(method, scheme, tol is None, max_steps, time_limit, throw, own, inner, x64)
        return _solve_traced(problem, grid, asked, guess, TOL if tol is None else tol)
    kind = arguments.as_dtype(dtype)
    check_node_values(guess, grid, "solve: the guess")
    check_spacings(grid, kind)
    clock = Clock(max_steps or 10**9, time_limit, progress, together=spans_processes(mesh))
    opened = checkpoints.open_checkpoint(
        checkpoint, [problem], grid, resume=resume, caller="solve", together=clock.together, method=method,
        scheme=scheme, tol=tol, guess=guess, dtype=kind,
    )  # fmt: skip
    choices = Choices(scheme=scheme is None, method=free, levels=free, tol=tol is None)
    tol = TOL if tol is None else tol
    if scheme is not None and paths is not None:
        with noting_interrupts(clock), host_loop.announce(clock), own_settings(x64=kind == np.float64), opened as kept:
            clock.journal = kept and kept.journal()
            options: Any = {"method": method, "tol": tol, "guess": guess, "max_memory": max_memory}
            solution = semi_lagrangian.solve_arcs_on_host(problem, grid, scheme, paths, kind, clock=clock, **options)
        return _ended(with_last_phase(solution, clock), clock, tol, throw=throw)
    method = choose(problem, grid, traced=False, method=method, divided=mesh is not None)
    on = Discretisation(problem, grid, scheme or Upwind(subcell=True), kind)
    # float64 for this call only: other threads, and the caller's own programs, keep their type
    with noting_interrupts(clock), host_loop.announce(clock), own_settings(x64=kind == np.float64), opened as kept:
        clock.journal = kept and kept.journal()
        check_on_one_state(problem, grid, on.scheme)  # before the memory check, which reads functions
        needed = memory.require(
            problem, grid, method, kind, max_memory, high_order=may_raise_order(problem, method, scheme), mesh=mesh
        )
        with host_loop.with_solution(clock, needed, lambda kept: _partial(on, kept)):
            solution = solve_on_host(on, method, tol, guess, clock, choices, mesh)
    solution = with_last_phase(solution, clock)  # after the last write of the checkpoint, which may take long
    solution.stats.setdefault("method", method.described(problem.is_game))
    solution.stats.update(bytes=needed, **({} if mesh is None else {"mesh": mesh.devices.shape}))
    return _ended(solution, clock, tol, throw=throw)


def _ended(solution: Solution, clock: Clock, tol: float, *, throw: bool) -> Solution:
    """The solution with its times; raises ``SolveError`` if it did not converge and ``throw`` is set."""
    solution.stats.update(
        seconds=clock.stepping, compile_seconds=clock.elapsed() - clock.stepping,
        tol=tol, **({} if clock.journal is None else {"checkpoint": clock.journal.file.outcome}),
    )  # fmt: skip
    if throw and solution.status is not Status.CONVERGED:
        raise SolveError(f"{solution.status.name}: {solution.message}", solution)
    return solution


def _partial(on: Discretisation, kept: host_loop.Kept | None) -> Solution:
    """The solution of a failed run, from a saved value, maybe on a coarser grid; else zero."""
    if kept is None:
        value = np.broadcast_to(np.zeros((), on.dtype), on.grid.shape)  # a broadcast zero takes no memory
    else:
        value, grid = kept
        value = value if grid.shape == on.grid.shape else nested_grids.prolong(value, grid, on.grid)
    return solution_at_start(on, value, Status.INTERRUPTED)


@as_one_program
def _solve_traced(problem: Problem, grid: Grid, asked: Asked, guess: Nodes | None, tol: Number) -> Solution:
    """The solution inside a JAX transformation, computed by the host in a call from the compiled program.

    Its derivative is the derivative of the equation that it solves, and is part of the program.
    """
    return transformed.solve_in_program(problem, grid, asked, guess, tol)


def check_limits(max_steps: object, time_limit: object) -> None:
    """Refuse an invalid limit on steps or seconds."""
    if max_steps is not None:
        arguments.count(max_steps, "solve: max_steps")
    if time_limit is not None:
        arguments.positive(time_limit, "solve: time_limit", "in seconds", endless=True)


def check_arguments(
    problem: object, grid: object, method: object, scheme: object, tol: object, guess: object = None
) -> None:
    """Refuse arguments with which no solve can start, without evaluating the problem's functions."""
    if not isinstance(problem, Problem) or not isinstance(grid, Grid):
        kinds = f"{type(problem).__name__}, {type(grid).__name__}"
        raise TypeError(f"solve: got {kinds}; wanted a Problem and a Grid")
    if method is not None:
        check_method(method, "solve: method")
    if scheme is not None:
        schemes.check_scheme(scheme, "solve: scheme", grid, stationary=True)
    word = problem.labels.word
    if tol is not None:
        arguments.positive(tol, "solve: tol", word("in the units of the cost"))
    if guess is not None and is_constrained(problem) and is_discounted(problem) is False:
        raise ValueError(
            f"solve: without discount a {word('stopping_cost')} or a running_max has many fixed points, and the "
            "iteration must start from the constraint itself;\nremove guess, and raise max_steps if necessary"
        )
    if problem.terminal_cost is not None or problem.terminal_reward is not None:
        raise ValueError(
            f"solve: a {word('terminal_cost')} belongs to a finite horizon; a stationary problem has none. "
            "Use hjb.march(problem, grid, horizon)"
        )
    if problem.time_dependent:
        raise ValueError("solve: a time-dependent problem has no stationary value; it needs a finite horizon")


def check_node_values(values: object, grid: Grid, name: str) -> None:
    """Refuse values that are not one finite real number per node; None passes."""
    if values is None:
        return
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different lengths
        raise ValueError(
            f"{name} is {arguments.shown(values)}; wanted real node values of shape {grid.shape}"
        ) from None
    if array.dtype.kind not in "fiu":  # not booleans or complex numbers
        raise ValueError(f"{name} holds {array.dtype}; wanted real node values of shape {grid.shape}")
    if array.shape != grid.shape:
        hint = "; it looks transposed" if array.shape == grid.shape[::-1] else ""
        raise ValueError(f"{name} has shape {array.shape}, the grid {grid.shape}{hint}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} is NaN or infinite at {int(np.sum(~np.isfinite(array)))} nodes")
