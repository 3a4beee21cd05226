"""Walls on the node: reflected processes with known answers, to second order, and what the chain does at a wall."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from orders import order_of
from scipy.sparse.linalg import spsolve
from systems import SEEDS

import hjbjax as hjb
from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import jump_rates
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.markov_chain import chain
from hjbjax.problem.stretching import Sinh

SIGMA = 0.5


def hitting_time(x, drift):
    """Mean time from x to 0 on [0, 1] with a wall at 1: ½σ²T″ + bT′ = −1, T(0) = 0, T′(1) = 0."""
    if drift == 0:
        return (2 * x - x**2) / SIGMA**2
    rate = 2 * drift / SIGMA**2
    return -x / drift + np.exp(rate) * (1 - np.exp(-rate * x)) / (rate * drift)


def resolvent(problem, grid, source, discount=0.0, held=None, **how):
    """V with (β − 𝓛)V = source, zero at the held nodes."""
    generator = chain.generator(problem, grid, **how).tocsc()
    free = np.ones(grid.size, bool) if held is None else ~held.ravel()
    value = np.zeros(grid.size)
    rows = generator[free][:, free]
    system = rows * -1.0
    system.setdiag(discount - rows.diagonal())
    value[free] = spsolve(system, np.broadcast_to(source, grid.shape).ravel()[free])
    return value.reshape(grid.shape)


# --- reflected hitting and exit times ---


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [hjb.Upwind(), hjb.Limited()])
def test_the_shortest_hitting_time_off_a_wall(scheme):
    """dx = u dt + ½ dw, |u| ≤ 1, to x = 0: u = −1 and T = x − (e^{−λ(1−x)} − e^{−λ})/λ with λ = 2/σ²."""
    rate, errors = 2 / SIGMA**2, []
    for count in (201, 401):
        grid = hjb.Grid([0.0], [1.0], (count,))
        problem = hjb.Problem(
            lambda x, u: u, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), noise=SIGMA, target=lambda x: x[0]
        )
        solution = hjb.solve(problem, grid, scheme=scheme, tol=1e-8)
        x = np.asarray(grid.axis(0))
        errors.append(np.max(np.abs(solution.value - x + (np.exp(-rate * (1 - x)) - np.exp(-rate)) / rate)))
        assert np.all(solution.policy[1:] == -1)
    assert errors[-1] <= 3e-6  # 1.2e-3 with the wall half a spacing further out
    assert order_of(errors) >= 1.8


@pytest.mark.parametrize("edges", ["projected", "constrained"])
@pytest.mark.parametrize("stretch", [None, (Sinh(2.0, 0.0),)])
@pytest.mark.parametrize("drift", [-1.0, 0.0, 0.4])
def test_hitting_times_with_drift_inwards_none_and_outwards(drift, stretch, edges):
    if drift > 0 and edges == "constrained":
        pytest.skip("outward drift is not admissible there")
    problem, errors = hjb.Problem(lambda x, u: drift + 0 * x, noise=SIGMA), []
    for count in (51, 101, 201):
        grid = hjb.Grid([0.0], [1.0], (count,), stretch=stretch, edges=[("projected", edges)])
        x = np.asarray(grid.axis(0))
        exact = hitting_time(x, drift)
        errors.append(np.max(np.abs(resolvent(problem, grid, 1.0, held=x == 0) - exact)) / exact[-1])
    if drift == 0:  # a parabola
        assert max(errors) <= 1e-10
        return
    assert errors[-1] <= 5e-4
    assert order_of(errors) >= 1.8


def test_the_exit_time_of_a_reflected_brownian_motion():
    """From [0, 1) with a wall at 0: (1 − x²)/σ², a parabola, which the mirror image has exactly."""
    grid = hjb.Grid([0.0], [1.0], (41,))
    problem = hjb.Problem(lambda x, u: 0 * x, noise=SIGMA)
    found = hjb.expected_exit_time(problem, grid, lambda x: 1 - x[0], tol=1e-10)
    np.testing.assert_allclose(found.value, (1 - np.asarray(grid.axis(0)) ** 2) / SIGMA**2, atol=1e-8)


@pytest.mark.slow
def test_a_target_inside_the_last_cell():
    """From a wall at 1 to the boundary at 1 − d, which cuts its only link: d²/σ²."""
    grid = hjb.Grid([0.0], [1.0], (11,))
    problem = hjb.Problem(
        lambda x, u: 0 * x, lambda x, u: 1.0, noise=SIGMA, target=lambda x: x[0] - 0.93, exit_cost=lambda x: 0.0
    )
    found = hjb.solve(problem, grid, scheme=hjb.Upwind(subcell=True), tol=1e-10)
    assert found.value[-1] == pytest.approx(0.07**2 / SIGMA**2, rel=1e-6)


# --- densities ---


@pytest.mark.parametrize("stretch", [None, (Sinh(1.5, 0.5),)])
@pytest.mark.parametrize("box", [(-1.0, 1.0), (0.5, 2.0)])
def test_a_reflected_ornstein_uhlenbeck_process_has_the_gauss_of_the_inside(box, stretch):
    """dx = −x dt + dw between walls: e^{−x²} scaled to one, with drift into the walls, out of them, up to the node."""
    z = np.linspace(*box, 20_001)
    total, errors = np.trapezoid(np.exp(-(z**2)), z), []
    for count in (33, 65, 129):
        grid = hjb.Grid([box[0]], [box[1]], (count,), stretch=stretch)
        density = chain.stationary_density(hjb.Problem(lambda x, u: -x, noise=1.0), grid)
        errors.append(np.max(np.abs(density - np.exp(-(np.asarray(grid.axis(0)) ** 2)) / total)))
    assert errors[-1] <= 5e-4
    assert order_of(errors) >= 1.8


def test_a_density_in_a_corner():
    """Two axes of which one has no drift: e^{−2x}/∫ along the first, flat along the second; correlation none."""
    errors = []
    for count in (17, 33, 65):
        grid = hjb.Grid([0.0, 0.0], [1.0, 2.0], (count, 9))
        problem = hjb.Problem(lambda x, u: jnp.stack([-1.0 + 0 * x[0], 0 * x[1]]), noise=[1.0, 0.7])
        exact = 2 * np.exp(-2 * np.asarray(grid.axis(0))) / (1 - np.exp(-2.0)) / 2
        errors.append(np.max(np.abs(chain.stationary_density(problem, grid) - exact[:, None])))
    assert errors[-1] <= 1e-3
    assert order_of(errors) >= 1.8


# --- correlated noise, marches ---


@pytest.mark.parametrize("correlation", [-0.6, 0.0, 0.6])
@pytest.mark.parametrize("scheme", [hjb.Upwind(), hjb.Upwind(central=False)])
def test_diagonal_jumps_reflect_to_second_order(correlation, scheme):
    """V = cos πx cos πy is even about all four walls: (β − 𝓛)V = L, with ∂²V/∂x∂y = 0 on them and in the corners."""
    root = np.array([[1.0, 0.0], [correlation, np.sqrt(1 - correlation**2)]]) * 0.8
    a, beta, errors = root @ root.T, 1.0, []
    problem = hjb.Problem(lambda x, u: 0 * x, noise=root)
    for count in (9, 17, 33):
        grid = hjb.Grid([0.0, 0.0], [1.0, 1.0], (count, count))
        x, y = np.moveaxis(np.pi * grid.nodes(), -1, 0)
        exact = np.cos(x) * np.cos(y)
        source = (beta + np.pi**2 * np.trace(a) / 2) * exact - np.pi**2 * a[0, 1] * np.sin(x) * np.sin(y)
        errors.append(np.max(np.abs(resolvent(problem, grid, source, beta, scheme=scheme) - exact)))
    assert errors[-1] <= 5e-3
    assert order_of(errors) >= 1.8


SLOWLY = [pytest.param(scheme, marks=pytest.mark.slow) for scheme in (hjb.Limited(), hjb.Eno2())]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [pytest.param(hjb.Upwind(), marks=pytest.mark.slow), hjb.Weno5(), *SLOWLY])
def test_heat_between_two_walls(scheme):
    """−V_t = ½σ²V″: cos πx decays at the rate π²σ²/2."""
    errors = []
    for count in (11, 21, 41):
        grid = hjb.Grid([0.0], [1.0], (count,))
        problem = hjb.Problem(lambda x, u: 0 * x, noise=1.0, terminal_cost=lambda x: jnp.cos(jnp.pi * x[0]))
        found = hjb.march(problem, grid, 0.1, scheme=scheme).value[0]
        errors.append(np.max(np.abs(found - np.exp(-(np.pi**2) * 0.05) * np.cos(np.pi * np.asarray(grid.axis(0))))))
    assert errors[-1] <= 1e-3
    assert order_of(errors) >= 1.8


# --- the chain and the Hamiltonian at a wall ---


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
@pytest.mark.parametrize("scheme", [hjb.Limited(), hjb.Eno2(), hjb.Weno5()])
def test_a_sliver_between_a_target_and_a_wall_stays_in_the_range_of_its_data(scheme):
    """Noise too weak for central differences ties the wall to the node before it, which once took its slope downwind.

    With drift towards the wall both then grew like e^{.15 f t/h}: V = −7e13 for data in [−½, 1], and CONVERGED.
    """
    grid, drift = hjb.Grid([-1.0], [1.0], (31,)), 3.0
    for nodes, share in ((2, 0.2), (2, 0.9), (3, 0.6), (4, 0.6)):  # between the target and the wall, and a/(h f)
        edge = 1 - (nodes - 0.5) * grid.spacing(0)
        problem = hjb.Problem(
            lambda x, u: drift + 0 * x, noise=np.sqrt(share * drift * grid.spacing(0)), terminal_cost=-0.5,
            target=lambda x, edge=edge: jnp.abs(x[0] - edge + 0.3) - 0.3, exit_cost=1.0,
        )  # fmt: skip
        value = hjb.march(problem, grid, 3.0, scheme=scheme).value
        assert value.min() >= -0.501
        assert value.max() <= 1.001
    if scheme.stationary:  # of the last one, in [0, 1], −1.4 was CONVERGED
        value = hjb.solve(dataclasses.replace(problem, terminal_cost=None, discount=0.3), grid, scheme=scheme).value
        assert value.min() >= -0.001
        assert value.max() <= 1.001


@given(seed=SEEDS)
@settings(max_examples=15, deadline=None)
def test_walls_with_any_noise_and_drift_keep_rows_probabilities(seed):
    """From noise that rules to drift that does, inwards and outwards; where noise rules the mean step is f − a/h."""
    rng = np.random.default_rng(seed)
    push, sigma = rng.normal(size=5) * 10 ** rng.uniform(-2, 2), 10 ** rng.uniform(-2, 1) * rng.integers(0, 2)
    grid = hjb.Grid([0.0], [1.0], (5,), stretch=(Sinh(2.0),) if rng.integers(2) else None)
    # a policy as drift: no program is compiled anew
    problem = hjb.Problem(lambda x, u: u, None, hjb.Box([-1e9], [1e9]), noise=float(sigma))
    for scheme in (hjb.Upwind(), hjb.Upwind(central=False)):
        matrix = chain.matrix(problem, grid, push[:, None], scheme=scheme)
        assert matrix.data.min() >= 0
        np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-12)
        rates = chain.generator(problem, grid, push[:, None], scheme=scheme).toarray()
        gaps = np.diff(np.asarray(grid.axis(0)))
        for node, inner, h, outward in ((0, 1, gaps[0], -push[0]), (4, 3, gaps[-1], push[4])):
            held = outward if scheme.central else min(outward, 0.0)
            assert rates[node, inner] == pytest.approx(max(sigma**2 - h * held, 0) / h**2, rel=1e-9, abs=1e-12)


@functools.partial(jax.jit, static_argnames=("central", "subcell"))
def _hamiltonian_and_generator(slope, root, value, u, grid, central, subcell):
    """H and L + 𝓛V under one policy; the examples share the program."""
    problem = hjb.Problem(lambda x, u: slope @ x + u, None, hjb.Box([-9.0] * 2, [9.0] * 2), noise=root)
    on = Discretisation(problem, grid, hjb.Upwind(central=central, subcell=subcell), np.float64)
    return discrete.around(on, value).at(list(u), []), jump_rates(on, list(u)).apply(grid, value)


@pytest.mark.parametrize("subcell", [False, True])
@pytest.mark.parametrize("central", [True, False])
@given(seed=SEEDS)
@settings(max_examples=5, deadline=None)
def test_the_hamiltonian_at_walls_is_that_of_the_chain(central, subcell, seed):
    """H = L + 𝓛V under one policy, on all nodes, with diagonal jumps across edges and corners."""
    rng = np.random.default_rng(seed)
    grid = hjb.Grid([0.0, 0.0], [1.0, 1.0], (3, 4), edges=["projected", ("open", "projected")])
    grid = grid if central else stencil.walled(grid)
    slope, root = rng.normal(size=(2, 2)), np.array([[1.0, 0.0], [rng.uniform(-0.4, 0.4), 0.8]])
    with jax.enable_x64(True):
        value, u = rng.normal(size=grid.shape), rng.normal(size=(2, *grid.shape)) * 3
        found, wanted = _hamiltonian_and_generator(slope, root, value, u, grid, central, subcell)
    np.testing.assert_allclose(found, wanted, atol=1e-9)


@pytest.mark.parametrize("noise", [0.05, 0.5])
def test_the_optimum_at_a_wall_is_exact(noise):
    """Against a fine scan, where the kink n = a/h of the gain lies inside the box of the controls and outside of it."""
    scheme, grid = hjb.Upwind(), hjb.Grid([0.0], [1.0], (6,))
    problem = hjb.Problem(lambda x, u: u, lambda x, u: 0.02 * u @ u, hjb.Box([-1.0], [1.0]), noise=noise, discount=1.0)
    rng = np.random.default_rng(3)
    with jax.enable_x64(True):
        on = Discretisation(problem, grid, scheme, np.float64)
        for _ in range(5):
            hamiltonian = discrete.around(on, jnp.asarray(rng.normal(size=6)))
            best, _, _ = optimum.optimise(hamiltonian)
            scan = jax.vmap(lambda c, h=hamiltonian: h.at([jnp.full(6, c)], []))(jnp.linspace(-1, 1, 4001))
            np.testing.assert_array_less(best, jnp.min(scan, axis=0) + 1e-12)
            np.testing.assert_allclose(best, jnp.min(scan, axis=0), atol=1e-5)
