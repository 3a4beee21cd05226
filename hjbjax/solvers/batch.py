"""Many problems on one grid at once: ``solve_batch``.

Problems that differ only in numbers share their programs. On a CPU each lane is a separate solve, and one runs
per core in parallel: JAX releases other threads while a program runs, and a solve keeps one core busy most of
the time. Two cores gave 1.8 times the solves per second on 100 x 101 nodes. Lanes of one ``vmap``ped loop gave 0.9 to
1.3 times, since sweeps are still a loop over slices, and every lane pays for the steps of the slowest lane.

On an accelerator, which a single lane does not fill, they are lanes of one ``vmap``ped loop. It runs until its slowest
lane stops, so finished lanes are removed between chunks.

With ``mesh=`` each device runs such a loop over its own lanes, and devices do not wait for each other within a chunk.

Each lane has its own status, and NaN in one does not affect the others. Ctrl-C and the time limit end all lanes that
are running or have not started.
"""

import contextlib
import dataclasses
import os
from collections.abc import Hashable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.posing import without_horizon
from hjbjax.discretisation.schemes import Upwind, check_slopes
from hjbjax.hamiltonian import exact
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.iteration.methods import Method
from hjbjax.problem import arguments
from hjbjax.problem.arguments import as_mesh
from hjbjax.problem.grid import Grid, check_spacings
from hjbjax.problem.layouts import Lanes, spans_processes
from hjbjax.problem.problem import Problem
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import DType, Nodes
from hjbjax.problem.words import shown
from hjbjax.solution import checkpoints
from hjbjax.solution.checkpoints import Checkpoint, File
from hjbjax.solution.clock import CUT, Clock, Stopped, noting_interrupts
from hjbjax.solution.placement import Path
from hjbjax.solution.rewards import with_rewards
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status, keeping_warnings, warn
from hjbjax.solvers import host_loop, memory, vanishing_discounts
from hjbjax.solvers.box_error import with_box_error
from hjbjax.solvers.coarser_answer import coarser_answer
from hjbjax.solvers.host_solve import Choices, solve_on_host
from hjbjax.solvers.result import finish, solution_at_start, with_grid_error, with_last_phase
from hjbjax.solvers.second_order import better_of, raise_order
from hjbjax.solvers.semi_lagrangian import finish_replacement, replace_chain
from hjbjax.solvers.settle import Settled, may_go_on, settle
from hjbjax.solvers.setup import (
    TOL,
    Assumptions,
    check_on_one_state,
    choose,
    choose_scheme,
    may_raise_order,
    prepare_on_host,
    warn_unreached,
)
from hjbjax.solvers.stationary import check_arguments, check_limits
from hjbjax.solvers.stationary_run import LanesRun, stack_lanes, with_obstacles
from hjbjax.tracing import checks
from hjbjax.tracing.closures import refuse_traced, with_settled_functions
from hjbjax.well_posedness import admissibility, node_checks
from hjbjax.well_posedness.attainability import Reach


