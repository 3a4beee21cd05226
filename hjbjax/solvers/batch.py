"""Many problems on one grid at once: ``solve_batch``.

Problems that differ in numbers alone are lanes of one ``vmap``ped loop. A batched loop runs until its slowest
lane stops, so finished lanes are taken out between chunks; each lane has its own status, and one that goes NaN
changes no bit of the others. Ctrl-C and the time limit end the lanes that still run, and those that have not begun.
"""

import dataclasses
from collections.abc import Hashable, Iterable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.schemes import Upwind
from hjbjax.finiteness import admissibility, node_checks
from hjbjax.iteration import fixed_point
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.iteration.methods import Method
from hjbjax.problem.arguments import shown
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.types import DType, Mask
from hjbjax.solution.clock import CHUNK_SECONDS, CUT, Clock, Stopped, noting_interrupts
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status
from hjbjax.solvers import faults, memory, nested
from hjbjax.solvers.host_loop import FIRST_NODES, with_obstacles
from hjbjax.solvers.nested import Settled
from hjbjax.solvers.result import finish, solution_at_start, with_last_phase
from hjbjax.solvers.setup import Assumptions, choose, prepare_on_host
from hjbjax.solvers.stationary import as_dtype, check_arguments, check_limits, second_order
from hjbjax.tracing import checks
from hjbjax.tracing.closures import with_settled_functions

T = TypeVar("T")
CHUNK = 8  # steps between two looks at which lanes are done, at most

# under vmap a loop goes on until its last lane is done; lanes that are done keep their state by a select and pay
# for the others' steps all the same, hence the short chunks
_begin = jax.vmap(fixed_point.begin)
_run = jax.jit(jax.vmap(fixed_point.run, in_axes=(0, 0, 0)))


@with_settled_functions
def solve_batch(
    problems: Iterable[Problem],
    grid: Grid,
    *,
    method: Method | None = None,
    scheme: Scheme = Upwind(),
    tol: float = 1e-3,
    dtype: DType | None = None,
    max_steps: int | None = None,
    time_limit: float | None = None,
    throw: bool = True,
    max_memory: int | None = None,
) -> list[Solution]:
    """Solve many problems on one grid; each answer is that of ``solve`` by this method.

    Args:
      problems: problems; those with the same functions and shapes run together, whatever their numbers.
      grid: the nodes.
      method: as in ``solve``, without nesting; ``None`` picks by the problem.
      scheme: the discretisation; ``Limited()`` goes on from the chain's answer lane by lane.
      tol: as in ``solve``.
      dtype: as in ``solve``.
      max_steps: at most so many steps for each lane.
      time_limit: at most so many seconds for all lanes, checks and compilation included.
      throw: raise when a lane does not converge; otherwise its status says it.
      max_memory: bytes that one round of lanes may take; a batch that needs more runs in several.

    Returns:
      One solution for each problem, in their order.

    Raises:
      ValueError: a question without an answer; the lane is named.
      SolveError: a lane did not converge, be it by Ctrl-C; ``.solution`` is the first such, ``.solutions`` are all.
    """
    if isinstance(problems, Problem) or not isinstance(problems, Iterable):
        raise TypeError(f"solve_batch: got {shown(problems)}; wanted a list of problems, as in [problem]")
    lanes = list(problems)
    check_limits(max_steps, time_limit)
    for lane in lanes:
        check_arguments(lane, grid, method, scheme, tol)
    kind = as_dtype(dtype)
    grid.check_spacings(kind)
    solutions: list[Any] = [None] * len(lanes)
    clock = Clock(max_steps or 10**9, time_limit)
    with noting_interrupts(clock), jax.enable_x64(kind == np.float64):
        for members in _same_program(lanes):
            first = lanes[members[0]]
            # without nesting, whose levels the host drives one by one
            chosen = (method or choose(first, grid, traced=False)).inner
            checks.shapes(first, grid, scheme)
            on = Discretisation(first, grid, scheme, kind)
            needed = memory.require(first, grid, chosen, kind, max_memory)
            # one lane by itself has been held against the memory above, so that a round is never empty
            for some in _rounds(members, needed, max_memory):
                with faults.with_solution(clock, needed * len(some), lambda _: next(filter(None, solutions), None)):
                    together = _solve_together({i: on.asking(lanes[i]) for i in some}, chosen, tol, clock)
                for index, solution in zip(some, together, strict=True):
                    solutions[index] = solution
        if solutions and not any(solution.status in CUT for solution in solutions):
            solutions[-1] = with_last_phase(solutions[-1], clock)  # no late Ctrl-C is lost
    for index, solution in enumerate(solutions):
        if throw and solution.status is not Status.CONVERGED:
            raise SolveError(f"lane {index}: {solution.status.name}: {solution.message}", solution, solutions)
    return solutions


