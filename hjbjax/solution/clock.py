"""The limits of a long run: its seconds, its steps, and Ctrl-C; and how far it came.

All that runs long does so in phases (checks, a survey of the nodes, preparation, grids, chunks of steps) and looks at
its clock between two of them. Ctrl-C leaves a note on the clock instead of an exception: an exception may be thrown
into a callback of the runtime and be swallowed there, and would take along what was done so far. What cannot be cut,
a compilation or one step, is seen to its end, and nothing follows it.

Where one problem is solved by many processes together, all do the same things in the same order, or they would wait for
each other for ever: each limit that one of them meets is met by all, at the same look at the clock.
"""

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import numpy as np

from hjbjax.solution.status import Status

SIGNALS = (signal.SIGINT, signal.SIGTERM)
CHUNK_SECONDS = 0.5  # between two looks at the clock, where steps are short: how long Ctrl-C may take to be heard
REPEAT = 1.0  # seconds within which SIGTERM is sent twice: by a service manager to all processes, and by their launcher
CUT = (Status.INTERRUPTED, Status.TIME_LIMIT)


class Stopped(Exception):
    """A run is over between two of its phases: ``status`` says why, ``reached`` is the answer so far, if there is one.

    Caught where there is something to hand back.
    """

    def __init__(self, status: Status, reached: Any = None):
        super().__init__(status.message)
        self.status, self.reached = status, reached


class Clock:
    """The limits of a run, the time it has taken, that of its steps apart, and whether it was interrupted.

    ``phase`` says how far it came, as in "the survey of the nodes"; ``tell``, if there is one, is called with each new
    one. ``per_node`` is the seconds that a step took at a node in the last chunk, from grid to grid; None before the
    first. ``journal`` is what keeps the parts that are done in a file, or None. ``together`` is true in one of many
    processes that solve one problem.
    """

    def __init__(
        self,
        max_steps: int = 10**9,
        seconds: float | None = None,
        progress: bool | None = None,
        *,
        together: bool = False,
    ):
        self.max_steps, self.progress, self.together = max_steps, progress, together
        self.seconds = math.inf if seconds is None else seconds
        self.began, self.stepping, self.interrupted = time.perf_counter(), 0.0, False
        self.per_node: float | None = None
        self.tell: Callable[[str], object] | None = None
        self.journal: Any = None
        self.phase = "the checks"

    @property
    def phase(self) -> str:
        """How far the run came."""
        return self._phase

    @phase.setter
    def phase(self, phase: str) -> None:
        self._phase = phase
        if self.tell is not None:
            self.tell(phase)

    def elapsed(self) -> float:
        """Seconds since the run began."""
        return time.perf_counter() - self.began

    def beside(self) -> "Clock":
        """A clock for one of several runs side by side: with its own pace, and with one interrupt for all."""
        return _Beside(self)

    def over(self) -> Status | None:
        """INTERRUPTED or TIME_LIMIT; ``None`` to go on."""
        # first: who pressed Ctrl-C wants to read that, whatever the time is
        found = 0 if self.interrupted else 1 if self.elapsed() >= self.seconds else 2
        return (Status.INTERRUPTED, Status.TIME_LIMIT, None)[self.least_of_all(found)]

    def least_of_all(self, number: int) -> int:
        """The least of a number of every process, by which they agree; the number itself where there is one."""
        return agreed(number) if self.together else number

    def look(self) -> None:
        """Go on, or raise ``Stopped``."""
        code = self.over()
        if code is not None:
            raise Stopped(code)

    def enter(self, phase: str) -> None:
        """Go on to the next phase, or raise ``Stopped``; the clock then keeps the phase before."""
        self.look()
        self.phase = phase

    def count(self, seconds: float, steps: int, nodes: int) -> None:
        """Take note of a chunk of steps."""
        self.stepping += seconds
        # a chunk shorter than the clock can tell must not promise that a million steps take no time
        self.per_node = max(seconds, 1e-4) / (steps * nodes)

    def steps_in(self, seconds: float, nodes: int) -> float:
        """The number of steps that take so long, by the last chunk."""
        assert self.per_node is not None
        return seconds / (self.per_node * nodes)


def agreed(number: int) -> int:
    """The least of a whole number over all processes of ``jax.distributed``, each of which has to ask."""
    from jax.experimental import multihost_utils

    return int(np.min(multihost_utils.process_allgather(np.asarray(number, np.int32))))


class _Beside(Clock):
    """The clock of one of several runs side by side, with its own pace; interrupts and limits are those of all."""

    def __init__(self, outer: Clock):
        self.__dict__["_outer"] = outer
        super().__init__(outer.max_steps, outer.seconds, progress=False)
        self.began, self.phase = outer.began, outer.phase

    def __setattr__(self, name: str, value: Any) -> None:
        # an interrupt is never taken back by a lane that begins
        if name == "interrupted":
            self._outer.interrupted |= value
        elif name == "seconds":
            self._outer.seconds = value
        else:
            super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._outer, name)


_running: list[Clock] = []  # of the main thread, the outermost run first
_raised: list[int] = []  # signals for which ``_interrupt`` raised
_heard: dict[int, float] = {}  # when a signal came for the last time


def _interrupt(number: int, frame: FrameType | None) -> None:
    """What the command does on a signal: Ctrl-C's exception, and a note that there was one."""
    now, before = time.monotonic(), _heard.get(number, -math.inf)
    _heard[number] = now
    if number == signal.SIGTERM and now - before < REPEAT:
        return
    _raised.append(number)
    raise KeyboardInterrupt


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Context of a command that Ctrl-C and SIGTERM end alike: a run in it keeps what it has for either.

    A second Ctrl-C cuts it short. SIGTERM within ``REPEAT`` seconds of another one does not.

    Python drops an exception in a callback of its garbage collector, and JAX has such; the next run notes the signal.
    A shell starts background jobs with SIGINT ignored, which stays so, and SIGTERM must not go by way of it.
    """
    if threading.current_thread() is not threading.main_thread():  # signals are another's business
        yield
        return
    ignored = signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    usual = {number: signal.signal(number, _interrupt) for number in (SIGNALS[1:] if ignored else SIGNALS)}
    _raised.clear()
    _heard.clear()
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
        _raised.clear()


@contextlib.contextmanager
def noting_interrupts(clock: Clock) -> Iterator[None]:
    """Context in which Ctrl-C leaves a note on the clock, and on those of the runs around this one.

    A second Ctrl-C is the usual exception. Only in the main thread, and not over a handler of the user's own. SIGTERM
    likewise where it was made to do what Ctrl-C does: ``signal.signal(signal.SIGTERM, signal.default_int_handler)``.
    """
    if threading.current_thread() is not threading.main_thread():  # Python hands signals to the main thread alone
        yield
        return
    # A run inside another one finds the handler of the outer already there.
    handlers = {} if _running else {number: signal.getsignal(number) for number in SIGNALS}
    noted = {n: usual for n, usual in handlers.items() if usual in (signal.default_int_handler, _interrupt)}

    def give_back() -> None:
        for number, usual in noted.items():
            signal.signal(number, usual)

    def note(number: int, frame: FrameType | None) -> None:
        _heard[number] = time.monotonic()
        for each in _running:
            each.interrupted = True
        give_back()  # a second Ctrl-C is the usual KeyboardInterrupt

    # a Ctrl-C that fell between two inner runs was noted on the outer clock
    clock.interrupted |= any(each.interrupted for each in _running) or bool(_raised)
    _running.append(clock)
    try:
        for number in noted:
            signal.signal(number, note)
        yield
    finally:
        give_back()
        _running.remove(clock)
