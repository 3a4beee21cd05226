"""Laws of states without noise of their own against Kalman's filter, and warnings where a law is not resolved."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hjbjax.filtering.information_state import GridFilter, zakai
from hjbjax.filtering.observers import ExtendedKalman
from hjbjax.markov_chain import forward_equation
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem

START, VARIANCE, R, DT, STEPS = (-1.0, 1.0), 0.02, 0.1, 0.05, 40
DRIVEN = Problem(lambda x, u: jnp.stack([x[1], 0 * x[1]]), noise=np.array([0.0, 0.2]))


def place(x):
    return x[:1]


def prior(x):
    return jnp.exp(-((x[0] - START[0]) ** 2 + (x[1] - START[1]) ** 2) / (2 * VARIANCE))


def kalman(record):
    """Mean and covariance of the linear plant after the record."""
    observer = ExtendedKalman(DRIVEN, place, START, [VARIANCE] * 2, measurement_noise=R)
    with jax.enable_x64(True):
        state, update = observer.initial(), jax.jit(observer.update)
        for dy in record:
            state = update(state, np.zeros(0), dy, DT)
        return np.asarray(state.mean), np.asarray(state.covariance)


@jax.jit
def carried(observer, p, time):
    """The probabilities after a time without measurement."""
    return forward_equation.advanced(observer._on(p.dtype), p, jnp.zeros(0), time, axes=observer.axes)


@pytest.mark.optimised
@pytest.mark.slow
@pytest.mark.parametrize(("count", "most"), [(61, 0.13), (121, 0.03)])
def test_a_position_without_noise_has_the_law_of_kalman(count, most):
    """x₁' = x₂, dx₂ = 0.2 dw. The diffusion of upwinding made the variances 55 % and 32 % too large."""
    times = DT * np.arange(STEPS)
    record = ((times + DT / 2 - 1) * DT)[:, None]
    mean, covariance = kalman(record)
    law = zakai(DRIVEN, place, Grid([-2.0] * 2, [2.0] * 2, (count,) * 2), record, DT, prior, measurement_noise=R)
    np.testing.assert_allclose(law.covariance[-1], covariance, rtol=most)
    np.testing.assert_allclose(law.mean[-1], mean, atol=0.005)
    assert np.all(law.density >= 0)


@pytest.mark.slow
def test_a_rotation_keeps_mass_sign_and_width():
    """x₁' = x₂, x₂' = −x₁ over a quarter of a turn."""
    turning = Problem(lambda x, u: jnp.stack([x[1], -x[0]]))
    grid = Grid([-2.0] * 2, [2.0] * 2, (61, 61))
    observer = GridFilter(turning, place, grid, lambda x: jnp.exp(-25 / 2 * ((x[0] - 1) ** 2 + x[1] ** 2)))
    assert observer.axes == (0, 1)
    with jax.enable_x64(True):
        p = jnp.asarray(observer.probability(observer.initial()))
        q = carried(observer, p, np.pi / 2)
        mean, covariance = forward_equation.mean(grid, q), forward_equation.covariance(grid, q)
    assert np.sum(np.asarray(q)) == pytest.approx(1, abs=1e-12)
    assert np.all(np.asarray(q) >= 0)
    np.testing.assert_allclose(mean, [0.0, -1.0], atol=0.01)
    np.testing.assert_allclose(np.diag(covariance), 0.04, rtol=0.1)


@pytest.mark.slow
def test_the_order_of_transport_is_the_second():
    """x' = 1 + sin(x)/2 on a ring: the mass between two paths does not change."""
    errors = []
    for count in (40, 80, 160):
        grid = Grid([0.0], [2 * np.pi], (count,), (True,))
        flow = Problem(lambda x, u: 1 + jnp.sin(x) / 2)
        observer = GridFilter(flow, place, grid, lambda x: 2 + jnp.sin(x[0]))
        with jax.enable_x64(True):
            p = jnp.asarray(observer.probability(observer.initial()))
            density = np.asarray(carried(observer, p, 1.0)) / np.asarray(observer.cells)
        # along the path back from x the density times the speed is constant
        x = np.asarray(grid.axis(0))
        back = solve_ivp(lambda t, y: -(1 + np.sin(y) / 2), (0, 1.0), x, rtol=1e-10, atol=1e-12).y[:, -1]
        exact = (2 + np.sin(back)) / (4 * np.pi) * (1 + np.sin(back) / 2) / (1 + np.sin(x) / 2)
        errors.append(np.mean(np.abs(density - exact)))
    order = -np.polyfit(np.log([40, 80, 160]), np.log(errors), 1)[0]
    assert order >= 1.85


