"""Correlated noise and the spacings of a grid.

The diagonal jumps of the chain take Σ_j |a_ij| h_i/h_j from a_ii, and what is left must not be negative:

    a_ii/h_i ≥ Σ_{j≠i} |a_ij|/h_j        (a = σσᵀ, scaled diagonal dominance)

With M_ij = |a_ij|/a_ii the densities ρ = 1/h must satisfy ρ ≥ Mρ. They exist exactly where the spectral radius of M
is at most one: then ρ = (I − M)⁻¹ s for some s > 0, or at one the Perron vector of M, block by block. In 2-D they
always exist for one matrix a: h₁/h₂ = √(a₁₁/a₂₂). For several matrices, as at the nodes under state-dependent noise,
ρ ≥ Mρ with the largest entries of all M suffices, and in 2-D it is also necessary.
"""

import dataclasses
import functools
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.problem.grid import Grid
from hjbjax.problem.settings import own_settings
from hjbjax.tracing import checks

Actions: TypeAlias = tuple[np.ndarray, np.ndarray]

TRIES = 5  # shapes that are tried, each with what the nodes of the one before have shown
ROUNDING = 1e-12  # of densities that are to be equal
CONSTANT = 1e-6  # relative differences up to which noise counts as constant


def dominance(a: ArrayLike) -> np.ndarray:
    """M_ij = |a_ij|/a_ii, i ≠ j, of diffusion matrices, shape (..., n, n)."""
    sizes = np.abs(np.asarray(a, dtype=float))
    diagonal = np.diagonal(sizes, axis1=-2, axis2=-1)[..., None]
    # an axis without noise has a zero row in a positive semidefinite matrix: any density does for it
    return np.where(np.eye(sizes.shape[-1], dtype=bool), 0, sizes / np.where(diagonal > 0, diagonal, 1))


def spacings(m: np.ndarray, now: ArrayLike, scale: np.ndarray) -> np.ndarray | None:
    """Spacings h close to the given ones with ρ ≥ Mρ, ρ = 1/h, if there are any.

    Args:
      m: M, shape (n, n).
      now: the present spacings, shape (n,); each block keeps their geometric mean.
      scale: the size of the noise along each axis, > 0, shape (n,): how much room each of them gets.

    Returns:
      Spacings, shape (n,), or None.

    Example:
      >>> a = np.array([[1.0, 2.0], [2.0, 4.0]])
      >>> spacings(dominance(a), [0.5, 0.5], np.sqrt(np.diag(a))).round(6).tolist()
      [0.353553, 0.707107]
    """
    result = np.array(now, dtype=float)
    # (I + |M|)ⁿ > 0 where a path of correlations leads from axis to axis: the blocks of M
    linked = np.linalg.matrix_power(np.eye(len(m)) + (m > 0) + (m.T > 0), len(m)) > 0
    for block in {tuple(np.flatnonzero(row)) for row in linked}:
        if len(block) == 1:
            continue
        axes = np.array(block)
        inner = m[np.ix_(axes, axes)]
        values, vectors = np.linalg.eig(inner)
        largest = int(np.argmax(values.real))  # M is not negative: the Perron root, which is real
        if values[largest].real > 1 + 1e-12:
            return None
        if values[largest].real < 1 - 1e-9:  # (I − M) ρ = s has room on every axis
            density = np.linalg.solve(np.eye(len(axes)) - inner, 1 / scale[axes])
        else:
            vector = np.abs(vectors[:, largest].real)
            density = np.maximum(vector, 1e-9 * np.max(vector))
        # the inequality has no unit: the block keeps the geometric mean of its spacings, and so the count of nodes
        result[axes] = np.exp(np.mean(np.log(result[axes] * density))) / density
    return result


def shape(m: np.ndarray, grid: Grid, wanted: np.ndarray) -> tuple[int, ...] | None:
    """Numbers of nodes with ρ ≥ Mρ on the same box, if there are any near the present ones.

    Args:
      m: M, shape (n, n).
      grid: the grid.
      wanted: spacings that satisfy it, shape (n,).
    """
    lengths = np.asarray(grid.hi) - np.asarray(grid.lo)
    ends = 1 - np.array(grid.periodic, dtype=int)
    # counts are whole numbers, which few factors hit well: nearest to the present size first, half to twice as many
    for factor in sorted(np.geomspace(0.5, 2.0, 2001), key=lambda factor: abs(np.log(factor))):
        intervals = np.maximum(np.round(lengths / wanted * factor), 1)
        density = intervals / lengths
        # 1e-15: where equality is meant, as between two axes of correlation one, products differ in the last place
        if np.all(density * (1 + 1e-15) >= m @ density) and np.all(intervals + ends >= 2):
            return tuple(int(count) for count in intervals + ends)
    return None


