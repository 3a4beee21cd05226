"""Collocation of a boundary-value problem by SciPy in scaled units, with exact derivatives of its equations.

SciPy's tolerances are absolute: a length of 1e-9 is below every tolerance, and a length of 1e9 cannot meet any. Sizes
near one keep their unit. Other sizes are measured along the guess and rounded to powers of two, which are exact.

A cost such as θ² on [−π, π) is continuous at the seam of the axis, and so are the costate and H, but ṗ jumps. A
collocation across the seam would refine its mesh there indefinitely. The remedy is one arc per turn, in the coordinates
of the box, with unknown crossing times and the condition x_i = end of the axis. Every arc is then smooth.
"""

import dataclasses
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing, Limits, conditions, rates
from hjbjax.hamiltonian import pointwise
from hjbjax.problem.sets import samples
from hjbjax.problem.types import Array
from hjbjax.solution.clock import Stopped

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

FEWEST = 64  # width to which meshes are padded; wider meshes double it, so that few shapes are compiled
ORDINARY = 1e3  # sizes between 1/ORDINARY and ORDINARY are not scaled
ROUNDING = 1e-12  # relative motion of a state that counts as rest
BUDGET = 16  # number of controls that show the size of motion and cost if the guess does not move
FINE = 4001  # number of samples in which a guess is searched for crossings
NODES = 33  # initial number of mesh nodes per arc

# Exact derivatives, because SciPy's finite differences take k·(2n+1) evaluations and have half of the digits. The
# functions are vmapped over the nodes of the mesh, the last axis of y.
_rates = jax.jit(jax.vmap(rates, (None, 0, 1, None), 1))
_slopes = jax.jit(jax.vmap(jax.jacfwd(rates, (2, 3)), (None, 0, 1, None), 2))
_conditions = jax.jit(conditions)
_condition_slopes = jax.jit(jax.jacfwd(conditions, (1, 2, 3)))


