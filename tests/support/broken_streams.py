"""What programs have in place of ``sys.stderr``: streams that are missing, closed, full, or lack a method."""

import contextlib
import errno
import io
import os
import sys
import warnings


class Failing(io.StringIO):
    """A terminal, by its own account, whose reader has gone, or whose disk is full."""

    def __init__(self, error):
        super().__init__()
        self.error = error

    def isatty(self):
        return True

    def write(self, text):
        raise self.error

    def flush(self):
        raise self.error


class Mute:
    """A stand-in that takes text and has nothing else."""

    def write(self, text):
        return len(text)


class Deaf(Mute):
    """A stand-in that does not even say if it is a terminal."""

    def isatty(self):
        raise RuntimeError("wrapped C++ object of type QPlainTextEdit has been deleted")


class Proxy(Mute):
    """A stand-in that raises its own error for every attribute that it lacks."""

    def __getattr__(self, name):
        raise RuntimeError(f"the console has no {name}")


def closed():
    stream = io.TextIOWrapper(io.BytesIO())
    stream.close()
    return stream


def detached():
    stream = io.TextIOWrapper(io.BytesIO())
    stream.detach()
    return stream


BROKEN = {
    "none": lambda: None,
    "closed": closed,
    "detached": detached,
    "only write": Mute,
    "nothing": object,
    "deleted": Deaf,
    "proxy": Proxy,
    "no reader": lambda: Failing(BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))),
    "full": lambda: Failing(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))),
    "closed terminal": lambda: Failing(ValueError("I/O operation on closed file")),
    "of another kind": lambda: Failing(RuntimeError("gone")),
}


def show_as_python_does(message, category, filename, lineno, file=None, line=None):
    """Python's own ``warnings.showwarning``, which pytest replaces: it drops an OSError and nothing else."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError):
            sys.stderr.write(warnings.formatwarning(message, category, filename, lineno, line))
