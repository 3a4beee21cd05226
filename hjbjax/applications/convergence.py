"""Studies of convergence: one problem on finer and finer grids, errors against h and against seconds.

With e_k the error on the grid of spacing h_k the order p is the slope of log e over log h by least squares. What
the errors are measured against is the matter of ``hjbjax.reference``.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from itertools import pairwise, repeat
from typing import Any

import numpy as np

from hjbjax.applications.reference import (
    at_nodes_of,
    check_box,
    check_reference,
    distance,
    mask_of,
    mean_spacing,
    restrict,
    richardson,
    spacings,
    words_for,
)
from hjbjax.discretisation.discretisation import Scheme
from hjbjax.discretisation.schemes import Upwind
from hjbjax.iteration.methods import Method
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, is_traced
from hjbjax.problem.types import Numbers
from hjbjax.solution.clock import Clock, noting_interrupts
from hjbjax.solution.solution import Solution, SolveError
from hjbjax.solution.status import Status
from hjbjax.solvers.stationary import solve

REFINED = 1.1  # the factors by which the axes are refined over one another, at most


# no ==: it would compare arrays, which have no single truth value
@dataclasses.dataclass(frozen=True, eq=False)
class Study:
    """Spacings, errors and seconds of a study, one entry a grid from coarse to fine; ``print`` shows the table.

    Args:
      grids: the grids.
      solutions: the solution on each.
      scheme: the scheme's text.
      tol: the tolerance of every solve.
      reference: what the errors are measured against, in words.
      estimated: True where that is an estimate from these very solutions.
      h: spacings, the geometric mean over the axes.
      errors: the largest |V_h − V| over the nodes of the region.
      mean_errors: the mean of it.
      seconds: wall time of a second solve, all of it: nothing is compiled any more.
      compile_seconds: how much longer the first one took.
      extrapolated: Richardson's V on the nodes of the coarsest grid, where there is one.
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
        """How each solve ended."""
        return tuple(solution.status for solution in self.solutions)

    @property
    def fitted(self) -> np.ndarray:
        """A mask of the grids that count for the orders: converged, and with an error above the tolerance."""
        converged = np.array([status is Status.CONVERGED for status in self.statuses])
        # an error at or below the tolerance may be what the iteration left, and says nothing of the grid
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
        """The order of the largest error from each grid to the next, one entry less than grids."""
        return self._steps(self.errors)

    @property
    def mean_orders(self) -> np.ndarray:
        """The order of the mean error from each grid to the next."""
        return self._steps(self.mean_errors)

    def _steps(self, errors: np.ndarray) -> np.ndarray:
        """The slopes of log error over log h from each grid to the next; NaN beside one that is not fitted."""
        known = self.fitted[:-1] & self.fitted[1:]
        # an error of zero has no logarithm, and is not fitted: any positive number stands in for it
        logs = np.log(np.where(self.fitted, errors, 1.0))
        return np.where(known, np.diff(logs) / np.diff(np.log(self.h)), np.nan)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The table as plain numbers and words, one dictionary a grid, as a JSON file takes them."""
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
                "fitted": bool(self.fitted[k]),  # JSON takes no truth value of NumPy
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
        # an order belongs to a step between two grids, and is written beside the finer one
        orders, means = (["", *map(_order, steps)] for steps in (self.orders, self.mean_orders))
        for k, grid in enumerate(self.grids):
            lines.append(
                f"{' x '.join(map(str, grid.shape)):>14} {self.h[k]:>9.3g} {self.errors[k]:>10.3e}"
                f"{' ' if self.fitted[k] else '*'} {orders[k]:>6} {self.mean_errors[k]:>10.3e} {means[k]:>6}"
                # the sum is the first solve, compiling included
                f" {self.seconds[k]:>8.3g} {self.seconds[k] + self.compile_seconds[k]:>6.3g}  {self.statuses[k].name}"
            )
        lines.append(f"{'fitted':>14} {'':>9} {'':>11} {_order(self.order):>6} {'':>10} {_order(self.mean_order):>6}")
        if not self.fitted.all():
            lines.append("* not fitted: the solve did not converge, or no error above the tolerance is known")
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

    Every grid is solved twice, so that the second solve tells the time without compiling. A solve that does not
    converge keeps its row, with its status, and stays out of the fit; so does an error below the tolerance.

    Args:
      problem: the question.
      grids: at least two grids of one box, refined alike along every axis; in any order.
      reference: the value as a function of one state; or a converged ``Solution`` on a grid finer than all, which
        between its nodes is linear; or ``None``: Richardson's estimate from the three finest grids, which needs
        grids whose intervals are multiples of the coarsest one's, as with 41, 81 and 161 nodes.
      scheme: as for ``solve``.
      method: as for ``solve``.
      tol: as for ``solve``, and small: errors are to show the grid, not the iteration.
      region: where errors count: a function of one state, true inside; or the share of the box around its centre
        along every axis that is not periodic, .5 for its inner half; ``None`` is everywhere.

    Returns:
      The study: ``.h``, ``.errors``, ``.order`` and the rest; ``print(study)`` shows the table and
      ``hjb.plotting.convergence(study)`` draws it.

    Raises:
      ValueError: fewer than two grids, or three without a reference; grids of different boxes; a reference of
        another shape, on a coarser grid, or NaN; a region without a node; and what ``solve`` refuses.
      TypeError: something that is no grid, no reference or no region.
      SolveError: it was interrupted; ``.solution`` is the study of the grids so far.

    Example:
      >>> from hjbjax import zoo
      >>> problem, _ = zoo.bang_bang()
      >>> grids = [Grid([-2.0], [2.0], (n,)) for n in (21, 41, 81)]
      >>> study = convergence_study(problem, grids, zoo.bang_bang_exact())
      >>> study.nodes.tolist(), abs(study.order - 1) < 0.15
      ([21, 41, 81], True)
    """
    if is_traced(problem, grids, reference):  # seconds, statuses and masks are read as plain values
        raise ValueError("convergence_study: it runs at host level only, outside of jit, vmap and grad")
    ordered = _sort(grids)
    check_reference(reference, ordered)  # before any solve: a refusal after them would throw their time away
    compared = ordered if reference is not None else ordered[:1] * len(ordered)  # the estimate lives on the coarsest
    masks = [mask_of(region, grid) for grid in compared]
    # the reference at all nodes before the first solve: what cannot be measured against is refused at once
    exact = [] if reference is None else list(map(at_nodes_of, repeat(reference), ordered, masks))
    clock, timed = Clock(), []
    with noting_interrupts(clock):
        for grid in ordered:
            # no raise: a grid that does not converge keeps its row, with its status
            timed.append(_solve_twice(problem, grid, clock, scheme=scheme, method=method, tol=tol, throw=False))
            if clock.interrupted:  # the solve has handed back what it had, not raised
                break
    # Ctrl-C: the rows so far are a study, whose last grid may have one solve in place of two
    whole = len(timed) == len(ordered)
    ordered, masks, exact = ordered[: len(timed)], masks[: len(timed)], exact[: len(timed)]
    solutions = tuple(solution for solution, _, _ in timed)
    values = [np.asarray(solution.value) for solution in solutions]  # one array a grid, of its own shape
    h = np.array([mean_spacing(grid) for grid in ordered])
    extrapolated, words = None, words_for(reference, ordered)
    if reference is None:
        # all errors on the nodes of the coarsest grid, which all have: there alone V is known from three spacings
        values = [restrict(value, grid, ordered[0]) for value, grid in zip(values, ordered, strict=True)]
        if clock.interrupted:
            words = "nothing: the study was interrupted"
        else:
            extrapolated, words = richardson(values[-3:], h[-3:], masks[0], tol)
        # without an estimate NaN: every error is then NaN, and no grid is fitted
        exact = [np.full(masks[0].shape, np.nan) if extrapolated is None else extrapolated] * len(values)
    # one row of distances a grid, over the nodes of its region
    off = [distance(*pair)[mask] for *pair, mask in zip(values, exact, masks, strict=True)]
    study = Study(
        ordered,
        solutions,
        scheme=str(scheme),
        tol=tol,
        reference=words,
        estimated=reference is None,
        h=h,
        # no nanmax: a node without a value must show, and takes its grid out of the fit
        errors=np.array([np.max(each) for each in off]),
        mean_errors=np.array([np.mean(each) for each in off]),
        seconds=np.array([warm for _, _, warm in timed]),
        # where nothing had to be compiled the second solve may by chance take longer
        compile_seconds=np.array([cold if math.isnan(warm) else max(0.0, cold - warm) for _, cold, warm in timed]),
        extrapolated=extrapolated,
    )
    if clock.interrupted:
        came = "after the last solve" if whole else f"on the grid {' x '.join(map(str, ordered[-1].shape))}"
        raise SolveError(f"convergence_study: interrupted {came}; .solution is the study so far", study)
    return study


