"""Nodes where the system can rest at no cost, which close an undiscounted problem, and the gain of leaving them.

If some action has f = 0, L = 0 and no noise at a node, the run may stay there indefinitely and pay nothing, so V ≤ 0.
If no path can earn anything, V = 0 and the node is fixed at zero like a target. If some path can (a negative exit cost,
a negative running cost elsewhere), leaving may be better; the value computed with fixed rest nodes decides.

"No cost" and "no motion" mean less than rounding relative to the largest cost and the largest speed on the grid.
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

ROUNDINGS = 8  # units of eps: sin π, also in float32, times its factor
GAIN = 64  # units of eps of Q max|V|: a smaller gain from leaving is rounding


class Standstill(NamedTuple):
    """The nodes where the system can rest, and the scales of cost and time used to decide this.

    Attributes:
      rests: bool (*grid).
      least: the least running cost at every node, (*grid).
      crossing: the time of the fastest motion through the box along all axes, one after the other; a number.
    """

    rests: Mask
    least: Field
    crossing: Scalar


def standstill(on: Discretisation) -> Standstill:
    """The nodes where the system can rest at no cost, up to rounding, since sin π is not zero in floating point.

    With slopes ±s, s_i = max L/max|f_i|, the Hamiltonian is L + Σ s_i |f_i|, which vanishes only at rest.
    """
    grid, dtype, layout = on.grid, on.dtype, on.grid.layout
    least = _least_cost(on)
    speeds, dearest = _scales(on)
    # the least cost is infinite if a constrained end admits no action
    cost = layout.largest(jnp.where(jnp.isfinite(least), jnp.abs(least), 0))
    # if the least cost is zero everywhere, the most expensive action sets the scale; without any cost the scale is one
    cost = jnp.where(cost > 0, cost, jnp.where(dearest > 0, dearest, 1))
    # an axis without motion imposes no condition
    speeds = jnp.where(speeds > 0, speeds, 1)
    # s_i = max L/max|f_i| brings costs and speeds to one unit, so rounding in one does not hide another
    effort, u, d = optimum.optimise(discrete.at_rest(on, cost / speeds))
    small = ROUNDINGS * jnp.finfo(dtype).eps
    # checking the optimal action is enough: the minimum is at rest wherever any action is
    rests = (jnp.abs(effort) <= small * cost) & (jnp.abs(least) <= small * cost)
    for axis, speed in enumerate(_noise_speeds(on, u, d)):
        rests &= speed <= small * speeds[axis]
    for rate in (*on.mode_rates(u, d), *on.intensities(u, d)):  # in another mode, or after a jump, it may move
        rests &= rate == 0
    # axes one after another: an upper bound for any direction of motion
    extents = jnp.stack([jnp.asarray(grid.hi[axis] - grid.lo[axis], dtype) for axis in grid.state_axes])
    speeds = speeds[1:] if grid.modes else speeds
    return Standstill(rests, least, jnp.sum(extents / speeds))


def _least_cost(on: Discretisation) -> Field:
    """The least running cost at every node, in a game for both players' best actions, (*grid)."""
    if not on.grid.sides("constrained"):  # otherwise the admissible actions depend on the drift
        on = on.asking(altered(on.problem, drift=_nowhere, noise=None))
    # at V = 0 the Hamiltonian is L
    return optimum.optimise(discrete.around(on, jnp.zeros(on.grid.shape, on.dtype)))[0]


def _nowhere(x: jax.Array, *actions: jax.Array) -> jax.Array:
    """Zero drift."""
    return jnp.zeros_like(x)


def _noise_speeds(on: Discretisation, u: list, d: list) -> list[jax.Array]:
    """a_ii/h_i along every axis: the speed at which noise leaves a node, including correlated noise."""
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
        return grid.layout.largest(jnp.abs(jnp.broadcast_to(jnp.asarray(entry, dtype), grid.shape)))

    def look(found: tuple, pair: jax.Array) -> tuple:
        # otherwise XLA hoists terms that do not depend on the pair and keeps an array of all nodes for each
        x, (u, d) = jax.lax.optimization_barrier((on.coordinates(), (list(us[pair[0]]), list(ds[pair[1]]))))
        f, spread = on.drift(u, d, x), _noise_speeds(on, u, d)
        speeds = jnp.stack([largest(jnp.abs(drift) + noise) for drift, noise in zip(f, spread, strict=True)])
        cost = largest(on.running_cost(u, d, x))
        return (jnp.maximum(found[0], speeds), jnp.maximum(found[1], cost)), None

    start = (jnp.zeros(grid.ndim, dtype), jnp.zeros((), dtype))
    return jax.lax.scan(look, start, pairs)[0]


def leaving_pays(on: Discretisation, obstacles: Obstacles, counted: Mask, value: Field) -> jax.Array:
    """The fixed rest nodes at which some action has L + Σ_o c_o (V(x + o) − V(x)) < 0, bool (*grid).

    If there are none, the value with fixed rest nodes also solves the problem in which they may be left.
    """
    # fixed nodes are targets, unreachable nodes and rest nodes; only for rest nodes the value is in doubt
    rests = obstacles.fixed & counted & ~jnp.asarray(obstacles.ended)
    # not fixed in this evaluation: the defect at a rest node is the gain of its best action
    policy = bellman.greedy(on, value, obstacles.fixed & ~rests)
    u, d = list(policy.controls), list(policy.disturbances)
    leaving = jump_rates(on, u, d).total()
    cost = jnp.max(jnp.abs(on.running_cost(u, d)))
    size = jnp.max(jnp.where(counted, jnp.abs(value), 0))
    return rests & (policy.defect < -GAIN * jnp.finfo(value.dtype).eps * (leaving * size + cost))


def release(obstacles: Obstacles, pays: Mask) -> Obstacles:
    """The obstacles without the fixed nodes ``pays``, where the run may now rest, V ≤ 0, or leave."""
    # V ≤ 0 as a stopping cost of zero, which is the value of resting indefinitely
    stop = jnp.where(pays, 0, jnp.inf)
    stop = stop if obstacles.upper is None else jnp.minimum(stop, obstacles.upper)
    return bellman.Obstacles(obstacles.fixed & ~pays, obstacles.fixed_value, stop, obstacles.lower, obstacles.ended)
