"""Checkpoints: cut anywhere and resumed, a run comes to the bits of one that was never cut."""

import errno
import json
import os
import random
import signal
import subprocess
import sys
import threading
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


def test_the_file_of_another_question_is_refused(tmp_path, monkeypatch):
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
    with pytest.raises(hjb.FileError, match="it was made for another function, or another number of problems"):
        hjb.march(posed(), LINE, 1.0, checkpoint=path, resume=True)
    with monkeypatch.context() as patched:
        patched.setattr(checkpoints, "versions", lambda: {"jax": "99"})
        with pytest.raises(hjb.FileError, match=r"another problem, or the same with other versions \(.*; now jax 99\)"):
            hjb.solve(posed(1.5), LINE, checkpoint=path, resume=True)
    # the same question in other words: a function written anew
    hjb.solve(posed(), LINE, checkpoint=path, resume=True)


class Own(hjb.Upwind):
    """A scheme of a user, whose text does not show its number."""

    def __init__(self, number):
        super().__init__()
        object.__setattr__(self, "number", number)


def test_numbers_that_a_text_hides_belong_to_the_question():
    def question(number, scheme):
        grid = hjb.Grid([-1.0], [1.0], (21,), stretch=(hjb.Sinh(np.array(number)),))
        return checkpoints.describe_question([posed()], grid, scheme=scheme, method=hjb.PolicyIteration())

    first = question(2.0, Own(1.0))
    assert first == question(2.0, Own(1.0))
    assert [key for key in first if first[key] != question(2.0 + 1e-12, Own(1.0))[key]] == ["grid"]
    assert [key for key in first if first[key] != question(2.0, Own(1.5))[key]] == ["scheme"]


def test_what_stands_in_the_way_is_said_before_anything_is_computed(tmp_path):
    path = tmp_path / "run.npz"
    path.write_bytes(b"")
    with pytest.raises(FileExistsError, match=r"^solve: .*there is a checkpoint already; pass resume=True to continue"):
        hjb.solve(posed(), LINE, checkpoint=path)
    with pytest.raises(hjb.FileError, match="^solve: .*run.npz: cannot be read: it is empty"):
        hjb.solve(posed(), LINE, checkpoint=path, resume=True)
    with pytest.raises(ValueError, match="resume=True continues from a checkpoint; pass checkpoint="):
        hjb.solve(posed(), LINE, resume=True)
    with pytest.raises(hjb.FileError, match=r"^solve: .*run.npz: cannot be written: there is no folder .*missing$"):
        hjb.solve(posed(), LINE, checkpoint=tmp_path / "missing" / "run")
    with pytest.raises(hjb.FileError, match="it is a folder"):
        hjb.solve(posed(), LINE, checkpoint=tmp_path, resume=True)
    with pytest.raises(ValueError, match=r"Checkpoint: every = 0; wanted a finite number > 0, in seconds"):
        hjb.Checkpoint("run", every=0)
    hjb.solve(posed(), LINE, checkpoint=tmp_path / "other")  # which is no solution
    with pytest.raises(hjb.FileError, match="another kind, hjbjax.Checkpoint, wanted hjbjax.Solution"):
        hjb.load(tmp_path / "other.npz")


def full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("resume", [False, True])
def test_a_place_where_nothing_can_be_written_is_found_before_the_solve(tmp_path, monkeypatch, resume):
    cut = hjb.solve(posed(), LINE, checkpoint=tmp_path / "old.npz", max_steps=1, throw=False)
    assert cut.status is hjb.Status.MAX_STEPS
    monkeypatch.setattr(StatesInChunks, "advance", None)
    (tmp_path / "file").write_bytes(b"")
    for name, reason in (("x" * 256, "File name too long"), ("file/run.npz", "there is no folder .*file$")):
        with pytest.raises(hjb.FileError, match=f"^solve: .*cannot be written: {reason}"):
            hjb.solve(posed(), LINE, checkpoint=tmp_path / name, resume=resume)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(hjb.FileError, match=r"^solve: .*new\.npz: cannot be written: No space left on device"):
            hjb.solve(posed(), LINE, checkpoint=tmp_path / "new.npz", resume=resume)
        with pytest.raises(
            OSError, match=r"old\.npz: (there is a checkpoint already|cannot be written: No space left)"
        ):
            hjb.solve(posed(), LINE, checkpoint=tmp_path / "old.npz", resume=resume)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(hjb.FileError, match="run.npz: cannot be written: the current folder has been removed"):
        hjb.solve(posed(), LINE, checkpoint="run.npz", resume=resume)
    assert sorted(os.listdir(tmp_path)) == ["file", "old.npz"]


