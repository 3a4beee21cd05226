"""Time limits and Ctrl-C in every phase of a solve and of a march: what there is comes back, and says how far it came.

A signal is sent to this very process; in a job that a shell starts in the background it is ignored, so that the usual
handler is put in its place first.
"""

import dataclasses
import signal
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.applications import convergence, hinf, perturbations
from hjbjax.extremals import collocation, continuation, equilibria
from hjbjax.feedback import simulation
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.solution import clock as clock_module
from hjbjax.solution.clock import Clock, Stopped, interruptible, noting_interrupts
from hjbjax.solvers import batch, host_loop, march_run, stationary_run
from hjbjax.solvers.march_run import MarchRun
from hjbjax.solvers.stationary_run import LanesRun, StationaryRun
from hjbjax.well_posedness import node_checks

U = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([-1.0], [1.0], (25,))
INTERRUPTED, TIME_LIMIT = hjb.Status.INTERRUPTED, hjb.Status.TIME_LIMIT


def drift(x, u):
    return u


def cost(x, u):
    return 1.0 + x @ x


def disc(x):
    return jnp.abs(x[0]) - 0.1


def push(x, u, d):
    return u + d


def effort(x, u, d):
    return x @ x


def question(**changes):
    return hjb.Problem(drift, cost, U, **({"discount": 0.5} | changes))


def to_rest():
    """Least cost to a disc, undiscounted."""
    return question(discount=0.0, target=disc)


@pytest.fixture(autouse=True)
def _usual_handler():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def press(clock):
    signal.raise_signal(signal.SIGINT)


def run_out(clock):
    clock.seconds = 0.0


WAYS = [pytest.param(press, INTERRUPTED, id="Ctrl-C"), pytest.param(run_out, TIME_LIMIT, id="time")]


@pytest.fixture
def upon(monkeypatch):
    """``upon(words, act)``: act once a run enters a phase with these words; a list of such phases."""

    def upon(words, act):
        enter, found = Clock.enter, []

        def entered(self, phase):
            enter(self, phase)
            if words in phase and not found:
                found.append(phase)
                act(self)

        monkeypatch.setattr(Clock, "enter", entered)
        return found

    return upon


@pytest.fixture
def calls(monkeypatch):
    """``calls(act, at)``: act at the end of that call of the compiled run; the shapes and evaluations of all calls.

    The first call on a grid compiles, and evaluates nothing; the others are chunks.
    """
    first, run = StationaryRun.first_chunk, stationary_run.run

    def calls(act, at):
        made, clocks = [], []

        def watched(task, state, until):
            made.append((task.grid.shape, int(until)))
            state = run(task, state, until)
            if len(made) == at + 1:
                act(clocks[-1])
            return state

        monkeypatch.setattr(
            StationaryRun, "first_chunk", lambda run, clock: (clocks.append(clock), first(run, clock))[1]
        )
        monkeypatch.setattr(stationary_run, "run", watched)
        return made

    return calls


NEVER = 10**9


# --- the clock ---


def test_a_note_in_place_of_an_exception_and_the_second_is_the_usual_one():
    mine = Clock()
    with noting_interrupts(mine):
        signal.raise_signal(signal.SIGINT)
        assert mine.over() is INTERRUPTED
        with pytest.raises(Stopped):
            mine.enter("another phase")
        assert mine.phase == "the checks"
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_runs_inside_runs_share_their_note_and_only_the_outermost_gives_the_handler_back():
    outer, inner, later = Clock(), Clock(), Clock()
    with noting_interrupts(outer):
        with noting_interrupts(inner):
            pass
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        with noting_interrupts(inner):
            signal.raise_signal(signal.SIGINT)
        with noting_interrupts(later):
            assert outer.interrupted
            assert inner.interrupted
            assert later.interrupted
    after = Clock()
    with noting_interrupts(after):
        assert not after.interrupted


class Pressed(list):
    """A list of clocks during whose changes Ctrl-C is pressed, as it may be between any two instructions."""

    def append(self, clock):
        super().append(clock)
        raise KeyboardInterrupt


def test_ctrl_c_at_the_begin_and_the_end_of_a_run_leaves_no_clock(monkeypatch):
    """A clock that stays interrupts all later runs, or leaves Ctrl-C to Python."""
    pressed = Pressed()
    monkeypatch.setattr(clock_module, "_running", pressed)
    with pytest.raises(KeyboardInterrupt), noting_interrupts(Clock()):
        pass
    assert pressed == []
    running = []
    monkeypatch.setattr(clock_module, "_running", running)
    give_back = signal.signal

    def press(number, handler):
        give_back(number, handler)
        if handler is signal.default_int_handler:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), noting_interrupts(Clock()):
        monkeypatch.setattr(signal, "signal", press)
    monkeypatch.undo()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    assert running == []


