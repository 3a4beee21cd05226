"""The Hamiltonian over cells: H(x, p) = min over u of G(x, u) = L + f·p, with proof.

    d = β W − H(x, DW)

If G is a sum of quadratic polynomials b u + c u² of single inputs, the minimum over a box is a function of b and c with
the derivatives u* and u*², where u* is the minimiser (Danskin's theorem). A finite set is enumerated. Over a ball G may
be affine, or c|u|² plus an affine function, and over a simplex affine. In other problems the set is cut into pieces and
the control is one more coordinate of the cells.
"""

import contextlib
import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from hjbjax.enclosure.cell_functions import Cell, cost_form, gain
from hjbjax.problem.sets import Ball, Box, Finite, Simplex, is_unbounded, ranges
from hjbjax.tracing import intervals as iv
from hjbjax.tracing import quadratics as qu
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import Interval, point
from hjbjax.tracing.taylor_forms import Form

PIECES = {1: 64, 2: 16, 3: 8}  # pieces per input where there is no formula
Actions = list[Interval]  # the range of every input


@dataclasses.dataclass(frozen=True)
class CellDefect:
    """The defect over parts of cells.

    Attributes:
      defect: the range of β W − H.
      least: for each set of coordinates that a wall stops, an upper bound of β W − H without their motion.
      drift: the range of every component of the drift under the minimisers.
      policy: a control near the minimiser at the centre, shape (count, m); proves nothing.
    """

    defect: Interval
    least: dict[frozenset[int], np.ndarray]
    drift: list[Interval]
    policy: np.ndarray


def control_defect(cell: Cell, stopped: Sequence[frozenset[int]] = ()) -> CellDefect:
    """The defect of a candidate.

    Args:
      cell: the candidate.
      stopped: sets of coordinates whose motion a wall may stop.
    """
    if isinstance(cell.functions.problem.controls, Finite):
        return _enumerated(cell, stopped)
    with contextlib.suppress(qu.NotQuadraticError):
        for cost, drift in cell.functions.options:
            return _by_formula(cell, stopped, cost, drift)
    return _by_pieces(cell, stopped)


def _by_formula(
    cell: Cell, stopped: Sequence[frozenset[int]], cost: qu.Polynomial, drift: list[qu.Polynomial]
) -> CellDefect:
    """The defect from the formula for the minimum of a quadratic polynomial of the control."""
    known = cell.functions

    def defect(without: frozenset[int]) -> tuple[Interval, Actions, list[np.ndarray]]:
        least, actions, near = least_over(known.problem.controls, gain(cost, drift, cell.p, without))
        return (known.rate * cell.w - least).bounds(known.radii), actions, near

    found, actions, near = defect(frozenset())
    speeds = [range_over(component, actions) for component in drift] if stopped else []
    return CellDefect(found, {each: defect(each)[0].hi for each in stopped}, speeds, _stacked(near, cell))


def _stacked(inputs: Sequence[np.ndarray], cell: Cell) -> np.ndarray:
    """The inputs of a control as one array (count, m)."""
    rows = [np.broadcast_to(each, np.shape(cell.w.range.lo)) for each in inputs]
    return np.stack(rows, axis=-1) if rows else np.zeros((*np.shape(cell.w.range.lo), 0))


def range_over(terms: qu.Polynomial, actions: Actions) -> Interval:
    """The range of a polynomial over a box of controls and over cells."""
    total = point(0.0)
    for term, coefficient in terms.items():
        if len(term) == 2 and term[0] == term[1]:
            total = total + coefficient.range * iv.squared(actions[term[0]])
            continue
        product = coefficient.range
        for j in term:
            product = product * actions[j]
        total = total + product
    return total


def least_over(admissible: Any, terms: qu.Polynomial) -> tuple[Form, Actions, list[np.ndarray]]:
    """The minimum of a polynomial over a set, the ranges of the minimisers, and a minimiser at the centre.

    Raises:
      NotQuadraticError: there is no formula for this polynomial and this set.
    """
    zero = tf.constant(0.0)
    least = terms.get((), zero)
    if admissible is None:
        return least, [], []
    count = admissible.dim
    b = [terms.get((j,), zero) for j in range(count)]
    squares = [terms.get((j, j)) for j in range(count)]
    if any(len(term) == 2 and term[0] != term[1] for term in terms):
        raise qu.NotQuadraticError
    if isinstance(admissible, Box):
        lo, hi = np.asarray(admissible.lo, float), np.asarray(admissible.hi, float)
        actions, near = [], []
        for j in range(count):
            part, action, middle = least_quadratic(b[j], squares[j] or zero, lo[j], hi[j])
            least = least + part
            actions.append(action)
            near.append(middle)
        return least, actions, near
    if isinstance(admissible, Ball):
        radius = float(admissible.radius)
        length = tf.norm(b)
        part, _, distance = least_quadratic(-length, _common(squares), 0.0, radius)
        whole = Interval(np.array(-radius), np.array(radius))
        size = np.maximum(length.centre.hi, iv.TINY)
        return least + part, [whole] * count, [-distance * each.centre.lo / size for each in b]
    if isinstance(admissible, Simplex) and not any(squares):
        total = float(admissible.total)
        options = b + [zero] * admissible.at_most
        whole = Interval(np.array(0.0), np.array(total))
        best = np.argmin(np.stack(np.broadcast_arrays(*(each.centre.lo for each in options))), axis=0)
        near = [np.where(best == j, total, 0.0) for j in range(count)]
        return least + tf.constant(total) * tf.minimum(*options), [whole] * count, near
    raise qu.NotQuadraticError


