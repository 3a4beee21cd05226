"""Solving δ = s + Σ_o w_o δ(x + o): sweeps, Krylov, direct."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.iteration import wavefront
from hjbjax.iteration.bellman import Correction
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import node

OPEN_FRACTION = 1e-8  # of the residual, to which a Krylov method goes with open ends


@node(static=("count",))
class Sweeps:
    """Rough evaluation by Gauss–Seidel: in every order ``count`` times a forward and a backward sweep.

    The work is about that of ``count`` 2^n relaxations of every node. Runs in float32 on the correction. On a CPU whose
    cache the grid outgrows, every slab of it is swept 2 ``count`` - 1 times (three at least) on each of two ways.
    """

    count: int = 3

    def __post_init__(self):
        arguments.count(self.count, "Sweeps: count")


@node(static=("max_steps",))
class Krylov:
    """Evaluation by BiCGStab, preconditioned by one round of Gauss–Seidel, to a fraction of the residual.

    Args:
      fraction: stop when the 2-norm of the residual has fallen by this factor.
      max_steps: at most so many steps, two products and two preconditionings each.
    """

    fraction: Any = 1e-3
    max_steps: int = 200

    def __post_init__(self):
        arguments.positive(self.fraction, "Krylov: fraction", most=1)
        arguments.count(self.max_steps, "Krylov: max_steps")


@node()
class Direct:
    """Exact evaluation by a sparse LU factorisation (SciPy's SuperLU, on the host): small grids and oracles."""


Evaluation = Sweeps | Krylov | Direct


def check_evaluation(evaluation: Any, name: str) -> None:
    """Refuse, by ``name``, what evaluates no policy.

    Raises:
      TypeError: with the evaluations that there are.
    """
    arguments.one_of(evaluation, name, (Sweeps, Krylov, Direct), "hjb.Sweeps(...), hjb.Krylov(...) or hjb.Direct()")


def solve(method: Evaluation, equation: Correction, grid: Grid) -> jax.Array:
    """An approximate solution δ, shape (*grid), in the dtype of the equation."""
    if isinstance(method, Sweeps) and grid.sides("open"):
        raise ValueError(
            "Sweeps(...) relax node by node, which does not converge where open ends continue the value from inside; "
            "use hjb.PolicyIteration(hjb.Direct()) or Krylov(), in a march Implicit(hjb.Direct())"
        )
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
    if grid.sides("open"):
        terms = [w * stencil.continued(delta, grid, offset) for offset, w in jumps]
    else:  # no weight leads out
        terms = [w * stencil.neighbour(delta, grid, offset, ghost=False) for offset, w in jumps]
    return sum(terms, start=equation.source - delta)


def jacobi(equation: Correction, grid: Grid, sweeps: int) -> jax.Array:
    """Damped Jacobi sweeps, ½(I + T): the star stencil alone has an eigenvalue near −1."""

    def sweep(_, delta):
        return delta + 0.5 * left_over(equation, grid, delta)

    return jax.lax.fori_loop(0, sweeps, sweep, jnp.zeros_like(equation.source))


def gauss_seidel(equation: Correction, grid: Grid, rounds: int) -> jax.Array:
    """Rounds of wavefront Gauss–Seidel from zero; damped Jacobi where diagonal jumps break the wavefront.

    At open ends the correction is continued as a constant: of an equation with a parabola beyond them this is a
    preconditioner and no solver, since what is outside is told by the change of δ inside.
    """
    equation = _walled(equation, grid)
    if any(sum(map(abs, offset)) > 1 for offset in equation.weights.offsets):
        return jacobi(equation, grid, 4 * rounds * 2**grid.ndim)
    return wavefront.gauss_seidel(equation, grid, rounds)


def _walled(equation: Correction, grid: Grid) -> Correction:
    """The equation without weights that lead out of open ends, whose share is the node's own."""
    if not grid.sides("open"):
        return equation
    inside, outside = [], jnp.zeros_like(equation.source)
    for offset, w in zip(equation.weights.offsets, equation.weights.values, strict=True):
        leaves = np.zeros((1,) * grid.ndim, bool)
        for axis, step in grid.sides("open"):
            if offset[axis] == step:
                leaves = leaves | stencil.on_edge(grid, axis, step)
        inside.append(jnp.where(leaves, 0, w))
        outside = outside + jnp.where(leaves, w, 0)
    scale = 1 / jnp.where(outside < 1, 1 - outside, 1)
    weights = dataclasses.replace(equation.weights, values=tuple(scale * w for w in inside))
    return Correction(scale * equation.source, weights)


def krylov(method: Krylov, equation: Correction, grid: Grid) -> jax.Array:
    """BiCGStab on (I − W) δ = s with one Gauss–Seidel round as preconditioner."""

    def matvec(delta):
        return -left_over(Correction(jnp.zeros_like(delta), equation.weights), grid, delta)

    def precondition(residual):
        return gauss_seidel(Correction(residual, equation.weights), grid, 1)

    fraction = method.fraction
    if grid.sides("open"):  # at 1e-3 the errors of the solves led a step in time to another solution
        fraction = jnp.minimum(fraction, OPEN_FRACTION)
    delta, _ = jax.scipy.sparse.linalg.bicgstab(
        matvec, equation.source, tol=fraction, maxiter=method.max_steps, M=precondition
    )
    return delta


def direct(equation: Correction, grid: Grid, *, transposed: bool = False) -> jax.Array:
    """(I − W)⁻¹ s, or its transpose times s, by SuperLU through a host callback; a batch goes lane after lane.

    Numbers travel as 32-bit words: the callback's thread does not know of ``jax.enable_x64``.
    """
    dtype = equation.source.dtype
    offsets, weights = stencil.inward(equation.weights.offsets, equation.weights.values, grid)
    word = np.uint32

    def numbers(words):
        return np.ascontiguousarray(words).view(dtype).reshape(grid.shape).astype(np.float64)

    def on_host(source, *weights):
        delta = _factor_and_solve(offsets, [numbers(w) for w in weights], numbers(source), grid, transposed)
        return np.ascontiguousarray(delta.astype(dtype)).view(word).reshape(source.shape)

    words = [jax.lax.bitcast_convert_type(array, word) for array in (equation.source, *weights)]
    result = jax.ShapeDtypeStruct(words[0].shape, word)
    delta = jax.pure_callback(on_host, result, *words, vmap_method="sequential")
    return jax.lax.bitcast_convert_type(delta, dtype)


def _factor_and_solve(
    offsets: Any, weights: list[np.ndarray], source: np.ndarray, grid: Grid, transposed: bool
) -> np.ndarray:
    from scipy.sparse.linalg import splu

    matrix = stencil.sparse(offsets, [-w for w in weights], np.ones(grid.shape), grid)
    try:
        delta = splu(matrix.tocsc()).solve(source.ravel(), "T" if transposed else "N")
    except RuntimeError:  # exactly singular
        delta = np.full(grid.size, np.nan)
    return delta.reshape(grid.shape)
