"""An estimate of the error of the spacing, from the answers on two grids.

    |V − V_h| ≈ |V_h − V_rh|/(r^q − 1)

with r the ratio of the spacings and c h^q the leading term of the error. The order q is measured at every node, since
it is 2 where V is smooth, 1 next to kinks and corners, and less where V is not Lipschitz continuous. Two observations
decide, and the lower order counts:

- The second-order scheme changes the answer of its chain by the chain's whole error, which is of first order. If the
  change between grids is small compared to that, the order is 2. If both are alike, slopes gain nothing: q is 1.
- Second differences of V fall like h² where V is smooth, like h at a kink, and not at all at a jump or in a layer that
  is thinner than a cell.

First differences fall like h where V is Lipschitz continuous and not at all where V jumps. A jump is off by up to its
height within the few cells over which the scheme smears it, which no comparison of grids measures: there the
estimate is at least the range of V over two coarse cells.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.solution import nested_grids

LEAST, FIRST, SECOND = 0.5, 1.0, 2.0  # orders
SMOOTH, ALIKE, ONE = 0.05, 0.5, 10.0  # change between grids over change between schemes: order 2, order 1, one scheme
BENT = 0.1  # second differences below this part of the first ones say nothing about the order
# differences fall like h^a: a jump below the one number and none above the other; a root of the distance has ½
JUMP, CONTINUOUS = 0.3, 0.6


@dataclasses.dataclass(frozen=True)
class TwoGrids:
    """The answers on two grids of one box.

    Args:
      grid: the finer grid.
      coarse: the coarser one.
      value: V_h, (*grid); infinite where the target cannot be reached.
      before: V_rh, (*coarse).
      held: the fixed nodes, bool (*grid).
      chain: the answer of the monotone chain on ``grid``, where V_h is of another scheme; else None.
      highest: the order of the scheme where V is smooth.
    """

    grid: Grid
    coarse: Grid
    value: np.ndarray
    before: np.ndarray
    held: np.ndarray
    chain: np.ndarray | None = None
    highest: float = SECOND


def estimate(answers: TwoGrids) -> np.ndarray:
    """|V − V_h| at the nodes, about, shape (*grid), in cost units; zero where V is infinite."""
    grid, coarse, value = answers.grid, answers.coarse, answers.value
    finite = np.isfinite(value)
    change = nested_grids.apart(nested_grids.restrict(value, grid, coarse), answers.before)
    ratio = nested_grids.ratio_of(grid, coarse)
    free = finite & ~answers.held
    fine = _Differences.of(np.where(free, value, np.nan), grid).near(grid, coarse)
    rough = _Differences.of(np.where(nearest(free, grid, coarse), answers.before, np.nan), coarse).around(coarse)
    order = np.minimum(_order_of_bends(fine, rough, ratio), answers.highest)
    if answers.chain is not None:
        gain = nearest(nested_grids.apart(value, answers.chain), grid, coarse)
        order = np.minimum(order, _order_of_slopes(change, gain, coarse))
    error = np.maximum(change / (ratio**order - 1), _jumps(fine, rough, ratio))
    return np.where(finite, nested_grids.prolong(error, coarse, grid), 0)


def is_a_point(target: np.ndarray) -> bool:
    """True if a target, bool (*grid), has at most the nodes of one cell; on a line that is not a small target."""
    return target.ndim > 1 and 0 < np.sum(target) <= 2**target.ndim


def nearest(values: np.ndarray, fine: Grid, coarse: Grid) -> np.ndarray:
    """Node values on the finer grid at the nodes closest to those of the coarser one, (*coarse)."""
    places = [
        np.rint(np.arange(count) * (fine.intervals(axis) / coarse.intervals(axis))).astype(int)
        for axis, count in enumerate(coarse.shape)
    ]
    return values[np.ix_(*places)]


@dataclasses.dataclass(frozen=True)
class _Differences:
    """The largest first and second differences at every node and the range of V, over all axes; zero without any."""

    first: np.ndarray
    second: np.ndarray
    least: np.ndarray
    most: np.ndarray

    @classmethod
    def of(cls, value: np.ndarray, grid: Grid) -> "_Differences":
        """Of node values that are NaN where they do not count; an axis of two nodes has none."""
        first, second = np.zeros(grid.shape), np.zeros(grid.shape)
        for axis, count in enumerate(grid.shape):
            if count == 2:
                continue
            below, above = _steps(value, grid, axis)
            first = np.fmax(first, np.fmax(np.abs(below), np.abs(above)))
            second = np.fmax(second, np.abs(above - below))
        return cls(first, second, np.where(np.isnan(value), np.inf, value), np.where(np.isnan(value), -np.inf, value))

    def around(self, grid: Grid) -> "_Differences":
        """The largest, and the range, over each node and its neighbours."""
        largest = (_combined(each, grid, np.maximum) for each in (self.first, self.second))
        return _Differences(*largest, _combined(self.least, grid, np.minimum), _combined(self.most, grid, np.maximum))

    def near(self, fine: Grid, coarse: Grid) -> "_Differences":
        """The same at the nodes of a coarser grid: the differences next to them, the range over two cells around."""
        once = self.around(fine)
        twice = once.around(fine)
        found = (once.first, once.second, twice.least, twice.most)
        return _Differences(*(nearest(each, fine, coarse) for each in found))


def _order_of_slopes(change: np.ndarray, gain: np.ndarray, coarse: Grid) -> np.ndarray:
    """The order by the change between grids over the change between schemes, in the mean over neighbours, (*coarse)."""
    change, gain = _combined(change, coarse, np.add), _combined(gain, coarse, np.add)
    share = np.divide(change, gain, out=np.zeros_like(change), where=gain > 0)
    order = np.interp(np.log(np.maximum(share, SMOOTH / 2)), np.log([SMOOTH, ALIKE]), [SECOND, FIRST])
    return np.where(share > ONE, SECOND, order)  # the schemes are one, as where noise allows central differences


def _order_of_bends(fine: _Differences, rough: _Differences, ratio: float) -> np.ndarray:
    """The order by which second differences fall, (*coarse)."""
    counts = (fine.second > BENT * fine.first) & (rough.second > 0)
    return np.clip(np.where(counts, _exponent(fine.second, rough.second, ratio), SECOND), LEAST, SECOND)


def _jumps(fine: _Differences, rough: _Differences, ratio: float) -> np.ndarray:
    """The range of V over neighbouring cells where V jumps, by how first differences fall, (*coarse)."""
    falls = _exponent(fine.first, rough.first, ratio)
    share = np.clip((CONTINUOUS - falls) / (CONTINUOUS - JUMP), 0, 1)
    return share * np.maximum(np.where(share > 0, fine.most, 0) - np.where(share > 0, fine.least, 0), 0)


def _exponent(fine: np.ndarray, rough: np.ndarray, ratio: float) -> np.ndarray:
    """a in fine = rough/ratio^a; one where either is zero."""
    counts = (fine > 0) & (rough > 0)
    quotient = np.divide(rough, fine, out=np.full(fine.shape, ratio), where=counts)
    return np.log(quotient) / np.log(ratio)


def _steps(values: np.ndarray, grid: Grid, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """The differences to the lower and to the upper neighbour, NaN across an end."""
    count, steps = grid.shape[axis], np.diff(_padded(values, grid, axis, np.nan), axis=axis)
    return np.take(steps, range(count), axis=axis), np.take(steps, range(1, count + 1), axis=axis)


def _padded(values: np.ndarray, grid: Grid, axis: int, beyond: float | None) -> np.ndarray:
    """The values with one more at both ends of an axis: around a period, else a number or the end itself."""
    width = [(int(i == axis),) * 2 for i in range(grid.ndim)]
    if grid.periodic[axis]:  # type: ignore[index]
        return np.pad(values, width, mode="wrap")
    return np.pad(values, width, mode="edge") if beyond is None else np.pad(values, width, constant_values=beyond)


def _combined(values: np.ndarray, grid: Grid, combine: Callable[[Any, Any], Any]) -> np.ndarray:
    """The values of every node and its neighbours, combined."""
    for axis, count in enumerate(grid.shape):
        wide = _padded(values, grid, axis, None)
        below, here, above = (np.take(wide, range(k, k + count), axis=axis) for k in range(3))
        values = combine(combine(below, here), above)
    return values
