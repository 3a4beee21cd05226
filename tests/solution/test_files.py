"""Result files: whole or not at all, and nothing in a bad one is believed."""

import errno
import io
import json
import os
import pathlib
import pickle
import signal
import subprocess
import sys
import textwrap
import time
import zipfile

import numpy as np
import pytest
from counted_reads import counted_reads

from hjbjax.problem.grid import Grid
from hjbjax.solution import files
from hjbjax.solution.archive import FORMAT, VERSION
from hjbjax.solution.files import FileError
from hjbjax.solution.solution import Solution, Status, load


def example(seed=0, **changes):
    random = np.random.default_rng(seed)
    grid = Grid([-np.pi, 0.1], [np.pi, 0.7], (4, 3), (True, False), ("angle", "speed"))
    value = random.normal(size=(4, 3))
    value[0, :] = [np.nan, np.inf, -0.0]
    fields = {
        "grid": grid,
        "value": value,
        "policy": random.normal(size=(4, 3, 2)),
        "disturbance": random.normal(size=(4, 3, 1)),
        "code": Status.STALLED,
        "steps": 17,
        "enclosure": random.normal(size=(2, 2)),
        "isaacs_gap": 0.1 + 0.2,
        "reached": random.random((4, 3)) < 0.5,
        "discrete": True,
        "residuals": random.random(5),
        "stats": {"method": "Test(é)", "seconds": 0.1, "tol": float("inf"), "versions": {"jax": "1.2"}},
        "message": "a test of “quotes”\nand lines",
    }
    return Solution(**{**fields, **changes})


ARRAYS = ("value", "policy", "disturbance", "enclosure", "reached", "times", "residuals")
OTHERS = ("code", "steps", "isaacs_gap", "discrete", "discrete_disturbance", "stats", "message")


def assert_same(one, other):
    for name in ARRAYS:
        a, b = getattr(one, name), getattr(other, name)
        if a is None:
            assert b is None, name
        else:
            assert (a.dtype, a.shape, np.asarray(a).tobytes()) == (b.dtype, b.shape, b.tobytes()), name
    for name in OTHERS:
        assert getattr(one, name) == getattr(other, name), name
    for name in ("shape", "periodic", "names"):
        assert getattr(one.grid, name) == getattr(other.grid, name), name
    assert one.grid.lo.tobytes() == other.grid.lo.tobytes()
    assert one.grid.hi.tobytes() == other.grid.hi.tobytes()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"disturbance": None, "enclosure": None, "isaacs_gap": None, "reached": None, "policy": None},
        {"policy": np.zeros((4, 3, 0)), "residuals": np.zeros(0), "stats": {}, "isaacs_gap": float("nan")},
        {"value": np.ones((4, 3), np.float32), "policy": np.asfortranarray(np.arange(24.0).reshape(4, 3, 2))},
        {"times": np.array([0.0, 0.5]), "value": np.arange(24.0).reshape(2, 4, 3), "policy": np.ones((2, 4, 3, 1))}
        | {"enclosure": None, "disturbance": None},
    ],
    ids=["all", "least", "empty", "float32", "marched"],
)
def test_round_trip_is_exact(tmp_path, changes):
    solution = example(**changes)
    solution.save(tmp_path / "run.npz")
    loaded = load(tmp_path / "run.npz")
    if solution.isaacs_gap is not None and np.isnan(solution.isaacs_gap):
        assert np.isnan(loaded.isaacs_gap)
        object.__setattr__(solution, "isaacs_gap", None)
        object.__setattr__(loaded, "isaacs_gap", None)
    assert_same(solution, loaded)
    assert loaded.status is Status.STALLED
    assert loaded.value.flags.writeable


def test_equal_solutions_make_equal_files_that_numpy_can_read(tmp_path):
    example().save(tmp_path / "a.npz")
    example().save(str(tmp_path / "b.file"))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.file").read_bytes()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["value"], example().value)
        assert json.loads(archive["header"].tobytes())["format"] == FORMAT


def test_names_without_a_suffix_get_numpys(tmp_path):
    example(steps=1).save(tmp_path / "run")
    assert [each.name for each in tmp_path.iterdir()] == ["run.npz"]
    assert load(tmp_path / "run").steps == load(tmp_path / "run.npz").steps == 1
    with pytest.raises(FileExistsError, match="run.npz: exists already"):
        example().save(tmp_path / "run")
    (tmp_path / "old").write_bytes((tmp_path / "run.npz").read_bytes())
    assert load(tmp_path / "old").steps == 1
    with pytest.raises(FileError, match="it is a folder"):
        example().save(tmp_path)


