"""Functions that are quadratic polynomials of the control, with coefficients that are scalars over boxes of states.

    a(x) + Σ_j b_j(x) u_j + Σ_{j≤k} c_jk(x) u_j u_k

The coefficients are read from the jaxpr, so that nothing cancels: the minimum over the control is then exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.interpreter import evaluate_jaxpr, lift
from hjbjax.tracing.intervals import quietly
from hjbjax.tracing.stacks import object_array
from hjbjax.tracing.taylor_forms import SCALARS, Form

if TYPE_CHECKING:
    from jax.extend import core as jex

Terms = dict[tuple[int, ...], Form]  # the coefficient of each product of at most two inputs; () is the constant

_LINEAR = frozenset({"neg", "convert_element_type", "copy", "copy_p", "real", "stop_gradient"})


class NotQuadraticError(Exception):
    """The function is not known to be a quadratic polynomial of the control."""


@quietly
def quadratics(function: Callable, x: Sequence[Form], count: int) -> list[Terms]:
    """The entries of a function of (x, u) as polynomials of u.

    Args:
      function: a JAX-traceable function.
      x: the state over boxes.
      count: the number of inputs of the control.

    Raises:
      NotQuadraticError: the function is not a quadratic polynomial of u.
      ValueError: it uses a primitive without a rule.
    """
    closed = tf.traced(function, list(x), [0.0] * count)
    states = object_array([{(): each} for each in x], (len(x),))
    inputs = object_array([{(j,): tf.constant(1.0)} for j in range(count)], (count,))
    (result,) = evaluate_jaxpr(closed, [states, inputs], _POLYNOMIALS)
    return list(np.ravel(lift(result, _POLYNOMIALS)))


def add(left: Terms, right: Terms) -> Terms:
    """The sum of two polynomials."""
    return {
        term: tf.add(left[term], right[term]) if term in left and term in right else (left | right)[term]
        for term in left | right
    }


def multiply(left: Terms, right: Terms) -> Terms:
    """The product of two polynomials, at most of degree two."""
    if left is right and left.keys() == {()}:
        return {(): tf.multiply(left[()], left[()])}
    total: Terms = {}
    for first, a in left.items():
        for second, b in right.items():
            if len(first) + len(second) > 2:
                raise NotQuadraticError
            total = add(total, {tuple(sorted(first + second)): tf.multiply(a, b)})
    return total


class _Polynomials:
    """The algebra of polynomials; arithmetic that does not involve the control is that of their coefficients."""

    def constant(self, value: Any, index: tuple[int, ...]) -> Terms:
        return {(): SCALARS.constant(value, index)}

    def entrywise(
        self, primitive: jex.Primitive, params: dict, operands: list[Terms], dtypes: Sequence[np.dtype]
    ) -> Terms:
        name = primitive.name

        def rule(*parts: Form) -> Form:
            return SCALARS.entrywise(primitive, params, list(parts), dtypes)

        if all(each.keys() <= {()} for each in operands):
            return {(): rule(*(_constant_of(each) for each in operands))}
        if name in ("add", "add_any"):
            return add(*operands)
        if name == "sub":
            return add(operands[0], {term: tf.negative(each) for term, each in operands[1].items()})
        if name == "mul":
            return multiply(*operands)
        if name == "square" or (name == "integer_pow" and params["y"] == 2):
            return multiply(operands[0], operands[0])
        if name == "integer_pow" and params["y"] == 1:
            return operands[0]
        if name == "div" and operands[1].keys() <= {()}:
            return {term: tf.divide(each, _constant_of(operands[1])) for term, each in operands[0].items()}
        if name in _LINEAR and not (name == "convert_element_type" and params["new_dtype"].kind != "f"):
            return {term: rule(each) for term, each in operands[0].items()}
        if name == "select_n" and operands[0].keys() <= {()}:
            zero, terms = tf.constant(0.0), {term: None for case in operands[1:] for term in case}
            which = _constant_of(operands[0])
            return {term: tf.selected(which, [case.get(term, zero) for case in operands[1:]]) for term in terms}
        raise NotQuadraticError

    def combine(self, operation: Callable, dtype: np.dtype, left: Terms, right: Terms) -> Terms:
        rule = tf.COMBINED.get(operation)
        if rule is tf.add:
            return add(left, right)
        if rule is tf.multiply:
            return multiply(left, right)
        if not (left.keys() <= {()} and right.keys() <= {()}):
            raise NotQuadraticError
        return {(): SCALARS.combine(operation, dtype, _constant_of(left), _constant_of(right))}

    def computes(self, eqn: jex.JaxprEqn) -> bool:
        return SCALARS.computes(eqn)

    def whole(self, eqn: jex.JaxprEqn, operands: list) -> None:
        SCALARS.whole(eqn, operands)

    def custom_jvp(self, eqn: jex.JaxprEqn, inner: jex.ClosedJaxpr, operands: list) -> list:
        return evaluate_jaxpr(inner, operands, self)

    def nodewise(self, eqn: jex.JaxprEqn, operands: list) -> list[np.ndarray]:
        return SCALARS.nodewise(eqn, operands)


def _constant_of(terms: Terms) -> Form:
    """The part without the control."""
    return terms.get((), tf.constant(0.0))


_POLYNOMIALS = _Polynomials()
