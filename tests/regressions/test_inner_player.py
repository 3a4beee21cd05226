"""Games whose inner player, half answered, kept the outer one going for ever; and one who pays to keep away."""

import functools

import jax
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo

# (γ, a, β): with a > 0 the state leaves the origin by itself, and a residual of r in the inner problem is up to
# (Q + β)/β ≈ 4000 r in the value
GAMES = [(2.0, 0.2, 0.5), (1.5, 0.2, 0.5), (3.0, 0.5, 0.2)]
NODES = 201


def exact(problem, grid, numbers):
    """px² at the nodes, with the stabilising p ≥ 0 of 1 + 2 (a − β/2) p = (1 − γ⁻²) p², in plain NumPy."""
    gamma, rate, discount = numbers
    weight, shifted = 1 - gamma**-2, rate - discount / 2
    p = (shifted + np.sqrt(shifted**2 + weight)) / weight
    return p * grid.nodes()[:, 0] ** 2


def posed(numbers):
    gamma, rate, discount = numbers
    return zoo.lq_game(gamma=gamma, rate=rate, discount=discount, shape=(NODES,))


@functools.cache
def by_value_iteration(numbers):
    problem, grid = posed(numbers)
    return hjb.solve(problem, grid, scheme=hjb.Upwind(), method=hjb.ValueIteration(), tol=1e-6).value


@pytest.mark.slow
@pytest.mark.parametrize("numbers", GAMES)
@pytest.mark.parametrize("evaluation", [None, pytest.param(hjb.Krylov(), marks=pytest.mark.slow)])
@pytest.mark.optimised
def test_a_game_near_its_limit_converges(numbers, evaluation):
    problem, grid = posed(numbers)
    method = hjb.PolicyIteration(evaluation)
    monotone = hjb.solve(problem, grid, scheme=hjb.Upwind(), method=method, tol=1e-6)
    np.testing.assert_allclose(monotone.value, by_value_iteration(numbers), rtol=0, atol=2.1e-6)
    assert monotone.steps <= 50
    sharp = hjb.solve(problem, grid, method=method, tol=1e-6)
    inside = np.abs(grid.nodes()[:, 0]) <= 0.8
    np.testing.assert_allclose(sharp.value[inside], exact(problem, grid, numbers)[inside], rtol=0, atol=1e-5)


@pytest.mark.slow
def test_a_march_in_long_implicit_steps_through_such_a_game_is_exact():
    problem, grid = posed(GAMES[0])
    stationary = hjb.solve(problem, grid, scheme=hjb.Upwind(split=True), tol=1e-8)
    settled = hjb.march(problem, grid, 40.0, method=hjb.Implicit(), step=10.0, scheme=hjb.Upwind(split=True))
    assert np.max(np.abs(settled.value[0] - stationary.value)) <= 0.05 * np.max(stationary.value)
    later = hjb.march(problem, grid, 400.0, method=hjb.Implicit(), step=10.0, scheme=hjb.Upwind(split=True))
    np.testing.assert_allclose(later.value[0], stationary.value, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_a_disturbance_that_pays_to_keep_away_from_the_target_leaves_a_finite_value(monkeypatch):
    problem, grid = zoo.lq_game(rate=0.2, shape=(NODES,))
    wanted = exact(problem, grid, (2.0, 0.2, 0.0))
    with jax.debug_nans(False):
        solution = hjb.solve(problem, grid, scheme=hjb.Upwind(), method=hjb.PolicyIteration(hjb.Direct()), throw=False)
    assert not np.any(np.isinf(solution.value))
    if solution.status is hjb.Status.CONVERGED:
        np.testing.assert_allclose(solution.value, wanted, rtol=0, atol=0.02)
    default = hjb.solve(problem, grid, scheme=hjb.Upwind())
    np.testing.assert_allclose(default.value, wanted, rtol=0, atol=0.02)
