"""Targets on a grid: which nodes lie in one, and boundaries that run between the nodes.

A node lies in the target {l ≤ 0} if a shift of it by the rounding of its coordinates brings it there, so that a node
on the boundary is inside in every program, however that rounds l. Between the nodes the boundary crosses the link
from a free node x to a held node y at the fraction θ = l(x)/(l(x) − l(y)) of the way, exactly so for a signed distance
that is linear there. The link is cut to θh and ends on the boundary, where the exit cost is paid. The chain stays a
chain: it jumps to the boundary at rates for the distance θh.
"""

import dataclasses

import jax
import jax.numpy as jnp

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.stencil import Links, PerNode
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Field
from hjbjax.tracing import components

KEPT = 200_000  # nodes up to which cut links are kept: 34 bytes a node and axis, and half the time of compiling
SHORTEST = 1e-2  # of a spacing: a shorter link would only make the rates large
ROUNDINGS = 16  # units of eps of the largest coordinate: 6 of a stretched axis, and a distance made of a few operations


def level(on: Discretisation) -> Field:
    """l at every node, shape (*grid), with an exact zero where it is zero up to rounding: ≤ 0 in the target.

    What rounding does to l is taken from its slopes, so that neither its units nor values far away matter; from the
    lesser of two, since one may lead across a jump.
    """
    found, grid, slack = on.at_nodes(on.problem.target), on.grid, jnp.zeros((), on.dtype)
    for axis in range(grid.ndim):
        up, down = stencil.one_sided(found, grid, axis)
        # a coordinate is made of lo and hi: off by roundings of the larger of them, however near zero it is itself
        farthest = jnp.maximum(jnp.abs(grid.lo[axis]), jnp.abs(grid.hi[axis]))
        up, down = jnp.abs(up), jnp.abs(down)
        end = stencil.on_edge(grid, axis, 1) | stencil.on_edge(grid, axis, -1)  # where one of them is none
        slope = jnp.where(end, jnp.maximum(up, down), jnp.minimum(up, down))
        # shifts along all axes at once: what they do to l adds up at worst
        slack = slack + ROUNDINGS * jnp.finfo(on.dtype).eps * farthest * slope
    return jnp.where(jnp.abs(found) <= slack, 0, found)


def links(on: Discretisation) -> list[Links]:
    """The links along every axis, cut at the target's boundary where the scheme wants that."""
    problem, grid = on.problem, on.grid
    plain = [stencil.links(grid, axis) for axis in range(grid.ndim)]
    if not on.scheme.subcell or problem.target is None:
        return plain
    if on.cut is not None:
        return list(on.cut)
    x, here = on.coordinates(), level(on)

    def cut(axis: int, step: int, length: PerNode) -> tuple[Field, tuple[Field, Field]]:
        """The length of every link in one direction, and where it meets the target with the exit cost there."""
        beyond = stencil.neighbour(here, grid, stencil.unit(grid, axis, step))
        # a copy beyond an edge has the sign of its node, so that no wall is taken for a target
        meets = (here > 0) & (beyond <= 0)
        # the inner where keeps the quotient finite on links that do not meet it, for derivatives
        theta = jnp.where(meets, jnp.maximum(here / jnp.where(meets, here - beyond, 1), SHORTEST), 1)
        # the exit cost is a function of the state: its argument is the crossing, not either node
        crossing = _across_seam(x[axis] + step * theta * length, grid, axis)
        boundary = [crossing if i == axis else entry for i, entry in enumerate(x)]
        paid = components.of_state(problem, problem.exit_cost, boundary, on.t, on.dtype)
        return theta * length, (meets, jnp.broadcast_to(paid, grid.shape))

    result = []
    for axis, link in enumerate(plain):
        (up, meets_up), (down, meets_down) = cut(axis, 1, link.up), cut(axis, -1, link.down)
        # beyond a wall stands the mirror image of a link that is cut
        mirrored = jnp.where(stencil.wall(grid, axis, 1), down, up), jnp.where(stencil.wall(grid, axis, -1), up, down)
        result.append(Links(*mirrored, meets_up, meets_down))
    return result


def keeps(on: Discretisation) -> bool:
    """Whether the cut links are kept at hand: where there are such, and they take little room."""
    return on.scheme.subcell and on.problem.target is not None and on.grid.size <= KEPT


def kept(on: Discretisation) -> Discretisation:
    """The discretisation with its cut links at hand, on grids where they take little room."""
    return dataclasses.replace(on, cut=tuple(links(on))) if keeps(on) else on


def _across_seam(coordinate: jax.Array, grid: Grid, axis: int) -> jax.Array:
    """A coordinate at most one spacing beyond the seam of a periodic axis, back in [lo, hi)."""
    if not grid.periodic[axis]:
        return coordinate
    lo, hi = grid.lo[axis], grid.hi[axis]
    # by comparison and not by %, which would round every coordinate anew
    inside = jnp.where(coordinate >= hi, coordinate - (hi - lo), coordinate)
    return jnp.where(inside < lo, inside + (hi - lo), inside)
