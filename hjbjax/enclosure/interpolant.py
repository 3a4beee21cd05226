"""A continuously differentiable function with one coefficient per node, and ranges of its derivatives over cells.

It is a quadratic spline in every coordinate. Its cells are centred at the nodes and end half way between them; at an
end of an axis only half of a cell is inside. Between two cells its slope is the difference of their coefficients
divided by their distance, so the slope everywhere is between differences of neighbouring coefficients: next to a kink
the spline does not overshoot. Beyond an end the coefficients continue as a parabola.

A polynomial is between the least and the largest of its Bézier coefficients (C. de Boor, A Practical Guide to Splines).
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.tracing.intervals import Interval, point
from hjbjax.tracing.taylor_forms import Form

# for every axis the lower and the upper ends of parts of the unit cells, dyadic numbers, (count,)
Ends = Sequence[tuple[np.ndarray, np.ndarray]]
DEGREE = 2
POINTS = DEGREE + 1
SEAM = 2.0**-30  # by which half cells at the ends of a periodic axis overlap: more than their rounding


@dataclasses.dataclass(frozen=True)
class AxisTable:
    """The spline along one axis.

    Attributes:
      periodic: True if the last cell is the first one again.
      between: the ends of the cells inside the box.
      lower: the lower end of every cell.
      lengths: the length of every cell.
      nodes: the three nodes whose coefficients determine each cell, shape (cells, 3).
      weights: their weights in the three Bézier coefficients, shape (cells, 3, 3).
    """

    periodic: bool
    between: np.ndarray
    lower: Interval
    lengths: Interval
    nodes: np.ndarray
    weights: Interval


def axis_table(grid: Grid, axis: int) -> AxisTable:
    """The spline along one axis of a grid."""
    at, count, cyclic = np.asarray(grid.axis(axis), float), grid.shape[axis], grid.periodic[axis]
    if cyclic:
        at = np.append(at, float(grid.hi[axis]))
    between = (at[:-1] + at[1:]) / 2  # the ends of the cells, exact numbers like the nodes
    below, above = point(at[1:]) - point(between), point(between) - point(at[:-1])
    first = _take(below, [-1]) if cyclic else _take(above, [0])
    last = _take(above, [0]) if cyclic else _take(below, [-1])
    below, above = _joined(first, below), _joined(above, last)
    lengths = below + above
    cells = len(at)
    index = np.arange(cells)[:, None] + np.arange(-1, 2)
    around = _joined(_take(lengths, [-2 if cyclic else 0]), lengths, _take(lengths, [1 if cyclic else -1]))
    previous, following = _take(around, np.arange(cells)), _take(around, np.arange(2, cells + 2))
    weights = Interval(*(np.zeros((cells, 3, 3)) for _ in range(2)))
    # a knot divides the distance between two coefficients in the ratio of the lengths of their cells
    _put(weights, 0, [lengths / (previous + lengths), previous / (previous + lengths), None])
    _put(weights, 1, [None, point(np.ones(cells)), None])
    _put(weights, 2, [None, following / (lengths + following), lengths / (lengths + following)])
    if cyclic:
        nodes = index % count
    else:
        nodes = np.clip(index, 0, count - 1)
        _extrapolate(weights, nodes, count)
    return AxisTable(cyclic, between, point(at) - below, lengths, nodes, weights)


def _extrapolate(weights: Interval, nodes: np.ndarray, count: int) -> None:
    """Replace the coefficient beyond either end by a parabola through the next three, or a line through two."""
    for cell, ghost in ((0, 0), (-1, 2)):
        near = [0, 1, 2] if cell == 0 else [count - 1, count - 2, count - 3]
        factors = (3.0, -3.0, 1.0) if count > 2 else (2.0, -1.0, 0.0)
        rows = []
        for row in range(3):
            w = [Interval(weights.lo[cell, row, k], weights.hi[cell, row, k]) for k in range(3)]
            beyond, own, inner = w[ghost], w[1], w[2 - ghost]
            parts = [beyond * point(factor) for factor in factors]
            rows.append([own + parts[0], inner + parts[1], parts[2]])
        nodes[cell] = np.clip(near, 0, count - 1)
        for kind in ("lo", "hi"):
            getattr(weights, kind)[cell] = [[getattr(each, kind) for each in row] for row in rows]


def _take(x: Interval, index: Any) -> Interval:
    return Interval(x.lo[index], x.hi[index])


def _joined(*parts: Interval) -> Interval:
    return Interval(np.concatenate([each.lo for each in parts]), np.concatenate([each.hi for each in parts]))


def _put(weights: Interval, row: int, columns: Sequence[Interval | None]) -> None:
    for k, column in enumerate(columns):
        if column is not None:
            weights.lo[:, row, k], weights.hi[:, row, k] = column.ends


@dataclasses.dataclass(frozen=True)
class Spline:
    """The function with some coefficients.

    Attributes:
      tables: one per axis.
      values: the coefficients, shape (*grid).
    """

    tables: tuple[AxisTable, ...]
    values: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of cells along every axis."""
        return tuple(len(table.lengths.lo) for table in self.tables)

    def cells(self, index: tuple[np.ndarray, ...]) -> "Cells":
        """The polynomials of some cells.

        Args:
          index: the number of each cell along every axis, one array (count,) per axis.
        """
        n = len(self.tables)
        pairs = list(zip(self.tables, index, strict=True))
        stencil = tuple(
            table.nodes[i].reshape(-1, *(1,) * axis, POINTS, *(1,) * (n - 1 - axis))
            for axis, (table, i) in enumerate(pairs)
        )
        values = self.values[stencil]
        found = Interval(values, values)
        for axis, (table, i) in enumerate(pairs):
            found = _contract(_take(table.weights, i), found, axis + 1)
        return Cells(
            found, [_take(table.lengths, i) for table, i in pairs], [_take(table.lower, i) for table, i in pairs]
        )

    def at(self, states: np.ndarray) -> Interval:
        """The function at some states inside the box, shape (count, n)."""
        index = tuple(
            np.searchsorted(table.between, states[:, axis], side="right") for axis, table in enumerate(self.tables)
        )
        cells = self.cells(index)
        found = cells.coefficients
        for axis in reversed(range(len(self.tables))):
            place = (point(states[:, axis]) - cells.lower[axis]) / cells.lengths[axis]
            fill = (slice(None), *(None,) * (axis + 1))  # the axes before this one, and the coefficients along it
            t = Interval(place.lo[fill], place.hi[fill])
            rest = point(1.0) - t
            while found.lo.shape[-1] > 1:  # de Casteljau's algorithm
                found = rest * _take(found, (..., slice(None, -1))) + t * _take(found, (..., slice(1, None)))
            found = _take(found, (..., 0))
        return found


