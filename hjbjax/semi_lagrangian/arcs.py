"""Arcs: pieces of paths along the drift, and the Markov chain with long jumps that they define.

An arc leaves a node under a constant action u for some time τ. Let y be its path and β the discount. Its cost is

    Q = ∫₀^τ e^{−βs} L(y, u) ds + e^{−βτ} I[V](y(τ)),

where I[V] is the multilinear interpolant, whose weights are non-negative and sum to one. If the path meets the target
at a time τ' < τ, the arc ends there, and the exit cost, discounted by e^{−βτ'}, replaces V. The minimum of Q over arcs
is a Bellman operator: monotone, and a contraction by the largest e^{−βτ}.

A path consists of legs. Each leg takes the time to cross one cell at its initial speed (see ``SLOWEST``) and is one
step of the classical fourth-order Runge–Kutta method. If the target's l changes sign on a leg, the secant gives the
time of the crossing and Hermite's cubic the position. At an end of the box the outward component of a path is cut off,
like projected drift.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.paths import Plan
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.stretching import into_period
from hjbjax.problem.types import AtNodes, Mask, Number, Scalar
from hjbjax.tracing import components

# fraction of the greatest speed on the grid. A slower leg takes as long as a leg at this speed, because near a rest
# point crossing a cell could take arbitrarily long.
SLOWEST = 0.1


@pytree_dataclass()
class Arcs:
    """The K arcs from every node, as jumps of a chain. All arrays are (K, *grid), or (*grid) for one arc per node.

    Args:
      pay: the discounted running cost along the arc, plus the exit cost if it ends on the target; cost units.
      keep: e^{−βτ}, the weight of V at the end of the arc; zero on the target.
      cell: the lowest corner of the cell in which it ends, as an index into the array of ``widened``.
      fractions: the position in that cell along each of the n axes, from 0 to 1.
      running: the running cost without the exit cost, if the certificate requires it; else None.
    """

    pay: jax.Array
    keep: jax.Array
    cell: jax.Array
    fractions: tuple[jax.Array, ...]
    running: jax.Array | None = None

    @property
    def count(self) -> int:
        """The number of arcs K."""
        return self.pay.shape[0]

    def one(self, k: Scalar) -> "Arcs":
        """The arcs with number k from all nodes."""
        return jax.tree.map(lambda entry: jax.lax.dynamic_index_in_dim(entry, k, keepdims=False), self)

    def chosen(self, number: AtNodes) -> "Arcs":
        """Select one arc per node by its number, integers (*grid)."""
        return jax.tree.map(lambda entry: jnp.take_along_axis(entry, number[None], axis=0)[0], self)

    def worth(self, value: jax.Array, grid: Grid) -> jax.Array:
        """Q of one arc per node, (*grid), for V as returned by ``widened``."""
        return self.pay + self.keep * self.read(value, grid)

    def read(self, value: jax.Array, grid: Grid) -> jax.Array:
        """I[V] at the end of one arc per node, (*grid), for V as returned by ``widened``."""
        strides = _strides(grid)

        def along(axis: int, cell: jax.Array) -> jax.Array:
            if axis == grid.ndim:
                return value[cell]
            below, above = along(axis + 1, cell), along(axis + 1, cell + strides[axis])
            return below + self.fractions[axis] * (above - below)

        return along(0, self.cell)


def widened(value: AtNodes, grid: Grid) -> jax.Array:
    """Flat node values; the first node of a periodic axis is repeated at its end, so every cell has all corners."""
    for axis in range(grid.ndim):
        if grid.periodic[axis]:
            first = jax.lax.slice_in_dim(value, 0, 1, axis=axis)
            value = jnp.concatenate([value, first], axis=axis)
    return value.reshape(-1)


def trace(on: Discretisation, plan: Plan, held: Mask, *, running: bool) -> Arcs:
    """The arcs of a plan from all nodes. Arcs from ``held`` nodes, bool (*grid), cost nothing and do not move.

    ``running``: True to store the running cost separately.
    """
    slowest = SLOWEST * _fastest(on, plan)
    start = [jnp.broadcast_to(x, on.grid.shape) for x in on.coordinates()]
    level = None if on.problem.target is None else on.level
    further = jnp.diff(jnp.asarray(plan.legs), prepend=0)

    def under(action: jax.Array) -> Arcs:
        u = [action[j] for j in range(action.shape[0])]

        def longer(path: ArcPath, count: Scalar) -> tuple[ArcPath, Arcs]:
            # the next longer arc continues where this one ends
            path = jax.lax.fori_loop(0, count, lambda _, path: leg(on, path, u, slowest), path)
            return path, _as_jumps(on, path, held, running=running)

        # keep XLA from hoisting tables of all nodes out of the loop over actions
        places, signs = jax.lax.optimization_barrier((start, level))
        zero = jnp.zeros(on.grid.shape, on.dtype)
        return jax.lax.scan(longer, ArcPath(places, zero, zero, signs, jnp.asarray(held)), further)[1]

    found = jax.lax.map(under, jnp.asarray(plan.actions))  # (A, R, *grid)
    return jax.tree.map(lambda entry: entry.reshape(-1, *on.grid.shape), found)


def trace_chosen(on: Discretisation, plan: Plan, number: AtNodes, held: Mask) -> Arcs:
    """The arc of a plan selected by ``number`` at each node; differentiable.

    The legs are the same as in ``trace``, but in a loop of fixed length, as reverse-mode derivatives require.
    """
    count = len(plan.legs)
    u = [jnp.asarray(plan.actions)[number // count, j] for j in range(np.shape(plan.actions)[1])]
    legs = jnp.asarray(plan.legs)[number % count]
    slowest = SLOWEST * _fastest(on, plan)

    def further(path: ArcPath, done: Scalar) -> tuple[ArcPath, None]:
        moved = leg(on, path, u, slowest)
        return jax.tree.map(lambda new, old: jnp.where(done < legs, new, old), moved, path), None

    start = [jnp.broadcast_to(x, on.grid.shape) for x in on.coordinates()]
    level = None if on.problem.target is None else on.level
    zero = jnp.zeros(on.grid.shape, on.dtype)
    path = ArcPath(start, zero, zero, level, jnp.asarray(held))
    path = jax.lax.scan(further, path, jnp.arange(int(np.max(plan.legs))))[0]
    return _as_jumps(on, path, held, running=False)


class ArcPath(NamedTuple):
    """Paths: position, time and discounted cost so far, l at the position, and True if the path has ended."""

    x: list[jax.Array]
    time: jax.Array
    cost: jax.Array
    level: jax.Array | None
    ended: jax.Array


def _as_jumps(on: Discretisation, path: ArcPath, held: Mask, *, running: bool) -> Arcs:
    """Convert complete paths to jumps of the chain."""
    grid, problem = on.grid, on.problem
    weight, pay = jnp.exp(-problem.discount * path.time), path.cost
    if problem.target is not None:
        paid = components.of_state(problem, problem.exit_cost, path.x, on.t, on.dtype)
        # outside the target the exit cost is irrelevant and may be NaN
        pay = jnp.where(path.ended & ~held, pay + weight * jnp.where(path.ended, paid, 0), pay)
        weight = jnp.where(path.ended, 0, weight)
    cell = jnp.zeros(grid.shape, jnp.int32)
    fractions: list[jax.Array] = []
    for axis, stride in enumerate(_strides(grid)):
        lower, fraction, _ = grid._locate(axis, path.x[axis])
        cell, fractions = cell + stride * lower.astype(jnp.int32), [*fractions, fraction]
    return Arcs(pay, weight, cell, tuple(fractions), path.cost if running else None)


def leg(on: Discretisation, path: ArcPath, u: list[jax.Array], slowest: Scalar) -> ArcPath:
    """Advance the paths by one leg under an action, stopping at the target; paths that have ended stay."""
    grid, x, beta = on.grid, path.x, on.problem.discount
    shape = jnp.shape(x[0])

    def drift(places: list[jax.Array]) -> list[jax.Array]:
        return [jnp.broadcast_to(f, shape) for f in on.drift(u, [], places)]

    f1 = drift(x)
    length = 1 / jnp.maximum(speed(grid, x, f1), slowest)  # time to cross one cell
    f2 = drift(_moved(grid, x, f1, length / 2))
    f3 = drift(_moved(grid, x, f2, length / 2))
    f4 = drift(_moved(grid, x, f3, length))
    mean = [(a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(f1, f2, f3, f4, strict=True)]

    def at(share: Number | jax.Array) -> list[jax.Array]:
        """The position after a fraction of the leg, by Hermite's cubic from f at both ends."""
        rises = share * share * (3 - 2 * share), share * (1 - share) ** 2, share * share * (share - 1)
        ends = zip(mean, f1, f4, strict=True)
        steps: list[Any] = [rises[0] * m + rises[1] * a + rises[2] * b for m, a, b in ends]
        return _moved(grid, x, steps, length)

    share, ended, level = jnp.ones(shape, on.dtype), path.ended, path.level
    if level is not None:
        beyond = components.of_state(on.problem, on.problem.target, at(1.0), on.t, on.dtype)
        beyond = jnp.broadcast_to(beyond, shape)
        meets = (level > 0) & (beyond <= 0) & ~ended
        # the inner where keeps the quotient finite on legs that do not cross the target
        share = jnp.where(meets, level / jnp.where(meets, level - beyond, 1), 1)
        ended, level = ended | meets, beyond
    middle, end = at(share / 2), at(share)
    lasts = jnp.where(path.ended, 0, share * length)
    # Simpson's rule for L; the discount is integrated exactly, so a constant L costs L (1 − e^{−βτ})/β
    mean_cost = (on.running_cost(u, [], x) + 4 * on.running_cost(u, [], middle) + on.running_cost(u, [], end)) / 6
    safe = jnp.where(beta > 0, beta, 1)
    weight = jnp.exp(-beta * path.time) * jnp.where(beta > 0, -jnp.expm1(-beta * lasts) / safe, lasts)
    stays = [jnp.where(path.ended, before, after) for before, after in zip(x, end, strict=True)]
    cost = path.cost + jnp.where(path.ended, 0, weight * mean_cost)
    return ArcPath(stays, path.time + lasts, cost, level, ended)


