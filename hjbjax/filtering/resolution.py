"""Warnings for a grid or a time step that is too coarse for the law of the state.

A law is resolved along an axis if its width is at least ``NARROW`` cells. The width is measured locally, so that a law
with several narrow peaks counts as narrow: near a node, a normal law of standard deviation s has

    log p_{i+1} − 2 log p_i + log p_{i−1} = −h²/s².

The median over the mass is used, so that a sharp edge of a flat law does not count as narrow.

A step is short enough if the noise of the state does not undo the measurement within the step. In the steady state of
dx = σ dw, dy = h'x dt + r dv the variance is r σ/|h'|, and the noise renews it in the time r/(σ|h'|).
"""

import math

import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import is_traced, known
from hjbjax.problem.types import Array
from hjbjax.solution.status import warn

NARROW = 0.6  # standard deviations per cell: below this, sums over nodes miss more than 1e-3 of a normal law
LOOKS = 16  # number of laws checked along a record


def paces(on: Discretisation, signal: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """The rates of measurement and noise at the nodes; None if a number is traced.

    Noise that depends on the control is evaluated at zero control.

    Args:
      on: the chain.
      signal: r⁻¹ h, shape (p, *grid).

    Returns:
      |r⁻¹ h'σ|, per unit time, shape (*grid); the information |r⁻¹ ∂h/∂x_i|² per unit time and the variance a_ii per
      unit time, shape (n, *grid).
    """
    grid = on.grid
    m = 0 if on.problem.controls is None else on.problem.controls.dim
    noise = on.diffusion([jnp.zeros((), on.dtype)] * m)
    if is_traced(on, signal, noise):
        return None
    slopes = np.stack([np.gradient(signal, np.asarray(grid.axis(i)), axis=1 + i) for i in range(grid.ndim)], axis=-1)
    spread = np.zeros((*grid.shape, grid.ndim, grid.ndim))
    for (i, j), entry in noise.items():
        spread[..., i, j] = spread[..., j, i] = known(entry)
    slopes = np.moveaxis(slopes, 0, -2)  # (*grid, p, n)
    pace = np.linalg.eigvalsh(slopes @ spread @ np.swapaxes(slopes, -1, -2))[..., -1]
    information, variance = np.sum(slopes**2, axis=-2), np.diagonal(spread, axis1=-2, axis2=-1)
    return np.sqrt(np.maximum(pace, 0)), np.moveaxis(information, -1, 0), np.moveaxis(variance, -1, 0)


def warn_if_coarse(name: str, on: Discretisation, signal: Array, laws: np.ndarray, dt: float) -> None:
    """Warn if the law is narrower than a cell, or if the noise of the state undoes a measurement within a step.

    Args:
      name: the function the user called.
      on: the chain.
      signal: r⁻¹ h, shape (p, *grid).
      laws: the probabilities of the nodes at some times, the final time last, shape (k, *grid).
      dt: the time between two measurements.
    """
    rows = laws[np.unique(np.linspace(0, len(laws) - 1, LOOKS).astype(int))]
    found = paces(on, signal)
    if found is None or not np.all(np.isfinite(rows)):
        return
    pace, information, variance = found
    # a prior may be narrow and spread later: the median law and the last one decide
    forgetting = np.tensordot(rows, pace, on.grid.ndim)
    fastest = max(float(forgetting[-1]), float(np.median(forgetting)))
    enough = min(dt, 1 / fastest) if fastest else dt
    if fastest * dt > 1 + 1e-6:  # the dt that the warning recommends must not warn again
        longest = _rounded_down(1 / fastest)
        warn(
            f"{name}: dt = {dt:.3g} is longer than r/(σ|h'|) = {longest}, the time in which the noise of the state "
            "undoes a measurement, so the mean and covariance belong to a coarser model.\n"
            f"Use dt of at most {longest}.",
            UserWarning,
        )
    for axis in range(on.grid.ndim):
        widths = [local_width(row, on.grid, axis) for row in rows]
        width = min(widths[-1], float(np.median(widths)))
        if width >= NARROW:
            continue
        marginal = np.sum(rows[-1], axis=tuple(i for i in range(on.grid.ndim) if i != axis))
        gaps = np.diff(np.asarray(on.grid.axis(axis), np.float64))
        spacing = float(gaps[min(int(np.argmax(marginal)), len(gaps) - 1)])
        seen, renewed = (float(np.sum(rows[-1] * each[axis])) * enough for each in (information, variance))
        # the variance after a measurement in the steady state, if there is noise on this axis
        steady = 0.0
        if seen * renewed > 0:
            steady = math.sqrt((math.sqrt(renewed**2 + 4 * renewed / seen) - renewed) / 2)
        wanted = steady if 0 < steady < spacing else max(width, 0.01) * spacing
        warn(
            f"{name}: the law is narrower than a cell of axis {axis}, whose spacing is {spacing:.3g}, so mean and "
            "covariance are determined by single nodes.\n"
            f"Use a spacing of at most {_rounded_down(wanted)} there, or a larger measurement_noise.",
            UserWarning,
        )


def local_width(probability: np.ndarray, grid: Grid, axis: int) -> float:
    """The median over the mass of the local standard deviation along an axis, in cells; infinite for a flat law.

    The end nodes of the box do not count, because the law is cut off there.
    """
    height = np.log(np.maximum(probability, np.finfo(np.float64).tiny))
    bend = 2 * height - np.roll(height, 1, axis) - np.roll(height, -1, axis)
    weights = probability.copy()
    if not grid.periodic[axis]:
        np.moveaxis(weights, axis, 0)[[0, -1]] = 0
    if not np.sum(weights) > 0.5:  # most of the mass is at an end
        return np.inf
    order = np.argsort(bend, axis=None)
    share = np.cumsum(weights.ravel()[order])
    median = bend.ravel()[order[np.searchsorted(share, share[-1] / 2)]]
    return float(median**-0.5) if median > 0 else np.inf


def _rounded_down(number: float) -> str:
    """A positive number rounded down to two digits."""
    unit = 10.0 ** (math.floor(math.log10(number)) - 1)
    return f"{math.floor(number / unit * (1 + 1e-9)) * unit:.2g}"
