"""Children end when their launcher ends: by signals at any moment, ``kill -9``, stopped and deaf children.

The children are small scripts and the launcher is ``tests/support/cheap_launch.py``, so that a case takes a tenth of a
second. Every wait has a limit far above what it should take, and after every test no process may be left.
"""

import contextlib
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import cheap_launch
import pytest

from hjbjax.cli import children
from hjbjax.cli.children import ChildEnds, End

pytestmark = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="processes are found in /proc")
LIMIT = 60  # seconds: a wait that is longer is a failure
MARK = "HJBJAX_TEST_MARK"

SLEEPS = "up(); time.sleep(90)"
GENTLE = "on_request(130); up(); time.sleep(90)"
DEAF = "signal.signal(signal.SIGTERM, signal.SIG_IGN); up(); time.sleep(90)"
WELL = "print('said by', number, flush=True); print('noted by', number, file=sys.stderr)"


def until(condition):
    """What a condition gives once it is true."""
    end = time.monotonic() + LIMIT
    while not (found := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)
    return found


def marked(mark):
    """The processes, but for zombies, that have inherited a mark."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            if f"{MARK}={mark}".encode() in (folder / "environ").read_bytes():
                yield int(folder.name)


def states(pid):
    """The states of the threads of a process; none if it has ended."""
    found = set()
    for each in Path(f"/proc/{pid}/task").glob("*/stat"):
        with contextlib.suppress(OSError):  # the thread has ended meanwhile
            found.add(each.read_text().rpartition(")")[2].split()[0])
    return found


def stop(pid):
    """Stop a process with all of its threads: the system continues no other when the launcher dies."""
    os.kill(pid, signal.SIGSTOP)
    until(lambda: states(pid) <= {"T", "Z", "X"})


class Launch:
    """A running launcher in a folder, and its children."""

    def __init__(self, folder, mark, codes, **options):
        self.folder, self.mark, self.count = folder, mark, len(codes)
        words = [sys.executable, "-S", cheap_launch.__file__, json.dumps({"children": codes, **options})]
        self.process = subprocess.Popen(
            words, cwd=folder, env={**os.environ, MARK: mark}, stdout=-1, stderr=-1, bufsize=0
        )
        assert self.process.stdout.readline() == b"ready\n"

    def pids(self):
        """The process ids of all children by their numbers, once all of them are up."""

        def found():
            names = [path.name.split("-") for path in self.folder.glob("up-*")]
            return {int(number): int(pid) for _, number, pid in names} if len(names) == self.count else None

        return until(found)

    def ended(self):
        """What became of the children, and what was written before."""
        out, err = self.process.communicate(timeout=LIMIT)
        self.out, self.err = out.decode().splitlines(), err.decode().splitlines()
        assert self.process.returncode == 0, err
        return json.loads(self.out.pop())

    def signal(self, pid, number):
        """Signal a process; stop it only if the system continues it when the launcher dies.

        The system does not continue a child that is not yet the leader of its own group, or that stops after the death
        of its launcher.
        """
        if number != signal.SIGSTOP:
            os.kill(pid, number)
        elif pid in (self.process.pid, os.getpgid(pid)):
            stop(pid)
            if self.process.poll() is not None:
                os.kill(pid, signal.SIGCONT)

    def gone(self):
        """Wait until no process is left."""
        until(lambda: not list(marked(self.mark)))


@pytest.fixture
def launch(tmp_path):
    """A function that launches cheap children; at the end none of them may be left."""
    mark, launched = uuid.uuid4().hex, []

    def start(*codes, **options):
        launched.append(Launch(tmp_path, mark, codes, **options))
        return launched[-1]

    yield start
    left = list(marked(mark))
    for pid in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    for each in launched:
        each.process.communicate(timeout=LIMIT)
    assert not left


def codes_of(outcome):
    """The exit codes by numbers."""
    return [end["code"] for end in sorted(outcome["ends"], key=lambda end: end["number"])]


# --- ends of their own ---


def test_the_first_child_is_heard_and_all_end_well(launch):
    found = launch(WELL, WELL, "print('[muted] hello')")
    outcome = found.ended()
    assert (found.out, found.err) == (["said by 0"], ["noted by 0"])
    assert codes_of(outcome) == [0, 0, 0]
    assert (outcome["culprit"], outcome["interrupted"], outcome["killed"]) == (None, False, [])


def test_a_muted_line_is_not_passed_on(launch):
    found = launch("print('[muted] hello'); print('hello')")
    found.ended()
    assert found.out == ["hello"]


@pytest.mark.parametrize("dead", [0, 1, 2])
def test_a_child_that_is_killed_is_the_culprit_and_the_others_are_asked(launch, dead):
    found = launch(GENTLE, GENTLE, GENTLE)
    os.kill(found.pids()[dead], signal.SIGKILL)
    outcome = found.ended()
    assert outcome["culprit"] == dead
    assert codes_of(outcome) == [-9 if number == dead else 130 for number in range(3)]
    assert not outcome["interrupted"]


def test_a_child_that_raises_is_the_culprit_with_its_last_words(launch):
    outcome = launch(GENTLE, "raise ValueError('the disk of process 1')").ended()
    assert outcome["culprit"] == 1
    assert outcome["ends"][0] == {
        "number": 1, "code": 1, "words": "ValueError: the disk of process 1", "early": False
    }  # fmt: skip


def test_children_that_refuse_together_each_say_why(launch):
    """The second one is earlier; the first one is given the time to say it too."""
    found = launch("time.sleep(0.3); sys.exit('late' and 2)", "sys.exit(2)")
    assert codes_of(found.ended()) == [2, 2]


def test_the_first_child_ends_all(launch):
    """It speaks for all: who is left has nothing to say, whether it hears or not."""
    outcome = launch("pass", GENTLE, DEAF, settle=0.5, grace=1.5).ended()
    assert codes_of(outcome) == [0, 130, -9]
    assert outcome["killed"] == [2]


def test_a_child_that_ends_without_a_farewell_is_the_culprit_and_the_others_are_asked(launch):
    """As by ``exit(0)`` in a library: the others would wait for it."""
    early = "while not any(name.startswith('up-0') for name in os.listdir()): time.sleep(0.01)\nos._exit(0)"
    outcome = launch(GENTLE, early, farewell="farewell").ended()
    assert (outcome["culprit"], codes_of(outcome)) == (1, [130, 0])


def test_a_child_that_says_farewell_may_end_before_the_first_one(launch):
    outcome = launch("time.sleep(0.5)", "print('and farewell')", farewell="farewell").ended()
    assert (outcome["culprit"], codes_of(outcome)) == (None, [0, 0])


def test_a_stopped_child_is_the_culprit_and_not_the_one_that_fails_for_want_of_it(launch):
    found = launch("up()\nwhile not os.path.exists('go'): time.sleep(0.01)\nos.abort()", GENTLE)
    stop(found.pids()[1])
    (found.folder / "go").touch()
    outcome = found.ended()
    assert (outcome["culprit"], outcome["stopped"]) == (1, [1])
    assert codes_of(outcome) == [-6, 130]


@pytest.mark.parametrize(
    ("codes", "more", "culprit"),
    [
        ([(0, 0), (1, 0)], {}, None),
        ([(0, -6), (1, -9)], {}, 1),  # the first one is seen first, and only missed the other
        ([(0, 4), (2, -11), (1, 4)], {}, 2),
        ([(1, 4), (0, -15)], {}, 1),  # SIGTERM is the request to end
        ([(1, 3), (0, -9)], {"killed": (0,)}, 1),
        ([(0, -6), (1, -15), (2, -15)], {"stopped": (2,)}, 2),
        ([(1, -15), (0, 130)], {}, 1),
    ],
)
def test_who_is_the_culprit(codes, more, culprit):
    outcome = ChildEnds(tuple(End(number, code) for number, code in codes), **more)
    assert (outcome.culprit and outcome.culprit.number) == culprit


# --- signals ---


@pytest.mark.parametrize("number", children.SIGNALS)
def test_a_signal_asks_all_children_and_they_keep_what_they_have(launch, number, tmp_path):
    found = launch(GENTLE, GENTLE, GENTLE)
    found.pids()
    found.process.send_signal(number)
    outcome = found.ended()
    assert outcome["interrupted"]
    assert codes_of(outcome) == [130, 130, 130]
    assert len(list(tmp_path.glob("kept-*"))) == 3


@pytest.mark.parametrize(
    ("number", "delay"),
    [*itertools.product([signal.SIGINT, signal.SIGKILL], [0.0, 0.003, 0.01, 0.03]), (signal.SIGHUP, 0.01)],
)
def test_a_signal_at_the_start_leaves_nobody(launch, delay, number):
    found = launch(SLEEPS, SLEEPS, SLEEPS, SLEEPS, follow=True)
    time.sleep(delay)
    found.process.send_signal(number)
    found.gone()
    if found.process.wait() == 0:  # else it had not begun to start them
        outcome = found.ended()
        assert outcome["interrupted"]
        assert codes_of(outcome) == [-15] * 4


def test_a_second_signal_kills(launch):
    found = launch(DEAF, DEAF, grace=600)
    found.pids()
    found.process.send_signal(signal.SIGINT)
    time.sleep(2 * children.BOUNCE)
    found.process.send_signal(signal.SIGINT)
    outcome = found.ended()
    assert (outcome["hurried"], outcome["killed"]) == (True, [0, 1])
    assert codes_of(outcome) == [-9, -9]


def test_signals_that_come_together_are_one_request(launch):
    """A terminal that closes tells the launcher, and so does its shell; a service manager sends two kinds at once."""
    slow = "signal.signal(signal.SIGTERM, lambda *_: (time.sleep(0.2), os._exit(130))); up(); time.sleep(90)"
    found = launch(slow, slow)
    found.pids()
    for number in (signal.SIGHUP, signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        found.process.send_signal(number)
    outcome = found.ended()
    assert codes_of(outcome) == [130, 130]
    assert (outcome["hurried"], outcome["killed"]) == (False, [])


def test_a_deaf_child_is_killed_after_the_grace_and_named(launch):
    found = launch(GENTLE, DEAF, GENTLE, grace=3)
    found.pids()
    found.process.send_signal(signal.SIGTERM)
    outcome = found.ended()
    assert outcome["killed"] == [1]
    assert codes_of(outcome) == [130, -9, 130]


def test_a_child_that_stays_stopped_is_continued_to_its_end(launch):
    """The others wait for it, and all of them keep what they have."""
    found = launch(GENTLE, GENTLE, patience=1)
    stop(found.pids()[1])
    outcome = found.ended()
    assert (outcome["culprit"], outcome["stopped"], outcome["interrupted"]) == (1, [1], False)
    assert codes_of(outcome) == [130, 130]


def test_a_child_that_has_not_arrived_in_time_is_the_culprit(launch):
    """As one that hangs while it starts: JAX would abort the one that waits for it, after five minutes."""
    arrives = "print('arrived', flush=True); "
    found = launch(arrives + GENTLE, DEAF, arrives + "sys.exit(0)", grace=2, arrival=["arrived", 1])
    outcome = found.ended()
    assert (outcome["culprit"], outcome["late"], outcome["killed"]) == (1, [1], [1])
    assert codes_of(outcome) == [130, -9, 0]
    assert found.out == []


def test_a_deaf_child_is_killed_where_another_one_died(launch):
    found = launch(DEAF, GENTLE, DEAF, grace=3)
    os.kill(found.pids()[1], signal.SIGKILL)
    outcome = found.ended()
    assert (outcome["culprit"], outcome["killed"]) == (1, [0, 2])


@pytest.mark.parametrize("stopped", [[0], [1], [0, 1]])
def test_a_stopped_child_goes_on_in_order_to_end(launch, stopped):
    found = launch(GENTLE, GENTLE)
    pids = found.pids()
    for number in stopped:
        stop(pids[number])
    found.process.send_signal(signal.SIGINT)
    outcome = found.ended()
    assert codes_of(outcome) == [130, 130]
    assert (outcome["stopped"], outcome["killed"]) == (stopped, [])


def test_a_signal_to_the_launcher_and_all_children_at_once(launch):
    """As from ``pkill``; those that follow a launcher leave SIGINT to it."""
    found = launch(GENTLE, GENTLE, follow=True)
    for pid in [found.process.pid, *found.pids().values()]:
        with contextlib.suppress(ProcessLookupError):  # the launcher was faster
            os.kill(pid, signal.SIGINT)
    assert codes_of(found.ended()) == [130, 130]


def test_a_signal_that_is_ignored_stays_ignored(launch):
    found = launch(GENTLE, ignored=["SIGHUP"])
    found.pids()
    found.process.send_signal(signal.SIGHUP)
    time.sleep(0.2)
    assert found.process.poll() is None
    found.process.send_signal(signal.SIGTERM)
    assert codes_of(found.ended()) == [130]


def test_ends_are_seen_where_the_parent_ignores_them(launch):
    found = launch(GENTLE, "os.kill(os.getpid(), 9)", ignored=["SIGCHLD"])
    outcome = found.ended()
    assert (outcome["culprit"], codes_of(outcome)[1]) == (1, -9)


# --- a launcher that is killed ---


@pytest.mark.parametrize("stopped", [None, 0, 1])
def test_children_of_a_killed_launcher_keep_what_they_have(launch, tmp_path, stopped):
    found = launch(GENTLE, GENTLE, follow=True)
    pids = found.pids()
    if stopped is not None:
        stop(pids[stopped])
    found.process.kill()
    found.gone()
    assert {path.name for path in tmp_path.glob("kept-*")} == {"kept-0", "kept-1"}


@pytest.mark.slow
def test_a_deaf_child_of_a_killed_launcher_ends_too(launch):
    found = launch(DEAF, GENTLE, follow=True)
    found.pids()
    found.process.kill()
    found.gone()


def test_a_child_that_follows_imports_from_where_its_launcher_does(launch, tmp_path):
    """A file of the working directory replaces no module of the standard library."""
    (tmp_path / "queue.py").write_text("raise RuntimeError('from the working directory')")
    found = launch("import cheap_launch; print(sys.argv[1:])", follow=True)
    assert codes_of(found.ended()) == [0]
    assert found.out == ["['0']"]


def test_a_child_does_not_end_in_a_prompt(tmp_path, monkeypatch):
    """Its exit code would be 1 in any case."""
    (tmp_path / "ends.py").write_text("raise SystemExit(3)")
    monkeypatch.syspath_prepend(tmp_path)
    command = children.followed("ends", [], {**os.environ, "PYTHONINSPECT": "1"})
    with subprocess.Popen(command.words, env=command.environment, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        assert run.wait(timeout=LIMIT) == 3


def test_a_child_that_reads_finds_no_input(launch):
    found = launch("print(repr(sys.stdin.read()))", follow=True)
    found.ended()
    assert found.out == ["''"]


# --- other faults ---


def test_a_child_that_cannot_be_started_leaves_nobody(launch):
    outcome = launch(SLEEPS, DEAF, broken=True).ended()
    assert "/no/such/program" in outcome["error"]


def test_a_child_writes_on_where_nobody_reads(launch):
    """The first lines go to ``head -1``, and then the pipe is closed: the child must not wait for ever to be read."""
    found = launch("up(); time.sleep(0.2)\nfor _ in range(20_000): print('x' * 80)\nopen('done', 'w').close()")
    found.process.stdout.close()
    err = found.process.stderr.read()
    assert "BrokenPipeError" in json.loads(err)["unwritten"]
    assert (found.folder / "done").exists()
    found.process.wait(timeout=LIMIT)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100))
def test_random_signals_at_random_times(launch, seed):
    """Whoever is signalled, nobody is left when the launcher has ended by Ctrl-C or by SIGKILL."""
    rng = random.Random(seed)
    codes = [rng.choice([SLEEPS, GENTLE, WELL, "time.sleep(0.05)"]) for _ in range(rng.randint(1, 4))]
    found = launch(*codes, follow=True, grace=2)
    for _ in range(rng.randint(0, 4)):
        time.sleep(rng.random() * 0.05)
        number = rng.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGSTOP, signal.SIGCONT])
        if there := list(marked(found.mark)):
            with contextlib.suppress(ProcessLookupError):
                found.signal(rng.choice(there), number)
    time.sleep(0.05)
    found.process.send_signal(signal.SIGCONT)
    found.process.send_signal(rng.choice([signal.SIGINT, signal.SIGKILL]))
    found.gone()
