"""Ranges of a function over boxes by Taylor's theorem: the interval evaluator of components.

A scalar has its range over the box, its value and its gradient at the centre c, and ranges of its first and second
derivatives over the box. Then

    f(x) ∈ f(c) + Σ_i ∂_i f(c) (x_i − c_i) + ½ Σ_ij [∂_ij f] (x_i − c_i)(x_j − c_j),

which is narrow for a difference of large terms that nearly cancel, such as a defect: if f is constant, the width of
the result falls with the third power of the width of the box. With the range of the gradient instead of its value at c
it is the mean value theorem, which also holds at kinks: the derivative there is the hull of the derivatives on both
sides, and the second derivative the whole line. Where a function may jump both are the whole line.

All bounds are rounded outward, see ``intervals``. The rules are those of real arithmetic: a conversion to float32 does
not round.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import as_partial, remembered
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Numbers
from hjbjax.tracing import intervals as iv
from hjbjax.tracing.interpreter import Algebra, entry_by_entry, evaluate_jaxpr, lift, pack
from hjbjax.tracing.intervals import Interval, entire, monotone, outward, point, power, squared, union
from hjbjax.tracing.jaxprs import CALLS, CUMULATIVE, MOVES, REDUCTIONS, SCATTERS, array_type, without_repetitions
from hjbjax.tracing.stacks import varies

if TYPE_CHECKING:
    from jax.extend import core as jex

Slopes = tuple[Interval | None, ...]  # one derivative per coordinate; None is zero
Curvature = dict[tuple[int, int], Interval]  # second derivatives with i ≤ j; those left out are zero


@dataclasses.dataclass(frozen=True, eq=False, slots=True)
class Form:
    """A scalar over boxes.

    Attributes:
      range: its range over each box.
      centre: its value at the centre of each box.
      slopes: the ranges of its derivatives with respect to every coordinate of the boxes; empty for a constant.
      gradient: its derivatives at the centre.
      curvature: the ranges of its second derivatives.
    """

    range: Interval
    centre: Interval
    slopes: Slopes = ()
    gradient: Slopes = ()
    curvature: Curvature = dataclasses.field(default_factory=dict)

    def __add__(self, other: Form) -> Form:
        return _linear(operator.add, (1, 1), self, other)

    def __sub__(self, other: Form) -> Form:
        return _linear(operator.sub, (1, -1), self, other)

    def __neg__(self) -> Form:
        return _linear(operator.neg, (-1,), self)

    def __mul__(self, other: Form) -> Form:
        if self is other:  # narrower than the product of two unrelated factors
            return powers(self, 2)
        for factor, one in ((self, other), (other, self)):
            if one.range is one.centre and np.size(one.range.lo) == 1 and one.range.lo == one.range.hi == 1:
                return factor
        return apply(operator.mul, lambda a, b: (b, a), lambda a, b: {(0, 1): _ONE}, self, other)

    def __truediv__(self, other: Form) -> Form:
        if not other.slopes:
            return self * Form(_ONE / other.range, _ONE / other.centre)
        return apply(
            operator.truediv,
            lambda a, b: (_ONE / b, -(a / squared(b))),
            lambda a, b: {(0, 1): -(_ONE / squared(b)), (1, 1): (a / power(b, 3)).scaled(2.0)},
            self, other,
        )  # fmt: skip

    def bounds(self, radii: Sequence[np.ndarray]) -> Interval:
        """The range by Taylor's theorem of first and of second order, over boxes with these half widths."""
        first, second = _Distance(), _Distance()
        for slope, at_centre, radius in zip(self.slopes, self.gradient, radii, strict=False):
            for total, each in ((first, slope), (second, at_centre)):
                if each is not None:
                    total.add(each, radius)
        for (i, j), curvature in self.curvature.items():
            second.add(curvature, radii[i] * radii[j] / (2 if i == j else 1) + iv.TINY, rises=i == j)
        return iv.meet(iv.meet(first.around(self.centre), second.around(self.centre)), self.range)


