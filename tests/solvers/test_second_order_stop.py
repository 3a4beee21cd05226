"""The second-order iteration of a default solve stops at a tenth of the grid error; ``tol=`` makes it strict."""

import numpy as np
import pytest

import hjbjax as hjb

pytestmark = pytest.mark.filterwarnings("ignore:.*of the nodes", "ignore:the optimal drift leaves the box")

PROBLEMS = {
    "pendulum": lambda: hjb.zoo.pendulum(shape=(40, 41)),
    "Dubins car": lambda: hjb.zoo.dubins(shape=(21, 21, 20)),
    "Merton": lambda: hjb.zoo.merton(shape=(81,)),
    "double integrator": lambda: hjb.zoo.double_integrator(shape=(61, 61)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if k else []) for k, name in enumerate(PROBLEMS)]
)
def test_iteration_leaves_at_most_a_tenth_of_the_grid_error(name):
    problem, grid = PROBLEMS[name]()
    default, strict = hjb.solve(problem, grid), hjb.solve(problem, grid, tol=1e-7)
    assert default.status is strict.status is hjb.Status.CONVERGED
    assert default.steps < strict.steps
    finite, error = np.isfinite(strict.value), strict.grid_error
    left = np.abs(default.value - strict.value)[finite]
    assert np.max(left) <= 0.1 * np.max(error) + 1e-3
    assert np.mean(left) <= 0.1 * np.mean(error) + 1e-3
    # the estimate includes the rest
    assert np.mean(left <= default.grid_error[finite]) > 0.99
    assert np.mean(default.grid_error) <= 1.3 * np.mean(error) + 2e-3


def test_tolerance_of_the_caller_is_kept():
    problem, grid = PROBLEMS["pendulum"]()
    for tol in (1e-3, 1e-5):
        solution = hjb.solve(problem, grid, tol=tol)
        assert f"are at most {tol:.2g} " in solution.message
    default = hjb.solve(problem, grid)
    assert "are at most 10% of the estimated grid error" in default.message
    assert "10% of the estimated grid error" in str(default)
    strict = hjb.solve(problem, grid, tol=1e-3, scheme=hjb.Limited())  # without an estimate
    assert strict.grid_error is None
    assert "are at most 0.001 " in strict.message


def test_batch_stops_like_a_single_solve():
    problem, grid = PROBLEMS["pendulum"]()
    heavier = hjb.zoo.pendulum(mass=1.2, shape=(40, 41))[0]
    together = hjb.solve_batch([problem, heavier], grid)
    for lane, each in zip(together, (problem, heavier), strict=True):
        alone = hjb.solve(each, grid, method=hjb.PolicyIteration())  # without coarser grids for the first guess
        np.testing.assert_allclose(lane.value, alone.value, rtol=0, atol=1e-8 * np.ptp(alone.value))
        np.testing.assert_allclose(lane.grid_error, alone.grid_error, rtol=0, atol=1e-8 * np.ptp(alone.value))
