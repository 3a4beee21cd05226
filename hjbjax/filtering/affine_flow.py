"""One step of an affine system with noise, exactly: dξ = (F ξ + g) dt + dw with covariance W dt of dw.

    Φ = e^{F t},    s = ∫₀ᵗ e^{F σ} g dσ,    Q = ∫₀ᵗ e^{F σ} W e^{Fᵀ σ} dσ

by Taylor series on a short piece and doublings,

    s(2t) = s + Φ s,    Q(2t) = Q + Φ Q Φᵀ,    Φ(2t) = Φ²,

which add covariances and subtract nothing, so that no step is too long, unlike with C. F. Van Loan's exponential of
[−F, W; 0, Fᵀ], whose e^{−F t} overflows for a stiff system.
"""

import jax
import jax.numpy as jnp

from hjbjax.problem.types import Array, Number

SHORT = 0.25  # of the piece, |F| t: the series of Q then falls like ½^j/j!
TERMS = 14  # of the series: what is left is ½^15/15!, 2e-17
DOUBLINGS = 64  # at most: a piece 2^64 times shorter than the step is no longer told from none


def affine_flow(matrix: Array, source: Array, noise: Array, dt: Number, *, states: int) -> tuple[Array, Array, Array]:
    """Φ, s and Q after the time dt, shapes (k, k), (k,) and (k, k).

    Args:
      matrix: F, shape (k, k); of its columns only the first ``states`` need not be zero.
      source: g, shape (k,).
      noise: W, shape (k, k), symmetric and not negative.
      dt: the length of the step, in units of time.
      states: the number of entries that feed back. The others are integrals of them, whose units do not count for
        the number of doublings, and cost no rounding.
    """
    inner = jnp.abs(matrix[:states, :states])
    # both bound the spectral radius; the lesser one, as states may have units far apart
    rate = jnp.minimum(jnp.max(jnp.sum(inner, axis=0)), jnp.max(jnp.sum(inner, axis=1)))
    halvings = jnp.ceil(jnp.log2(jnp.maximum(rate * dt / SHORT, 1)))
    halvings = jnp.where(jnp.isfinite(halvings), jnp.clip(halvings, 0, DOUBLINGS), 0)
    piece = dt * jnp.exp2(-halvings)

    def add(j: int, carry: tuple) -> tuple:
        # t^j F^j/j!, t^{j+1} F^j g/(j+1)! and the same of Q: T_{j+1} = F T_j + T_j Fᵀ
        sums, (power, push, spread) = carry[:3], carry[3]
        half = matrix @ spread
        power, push, spread = (
            matrix @ power * (piece / j), matrix @ push * (piece / (j + 1)), (half + half.T) * (piece / (j + 1))
        )  # fmt: skip
        return sums[0] + power, sums[1] + push, sums[2] + spread, (power, push, spread)

    first = jnp.eye(len(source), dtype=matrix.dtype), piece * source, piece * noise
    transition, shift, covariance, _ = jax.lax.fori_loop(1, TERMS, add, (*first, first))

    def double(_: int, carry: tuple) -> tuple:
        transition, shift, covariance = carry
        return (
            transition @ transition,
            shift + transition @ shift,
            covariance + transition @ covariance @ transition.T,
        )

    return jax.lax.fori_loop(0, halvings.astype(jnp.int32), double, (transition, shift, covariance))