def test_a_complete_run_is_resumed_on_a_full_disk(tmp_path, monkeypatch):
    """It writes nothing; a part that has not begun must be refused before it computes anything."""
    path, lanes = tmp_path / "run.npz", tmp_path / "lanes.npz"
    wanted = hjb.solve(posed(), LINE, checkpoint=path)
    batch = hjb.solve_batch([posed(), posed(2.0)], LINE, checkpoint=lanes)
    before = path.read_bytes()
    with opened(tmp_path / "part.npz") as file:
        file.journal().leave(Counter(), hjb.Status.CONVERGED)
    monkeypatch.setattr(os, "fsync", full)
    found = hjb.solve(posed(), LINE, checkpoint=path, resume=True)
    alike(found, wanted)
    assert found.stats["checkpoint"] == "written"
    resumed = hjb.solve_batch([posed(), posed(2.0)], LINE, checkpoint=lanes, resume=True)
    for one, other in zip(resumed, batch, strict=True):
        alike(one, other)
    with opened(tmp_path / "part.npz", resume=True) as file:
        journal = file.journal()
        assert journal.enter(Counter()) is hjb.Status.CONVERGED
        with pytest.raises(hjb.FileError, match=r"^solve: .*part\.npz: cannot be written: No space left on device"):
            journal.enter(Counter())
    assert path.read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == ["lanes.npz", "part.npz", "run.npz"]


def test_a_full_disk_takes_the_checkpoint_and_not_the_answer(tmp_path, monkeypatch):
    write, writes = files.write_archive, []

    def full_after_the_first(*arguments):
        writes.append(None)
        return write(*arguments) if len(writes) == 1 else full()

    monkeypatch.setattr(files, "write_archive", full_after_the_first)
    kept = hjb.Checkpoint(tmp_path / "run", every=OFTEN)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solution = hjb.solve(posed(), LINE, checkpoint=kept)
    assert solution.status is hjb.Status.CONVERGED
    assert ["solve: the run goes on without a checkpoint" in str(each.message) for each in said] == [True]
    assert "No space left" in solution.stats["checkpoint"]
    assert len(writes) > 2


# --- one run, one file ---


def opened(path, *, resume=False, every=OFTEN, caller="solve", **others):
    """The file of a run that has been asked a question of its own."""
    kept = hjb.Checkpoint(path, every=every)
    return checkpoints.open_checkpoint(kept, [posed()], LINE, resume=resume, caller=caller, **others)


class Counter:
    """A part that counts, in an array of JAX's that every step takes for the next one."""

    passing = False
    _add = staticmethod(jax.jit(lambda x: x + 1, donate_argnums=0))

    def __init__(self, start=0.0):
        self.state = jnp.full(1000, start)

    def step(self):
        before, self.state = self.state, self._add(self.state)
        return before

    def saved(self):
        return [self.state]

    def restore(self, arrays):
        checkpoints.check_alike(arrays, [self.state])
        self.state = jnp.asarray(arrays[0])


def counts(path, **others):
    """What the counters of a file have come to, by the names of their journals."""
    with opened(path, resume=True, **others) as file:
        return {name: [float(each.arrays[0][0]) for each in records] for name, records in file.known.items()}


DOORS = {
    "solve": lambda **options: hjb.solve(posed(), LINE, **options),
    "solve_batch": lambda **options: hjb.solve_batch([posed()], LINE, **options),
    "march": lambda **options: hjb.march(posed(), LINE, 1.0, **options),
}


