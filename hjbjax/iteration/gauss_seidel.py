"""Wavefront Gauss–Seidel: δ(x) ← s(x) + Σ_o w_o(x) δ(x + o), one hyperplane of nodes at a time.

For the star stencil the nodes on a hyperplane i₀ + i₁ + … = const do not depend on each other. The arrays are skewed
cyclically along the first axis,

    S[d, j] = X[(d − Σ_k j_k) mod n₀, j],

so that such a hyperplane is one slice S[d] (or several, folded). Its neighbours are in S[d − 1] and S[d + 1], shifted
by one entry for the axes beyond the first. A forward sweep goes through the slices upwards, a backward sweep downwards,
and flipping axes beyond the first before skewing gives all 2ⁿ orders. Values across the seam of a periodic axis beyond
the first are from the previous sweep.

If the arrays exceed a processor's cache, slabs of slices are swept several times instead of all slices once.

With modes, all modes of a node are updated simultaneously. Their jumps to one another, M, are solved for exactly:
δ(x) ← (I − M(x))⁻¹ (s(x) + Σ_o w_o(x) δ(x + o)), with one small matrix per node. In the arrays the modes are the second
axis, which is neither skewed nor flipped.

With several devices, each sweeps its own nodes: block Jacobi between the parts. The arrays of a part have an additional
layer next to a divided axis, with rows without weights whose source is the δ beyond, fetched before every pair of
sweeps.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.iteration.bellman import PolicyEquation
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Field, Scalar

Index: TypeAlias = int | Scalar  # index of a slice; traced inside a loop

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

    mixing = _mixing(equation, arrays)

    def order(index: jax.Array, delta: jax.Array) -> jax.Array:
        # one bit per axis beyond the first; forward and backward sweeps are the two directions along the first
        flips = [(index >> bit) & 1 for bit in range(len(arrays.skewed))]
        if arrays.modes is not None:
            flips.insert(arrays.modes - 1, jnp.zeros_like(index))
        source = _sheared(equation.source, flips, arrays)
        along = {axis: _towards(equation, arrays, axis, flips) for axis in (0, *arrays.skewed)}
        weights = Weights(along, tuple(_sheared(each, flips, arrays) for each in mixing))

        def whole(planes: jax.Array) -> jax.Array:
            return _in_turns(source, weights, planes, arrays, rounds, flips)

        def in_slabs(planes: jax.Array) -> jax.Array:
            return _in_slabs(source, weights, planes, arrays, rounds, flips)

        # a margin of one entry next to the axes beyond the first, so that neighbours are slices without a branch
        planes = jnp.pad(_sheared(delta, flips, arrays), arrays.margins)
        if _outgrows_the_cache(source, weights):
            planes = jax.lax.platform_dependent(planes, cpu=in_slabs, default=whole)
        else:
            planes = whole(planes)
        return _from_planes(planes, flips, arrays)

    delta = jax.lax.fori_loop(0, 2 ** len(arrays.skewed), order, jnp.zeros_like(equation.source))
    inside = tuple(slice(1, -1) if arrays.is_divided(axis) else slice(None) for axis in range(grid.ndim))
    return jnp.moveaxis(delta[inside], 0, arrays.axes[0])


@dataclasses.dataclass(frozen=True)
class Arrays:
    """The arrangement of the grid's axes in the arrays of a sweep, and the additional layers.

    Attributes:
      grid: the grid.
      axes: the grid's axes, in the order of the arrays' axes; an axis of modes is the second.
    """

    grid: Grid
    axes: tuple[int, ...]

    @property
    def modes(self) -> int | None:
        """The axis of the arrays that is an axis of modes, or None."""
        return self.axes.index(0) if self.grid.modes else None

    @property
    def skewed(self) -> tuple[int, ...]:
        """The axes of the arrays that are skewed: all beyond the first, except modes."""
        return tuple(axis for axis in range(1, len(self.axes)) if axis != self.modes)

    @property
    def margins(self) -> list[tuple[int, int]]:
        """The padding of planes before and after the nodes along every axis."""
        return [(1, 1) if axis in self.skewed else (0, 0) for axis in range(len(self.axes))]

    def is_divided(self, axis: int) -> bool:
        """True if an axis of the arrays has a layer on both sides, for the nodes on other devices."""
        return self.grid.layout.is_divided(self.axes[axis])

    def closes(self, axis: int) -> bool:
        """True if an axis of the arrays is periodic and not divided."""
        return axis in self.skewed and bool(self.grid.periodic[self.axes[axis]]) and not self.is_divided(axis)


class Weights(NamedTuple):
    """The skewed weights of an equation.

    Attributes:
      along: for every axis of the arrays along which nodes are linked, as returned by ``_towards``.
      mixing: the entries (i, i + d) of (I − M)⁻¹, for d = 0, ..., k − 1; empty without jumps between modes.
    """

    along: dict[int, tuple[jax.Array, ...]]
    mixing: tuple[jax.Array, ...]

    @property
    def size(self) -> int:
        """The number of arrays."""
        return sum(map(len, self.along.values())) + len(self.mixing)


def _arrays_of(grid: Grid) -> Arrays:
    """The arrays with the axes in order; if a part is so flat that hyperplanes would fold often, longest axis first."""
    if grid.modes:
        return Arrays(grid, (1, 0, *range(2, grid.ndim)))
    axes = list(range(grid.ndim))
    if grid.layout.axes and _folds(grid.shape) > FOLDS:
        axes.sort(key=lambda axis: axis != int(np.argmax(grid.shape)))
    return Arrays(grid, tuple(axes))


def _with_layers(equation: PolicyEquation, arrays: Arrays) -> PolicyEquation:
    """The equation with a layer of zeros on both sides of every divided axis; filler nodes are zeroed too."""
    layout = arrays.grid.layout
    if not layout.axes and not arrays.grid.modes:
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
            given = planes.at[_within(_places(source.shape, axis, first, flips, arrays), arrays)].get(**KNOWN)
            there = _places(source.shape, axis, layer, flips, arrays)
            found = layout.fetched(given, along, step, cyclic=cyclic)
            planes = planes.at[_within(there, arrays)].set(found, **KNOWN)
            source = source.at[there].set(found, **KNOWN)
    return planes, source


def _within(places: Sequence[Any], arrays: Arrays) -> tuple[Any, ...]:
    """Convert indices into skewed arrays to indices into planes, which have margins."""
    return tuple(place + before for place, (before, _) in zip(places, arrays.margins, strict=True))


def _places(
    shape: tuple[int, ...], axis: int, number: Index, flips: list[jax.Array], arrays: Arrays
) -> tuple[jax.Array, ...]:
    """The indices, in skewed arrays, of the nodes with the given ``number`` along an axis."""
    sizes = [1 if k == axis else size for k, size in enumerate(shape)]
    row, *columns = (
        jax.lax.broadcasted_iota(jnp.int32, sizes, k) + (number if k == axis else 0) for k in range(len(shape))
    )
    columns = [
        jnp.where(flip == 1, size - 1 - column, column)
        for column, size, flip in zip(columns, shape[1:], flips, strict=True)
    ]
    return (row + sum(columns[k - 1] for k in arrays.skewed)) % shape[0], *columns


def _outgrows_the_cache(source: jax.Array, weights: Weights) -> bool:
    """True if all slices together exceed a processor's cache and a slab of them does not."""
    arrays = 2 + weights.size  # source and planes, in addition to the weights
    size = arrays * source.size * source.dtype.itemsize
    # half of the cache, since the previous and the next slab pass through it too
    return size > CACHE and SLAB * size / len(source) < CACHE / 2