@with_rewards
@without_horizon
@with_settled_functions
def solve_batch(
    problems: Iterable[Problem],
    grid: Grid,
    *,
    method: Method | None = None,
    scheme: Scheme | None = None,
    tol: float | None = None,
    dtype: DType | None = None,
    max_steps: int | None = None,
    time_limit: float | None = None,
    throw: bool = True,
    progress: bool | None = None,
    max_memory: int | None = None,
    checkpoint: Path | Checkpoint | None = None,
    resume: bool = False,
    mesh: Mesh | None = None,
) -> list[Solution]:
    """Solve many problems on one grid; each solution is the same as from ``solve`` with this method.

    Args:
      problems: problems; problems with the same functions and shapes share a program, regardless of their numbers.
      grid: the grid.
      method: as in ``solve``, without nesting: ``Nested`` is replaced by its inner method; ``None`` chooses by the
        problem.
      scheme: as in ``solve``.
      tol: as in ``solve``.
      dtype: as in ``solve``.
      max_steps: largest number of steps per lane.
      time_limit: seconds for all lanes, including checks and compilation.
      throw: raise if a lane does not converge; otherwise its status reports it.
      progress: as in ``solve``.
      max_memory: bytes for one round of lanes; a batch that needs more runs in several rounds.
      checkpoint: as in ``solve``, like ``resume``: one file for all lanes. Lanes then run in parallel, one per core,
        also on an accelerator.
      resume: continue from that file if it exists, each lane with the same bits.
      mesh: distribute the lanes over all of its devices, each with its own lanes; not with ``checkpoint``.

    Returns:
      One solution per problem, in the same order.

    Raises:
      ValueError: a problem has no solution; the message names the lane. Or a call inside ``jit``, ``vmap`` or ``grad``.
      SolveError: a lane did not converge, or was interrupted; ``.solution`` is the first such, ``.solutions`` are all.
    """
    if isinstance(problems, Problem) or not isinstance(problems, Iterable):
        raise TypeError(f"solve_batch: got {shown(problems)}; wanted a list of problems, such as [problem]")
    lanes = list(problems)
    check_limits(max_steps, time_limit)
    for number, lane in enumerate(lanes):
        if not isinstance(lane, Problem):
            raise TypeError(f"solve_batch: lane {number} is {shown(lane)}; wanted only problems")
        check_arguments(lane, grid, method, scheme, tol)
    refuse_traced("solve_batch", *lanes, grid)
    check_slopes(scheme, "solve_batch: scheme")
    checks.check_indices(grid)
    kind = arguments.as_dtype(dtype)
    check_spacings(grid, kind)
    solutions: list[Any] = [None] * len(lanes)
    over = Lanes(None if mesh is None else _over_lanes(mesh, lanes, grid, method, checkpoint))
    clock = Clock(max_steps or 10**9, time_limit, progress, together=spans_processes(over.mesh))
    opened = checkpoints.open_checkpoint(
        checkpoint, lanes, grid, resume=resume, caller="solve_batch", method=method, scheme=scheme, tol=tol, dtype=kind
    )
    free_tol, tol = tol is None, TOL if tol is None else tol
    with noting_interrupts(clock), host_loop.announce(clock), own_settings(x64=kind == np.float64), opened as kept:
        for members in _same_program(lanes):
            first = lanes[members[0]]
            # without nesting, because the host would drive the levels of each lane
            chosen = choose(first, grid, traced=False, method=method, divided=mesh is not None).inner
            on = Discretisation(first, grid, scheme or Upwind(subcell=True), kind)
            choices = Choices(scheme=scheme is None, method=method is None, levels=False, tol=free_tol)
            with _naming(members[0]):
                check_on_one_state(first, grid, on.scheme)
            needed = memory.require(
                first, grid, chosen, kind, max_memory, high_order=may_raise_order(first, chosen, scheme)
            )
            # a single lane fits, as checked above, so a round is never empty
            for some in _rounds(members, needed, max_memory):
                with host_loop.with_solution(clock, needed * len(some), lambda _: next(filter(None, solutions), None)):
                    members_of = {i: on.asking(lanes[i]) for i in some}
                    if mesh is not None or (_fills_with_lanes() and kept is None):
                        together = _solve_together(members_of, chosen, tol, clock, over, choices)
                    else:
                        together = _solve_side_by_side(members_of, chosen, tol, clock, kept, choices)
                for index, solution in zip(some, together, strict=True):
                    solution.stats["bytes"] = needed
                    solutions[index] = solution
    if solutions and not any(solution.status in CUT for solution in solutions):
        solutions[-1] = with_last_phase(solutions[-1], clock)  # catches a late Ctrl-C
    for index, solution in enumerate(solutions):
        solution.stats.update({} if kept is None else {"checkpoint": kept.outcome})
        if throw and solution.status is not Status.CONVERGED:
            raise SolveError(f"lane {index}: {solution.status.name}: {solution.message}", solution, solutions)
    return solutions


