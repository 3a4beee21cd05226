"""Functions of the states of a grid, by components and by ``vmap``."""

import jax
import jax.numpy as jnp

from hjbjax.tracing import components


@jax.custom_jvp
def steep(x):
    return jnp.sin(x)


@steep.defjvp
def _(primals, tangents):  # twice the true slope, so that a test sees whose derivative is used
    return steep(primals[0]), 2 * jnp.cos(primals[0]) * tangents[0]


def by_components(function, grid, dtype):
    """The values of a function at all nodes, (*grid, *shape of the result)."""
    entries = components.components(function, grid.components(dtype), dtype=dtype)
    full = [jnp.broadcast_to(jnp.asarray(entry), grid.shape) for entry in entries.flat]
    return jnp.stack(full, axis=-1).reshape(*grid.shape, *entries.shape)


def by_vmap(function, grid, dtype):
    """The same by ``vmap`` over the table of all states."""
    table = jnp.asarray(grid.nodes(), dtype).reshape(-1, grid.ndim)
    result = jax.vmap(function)(table)
    return result.reshape(*grid.shape, *result.shape[1:])