def _common(squares: Sequence[Form | None]) -> Form:
    """The coefficient of |u|², which must be one number for all inputs."""
    known = [each for each in squares if each is not None]
    if not known:
        return tf.constant(0.0)
    ends = {(float(each.range.lo), float(each.range.hi)) for each in known if np.size(each.range.lo) == 1}
    if len(known) < len(squares) or len(ends) != 1 or any(each.slopes or np.size(each.range.lo) > 1 for each in known):
        raise qu.NotQuadraticError
    return known[0]


def least_quadratic(b: Form, c: Form, lo: float, hi: float) -> tuple[Form, Interval, np.ndarray]:
    """The minimum of b u + c u² over lo ≤ u ≤ hi, the range of the minimiser, and a minimiser at the centre."""
    whole, near = minimisers(b.range, c.range, lo, hi), minimisers(b.centre, c.centre, lo, hi)
    zero = point(0.0)

    def of(slope: Interval) -> Interval:
        return whole if slope is b.range else near

    def function(slope: Interval, curvature: Interval) -> Interval:
        return _least_value(slope, curvature, of(slope), lo, hi)

    def derivatives(slope: Interval, curvature: Interval) -> tuple[Interval, Interval]:
        return of(slope), iv.squared(of(slope)) if c.slopes else zero  # a constant needs no derivative

    def seconds(slope: Interval, curvature: Interval) -> tf.Curvature:
        inside, outside = (whole.lo > lo) & (whole.hi < hi), (whole.lo == whole.hi)
        response = -(point(0.5) / curvature)  # the derivative of an inner minimiser with respect to the slope
        response = iv.where(inside, response, iv.union(response, zero))
        # without curvature the minimiser jumps from one end to the other
        response = iv.where(curvature.lo > 0, response, iv.entire(response))
        response = iv.where(outside & ~inside, zero, response)
        if not c.slopes:
            return {(0, 0): response}
        return {
            (0, 0): response, (0, 1): (response * whole).scaled(2.0), (1, 1): (response * iv.squared(whole)).scaled(4.0)
        }  # fmt: skip

    return tf.apply(function, derivatives, seconds, b, c), whole, _middle(near, lo, hi)


def _middle(u: Interval, lo: float, hi: float) -> np.ndarray:
    """The middle of an interval, moved into [lo, hi]."""
    return np.clip(np.nan_to_num((u.lo + u.hi) / 2), lo, hi)


def _least_value(slope: Interval, curvature: Interval, minimiser: Interval, lo: float, hi: float) -> Interval:
    """The range of the minimum of b u + c u² over lo ≤ u ≤ hi.

    Let v be admissible and g = b + 2 c v. For c ≥ 0 the polynomial exceeds its value at v by g (u − v) + c (u − v)².
    This is at least −s²/(4c) and −s |u − v|, where s is the part of |g| whose sign allows a decrease.
    """
    at = _middle(minimiser, lo, hi)
    u = point(at)
    value = slope * u + curvature * iv.squared(u)
    gradient = slope + (curvature * u).scaled(2.0)
    falls = np.maximum(np.where(at <= lo, 0.0, gradient.hi), np.where(at >= hi, 0.0, -gradient.lo))
    decrease = point(np.maximum(falls, 0.0))
    span = np.maximum((point(np.asarray(hi)) - u).hi, (u - point(np.asarray(lo))).hi)
    loss = np.minimum((decrease * point(span)).hi, (iv.squared(decrease) / point(curvature.lo).scaled(4.0)).hi)
    low = (point(value.lo) - point(np.where(decrease.lo > 0, loss, 0.0))).lo
    if not np.all(curvature.lo >= 0):
        # increasing in c, and for c < 0 least at an end
        ends = [(slope * point(end) + point(curvature.lo) * iv.squared(point(end))).lo for end in (lo, hi)]
        least = np.minimum(*ends)
        low = np.where(curvature.lo >= 0, low, np.where(np.isfinite(least), least, -np.inf))
    return Interval(low, value.hi)


