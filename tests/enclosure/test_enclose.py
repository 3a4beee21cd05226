"""Bounds on the true value hold at all states, close with the mesh, and are refused where nothing is proved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import hjbjax as hjb
from hjbjax.enclosure import branches, defect
from hjbjax.enclosure.discounted import DiscountTask
from hjbjax.enclosure.interpolant import Spline

BETA = 0.7


def near(grid, value, error=0.0):
    """A solution whose node values are the exact ones, up to an error that varies from node to node."""
    nodes = grid.nodes()
    with jax.enable_x64(True):
        flat = np.asarray(jax.vmap(value)(nodes.reshape(-1, grid.ndim))).reshape(grid.shape)
    wave = np.sin(np.sum(37 * nodes, axis=-1))
    return hjb.Solution(grid, flat + error * np.ptp(flat) * wave, None, code=hjb.Status.CONVERGED)


def check(found, value, lo, hi, count=2000, seed=0):
    """The value is between the bounds at random states; returns the largest width there relative to its range."""
    states = np.random.default_rng(seed).uniform(lo, hi, (count, len(lo)))
    with jax.enable_x64(True):
        exact = np.asarray(jax.vmap(value)(states))
    low, high = found.lower_at(states), found.upper_at(states)
    assert np.all(low <= exact)
    assert np.all(exact <= high)
    return float(np.max(high - low) / np.ptp(exact))


def manufactured(value, drift, least, controls, rate=BETA):
    """The problem with a chosen value: L = q + |u|²/2 with q = β V − min over u of |u|²/2 + f·DV.

    Args:
      value: V.
      drift: f(x, u), affine in u.
      least: the minimum over the admissible u of |u|²/2 + b·u, as a function of b.
      controls: the set of u.
      rate: β.
    """

    def cost(x, u):
        still = jnp.zeros_like(u)
        slope = jax.grad(value)(x)
        gain = jax.jacfwd(drift, 1)(x, still).T @ slope
        return rate * value(x) - drift(x, still) @ slope - least(gain) + u @ u / 2

    return hjb.Problem(drift, cost, controls, discount=rate)


def in_box(bound):
    return lambda b: jnp.sum(jnp.clip(-b, -bound, bound) * (b + jnp.clip(-b, -bound, bound) / 2))


def wave(draw, n):
    """A random periodic function on [0, 1]^n."""
    numbers = draw.normal(size=(2, n + 1))

    def value(x):
        angle = 2 * jnp.pi * x
        inner = sum(numbers[0, k] * jnp.sin(angle[k] + numbers[1, k]) for k in range(n))
        return inner + 0.2 * numbers[0, n] * jnp.exp(jnp.cos(angle[0])) * jnp.sin(angle[-1])

    return value


def random_problem(seed, n):
    """A random nonlinear problem on the torus with its exact value."""
    draw = np.random.default_rng(seed)
    value, fields = wave(draw, n), [wave(draw, n) for _ in range(2 * n)]
    reach = draw.uniform(0.3, 3.0)

    def drift(x, u):
        return jnp.stack([0.3 * fields[k](x) + (1 + 0.2 * jnp.sin(fields[n + k](x))) * u[k] for k in range(n)])

    return manufactured(value, drift, in_box(reach), hjb.Box([-reach] * n, [reach] * n)), value


def test_the_value_of_a_random_problem_is_enclosed_and_the_bounds_close_with_the_mesh():
    problem, value = random_problem(0, 1)
    widths = []
    for count in (24, 48):
        grid = hjb.Grid([0.0], [1.0], (count,), periodic=(True,))
        found = hjb.enclose(problem, near(grid, value, 1e-3), rounds=2)
        widths.append(check(found, value, [-1.0], [2.0]))
        assert np.all(found.lower <= found.upper)
        np.testing.assert_array_equal(found.lower, found.lower_at(grid.nodes()))
    assert widths[1] < 0.5 * widths[0]


def test_a_spline_and_its_gradient_are_within_their_ranges_over_cells():
    draw = np.random.default_rng(3)
    grid = hjb.Grid([-1.0, 0.0], [2.0, 1.0], (7, 6), periodic=(False, True))
    spline, values = Spline.on(grid), draw.normal(size=grid.shape)
    states = draw.uniform([-1.0, 0.01], [2.0, 0.99], (500, 2))
    index = [np.searchsorted(table.between, states[:, k], side="right") for k, table in enumerate(spline.tables)]
    w, p = spline.cells(index).scalars(values)
    here = spline.at(states).values(values)
    assert np.all(here.hi - here.lo < 1e-11)
    assert np.all((w.range.lo <= here.hi) & (here.lo <= w.range.hi))
    assert np.all(here.lo <= spline.range(values).hi[tuple(index)])
    assert np.all(spline.range(values).lo[tuple(index)] <= here.hi)
    other = draw.normal(size=grid.shape)
    gap = spline.largest_difference(values, other, index)
    assert np.all(here.lo - spline.at(states).values(other).hi <= gap)
    np.testing.assert_allclose(gap, spline.range(values - other).hi[tuple(index)], rtol=1e-12, atol=1e-12)
    assert np.all(spline.range(values).hi[tuple(index)] <= w.range.hi + 1e-11)
    for k in range(2):
        step = 1e-4 * np.eye(2)[k]
        # the spline is a parabola in each coordinate, so that a central difference is exact inside a cell
        ends = [spline.at(np.clip(states + side * step, grid.lo, grid.hi)).values(values).lo for side in (1, -1)]
        slope, exact = (ends[0] - ends[1]) / 2e-4, p[k].range
        assert np.all((exact.lo - 1e-2 <= slope) & (slope <= exact.hi + 1e-2))


@pytest.mark.parametrize("controls", [hjb.Box([-2.0, -1.0], [2.0, 1.0]), hjb.Finite([[-1.0, 0.0], [1.0, 0.5]])])
def test_a_list_of_cells_has_the_defects_of_all_cells(controls):
    """Cells in a mesh share the functions of one coordinate; those in a list do not."""
    draw = np.random.default_rng(1)
    drift = lambda x, u: jnp.stack([jnp.sin(x[0]) * x[1] + u[0], jnp.cos(x[0]) * (1 + u[1])])  # noqa: E731
    problem = hjb.Problem(drift, lambda x, u: x[0] ** 2 * jnp.exp(x[1]) + u @ u, controls, discount=0.5)
    grid = hjb.Grid([-1.0, 0.0], [1.0, 2.0], (9, 12), periodic=(False, True))
    spline, values = Spline.on(grid), draw.normal(size=grid.shape)
    every = [each.ravel() for each in np.meshgrid(*map(np.arange, spline.shape), indexing="ij")]
    with jax.enable_x64(True):
        mesh = defect.blocks(problem, grid, spline, defect.all_cells(spline), 0)
        whole = defect.defects(spline, mesh, values)
        listed = defect.defects(spline, defect.blocks(problem, grid, spline, every, 0), values)
        some = draw.random(spline.shape) < 0.3
        part = defect.defects(spline, defect.chosen_cells(mesh, some), values)
        policy = defect.greedy_policy(spline, mesh, values)
    for name in ("low", "high", "policy"):
        np.testing.assert_allclose(getattr(listed, name), getattr(whole, name), rtol=1e-12)
        np.testing.assert_allclose(getattr(part, name)[some], getattr(whole, name)[some], rtol=1e-12)
    np.testing.assert_allclose(policy, whole.policy, atol=1e-12)


@pytest.mark.slow
def test_a_value_in_three_dimensions_is_enclosed_and_the_bounds_close_with_the_mesh():
    value = lambda x: 0.3 * jnp.sum(jnp.cos(2 * jnp.pi * x)) + 0.2 * jnp.sin(2 * jnp.pi * (x[0] + x[1]))  # noqa: E731
    drift = lambda x, u: 0.2 * jnp.sin(2 * jnp.pi * x[jnp.array([1, 2, 0])]) + u  # noqa: E731
    problem, widths = manufactured(value, drift, in_box(2.0), hjb.Box([-2.0] * 3, [2.0] * 3)), []
    for count in (12, 24):
        grid = hjb.Grid([0.0] * 3, [1.0] * 3, (count,) * 3, periodic=(True,) * 3)
        found = hjb.enclose(problem, near(grid, value), rounds=1)
        widths.append(check(found, value, [0.0] * 3, [1.0] * 3))
    assert widths[1] < 0.5 * widths[0]


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2])
def test_the_values_of_many_random_problems_are_enclosed(n):
    for seed in range(40 if n == 1 else 5):
        problem, value = random_problem(100 + seed, n)
        grid = hjb.Grid([0.0] * n, [1.0] * n, (32,) * n, periodic=(True,) * n)
        check(hjb.enclose(problem, near(grid, value, 1e-3), rounds=3), value, [0.0] * n, [1.0] * n, seed=seed)


def test_a_quadratic_value_is_enclosed_on_a_stretched_axis():
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-3.0], [3.0]), discount=1.0)
    grid = hjb.Grid([-1.0], [1.0], (41,), stretch=(hjb.Sinh(2.0, 0.4),))
    exact = lambda x: (5**0.5 - 1) / 2 * (x @ x)  # noqa: E731
    found = hjb.enclose(problem, near(grid, exact))
    assert check(found, exact, [-1.0], [1.0]) < 1e-2
    assert found.status is hjb.Status.CONVERGED
    assert "walls at the projected ends" in found.message


@pytest.mark.slow
def test_the_bounds_close_with_the_mesh_faster_than_linearly():
    exact, widths = hjb.zoo.smooth_exact(), []
    for count in (41, 81):
        problem, grid = hjb.zoo.smooth(shape=(count, count))
        found = hjb.enclose(problem, hjb.solve(problem, grid))
        widths.append(check(found, exact, [-0.5, -0.45], [0.5, 0.45], 100_000))
    assert np.log2(widths[0] / widths[1]) > 1.5
    assert widths[1] < 0.005


def test_the_time_until_a_wall_is_met_is_a_lower_bound():
    """x' = x/2 + u with |u| ≤ 1: the earliest exit from x ≥ 0 is at 2 log(2/(1 + x/2)) for an end at 2."""
    problem = hjb.Problem(lambda x, u: x / 2 + u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    grid = hjb.Grid([-2.0], [2.0], (81,))
    found = hjb.enclose(problem, near(grid, lambda x: x @ x), rounds=1)
    exact = ((1 + np.abs(np.asarray(grid.axis(0))) / 2) / 2) ** 2
    assert np.all(exact <= found.remaining)
    assert np.max(found.remaining / exact) < 1.05
    cyclic = hjb.Grid([-2.0], [2.0], (8,), periodic=(True,))
    steady = hjb.Problem(lambda x, u: u, lambda x, u: u @ u, hjb.Box([-1.0], [1.0]), discount=1.0)
    assert not np.any(hjb.enclose(steady, near(cyclic, lambda x: 0 * x[0]), rounds=1).remaining)


def riccati():
    """The double integrator with a quadratic cost, and its value x'Px."""
    rate, a, b = 1.0, np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    p = scipy.linalg.solve_continuous_are(a - rate / 2 * np.eye(2), b, np.eye(2), np.eye(1))
    problem = hjb.Problem(
        lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: x @ x + u @ u, hjb.Box([-np.inf], [np.inf]), discount=rate
    )
    return problem, lambda x: x @ p @ x


@pytest.mark.slow
def test_the_bounds_of_a_riccati_value_close_in_the_inner_half_of_a_large_box():
    (problem, exact), widths = riccati(), []
    for count in (51, 101, 201):
        grid = hjb.Grid([-4.0, -4.0], [4.0, 4.0], (count, count))
        found = hjb.enclose(problem, hjb.solve(problem, grid))
        widths.append(check(found, exact, [-2.0, -2.0], [2.0, 2.0], 100_000))
    assert np.all(np.log2(np.divide(widths[:-1], widths[1:])) > 1.5)
    assert widths[-1] < 0.002


def wells(x):
    """V of x' = u, |u| ≤ 1, with the cost |distance to the nearer of ±1| and the discount 1: a concave kink at zero."""
    distance = jnp.abs(jnp.abs(x[0]) - 1)
    return distance - 1 + jnp.exp(-distance)


SETS = [hjb.Box([-1.0], [1.0]), hjb.Finite([[-1.0], [0.0], [1.0]]), hjb.Ball(1.0, 1)]


@pytest.mark.parametrize("controls", [SETS[0], *(pytest.param(each, marks=pytest.mark.slow) for each in SETS[1:])])
def test_a_value_with_a_concave_kink_is_enclosed(controls):
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: jnp.minimum(jnp.abs(x[0] - 1), jnp.abs(x[0] + 1)), controls, discount=1.0
    )
    widths = []
    for count in (41, 81):
        grid = hjb.Grid([-2.0], [2.0], (count,))
        found = hjb.enclose(problem, near(grid, wells))
        check(found, wells, [-2.0], [2.0])
        widths.append(np.median(found.width))
    assert widths[1] < 0.6 * widths[0]
    assert widths[1] < 0.12


