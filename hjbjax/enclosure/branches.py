"""Bounds at kinks: the best of several candidates, each of which continues V across kinks from one side.

Where two ways of acting are equally good, V has a concave kink, which a differentiable upper bound cannot touch. But V
is the least of two differentiable functions there, one for each way of acting. On the other side of the kink such a
function is about the extrapolation 2 V(x − s) − V(x − 2s), if s is longer than the distance over which a spline rounds
the kink off. The extrapolations along both directions of every axis are candidates. A candidate has to be a bound only
in cells where it is the best one somewhere.

Each candidate is corrected along the paths of its control, since they leave the kink to one side.
"""

from collections.abc import Sequence

import numpy as np

from hjbjax.enclosure import correction
from hjbjax.enclosure.bounds import Bound
from hjbjax.enclosure.defect import Defects
from hjbjax.enclosure.discounted import DiscountTask, Kept, Move, sizes_of
from hjbjax.enclosure.levels import Levels
from hjbjax.problem.grid import Grid

FAR = 0.1  # more candidates are tried if a bound is off by this fraction of the range of V somewhere ...
MORE = 3  # ... with this many times as many corrections
STEP = 8  # cells; the mean and the spline smooth a kink over about seven
RISE = 0.5  # a candidate loses this fraction of the range of V where it reads beyond an end
LEVEL = 3.0  # the level of a correction is the shift divided by this number
STAGNANT = 5  # stop after this number of corrections without progress ...
FALLS = 0.9  # ... unless the largest defect fell by this factor
PROGRESS = 0.1  # least gain of a correction, relative to the wanted width or to a tenth of the shift
REFRESHED = 4  # corrections that share one factorisation


def bound(
    task: DiscountTask, values: np.ndarray, found: Defects, move: Move, sign: int, rounds: int
) -> tuple[Bound, np.ndarray]:
    """The bound of ``DiscountTask.bound``, with more candidates if it is far from V."""
    narrow, sizes = task.bound(values, found, move, sign, rounds)
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
    best, worst, stagnant = _best(kept, sign), np.inf, 0
    for turn in range(rounds if candidates else 0):
        found = [task.defects(each) for each in candidates]
        needs = required(task, candidates, found, sign)
        largest = float(np.max(needs))
        leads = [task.lead(each, [*kept, *added], sign) for each in candidates]
        sizes = np.minimum(needs, leads)
        shift = float(np.max(sizes))
        if not np.isfinite(shift):
            break
        fresh = [(each, shift) for each in candidates]
        better = np.maximum(best, _best(fresh, sign))
        stagnant = 0 if largest < FALLS * worst else stagnant + 1
        worst = min(worst, largest)
        if np.mean((better - best)[task.chosen]) > PROGRESS * max(task.wanted, shift / 10):
            best, stagnant = better, 0
            added += fresh
        if shift <= task.wanted / 4 or stagnant >= STAGNANT:
            break
        if turn % REFRESHED == 0:
            moves = [task.mover(each) for each in found]
        excess = [correction.on_nodes(np.maximum(each - shift / LEVEL, 0), task.grid) for each in sizes]
        candidates = [
            each - sign * move(correction.smooth_cover(source, task.grid)) if np.any(source) else each
            for each, move, source in zip(candidates, moves, excess, strict=True)
        ]
    return added


def required(
    task: DiscountTask, candidates: Sequence[np.ndarray], found: Sequence[Defects], sign: int
) -> list[np.ndarray]:
    """The shift that every cell requires of every candidate, if all have the same shift, shape (*cells) each.

    In a cell in which another candidate is better everywhere, nothing is required.
    """
    needs = []
    for i, (each, defects) in enumerate(zip(candidates, found, strict=True)):
        need = sizes_of(defects, np.inf, sign)
        for other in (*candidates[:i], *candidates[i + 1 :]):
            need = np.where(task.spline.largest(sign * (each - other)) < 0, 0, need)
        needs.append(need)
    return needs
