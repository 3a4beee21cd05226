"""Checkpoints of fits: cut anywhere and resumed, a fit ends with the bits of one that was never cut."""

import os
import random
import signal
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import hjbjax as hjb
from hjbjax.calibration import optimisation
from hjbjax.solution.clock import Clock

OFTEN = 1e-9  # seconds: at every opportunity
START = {"a": 1.0, "b": np.array([0.5, -1.0])}


def waves(p, depth=1.0):
    return depth * jnp.cos(3 * p["a"]) + (p["a"] - 3.0) ** 2 + jnp.sum((p["b"] - jnp.array([1.0, -2.0])) ** 2)


class Cutting(Clock):
    """A clock with Ctrl-C at its k-th check."""

    left = 10**9

    def over(self):
        Cutting.left -= 1
        self.interrupted |= Cutting.left <= 0
        return super().over()


def bits(found):
    leaves = [np.ravel(leaf) for leaf in jax.tree.leaves(found.parameters)]
    return np.concatenate([*leaves, found.history, found.starts, [found.loss, found.status]]).tobytes()


@pytest.mark.parametrize("every", [pytest.param(OFTEN, marks=pytest.mark.slow), np.inf])
def test_a_fit_interrupted_at_random_steps_is_resumed_to_the_same_bits(every, tmp_path, monkeypatch):
    """Also in the second and the third run, from random starts, and with an end before the last step."""
    monkeypatch.setattr(optimisation, "Clock", Cutting)
    options = {"optimiser": optax.adam(0.1), "steps": 60, "restarts": 2, "tol": 0.5}
    whole = hjb.fit(waves, START, **options)
    draw, cuts, path = random.Random(5), 0, tmp_path / "fit.npz"
    while True:
        monkeypatch.setattr(Cutting, "left", draw.randrange(20, 60))
        found = hjb.fit(waves, START, checkpoint=hjb.Checkpoint(path, every), resume=True, **options)
        if found.status is not hjb.Status.INTERRUPTED:
            break
        cuts += 1
    assert cuts >= 3
    assert bits(found) == bits(whole)
    before = path.read_bytes()
    monkeypatch.setattr(Cutting, "left", 10**9)
    again = hjb.fit(waves, START, checkpoint=hjb.Checkpoint(path, every), resume=True, check_gradient=True, **options)
    assert bits(again) == bits(whole)
    assert path.read_bytes() == before


def test_a_loss_that_is_not_finite_is_remembered(tmp_path):
    def loss(p):
        return jnp.where(p > 0.5, p, jnp.nan)

    ended = hjb.fit(loss, 1.0, checkpoint=tmp_path / "fit.npz")
    assert ended.status is hjb.Status.NONFINITE
    assert bits(hjb.fit(loss, 1.0, checkpoint=tmp_path / "fit.npz", resume=True)) == bits(ended)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"loss": lambda p: waves(p, 1.5)}, "loss or optimiser"),
        ({"optimiser": optax.adam(0.02)}, "loss or optimiser"),
        ({"parameters": {**START, "a": 1.1}}, "parameters"),
        ({"bounds": (-3.0, 8.0)}, "bounds"),
        ({"steps": 7}, "steps"),
        ({"restarts": 1}, "restarts"),
        ({"seed": 1}, "seed"),
        ({"tol": 1e-3}, "tol"),
    ],
)
def test_the_file_of_another_fit_is_refused(change, word, tmp_path):
    options = {"loss": waves, "parameters": START, "optimiser": optax.adam(0.05), "steps": 2}
    hjb.fit(**options, checkpoint=tmp_path / "fit.npz")
    with pytest.raises(hjb.FileError, match=rf"^fit: .*made for another {word}; give"):
        hjb.fit(**options | change, checkpoint=tmp_path / "fit.npz", resume=True)


