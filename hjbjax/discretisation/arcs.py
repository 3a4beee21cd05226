"""Arcs: pieces of path along the drift, and the Markov chain with long jumps that they make of V.

An arc leaves a node under an action u that is held, for some time τ. With y its path and β the discount it is worth

    Q = ∫₀^τ e^{−βs} L(y, u) ds + e^{−βτ} I[V](y(τ)),

I[V] the multilinear interpolant, whose weights are not negative and sum to one; where the path comes to the target
before, at the time τ' < τ, the exit cost there, discounted by e^{−βτ'}, takes the place of V, and the rest is left out.
So min over arcs of Q is a Bellman operator: monotone, and a contraction by the largest e^{−βτ}.

A path goes in legs, each long enough for one cell at the speed at which it sets out, by the Runge–Kutta method of order
4. Where the target's l changes sign on a leg, the time is that of its secant, the place that of Hermite's cubic. At an
end of the box a component that would leave is cut off, as by projection of the drift; a periodic axis has no end.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import cut_cells
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.stretching import into_period
from hjbjax.problem.types import Array, AtNodes, Mask, Number, Scalar
from hjbjax.tracing import components

# of the greatest speed on the grid: where an action moves the state more slowly, a leg takes no longer than at this
# one, since near a rest point a cell would take any time and the action be held for as long
SLOWEST = 0.1


@pytree_dataclass()
class Plan:
    """The arcs that are tried from every node: every action for every length.

    Args:
      actions: (A, m).
      legs: the lengths of arcs, integers that rise, (R,).
    """

    actions: Array
    legs: Array

    @property
    def count(self) -> int:
        """K = A R: the arcs of the first action, by their lengths, then those of the next."""
        return len(self.actions) * len(self.legs)


@pytree_dataclass()
class Arcs:
    """The K arcs from every node, as jumps of a chain; all entries (K, *grid), or (*grid) for one arc a node.

    Args:
      pay: the running cost on the way, and the exit cost where the arc ends on the target, discounted; cost units.
      keep: e^{−βτ}, the weight of V where the arc ends; zero where that is the target.
      cell: the lowest corner of the cell in which it ends, its number in the array of ``widened``.
      fractions: how far into that cell it goes along every axis, n of them, from 0 to 1.
      running: the running cost on the way alone, where the certificate asks for it; else None.
    """

    pay: jax.Array
    keep: jax.Array
    cell: jax.Array
    fractions: tuple[jax.Array, ...]
    running: jax.Array | None = None

    @property
    def count(self) -> int:
        """K."""
        return self.pay.shape[0]

    def one(self, k: Scalar) -> "Arcs":
        """The arcs with the number k from all nodes."""
        return jax.tree.map(lambda entry: jax.lax.dynamic_index_in_dim(entry, k, keepdims=False), self)

    def chosen(self, number: AtNodes) -> "Arcs":
        """For each node the arc of the number that stands there, integers (*grid)."""
        return jax.tree.map(lambda entry: jnp.take_along_axis(entry, number[None], axis=0)[0], self)

    def worth(self, value: jax.Array, grid: Grid) -> jax.Array:
        """Q of one arc a node for V as ``widened`` gives it, (*grid)."""
        return self.pay + self.keep * self.read(value, grid)

    def read(self, value: jax.Array, grid: Grid) -> jax.Array:
        """I[V] where one arc a node ends, (*grid), for V as ``widened`` gives it."""
        strides = _strides(grid)

        def along(axis: int, cell: jax.Array) -> jax.Array:
            if axis == grid.ndim:
                return value[cell]
            below, above = along(axis + 1, cell), along(axis + 1, cell + strides[axis])
            return below + self.fractions[axis] * (above - below)

        return along(0, self.cell)


def widened(value: AtNodes, grid: Grid) -> jax.Array:
    """Node values, flat, the first of a periodic axis again behind its last ones: every cell has all its corners."""
    for axis in range(grid.ndim):
        if grid.periodic[axis]:
            first = jax.lax.slice_in_dim(value, 0, 1, axis=axis)
            value = jnp.concatenate([value, first], axis=axis)
    return value.reshape(-1)


def trace(on: Discretisation, plan: Plan, held: Mask, *, running: bool) -> Arcs:
    """The arcs of a plan from all nodes; those from ``held`` ones, bool (*grid), are worth nothing and stay.

    ``running``: keep the running cost apart.
    """
    slowest = SLOWEST * _fastest(on, plan)
    start = [jnp.broadcast_to(x, on.grid.shape) for x in on.coordinates()]
    level = None if on.problem.target is None else cut_cells.level(on)
    further = jnp.diff(jnp.asarray(plan.legs), prepend=0)

    def under(action: jax.Array) -> Arcs:
        u = [action[j] for j in range(action.shape[0])]

        def longer(path: Path, count: Scalar) -> tuple[Path, Arcs]:
            # the next longer arc goes on where this one ends
            path = jax.lax.fori_loop(0, count, lambda _, path: leg(on, path, u, slowest), path)
            return path, _as_jumps(on, path, held, running=running)

        # a loop over actions must not hoist tables of all nodes out of itself
        places, signs = jax.lax.optimization_barrier((start, level))
        zero = jnp.zeros(on.grid.shape, on.dtype)
        return jax.lax.scan(longer, Path(places, zero, zero, signs, jnp.asarray(held)), further)[1]

    found = jax.lax.map(under, jnp.asarray(plan.actions))  # (A, R, *grid)
    return jax.tree.map(lambda entry: entry.reshape(-1, *on.grid.shape), found)


def trace_chosen(on: Discretisation, plan: Plan, number: AtNodes, held: Mask) -> Arcs:
    """One arc of a plan per node, that with the number which ``number`` has there; differentiable.

    The legs are those of ``trace``, in a loop of fixed length, which reverse-mode derivatives require.
    """
    count = len(plan.legs)
    u = [jnp.asarray(plan.actions)[number // count, j] for j in range(np.shape(plan.actions)[1])]
    legs = jnp.asarray(plan.legs)[number % count]
    slowest = SLOWEST * _fastest(on, plan)

    def further(path: Path, done: Scalar) -> tuple[Path, None]:
        moved = leg(on, path, u, slowest)
        return jax.tree.map(lambda new, old: jnp.where(done < legs, new, old), moved, path), None

    start = [jnp.broadcast_to(x, on.grid.shape) for x in on.coordinates()]
    level = None if on.problem.target is None else cut_cells.level(on)
    zero = jnp.zeros(on.grid.shape, on.dtype)
    path = Path(start, zero, zero, level, jnp.asarray(held))
    path = jax.lax.scan(further, path, jnp.arange(int(np.max(plan.legs))))[0]
    return _as_jumps(on, path, held, running=False)


class Path(NamedTuple):
    """Paths: where they are, their time and discounted cost so far, l there, and whether they ended."""

    x: list[jax.Array]
    time: jax.Array
    cost: jax.Array
    level: jax.Array | None
    ended: jax.Array


def _as_jumps(on: Discretisation, path: Path, held: Mask, *, running: bool) -> Arcs:
    """Paths that have come to their end, as jumps of the chain."""
    grid, problem = on.grid, on.problem
    weight, pay = jnp.exp(-problem.discount * path.time), path.cost
    if problem.target is not None:
        paid = components.of_state(problem, problem.exit_cost, path.x, on.t, on.dtype)
        # off the target an exit cost says nothing, and may be no number
        pay = jnp.where(path.ended & ~held, pay + weight * jnp.where(path.ended, paid, 0), pay)
        weight = jnp.where(path.ended, 0, weight)
    cell = jnp.zeros(grid.shape, jnp.int32)
    fractions: list[jax.Array] = []
    for axis, stride in enumerate(_strides(grid)):
        lower, fraction, _ = grid._locate(axis, path.x[axis])
        cell, fractions = cell + stride * lower.astype(jnp.int32), [*fractions, fraction]
    return Arcs(pay, weight, cell, tuple(fractions), path.cost if running else None)


def leg(on: Discretisation, path: Path, u: list[jax.Array], slowest: Scalar) -> Path:
    """The paths one leg further under an action, up to the target where they come to it; those that ended stay."""
    grid, x, beta = on.grid, path.x, on.problem.discount
    shape = jnp.shape(x[0])

    def drift(places: list[jax.Array]) -> list[jax.Array]:
        return [jnp.broadcast_to(f, shape) for f in on.drift(u, [], places)]

    f1 = drift(x)
    length = 1 / jnp.maximum(speed(grid, x, f1), slowest)  # seconds for one cell
    f2 = drift(_moved(grid, x, f1, length / 2))
    f3 = drift(_moved(grid, x, f2, length / 2))
    f4 = drift(_moved(grid, x, f3, length))
    mean = [(a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(f1, f2, f3, f4, strict=True)]

    def at(share: Number | jax.Array) -> list[jax.Array]:
        """The places after a share of the leg: Hermite's cubic, by f at both ends."""
        rises = share * share * (3 - 2 * share), share * (1 - share) ** 2, share * share * (share - 1)
        ends = zip(mean, f1, f4, strict=True)
        steps: list[Any] = [rises[0] * m + rises[1] * a + rises[2] * b for m, a, b in ends]
        return _moved(grid, x, steps, length)

    share, ended, level = jnp.ones(shape, on.dtype), path.ended, path.level
    if level is not None:
        beyond = components.of_state(on.problem, on.problem.target, at(1.0), on.t, on.dtype)
        beyond = jnp.broadcast_to(beyond, shape)
        meets = (level > 0) & (beyond <= 0) & ~ended
        # the inner where keeps the quotient finite on legs that do not meet it
        share = jnp.where(meets, level / jnp.where(meets, level - beyond, 1), 1)
        ended, level = ended | meets, beyond
    middle, end = at(share / 2), at(share)
    lasts = jnp.where(path.ended, 0, share * length)
    # Simpson's mean of L, under a discount that is integrated exactly, so that a constant L costs L (1 − e^{−βτ})/β
    mean_cost = (on.running_cost(u, [], x) + 4 * on.running_cost(u, [], middle) + on.running_cost(u, [], end)) / 6
    safe = jnp.where(beta > 0, beta, 1)
    weight = jnp.exp(-beta * path.time) * jnp.where(beta > 0, -jnp.expm1(-beta * lasts) / safe, lasts)
    stays = [jnp.where(path.ended, before, after) for before, after in zip(x, end, strict=True)]
    cost = path.cost + jnp.where(path.ended, 0, weight * mean_cost)
    return Path(stays, path.time + lasts, cost, level, ended)


