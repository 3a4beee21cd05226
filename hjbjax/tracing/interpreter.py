"""Evaluation of the jaxpr of a function of one state on object arrays, whose entries belong to an algebra.

Three kinds of primitives have a rule: primitives that move entries (one rule for all: move labels instead), primitives
that act entry by entry, and sums and products. All others use the algebra's ``nodewise``, with one warning.
"""

from __future__ import annotations

import abc
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem import streams
from hjbjax.problem.types import Numbers
from hjbjax.tracing import host_functions, jaxprs
from hjbjax.tracing.jaxprs import (
    CALLS,
    CUMULATIVE,
    ENTRYWISE,
    IN_NUMPY,
    MOVES,
    REDUCTIONS,
    SCATTERS,
    array_type,
    bind,
    in_numpy,
)
from hjbjax.tracing.stacks import RULES, Stack, is_components, object_array, varies

if TYPE_CHECKING:
    from jax.extend import core as jex

Operand: TypeAlias = Numbers  # operand of an equation: an object array of scalars, or numbers that hold at all nodes


class FallbackWarning(UserWarning):
    """A primitive without a component rule is evaluated node by node with ``vmap``, which is correct but slower."""


class Algebra(abc.ABC):
    """Arithmetic of the scalars in an object array: arrays over the nodes, or sets of terms in the control."""

    @abc.abstractmethod
    def constant(self, value: Numbers, index: tuple[int, ...]) -> Any:
        """The scalar for one entry of numbers that hold at all nodes."""

    @abc.abstractmethod
    def entrywise(self, primitive: jex.Primitive, params: dict, operands: list, dtypes: Sequence[np.dtype]) -> Any:
        """One entry of the result of a primitive that acts entry by entry."""

    @abc.abstractmethod
    def combine(self, operation: Callable, dtype: np.dtype, left: Any, right: Any) -> Any:
        """A sum, a product, a maximum ... of two scalars."""

    @abc.abstractmethod
    def nodewise(self, eqn: jex.JaxprEqn, operands: list) -> list[np.ndarray]:
        """Results of an equation without a rule."""

    def call(self, eqn: jex.JaxprEqn, inner: jex.ClosedJaxpr, operands: list) -> list | None:
        """Results of a function that is called by name; None to evaluate its program ``inner``."""
        return None

    def custom_jvp(self, eqn: jex.JaxprEqn, inner: jex.ClosedJaxpr, operands: list) -> list[np.ndarray]:
        """Results of a function with a custom derivative rule, which may differ from its computation ``inner``."""
        return self.nodewise(eqn, operands)

    def computes(self, eqn: jex.JaxprEqn) -> bool:
        """True if the rules also apply to numbers that hold at all nodes, which JAX would round."""
        return False

    def whole(self, eqn: jex.JaxprEqn, operands: list) -> list | None:
        """Results of an equation on vectors too long for components; None if the component rules apply."""
        return None


def pack(argument: Sequence[Numbers] | Numbers) -> np.ndarray:
    """A list of per-node scalars, or a single one, as an object array."""
    if isinstance(argument, (list, tuple)):
        return object_array(argument, (len(argument),))
    return object_array([argument], ())


def lift(value: Operand, algebra: Algebra) -> np.ndarray:
    """An operand as an object array of the algebra's scalars."""
    if is_components(value):
        return value
    if isinstance(value, Stack):
        return value.entries()
    shape = np.shape(value)
    return object_array([algebra.constant(value, index) for index in np.ndindex(*shape)], shape)


def evaluate_jaxpr(closed: jex.ClosedJaxpr, arguments: Sequence[Operand], algebra: Algebra) -> list:
    """Results of a jaxpr on object arrays.

    Args:
      closed: the jaxpr of a function of one state.
      arguments: one value per input, an object array or an array that is the same at all nodes.
      algebra: the scalars: arrays over the nodes, or abstract ones that record how results depend on inputs.

    Returns:
      One value per output, of the same kinds.
    """
    env: dict[jex.Var, Any] = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    env |= dict(zip(closed.jaxpr.invars, arguments, strict=True))
    for eqn in closed.jaxpr.eqns:
        operands = [var.val if jaxprs.is_literal(var) else env[var] for var in eqn.invars]
        results = _apply(eqn, operands, algebra)
        env.update(zip(eqn.outvars, results, strict=True))
    return [var.val if jaxprs.is_literal(var) else env[var] for var in closed.jaxpr.outvars]


