"""Evaluation of a function of one state on a whole grid, component by component.

``vmap`` of a drift that ends in ``jnp.stack`` writes one array of all nodes per entry to memory. Here the function is
traced once on a single state, and its jaxpr is evaluated with every vector as a NumPy object array of per-node scalars.
Entry i of the state is an array that varies only along axis i, so that sin θ is computed N times and not N^n times,
stacking and slicing cost nothing, and XLA fuses the rest.

Primitives without a rule in ``interpreter`` use ``vmap``, with one warning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.problem import Problem
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import DType, Numbers
from hjbjax.tracing import indices, stacks
from hjbjax.tracing.interpreter import Algebra, evaluate_jaxpr, lift, pack
from hjbjax.tracing.jaxprs import array_type, bind
from hjbjax.tracing.stacks import is_components, object_array

if TYPE_CHECKING:
    from jax.extend import core as jex

Rows: TypeAlias = Sequence[Sequence[jax.Array]]  # the entries of each operand or result


def components(function: Callable, *arguments: Any, dtype: DType) -> np.ndarray:
    """Values of a function of one state at all nodes, entry by entry.

    Args:
      function: a JAX-traceable function; its vector arguments have shape (n,), (m,), ...
      *arguments: each a list of per-node scalars for a vector argument, or one per-node scalar for a scalar
        argument. A per-node scalar is an array that broadcasts against the node axes, or a number.
      dtype: floating-point type in which the function is traced.

    Returns:
      An object array with the shape of the function's result; every entry is a per-node scalar.
    """
    closed, packed = _trace(function, *arguments, dtype=dtype)
    (result,) = evaluate_jaxpr(closed, packed, ARRAYS)
    entries = lift(result, ARRAYS)
    (kind,) = (each.dtype for each in closed.out_avals)
    if not jnp.issubdtype(kind, jnp.floating) or kind == dtype:
        return entries
    # inside jit, a closure may hold tracers of another type, which are not leaves that ``cast`` could find
    return np.vectorize(lambda entry: jnp.asarray(entry, dtype), otypes=[object])(entries)


def scalar(function: Callable | Numbers, *arguments: Any, dtype: DType) -> jax.Array:
    """Values at all nodes of a function that returns a scalar, or of a number used instead: one per-node scalar."""
    if not callable(function):
        return jnp.asarray(function, dtype)
    entries = components(function, *arguments, dtype=dtype)
    if entries.shape != ():
        raise ValueError(f"a function returned shape {entries.shape}, expected a scalar ()")
    return entries.item()


def of_state(
    problem: Problem, ingredient: Callable | Numbers | None, x: Sequence[Numbers], t: Numbers, dtype: DType
) -> jax.Array:
    """Values at all nodes of a problem's function of the state, of a number used instead, or of None for zero."""
    entry = 0.0 if ingredient is None else ingredient
    return scalar(entry, *problem.state_arguments(x, t), dtype=dtype)


def _trace(function: Callable, *arguments: Any, dtype: DType) -> tuple[jex.ClosedJaxpr, list[np.ndarray]]:
    """The jaxpr of ``function`` on one state, and the arguments as object arrays."""
    packed = [pack(argument) for argument in arguments]
    shapes = [jax.ShapeDtypeStruct(entries.shape, dtype) for entries in packed]
    # JAX caches traces by function, even if a global has changed since; the marks of ``closures`` prevent this
    closed = jax.make_jaxpr(function)(*shapes)
    if (outside := indices.first_outside(closed)) is not None:  # inside jit, where it has not been checked yet
        raise ValueError(f"a function of one state reads {outside}")
    return closed, packed


