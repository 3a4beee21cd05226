"""A thousand damaged and forged files of each kind: a FileError each, quick and small, and nothing in them runs."""

import io
import json
import pathlib
import pickle
import random
import tracemalloc
import zipfile

import numpy as np
import pytest
from counted_reads import counted_reads
from forged_headers import header_of, npy, write_header

import hjbjax as hjb
from hjbjax.calibration.optimisation import Fit
from hjbjax.neural.solution import NeuralSolution
from hjbjax.problem.mode_axis import with_modes
from hjbjax.solution import checkpoints, files
from hjbjax.solution.locked_file import LockedFile

COUNT = 1000  # files that must be refused
SPARED = 400  # files at most that may say the same as before: a date or a flag of a zip entry says nothing
READS, BYTES = 4, 100 * 10**6  # of one refusal, at most: how often each byte is read on average, and memory
GRID = hjb.Grid([-1.0, 0.0], [1.0, 1.0], (7, 5), periodic=(True, False))
# what a header may say in place of a number, a name, a list or a table: too large, of another kind, too deep
ODD = (None, True, -1, 10**30, 1e308, "x" * 2000, "\0", [], {}, [[]] * 50, {"a": {"b": []}}, [10**6] * 3)


class Bomb:
    """What a pickle would run."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return pathlib.Path.touch, (self.mark,)


def solution(path):
    values = np.random.default_rng(0).normal(size=(7, 5))
    about = {"message": "a test", "stats": {"method": "Test", "tol": 0.1}, "residuals": np.ones(3)}
    made = hjb.Solution(GRID, values, values[..., None], code=hjb.Status.CONVERGED, steps=3, **about)
    made.save(path, force=True)
    return lambda: hjb.load(path)


def checkpoint(path):
    kept, target = checkpoints.Checkpoint(str(path)), LockedFile(str(path))
    question = {"problem": "a digest", "grid": "another", "tol": "0.1"}
    file = checkpoints.File(kept, question, {}, target)
    arrays = [np.random.default_rng(0).normal(size=(7, 5)), np.arange(4, dtype=np.int32), np.ones(3, bool)]
    done = checkpoints.Record(arrays, hjb.Status.CONVERGED, False)
    file.journal().records = [done, checkpoints.Record(arrays[:1], hjb.Status.RUNNING, True)]
    file.changed = True
    file.write()
    target.close()
    return lambda: checkpoints._read(str(path), question)


def said(answer):
    """What a reader found, as text: all of its numbers, to the last bit."""
    if isinstance(answer, np.ndarray):
        return f"{answer.dtype} {answer.shape} {answer.tobytes().hex()}"
    if isinstance(answer, dict):
        return {str(key): said(each) for key, each in answer.items()}
    if isinstance(answer, (list, tuple)):
        return [said(each) for each in answer]
    return said(vars(answer)) if hasattr(answer, "__dict__") else repr(answer)


def flipped(data, draw, mark):
    data = bytearray(data)
    for _ in range(draw.choice([1, 1, 2, 20, 200])):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    return bytes(data)


def moved(data, draw, mark):
    """Cut off, with a part missing, doubled, or full of zeros, ones or what a zip's own numbers may be."""
    start, stop = sorted(draw.randrange(len(data)) for _ in range(2))
    way = draw.randrange(4)
    if way == 0:
        return data[:start]
    if way == 1:
        return data[:start] + data[stop:]
    if way == 2:
        return data[:stop] + data[start:]
    fill = draw.choice([b"\0", b"\xff", b"PK\1\2", b"\x80\4"])
    return data[:start] + (fill * (stop - start + 1))[: stop - start] + data[stop:]


def forged(data, draw, mark):
    """A sound archive whose header, or one of whose arrays, is another."""
    with zipfile.ZipFile(io.BytesIO(data)) as source:
        content = {name: source.read(name) for name in source.namelist()}
    header = json.loads(np.load(io.BytesIO(content["header.npy"])).tobytes())
    name = draw.choice([each for each in content if each != "header.npy"])
    way = draw.randrange(4)
    if way == 0:  # an entry of the header, or one within it
        table = header
        while isinstance(table, dict) and table:
            key = draw.choice(list(table))
            if not isinstance(table[key], dict) or draw.random() < 0.5:
                table[key] = draw.choice(ODD)
                break
            table = table[key]
        content["header.npy"] = npy(np.frombuffer(json.dumps(header).encode(), np.uint8))
    elif way == 1:  # an array of another size or kind
        count = draw.randrange(1, 9)
        content[name] = npy(
            draw.choice([np.zeros(count), np.zeros((count, 0)), np.zeros((7, 5), ">f8"), np.zeros(3, complex)])
        )
    elif way == 2:  # a pickle
        content[name] = npy(np.array(Bomb(mark), dtype=object))
    else:  # a claim
        shape = tuple(draw.choice([7, 10**6, 10**18]) for _ in range(draw.randrange(1, 4)))
        text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
        content[name] = b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text + bytes(64)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for each, member in content.items():
            archive.writestr(each, member)
    return made.getvalue()


