"""What breaks a run from outside leaves with what there was before it: callbacks that raise, memory that runs out."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.solution.status import Status
from hjbjax.solvers import march_run, stationary_run
from hjbjax.solvers.march_run import MarchRun
from hjbjax.solvers.stationary_run import StationaryRun
from hjbjax.tracing import checks

U = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([-1.0], [1.0], (9,))


def cost(x, u):
    return x @ x + u @ u


class Trouble:
    """A drift through Python that raises from a moment on."""

    def __init__(self):
        self.armed = False

    def on_host(self, x, u):
        if self.armed:
            raise ValueError("my own trouble")
        return np.asarray(u) - np.asarray(x)

    def drift(self, x, u):
        shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
        return jax.pure_callback(self.on_host, shape, x, u, vmap_method="expand_dims")


@pytest.fixture
def trouble():
    made = Trouble()
    made.problem = hjb.Problem(made.drift, cost, U, discount=1.0)
    return made


def broken(caught, words="my own trouble"):
    error = caught.value
    assert words in str(error)
    assert any("It stopped during" in note for note in error.__notes__)
    assert error.solution.status is Status.INTERRUPTED
    return error.solution


def test_what_calls_python_is_known(trouble):
    assert checks.problem_calls_back(trouble.problem, 1)
    assert not checks.problem_calls_back(hjb.Problem(lambda x, u: u, cost, U), 1)
    within = hjb.Problem(lambda x, u: u, lambda x, u: jax.jit(lambda x: trouble.drift(x, u))(x)[0], U)
    assert checks.problem_calls_back(within, 1)


@pytest.mark.filterwarnings("ignore:the primitive 'pure_callback'")
def test_a_callback_that_raises_in_a_solve(trouble, monkeypatch):
    """The value of the last chunk before it, on the way and at the very start."""
    seen = []
    first, between = StationaryRun.first_chunk, StationaryRun.between
    monkeypatch.setattr(StationaryRun, "first_chunk", lambda *a: first(*a) and 1)

    def arm(run, status, clock):
        trouble.armed = run.steps >= 2
        seen.append(run.steps)
        return between(run, status, clock)

    monkeypatch.setattr(StationaryRun, "between", arm)
    # float32: JAX runs callbacks in a thread of its own, which knows nothing of float64 inside a ``with``
    options = {"method": hjb.ValueIteration(), "tol": 1e-5, "dtype": "float32"}
    with pytest.raises(Exception, match="my own trouble") as caught:
        hjb.solve(trouble.problem, GRID, **options)
    kept = broken(caught).value
    trouble.armed = False
    monkeypatch.setattr(StationaryRun, "between", between)
    steps = max(done for done in seen)
    known = hjb.solve(trouble.problem, GRID, max_steps=steps, throw=False, **options)
    np.testing.assert_array_equal(kept, known.value)
    trouble.armed = True
    guess = np.arange(9.0)
    with pytest.raises(Exception, match="my own trouble") as caught:
        hjb.solve(trouble.problem, GRID, guess=guess, **options)
    assert broken(caught).grid is GRID


@pytest.mark.filterwarnings("ignore:the primitive 'pure_callback'")
def test_a_callback_that_raises_in_a_march(trouble, monkeypatch):
    advance = MarchRun.advance

    def arm(run, count):
        trouble.armed = run.steps > 3
        return advance(run, 2)

    monkeypatch.setattr(MarchRun, "advance", arm)
    with pytest.raises(Exception, match="my own trouble") as caught:
        hjb.march(trouble.problem, GRID, 1.0, times=[0.0, 0.5], dtype="float32", scheme=hjb.Upwind(split=True))
    solution = broken(caught)
    assert 0 < solution.times[0] < 1
    assert solution.steps > 3
    assert np.all(np.isfinite(solution.value))


def out_of_memory(*_):
    raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 648361672 bytes.")


def no_room_for_a_result(*_):
    raise jax.errors.JaxRuntimeError("INTERNAL: Error dispatching computation: Out of memory allocating 1080 bytes.")


def plain(discount=1.0):
    return hjb.Problem(lambda x, u: u, cost, U, discount=discount)


@pytest.mark.parametrize(
    "error", [out_of_memory, no_room_for_a_result, lambda *_: np.empty(2**55)], ids=["JAX", "dispatch", "NumPy"]
)
def test_memory_that_runs_out(monkeypatch, error):
    monkeypatch.setattr(stationary_run, "run", error)
    guess = np.arange(9.0)
    with pytest.raises(MemoryError, match=r"memory ran out: .*") as caught:
        hjb.solve(plain(), GRID, guess=guess, scheme=hjb.Upwind())
    message = str(caught.value)
    for word in ("estimated at", "GB are free now", "float32", "hjb.pontryagin", "compiling for 9 nodes"):
        assert word in message
    assert len(message.splitlines()) <= 6
    np.testing.assert_array_equal(caught.value.solution.value, guess)
    assert caught.value.solution.message
    monkeypatch.setattr(march_run, "_run", error)
    with pytest.raises(MemoryError, match="memory ran out") as caught:
        hjb.march(plain(), GRID, 1.0, start=guess, scheme=hjb.Upwind(split=True))
    np.testing.assert_array_equal(caught.value.solution.value[-1], guess)


def test_memory_that_runs_out_on_a_coarser_grid(monkeypatch):
    run, calls = stationary_run.run, []

    def later(task, state, until):
        calls.append(task.grid.shape)
        return out_of_memory() if len(set(calls)) == 2 else run(task, state, until)

    monkeypatch.setattr(stationary_run, "run", later)
    with pytest.raises(MemoryError) as caught:
        hjb.solve(plain(), hjb.Grid([-1.0], [1.0], (33,)), method=hjb.Nested(coarsest=5), scheme=hjb.Upwind())
    value = caught.value.solution.value
    assert value.shape == (33,)
    assert np.any(value != 0)  # what the coarsest grid found


@pytest.mark.parametrize(("one_loop", "program"), [(False, "run"), (True, "_run_lanes")])
def test_memory_that_runs_out_in_a_batch(monkeypatch, one_loop, program):
    from hjbjax.solvers import batch

    monkeypatch.setattr(batch, "_fills_with_lanes", lambda: one_loop)
    monkeypatch.setattr(stationary_run, program, out_of_memory)
    with pytest.raises(MemoryError, match="memory ran out"):
        hjb.solve_batch([plain(), plain(2.0)], GRID, scheme=hjb.Upwind())


def test_refusals_are_no_faults():
    with pytest.raises(ValueError, match="drift") as caught:
        hjb.solve(hjb.Problem(lambda x, u: jnp.zeros(3), cost, U, discount=1.0), GRID, scheme=hjb.Upwind())
    assert not hasattr(caught.value, "solution")


@pytest.mark.slow
def test_memory_that_truly_runs_out():
    program = """
import resource
import hjbjax as hjb, jax
problem = hjb.Problem(lambda x, u: u[0] - x, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
hjb.solve(problem, hjb.Grid([-1.0] * 2, [1.0] * 2, (41, 41)))
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 10**9,) * 2)
try:
    hjb.solve(problem, hjb.Grid([-1.0] * 2, [1.0] * 2, (6000, 6000)), max_memory=10**11, method=hjb.PolicyIteration())
except MemoryError as error:
    print(error, error.solution.value.shape)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)
    assert "memory ran out" in done.stdout, done.stderr
    assert "(6000, 6000)" in done.stdout
