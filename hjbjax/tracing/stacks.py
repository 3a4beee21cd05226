"""Vectors of one state over all nodes: an object array with one array per component, or one array for long vectors.

Components are fast for a drift of a few states. In a layer of a neural network, however, a product with a 32 x 32
matrix is 2,000 scalar operations, each on its own array, and XLA takes minutes to compile a few layers. So a product
with a large matrix stays one contraction, and an operation on a long vector stays one operation on a ``Stack``, an
array (*shape, *nodes). A result that is short again, such as the drift at the end, is split into components.

Small matrices, as in mechanics and in linear systems, never become stacks.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.types import DType, Numbers
from hjbjax.tracing.jaxprs import CUMULATIVE, ENTRYWISE, MOVES, REDUCTIONS, SCATTERS, array_type, bind

if TYPE_CHECKING:
    from jax.extend import core as jex

MANY = 60  # an equation with more entries in its largest operand or result is one operation; 7 x 7 is below
LONG = 16  # a vector with more entries stays one array; the few entries of a drift are faster as separate arrays


@dataclasses.dataclass(frozen=True)
class Stack:
    """All entries of a vector, or of a matrix, in one array over the nodes.

    Attributes:
      array: (*shape, *nodes); the node axes are the axes of the grid, of length 1 where nothing varies, or absent.
      shape: the shape of the vector or matrix.
    """

    array: jax.Array
    shape: tuple[int, ...]

    @property
    def nodes(self) -> tuple[int, ...]:
        """The lengths of the axes over the nodes."""
        return self.array.shape[len(self.shape) :]

    def entries(self) -> np.ndarray:
        """An object array with one array over the nodes per entry."""
        rows = self.array.reshape(math.prod(self.shape), *self.nodes)
        return object_array([jax.lax.index_in_dim(rows, k, keepdims=False) for k in range(len(rows))], self.shape)

    def over(self, nodes: tuple[int, ...]) -> jax.Array:
        """The array (*shape, *nodes) over more nodes."""
        missing = len(nodes) - len(self.nodes)  # none, or all for a vector that is the same at all nodes
        aligned = self.array.reshape(*self.shape, *(1,) * missing, *self.nodes)
        return jnp.broadcast_to(aligned, (*self.shape, *nodes))


def object_array(entries: Sequence[Any], shape: tuple[int, ...]) -> np.ndarray:
    """An array of objects with the given shape, for entries of any kind."""
    array = np.empty(len(entries), dtype=object)  # np.array(entries) would unpack entries that are arrays
    for index, entry in enumerate(entries):
        array[index] = entry
    return array.reshape(shape)


def is_components(value: object) -> TypeGuard[np.ndarray]:
    """True if an operand is an object array, with one entry per component."""
    return isinstance(value, np.ndarray) and value.dtype == object


def varies(value: object) -> TypeGuard[np.ndarray | Stack]:
    """True if an operand may vary from node to node."""
    return is_components(value) or isinstance(value, Stack)


def results(eqn: jex.JaxprEqn, operands: Sequence[Any]) -> list | None:
    """Results of an equation on long vectors, by one operation on all entries; None if components are better.

    Args:
      eqn: the equation of a jaxpr of one state; not a call, nor a ``cond`` with a known branch.
      operands: stacks, object arrays, and numbers that hold at all nodes.

    Returns:
      One value per output: a stack, or an object array if it is short.
    """
    name = eqn.primitive.name
    if not is_whole(eqn, any(isinstance(value, Stack) for value in operands)):
        return None
    if name in ENTRYWISE:
        found = [_entrywise(eqn, operands)]
    elif name in _BY_AXES:
        value = stacked(operands[0], array_type(eqn.invars[0]).dtype)
        found = [Stack(bind(eqn, [value.array])[0], array_type(eqn.outvars[0]).shape)]
    elif name == "dot_general" and sum(map(varies, operands)) == 1:
        found = [_contraction(eqn, operands)]
    else:
        found = _over_nodes(eqn, operands)
    return [value if is_long(value.shape) else value.entries() for value in found]


def is_whole(eqn: jex.JaxprEqn, with_stacks: bool) -> bool:
    """True if an equation is one operation on all entries: an operand is a stack, or the equation is large."""
    if with_stacks:
        return True
    # moving the entries costs nothing here, and the next operation acts on one array
    name = eqn.primitive.name
    if not (name in ENTRYWISE or name in _BY_AXES or name in ("dot_general", "custom_jvp_call")):
        return False
    return max(array_type(var).size for var in (*eqn.invars, *eqn.outvars)) > MANY


def is_long(shape: tuple[int, ...]) -> bool:
    """True if a vector or matrix of this shape stays one array."""
    return math.prod(shape) > LONG


# entries come first, so the axes of one state are axes of the stack and the equation is bound unchanged
_BY_AXES = frozenset(REDUCTIONS) | frozenset(CUMULATIVE)
RULES = ENTRYWISE | _BY_AXES | frozenset(MOVES) | frozenset(SCATTERS) | {"dot_general", "custom_jvp_call", "cond"}


def stacked(value: np.ndarray | Stack | Numbers, dtype: DType) -> Stack:
    """An operand as a stack, without node axes if it holds at all nodes."""
    if isinstance(value, Stack):
        return Stack(jnp.asarray(value.array, dtype), value.shape)
    if not is_components(value):
        return Stack(jnp.asarray(value, dtype), np.shape(value))
    unique = {id(entry): entry for entry in value.flat}  # repeated rows are stacked once
    arrays = [jnp.asarray(entry, dtype) for entry in unique.values()]
    nodes = np.broadcast_shapes(*(array.shape for array in arrays))
    rows = jnp.stack([jnp.broadcast_to(array, nodes) for array in arrays])
    if len(unique) < value.size:
        places = dict(zip(unique, range(len(unique)), strict=True))
        rows = rows[np.array([places[id(entry)] for entry in value.flat])]
    return Stack(rows.reshape(*value.shape, *nodes), value.shape)


def _over_nodes(eqn: jex.JaxprEqn, operands: Sequence[Any]) -> list[Stack]:
    """Results of any equation by ``vmap`` over the nodes, which are the last axis throughout."""
    stacks = [
        stacked(value, array_type(var).dtype) if varies(value) else value
        for value, var in zip(operands, eqn.invars, strict=True)
    ]
    nodes = np.broadcast_shapes(*(value.nodes for value in stacks if isinstance(value, Stack)))
    arguments = [
        value.over(nodes).reshape(*value.shape, math.prod(nodes)) if isinstance(value, Stack) else value
        for value in stacks
    ]
    axes = [len(value.shape) if isinstance(value, Stack) else None for value in stacks]
    found = jax.vmap(lambda *one: bind(eqn, list(one)), in_axes=axes, out_axes=-1)(*arguments)
    return [Stack(result.reshape(*result.shape[:-1], *nodes), result.shape[:-1]) for result in found]


def _entrywise(eqn: jex.JaxprEqn, operands: Sequence[Any]) -> Stack:
    """The result of a primitive that acts entry by entry; a scalar combined with a vector is used for all entries."""
    stacks = [stacked(value, array_type(var).dtype) for value, var in zip(operands, eqn.invars, strict=True)]
    shape = array_type(eqn.outvars[0]).shape
    nodes = np.broadcast_shapes(*(value.nodes for value in stacks))
    arrays = []
    for value in stacks:
        fill = (1,) * (len(shape) - len(value.shape)) + (1,) * (len(nodes) - len(value.nodes))
        aligned = value.array.reshape(*value.shape, *fill, *value.nodes)
        arrays.append(jnp.broadcast_to(aligned, (*shape, *nodes)))
    return Stack(bind(eqn, arrays)[0], shape)


def _contraction(eqn: jex.JaxprEqn, operands: Sequence[Any]) -> Stack:
    """``dot_general`` with numbers that hold at all nodes: one product for all nodes."""
    left, right = (stacked(value, array_type(var).dtype) for value, var in zip(operands, eqn.invars, strict=True))
    (contract_l, contract_r), (batch_l, batch_r) = eqn.params["dimension_numbers"]
    # full precision, as in unrolled sums; by default a GPU would use 10 bits of float32
    params = eqn.params | {"precision": eqn.params["precision"] or jax.lax.Precision.HIGHEST}
    shape = array_type(eqn.outvars[0]).shape
    if varies(operands[1]):  # the free axes of the right operand come last, with the nodes at the end
        return Stack(eqn.primitive.bind(left.array, right.array, **params), shape)
    params["dimension_numbers"] = ((contract_r, contract_l), (batch_r, batch_l))
    product = eqn.primitive.bind(right.array, left.array, **params)
    # (batch, free of the right, free of the left, nodes): move the left axes first
    batch, columns = len(batch_l), len(right.shape) - len(contract_r) - len(batch_r)
    rows = len(shape) - batch - columns
    return Stack(
        jnp.moveaxis(product, range(batch, batch + columns), range(batch + rows, batch + rows + columns)), shape
    )