def test_noisy_states_keep_their_chain():
    noisy = Problem(lambda x, u: -x, noise=1.0)
    assert GridFilter(noisy, place, Grid([-3.0], [3.0], (61,)), lambda x: jnp.exp(-x @ x)).axes == ()
    assert GridFilter(DRIVEN, place, Grid([-2.0] * 2, [2.0] * 2, (9, 9)), prior).axes == (0,)


@pytest.mark.slow
def test_transport_under_jit_vmap_and_grad():
    """The derivative of the mean in the speed, and a batch of speeds, of a traced plant."""
    grid, record = Grid([-2.0], [2.0], (41,)), np.zeros((2, 1))

    def mean(speed):
        plant = Problem(lambda x, u: speed + 0 * x)
        law = zakai(plant, place, grid, record, 0.1, lambda x: jnp.exp(-8 * x @ x), measurement_noise=10.0)
        return law.mean[-1, 0]

    with jax.enable_x64(True):
        pair = jax.jit(jax.vmap(mean))(jnp.array([0.47 - 1e-5, 0.47 + 1e-5]))
        slope = (float(pair[1]) - float(pair[0])) / 2e-5
        assert float(jax.grad(mean)(0.47)) == pytest.approx(slope, rel=1e-5)
    assert slope == pytest.approx(0.2, rel=0.01)
    assert float(pair[0]) == pytest.approx(0.094, rel=0.01)


# --- laws that are not resolved ---

WALK = Problem(lambda x, u: 0 * x, noise=0.5)


def walk(count, dt, r, steps=20):
    record = np.full((steps, 1), 0.4237 * dt)
    grid = Grid([-3.0], [3.0], (count,))
    return zakai(WALK, place, grid, record, dt, lambda x: jnp.exp(-x @ x / 2), measurement_noise=r)


def test_a_law_that_is_narrower_than_a_cell_is_warned_of():
    """sd 4.8e-5 was returned for 0.0296, without a word."""
    with pytest.warns(UserWarning, match="zakai|GridFilter") as said:
        walk(61, 1e-2, 1e-3, steps=1)
    texts = [str(each.message) for each in said]
    assert len(texts) == 2
    assert "zakai: dt = 0.01 is longer than r/(σ|h'|) = 0.002" in texts[0]
    assert "Use dt of at most 0.002." in texts[0]
    assert "narrower than a cell of axis 0, whose spacing is 0.1" in texts[1]
    assert "Use a spacing of at most 0.017 there" in texts[1]


def test_what_the_warnings_name_is_enough():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        law = walk(355, 2e-3, 1e-3)
    assert law.covariance[-1, 0, 0] ** 0.5 == pytest.approx((0.5 * 1e-3) ** 0.5, rel=0.15)


def test_each_warning_comes_alone():
    with pytest.warns(UserWarning, match="narrower than a cell") as said:
        walk(61, 2e-3, 1e-3)
    assert len(said) == 1
    with pytest.warns(UserWarning, match="dt = 0.2 is longer than") as said:
        walk(601, 0.2, 0.05)
    assert len(said) == 1


@pytest.mark.slow
def test_the_filter_warns_outside_jit_alone():
    observer = GridFilter(WALK, place, Grid([-3.0], [3.0], (61,)), lambda x: jnp.exp(-x @ x), measurement_noise=1e-3)
    told = np.zeros(0), np.array([0.4e-2]), 1e-2
    with pytest.warns(UserWarning, match="zakai|GridFilter") as said:
        observer.update(observer.initial(), *told)
    assert [str(each.message).split(" is ")[0] for each in said] == [
        "GridFilter.update: dt = 0.01",
        "GridFilter.update: the law",
    ]
    jax.jit(observer.update)(observer.initial(), *told)


@pytest.mark.slow
def test_two_narrow_peaks_are_narrow():
    """h = x² leaves x = ±1: the covariance of both is large, each peak is not resolved."""
    grid, record = Grid([-3.0], [3.0], (61,)), np.full((10, 1), 1e-4)
    with pytest.warns(UserWarning, match="narrower than a cell"):
        law = zakai(WALK, lambda x: x**2, grid, record, 1e-4, np.ones(61), measurement_noise=1e-3)
    assert law.covariance[-1, 0, 0] > 0.5
