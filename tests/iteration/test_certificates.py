"""Every certificate contains a direct solution: policy iteration with dense matrices, written here."""

import dataclasses
import functools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from systems import SEEDS, random_grid, random_problem

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.schemes import Upwind
from hjbjax.iteration import bellman, certificates
from hjbjax.iteration.bellman import Obstacles
from hjbjax.iteration.certificates import Certificate
from hjbjax.markov_chain import chain
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast
from hjbjax.problem.sets import Finite
from hjbjax.solution.solution import Solution

pytestmark = pytest.mark.usefixtures("float64")
POINTS = np.array([[-1.0], [0.0], [0.4], [1.0]])
laws = settings(max_examples=10)


@functools.partial(jax.jit, static_argnames="kind")
def measured(kind, problem, grid, value, obstacles, least_cost, counted, moved):
    on = Discretisation(problem, grid, Upwind(), value.dtype)
    policy = bellman.greedy(on, value, obstacles.fixed)
    equation = bellman.policy_equation(on, value, policy, obstacles)
    iterate = certificates.Iterate(grid.layout, value, policy, equation, obstacles, counted)
    bound = certificates.error_bound(kind, iterate, discount=problem.discount, least_cost=least_cost, moved=moved)
    return bound, equation


def bounds_of(kind, problem, grid, value, obstacles, least_cost=None, counted=None):
    counted = np.ones(grid.shape, bool) if counted is None else counted
    gap, _ = jax.device_get(measured(kind, problem, grid, value, obstacles, least_cost, counted, np.inf))
    return gap, Solution(grid, value, None, enclosure=certificates.affine_bounds(kind, gap, problem.discount)).bounds


def exact_solution(problem, grid, obstacles, start=0.0):
    """Dense solves: Howard's iteration of who pays, inside that of who may lift the value to the floor.

    Newton's method on max(g, min(ψ, T V)) at once, where one maximises and the other minimises, may cycle: so this is
    the iteration of Hoffman and Karp.
    """
    size = grid.size
    x = grid.nodes().reshape(size, grid.ndim)
    generators = [chain.generator(problem, grid, np.broadcast_to(u, (*grid.shape, 1))).toarray() for u in POINTS]
    costs = [
        np.zeros(size) if problem.cost is None else np.asarray(jax.vmap(lambda x, u=u: problem.cost(x, u))(x))
        for u in POINTS
    ]
    floored = np.zeros(size, bool)
    value = np.where(
        np.ravel(obstacles.fixed),
        np.ravel(obstacles.fixed_value),
        np.ravel(start if obstacles.upper is None else obstacles.upper),
    )
    for _ in range(200):
        value, ahead = _without_floor(
            np.array(generators), np.array(costs), problem.discount, obstacles, floored, value
        )
        if obstacles.lower is None:
            return value.reshape(grid.shape)
        gain, slack = np.ravel(obstacles.lower) - value - ahead, 1e-12 * (1 + np.max(np.abs(value)))
        after = ~np.ravel(obstacles.fixed) & np.where(floored, gain >= -slack, gain > slack)
        if np.array_equal(after, floored):
            return value.reshape(grid.shape)
        floored = after
    raise AssertionError("the oracle does not converge")


def _without_floor(generators, costs, discount, obstacles, floored, value):
    """Howard's iteration over actions and stopping where the floor is held, and what min(ψ, T V) − V is left."""
    size, here = len(value), np.arange(len(value))
    held = np.ravel(obstacles.fixed) | floored
    given = np.where(
        np.ravel(obstacles.fixed),
        np.ravel(obstacles.fixed_value),
        0 if obstacles.lower is None else np.ravel(obstacles.lower),
    )
    stop = np.full(size, np.inf) if obstacles.upper is None else np.ravel(obstacles.upper)
    choice = np.full(size, -1)
    for _ in range(200):
        rates = costs + generators @ value - discount * value
        # keep the incumbent unless the gain is real, so that the iteration ends
        new = np.argmin(rates, axis=0)
        better = rates[new, here] < rates[choice, here] - 1e-11 * (1 + np.max(np.abs(value)))
        choice = np.where((choice < 0) | better, new, choice)
        outflow = discount - generators[choice, here, here]
        step = rates[choice, here] / np.where(outflow > 0, outflow, 1)
        ends = held | (stop - value < step - 1e-12)
        matrix = np.where(ends[:, None], np.eye(size), discount * np.eye(size) - generators[choice, here])
        after = np.linalg.solve(matrix, np.where(held, given, np.where(ends, stop, costs[choice, here])))
        done = np.max(np.abs(after - value)) <= 1e-12 * (1 + np.max(np.abs(value)))
        value = after
        if done:
            return value, np.minimum(stop - value, step)
    raise AssertionError("the oracle does not converge")


