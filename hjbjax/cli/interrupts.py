"""Ctrl-C handling of the command.

The command starts by importing JAX, which takes about a second. An exception that a signal raises inside these imports
may be replaced by another one, or be dropped by an extension module. So Ctrl-C ends the process at once, except while
the command writes files or owns other processes. Then Ctrl-C raises ``KeyboardInterrupt`` as usual.
"""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

CODE = 130  # 128 + SIGINT, the exit code by convention of shells


def end(number: int, frame: FrameType | None) -> None:
    """End the process at once, without flushing its streams, which do not hold anything of interest at that time."""
    with contextlib.suppress(OSError):  # not through Python's stream, which the signal may have interrupted
        os.write(2, b"\n" * os.isatty(2) + b"hjbjax: interrupted\n")  # the newline ends the line with ^C on a terminal
    os._exit(CODE)


def end_at_once() -> None:
    """Let Ctrl-C end this process at once, unless the signal is ignored, as in background jobs of a shell."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)


@contextlib.contextmanager
def raising_interrupts() -> Iterator[None]:
    """Context in which Ctrl-C raises ``KeyboardInterrupt`` instead of ending the process at once."""
    # only the main thread may set handlers, and a program that calls the command keeps its own handler
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is not end:
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, end)