def minimisers(slope: Interval, curvature: Interval, lo: float, hi: float) -> Interval:
    """All minimisers of b u + c u² over lo ≤ u ≤ hi."""
    low, high = point(np.asarray(lo)), point(np.asarray(hi))
    free = -(slope / curvature.scaled(2.0))
    inside = Interval(np.clip(free.lo, lo, hi), np.clip(free.hi, lo, hi))
    # a convex polynomial is least at an end where its derivative there has the right sign
    two = point(2.0)
    at_low = (slope + two * curvature * low).lo >= 0 if np.isfinite(lo) else np.zeros((), bool)
    at_high = (slope + two * curvature * high).hi <= 0 if np.isfinite(hi) else np.zeros((), bool)
    convex = curvature.lo >= 0
    found = iv.where(curvature.lo > 0, inside, Interval(low.lo, high.lo))
    found = iv.where(convex & at_low, low, found)
    return iv.where(convex & at_high, high, found)


def _enumerated(cell: Cell, stopped: Sequence[frozenset[int]]) -> CellDefect:
    """The defect from an enumeration of a finite set."""
    known = cell.functions
    costs: dict[frozenset[int], list[Form]] = {each: [] for each in (frozenset[int](), *stopped)}
    for paid, drift in known.options:
        for without, found in costs.items():
            found.append(gain(paid[()], [each[()] for each in drift], cell.p, without))
    whole = known.rate * cell.w
    points, gains = np.asarray(known.problem.controls.points, float), [each.centre.lo for each in costs[frozenset()]]
    best = np.argmin(np.stack(np.broadcast_arrays(*gains)), axis=0)
    bounds = {without: (whole - tf.minimum(*found)).bounds(known.radii) for without, found in costs.items()}
    speeds = [iv.union(*(drift[k][()].range for _, drift in known.options)) for k in range(len(cell.p))]
    return CellDefect(bounds[frozenset()], {each: bounds[each].hi for each in stopped}, speeds, points[best])


def _by_pieces(cell: Cell, stopped: Sequence[frozenset[int]]) -> CellDefect:
    """The defect from pieces of the set of controls: the control is one more coordinate of each box."""
    known = cell.functions
    problem, n, whole = known.problem, len(known.x), known.rate * cell.w
    high = {each: np.asarray(-np.inf) for each in (frozenset[int](), *stopped)}
    low = np.asarray(-np.inf)
    policy = np.zeros((*np.shape(cell.w.range.lo), problem.controls.dim))
    speeds: list[list[Interval]] = []
    for box, centre, inside in pieces(problem.controls):
        radii = [
            *known.radii,
            *(np.nextafter((each.hi - each.lo) / 2 + iv.EPS * abs(each).hi, np.inf) for each in box),
        ]
        action = tf.coordinates(box, [point(c) for c in centre], n + len(box), n)
        drift = list(tf.taylor_forms(problem.drift, known.x, action))
        paid = cost_form(problem, known.x, action)
        for without in high:
            own = whole - gain(paid, drift, cell.p, without)
            high[without] = np.maximum(high[without], own.bounds(radii).hi)
            if not without and inside:  # the derivatives over the piece contain those at its centre
                at_centre = dataclasses.replace(own, range=iv.entire(own.range))
                still = [*known.radii, *(np.zeros(()) for _ in box)]
                found = at_centre.bounds(still).lo
                policy = np.where((found > low)[..., None], centre, policy)
                low = np.maximum(low, found)
        speeds.append([each.range for each in drift])
    return CellDefect(
        Interval(low, high[frozenset()]), {each: high[each] for each in stopped},
        [iv.union(*each) for each in zip(*speeds, strict=True)], policy,
    )  # fmt: skip


def pieces(admissible: Any) -> list[tuple[list[Interval], np.ndarray, bool]]:
    """Boxes that cover a set: their ranges, their centres, and True if the centre belongs to the set.

    Raises:
      ValueError: the set has too many inputs, or no boxes cover it.
    """
    count = admissible.dim
    if count not in PIECES or isinstance(admissible, Simplex) or is_unbounded(admissible):
        raise ValueError(
            f"enclose: got controls={admissible!r:.80} with a drift or a cost that is not a quadratic polynomial of\n"
            "single inputs; wanted such a polynomial, or a bounded Box or Ball of at most three inputs, or a Finite set"
        )
    lo, hi = ranges(admissible)
    steps = PIECES[count]
    edges = [(lo * (steps - k) + hi * k) / steps for k in range(steps + 1)]
    edges[0], edges[-1] = lo, hi
    found = []
    for index in itertools.product(range(steps), repeat=count):
        ends = [(edges[k][j], edges[k + 1][j]) for j, k in enumerate(index)]
        centre = np.array([(a + b) / 2 for a, b in ends])
        inside = True
        if isinstance(admissible, Ball):
            radius = float(admissible.radius)
            nearest = np.array([0.0 if a <= 0 <= b else min(abs(a), abs(b)) for a, b in ends])
            if np.linalg.norm(nearest) > radius * (1 + 1e-12):
                continue
            inside = bool(np.linalg.norm(centre) <= radius * (1 - 1e-12))
        found.append(([Interval(np.asarray(a), np.asarray(b)) for a, b in ends], centre, inside))
    return found
