"""An estimate of the discretisation error from the values on two grids.

    |V − V_h| ≈ |V_h − V_rh|/(r^q − 1)

where r is the ratio of the spacings and c h^q the leading term of the error. The order q is measured at every node,
since it is 2 where V is smooth, 1 next to kinks and corners, and lower where V is not Lipschitz continuous. It is the
lower of two observed orders:

- The second-order scheme changes the value of the monotone chain by the whole first-order error of the chain. If the
  change between the grids is much smaller than this change, q is 2. If the two changes are similar, q is 1.
- Second differences of V fall like h² where V is smooth, like h at a kink, and not at all at a jump or in a layer that
  is thinner than a cell.

A march has no separate value of the chain. Its time steps grow with the spacings, so the change between grids includes
the time discretisation error. Only second differences are used, and an advected kink is smeared; see ``SMEARED``.

First differences fall like h where V is Lipschitz continuous, and not at all where V jumps. Near a jump the scheme
smears V over a few cells and the error is up to the height of the jump. Comparing grids does not measure this, so the
estimate there is at least the range of V over two coarse cells. A march smears jumps over more and more cells, and
first differences fall like the square root of h.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.solvers import nested_grids

LEAST, FIRST, SECOND = 0.5, 1.0, 2.0  # orders
# ratio of the change between grids to the change between schemes at which the order is 2 or 1, or the schemes coincide.
# An order of 1/2 for ratios from 2 on made half of the estimates two to seven times the error.
SMOOTH, ALIKE, ONE = 0.05, 0.5, 10.0
REACH = 2  # fine nodes on both sides of a coarse node
# Orders of second differences, and of the error, if there is no value of the chain. An advected kink is smeared over a
# width h^a, a = 1/2 or 2/3. Second differences fall like h^(2 − a) there, and the error like h^a. V counts as smooth
# from STRAIGHT on; below, the change between grids may vanish at single nodes.
STRAIGHT = 1.9
SMEARED = (0.5, 1.0, 1.5, 1.75, STRAIGHT), (0.5, 1.0, 0.6, 0.67, 2.0)
BENT = 0.1  # second differences below this fraction of the first differences do not determine the order
# differences fall like h^a: a jump if a is below the first, none if a is above the second; √distance has a = 1/2
JUMPS = 0.3, 0.6
# In a march a scheme of order p smears a jump over a width h^(p/(p+1)), and differences there fall like h^(1/(p+1)). A
# third of the range of V for p = 1 made the estimate a sixth of the error.
SMEARED_JUMPS = 0.5, 0.8


@dataclasses.dataclass(frozen=True)
class TwoGrids:
    """The values on two grids of one box.

    Args:
      grid: the finer grid.
      coarse: the coarser grid.
      value: V_h, (*grid); infinite where the target cannot be reached.
      before: V_rh, (*coarse).
      held: the fixed nodes, bool (*grid).
      chain: the value of the monotone chain on ``grid``, if V_h belongs to another scheme; else None.
      highest: the order of the scheme where V is smooth.
      jumps: the exponents between which differences show a jump: ``JUMPS``, or ``SMEARED_JUMPS`` for a march.
    """

    grid: Grid
    coarse: Grid
    value: np.ndarray
    before: np.ndarray
    held: np.ndarray
    chain: np.ndarray | None = None
    highest: float = SECOND
    jumps: tuple[float, float] = JUMPS


def estimate_error(answers: TwoGrids) -> np.ndarray:
    """Estimate |V − V_h| at the nodes, shape (*grid), in cost units and the type of V_h; zero where V is infinite."""
    near = estimate_on_coarse(answers).astype(answers.value.dtype)
    error = nested_grids.prolong(near, answers.coarse, answers.grid)
    error[~np.isfinite(answers.value)] = 0
    return error


def estimate_on_coarse(answers: TwoGrids) -> np.ndarray:
    """Estimate |V − V_h| near the nodes of the coarser grid, shape (*coarse), in cost units."""
    grid, coarse, value = answers.grid, answers.coarse, answers.value
    change = nested_grids.apart(nested_grids.restrict(value, grid, coarse), answers.before)
    ratio = nested_grids.ratio_of(grid, coarse)
    free = np.isfinite(value) & ~answers.held
    fine = _along_axes(np.where(free, value, np.nan), grid, coarse)
    known = nested_grids.at_nearest_nodes(free, grid, coarse) & np.isfinite(answers.before)
    rough = _around(np.where(known, answers.before, np.nan), coarse)
    bends = _order_of_bends(fine, rough, ratio)
    if answers.chain is None:
        for _ in range(REACH):  # the width of a smeared kink
            near = combined(bends, coarse, np.minimum)
            change = np.where(near < STRAIGHT, combined(change, coarse, np.maximum), change)
        order = np.interp(bends, *SMEARED)
    else:
        gain = nested_grids.apart(
            nested_grids.at_nearest_nodes(value, grid, coarse),
            nested_grids.at_nearest_nodes(answers.chain, grid, coarse),
        )
        order = np.minimum(bends, _order_of_slopes(change, gain, coarse))
    order = np.minimum(order, answers.highest)
    return np.maximum(change / (ratio**order - 1), _jumps(fine, rough, ratio, answers.jumps))


def is_a_point(target: np.ndarray) -> bool:
    """True if a target, bool (*grid), has at most the nodes of one cell; always False in one dimension."""
    return target.ndim > 1 and 0 < np.sum(target) <= 2**target.ndim


class _Differences(NamedTuple):
    """The largest first and second differences near every coarse node, and the range of V there; zero if undefined."""

    first: np.ndarray
    second: np.ndarray
    extent: np.ndarray


def _along_axes(value: np.ndarray, fine: Grid, coarse: Grid) -> _Differences:
    """Differences of values on the finer grid over ``REACH`` nodes along every axis; NaN values are skipped."""
    first = second = extent = np.zeros(coarse.shape, value.dtype)
    for axis, count in enumerate(fine.shape):
        if count == 2 or axis not in fine.state_axes:  # a chain of two states
            continue
        line = value
        for other in range(fine.ndim):
            line = line if other == axis else np.take(line, nested_grids.places(fine, coarse, other), axis=other)
        wide, places = _padded(line, fine, axis, np.nan, REACH), nested_grids.places(fine, coarse, axis)
        here, before = np.take(wide, places, axis=axis), None
        least = most = here
        for k in range(1, 2 * REACH + 1):  # one node after the other: few arrays at a time
            beyond = np.take(wide, places + k, axis=axis)
            step = beyond - here
            first = np.fmax(first, np.abs(step))
            if before is not None:
                second = np.fmax(second, np.abs(step - before))
            least, most = np.fmin(least, beyond), np.fmax(most, beyond)
            here, before = beyond, step
        extent = np.fmax(extent, most - least)
    return _Differences(first, second, extent)


def _around(value: np.ndarray, grid: Grid) -> _Differences:
    """Differences of values on the coarser grid over every node and its neighbours; NaN values are skipped."""
    first = second = np.zeros(grid.shape)
    for axis, count in enumerate(grid.shape):
        if count == 2 or axis not in grid.state_axes:
            continue
        steps = np.diff(_padded(value, grid, axis, np.nan), axis=axis)
        below, above = (_part(steps, axis, k, count) for k in (0, 1))
        first = np.fmax(first, np.fmax(np.abs(below), np.abs(above)))
        second = np.fmax(second, np.abs(above - below))
    return _Differences(combined(first, grid, np.maximum), combined(second, grid, np.maximum), np.zeros(grid.shape))


def _order_of_slopes(change: np.ndarray, gain: np.ndarray, coarse: Grid) -> np.ndarray:
    """The order from the ratio of ``change`` to ``gain``, averaged over neighbours, (*coarse)."""
    change, gain = combined(change, coarse, np.add), combined(gain, coarse, np.add)
    share = np.divide(change, gain, out=np.zeros_like(change), where=gain > 0)
    order = np.interp(np.log(np.maximum(share, SMOOTH)), np.log([SMOOTH, ALIKE]), [SECOND, FIRST])
    return np.where(share > ONE, SECOND, order)  # the schemes coincide, e.g. where noise permits central ones


def _order_of_bends(fine: _Differences, rough: _Differences, ratio: float) -> np.ndarray:
    """The order at which second differences fall, (*coarse)."""
    counts = (fine.second > BENT * fine.first) & (rough.second > 0)
    return np.clip(np.where(counts, _exponent(fine.second, rough.second, ratio), SECOND), LEAST, SECOND)


def _jumps(fine: _Differences, rough: _Differences, ratio: float, limits: tuple[float, float]) -> np.ndarray:
    """The range of V over neighbouring cells where first differences indicate a jump, (*coarse)."""
    falls = _exponent(fine.first, rough.first, ratio)
    jump, continuous = limits
    return np.clip((continuous - falls) / (continuous - jump), 0, 1) * fine.extent


def _exponent(fine: np.ndarray, rough: np.ndarray, ratio: float) -> np.ndarray:
    """The exponent a in fine = rough/ratio^a; one where either is zero."""
    counts = (fine > 0) & (rough > 0)
    quotient = np.divide(rough, fine, out=np.full(fine.shape, ratio), where=counts)
    return np.log(quotient) / np.log(ratio)


def _padded(values: np.ndarray, grid: Grid, axis: int, beyond: float | None, reach: int = 1) -> np.ndarray:
    """Pad the values at both ends of an axis: periodically, with the number ``beyond``, or with the end value."""
    width = [(reach * (i == axis),) * 2 for i in range(grid.ndim)]
    if grid.periodic[axis]:
        return np.pad(values, width, mode="wrap")
    return np.pad(values, width, mode="edge") if beyond is None else np.pad(values, width, constant_values=beyond)


def combined(values: np.ndarray, grid: Grid, combine: Callable[[Any, Any], Any]) -> np.ndarray:
    """Combine the values of every node and its neighbours."""
    for axis in grid.state_axes:
        wide = _padded(values, grid, axis, None)
        below, here, above = (_part(wide, axis, k, grid.shape[axis]) for k in range(3))
        values = combine(combine(below, here), above)
    return values


def _part(values: np.ndarray, axis: int, start: int, count: int) -> np.ndarray:
    """Take ``count`` entries along an axis, from ``start`` on."""
    return values[(slice(None),) * axis + (slice(start, start + count),)]
