"""Child processes that end when their launcher ends, and a record of how each of them ended.

The launcher handles one event at a time. Signals and ends of children go through one queue, so a signal cannot
interrupt the launcher between starting a child and recording it:

    a signal (SIGINT, SIGTERM, SIGHUP)   ask every child to end; a second signal kills them
    a child dies                         ask the others to end
    a child fails with a reason          ask the others to end after ``SETTLE`` seconds
    the first child ends                 the same, because its result counts
    another one ends without a farewell  ask the others to end
    a child stays stopped                ask all of them to end, and continue it
    a child does not report its start    ask all of them to end
    ``GRACE`` seconds after any of them  kill the children that still run

A request to end is SIGTERM, and also SIGCONT for a stopped child. A launcher that is killed cannot send it, but
children started by ``followed`` notice this: their standard input is a pipe that closes with the launcher.

This file imports only the standard library and also runs as the script of a child. A child therefore reacts to the end
of its launcher after milliseconds, although importing JAX takes seconds.
"""

import collections
import contextlib
import dataclasses
import math
import os
import queue
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from types import FrameType
from typing import IO, Any

GRACE = 7.0  # seconds between a request to end and SIGKILL, so that everything ends within 10 s
SETTLE = 2.0  # seconds for children that fail together to print their reasons
BOUNCE = 0.3  # seconds within which a second signal counts as the first one, as when a terminal and its shell close
TICK = 0.5  # seconds between two checks of the clock
LINES = 20  # number of last lines of standard output that are searched for a farewell
LINGER = 0.5  # seconds to wait for the last output of a child that has ended
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
REQUEST = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGCONT") if hasattr(signal, name))
SHARED = (signal.SIGTERM, signal.SIGABRT)  # signals that may end a child because another child ended


@dataclasses.dataclass(frozen=True)
class Command:
    """A command and its environment."""

    words: Sequence[str]
    environment: Mapping[str, str]


@dataclasses.dataclass(frozen=True)
class End:
    """The end of a child.

    Args:
      number: the number of the child.
      code: its exit code; minus the number of the signal that ended it.
      words: the last line that it wrote on standard error.
      early: True if it ended with exit code 0 without printing the farewell.
    """

    number: int
    code: int
    words: str = ""
    early: bool = False


@dataclasses.dataclass(frozen=True)
class ChildEnds:
    """The ends of all children.

    Args:
      ends: one per child, in the order in which they ended.
      interrupted: True if a signal came before any child failed.
      hurried: True if a second signal killed the children.
      stopped: numbers of the children that were stopped (SIGSTOP) when they were asked to end.
      late: numbers of the children that did not report their start in time.
      killed: numbers of the children that were killed.
      unwritten: the error that prevented output of the first child from being passed on.
    """

    ends: tuple[End, ...]
    interrupted: bool = False
    hurried: bool = False
    stopped: tuple[int, ...] = ()
    late: tuple[int, ...] = ()
    killed: tuple[int, ...] = ()
    unwritten: OSError | None = None

    def end_of(self, number: int) -> End:
        """The end of one child."""
        return next(end for end in self.ends if end.number == number)

    @property
    def culprit(self) -> End | None:
        """The child whose end made the others fail; None if all ended with exit code 0 and a farewell.

        If a child is killed or stopped, the others fail as well, possibly before it ends.
        """
        alone = [end for end in self.ends if end.number not in self.killed]
        crashed = [end for end in alone if end.code < 0 and -end.code not in SHARED]
        silent = [self.end_of(number) for number in (*self.stopped, *self.late)]
        early = [end for end in self.ends if end.early]
        failed = [end for end in self.ends if end.code != 0]
        return next(iter([*crashed, *early, *silent, *failed]), None)


def followed(module: str, words: Sequence[str], environment: Mapping[str, str]) -> Command:
    """The command ``python -m module words`` in a process that ends when its launcher ends, even by ``kill -9``.

    It imports from the same folders as the launcher, so a file ``random.py`` in the working directory has no effect.
    Under PYTHONINSPECT it would end in a prompt, with exit code 1 in any case, so it does not inherit this variable.
    """
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    inherited = {name: value for name, value in environment.items() if name != "PYTHONINSPECT"}
    return Command([sys.executable, "-P", __file__, module, *words], {**inherited, "PYTHONPATH": path})


def run_children(
    commands: Sequence[Command],
    explained: Collection[int] = (),
    muted: Collection[bytes] = (),
    patience: float = math.inf,
    farewell: bytes = b"",
    arrival: tuple[bytes, float] = (b"", math.inf),
) -> ChildEnds:
    """Run commands in parallel until all of them have ended; pass on the output of the first one.

    Args:
      commands: one per child.
      explained: exit codes of a child that has printed its reason.
      muted: lines that contain any of these are not passed on.
      patience: seconds for which a child may stay stopped.
      farewell: text on standard output by which a child other than the first reports that the others no longer need it;
        if empty, exit code 0 means this.
      arrival: text on standard output by which a child reports that it has started, and the seconds allowed for that.

    Raises:
      OSError: a child could not be started; no child is left running.
    """
    launcher = _Launcher(explained, muted, patience, farewell, arrival)
    with _signals_into(launcher.events):
        try:
            for command in commands:
                launcher.start(command)
            launcher.wait()
        finally:
            launcher.clear()
    return launcher.outcome()


