"""Predictions without a measurement, samples at irregular times, and sensors that are nearly exact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import hjbjax as hjb

F = hjb.filtering
RATE, SIGMA, NONE = 0.7, 0.5, np.zeros(0)
PLANT = hjb.Problem(lambda x, u: -RATE * x, lambda x, u: 0.0 * x[0], noise=SIGMA)
GRID = hjb.Grid([-3.0], [3.0], (121,))


def identity(x):
    return x


def twice(x):
    return jnp.stack([x[0], x[0]])


def moved(mean, variance, t):
    """The law of dx = −a x dt + σ dw after a time, from its formula."""
    shrink = np.exp(-RATE * t)
    return shrink * mean, shrink**2 * variance + SIGMA**2 * (1 - shrink**2) / (2 * RATE)


def kalman(h=identity, r=1.0):
    return F.ExtendedKalman(PLANT, h, [1.0], [0.2], measurement_noise=r)


def grid_filter():
    return F.GridFilter(PLANT, identity, GRID, lambda x: jnp.exp(-((x - 1) @ (x - 1)) / 0.4))


@pytest.mark.slow
def test_a_prediction_is_the_law_of_the_plant():
    with jax.enable_x64(True):
        mean, variance = moved(1.0, 0.2, 0.8)
        state = jax.jit(lambda s: kalman().update(s, NONE, None, 0.8))(kalman().initial())
        np.testing.assert_allclose([state.mean[0], state.covariance[0, 0]], [mean, variance], rtol=1e-12)
        observer = grid_filter()
        state = jax.jit(lambda s: observer.update(s, NONE, None, 0.8))(observer.initial())
        assert float(observer.estimate(state)[0]) == pytest.approx(mean, rel=1e-3)
        assert float(observer.covariance(state)[0, 0]) == pytest.approx(variance, rel=1e-2)
        assert float(state.log_likelihood) == 0
        copy = F.Luenberger(PLANT, identity, [[3.0]], [1.0])
        assert float(copy.update(copy.initial(), NONE, None, 0.8)[0]) == pytest.approx(mean, rel=1e-12)


def test_a_robust_prediction_pays_for_disturbances_alone():
    """p = −γ² x²/(2Y) with Y' = −2a Y + σ² where nothing is seen and nothing costs."""
    observer = F.RobustGridFilter(PLANT, identity, GRID, lambda x: -2 * x @ x, 2.0)
    with jax.enable_x64(True):
        state = observer.update(observer.initial(), NONE, None, 0.4)
        _, spread = moved(0.0, 1.0, 0.4)
        state = np.asarray(state) - np.max(state)
    x = np.asarray(GRID.axis(0))[40:81]
    np.testing.assert_allclose(state[40:81], -2 * x**2 / spread, atol=2e-3)


def test_a_hidden_chain_is_predicted_by_its_generator():
    generator = np.array([[-1.0, 1.0], [2.0, -2.0]])
    observer = F.WonhamFilter(generator, [1.0, 0.0], [0.9, 0.1])
    belief = observer.update(observer.initial(), NONE, None, 0.6)
    np.testing.assert_allclose(belief, [0.9, 0.1] @ expm(0.6 * generator), atol=1e-6)


def test_samples_at_irregular_times_are_bayes():
    """Against the formulas of the scalar Kalman filter, at times that no step divides."""
    times, samples, s = [0.13, 0.2, 0.71], [0.8, 0.9, 0.2], 0.4
    mean, variance, t = 1.0, 0.2, 0.0
    observers = {"kalman": kalman(), "grid": grid_filter()}
    with jax.enable_x64(True):
        states = {name: each.initial() for name, each in observers.items()}
        for time, y in zip(times, samples, strict=True):
            mean, variance = moved(mean, variance, time - t)
            gain = variance / (variance + s**2)
            mean, variance = mean + gain * (y - mean), (1 - gain) * variance
            for name, each in observers.items():
                states[name] = each.update(states[name], NONE, None, time - t)
                states[name] = each.correct(states[name], np.array([y]), measurement_noise=s)
            t = time
        found = states["kalman"]
        np.testing.assert_allclose([found.mean[0], found.covariance[0, 0]], [mean, variance], rtol=1e-10)
        found, observer = states["grid"], observers["grid"]
        assert float(observer.estimate(found)[0]) == pytest.approx(mean, abs=2e-3)
        assert float(observer.covariance(found)[0, 0]) == pytest.approx(variance, rel=1e-2)


def test_a_robust_sample_costs_its_error():
    observer = F.RobustGridFilter(PLANT, identity, GRID, lambda x: -2 * x @ x, 2.0)
    with jax.enable_x64(True):
        state = observer.correct(observer.initial(), np.array([0.5]), measurement_noise=0.1)
    x = np.asarray(GRID.axis(0))
    np.testing.assert_allclose(state, -2 * x**2 - 2 * ((x - 0.5) / 0.1) ** 2, rtol=1e-12)