def test_a_handler_of_the_users_own_stays():
    class Mine(Exception):
        pass

    def handler(*_):
        raise Mine

    signal.signal(signal.SIGINT, handler)
    try:
        with noting_interrupts(Clock()), pytest.raises(Mine):
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def test_other_threads_leave_signals_alone():
    found = []

    def work():
        with noting_interrupts(Clock()):
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.default_int_handler]


def test_sigterm_where_it_was_made_to_do_what_ctrl_c_does():
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        mine = Clock()
        with noting_interrupts(mine):
            signal.raise_signal(signal.SIGTERM)
            assert mine.over() is INTERRUPTED
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with noting_interrupts(Clock()):
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)


def test_sigterm_that_comes_twice_at_once_ends_a_command_once():
    """A service manager sends it to all processes of a launch, and so does their launcher."""
    with interruptible():
        mine = Clock()
        with noting_interrupts(mine):
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)
            assert mine.over() is INTERRUPTED
    with interruptible():
        with pytest.raises(KeyboardInterrupt):  # outside of a run, as while pictures are drawn
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        with noting_interrupts(mine):
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)


# --- before the steps ---

PHASES = ["survey of the nodes", "preparation of 25 nodes", "jumps of the chain", "search for nodes"]


@pytest.mark.parametrize(("act", "status"), WAYS)
@pytest.mark.parametrize("phase", PHASES)
def test_in_a_phase_before_the_steps(upon, monkeypatch, phase, act, status):
    """Nothing runs after the phase in which it ended, and the guess comes back."""
    met, ran = upon(phase, act), []
    monkeypatch.setattr(stationary_run, "run", lambda *_: ran.append(1))
    guess = np.arange(25.0)
    solution = hjb.solve(to_rest(), GRID, guess=guess, throw=False, scheme=hjb.Upwind())
    assert (solution.status, solution.steps, ran) == (status, 0, [])
    assert met[0] in solution.message
    assert "guess=" in solution.message
    held = np.abs(np.linspace(-1, 1, 25)) <= 0.1
    np.testing.assert_array_equal(solution.value[~held], guess[~held])  # what is given there may be known by then
    assert solution.error in (None, np.inf)
    assert np.all(np.isnan(solution.policy))
    assert solution.policy.shape == (*GRID.shape, 1)
    assert str(solution).startswith(status.name)


def test_what_is_raised_brings_what_there_is(upon):
    upon("survey of the nodes", press)
    with pytest.raises(hjb.SolveError, match=r"INTERRUPTED: .*the survey of the nodes, 0 of \d+ actions") as caught:
        hjb.solve(question(), GRID, scheme=hjb.Upwind())
    np.testing.assert_array_equal(caught.value.solution.value, 0.0)


@pytest.mark.parametrize(("act", "status"), WAYS)
@pytest.mark.parametrize("phase", ["survey of the nodes", "the preparation"])
def test_before_the_steps_of_a_march(upon, phase, act, status):
    upon(phase, act)
    start = np.ones(GRID.shape)
    solution = hjb.march(question(discount=0.0), GRID, 0.5, start=start, throw=False, scheme=hjb.Upwind(split=True))
    assert solution.status is status
    np.testing.assert_array_equal(solution.times, [0.5])
    np.testing.assert_array_equal(solution.value[0], start)
    assert "start=" in solution.message
    assert phase in solution.message


def test_a_march_that_did_not_begin_knows_no_value(upon):
    upon("survey of the nodes", press)
    solution = hjb.march(question(discount=0.0), GRID, 0.5, throw=False, scheme=hjb.Upwind(split=True))
    assert np.all(np.isnan(solution.value))
    assert "did not leave t = 0.5" in solution.message


def test_a_survey_of_many_actions_is_cut_between_two_of_them(monkeypatch):
    monkeypatch.setattr(node_checks, "LOOK", 4 * GRID.size)
    phases, enter = [], Clock.enter

    def entered(self, phase):
        phases.append(phase)
        if len(phases) == 3:
            self.seconds = 0.0
        enter(self, phase)

    monkeypatch.setattr(Clock, "enter", entered)
    solution = hjb.solve(question(), GRID, throw=False, scheme=hjb.Upwind())
    assert solution.status is TIME_LIMIT
    assert phases == [f"the survey of the nodes, {first} of 9 actions" for first in (0, 4, 8)]
    assert "4 of 9 actions" in solution.message


def test_some_actions_at_a_time_refuse_what_all_at_once_refuse(monkeypatch):
    """The last of 21 actions is the bad one."""
    points = np.linspace(-1.0, 1.0, 21)[:, None]
    bad = hjb.Problem(drift, lambda x, u: 1 / (u[0] - 1), hjb.Finite(points), discount=1.0)
    monkeypatch.setattr(node_checks, "LOOK", 4 * GRID.size)
    with pytest.raises(ValueError, match=r"cost\(x, u\) is NaN or infinite at 25 of 25.* with u = \[1\]"):
        hjb.solve(bad, GRID, scheme=hjb.Upwind())


