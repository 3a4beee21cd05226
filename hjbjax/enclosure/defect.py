"""The defect β W − H(x, DW) of a candidate over every cell, and the shifts that make the candidate a bound.

For a continuously differentiable W, a discount β > 0, and costs L and drifts f that are Lipschitz in the state:

- If β W − H(x, DW) ≤ β k in every cell, then V ≥ W − k: along any path d/dt e^{−βt}(W − k) ≥ −e^{−βt} L.
- If β W − H(x, DW) ≥ −β k in every cell, then V ≤ W + k: W + k is a supersolution of the equation.

At a projected end of the box a wall stops outward motion. There the first condition must also hold without the outward
component f_i of the drift, which matters only where W increases outward. The second must hold for a control that is
optimal for W, whose outward speed the wall may take away: this costs at most f_i⁺ (−∂W/∂n)⁺.
At a constrained end the first condition suffices for a lower bound.
"""

import dataclasses
import itertools

import numpy as np

from hjbjax.enclosure.interpolant import SEAM, Cells, Ends, Spline
from hjbjax.enclosure.minimum import Cell, cell_defect
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.tracing import intervals as iv
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import Interval, point, quietly

BLOCK = 8192  # cells that are evaluated together: the arrays of one operation stay in the cache
Index = tuple[np.ndarray, ...]


@dataclasses.dataclass(frozen=True)
class Defects:
    """Bounds of (β W − H)/β over cells, ends of the box included.

    Attributes:
      low: a lower bound, shape (*cells).
      high: an upper bound, shape (*cells).
      policy: a control in every cell, shape (*cells, m); proves nothing.
    """

    low: np.ndarray
    high: np.ndarray
    policy: np.ndarray


def defects(problem: Problem, grid: Grid, candidate: Spline, depth: int = 0) -> Defects:
    """The defects over all cells, each cut into 2^depth parts along every axis.

    Args:
      problem: a problem of one player with costs.
      grid: the grid.
      candidate: W.
      depth: the number of bisections.
    """
    inputs = 0 if problem.controls is None else problem.controls.dim
    found = Defects(
        np.full(candidate.shape, np.inf), np.full(candidate.shape, -np.inf), np.zeros((*candidate.shape, inputs))
    )
    every = tuple(each.ravel() for each in np.meshgrid(*map(np.arange, candidate.shape), indexing="ij"))
    _extend(problem, grid, candidate, every, depth, found)
    return found


def refine_cells(
    problem: Problem, grid: Grid, candidate: Spline, found: Defects, chosen: np.ndarray, depth: int
) -> Defects:
    """The defects, with some cells cut into 2^depth parts along every axis.

    Args:
      problem: the problem.
      grid: the grid.
      candidate: W.
      found: the defects so far.
      chosen: the cells to cut, bool (*cells).
      depth: the number of bisections.
    """
    index = np.nonzero(chosen)
    cut = Defects(found.low.copy(), found.high.copy(), found.policy)
    cut.low[index], cut.high[index] = np.inf, -np.inf
    _extend(problem, grid, candidate, index, depth, cut)
    # both enclose the same numbers
    return Defects(np.maximum(cut.low, found.low), np.minimum(cut.high, found.high), found.policy)


