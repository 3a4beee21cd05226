"""Wavefront Gauss–Seidel: δ(x) ← s(x) + Σ_o w_o(x) δ(x + o), one hyperplane of nodes at a time.

For the star stencil the nodes on a hyperplane i₀ + i₁ + … = const do not depend on each other. The arrays are skewed
cyclically along the first axis,

    S[d, j] = X[(d − Σ_k j_k) mod n₀, j],

so that such a hyperplane is one slice S[d] (or several, folded). Its neighbours are in S[d − 1] and S[d + 1], shifted
by one entry for the axes beyond the first. A forward sweep goes through the slices upwards, a backward sweep downwards,
and flipping axes beyond the first before skewing gives all 2ⁿ orders. Values across the seam of a periodic axis beyond
the first are from the previous sweep.

If the arrays exceed a processor's cache, slabs of slices are swept several times instead of all slices once.

With several devices, each sweeps its own nodes: block Jacobi between the parts. The arrays of a part have an additional
layer next to a divided axis, with rows without weights whose source is the δ beyond, fetched before every pair of
sweeps.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.iteration.bellman import PolicyEquation
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Field, Scalar

Index: TypeAlias = int | Scalar  # of a slice; traced inside a loop
Weights = list[tuple[jax.Array, ...]]  # for each axis, as returned by ``_towards``

CACHE = 2**25  # bytes of the processor's cache
SLAB = 64  # slices swept back and forth while they are in the cache
KNOWN: Any = {"mode": "promise_in_bounds", "unique_indices": True}  # for indices that are valid by construction
FURTHER = 4  # parts along an axis per extra round: with 8 parts and no extra round, solves took 16 steps, not 12
FOLDS = 4  # up to this number of comparisons replace a division, which XLA does not fuse


def sweep(equation: PolicyEquation, grid: Grid, rounds: int) -> Field:
    """Sweeps from zero, ``rounds`` times forward and backward in every order; for jumps along the axes only.

    The orders are one loop, so that one program serves them all and its operands are arrays in memory: a fused gather
    would compute every entry separately.
    """
    arrays = _arrays_of(grid)
    equation = _with_layers(equation, arrays)
    # information crosses one part per sweep
    rounds += max(grid.layout.sizes) // FURTHER

    def order(index: jax.Array, delta: jax.Array) -> jax.Array:
        # one bit per axis beyond the first; forward and backward sweeps are the two directions along the first
        flips = [(index >> axis) & 1 for axis in range(grid.ndim - 1)]
        source = _sheared(equation.source, flips)
        weights = [_towards(equation, arrays, axis, flips) for axis in range(grid.ndim)]

        def whole(planes: jax.Array) -> jax.Array:
            return _in_turns(source, weights, planes, arrays, rounds, flips)

        def in_slabs(planes: jax.Array) -> jax.Array:
            return _in_slabs(source, weights, planes, arrays, rounds, flips)

        # a margin of one entry next to the axes beyond the first, so that neighbours are slices without a branch
        planes = jnp.pad(_sheared(delta, flips), _margins(grid.ndim))
        if _outgrows_the_cache(source, weights):
            planes = jax.lax.platform_dependent(planes, cpu=in_slabs, default=whole)
        else:
            planes = whole(planes)
        return _from_planes(planes, flips)

    delta = jax.lax.fori_loop(0, 2 ** (grid.ndim - 1), order, jnp.zeros_like(equation.source))
    inside = tuple(slice(1, -1) if arrays.is_divided(axis) else slice(None) for axis in range(grid.ndim))
    return jnp.moveaxis(delta[inside], 0, arrays.axes[0])


@dataclasses.dataclass(frozen=True)
class Arrays:
    """The arrangement of the grid's axes in the arrays of a sweep, and the additional layers.

    Attributes:
      grid: the grid.
      axes: the grid's axes, in the order of the arrays' axes.
    """

    grid: Grid
    axes: tuple[int, ...]

    def is_divided(self, axis: int) -> bool:
        """True if an axis of the arrays has a layer on both sides, for the nodes on other devices."""
        return self.grid.layout.is_divided(self.axes[axis])

    def closes(self, axis: int) -> bool:
        """True if an axis of the arrays is periodic and not divided."""
        return bool(self.grid.periodic[self.axes[axis]]) and not self.is_divided(axis)


def _arrays_of(grid: Grid) -> Arrays:
    """The arrays with the axes in order; if a part is so flat that hyperplanes would fold often, longest axis first."""
    axes = list(range(grid.ndim))
    if grid.layout.axes and _folds(grid.shape) > FOLDS:
        axes.sort(key=lambda axis: axis != int(np.argmax(grid.shape)))
    return Arrays(grid, tuple(axes))


def _with_layers(equation: PolicyEquation, arrays: Arrays) -> PolicyEquation:
    """The equation with a layer of zeros on both sides of every divided axis; filler nodes are zeroed too."""
    layout = arrays.grid.layout
    if not layout.axes:
        return equation
    widths = [(int(arrays.is_divided(axis)),) * 2 for axis in range(arrays.grid.ndim)]

    def lay(leaf: jax.Array) -> jax.Array:
        return jnp.pad(jnp.moveaxis(layout.cleared(leaf), arrays.axes[0], 0), widths) if leaf.ndim else leaf

    return jax.tree.map(lay, equation)


Carried = tuple[jax.Array, jax.Array]  # planes, and the source, whose layers change between pairs of sweeps


def _exchanged(carried: Carried, arrays: Arrays, flips: list[jax.Array]) -> Carried:
    """Planes and source, with the δ of the nodes beyond this part in the layers around it."""
    (planes, source), layout = carried, arrays.grid.layout
    for axis in range(source.ndim):
        if not arrays.is_divided(axis):
            continue
        along = arrays.axes[axis]
        count, cyclic = layout.count(along), bool(arrays.grid.periodic[along])
        for step, first, layer in ((1, 1, count + 1), (-1, count, 0)):
            # the adjacent part requires the node of this part at that end; indices count the layer
            given = planes.at[_within(_places(source.shape, axis, first, flips))].get(**KNOWN)
            found, there = layout.fetched(given, along, step, cyclic=cyclic), _places(source.shape, axis, layer, flips)
            planes = planes.at[_within(there)].set(found, **KNOWN)
            source = source.at[there].set(found, **KNOWN)
    return planes, source


def _margins(ndim: int) -> list[tuple[int, int]]:
    """The padding of planes before and after the nodes along every axis."""
    return [(0, 0), *[(1, 1)] * (ndim - 1)]


def _within(places: Sequence[Any]) -> tuple[Any, ...]:
    """Convert indices into skewed arrays to indices into planes, which have margins."""
    return tuple(place + (axis > 0) for axis, place in enumerate(places))


def _places(shape: tuple[int, ...], axis: int, number: Index, flips: list[jax.Array]) -> tuple[jax.Array, ...]:
    """The indices, in skewed arrays, of the nodes with the given ``number`` along an axis."""
    sizes = [1 if k == axis else size for k, size in enumerate(shape)]
    row, *columns = (
        jax.lax.broadcasted_iota(jnp.int32, sizes, k) + (number if k == axis else 0) for k in range(len(shape))
    )
    columns = [
        jnp.where(flip == 1, size - 1 - column, column)
        for column, size, flip in zip(columns, shape[1:], flips, strict=True)
    ]
    return (row + sum(columns)) % shape[0], *columns


def _outgrows_the_cache(source: jax.Array, weights: Weights) -> bool:
    """True if all slices together exceed a processor's cache and a slab of them does not."""
    arrays = 2 + sum(map(len, weights))  # source and planes, in addition to the weights
    size = arrays * source.size * source.dtype.itemsize
    # half of the cache, since the previous and the next slab pass through it too
    return size > CACHE and SLAB * size / len(source) < CACHE / 2


