"""Drift that carries past a target, without discount and noise: once most nodes were said not to reach it.

The control u, |u| ≤ b, adds to a constant drift w. The least time from x to the ball |x| ≤ r is the least t ≥ 0 with
|x + w t| ≤ r + b t.
"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.solvers import batch, semi_lagrangian

CORNER = jnp.array([-1.0, -1.0])
UNREACHED = r"^60\.\d % of the nodes cannot reach the target: their value is inf"


ANGLE = np.array([np.cos(0.3), np.sin(0.3)])


def disc(x):
    return jnp.hypot(x[0], x[1] + 1e-12) - 0.3


FLOW = hjb.Problem(lambda x, u: jnp.array(ANGLE) + 0 * x)


def square(count):
    return hjb.Grid([-1.0, -1.0], [1.0, 1.0], (count, count))


def drifting(b=1.0, w=1.5, r=0.25, cost=1.0):
    return hjb.Problem(
        lambda x, u: u + w * jnp.array([1.0, 0.0]), lambda x, u: cost, hjb.Ball(b, 2),
        target=lambda x: jnp.hypot(x[0], x[1]) - r,
    )  # fmt: skip


def least_time(x, w, b, r):
    """The time from the states (..., n); infinite where the ball is not met."""
    x, w = np.asarray(x, float), np.asarray(w, float)
    a, half, c = w @ w - b * b, x @ w - r * b, np.sum(x * x, axis=-1) - r * r
    root = np.sqrt(np.maximum(half**2 - a * c, 0))
    met = (half**2 >= a * c) & (half <= 0)
    return np.where(c <= 0, 0, np.where(met, (-half - root) / a, np.inf))


def assert_near(value, exact, mean, atol, share):
    """Errors within ``atol``, and their mean; finite at the same nodes but for a ``share`` at the edge.

    The time rises like a square root from the tangent to the ball, next to which the error is largest.
    """
    both = np.isfinite(value) & np.isfinite(exact)
    np.testing.assert_allclose(value[both], exact[both], rtol=0, atol=atol)
    assert np.mean(np.abs(value[both] - exact[both])) <= mean
    assert np.mean(np.isfinite(value) != np.isfinite(exact)) <= share


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_the_default_reaches_the_target(dtype):
    grid = square(21)
    with pytest.warns(hjb.SolveWarning, match=UNREACHED):
        solution = hjb.solve(drifting(), grid, dtype=dtype)
    assert "solved by SemiLagrangian()" in solution.message
    assert float(solution.value_at(CORNER)) == pytest.approx(0.760, abs=0.01)
    np.testing.assert_array_equal(solution.reached, np.isfinite(solution.value))
    assert_near(solution.value, least_time(grid.nodes(), [1.5, 0.0], 1.0, 0.25), 0.005, 0.07, 0.02)


@pytest.mark.slow
@pytest.mark.optimised
def test_any_resolution_gives_the_same_share():
    for count in (41, 80, 121):
        with pytest.warns(hjb.SolveWarning, match=UNREACHED):
            solution = hjb.solve(drifting(), square(count))
        assert float(np.mean(solution.reached)) == pytest.approx(0.4, abs=0.01)
        assert float(solution.value_at(CORNER)) == pytest.approx(0.760, abs=0.005)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach the target")
def test_batches_and_transformations_decide_alike(monkeypatch):
    """Of three lanes the third, whose control is faster than the drift, keeps the chain."""
    grid, speeds = square(21), (1.0, 1.1, 2.0)
    alone = [hjb.solve(drifting(b), grid) for b in speeds]
    assert [each.stats["scheme"][:5] for each in alone] == ["SemiL", "SemiL", "Limit"]
    for together in (False, True):
        monkeypatch.setattr(batch, "_fills_with_lanes", lambda together=together: together)
        for lane, own in zip(hjb.solve_batch([drifting(b) for b in speeds], grid), alone, strict=True):
            np.testing.assert_allclose(lane.value, own.value, rtol=1e-8)
            assert lane.stats["scheme"] == own.stats["scheme"]
    with jax.enable_x64(True):
        values = jax.vmap(lambda b: hjb.solve(drifting(b), grid).value)(jnp.array(speeds))
    np.testing.assert_allclose(values, [own.value for own in alone], rtol=1e-8)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach the target")
def test_derivatives_are_those_of_the_answer():
    """With respect to the control's bound, the drift, the radius, the cost and the box."""
    numbers, step = np.array([1.03, 1.47, 0.26, 1.2, 1.01]), 1e-6

    def value(numbers):
        *ingredients, size = numbers
        grid = hjb.Grid([-1.07 * size, -0.98], [1.03, 1.09 * size], (21, 22))
        return hjb.solve(drifting(*ingredients), grid, tol=1e-10).value_at(jnp.array([-0.87, 0.53]))

    with jax.enable_x64(True):
        numbers = jnp.asarray(numbers)
        slope = jax.grad(value)(numbers)
        shifts = step * np.eye(5)
        differences = [(value(numbers + shift) - value(numbers - shift)) / (2 * step) for shift in shifts]
        tangent = jax.jvp(value, (numbers,), (jnp.ones(5),))[1]
    np.testing.assert_allclose(slope, differences, rtol=1e-4, atol=1e-5)
    assert float(tangent) == pytest.approx(float(np.sum(np.asarray(slope))), rel=1e-8)


