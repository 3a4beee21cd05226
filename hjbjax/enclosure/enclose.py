"""``enclose``: two functions between which the value of the continuous problem lies, with proof."""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from hjbjax.enclosure import correction, defect, walls
from hjbjax.enclosure.bounds import Bound, Enclosure
from hjbjax.enclosure.defect import CellBlock, Defects
from hjbjax.enclosure.interpolant import Spline
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import REWARD
from hjbjax.problem.problem import Problem, is_constrained, is_discounted, is_random
from hjbjax.problem.pytree import front_door, is_traced
from hjbjax.problem.rewards import costs_of
from hjbjax.problem.sets import Finite
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import in_unit_box
from hjbjax.solution.rewards import in_costs
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status
from hjbjax.solvers import memory
from hjbjax.tracing import closures
from hjbjax.tracing.intervals import point
from hjbjax.tracing.operations import operations
from hjbjax.tracing.taylor_forms import traced

SMOOTHING = 3  # defect corrections before the bounds part
WIDENED = 5.0  # the level of a correction is the largest defect divided by this number
FALLS = 0.7  # a defect correction must reduce the mean defect to this fraction
HELPS = 0.6  # a correction along the paths that leaves more than this fraction of the shift is compared with another
STAGNANT = 2  # corrections without progress after which a bound is given up
BISECTIONS = 2  # of the cells with the largest defects
LARGEST = 0.5  # fraction of the largest defect from which on a cell is bisected
GAIN = 0.97  # a correction that leaves more than this fraction of the width is no progress


