"""The law of the state on a grid against Kalman and Bucy, V. E. Beneš, Bayes, and SciPy's exponential of the chain."""

from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from orders import order_of
from refusals import refused
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from systems import SEEDS, random_grid, random_problem

from hjbjax.filtering import grid_filter
from hjbjax.filtering.information_state import GridFilter, zakai
from hjbjax.filtering.observers import Observer
from hjbjax.markov_chain import chain, forward_equation
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast
from hjbjax.problem.sets import Box
from hjbjax.problem.stretching import Sinh

R = 0.5


def identity(x):
    return x


def first(x):
    return x[:1]


def decay(x, u):
    return -x


def gauss(mean, variance):
    return lambda x: jnp.exp(-jnp.sum((x - jnp.asarray(mean)) ** 2 / (2 * jnp.asarray(variance))))


def measured(t):
    return 1.5 * np.cos(1.5 * t) + 0.3


def increments(times):
    return np.diff(np.sin(1.5 * times) + 0.3 * times)[:, None]


def bucy(a, c, noise, mean, covariance, end, r=R):
    """Mean, covariance and log-likelihood by Kalman and Bucy's equations for the record dy = y(t) dt."""
    n = len(mean)

    def rate(t, z):
        x, p = z[:n], z[n : n + n * n].reshape(n, n)
        gain, seen = p @ c.T / r**2, c @ x
        dx = a @ x + gain @ (measured(t) - seen)
        dp = a @ p + p @ a.T + noise @ noise.T - gain @ gain.T * r**2
        # d log ∫q = (E h y − ½ E|h|²) dt/r² for a record without noise, as a smooth record has it (Stratonovich)
        dl = (seen @ np.full(1, measured(t)) - 0.5 * (seen @ seen + np.trace(c @ p @ c.T))) / r**2
        return np.concatenate([dx, dp.ravel(), [dl]])

    begin = np.concatenate([mean, np.ravel(covariance), [0.0]])
    z = solve_ivp(rate, (0, end), begin, rtol=1e-11, atol=1e-12).y[:, -1]
    return z[:n], z[n : n + n * n].reshape(n, n), z[-1]


# --- linear plants ---


@pytest.mark.slow
def test_a_linear_plant_is_kalman_and_bucys_with_second_order():
    mean, covariance, likelihood = bucy(*(np.array([[k]]) for k in (-1.0, 1.0, 0.8)), [0.5], [[0.4]], 2.0)
    errors = []
    for count in (33, 65, 129):
        steps = (count - 1) // 2
        times = np.linspace(0, 2, steps + 1)
        grid = Grid([-5.0], [5.0], (count,))
        law = zakai(
            Problem(decay, noise=0.8), identity, grid, increments(times), times[1], gauss(0.5, 0.4), measurement_noise=R
        )
        errors.append(
            [
                abs(law.mean[-1, 0] - mean[0]),
                abs(law.covariance[-1, 0, 0] - covariance[0, 0]),
                abs(law.log_likelihood[-1] - likelihood),
            ]
        )
    assert law.density.shape == (64, 129)
    for column in np.transpose(errors):
        assert order_of(column) >= 1.8
    assert np.max(errors[-1]) < 5e-3