class _Distance:
    """Upper bounds of the distances below and above a number, as sums of products of numbers that are not negative."""

    def __init__(self) -> None:
        self.below: np.ndarray = np.zeros(())
        self.above: np.ndarray = np.zeros(())
        self.count = 0

    def add(self, factor: Interval, size: np.ndarray, *, rises: bool = False) -> None:
        """Add a factor times any number of at most this absolute value, or from zero to this value if it ``rises``."""
        if rises:
            below, above = (np.maximum(end, 0.0) * size for end in (-factor.lo, factor.hi))
        else:
            below = above = abs(factor).hi * size
        if iv.have_nan(below, above):  # 0 · ∞ is 0, as in a product of intervals
            below, above = (np.where(size == 0, 0.0, each) for each in (below, above))
        self.below, self.above, self.count = self.below + below, self.above + above, self.count + 1

    def around(self, centre: Interval) -> Interval:
        """The numbers within these distances."""
        error = (self.count + 4) * iv.EPS  # each product is rounded at most three times, and each sum once per term
        return outward(
            centre.lo - (self.below * (1 + error) + self.count * iv.TINY),
            centre.hi + (self.above * (1 + error) + self.count * iv.TINY),
        )


def constant(value: object) -> Form:
    """A number that holds everywhere."""
    exact = point(value)
    return Form(exact, exact)


def coordinates(boxes: Sequence[Interval], centres: Sequence[Interval], count: int, first: int = 0) -> list[Form]:
    """The coordinates of boxes as scalars.

    Args:
      boxes: the range of every coordinate.
      centres: the centre of every coordinate.
      count: the number of coordinates with respect to which to differentiate.
      first: the number of the first of these coordinates.
    """
    slopes = [tuple(_ONE if i == first + k else None for i in range(count)) for k in range(len(boxes))]
    return [Form(box, centre, slope, slope) for box, centre, slope in zip(boxes, centres, slopes, strict=True)]


@iv.quietly
def taylor_forms(function: Callable | Numbers, *arguments: Any) -> np.ndarray:
    """A function of one state over boxes.

    Args:
      function: a JAX-traceable function, or a number used instead.
      *arguments: one list of scalars per vector argument, or one scalar.

    Returns:
      An object array of scalars with the shape of the function's result.

    Raises:
      ValueError: the function uses a primitive without a rule.
    """
    if not callable(function):
        return lift(np.asarray(function, float), SCALARS)
    (result,) = evaluate_jaxpr(traced(function, *arguments), [pack(argument) for argument in arguments], SCALARS)
    return lift(result, SCALARS)


def traced(function: Callable, *arguments: Any) -> jex.ClosedJaxpr:
    """The jaxpr of a function of one state in float64."""
    return _jaxpr(
        as_partial(function), *(None if not isinstance(each, (list, tuple)) else len(each) for each in arguments)
    )


@remembered
def _jaxpr(function: Callable, *lengths: int | None) -> jex.ClosedJaxpr:
    """The jaxpr for vectors of these lengths; None is a scalar."""
    with own_settings(x64=True):
        shapes = [jax.ShapeDtypeStruct(() if length is None else (length,), np.float64) for length in lengths]
        return without_repetitions(jax.make_jaxpr(function)(*shapes))


# --- rules ---


def _chain(factors: Sequence[Interval], operands: Sequence[Slopes]) -> Slopes:
    """The derivatives of a function by the chain rule, from its derivative with respect to each operand."""
    total: list[Interval | None] = [None] * max(map(len, operands))
    for factor, slopes in zip(factors, operands, strict=True):
        for i, slope in enumerate(slopes):
            if slope is not None:
                total[i] = _sum(total[i], factor * slope)
    return tuple(total)


def _sum(left: Interval | None, right: Interval) -> Interval:
    return right if left is None else left + right


def _bend(factors: Sequence[Interval], seconds: Curvature, operands: Sequence[Form]) -> Curvature:
    """The second derivatives of a function by the chain rule.

    Args:
      factors: its derivatives with respect to each operand.
      seconds: its second derivatives with respect to pairs of operands.
      operands: the operands.
    """
    total: Curvature = {}

    def put(i: int, j: int, term: Interval) -> None:
        place = (min(i, j), max(i, j))
        total[place] = _sum(total.get(place), term)

    for factor, operand in zip(factors, operands, strict=True):
        for (i, j), curvature in operand.curvature.items():
            put(i, j, factor * curvature)
    for (a, b), second in seconds.items():
        for i, left in enumerate(operands[a].slopes):
            for j, right in enumerate(operands[b].slopes):
                if left is not None and right is not None and (a != b or i <= j):
                    square = a == b and i == j
                    term = (iv.squared(left) if square else left * right) * second
                    # with a ≠ b both ∂_i a ∂_j b and ∂_j a ∂_i b occur, on the diagonal of (i, j) twice
                    put(i, j, term.scaled(2.0) if a != b and i == j else term)
    return total