def swirling(x, u):
    return jnp.stack([1.0 + 0.0 * x[0], 0.5 * jnp.sin(3 * x[0]) + 0.4 * u[0]])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach the target", "ignore:the grid is coarse", "ignore:the box decides")
def test_two_targets_and_a_bent_flow():
    """ẋ₁ = 1, ẋ₂ = sin(3 x₁)/2 + 0.4 u: the first meeting with either disc over constant controls, which bounds T."""
    discs = ((0.1, 0.3, 0.2), (0.5, -0.4, 0.15))

    def target(x):
        return jnp.minimum(*(jnp.hypot(x[0] - a, x[1] - b) - r for a, b, r in discs))

    problem = hjb.Problem(swirling, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), target=target)
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (61, 61))
    solution = hjb.solve(problem, grid)
    assert "SemiLagrangian" in solution.message
    start, times = grid.nodes()[:30:6, ::4].reshape(-1, 2), np.linspace(0, 2, 801)
    least = np.full(len(start), np.inf)
    for u in np.linspace(-1, 1, 81):
        first = start[:, :1] + times
        second = start[:, 1:] + 0.4 * u * times - (np.cos(3 * first) - np.cos(3 * start[:, :1])) / 6
        inside = np.any([np.hypot(first - a, second - b) <= r for a, b, r in discs], axis=0)
        least = np.minimum(least, np.where(inside.any(axis=1), times[np.argmax(inside, axis=1)], np.inf))
    value = solution.value[:30:6, ::4].reshape(-1)
    assert np.mean(np.isfinite(value) != np.isfinite(least)) <= 0.07
    both = np.isfinite(value) & np.isfinite(least)
    # V jumps where the nearer disc is just missed; elsewhere all are close
    errors = np.abs(value[both] - least[both])
    assert np.quantile(errors, 0.95) <= 0.02


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach the target")
def test_three_states():
    w, grid = jnp.array([0.9, 0.7, 0.4]), hjb.Grid([-1.0] * 3, [1.0] * 3, (21, 21, 21))
    problem = hjb.Problem(
        lambda x, u: u + w, lambda x, u: 1.0, hjb.Ball(0.6, 3), target=lambda x: jnp.sqrt(x @ x + 1e-12) - 0.4
    )
    solution = hjb.solve(problem, grid)
    assert "SemiLagrangian" in solution.message
    # 26 directions of the control are tried, which leaves larger errors at the edge
    assert_near(solution.value, least_time(grid.nodes(), w, 0.6, 0.4), 0.03, 0.5, 0.06)


@pytest.mark.filterwarnings("ignore:the grid is coarse")
@pytest.mark.slow
def test_what_the_chain_can_do_stays_with_the_chain():
    """A mass brought to rest near the origin: all nodes are reached, and nothing is followed."""
    problem, grid = zoo.double_integrator(shape=(21, 21))
    solution = hjb.solve(problem, grid)
    assert "SemiLagrangian" not in solution.message + solution.stats["scheme"]


