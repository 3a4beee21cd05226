"""One solve by many processes and devices: refusals, the answer of one process, and a process that dies."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from click.testing import CliRunner

import hjbjax as hjb
from hjbjax.cli import launch
from hjbjax.cli.main import main

ROOT = Path(__file__).parents[2]
HEARTBEAT = 10


def command(folder, *words):
    """A process of the command, in a folder of its own."""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    return subprocess.Popen(
        [sys.executable, "-m", "hjbjax", *map(str, words)],
        cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def ended(process):
    """Exit code, standard output and standard error."""
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("launch", "--", "list"), "launch: got 'list', wanted solve"),
        (("launch", "--proceses", "2", "--", "solve", "pendulum"), "'--proceses'; did you mean '--processes'?"),
        (("launch", "--processes", "0", "--", "solve", "pendulum"), "wanted a whole number > 0"),
        (
            ("solve", "pendulum", "--devices", "1000x1000"),
            "1000000 devices were asked for; of a process 256 are the most",
        ),
        (("solve", "pendulum", "--devices", "7"), "7 devices were asked for, and "),
        (("solve", "pendulum", "--devices", "0x2"), "whole numbers of at least 1, one an axis, as in 4x2"),
    ],
)
def test_refusals(words, part, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    jax.devices()  # from here on there are as many as there are
    result = CliRunner().invoke(main, list(words))
    assert result.exit_code == 2
    assert part in result.stderr
    assert result.stderr.count("\n") == 1


def test_devices_that_are_not_the_same_number_in_each_process(monkeypatch):
    monkeypatch.setenv(launch.PROCESSES, "2")
    result = CliRunner().invoke(main, ["solve", "pendulum", "--devices", "3"])
    assert result.exit_code == 2
    assert "3 devices cannot be the same number in each of 2 processes" in result.stderr


def test_a_process_that_died_is_named_with_the_command_that_goes_on():
    died = launch._obituary(1, -9, 9.6, ("solve", "pendulum", "--checkpoint", "my run.npz"), 3)
    assert died.startswith("process 1 of 3 was ended by signal 9, and the others 10 s later; go on with: ")
    assert died.endswith("hjbjax launch --processes 3 -- solve pendulum --checkpoint 'my run.npz' --resume")
    died = launch._obituary(0, 1, 0.2, ("solve", "pendulum"), 2)
    assert died == (
        "process 0 of 2 ended with exit code 1, and the others 0 s later; with --checkpoint FILE a run can be resumed"
    )


@pytest.mark.slow
def test_two_processes_and_two_devices_give_the_answer_of_one(tmp_path):
    problem = ("solve", "pendulum", "--shape", "26x25", "--set", "discount=.5", "--scheme", "upwind", "--tol", "1e-6")
    for out, words in {
        "processes": ("launch", "--processes", "2", "--", *problem),
        "devices": (*problem, "--devices", "2"),
        "both": ("launch", "--", *problem, "--devices", "2x2"),
        "one": problem,
    }.items():
        code, said, err = ended(command(tmp_path, *words, "--out", tmp_path / out))
        assert (code, err) == (0, ""), err
        assert said.startswith("CONVERGED")
        assert "Gloo" not in said
        assert {"one": "cpu", "both": "2 x 2 cpu"}.get(out, "2 cpu") in said
    one, *others = (hjb.load(tmp_path / name / "solution.npz") for name in ("one", "processes", "devices", "both"))
    for other in others:
        assert np.max(np.abs(one.value - other.value)) <= one.error + other.error
    assert np.array_equal(others[0].value, others[1].value)  # the same parts


@pytest.mark.slow
def test_a_process_that_dies_takes_the_others_along_and_the_run_goes_on(tmp_path):
    # a way from the start of 180 steps, which a checkpoint holds, and then a climb of many minutes
    words = ("solve", "pendulum", "--shape", "400x401", "--method", "value-iteration", "--tol", "1e-9")
    words = (*words, "--checkpoint", "run.npz")
    process = command(tmp_path, "launch", "--heartbeat", HEARTBEAT, "--", *words)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    if not children.exists():
        process.kill()
        pytest.skip("the children of a process are not to be seen here")
    time.sleep(25)
    _, second = map(int, children.read_text().split())
    os.kill(second, signal.SIGKILL)
    died = time.monotonic()
    code, _, err = ended(process)
    assert time.monotonic() - died < HEARTBEAT + launch.GRACE
    assert code == launch.DIED
    last = err.splitlines()[-1]
    assert last.startswith("hjbjax: process 1 of 2 was ended by signal 9")
    again = last.partition("go on with: hjbjax ")[2].split()
    assert again[-1] == "--resume"
    assert (tmp_path / "run.npz").exists()
    code, _, err = ended(command(tmp_path, *again, "--max-steps", "200"))
    assert code == 3
    assert err.startswith("hjbjax: MAX_STEPS")


@pytest.mark.slow
def test_an_interrupt_ends_all_processes_at_one_step_and_leaves_the_answer_so_far(tmp_path):
    words = ("solve", "pendulum", "--shape", "400x401", "--method", "value-iteration", "--tol", "1e-9")
    process = command(tmp_path, "launch", "--", *words)
    time.sleep(25)
    process.send_signal(signal.SIGINT)
    code, said, _ = ended(process)
    assert code == 130
    assert said.startswith("INTERRUPTED")
    assert hjb.load(tmp_path / "pendulum" / "solution.npz").status.name == "INTERRUPTED"
