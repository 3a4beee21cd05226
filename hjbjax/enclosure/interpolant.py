"""A continuously differentiable function with one coefficient per node, and ranges of its derivatives over cells.

It is a quadratic spline in every coordinate. Its cells are centred at the nodes and end half way between them; at an
end of an axis only half of a cell is inside. Between two cells its slope is the difference of their coefficients
divided by their distance, so the slope everywhere is between differences of neighbouring coefficients: next to a kink
the spline does not overshoot. Beyond an end the coefficients continue as a parabola.

A polynomial is between the least and the largest of its Bézier coefficients (C. de Boor, A Practical Guide to Splines).
They are sums of products of node values and known weights, one weight per axis. The sums are computed in float64, and a
bound of their rounding errors is added: the largest node value times a number that depends only on the grid.
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.tracing.intervals import EPS, Interval, point
from hjbjax.tracing.taylor_forms import Form, constant

# for every axis the lower and the upper ends of parts of the unit cells, dyadic numbers, (count,)
Ends = Sequence[tuple[np.ndarray, np.ndarray]]
DEGREE = 2
POINTS = DEGREE + 1
SEAM = 2.0**-30  # overlap of the half cells at the ends of a periodic axis: more than their rounding
LARGEST = 1e150  # coefficients may be this large; sums of larger ones may overflow, so they give no bounds
ROUNDING = 64 * EPS  # relative error of a weight on a part of a cell, and of a sum along one axis


@dataclasses.dataclass(frozen=True)
class AxisWeights:
    """The Bézier coefficients of one derivative along one axis, as sums over three nodes.

    Attributes:
      rows: the weights, shape (3 − order, 3, cells).
      size: the largest sum of the absolute weights of a coefficient, shape (cells,).
      error: a bound of the error of a sum of three terms with absolute value at most one, shape (cells,).
    """

    rows: np.ndarray
    size: np.ndarray
    error: np.ndarray


@dataclasses.dataclass(frozen=True)
class AxisTable:
    """The spline along one axis.

    Attributes:
      at: the coordinates of the nodes; on a periodic axis also of its upper end.
      periodic: True if the last cell is the first one again.
      between: the ends of the cells inside the box.
      lower: the lower end of every cell.
      lengths: the length of every cell.
      nodes: the three nodes whose coefficients determine each cell, shape (cells, 3).
      weights: of the derivatives of order 0, 1 and 2.
    """

    at: np.ndarray
    periodic: bool
    between: np.ndarray
    lower: Interval
    lengths: Interval
    nodes: np.ndarray
    weights: tuple[AxisWeights, ...]


def axis_table(at: np.ndarray, cyclic: bool) -> AxisTable:
    """The spline along one axis.

    Args:
      at: the coordinates of the nodes; on a periodic axis also of its upper end.
      cyclic: True for a periodic axis.
    """
    count = len(at) - cyclic
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
    return AxisTable(at, cyclic, between, point(at) - below, lengths, nodes, _derivatives(weights, lengths))


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


def _derivatives(weights: Interval, lengths: Interval) -> tuple[AxisWeights, ...]:
    """The weights (cells, 3, 3) of the Bézier coefficients, and those of the first and second derivative."""
    found, length = [], _take(lengths, (slice(None), None, None))
    for order in range(POINTS):
        if order:
            difference = _take(weights, np.s_[:, 1:]) - _take(weights, np.s_[:, :-1])
            weights = difference.scaled(POINTS - order) / length
        middle = (weights.lo + weights.hi) / 2
        size = np.abs(middle).sum(axis=2).max(axis=1)
        error = (weights.hi - weights.lo).sum(axis=2).max(axis=1) + ROUNDING * size
        found.append(AxisWeights(np.moveaxis(middle, 0, -1), size, error))
    return tuple(found)


def _take(x: Interval, index: Any) -> Interval:
    return Interval(x.lo[index], x.hi[index])


def _joined(*parts: Interval) -> Interval:
    return Interval(np.concatenate([each.lo for each in parts]), np.concatenate([each.hi for each in parts]))


def _put(weights: Interval, row: int, columns: Sequence[Interval | None]) -> None:
    for k, column in enumerate(columns):
        if column is not None:
            weights.lo[:, row, k], weights.hi[:, row, k] = column.ends


def _mixed(rows: np.ndarray, place: np.ndarray) -> np.ndarray:
    """One step of de Casteljau's algorithm for one place in every cell, or for one place in all."""
    return (1 - place) * rows[:-1] + place * rows[1:]


