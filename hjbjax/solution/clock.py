"""The limits of a long run: time, steps and Ctrl-C; and its progress.

Long computations run in phases (checks, a survey of the nodes, preparation, grids, chunks of steps) and check their
clock between two phases. Ctrl-C sets a flag on the clock instead of raising an exception, which might be swallowed in a
callback of the runtime, and would lose the results so far. A compilation or a single step cannot be interrupted; it
finishes, and nothing follows it.

If several processes solve one problem together, all must do the same in the same order, otherwise they would wait for
each other indefinitely. A limit that one of them reaches therefore applies to all, at the same check of the clock.
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
CHUNK_SECONDS = 0.5  # seconds between two checks of the clock if steps are short: the delay of Ctrl-C
REPEAT = 1.0  # seconds within which SIGTERM is sent twice: by a service manager to all processes, and by their launcher
CUT = (Status.INTERRUPTED, Status.TIME_LIMIT)


class Stopped(Exception):
    """A run ends between two of its phases: ``status`` is the reason, ``reached`` the solution so far, if any.

    It is caught by functions that have a result to return.
    """

    def __init__(self, status: Status, reached: Any = None):
        super().__init__(status.message)
        self.status, self.reached = status, reached


class Clock:
    """The limits of a run, its elapsed time, the time of its steps, and a flag for interrupts.

    ``phase`` describes the progress, such as "the survey of the nodes"; ``tell``, if set, is called with each new
    phase. ``per_node`` is the time per step and node in the last chunk, in seconds, also across grids; None before the
    first chunk. ``journal`` stores the completed parts in a file, or is None. ``together`` is True in each of several
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
        """The current phase of the run."""
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
        """A clock for one of several parallel runs, with its own pace and a common interrupt."""
        return _Beside(self)

    def beside_from_now(self) -> "Clock":
        """Like ``beside``, but the run that begins now gets the whole time limit."""
        lane = self.beside()
        lane.began = time.perf_counter()
        return lane

    def over(self) -> Status | None:
        """INTERRUPTED or TIME_LIMIT; ``None`` to continue."""
        # Ctrl-C takes precedence over the time limit
        found = 0 if self.interrupted else 1 if self.elapsed() >= self.seconds else 2
        return (Status.INTERRUPTED, Status.TIME_LIMIT, None)[self.least_of_all(found)]

    def least_of_all(self, number: int) -> int:
        """The least of this number over all processes, so that they agree; the number itself for a single process."""
        return agreed(number) if self.together else number

    def look(self) -> None:
        """Return, or raise ``Stopped`` if the run is over."""
        code = self.over()
        if code is not None:
            raise Stopped(code)

    def enter(self, phase: str) -> None:
        """Begin the next phase, or raise ``Stopped`` and keep the previous phase."""
        self.look()
        self.phase = phase

    def count(self, seconds: float, steps: int, nodes: int) -> None:
        """Record the time of a chunk of steps."""
        self.stepping += seconds
        # at least 1e-4 s, so that a chunk below the resolution of the clock does not predict steps without duration
        self.per_node = max(seconds, 1e-4) / (steps * nodes)

    def steps_in(self, seconds: float, nodes: int) -> float:
        """The number of steps that fit into this time, at the pace of the last chunk."""
        assert self.per_node is not None
        return seconds / (self.per_node * nodes)


def agreed(number: int) -> int:
    """The least of an integer over all processes of ``jax.distributed``, each of which must call this."""
    from jax.experimental import multihost_utils

    return int(np.min(multihost_utils.process_allgather(np.asarray(number, np.int32))))


class _Beside(Clock):
    """The clock of one of several parallel runs, with its own pace and common interrupts and limits."""

    def __init__(self, outer: Clock):
        self.__dict__["_outer"] = outer
        super().__init__(outer.max_steps, outer.seconds, progress=False)
        self.began, self.phase = outer.began, outer.phase

    def __setattr__(self, name: str, value: Any) -> None:
        # a lane that begins must not reset an interrupt
        if name == "interrupted":
            self._outer.interrupted |= value
        elif name == "seconds":
            self._outer.seconds = value
        else:
            super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._outer, name)


_running: list[Clock] = []  # clocks of the main thread, the outermost run first
_raised: list[int] = []  # signals for which ``_interrupt`` raised
_heard: dict[int, float] = {}  # time of the last occurrence of each signal


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Handle a signal in a command: record it and raise the exception of Ctrl-C."""
    now, before = time.monotonic(), _heard.get(number, -math.inf)
    _heard[number] = now
    if number == signal.SIGTERM and now - before < REPEAT:
        return
    _raised.append(number)
    raise KeyboardInterrupt


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Context of a command that Ctrl-C and SIGTERM end in the same way: a run in it saves its results for both.

    A second Ctrl-C interrupts it at once. SIGTERM within ``REPEAT`` seconds of another SIGTERM does not.

    Python drops exceptions in callbacks of its garbage collector, which JAX uses; the next run then checks the recorded
    signal. A shell starts background jobs with SIGINT ignored. This is preserved, and SIGTERM has its own handler.
    """
    if threading.current_thread() is not threading.main_thread():  # only the main thread handles signals
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
    """Context in which Ctrl-C sets a flag on the clock, and on the clocks of the enclosing runs.

    A second Ctrl-C raises the usual exception. Only in the main thread, and only without a custom handler. SIGTERM is
    treated in the same way after ``signal.signal(signal.SIGTERM, signal.default_int_handler)``.
    """
    if threading.current_thread() is not threading.main_thread():  # Python delivers signals to the main thread only
        yield
        return
    # in a nested run the handler of the outer run is already installed
    handlers = {} if _running else {number: signal.getsignal(number) for number in SIGNALS}
    noted = {n: usual for n, usual in handlers.items() if usual in (signal.default_int_handler, _interrupt)}

    def give_back() -> None:
        for number, usual in noted.items():
            signal.signal(number, usual)

    def note(number: int, frame: FrameType | None) -> None:
        _heard[number] = time.monotonic()
        for each in _running:
            each.interrupted = True
        give_back()  # a second Ctrl-C raises the usual KeyboardInterrupt

    # a Ctrl-C between two inner runs has set the flag of the outer clock
    clock.interrupted |= any(each.interrupted for each in _running) or bool(_raised)
    try:
        _running.append(clock)
        for number in noted:
            signal.signal(number, note)
        yield
    finally:
        # first, before Python can raise a second Ctrl-C: all later runs would end with a clock that stays in the list
        if clock in _running:
            _running.remove(clock)
        give_back()
