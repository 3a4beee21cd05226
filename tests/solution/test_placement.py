"""How files get to their place: no device replaced, no writer's file lost, nothing of a killed writer left."""

import contextlib
import errno
import multiprocessing
import os
import signal
import socket
import stat
import subprocess
import sys

import numpy as np
import pytest

from hjbjax.cli import run_folder
from hjbjax.solution import files, placement
from hjbjax.solution.placement import FileError

RACES = 60
posix = pytest.mark.skipif(os.name != "posix", reason="pipes, devices and locks are POSIX's")


def write(path, number=0.0, *, force=False):
    files.write(path, {"format": "test", "version": 1}, {"a": np.full(3, number)}, force=force)


def read(path):
    plan = {"a": files.Expected(((3,),), optional=False)}
    return files.read(path, "test", 1, lambda header: plan, lambda header, arrays: arrays["a"])


def dead():
    """The pid of a process that has ended."""
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    return child.pid


# --- two writers ---


def race(folder, number, barrier, answers):
    """Write to one new name after the other, together with the other process."""
    won = []
    for k in range(RACES):
        barrier.wait()
        try:
            write(os.path.join(folder, f"{k}.npz"), number)
            won.append(True)
        except FileExistsError:
            won.append(False)
    answers.put((number, won))


@pytest.mark.slow
def test_of_two_writers_without_force_one_succeeds(tmp_path):
    context = multiprocessing.get_context("spawn")
    barrier, answers = context.Barrier(2), context.Queue()
    writers = [context.Process(target=race, args=(str(tmp_path), k, barrier, answers)) for k in (1.0, 2.0)]
    for writer in writers:
        writer.start()
    won = dict(answers.get(timeout=120) for _ in writers)
    for writer in writers:
        writer.join()
    for k in range(RACES):
        (winner,) = [number for number, outcomes in won.items() if outcomes[k]]
        assert read(tmp_path / f"{k}.npz").tolist() == [winner] * 3
    assert len(os.listdir(tmp_path)) == RACES


@pytest.mark.parametrize("links", [True, False], ids=["links", "no links"])
def test_a_name_taken_while_writing_is_kept(tmp_path, monkeypatch, links):
    path = tmp_path / "run.npz"
    fsync = os.fsync

    def meanwhile(handle):
        path.write_bytes(b"another's")
        fsync(handle)

    def no_links(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "fsync", meanwhile)
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    with pytest.raises(FileExistsError, match=r"run\.npz: exists already.*force=True"):
        write(path)
    assert path.read_bytes() == b"another's"
    assert os.listdir(tmp_path) == ["run.npz"]


def test_a_file_system_without_links(tmp_path, monkeypatch):
    def no_links(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "link", no_links)
    write(tmp_path / "run.npz", 3.0)
    assert read(tmp_path / "run.npz").tolist() == [3.0] * 3
    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(FileError, match="No space left"):
        write(tmp_path / "other.npz")
    assert os.listdir(tmp_path) == ["run.npz"]  # no reservation stays


def test_of_two_commands_one_keeps_its_results(tmp_path):
    made = run_folder.FILES[:2]
    out = tmp_path / "out"
    with run_folder.staging(out) as mine, run_folder.staging(out) as theirs:
        for folder, text in ((mine, "mine"), (theirs, "theirs")):
            for name in made:
                (folder / name).write_text(text)
        run_folder.publish(theirs, out, made)
        with pytest.raises(FileExistsError, match="contains solution.npz, value.png already"):
            run_folder.publish(mine, out, made)
        out_again = tmp_path / "again"  # taken between the check and the move
        out_again.mkdir()
        with pytest.MonkeyPatch.context() as patch:
            check = run_folder.check_folder
            patch.setattr(
                run_folder, "check_folder", lambda *a: (check(*a), (out_again / made[0]).write_text("theirs"))[0]
            )
            with pytest.raises(FileExistsError):
                run_folder.publish(mine, out_again, made)
    assert {(out / name).read_text() for name in made} == {"theirs"}
    assert [(path.name, path.read_text()) for path in out_again.iterdir()] == [(made[0], "theirs")]
    assert sorted(os.listdir(tmp_path)) == ["again", "out"]


# --- what is no ordinary file ---


def make_pipe(path):
    os.mkfifo(path)


def make_device(path):
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))  # a node of its own, that of /dev/null
    except PermissionError:
        pytest.skip("only root makes devices")


