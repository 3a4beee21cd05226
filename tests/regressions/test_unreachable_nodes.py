"""Nodes that cannot be brought to the target: inf, and no action steps there in whatever units cost and time come."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

U = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([0.0], [4.0], (41,))
partial = jax.tree_util.Partial


def current(rate, x, u):
    """Beyond x = 3 a current carries away; from x = 2.9 it takes 29 to the target."""
    return rate * jnp.where(x > 3.0, 1.0, 0.1 * u)


def toll(cost, x, u):
    return cost + 0 * x[0]


def near_zero(x):
    return x[0] - 0.05


def drifting(cost, rate):
    return hjb.Problem(partial(current, rate), partial(toll, cost * rate), U, target=near_zero)


@pytest.mark.filterwarnings("ignore:.*cannot reach")
@pytest.mark.parametrize(("cost", "rate"), [(1.0, 1.0), (1e7, 1.0), (1e9, 1.0), (1e9, 1e6), (1e-9, 1e-6)])
def test_no_action_steps_into_what_is_lost(cost, rate):
    solution = hjb.solve(drifting(cost, rate), GRID, tol=1e-6 * cost, scheme=hjb.Upwind())
    x = GRID.axis(0)
    assert np.allclose(solution.value[x <= 3.0] / cost, 10 * x[x <= 3.0], atol=1e-5)
    assert np.all(np.isinf(solution.value[x > 3.05]))
    assert np.all(solution.policy[1:30] < 0)
    assert solution.error <= 1e-6 * cost


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach")
def test_lanes_with_and_without_lost_nodes_and_traced_ones():
    lanes = hjb.solve_batch([drifting(1.0, 1.0), drifting(1e9, 1.0)], GRID, tol=1e-6 * 1e9, scheme=hjb.Upwind())
    assert np.allclose(lanes[1].value[:30] / 1e9, GRID.axis(0)[:30] * 10, atol=1e-5)
    with jax.enable_x64(True):
        solution = jax.jit(lambda problem: hjb.solve(problem, GRID, tol=1e3, scheme=hjb.Upwind()))(drifting(1e9, 1.0))
        slope = jax.grad(lambda c: hjb.solve(drifting(c, 1.0), GRID, tol=1e-6, scheme=hjb.Upwind()).value[29])(1.0)
    assert int(solution.code) == hjb.Status.CONVERGED
    value = np.asarray(solution.value)
    assert np.allclose(value[:30] / 1e9, GRID.axis(0)[:30] * 10, atol=1e-5)
    assert np.all(np.isinf(value[31:]))
    assert np.isclose(slope, 29)


def corridor(x, u):
    """Staying in it wants u = .37 exactly; outside all is lost."""
    out = jnp.abs(x[1]) > 0.05
    return jnp.where(out, jnp.stack([0.0, jnp.sign(x[1])]), jnp.stack([-1.0, u[0] - 0.37]))


def gate(x):
    return jnp.maximum(x[0] - 0.05, jnp.abs(x[1]) - 0.05)


def narrow(x, u):
    """Two inputs, each of which must be held at a value of its own."""
    out = jnp.maximum(jnp.abs(x[1]), jnp.abs(x[2])) > 0.05
    moving = jnp.stack([-1.0, u[0] - 0.37, 2 * u[1] + 0.5 * u[0]])
    return jnp.where(out, jnp.stack([0.0, jnp.sign(x[1]), jnp.sign(x[2])]), moving)


def narrow_gate(x):
    return jnp.max(jnp.abs(x) - jnp.array([0.05, 0.05, 0.05]))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach")
def test_a_corridor_that_one_action_alone_keeps_to():
    """No sample of the controls is that action; the minimiser knows where the drift changes its sign."""
    grid = hjb.Grid([0.0, -1.0], [2.0, 1.0], (21, 21))
    solution = hjb.solve(hjb.Problem(corridor, lambda x, u: 1.0, U, target=gate), grid, scheme=hjb.Upwind())
    assert np.allclose(solution.value[:, 10], grid.axis(0), atol=1e-3)
    assert np.isinf(solution.value_at([1.0, 0.5]))
    grid = hjb.Grid([0.0, -1.0, -1.0], [2.0, 1.0, 1.0], (11, 5, 5))
    problem = hjb.Problem(narrow, lambda x, u: 1.0, hjb.Box([-1.0, -1.0], [1.0, 1.0]), target=narrow_gate)
    solution = hjb.solve(problem, grid, scheme=hjb.Upwind())
    assert np.allclose(solution.value[:, 2, 2], grid.axis(0), atol=1e-3)


def around(x, u):
    """sin π is not zero in floating point: at x = 1 the drift is 1.2e-16, which leads nowhere."""
    return jnp.where(x > 0.5, jnp.sin(jnp.pi * x), u)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach")
def test_a_drift_that_cancels_reaches_nothing():
    grid = hjb.Grid([0.0], [1.0], (11,))
    solution = hjb.solve(hjb.Problem(around, lambda x, u: 1.0, U, target=near_zero), grid, scheme=hjb.Upwind())
    assert np.isinf(solution.value[-1])
    assert np.allclose(solution.value[:6], grid.axis(0)[:6], atol=1e-3)


def pursued(speed, x, u, d):
    """Beyond x = 2 the disturbance is stronger than the control, before it the control is."""
    return u + jnp.where(x > 2.05, speed, 0.5) * d


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach")
@pytest.mark.parametrize("isaacs", ["upper", "lower"])
def test_a_game_says_from_where_its_target_cannot_be_forced(isaacs):
    grid = hjb.Grid([0.0], [4.0], (21,))
    problem = hjb.Problem(
        partial(pursued, 1.5), lambda x, u, d: 1.0, U, disturbances=U, target=near_zero, isaacs=isaacs
    )
    solution = hjb.solve(problem, grid, tol=1e-6, scheme=hjb.Upwind())
    x = grid.axis(0)
    assert solution.status is hjb.Status.CONVERGED
    assert np.allclose(solution.value[x <= 2.05], 2 * x[x <= 2.05], atol=1e-5)
    assert np.all(np.isinf(solution.value[x > 2.05]))
    assert np.array_equal(solution.reached, x <= 2.05)


def crawling(fast, x, u):
    """A control that needs hundreds of crossings' time of the current beyond the target."""
    return 0.0284 * u + jnp.where(x > 2.1, fast, 0.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach")
@pytest.mark.parametrize("fast", [20.0, 2000.0])
def test_a_slow_way_beside_a_fast_current(fast):
    """Pushing outwards and paying for ever looks cheaper at first, under every discount that the current suggests."""
    grid = hjb.Grid([-1.0], [3.0], (21,))
    controls = hjb.Box([-0.877], [0.152])
    problem = hjb.Problem(
        partial(crawling, fast), lambda x, u: 0.59, controls, target=lambda x: jnp.abs(x[0] - 2.0) - 0.1
    )
    solution = hjb.solve(problem, grid, tol=0.03, scheme=hjb.Upwind())
    cells = np.arange(15, 0, -1)
    assert np.allclose(solution.value[:15], cells * 0.59 * 0.2 / (0.0284 * 0.152), atol=0.03)


@pytest.mark.filterwarnings("ignore:.*cannot reach")
def test_a_rest_node_among_unreachable_nodes_that_no_coarser_grid_has():
    problem, grid = hjb.Problem(lambda x, u: x, lambda x, u: x @ x), hjb.Grid([-1.0], [1.0], (15,))
    solution = hjb.solve(problem, grid)
    np.testing.assert_array_equal(solution.value, np.where(np.arange(15) == 7, 0.0, np.inf))
    assert solution.grid_error is None
