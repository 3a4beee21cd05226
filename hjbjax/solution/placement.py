"""Files put in their place in one step, and what killed writers left on the way taken away.

A file is made under a hidden name in its folder and moved when it is whole: by ``os.replace`` where an older one may
go, else by ``os.link``, which fails if somebody else's is there by then.
"""

import contextlib
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from typing import TypeAlias

try:
    import fcntl
except ImportError:  # Windows, where nothing of a dead process is taken away
    fcntl = None  # type: ignore[assignment]

Path: TypeAlias = str | bytes | os.PathLike  # what the system takes for the name of a file
NAME = 64  # bytes of a file's name that its temporary one repeats; file systems allow 255 in all
OWN = re.compile(
    r"\..*\.hjbjax\.tmp-(\d+)-[0-9a-f]{8}", re.DOTALL
)  # names of what is on its way, with the writer's pid


class FileError(OSError):
    """A result file that could not be written or read; the message names the path and the reason."""


class MissingFileError(FileError, FileNotFoundError):
    """A file that is not there, for whoever catches what ``open`` raises."""


def path_of(path: Path, done: str) -> str:
    """The name of a file as text.

    Args:
      path: text, bytes or a path object.
      done: what was to be done with the file, as in "read".

    Raises:
      FileError: no path at all, or one with a null byte, which no system takes.
    """
    try:
        text = os.fsdecode(path)
    except TypeError:
        raise FileError(f"{path!r:.80}: cannot be {done}: it is no path; wanted the name of a file") from None
    if "\0" in text:
        raise FileError(f"{path!r}: cannot be {done}: there is a null byte in the name")
    return text


def current_folder() -> str:
    """The current folder.

    Raises:
      FileError: it has been removed.
    """
    try:
        return os.getcwd()
    except FileNotFoundError as error:
        raise FileError("the current folder has been removed; change to another one") from error


def absolute(path: str) -> str:
    """The path of a file to be written, from the root of the file system and through links.

    Raises:
      FileError: the path is relative, and the current folder has been removed.
    """
    try:
        return os.path.realpath(path if os.path.isabs(path) else os.path.join(current_folder(), path))
    except FileError as error:
        raise FileError(f"{path}: cannot be written: {error}, or give an absolute path") from error


def check_place(path: str | os.PathLike[str], force: bool) -> None:
    """Refuse a path at which no file can be put.

    Raises:
      FileExistsError: a file is there and ``force`` is false.
      FileError: what is there is no ordinary file: to replace a device would take it from the whole machine.
    """
    try:
        mode = os.stat(path).st_mode
    except OSError:  # nothing is there, or writing will tell
        return
    if stat.S_ISDIR(mode):
        raise FileError(f"{path}: cannot be written: it is a folder; give a file in it, as in 'run.npz'")
    if not stat.S_ISREG(mode):
        raise FileError(f"{path}: cannot be written: it is a device, a pipe or a socket; give another name")
    if not force:
        raise FileExistsError(f"{path}: exists already; give another name, or force=True to replace it")


def place(source: str | os.PathLike[str], path: str | os.PathLike[str], force: bool) -> None:
    """Move a whole file to its name in one step; without ``force`` only if that name is free at that moment.

    Raises:
      FileExistsError: it is not.
      OSError: whatever the system says.
    """
    check_place(path, force)
    if force:
        os.replace(source, path)
        return
    # ``os.replace`` would take the place of a file that came after the check; a link fails where there is one
    try:
        try:
            os.link(source, path)
        except FileExistsError:
            raise
        except (OSError, AttributeError):  # a file system without links
            _move_over_reservation(source, path)
        else:
            os.unlink(source)
    except FileExistsError:
        check_place(path, force)  # who refuses in the user's words, unless the file has gone again
        raise


def _move_over_reservation(source: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Move a file to a name that an empty file takes first: of two who try, one fails."""
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    try:
        os.replace(source, path)
    except OSError:
        os.unlink(path)
        raise


# --- what is on its way ---


def hidden_name(name: str) -> str:
    """A name for what will be called ``name``, hidden, with the writer's pid."""
    start = os.fsdecode(os.fsencode(name)[:NAME])  # the limit of file systems is in bytes, a cut letter is no harm
    return f".{start}.hjbjax.tmp-{os.getpid()}-{secrets.token_hex(4)}"


@contextlib.contextmanager
def claimed(path: Path) -> Iterator[None]:
    """Context with a lock on a file or a folder on its way; it ends with the process, however that ends."""
    if fcntl is None:
        yield
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)


def sweep(folder: str | os.PathLike[str]) -> None:
    """Take away what killed writers left in a folder: what bears a dead pid and is locked by nobody.

    Of the two signs one alone would not do: a pid says nothing about another machine that writes into the folder, and
    a lock comes a moment after the file.
    """
    if fcntl is None:
        return
    with contextlib.suppress(OSError):  # a folder that cannot be listed is no reason not to write into it
        for entry in os.scandir(folder):
            found = OWN.fullmatch(entry.name)
            if found and not _is_alive(int(found[1])):
                with contextlib.suppress(OSError):
                    _remove_unclaimed(entry)


def _is_alive(pid: int) -> bool:
    """True if a process with this number runs on this machine."""
    try:
        os.kill(pid, 0)  # signal 0 is none: only its delivery is checked
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # another user's
        return True
    return True


def _remove_unclaimed(entry: os.DirEntry) -> None:
    """Remove a file or a folder unless a living writer holds its lock."""
    is_folder = entry.is_dir(follow_symlinks=False)
    if not is_folder and not entry.is_file(follow_symlinks=False):
        return
    handle = os.open(entry.path, os.O_RDONLY | os.O_NOFOLLOW)  # a link that came meanwhile may point anywhere
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises where a writer holds it
        shutil.rmtree(entry.path, ignore_errors=True) if is_folder else os.unlink(entry.path)
    finally:
        os.close(handle)
