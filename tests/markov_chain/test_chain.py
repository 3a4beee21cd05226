"""The chain against its formulas written as loops, its moments, and the solvers that its exports are for."""

import itertools
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from systems import SEEDS, SHAPES, random_grid, random_problem

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import jump_rates
from hjbjax.discretisation.schemes import Upwind
from hjbjax.markov_chain import chain, policy_rates
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import Ball, Box, Finite

pytestmark = pytest.mark.usefixtures("float64")
PLAIN = Upwind(central=False)
KINDS = ("none", "scalar", "diagonal", "matrix")
FEW = [(1, "scalar"), (2, "none"), (2, "matrix"), (2, "function"), (3, "matrix")]
REST = {(n, kind) for n in (1, 2, 3, 4) for kind in KINDS} - {(1, "none"), *FEW}
CASES = [(1, "none"), *FEW, *(pytest.param(*case, marks=pytest.mark.slow) for case in sorted(REST))]
UNIT = Box([-1.0], [1.0])
laws = settings(max_examples=15)


def drift_and_noise(problem, grid, policy):
    """f and a = σσᵀ at every node."""
    return jax.device_get(_drift_and_noise(problem, grid, policy))


@jax.jit
def _drift_and_noise(problem, grid, policy):
    x = jnp.stack(jnp.broadcast_arrays(*grid.components(np.float64)), axis=-1)

    def at(x, u):
        sigma = problem.diffusion(x, u)
        return problem.drift(x, u), sigma @ sigma.T

    for _ in range(grid.ndim):
        at = jax.vmap(at)
    return at(x, policy)


def dense_generator(f, a, grid, central):
    """The rates of the module's docstring, node by node; at a wall all noise goes inwards, diagonals to their image."""
    number = np.arange(grid.size).reshape(grid.shape)
    h = [grid.spacing(axis) for axis in range(grid.ndim)]
    result = np.zeros((grid.size, grid.size))

    def end(index, jump):
        """Where a jump ends: across a wall at the mirror image."""
        reached = []
        for i, step, count, wraps in zip(index, jump, grid.shape, grid.periodic, strict=True):
            inside = 0 <= i + step < count
            reached.append((i + step) % count if wraps else i + step if inside else i - step)
        return number[tuple(reached)]

    for index in np.ndindex(*grid.shape):
        here, fx, ax = number[index], f[index], a[index]
        moves = []
        for i in range(grid.ndim):
            left = ax[i, i] - sum(abs(ax[i, j]) * h[i] / h[j] for j in range(grid.ndim) if j != i)
            left = max(left, 0.0)
            unit = np.eye(grid.ndim, dtype=int)[i]
            for sign in (1, -1):
                if not grid.periodic[i] and index[i] == (grid.shape[i] - 1 if sign > 0 else 0):
                    rate = 0
                elif not grid.periodic[i] and index[i] == (0 if sign > 0 else grid.shape[i] - 1):
                    held = max(-sign * fx[i], 0) / h[i] if central else 0  # outward drift against the noise
                    rate = max(sign * fx[i], 0) / h[i] + max(left / h[i] ** 2 - held, 0)
                elif central and left >= h[i] * abs(fx[i]):
                    rate = left / (2 * h[i] ** 2) + sign * fx[i] / (2 * h[i])
                elif central:
                    rate = max(sign * fx[i], 0) / h[i]
                else:
                    rate = max(sign * fx[i], 0) / h[i] + left / (2 * h[i] ** 2)
                moves.append((sign * unit, rate))
        for i, j in itertools.combinations(range(grid.ndim), 2):
            for p, q in itertools.product((1, -1), repeat=2):
                jump = np.zeros(grid.ndim, dtype=int)
                jump[i], jump[j] = p, q
                moves.append((jump, max(p * q * ax[i, j], 0) / (2 * h[i] * h[j])))
        for jump, rate in moves:
            result[here, end(index, jump)] += rate
            result[here, here] -= rate
    return result