def _apply(eqn: jex.JaxprEqn, operands: list, algebra: Algebra) -> list:
    """Results of one equation by the first rule that applies."""
    name = host_functions.NAME if host_functions.is_host_call(eqn) else eqn.primitive.name
    if not any(map(varies, operands)) and not algebra.computes(eqn):
        return _bind_uniform(eqn, operands)
    if name in CALLS and CALLS[name] in eqn.params:
        inner = eqn.params[CALLS[name]]  # some calls keep a jaxpr without constants
        inner = inner if jaxprs.is_closed(inner) else jaxprs.closed(inner)
        if (known := algebra.call(eqn, inner, operands)) is not None:
            return known
        return (
            algebra.custom_jvp(eqn, inner, operands)
            if name == "custom_jvp_call"
            else evaluate_jaxpr(inner, operands, algebra)
        )
    if name == "cond" and (_are_known(operands[:1]) or not any(isinstance(value, Stack) for value in operands)):
        return _branch(eqn, operands, algebra)
    if (found := algebra.whole(eqn, operands)) is not None:
        if name not in RULES:
            _warn_once(name)
        return found
    # a rule returns None if an index is unknown, which only a node-by-node evaluation can follow
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
        return [_accumulate(eqn, lift(operands[0], algebra), algebra)]
    elif name in REDUCTIONS:
        return [_reduce(eqn, lift(operands[0], algebra), algebra)]
    elif name == "dot_general":
        return [_contract(eqn, lift(operands[0], algebra), lift(operands[1], algebra), algebra)]
    # for scalars a rule would also use ``vmap`` over the nodes, so there is no need to warn
    if any(np.shape(value) != () for value in operands) or any(array_type(var).shape != () for var in eqn.outvars):
        _warn_once(name)
    return algebra.nodewise(eqn, operands)


def _bind_uniform(eqn: jex.JaxprEqn, operands: list) -> list:
    """Results of an equation whose operands are the same at all nodes; concrete if the operands are concrete."""
    if any(isinstance(value, jax.core.Tracer) for value in operands):
        return bind(eqn, operands)
    if (result := in_numpy(eqn, operands)) is not None:
        return [result]
    # inside ``jit``, an index computed from constants would otherwise become a tracer and need the fallback
    with jax.ensure_compile_time_eval():
        return bind(eqn, operands)


def _are_known(values: Iterable[Operand]) -> bool:
    """True if all values are concrete numbers that hold at all nodes."""
    return not any(varies(value) or isinstance(value, jax.core.Tracer) for value in values)


def _move(eqn: jex.JaxprEqn, operands: list, algebra: Algebra) -> list[np.ndarray] | None:
    """Results of a data-moving primitive, found by moving integer labels with JAX; None for unknown indices."""
    data = set(MOVES[eqn.primitive.name](len(operands)))
    if not _are_known([value for position, value in enumerate(operands) if position not in data]):
        return None
    pool: list[Any] = []  # label k stands for the entry pool[k] of some operand
    labelled = list(operands)
    for position in sorted(data):
        entries = lift(operands[position], algebra)
        labelled[position] = np.arange(len(pool), len(pool) + entries.size, dtype=np.int32).reshape(entries.shape)
        pool.extend(entries.reshape(-1))
    fill = eqn.params.get("fill_value")
    pool.append(algebra.constant(np.asarray(np.nan if fill is None else fill), ()))
    if fill is not None:  # without a fill value, JAX fills integers with the least one, which is also a negative label
        eqn = eqn.replace(params=eqn.params | {"fill_value": -1})
    if eqn.primitive.name in IN_NUMPY:
        moved = [IN_NUMPY[eqn.primitive.name](*labelled, **eqn.params)]
    else:
        with jax.ensure_compile_time_eval():
            moved = bind(eqn, labelled)
    return [  # an index out of range gives a negative label, which takes the fill value at the end
        object_array([pool[max(label, -1)] for label in np.ravel(labels)], np.shape(labels)) for labels in moved
    ]


def _scatter(eqn: jex.JaxprEqn, operands: list, algebra: Algebra) -> np.ndarray | None:
    """``x.at[known].add(...)`` and similar: JAX shows where each update goes; None for unknown indices."""
    target, indices, updates = operands
    if not _are_known([indices]):
        return None
    entries, updates = lift(target, algebra).copy(), lift(updates, algebra)
    numbers, mode = eqn.params["dimension_numbers"], eqn.params["mode"]
    combine = functools.partial(algebra.combine, SCATTERS[eqn.primitive.name], array_type(eqn.invars[0]).dtype)
    for position in np.ndindex(*updates.shape):  # one by one, because labels of updates to the same entry would add up
        one = np.zeros(updates.shape, np.int32)
        one[position] = 1
        with jax.ensure_compile_time_eval():
            hit = jax.lax.scatter_add(jnp.zeros(entries.shape, np.int32), indices, one, numbers, mode=mode)
        for place in zip(*np.nonzero(hit), strict=True):
            entries[place] = combine(entries[place], updates[position])
    return entries


def _branch(eqn: jex.JaxprEqn, operands: list, algebra: Algebra) -> list:
    """``cond`` and ``switch``: the known branch, or a choice node by node, as under ``vmap``."""
    index, *rest = operands
    branches = eqn.params["branches"]
    if _are_known([index]):
        return evaluate_jaxpr(branches[int(np.clip(index, 0, len(branches) - 1))], rest, algebra)  # JAX clamps it, too
    # all branches are evaluated and ``select_n`` picks one entry, so a NaN in another branch has no effect
    index = lift(index, algebra).item()
    outputs = [[lift(value, algebra) for value in evaluate_jaxpr(branch, rest, algebra)] for branch in branches]
    results = []
    for var, cases in zip(eqn.outvars, zip(*outputs, strict=True), strict=True):
        dtypes = [array_type(eqn.invars[0]).dtype] + [array_type(var).dtype] * len(cases)
        rows = zip(*(case.reshape(-1) for case in cases), strict=True)
        chosen = [algebra.entrywise(jax.lax.select_n_p, {}, [index, *row], dtypes) for row in rows]
        results.append(object_array(chosen, cases[0].shape))
    return results


