"""Convergence studies: one problem on successively finer grids, errors against spacing and time.

With the errors e_k on grids of spacing h_k, the order p is the least-squares slope of log e over log h. The reference
for the errors is in ``hjbjax.reference``.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from itertools import pairwise, repeat
from typing import Any

import numpy as np

from hjbjax.applications.reference import (
    absolute_difference,
    at_nodes_of,
    at_shared_nodes,
    check_reference,
    check_same_box,
    mask_of,
    mean_spacing,
    mean_spacings,
    richardson,
    words_for,
)
from hjbjax.discretisation.discretisation import Scheme
from hjbjax.discretisation.schemes import Upwind
from hjbjax.iteration.methods import Method
from hjbjax.problem.grid import Grid
from hjbjax.problem.mode_axis import of_mode, with_modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door
from hjbjax.problem.types import Numbers
from hjbjax.solution.clock import Clock, noting_interrupts
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status
from hjbjax.solvers.stationary import solve
from hjbjax.tracing.closures import refuse_traced

REFINED = 1.1  # maximal ratio between the refinement factors of two axes


# eq=False, because comparing arrays does not give a single boolean
@dataclasses.dataclass(frozen=True, eq=False)
class Study:
    """The spacings, errors and times of a study, one entry per grid from coarse to fine; ``print`` shows the table.

    Args:
      grids: the grids.
      solutions: the solution on each grid.
      scheme: the scheme as text.
      tol: the tolerance of every solve.
      reference: a description of the reference for the errors.
      estimated: True if the reference is an estimate from these solutions.
      h: spacings, the geometric mean over the axes.
      errors: the largest |V_h − V| over the nodes of the region.
      mean_errors: the mean |V_h − V| over these nodes.
      seconds: the wall time of a second solve, without compilation.
      compile_seconds: the additional time of the first solve.
      extrapolated: Richardson's V on the nodes of the coarsest grid, if there is one.
    """

    grids: tuple[Grid, ...]
    solutions: tuple[Solution, ...]
    scheme: str
    tol: float
    reference: str
    estimated: bool
    h: np.ndarray
    errors: np.ndarray
    mean_errors: np.ndarray
    seconds: np.ndarray
    compile_seconds: np.ndarray
    extrapolated: np.ndarray | None = None

    @property
    def nodes(self) -> np.ndarray:
        """The number of nodes of each grid."""
        return np.array([grid.size for grid in self.grids])

    @property
    def statuses(self) -> tuple[Status, ...]:
        """The status of each solve."""
        return tuple(solution.status for solution in self.solutions)

    @property
    def fitted(self) -> np.ndarray:
        """A mask of the grids that count for the orders: grids that converged with an error above the tolerance."""
        converged = np.array([status is Status.CONVERGED for status in self.statuses])
        # a smaller error may come from the iteration instead of the grid
        return converged & np.isfinite(self.errors) & (self.errors > self.tol)

    @property
    def order(self) -> float:
        """The fitted order of the largest error; NaN with fewer than two grids to fit."""
        return fitted_order(self.h[self.fitted], self.errors[self.fitted])

    @property
    def mean_order(self) -> float:
        """The fitted order of the mean error, from the same grids."""
        return fitted_order(self.h[self.fitted], self.mean_errors[self.fitted])

    @property
    def orders(self) -> np.ndarray:
        """The order of the largest error from each grid to the next, one entry fewer than grids."""
        return self._steps(self.errors)

    @property
    def mean_orders(self) -> np.ndarray:
        """The order of the mean error from each grid to the next."""
        return self._steps(self.mean_errors)

    def _steps(self, errors: np.ndarray) -> np.ndarray:
        """The slopes of log error over log h from each grid to the next; NaN next to a grid that is not fitted."""
        known = self.fitted[:-1] & self.fitted[1:]
        # an error of zero has no logarithm and is not fitted, so replace it by any positive number
        logs = np.log(np.where(self.fitted, errors, 1.0))
        return np.where(known, np.diff(logs) / np.diff(np.log(self.h)), np.nan)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The table as plain numbers and strings, one dictionary per grid, ready for JSON."""
        return [
            {
                "shape": list(grid.shape),
                "nodes": grid.size,
                "h": float(self.h[k]),
                "error": float(self.errors[k]),
                "mean_error": float(self.mean_errors[k]),
                "estimated": self.estimated,
                "seconds": float(self.seconds[k]),
                "compile_seconds": float(self.compile_seconds[k]),
                "fitted": bool(self.fitted[k]),  # JSON does not accept NumPy booleans
                "status": self.statuses[k].name,
            }
            for k, grid in enumerate(self.grids)
        ]

    def __repr__(self) -> str:
        return f"Study({self.scheme}, {len(self.grids)} grids, order {self.order:.2f})"

    def __str__(self) -> str:
        what = "estimated" if self.estimated else "largest"
        lines = [f"{self.scheme}, tol {self.tol:g}; error against {self.reference}"]
        lines.append(f"{'grid':>14} {'h':>9} {what:>11} {'order':>6} {'mean':>10} {'order':>6}  seconds  first  status")
        # an order belongs to two successive grids; the table shows it in the row of the finer grid
        orders, means = (["", *map(_order, steps)] for steps in (self.orders, self.mean_orders))
        for k, grid in enumerate(self.grids):
            lines.append(
                f"{' x '.join(map(str, grid.shape)):>14} {self.h[k]:>9.3g} {self.errors[k]:>10.3e}"
                f"{' ' if self.fitted[k] else '*'} {orders[k]:>6} {self.mean_errors[k]:>10.3e} {means[k]:>6}"
                # the sum is the time of the first solve, including compilation
                f" {self.seconds[k]:>8.3g} {self.seconds[k] + self.compile_seconds[k]:>6.3g}  {self.statuses[k].name}"
            )
        lines.append(f"{'fitted':>14} {'':>9} {'':>11} {_order(self.order):>6} {'':>10} {_order(self.mean_order):>6}")
        if not self.fitted.all():
            lines.append("* not fitted: the solve did not converge, or its error is not above the tolerance or unknown")
        return "\n".join(line.rstrip() for line in lines)


