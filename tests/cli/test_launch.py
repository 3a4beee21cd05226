"""One solve by many processes and devices: refusals, the answer of one process, and a process that dies."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from click.testing import CliRunner

import hjbjax as hjb
from hjbjax.cli import children, launch, run_folder
from hjbjax.cli.children import ChildEnds, End
from hjbjax.cli.command_line import Failure
from hjbjax.cli.main import main
from hjbjax.solution.locked_file import LockedFile
from hjbjax.solution.solution import Solution, Status

ROOT = Path(__file__).parents[2]
HEARTBEAT = 10
COMMAND = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
from hjbjax.__main__ import start
start()
"""


def command(folder, *words):
    """A process of the command, in a folder of its own."""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, *map(str, words)],
        cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def ended(process):
    """Exit code, standard output and standard error."""
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def refused(words, part, code=2):
    """Assert that a command is refused in one line."""
    result = CliRunner().invoke(main, list(words))
    assert result.exit_code == code, result.stderr
    assert part in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.fixture
def _no_child(monkeypatch):
    """A test in which no process may be started."""
    monkeypatch.setattr(children, "run_children", lambda *_, **__: pytest.fail("a process was started"))


@pytest.mark.usefixtures("_no_child")
@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("list",), "launch: got 'list', wanted solve"),
        (("--proceses", "2", "--", "solve", "pendulum"), "'--proceses'; did you mean '--processes'?"),
        (("--processes", "0", "--", "solve", "pendulum"), "wanted a whole number > 0"),
        (("--processes", "100000", "--", "solve", "pendulum"), "--processes 100000, wanted at most 256"),
        (("--heartbeat", "9" * 30, "--", "solve", "pendulum"), "wanted at most 86400"),
        (("--", "solve", "pendulum", "--devices", "3"), "3 devices cannot be the same number in each of 2 processes"),
        (("--processes", "30", "--", "solve", "bang-bang", "--shape", "41"), "at most 13 parts"),
        (("--processes", "90", "--", "solve", "pendulum"), "the 200 points of axis 0 into 90 parts"),
        (("--", "solve", "bang-bang", "--devices", "2x1"), "got a mesh of 2 axes, (2, 1), wanted at most 1"),
        (("--", "solve", "bang-bang", "--shape", "41x41"), "got 2 sizes, but bang-bang has 1 axes"),
        (("--", "solve", "pendulum", "--set", "trque=2"), "did you mean 'torque'?"),
        (("--", "solve", "pendulum", "--set", "torque=-1"), "no admissible control: input 0 has lo = 1 > hi = -1"),
        (("--", "solve", "pendulum", "--scheme", "semi-lagrangian"), "runs on one device; leave out mesh"),
        (("--", "solve", "dividends"), "mesh divides axis 0, along which the problem has pushes"),
        (("--", "solve", "pendulum", "--dry-run", "--shape", "9"), "got 1 sizes, but pendulum has 2 axes"),
        (("--", "solve", "pendulm"), "did you mean 'pendulum'?"),
        (("--", "solve", "pendulum", "--tol", "nan"), "got 'nan', wanted a finite number > 0"),
        (("--", "solve"), "Missing argument 'NAME'"),
        (("--", "solve", "pendulum", "--resume"), "--resume continues from a checkpoint; add --checkpoint FILE"),
        (("--", "solve", "pendulum", "--out", "old"), "old contains value.png already"),
        (("--", "solve", "pendulum", "--out", "run.npz"), "run.npz exists but is not a folder"),
        (("--", "solve", "pendulum", "--out", "run.npz/out"), "run.npz/out cannot be written"),
        (
            ("--", "solve", "pendulum", "--checkpoint", "run"),
            "run.npz already exists; add --resume to continue from it",
        ),
    ],
)
def test_a_launch_that_is_refused_starts_no_process(words, part, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "value.png").touch()
    (tmp_path / "run.npz").touch()
    refused(("launch", *words), part)


