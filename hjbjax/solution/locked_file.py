"""A file that one run keeps locked from beginning to end, and may replace any number of times.

The lock is on the file itself, so no second file is left behind, and the kernel releases the lock when the process ends
for any reason. Each new file is locked before it gets the name, so the name is never unlocked. On a file system without
locks one check remains: a file that another run has put there is never replaced.
"""

import contextlib
import os
import weakref
from collections.abc import Callable
from typing import IO, TypeAlias

from hjbjax.solution import files, placement
from hjbjax.solution.placement import FileError

TRIES = 100  # attempts to open a file that others keep replacing
Held: TypeAlias = tuple[os.stat_result, int | None]  # which file, and a handle that keeps its lock
_made: "weakref.WeakSet[LockedFile]" = weakref.WeakSet()


class LockedFile:
    """A file that belongs to one run until it is closed.

    Args:
      path: its absolute path, as ``placement.absolute`` gives it.
    """

    def __init__(self, path: str):
        self.path = path
        self._own: list[Held] = []  # the run's file at the path, and during a write the one that will replace it
        _made.add(self)

    def take(self) -> bool:
        """Lock the file at the path and return True; return False if there is none.

        Raises:
          FileError: another run has locked it, or it cannot be opened, or it is empty. On a file system without links,
            another run reserves the name with an empty file.
        """
        for _ in range(TRIES):
            placement.check_place(self.path, force=True)
            try:
                handle = _open(self.path)
            except OSError as error:
                if isinstance(error, FileNotFoundError) or not os.path.lexists(self.path):
                    return False
                raise FileError(f"{self.path}: cannot be opened: {error.strerror or error}") from error
            try:
                if not placement.lock(handle):
                    raise FileError(f"{self.path}: another run is using it; wait for its end, or give another path")
                if os.fstat(handle).st_size == 0:
                    raise FileError(f"{self.path}: cannot be read: it is empty; remove it, or give another path")
                self._own = [_held(handle)]
            finally:
                os.close(handle)
            if self._is_own(self._there()):
                return True
            self.close()  # the file was replaced or removed between opening and locking
        raise FileError(f"{self.path}: other runs keep replacing it; give another path")

    def write(self, fill: Callable[[IO[bytes]], object]) -> None:
        """Replace the file atomically; the first write of a run that has not taken a file creates a new one.

        Raises:
          FileExistsError: a file has appeared, and this run has not taken one.
          FileError: another program has put its own file there, or the file cannot be written.
        """
        before = self._own

        def fill_and_lock(stream: IO[bytes]) -> None:
            fill(stream)
            there = self._there()
            if before and there is not None and not self._is_own(there):
                raise OSError("another run or program has put its own file there")
            self._own = [*before, _held(stream.fileno())]

        try:
            files.write_whole(self.path, fill_and_lock, force=bool(before))
        finally:  # the file at the path shows how far the write came, also after Ctrl-C
            there = self._there()
            self._keep([each for each in self._own if there and os.path.samestat(there, each[0])] or before)

    def remove(self) -> None:
        """Remove the file, unless another program has replaced it."""
        if self._is_own(self._there()):
            with contextlib.suppress(OSError):
                os.unlink(self.path)

    def close(self) -> None:
        """Release the lock."""
        self._keep([])

    def _keep(self, some: list[Held]) -> None:
        """Forget all own files except some, and close their handles."""
        others, self._own = [each for each in self._own if each not in some], some
        for _, handle in others:
            if handle is not None:
                os.close(handle)

    def _there(self) -> os.stat_result | None:
        """The identity of the file at the path; None if there is none."""
        try:
            return os.stat(self.path)
        except OSError:
            return None

    def _is_own(self, there: os.stat_result | None) -> bool:
        """True if the file is one of the run's own."""
        return there is not None and any(os.path.samestat(there, own) for own, _ in self._own)


def _held(handle: int) -> Held:
    """Identify an open file, with a copy of its handle that shares the lock; no handle on Windows, where it blocks."""
    return os.fstat(handle), None if placement.fcntl is None else os.dup(handle)


def _close_in_fork() -> None:
    """Close the copies of all handles: a worker that outlives a killed run would keep the lock of its file."""
    for each in list(_made):
        each.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_in_fork)


def _open(path: str) -> int:
    """Open a file, for writing if possible, because NFS requires this for a lock."""
    try:
        return os.open(path, os.O_RDWR)
    except OSError:
        return os.open(path, os.O_RDONLY)
