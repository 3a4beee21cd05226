"""The generalised Hopf formula: exact values, a march, an oracle by linear programming, and refusals."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import hjbjax as hjb


def free_motion(admissible, terminal):
    return hjb.reach(lambda x, u: u, admissible, terminal, tube=False)


@pytest.mark.parametrize("n", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (10, 50))])
def test_free_motion_to_a_ball_has_its_exact_value_in_any_dimension(n):
    solution = hjb.hopf(free_motion(hjb.Ball(1.0, n), hjb.convex.ball(np.zeros(n), 0.5)), 1.0, intervals=4)
    x = np.random.default_rng(n).normal(size=(12, n))
    x *= np.linspace(0.0, 3.0, 12)[:, None] / np.linalg.norm(x, axis=1, keepdims=True)
    exact = np.maximum(np.linalg.norm(x, axis=1) - 1, 0) - 0.5
    lower, upper = solution.bounds_at(0.0, x)
    error = np.abs(solution.value_at(0.0, x) - exact).max()
    print(f"error {error:.1g}, duality gap {(upper - lower).max():.1g}")
    assert error < 1e-6
    assert np.all(lower <= exact + 1e-12)
    assert np.all(exact <= upper + 1e-12)
    assert (upper - lower).max() < 1e-6


DAMPED = {
    "drift": lambda x, u: jnp.stack([x[1], -0.5 * x[1] + u[0]]),
    "controls": hjb.Box([-1.0], [1.0]),
    "tube": False,
}


@pytest.mark.slow
def test_a_damped_double_integrator_agrees_with_marches():
    problem = hjb.reach(target=hjb.convex.ball([0.0, 0.0], 0.5), **DAMPED)
    found = hjb.hopf(problem, 1.0).on_grid(hjb.Grid([-1.0, -1.0], [1.0, 1.0], (11, 11)), [0.0, 0.5])
    at, far = found.grid.nodes(), []
    assert found.grid_error.max() < 2e-4
    for nodes in (41, 81):
        grid = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (nodes, nodes), edges="linear")
        march = hjb.march(problem, grid, 1.0)
        off = np.abs(found.value[0] - march.value_at(0.0, at))
        print(f"{nodes} nodes: off {off.max():.2g}, mean {off.mean():.2g}, grid error {march.grid_error[0].max():.2g}")
        assert off.max() <= march.grid_error[0].max()
        far.append(off.mean())
    assert far[1] < 0.01
    assert far[1] < 0.6 * far[0]


def lowest_maximum(a, b, x, horizon, half, count):
    """min over controls constant on ``count`` intervals of the largest |x_i(T)|, by a linear program."""
    n, m = b.shape
    h = horizon / count
    whole = expm(np.block([[a, b], [np.zeros((m, n + m))]]) * h)
    step, push = whole[:n, :n], whole[:n, n:]
    columns, free = [], x
    for _ in range(count):
        columns = [step @ column for column in columns] + [push]
        free = step @ free
    effect = np.concatenate(columns, axis=1)
    ones = np.ones((n, 1))
    rows = np.block([[effect, -ones], [-effect, -ones]])
    cost = np.append(np.zeros(effect.shape[1]), 1.0)
    bounds = [(-half, half)] * effect.shape[1] + [(0, None)]
    return linprog(cost, rows, np.concatenate([-free, free]), bounds=bounds).fun


def random_cases(count, seed):
    draw = np.random.default_rng(seed)
    for _ in range(count):
        yield draw.normal(size=(3, 3)), draw.normal(size=(3, 2)), draw.normal(size=3) * draw.uniform(0, 3)


@pytest.mark.slow
def test_the_duality_gap_bounds_the_error_of_random_systems():
    """The oracle restricts the controls to 64 intervals, so it is an upper bound that exceeds V by O(1/64²)."""
    zero = np.zeros(3)

    @jax.jit
    def bounds(a, b, x):
        problem = hjb.reach(
            lambda x, u: a @ x + b @ u, hjb.Box([-1.0] * 2, [1.0] * 2), hjb.convex.box(zero, zero), tube=False
        )
        solution = hjb.hopf(problem, 0.8, intervals=16)
        return solution.value_at(0.0, x), *solution.bounds_at(0.0, x)

    gaps = []
    with jax.enable_x64(True):
        for a, b, x in random_cases(1000, 7):
            value, lower, upper = map(float, bounds(a, b, x))
            coarse, fine = (lowest_maximum(a, b, x, 0.8, 1.0, each) for each in (16, 64))
            assert lower <= fine + 1e-7  # V ≤ the oracle's cost
            assert coarse <= upper + 1e-7  # both have 16 intervals, and the oracle's control is the best
            assert upper <= coarse + 1e-6
            assert lower - 1e-9 <= value <= upper + 1e-9
            assert abs(value - fine) <= upper - lower + 1e-7
            gaps.append(upper - lower)
    print(f"duality gap: median {np.median(gaps):.2g}, largest {max(gaps):.2g}")
    assert np.median(gaps) < 0.05


@pytest.mark.slow
def test_a_weaker_disturbance_shrinks_the_control_and_a_stronger_one_is_refused():
    weak = hjb.reach(
        lambda x, u, d: u + d, hjb.Ball(1.0, 3), hjb.convex.ball(np.zeros(3), 0.5), disturbances=hjb.Ball(0.4, 3),
        tube=False,
    )  # fmt: skip
    x = np.array([2.0, 0.0, 0.0])
    solution = hjb.hopf(weak, 1.0, intervals=4)
    assert solution.bound is None
    assert abs(solution.value_at(0.0, x) - (2.0 - 0.6 - 0.5)) < 1e-6
    assert np.allclose(solution.control_at(0.0, x), [-1, 0, 0], atol=1e-4)
    assert np.allclose(solution.disturbance_at(0.0, x), [0.4, 0, 0], atol=1e-4)
    strong = hjb.reach(
        lambda x, u, d: u + d, hjb.Box([-1.0], [1.0]), hjb.convex.ball([0.0], 0.5),
        disturbances=hjb.Box([-2.0], [2.0]), tube=False,
    )  # fmt: skip
    with pytest.raises(ValueError, match="not known to be convex"):
        hjb.hopf(strong, 1.0)
    lower = hjb.hopf(strong, 1.0, intervals=4, bound=True)
    assert lower.bound == "lower"
    assert abs(lower.value_at(0.0, [0.3]) - (0.3 + 1.0 - 0.5)) < 1e-6  # exact for one state: |x| + t − r
    assert np.isinf(lower.bounds_at(0.0, [0.3])[1])


@pytest.mark.slow
def test_avoid_exchanges_the_players():
    """The disturbance pushes with 1, the control flees with 0.25 along the same line: V = 0.5 − max(|x| − 0.75, 0)."""
    problem = hjb.avoid(
        lambda x, u, d: u + d, hjb.Box([-0.25], [0.25]), hjb.convex.ball([0.0], 0.5),
        disturbances=hjb.Box([-1.0], [1.0]), tube=False,
    )  # fmt: skip
    solution = hjb.hopf(problem, 1.0, intervals=4)
    assert solution.bound is None
    assert np.allclose(solution.value_at(0.0, [[0.2], [2.0]]), [0.5, 0.5 - 1.25], atol=1e-6)
    assert np.allclose(solution.control_at(0.0, [2.0]), [0.25], atol=1e-4)
    lower, upper = solution.bounds_at(0.0, [2.0])
    assert lower <= -0.75 <= upper + 1e-12


@pytest.mark.slow
def test_closed_loop_under_the_control_costs_the_value():
    problem = hjb.reach(target=hjb.convex.ellipsoid([0.0, 0.0], [[1.0, 0.2], [0.2, 0.5]]), **DAMPED)
    solution = hjb.hopf(problem, 1.0)
    x = np.array([-1.5, 0.3])
    path = hjb.simulate(problem, solution.control_at, x, 1.0, time_varying=True, hold=0.02)
    assert abs(path.cost - solution.value_at(0.0, x)) < 5e-3


@pytest.mark.slow
def test_the_derivative_is_the_costate_and_follows_parameters():
    terminal = hjb.convex.largest([hjb.convex.half_space([0.6, 0.8], 0.1), hjb.convex.ball([0.0, 0.0], 2.0)])

    def value(gain, x):
        problem = hjb.reach(lambda x, u: jnp.stack([x[1], gain * u[0]]), hjb.Box([-1.0], [1.0]), terminal, tube=False)
        return hjb.hopf(problem, 1.0, intervals=8).value_at(0.25, x)

    x = np.array([1.0, 0.5])
    with jax.enable_x64(True):
        by_gain, by_x = map(np.asarray, jax.jit(jax.grad(value, (0, 1)))(1.0, jnp.asarray(x)))
    # near x only the half-space counts: V = 0.6 (x₁ + τ x₂) + 0.8 x₂ − g ∫ |0.6 s + 0.8| ds − 0.1 with τ = 0.75
    assert np.allclose(by_x, [0.6, 0.6 * 0.75 + 0.8], atol=1e-6)
    assert abs(by_gain + 0.3 * 0.75**2 + 0.8 * 0.75) < 1e-6


@pytest.mark.slow
def test_float32_states_have_float32_values_also_among_float64_numbers():
    solution = hjb.hopf(free_motion(hjb.Ball(1.0, 3), hjb.convex.ball(np.zeros(3), 0.5)), 1.0, intervals=2)
    with jax.enable_x64(True):
        found = jax.jit(solution.value_at)(0.0, jnp.asarray([3.0, 0.0, 4.0], jnp.float32))
    assert found.dtype == np.float32
    assert abs(float(found) - 3.5) < 2e-3


@pytest.mark.slow
def test_derivatives_by_the_terminal_cost_and_of_the_control():
    """x' = u, |u| ≤ 1: V = |x − c| − t − r, whose second derivative is that of the distance; u = −DV."""

    def solution(radius, center):
        problem = free_motion(hjb.Ball(1.0, 2), hjb.convex.ball(center, radius))
        return hjb.hopf(problem, 1.0, intervals=4)

    x, center = np.array([3.0, 0.5]), np.array([0.1, 0.2])
    length = np.linalg.norm(x - center)
    way = (x - center) / length
    bent = (np.eye(2) - np.outer(way, way)) / length
    with jax.enable_x64(True):
        value = lambda radius, center, x: solution(radius, center).value_at(0.0, x)  # noqa: E731
        by_radius, by_center = map(np.asarray, jax.grad(value, (0, 1))(0.5, jnp.asarray(center), jnp.asarray(x)))
        hessian = jax.hessian(value, 2)(0.5, jnp.asarray(center), jnp.asarray(x))
        turning = jax.jacfwd(lambda x: solution(0.5, center).control_at(0.0, x))(jnp.asarray(x))
    assert abs(by_radius + 1) < 1e-6
    assert np.allclose(by_center, -way, atol=1e-6)
    assert np.allclose(hessian, bent, atol=1e-5)
    assert np.allclose(turning, -bent, atol=1e-5)