def apply(
    function: Callable[..., Interval],
    derivatives: Callable[..., Sequence[Interval]],
    seconds: Callable[..., Curvature],
    *operands: Form,
) -> Form:
    """A function of scalars, given on intervals.

    Args:
      function: its range.
      derivatives: the ranges of its derivatives with respect to each operand.
      seconds: the ranges of its second derivatives with respect to pairs of operands; pairs left out are zero.
      *operands: the operands.
    """
    ranges = [each.range for each in operands]
    found = function(*ranges)
    if all(each.centre is each.range for each in operands):
        return Form(found, found)
    centres = [each.centre for each in operands]
    if not any(each.slopes for each in operands):
        return Form(found, function(*centres))
    factors = derivatives(*ranges)
    return Form(
        found, function(*centres), _chain(factors, [each.slopes for each in operands]),
        _chain(derivatives(*centres), [each.gradient for each in operands]), _bend(factors, seconds(*ranges), operands),
    )  # fmt: skip


def _linear(function: Callable[..., Interval], signs: Sequence[int], *operands: Form) -> Form:
    """A sum or a difference."""

    def signed(sign: int, slope: Interval) -> Interval:
        return slope if sign > 0 else -slope

    def total(rows: Sequence[Slopes]) -> Slopes:
        found: list[Interval | None] = [None] * max(map(len, rows))
        for sign, row in zip(signs, rows, strict=True):
            for i, slope in enumerate(row):
                if slope is not None:
                    found[i] = _sum(found[i], signed(sign, slope))
        return tuple(found)

    curvature: Curvature = {}
    for sign, each in zip(signs, operands, strict=True):
        for place, term in each.curvature.items():
            curvature[place] = _sum(curvature.get(place), signed(sign, term))
    found = function(*(each.range for each in operands))
    if all(each.centre is each.range for each in operands):
        return Form(found, found)
    return Form(
        found, function(*(each.centre for each in operands)), total([each.slopes for each in operands]),
        total([each.gradient for each in operands]), curvature,
    )  # fmt: skip


def powers(x: Form, exponent: int) -> Form:
    """x^k for an integer k."""
    if exponent == 1:
        return x
    first, second = point(float(exponent)), point(float(exponent * (exponent - 1)))
    return apply(
        lambda a: power(a, exponent),
        lambda a: (first * power(a, exponent - 1),),
        lambda a: {(0, 0): second * power(a, exponent - 2)} if exponent else {},
        x,
    )


def minimum(*parts: Form) -> Form:
    """The smallest of several scalars."""
    found = parts[0]
    for part in parts[1:]:
        found = apply(Interval.minimum, lambda a, b: _weights(a.hi <= b.lo, b.hi <= a.lo), _kink_of_two, found, part)
    return found


def maximum(left: Form, right: Form) -> Form:
    """The larger of two scalars."""
    return apply(Interval.maximum, lambda a, b: _weights(a.lo >= b.hi, b.lo >= a.hi), _kink_of_two, left, right)


def norm(b: Sequence[Form]) -> Form:
    """The Euclidean norm. Where it may be zero, its derivative is the range over all directions."""

    def function(*ranges: Interval) -> Interval:
        total = squared(ranges[0])
        for each in ranges[1:]:
            total = total + squared(each)
        return iv.square_root(Interval(np.maximum(total.lo, 0.0), total.hi))

    def derivatives(*ranges: Interval) -> list[Interval]:
        length = function(*ranges)
        found = [each / length for each in ranges]
        return [Interval(np.maximum(each.lo, -1.0), np.minimum(each.hi, 1.0)) for each in found]

    def seconds(*ranges: Interval) -> Curvature:
        length = function(*ranges)
        cubed = power(length, 3)
        found: Curvature = {}
        for i, j in itertools.combinations_with_replacement(range(len(ranges)), 2):
            found[i, j] = -(ranges[i] * ranges[j] / cubed)
            if i == j:
                others = point(0.0)
                for k, other in enumerate(ranges):
                    if k != i:
                        others = others + squared(other)
                found[i, j] = others / cubed
        return found

    return apply(function, derivatives, seconds, *b)


