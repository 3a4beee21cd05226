"""Coarser grids: which ones a solve begins on, and what it knows of them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.solution.clock import Clock
from hjbjax.solvers import coarse_levels, nested_grids
from hjbjax.solvers.setup import prepare_on_host

pytestmark = pytest.mark.usefixtures("float64")
METHOD = hjb.PolicyIteration(hjb.Sweeps())
SCHEME = hjb.Upwind(subcell=True)
KIND = np.dtype(float)


def task_of(problem, grid):
    """The task of a solve by the chain, with the checks of the host."""
    return prepare_on_host(Discretisation(problem, grid, SCHEME, KIND), method=METHOD, tol=1e-3)[0]


def drift(x, u):
    """Drift that only the control makes."""
    return u


PROBLEMS = {
    "discounted": lambda: zoo.pendulum(discount=0.1, shape=(40, 41)),
    "target": lambda: zoo.double_integrator(shape=(41, 41)),
    "undiscounted, at rest": lambda: zoo.smooth(shape=(41, 41), discount=0.0),
    "obstacles": lambda: (
        hjb.Problem(
            drift, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0, stopping_cost=lambda x: 0.3 + x[0]
        ),
        hjb.Grid([-1.0], [1.0], (41,)),
    ),
    "constrained": lambda: (
        hjb.Problem(drift, lambda x, u: x @ x + u @ u, hjb.Box([-1.0], [1.0]), discount=1.0),
        hjb.Grid([-1.0], [1.0], (41,), edges="constrained"),
    ),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in ("target", "undiscounted, at rest") else name
        for name in PROBLEMS
    ],
)
def test_what_is_known_of_every_second_node_is_what_a_preparation_finds_there(name):
    problem, grid = PROBLEMS[name]()
    task = task_of(problem, grid)
    coarse = nested_grids.coarser(grid)
    found, made = coarse_levels.on_coarser(task, coarse), task_of(problem, coarse)
    assert found.grid.shape == made.grid.shape == tuple((n + 1) // 2 for n in grid.shape)
    for part in ("obstacles", "counted", "least_cost", "on"):
        mine, theirs = (jax.tree.leaves(getattr(each, part)) for each in (found, made))
        for one, other in zip(mine, theirs, strict=True):
            np.testing.assert_allclose(np.broadcast_to(one, np.shape(other)), other, rtol=1e-12, atol=1e-12)


def test_the_fastest_rate_is_asked_for_on_every_grid():
    problem, grid = zoo.pendulum(discount=0.1, shape=(40, 41))
    on = Discretisation(problem, grid, SCHEME, KIND)
    task = prepare_on_host(on, method=hjb.ValueIteration(), tol=1e-3)[0]
    found = coarse_levels.on_coarser(task, nested_grids.coarser(grid))
    assert found.outflow.shape == (20, 21)
    assert float(np.max(found.outflow)) < 0.6 * float(np.max(task.outflow))  # half as many jumps per unit time


def test_a_coarser_grid_that_loses_the_target_is_none():
    problem = hjb.Problem(drift, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), target=lambda x: abs(x[0] - 0.05) - 0.01)
    task = task_of(problem, hjb.Grid([-1.0], [1.0], (41,)))  # the node at .05 is an odd one
    assert coarse_levels.on_coarser(task, hjb.Grid([-1.0], [1.0], (21,))) is None


def test_odd_intervals_are_prepared_anew_unless_nodes_are_lost():
    problem, grid = zoo.double_integrator(shape=(42, 42))
    task, coarse = task_of(problem, grid), nested_grids.coarser(grid)
    found = coarse_levels.on_coarser(task, coarse)
    assert found.counted.shape == coarse.shape == (22, 22)
    assert coarse_levels.on_coarser(dataclasses.replace(task, has_lost=True), coarse) is None


@pytest.mark.slow
def test_the_grid_that_tells_the_error_is_where_a_large_solve_begins(iterations):
    problem, grid = zoo.smooth(shape=(145, 145))
    solution = hjb.solve(problem, grid)
    fine, half = (145, 145), (73, 73)
    # on the coarser grid the second order first runs roughly, for an estimate of the error of the grid
    assert iterations[:5] == [("Upwind", half), ("Upwind", fine), *[("Limited", half)] * 2, ("Limited", fine)]
    begun = len(iterations)
    assert solution.stats["levels"] == [half, fine]
    alone = hjb.solve(problem, grid, method=METHOD)  # asked for, on one grid
    assert iterations[begun] == ("Upwind", fine)
    assert alone.stats["levels"] == [fine]
    np.testing.assert_allclose(solution.value, alone.value, rtol=0, atol=2e-3)  # each to a residual of 1e-3
    assert np.max(solution.grid_error) == pytest.approx(np.max(alone.grid_error), rel=0.05)


def test_levels_end_at_the_nodes_that_the_method_names():
    problem, grid = zoo.pendulum(discount=0.1, shape=(100, 101))
    task = task_of(problem, grid)
    for coarsest, wanted in ((300, [(25, 26), (50, 51)]), (2000, [(50, 51)]), (9000, [])):
        found = coarse_levels.levels(task, hjb.Nested(METHOD, coarsest), Clock(), asked_again=False)
        assert [level.grid.shape for level in found] == wanted
    told = coarse_levels.levels(task, METHOD, Clock(), asked_again=True)
    assert [level.grid.shape for level in told] == [(50, 51)]


@pytest.mark.slow
def test_nodes_that_are_lost_do_not_spoil_the_guess_of_their_neighbours():
    problem = hjb.Problem(
        lambda x, u: jnp.where(x[0] > 0.5, 1.0, u[0])[None],
        lambda x, u: 1.0,
        hjb.Box([-1.0], [1.0]),
        target=lambda x: jnp.abs(x[0]) - 0.1,
    )
    grid = hjb.Grid([-1.0], [1.0], (161,))
    with pytest.warns(hjb.SolveWarning, match="cannot reach the target"):
        found = hjb.solve(problem, grid, method=hjb.Nested(METHOD, 20), scheme=SCHEME, tol=1e-9)
    assert found.stats["levels"] == [(21,), (41,), (81,), (161,)]
    x = np.asarray(grid.axis(0))
    # upwinding is exact on a straight line: the time to the target, or for ever
    np.testing.assert_allclose(found.value, np.where(x > 0.5 + 1e-9, np.inf, np.maximum(np.abs(x) - 0.1, 0)), atol=1e-9)
    assert found.steps <= 2