# --- during the steps ---


@pytest.mark.parametrize(("act", "status"), WAYS)
def test_on_a_coarser_grid_its_answer_comes_back_on_the_finest(calls, act, status):
    """And no program for a finer grid is compiled."""
    fine, coarse = hjb.Grid([-1.0], [1.0], (49,)), GRID
    made = calls(act, at=1)
    method = hjb.Nested(hjb.PolicyIteration(), coarsest=25)
    solution = hjb.solve(question(), fine, method=method, throw=False, scheme=hjb.Upwind())
    assert solution.status is status
    assert {shape for shape, _ in made} == {coarse.shape}
    assert "on 25 nodes" in solution.message
    once = hjb.solve(question(), coarse, max_steps=made[-1][1] - 1, throw=False, scheme=hjb.Upwind())
    np.testing.assert_allclose(solution.value[::2], once.value, rtol=1e-12)
    np.testing.assert_allclose(solution.value[1::2], (once.value[:-1] + once.value[1:]) / 2, rtol=1e-12)


@pytest.mark.parametrize(("act", "status"), WAYS)
def test_on_the_way_to_a_guess_nothing_follows(calls, act, status):
    """An undiscounted solve starts from those of three discounts: not the next one, and no look at the last value."""
    made = calls(act, at=1)
    solution = hjb.solve(to_rest(), GRID, throw=False, scheme=hjb.Upwind())
    assert solution.status is status
    assert len(made) == 2  # one compilation, one chunk
    assert "computing a guess" in solution.message
    assert np.all(np.isfinite(solution.value))
    assert np.all(np.isnan(solution.policy))


@pytest.mark.parametrize(("act", "status"), WAYS)
def test_during_the_compilation_of_the_steps(calls, act, status):
    """The look at the guess does not follow, nor does the Isaacs gap, which is a program of its own."""
    both = hjb.Box([-0.5], [0.5])
    game = hjb.Problem(push, effort, U, disturbances=both, discount=1.0, target=disc, exit_cost=3.0)
    made = calls(act, at=0)
    solution = hjb.solve(game, GRID, throw=False, scheme=hjb.Upwind())
    assert (solution.status, made) == (status, [((25,), 0)])
    assert solution.value[12] == 3.0  # what is given is put in
    assert solution.isaacs_gap is None
    assert np.all(np.isnan(solution.disturbance))
    assert "compiling" in solution.message


def test_a_step_that_would_come_too_late_is_not_begun(calls, monkeypatch):
    """By the pace of the look at the guess, which on many nodes is a chunk of its own."""
    monkeypatch.setattr(stationary_run, "MANY_NODES", 10)

    def slow(clock):
        clock.per_node, clock.seconds = 1.0, clock.elapsed() + 20.0  # 25 nodes take 25 seconds

    made = calls(None, at=NEVER)
    whole = hjb.solve(question(), GRID, scheme=hjb.Upwind())
    assert [until for _, until in made][:2] == [0, 1]
    count = Clock.count
    monkeypatch.setattr(Clock, "count", lambda clock, *rest: (count(clock, *rest), slow(clock)))
    made = calls(None, at=NEVER)
    solution = hjb.solve(question(), GRID, throw=False, scheme=hjb.Upwind())
    assert solution.status is TIME_LIMIT
    assert [until for _, until in made] == [0, 1]
    assert solution.steps == 0
    lower, upper = solution.bounds  # the look was taken
    assert np.all(lower <= whole.value)
    assert np.all(whole.value <= upper)


def test_ctrl_c_after_the_last_look_is_not_lost(calls):
    """The answer is whole, and the status says that somebody wanted an end."""
    made = calls(None, at=NEVER)
    whole = hjb.solve(question(), GRID, scheme=hjb.Upwind())
    calls(press, at=len(made) - 1)  # in the last chunk
    with pytest.raises(hjb.SolveError, match=r"INTERRUPTED: It was interrupted after it had finished") as caught:
        hjb.solve(question(), GRID, scheme=hjb.Upwind())
    np.testing.assert_array_equal(caught.value.solution.value, whole.value)
    assert caught.value.solution.error <= 1e-3


@pytest.mark.parametrize(("act", "status"), WAYS)
def test_before_the_second_order_steps_the_first_order_answer_stands(calls, act, status):
    made = calls(None, at=NEVER)
    upwind = hjb.solve(question(), GRID, scheme=hjb.Upwind())
    calls(act, at=len(made) - 1)
    solution = hjb.solve(question(), GRID, scheme=hjb.Limited(), throw=False)
    assert solution.status is status
    np.testing.assert_array_equal(solution.value, upwind.value)
    np.testing.assert_array_equal(solution.bounds, upwind.bounds)
    assert "Upwind" in solution.stats["scheme"]
    calls(act, at=len(made))  # while the second-order steps compile
    late = hjb.solve(question(), GRID, scheme=hjb.Limited(), throw=False)
    assert late.status is status
    np.testing.assert_array_equal(late.value, upwind.value)


