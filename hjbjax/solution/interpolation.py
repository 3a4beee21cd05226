"""Values between the nodes: multilinear, multilinear over the defined nodes, or from the nearest node.

Let c be the corners of the cell and s_i the fraction of the cell along axis i. With w_c = Π_i (s_i or 1 − s_i), the
interpolant V(x) = Σ_c w_c V_c is second order, exact for multilinear V, and within the range of the corners.

The slopes DV are computed at the nodes and interpolated in the same way: second order where V is smooth, exact for
quadratic V.
"""

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import as_jax, cast, is_traced
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, DType, Numbers


class Moment(NamedTuple):
    """A time between two kept times: the index before it, the weight of the next, and if it is inside their range."""

    before: jax.Array
    share: jax.Array
    inside: jax.Array


CONSTANT = 2**20  # bytes of node values up to which they are a constant of a program, which saves 10 µs per call

Place: TypeAlias = tuple[jax.Array, jax.Array, jax.Array]  # along one axis: node below, fraction to the next, inside
Layer: TypeAlias = tuple[jax.Array, tuple[jax.Array, ...]]  # weight, index of a kept time; stationary: 1, ()


class Interpolation(Protocol):
    """A rule for values between the nodes: ``between``, ``between_defined``, ``nearest`` or ``slopes_between``."""

    def __call__(self, grid: Grid, values: Array, x: jax.Array, clamp: bool, when: Moment | None = None) -> jax.Array:
        """The answer at the states x, shape (..., n)."""


class Samples(NamedTuple):
    """Node values, (*grid, ...), or (k, *grid, ...) with ``times``."""

    grid: Grid
    values: Array
    times: Array | None = None


def query(
    look: Interpolation, samples: Samples, x: Numbers, t: Numbers | None = None, *, clamp: bool, name: str
) -> Array:
    """Interpolate node values: float64 NumPy for concrete data, else a JAX array in the dtype of the tracer.

    Args:
      look: the interpolation rule.
      samples: grid, node values, and times of a marched solution, which are interpolated by the same rule.
      x: states, shape (..., n).
      t: time, broadcasts against ``x.shape[:-1]``; outside the times it is treated like a state outside the grid.
      clamp: outside the grid use the nearest point of its box; otherwise the result there is NaN.
      name: the function to name in error messages.

    Returns:
      Shape ``x.shape[:-1] + values.shape[n:]``.

    Raises:
      TypeError: the states are not real numbers.
      ValueError: the states have the wrong length.
    """
    grid, values, times = samples
    traced = [leaf for leaf in jax.tree.leaves((values, x, times, t)) if isinstance(leaf, jax.core.Tracer)]
    if not traced and not is_traced(grid):
        # Inside a jit of the caller the result must be a constant, and float64 must not be enabled in the middle of it.
        with jax.ensure_compile_time_eval(), own_settings(x64=True):
            when = None if times is None else _moment(times, t, np.float64, name)
            # JAX caches NumPy arrays that it has converted to float32 elsewhere, and would reuse them for float64.
            grid, values = cast((grid, values), np.float64)
            return np.array(look(grid, values, _states(grid, x, np.float64, name), clamp, when))[()]
    with own_settings():
        dtype: DType = jnp.result_type(*traced) if traced else jnp.result_type(float)
        if not jnp.issubdtype(dtype, jnp.floating):
            dtype = jnp.result_type(float)
        when = None if times is None else _moment(times, t, dtype, name)
        return look(*as_jax((grid, values)), _states(grid, x, dtype, name), clamp, when).astype(dtype)


def compile_query(look: Interpolation, grid: Grid, values: Array) -> Callable[[np.ndarray], jax.Array]:
    """``query`` with ``clamp`` for concrete float64 states as one program; requires ``settings.are_usual()``.

    A call takes about 25 microseconds, most of which JAX takes to start the program. The result is a tracer inside a
    caller's ``jit``.
    """
    with jax.core.eval_context(), own_settings(x64=True):
        grid, values = jax.device_put(cast((grid, values), np.float64))
    cyclic = np.array(grid.periodic)

    def at(values: Array, x: jax.Array) -> jax.Array:
        return look(grid, values, jnp.where(cyclic & jnp.isinf(x), jnp.nan, x), True)

    if values.nbytes <= CONSTANT:
        return jax.jit(functools.partial(at, values))
    return functools.partial(jax.jit(at), values)


