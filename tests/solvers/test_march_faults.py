"""What march refuses, how it ends early, and what it keeps: times, chunks, files, transformations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.problem.sets import Box
from hjbjax.solvers import host_loop
from hjbjax.solvers.march_run import MarchRun

GRID = hjb.Grid([-2.0], [2.0], (41,))


def plane(x, u):
    return u


def quadratic(x, u):
    return x @ x + u @ u


def weighted(weight, x, u):
    return weight * (x @ x) + u @ u


LQ = hjb.Problem(plane, quadratic, Box([-3.0], [3.0]))


@pytest.mark.parametrize(
    ("changes", "error", "reason"),
    [
        ({"horizon": 0.0}, ValueError, r"horizon = 0.0; wanted a finite number > 0"),
        ({"horizon": np.nan}, ValueError, r"horizon = nan"),
        ({"horizon": True}, ValueError, r"horizon = True"),
        ({"times": [0.5, 0.25]}, ValueError, r"not increasing: times\[0\] = 0.5, times\[1\] = 0.25"),
        ({"times": [0.0, 2.0]}, ValueError, r"run from 0 to 2; wanted them in \[0, 1\]"),
        ({"times": []}, ValueError, r"times = \[\]; wanted numbers"),
        ({"times": ["a"]}, ValueError, r"wanted numbers in \[0, horizon\]"),
        ({"step": -0.1}, ValueError, r"step = -0.1"),
        ({"step": 0.5}, ValueError, r"step = 0.5 is above the stability limit .* = 0.0333333 of explicit"),
        ({"scheme": "weno"}, TypeError, r"scheme is 'weno'; wanted hjb.Upwind\(\)"),
        ({"method": "implicit"}, TypeError, r"method is 'implicit'"),
        ({"method": hjb.Implicit(), "scheme": hjb.Weno5()}, ValueError, r"got Weno5\(.*\), wanted Upwind"),
        ({"inner": 2.0}, ValueError, r"inner = 2.0; wanted the fraction"),
        ({"inner": 0.5}, ValueError, r"requires disturbances in a Box; got None"),
        ({"time_limit": 0}, ValueError, r"time_limit = 0"),
        ({"dtype": "float16"}, ValueError, r"dtype: got 'float16'"),
        ({"max_memory": 100}, MemoryError, r"41 = 41 nodes need about"),
        ({"grid": hjb.Grid([-2.0], [2.0], (6,)), "scheme": hjb.Weno5()}, ValueError, r"has 6 points; Weno5 needs at l"),
        (
            {"grid": hjb.Grid([-2.0], [2.0], (41,), stretch=(hjb.Sinh(2.0),)), "scheme": hjb.Eno2()},
            ValueError,
            r"Eno2\(\) requires equal spacings",
        ),
    ],
)
def test_bad_input_is_refused(changes, error, reason):
    arguments = {"problem": LQ, "grid": GRID, "horizon": 1.0} | changes
    with pytest.raises(error, match=reason) as caught:
        hjb.march(**arguments)
    assert len(str(caught.value).splitlines()) <= 6


def test_stages_and_fractions_that_are_none():
    with pytest.raises(ValueError, match=r"stages = 5, wanted 1, 2, 3, 4, a Tableau or None"):
        hjb.Explicit(5)
    with pytest.raises(ValueError, match=r"Explicit: fraction = 1.5; wanted a number > 0 and at most 1"):
        hjb.Explicit(fraction=1.5)


# --- ends ---


def lost_half_way(t, x, u):
    """NaN before t = ½; but not at t = 0, where the problem is looked at before it starts."""
    return jnp.where((t > 0.5) | (t == 0), 1.0, jnp.nan) * (x @ x)


def test_numbers_that_are_not_finite_stop_the_march_with_the_time():
    problem = hjb.Problem(lambda t, x, u: u, lost_half_way, Box([-1.0], [1.0]), time_dependent=True)
    with pytest.raises(
        hjb.SolveError, match=r"NONFINITE: The march stopped at t = 0.[45]\d* .*NaN or infinity"
    ) as caught:
        hjb.march(problem, GRID, 1.0, times=[0.0, 0.75], scheme=hjb.Upwind(split=True))
    solution = caught.value.solution
    assert solution.status is hjb.Status.NONFINITE
    assert np.all(np.isfinite(solution.value))
    assert solution.times[1] == 0.75
    assert solution.times[0] == pytest.approx(0.5, abs=0.02)


def test_a_time_limit_keeps_what_there_is(monkeypatch):
    ticks = iter(np.arange(1000.0))
    monkeypatch.setattr(host_loop.Clock, "elapsed", lambda _: next(ticks))
    solution = hjb.march(LQ, GRID, 1.0, time_limit=2.0, throw=False, scheme=hjb.Upwind(split=True))
    assert solution.status is hjb.Status.TIME_LIMIT
    assert 0 < solution.times[0] <= 1
    assert "stopped at t = " in solution.message
    assert "start=" in solution.message


def test_an_interrupt_keeps_what_there_is(monkeypatch):
    between = MarchRun.between

    def interrupted(run, status, clock):
        clock.interrupted = run.steps > 5
        return between(run, status, clock)

    monkeypatch.setattr(host_loop, "CHUNK_SECONDS", 0.0)  # one step a chunk
    monkeypatch.setattr(MarchRun, "between", interrupted)
    solution = hjb.march(LQ, GRID, 1.0, throw=False, scheme=hjb.Upwind(split=True))
    assert solution.status is hjb.Status.INTERRUPTED
    assert solution.value.shape == (1, 41)
    monkeypatch.undo()  # else the other march is interrupted, too, in its last chunk
    whole = hjb.march(LQ, GRID, 1.0, times=[solution.times[0]], scheme=hjb.Upwind(split=True))
    np.testing.assert_allclose(solution.value, whole.value, rtol=0, atol=1e-3)


def test_how_long_a_chunk_is_changes_no_bit(monkeypatch):
    once = hjb.march(LQ, GRID, 1.0, times=[0.0, 0.4], scheme=hjb.Upwind(split=True))
    monkeypatch.setattr(host_loop, "CHUNK_SECONDS", 0.0)
    again = hjb.march(LQ, GRID, 1.0, times=[0.0, 0.4], scheme=hjb.Upwind(split=True))
    np.testing.assert_array_equal(once.value, again.value)
    assert once.steps == again.steps


# --- what is kept ---


@pytest.mark.slow
def test_times_and_what_they_hold(tmp_path):
    problem = dataclasses.replace(LQ, terminal_cost=lambda x: jnp.cos(x[0]))
    solution = hjb.march(problem, GRID, 1.0, times=[0.0, 0.3, 1.0], scheme=hjb.Eno2())
    assert solution.value.shape == (3, 41)
    assert solution.policy.shape == (3, 41, 1)
    np.testing.assert_allclose(solution.value[2], np.cos(GRID.axis(0)), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(solution.times, [0.0, 0.3, 1.0])
    solution.save(tmp_path / "march.npz")
    again = hjb.load(tmp_path / "march.npz")
    np.testing.assert_array_equal(again.value, solution.value)
    np.testing.assert_array_equal(again.box_error, solution.box_error)
    assert solution.box_error.shape == (3, 41)
    assert again.value_at(0.65, [0.5]) == solution.value_at(0.65, [0.5])
    between = (solution.value_at(0.3, [0.5]) + solution.value_at(1.0, [0.5])) / 2
    assert solution.value_at(0.65, [0.5]) == pytest.approx(between, rel=1e-12)
    with pytest.warns(UserWarning, match="lie outside the kept times"):
        assert np.isnan(solution.value_at(1.5, [0.5]))
    assert solution.value_at(1.5, [0.5], clamp=True) == solution.value_at(1.0, [0.5])
    several = solution.value_at([0.0, 0.3], [[0.5], [-0.5]])
    assert several.shape == (2,)
    assert several[1] == solution.value_at(0.3, [-0.5])
    assert "times            3" in str(solution)


@pytest.mark.slow
def test_on_the_target_the_exit_cost_is_paid_and_nothing_is_done():
    problem = hjb.Problem(
        plane, lambda x, u: 1.0, Box([-1.0], [1.0]), target=lambda x: jnp.abs(x[0]) - 0.5, exit_cost=2.0
    )
    solution = hjb.march(problem, GRID, 1.0, scheme=hjb.Upwind(split=True))
    inside = np.abs(GRID.axis(0)) <= 0.5
    assert np.all(solution.value[0][inside] == 2.0)
    assert np.all(np.isnan(solution.policy[0][inside]))


def test_without_a_terminal_cost_the_constraint_is_the_end():
    stop = hjb.march(
        dataclasses.replace(LQ, stopping_cost=lambda x: x[0]), GRID, 1.0, times=[1.0], scheme=hjb.Upwind(split=True)
    )
    np.testing.assert_allclose(stop.value[0], GRID.axis(0), rtol=0, atol=1e-14)


# --- transformations ---


def at_one(weight, method=None, step=1 / 64):
    problem = dataclasses.replace(LQ, cost=jax.tree_util.Partial(weighted, weight))
    return hjb.march(problem, GRID, 1.0, step=step, method=method, scheme=hjb.Upwind(split=True)).value[0, 30]


@pytest.mark.slow
def test_it_can_be_compiled_batched_and_differentiated():
    with jax.enable_x64(True):
        plain = float(at_one(1.0))
        assert float(jax.jit(at_one)(1.0)) == pytest.approx(plain, rel=1e-9)
        both = jax.jit(jax.vmap(at_one))(jnp.array([1.0, 2.0]))
        assert float(both[0]) == pytest.approx(plain, rel=1e-9)
        slope = float(jax.jit(jax.grad(at_one))(1.0))
        assert slope == pytest.approx(float(jax.jit(lambda w: jax.jvp(at_one, (w,), (1.0,))[1])(1.0)), rel=1e-9)
        assert slope == pytest.approx(float(at_one(1.001) - at_one(0.999)) / 0.002, rel=1e-4)
        implicit = jax.jit(lambda weight: at_one(weight, hjb.Implicit()))(1.0)
        assert float(implicit) == pytest.approx(float(at_one(1.0, hjb.Implicit())), abs=1e-6)


def test_traced_use_wants_a_step():
    with pytest.raises(ValueError, match=r"inside jit, vmap and grad the number of steps must be known: pass step="):
        jax.jit(lambda weight: at_one(weight, step=None))(1.0)
    with pytest.raises(ValueError, match=r"horizon and times set the number of steps and must be known"):
        jax.jit(lambda horizon: hjb.march(LQ, GRID, horizon, step=0.01, scheme=hjb.Upwind(split=True)).value)(1.0)


@pytest.mark.slow
def test_a_marched_feedback_must_be_known_densely_enough():
    few = hjb.march(LQ, GRID, 1.0, times=[0.0, 1.0], scheme=hjb.Upwind(split=True))
    with pytest.raises(ValueError, match=r"stored at 2 times from 0 to 1; a feedback up to t = 1 needs times"):
        hjb.simulate(LQ, few, [1.0], 1.0)
    with pytest.raises(ValueError, match=r"duration = 2 goes beyond the horizon 1"):
        hjb.simulate(LQ, few, [1.0], 2.0)
    many = hjb.march(LQ, GRID, 1.0, times=np.linspace(0, 1, 21), scheme=hjb.Weno5())
    path = hjb.simulate(LQ, many, [1.0], 1.0)
    assert path.cost == pytest.approx(np.tanh(1.0), abs=2e-3)
    assert path.controls[0] == pytest.approx(-np.tanh(1.0), abs=0.02)