@pytest.mark.parametrize(("act", "status"), WAYS)
def test_a_march_between_two_kept_times(monkeypatch, act, status):
    """The times that it came to keep their feedback; where it was cut nothing is compiled for one."""
    advance, first, seen, clocks = MarchRun.advance, MarchRun.first_chunk, [], []

    def watched(run, count):
        seen.append(float(run.until))
        if seen[-1] < 0.5:
            act(*clocks)
        return advance(run, count)

    monkeypatch.setattr(host_loop, "CHUNK_SECONDS", 0.0)
    monkeypatch.setattr(MarchRun, "first_chunk", lambda run, clock: (clocks.append(clock), first(run, clock))[1])
    monkeypatch.setattr(MarchRun, "advance", watched)
    times = [0.0, 0.5]
    solution = hjb.march(question(discount=0.0), GRID, 0.6, times=times, throw=False, scheme=hjb.Upwind(split=True))
    assert solution.status is status
    assert solution.times[-1] == 0.5
    assert 0 < solution.times[0] < 0.5
    assert np.all(np.isfinite(solution.policy[-1]))
    assert seen.count(seen[-1]) == 1  # no chunk after the one in which it was cut


def test_a_march_that_has_arrived_is_not_out_of_time(monkeypatch):
    between, advance = MarchRun.between, MarchRun.advance

    def late(run, status, clock):
        clock.seconds = 0.0 if run.steps else np.inf
        return between(run, status, clock)

    monkeypatch.setattr(MarchRun, "advance", lambda run, count: advance(run, 10**6))
    monkeypatch.setattr(MarchRun, "between", late)
    solution = hjb.march(question(discount=0.0), GRID, 0.6, scheme=hjb.Upwind(split=True))
    assert solution.status is hjb.Status.CONVERGED
    assert np.all(np.isfinite(solution.policy))


# --- batches ---


@pytree_dataclass()
class Pull:
    """ẋ = u − k x."""

    k: float

    def drift(self, x, u):
        return u - self.k * x


def lanes(count):
    """Discounts far apart take different numbers of steps of value iteration."""
    return [
        hjb.Problem(Pull(0.1 * k).drift, cost, U, discount=beta)
        for k, beta in zip(range(count), np.geomspace(5.0, 1e-3, count), strict=True)
    ]


@pytest.fixture
def rounds(monkeypatch):
    """``rounds(act, at)``: act at the end of that call of a batch's compiled run; the steps of all calls."""
    monkeypatch.setattr(batch, "_fills_with_lanes", lambda: True)  # one loop, as on an accelerator
    run = stationary_run._run_lanes

    def rounds(act, at):
        made, clocks, first = [], [], LanesRun.first_chunk

        def watched(tasks, states, until, over):
            made.append(np.asarray(until))
            states = run(tasks, states, until, over)
            if len(made) == at + 1:
                act(clocks[-1])
            return states

        def begun(run, clock):
            clocks.append(clock)
            return first(run, clock)

        monkeypatch.setattr(LanesRun, "first_chunk", begun)
        monkeypatch.setattr(stationary_run, "_run_lanes", watched)
        return made

    return rounds


@pytest.mark.parametrize(("act", "status"), WAYS)
def test_a_batch_keeps_its_finished_lanes(rounds, act, status):
    whole = hjb.solve_batch(
        lanes(4), GRID, method=hjb.ValueIteration(), max_steps=200, throw=False, scheme=hjb.Upwind()
    )
    assert whole[0].status is hjb.Status.CONVERGED
    at = 2 + whole[0].steps // stationary_run.CHUNK  # the first lane is done by then
    rounds(act, at)
    with pytest.raises(hjb.SolveError, match=rf"lane \d: {status.name}: .*step \d+ on lanes 0 to 3") as caught:
        hjb.solve_batch(lanes(4), GRID, method=hjb.ValueIteration(), max_steps=200, scheme=hjb.Upwind())
    solutions = caught.value.solutions
    assert solutions[0].status is hjb.Status.CONVERGED
    np.testing.assert_array_equal(solutions[0].value, whole[0].value)
    assert caught.value.solution is next(each for each in solutions if each.status is status)
    for found, alone in zip(solutions, lanes(4), strict=True):
        if found.status is status:
            assert 0 < found.steps < 200
            assert len(found.residuals) == found.steps + 1
            part = hjb.solve(
                alone, GRID, method=hjb.ValueIteration(), max_steps=found.steps, throw=False, scheme=hjb.Upwind()
            )
            np.testing.assert_allclose(found.value, part.value, rtol=1e-12)
            np.testing.assert_allclose(found.bounds, part.bounds, rtol=1e-9)