def test_statistics_become_json(tmp_path):
    stats = {"seconds": np.float64(0.1), "counts": (1, np.int32(2)), "array": np.arange(2), "method": Status, 3: None}
    example(stats=stats).save(tmp_path / "run.npz")
    expected = {"seconds": 0.1, "counts": [1, 2], "array": [0, 1], "method": str(Status), "3": None}
    assert load(tmp_path / "run.npz").stats == expected


def test_no_overwriting_unless_forced(tmp_path):
    path = tmp_path / "run.npz"
    example(1).save(path)
    with pytest.raises(FileExistsError, match=r"run\.npz: exists already.*force=True"):
        example(2).save(path)
    assert_same(load(path), example(1))
    example(2).save(path, force=True)
    assert_same(load(path), example(2))


def test_a_forced_save_through_a_link_keeps_the_link(tmp_path):
    example(1).save(tmp_path / "run.npz")
    os.symlink("run.npz", tmp_path / "link.npz")
    example(2).save(tmp_path / "link.npz", force=True)
    assert os.path.islink(tmp_path / "link.npz")
    assert_same(load(tmp_path / "run.npz"), example(2))


def test_what_cannot_be_written(tmp_path):
    with pytest.raises(FileError, match="no/run.npz: cannot be written: there is no folder .*no$"):
        example().save(tmp_path / "no" / "run.npz")
    with pytest.raises(FileError, match="it is a folder"):
        example().save(tmp_path, force=True)


@pytest.mark.parametrize("name", [None, 5, 2.5, ["run.npz"], "a\0b", b"a\0b", "\ud800"])
def test_what_is_no_name_of_a_file(name):
    for done, ask in (("written", example().save), ("read", load)):
        with pytest.raises(
            FileError, match=f"cannot be {done}: (it is not a path|there is a null byte|the system cannot encode)"
        ):
            ask(name)


def test_a_link_to_itself_is_no_file(tmp_path):
    loop = tmp_path / "run.npz"
    loop.symlink_to(loop)
    with pytest.raises(FileError, match="run.npz: cannot be written: it is a link to itself"):
        example().save(loop)
    assert os.listdir(tmp_path) == ["run.npz"]


def test_bytes_and_paths_are_names(tmp_path):
    example().save(os.fsencode(tmp_path / "run.npz"))
    assert_same(load(os.fsencode(tmp_path / "run.npz")), example())


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file_and_no_other(tmp_path, monkeypatch, call):
    path = tmp_path / "run.npz"
    example(1).save(path)

    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, call, full)
    with pytest.raises(FileError, match="run.npz: cannot be written: No space left on device"):
        example(2).save(path, force=True)
    monkeypatch.undo()
    assert_same(load(path), example(1))
    assert os.listdir(tmp_path) == ["run.npz"]


@pytest.mark.parametrize(
    ("owner", "call"),
    [(np.lib.format, "write_array"), (zipfile, "_ZipWriteFile"), (os, "fsync"), (os, "link")],
    ids=["array", "entry", "fsync", "link"],
)
def test_ctrl_c_while_writing_leaves_nothing(tmp_path, monkeypatch, owner, call):
    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(owner, call, interrupt)
    with pytest.raises(KeyboardInterrupt):
        example().save(tmp_path / "run.npz")
    assert os.listdir(tmp_path) == []


def test_bytes_are_on_the_disk_before_the_name_moves(tmp_path, monkeypatch):
    calls, fsync, replace, link = [], os.fsync, os.replace, os.link
    monkeypatch.setattr(os, "fsync", lambda handle: (calls.append("fsync"), fsync(handle))[1])
    monkeypatch.setattr(os, "replace", lambda a, b: (calls.append("replace"), replace(a, b))[1])
    monkeypatch.setattr(os, "link", lambda a, b: (calls.append("link"), link(a, b))[1])
    example().save(tmp_path / "run.npz")
    assert calls[:2] == ["fsync", "link"]
    calls.clear()
    example().save(tmp_path / "run.npz", force=True)
    assert calls[:2] == ["fsync", "replace"]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_kill_minus_nine_while_writing_leaves_a_whole_file(tmp_path):
    path = tmp_path / "run.npz"
    program = f"""
        import numpy as np
        from hjbjax.solution import files
        for number in range(10**9):
            array = np.full(300_000, number * 1.0)
            files.write({str(path)!r}, {{"format": "test", "version": 1}}, {{"a": array}}, force=True)
    """
    child = subprocess.Popen([sys.executable, "-c", textwrap.dedent(program)])
    try:
        deadline = time.monotonic() + 60
        while not path.exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        time.sleep(0.05)
    finally:
        child.kill()
        child.wait()
    plan = {"a": files.Expected(((300_000,),), optional=False)}
    array = files.read(path, "test", 1, lambda header: plan, lambda header, arrays: arrays["a"])
    assert np.all(array == array[0])


