"""Atomic placement of files, and removal of temporary files left by killed writers.

A file is written under a hidden name in its folder and moved when it is complete: by ``os.replace`` if an older file
may be replaced, otherwise by ``os.link``, which fails if another writer has created the file meanwhile. The new file
has the mode of the file it replaces.
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
except ImportError:  # Windows: no locks, and no removal of leftover files
    fcntl = None  # type: ignore[assignment]

Path: TypeAlias = str | bytes | os.PathLike  # types that the system accepts as the name of a file
NAME = 64  # leading bytes of a file's name in its temporary name; file systems allow 255 in all
OWN = re.compile(r"\..*\.hjbjax\.tmp-(\d+)-[0-9a-f]{8}", re.DOTALL)  # names of temporary files, with the writer's pid
BLOCK = 4096  # size of a test file in bytes: the least that a file system allocates


class FileError(OSError):
    """A result file could not be written or read; the message names the path and the reason."""


class MissingFileError(FileError, FileNotFoundError):
    """A file does not exist; for callers that catch the exception of ``open``."""


def path_of(path: Path, done: str) -> str:
    """The name of a file as text.

    Args:
      path: the name.
      done: the intended operation, such as "read".

    Raises:
      FileError: not a path, or one that no system accepts: with a null byte, or with half of a surrogate pair.
    """
    try:
        text = os.fsdecode(path)
    except TypeError:
        raise FileError(f"{path!r:.80}: cannot be {done}: it is not a path; wanted the name of a file") from None
    if "\0" in text:
        raise FileError(f"{path!r}: cannot be {done}: there is a null byte in the name")
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        raise FileError(f"{path!r}: cannot be {done}: the system cannot encode this name") from None
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
    """The absolute path of a file to be written, with links resolved.

    Raises:
      FileError: the path is relative, and the current folder has been removed.
    """
    try:
        return os.path.realpath(path if os.path.isabs(path) else os.path.join(current_folder(), path))
    except FileError as error:
        raise FileError(f"{path}: cannot be written: {error}, or give an absolute path") from error


def check_place(path: str | os.PathLike[str], force: bool) -> None:
    """Refuse a path where a file cannot be written.

    Raises:
      FileExistsError: the file exists and ``force`` is false.
      FileError: the path is a folder, a device, which replacing would remove from the machine, or a link to itself.
    """
    try:
        mode = os.stat(path).st_mode
    except OSError as error:  # the path is free, or writing will report the reason
        if error.errno == errno.ELOOP and not force:
            raise FileError(f"{path}: cannot be written: it is a link to itself") from error
        return
    if stat.S_ISDIR(mode):
        raise FileError(f"{path}: cannot be written: it is a folder; give a file in it, such as 'run.npz'")
    if not stat.S_ISREG(mode):
        raise FileError(f"{path}: cannot be written: it is a device, a pipe or a socket; give another name")
    if not force:
        raise FileExistsError(f"{path}: exists already; give another name, or force=True to replace it")


@contextlib.contextmanager
def new_file(path: str) -> Iterator[tuple[str, IO[bytes]]]:
    """Context with the hidden name and the open stream of a file that ``place`` will move to ``path``.

    The file is locked, and removed at the end unless it was moved.

    Raises:
      FileError: any error of the system.
    """
    folder, name = os.path.split(path)
    remove_leftovers(folder)
    temporary = os.path.join(folder, hidden_name(name))
    try:
        with open(temporary, "xb") as stream:
            lock(stream.fileno())  # the pid in the name protects the file until here
            keep_owner_and_mode(temporary, path)  # before it has content that others may not read
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


def flush_to_disk(stream: IO[bytes]) -> None:
    """Flush all bytes to the disk; otherwise a power cut may leave the new name without content."""
    stream.flush()
    os.fsync(stream.fileno())
    if fcntl is None:  # Windows cannot move an open file; elsewhere it stays open and locked until it is moved
        stream.close()


def try_place(path: str) -> None:
    """Test that a run can replace the file at ``path``, by writing and removing a small file next to it.

    Raises:
      FileError: no file can be written there, or the file belongs to another user, in a folder like /tmp.
    """
    with new_file(path) as (_, stream):
        stream.write(bytes(BLOCK))
        flush_to_disk(stream)
        folder, old = os.stat(os.path.dirname(path)), os.stat(path)
        if folder.st_mode & stat.S_ISVTX and os.geteuid() not in (0, folder.st_uid, old.st_uid):
            raise FileError(f"{path}: cannot be written: in this folder only the owner of a file may replace it")


def place(source: str | os.PathLike[str], path: str | os.PathLike[str], force: bool) -> None:
    """Move a complete file to its name atomically; without ``force`` only if that name is free at that moment.

    A file that replaces another one takes over its mode and, where permitted, its owner.

    Raises:
      FileExistsError: the name is taken and ``force`` is false.
      OSError: any error of the system.
    """
    check_place(path, force)
    if force:
        keep_owner_and_mode(source, path)
        os.replace(source, path)
        return
    # ``os.replace`` would replace a file created after the check; a link fails if there is one
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
        check_place(path, force)  # raises a readable error, unless the file is gone again
        raise


def _move_over_reservation(source: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Move a file to a name that is first reserved by an empty file, so that one of two writers fails."""
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    try:
        os.replace(source, path)
    except BaseException:  # including Ctrl-C
        os.unlink(path)
        raise


