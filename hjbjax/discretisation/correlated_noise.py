"""Correlated noise and the spacings of a grid.

The diagonal jumps of the chain take Σ_j |a_ij| h_i/h_j from a_ii, and what is left must not be negative:

    a_ii/h_i ≥ Σ_{j≠i} |a_ij|/h_j        (a = σσᵀ, scaled diagonal dominance)

With D = diag a there are such spacings exactly where the spectral radius of B = D^(−1/2) |a − D| D^(−1/2) is at
most one; then 1/h = D^(−1/2) v with (I − B) v = 1, or at one with the Perron vector v of B, block by block. In 2-D
there always are: h₁/h₂ = √(a₁₁/a₂₂).
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.problem.grid import Grid
from hjbjax.tracing import checks


def spacings(a: ArrayLike, now: ArrayLike) -> np.ndarray | None:
    """Spacings h close to the given ones with a_ii/h_i ≥ Σ_j |a_ij|/h_j on every axis, if there are any.

    Args:
      a: the diffusion matrix at one node, shape (n, n).
      now: the spacings now, shape (n,); each block keeps their geometric mean.

    Returns:
      Spacings, shape (n,), or None.

    Example:
      >>> spacings([[1.0, 2.0], [2.0, 4.0]], [0.5, 0.5]).round(6).tolist()
      [0.353553, 0.707107]
    """
    a, result = np.asarray(a, dtype=float), np.array(now, dtype=float)
    # an axis without noise has a zero row in a positive semidefinite matrix: any scale does for it
    root = np.sqrt(np.diag(a))
    scale = np.where(root > 0, root, 1.0)
    b = np.abs(a - np.diag(np.diag(a))) / np.outer(scale, scale)
    # (I + |B|)ⁿ > 0 where a path of correlations leads from axis to axis: the blocks of B
    linked = np.linalg.matrix_power(np.eye(len(a)) + (b > 0), len(a)) > 0
    for block in {tuple(np.flatnonzero(row)) for row in linked}:
        if len(block) == 1:
            continue
        axes = np.array(block)
        inner = b[np.ix_(axes, axes)]
        # B is symmetric and non-negative: its spectral radius is its largest eigenvalue, the Perron vector the last
        radii, vectors = np.linalg.eigh(inner)
        if radii[-1] > 1 + 1e-12:
            return None
        if radii[-1] < 1 - 1e-9:  # (I − B) v = 1 has room on every axis, and v ≥ 1 where blocks hardly touch
            v = np.linalg.solve(np.eye(len(axes)) - inner, np.ones(len(axes)))
        else:
            v = np.maximum(np.abs(vectors[:, -1]), 1e-9)
        new = scale[axes] / v  # 1/h = D^(−1/2) v
        # the inequality has no unit: the block keeps the geometric mean of its spacings, and so the count of nodes
        result[axes] = new * np.exp(np.mean(np.log(result[axes] / new)))
    return result


def shape(a: ArrayLike, grid: Grid, wanted: np.ndarray) -> tuple[int, ...] | None:
    """Numbers of nodes for which the chain represents ``a`` on the same box, if there are any near the present ones.

    Args:
      a: the diffusion matrix at one node, shape (n, n).
      grid: the grid.
      wanted: spacings that represent it, shape (n,).
    """
    a, lengths = np.asarray(a, dtype=float), np.asarray(grid.hi) - np.asarray(grid.lo)
    ends = 1 - np.array(grid.periodic, dtype=int)
    off = np.abs(a - np.diag(np.diag(a)))
    # counts are whole numbers, which few factors hit well: nearest to the present size first, half to twice as many
    for factor in sorted(np.geomspace(0.5, 2.0, 2001), key=lambda factor: abs(np.log(factor))):
        intervals = np.maximum(np.round(lengths / wanted * factor), 1)
        density = intervals / lengths
        # 1e-15: where equality is meant, as between two axes of correlation one, products differ in the last place
        if np.all(np.diag(a) * density * (1 + 1e-15) >= off @ density) and np.all(intervals + ends >= 2):
            return tuple(int(count) for count in intervals + ends)
    return None


def advice(a: ArrayLike, grid: Grid, *, everywhere: bool) -> str:
    """Two sentences for a message: the condition on ``a``, and a shape or spacings that meet it.

    Args:
      a: the diffusion matrix at one node, shape (n, n).
      grid: the grid.
      everywhere: true if it is the matrix of all nodes.
    """
    h = np.array([grid.spacing(axis) for axis in range(grid.ndim)], dtype=float)
    head = (
        "Every axis i needs a_ii/h_i ≥ Σ_j |a_ij|/h_j (a = σσᵀ); here diag a = "
        f"{_numbers(np.diag(a))}, h = {_numbers(h)}.\n"
    )
    wanted = spacings(a, h)
    if wanted is None:
        return head + (
            "No spacing of these axes will do: turn the state's axes so that a becomes (nearly) diagonal, "
            "or weaken the correlation"
        )
    fitting, where = shape(a, grid, wanted), "everywhere" if everywhere else "there"
    if fitting is not None:
        return head + f"Use Grid(..., shape={fitting}): representable {where}"
    return head + (
        f"Choose lo, hi and shape so that the spacings are as {_numbers(wanted / wanted[0])} to one another: "
        f"representable {where}; with this box no shape near {grid.shape} has that ratio"
    )


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
