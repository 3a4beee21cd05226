"""An estimate of the error caused by the ends of the box.

V is unknown beyond the box, so every end makes an assumption. At a projected end outward drift is cut off and noise is
reflected; at an open end V is extrapolated by a parabola. The estimate replaces the assumption by another one, in which
V is extrapolated by a straight line (by a parabola, if it was a line), and measures the change of V.

Let F be the equation on a coarse grid with the caller's ends, and G the same equation with the other ends. V is the
solution, restricted to the coarse grid, and W solves

    G(W) = F(V),        box_error = |W − V|.

Because the defect F(V) of the restricted solution is on the right, W = V wherever the ends do not matter, whatever the
error of the coarse grid. Newton's method (policy iteration) starts at V, where G(V) − F(V) is zero except at the end
nodes. Its linear equations are factored on the host: with the other ends the matrix does not belong to a Markov chain,
and relaxations need not converge. Because policies improve in every step, the estimate also includes actions that pay
only with the other ends, such as leaving where the control stands still at a wall.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import edges
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import bellman
from hjbjax.iteration.bellman import Obstacles
from hjbjax.iteration.fixed_point import Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered
from hjbjax.problem.types import Field, Nodes
from hjbjax.solution.clock import Clock
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import warn
from hjbjax.solvers import factored_level, nested_grids
from hjbjax.solvers.factored_level import Rows
from hjbjax.solvers.result import least_and_most, warn_of_cuts
from hjbjax.solvers.settle import Settled

MARCHED = 20_000  # largest coarse grid of marches for the box error only
STEPS = 30  # largest number of Newton steps; most problems take two or three
SETTLED = 0.05  # the iteration ends with a step below this fraction of the change so far
SHRINKS = 0.5  # the last factors are used again as long as a step is at most this fraction of the one before
FARTHEST = 100  # in units of the range of V: a larger change means that the other equation has no solution near V
ROUNDING = 1e-9  # changes at the end nodes below this fraction of the range of V are rounding
LARGE = 0.1  # fraction of the range of V: a larger box error is worth a warning ...
NODES = 0.05  # ... at more than this fraction of the nodes

CANNOT_MATTER = "no end of the box assumes anything"
NEVER_REACHED = "no optimal path reaches an end of the box"
UNMOVED = "the ends cut off drift, but V continued beyond them by straight lines is a solution too"
FLAT = "not estimated: V is constant, which no other assumption at the ends changes"
TOO_MANY = "not estimated: no coarse grid of this problem is small enough"
UNSETTLED = "not estimated: the equation with linear ends has no solution near this one"


class BoxError(NamedTuple):
    """The estimate, or the reason why there is none, and the ends that cause it, as pairs of axis and step."""

    error: np.ndarray | None
    reason: str = ""
    sides: tuple[tuple[int, int], ...] = ()


def with_box_error(solution: Solution, settled: Settled, clock: Clock) -> Solution:
    """The solution with an estimate of the box error; warns if it is large.

    Args:
      solution: a converged solution at host level.
      settled: the end of its iteration.
      clock: the limits; there is no estimate once they are exceeded.
    """
    if clock.over() is not None:
        return solution
    clock.phase = "the estimate of the box error"
    return reported(solution, of_solve(settled.task, np.asarray(solution.value)))


def reported(solution: Solution, found: BoxError) -> Solution:
    """The solution with the estimate or the reason why there is none, and the corresponding warning."""
    grid = solution.grid
    if found.error is not None:
        warn_of_box(found, np.asarray(solution.value), grid)
        return dataclasses.replace(solution, box_error=found.error)
    cut = np.zeros(0) if solution.cut is None else np.max(np.reshape(solution.cut, (-1, grid.ndim, 2)), axis=0)
    solution.stats["box_error"] = UNMOVED if found.reason == NEVER_REACHED and np.any(cut) else found.reason
    if found.reason in (TOO_MANY, UNSETTLED, FLAT) and np.any(cut):
        warn_of_cuts(cut, np.array([[grid.size // count] * 2 for count in grid.shape]), grid)
    return solution


def of_solve(task: Task, value: Nodes) -> BoxError:
    """The estimate for one stationary solution, (*grid).

    Args:
      task: the task of the solution, for any scheme.
      value: its value, (*grid); infinite where the target cannot be reached.
    """
    if other_ends(task.problem, task.grid) == task.grid.edges:
        return BoxError(None, CANNOT_MATTER)
    level = factored_level.small_enough(task)
    if level is None:
        return BoxError(None, TOO_MANY)
    finite = np.where(np.isfinite(value), value, np.max(value[np.isfinite(value)], initial=0))
    before = nested_grids.restrict(finite, task.grid, level.grid)
    return _compare(level, before, task.grid)


def coarse_for_marches(grid: Grid) -> Grid | None:
    """The coarse grid for two marches of which only the difference matters; None if none is small enough."""
    wanted = int(np.clip(grid.size // factored_level.SHARE, factored_level.FEWEST, MARCHED))
    coarse = grid
    while coarse.size > wanted and (smaller := nested_grids.coarser(coarse, factored_level.INTERVALS)) is not None:
        coarse = smaller
    return coarse if coarse.size <= max(wanted, MARCHED) else None


def of_two_marches(first: np.ndarray, second: np.ndarray, coarse: Grid, value: Nodes, fine: Grid) -> BoxError:
    """The estimate for a march: the difference between two marches on a coarse grid, (k, *fine).

    Args:
      first: V at k times by a march with the caller's ends, (k, *coarse).
      second: the same with the other ends.
      coarse: their grid.
      value: V at the kept times, (k, *fine), whose range is the scale.
      fine: the grid of the estimate.
    """
    change, scale = np.abs(second - first), np.ptp(value)
    if _is_flat(np.asarray(value)):
        return BoxError(None, FLAT)
    if np.max(change) <= ROUNDING * scale:
        return BoxError(None, NEVER_REACHED)
    error = np.empty((len(change), *fine.shape), change.dtype)
    for each, wide in zip(change, error, strict=True):  # one after the other: no second array with all times
        nested_grids.prolong_into(wide, each, coarse, fine)
    return BoxError(error, sides=_sides(coarse, np.max(change, axis=0) > LARGE * scale))


def other_ends(problem: Problem, grid: Grid) -> tuple:
    """The kinds of ends to compare with; ends without an assumption stay.

    A constrained end is part of the problem, but the reflection of noise there is an assumption.
    """
    others = {"projected": "linear", "linear": "open", "open": "linear"}
    if problem.noise is not None:
        others["constrained"] = "linear"
    return tuple(pair and tuple(others.get(kind, kind) for kind in pair) for pair in grid.edges)


def _other_free_ends(level: Task) -> tuple:
    """``other_ends``; with jumps, without ends at which every value is fixed, because a jump beyond them ends there."""
    if level.problem.landings is None:
        return other_ends(level.problem, level.grid)
    # without a policy the obstacles may be one number for all nodes
    found, fixed = list(other_ends(level.problem, level.grid)), np.broadcast_to(level.obstacles.fixed, level.grid.shape)
    for axis, (pair, own) in enumerate(zip(found, level.grid.edges, strict=True)):
        if pair:
            ends = (bool(np.all(np.take(fixed, node, axis))) for node in (0, -1))
            found[axis] = tuple(b if held else a for a, b, held in zip(pair, own, ends, strict=True))
    return tuple(found)


def _compare(level: Task, before: np.ndarray, fine: Grid) -> BoxError:
    """|W − V| on the grid ``fine``, from V on a coarse one."""
    grid = altered(level.grid, edges=_other_free_ends(level))
    others = level.on.on_grid(grid)
    restricted, policy = factored_level.policy_at(level, jnp.asarray(before, level.tol.dtype))
    start, defect = jax.device_get((restricted, policy.defect))
    obstacles = _fixed_next_to_lost(level)
    value, scale = start, np.ptp(counted := start[np.asarray(level.counted)])
    if _is_flat(counted):
        return BoxError(None, FLAT)
    change, moved, solve, largest = np.zeros_like(start), np.zeros(grid.shape, bool), None, np.inf
    for step in range(STEPS):
        rows = _equation(others, value, obstacles, defect)
        source = np.asarray(rows.source)
        if step == 0:
            moved = np.abs(source) > ROUNDING * scale
            if not np.any(moved):
                return BoxError(None, NEVER_REACHED)
        # where policies hardly change the last factors are good enough
        delta = None if solve is None else solve(source)
        if delta is None or not np.max(np.abs(delta)) <= SHRINKS * largest:
            solve = rows.factored(grid)
            delta = solve(source)
        value, largest = value + delta, np.max(np.abs(delta))
        change = np.abs(value - start)
        if not np.isfinite(largest) or np.max(change) > FARTHEST * scale:
            break
        if largest <= SETTLED * np.max(change):
            responsible = moved & (change > LARGE * scale)
            return BoxError(nested_grids.prolong(change, grid, fine), sides=_sides(grid, responsible))
    return BoxError(None, UNSETTLED)


@jax.jit
def _equation(on: Discretisation, value: Field, obstacles: Obstacles, defect: Field) -> Rows:
    """Newton's equation for G(W) = F(V), F(V) being the ``defect``."""
    policy = bellman.greedy(on, value, obstacles.fixed)
    policy = dataclasses.replace(policy, defect=policy.defect - jnp.where(obstacles.fixed, 0, defect))
    return factored_level.rows_of(bellman.policy_equation(on, value, policy, obstacles), on.grid)


