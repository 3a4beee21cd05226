"""The forward equation ∂p/∂t = 𝓛*p on a grid, and the mean, covariance and mode of a law.

𝓛* is the transposed generator of the chain under one control, so Σ p is conserved and p stays ≥ 0. With sub-steps
τ ≤ 1/max Q, each

    p ← p + τ 𝓛*p

is a step of a Markov chain. Heun's mean ½ p + ½ (1 + τ𝓛*)² p has order 2 in τ. There are ⌈dt max Q⌉ sub-steps, the
fewest that are stable, so dt may have any length; each sub-step costs two passes over the nodes. Along axes whose noise
is too small for central differences, ``transport`` removes the diffusion of upwinding, in sub-steps up to half as long.

The law of the chain is one probability per node. The density is the probability divided by the cell of the node: half a
cell at a wall where noise reflects, a whole cell at an end of an axis without noise, see ``chain.stationary_density``.

Along a periodic axis of length L the mean is the circular mean,

    lo + L/2π arg Σ p e^{2πi (x − lo)/L},

wrapped into the box. Differences from it are taken the short way round, in [−L/2, L/2). If the sum vanishes, as for a
uniform law, the mean is ``lo``.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import Rates, jump_rates
from hjbjax.markov_chain.transport import Correction, corrections, gained
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import known
from hjbjax.problem.types import Array, Control, Field, Number, State

MOST = 10_000_000  # sub-steps: enough for a law to come to rest on any grid that fits in memory, one cell per sub-step


def substeps(on: Discretisation, u: Control, dt: Number, axes: tuple[int, ...] = ()) -> jax.Array:
    """The number of sub-steps ⌈dt max Q⌉ under the control u (m,), from 1 to ``MOST`` + 1."""
    entries = _entries(u, on.dtype)
    return _count(_leaving(jump_rates(on, entries), corrections(on, entries, axes)), dt)


def _entries(u: Control, dtype: np.dtype) -> list:
    return [jnp.asarray(u[j], dtype) for j in range(len(u))]


def _leaving(jumps: Rates, corrected: list[Correction]) -> Any:
    """The largest rate at which mass leaves each node."""
    return sum((each.rate for each in corrected), start=jumps.total())


def _count(leaving: Field, dt: Number) -> jax.Array:
    wanted = jnp.ceil(jnp.max(leaving) * dt)
    # rates that are not finite give no count; take one sub-step, whose result is then not finite either
    return jnp.where(jnp.isfinite(wanted), jnp.clip(wanted, 1, MOST + 1), 1).astype(jnp.int32)


def advanced(
    on: Discretisation,
    probability: Field,
    u: Control,
    dt: Number,
    most: int | None = None,
    *,
    axes: tuple[int, ...] = (),
) -> Field:
    """The probabilities at the nodes after the time dt under the control u (m,): ≥ 0, with the same sum.

    NaN if more than ``MOST`` sub-steps are needed.

    Args:
      on: the chain.
      probability: at the nodes, shape (*grid).
      u: the control, shape (m,).
      dt: the time.
      most: the number of sub-steps, at least the number needed. A loop of known length has a reverse derivative.
      axes: the axes along which the diffusion of upwinding is removed.
    """
    dtype = probability.dtype
    entries = _entries(u, dtype)
    jumps, corrected = jump_rates(on, entries), corrections(on, entries, axes)
    arriving = jumps.inflow(on.grid)
    count = _count(_leaving(jumps, corrected), dt) if most is None else most
    probability = jnp.where(jnp.asarray(count) > MOST, jnp.nan, probability)
    tau = jnp.asarray(dt / count, dtype)
    stays = jnp.maximum(1 - tau * jumps.total(), 0)  # for the fastest node 1 − 1, which may round below zero
    moves = arriving.scaled(tau)
    corrected = [each._replace(rate=tau * each.rate) for each in corrected]

    def moved(p: Field) -> Field:
        found = _moved(on, stays, moves, p)
        for correction in corrected:
            found = found + gained(on.grid, correction, p)
        # fluxes that cancel may leave a negative rounding error
        return jnp.maximum(found, 0) if corrected else found

    def substep(_: int, p: Field) -> Field:
        return (p + moved(moved(p))) / 2

    # with more than MOST sub-steps needed, none is made and the result is NaN
    return jax.lax.fori_loop(0, jnp.where(count > MOST, 0, count) if most is None else most, substep, probability)


def _moved(on: Discretisation, stays: Field, moves: Rates, p: Field) -> Field:
    """The probabilities after at most one jump of the chain."""
    return sum(moves.products(on.grid, p), start=stays * p)


def cells(on: Discretisation) -> Array:
    """The cell of every node for the law of the chain, shape (*grid), in the units of the states.

    Noise that depends on the control is evaluated at zero control.
    """
    grid, sizes = on.grid, on.grid.volumes()
    m = 0 if on.problem.controls is None else on.problem.controls.dim
    noise = on.diffusion([jnp.zeros((), on.dtype)] * m)
    for axis in range(grid.ndim):
        still = stencil.walls(grid, axis) & ~(known(noise.get((axis, axis), 0.0)) > 0)
        sizes = sizes * (1 + still)  # whole cells
    return sizes


# --- moments ---


def mean(grid: Grid, probability: Field) -> State:
    """The mean, shape (n,), of probabilities of sum one."""
    return jnp.stack([_mean_along(grid, axis, _marginal(probability, axis)) for axis in range(grid.ndim)])


def covariance(grid: Grid, probability: Field) -> jax.Array:
    """The covariance about the mean, shape (n, n), of probabilities of sum one."""
    center = mean(grid, probability)
    off = [_difference(grid, axis, center[axis], probability.dtype) for axis in range(grid.ndim)]
    entries = {(i, j): jnp.sum(probability * off[i] * off[j]) for i in range(grid.ndim) for j in range(i, grid.ndim)}
    return jnp.stack([jnp.stack([entries[min(i, j), max(i, j)] for j in range(grid.ndim)]) for i in range(grid.ndim)])


def mode(grid: Grid, density: Field) -> State:
    """The first node at which a density is largest, shape (n,)."""
    index = jnp.unravel_index(jnp.argmax(density), grid.shape)
    return jnp.stack([jnp.asarray(grid.axis(axis, density.dtype), density.dtype)[i] for axis, i in enumerate(index)])


def _marginal(probability: Field, axis: int) -> jax.Array:
    """The probabilities of the nodes along one axis, shape (N,)."""
    return jnp.sum(probability, axis=tuple(i for i in range(probability.ndim) if i != axis))


def _mean_along(grid: Grid, axis: int, probability: jax.Array) -> jax.Array:
    dtype = probability.dtype
    x = jnp.asarray(grid.axis(axis, dtype), dtype)
    if not grid.periodic[axis]:
        return probability @ x
    lo, hi = jnp.asarray(grid.lo[axis], dtype), jnp.asarray(grid.hi[axis], dtype)
    angle = 2 * np.pi * (x - lo) / (hi - lo)
    turn = jnp.arctan2(probability @ jnp.sin(angle), probability @ jnp.cos(angle)) / (2 * np.pi)
    place = lo + (hi - lo) * jnp.mod(turn, 1)
    return jnp.where(place >= hi, lo, place)  # an angle just below zero can round up to a whole turn


def _difference(grid: Grid, axis: int, center: jax.Array, dtype: np.dtype) -> jax.Array:
    """x − mean along one axis, the short way round a periodic one; broadcasts over the nodes."""
    off = grid.components(dtype)[axis] - center
    if not grid.periodic[axis]:
        return off
    length = jnp.asarray(grid.hi[axis], dtype) - jnp.asarray(grid.lo[axis], dtype)
    return jnp.mod(off + length / 2, length) - length / 2
