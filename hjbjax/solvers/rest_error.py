"""An estimate of the error at rest points between the nodes.

A discounted path may rest at a state z with f(z, u) = 0, so V(z) ≤ L(z, u)/β. On a grid it rests at a node, or it moves
on where resting at the nodes is expensive. If the running cost is lower between two nodes than at both of them, V_h is
too large by at least V_h − L(z, u)/β near z. A coarser grid often makes the same error, and then comparing two grids
shows nothing.

Such places are sought on the links between neighbours along which L bends upwards so much that the error may matter.
From the ends and the middle of each, with the action of its lower node, Newton's method finds f(z, u) = 0 by the
shortest step in (z, u), where one unit is a spacing and half the width of the admissible controls. The links on which a
parabola through the three costs is lowest, compared with V_h, are sampled.
"""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.iteration.fixed_point import Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_random
from hjbjax.problem.sets import Box
from hjbjax.solution.solution import Solution
from hjbjax.tracing import components

BLOCK = 1 << 12  # states at a time, always the same number for one program
MANY = 1 << 14  # links along each axis that are tried, of the largest bends
LEAST = 1e-3  # fraction of the range of V: smaller errors are not sought
STEPS = 3  # of Newton's method, which takes one if the drift is affine
RIDGE = 1e-9  # added to the normal matrix, as a fraction of its trace
MOST = 64  # links that are sampled
PARTS, ZOOMS = 8, 3  # parts of half a link, and how often they are divided around the best one
STILL = 0.01  # a path rests if it moves by less than this fraction of a spacing in the time 1/β


class _Value(NamedTuple):
    """V_h with its policy, and what a cost at rest is compared with.

    Attributes:
      problem, grid: the problem and the grid.
      value: V_h, (*grid).
      free: the nodes where V_h is finite and not prescribed, bool (*grid).
      policy: the controls, (nodes, m).
      discount: β, per unit time.
    """

    problem: Problem
    grid: Grid
    value: np.ndarray
    free: np.ndarray
    policy: np.ndarray
    discount: float


def error_at_rest(solution: Solution, task: Task, above: float) -> float:
    """The largest error of V at a rest point between nodes, in cost units; zero with noise and without a discount.

    Args:
      solution: the solution.
      task: its task.
      above: an estimate of the error; a third of it is the least error that is sought.
    """
    problem, grid, value = task.problem, task.grid, np.asarray(solution.value)
    if solution.policy is None or grid.modes or not _may_rest(problem):
        return 0.0
    free = ~np.broadcast_to(np.asarray(task.obstacles.fixed), value.shape) & np.isfinite(value)
    if not free.any():
        return 0.0
    policy = np.asarray(solution.policy).reshape(value.size, -1)
    about = _Value(problem, grid, value, free, policy, float(np.asarray(problem.discount)))
    scale = np.max(value, where=free, initial=-np.inf) - np.min(value, where=free, initial=np.inf)
    found = _promising_links(about, max(above / 3, LEAST * float(scale)))
    return max((_largest_excess(about, *links) for links in found), default=0.0)


def _may_rest(problem: Problem) -> bool:
    """True if V ≤ L/β at every state where a control holds the state: no noise, one player, a constant discount."""
    if problem.cost is None or problem.is_game or is_random(problem) or problem.growth is not None:
        return False
    return not callable(problem.discount) and float(np.asarray(problem.discount)) > 0