@pytest.mark.slow
def test_a_smooth_cost_may_close_over_a_parameter():
    """x' = u, |u| ≤ 1: V(2) = k for J = k x² and T = 1, and V is linear in k."""

    def value(k):
        terminal = hjb.convex.smooth(lambda x: k * x @ x, 1)
        return hjb.hopf(free_motion(hjb.Box([-1.0], [1.0]), terminal), 1.0, intervals=4).value_at(0.0, [2.0])

    with jax.enable_x64(True):
        assert np.allclose(jax.jit(jax.value_and_grad(value))(3.0), [3.0, 1.0], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("terminal", [hjb.convex.ball([0.1, 0.2], 0.5), hjb.convex.box([-0.5] * 2, [0.5] * 2)])
def test_near_the_horizon_the_value_is_the_terminal_cost(terminal):
    """Where the control has hardly any effect, only rounding limits the bounds. V − J is at most T − t."""
    solution = hjb.hopf(free_motion(hjb.Box([-1.0] * 2, [1.0] * 2), terminal), 1.0, intervals=4)
    x = np.array([[3.0, 0.5], [0.1, 0.2], [0.5, 0.5], [0.0, 0.0], [1e6, 1.0]])
    with jax.enable_x64(True):
        exact = np.array([float(terminal(jnp.asarray(each))) for each in x])
    for left in (0.0, 1e-12, 1e-6):
        lower, upper = solution.bounds_at(1.0 - left, x)
        assert np.all(
            np.abs(solution.value_at(1.0 - left, x) - exact) <= 1.5 * left + 1e-13 * (1 + np.abs(x).max(axis=1))
        )
        assert np.all(upper - lower <= 1e-12 * (1 + 64 * np.abs(x).max(axis=1)))
        assert np.all(upper >= exact - 1.5 * left - 1e-12 * (1 + 64 * np.abs(x).max(axis=1)))
    with jax.enable_x64(True):
        inside = [float(jax.jit(solution.value_at)(t, jnp.asarray(x[0]))) for t in (-0.5, 1.5, 1.0)]
    assert np.isnan(inside).tolist() == [True, True, False]
    assert abs(inside[2] - exact[0]) < 1e-12


@pytest.mark.parametrize(
    ("drift", "controls", "disturbances"),
    [
        # in the second state the disturbance opposes itself, in units 1e10 times larger than the first
        (lambda x, u, d: jnp.stack([1e10 * (u[0] + d[0]), u[0] - 0.5 * d[0]]), hjb.Box([-1.0], [1.0]), ([-0.9], [0.9])),
        # two disturbances that differ in size by 1e10, of which the second has no control against it
        (
            lambda x, u, d: jnp.stack([u[0] + d[0], 1e-10 * d[1]]), hjb.Box([-1.0], [1.0]),
            ([-0.5, -1e10], [0.5, 1e10]),
        ),
    ],
)  # fmt: skip
def test_units_do_not_hide_a_disturbance(drift, controls, disturbances):
    problem = hjb.reach(
        drift, controls, hjb.convex.box([-1.0] * 2, [1.0] * 2), disturbances=hjb.Box(*disturbances), tube=False
    )
    with pytest.raises(ValueError, match="not known to be convex"):
        hjb.hopf(problem, 1.0)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_ball_stretched_by_the_disturbance_is_not_a_smaller_ball(axis):
    problem = hjb.reach(
        lambda x, u, d: u + 1e-5 * d * jnp.eye(2)[axis], hjb.Ball(1.0, 2), hjb.convex.ball([0.0, 0.0], 0.5),
        disturbances=hjb.Ball(5e4, 2), tube=False,
    )  # fmt: skip
    with pytest.raises(ValueError, match="not known to be convex"):
        hjb.hopf(problem, 1.0)


def test_a_saddle_in_large_units_is_not_convex():
    problem = hjb.Problem(
        lambda x, u: u, controls=hjb.Box([-1.0] * 2, [1.0] * 2), terminal_cost=lambda x: 1e10 * x[0] ** 2 - x[1] ** 2
    )
    with pytest.raises(ValueError, match="eigenvalues of both signs"):
        hjb.hopf(problem, 1.0, states=2)


@pytest.mark.slow
def test_a_convex_quadratic_is_recognised_and_its_concave_twin_exchanges_the_players():
    problem = hjb.Problem(lambda x, u: u, controls=hjb.Box([-1.0], [1.0]), terminal_cost=lambda x: 3 * x @ x + x[0])
    # the minimum of 3y² + y over |y − x| ≤ 1 is −1/12 if y = −1/6 can be reached
    found = hjb.hopf(problem, 1.0, states=1, intervals=4).value_at(0.0, [[0.5], [2.0]])
    assert np.allclose(found, [-1 / 12, 4.0], atol=1e-6)
    with pytest.raises(ValueError, match="eigenvalues of both signs"):
        hjb.hopf(
            hjb.Problem(lambda x, u: u, controls=hjb.Box([-1.0], [1.0]), terminal_cost=lambda x: x[0] ** 2 - x[1] ** 2),
            1.0, states=2,
        )  # fmt: skip


def bent(x):
    return x @ x / 2 + jnp.sum(jnp.abs(x))


@pytest.mark.slow
def test_a_legendre_transform_allows_kinks():
    """x' = u, |u_i| ≤ 1: the distance to 0 shrinks by the time to go on each axis."""
    terminal = hjb.convex.smooth(bent, 3, conjugate=lambda p: jnp.sum(jnp.maximum(jnp.abs(p) - 1, 0) ** 2) / 2)
    solution = hjb.hopf(free_motion(hjb.Box([-1.0] * 3, [1.0] * 3), terminal), 1.0, intervals=4)
    x = np.random.default_rng(0).uniform(-3, 3, (12, 3))
    left = np.maximum(np.abs(x) - 1, 0)
    assert np.abs(solution.value_at(0.0, x) - np.sum(left**2 / 2 + left, axis=1)).max() < 1e-7
    assert solution.error_at(0.0, x).max() < 1e-6


def test_a_function_that_is_not_the_legendre_transform_is_refused():
    with pytest.raises(ValueError, match="not the Legendre transform"):
        hjb.convex.smooth(bent, 3, conjugate=lambda p: p @ p / 2)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"drift": lambda x, u: jnp.stack([x[1], x[0] * u[0]])}, "entry 1 of the drift has the product"),
        ({"drift": lambda x, u: jnp.stack([jnp.sin(x[1]), u[0]])}, "entry 0 of the drift has a nonlinear function"),
        ({"tube": True}, "pass tube=False"),
        ({"target": lambda x: jnp.linalg.norm(x)}, "states="),
    ],
)
def test_what_the_formula_does_not_cover_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        hjb.hopf(hjb.reach(**{**DAMPED, "target": hjb.convex.ball([0.0, 0.0], 0.5), **change}), 1.0)


