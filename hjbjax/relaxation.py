"""Solving δ = s + Σ_o w_o δ(x + o): sweeps, Krylov, direct."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import stencil, wavefront
from hjbjax.bellman import Correction
from hjbjax.grid import Grid
from hjbjax.pytree import node


@node(static=("count",))
class Sweeps:
    """Rough evaluation by Gauss–Seidel: in every order ``count`` times a forward and a backward sweep.

    The work is about that of ``count`` 2^n relaxations of every node. Runs in float32 on the correction. On a CPU whose
    cache the grid outgrows, every slab of it is swept 2 ``count`` - 1 times (three at least) on each of two ways.
    """

    count: int = 3


@node(static=("max_steps",))
class Krylov:
    """Evaluation by BiCGStab, preconditioned by one round of Gauss–Seidel, to a fraction of the residual.

    Args:
      fraction: stop when the 2-norm of the residual has fallen by this factor.
      max_steps: at most so many steps, two products and two preconditionings each.
    """

    fraction: Any = 1e-3
    max_steps: int = 200


@node()
class Direct:
    """Exact evaluation by a sparse LU factorisation (SciPy's SuperLU, on the host): small grids and oracles."""


Evaluation = Sweeps | Krylov | Direct


def solve(method: Evaluation, equation: Correction, grid: Grid) -> jax.Array:
    """An approximate solution δ, shape (*grid), in the dtype of the equation."""
    if not isinstance(method, Sweeps):
        delta = direct(equation, grid) if isinstance(method, Direct) else krylov(method, equation, grid)
        size, left = jnp.max(jnp.abs(equation.source)), jnp.max(jnp.abs(left_over(equation, grid, delta)))
        # an improper policy has no value, and BiCGStab may break down: then relax, which always makes sense
        return jax.lax.cond(left <= size, lambda: delta, lambda: gauss_seidel(equation, grid, 2))
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), equation)
    return gauss_seidel(single, grid, method.count).astype(equation.source.dtype)


def left_over(equation: Correction, grid: Grid, delta: jax.Array) -> jax.Array:
    """s + Σ_o w_o δ(x + o) − δ: what a correction leaves."""
    jumps = zip(equation.weights.offsets, equation.weights.values, strict=True)
    terms = [w * stencil.neighbour(delta, grid, offset, ghost=False) for offset, w in jumps]
    return sum(terms, start=equation.source - delta)


def jacobi(equation: Correction, grid: Grid, sweeps: int) -> jax.Array:
    """Damped Jacobi sweeps, ½(I + T): the star stencil alone has an eigenvalue near −1."""

    def sweep(_, delta):
        return delta + 0.5 * left_over(equation, grid, delta)

    return jax.lax.fori_loop(0, sweeps, sweep, jnp.zeros_like(equation.source))


def gauss_seidel(equation: Correction, grid: Grid, rounds: int) -> jax.Array:
    """Rounds of wavefront Gauss–Seidel from zero; damped Jacobi where diagonal jumps break the wavefront."""
    if any(sum(map(abs, offset)) > 1 for offset in equation.weights.offsets):
        return jacobi(equation, grid, 4 * rounds * 2**grid.ndim)
    return wavefront.gauss_seidel(equation, grid, rounds)


def krylov(method: Krylov, equation: Correction, grid: Grid) -> jax.Array:
    """BiCGStab on (I − W) δ = s with one Gauss–Seidel round as preconditioner."""

    def matvec(delta):
        return -left_over(Correction(jnp.zeros_like(delta), equation.weights), grid, delta)

    def precondition(residual):
        return gauss_seidel(Correction(residual, equation.weights), grid, 1)

    delta, _ = jax.scipy.sparse.linalg.bicgstab(
        matvec, equation.source, tol=method.fraction, maxiter=method.max_steps, M=precondition
    )
    return delta


def direct(equation: Correction, grid: Grid) -> jax.Array:
    """(I − W)⁻¹ s by SuperLU through a host callback; lanes of a batch are solved one after another.

    Numbers travel as 32-bit words: the callback's thread does not know of ``jax.enable_x64``.
    """
    offsets, dtype = equation.weights.offsets, equation.source.dtype
    word = np.uint32

    def numbers(words):
        return np.ascontiguousarray(words).view(dtype).reshape(grid.shape).astype(np.float64)

    def on_host(source, *weights):
        delta = _factor_and_solve(offsets, [numbers(w) for w in weights], numbers(source), grid)
        return np.ascontiguousarray(delta.astype(dtype)).view(word).reshape(source.shape)

    words = [jax.lax.bitcast_convert_type(array, word) for array in (equation.source, *equation.weights.values)]
    result = jax.ShapeDtypeStruct(words[0].shape, word)
    delta = jax.pure_callback(on_host, result, *words, vmap_method="sequential")
    return jax.lax.bitcast_convert_type(delta, dtype)


def _factor_and_solve(offsets: Any, weights: list[np.ndarray], source: np.ndarray, grid: Grid) -> np.ndarray:
    from scipy.sparse.linalg import splu

    matrix = stencil.sparse(offsets, [-w for w in weights], np.ones(grid.shape), grid)
    try:
        delta = splu(matrix.tocsc()).solve(source.ravel())
    except RuntimeError:  # exactly singular
        delta = np.full(grid.size, np.nan)
    return delta.reshape(grid.shape)
