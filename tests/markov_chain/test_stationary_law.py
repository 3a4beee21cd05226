"""Stationary densities against Gauss, Gibbs and a tilted ring, with fitted orders; laws against QuantEcon."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from orders import order_of
from systems import SEEDS, random_grid, random_problem

from hjbjax.discretisation.schemes import Upwind
from hjbjax.markov_chain import chain, stationary_law
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import Box
from hjbjax.problem.stretching import Sinh

COUNTS = (65, 129, 257)


def ornstein_uhlenbeck(x, u):
    return -x


def double_well(x, u):
    """−U' for U = x⁴ − 2x²."""
    return 4 * (x - x**3)


def gibbs(potential, sigma, lo, hi):
    """exp(−2U/σ²) with integral one over the box."""
    z = np.linspace(lo, hi, 20_001)
    total = np.trapezoid(np.exp(-2 * potential(z) / sigma**2), z)
    return lambda x: np.exp(-2 * potential(x) / sigma**2) / total


@pytest.mark.parametrize(("central", "order"), [(True, 2), (False, 1)])
@pytest.mark.parametrize("system", ["Ornstein-Uhlenbeck", "double well"])
def test_gauss_and_gibbs(system, central, order):
    if system == "double well":
        drift, sigma, reach, exact = double_well, 1.2, 2.5, gibbs(lambda x: x**4 - 2 * x**2, 1.2, -2.5, 2.5)
    else:
        drift, sigma, reach = ornstein_uhlenbeck, 1.0, 4.0

        def exact(x):
            return np.exp(-(x**2)) / np.sqrt(np.pi)

    errors = []
    for count in COUNTS:
        grid = Grid([-reach], [reach], (count,))
        density = chain.stationary_density(Problem(drift, noise=sigma), grid, scheme=Upwind(central=central))
        errors.append(np.max(np.abs(density - exact(np.asarray(grid.axis(0))))))
    assert order_of(errors) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("shape", ["stretched", "uniform"])
def test_a_wall_that_reflects_has_the_density_of_the_inside(shape):
    """dx = −dt + σ dw above a wall: exp(−2x/σ²), up to the wall itself; without drift it is flat."""
    stretch = (Sinh(2.0, 0.0),) if shape == "stretched" else None
    exact = gibbs(lambda x: x, 1.0, 0.0, 4.0)
    errors, at_the_wall = [], []
    for count in COUNTS:
        grid = Grid([0.0], [4.0], (count,), stretch=stretch)
        density = chain.stationary_density(Problem(lambda x, u: -jnp.ones(1), noise=1.0), grid)
        off = np.abs(density - exact(np.asarray(grid.axis(0))))
        errors.append(np.max(off[1:]))
        at_the_wall.append(off[0])
    assert order_of(errors) == pytest.approx(2, abs=0.15)
    assert order_of(at_the_wall) >= 1.85
    flat = chain.stationary_density(Problem(lambda x, u: 0 * x, noise=1.0), grid)
    np.testing.assert_allclose(flat, 0.25, rtol=1e-9)


def test_integrals_are_one_by_the_volumes_of_the_nodes():
    grid = Grid([-4.0, 0.0], [4.0, 1.0], (41, 10), (False, True), stretch=(Sinh(3.0), None))
    assert grid.volumes().shape == grid.shape
    assert grid.volumes().sum() == pytest.approx(8.0, rel=1e-12)
    assert grid.volumes()[0, 0] == pytest.approx((grid.axis(0)[1] - grid.axis(0)[0]) / 2 / 10, rel=1e-12)
    density = chain.stationary_density(Problem(lambda x, u: jnp.stack([-x[0], 1.0]), noise=[1.0, 0.5]), grid)
    assert np.sum(density * grid.volumes()) == pytest.approx(1, rel=1e-12)
    assert np.ptp(density, axis=1).max() < 1e-12  # as on a ring with a constant drift


def tilted(x, force, sigma):
    """dx = (F + sin x) dt + σ dw on a ring: p ∝ ∫₀^{2π} exp(φ(x + y) − φ(x)) dy, φ = −2(Fx − cos x)/σ², J ≠ 0."""
    y = np.linspace(0, 2 * np.pi, 2001)

    def phi(z):
        return -2 / sigma**2 * (force * z - np.cos(z))

    rows = phi(x[:, None] + y) - phi(x)[:, None]
    p = np.trapezoid(np.exp(rows), y)
    return p / (np.mean(p) * 2 * np.pi)


def test_a_ring_with_a_current():
    errors = []
    for count in (64, 128, 256):
        grid = Grid([0.0], [2 * np.pi], (count,), (True,))
        density = chain.stationary_density(Problem(lambda x, u: 0.5 + jnp.sin(x), noise=0.8), grid)
        errors.append(np.max(np.abs(density - tilted(np.asarray(grid.axis(0)), 0.5, 0.8))))
    assert order_of(errors) == pytest.approx(2, abs=0.15)


