"""Bounds on the cost until a target is met, without a discount: the defect counts relative to the running cost.

Let L ≥ ℓ > 0 outside the target. With κ as in ``levels``,

- if L + f·DW ≥ −κ L for all controls and W ≤ ψ + c where paths end, V ≥ Φ(W) with Φ' = 1/(1 + κ);
- if L + f·DW ≤ κ L for the minimiser and W ≥ ψ − c where paths end, V ≤ Φ(W) with Φ' = 1/(1 − κ).

W falls along the paths of the second kind. So a cell matters only at levels above its own. A cell without a bound, such
as a cell at a concave kink, makes the upper bound infinite only above its level. A correction lifts these cells above
all others. It changes nothing at states whose paths do not meet them.
"""

import dataclasses

import numpy as np

from hjbjax.enclosure import correction, defect, walls
from hjbjax.enclosure.bounds import Bound
from hjbjax.enclosure.defect import Defects
from hjbjax.enclosure.discounted import BISECTIONS, STAGNANT, WIDENED, DiscountTask, Move, Start, at_nodes
from hjbjax.enclosure.exits import DEPTH, Exit, exit_of
from hjbjax.enclosure.interpolant import Spline
from hjbjax.enclosure.levels import Levels, levels_of
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import point

BAD = 0.5  # cells with at least this relative defect are lifted above the others
LEAK = 0.01  # discount of the corrections, times the range of V over the least cost: keeps their equations regular
LIMIT = 0.5  # a defect correction clips relative defects to this
BLANK = 1e-5  # values this close to the exit cost, relative to the range of V, are equal to it
LIFT = 1.5  # height of a lifted cell, relative to the range of W
HELD = 1e12  # rate of the nodes whose correction is prescribed, relative to the leak


