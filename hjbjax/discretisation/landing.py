"""Jumps of the chain to nodes that are not neighbours, at the corners of the cell in which a jump of the state lands.

A jump to y, in the cell with the corners y_c and the multilinear weights w_c ≥ 0, becomes jumps to the corners at the
rates λ w_c. So V(y) is interpolated: exactly for linear V, and otherwise with an error of at most h²/8 |V''|.

If y is outside the box, the rule of the nearest end applies. At a wall and at a prescribed value, the jump ends on the
boundary. At open and linear ends V continues along the line through the last two nodes, and at prescribed slopes, with
that slope. A jump across a constrained end, or across one with a prescribed growth rate, is refused.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.stretching import into_period
from hjbjax.problem.types import AtNodes, Field

ROUNDING = 64  # units of eps of the width of the box: a smaller distance beyond an end is rounding


@pytree_dataclass(static=("transposed",))
class Landing:
    """A jump from every node x to the node y(x), at the rate c(x).

    Args:
      nodes: the flat index of y(x), (*grid).
      rate: c(x), (*grid), per unit time; or a weight of a linear equation.
      transposed: True for jumps in the opposite direction, from y(x) to x.
    """

    nodes: Any
    rate: Any
    transposed: bool = False

    def product(self, values: Field) -> Field:
        """c(x) V(y(x)); if transposed, the sum of c(x) V(x) over all x with y(x) = y, at every node y; (*grid)."""
        if not self.transposed:
            return self.rate * self.ahead(values)
        flows = jnp.broadcast_to(self.rate * values, self.nodes.shape)
        total = jnp.zeros(values.size, flows.dtype).at[self.nodes.reshape(-1)].add(flows.reshape(-1))
        return total.reshape(values.shape)

    def ahead(self, values: AtNodes) -> AtNodes:
        """V(y(x)), (*grid)."""
        return values.reshape(-1)[self.nodes]

    def weighed(self, factor: Any) -> "Landing":
        """The jump with its rate times ``factor``, (*grid) or a number."""
        return Landing(self.nodes, factor * self.rate, self.transposed)

    def reversed(self) -> "Landing":
        """The jump in the opposite direction."""
        return Landing(self.nodes, self.rate, not self.transposed)


class Corners(NamedTuple):
    """The corners of the cells in which a jump lands.

    Attributes:
      nodes: for every corner its flat index, (*grid).
      weights: for every corner its weight w_c, (*grid).
      payment: the slope beyond an end times the distance, in cost units; zero inside the box.
      leaves: the nodes from which the jump crosses an end that refuses it, bool (*grid).
    """

    nodes: list[jax.Array]
    weights: list[jax.Array]
    payment: Any
    leaves: Any

    def interpolate(self, values: Field) -> Field:
        """V where the jump lands, (*grid)."""
        flat, total = values.reshape(-1), jnp.asarray(self.payment, values.dtype)
        for nodes, weight in zip(self.nodes, self.weights, strict=True):
            there = flat[nodes]
            # an infinite value may have weight zero; a finite one still contributes to derivatives
            total = total + weight * jnp.where((weight == 0) & ~jnp.isfinite(there), 0, there)
        return total


def landing_corners(grid: Grid, y: Sequence[Any], dtype: Any) -> Corners:
    """The corners for a jump to the state y, whose entries are arrays over the nodes, one per axis of the state."""
    strides = [math.prod(grid.shape[axis + 1 :]) for axis in range(grid.ndim)]
    nodes, weights = [jnp.zeros(grid.shape, jnp.int32)], [jnp.ones((), dtype)]
    if grid.modes:  # a jump keeps the mode
        nodes = [jax.lax.broadcasted_iota(jnp.int32, grid.shape, 0) * strides[0]]
    payment, leaves = jnp.zeros((), dtype), jnp.zeros((), bool)
    for axis, entry in zip(grid.state_axes, y, strict=True):
        place = _place(grid, axis, jnp.asarray(entry, dtype))
        payment, leaves = payment + place.payment, leaves | place.leaves
        pairs = [
            (before + (strides[axis] * cell).astype(jnp.int32), weight * share)
            for before, weight in zip(nodes, weights, strict=True)
            for cell, share in ((place.below, place.shares[0]), (place.above, place.shares[1]))
        ]
        nodes, weights = [node for node, _ in pairs], [weight for _, weight in pairs]
    return Corners(nodes, [jnp.broadcast_to(weight, grid.shape) for weight in weights], payment, leaves)


class _Place(NamedTuple):
    """The position of a state along one axis: two nodes, their weights, and the payment beyond an end."""

    below: jax.Array
    above: jax.Array
    shares: tuple[jax.Array, jax.Array]
    payment: Any
    leaves: Any


def _place(grid: Grid, axis: int, y: jax.Array) -> _Place:
    """The position along one axis."""
    lo, hi = jnp.asarray(grid.lo[axis], y.dtype), jnp.asarray(grid.hi[axis], y.dtype)
    payment, leaves = jnp.zeros((), y.dtype), jnp.zeros((), bool)
    if grid.periodic[axis]:
        cell, share, _ = grid._locate(axis, into_period(y, lo, hi))
        return _Place(cell, (cell + 1) % grid.shape[axis], (1 - share, share), payment, leaves)
    cell, share, _ = grid._locate(axis, y)
    low, high = 1 - share, share
    coordinates = jnp.asarray(grid.axis(axis), y.dtype)
    for step, end, gap in ((-1, lo, coordinates[1] - coordinates[0]), (1, hi, coordinates[-1] - coordinates[-2])):
        over = jnp.maximum(step * (y - end), 0)  # the distance beyond this end
        if (axis, step) in (*grid.sides("constrained"), *grid.sides("robin")):
            leaves = leaves | (over > ROUNDING * jnp.finfo(y.dtype).eps * (hi - lo))
        for slope in (end.slope for i, s, end in grid.prescribed("neumann") if (i, s) == (axis, step)):
            payment = payment + step * over * jnp.asarray(slope, y.dtype)
        if (axis, step) in grid.sides("open"):
            low, high = low - step * over / gap, high + step * over / gap
    return _Place(cell, cell + 1, (low, high), payment, leaves)
