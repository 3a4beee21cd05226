"""Bounds at kinks: the best of several candidates, each of which continues V across kinks from one side.

Where two ways of acting are equally good, V has a concave kink, which a differentiable upper bound cannot touch. But V
is the least of two differentiable functions there, one for each way of acting. On the other side of the kink such a
function is about the extrapolation 2 V(x − s) − V(x − 2s), if s is longer than the distance over which a spline rounds
the kink off. The extrapolations along both directions of every axis are candidates. A candidate has to be a bound only
in cells where it is the best one somewhere.

Each candidate is corrected along the paths of its control, since they leave the kink to one side.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from hjbjax.enclosure import correction
from hjbjax.enclosure.bounds import Bound
from hjbjax.enclosure.defect import Index
from hjbjax.enclosure.discounted import DiscountTask, Kept, Move, Start, sizes_of
from hjbjax.enclosure.levels import Levels
from hjbjax.problem.grid import Grid
from hjbjax.tracing.intervals import point

FAR = 0.1  # more candidates are tried if a bound is off by this fraction of the range of V somewhere ...
MORE = 3  # ... with this many times as many corrections
STEP = 8  # cells; the mean and the spline smooth a kink over about seven
RISE = 0.5  # a candidate loses this fraction of the range of V where it reads beyond an end
LEVEL = 3.0  # the level of a correction is the shift divided by this number
AHEAD = 0.7  # defects count above this fraction of the level of the last correction: the next level is lower
STAGNANT = 5  # stop after this number of corrections without progress ...
FALLS = 0.9  # ... unless the largest defect fell by this factor
PROGRESS = 0.1  # least gain of a correction, relative to the wanted width or to a tenth of the shift
REFRESHED = 4  # corrections that share one factorisation


def bound(task: DiscountTask, start: Start, move: Move, sign: int, rounds: int) -> tuple[Bound, np.ndarray]:
    """The bound of ``DiscountTask.bound``, with more candidates if it is far from V."""
    narrow, sizes = task.bound(start, move, sign, rounds)
    values, _ = start(0)
    shifts = [-sign * float(each.values[0]) for each in narrow.levels]
    kept = list(zip(narrow.coefficients, shifts, strict=True))

    def is_far() -> bool:
        distance = np.max((sign * values - _best(kept, sign))[task.chosen])
        return bool(distance > FAR * np.ptp(values[task.chosen]))

    if is_far():
        smooth = correction.mollified(values, task.grid)
        smoother = correction.mollified(correction.mollified(smooth, task.grid), task.grid)
        kept += further(task, [smoother], kept, sign, MORE * rounds)
        if is_far():
            kept += further(task, extrapolations(smooth, task.grid, sign), kept, sign, MORE * rounds)
    for candidate, shift in kept[len(shifts) :]:
        narrow = narrow.with_candidate(candidate, Levels.shifted(shift, sign))
    return narrow, sizes


def _best(kept: Kept, sign: int) -> np.ndarray:
    """The bound at the nodes, shape (*grid), with its sign changed for an upper bound."""
    return np.max([sign * each - shift for each, shift in kept], axis=0)


def extrapolations(values: np.ndarray, grid: Grid, sign: int) -> list[np.ndarray]:
    """The extrapolations of smooth values along both directions of every axis, shape (*grid) each.

    Next to an end of the box, where an extrapolation would need V beyond the end, it is lowered (``sign`` 1, for lower
    bounds) or raised (−1).
    """
    found = []
    for axis, cyclic in enumerate(grid.periodic):
        count = grid.shape[axis]
        if count < 4 * STEP:
            continue
        wide = correction.pad(values, axis, 2 * STEP, cyclic=cyclic)
        ramp = np.maximum(0, 1 - np.arange(count) / (2 * STEP)) ** 2 * (RISE * np.ptp(values) * (not cyclic))
        for direction in (1, -1):
            near, far = (np.take(wide, np.arange(count) + 2 * STEP - k * direction * STEP, axis=axis) for k in (1, 2))
            steep = ramp[::direction].reshape([count if other == axis else 1 for other in range(grid.ndim)])
            found.append(2 * near - far - sign * steep)
    return found


def further(task: DiscountTask, candidates: Sequence[np.ndarray], kept: Kept, sign: int, rounds: int) -> Kept:
    """Corrections of several candidates that narrow the bound, with their shifts.

    Args:
      task: the data of the bounds.
      candidates: the candidates, shape (*grid) each; none on few nodes.
      kept: the candidates of the bound so far, and their shifts.
      sign: 1 for a lower and −1 for an upper bound.
      rounds: the largest number of corrections.
    """
    added: Kept = []
    moves: list[Move] = []
    leaders, level = Leaders.of(kept, sign), 0.0
    worst, stagnant = np.inf, 0
    for turn in range(rounds if candidates else 0):
        is_open = [~is_beaten(task, candidates, i, sign) for i in range(len(candidates))]
        leads = [leaders.leads(task, each, some) for each, some in zip(candidates, is_open, strict=True)]
        if turn % REFRESHED == 0:
            moves = [task.mover(task.policy(each)) for each in candidates]
        sizes, largest = required(task, candidates, leads, sign, level)
        sizes = leaders.narrowed(task, candidates, sizes)
        shift = float(np.max(sizes))
        if not np.isfinite(shift):
            break
        fresh = [(each, shift) for each in candidates]
        better = leaders.with_candidates(fresh)
        stagnant = 0 if largest < FALLS * worst else stagnant + 1
        worst = min(worst, largest)
        if np.mean((better.values - leaders.values)[task.chosen]) > PROGRESS * max(task.wanted, shift / 10):
            leaders, stagnant = better, 0
            added += fresh
        if shift <= task.wanted / 4 or stagnant >= STAGNANT:
            break
        level = AHEAD * shift / LEVEL
        excess = [correction.on_nodes(np.maximum(each - shift / LEVEL, 0), task.grid) for each in sizes]
        candidates = [
            each - sign * move(correction.smooth_cover(source, task.grid)) if np.any(source) else each
            for each, move, source in zip(candidates, moves, excess, strict=True)
        ]
    return added


@dataclasses.dataclass(frozen=True)
class Leaders:
    """The best of several candidates at every node.

    Attributes:
      kept: the candidates and their shifts.
      sign: 1 for a lower and −1 for an upper bound.
      values: the bound at the nodes, with its sign changed for an upper bound, shape (*grid).
      which: the number of the best candidate, (*grid).
    """

    kept: Kept
    sign: int
    values: np.ndarray
    which: np.ndarray

    @classmethod
    def of(cls, kept: Kept, sign: int) -> "Leaders":
        """The best of some candidates."""
        shape = kept[0][0].shape
        return cls([], sign, np.full(shape, -np.inf), np.zeros(shape, int)).with_candidates(kept)

    def with_candidates(self, more: Kept) -> "Leaders":
        """The best of these and of some more candidates."""
        values, which = self.values, self.which
        for k, (each, shift) in enumerate(more, len(self.kept)):
            own = self.sign * each - shift
            values, which = np.maximum(values, own), np.where(own > values, k, which)
        return Leaders([*self.kept, *more], self.sign, values, which)

    def leads(self, task: DiscountTask, values: np.ndarray, some: np.ndarray) -> np.ndarray:
        """The shift with which a candidate is not better in a cell than the best one at its node; zero in other cells.

        Args:
          task: the data of the bounds.
          values: the candidate, (*grid).
          some: True for the cells, (*cells).
        """
        found, index = np.zeros(some.shape), np.nonzero(some)
        which = self.which[tuple(i % count for i, count in zip(index, values.shape, strict=True))]
        for k in np.nonzero(np.bincount(which, minlength=1))[0]:
            own = tuple(i[which == k] for i in index)
            found[own] = self.lead(task, values, int(k), own)
        return found

    def lead(self, task: DiscountTask, values: np.ndarray, k: int, index: Index) -> np.ndarray:
        """The shift with which a candidate is not better than the k-th one anywhere in listed cells, (count,)."""
        other, shift = self.kept[k]
        pair = (values, other) if self.sign > 0 else (other, values)
        return (point(task.spline.largest_difference(*pair, index)) + point(shift)).hi

    def narrowed(
        self, task: DiscountTask, candidates: Sequence[np.ndarray], sizes: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """The required shifts of the cells that a correction changes, if all leads count and not only the first."""
        found, level = [each.copy() for each in sizes], float(np.max(sizes)) / LEVEL
        for each, own in zip(candidates, found, strict=True):
            index = np.nonzero(own > level)
            for k in range(len(self.kept)):
                own[index] = np.minimum(own[index], self.lead(task, each, k, index))
        return found


def is_beaten(task: DiscountTask, candidates: Sequence[np.ndarray], i: int, sign: int) -> np.ndarray:
    """True in cells in which another candidate with the same shift is better everywhere, (*cells)."""
    others = [each for k, each in enumerate(candidates) if k != i]
    worse = [task.spline.range(sign * (candidates[i] - other)).hi < 0 for other in others]
    return np.logical_or.reduce([np.zeros(task.spline.shape, bool), *worse])


def required(
    task: DiscountTask, candidates: Sequence[np.ndarray], leads: Sequence[np.ndarray], sign: int, level: float
) -> tuple[list[np.ndarray], float]:
    """The shift that every cell requires of every candidate, if all have the same shift, and the largest defect.

    Args:
      task: the data of the bounds.
      candidates: the candidates, (*grid) each.
      leads: their leads, (*cells) each; zero where nothing is required.
      sign: 1 for a lower and −1 for an upper bound.
      level: a lead up to this number counts as required, instead of a defect that may be smaller.
    """
    sizes, largest = [], 0.0
    for each, lead in zip(candidates, leads, strict=True):
        some = lead > level
        need = sizes_of(task.defects(each, some), np.inf, sign)
        sizes.append(np.minimum(need, lead))
        largest = max(largest, float(np.max(need[some], initial=0.0)))
    return sizes, largest