def _weights(first: np.ndarray, second: np.ndarray) -> tuple[Interval, Interval]:
    """The derivatives with respect to two operands of which one is the result, in part or on both sides of a kink."""
    return Interval(np.where(first, 1.0, 0.0), np.where(second, 0.0, 1.0)), Interval(
        np.where(second & ~first, 1.0, 0.0), np.where(first, 0.0, 1.0)
    )


def _kink_of_two(a: Interval, b: Interval) -> Curvature:
    """The second derivatives of a maximum or a minimum: unknown where both operands may be the result."""
    kink = _unknown((a.hi > b.lo) & (b.hi > a.lo))
    return {(0, 0): kink, (0, 1): kink, (1, 1): kink}


def _unknown(where: np.ndarray) -> Interval:
    """The whole line at some boxes, and zero at the others."""
    return Interval(np.where(where, -np.inf, 0.0), np.where(where, np.inf, 0.0))


def _signs(x: Interval) -> Interval:
    """The derivative of |x|."""
    return Interval(np.where(x.lo >= 0, 1.0, -1.0), np.where(x.hi <= 0, -1.0, 1.0))


def _kink(x: Interval) -> Interval:
    """The second derivative of |x|."""
    return _unknown((x.lo < 0) & (x.hi > 0))


def _reciprocal_root(x: Interval) -> Interval:
    return _ONE / iv.square_root(x)


_ONE = iv.ONE
_LOG2 = iv.logarithm_of_two
_NO_BEND = point(0.0)
_exp, _sinh = monotone(np.exp, least=0.0), monotone(np.sinh)

Derivative = Callable[[Interval, Interval], Interval]