@pytest.mark.parametrize(("n", "kind"), CASES)
@given(seed=SEEDS)
@laws
def test_rows_are_probabilities(n, kind, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    problem = random_problem(rng, grid, kind)
    policy = rng.uniform(-1, 1, (*grid.shape, 1))
    matrix = chain.matrix(problem, grid, policy)
    assert matrix.shape == (grid.size, grid.size)
    assert matrix.format == "csr"
    assert np.max(np.abs(matrix.sum(axis=1) - 1)) <= 1e-12
    assert matrix.data.min() >= 0
    generator = chain.generator(problem, grid, policy)
    fastest = np.max(-generator.diagonal())
    dt = 1 / fastest if fastest > 0 else 1.0
    assert np.allclose(matrix.toarray(), np.eye(grid.size) + dt * generator.toarray(), rtol=0, atol=1e-12)
    assert fastest == 0 or np.isclose(matrix.diagonal().min(), 0, atol=1e-12)  # no smaller step than need be


@pytest.mark.parametrize("central", [False, True])
@pytest.mark.parametrize(("n", "kind"), FEW)
@given(seed=SEEDS)
@settings(max_examples=4)
def test_generator_equals_its_formula(n, kind, central, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    problem = random_problem(rng, grid, kind)
    policy = rng.uniform(-1, 1, (*grid.shape, 1))
    expected = dense_generator(*drift_and_noise(problem, grid, policy), grid, central)
    found = chain.generator(problem, grid, policy, scheme=Upwind(central=central)).toarray()
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-9 * np.max(np.abs(expected)))


@pytest.mark.parametrize(
    ("n", "kind"),
    [
        (1, "scalar"),
        (2, "matrix"),
        pytest.param(2, "diagonal", marks=pytest.mark.slow),
        pytest.param(3, "matrix", marks=pytest.mark.slow),
    ],
)
@given(seed=SEEDS)
@settings(max_examples=6)
def test_steps_have_the_mean_and_the_covariance_of_the_diffusion(n, kind, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n, periodic=False)
    problem = random_problem(rng, grid, kind)
    policy = rng.uniform(-1, 1, (*grid.shape, 1))
    f, a = (entries.reshape(grid.size, *entries.shape[n:]) for entries in drift_and_noise(problem, grid, policy))
    x = grid.nodes().reshape(grid.size, n)
    inner = np.all([(x[:, i] > x[:, i].min()) & (x[:, i] < x[:, i].max()) for i in range(n)], axis=0)
    h = np.array([grid.spacing(axis) for axis in range(n)])
    steps = x[None, :, :] - x[:, None, :]
    for central in (False, True):
        matrix = chain.matrix(problem, grid, policy, scheme=Upwind(central=central)).toarray()
        generator = chain.generator(problem, grid, policy, scheme=Upwind(central=central))
        dt = 1 / max(np.max(-generator.diagonal()), 1e-9)
        mean = np.einsum("xy,xyi->xi", matrix, steps)
        second = np.einsum("xy,xyi,xyj->xij", matrix, steps, steps)
        assert np.allclose(mean[inner], f[inner] * dt, rtol=0, atol=1e-12 * h.max())
        extra = (second - a * dt)[inner]  # artificial diffusion, which goes with h
        off = extra - np.einsum("xii->xi", extra)[:, :, None] * np.eye(n)
        assert np.allclose(off, 0, rtol=0, atol=1e-12 * h.max() ** 2)
        diagonal, most = np.einsum("xii->xi", extra), h * np.abs(f[inner]) * dt
        slack = 1e-12 * h.max() ** 2
        if central:
            assert np.all(diagonal >= -slack)
            assert np.all(diagonal <= most + slack)
        else:
            assert np.allclose(diagonal, most, rtol=0, atol=slack)


def test_numbers_by_hand():
    """h = ½, f = 1 at the left node, −1 elsewhere, ε = 1: c⁺ = f⁺/h + 2, c⁻ = f⁻/h + 2, at the walls |f|/h + 4."""
    problem = Problem(lambda x, u: u, None, Box([-1.0], [1.0]), noise=1.0)
    grid = Grid([0.0], [1.0], (3,))
    policy = np.array([[1.0], [-1.0], [-1.0]])
    plain = chain.generator(problem, grid, policy, scheme=PLAIN).toarray()
    assert plain.tolist() == [[-6, 6, 0], [4, -6, 2], [0, 6, -6]]
    assert chain.generator(problem, grid, policy).toarray().tolist() == [[-6, 6, 0], [3, -4, 1], [0, 6, -6]]
    outward = chain.generator(problem, grid, -policy, scheme=PLAIN).toarray()
    assert outward[0].tolist() == [-4, 4, 0]  # the drift is gone, the noise reflects
    assert outward[2].tolist() == [0, 4, -4]
    against = chain.generator(problem, grid, -policy).toarray()
    assert against[0].tolist() == [-2, 2, 0]  # (a − h n)/h²: central differences hold the noise back


@pytest.mark.parametrize("n", [1, 2, pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow)])
@given(seed=SEEDS)
@laws
def test_generator_and_adjoint_are_dual(n, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    problem = random_problem(rng, grid, "matrix" if n > 1 else "scalar")
    u = [jnp.asarray(rng.uniform(-1, 1, grid.shape))]
    value, density = (jnp.asarray(rng.normal(size=grid.shape)) for _ in range(2))
    applied, transposed = _apply_both(problem, grid, u, value, density)
    size = jnp.sum(jnp.abs(applied * density))
    assert abs(jnp.sum(applied * density) - jnp.sum(value * transposed)) <= 1e-12 * size
    assert abs(jnp.sum(transposed)) <= 1e-12 * jnp.sum(jnp.abs(transposed))  # nothing is lost
    matrix = chain.generator(problem, grid, np.asarray(u[0])[..., None])
    assert np.allclose(matrix @ value.ravel(), applied.ravel(), rtol=0, atol=1e-12 * np.max(np.abs(applied)))
    assert np.allclose(matrix.T @ density.ravel(), transposed.ravel(), rtol=0, atol=1e-12 * np.max(np.abs(matrix.data)))


@jax.jit
def _apply_both(problem, grid, u, value, density):
    from hjbjax.discretisation import stencil

    rates = jump_rates(Discretisation(problem, grid, Upwind(), value.dtype), u)
    arriving = rates.inflow(grid)
    jumps = zip(arriving.offsets, arriving.values, strict=True)
    came = sum(c * stencil.neighbour(density, grid, offset, ghost=False) for offset, c in jumps)
    return rates.apply(grid, value), came - rates.total() * density


def test_scaled_multiplies_every_rate():
    problem = Problem(lambda x, u: u, None, Box([-1.0], [1.0]), noise=1.0)
    grid = Grid([0.0], [1.0], (3,))
    rates = jump_rates(Discretisation(problem, grid, PLAIN, np.float64), [jnp.ones(3)])
    factor = jnp.array([0.0, 1.0, 3.0])
    assert rates.scaled(factor).total().tolist() == (factor * rates.total()).tolist()


# --- exports ---


def test_the_chain_stays_on_the_target_and_where_there_is_no_action():
    problem = Problem(lambda x, u: u, None, Box([-1.0], [1.0]), target=lambda x: x[0] - 0.1)
    grid = Grid([0.0], [1.0], (5,))
    policy = np.array([np.nan, -1.0, -1.0, np.nan, -0.5])[:, None]
    matrix = chain.matrix(problem, grid, policy).toarray()
    assert matrix.tolist() == [
        [1, 0, 0, 0, 0],
        [1, 0, 0, 0, 0],
        [0, 1, 0, 0, 0],
        [0, 0, 0, 1, 0],
        [0, 0, 0, 0.5, 0.5],
    ]


def test_an_equal_scheme_compiles_nothing_new():
    problem, grid = Problem(lambda x, u: u, None, UNIT, noise=1.0), Grid([0.0], [1.0], (3,))
    chain.matrix(problem, grid, np.ones((3, 1)), scheme=Upwind(central=False))
    compiled = policy_rates._evaluate._cache_size()
    chain.matrix(problem, grid, np.zeros((3, 1)), scheme=Upwind(central=False))
    assert policy_rates._evaluate._cache_size() == compiled
    assert Upwind() != Upwind(central=False)


def test_without_motion_the_matrix_is_the_identity():
    grid = Grid([0.0], [1.0], (4,))
    assert chain.matrix(Problem(lambda x, u: 0 * x), grid).toarray().tolist() == np.eye(4).tolist()


def test_game_and_time():
    def drift(t, x, u, d):
        return t * u + d

    game = Problem(drift, None, Box([-1.0], [1.0]), disturbances=Box([-1.0], [1.0]), discount=1.0, time_dependent=True)
    grid = Grid([0.0], [1.0], (3,))
    ones = np.ones((3, 1))
    generator = chain.generator(game, grid, ones, disturbance=-0.5 * ones, t=2.0).toarray()
    assert generator.tolist() == [[-3, 3, 0], [0, -3, 3], [0, 0, 0]]
    with pytest.raises(ValueError, match=r"disturbance of shape \(\), wanted \(3, 1\)"):
        chain.matrix(game, grid, ones)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (np.ones(3), "got a policy of shape (3,), wanted (3, 1)"),
        (np.ones((3, 2)), "got a policy of shape (3, 2), wanted (3, 1)"),
        (None, "got a policy of shape (), wanted (3, 1)"),
        (np.full((3, 1), np.inf), "infinite"),
    ],
)
def test_bad_policies_are_refused(policy, message):
    problem = Problem(lambda x, u: u, None, Box([-1.0], [1.0]))
    with pytest.raises(ValueError, match=re.escape(message)):
        chain.matrix(problem, Grid([0.0], [1.0], (3,)), policy)


