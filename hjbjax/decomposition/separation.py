"""Functions as sums, maxima or minima of functions of fewer inputs, found in their traces.

The jaxpr of a function is evaluated with *separated* scalars: numbers with the set of the inputs on which each depends.
A sum keeps one number per set of inputs, and so do a maximum and a minimum. Every other operation first joins its
operands into one number that depends on all their inputs. Constants become a part of a number with inputs. A factor
that is known decides whether a maximum stays one, and a product with a known zero depends on nothing. A number that is
traced is unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.types import Numbers
from hjbjax.tracing.interpreter import Algebra, evaluate_jaxpr, lift
from hjbjax.tracing.jaxprs import array_type, bind
from hjbjax.tracing.stacks import is_components, object_array

if TYPE_CHECKING:
    from jax.extend import core as jex

Inputs = frozenset[int]
NONE: Inputs = frozenset()
ONE, SUM, MAX, MIN = "one", "sum", "max", "min"
OPERATIONS: dict[str, Callable] = {SUM: jax.lax.add, MAX: jax.lax.max, MIN: jax.lax.min}
_LINEAR = frozenset({"convert_element_type", "copy", "copy_p", "real"})


class Separated(NamedTuple):
    """A scalar as the sum, the maximum or the minimum of numbers, each with the inputs on which it depends."""

    kind: str
    parts: dict[Inputs, Any]

    @property
    def inputs(self) -> Inputs:
        """All inputs on which it depends."""
        return NONE.union(*self.parts)


def separated(function: Callable, arguments: Sequence[Numbers], first: Sequence[int | None]) -> np.ndarray:
    """The entries of a function's result, separated.

    Args:
      function: a function of arrays.
      arguments: the arrays, which may be traced.
      first: for each argument the number of its first input; ``None`` if its entries do not count as inputs.

    Returns:
      An object array of ``Separated``, of the shape of the result.
    """
    arrays = [jnp.asarray(each) for each in arguments]
    closed = jax.make_jaxpr(function)(*arrays)
    packed: list[Any] = []
    for array, number in zip(arrays, first, strict=True):
        inputs = (NONE if number is None else frozenset({number + k}) for k in range(array.size))
        entries = [Separated(ONE, {each: entry}) for each, entry in zip(inputs, array.reshape(-1), strict=True)]
        packed.append(object_array(entries, array.shape))
    (result,) = evaluate_jaxpr(closed, packed, _ALGEBRA)
    return lift(result, _ALGEBRA)


def structure(function: Callable, shapes: Sequence[tuple[int, ...]], first: Sequence[int | None]) -> list[Separated]:
    """The kinds and the inputs of a function's entries, in order, without numbers.

    Args:
      function: a function as a pytree.
      shapes: the shapes of its arguments.
      first: as in ``separated``.
    """
    found: list[Separated] = []

    def run(*arguments: jax.Array) -> int:
        entries = separated(function, arguments, first)
        found.extend(Separated(each.kind, dict.fromkeys(each.parts)) for each in entries.reshape(-1))
        return 0

    jax.eval_shape(run, *(jax.ShapeDtypeStruct(shape, jnp.result_type(float)) for shape in shapes))
    return found


def structure_for_any_leaves(
    function: Callable, shapes: Sequence[tuple[int, ...]], first: Sequence[int | None]
) -> list[Separated]:
    """``structure`` if the leaves of the function are unknown, as in a compiled program."""
    found: list[Separated] = []
    jax.eval_shape(lambda function: found.extend(structure(function, shapes, first)), function)
    return found


def _number(value: Separated, dtype: Any) -> jax.Array:
    """The scalar as one number of a type."""
    (number,) = _as_one(value).parts.values()
    return jnp.asarray(number, dtype)


def merged(value: Separated, keep: Callable[[Inputs], bool] = lambda inputs: True) -> Any:
    """The sum, maximum or minimum of the parts whose inputs satisfy a condition; None without any."""
    chosen = [number for inputs, number in value.parts.items() if keep(inputs)]
    total = chosen[0] if chosen else None
    for number in chosen[1:]:
        total = _numbers(OPERATIONS[value.kind], total, number)
    return total


def _numbers(operation: Callable, left: Any, right: Any) -> jax.Array:
    """A binary operation on two numbers of the same type."""
    dtype = jnp.result_type(left, right)
    return operation(jnp.asarray(left, dtype), jnp.asarray(right, dtype))


def _as_one(value: Separated) -> Separated:
    """The scalar as one number."""
    return value if value.kind == ONE else Separated(ONE, {value.inputs: merged(value)})


def _merge(kind: str, left: Separated, right: Separated) -> Separated:
    """The sum, maximum or minimum of two scalars."""
    left, right = (each if each.kind in (ONE, kind) else _as_one(each) for each in (left, right))
    parts = dict(left.parts)
    for inputs, number in right.parts.items():
        parts[inputs] = _numbers(OPERATIONS[kind], parts[inputs], number) if inputs in parts else number
    if NONE in parts and len(parts) > 1:  # a constant belongs to any part
        constant, home = parts.pop(NONE), next(inputs for inputs in parts if inputs)
        parts[home] = _numbers(OPERATIONS[kind], parts[home], constant)
    return Separated(kind if len(parts) > 1 else ONE, parts)


def _add(left: Separated, right: Separated) -> Separated:
    """A sum; a constant is added to each part of a maximum or a minimum."""
    for one, other in ((left, right), (right, left)):
        if one.kind in (MAX, MIN) and not other.inputs:
            (constant,) = _as_one(other).parts.values()
            return Separated(one.kind, {key: _numbers(jax.lax.add, part, constant) for key, part in one.parts.items()})
    return _merge(SUM, left, right)


def _negative(value: Separated) -> Separated:
    """Minus a scalar: minus a maximum is a minimum."""
    kind = {MAX: MIN, MIN: MAX}.get(value.kind, value.kind)
    return Separated(kind, {inputs: -jnp.asarray(number) for inputs, number in value.parts.items()})


def _scaled(value: Separated, factor: Separated, operation: Callable) -> Separated:
    """A scalar times a constant, or divided by it."""
    (number,) = factor.parts.values()
    sign = None if isinstance(number, jax.core.Tracer) else float(np.sign(np.asarray(number)))
    if sign == 0 and operation is jax.lax.mul:
        return Separated(ONE, {NONE: np.zeros((), jnp.result_type(number, *value.parts.values()))})
    if value.kind in (MAX, MIN) and sign not in (-1, 1):
        value = _as_one(value)
    parts = {inputs: _numbers(operation, part, number) for inputs, part in value.parts.items()}
    flipped = value.kind in (MAX, MIN) and sign == -1
    return Separated({MAX: MIN, MIN: MAX}[value.kind] if flipped else value.kind, parts)


class _Separation(Algebra):
    """The algebra of separated scalars for ``evaluate_jaxpr``."""

    def constant(self, value: Numbers, index: tuple[int, ...]) -> Separated:
        if not isinstance(value, jax.core.Tracer):  # a trace would make the entry of a JAX array a tracer
            value = np.asarray(value)
        return Separated(ONE, {NONE: value[index]})

    def entrywise(
        self, primitive: jex.Primitive, params: dict, operands: list[Separated], dtypes: Sequence[np.dtype]
    ) -> Separated:
        name = primitive.name
        floating = all(jnp.issubdtype(dtype, jnp.floating) for dtype in dtypes)
        if floating and name in ("add", "add_any"):
            return _add(*operands)
        if floating and name == "sub":
            return _add(operands[0], _negative(operands[1]))
        if floating and name == "neg":
            return _negative(operands[0])
        if floating and name in (MAX, MIN):
            return _merge(name, *operands)
        if floating and name == "mul":
            return self.combine(jax.lax.mul, dtypes[0], *operands)
        if floating and name == "div" and not operands[1].inputs:
            return _scaled(operands[0], _as_one(operands[1]), jax.lax.div)
        if name == "select_n" and not operands[0].inputs:
            (case,) = _as_one(operands[0]).parts.values()
            if not isinstance(case, jax.core.Tracer):
                return operands[1 + int(case)]
        if name in _LINEAR and floating and jnp.issubdtype(params.get("new_dtype", np.float64), jnp.floating):
            parts = operands[0].parts.items()
            moved = {inputs: primitive.bind(jnp.asarray(number, dtypes[0]), **params) for inputs, number in parts}
            return Separated(operands[0].kind, moved)
        numbers = [_number(each, dtype) for each, dtype in zip(operands, dtypes, strict=True)]
        return Separated(ONE, {NONE.union(*(each.inputs for each in operands)): primitive.bind(*numbers, **params)})

    def combine(self, operation: Callable, dtype: np.dtype, left: Separated, right: Separated) -> Separated:
        if operation is jax.lax.add:
            return _add(left, right)
        if operation in (jax.lax.max, jax.lax.min):
            return _merge(MAX if operation is jax.lax.max else MIN, left, right)
        if operation is jax.lax.mul:
            for one, other in ((left, right), (right, left)):
                if not other.inputs:
                    return _scaled(one, _as_one(other), jax.lax.mul)
        number = operation(*(_number(each, dtype) for each in (left, right)))
        return Separated(ONE, {left.inputs | right.inputs: number})

    def nodewise(self, eqn: jex.JaxprEqn, operands: list) -> list[np.ndarray]:
        used, arrays = NONE, []
        for value, var in zip(operands, eqn.invars, strict=True):
            if not is_components(value):
                arrays.append(value)
                continue
            used = used.union(*(each.inputs for each in value.flat))
            kind = array_type(var)
            entries = [_number(each, kind.dtype) for each in value.flat]
            arrays.append(jnp.stack(entries).reshape(kind.shape) if entries else jnp.zeros(kind.shape, kind.dtype))
        return [  # every result may depend on every operand
            object_array([Separated(ONE, {used: entry}) for entry in result.reshape(-1)], result.shape)
            for result in map(jnp.asarray, bind(eqn, arrays))
        ]


_ALGEBRA = _Separation()