class _Launcher:
    """The running children, the ends of the others, and the time of the next request."""

    def __init__(
        self,
        explained: Collection[int],
        muted: Collection[bytes],
        patience: float,
        farewell: bytes,
        arrival: tuple[bytes, float],
    ):
        self.explained, self.muted, self.patience, self.farewell = explained, muted, patience, farewell
        self.greeting, seconds = arrival
        self.late_at, self.arrived = time.monotonic() + seconds, set[int]()
        self.events: queue.SimpleQueue[End | int] = queue.SimpleQueue()
        self.running: dict[int, subprocess.Popen] = {}
        self.voices: list[threading.Thread] = []
        self.ends: list[End] = []
        self.ask_at = self.kill_at = math.inf
        self.asked_at: float | None = None
        self.interrupted = self.hurried = False
        self.standing: dict[int, float] = {}  # the seconds for which a child has been stopped
        self.stopped: tuple[int, ...] = ()
        self.late: tuple[int, ...] = ()
        self.killed: tuple[int, ...] = ()
        self.quiet = threading.Event()  # if set, output of the first child is only about missing children
        self.unwritten: list[OSError] = []

    def start(self, command: Command) -> None:
        """Start a child in a separate process group, so that Ctrl-C reaches it only through the launcher."""
        number = len(self.running) + len(self.ends)
        first = number == 0
        options: dict[str, Any] = {
            "env": command.environment,
            "stdin": subprocess.PIPE,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.PIPE,
            "process_group": 0,
        }
        process = self.running[number] = subprocess.Popen(command.words, **options)
        noted: collections.deque[bytes] = collections.deque(maxlen=1)
        said: collections.deque[bytes] = collections.deque(maxlen=LINES)
        voices = (
            self._listen(number, process.stderr, sys.stderr if first else None, noted),
            self._listen(number, process.stdout, sys.stdout if first else None, said),
        )

        def report_end() -> None:
            code = process.wait()
            for voice in voices:
                voice.join(LINGER)
            words = noted[0].decode(errors="replace").strip() if noted else ""
            early = not first and code == 0 and not any(self.farewell in line for line in (*said, b""))
            self.events.put(End(number, code, words, early))

        threading.Thread(target=report_end, daemon=True).start()

    def _listen(
        self, number: int, stream: IO[bytes] | None, out: Any, last: collections.deque[bytes]
    ) -> threading.Thread:
        """Start a thread that reads the output of a child, keeps the last lines and passes on all but the greeting."""

        def listen() -> None:
            assert stream is not None
            sink = out
            with stream:
                for line in stream:
                    if self.greeting and self.greeting in line:
                        self.arrived.add(number)
                        continue
                    if line.strip():
                        last.append(line)
                    if sink is None or self.quiet.is_set() or any(part in line for part in self.muted):
                        continue
                    try:
                        _write(line, sink)
                    except OSError as error:  # drop further lines, so that the child can continue to write
                        self.unwritten.append(error)
                        sink = None

        voice = threading.Thread(target=listen, daemon=True)
        voice.start()
        self.voices.append(voice)
        return voice

    def wait(self) -> None:
        """Handle events until every child has ended."""
        while self.running:
            left = min(self.ask_at, self.kill_at) - time.monotonic()
            try:
                event = self.events.get(timeout=min(TICK, max(0.0, left)))
            except queue.Empty:
                self._note_stopped()
                self._note_late()
            else:
                if isinstance(event, End):
                    self._note_end(event)
                else:
                    self._note_signal()
            if time.monotonic() >= self.kill_at:
                self._kill()
            elif time.monotonic() >= self.ask_at:
                self._ask()

    def _note_end(self, end: End) -> None:
        """Record an end, and ask the other children to end if they are no longer needed or cannot continue."""
        self._close(self.running.pop(end.number))
        self.ends.append(end)
        if self.asked_at is not None or (end.number > 0 and end.code == 0 and not end.early):
            return
        now = time.monotonic()
        died = end.early or end.code not in (0, *self.explained)
        self.ask_at = min(self.ask_at, now if died else now + SETTLE)
        self.kill_at = min(self.kill_at, now + GRACE)

    def _note_signal(self) -> None:
        """Ask the children to end; kill them if they were asked before."""
        now = time.monotonic()
        if self.asked_at is None:
            self.interrupted = all(end.code == 0 and not end.early for end in self.ends)
            self.ask_at, self.kill_at = now, min(self.kill_at, now + GRACE)
        elif now - self.asked_at > BOUNCE:
            self.kill_at, self.hurried = now, True

    def _note_stopped(self) -> None:
        """Ask the children to end if one of them has been stopped for too long, because the others wait for it."""
        # count checks instead of time, because the launcher may have been stopped as well
        self.standing = {number: self.standing.get(number, 0.0) + TICK for number in self._stopped_now()}
        if self.asked_at is None and any(seconds > self.patience for seconds in self.standing.values()):
            self.ask_at = min(self.ask_at, time.monotonic())
            self.kill_at = min(self.kill_at, self.ask_at + GRACE)

    def _note_late(self) -> None:
        """Ask the children to end if one of them has not reported its start in time: the others wait for it."""
        if self.asked_at is None and time.monotonic() > self.late_at:
            self.late_at, self.late = math.inf, tuple(each for each in self.running if each not in self.arrived)
            if self.late:
                self.ask_at = min(self.ask_at, time.monotonic())
                self.kill_at = min(self.kill_at, self.ask_at + GRACE)

    def _stopped_now(self) -> tuple[int, ...]:
        """The numbers of the children that are stopped."""
        return tuple(number for number, process in self.running.items() if _is_stopped(process))

    def _ask(self) -> None:
        """Ask the children to end."""
        self.asked_at, self.ask_at = time.monotonic(), math.inf
        self.stopped = self._stopped_now()
        if 0 in self.running and not self.interrupted:
            self.quiet.set()
        for process in self.running.values():
            for number in REQUEST:
                process.send_signal(number)

    def _kill(self) -> None:
        """Kill the children."""
        self.ask_at = self.kill_at = math.inf
        self.killed = tuple(self.running)
        for process in self.running.values():
            process.kill()

    def clear(self) -> None:
        """Kill the children that still run, for example after an error of the launcher, and close the pipes."""
        for process in self.running.values():
            process.kill()
        for process in self.running.values():
            process.wait()
            self._close(process)
        latest = time.monotonic() + LINGER  # a grandchild may hold a pipe open
        for voice in self.voices:
            voice.join(max(0.0, latest - time.monotonic()))

    @staticmethod
    def _close(process: subprocess.Popen) -> None:
        """Close the pipe through which a child follows its launcher."""
        assert process.stdin is not None
        process.stdin.close()

    def outcome(self) -> ChildEnds:
        """The ends of all children."""
        return ChildEnds(
            ends=tuple(self.ends),
            interrupted=self.interrupted,
            hurried=self.hurried,
            stopped=self.stopped,
            late=self.late,
            killed=self.killed,
            unwritten=next(iter(self.unwritten), None),
        )


