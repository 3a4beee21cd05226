"""The discrete Hamiltonian against the chain's rates, and its optimum against brute force."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from systems import SEEDS, random_game, random_grid, random_problem, random_sigma

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.players import SAMPLES, find_players
from hjbjax.discretisation.rates import jump_rates
from hjbjax.discretisation.schemes import Upwind
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.sets import Ball, Box, Finite, samples

pytestmark = pytest.mark.usefixtures("float64")
CASES = [(1, "diagonal"), (2, "none"), (2, "matrix"), (2, "function"), (3, "matrix")]
CASES += [pytest.param(n, kind, marks=pytest.mark.slow) for n, kind in ((3, "diagonal"), (4, "matrix"))]
SCHEMES = [Upwind(central=False), Upwind(central=True)]
UNIT = Box([-1.0], [1.0])


@functools.partial(jax.jit, static_argnames="scheme")
def both_forms(problem, grid, value, u, d, scheme):
    on, other = Discretisation(problem, grid, scheme, value.dtype), d if problem.is_game else None
    rates, cost = jump_rates(on, u, other), on.running_cost(u, other)
    return discrete.around(on, value).at(u, d), cost + rates.apply(grid, value)


@pytest.mark.parametrize("scheme", SCHEMES, ids=["plain", "central"])
@pytest.mark.parametrize(("n", "kind"), CASES)
@given(seed=SEEDS)
@settings(max_examples=8)
def test_differences_and_rates_are_two_forms_of_one_operator(n, kind, scheme, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    problem = random_problem(rng, grid, kind)
    value, u = rng.normal(size=grid.shape), [rng.uniform(-1, 1, grid.shape)]
    differences, rates = map(np.asarray, both_forms(problem, grid, value, u, [], scheme))
    assert np.allclose(differences, rates, rtol=0, atol=1e-12 * (1 + np.max(np.abs(rates))))


# --- exact minima over continua ---


@pytree_dataclass()
class Coupled:
    """Two inputs in three components: u₀ drives two of them, u₁ the third; the cost is separable."""

    numbers: object

    def drift(self, x, u):
        p = self.numbers
        return jnp.stack(
            [
                p[0] * jnp.sin(x[1]) + p[1] * u[0],
                p[2] + p[3] * u[0] * jnp.cos(x[0]),
                p[4] * x[0] - p[5] * u[1],
            ]
        )

    def cost(self, x, u):
        p = self.numbers
        return p[6] * u[0] + p[7] * u[0] ** 2 + p[8] * jnp.square(u[1]) + p[9] * x[2] * u[1] + jnp.abs(x[0])

    def affine_cost(self, x, u):
        return self.numbers[6] * u[0] - self.numbers[9] * u[1] * x[1]

    def one_each(self, x, u):
        p = self.numbers
        return jnp.stack([p[0] * x[1] + p[1] * u[0], p[2] * jnp.ones_like(x[0]), p[4] * x[0] - p[5] * u[1]])


@functools.partial(jax.jit, static_argnames="scheme")
def best_and_scan(problem, grid, value, scan, scheme):
    players = find_players(problem, grid.ndim, value.dtype)
    assert players.exact
    hamiltonian = discrete.around(Discretisation(problem, grid, scheme, value.dtype), value)
    best, u, _ = optimum.optimise(hamiltonian)
    table = jax.lax.map(lambda point: hamiltonian.at([point[j] for j in range(scan.shape[1])], []), scan)
    full = [jnp.broadcast_to(component, grid.shape) for component in u]
    return best, jnp.stack(full), jnp.min(table, axis=0), hamiltonian.at(full, [])


def check_minimum(problem, grid, value, scan, scheme):
    best, u, lowest, there = jax.device_get(best_and_scan(problem, grid, value, scan, scheme))
    assert np.allclose(best, there, rtol=1e-12, atol=1e-12)
    size = 1 + np.max(np.abs(lowest))
    assert np.all(best <= lowest + 1e-12 * size)
    return u


@pytest.mark.parametrize(
    ("cost", "kind", "scheme"),
    [
        ("cost", "none", SCHEMES[1]), ("cost", "matrix", SCHEMES[0]), ("affine_cost", "none", SCHEMES[0]),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in [
                ("cost", "none", SCHEMES[0]), ("cost", "matrix", SCHEMES[1]), ("affine_cost", "none", SCHEMES[1]),
                *(("affine_cost", "matrix", scheme) for scheme in SCHEMES),
            ]
        ),
    ],
)  # fmt: skip
@given(seed=SEEDS)
@settings(max_examples=8)
def test_a_box_is_minimised_exactly(cost, kind, scheme, seed):
    rng = np.random.default_rng(seed)
    grid, system = random_grid(rng, 3), Coupled(rng.normal(size=10) * rng.choice([0.0, 1.0], 10, p=[0.15, 0.85]))
    lo = -rng.uniform(0, 2, 2)
    hi = lo + rng.uniform(0, 3, 2)
    sigma = random_sigma(rng, grid, kind)
    problem = Problem(system.drift, getattr(system, cost), Box(lo, hi), noise=sigma, discount=1.0)
    unit = np.stack(np.meshgrid(*(np.linspace(0, 1, 25),) * 2), axis=-1).reshape(-1, 2)
    value = rng.normal(size=grid.shape) * rng.choice([1.0, 10.0])
    u = check_minimum(problem, grid, value, lo + (hi - lo) * unit, scheme)
    for j in range(2):
        assert np.all((lo[j] <= u[j]) & (u[j] <= hi[j]))


@pytest.mark.parametrize("scheme", SCHEMES, ids=["plain", "central"])
@pytest.mark.parametrize("kind", ["none", pytest.param("diagonal", marks=[pytest.mark.slow, pytest.mark.emitters])])
@given(seed=SEEDS)
@settings(max_examples=8)
def test_a_ball_is_minimised_exactly(kind, scheme, seed):
    rng = np.random.default_rng(seed)
    grid, system = random_grid(rng, 3), Coupled(rng.normal(size=10) * rng.choice([0.0, 1.0], 10, p=[0.15, 0.85]))
    radius = rng.uniform(0, 2)
    sigma = random_sigma(rng, grid, kind)
    problem = Problem(system.one_each, system.affine_cost, Ball(radius, 2), noise=sigma, discount=1.0)
    angle = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    scan = radius * np.concatenate([share * circle for share in np.linspace(0, 1, 9)])
    u = check_minimum(problem, grid, rng.normal(size=grid.shape), scan, scheme)
    assert np.all(np.sum(u * u, axis=0) <= radius**2 * (1 + 1e-12) + 1e-300)


@pytest.mark.parametrize(
    ("drift", "cost", "controls", "exact"),
    [
        (lambda x, u: x + u, lambda x, u: u @ u, Box([-1.0] * 2, [1.0] * 2), True),
        (lambda x, u: x + u, None, Ball(1.0, 2), True),
        (lambda x, u: x + u, lambda x, u: u @ u, Ball(1.0, 2), True),
        (lambda x, u: x + u[:2] * u[2], lambda x, u: u @ u, Ball(1.0, 3), False),
        (lambda x, u: x * u[0] + u[1], None, Box([-1.0] * 2, [1.0] * 2), True),  # both inputs drive both components
        (lambda x, u: x * u[0] + u[1] - u[2], None, Box([-1.0] * 3, [1.0] * 3), True),  # three do
        (lambda x, u: x * u[0] + u[1], None, Ball(1.0, 2), True),
        (lambda x, u: x + u[0] ** 2, None, UNIT, False),
        (lambda x, u: x + jnp.sin(u[0]), None, UNIT, False),
        (lambda x, u: x + u, lambda x, u: u[0] * u[1], Box([-1.0] * 2, [1.0] * 2), True),  # where it is convex
        (lambda x, u: x + u, lambda x, u: u[0] * u[1] ** 2, Box([-1.0] * 2, [1.0] * 2), False),
        (lambda x, u: x + u[0], lambda x, u: u[0] ** 4, UNIT, False),
        (lambda x, u: x + u[0], lambda x, u: jnp.exp(x[0]) * u[0] ** 2 + jnp.sin(x[1]) * u[0], UNIT, True),
        (lambda x, u: x * u[0], None, UNIT, True),
    ],
)
def test_what_is_exact_is_read_from_the_functions(drift, cost, controls, exact):
    players = find_players(Problem(drift, cost, controls, discount=1.0), 2, np.float64)
    assert players.exact == exact


def test_noise_that_depends_on_the_control_is_not_exact():
    steered = Problem(lambda x, u: u, None, UNIT, noise=lambda x, u: u, discount=1.0)
    given_by_state = Problem(lambda x, u: u, None, UNIT, noise=lambda x, u: x, discount=1.0)
    assert not find_players(steered, 1, np.float64).exact
    assert find_players(given_by_state, 1, np.float64).exact


@pytest.mark.parametrize("scheme", SCHEMES, ids=["plain", "central"])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.slow
def test_samples_and_search_come_close_where_the_minimum_is_not_exact(scheme, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 2)
    problem = random_problem(rng, grid, "diagonal", Box([-1.0, -2.0], [1.0, 1.0]))  # both inputs drive both components
    value = rng.normal(size=grid.shape)
    best, lowest, sampled = jax.device_get(sampled_and_scan(problem, grid, value, scheme))
    assert np.all(best <= sampled + 1e-12)  # the search starts from the best of these
    assert np.all(best - lowest <= 0.02 * (1 + np.max(np.abs(lowest))))


@functools.partial(jax.jit, static_argnames="scheme")
def sampled_and_scan(problem, grid, value, scheme):
    hamiltonian = discrete.around(Discretisation(problem, grid, scheme, value.dtype), value)
    best = optimum.optimise(hamiltonian)[0]

    def lowest(points):
        return jnp.min(jax.lax.map(lambda point: hamiltonian.at(list(point), []), points), axis=0)

    return best, lowest(problem.controls.grid(81).points), lowest(samples(problem.controls, SAMPLES))


# --- finite sets and games ---


@functools.partial(jax.jit, static_argnames=("scheme", "isaacs"))
def optimal(problem, grid, value, scheme, isaacs=None):
    hamiltonian = discrete.around(Discretisation(problem, grid, scheme, value.dtype), value)
    return optimum.optimise(hamiltonian, isaacs=isaacs)


@functools.partial(jax.jit, static_argnames="scheme")
def table_of(problem, grid, value, controls, disturbances, scheme):
    """H for every pair, shape (K, L, *grid)."""
    hamiltonian = discrete.around(Discretisation(problem, grid, scheme, value.dtype), value)

    def at(u, d):
        return hamiltonian.at(list(u), list(d))

    return jax.lax.map(lambda u: jax.lax.map(lambda d: at(u, d), disturbances), controls)


@pytest.mark.parametrize("count", [3, pytest.param(130, marks=pytest.mark.slow)])
@given(seed=SEEDS)
@settings(max_examples=5)
def test_a_finite_set_is_enumerated(count, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 2)
    problem = random_problem(rng, grid, "matrix", Finite(rng.uniform(-1, 1, (count, 2))))
    value = rng.normal(size=grid.shape)
    best, u, _ = jax.device_get(optimal(problem, grid, value, Upwind()))
    table = np.asarray(table_of(problem, grid, value, problem.controls.points, np.zeros((1, 0)), Upwind()))[:, 0]
    assert np.allclose(best, np.min(table, axis=0), rtol=1e-12, atol=1e-12)
    assert np.array_equal(np.stack(u, axis=-1), problem.controls.points[np.argmin(table, axis=0)])


# the second pair of numbers is beyond what is unrolled
@pytest.mark.parametrize(("mine", "theirs"), [(3, 4), pytest.param(11, 12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("isaacs", ["upper", pytest.param("lower", marks=pytest.mark.slow)])
@given(seed=SEEDS)
@settings(max_examples=4)
def test_min_max_against_all_pairs(isaacs, mine, theirs, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 2)
    sets = Finite(rng.uniform(-1, 1, (mine, 1))), Finite(rng.uniform(-1, 1, (theirs, 2)))
    problem = random_game(rng, grid, "diagonal", *sets, isaacs=isaacs)
    value = rng.normal(size=grid.shape)
    best, u, d = jax.device_get(optimal(problem, grid, value, Upwind()))
    table = np.asarray(table_of(problem, grid, value, sets[0].points, sets[1].points, Upwind()))
    expected = table.max(axis=1).min(axis=0) if isaacs == "upper" else table.min(axis=0).max(axis=0)
    assert np.allclose(best, expected, rtol=1e-12, atol=1e-12)
    assert np.allclose(best, both_forms(problem, grid, value, u, d, Upwind())[0], rtol=1e-12, atol=1e-12)


@pytest.mark.slow  # two nested optimisations over continua: half a minute of compilation
@given(seed=SEEDS)
@settings(max_examples=5)
def test_lower_is_at_most_upper(seed):
    """The outer player's set is sampled and refined, the inner player's reply to it is exact."""
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 2)
    problem = random_game(rng, grid, "diagonal", UNIT, Box([-0.5], [1.0]))
    value = rng.normal(size=grid.shape)
    (upper, u, _), (lower, _, d) = (optimal(problem, grid, value, Upwind(), isaacs) for isaacs in ("upper", "lower"))
    slack = 1e-12 * (1 + float(jnp.max(jnp.abs(upper))))
    assert jnp.all(lower <= upper + slack)
    highest, lowest = replies(problem, grid, value, u, d)
    assert jnp.all(highest <= upper + slack)
    assert jnp.all(lowest >= lower - slack)


@jax.jit
def replies(problem, grid, value, u, d):
    """max over d of H(u, d) and min over u of H(u, d), over scans, at given actions of the other."""
    hamiltonian = discrete.around(Discretisation(problem, grid, Upwind(), value.dtype), value)
    against_u = jax.lax.map(lambda point: hamiltonian.at(u, list(point)), problem.disturbances.grid(301).points)
    against_d = jax.lax.map(lambda point: hamiltonian.at(list(point), d), problem.controls.grid(301).points)
    return jnp.max(against_u, axis=0), jnp.min(against_d, axis=0)


def test_upwinding_opens_a_gap_at_a_kink():
    """f = u + d with D⁺ = 1, D⁻ = −1: H = |u + d|, min max 1 and max min 0."""
    problem = Problem(lambda x, u, d: u + d, None, UNIT, disturbances=UNIT, discount=1.0)
    grid = Grid([-1.0], [1.0], (3,))
    value = jnp.abs(jnp.linspace(-1.0, 1.0, 3))
    assert np.isclose(optimal(problem, grid, value, Upwind(), "upper")[0][1], 1)
    assert np.isclose(optimal(problem, grid, value, Upwind(), "lower")[0][1], 0)


@pytest.mark.parametrize("slope", [2.0, pytest.param(-0.5, marks=pytest.mark.slow)])
def test_a_squared_difference_has_a_gap_everywhere(slope):
    """ẋ = (u − d)²: min max is p⁺ and max min −p⁻, so they differ by |p|."""
    problem = Problem(lambda x, u, d: (u - d) ** 2, None, UNIT, disturbances=UNIT, discount=1.0)
    grid = Grid([0.0], [1.0], (5,))
    value = slope * jnp.linspace(0.0, 1.0, 5)
    upper, lower = (optimal(problem, grid, value, Upwind(), isaacs)[0][:-1] for isaacs in ("upper", "lower"))
    assert np.allclose(upper, max(slope, 0), atol=1e-9)
    assert np.allclose(lower, min(slope, 0), atol=1e-9)


@pytest.mark.parametrize(
    ("drift", "cost", "noise", "decoupled"),
    [
        (lambda x, u, d: jnp.stack([u[0], d[0]]), None, None, True),
        (lambda x, u, d: jnp.stack([u[0], x[0] * d[0]]), lambda x, u, d: u @ u - d @ d, None, True),
        (lambda x, u, d: jnp.stack([u[0] + d[0], x[0]]), None, None, False),
        (lambda x, u, d: jnp.stack([u[0] * d[0], x[0]]), None, None, False),
        (lambda x, u, d: jnp.stack([u[0], d[0]]), lambda x, u, d: u[0] * d[0], None, False),
        (lambda x, u, d: jnp.stack([u[0], d[0]]), lambda x, u, d: jnp.exp(u[0] + d[0]), None, False),
        (lambda x, u, d: jnp.stack([u[0], d[0]]), None, lambda x, u, d: u, False),
    ],
)
def test_players_that_do_not_touch_each_other_are_told(drift, cost, noise, decoupled):
    problem = Problem(drift, cost, UNIT, disturbances=UNIT, noise=noise, discount=1.0)
    players = find_players(problem, 2, np.float64)
    assert players.decoupled == decoupled
    assert players.disturbance_costs == (cost is not None)


@pytest.mark.parametrize("isaacs", ["upper", "lower"])
def test_decoupled_players_reach_the_saddle(isaacs):
    def drift(x, u, d):
        return jnp.stack([jnp.sin(x[1]) + u[0], 0.3 + x[0] * d[0]])

    game = Problem(
        drift, lambda x, u, d: u[0] ** 2 - 0.5 * d[0] ** 2, UNIT, disturbances=UNIT, discount=1.0, isaacs=isaacs
    )
    grid = Grid([-1.0, -1.0], [1.0, 1.0], (6, 5))
    value = np.random.default_rng(3).normal(size=grid.shape)
    best, u, d = optimal(game, grid, value, Upwind())
    highest, lowest = replies(game, grid, value, u, d)
    assert jnp.all(highest <= best + 1e-12)
    assert jnp.all(lowest >= best - 1e-12)


def test_one_player_at_a_time():
    """A problem in which only the disturbance acts: it maximises, exactly."""
    problem = Problem(lambda x, d: 0 * x, lambda x, d: d[0], UNIT, discount=1.0)
    grid = Grid([0.0], [1.0], (3,))
    assert optimal(problem, grid, jnp.zeros(3), Upwind())[0].tolist() == [-1.0] * 3
    alone = Problem(lambda x, u, d: 0 * x, lambda x, u, d: d[0] - d[0] ** 2, disturbances=UNIT, discount=1.0)
    best, u, d = optimal(alone, grid, jnp.zeros(3), Upwind())
    assert np.allclose(best, 0.25, rtol=1e-14)
    assert u == []
    assert np.allclose(d[0], 0.5, rtol=1e-12)


@pytest.mark.slow
def test_a_reply_meets_the_others_action():
    problem = Problem(lambda x, u, d: 0 * x, lambda x, u, d: u[0] * d[0], UNIT, disturbances=UNIT, discount=1.0)
    grid = Grid([0.0], [1.0], (3,))
    players = find_players(problem, 1, np.float64)
    hamiltonian = discrete.around(Discretisation(problem, grid, Upwind(), jnp.zeros(3).dtype), jnp.zeros(3))
    fixed = [jnp.array([-1.0, 0.5, 1.0])]
    value, action = optimum.best_response(hamiltonian, players.disturbance, lambda d: (fixed, d))
    assert np.allclose(value, [1.0, 0.5, 1.0], rtol=1e-14)
    assert np.allclose(action[0], [-1.0, 1.0, 1.0], rtol=1e-14)
