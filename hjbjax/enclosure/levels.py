"""Bounds as functions Φ(W) of a candidate W: a shift, or, for costs until a target, a function with a slope per level.

Let κ(s) ≥ 0 be the largest relative defect of all cells in which W takes the value s. A lower bound has the slope
1/(1 + κ(s)) at the level s, and an upper bound 1/(1 − κ(s)), from the level on where κ ≥ 1 it is infinite. Φ is linear
between levels. Its numbers are rounded to its side.
"""

import dataclasses

import numpy as np

from hjbjax.tracing.intervals import EPS, Interval, point, quietly

COUNT = 4096  # levels: their spacing widens the bounds by at most this fraction of V times the relative defect


@dataclasses.dataclass(frozen=True)
class Levels:
    """A nondecreasing function, linear between levels.

    Attributes:
      edges: the levels, increasing, (count,). The first piece continues below its level.
      values: the function at the levels, (count,).
      slopes: its slope above each level, (count,); infinite from a level on above which an upper bound is unknown.
      sign: 1 if it belongs to a lower and −1 if it belongs to an upper bound.
    """

    edges: np.ndarray
    values: np.ndarray
    slopes: np.ndarray
    sign: int

    @classmethod
    def shifted(cls, shift: float, sign: int) -> "Levels":
        """W − shift for a lower and W + shift for an upper bound."""
        return cls(np.zeros(1), np.array([-sign * shift]), np.ones(1), sign)

    @quietly
    def at(self, s: Interval) -> np.ndarray:
        """A lower bound of the function if it belongs to a lower bound, otherwise an upper bound."""
        end = s.lo if self.sign > 0 else s.hi
        k = np.clip(np.searchsorted(self.edges, end, side="right") - 1, 0, None)
        found = point(self.values[k]) + point(self.slopes[k]) * (point(end) - point(self.edges[k]))
        return found.lo if self.sign > 0 else np.where(np.isinf(self.slopes[k]), np.inf, found.hi)


@quietly
def levels_of(least: np.ndarray, largest: np.ndarray, relative: np.ndarray, start: float, sign: int) -> Levels:
    """The function for the relative defects of some cells.

    Args:
      least: a lower bound of W in every cell, (count,).
      largest: an upper bound of W in every cell, (count,).
      relative: the relative defect of every cell, (count,); a negative one counts as zero.
      start: the value of the function at the lowest level, minus this level.
      sign: 1 for a lower and −1 for an upper bound.
    """
    low, high = float(np.min(least)), float(np.max(largest))
    edges = np.linspace(low, high, COUNT) if high > low else np.array([low])
    first = np.clip(np.searchsorted(edges, least, side="right") - 1, 0, None)
    last = np.clip(np.searchsorted(edges, largest, side="right") - 1, 0, None)
    worst = point(np.maximum(_largest_over(first, last, np.nan_to_num(relative, nan=np.inf), len(edges)), 0.0))
    one = point(1.0)
    if sign > 0:
        slopes = np.maximum((one / (one + worst)).lo, 0.0)
    else:
        slopes = np.where(worst.hi < 1, (one / (one - worst)).hi, np.inf)
        slopes = np.where(slopes > 0, slopes, np.inf)
        slopes = np.where(np.maximum.accumulate(np.isinf(slopes)), np.inf, slopes)
    steps = slopes[:-1] * np.diff(edges)
    steps = np.where(np.isnan(steps), np.inf, steps)
    values = np.concatenate([[0.0], np.cumsum(steps)])
    # each step is rounded four times, and each sum once per step
    slack = (len(edges) + 8) * EPS * (np.abs(values) + abs(low) + abs(start))
    ends = low + start + values
    return Levels(edges, np.where(np.isfinite(values), ends - sign * slack, np.inf), slopes, sign)


def _largest_over(first: np.ndarray, last: np.ndarray, numbers: np.ndarray, count: int) -> np.ndarray:
    """For every k, the largest of the numbers of all intervals first ≤ k ≤ last that contain k; −∞ if there is none.

    An interval is covered by two of its size rounded down to a power of two.
    """
    sizes = np.floor(np.log2(last - first + 1)).astype(int)
    found = np.full(count, -np.inf)
    for power in range(int(sizes.max()), -1, -1):
        length, own = 2**power, sizes == power
        for starts in (first[own], last[own] - length + 1):
            np.maximum.at(found, starts, numbers[own])
        if power:  # each interval of this length becomes two of half the length
            later = np.full(count, -np.inf)
            later[length // 2 :] = found[: count - length // 2]
            found = np.maximum(found, later)
    return found
