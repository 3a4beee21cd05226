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
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from hjbjax.enclosure import games
from hjbjax.enclosure.cell_functions import Cell, Functions, admissible_sets, functions_over
from hjbjax.enclosure.interpolant import SEAM, Cells, Spline
from hjbjax.enclosure.minimum import control_defect
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.tracing import intervals as iv
from hjbjax.tracing import quadratics as qu
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import Interval, point, quietly
from hjbjax.tracing.taylor_forms import Form

BLOCK = 8192  # cells that are evaluated together: the arrays of one operation stay in the cache
Index = tuple[np.ndarray, ...]  # arrays that broadcast together: one axis for a list of cells, or one per axis


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


@dataclasses.dataclass(frozen=True)
class CellBlock:
    """Parts of some cells with the functions of the problem, which do not depend on W.

    Attributes:
      index: the number of each cell along every axis.
      number: the number of parts of a cell, which follow each other along the last axis.
      cells: the parts.
      known: the functions of the problem.
      walls: the axes whose walls stop the paths, with the side of each part: −1 for the lower and 1 for the upper end.
      ended: True for parts inside the target, where nothing is required; ``None`` without a target.
    """

    index: Index
    number: int
    cells: Cells
    known: Functions
    walls: dict[int, np.ndarray]
    ended: np.ndarray | None = None

    @property
    def inputs(self) -> int:
        """The number of inputs of both players."""
        return sum(each.dim for each in admissible_sets(self.known.problem) if each is not None)


