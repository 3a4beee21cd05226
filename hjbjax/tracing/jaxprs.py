"""The parts of a jaxpr, and JAX's primitives grouped by the rule that evaluates them by components.

See ``components``. The types belong to ``jax.extend.core``, which is imported when the first function is traced and not
with the package: ``jax.extend`` imports Pallas, which would add 15 ms to every ``import hjbjax``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeGuard, cast

import jax
import numpy as np

from hjbjax.problem.types import Numbers

if TYPE_CHECKING:
    from jax.extend import core as jex

# The positions of the operands, among n, that a data-moving primitive moves. The other operands are indices. If an
# index varies from node to node, the primitive moves different entries at every node, which requires ``vmap``.
MOVES: dict[str, Callable[[int], Sequence[int]]] = {
    "broadcast_in_dim": lambda n: (0,),
    "reshape": lambda n: (0,),
    "squeeze": lambda n: (0,),
    "expand_dims": lambda n: (0,),
    "transpose": lambda n: (0,),
    "rev": lambda n: (0,),
    "slice": lambda n: (0,),
    "split": lambda n: (0,),
    "dynamic_slice": lambda n: (0,),
    "gather": lambda n: (0,),
    "concatenate": range,
    "stack": range,
    "unstack": lambda n: (0,),
    "tile": lambda n: (0,),
    "pad": range,
    "dynamic_update_slice": lambda n: (0, 1),
    "scatter": lambda n: (0, 2),
}


def _broadcast(
    x: np.ndarray, *, shape: tuple[int, ...], broadcast_dimensions: tuple[int, ...], **_: object
) -> np.ndarray:
    """An array whose axes are some axes of ``shape``, repeated along the others."""
    lengths = dict(zip(broadcast_dimensions, x.shape, strict=True))
    return np.broadcast_to(x.reshape([lengths.get(axis, 1) for axis in range(len(shape))]), shape)


# The most common ones in NumPy, for labels and for constants, because JAX would compile each on its first use.
IN_NUMPY: dict[str, Callable[..., np.ndarray]] = {
    "broadcast_in_dim": _broadcast,
    "slice": lambda x, start_indices, limit_indices, strides: x[
        tuple(map(slice, start_indices, limit_indices, strides or (None,) * x.ndim))
    ],
    "squeeze": lambda x, dimensions: np.squeeze(x, dimensions),
    "stack": lambda *xs, axis: np.stack(xs, axis),
    "concatenate": lambda *xs, dimension: np.concatenate(xs, dimension),
}
# Arithmetic with the same bits in NumPy, for the constants that a function computes from its parameters.
_ARITHMETIC: dict[str, Callable[..., np.ndarray]] = {
    "add": np.add,
    "add_any": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "convert_element_type": np.asarray,
}

# ``scatter`` only moves entries, these compute: several updates may add up in one entry
SCATTERS = {"scatter-add": jax.lax.add, "scatter-sub": jax.lax.sub, "scatter-mul": jax.lax.mul}
SCATTERS |= {"scatter-min": jax.lax.min, "scatter-max": jax.lax.max}

ENTRYWISE = frozenset(
    """abs acos acosh add add_any and asin asinh atan atan2 atanh bessel_i0e bessel_i1e cbrt ceil clamp
    convert_element_type copy copy_p cos cosh digamma div eq erf erf_inv erfc exp exp2 expm1 floor ge gt imag
    integer_pow is_finite le lgamma log log1p log2 logistic lt max min mul ne neg nextafter not one_minus_square or
    polynomial pow real reduce_precision rem round rsqrt select_n sign sin sinh sqrt square stop_gradient sub tan tanh
    xor""".split()  # noqa: SIM905
)

REDUCTIONS: dict[str, Callable] = {
    "reduce_sum": jax.lax.add,
    "reduce_prod": jax.lax.mul,
    "reduce_max": jax.lax.max,
    "reduce_min": jax.lax.min,
    "reduce_and": jax.lax.bitwise_and,
    "reduce_or": jax.lax.bitwise_or,
}

CUMULATIVE = {"cumsum": jax.lax.add, "cumprod": jax.lax.mul, "cummax": jax.lax.max, "cummin": jax.lax.min}

# The parameter under which a call stores its jaxpr, for all names of the primitive in different versions of JAX. A
# custom_vjp is not included: evaluating its jaxpr would lose its rule, and ``vmap`` keeps the rule.
CALLS = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr"}
CALLS |= {"checkpoint": "jaxpr", "remat": "jaxpr", "remat2": "jaxpr", "custom_jvp_call": "call_jaxpr"}


def in_numpy(eqn: jex.JaxprEqn, operands: Sequence[Numbers]) -> np.ndarray | None:
    """Result of an equation on concrete numbers if NumPy gives the same bits, else None."""
    name, dtypes = eqn.primitive.name, [array_type(var).dtype for var in (*eqn.invars, *eqn.outvars)]
    if any(jax.dtypes.issubdtype(d, jax.dtypes.extended) for d in dtypes):  # random keys
        return None
    if name not in IN_NUMPY and (name not in _ARITHMETIC or not all(np.issubdtype(d, np.floating) for d in dtypes)):
        return None
    arrays = [np.asarray(operand, dtype) for operand, dtype in zip(operands, dtypes[:-1], strict=True)]
    if name in IN_NUMPY:
        return IN_NUMPY[name](*arrays, **eqn.params)
    with np.errstate(all="ignore"):
        return np.asarray(_ARITHMETIC[name](*arrays), dtypes[-1])


def bind(eqn: jex.JaxprEqn, operands: Sequence[Numbers]) -> list:
    """Results of one equation on JAX arrays."""
    results = eqn.primitive.bind(*operands, **eqn.primitive.get_bind_params(eqn.params))
    return list(results) if eqn.primitive.multiple_results else [results]


def array_type(var: jex.Var | jex.Literal) -> jax.core.ShapedArray:
    """Shape and dtype of a variable of a jaxpr; JAX annotates a wider type that includes tokens and references."""
    return cast(jax.core.ShapedArray, var.aval)


def is_literal(operand: jex.Var | jex.Literal) -> TypeGuard[jex.Literal]:
    """True for a number in the code, which is not a variable of the jaxpr."""
    from jax.extend.core import Literal

    return isinstance(operand, Literal)


def is_closed(value: Any) -> TypeGuard[jex.ClosedJaxpr]:
    """True for a jaxpr that includes its constants."""
    from jax.extend.core import ClosedJaxpr

    return isinstance(value, ClosedJaxpr)


def is_open_jaxpr(value: Any) -> TypeGuard[jex.Jaxpr]:
    """True for a jaxpr without constants, or with constants stored elsewhere."""
    from jax.extend.core import Jaxpr

    return isinstance(value, Jaxpr)


def closed(jaxpr: jex.Jaxpr) -> jex.ClosedJaxpr:
    """A jaxpr without constants as a closed jaxpr."""
    from jax.extend.core import ClosedJaxpr

    return ClosedJaxpr(jaxpr, ())


def in_use(found: jex.ClosedJaxpr) -> jex.ClosedJaxpr:
    """A jaxpr with separate constants in JAX's default types.

    JAX 0.10 converts a NumPy array once and returns the converted array again as long as something holds it, in 32 bits
    as in 64. A jaxpr that is kept must therefore not hold it.
    """
    from jax.extend.core import ClosedJaxpr

    return ClosedJaxpr(found.jaxpr, [_in_use(constant) for constant in found.consts])


def _in_use(constant: Any) -> Any:
    if jax.dtypes.issubdtype(constant.dtype, jax.dtypes.extended):  # a random key
        return constant
    dtype = jax.dtypes.canonicalize_dtype(constant.dtype)
    if not isinstance(constant, np.ndarray):
        return constant if constant.dtype == dtype else np.asarray(constant, dtype)
    # another view of the same memory, in the class that JAX does not convert again
    return np.asarray(constant, dtype).view(type(constant))


def without_repetitions(found: jex.ClosedJaxpr) -> jex.ClosedJaxpr:
    """The same program without equations that repeat an earlier one, such as every further ``x[0]``."""
    from jax.extend.core import ClosedJaxpr

    def name(var: jex.Var | jex.Literal) -> Any:
        if not is_literal(var):
            return var
        number = np.asarray(var.val)
        return number.dtype, number.shape, number.tobytes()

    results: dict[Any, Sequence[jex.Var]] = {}
    names: dict[jex.Var, jex.Var] = {}
    kept = []
    for eqn in found.jaxpr.eqns:
        operands = [var if is_literal(var) else names.get(var, var) for var in eqn.invars]
        key: Any = eqn.primitive, tuple(map(name, operands)), tuple(sorted(eqn.params.items()))
        try:
            first = None if eqn.effects else results.setdefault(key, eqn.outvars)
        except TypeError:  # a parameter that is not hashable
            first = None
        if first is None or first is eqn.outvars:
            kept.append(eqn.replace(invars=operands))
        else:
            names |= dict(zip(eqn.outvars, first, strict=True))
    outputs = [var if is_literal(var) else names.get(var, var) for var in found.jaxpr.outvars]
    return ClosedJaxpr(found.jaxpr.replace(eqns=kept, outvars=outputs), found.consts)


def inner(eqn: jex.JaxprEqn) -> list[jex.ClosedJaxpr]:
    """The jaxprs that an equation calls, except the jaxpr that combines two entries of a scatter."""
    found = []
    for name, value in eqn.params.items():
        for each in value if isinstance(value, (tuple, list)) else (value,):
            if is_closed(each):
                found.append(each)
            elif is_open_jaxpr(each) and name != "update_jaxpr":
                found.append(closed(each))
    return found


def calls_back(jaxpr: jex.Jaxpr) -> bool:
    """True if a jaxpr calls Python while it runs."""
    return any(
        "callback" in eqn.primitive.name or any(calls_back(each.jaxpr) for each in inner(eqn)) for eqn in jaxpr.eqns
    )
