"""Indices beyond the end of their array, found in the jaxpr of a function.

Where NumPy raises, JAX clamps: x[2] of two states is x[1]. An index that is known when a function is traced appears in
its jaxpr, after a few operations on integers ("if negative, add the length"). Only these are evaluated here, in NumPy.
Everything that depends on the state is unknown, and unknown indices are accepted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from hjbjax.problem.types import Numbers
from hjbjax.tracing import jaxprs
from hjbjax.tracing.jaxprs import array_type

if TYPE_CHECKING:
    from jax.extend import core as jex

# the check takes time before every solve, and typical mistakes are small: x[2] of two states, a row beyond a table
MOST = 10_000  # largest array of indices to check
TURNS = 64  # iterations to follow of a loop of known length

# The operations between a written index and the primitive that uses it. JAX could evaluate them, but would compile each
# on its first use.
KNOWN: dict[str, Callable[..., Any]] = {
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "gt": lambda a, b: a > b,
    "ge": lambda a, b: a >= b,
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "neg": lambda a: -a,
    "max": np.maximum,
    "min": np.minimum,
    "copy": lambda a: a,
    "clamp": lambda low, a, high: np.clip(a, low, high),
    "select_n": lambda which, *cases: np.choose(np.asarray(which, int), cases),
    "convert_element_type": lambda a, new_dtype, **_: np.asarray(a, new_dtype),
    "squeeze": lambda a, dimensions: np.squeeze(a, dimensions),
    "reshape": lambda a, new_sizes, **_: np.reshape(a, new_sizes),
    "concatenate": lambda *parts, dimension: np.concatenate(parts, dimension),
    "iota": lambda dtype, shape, dimension, **_: np.asarray(np.indices(shape)[dimension], dtype),
    "broadcast_in_dim": lambda a, shape, broadcast_dimensions, **_: np.broadcast_to(
        np.reshape(a, [shape[axis] if axis in broadcast_dimensions else 1 for axis in range(len(shape))])
        if np.shape(a) == tuple(shape[axis] for axis in broadcast_dimensions)
        else np.reshape(a, [1] * len(shape)),
        shape,
    ),
}


def first_outside(closed: jex.ClosedJaxpr, names: Sequence[str] = ()) -> str | None:
    """The first index of a jaxpr that is outside its array, in words; ``None`` if there is none.

    Args:
      closed: the jaxpr.
      names: the names of its inputs, as in ("x", "u").
    """
    labels: list[str | None] = [*names, *(None,) * (len(closed.jaxpr.invars) - len(names))]
    return _walk(closed.jaxpr, closed.consts, [None] * len(closed.jaxpr.invars), labels)[1]


def _walk(
    jaxpr: jex.Jaxpr, consts: Sequence[Any], inputs: Sequence[Any], labels: Sequence[str | None]
) -> tuple[list[np.ndarray | None], str | None]:
    """Known outputs (``None`` for unknown ones), and the first index outside its array, in words."""
    values: dict[Any, np.ndarray | None] = dict(zip(jaxpr.invars, inputs, strict=True))
    values |= {var: _index_array(const) for var, const in zip(jaxpr.constvars, consts, strict=False)}
    called: dict[Any, str | None] = dict(zip(jaxpr.invars, labels, strict=True))

    def look(var: jex.Var | jex.Literal) -> np.ndarray | None:
        return _index_array(var.val) if jaxprs.is_literal(var) else values.get(var)

    for eqn in jaxpr.eqns:
        known = [look(var) for var in eqn.invars]
        first = eqn.invars[0] if eqn.invars else None
        # an array keeps the argument's name as long as it is the argument itself, also inside an inner ``jit``
        name = None if first is None or jaxprs.is_literal(first) else called.get(first)
        if (found := _outside(eqn, known, name)) is not None:
            return [], found
        results: Sequence[Any] = [None] * len(eqn.outvars)
        passed = [None if jaxprs.is_literal(var) else called.get(var) for var in eqn.invars]
        inner = jaxprs.inner(eqn)
        if eqn.primitive.name == "scan":  # its counters are known in each iteration, but not in the body in general
            inner, (results, found) = [], _walk_turns(eqn, known, passed)
            if found is not None:
                return [], found
        for body in inner:
            fits = len(body.jaxpr.invars) == len(known)  # otherwise it is a loop or a branch with other inputs
            arguments = (known, passed) if fits else ([None] * len(body.jaxpr.invars),) * 2
            outputs, found = _walk(body.jaxpr, body.consts, *arguments)
            if found is not None:
                return [], found
            if fits and len(inner) == 1 and eqn.primitive.name in ("jit", "pjit", "closed_call"):
                results = outputs
        if not inner and eqn.primitive.name != "scan":
            results = _evaluate(eqn, known)
        values |= dict(zip(eqn.outvars, results, strict=True))
    return [look(var) for var in jaxpr.outvars], None


def _walk_turns(
    eqn: jex.JaxprEqn, known: list[np.ndarray | None], labels: Sequence[str | None]
) -> tuple[list[np.ndarray | None], str | None]:
    """Known results of a loop, followed as long as its counters are known, and the first index outside its array."""
    body, length = eqn.params["jaxpr"], eqn.params["length"]
    # operands of ``scan``: constants, carry, and arrays taken row by row
    start, carried = (
        _count_whole(*pair) for pair in ((eqn.invars, body.jaxpr.invars), (eqn.outvars, body.jaxpr.outvars))
    )
    fixed = start - carried
    carry, rows = known[fixed:start], known[start:]
    turns = range(length)[:: -1 if eqn.params["reverse"] else 1]
    for turn in turns[:TURNS]:
        inputs = [*known[:fixed], *carry, *(None if row is None else row[turn] for row in rows)]
        outputs, found = _walk(body.jaxpr, body.consts, inputs, [*labels[:start], *(None for _ in rows)])
        if found is not None:
            return [], found
        carry = outputs[: len(carry)]
        if all(each is None for each in (*carry, *rows)):
            break  # nothing is known any more, so all further iterations are alike
    followed = length <= TURNS and any(each is not None for each in carry)
    return [*(carry if followed else (None,) * len(carry)), *(None for _ in eqn.outvars[len(carry) :])], None


def _count_whole(outside: Sequence[jex.Var | jex.Literal], inside: Sequence[jex.Var | jex.Literal]) -> int:
    """The number of values that an iteration of a loop takes, or returns, whole and not as rows of arrays.

    Found by rank, because JAX 0.12 stores the numbers of operands under other parameters than JAX 0.10.
    """
    pairs = zip(outside, inside, strict=True)
    return sum(len(array_type(whole).shape) == len(array_type(part).shape) for whole, part in pairs)


def _index_array(value: Numbers) -> np.ndarray | None:
    """A concrete array of indices as NumPy; ``None`` for anything else."""
    kind = getattr(value, "dtype", np.asarray(value).dtype if isinstance(value, (bool, int)) else None)
    whole = kind is not None and any(jax.dtypes.issubdtype(kind, each) for each in (np.integer, np.bool_))
    if not whole or np.size(value) > MOST:
        return None
    try:
        return np.asarray(value)
    except Exception:  # a tracer, whose value is unknown
        return None


def _evaluate(eqn: jex.JaxprEqn, known: list[np.ndarray | None]) -> list[np.ndarray | None]:
    """Results of an operation on known integers; ``None`` for other operations or unknown integers."""
    rule, shape = KNOWN.get(eqn.primitive.name), array_type(eqn.outvars[0]).shape if eqn.outvars else ()
    # the size as a float: a shape such as (10**10, 10**10) would overflow int64 to a small number
    if rule is None or any(value is None for value in known) or np.prod(shape, dtype=float) > MOST:
        return [None] * len(eqn.outvars)
    with np.errstate(all="ignore"):  # overflowing integers wrap silently in JAX
        return [_index_array(rule(*known, **eqn.params))]


# --- what an equation indexes ---


def _outside(eqn: jex.JaxprEqn, known: list[np.ndarray | None], name: str | None) -> str | None:
    """Entries outside its array that an equation reads or writes, in words; ``None`` if there are none."""
    kind, shape = eqn.primitive.name, getattr(eqn.invars[0].aval, "shape", ()) if eqn.invars else ()
    if kind == "dynamic_slice":
        columns = dict(enumerate(known[1 : 1 + len(shape)]))
        sizes = eqn.params["slice_sizes"]
    elif kind == "dynamic_update_slice":
        columns, sizes = dict(enumerate(known[2 : 2 + len(shape)])), array_type(eqn.invars[1]).shape
    # ``x.at[i].get(mode="fill", fill_value=0)`` reads entries outside on purpose
    elif kind == "gather" and not _has_stand_in(eqn.params.get("fill_value")):
        columns, sizes = _columns(known[1], eqn.params["dimension_numbers"].start_index_map), eqn.params["slice_sizes"]
    elif kind.startswith("scatter"):
        numbers = eqn.params["dimension_numbers"]
        columns = _columns(known[1], numbers.scatter_dims_to_operand_dims)
        sizes = _window(numbers, shape, array_type(eqn.invars[2]).shape)
    else:
        return None
    for axis, starts in columns.items():
        last = shape[axis] - sizes[axis]  # the largest start for which the whole window is inside
        if starts is None or np.size(starts) == 0 or not (np.min(starts) < 0 or np.max(starts) > last):
            continue
        start = next(int(k) for k in np.ravel(starts) if not 0 <= k <= last)
        return _sentence(name, shape, axis, start, sizes[axis])
    return None


def _has_stand_in(fill: float | None) -> bool:
    """True if a gather has a fill value for entries outside; NaN is JAX's default."""
    return fill is not None and not np.isnan(fill)