def test_noise_that_leaves_negative_rates_is_refused():
    problem = Problem(lambda x, u: 0 * x, noise=[[1.0, 0.0], [0.9, 0.1]])
    with pytest.raises(ValueError, match="correlated more than the spacings allow at 12 nodes, the first"):
        chain.matrix(problem, Grid([0, 0], [1, 1], (3, 4)))


def test_rates_that_are_not_finite_are_refused_off_the_target_only():
    def drift(x, u):
        return jnp.where(x > 0, jnp.log(x), jnp.nan)

    grid = Grid([0.0], [1.0], (3,))
    with pytest.raises(ValueError, match=r"not finite at 1 nodes, the first \(0,\) with state \[0.\]"):
        chain.generator(Problem(drift), grid)
    assert np.all(np.isfinite(chain.generator(Problem(drift, target=lambda x: x[0]), grid).toarray()))


def random_decision_problem(rng, n, kind, count=4, **ingredients):
    grid = random_grid(rng, n)
    controls = Finite(rng.uniform(-1, 1, (count, 2)))
    return random_problem(rng, grid, kind, controls, discount=rng.uniform(0.1, 2), **ingredients), grid


@pytest.mark.parametrize(("n", "kind"), [*FEW, pytest.param(4, "none", marks=pytest.mark.slow)])
@given(seed=SEEDS)
@settings(max_examples=3)
def test_pairs_are_the_rows_of_the_matrices(n, kind, seed):
    problem, grid = random_decision_problem(np.random.default_rng(seed), n, kind, 3)
    costs, probabilities, states, actions, factor = chain.transition_arrays(problem, grid)
    assert costs.shape == states.shape == actions.shape == (3 * grid.size,)
    assert np.array_equal(states, np.repeat(np.arange(grid.size), 3))
    assert np.array_equal(actions, np.tile(np.arange(3), grid.size))
    assert probabilities.format == "csr"
    assert probabilities.has_canonical_format
    assert probabilities.data.min() > 0
    assert np.max(np.abs(probabilities.sum(axis=1) - 1)) <= 1e-12
    generators = [chain.generator(problem, grid, np.broadcast_to(u, (*grid.shape, 2))) for u in problem.controls.points]
    fastest = max(np.max(-generator.diagonal()) for generator in generators)
    dt = 1 / fastest if fastest > 0 else 1.0
    assert np.isclose(factor, 1 / (1 + problem.discount * dt), rtol=1e-14)
    x = grid.nodes().reshape(grid.size, n)
    for k, generator in enumerate(generators):
        assert np.allclose(probabilities.toarray()[k::3], np.eye(grid.size) + dt * generator.toarray(), atol=1e-12)
        running = jax.vmap(lambda x, k=k: problem.cost(x, problem.controls.points[k]))(x)
        assert np.allclose(costs[k::3], factor * dt * running, rtol=1e-12, atol=1e-14)