@pytest.mark.parametrize("door", DOORS)
def test_a_file_that_another_run_is_using_is_refused(tmp_path, door):
    path = tmp_path / "run.npz"
    (tmp_path / "link.npz").symlink_to("run.npz")
    with opened(path) as file:
        file.journal().leave(Counter(), hjb.Status.INTERRUPTED)
        file.write()
        for name in ("run", "run.npz", "link.npz"):
            with pytest.raises(hjb.FileError, match=rf"^{door}: .*run\.npz: another run is using it; wait for its end"):
                DOORS[door](checkpoint=tmp_path / name, resume=True)
            with pytest.raises(FileExistsError, match=f"^{door}: .*there is a checkpoint already"):
                DOORS[door](checkpoint=tmp_path / name)
    with pytest.raises(hjb.FileError, match=f"^{door}: .*made for another"):
        DOORS[door](checkpoint=path, resume=True)
    assert counts(path) == {"run": [0.0]}


def test_of_many_runs_with_one_new_file_one_begins(tmp_path):
    for resume in (False, True):
        path, barrier, ends = tmp_path / f"{resume}.npz", threading.Barrier(4), []

        def run(path=path, barrier=barrier, ends=ends, resume=resume):
            barrier.wait()
            try:
                with opened(path, resume=resume) as file:
                    file.journal().leave(Counter(), hjb.Status.CONVERGED)
                    barrier.wait()  # until the others have been refused
            except (FileExistsError, hjb.FileError) as error:
                ends.append(str(error))
                barrier.wait()
            else:
                ends.append(file.outcome)

        threads = [threading.Thread(target=run) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted("written" in each for each in ends) == [False, False, False, True]
        assert counts(path) == {"run": [0.0]}


def test_another_folder_meanwhile_sends_the_file_nowhere_else(tmp_path, monkeypatch):
    (tmp_path / "first").mkdir()
    (tmp_path / "second").mkdir()
    monkeypatch.chdir(tmp_path / "first")
    with opened("run") as file:
        monkeypatch.chdir(tmp_path / "second")
        file.journal().leave(Counter(), hjb.Status.INTERRUPTED)
    assert os.listdir(tmp_path / "second") == []
    assert counts(tmp_path / "first" / "run.npz") == {"run": [0.0]}


@pytest.mark.parametrize(
    "run",
    [
        lambda **kept: hjb.solve(posed(), LINE, **kept),
        lambda **kept: hjb.march(posed(), LINE, 0.1, **kept),
        lambda **kept: hjb.solve_batch([posed(), posed()], LINE, **kept),
    ],
    ids=["solve", "march", "solve_batch"],
)
def test_ctrl_c_during_the_last_write_is_not_lost(run, tmp_path, monkeypatch):
    """The write of a large state takes as long as its disk."""
    write, path = checkpoints.File.write, tmp_path / "run.npz"

    def pressed(file):
        os.kill(os.getpid(), signal.SIGINT)
        write(file)

    with monkeypatch.context() as patched:
        patched.setattr(checkpoints.File, "write", pressed)
        with pytest.raises(hjb.SolveError, match="interrupted after it had finished"):
            run(checkpoint=hjb.Checkpoint(path, every=np.inf))
    run(checkpoint=path, resume=True)


def test_a_run_that_is_refused_leaves_no_file_and_takes_none(tmp_path):
    path = tmp_path / "run.npz"
    broken = hjb.Problem(lambda x, u: u * jnp.nan, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    for resume in (False, True):
        with pytest.raises(ValueError, match="NaN"):
            hjb.solve(broken, LINE, checkpoint=path, resume=resume)
    assert os.listdir(tmp_path) == []
    with opened(path) as file:
        file.journal().leave(Counter(), hjb.Status.INTERRUPTED)
    with pytest.raises(KeyboardInterrupt), opened(path, resume=True):
        raise KeyboardInterrupt
    assert counts(path) == {"run": [0.0]}


def test_a_file_that_appears_during_the_run_is_not_replaced(tmp_path):
    path = tmp_path / "run.npz"
    with opened(path) as file:
        path.unlink()
        path.write_bytes(b"another's")
        file.journal().leave(Counter(), hjb.Status.CONVERGED)
        with pytest.warns(hjb.SolveWarning, match="^solve: the run goes on without a checkpoint: .*its own file there"):
            file.write()
    assert path.read_bytes() == b"another's"
    assert "its own file there" in file.outcome


def in_processes(run, monkeypatch, count=3):
    """The answers of a run in many processes of one solve, which here are threads."""
    me, barrier, votes, answers = threading.local(), threading.Barrier(count), [None] * count, [None] * count

    def agreed(number):
        votes[me.number] = number
        barrier.wait()
        least = min(votes)
        barrier.wait()
        return least

    def process(number):
        me.number = number
        try:
            answers[number] = run(number)
        except (hjb.FileError, FileExistsError) as error:
            answers[number] = error

    monkeypatch.setattr(checkpoints, "agreed", agreed)
    monkeypatch.setattr(checkpoints.jax, "process_index", lambda: me.number)
    threads = [threading.Thread(target=process, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return answers


def test_of_many_processes_of_one_solve_the_first_holds_the_file_and_all_read_it(tmp_path, monkeypatch):
    path = tmp_path / "run.npz"

    def run(number, resume=False):
        with opened(path, resume=resume, together=True) as file:
            journal = file.journal()
            known = [float(record.arrays[0][0]) for record in journal.records]
            journal.leave(Counter(float(number)), hjb.Status.INTERRUPTED)
            return known

    assert in_processes(run, monkeypatch) == [[], [], []]
    refused = in_processes(run, monkeypatch)
    assert [type(each) for each in refused] == [FileExistsError] * 3  # one exit code of all processes of a command
    assert "solve: " in str(refused[1])
    assert "another process of this run could not open it" in str(refused[1])
    with opened(path, resume=True):
        refused = in_processes(lambda number: run(number, resume=True), monkeypatch)
    assert [type(each) for each in refused] == [hjb.FileError] * 3
    assert "another run is using it" in str(refused[0])
    assert in_processes(lambda number: run(number, resume=True), monkeypatch) == [[0.0], [0.0], [0.0]]


# --- what is written, and when ---


def test_a_state_that_is_written_is_a_copy_that_the_next_step_does_not_touch(tmp_path):
    path, part, other = tmp_path / "run.npz", Counter(), Counter(10.0)
    with opened(path) as file:
        part.step()
        file.journal("one").keep(part)
        (kept,) = file.journal("one").records
        # a view would keep the step from using the memory of the state again
        assert not np.shares_memory(kept.arrays[0], np.asarray(part.state))
        part.state = jnp.full(1000, 5.0)
        file.journal("one").keep(part)
        assert part.step().is_deleted()
        file.journal("two").keep(other)
    assert counts(path) == {"one": [5.0], "two": [10.0]}


def test_nothing_is_written_before_it_is_time(tmp_path, monkeypatch):
    now, path, part = [0.0], tmp_path / "run.npz", Counter()
    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: now[0])
    stamps = []
    with opened(path, every=60.0) as file:
        for now[0] in (1.0, 59.0, 60.0, 61.0, 119.0, 121.0):
            part.step()
            file.journal().keep(part)
            stamps.append(os.stat(path).st_ino)
    assert [stamps[i] != stamps[i - 1] for i in range(1, 6)] == [False, True, False, False, True]
    assert counts(path) == {"run": [6.0]}


@pytest.mark.parametrize("every", [3600.0, OFTEN])
def test_a_solve_writes_as_often_as_it_is_told(tmp_path, monkeypatch, every):
    write, writes = files.write_archive, []
    monkeypatch.setattr(files, "write_archive", lambda *arguments: (writes.append(None), write(*arguments)))
    hjb.solve(posed(), LINE, checkpoint=hjb.Checkpoint(tmp_path / "run", every=every))
    assert len(writes) == 2 if every > 1 else len(writes) > 4  # the first, before the solve, and the last


def test_lanes_that_have_not_begun_stay_in_the_file(tmp_path):
    path = tmp_path / "run.npz"
    with opened(path) as file:
        for lane in range(3):
            file.journal(f"lane{lane}").leave(Counter(float(lane)), hjb.Status.MAX_STEPS)
    with opened(path, resume=True) as file:
        part = Counter()
        assert file.journal("lane1").enter(part) is None
        part.step()
        file.journal("lane1").keep(part)
        assert counts_in(path) == [0.0, 2.0, 2.0]
    assert counts(path) == {"lane0": [0.0], "lane1": [2.0], "lane2": [2.0]}


def counts_in(path):
    """What the counters of a file have come to, read by someone who takes no lock."""
    with np.load(path) as found:
        return [float(found[name][0]) for name in sorted(found) if name != "header"]


# --- files that someone made up ---


def forge(sound, path, changes):
    """A checkpoint with other arrays, of whose shapes and dtypes its header knows."""
    with np.load(sound) as found:
        arrays = {name: changes.get(name, np.asarray)(found[name]) for name in found if name != "header"}
        header = json.loads(found["header"].tobytes())
    for name in changes:
        journal, part, array = name.split("_")
        header["journals"][journal][int(part)][3][int(array)] = [list(arrays[name].shape), arrays[name].dtype.str]
    files.write(path, header, arrays, force=True)


def longer(array):
    return np.concatenate([array, array[-1:]]) if array.ndim else array[None]


def shorter(array):
    return array[:-1]


def cut_short(door, path, monkeypatch):
    """The checkpoint of a run that ended after some steps, and the options with which to go on."""
    with monkeypatch.context() as patched:
        if door == "march":
            options = {"times": np.linspace(0, 1, 4)}
            patched.setattr(MarchRun, "advance", Chunks(MarchRun.advance, 2))
            cut = DOORS[door](checkpoint=path, throw=False, **options)
        else:
            options = {}
            cut = DOORS[door](checkpoint=path, throw=False, max_steps=1)
    assert cut.status is not hjb.Status.CONVERGED
    return options


@pytest.mark.parametrize("door", ["solve", "march"])
def test_a_state_of_another_size_is_refused(tmp_path, door, monkeypatch):
    sound, path = tmp_path / "sound.npz", tmp_path / "run.npz"
    options = cut_short(door, sound, monkeypatch)
    with np.load(sound) as found:
        sizes = {name: found[name].shape for name in found if name != "header"}
    forgeries = [{name: longer} for name in sizes]
    forgeries += [{name: shorter} for name, shape in sizes.items() if shape and shape[0]]
    forgeries += [{"run_0_1": lambda array: array.astype("u4")}]
    if door == "march":  # more slices than there are times
        more = {f"run_0_{i}": lambda array: np.resize(array, (9, *array.shape[1:])) for i in range(1, 7)}
        forgeries += [{**more, "run_0_0": lambda count: count - count + 9}]
        none = {f"run_0_{i}": lambda array: array[:0] for i in range(1, 7)}
        forgeries += [{**none, "run_0_0": lambda count: count - count - 1}]
    for forgery in forgeries:
        forge(sound, path, forgery)
        with pytest.raises(hjb.FileError, match=f"^{door}: .*run.npz: cannot be read: it holds a state that this run"):
            DOORS[door](checkpoint=path, resume=True, **options)
    alike(DOORS[door](checkpoint=sound, resume=True, **options), DOORS[door](**options))


def test_a_part_that_is_done_has_its_state(tmp_path):
    path = tmp_path / "run.npz"
    with opened(path) as file:
        file.journal().leave(Counter(), hjb.Status.CONVERGED)
    with np.load(path) as found:
        header = json.loads(found["header"].tobytes())
    header["journals"]["run"][0][3] = []
    files.write(path, header, {}, force=True)
    with opened(path, resume=True) as file, pytest.raises(hjb.FileError, match="^solve: .*has 0 arrays, wanted 1"):
        file.journal().enter(Counter())


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
