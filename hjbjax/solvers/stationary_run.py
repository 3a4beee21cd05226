"""A solve in chunks of steps: the jitted iteration from a guess to its end, with the residuals of all steps."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.iteration import fixed_point
from hjbjax.iteration.fixed_point import HISTORY, State, Task
from hjbjax.problem.types import Nodes
from hjbjax.solution.clock import CHUNK_SECONDS, CUT, Clock
from hjbjax.solution.status import Status
from hjbjax.solvers import host_loop
from hjbjax.solvers.host_loop import FIRST_NODES
from hjbjax.tracing import checks

MANY_NODES = 2_000_000  # beyond which the look at the guess is a chunk of its own: a step may take many times as long

# a state is used once: the next one takes its place in memory
run = jax.jit(fixed_point.run, donate_argnames="state")
# where Python is called on the way, and may raise, the state before must outlast it
_run_kept = jax.jit(fixed_point.run)


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
    iteration = StationaryRun(task, guess, clock.max_steps if most is None else min(most, clock.max_steps))
    if most is not None:
        iteration.name += ", on the way to a guess"
    status, state = host_loop.drive(iteration, clock), iteration.state
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


def _calls_back(task: Task) -> bool:
    """True if a step calls Python on the host, be it for a solve or in a function of the user's."""
    evaluation = task.method.evaluation
    return (evaluation is not None and evaluation.calls_back) or checks.calls_back(task.problem, task.grid.ndim)