SLOW = [
    pytest.param(*case, marks=pytest.mark.slow)
    for case in [(2, "none", False), (2, "matrix", False), (3, "diagonal", False), (4, "none", True)]
]


@pytest.mark.slow
@pytest.mark.parametrize(("n", "kind", "with_target"), [(1, "scalar", True), (2, "matrix", True), *SLOW])
def test_quantecon_finds_our_value(n, kind, with_target):
    from quantecon.markov import DiscreteDP

    from hjbjax.solvers.stationary import solve

    rng = np.random.default_rng(n)
    ending = {"target": lambda x: abs(x[0]) - 0.5, "exit_cost": lambda x: x[0] - 1} if with_target else {}
    grid = Grid([-1.0] * n, [1.0] * n, SHAPES[n] if n > 2 else (21,) * n, (False, True, False, False)[:n])
    controls = Finite(rng.uniform(-1, 1, (4, 2)))
    problem = random_problem(rng, grid, kind, controls, discount=0.3, **ending)
    costs, probabilities, states, actions, factor = chain.transition_arrays(problem, grid)
    theirs = DiscreteDP(-costs, probabilities, factor, states, actions).solve(method="policy_iteration")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* of the nodes cannot reach the target")  # discounted: no matter
        warnings.filterwarnings("ignore", message="the optimal drift leaves")  # of a random system it may
        ours = solve(problem, grid, tol=1e-9, scheme=Upwind())
    assert np.max(np.abs(ours.value.ravel() + theirs.v)) <= 1e-8
    best = problem.controls.points[theirs.sigma]
    under = chain.matrix(problem, grid, ours.policy)  # both policies are optimal: check theirs by value
    assert under.shape == (grid.size, grid.size)
    free = ours.policy.reshape(grid.size, 2)
    agree = np.all(np.isnan(free), axis=1) | np.all(free == best, axis=1)
    assert np.mean(agree) > 0.95  # ties apart


