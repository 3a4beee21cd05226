"""The exported feedback: the same answers with NumPy only, from a copy of one file."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.problem.mode_axis import with_modes
from hjbjax.solution import numpy_feedback
from hjbjax.solution.solution import Solution

GRID = hjb.Grid(
    [-1.0, 0.0], [1.0, 2 * np.pi], (5, 6), (False, True), ("speed", "angle"), stretch=(hjb.Sinh(3.0, 0.2), None)
)
PLAIN = hjb.Grid([-1.0, 2.0], [1.0, 5.0], (5, 4))
TIMES = np.array([0.0, 0.3, 1.0])
MODES = with_modes(GRID, ("low", "high"))


def solution(grid=GRID, times=None, dtype=np.float64, **fields):
    """A solution with random values, some of them infinite, and with controls that are undefined at some nodes."""
    random = np.random.default_rng(7)
    shape = (*np.shape(times), *grid.shape)
    value, (policy, disturbance) = random.normal(size=shape), random.normal(size=(2, *shape, 2))
    value[random.random(shape) < 0.1] = np.inf
    policy[random.random(shape) < 0.4] = np.nan
    arrays = {"value": value.astype(dtype), "policy": policy.astype(dtype), "disturbance": disturbance.astype(dtype)}
    return Solution(grid=grid, times=times, code=1, **arrays, **fields)


CASES = {  # and if states outside are clamped
    "mean": (solution(), False),
    "finite sets, float32": (solution(PLAIN, discrete=True, discrete_disturbance=True, dtype=np.float32), True),
    "marched with modes, a finite set": (solution(MODES, times=TIMES, discrete=True), True),
    "one stored time": (solution(PLAIN, times=TIMES[:1]), False),
}


def places(grid, times):
    """States inside, outside, on nodes up to rounding, between two nodes, and infinite or NaN; with times."""
    random = np.random.default_rng(3)
    nodes = grid.nodes().reshape(-1, grid.ndim)[::7]
    inside = random.uniform(grid.lo, grid.hi, (60, grid.ndim))
    outside = random.uniform(1.5 * grid.lo - 3, 1.5 * grid.hi, (60, grid.ndim))
    odd = np.full((3, grid.ndim), 2.5)
    odd[np.arange(3), [-1, -2, -1]] = [np.nan, np.inf, -np.inf]
    x = np.concatenate([nodes, nodes * (1 + 1e-15), (nodes[1:] + nodes[:-1]) / 2, inside, outside, odd])
    if grid.modes:
        x[:, 0] = random.integers(len(grid.modes), size=len(x))
    if times is None:
        return (x,)
    t = random.uniform(-0.2, 1.2, len(x))
    t[::2] = times[np.arange(len(t[::2])) % len(times)]
    return t, x


def exported(case, folder):
    case.export(folder / "exported")  # the suffix is added
    return numpy_feedback.load(folder / "exported.npz")


@pytest.mark.filterwarnings("ignore:Solution:UserWarning")  # states outside
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if "modes" in name else []) for name in CASES]
)
def test_the_answers_are_the_same(name, tmp_path):
    case, clamp = CASES[name]
    feedback = exported(case, tmp_path)
    where = places(case.grid, case.times)
    pairs = {
        "value": (case.value_at, feedback.value),
        "control": (case.control_at, feedback.control),
        "disturbance": (case.disturbance_at, feedback.disturbance),
    }
    for about, (wanted, found) in pairs.items():
        expected = wanted(*where, clamp=clamp)
        answer = found(*where, clamp=clamp)
        assert answer.shape == expected.shape
        np.testing.assert_allclose(answer, expected, rtol=0, atol=3e-12, err_msg=about)
        one = found(*(each[20] for each in where), clamp=clamp)  # a single state
        np.testing.assert_array_equal(one, answer[20])
    assert np.isfinite(answer[:, 0]).sum() > 30


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("grid", [PLAIN, hjb.Grid([-2.0, -2.0], [2.0, 2.0], (21, 21)), GRID])
def test_between_equally_near_nodes_the_lower_one_decides(grid, dtype, tmp_path):
    """Midpoints along both axes: the coordinates are rounded, so the four weights differ in their last digits."""
    case = solution(grid, dtype=dtype, discrete=True)
    index = np.arange(int(np.prod(grid.shape)), dtype=dtype).reshape(*grid.shape, 1)
    case = dataclasses.replace(case, policy=index)
    lower = np.stack(np.meshgrid(*(np.arange(n - 1) for n in grid.shape), indexing="ij"), axis=-1).reshape(-1, 2)
    axes = [np.asarray(grid.axis(i)) for i in range(2)]
    x = np.stack([(a[k] + a[k + 1]) / 2 for a, k in zip(axes, lower.T, strict=True)], axis=-1)
    wanted = index[tuple(lower.T)]
    np.testing.assert_array_equal(case.control_at(x), wanted)
    np.testing.assert_array_equal(exported(case, tmp_path).control(x), wanted)


def test_a_mode_is_named_or_numbered(tmp_path):
    feedback = exported(CASES["marched with modes, a finite set"][0], tmp_path)
    t, x = 0.4, np.array([0.1, 0.2])
    assert feedback.value(t, x, mode="high") == feedback.value(t, x, mode=1) == feedback.value(t, [1, *x])
    with pytest.raises(ValueError, match=r"got mode = 'medium', wanted one of \('low', 'high'\)"):
        feedback.value(t, x, mode="medium")
    with pytest.raises(ValueError, match=r"got states of shape \(2,\); wanted one entry per axis: mode, speed, angle"):
        feedback.value(t, x)
    with pytest.raises(ValueError, match="got 1 arguments; call it with"):
        feedback.value(x)


def test_the_file_runs_alone(tmp_path):
    """Next to a robot's code, where neither JAX nor the package is imported."""
    case, _ = CASES["mean"]
    case.export(tmp_path / "feedback.npz")
    shutil.copy(numpy_feedback.__file__, tmp_path / "numpy_feedback.py")
    code = (
        "import sys, numpy_feedback; f = numpy_feedback.load('feedback.npz')\n"
        "print(f.control([0.1, 7.0]).tolist()); print({'jax', 'hjbjax', 'scipy'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    control, loaded = run.stdout.splitlines()
    np.testing.assert_allclose(eval(control), case.control_at([0.1, 7.0]), rtol=0, atol=1e-12)
    assert loaded == "set()"


def test_other_files_are_refused(tmp_path):
    case, _ = CASES["mean"]
    case.export(tmp_path / "f.npz")
    with pytest.raises(FileExistsError):
        case.export(tmp_path / "f.npz")
    with pytest.raises(hjb.FileError, match="hjbjax"):
        hjb.load(tmp_path / "f.npz")
    case.save(tmp_path / "solution.npz")
    np.savez(tmp_path / "other.npz", value=np.zeros(3))
    np.save(tmp_path / "array.npy", np.zeros(3))
    for name, why in {
        "solution.npz": "got hjbjax.Solution",
        "other.npz": "not a file",
        "array.npy": "not a file",
    }.items():
        with pytest.raises(ValueError, match=why):
            numpy_feedback.load(tmp_path / name)
    lone = exported(Solution(GRID, np.zeros(GRID.shape), None, code=1), tmp_path)
    with pytest.raises(ValueError, match="the exported solution has no control"):
        lone.control([0.1, 0.2])
    with pytest.raises(ValueError, match="a batch"):
        Solution(GRID, np.zeros((2, *GRID.shape)), None, code=np.ones(2)).export(tmp_path / "batch.npz")


def test_a_damaged_file_is_refused_as_documented_or_says_the_same(tmp_path):
    """Cut at the end or within, and with an inverted byte: its readers raise six other types."""
    path, damaged = tmp_path / "whole.npz", tmp_path / "damaged.npz"
    CASES["mean"][0].export(path)
    whole, state = path.read_bytes(), [0.1, 7.0]
    wanted = numpy_feedback.load(path).control(state)
    contents = [whole[:n] for n in range(0, len(whole), 97)]
    contents += [whole[:n] + whole[n + 7 :] for n in range(0, len(whole), 211)]
    contents += [whole[:n] + bytes([whole[n] ^ 0xFF]) + whole[n + 1 :] for n in range(0, len(whole), 37)]
    refused = 0
    for content in contents:
        damaged.write_bytes(content)
        try:
            found = numpy_feedback.load(damaged)
        except ValueError:
            refused += 1
        else:
            np.testing.assert_array_equal(found.control(state), wanted)
    assert refused > len(contents) / 2
    damaged.write_bytes(whole[:-50])
    with pytest.raises(ValueError, match=r"damaged\.npz: damaged, or not a file written by Solution\.export"):
        numpy_feedback.load(damaged)
    with pytest.raises(FileNotFoundError):
        numpy_feedback.load(tmp_path / "nowhere.npz")


@pytest.mark.parametrize(
    ("name", "wrong", "part"),
    [
        ("control", np.ones(3), "control is float64 of shape"),
        ("value", np.ones((5, 7)), "value is float64 of shape"),
        ("value", np.ones(35, int), "value is int64"),
        ("periodic", np.zeros(2), "periodic is float64"),
        ("nodes1", np.ones(9), "value is float64 of shape"),
        ("enumerated", np.zeros(1, bool), "enumerated is bool of shape"),
        ("lo", np.zeros(3), "lo is float64 of shape"),
        ("more", np.zeros(3), "its header lists"),
    ],
)
def test_arrays_that_do_not_fit_each_other_are_refused(name, wrong, part, tmp_path):
    """A feedback loop would fail later, at a state whose cell reads them."""
    path = tmp_path / "feedback.npz"
    CASES["mean"][0].export(path)
    with np.load(path) as file:
        content = dict(file)
    assert {"control", "value", "lo"} < set(content)
    np.savez(path, **{**content, name: wrong})
    with pytest.raises(ValueError, match=rf"feedback\.npz: damaged, or not .*{part}"):
        numpy_feedback.load(path)
    np.savez(path, **content)
    assert numpy_feedback.load(path).names == CASES["mean"][0].grid.names


def test_a_file_that_claims_more_bytes_than_it_has_is_refused(tmp_path):
    """A few kilobytes may unpack to gigabytes."""
    path = tmp_path / "feedback.npz"
    CASES["mean"][0].export(path)
    with np.load(path) as file:
        content = dict(file)
    np.savez_compressed(path, **{**content, "value": np.zeros((1000, 1000))})
    with pytest.raises(ValueError, match="it claims 8[0-9]* bytes of arrays and is"):
        numpy_feedback.load(path)


def test_a_folder_and_a_pipe_are_refused(tmp_path):
    """Opening a pipe waits for a writer."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe: damaged, or not .*it is not an ordinary file"):
        numpy_feedback.load(tmp_path / "pipe")
    with pytest.raises(IsADirectoryError):
        numpy_feedback.load(tmp_path)


def test_a_refusal_is_one_short_line(tmp_path):
    path = tmp_path / "feedback.npz"
    CASES["mean"][0].export(path)
    for key in ("format", "arrays"):
        with np.load(path) as file:
            content = dict(file)
        header = json.loads(content["header"].tobytes())
        long = ["x\n" * 5000, *header[key]] if key == "arrays" else "x" * 5000
        content["header"] = np.frombuffer(json.dumps({**header, key: long}).encode(), np.uint8)
        np.savez(tmp_path / "long.npz", **content)
        with pytest.raises(ValueError, match=r"long\.npz: ") as refused:
            numpy_feedback.load(tmp_path / "long.npz")
        assert len(str(refused.value).splitlines()) == 1
        assert len(str(refused.value)) < 600


@pytest.mark.slow
def test_the_controllers_changes_of_mode_are_exported(tmp_path):
    problem, grid = hjb.zoo.thermostat(shape=(41,))
    found = hjb.solve(problem, grid)
    found.export(tmp_path / "thermostat.npz")
    feedback = numpy_feedback.load(tmp_path / "thermostat.npz")
    nodes = found.grid.nodes()
    np.testing.assert_array_equal(feedback.switching(nodes), found.switching)
    assert (found.switching != nodes[..., 0]).any()
    assert feedback.switching([float(grid.hi[0]) + 1.0], mode=0) == -1
