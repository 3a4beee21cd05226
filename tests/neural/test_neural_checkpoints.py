"""Checkpoints of trainings: cut anywhere and resumed, a training ends with the bits of one that was never cut."""

import functools
import os
import random
import signal
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import neural
from hjbjax.neural import backward_equation, deterministic, extremal_samples, training
from hjbjax.neural.extremal_samples import ExtremalSamples
from hjbjax.problem.settings import own_settings
from hjbjax.solution.checkpoints import open_checkpoint
from hjbjax.solution.clock import Clock

OFTEN = 1e-9  # seconds: at every opportunity
CORNERS = np.array([-1.0, -1.0]), np.array([1.0, 1.0])


def plant(damping=1.0):
    return hjb.Problem(
        lambda x, u: jnp.stack([x[1], jnp.sin(x[0]) - damping * x[1] + u[0]]), lambda x, u: x @ x + u @ u,
        hjb.Box([-20.0], [20.0]),
    )  # fmt: skip


def noisy(noise=0.5):
    return hjb.Problem(
        lambda x, u: u, lambda x, u: u @ u, hjb.Box([-np.inf] * 2, [np.inf] * 2), noise=noise,
        terminal_cost=lambda x: x @ x,
    )  # fmt: skip


class Cutting(Clock):
    """A clock with Ctrl-C at its k-th check."""

    def __init__(self, k):
        super().__init__()
        self.left = k

    def over(self):
        self.left -= 1
        self.interrupted |= self.left <= 0
        return super().over()


def extremal_from(problem, start, **options):
    """A made-up extremal of five points; there is none from states on the left."""
    if start[0] < -0.5:
        raise ValueError("no extremal")
    along = np.linspace(1.0, 0.0, 5)
    states = along[:, None] * start
    return types.SimpleNamespace(
        cost=start @ start, horizon=1.0 + start[0], times=1 - along, states=states,
        values=np.sum(states**2, axis=1), costates=2 * states,
    )  # fmt: skip


def toy_loss(weights, key, data):
    rows = jax.random.randint(key, (8,), 0, data["count"])
    return jnp.mean((data["states"][rows] @ weights - data["values"][rows]) ** 2)


def toy_training(path=None, k=10**9, every=OFTEN):
    """A training of two weights on ten made-up extremals, which are collected before two of its eight chunks."""
    clock, held, seen = Cutting(k), ExtremalSamples(*CORNERS, 3, {}), ExtremalSamples(*CORNERS, 10, {})
    rounds = {0: 7, 3: 7}

    def refresh(weights, number, keep):
        if number in rounds:
            starts = np.random.default_rng(number).uniform(-1, 1, (rounds[number], 2)) + 1e-3 * np.asarray(weights)
            seen.collect(plant(), starts, clock, earlier=0 if number == 0 else 7, keep=keep)
        return seen.arrays()

    def measure(weights):
        return np.sum((np.asarray(weights) - 0.3) ** 2) + np.sum(held.values[: held.count])

    checkpoint = path and hjb.Checkpoint(path, every)
    with own_settings(x64=True), open_checkpoint(checkpoint, [plant()], 2, resume=bool(path), caller="train") as file:
        clock.journal = file and file.journal()
        held.collect_all(plant(), np.random.default_rng(9).uniform(-1, 1, (6, 2)), clock)
        found = training.train(
            toy_loss, measure, np.zeros(2), steps=200, rate=0.1, seed=4, clock=clock, samples=seen, refresh=refresh
        )
    return found, [found.weights, np.array(found.history), *held.saved(), *found.saved()]


@pytest.fixture
def _compiled_once(monkeypatch):
    usual = training._chunk
    kept = functools.cache(lambda loss: usual(loss, kept.optimiser))

    def chunk(loss, optimiser):
        kept.optimiser = optimiser
        return kept(loss)

    monkeypatch.setattr(training, "_chunk", chunk)
    monkeypatch.setattr(extremal_samples, "pontryagin", extremal_from)


@pytest.mark.usefixtures("_compiled_once")
@pytest.mark.parametrize("every", [pytest.param(OFTEN, marks=pytest.mark.slow), np.inf])
def test_a_training_interrupted_at_random_steps_is_resumed_to_the_same_bits(every, tmp_path):
    whole, wanted = toy_training()
    assert whole.status is hjb.Status.MAX_STEPS
    assert whole.samples.failed > 0
    assert len(set(whole.history)) > 8
    draw, cuts = random.Random(5), 0
    for name in range(2):
        path = tmp_path / f"{name}.npz"
        while (part := toy_training(path, draw.randrange(3, 12), every))[0].status is hjb.Status.INTERRUPTED:
            cuts += 1
        for one, other in zip(part[1], wanted, strict=True):
            np.testing.assert_array_equal(one, other)
        before = path.read_bytes()
        _, again = toy_training(path, every=every)  # of a complete run
        for one, other in zip(again, wanted, strict=True):
            np.testing.assert_array_equal(one, other)
        assert path.read_bytes() == before
    assert cuts > 5


@pytest.mark.usefixtures("_compiled_once")
def test_an_extremal_that_ctrl_c_cut_short_is_computed_again(monkeypatch):
    """The method of extremals then raises, which does not mean that there is none."""
    clock, samples = Clock(), ExtremalSamples(*CORNERS, 3, {})

    def interrupted(problem, start, **options):
        clock.interrupted = True
        raise hjb.SolveError("pontryagin: INTERRUPTED")

    starts = np.array([[0.5, 0.5], [0.2, 0.1], [0.3, -0.4]])
    monkeypatch.setattr(extremal_samples, "pontryagin", interrupted)
    samples.collect(plant(), starts, clock)
    assert (samples.failed, samples.tried, samples.count) == (0, 0, 0)
    clock.interrupted = False
    monkeypatch.setattr(extremal_samples, "pontryagin", extremal_from)
    samples.collect(plant(), starts, clock)
    assert np.array_equal(samples.starts, starts)


