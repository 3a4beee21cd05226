"""A solve in chunks of steps, of one problem or of lanes of one ``vmap``ped loop, with the residuals of all steps."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import on_part, over_nodes
from hjbjax.iteration import fixed_point
from hjbjax.iteration.fixed_point import HISTORY, State, Task
from hjbjax.problem.parts import Lanes, Parts, spans_processes
from hjbjax.problem.pytree import altered
from hjbjax.problem.types import Array, Nodes, Number
from hjbjax.solution.checkpoints import check_alike
from hjbjax.solution.clock import CHUNK_SECONDS, CUT, Clock
from hjbjax.solution.status import Status
from hjbjax.solvers import host_loop
from hjbjax.solvers.host_loop import FIRST_NODES, WideJit
from hjbjax.tracing import checks

T = TypeVar("T")
CHUNK = 8  # steps between two looks at which lanes are done, at most
MANY_NODES = 2_000_000  # beyond which the look at the guess is a chunk of its own: a step may take many times as long

# a state is used once: the next one takes its place in memory
run = WideJit(fixed_point.run, donate_argnames="state")
# where Python is called on the way, and may raise, the state before must outlast it
_run_kept = WideJit(fixed_point.run)
_begin = jax.vmap(fixed_point.begin)


@functools.partial(WideJit, static_argnames="over")
def _run_lanes(tasks: Task, states: State, until: Array, over: Lanes) -> State:
    """``fixed_point.run`` for lanes that run together, those of every device by themselves."""
    # under vmap a loop goes on until its last lane is done; lanes that are done keep their state by a select and pay
    # for the others' steps all the same, hence the short chunks
    each = over.in_turn if over.on_processors else jax.vmap
    return over.mapped(each(fixed_point.run))(tasks, states, until)


@functools.partial(WideJit, static_argnames="parts", donate_argnames="state")
def _run_in_parts(task: Task, state: State, until: Number, parts: Parts) -> State:
    """``fixed_point.run`` on every device of a mesh at once, each with its own nodes."""

    def here(task: Task, state: State, until: Number) -> State:
        return fixed_point.run(on_part(task, parts), state, until)

    over = over_nodes(task, parts.entries), state_over_nodes(state), False
    return parts.mapped(here, over, over[1])(task, state, until)


def state_over_nodes(state: State) -> State:
    """The leaves of a state that hold a value at every node, as truth values."""
    # where V alone is kept the policy has no nodes
    value, policy = jax.tree.map(lambda leaf: jnp.ndim(leaf) > 0, (state.value, state.policy))
    return altered(jax.tree.map(lambda _: False, state), value=value, policy=policy)


def iterate(task: Task, guess: Nodes, clock: Clock, most: int | None = None) -> tuple[State, Status, np.ndarray]:
    """Iterate from a guess in chunks of steps until the state stops, the steps or the time run out, or Ctrl-C.

    Args:
      task: what to iterate.
      guess: node values to start from.
      clock: the limits, and where the time goes.
      most: at most so many steps, if fewer than the clock allows: the way to another guess is worth few of them.

    Returns:
      The last state, how it ended, and the residuals of all steps, that of the guess first.
    """
    limit = clock.max_steps if most is None else min(most, clock.max_steps)
    parts = task.on.parts
    iteration = StationaryRun(task, guess, limit) if parts is None else RunInParts(task, guess, limit, parts)
    if most is not None:
        iteration.name += ", on the way to a guess"
        iteration.passing = most <= clock.max_steps
    status, state = host_loop.drive(iteration, clock), iteration.gathered()
    # a run that ended before its first look still holds the guess as it came
    if status is Status.NONFINITE or status in CUT:
        state = with_obstacles(task, state)
    return state, status, np.concatenate(iteration.residuals)[: int(state.step) + 1]


def with_obstacles(task: Task, state: State) -> State:
    """The state with what is given at its nodes, which a guess that nobody looked at does not have."""
    return dataclasses.replace(state, value=task.obstacles.impose(jnp.asarray(state.value)))


class StatesInChunks:
    """An iteration whose state holds all there is: the last one, and the one before the chunk that is running.

    Args:
      task: what is iterated, with ``grid`` and ``tol``.
      state: where it begins, at step −1, with ``step``, ``code``, ``history``, ``bound`` and ``value``.
      run: from a task, a state and a number of steps to the state then; it may donate the state.
      guess: the value to fall back on.
      limit: of the steps.
    """

    longest = HISTORY  # a chunk records the residuals of so many steps
    passing = False

    def __init__(self, task: Any, state: Any, run: Callable[..., Any], guess: Nodes, limit: int):
        self.task, self.guess, self.limit = task, guess, limit
        self.state = self.before = state
        self.residuals, self.steps = [np.zeros(0)], -1
        self.nodes, self.name = task.grid.size, f"{' x '.join(map(str, task.grid.shape))} nodes"
        self.bar = {"desc": "solve", "unit": " steps"}
        self._run = run

    def compile(self) -> None:
        """Run no step: the state is at step −1, before the look at the guess."""
        self.before, self.state = self.state, self._run(self.task, self.state, -1)

    def advance(self, count: int) -> Status:
        """Take ``count`` steps at most; the look at the guess comes with the first of them."""
        until = int(min(max(self.steps, 0) + count, self.limit))
        # in one assignment: an interrupt may come from here on, and the state before may be donated
        self.before, self.state = self.state, self._run(self.task, self.state, until)
        status = Status(int(self.state.code))
        self._note()
        return status

    def _note(self) -> None:
        """Write down the residuals of the last chunk, once."""
        done = int(self.state.step)
        self.residuals.append(np.asarray(self.state.history)[: done - self.steps])
        self.steps = done

    def between(self, status: Status, clock: Clock) -> Status:
        """Write down what an interrupt left open."""
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
        """Go on from a state that was saved.

        Raises:
          ValueError: the arrays are not a state of this run, with one residual per step and one before the first.
        """
        residuals, *leaves = arrays
        check_alike(leaves, jax.tree.leaves(self.gathered()))
        # copied to the device: a state is donated
        on_device = [jax.device_put(leaf, may_alias=False) for leaf in leaves]
        state = jax.tree.unflatten(jax.tree.structure(self.state), on_device)
        check_alike([residuals], [np.broadcast_to(0.0, int(state.step) + 1)])
        Status(int(state.code))
        self.before = self.state = state
        self.residuals, self.steps = [residuals], int(state.step)

    def show(self, bar: Any) -> None:
        """Move the progress bar; the look is no step."""
        bar.update(max(self.steps, 0) - bar.n)
        error, tol = float(self.state.bound.error), float(self.task.tol)
        bar.set_postfix_str(f"error {error:.2e}, tol {tol:.0e}", refresh=False)

    def keep(self, error: Exception) -> None:
        """Attach the value to an exception: of the step that failed, the one before unless donated, the guess."""
        host_loop.keep(error, self.task.grid, lambda: self.state.value, lambda: self.before.value, lambda: self.guess)


class StationaryRun(StatesInChunks):
    """The iteration of a task of the chain, or of one with slopes of high order behind it."""

    def __init__(self, task: Task, guess: Nodes, limit: int):
        task = altered(task, on=task.on.settled)
        super().__init__(task, fixed_point.begin(task, guess), _run_kept if _calls_back(task) else run, guess, limit)

    def first_chunk(self, clock: Clock) -> int:
        """Steps of the first chunk on this grid, before any is timed there, beside the look at the guess.

        A coarser grid tells what they take; a finer one may fall out of the cache, hence half a chunk's time. One alone
        where a step may take many passes over the nodes, and more of them on a finer grid.
        """
        evaluation = self.task.method.evaluation
        # the look is one pass over the nodes, a step with a linear solve hundreds: it is timed before one is begun
        if clock.per_node is None and self.nodes > MANY_NODES:
            return 0
        # a Krylov or direct solve takes more passes on finer grids, and so do the replies of a game: what a step took
        # on a coarser grid says nothing
        if self.task.problem.is_game or (evaluation is not None and not evaluation.rough):
            return 1
        if clock.per_node is None:
            steps = FIRST_NODES / self.nodes
        else:
            steps = clock.steps_in(min(CHUNK_SECONDS / 2, clock.seconds - clock.elapsed()), self.nodes)
        return int(np.clip(steps, 1, HISTORY - 1))  # one place of the history is the look's


class RunInParts(StationaryRun):
    """The iteration of a task whose nodes are divided over many devices."""

    def __init__(self, task: Task, guess: Nodes, limit: int, parts: Parts):
        super().__init__(task, guess, limit)
        self.grid, self.parts, self._over = task.grid, parts, state_over_nodes(self.state)
        self.task = parts.spread(self.task, over_nodes(self.task, task.grid.shape))
        self.before = self.state = parts.spread(self.state, self._over)
        self._run = functools.partial(_run_in_parts, parts=parts)

    def gathered(self) -> State:
        """The last state, with the values of all parts."""
        return self.parts.gathered(self.state, self._over)

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Go on from a state that was saved, by whatever number of devices."""
        super().restore(arrays)
        self.before = self.state = self.parts.spread(self.state, self._over)

    def keep(self, error: Exception) -> None:
        """Attach the value to an exception, as without parts."""
        # what other processes hold is out of reach: they may not have come to this exception
        states = () if spans_processes(self.parts.mesh) else (self.state, self.before)
        values = (lambda s=s: self.parts.gathered(s, self._over).value for s in states)
        host_loop.keep(error, self.grid, *values, lambda: self.guess)


