"""What the errors of a study are measured against: a function, a finer solution, or Richardson's extrapolation.

From V_h = V + c h^p + o(h^p) on three grids,

    (h₁^p − h₂^p)/(h₂^p − h₃^p) = |V₁ − V₂|/|V₂ − V₃|   (means over the nodes),
    V ≈ V₃ + (V₃ − V₂) h₃^p/(h₂^p − h₃^p)

which is an estimate, and is called one wherever it shows.
"""

import math
from collections.abc import Callable

import jax
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Mask, Nodes
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status

FLATTEST, STEEPEST = 1e-3, 16.0  # orders between which Richardson's is sought; the highest of a scheme is 5


def mean_spacing(grid: Grid) -> float:
    """The geometric mean of the axes' mean spacings: a change of units changes no ratio of two of them."""
    return float(np.prod(spacings(grid)) ** (1 / grid.ndim))  # n-th root of the cell's volume


def spacings(grid: Grid) -> np.ndarray:
    """The mean spacing along every axis, shape (n,)."""
    # of a stretched axis the mean; on a finer grid all of its spacings shrink by about the factor of the mean
    counts = np.array([grid.intervals(axis) for axis in range(grid.ndim)])
    return (np.asarray(grid.hi) - np.asarray(grid.lo)) / counts


def check_box(what: str, first: Grid, second: Grid) -> None:
    """Refuse two grids of different boxes."""
    # a periodic axis joins its ends: of equal corners it makes another box
    alike = first.periodic == second.periodic
    if not (alike and np.array_equal(first.lo, second.lo) and np.array_equal(first.hi, second.hi)):
        boxes = [f"{grid.lo} to {grid.hi}, periodic {grid.periodic}" for grid in (first, second)]
        raise ValueError(f"convergence_study: got {what}: {boxes[0]} and {boxes[1]}; wanted one box")


def check_reference(reference: object, grids: tuple[Grid, ...]) -> None:
    """Refuse a reference against which no error can be measured, before anything is solved."""
    if reference is None:
        if len(grids) < 3:
            raise ValueError(
                f"convergence_study: got {len(grids)} grids and no reference; Richardson's estimate needs three"
            )
        for grid in grids[1:]:
            strides(grid, grids[0])  # for its refusal alone
    elif isinstance(reference, Solution):
        # a marched value has a time axis in front
        if reference.times is not None or np.shape(reference.value) != reference.grid.shape:
            raise ValueError(
                f"convergence_study: the reference has values of shape {np.shape(reference.value)} on a grid of shape "
                f"{reference.grid.shape}; wanted one stationary solution"
            )
        if reference.status is not Status.CONVERGED:
            raise ValueError(
                f"convergence_study: the reference is {reference.status.name}; wanted a converged solution"
            )
        check_box("a reference of another box", grids[0], reference.grid)
        # its own error must be smaller than those it is to measure, along every axis
        if not np.all(spacings(reference.grid) < spacings(grids[-1])):
            raise ValueError(
                f"convergence_study: the reference is on {reference.grid.shape} nodes and the finest grid has "
                f"{grids[-1].shape}; wanted a finer reference"
            )
    elif not callable(reference):
        raise TypeError(
            f"convergence_study: got reference = {reference!r}; wanted a function of one state or a Solution"
        )


def words_for(reference: object, grids: tuple[Grid, ...]) -> str:
    """The reference in a few words, for the head of the table."""
    if not isinstance(reference, Solution):
        return "the function given"
    shape = " x ".join(map(str, reference.grid.shape))
    between = "" if all(is_nested(reference.grid, grid) for grid in grids) else ", linear between its nodes"
    return f"the solution on {shape} nodes{between}"


def at_nodes_of(reference: Solution | Callable, grid: Grid, mask: Mask) -> np.ndarray:
    """The reference at the nodes of a grid."""
    if isinstance(reference, Solution):
        # clamped: a node on the edge may lie outside of the other grid by rounding
        values = np.asarray(reference.value_at(grid.nodes(), clamp=True))
    else:
        values = evaluate(reference, grid, "the reference")
    # only where it counts: outside of the region the reference need not be known; inf is a value
    missing = np.isnan(values) & mask
    if missing.any():
        index = tuple(int(i) for i in np.argwhere(missing)[0])
        raise ValueError(
            f"convergence_study: the reference is NaN at {int(missing.sum())} nodes, first at x = {grid.state(index)}; "
            "leave them out by region="
        )
    return values