def _write(line: bytes, out: Any) -> None:
    """Write a line unchanged, and flush it."""
    if hasattr(out, "buffer"):
        out.buffer.write(line)
    else:
        out.write(line.decode(errors="replace"))
    out.flush()


@contextlib.contextmanager
def _signals_into(events: "queue.SimpleQueue[Any]") -> Iterator[None]:
    """Context in which signals are put into a queue; ignored signals, as under ``nohup``, stay ignored."""
    if threading.current_thread() is not threading.main_thread():  # Python hands signals to the main thread only
        yield
        return

    def note(number: int, frame: FrameType | None) -> None:
        events.put(number)

    usual: dict[int, Any] = {}
    try:
        for number in SIGNALS:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                usual[number] = signal.signal(number, note)
        if hasattr(signal, "SIGCHLD") and signal.getsignal(signal.SIGCHLD) is signal.SIG_IGN:
            # some parents leave it ignored; the system would then drop exit codes, and every child would seem to
            # succeed
            usual[signal.SIGCHLD] = signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)


def _is_stopped(process: subprocess.Popen) -> bool:
    """True if a child is stopped now, for example by SIGSTOP; False if the system does not report it."""
    if not hasattr(os, "waitid"):
        return False
    try:  # WNOWAIT leaves the event to the thread that waits for the end
        return os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT) is not None
    except OSError:
        return False


# --- in the child ---


def _follow(lifeline: int) -> None:
    """End this process when the pipe closes: by SIGTERM, so that it saves its work, and by force after ``GRACE``."""
    while os.read(lifeline, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE)
    os._exit(128 + signal.SIGTERM)


def _main(module: str) -> None:
    """Run a module as a script that follows its launcher."""
    lifeline, nothing = os.dup(0), os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    # the launcher sends SIGTERM; other signals may have been sent by name to all processes, including the launcher, and
    # if a launcher is killed, the system sends SIGHUP to a stopped process and continues it
    for number in set(SIGNALS) - {signal.SIGTERM}:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_follow, args=(lifeline,), daemon=True).start()
    runpy.run_module(module, run_name="__main__")


if __name__ == "__main__":
    del sys.argv[0]
    _main(sys.argv[0])
