"""Neighbours and one-sided differences on a grid, with ghost cells.

Beyond an edge that is not periodic stands a copy of the edge node: a one-sided difference across the edge is
zero, which projects outward drift back onto the box and reflects noise.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.grid import Grid


def on_edge(grid: Grid, axis: int, step: int) -> np.ndarray:
    """Which nodes have no neighbour in direction ``step`` along ``axis``; broadcasts against the node axes."""
    mask = np.zeros(grid.shape[axis], dtype=bool)
    if not grid.periodic[axis]:  # type: ignore[index]
        mask[-1 if step > 0 else 0] = True
    return mask.reshape([-1 if i == axis else 1 for i in range(grid.ndim)])


def neighbour(values: jax.Array, grid: Grid, offset: tuple[int, ...], *, ghost: bool = True) -> jax.Array:
    """The values at x + offset for every node x, shape (*grid).

    Args:
      values: node values, shape (*grid).
      grid: the grid they live on.
      offset: steps along the axes, each −1, 0 or 1.
      ghost: beyond an edge take the edge node's own value; otherwise zero.
    """
    for axis, step in enumerate(offset):
        if step == 0:
            continue
        padding = [(0, 0, 0)] * grid.ndim
        padding[axis] = (-step, step, 0)
        moved = jax.lax.pad(values, jnp.zeros((), values.dtype), padding)
        if grid.periodic[axis]:  # type: ignore[index]
            count = grid.shape[axis]
            seam = (
                jax.lax.slice_in_dim(values, 0, 1, axis=axis)
                if step > 0
                else (jax.lax.slice_in_dim(values, count - 1, count, axis=axis))
            )
            last = np.arange(count) == (count - 1 if step > 0 else 0)
            values = jnp.where(last.reshape([-1 if i == axis else 1 for i in range(grid.ndim)]), seam, moved)
        else:
            values = jnp.where(on_edge(grid, axis, step), values, moved) if ghost else moved
    return values


def unit(grid: Grid, axis: int, step: int) -> tuple[int, ...]:
    """The offset of one step along one axis."""
    return tuple(step if i == axis else 0 for i in range(grid.ndim))


def steps(grid: Grid, axis: int) -> tuple[Any, Any]:
    """The distances to the upper and to the lower neighbour along ``axis``; broadcast against the node axes."""
    h = grid.spacing(axis)
    return h, h


def one_sided(values: jax.Array, grid: Grid, axis: int) -> tuple[jax.Array, jax.Array]:
    """The differences D⁺ = (V(x+h) − V(x))/h and D⁻ = (V(x) − V(x−h))/h along one axis; zero across an edge."""
    h_up, h_down = steps(grid, axis)
    up = neighbour(values, grid, unit(grid, axis, 1))
    down = neighbour(values, grid, unit(grid, axis, -1))
    return (up - values) / h_up, (values - down) / h_down


def limited(up: jax.Array, down: jax.Array, grid: Grid, axis: int) -> tuple[jax.Array, jax.Array]:
    """Second-order one-sided slopes from the differences D⁺, D⁻ along one axis; zero across an edge as they are.

    Next to an edge the second difference is continued as a constant: the ghost value is quadratic.
    """
    h_up, h_down = steps(grid, axis)
    upper, lower = on_edge(grid, axis, 1), on_edge(grid, axis, -1)
    bend = 2 * (up - down) / (h_up + h_down)
    bend = jnp.where(upper, neighbour(bend, grid, unit(grid, axis, -1)), bend)
    bend = jnp.where(lower, neighbour(bend, grid, unit(grid, axis, 1)), bend)
    above, below = neighbour(bend, grid, unit(grid, axis, 1)), neighbour(bend, grid, unit(grid, axis, -1))
    up = jnp.where(upper, 0, up - h_up / 2 * _van_albada(bend, above))
    return up, jnp.where(lower, 0, down + h_down / 2 * _van_albada(bend, below))


def _van_albada(a: jax.Array, b: jax.Array) -> jax.Array:
    agree = a * b > 0
    return jnp.where(agree, a * b * (a + b) / jnp.where(agree, a * a + b * b, 1), 0)


def sparse(offsets: Sequence[tuple[int, ...]], values: Sequence[np.ndarray], diagonal: np.ndarray, grid: Grid) -> Any:
    """The matrix with ``diagonal`` and, for every offset o, entry values_o(x) in row x and column x + o.

    Host level. Nodes are numbered in C order. Entries whose column lies outside the box must be zero.

    Returns:
      A SciPy CSR array of shape (nodes, nodes) without explicit zeros off the diagonal.
    """
    from scipy.sparse import coo_array

    number = np.arange(grid.size).reshape(grid.shape)
    rows, columns, entries = [number.ravel()], [number.ravel()], [np.asarray(diagonal, np.float64).ravel()]
    for offset, value in zip(offsets, values, strict=True):
        nonzero = np.asarray(value).ravel() != 0
        target = np.roll(number, [-step for step in offset], axis=range(grid.ndim)).ravel()
        rows.append(number.ravel()[nonzero])
        columns.append(target[nonzero])
        entries.append(np.asarray(value, np.float64).ravel()[nonzero])
    index = (np.concatenate(rows), np.concatenate(columns))
    return coo_array((np.concatenate(entries), index), shape=(grid.size, grid.size)).tocsr()
