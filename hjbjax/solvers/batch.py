"""Many problems on one grid at once: ``solve_batch``.

Problems that differ in numbers alone are lanes of one ``vmap``ped loop. A batched loop runs until its slowest
lane stops, so finished lanes are taken out between chunks; each lane has its own status, and one that goes NaN
changes no bit of the others. Ctrl-C and the time limit end the lanes that still run, and those that have not begun.
"""

import dataclasses
from collections.abc import Hashable, Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.schemes import Upwind
from hjbjax.iteration import fixed_point
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.iteration.methods import Method
from hjbjax.markov_chain import admissibility, memory, node_checks
from hjbjax.problem.arguments import shown
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.types import Array, DType, Mask, Nodes
from hjbjax.solution.clock import CUT, Clock, Stopped, noting_interrupts
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status
from hjbjax.solvers import host_loop, nested
from hjbjax.solvers.host_loop import FIRST_NODES
from hjbjax.solvers.nested import Settled
from hjbjax.solvers.result import finish, solution_at_start, with_last_phase
from hjbjax.solvers.setup import Assumptions, check_on_one_state, choose, choose_scheme, prepare_on_host
from hjbjax.solvers.stationary import as_dtype, check_arguments, check_limits
from hjbjax.solvers.stationary_run import with_obstacles
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
    scheme: Scheme | None = None,
    tol: float = 1e-3,
    dtype: DType | None = None,
    max_steps: int | None = None,
    time_limit: float | None = None,
    throw: bool = True,
    progress: bool | None = None,
    max_memory: int | None = None,
) -> list[Solution]:
    """Solve many problems on one grid; each answer is that of ``solve`` by this method.

    Args:
      problems: problems; those with the same functions and shapes run together, whatever their numbers.
      grid: the nodes.
      method: as in ``solve``, without nesting: of ``Nested`` its inner method; ``None`` picks by the problem.
      scheme: as in ``solve``; no error of the grid is estimated.
      tol: as in ``solve``.
      dtype: as in ``solve``.
      max_steps: at most so many steps for each lane.
      time_limit: at most so many seconds for all lanes, checks and compilation included.
      throw: raise when a lane does not converge; otherwise its status says it.
      progress: as in ``solve``.
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
    clock = Clock(max_steps or 10**9, time_limit, progress)
    with noting_interrupts(clock), jax.enable_x64(kind == np.float64):
        for members in _same_program(lanes):
            first = lanes[members[0]]
            # without nesting, whose levels the host drives one by one
            chosen = choose(first, grid, traced=False, method=method).inner
            on, sharpen = Discretisation(first, grid, scheme or Upwind(subcell=True), kind), scheme is None
            check_on_one_state(first, grid, on.scheme)
            needed = memory.require(first, grid, chosen, kind, max_memory)
            # one lane by itself has been held against the memory above, so that a round is never empty
            for some in _rounds(members, needed, max_memory):
                with host_loop.with_solution(clock, needed * len(some), lambda _: next(filter(None, solutions), None)):
                    members_of = {i: on.asking(lanes[i]) for i in some}
                    together = _solve_together(members_of, chosen, tol, clock, sharpen=sharpen)
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


def _solve_together(
    lanes: dict[int, Discretisation], method: Method, tol: float, clock: Clock, *, sharpen: bool
) -> list[Solution]:
    """The solutions of problems that run together, by the numbers of their lanes; ``sharpen`` as in ``solve``."""
    began, names, asked = clock.elapsed(), list(lanes), list(lanes.values())
    prepared: list[tuple[Task, Assumptions, Mask | None]] = []
    for i, on in enumerate(asked):
        try:
            node_checks.values(on, clock)
            admissibility.values(on.problem, on.grid, on.dtype)
            if sharpen:
                on = asked[i] = dataclasses.replace(on, scheme=choose_scheme(on, method))
            prepared.append(prepare_on_host(on.chain, method=method, tol=tol, clock=clock))
        except ValueError as refusal:
            raise ValueError(f"lane {names[i]}: {refusal}") from refusal
        except Stopped as stop:
            nothing = [solution_at_start(each, np.zeros(each.grid.shape), stop.status) for each in asked]
            return [with_last_phase(solution, clock) for solution in nothing]
    # a static flag, set for all lanes as soon as one has nodes out of reach, so that they share a program
    has_lost = any(task.has_lost for task, _, _ in prepared)
    tasks = [dataclasses.replace(task, has_lost=has_lost) for task, _, _ in prepared]
    # from zero, or from the constraint of a tube; a lane that is caught there goes on alone, see _settled
    ended = _iterate(tasks, [task.start() for task in tasks], names, clock)
    settled = [
        _settled(Settled(task, assumptions, reached, *end), clock)
        for task, (_, assumptions, reached), end in zip(tasks, prepared, ended, strict=True)
    ]
    further = [
        i
        for i, each in enumerate(settled)
        if not asked[i].scheme.monotone and each.code not in CUT and (each.code is Status.CONVERGED or not sharpen)
    ]
    raised = [nested.raised(settled[i].task, settled[i].assumptions, asked[i].scheme) for i in further]
    better = _iterate(
        [task for task, _ in raised], [settled[i].state.value for i in further], [names[i] for i in further], clock
    )
    for i, (task, assumptions), end in zip(further, raised, better, strict=True):
        sharp = Settled(task, assumptions, settled[i].reached, *end, settled[i])
        settled[i] = nested.better_of(settled[i], sharp, sharpen=sharpen)
    solutions = [finish(each, on.grid, cut=clock.over() is not None) for each, on in zip(settled, asked, strict=True)]
    about = {"seconds": clock.elapsed() - began, "lanes": len(lanes), "tol": tol}
    for on, solution in zip(asked, solutions, strict=True):
        solution.stats.update(method=method.described(on.problem.is_game), **about)
    return [with_last_phase(each, clock) if each.status in CUT else each for each in solutions]


def _iterate(
    tasks: Sequence[Task], starts: Sequence[Nodes], names: Sequence[int], clock: Clock
) -> list[tuple[State, Status, np.ndarray]]:
    """The last state, the status and the residuals of each lane; lanes whose tasks share a structure run together."""
    found: list[Any] = [None] * len(tasks)
    # lanes whose certificates differ stop by different rules, which are part of the structure
    for members in _groups(jax.tree.structure(task) for task in tasks):
        run = LanesRun(_stack([tasks[i] for i in members]), _stack([starts[i] for i in members]), clock.max_steps)
        run.name = f"lanes {names[members[0]]} to {names[members[-1]]}, {tasks[0].grid.size} nodes each"
        run.between(host_loop.drive(run, clock), clock)  # once more, for lanes that were cut short
        for i, (state, code), residuals in zip(members, run.final, run.histories, strict=True):
            # a run that ended before its first look still holds the guess as it came
            state = with_obstacles(tasks[i], state) if code in CUT else state
            found[i] = state, code, np.concatenate(residuals)[: int(state.step) + 1]
    return found


def _settled(settled: Settled, clock: Clock) -> Settled:
    """The end of one lane, which may go on by itself: off a node where it rests, or by vanishing discounts."""
    task, assumptions, reached, state, code, history, *_ = settled
    if code in CUT or not nested.may_go_on(task, assumptions, state, code):
        return settled
    # an answer, and a game that failed, go on from where they are; whoever was caught at rest starts anew, by the
    # answers for vanishing discounts
    onwards = code is Status.CONVERGED or task.problem.is_game
    settled = nested.settle(task, assumptions, reached, state.value if onwards else None, clock)
    return settled._replace(residuals=np.concatenate([history, settled.residuals])) if onwards else settled


class Rows(NamedTuple):
    """The rows of the arrays in which lanes run together; one value, so that an interrupt finds all of it or none."""

    lanes: np.ndarray  # which lane each row holds; −1 in rows that only fill up
    tasks: Task
    states: State
    before: np.ndarray  # the steps of each row before the last chunk


class LanesRun:
    """The iterations of lanes that run together; those that are done are taken out where that halves the work."""

    longest, bar = CHUNK, {"desc": "solve_batch", "unit": " steps"}

    def __init__(self, tasks: Task, starts: Array, limit: int):
        count, self.name = len(starts), f"{len(starts)} lanes"
        self.rows = Rows(np.arange(count), tasks, _begin(tasks, starts), np.full(count, -1))
        self.limit, self.steps = limit, -1
        self.final: list[Any] = [None] * count  # the last state and the status of each lane
        self.histories: list[list] = [[np.zeros(0)] for _ in range(count)]

    @property
    def nodes(self) -> int:
        """The nodes of all rows: the loop runs over those that only fill up as well."""
        return self.rows.states.value.size

    def compile(self) -> None:
        """Run no step."""
        rows = self.rows
        self.rows = rows._replace(states=_run(rows.tasks, rows.states, rows.before))

    def first_chunk(self, clock: Clock) -> int:
        """Steps of the first chunk: nothing has been timed yet."""
        return int(np.clip(FIRST_NODES / self.nodes, 1, CHUNK))

    def advance(self, count: int) -> Status:
        """Take ``count`` steps at most in every row; the loop runs as long as its slowest lane."""
        rows, before = self.rows, np.asarray(self.rows.states.step)
        # an array: rows that are done stand where they stopped
        until = np.minimum(np.maximum(before, 0) + count, self.limit)
        self.rows = rows._replace(states=jax.block_until_ready(_run(rows.tasks, rows.states, until)), before=before)
        self.steps += max(int(np.max(np.asarray(self.rows.states.step) - before)), 1)
        return Status.RUNNING

    def between(self, status: Status, clock: Clock) -> Status:
        """Take out the lanes that are done, with all of them CONVERGED; one that is cut short ends them all."""
        rows = self.rows
        if not rows.lanes.size:
            return status
        codes, steps, history = jax.device_get((rows.states.code, rows.states.step, rows.states.history))
        going = (codes == Status.RUNNING) & (steps < self.limit) & (status is Status.RUNNING)
        live = [row for row, lane in enumerate(rows.lanes) if lane >= 0 and self.final[lane] is None]
        for row in live:
            self._note(rows.lanes[row], history[row, : steps[row] - rows.before[row]], steps[row] + 1)
        ended = [row for row in live if not going[row]]
        if ended:
            on_host = jax.device_get(rows.states)
            for row in ended:
                # copied, or a view would keep the arrays of all lanes alive
                last = jax.tree.map(lambda leaf, row=row: leaf[row].copy(), on_host)
                own = Status(int(last.code))
                cut = status if status is not Status.RUNNING else Status.MAX_STEPS
                self.final[rows.lanes[row]] = last, own if own is not Status.RUNNING else cut
        self._narrow(np.flatnonzero(going & (rows.lanes >= 0)))
        return status if self.rows.lanes.size else Status.CONVERGED

    def _note(self, lane: int, chunk: np.ndarray, residuals: int) -> None:
        """Write down the residuals of a lane's last chunk, so that there are so many of them: once."""
        missing = residuals - sum(map(len, self.histories[lane]))
        self.histories[lane].append(chunk[len(chunk) - missing :])

    def _narrow(self, left: np.ndarray) -> None:
        """Go on with these rows alone, where that halves the work."""
        rows, before = self.rows, np.asarray(self.rows.states.step)
        # powers of two, since every width is compiled for itself: a thousand lanes take eleven programs at most
        width = 1 << (left.size - 1).bit_length() if left.size else 0
        if width < rows.lanes.size:
            kept = np.resize(left, width)
            lanes = np.where(np.arange(width) < left.size, rows.lanes[kept], -1)
            rows, before = Rows(lanes, _take(rows.tasks, kept), _take(rows.states, kept), before[kept]), before[kept]
        self.rows = rows._replace(before=before)

    def show(self, bar: Any) -> None:
        """Move the progress bar."""
        bar.update(max(self.steps, 0) - bar.n)

    def keep(self, error: Exception) -> None:
        """Nothing: the lanes that were done before this round are what is left."""


def _stack(trees: Sequence[T]) -> T:
    """One tree of trees of one structure, with a leading axis of lanes in every leaf."""
    return jax.tree.map(lambda *leaves: jnp.stack(jnp.broadcast_arrays(*leaves)), *trees)


def _take(tree: T, rows: np.ndarray) -> T:
    """The rows of every leaf."""
    return jax.tree.map(lambda leaf: leaf[rows], tree)