@front_door
def enclose(
    problem: Problem,
    solution: Solution,
    *,
    region: Sequence | np.ndarray | None = None,
    tol: float = 1e-3,
    rounds: int = 8,
    max_memory: int | None = None,
) -> Enclosure:
    """Bounds on the value of the continuous problem, with proof: neither the grid nor rounding is neglected.

    A spline W near the solution has the defect β W − H(x, DW). If it is at most β k everywhere, V ≥ W − k; if it is at
    least −β k, V ≤ W + k. The defect is bounded over whole cells by interval arithmetic with outward rounding. Then W
    is corrected where its defect is large, separately for both bounds, and checked again.

    The bounds are those of the problem with the ends of its grid: projected ends are walls that stop outward motion.

    Args:
      problem: one player, a discount, no noise, jumps, modes, targets or obstacles. Drift, cost and discount must be
        Lipschitz functions of the state that are defined on the whole box. On a periodic axis they must be periodic.
      solution: a solution of this problem by ``solve``. The bounds hold for any solution; they are narrow for a good
        one.

    Keyword Args:
      region: where narrow bounds are wanted: a pair (lower corner, upper corner), or a mask of the nodes, bool (*grid).
        Corrections are chosen for this region and end once the bounds are narrow there. The bounds hold everywhere.
      tol: the wanted mean width in the region, relative to the range of V there.
      rounds: the largest number of corrections per bound.
      max_memory: the number of bytes that count as free.

    Returns:
      An Enclosure.

    Raises:
      ValueError: the problem has an ingredient for which there is no proof, or a function without an interval rule.
      MemoryError: the estimated memory is not free.

    Example:
      >>> import hjbjax as hjb
      >>> problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-2.0], [2.0]), discount=1.0)
      >>> found = hjb.enclose(problem, hjb.solve(problem, hjb.Grid([-1.0], [1.0], (41,))))
      >>> exact = (5**0.5 - 1) / 2 * 0.5**2  # the Riccati equation
      >>> bool(found.lower_at([0.5]) <= exact <= found.upper_at([0.5]))
      True
    """
    start = time.perf_counter()
    own, value, grid = _checked(problem, solution)
    arguments.positive(tol, "enclose: tol")
    count = arguments.count(rounds, "enclose: rounds")
    needed = memory.fitting(_peak_bytes(own, grid), grid, max_memory)
    chosen = _chosen(region, grid)
    scale = float(np.ptp(value[chosen])) or 1.0
    with own_settings(x64=True):
        spline = Spline.on(grid)
        known = defect.blocks(own, grid, spline, defect.all_cells(spline), 0)
        task = _Task(own, grid, spline, known, scale * tol, chosen)
        middle, found = task.corrected(value)
        bounds = [task.bound(middle, found, sign, count) for sign in (1, -1)]
        remaining = walls.remaining(own, grid, spline)
    if problem.payoff == REWARD:
        bounds = [(each.negative(), sizes) for each, sizes in reversed(bounds)]
    (lower, below), (upper, above) = bounds
    nodes = grid.nodes().reshape(-1, grid.ndim)
    low, high = (each.at(nodes).reshape(grid.shape) for each in (lower, upper))
    share = float(np.mean((high - low)[chosen])) / scale
    stats = {"seconds": time.perf_counter() - start, "bytes": needed, "corrections": len(lower.shifts + upper.shifts)}
    status = Status.CONVERGED if share <= tol else Status.MAX_STEPS
    return Enclosure(
        solution.grid, low, high, status, _message(solution.grid, share, tol, region is not None), stats, remaining,
        np.stack([below, above]), (lower, upper),
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _Task:
    """The data of both bounds.

    Attributes:
      problem: a problem of one player with costs.
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

    def defects(self, values: np.ndarray) -> Defects:
        """The defects of the spline with these coefficients."""
        return defect.defects(self.spline, self.known, values)

    def move(self, found: Defects, source: np.ndarray) -> np.ndarray:
        """The correction of the coefficients by a source at the nodes."""
        policy = np.stack(
            [correction.on_nodes(found.policy[..., j], self.grid) for j in range(found.policy.shape[-1])], axis=-1
        ) if found.policy.shape[-1] else None  # fmt: skip
        return correction.solver(self.problem, self.grid, policy, self.rates())(source)

    def rates(self) -> np.ndarray:
        """The discount at the nodes."""
        discount = self.problem.discount
        if not callable(discount):
            return np.full(self.grid.shape, float(discount))
        nodes = self.grid.nodes().reshape(-1, self.grid.ndim)
        return np.asarray(jax.vmap(discount)(nodes)).reshape(self.grid.shape)

    def corrected(self, values: np.ndarray) -> tuple[np.ndarray, Defects]:
        """The coefficients after defect corrections, as long as the mean defect falls, and their defects."""
        nodes = self.grid.nodes().reshape(-1, self.grid.ndim)
        # a spline with the node values as its coefficients is too smooth
        smoothed = self.spline.at(nodes).values(values).lo.reshape(self.grid.shape)
        values = 2 * values - smoothed
        found = self.defects(values)
        for _ in range(SMOOTHING):
            middle = (found.low + found.high) / 2
            if not np.all(np.isfinite(middle)):
                break
            changed = values - self.move(found, correction.on_nodes(middle, self.grid))
            after = self.defects(changed)
            if not np.mean(np.abs(after.low + after.high)) < FALLS * np.mean(np.abs(2 * middle)):
                break
            values, found = changed, after
        return values, found

    def bound(self, values: np.ndarray, found: Defects, sign: int, rounds: int) -> tuple[Bound, np.ndarray]:
        """The best bound after corrections, and the shift that the cell around each node requires without them.

        Raises:
          ValueError: no bound is finite.
        """
        kept: list[tuple[np.ndarray, float]] = []
        best, stagnant = np.full(self.grid.shape, -np.inf), 0
        required = np.zeros(self.grid.shape)
        for _ in range(rounds):
            lead = self.lead(values, kept, sign)
            found = self.bisected(values, found, lead, sign)
            sizes = _sizes(found, lead, sign)
            shift = float(np.max(sizes))
            if not np.isfinite(shift):
                break
            if not kept:
                required = correction.on_nodes(sizes, self.grid, np.max)
            before = np.mean(best[self.chosen])
            best = np.maximum(best, sign * values - shift)
            kept.append((values, shift))
            # progress is measured by the part of the width that one more correction may win
            gain = np.mean(best[self.chosen]) - before
            stagnant = 0 if gain > (1 - GAIN) * max(shift, self.wanted) else stagnant + 1
            if shift <= self.wanted / 4 or stagnant >= STAGNANT:
                break
            excess = correction.on_nodes(np.maximum(sizes - shift / WIDENED, 0), self.grid)
            values, found = self.better(values, found, excess, kept, sign)
        if not kept:
            raise ValueError(_no_bound(self.grid, found, sign))
        coefficients, shifts = zip(*kept, strict=True)
        return Bound(self.spline, coefficients, shifts, sign), required

    def lead(self, values: np.ndarray, kept: list[tuple[np.ndarray, float]], sign: int) -> np.ndarray:
        """The shift from which on a candidate is nowhere in a cell better than the bounds so far, shape (*cells)."""
        found = np.full(self.spline.shape, np.inf)
        for other, shift in kept:
            found = np.minimum(found, (point(self.spline.largest(sign * (values - other))) + point(shift)).hi)
        return found

    def better(
        self, values: np.ndarray, found: Defects, excess: np.ndarray, kept: list[tuple[np.ndarray, float]], sign: int
    ) -> tuple[np.ndarray, Defects]:
        """A correction for an excess at the nodes, and its defects.

        It follows the paths. If this does not help, the better of it and of a bump at the nodes themselves: at a kink
        that paths leave, the spline has an extremum, where the motion does not count and W must be the value of resting
        there.
        """
        options: list[tuple[float, np.ndarray, Defects]] = []
        for move in (lambda: self.move(found, correction.smooth_cover(excess, self.grid)), lambda: excess):
            option = values - sign * move()
            after = self.defects(option)
            sizes = _sizes(after, self.lead(option, kept, sign), sign)
            shift = float(np.max(sizes))
            options.append((float(np.mean((sign * option)[self.chosen])) - shift, option, after))
            if shift < HELPS * kept[-1][1]:
                break
        _, option, after = max(options, key=lambda each: each[0])
        return option, after

    def bisected(self, values: np.ndarray, found: Defects, lead: np.ndarray, sign: int) -> Defects:
        """The defects with the cells that determine the shift cut into parts, at most one in ten."""
        for depth in range(1, BISECTIONS + 1):
            sizes = _sizes(found, lead, sign)
            if not np.all(np.isfinite(sizes)):
                break
            level = max(LARGEST * np.max(sizes), np.quantile(sizes, 0.9))
            chosen = sizes >= level
            # where the range of the defect is narrow, its largest value is already known
            chosen &= found.high - found.low > 0.2 * np.abs(sizes)
            if not np.any(chosen):
                break
            parts = defect.blocks(self.problem, self.grid, self.spline, np.nonzero(chosen), depth)
            found = defect.defects(self.spline, parts, values, found)
        return found


def _checked(problem: Problem, solution: Solution) -> tuple[Problem, np.ndarray, Grid]:
    """The problem with costs and its numbers settled, the value as a cost, and the grid.

    Raises:
      ValueError: there is no proof for the problem, its grid or its solution.
    """
    for given, kind in ((problem, Problem), (solution, Solution)):
        if not isinstance(given, kind):
            raise TypeError(f"enclose: got {type(given).__name__}, wanted a {kind.__name__}")
    if is_traced(problem, solution.value):
        raise ValueError("enclose: got traced numbers; call it outside of jit, vmap and grad")
    grid, costs = solution.grid, in_costs(solution)
    lacking = {
        "a game": problem.is_game, "random paths (noise, jumps or modes)": is_random(problem),
        "modes": problem.modes is not None, "pushes": bool(problem.pushes), "growth": problem.growth is not None,
        "a target": problem.target is not None, "time_dependent=True": problem.time_dependent,
        "a stopping_cost, a stopping_reward or a running_max": is_constrained(problem)
        or problem.stopping_reward is not None,
        "no discount": not is_discounted(problem), "a marched solution": solution.times is not None,
    }  # fmt: skip
    if found := [name for name, there in lacking.items() if there]:
        raise ValueError(
            f"enclose: got {' and '.join(found)}; wanted a stationary problem of one player with a discount, whose\n"
            "paths are not random and do not end. Bounds on the true value are proved only for these problems;\n"
            "Solution.grid_error and box_error are estimates for the others"
        )
    kinds = sorted({kind for pair in grid.edges if pair for kind in pair if kind != "projected"})
    if kinds:
        raise ValueError(
            f"enclose: got {' and '.join(kinds)} ends; wanted projected ends or periodic axes. Solve on a larger box\n"
            "with edges='projected': the bounds are those of the problem with walls at its ends"
        )
    value = np.asarray(costs.value, float)
    if value.shape != grid.shape or not np.all(np.isfinite(value)):
        raise ValueError(f"enclose: got a value of shape {value.shape} with numbers that are not finite, or a batch")
    known = in_unit_box(closures.settled(costs_of(problem), grid.ndim), grid.ndim)
    return known, value, grid


def _chosen(region: Any, grid: Grid) -> np.ndarray:
    """True at the nodes of a region, shape (*grid).

    Raises:
      ValueError: the region is neither a box nor a mask of the nodes, or has no nodes.
    """
    if region is None:
        return np.ones(grid.shape, bool)
    array = np.asarray(region)
    if array.dtype == bool and array.shape == grid.shape:
        found = array
    elif array.dtype != bool and array.shape == (2, grid.ndim):
        nodes = grid.nodes()
        found = np.all((nodes >= array[0]) & (nodes <= array[1]), axis=-1)
    else:
        raise ValueError(
            f"enclose: got a region of shape {array.shape} and type {array.dtype}; wanted a pair of corners (lo, hi)\n"
            f"of {grid.ndim} numbers each, or a mask of the nodes, bool {grid.shape}"
        )
    if not np.any(found):
        raise ValueError("enclose: got a region that contains no node; wanted a larger one")
    return found


def _sizes(found: Defects, lead: np.ndarray, sign: int) -> np.ndarray:
    """The shift that every cell requires, (*cells): its defect, or the lead if that is smaller."""
    return np.minimum(found.high if sign > 0 else -found.low, lead)


def _peak_bytes(problem: Problem, grid: Grid) -> int:
    """Bytes that ``enclose`` uses at its peak: all scalars of one block of cells, and arrays at all nodes.

    These are the weights of the spline, the functions of the problem and the factors of the chain.
    """
    n, m = grid.ndim, 0 if problem.controls is None else problem.controls.dim
    arguments = ([0.0] * n, [0.0] * m)
    counts = [operations(traced(each, *arguments)) for each in (problem.drift, problem.cost) if each is not None]
    scalars = 60 + sum(each.single + each.whole for each in counts)
    # range, centre, slopes, gradient and second derivatives, each with two bounds
    scalar = 8 * 2 * (2 + 2 * n + n * (n + 1) // 2)
    block = scalar * min(grid.size, defect.BLOCK) * scalars
    terms = len(problem.controls.points) if isinstance(problem.controls, Finite) else m + 1
    known = scalar * (2 + (n + 1) * terms) + 8 * 27 * n
    fill = 31 * np.log2(grid.size + 2) if n <= correction.DIRECT else 20
    return int(block + grid.size * (12 * fill + 8 * 30 + known))


def _message(grid: Grid, share: float, tol: float, is_part: bool) -> str:
    """The statement that is proved, and its width."""
    with_walls = bool(grid.sides("projected"))
    which = "the problem with walls at the projected ends of the box" if with_walls else "the continuous problem"
    end = "" if share <= tol else f", above tol = {tol:g}: use more nodes, or a better solution"
    width = f"their mean width{' in the region' * is_part} is {share:.2g} of the range of V"
    return f"The value of {which} lies between the bounds; {width}{end}."


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