def _moment(times: Array, t: Any, dtype: DType, name: str) -> Moment:
    """Locate t among the kept times."""
    try:
        t = jnp.asarray(t if is_traced(t) else np.asarray(t, np.float64), dtype)
    except (TypeError, ValueError):
        raise TypeError(f"{name}: got t = {t!r}, wanted a time") from None
    times = jnp.asarray(times, dtype)
    inside = ~times_outside(times, t)
    if len(times) == 1:
        return Moment(jnp.zeros(t.shape, int), jnp.zeros(t.shape, dtype), inside)
    # a kept time belongs to the interval that begins there, the last one to the interval that ends there
    before = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    share = (t - times[before]) / (times[before + 1] - times[before])
    return Moment(before, jnp.clip(share, 0, 1), inside & ~jnp.isnan(t))


def times_outside(times: Array, t: Array) -> Any:
    """True for times t outside the kept times; NaN counts as inside."""
    xp: Any = jnp if is_traced(times, t) or isinstance(times, jax.Array) else np
    times, t = xp.asarray(times), xp.asarray(t)
    kind = times.dtype if np.issubdtype(times.dtype, np.floating) else t.dtype
    # the caller's ``0.1 * k`` and the times of the march differ by rounding
    slack = 8 * np.finfo(kind if np.issubdtype(kind, np.floating) else float).eps * xp.max(xp.abs(times))
    return (t < times[0] - slack) | (t > times[-1] + slack)


def _states(grid: Grid, x: Numbers, dtype: DType, name: str) -> jax.Array:
    """The states in ``dtype``; an infinite entry on a periodic axis becomes NaN."""
    try:
        x = jnp.asarray(x) if is_traced(x) else np.asarray(x)
    except (TypeError, ValueError):
        x = np.asarray(None)  # an object array, which the check below refuses
    if not jnp.issubdtype(x.dtype, jnp.floating) and not jnp.issubdtype(x.dtype, jnp.integer):
        raise TypeError(f"{name}: got states of type {x.dtype}, wanted real numbers, shape (..., {grid.ndim})")
    if x.ndim == 0 or x.shape[-1] != grid.ndim:
        raise ValueError(f"{name}: got states of shape {x.shape}, wanted (..., {grid.ndim}): one entry per axis")
    x = jnp.asarray(x, dtype)
    return jnp.where(np.array(grid.periodic) & jnp.isinf(x), jnp.nan, x)


@functools.partial(jax.jit, static_argnames="clamp")
def between(grid: Grid, values: Array, x: jax.Array, clamp: bool, when: Moment | None = None) -> jax.Array:
    """The multilinear interpolant; NaN or infinite where a node with positive weight is."""
    if when is None:
        return grid.interpolate(values, x, clamp=clamp)
    total: Any = 0.0
    for weight, hidden, there in _corners(grid, values, x, clamp, when):
        # 0 · inf is NaN, so infinite neighbours with weight zero must be skipped
        total = total + jnp.where(hidden, jnp.nan, weight * jnp.where((weight == 0) & ~jnp.isfinite(there), 0, there))
    return total


@functools.partial(jax.jit, static_argnames="clamp")
def between_defined(grid: Grid, values: Array, x: jax.Array, clamp: bool, when: Moment | None = None) -> jax.Array:
    """The weighted mean over the nodes of the cell where no entry is NaN."""
    total: Any = 0.0
    sum_of_weights: Any = 0.0
    for weight, defined, there in _defined_corners(grid, values, x, clamp, when):
        weight = jnp.where(defined, weight, 0)[..., None]
        total, sum_of_weights = total + weight * jnp.where(defined[..., None], there, 0), sum_of_weights + weight
    some = sum_of_weights > 0
    # divide by 1 if there is none: 0/0 in the branch not taken would still make the derivative NaN
    return jnp.where(some, total / jnp.where(some, sum_of_weights, 1), jnp.nan)


@functools.partial(jax.jit, static_argnames="clamp")
def nearest(grid: Grid, values: Array, x: jax.Array, clamp: bool, when: Moment | None = None) -> jax.Array:
    """The values at the nearest node of the cell where no entry is NaN; on ties the lower node."""
    answer: Any = jnp.nan
    largest: Any = 0.0
    # At a midpoint rounding must not decide. There an error e of a position changes the quotient of two weights by 4 e.
    ties = jnp.minimum(sum(4 * grid.slack(axis, x.dtype) for axis in range(grid.ndim)), 0.5)
    for weight, defined, there in _defined_corners(grid, values, x, clamp, when):
        # a node is nearer along every axis if and only if its weight is larger
        nearer = defined & (weight > largest * (1 + ties))
        answer, largest = jnp.where(nearer[..., None], there, answer), jnp.where(nearer, weight, largest)
    return answer


