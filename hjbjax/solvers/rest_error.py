"""An estimate of the error at rest points between the nodes.

A discounted path may end where it rests, at the least running cost that it can find, and V is L/β there. On a grid it
rests at a node. If the running cost is lower between two nodes than at both of them, as |x − c| or a square root is,
V_h exceeds V by the difference over β wherever paths lead to this place. A coarser grid often has the same node, and
then the comparison of two grids shows nothing.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.iteration.fixed_point import Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_random
from hjbjax.solution.solution import Solution
from hjbjax.tracing import components

MOST = 64  # candidates, with the least V
PARTS = 8  # parts of an interval between nodes: seven points inside


def error_at_rest(solution: Solution, task: Task) -> float:
    """The largest error of V at a rest point between nodes, in cost units; zero with noise and without a discount."""
    problem, grid, value = task.problem, task.grid, np.asarray(solution.value)
    discount = problem.discount
    if problem.cost is None or callable(discount) or not float(np.asarray(discount)) > 0:
        return 0.0
    if is_random(problem) or problem.growth is not None or grid.modes or solution.policy is None:
        return 0.0
    places = _lowest(value, ~np.asarray(task.obstacles.fixed) & np.isfinite(value), grid)
    if not places.size:
        return 0.0
    wanted = np.resize(places, MOST)  # always the same number, for one program
    actions = [
        np.zeros((*value.shape, 0)) if each is None else each for each in (solution.policy, solution.disturbance)
    ]
    u, d = (list(np.moveaxis(each.reshape(value.size, -1)[wanted], -1, 0)) for each in actions)
    lower, cost = _gain_between_nodes(problem, grid, wanted, (u, d))
    rate = float(np.asarray(discount))
    excess = rate * value.ravel()[wanted] - (cost - lower)
    # further above the running cost paths do not rest
    rests = np.isfinite(lower) & (excess <= 2 * lower)
    return float(np.max(np.minimum(excess, lower), where=rests, initial=0)) / rate


def _lowest(value: np.ndarray, free: np.ndarray, grid: Grid) -> np.ndarray:
    """The flat indices of the ``MOST`` lowest free nodes at which V is at most V at all neighbours along the axes."""
    least = free.copy()  # comparisons of slices: the only new arrays are boolean
    for axis in range(value.ndim):
        nodes, marks = np.moveaxis(value, axis, 0), np.moveaxis(least, axis, 0)
        marks[:-1] &= nodes[:-1] <= nodes[1:]
        marks[1:] &= nodes[1:] <= nodes[:-1]
        if grid.periodic[axis]:
            marks[-1] &= nodes[-1] <= nodes[0]
            marks[0] &= nodes[0] <= nodes[-1]
    found = np.flatnonzero(least)
    return found[np.argsort(value.ravel()[found], kind="stable")[:MOST]]


def _gain_between_nodes(
    problem: Problem, grid: Grid, places: np.ndarray, actions: tuple[list, list]
) -> tuple[np.ndarray, np.ndarray]:
    """By how much the running cost next to nodes is below its value at both ends of an interval, and at the nodes.

    The first is summed over the axes, with the better of the two intervals on each axis; both (k,), cost per time.
    """
    indices = np.unravel_index(places, grid.shape)
    x = np.stack([np.asarray(grid.axis(axis))[index] for axis, index in enumerate(indices)])
    states: list[Any] = [x[:, None]]  # (n, points, k)
    for axis in range(grid.ndim):
        for step in (-1, 1):
            away = _to_neighbour(grid, axis, indices[axis], step)
            for part in range(1, PARTS + 1):
                moved = x.copy()
                moved[axis] += away * part / PARTS
                states.append(moved[:, None])
    points = np.concatenate(states, axis=1)
    u, d = ([np.broadcast_to(entry, points.shape[1:]).ravel() for entry in each] for each in actions)
    cost = np.asarray(_running_cost(problem, list(points.reshape(grid.ndim, -1)), u, d)).reshape(points.shape[1:])
    here, around = cost[0], cost[1:].reshape(grid.ndim, 2, PARTS, -1)
    with np.errstate(invalid="ignore"):  # between nodes the cost may be infinite or undefined
        lower = np.minimum(here, around[:, :, -1]) - np.min(around[:, :, :-1], axis=2)
        return np.sum(np.maximum(np.max(lower, axis=1), 0), axis=0), here


def _to_neighbour(grid: Grid, axis: int, index: np.ndarray, step: int) -> np.ndarray:
    """The signed distances to the neighbours along an axis; zero beyond an end."""
    if grid.periodic[axis]:
        return np.full(index.shape, step * float(grid.spacing(axis)))
    nodes = np.asarray(grid.axis(axis))
    return nodes[np.clip(index + step, 0, len(nodes) - 1)] - nodes[index]


@jax.jit
def _running_cost(problem: Problem, x: list, u: list, d: list) -> jax.Array:
    """The running cost at states with entries (k,), shape (k,)."""
    return jnp.broadcast_to(components.scalar(problem.cost, *problem.arguments(x, u, d), dtype=x[0].dtype), x[0].shape)