def _in_turns(
    source: jax.Array, weights: Weights, planes: jax.Array, arrays: Arrays, rounds: int, flips: list[jax.Array]
) -> jax.Array:
    """Sweep all slices upwards and downwards, ``rounds`` times."""

    def sweep(k: jax.Array, planes: jax.Array, source: jax.Array = source) -> jax.Array:
        # one program for both directions
        return _sweep(source, weights, _wrapped(planes, arrays), arrays, (0, len(source)), up=k % 2 == 0)

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
                return _sweep(source, weights, planes, arrays, (first, last), up=upwards == (k % 2 == 0))

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
        return (_sheared((up - down) * jnp.where(flipped, -1, 1).astype(up.dtype), flips, arrays),)
    pair = (down, up), (up, down)
    higher, lower = (_sheared(jnp.where(flipped, *each), flips, arrays) for each in pair)
    return higher, lower


def _mixing(equation: PolicyEquation, arrays: Arrays) -> list[jax.Array]:
    """The entries (i, i + d) of (I − M)⁻¹ at every node, for d = 0, ..., k − 1; empty without jumps between modes.

    I − M is a diagonally dominant M-matrix, so elimination needs no exchange of rows. A row sum of zero, where nothing
    leaves a set of modes, has no inverse; its pivot counts as one, since sweeps are only approximate.
    """
    grid, table = arrays.grid, dict(zip(equation.weights.offsets, equation.weights.values, strict=True))
    count = len(grid.modes)
    jumps = [table.get(stencil.unit(grid, 0, number)) for number in range(1, count)]
    if arrays.modes is None or all(jump is None for jump in jumps):
        return []
    zero = jnp.zeros_like(equation.source)
    steps = [zero + 1, *(zero if jump is None else -jump for jump in jumps)]
    entries = [jnp.moveaxis(step, arrays.modes, 0) for step in steps]
    matrix = jnp.stack([jnp.stack([entries[(j - i) % count][i] for j in range(count)]) for i in range(count)])

    def eliminate(p: Scalar, a: jax.Array) -> jax.Array:
        row, column, pivot = a[p], a[:, p], a[p, p]
        pivot = jnp.where(pivot > jnp.finfo(a.dtype).eps, pivot, 1)
        a = a - column[:, None] * (row / pivot)[None]
        a = a.at[p].set(row / pivot).at[:, p].set(-column / pivot)
        return a.at[p, p].set(1 / pivot)

    inverse = jax.lax.fori_loop(0, count, eliminate, matrix)
    turned = [jnp.stack([inverse[i, (i + d) % count] for i in range(count)]) for d in range(count)]
    return [jnp.moveaxis(each, 0, arrays.modes) for each in turned]


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
        # S[d, j] depends on d − Σ j, so a shift of j by the whole axis is a shift of d by the same number of slices
        inner = jnp.roll(inner, jnp.where(above, count, -count), axis=0)
        start[axis] = jnp.where(above, count + 1, 0)
        return jax.lax.dynamic_update_slice(planes, inner, start)

    return jax.lax.fori_loop(0, 2, fill, planes)


