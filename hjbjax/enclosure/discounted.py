"""Bounds of a problem with a discount: candidates, their corrections, and the shifts that make them bounds.

A lower bound is the largest of several W − k. Each of them needs its inequality only in cells where it may exceed the
earlier ones.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import numpy as np

from hjbjax.enclosure import correction, defect, walls
from hjbjax.enclosure.bounds import Bound
from hjbjax.enclosure.defect import CellBlock, Defects
from hjbjax.enclosure.interpolant import Spline
from hjbjax.enclosure.levels import Levels
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.tracing.intervals import point

SMOOTHING = 3  # largest number of defect corrections of V, which both bounds start from
WIDENED = 5.0  # the level of a correction is the largest defect divided by this number
FALLS = 0.7  # a defect correction must reduce the mean defect to this fraction, a smoother candidate the shift
HELPS = 0.6  # other candidates are tried if a correction leaves more than this fraction of the shift
SMOOTHER = 3  # the largest number of times that a candidate is smoothed
STAGNANT = 2  # stop after this number of corrections without progress
BISECTIONS = 2  # largest number of bisections of a cell
PASSES = 3  # times that the cells with the largest defects are bisected once more after the last correction
LARGEST = 0.5  # cells with at least this fraction of the largest defect are bisected
SHARE = 0.03  # largest fraction of the cells that are bisected at a time: their parts take as long as half of all cells
WORTH = 0.97  # bisect only if the other cells require less than this fraction of the shift
GAIN = 0.97  # progress means that less than this fraction of the width is left
Kept: TypeAlias = list[tuple[np.ndarray, float]]  # the candidates of a bound, and their shifts
Move = Callable[[np.ndarray], np.ndarray]
Start = Callable[[int], tuple[np.ndarray, Defects]]  # coefficients and their defects by the number of smoothings


@dataclasses.dataclass(frozen=True)
class DiscountTask:
    """The data of both bounds.

    Attributes:
      problem: a problem with costs.
      grid: the grid.
      spline: the cells of the grid.
      known: the functions of the problem over all cells.
      wanted: the width at which corrections stop, in cost units.
      chosen: True at the nodes where narrow bounds are wanted, shape (*grid).
    """

    problem: Problem
    grid: Grid
    spline: Spline
    known: list[CellBlock]
    wanted: float
    chosen: np.ndarray

    def defects(self, values: np.ndarray, some: np.ndarray | None = None) -> Defects:
        """The defects of the spline with these coefficients; infinite outside the cells ``some``, (*cells)."""
        known = self.known if some is None else defect.chosen_cells(self.known, some)
        return defect.defects(self.spline, known, values)

    def policy(self, values: np.ndarray) -> np.ndarray:
        """The control that is optimal for the spline in every cell, (*cells, m); proves nothing."""
        return defect.greedy_policy(self.spline, self.known, values)

    def mover(self, policy: np.ndarray) -> Move:
        """The correction of the coefficients as a function of a source at the nodes, relative to the discount."""
        rates, weights = self.rates()
        solve = functools.cache(lambda: self.solver(policy, rates))  # not needed if the defect is unbounded
        return lambda source: solve()(weights * source)

    def solver(self, policy: np.ndarray, rates: np.ndarray) -> Move:
        """The solution E of (β − L^π) E = s as a function of s, where π is a control in every cell, (*cells, m)."""
        inputs = [correction.on_nodes(policy[..., j], self.grid) for j in range(policy.shape[-1])]
        at_nodes = np.stack(inputs, axis=-1) if inputs else np.zeros((*self.grid.shape, 0))
        return correction.solver(self.problem, self.grid, at_nodes, rates)

    def remaining(self, upper: Bound) -> np.ndarray:
        """The influence of the projected ends, see ``Enclosure.remaining``."""
        return walls.remaining(self.problem, self.grid, self.spline)

    def rates(self) -> tuple[np.ndarray, np.ndarray]:
        """The discount at the nodes, and the number by which a relative source is multiplied there."""
        discount = self.problem.discount
        if callable(discount):
            rates = np.asarray(at_nodes(discount, self.grid))
        else:
            rates = np.full(self.grid.shape, float(discount))
        return rates, rates

    def continued(self, values: np.ndarray) -> np.ndarray:
        """The coefficients where the problem does not determine them; here everywhere as given."""
        return values

    def middle(self, found: Defects) -> np.ndarray | None:
        """The middle of the defect in every cell, or ``None`` if it is unbounded somewhere."""
        middle = (found.low + found.high) / 2
        return middle if np.all(np.isfinite(middle)) else None

    def corrected(self, values: np.ndarray) -> tuple[Start, Move]:
        """The coefficients after defect corrections, as long as the mean defect falls, their defects, and ``mover``.

        The control hardly changes, so the equations of all corrections are factored once.
        """
        values, nodes = self.continued(values), self.grid.nodes().reshape(-1, self.grid.ndim)
        # a spline with the node values as its coefficients is too smooth
        smoothed = self.spline.at(nodes).values(values).lo.reshape(self.grid.shape)
        values = self.continued(2 * values - smoothed)
        found = self.defects(values)
        middle, move = self.middle(found), self.mover(found.policy)
        for _ in range(SMOOTHING):
            if middle is None:
                break
            changed = self.continued(values - move(correction.on_nodes(middle, self.grid)))
            after = self.defects(changed)
            remains = self.middle(after)
            if remains is None or not np.mean(np.abs(remains)) < FALLS * np.mean(np.abs(middle)):
                break
            values, found, middle = changed, after, remains
        return self.smoother(values, found), move

    def bound(self, start: Start, move: Move, sign: int, rounds: int) -> tuple[Bound, np.ndarray]:
        """The best bound after corrections, and the shift that the cell around each node requires without them.

        Raises:
          ValueError: no bound is finite.
        """
        kept: Kept = []
        best, stagnant = np.full(self.grid.shape, -np.inf), 0
        required = np.zeros(self.grid.shape)
        values, found = self.start(start, sign)
        lead = self.lead(values, kept, sign)
        for turn in range(rounds):
            before = float(np.max(sizes_of(found, lead, sign)))
            found = self.bisected(values, found, lead, sign)
            sizes = sizes_of(found, lead, sign)
            shift = float(np.max(sizes))
            if not np.isfinite(shift):
                break
            if not kept:
                required = correction.on_nodes(sizes, self.grid, np.max)
            mean = np.mean(best[self.chosen])
            best = np.maximum(best, sign * values - shift)
            kept.append((values, shift))
            # progress is measured by the part of the width that one more correction may win
            gain = np.mean(best[self.chosen]) - mean
            stagnant = 0 if gain > (1 - GAIN) * max(shift, self.wanted) else stagnant + 1
            if shift <= self.wanted / 4 or stagnant >= STAGNANT or turn == rounds - 1:
                break
            excess = correction.on_nodes(np.maximum(sizes - shift / WIDENED, 0), self.grid)
            values, found, lead, move = self.better(values, found, excess, move, kept, sign, min(HELPS * before, shift))
        if not kept:
            raise ValueError(_no_bound(self.grid, found, sign))
        coefficients, shifts = zip(*kept, strict=True)
        levels = tuple(Levels.shifted(shift, sign) for shift in shifts)
        return Bound(self.spline, coefficients, levels, sign), required

    def smoother(self, values: np.ndarray, found: Defects) -> Start:
        """The coefficients with their defects after a number of smoothings, computed once for both bounds."""

        @functools.cache
        def start(count: int) -> tuple[np.ndarray, Defects]:
            if count == 0:
                return values, found
            smoother = self.continued(correction.mollified(start(count - 1)[0], self.grid))
            return smoother, self.defects(smoother)

        return start

    def start(self, start: Start, sign: int) -> tuple[np.ndarray, Defects]:
        """The candidate, or a smoother one that requires a far smaller shift, and its defects.

        H is concave in the slope, so a mean of W over nearby states is about as good a lower bound as W. It smooths the
        kinks, around which the spline of V oscillates.
        """
        values, found = start(0)
        for k in range(SMOOTHER):
            smoother, after = start(k + 1)
            shifts = [float(np.max(sizes_of(each, np.inf, sign))) for each in (found, after)]
            lost = float(np.mean(sign * (values - smoother)[self.chosen]))
            if not (shifts[1] < FALLS * shifts[0] and shifts[1] + lost < shifts[0]):
                break
            values, found = smoother, after
        return values, found

    def lead(self, values: np.ndarray, kept: Kept, sign: int) -> np.ndarray:
        """The least shift with which a candidate is not better than the bounds so far anywhere in a cell, shape
        (*cells).
        """
        found = np.full(self.spline.shape, np.inf)
        for other, shift in kept:
            found = np.minimum(found, (point(self.spline.range(sign * (values - other)).hi) + point(shift)).hi)
        return found

    def better(
        self, values: np.ndarray, found: Defects, excess: np.ndarray, move: Move,
        kept: Kept, sign: int, enough: float,
    ) -> tuple[np.ndarray, Defects, np.ndarray, Move]:  # fmt: skip
        """A correction for an excess at the nodes, its defects, its lead, and the function for the next correction.

        It follows the paths. If this leaves a shift above ``enough``, the best of it, of the same under the present
        control, and of a bump at the nodes themselves: at a kink that paths leave, the spline has an extremum, where
        the motion does not count and W must be the value of resting there.
        """
        options: list[tuple[float, np.ndarray, Defects, np.ndarray, Move]] = []
        along, fresh = correction.smooth_cover(excess, self.grid), self.mover(found.policy)
        for step, used in ((lambda: move(along), move), (lambda: fresh(along), fresh), (lambda: excess, fresh)):
            option = values - sign * step()
            after, lead = self.defects(option), self.lead(option, kept, sign)
            shift = float(np.max(sizes_of(after, lead, sign)))
            options.append((float(np.mean((sign * option)[self.chosen])) - shift, option, after, lead, used))
            if shift < enough:
                break
        return max(options, key=lambda each: each[0])[1:]

    def bisected(self, values: np.ndarray, found: Defects, lead: np.ndarray, sign: int) -> Defects:
        """The defects after the cells that determine the shift, at most a fraction ``SHARE``, are cut into parts."""
        cuts = np.zeros(self.spline.shape, int)
        # without a further correction only the largest defect counts, which fewer parts reduce
        is_last = bool(np.max(sizes_of(found, lead, sign)) <= self.wanted / 4)
        for turn in range(PASSES if is_last else BISECTIONS):
            sizes = sizes_of(found, lead, sign)
            if not np.all(np.isfinite(sizes)):
                break
            level = max(LARGEST * np.max(sizes), np.quantile(sizes, 1 - SHARE))
            if level > WORTH * np.max(sizes):  # the shift hardly falls, because other cells require almost the same
                break
            chosen = (sizes >= level) & (cuts < BISECTIONS)
            # where the range of the defect is narrow, its largest value is already known
            chosen &= found.high - found.low > 0.2 * np.abs(sizes)
            if not np.any(chosen):
                break
            cuts[chosen] = cuts[chosen] + 1 if is_last else turn + 1
            for depth in np.unique(cuts[chosen]):
                index = np.nonzero(chosen & (cuts == depth))
                parts = defect.blocks(self.problem, self.grid, self.spline, index, int(depth))
                found = defect.defects(self.spline, parts, values, found)
        return found


def at_nodes(function: Any, grid: Grid) -> np.ndarray:
    """A function of the state at the nodes, shape (*grid)."""
    nodes = grid.nodes().reshape(-1, grid.ndim)
    return np.asarray(jax.vmap(function)(nodes), float).reshape(grid.shape)


def sizes_of(found: Defects, lead: np.ndarray | float, sign: int) -> np.ndarray:
    """The shift that every cell requires, (*cells): its defect, or the lead if that is smaller."""
    return np.minimum(found.high if sign > 0 else -found.low, lead)


def _no_bound(grid: Grid, found: Defects, sign: int) -> str:
    """The message for a defect that is not bounded, with the first such cell."""
    sizes = found.high if sign > 0 else -found.low
    index = np.unravel_index(int(np.argmax(~np.isfinite(sizes))), sizes.shape)
    nodes = [np.append(np.asarray(grid.axis(k)), grid.hi[k]) for k in range(grid.ndim)]
    state = [float(nodes[k][i]) for k, i in enumerate(index)]
    return (
        f"enclose: the {'lower' if sign > 0 else 'upper'} bound is infinite: drift, cost or 1/discount is not bounded\n"
        f"in the cell at x = {np.round(state, 4).tolist()}. Functions must be finite and Lipschitz on the whole box,\n"
        "and controls bounded unless the cost is quadratic in them"
    )