def discounted(rng, kind, n, with_rules):
    grid = random_grid(rng, n)
    problem = random_problem(rng, grid, kind, Finite(POINTS), discount=rng.uniform(0.2, 2))
    obstacles = Obstacles(np.zeros(grid.shape, bool), np.zeros(grid.shape))
    if with_rules:
        held = rng.random(grid.shape) < 0.15
        stop, floor = rng.uniform(-0.5, 2, grid.shape), rng.uniform(-2, 0.5, grid.shape)
        obstacles = Obstacles(held, np.where(held, rng.normal(size=grid.shape), 0), stop, floor)
    return problem, grid, obstacles


@pytest.mark.parametrize(
    ("n", "kind", "with_rules"),
    [
        (1, "diagonal", False), (1, "diagonal", True), (2, "none", False), (2, "matrix", True),
        *(pytest.param(2, *each, marks=pytest.mark.slow) for each in (("none", True), ("matrix", False))),
    ],
)  # fmt: skip
@given(seed=SEEDS)
@laws
def test_the_discounted_bound_contains_the_exact_solution(n, kind, with_rules, seed):
    rng = np.random.default_rng(seed)
    problem, grid, obstacles = discounted(rng, kind, n, with_rules)
    exact = exact_solution(problem, grid, obstacles)
    noise = rng.choice([0.0, 1e-6, 1.0]) * rng.normal(size=grid.shape)
    value = np.asarray(obstacles.impose(exact + noise))
    gap, (lower, upper) = bounds_of(Certificate.ADDITIVE, problem, grid, value, obstacles)
    slack = 1e-9 * (1 + np.max(np.abs(exact)))
    assert np.all(lower <= exact + slack)
    assert np.all(exact <= upper + slack)
    assert np.max(np.abs(value - exact)) <= gap.error + slack
    if not noise.any():
        assert gap.error <= slack


def test_the_discounted_bound_is_sharp():
    """A constant off by δ leaves r = −βδ: the bound is δ and no more."""
    problem = Problem(lambda x, u: u, lambda x, u: 1.0 + 0 * x[0], Finite(POINTS), discount=0.5)
    grid = Grid([0.0], [1.0], (5,))
    obstacles = Obstacles(np.zeros(5, bool), np.zeros(5))
    gap, (lower, upper) = bounds_of(Certificate.ADDITIVE, problem, grid, np.full(5, 2.25), obstacles)
    assert np.allclose(lower, 2.0, rtol=1e-14)
    assert np.allclose(upper, 2.0, rtol=1e-14)
    assert np.isclose(gap.error, 0.25, rtol=1e-14)


@pytest.mark.parametrize(("n", "kind"), [pytest.param(1, "none", marks=pytest.mark.slow), (2, "diagonal")])
@given(seed=SEEDS)
@laws
def test_the_undiscounted_bound_contains_the_exact_solution(n, kind, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n, periodic=False)
    speed, slope = rng.uniform(0.5, 2), rng.uniform(0, 2, n)
    problem = Problem(
        jax.tree_util.Partial(_away, speed),
        jax.tree_util.Partial(_toll, slope, grid.lo),
        Finite(POINTS),
        noise=None if kind == "none" else rng.uniform(0.1, 1, n),
    )
    held = np.zeros(grid.shape, bool)
    held[0] = held[-1] = True
    obstacles = Obstacles(held, np.where(held, rng.uniform(0, 1, grid.shape), 0))
    steps = np.minimum(np.arange(len(held)), np.arange(len(held))[::-1])  # steep: its greedy policy is proper
    start = np.broadcast_to(1e3 * steps.reshape(-1, *[1] * (n - 1)), grid.shape)
    exact = exact_solution(problem, grid, obstacles, start)
    assert np.all(exact >= 0)
    least = 0.3 + (grid.nodes() - grid.lo) @ slope
    deep = rng.choice([0.0, 5.0])  # exits that pay move the whole value
    exact, obstacles = (
        exact - deep,
        dataclasses.replace(obstacles, fixed_value=np.where(held, obstacles.fixed_value - deep, 0)),
    )
    for noise in (0.0, 1e-6, 0.2):
        value = np.where(
            held, obstacles.fixed_value, (exact + deep) * (1 + noise * rng.uniform(-1, 1, grid.shape)) - deep
        )
        gap, (lower, upper) = bounds_of(Certificate.MULTIPLICATIVE, problem, grid, value, obstacles, least)
        assert (gap.lift > 0) == (deep > 0)
        slack = 1e-8 * (1 + np.max(np.abs(exact)))
        assert np.all(lower <= exact + slack)
        assert np.all(exact <= upper + slack)
        assert np.max(np.abs(value - exact)) <= gap.error + slack
        assert noise > 0 or gap.error <= slack


