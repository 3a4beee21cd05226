"""Host functions that a user's function calls through ``jax.pure_callback``, with numbers of 64 bits.

A solve enables 64-bit types for its own thread. A program may call the host in another thread, where JAX rounds the
numbers to 32 bits and refuses the results. Here the numbers are sent in words of 32 bits; see
``hjbjax.problem.host_calls``.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.host_calls import call_on_host
from hjbjax.problem.types import Numbers
from hjbjax.tracing import jaxprs

if TYPE_CHECKING:
    from jax.extend import core as jex

NAME = "pure_callback"


def evaluate_with_host_calls(jaxpr: jex.Jaxpr, consts: Sequence[Numbers], *arguments: Numbers) -> list:
    """``jax.core.eval_jaxpr``, with host functions that receive and return 64-bit numbers unchanged."""
    if not jaxprs.calls_back(jaxpr):
        return jax.core.eval_jaxpr(jaxpr, consts, *arguments)
    values: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    values |= dict(zip(jaxpr.invars, arguments, strict=True))
    for eqn in jaxpr.eqns:
        operands = [var.val if jaxprs.is_literal(var) else values[var] for var in eqn.invars]
        values.update(zip(eqn.outvars, _results(eqn, operands), strict=True))
    return [var.val if jaxprs.is_literal(var) else values[var] for var in jaxpr.outvars]


def is_host_call(eqn: jex.JaxprEqn) -> bool:
    """True for a call of the host, also as ``evaluate_with_host_calls`` makes it."""
    return NAME in (eqn.primitive.name, eqn.params.get("name"))


def _results(eqn: jex.JaxprEqn, operands: list) -> list:
    """Results of one equation."""
    if any(jaxprs.calls_back(each.jaxpr) for each in jaxprs.inner(eqn)):
        eqn = eqn.replace(params={name: _changed(each) for name, each in eqn.params.items()})
    if eqn.primitive.name != NAME:
        return jaxprs.bind(eqn, operands)
    results = eqn.params["result_avals"]
    types = [jaxprs.array_type(var).dtype for var in eqn.invars] + [result.dtype for result in results]
    if all(kind.itemsize <= 4 for kind in types) or eqn.params.get("sharding") is not None:
        return jaxprs.bind(eqn, operands)
    shapes = tuple(jax.ShapeDtypeStruct(result.shape, result.dtype) for result in results)

    # the name by which ``is_host_call`` knows the call
    def pure_callback(*numbers: jax.Array) -> Any:
        on_host = _OnHost(eqn.params["callback"], tuple(shape.dtype for shape in shapes))
        return call_on_host(on_host, shapes, *numbers, vmap_method=eqn.params["vmap_method"])

    return list(jax.jit(pure_callback)(*operands))


def _changed(parameter: Any) -> Any:
    """A parameter of an equation; jaxprs in it call the host by ``evaluate_with_host_calls``."""
    if type(parameter) is tuple:  # the branches of a ``cond``
        return tuple(map(_changed, parameter))
    if not jaxprs.is_closed(parameter):
        return _changed(jaxprs.closed(parameter)).jaxpr if jaxprs.is_open_jaxpr(parameter) else parameter
    shapes = [jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=aval.weak_type) for aval in parameter.in_avals]
    return jax.make_jaxpr(functools.partial(evaluate_with_host_calls, parameter.jaxpr, parameter.consts))(*shapes)


class _OnHost:
    """A host function of JAX arrays as a function of NumPy arrays, which checks the types of the results."""

    def __init__(self, callback: Any, types: tuple[np.dtype, ...]):
        self.callback_func, self.types = callback, types

    def __call__(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        with jax.enable_x64(True):
            found = tuple(np.asarray(each) for each in self.callback_func(*map(jnp.asarray, arrays)))
        for each, wanted in zip(found, self.types, strict=True):
            if each.dtype != wanted:
                raise TypeError(
                    f"a function called by jax.pure_callback returned {each.dtype} numbers, wanted {wanted}"
                )
        return found
