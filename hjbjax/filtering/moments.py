"""Mean, covariance and mode of probabilities at the nodes of a grid.

Along a periodic axis of length L the mean is the circular one,

    lo + L/2π arg Σ p e^{2πi (x − lo)/L},

brought into the box, and differences from it are taken the short way round, in [−L/2, L/2). Where the sum vanishes, as
of a uniform law, there is no direction and the mean is ``lo``.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Field, State


def mean(grid: Grid, probability: Field) -> State:
    """The mean, shape (n,), of probabilities of sum one."""
    return jnp.stack([_mean_along(grid, axis, _marginal(probability, axis)) for axis in range(grid.ndim)])


def covariance(grid: Grid, probability: Field) -> jax.Array:
    """The covariance about the mean, shape (n, n), of probabilities of sum one."""
    center = mean(grid, probability)
    off = [_difference(grid, axis, center[axis], probability.dtype) for axis in range(grid.ndim)]
    entries = {(i, j): jnp.sum(probability * off[i] * off[j]) for i in range(grid.ndim) for j in range(i, grid.ndim)}
    return jnp.stack([jnp.stack([entries[min(i, j), max(i, j)] for j in range(grid.ndim)]) for i in range(grid.ndim)])


def mode(grid: Grid, density: Field) -> State:
    """The node at which a density is largest, shape (n,); the first of equals."""
    index = jnp.unravel_index(jnp.argmax(density), grid.shape)
    return jnp.stack([jnp.asarray(grid.axis(axis, density.dtype), density.dtype)[i] for axis, i in enumerate(index)])


def _marginal(probability: Field, axis: int) -> jax.Array:
    """The probabilities of the nodes along one axis, shape (N,)."""
    return jnp.sum(probability, axis=tuple(i for i in range(probability.ndim) if i != axis))


def _mean_along(grid: Grid, axis: int, probability: jax.Array) -> jax.Array:
    dtype = probability.dtype
    x = jnp.asarray(grid.axis(axis, dtype), dtype)
    if not grid.periodic[axis]:  # type: ignore[index]
        return probability @ x
    lo, hi = jnp.asarray(grid.lo[axis], dtype), jnp.asarray(grid.hi[axis], dtype)
    angle = 2 * np.pi * (x - lo) / (hi - lo)
    turn = jnp.arctan2(probability @ jnp.sin(angle), probability @ jnp.cos(angle)) / (2 * np.pi)
    place = lo + (hi - lo) * jnp.mod(turn, 1)
    return jnp.where(place >= hi, lo, place)  # just below zero, the remainder rounds up to a whole turn


def _difference(grid: Grid, axis: int, center: jax.Array, dtype: np.dtype) -> jax.Array:
    """x − mean along one axis, the short way round a periodic one; broadcasts over the nodes."""
    off = grid.components(dtype)[axis] - center
    if not grid.periodic[axis]:  # type: ignore[index]
        return off
    length = jnp.asarray(grid.hi[axis], dtype) - jnp.asarray(grid.lo[axis], dtype)
    return jnp.mod(off + length / 2, length) - length / 2