def make_socket(path):
    with socket.socket(socket.AF_UNIX) as server, contextlib.chdir(path.parent):
        server.bind(path.name)


@posix
@pytest.mark.parametrize("make", [make_pipe, make_device, make_socket])
@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("by_link", [False, True])
def test_devices_pipes_and_sockets_are_not_replaced(tmp_path, make, force, by_link):
    make(tmp_path / "node")
    before = os.lstat(tmp_path / "node")
    os.symlink("node", tmp_path / "link")
    with pytest.raises(FileError, match=r"node: cannot be written: it is a device, a pipe or a socket") as caught:
        write(tmp_path / ("link" if by_link else "node"), force=force)
    assert not isinstance(caught.value, FileExistsError)
    assert os.lstat(tmp_path / "node")[:3] == before[:3]
    assert sorted(os.listdir(tmp_path)) == ["link", "node"]


@posix
def test_a_command_replaces_no_pipe(tmp_path):
    make_pipe(tmp_path / "value.png")
    with pytest.raises(FileError, match=r"value.png: cannot be written: it is a device"):
        run_folder.check_folder(tmp_path, force=True)


def test_a_disk_that_became_read_only_is_the_reason_given(tmp_path, monkeypatch):
    """Removing the half file fails as well, which used to be all that was reported."""
    path = tmp_path / "run.npz"
    write(path)
    before = path.read_bytes()

    def read_only(*_):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "fsync", read_only)
    monkeypatch.setattr(os, "unlink", read_only)
    with pytest.raises(FileError, match=r"run\.npz: cannot be written: Read-only file system"):
        write(path, 1.0, force=True)
    assert path.read_bytes() == before


# --- names ---


@pytest.mark.parametrize("there", [["run"], ["run", "run.npz"]])
def test_a_folder_of_the_same_name(tmp_path, there):
    """``hjbjax solve pendulum --checkpoint pendulum`` makes both, and could not be resumed."""
    (tmp_path / "run").mkdir()
    for name in there[1:]:
        write(tmp_path / name, 1.0)
    if there[1:]:
        assert read(tmp_path / "run").tolist() == [1.0] * 3
        write(tmp_path / "run", 2.0, force=True)
        assert read(tmp_path / "run.npz").tolist() == [2.0] * 3
    else:
        with pytest.raises(FileError, match="run: cannot be written: it is a folder; give a file in it"):
            write(tmp_path / "run")


@pytest.mark.parametrize("name", ["é" * 125 + ".npz", "𝛽" * 62 + ".npz", "x" * 253 + ".b"])
def test_any_name_that_the_system_takes(tmp_path, name):
    write(tmp_path / name)
    assert os.listdir(tmp_path) == [name]


def test_a_name_that_is_too_long(tmp_path):
    with pytest.raises(FileError, match="name too long"):
        write(tmp_path / ("x" * 256))
    assert os.listdir(tmp_path) == []


# --- permissions ---


def mode(path):
    return stat.S_IMODE(os.stat(path).st_mode)


@posix
@pytest.mark.parametrize("kept", [0o600, 0o640, 0o444, 0o777])
def test_a_file_that_is_replaced_keeps_its_mode_and_its_owner(tmp_path, kept):
    path, other = tmp_path / "run.npz", tmp_path / "link.npz"
    write(path)
    os.chmod(path, kept)
    os.symlink(path, other)
    if os.geteuid() == 0:
        os.chown(path, 1234, 1235)
    before = os.stat(path)
    for number, name in ((0.0, path), (1.0, other)):
        write(name, number, force=True)
        after = os.stat(path)
        assert (mode(path), after.st_uid, after.st_gid) == (kept, before.st_uid, before.st_gid)
    assert read(path).tolist() == [1.0] * 3


@posix
def test_a_file_that_is_moved_over_another_takes_its_mode(tmp_path):
    """As the files of a command, which are made in a folder of their own."""
    for name, text in (("made", "new"), ("old", "old")):
        (tmp_path / name).write_text(text)
    os.chmod(tmp_path / "old", 0o600)
    placement.place(tmp_path / "made", tmp_path / "old", force=True)
    assert (mode(tmp_path / "old"), (tmp_path / "old").read_text()) == (0o600, "new")