def modes(path):
    grid = with_modes(hjb.Grid([-1.0], [1.0], (3,)), ("low", "high"))
    hjb.Solution(grid, np.zeros(grid.shape), None, code=hjb.Status.CONVERGED).save(path)
    return hjb.load


def hopf(path):
    ball = hjb.convex.ball([0.0, 0.0], 1.0)
    hjb.hopf(hjb.Problem(lambda x, u: u, None, hjb.Box([-1.0] * 2, [1.0] * 2), terminal_cost=ball), 1.0).save(path)
    return hjb.HopfSolution.load


def fit(path):
    Fit({"a": np.ones(2)}, 1.0, np.ones(3), hjb.Status.CONVERGED).save(path)
    return hjb.Fit.load


def network(path):
    weights = ((np.ones((1, 2)), np.zeros(2)), (np.ones((2, 1)), np.zeros(1)))
    number, row, square = np.ones(()), np.ones(1), np.ones((1, 1))
    fields = {"state": row, "costate": row, "value": number, "matrix": square, "norm": square, "size": row}
    header = {
        "ansatz": "RestAnsatz", "fields": list(fields), "layers": 2, "format": NeuralSolution.FORMAT, "quadratic": True,
        "status": 0, "validation": {"residual": 0.5}, "seconds": 1.0,
    }  # fmt: skip
    arrays = {
        f"{name}{i}": each
        for i, pair in enumerate(weights)
        for name, each in zip(("matrix", "bias"), pair, strict=True)
    }
    ends = {"lo": np.zeros(1), "hi": np.ones(1), "history": np.ones(1)}
    files.write(path, {**header, "version": 1}, {**arrays, **fields, **ends})
    return NeuralSolution.load


def blocks(path):
    """A sum of a function of one state and a function of two others."""
    grids = hjb.Grid([-1.0], [1.0], (3,)), hjb.Grid([-1.0] * 2, [1.0] * 2, (3, 4))
    parts = tuple(hjb.Solution(each, np.ones(each.shape), np.ones((*each.shape, 1))) for each in grids)
    hjb.BlockSolution(parts, "sum", None, ((1,), (0, 2)), ((0,), (1,)), ((), ()), count=3).save(path)
    return hjb.BlockSolution.load


def test_the_files_of_these_tests_are_read(tmp_path):
    for make in (modes, hopf, fit, network, blocks):
        make(tmp_path / f"{make.__name__}.npz")(tmp_path / f"{make.__name__}.npz")
    assert hjb.BlockSolution.load(tmp_path / "blocks.npz").control_at([0.1, 0.2, 0.3]).tolist() == [1.0, 1.0]
    assert np.isfinite(NeuralSolution.load(tmp_path / "network.npz").value_at([0.5]))


@pytest.mark.parametrize("make", [hopf, fit, network, blocks])
def test_every_entry_of_a_header_is_checked(make, tmp_path):
    """Otherwise a look at the result raises KeyError or TypeError, far from the file."""
    path = tmp_path / "run.npz"
    load = make(path)
    header, kinds = header_of(path), load.__self__.KINDS
    assert set(header) == {*kinds, "format", "version", "arrays"}
    for name in kinds:
        write_header(path, {key: each for key, each in header.items() if key != name})
        with pytest.raises(hjb.FileError, match=f"its header has no '{name}': it is damaged, or of an older format"):
            load(path)
        for wrong in (True, 7, 0.5, "word", None, [], {}):
            if type(wrong) not in kinds[name]:
                write_header(path, {**header, name: wrong})
                with pytest.raises(
                    hjb.FileError, match=f"its header has {name} = .*, wanted {kinds[name][0].__name__}"
                ):
                    load(path)


