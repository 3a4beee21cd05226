"""The nodes where a constraint holds with equality: V = ψ, where it is optimal to stop, V = g, and V = c + V(x + o).

In a solve the residual is max(min(s, ψ − V), g − V) with s = r/(Q + β). A node belongs to the stopping set if ψ − V is
the branch that counts, and to the set of the running maximum if g − V is. The distance from V to ψ alone does not
decide: an approximate linear solve may leave V below ψ by more than rounding where it is optimal to stop. A march
imposes ψ and g after every step, so its V equals them exactly.

With noise V is strictly better than ψ at every node from which continuing, at no loss, leads to a node that continues.
A loss r/β below the tolerance is none.
Far from the boundary this gain may be below the tolerance, for example where the payoff of an option is zero, and the
solve leaves V = ψ. These nodes are removed from the stopping set.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.rates import jump_rates
from hjbjax.iteration import bellman
from hjbjax.iteration.bellman import Obstacles
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.types import Field, Nodes, Number

ROUNDING = 16  # units of eps of |ψ|: a smaller distance from V to ψ is rounding


def contact(
    problem: Problem, grid: Grid, obstacles: Obstacles, value: Nodes, residual: Field | Number = 0
) -> dict[str, Any]:
    """The stopping set and the set of the running maximum, bool (*grid), and the push regions, bool (*grid, p).

    The keys are the names of fields of a Solution.

    A tie counts: it is optimal to stop where continuing costs the same. A node with an infinite ψ never stops. A
    node of the target with V = ψ belongs to the set only if a neighbour outside of the target does. Otherwise the
    boundary of the set would follow the boundary of the target.

    Args:
      problem: the problem; a set without its constraint is left out.
      grid: the grid.
      obstacles: ψ, g and the target at the nodes.
      value: V at the nodes.
      residual: max(min(s, ψ − V), g − V) at V, cost units; zero if V has both constraints imposed.
    """
    value = jnp.asarray(value)
    limits = {
        "stopping": None if problem.stopping_cost is None else obstacles.upper,
        "active": None if problem.running_max is None else obstacles.lower,
    }
    eps, found = ROUNDING * jnp.finfo(value.dtype).eps, {}
    for name, limit in limits.items():
        if limit is None:
            continue
        known = jnp.isfinite(limit) & jnp.isfinite(value)
        limit = jnp.where(known, limit, 0)
        touches = known & (jnp.abs(limit - jnp.where(known, value, 0) - residual) <= eps * jnp.abs(limit))
        found[name] = _with_neighbours(touches, grid, obstacles)
    if problem.push_steps:
        pushes = obstacles.interventions
        after = jnp.stack(pushes.after(value)[pushes.changes :], axis=-1)
        gap = after - (value + residual)[..., None]
        found["pushing"] = (gap <= eps * jnp.abs(after)) & jnp.isfinite(after) & ~obstacles.fixed[..., None]
    return found


def _with_neighbours(touches: jax.Array, grid: Grid, obstacles: Obstacles) -> jax.Array:
    """The nodes outside of the target, and those of the target that are next to one of them."""
    free = touches & ~obstacles.ended
    beside = jnp.zeros_like(free)
    for axis in grid.state_axes:
        for step in (-1, 1):
            beside |= stencil.neighbour(free, grid, stencil.unit(grid, axis, step))
    return free | (touches & beside)


def contact_axes(problem: Problem) -> dict[str, tuple[int, ...]]:
    """The sets of ``contact`` that a problem has, with the axes of their masks after those of the nodes."""
    there = {
        "stopping": problem.stopping_cost is not None, "active": problem.running_max is not None,
        "pushing": bool(problem.push_steps),
    }  # fmt: skip
    return {name: (len(problem.push_steps),) * (name == "pushing") for name, has in there.items() if has}


def contact_of_solve(task: Task, state: State) -> dict[str, Any]:
    """The sets of ``contact`` for a solve, in NumPy; empty without constraints, and if only V is stored."""
    axes = contact_axes(task.problem)
    if not axes or task.bare:
        return {}
    found = jax.device_get(_of_task(task, state))
    return {name: np.array(np.broadcast_to(mask, task.grid.shape + axes[name])) for name, mask in found.items()}


@jax.jit
def _of_task(task: Task, state: State) -> dict[str, Any]:
    equation = task.equation(state.value, state.policy, state.fastest)
    found = contact(task.problem, task.grid, task.obstacles, state.value, equation.source)
    counted = task.counted[..., None]
    found = {name: mask & (counted if name == "pushing" else task.counted) for name, mask in found.items()}
    if "stopping" in found and task.problem.noise is not None:
        left = found["stopping"] & ~_gaining(task, state, found["stopping"])
        found["stopping"] = _with_neighbours(left, task.grid, task.obstacles)
    return found


def _gaining(task: Task, state: State, stopping: jax.Array) -> jax.Array:
    """The nodes with V = ψ, up to the tolerance, from which continuing at no loss leads to a node that continues."""
    on, policy, grid = task.on.chain, state.policy, task.grid
    if not task.scheme.monotone:  # high-order slopes overshoot where V is small, so continuing seems to cost something
        policy = bellman.greedy(on, state.value, task.obstacles.fixed)
    rates = jump_rates(on, list(policy.controls), list(policy.disturbances))
    rounding = ROUNDING * jnp.finfo(state.value.dtype).eps * (rates.total() + on.decay) * jnp.abs(state.value)
    free = ~task.obstacles.fixed
    # continuing loses r per unit time, r/β in total
    indifferent = stopping & free & (policy.defect <= jnp.maximum(rounding, on.decay * task.tol))

    def spread(continuing: jax.Array) -> jax.Array:
        for rate, ahead in rates.jumps(grid):
            continuing |= indifferent & (rate > 0) & ahead(continuing)
        return continuing

    def grows(both: tuple[jax.Array, jax.Array]) -> jax.Array:
        return task.layout.some(both[0] != both[1])

    first = free & task.counted & ~stopping
    continuing, _ = jax.lax.while_loop(grows, lambda both: (spread(both[0]), both[0]), (spread(first), first))
    return continuing
