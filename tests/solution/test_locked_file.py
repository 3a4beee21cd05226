"""Files that one run holds: locked from beginning to end, never lost to another run, never left half written."""

import contextlib
import errno
import os
import signal
import subprocess
import sys
import threading

import pytest

from hjbjax.solution import files, placement
from hjbjax.solution.locked_file import LockedFile
from hjbjax.solution.placement import FileError

pytestmark = pytest.mark.skipif(os.name != "posix", reason="locks and handles of replaced files are POSIX's")

# another process that locks a file, as a run does, without the seconds that importing JAX takes
HOLDER = """
import fcntl, sys, time
with open(sys.argv[1], "r+b") as file:
    fcntl.flock(file, fcntl.LOCK_EX)
    print("locked", flush=True)
    time.sleep(60)
"""


def text(word):
    return lambda stream: stream.write(word.encode())


def handles():
    """How many files this process has open."""
    return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0


@pytest.fixture
def path(tmp_path):
    return str(tmp_path / "run.npz")


def test_the_lock_moves_with_the_name_from_file_to_file(path):
    before = handles()
    mine, other = LockedFile(path), LockedFile(path)
    assert not mine.take()
    for word in ("one", "two", "three"):
        mine.write(text(word))
        with pytest.raises(FileError, match=r"run\.npz: another run is using it; wait for its end, or give another"):
            other.take()
        with open(path) as file:
            assert file.read() == word
    assert handles() <= before + 1
    mine.close()
    assert other.take()
    with pytest.raises(FileError, match="another run is using it"):
        mine.take()
    other.close()
    assert handles() == before
    assert os.listdir(os.path.dirname(path)) == ["run.npz"]