def evaluate(function: Callable, grid: Grid, what: str, name: str = "convergence_study") -> np.ndarray:
    """A function of one state at all nodes, in float64; ``name`` is who asks, for refusals."""
    with own_settings(x64=True):  # the reference must not be what limits the errors seen
        # abstractly: a wrong shape is refused before anything is compiled
        got = jax.eval_shape(function, jax.ShapeDtypeStruct((grid.ndim,), np.float64))
        if getattr(got, "shape", None) != ():
            shape = getattr(got, "shape", got)
            raise ValueError(f"{name}: {what} returned shape {shape} for one state; wanted a scalar, ()")
        states = grid.nodes().reshape(-1, grid.ndim)
        return np.asarray(jax.jit(jax.vmap(function))(states)).reshape(grid.shape)


def mask_of(region: Callable | float | None, grid: Grid, name: str = "convergence_study") -> np.ndarray:
    """The nodes that count, bool (*grid); ``name`` is who asks, for refusals."""
    if region is None:
        return np.ones(grid.shape, bool)
    if callable(region):
        inside = evaluate(region, grid, "the region", name).astype(bool)
    elif isinstance(region, (int, float)) and not isinstance(region, bool):
        # a truth value, which is an int as well, has been kept out: True would be the whole box
        if not 0 < region <= 1:
            raise ValueError(f"{name}: got region = {region!r}; wanted a share of the box in (0, 1]")
        inside = grid.inner(region)
    else:
        raise TypeError(f"{name}: got region = {region!r}; wanted a function of one state, or a share")
    if not inside.any():
        raise ValueError(f"{name}: no node of the grid {grid.shape} lies in the region; enlarge it")
    return inside


def is_nested(fine: Grid, coarse: Grid) -> bool:
    """True if every node of the coarse grid is a node of the fine one, in grids of one box."""
    # intervals, not nodes: so the rule is the same for periodic axes, which have as many of both
    multiple = all(fine.intervals(axis) % coarse.intervals(axis) == 0 for axis in range(coarse.ndim))
    return multiple and repr(fine.stretch) == repr(coarse.stretch)


def strides(fine: Grid, coarse: Grid) -> tuple[slice, ...]:
    """The slices of the fine grid that pick the nodes of the coarse one."""
    if not is_nested(fine, coarse):
        raise ValueError(
            f"convergence_study: without a reference the nodes of {coarse.shape} must be nodes of {fine.shape}; wanted "
            "intervals that are multiples of the coarsest grid's, as with 41, 81 and 161 nodes"
        )
    return tuple(slice(None, None, fine.intervals(axis) // coarse.intervals(axis)) for axis in range(fine.ndim))


def restrict(value: np.ndarray, fine: Grid, coarse: Grid) -> np.ndarray:
    """The values at the nodes that both grids have."""
    # no interpolation: it would add an error of its own, of the order that is to be measured
    return value[strides(fine, coarse)]


def distance(value: Nodes, exact: Nodes) -> np.ndarray:
    """|V − W|; two equal infinities are no distance apart."""
    # ∞ − ∞ is NaN and warns, though `where` does not take it
    with np.errstate(invalid="ignore"):
        return np.where(value == exact, 0.0, np.abs(value - exact))


def richardson(values: list[np.ndarray], h: np.ndarray, mask: np.ndarray, tol: float) -> tuple[np.ndarray | None, str]:
    """The extrapolated value from three grids, or ``None`` where they show no order, and its name in the table."""
    (coarse, middle, fine), h = values, h / h[0]  # spacings over the coarsest: powers of order 16 stay in range
    wide, narrow = (float(np.mean(distance(a, b)[mask])) for a, b in ((coarse, middle), (middle, fine)))

    def excess(order: float) -> float:
        """The first line of the module's, left side less right side, times h₂^p − h₃^p: its zero is the order."""
        return (h[0] ** order - h[1] ** order) - wide / narrow * (h[1] ** order - h[2] ** order)

    if not (math.isfinite(wide) and narrow > tol and excess(FLATTEST) < 0 < excess(STEEPEST)):
        # a change below the tolerance is the iteration's; without a change of sign no order explains the two changes
        return None, (
            "nothing: no Richardson estimate, since from grid to grid the mean "
            f"changes by {wide:.3g} and {narrow:.3g}, which shows no order"
        )
    # here: only a study without a reference needs it
    from scipy.optimize import brentq

    order = brentq(excess, FLATTEST, STEEPEST)
    with np.errstate(invalid="ignore"):  # nodes that are infinite on all grids stay so
        step = np.where(fine == middle, 0.0, fine - middle)
    # the second line of the module's; h is over the coarsest spacing, which cancels in the quotient
    extrapolated = fine + step * h[2] ** order / (h[1] ** order - h[2] ** order)
    return extrapolated, f"Richardson's estimate from the three finest grids, which show order {order:.2f}"
