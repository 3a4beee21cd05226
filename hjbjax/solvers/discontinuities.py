"""An estimate of the error from costs and drifts that jump between nodes.

On a move from x to its neighbour y the chain pays the running cost at x. If the cost jumps by J at a fraction θ of the
way, V_h is off by (1 − θ) J times the time of the move. A coarser grid may place the jump at the same fraction of its
own spacing, and then the comparison of two grids shows nothing.

Let H be the rate at which V changes under the policy with DV kept, at the node, halfway and at the neighbour:

    H(z) = L(z, u, d) + f(z, u, d)·DV(x) + g(z, u, d) V(x),     J = |H(x) − 2 H((x + y)/2) + H(y)|

is small for smooth data and the height of a jump otherwise. The error e is the total of these errors along the paths of
the chain: Q e = Σ c e(y) + Σ c s J/(Σ c), with s = 1 or ½ for a jump in the half next to x or next to y. This equation
is solved on a grid that is small enough to factor, with the mean of its right-hand side over the finer nodes.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.rates import jump_rates
from hjbjax.iteration import bellman
from hjbjax.iteration.bellman import Greedy
from hjbjax.iteration.fixed_point import Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Field
from hjbjax.solution.solution import Solution
from hjbjax.solvers import factored_level, nested_grids
from hjbjax.solvers.factored_level import Rows

SMOOTH = 0.5  # ratio of J to the same difference over two spacings; it is a quarter where the data are smooth
LEAST = 1e-4  # fraction of the range of V: jumps that cost less on one move are not worth a linear solve


def error_at_discontinuities(solution: Solution, task: Task) -> np.ndarray | None:
    """The estimate at the nodes, (*grid), cost units; None if nothing jumps, or no grid is small enough."""
    value = np.asarray(solution.value)
    finite = np.isfinite(value)
    if solution.policy is None or not finite.any():
        return None
    least, most = np.min(value, where=finite, initial=np.inf), np.max(value, where=finite, initial=-np.inf)
    filled = np.where(finite, value, most)
    source, step = jax.device_get(_jumps(task, filled, solution.policy, solution.disturbance))
    if not np.max(step) > LEAST * (most - least):
        return None
    level = factored_level.small_enough(task)
    if level is None:
        return None
    error = _along_paths(level, filled, source, task.grid)
    return None if error is None else nested_grids.prolong(error, level.grid, task.grid)


@jax.jit
def _jumps(task: Task, value: Field, policy: Field, disturbance: Field | None) -> tuple[Field, Field]:
    """The mean error of the rate H on the moves from each node, per unit time, and its cost on one move, (*grid)."""
    on, grid = task.on.chain, task.grid
    x, slopes = on.coordinates(), [_central(value, grid, axis) for axis in range(grid.ndim)]
    u, d = ([] if each is None else list(jnp.moveaxis(each, -1, 0)) for each in (policy, disturbance))

    def rate_at(offset: tuple[int, ...], share: float) -> tuple[Field, list]:
        """H and f at x + share (y − x)."""
        z = [_towards(c, grid, axis, share * offset[axis]) for axis, c in enumerate(x)]
        f, growth = on.drift(u, d, z), on.growth(u, d, z)
        paid = on.running_cost(u, d, z) + sum(each * value for each in growth)
        return paid + sum(f[axis] * slopes[axis] for axis in grid.state_axes), f

    here, f = rate_at((0,) * grid.ndim, 0)
    total = moving = jnp.zeros(grid.shape, on.dtype)
    rates, loose, random = jump_rates(on, u, d), ~task.obstacles.fixed, on.problem.noise is not None
    for offset, c in zip(rates.offsets, rates.values, strict=True):
        (middle, _), (there, beyond), (behind, _) = (rate_at(offset, share) for share in (0.5, 1, -1))
        jump = jnp.abs(here - 2 * middle + there)
        near = jnp.abs(middle - here) > jnp.abs(there - middle)
        jump = jnp.where(jump > SMOOTH * jnp.abs(behind - 2 * here + there), jump, 0) * jnp.where(near, 1, 0.5)
        # beyond the boundary of a target nothing is paid, and a cost may be undefined there
        counts = (c > 0) & jnp.isfinite(jump) & stencil.neighbour(loose, grid, offset)
        if not random:  # a path that comes to rest between x and y does not get to y
            counts &= functools.reduce(
                jnp.logical_and, (jnp.abs(f[i]) > jnp.abs(beyond[i] - f[i]) for i, step in enumerate(offset) if step)
            )
        total, moving = total + jnp.where(counts, c * jump, 0), moving + c
    moves = task.obstacles.acting(value) & (moving > 0)
    source = jnp.where(moves, total / jnp.where(moves, moving, 1), 0)
    return source, jnp.where(moves, source / jnp.where(moves, moving, 1), 0)


def _central(value: Field, grid: Grid, axis: int) -> Field:
    """The slope of V along an axis by central differences, one-sided at the ends of the box."""
    up, down = stencil.one_sided(value, grid, axis)
    if grid.periodic[axis]:
        return (up + down) / 2
    first, last = (stencil.on_edge(grid, axis, step) for step in (-1, 1))
    return jnp.where(first, up, jnp.where(last, down, (up + down) / 2))


def _towards(x: Field, grid: Grid, axis: int, share: float) -> Field:
    """A coordinate at a share of the way to the next node, above if it is positive, or else below."""
    if share == 0 or axis not in grid.state_axes:
        return x
    link = stencil.grid_links(grid, axis)
    return x + share * (link.up if share > 0 else link.down)


def _along_paths(level: Task, value: np.ndarray, source: np.ndarray, fine: Grid) -> np.ndarray | None:
    """The total of the source along the paths of the chain on a coarser grid, (*level.grid); None if it is infinite."""
    restricted = jnp.asarray(nested_grids.restrict(value, fine, level.grid), level.tol.dtype)
    mean = jnp.asarray(nested_grids.mean_around(source, fine, level.grid), level.tol.dtype)
    error = _accumulation(level, *factored_level.policy_at(level, restricted), mean).solved(level.grid)
    return error if np.all(np.isfinite(error)) else None


@jax.jit
def _accumulation(level: Task, value: Field, policy: Greedy, source: Field) -> Rows:
    """The equation for the total of a source along the paths of a policy; zero where they end."""
    obstacles = level.obstacles
    # an infinite defect selects the constraint, whose row has no source
    beyond = jnp.inf if obstacles.lower is None else jnp.where(value > obstacles.lower, jnp.inf, -jnp.inf)
    defect = jnp.where(obstacles.acting(value), source, jnp.where(obstacles.fixed, 0, beyond))
    equation = bellman.policy_equation(level.on, value, dataclasses.replace(policy, defect=defect), obstacles)
    return factored_level.rows_of(equation, level.grid)