@pytest.mark.slow
def test_the_message_tells_never_from_perhaps():
    question = hjb.Problem(FLOW.drift, lambda x, u: 1.0, target=disc)
    with pytest.warns(hjb.SolveWarning, match="carried past the target under every control, so its expected cost is"):
        solution = hjb.solve(question, square(21), scheme=hjb.Upwind())
    assert np.mean(solution.reached) < 0.15
    onwards = hjb.Problem(lambda x, u: 0.5 + 0 * x, lambda x, u: 1.0, target=lambda x: x[0] ** 2 - 0.01)
    with pytest.warns(hjb.SolveWarning, match=r"^46\.2 % of the nodes cannot reach the target: their value is inf"):
        hjb.solve(onwards, hjb.Grid([-1.0], [1.0], (26,)))


@pytest.mark.slow
def test_arcs_that_do_not_fit_leave_the_chain(monkeypatch):
    """The answer is then that of the chain, with its warning."""
    monkeypatch.setattr(semi_lagrangian, "arc_bytes", lambda *_: 10**15)
    with pytest.warns(hjb.SolveWarning, match="carried past the target"):
        solution = hjb.solve(drifting(), square(21))
    assert "SemiLagrangian" not in solution.message


# --- times and probabilities of systems without chance ---


def in_the_way(x):
    return jnp.hypot(x[0] + 0.5, x[1] + 0.15) - 0.15


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach the target")
def test_a_flow_has_its_own_times():
    """The same in a batch of one and inside ``jit``."""
    grid = square(31)
    found = hjb.expected_exit_time(FLOW, grid, disc)
    assert_near(found.value, least_time(grid.nodes(), ANGLE, 0.0, 0.3), 0.005, 0.07, 0.02)
    question = hjb.Problem(FLOW.drift, lambda x, u: 1.0, target=disc)
    (lane,) = hjb.solve_batch([question], grid, tol=1e-6)
    np.testing.assert_array_equal(lane.value, found.value)
    with jax.enable_x64(True):
        inside = jax.jit(lambda one: hjb.solve(question, grid, tol=1e-6 * one).value)(1.0)
    np.testing.assert_allclose(inside, found.value, rtol=1e-8)


@pytest.mark.slow
def test_a_flow_arrives_or_does_not():
    grid = square(31)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = hjb.reach_probability(FLOW, grid, disc)
        past = hjb.reach_probability(FLOW, grid, disc, obstacle=in_the_way)
        gone = hjb.stay_probability(FLOW, grid, lambda x: -disc(x))
    arrives = np.isfinite(least_time(grid.nodes(), ANGLE, 0.0, 0.3))
    for each in (found, past, gone):
        assert set(np.unique(each.value)) == {0.0, 1.0}
    assert np.mean(found.value != arrives) <= 0.02
    np.testing.assert_array_equal(gone.value, 1 - found.value)
    shift = grid.nodes() - np.array([-0.5, -0.15])
    stopped = least_time(shift, ANGLE, 0.0, 0.15) < least_time(grid.nodes(), ANGLE, 0.0, 0.3)
    assert np.mean(past.value != (arrives & ~stopped)) <= 0.04


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [None, 1.0])
def test_a_control_arrives_or_keeps_away(horizon):
    """The drift meets the ball under every control from the cone behind it alone: ẋ = u + (1.5, 0)."""
    grid = square(41)
    problem, x = drifting(), grid.nodes()
    most = hjb.reach_probability(problem, grid, horizon=horizon)
    least = hjb.reach_probability(problem, grid, horizon=horizon, least=True)
    for each in (most, least):
        assert set(np.unique(each.value)) == {0.0, 1.0}
    time = least_time(x, [1.5, 0.0], 1.0, 0.25)
    first = np.reshape(most.value, (-1, *grid.shape))[0]
    arrives = np.isfinite(time) if horizon is None else time <= horizon
    assert np.mean(first != arrives) <= 0.02
    # kept out of: the disc and what lies before it, between two tangents at the angle arcsin(b/w) to the axis
    slope = 1 / np.sqrt(1.5**2 - 1)
    apex = -0.25 / (1 / 1.5)
    inside = np.hypot(x[..., 0], x[..., 1]) <= 0.25
    wedge = (x[..., 0] <= 0) & (x[..., 0] >= apex) & (np.abs(x[..., 1]) <= slope * (x[..., 0] - apex))
    kept = np.reshape(least.value, (-1, *grid.shape))[0]
    assert np.all(kept[inside] == 1)
    assert np.mean(kept != (inside | wedge)) <= 0.03
