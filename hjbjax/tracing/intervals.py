"""Interval arithmetic with outward rounding on NumPy arrays in float64: results contain all values of an operation.

Sums, products, quotients and square roots of IEEE arithmetic are correctly rounded, so one unit in the last place is
added on either side. Library functions are assumed to be correct to ``LIBRARY`` units, twice what NumPy documents, and
the special functions of SciPy to ``SPECIAL``. A function is evaluated on the part of an interval where it is defined.

Booleans are pairs too: ``lo`` is True where a comparison certainly holds, ``hi`` where it may hold.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
T = TypeVar("T")

EPS = float(np.finfo(np.float64).eps)
TINY = 5e-324  # the unit of the smallest numbers
LIBRARY = 8 * EPS  # relative error of a function of NumPy
SPECIAL = 1e-12  # relative and absolute error of a special function of SciPy
SHORT = 8192  # numbers in a short array
LARGE = 1e8  # angles above this size are not reduced
LEAST_OF_LGAMMA = 1.4616321449683623, -0.12148629053584961  # where lgamma is least on x > 0, and its value there
LARGEST_OF_I1E = 0.2191  # bessel_i1e is largest between 1.5 and 1.6


@dataclasses.dataclass(frozen=True, eq=False, slots=True)
class Interval:
    """All numbers from ``lo`` to ``hi``, two arrays of the same shape."""

    lo: np.ndarray
    hi: np.ndarray

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Both bounds."""
        return self.lo, self.hi

    def __add__(self, other: Interval) -> Interval:
        return outward(self.lo + other.lo, self.hi + other.hi)

    def __sub__(self, other: Interval) -> Interval:
        return outward(self.lo - other.hi, self.hi - other.lo)

    def __neg__(self) -> Interval:
        return Interval(-self.hi, -self.lo)

    def __mul__(self, other: Interval) -> Interval:
        for factor, one in ((self, other), (other, self)):
            if one is ONE:  # the derivative of a coordinate and of a sum: no arithmetic, and no rounding
                return factor
        return _hull_of(operator.mul, self, other)

    def __truediv__(self, other: Interval) -> Interval:
        found = _hull_of(operator.truediv, self, other)
        through = (other.lo <= 0) & (other.hi >= 0)
        return Interval(np.where(through, -np.inf, found.lo), np.where(through, np.inf, found.hi))

    def __abs__(self) -> Interval:
        far = np.maximum(np.abs(self.lo), np.abs(self.hi))
        near = np.where((self.lo <= 0) & (self.hi >= 0), 0.0, np.minimum(np.abs(self.lo), np.abs(self.hi)))
        return Interval(near, far)

    def minimum(self, other: Interval) -> Interval:
        """The smaller of two numbers."""
        return Interval(np.minimum(self.lo, other.lo), np.minimum(self.hi, other.hi))

    def maximum(self, other: Interval) -> Interval:
        """The larger of two numbers."""
        return Interval(np.maximum(self.lo, other.lo), np.maximum(self.hi, other.hi))

    def scaled(self, factor: float | np.ndarray) -> Interval:
        """The product with a positive number."""
        return outward(self.lo * factor, self.hi * factor)