@quietly
def blocks(problem: Problem, grid: Grid, spline: Spline, index: Index, depth: int) -> list[CellBlock]:
    """Blocks of parts of some cells.

    Args:
      problem: a problem with costs.
      grid: the grid.
      spline: its cells.
      index: the number of each cell along every axis.
      depth: the number of bisections along every axis: each cell is cut into 2^depth parts along it.
    """
    projected, found = set(grid.sides("projected")), []
    for stopped in itertools.chain.from_iterable(
        itertools.combinations(range(grid.ndim), count) for count in range(grid.ndim + 1)
    ):
        cut = [0 if axis in stopped else depth for axis in range(grid.ndim)]
        number = 2 ** sum(cut)
        for block in _split(_at_walls(index, spline, projected, stopped), max(1, BLOCK // number)):
            side = _sides(block, spline)
            cells = spline.cells([np.repeat(i, number, axis=-1) for i in block], _parts(grid, side, cut, stopped))
            x = tf.coordinates(cells.ranges, cells.centres, grid.ndim)
            signs = {axis: np.repeat(side[axis], number, axis=-1) for axis in stopped}
            ended = None
            if problem.target is not None:
                (level,) = tf.taylor_forms(problem.target, x).reshape(-1)
                ended = level.bounds(cells.radii).hi <= 0
            known = functions_over(problem, x, cells.radii)
            found.append(CellBlock(block, number, cells, known, signs, ended))
    return found


def _at_walls(index: Index, spline: Spline, projected: set[tuple[int, int]], stopped: Sequence[int]) -> Index:
    """The cells at a wall along every one of some axes."""
    sides = _sides(index, spline)
    walls = {axis: np.isin(sides[axis], [step for other, step in projected if other == axis]) for axis in stopped}
    walls = {axis: wall & (sides[axis] != 0) for axis, wall in walls.items()}
    if index[0].ndim == 1:  # a list
        chosen = np.logical_and.reduce([np.ones(len(index[0]), bool), *walls.values()])
        return tuple(i[chosen] for i in index)
    return tuple(np.compress(walls[axis].ravel(), i, axis=axis) if axis in walls else i for axis, i in enumerate(index))


def _split(index: Index, size: int) -> Iterator[Index]:
    """Parts of an index with at most this number of cells."""
    shape = np.broadcast_shapes(*(i.shape for i in index))
    pieces, left = [], size
    for length in reversed(shape):
        step = max(1, min(length, left))
        pieces.append([slice(first, first + step) for first in range(0, length, step)])
        left //= step
    for piece in itertools.product(*reversed(pieces)):
        yield tuple(
            i[tuple(some if length > 1 else slice(None) for some, length in zip(piece, i.shape, strict=True))]
            for i in index
        )


def chosen_cells(known: Sequence[CellBlock], chosen: np.ndarray) -> list[CellBlock]:
    """Blocks of the cells with a mark, (*cells), from blocks of whole cells. Those at walls stay whole."""
    found: list[CellBlock] = []
    for block in known:
        some = np.nonzero(chosen[block.index])
        if not len(some[0]):
            continue
        if block.walls or len(some[0]) == np.size(chosen[block.index]):
            found.append(block)
            continue
        take = _Taken(some)
        functions = dataclasses.replace(block.known, **{
            name: take(getattr(block.known, name)) for name in ("x", "radii", "rate", "unit", "options")
        })  # fmt: skip
        index = tuple(take(each) for each in block.index)
        found.append(CellBlock(index, 1, take(block.cells), functions, {}, take(block.ended)))
    return found


class _Taken:
    """Some cells of arrays over the cells of a block, in any structure of them.

    Args:
      index: the number of each cell along every axis.
    """

    def __init__(self, index: Index) -> None:
        self.index, self.known = index, dict[int, Any]()

    def __call__(self, tree: Any) -> Any:
        # an array that occurs twice stays one array: a number is the same at both ends of its interval
        if id(tree) not in self.known:
            self.known[id(tree)] = tree, self._taken(tree)
        return self.known[id(tree)][1]

    def _taken(self, tree: Any) -> Any:
        if isinstance(tree, np.ndarray):
            if tree.ndim < len(self.index):
                return tree
            shape = tree.shape[-len(self.index) :]
            places: list[Any] = [i if length > 1 else 0 * i for i, length in zip(self.index, shape, strict=True)]
            return tree[(..., *places)]
        if dataclasses.is_dataclass(tree) and not isinstance(tree, type):
            return dataclasses.replace(
                tree, **{each.name: self(getattr(tree, each.name)) for each in dataclasses.fields(tree)}
            )
        if isinstance(tree, dict):
            return type(tree)({key: self(each) for key, each in tree.items()})
        if isinstance(tree, (list, tuple)):
            return type(tree)(self(each) for each in tree)
        return tree


def _sides(index: Index, spline: Spline) -> list[np.ndarray]:
    """Per axis −1 for the first, 1 for the last and 0 for every other cell."""
    pairs = zip(index, spline.shape, strict=True)
    return [np.where(i == 0, -1, np.where(i == cells - 1, 1, 0)) for i, cells in pairs]


def parts_of(grid: Grid, spline: Spline, index: Index, depth: int, stopped: Sequence[int] = ()) -> Cells:
    """The parts of some cells inside the box, 2^depth along every axis, the parts of one cell after each other.

    Args:
      grid: the grid.
      spline: its cells.
      index: the number of each cell along every axis.
      depth: the number of bisections along every axis.
      stopped: axes along which a part is only the middle of its cell, which is a node.
    """
    ends = _parts(grid, _sides(index, spline), [depth] * grid.ndim, stopped)
    return spline.cells([np.repeat(i, 2 ** (depth * grid.ndim), axis=-1) for i in index], ends)


def all_cells(spline: Spline) -> Index:
    """The numbers of all cells along every axis."""
    return np.ix_(*map(np.arange, spline.shape))  # functions of one coordinate are evaluated once per number


@quietly
def defects(spline: Spline, known: Sequence[CellBlock], values: np.ndarray, before: Defects | None = None) -> Defects:
    """The defects over the cells of some blocks.

    Args:
      spline: the cells.
      known: blocks.
      values: the coefficients of W.
      before: the defects so far, if the blocks do not contain all cells.
    """
    if before is None:
        policy = np.zeros((*spline.shape, known[0].inputs if known else 0))
        before = Defects(np.full(spline.shape, -np.inf), np.full(spline.shape, np.inf), policy)
    total = Defects(before.low.copy(), before.high.copy(), before.policy)
    for block in known:
        total.low[block.index], total.high[block.index] = np.inf, -np.inf
    for block in known:
        found, policy = over_block(block, *block.cells.scalars(values))
        low, high = found.ends
        if block.ended is not None:
            low, high = np.where(block.ended, np.inf, low), np.where(block.ended, -np.inf, high)
        low, high = (each.reshape(*each.shape[:-1], -1, block.number) for each in (low, high))
        total.low[block.index] = np.minimum(total.low[block.index], low.min(axis=-1))
        total.high[block.index] = np.maximum(total.high[block.index], high.max(axis=-1))
        if not block.walls:
            total.policy[block.index] = policy.reshape(*low.shape, policy.shape[-1])[..., 0, :]
    # both enclose the same numbers
    return Defects(np.maximum(total.low, before.low), np.minimum(total.high, before.high), total.policy)


@quietly
def greedy_policy(spline: Spline, known: Sequence[CellBlock], values: np.ndarray) -> np.ndarray:
    """The control of ``Defects`` from numbers at the centres of the cells only.

    Args:
      spline: the cells.
      known: blocks of all cells.
      values: the coefficients of W.
    """
    found = np.zeros((*spline.shape, known[0].inputs))
    for block in known:
        if not block.walls:
            w, p = block.cells.at_centres(values)
            found[block.index] = over_block(_at_centres(block), w, p)[1]
    return found


def _at_centres(block: CellBlock) -> CellBlock:
    """A block with the numbers at the centres of its cells instead of ranges."""
    known = block.known

    def number(form: Form) -> Form:
        return Form(form.centre, form.centre)

    options = [
        (qu.Polynomial({term: number(each) for term, each in cost.items()}), [
            qu.Polynomial({term: number(each) for term, each in component.items()}) for component in drift
        ])
        for cost, drift in known.options
    ]  # fmt: skip
    functions = Functions(
        known.problem, list(map(number, known.x)), [0 * each for each in known.radii], number(known.rate), known.unit,
        options,
    )  # fmt: skip
    return dataclasses.replace(block, known=functions)


def _parts(
    grid: Grid, sides: list[np.ndarray], depths: list[int], stopped: Sequence[int]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The ends of all parts of all cells, the parts of one cell after each other."""
    counts = [2**depth for depth in depths]
    places = np.meshgrid(*map(np.arange, counts), indexing="ij")
    found = []
    for axis, (side, count, place) in enumerate(zip(sides, counts, places, strict=True)):
        overlap = SEAM * grid.periodic[axis]  # both halves of a cell at the seam must cover it
        lower = np.where(side < 0, 0.5 - overlap, 0.0)[..., None]
        upper = np.where(side > 0, 0.5 + overlap, 1.0)[..., None]
        if axis in stopped:  # an end of an axis is the middle of its cell
            lower = upper = np.full_like(lower, 0.5)
        share = place.ravel() / count
        ends = lower + (upper - lower) * share, lower + (upper - lower) * (share + 1 / count)
        found.append((ends[0].reshape(*side.shape[:-1], -1), ends[1].reshape(*side.shape[:-1], -1)))
    return found


def over_block(block: CellBlock, w: Form, p: list[Form]) -> tuple[Interval, np.ndarray]:
    """Bounds of (β W − H)/β over parts of some cells, and a control; without a discount −H over the least cost.

    Args:
      block: the parts.
      w: W over these parts.
      p: its gradient.
    """
    if block.known.problem.is_game:
        return _over_block_of_game(block, w, p)
    every = frozenset(block.walls)
    found = control_defect(Cell(block.known, w, p), [every] if every else [])
    low, high = found.defect.ends
    rises = np.ones(np.shape(low), bool)
    for axis, side in block.walls.items():
        slope = p[axis].bounds(block.cells.radii)
        outward, speed = (iv.where(side > 0, each, -each) for each in (slope, found.drift[axis]))
        rises &= outward.hi > 0
        loss = point(np.maximum(speed.hi, 0.0)) * point(np.maximum(-outward.lo, 0.0))
        low = (point(low) - loss).lo
    if every:
        high = np.where(rises, np.maximum(high, found.least[every]), high)
    return _per_unit(low, high, block.known.unit), found.policy


def _over_block_of_game(block: CellBlock, w: Form, p: list[Form]) -> tuple[Interval, np.ndarray]:
    """The same for a game."""
    rises, falls = {}, {}
    for axis, side in block.walls.items():
        slope = p[axis].bounds(block.cells.radii)
        outward = iv.where(side > 0, slope, -slope)
        rises[axis], falls[axis] = outward.hi > 0, outward.lo < 0
    stopped = games.subsets(rises), games.subsets(falls)
    found, policy = games.game_defect(Cell(block.known, w, p), *stopped)
    return _per_unit(*found.ends, block.known.unit), policy


def _per_unit(low: np.ndarray, high: np.ndarray, unit: Interval) -> Interval:
    """Both bounds divided by a positive number."""
    ratios = [point(each) / unit for each in (np.minimum(low, high), high)]
    return Interval(ratios[0].lo, ratios[1].hi)