@functools.partial(jax.jit, static_argnames="clamp")
def slopes_between(grid: Grid, values: Array, x: jax.Array, clamp: bool, when: Moment | None = None) -> jax.Array:
    """DV, shape ``x.shape[:-1] + (n,)``, interpolated from the slopes at the corners of the cell."""
    values, x = jnp.asarray(values), grid.wrap(x)
    places = [grid._locate(axis, x[..., axis]) for axis in range(grid.ndim)]
    hidden = jnp.any(jnp.isnan(x), axis=-1) | ((not clamp) & ~jnp.all(jnp.stack([p[2] for p in places]), axis=0))
    layers = _layers(x.dtype, values, when)
    if when is not None:
        hidden |= (not clamp) & ~when.inside
    slopes = []
    for axis in range(grid.ndim):
        total: Any = 0.0
        # ``_slope_along`` interpolates along the axis itself, so only 2^(n−1) edges of the cell are needed
        others = [(0, 1) if other != axis else (0,) for other in range(grid.ndim)]
        for (layer, moment), corner in itertools.product(layers, itertools.product(*others)):
            weight, nodes = layer, []
            for other, bit in enumerate(corner):
                cell, fraction, _ = places[other]
                nodes.append((cell + bit) % grid.shape[other])
                if other != axis:
                    weight = weight * (fraction if bit else 1 - fraction)
            row = _slope_along(grid, values, axis, moment, nodes, places[axis])
            total = total + weight * jnp.where((weight == 0) & ~jnp.isfinite(row), 0, row)
        slopes.append(total)
    return jnp.where(hidden[..., None], jnp.nan, jnp.stack(slopes, axis=-1))


def _slope_along(
    grid: Grid, values: Array, axis: int, moment: tuple[jax.Array, ...], nodes: list[jax.Array], place: Place
) -> jax.Array:
    """The slope along one axis on the edge of the cell that begins at ``nodes``, linear between the ends of the edge.

    The slope at a node is the slope of the parabola through the node and its neighbours. Next to an end of the axis, or
    to a value that is not finite, it is the slope of the parabola through the nearest three nodes, or of a line through
    two.
    """
    cell, fraction, _ = place
    count, cyclic = grid.shape[axis], grid.periodic[axis]
    row, at = [], []  # values and coordinates: two nodes before the edge, its two ends, one after it
    coordinates = jnp.asarray(grid.axis(axis), fraction.dtype)
    for shift in (-2, -1, 0, 1, 2):
        index = cell + shift
        there = list(nodes)
        there[axis] = index % count if cyclic else jnp.clip(index, 0, count - 1)
        outside = jnp.zeros((), bool) if cyclic else (index < 0) | (index > count - 1)
        row.append(jnp.where(outside, jnp.nan, values[(*moment, *there)]))
        at.append(coordinates[there[axis]])
    spacing = grid.spacing(axis)
    widths = [jnp.asarray(spacing, fraction.dtype)] * 4 if cyclic else [b - a for a, b in itertools.pairwise(at)]
    widths = [jnp.where(width > 0, width, 1) for width in widths]  # beyond an end of the axis both are the last node
    # first and (below) second divided differences, for Newton's form of the parabola; NaN where a value is not finite
    far, down, here, up = (
        jnp.where(jnp.isfinite(b - a), b - a, jnp.nan) / width
        for (a, b), width in zip(itertools.pairwise(row), widths, strict=True)
    )
    slopes = (far, down, here, up)
    bend_far, bend_down, bend_up = ((slopes[k + 1] - slopes[k]) / (widths[k] + widths[k + 1]) for k in range(3))
    first_bend = jnp.where(jnp.isnan(bend_down), jnp.nan_to_num(bend_up), bend_down)
    last_bend = jnp.where(jnp.isnan(bend_up), jnp.nan_to_num(bend_down), bend_up)
    # on the last node before an infinite one this cell is undefined, and the parabola of the other side is used
    first = jnp.where(jnp.isnan(here), down + widths[1] * jnp.nan_to_num(bend_far), here - widths[2] * first_bend)
    last = here + widths[2] * last_bend
    # On a node the end that is not finite is ignored; the finite end keeps the derivative along the axis.
    lone_first, lone_last = (fraction == 0) & ~jnp.isfinite(last), (fraction == 1) & ~jnp.isfinite(first)
    first, last = jnp.where(lone_last, last, first), jnp.where(lone_first, first, last)
    return (1 - fraction) * first + fraction * last