def test_the_bounds_at_a_concave_kink_are_as_near_as_elsewhere():
    """A differentiable upper bound cannot touch it: the width at the kink was 1.7 times the range of V."""
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: jnp.minimum(jnp.abs(x[0] - 1), jnp.abs(x[0] + 1)), SETS[0], discount=1.0
    )
    found = hjb.enclose(problem, near(hjb.Grid([-2.0], [2.0], (161,)), wells))
    assert check(found, wells, [-2.0], [2.0]) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("direction", [[1.0, 0.0], [0.8, 0.6], [-0.6, 0.8]])
def test_an_oblique_kink_is_enclosed(direction):
    """The problem of ``wells`` along a direction, with controls in the unit disc."""
    along = jnp.array(direction)

    def value(x):
        return wells((along @ x)[None])

    problem = hjb.Problem(lambda x, u: u, lambda x, u: jnp.abs(jnp.abs(along @ x) - 1), hjb.Ball(1.0, 2), discount=1.0)
    grid = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (101, 101))
    found = hjb.enclose(problem, near(grid, value))
    assert check(found, value, [-1.0, -1.0], [1.0, 1.0], 20_000) < 0.4  # further out a wall may be in the way


def test_of_several_candidates_only_the_best_one_in_a_cell_must_be_a_bound():
    """Two branches of V meet at a kink. Beyond it each is flat and far from a bound, and their minimum is V."""
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: jnp.minimum(jnp.abs(x[0] - 1), jnp.abs(x[0] + 1)), SETS[0], discount=1.0
    )
    grid = hjb.Grid([-2.0], [2.0], (201,))
    distances = [np.abs(np.maximum(side * grid.nodes()[:, 0], -0.1) - 1) for side in (-1, 1)]
    sides = [each - 1 + np.exp(-each) for each in distances]
    with jax.enable_x64(True):
        spline = Spline.on(grid)
        blocks = defect.blocks(problem, grid, spline, defect.all_cells(spline), 0)
        task = DiscountTask(problem, grid, spline, blocks, 1e-3, np.ones(grid.shape, bool))
        leads = [np.where(branches.is_beaten(task, sides, i, -1), 0.0, np.inf) for i in range(2)]
        needs, _ = branches.required(task, sides, leads, -1, 0.0)
        alone = [float(np.max(-task.defects(each).low)) for each in sides]
    assert min(alone) > 0.3
    assert np.max(needs) < 0.025  # next to ±1, where the cost has a kink


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_a_pendulum_with_swings_is_enclosed():
    """V has kinks along spirals. Both bounds were several ranges of V away from it."""
    problem, fine = hjb.zoo.pendulum(discount=0.5, shape=(800, 801))
    reference = hjb.solve(problem, fine)
    solution = hjb.solve(problem, hjb.zoo.pendulum(shape=(200, 201))[1])
    found = hjb.enclose(problem, solution)
    for state in ([np.pi / 4, 0.0], [0.5, -1.0], [1.0, 1.0]):
        extremal = hjb.pontryagin(problem, state, guess=solution)
        assert found.lower_at(state) <= extremal.cost <= found.upper_at(state)
    nodes = fine.nodes().reshape(-1, 2)
    low, high = found.lower_at(nodes), found.upper_at(nodes)
    value, error = np.asarray(reference.value).ravel(), np.asarray(reference.grid_error).ravel()
    extent = np.ptp(value)
    assert np.all(low <= value + error)
    assert np.all(value - error <= high)
    assert np.median(value - low) < 0.03 * extent
    assert np.median(high - value) < 0.15 * extent


