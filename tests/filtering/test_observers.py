"""Observers of linear plants against SciPy's integration of Kalman and Bucy's equations, with fitted orders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from orders import order_of
from refusals import refused
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, expm
from systems import SEEDS

from hjbjax.filtering.observers import ExtendedKalman, Gaussian, Luenberger, Observer, affine_flow
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.sets import Box

A = np.array([[0.0, 1.0], [-2.0, -0.3]])
B = np.array([[0.0], [1.0]])
C = np.array([[1.0, 0.2]])
SIGMA = np.array([[0.3, 0.0], [0.1, 0.5]])
R = 0.4


@pytree_dataclass()
class Linear:
    """dx = (A x + B u) dt, y = C x: all numbers are leaves."""

    a: object
    b: object
    c: object

    def drift(self, x, u):
        return self.a @ x + self.b @ u

    def h(self, x):
        return self.c @ x


PLANT = Linear(A, B, C)
PROBLEM = Problem(PLANT.drift, controls=Box([-9.0], [9.0]), noise=SIGMA)
START, PRIOR = np.array([1.0, -0.5]), np.array([[0.5, 0.1], [0.1, 0.3]])


def kalman(problem=PROBLEM, plant=PLANT, r=R):
    return ExtendedKalman(problem, plant.h, START, PRIOR, measurement_noise=r)


@jax.jit
def step(observer, state, u, dy, dt):
    return observer.update(state, u, dy, dt)


def after(observer, controls, record, dt):
    """The states after each increment; a loop on the host, so that records of all lengths share one program."""
    with jax.enable_x64(True):
        states = [observer.initial()]
        for u, dy in zip(controls, record, strict=True):
            states.append(step(observer, states[-1], u, dy, dt))
        return jax.tree.map(lambda *rows: np.stack(rows), *states[1:])


def measured(t):
    return np.cos(1.5 * t) + 0.3


def increments(times):
    """∫ y dt between the times."""
    return np.diff(np.sin(1.5 * times) / 1.5 + 0.3 * times)[:, None]


def bucy(end, u):
    """Mean and covariance by Kalman and Bucy's equations for the record dy = y(t) dt under a control."""

    def rate(t, z):
        x, p = z[:2], z[2:].reshape(2, 2)
        gain = p @ C.T / R**2
        dx = A @ x + B @ u(t) + gain @ (measured(t) - C @ x)
        return np.append(dx, (A @ p + p @ A.T + SIGMA @ SIGMA.T - gain @ gain.T * R**2).ravel())

    z = solve_ivp(rate, (0, end), np.append(START, PRIOR.ravel()), rtol=1e-11, atol=1e-12).y[:, -1]
    return z[:2], z[2:].reshape(2, 2)


def test_kalman_and_bucy_of_the_second_order():
    exact_mean, exact_covariance = bucy(3.0, lambda t: np.array([0.7]))
    means, covariances = [], []
    for count in (24, 48, 96, 192):
        times = np.linspace(0, 3.0, count + 1)
        state = after(kalman(), np.full((count, 1), 0.7), increments(times), times[1])
        means.append(np.max(np.abs(state.mean[-1] - exact_mean)))
        covariances.append(np.max(np.abs(state.covariance[-1] - exact_covariance)))
    assert order_of(means) == pytest.approx(2, abs=0.15)
    assert order_of(covariances) == pytest.approx(2, abs=0.15)
    assert means[-1] < 1e-4


