"""Nodes where the system can rest at no cost, which close an undiscounted problem, and whether leaving them pays.

At a node where some action has f = 0, L = 0 and no noise the run may stay for ever and pay nothing: V ≤ 0 there.
Where no path can earn anything V = 0, and the node is held at it like a target. Where some can (a negative exit cost,
a negative running cost elsewhere), leaving may be better: whether it is, the answer with held rest nodes tells.

"No cost" and "no motion" mean: less than rounding beside the largest cost and beside the largest speed on the grid,
each in its own unit.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import jump_rates
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.iteration import bellman
from hjbjax.iteration.bellman import Obstacles
from hjbjax.problem import sets
from hjbjax.problem.pytree import altered
from hjbjax.problem.sets import AdmissibleSet
from hjbjax.problem.types import Field, Mask, Numbers, Scalar

ROUNDINGS = 8  # units of eps: sin π, in float32 as well, times what it is multiplied with
GAIN = 64  # units of eps of Q max|V|: a smaller gain of leaving is rounding


class Standstill(NamedTuple):
    """The nodes where the system can rest, and the scales of cost and time that tell it.

    Attributes:
      rests: bool (*grid).
      least: the least running cost at every node, (*grid).
      crossing: the time that the fastest motion takes from end to end of the box, all axes after one another; a number.
    """

    rests: Mask
    least: Field
    crossing: Scalar


def standstill(on: Discretisation) -> Standstill:
    """The nodes where the system can rest at no cost, up to rounding: sin π is not zero in floating point.

    With slopes ±s, s_i = max L/max|f_i|, the Hamiltonian is L + Σ s_i |f_i|: its minimum vanishes at rest alone.
    """
    grid, dtype = on.grid, on.dtype
    least = _least_cost(on)
    speeds, dearest = _scales(on)
    cost = jnp.max(jnp.where(jnp.isfinite(least), jnp.abs(least), 0))  # infinite where a constrained end leaves none
    # the least cost may be zero everywhere: then the dearest action sets the scale, and without any cost one does
    cost = jnp.where(cost > 0, cost, jnp.where(dearest > 0, dearest, 1))
    # an axis along which nothing moves puts no condition on rest
    speeds = jnp.where(speeds > 0, speeds, 1)
    # s_i = max L/max|f_i| puts costs and all speeds into one unit, so that none drowns in the rounding of another
    effort, u, d = optimum.optimise(discrete.at_rest(on, cost / speeds))
    small = ROUNDINGS * jnp.finfo(dtype).eps
    # of the action that was found, not of all: the minimum is at rest where any action is
    rests = (jnp.abs(effort) <= small * cost) & (jnp.abs(least) <= small * cost)
    for axis, speed in enumerate(_noise_speeds(on, u, d)):
        rests &= speed <= small * speeds[axis]
    # axes one after another: an upper bound, whichever way the motion turns
    extents = jnp.stack([jnp.asarray(grid.hi[axis] - grid.lo[axis], dtype) for axis in range(grid.ndim)])
    return Standstill(rests, least, jnp.sum(extents / speeds))


def _least_cost(on: Discretisation) -> Field:
    """The least running cost at every node, in a game that of both players' best actions, (*grid)."""
    if not on.grid.sides("constrained"):  # else the drift tells which actions there are
        on = on.asking(altered(on.problem, drift=_nowhere, noise=None))
    # at V = 0 the Hamiltonian is L alone
    return optimum.optimise(discrete.around(on, jnp.zeros(on.grid.shape, on.dtype)))[0]


def _nowhere(x: jax.Array, *actions: jax.Array) -> jax.Array:
    """No drift."""
    return jnp.zeros_like(x)


def _noise_speeds(on: Discretisation, u: list, d: list) -> list[jax.Array]:
    """a_ii/h_i along every axis: the speed at which noise leaves a node, correlated noise included."""
    a, none = on.diffusion(u, d), jnp.zeros((), on.dtype)
    return [a.get((axis, axis), none) / on.grid.spacing(axis) for axis in range(on.grid.ndim)]


def _scales(on: Discretisation) -> tuple[jax.Array, jax.Array]:
    """The largest speed along every axis, drift or noise, shape (n,), and the largest |L|, over nodes and actions."""
    grid, dtype = on.grid, on.dtype

    def rows(admissible: AdmissibleSet | None) -> jax.Array:
        return jnp.stack(
            [jnp.stack(action) if action else jnp.zeros(0, dtype) for action in sets.probes(admissible, dtype)]
        )

    us, ds = rows(on.problem.controls), rows(on.problem.disturbances)
    pairs = jnp.stack(jnp.meshgrid(jnp.arange(len(us)), jnp.arange(len(ds)), indexing="ij"), -1).reshape(-1, 2)

    def largest(entry: Numbers) -> Scalar:
        return jnp.max(jnp.abs(jnp.broadcast_to(jnp.asarray(entry, dtype), grid.shape)))

    def look(found: tuple, pair: jax.Array) -> tuple:
        # or XLA hoists what does not depend on the pair and keeps an array of all nodes for each of it
        x, (u, d) = jax.lax.optimization_barrier((on.coordinates(), (list(us[pair[0]]), list(ds[pair[1]]))))
        f, spread = on.drift(u, d, x), _noise_speeds(on, u, d)
        speeds = jnp.stack([largest(jnp.abs(drift) + noise) for drift, noise in zip(f, spread, strict=True)])
        cost = largest(on.running_cost(u, d, x))
        return (jnp.maximum(found[0], speeds), jnp.maximum(found[1], cost)), None

    start = (jnp.zeros(grid.ndim, dtype), jnp.zeros((), dtype))
    return jax.lax.scan(look, start, pairs)[0]


def leaving_pays(on: Discretisation, obstacles: Obstacles, counted: Mask, value: Field) -> jax.Array:
    """The held rest nodes at which some action has L + Σ_o c_o (V(x + o) − V(x)) < 0, bool (*grid).

    With none of them the value with held rest nodes solves the problem in which they may be left, too.
    """
    # fixed nodes are targets, nodes out of reach and rest nodes; only of these the value is in doubt
    rests = obstacles.fixed & counted & ~jnp.asarray(obstacles.ended)
    # not held for this look: the defect at a rest node is the gain of its best action
    policy = bellman.greedy(on, value, obstacles.fixed & ~rests)
    u, d = list(policy.controls), list(policy.disturbances)
    leaving = jump_rates(on, u, d).total()
    cost = jnp.max(jnp.abs(on.running_cost(u, d)))
    size = jnp.max(jnp.where(counted, jnp.abs(value), 0))
    return rests & (policy.defect < -GAIN * jnp.finfo(value.dtype).eps * (leaving * size + cost))


def release(obstacles: Obstacles, pays: Mask) -> Obstacles:
    """The obstacles with the nodes ``pays`` no longer held: there the run may rest, V ≤ 0, or leave."""
    # V ≤ 0 as a stopping cost of zero, which is what resting for ever amounts to
    stop = jnp.where(pays, 0, jnp.inf)
    stop = stop if obstacles.upper is None else jnp.minimum(stop, obstacles.upper)
    return bellman.Obstacles(obstacles.fixed & ~pays, obstacles.fixed_value, stop, obstacles.lower, obstacles.ended)