def quietly(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator of functions that compute with intervals: infinite bounds are no reason for a warning."""

    @functools.wraps(function)
    def called(*arguments: P.args, **options: P.kwargs) -> T:
        with np.errstate(all="ignore"):  # once, because it takes as long as an operation on a thousand numbers
            return function(*arguments, **options)

    return called


def point(value: object) -> Interval:
    """The interval of one number; booleans stay booleans."""
    array = np.asarray(value)
    array = array if array.dtype == bool else array.astype(np.float64)
    return Interval(array, array)


ONE = point(1.0)


def entire(like: Interval) -> Interval:
    """All numbers."""
    shape = np.broadcast(like.lo, like.hi).shape
    return Interval(np.full(shape, -np.inf), np.full(shape, np.inf))


def outward(lo: np.ndarray, hi: np.ndarray, relative: float = 0.0, absolute: float = 0.0) -> Interval:
    """Bounds moved outward by their rounding error; NaN, as in ∞ − ∞, becomes infinite.

    A number of size m has units in the last place of at most m · EPS, so the bounds move by a unit or more. This is
    eight times faster than ``np.nextafter``.
    """
    below, above = _moved(lo, hi, EPS + relative, absolute + TINY)
    if have_nan(below, above):
        below, above = np.where(np.isnan(below), -np.inf, below), np.where(np.isnan(above), np.inf, above)
    return Interval(below, above)


def _moved(lo: np.ndarray, hi: np.ndarray, relative: float, absolute: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounds moved outward by a relative and an absolute error."""
    below, above = np.abs(lo), np.abs(hi)
    below *= -relative  # in place, because new arrays take a third of the time
    above *= relative
    below -= absolute
    above += absolute
    below += lo
    above += hi
    return below, above


def have_nan(x: np.ndarray, y: np.ndarray) -> bool:
    """True if any number is NaN; it may also be True if any number is infinite."""
    # a short scalar product is three times faster than a sum; BLAS computes a long one on several threads
    if np.shape(x) == np.shape(y) and np.size(x) <= SHORT:
        return bool(np.isnan(np.vdot(x, y)))
    return bool(np.isnan(np.sum(x)) or np.isnan(np.sum(y)))


def _hull_of(operation: Callable, left: Interval, right: Interval) -> Interval:
    """The hull of an operation on all four pairs of ends, for an operation that is monotone in each operand."""
    if operation is operator.mul:
        for number, other in ((left, right), (right, left)):
            if number.lo is number.hi and np.size(number.lo) == 1 and 0 < number.lo < np.inf:
                return other.scaled(number.lo)
    if left.lo is left.hi:
        pairs = [(left.lo, right.lo), (left.lo, right.hi)]
    elif right.lo is right.hi:
        pairs = [(left.lo, right.lo), (left.hi, right.lo)]
    else:
        pairs = [(a, b) for a in left.ends for b in right.ends]
    ends = [operation(a, b) for a, b in pairs]
    lo, hi = ends[0], ends[0]
    for end in ends[1:]:
        lo, hi = np.minimum(lo, end), np.maximum(hi, end)
    below, above = _moved(lo, hi, EPS, TINY)
    if not have_nan(below, above):
        return Interval(below, above)
    # 0 · ∞ is 0: the infinite end of an interval is not one of its numbers
    ends = [np.where(np.isnan(end), 0.0, end) for end in ends]
    return outward(functools.reduce(np.minimum, ends), functools.reduce(np.maximum, ends))


def union(*parts: Interval) -> Interval:
    """The hull of several intervals."""
    lo, hi = parts[0].ends
    for part in parts[1:]:
        lo, hi = np.minimum(lo, part.lo), np.maximum(hi, part.hi)
    return Interval(lo, hi)


def meet(left: Interval, right: Interval) -> Interval:
    """The common part of two intervals that contain the same number."""
    return Interval(np.maximum(left.lo, right.lo), np.minimum(left.hi, right.hi))


def where(which: np.ndarray, yes: Interval, no: Interval) -> Interval:
    """One of two intervals, entry by entry."""
    return Interval(np.where(which, yes.lo, no.lo), np.where(which, yes.hi, no.hi))


def squared(x: Interval) -> Interval:
    """x²."""
    return power(x, 2)


def power(x: Interval, exponent: int) -> Interval:
    """x^k for an integer k of either sign."""
    if exponent < 0:
        return point(1.0) / power(x, -exponent)
    if exponent == 0:
        return point(np.ones(np.shape(x.lo)))
    base = abs(x) if exponent % 2 == 0 else x
    # repeated multiplication rounds once per factor
    return _no_less(outward(base.lo**exponent, base.hi**exponent, exponent * LIBRARY), exponent % 2 == 0)


def _no_less(x: Interval, nonnegative: bool) -> Interval:
    return Interval(np.maximum(x.lo, 0.0), x.hi) if nonnegative else x


def monotone(
    function: Callable,
    lo: float = -np.inf,
    hi: float = np.inf,
    *,
    falls: bool = False,
    error: float = LIBRARY,
    least: float = -np.inf,
    largest: float = np.inf,
) -> Callable[[Interval], Interval]:
    """The rule of a monotone function.

    Args:
      function: the function in NumPy.
      lo, hi: the interval on which it is defined.
      falls: True if it decreases.
      error: its relative error; from ``SPECIAL`` on also its absolute error.
      least, largest: its limits.
    """

    def rule(x: Interval) -> Interval:
        ends = [function(np.clip(end, lo, hi)) for end in x.ends]
        low, high = ends[::-1] if falls else ends
        found = outward(low, high, error, SPECIAL if error >= SPECIAL else 0.0)
        return Interval(np.clip(found.lo, least, largest), np.clip(found.hi, least, largest))

    return rule


def sine(x: Interval) -> Interval:
    """sin x."""
    return _wave(x, np.sin, 0.25)


def cosine(x: Interval) -> Interval:
    """cos x."""
    return _wave(x, np.cos, 0.0)


def _wave(x: Interval, function: Callable, top: float) -> Interval:
    """A sine or a cosine, whose largest values are at (top + k) periods."""
    turn = 2 * np.pi
    ends = [function(end) for end in x.ends]
    slack = 1e-12 + 4 * EPS * np.maximum(np.abs(x.lo), np.abs(x.hi))
    lo, hi = (x.lo - slack) / turn, (x.hi + slack) / turn
    # the number of a largest value, and of a smallest one half a period later, between the ends
    peak = np.floor(hi - top) >= np.ceil(lo - top)
    valley = np.floor(hi - top - 0.5) >= np.ceil(lo - top - 0.5)
    unknown = ~(np.maximum(np.abs(x.lo), np.abs(x.hi)) < LARGE)
    found = outward(np.minimum(*ends), np.maximum(*ends), LIBRARY)
    low = np.where(valley | unknown, -1.0, np.maximum(found.lo, -1.0))
    return Interval(low, np.where(peak | unknown, 1.0, np.minimum(found.hi, 1.0)))


def tangent(x: Interval) -> Interval:
    """tan x; all numbers if there may be a pole."""
    slack = 1e-12 + 4 * EPS * np.maximum(np.abs(x.lo), np.abs(x.hi))
    pole = np.floor((x.hi + slack) / np.pi - 0.5) >= np.ceil((x.lo - slack) / np.pi - 0.5)
    pole |= ~(np.maximum(np.abs(x.lo), np.abs(x.hi)) < LARGE)
    return where(pole, entire(x), monotone(np.tan)(x))


def hyperbolic_cosine(x: Interval) -> Interval:
    """cosh x."""
    return monotone(np.cosh, least=1.0)(abs(x))


def angle(y: Interval, x: Interval) -> Interval:
    """atan2(y, x); the whole circle if the box may meet the half line where the angle jumps."""
    corners = [np.arctan2(b, a) for a in x.ends for b in y.ends]
    found = outward(np.minimum.reduce(corners), np.maximum.reduce(corners), LIBRARY)
    return where(meets_the_cut(y, x), outward(np.full_like(found.lo, -np.pi), np.full_like(found.lo, np.pi)), found)


def meets_the_cut(y: Interval, x: Interval) -> np.ndarray:
    """True if atan2 may jump."""
    return (x.lo <= 0) & (y.lo <= 0) & (y.hi >= 0)


def general_power(x: Interval, y: Interval) -> Interval:
    """x^y for x ≥ 0, and for any x if y is the same integer everywhere."""
    if np.all(y.lo == y.hi) and np.all(y.lo == np.round(y.lo)) and np.size(np.unique(y.lo)) == 1:
        return power(x, int(np.ravel(y.lo)[0]))
    ends = [np.clip(a, 0, np.inf) ** b for a in x.ends for b in y.ends]
    found = outward(np.minimum.reduce(ends), np.maximum.reduce(ends), LIBRARY)
    return _no_less(found, True)


def remainder(x: Interval, y: Interval) -> Interval:
    """The remainder of a division that rounds to zero; all remainders if the quotient is not the same everywhere."""
    whole = quotient(x, y)
    bound = abs(y).hi
    every = Interval(np.where(x.lo < 0, -bound, 0.0), np.where(x.hi > 0, bound, 0.0))
    found = x - y * Interval(whole.lo, whole.lo)
    return where(whole.lo == whole.hi, meet(found, every), every)


def quotient(x: Interval, y: Interval) -> Interval:
    """x/y rounded to zero."""
    found = x / y
    return Interval(np.trunc(found.lo), np.trunc(found.hi))


def is_one_quotient(x: Interval, y: Interval) -> np.ndarray:
    """True if the division rounds to the same integer everywhere, and is finite."""
    whole = quotient(x, y)
    return (whole.lo == whole.hi) & np.isfinite(whole.lo)


def log_gamma(x: Interval) -> Interval:
    """log |Γ(x)|; all numbers where x may be ≤ 0."""
    from scipy.special import gammaln

    place, bottom = LEAST_OF_LGAMMA
    ends = [gammaln(end) for end in x.ends]
    found = outward(np.minimum(*ends), np.maximum(*ends), SPECIAL, SPECIAL)
    low = np.where((x.lo <= place) & (x.hi >= place), bottom - SPECIAL, found.lo)
    return where(x.lo > 0, Interval(low, found.hi), entire(x))


def bessel_i0e(x: Interval) -> Interval:
    """exp(−|x|) I₀(x)."""
    from scipy.special import i0e

    return monotone(i0e, falls=True, error=SPECIAL, least=0.0)(abs(x))


def bessel_i1e(x: Interval) -> Interval:
    """exp(−|x|) I₁(x)."""
    from scipy.special import i1e

    ends = [i1e(end) for end in x.ends]
    found = outward(np.minimum(*ends), np.maximum(*ends), SPECIAL, SPECIAL)
    high = np.where((x.lo <= 1.6) & (x.hi >= 1.5), LARGEST_OF_I1E, found.hi)
    return Interval(np.where((x.lo <= -1.5) & (x.hi >= -1.6), -LARGEST_OF_I1E, found.lo), high)


def square_root(x: Interval) -> Interval:
    """√x."""
    return monotone(np.sqrt, 0.0, least=0.0)(x)


def logistic(x: Interval) -> Interval:
    """1/(1 + exp(−x))."""
    found = point(1.0) / (point(1.0) + monotone(np.exp, least=0.0)(-x))
    return Interval(np.maximum(found.lo, 0.0), np.minimum(found.hi, 1.0))


def special(
    name: str, lo: float = -np.inf, hi: float = np.inf, *, falls: bool = False, least: float = -np.inf,
    largest: float = np.inf,
) -> Callable[[Interval], Interval]:  # fmt: skip
    """The rule of a monotone function of ``scipy.special``, which is imported on first use."""

    def function(x: np.ndarray) -> np.ndarray:
        import scipy.special

        return getattr(scipy.special, name)(x)

    return monotone(function, lo, hi, falls=falls, error=SPECIAL, least=least, largest=largest)


def bell(x: Interval) -> Interval:
    """2 exp(−x²)/√π, the derivative of erf."""
    found = monotone(np.exp, least=0.0)(-squared(x))
    factor = 2 / np.sqrt(np.pi)
    return outward(found.lo * factor, found.hi * factor, LIBRARY)


def digamma(x: Interval) -> Interval:
    """The derivative of log Γ; all numbers where x may be ≤ 0."""
    return where(x.lo > 0, special("digamma", 1e-300)(x), entire(x))


def trigamma(x: Interval) -> Interval:
    """The second derivative of log Γ; all numbers where x may be ≤ 0."""
    from scipy.special import polygamma

    falls = monotone(lambda end: polygamma(1, end), 1e-300, falls=True, error=SPECIAL, least=0.0)
    return where(x.lo > 0, falls(x), entire(x))


logarithm_of_two = outward(np.log(np.array(2.0)), np.log(np.array(2.0)))
