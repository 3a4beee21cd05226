"""How far a value is from the exact one: an estimate from the answers of two grids.

    |V − V_h| ≈ |V_h − V_2h|/(2^q − 1)

by the leading term c h^q of the error. Limited slopes have q = 2 where V is smooth and 1 at kinks, which two grids do
not tell apart: by an order between them the estimate is 1.4 times the error at the one and half of it at the other.
Where optimal paths run along a curve at which the policy jumps V is Hölder continuous and no better, as beside the
switching curve of a minimum time, and q = ½. What the slopes changed of the chain's answer tells that: elsewhere it is
the chain's whole error, of first order, and many times the change from grid to grid.
"""

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.solution import transfer

USUAL, BROKEN = 1.65, 0.5  # orders of limited slopes
OTHERS = 1.3  # where the coarser grid has other nodes, as at odd intervals, and one of them may meet a kink
# of the mean change between grids over that between schemes: slopes gain nothing, and where both schemes are one
LARGE, ALIKE = 0.5, 10.0
JUMP = 0.9  # of the range of a control, between neighbours


def apart(value: np.ndarray, other: np.ndarray) -> np.ndarray:
    """|value − other|, zero where that is not finite."""
    with np.errstate(invalid="ignore"):
        change = np.abs(value - other)
    return np.where(np.isfinite(change), change, 0)


def estimate(grid: Grid, coarse: Grid, change: np.ndarray, order: float) -> np.ndarray:
    """|V − V_h| at the nodes, about, shape (*grid), in cost units.

    Args:
      grid: the grid.
      coarse: the grid with half of the intervals.
      change: |V_h − V_2h| at the nodes of ``coarse``.
      order: q.
    """
    return transfer.prolong(change / (2**order - 1), coarse, grid)


def order_of_slopes(grid: Grid, coarse: Grid, change: np.ndarray, gain: np.ndarray, policy: np.ndarray | None) -> float:
    """q of limited slopes, by what they changed of the chain's answer.

    Args:
      grid: the grid.
      coarse: the grid with half of the intervals.
      change: |V_h − V_2h| at the nodes of ``coarse``, V by limited slopes.
      gain: |V_h − the answer of the chain| on ``grid``.
      policy: the controls on it, shape (*grid, m), NaN where there are none; None without controls.
    """
    moved, gained = np.mean(change), np.mean(gain)
    if LARGE * gained <= moved <= ALIKE * gained and moved > 0 and _jumps(policy):
        return BROKEN
    nested = all(grid.intervals(axis) % coarse.intervals(axis) == 0 for axis in range(grid.ndim))
    return USUAL if nested else OTHERS


def _jumps(policy: np.ndarray | None) -> bool:
    """True if a control jumps from end to end of its range across a surface: at half as many nodes as a layer has."""
    if policy is None:
        return False
    *shape, _ = policy.shape
    known = policy[np.all(np.isfinite(policy), axis=-1)]
    span = np.ptp(known, axis=0) if len(known) else np.zeros(policy.shape[-1])
    steps = (np.abs(np.diff(policy, axis=axis)) > JUMP * span for axis in range(len(shape)))
    # a comparison with NaN is False, and so is one of a control that never changes
    return bool(sum(np.sum(np.any(step, axis=-1)) for step in steps) >= 0.5 * np.prod(shape) / max(shape))
