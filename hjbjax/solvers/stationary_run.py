"""A solve in chunks of steps, for one problem or for lanes of one ``vmap``ped loop, with all residuals."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.iteration import fixed_point
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.iteration.progress import HISTORY
from hjbjax.problem.grid import tabulated
from hjbjax.problem.layouts import Lanes, Layout
from hjbjax.problem.pytree import altered
from hjbjax.problem.types import Array, Nodes, Number
from hjbjax.solution.checkpoints import check_alike
from hjbjax.solution.clock import CHUNK_SECONDS, CUT, Clock
from hjbjax.solution.status import Status
from hjbjax.solvers import host_loop
from hjbjax.solvers.host_loop import FIRST_NODES, WideJit
from hjbjax.tracing import checks

T = TypeVar("T")
CHUNK = 8  # largest number of steps between two checks of which lanes are done
MANY_NODES = 2_000_000  # above which the initial evaluation is its own chunk, since a step may take far longer

# a state is used once: the next one reuses its memory
run = WideJit(fixed_point.run, donate_argnames="state")
# if Python is called from the program, which may raise, the previous state must survive
_run_kept = WideJit(fixed_point.run)
_start = jax.vmap(fixed_point.start)


@functools.partial(WideJit, static_argnames="over")
def _run_lanes(tasks: Task, states: State, until: Array, over: Lanes) -> State:
    """``fixed_point.run`` for lanes that run together, separately on every device."""
    # under vmap a loop runs until its last lane is done; lanes that are done keep their state by a select and still pay
    # for the others' steps, so chunks are short
    each = over.in_turn if over.on_processors else jax.vmap
    return over.mapped(each(fixed_point.run))(tasks, states, until)


@functools.partial(WideJit, static_argnames="parts", donate_argnames="state")
def _run_in_parts(task: Task, state: State, until: Number, parts: Layout) -> State:
    """``fixed_point.run`` on all devices of a mesh, each with its own nodes."""

    def here(task: Task, state: State, until: Number) -> State:
        return fixed_point.run(task.on_part(parts), state, until)

    over = task.over_nodes(parts.entries), state_over_nodes(state), False
    return parts.mapped(here, over, over[1])(task, state, until)


def state_over_nodes(state: State) -> State:
    """Mark the leaves of a state that have a value at every node."""
    # if only V is stored the policy has no nodes
    value, policy = jax.tree.map(lambda leaf: jnp.ndim(leaf) > 0, (state.value, state.policy))
    return altered(jax.tree.map(lambda _: False, state), value=value, policy=policy)


def iterate(task: Task, guess: Nodes, clock: Clock, most: int | None = None) -> tuple[State, Status, np.ndarray]:
    """Iterate from a guess in chunks until the state stops, the limit of steps or time is reached, or Ctrl-C.

    Args:
      task: the task.
      guess: initial node values.
      clock: the limits, and the pace.
      most: the largest number of steps, if less than the clock allows, for iterations that only improve a guess.

    Returns:
      The last state, its status, and the residuals of all steps, starting with the guess.
    """
    limit = clock.max_steps if most is None else min(most, clock.max_steps)
    iteration = _iteration(task, guess, limit)
    if most is not None:
        iteration.name += ", computing a guess"
        iteration.passing = most <= clock.max_steps
    status, state = host_loop.drive(iteration, clock), iteration.gathered()
    # a run that ended before it evaluated the guess still contains it as it was given
    if status is Status.NONFINITE or status in CUT:
        state = with_obstacles(task, state)
    return state, status, np.concatenate(iteration.residuals)[: int(state.progress.evaluations)]


def evaluated_state(task: Task, value: Nodes) -> State:
    """The state of a value after its evaluation, by the program of the iteration, on any devices and at any time."""
    iteration = _iteration(task, value, 0)
    iteration.advance(1)
    return iteration.gathered()


def _iteration(task: Task, guess: Nodes, limit: int) -> "StationaryRun":
    """The run of a task from a guess, on one device or on several."""
    return (RunInParts if task.division.axes else StationaryRun)(task, guess, limit)


def with_obstacles(task: Task, state: State) -> State:
    """The state with fixed values inserted, which a guess that was not evaluated may lack."""
    return dataclasses.replace(state, value=task.obstacles.impose(jnp.asarray(state.value)))


class StatesInChunks:
    """An iteration that is described by its state: the last one, and the one before the current chunk.

    Args:
      task: the task, with ``grid`` and ``tol``.
      state: the state of the guess, with ``progress``, ``bound`` and ``value``.
      run: a function from a task, a state and a total number of evaluations to the new state; may donate the state.
      guess: the value to fall back on.
      limit: the largest number of steps.
    """

    longest = HISTORY  # a chunk records this number of residuals
    passing = False

    def __init__(self, task: Any, state: Any, run: Callable[..., Any], guess: Nodes, limit: int):
        self.task, self.guess, self.limit = task, guess, limit
        self.state = self.before = state
        self.residuals, self.evaluations = [np.zeros(0)], 0
        self.nodes, self.name = task.grid.size, f"{' x '.join(map(str, task.grid.shape))} nodes"
        self.bar = {"desc": "solve", "unit": " steps"}
        self._run = run

    @property
    def steps(self) -> int:
        """The number of completed steps; the evaluation of the guess is not a step."""
        return max(self.evaluations - 1, 0)

    def compile(self) -> None:
        """Call the program without an evaluation."""
        self.before, self.state = self.state, self._run(self.task, self.state, 0)

    def advance(self, count: int) -> Status:
        """Evaluate at most ``count`` values: the guess, if it has not been evaluated, and one per step."""
        until = int(min(self.evaluations + count, self.limit + 1))
        # in one assignment: an interrupt may come at any time, and the previous state may have been donated
        self.before, self.state = self.state, self._run(self.task, self.state, until)
        status = Status(int(self.state.progress.code))
        self._note()
        return status

    def _note(self) -> None:
        """Record the residuals of the last chunk, once."""
        progress = self.state.progress
        done = int(progress.evaluations)
        self.residuals.append(np.asarray(progress.history)[: done - self.evaluations])
        self.evaluations = done

    def between(self, status: Status, clock: Clock) -> Status:
        """Record the residuals that an interrupt left unrecorded."""
        if status is Status.INTERRUPTED:
            self._note()
        return status

    def gathered(self) -> Any:
        """The last state, with values at all nodes."""
        return self.state

    def saved(self) -> list[Any]:
        """The residuals so far and the leaves of the state."""
        return [np.concatenate(self.residuals), *jax.tree.leaves(self.gathered())]

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Continue from a saved state.

        Raises:
          ValueError: the arrays are not a state of this run, with one residual per evaluation.
        """
        residuals, *leaves = arrays
        check_alike(leaves, jax.tree.leaves(self.gathered()))
        # copied to the device, because a state is donated
        on_device = [jax.device_put(leaf, may_alias=False) for leaf in leaves]
        state = jax.tree.unflatten(jax.tree.structure(self.state), on_device)
        evaluations = int(state.progress.evaluations)
        check_alike([residuals], [np.broadcast_to(0.0, evaluations)])
        Status(int(state.progress.code))
        self.before = self.state = state
        self.residuals, self.evaluations = [residuals], evaluations

    def show(self, bar: Any) -> None:
        """Advance the progress bar."""
        bar.update(self.steps - bar.n)
        error, tol = float(self.state.bound.error), float(self.task.tol)
        bar.set_postfix_str(f"error {error:.2e}, tol {tol:.0e}", refresh=False)

    def keep(self, error: Exception) -> None:
        """Attach the best available value to an exception: of the last state, the previous state, or the guess."""
        host_loop.keep(error, self.task.grid, lambda: self.state.value, lambda: self.before.value, lambda: self.guess)


