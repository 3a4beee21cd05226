"""Fits: optima that are known, bounds, checks and interrupts, and parameters recovered from closed loops."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

import hjbjax as hjb
from hjbjax.calibration import trajectories


def bowl(p):
    return (p["a"] - 3.0) ** 2 + jnp.sum((p["b"] - jnp.array([1.0, -2.0])) ** 2)


START = {"a": 1.0, "b": np.array([0.5, -1.0])}


def test_a_minimum_is_found_in_any_units():
    found = hjb.fit(bowl, START, check_gradient=True)
    assert found.status is hjb.Status.CONVERGED
    assert np.allclose([found.parameters["a"], *found.parameters["b"]], [3, 1, -2], atol=5e-3)
    assert found.gradient_error < 1e-6
    assert found.loss == min(found.history)
    scaled = hjb.fit(lambda p: 1e3 * bowl({"a": p["a"] / 1e6, "b": p["b"]}), {"a": 1e6, "b": START["b"]})
    assert np.allclose(scaled.history[:20], 1e3 * found.history[:20], rtol=1e-5)


def test_bounds_hold():
    found = hjb.fit(bowl, START, bounds=({"a": 0.0, "b": -1.5}, {"a": 2.0, "b": 5.0}))
    assert np.allclose([found.parameters["a"], *found.parameters["b"]], [2, 1, -1.5], atol=5e-3)
    with pytest.raises(ValueError, match="not within the bounds"):
        hjb.fit(bowl, START, bounds=(0.0, 2.0))


@pytest.mark.parametrize("start", [3.0, 3.0 + 1e-7])
def test_a_start_at_the_optimum_has_converged(start):
    """The slope of rounding size makes Adam leave the optimum, and the start remains the best."""
    found = hjb.fit(lambda p: (p - 3.0) ** 2 + 1e-13 * p + 5.0, start)
    assert found.status is hjb.Status.CONVERGED
    assert found.parameters == start


def test_the_gradient_is_checked_inside_the_bounds():
    root = lambda p: jnp.sum(jnp.sqrt(p - 1.0)) + p[0]  # noqa: E731
    bounds = np.array([1.0, 1.0, 2.5]), np.array([4.0, 2.0, 2.5])
    found = hjb.fit(root, np.array([1.001, 2.0, 2.5]), bounds=bounds, check_gradient=True, steps=2)
    assert found.gradient_error < 1e-2


@dataclasses.dataclass
class Pair:
    first: float
    second: np.ndarray


jax.tree_util.register_dataclass(Pair, ["first", "second"], [])


@pytest.mark.parametrize("kind", [Pair, lambda *each: [*each]])
def test_bounds_have_the_structure_of_the_parameters(kind):
    loss = lambda p: sum(jnp.sum((leaf - 2.0) ** 2) for leaf in jax.tree.leaves(p))  # noqa: E731
    bounds = kind(np.float64(0.0), np.zeros(2)), kind(np.float64(1.5), np.full(2, 9.0))
    found = hjb.fit(loss, kind(1.0, np.ones(2)), bounds=bounds)
    assert np.allclose(np.hstack(jax.tree.leaves(found.parameters)), [1.5, 2, 2], atol=5e-3)


def test_restarts_leave_zero():
    found = hjb.fit(lambda p: (p - 1.0) ** 2, 0.0, restarts=2, steps=1)
    assert len(set(found.starts)) == 3


def test_a_complex_loss_is_refused():
    with pytest.raises(TypeError, match="complex"):
        hjb.fit(lambda p: p + 1j, 1.0)


@pytest.mark.slow
def test_lbfgs_is_an_optimiser_too():
    assert hjb.fit(bowl, START, optimiser=optax.lbfgs(), steps=30).loss < 1e-12


def test_restarts_leave_a_local_minimum():
    waves = lambda p: jnp.cos(3 * p) + 0.1 * (p - 3.2) ** 2  # noqa: E731
    alone = hjb.fit(waves, 7.0, steps=60, bounds=(0.0, 10.0))
    several = hjb.fit(waves, 7.0, steps=60, bounds=(0.0, 10.0), restarts=12, seed=1)
    assert several.loss < alone.loss - 0.5
    assert abs(several.parameters - np.pi) < 0.1
    assert len(several.starts) == 13


def test_a_loss_that_is_not_finite_is_refused_or_ends_the_run():
    with pytest.raises(ValueError, match="not finite at the initial parameters"):
        hjb.fit(lambda p: jnp.log(-p), 1.0)
    ended = hjb.fit(lambda p: jnp.where(p > 0.5, p, jnp.nan), 1.0)
    assert ended.status is hjb.Status.NONFINITE
    assert 0.5 < ended.parameters <= 0.6


def test_a_wrong_gradient_is_reported():
    with pytest.warns(hjb.SolveWarning, match="finite difference"):
        hjb.fit(lambda p: jax.lax.stop_gradient(p) * p, 1.0, steps=2, check_gradient=True)


def test_a_time_limit_keeps_the_best_parameters_and_a_file_brings_them_back(tmp_path):
    with pytest.raises(hjb.SolveError, match="TIME_LIMIT"):
        hjb.fit(bowl, START, time_limit=0.0)
    found = hjb.fit(bowl, START, steps=5)
    assert found.status is hjb.Status.MAX_STEPS
    found.save(tmp_path / "fit")
    back = hjb.Fit.load(tmp_path / "fit")
    assert (back.loss, back.status) == (found.loss, found.status)
    assert np.array_equal(back.parameters["['b']"], found.parameters["b"])


def test_parameters_with_many_axes_come_back(tmp_path):
    start = np.arange(6.0).reshape(1, 3, 1, 1, 2, 1)
    hjb.fit(lambda p: jnp.sum((p - start) ** 2), start, steps=1).save(tmp_path / "fit")
    assert np.array_equal(hjb.Fit.load(tmp_path / "fit").parameters[""], start)


@pytest.mark.slow
def test_a_design_with_a_known_optimum():
    """x' = b u, cost x² + u²: V = x²/b, so V(1) + 4 b is least at b = ½, where it is 4."""
    found = hjb.design(
        lambda b: hjb.Problem(lambda x, u: b * u, lambda x, u: x @ x + u @ u, hjb.Box([-9.0], [9.0])),
        hjb.Grid([-1.5], [1.5], (61,)),
        lambda solution, b: solution.value_at(jnp.array([1.0])) + 4 * b,
        0.8,
        optimiser=optax.lbfgs(),
        steps=12,
    )
    print(f"strength {found.parameters:.4f}, value and price {found.loss:.4f}")
    assert abs(found.parameters - 0.5) < 0.005
    assert abs(found.loss - 4.0) < 0.02