def fitted_order(h: Numbers | Sequence[float], errors: Numbers | Sequence[float]) -> float:
    """The slope of log error over log h by least squares; NaN unless two errors are positive and finite."""
    # log e = p log h + log c of e = c h^p: the slope is p, in whatever units h is
    h, errors = np.asarray(h, float), np.asarray(errors, float)
    usable = np.isfinite(errors) & (errors > 0)
    if np.count_nonzero(usable) < 2:  # a line through one point has every slope
        return math.nan
    return float(np.polyfit(np.log(h[usable]), np.log(errors[usable]), 1)[0])


def _solve_twice(problem: Problem, grid: Grid, clock: Clock, **options: Any) -> tuple[Solution, float, float]:
    """A solution, and the wall time of the first and of a second solve, NaN where that was interrupted."""
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
    """The grids from coarse to fine, once they are known to be of one box and to shrink alike."""
    grids = list(grids) if isinstance(grids, Sequence) else [grids]
    for grid in grids:
        if not isinstance(grid, Grid):
            raise TypeError(f"convergence_study: got {grid!r} among the grids, wanted Grid objects")
    if len(grids) < 2:
        raise ValueError(f"convergence_study: got {len(grids)} grid, wanted at least two to see an order")
    # by the geometric mean of the spacings, so that the order does not depend on the units of the axes
    first, *rest = ordered = sorted(grids, key=mean_spacing, reverse=True)
    for grid in rest:
        check_box("grids of different boxes", first, grid)
        if repr(grid.stretch) != repr(first.stretch):  # by their text: they compare as objects
            raise ValueError(f"convergence_study: got stretch {first.stretch} and {grid.stretch}; wanted one for all")
        ratios = spacings(first) / spacings(grid)  # (n,), how many times finer along every axis
        # intervals are integers: 10 % lets an odd axis be refined by almost the factor of the others
        if ratios.max() > REFINED * ratios.min():
            raise ValueError(
                f"convergence_study: from {first.shape} to {grid.shape} the axes are refined by the factors "
                f"{', '.join(f'{ratio:.3g}' for ratio in ratios)}; wanted one factor, so that one h stands for all"
            )
    # between two equal spacings there is no slope to fit
    if any(coarse.shape == fine.shape for coarse, fine in pairwise(ordered)):
        raise ValueError(f"convergence_study: got grids {[grid.shape for grid in ordered]}; wanted each one once")
    return tuple(ordered)


def _order(order: float) -> str:
    """An order as the table shows it."""
    return f"{order:.2f}" if math.isfinite(order) else "-"
