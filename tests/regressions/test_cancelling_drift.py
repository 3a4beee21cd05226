"""Drifts that cancel at a node up to rounding: such a rest of a drift is not motion. And a game with a known value."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo


@pytest.mark.slow
def test_the_lq_game_has_its_known_value():
    exact, errors = zoo.lq_game_exact(), []
    for n in (51, 101, 201):
        problem, grid = zoo.lq_game(shape=(n,))
        solution = hjb.solve(problem, grid, tol=1e-5, scheme=hjb.Upwind())
        x = grid.nodes()
        known = np.array([float(exact(jnp.asarray(one))) for one in x])
        errors.append(np.max(np.abs(solution.value - known)[np.abs(x[:, 0]) <= 0.5]))
    assert errors[-1] <= 0.02
    assert abs(-np.polyfit(range(3), np.log2(errors), 1)[0] - 1) <= 0.15


@pytest.mark.slow
def test_a_nested_solve_where_the_drift_cancels_at_a_node():
    """A drift of rounding size is no motion: dividing by it sent the value to infinity."""
    problem, grid = zoo.pendulum(as_printed=True, shape=(100, 101))
    nested = hjb.solve(problem, grid, method=hjb.Nested(), scheme=hjb.Upwind())
    plain = hjb.solve(problem, grid, method=hjb.PolicyIteration(), scheme=hjb.Upwind())
    assert np.max(np.abs(nested.value - plain.value)) <= 2e-3


@pytest.mark.slow
def test_a_second_order_game_where_the_drift_cancels_at_a_node():
    problem, grid = zoo.lq_game(shape=(81,))
    solution = hjb.solve(problem, grid, scheme=hjb.Limited(), tol=1e-6)
    exact = jax.vmap(zoo.lq_game_exact())(jnp.asarray(grid.nodes(), jnp.float32))
    assert np.max(np.abs(solution.value - np.asarray(exact))) <= 1e-5
