"""The host's loop around the jitted iteration.

``run`` is called in chunks of about half a second, since every call takes its memory anew; progress, Ctrl-C, time
limits and stops at NaN all live between two chunks. A first call of no steps compiles, so that the others can be timed.
"""

import contextlib
import dataclasses
import signal
import sys
import threading
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import iteration
from hjbjax.iteration import HISTORY, State, Task
from hjbjax.relaxation import Direct, Krylov
from hjbjax.status import Status

CHUNK_SECONDS = 0.5
FIRST_NODES = 20_000  # a first chunk steps over about so many nodes

run = jax.jit(iteration.run, donate_argnames="state")  # a state is used once: the next one takes its place in memory


class Clock:
    """The limits of a solve, the time it has taken, that of its steps apart, and whether it was interrupted.

    ``per_node`` is the seconds that a step took at a node in the last chunk, from grid to grid; None before the first.
    """

    def __init__(self, max_steps: int, seconds: float, progress: bool | None):
        self.max_steps, self.seconds, self.progress = max_steps, seconds, progress
        self.began, self.stepping, self.interrupted = time.perf_counter(), 0.0, False
        self.per_node: float | None = None

    def elapsed(self) -> float:
        """Seconds since the solve began."""
        return time.perf_counter() - self.began

    def count(self, seconds: float, steps: int, nodes: int) -> None:
        """Take note of a chunk of steps."""
        self.stepping += seconds
        self.per_node = max(seconds, 1e-4) / (steps * nodes)

    def steps_in(self, seconds: float, nodes: int) -> float:
        """How many steps take so long, by the last chunk."""
        assert self.per_node is not None
        return seconds / (self.per_node * nodes)


def drive(task: Task, guess: Any, clock: Clock, most: int | None = None) -> tuple[State, Status, np.ndarray]:
    """Chunks of steps until the state stops running, the steps or the time run out, or Ctrl-C.

    Args:
      task: what to iterate.
      guess: node values to start from.
      clock: the limits, and where the time goes.
      most: at most so many steps, if fewer than the clock allows.

    Returns:
      The last state, how it ended, and the residuals of all steps, that of the guess first.
    """
    limit = clock.max_steps if most is None else min(most, clock.max_steps)
    state, residuals = iteration.begin(task, guess), [np.zeros(0)]
    chunk, done = _first_chunk(task, clock), -1  # step −1 is the look at the guess
    if clock.interrupted:
        return _imposed(task, state), Status.INTERRUPTED, residuals[0]
    code = Status.RUNNING
    with _bar(clock.progress, float(task.tol)) as show, noting_interrupts(clock):
        try:
            state = run(task, state, -1)  # compiles and does nothing
            while code is Status.RUNNING:
                began = time.perf_counter()
                over = clock.interrupted or done >= limit or clock.elapsed() >= clock.seconds
                if over and done >= 0:
                    late = Status.MAX_STEPS if done >= limit else Status.TIME_LIMIT
                    code = Status.INTERRUPTED if clock.interrupted else late
                    break
                until = 0 if over else min(max(done, 0) + chunk, limit)
                state = run(task, state, int(until))  # at once a state: an interrupt may come from here on
                code, steps = Status(int(state.code)), int(state.step) - done
                residuals.append(np.asarray(state.history)[:steps])
                clock.count(time.perf_counter() - began, steps, task.grid.size)
                chunk = int(np.clip(clock.steps_in(CHUNK_SECONDS, task.grid.size), 1, min(HISTORY, 8 * chunk)))
                show(steps - (done < 0), float(state.gap.error))
                done += steps
        except KeyboardInterrupt:
            clock.interrupted, code = True, Status.INTERRUPTED
            residuals.append(np.asarray(state.history)[: int(state.step) - done])  # of steps not yet written down
    if code in (Status.INTERRUPTED, Status.NONFINITE):
        state = _imposed(task, state)
    return state, code, np.concatenate(residuals)[: int(state.step) + 1]


def _first_chunk(task: Task, clock: Clock) -> int:
    """How many steps to take before anything is timed on this grid, beside the look at the guess.

    A coarser grid tells what they take; a finer one may fall out of the cache, hence half a chunk's time. One alone
    where a step may take many passes over the nodes, and more of them on a finer grid.
    """
    method, nodes = task.method, task.grid.size
    if task.problem.is_game or isinstance(getattr(method, "evaluation", None), (Krylov, Direct)):
        return 1
    if clock.per_node is None:
        steps = FIRST_NODES / nodes
    else:
        steps = clock.steps_in(min(CHUNK_SECONDS / 2, clock.seconds - clock.elapsed()), nodes)
    return int(np.clip(steps, 1, HISTORY - 1))


def _imposed(task: Task, state: State) -> State:
    """The state with what is given at its nodes, which a guess that nobody looked at does not have."""
    return dataclasses.replace(state, value=task.rules.impose(jnp.asarray(state.value)))


@contextlib.contextmanager
def noting_interrupts(clock: Clock) -> Any:
    """Ctrl-C leaves a note on the clock instead of an exception, which a callback of the runtime might swallow.

    A second Ctrl-C is the usual one. Only in the main thread, and not over a handler of the user's own.
    """
    usual = signal.default_int_handler
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is not usual:
        yield
        return

    def note(number: int, frame: Any) -> None:
        clock.interrupted = True
        signal.signal(signal.SIGINT, usual)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)


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


@contextlib.contextmanager
def ticker(progress: bool | None, total: float, what: str) -> Any:
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