def test_a_lock_ends_with_its_process(path):
    mine = LockedFile(path)
    files.write_whole(path, text("one"))
    with subprocess.Popen([sys.executable, "-c", HOLDER, path], stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        with pytest.raises(FileError, match="another run is using it"):
            mine.take()
        other.send_signal(signal.SIGKILL)
        other.wait()
    assert mine.take()
    mine.close()


@pytest.mark.filterwarnings("ignore:.*fork")  # of a process with threads
def test_a_worker_that_outlives_its_run_keeps_no_lock(path):
    """A process forked by a library, as by ``multiprocessing``, has copies of all handles."""
    mine, other = LockedFile(path), LockedFile(path)
    mine.write(text("one"))
    (ended, end), (begun, begin) = os.pipe(), os.pipe()
    if (worker := os.fork()) == 0:
        os.close(end)
        os.write(begin, b"!")
        os.read(ended, 1)
        os._exit(0)
    try:
        os.read(begun, 1)
        with pytest.raises(FileError, match="another run is using it"):
            other.take()
        mine.close()  # as the system does when the run is killed
        assert other.take()
        other.close()
    finally:
        for handle in (ended, end, begun, begin):
            os.close(handle)
        os.waitpid(worker, 0)


@pytest.mark.parametrize("links", [True, False], ids=["links", "no links"])
def test_of_many_threads_one_gets_a_new_file(path, monkeypatch, links):
    if not links:
        monkeypatch.delattr(os, "link")
    for _ in range(30):
        barrier, ends, refusals = threading.Barrier(4), [], []

        def begin(word, barrier=barrier, ends=ends, refusals=refusals):
            own = LockedFile(path)
            barrier.wait()
            try:
                while not own.take():
                    with contextlib.suppress(FileExistsError):
                        own.write(text(word))
                        break
            except FileError as error:
                refusals.append(str(error))
            else:
                ends.append((word, own))

        threads = [threading.Thread(target=begin, args=(word,)) for word in "abcd"]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        ((word, own),) = ends
        assert all("another run is using it" in each or "it is empty" in each for each in refusals)
        with open(path) as file:
            assert file.read() == word
        own.remove()
        own.close()


def test_a_new_file_replaces_none_that_appeared_meanwhile(path):
    def slow(stream):
        stream.write(b"mine")
        with open(path, "w") as other:
            other.write("another's")

    mine = LockedFile(path)
    with pytest.raises(FileExistsError):
        mine.write(slow)
    with open(path) as file:
        assert file.read() == "another's"
    assert mine.take()  # nobody else holds it
    mine.close()


def test_a_file_put_in_the_place_of_the_own_one_is_not_replaced(path):
    mine = LockedFile(path)
    mine.write(text("mine"))
    os.rename(path, path + ".old")
    with open(path, "w") as other:
        other.write("another's")
    for _ in range(2):
        with pytest.raises(
            FileError, match=r"run\.npz: cannot be written: another run or program has put its own file"
        ):
            mine.write(text("mine again"))
    mine.remove()
    with open(path) as file:
        assert file.read() == "another's"
    os.unlink(path)
    mine.write(text("mine again"))  # the name is free again
    mine.write(text("and again"))
    mine.close()


def test_a_failed_write_leaves_the_old_file_and_its_lock(path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    mine = LockedFile(path)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(FileError, match="No space left"):
            mine.write(text("one"))
    assert not mine.take()
    mine.write(text("one"))
    before = handles()
    for call in ("fsync", "replace"):
        with monkeypatch.context() as patched:
            patched.setattr(os, call, full)
            with pytest.raises(FileError, match="No space left"):
                mine.write(text("two"))
        with pytest.raises(FileError, match="another run is using it"):
            LockedFile(path).take()
    assert handles() == before
    with open(path) as file:
        assert file.read() == "one"
    mine.close()
    assert os.listdir(os.path.dirname(path)) == ["run.npz"]


@pytest.mark.parametrize("moment", ["before the move", "after it"])
def test_ctrl_c_during_a_write_loses_no_lock(path, monkeypatch, moment):
    mine, replace = LockedFile(path), os.replace
    mine.write(text("one"))

    def interrupted(*names):
        if moment == "after it":
            replace(*names)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            mine.write(text("two"))
    with pytest.raises(FileError, match="another run is using it"):
        LockedFile(path).take()
    mine.write(text("three"))
    mine.close()
    assert os.listdir(os.path.dirname(path)) == ["run.npz"]


def test_without_locks_a_run_does_not_replace_the_file_of_another(path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(placement.fcntl, "flock", no_locks)
    mine, other = LockedFile(path), LockedFile(path)
    mine.write(text("mine"))
    assert other.take()
    other.write(text("another's"))
    with pytest.raises(FileError, match="another run or program has put its own file there"):
        mine.write(text("mine"))
    mine.close()
    other.close()


def test_where_there_are_no_locks_no_handle_is_kept(path, monkeypatch):
    """Windows replaces no open file."""
    monkeypatch.setattr(placement, "fcntl", None)
    before, mine = handles(), LockedFile(path)
    mine.write(text("one"))
    mine.write(text("two"))
    assert handles() == before
    mine.close()
    assert mine.take()
    assert handles() == before
    os.rename(path, path + ".old")
    files.write_whole(path, text("another's"))
    with pytest.raises(FileError, match="another run or program"):
        mine.write(text("three"))


def test_a_trial_leaves_nothing(path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    files.write_whole(path, text("one"))
    placement.try_place(path)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(FileError, match=r"run\.npz: cannot be written: No space left"):
            placement.try_place(path)
    assert os.listdir(os.path.dirname(path)) == ["run.npz"]


def test_in_a_shared_folder_a_trial_finds_the_file_of_another_user(path, monkeypatch):
    files.write_whole(path, text("one"))
    folder, user = os.path.dirname(path), os.geteuid()
    os.chmod(folder, 0o1777)
    placement.try_place(path)
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    with pytest.raises(FileError, match="in this folder only the owner of a file may replace it"):
        placement.try_place(path)
    assert os.listdir(folder) == ["run.npz"]
