"""Files put in their place in one step, and what killed writers left on the way taken away.

A file is made under a hidden name in its folder and moved when it is whole: by ``os.replace`` if an older file may be
replaced, otherwise by ``os.link``, which fails if another writer's file is there by then. The new file has the mode
of the one it replaces.
"""

import contextlib
import errno
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from typing import IO, TypeAlias

try:
    import fcntl
except ImportError:  # Windows: no locks, and nothing that a dead process left is taken away
    fcntl = None  # type: ignore[assignment]

Path: TypeAlias = str | bytes | os.PathLike  # what the system takes for the name of a file
NAME = 64  # bytes of a file's name that its temporary one repeats; file systems allow 255 in all
OWN = re.compile(
    r"\..*\.hjbjax\.tmp-(\d+)-[0-9a-f]{8}", re.DOTALL
)  # names of what is on its way, with the writer's pid
BLOCK = 4096  # bytes that a trial writes: what a file system allocates at least for a file


class FileError(OSError):
    """A result file that could not be written or read; the message names the path and the reason."""


class MissingFileError(FileError, FileNotFoundError):
    """A file that does not exist, for callers that catch what ``open`` raises."""


def path_of(path: Path, done: str) -> str:
    """The name of a file as text.

    Args:
      path: text, bytes or a path object.
      done: what was to be done with the file, as in "read".

    Raises:
      FileError: not a path, or one that no system takes: with a null byte, or with half of a surrogate pair.
    """
    try:
        text = os.fsdecode(path)
    except TypeError:
        raise FileError(f"{path!r:.80}: cannot be {done}: it is no path; wanted the name of a file") from None
    if "\0" in text:
        raise FileError(f"{path!r}: cannot be {done}: there is a null byte in the name")
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        raise FileError(f"{path!r}: cannot be {done}: the system has no bytes for this name") from None
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
      FileError: a folder is there, a device, or a link to itself: to replace a device would take it from the machine.
    """
    try:
        mode = os.stat(path).st_mode
    except OSError as error:  # nothing is there, or writing reports the reason
        if error.errno == errno.ELOOP and not force:
            raise FileError(f"{path}: cannot be written: it is a link to itself") from error
        return
    if stat.S_ISDIR(mode):
        raise FileError(f"{path}: cannot be written: it is a folder; give a file in it, as in 'run.npz'")
    if not stat.S_ISREG(mode):
        raise FileError(f"{path}: cannot be written: it is a device, a pipe or a socket; give another name")
    if not force:
        raise FileExistsError(f"{path}: exists already; give another name, or force=True to replace it")


@contextlib.contextmanager
def new_file(path: str) -> Iterator[tuple[str, IO[bytes]]]:
    """Context with the hidden name and the open stream of a file that ``place`` will move to ``path``.

    The file is locked, and it is gone at the end unless it was moved.

    Raises:
      FileError: whatever the system refuses on the way.
    """
    folder, name = os.path.split(path)
    sweep(folder)
    temporary = os.path.join(folder, hidden_name(name))
    try:
        with open(temporary, "xb") as stream:
            lock(stream.fileno())  # the pid in the name protects the file until here
            keep_owner_and_mode(temporary, path)  # before anything is in it that others may not read
            yield temporary, stream
    except (FileError, FileExistsError):
        raise
    except OSError as error:
        missing = isinstance(error, (FileNotFoundError, NotADirectoryError)) and not os.path.isdir(folder)
        reason = f"there is no folder {folder}" if missing else error.strerror or error
        raise FileError(f"{path}: cannot be written: {reason}") from error
    finally:
        # a disk that became read-only refuses this as well, which must not hide the first error
        with contextlib.suppress(OSError):
            os.unlink(temporary)


def finish(stream: IO[bytes]) -> None:
    """Bring all bytes to the disk: otherwise a power cut may leave the new name with nothing behind it."""
    stream.flush()
    os.fsync(stream.fileno())
    if fcntl is None:  # Windows moves no open file; elsewhere it is open, and so locked, until it is in its place
        stream.close()


def try_place(path: str) -> None:
    """Write a small file next to the file at ``path``, which a run will replace, and remove it again.

    Raises:
      FileError: no file can be written there, or that file belongs to another user, in a folder like /tmp.
    """
    with new_file(path) as (_, stream):
        stream.write(bytes(BLOCK))
        finish(stream)
        folder, old = os.stat(os.path.dirname(path)), os.stat(path)
        if folder.st_mode & stat.S_ISVTX and os.geteuid() not in (0, folder.st_uid, old.st_uid):
            raise FileError(f"{path}: cannot be written: in this folder only the owner of a file may replace it")


def place(source: str | os.PathLike[str], path: str | os.PathLike[str], force: bool) -> None:
    """Move a whole file to its name in one step; without ``force`` only if that name is free at that moment.

    A file that replaces another one takes over its mode and, where permitted, its owner.

    Raises:
      FileExistsError: the name is taken and ``force`` is false.
      OSError: whatever the system refuses.
    """
    check_place(path, force)
    if force:
        keep_owner_and_mode(source, path)
        os.replace(source, path)
        return
    # ``os.replace`` would replace a file that came after the check; a link fails if there is one
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
        check_place(path, force)  # refuses in the user's words, unless the file is gone again
        raise


def _move_over_reservation(source: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Move a file to a name that an empty file takes first: of two writers one fails."""
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    try:
        os.replace(source, path)
    except BaseException:  # Ctrl-C among them
        os.unlink(path)
        raise


