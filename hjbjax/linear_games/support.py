"""Support functions σ(w) = max w·u of admissible sets, and their smooth maximisers.

The smooth maximisers have the barriers Σ log(1 − q_i²) on the box u = c + r q, log(1 − |q|²) on the ball of radius 1,
and Σ log λ_i of the weights of the vertices on a simplex or on the convex hull of a finite set. A control that switches
between the points of a finite set fast enough comes arbitrarily close to any mean of them, so the hull gives the same
value.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.linear_games.barriers import over_ball, over_interval, over_simplex
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Finite, Simplex
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number

MATCHING = 1e-9  # relative difference of two matrices that counts as rounding


def support(admissible: AdmissibleSet, w: Array) -> jax.Array:
    """σ(w) for w of shape (..., m)."""
    w = jnp.asarray(w)
    if isinstance(admissible, Box):
        middle, half = _middle_and_half(admissible, w.dtype)
        return w @ middle + jnp.abs(w) @ half
    if isinstance(admissible, Ball):
        return jnp.asarray(admissible.radius, w.dtype) * _length(w)
    return jnp.max(w @ _vertices(admissible, w.dtype).T, axis=-1)


def smooth_support(admissible: AdmissibleSet, w: Array, mu: Number) -> tuple[Array, Array]:
    """The maximum of w·u plus μ times the barrier for w of shape (m,), and the maximiser, inside the set."""
    w = jnp.asarray(w)
    if isinstance(admissible, Box):
        middle, half = _middle_and_half(admissible, w.dtype)
        values, q = over_interval(half * w, mu)
        return w @ middle + jnp.sum(values), middle + half * q
    if isinstance(admissible, Ball):
        radius = jnp.asarray(admissible.radius, w.dtype)
        value, q = over_ball(radius * w, mu)
        return value, radius * q
    vertices = _vertices(admissible, w.dtype)
    value, weights = over_simplex(vertices @ w, mu)
    return value, weights @ vertices


def integral_over_line(admissible: AdmissibleSet, first: Array, last: Array) -> Array:
    """An upper bound of ∫ σ over the straight line from w = ``first`` to ``last``, shapes (..., m), of length 1.

    It is exact for a box. σ is convex, so the trapezoidal rule is an upper bound for the other sets.
    """
    if not isinstance(admissible, Box):
        return (support(admissible, first) + support(admissible, last)) / 2
    middle, half = _middle_and_half(admissible, first.dtype)
    sizes = jnp.abs(first), jnp.abs(last)
    total = jnp.where(sizes[0] + sizes[1] == 0, 1, sizes[0] + sizes[1])
    # ∫|w| of a linear w: a trapezoid without a change of sign, otherwise two triangles
    crossing = (sizes[0] ** 2 + sizes[1] ** 2) / (2 * total)
    mean = jnp.where(first * last < 0, crossing, (sizes[0] + sizes[1]) / 2)
    return (first + last) @ middle / 2 + mean @ half


def largest_entries(admissible: AdmissibleSet, dtype: Any) -> jax.Array:
    """The largest |u_j| in the set, shape (m,)."""
    if isinstance(admissible, Box):
        return jnp.maximum(jnp.abs(jnp.asarray(admissible.lo, dtype)), jnp.abs(jnp.asarray(admissible.hi, dtype)))
    if isinstance(admissible, Ball):
        return jnp.full(admissible.dim, admissible.radius, dtype)
    return jnp.max(jnp.abs(_vertices(admissible, dtype)), axis=0)


def reduced(controls: AdmissibleSet, own: np.ndarray, opponents: AdmissibleSet, other: np.ndarray) -> Any:
    """The set S with σ_S(B'p) = σ_U(B'p) − σ_D(−C'p) for all p; None if there is no set of this kind.

    The difference is convex in p if and only if it is a support function. Two cases are recognised: boxes, if every
    column of C is parallel to a column of B, and balls, if C is B times a multiple of an orthogonal matrix.

    Args:
      controls: U, the set of the player that minimises a convex terminal cost.
      own: B, shape (n, m).
      opponents: D.
      other: C, shape (n, k).
    """
    # in units of the states and of the largest entries of the inputs, because these may differ by any factor
    sizes = [_largest_known(each) for each in (controls, opponents)]
    rows = np.max(np.abs(np.concatenate([own * sizes[0], other * sizes[1]], axis=1)), axis=1, initial=0.0)
    rows = np.where(rows > 0, rows, 1.0)[:, None]
    own, other = own * sizes[0] / rows, other * sizes[1] / rows
    inside = np.linalg.lstsq(own, other, rcond=None)[0]  # K with C = B K, shape (m, k)
    inside = np.where(np.abs(inside) <= MATCHING, 0.0, inside)
    if np.max(np.abs(own @ inside - other), initial=0.0) > MATCHING:
        return None
    inside = inside * sizes[0][:, None] / sizes[1]
    if isinstance(controls, Box) and isinstance(opponents, Box):
        if np.any(np.sum(inside != 0, axis=0) > 1):
            return None
        middle, half = (controls.lo + controls.hi) / 2, (controls.hi - controls.lo) / 2
        shift, cost = (opponents.lo + opponents.hi) / 2, (opponents.hi - opponents.lo) / 2
        middle, left = middle + inside @ shift, half - np.abs(inside) @ cost
        return (
            None if np.any(left < -MATCHING * half) else Box(middle - np.maximum(left, 0), middle + np.maximum(left, 0))
        )
    if isinstance(controls, Ball) and isinstance(opponents, Ball):
        square = inside.T @ inside
        scale = float(np.sqrt(np.mean(np.diagonal(square))))
        turned = inside.shape[0] == inside.shape[1] and np.allclose(
            square, scale**2 * np.eye(len(square)), rtol=0, atol=MATCHING * scale**2
        )
        radius = float(controls.radius) - scale * float(opponents.radius)
        return Ball(max(radius, 0.0), controls.dim) if turned and radius >= -MATCHING * float(controls.radius) else None
    return None


def _largest_known(admissible: AdmissibleSet) -> np.ndarray:
    """The largest |u_j| in the set in NumPy, shape (m,); 1 for an input that is always zero."""
    with own_settings(x64=True):
        found = np.asarray(largest_entries(admissible, np.float64))
    return np.where(found > 0, found, 1.0)


def _middle_and_half(box: Box, dtype: Any) -> tuple[jax.Array, jax.Array]:
    """Centre and half widths of a box."""
    lo, hi = jnp.asarray(box.lo, dtype), jnp.asarray(box.hi, dtype)
    return (lo + hi) / 2, (hi - lo) / 2


def _vertices(admissible: Finite | Simplex, dtype: Any) -> jax.Array:
    """Points whose convex hull is the set, or the hull of the set, shape (K, m)."""
    if isinstance(admissible, Finite):
        return jnp.asarray(admissible.points, dtype)
    corners = np.eye(admissible.dim)
    if admissible.at_most:
        corners = np.concatenate([corners, np.zeros((1, admissible.dim))])
    return jnp.asarray(admissible.total, dtype) * jnp.asarray(corners, dtype)


def _length(w: jax.Array) -> jax.Array:
    """|w| with the derivative 0 at zero."""
    square = jnp.sum(w * w, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
