"""Neighbours and one-sided differences on a grid, with ghost cells.

An edge that is neither periodic nor open is a wall on its node. Drift sees a copy of the node beyond it, a one-sided
difference of zero, which projects outward drift back onto the box. Noise sees the mirror image, V_{N+1} = V_{N−1}: the
reflected path has ∂V/∂n = 0 there, and a value that is even about the wall has it to second order, where the copy
puts the wall half a spacing further out. Beyond an open end the value goes on as the parabola through its last three
nodes, V_{N+1} = 3V_N − 3V_{N−1} + V_{N−2} where they are equally spaced.

Where the nodes are divided over many devices, what stands beyond the last node of a part is fetched from the part
beside: see ``problem.parts``.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, AtNodes, Field, Number, Scalar

if TYPE_CHECKING:
    from scipy.sparse import csr_array

PerNode: TypeAlias = float | jax.Array | np.ndarray  # a number a node, as one number or as an array that broadcasts

LONGER = 4  # axes up to which neighbours along the last one are slices of a longer array


def on_edge(grid: Grid, axis: int, step: int) -> Array:
    """The nodes without a neighbour in direction ``step`` along ``axis``, bool; broadcasts against the node axes."""
    along = [-1 if i == axis else 1 for i in range(grid.ndim)]
    # which nodes are here, only the running program knows
    if grid.parts is not None and (grid.is_divided(axis) or not grid.parts.even(axis)):
        ended = jnp.asarray(not grid.periodic[axis])
        return (grid.parts.last(axis, step) & ended).reshape(along)
    # (1, …, N, …, 1) and on the host: as a constant of the size of the grid it would stand in every program
    mask = np.zeros(grid.shape[axis], dtype=bool)
    mask[-1 if step > 0 else 0] = not grid.periodic[axis]
    return mask.reshape(along)


def has_walls(grid: Grid, axis: int) -> bool:
    """True if an end of an axis, or both, stops drift and noise."""
    return not grid.periodic[axis] and any(has_wall(grid, axis, step) for step in (-1, 1))


def has_wall(grid: Grid, axis: int, step: int) -> bool:
    """True if an end stops drift and noise; False where V continues: at open ends and where its slope is prescribed."""
    return (axis, step) not in grid.sides("open") and (axis, step) not in grid.sides("neumann")


def sloped(grid: Grid, axis: int, step: int) -> Any:
    """The prescription of a slope at an end, with its arrays; None where the slope is not prescribed."""
    return next((end for i, s, end in grid.prescribed("neumann", "robin") if (i, s) == (axis, step)), None)


def wall(grid: Grid, axis: int, step: int) -> Array:
    """The nodes at which drift and noise in direction ``step`` along ``axis`` are stopped: edges that are not open."""
    edge = on_edge(grid, axis, step)
    return np.zeros(edge.shape, bool) if not has_wall(grid, axis, step) else edge


def walls(grid: Grid, axis: int) -> Array:
    """The nodes with a wall on either side along ``axis``."""
    return wall(grid, axis, 1) | wall(grid, axis, -1)


def stopped(up: Field, down: Field, grid: Grid, axis: int) -> tuple[Field, Field]:
    """Slopes of a scheme from above and from below along one axis, with those across walls made zero."""
    return jnp.where(wall(grid, axis, 1), 0, up), jnp.where(wall(grid, axis, -1), 0, down)


def bends(up: Field, down: Field, grid: Grid, axis: int) -> Field:
    """D⁺ − D⁻, which noise sees: across a wall stands the mirror image, −D⁻ for D⁺ and −D⁺ for D⁻."""
    bend = up - down
    return jnp.where(walls(grid, axis), 2 * bend, bend)  # one of the two is zero there


def continuation(grid: Grid, axis: int, step: int) -> tuple[Number, ...]:
    """The weights of the last node and of the nodes before it in the value beyond an end; their sum is one.

    Two weights of a straight line at a linear end, three of a parabola at an open one. The gap beyond the end has the
    length of the last gap inside. Where a slope s + r V is prescribed, V continues as the mirror image with that slope,
    V_{N+1} = V_{N−1} ± 2h (s + r V_N), whose weights are ±2h r and 1.
    """
    if (axis, step) in grid.sides("linear"):
        return 2.0, -1.0
    if (end := sloped(grid, axis, step)) is not None:
        return step * 2 * _last_gap(grid, axis, step) * getattr(end, "rate", 0.0), 1.0
    if grid.stretch[axis] is None:
        return 3.0, -3.0, 1.0
    gaps = jnp.diff(jnp.asarray(grid.whole.axis(axis)))
    last, before = (gaps[-1], gaps[-2]) if step > 0 else (gaps[0], gaps[1])
    # Newton's form of the parabola at a distance ``last`` beyond the end; equal gaps make it 3, −3, 1
    ratio, bend = last / before, 2 * last / (last + before)
    return 2 + bend, -(1 + bend + bend * ratio), bend * ratio


def _last_gap(grid: Grid, axis: int, step: int) -> Number:
    """The distance between the end of an axis and the node next to it."""
    if grid.stretch[axis] is None:
        return grid.spacing(axis)
    gaps = jnp.diff(jnp.asarray(grid.whole.axis(axis)))
    return gaps[-1] if step > 0 else gaps[0]


def continued(
    values: Field, grid: Grid, offset: tuple[int, ...], *, mirror: bool = False, change: bool = False
) -> Field:
    """V at x + offset for every node x, shape (*grid): beyond ends where V continues its continuation.

    Args:
      values: V, or a change of V.
      grid: the nodes.
      offset: one step −1, 0 or 1 per axis.
      mirror: beyond a wall take the mirror image, which noise sees; otherwise as in ``neighbour``.
      change: ``values`` are a change of V, to which a prescribed slope adds nothing.
    """
    if not (grid.sides("open") or grid.sides("neumann") or mirror):
        return neighbour(values, grid, offset)
    for axis, step in enumerate(offset):  # beyond a corner: what one axis says through what the other says
        moved = neighbour(values, grid, unit(grid, axis, step))
        if step and not grid.periodic[axis] and not has_wall(grid, axis, step):
            moved = jnp.where(on_edge(grid, axis, step), _ended(values, grid, axis, step, change=change), moved)
        elif step and mirror and not grid.periodic[axis]:
            moved = jnp.where(on_edge(grid, axis, step), slices(values, grid, axis, step, 1), moved)
        values = moved
    return values


def inward(
    offsets: Sequence[tuple[int, ...]], values: Sequence[jax.Array], grid: Grid
) -> tuple[list[tuple[int, ...]], list[jax.Array]]:
    """Offsets and entries of an operator with those beyond open ends moved to the nodes of the parabola inside.

    Row sums stay, since the weights of a parabola sum to one. Offsets may come twice; their entries add up.
    """
    pairs = list(zip(offsets, values, strict=True))
    for axis in range(grid.ndim):  # one after the other: a diagonal jump over a corner is turned inwards twice
        kept = []
        for offset, value in pairs:
            step = offset[axis]
            if step == 0 or (axis, step) not in grid.sides("open"):
                kept.append((offset, value))
                continue
            outside = on_edge(grid, axis, step)
            kept.append((offset, jnp.where(outside, 0, value)))
            for k, weight in enumerate(continuation(grid, axis, step)):
                place = (*offset[:axis], -k * step, *offset[axis + 1 :])  # the end itself, one before it, two
                kept.append((place, jnp.where(outside, jnp.asarray(weight, value.dtype) * value, 0)))
        pairs = kept
    return [offset for offset, _ in pairs], [value for _, value in pairs]


def slices(values: jax.Array, grid: Grid, axis: int, step: int, inwards: int = 0, count: int = 1) -> jax.Array:
    """So many slices of the nodes next to the end of an axis in direction ``step``, ``inwards`` away from it.

    Of an array at the nodes, or of one that varies along this axis and broadcasts. In the order of the nodes. Where
    the axis is divided they are next to the end of this part.
    """
    first: int | Scalar = inwards
    if step > 0:
        nodes = grid.shape[axis] if grid.parts is None else grid.parts.count(axis)
        first = nodes - inwards - count
    if isinstance(first, int):
        return jax.lax.slice_in_dim(values, first, first + count, axis=axis)
    return jax.lax.dynamic_slice_in_dim(values, first, count, axis=axis)


def joined(values: AtNodes, grid: Grid, axis: int, below: jax.Array, above: jax.Array) -> jax.Array:
    """The values with slices ``below`` and ``above`` them along an axis, these behind the last node that is here."""
    long = jnp.concatenate([below, values, above], axis=axis)
    if grid.parts is None or grid.parts.even(axis):
        return long
    return jax.lax.dynamic_update_slice_in_dim(long, above, below.shape[axis] + grid.parts.count(axis), axis=axis)


def beyond(values: AtNodes, grid: Grid, axis: int, step: int, ended: jax.Array) -> jax.Array:
    """The slices beyond the last node here: of the part beside, of the other end of a periodic axis, or ``ended``.

    ``ended`` is what stands beyond an end of the box, and says how many slices there are to be.
    """
    cyclic = bool(grid.periodic[axis])
    if not (cyclic or grid.is_divided(axis)):
        return ended
    # what the other side has at the end that faces this one
    given = slices(values, grid, axis, -step, count=ended.shape[axis])
    if grid.parts is None or not grid.is_divided(axis):
        return given
    found = grid.parts.fetched(given, axis, step, cyclic=cyclic)
    return found if cyclic else jnp.where(grid.parts.at_end(axis, step), ended, found)


def _ended(values: AtNodes, grid: Grid, axis: int, step: int, *, change: bool = False) -> jax.Array:
    """The values beyond the end of an ordinary axis, one slice: a copy of the end node, or V continued from inside."""
    if has_wall(grid, axis, step):
        return slices(values, grid, axis, step)
    weights = [jnp.asarray(weight, values.dtype) for weight in continuation(grid, axis, step)]
    terms = [weight * slices(values, grid, axis, step, k) for k, weight in enumerate(weights)]
    if not change and (end := sloped(grid, axis, step)) is not None:
        terms.append(jnp.asarray(step * 2 * _last_gap(grid, axis, step) * end.slope, values.dtype))
    return sum(terms[1:], start=terms[0])


def neighbour(values: AtNodes, grid: Grid, offset: tuple[int, ...], *, ghost: bool = True) -> AtNodes:
    """The values at x + offset for every node x, shape (*grid).

    Args:
      values: node values, shape (*grid).
      grid: the grid they live on.
      offset: steps along the axes, each −1, 0 or 1.
      ghost: beyond an edge take the edge node's own value; otherwise zero.
    """
    for axis, step in enumerate(offset):
        if step == 0:
            continue
        last = slices(values, grid, axis, step)
        outside = beyond(values, grid, axis, step, last if ghost else jnp.zeros_like(last))
        if step < 0:
            parts = [outside, jax.lax.slice_in_dim(values, 0, grid.shape[axis] - 1, axis=axis)]
        else:
            parts = [jax.lax.slice_in_dim(values, 1, grid.shape[axis], axis=axis), outside]
        moved = jnp.concatenate(parts, axis=axis)  # fused, where a pad would fill an array
        if step > 0 and grid.parts is not None and not grid.parts.even(axis):
            # the last entry may be no node of this part, and the one before it the last
            place = jnp.arange(grid.shape[axis]).reshape([-1 if i == axis else 1 for i in range(grid.ndim)])
            moved = jnp.where(place == grid.parts.count(axis) - 1, outside, moved)
        values = moved
    return values


def unit(grid: Grid, axis: int, step: int) -> tuple[int, ...]:
    """The offset of one step along one axis."""
    return tuple(step if i == axis else 0 for i in range(grid.ndim))


@pytree_dataclass()
class Links:
    """Distances from each node to its two neighbours along one axis; all entries broadcast.

    Attributes:
      up, down: the distances.
      meets_up, meets_down: where the link ends on the boundary of a target before it comes to the next node, and
        the value there; None where no link does.
    """

    up: PerNode
    down: PerNode
    meets_up: tuple[jax.Array, jax.Array] | None = None
    meets_down: tuple[jax.Array, jax.Array] | None = None


def links(grid: Grid, axis: int) -> Links:
    """The links of the grid itself along one axis; on a stretched one an end repeats its only distance."""
    if grid.stretch[axis] is None:
        return Links(grid.spacing(axis), grid.spacing(axis))
    gaps = jnp.diff(jnp.asarray(grid.whole.axis(axis)))
    along = [-1 if i == axis else 1 for i in range(grid.ndim)]
    # N − 1 gaps for N nodes: beyond an end stands the mirror image, or a parabola over a gap as long
    up, down = jnp.append(gaps, gaps[-1:]), jnp.append(gaps[:1], gaps)
    if grid.parts is not None:
        up, down = grid.parts.own(up, axis), grid.parts.own(down, axis)
    return Links(up.reshape(along), down.reshape(along))


def one_sided(values: Field, grid: Grid, axis: int, link: Links | None = None) -> tuple[Field, Field]:
    """The differences D⁺ = (V(x+h⁺) − V(x))/h⁺ and D⁻ = (V(x) − V(x−h⁻))/h⁻ along one axis; zero across a wall."""
    link = link or links(grid, axis)
    up, down = _neighbours(values, grid, axis)
    if link.meets_up is not None:  # the link ends on a target: the exit cost there takes the neighbour's place
        up = jnp.where(*link.meets_up, up)
    if link.meets_down is not None:
        down = jnp.where(*link.meets_down, down)
    return (up - values) / link.up, (values - down) / link.down


def _neighbours(values: Field, grid: Grid, axis: int) -> tuple[Field, Field]:
    """The values one step up and one step down along an axis.

    XLA fuses a concatenation into the loop over the nodes, except one along the last axis. There two slices of a
    longer array are fused: one array is filled in place of two. In many dimensions, where memory rules, none is.
    """
    if axis < grid.ndim - 1 or grid.ndim > LONGER:
        return continued(values, grid, unit(grid, axis, 1)), continued(values, grid, unit(grid, axis, -1))
    below, above = (beyond(values, grid, axis, step, _ended(values, grid, axis, step)) for step in (-1, 1))
    wide, count = jax.lax.optimization_barrier(joined(values, grid, axis, below, above)), grid.shape[axis]
    return jax.lax.slice_in_dim(wide, 2, count + 2, axis=axis), jax.lax.slice_in_dim(wide, 0, count, axis=axis)


def limited(
    up: Field, down: Field, grid: Grid, axis: int, link: Links, noisy: Mapping[int, Array] | None = None
) -> tuple[Field, Field]:
    """Second-order one-sided slopes from the differences D⁺, D⁻ along one axis; zero across a wall as they are.

    Next to an edge, and to the boundary of a target, the second difference is continued as a constant; at a wall on
    which noise reflects, where ``noisy`` says so, it is that of the mirror image (see ``noisy_walls``).
    """
    bend = 2 * (up - down) / (link.up + link.down)  # V'' on two gaps of any length
    for step in (1, -1):
        if sloped(grid, axis, step) is not None:  # the mirror image with the prescribed slope has the bend of V
            continue
        # D⁺ or D⁻ is missing on an edge, and with it the bend: that of the node before is taken
        ended = neighbour(bend, grid, unit(grid, axis, -step))
        if noisy and step in noisy:
            ended = jnp.where(noisy[step], 2 * bend, ended)
        bend = jnp.where(on_edge(grid, axis, step), ended, bend)
    above, below = (neighbour(bend, grid, unit(grid, axis, step)) for step in (1, -1))
    # nodes inside a target hold no smooth continuation of V: the bend of this side is taken for both
    if link.meets_up is not None:
        above = jnp.where(link.meets_up[0], bend, above)
    if link.meets_down is not None:
        below = jnp.where(link.meets_down[0], bend, below)
    # V(x ± h) = V ± h V' + h²/2 V'': half a gap times the bend is the leading error of a one-sided difference
    up, down = up - link.up / 2 * van_albada(bend, above), down + link.down / 2 * van_albada(bend, below)
    return stopped(up, down, grid, axis)


def van_albada(a: Field, b: Field) -> Field:
    """The mean a b (a + b)/(a² + b²) of two bends, zero where their signs differ: G. D. van Albada's limiter."""
    agree = a * b > 0
    # the inner where keeps 0/0 out of the branch not taken, whose NaN a derivative would bring back
    return jnp.where(agree, a * b * (a + b) / jnp.where(agree, a * a + b * b, 1), 0)


