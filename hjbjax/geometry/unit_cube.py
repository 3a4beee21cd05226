"""A region of states and an interval of times as a unit cube, whose points a search can climb over."""

import jax
import jax.numpy as jnp

from hjbjax.problem.sets import Ball, Box
from hjbjax.problem.types import Array, State


def half_widths(region: Box | Ball) -> jax.Array:
    """Half the width of the region in every state: what distances are measured in."""
    if isinstance(region, Ball):
        return jnp.broadcast_to(jnp.asarray(region.radius), region.dim)
    width = jnp.asarray(region.hi - region.lo) / 2
    return jnp.where(width > 0, width, 1)


def state_of(region: Box | Ball, times: Array | None, z: Array) -> tuple[jax.Array | None, jax.Array]:
    """The time, or None, and the state that a point of the unit cube stands for."""
    t = None if times is None else time_of(times, z)
    z = z if times is None else z[:-1]
    if isinstance(region, Box):
        return t, region.lo + z * (region.hi - region.lo)
    # the cube around the ball; points outside go to the sphere along their ray, so that its edge is searched as well
    x = region.radius * (2 * z - 1)
    square = jnp.sum(x * x)
    outside = square > region.radius**2
    # the root of 1 inside: at the centre the slope of √0 is infinite, and NaN through a ``where`` that discards it
    return t, jnp.where(outside, x * region.radius / jnp.sqrt(jnp.where(outside, square, 1)), x)


def time_of(times: Array, z: Array) -> jax.Array:
    """The time that a point of the unit cube stands for: its last coordinate."""
    return times[0] + z[-1] * (times[1] - times[0])


def nearest_inside(region: Box | Ball, x: State) -> jax.Array:
    """The state, or the nearest one of the region."""
    if isinstance(region, Box):
        return jnp.clip(x, region.lo, region.hi)
    length = jnp.sqrt(jnp.sum(x * x))
    return jnp.where(length > region.radius, x * region.radius / jnp.where(length > 0, length, 1), x)