@front_door
def convergence_study(
    problem: Problem,
    grids: Sequence[Grid],
    reference: Callable | Solution | None = None,
    *,
    scheme: Scheme = Upwind(),
    method: Method | None = None,
    tol: float = 1e-7,
    region: Callable | float | None = None,
) -> Study:
    """Solve one problem on several grids, measure the errors and fit their orders.

    Every grid is solved twice, so that the second solve gives the time without compilation. A solve that does not
    converge keeps its row, with its status, but is not fitted. The same holds for an error below the tolerance.

    Args:
      problem: the problem.
      grids: at least two grids of the same box in any order, refined by the same factor along every axis.
      reference: the value as a function of one state, and of the mode if there are modes, or a converged ``Solution``
        on a finer grid, interpolated linearly between its nodes. ``None`` uses Richardson's estimate from the three
        finest grids. The number of intervals of every grid must then be a multiple of the number on the coarsest grid,
        as with 41, 81 and 161 nodes.
      scheme: as in ``solve``.
      method: as in ``solve``.
      tol: as in ``solve``; it must be small, so that errors come from the grid and not from the iteration.
      region: the region where errors count: a boolean function of one state, and of the mode, or the fraction of the
        box around its centre along every axis that is not periodic, 0.5 for its inner half; ``None`` is everywhere.

    Returns:
      The study: ``.h``, ``.errors``, ``.order`` and the rest; ``print(study)`` shows the table and
      ``hjb.plotting.convergence(study)`` draws it.

    Raises:
      ValueError: there are fewer than two grids, or fewer than three without a reference; the grids have different
        boxes; the reference has the wrong shape, a coarser grid, or NaN; the region has no node; or ``solve`` refuses.
      TypeError: an argument is not a grid, a reference or a region.
      SolveError: the study was interrupted; ``.solution`` is the study of the grids so far.

    Example:
      >>> from hjbjax import zoo
      >>> problem, _ = zoo.bang_bang()
      >>> grids = [Grid([-2.0], [2.0], (n,)) for n in (21, 41, 81)]
      >>> study = convergence_study(problem, grids, zoo.bang_bang_exact())
      >>> study.nodes.tolist(), abs(study.order - 1) < 0.15
      ([21, 41, 81], True)
    """
    refuse_traced("convergence_study", problem, grids, reference)  # seconds, statuses and masks must be concrete
    ordered = _sort(grids)
    if isinstance(problem, Problem) and problem.modes is not None:
        ordered = tuple(with_modes(grid, problem.modes.names) for grid in ordered)
        reference, region = of_mode(reference, problem.modes), of_mode(region, problem.modes)
    check_reference(reference, ordered)  # before any solve, because a late error would waste the time of the solves
    compared = ordered if reference is not None else ordered[:1] * len(ordered)  # the estimate is on the coarsest grid
    masks = [mask_of(region, grid) for grid in compared]
    # evaluate the reference before the first solve, so that a bad reference is refused at once
    exact = [] if reference is None else list(map(at_nodes_of, repeat(reference), ordered, masks))
    clock, timed = Clock(), []
    with noting_interrupts(clock):
        for grid in ordered:
            # throw=False: a grid that does not converge keeps its row, with its status
            timed.append(_solve_twice(problem, grid, clock, scheme=scheme, method=method, tol=tol, throw=False))
            if clock.interrupted:  # an interrupted solve returns its partial solution
                break
    # after Ctrl-C the rows so far are a study, whose last grid may have been solved only once
    whole = len(timed) == len(ordered)
    ordered, masks, exact = ordered[: len(timed)], masks[: len(timed)], exact[: len(timed)]
    solutions = tuple(solution for solution, _, _ in timed)
    values = [np.asarray(solution.value) for solution in solutions]  # one array per grid
    h = np.array([mean_spacing(grid) for grid in ordered])
    extrapolated, words = None, words_for(reference, ordered)
    if reference is None:
        # all errors on the nodes of the coarsest grid, which all grids share
        values = [at_shared_nodes(value, grid, ordered[0]) for value, grid in zip(values, ordered, strict=True)]
        if clock.interrupted:
            words = "nothing: the study was interrupted"
        else:
            extrapolated, words = richardson(values[-3:], h[-3:], masks[0], tol)
        # without an estimate all errors are NaN, and no grid is fitted
        exact = [np.full(masks[0].shape, np.nan) if extrapolated is None else extrapolated] * len(values)
    # one array of distances per grid, over the nodes of its region
    off = [absolute_difference(*pair)[mask] for *pair, mask in zip(values, exact, masks, strict=True)]
    study = Study(
        ordered,
        solutions,
        scheme=str(scheme),
        tol=tol,
        reference=words,
        estimated=reference is None,
        h=h,
        # max instead of nanmax, so that a node without a value gives NaN and excludes its grid from the fit
        errors=np.array([np.max(each) for each in off]),
        mean_errors=np.array([np.mean(each) for each in off]),
        seconds=np.array([warm for _, _, warm in timed]),
        # if nothing had to be compiled, the second solve may take longer by chance
        compile_seconds=np.array([cold if math.isnan(warm) else max(0.0, cold - warm) for _, cold, warm in timed]),
        extrapolated=extrapolated,
    )
    if clock.interrupted:
        came = "after the last solve" if whole else f"on the grid {' x '.join(map(str, ordered[-1].shape))}"
        raise SolveError(f"convergence_study: interrupted {came}; .solution is the study so far", study)
    return study