def extended(grid: Grid, values: Array, enumerated: bool) -> Any:
    """Node values (..., *grid, m) extended by one layer: undefined nodes take the values of defined neighbours.

    Undefined means NaN. Axis by axis, a node takes the mean of its two neighbours, or the only defined one.
    ``enumerated`` values are not averaged. Nodes without a defined node among the 3^n around them stay NaN.
    """
    xp: Any = jnp if is_traced(values) else np
    values = xp.asarray(values)
    first = values.ndim - 1 - grid.ndim
    # axis after axis, so that later axes use the nodes filled by earlier ones, which includes diagonal neighbours
    for axis in range(grid.ndim):
        lost = xp.any(xp.isnan(values), axis=-1, keepdims=True)
        lower, upper = (xp.roll(values, shift, axis=first + axis) for shift in (1, -1))
        if not grid.periodic[axis]:
            place = xp.arange(grid.shape[axis]).reshape(-1, *(1,) * (grid.ndim - axis))
            # ``roll`` wraps around, which is right for periodic axes only
            lower = xp.where(place == 0, xp.nan, lower)
            upper = xp.where(place == grid.shape[axis] - 1, xp.nan, upper)
        no_lower, no_upper = (xp.any(xp.isnan(side), axis=-1, keepdims=True) for side in (lower, upper))
        both = lower if enumerated else (lower + upper) / 2
        near = xp.where(no_lower, upper, xp.where(no_upper, lower, both))
        values = xp.where(lost, near, values)
    return values


def _layers(dtype: np.dtype, values: Array, when: Moment | None) -> list[Layer]:
    """The kept times before and after a moment, with their weights; a single layer for a stationary function."""
    if when is None:
        return [(jnp.ones((), dtype), ())]
    after = jnp.minimum(when.before + 1, values.shape[0] - 1)  # the same time if only one is kept, with weight 0
    return [(1 - when.share, (when.before,)), (when.share, (after,))]


Corner: TypeAlias = tuple[jax.Array, jax.Array, jax.Array]  # weight and flag (...), values (..., *entries)


def _defined_corners(grid: Grid, values: Array, x: jax.Array, clamp: bool, when: Moment | None) -> Iterator[Corner]:
    """The nodes around each state: weight, a flag that is True if the values are defined and used, and the values."""
    for weight, hidden, there in _corners(grid, values, x, clamp, when):
        # On a node its neighbours have weight zero, so undefined controls there do not matter.
        yield weight, (weight > 0) & ~hidden & ~jnp.any(jnp.isnan(there), axis=-1), there


def _corners(grid: Grid, values: Array, x: jax.Array, clamp: bool, when: Moment | None) -> Iterator[Corner]:
    """The 2^n nodes around each state, at two times if marched: weight, a flag for hidden results, and the values.

    Cells, weights and the test for the outside agree with ``Grid.interpolate``. Values are gathered before the test for
    NaN, so the cost of a query does not depend on the size of the grid.
    """
    values, x = jnp.asarray(values), grid.wrap(x)
    cells, fractions, inside = zip(*(grid._locate(axis, x[..., axis]) for axis in range(grid.ndim)), strict=True)
    hidden = jnp.any(jnp.isnan(x), axis=-1) | ((not clamp) & ~jnp.all(jnp.stack(inside), axis=0))
    layers = _layers(x.dtype, values, when)
    if when is not None:
        hidden |= (not clamp) & ~when.inside
    for (layer, moment), corner in itertools.product(layers, np.ndindex(*(2,) * grid.ndim)):
        weight = layer
        for fraction, bit in zip(fractions, corner, strict=True):
            weight = weight * (fraction if bit else 1 - fraction)
        nodes = tuple((cell + bit) % n for cell, bit, n in zip(cells, corner, grid.shape, strict=True))
        yield weight, hidden, values[moment + nodes]


def check_query(solution: Any, name: str, values: Array, trailing: int, where: tuple) -> tuple[Any, Any]:
    """Split the arguments into time, None if stationary, and state; refuse a wrong number of arguments, and batches."""
    marched = solution.times is not None
    if len(where) != 1 + marched:
        kind, call = ("marched over times", f"{name}(t, x)") if marched else ("stationary", f"{name}(x)")
        raise ValueError(f"Solution.{name}: got {len(where)} arguments; this solution is {kind}: call {call}")
    # a batch has an additional axis, which interpolation would mistake for an axis of the grid
    shape, wanted = np.shape(values), solution.grid.shape
    if marched:
        wanted = np.shape(solution.times) + wanted
    if shape[: len(wanted)] != wanted or len(shape) != len(wanted) + trailing:
        raise ValueError(
            f"Solution.{name}: got node values of shape {shape} on a grid of shape {wanted}; query a batch of "
            f"solutions one at a time: jax.vmap(lambda solution, x: solution.{name}(x))"
        )
    return (where[0] if marched else None), where[-1]