@contextlib.contextmanager
def _naming(lane: int) -> Iterator[None]:
    """Prefix errors with the lane they belong to."""
    try:
        yield
    except ValueError as refusal:
        raise ValueError(f"lane {lane}: {refusal}") from refusal


def _over_lanes(mesh: object, lanes: Sequence[Problem], grid: Grid, method: Method | None, checkpoint: object) -> Mesh:
    """Check that lanes can be distributed over a mesh, and return it.

    Raises:
      TypeError, ValueError: names what does not run on several devices.
    """
    known = as_mesh(mesh, "solve_batch")
    if checkpoint is not None:
        raise ValueError("solve_batch: checkpoint= is not supported together with mesh=. Pass only one of them")
    evaluation = None if method is None else method.inner.evaluation
    calls_back = evaluation is not None and evaluation.calls_back
    if calls_back or any(checks.problem_calls_back(problem, grid.ndim) for problem in lanes):
        called = repr(method) if calls_back else "a function of the problem"
        raise ValueError(f"solve_batch: {called} calls Python on the host; leave out mesh")
    return known


def _same_program(problems: Sequence[Problem]) -> list[list[int]]:
    """Groups of lanes that share one program (the same functions and shapes), in the order of first appearance."""
    # numbers are leaves and may differ; functions, kinds of sets and flags are structure, each with its own program
    flat = map(jax.tree.flatten, problems)
    return _groups((structure, tuple(np.shape(leaf) for leaf in leaves)) for leaves, structure in flat)


def _groups(keys: Iterable[Hashable]) -> list[list[int]]:
    """Groups of the positions of equal keys, in the order of first appearance."""
    groups: dict[Hashable, list[int]] = {}
    for position, key in enumerate(keys):
        groups.setdefault(key, []).append(position)
    return list(groups.values())