@quietly
def _extend(problem: Problem, grid: Grid, candidate: Spline, index: Index, depth: int, total: Defects) -> None:
    """Extend the bounds of some cells by the defects over their parts."""
    pairs = zip(index, candidate.shape, strict=True)
    sides = [np.where(i == 0, -1, np.where(i == cells - 1, 1, 0)) for i, cells in pairs]
    inner = np.logical_and.reduce([side == 0 for side in sides])
    # the coefficients of whole cells are used as they are; few cells are not worth a second evaluation
    whole = inner & (depth == 0) & (len(inner) > BLOCK // 8)
    for chosen, plain in ((whole, True), (~whole, False)):
        own, at = tuple(each[chosen] for each in index), [each[chosen] for each in sides]
        _over_blocks(problem, grid, candidate, own, at, depth, frozenset(), plain, total)
    projected = set(grid.sides("projected"))
    walls = [np.isin(side, [step for axis_, step in projected if axis_ == axis]) for axis, side in enumerate(sides)]
    walls = [wall & (side != 0) for wall, side in zip(walls, sides, strict=True)]
    for count in range(1, grid.ndim + 1):
        for stopped in itertools.combinations(range(grid.ndim), count):
            chosen = np.logical_and.reduce([walls[axis] for axis in stopped])
            own, at = tuple(each[chosen] for each in index), [each[chosen] for each in sides]
            _over_blocks(problem, grid, candidate, own, at, depth, frozenset(stopped), False, total)


def _over_blocks(
    problem: Problem, grid: Grid, candidate: Spline, index: Index, sides: list[np.ndarray], depth: int,
    stopped: frozenset[int], whole: bool, total: Defects,
) -> None:  # fmt: skip
    """Extend the bounds of cells, in blocks.

    Args:
      problem, grid, candidate, index, depth, total: as for ``_extend``.
      sides: for every axis −1 for a cell at the lower end, 1 at the upper end, and 0 elsewhere.
      stopped: the axes whose walls the states are on.
      whole: True for whole cells.
    """
    cut = [0 if axis in stopped else depth for axis in range(grid.ndim)]
    number = 2 ** sum(cut)
    step = max(1, BLOCK // number)
    for first in range(0, len(index[0]), step):
        block, at = tuple(i[first : first + step] for i in index), [side[first : first + step] for side in sides]
        every = tuple(np.repeat(i, number) for i in block)
        ends = None if whole else _parts(grid, at, cut, stopped)
        signs = {axis: np.repeat(at[axis], number) for axis in stopped}
        found, policy = over_part(problem, candidate.cells(every), ends, signs)
        low, high = (each.reshape(-1, number) for each in found.ends)
        total.low[block] = np.minimum(total.low[block], low.min(axis=1))
        total.high[block] = np.maximum(total.high[block], high.max(axis=1))
        total.policy[block] = policy.reshape(-1, number, policy.shape[-1])[:, 0]


def _parts(
    grid: Grid, sides: list[np.ndarray], depths: list[int], stopped: frozenset[int]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The ends of all parts of all cells, the parts of one cell after each other."""
    counts = [2**depth for depth in depths]
    places = np.meshgrid(*map(np.arange, counts), indexing="ij")
    found = []
    for axis, (side, count, place) in enumerate(zip(sides, counts, places, strict=True)):
        if axis in stopped:  # an end of an axis is the middle of its cell
            middle = np.full(len(side) * place.size, 0.5)
            found.append((middle, middle))
            continue
        overlap = SEAM * grid.periodic[axis]  # both halves of a cell at the seam must cover it
        lower = np.where(side < 0, 0.5 - overlap, 0.0)[:, None]
        upper = np.where(side > 0, 0.5 + overlap, 1.0)[:, None]
        share = place.ravel() / count
        found.append(
            ((lower + (upper - lower) * share).ravel(), (lower + (upper - lower) * (share + 1 / count)).ravel())
        )
    return found


def over_part(
    problem: Problem, cells: Cells, ends: Ends | None, walls: dict[int, np.ndarray]
) -> tuple[Interval, np.ndarray]:
    """Bounds of (β W − H)/β over a part of some cells, and a control.

    Args:
      problem: the problem.
      cells: the cells.
      ends: the parts of the unit cells; ``None`` is the whole of them.
      walls: the axes whose walls stop the paths, with the side of each cell: −1 for the lower and 1 for the upper end.
    """
    boxes, centres, radii = cells.boxes(ends)
    w, p = cells.scalars(ends)
    n, every = len(boxes), frozenset(walls)
    found = cell_defect(problem, Cell(tf.coordinates(boxes, centres, n), radii, w, p), [every] if walls else [])
    low, high = found.defect.ends
    rises = np.ones(np.shape(low), bool)
    for axis, side in walls.items():
        slope = p[axis].bounds(radii)
        outward, speed = (iv.where(side > 0, each, -each) for each in (slope, found.drift[axis]))
        rises &= outward.hi > 0
        loss = point(np.maximum(speed.hi, 0.0)) * point(np.maximum(-outward.lo, 0.0))
        low = (point(low) - loss).lo
    if walls:
        high = np.where(rises, np.maximum(high, found.least[every]), high)
    # β is positive
    ratios = [point(each) / found.rate for each in (np.minimum(low, high), high)]
    return Interval(ratios[0].lo, ratios[1].hi), found.policy