def _restricted(rows: np.ndarray, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """The weights of the Bézier coefficients over a part of every cell."""
    degree = len(rows) - 1
    # the k-th coefficient is the blossom at degree − k times the lower and k times the upper end
    columns = []
    for k in range(degree + 1):
        blossom = rows
        for place in (start,) * (degree - k) + (stop,) * k:
            blossom = _mixed(blossom, place)
        columns.append(blossom)
    return np.concatenate(columns)


def _contracted(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The sums over the first axis of values (3, ..., *cells) with weights (r, 3, *cells): shape (..., r, *cells)."""
    cells = rows.ndim - 2
    fill = (slice(None), *(None,) * (values.ndim - 1 - cells))
    total = rows[:, 0][fill] * values[0]
    for k in range(1, POINTS):
        total += rows[:, k][fill] * values[k]
    return np.moveaxis(total, 0, -1 - cells)


def with_largest(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Coefficients and their largest absolute value; zeros and infinity if one is too large or NaN."""
    largest = float(np.max(np.abs(values), initial=0.0))
    return (values, largest) if largest <= LARGEST else (np.zeros_like(values), np.inf)


@dataclasses.dataclass(frozen=True)
class Cells:
    """Parts of some cells, for any coefficients of the spline.

    Attributes:
      stencil: the index of the nodes of every cell, one array per axis; together of shape (3, ..., 3, count).
      rows: per axis and order of the derivative, the weights of the coefficients over the part, (3 − order, 3, count).
      middles: the same for the value at the centre of the part, (1, 3, count).
      weights: per axis and order, ``size`` and ``error`` of the cells, both (count,).
      ranges: the range of every coordinate.
      centres: the centre of every coordinate.
      radii: the largest distance from the centre along every axis.
    """

    stencil: tuple[np.ndarray, ...]
    rows: list[list[np.ndarray]]
    middles: list[list[np.ndarray]]
    weights: list[list[tuple[np.ndarray, np.ndarray]]]
    ranges: list[Interval]
    centres: list[Interval]
    radii: list[np.ndarray]

    def scalars(self, values: np.ndarray) -> tuple[Form, list[Form]]:
        """The spline and its gradient.

        Args:
          values: the coefficients of the spline, shape (*grid).
        """
        n, found = len(self.rows), self._derivatives(values)

        def form(*axes: int) -> Form:
            """A derivative of order zero or one, with its own first and second derivatives."""
            own = [tuple(sorted((*axes, i))) for i in range(n)]
            pairs = itertools.combinations_with_replacement(range(n), 2)
            curvature = {(i, j): found[tuple(sorted((*axes, i, j)))][0] for i, j in pairs}
            slopes, gradient = (tuple(found[each][k] for each in own) for k in range(2))
            return Form(*found[axes], slopes, gradient, curvature)

        return form(), [form(i) for i in range(n)]

    def at_centres(self, values: np.ndarray) -> tuple[Form, list[Form]]:
        """The spline and its gradient as numbers at the centres, without their rounding errors."""
        stencil, n = with_largest(values)[0][self.stencil], len(self.middles)

        def number(axis: int | None) -> Form:
            found = stencil
            for k, rows in enumerate(self.middles):
                found = _contracted(rows[k == axis], found)
            return constant(found.reshape(found.shape[n:]))

        return number(None), [number(axis) for axis in range(n)]

    def _derivatives(self, values: np.ndarray) -> dict[tuple[int, ...], tuple[Interval, Interval]]:
        """Per list of axes, at most three, the range of the derivative and its value at the centre."""
        n = len(self.rows)
        values, largest = with_largest(values)
        found: dict[tuple[int, ...], tuple[Interval, Interval]] = {}
        stencil = values[self.stencil]
        for orders, whole, middle in self._contractions(stencil, stencil):
            whole, middle = whole.reshape(-1, *whole.shape[n:]), middle.reshape(middle.shape[n:])
            error = largest * self._error(orders)
            axes = tuple(k for k, order in enumerate(orders) for _ in range(order))
            ranges = Interval(whole.min(axis=0) - error, whole.max(axis=0) + error)
            found[axes] = ranges, Interval(middle - error, middle + error)
        zero = np.zeros(())
        for axis in range(n):
            found[axis, axis, axis] = (Interval(zero, zero),) * 2
        return found

    def _contractions(
        self, whole: np.ndarray, middle: np.ndarray, orders: tuple[int, ...] = ()
    ) -> Iterator[tuple[tuple[int, ...], np.ndarray, np.ndarray]]:
        """Per order along every axis, at most three in all, the Bézier coefficients of the derivative and its centre.

        A method, because a local function that calls itself is a cycle, which keeps the arrays of its cells until the
        garbage collector runs.
        """
        axis = len(orders)
        if axis == len(self.rows):
            yield orders, whole, middle
            return
        for order in range(min(POINTS, 4 - sum(orders))):
            rows, middles = self.rows[axis][order], self.middles[axis][order]
            yield from self._contractions(_contracted(rows, whole), _contracted(middles, middle), (*orders, order))

    def _error(self, orders: Sequence[int]) -> np.ndarray:
        """A bound of the error of a coefficient of a derivative for node values up to one, shape (count,)."""
        pairs = [self.weights[axis][order] for axis, order in enumerate(orders)]
        total, share = np.ones(()), np.zeros(())
        for size, error in pairs:
            total, share = total * size, share + error / size
        return 2 * total * share  # the product of (1 + shares) is less than 1 plus twice their sum


@dataclasses.dataclass(frozen=True)
class Spline:
    """The cells of a grid.

    Attributes:
      tables: one per axis.
    """

    tables: tuple[AxisTable, ...]

    @classmethod
    def on(cls, grid: Grid) -> "Spline":
        """The cells of the nodes of a grid."""
        tables = []
        for axis, cyclic in enumerate(grid.periodic):
            at, lo, hi = np.array(grid.axis(axis), float), float(grid.lo[axis]), float(grid.hi[axis])
            at = np.append(at, hi) if cyclic else at
            at[0], at[-1] = lo, hi  # nodes are rounded, and the cells must cover the whole box
            tables.append(axis_table(at, cyclic))
        return cls(tuple(tables))

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of cells along every axis."""
        return tuple(len(table.between) + 1 for table in self.tables)

    def _stencil(self, index: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        n = len(self.tables)
        return tuple(
            np.moveaxis(table.nodes[i], -1, 0).reshape(*(1,) * axis, POINTS, *(1,) * (n - 1 - axis), *i.shape)
            for axis, (table, i) in enumerate(zip(self.tables, index, strict=True))
        )

    def cells(self, index: Sequence[np.ndarray], ends: Ends | None = None) -> Cells:
        """Parts of some cells.

        Args:
          index: the number of each cell along every axis, one array (count,) per axis.
          ends: the parts of the unit cells; ``None`` is the whole of them.
        """
        whole = np.zeros(()), np.ones(())
        found = Cells(self._stencil(index), [], [], [], [], [], [])
        for axis, (table, i) in enumerate(zip(self.tables, index, strict=True)):
            start, stop = whole if ends is None else ends[axis]
            middle = (start + stop) / 2
            rows = [each.rows[..., i] for each in table.weights]
            found.rows.append(rows if ends is None else [_restricted(each, start, stop) for each in rows])
            centre = []
            for each in rows:
                while len(each) > 1:
                    each = _mixed(each, middle)
                centre.append(each)
            found.middles.append(centre)
            found.weights.append([(each.size[i], each.error[i]) for each in table.weights])
            lower, lengths = _take(table.lower, i), _take(table.lengths, i)
            low, high, place = (lower + lengths * point(t) for t in (start, stop, middle))
            box = Interval(low.lo, high.hi)
            found.ranges.append(box)
            found.centres.append(place)
            found.radii.append(np.nextafter(np.maximum(box.hi - place.lo, place.hi - box.lo), np.inf))
        return found

    @functools.cached_property
    def _inside(self) -> list[np.ndarray]:
        """Per axis the weights (3, 3, cells) of the Bézier coefficients over the part of every cell inside the box."""
        found = []
        for table in self.tables:
            start, stop = (np.full(len(table.nodes), end) for end in (0.0, 1.0))
            if not table.periodic:
                start[0] = stop[-1] = 0.5
            found.append(_restricted(table.weights[0].rows, start, stop))
        return found

    @functools.cached_property
    def _slack(self) -> float:
        """A bound of the error of a Bézier coefficient for node values up to one."""
        size, error = 1.0, 0.0
        for weights in (table.weights[0] for table in self.tables):
            size, error = size * float(np.max(weights.size)), error + float(np.max(weights.error / weights.size))
        return 2 * size * error

    def range(self, values: np.ndarray) -> Interval:
        """Bounds of the spline with some coefficients in every cell inside the box, shape (*cells)."""
        values, largest = with_largest(values)
        low, high = self._ends(values, 0)
        slack = largest * self._slack
        return Interval(low - slack, high + slack)

    def _ends(self, values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
        """The least and the largest Bézier coefficient of every cell along the axes from one on."""
        if axis == len(self.tables):
            return values, values
        table, rows = self.tables[axis], self._inside[axis]
        around = np.moveaxis(values, axis, 0)
        fill = (slice(None), *(None,) * (values.ndim - 1))

        def combined(row: int, cells: slice) -> np.ndarray:
            nodes = table.nodes[cells]
            return sum(rows[row, k, cells][fill] * around[nodes[:, k]] for k in range(POINTS))

        # two cells have the coefficient at the knot between them in common, and the middle one is that of the node
        knots = np.concatenate([combined(0, slice(None)), combined(2, slice(-1, None))])
        middles = np.concatenate([combined(1, slice(1)), around[table.nodes[1:-1, 1]], combined(1, slice(-1, None))])
        low, high = ([], [])
        for each in (knots, middles):
            least, most = self._ends(np.moveaxis(each, 0, axis), axis + 1)
            low.append(np.moveaxis(least, axis, 0))
            high.append(np.moveaxis(most, axis, 0))
        least = np.minimum(np.minimum(low[0][:-1], low[0][1:]), low[1])
        most = np.maximum(np.maximum(high[0][:-1], high[0][1:]), high[1])
        return np.moveaxis(least, 0, axis), np.moveaxis(most, 0, axis)

    def largest_difference(self, values: np.ndarray, other: np.ndarray, index: Sequence[np.ndarray]) -> np.ndarray:
        """An upper bound of the difference of two splines in listed cells inside the box, shape (count,)."""
        stencil = self._stencil(index)
        found, largest = with_largest(values[stencil] - other[stencil])
        for rows, i in zip(self._inside, index, strict=True):
            found = _contracted(rows[..., i], found)
        return found.max(axis=tuple(range(len(index)))) + largest * self._slack

    def index(self, states: np.ndarray) -> tuple[np.ndarray, ...]:
        """The number of the cell of every state along every axis."""
        return tuple(np.searchsorted(table.between, states[:, k], side="right") for k, table in enumerate(self.tables))

    def at(self, states: np.ndarray) -> "States":
        """The spline at some states inside the box, shape (count, n), for any coefficients."""
        rows, size, error = [], np.ones(()), np.zeros(())
        index = self.index(states)
        for axis, (table, i) in enumerate(zip(self.tables, index, strict=True)):
            weights, slope = table.weights[:2]
            place = (point(states[:, axis]) - _take(table.lower, i)) / _take(table.lengths, i)
            middle, row = (place.lo + place.hi) / 2, weights.rows[..., i]
            while len(row) > 1:
                row = _mixed(row, middle)
            # rounding may put a place outside [0, 1], where the weights are hardly larger
            moved = slope.size[i] * table.lengths.hi[i] * (place.hi - place.lo)
            rows.append(row)
            error = error + (weights.error[i] + 2 * moved) / weights.size[i]
            size = size * weights.size[i]
        return States(self._stencil(index), rows, 2 * size * error)


@dataclasses.dataclass(frozen=True)
class States:
    """Some states, for any coefficients of the spline.

    Attributes:
      stencil: the index of the nodes around every state, as in ``Cells``.
      rows: per axis the weights of the nodes, (1, 3, count).
      error: a bound of the error for node values up to one, shape (count,).
    """

    stencil: tuple[np.ndarray, ...]
    rows: list[np.ndarray]
    error: np.ndarray

    def values(self, coefficients: np.ndarray) -> Interval:
        """The spline with these coefficients, shape (*grid), at the states."""
        coefficients, largest = with_largest(coefficients)
        found = coefficients[self.stencil]
        for row in self.rows:
            found = _contracted(row, found)
        found, error = found.reshape(-1), largest * self.error
        return Interval(found - error, found + error)
