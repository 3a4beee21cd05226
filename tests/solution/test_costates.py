"""DV between the nodes: exact for quadratics, second order, at ends, seams, kinks and infinite values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hjbjax.problem.grid import Grid
from hjbjax.problem.stretching import Sinh
from hjbjax.solution.solution import Solution

BOX = ([-1.0, 0.0], [1.0, 3.0])
PLAIN = Grid(*BOX, (6, 5))
STRETCHED = Grid(*BOX, (6, 5), stretch=(Sinh(3.0), None))
NUMBERS = st.floats(-3, 3)


def solution_of(function, grid, **fields):
    value = np.asarray(function(grid.nodes()))
    return Solution(grid, value, np.zeros((*value.shape, 1)), code=1, **fields)


@pytest.mark.parametrize("grid", [pytest.param(PLAIN, marks=pytest.mark.slow), STRETCHED], ids=["plain", "stretched"])
@given(st.tuples(*[NUMBERS] * 5), st.floats(-1, 1), st.floats(0, 3))
def test_exact_for_quadratics(grid, numbers, a, b):
    """A product of two coordinates too; to the ends of the box, where parabolas take over."""
    c0, c1, c00, c01, c11 = numbers

    def quadratic(x):
        first, second = x[..., 0], x[..., 1]
        return c0 * first + c1 * second + c00 * first**2 + c01 * first * second + c11 * second**2

    wanted = [c0 + 2 * c00 * a + c01 * b, c1 + c01 * a + 2 * c11 * b]
    got = solution_of(quadratic, grid).costate_at([a, b])
    assert got.dtype == np.float64
    np.testing.assert_allclose(got, wanted, atol=1e-11)


@pytest.mark.slow
def test_second_order_on_a_smooth_value():
    def smooth(x):
        return np.sin(2 * x[..., 0]) * np.exp(0.5 * x[..., 1])

    states = np.random.default_rng(0).uniform([-1, 0], [1, 3], (200, 2))
    wanted = np.stack([2 * np.cos(2 * states[:, 0]) * np.exp(0.5 * states[:, 1]), 0.5 * smooth(states)], axis=-1)
    counts = np.array([21, 41, 81])
    errors = [np.max(np.abs(solution_of(smooth, Grid(*BOX, (k, k))).costate_at(states) - wanted)) for k in counts]
    order = -np.polyfit(np.log(counts - 1), np.log(errors), 1)[0]
    assert order == pytest.approx(2, abs=0.15)


def test_across_the_seam_of_a_periodic_axis():
    grid = Grid([-np.pi], [np.pi], (64,), (True,))
    solution = solution_of(lambda x: np.cos(x[..., 0]), grid)
    states = np.linspace(-np.pi - 0.2, -np.pi + 0.2, 9)[:, None]
    np.testing.assert_allclose(solution.costate_at(states), -np.sin(states), atol=3e-3)
    np.testing.assert_allclose(solution.costate_at(states), solution.costate_at(states + 2 * np.pi), atol=1e-12)


def test_away_from_a_kink_and_beside_infinity():
    grid = Grid([-1.0], [1.0], (21,))
    kinked = solution_of(lambda x: np.abs(x[..., 0]), grid)
    np.testing.assert_allclose(kinked.costate_at([[-0.5], [0.11], [0.5]])[:, 0], [-1, 1, 1], atol=1e-12)
    assert kinked.costate_at([0.0])[0] == pytest.approx(0, abs=1e-12)  # the mean of both sides
    walled = solution_of(lambda x: np.where(x[..., 0] > 0.55, np.inf, x[..., 0] ** 2), grid)
    np.testing.assert_allclose(walled.costate_at([[0.45], [0.5]])[:, 0], [0.9, 1.0], atol=1e-12)
    assert np.isnan(walled.costate_at([0.8])[0])


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("grid", [PLAIN, STRETCHED], ids=["plain", "stretched"])
def test_on_a_node_the_second_derivative_is_that_beside_it(grid, derivative):
    solution = solution_of(lambda x: x[..., 0] ** 2 + 3 * x[..., 0] * x[..., 1], grid)
    with jax.enable_x64(True):
        bends = jax.jit(jax.vmap(derivative(lambda x: solution.costate_at(x))))
        states = [[grid.axis(0)[2], 1.0], [grid.axis(0)[2] + 0.01, 1.0], [0.1, grid.axis(1)[2]]]
        np.testing.assert_allclose(bends(jnp.asarray(states)), [[[2.0, 3.0], [3.0, 0.0]]] * 3, atol=1e-10)
        walled = solution_of(lambda x: np.where(x[..., 0] > 0.55, np.inf, x[..., 0] ** 2), Grid([-1.0], [1.0], (21,)))
        edge = jax.jit(jax.vmap(derivative(lambda x: walled.costate_at(x))))(jnp.array([[0.5], [0.4]]))
    np.testing.assert_allclose(edge[1], 2, atol=1e-10)
    assert np.all(np.isfinite(edge))


@pytest.mark.filterwarnings("ignore:.*outside the grid, where")
def test_outside_the_grid():
    solution = solution_of(lambda x: x[..., 0] ** 2 + x[..., 1], PLAIN)
    assert np.all(np.isnan(solution.costate_at([2.0, 1.0])))
    np.testing.assert_allclose(solution.costate_at([2.0, 1.0], clamp=True), [2.0, 1.0])
    assert np.all(np.isnan(solution.costate_at([np.nan, 1.0])))


def test_two_nodes_make_a_line():
    solution = Solution(Grid([0.0], [2.0], (2,)), np.array([1.0, 4.0]), np.zeros((2, 1)), code=1)
    np.testing.assert_allclose(solution.costate_at([[0.0], [0.7], [2.0]])[:, 0], 1.5)


@pytest.mark.slow
def test_of_a_marched_solution_and_under_transformations():
    times = np.array([0.0, 0.5, 2.0])
    values = np.stack([(1 + t) * (PLAIN.nodes()[..., 0] ** 2 + PLAIN.nodes()[..., 1]) for t in times])
    marched = Solution(PLAIN, values, np.zeros((*values.shape, 1)), code=1, times=times)
    np.testing.assert_allclose(marched.costate_at(1.25, [0.3, 1.0]), 2.25 * np.array([0.6, 1.0]))
    with pytest.warns(UserWarning, match="lie outside the kept times"):
        assert np.all(np.isnan(marched.costate_at(3.0, [0.3, 1.0])))
    with pytest.raises(ValueError, match=r"marched over times: call costate_at\(t, x\)"):
        marched.costate_at([0.3, 1.0])
    with jax.enable_x64(True):
        states = jnp.asarray(np.random.default_rng(1).uniform([-1, 0], [1, 3], (7, 2)))
        batch = jax.jit(jax.vmap(lambda x: marched.costate_at(1.25, x)))(states)
        np.testing.assert_allclose(batch, marched.costate_at(1.25, np.asarray(states)), rtol=1e-12)
        bends = jax.jacfwd(lambda x: marched.costate_at(1.25, x))(states[0])
        np.testing.assert_allclose(bends, [[4.5, 0], [0, 0]], atol=1e-10)
