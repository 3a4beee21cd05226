"""Layouts of the nodes of a grid: all on one device, or in parts, one per device of a mesh.

A layout exchanges values between parts and reduces over all nodes. Parts are a domain decomposition by
``jax.shard_map``: every device runs the single-device program on its part of the grid. It fetches the nodes just beyond
its part from the neighbouring parts by ``ppermute`` and reduces by ``pmax`` or ``psum``. The i-th axis of the mesh
divides the i-th axis of the grid. With N nodes, part k of p has the nodes from ⌊kN/p⌋ up to ⌊(k + 1)N/p⌋, so that parts
differ by at most one node. Arrays have ⌈N/p⌉ entries per part. A part with one node fewer has a filler as its last
entry, a copy of the next node. No node reads the value computed at a filler, and reductions ignore fillers.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hjbjax.problem.types import Array, AtNodes, Mask, Scalar, Verdict

T = TypeVar("T")
FEWEST = 3  # least number of nodes of a part along a divided axis, because Weno5 reads this many neighbours


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Layout:
    """The nodes of a grid in the arrays of this device: all of them on one device; see ``Parts`` for several.

    Args:
      whole: the number of nodes of the whole grid along every axis.
    """

    whole: tuple[int, ...]

    @property
    def sizes(self) -> tuple[int, ...]:
        """The number of parts along every axis."""
        return (1,) * len(self.whole)

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of entries of one part's arrays along every axis."""
        return tuple(-(-count // size) for count, size in zip(self.whole, self.sizes, strict=True))

    @property
    def axes(self) -> tuple[int, ...]:
        """The axes of the grid that are divided."""
        return tuple(axis for axis, size in enumerate(self.sizes) if size > 1)

    def is_divided(self, axis: int) -> bool:
        """True if the nodes along an axis are divided over several devices, so that this part holds some of them."""
        return self.sizes[axis] > 1

    def even(self, axis: int) -> bool:
        """True if all parts have the same number of nodes along an axis."""
        return self.whole[axis] % self.sizes[axis] == 0

    def count(self, axis: int) -> int | Scalar:
        """The number of nodes of this part along an axis; an int if all parts have the same number."""
        return self.whole[axis]

    def last(self, axis: int, step: int) -> Array:
        """The entries that hold the last node of an axis in the direction of ``step``, bool."""
        # NumPy, so that the program contains it as a small constant
        return np.arange(self.whole[axis]) == (self.whole[axis] - 1 if step > 0 else 0)

    def own(self, table: Any, axis: int) -> Any:
        """This part's entries of a table of all nodes along an axis."""
        return table

    def at_end(self, axis: int, step: int) -> Verdict | bool:
        """True if this part is at the end of an axis in the direction of ``step``."""
        return True

    def fetched(self, values: T, axis: int, step: int, *, cyclic: bool) -> T:
        """The values of the neighbouring part in the direction of ``step``; zero beyond the ends unless cyclic."""
        return values

    def cleared(self, values: AtNodes) -> AtNodes:
        """Node values with zeros in the fillers."""
        return values

    def largest(self, values: AtNodes) -> Scalar:
        """The largest of the values at all nodes; NaN if one of them is NaN."""
        return jnp.max(values)

    def least(self, values: AtNodes) -> Scalar:
        """The smallest of the values at all nodes; NaN if one of them is NaN."""
        return jnp.min(values)

    def total(self, values: AtNodes) -> Scalar:
        """The sum of the values at all nodes."""
        return jnp.sum(values)

    def some(self, mask: Mask) -> Verdict:
        """True if a mask is true at any node."""
        return jnp.any(mask)

    def first(self, mask: Mask) -> Scalar:
        """The smallest index in C order of the nodes of a mask, (*grid); −1 for an empty mask."""
        return jnp.where(jnp.any(mask), jnp.argmax(mask), -1).astype(jnp.int32)

    # On the host: conversion between arrays of the whole grid and arrays of all parts.

    @property
    def entries(self) -> tuple[int, ...]:
        """The shape of an array of all parts, including fillers."""
        return tuple(width * size for width, size in zip(self.shape, self.sizes, strict=True))

    @property
    def is_local(self) -> bool:
        """True if this process holds all parts."""
        return True

    def spread(self, tree: T, over_nodes: Any) -> T:
        """Divide arrays of the whole grid over the devices, and copy the others to every device.

        Args:
          tree: numbers and arrays.
          over_nodes: a tree of the same structure, True for leaves with one value per node, (*grid).
        """
        return tree

    def copied(self, tree: T) -> T:
        """Copy arrays to every device."""
        return tree

    def gathered(self, tree: T, over_nodes: Any) -> T:
        """The inverse of ``spread``: NumPy arrays of the whole grid if it is divided."""
        return tree

    def mapped(self, function: Callable, over_nodes: Any, result_over_nodes: Any) -> Callable:
        """A function that runs on every device at once, each with its own part of arrays from ``spread``."""
        return function


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Parts(Layout):
    """The nodes of a grid, divided over the devices of a mesh. The traced methods work only inside ``shard_map``.

    Args:
      whole: the number of nodes of the whole grid along every axis.
      mesh: the devices, with at most as many axes as the grid.
    """

    mesh: Mesh

    @property
    def names(self) -> tuple[str | None, ...]:
        """The axis of the mesh that divides each axis of the grid; None for an undivided axis."""
        pairs = zip(self.mesh.axis_names, self.mesh.devices.shape, strict=True)
        found = [name if size > 1 else None for name, size in pairs]
        return (*found, *[None] * (len(self.whole) - len(found)))

    @property
    def sizes(self) -> tuple[int, ...]:
        """The number of parts along every axis."""
        return (*self.mesh.devices.shape, *[1] * (len(self.whole) - self.mesh.devices.ndim))

    @property
    def fits(self) -> bool:
        """True if every part has at least ``FEWEST`` nodes along each divided axis, as stencils require."""
        return all(self.whole[axis] // self.sizes[axis] >= FEWEST for axis in self.axes)

    def _starts(self, axis: int) -> np.ndarray:
        """The first node of every part along an axis, followed by the number of nodes, (p + 1,)."""
        size = self.sizes[axis]
        return np.array([k * self.whole[axis] // size for k in range(size + 1)])

    def _nodes_of_entries(self, axis: int) -> np.ndarray:
        """The node at each entry of an array of all parts along an axis; fillers copy the next node."""
        reach = self._starts(axis)[:-1, None] + np.arange(self.shape[axis])
        return np.minimum(reach, self.whole[axis] - 1).ravel()

    def _entries_of_nodes(self, axis: int) -> np.ndarray:
        """The entry of each node in an array of all parts along an axis."""
        starts = self._starts(axis)
        width = self.shape[axis]
        return np.concatenate([k * width + np.arange(n) for k, n in enumerate(np.diff(starts))])

    @property
    def is_local(self) -> bool:
        """True if this process holds all parts."""
        return not spans_processes(self.mesh)

    def spread(self, tree: T, over_nodes: Any) -> T:
        """Divide arrays of the whole grid over the devices, and copy the others to every device."""

        def put(leaf: Any, divided: bool) -> jax.Array:
            host = np.asarray(leaf)
            for axis in self.axes if divided else ():
                if not self.even(axis):
                    host = np.take(host, self._nodes_of_entries(axis), axis)
            # each process provides the values for its own devices; they are copied, because states are donated
            return jax.make_array_from_callback(
                host.shape, self._sharding(divided), lambda index: np.array(host[index])
            )

        return jax.tree.map(put, tree, over_nodes)

    def copied(self, tree: T) -> T:
        """Copy arrays to every device."""
        return self.spread(tree, jax.tree.map(lambda _: False, tree))

    def gathered(self, tree: T, over_nodes: Any) -> T:
        """The inverse of ``spread``: NumPy arrays of the whole grid."""

        def take(leaf: Any, divided: bool) -> np.ndarray:
            # an array held by several processes can be gathered only if all of them take part
            far = isinstance(leaf, jax.Array) and divided and not leaf.is_fully_addressable
            host = np.asarray(multihost_utils.process_allgather(leaf, tiled=True) if far else leaf)
            for axis in self.axes if divided else ():
                if not self.even(axis):
                    host = np.take(host, self._entries_of_nodes(axis), axis)
            return host

        return jax.tree.map(take, tree, over_nodes)

    def mapped(self, function: Callable, over_nodes: Any, result_over_nodes: Any) -> Callable:
        """A function that runs on every device at once, each with its own part of arrays from ``spread``."""
        specs = (jax.tree.map(self._spec, marks) for marks in (over_nodes, result_over_nodes))
        # check_vma cannot see that results of reductions over all devices are the same on every device
        return jax.shard_map(function, mesh=self.mesh, in_specs=next(specs), out_specs=next(specs), check_vma=False)

    def _spec(self, divided: bool) -> PartitionSpec:
        """The layout of an array on the mesh."""
        return PartitionSpec(*self.names) if divided else PartitionSpec()

    def _sharding(self, divided: bool) -> NamedSharding:
        return NamedSharding(self.mesh, self._spec(divided))

    # Inside ``shard_map``, on this device's part.

    def index(self, axis: int) -> Scalar:
        """The number of this part along a divided axis."""
        return jax.lax.axis_index(self.names[axis])

    def count(self, axis: int) -> int | Scalar:
        """The number of nodes of this part along an axis; an int if all parts have the same number."""
        if self.even(axis):
            return self.shape[axis]
        return jnp.asarray(np.diff(self._starts(axis)), jnp.int32)[self.index(axis)]

    def nodes(self, axis: int) -> jax.Array:
        """The index of the node at each entry along a divided axis; a filler has the index of the next node."""
        start = jnp.asarray(self._starts(axis)[:-1], jnp.int32)[self.index(axis)]
        return start + jnp.arange(self.shape[axis], dtype=jnp.int32)

    def last(self, axis: int, step: int) -> Array:
        """The entries that hold the last node of an axis in the direction of ``step``, bool."""
        nodes = self.nodes(axis) if self.is_divided(axis) else np.arange(self.whole[axis])
        return nodes == (self.whole[axis] - 1 if step > 0 else 0)

    def own(self, table: Any, axis: int) -> Any:
        """This part's entries of a table of all nodes along an axis."""
        if self.names[axis] is None:
            return table
        return jnp.take(jnp.asarray(table), self.nodes(axis), axis=0, mode="clip")

    def at_end(self, axis: int, step: int) -> jax.Array:
        """True if this part is at the end of an axis in the direction of ``step``."""
        return self.index(axis) == (self.sizes[axis] - 1 if step > 0 else 0)

    def fetched(self, values: T, axis: int, step: int, *, cyclic: bool) -> T:
        """The values of the neighbouring part in the direction of ``step``; zero beyond the ends unless cyclic."""
        if not self.is_divided(axis):
            return values
        last, size = self.sizes[axis] - 1, self.sizes[axis]
        pairs = [((k + step) % size, k) for k in range(size) if cyclic or k != (last if step > 0 else 0)]
        return jax.lax.ppermute(values, self.names[axis], pairs)

    def _real(self) -> jax.Array | None:
        """True at nodes, False at fillers, in a shape that broadcasts to a part; None if there are no fillers."""
        found = None
        for axis in self.axes:
            if not self.even(axis):
                along = [-1 if i == axis else 1 for i in range(len(self.whole))]
                mask = (jnp.arange(self.shape[axis]) < self.count(axis)).reshape(along)
                found = mask if found is None else found & mask
        return found

    def cleared(self, values: AtNodes) -> AtNodes:
        """Node values with zeros in the fillers."""
        real = self._real()
        return values if real is None else jnp.where(real, values, jnp.zeros((), values.dtype))

    def _reduced(self, values: AtNodes | Mask, within: Callable, across: Callable, neutral: Any) -> jax.Array:
        """A reduction over all nodes: ``within`` each part, then ``across`` the parts; fillers count as ``neutral``."""
        real = self._real()
        if real is not None:
            values = jnp.where(real, values, jnp.asarray(neutral, jnp.result_type(values)))
        return across(within(values), tuple(name for name in self.names if name is not None))

    def largest(self, values: AtNodes) -> jax.Array:
        """The largest of the values at all nodes; NaN if one of them is NaN."""
        return self._reduced(values, jnp.max, _largest, -jnp.inf)

    def least(self, values: AtNodes) -> jax.Array:
        """The smallest of the values at all nodes; NaN if one of them is NaN."""
        return -self.largest(-values)

    def total(self, values: AtNodes) -> jax.Array:
        """The sum of the values at all nodes."""
        return self._reduced(values, jnp.sum, jax.lax.psum, 0)

    def some(self, mask: Mask) -> jax.Array:
        """True if a mask is true at any node."""
        return self._reduced(mask, lambda found: jnp.any(found).astype(jnp.int32), jax.lax.pmax, False) > 0

    def first(self, mask: Mask) -> jax.Array:
        """The smallest index in C order of the nodes of a mask, (*grid); −1 for an empty mask."""
        number = jnp.zeros((), jnp.int32)
        for axis, count in enumerate(self.whole):
            along = [-1 if i == axis else 1 for i in range(len(self.whole))]
            nodes = jnp.arange(count, dtype=jnp.int32) if self.names[axis] is None else self.nodes(axis)
            number = number * count + nodes.reshape(along)
        beyond = np.iinfo(np.int32).max
        found = self._reduced(jnp.where(mask, number, beyond), jnp.min, jax.lax.pmin, beyond)
        return jnp.where(found == beyond, -1, found)


@dataclasses.dataclass(frozen=True)
class Lanes:
    """The lanes of a batch, the leading axis of every array, divided evenly over all devices of a mesh.

    Args:
      mesh: the devices; None for a single device.
    """

    mesh: Mesh | None = None

    @property
    def spec(self) -> PartitionSpec:
        """The layout of an array on the mesh: its leading axis is divided over all axes of the mesh together."""
        return PartitionSpec(() if self.mesh is None else self.mesh.axis_names)

    @property
    def on_processors(self) -> bool:
        """True if the devices are CPUs, where a single lane keeps each device busy."""
        return self.mesh is not None and self.mesh.devices.flat[0].platform == "cpu"

    @staticmethod
    def in_turn(function: Callable) -> Callable:
        """Apply a function of one lane to the lanes one after the other, each with its own number of iterations."""
        # 48 pendulums on 100 x 101 nodes take as long as in separate threads; vmap takes 1.3 to 1.8 times as long
        return lambda *rows: jax.lax.map(lambda row: function(*row), rows)

    def filled(self, count: int) -> int:
        """The smallest number of rows, at least ``count``, that divides evenly over the devices."""
        size = 1 if self.mesh is None else self.mesh.size
        return -(-count // size) * size

    def spread(self, tree: T) -> T:
        """Place the lanes of all arrays on the devices that run them."""
        if self.mesh is None:
            return tree
        sharding = NamedSharding(self.mesh, self.spec)

        def put(leaf: Any) -> jax.Array:
            host = np.asarray(leaf)
            return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])

        return jax.tree.map(put, tree)

    def gathered(self, tree: Any) -> Any:
        """The inverse of ``spread``: NumPy arrays of all lanes, in every process."""
        far = spans_processes(self.mesh)
        return multihost_utils.process_allgather(tree, tiled=True) if far else jax.device_get(tree)

    def mapped(self, function: Callable) -> Callable:
        """A function of arrays of lanes that runs on every device independently."""
        if self.mesh is None:
            return function
        return jax.shard_map(function, mesh=self.mesh, in_specs=self.spec, out_specs=self.spec, check_vma=False)


def spans_processes(mesh: Mesh | None) -> bool:
    """True if some of the devices belong to other processes."""
    return mesh is not None and any(device.process_index != jax.process_index() for device in mesh.devices.flat)


def _largest(value: Scalar, names: tuple[str, ...]) -> Scalar:
    """The largest of one number per part; NaN if one of them is NaN, whether or not the backend's maximum keeps NaN."""
    lost = jnp.isnan(value)
    # one exchange for the maximum and the NaN; with the NaN dropped, the solve would appear to converge
    found = jax.lax.pmax(jnp.stack([jnp.where(lost, -jnp.inf, value), lost.astype(value.dtype)]), names)
    return jnp.where(found[1] > 0, jnp.nan, found[0])