def _in_turns(
    source: jax.Array, weights: Weights, planes: jax.Array, arrays: Arrays, rounds: int, flips: list[jax.Array]
) -> jax.Array:
    """Sweep all slices upwards and downwards, ``rounds`` times."""

    def sweep(k: jax.Array, planes: jax.Array, source: jax.Array = source) -> jax.Array:
        # one program for both directions
        return _sweep(source, weights, _wrapped(planes, arrays), 0, len(source), up=k % 2 == 0)

    def pair(_: Index, carried: Carried) -> Carried:
        planes, source = _exchanged(carried, arrays, flips)
        return jax.lax.fori_loop(0, 2, functools.partial(sweep, source=source), planes), source

    if not arrays.grid.layout.axes:
        return jax.lax.fori_loop(0, 2 * rounds, sweep, planes)
    return jax.lax.fori_loop(0, rounds, pair, (planes, source))[0]


def _in_slabs(
    source: jax.Array, weights: Weights, planes: jax.Array, arrays: Arrays, rounds: int, flips: list[jax.Array]
) -> jax.Array:
    """Sweep slab after slab upwards and then downwards, each slab back and forth while it is in the cache.

    Memory beyond the cache is read twice instead of 2 ``rounds`` times. A slab is swept 2 ``rounds`` - 1 times while it
    is in the cache, at least three times.
    """
    count = len(source)
    slabs = -(-count // SLAB)  # the last one may be shorter

    def way(k: jax.Array, carried: Carried) -> Carried:
        upwards, (planes, source) = k == 0, _exchanged(carried, arrays, flips)

        def slab(index: jax.Array, planes: jax.Array) -> jax.Array:
            first = SLAB * jnp.where(upwards, index, slabs - 1 - index)
            last = jnp.minimum(first + SLAB, count)

            def sweep(k: jax.Array, planes: jax.Array) -> jax.Array:
                return _sweep(source, weights, planes, first, last, up=upwards == (k % 2 == 0))

            return jax.lax.fori_loop(0, max(2 * rounds - 1, 3), sweep, planes)

        # fill the margins once per direction: doing so between slabs would read all planes
        return jax.lax.fori_loop(0, slabs, slab, _wrapped(planes, arrays)), source

    return jax.lax.fori_loop(0, 2, way, (planes, source))[0]


def _towards(equation: PolicyEquation, arrays: Arrays, axis: int, flips: list[jax.Array]) -> tuple[jax.Array, ...]:
    """The skewed weights (up, down) along an axis, or (up − down,) if at most one of the two is positive."""
    table = dict(zip(equation.weights.offsets, equation.weights.values, strict=True))
    up, down = (table[stencil.unit(arrays.grid, arrays.axes[axis], step)] for step in (1, -1))
    flipped = flips[axis - 1] == 1 if axis else False
    # one array instead of two halves the memory traffic, which limits the speed; the sign gives the direction
    if equation.weights.one_way:
        return (_sheared((up - down) * jnp.where(flipped, -1, 1).astype(up.dtype), flips),)
    return _sheared(jnp.where(flipped, down, up), flips), _sheared(jnp.where(flipped, up, down), flips)


def _wrapped(planes: jax.Array, arrays: Arrays) -> jax.Array:
    """The planes with margins filled across the seams of periodic axes beyond the first."""
    for axis in range(1, planes.ndim):
        if arrays.closes(axis):
            planes = _with_margins(planes, axis)
    return planes


def _with_margins(planes: jax.Array, axis: int) -> jax.Array:
    """Fill both margins of an axis from its other end; across a seam a hyperplane continues in another slice.

    In a loop the update is in place; outside, XLA would copy all planes to keep the old ones.
    """
    count = planes.shape[axis] - 2

    def fill(side: jax.Array, planes: jax.Array) -> jax.Array:
        above = side == 0
        inner = jax.lax.dynamic_slice_in_dim(planes, jnp.where(above, 1, count), 1, axis)
        start: list[Index] = [0] * planes.ndim
        # S[d, j] with d − Σ j: moving by a whole axis sideways is the same number of slices further
        inner = jnp.roll(inner, jnp.where(above, count, -count), axis=0)
        start[axis] = jnp.where(above, count + 1, 0)
        return jax.lax.dynamic_update_slice(planes, inner, start)

    return jax.lax.fori_loop(0, 2, fill, planes)


def _sweep(
    source: jax.Array, weights: Weights, planes: jax.Array, first: Index, last: Index, *, up: jax.Array
) -> jax.Array:
    """One pass over the slices from ``first`` to ``last``; ``planes`` has margins for the axes beyond the first."""
    count = len(source)

    def row(values: jax.Array, d: Index) -> jax.Array:
        # d is never negative; JAX would add a comparison and a select to every start index
        return jax.lax.dynamic_slice_in_dim(values, d, 1, allow_negative_indices=False)

    def core(slab: jax.Array, axis: int, step: int) -> jax.Array:
        """A slice without its margin, shifted by ``step`` along an axis of the grid beyond the first."""
        starts = [1 + step * (k == axis) for k in range(1, source.ndim)]
        cut = (slice(start, start + size) for start, size in zip(starts, source.shape[1:], strict=True))
        return slab[(slice(None), *cut)]

    def relax(k: jax.Array, planes: jax.Array) -> jax.Array:
        d = jnp.where(up, k, first + last - 1 - k)
        # cyclic: after the last slice comes the first one, across the fold
        below, above = row(planes, jnp.where(d == 0, count, d) - 1), row(planes, jnp.where(d == count - 1, 0, d + 1))
        new = row(source, d)
        for axis, pair in enumerate(weights):
            rows, up_there, down_there = [row(w, d) for w in pair], core(above, axis, 1), core(below, axis, -1)
            if len(rows) == 2:
                new = new + rows[0] * up_there + rows[1] * down_there
            else:
                # up − down: a positive weight goes up, a negative one goes down
                new = new + rows[0] * jnp.where(rows[0] > 0, up_there, -down_there)
        start: tuple[Index, ...] = (d, *(1 for _ in source.shape[1:]))
        return jax.lax.dynamic_update_slice(planes, new, start, allow_negative_indices=False)

    return jax.lax.fori_loop(first, last, relax, planes)


def _folds(shape: tuple[int, ...]) -> int:
    """The number of times that Σ j, which ranges over Σ (n_k − 1), may wrap around the first axis."""
    count, *counts = shape
    return -(-(sum(counts) - len(counts)) // count)


def _sheared(values: jax.Array, flips: list[jax.Array]) -> jax.Array:
    """S[d, j] = X[(d − Σ_k j_k) mod n₀, j] of the flipped array."""
    row, columns, flipped = _entries(values.shape, flips)
    return _gathered(values, [_folded(row - sum(columns), values.shape, back=False), *flipped])


def _from_planes(planes: jax.Array, flips: list[jax.Array]) -> jax.Array:
    """Recover X from its planes, which have margins.

    The indices skip the margin. Slicing the margin off first would be fused into the gather, with a division per entry,
    and take six times as long.
    """
    shape = tuple(size - sum(margin) for size, margin in zip(planes.shape, _margins(planes.ndim), strict=True))
    row, _, flipped = _entries(shape, flips)
    first = _folded(row + sum(flipped), shape, back=True)
    return _gathered(planes, list(_within((first, *flipped))))


def _entries(shape: tuple[int, ...], flips: list[jax.Array]) -> tuple[jax.Array, list[jax.Array], list[jax.Array]]:
    """The indices of every entry: along the first axis, along the others, and along the others after flipping."""
    zero, *flips = jax.lax.optimization_barrier((jnp.int32(0), *flips))  # otherwise the loop stores indices
    row, *columns = (jax.lax.broadcasted_iota(jnp.int32, shape, axis) + zero for axis in range(len(shape)))
    flipped = [
        jnp.where(flip == 1, size - 1 - column, column)
        for column, size, flip in zip(columns, shape[1:], flips, strict=True)
    ]
    return row, columns, flipped


def _folded(place: jax.Array, shape: tuple[int, ...], *, back: bool) -> jax.Array:
    """An index along the skewed axis modulo n₀: from below if columns were subtracted, with ``back`` from above."""
    count, folds = shape[0], _folds(shape)
    if folds > FOLDS:
        return place % count
    step = -count if back else count
    for _ in range(folds):
        place = jnp.where(place >= count if back else place < 0, place + step, place)
    return place


def _gathered(values: jax.Array, places: list[jax.Array]) -> jax.Array:
    """The entries of an array at these indices: one gather from the flat array, without clamping."""
    flat, *others = places
    for place, size in zip(others, values.shape[1:], strict=True):
        flat = flat * size + place
    # in bounds by construction, and never negative
    return values.reshape(-1).at[flat].get(mode="promise_in_bounds", wrap_negative_indices=False)