@pytest.mark.slow
def test_a_control_without_a_formula_is_enclosed():
    """The drift sin u and the cost u²/2 + cos u: the minimum over the control is found by pieces."""
    problem = hjb.Problem(
        lambda x, u: jnp.sin(u), lambda x, u: x @ x + 1 - jnp.cos(u[0]), hjb.Box([-2.0], [2.0]), discount=1.0
    )
    grid = hjb.Grid([-1.0], [1.0], (41,))
    solution = hjb.solve(problem, grid)
    found = hjb.enclose(problem, solution)
    assert np.all(found.lower <= solution.value + 1e-3)
    assert np.all(solution.value - 1e-3 <= found.upper)
    assert np.max(found.width) < 0.1 * np.ptp(solution.value)


def test_rewards_change_the_sides_and_a_discount_may_depend_on_the_state():
    """V = −v for a chosen v, with the discount 1 + v²."""
    value = wave(np.random.default_rng(5), 1)
    costs = manufactured(value, lambda x, u: u, in_box(2.0), hjb.Box([-2.0], [2.0]), 1.0)
    rewards = hjb.Problem(
        costs.drift, controls=costs.controls, reward=lambda x, u: -costs.cost(x, u) - value(x) ** 3,
        discount=lambda x: 1.0 + value(x) ** 2,
    )  # fmt: skip
    grid = hjb.Grid([0.0], [1.0], (40,), periodic=(True,))
    solution = hjb.Solution(grid, near(grid, lambda x: -value(x)).value, None, labels=rewards.labels)
    check(hjb.enclose(rewards, solution, rounds=1), lambda x: -value(x), [0.0], [1.0])


