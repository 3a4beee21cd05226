"""The condition on the grid spacings for correlated noise.

The diagonal jumps of the chain take Σ_j |a_ij| h_i/h_j from a_ii, and the remainder must be non-negative:

    a_ii/h_i ≥ Σ_{j≠i} |a_ij|/h_j        (a = σσᵀ, scaled diagonal dominance)

Let M_ij = |a_ij|/a_ii. The densities ρ = 1/h must satisfy ρ ≥ Mρ. Such densities exist if and only if the spectral
radius of M is at most one. If it is less, ρ = (I − M)⁻¹ s for some s > 0; if it is one, ρ is the Perron vector of M,
block by block. In 2-D they always exist for a single matrix a: h₁/h₂ = √(a₁₁/a₂₂). For several matrices, as for
state-dependent noise, ρ ≥ Mρ with the largest entries of all M is sufficient, and in 2-D also necessary.
"""

import dataclasses
import functools
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.problem.grid import Grid
from hjbjax.problem.settings import own_settings

Actions: TypeAlias = tuple[np.ndarray, np.ndarray]

TRIES = 5  # shapes to try, each based on the matrices at the nodes of the one before
ROUNDING = 1e-12  # relative difference of densities that should be equal
CONSTANT = 1e-6  # relative differences below which noise counts as constant


def dominance(a: ArrayLike) -> np.ndarray:
    """M_ij = |a_ij|/a_ii, i ≠ j, of diffusion matrices, shape (..., n, n)."""
    sizes = np.abs(np.asarray(a, dtype=float))
    diagonal = np.diagonal(sizes, axis1=-2, axis2=-1)[..., None]
    # an axis without noise has a zero row in a positive semidefinite matrix and accepts any density
    return np.where(np.eye(sizes.shape[-1], dtype=bool), 0, sizes / np.where(diagonal > 0, diagonal, 1))


def spacings(m: np.ndarray, now: ArrayLike, scale: np.ndarray) -> np.ndarray | None:
    """Spacings h close to the given ones with ρ ≥ Mρ, ρ = 1/h; None if there are none.

    Args:
      m: M, shape (n, n).
      now: the present spacings, shape (n,); each block keeps their geometric mean.
      scale: the size of the noise along each axis, > 0, shape (n,); determines the slack of each axis.

    Returns:
      Spacings, shape (n,), or None.

    Example:
      >>> a = np.array([[1.0, 2.0], [2.0, 4.0]])
      >>> spacings(dominance(a), [0.5, 0.5], np.sqrt(np.diag(a))).round(6).tolist()
      [0.353553, 0.707107]
    """
    result = np.array(now, dtype=float)
    # (I + |M|)ⁿ > 0 between axes connected by a path of correlations: the blocks of M
    linked = np.linalg.matrix_power(np.eye(len(m)) + (m > 0) + (m.T > 0), len(m)) > 0
    for block in {tuple(np.flatnonzero(row)) for row in linked}:
        if len(block) == 1:
            continue
        axes = np.array(block)
        inner = m[np.ix_(axes, axes)]
        values, vectors = np.linalg.eig(inner)
        largest = int(np.argmax(values.real))  # M is non-negative: the Perron root, which is real
        if values[largest].real > 1 + 1e-12:
            return None
        if values[largest].real < 1 - 1e-9:  # (I − M) ρ = s leaves slack on every axis
            density = np.linalg.solve(np.eye(len(axes)) - inner, 1 / scale[axes])
        else:
            vector = np.abs(vectors[:, largest].real)
            density = np.maximum(vector, 1e-9 * np.max(vector))
        # the inequality is scale-invariant: keep the geometric mean of the spacings, so also the number of nodes
        result[axes] = np.exp(np.mean(np.log(result[axes] * density))) / density
    return result


def shape(m: np.ndarray, grid: Grid, wanted: np.ndarray) -> tuple[int, ...] | None:
    """A grid shape close to the present one with ρ ≥ Mρ on the same box; None if there is none.

    Args:
      m: M, shape (n, n).
      grid: the grid.
      wanted: spacings that satisfy the condition, shape (n,).
    """
    lengths = np.asarray(grid.hi) - np.asarray(grid.lo)
    ends = 1 - np.array(grid.periodic, dtype=int)
    # counts are integers, so few factors match well: try sizes from half to twice the present size, the closest first
    for factor in sorted(np.geomspace(0.5, 2.0, 2001), key=lambda factor: abs(np.log(factor))):
        intervals = np.maximum(np.round(lengths / wanted * factor), 1)
        density = intervals / lengths
        # 1e-15: two equal numbers, as for axes with correlation one, may differ in the last digit
        if np.all(density * (1 + 1e-15) >= m @ density) and np.all(intervals + ends >= 2):
            return tuple(int(count) for count in intervals + ends)
    return None


def advice(on: Discretisation, a: ArrayLike, actions: Actions) -> str:
    """Two sentences for a message: the condition on ``a``, and a remedy for all nodes; host level.

    Args:
      on: the problem on its grid, at the given time.
      a: the diffusion matrix where the condition fails, shape (n, n).
      actions: the pairs of control and disturbance to try, shapes (K, m) and (K, l).
    """
    a, grid = np.asarray(a, dtype=float), on.grid
    h = np.array([grid.spacing(axis) for axis in range(grid.ndim)], dtype=float)
    head = (
        "Every axis i needs a_ii/h_i ≥ Σ_j |a_ij|/h_j (a = σσᵀ); here diag a = "
        f"{_numbers(np.diag(a))}, h = {_numbers(h)}.\n"
    )
    on = dataclasses.replace(on, dtype=np.dtype(np.float64))
    with own_settings(x64=True):
        return head + _remedy(on, a, actions, h)


