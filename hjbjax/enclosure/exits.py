"""The target between the nodes: cells inside it, cells that its boundary cuts, and the exit cost.

Paths end where g ≤ 0 and pay ψ. A candidate W must be compared with ψ where they end, on g = 0. For any number μ

    W − ψ = W − ψ − μ g   where g = 0,     W − ψ ≤ W − ψ − μ g   where g ≤ 0 and μ ≥ 0.

W − ψ varies over a cell by as much as V does. With μ = (DW − Dψ)·Dg/|Dg|² the right side hardly varies, so its range is
narrow: the width of the range falls with the square of the width of the cell.
"""

import dataclasses

import numpy as np

from hjbjax.enclosure import defect
from hjbjax.enclosure.defect import Index
from hjbjax.enclosure.interpolant import Cells, Spline
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import TINY, Interval, quietly
from hjbjax.tracing.taylor_forms import Form

DEPTH = 2  # bisections along every axis of the cells that the boundary of the target may cut


@dataclasses.dataclass(frozen=True)
class Exit:
    """The target in the cells of a grid.

    Attributes:
      inside: True for cells in which g ≤ 0 everywhere, shape (*cells).
      meets: True for cells in which g ≤ 0 may hold somewhere, shape (*cells).
      least: a lower bound of ψ in every cell that meets the target, shape (*cells).
      largest: an upper bound of ψ there.
      cut: the number along every axis of the cells that the boundary may cut.
      parts: parts of these cells; ``None`` if there are none.
      level: g over these parts.
      paid: ψ over these parts.
    """

    inside: np.ndarray
    meets: np.ndarray
    least: np.ndarray
    largest: np.ndarray
    cut: Index
    parts: Cells | None
    level: Form
    paid: Form

    @quietly
    def shift(self, values: np.ndarray, sign: int) -> tuple[float, np.ndarray]:
        """An upper bound of W − ψ where g = 0, or of ψ − W if ``sign`` is −1.

        Args:
          values: the coefficients of W.
          sign: 1 or −1.

        Returns:
          The number, and True for cells in which it may be larger where g < 0, (*cells).
        """
        over = np.zeros(self.inside.shape, bool)
        if self.parts is None:
            return -np.inf, over
        w, _ = self.parts.scalars(values)
        difference = w - self.paid
        slopes = [_middle(each) for each in _all(difference.gradient, len(self.parts.radii))]
        normal = [_middle(each) for each in _all(self.level.gradient, len(self.parts.radii))]
        size = sum(each * each for each in normal)
        ratio = sum(a * b for a, b in zip(slopes, normal, strict=True)) / np.maximum(size, TINY)
        ratio = np.where(np.isfinite(ratio), np.maximum(ratio, 0.0), 0.0)
        moved = difference - tf.constant(ratio) * self.level
        found, level = moved.bounds(self.parts.radii), self.level.bounds(self.parts.radii)
        excess = found.hi if sign > 0 else -found.lo
        largest = float(np.max(np.where((level.lo <= 0) & (level.hi >= 0), excess, -np.inf)))
        beyond = ~(level.lo > 0) & ~(excess <= largest)
        over[self.cut] = np.any(beyond.reshape(len(self.cut[0]), -1), axis=1)
        return largest, over


def _all(gradient: tuple[Interval | None, ...], count: int) -> list[Interval | None]:
    return list(gradient) or [None] * count


def _middle(each: Interval | None) -> np.ndarray:
    return np.zeros(()) if each is None else (each.lo + each.hi) / 2


@quietly
def exit_of(problem: Problem, grid: Grid, spline: Spline) -> Exit:
    """The target of a problem in the cells of a grid."""
    whole = defect.parts_of(grid, spline, defect.all_cells(spline), 0)
    level, paid = _functions(problem, grid, whole)
    reach, cost = level.bounds(whole.radii), paid.bounds(whole.radii)
    inside, meets, least, largest = (
        np.broadcast_to(each, spline.shape) for each in (reach.hi <= 0, ~(reach.lo > 0), cost.lo, cost.hi)
    )
    cut = np.nonzero(meets & ~inside)
    if not len(cut[0]):
        return Exit(inside, meets, least, largest, cut, None, level, paid)
    parts = defect.parts_of(grid, spline, cut, DEPTH)
    level, paid = _functions(problem, grid, parts)
    return Exit(inside, meets, least, largest, cut, parts, level, paid)


def _functions(problem: Problem, grid: Grid, cells: Cells) -> tuple[Form, Form]:
    """The function of the target and the exit cost over some cells."""
    x = tf.coordinates(cells.ranges, cells.centres, grid.ndim)
    level = tf.taylor_forms(problem.target, x).reshape(-1)[0]
    cost = 0.0 if problem.exit_cost is None else problem.exit_cost
    return level, tf.taylor_forms(cost, *([x] * callable(cost))).reshape(-1)[0]