@pytest.mark.parametrize("dt", [0.01, 1.0, 20.0])
def test_one_step_is_the_exact_law_given_the_increment(dt):
    """The law of (x, y) at the end by SciPy's integration of its moments, then conditioned on y."""
    u, dy = np.array([0.4]), np.array([0.9 * dt])
    big = np.block([[A, np.zeros((2, 1))], [C, np.zeros((1, 1))]])
    spread = block_diag(SIGMA @ SIGMA.T, [[R**2]])

    def rate(t, z):
        mean, cov = z[:3], z[3:].reshape(3, 3)
        return np.append(big @ mean + np.append(B @ u, 0), (big @ cov + cov @ big.T + spread).ravel())

    begin = np.concatenate([START, [0.0], block_diag(PRIOR, [[0.0]]).ravel()])
    z = solve_ivp(rate, (0, dt), begin, rtol=1e-12, atol=1e-13, method="DOP853").y[:, -1]
    mean, cov = z[:3], z[3:].reshape(3, 3)
    gain = cov[:2, 2] / cov[2, 2]
    state = after(kalman(), u[None], dy[None], dt)
    np.testing.assert_allclose(state.mean[0], mean[:2] + gain * (dy[0] - mean[2]), rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(state.covariance[0], cov[:2, :2] - np.outer(gain, cov[2, :2]), rtol=1e-8, atol=1e-9)


@given(seed=SEEDS)
@settings(max_examples=25)
def test_covariances_stay_symmetric_and_positive(seed):
    rng = np.random.default_rng(seed)
    plant = Linear(
        rng.normal(size=(2, 2)) * 10 ** rng.uniform(-2, 2), B, rng.normal(size=(1, 2)) * 10 ** rng.uniform(-3, 3)
    )
    observer = kalman(Problem(plant.drift, controls=Box([-1.0], [1.0]), noise=rng.normal(size=(2, 2))), plant, 0.1)
    dt = 10 ** rng.uniform(-4, 0.5) / max(1, np.abs(plant.a).max())
    state = after(observer, rng.normal(size=(20, 1)), rng.normal(size=(20, 1)), dt)
    np.testing.assert_array_equal(state.covariance, np.swapaxes(state.covariance, 1, 2))
    eigenvalues = np.linalg.eigvalsh(state.covariance)
    assert np.all(eigenvalues[:, 0] >= -1e-12 * eigenvalues[:, 1])
    assert np.all(np.isfinite(state.mean))


def test_a_stiff_plant_over_a_long_step_goes_to_its_stationary_law():
    plant = Linear(np.diag([-1e4, -1.0]), B, np.array([[0.0, 1e-9]]))
    observer = kalman(Problem(plant.drift, controls=Box([-1.0], [1.0]), noise=1.0), plant, 1.0)
    state = after(observer, np.zeros((1, 1)), np.zeros((1, 1)), 100.0)
    np.testing.assert_allclose(state.covariance[0], np.diag([0.5e-4, 0.5]), rtol=1e-9, atol=1e-13)


def test_units_of_time_state_and_measurement_do_not_matter():
    """x in units of 1e6, y in units of 1e-7, time in units of 1e-5."""
    record, dt = np.random.default_rng(0).normal(size=(30, 1)) * 0.3, 0.1
    plain = after(kalman(), np.ones((30, 1)), record, dt)
    t, x, y = 1e-5, 1e6, 1e-7
    plant = Linear(A * t, B * t / x, C * x / y)
    problem = Problem(plant.drift, controls=Box([-9.0], [9.0]), noise=SIGMA * np.sqrt(t) / x)
    scaled = ExtendedKalman(problem, plant.h, START / x, PRIOR / x**2, measurement_noise=R / (y * np.sqrt(t)))
    other = after(scaled, np.ones((30, 1)), record / (y * t), dt / t)
    np.testing.assert_allclose(other.mean * x, plain.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(other.covariance * x**2, plain.covariance, rtol=1e-9, atol=1e-11)


@given(seed=SEEDS)
@settings(max_examples=8)
def test_an_affine_flow_is_that_of_the_matrix_exponential(seed):
    rng = np.random.default_rng(seed)
    matrix, source, root = rng.normal(size=(3, 3)), rng.normal(size=3), rng.normal(size=(3, 3))
    noise, dt = root @ root.T, 10 ** rng.uniform(-3, 0.8)
    with jax.enable_x64(True):
        found = jax.tree.map(np.asarray, FLOW(matrix, source, noise, dt))
    big = expm(dt * np.block([[matrix, source[:, None]], [np.zeros((1, 4))]]))
    # ∫ e^{Fs} W e^{Fᵀs} ds by Gauss: nothing cancels, as it does in Van Loan's exponential over long steps
    nodes, weights = np.polynomial.legendre.leggauss(60)
    flows = expm(dt * (nodes[:, None, None] + 1) / 2 * matrix)
    spread = np.einsum("s,sij,jk,slk->il", weights * dt / 2, flows, noise, flows)
    for ours, theirs in zip(found, (big[:3, :3], big[:3, 3], spread), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-9 * np.abs(theirs).max())


FLOW = jax.jit(lambda *given: affine_flow(*given, states=3))


def swing(x, u):
    return jnp.stack([x[1], jnp.sin(x[0]) - 0.2 * x[1]])


def angle(x):
    return jnp.stack([jnp.sin(x[0]), jnp.cos(x[0])])


def test_the_linearisation_of_a_swing_is_of_second_order_without_measurement():
    """With a sensor that tells nothing, the mean follows the plant."""
    observer = ExtendedKalman(Problem(swing), angle, [1.0, 0.3], [1e-8, 1e-8], measurement_noise=1e6)
    exact = solve_ivp(lambda t, x: [x[1], np.sin(x[0]) - 0.2 * x[1]], (0, 2), [1.0, 0.3], rtol=1e-11, atol=1e-12).y[
        :, -1
    ]
    errors = []
    for count in (10, 20, 40, 80):
        state = after(observer, np.zeros((count, 0)), np.zeros((count, 2)), 2 / count)
        errors.append(np.max(np.abs(state.mean[-1] - exact)))
    assert order_of(errors) == pytest.approx(2, abs=0.2)


def test_noise_that_depends_on_the_state_counts_at_the_estimate():
    plant = Problem(lambda x, u: 0 * x, noise=lambda x, u: 2 * x)
    state = after(ExtendedKalman(plant, lambda x: 0 * x, [3.0], [0.0]), np.zeros((1, 0)), np.zeros((1, 1)), 0.1)
    assert state.covariance[0, 0, 0] == pytest.approx(3.6, rel=1e-12)


def test_correlated_sensors_count_by_their_matrix():
    """Two sensors of one state with noise r v, r a matrix: precision 1ᵀ R⁻¹ 1 per unit time."""
    root = np.array([[0.5, 0.0], [0.3, 0.2]])
    observer = ExtendedKalman(
        Problem(lambda x, u: 0 * x), lambda x: jnp.stack([x[0], x[0]]), [0.0], [2.0], measurement_noise=root
    )
    dy, dt = np.array([[0.1, 0.12]]), 0.4
    state = after(observer, np.zeros((1, 0)), dy, dt)
    inverse = np.linalg.inv(root @ root.T)
    precision = 1 / 2.0 + dt * inverse.sum()
    assert state.covariance[0, 0, 0] == pytest.approx(1 / precision, rel=1e-12)
    assert state.mean[0, 0] == pytest.approx(inverse.sum(axis=0) @ dy[0] / precision, rel=1e-12)


# --- Luenberger ---

GAIN = np.array([[4.0], [3.0]])


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.02, 0.5])
def test_the_error_of_a_luenberger_observer_falls_as_its_matrix_says(dt):
    """The record of a plant at rest, y = C x* with A x* + B u = 0: x̂ − x* = e^{(A − GC)t}(x̂₀ − x*), at any dt."""
    u = np.array([1.3])
    rest = np.linalg.solve(A, -B @ u)
    observer = Luenberger(PROBLEM, PLANT.h, GAIN, START)
    count = round(8 / dt)
    estimates = after(observer, np.tile(u, (count, 1)), np.tile(C @ rest * dt, (count, 1)), dt)
    exact = [rest + expm((A - GAIN @ C) * dt * (k + 1)) @ (START - rest) for k in range(count)]
    np.testing.assert_allclose(estimates, exact, rtol=1e-9, atol=1e-11)
    assert np.max(np.abs(estimates[-1] - rest)) < 1e-2 * np.max(np.abs(START - rest))