@pytest.mark.parametrize(("act", "status"), WAYS)
def test_lanes_of_a_batch_that_did_not_begin(upon, monkeypatch, act, status):
    """Two kinds of problems run one after the other: the first kind is finished, the other one is not begun."""
    first, later = lanes(4), [question(target=disc, exit_cost=1.0)] * 2
    upon("jumps of the chain", act)
    mixed = [first[0], later[0], *first[1:], later[1]]
    found = hjb.solve_batch(mixed, GRID, method=hjb.ValueIteration(), tol=1e3, throw=False, scheme=hjb.Upwind())
    assert [k for k, solution in enumerate(found) if solution.status is status] == [1, 5]
    assert all(found[k].status is hjb.Status.CONVERGED for k in (0, 2, 3, 4))
    assert "jumps of the chain" in found[1].message
    assert found[5].steps == 0
    np.testing.assert_array_equal(found[5].value, 0.0)


@pytest.mark.parametrize(("act", "status"), WAYS)
def test_lanes_side_by_side_end_with_their_last_steps(monkeypatch, act, status):
    """The third lane to look at its clock ends them all; the first one is done by then."""
    between, seen = stationary_run.StationaryRun.between, []

    def watched(run, code, clock):
        new = clock not in seen
        seen.append(clock)
        # once: a second Ctrl-C may come after the batch has ended, and then it ends the test run
        if new and len(set(map(id, seen))) == 3:
            act(clock)
        return between(run, code, clock)

    monkeypatch.setattr(stationary_run.StationaryRun, "longest", 4)
    options = {"method": hjb.ValueIteration(), "throw": False, "scheme": hjb.Upwind()}
    whole = hjb.solve_batch(lanes(6), GRID, max_steps=200, **options)
    monkeypatch.setattr(stationary_run.StationaryRun, "between", watched)
    found = hjb.solve_batch(lanes(6), GRID, max_steps=200, **options)
    assert found[0].status is hjb.Status.CONVERGED
    np.testing.assert_array_equal(found[0].value, whole[0].value)
    assert all(solution.status is status for solution in found[-2:])
    for solution, alone in zip(found, lanes(6), strict=True):
        if solution.status is status and solution.steps > 0:
            part = hjb.solve(alone, GRID, max_steps=solution.steps, **options)
            np.testing.assert_array_equal(solution.value, part.value)


@pytest.mark.slow
def test_ctrl_c_after_the_last_look_of_a_batch_is_not_lost(rounds, monkeypatch):
    monkeypatch.setattr(LanesRun, "longest", 1)  # as many calls in both runs, whatever the machine's pace
    made = rounds(press, NEVER)
    whole = hjb.solve_batch(lanes(4), GRID, method=hjb.ValueIteration(), tol=1e3, scheme=hjb.Upwind())
    rounds(press, len(made) - 1)
    with pytest.raises(hjb.SolveError, match=r"lane 3: INTERRUPTED: It was interrupted after") as caught:
        hjb.solve_batch(lanes(4), GRID, method=hjb.ValueIteration(), tol=1e3, scheme=hjb.Upwind())
    for found, alone in zip(caught.value.solutions, whole, strict=True):
        np.testing.assert_array_equal(found.value, alone.value)


@pytest.mark.parametrize("limit", [0, -1.0, np.nan, "soon"])
def test_a_time_limit_of_a_batch_that_is_none(limit):
    with pytest.raises((ValueError, TypeError), match="time_limit"):
        hjb.solve_batch(lanes(1), GRID, time_limit=limit, scheme=hjb.Upwind())


# --- searches and studies of many solves ---

PLANT = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-4.0], [4.0]))
WIDE = hjb.Box([-4.0], [4.0])


def attenuated(gamma):
    return hjb.attenuation(PLANT, gamma, WIDE)


def level_of(make):
    return hjb.hinf_level(make, hjb.Grid([-1.0], [1.0], (21,)), 0.5, 1.0, horizon=16.0)


@pytest.mark.slow
def test_an_interrupted_search_for_a_level_keeps_its_bracket_and_its_trials():
    """Ctrl-C in the midst of a γ, seen by its march and by the search around it."""
    tried = []

    def pressing(gamma):
        tried.append(gamma)
        if len(tried) == 4:
            signal.raise_signal(signal.SIGINT)
        return attenuated(gamma)

    whole = level_of(attenuated)
    with pytest.raises(
        hjb.SolveError, match=rf"hinf_level: at gamma = {0.5**0.75:g}|at gamma = {0.5**0.25:g}"
    ) as caught:
        level_of(pressing)
    level = caught.value.solution
    assert len(tried) == 4
    assert level.status is INTERRUPTED
    assert [t.reason for t in level.trials if t.gamma == tried[-1]] == ["interrupted"]
    known = {trial.gamma: trial.feasible for trial in whole.trials}
    assert {t.gamma: t.feasible for t in level.trials if t.gamma != tried[-1]} == {g: known[g] for g in tried[:-1]}
    assert level.bracket == (max(g for g in tried[:-1] if not known[g]), min(g for g in tried[:-1] if known[g]))
    assert level.solution.value.shape == (21,)
    assert "interrupted" in str(level)