@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.usefixtures("float64")
def test_observed_paths_are_integrated_to_fourth_order(timed):
    """x' = u with u = −2x, or u = −(2 − t) x, from several states; x = x₀ e^{−2t} or x₀ e^{−2t + t²/2}."""
    gain = lambda t: 2 - t if timed else 2.0  # noqa: E731

    def control_at(*where, clamp):
        return -gain(where[0][..., None] if timed else 0.0) * where[-1]

    problem = hjb.Problem(lambda x, u: u, lambda x, u: u @ u, hjb.Box([-9.0] * 2, [9.0] * 2))
    times, starts = np.array([1.0, 1.3, 1.5, 2.5]), np.array([[1.0, -0.5], [0.2, 0.3], [-0.7, 0.0]])
    seen = trajectories.Observations(times, np.repeat(starts[:, None], 4, axis=1), np.zeros((3, 4, 2)))
    feedback = types.SimpleNamespace(times=np.zeros(2) if timed else None, control_at=control_at)
    t = times - 1.0
    exact = starts[:, None] * np.exp(-2 * t + timed * t**2 / 2)[:, None]
    errors = []
    for count in (4, 8):
        states, controls = trajectories._closed_loops(problem, feedback, seen, count)
        assert np.allclose(controls, -(2 - timed * t)[:, None] * states, rtol=1e-12)
        errors.append(np.abs(states - exact).max())
    assert errors[1] < 1e-4
    assert 3.7 < np.log2(errors[0] / errors[1]) < 4.6


TRUE = {"position": 2.0, "velocity": 0.5, "mass": 1.5}


def closed_loops(count, seed):
    """The optimal paths of a mass, by SciPy: cost q₁ x² + q₂ v² + u², m v' = u."""
    a, b = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1 / TRUE["mass"]]])
    p = solve_continuous_are(a, b, np.diag([TRUE["position"], TRUE["velocity"]]), np.eye(1))
    gain = b.T @ p
    times, draw = np.linspace(0.0, 4.0, 21), np.random.default_rng(seed)
    for _ in range(count):
        start = draw.uniform([-0.8, -0.6], [0.8, 0.6])
        states = solve_ivp(lambda t, x: (a - b @ gain) @ x, (0, 4), start, t_eval=times, rtol=1e-9, atol=1e-9).y.T
        yield times, states, -states @ gain.T


def posed(p):
    return hjb.Problem(
        lambda x, u: jnp.stack([x[1], u[0] / p["mass"]]),
        lambda x, u: p["position"] * x[0] ** 2 + p["velocity"] * x[1] ** 2 + u @ u,
        hjb.Box([-6.0], [6.0]),
    )


@pytest.mark.slow
def test_a_mass_and_two_weights_are_recovered_from_twenty_closed_loops():
    """Without noise, and with noise of 5 % of the standard deviation of every state and control."""
    grid, start = hjb.Grid([-1.5, -1.5], [1.5, 1.5], (31, 31)), dict.fromkeys(TRUE, 1.0)
    exact, draw = list(closed_loops(20, 3)), np.random.default_rng(1)

    def observed(values):
        return values + 0.05 * np.std(values) * draw.standard_normal(values.shape)

    noisy = [(times, observed(states), observed(controls)) for times, states, controls in exact]
    for loops, within in ((exact, 0.02), (noisy, 0.1)):
        found = hjb.fit_trajectories(posed, grid, loops, start, steps=300, bounds=(0.05, 20.0))
        off = {name: float(abs(found.parameters[name] / value - 1)) for name, value in TRUE.items()}
        print(f"relative errors {off}")
        assert max(off.values()) < within
