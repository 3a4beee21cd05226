"""Targets on a grid: the nodes inside, and boundaries between the nodes.

A node belongs to the target {l ≤ 0} if shifting it by the rounding error of its coordinates moves it there. A node on
the boundary is therefore inside in every program, however l is rounded. Between nodes, the boundary crosses the link
from a free node x to a fixed node y at the fraction θ = l(x)/(l(x) − l(y)), exactly so for a signed distance that is
linear there. The link is cut to θh and ends on the boundary, where the exit cost is paid. The scheme remains a chain,
which jumps to the boundary at rates for the distance θh.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.discretisation import stencil
from hjbjax.discretisation.stencil import Links, PerNode
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Field

SHORTEST = 1e-2  # in units of the spacing: a shorter link would only make the rates large
ROUNDINGS = 16  # units of eps of the largest coordinate: 6 for a stretched axis, and a few operations for l


def level(values: Field, grid: Grid) -> Field:
    """The values of l with an exact zero where l is zero up to rounding, (*grid).

    The rounding error of l is estimated from its slopes, so neither units nor distant values matter. The smaller of the
    two one-sided slopes is used, since the other may cross a jump.
    """
    eps, slack = jnp.finfo(values.dtype).eps, jnp.zeros((), values.dtype)
    for axis in grid.state_axes:
        up, down = stencil.one_sided(values, grid, axis)
        # coordinates are computed from lo and hi, so their error is relative to the larger, even near zero
        farthest = jnp.maximum(jnp.abs(grid.lo[axis]), jnp.abs(grid.hi[axis]))
        up, down = jnp.abs(up), jnp.abs(down)
        end = stencil.on_edge(grid, axis, 1) | stencil.on_edge(grid, axis, -1)  # one slope is missing there
        slope = jnp.where(end, jnp.maximum(up, down), jnp.minimum(up, down))
        # all coordinates are off at once: in the worst case their effects add up
        slack = slack + ROUNDINGS * eps * farthest * slope
    return jnp.where(jnp.abs(values) <= slack, 0, values)


def links(x: Sequence[Any], here: Field, exit_cost: Callable[[list], Any], grid: Grid) -> tuple[Links, ...]:
    """The links along every axis, cut at the boundary of the target.

    Args:
      x: the coordinates of the nodes.
      here: l at the nodes, see ``level``.
      exit_cost: maps the coordinates of states to the exit cost there.
      grid: the grid.
    """

    def cut(axis: int, step: int, length: PerNode) -> tuple[Field, tuple[Field, Field]]:
        """The length of every link in one direction, and where it meets the target with the exit cost there."""
        beyond = stencil.neighbour(here, grid, stencil.unit(grid, axis, step))
        # the copy beyond an edge has the sign of its node, so a wall is not mistaken for a target
        meets = (here > 0) & (beyond <= 0)
        # the inner where keeps the quotient finite on links that do not meet the target, for derivatives
        theta = jnp.where(meets, jnp.maximum(here / jnp.where(meets, here - beyond, 1), SHORTEST), 1)
        # the exit cost is evaluated at the crossing, not at a node
        crossing = _across_seam(x[axis] + step * theta * length, grid, axis)
        paid = exit_cost([crossing if i == axis else entry for i, entry in enumerate(x)])
        return theta * length, (meets, jnp.broadcast_to(paid, grid.shape))

    result = []
    for axis in range(grid.ndim):
        link = stencil.grid_links(grid, axis)
        if axis not in grid.state_axes:
            result.append(link)
            continue
        (up, meets_up), (down, meets_down) = cut(axis, 1, link.up), cut(axis, -1, link.down)
        # beyond a wall is the mirror image of the cut link
        mirrored = jnp.where(stencil.wall(grid, axis, 1), down, up), jnp.where(stencil.wall(grid, axis, -1), up, down)
        result.append(Links(*mirrored, meets_up, meets_down))
    return tuple(result)


def _across_seam(coordinate: jax.Array, grid: Grid, axis: int) -> jax.Array:
    """Wrap a coordinate at most one spacing beyond the seam of a periodic axis back into [lo, hi)."""
    if not grid.periodic[axis]:
        return coordinate
    lo, hi = grid.lo[axis], grid.hi[axis]
    # a comparison instead of %, which would round every coordinate
    inside = jnp.where(coordinate >= hi, coordinate - (hi - lo), coordinate)
    return jnp.where(inside < lo, inside + (hi - lo), inside)