@pytest.mark.slow
@pytest.mark.parametrize("last", ["_bisect", "comes_back"])
def test_ctrl_c_after_the_last_trial_is_not_lost(monkeypatch, last):
    usual = getattr(hinf, last)
    monkeypatch.setattr(hinf, last, lambda *a: (usual(*a), signal.raise_signal(signal.SIGINT))[0])
    with pytest.raises(hjb.SolveError, match="hinf_level: interrupted after the search had finished") as caught:
        level_of(attenuated)
    level = caught.value.solution
    assert level.status is INTERRUPTED
    assert level.gamma == pytest.approx(0.5**0.5, rel=0.02)


@pytest.fixture
def pressed(monkeypatch):
    """``pressed(module, number)``: Ctrl-C at the beginning of the solve of that number that a module asks for."""

    def pressed(module, number):
        made, solve = [], module.solve

        def counted(*arguments, **options):
            made.append(options)
            if len(made) == number:
                signal.raise_signal(signal.SIGINT)
            return solve(*arguments, **options)

        monkeypatch.setattr(module, "solve", counted)
        return made

    return pressed


@pytest.mark.parametrize(
    ("number", "rows", "seconds"), [(1, 1, [False]), (4, 2, [True, False]), (6, 3, [True] * 2 + [False])]
)
def test_an_interrupted_study_of_convergence_keeps_its_rows(pressed, number, rows, seconds):
    """Each grid is solved twice: one whose second solve was interrupted keeps the first."""
    made = pressed(convergence, number)
    grids = [hjb.Grid([-1.0], [1.0], (n,)) for n in (13, 25, 49)]
    with pytest.raises(
        hjb.SolveError, match=r"convergence_study: interrupted (on the grid \d+|after the last)"
    ) as caught:
        hjb.convergence_study(question(), grids, tol=1e-6)
    study = caught.value.solution
    assert len(made) == number
    assert [grid.shape for grid in study.grids] == [(13,), (25,), (49,)][:rows]
    converged = [status is hjb.Status.CONVERGED for status in study.statuses]
    assert converged == [True] * (rows - (number % 2)) + [False] * (number % 2)
    assert np.isfinite(study.seconds).tolist() == seconds
    assert study.extrapolated is None
    assert "interrupted" in str(study)


def test_an_interrupted_study_of_perturbations_keeps_its_rows(pressed):
    """The unperturbed problem, two noises and two levels: stopped in the first level."""
    made = pressed(perturbations, 4)
    plant = dataclasses.replace(PLANT, discount=1.0)
    with pytest.raises(hjb.SolveError, match="perturbation_study: interrupted after 3 of 4 perturbed") as caught:
        hjb.perturbation_study(plant, GRID, noises=[0.05, 0.1], gammas=[5.0, 10.0], disturbances=U, scheme=hjb.Upwind())
    study = caught.value.solution
    assert len(made) == 4
    assert study.nominal.status is hjb.Status.CONVERGED
    assert [s.status for s in study.noise.solutions] == [hjb.Status.CONVERGED] * 2
    assert [s.status for s in study.gain.solutions] == [INTERRUPTED]
    assert study.noise.errors.shape == (2,)
    assert not study.gain.fitted.any()
    assert "INTERRUPTED" in str(study)


# --- extremals ---

LQ = hjb.Problem(drift, lambda x, u: x @ x + u @ u, hjb.Box([-9.0], [9.0]))
DOUBLE = hjb.Problem(lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: 1.0, U)


@pytest.fixture
def slopes(monkeypatch):
    """``slopes(number)``: Ctrl-C before the Jacobian of that number, one or two a Newton step; how many were made."""
    inner = collocation._slopes

    def slopes(number):
        made = []

        def counted(*arguments):
            made.append(1)
            if len(made) == number:
                signal.raise_signal(signal.SIGINT)
            return inner(*arguments)

        monkeypatch.setattr(collocation, "_slopes", counted)
        return made

    return slopes


@pytest.mark.parametrize("number", [1, 3])
@pytest.mark.parametrize(
    "problem",
    [
        (LQ, [1.0], {}),
        (LQ, [1.0], {"horizon": 2.0, "terminal": [0.0]}),
        (DOUBLE, [1.0, 0.0], {"terminal": [0.0, 0.0]}),
    ],
    ids=["a rest", "an end", "jumps"],
)
def test_an_interrupted_extremal_is_the_last_iterate(slopes, problem, number):
    """Smooth, to given ends, and with smoothed jumps: no further collocation begins."""
    question, x0, options = problem
    made = slopes(number)
    with pytest.raises(hjb.SolveError, match=r"pontryagin: INTERRUPTED: this is the last iterate") as caught:
        hjb.pontryagin(question, x0, **options)
    extremal = caught.value.solution
    assert len(made) == number
    assert extremal.status is INTERRUPTED
    assert extremal.states.shape == extremal.costates.shape == (len(extremal.times), len(x0))
    assert np.all(np.diff(extremal.times) > 0)
    assert np.all(np.isfinite(extremal.states))
    assert extremal.controls.shape == (len(extremal.times) - 1, 1)
    assert np.all(np.isnan(extremal.controls))