def _columns(indices: np.ndarray | None, axes: Sequence[int]) -> dict[int, np.ndarray | None]:
    """The indices along each axis of the array, from the rows of a gather or a scatter."""
    return {} if indices is None else {axis: np.asarray(indices)[..., k] for k, axis in enumerate(axes)}


def _window(numbers: jax.lax.ScatterDimensionNumbers, shape: tuple[int, ...], updates: tuple[int, ...]) -> list[int]:
    """Length along each axis of the window of one update of a scatter."""
    single = {*numbers.inserted_window_dims, *getattr(numbers, "operand_batching_dims", ())}
    widths = iter(updates[axis] for axis in numbers.update_window_dims)
    return [1 if axis in single else next(widths) for axis in range(len(shape))]


def _sentence(name: str | None, shape: tuple[int, ...], axis: int, start: int, size: int) -> str:
    """The index and the valid range, for a message."""
    count = shape[axis]
    # x[-3] of two states appears in the jaxpr as -1, after JAX has added the length
    entry = f"entry {start}" if start >= 0 else f"entry {start - count} (from the end)"
    if size > 1:
        entry = f"entries {start} to {start + size - 1}"
    array = f"an array of shape {shape}" if name is None else f"{name}, whose shape is {shape}"
    along = f" along axis {axis}" if len(shape) > 1 else ""
    wanted = f"0 to {count - 1}" if count else "none"
    return f"{entry} of {array}{along}; there are {wanted}"
