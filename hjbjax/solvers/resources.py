"""Estimates of a solve: bytes by counting arrays, steps and seconds by solving on two small grids of the same box."""

import dataclasses
import math

import numpy as np

from hjbjax.discretisation.discretisation import Scheme
from hjbjax.discretisation.posing import with_mode_axis
from hjbjax.discretisation.schemes import Upwind
from hjbjax.iteration.methods import Method, Nested
from hjbjax.problem import arguments
from hjbjax.problem.arguments import INDEXABLE
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door
from hjbjax.problem.rewards import costs_of
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import in_unit_box
from hjbjax.problem.time_change import in_own_time
from hjbjax.problem.types import DType
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import keeping_warnings
from hjbjax.solvers import memory, semi_lagrangian
from hjbjax.solvers.coarse_levels import below
from hjbjax.solvers.nested_grids import resized
from hjbjax.solvers.setup import check_on_one_state, choose, may_raise_order
from hjbjax.solvers.stationary import check_arguments, solve

SMALL = 12_000  # nodes of the larger trial grid: about a second, plus compilation
FEWEST = 4  # minimal number of intervals per axis


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Estimated resources of a solve.

    Attributes:
      shape: the number of nodes per axis; with modes their number comes first.
      bytes: peak memory on the device.
      free: free bytes on the device; ``None`` if unknown.
      largest: points per axis of the state, in the largest grid with the same axes and modes that fits; ``None`` if
        unknown.
      programs: the number of compiled loops, one per grid and scheme.
      steps: improvements on the finest grid; ``None`` if the small grids could not be solved.
      seconds: the time of all steps, usually within a factor of three.
      compile_seconds: the time of checks and compilation, measured on the small grids.
      note: the reason if steps and seconds are unknown.
    """

    shape: tuple[int, ...]
    bytes: int
    free: int | None
    largest: int | None
    programs: int
    steps: int | None = None
    seconds: float | None = None
    compile_seconds: float | None = None
    note: str = ""

    @property
    def numbered(self) -> bool:
        """True if 32-bit indices can number the nodes."""
        return math.prod(self.shape) < INDEXABLE

    @property
    def fits(self) -> bool:
        """True if there is enough memory, and 32-bit indices can number the nodes."""
        return self.numbered and (self.free is None or self.bytes <= self.free)

    def __str__(self) -> str:
        free = "" if self.free is None else f", {self.free / 1e9:.3g} GB are free"
        most = "" if self.largest is None else f"; at most {self.largest} points per axis fit"
        lines = [
            f"nodes     {' x '.join(map(str, self.shape))} = {math.prod(self.shape):,}"
            + ("" if self.numbered else f": 32-bit indices number fewer than {INDEXABLE:,}"),
            f"memory    {self.bytes / 1e9:.3g} GB{free}{most}{'' if self.fits else ': IT DOES NOT FIT'}",
            f"programs  {self.programs} to compile",
        ]
        if self.seconds is None or self.compile_seconds is None:
            return "\n".join([*lines, f"steps     not known: {self.note}"])
        return "\n".join(
            [
                *lines,
                f"steps     {self.steps}",
                f"seconds   {self.seconds:.2g}, and {self.compile_seconds:.2g} to compile",
            ]
        )


@with_mode_axis()
@front_door
def estimate(
    problem: Problem,
    grid: Grid,
    method: Method | None = None,
    *,
    scheme: Scheme | None = None,
    tol: float | None = None,
    dtype: DType | None = None,
    measure: bool = True,
) -> Estimate:
    """Estimate the memory and time of ``solve`` without allocating arrays of the size of the grid.

    Args:
      problem: the problem.
      grid: the grid.
      method: as in ``solve``.
      scheme: as in ``solve``.
      tol: as in ``solve``.
      dtype: as in ``solve``.
      measure: solve on two small grids to estimate steps and seconds, which takes a few seconds; otherwise only bytes.

    Returns:
      The estimate. Steps and seconds are extrapolated from the two grids by a power law in the number of nodes.

    Raises:
      ValueError: an argument is not admissible.

    Example:
      >>> import hjbjax as hjb
      >>> problem, grid = hjb.zoo.manipulator(links=2, shape=(200,) * 4)
      >>> hjb.estimate(problem, grid, dtype="float32", measure=False).bytes // grid.size
      74
    """
    check_arguments(problem, grid, method, scheme, tol)
    asked, problem = problem, in_own_time(in_unit_box(costs_of(problem), grid.ndim))  # memory does not depend on a sign
    kind, free = arguments.as_dtype(dtype), memory.available()
    check_on_one_state(problem, grid, scheme or Upwind())
    chosen = choose(problem, grid, traced=False, method=method)
    paths = None if scheme is None else scheme.paths
    if paths is not None:
        paths.check(problem, grid)
        with own_settings(x64=kind == np.float64):
            needed, programs = semi_lagrangian.arc_bytes(grid, paths.plan(problem, grid, kind), kind), 1
    else:
        high_order = may_raise_order(problem, chosen.inner, scheme)
        needed = memory.peak_bytes(problem, grid, chosen.inner, kind, high_order=high_order)
        programs = _programs(grid, chosen, scheme)
    largest = None if free is None else memory.points_per_axis(min(free / needed * grid.size, INDEXABLE - 1), grid)
    about = Estimate(grid.shape, needed, free, largest, programs)
    if not measure:
        return dataclasses.replace(about, note="nothing was measured")
    tried = _tried(grid)
    found: list[Solution] = []
    with keeping_warnings():
        try:
            for small in tried:
                alike = _alike(chosen, small, grid) if paths is None else method
                options = {"scheme": scheme, "tol": tol, "dtype": kind, "throw": False, "progress": False}
                found.append(solve(asked, small, method=alike, **options))
        except ValueError as refusal:
            return dataclasses.replace(
                about, note=f"on {memory.as_counts(small)} nodes: {str(refusal).splitlines()[0]}"
            )
    coarse, fine = found
    ratio, beyond = max(tried[1].size / tried[0].size, 1 + 1e-9), grid.size / tried[1].size
    most = 2 / len(grid.state_axes)  # per step a front moves one cell, and noise needs N steps to spread over √N cells
    seconds = [max(each.stats["seconds"], 1e-4) for each in found]
    growth = 1 + np.clip(np.log(seconds[1] / seconds[0]) / np.log(ratio) - 1, 0, most)
    climb = np.clip(np.log(max(fine.steps, 1) / max(coarse.steps, 1)) / np.log(ratio), 0, most)
    return dataclasses.replace(
        about,
        steps=round(max(fine.steps, 1) * beyond**climb),
        seconds=float(seconds[1] * beyond**growth),
        compile_seconds=float(max(each.stats["compile_seconds"] for each in found)),
    )


def _programs(grid: Grid, method: Method, scheme: Scheme | None) -> int:
    """The loops to compile: one per grid, and without a scheme one for the coarser grid that estimates the error."""
    count, smaller = 1, below(grid, method)
    while smaller is not None:
        count, smaller = count + 1, below(smaller, method)
    return count + (scheme is None and count == 1)


def _tried(grid: Grid) -> tuple[Grid, Grid]:
    """Two small grids of the box, the coarser one first."""
    fine = _smaller(grid, min(SMALL, grid.size / 4))
    return _smaller(grid, fine.size / 4), fine


def _smaller(grid: Grid, nodes: float) -> Grid:
    """The grid with about this number of nodes; an axis with a node in its middle keeps it."""
    share, shape = (nodes / grid.size) ** (1 / len(grid.state_axes)), []
    for axis, count in enumerate(grid.shape):
        if axis not in grid.state_axes:
            shape.append(count)
            continue
        intervals = grid.intervals(axis)
        fewer = max(round(share * intervals), FEWEST)
        fewer += (intervals - fewer) % 2
        shape.append(count - intervals + min(fewer, intervals))
    return resized(grid, shape)


def _alike(method: Method, small: Grid, grid: Grid) -> Method:
    """The method with the same number of levels on the small grid as on the large one."""
    if method.coarsest is None:
        return method
    return Nested(method.inner, max(round(method.coarsest * small.size / grid.size), 50))