def test_what_is_not_proved_is_refused():
    line = hjb.Grid([-1.0], [1.0], (11,))
    base = {"drift": lambda x, u: u, "cost": lambda x, u: x @ x, "controls": hjb.Box([-1.0], [1.0])}
    solution = near(line, lambda x: x @ x)
    for more, word in (
        ({}, "no discount"),
        ({"discount": 1.0, "noise": 0.1}, "noise"),
        ({"discount": 1.0, "target": lambda x: jnp.abs(x[0]) - 0.1}, "a target with a discount"),
        ({"discount": 1.0, "stopping_cost": 1.0}, "stopping_cost"),
        ({"discount": 1.0, "growth": lambda x, u: 0.1}, "growth"),
    ):
        with pytest.raises(ValueError, match=f"got .*{word}"):
            hjb.enclose(hjb.Problem(**base, **more), solution)
    problem = hjb.Problem(**base, discount=1.0)
    with pytest.raises(ValueError, match="open ends"):
        hjb.enclose(problem, near(hjb.Grid([-1.0], [1.0], (11,), edges="open"), lambda x: x @ x))
    with pytest.raises(MemoryError):
        hjb.enclose(problem, solution, max_memory=1000)
    table = jnp.arange(3.0)
    looked_up = hjb.Problem(base["drift"], lambda x, u: jnp.interp(x[0], table, table), base["controls"], discount=1.0)
    with pytest.raises(ValueError, match="there is no interval rule"):
        hjb.enclose(looked_up, solution)
    with pytest.raises(ValueError, match="infinite"):
        hjb.enclose(hjb.Problem(lambda x, u: u / x, base["cost"], base["controls"], discount=1.0), solution)