def test_a_batch_or_a_misfit_is_not_written(tmp_path):
    for changes in ({"value": np.zeros((5, 4, 3))}, {"policy": np.zeros((4, 3))}, {"value": np.zeros((4, 3), int)}):
        with pytest.raises(ValueError, match=rf"Solution.save: {next(iter(changes))} has"):
            example(**changes).save(tmp_path / "run.npz")
    assert os.listdir(tmp_path) == []


# Bad files. Each must be refused by one FileError that names path and reason, at the cost of reading the file.


def refused(path, reason):
    with counted_reads() as reads, pytest.raises(FileError, match=reason) as caught:
        load(path)
    if os.path.isfile(path):  # a claim of 8 TB costs nothing: of a file no more is read than a few times its bytes
        assert sum(reads) <= 4 * os.path.getsize(path) + 100
    assert str(caught.value).startswith(f"{path}: cannot be read: ")
    assert len(str(caught.value).splitlines()) == 1


def good(path):
    example().save(path, force=True)
    return path.read_bytes()


def rewritten(path, *, header=None, drop=(), compression=zipfile.ZIP_STORED, **members):
    """A good file with some of its header or members exchanged: bytes as they are, arrays as npy."""
    source = zipfile.ZipFile(io.BytesIO(good(path)))
    content = {name: source.read(name) for name in source.namelist()}
    about = json.loads(np.load(io.BytesIO(content["header.npy"])).tobytes())
    about = about | header if isinstance(header, dict) else about
    about["arrays"] = sorted({*about["arrays"], *members} - set(drop))
    text = header if isinstance(header, bytes) else json.dumps(about).encode()
    members = {"header": np.frombuffer(text, np.uint8), **members}
    for name, member in members.items():
        buffer = io.BytesIO()
        if not isinstance(member, bytes):
            np.save(buffer, member)
        content[name + ".npy"] = member if isinstance(member, bytes) else buffer.getvalue()
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in content.items():
            if name.removesuffix(".npy") not in drop:
                archive.writestr(name, data)
    return path


def npy(declaration, data=b""):
    text = declaration.encode() + b"\n"
    return b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text + data


def test_rewriting_alone_changes_nothing(tmp_path):
    assert_same(load(rewritten(tmp_path / "run.npz")), example())


def test_missing_folder_empty_and_pipe(tmp_path):
    refused(tmp_path / "no.npz", "No such file or directory")
    refused(tmp_path, "it is a folder")
    (tmp_path / "empty.npz").write_bytes(b"")
    refused(tmp_path / "empty.npz", "it is empty")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        refused(tmp_path / "pipe", "not an ordinary file")


def test_every_truncation_is_refused(tmp_path):
    path = tmp_path / "run.npz"
    data = good(path)
    for length in {*range(1, 8), *range(8, len(data), 41), *range(len(data) - 30, len(data))}:
        path.write_bytes(data[:length])
        refused(path, "truncated|not an npz file|damaged")


def test_a_lost_byte_is_refused(tmp_path):
    path = tmp_path / "run.npz"
    data = good(path)
    for place in range(4, len(data), 401):
        path.write_bytes(data[:place] + data[place + 1 :])
        refused(path, "truncated|damaged")


@pytest.mark.slow
def test_every_flipped_bit_is_refused_or_without_consequence(tmp_path):
    path, random = tmp_path / "run.npz", np.random.default_rng(0)
    data, harmless = good(path), 0
    places = range(0, len(data), 3)
    for place in places:
        broken = bytearray(data)
        broken[place] ^= 1 << int(random.integers(8))
        path.write_bytes(broken)
        try:
            loaded = load(path)
        except FileError:
            continue
        assert_same(loaded, example())  # dates, attributes and the like, of which a zip has some
        harmless += 1
    assert harmless < 0.2 * len(places)