@pytest.mark.usefixtures("_no_child")
@pytest.mark.parametrize(
    ("checkpoint", "part"),
    [("nowhere/run.npz", "there is no folder"), (".", "it is a folder")],
)
def test_a_checkpoint_that_cannot_be_written_is_found_before_a_process_starts(checkpoint, part, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(("launch", "--", "solve", "pendulum", "--resume", "--checkpoint", checkpoint), part, 5)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("_no_child")
def test_a_checkpoint_that_another_run_is_using_is_found_before_a_process_starts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.npz").write_bytes(b"of the other run")
    with contextlib.closing(LockedFile(str(tmp_path / "run.npz"))) as file:
        file.take()
        refused(("launch", "--", "solve", "pendulum", "--resume", "--checkpoint", "run"), "another run is using it", 5)


def leave_checkpoint(path):
    """Write the checkpoint of a small solve."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    hjb.solve(problem, hjb.Grid([-1.0], [1.0], (9,)), scheme=hjb.Upwind(), tol=1e-2, checkpoint=path)


@pytest.mark.usefixtures("_no_child")
@pytest.mark.parametrize("damage", [lambda data: data[:-100], lambda data: data[:600] + b"\0" + data[601:]])
def test_a_damaged_checkpoint_is_found_before_a_process_starts(damage, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    leave_checkpoint("run.npz")
    damaged = damage((tmp_path / "run.npz").read_bytes())
    (tmp_path / "run.npz").write_bytes(damaged)
    refused(("launch", "--", "solve", "pendulum", "--resume", "--checkpoint", "run"), "run.npz: cannot be read: ", 5)
    assert (tmp_path / "run.npz").read_bytes() == damaged


@pytest.mark.usefixtures("_no_child")
def test_more_nodes_than_indices_are_found_before_a_process_starts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(("launch", "--", "solve", "pendulum", "--shape", "100000x100000"), "10,000,000,000 nodes", 6)


@pytest.mark.slow  # it needs a process in which JAX has not started
def test_the_launcher_leaves_the_accelerators_to_its_processes(tmp_path):
    """A platform that does not exist stops JAX where it asks for anything but the processor."""
    code = (
        "import jax, sys; from hjbjax.cli import launch; from hjbjax.cli.main import main\n"
        "launch.start_processes = lambda *_: print(jax.devices()[0].platform) or 0\n"
        "main(['launch', '--', 'solve', 'stochastic-lq'])\n"
    )
    environment = {**os.environ, "JAX_PLATFORMS": "nowhere"}
    found = subprocess.run([sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert (found.returncode, found.stdout) == (0, "cpu\n"), found.stderr


def test_a_launch_in_a_folder_that_is_allowed_starts(tmp_path, monkeypatch):
    """What is refused above, with --force and --resume; and a dry run, which writes nothing."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pendulum").mkdir()
    (tmp_path / "pendulum" / "value.png").touch()
    leave_checkpoint("run.npz")
    monkeypatch.setattr(children, "run_children", lambda *_, **__: ChildEnds((End(0, 0), End(1, 0))))
    for more in (("--force", "--checkpoint", "run", "--resume"), ("--dry-run",)):
        assert CliRunner().invoke(main, ["launch", "--", "solve", "pendulum", *more]).exit_code == 0


