"""Paths that end at a target, or where the feedback has no control: every grid, every kind of players."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hjbjax.feedback.path import PathStatus
from hjbjax.feedback.simulation import simulate
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.sets import Ball, Box, Finite
from hjbjax.problem.stretching import Sinh
from hjbjax.solution.interpolation import extended
from hjbjax.solution.solution import Solution

GRID = Grid([-1.5, -1.5], [1.5, 1.5], (31, 31))


@pytree_dataclass()
class Disc:
    """A disc as target, or all that is outside of it (side = −1)."""

    radius: object
    side: object = 1.0

    def level(self, x):
        return self.side * (jnp.sqrt(x @ x) - self.radius)


def velocity(x, u):
    return u


def one(x, u):
    return 1.0


def to_disc(radius, side=1.0):
    """The way straight to the target, with NaN at its nodes as ``solve`` leaves them, and the problem."""
    disc = Disc(radius, side)
    x = GRID.nodes()
    distance = np.linalg.norm(x, axis=-1, keepdims=True)
    policy = -side * x / np.where(distance > 0, distance, 1)
    policy[side * (distance[..., 0] - radius) <= 1e-12] = np.nan
    return Problem(velocity, one, Ball(1.0, 2), target=disc.level), Solution(GRID, 0 * distance[..., 0], policy)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.3, 0.25])
def test_a_path_ends_on_the_boundary_of_a_disc_wherever_the_output_times_fall(radius):
    """Radius .3 on spacing .1: the boundary goes through nodes, and along an axis only they count."""
    problem, solution = to_disc(radius)
    for x0, duration in (([1.0, 0.0], 3.0), ([1.0, 0.0], 2.0), ([0.0, -1.0], 20.0), ([0.7, 0.6], 1.7)):
        path = simulate(problem, solution, x0, duration)
        assert (path.status, path.times[-1]) == (PathStatus.TARGET, path.reached)
        assert np.linalg.norm(path.states[-1]) == pytest.approx(radius, abs=1e-6)
        # a mean of unit vectors over a cell is shorter than one by about h²/4r²: 3 % at the disc, less farther out
        assert path.reached == pytest.approx(np.hypot(*x0) - radius, abs=6e-3) == path.cost
        assert path.steps < 300
        assert np.all(np.isfinite(path.controls))


@pytest.mark.slow
def test_a_path_ends_on_the_boundary_of_a_hollow_target_in_cells_without_a_control():
    problem, solution = to_disc(1.0, side=-1.0)
    for angle in np.linspace(0.0, 1.5, 7):
        way = np.array([np.cos(angle), np.sin(angle)])
        path = simulate(problem, solution, 0.3 * way, 4.0)
        assert path.status == PathStatus.TARGET
        assert np.linalg.norm(path.states[-1]) == pytest.approx(1.0, abs=1e-6)
        assert path.reached == pytest.approx(0.7, abs=6e-3)


def test_a_path_into_states_without_a_control_ends_there_and_says_where():
    problem, solution = to_disc(0.3)
    policy = np.array(solution.policy)
    policy[...] = [-1.0, 0.0]
    policy[GRID.nodes()[..., 0] < -0.45] = np.nan
    stranded = Solution(GRID, solution.value, policy)
    with pytest.warns(UserWarning, match=r"no control \(NaN\).*x = \[-0\.\d+, 1\]"):
        path = simulate(problem, stranded, [0.0, 1.0], 3.0)
    assert path.status == PathStatus.UNDEFINED
    assert path.reached is None
    assert np.all(np.isfinite(path.states))
    assert np.all(np.isfinite(path.controls))
    assert -0.6 - 1e-9 <= path.states[-1, 0] <= -0.5 + 1e-9  # the last node with a control, or a cell farther
    assert path.times[-1] == pytest.approx(-path.states[-1, 0], abs=1e-6) == path.cost
    with pytest.warns(UserWarning, match="no control"):
        path = simulate(problem, stranded, [-1.0, 1.0], 3.0)
    assert (path.status, path.states.tolist(), path.controls.shape) == (PathStatus.UNDEFINED, [[-1.0, 1.0]], (0, 2))


@pytest.mark.slow
def test_a_game_with_enumerated_controls_across_a_seam_on_a_stretched_axis_ends_at_its_target():
    grid = Grid([0.0, -1.0], [1.0, 1.0], (20, 21), periodic=(True, False), stretch=(None, Sinh(1.5)))

    def level(x):  # a box around the seam of the first axis
        return jnp.maximum(jnp.abs(jnp.mod(x[0] + 0.5, 1.0) - 0.5) - 0.1, jnp.abs(x[1]) - 0.2)

    x = grid.nodes()
    inside = np.asarray(jax.vmap(level)(x.reshape(-1, 2))).reshape(grid.shape) <= 1e-9
    assert inside.sum() == 15
    first = np.where(x[..., 0] < 0.5, -1.0, 1.0)
    policy = np.stack([np.where(np.abs(x[..., 1]) < 0.15, first, 0), np.where(np.abs(x[..., 1]) < 0.15, 0, 1)], -1)
    policy[..., 1] *= -np.sign(x[..., 1])
    worst = np.stack([0 * first, 0.25 * np.sign(x[..., 1])], -1)
    policy[inside], worst[inside] = np.nan, np.nan
    admissible = Finite([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0], [0.0, 0.0]])
    problem = Problem(
        lambda x, u, d: u + d, lambda x, u, d: 1.0, admissible, disturbances=Box([-0.25] * 2, [0.25] * 2), target=level
    )
    solution = Solution(grid, 0 * first, policy, worst, discrete=True)
    for x0, wanted in (([0.7, 0.05], 0.2), ([0.3, -0.05], 0.2), ([0.0, 0.65], 0.6), ([0.95, -0.65], 0.6)):
        path = simulate(problem, solution, x0, 3.0)
        assert path.status == PathStatus.TARGET, path.message
        assert path.reached == pytest.approx(wanted, abs=0.02)
        assert abs(float(level(path.states[-1]))) < 1e-6
        assert {tuple(u) for u in path.controls} <= {tuple(u) for u in admissible.points}


@pytest.mark.slow
def test_a_target_that_moves_is_met_by_a_marched_feedback_on_a_line():
    """From x = 1 at speed −1 towards |x| ≤ .2 + .1 t: met where 1 − t = .2 + .1 t."""
    grid, times = Grid([-1.0], [1.0], (21,)), np.linspace(0.0, 2.0, 21)

    def level(t, x):
        return jnp.abs(x[0]) - 0.2 - 0.1 * t

    x = np.broadcast_to(grid.axis(0), (21, 21))
    policy = np.where(np.abs(x) <= 0.2 + 0.1 * times[:, None] + 1e-9, np.nan, -np.sign(x))[..., None]
    problem = Problem(lambda t, x, u: u, lambda t, x, u: 1.0, Box([-1.0], [1.0]), target=level, time_dependent=True)
    solution = Solution(grid, np.zeros((21, 21)), policy, times=times)
    for x0 in (1.0, -1.0):
        path = simulate(problem, solution, [x0], 2.0)
        assert path.reached == pytest.approx(0.8 / 1.1, abs=1e-6)
        assert path.status == PathStatus.TARGET


def test_a_feedback_of_nan_is_blamed_and_not_the_state():
    problem = Problem(velocity, one, Ball(1.0, 1))
    with pytest.warns(UserWarning, match=r"feedback are not finite at t = 0\.\d+, x = \[0\.\d+\]"):
        path = simulate(problem, lambda x: jnp.where(x > 0.52, jnp.nan, 1.0), [0.0], 1.0, steps=10)
    assert path.status == PathStatus.NONFINITE
    assert path.states[-1, 0] == pytest.approx(0.5)
    assert path.steps < 60_000  # it does not crawl through all of max_steps


def test_controls_reach_one_node_farther_than_they_are_known():
    small = Grid([0.0, 0.0], [1.0, 1.0], (5, 5))
    lost = np.full((5, 5, 1), np.nan)
    lost[2, 2] = 3.0
    assert np.isfinite(extended(small, lost, False)).sum() == 9
    row = np.array([[1.0, 2.0], [np.nan, np.nan], [3.0, 6.0], [np.nan, np.nan], [np.nan, np.nan]])
    line, circle = Grid([0.0], [1.0], (5,)), Grid([0.0], [1.0], (5,), periodic=(True,))
    wanted = [[1, 2], [2, 4], [3, 6], [3, 6], [np.nan, np.nan]]
    np.testing.assert_array_equal(extended(line, row, False), wanted)
    np.testing.assert_array_equal(extended(line, row, True), [[1, 2], [1, 2], *wanted[2:]])
    np.testing.assert_array_equal(extended(circle, row, False)[4], [1, 2])
    np.testing.assert_array_equal(jax.jit(lambda a: extended(circle, a, True))(row), extended(circle, row, True))
