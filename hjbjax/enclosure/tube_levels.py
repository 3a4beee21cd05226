"""Conditions on the levels that bound a marched tube, for every cell of time and space.

Let W(t, x) be a spline in time and space near the value of

    V = min_u max_d min_τ max{ψ(x(τ)), max_{r ≤ τ} g(x(r))},      min{max{−V_t − H(x, DV), V − ψ}, V − g} = 0,

with H = min_u max_d f·p or max min, and let the level σ(t) not increase. Assume that

- −W_t − H(x, DW) ≤ −σ′ where W = σ, unless g ≥ v there,
- max(ψ, g) ≥ v where W ≥ σ, and V ≥ v where W ≥ σ at the horizon.

Then some disturbance keeps W ≥ σ until g ≥ v. So V ≥ v at all states with W(0, x) ≥ σ(0). This is the lower side. The
upper side is the same with opposite signs, with the obstacles exchanged. Only cells that meet the level σ count: the
rate of σ in a time slab is the largest defect −W_t − H of these cells.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.enclosure import defect, games
from hjbjax.enclosure.cell_functions import Cell
from hjbjax.enclosure.interpolant import Spline, with_largest
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.types import Array
from hjbjax.tracing import intervals as iv
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import EPS, quietly
from hjbjax.tracing.taylor_forms import Form


def steady_drift(drift: Callable, z: Array, *inputs: Array) -> Array:
    """The drift of (t, x) for a drift that does not depend on time."""
    return jnp.concatenate([jnp.ones(1), jnp.asarray(drift(z[1:], *inputs)).reshape(-1)])


def timed_drift(drift: Callable, z: Array, *inputs: Array) -> Array:
    """The drift of (t, x) for a drift that takes the time as its first argument."""
    return jnp.concatenate([jnp.ones(1), jnp.asarray(drift(z[0], z[1:], *inputs)).reshape(-1)])


@dataclasses.dataclass(frozen=True)
class Sides:
    """The conditions of the cells of (t, x) on both sides, the lower one first; s is 1 for it and −1 for the upper one.

    Attributes:
      least: a lower bound of W, shape (*cells).
      most: an upper bound of W.
      rate: the largest s (−W_t − H), (2, *cells); infinite in cells that are not evaluated.
      helper: the largest number by which s W exceeds the obstacle that helps the side, (2, *cells).
      hinder: the largest number by which s W exceeds the obstacle that hinders the side, (2, *cells).
      known: True in cells that are evaluated.
    """

    least: np.ndarray
    most: np.ndarray
    rate: np.ndarray
    helper: np.ndarray
    hinder: np.ndarray
    known: np.ndarray


@dataclasses.dataclass(frozen=True)
class TubeTask:
    """The data of both sides.

    Attributes:
      problem: a problem without running cost and discount, with its numbers settled.
      moving: the problem with the state (t, x).
      mesh: the grid of (t, x).
      spline: its cells.
      values: the coefficients of W, (*mesh).
    """

    problem: Problem
    moving: Problem
    mesh: Grid
    spline: Spline
    values: np.ndarray

    @classmethod
    def of(cls, problem: Problem, grid: Grid, horizon: float, values: np.ndarray) -> "TubeTask":
        """The data for node values (k, *grid) at k equally spaced times from zero to the horizon."""
        mesh = Grid(
            [0.0, *np.asarray(grid.lo)], [horizon, *np.asarray(grid.hi)], values.shape,
            periodic=(False, *grid.periodic), stretch=(None, *grid.stretch), edges=("open", *grid.edges),
        )  # fmt: skip
        drift = jax.tree_util.Partial(timed_drift if problem.time_dependent else steady_drift, problem.drift)
        moving = Problem(
            drift, None, problem.controls, disturbances=problem.disturbances, isaacs=problem.isaacs
        )  # fmt: skip
        return cls(problem, moving, mesh, Spline.on(mesh), spline_coefficients(values, mesh))

    def with_values(self, values: np.ndarray) -> "TubeTask":
        """The same data for other node values (k, *grid)."""
        return dataclasses.replace(self, values=spline_coefficients(values, self.mesh))

    def obstacles(self, z: list[Form]) -> tuple[list[tuple[Form | None, Form | None]], Form]:
        """The obstacles that help and hinder each side, ``None`` if there is none, and V at the horizon."""
        problem = self.problem
        at = [z[0], z[1:]] if problem.time_dependent else [z[1:]]
        stop, run, end = (
            None if each is None else tf.taylor_forms(each, *(at if callable(each) else [])).reshape(-1)[0]
            for each in (problem.stopping_cost, problem.running_max, problem.terminal_cost)
        )
        final = _either(tf.minimum, stop, end)
        both = None if stop is None else _either(tf.maximum, stop, run)
        last = _either(tf.maximum, final, run)
        return [(run, both), (stop, run)], tf.constant(0.0) if last is None else last

    @quietly
    def obstacle_ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """The least value, with the sign of the side, of the obstacles that help and hinder it, each (2, *cells)."""
        shape = self.spline.shape
        found = np.full((2, *shape), -np.inf), np.full((2, *shape), np.inf)
        times = np.arange(shape[0]) if self.problem.time_dependent else np.zeros(1, int)
        rows = np.meshgrid(times, *map(np.arange, shape[1:]), indexing="ij")
        for some in _parts([each.ravel() for each in rows]):
            cells = defect.parts_of(self.mesh, self.spline, some, 0)
            pairs, _ = self.obstacles(tf.coordinates(cells.ranges, cells.centres, self.mesh.ndim))
            place = some if self.problem.time_dependent else (slice(None), *some[1:])
            for side, pair in enumerate(pairs):
                for total, each in zip(found, pair, strict=True):
                    if each is not None:
                        own = each.bounds(cells.radii)
                        total[side][place] = own.lo if side == 0 else -own.hi
        return found

    def hulls(self) -> Sides:
        """The conditions before any cell is evaluated."""
        least, most = hulls(self.values, self.mesh)
        rate, helper, hinder = (np.full((2, *self.spline.shape), np.inf) for _ in range(3))
        return Sides(least, most, rate, helper, hinder, np.zeros(self.spline.shape, bool))

    @quietly
    def evaluate(self, found: Sides, chosen: np.ndarray) -> None:
        """Enter the conditions of some cells, True in ``chosen``, (*cells)."""
        found.rate[:, chosen] = -np.inf
        found.known[chosen] = True
        for some in _parts(np.nonzero(chosen)):
            for block in defect.blocks(self.moving, self.mesh, self.spline, some, 0):
                w, p = block.cells.scalars(self.values)
                for side, end in enumerate(_rates(block, w, p)):
                    found.rate[side][block.index] = np.maximum(found.rate[side][block.index], end)
                if not block.walls:
                    self._compare(block, w, found)

    def _compare(self, block: defect.CellBlock, w: Form, found: Sides) -> None:
        """Enter the ranges of W and of its differences from the obstacles."""
        radii = block.cells.radii
        bounds = w.bounds(radii)
        found.least[block.index] = np.maximum(found.least[block.index], bounds.lo)
        found.most[block.index] = np.minimum(found.most[block.index], bounds.hi)
        pairs, _ = self.obstacles(tf.coordinates(block.cells.ranges, block.cells.centres, self.mesh.ndim))
        for side, pair in enumerate(pairs):
            for excess, each in zip((found.helper, found.hinder), pair, strict=True):
                if each is not None:
                    difference = w - each if side == 0 else each - w
                    excess[side][block.index] = difference.bounds(radii).hi

    @quietly
    def refine(self, found: Sides, chosen: np.ndarray, depth: int) -> None:
        """Narrow the rates of some cells to the rates of their parts, 2^depth along every axis."""
        fresh = np.full(found.rate.shape, -np.inf)
        for some in _parts(np.nonzero(chosen), depth * self.mesh.ndim):
            for block in defect.blocks(self.moving, self.mesh, self.spline, some, depth):
                for side, end in enumerate(_rates(block, *block.cells.scalars(self.values))):
                    most = end.reshape(-1, block.number).max(axis=1)
                    fresh[side][block.index] = np.maximum(fresh[side][block.index], most)
        found.rate[:, chosen] = np.minimum(found.rate[:, chosen], fresh[:, chosen])

    @quietly
    def at_horizon(self, level: float, side: int) -> float:
        """The least σ at the horizon for the level v, both with the sign of the side."""
        rows, needed = np.meshgrid(*map(np.arange, self.spline.shape[1:]), indexing="ij"), -np.inf
        last = self.spline.shape[0] - 1
        for some in _parts([np.full(rows[0].size, last), *(each.ravel() for each in rows)]):
            cells = defect.parts_of(self.mesh, self.spline, some, 0, (0,))  # only the end of the time axis
            w, _ = cells.scalars(self.values)
            _, end = self.obstacles(tf.coordinates(cells.ranges, cells.centres, self.mesh.ndim))
            excess = (w - end if side == 0 else end - w).bounds(cells.radii).hi
            own, range_ = end.bounds(cells.radii), w.bounds(cells.radii)
            low, high = (own.lo, range_.hi) if side == 0 else (-own.hi, -range_.lo)
            bound = above(np.minimum(high, level + excess))
            needed = max(needed, float(np.max(np.where(low < level, bound, -np.inf))))
        return needed


def above(x: Any) -> Any:
    """The next larger number."""
    return np.nextafter(x, np.inf)


def _either(join: Callable[[Form, Form], Form], left: Form | None, right: Form | None) -> Form | None:
    """Two scalars joined, or the one that there is."""
    if left is None or right is None:
        return left if right is None else right
    return join(left, right)


def _parts(index: Sequence[np.ndarray], bisections: int = 0) -> Iterator[tuple[np.ndarray, ...]]:
    """The numbers of some cells, in blocks that are small enough if every cell is bisected this number of times."""
    step = max(1, defect.BLOCK >> bisections)
    for first in range(0, len(index[0]), step):
        yield tuple(each[first : first + step] for each in index)


def _rates(block: defect.CellBlock, w: Form, p: list[Form]) -> tuple[np.ndarray, np.ndarray]:
    """Upper bounds of −W_t − H and of W_t + H over parts of some cells."""
    rate, _ = defect.over_block(block, w, p)
    narrow = None if block.walls else games.by_vertices(Cell(block.known, w, p))
    if narrow is not None:
        rate = iv.meet(rate, narrow)
    return rate.hi, -rate.lo


def spline_coefficients(values: np.ndarray, mesh: Grid) -> np.ndarray:
    """Coefficients of a spline near some node values: a spline with the values as coefficients is too smooth.

    At a kink they are the values, because a spline through them would overshoot.
    """
    for axis, cyclic in enumerate(mesh.periodic):
        rows = _extended(np.moveaxis(values, axis, 0), cyclic)[: values.shape[axis] + 2]
        bend = (2 * rows[1:-1] - rows[:-2] - rows[2:]) / 8
        around = (
            _extended(bend, cyclic)[: values.shape[axis] + 2] if cyclic else np.concatenate([bend[:1], bend, bend[-1:]])
        )
        three = np.stack([around[:-2], bend, around[2:]])
        # the least of three bends of one sign; they hardly differ where the function is smooth
        least = np.where(
            np.all(three > 0, axis=0), three.min(axis=0), np.where(np.all(three < 0, axis=0), three.max(axis=0), 0)
        )
        values = values + np.moveaxis(least, 0, axis)
    return values


def _extended(rows: np.ndarray, cyclic: bool) -> np.ndarray:
    """The coefficients along the first axis and beyond its ends: periodic, or along a parabola."""
    if cyclic:
        return np.concatenate([rows[-1:], rows, rows[:2]])
    ghosts = [3 * (rows[a] - rows[b]) + rows[c] for a, b, c in ((0, 1, 2), (-1, -2, -3))]
    return np.concatenate([ghosts[0][None], rows, ghosts[1][None]])


def hulls(values: np.ndarray, mesh: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the spline in every cell: the least and the largest of the coefficients that determine it.

    Args:
      values: the coefficients, (*mesh).
      mesh: the grid of (t, x).
    """
    values, largest = with_largest(values)
    # first along all axes: the continuation of the least coefficients is not the least one
    for axis, cyclic in enumerate(mesh.periodic):
        values = np.moveaxis(_extended(np.moveaxis(values, axis, 0), cyclic), 0, axis)
    pair = [values, values]
    for axis in range(mesh.ndim):
        for k, join in enumerate((np.minimum, np.maximum)):
            rows = np.moveaxis(pair[k], axis, 0)
            pair[k] = np.moveaxis(join(join(rows[:-2], rows[1:-1]), rows[2:]), 0, axis)
    # a ghost is at most seven times as large as its neighbours, and is rounded four times per axis
    slack = 8 * mesh.ndim * 7.0**mesh.ndim * EPS * largest
    return pair[0] - slack, pair[1] + slack