def test_samples_under_jit_and_vmap():
    observer = kalman()
    rows = jax.vmap(lambda y: observer.correct(observer.initial(), y, measurement_noise=0.4).mean)(jnp.ones((3, 1)))
    assert rows.shape == (3, 1)


@pytest.mark.parametrize("x64", [True, False])
@pytest.mark.parametrize("r", [1e-9, 1e-3])
def test_equal_sensors_count_by_their_mean(r, x64):
    """Two sensors of noise r are one of noise r/√2; with r = 1e-9 their covariance is singular up to rounding."""
    pair, alone = kalman(twice, r), kalman(identity, r / np.sqrt(2))
    with jax.enable_x64(x64):
        states, dt = (pair.initial(), alone.initial()), 0.01

        @jax.jit
        def update(states, y):
            both = pair.update(states[0], NONE, jnp.stack([y, y]) * dt, dt)
            return both, alone.update(states[1], NONE, y[None] * dt, dt)

        for y in (0.9, 0.7, 0.8, 0.85):
            states = update(states, jnp.asarray(y))
        both, one = (np.array([each.mean[0], each.covariance[0, 0]]) for each in states)
    assert np.all(np.isfinite(both))
    tolerance = 1e-6 if x64 else 5e-3
    np.testing.assert_allclose(both[0], one[0], rtol=tolerance)
    np.testing.assert_allclose(both[1], one[1], rtol=0.02, atol=tolerance * SIGMA**2 * dt)
    assert both[1] >= 0


def test_equal_exact_sensors_of_a_constant_stay_finite():
    """No noise renews the covariance, which falls to rounding."""
    still = hjb.Problem(lambda x, u: 0 * x)
    observer = F.ExtendedKalman(
        still, lambda x: jnp.stack([x[0], x[0]]), [0.0, 0.0], [1.0, 1.0], measurement_noise=1e-9
    )
    with jax.enable_x64(True):
        state, update = observer.initial(), jax.jit(observer.update)
        for _ in range(50):
            state = update(state, NONE, np.array([3e-3, 3e-3]), 0.01)
    assert float(state.mean[0]) == pytest.approx(0.3, rel=1e-6)
    assert np.all(np.isfinite(state.covariance))
    assert float(state.covariance[1, 1]) == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*narrower than a cell", "ignore:.*is longer than")
def test_equal_exact_sensors_leave_a_law_on_a_grid():
    law = F.zakai(PLANT, twice, GRID, np.full((3, 2), 5e-3), 0.01, lambda x: jnp.exp(-x @ x), measurement_noise=1e-9)
    np.testing.assert_allclose(law.mean[-1], 0.5, atol=0.05)
    assert np.all(np.isfinite(law.covariance))
    record = np.full((1, 2), 0.5)
    with pytest.raises(ValueError, match="needs more than"):
        F.robust_filter(PLANT, twice, GRID, record, 0.01, lambda x: -x @ x, gamma=2.0, measurement_noise=1e-9)


@pytest.mark.parametrize("r", [1e-2, 1e-3])
def test_a_nearly_exact_sensor_of_the_worst_case(r):
    """With r = 1e-3 the worst case was −2.93 and p was 1e8, where p ≤ 0."""
    found = F.robust_filter(
        PLANT, identity, GRID, np.full((2, 1), 0.5), 0.01, lambda x: -x @ x, gamma=2.0, measurement_noise=r
    )
    np.testing.assert_allclose(found.worst_case[-1], 0.5, atol=0.01)
    assert np.all(found.p <= 1e-9)


@pytest.mark.parametrize(
    ("observer", "name"),
    [
        (kalman(), "ExtendedKalman.correct"),
        (grid_filter(), "GridFilter.correct"),
        (F.RobustGridFilter(PLANT, identity, GRID, lambda x: -x @ x, 2.0), "RobustGridFilter.correct"),
    ],
    ids=["kalman", "grid", "robust"],
)
def test_samples_are_refused(observer, name):
    state = observer.initial()
    with pytest.raises(ValueError, match=rf"{name}: y has shape \(2,\), wanted \(1,\): the sample"):
        observer.correct(state, np.ones(2), measurement_noise=1.0)
    with pytest.raises(ValueError, match=rf"{name}: y = \[nan\], wanted finite numbers"):
        observer.correct(state, np.array([np.nan]), measurement_noise=1.0)
    with pytest.raises(ValueError, match=rf"{name}: got measurement_noise = 0.0"):
        observer.correct(state, np.ones(1), measurement_noise=0.0)