def test_an_entry_that_vanished_is_missed(tmp_path):
    path = rewritten(tmp_path / "run.npz", drop=["policy"])
    assert load(path).policy is None
    source = zipfile.ZipFile(io.BytesIO(good(path)))
    with zipfile.ZipFile(path, "w") as archive:
        for name in source.namelist():
            if name != "policy.npy":
                archive.writestr(name, source.read(name))
    refused(path, "does not hold the arrays that its header lists: policy")


def test_damage_inside_the_values_is_named(tmp_path):
    path = tmp_path / "run.npz"
    data = bytearray(good(path))
    data[bytes(data).index(example().policy.tobytes()) + 5] ^= 16
    path.write_bytes(data)
    refused(path, "it is damaged: Bad CRC-32 for file 'policy.npy'")


def test_foreign_files(tmp_path):
    path = tmp_path / "run.npz"
    for name, data in {"text": b"hello, this is text", "npy": npy("{}"), "zeros": bytes(4096)}.items():
        (tmp_path / name).write_bytes(data)
        refused(tmp_path / name, "it is not an npz file")
    np.savez(path, value=np.zeros((4, 3)))
    refused(path, "it has no header")
    np.savez(path, header=np.zeros(3))
    refused(path, "'header' has dtype '<f8'")
    refused(rewritten(path, header=b"not json"), "damaged or foreign.*JSONDecodeError")
    refused(rewritten(path, header=b"\xff\xfe\x00"), "damaged or foreign")
    refused(rewritten(path, header=b"[" * 100_000), "damaged or foreign")
    refused(rewritten(path, header=b"[]"), "another program wrote it")
    refused(rewritten(path, header={"format": "other"}), "another program wrote it")
    refused(rewritten(path, extra=np.zeros(3)), "unknown entry 'extra'")
    refused(rewritten(path, drop=["value"]), "'value' is missing")
    refused(rewritten(path, compression=zipfile.ZIP_DEFLATED), "compressed")


def test_other_versions(tmp_path):
    path = tmp_path / "run.npz"
    refused(rewritten(path, header={"version": VERSION + 1}, later=np.zeros(3)), "newer than the 1 .*update hjbjax")
    for version in (0, -1, 1.0, True, "1", None):
        refused(rewritten(path, header={"version": version}), "its format version is")


def test_contradictions(tmp_path):
    path = tmp_path / "run.npz"
    about = {"shape": [4, 3], "periodic": [True, False], "names": ["a", "b"], "stretch": [None, None]}
    refused(rewritten(path, value=np.zeros((3, 4))), r"'value' has shape \(3, 4\), wanted \(4, 3\)")
    refused(rewritten(path, policy=np.zeros((4, 3))), r"'policy' has shape \(4, 3\), wanted \(4, 3, any\)")
    refused(rewritten(path, lo=np.zeros(3)), r"'lo' has shape \(3,\), wanted \(2,\)")
    refused(rewritten(path, value=np.zeros((4, 3), ">f8")), "'value' has dtype '>f8'")
    refused(rewritten(path, reached=np.zeros((4, 3), np.int8)), "'reached' has dtype")
    refused(rewritten(path, value=np.asfortranarray(np.zeros((4, 3)))), "'value' is damaged or holds something other")
    refused(rewritten(path, header={"grid": about | {"shape": [5, 3]}}), "wanted \\(5, 3\\)")
    for shape in ([4.0, 3], [4, -3], [True, 3], "43", 4, None):
        refused(rewritten(path, header={"grid": about | {"shape": shape}}), "grid has shape|damaged or foreign")
    refused(rewritten(path, header={"grid": about | {"periodic": [0, 1]}}), "damaged or foreign.*periodic")
    refused(rewritten(path, header={"grid": about | {"names": ["a"]}}), "damaged or foreign.*names")
    refused(rewritten(path, hi=np.array([0.0, np.nan])), "damaged or foreign")
    refused(rewritten(path, header={"code": 99}), "99 is not a valid Status")
    for name, wrong in {"code": 1.0, "steps": "many", "stats": [], "message": 3, "discrete": 1}.items():
        refused(rewritten(path, header={name: wrong}), f"its header has {name} = ")
    refused(rewritten(path, times=np.zeros(2)), "unknown entry 'times'")
    refused(rewritten(path, header={"marched": 2}), r"wanted \(2, 4, 3\)")


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return pathlib.Path.touch, (self.path,)


