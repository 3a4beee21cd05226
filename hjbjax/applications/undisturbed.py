"""The loop of a feedback without a disturbance: whether it comes back from the corners of an inner box."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.path import PathStatus
from hjbjax.feedback.simulation import rollout
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.types import Array, State
from hjbjax.solution.solution import Solution

LOOKS = 8  # output intervals: only the last state counts
RTOL, ATOL = 1e-4, 1e-6  # of the paths: a mode that grows does so at any tolerance
NEARER = 0.5  # the ends over the starts, in their spread along each axis; a mode that rests keeps 1


def comes_back(problem: Problem, solution: Solution, inner: float, duration: float) -> bool:
    """True if all paths from the corners of the inner box stay in the box and end closer together than they began.

    No rest point is asked for. In a box around one, a mode that grows leaves the box or keeps the paths apart, and one
    that neither grows nor decays keeps them apart as they were.

    Args:
      problem: the game, whose disturbance is left at zero.
      solution: its stationary solution with the feedback.
      inner: the share of the grid's box, around its middle.
      duration: of the paths, in units of time.
    """
    grid = solution.grid
    assert problem.disturbances is not None
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=grid.ndim)))
    half = 0.5 * (np.asarray(grid.hi) - np.asarray(grid.lo))
    starts = np.asarray(grid.lo) + half + inner * half * signs  # (2^n, n)
    times, nothing = np.linspace(0.0, duration, LOOKS + 1), jnp.zeros(problem.disturbances.dim)

    def end(start: State) -> tuple[Array, Array]:
        path = rollout(problem, solution, start, times, disturbance=lambda x: nothing, rtol=RTOL, atol=ATOL)
        return path.code, path.states[-1]

    codes, ends = map(np.asarray, jax.jit(jax.vmap(end))(jnp.asarray(starts)))
    if np.any(codes != PathStatus.DURATION):
        return False
    return bool(np.all(_spread(grid, ends) <= NEARER * _spread(grid, starts)))


def _spread(grid: Grid, states: np.ndarray) -> np.ndarray:
    """The largest distance along each axis from the first of the states, shape (n,); the short way round a circle."""
    width = np.asarray(grid.hi) - np.asarray(grid.lo)
    apart = states - states[0]
    turns = np.where(np.array(grid.periodic), np.round(apart / width), 0)
    return np.max(np.abs(apart - width * turns), axis=0)