# range, derivative and second derivative of the functions of one number x; derivatives also take the result y
SMOOTH: dict[str, tuple[Callable[[Interval], Interval], Derivative, Derivative]] = {
    "neg": (lambda x: -x, lambda x, y: -_ONE, lambda x, y: _NO_BEND),
    "abs": (abs, lambda x, y: _signs(x), lambda x, y: _kink(x)),
    "square": (squared, lambda x, y: x.scaled(2.0), lambda x, y: point(2.0)),
    "one_minus_square": (lambda x: _ONE - squared(x), lambda x, y: -x.scaled(2.0), lambda x, y: point(-2.0)),
    "sqrt": (iv.square_root, lambda x, y: point(0.5) / y, lambda x, y: point(-0.25) / (y * x)),
    "rsqrt": (_reciprocal_root, lambda x, y: point(-0.5) * power(y, 3), lambda x, y: point(0.75) * power(y, 5)),
    "cbrt": (
        monotone(np.cbrt), lambda x, y: _ONE / squared(y).scaled(3.0),
        lambda x, y: point(-2.0) / power(y, 5).scaled(9.0),
    ),
    "exp": (_exp, lambda x, y: y, lambda x, y: y),
    "exp2": (monotone(np.exp2, least=0.0), lambda x, y: y * _LOG2, lambda x, y: y * squared(_LOG2)),
    "expm1": (monotone(np.expm1, least=-1.0), lambda x, y: _exp(x), lambda x, y: _exp(x)),
    "log": (monotone(np.log, 0.0), lambda x, y: _ONE / x, lambda x, y: -(_ONE / squared(x))),
    "log1p": (
        monotone(np.log1p, -1.0), lambda x, y: _ONE / (_ONE + x), lambda x, y: -(_ONE / squared(_ONE + x))
    ),
    "log2": (
        monotone(np.log2, 0.0), lambda x, y: _ONE / (x * _LOG2), lambda x, y: -(_ONE / (squared(x) * _LOG2))
    ),
    "sin": (iv.sine, lambda x, y: iv.cosine(x), lambda x, y: -y),
    "cos": (iv.cosine, lambda x, y: -iv.sine(x), lambda x, y: -y),
    "tan": (iv.tangent, lambda x, y: _ONE + squared(y), lambda x, y: (y * (_ONE + squared(y))).scaled(2.0)),
    "asin": (
        monotone(np.arcsin, -1.0, 1.0), lambda x, y: _ONE / iv.square_root(_ONE - squared(x)),
        lambda x, y: x / power(iv.square_root(_ONE - squared(x)), 3),
    ),
    "acos": (
        monotone(np.arccos, -1.0, 1.0, falls=True), lambda x, y: -(_ONE / iv.square_root(_ONE - squared(x))),
        lambda x, y: -(x / power(iv.square_root(_ONE - squared(x)), 3)),
    ),
    "atan": (
        monotone(np.arctan), lambda x, y: _ONE / (_ONE + squared(x)),
        lambda x, y: -(x.scaled(2.0) / squared(_ONE + squared(x))),
    ),
    "sinh": (_sinh, lambda x, y: iv.hyperbolic_cosine(x), lambda x, y: y),
    "cosh": (iv.hyperbolic_cosine, lambda x, y: _sinh(x), lambda x, y: y),
    "tanh": (
        monotone(np.tanh, least=-1.0, largest=1.0), lambda x, y: _ONE - squared(y),
        lambda x, y: -(y * (_ONE - squared(y))).scaled(2.0),
    ),
    "asinh": (
        monotone(np.arcsinh), lambda x, y: _ONE / iv.square_root(_ONE + squared(x)),
        lambda x, y: -(x / power(iv.square_root(_ONE + squared(x)), 3)),
    ),
    "acosh": (
        monotone(np.arccosh, 1.0, least=0.0), lambda x, y: _ONE / iv.square_root(squared(x) - _ONE),
        lambda x, y: -(x / power(iv.square_root(squared(x) - _ONE), 3)),
    ),
    "atanh": (
        monotone(np.arctanh, -1.0, 1.0), lambda x, y: _ONE / (_ONE - squared(x)),
        lambda x, y: x.scaled(2.0) / squared(_ONE - squared(x)),
    ),
    "logistic": (
        iv.logistic, lambda x, y: y * (_ONE - y), lambda x, y: y * (_ONE - y) * (_ONE - y.scaled(2.0))
    ),
    "erf": (
        iv.special("erf", least=-1.0, largest=1.0), lambda x, y: iv.bell(x), lambda x, y: -(x * iv.bell(x)).scaled(2.0)
    ),
    "erfc": (
        iv.special("erfc", falls=True, least=0.0, largest=2.0), lambda x, y: -iv.bell(x),
        lambda x, y: (x * iv.bell(x)).scaled(2.0),
    ),
    "erf_inv": (
        iv.special("erfinv", -1.0, 1.0), lambda x, y: _ONE / iv.bell(y),
        lambda x, y: y.scaled(2.0) / squared(iv.bell(y)),
    ),
    "digamma": (iv.digamma, lambda x, y: iv.trigamma(x), lambda x, y: entire(x)),
    "lgamma": (iv.log_gamma, lambda x, y: iv.digamma(x), lambda x, y: iv.trigamma(x)),
    "bessel_i0e": (iv.bessel_i0e, lambda x, y: iv.bessel_i1e(x) - _signs(x) * y, lambda x, y: entire(x)),
    "bessel_i1e": (iv.bessel_i1e, lambda x, y: entire(x), lambda x, y: entire(x)),
}  # fmt: skip
STEPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {  # constant between jumps, and monotone
    "floor": np.floor, "ceil": np.ceil, "sign": np.sign,
}  # fmt: skip
SAME = frozenset({"copy", "copy_p", "real", "stop_gradient"})
BINARY: dict[str, Callable[[Form, Form], Form]] = {
    "add": operator.add, "add_any": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
    "min": minimum, "max": maximum,
}  # fmt: skip
COMPARISONS: dict[str, Callable[[Interval, Interval], Interval]] = {
    "lt": lambda a, b: Interval(a.hi < b.lo, a.lo < b.hi),
    "le": lambda a, b: Interval(a.hi <= b.lo, a.lo <= b.hi),
    "gt": lambda a, b: Interval(a.lo > b.hi, a.hi > b.lo),
    "ge": lambda a, b: Interval(a.lo >= b.hi, a.hi >= b.lo),
    "eq": lambda a, b: Interval((a.lo == b.hi) & (a.hi == b.lo), (a.lo <= b.hi) & (b.lo <= a.hi)),
    "ne": lambda a, b: Interval((a.hi < b.lo) | (b.hi < a.lo), ~((a.lo == b.hi) & (a.hi == b.lo))),
    "and": lambda a, b: Interval(a.lo & b.lo, a.hi & b.hi),
    "or": lambda a, b: Interval(a.lo | b.lo, a.hi | b.hi),
    "xor": lambda a, b: Interval((a.lo & ~b.hi) | (~a.hi & b.lo), (a.hi & ~b.lo) | (~a.lo & b.hi)),
}
COMBINED: dict[Callable, Callable[[Form, Form], Form]] = {
    jax.lax.add: operator.add, jax.lax.sub: operator.sub, jax.lax.mul: operator.mul, jax.lax.min: minimum,
    jax.lax.max: maximum,
}  # fmt: skip


