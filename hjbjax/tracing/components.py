"""A function of one state, evaluated on a whole grid, component by component.

``vmap`` of a drift that ends in ``jnp.stack`` writes one array of all nodes per entry to memory. Here the
function is traced once on a single state, and its jaxpr is evaluated with every vector held as a NumPy object
array of scalars-per-node: entry i of the state is an array that varies along axis i alone, so that sin θ is
computed N times and not N^n times, stacking and slicing cost nothing, and XLA fuses what is left.

Three kinds of primitives have a rule: those that move entries about (one rule: move labels instead), those
that act entry by entry, and sums and products. Anything else falls back to ``vmap``, with one warning.
"""

import functools
import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core as jex

from hjbjax.problem.problem import Problem
from hjbjax.tracing import indices
from hjbjax.tracing.primitives import CALLS, CUMULATIVE, ENTRYWISE, IN_NUMPY, MOVES, REDUCTIONS, SCATTERS


class FallbackWarning(UserWarning):
    """A primitive has no component rule and is evaluated node by node with ``vmap``: correct, slower."""


def components(function: Callable, *arguments: Any, dtype: Any) -> np.ndarray:
    """``function`` of one state, evaluated at every node.

    Args:
      function: a JAX-traceable function; its vector arguments have shape (n,), (m,), ...
      *arguments: each a list of per-node scalars for a vector argument, or one per-node scalar for a scalar
        argument. A per-node scalar is an array that broadcasts against the node axes, or a number.
      dtype: floating-point type in which the function is traced.

    Returns:
      An object array of the shape of the function's result; every entry is a per-node scalar.
    """
    closed, packed = trace(function, *arguments, dtype=dtype)
    (result,) = evaluate(closed, packed, ARRAYS)
    return _lift(result, ARRAYS)


def scalar(function: Any, *arguments: Any, dtype: Any) -> Any:
    """Like ``components`` for a function that returns a scalar, or a number in its place: one per-node scalar."""
    if not callable(function):
        return jnp.asarray(function, dtype)
    entries = components(function, *arguments, dtype=dtype)
    if entries.shape != ():
        raise ValueError(f"a function returned shape {entries.shape}, expected a scalar ()")
    return entries.item()


def of_state(problem: Problem, ingredient: Any, x: list, t: Any, dtype: Any) -> Any:
    """A problem's function of the state alone, or a number in its place, or None for zero: one per-node scalar."""
    entry = 0.0 if ingredient is None else ingredient
    return scalar(entry, *problem.state_arguments(x, t), dtype=dtype)


def trace(function: Callable, *arguments: Any, dtype: Any) -> tuple[jex.ClosedJaxpr, list[np.ndarray]]:
    """The jaxpr of ``function`` on one state, and the arguments as object arrays."""
    packed = [pack(argument) for argument in arguments]
    shapes = [jax.ShapeDtypeStruct(entries.shape, dtype) for entries in packed]
    closed = jax.make_jaxpr(function)(*shapes)
    if (outside := indices.beyond(closed)) is not None:  # inside jit, where nobody has looked before
        raise ValueError(f"a function of one state asks for {outside}")
    return closed, packed


def pack(argument: Any) -> np.ndarray:
    """A list of per-node scalars, or one of them, as an object array."""
    if isinstance(argument, (list, tuple)):
        return _object_array(argument, (len(argument),))
    return _object_array([argument], ())


def _object_array(entries: Sequence[Any], shape: tuple[int, ...]) -> np.ndarray:
    array = np.empty(len(entries), dtype=object)
    for index, entry in enumerate(entries):
        array[index] = entry
    return array.reshape(shape)