def test_code_in_a_file_never_runs(tmp_path):
    path, mark = tmp_path / "run.npz", tmp_path / "mark"
    path.write_bytes(pickle.dumps(Bomb(mark)))
    refused(path, "a pickle")
    np.savez(path, header=np.array(Bomb(mark), dtype=object))
    refused(path, "'header' is damaged or holds something other than numbers|has dtype")
    refused(rewritten(path, value=np.array(Bomb(mark), dtype=object)), "'value'")
    objects = npy("{'descr': '|O', 'fortran_order': False, 'shape': (4, 3), }", pickle.dumps(Bomb(mark)))
    refused(rewritten(path, value=objects), "'value' is damaged or holds")
    assert not mark.exists()


@pytest.mark.parametrize("moment", ["stat", "fstat"])
def test_a_file_that_is_replaced_while_it_is_opened_is_read_whole(tmp_path, monkeypatch, moment):
    """A reader sees the old or the new file, although the new one is longer."""
    path, longer = tmp_path / "run.npz", tmp_path / "longer.npz"
    old, new = example(residuals=np.zeros(2)), example(residuals=np.zeros(10**4))
    old.save(path)
    new.save(longer)
    look, writers = getattr(os, moment), [longer]

    def replace_and_look(place, *arguments, **options):
        found = look(place, *arguments, **options)
        if writers and (moment == "fstat" or place == str(path)):
            writers.pop().rename(path)
        return found

    monkeypatch.setattr(os, moment, replace_and_look)
    assert_same(load(str(path)), {"stat": new, "fstat": old}[moment])
    assert_same(load(str(path)), new)


def test_a_claim_of_eight_terabytes(tmp_path, monkeypatch):
    path = tmp_path / "run.npz"
    huge = {"shape": [10**6, 10**6], "periodic": [False, False], "names": ["a", "b"], "stretch": [None, None]}
    claim = npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }", bytes(64))
    refused(rewritten(path, header={"grid": huge}, value=claim), r"'value' declares shape \(1000000, 1000000\)")
    refused(
        rewritten(path, residuals=npy("{'descr': '<f8', 'fortran_order': False, 'shape': (999999999999,), }")), "decl"
    )
    digits = npy("{'descr': '<f8', 'fortran_order': False, 'shape': (" + "9" * 900 + ",), }")
    refused(rewritten(path, residuals=digits), "'residuals' declares")
    good(path)
    with open(path, "r+b") as file:
        try:
            file.truncate(8 * 10**12)  # a sparse file: nothing is stored
        except OSError:
            file.truncate(10**9)
    refused(path, "truncated or damaged")
    path.unlink()
    good(path)
    monkeypatch.setattr(files, "_memory", lambda: 1000)
    refused(path, "this machine has 1,000 bytes of memory")


def test_sizes_in_the_table_of_contents_are_not_believed(tmp_path):
    path = tmp_path / "run.npz"
    data = bytearray(good(path))
    entry = data.index(b"PK\1\2")
    data[entry + 20 : entry + 28] = (0xFFFFFF00).to_bytes(4, "little") * 2
    path.write_bytes(data)
    refused(path, "it claims 4,294,9.* bytes of arrays")
    data[entry + 20 : entry + 24] = (1).to_bytes(4, "little")
    path.write_bytes(data)
    refused(path, "declares two sizes")


class Cubes(files.Saved):
    """A result whose ``load`` accepts at most one axis."""

    FORMAT = "test.Cubes"

    def __init__(self, array):
        self.array = array

    def _contents(self):
        return {}, {"array": self.array}

    @staticmethod
    def _plan(header):
        return {"array": files.Expected(((), (None,)))}

    @classmethod
    def _from_file(cls, header, arrays):
        return cls(arrays["array"])


def test_a_result_that_could_not_be_read_again_is_not_written(tmp_path):
    Cubes(np.arange(3.0)).save(tmp_path / "line")
    assert Cubes.load(tmp_path / "line").array.tolist() == [0.0, 1.0, 2.0]
    for array in (np.zeros((2, 2)), np.zeros(2, complex)):
        with pytest.raises(ValueError, match=r"Cubes.save: array has (shape|dtype)"):
            Cubes(array).save(tmp_path / "square")
    assert [each.name for each in tmp_path.iterdir()] == ["line.npz"]