def test_a_nonlinear_luenberger_observer_is_of_second_order():
    """A gain that depends on the estimate; the record y(t) = (sin t, cos t), in means over the steps."""

    def gain(x):
        return 2 * jnp.stack([jnp.stack([jnp.cos(x[0]), -jnp.sin(x[0])]), jnp.stack([jnp.cos(x[0]), -jnp.sin(x[0])])])

    def rate(t, x):
        column = 2 * np.array([np.cos(x[0]), -np.sin(x[0])])
        pull = column @ (np.array([np.sin(t), np.cos(t)]) - [np.sin(x[0]), np.cos(x[0])])
        return [x[1] + pull, np.sin(x[0]) - 0.2 * x[1] + pull]

    exact = solve_ivp(rate, (0, 2), [1.0, 0.0], rtol=1e-11, atol=1e-12).y[:, -1]
    observer, errors = Luenberger(Problem(swing), angle, gain, [1.0, 0.0]), []
    for count in (20, 40, 80, 160):
        t = np.linspace(0, 2, count + 1)
        record = np.stack([-np.diff(np.cos(t)), np.diff(np.sin(t))], axis=-1)
        errors.append(np.max(np.abs(after(observer, np.zeros((count, 0)), record, 2 / count)[-1] - exact)))
    assert order_of(errors) == pytest.approx(2, abs=0.2)


# --- as values ---


def test_observers_follow_the_protocol_and_the_type_of_their_state():
    observers = [kalman(), Luenberger(PROBLEM, PLANT.h, GAIN, START)]
    for observer in observers:
        assert isinstance(observer, Observer)
        state = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), observer.initial())
        state = jax.jit(observer.update)(state, np.zeros(1), np.zeros(1), 0.1)
        assert {leaf.dtype for leaf in jax.tree.leaves(state)} == {np.dtype(np.float32)}
        assert observer.estimate(state).shape == (2,)


