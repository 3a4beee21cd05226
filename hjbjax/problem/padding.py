"""The nodes of a grid in the first entries of larger arrays, so that one program serves grids of several sizes.

A program for a loop of steps takes XLA the better part of a second, whatever the nodes, and the coarser grid that tells
the error of a finer one would have one of its own. On small grids a step takes less than a millisecond, so that the
coarser one may as well take four times as long, in arrays of the finer one's shape. What a grid of these arrays says of
its own size is then a number of the program, and no part of it.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import AtNodes, Field, Mask, Scalar

T = TypeVar("T")


@pytree_dataclass(static=("shape", "periodic"))
class Padding:
    """The nodes of a grid in the first entries of larger arrays, so that one program serves grids of several sizes.

    Along a periodic axis they are there several times, so that what is beside a node stands beside it everywhere; after
    every step the copies are made alike. Along the others copies of the last node follow it. No node reads what becomes
    of them, and no reduction counts them.

    Args:
      counts: the nodes along every axis, n integers, which may be traced.
      shape: the entries of the arrays along every axis.
      periodic: whether an axis is.
      patience: the steps without progress after which a solve on this grid has stalled, a number as well.
    """

    counts: Any
    shape: tuple[int, ...]
    periodic: tuple[bool, ...]
    patience: Any = 0
    mesh, axes = None, ()  # of the one device

    @staticmethod
    def fits(whole: tuple[int, ...], shape: tuple[int, ...], periodic: tuple[bool, ...]) -> bool:
        """True if so many nodes can stand in arrays of this shape."""
        return all(n <= m and not (cyclic and m % n) for n, m, cyclic in zip(whole, shape, periodic, strict=True))

    @property
    def whole(self) -> tuple[int, ...]:
        """The entries of all arrays."""
        return self.shape

    def even(self, axis: int) -> bool:
        """True if the last entry along an axis is read by others, as a node is."""
        return self.periodic[axis]

    def count(self, axis: int) -> int | Scalar:
        """The entries along an axis that are read by others."""
        return self.shape[axis] if self.periodic[axis] else self.counts[axis]

    def last(self, axis: int, step: int) -> jax.Array:
        """The entry of the last node of an axis in the direction of ``step``, bool."""
        return jnp.arange(self.shape[axis]) == (self.count(axis) - 1 if step > 0 else 0)

    def own(self, table: Any, axis: int) -> Any:
        """A table of the nodes along an axis as one of the entries; host level."""
        return np.asarray(table)[self._nodes(axis, len(table))]

    def _nodes(self, axis: int, count: int) -> np.ndarray:
        """The number of the node, one of so many, that each entry holds along an axis."""
        entry = np.arange(self.shape[axis])
        return entry % count if self.periodic[axis] else np.minimum(entry, count - 1)

    def repeated(self, values: Field) -> Field:
        """What each node holds, in all of its copies.

        Left alone they need not stay alike: what no certificate bounds may have solutions on a ring of several turns
        that are none on a ring of one.
        """
        for axis in range(len(self.shape)):
            if self.periodic[axis]:
                entry = jnp.arange(self.shape[axis]) % self.counts[axis]
                values = jnp.take(values, entry, axis, mode="clip")
        return values

    def spread(self, tree: T, over_nodes: Any) -> T:
        """Arrays of the grid as those of the entries, on the device; others as they are. Host level."""

        def put(leaf: Any, padded: bool) -> jax.Array:
            host = np.asarray(leaf)
            if padded and host.shape != self.shape:
                host = host[np.ix_(*(self._nodes(axis, count) for axis, count in enumerate(host.shape)))]
            return jax.device_put(host, may_alias=False)  # a copy, since states are donated

        return jax.tree.map(put, tree, over_nodes)

    def gathered(self, tree: T, over_nodes: Any) -> T:
        """The inverse of ``spread``: NumPy arrays of the grid."""
        nodes = tuple(slice(int(count)) for count in self.counts)

        def take(leaf: Any, padded: bool) -> np.ndarray:
            return np.asarray(leaf)[nodes] if padded else np.asarray(leaf)

        return jax.tree.map(take, tree, over_nodes)

    def _counted(self, values: AtNodes | Mask, neutral: Any) -> jax.Array:
        """Node values with a neutral one where an entry is no node, or one that stood before."""
        for axis, entries in enumerate(self.shape):
            along = [-1 if i == axis else 1 for i in range(len(self.shape))]
            here = (jnp.arange(entries) < self.counts[axis]).reshape(along)
            values = jnp.where(here, values, jnp.asarray(neutral, jnp.result_type(values)))
        return jnp.asarray(values)

    def largest(self, values: AtNodes) -> jax.Array:
        """The largest of the values at all nodes."""
        return jnp.max(self._counted(values, -jnp.inf))

    def total(self, values: AtNodes) -> jax.Array:
        """The sum of the values at all nodes."""
        return jnp.sum(self._counted(values, 0))

    def some(self, mask: Mask) -> jax.Array:
        """True if a mask holds at some node."""
        return jnp.any(self._counted(mask, False))

    def first(self, mask: Mask) -> jax.Array:
        """The least number in C order of the nodes of a mask, (*grid); −1 where there is none."""
        index = jnp.unravel_index(jnp.argmax(self._counted(mask, False)), self.shape)
        number = jnp.zeros((), jnp.int32)
        for place, count in zip(index, self.counts, strict=True):
            number = number * count + place
        return jnp.where(self.some(mask), number, -1)