@pytest.mark.slow
def test_a_saved_solution_comes_back(tmp_path):
    solution = hjb.hopf(hjb.reach(target=hjb.convex.box([-0.5, -0.5], [0.5, 0.5]), **DAMPED), 1.0, intervals=16)
    solution.save(tmp_path / "value")
    back = hjb.HopfSolution.load(tmp_path / "value")
    assert back.value_at(0.25, [1.0, 0.5]) == solution.value_at(0.25, [1.0, 0.5])
    assert back.status is hjb.Status.CONVERGED


@pytest.mark.slow
def test_ten_coupled_states_take_less_than_50_ms_each():
    draw = np.random.default_rng(0)
    a, b = draw.normal(size=(10, 10)) / 2 - np.eye(10), draw.normal(size=(10, 3))
    problem = hjb.reach(
        lambda x, u: a @ x + b @ u, hjb.Box([-1.0] * 3, [1.0] * 3), hjb.convex.ball(np.zeros(10), 0.5), tube=False
    )
    solution = hjb.hopf(problem, 1.0)
    states = draw.normal(size=(20, 10))
    solution.value_at(0.0, states[0])
    began = time.process_time()
    for x in states:
        solution.value_at(0.0, x)
    each = (time.process_time() - began) / 20
    print(f"{1e3 * each:.1f} ms per state")
    assert each < 0.05