def jumping(function: Callable[..., Interval], *operands: Form) -> Form:
    """A function that is constant except where it jumps, such as a comparison."""

    def derivatives(*ranges: Interval) -> list[Interval]:
        found = function(*ranges)
        return [_unknown(found.lo != found.hi)] * len(ranges)

    def seconds(*ranges: Interval) -> Curvature:
        jump = derivatives(*ranges)[0]
        return {(a, b): jump for a in range(len(ranges)) for b in range(a, len(ranges))}

    return apply(function, derivatives, seconds, *operands)


def _rounded(x: Form, params: dict) -> Form:
    """``round`` to integers, and conversions to integers, which round towards zero."""
    if "rounding_method" not in params:
        function: Callable = np.trunc
    elif params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        function = np.round
    else:
        function = lambda end: np.sign(end) * np.floor(np.abs(end) + 0.5)  # noqa: E731
    return jumping(lambda a: Interval(function(a.lo), function(a.hi)), x)


def _converted(x: Form, kind: np.dtype) -> Form:
    """A conversion between kinds of numbers; between floating-point types it changes nothing."""
    if x.range.lo.dtype.kind == "b":
        if kind.kind == "b":
            return x
        numbers = (Interval(each.lo.astype(float), each.hi.astype(float)) for each in (x.range, x.centre))
        return dataclasses.replace(x, range=next(numbers), centre=next(numbers))
    if kind.kind == "b":
        return jumping(COMPARISONS["ne"], x, constant(0.0))
    return x if np.issubdtype(kind, np.floating) else _rounded(x, {})


def selected(which: Form, cases: Sequence[Form]) -> Form:
    """``select_n``: one of several cases; the derivatives are unknown where the choice may change within a box."""
    zero = point(0.0)

    def hull(choice: Interval, parts: Sequence[Interval | None]) -> Interval | None:
        if all(part is None for part in parts):
            return None
        return _hull_of_cases(choice, [zero if part is None else part for part in parts])

    def slopes(choice: Interval, kind: str) -> Slopes:
        rows = [getattr(case, kind) for case in cases]
        jumps = _chain([_unknown(choice.lo != choice.hi)], [getattr(which, kind)])
        found = []
        for i in range(max(len(jumps), *map(len, rows))):
            slope, jump = hull(choice, [row[i] if row else None for row in rows]), jumps[i] if jumps else None
            found.append(slope if jump is None else _sum(slope, jump))
        return tuple(found)

    jump = _unknown(which.range.lo != which.range.hi)
    curvature = _bend([jump], {(0, 0): jump}, [which])
    for place in {place: None for case in cases for place in case.curvature}:
        found = hull(which.range, [case.curvature.get(place) for case in cases])
        assert found is not None
        curvature[place] = _sum(curvature.get(place), found)
    found, centre = (
        _hull_of_cases(getattr(which, kind), [getattr(case, kind) for case in cases]) for kind in ("range", "centre")
    )
    return Form(found, centre, slopes(which.range, "slopes"), slopes(which.centre, "gradient"), curvature)


def _hull_of_cases(choice: Interval, parts: Sequence[Interval]) -> Interval:
    """The hull of the cases that may be chosen."""
    # infinite bounds of an index would become arbitrary integers
    first, last = (np.clip(np.asarray(end, float), 0, len(parts) - 1).astype(int) for end in choice.ends)
    total: Interval | None = None
    is_boolean = parts[0].lo.dtype == bool
    for k, part in enumerate(parts):
        may = (first <= k) & (k <= last)
        # a case that is not chosen must not count: it is neither certain nor possible
        own = (
            Interval(part.lo | ~may, part.hi & may)
            if is_boolean
            else Interval(np.where(may, part.lo, np.inf), np.where(may, part.hi, -np.inf))
        )
        if total is None:
            total = own
        elif is_boolean:
            total = Interval(total.lo & own.lo, total.hi | own.hi)
        else:
            total = union(total, own)
    assert total is not None
    return total