def test_an_extremal_at_its_time_limit_is_the_last_iterate(monkeypatch):
    inner, made = collocation._slopes, []
    monkeypatch.setattr(Clock, "elapsed", lambda clock: 100.0 * bool(made))
    monkeypatch.setattr(collocation, "_slopes", lambda *arguments: (made.append(1), inner(*arguments))[1])
    with pytest.raises(hjb.SolveError, match="pontryagin: TIME_LIMIT: this is the last iterate") as caught:
        hjb.pontryagin(LQ, [1.0], time_limit=50.0)
    assert len(made) == 1
    assert caught.value.solution.status is TIME_LIMIT
    assert np.all(np.isfinite(caught.value.solution.costates))
    extremal = hjb.pontryagin(LQ, [1.0], time_limit=101.0)
    assert extremal.status is hjb.Status.CONVERGED
    with pytest.raises(ValueError, match=r"pontryagin: time_limit = 0; wanted a finite number > 0, in seconds"):
        hjb.pontryagin(LQ, [1.0], time_limit=0)


def test_a_last_iterate_is_a_guess_to_go_on_from(slopes):
    options = {"horizon": 2.0, "terminal": [0.0]}
    slopes(2)
    cut = hjb.pontryagin(LQ, [1.0], **options, throw=False)
    again = hjb.pontryagin(LQ, [1.0], **options, guess=cut)
    assert again.cost == pytest.approx(1 / np.tanh(2.0), rel=1e-6)


def test_an_extremal_interrupted_on_the_way_to_a_first_guess(monkeypatch):
    find = equilibria.find
    monkeypatch.setattr(equilibria, "find", lambda *a: (signal.raise_signal(signal.SIGINT), find(*a))[1])
    with pytest.raises(hjb.SolveError, match="pontryagin: INTERRUPTED before there was an initial guess") as caught:
        hjb.pontryagin(LQ, [1.0], throw=False)
    assert caught.value.solution is None


def test_ctrl_c_while_an_extremal_is_checked_is_not_lost(monkeypatch):
    made = continuation.assemble_extremal
    monkeypatch.setattr(continuation, "assemble_extremal", lambda *a: (signal.raise_signal(signal.SIGINT), made(*a))[1])
    extremal = hjb.pontryagin(LQ, [1.0], throw=False)
    assert extremal.status is INTERRUPTED
    assert extremal.cost == pytest.approx(1.0, rel=1e-6)
    assert np.all(np.isfinite(extremal.controls))


# --- simulations ---


def pressing(monkeypatch, number):
    """Ctrl-C at the end of that call of a simulation's compiled run; the number of calls."""
    made, inner = [], simulation._jit_part

    def counted(*arguments):
        answer = inner(*arguments)
        made.append(arguments[-1])
        if len(made) == number:
            signal.raise_signal(signal.SIGINT)
        return answer

    monkeypatch.setattr(simulation, "_jit_part", counted)
    return made


