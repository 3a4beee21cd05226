"""A coarse grid on which linear equations are factored, for estimates that need no fine one."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.landing import Landing
from hjbjax.iteration import bellman
from hjbjax.iteration.bellman import Greedy, PolicyEquation
from hjbjax.iteration.evaluation import factored
from hjbjax.iteration.fixed_point import Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Field
from hjbjax.solvers import nested_grids
from hjbjax.solvers.coarse_levels import on_coarser

SHARE, FEWEST, MOST = 16, 600, 3000  # nodes of the coarse grid: one in 16, within these limits
FACTORED = 12_000  # largest grid that is factored if a coarser one would lose the target
INTERVALS = 6  # least number of intervals per axis


class Rows(NamedTuple):
    """The rows δ(x) = source + Σ_o weights_o δ(x + o) of a linear equation, all (*grid), and its far jumps."""

    source: Field
    weights: dict[tuple[int, ...], Field]
    landings: tuple[Landing, ...]

    def factored(self, grid: Grid) -> Callable[[np.ndarray], np.ndarray]:
        """δ as a function of the source, arrays (*grid) in NumPy; NaN if the matrix is singular."""
        weights, landings = jax.device_get((self.weights, self.landings))
        return factored(list(weights), list(weights.values()), grid, landings=landings)


def rows_of(equation: PolicyEquation, grid: Grid) -> Rows:
    """The equation of a policy with weights beyond open ends moved to inner nodes, and repeated offsets added up."""
    offsets, entries = stencil.inward(equation.weights.offsets, equation.weights.values, grid)
    weights: dict[tuple[int, ...], Field] = {}
    for offset, entry in zip(offsets, entries, strict=True):
        weights[offset] = weights[offset] + entry if offset in weights else entry
    return Rows(equation.source, weights, equation.weights.landings)


@jax.jit
def policy_at(task: Task, value: Field) -> tuple[Field, Greedy]:
    """V with prescribed values inserted, and its policy with the defect of V where actions matter.

    The actions are results too, because XLA would otherwise recompute them in every branch of the defect.
    """
    value = task.impose(value)
    policy = bellman.greedy(task.on, value, task.obstacles.fixed, lost=task.lost)
    return value, dataclasses.replace(policy, defect=jnp.where(task.obstacles.acting(value), policy.defect, 0))


def small_enough(task: Task) -> Task | None:
    """The task of the chain on a grid that is small enough to factor; None if the problem has none."""
    level = dataclasses.replace(task, on=task.on.chain)
    grids = coarser_grids(task.grid)
    while grids:
        coarse = on_coarser(level, grids.pop())
        if coarse is not None:
            level = coarse
            break
    fits = level.grid.size <= FACTORED and level.grid.ndim < 6
    return dataclasses.replace(level, mesh=None) if fits else None


def coarser_grids(grid: Grid) -> list[Grid]:
    """Ever coarser grids; the number of nodes of the last is closest to the wanted one, as a ratio."""
    grids, wanted = [grid], int(np.clip(grid.size // SHARE, FEWEST, MOST))
    while grids[-1].size > wanted and (coarse := nested_grids.coarser(grids[-1], INTERVALS)) is not None:
        if coarse.size * grids[-1].size < wanted**2:
            break
        grids.append(coarse)
    return grids[1:]
