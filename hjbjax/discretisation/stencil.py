"""Neighbours and one-sided differences on a grid, with ghost cells.

An end is a wall through its last node, unless V continues beyond it: at open, linear, Neumann and Robin ends. For
drift, the value beyond is a copy of the node, so the one-sided difference is zero and outward drift is projected onto
the box. For noise it is the mirror image, V_{N+1} = V_{N−1}: a reflected path has ∂V/∂n = 0 there, which an even
extension satisfies to second order, while the copy would move the wall outwards by half a spacing. Beyond an open end
the value is extrapolated by the parabola through the last three nodes, V_{N+1} = 3V_N − 3V_{N−1} + V_{N−2} for equal
spacings. ``continuation`` has the weights for all these ends.

If the nodes are divided among several devices, the values beyond the last node of a part are fetched from the adjacent
part: see ``problem.layouts``.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.landing import Landing
from hjbjax.problem.grid import CONTINUED, Grid, undivided
from hjbjax.problem.pytree import altered, pytree_dataclass
from hjbjax.problem.types import Array, AtNodes, Field, Number
from hjbjax.tracing import checks

if TYPE_CHECKING:
    from scipy.sparse import csr_array

PerNode: TypeAlias = float | jax.Array | np.ndarray  # one number per node, as a scalar or an array that broadcasts

LONGER = 4  # number of axes up to which neighbours along the last one are slices of a longer array


def on_edge(grid: Grid, axis: int, step: int) -> Array:
    """The nodes without a neighbour in direction ``step`` along ``axis``, bool; broadcasts against the node axes."""
    # (1, …, N, …, 1), since a constant of the size of the grid would be stored in every program
    along = [-1 if i == axis else 1 for i in range(grid.ndim)]
    return (grid.layout.last(axis, step) & (not grid.periodic[axis])).reshape(along)


def has_walls(grid: Grid, axis: int) -> bool:
    """True if at least one end of an axis stops drift and noise."""
    return not grid.periodic[axis] and any(has_wall(grid, axis, step) for step in (-1, 1))


def has_wall(grid: Grid, axis: int, step: int) -> bool:
    """True if an end stops drift and noise; False at open ends and where the slope is prescribed, as V continues."""
    return (axis, step) not in grid.sides("open") and (axis, step) not in grid.sides("neumann")


def walled(grid: Grid) -> Grid:
    """The grid with the ends of a Markov chain: projected ends instead of open, linear and Robin ends."""
    pairs = (pair and tuple("projected" if name in CONTINUED else name for name in pair) for pair in grid.edges)
    return altered(grid, edges=tuple(pairs))


def sloped(grid: Grid, axis: int, step: int) -> Any:
    """The prescribed slope at an end, with its arrays; None if the slope is not prescribed."""
    return next((end for i, s, end in grid.prescribed("neumann", "robin") if (i, s) == (axis, step)), None)


def wall(grid: Grid, axis: int, step: int) -> Array:
    """The nodes at which drift and noise in direction ``step`` along ``axis`` stop: edges that are not open."""
    edge = on_edge(grid, axis, step)
    return np.zeros(edge.shape, bool) if not has_wall(grid, axis, step) else edge


def walls(grid: Grid, axis: int) -> Array:
    """The nodes with a wall on either side along ``axis``."""
    return wall(grid, axis, 1) | wall(grid, axis, -1)


def stopped(up: Field, down: Field, grid: Grid, axis: int) -> tuple[Field, Field]:
    """Set slopes from above and from below along one axis to zero across walls."""
    return jnp.where(wall(grid, axis, 1), 0, up), jnp.where(wall(grid, axis, -1), 0, down)


def bends(up: Field, down: Field, grid: Grid, axis: int) -> Field:
    """D⁺ − D⁻ for noise: across a wall D⁺ is the mirror image −D⁻, and D⁻ is −D⁺."""
    bend = up - down
    return jnp.where(walls(grid, axis), 2 * bend, bend)  # one of the two is zero there


def continuation(grid: Grid, axis: int, step: int) -> tuple[Number, ...]:
    """The weights of the last node and of the nodes before it in the value beyond an end.

    They sum to one at a linear end (two weights of a line) and at an open end (three weights of a parabola). The gap
    beyond the end equals the last gap inside. Where a slope s + r V is prescribed, V continues as the mirror image with
    that slope, V_{N+1} = V_{N−1} ± 2h (s + r V_N), with the weights ±2h r and 1.
    """
    if (axis, step) in grid.sides("linear"):
        return 2.0, -1.0
    if (end := sloped(grid, axis, step)) is not None:
        return step * 2 * _last_gap(grid, axis, step) * end.rate, 1.0
    if grid.stretch[axis] is None:
        return 3.0, -3.0, 1.0
    gaps = _gaps(grid, axis)
    last, before = (gaps[-1], gaps[-2]) if step > 0 else (gaps[0], gaps[1])
    # Newton's form of the parabola at a distance ``last`` beyond the end; equal gaps give 3, −3, 1
    ratio, bend = last / before, 2 * last / (last + before)
    return 2 + bend, -(1 + bend + bend * ratio), bend * ratio


def _gaps(grid: Grid, axis: int) -> jax.Array:
    """The distances between the nodes along an axis, (N − 1,), in the type of the corners of the grid."""
    return jnp.diff(jnp.asarray(undivided(grid).axis(axis, jnp.result_type(grid.spacing(axis)))))


def _last_gap(grid: Grid, axis: int, step: int) -> Number:
    """The distance between the end of an axis and the node next to it."""
    if grid.stretch[axis] is None:
        return grid.spacing(axis)
    gaps = _gaps(grid, axis)
    return gaps[-1] if step > 0 else gaps[0]


def continued(
    values: Field, grid: Grid, offset: tuple[int, ...], *, mirror: bool = False, change: bool = False
) -> Field:
    """V at x + offset for every node x, shape (*grid), extrapolated beyond ends where V continues.

    Args:
      values: V, or a change of V.
      grid: the grid.
      offset: one step −1, 0 or 1 per axis; along an axis of modes any number.
      mirror: beyond a wall use the mirror image, as noise requires; otherwise as in ``neighbour``.
      change: ``values`` are a change of V, so a prescribed slope adds nothing.
    """
    if not (grid.sides("open") or grid.sides("neumann") or mirror):
        return neighbour(values, grid, offset)
    for axis, step in enumerate(offset):  # beyond a corner the axes compose
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
    """Offsets and entries of an operator, with those beyond open ends moved to the inner nodes of the parabola.

    Row sums are preserved, since the weights of a parabola sum to one. Repeated offsets add up.
    """
    pairs = list(zip(offsets, values, strict=True))
    for axis in range(grid.ndim):  # one after the other: a diagonal jump over a corner is moved twice
        kept = []
        for offset, value in pairs:
            step = offset[axis]
            if step == 0 or (axis, step) not in grid.sides("open"):
                kept.append((offset, value))
                continue
            outside = on_edge(grid, axis, step)
            kept.append((offset, jnp.where(outside, 0, value)))
            for k, weight in enumerate(continuation(grid, axis, step)):
                place = (*offset[:axis], -k * step, *offset[axis + 1 :])  # the end itself, one before it, two before it
                kept.append((place, jnp.where(outside, jnp.asarray(weight, value.dtype) * value, 0)))
        pairs = kept
    return [offset for offset, _ in pairs], [value for _, value in pairs]


def slices(values: jax.Array, grid: Grid, axis: int, step: int, inwards: int = 0, count: int = 1) -> jax.Array:
    """``count`` slices of nodes next to the end of an axis in direction ``step``, ``inwards`` away from the end.

    The array has values at the nodes, or varies along this axis and broadcasts. Slices are in the order of the nodes.
    On a divided axis they are next to the end of the local part.
    """
    first = grid.layout.count(axis) - inwards - count if step > 0 else inwards
    if isinstance(first, int):
        return jax.lax.slice_in_dim(values, first, first + count, axis=axis)
    return jax.lax.dynamic_slice_in_dim(values, first, count, axis=axis)


def joined(values: AtNodes, grid: Grid, axis: int, below: jax.Array, above: jax.Array) -> jax.Array:
    """The values with the slices ``below`` and ``above`` joined along an axis, the latter after the last local node."""
    long = jnp.concatenate([below, values, above], axis=axis)
    if grid.layout.even(axis):
        return long
    return jax.lax.dynamic_update_slice_in_dim(long, above, below.shape[axis] + grid.layout.count(axis), axis=axis)


def beyond(values: AtNodes, grid: Grid, axis: int, step: int, ended: jax.Array) -> jax.Array:
    """The slices beyond the last local node: of the adjacent part, of the other end of a periodic axis, or ``ended``.

    ``ended`` contains the values beyond an end of the box, and determines the number of slices.
    """
    cyclic, layout = bool(grid.periodic[axis]), grid.layout
    if not (cyclic or layout.is_divided(axis)):
        return ended
    # the slices at the opposite end of the adjacent part
    given = slices(values, grid, axis, -step, count=ended.shape[axis])
    found = layout.fetched(given, axis, step, cyclic=cyclic)
    return found if cyclic else jnp.where(layout.at_end(axis, step), ended, found)


def _ended(values: AtNodes, grid: Grid, axis: int, step: int, *, change: bool = False) -> jax.Array:
    """The values beyond an end of an axis that is not periodic, one slice: a copy of the end node, or extrapolated."""
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
      grid: the grid.
      offset: steps along the axes, each −1, 0 or 1; along an axis of modes any number.
      ghost: beyond an edge use the edge node's value; otherwise zero.
    """
    for axis, step in enumerate(offset):
        if step == 0:
            continue
        if axis not in grid.state_axes:
            values = jnp.roll(values, -step, axis)
            continue
        last = slices(values, grid, axis, step)
        outside = beyond(values, grid, axis, step, last if ghost else jnp.zeros_like(last))
        if step < 0:
            parts = [outside, jax.lax.slice_in_dim(values, 0, grid.shape[axis] - 1, axis=axis)]
        else:
            parts = [jax.lax.slice_in_dim(values, 1, grid.shape[axis], axis=axis), outside]
        moved = _concatenated(parts, axis)
        if step > 0 and not grid.layout.even(axis):
            # the last entry may be padding of this part, and the one before it the last node
            place = jnp.arange(grid.shape[axis]).reshape([-1 if i == axis else 1 for i in range(grid.ndim)])
            moved = jnp.where(place == grid.layout.count(axis) - 1, outside, moved)
        values = moved
    return values