def _contract(matrix: Interval, values: Interval, axis: int) -> Interval:
    """The product of one matrix (count, r, s), or (r, s), with values (count, ..., s, ...) along an axis."""
    lo, hi = (np.moveaxis(end, axis, -1) for end in values.ends)
    fill = (slice(None),) * (matrix.lo.ndim - 2) + (None,) * (lo.ndim - 1 - (matrix.lo.ndim - 2))
    total: Interval | None = None
    for s in range(matrix.lo.shape[-1]):
        column = Interval(matrix.lo[..., s][fill], matrix.hi[..., s][fill])
        term = column * Interval(lo[..., s, None], hi[..., s, None])
        total = term if total is None else total + term
    assert total is not None
    return Interval(np.moveaxis(total.lo, -1, axis), np.moveaxis(total.hi, -1, axis))


def _at(places: np.ndarray, found: Interval, axis: int) -> Interval:
    """One step of de Casteljau's algorithm along an axis, for one place in every unit cell."""
    lo, hi = (np.moveaxis(end, axis, -1) for end in found.ends)
    fill = (slice(None), *(None,) * (lo.ndim - 1))
    t = point(places[fill])
    mixed = point(1 - places[fill]) * Interval(lo[..., :-1], hi[..., :-1]) + t * Interval(lo[..., 1:], hi[..., 1:])
    return Interval(*(np.moveaxis(end, -1, axis) for end in mixed.ends))


def _restricted(found: Interval, axis: int, ends: tuple[np.ndarray, np.ndarray]) -> Interval:
    """The Bézier coefficients over a part of every cell along one axis."""
    degree = found.lo.shape[axis] - 1
    # the k-th coefficient is the blossom at degree − k times the lower and k times the upper end
    columns = []
    for k in range(degree + 1):
        blossom = found
        for place in (ends[0],) * (degree - k) + (ends[1],) * k:
            blossom = _at(place, blossom, axis)
        columns.append(blossom)
    return Interval(*(np.concatenate([each.ends[k] for each in columns], axis=axis) for k in range(2)))


