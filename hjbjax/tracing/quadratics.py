"""Functions that are quadratic polynomials of the control, with coefficients that are scalars over boxes of states.

    a(x) + Σ_j b_j(x) u_j + Σ_{j≤k} c_jk(x) u_j u_k

The coefficients are read from the jaxpr, so that nothing cancels: the minimum over the control is then exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.interpreter import Algebra, entry_by_entry, evaluate_jaxpr, lift
from hjbjax.tracing.intervals import quietly
from hjbjax.tracing.stacks import object_array
from hjbjax.tracing.taylor_forms import SCALARS, Form

if TYPE_CHECKING:
    from jax.extend import core as jex

_LINEAR = frozenset({"neg", "convert_element_type", "copy", "copy_p", "real", "stop_gradient"})


class NotQuadraticError(Exception):
    """The function is not known to be a quadratic polynomial of the control."""


class Polynomial(dict[tuple[int, ...], Form]):
    """The coefficient of each product of at most two inputs; () is the constant."""

    def __add__(self, other: Polynomial) -> Polynomial:
        total = Polynomial(self)
        for term, each in other.items():
            total[term] = total[term] + each if term in total else each
        return total

    def __neg__(self) -> Polynomial:
        return Polynomial({term: -each for term, each in self.items()})

    def __mul__(self, other: Polynomial | Form) -> Polynomial:
        if isinstance(other, Form):
            return Polynomial({term: each * other for term, each in self.items()})
        if self is other and self.keys() == {()}:  # the square of a coefficient is narrower than a product
            return Polynomial({(): self[()] * self[()]})
        total = Polynomial()
        for first, a in self.items():
            for second, b in other.items():
                if len(first) + len(second) > 2:
                    raise NotQuadraticError
                total = total + Polynomial({tuple(sorted(first + second)): a * b})
        return total


@quietly
def quadratics(function: Callable, x: Sequence[Form], *inputs: int | np.ndarray) -> list[Polynomial]:
    """The entries of a function of (x, u), or of (x, u, d), as polynomials of the inputs.

    Args:
      function: a JAX-traceable function.
      x: the state over boxes.
      *inputs: for every player the number of its inputs, which are numbered through, or the numbers of its control.

    Raises:
      NotQuadraticError: the function is not a quadratic polynomial of u.
      ValueError: it uses a primitive without a rule.
    """
    counts = [each if isinstance(each, int) else len(each) for each in inputs]
    closed = tf.traced(function, list(x), *([0.0] * count for count in counts))
    arguments, first = [object_array([Polynomial({(): each}) for each in x], (len(x),))], 0
    for each, count in zip(inputs, counts, strict=True):
        if isinstance(each, int):
            own = [Polynomial({(first + j,): tf.constant(1.0)}) for j in range(count)]
            first += count
        else:
            own = [Polynomial({(): tf.constant(number)}) for number in each]
        arguments.append(object_array(own, (count,)))
    (result,) = evaluate_jaxpr(closed, arguments, _POLYNOMIALS)
    return list(np.ravel(lift(result, _POLYNOMIALS)))


class _Polynomials(Algebra):
    """The algebra of polynomials; arithmetic that does not involve the control is that of their coefficients."""

    def constant(self, value: Any, index: tuple[int, ...]) -> Polynomial:
        return Polynomial({(): SCALARS.constant(value, index)})

    def entrywise(
        self, primitive: jex.Primitive, params: dict, operands: list[Polynomial], dtypes: Sequence[np.dtype]
    ) -> Polynomial:
        name = primitive.name

        def rule(*parts: Form) -> Form:
            return SCALARS.entrywise(primitive, params, list(parts), dtypes)

        if all(each.keys() <= {()} for each in operands):
            return Polynomial({(): rule(*(_constant_of(each) for each in operands))})
        if name in ("add", "add_any"):
            return operands[0] + operands[1]
        if name == "sub":
            return operands[0] + (-operands[1])
        if name == "mul":
            return operands[0] * operands[1]
        if name == "square" or (name == "integer_pow" and params["y"] == 2):
            return operands[0] * operands[0]
        if name == "integer_pow" and params["y"] == 1:
            return operands[0]
        if name == "div" and operands[1].keys() <= {()}:
            divisor = _constant_of(operands[1])
            return Polynomial({term: each / divisor for term, each in operands[0].items()})
        if name in _LINEAR and not (name == "convert_element_type" and params["new_dtype"].kind != "f"):
            return Polynomial({term: rule(each) for term, each in operands[0].items()})
        if name == "select_n" and operands[0].keys() <= {()}:
            zero, terms = tf.constant(0.0), {term: None for case in operands[1:] for term in case}
            which = _constant_of(operands[0])
            cases = {term: [case.get(term, zero) for case in operands[1:]] for term in terms}
            return Polynomial({term: tf.selected(which, each) for term, each in cases.items()})
        raise NotQuadraticError

    def combine(self, operation: Callable, dtype: np.dtype, left: Polynomial, right: Polynomial) -> Polynomial:
        if operation is jax.lax.add:
            return left + right
        if operation is jax.lax.mul:
            return left * right
        if not (left.keys() <= {()} and right.keys() <= {()}):
            raise NotQuadraticError
        return Polynomial({(): SCALARS.combine(operation, dtype, _constant_of(left), _constant_of(right))})

    def computes(self, eqn: jex.JaxprEqn) -> bool:
        return SCALARS.computes(eqn)

    def whole(self, eqn: jex.JaxprEqn, operands: list) -> None:
        SCALARS.whole(eqn, operands)

    def call(self, eqn: jex.JaxprEqn, inner: jex.ClosedJaxpr, operands: list) -> list | None:
        if not tf.is_hypot(eqn, inner):
            return None

        def length(*pair: Polynomial) -> Polynomial:
            if not all(each.keys() <= {()} for each in pair):
                raise NotQuadraticError
            return Polynomial({(): tf.norm([_constant_of(each) for each in pair])})

        return [entry_by_entry(length, operands, self)]

    def custom_jvp(self, eqn: jex.JaxprEqn, inner: jex.ClosedJaxpr, operands: list) -> list:
        return evaluate_jaxpr(inner, operands, self)

    def nodewise(self, eqn: jex.JaxprEqn, operands: list) -> list[np.ndarray]:
        return SCALARS.nodewise(eqn, operands)


def _constant_of(terms: Polynomial) -> Form:
    """The part without the control."""
    return terms.get((), tf.constant(0.0))


_POLYNOMIALS = _Polynomials()