def _moved(grid: Grid, x: Sequence[jax.Array], f: Sequence[jax.Array], time: jax.Array) -> list[jax.Array]:
    """x + time · f inside the box: cut off at its ends, round periodic axes."""
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
    """Cells per unit time along the axis on which that is most."""
    most = jnp.zeros((), f[0].dtype)
    for axis, (place, velocity) in enumerate(zip(x, f, strict=True)):
        width: Number | jax.Array = grid.spacing(axis)
        if grid.stretch[axis] is not None:
            width = jnp.diff(jnp.asarray(grid.axis(axis), place.dtype))[grid._locate(axis, place)[0]]
        most = jnp.maximum(most, jnp.abs(velocity) / width)
    return most


def _fastest(on: Discretisation, plan: Plan) -> Scalar:
    """The greatest speed at the nodes under the actions of a plan, cells per unit time; one where nothing moves."""
    x = [jnp.broadcast_to(place, on.grid.shape) for place in on.coordinates()]

    def largest(action: jax.Array) -> Scalar:
        u = [action[j] for j in range(action.shape[0])]
        f = [jnp.broadcast_to(entry, on.grid.shape) for entry in on.drift(u, [], x)]
        return jnp.max(speed(on.grid, x, f))

    most = jnp.max(jax.lax.map(largest, jnp.asarray(plan.actions)))
    return jnp.where(most > 0, most, 1)


def _strides(grid: Grid) -> list[int]:
    """The distance in the array of ``widened`` between two neighbours along every axis."""
    counts = [count + bool(around) for count, around in zip(grid.shape, grid.periodic, strict=True)]
    return [int(np.prod(counts[axis + 1 :], dtype=np.int64)) for axis in range(grid.ndim)]