def _away(speed, x, u):
    return speed * u[0] * jnp.ones_like(x).at[1:].set(0.5)


def _toll(slope, lo, x, u):
    return 0.3 + slope @ (x - lo) + 0.5 * u[0] ** 2


def test_before_the_first_look_nothing_is_known():
    unlooked = certificates.ErrorBound(-np.inf, np.inf, 0.0, np.inf, np.inf)
    for kind in (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE):
        value = np.array([0.0, 2.0, np.inf])
        solution = Solution(Grid([0.0], [1.0], (3,)), value, None, enclosure=certificates.affine_bounds(kind, unlooked))
        np.testing.assert_array_equal(solution.bounds, [[-np.inf, -np.inf, np.inf], [np.inf] * 3])
        assert solution.error == np.inf


def minimum_time():
    """ẋ = u on five nodes with both ends held: the time to the nearer end, 0, ¼, ½, ¼, 0."""
    problem = Problem(lambda x, u: u, lambda x, u: 1.0 + 0 * x[0], Finite(POINTS))
    grid = Grid([0.0], [1.0], (5,))
    held = np.array([True, False, False, False, True])
    return problem, grid, Obstacles(held, np.zeros(5)), np.array([0.0, 0.25, 0.5, 0.25, 0.0])


def test_minimum_time_by_hand():
    problem, grid, obstacles, exact = minimum_time()
    for factor in (1.0, 1.1, 0.8):
        gap, (lower, upper) = bounds_of(
            Certificate.MULTIPLICATIVE, problem, grid, factor * exact, obstacles, np.ones(5)
        )
        assert np.allclose(lower if factor > 1 else upper, exact, rtol=1e-12)  # sharp on a multiple of the answer
        assert np.isclose(gap.error, 0.5 * max(factor - 1, 1 - factor), atol=1e-12)


def test_no_bound_where_the_theorem_says_nothing():
    problem, grid, obstacles, exact = minimum_time()
    negative, _ = bounds_of(Certificate.MULTIPLICATIVE, problem, grid, exact - 0.3, obstacles, np.ones(5))
    assert np.isinf(negative.error)
    low = np.where(obstacles.fixed, 0, 1e-6)
    steep, (_, upper) = bounds_of(Certificate.MULTIPLICATIVE, problem, grid, low, obstacles, np.ones(5))
    assert np.all(upper >= exact)
    flat, (_, upper) = bounds_of(Certificate.MULTIPLICATIVE, problem, grid, 0 * exact, obstacles, np.ones(5))
    assert np.isinf(flat.above)  # r = L
    assert np.all(np.isinf(upper))  # not 0 · inf
    assert np.isfinite(steep.below)
    free, _ = bounds_of(Certificate.MULTIPLICATIVE, problem, grid, 0.9 * exact, obstacles, np.array([1.0, 1, 0, 1, 1]))
    assert np.isinf(free.error)
    assert certificates.affine_bounds(Certificate.NONE, free) is None


def test_where_the_value_is_flat_rounding_certifies_nothing():
    """r = L at a node that no action improves; a least cost that is larger by rounding leaves 1 − ρ = 2e-16."""
    problem, grid, obstacles, exact = minimum_time()
    least = np.full(5, 1 + np.finfo(float).eps)
    flat, (_, upper) = bounds_of(Certificate.MULTIPLICATIVE, problem, grid, 0 * exact, obstacles, least)
    assert np.isinf(flat.above)
    assert np.isinf(flat.error)
    assert np.all(np.isinf(upper))
    single = cast((problem, grid, np.zeros(5), obstacles, np.full(5, 1 + 1e-6)), np.float32)
    flat, _ = bounds_of(Certificate.MULTIPLICATIVE, *single)
    assert flat.above.dtype == np.float32
    assert np.isinf(flat.error)


