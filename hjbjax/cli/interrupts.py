"""Ctrl-C before and while the command has something to keep.

The command starts by importing JAX for a second. An exception from a signal that arrives inside these imports may come
out as another one or be dropped by an extension module. So the command handles Ctrl-C by ending the process at once,
except where it writes files or owns other processes: there Ctrl-C raises ``KeyboardInterrupt``, as usual.
"""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

CODE = 130  # 128 + SIGINT, the exit code that shells report


def end(number: int, frame: FrameType | None) -> None:
    """End the process at once; the buffers of its streams are lost, and nothing is in them that anybody awaits."""
    with contextlib.suppress(OSError):  # not by way of Python's stream, in which the signal may have come
        os.write(2, b"\n" * os.isatty(2) + b"hjbjax: interrupted\n")  # a terminal shows ^C on the line
    os._exit(CODE)


def end_at_once() -> None:
    """Let Ctrl-C end this process at once; a shell starts background jobs with the signal ignored, which stays so."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)


@contextlib.contextmanager
def raised() -> Iterator[None]:
    """Context in which Ctrl-C raises ``KeyboardInterrupt`` instead of ending the process at once."""
    # Python allows only the main thread to set handlers; a program that runs the command itself has its own
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is not end:
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, end)