def keep_owner_and_mode(source: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Give a file the permissions of the file at ``path``, if it exists, and its owner where permitted."""
    try:
        old, new = os.stat(path), os.stat(source)
    except OSError:  # for a new file the mode follows the umask
        return
    mode = stat.S_IMODE(old.st_mode) & 0o777
    if hasattr(os, "chown"):
        for owner, group in ((old.st_uid, -1), (-1, old.st_gid)):
            with contextlib.suppress(OSError):  # only root can change the owner, and only members the group
                os.chown(source, owner, group)
        if os.stat(source).st_gid != old.st_gid:  # members of another group get the permissions of others
            mode = mode & ~0o070 | (mode & 0o007) << 3
    if mode != stat.S_IMODE(new.st_mode):
        with contextlib.suppress(OSError):  # some file systems have no modes
            os.chmod(source, mode)


# --- temporary files ---


def hidden_name(name: str) -> str:
    """A hidden temporary name, with the writer's pid, for the file ``name``."""
    start = os.fsdecode(os.fsencode(name)[:NAME])  # the limit is in bytes; a truncated character is harmless
    return f".{start}.hjbjax.tmp-{os.getpid()}-{secrets.token_hex(4)}"


def lock(handle: int) -> bool:
    """Lock an open file or folder until it is closed or the process ends; False if it is already locked.

    Also returns True on a file system without locks.
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
    """Context with a lock on a temporary folder; the lock ends with the process."""
    if fcntl is None:
        yield
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        lock(handle)
        yield
    finally:
        os.close(handle)


def remove_leftovers(folder: str | os.PathLike[str]) -> None:
    """Remove temporary files of killed writers from a folder: files with a dead pid in their name and without a lock.

    Both conditions are required: the pid may belong to a process on another machine that writes into the folder, and
    the lock is set a moment after the file is created.
    """
    if fcntl is None:
        return
    with contextlib.suppress(OSError):  # if a folder cannot be listed, writing may still work
        for entry in os.scandir(folder):
            found = OWN.fullmatch(entry.name)
            if found and not _is_alive(int(found[1])):
                with contextlib.suppress(OSError):
                    _remove_unclaimed(entry)


def _is_alive(pid: int) -> bool:
    """True if a process with this pid runs on this machine."""
    try:
        os.kill(pid, 0)  # signal 0 sends nothing; it only checks that the process exists
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # PermissionError: a process of another user
        return True
    return True


def _remove_unclaimed(entry: os.DirEntry) -> None:
    """Remove a file or a folder unless a living writer has locked it."""
    is_folder = entry.is_dir(follow_symlinks=False)
    if not is_folder and not entry.is_file(follow_symlinks=False):
        return
    handle = os.open(entry.path, os.O_RDONLY | os.O_NOFOLLOW)  # a link created meanwhile may point anywhere
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises if a writer has locked it
        shutil.rmtree(entry.path, ignore_errors=True) if is_folder else os.unlink(entry.path)
    finally:
        os.close(handle)