def _remainder(x: Form, y: Form) -> Form:
    """``rem``, which jumps where the quotient passes an integer."""

    def derivatives(a: Interval, b: Interval) -> tuple[Interval, Interval]:
        one = iv.is_one_quotient(a, b)
        whole = entire(Interval(one, one))
        return iv.where(one, _ONE, whole), iv.where(one, -iv.quotient(a, b), whole)

    def seconds(a: Interval, b: Interval) -> Curvature:
        jump = _unknown(~iv.is_one_quotient(a, b))
        return {(0, 0): jump, (0, 1): jump, (1, 1): jump}

    return apply(iv.remainder, derivatives, seconds, x, y)


def _general_power(x: Form, y: Form) -> Form:
    """x^y."""
    exponent = y.range
    if not y.slopes and np.size(exponent.lo) == 1 and exponent.lo == np.round(exponent.lo) == exponent.hi:
        return powers(x, int(exponent.lo))
    if y.slopes:
        return _smooth("exp", y * _smooth("log", x))

    def term(a: Interval, k: int) -> Interval:
        """The k-th derivative for the same exponent everywhere."""
        factor = _ONE
        for i in range(k):
            factor = factor * (exponent - point(float(i)))
        return factor * iv.general_power(a, exponent - point(float(k)))

    return apply(lambda a: term(a, 0), lambda a: (term(a, 1),), lambda a: {(0, 0): term(a, 2)}, x)


def _smooth(name: str, x: Form) -> Form:
    """A function of one number, by the name of its primitive."""
    function, derivative, second = SMOOTH[name]
    return apply(function, lambda a: (derivative(a, function(a)),), lambda a: {(0, 0): second(a, function(a))}, x)


def _angle(y: Form, x: Form) -> Form:
    """atan2, whose derivatives are unknown where it may jump."""

    def parts(b: Interval, a: Interval) -> tuple[Interval, np.ndarray, Interval]:
        square, cut = squared(a) + squared(b), iv.meets_the_cut(b, a)
        return square, cut, entire(square)

    def derivatives(b: Interval, a: Interval) -> tuple[Interval, Interval]:
        square, cut, whole = parts(b, a)
        return iv.where(cut, whole, a / square), iv.where(cut, whole, -(b / square))

    def seconds(b: Interval, a: Interval) -> Curvature:
        square, cut, whole = parts(b, a)
        mixed, product = (squared(b) - squared(a)) / squared(square), (a * b).scaled(2.0) / squared(square)
        found = {(0, 0): -product, (0, 1): mixed, (1, 1): product}
        return {place: iv.where(cut, whole, each) for place, each in found.items()}

    return apply(iv.angle, derivatives, seconds, y, x)


class _Scalars(Algebra):
    """The algebra of scalars over boxes; refuses primitives without a rule."""

    def constant(self, value: Any, index: tuple[int, ...]) -> Form:
        return constant(np.asarray(value)[index] if np.ndim(value) else value)

    def entrywise(
        self, primitive: jex.Primitive, params: dict, operands: list[Form], dtypes: Sequence[np.dtype]
    ) -> Form:
        name, x = primitive.name, operands[0]
        if name in SAME:
            return x
        if name in SMOOTH:
            return _smooth(name, x)
        if name == "div" and not np.issubdtype(dtypes[0], np.floating):
            raise _refusal("an integer division")
        if name in BINARY:
            return BINARY[name](*operands)
        if name in COMPARISONS and all(each.range.lo.dtype == bool for each in operands) >= (name in LOGICAL):
            return jumping(COMPARISONS[name], *operands)
        if name in STEPS:
            step = STEPS[name]
            return jumping(lambda a: Interval(step(a.lo), step(a.hi)), x)
        other = OTHERS.get(name)
        if other is None or (name == "not" and x.range.lo.dtype != bool):
            raise _refusal(name)
        return other(operands, params)

    def combine(self, operation: Callable, dtype: np.dtype, left: Form, right: Form) -> Form:
        if operation in LOGICAL_REDUCTIONS and dtype.kind == "b":
            return jumping(COMPARISONS[LOGICAL_REDUCTIONS[operation]], left, right)
        if operation not in COMBINED:
            raise _refusal(getattr(operation, "__name__", str(operation)))
        return COMBINED[operation](left, right)

    def computes(self, eqn: jex.JaxprEqn) -> bool:
        """True for arithmetic with numbers that hold everywhere, whose rounding counts."""
        name = eqn.primitive.name
        if name in MOVES or not any(np.issubdtype(array_type(var).dtype, np.floating) for var in eqn.outvars):
            return False
        if not (name in KNOWN or name in CALLS or name == "cond" or name == "iota"):
            raise _refusal(name)
        return name != "iota"

    def whole(self, eqn: jex.JaxprEqn, operands: list) -> None:
        """Refuse an equation without a rule before the interpreter warns of a slow evaluation."""
        name = eqn.primitive.name
        if name not in KNOWN and name not in MOVES:
            raise _refusal(name)
        if name in MOVES or name in SCATTERS:
            moved = MOVES[name](len(operands)) if name in MOVES else (0, 2)
            if any(varies(value) for k, value in enumerate(operands) if k not in moved):
                raise _refusal(f"{name} with an index that depends on the state")

    def call(self, eqn: jex.JaxprEqn, inner: jex.ClosedJaxpr, operands: list) -> list | None:
        # its program divides by the larger number, which may be zero
        return [entry_by_entry(lambda *pair: norm(pair), operands, self)] if is_hypot(eqn, inner) else None

    def custom_jvp(self, eqn: jex.JaxprEqn, inner: jex.ClosedJaxpr, operands: list) -> list:
        # the derivatives are those of the computation: a rule of the user may differ
        return evaluate_jaxpr(inner, operands, self)

    def nodewise(self, eqn: jex.JaxprEqn, operands: list) -> list[np.ndarray]:
        raise _refusal(eqn.primitive.name)


