"""The estimate of the error of a march where costs and drifts jump between nodes, against exact solutions."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.solvers import march_discontinuities

GRID, TIMES = hjb.Grid([-1.0], [1.0], (41,)), [0.0, 0.5]
LOW, HIGH = 0.3, 2.0


def _paid(x, left, jump, costs, speeds):
    """The cost of x' = s(x) > 0 for the time left; cost and speed are constant on both sides of the jump."""
    first = np.clip((jump - x) / speeds[0], 0, left)
    return costs[0] * first + costs[1] * (left - first)


def _problem(jump, costs, speeds):
    return hjb.Problem(
        lambda x, u: jnp.where(x > jump, speeds[1], speeds[0]) + 0 * u,
        lambda x, u: jnp.where(x[0] > jump, costs[1], costs[0]),
        hjb.Box([-1.0], [1.0]),
    )


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [None, hjb.Upwind()], ids=["default", "upwind"])
@pytest.mark.parametrize("place", [0.02, 0.3, 0.7, 0.98])
@pytest.mark.parametrize("costs", [(LOW, HIGH), (HIGH, LOW)])
def test_jump_of_the_cost(costs, place, scheme):
    """The estimate is at least a third of the error at every node, and at most 1.5 J h/s."""
    h = float(GRID.spacing(0))
    jump = 0.1 + place * h
    solution = hjb.march(_problem(jump, costs, (0.8, 0.8)), GRID, 1.0, times=TIMES, scheme=scheme)
    for i, t in enumerate(TIMES):
        exact = _paid(np.asarray(GRID.axis(0)), 1 - t, jump, costs, (0.8, 0.8))
        error = np.abs(solution.value[i] - exact)
        assert np.all(solution.grid_error[i] >= error / 3 - 1e-3)
        assert solution.grid_error[i].max() <= 1.5 * h * (HIGH - LOW) / 0.8


def test_jump_behind_which_a_coarser_grid_makes_the_same_error():
    h = float(GRID.spacing(0))
    jump = 0.05 + 0.02 * h
    solution = hjb.march(_problem(jump, (LOW, HIGH), (0.5, 0.5)), GRID, 1.0, scheme=hjb.Upwind())
    exact = _paid(np.asarray(GRID.axis(0)), 1.0, jump, (LOW, HIGH), (0.5, 0.5))
    error = np.abs(solution.value[0] - exact)
    before = (GRID.axis(0) < jump) & (error > 0.05)
    assert before.sum() == 10
    assert np.all(solution.grid_error[0][before] > error[before] / 3)
    assert np.all(solution.grid_error[0][before] < 3 * error[before])


def test_jump_of_the_drift():
    """V = ∫ (1 + x/2) dt along x' = s(x), which jumps from 1 to 0.4."""
    h = float(GRID.spacing(0))
    jump = 0.1 + 0.3 * h
    problem = dataclasses.replace(_problem(jump, (1, 1), (1.0, 0.4)), cost=lambda x, u: 1 + 4 * x[0])
    solution = hjb.march(problem, GRID, 0.8, scheme=hjb.Upwind())
    x = np.asarray(GRID.axis(0))
    inside = x <= 0.6  # from there paths do not reach the end of the box
    first = np.clip(jump - x, 0, 0.8)
    after, start = 0.8 - first, np.maximum(x, jump)
    exact = first + 4 * (x * first + first**2 / 2) + after + 4 * (start * after + 0.4 * after**2 / 2)
    exact = np.where(first < 0.8, exact, 0.8 + 4 * (0.8 * x + 0.32))
    error = np.abs(solution.value[0] - exact)[inside]
    assert error.max() > 0.02
    assert np.all(solution.grid_error[0][inside] >= error / 3 - 0.01)


def test_smooth_costs_are_not_marched_again(monkeypatch):
    def refuse(*_):
        raise AssertionError

    monkeypatch.setattr(march_discontinuities, "_marched", refuse)
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-5.0], [5.0]))
    assert hjb.march(problem, GRID, 1.0).grid_error is not None
