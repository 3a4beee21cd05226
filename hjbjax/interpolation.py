"""Values between the nodes: multilinear, with gaps, or of the nearest node.

With the cell's corners c and fractions s_i of the way along each axis, w_c = Π_i (s_i or 1 − s_i) and
V(x) = Σ_c w_c V_c: second order, exact for multilinear V, and never beyond the range of the corners.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.grid import Grid
from hjbjax.pytree import is_traced


def query(look: Callable, grid: Grid, values: Any, x: Any, *, clamp: bool, name: str) -> Any:
    """``look`` at node values between the nodes: float64 NumPy from concrete data, else as the tracer is.

    Args:
      look: ``between``, ``between_defined`` or ``nearest``.
      grid: the nodes.
      values: shape (*grid, ...).
      x: states, shape (..., n).
      clamp: outside the grid take the nearest point of its box; otherwise the answer there is NaN.
      name: who asks, for refusals.

    Returns:
      Shape ``x.shape[:-1] + values.shape[n:]``.

    Raises:
      TypeError: states that are not real numbers.
      ValueError: states of another length.
    """
    traced = [leaf for leaf in jax.tree.leaves((values, x)) if isinstance(leaf, jax.core.Tracer)]
    if not traced and not is_traced(grid):
        # Inside somebody's jit a constant must come out, and float64 must not be switched on in the middle of it.
        with jax.ensure_compile_time_eval(), jax.enable_x64(True):
            return np.array(look(grid, values, _states(grid, x, np.float64, name), clamp))[()]
    dtype = jnp.result_type(*traced) if traced else jnp.result_type(float)
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    return look(grid, values, _states(grid, x, dtype, name), clamp).astype(dtype)


def _states(grid: Grid, x: Any, dtype: Any, name: str) -> Any:
    """The states in ``dtype``; an infinite entry on a periodic axis is no place and becomes NaN."""
    try:
        x = jnp.asarray(x) if is_traced(x) else np.asarray(x)
    except (TypeError, ValueError):
        x = np.asarray(None)
    if not jnp.issubdtype(x.dtype, jnp.floating) and not jnp.issubdtype(x.dtype, jnp.integer):
        raise TypeError(f"{name}: got states of type {x.dtype}, wanted real numbers, shape (..., {grid.ndim})")
    if x.ndim == 0 or x.shape[-1] != grid.ndim:
        raise ValueError(f"{name}: got states of shape {x.shape}, wanted (..., {grid.ndim}): one entry an axis")
    x = jnp.asarray(x, dtype)
    return jnp.where(np.array(grid.periodic) & jnp.isinf(x), jnp.nan, x)


@functools.partial(jax.jit, static_argnames="clamp")
def between(grid: Grid, values: Any, x: Any, clamp: bool) -> jax.Array:
    """The multilinear interpolant, with NaN and infinity wherever a node that counts has them."""
    return grid.interpolate(values, x, clamp=clamp)


@functools.partial(jax.jit, static_argnames="clamp")
def between_defined(grid: Grid, values: Any, x: Any, clamp: bool) -> jax.Array:
    """The mean over those nodes of the cell where no entry is NaN."""
    total: Any = 0.0
    sum_of_weights: Any = 0.0
    for weight, defined, there in _corners(grid, values, x, clamp):
        weight = jnp.where(defined, weight, 0)[..., None]
        total, sum_of_weights = total + weight * jnp.where(defined[..., None], there, 0), sum_of_weights + weight
    some = sum_of_weights > 0
    return jnp.where(some, total / jnp.where(some, sum_of_weights, 1), jnp.nan)


@functools.partial(jax.jit, static_argnames="clamp")
def nearest(grid: Grid, values: Any, x: Any, clamp: bool) -> jax.Array:
    """The values at the nearest node of the cell where no entry is NaN; of equally near ones the lower."""
    answer: Any = jnp.nan
    largest: Any = 0.0
    for weight, defined, there in _corners(grid, values, x, clamp):
        # A node is nearer in every axis exactly if its weight is larger; half way, rounding must not choose.
        nearer = defined & (weight > largest * (1 + 8 * jnp.finfo(x.dtype).eps))
        answer, largest = jnp.where(nearer[..., None], there, answer), jnp.where(nearer, weight, largest)
    return answer


def _corners(grid: Grid, values: Any, x: Any, clamp: bool) -> Iterator[tuple[Any, Any, Any]]:
    """The 2^n nodes around each state: weight, whether the values there are defined and count, and the values.

    The cell, the weights and what is outside are those of ``Grid.interpolate``. Gathering before looking for NaN
    keeps a query as cheap as a few nodes, however many the grid has.
    """
    values, x = jnp.asarray(values), grid.wrap(x)
    cells, fractions, inside = zip(*(grid._locate(axis, x[..., axis]) for axis in range(grid.ndim)), strict=True)
    hidden = jnp.any(jnp.isnan(x), axis=-1) | ((not clamp) & ~jnp.all(jnp.stack(inside), axis=0))
    for corner in np.ndindex(*(2,) * grid.ndim):
        weight = jnp.ones((), x.dtype)
        for fraction, bit in zip(fractions, corner, strict=True):
            weight = weight * (fraction if bit else 1 - fraction)
        there = values[tuple((cell + bit) % n for cell, bit, n in zip(cells, corner, grid.shape, strict=True))]
        # On a node its neighbours have no weight, so where it has no control, they have no say.
        yield weight, (weight > 0) & ~hidden & ~jnp.any(jnp.isnan(there), axis=-1), there