def _promising_links(about: _Value, least: float) -> list[tuple[np.ndarray, int]]:
    """For every axis the links where V_h − L/β at rest may be largest: their lower nodes, (k,), and the axis."""
    grid, found = about.grid, []
    for axis in range(grid.ndim):
        bends = _bends_along(about, axis)
        nodes = np.flatnonzero(bends > 2 * about.discount * least)  # at most half a bend below both ends
        nodes = nodes[np.argsort(-bends.ravel()[nodes], kind="stable")[:MANY]]
        gains = [np.zeros(0)]
        for part in (nodes[start : start + BLOCK // 3] for start in range(0, nodes.size, BLOCK // 3)):
            middle = _moved(about, part, _states(grid, part), axis, 0.5)
            states = np.concatenate([_moved(about, part, middle, axis, share) for share in (-0.5, 0, 0.5)], axis=1)
            excess, cost = (np.split(each, 3) for each in _excess(about, np.tile(part, 3), states))
            gains.append(excess[1] + _below_middle(*cost))
        gain = np.concatenate(gains)
        best = np.argsort(-gain, kind="stable")[:MOST]
        best = best[gain[best] > -np.inf]
        if best.size:
            found.append((nodes[best], axis))
    return found


def _bends_along(about: _Value, axis: int) -> np.ndarray:
    """The second difference of L between each node and the next along an axis, (*grid); −∞ where there is no next."""
    grid = about.grid
    nodes = (np.asarray(grid.axis(i), about.value.dtype) for i in range(grid.ndim))
    x = [np.reshape(each, along(grid, i)) for i, each in enumerate(nodes)]
    shift = [np.zeros_like(each) for each in x]
    shift[axis] = np.reshape(link_lengths(grid, axis), x[axis].shape).astype(x[axis].dtype)
    u = list(np.moveaxis(about.policy.reshape(*grid.shape, -1), -1, 0))
    bends = np.array(_bends(about.problem, x, shift, u))
    last = (slice(None),) * axis + (-1,)
    if not grid.periodic[axis]:
        bends[last] = -np.inf
    return np.where(about.free & np.isfinite(bends), bends, -np.inf)


@jax.jit
def _bends(problem: Problem, x: list, shift: list, u: list) -> jax.Array:
    """L(x) − 2 L(x + s/2) + L(x + s) with the same action, cost per unit time, (*grid)."""
    first, middle, last = (
        _running_cost(problem, [a + share * b for a, b in zip(x, shift, strict=True)], u) for share in (0, 0.5, 1)
    )
    return jnp.broadcast_to(first - 2 * middle + last, np.broadcast_shapes(*(each.shape for each in x)))


def _running_cost(problem: Problem, x: list, u: list) -> jax.Array:
    """L at states, one entry per state."""
    return components.scalar(problem.cost, *problem.arguments(x, u), dtype=x[0].dtype)


def _largest_excess(about: _Value, nodes: np.ndarray, axis: int) -> float:
    """The largest V_h − L/β at rest on links, and on lines across them; zero if none is positive."""
    states = _moved(about, nodes, _states(about.grid, nodes), axis, 0.5)
    best, ndim = 0.0, about.grid.ndim
    for turn, zoom in itertools.product(range(ndim), range(ZOOMS)):
        reach = (0.5 if turn == 0 else 1.0) / PARTS**zoom
        shares = np.linspace(-reach, reach, 2 * PARTS + 1)
        tried = np.array([_moved(about, nodes, states, (axis + turn) % ndim, share) for share in shares])
        flat = np.moveaxis(tried, 1, 0).reshape(ndim, -1)
        excess = _excess(about, np.tile(nodes, shares.size), flat)[0].reshape(shares.size, -1)
        best = max(best, float(np.max(excess)))
        states = tried[np.argmax(excess, axis=0), :, np.arange(nodes.size)].T
    return best


def _moved(about: _Value, nodes: np.ndarray, states: np.ndarray, axis: int, share: float) -> np.ndarray:
    """States that are moved by a share of the link from each node to the next along an axis, (n, k)."""
    moved = states.copy()
    moved[axis] += share * link_lengths(about.grid, axis)[np.unravel_index(nodes, about.grid.shape)[axis]]
    return moved


def _excess(about: _Value, nodes: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least V_h of the cell minus L/β at the rest point near each state, and L/β there, (k,); −∞ and ∞ without one.

    Args:
      about: V_h and its problem.
      nodes: the flat indices of nodes whose action is tried, (k,).
      states: the states, (n, k).
    """
    grid, count = about.grid, nodes.size
    wanted = np.resize(np.arange(count), BLOCK)  # always the same number, for one program
    z, u = (list(each[:, wanted]) for each in (states, about.policy[nodes].T))
    spacings = [_spacing(grid, axis) for axis in range(grid.ndim)]
    place, cost = _at_rest(about.problem, z, u, spacings, about.discount)
    cost = np.asarray(cost)[:count].astype(float) / about.discount
    least = _least_of_cell(about, np.asarray(place)[:, :count])
    return np.where(np.isfinite(cost), least - np.where(np.isfinite(cost), cost, 0), -np.inf), cost


@jax.jit
def _at_rest(problem: Problem, x: list, u: list, spacings: list, discount: Any) -> tuple[jax.Array, jax.Array]:
    """The rest point near each state x, entries (k,), and its running cost (k,); infinite if none is near."""
    dtype, lo, hi = x[0].dtype, [], []
    if isinstance(problem.controls, Box):
        lo, hi = (list(jnp.asarray(bound, dtype)) for bound in (problem.controls.lo, problem.controls.hi))
    widths = [jnp.where(jnp.isfinite(b - a), (b - a) / 2, 1) for a, b in zip(lo, hi, strict=True)]
    units = [*(jnp.asarray(h, dtype) for h in spacings), *widths]
    n, free, z = len(x), u[: len(widths)], list(x)

    def drift(z: list, free: list) -> list:
        values = components.components(problem.drift, *problem.arguments(z, [*free, *u[len(free) :]]), dtype=dtype)
        return [jnp.broadcast_to(value, x[0].shape) for value in values]

    for _ in range(STEPS):
        columns = []
        for direction in range(len(units)):
            tangents = [jnp.full_like(x[0], units[direction] * (direction == j)) for j in range(len(units))]
            f, column = jax.jvp(drift, (z, free), (tangents[:n], tangents[n:]))
            columns.append(column)
        steps = _shortest(columns, f)
        z = [entry + unit * step for entry, unit, step in zip(z, units[:n], steps[:n], strict=True)]
        moved = (entry + unit * step for entry, unit, step in zip(free, units[n:], steps[n:], strict=True))
        free = [jnp.clip(entry, a, b) for entry, a, b in zip(moved, lo, hi, strict=True)]
    rests = jnp.ones(x[0].shape, bool)
    for here, before, rate, h in zip(z, x, drift(z, free), spacings, strict=True):
        rests &= (jnp.abs(rate) <= STILL * discount * h) & (jnp.abs(here - before) <= h)
    cost = _running_cost(problem, z, [*free, *u[len(free) :]])
    return jnp.stack(z), jnp.where(rests & jnp.isfinite(cost), cost, jnp.inf)


def _shortest(columns: list[list], f: list) -> list:
    """The shortest step with J step = −f, for the columns of J: −Jᵀ (J Jᵀ)⁻¹ f, by elimination."""
    n = len(f)
    rows = [[sum(column[i] * column[j] for column in columns) for j in range(n)] + [f[i]] for i in range(n)]
    ridge = RIDGE * sum(rows[i][i] for i in range(n)) + jnp.finfo(f[0].dtype).tiny
    for i in range(n):
        rows[i][i] = rows[i][i] + ridge
        for k in range(i + 1, n):
            share = rows[k][i] / rows[i][i]
            rows[k] = [entry - share * pivot for entry, pivot in zip(rows[k], rows[i], strict=True)]
    weights: list[Any] = [0.0] * n
    for i in reversed(range(n)):
        known = sum((rows[i][j] * weights[j] for j in range(i + 1, n)), start=0.0)
        weights[i] = (rows[i][n] - known) / rows[i][i]
    return [-sum(weight * entry for weight, entry in zip(weights, column, strict=True)) for column in columns]


def _below_middle(first: np.ndarray, middle: np.ndarray, last: np.ndarray) -> np.ndarray:
    """By how much the parabola through three equally spaced values is lower than its middle; 0 if one is infinite."""
    known = np.isfinite(first) & np.isfinite(middle) & np.isfinite(last)
    first, middle, last = (np.where(known, each, 0) for each in (first, middle, last))
    bend, slope = first - 2 * middle + last, last - first
    inside = (bend > 0) & (np.abs(slope) < 2 * bend)
    return np.where(inside, slope**2 / np.where(inside, 8 * bend, 1), middle - np.minimum(first, last))


def _least_of_cell(about: _Value, places: np.ndarray) -> np.ndarray:
    """The least V_h at the corners of the cell of each state, (k,); −∞ if V is prescribed at one of them."""
    grid, sides = about.grid, []
    for axis, place in enumerate(places):
        nodes = np.asarray(grid.axis(axis))
        if grid.periodic[axis]:
            below = np.floor((place - nodes[0]) / _spacing(grid, axis)).astype(int)
            sides.append((below % nodes.size, (below + 1) % nodes.size))
        else:
            below = np.clip(np.searchsorted(nodes, place, side="right") - 1, 0, nodes.size - 2)
            sides.append((below, below + 1))
    corners = list(itertools.product(*sides))
    free = np.all([about.free[corner] for corner in corners], axis=0)
    return np.where(free, np.min([about.value[corner] for corner in corners], axis=0), -np.inf)


def _states(grid: Grid, nodes: np.ndarray) -> np.ndarray:
    """The states at flat indices, (n, k)."""
    return np.stack([np.asarray(grid.axis(axis))[i] for axis, i in enumerate(np.unravel_index(nodes, grid.shape))])


def along(grid: Grid, axis: int) -> list[int]:
    """The shape of an array that varies along one axis only."""
    return [-1 if i == axis else 1 for i in range(grid.ndim)]


def link_lengths(grid: Grid, axis: int) -> np.ndarray:
    """The distance from each node to the next along an axis; at the end of the box to the one before."""
    if grid.periodic[axis]:
        return np.full(grid.shape[axis], _spacing(grid, axis))
    gaps = np.diff(np.asarray(grid.axis(axis)))
    return np.append(gaps, gaps[-1:])


def _spacing(grid: Grid, axis: int) -> float:
    """The smallest spacing along an axis."""
    if grid.stretch[axis] is None:
        return float(grid.spacing(axis))
    return float(np.min(np.diff(np.asarray(grid.axis(axis)))))
