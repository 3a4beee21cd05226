"""A map from the unit cube to a region of states and an interval of times, for searches over the region."""

import jax
import jax.numpy as jnp

from hjbjax.problem.sets import Ball, Box
from hjbjax.problem.types import Array, State


def half_widths(region: Box | Ball) -> jax.Array:
    """Half the width of the region in every state, the unit of distances."""
    if isinstance(region, Ball):
        return jnp.broadcast_to(jnp.asarray(region.radius), region.dim)
    width = jnp.asarray(region.hi - region.lo) / 2
    return jnp.where(width > 0, width, 1)


def state_of(region: Box | Ball, times: Array | None, z: Array) -> tuple[jax.Array | None, jax.Array]:
    """The time (or None) and the state at a point of the unit cube."""
    t = None if times is None else time_of(times, z)
    z = z if times is None else z[:-1]
    if isinstance(region, Box):
        return t, region.lo + z * (region.hi - region.lo)
    # points outside the ball move to the sphere along their ray, so that the sphere is searched as well
    x = region.radius * (2 * z - 1)
    square = jnp.sum(x * x)
    outside = square > region.radius**2
    # inside, take the root of 1: at the centre √0 has an infinite slope, which gives NaN even in a branch not taken
    return t, jnp.where(outside, x * region.radius / jnp.sqrt(jnp.where(outside, square, 1)), x)


def time_of(times: Array, z: Array) -> jax.Array:
    """The time at a point of the unit cube, given by its last coordinate."""
    return times[0] + z[-1] * (times[1] - times[0])


def nearest_inside(region: Box | Ball, x: State) -> jax.Array:
    """The point of the region closest to the state."""
    if isinstance(region, Box):
        return jnp.clip(x, region.lo, region.hi)
    length = jnp.sqrt(jnp.sum(x * x))
    return jnp.where(length > region.radius, x * region.radius / jnp.where(length > 0, length, 1), x)