def test_states_of_other_sizes_are_refused():
    samples = ExtremalSamples(*CORNERS, 3, {})
    arrays = samples.saved()
    for wrong in (arrays[1:], ExtremalSamples(*CORNERS, 2, {}).saved(), [arrays[0] + 9, *arrays[1:]]):
        with pytest.raises(ValueError, match=r"^it has|^one of its arrays"):
            samples.restore(wrong)


class Begun(Exception):
    pass


def begins(*_):
    """Write a record in place of a training."""
    clock = _[-1]
    clock.journal.leave(ExtremalSamples(*CORNERS, 1, {}), hjb.Status.INTERRUPTED)
    raise Begun


def solve(**changes):
    options = {"problem": plant(), "lo": CORNERS[0], "hi": CORNERS[1], "seed": 0, "layers": (4,), "steps": 50}
    return neural.solve(**options | changes)


def deep_bsde(**changes):
    options = {"problem": noisy(), "x0": [1.0, -0.5], "horizon": 1.0, "seed": 1, "steps": 50, "layers": (4,)}
    return neural.deep_bsde(**options | changes)


def a_guess():
    ansatz = neural.ansatz.HorizonAnsatz(((np.ones((4, 1)), np.ones(1)),), 1.0, np.zeros(2), np.ones(2), 0, 1, 1, 0)
    return neural.NeuralSolution(ansatz, *CORNERS, None, None)


CHANGES = {
    solve: {
        "problem": plant(1.5), "lo": [-1.0, -2.0], "hi": [1.0, 2.0], "seed": 1, "horizon": 2.0, "rest": [0.1, 0.0],
        "quadratic": False, "extremals": 7, "held_out": 7, "steps": 75, "batch": 7, "layers": (5,), "rate": 0.02,
    },
    deep_bsde: {
        "problem": noisy(0.6), "x0": [1.0, 0.5], "horizon": 2.0, "seed": 2, "intervals": 7, "steps": 75, "batch": 7,
        "layers": (5,), "rate": 0.02, "guess": a_guess(),
    },
}  # fmt: skip


@pytest.mark.parametrize("door", CHANGES)
def test_the_file_of_another_training_is_refused(door, tmp_path, monkeypatch):
    monkeypatch.setattr(deterministic, "_begun", lambda equation, *_: (equation, None, {}))
    monkeypatch.setattr(deterministic, "_samples", begins)
    monkeypatch.setattr(backward_equation, "_first_ansatz", lambda *_: None)
    monkeypatch.setattr(backward_equation, "_trained", begins)
    path = tmp_path / "run.npz"
    with pytest.raises(ValueError, match=rf"^neural.{door.__name__}: resume=True continues from a checkpoint"):
        door(resume=True)
    with pytest.raises(Begun):
        door(checkpoint=path)
    path.chmod(0o640)
    for word, value in CHANGES[door].items():
        with pytest.raises(hjb.FileError, match=rf"^neural.{door.__name__}: .*made for another {word}; give"):
            door(**{word: value}, checkpoint=path, resume=True)
    with pytest.raises(FileExistsError, match="there is a checkpoint already"):
        door(checkpoint=path)
    used = open_checkpoint(tmp_path / "used.npz", [plant()], 2, resume=False, caller="other")
    with used, pytest.raises(hjb.FileError, match="another run is using it"):
        door(checkpoint=tmp_path / "used.npz", resume=True)
    with pytest.raises(hjb.FileError, match="cannot"):
        door(checkpoint=tmp_path / "missing" / "run.npz")
    with pytest.raises(Begun):  # not a part of the training
        door(checkpoint=path, resume=True, tol=0.5, time_limit=1e3, progress=False)
    if os.name == "posix":
        assert path.stat().st_mode & 0o777 == 0o640


SCRIPT = """
import os, signal, sys, numpy as np, jax, hjbjax as hjb
from hjbjax.solution.checkpoints import Journal
from tests.neural.test_neural_checkpoints import CORNERS, plant
hjb.keep_compiled()
path, out, left = sys.argv[1], sys.argv[2], int(sys.argv[3])
usual = Journal.keep
def keep(journal, part):
    global left
    usual(journal, part)
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
Journal.keep = keep
kept = hjb.Checkpoint(path, every=1e-9)
found = hjb.neural.solve(
    plant(), *CORNERS, seed=0, layers=(4,), extremals=3, held_out=2, steps=100, batch=16, checkpoint=kept, resume=True
)
leaves = [np.ravel(leaf) for leaf in jax.tree.leaves(found.ansatz)]
np.save(out, np.concatenate([*leaves, found.history, list(found.validation.values())]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="Windows")
def test_killed_in_the_collection_and_in_the_training_it_ends_with_the_same_bits(tmp_path):
    root = os.path.dirname(os.path.dirname(os.path.dirname(__file__)))
    environment = {
        **os.environ, "XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": os.pathsep.join([root, *sys.path]),
    }  # fmt: skip

    def ended(name, left=0):
        command = [
            sys.executable,
            "-c",
            SCRIPT,
            str(tmp_path / f"{name}.npz"),
            str(tmp_path / f"{name}.npy"),
            str(left),
        ]
        return subprocess.run(command, env=environment, cwd=root, check=False).returncode

    assert ended("whole") == 0
    assert ended("cut", 3) == -signal.SIGKILL  # in the first round of extremals
    assert ended("cut", 3) == -signal.SIGKILL  # between chunks
    assert ended("cut") == 0
    np.testing.assert_array_equal(np.load(tmp_path / "cut.npy"), np.load(tmp_path / "whole.npy"))