@pytest.mark.parametrize(
    ("devices", "part"),
    [
        ("1000x1000", "got 1000000 devices, wanted at most 256 per process"),
        ("7", "got 7 devices, but only "),
        ("0x2", "whole numbers of at least 1, one per axis, as in 4x2"),
    ],
)
def test_devices_that_are_not_there(devices, part, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    jax.devices()  # from here on there are as many as there are
    refused(("solve", "pendulum", "--devices", devices), part)


# --- in each process ---

MEMBER = {launch.RANK: "0", launch.PROCESSES: "2", launch.COORDINATOR: "127.0.0.1:4000", launch.HEARTBEAT: "10"}


def as_member(monkeypatch, **changed):
    """The environment of a process of a launch; None takes a variable out."""
    for name, value in {**MEMBER, **changed}.items():
        if value is None:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, value)


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        (launch.RANK, "x", "got 'x', wanted a whole number from 0 to 1"),
        (launch.RANK, "", "got '', wanted a whole number from 0 to 1"),
        (launch.RANK, "2", "got '2', wanted a whole number from 0 to 1"),
        (launch.RANK, "-1", "got '-1', wanted a whole number from 0 to 1"),
        (launch.RANK, "0.5", "got '0.5', wanted a whole number from 0 to 1"),
        (launch.RANK, None, "HJBJAX_RANK is not set, but HJBJAX_PROCESSES"),
        (launch.PROCESSES, "x", "got 'x', wanted a whole number from 1 to 256"),
        (launch.PROCESSES, "0", "got '0', wanted a whole number from 1 to 256"),
        (launch.PROCESSES, "9" * 30, "wanted a whole number from 1 to 256"),
        (launch.PROCESSES, None, "HJBJAX_PROCESSES is not set, but HJBJAX_RANK"),
        (launch.COORDINATOR, "127.0.0.1", "got '127.0.0.1', wanted HOST:PORT"),
        (launch.COORDINATOR, ":80", "got ':80', wanted HOST:PORT"),
        (launch.COORDINATOR, "here:99999", "got 'here:99999', wanted HOST:PORT"),
        (launch.COORDINATOR, None, "HJBJAX_COORDINATOR is not set"),
        (launch.HEARTBEAT, "0", "got '0', wanted a whole number from 1 to 86400"),
        (launch.HEARTBEAT, "soon", "got 'soon', wanted a whole number from 1 to 86400"),
    ],
)
def test_a_bad_environment_is_refused_in_one_line(name, value, wanted, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    as_member(monkeypatch, **{name: value})
    refused(("solve", "pendulum"), wanted)
    refused(("solve", "pendulum"), f"{name}")
    refused(("solve", "pendulum"), "unset all of them to solve in one process")


@pytest.mark.parametrize("port", ["4_000", "٤٠٠٠", "04000"])
def test_a_port_is_passed_on_as_a_number(port, monkeypatch):
    as_member(monkeypatch, **{launch.COORDINATOR: f"127.0.0.1:{port}"})
    assert launch.member().coordinator == "127.0.0.1:4000"


def test_devices_that_are_not_the_same_number_in_each_process(monkeypatch):
    as_member(monkeypatch)
    refused(("solve", "pendulum", "--devices", "3"), "3 devices cannot be the same number in each of 2 processes")


def test_a_port_that_is_taken_is_named_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    jax.devices()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        place = f"127.0.0.1:{taken.getsockname()[1]}"
        as_member(monkeypatch, **{launch.COORDINATOR: place})
        refused(("solve", "pendulum"), f"process 0 of 2 could not meet the others at {place}: Address already in use")


def test_a_port_is_reserved_until_the_first_process_has_it():
    """No other program gets it meanwhile, and the service of the first process can share it."""
    with launch.reserved_port() as port:
        with pytest.raises(OSError, match="in use"), socket.create_server(("127.0.0.1", port)):
            pass
        launch._check_port(*launch._address_of(f"127.0.0.1:{port}"))


@pytest.mark.parametrize("number", ["0", "1"])
@pytest.mark.parametrize("host", ["no-such-host.invalid", "a..b", "x" * 90])
def test_a_host_that_is_unknown_is_named_in_one_line(host, number, tmp_path, monkeypatch):
    """JAX would wait for it for five minutes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(jax.distributed, "initialize", lambda *_, **__: pytest.fail("JAX looks for the host"))
    as_member(monkeypatch, **{launch.RANK: number, launch.COORDINATOR: f"{host}:4000"})
    refused(("solve", "pendulum"), f"HJBJAX_COORDINATOR: got '{host}:4000', but the host '{host}' is unknown")


def test_the_host_of_another_machine_is_not_taken_for_a_port_in_use(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    as_member(monkeypatch, **{launch.COORDINATOR: "192.0.2.1:4000"})  # RFC 5737: an address of no machine
    refused(("solve", "pendulum"), "Cannot assign requested address; process 0 must run on the host in HJBJAX_COORD")


def test_the_host_may_be_an_address_of_ipv6():
    assert launch._address_of("[::1]:4000")[1][:2] == ("::1", 4000)


def test_a_process_waits_for_the_others_as_long_as_its_launcher(monkeypatch):
    """JAX waits for five minutes, also with so many processes that the launcher waits for longer."""
    options = {}
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    monkeypatch.setattr(jax.distributed, "initialize", lambda *_, **given: options.update(given))
    launch._join(launch.Member(1, 200, "127.0.0.1:4000", HEARTBEAT))
    assert options["initialization_timeout"] == launch.ARRIVAL + 200


@pytest.mark.parametrize("number", ["0", "1"])
def test_the_processes_part_before_the_pictures(number, tmp_path, monkeypatch):
    """JAX ends a process that waits for five minutes; and only the first one says that the steps ran out."""
    monkeypatch.chdir(tmp_path)
    as_member(monkeypatch, **{launch.RANK: number})
    order = []

    def solved(problem, grid, **options):
        return Solution(grid, np.zeros(grid.shape), None, code=Status.MAX_STEPS, steps=7, residuals=np.array([1.0]))

    monkeypatch.setattr(launch, "mesh_of", lambda counts: None)
    monkeypatch.setattr(hjb, "solve", solved)
    monkeypatch.setattr(launch, "leave", lambda: order.append("parted"))
    monkeypatch.setattr(run_folder, "make", lambda *_, **__: order.append("drawn") or iter(()))
    result = CliRunner().invoke(main, ["solve", "pendulum", "--no-cache"])
    assert order == ["parted", "drawn"][: 1 + (number == "0")]
    assert result.exit_code == (3 if number == "0" else 0), result.output


@pytest.mark.parametrize(("number", "words"), [("0", ""), ("1", f"{launch.FAREWELL}\n")])
def test_a_process_that_is_not_needed_any_more_says_so(number, words, monkeypatch, capsys):
    as_member(monkeypatch, **{launch.RANK: number})
    launch.leave()  # it has not met the others: JAX has nothing to part from
    assert capsys.readouterr().out == words


def test_the_first_process_checks_its_places_before_it_meets_the_others(tmp_path, monkeypatch):
    """Another launch may have made the checkpoint meanwhile; the others would wait in the middle of the solve."""
    as_member(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(launch, "mesh_of", None)
    (tmp_path / "run.npz").touch()
    refused(("solve", "pendulum", "--checkpoint", "run"), "run.npz already exists")


@pytest.mark.parametrize("number", [None, "0", "1"])
def test_a_process_of_a_launch_reports_that_it_has_begun(number, monkeypatch, capsys):
    if number is not None:
        as_member(monkeypatch, **{launch.RANK: number})
    launch.arrive()
    assert capsys.readouterr().out == ("" if number is None else f"{launch.ARRIVED}\n")


# --- what is said at the end ---

WAY_ON = "go on"


def outcome_of(*codes, words="", **more):
    """An outcome with the exit codes of processes in the order in which they ended."""
    return ChildEnds(tuple(End(number, code, words) for number, code in codes), **more)


@pytest.mark.parametrize(
    ("outcome", "code"),
    [
        (outcome_of((1, 0), (0, 0)), 0),
        (outcome_of((0, 0), (1, -15)), 0),  # as after a dry run, for which the first does not need the others
        (outcome_of((0, 3), (1, -9), killed=(1,)), 3),
        (outcome_of((1, 2), (0, 2)), 2),
        (outcome_of((1, 130), (0, 130), interrupted=True), 130),
        (outcome_of((1, -15), (0, 0), interrupted=True), 0),
        (outcome_of((0, 130), (1, -9), interrupted=True, hurried=True, killed=(1,)), 130),  # it kept everything
    ],
)
def test_the_first_process_has_said_it(outcome, code):
    assert launch._verdict(outcome, WAY_ON) == code


@pytest.mark.parametrize(
    ("outcome", "code", "line"),
    [
        (outcome_of((1, -9), (0, 130)), 7, "process 1 of 2 was ended by signal 9 (SIGKILL); go on"),
        (outcome_of((1, -40), (0, 130)), 7, "process 1 of 2 was ended by signal 40; go on"),
        (outcome_of((0, 4), (2, -11), (1, 4)), 7, "process 2 of 3 was ended by signal 11 (SIGSEGV); go on"),
        (
            outcome_of((1, 1), (0, 130), words="ValueError: no"),
            7,
            "process 1 of 2 ended with exit code 1: ValueError: no; go on",
        ),
        (outcome_of((1, 6), (0, -15), words="hjbjax: no memory"), 6, "process 1 of 2: no memory"),
        (
            outcome_of((0, -6), (1, 130), stopped=(1,)),
            7,
            "process 1 of 2 was stopped, and the others cannot go on without it; go on",
        ),
        (
            outcome_of((0, -15), (1, -9), late=(1,), killed=(1,)),
            7,
            "process 1 of 2 did not start within 122 s; go on",
        ),
        (
            ChildEnds((End(1, 0, early=True), End(0, -6))),
            7,
            "process 1 of 2 ended with exit code 0 before the others were done; go on",
        ),
        (outcome_of((0, -15), (1, -15), interrupted=True), 130, "interrupted"),
        (
            outcome_of((0, 4), (1, -9), interrupted=True, killed=(1,)),
            130,
            "interrupted; process 1 of 2 was killed, not having ended in 7 s; go on",
        ),
        (
            outcome_of((0, -9), (1, -9), (2, -9), interrupted=True, killed=(0, 1, 2), stopped=(1,)),
            130,
            "interrupted; process 1 of 3 was killed, not having ended in 7 s; go on",
        ),
        (
            outcome_of((0, -9), (1, -9), interrupted=True, hurried=True, killed=(0, 1)),
            130,
            "interrupted; processes 0, 1 of 2 were killed by the second signal; go on",
        ),
    ],
)
def test_the_process_that_failed_is_named(outcome, code, line):
    with pytest.raises(Failure) as failed:
        launch._verdict(outcome, WAY_ON)
    assert (failed.value.exit_code, failed.value.message) == (code, line)


def test_the_command_that_goes_on(tmp_path):
    words = ("solve", "pendulum", "--checkpoint", "my run.npz")
    again = "go on with: hjbjax launch --processes 3 -- solve pendulum --checkpoint 'my run.npz' --resume"
    result = tmp_path / "solution.npz"
    assert launch._way_on(words, 3, result) == again
    assert launch._way_on((*words, "--resume"), 3, result) == again
    result.touch()
    assert launch._way_on(words, 3, result) == f"{again} --force"
    assert launch._way_on(("solve", "pendulum"), 2, result) == "with --checkpoint FILE a run can be resumed"


# --- real processes ---


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
        unexpected = [line for line in err.splitlines() if "the box decides V" not in line]
        assert (code, unexpected) == (0, [])
        assert said.startswith("CONVERGED")
        assert "Gloo" not in said
        assert {"one": "cpu", "both": "2 x 2 cpu"}.get(out, "2 cpu") in said
    one, *others = (hjb.load(tmp_path / name / "solution.npz") for name in ("one", "processes", "devices", "both"))
    for other in others:
        assert np.max(np.abs(one.value - other.value)) <= one.error + other.error
    assert np.array_equal(others[0].value, others[1].value)  # the same parts


LONG = ("solve", "pendulum", "--shape", "400x401", "--method", "value-iteration", "--tol", "1e-9")  # many minutes


@pytest.fixture
def running(tmp_path):
    """A long solve in two processes under way, with the process ids of the two; at the end none of them may be left."""
    if not Path("/proc/self/task").exists():
        pytest.skip("the children of a process are found in /proc")
    process = command(tmp_path, "launch", "--heartbeat", HEARTBEAT, "--", *LONG, "--checkpoint", "run.npz")
    children_of = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    wait_for(lambda: list(tmp_path.glob(".pendulum.*")))  # the hidden folder of the first process
    time.sleep(15)
    pids = [int(pid) for pid in children_of.read_text().split()]
    yield process, pids
    left = [pid for pid in (process.pid, *pids) if is_running(pid)]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    process.communicate(timeout=60)
    assert not left


def wait_for(condition):
    """Wait until a condition is true."""
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.1)


def is_running(pid):
    """True if a process is there and has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
def test_a_process_that_dies_is_named_and_the_run_goes_on(running, tmp_path):
    process, pids = running
    os.kill(pids[1], signal.SIGKILL)
    code, _, err = ended(process)
    assert code == launch.DIED
    last = err.splitlines()[-1]
    assert last.startswith("hjbjax: process 1 of 2 was ended by signal 9 (SIGKILL)")
    again = last.partition("go on with: hjbjax ")[2].split()
    assert again[-1] == "--resume"
    code, _, err = ended(command(tmp_path, *again, "--max-steps", "200"))
    assert code == 3
    assert err.startswith("hjbjax: MAX_STEPS")


@pytest.mark.slow
def test_a_process_that_is_stopped_is_named_and_all_keep_what_they_have(running, tmp_path):
    process, pids = running
    os.kill(pids[1], signal.SIGSTOP)
    code, _, err = ended(process)
    assert code == launch.DIED
    assert err.splitlines()[-1].startswith("hjbjax: process 1 of 2 was stopped")
    assert (tmp_path / "run.npz").exists()
    assert hjb.load(tmp_path / "pendulum" / "solution.npz").status.name == "INTERRUPTED"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_launcher_that_is_signalled_leaves_the_answer_so_far(running, tmp_path, number):
    """By SIGKILL, too: the processes notice it."""
    process, pids = running
    process.send_signal(number)
    code, said, _ = ended(process)
    if number == signal.SIGKILL:
        wait_for(lambda: not any(is_running(pid) for pid in pids))
    else:
        assert code == launch.INTERRUPTED
        assert said.startswith("INTERRUPTED")
    assert (tmp_path / "run.npz").exists()
    assert hjb.load(tmp_path / "pendulum" / "solution.npz").status.name == "INTERRUPTED"