def fitted_order(h: Numbers | Sequence[float], errors: Numbers | Sequence[float]) -> float:
    """The least-squares slope of log error over log h; NaN unless two errors are positive and finite."""
    # e = c h^p gives log e = p log h + log c; the slope p does not depend on the unit of h
    h, errors = np.asarray(h, float), np.asarray(errors, float)
    usable = np.isfinite(errors) & (errors > 0)
    if np.count_nonzero(usable) < 2:  # a line through one point has every slope
        return math.nan
    return float(np.polyfit(np.log(h[usable]), np.log(errors[usable]), 1)[0])


def _solve_twice(problem: Problem, grid: Grid, clock: Clock, **options: Any) -> tuple[Solution, float, float]:
    """Solve twice: the solution, and the wall times of the first and the second solve, NaN if it was interrupted."""
    marks = [time.perf_counter()]
    solution = solve(problem, grid, **options)  # compiles, unless a grid of this shape was solved before
    marks.append(time.perf_counter())
    if not clock.interrupted:
        solve(problem, grid, **options)  # nothing is left to compile
        marks.append(time.perf_counter())
    if clock.interrupted:
        return solution, marks[1] - marks[0], math.nan
    return solution, marks[1] - marks[0], marks[2] - marks[1]


def _sort(grids: Sequence[Grid] | Grid) -> tuple[Grid, ...]:
    """Check that the grids have the same box and refine evenly, and sort them from coarse to fine."""
    grids = list(grids) if isinstance(grids, Sequence) else [grids]
    for grid in grids:
        if not isinstance(grid, Grid):
            raise TypeError(f"convergence_study: got {grid!r} among the grids, wanted Grid objects")
    if len(grids) < 2:
        raise ValueError(f"convergence_study: got {len(grids)} grid, wanted at least two to see an order")
    # the geometric mean of the spacings, so that the units of the axes do not matter
    first, *rest = ordered = sorted(grids, key=mean_spacing, reverse=True)
    for grid in rest:
        check_same_box("grids of different boxes", first, grid)
        if repr(grid.stretch) != repr(first.stretch):  # compare the text, because stretch functions compare by identity
            raise ValueError(f"convergence_study: got stretch {first.stretch} and {grid.stretch}; wanted one for all")
        ratios = mean_spacings(first) / mean_spacings(grid)  # (n,), the refinement factor along every axis
        # intervals are integers, so allow an odd axis to deviate by 10 %
        if ratios.max() > REFINED * ratios.min():
            raise ValueError(
                f"convergence_study: from {first.shape} to {grid.shape} the axes are refined by the factors "
                f"{', '.join(f'{ratio:.3g}' for ratio in ratios)}; wanted one factor, so that one h describes all axes"
            )
    # two equal spacings have no slope
    if any(coarse.shape == fine.shape for coarse, fine in pairwise(ordered)):
        raise ValueError(f"convergence_study: got grids {[grid.shape for grid in ordered]}; wanted each one once")
    return tuple(ordered)


def _order(order: float) -> str:
    """An order as text for the table."""
    return f"{order:.2f}" if math.isfinite(order) else "-"