def is_hypot(eqn: jex.JaxprEqn, inner: jex.ClosedJaxpr) -> bool:
    """True for a call of ``jnp.hypot``, whose name a function of the user may have too."""
    return eqn.params.get("name") == "hypot" and str(inner.jaxpr) == _hypot(tuple(inner.in_avals))


@functools.cache
def _hypot(types: tuple[jax.core.ShapedArray, ...]) -> str:
    """The program of ``jnp.hypot`` for operands of these types."""
    with own_settings(x64=True):
        (call,) = jax.make_jaxpr(jnp.hypot)(*types).jaxpr.eqns
    return str(call.params["jaxpr"].jaxpr)


def _refusal(name: str) -> ValueError:
    """The error for a primitive without a rule."""
    return ValueError(
        f"enclose: a function of the problem uses {name}, for which there is no interval rule. Write it with\n"
        "arithmetic, jnp.where, minimum, maximum and elementary functions of x[0], x[1], ..."
    )


OTHERS: dict[str, Callable[[list[Form], dict], Form]] = {
    "not": lambda x, params: jumping(lambda a: Interval(~a.hi, ~a.lo), *x),
    "integer_pow": lambda x, params: powers(x[0], params["y"]),
    "pow": lambda x, params: _general_power(*x),
    "atan2": lambda x, params: _angle(*x),
    "rem": lambda x, params: _remainder(*x),
    "clamp": lambda x, params: minimum(maximum(x[1], x[0]), x[2]),
    "select_n": lambda x, params: selected(x[0], x[1:]),
    "round": lambda x, params: _rounded(x[0], params),
    "convert_element_type": lambda x, params: _converted(x[0], params["new_dtype"]),
    "is_finite": lambda x, params: constant(True),  # a function is evaluated where it is defined
    "imag": lambda x, params: constant(0.0),
    "nextafter": lambda x, params: _perturbed(x[0], 1e-307, iv.EPS),
    "reduce_precision": lambda x, params: _perturbed(
        x[0], 2.0 ** (2 - 2 ** (params["exponent_bits"] - 1)), 2.0 ** -params["mantissa_bits"]
    ),
}


def _perturbed(x: Form, absolute: float, relative: float) -> Form:
    """A number moved by at most these errors, by which it jumps."""
    return apply(
        lambda a: outward(a.lo, a.hi, relative, absolute), lambda a: (entire(a),), lambda a: {(0, 0): entire(a)}, x
    )


LOGICAL = frozenset({"and", "or", "xor"})
LOGICAL_REDUCTIONS = {jax.lax.bitwise_and: "and", jax.lax.bitwise_or: "or"}
ENTRIES = frozenset({*SAME, *SMOOTH, *BINARY, *COMPARISONS, *STEPS, *OTHERS})
KNOWN = ENTRIES | frozenset({*REDUCTIONS, *CUMULATIVE, *SCATTERS, "dot_general"})
SCALARS = _Scalars()
