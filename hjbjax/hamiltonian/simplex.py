"""The minimum of a separable convex quadratic over a simplex, and the projection onto it.

The minimum of Σ l_j u_j + q_j u_j² over u ≥ 0, Σ u_j = T has one multiplier τ of the sum,

    u_j = max(−l_j − τ, 0)/(2q_j),        Σ_j u_j(τ) = T.

The sum is piecewise linear in τ, with a breakpoint at every −l_j. For every breakpoint the multiplier is computed as if
exactly the inputs at and above it were positive; the largest of these numbers is τ, so that no sorting is needed. An
input without curvature takes the rest if τ meets its −l_j. For Σ u_j ≤ T the multiplier is at least zero.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from hjbjax.discretisation.stencil import PerNode
from hjbjax.hamiltonian.piecewise import inverse
from hjbjax.hamiltonian.search import Action
from hjbjax.problem.sets import Simplex


def least_in_simplex(simplex: Simplex, linear: Sequence[PerNode], square: Sequence[PerNode]) -> list[jax.Array]:
    """The u that minimises Σ l_j u_j + q_j u_j² over a simplex; q_j ≥ 0. Numbers are per-node scalars."""
    # 1/(2q) is zero without curvature, which leaves these inputs out of the sums
    starts, widths = [-slope for slope in linear], [inverse(2 * q) for q in square]
    none = -jnp.inf
    multipliers = []
    for start, width in zip(starts, widths, strict=True):
        positive = [jnp.where(s >= start, w, 0) for s, w in zip(starts, widths, strict=True)]
        # relative to this breakpoint, because starts may be large and close to each other
        reach = sum(w * (s - start) for s, w in zip(starts, positive, strict=True))
        multipliers.append(jnp.where(width > 0, start + (reach - simplex.total) * inverse(sum(positive)), none))
    straight = [jnp.where(width > 0, none, start) for start, width in zip(starts, widths, strict=True)]
    least = functools.reduce(jnp.maximum, straight)
    multiplier = functools.reduce(jnp.maximum, multipliers, least)
    if simplex.at_most:
        multiplier = jnp.maximum(multiplier, 0)
    action = [jnp.maximum(start - multiplier, 0) * width for start, width in zip(starts, widths, strict=True)]
    # −∞ in all straight inputs would count as equal
    rest = jnp.where((least == multiplier) & (least > none), simplex.total - sum(action), 0)
    for j, start in enumerate(straight):  # one straight input takes all of the rest
        mine = start == least
        action[j] = action[j] + jnp.where(mine, rest, 0)
        rest = jnp.where(mine, 0, rest)
    return action


def project(simplex: Simplex, action: Action) -> list[jax.Array]:
    """The nearest admissible action."""
    half = jnp.full((), 0.5, jnp.result_type(float, *action))
    return least_in_simplex(simplex, [-u for u in action], [half] * len(action))