def _calls_back(task: Task) -> bool:
    """True if a step calls Python on the host, be it for a solve or in a function of the user's."""
    evaluation = task.method.evaluation
    return (evaluation is not None and evaluation.calls_back) or checks.calls_back(task.problem, task.grid.ndim)


class Rows(NamedTuple):
    """The rows of the arrays in which lanes run together; one value, so that an interrupt finds all of it or none."""

    lanes: np.ndarray  # which lane each row holds; −1 in rows that only fill up
    tasks: Task
    states: State
    before: np.ndarray  # the steps of each row before the last chunk


class LanesRun:
    """The iterations of lanes that run together; those that are done are taken out where that halves the work."""

    longest, bar = CHUNK, {"desc": "solve_batch", "unit": " steps"}

    def __init__(self, tasks: Task, starts: Array, limit: int, over: Lanes):
        count, self.name, self.over = len(starts), f"{len(starts)} lanes", over
        states, lanes = _begin(tasks, starts), np.arange(over.filled(count))
        if lanes.size > count:  # every device takes as many rows
            (tasks, states), lanes = _take((tasks, states), lanes % count), np.where(lanes < count, lanes, -1)
        self.rows = Rows(lanes, *over.spread((tasks, states)), np.full(lanes.size, -1))
        self.limit, self.steps = limit, -1
        self.final: list[Any] = [None] * count  # the last state and the status of each lane
        self.histories: list[list] = [[np.zeros(0)] for _ in range(count)]

    @property
    def nodes(self) -> int:
        """The nodes of all rows: the loop runs over those that only fill up as well."""
        return self.rows.states.value.size

    def _run(self, until: np.ndarray) -> State:
        """The states when so many steps of each row are done, or it is."""
        return _run_lanes(self.rows.tasks, self.rows.states, self.over.spread(until), self.over)

    def compile(self) -> None:
        """Run no step."""
        self.rows = self.rows._replace(states=self._run(self.rows.before))

    def first_chunk(self, clock: Clock) -> int:
        """Steps of the first chunk: nothing has been timed yet."""
        return int(np.clip(FIRST_NODES / self.nodes, 1, CHUNK))

    def advance(self, count: int) -> Status:
        """Take ``count`` steps at most in every row; the loop runs as long as its slowest lane."""
        before = self.over.gathered(self.rows.states.step)
        # an array: rows that are done stand where they stopped
        until = np.minimum(np.maximum(before, 0) + count, self.limit)
        self.rows = self.rows._replace(states=jax.block_until_ready(self._run(until)), before=before)
        self.steps += max(int(np.max(self.over.gathered(self.rows.states.step) - before)), 1)
        return Status.RUNNING

    def between(self, status: Status, clock: Clock) -> Status:
        """Take out the lanes that are done, with all of them CONVERGED; one that is cut short ends them all."""
        rows = self.rows
        if not rows.lanes.size:
            return status
        codes, steps, history = self.over.gathered((rows.states.code, rows.states.step, rows.states.history))
        going = (codes == Status.RUNNING) & (steps < self.limit) & (status is Status.RUNNING)
        live = [row for row, lane in enumerate(rows.lanes) if lane >= 0 and self.final[lane] is None]
        for row in live:
            self._note(rows.lanes[row], history[row, : steps[row] - rows.before[row]], steps[row] + 1)
        ended = [row for row in live if not going[row]]
        if ended:
            on_host = self.over.gathered(rows.states)
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
        rows, over, before = self.rows, self.over, self.over.gathered(self.rows.states.step)
        # powers of two, since every width is compiled for itself: a thousand lanes take eleven programs at most
        width = over.filled(1 << (left.size - 1).bit_length()) if left.size else 0
        if width < rows.lanes.size:
            kept, before = np.resize(left, width), before[np.resize(left, width)]
            lanes = np.where(np.arange(width) < left.size, rows.lanes[kept], -1)
            both = rows.tasks, rows.states
            if over.mesh is not None:  # by way of the host: rows go to other devices
                both = over.gathered(both)
            rows = Rows(lanes, *over.spread(_take(both, kept)), before)
        self.rows = rows._replace(before=before)

    def show(self, bar: Any) -> None:
        """Move the progress bar."""
        bar.update(max(self.steps, 0) - bar.n)

    passing = False

    def saved(self) -> list[Any]:
        """Nothing: lanes that run together have no checkpoint."""
        return []

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Nothing, likewise."""

    def keep(self, error: Exception) -> None:
        """Nothing: the lanes that were done before this round are what is left."""


def stacked(trees: Sequence[T]) -> T:
    """One tree of trees of one structure, with a leading axis of lanes in every leaf."""
    return jax.tree.map(lambda *leaves: jnp.stack(jnp.broadcast_arrays(*leaves)), *trees)


def _take(tree: T, rows: np.ndarray) -> T:
    """The rows of every leaf."""
    return jax.tree.map(lambda leaf: leaf[rows], tree)