def test_an_interrupted_simulation_brings_the_path_so_far(monkeypatch):
    """Without what is paid at the end, which it has not come to; and no chunk follows."""
    ends = hjb.Problem(drift, cost, hjb.Box([-9.0], [9.0]), terminal_cost=lambda x: 100.0)
    whole = hjb.simulate(ends, lambda x: -x, [1.0], 2.0, steps=40)
    monkeypatch.setattr(simulation, "CHUNK_SECONDS", 0.0)  # one interval a chunk
    made = pressing(monkeypatch, 11)
    with pytest.raises(KeyboardInterrupt, match="interrupted at t = 0.5; cost") as caught:
        hjb.simulate(ends, lambda x: -x, [1.0], 2.0, steps=40)
    path = caught.value.path
    assert made == list(range(11))
    assert path.status.name == "INTERRUPTED"
    assert path.reached is None
    np.testing.assert_array_equal(path.times, whole.times[:11])
    np.testing.assert_array_equal(path.states, whole.states[:11])
    np.testing.assert_array_equal(path.controls, whole.controls[:10])
    assert path.cost == pytest.approx(0.5 + (1 - np.exp(-1)) / 2, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("target", [None, lambda x: x[0] - 0.3])
def test_how_long_a_chunk_of_a_simulation_is_changes_no_bit(monkeypatch, target):
    problem = hjb.Problem(drift, None, hjb.Box([-9.0], [9.0]), target=target, running_max=lambda x: x[0] ** 2)
    whole = hjb.simulate(problem, lambda x: -x, [1.0], 2.0, steps=40)
    monkeypatch.setattr(simulation, "CHUNK_SECONDS", 0.0)
    apart = hjb.simulate(problem, lambda x: -x, [1.0], 2.0, steps=40)
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(apart), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_ctrl_c_after_the_last_chunk_of_a_simulation_is_not_lost(monkeypatch):
    plain = hjb.Problem(drift, cost, hjb.Box([-9.0], [9.0]))
    made = pressing(monkeypatch, 10**6)
    hjb.simulate(plain, lambda x: -x, [1.0], 2.0, steps=4)
    monkeypatch.undo()
    pressing(monkeypatch, len(made))
    with pytest.raises(KeyboardInterrupt) as caught:
        hjb.simulate(plain, lambda x: -x, [1.0], 2.0, steps=4)
    assert caught.value.path.times[-1] == 2.0


def test_an_extremal_whose_guess_is_being_simulated(monkeypatch):
    solution = hjb.solve(to_rest(), GRID, scheme=hjb.Upwind())
    pressing(monkeypatch, 1)
    with pytest.raises(hjb.SolveError, match="pontryagin: INTERRUPTED before there was an initial guess"):
        hjb.pontryagin(to_rest(), [0.8], guess=solution)


# --- interrupts at the worst of moments ---


def keeping(monkeypatch, act, at):
    """Act at the end of that call of ``Slices.keep``."""
    keep, calls = march_run.Slices.keep, []

    def kept(self, *rest, **options):
        keep(self, *rest, **options)
        calls.append(1)
        if len(calls) == at:
            act()

    monkeypatch.setattr(march_run.Slices, "keep", kept)


def by_hand():
    raise KeyboardInterrupt  # what a handler of the user's own does


@pytest.mark.parametrize("act", [lambda: signal.raise_signal(signal.SIGINT), by_hand], ids=["noted", "raised"])
@pytest.mark.parametrize("at", [1, 2])
def test_a_march_cut_just_after_a_kept_time_keeps_it_once(monkeypatch, act, at):
    keeping(monkeypatch, act, at)
    times = [0.0, 0.3, 0.6]
    solution = hjb.march(question(discount=0.0), GRID, 0.6, times=times, throw=False)
    assert solution.status is INTERRUPTED
    np.testing.assert_array_equal(solution.times, times[-at:])
    whole = hjb.march(question(discount=0.0), GRID, 0.6, times=times)
    np.testing.assert_array_equal(solution.value, whole.value[-at:])
    assert np.isfinite(solution.value_at(0.6, [0.5]))


@pytest.mark.parametrize("where", ["cut", "device_get"])
def test_an_interrupt_while_a_slice_is_filled_leaves_no_half_of_it(monkeypatch, where):
    owner = march_run.edges if where == "cut" else march_run.jax
    function, calls = getattr(owner, where), []

    def interrupted(*rest, **options):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return function(*rest, **options)

    monkeypatch.setattr(owner, where, interrupted)
    solution = hjb.march(question(discount=0.0), GRID, 0.6, times=[0.0, 0.3, 0.6], throw=False)
    monkeypatch.undo()
    whole = hjb.march(question(discount=0.0), GRID, 0.6, times=[0.0, 0.3, 0.6])
    assert solution.times[-1] == 0.6
    assert np.all(np.diff(solution.times) > 0)
    np.testing.assert_array_equal(solution.value[-1], whole.value[-1])
    if solution.times.size > 1:
        assert solution.times[0] == 0.3  # where it was, with its value
        np.testing.assert_array_equal(solution.value[0], whole.value[1])


def test_times_that_are_one_number_in_single_precision():
    with pytest.raises(ValueError, match=r"march: two of the times .* are the same number in float32"):
        hjb.march(question(discount=0.0), GRID, 1.0, times=[0.0, 0.5, 0.5 + 1e-9], dtype="float32")


@pytest.mark.slow
def test_an_interrupt_while_lanes_are_taken_out_keeps_them_all(monkeypatch):
    problems = [question(discount=beta) for beta in (0.02, 3.0, 0.5, 20.0, 1.0)]
    options = {"method": hjb.PolicyIteration(hjb.Sweeps(1)), "tol": 1e-9, "throw": False}
    whole = hjb.solve_batch(problems, GRID, scheme=hjb.Upwind(), **options)
    monkeypatch.setattr(batch, "_fills_with_lanes", lambda: True)  # one loop, as on an accelerator
    take, calls = stationary_run._take, []

    def interrupted(*rest):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return take(*rest)

    monkeypatch.setattr(LanesRun, "longest", 1)
    monkeypatch.setattr(stationary_run, "_take", interrupted)
    found = hjb.solve_batch(problems, GRID, scheme=hjb.Upwind(), **options)
    assert {solution.status for solution in found} == {hjb.Status.CONVERGED, INTERRUPTED}
    for solution, known in zip(found, whole, strict=True):
        assert len(solution.residuals) == solution.steps + 1
        if solution.status is hjb.Status.CONVERGED:
            np.testing.assert_array_equal(solution.value, known.value)