def advice(on: Discretisation, a: ArrayLike, actions: Actions) -> str:
    """Two sentences for a message: the condition on ``a``, and what meets it at all nodes; host level.

    Args:
      on: the problem on its grid, at its time.
      a: the diffusion matrix where the condition fails, shape (n, n).
      actions: the pairs of control and disturbance that are tried, shapes (K, m) and (K, l).
    """
    a, grid = np.asarray(a, dtype=float), on.grid
    h = np.array([grid.spacing(axis) for axis in range(grid.ndim)], dtype=float)
    head = (
        "Every axis i needs a_ii/h_i ≥ Σ_j |a_ij|/h_j (a = σσᵀ); here diag a = "
        f"{_numbers(np.diag(a))}, h = {_numbers(h)}.\n"
    )
    on = dataclasses.replace(on, dtype=np.dtype(np.float64), cut=None)
    with own_settings(x64=True):
        return head + _remedy(on, a, actions, h)


def _remedy(on: Discretisation, a: np.ndarray, actions: Actions, h: np.ndarray) -> str:
    """The shape, the spacings or the coordinates that represent the noise at all nodes."""
    scale = np.sqrt(np.where(np.diag(a) > 0, np.diag(a), 1.0))
    if spacings(dominance(a), h, scale) is None:
        return (
            "No spacing of these axes will do: turn the state's axes so that a becomes (nearly) diagonal, "
            "or weaken the correlation"
        )
    most, grid = np.maximum(dominance(a), _largest(on, actions)), on.grid
    for _ in range(TRIES):
        wanted = spacings(most, h, scale)
        if wanted is None:
            return "No spacings were found that do at all nodes. " + _coordinates(on, actions)
        fitting = shape(most, grid, wanted)
        if fitting is None:
            return (
                f"Choose lo, hi and shape so that the spacings are as {_numbers(wanted / wanted[0])} to one another, "
                f"which does at all nodes; with this box no shape near {grid.shape} has that ratio"
            )
        # other nodes have other states
        there = _largest(on.on_grid(dataclasses.replace(grid, shape=fitting)), actions)
        density = (np.array(fitting) - 1 + np.array(grid.periodic)) / (np.asarray(grid.hi) - np.asarray(grid.lo))
        if np.all(density * (1 + ROUNDING) >= there @ density):
            return f"Use Grid(..., shape={fitting}): representable at all of its nodes"
        most = np.maximum(most, there)
    return "No shape was found that does at all of its nodes. " + _coordinates(on, actions)


def _largest(on: Discretisation, actions: Actions) -> np.ndarray:
    """The largest entries of M over all nodes and the actions that are tried, (n, n); zero if it is the same there."""
    found = np.zeros((on.grid.ndim,) * 2)
    if not callable(on.problem.noise):
        return found
    for u, d in zip(*actions, strict=True):
        found = np.maximum(found, np.max(dominance(_matrices(on, u, d)), axis=0))
    return found


def _matrices(on: Discretisation, u: np.ndarray, d: np.ndarray) -> np.ndarray:
    """a at all nodes, counted flat, (N, n, n)."""
    grid = on.grid
    found = np.zeros((grid.size, grid.ndim, grid.ndim))
    for (i, j), entry in on.diffusion(list(u), list(d)).items():
        found[:, i, j] = found[:, j, i] = np.broadcast_to(np.asarray(entry), grid.shape).reshape(-1)
    return found


def _coordinates(on: Discretisation, actions: Actions) -> str:
    """The advice on coordinates y_i(x_i) in which the noise is constant; another one where there are none.

    With g_i = √a_ii a function of x_i and constant correlations a_ij/(g_i g_j), dy_i = dx_i/g_i has constant noise.
    """
    otherwise = (
        "Turn the state's axes so that a becomes (nearly) diagonal, take coordinates in which the noise is constant, "
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
    """Spacings and scales of one."""
    return np.ones(grid.ndim), np.ones(grid.ndim)


def _coordinate(grid: Grid, axis: int, size: np.ndarray) -> str | None:
    """y(x) with dy = dx/g for an axis in words, from g at all nodes, counted flat; None where g has other arguments."""
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
    """Numbers as they stand in a message, to six digits."""
    return "[" + ", ".join(f"{entry:.6g}" for entry in np.asarray(entries, dtype=float)) + "]"


def along_axis(a: dict[tuple[int, int], jax.Array], grid: Grid, axis: int) -> Any:
    """a_ii − Σ_j |a_ij| h_i/h_j: the noise that the diagonal jumps leave for jumps along axis i; None without any."""
    left = a.get((axis, axis))
    if left is None:
        return None
    for (i, j), entry in a.items():
        if i != j:
            checks.refuse_stretched(grid)  # a diagonal between unequal cells is no diagonal
        if i != j and axis in (i, j):
            other = j if axis == i else i
            left = left - jnp.abs(entry) * (grid.spacing(axis) / grid.spacing(other))
    return left


def lacking(on: Discretisation, a: dict[tuple[int, int], jax.Array]) -> jax.Array | None:
    """The nodes at which the diagonal jumps take more than an axis has, bool; None without correlation."""
    if all(i == j for i, j in a):
        return None
    slack = 16 * on.grid.ndim * jnp.finfo(on.dtype).eps  # rounding of σσᵀ and of the spacings
    short = (along_axis(a, on.grid, i) < -slack * jnp.asarray(a[i, i], on.dtype) for i in range(on.grid.ndim))
    return functools.reduce(jnp.logical_or, short)