@pytest.mark.slow
def test_an_oscillator_whose_position_has_no_noise_is_kalman_and_bucys_with_first_order():
    a, c, noise = np.array([[0.0, 1.0], [-1.0, -0.5]]), np.array([[1.0, 0.0]]), np.diag([0.0, 0.8])
    mean, covariance, _ = bucy(a, c, noise, [0.5, 0.0], 0.3 * np.eye(2), 1.0)
    errors = []
    for count in (21, 41, 81):
        times = np.linspace(0, 1, (count - 1) // 2 + 1)
        law = zakai(
            Problem(lambda x, u: jnp.stack([x[1], -x[0] - 0.5 * x[1]]), noise=[0.0, 0.8]),
            first, Grid([-4.0, -4.0], [4.0, 4.0], (count, count)), increments(times), times[1],
            gauss([0.5, 0.0], 0.3), measurement_noise=R,
        )  # fmt: skip
        errors.append([np.max(np.abs(law.mean[-1] - mean)), np.max(np.abs(law.covariance[-1] - covariance))])
    for column in np.transpose(errors):
        assert order_of(column) >= 0.85
    assert np.all(np.diff(np.log2(errors), axis=0)[-1] < -0.9)  # from 41 to 81 nodes


def test_a_control_on_record_moves_the_law():
    """dx = u dt without measurement worth the name: the mean is ∫u dt."""
    controls = np.array([[1.0], [1.0], [-0.5], [0.0]])
    problem = Problem(lambda x, u: u, controls=Box([-1.0], [1.0]), noise=0.3)
    law = zakai(
        problem, identity, Grid([-4.0], [4.0], (161,)), np.zeros((4, 1)), 0.5, gauss(0.0, 0.2),
        controls=controls, measurement_noise=1e6,
    )  # fmt: skip
    np.testing.assert_allclose(law.mean[:, 0], [0.5, 1.0, 0.75, 0.75], atol=1e-9)
    np.testing.assert_allclose(law.covariance[-1, 0, 0], 0.2 + 4 * 0.5 * 0.09, rtol=1e-2)


# --- Beneš ---


@pytest.mark.slow
def test_the_filter_of_benes():
    """dx = tanh x dt + dw, dy = x dt + r dv: q ∝ cosh x · N(m, P) with m and P those of dx = dw."""
    mean, variance, _ = bucy(*(np.array([[k]]) for k in (0.0, 1.0, 1.0)), [0.3], [[0.5]], 1.5)
    errors = []
    for count in (41, 81, 161):
        times = np.linspace(0, 1.5, (count - 1) // 4 + 1)
        grid = Grid([-7.0], [7.0], (count,))
        law = zakai(
            Problem(lambda x, u: jnp.tanh(x), noise=1.0), identity, grid, increments(times), times[1],
            lambda x: jnp.cosh(x[0]) * gauss(0.3, 0.5)(x), measurement_noise=R,
        )  # fmt: skip
        x = np.asarray(grid.axis(0))
        exact = np.cosh(x) * np.exp(-((x - mean[0]) ** 2) / (2 * variance[0, 0]))
        exact /= np.sum(exact * grid.volumes())
        errors.append(np.max(np.abs(law.density[-1] - exact)))
    assert order_of(errors) >= 1.8
    assert errors[-1] < 2e-3


# --- Bayes ---


@pytest.mark.filterwarnings("ignore:.*narrower than a cell")
def test_a_state_that_rests_is_bayes_to_rounding():
    """No drift and no noise: the prior times the likelihood of y(t), node by node, whatever the steps."""
    rng = np.random.default_rng(4)
    grid = Grid([-2.0, 0.0], [2.0, 1.0], (9, 8), (False, True), stretch=(Sinh(2.0), None))
    root = np.array([[0.4, 0.0], [0.2, 0.3]])

    def h(x):
        return jnp.stack([x[0] * jnp.cos(2 * jnp.pi * x[1]), x[0] ** 2])

    record, prior = rng.normal(size=(6, 2)) * 0.2, rng.uniform(0.1, 1, grid.shape)
    law = zakai(Problem(lambda x, u: 0 * x), h, grid, record, 0.2, prior, measurement_noise=root)
    nodes = grid.nodes()
    signal = np.stack([nodes[..., 0] * np.cos(2 * np.pi * nodes[..., 1]), nodes[..., 0] ** 2], axis=-1)
    inverse, total = np.linalg.inv(root @ root.T), np.cumsum(record, axis=0)
    for k in range(6):
        exponent = signal @ inverse @ total[k] - 0.1 * (k + 1) * np.einsum("...i,ij,...j", signal, inverse, signal)
        exact = prior * np.exp(exponent)
        density = exact / np.sum(exact * grid.volumes())
        np.testing.assert_allclose(law.density[k], density, rtol=1e-11)
        # the chain's own mass: whole cells at ends without noise, of which the box holds one half
        cells = grid.volumes() * np.where(np.isin(np.arange(9), (0, 8)), 2, 1)[:, None]
        likelihood = np.sum(exact * cells) / np.sum(prior * cells)
        assert law.log_likelihood[k] == pytest.approx(np.log(likelihood), rel=1e-10)
        assert tuple(law.mode[k]) == tuple(nodes[np.unravel_index(np.argmax(density), grid.shape)])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*at an end of the box", "ignore:.*narrower than a cell")
@pytest.mark.parametrize("size", [pytest.param(1e3, marks=pytest.mark.slow), 1e8])
def test_records_of_any_size_leave_no_mass_behind(size):
    """Factors of e^{±size} neither overflow nor vanish; at first the law sits where the record points."""
    grid = Grid([-1.0], [1.0], (21,))
    records = np.array([[[size], [-size]], [[-size], [0.0]]])
    law = zakai(Problem(decay, noise=0.3), identity, grid, records, 0.1, np.ones(21))
    sums = np.sum(law.density * grid.volumes(), axis=-1)
    np.testing.assert_allclose(sums, 1, atol=1e-12)
    assert np.all(law.density >= 0)
    np.testing.assert_allclose(law.mode[:, 0], [[1.0], [-1.0]])
    assert np.all(np.isfinite(law.log_likelihood))
    unnormalised = zakai(Problem(decay, noise=0.3), identity, grid, [[0.3]], 0.1, np.ones(21), normalised=False)
    assert np.sum(unnormalised.density * grid.volumes()) == pytest.approx(
        np.exp(unnormalised.log_likelihood[0]), rel=1e-12
    )


# --- the chain ---


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore:.*at an end of the box", "ignore:.*narrower than a cell", "ignore:.*dt = .* is longer"
)
@pytest.mark.parametrize(
    ("n", "kind"),
    [*(pytest.param(*case, marks=pytest.mark.slow) for case in [(2, "matrix"), (3, "diagonal")]), (2, "none")],
)
@given(seed=SEEDS)
@settings(max_examples=6)
def test_laws_of_random_systems_are_laws_and_those_of_the_exponential_of_the_chain(n, kind, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    problem = random_problem(rng, grid, kind)
    prior, record = rng.uniform(0, 1, grid.shape), rng.normal(size=(3, 1)) * 10 ** rng.uniform(-2, 2)
    controls, dt = rng.uniform(-1, 1, (3, 1)), 10 ** rng.uniform(-4, 0)
    law = zakai(problem, SENSOR, grid, record, dt, prior, controls=controls, measurement_noise=0.7)
    assert np.all(law.density >= 0)
    volumes = grid.volumes()
    np.testing.assert_allclose(np.sum(law.density * volumes, axis=tuple(range(1, n + 1))), 1, atol=1e-10)
    # by SciPy, on the matrix that the package exports
    noise = np.broadcast_to(0.0 if problem.noise is None else problem.noise, (n, n) if kind == "matrix" else (n,))
    cells = volumes
    for axis in range(n):
        if not grid.periodic[axis] and not np.any(noise[axis]):  # whole cells at ends without noise
            ends = np.isin(np.arange(grid.shape[axis]), (0, grid.shape[axis] - 1))
            cells = cells * (1 + ends.reshape([-1 if i == axis else 1 for i in range(n)]))
    p, signal = (prior * cells).ravel(), np.cos(grid.nodes()[..., 0]).ravel()
    dt = 0.02 / max(
        1.0, -min(generator_of(problem, grid, u).diagonal().min() for u in controls)
    )  # so that its steps are resolved
    record = rng.normal(size=(3, 1)) * 0.5  # a large one makes of the error of a step at a node e^{dy} times as much
    # the law of the chain itself, without the flux that takes the diffusion of upwinding away
    with mock.patch.object(grid_filter, "_check_rates", return_value=()):
        law = zakai(problem, SENSOR, grid, record, dt, prior, controls=controls, measurement_noise=0.7)
    p /= p.sum()
    for dy, u in zip(record[:, 0], controls, strict=True):
        factor = np.exp((signal * dy - signal**2 * dt / 2) / (2 * 0.7**2))
        p = factor * (expm(dt * generator_of(problem, grid, u).T) @ (factor * p))
    density = (p / cells.ravel()).reshape(grid.shape)
    density /= np.sum(density * volumes)
    np.testing.assert_allclose(law.density[-1], density, atol=1e-4 * density.max())
    assert law.log_likelihood[-1] == pytest.approx(np.log(p.sum()), abs=1e-4)


def generator_of(problem, grid, u):
    return chain.generator(problem, grid, np.broadcast_to(u, (*grid.shape, 1))).toarray()


def SENSOR(x):
    return jnp.cos(x[:1])


@pytest.mark.parametrize("stretch", [pytest.param(None, marks=pytest.mark.slow), (Sinh(2.5, 0.0),)])
def test_walls_keep_a_flat_density_flat(stretch):
    grid = Grid([0.0], [2.0], (31,), stretch=stretch)
    law = zakai(Problem(lambda x, u: 0 * x, noise=1.0), lambda x: 0 * x, grid, np.zeros((2, 1)), 0.5, np.ones(31))
    np.testing.assert_allclose(law.density, 0.5, rtol=1e-10)
    assert law.log_likelihood[-1] == pytest.approx(0, abs=1e-12)


@pytest.mark.slow
def test_after_a_long_time_without_news_the_law_is_the_stationary_one():
    grid = Grid([-3.0], [3.0], (41,))
    problem = Problem(decay, noise=1.0)
    law = zakai(problem, lambda x: 0 * x, grid, np.zeros((1, 1)), 40.0, np.ones(41))
    np.testing.assert_allclose(law.density[0], chain.stationary_density(problem, grid), atol=1e-9)


# --- angles ---


def test_means_on_a_ring_are_circular():
    """A law across the seam: the mean is near π, not near 0, and the covariance that of the short way."""
    grid = Grid([-np.pi, -1.0], [np.pi, 1.0], (400, 5), (True, False))
    x = np.asarray(grid.axis(0))
    off = np.mod(x - 3.0 + np.pi, 2 * np.pi) - np.pi
    along = np.exp(-(off**2) / (2 * 0.04))
    p = along[:, None] * np.array([0.0, 1.0, 2.0, 1.0, 0.0])
    with jax.enable_x64(True):
        p = jnp.asarray(p / p.sum())
        np.testing.assert_allclose(forward_equation.mean(grid, p), [3.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(forward_equation.covariance(grid, p), np.diag([0.04, 0.125]), atol=1e-9)
        turned = jnp.roll(p, 57, axis=0)
        np.testing.assert_allclose(forward_equation.covariance(grid, turned), np.diag([0.04, 0.125]), atol=1e-9)
        np.testing.assert_allclose(forward_equation.mode(grid, turned), [x[(np.argmax(along) + 57) % 400], 0.0])


@pytest.mark.slow
def test_a_phase_that_runs_round_is_followed():
    """dθ = 2 dt + noise, measured by its sine and cosine, over several turns."""
    problem = Problem(lambda x, u: 2 + 0 * x, noise=0.2)
    grid = Grid([0.0], [2 * np.pi], (96,), (True,))
    t = np.linspace(0, 8, 161)
    record = np.stack([np.diff(-np.cos(2 * t + 1) / 2), np.diff(np.sin(2 * t + 1) / 2)], axis=-1)
    law = zakai(
        problem, lambda x: jnp.stack([jnp.sin(x[0]), jnp.cos(x[0])]), grid, record, t[1], np.ones(96),
        measurement_noise=0.2,
    )  # fmt: skip
    off = np.mod(law.mean[20:, 0] - (2 * t[21:] + 1) + np.pi, 2 * np.pi) - np.pi
    assert np.max(np.abs(off)) < 0.05
    assert np.all((law.mean >= 0) & (law.mean < 2 * np.pi))


# --- as values ---


SMALL = Grid([-3.0], [3.0], (31,))
NOISY = Problem(decay, noise=0.8)


def observer():
    return GridFilter(NOISY, identity, SMALL, gauss(0.0, 1.0), measurement_noise=R)


def test_zakai_is_a_scan_of_the_filter():
    record = np.random.default_rng(1).normal(size=(5, 1)) * 0.3
    law = zakai(NOISY, identity, SMALL, record, 0.1, gauss(0.0, 1.0), measurement_noise=R)
    filtering = observer()
    assert isinstance(filtering, Observer)
    with jax.enable_x64(True):
        state = filtering.initial()
        update = jax.jit(filtering.update)
        for k in range(5):
            state = update(state, np.zeros(0), record[k], 0.1)
            np.testing.assert_allclose(state.density, law.density[k], rtol=1e-10)
            np.testing.assert_allclose(filtering.estimate(state), law.mean[k], rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(filtering.covariance(state), law.covariance[k], rtol=1e-9)
            np.testing.assert_allclose(filtering.mode(state), law.mode[k])


@pytest.mark.slow
def test_a_batch_of_records_is_each_of_them():
    rng = np.random.default_rng(2)
    problem = Problem(lambda x, u: u - x, controls=Box([-1.0], [1.0]), noise=0.8)
    records, controls = rng.normal(size=(3, 6, 1)) * 0.3, rng.uniform(-1, 1, (3, 6, 1))
    batch = zakai(problem, identity, SMALL, records, 0.1, np.ones(31), controls=controls)
    shared = zakai(problem, identity, SMALL, records, 0.1, np.ones(31), controls=controls[1])
    assert batch.density.shape == (3, 6, 31)
    for k in range(3):
        alone = zakai(problem, identity, SMALL, records[k], 0.1, np.ones(31), controls=controls[k])
        for one, many in zip(jax.tree.leaves(alone), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(one, many[k], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(shared.density[1], batch.density[1], rtol=1e-9)


def test_inside_jit_vmap_and_grad():
    """The derivative of the likelihood in the strength of the noise is that of differences."""
    record = np.random.default_rng(5).normal(size=(4, 1)) * 0.2

    def likelihood(sigma):
        law = zakai(
            Problem(lambda x, u: -sigma * x, noise=sigma),
            identity,
            SMALL,
            record,
            0.05,
            gauss(0.0, 1.0),
            measurement_noise=R,
        )
        return law.log_likelihood[-1]

    with jax.enable_x64(True):
        slope = jax.jit(jax.jacfwd(likelihood))(0.8)
        values = jax.jit(jax.vmap(likelihood))(jnp.array([0.8 - 1e-4, 0.8 + 1e-4]))
    low, high = np.asarray(values)
    assert float(slope) == pytest.approx((high - low) / 2e-4, rel=1e-5)


def test_single_precision_stays_single_and_near():
    record = np.random.default_rng(6).normal(size=(8, 1)) * 0.3
    law = zakai(NOISY, identity, SMALL, record, 0.1, gauss(0.0, 1.0), measurement_noise=R)
    filtering = cast(observer(), np.float32)
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), filtering.initial())
    update = jax.jit(filtering.update)
    for dy in record.astype(np.float32):
        state = update(state, np.zeros(0, np.float32), dy, np.float32(0.1))
    assert state.density.dtype == np.float32
    np.testing.assert_allclose(state.density, law.density[-1], atol=1e-5)
    single = zakai(NOISY, identity, SMALL, record.astype(np.float32), 0.1, gauss(0.0, 1.0), measurement_noise=R)
    assert single.density.dtype == np.float64


# --- refusals ---

FLAT = np.ones(31)
DRIVEN = Problem(lambda x, u: u, controls=Box([-1.0], [1.0]), noise=1.0)
SPIKE = np.where(np.arange(31) == 7, np.nan, 1.0)


def ask(problem=NOISY, h=identity, grid=SMALL, dy=((0.1,),), dt=0.1, prior=FLAT, **options):
    return zakai(problem, h, grid, dy, dt, prior, **options)


REFUSED = [
    (lambda: ask(dt=0.0), "dt = 0.0; wanted a finite number > 0"),
    (lambda: ask(dt=-0.1), "dt = -0.1; wanted"),
    (lambda: ask(dy=[0.1, 0.2]), "dy has shape (2,), wanted (k, 1)"),
    (lambda: ask(dy=[[0.1, 0.2]]), "dy has shape (1, 2), wanted (k, 1)"),
    (lambda: ask(dy=[[np.nan], [0.0]]), "wanted finite numbers. If a measurement is missing"),
    (lambda: ask(prior=0 * FLAT), "zero at every node"),
    (lambda: ask(prior=-FLAT), "not a finite number ≥ 0 at 31 nodes, the first (0,)"),
    (lambda: ask(prior=SPIKE), "not a finite number ≥ 0 at 1 nodes, the first (7,)"),
    (lambda: ask(prior=np.ones(30)), "initial_density has shape (30,), wanted the shape of the grid, (31,)"),
    (lambda: ask(prior=lambda x: x), "initial_density(x) returned shape (1,), expected one number"),
    (lambda: ask(h=lambda x: x[0]), "h(x) returned"),
    (lambda: ask(h=lambda x: jnp.log(x)), "h(x) is not finite at"),
    (lambda: ask(measurement_noise=0.0), "wanted finite numbers > 0"),
    (lambda: ask(measurement_noise=-1.0), "wanted finite numbers > 0"),
    (lambda: ask(Problem(lambda x, u: jnp.log(x), noise=1.0)), "a jump rate, made of drift and noise, is not finite"),
    (lambda: ask(grid=Grid([-1.0], [1.0], (31,), edges="open")), "open ends, where mass would leave"),
    (lambda: ask(controls=[[1.0]]), "controls has shape (1, 1), wanted (1, 0)"),
    (lambda: ask(DRIVEN), "controls is None, but the problem has 1"),
    (lambda: ask(DRIVEN, controls=[[1.0], [1.0]]), "controls has shape (2, 1), wanted (1, 1)"),
    (lambda: ask(DRIVEN, controls=[[np.inf]]), "controls[0] = [inf], wanted finite numbers"),
    (lambda: ask(Problem(lambda x, u: x[:1] * jnp.ones(2))), "drift(x, u) "),
]


@pytest.mark.parametrize(("call", "reason"), REFUSED, ids=[reason for _, reason in REFUSED])
def test_refusals_say_what_is_wrong(call, reason):
    refused(call, reason)


def test_noise_that_is_correlated_too_much_is_refused():
    problem = Problem(lambda x, u: 0 * x, noise=np.array([[1.0, 0.0], [1.0, 0.1]]))
    with pytest.raises(ValueError, match="correlated more than the spacings allow"):
        GridFilter(problem, first, Grid([-1.0, -1.0], [1.0, 1.0], (5, 21)), np.ones((5, 21)))


def test_what_is_no_grid_is_refused():
    with pytest.raises(TypeError, match="wanted a Grid"):
        GridFilter(NOISY, identity, (31,), FLAT)