def test_a_setting_of_random_numbers_is_part_of_the_fit(tmp_path):
    """The same key has other numbers, so the two halves of a run would belong to two losses."""

    def loss(p):
        return jnp.sum((p["a"] - jax.random.normal(jax.random.key(0), (2,))) ** 2)

    hjb.fit(loss, {"a": 1.0}, steps=2, checkpoint=tmp_path / "fit.npz")
    for other in (jax.threefry_partitionable(not jax.config.jax_threefry_partitionable), jax.default_prng_impl("rbg")):
        with other, pytest.raises(hjb.FileError, match="made for another (loss or .*)?setting of random numbers; give"):
            hjb.fit(loss, {"a": 1.0}, steps=2, checkpoint=tmp_path / "fit.npz", resume=True)


def test_the_first_state_of_the_optimiser_is_part_of_the_fit(tmp_path):
    """It is not an operation of a step."""
    fits = [
        {"optimiser": optax.adagrad(0.1, initial_accumulator_value=first), "checkpoint": tmp_path / "fit.npz"}
        for first in (0.1, 0.5)
    ]
    hjb.fit(waves, START, steps=2, **fits[0])
    hjb.fit(waves, START, steps=2, resume=True, **fits[0])
    with pytest.raises(hjb.FileError, match="made for another first state of the optimiser; give"):
        hjb.fit(waves, START, steps=2, resume=True, **fits[1])


def test_other_names_of_the_parameters_are_another_fit(tmp_path):
    hjb.fit(lambda p: p["a"] ** 2, {"a": 1.0}, steps=2, checkpoint=tmp_path / "fit.npz")
    with pytest.raises(hjb.FileError, match="made for another structure of the parameters; give"):
        hjb.fit(lambda p: p["b"] ** 2, {"b": 1.0}, steps=2, checkpoint=tmp_path / "fit.npz", resume=True)


def test_files_that_cannot_be_used_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^fit: resume=True continues from a checkpoint"):
        hjb.fit(waves, START, resume=True)
    with pytest.raises(ValueError, match=r"dtype bfloat16, which a checkpoint cannot store"):
        hjb.fit(waves, START, optimiser=optax.adam(0.1, mu_dtype=jnp.bfloat16), checkpoint=tmp_path / "fit.npz")
    assert not list(tmp_path.iterdir())
    hjb.fit(waves, START, steps=2, checkpoint=tmp_path / "fit.npz")
    with pytest.raises(FileExistsError, match=r"^fit: .*there is a checkpoint already"):
        hjb.fit(waves, START, steps=2, checkpoint=tmp_path / "fit.npz")


def motor(strength):
    return hjb.Problem(
        lambda x, u: strength * u, lambda x, u: x @ x + u @ u, hjb.Box([-9.0], [9.0]), discount=0.1
    )  # fmt: skip


def designed(checkpoint=None):
    grid, resume = hjb.Grid([-1.5], [1.5], (21,)), checkpoint is not None
    price = lambda solution, b: solution.value_at(jnp.array([1.0])) + 4 * b  # noqa: E731
    return hjb.design(motor, grid, price, 0.8, steps=6, checkpoint=checkpoint, resume=resume)


SCRIPT = """
import os, signal, sys, hjbjax as hjb
from hjbjax.solution.checkpoints import Journal
from tests.calibration.test_fit_checkpoints import designed
usual, writes = Journal.keep, []
def keep(journal, part):
    usual(journal, part)
    writes.append(1)
    if len(writes) == 3:
        os.kill(os.getpid(), signal.SIGKILL)
Journal.keep = keep
designed(hjb.Checkpoint(sys.argv[1], every=1e-9))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="Windows")
def test_a_design_that_is_killed_is_continued_by_another_process(tmp_path):
    root, path = os.path.dirname(os.path.dirname(os.path.dirname(__file__))), tmp_path / "design.npz"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, *sys.path])}
    command = [sys.executable, "-c", SCRIPT, str(path)]
    assert subprocess.run(command, env=environment, cwd=root, check=False).returncode == -signal.SIGKILL
    assert bits(designed(path)) == bits(designed())