def _same_program(problems: Sequence[Problem]) -> list[list[int]]:
    """Groups of lanes whose problems share functions and shapes, and so a program, in the order of first appearance."""
    # numbers are leaves and may differ; functions, kinds of sets and flags are structure and cost a program each
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
    # half of it, since the prepared tasks live on beside their stack, and rows that are taken out are copied
    free = memory.available() if limit is None else int(limit)
    most = len(members) if free is None else max(1, free // 2 // max(bytes_each, 1))
    return [members[start : start + most] for start in range(0, len(members), most)]


def _solve_together(lanes: dict[int, Discretisation], method: Method, tol: float, clock: Clock) -> list[Solution]:
    """The solutions of problems that run together, by the numbers of their lanes."""
    began, names, asked = clock.elapsed(), list(lanes), list(lanes.values())
    prepared: list[tuple[Task, Assumptions, Mask | None]] = []
    for name, on in lanes.items():
        try:
            node_checks.values(on.problem, on.grid, on.dtype, clock)
            admissibility.values(on.problem, on.grid, on.dtype)
            prepared.append(prepare_on_host(on.chain, method=method, tol=tol, clock=clock))
        except ValueError as refusal:
            raise ValueError(f"lane {name}: {refusal}") from refusal
        except Stopped as stop:
            nothing = [solution_at_start(each, np.zeros(each.grid.shape), stop.status) for each in asked]
            return [with_last_phase(solution, clock) for solution in nothing]
    clock.phase = f"the steps of lanes {names[0]} to {names[-1]}"
    # a static flag, set for all lanes as soon as one has nodes out of reach, so that they share a program
    has_lost = any(task.has_lost for task, _, _ in prepared)
    prepared = [
        (dataclasses.replace(task, has_lost=has_lost), assumptions, reached) for task, assumptions, reached in prepared
    ]
    solutions: list[Any] = [None] * len(lanes)
    for members in _groups(jax.tree.structure(task) for task, _, _ in prepared):  # by certificate, too
        # lanes whose certificates differ stop by different rules, which are part of the structure
        tasks = _stack([prepared[i][0] for i in members])
        # from zero, or from the constraint of a tube; a lane that is caught there goes on alone, see _lane_solution
        states = _begin(tasks, jax.vmap(Task.start)(tasks))
        ended, histories = _finish_lanes(tasks, states, len(members), clock)
        for i, (state, code), residuals in zip(members, ended, histories, strict=True):
            history = np.concatenate(residuals)[: int(state.step) + 1]
            solutions[i] = _lane_solution(Settled(*prepared[i], state, code, history), asked[i], clock)
    about = {"seconds": clock.elapsed() - began, "lanes": len(lanes), "tol": tol}
    for on, solution in zip(asked, solutions, strict=True):
        solution.stats.update(method=method.described(on.problem.is_game), **about)
    return solutions


def _lane_solution(settled: Settled, on: Discretisation, clock: Clock) -> Solution:
    """The solution of one lane, which may go on by itself: off a node where it rests, or to second order."""
    task, assumptions, reached, state, code, history = settled
    apart: dict[str, Any] = {}
    if code in CUT:
        settled = settled._replace(state=with_obstacles(task, state))
    elif nested.may_go_on(task, assumptions, state, code):
        # an answer, and a game that failed, go on from where they are; whoever was caught at rest starts anew, by the
        # answers for vanishing discounts
        onwards = code is Status.CONVERGED or task.problem.is_game
        guess = state.value if onwards else None
        settled = nested.settle(task, assumptions, reached, guess, clock)
        if onwards:
            settled = settled._replace(residuals=np.concatenate([history, settled.residuals]))
    if not on.scheme.monotone and settled.code not in CUT:
        settled, apart = second_order(settled, on.scheme, clock)
    solution = finish(settled, on.grid, cut=clock.over() is not None)
    solution.stats.update(apart)
    return with_last_phase(solution, clock) if settled.code in CUT else solution


def _finish_lanes(tasks: Task, states: State, count: int, clock: Clock) -> tuple[list[tuple], list[list]]:
    """The last state and the status of each lane, and its residuals, by chunks of steps until all are done or cut.

    Lanes that are done are taken out where that halves the work.
    """
    final: list[Any] = [None] * count
    histories: list[list] = [[np.zeros(0)] for _ in range(count)]
    lanes = np.arange(count)  # which lane each row holds; −1 in rows that only fill up
    nodes = states.value[0].size
    chunk = int(np.clip(FIRST_NODES / (nodes * count), 1, CHUNK))  # nothing has been timed yet
    if clock.over() is None:
        states = _run(tasks, states, np.full(count, -1))  # compiles and does nothing
    while lanes.size:
        began, before, cut = clock.elapsed(), np.asarray(states.step), clock.over()
        if cut is None:
            # an array: lanes that are done stand where they stopped
            states = _run(tasks, states, np.minimum(before + chunk, clock.max_steps))
        codes, steps, history = jax.device_get((states.code, states.step, states.history))
        if cut is None:  # the loop ran as long as its slowest lane, over rows that only fill up as well
            clock.count(clock.elapsed() - began, max(int(np.max(steps - before)), 1), nodes * len(lanes))
            chunk = int(np.clip(clock.steps_in(CHUNK_SECONDS, nodes * len(lanes)), 1, CHUNK))
        going = (codes == Status.RUNNING) & (steps < clock.max_steps) & (lanes >= 0) & (cut is None)
        live = [row for row, lane in enumerate(lanes) if lane >= 0 and final[lane] is None]
        for row in live:
            histories[lanes[row]].append(history[row, : steps[row] - before[row]])
        ended = [row for row in live if not going[row]]
        if ended:
            on_host = jax.device_get(states)
            for row in ended:
                # copied, or a view would keep the arrays of all lanes alive
                last = jax.tree.map(lambda leaf, row=row: leaf[row].copy(), on_host)
                own = Status(int(last.code))
                final[lanes[row]] = last, own if own is not Status.RUNNING else cut or Status.MAX_STEPS
        left = np.flatnonzero(going)
        # powers of two, since every width is compiled for itself: a thousand lanes take eleven programs at most
        width = 1 << (left.size - 1).bit_length() if left.size else 0
        if width < lanes.size:
            kept = np.resize(left, width)
            lanes = np.where(np.arange(width) < left.size, lanes[kept], -1)
            tasks, states = _take(tasks, kept), _take(states, kept)
    return final, histories


def _stack(trees: Sequence[T]) -> T:
    """One tree of trees of one structure, with a leading axis of lanes in every leaf."""
    return jax.tree.map(lambda *leaves: jnp.stack(jnp.broadcast_arrays(*leaves)), *trees)


def _take(tree: T, rows: np.ndarray) -> T:
    """The rows of every leaf."""
    return jax.tree.map(lambda leaf: leaf[rows], tree)