@pytest.mark.parametrize(
    ("name", "wrong", "part"),
    [
        ("rule", "mean", "rule is 'mean', wanted one of"),
        ("bound", "inner", "bound is 'inner', wanted one of"),
        ("states", [[1]], "its 2 blocks have states"),
        ("states", [[1], 2], "its 2 blocks have states"),
        ("states", [[1], [0]], "a block of 2 states has the numbers"),
        ("states", [[1], [0, 3]], "a block of 2 states has the numbers"),
        ("states", [[1], [0, -1]], "a block of 2 states has the numbers"),
        ("states", [[1], [0, True]], "a block of 2 states has the numbers"),
        ("controls", [[0, 1], [1]], "a block of 1 controls has the numbers"),
        ("controls", [[0], [10**30]], "a block of 1 controls has the numbers"),
        ("disturbances", [[]], "its 2 blocks have disturbances"),
        ("count", 0, "its 2 blocks have states"),
        ("count", 10**30, "its 2 blocks have states"),
        ("parts", [], "does not hold the arrays|unknown entry"),
    ],
)
def test_blocks_that_do_not_fit_are_refused(name, wrong, part, tmp_path):
    path = tmp_path / "run.npz"
    load = blocks(path)
    write_header(path, {**header_of(path), name: wrong})
    with pytest.raises(hjb.FileError, match=f"cannot be read: .*({part})"):
        load(path)


@pytest.mark.parametrize("name", ["lo", "hi", "matrix0", "bias0", "matrix1", "bias1", "state", "norm", "value"])
def test_arrays_of_a_network_that_do_not_fit_are_refused(name, tmp_path):
    path = tmp_path / "run.npz"
    load = network(path)
    with zipfile.ZipFile(path) as source:
        content = {each: source.read(each) for each in source.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for each, member in content.items():
            archive.writestr(each, npy(np.ones(3)) if each == f"{name}.npy" else member)
    with pytest.raises(hjb.FileError, match="cannot be read: its (array|network)"):
        load(path)


@pytest.mark.parametrize(
    ("make", "keys", "wrong", "part"),
    [
        (modes, ("grid", "modes"), ["low", 7], "modes are .* wanted text"),
        (modes, ("grid", "modes"), [None, "high"], "modes are .* wanted text"),
        (hopf, ("horizon",), None, "horizon = None, wanted float"),
        (hopf, ("horizon",), "soon", "horizon = 'soon', wanted float"),
        (fit, ("names",), [None], "names of parameters are .* wanted text"),
        (network, ("layers",), 10**30, "arrays cannot be 1000"),
        (
            network,
            ("layers",),
            10**9,
            "arrays cannot be 1000",
        ),  # a loop over all of them took minutes and the memory of the machine
    ],
)
def test_a_header_with_another_kind_of_entry_is_refused(make, keys, wrong, part, tmp_path):
    """Also if only a look at the result would fail."""
    path = tmp_path / "run.npz"
    load = make(path)
    table = header = header_of(path)
    for key in keys[:-1]:
        table = table[key]
    table[keys[-1]] = wrong
    write_header(path, header)
    with pytest.raises(hjb.FileError, match=f"cannot be read: .*{part}"):
        load(path)


@pytest.mark.parametrize("make", [solution, checkpoint])
def test_a_thousand_files(make, tmp_path):
    path, mark, draw = tmp_path / "run.npz", tmp_path / "mark", random.Random(1)
    read = make(path)
    data, wanted = path.read_bytes(), said(read())
    refused = spared = 0
    while refused < COUNT:
        way = draw.choice([flipped, moved, forged])
        path.write_bytes(damaged := way(data, draw, mark))
        weighed = refused % 5 == 0  # which takes five times as long
        if weighed:
            tracemalloc.start()
        complaint = None
        try:
            with counted_reads() as reads:
                answer = said(read())
        except hjb.FileError as error:
            complaint = str(error)
        bytes_ = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        if complaint is None:
            spared += 1
            assert way is forged or answer == wanted  # whoever makes a sound file may say what can be said
        else:
            refused += 1
            assert complaint.startswith(f"{path}: cannot be read: ")
            assert len(complaint.splitlines()) == 1
        assert bool(damaged) <= sum(reads) <= READS * len(damaged) + zipfile.sizeEndCentDir
        assert bytes_ < BYTES
        assert not weighed or bytes_ > 0
    assert spared <= SPARED
    path.write_bytes(pickle.dumps(Bomb(mark)))
    with pytest.raises(hjb.FileError, match="a pickle"):
        read()
    assert not mark.exists()
