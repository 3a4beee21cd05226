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
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import bellman
from hjbjax.iteration.bellman import Greedy
from hjbjax.iteration.fixed_point import Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import DType, Field
from hjbjax.solution.solution import Solution
from hjbjax.solvers import factored_level, nested_grids
from hjbjax.solvers.factored_level import Rows
from hjbjax.solvers.rest_error import along, link_lengths

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
    source, step = _jumps(solution, task, filled)
    if not np.max(step) > LEAST * (most - least):
        return None
    level = factored_level.small_enough(task)
    if level is None:
        return None
    error = _along_paths(level, filled, source, task.grid)
    return None if error is None else nested_grids.prolong(error, level.grid, task.grid)


def _jumps(solution: Solution, task: Task, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean error of the rate H on the moves from each node, per unit time, and its cost on one move, (*grid)."""
    obstacles = jax.device_get(task.obstacles)
    actions = tuple(None if each is None else np.asarray(each) for each in (solution.policy, solution.disturbance))
    loose = np.broadcast_to(np.logical_not(obstacles.fixed), task.grid.shape)
    return error_on_moves(task.on.chain, actions, value, loose, np.asarray(obstacles.acting(value)))


def error_on_moves(
    on: Discretisation, actions: tuple, value: np.ndarray, loose: np.ndarray, acting: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The mean error of the rate H on the moves from each node, per unit time, and its cost on one move, (*grid).

    Args:
      on: the problem on its grid, with the slopes of the chain.
      actions: u and d, (*grid, m); None for a player that does not exist.
      value: V, finite, (*grid).
      loose: the nodes without a prescribed value, bool (*grid).
      acting: the nodes at which actions matter, bool (*grid); there is no error elsewhere.
    """
    ways = directions(on.grid, value.dtype)
    # beyond the boundary of a target nothing is paid, and a cost may be undefined there
    free = np.stack([_next_to(loose, on.grid, axis, step) for axis, step in ways.neighbours])
    total, moving = jax.device_get(_missed(on, actions, value, ways.steps, free))
    moves = acting & (moving > 0)
    source = np.divide(total, moving, out=np.zeros_like(total), where=moves)
    return source, np.divide(source, moving, out=np.zeros_like(total), where=moves)


class Directions(NamedTuple):
    """The directions to the neighbours of the nodes.

    Attributes:
      neighbours: the axis and the sign of each direction.
      steps: the coordinates of the nodes; for every axis the way to the neighbour in each direction; and each direction
        as a unit vector.
    """

    neighbours: list[tuple[int, int]]
    steps: tuple[list[np.ndarray], list[np.ndarray], np.ndarray]


def directions(grid: Grid, dtype: DType) -> Directions:
    """The directions to the neighbours on a grid, in NumPy, because small programs compile fast."""
    x = [np.reshape(np.asarray(grid.axis(axis), dtype), along(grid, axis)) for axis in range(grid.ndim)]
    ways = [(axis, step) for axis in grid.state_axes for step in (-1, 1)]
    signs = np.array([[step * (i == axis) for i in range(grid.ndim)] for axis, step in ways], dtype)
    shifts = [np.stack([_step(grid, axis, sign[axis]) for sign in signs]).astype(dtype) for axis in range(grid.ndim)]
    return Directions(ways, (x, shifts, signs))


@jax.jit
def _missed(on: Discretisation, actions: tuple, value: Field, steps: tuple, free: jax.Array) -> tuple[Field, Field]:
    """``rate_errors`` for actions of shape (*grid, m)."""
    u, d = ([] if each is None else list(jnp.moveaxis(each, -1, 0)) for each in actions)
    return rate_errors(on, (u, d), value, steps, free)


def rate_errors(
    on: Discretisation, actions: tuple[list, list], value: Field, steps: tuple, free: jax.Array
) -> tuple[Field, Field]:
    """The sum over all directions of the rate of moves times the error of H on them, and of the rates, (*grid).

    Args:
      on: the problem on its grid.
      actions: the components of u and of d, each (*grid).
      value: V.
      steps: see ``Directions``.
      free: for every direction the nodes whose neighbour is free, bool (directions, *grid).
    """
    x, shifts, signs = steps
    around = (value, [_slope(value, on.grid, x[axis], axis) for axis in range(on.grid.ndim)])

    def add(sums: tuple[Field, Field], way: tuple[list, jax.Array, Field]) -> tuple[tuple[Field, Field], None]:
        shift, sign, free = way
        missed, rate = _missed_on(on, x, actions, around, (shift, list(sign)))
        return (sums[0] + jnp.where(free, missed, 0), sums[1] + rate), None

    zero = jnp.zeros(on.grid.shape, on.dtype)
    return jax.lax.scan(add, (zero, zero), (shifts, signs, free))[0]


def _missed_on(
    on: Discretisation, x: list, actions: tuple[list, list], around: tuple[Field, list], way: tuple[list, list]
) -> tuple[Field, Field]:
    """The rate of moves in one direction times the error of H on them, and this rate, (*grid)."""
    (u, d), (value, slopes), (shift, sign) = actions, around, way

    def rate_at(share: float) -> tuple[Field, Field]:
        """H at x + share (y − x), and the drift towards y."""
        z = [entry + share * step for entry, step in zip(x, shift, strict=True)]
        f, growth = on.drift(u, d, z), on.growth(u, d, z)
        paid = on.running_cost(u, d, z) + sum(each * value for each in growth)
        gain = sum(rate * slope for rate, slope in zip(f, slopes, strict=True))
        return paid + gain, sum(rate * step for rate, step in zip(f, sign, strict=True))

    (behind, _), (here, f), (middle, _), (there, beyond) = (rate_at(share) for share in (-1, 0, 0.5, 1))
    jump = jnp.abs(here - 2 * middle + there)
    near = jnp.abs(middle - here) > jnp.abs(there - middle)
    jump = jnp.where(jump > SMOOTH * jnp.abs(behind - 2 * here + there), jump, 0) * jnp.where(near, 1, 0.5)
    length, noise = sum(jnp.abs(step) for step in shift), on.diffusion(u, d)
    rate = jnp.maximum(f, 0) / length + sum(sign[i] ** 2 * a for (i, j), a in noise.items() if i == j) / (2 * length**2)
    # without noise, a path that comes to rest between x and y does not get to y
    counts = jnp.isfinite(jump) & ((f * beyond > 0) | (on.problem.noise is not None))
    return jnp.where(counts, rate * jump, 0), rate


def _step(grid: Grid, axis: int, sign: float) -> np.ndarray:
    """The way to the next node along an axis, up or down, or zero; one number per node of the axis."""
    up = link_lengths(grid, axis)
    return np.reshape(sign * (up if sign > 0 else np.append(up[:1], up[:-1])), along(grid, axis))


def _next_to(nodes: np.ndarray, grid: Grid, axis: int, step: int) -> np.ndarray:
    """True where the neighbour in one direction exists and is one of the nodes, bool (*grid)."""
    found = np.roll(nodes, -step, axis)
    if not grid.periodic[axis]:
        found[(slice(None),) * axis + (-1 if step > 0 else 0,)] = False
    return found


def _slope(value: Field, grid: Grid, x: jax.Array, axis: int) -> Field:
    """The slope of V along an axis by central differences, one-sided at the ends of the box."""
    if axis not in grid.state_axes:
        return jnp.zeros_like(value)
    if grid.periodic[axis]:
        width = 2 * jnp.asarray(grid.spacing(axis), value.dtype)
        return (jnp.roll(value, -1, axis) - jnp.roll(value, 1, axis)) / width
    ahead, behind = (np.clip(np.arange(grid.shape[axis]) + step, 0, grid.shape[axis] - 1) for step in (1, -1))
    width = jnp.take(x, ahead, axis) - jnp.take(x, behind, axis)
    return (jnp.take(value, ahead, axis) - jnp.take(value, behind, axis)) / width


def _along_paths(level: Task, value: np.ndarray, source: np.ndarray, fine: Grid) -> np.ndarray | None:
    """The total of the source along the paths of the chain on a coarser grid, (*level.grid); None if it is infinite."""
    restricted = jnp.asarray(nested_grids.restrict(value, fine, level.grid), level.tol.dtype)
    mean = jnp.asarray(nested_grids.mean_around(source, fine, level.grid), level.tol.dtype)
    rows = _accumulation(level, *factored_level.policy_at(level, restricted), mean)
    error = rows.factored(level.grid)(np.asarray(rows.source))
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