def _concatenated(parts: Sequence[jax.Array], axis: int) -> jax.Array:
    """The parts joined along an axis, in a form that XLA fuses into the loop over the nodes.

    XLA stores an array for a pad, and from version 0.12 on for a concatenation along the last axis, but not along the
    axis before an axis of one entry.
    """
    return jnp.concatenate([part[..., None] for part in parts], axis=axis)[..., 0]


def unit(grid: Grid, axis: int, step: int) -> tuple[int, ...]:
    """The offset of one step along one axis."""
    return tuple(step if i == axis else 0 for i in range(grid.ndim))


@pytree_dataclass()
class Links:
    """Distances from each node to its two neighbours along one axis; all entries broadcast.

    Attributes:
      up, down: the distances.
      meets_up, meets_down: the nodes where the link ends on the boundary of a target before the next node, and the
        value there; None if no link does.
    """

    up: PerNode
    down: PerNode
    meets_up: tuple[jax.Array, jax.Array] | None = None
    meets_down: tuple[jax.Array, jax.Array] | None = None


def grid_links(grid: Grid, axis: int) -> Links:
    """The links of the grid along one axis; on a stretched axis an end node repeats its only distance."""
    if grid.stretch[axis] is None:
        return Links(grid.spacing(axis), grid.spacing(axis))
    gaps = _gaps(grid, axis)
    along = [-1 if i == axis else 1 for i in range(grid.ndim)]
    # N − 1 gaps for N nodes: beyond an end is the mirror image, or a parabola over a gap of the same length
    up, down = jnp.append(gaps, gaps[-1:]), jnp.append(gaps[:1], gaps)
    up, down = grid.layout.own(up, axis), grid.layout.own(down, axis)
    return Links(up.reshape(along), down.reshape(along))


