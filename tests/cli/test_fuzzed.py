"""Command lines made of right and wrong words: each is done or refused in one line, and none ends in a traceback."""

import random

import numpy as np
import pytest
from click.testing import CliRunner

import hjbjax
from hjbjax import zoo
from hjbjax.cli import run_folder
from hjbjax.cli.main import main
from hjbjax.solution.solution import Solution, Status
from hjbjax.solvers import memory
from hjbjax.solvers.resources import Estimate

LINES = 2_000
NAMES = [*zoo.catalogue, "pendulm", "", "Pendulum", "../pendulum", "pendulum\0", "--", "é" * 40]
NUMBERS = [
    "1",
    "0",
    "-1",
    "1e-3",
    "nan",
    "inf",
    "-inf",
    "1e400",
    "1e-400",
    "0x10",
    "1_000",
    "٣",
    "1,2",
    "",
    " ",
    "one",
    "9" * 400,
]
SHAPES = [
    "11x13",
    "11",
    "3x3x3x3",
    "0x5",
    "-5",
    "5x",
    "x",
    "1e400",
    "2.5x3",
    "99999999999x3",
    "11X13",
    "11×13",
    "",
    "nan",
]
SETTINGS = [
    "mass=2",
    "mass",
    "=2",
    "mass=",
    "mass==2",
    "discount=0.5",
    "shape=3x3",
    "masss=1",
    "gamma=1e400",
    "noise=-1",
    "mass=\0",
]
OUTS = ["out", "a/b/c", ".", "", "out\0", "x" * 300, "~", "-"]
FLAGS = [
    "--force",
    "--json",
    "--no-cache",
    "--resume",
    "--dry-run",
    "--help",
    "--mass",
    "-x",
    "--tol=",
    "--version",
    "--",
    "-",
]
OPTIONS = {
    "--tol": NUMBERS, "--max-steps": NUMBERS, "--time-limit": NUMBERS, "--shape": SHAPES, "--set": SETTINGS,
    "--out": OUTS, "--method": ["value-iteration", "policy-iteration", "howard", ""],
    "--scheme": ["upwind", "eno2", "weno5", "limited", "ENO", ""], "--checkpoint": OUTS, "--only": NAMES,
}  # fmt: skip


def command_line(draw):
    """Some words, most of them in their place."""
    words = [draw.choice(["solve"] * 8 + ["list", "slove", ""])]
    if draw.random() < 0.95:
        words.append(draw.choice(NAMES if draw.random() < 0.3 else list(zoo.catalogue)))
    for _ in range(draw.randrange(4)):
        if draw.random() < 0.7:
            option = draw.choice(list(OPTIONS))
            words += [option] if draw.random() < 0.1 else [option, draw.choice(OPTIONS[option])]
        else:
            words.append(draw.choice(FLAGS))
    if draw.random() < 0.1:
        draw.shuffle(words)
    return words


@pytest.fixture
def stand_ins(monkeypatch):
    """No solver, no pictures: what is looked at is what stands before them."""

    def solve(problem, grid, **options):
        memory.require(problem, grid, hjbjax.PolicyIteration(hjbjax.Sweeps()), np.float64, None)
        small = hjbjax.Grid(np.zeros(grid.ndim), np.ones(grid.ndim), (3,) * grid.ndim)
        return Solution(small, np.zeros(small.shape), None, code=Status.CONVERGED, steps=1)

    def make(problem, solution, folder, **options):
        (folder / "value.png").write_bytes(b"")
        yield "value.png", None

    monkeypatch.setattr(hjbjax, "solve", solve)
    monkeypatch.setattr(hjbjax, "estimate", lambda problem, grid, **options: Estimate(grid.shape, 1, None, None, 1))
    monkeypatch.setattr(run_folder, "make", make)
    monkeypatch.setattr(run_folder, "difference", lambda *arguments: 0.0)


@pytest.mark.slow
def test_no_command_line_ends_in_a_traceback(stand_ins, tmp_path, monkeypatch):
    draw, seen = random.Random(0), set()
    for number in range(LINES):
        folder = tmp_path / str(number)
        folder.mkdir()
        monkeypatch.chdir(folder)
        words = command_line(draw)
        result = CliRunner().invoke(main, words)
        assert result.exception is None or isinstance(result.exception, SystemExit), (words, result.exception)
        assert result.exit_code in (0, 2, 5, 6), (words, result.output)
        assert "Traceback" not in result.output, words
        if result.exit_code:
            assert result.stderr.count("\n") == 1, (words, result.stderr)
            assert result.stderr.startswith("hjbjax: "), (words, result.stderr)
        seen.add(result.exit_code)
    assert seen == {0, 2, 5, 6}  # 5: a checkpoint that is a folder; 6: a grid that does not fit
