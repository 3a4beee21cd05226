"""The level σ of the splines that bound a tube: the conditions of the cells that it meets, and where they are bisected.

Several candidates W₁, …, W_m bound a side together, W being the largest of them with the sign of the side. A cell
requires something of a candidate only if the candidate may be at the level σ there and no other one is above it.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from hjbjax.enclosure.tube_levels import Sides, TubeTask, above
from hjbjax.tracing.intervals import quietly

UP = 1 + 1e-12  # more than the rounding of a few products and sums
TRIALS = 100  # guesses of the rise of the level in one time slab
MORE = 1.01  # a guess exceeds the rise that the last one required by this factor
JUMPS = np.linspace(0.1, 0.9, 9)  # tried jumps of the level before a time slab, as parts of its rise without a jump
WIDER = 4  # largest number of times that the band of evaluated cells is doubled
WORTH = 0.7  # a cell is bisected if its rate exceeds this fraction of the largest rate in its time slab


@dataclasses.dataclass(frozen=True, eq=False)
class Candidate:
    """A spline W with the conditions of its cells.

    Attributes:
      task: the data with its coefficients.
      found: the conditions.
      cuts: the number of times that each cell is bisected along every axis, (*cells).
    """

    task: TubeTask
    found: Sides
    cuts: np.ndarray

    @classmethod
    def of(cls, task: TubeTask) -> "Candidate":
        """A candidate of which no cell is evaluated yet."""
        found = task.hulls()
        return cls(task, found, np.zeros(found.known.shape, int))

    def ends(self, side: int) -> tuple[np.ndarray, np.ndarray]:
        """The least and the largest W of every cell, with the sign of the side."""
        return (self.found.least, self.found.most) if side == 0 else (-self.found.most, -self.found.least)


def largest_least(some: Sequence[Candidate], side: int) -> np.ndarray:
    """A lower bound of the largest candidate in every cell, with the sign of the side, (*cells)."""
    return np.max([each.ends(side)[0] for each in some], axis=0)


@dataclasses.dataclass(frozen=True)
class LevelSearch:
    """Levels of candidates.

    Attributes:
      levels: v for both sides, with the sign of the side.
      ranges: the least value, with the sign of the side, of the obstacles that help and hinder it, each (2, *cells).
      band: the distance from v up to which cells are evaluated at first.
      depth: the number of times that a cell may be bisected along every axis.
    """

    levels: tuple[float, float]
    ranges: tuple[np.ndarray, np.ndarray]
    band: float
    depth: int

    @classmethod
    def of(cls, some: Candidate, levels: tuple[float, float], depth: int) -> "LevelSearch":
        """A search with a band of about one cell."""
        middle, found = (levels[0] - levels[1]) / 2, some.found
        widths = (found.most - found.least)[(found.least <= middle) & (found.most >= middle)]
        band = float(np.median(widths)) / 4 if widths.size else 0.0
        return cls(levels, some.task.obstacle_ranges(), band, depth)

    def paths(self, some: Sequence[Candidate], sides: Sequence[int], wider: int) -> tuple[list[np.ndarray], int]:
        """σ per side at the beginning of every time slab and at the horizon, and the number of bisected cells.

        Args:
          some: the candidates; cells that the levels may meet are evaluated.
          sides: 0 for the lower and 1 for the upper side.
          wider: the largest number of times that the band is doubled for a side whose level leaves it. Its path then
            is infinite at the first times.
        """
        bands, bisected = [self.band] * len(sides), 0
        for _ in range(wider + 1):
            for each in some:
                pairs = zip(sides, bands, strict=True)
                near = np.logical_or.reduce([self._may_meet(each, some, side, band) for side, band in pairs])
                each.task.evaluate(each.found, near & ~each.found.known)
            while True:
                paths, count = [self.level_path(some, side) for side in sides], 0
                for each in some:
                    rows = zip(sides, paths, strict=True)
                    chosen = np.logical_or.reduce([self._worst(each, some, side, path) for side, path in rows])
                    for old in np.unique(each.cuts[chosen]):
                        each.task.refine(each.found, chosen & (each.cuts == old), int(old) + 1)
                    each.cuts[chosen] += 1
                    count += int(chosen.sum())
                if not count:
                    break
                bisected += count
            ended = [bool(np.isfinite(path[0])) for path in paths]
            if all(ended):
                break
            bands = [band if end else 2 * band for band, end in zip(bands, ended, strict=True)]
        return paths, bisected

    def _may_meet(self, each: Candidate, some: Sequence[Candidate], side: int, band: float) -> np.ndarray:
        """True for cells of a candidate from which a level in the band requires something, (*cells)."""
        level = self.levels[side]
        meets = (largest_least(some, side) <= level + band) & (each.ends(side)[1] >= level)
        return meets & ~(self.ranges[0][side] >= level)

    def _worst(self, each: Candidate, some: Sequence[Candidate], side: int, path: np.ndarray) -> np.ndarray:
        """True for cells that are bisected next: the level meets them, and their rate is large in their time slab.

        In a slab with cells that are not bisected again, only cells with a larger rate than theirs count.

        Args:
          each: the candidate.
          some: all candidates.
          side: 0 for the lower and 1 for the upper side.
          path: its σ.
        """
        found, level, final = each.found, self.levels[side], each.cuts >= self.depth
        if not np.isfinite(path[-1]):
            return np.zeros(found.known.shape, bool)
        fill = (slice(None), *(None,) * (found.known.ndim - 1))
        path = np.where(np.isfinite(path), path, path[np.isfinite(path)][0])  # the level before it left the band
        before, after = path[:-1][fill], path[1:][fill]
        meets = found.known & (largest_least(some, side) <= before) & (each.ends(side)[1] >= after)
        meets &= ~((self.ranges[0][side] >= level) | (found.helper[side] <= after - level))
        rate, axes = np.where(meets, found.rate[side], 0.0), tuple(range(1, found.known.ndim))
        least = np.maximum(WORTH * rate.max(axis=axes), np.where(final, rate, 0.0).max(axis=axes))
        return (rate > least[fill]) & ~final

    @quietly
    def level_path(self, some: Sequence[Candidate], side: int) -> np.ndarray:
        """σ at the beginning of every time slab and at the horizon, with the sign of the side; infinite if unknown."""
        level, count = self.levels[side], some[0].found.known.shape[0]
        least = largest_least(some, side).reshape(count, -1)
        most, rate, helper, hinder = (
            np.stack([part.reshape(count, -1) for part in parts], axis=1)
            for parts in zip(*(
                (each.ends(side)[1], each.found.rate[side], each.found.helper[side], each.found.hinder[side])
                for each in some
            ), strict=True)
        )  # fmt: skip
        helped, hindered = (each[side].reshape(count, -1) for each in self.ranges)
        table, path = some[0].task.spline.tables[0], np.full(count + 1, np.inf)
        edges = np.concatenate([table.at[:1], table.between, table.at[-1:]])
        # a level below all W is as good as any lower one
        lowest = 2 * float(np.min(least)) - float(np.max(most))
        path[count] = max(lowest, *(each.task.at_horizon(level, side) for each in some))
        for k in range(count - 1, -1, -1):
            must = np.where(hindered[k] < level, above(np.minimum(most[k], level + hinder[k])), -np.inf)
            now = max(float(path[k + 1]), float(np.max(must)))
            near = (most[k] >= now) & ~(helped[k] >= level)
            cells = np.broadcast_to(least[k], near.shape)[near], rate[k][near], helper[k][near] + level
            path[k] = _level_before(*cells, now, (edges[k + 1] - edges[k]) * UP)
        return path


def _level_before(least: np.ndarray, rate: np.ndarray, helped: np.ndarray, now: float, duration: float) -> float:
    """The level before a time slab, from the level after it.

    A level that first jumps may end lower, because an obstacle then helps it in more cells.

    Args:
      least: the least W, with the sign of the side, of the cells that reach the level after the slab.
      rate: their rates.
      helped: the levels from which on they require nothing.
      now: the level after the slab.
      duration: the length of the slab.
    """

    def before(start: float) -> float:
        chosen = ~(above(helped) < start)
        return _level_after_rise(least[chosen], rate[chosen], start, duration)

    found = before(now)
    if not np.isfinite(found) or not np.any(np.isfinite(helped)):
        return found
    return min(found, *(before(now + share * (found - now)) for share in JUMPS))


def _level_after_rise(least: np.ndarray, rate: np.ndarray, now: float, duration: float) -> float:
    """The level before a time slab in which it does not jump and meets some cells with these rates."""
    rise = 0.0
    for _ in range(TRIALS):
        fastest = float(np.max(rate[least <= above(now + rise)], initial=0.0))
        if duration * fastest * UP <= rise:
            return float(above(now + rise))
        rise = duration * fastest * UP * MORE
        if not np.isfinite(rise):
            break
    return np.inf
