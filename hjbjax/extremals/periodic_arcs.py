"""Extremals that cross the seam of a periodic axis: one arc on every side of it.

A cost such as θ² on [−π, π) is continuous at the seam, and so are the costate and H, but ṗ jumps there; a collocation
across it crowds its mesh at that place and comes no further. With an arc for every turn, each in the coordinates of the
box, and the times of crossing sought (x_i = its end of the axis), everything is smooth on an arc again.
"""

import dataclasses

import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem

FINE = 4001  # samples in which a guess is looked through for crossings
NODES = 33  # of an arc's first mesh


def split(
    bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray
) -> tuple[BoundaryValueProblem, np.ndarray, np.ndarray, np.ndarray] | None:
    """The boundary-value problem in arcs, their mesh, the guess on it, and their durations; None without a crossing.

    Args:
      bvp: with one arc, and a grid where it has periodic axes.
      times: increasing from 0.
      columns: the guess (x, p, w) at these times.
    """
    if bvp.grid is None:
        return None
    cyclic, fine = np.array(bvp.grid.periodic), np.linspace(0, times[-1], FINE)
    lo, period = np.asarray(bvp.grid.lo), np.asarray(bvp.grid.hi) - np.asarray(bvp.grid.lo)
    states = np.stack([np.interp(fine, times, row) for row in columns[: bvp.n]], axis=-1)
    # the number of whole periods that each unwound state is away from the box, shape (FINE, n)
    turns = np.where(cyclic, np.floor((states - lo) / period), 0)
    at = 1 + np.flatnonzero(np.any(np.diff(turns, axis=0) != 0, axis=1))
    steps = turns[at] - turns[at - 1]
    # two seams within one sample, or a seam jumped over twice, have no order that the guess could tell
    if not len(at) or np.any(np.sum(np.abs(steps), axis=1) != 1):
        return None
    axes = np.argmax(np.abs(steps), axis=1)
    shifts = turns[np.append(0, at)] * period
    upward = steps[np.arange(len(at)), axes] > 0
    starts = np.append(0.0, fine[at])
    lengths, s = np.diff(np.append(starts, times[-1])), np.linspace(0, 1, NODES)
    pieces = [
        np.stack([np.interp(begin + s * length, times, row) for row in columns])
        for begin, length in zip(starts, lengths, strict=True)
    ]
    # into the box: costates and cost to go are the same in every period, states are shifted
    for piece, shift in zip(pieces, shifts, strict=True):
        piece[: bvp.n] -= shift[:, None]
    rest = bvp.rest and dataclasses.replace(bvp.rest, state=bvp.rest.state - shifts[-1])
    apart = dataclasses.replace(
        bvp,
        grid=None,  # an iterate may overshoot the seam a little: there the drift goes on smoothly, unwrapped
        start=bvp.start - shifts[0],
        ends=bvp.ends - np.where(bvp.held, shifts[-1], 0),
        rest=rest,
        arcs=np.repeat(bvp.arcs, len(starts), 0),
        shifts=shifts,
        places=np.where(upward, lo[axes] + period[axes], lo[axes]),
        seams=tuple(int(axis) for axis in axes),
    )
    return apart, s, np.concatenate(pieces), lengths