def noise_along(a: dict[tuple[int, int], jax.Array], grid: Grid, axis: int) -> Any:
    """a_ii − Σ_j |a_ij| h_i/h_j: the noise left for jumps along axis i after the diagonal jumps; None without any."""
    left = a.get((axis, axis))
    if left is None:
        return None
    for (i, j), entry in a.items():
        if i != j:
            checks.refuse_stretched(grid)  # between unequal cells there are no diagonals
        if i != j and axis in (i, j):
            other = j if axis == i else i
            left = left - jnp.abs(entry) * (grid.spacing(axis) / grid.spacing(other))
    return left


def one_sided(values: Field, grid: Grid, axis: int, link: Links | None = None) -> tuple[Field, Field]:
    """The differences D⁺ = (V(x+h⁺) − V(x))/h⁺ and D⁻ = (V(x) − V(x−h⁻))/h⁻ along one axis; zero across a wall."""
    link = link or grid_links(grid, axis)
    up, down = _neighbours(values, grid, axis)
    if link.meets_up is not None:  # the link ends on a target: its exit cost replaces the neighbour's value
        up = jnp.where(*link.meets_up, up)
    if link.meets_down is not None:
        down = jnp.where(*link.meets_down, down)
    # products, because XLA stores quotients that several expressions read
    return (up - values) * (1 / link.up), (values - down) * (1 / link.down)


