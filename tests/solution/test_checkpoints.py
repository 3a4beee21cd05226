"""Checkpoints: cut anywhere and resumed, a run comes to the bits of one that was never cut."""

import os
import random
import signal
import subprocess
import sys
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.solution import checkpoints, files
from hjbjax.solvers import stationary_run
from hjbjax.solvers.march_run import MarchRun
from hjbjax.solvers.stationary_run import StatesInChunks

OFTEN = 1e-9  # seconds: between any two chunks


def alike(found, wanted):
    """The same bits in all that a solution holds."""
    for name in ("value", "policy", "disturbance", "grid_error", "residuals", "enclosure", "reached", "cut", "times"):
        one, other = getattr(found, name), getattr(wanted, name)
        assert (one is None) == (other is None), name
        if one is not None:
            np.testing.assert_array_equal(one, other, err_msg=name)
    assert (found.code, found.steps) == (wanted.code, wanted.steps)
    assert (found.monotone_error, found.isaacs_gap) == (wanted.monotone_error, wanted.isaacs_gap)


def pendulum():
    return *zoo.pendulum(shape=(30, 31)), {"tol": 1e-8}


def first_order():
    return *zoo.pendulum(shape=(30, 31)), {"tol": 1e-6, "scheme": hjb.Upwind(), "dtype": "float64"}


def single():
    return *zoo.stochastic_lq(shape=(41,)), {"dtype": "float32"}


def least_time():  # the way to its guess goes by vanishing discounts
    return *zoo.double_integrator(shape=(41, 41)), {"tol": 1e-6}


def levels():
    return *zoo.pendulum(shape=(60, 61)), {"method": hjb.Nested(coarsest=200), "tol": 1e-6}


def game():
    return *zoo.lq_game(rate=0.2, discount=0.5, shape=(101,)), {"tol": 1e-6}


def paths():
    return *zoo.pendulum(discount=0.5, shape=(30, 31)), {"scheme": hjb.SemiLagrangian(), "tol": 1e-4}


LONGER = (first_order, least_time, single, levels, game, paths)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
@pytest.mark.parametrize(
    "question",
    [pendulum, *(pytest.param(each, marks=pytest.mark.slow) for each in LONGER)],
)
def test_a_solve_that_is_cut_after_every_number_of_steps_comes_to_the_same_bits(question, tmp_path):
    problem, grid, options = question()
    wanted = hjb.solve(problem, grid, throw=False, **options)
    for most in (1, 2, 3, 5, 9):
        kept = hjb.Checkpoint(tmp_path / f"{most}.npz", every=OFTEN)
        cut = hjb.solve(problem, grid, checkpoint=kept, max_steps=most, throw=False, **options)
        assert cut.stats["checkpoint"] == "written"
        alike(hjb.solve(problem, grid, checkpoint=kept, resume=True, throw=False, **options), wanted)


class Chunks:
    """A method that takes a step, which counts its calls, and presses Ctrl-C at one of them."""

    def __init__(self, method, stop=0):
        self.method, self.stop, self.count = method, stop, 0

    def __get__(self, owner, kind=None):
        def called(*arguments):
            self.count += 1
            if self.count == self.stop:
                os.kill(os.getpid(), signal.SIGINT)
            return self.method(owner, *arguments)

        return called


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_an_interrupt_in_any_part_is_resumed_to_the_same_bits(tmp_path, monkeypatch):
    """Vanishing discounts, the monotone solve, the one of second order, the coarser grid that tells the error."""
    problem, grid, options = least_time()
    monkeypatch.setattr(StatesInChunks, "longest", 1)
    monkeypatch.setattr(stationary_run, "FIRST_NODES", 1)
    monkeypatch.setattr(stationary_run, "CHUNK_SECONDS", 0.0)
    step = StatesInChunks.advance
    counted = Chunks(step)
    monkeypatch.setattr(StatesInChunks, "advance", counted)
    wanted = hjb.solve(problem, grid, **options)
    assert counted.count > 15
    for stop in np.linspace(1, counted.count - 1, 7).astype(int):
        path = tmp_path / str(stop)
        monkeypatch.setattr(StatesInChunks, "advance", Chunks(step, stop))
        cut = hjb.solve(problem, grid, checkpoint=path, throw=False, **options)
        assert cut.status is hjb.Status.INTERRUPTED
        left = Chunks(step)
        monkeypatch.setattr(StatesInChunks, "advance", left)
        alike(hjb.solve(problem, grid, checkpoint=path, resume=True, **options), wanted)
        assert left.count == counted.count - stop
    # a run that is done gives its answer again without a step
    monkeypatch.setattr(StatesInChunks, "advance", None)
    alike(hjb.solve(problem, grid, checkpoint=path, resume=True, **options), wanted)


