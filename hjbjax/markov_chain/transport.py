"""Transport of a law along axes with little or no noise, for example a position driven by a velocity.

The chain moves mass upwind, which adds the diffusion h|f| to an axis with spacing h. If the noise a is smaller, the law
of the chain is too wide by the difference. With the excess speed s = max(|f| − a/h, 0) and q = s p, the flux

    F_{i+1/2} = f_i p_i + δ_i,    δ_i = min(|Δ⁺|, |Δ⁻|, (2|Δ⁺| + |Δ⁻|)/6),    Δ⁺ = q_{i+1} − q_i,  Δ⁻ = q_i − q_{i−1},

removes the difference. δ has the sign of both differences, and is zero if their signs differ. The scheme is
conservative and has order 2 where s p is smooth and monotone. Since |δ_i| ≤ q_i, it keeps p ≥ 0 for steps
τ ≤ 1/max(Q + Σ s/h), which may be half as long as the steps of the chain.

Source: B. Koren, A robust upwind discretization method for advection, diffusion and source terms (1993).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.problem.grid import Grid


class Correction(NamedTuple):
    """The flux that removes the diffusion of upwinding, in one direction along an axis.

    Attributes:
      ahead: the offset to the next node in the direction.
      behind: the opposite offset.
      rate: s/h, per unit time, shape (*grid).
    """

    ahead: tuple[int, ...]
    behind: tuple[int, ...]
    rate: jax.Array


def corrections(on: Discretisation, u: list, axes: tuple[int, ...]) -> list[Correction]:
    """The corrections along the given axes under the control u, a list of m components."""
    grid = on.grid
    found: list[Correction] = []
    if not axes:
        return found
    drift, noise = on.drift(u), on.diffusion(u)
    for axis in axes:
        link, a = stencil.grid_links(grid, axis), stencil.noise_along(noise, grid, axis)
        for step, length in ((1, link.up), (-1, link.down)):
            # no flux crosses a wall; upwinding adds the diffusion h f, of which only the part above a is removed
            speed = jnp.where(stencil.wall(grid, axis, step), 0, jnp.maximum(step * drift[axis], 0))
            excess = speed if a is None else jnp.maximum(speed - jnp.maximum(a, 0) / length, 0)
            rate = jnp.broadcast_to(jnp.asarray(excess / length, on.dtype), grid.shape)
            found.append(Correction(stencil.unit(grid, axis, step), stencil.unit(grid, axis, -step), rate))
    return found


def gained(grid: Grid, correction: Correction, p: jax.Array) -> jax.Array:
    """The mass per unit time that every node gains from a correction, shape (*grid); its sum is zero."""
    q = correction.rate * p
    ahead = stencil.neighbour(q, grid, correction.ahead, ghost=False) - q
    behind = q - stencil.neighbour(q, grid, correction.behind, ghost=False)
    size = jnp.minimum(jnp.minimum(jnp.abs(ahead), jnp.abs(behind)), (2 * jnp.abs(ahead) + jnp.abs(behind)) / 6)
    flux = jnp.where(ahead * behind > 0, jnp.sign(ahead) * size, 0)
    return stencil.neighbour(flux, grid, correction.behind, ghost=False) - flux


def largest_rates(on: Discretisation, u: list) -> jax.Array:
    """The largest s/h along every axis, shape (n,); zero where the noise is large enough to need no correction."""
    axes = tuple(range(on.grid.ndim))
    rates = [jnp.max(each.rate) for each in corrections(on, u, axes)]
    return jnp.stack([jnp.maximum(*rates[2 * axis : 2 * axis + 2]) for axis in axes])