def _rounds(members: Sequence[int], bytes_each: int, limit: int | None) -> list[Sequence[int]]:
    """Groups of lanes that fit into half of the memory together."""
    # half, because the prepared tasks coexist with their stack, and rows are copied when lanes are removed
    free = memory.available() if limit is None else int(limit)
    most = len(members) if free is None else max(1, free // 2 // max(bytes_each, 1))
    return [members[start : start + most] for start in range(0, len(members), most)]


def _fills_with_lanes() -> bool:
    """True if lanes run as one ``vmap``ped loop, on a device that a single lane does not keep busy."""
    device = host_loop.setting("jax_default_device") or jax.devices()[0]
    return getattr(device, "platform", device) != "cpu"


def _cores() -> int:
    """The number of cores that this process may use."""
    with contextlib.suppress(AttributeError):  # only Linux reports ``taskset`` and containers
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _solve_side_by_side(
    lanes: dict[int, Discretisation], method: Method, tol: float, clock: Clock, kept: File | None, choices: Choices
) -> list[Solution]:
    """Solve problems that share a program in parallel, one thread per core; the solutions in the order of ``lanes``."""
    settings, names = host_loop.settings(), list(lanes)

    def one(name: int) -> tuple[Solution, list[str]]:
        own = clock.beside()
        own.journal = kept and kept.journal(f"lane{name}")
        with _naming(name), settings(), keeping_warnings() as said:
            solution = solve_on_host(lanes[name], method, tol, None, own, choices)
        solution.stats.setdefault("method", method.described(lanes[name].problem.is_game))
        solution.stats.update(seconds=own.stepping, lanes=len(lanes), tol=tol)
        return with_last_phase(solution, own) if solution.status in CUT else solution, said

    found = {names[0]: _told(names[0], *one(names[0]))}  # first on its own, to compile the program that the others use
    with (
        ThreadPoolExecutor(_cores()) as pool,
        host_loop.progress_bar(clock.progress, {"desc": "solve_batch", "unit": " lanes", "total": len(lanes)}) as bar,
    ):
        waiting = {pool.submit(one, name): name for name in names[1:]}
        try:
            _finish(waiting, found, bar)
        except KeyboardInterrupt:  # a second Ctrl-C, or a custom handler: running lanes end by the clock
            clock.interrupted = True
            _finish(waiting, found, None)
        finally:
            pool.shutdown(cancel_futures=True)
    return [found[name] for name in names]


def _finish(waiting: dict[Future, int], found: dict[int, Solution], bar: Any) -> None:
    """Wait for the lanes in the order in which they end; raise the first exception."""
    for done in as_completed(waiting):
        found[waiting[done]] = _told(waiting[done], *done.result())
        if bar is not None:
            bar.update(len(found) - bar.n)


def _told(name: int, solution: Solution, said: Sequence[str]) -> Solution:
    """Return the solution of a lane, after issuing its warnings at the user's line."""
    for message in said:
        warn(f"lane {name}: {message}")
    return solution


def _solve_together(
    lanes: dict[int, Discretisation], method: Method, tol: float, clock: Clock, over: Lanes, choices: Choices
) -> list[Solution]:
    """Solve problems in one loop; the solutions in the order of ``lanes``, with ``choices`` as in ``solve``."""
    asked, found = dict(lanes), dict[int, Solution]()
    prepared: dict[int, tuple[Task, Assumptions, Reach | None]] = {}
    for name, on in lanes.items():
        try:
            with _naming(name):
                exact.check_unbounded(on, relaxes=method.inner.relaxes)
                node_checks.check_values(on, clock)
                admissibility.check_constrained_ends(on.problem, on.grid, on.dtype)
                if choices.scheme:
                    on = asked[name] = on.with_scheme(choose_scheme(on, method))
                prepared[name] = prepare_on_host(on.chain, method=method, tol=tol, clock=clock)
                followed = replace_chain(on, prepared[name][2], tol, None, clock) if choices.both else None
        except Stopped as stop:
            nothing = [solution_at_start(each, np.zeros(each.grid.shape), stop.status) for each in asked.values()]
            return [with_last_phase(solution, clock) for solution in nothing]
        if followed is not None:
            found[name] = finish_replacement(followed)
            continue
        reach = prepared[name][2]
        if reach is not None and not reach.surely.all():
            warn_unreached(reach, on.problem.payoff, undiscounted=bool(on.problem.discount == 0))
    left = [name for name in lanes if name not in found]
    if left:
        rest = _solve_chains(
            {i: asked[i] for i in left}, [prepared[i] for i in left], method, tol, clock, over, choices
        )
        found |= dict(zip(left, rest, strict=True))
    return [found[name] for name in lanes]


def _solve_chains(
    lanes: dict[int, Discretisation], prepared: Sequence[tuple[Task, Assumptions, Reach | None]], method: Method,
    tol: float, clock: Clock, over: Lanes, choices: Choices,
) -> list[Solution]:  # fmt: skip
    """The solutions of prepared lanes that run as one loop, in the same order."""
    began, names, asked, sharpen = clock.elapsed(), list(lanes), list(lanes.values()), choices.scheme
    # a static flag, set for all lanes as soon as one has unreachable nodes, so that they share a program
    has_lost = any(task.has_lost for task, _, _ in prepared)
    tasks = [dataclasses.replace(task, has_lost=has_lost) for task, _, _ in prepared]
    ended = _iterate(tasks, _starts(tasks, names, clock, over), names, clock, over)
    settled = [
        _settled(Settled(task, assumptions, None if reach is None else reach.surely, *end), clock)
        for task, (_, assumptions, reach), end in zip(tasks, prepared, ended, strict=True)
    ]
    further = [
        i
        for i, each in enumerate(settled)
        if not asked[i].scheme.monotone and each.code not in CUT and (each.code is Status.CONVERGED or not sharpen)
    ]
    for i in further:
        settled[i] = settled[i].without_actions()
    sharp = [raise_order(settled[i], asked[i].scheme, clock, to_grid_error=choices.to_grid_error) for i in further]
    guesses, further_names = [settled[i].state.value for i in further], [names[i] for i in further]
    better = _iterate([each.task for each in sharp], guesses, further_names, clock, over)
    for i, each, (state, code, residuals) in zip(further, sharp, better, strict=True):
        each = each._replace(state=state, code=code, residuals=residuals)
        settled[i] = better_of(settled[i], each, clock, sharpen=sharpen)
    solutions = [finish(each, on.grid, cut=clock.over() is not None) for each, on in zip(settled, asked, strict=True)]
    for i, each in enumerate(settled):
        if sharpen and asked[i].scheme.subcell and solutions[i].status is Status.CONVERGED:
            solutions[i] = with_grid_error(solutions[i], each, each.coarser or coarser_answer(each, clock))
        if solutions[i].status is Status.CONVERGED:
            solutions[i] = with_box_error(solutions[i], each, clock)
    about = {"seconds": clock.elapsed() - began, "lanes": len(lanes), "tol": tol}
    for on, solution in zip(asked, solutions, strict=True):
        solution.stats.update(method=method.described(on.problem.is_game), **about)
    return [with_last_phase(each, clock) if each.status in CUT else each for each in solutions]


def _starts(tasks: Sequence[Task], names: Sequence[int], clock: Clock, over: Lanes) -> list[Nodes]:
    """The initial values of the lanes: zero, the constraint of a tube, or the values for vanishing discounts."""
    starts: list[Nodes] = [task.start() for task in tasks]
    led = [i for i, task in enumerate(tasks) if vanishing_discounts.needs_a_way(task)]
    for discount in vanishing_discounts.VANISHING if led else ():
        on_the_way = [vanishing_discounts.under(tasks[i], discount) for i in led]
        most = vanishing_discounts.WARM_STEPS
        ended = _iterate(on_the_way, [starts[i] for i in led], [names[i] for i in led], clock, over, most)
        for i, (state, _, _) in zip(led, ended, strict=True):
            starts[i] = state.value
    return starts


def _iterate(
    tasks: Sequence[Task], starts: Sequence[Nodes], names: Sequence[int], clock: Clock, over: Lanes, most: int = 10**9
) -> list[tuple[State, Status, np.ndarray]]:
    """The last state, status and residuals of each lane; lanes whose tasks share a structure run together."""
    found: list[Any] = [None] * len(tasks)
    # lanes with different certificates stop by different rules, which are part of the structure
    for members in _groups(jax.tree.structure(task) for task in tasks):
        limit = min(most, clock.max_steps)
        run = LanesRun(stack_lanes([tasks[i] for i in members]), stack_lanes([starts[i] for i in members]), limit, over)
        run.name = f"lanes {names[members[0]]} to {names[members[-1]]}, {tasks[0].grid.size} nodes each"
        run.between(host_loop.drive(run, clock), clock)  # once more, for lanes that were cut short
        for i, (state, code), residuals in zip(members, run.final, run.histories, strict=True):
            # a run that ended before its initial evaluation still contains the raw guess
            state = with_obstacles(tasks[i], state) if code in CUT else state
            found[i] = state, code, np.concatenate(residuals)[: int(state.progress.evaluations)]
    return found


def _settled(settled: Settled, clock: Clock) -> Settled:
    """The end of one lane, which may continue on its own: away from a rest node, or by vanishing discounts."""
    task, assumptions, reached, state, code, history, *_ = settled
    if code in CUT or not may_go_on(task, assumptions, state, code):
        return settled
    # a converged solution and a failed game continue from their value; a lane caught at rest restarts from the values
    # for vanishing discounts
    onwards = code is Status.CONVERGED or task.problem.is_game
    settled = settle(task, assumptions, reached, state.value if onwards else None, clock)
    return settled._replace(residuals=np.concatenate([history, settled.residuals])) if onwards else settled