class StationaryRun(StatesInChunks):
    """The iteration of a task of the chain, or of a high-order task based on it."""

    def __init__(self, task: Task, guess: Nodes, limit: int):
        task = altered(task, on=altered(task.on, grid=tabulated(task.grid)))
        super().__init__(task, fixed_point.start(task, guess), _run_kept if _calls_back(task) else run, guess, limit)

    def first_chunk(self, clock: Clock) -> int:
        """Evaluations of the first chunk on this grid, before any is timed there: a new guess, and some steps.

        The steps should take half the time of a chunk at the pace of a coarser grid, because a finer grid may exceed
        the cache. If a step takes many passes over the nodes, and more passes on a finer grid, only one step is made.
        """
        evaluation = self.task.method.evaluation
        guesses = int(self.evaluations == 0)  # a resumed state has been evaluated
        # the evaluation of the guess is one pass over the nodes, a step with a linear solve hundreds, so it is timed
        # separately
        if clock.per_node is None and self.nodes > MANY_NODES:
            return 1
        # a Krylov or direct solve takes more passes on finer grids, and so do the replies of a game: the time of a step
        # on a coarser grid does not predict them
        if self.task.problem.is_game or (evaluation is not None and not evaluation.rough):
            return guesses + 1
        if clock.per_node is None:
            steps = FIRST_NODES / self.nodes
        else:
            steps = clock.steps_in(min(CHUNK_SECONDS / 2, clock.seconds - clock.elapsed()), self.nodes)
        return guesses + int(np.clip(steps, 1, HISTORY - 1))