@dataclasses.dataclass(frozen=True)
class ExitTask(DiscountTask):
    """The data of both bounds.

    Attributes:
      exit: the target in the cells.
      unit: a lower bound of the running cost at the nodes, shape (*grid); proves nothing.
      ended: True at the nodes of the target.
      level: g at the nodes.
      paid: ψ at the nodes.
      blank: True at the nodes of the target where the solution is the exit cost, so that it determines no slope.
      leak: a small discount of the corrections, per unit time.
    """

    exit: Exit
    unit: np.ndarray
    ended: np.ndarray
    level: np.ndarray
    paid: np.ndarray
    blank: np.ndarray
    leak: float

    def defects(self, values: np.ndarray, some: np.ndarray | None = None) -> Defects:
        """The defects relative to the least running cost; zero inside the target."""
        return self.outside(super().defects(values, some))

    def outside(self, found: Defects) -> Defects:
        """The defects with zero inside the target."""
        low, high = (np.where(self.exit.inside, 0.0, each) for each in (found.low, found.high))
        return Defects(low, high, found.policy)

    def remaining(self, upper: Bound) -> np.ndarray:
        """Zero where a path that meets a projected end costs more than the upper bound, otherwise one."""
        nodes = self.grid.nodes().reshape(-1, self.grid.ndim)
        times = walls.times(self.problem, self.grid, self.spline)
        spent, paid = float(np.min(self.unit)) * times * (1 - walls.ROUNDING), float(np.min(self.exit.least))
        most = upper.at(nodes).reshape(self.grid.shape)
        return np.where((most - paid < spent - walls.ROUNDING * abs(paid)) | np.isinf(times), 0.0, 1.0)

    def rates(self) -> tuple[np.ndarray, np.ndarray]:
        """One on the target and a small number elsewhere, and the running cost outside the target."""
        return np.where(self.ended, 1.0, self.leak), np.where(self.ended, 0.0, self.unit)

    def middle(self, found: Defects) -> np.ndarray:
        """The middle of the defect in every cell; a large one counts as ``LIMIT``."""
        with np.errstate(invalid="ignore"):
            middle = (found.low + found.high) / 2
        return np.clip(np.nan_to_num(middle), -LIMIT, LIMIT)

    def continued(self, values: np.ndarray) -> np.ndarray:
        """The coefficients with ψ + μ g inside the target, where μ continues (W − ψ)/g from outside."""
        clear = correction.away_from(self.blank, self.grid) & (self.level > 0)
        if not np.any(self.blank) or not np.any(clear):
            return values
        with np.errstate(all="ignore"):
            ratio = (values - self.paid) / self.level
        ratio = correction.nearest_known(ratio, clear, self.grid)
        return np.where(self.blank, self.paid + ratio * self.level, values)

    def bound(self, start: Start, move: Move, sign: int, rounds: int) -> tuple[Bound, np.ndarray]:
        """The best bound after corrections, and the relative defect of the cell around each node without them.

        Raises:
          ValueError: no bound is finite.
        """
        kept: list[tuple[np.ndarray, Levels]] = []
        values, found = start(0)
        base, policy = values, found.policy
        lifted, required = np.zeros(self.grid.shape, bool), np.zeros(self.grid.shape)
        beyond = np.zeros(self.spline.shape, bool)
        best, stagnant = np.full(self.grid.shape, np.inf), 0
        for _ in range(rounds):
            found = self.refined(values, found, sign)
            sizes = np.where(self.exit.inside, -np.inf, found.high if sign > 0 else -found.low)
            shift, over = self.exit.shift(values, sign)
            if not np.isfinite(shift):
                break
            levels, beyond = self.levels(values, sizes, shift, sign), beyond | over
            if not kept:
                required = correction.on_nodes(np.maximum(sizes, 0.0), self.grid, np.max)
            kept.append((values, levels))
            # coefficients instead of values of the spline: this only measures the progress
            gap = np.minimum(sign * (base - levels.at(point(values))), best)
            stagnant = 0 if self.gains(gap, best) else stagnant + 1
            best = gap
            if stagnant >= STAGNANT or np.mean(best[self.chosen]) <= self.wanted / 4:
                break
            bad = (correction.on_nodes(np.where(sizes >= BAD, 1.0, 0.0), self.grid, np.max) > 0) & ~lifted
            if np.any(bad):
                lifted |= ~correction.away_from(bad, self.grid)
            else:
                excess = np.where(lifted, 0.0, correction.on_nodes(np.maximum(sizes, 0.0), self.grid))
                excess = np.maximum(excess - np.max(excess) / WIDENED, 0.0)
                base = base - sign * move(correction.smooth_cover(excess, self.grid))
            values = base - sign * self.lift(policy, lifted, base)
            found = self.defects(values)
        if not kept:
            raise ValueError(
                f"enclose: the {'lower' if sign > 0 else 'upper'} bound is infinite at the target. The exit cost must\n"
                "be bounded there, and the target wider than a few cells; use more nodes"
            )
        coefficients, functions = zip(*kept, strict=True)
        return Bound(self.spline, coefficients, functions, sign, self.caps(beyond, sign)), required

    def gains(self, gap: np.ndarray, best: np.ndarray) -> bool:
        """True if the bound is finite at more nodes, or narrower by a part of the wanted width."""
        gap, best = gap[self.chosen], best[self.chosen]
        known = np.isfinite(best)
        if np.sum(np.isfinite(gap)) > np.sum(known):
            return True
        gain = np.mean(best[known] - gap[known]) if np.any(known) else 0.0
        return bool(gain > 0.03 * max(np.mean(gap[known]), self.wanted)) if np.any(known) else False

    def levels(self, values: np.ndarray, sizes: np.ndarray, start: float, sign: int) -> Levels:
        """The function of the spline that is a bound."""
        ranges = self.spline.range(values)
        there = ~self.exit.inside
        return levels_of(ranges.lo[there], ranges.hi[there], sizes[there], -sign * start, sign)

    def caps(self, beyond: np.ndarray, sign: int) -> np.ndarray:
        """The least and the largest bound in every cell, see ``Bound``.

        Inside the target they are the bounds of ψ. In a cell that the boundary may cut the upper bound is at least ψ.
        The lower bound is below ψ there without a cap, except in a few cells.

        Args:
          beyond: True for these cells, (*cells).
          sign: 1 for a lower and −1 for an upper bound.
        """
        least, largest = np.full(self.spline.shape, -np.inf), np.full(self.spline.shape, np.inf)
        inside = self.exit.inside
        if sign > 0:
            return np.stack([
                np.where(inside, self.exit.least, least), np.where(inside | beyond, self.exit.least, largest)
            ])  # fmt: skip
        least = np.where(self.exit.meets, self.exit.largest, least)
        return np.stack([least, np.where(inside, self.exit.largest, largest)])

    def refined(self, values: np.ndarray, found: Defects, sign: int) -> Defects:
        """The defects after the cells with the largest finite ones, at most one in ten, are cut into parts."""
        for depth in range(1, BISECTIONS + 1):
            sizes = np.where(self.exit.inside, -np.inf, found.high if sign > 0 else -found.low)
            chosen = sizes >= max(float(np.quantile(sizes, 0.9)), 1e-6)
            chosen &= found.high - found.low > 0.2 * np.abs(sizes)
            if not np.any(chosen):
                break
            parts = defect.blocks(self.problem, self.grid, self.spline, np.nonzero(chosen), depth)
            found = self.outside(defect.defects(self.spline, parts, values, found))
        return found

    def lift(self, policy: np.ndarray, lifted: np.ndarray, values: np.ndarray) -> np.ndarray:
        """The height by which every node is lifted: the probability that paths visit some nodes before they end.

        Nodes of the target are lifted too: W may exceed ψ for an upper bound, and be less for a lower bound.

        Args:
          policy: the control in every cell, (*cells, m).
          lifted: True for the nodes that are lifted above all others.
          values: the coefficients.
        """
        if not np.any(lifted):
            return np.zeros(self.grid.shape)
        rates = np.where(lifted, HELD * self.leak, self.rates()[0])
        return LIFT * float(np.ptp(values)) * np.clip(self.solver(policy, rates)(rates * lifted), 0.0, 1.0)


