"""The estimate of the error where costs and drifts jump between nodes, against exact solutions on a line."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.solvers import discontinuities

BETA, LOW, HIGH = 0.5, 0.3, 2.0
PLACES = (0.02, 0.3, 0.5, 0.7, 0.98)  # of the jump between two nodes


def _at_speeds(x, jump, costs, speeds):
    """V of x' = s(x) > 0 that leaves at 1, with cost and speed constant on both sides of a jump."""

    def paid(cost, time):
        return cost * -np.expm1(-BETA * time) / BETA

    after = paid(costs[1], (1 - np.maximum(x, jump)) / speeds[1])
    before = np.maximum(jump - x, 0) / speeds[0]
    return np.where(x < jump, paid(costs[0], before) + np.exp(-BETA * before) * after, after)


def _problem(jump, costs, speeds, length=1.0, unit=1.0):
    """The same in other units of length and cost."""
    return hjb.Problem(
        lambda x, u: length * jnp.where(x > length * jump, speeds[1], speeds[0]) + 0 * u,
        lambda x, u: unit * jnp.where(x[0] > length * jump, costs[1], costs[0]),
        hjb.Box([-1.0], [1.0]),
        discount=BETA,
        target=lambda x: 1 - x[0] / length - 1e-9,
    )


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("costs", "speeds"), [((LOW, HIGH), (1, 1)), ((HIGH, LOW), (1, 1)), ((1, 1), (1, 2))])
def test_jump_between_nodes(place, costs, speeds):
    """Wherever the jump is between its nodes, the estimate is at least a third of the error, and at most J h."""
    grid = hjb.Grid([-1.0], [1.0], (41,))
    h = float(grid.spacing(0))
    jump = 0.1 + place * h
    solution = hjb.solve(_problem(jump, costs, speeds), grid)
    exact = _at_speeds(np.asarray(grid.axis(0)), jump, costs, speeds)
    error = np.abs(solution.value - exact)
    assert np.all(solution.grid_error >= error / 3 - 2e-5)
    assert solution.grid_error.max() <= 1.1 * h * (HIGH - LOW)


@pytest.mark.parametrize(("length", "unit"), [(1e-4, 1.0), (1e5, 1e6), (1.0, 1e-5)])
def test_jump_in_other_units(length, unit):
    """Units of length and cost change nothing but the unit of the estimate."""
    grid, jump = hjb.Grid([-length], [length], (41,)), 0.1 + 0.02 * 0.05
    solution = hjb.solve(_problem(jump, (LOW, HIGH), (1, 1), length, unit), grid, tol=1e-4 * unit)
    exact = unit * _at_speeds(np.asarray(grid.axis(0)) / length, jump, (LOW, HIGH), (1, 1))
    error = np.abs(solution.value - exact)
    assert error.max() > 0.05 * unit
    assert np.all(solution.grid_error >= error / 3 - 1e-4 * unit)


def test_jump_in_single_precision_and_in_a_batch():
    """The same estimate in float32 and for every lane of a batch."""
    grid, jump = hjb.Grid([-1.0], [1.0], (41,)), 0.1 + 0.02 * 0.05
    problem = _problem(jump, (LOW, HIGH), (1, 1))
    alone = hjb.solve(problem, grid).grid_error
    np.testing.assert_allclose(
        hjb.solve(problem, grid, dtype="float32", tol=1e-3).grid_error, alone, rtol=0.05, atol=1e-3
    )
    for lane in hjb.solve_batch([problem, problem], grid):
        np.testing.assert_allclose(lane.grid_error, alone, rtol=0.05, atol=1e-3)


@pytest.mark.parametrize("place", [0.05, pytest.param(0.95, marks=pytest.mark.slow)])
def test_jump_under_noise(place):
    """½ σ² V″ + V′ + L − β V = 0 with V(±1) = 0 and a jump of L."""
    grid, sigma = hjb.Grid([-1.0], [1.0], (81,)), 0.5
    jump = 0.1 + place * float(grid.spacing(0))
    problem = hjb.Problem(
        lambda x, u: 1 + 0 * u, lambda x, u: jnp.where(x[0] > jump, HIGH, LOW), hjb.Box([-1.0], [1.0]), discount=BETA,
        noise=sigma, target=lambda x: 1 - jnp.abs(x[0]) - 1e-9,
    )  # fmt: skip
    solution = hjb.solve(problem, grid)
    roots = np.roots([sigma**2 / 2, 1, -BETA])

    def here(x, side):
        return np.array([*(side * np.exp(roots * x)), *((1 - side) * np.exp(roots * x))])

    slope = np.array([*(roots * np.exp(roots * jump)), *(-roots * np.exp(roots * jump))])
    rows = np.array([here(-1, 1), here(1, 0), here(jump, 1) - here(jump, 0), slope])
    c = np.linalg.solve(rows, [-LOW / BETA, -HIGH / BETA, (HIGH - LOW) / BETA, 0])
    x = np.asarray(grid.axis(0))
    exact = np.array([here(z, z <= jump) @ c + (HIGH if z > jump else LOW) / BETA for z in x])
    error = np.abs(solution.value - exact)
    assert error.max() > 1e-2
    assert 1 < solution.grid_error[np.argmax(error)] / error.max() < 3


def test_rest_next_to_a_jump():
    """A path that rests next to a high cost does not pay for the jump: V = LOW/β around the rest point is exact."""
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: jnp.where(jnp.abs(x[0]) > 0.51, HIGH, LOW), hjb.Box([-1.0], [1.0]), discount=BETA
    )
    grid = hjb.Grid([-1.0], [1.0], (41,))
    solution = hjb.solve(problem, grid)
    away = np.maximum(np.abs(np.asarray(grid.axis(0))) - 0.51, 0)
    exact = LOW / BETA + (HIGH - LOW) * -np.expm1(-BETA * away) / BETA
    error = np.abs(solution.value - exact)
    assert np.all(solution.grid_error >= error / 3 - 1e-3)
    assert solution.grid_error.max() <= 1.2 * (HIGH - LOW) * float(grid.spacing(0))


@pytest.mark.filterwarnings("ignore:the grid is coarse")
@pytest.mark.parametrize("name", ["double_integrator", pytest.param("pendulum", marks=pytest.mark.slow)])
def test_smooth_costs_need_no_linear_solve(name, monkeypatch):
    """Smooth data, kinks of V and targets are no jumps."""

    def refuse(*_):
        raise AssertionError

    monkeypatch.setattr(discontinuities, "_along_paths", refuse)
    problem, grid = getattr(hjb.zoo, name)()
    assert hjb.solve(problem, dataclasses.replace(grid, shape=(40, 41))).grid_error is not None