def on_mesh(
    bvp: BoundaryValueProblem, s: np.ndarray, y: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """dy/ds at every node, shape (k·(2n+1), len(s)), and its derivatives by y and by theta, with the nodes last."""
    padded = (bvp, *pad_mesh(s, y), theta)
    value, (by_state, by_theta) = np.asarray(_rates(*padded)), map(np.asarray, _slopes(*padded))
    return value[..., : len(s)], by_state[..., : len(s)], by_theta[..., : len(s)]


def slopes_at_ends(
    bvp: BoundaryValueProblem, y: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of the conditions by the first column, the last column and theta."""
    by_first, by_last, by_theta = map(np.asarray, _condition_slopes(bvp, y[:, 0], y[:, -1], theta))
    return by_first, by_last, by_theta


def pad_mesh(s: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh and its columns, padded by repeating the last column to the next compiled width."""
    # repeated instead of zero, because drift and cost may be undefined at the origin
    width = FEWEST
    while width < len(s):
        width *= 2
    more = width - len(s)
    return np.append(s, np.full(more, s[-1])), np.concatenate([y, np.repeat(y[:, -1:], more, 1)], 1)


def collocate(bvp: BoundaryValueProblem, s: Array, y: Array, theta: Array, limits: Limits) -> "OptimizeResult":
    """SciPy's result from an initial guess, with the ``units`` of its rows; requires float64 mode.

    Every evaluation checks the clock. ``Stopped`` carries the last iterate (s, y, theta).

    Args:
      bvp: the boundary-value problem.
      s: the initial mesh on [0, 1].
      y: the initial guess on it, shape (k·(2n+1), len(s)).
      theta: the initial guess of the unknown parameters.
      limits: the limits of the solve.
    """
    from scipy.integrate import solve_bvp

    arrays = jax.tree.map(jnp.asarray, bvp)  # once, because NumPy leaves are copied to the device in every call
    nothing = np.zeros(0)
    last = (np.asarray(s), np.asarray(y), np.asarray(theta))
    with np.errstate(all="ignore"):  # drift and cost may be undefined along the guess
        mesh, guess, sought = last
        slopes = np.asarray(_rates(arrays, *pad_mesh(mesh, guess), sought))[:, : len(mesh)]
        missed = np.asarray(_conditions(arrays, guess[:, 0], guess[:, -1], sought))
        unit, rows = units_of(bvp, guess, slopes, missed, sought)
    column = unit[:, None]

    def function(s: np.ndarray, y: np.ndarray, theta: np.ndarray = nothing) -> np.ndarray:
        nonlocal last
        y = y * column
        if s[0] == 0 and s[-1] == 1:  # the mesh itself, not the points between its nodes
            last = (np.array(s), np.array(y), np.array(theta))
        limits.clock.look()
        return np.asarray(_rates(arrays, *pad_mesh(s, y), theta))[:, : len(s)] / column

    def function_slopes(
        s: np.ndarray, y: np.ndarray, theta: np.ndarray = nothing
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        limits.clock.look()
        # copies, because SciPy modifies the derivatives in place, and JAX arrays are read-only
        by_state, by_theta = _slopes(arrays, *pad_mesh(s, y * column), theta)
        by_state = np.array(by_state)[..., : len(s)] * (unit / column)[..., None]
        by_theta = np.array(by_theta)[..., : len(s)] / column[..., None]
        return (by_state, by_theta) if len(theta) else by_state

    def ends(first: np.ndarray, last: np.ndarray, theta: np.ndarray = nothing) -> np.ndarray:
        return np.asarray(_conditions(arrays, first * unit, last * unit, theta)) / rows

    def end_slopes(first: np.ndarray, last: np.ndarray, theta: np.ndarray = nothing) -> tuple[np.ndarray, ...]:
        by_first, by_last, by_theta = _condition_slopes(arrays, first * unit, last * unit, theta)
        scaled = (np.asarray(by_first) * unit, np.asarray(by_last) * unit, np.asarray(by_theta))
        parts = tuple(part / rows[:, None] for part in scaled)
        return parts if len(theta) else parts[:2]

    try:
        with np.errstate(all="ignore"):  # attempt() checks the result for NaN and infinity
            result = solve_bvp(
                function, ends, s, y / column, p=theta if len(theta) else None, fun_jac=function_slopes,
                bc_jac=end_slopes, tol=limits.tol, max_nodes=limits.max_nodes,
            )  # fmt: skip
        result.y, result.units = result.y * column, column
        return result
    except Stopped as stop:
        raise Stopped(stop.status, last) from None


def units_of(
    bvp: BoundaryValueProblem, y: np.ndarray, slopes: np.ndarray, missed: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Units of the rows of y, shape (k·(2n+1),), and of the conditions.

    Args:
      bvp: the boundary-value problem.
      y: the guess.
      slopes: dy/ds of the guess.
      missed: the residuals of the conditions.
      theta: the guess of the durations and ν.
    """
    n, arrays = bvp.n, jax.tree.map(jnp.asarray, bvp)
    horizon = abs(float(np.sum(bvp.durations(theta))))
    seen = np.max(np.abs(np.stack([y, slopes])).reshape(2, bvp.count, 2 * n + 1, -1), axis=(0, 1, 3))
    given = [bvp.start, np.where(bvp.held, bvp.ends, 0)] + ([] if bvp.rest is None else [bvp.rest.state])
    lengths, cost = np.max(np.abs([seen[:n], *given]), axis=0), seen[-1]
    target, timed = bvp.closing is Closing.TARGET, bvp.free or bvp.count > 1
    # the residual of the end cost; the residuals of l, and of H or the time, come after it
    cost = max(cost, abs(missed[len(missed) - 1 - target - timed]))
    if min(np.min(lengths), cost) < 1 / ORDINARY:
        moved, spent = (horizon * np.asarray(part) for part in _reach(arrays))
        lengths = np.where(lengths > ROUNDING * moved, lengths, moved)
        cost = cost if cost > ROUNDING**2 * spent else spent  # squared, because costs are quadratic in the motion
    x, c, t = (_unit(part) for part in (lengths, cost, horizon))
    column = np.concatenate([x, c / x, c[None]])
    closing = np.where(bvp.held, x, c / x) if bvp.closing is Closing.STATE else c / x
    joints = [column] * (bvp.count - 1)
    joints += [x[list(bvp.seams)]] if bvp.places is not None else [np.full(bvp.count - 1, c / t)]
    ends = [closing, c[None]]
    if target:
        # l at the start, because a guess may end exactly on the boundary
        ends.append(_unit(abs(float(arrays.level(0.0, arrays.start))))[None])
    if timed:
        ends.append(np.asarray(c / t if bvp.free else t)[None])
    return np.tile(column, bvp.count), np.concatenate([x, *joints, *ends])


def _unit(size: np.ndarray | float) -> np.ndarray:
    """One for an ordinary or unknown size, otherwise the size rounded to a power of two."""
    ordinary = (np.asarray(size) >= 1 / ORDINARY) & (np.asarray(size) <= ORDINARY)
    known = np.isfinite(size) & (np.asarray(size) > 0) & ~ordinary
    return np.asarray(2.0 ** np.round(np.log2(np.where(known, size, 1.0))))


@jax.jit
def _reach(bvp: BoundaryValueProblem) -> tuple[Array, Array]:
    """The fastest motion of every state at the start, shape (n,), and the largest running cost, over some controls."""
    assert bvp.problem.controls is not None
    x = bvp.wrap(jnp.asarray(bvp.start))
    tried = jnp.asarray(samples(bvp.problem.controls, BUDGET), x.dtype)
    drift = jax.vmap(lambda u: jnp.asarray(bvp.problem.drift(*bvp.problem.arguments(x, u, t=0.0)), x.dtype))(tried)
    cost = jax.vmap(lambda u: pointwise.running_cost(bvp.problem, 0.0, x, u))(tried)
    return jnp.max(jnp.abs(drift), axis=0), jnp.max(jnp.abs(cost))


def split_at_seams(
    bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray
) -> tuple[BoundaryValueProblem, np.ndarray, np.ndarray, np.ndarray] | None:
    """Split the problem into arcs at the seams: problem, mesh, guess and durations; None if there is no crossing.

    Args:
      bvp: a problem with one arc, and a grid if it has periodic axes.
      times: increasing from 0.
      columns: the guess (x, p, w) at these times.
    """
    if bvp.grid is None:
        return None
    cyclic, fine = np.array(bvp.grid.periodic), np.linspace(0, times[-1], FINE)
    lo, period = np.asarray(bvp.grid.lo), np.asarray(bvp.grid.hi) - np.asarray(bvp.grid.lo)
    states = np.stack([np.interp(fine, times, row) for row in columns[: bvp.n]], axis=-1)
    # the number of periods by which each unwound state is outside the box, shape (FINE, n)
    turns = np.where(cyclic, np.floor((states - lo) / period), 0)
    at = 1 + np.flatnonzero(np.any(np.diff(turns, axis=0) != 0, axis=1))
    steps = turns[at] - turns[at - 1]
    # the order of crossings is unknown if a sample crosses two seams, or one seam twice
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
    # shift the states into the box; costates and cost to go are the same in every period
    for piece, shift in zip(pieces, shifts, strict=True):
        piece[: bvp.n] -= shift[:, None]
    rest = bvp.rest and dataclasses.replace(bvp.rest, state=bvp.rest.state - shifts[-1])
    apart = dataclasses.replace(
        bvp,
        grid=None,  # an iterate may overshoot the seam slightly, and the unwrapped drift is smooth there
        start=bvp.start - shifts[0],
        ends=bvp.ends - np.where(bvp.held, shifts[-1], 0),
        rest=rest,
        arcs=np.repeat(bvp.arcs, len(starts), 0),
        shifts=shifts,
        places=np.where(upward, lo[axes] + period[axes], lo[axes]),
        seams=tuple(int(axis) for axis in axes),
    )
    return apart, s, np.concatenate(pieces), lengths
