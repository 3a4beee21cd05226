"""Dependence of the drift and the cost on the control, read from the jaxpr rather than from a flag or samples.

The jaxpr of a function is evaluated with polynomials in u instead of numbers. A polynomial is represented by the set of
its terms: ``()`` is independent of u, ``(0,)`` is u₀, ``(0, 1)`` is u₀u₁. A term of degree above two, or one that is
not a polynomial, is represented by the set of its inputs: ``frozenset({0})`` is some function of u₀. The result is a
proof: a function reported as affine is affine at every state.

The slopes of an affine function come from JAX's derivative rules. So a function with its own derivative rule
(``stop_gradient``, ``custom_jvp``, ``custom_vjp``) of the control is treated as not polynomial.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import numpy as np

from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import remembered
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import DType, Numbers
from hjbjax.tracing.interpreter import Algebra, evaluate_jaxpr
from hjbjax.tracing.jaxprs import array_type
from hjbjax.tracing.operations import NONE, Operations, operations
from hjbjax.tracing.stacks import is_components

if TYPE_CHECKING:
    from jax.extend import core as jex

Term = tuple[int, ...] | frozenset[int]  # a product of at most two inputs, or some function of these inputs
Terms = frozenset
CONSTANT: Terms = frozenset({()})

# f(a + b) = f(a) + f(b), so that the terms of the operand stay the same
_LINEAR = frozenset({"neg", "convert_element_type", "copy", "copy_p", "real"})


@dataclass(frozen=True)
class Dependence:
    """The terms in the control that each entry of a function's result contains.

    Attributes:
      entries: one set of terms per entry.
      operations: the operations of one evaluation of the function.
    """

    entries: tuple[Terms, ...]
    operations: Operations = NONE

    @property
    def is_constant(self) -> bool:
        """True if no entry depends on the control."""
        return not any(term for entry in self.entries for term in entry)

    def affine_in(self, inputs: Sequence[int]) -> bool:
        """True if every entry is affine in these inputs together, for any dependence on the others."""
        wanted = set(inputs)

        # u₀u₀ is (0, 0) and counts twice; a function of unknown kind must not contain any of the inputs
        def fits(term: Term) -> bool:
            return sum(j in wanted for j in term) <= (1 if isinstance(term, tuple) else 0)

        return all(fits(term) for entry in self.entries for term in entry)

    def separable_quadratic_in(self, inputs: Sequence[int]) -> bool:
        """True if every entry is a sum of quadratic polynomials, each of one of these inputs."""
        wanted = set(inputs)

        # as a set (0, 0) is one input, so squares pass and products of two inputs do not
        def fits(term: Term) -> bool:
            return len(wanted & set(term)) <= (1 if isinstance(term, tuple) else 0)

        return all(fits(term) for entry in self.entries for term in entry)

    def quadratic_in(self, inputs: Sequence[int]) -> bool:
        """True if every entry is a quadratic polynomial of these inputs together, for any dependence on the others."""
        wanted = set(inputs)
        return all(isinstance(term, tuple) or not wanted & term for entry in self.entries for term in entry)

    def products_in(self, inputs: Sequence[int]) -> frozenset[tuple[int, ...]]:
        """The pairs of different ``inputs``, the smaller first, whose product is in some entry."""
        wanted = set(inputs)
        pairs = (term for entry in self.entries for term in entry if isinstance(term, tuple) and len(set(term)) == 2)
        return frozenset(pair for pair in pairs if wanted.issuperset(pair))

    def free_of(self, inputs: Sequence[int]) -> bool:
        """True if no entry depends on these inputs."""
        return not self.driven_by(inputs)

    def driven_by(self, inputs: Sequence[int]) -> tuple[int, ...]:
        """The entries that depend on one of ``inputs``."""
        wanted = set(inputs)
        return tuple(i for i, entry in enumerate(self.entries) if any(wanted & set(term) for term in entry))

    def crosses(self, first: Sequence[int], second: Sequence[int]) -> bool:
        """True if some term contains inputs of both, so that the function is not a sum of one part for each."""
        return any(set(term) & set(first) and set(term) & set(second) for entry in self.entries for term in entry)

    def has_square(self, inputs: Sequence[int]) -> bool:
        """True if some entry contains the square of one of ``inputs``."""
        # a term of unknown kind is a frozenset and does not count, since no minimiser of quadratics accepts it
        return any((j, j) in entry for entry in self.entries for j in inputs)


@remembered
def dependence(function: Callable, *arguments: tuple[int | None, bool], dtype: DType) -> Dependence:
    """Terms of ``function`` in the arguments that are controls.

    Args:
      function: a function of one state, as stored by a problem: a pytree.
      *arguments: one pair (length, counts) per argument. The length is ``None`` for a scalar; ``counts`` is True if the
        entries are inputs. Inputs are numbered consecutively over all counted arguments.
      dtype: the floating-point type of the trace. Float64 does not depend on the caller's ``jax.enable_x64``.
    """
    with own_settings(x64=dtype == np.float64 or None):
        shapes = [jax.ShapeDtypeStruct(() if length is None else (length,), dtype) for length, _ in arguments]
        closed = jax.make_jaxpr(function)(*shapes)
    packed, number = [], 0
    for (_, counts), shape in zip(arguments, shapes, strict=True):
        entries = np.empty(shape.shape, dtype=object)
        for index in np.ndindex(*shape.shape):
            entries[index] = frozenset({(number,)}) if counts else CONSTANT  # the term of this input, or no input
            number += counts
        packed.append(entries)
    (result,) = evaluate_jaxpr(closed, packed, _POLYNOMIALS)
    if not is_components(result):  # a constant, which the evaluation leaves as a number
        return Dependence((CONSTANT,) * int(np.size(result)))
    return Dependence(tuple(result.reshape(-1)), operations(closed))


@dataclass(frozen=True)
class Influence:
    """Dependence of drift, cost and noise on both players' inputs, the control's first, then the disturbance's.

    Attributes:
      drift, cost, noise, switching, landing: the dependences; the last two of the rates of jumps, of changes of the
        mode and of the growth, and of the states after the jumps.
      control, disturbance: the inputs of each player.
    """

    drift: Dependence
    cost: Dependence
    noise: Dependence
    switching: Dependence
    landing: Dependence
    control: range
    disturbance: range

    @property
    def separable(self) -> bool:
        """True if drift, cost and rates are sums of one part per player; noise and landings depend on neither."""
        functions = (self.drift, self.cost, self.switching)
        crossed = any(function.crosses(self.control, self.disturbance) for function in functions)
        return not crossed and self.noise.is_constant and self.landing.is_constant

    @property
    def operations(self) -> Operations:
        """The operations of one evaluation of all these functions."""
        each = (self.drift, self.cost, self.noise, self.switching, self.landing)
        return sum((found.operations for found in each), start=NONE)

    @property
    def meet(self) -> bool:
        """True if both players drive some common component of the state."""
        return bool(set(self.drift.driven_by(self.control)) & set(self.drift.driven_by(self.disturbance)))


def influence(problem: Problem, n: int, dtype: DType) -> Influence:
    """The dependence of the functions of a problem with ``n`` states on its players."""
    m = 0 if problem.controls is None else problem.controls.dim
    k = 0 if problem.disturbances is None else problem.disturbances.dim
    arguments = (*((None, False),) * problem.time_dependent, (n, False), (m, True), *((k, True),) * problem.is_game)

    def of(function: object) -> Dependence:
        return dependence(function, *arguments, dtype=dtype) if callable(function) else Dependence((CONSTANT,))

    each = (problem.mode_rates, problem.intensities, problem.growth)
    rates = [of(function) for function in each if function is not None]
    switching = Dependence(
        sum((each.entries for each in rates), start=()) or (CONSTANT,), sum((each.operations for each in rates), NONE)
    )
    landing, players = of(problem.landings), (range(m), range(m, m + k))
    return Influence(of(problem.drift), of(problem.cost), of(problem.noise), switching, landing, *players)


def _some_function(operands: Iterable[Terms]) -> Terms:
    """The term of a function of these operands that is not a quadratic polynomial: the set of its inputs."""
    inputs = frozenset(j for terms in operands for term in terms for j in term)
    return frozenset({inputs}) if inputs else CONSTANT


def _product(left: Terms, right: Terms) -> Terms:
    """Terms of a product: each term of one factor times each term of the other."""
    return frozenset(_times(p, q) for p in left for q in right)


def _times(left: Term, right: Term) -> Term:
    """A product of two terms."""
    if not left or not right:  # one of them is the constant term ()
        return left or right
    if isinstance(left, tuple) and isinstance(right, tuple) and len(left) + len(right) <= 2:
        return tuple(sorted(left + right))
    return frozenset(left) | frozenset(right)


class _Polynomials(Algebra):
    """Algebra of sets of terms without coefficients, so terms never cancel and "affine" holds for all numbers."""

    def constant(self, value: Numbers, index: tuple[int, ...]) -> Terms:
        return CONSTANT

    def entrywise(
        self, primitive: jex.Primitive, params: dict, operands: list[Terms], dtypes: Sequence[np.dtype]
    ) -> Terms:
        name = primitive.name
        if all(value == CONSTANT for value in operands):
            return CONSTANT
        # before the linear ones: the slope and the ends of a staircase do not determine its minimum
        if name == "convert_element_type" and _rounds(params["new_dtype"]):
            return _some_function(operands)
        if name in _LINEAR:
            return operands[0]
        if name in ("add", "add_any", "sub"):
            return operands[0] | operands[1]
        if name == "mul":
            return _product(*operands)
        if name == "div" and operands[1] == CONSTANT:  # u₀/u₁ is not a polynomial
            return operands[0]
        if name == "square" or (name == "integer_pow" and params["y"] == 2):
            return _product(operands[0], operands[0])
        if name == "integer_pow" and params["y"] == 1:
            return operands[0]
        # if the state makes the choice, the result is one of the cases at each state
        if name == "select_n" and operands[0] == CONSTANT:
            return frozenset().union(*operands[1:])
        return _some_function(operands)

    def combine(self, operation: Callable, dtype: np.dtype, left: Terms, right: Terms) -> Terms:
        if operation is jax.lax.add:  # used by ``reduce_sum``, ``cumsum`` and products of matrices
            return left | right
        if operation is jax.lax.mul:
            return _product(left, right)
        return _some_function([left, right])

    def nodewise(self, eqn: jex.JaxprEqn, operands: list) -> list[np.ndarray]:
        varying = [v for v in operands if is_components(v)]
        known = _some_function(entry for value in varying for entry in value.flat)
        results = []
        for var in eqn.outvars:
            entries = np.empty(array_type(var).shape, dtype=object)
            entries.fill(known)  # every result may depend on every operand
            results.append(entries)
        return results


def _rounds(dtype: DType) -> bool:
    """True if conversion to this type rounds coarsely: integers, and floating point of 16 bits or fewer."""
    return not np.issubdtype(dtype, np.inexact) or np.finfo(dtype).bits < 32


_POLYNOMIALS = _Polynomials()