@pytest.mark.parametrize("method", [hjb.Explicit(), pytest.param(hjb.Implicit(), marks=pytest.mark.slow)])
def test_a_march_is_resumed_to_the_same_bits(method, tmp_path, monkeypatch):
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-4.0], [4.0]))
    grid, times = hjb.Grid([-2.0], [2.0], (81,)), np.linspace(0, 1, 6)
    options = {"times": times, "method": method}
    wanted = hjb.march(problem, grid, 1.0, **options)
    for chunks in (1, 3, 6):
        path = tmp_path / f"{chunks}.npz"
        with monkeypatch.context() as patched:
            pressed = Chunks(MarchRun.advance, chunks)
            patched.setattr(MarchRun, "advance", pressed)
            cut = hjb.march(problem, grid, 1.0, checkpoint=path, throw=False, **options)
        assert cut.status is hjb.Status.INTERRUPTED, f"Ctrl-C at chunk {chunks} of {pressed.count}"
        alike(hjb.march(problem, grid, 1.0, checkpoint=path, resume=True, **options), wanted)
    with pytest.raises(hjb.FileError, match="made for another horizon"):
        hjb.march(problem, grid, 2.0, checkpoint=path, resume=True, **options | {"times": times})


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_a_batch_is_resumed_lane_by_lane_to_the_same_bits(tmp_path, monkeypatch):
    grid = hjb.Grid([-3.0, -3.0], [3.0, 3.0], (21, 21))

    def cart(mass):
        drift = jax.tree_util.Partial(lambda mass, x, u: jnp.stack([x[1], u[0] / mass]), mass)
        return hjb.Problem(drift, lambda x, u: x @ x + u @ u, hjb.Box([-1.0], [1.0]), discount=0.5)

    problems = [cart(mass) for mass in (0.5, 1.0, 1.5, 2.0)]
    wanted = hjb.solve_batch(problems, grid, tol=1e-7)
    step = StatesInChunks.advance
    counted = Chunks(step)
    monkeypatch.setattr(StatesInChunks, "advance", counted)
    hjb.solve_batch(problems, grid, tol=1e-7)
    for stop in (1, counted.count // 2, counted.count - 1):
        kept = hjb.Checkpoint(tmp_path / f"{stop}.npz", every=OFTEN)
        monkeypatch.setattr(StatesInChunks, "advance", Chunks(step, stop))
        cut = hjb.solve_batch(problems, grid, tol=1e-7, checkpoint=kept, throw=False)
        assert any(each.status is hjb.Status.INTERRUPTED for each in cut)
        monkeypatch.setattr(StatesInChunks, "advance", step)
        found = hjb.solve_batch(problems, grid, tol=1e-7, checkpoint=kept, resume=True)
        for one, other in zip(found, wanted, strict=True):
            alike(one, other)
            assert one.stats["checkpoint"] == "written"
    with pytest.raises(hjb.FileError, match="made for another list of problems"):
        hjb.solve_batch(problems[::-1], grid, tol=1e-7, checkpoint=kept, resume=True)


# --- which file, and for which question ---


def posed(weight=1.0):
    return hjb.Problem(lambda x, u: u, lambda x, u: weight * (x @ x) + u @ u, hjb.Box([-1.0], [1.0]), discount=1.0)


LINE = hjb.Grid([-1.0], [1.0], (21,))


def test_the_file_of_another_question_is_refused(tmp_path):
    path = tmp_path / "run.npz"
    hjb.solve(posed(), LINE, checkpoint=path)
    before = path.read_bytes()
    for problem, grid, options, word in (
        (posed(1.5), LINE, {}, "problem"),
        (posed(), hjb.Grid([-1.0], [1.5], (21,)), {}, "grid"),
        (posed(), LINE, {"tol": 1e-4}, "tol"),
        (posed(), LINE, {"guess": np.ones(21)}, "guess"),
        (posed(), LINE, {"scheme": hjb.Upwind()}, "scheme"),
        (posed(), LINE, {"method": hjb.ValueIteration()}, "method"),
        (posed(), LINE, {"dtype": "float32"}, "dtype"),
    ):
        with pytest.raises(hjb.FileError, match=f"run.npz.*it was made for another {word}; give another path"):
            hjb.solve(problem, grid, checkpoint=path, resume=True, **options)
    assert path.read_bytes() == before
    # the same question in other words: a function written anew
    hjb.solve(posed(), LINE, checkpoint=path, resume=True)


def test_what_stands_in_the_way_is_said_before_anything_is_computed(tmp_path):
    path = tmp_path / "run.npz"
    path.write_bytes(b"")
    with pytest.raises(FileExistsError, match=r"there is a checkpoint already; resume=True goes on from it"):
        hjb.solve(posed(), LINE, checkpoint=path)
    with pytest.raises(hjb.FileError, match="it is empty"):
        hjb.solve(posed(), LINE, checkpoint=path, resume=True)
    with pytest.raises(ValueError, match="resume=True goes on from a checkpoint; give checkpoint="):
        hjb.solve(posed(), LINE, resume=True)
    with pytest.raises(hjb.FileError, match="is no folder in which one may write"):
        hjb.solve(posed(), LINE, checkpoint=tmp_path / "missing" / "run")
    with pytest.raises(hjb.FileError, match="it is a folder"):
        hjb.solve(posed(), LINE, checkpoint=tmp_path, resume=True)
    with pytest.raises(ValueError, match=r"Checkpoint: every = 0; wanted a finite number > 0, in seconds"):
        hjb.Checkpoint("run", every=0)
    hjb.solve(posed(), LINE, checkpoint=tmp_path / "other")  # which is no solution
    with pytest.raises(hjb.FileError, match="does not say 'hjbjax.Solution'"):
        hjb.load(tmp_path / "other.npz")


def test_a_full_disk_takes_the_checkpoint_and_not_the_answer(tmp_path, monkeypatch):
    def full(*arguments, **options):
        raise files.FileError("run.npz: cannot be written: No space left on device")

    monkeypatch.setattr(files, "write", full)
    kept = hjb.Checkpoint(tmp_path / "run", every=OFTEN)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solution = hjb.solve(posed(), LINE, checkpoint=kept)
    assert solution.status is hjb.Status.CONVERGED
    assert ["without a checkpoint" in str(each.message) for each in said] == [True]
    assert "No space left" in solution.stats["checkpoint"]


@pytest.mark.slow
def test_damaged_files_are_refused(tmp_path):
    path = tmp_path / "run.npz"
    hjb.solve(posed(), LINE, checkpoint=path)
    whole, draw = path.read_bytes(), random.Random(0)
    refused = 0
    for _ in range(100):
        data = bytearray(whole)
        if draw.random() < 0.3:
            data = data[: draw.randrange(len(data))]
        else:
            for _ in range(draw.randrange(1, 20)):
                data[draw.randrange(len(data))] = draw.randrange(256)
        path.write_bytes(data)
        try:
            hjb.solve(posed(), LINE, checkpoint=path, resume=True)
        except hjb.FileError:
            refused += 1
            path.write_bytes(whole)
        path.write_bytes(whole)
    assert refused >= 90  # a bit of padding, or of a date, says nothing


# --- killed ---

SCRIPT = """
import sys, numpy as np, hjbjax as hjb
hjb.keep_compiled()
problem, grid = hjb.zoo.pendulum(shape=(120, 121))
kept = hjb.Checkpoint(sys.argv[1], every=1e-3)
solution = hjb.solve(problem, grid, tol=1e-9, checkpoint=kept, resume=True, method=hjb.PolicyIteration(hjb.Sweeps(1)))
np.save(sys.argv[2], solution.value)
"""


@pytest.mark.slow
def test_killed_at_random_times_the_file_is_whole_and_the_bits_are_the_same(tmp_path):
    kills = int(os.environ.get("HJBJAX_KILLS", "4"))
    draw, environment = random.Random(1), {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}

    def begun(name):
        command = [sys.executable, "-c", SCRIPT, str(tmp_path / f"{name}.npz"), str(tmp_path / f"{name}.npy")]
        return subprocess.Popen(command, env=environment)

    began = time.monotonic()
    assert begun("first").wait() == 0  # which compiles
    assert begun("whole").wait() == 0
    seconds = (time.monotonic() - began) / 2
    wanted, path, readable = np.load(tmp_path / "whole.npy"), tmp_path / "cut.npz", 0
    for _ in range(kills):
        process = begun("cut")
        time.sleep(draw.uniform(0.2, 1.2) * seconds)
        process.kill()
        process.wait()
        if path.exists():
            files.read(path, checkpoints.FORMAT, checkpoints.VERSION, checkpoints._plan, lambda *_: None)
            readable += 1
            if draw.random() < 0.3:  # from the beginning, now and then
                assert begun("cut").wait() == 0
                np.testing.assert_array_equal(np.load(tmp_path / "cut.npy"), wanted)
                path.unlink()
    assert begun("cut").wait() == 0
    np.testing.assert_array_equal(np.load(tmp_path / "cut.npy"), wanted)
    assert readable
