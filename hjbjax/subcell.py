"""Targets whose boundary runs between the nodes.

With a target {l ≤ 0} the boundary crosses the link from a free node x to a held node y at the fraction
θ = l(x)/(l(x) − l(y)) of the way, exactly so for a signed distance that is linear there. The link is cut to θh and
ends on the boundary, where the exit cost is the linear interpolation of those at x and y. The chain stays a chain:
it jumps to the boundary at rates for the distance θh.
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
    arguments = problem.state_arguments(x, t)
    level = jnp.broadcast_to(fields.scalar(problem.target, *arguments, dtype=dtype), grid.shape)
    exit_cost: Any = 0.0 if problem.exit_cost is None else problem.exit_cost
    if callable(exit_cost):
        exit_cost = fields.scalar(exit_cost, *arguments, dtype=dtype)
    exit_cost = jnp.broadcast_to(jnp.asarray(exit_cost, dtype), grid.shape)
    return [_cut(link, level, exit_cost, grid, axis) for axis, link in enumerate(plain)]


def _cut(link: Links, level: Any, exit_cost: Any, grid: Grid, axis: int) -> Links:
    theta_up, meets_up = _crossing(level, exit_cost, grid, stencil.unit(grid, axis, 1))
    theta_down, meets_down = _crossing(level, exit_cost, grid, stencil.unit(grid, axis, -1))
    return Links(theta_up * link.up, theta_down * link.down, meets_up, meets_down)


def _crossing(level: Any, exit_cost: Any, grid: Grid, offset: tuple[int, ...]) -> tuple[Any, tuple[Any, Any]]:
    """θ on every link in one direction, 1 where it does not cross, and where it crosses with the value there."""
    beyond, beyond_cost = (stencil.neighbour(values, grid, offset) for values in (level, exit_cost))
    crosses = (level > 0) & (beyond <= 0)
    theta = jnp.where(crosses, level / jnp.where(crosses, level - beyond, 1), 1)
    here = jnp.where(jnp.isfinite(exit_cost), exit_cost, beyond_cost)  # an exit cost may exist on the target alone
    return jnp.maximum(theta, SHORTEST), (crosses, here + theta * (beyond_cost - here))