class RunInParts(StationaryRun):
    """The iteration of a task whose nodes are divided among several devices."""

    def __init__(self, task: Task, guess: Nodes, limit: int):
        super().__init__(task, guess, limit)
        parts = task.division
        self.grid, self.parts, self._over = task.grid, parts, state_over_nodes(self.state)
        self.task = parts.spread(self.task, self.task.over_nodes(task.grid.shape))
        self.before = self.state = parts.spread(self.state, self._over)
        self._run = functools.partial(_run_in_parts, parts=parts)

    def gathered(self) -> State:
        """The last state, with the values of all parts."""
        return self.parts.gathered(self.state, self._over)

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Continue from a saved state, on any number of devices."""
        super().restore(arrays)
        self.before = self.state = self.parts.spread(self.state, self._over)

    def keep(self, error: Exception) -> None:
        """Attach the value to an exception, as without parts."""
        # data in other processes is inaccessible, since they may not have raised this exception
        states = (self.state, self.before) if self.parts.is_local else ()
        values = (lambda s=s: self.parts.gathered(s, self._over).value for s in states)
        host_loop.keep(error, self.grid, *values, lambda: self.guess)


def _calls_back(task: Task) -> bool:
    """True if a step calls Python on the host, for a solve or in a function of the user."""
    evaluation = task.method.evaluation
    return (evaluation is not None and evaluation.calls_back) or checks.problem_calls_back(task.problem, task.grid.ndim)


class LaneRows(NamedTuple):
    """The rows of the arrays in which lanes run together; a single value, so that interrupts find it consistent."""

    lanes: np.ndarray  # the lane of each row; −1 in padding rows
    tasks: Task
    states: State
    before: np.ndarray  # number of evaluations of each row before the last chunk


class LanesRun:
    """The iterations of lanes that run together; finished lanes are removed when this halves the work."""

    longest, bar = CHUNK, {"desc": "solve_batch", "unit": " steps"}

    def __init__(self, tasks: Task, starts: Array, limit: int, over: Lanes):
        count, self.name, self.over = len(starts), f"{len(starts)} lanes", over
        states, lanes = _start(tasks, starts), np.arange(over.filled(count))
        if lanes.size > count:  # every device has the same number of rows
            (tasks, states), lanes = _take((tasks, states), lanes % count), np.where(lanes < count, lanes, -1)
        self.rows = LaneRows(lanes, *over.spread((tasks, states)), np.zeros(lanes.size, int))
        self.limit, self.steps = limit, 0
        self.final: list[Any] = [None] * count  # the last state and the status of each lane
        self.histories: list[list] = [[np.zeros(0)] for _ in range(count)]

    @property
    def nodes(self) -> int:
        """The nodes of all rows, including padding rows."""
        return self.rows.states.value.size

    def _run(self, until: np.ndarray) -> State:
        """The states after this number of evaluations per row, or when the row is done."""
        return _run_lanes(self.rows.tasks, self.rows.states, self.over.spread(until), self.over)

    def compile(self) -> None:
        """Call the program without an evaluation."""
        self.rows = self.rows._replace(states=self._run(self.rows.before))

    def first_chunk(self, clock: Clock) -> int:
        """Evaluations of the first chunk: the guesses, and some steps, as nothing has been timed yet."""
        return 1 + int(np.clip(FIRST_NODES / self.nodes, 1, CHUNK))

    def advance(self, count: int) -> Status:
        """Evaluate at most ``count`` values in every row; the loop runs as long as its slowest lane."""
        before = self._evaluations()
        # an array: finished rows keep their number of evaluations
        until = np.minimum(before + count, self.limit + 1)
        self.rows = self.rows._replace(states=jax.block_until_ready(self._run(until)), before=before)
        done = np.maximum(self._evaluations() - 1, 0) - np.maximum(before - 1, 0)
        self.steps += max(int(np.max(done)), 1)
        return Status.RUNNING

    def _evaluations(self) -> np.ndarray:
        """The number of evaluations of each row."""
        return self.over.gathered(self.rows.states.progress.evaluations)

    def between(self, status: Status, clock: Clock) -> Status:
        """Remove the finished lanes; CONVERGED when all are done; a lane that is cut short ends them all."""
        rows = self.rows
        if not rows.lanes.size:
            return status
        progress = self.over.gathered(rows.states.progress)
        codes, counts, history = progress.code, progress.evaluations, progress.history
        going = (codes == Status.RUNNING) & (counts <= self.limit) & (status is Status.RUNNING)
        live = [row for row, lane in enumerate(rows.lanes) if lane >= 0 and self.final[lane] is None]
        for row in live:
            self._note(rows.lanes[row], history[row, : counts[row] - rows.before[row]], counts[row])
        ended = [row for row in live if not going[row]]
        if ended:
            on_host = self.over.gathered(rows.states)
            for row in ended:
                # copied, because a view would keep the arrays of all lanes alive
                last = jax.tree.map(lambda leaf, row=row: leaf[row].copy(), on_host)
                own = Status(int(last.progress.code))
                cut = status if status is not Status.RUNNING else Status.MAX_STEPS
                self.final[rows.lanes[row]] = last, own if own is not Status.RUNNING else cut
        self._narrow(np.flatnonzero(going & (rows.lanes >= 0)))
        return status if self.rows.lanes.size else Status.CONVERGED

    def _note(self, lane: int, chunk: np.ndarray, residuals: int) -> None:
        """Append the residuals of a lane's last chunk, until this number of residuals is recorded."""
        missing = residuals - sum(map(len, self.histories[lane]))
        self.histories[lane].append(chunk[len(chunk) - missing :])

    def _narrow(self, left: np.ndarray) -> None:
        """Continue with these rows only, if this halves the work."""
        rows, over, before = self.rows, self.over, self._evaluations()
        # powers of two, since every width is compiled separately: a thousand lanes take at most eleven programs
        width = over.filled(1 << (left.size - 1).bit_length()) if left.size else 0
        if width < rows.lanes.size:
            kept, before = np.resize(left, width), before[np.resize(left, width)]
            lanes = np.where(np.arange(width) < left.size, rows.lanes[kept], -1)
            both = rows.tasks, rows.states
            if over.mesh is not None:  # through the host, because rows move to other devices
                both = over.gathered(both)
            rows = LaneRows(lanes, *over.spread(_take(both, kept)), before)
        self.rows = rows._replace(before=before)

    def show(self, bar: Any) -> None:
        """Move the progress bar."""
        bar.update(self.steps - bar.n)

    passing = False

    def saved(self) -> list[Any]:
        """Nothing: lanes that run together have no checkpoint."""
        return []

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Nothing: lanes that run together have no checkpoint."""

    def keep(self, error: Exception) -> None:
        """Nothing: the result consists of the lanes that finished before this round."""


def stack_lanes(trees: Sequence[T]) -> T:
    """Stack trees of the same structure, with a leading axis of lanes in every leaf."""
    return jax.tree.map(lambda *leaves: jnp.stack(jnp.broadcast_arrays(*leaves)), *trees)


def _take(tree: T, rows: np.ndarray) -> T:
    """The rows of every leaf."""
    return jax.tree.map(lambda leaf: leaf[rows], tree)