def _is_flat(value: np.ndarray) -> bool:
    """True if V varies by rounding only."""
    return bool(np.ptp(value) <= max(ROUNDING, 8 * np.finfo(value.dtype).eps) * np.max(np.abs(value)))


def _fixed_next_to_lost(task: Task) -> Obstacles:
    """The obstacles, with the neighbours of unreachable nodes fixed too.

    Unreachable nodes store a number far above all others; extrapolated beyond an end next to them it would be far
    below.
    """
    if task.lost is None:
        return task.obstacles
    near = functools.reduce(
        np.logical_or, (np.asarray(side) for pair in edges.beside(task.lost, task.grid) for side in pair)
    )
    return dataclasses.replace(task.obstacles, fixed=task.obstacles.fixed | near)


def _sides(grid: Grid, nodes: np.ndarray) -> tuple[tuple[int, int], ...]:
    """The ends of the box with one of these nodes, bool (*grid)."""
    ends = ((axis, step) for axis, pair in enumerate(grid.edges) if pair for step in (-1, 1))
    return tuple((axis, step) for axis, step in ends if np.any(np.take(nodes, -1 if step > 0 else 0, axis=axis)))


def warn_of_box(found: BoxError, value: np.ndarray, grid: Grid) -> None:
    """Warn of ends whose assumption moves V by more than a tenth of its range at many nodes."""
    finite = np.isfinite(value)
    least, most = least_and_most(value, finite)
    large = np.asarray(found.error) > LARGE * (most - least)
    share = float(np.mean(large, where=finite))
    if share <= NODES or not found.sides:
        return
    words = {-1: "lower", 1: "upper"}
    ends = " and ".join(f"the {words[step]} end of {grid.names[axis]}" for axis, step in found.sides)
    kinds = {grid.edges[axis][(step + 1) // 2] for axis, step in found.sides}
    warn(
        f"the box decides V: with another assumption at {ends} V changes by more than a tenth of its range at "
        f"{share:.0%} of the nodes (Solution.box_error). {_remedy(kinds)}"
    )


def _remedy(kinds: set[str]) -> str:
    """The remedy for ends of these kinds."""
    if kinds & {"open", "linear"}:
        return (
            "Use a larger box, or a coordinate in which V grows like a parabola at most, or prescribe V at these ends "
            "by a target."
        )
    return (
        "Use a larger box. If the state may not leave it, use Grid(..., edges='constrained'); if the problem goes on "
        "beyond, edges='open' or 'linear'."
    )