def _moved(grid: Grid, x: Sequence[jax.Array], f: Sequence[jax.Array], time: jax.Array) -> list[jax.Array]:
    """x + time · f, clipped to the box, or wrapped on periodic axes."""
    found = []
    for axis, (place, velocity) in enumerate(zip(x, f, strict=True)):
        lo, hi = jnp.asarray(grid.lo[axis], place.dtype), jnp.asarray(grid.hi[axis], place.dtype)
        place = place + time * velocity
        if grid.periodic[axis]:
            found.append(into_period(place, lo, hi))
        else:
            found.append(jnp.clip(place, lo, hi))
    return found


def speed(grid: Grid, x: Sequence[jax.Array], f: Sequence[jax.Array]) -> jax.Array:
    """The largest number of cells per unit time over the axes."""
    most = jnp.zeros((), f[0].dtype)
    for axis, (place, velocity) in enumerate(zip(x, f, strict=True)):
        width: Number | jax.Array = grid.spacing(axis)
        if grid.stretch[axis] is not None:
            width = jnp.diff(jnp.asarray(grid.axis(axis), place.dtype))[grid._locate(axis, place)[0]]
        most = jnp.maximum(most, jnp.abs(velocity) / width)
    return most


def _fastest(on: Discretisation, plan: Plan) -> Scalar:
    """The greatest speed at the nodes under the actions of a plan, in cells per unit time; one if nothing moves."""
    x = [jnp.broadcast_to(place, on.grid.shape) for place in on.coordinates()]

    def largest(action: jax.Array) -> Scalar:
        u = [action[j] for j in range(action.shape[0])]
        f = [jnp.broadcast_to(entry, on.grid.shape) for entry in on.drift(u, [], x)]
        return jnp.max(speed(on.grid, x, f))

    most = jnp.max(jax.lax.map(largest, jnp.asarray(plan.actions)))
    return jnp.where(most > 0, most, 1)


def _strides(grid: Grid) -> list[int]:
    """The distance between two neighbours along every axis, in entries of the array of ``widened``."""
    counts = [count + bool(around) for count, around in zip(grid.shape, grid.periodic, strict=True)]
    return [int(np.prod(counts[axis + 1 :], dtype=np.int64)) for axis in range(grid.ndim)]
