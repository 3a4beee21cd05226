"""Targets whose boundary runs between the nodes.

With a target {l ≤ 0} the boundary crosses the link from a free node x to a held node y at the fraction
θ = l(x)/(l(x) − l(y)) of the way, exactly so for a signed distance that is linear there. The link is cut to θh and
ends on the boundary, where the exit cost is paid. The chain stays a chain: it jumps to the boundary at rates for the
distance θh.
"""

from typing import Any

import jax.numpy as jnp

from hjbjax import fields, stencil
from hjbjax.grid import Grid
from hjbjax.problem import Problem
from hjbjax.stencil import Links

SHORTEST = 1e-2  # of a spacing: a shorter link would only make the rates large


def links(problem: Problem, grid: Grid, *, subcell: bool, dtype: Any, t: Any = 0.0) -> list[Links]:
    """The links along every axis, cut at the target's boundary where the scheme wants that."""
    plain = [stencil.links(grid, axis) for axis in range(grid.ndim)]
    if not subcell or problem.target is None:
        return plain
    x = grid.components(dtype)

    def at(ingredient: Any, x: list) -> Any:
        return jnp.broadcast_to(fields.of_state(problem, ingredient, x, t, dtype), grid.shape)

    level = at(problem.target, x)

    def cut(axis: int, step: int, length: Any) -> tuple[Any, tuple[Any, Any]]:
        """The length of every link in one direction, and where it meets the target with the exit cost there."""
        beyond = stencil.neighbour(level, grid, stencil.unit(grid, axis, step))
        meets = (level > 0) & (beyond <= 0)
        theta = jnp.where(meets, jnp.maximum(level / jnp.where(meets, level - beyond, 1), SHORTEST), 1)
        boundary = [entry + step * theta * length if i == axis else entry for i, entry in enumerate(x)]
        return theta * length, (meets, at(problem.exit_cost, boundary))

    result = []
    for axis, link in enumerate(plain):
        (up, meets_up), (down, meets_down) = cut(axis, 1, link.up), cut(axis, -1, link.down)
        result.append(Links(up, down, meets_up, meets_down))
    return result