def _is_components(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == object


def _lift(value: Any, algebra: Any) -> np.ndarray:
    """A value that is the same at all nodes, as an object array of the algebra's scalars."""
    if _is_components(value):
        return value
    shape = np.shape(value)
    return _object_array([algebra.constant(value, index) for index in np.ndindex(*shape)], shape)


def evaluate(closed: jex.ClosedJaxpr, arguments: Sequence[Any], algebra: Any) -> list[Any]:
    """Evaluate a jaxpr on object arrays.

    Args:
      closed: the jaxpr of a function of one state.
      arguments: one value an input; an object array, or an array that is the same at all nodes.
      algebra: what the scalars are; ``ARRAYS``, or an abstract one that records how results depend on inputs.

    Returns:
      One value an output, likewise.
    """
    env = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    env |= dict(zip(closed.jaxpr.invars, arguments, strict=True))
    for eqn in closed.jaxpr.eqns:
        operands = [var.val if isinstance(var, jex.Literal) else env[var] for var in eqn.invars]
        results = _apply(eqn, operands, algebra)
        env.update(zip(eqn.outvars, results, strict=True))
    return [var.val if isinstance(var, jex.Literal) else env[var] for var in closed.jaxpr.outvars]


def _apply(eqn: Any, operands: list[Any], algebra: Any) -> list[Any]:
    name = eqn.primitive.name
    if not any(map(_is_components, operands)):
        return _uniform(eqn, operands)
    if name in CALLS and CALLS[name] in eqn.params:
        inner = eqn.params[CALLS[name]]
        inner = inner if isinstance(inner, jex.ClosedJaxpr) else jex.ClosedJaxpr(inner, ())
        return (
            algebra.custom_jvp(eqn, inner, operands)
            if name == "custom_jvp_call"
            else evaluate(inner, operands, algebra)
        )
    if name == "cond":
        return _branch(eqn, operands, algebra)
    if name in MOVES:
        moved = _move(eqn, operands, algebra)
        if moved is not None:
            return moved
    elif name in ENTRYWISE:
        return [_entrywise(eqn, operands, algebra)]
    elif name in SCATTERS:
        scattered = _scatter(eqn, operands, algebra)
        if scattered is not None:
            return [scattered]
    elif name in CUMULATIVE:
        return [_accumulate(eqn, _lift(operands[0], algebra), algebra)]
    elif name in REDUCTIONS:
        return [_reduce(eqn, _lift(operands[0], algebra), algebra)]
    elif name == "dot_general":
        return [_contract(eqn, _lift(operands[0], algebra), _lift(operands[1], algebra), algebra)]
    if any(np.shape(value) != () for value in operands) or any(var.aval.shape != () for var in eqn.outvars):
        _warn_once(name)
    return algebra.nodewise(eqn, operands)


def _uniform(eqn: Any, operands: list[Any]) -> list[Any]:
    """An equation none of whose operands varies over the nodes; kept concrete while its operands are."""
    if any(isinstance(value, jax.core.Tracer) for value in operands):
        return _bind(eqn, operands)
    with jax.ensure_compile_time_eval():
        return _bind(eqn, operands)


def _bind(eqn: Any, operands: list[Any]) -> list[Any]:
    results = eqn.primitive.bind(*operands, **eqn.primitive.get_bind_params(eqn.params))
    return list(results) if eqn.primitive.multiple_results else [results]


def _known(values: Sequence[Any]) -> bool:
    return not any(_is_components(value) or isinstance(value, jax.core.Tracer) for value in values)


def _move(eqn: Any, operands: list[Any], algebra: Any) -> list[Any] | None:
    """Where every entry of a data-moving primitive goes, found by moving integer labels."""
    data = set(MOVES[eqn.primitive.name](len(operands)))
    if not _known([value for position, value in enumerate(operands) if position not in data]):
        return None
    pool: list[Any] = []
    labelled = list(operands)
    for position in sorted(data):
        entries = _lift(operands[position], algebra)
        labelled[position] = np.arange(len(pool), len(pool) + entries.size, dtype=np.int32).reshape(entries.shape)
        pool.extend(entries.reshape(-1))
    fill = eqn.params.get("fill_value")
    pool.append(algebra.constant(np.asarray(np.nan if fill is None else fill), ()))
    if fill is not None:
        eqn = eqn.replace(params=eqn.params | {"fill_value": -1})
    if eqn.primitive.name in IN_NUMPY:
        moved = [IN_NUMPY[eqn.primitive.name](*labelled, **eqn.params)]
    else:
        with jax.ensure_compile_time_eval():
            moved = _bind(eqn, labelled)
    return [  # a gather out of range has a negative label: it takes the fill value at the end
        _object_array([pool[max(label, -1)] for label in np.ravel(labels)], np.shape(labels)) for labels in moved
    ]


def _scatter(eqn: Any, operands: list[Any], algebra: Any) -> np.ndarray | None:
    """``x.at[known].add(...)`` and its like: each update goes where a one in its place would go."""
    target, indices, updates = operands
    if not _known([indices]):
        return None
    entries, updates = _lift(target, algebra).copy(), _lift(updates, algebra)
    numbers, mode = eqn.params["dimension_numbers"], eqn.params["mode"]
    combine = functools.partial(algebra.combine, SCATTERS[eqn.primitive.name], eqn.invars[0].aval.dtype)
    for position in np.ndindex(*updates.shape):
        one = np.zeros(updates.shape, np.int32)
        one[position] = 1
        with jax.ensure_compile_time_eval():
            hit = jax.lax.scatter_add(jnp.zeros(entries.shape, np.int32), indices, one, numbers, mode=mode)
        for place in zip(*np.nonzero(hit), strict=True):
            entries[place] = combine(entries[place], updates[position])
    return entries


def _branch(eqn: Any, operands: list[Any], algebra: Any) -> list[Any]:
    """``cond`` and ``switch``: the branch that is known to be taken, or a choice node by node, as under ``vmap``."""
    index, *rest = operands
    branches = eqn.params["branches"]
    if _known([index]):
        return evaluate(branches[int(np.clip(index, 0, len(branches) - 1))], rest, algebra)
    index = _lift(index, algebra).item()
    outputs = [[_lift(value, algebra) for value in evaluate(branch, rest, algebra)] for branch in branches]
    results = []
    for var, cases in zip(eqn.outvars, zip(*outputs, strict=True), strict=True):
        dtypes = [eqn.invars[0].aval.dtype] + [var.aval.dtype] * len(cases)
        rows = zip(*(case.reshape(-1) for case in cases), strict=True)
        chosen = [algebra.entrywise(jax.lax.select_n_p, {}, [index, *row], dtypes) for row in rows]
        results.append(_object_array(chosen, cases[0].shape))
    return results


def _entrywise(eqn: Any, operands: list[Any], algebra: Any) -> np.ndarray:
    lifted = np.broadcast_arrays(*(_lift(value, algebra) for value in operands))
    dtypes = [var.aval.dtype for var in eqn.invars]
    rows = zip(*(value.reshape(-1) for value in lifted), strict=True)
    results = [algebra.entrywise(eqn.primitive, eqn.params, list(row), dtypes) for row in rows]
    return _object_array(results, lifted[0].shape)


def _reduce(eqn: Any, entries: np.ndarray, algebra: Any) -> np.ndarray:
    axes = tuple(eqn.params["axes"])
    kept = [axis for axis in range(entries.ndim) if axis not in axes]
    shape = tuple(entries.shape[axis] for axis in kept)
    if entries.size == 0:  # the neutral element
        return _lift(_uniform(eqn, [np.zeros(entries.shape, eqn.invars[0].aval.dtype)])[0], algebra)
    rows = entries.transpose(*kept, *axes).reshape(math.prod(shape), -1)
    combine = functools.partial(algebra.combine, REDUCTIONS[eqn.primitive.name], eqn.invars[0].aval.dtype)
    return _object_array([functools.reduce(combine, row) for row in rows], shape)


def _accumulate(eqn: Any, entries: np.ndarray, algebra: Any) -> np.ndarray:
    axis, step = eqn.params["axis"], -1 if eqn.params["reverse"] else 1
    combine = functools.partial(algebra.combine, CUMULATIVE[eqn.primitive.name], eqn.invars[0].aval.dtype)
    rows = np.moveaxis(entries, axis, -1)[..., ::step]
    result = np.empty(rows.shape, dtype=object)
    for index in np.ndindex(*rows.shape[:-1]):
        result[index] = _object_array(list(itertools.accumulate(rows[index], combine)), rows.shape[-1:])
    return np.moveaxis(result[..., ::step], -1, axis)


def _contract(eqn: Any, left: np.ndarray, right: np.ndarray, algebra: Any) -> np.ndarray:
    """dot_general: batch axes first, then the free axes of the left and of the right operand."""
    (contract_l, contract_r), (batch_l, batch_r) = eqn.params["dimension_numbers"]
    free_l = [axis for axis in range(left.ndim) if axis not in (*contract_l, *batch_l)]
    free_r = [axis for axis in range(right.ndim) if axis not in (*contract_r, *batch_r)]
    batch = tuple(left.shape[axis] for axis in batch_l)
    rows = tuple(left.shape[axis] for axis in free_l)
    columns = tuple(right.shape[axis] for axis in free_r)
    length = math.prod(left.shape[axis] for axis in contract_l)
    left = left.transpose(*batch_l, *free_l, *contract_l).reshape(math.prod(batch), math.prod(rows), length)
    right = right.transpose(*batch_r, *free_r, *contract_r).reshape(math.prod(batch), math.prod(columns), length)
    dtype = eqn.outvars[0].aval.dtype
    if length == 0:
        return _lift(np.zeros(batch + rows + columns), algebra)
    add, multiply = (functools.partial(algebra.combine, op, dtype) for op in (jax.lax.add, jax.lax.mul))
    inner = [
        functools.reduce(add, map(multiply, left[b, i], right[b, j]))
        for b, i, j in np.ndindex(math.prod(batch), math.prod(rows), math.prod(columns))
    ]
    return _object_array(inner, batch + rows + columns)


class _Arrays:
    """Scalars that are arrays over the nodes; ranks are those of the grid, or zero."""

    def constant(self, value: Any, index: tuple[int, ...]) -> Any:
        return value[index] if np.ndim(value) else value

    def entrywise(self, primitive: Any, params: dict, operands: list[Any], dtypes: list[Any]) -> Any:
        arrays = [jnp.asarray(value, dtype) for value, dtype in zip(operands, dtypes, strict=True)]
        return primitive.bind(*jnp.broadcast_arrays(*arrays), **params)

    def combine(self, operation: Callable, dtype: Any, left: Any, right: Any) -> Any:
        return operation(*jnp.broadcast_arrays(jnp.asarray(left, dtype), jnp.asarray(right, dtype)))

    def custom_jvp(self, eqn: Any, inner: jex.ClosedJaxpr, operands: list[Any]) -> list[Any]:
        """The function by components, with its own derivative, which is a function of one state as well."""
        avals = [var.aval for var in eqn.invars]
        if not all(jnp.issubdtype(aval.dtype, jnp.floating) for aval in avals):
            return self.nodewise(eqn, operands)
        packed = [_lift(value, self) for value in operands]
        shapes = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]

        def flat(closed, rows):
            arguments = [_object_array(row, shape.shape) for row, shape in zip(rows, shapes * 2, strict=False)]
            return [
                [jnp.asarray(entry, var.aval.dtype) for entry in _lift(value, self).flat]
                for var, value in zip(closed.jaxpr.outvars, evaluate(closed, arguments, self), strict=True)
            ]

        @jax.custom_jvp
        def function(*rows):
            return flat(inner, rows)

        @function.defjvp
        def derivative(primals, tangents):
            def one(*args):
                half = len(args) // 2
                return jax.jvp(lambda *state: _bind(eqn, list(state)), args[:half], args[half:])

            both = flat(jax.make_jaxpr(one)(*shapes, *shapes), (*primals, *tangents))
            # a tangent has the shape of its primal, which may vary along more axes than the tangents it came from
            values, slopes = both[: len(both) // 2], both[len(both) // 2 :]
            return values, jax.tree.map(lambda value, slope: jnp.broadcast_to(slope, value.shape), values, slopes)

        rows = [
            [jnp.asarray(entry, aval.dtype) for entry in value.flat] for value, aval in zip(packed, avals, strict=True)
        ]
        outputs = function(*rows)
        return [_object_array(entries, var.aval.shape) for entries, var in zip(outputs, eqn.outvars, strict=True)]

    def nodewise(self, eqn: Any, operands: list[Any]) -> list[Any]:
        """One equation at every node by ``vmap`` over the flattened nodes."""
        varying = [_is_components(value) for value in operands]
        shapes = [np.shape(entry) for value, v in zip(operands, varying, strict=True) if v for entry in value.flat]
        nodes = np.broadcast_shapes(*shapes)

        def gathered(value, aval):
            entries = [jnp.broadcast_to(jnp.asarray(entry, aval.dtype), nodes).reshape(-1) for entry in value.flat]
            return jnp.stack(entries, axis=-1).reshape(math.prod(nodes), *value.shape)

        arguments = [
            gathered(value, var.aval) if v else value
            for value, v, var in zip(operands, varying, eqn.invars, strict=True)
        ]
        axes = [0 if v else None for v in varying]
        results = jax.vmap(lambda *one: _bind(eqn, list(one)), in_axes=axes)(*arguments)
        return [
            _object_array(
                [result[(slice(None), *index)].reshape(nodes) for index in np.ndindex(*result.shape[1:])],
                result.shape[1:],
            )
            for result in results
        ]


ARRAYS = _Arrays()


@functools.cache
def _warn_once(name: str) -> None:
    warnings.warn(
        f"the primitive {name!r} has no component rule: the function that uses it is evaluated node by node, "
        "which is correct and slower; entry-by-entry arithmetic on x[0], x[1], ... avoids it",
        FallbackWarning,
        stacklevel=2,
    )
