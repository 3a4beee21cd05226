"""An estimate of the error of a march from costs and drifts that jump between nodes.

The jumps are those of ``discontinuities``. They make the rate at which V changes wrong by the mean J̄ of s J over the
moves from a node, and a path carries this error along:

    −e_t = Σ c (e(y) − e(x)) − β e + J̄,    e = 0 at the horizon.

V and e are marched together by Euler steps of the chain on a coarser grid, whose J̄ is divided by the ratio of the
spacings. There is nothing to march if the actions at the kept times do not meet a jump.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.rates import jump_rates
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.iteration import bellman, time_stepping
from hjbjax.iteration.bellman import Obstacles
from hjbjax.iteration.time_stepping import March
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import altered, cast
from hjbjax.problem.types import Field, Nodes, Scalar, Verdict
from hjbjax.solution.solution import Solution
from hjbjax.solvers import discontinuities, factored_level, nested_grids
from hjbjax.solvers.discontinuities import LEAST

FEWEST = 32  # steps per march
SHARE = 0.9  # of the longest monotone step

_obstacles = jax.jit(bellman.obstacles)


def error_along_paths(solution: Solution, task: March, start: Nodes | None, held: np.ndarray) -> Any:
    """The estimate at the kept times, (k, *grid), cost units; None if nothing jumps, or no grid is small enough.

    Args:
      solution: the completed march.
      task: its task.
      start: V at the horizon, if it is not the terminal cost.
      held: the fixed nodes at each kept time, bool (k, *grid), or (1, *grid).
    """
    if solution.policy is None or not _meets_jumps(solution, task):
        return None
    fine, level = task.grid, _small_enough(task.grid, np.any(held, axis=0))
    if level is None:
        return None
    on = cast(task.on.chain.on_grid(level), task.on.dtype)
    first = None if start is None else nested_grids.restrict(np.asarray(start), fine, level)
    ends = np.asarray([float(task.horizon), *np.asarray(solution.times, float)[::-1]], task.on.dtype)
    coarse = altered(task, on=on, obstacles=None, mesh=None)
    steps = discontinuities.directions(level, task.on.dtype).steps
    errors = np.asarray(_marched(coarse, first, steps, ends)) / nested_grids.ratio_of(fine, level)
    return np.stack([nested_grids.prolong(each, level, fine) for each in errors[::-1]])


def _meets_jumps(solution: Solution, task: March) -> bool:
    """True if the moves at some kept time meet a jump that costs more than a small fraction of the range of V."""
    for i, t in enumerate(np.asarray(solution.times)):
        value, on = np.asarray(solution.value[i]), task.on.chain.at(np.asarray(t, task.on.dtype))
        actions = tuple(
            None if each is None else np.asarray(each[i]) for each in (solution.policy, solution.disturbance)
        )
        obstacles = jax.device_get(_obstacles(on))
        loose = np.broadcast_to(np.logical_not(obstacles.fixed), value.shape)
        _, step = discontinuities.error_on_moves(on, actions, value, loose, np.asarray(obstacles.acting(value)))
        if np.max(step) > LEAST * np.ptp(value):
            return True
    return False


def _small_enough(grid: Grid, held: np.ndarray) -> Grid | None:
    """The smallest of the coarser grids that keeps the fixed nodes; None if it has too many nodes."""
    grids = [grid, *factored_level.coarser_grids(grid)]
    level = next(each for each in reversed(grids) if each is grid or nested_grids.keeps_nodes(held, grid, each))
    return level if level.size <= factored_level.FACTORED else None


@jax.jit
def _marched(task: March, start: Field | None, steps: tuple, ends: jax.Array) -> jax.Array:
    """The error e at the ends of intervals of time, from the horizon back, (k, *grid)."""
    value = time_stepping.terminal(task.on.at(task.horizon), start)

    def interval(carry: tuple[Field, Field], both: tuple[Scalar, Scalar]) -> tuple[tuple[Field, Field], Field]:
        def unfinished(carry: tuple[Field, Field, Scalar]) -> Verdict:
            return carry[2] > both[1]

        def step(carry: tuple[Field, Field, Scalar]) -> tuple[Field, Field, Scalar]:
            return _step(task, steps, carry, both[1])

        value, error, _ = jax.lax.while_loop(unfinished, step, (*carry, both[0]))
        return (value, error), error

    return jax.lax.scan(interval, (value, jnp.zeros_like(value)), (ends[:-1], ends[1:]))[1]


def _step(task: March, steps: tuple, carry: tuple[Field, Field, Scalar], end: Scalar) -> tuple[Field, Field, Scalar]:
    """V, e and the time after one Euler step towards the time ``end``."""
    value, error, t = carry
    on, grid = task.on.at(t), task.grid
    best, u, d = optimum.optimise(discrete.around(on, value))
    rates, growth = jump_rates(on, u, d), sum(on.growth(u, d))
    leaving = rates.total() + on.decay
    longest = SHARE / jnp.maximum(jnp.max(leaving), SHARE * FEWEST / task.horizon)
    after = jnp.where(t - longest > end, t - longest, end)
    total, moving = discontinuities.rate_errors(
        on, (list(u), list(d)), value, steps, _free_neighbours(on.grid, task, t)
    )
    source = jnp.where(moving > 0, total / jnp.where(moving > 0, moving, 1), 0)
    ahead = sum(rate * at(error) for rate, at in rates.jumps(grid))
    carried = error + (t - after) * (ahead + (growth - leaving) * error + source)
    obstacles = task.obstacles_at(after)
    moved = value + (t - after) * (best - on.decay * value)
    value = obstacles.impose(moved)
    return value, _after_ends(obstacles, moved, value, carried), after


def _free_neighbours(grid: Grid, task: March, t: Scalar) -> jax.Array:
    """For every direction the nodes whose neighbour exists and is free, bool (directions, *grid)."""
    loose = jnp.broadcast_to(~task.obstacles_at(t).fixed, grid.shape).astype(jnp.int8)
    ways = (stencil.unit(grid, axis, step) for axis in grid.state_axes for step in (-1, 1))
    return jnp.stack([stencil.neighbour(loose, grid, way, ghost=False) > 0 for way in ways])


def _after_ends(obstacles: Obstacles, moved: Field, value: Field, error: Field) -> Field:
    """The error where the run goes on; zero where it ends, and the error after an intervention where one is made."""
    kept = jnp.where(obstacles.acting(value), error, 0)
    interventions = obstacles.interventions
    if not interventions:
        return kept
    goes = interventions.chosen(moved if obstacles.upper is None else jnp.minimum(moved, obstacles.upper), value)
    arriving = altered(interventions, costs=(0.0,) * len(interventions.offsets)).after(error)
    pairs = zip(goes, arriving, strict=True)
    return functools.reduce(lambda kept, pair: jnp.where(pair[0] & ~obstacles.fixed, pair[1], kept), pairs, kept)
