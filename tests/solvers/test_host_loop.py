"""How a solve ends when it does not converge, and what the host does around it."""

import _thread
import os
import select
import signal
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.solution.clock import Clock
from hjbjax.solvers import host_loop, stationary_run
from hjbjax.solvers.setup import prepare_on_host

GRID = hjb.Grid([-1.0, -2.0], [1.0, 2.0], (17, 18))
SLOW = hjb.ValueIteration()


def drift(x, u):
    return jnp.stack([x[1], u[0]])


def cost(x, u):
    return x @ x + 0.1 * u @ u


@pytree_dataclass()
class Level:
    """A constant cost, large if wanted."""

    height: float

    def cost(self, x, u):
        return self.height * (1 + x[0] ** 2)


def question(discount=1.0, **changes):
    return hjb.Problem(drift, **({"cost": cost, "controls": hjb.Box([-1.0], [1.0]), "discount": discount} | changes))


def endless(tol=1e-13):
    """A solve that would take minutes: value iteration at a discount of 1e-4 an hour."""
    return {"problem": question(1e-5), "grid": GRID, "method": SLOW, "tol": tol}


def test_converged_history_has_one_residual_a_step_and_one_for_the_guess():
    solution = hjb.solve(question(0.1), GRID, method=SLOW, tol=1e-6, scheme=hjb.Upwind())
    assert solution.status is hjb.Status.CONVERGED
    assert solution.residuals.shape == (solution.steps + 1,)
    assert solution.steps > 300  # more than one chunk can hold
    assert np.all(np.isfinite(solution.residuals))
    assert solution.residuals[-1] < 1e-5 < solution.residuals[0]
    assert np.all(np.diff(solution.residuals) <= 1e-12)  # value iteration is a contraction in the maximum norm
    assert solution.residual == solution.residuals[-1]


@pytest.fixture
def asked(monkeypatch):
    """The number of evaluations up to which the driver runs, call by call."""
    counts, run = [], stationary_run.run

    def watched(task, state, until):
        counts.append(int(until))
        return run(task, state, until)

    monkeypatch.setattr(stationary_run, "run", watched)
    monkeypatch.setattr(stationary_run, "_run_kept", watched)  # where Python is called on the way
    return counts


def test_a_first_chunk_is_as_long_as_coarser_grids_tell(asked):
    """Half a chunk's time by what a step took at a node, and never more than the history of one chunk can hold."""
    on = Discretisation(question(1e-3), GRID, hjb.Upwind(), np.float32)
    task, *_ = prepare_on_host(on, method=SLOW, tol=1e-13)
    histories = []
    paces = [(1e-9, stationary_run.HISTORY - 1), (host_loop.CHUNK_SECONDS / (20 * GRID.size), 10), (1.0, 1)]
    for per_node, first in paces:
        clock = host_loop.Clock(300, np.inf, False)
        clock.per_node = per_node
        asked.clear()
        state, code, residuals = stationary_run.iterate(task, jnp.zeros(GRID.shape), clock)
        assert asked[:2] == [0, 1 + first]  # one call that compiles, and the first chunk
        assert (code, state.progress.steps) == (hjb.Status.MAX_STEPS, 300)
        histories.append(residuals)
    assert histories[0].shape == (301,)
    assert np.all(np.diff(histories[0]) < 0)  # value iteration is a contraction
    assert all(np.array_equal(history, histories[0]) for history in histories)


