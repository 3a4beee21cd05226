"""The host's loop around the jitted iteration.

``run`` is called in chunks of about half a second, since every call takes its memory anew; progress, Ctrl-C, time
limits and stops at NaN all live between two chunks. A first call of no steps compiles, so that the others can be timed.
"""

import contextlib
import dataclasses
import sys
import time
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.iteration import fixed_point
from hjbjax.iteration.fixed_point import HISTORY, State, Task
from hjbjax.problem.types import Nodes
from hjbjax.solution.clock import CHUNK_SECONDS, CUT, Clock
from hjbjax.solution.status import Status
from hjbjax.solvers import faults
from hjbjax.tracing import checks

FIRST_NODES = 20_000  # a first chunk steps over about so many nodes
MANY_NODES = 2_000_000  # beyond which the look at the guess is a chunk of its own: a step may take many times as long

# a state is used once: the next one takes its place in memory
run = jax.jit(fixed_point.run, donate_argnames="state")
# where Python is called on the way, and may raise, the state before must outlast it
_run_kept = jax.jit(fixed_point.run)


def drive(task: Task, guess: Nodes, clock: Clock, most: int | None = None) -> tuple[State, Status, np.ndarray]:
    """Run a task in chunks of steps until its state stops, the steps or the time run out, or Ctrl-C.

    Args:
      task: what to iterate.
      guess: node values to start from.
      clock: the limits, and where the time goes.
      most: at most so many steps, if fewer than the clock allows.

    Returns:
      The last state, how it ended, and the residuals of all steps, that of the guess first.
    """
    # a way to a guess, as by a vanishing discount, is worth few steps, whatever the solve may take
    limit = clock.max_steps if most is None else min(most, clock.max_steps)
    state, residuals, nodes = fixed_point.begin(task, guess), [np.zeros(0)], " x ".join(map(str, task.grid.shape))
    code = clock.over()
    if code is not None:
        return with_obstacles(task, state), code, residuals[0]
    chunk, done, code = _first_chunk(task, clock), -1, Status.RUNNING  # step −1 is the look at the guess
    step, before = (_run_kept if _calls_back(task) else run), state
    clock.phase = f"compiling for {nodes} nodes"
    with _bar(clock.progress, float(task.tol)) as show:
        try:
            before, state = state, step(task, state, -1)  # compiles and does nothing
            while code is Status.RUNNING:
                began = time.perf_counter()
                code = _stop_status(clock, done, limit, task.grid.size)
                if code is not Status.RUNNING:
                    break
                clock.phase = f"step {done + 1} on {nodes} nodes" + ", on the way to a guess" * (most is not None)
                # the look at the guess, step −1, comes with the first chunk unless that is of no steps
                until = min(max(done, 0) + chunk, limit)
                # in one assignment: an interrupt may come from here on, and the state before may be donated
                before, state = state, step(task, state, int(until))
                code, steps = Status(int(state.code)), int(state.step) - done
                residuals.append(np.asarray(state.history)[:steps])
                clock.count(time.perf_counter() - began, steps, task.grid.size)
                # a chunk records the residuals of HISTORY steps at most; a short one is timed badly, hence the 8
                chunk = int(np.clip(clock.steps_in(CHUNK_SECONDS, task.grid.size), 1, min(HISTORY, 8 * max(chunk, 1))))
                show(steps - (done < 0), float(state.bound.error))  # the look is no step
                done += steps
        except KeyboardInterrupt:  # the second one, or by a handler of the user's own
            clock.interrupted, code = True, Status.INTERRUPTED
            residuals.append(np.asarray(state.history)[: int(state.step) - done])  # of steps not yet written down
        except Exception as error:
            # the state of the step that failed, the one before unless it was donated, and what it all began with
            faults.keep(error, task.grid, lambda: state.value, lambda: before.value, lambda: guess)
            raise
    # a run that ended before its first look still holds the guess as it came
    if code is Status.NONFINITE or code in CUT:
        state = with_obstacles(task, state)
    return state, code, np.concatenate(residuals)[: int(state.step) + 1]


def _calls_back(task: Task) -> bool:
    """True if a step calls Python on the host, be it for a solve or in a function of the user's."""
    evaluation = task.method.evaluation
    return (evaluation is not None and evaluation.calls_back) or checks.calls_back(task.problem, task.grid.ndim)


def _stop_status(clock: Clock, done: int, limit: int, nodes: int) -> Status:
    """The status that forbids another chunk, else RUNNING; a step that the last pace makes too late is not begun."""
    code = clock.over()
    # one step on a large grid may take minutes, and nothing can cut it
    if code is None and clock.per_node is not None and clock.steps_in(clock.seconds - clock.elapsed(), nodes) < 1:
        code = Status.TIME_LIMIT
    # the steps that were asked for are done: that comes before a time limit, but not before Ctrl-C
    if done >= limit and code is not Status.INTERRUPTED:
        return Status.MAX_STEPS
    return Status.RUNNING if code is None else code


def _first_chunk(task: Task, clock: Clock) -> int:
    """Steps of the first chunk on this grid, before any is timed there, beside the look at the guess.

    A coarser grid tells what they take; a finer one may fall out of the cache, hence half a chunk's time. One alone
    where a step may take many passes over the nodes, and more of them on a finer grid.
    """
    method, nodes = task.method, task.grid.size
    # the look is one pass over the nodes, a step with a linear solve hundreds: it is timed before one is begun
    if clock.per_node is None and nodes > MANY_NODES:
        return 0
    evaluation = method.evaluation
    # a Krylov or direct solve takes more passes on finer grids, and so do the replies of a game: what a step took on a
    # coarser grid says nothing
    if task.problem.is_game or (evaluation is not None and not evaluation.rough):
        return 1
    if clock.per_node is None:
        steps = FIRST_NODES / nodes
    else:
        steps = clock.steps_in(min(CHUNK_SECONDS / 2, clock.seconds - clock.elapsed()), nodes)
    return int(np.clip(steps, 1, HISTORY - 1))  # one place of the history is the look's


def with_obstacles(task: Task, state: State) -> State:
    """The state with what is given at its nodes, which a guess that nobody looked at does not have."""
    return dataclasses.replace(state, value=task.obstacles.impose(jnp.asarray(state.value)))


@contextlib.contextmanager
def _bar(progress: bool | None, tol: float) -> Iterator[Callable[[int, float], None]]:
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


@contextlib.contextmanager
def ticker(progress: bool | None, total: float, what: str) -> Iterator[Callable[[float, int], None]]:
    """A progress bar over the problem's own time; ``show(done, steps)`` moves it."""
    if progress is False or (progress is None and not sys.stderr.isatty()):
        yield lambda done, steps: None
        return
    from tqdm import tqdm

    form = "{desc}: {percentage:3.0f}% |{bar}| t {n:.3g} of {total:.3g}{postfix} [{elapsed}<{remaining}]"
    with tqdm(desc=what, total=total, delay=1, leave=False, bar_format=form) as bar:

        def show(done, steps):
            bar.update(done - bar.n)
            bar.set_postfix_str(f"{steps} steps", refresh=False)

        yield show