def test_values_whose_sums_may_overflow_are_refused():
    """A lower value by 1e307 at one node gave an upper bound of −1e307 elsewhere."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: jnp.abs(x[0]), hjb.Box([-1.0], [1.0]), discount=1.0)
    grid = hjb.Grid([-1.0], [1.0], (40,))
    values = np.where(np.arange(40) == 3, -1e307, np.abs(np.asarray(grid.axis(0), float)))
    with pytest.raises(ValueError, match="above 1e"):
        hjb.enclose(problem, hjb.Solution(grid, values, None, code=hjb.Status.CONVERGED))
    spline = Spline.on(grid)
    assert np.all(np.isinf(spline.range(values).hi))
    assert np.all(np.isinf(spline.at(np.zeros((1, 1))).values(values).lo))


def test_the_cells_cover_the_box():
    """The formula of the nodes rounds: on one of ten axes an end node is not the end of the box."""
    draw = np.random.default_rng(0)
    for _ in range(40):
        lo, hi = np.sort(draw.uniform(-3, 3, 2))
        for cyclic in (False, True):
            (table,) = Spline.on(hjb.Grid([lo], [hi], (int(draw.integers(3, 90)),), periodic=(cyclic,))).tables
            assert (table.at[0], table.at[-1]) == (lo, hi)