def _remedy(on: Discretisation, a: np.ndarray, actions: Actions, h: np.ndarray) -> str:
    """The shape, spacings or coordinates that represent the noise at all nodes."""
    scale = np.sqrt(np.where(np.diag(a) > 0, np.diag(a), 1.0))
    if spacings(dominance(a), h, scale) is None:
        return (
            "No spacings of these axes satisfy this: rotate the state's axes so that a becomes (nearly) diagonal, "
            "or weaken the correlation"
        )
    most, grid = np.maximum(dominance(a), _largest(on, actions)), on.grid
    for _ in range(TRIES):
        wanted = spacings(most, h, scale)
        if wanted is None:
            return "No spacings were found that satisfy this at all nodes. " + _coordinates(on, actions)
        fitting = shape(most, grid, wanted)
        if fitting is None:
            return (
                f"Choose lo, hi and shape so that the spacings have the ratios {_numbers(wanted / wanted[0])}, "
                f"which suffice at all nodes; with this box no shape near {grid.shape} has these ratios"
            )
        # the nodes of another grid have other states
        there = _largest(on.on_grid(dataclasses.replace(grid, shape=fitting)), actions)
        density = (np.array(fitting) - 1 + np.array(grid.periodic)) / (np.asarray(grid.hi) - np.asarray(grid.lo))
        if np.all(density * (1 + ROUNDING) >= there @ density):
            return f"Use Grid(..., shape={fitting}): the noise is representable at all of its nodes"
        most = np.maximum(most, there)
    return "No shape was found that suffices at all of its nodes. " + _coordinates(on, actions)


def _largest(on: Discretisation, actions: Actions) -> np.ndarray:
    """The largest entries of M over all nodes and actions, (n, n); a zero matrix if M is the same everywhere."""
    found = np.zeros((on.grid.ndim,) * 2)
    if not callable(on.problem.noise):
        return found
    for u, d in zip(*actions, strict=True):
        found = np.maximum(found, np.max(dominance(_matrices(on, u, d)), axis=0))
    return found


def _matrices(on: Discretisation, u: np.ndarray, d: np.ndarray) -> np.ndarray:
    """a at all nodes, with flat node index, (N, n, n)."""
    grid = on.grid
    found = np.zeros((grid.size, grid.ndim, grid.ndim))
    for (i, j), entry in on.diffusion(list(u), list(d)).items():
        found[:, i, j] = found[:, j, i] = np.broadcast_to(np.asarray(entry), grid.shape).reshape(-1)
    return found


def _coordinates(on: Discretisation, actions: Actions) -> str:
    """Advise coordinates y_i(x_i) in which the noise is constant, or give general advice if there are none.

    If g_i = √a_ii depends on x_i only and the correlations a_ij/(g_i g_j) are constant, dy_i = dx_i/g_i has constant
    noise.
    """
    otherwise = (
        "Rotate the state's axes so that a becomes (nearly) diagonal, take coordinates in which the noise is constant, "
        "or weaken the correlation"
    )
    found = [_matrices(on, u, d) for u, d in zip(*actions, strict=True)]
    a = found[0]
    sizes = np.sqrt(np.diagonal(a, axis1=1, axis2=2))
    if np.any(sizes <= 0) or any(not np.allclose(each, a, rtol=CONSTANT, atol=0) for each in found[1:]):
        return otherwise
    correlation = a / (sizes[:, :, None] * sizes[:, None, :])
    if np.max(np.ptp(correlation, axis=0)) > CONSTANT or spacings(dominance(correlation[0]), *_units(on.grid)) is None:
        return otherwise
    names = [_coordinate(on.grid, axis, sizes[:, axis]) for axis in range(on.grid.ndim)]
    if any(name is None for name in names):
        return otherwise
    return f"Take ({', '.join(map(str, names))}) as the state: there the noise is constant, and spacings exist"


def _units(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Unit spacings and unit scales."""
    return np.ones(grid.ndim), np.ones(grid.ndim)


def _coordinate(grid: Grid, axis: int, size: np.ndarray) -> str | None:
    """y(x) with dy = dx/g for an axis, as text, from g at all nodes, flat; None if g depends on other coordinates."""
    g = np.moveaxis(size.reshape(grid.shape), axis, 0).reshape(grid.shape[axis], -1)
    if np.max(np.ptp(g, axis=1)) > CONSTANT * np.max(g):
        return None
    x, name = np.asarray(grid.axis(axis), dtype=float), grid.names[axis]
    for power, words in ((0, name), (1, f"log {name}"), (0.5, f"√{name}")):
        ratio = g[:, 0] / np.abs(x) ** power if power == 0 or np.all(x > 0) else np.array([np.inf])
        if np.all(np.isfinite(ratio)) and np.ptp(ratio) <= CONSTANT * np.max(ratio):
            return words
    return f"∫ d{name}/√a_{axis}{axis}"


def _numbers(entries: ArrayLike) -> str:
    """Format numbers for a message, to six digits."""
    return "[" + ", ".join(f"{entry:.6g}" for entry in np.asarray(entries, dtype=float)) + "]"


def lacking(on: Discretisation, a: dict[tuple[int, int], jax.Array]) -> jax.Array | None:
    """The nodes at which the diagonal jumps take more noise than an axis has, bool; None without correlation."""
    if all(i == j for i, j in a):
        return None
    slack = 16 * on.grid.ndim * jnp.finfo(on.dtype).eps  # rounding in σσᵀ and in the spacings
    short = (stencil.noise_along(a, on.grid, i) < -slack * jnp.asarray(a[i, i], on.dtype) for i in on.grid.state_axes)
    return functools.reduce(jnp.logical_or, short)