@given(seed=SEEDS)
def test_lifted_bounds_are_rounded_outwards(seed):
    """Beside (V + lift) · factor − lift without rounding, at and near the lowest exit cost −lift."""
    rng = np.random.default_rng(seed)
    lift = float(10.0 ** rng.uniform(-9, 9) * rng.choice([0.0, 1.0], p=[0.1, 0.9]))
    below, above = float(rng.choice([1.0, rng.uniform(0, 1)])), float(10.0 ** rng.choice([0.0, rng.uniform(0, 7.8)]))
    value = np.append(-lift, -lift * (1 - 10.0 ** rng.uniform(-16, 0, 20)))
    gap = certificates.ErrorBound(*(np.asarray(number) for number in (below, above, lift, 0.0, 0.0)))
    enclosure = certificates.affine_bounds(Certificate.MULTIPLICATIVE, gap)
    lower, upper = Solution(Grid([0.0], [1.0], (21,)), value, None, enclosure=enclosure).bounds
    for v, low, high in zip(value, lower, upper, strict=True):
        raised = Fraction(v) + Fraction(lift)
        assert Fraction(low) <= raised * Fraction(below) - Fraction(lift) <= Fraction(v)
        assert Fraction(v) <= raised * Fraction(above) - Fraction(lift) <= Fraction(high)
    assert np.max(np.abs(lower[0] - value[0])) <= 2e-15 * lift
    assert np.max(np.abs(upper[0] - value[0])) <= 2e-15 * lift * above


@pytest.mark.parametrize("kind", list(Certificate))
def test_a_nan_certifies_nothing(kind):
    problem, grid, obstacles, exact = minimum_time()
    gap, _ = bounds_of(kind, problem, grid, np.where(np.arange(5) == 2, np.nan, exact), obstacles, np.ones(5))
    assert not gap.residual <= 1e300
    assert not gap.error <= 1e300


def test_without_a_certificate_the_last_step_counts_too():
    problem, grid, obstacles, exact = minimum_time()
    counted = np.ones(5, bool)
    gap, equation = measured(Certificate.NONE, problem, grid, 1.5 * exact, obstacles, None, counted, 0.0)
    assert np.isclose(gap.residual, np.max(np.abs(equation.source)), rtol=1e-14)
    assert gap.error == gap.residual
    later, _ = measured(Certificate.NONE, problem, grid, 1.5 * exact, obstacles, None, counted, 7.0)
    assert later.error == 7.0


def test_nodes_that_do_not_count_do_not_spoil_the_bound():
    problem, grid, obstacles, exact = minimum_time()
    value = np.where(np.arange(5) == 3, 1e6, exact)
    counted = np.array([True, True, False, False, True])
    gap, _ = bounds_of(Certificate.MULTIPLICATIVE, problem, grid, value, obstacles, np.ones(5), counted)
    assert np.isclose(gap.error, 0, atol=1e-12)


def test_every_certificate_says_itself_in_words():
    assert all(len(kind.value.split()) > 4 for kind in Certificate)


@given(seed=SEEDS)
@laws
def test_without_cost_and_discount_constraints_supply_the_value(seed):
    """A reach-avoid tube: V = max(g, min(ψ, V at the best neighbour)); a fixed point of the step has no residual."""
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 1)
    problem = Problem(lambda x, u: u, None, Finite(POINTS))
    stop, floor = rng.uniform(0, 1, 7), rng.uniform(-1, 0.5, 7)
    obstacles = Obstacles(np.zeros(7, bool), np.zeros(7), stop, floor)
    value = np.maximum(floor, stop)
    for _ in range(20):  # ends after at most as many steps as there are nodes
        best = np.minimum(value, np.minimum(np.r_[value[1:], value[-1]], np.r_[value[0], value[:-1]]))
        value = np.maximum(floor, np.minimum(stop, best))
    gap, _ = bounds_of(Certificate.NONE, problem, grid, value, obstacles)
    assert gap.residual <= 1e-14
    worse, _ = bounds_of(Certificate.NONE, problem, grid, value + np.where(np.arange(7) == 3, 0.5, 0), obstacles)
    assert worse.residual >= 0.01