@dataclasses.dataclass(frozen=True)
class Cells:
    """The polynomials of some cells.

    Attributes:
      coefficients: the Bézier coefficients, shape (count, 3, ..., 3).
      lengths: the lengths of the cells along every axis, each (count,).
      lower: the lower ends of the cells along every axis, each (count,).
    """

    coefficients: Interval
    lengths: Sequence[Interval]
    lower: Sequence[Interval]

    def derivative(self, orders: Sequence[int], ends: Ends | None) -> tuple[Interval, Interval]:
        """The range of a derivative over a part of the cells, and its value at the centre of the part.

        Args:
          orders: the order along every axis.
          ends: the parts of the unit cells; ``None`` is the whole of them.
        """
        found = self.coefficients
        if max(orders) > DEGREE:
            zero = np.zeros(len(found.lo))
            return Interval(zero, zero), Interval(zero, zero)
        for axis, order in enumerate(orders):
            for k in range(order):
                lo, hi = (np.moveaxis(end, axis + 1, -1) for end in found.ends)
                difference = Interval(lo[..., 1:], hi[..., 1:]) - Interval(lo[..., :-1], hi[..., :-1])
                found = Interval(*(np.moveaxis(end, -1, axis + 1) for end in difference.ends))
                fill = (slice(None), *(None,) * (found.lo.ndim - 1))
                found = found.scaled(DEGREE - k) / _take(self.lengths[axis], fill)
        centre = found
        for axis, order in enumerate(orders):
            middle = np.full(len(found.lo), 0.5) if ends is None else (ends[axis][0] + ends[axis][1]) / 2
            for _ in range(DEGREE - order):
                centre = _at(middle, centre, axis + 1)
            if ends is not None and order < DEGREE:
                found = _restricted(found, axis + 1, ends[axis])
        axes = tuple(range(1, found.lo.ndim))
        at_centre = Interval(centre.lo.reshape(len(centre.lo)), centre.hi.reshape(len(centre.hi)))
        return Interval(found.lo.min(axis=axes), found.hi.max(axis=axes)), at_centre

    def boxes(self, ends: Ends | None) -> tuple[list[Interval], list[Interval], list[np.ndarray]]:
        """Boxes that contain a part of the cells, their centres, and the largest distance from it along every axis."""
        ranges, centres, radii = [], [], []
        for axis, (lower, lengths) in enumerate(zip(self.lower, self.lengths, strict=True)):
            start, stop = (np.zeros(()), np.ones(())) if ends is None else ends[axis]
            low, high, middle = (lower + lengths * point(t) for t in (start, stop, (start + stop) / 2))
            box = Interval(low.lo, high.hi)
            ranges.append(box)
            centres.append(middle)
            radii.append(np.nextafter(np.maximum(box.hi - middle.lo, middle.hi - box.lo), np.inf))
        return ranges, centres, radii

    def scalars(self, ends: Ends | None) -> tuple[Form, list[Form]]:
        """The function and its gradient over a part of the cells."""
        n = len(self.lengths)

        def of(*axes: int) -> tuple[Interval, Interval]:
            return self.derivative([axes.count(axis) for axis in range(n)], ends)

        def table(order: int) -> dict[tuple[int, ...], tuple[Interval, Interval]]:
            return {axes: of(*axes) for axes in itertools.combinations_with_replacement(range(n), order)}

        first, second, third = table(1), table(2), table(3)

        def form(*axes: int) -> Form:
            """A derivative of order zero or one, with its own first and second derivatives."""
            own = [tuple(sorted((*axes, i))) for i in range(n)]
            lower, upper = (first, second) if not axes else (second, third)
            curvature = {(i, j): upper[tuple(sorted((*axes, i, j)))][0] for i in range(n) for j in range(i, n)}
            value = of() if not axes else first[axes]
            return Form(*value, tuple(lower[each][0] for each in own), tuple(lower[each][1] for each in own), curvature)

        return form(), [form(i) for i in range(n)]
