"""How far a value is from the exact one: an estimate from the answers of two grids.

    |V − V_h| ≈ |V_h − V_2h|/(2^q − 1)

by the leading term c h^q of the error. Limited slopes have q = 2 where V is smooth, less at kinks, and ½ where optimal
paths run along a curve at which the policy jumps: there V is Hölder continuous and no better, as beside the switching
curve of a minimum time. Two grids do not tell q; what the slopes changed of the chain's answer does. Where V is smooth
that is the chain's whole error, of first order, and many times the change from grid to grid.
"""

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.solution import transfer

SMOOTH, KINKED, BROKEN = 2.0, 1.6, 0.5  # orders; at kinks it is 1, and on coarse grids of smooth values above 2
SMALL = 0.25  # change between grids over that between schemes, below which the order is that of smooth values
LARGE, ALIKE = 0.5, 10.0  # in the mean, between which the slopes gain nothing; above the second both schemes are one
JUMP = 0.9  # of the range of a control, between neighbours


def estimate(
    grid: Grid, value: np.ndarray, coarse: Grid, before: np.ndarray, *, order: float | np.ndarray
) -> np.ndarray:
    """|V − V_h| at the nodes, about, shape (*grid), in cost units; zero beside values that are not finite.

    Args:
      grid: the grid.
      value: V_h at its nodes.
      coarse: the grid with half of the intervals.
      before: V_2h at its nodes.
      order: q, or one for every node of the coarser grid.
    """
    known = _apart(transfer.restrict(value, grid, coarse), before) / (2**order - 1)
    return np.asarray(transfer.prolong(known, coarse, grid))


def order_of_slopes(
    grid: Grid, value: np.ndarray, coarse: Grid, before: np.ndarray, *, chain: np.ndarray, policy: np.ndarray
) -> float | np.ndarray:
    """q of limited slopes, by what they changed of the chain's answer, at the nodes of the coarser grid or for all.

    Args:
      grid: the grid.
      value: V_h at its nodes, by limited slopes.
      coarse: the grid with half of the intervals.
      before: V_2h at its nodes, likewise.
      chain: the answer of the chain on ``grid``.
      policy: the controls there, shape (*grid, m), NaN where there are none.
    """
    change = _apart(transfer.restrict(value, grid, coarse), before)
    gain = _apart(transfer.restrict(value, grid, coarse), transfer.restrict(chain, grid, coarse))
    ratio = np.mean(change) / np.mean(gain) if gain.any() else np.inf
    if LARGE <= ratio <= ALIKE and _jumps(policy):
        return BROKEN
    return np.where(change <= SMALL * gain, SMOOTH, KINKED)


def _apart(value: np.ndarray, other: np.ndarray) -> np.ndarray:
    """|value − other|, zero where that is not finite."""
    with np.errstate(invalid="ignore"):
        change = np.abs(value - other)
    return np.where(np.isfinite(change), change, 0)


def _jumps(policy: np.ndarray) -> bool:
    """True if a control jumps from end to end of its range across a surface: at half as many nodes as a layer has."""
    *shape, inputs = policy.shape
    span = np.nanmax(policy.reshape(-1, inputs), axis=0) - np.nanmin(policy.reshape(-1, inputs), axis=0)
    steps = (np.abs(np.diff(policy, axis=axis)) > JUMP * span for axis in range(len(shape)))
    # a comparison with NaN is False, and so is one of a control that never changes
    return bool(sum(np.sum(np.any(step, axis=-1)) for step in steps) >= 0.5 * np.prod(shape) / max(shape))
