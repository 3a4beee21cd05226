"""The reference for the errors of a study: a function, a finer solution, or Richardson extrapolation.

From V_h = V + c h^p + o(h^p) on three grids,

    (h₁^p − h₂^p)/(h₂^p − h₃^p) = |V₁ − V₂|/|V₂ − V₃|   (means over the nodes),
    V ≈ V₃ + (V₃ − V₂) h₃^p/(h₂^p − h₃^p)

which is an estimate and is labelled as such.
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

FLATTEST, STEEPEST = 1e-3, 16.0  # range of orders for Richardson extrapolation; the highest order of a scheme is 5


def mean_spacing(grid: Grid) -> float:
    """The geometric mean of the mean spacings of the axes; ratios of two of them do not depend on the units."""
    spacings = mean_spacings(grid)
    return float(np.prod(spacings) ** (1 / len(spacings)))  # n-th root of the cell's volume


def mean_spacings(grid: Grid) -> np.ndarray:
    """The mean spacing along every axis of the state, shape (n,); modes have none."""
    # the mean for a stretched axis; refinement shrinks all of its spacings by about the same factor
    axes = list(grid.state_axes)
    counts = np.array([grid.intervals(axis) for axis in axes])
    return (np.asarray(grid.hi)[axes] - np.asarray(grid.lo)[axes]) / counts


def check_same_box(what: str, first: Grid, second: Grid) -> None:
    """Raise if two grids have different boxes."""
    # with the same corners, a periodic axis still makes a different box
    alike = first.periodic == second.periodic
    if not (alike and np.array_equal(first.lo, second.lo) and np.array_equal(first.hi, second.hi)):
        boxes = [f"{grid.lo} to {grid.hi}, periodic {grid.periodic}" for grid in (first, second)]
        raise ValueError(f"convergence_study: got {what}: {boxes[0]} and {boxes[1]}; wanted the same box")


def check_reference(reference: object, grids: tuple[Grid, ...]) -> None:
    """Raise before anything is solved if no error can be measured against the reference."""
    if reference is None:
        if len(grids) < 3:
            raise ValueError(
                f"convergence_study: got {len(grids)} grids and no reference; Richardson's estimate needs three"
            )
        for grid in grids[1:]:
            strides(grid, grids[0])  # raises if the grids are not nested
    elif isinstance(reference, Solution):
        # the value of a marched solution has a leading time axis
        if reference.times is not None or np.shape(reference.value) != reference.grid.shape:
            raise ValueError(
                f"convergence_study: the reference has values of shape {np.shape(reference.value)} on a grid of shape "
                f"{reference.grid.shape}; wanted one stationary solution"
            )
        if reference.status is not Status.CONVERGED:
            raise ValueError(
                f"convergence_study: the reference is {reference.status.name}; wanted a converged solution"
            )
        check_same_box("a reference of another box", grids[0], reference.grid)
        # the reference must be finer along every axis, so that its own error is smaller
        if not np.all(mean_spacings(reference.grid) < mean_spacings(grids[-1])):
            raise ValueError(
                f"convergence_study: the reference is on {reference.grid.shape} nodes and the finest grid has "
                f"{grids[-1].shape}; wanted a finer reference"
            )
    elif not callable(reference):
        raise TypeError(
            f"convergence_study: got reference = {reference!r}; wanted a function of one state or a Solution"
        )


def words_for(reference: object, grids: tuple[Grid, ...]) -> str:
    """A short description of the reference, for the head of the table."""
    if not isinstance(reference, Solution):
        return "the function given"
    shape = " x ".join(map(str, reference.grid.shape))
    between = "" if all(is_nested(reference.grid, grid) for grid in grids) else ", linear between its nodes"
    return f"the solution on {shape} nodes{between}"


def at_nodes_of(reference: Solution | Callable, grid: Grid, mask: Mask) -> np.ndarray:
    """The reference at the nodes of a grid."""
    if isinstance(reference, Solution):
        # clamped, because rounding may put a node of the boundary outside the other grid
        values = np.asarray(reference.value_at(grid.nodes(), clamp=True))
    else:
        values = _evaluate(reference, grid, "the reference")
    # only NaN inside the region is a fault; an infinite reference is a value like any other
    missing = np.isnan(values) & mask
    if missing.any():
        index = tuple(int(i) for i in np.argwhere(missing)[0])
        raise ValueError(
            f"convergence_study: the reference is NaN at {int(missing.sum())} nodes, first at x = {grid.state(index)}; "
            "exclude them with region="
        )
    return values


def _evaluate(function: Callable, grid: Grid, what: str, name: str = "convergence_study") -> np.ndarray:
    """Evaluate a function of one state at all nodes in float64; ``name`` is the caller in error messages."""
    with own_settings(x64=True):  # the accuracy of the reference must not limit the errors
        # check the shape before compiling
        got = jax.eval_shape(function, jax.ShapeDtypeStruct((grid.ndim,), np.float64))
        if getattr(got, "shape", None) != ():
            shape = getattr(got, "shape", got)
            raise ValueError(f"{name}: {what} returned shape {shape} for one state; wanted a scalar, ()")
        states = grid.nodes().reshape(-1, grid.ndim)
        return np.asarray(jax.jit(jax.vmap(function))(states)).reshape(grid.shape)


def mask_of(region: Callable | float | None, grid: Grid, name: str = "convergence_study") -> np.ndarray:
    """The nodes that count, bool (*grid); ``name`` is the caller in error messages."""
    if region is None:
        return np.ones(grid.shape, bool)
    if callable(region):
        inside = _evaluate(region, grid, "the region", name).astype(bool)
    elif isinstance(region, (int, float)) and not isinstance(region, bool):
        # bool is excluded, because True would mean the whole box
        if not 0 < region <= 1:
            raise ValueError(f"{name}: got region = {region!r}; wanted a share of the box in (0, 1]")
        inside = grid.inner(region)
    else:
        raise TypeError(f"{name}: got region = {region!r}; wanted a function of one state, or a share")
    if not inside.any():
        raise ValueError(f"{name}: no node of the grid {grid.shape} lies in the region; enlarge it")
    return inside


def is_nested(fine: Grid, coarse: Grid) -> bool:
    """True if every node of the coarse grid is a node of the fine grid; both have the same box."""
    # intervals instead of nodes, so that the rule also holds for periodic axes, which have as many intervals as nodes
    multiple = all(fine.intervals(axis) % coarse.intervals(axis) == 0 for axis in range(coarse.ndim))
    return multiple and repr(fine.stretch) == repr(coarse.stretch)


def strides(fine: Grid, coarse: Grid) -> tuple[slice, ...]:
    """The slices of the fine grid that select the nodes of the coarse grid."""
    if not is_nested(fine, coarse):
        raise ValueError(
            f"convergence_study: without a reference the nodes of {coarse.shape} must be nodes of {fine.shape}; wanted "
            "intervals that are multiples of the coarsest grid's, as with 41, 81 and 161 nodes"
        )
    return tuple(slice(None, None, fine.intervals(axis) // coarse.intervals(axis)) for axis in range(fine.ndim))


def at_shared_nodes(value: np.ndarray, fine: Grid, coarse: Grid) -> np.ndarray:
    """The values at the nodes that both grids share."""
    # no interpolation: its error has the same order as the error to be measured
    return value[strides(fine, coarse)]


def absolute_difference(value: Nodes, exact: Nodes) -> np.ndarray:
    """|V − W|, which is 0 for two equal infinities."""
    # ∞ − ∞ warns even in the branch that `where` discards
    with np.errstate(invalid="ignore"):
        return np.where(value == exact, 0.0, np.abs(value - exact))


def richardson(values: list[np.ndarray], h: np.ndarray, mask: np.ndarray, tol: float) -> tuple[np.ndarray | None, str]:
    """The value extrapolated from three grids, or ``None`` if they show no order, and a description for the table."""
    (coarse, middle, fine), h = values, h / h[0]  # relative spacings, so that powers of order 16 do not overflow
    wide, narrow = (float(np.mean(absolute_difference(a, b)[mask])) for a, b in ((coarse, middle), (middle, fine)))

    def excess(order: float) -> float:
        """The first equation of the module docstring, left minus right, times h₂^p − h₃^p; its zero is the order."""
        return (h[0] ** order - h[1] ** order) - wide / narrow * (h[1] ** order - h[2] ** order)

    if not (math.isfinite(wide) and narrow > tol and excess(FLATTEST) < 0 < excess(STEEPEST)):
        # a change below the tolerance comes from the iteration; without a change of sign no order fits the two changes
        return None, (
            "nothing: no Richardson estimate, since from grid to grid the mean "
            f"changes by {wide:.3g} and {narrow:.3g}, which shows no order"
        )
    # imported here, because it is only needed if there is no reference
    from scipy.optimize import brentq

    order = brentq(excess, FLATTEST, STEEPEST)
    with np.errstate(invalid="ignore"):  # nodes that are infinite on both grids remain infinite
        step = np.where(fine == middle, 0.0, fine - middle)
    # the second equation of the module docstring; the common factor of h cancels
    extrapolated = fine + step * h[2] ** order / (h[1] ** order - h[2] ** order)
    return extrapolated, f"Richardson's estimate from the three finest grids, which show order {order:.2f}"