@posix
@pytest.mark.parametrize(("mask", "wanted"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
@pytest.mark.parametrize("force", [False, True])
def test_the_mode_of_a_new_file_follows_the_umask(tmp_path, mask, wanted, force):
    usual = os.umask(mask)
    try:
        write(tmp_path / "run.npz", force=force)
    finally:
        os.umask(usual)
    assert mode(tmp_path / "run.npz") == wanted


@posix
def test_a_private_file_is_private_from_its_first_byte(tmp_path):
    path, seen = tmp_path / "run.npz", []
    write(path)
    os.chmod(path, 0o600)
    files.write_whole(path, lambda stream: seen.append(stat.S_IMODE(os.fstat(stream.fileno()).st_mode)), force=True)
    assert seen == [0o600]


@posix
def test_where_the_group_cannot_be_kept_it_may_do_what_everybody_may(tmp_path, monkeypatch):
    path = tmp_path / "run.npz"
    write(path)
    os.chmod(path, 0o664)
    stat_of, there = os.stat, os.stat(path).st_ino

    def of_another_group(name, **options):
        found = stat_of(name, **options)
        return os.stat_result([*found[:5], 4321, *found[6:]]) if found.st_ino == there else found

    def refused(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "chown", refused)
    monkeypatch.setattr(os, "stat", of_another_group)
    write(path, force=True)
    monkeypatch.undo()
    assert mode(path) == 0o644


# --- what killed writers leave ---


def left_by(pid, name="run.npz"):
    return f".{name}.hjbjax.tmp-{pid}-0123abcd"


def test_hidden_names_are_recognised():
    for name in ("run.npz", "out", ".hidden", "with\nnewline"):
        found = placement.OWN.fullmatch(placement.hidden_name(name))
        assert int(found[1]) == os.getpid()


@posix
def test_the_next_writer_takes_away_what_the_dead_left(tmp_path):
    pid = dead()
    gone = [tmp_path / left_by(pid), tmp_path / left_by(pid, "other.npz"), tmp_path / left_by(pid, "folder")]
    for path in gone[:2]:
        path.write_bytes(b"half")
    gone[2].mkdir()
    (gone[2] / "value.png").write_bytes(b"half")
    stay = [tmp_path / left_by(os.getpid()), tmp_path / left_by(1), tmp_path / f".run.npz.{pid}-0123abcd.tmp"]
    for path in stay:
        path.write_bytes(b"whose?")
    os.symlink(stay[0], tmp_path / left_by(pid, "link"))  # no writer makes links
    write(tmp_path / "run.npz")
    names = {path.name for path in stay} | {"run.npz", left_by(pid, "link")}
    assert set(os.listdir(tmp_path)) == names


@posix
def test_what_the_process_of_another_user_is_writing_stays(tmp_path, monkeypatch):
    path = tmp_path / left_by(dead())
    path.write_bytes(b"half")

    def not_permitted(pid, number):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    with monkeypatch.context() as patched:
        patched.setattr(os, "kill", not_permitted)
        write(tmp_path / "run.npz")
    assert path.exists()
    write(tmp_path / "run.npz", force=True)
    assert not path.exists()


@posix
def test_what_another_machine_is_writing_stays(tmp_path):
    path = tmp_path / left_by(dead())  # a pid of theirs that is free here
    path.write_bytes(b"half")
    program = f"""
import time
from hjbjax.solution import placement
with placement.claim({str(path)!r}):
    print("claimed", flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "claimed\n"
        write(tmp_path / "run.npz")
        assert path.exists()
        other.kill()
    write(tmp_path / "run.npz", force=True)
    assert os.listdir(tmp_path) == ["run.npz"]


@posix
def test_kill_minus_nine_leaves_nothing_for_long(tmp_path):
    program = f"""
import os, signal
import numpy as np
from hjbjax.solution import files
os.fsync = lambda handle: os.kill(os.getpid(), signal.SIGKILL)
files.write({str(tmp_path / "run.npz")!r}, {{"format": "test", "version": 1}}, {{"a": np.ones(3)}})
"""
    child = subprocess.run([sys.executable, "-c", program], check=False)
    assert child.returncode == -signal.SIGKILL
    (left,) = os.listdir(tmp_path)
    assert placement.OWN.fullmatch(left)
    with run_folder.staging(tmp_path / "out"):  # a command takes it away as well
        assert left not in os.listdir(tmp_path)
    assert os.listdir(tmp_path) == []