def _entrywise(eqn: jex.JaxprEqn, operands: list, algebra: Algebra) -> np.ndarray:
    """Results entry by entry; a scalar combined with an array is used for all entries."""
    dtypes = [array_type(var).dtype for var in eqn.invars]
    return entry_by_entry(
        lambda *row: algebra.entrywise(eqn.primitive, eqn.params, list(row), dtypes), operands, algebra
    )


def entry_by_entry(function: Callable, operands: Sequence[Operand], algebra: Algebra) -> np.ndarray:
    """A function of scalars for every entry; an operand with one entry is used for all entries."""
    lifted = np.broadcast_arrays(*(lift(value, algebra) for value in operands))
    rows = zip(*(value.reshape(-1) for value in lifted), strict=True)
    return object_array([function(*row) for row in rows], lifted[0].shape)


def _reduce(eqn: jex.JaxprEqn, entries: np.ndarray, algebra: Algebra) -> np.ndarray:
    """A sum, a product, a maximum ... over some axes, in the order of the entries."""
    axes = tuple(eqn.params["axes"])
    kept = [axis for axis in range(entries.ndim) if axis not in axes]
    shape = tuple(entries.shape[axis] for axis in kept)
    if entries.size == 0:  # the neutral element, which JAX provides for every operation and dtype
        return lift(_bind_uniform(eqn, [np.zeros(entries.shape, array_type(eqn.invars[0]).dtype)])[0], algebra)
    rows = entries.transpose(*kept, *axes).reshape(math.prod(shape), -1)
    combine = functools.partial(algebra.combine, REDUCTIONS[eqn.primitive.name], array_type(eqn.invars[0]).dtype)
    # from the left, in the same order for all nodes; XLA's own reductions may use another order and round differently
    return object_array([functools.reduce(combine, row) for row in rows], shape)


def _accumulate(eqn: jex.JaxprEqn, entries: np.ndarray, algebra: Algebra) -> np.ndarray:
    """Running sums, products, maxima ... along one axis."""
    axis, step = eqn.params["axis"], -1 if eqn.params["reverse"] else 1
    combine = functools.partial(algebra.combine, CUMULATIVE[eqn.primitive.name], array_type(eqn.invars[0]).dtype)
    rows = np.moveaxis(entries, axis, -1)[..., ::step]  # reversed for a reverse sum, and reversed back at the end
    result = np.empty(rows.shape, dtype=object)
    for index in np.ndindex(*rows.shape[:-1]):
        result[index] = object_array(list(itertools.accumulate(rows[index], combine)), rows.shape[-1:])
    return np.moveaxis(result[..., ::step], -1, axis)


def _contract(eqn: jex.JaxprEqn, left: np.ndarray, right: np.ndarray, algebra: Algebra) -> np.ndarray:
    """``dot_general``: batch axes first, then the free axes of the left and of the right operand."""
    (contract_l, contract_r), (batch_l, batch_r) = eqn.params["dimension_numbers"]
    free_l = [axis for axis in range(left.ndim) if axis not in (*contract_l, *batch_l)]
    free_r = [axis for axis in range(right.ndim) if axis not in (*contract_r, *batch_r)]
    batch = tuple(left.shape[axis] for axis in batch_l)
    rows = tuple(left.shape[axis] for axis in free_l)
    columns = tuple(right.shape[axis] for axis in free_r)
    length = math.prod(left.shape[axis] for axis in contract_l)
    # both as (batch, rows or columns, length), so that each entry of the result is a dot product of two last axes
    left = left.transpose(*batch_l, *free_l, *contract_l).reshape(math.prod(batch), math.prod(rows), length)
    right = right.transpose(*batch_r, *free_r, *contract_r).reshape(math.prod(batch), math.prod(columns), length)
    dtype = array_type(eqn.outvars[0]).dtype
    if length == 0:  # an empty sum, on which functools.reduce would raise
        return lift(np.zeros(batch + rows + columns), algebra)
    add, multiply = (functools.partial(algebra.combine, op, dtype) for op in (jax.lax.add, jax.lax.mul))
    inner = [
        functools.reduce(add, map(multiply, left[b, i], right[b, j]))
        for b, i, j in np.ndindex(math.prod(batch), math.prod(rows), math.prod(columns))
    ]
    return object_array(inner, batch + rows + columns)


@functools.cache  # a solve evaluates its functions many times, and would warn every time
def _warn_once(name: str) -> None:
    """Warn about a primitive without a rule, once per process."""
    streams.warn_safely(
        f"the primitive {name!r} has no component rule: the function that uses it is evaluated node by node, "
        "which is correct but slower. Entry-by-entry arithmetic on x[0], x[1], ... avoids it.",
        FallbackWarning,
        stacklevel=2,
    )