def numbers(grid: Grid, offset: Sequence[int]) -> np.ndarray:
    """The number in C order of the node x + offset for every node x, shape (*grid), round all axes; host level."""
    number = np.arange(grid.size).reshape(grid.shape)
    # round axes that are not periodic as well: whoever asks has zero entries there
    return np.roll(number, [-step for step in offset], axis=range(grid.ndim))


def sparse(
    offsets: Sequence[tuple[int, ...]], values: Sequence[np.ndarray], diagonal: np.ndarray, grid: Grid
) -> "csr_array":
    """The matrix with ``diagonal`` and, for every offset o, entry values_o(x) in row x and column x + o.

    Host level. Nodes are numbered in C order. Entries whose column lies outside the box must be zero.

    Returns:
      A SciPy CSR array of shape (nodes, nodes) without explicit zeros off the diagonal.
    """
    from scipy.sparse import coo_array

    number = np.arange(grid.size)
    rows, columns, entries = [number], [number], [np.asarray(diagonal, np.float64).ravel()]
    for offset, value in zip(offsets, values, strict=True):
        nonzero = np.asarray(value).ravel() != 0
        rows.append(number[nonzero])
        columns.append(numbers(grid, offset).ravel()[nonzero])
        entries.append(np.asarray(value, np.float64).ravel()[nonzero])
    index = (np.concatenate(rows), np.concatenate(columns))
    # entries at one place add up, as of two jumps over the seam of an axis with two nodes
    return coo_array((np.concatenate(entries), index), shape=(grid.size, grid.size)).tocsr()
