"""Maxima with a logarithmic barrier, in closed form or by one scalar equation.

For μ > 0 each maximum is smooth, smaller than the maximum without barrier by O(μ log 1/μ), and its maximiser is inside
the set. The maximiser approaches the boundary like μ divided by the distance, so its derivative never vanishes; the
weights of an entropy would vanish exponentially, and Newton's method with them.
"""

import jax
import jax.numpy as jnp

from hjbjax.problem.types import Array, Number

ROUNDS = 30  # steps of Newton's method for the scalar equation, which converges monotonically


def over_interval(z: Array, mu: Number) -> tuple[Array, Array]:
    """Maxima of q z + μ log(1 − q²) over |q| < 1, entry by entry, and the maximisers."""
    root = mu + jnp.sqrt(mu * mu + z * z)
    q = z / root  # 1 − q² = 2μ/root
    return q * z + mu * jnp.log(2 * mu / root), q


def over_ball(z: Array, mu: Number) -> tuple[Array, Array]:
    """The maximum of q·z + μ log(1 − |q|²) over the unit ball for z of shape (m,), and the maximiser."""
    root = mu + jnp.sqrt(mu * mu + z @ z)
    q = z / root
    return q @ z + mu * jnp.log(2 * mu / root), q


def over_simplex(levels: Array, mu: Number) -> tuple[Array, Array]:
    """The maximum of λ·s + μ Σ log λ_i over weights with the sum 1 for s of shape (K,), and the weights.

    The weights are μ/(ν − s_i), with ν such that their sum is 1.
    """
    top = jax.lax.stop_gradient(jnp.max(levels))
    below = (top - levels) / mu  # ≥ 0

    def newton(_: int, r: Array) -> Array:
        inverse = 1 / (r + below)
        return r + (jnp.sum(inverse) - 1) / jnp.sum(inverse**2)

    # r = (ν − max s)/μ is at least 1; the sum is convex and decreasing in r, so the steps approach from below
    r = jax.lax.fori_loop(0, ROUNDS, newton, jnp.ones((), below.dtype))
    r = newton(0, jax.lax.stop_gradient(r))  # the derivative of one step from the root is the derivative of the root
    weights = 1 / (r + below)
    return weights @ levels + mu * jnp.sum(jnp.log(weights)), weights