def exit_task(
    problem: Problem, grid: Grid, spline: Spline, value: np.ndarray, chosen: np.ndarray, wanted: float
) -> ExitTask:
    """The data of the bounds of a problem without a discount.

    Raises:
      ValueError: the target or the exit cost is not a scalar, or NaN somewhere; no cell or every cell is in the target;
        or the running cost is not known to be positive outside the target.
    """
    level, paid = _exit_at_nodes(problem, grid)
    exit, unit = exit_of(problem, grid, spline), np.full(spline.shape, np.inf)
    if np.all(exit.inside) or not np.any(exit.meets):
        which = "every cell of the grid is inside" if np.all(exit.inside) else "no cell of the grid meets"
        raise ValueError(
            f"enclose: {which} the target, where the function of the target is at most zero. Without a discount the\n"
            "bounds need a target inside the box that leaves other states; check its sign, or use another box"
        )
    cut = exit.meets & ~exit.inside
    known = [
        each for index, depth in ((~exit.meets, 0), (cut, DEPTH))
        for each in defect.blocks(problem, grid, spline, np.nonzero(index), depth)
    ]  # fmt: skip
    for block in known:
        own = np.where(np.zeros(1, bool) if block.ended is None else block.ended, np.inf, block.known.unit.lo)
        unit[block.index] = np.minimum(unit[block.index], own.reshape(-1, block.number).min(axis=1))
    faulty = ~(unit > 0) & ~exit.inside
    if np.any(faulty):
        index = np.unravel_index(int(np.argmax(faulty)), faulty.shape)
        state = [float(table.at[i]) for table, i in zip(spline.tables, index, strict=True)]
        raise ValueError(
            f"enclose: the running cost is not known to be positive in the cell at x = {np.round(state, 4).tolist()}.\n"
            "Without a discount the bounds need a positive cost outside the target, for all controls"
        )
    least = correction.on_nodes(np.where(exit.inside, np.max(unit[~exit.inside]), unit), grid, np.min)
    leak = LEAK * float(np.min(least)) / (float(np.ptp(value)) or 1.0)
    ended = level <= 0
    blank = ended & (np.abs(value - paid) <= BLANK * (float(np.ptp(value)) or 1.0))
    return ExitTask(problem, grid, spline, known, wanted, chosen, exit, least, ended, level, paid, blank, leak)


def _exit_at_nodes(problem: Problem, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The function of the target and the exit cost at the nodes, (*grid).

    Raises:
      ValueError: one of them is not a scalar, or NaN at a node.
    """
    found = []
    for name, function in (("target", problem.target), ("exit_cost", problem.exit_cost)):
        if not callable(function):
            found.append(np.full(grid.shape, 0.0 if function is None else float(function)))
            continue
        (shape,) = (each.shape for each in tf.traced(function, [0.0] * grid.ndim).out_avals)
        if shape:
            raise ValueError(f"enclose: {name}(x) returned shape {shape}, wanted one number, of shape ()")
        values = at_nodes(function, grid)
        if np.any(np.isnan(values)):
            state = grid.nodes()[np.unravel_index(int(np.argmax(np.isnan(values))), grid.shape)]
            raise ValueError(
                f"enclose: {name}(x) is NaN at x = {np.round(state, 4).tolist()}; wanted a number at every state of\n"
                "the box. Guard square roots, logarithms and quotients with jnp.maximum or jnp.where"
            )
        found.append(values)
    return found[0], found[1]
