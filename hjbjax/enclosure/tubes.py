"""``enclose_tube``: an inner and an outer set of a marched tube, with proof."""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np

from hjbjax.enclosure import checks
from hjbjax.enclosure.bounds import evaluate_in_box, spline_arrays, spline_of
from hjbjax.enclosure.interpolant import LARGEST, Spline
from hjbjax.enclosure.tube_branches import branches, vertices
from hjbjax.enclosure.tube_levels import TubeTask
from hjbjax.enclosure.tube_search import WIDER, Candidate, LevelSearch, largest_least
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_discounted
from hjbjax.problem.pytree import front_door
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import in_unit_box
from hjbjax.problem.types import Numbers
from hjbjax.solution import archive, files
from hjbjax.solution.solution import Solution
from hjbjax.solvers import memory
from hjbjax.tracing import closures
from hjbjax.tracing.operations import operations
from hjbjax.tracing.taylor_forms import traced

FEWEST = 3  # kept times, because coefficients beyond an end need three


@dataclasses.dataclass(frozen=True, eq=False)
class TubeEnclosure(files.Saved):
    """Two sets at t = 0, one inside and one outside a tube; made by ``enclose_tube``.

    Args:
      grid: the grid.
      level: v; the tube is {V ≤ v}, or {V ≥ v} for ``avoid``.
      inner: a function at the nodes, shape (*grid), that is ≤ 0 in the inner set; NaN if the inner set is empty.
      outer: a function at the nodes that is ≤ 0 in the outer set; NaN if the outer set is the whole box.
      shifts: the numbers by which the levels of W of the outer and the inner set differ from v, in units of V.
      is_free: True if the sets also hold for the problem that continues beyond the box.
      message: the statement that is proved.
      stats: "seconds", "bytes" (the estimated memory), "cells" and "bisected", the numbers of evaluated and of bisected
        cells.
      spline: the cells of W in (t, x).
      coefficients: the coefficients of every W at the first times, which determine W at t = 0, shape (m, 3, *grid).
      thresholds: a number per side and W, (2, m): W ≥ the first one for one W proves V > v, or V ≥ v for ``avoid``,
        and −W ≥ the second one V ≤ v, or V < v. They are infinite for a W that proves nothing on a side.
      above: True for ``avoid``.
    """

    FORMAT = "hjbjax.TubeEnclosure"
    KINDS: ClassVar = {
        "grid": (dict,), "level": files.REAL, "is_free": (bool,), "message": (str,), "stats": (dict,),
        "above": (bool,), "times": (int,), "splines": (int,),
    }  # fmt: skip

    grid: Grid
    level: float
    inner: np.ndarray
    outer: np.ndarray
    shifts: tuple[float, float]
    is_free: bool
    message: str
    stats: dict
    spline: Spline = dataclasses.field(repr=False)
    coefficients: np.ndarray = dataclasses.field(repr=False)
    thresholds: np.ndarray = dataclasses.field(repr=False)
    above: bool = dataclasses.field(repr=False)

    def inner_at(self, x: Numbers | Sequence) -> np.ndarray:
        """True at states that are proved to be in the tube.

        Args:
          x: states inside the box, shape (n,) or (..., n).

        Returns:
          Booleans, shape (...). False outside the box.
        """
        return self._is_beyond(x, 0 if self.above else 1)

    def outer_at(self, x: Numbers | Sequence) -> np.ndarray:
        """False at states that are proved not to be in the tube; True outside the box."""
        return ~self._is_beyond(x, 1 if self.above else 0)

    def _is_beyond(self, x: Numbers | Sequence, side: int) -> np.ndarray:
        """True where W is beyond the threshold of a side; False outside the box."""

        def is_beyond(states: np.ndarray) -> np.ndarray:
            return _beyond(self.spline, states, self.coefficients, self.thresholds, side) >= 0

        return evaluate_in_box(is_beyond, self.grid, x, False, "TubeEnclosure")

    def __repr__(self) -> str:
        return f"TubeEnclosure(level {self.level:g}, shifts {self.shifts[0]:.3g} and {self.shifts[1]:.3g})"

    def _contents(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        header = {
            "grid": archive.about_grid(self.grid), "level": self.level, "is_free": self.is_free,
            "message": self.message, "stats": self.stats, "above": self.above, "times": len(self.spline.tables[0].at),
            "splines": len(self.coefficients),
        }  # fmt: skip
        arrays = {"lo": self.grid.lo, "hi": self.grid.hi, "inner": self.inner, "outer": self.outer}
        arrays |= {"coefficients": self.coefficients}
        arrays |= {"shifts": np.array(self.shifts), "thresholds": self.thresholds}  # may be infinite
        return header, arrays | spline_arrays(self.spline)

    @staticmethod
    def _plan(header: dict) -> dict[str, files.Expected]:
        """The arrays of a file; their shapes follow from its grid and the number of times."""
        shape, cyclic = archive.shape_of(header["grid"]), header["grid"]["periodic"]
        shapes: dict[str, tuple[int, ...]] = {name: (len(shape),) for name in ("lo", "hi")}
        splines = header["splines"]
        shapes |= {**dict.fromkeys(("inner", "outer"), shape), "coefficients": (splines, FEWEST, *shape)}
        shapes |= {"shifts": (2,), "thresholds": (2, splines), "axis0": (header["times"],)}
        shapes |= {f"axis{k + 1}": (count + bool(cyclic[k]),) for k, count in enumerate(shape)}
        return {name: files.Expected((each,), (np.float64,), optional=False) for name, each in shapes.items()}

    @classmethod
    def _from_file(cls, header: dict, arrays: dict[str, np.ndarray]) -> Self:
        """The sets with a header and arrays of a file."""
        grid = archive.grid_of(header["grid"], arrays["lo"], arrays["hi"])
        first, second = arrays["shifts"].tolist()
        return cls(
            grid, header["level"], arrays["inner"], arrays["outer"], (first, second), header["is_free"],
            header["message"], header["stats"], spline_of(arrays, (False, *grid.periodic)), arrays["coefficients"],
            arrays["thresholds"], header["above"],
        )  # fmt: skip


@front_door
def enclose_tube(
    problem: Problem, solution: Solution, *, level: float = 0.0, depth: int = 1, max_memory: int | None = None
) -> TubeEnclosure:
    """An inner and an outer set of a tube, with proof: neither the grid nor rounding is neglected.

    A spline W in time and space has the defect −W_t − H(x, DW). Let σ(t) be a level of W that changes at the rate of
    the largest defect of the cells that it meets. Then {W(0) ≥ σ(0)} is inside {V ≥ v}, where v is the level σ at the
    horizon, apart from the errors of W there and at the obstacles. The same holds from the other side. At an edge of
    the tube, where a player has two equally good actions, several splines bound a side together: the values with this
    player fixed at a vertex of its set, at most four. They are marched here.

    Args:
      problem: a problem of ``reach``, ``avoid`` or ``reach_avoid``, or another problem without running cost, discount,
        noise, jumps and modes. Drift and distances must be Lipschitz functions that are defined on the whole box. In a
        game the drift must be a quadratic polynomial of the inputs, or the sets finite.
      solution: a solution of this problem by ``march`` with equally spaced ``times`` from zero to the horizon. The sets
        are proved for any solution; they are close to each other for a good one. A time step of one cell divided by the
        largest speed is short enough.

    Keyword Args:
      level: v, in units of V.
      depth: the number of times that cells with a large defect are bisected along every axis.
      max_memory: the number of bytes that count as free.

    Returns:
      A TubeEnclosure.

    Raises:
      ValueError: the problem has an ingredient for which there is no proof, or a function without an interval rule.
      MemoryError: the estimated memory is not free.

    Example:
      >>> import hjbjax as hjb
      >>> import jax.numpy as jnp
      >>> problem = hjb.reach(lambda x, u: u, hjb.Box([-1.0], [1.0]), lambda x: jnp.abs(x[0]) - 0.5)
      >>> solution = hjb.march(problem, hjb.Grid([-3.0], [3.0], (61,)), 1.0, times=np.linspace(0, 1, 11))
      >>> found = hjb.enclose_tube(problem, solution)
      >>> found.inner_at([[1.4], [1.6]]).tolist(), found.outer_at([[1.4], [1.6]]).tolist()
      ([True, False], [True, False])
    """
    start = time.perf_counter()
    own, values, horizon = _checked(problem, solution)
    if isinstance(depth, bool) or not isinstance(depth, (int, np.integer)) or depth < 0:
        raise ValueError(f"enclose_tube: depth: got {depth!r}, wanted an integer that is not negative")
    level = float(level)
    if not np.isfinite(level):
        raise ValueError(f"enclose_tube: level: got {level}, wanted a finite number")
    grid = solution.grid
    needed = memory.fitting(_peak_bytes(own, values.shape), grid, max_memory)
    above = problem.inside == "above"
    with own_settings(x64=True):
        task = TubeTask.of(own, grid, horizon, values)
        levels = (level if above else np.nextafter(level, np.inf), -(np.nextafter(level, -np.inf) if above else level))
        proofs, counts = _proofs(problem, solution, task, level, levels, depth)
    everyone = list({id(each): each for proof in proofs for each in proof.some}.values())
    coefficients = np.stack([each.task.values[:FEWEST] for each in everyone])
    thresholds = np.array([[proof.level if each in proof.some else np.inf for each in everyone] for proof in proofs])
    low, high = (proof.level for proof in proofs)
    is_free = bool(np.isfinite(high if above else low)) and not proofs[above].meets_end()
    shifts = (low - level, high + level)
    inner, outer = set_functions(grid, task.spline, coefficients, thresholds, above)
    return TubeEnclosure(
        grid, level, inner, outer, shifts[::-1] if above else shifts, is_free,
        _message(low, high, above, is_free, bool(grid.sides("projected"))),
        {"seconds": time.perf_counter() - start, "bytes": needed, **counts}, task.spline, coefficients, thresholds,
        above,
    )  # fmt: skip


def _beyond(
    spline: Spline, states: np.ndarray, coefficients: np.ndarray, thresholds: np.ndarray, side: int
) -> np.ndarray:
    """A lower bound of the largest excess of a candidate over its threshold, with the sign of the side, (count,)."""
    at, found = spline.at(np.column_stack([np.zeros(len(states)), states])), np.full(len(states), -np.inf)
    for each, threshold in zip(coefficients, thresholds[side], strict=True):
        if np.isfinite(threshold):
            w = at.values(each)
            found = np.maximum(found, (w.lo if side == 0 else -w.hi) - threshold)
    return found


def set_functions(
    grid: Grid, spline: Spline, coefficients: np.ndarray, thresholds: np.ndarray, above: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The functions of the inner and the outer set at the nodes; NaN if nothing is proved on a side."""
    nodes = grid.nodes().reshape(-1, grid.ndim)
    excess = [_beyond(spline, nodes, coefficients, thresholds, side).reshape(grid.shape) for side in (0, 1)]
    inner, outer = (-excess[0], excess[1]) if above else (-excess[1], excess[0])
    return np.where(np.isfinite(inner), inner, np.nan), np.where(np.isfinite(outer), outer, np.nan)


@dataclasses.dataclass(frozen=True)
class _Proof:
    """Candidates that bound a side together.

    Attributes:
      side: 0 for the lower and 1 for the upper side.
      some: the candidates.
      path: σ, with the sign of the side.
    """

    side: int
    some: list[Candidate]
    path: np.ndarray

    @property
    def level(self) -> float:
        """σ at t = 0."""
        return float(self.path[0])

    def meets_end(self) -> bool:
        """True if states that are not beyond σ may be at a projected end at some time."""
        least, mesh = largest_least(self.some, self.side), self.some[0].task.mesh
        ends = [np.take(least, 0 if step < 0 else -1, axis=axis) for axis, step in mesh.sides("projected")]
        return not all(np.all(end > self.level) for end in ends)  # σ is the largest at t = 0


def _proofs(
    problem: Problem, solution: Solution, task: TubeTask, level: float, levels: tuple[float, float], depth: int
) -> tuple[list[_Proof], dict[str, int]]:
    """The levels of both sides, and the numbers of evaluated and bisected cells.

    The first candidate is V itself. If σ moves by more than one or two cells, branches are tried, and at last V in a
    wider band.
    """
    own = Candidate.of(task)
    search = LevelSearch.of(own, levels, depth)
    paths, bisected = search.paths([own], (0, 1), 1)
    proofs, everyone = [_Proof(side, [own], path) for side, path in enumerate(paths)], [own]
    for side, first in enumerate(proofs):
        if np.isfinite(first.level):
            continue
        values = branches(problem, solution, side, level, search.band)
        tries = [[own]]
        if values:
            tries.insert(0, [Candidate.of(task.with_values(each)) for each in values])
            everyone += tries[0]
        for some in tries:
            (path,), count = search.paths(some, (side,), WIDER)
            proofs[side], bisected = _Proof(side, some, path), bisected + count
            if np.isfinite(path[0]):
                break
    return proofs, {"cells": sum(int(each.found.known.sum()) for each in everyone), "bisected": bisected}


def _checked(problem: Problem, solution: Solution) -> tuple[Problem, np.ndarray, float]:
    """The problem with its numbers settled, the value at all times, and the horizon.

    Raises:
      ValueError: there is no proof for the problem, its grid or its solution.
    """
    checks.check_types("enclose_tube", problem, solution)
    grid = solution.grid
    others = {
        "a running cost": problem.cost is not None or problem.reward is not None,
        "a discount": bool(is_discounted(problem)), "a target": problem.target is not None,
        "rewards": problem.stopping_reward is not None or problem.terminal_reward is not None,
        "a march from other values than the terminal cost": bool(solution.stats.get("start")),
    }  # fmt: skip
    wanted = "a problem of reach, avoid or reach_avoid.\nSets are proved only for these problems"
    checks.check_ingredients("enclose_tube", problem, grid, others, wanted)
    horizon = float(solution.stats.get("horizon", np.nan)) if solution.times is not None else np.nan
    times = np.asarray([] if solution.times is None else solution.times, float)
    even = len(times) >= FEWEST and np.allclose(
        times, np.linspace(0.0, horizon, len(times)), rtol=0, atol=1e-9 * horizon
    )
    if not even:
        raise ValueError(
            f"enclose_tube: got a solution with {len(times)} times; wanted at least {FEWEST} equally spaced ones from\n"
            "zero to the horizon, as in march(problem, grid, T, times=np.linspace(0, T, 41))"
        )
    value = np.asarray(solution.value, float)
    if value.shape != (len(times), *grid.shape) or not np.all(np.abs(value) <= LARGEST):
        raise ValueError(f"enclose_tube: got a value of shape {value.shape}, or numbers that are not below {LARGEST:g}")
    arguments.positive(horizon, "enclose_tube: horizon")
    return in_unit_box(closures.settled(problem, grid.ndim), grid.ndim), value, horizon


def _peak_bytes(problem: Problem, shape: tuple[int, ...]) -> int:
    """Bytes that ``enclose_tube`` uses at its peak: all scalars of one block of cells, and arrays at all cells."""
    n, size = len(shape), int(np.prod(shape))
    sets = [problem.controls] + [problem.disturbances] * problem.is_game
    inputs = [[0.0] * (0 if each is None else each.dim) for each in sets]
    at = [0.0, [0.0] * (n - 1)] if problem.time_dependent else [[0.0] * (n - 1)]
    count = operations(traced(problem.drift, *at, *inputs))
    scalar = 8 * 2 * (2 + 2 * n + n * (n + 1) // 2)
    splines = max(len(vertices(problem, side)) for side in (0, 1))
    return int(scalar * min(size, 8192) * (120 + count.single + count.whole) + 8 * (24 + 16 * splines) * size)


def _message(low: float, high: float, above: bool, is_free: bool, walls: bool) -> str:
    """The statement that is proved."""
    which = "the problem with walls at the projected ends of the box" if walls and not is_free else "the problem"
    text = f"The inner set is inside the tube of {which}, and the outer set contains it"
    outer, inner = (high, low) if above else (low, high)
    if not np.isfinite(inner):
        text += "; the inner set is empty"
    if not np.isfinite(outer):
        text += "; the outer set is the whole box"
    return text + "."


__all__ = ["TubeEnclosure", "enclose_tube"]