@pytest.mark.parametrize("subcell", [False, True])
def test_an_exit_cost_on_the_boundary_between_nodes(subcell):
    """ẋ = −1 into x ≤ 0.1 with exit cost 5x: the boundary lies 0.6 spacings from the node 0.25, and costs 0.5."""
    ending = {"target": lambda x: x[0] - 0.1, "exit_cost": lambda x: 5 * x[0]}
    problem = Problem(lambda x, u: -1 + 0 * x, lambda x, u: 1 + 0 * x[0], discount=1.0, **ending)
    grid = Grid([0.0], [1.0], (5,))
    costs, probabilities, _, _, factor = chain.transition_arrays(problem, grid, scheme=Upwind(subcell=subcell))
    value = np.linalg.solve(np.eye(5) - factor * probabilities.toarray(), costs)
    first = (1 / 0.15 * 0.5 + 1) / (1 / 0.15 + 1) if subcell else (4 * 0 + 1) / (4 + 1)
    expected = [0.0, first]
    for _ in range(3):
        expected.append((4 * expected[-1] + 1) / 5)
    assert np.allclose(value, expected, rtol=1e-13)


def test_two_nodes_on_a_periodic_axis():
    """Both neighbours are the same node: the two jumps add up."""
    problem = Problem(lambda x, u: 0 * x, noise=1.0, discount=1.0)
    grid = Grid([0.0], [1.0], (2,), (True,))
    assert chain.generator(problem, grid).toarray().tolist() == [[-4, 4], [4, -4]]
    costs, probabilities, *_ = chain.transition_arrays(problem, grid)
    assert probabilities.toarray().tolist() == [[0, 1], [1, 0]]
    assert costs.tolist() == [0, 0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"controls": Box([-1.0], [1.0])}, "controls in a Box, wanted Finite: sample it, e.g. Box.grid(num)"),
        ({"controls": Ball(1.0, 1)}, "controls in a Ball"),
        ({"discount": 0.0}, "discount = 0, wanted > 0"),
        ({"stopping_cost": 1.0}, "stopping_cost"),
        ({"running_max": lambda x: x[0], "discount": 0.0}, "discount = 0"),
        ({"disturbances": Finite([[1.0]]), "drift": lambda x, u, d: u + d}, "got a game"),
        ({"time_dependent": True, "drift": lambda t, x, u: u}, "time_dependent=True"),
        ({"cost": lambda x, u: 1 / x[0]}, "running cost is not finite at 1 nodes"),
    ],
)
def test_what_is_no_decision_problem_is_refused(changes, message):
    arguments = {"drift": lambda x, u: u, "controls": Finite([[-1.0], [1.0]]), "discount": 1.0} | changes
    with pytest.raises(ValueError, match=re.escape(message)):
        chain.transition_arrays(Problem(**arguments), Grid([0.0], [1.0], (3,)))