class _Arrays(Algebra):
    """The algebra of arrays over the nodes; each array has the rank of the grid, or rank zero."""

    def constant(self, value: Any, index: tuple[int, ...]) -> Numbers:
        return value[index] if np.ndim(value) else value

    def entrywise(
        self, primitive: jex.Primitive, params: dict, operands: list, dtypes: Sequence[np.dtype]
    ) -> jax.Array:
        # XLA's primitives require equal shapes; broadcasts are fused and never written to memory. The dtype is the
        # traced one: a Python number combined with a float32 state became float32 in the trace, and must here.
        arrays = [jnp.asarray(value, dtype) for value, dtype in zip(operands, dtypes, strict=True)]
        return primitive.bind(*jnp.broadcast_arrays(*arrays), **params)

    def combine(self, operation: Callable, dtype: np.dtype, left: Numbers, right: Numbers) -> jax.Array:
        return operation(*jnp.broadcast_arrays(jnp.asarray(left, dtype), jnp.asarray(right, dtype)))

    def whole(self, eqn: jex.JaxprEqn, operands: list) -> list | None:
        return stacks.results(eqn, operands)

    def custom_jvp(self, eqn: jex.JaxprEqn, inner: jex.ClosedJaxpr, operands: list) -> list:
        """The function by components, with its own derivative, which is also a function of one state."""
        if (found := self.whole(eqn, operands)) is not None:  # by ``vmap``, which keeps the rule
            return found
        avals = [array_type(var) for var in eqn.invars]
        # tangents of integers have the empty type float0, which has no arithmetic
        if not all(jnp.issubdtype(aval.dtype, jnp.floating) for aval in avals):
            return self.nodewise(eqn, operands)
        packed = [lift(value, self) for value in operands]
        shapes = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]

        # jax.custom_jvp accepts lists of arrays but no object arrays: pass each operand as the list of its entries;
        # the rows are the operands, or the operands and their tangents, so zip is not strict
        def flat(closed: jex.ClosedJaxpr, rows: Rows) -> Rows:
            arguments = [object_array(row, shape.shape) for row, shape in zip(rows, shapes * 2, strict=False)]
            return [
                [jnp.asarray(entry, var.aval.dtype) for entry in lift(value, self).flat]
                for var, value in zip(closed.jaxpr.outvars, evaluate_jaxpr(closed, arguments, self), strict=True)
            ]

        @jax.custom_jvp
        def function(*rows: Sequence[jax.Array]) -> Rows:
            return flat(inner, rows)

        @function.defjvp
        @own_settings()
        def derivative(primals: Rows, tangents: Rows) -> tuple[Rows, Rows]:
            # at one state, where binding the equation applies its derivative rule
            def one(*args: jax.Array) -> tuple[list, list]:
                half = len(args) // 2
                return jax.jvp(lambda *state: bind(eqn, list(state)), args[:half], args[half:])

            both = flat(jax.make_jaxpr(one)(*shapes, *shapes), (*primals, *tangents))
            # a tangent has the shape of its primal, which may vary along more axes than the incoming tangents
            values, slopes = both[: len(both) // 2], both[len(both) // 2 :]
            return values, jax.tree.map(lambda value, slope: jnp.broadcast_to(slope, value.shape), values, slopes)

        rows = [
            [jnp.asarray(entry, aval.dtype) for entry in value.flat] for value, aval in zip(packed, avals, strict=True)
        ]
        outputs = function(*rows)
        return [object_array(entries, array_type(var).shape) for entries, var in zip(outputs, eqn.outvars, strict=True)]

    def nodewise(self, eqn: jex.JaxprEqn, operands: list) -> list[np.ndarray]:
        """Results of one equation at every node, by ``vmap`` over the flattened nodes."""
        varying = [is_components(value) for value in operands]
        shapes = [np.shape(entry) for value, v in zip(operands, varying, strict=True) if v for entry in value.flat]
        nodes = np.broadcast_shapes(*shapes)  # axes along which no operand varies stay of length 1

        # entries that are arrays over the nodes, as one array (nodes, *shape of the operand)
        def gather(value: np.ndarray, aval: Any) -> jax.Array:
            entries = [jnp.broadcast_to(jnp.asarray(entry, aval.dtype), nodes).reshape(-1) for entry in value.flat]
            return jnp.stack(entries, axis=-1).reshape(math.prod(nodes), *value.shape)

        arguments = [
            gather(value, var.aval) if v else value for value, v, var in zip(operands, varying, eqn.invars, strict=True)
        ]
        axes = [0 if v else None for v in varying]  # numbers that hold at all nodes are not copied to each
        results = jax.vmap(lambda *one: bind(eqn, list(one)), in_axes=axes)(*arguments)
        return [  # results (nodes, *shape), split into one array (*grid) per entry
            object_array(
                [result[(slice(None), *index)].reshape(nodes) for index in np.ndindex(*result.shape[1:])],
                result.shape[1:],
            )
            for result in results
        ]


ARRAYS = _Arrays()