def test_a_damped_oscillator_under_noise():
    """dx = v dt, dv = (−x − v) dt + σ dw: Gauss, var x = var v = σ²/2; first order since x has no noise."""
    errors = []
    for count in (33, 65, 129):
        grid = Grid([-4.0, -4.0], [4.0, 4.0], (count, count))
        problem = Problem(lambda x, u: jnp.stack([x[1], -x[0] - x[1]]), noise=[0.0, 1.0])
        density = chain.stationary_density(problem, grid)
        weights = density * grid.volumes()
        errors.append(abs(np.sum(weights * grid.nodes()[..., 0] ** 2) - 0.5))
    assert order_of(errors) == pytest.approx(1, abs=0.15)


def test_a_density_under_the_policy_that_was_found():
    """LQ: u = −p x makes a Gauss of variance σ²/2p."""
    from hjbjax.solvers.stationary import solve

    problem = Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, Box([-9.0], [9.0]), noise=1.0, discount=1.0)
    grid = Grid([-5.0], [5.0], (201,))
    density = chain.stationary_density(problem, grid, solve(problem, grid).policy)
    p = (np.sqrt(5) - 1) / 2
    exact = np.exp(-p * np.asarray(grid.axis(0)) ** 2) * np.sqrt(p / np.pi)
    np.testing.assert_allclose(density, exact, rtol=0, atol=2e-3)


# --- laws of matrices ---


@pytest.mark.parametrize(
    ("n", "kind"),
    [
        (1, "scalar"),
        pytest.param(2, "matrix", marks=pytest.mark.slow),
        (2, "none"),
        pytest.param(3, "diagonal", marks=pytest.mark.slow),
    ],
)
@given(seed=SEEDS)
@settings(max_examples=15)
def test_quantecon_finds_the_same_law(n, kind, seed):
    quantecon = pytest.importorskip("quantecon")
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    problem, policy = random_problem(rng, grid, kind), rng.uniform(-1, 1, (*grid.shape, 1))
    generator = chain.generator(problem, grid, policy)
    theirs = quantecon.MarkovChain(chain.matrix(problem, grid, policy).toarray())
    found = stationary_law.classes(generator)
    assert sorted(map(tuple, found)) == sorted(map(tuple, theirs.recurrent_classes))
    for states in found:
        ours, error = stationary_law.law(generator, states)
        by_them = next(p for p in theirs.stationary_distributions if p[states].sum() > 0.5)
        assert 0.5 * np.abs(ours - by_them).sum() <= error + 1e-9
        assert error < 1e-9


def test_a_law_over_many_orders_of_magnitude_is_found_from_its_peak():
    """exp(−x²) up to x = 36: seen from the middle of the box, where nobody comes, rounding would decide."""
    grid = Grid([-12.0], [36.0], (481,))
    problem, plain = Problem(ornstein_uhlenbeck, noise=1.0), Upwind(central=False)
    assert [len(states) for states in stationary_law.classes(chain.generator(problem, grid, scheme=plain))] == [481]
    density = chain.stationary_density(problem, grid, scheme=plain)
    assert density.max() == pytest.approx(1 / np.sqrt(np.pi), rel=0.05)
    assert density[-1] == pytest.approx(0, abs=1e-100)
    assert np.sum(density * grid.volumes()) == pytest.approx(1, rel=1e-12)


def test_the_bound_on_rounding_holds_where_wells_hardly_exchange():
    """The exact law of a symmetric well is symmetric; the shallower the barrier, the smaller both numbers."""
    grid = Grid([-2.0], [2.0], (257,))
    asymmetry, bounds = [], []
    for sigma in (0.8, 0.6, 0.5):
        generator = chain.generator(Problem(double_well, noise=sigma), grid)
        found, bound = stationary_law.law(generator, np.arange(257))
        asymmetry.append(0.5 * np.abs(found - found[::-1]).sum())
        bounds.append(bound)
    assert np.all(np.array(asymmetry) <= bounds)
    assert bounds[0] < bounds[1] < bounds[2] < 1e-6


# --- refusals ---


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"target": lambda x: x[0]}, r"a problem with a target, where paths end"),
        ({"noise": 0.3}, r"rounding may move 0.00\d+ of the probability between them, wanted at most 1e-06"),
        ({"noise": None}, r"got 3 recurrent classes, wanted one.*\n.*states \[-1.\] and \[0.\], 1 and 1 nodes"),
    ],
)
def test_chains_without_one_law_are_refused(changes, reason):
    problem = Problem(**({"drift": double_well, "noise": 1.0} | changes))
    with pytest.raises(ValueError, match=reason) as caught:
        chain.stationary_density(problem, Grid([-2.0], [2.0], (257,)))
    assert len(str(caught.value).splitlines()) <= 6


@pytest.mark.slow
def test_where_everything_comes_to_rest_the_density_is_a_spike():
    """ẋ = −x: the node at zero holds all of it."""
    density = chain.stationary_density(Problem(ornstein_uhlenbeck), Grid([-1.0], [1.0], (21,)))
    assert density[10] == pytest.approx(10.0)
    assert np.count_nonzero(density) == 1