def test_a_batch_of_filters_is_each_of_them():
    records = np.random.default_rng(3).normal(size=(4, 1)) * 0.1
    observer = kalman()
    with jax.enable_x64(True):
        state = observer.initial()
        batch = jax.jit(jax.vmap(observer.update, (None, None, 0, None)))(state, np.zeros(1), records, 0.1)
        for k, dy in enumerate(records):
            np.testing.assert_allclose(step(observer, state, np.zeros(1), dy, 0.1).mean, batch.mean[k], rtol=1e-12)


def test_the_strength_of_the_noise_is_a_leaf():
    """Other numbers are no other program, and a derivative in them is that of differences."""
    traces = []

    @jax.jit
    def spread(r):
        traces.append(r)
        observer = ExtendedKalman(PROBLEM, PLANT.h, START, PRIOR, measurement_noise=r)
        state = observer.update(observer.initial(), jnp.zeros(1), jnp.zeros(1), 0.5)
        return jnp.trace(state.covariance)

    with jax.enable_x64(True):
        difference = (spread(0.4 + 1e-5) - spread(0.4 - 1e-5)) / 2e-5
        assert len(traces) == 1
        assert float(jax.jit(jax.jacfwd(spread))(0.4)) == pytest.approx(float(difference), rel=1e-6)


REFUSED = [
    (lambda: kalman(r=0.0), "measurement_noise = 0.0, wanted finite numbers > 0"),
    (lambda: kalman(r=[-1.0]), "wanted finite numbers > 0"),
    (lambda: kalman(r=np.nan), "wanted finite numbers > 0"),
    (lambda: kalman(r=[1.0, 2.0]), "has shape (2,), wanted a number, (1,) or (1, 1)"),
    (lambda: ExtendedKalman(PROBLEM, lambda x: x[0], START, PRIOR), "of shape (), wanted"),
    (lambda: ExtendedKalman(PROBLEM, lambda x: x[:3] * x[5], START, PRIOR), "h(x) reads"),
    (lambda: ExtendedKalman(PROBLEM, lambda x: x @ x[:1], START, PRIOR), "h(x) failed on one state"),
    (lambda: ExtendedKalman(PROBLEM, lambda x: x if x[0] > 0 else -x, START, PRIOR), "h(x) decides by Python `if`"),
    (lambda: ExtendedKalman(PROBLEM, PLANT.h, START, [[1.0, 2.0], [2.0, 1.0]]), "without negative eigenvalues"),
    (lambda: ExtendedKalman(PROBLEM, PLANT.h, START, [[1.0, 0.2], [0.1, 1.0]]), "wanted a symmetric matrix"),
    (lambda: ExtendedKalman(PROBLEM, PLANT.h, START, np.eye(3)), "covariance has shape (3, 3), wanted (2, 2)"),
    (lambda: ExtendedKalman(PROBLEM, PLANT.h, [np.inf, 0.0], PRIOR), "mean is [inf, 0.0], wanted finite"),
    (lambda: ExtendedKalman(PROBLEM, PLANT.h, [0.0] * 3, np.eye(3)), "drift(x, u) "),
    (lambda: ExtendedKalman(Problem(lambda t, x, u: x, time_dependent=True), PLANT.h, START, PRIOR), "time_dependent"),
    (
        lambda: ExtendedKalman(Problem(lambda x, u, d: x, disturbances=Box([-1.0], [1.0])), PLANT.h, START, PRIOR),
        "got a problem with disturbances",
    ),
    (
        lambda: ExtendedKalman(PROBLEM, lambda x: x, START, PRIOR, measurement_noise=[[1.0, 2.0], [2.0, 4.0]]),
        "a finite matrix with an inverse",
    ),
    (lambda: Luenberger(PROBLEM, PLANT.h, [[1.0, 2.0]], START), "gain has shape (1, 2), wanted (n, p) = (2, 1)"),
    (lambda: Luenberger(PROBLEM, PLANT.h, lambda x: x, START), "gain has shape (2,), wanted (n, p) = (2, 1)"),
    (lambda: Luenberger(PROBLEM, PLANT.h, [[np.nan], [0.0]], START), "wanted finite numbers"),
]


@pytest.mark.parametrize(("call", "reason"), REFUSED, ids=[reason for _, reason in REFUSED])
def test_refusals_say_what_is_wrong(call, reason):
    refused(call, reason)


def test_what_is_no_problem_or_no_function_is_refused():
    with pytest.raises(TypeError, match="wanted a Problem"):
        ExtendedKalman(PLANT.drift, PLANT.h, START, PRIOR)
    with pytest.raises(TypeError, match="wanted a function"):
        ExtendedKalman(PROBLEM, 3.0, START, PRIOR)
    assert isinstance(kalman().initial(), Gaussian)