@pytest.mark.parametrize(
    ("method", "first"),
    [(method, host_loop.FIRST_NODES // GRID.size) for method in (SLOW, hjb.PolicyIteration(hjb.Sweeps()))]
    + [(hjb.PolicyIteration(evaluation), 1) for evaluation in (hjb.Krylov(), hjb.Direct())],
)
def test_where_nothing_is_known_a_first_chunk_is_short(asked, method, first):
    """Of one step where a step may take many passes over the nodes."""
    hjb.solve(question(), GRID, method=method, scheme=hjb.Upwind())
    assert asked[1] == 1 + first


@pytest.mark.parametrize("steps", [1, 7])
def test_max_steps(steps):
    with pytest.raises(hjb.SolveError, match=r"MAX_STEPS.*max_steps.*guess=") as caught:
        hjb.solve(**endless(), max_steps=steps)
    solution = caught.value.solution
    assert (solution.status, solution.steps) == (hjb.Status.MAX_STEPS, steps)
    assert solution.residuals.shape == (steps + 1,)
    assert np.all(np.isfinite(solution.value))
    quiet = hjb.solve(**endless(), max_steps=steps, throw=False)
    np.testing.assert_array_equal(quiet.value, solution.value)


def test_bounds_hold_before_convergence():
    truth = hjb.solve(question(), GRID, method=hjb.PolicyIteration(hjb.Direct()), tol=1e-10, scheme=hjb.Upwind()).value
    solution = hjb.solve(question(), GRID, method=SLOW, max_steps=5, throw=False, scheme=hjb.Upwind())
    lower, upper = solution.bounds
    assert np.all(lower <= truth)
    assert np.all(truth <= upper)
    assert solution.error > 1e-3


def test_chunks_change_no_bit():
    together = hjb.solve(question(), GRID, method=SLOW, tol=1e-4, scheme=hjb.Upwind())
    half = hjb.solve(
        question(), GRID, method=SLOW, tol=1e-4, max_steps=together.steps // 2, throw=False, scheme=hjb.Upwind()
    )
    rest = hjb.solve(question(), GRID, method=SLOW, tol=1e-4, guess=half.value, scheme=hjb.Upwind())
    assert half.steps + rest.steps == together.steps
    np.testing.assert_array_equal(rest.value, together.value)


def test_a_solution_as_guess_takes_no_more_than_one_step():
    solution = hjb.solve(question(), GRID, tol=1e-6, scheme=hjb.Upwind())
    again = hjb.solve(question(), GRID, tol=1e-6, guess=solution.value, scheme=hjb.Upwind())
    assert again.steps <= 1 < solution.steps
    np.testing.assert_allclose(again.value, solution.value, rtol=0, atol=2e-6)


def test_the_guess_is_left_alone():
    guess = np.ones(GRID.shape)
    hjb.solve(question(), GRID, guess=guess, scheme=hjb.Upwind())
    np.testing.assert_array_equal(guess, 1.0)


def test_time_limit():
    hjb.solve(**endless(), max_steps=1, throw=False)  # compiles
    began = time.perf_counter()
    with pytest.raises(hjb.SolveError, match=r"TIME_LIMIT.*time_limit") as caught:
        hjb.solve(**endless(), time_limit=1.0)
    solution = caught.value.solution
    assert 0.9 <= time.perf_counter() - began <= 3
    assert solution.status is hjb.Status.TIME_LIMIT
    assert solution.steps > 1
    assert solution.residuals.shape == (solution.steps + 1,)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_tolerance_below_rounding_stalls_and_says_what_is_attainable(dtype):
    tol = 1e-10 if dtype == "float32" else 1e-17
    with pytest.raises(hjb.SolveError, match=r"(?s)STALLED.*within reach") as caught:
        hjb.solve(question(), GRID, tol=tol, dtype=dtype, scheme=hjb.Upwind())
    solution = caught.value.solution
    assert solution.status is hjb.Status.STALLED
    attainable = float(str(caught.value).split("a tolerance of ")[1].split()[0])
    assert hjb.solve(question(), GRID, tol=attainable, dtype=dtype, scheme=hjb.Upwind()).status is hjb.Status.CONVERGED
    assert attainable < (1e-3 if dtype == "float32" else 1e-10)


def test_overflow_stops_with_the_last_finite_value():
    overflowing = question(1e-4, cost=Level(1e307).cost)  # V = L/β = 1e311
    with pytest.raises(hjb.SolveError, match=r"NONFINITE") as caught:
        hjb.solve(overflowing, GRID, method=hjb.PolicyIteration(hjb.Sweeps()), scheme=hjb.Upwind())
    solution = caught.value.solution
    assert solution.status is hjb.Status.NONFINITE
    assert np.all(np.isfinite(solution.value))
    assert solution.residuals.shape == (solution.steps + 1,)
    assert not np.isfinite(solution.residuals[-1])


@pytree_dataclass()
class Burst:
    """A cost that is NaN for one control."""

    center: float

    def cost(self, x, u):
        return x @ x + jnp.where(jnp.abs(u[0] - self.center) < 1e-3, jnp.nan, u[0] ** 2)


def test_nan_during_the_steps_is_not_convergence():
    points = np.linspace(-1.0, 1.0, 41)  # more than the checks before a solve try: they pass over the fourth
    hidden = question(cost=Burst(points[3]).cost, controls=hjb.Finite(points[:, None]))
    with pytest.raises(hjb.SolveError, match="NONFINITE") as caught:
        hjb.solve(hidden, GRID, scheme=hjb.Upwind())
    assert np.all(np.isfinite(caught.value.solution.value))


@pytest.fixture
def pressed(monkeypatch):
    """Ctrl-C from another thread a while after the first chunk of a solve began; when it was pressed.

    A process that a shell started in the background ignores the signal; here it is in the foreground.
    """
    times, run = [], stationary_run.run
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def press():
        times.append(time.perf_counter())
        _thread.interrupt_main()

    timers = []

    def watched(task, state, until):
        if until > 0 and not timers:
            timers.append(threading.Timer(0.3, press))
            timers[0].start()
        return run(task, state, until)

    monkeypatch.setattr(stationary_run, "run", watched)
    yield times
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_keeps_the_partial_solution(pressed):
    solution = hjb.solve(**endless(), throw=False)
    assert time.perf_counter() - pressed[0] < host_loop.CHUNK_SECONDS + 0.3
    assert solution.status is hjb.Status.INTERRUPTED
    assert solution.steps > 0
    assert np.all(np.isfinite(solution.value))
    assert solution.residuals.shape == (solution.steps + 1,)


def test_ctrl_c_that_loses_a_step_is_no_other_error(monkeypatch):
    """A second one, between a program that has taken over the memory of the state, and the new state."""

    def advance(run, count):
        jax.block_until_ready(run._run(run.task, run.state, 1))
        raise KeyboardInterrupt

    monkeypatch.setattr(stationary_run.StationaryRun, "advance", advance)
    with pytest.raises(KeyboardInterrupt):
        hjb.solve(**endless())


@pytest.mark.usefixtures("pressed")
def test_ctrl_c_says_how_to_go_on():
    with pytest.raises(hjb.SolveError, match=r"INTERRUPTED.*guess=") as caught:
        hjb.solve(**endless())
    assert np.all(np.isfinite(caught.value.solution.value))


@pytest.mark.slow
def test_silent_where_there_is_no_terminal(capfd):
    hjb.solve(**endless(), time_limit=1.5, throw=False)
    out, err = capfd.readouterr()
    assert (out, err) == ("", "")


@pytest.mark.slow
def test_progress_when_asked_for_and_when_not(capfd):
    hjb.solve(**endless(), time_limit=2.0, throw=False, progress=True)
    said = capfd.readouterr().err
    phases = ("the checks", "the survey of the nodes", "the preparation of", "compiling for", "error")
    assert sorted(phases, key=said.index) == list(phases)
    assert said.rstrip(" ").endswith("\r")  # all of it is wiped out at the end
    hjb.solve(**endless(), time_limit=1.5, throw=False, progress=False)
    assert capfd.readouterr().err == ""


def test_the_progress_line_suggests_to_keep_compiled_programs(capfd, tmp_path):
    """Only where no folder is set."""
    said = []
    for folder in (None, str(tmp_path)):
        jax.config.update("jax_compilation_cache_dir", folder)
        hjb.solve(question(), GRID, tol=1e-2, scheme=hjb.Upwind(), progress=True)
        said.append(capfd.readouterr().err)
    jax.config.update("jax_compilation_cache_dir", None)
    assert ["compiling for" in each for each in said] == [True, True]
    assert ["hjb.keep_compiled()" in each for each in said] == [True, False]


def test_dtype_and_host_arrays():
    for dtype, kind in [(None, np.float64), ("float64", np.float64), ("float32", np.float32), (np.float32, np.float32)]:
        solution = hjb.solve(question(), GRID, tol=1e-2, dtype=dtype, scheme=hjb.Upwind())
        for array in (solution.value, solution.policy, *solution.bounds):
            assert type(array) is np.ndarray
            assert array.dtype == kind
        assert solution.stats["dtype"] == np.dtype(kind).name
    assert not jax.config.jax_enable_x64
    assert jnp.ones(2).dtype == jnp.float32


def test_statistics_of_a_solve():
    stats = hjb.solve(question(), GRID, tol=1e-4, scheme=hjb.Upwind()).stats
    assert stats["tol"] == 1e-4
    assert stats["seconds"] >= 0
    assert stats["compile_seconds"] >= 0
    assert stats["bytes"] > 8 * GRID.size
    assert "PolicyIteration" in stats["method"]
    assert "Upwind" in stats["scheme"]
    assert "discount" in stats["certificate"]
    assert stats["versions"]["jax"] == jax.__version__


def test_two_threads_in_different_dtypes_get_their_own():
    found, gate = {}, threading.Barrier(2)

    def work(dtype):
        gate.wait()
        for repeat in range(3):
            found[dtype, repeat] = hjb.solve(
                question(), GRID, tol=1e-2, dtype=dtype, method=SLOW, scheme=hjb.Upwind()
            ).value

    threads = [threading.Thread(target=work, args=(dtype,)) for dtype in ("float32", "float64")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for dtype in ("float32", "float64"):
        alone = hjb.solve(question(), GRID, tol=1e-2, dtype=dtype, method=SLOW, scheme=hjb.Upwind()).value
        for repeat in range(3):
            assert found[dtype, repeat].dtype == dtype
            np.testing.assert_array_equal(found[dtype, repeat], alone)


def test_what_stops_before_the_first_look_keeps_what_is_given():
    """A guess that is no number of the problem's: nothing but the exit cost is known."""
    problem = hjb.Problem(
        lambda x, u: u,
        lambda x, u: 1 + jnp.sqrt(jnp.where(x[0] > 0.5, x[0] - 0.75, 1.0)) * 0,
        hjb.Box([-1.0], [1.0]),
        discount=1.0,
        target=lambda x: 1 - jnp.abs(x[0]),
        exit_cost=3.0,
    )
    on = Discretisation(problem, hjb.Grid([-1.0], [1.0], (21,)), hjb.Upwind(), np.float32)
    task, _, _ = prepare_on_host(on, method=hjb.ValueIteration(), tol=1e-3)
    state, code, _ = stationary_run.iterate(task, jnp.full(21, 7.0), host_loop.Clock(10, np.inf, False))
    assert code is hjb.Status.NONFINITE
    assert np.all(np.isfinite(state.value))
    assert (state.value[0], state.value[10], state.value[-1]) == (3.0, 7.0, 3.0)


def test_a_terminal_that_tells_no_width_is_told_the_phases(monkeypatch):
    """As of `script`, and of some editors: tqdm by itself writes nothing there."""
    pty = pytest.importorskip("pty")
    reader, writer = pty.openpty()  # 0 columns
    with open(writer, "w", buffering=1) as terminal:
        monkeypatch.setattr("sys.stderr", terminal)
        clock = Clock()
        with host_loop.announce(clock):
            clock.phase = "compiling for 81 nodes"
        seen = ""
        # a terminal passes on what is written when it comes to it, in parts
        while "compiling" not in seen and select.select([reader], [], [], 5.0)[0]:
            seen += os.read(reader, 10_000).decode()
    os.close(reader)
    assert "the checks" in seen
    assert "compiling for 81 nodes" in seen


@pytest.mark.parametrize("option", ["xla_cpu_prefer_vector_width", "xla_no_such_option"])
def test_a_loop_is_compiled_with_and_without_the_option_for_wide_vectors(monkeypatch, option):
    """A version of XLA that no longer knows the option compiles the same loop without it."""
    monkeypatch.setattr(host_loop, "WIDTH", {option: 512})
    host_loop._known_width.cache_clear()
    known = option != "xla_no_such_option"
    loop = host_loop.WideJit(
        lambda x, count: jax.lax.fori_loop(0, count, lambda _, y: 2 * y, x), static_argnames="count"
    )
    assert host_loop._known_width() == ({option: 512} if known else {})
    assert float(loop(1.5, count=3)) == 12
    assert "stablehlo.while" in loop.lower(1.5, count=3).as_text()
    host_loop._known_width.cache_clear()