def _sweep(
    source: jax.Array, weights: Weights, planes: jax.Array, arrays: Arrays, lot: tuple[Index, Index], *, up: jax.Array
) -> jax.Array:
    """One pass over a range (first, last) of slices; ``planes`` has margins for the skewed axes."""
    (first, last), count = lot, len(source)
    margins = [before for before, _ in arrays.margins[1:]]

    def row(values: jax.Array, d: Index) -> jax.Array:
        # d is never negative; JAX would add a comparison and a select to every start index
        return jax.lax.dynamic_slice_in_dim(values, d, 1, allow_negative_indices=False)

    def core(slab: jax.Array, axis: int, step: int) -> jax.Array:
        """A slice without its margin, shifted by ``step`` along an axis of the grid beyond the first."""
        starts = [margin + step * (k == axis) for k, margin in enumerate(margins, start=1)]
        cut = (slice(start, start + size) for start, size in zip(starts, source.shape[1:], strict=True))
        return slab[(slice(None), *cut)]

    def relax(k: jax.Array, planes: jax.Array) -> jax.Array:
        d = jnp.where(up, k, first + last - 1 - k)
        # cyclic: after the last slice comes the first one, across the fold
        below, above = row(planes, jnp.where(d == 0, count, d) - 1), row(planes, jnp.where(d == count - 1, 0, d + 1))
        new = row(source, d)
        for axis, pair in weights.along.items():
            rows, up_there, down_there = [row(w, d) for w in pair], core(above, axis, 1), core(below, axis, -1)
            if len(rows) == 2:
                new = new + rows[0] * up_there + rows[1] * down_there
            else:
                # up − down: a positive weight goes up, a negative one goes down
                new = new + rows[0] * jnp.where(rows[0] > 0, up_there, -down_there)
        if weights.mixing:  # all modes of the nodes of the slice at once
            mixed = [row(each, d) * jnp.roll(new, -k, arrays.modes) for k, each in enumerate(weights.mixing)]
            new = sum(mixed[1:], start=mixed[0])
        start: tuple[Index, ...] = (d, *margins)
        return jax.lax.dynamic_update_slice(planes, new, start, allow_negative_indices=False)

    return jax.lax.fori_loop(first, last, relax, planes)


def _folds(shape: tuple[int, ...]) -> int:
    """The number of times that Σ j, over axes of this shape, may wrap around the first axis."""
    count, *counts = shape
    return -(-(sum(counts) - len(counts)) // count)


def _sheared(values: jax.Array, flips: list[jax.Array], arrays: Arrays) -> jax.Array:
    """S[d, j] = X[(d − Σ_k j_k) mod n₀, j] of the flipped array."""
    row, columns, flipped = _entries(values.shape, flips)
    place = row - sum(columns[axis - 1] for axis in arrays.skewed)
    return _gathered(values, [_folded(place, values.shape, arrays, back=False), *flipped])


def _from_planes(planes: jax.Array, flips: list[jax.Array], arrays: Arrays) -> jax.Array:
    """Recover X from its planes, which have margins.

    The indices skip the margin. Slicing the margin off first would be fused into the gather, with a division per entry,
    and take six times as long.
    """
    shape = tuple(size - sum(margin) for size, margin in zip(planes.shape, arrays.margins, strict=True))
    row, _, flipped = _entries(shape, flips)
    first = _folded(row + sum(flipped[axis - 1] for axis in arrays.skewed), shape, arrays, back=True)
    return _gathered(planes, list(_within((first, *flipped), arrays)))


def _entries(shape: tuple[int, ...], flips: list[jax.Array]) -> tuple[jax.Array, list[jax.Array], list[jax.Array]]:
    """The indices of every entry: along the first axis, along the others, and along the others after flipping."""
    zero, *flips = jax.lax.optimization_barrier((jnp.int32(0), *flips))  # otherwise the loop stores indices
    row, *columns = (jax.lax.broadcasted_iota(jnp.int32, shape, axis) + zero for axis in range(len(shape)))
    flipped = [
        jnp.where(flip == 1, size - 1 - column, column)
        for column, size, flip in zip(columns, shape[1:], flips, strict=True)
    ]
    return row, columns, flipped


def _folded(place: jax.Array, shape: tuple[int, ...], arrays: Arrays, *, back: bool) -> jax.Array:
    """An index along the first axis modulo n₀: a negative index, or with ``back`` an index of at least n₀, is moved."""
    count, folds = shape[0], _folds((shape[0], *(shape[axis] for axis in arrays.skewed)))
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
