"""Solving δ = s + Σ_o w_o δ(x + o): sweeps, Krylov, direct.

Gauss–Seidel runs as a wavefront. Under the star stencil the nodes on a hyperplane σ·i = const, σ ∈ {±1}^n, do
not depend on each other. The arrays are sheared cyclically along the first axis, S[d, j] = X[(d − Σ_k σ_k j_k)
mod n₀, j], so that such a hyperplane is one slice (several, folded), and a sweep is a ``scan`` over slices that
carries the one just written. Reversing the scan reverses the order; 2^{n−1} shears give all 2^n orders. Jumps
across the seam of a periodic axis other than the first lag by one order: they enter through the residual.
"""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import stencil
from hjbjax.bellman import Correction
from hjbjax.chain import Rates
from hjbjax.grid import Grid
from hjbjax.pytree import node


@node(static=("count",))
class Sweeps:
    """Rough evaluation by ``count`` rounds of Gauss–Seidel, each a forward and a backward sweep in every order.

    The work of a round is about that of 2^n relaxations of every node. Runs in float32 on the correction.
    """

    count: int = 2


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

    def one_round(_, delta):
        for signs in itertools.product((1, -1), repeat=grid.ndim - 1):
            delta = delta + _wavefront(left_over(equation, grid, delta), equation.weights, grid, signs)
        return delta

    return jax.lax.fori_loop(0, rounds, one_round, jnp.zeros_like(equation.source))


def _wavefront(source: jax.Array, weights: Rates, grid: Grid, signs: tuple[int, ...]) -> jax.Array:
    """One forward and one backward sweep from zero in one order; the seams of axes beyond the first are cut."""
    table = dict(zip(weights.offsets, weights.values, strict=True))
    moves = {offset: _shear(_cut_seam(w, grid, offset), signs) for offset, w in table.items()}
    source = _shear(source, signs)
    behind: list[tuple] = []
    ahead: list[tuple] = []
    # neighbours on the slice d − 1 and on the slice d + 1: (weights, roll within the slice)
    for offset, w in moves.items():
        axis = next(i for i, step in enumerate(offset) if step)
        direction = offset[axis] * (1 if axis == 0 else signs[axis - 1])
        (ahead if direction > 0 else behind).append((w, axis - 1, -offset[axis]))

    def pull(group, rows, plane):
        terms = [
            row * (plane if axis < 0 else jnp.roll(plane, step, axis))
            for (_, axis, step), row in zip(group, rows, strict=True)
        ]
        return sum(terms[1:], start=terms[0]) if terms else jnp.zeros_like(plane)

    def sweep(done, coming, old, reverse):
        following = jnp.roll(old, 1 if reverse else -1, axis=0)
        rows = (source, tuple(w for w, *_ in done), tuple(w for w, *_ in coming), following)

        def advance(previous, row):
            s, done_row, coming_row, following = row
            new = s + pull(done, done_row, previous) + pull(coming, coming_row, following)
            return new, new

        start = old[0] if reverse else old[-1]
        return jax.lax.scan(advance, start, rows, reverse=reverse)[1]

    first = sweep(behind, ahead, jnp.zeros_like(source), False)
    return _shear(sweep(ahead, behind, first, True), tuple(-s for s in signs))


def _cut_seam(w: jax.Array, grid: Grid, offset: tuple[int, ...]) -> jax.Array:
    axis = next(i for i, step in enumerate(offset) if step)
    if axis == 0 or not grid.periodic[axis]:  # type: ignore[index]
        return w
    edge = np.arange(grid.shape[axis]) == (grid.shape[axis] - 1 if offset[axis] > 0 else 0)
    return jnp.where(edge.reshape([-1 if i == axis else 1 for i in range(grid.ndim)]), 0, w)


def _shear(values: jax.Array, signs: tuple[int, ...]) -> jax.Array:
    """S[d, j] = X[(d − Σ_k σ_k j_k) mod n₀, j]; undone by the opposite signs."""
    if not signs:
        return values
    shift = sum(
        sign * np.arange(count).reshape([-1 if i == k else 1 for i in range(len(signs))])
        for k, (sign, count) in enumerate(zip(signs, values.shape[1:], strict=True))
    )
    rows = (np.arange(values.shape[0]).reshape((-1,) + (1,) * len(signs)) - shift) % values.shape[0]
    return jnp.take_along_axis(values, jnp.asarray(rows), axis=0)


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