def _neighbours(values: Field, grid: Grid, axis: int) -> tuple[Field, Field]:
    """The values one step up and one step down along an axis.

    XLA fuses a concatenation into the loop over the nodes, except along the last axis. There two slices of a longer
    array are fused, so one array is stored instead of two. In many dimensions, where memory is scarce, none is stored.
    """
    if axis < grid.ndim - 1 or grid.ndim > LONGER:
        return continued(values, grid, unit(grid, axis, 1)), continued(values, grid, unit(grid, axis, -1))
    below, above = (beyond(values, grid, axis, step, _ended(values, grid, axis, step)) for step in (-1, 1))
    wide, count = jax.lax.optimization_barrier(joined(values, grid, axis, below, above)), grid.shape[axis]
    return jax.lax.slice_in_dim(wide, 2, count + 2, axis=axis), jax.lax.slice_in_dim(wide, 0, count, axis=axis)


def limited(
    up: Field, down: Field, grid: Grid, axis: int, link: Links, noisy: Mapping[int, Array] | None = None
) -> tuple[Field, Field]:
    """Second-order one-sided slopes from the differences D⁺, D⁻ along one axis; zero across a wall.

    Next to an edge, and to the boundary of a target, the second difference is extrapolated as a constant. At a wall on
    which noise reflects, according to ``noisy``, the mirror image gives it (see ``noisy_walls``).
    """
    # V'' from two gaps of any lengths, times the width of the box: the squares of V'' itself may leave float32's range
    width = grid.hi[axis] - grid.lo[axis]
    bend = 2 * (up - down) / ((link.up + link.down) / width)
    for step in (1, -1):
        if sloped(grid, axis, step) is not None:  # already the bend of the mirror image
            continue
        # on an edge D⁺ or D⁻ is missing, so the second difference of the node before is used
        ended = neighbour(bend, grid, unit(grid, axis, -step))
        if noisy and step in noisy:
            ended = jnp.where(noisy[step], 2 * bend, ended)
        bend = jnp.where(on_edge(grid, axis, step), ended, bend)
    above, below = (neighbour(bend, grid, unit(grid, axis, step)) for step in (1, -1))
    # inside a target V has no smooth continuation, so the second difference of this side is used for both
    if link.meets_up is not None:
        above = jnp.where(link.meets_up[0], bend, above)
    if link.meets_down is not None:
        below = jnp.where(link.meets_down[0], bend, below)
    # V(x ± h) = V ± h V' + h²/2 V'': half a gap times V'' is the leading error of a one-sided difference
    up -= link.up / (2 * width) * van_albada(bend, above)
    down += link.down / (2 * width) * van_albada(bend, below)
    return stopped(up, down, grid, axis)


def van_albada(a: Field, b: Field) -> Field:
    """The mean a b (a + b)/(a² + b²) of two second differences, zero if their signs differ (G. D. van Albada)."""
    agree = a * b > 0
    # the inner where keeps 0/0 out of the branch not taken, whose NaN would enter the derivative
    # in this order no cube is formed, which leaves float32's range for units of 1e-13 or 1e13
    return jnp.where(agree, a * b / jnp.where(agree, a * a + b * b, 1) * (a + b), 0)


def neighbour_numbers(grid: Grid, offset: Sequence[int]) -> np.ndarray:
    """The flat index of the node x + offset for every node x, shape (*grid), wrapped on all axes; host level."""
    number = np.arange(grid.size).reshape(grid.shape)
    # also wraps axes that are not periodic, because callers have zero entries there
    return np.roll(number, [-step for step in offset], axis=range(grid.ndim))


def sparse(
    offsets: Sequence[tuple[int, ...]], values: Sequence[np.ndarray], diagonal: np.ndarray, grid: Grid,
    landings: Sequence[Landing] = (),
) -> "csr_array":  # fmt: skip
    """The matrix with ``diagonal`` and, for every offset o, the entry values_o(x) in row x and column x + o.

    Every landing has its rate in row x and column y(x). Host level. Nodes are indexed in C order. Entries whose column
    is outside the box must be zero.

    Returns:
      A SciPy CSR array of shape (nodes, nodes) without explicit zeros off the diagonal.
    """
    from scipy.sparse import coo_array

    number = np.arange(grid.size)
    rows, columns, entries = [number], [number], [np.asarray(diagonal, np.float64).ravel()]
    for offset, value in zip(offsets, values, strict=True):
        nonzero = np.asarray(value).ravel() != 0
        rows.append(number[nonzero])
        columns.append(neighbour_numbers(grid, offset).ravel()[nonzero])
        entries.append(np.asarray(value, np.float64).ravel()[nonzero])
    for landing in landings:
        ends = (number, np.asarray(landing.nodes).ravel())
        row, column = ends[::-1] if landing.transposed else ends
        rows.append(row)
        columns.append(column)
        entries.append(np.broadcast_to(np.asarray(landing.rate, np.float64), grid.shape).ravel())
    index = (np.concatenate(rows), np.concatenate(columns))
    # coinciding entries add up, as for two jumps over the seam of an axis with two nodes
    return coo_array((np.concatenate(entries), index), shape=(grid.size, grid.size)).tocsr()
