"""Interventions: jumps of the chain that the controller may make at once, at a cost.

A change of the mode leads to another mode, a push to the next node along an axis. With the offsets o and the costs c_o

    V(x) ≤ (M V)(x) = min_o [ c_o(x) + V(x + o) ].

Several interventions may follow each other, so a bound W at the nodes implies V ≤ W*, the cheapest of all paths of
interventions, W* = min(W, M W*). Changes of the mode form paths of at most k − 1 jumps. Pushes form paths across the
box; a scan of the lines of nodes, from the end to which the push leads, finds all paths along one direction. With
several directions the scans are repeated until nothing changes. W* then satisfies W* = c_o + W*(x + o) exactly, not up
to rounding, wherever an intervention is the best choice; certificates distinguish these nodes by equality.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import altered, pytree_dataclass
from hjbjax.problem.types import Field, Mask, Nodes

Offset = tuple[int, ...]
ROUNDING = 8  # units of eps in |c + V(x + o)| + |V(x + o)|: a smaller distance of V to c + V(x + o) is rounding


@pytree_dataclass(static=("offsets", "changes", "once"))
class Interventions:
    """Jumps at once and their costs at the nodes.

    Args:
      offsets: the jumps, one entry per axis: first the changes of the mode, then the pushes.
      costs: the cost of each, (*grid), in cost units; infinite where it is not possible.
      changes: the number of changes of the mode.
      once: True if one scan finds all paths: there is a single push, and its axis is not periodic.
    """

    offsets: tuple[Offset, ...] = ()
    costs: tuple[Field, ...] = ()
    changes: int = 0
    once: bool = False

    def __bool__(self) -> bool:
        return bool(self.offsets)

    @property
    def pushes(self) -> tuple[Offset, ...]:
        """The jumps that are pushes."""
        return self.offsets[self.changes :]

    @property
    def without_costs(self) -> "Interventions":
        """Only the jumps, without arrays."""
        return altered(self, costs=())

    def outside(self, held: Mask) -> "Interventions":
        """The interventions that are possible only outside of a set of nodes, bool (*grid), where paths have ended."""
        return altered(self, costs=tuple(jnp.where(held, jnp.inf, cost) for cost in self.costs))

    def avoiding(self, lost: Mask) -> "Interventions":
        """The interventions that do not lead to a set of nodes, bool (*grid)."""
        pairs = zip(self.offsets, self.costs, strict=True)
        return altered(self, costs=tuple(jnp.where(rolled(lost, o), jnp.inf, cost) for o, cost in pairs))

    def over(self, strides: Sequence[int]) -> "Interventions":
        """The interventions with pushes over several nodes, at the nodes of this grid; NumPy, at host level."""
        costs = [np.asarray(cost) for cost in self.costs]
        for k in range(self.changes, len(costs)):
            axis, step = _axis_and_step(self.offsets[k])
            costs[k] = np.sum([np.roll(costs[k], -i * step, axis) for i in range(strides[axis])], axis=0)
        return altered(self, costs=tuple(costs))

    def after(self, value: Nodes) -> list[Field]:
        """c_o + V(x + o) for every jump o, each (*grid)."""
        return [cost + rolled(value, offset) for offset, cost in zip(self.offsets, self.costs, strict=True)]

    def least(self, value: Nodes) -> Field:
        """M V, (*grid); only if there are interventions."""
        return functools.reduce(jnp.minimum, self.after(value))

    def cheapest(self, value: Field) -> Field:
        """V*, the least of ``value`` and its values after any path of interventions, (*grid)."""
        return _cheapest(self, value)

    def _paths(self, value: Field) -> Field:
        """V* without a derivative in reverse mode."""
        if not self.pushes:
            for _ in self.costs:  # a cheapest path of changes has at most k − 1 of them
                value = jnp.minimum(value, self.least(value))
            return value
        table = dict(zip(self.offsets, self.costs, strict=True))

        def change(value: Field, offset: Offset) -> Field:
            return jnp.minimum(value, table[offset] + rolled(value, offset))

        def push(value: Field, offset: Offset) -> Field:
            lines = (value, table[offset])
            return _swept(lambda ahead, own, cost: jnp.minimum(own, cost + ahead), lines, offset)

        return self._settled(value, change, push)

    def impose(self, value: Field) -> Field:
        """V*, and exact equality with the value after an intervention where V is closer to it than rounding."""
        eps, near = jnp.finfo(value.dtype).eps, jnp.zeros_like(value, bool)
        for offset, after in zip(self.offsets, self.after(value), strict=True):
            # the sizes of both terms, because their sum may be near zero
            size = jnp.abs(after) + jnp.abs(rolled(value, offset))
            near |= jnp.isfinite(size) & (after - value <= ROUNDING * eps * size)
        exact = self.cheapest(jnp.where(near, jnp.inf, value))  # along whole paths, each node from the next one
        return jnp.where(jnp.isfinite(exact), exact, value)

    def chosen(self, worth: Field, value: Field) -> list[jax.Array]:
        """The nodes of every intervention, if V is ``value`` and not intervening is ``worth``; bool (*grid) each.

        Following the interventions of a node leads to a node without any, since no round trip is free. A push is
        compared with V at the next node, or with the worth of that node if it is lower. Otherwise, if all nodes of a
        push region would gain by not pushing, each less than the next one, only the last one would leave the region.
        """
        bounds = self.after(self.cheapest(jnp.maximum(worth, value) if self.pushes else worth))
        left = functools.reduce(jnp.minimum, bounds, worth) < worth
        found = []
        for k, bound in enumerate(bounds):
            goes = left & functools.reduce(jnp.logical_and, (bound <= other for other in bounds[k + 1 :]), left)
            found.append(goes)
            left = left & ~goes
        return found

    def followed(self, goes: Sequence[Mask], source: Field, value: Field) -> Field:
        """``value`` with δ(x) = s(x) + δ(x + o) exactly at the nodes ``goes`` of every intervention o."""
        table = dict(zip(self.offsets, goes, strict=True))

        def change(value: Field, offset: Offset) -> Field:
            return jnp.where(table[offset], source + rolled(value, offset), value)

        def push(value: Field, offset: Offset) -> Field:
            lines = (value, source, table[offset])
            return _swept(lambda ahead, own, paid, go: jnp.where(go, paid + ahead, own), lines, offset)

        if self.pushes:
            return self._settled(value, change, push)
        for _ in self.offsets:  # the node that one intervention leads to may make another intervention
            for offset in self.offsets:
                value = change(value, offset)
        return value

    def _settled(self, value: Field, change: Callable, push: Callable) -> Field:
        """Changes and pushes along the lines of nodes, repeated until the value no longer changes."""

        def again(value: Field) -> Field:
            for offset in self.offsets[: self.changes]:
                value = change(value, offset)
            for offset in self.pushes:
                value = push(value, offset)
            return value

        if self.once:
            return again(value)
        most = sum(value.shape)  # ends the loop even if a round trip earns

        def step(carry: tuple[Field, Any, Any]) -> tuple[Field, Any, Any]:
            old, _, count = carry
            new = again(old)
            return new, jnp.any((new != old) & ~jnp.isnan(new)), count + 1

        start = value, jnp.ones((), bool), jnp.zeros((), jnp.int32)
        return jax.lax.while_loop(lambda carry: carry[1] & (carry[2] < most), step, start)[0]


@jax.custom_jvp
def _cheapest(known: Interventions, value: Field) -> Field:
    """``known.cheapest(value)``."""
    return known._paths(value)


@_cheapest.defjvp
def _cheapest_tangent(primals: Any, tangents: Any) -> tuple[Field, Field]:
    """V* and its tangent: that of V at the end of the path of interventions, plus those of the costs on the way.

    The paths are followed in a logarithmic number of steps, each twice as long as the one before: reverse mode cannot
    repeat scans until nothing changes.
    """
    (known, value), (dknown, dvalue) = primals, tangents
    best = known._paths(value)
    after = jnp.stack(known.after(best))
    goes, choice = best < value, jnp.argmin(after, axis=0)
    here = jnp.arange(value.size, dtype=jnp.int32).reshape(value.shape)
    ahead, paid = here, jnp.zeros_like(dvalue)
    for k, (offset, cost) in enumerate(zip(known.offsets, dknown.costs, strict=True)):
        takes = goes & (choice == k)
        ahead, paid = jnp.where(takes, rolled(here, offset), ahead), jnp.where(takes, cost, paid)
    ahead, paid = ahead.reshape(-1), paid.reshape(-1)
    for _ in range(value.size.bit_length()):
        ahead, paid = ahead[ahead], paid + paid[ahead]
    return best, (paid + dvalue.reshape(-1)[ahead]).reshape(value.shape)


def rolled(value: Nodes, offset: Offset) -> Field:
    """V(x + o) at every node; beyond an end it is the value at the other end, as on a periodic axis."""
    axis, step = _axis_and_step(offset)
    return jnp.roll(value, -step, axis)


def _axis_and_step(offset: Offset) -> tuple[int, int]:
    """The axis of a jump, and the number of nodes."""
    return next((axis, step) for axis, step in enumerate(offset) if step)


def _swept(rule: Callable, lines: Sequence[Nodes], offset: Offset) -> Field:
    """The result of ``rule(ahead, *own)`` at every node, with the result at the next node in direction o as ``ahead``.

    ``own`` are the entries of ``lines`` at the node. The node ahead of the last one is the first one.
    """
    axis, step = _axis_and_step(offset)
    rows = tuple(jnp.moveaxis(each, axis, 0) for each in lines)

    def go(ahead: jax.Array, own: tuple) -> tuple[jax.Array, jax.Array]:
        new = rule(ahead, *own)
        return new, new

    first = rows[0][0 if step > 0 else -1]
    return jnp.moveaxis(jax.lax.scan(go, first, rows, reverse=step > 0)[1], 0, axis)
