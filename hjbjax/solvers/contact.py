"""The nodes where a constraint holds with equality: V = ψ, where it is optimal to stop, and V = g.

In a solve the residual is max(min(s, ψ − V), g − V) with s = r/(Q + β). A node belongs to the stopping set if ψ − V is
the branch that counts, and to the set of the running maximum if g − V is. An approximate linear solve may leave V below
ψ by more than rounding where it is optimal to stop, and V at a node without a gain from waiting equals ψ exactly. The
branch decides both cases; the distance from V to ψ alone decides neither. A march imposes ψ and g after every step, so
its V equals them exactly.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.iteration.bellman import Obstacles
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.problem.problem import Problem
from hjbjax.problem.types import Field, Nodes, Number

ROUNDING = 16  # units of eps of |ψ|: a smaller distance from V to ψ is rounding


def contact(problem: Problem, obstacles: Obstacles, value: Nodes, residual: Field | Number = 0) -> dict[str, Any]:
    """The stopping set and the set of the running maximum, as fields of a Solution; bool (*grid) each.

    A tie counts: it is optimal to stop where continuing costs the same. A node with an infinite ψ never stops.

    Args:
      problem: the problem; a set without its constraint is left out.
      obstacles: ψ and g at the nodes.
      value: V at the nodes.
      residual: max(min(s, ψ − V), g − V) at V, cost units; zero if V has both constraints imposed.
    """
    xp: Any = jnp if isinstance(value, jax.Array) else np
    limits = {
        "stopping": None if problem.stopping_cost is None else obstacles.upper,
        "active": None if problem.running_max is None else obstacles.lower,
    }
    eps = ROUNDING * xp.finfo(value.dtype).eps
    found = {}
    for name, limit in limits.items():
        if limit is not None:
            known = xp.isfinite(limit) & xp.isfinite(value)
            apart = xp.where(known, limit, 0) - xp.where(known, value, 0) - residual
            found[name] = known & (abs(apart) <= eps * abs(xp.where(known, limit, 0)))
    return found


@jax.jit
def _of_task(task: Task, state: State) -> dict[str, Any]:
    equation = task.equation(state.value, state.policy, state.fastest)
    found = contact(task.problem, task.obstacles, state.value, equation.source)
    return {name: mask & task.counted for name, mask in found.items()}


def contact_of_solve(task: Task, state: State) -> dict[str, Any]:
    """The sets of ``contact`` for a solve, in NumPy; empty without constraints, and if only V is stored."""
    if not task.constrained or task.bare:
        return {}
    found = jax.device_get(_of_task(task, state))
    return {name: np.array(np.broadcast_to(mask, task.grid.shape)) for name, mask in found.items()}


def has_contact(problem: Problem) -> dict[str, bool]:
    """The sets of ``contact`` that a problem has."""
    return {"stopping": problem.stopping_cost is not None, "active": problem.running_max is not None}