def keep_owner_and_mode(source: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Give a file the permissions of the one at ``path``, if there is one, and its owner where permitted."""
    try:
        old, new = os.stat(path), os.stat(source)
    except OSError:  # a new file: its mode follows the umask
        return
    mode = stat.S_IMODE(old.st_mode) & 0o777
    if hasattr(os, "chown"):
        for owner, group in ((old.st_uid, -1), (-1, old.st_gid)):
            with contextlib.suppress(OSError):  # only root gives files away, and groups go to their members
                os.chown(source, owner, group)
        if os.stat(source).st_gid != old.st_gid:  # the members of another group may do what everybody may
            mode = mode & ~0o070 | (mode & 0o007) << 3
    if mode != stat.S_IMODE(new.st_mode):
        with contextlib.suppress(OSError):  # a file system without modes
            os.chmod(source, mode)


# --- files on their way ---


def hidden_name(name: str) -> str:
    """A hidden name, with the writer's pid, for what will be called ``name``."""
    start = os.fsdecode(os.fsencode(name)[:NAME])  # the limit of file systems is in bytes; half a letter does no harm
    return f".{start}.hjbjax.tmp-{os.getpid()}-{secrets.token_hex(4)}"


def lock(handle: int) -> bool:
    """Lock an open file or folder until it is closed, also by the end of the process; False if another lock is on it.

    True as well on a file system without locks.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


@contextlib.contextmanager
def claim(path: Path) -> Iterator[None]:
    """Context with a lock on a folder on its way; it ends with the process, however that ends."""
    if fcntl is None:
        yield
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        lock(handle)
        yield
    finally:
        os.close(handle)


def sweep(folder: str | os.PathLike[str]) -> None:
    """Remove what killed writers left in a folder: files whose names hold a dead pid and that nobody has locked.

    Neither sign is enough without the other: a pid says nothing about another machine that writes into the folder, and
    the lock comes a moment after the file.
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
        os.kill(pid, 0)  # signal 0 sends nothing, and only checks that it could be sent
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # PermissionError: the process of another user
        return True
    return True


def _remove_unclaimed(entry: os.DirEntry) -> None:
    """Remove a file or a folder unless a living writer holds its lock."""
    is_folder = entry.is_dir(follow_symlinks=False)
    if not is_folder and not entry.is_file(follow_symlinks=False):
        return
    handle = os.open(entry.path, os.O_RDONLY | os.O_NOFOLLOW)  # a link that came meanwhile may point anywhere
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises if a writer holds it
        shutil.rmtree(entry.path, ignore_errors=True) if is_folder else os.unlink(entry.path)
    finally:
        os.close(handle)
