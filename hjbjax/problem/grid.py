"""The grid of nodes on which a value function is defined.

Node-centred: both ends of an ordinary axis are nodes; a periodic axis omits its upper end. Coordinates are
x_i = (lo·(M − i) + hi·i)/M with M = N − 1 (M = N on a periodic axis), so that a node at zero is exactly zero. NumPy
computes them once, as one table per axis that is stored with the grid. A compiled division rounds differently, but all
programs must agree whether a node on the boundary of a target is inside.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.problem import arguments
from hjbjax.problem.ends import PRESCRIBED, on_face
from hjbjax.problem.labels import with_unit, words
from hjbjax.problem.layouts import Layout, Parts
from hjbjax.problem.pytree import altered, is_traced, known, pytree_dataclass, with_ways_out
from hjbjax.problem.settings import own_settings
from hjbjax.problem.stretching import Stretching, checked_table, from_table, into_period
from hjbjax.problem.types import Array, DType, Number, Numbers, States
from hjbjax.problem.words import OF_GRID

CONTINUED = ("open", "linear", "robin")  # kinds of ends beyond which V is extended
TABLED = 2**24  # points of an axis with a stored table, 128 MiB; a larger grid must not allocate before it is refused


@with_ways_out(OF_GRID)
@pytree_dataclass(static=("shape", "periodic", "names", "edges", "units", "modes"))
class Grid:
    """A grid of nodes on a box in R^n, uniform along every axis that is not stretched.

    Args:
      lo: lower corner, shape (n,), in the units of each state.
      hi: upper corner, shape (n,); on a periodic axis the point that is identified with ``lo``.
      shape: number of nodes per axis, n integers of at least 2.
      periodic: one bool per axis. Default: no periodic axes.
      names: one name per axis, used by plots and printed tables.
      stretch: one ``Sinh(strength, center)`` or ``None`` per axis. Default: uniform spacing. Not on a periodic axis.
      edges: the treatment of drift that points out of the box: a name for every end, or one entry per axis, a name or
        a pair (lower end, upper end); ``None`` on a periodic axis, which has no ends.
        "projected": the outward component is set to zero, while the control keeps its cost.
        "constrained": actions whose drift leaves the box are not admissible: the state-constrained problem.
        "open": paths may leave; beyond the end V is extended by the parabola through its last three nodes.
        "linear": paths may leave; beyond the end V is extended by the straight line through its last two nodes.
        Noise reflects at a projected or constrained end, on the node itself, and uses the extension of V at the others.
        A prescribed end: see ``Dirichlet(value)``, ``Neumann(slope)`` and ``Robin(rate)``.
      units: one unit per axis, as in ("rad", "rad/s"), for plots and printed tables; empty without a unit.

    Raises:
      ValueError: bounds that are not finite or not increasing, lengths that differ, or an unknown kind of end.
      TypeError: sizes that are not integers, periodicities that are not booleans.

    Example:
      >>> grid = Grid(lo=[-1.0, 0.0], hi=[1.0, 1.0], shape=(5, 4), periodic=(False, True))
      >>> grid.axis(0).tolist(), grid.axis(1).tolist()
      ([-1.0, -0.5, 0.0, 0.5, 1.0], [0.0, 0.25, 0.5, 0.75])
    """

    lo: Any
    hi: Any
    shape: tuple[int, ...]
    periodic: tuple[bool, ...] = ()
    names: tuple[str, ...] = ()
    stretch: tuple[Stretching | None, ...] = ()
    edges: Any = "projected"
    units: tuple[str, ...] = ()
    modes: tuple[str, ...] = dataclasses.field(init=False, repr=False, default=())  # see ``mode_axis``
    _coordinates: tuple[Any, ...] = dataclasses.field(init=False, repr=False)
    _spacings: tuple[Any, ...] | None = dataclasses.field(init=False, repr=False, default=None)  # see ``tabulated``
    _layout: Layout | None = dataclasses.field(init=False, repr=False, default=None)  # None: all nodes on one device
    _faces: tuple[Any, ...] = dataclasses.field(init=False, repr=False, default=())  # the numbers of prescribed ends

    def __post_init__(self) -> None:
        lo, hi = arguments.corner(self.lo, "lo"), arguments.corner(self.hi, "hi")
        shape = arguments.counts(self.shape)
        periodic = arguments.periodic_flags(self.periodic, len(shape))
        names = arguments.axis_names(self.names, len(shape))
        stretch = arguments.stretchings(self.stretch, len(shape))
        lengths = (len(lo), len(hi), len(shape), len(periodic), len(names), len(stretch))
        if len(set(lengths)) != 1:
            raise ValueError(
                "Grid: got lo, hi, shape, periodic, names and stretch of lengths {}, {}, {}, {}, {} and {}; "
                "wanted one entry per axis in each".format(*lengths)
            )
        arguments.check_stretch(stretch, periodic)
        if isinstance(lo, np.ndarray) and isinstance(hi, np.ndarray):  # traced corners cannot be compared
            for axis, (low, high) in enumerate(zip(lo, hi, strict=True)):
                if not (math.isfinite(low) and math.isfinite(high) and low < high):
                    raise ValueError(f"Grid: axis {axis} runs from {low:g} to {high:g}; wanted finite lo < hi")
        ends = arguments.pairs_of_ends(self.edges, periodic, shape)
        edges = arguments.kinds_of_ends(ends)
        units = words(self.units, len(shape), "Grid.units") or ("",) * len(shape)
        checked = {
            "lo": lo, "hi": hi, "shape": shape, "periodic": periodic, "names": names, "stretch": stretch,
            "edges": edges, "units": units,
        }  # fmt: skip
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        tables = (self._by_formula(axis) if count <= TABLED else None for axis, count in enumerate(shape))
        object.__setattr__(self, "_coordinates", tuple(tables))
        object.__setattr__(self, "_faces", tuple(self._prescriptions(axis, given) for axis, given in enumerate(ends)))
        check_spacings(self, np.float64)  # a solve repeats this in its own dtype, which may be float32

    def _prescriptions(self, axis: int, pair: tuple[Any, Any] | None) -> tuple[Any, Any] | None:
        """The prescriptions at the two ends of an axis, evaluated at their nodes; None if neither is prescribed."""
        if pair is None or not any(isinstance(end, PRESCRIBED) for end in pair):
            return None
        found: list[Any] = []
        for end, index in zip(pair, (0, -1), strict=True):
            if not isinstance(end, PRESCRIBED):
                found.append(None)
                continue
            along = [self.axis(i) if i != axis else self.axis(i)[index : index + 1 or None] for i in range(self.ndim)]
            xp: Any = jnp if is_traced(along) else np
            nodes = xp.stack(xp.meshgrid(*along, indexing="ij"), axis=-1)
            name = f"Grid.edges: {type(end).__name__} at an end of {self.names[axis]}"
            numbers = {each.name: on_face(getattr(end, each.name), nodes, name) for each in dataclasses.fields(end)}
            found.append(altered(end, **numbers))
        return found[0], found[1]

    def prescribed(self, *kinds: str) -> list[tuple[int, int, Any]]:
        """The prescribed ends of these kinds, or of all kinds: axis, step, and the prescription at the nodes."""
        found = (
            (axis, step, pair[(step + 1) // 2]) for axis, pair in enumerate(self._faces) if pair for step in (-1, 1)
        )
        return [each for each in found if each[2] is not None and (not kinds or each[2].kind in kinds)]

    @property
    def ndim(self) -> int:
        """The number of states n."""
        return len(self.shape)

    @property
    def state_axes(self) -> tuple[int, ...]:
        """The axes along which the state moves: all, except a first axis of modes, along which it only jumps."""
        return tuple(range(1 if self.modes else 0, self.ndim))

    @property
    def labels(self) -> tuple[str, ...]:
        """One text per axis: its name, and its unit in brackets if it has one."""
        return tuple(map(with_unit, self.names, self.units))

    @property
    def size(self) -> int:
        """The number of nodes, a Python integer of any size."""
        return math.prod(self.shape)

    def sides(self, kind: str) -> list[tuple[int, int]]:
        """The sides of the box with ends of this kind: pairs of an axis and a step, −1 lower and 1 upper.

        Linear and Robin ends count as "open": V is extended beyond all three, and none belongs to a Markov chain.
        """
        kinds = CONTINUED if kind == "open" else (kind,)
        ends = ((axis, pair) for axis, pair in enumerate(self.edges) if pair is not None)  # None: a periodic axis
        return [(axis, step) for axis, pair in ends for step, name in zip((-1, 1), pair, strict=True) if name in kinds]

    @property
    def layout(self) -> Layout:
        """The placement of its node arrays: on one device, except inside a program that runs on parts of the grid."""
        return self._layout or Layout(self.shape)

    def intervals(self, axis: int) -> int:
        """The number M of intervals between ``lo`` and ``hi``."""
        count = self.layout.whole[axis]
        return count if self.periodic[axis] else count - 1

    def spacing(self, axis: int) -> Number:
        """The distance h between neighbours along ``axis``; the mean distance on a stretched axis."""
        return self._spacings[axis] if self._spacings else (self.hi[axis] - self.lo[axis]) / self.intervals(axis)

    def axis(self, axis: int, dtype: DType | None = None) -> Array:
        """The coordinates of the nodes along one axis, shape (N,); the same numbers in every program."""
        if self._layout is not None:
            return self._layout.own(undivided(self).axis(axis, dtype), axis)
        if self._spacings is not None:
            return jnp.asarray(self._coordinates[axis], dtype or jnp.result_type(float))
        computed, table = self._by_formula(axis), self._coordinates[axis]
        table = computed if table is None else table
        # NumPy if nothing is traced, also inside ``jit``, where the table then is a constant
        if is_traced(computed, table):
            given = (computed, table, jnp.maximum(jnp.abs(self.lo[axis]), jnp.abs(self.hi[axis])))
            return from_table(*(jnp.asarray(each, dtype or jnp.result_type(float)) for each in given))
        return np.asarray(table, dtype or np.float64)

    def _by_formula(self, axis: int) -> Array:
        """The coordinates by the formula, in NumPy if the corners are known numbers."""
        index: Array = np.arange(self.shape[axis], dtype=np.float64)
        last = self.intervals(axis)
        stretching = self.stretch[axis]
        if stretching is not None:
            index = last * stretching.place(index / last)
        return (known(self.lo)[axis] * (last - index) + known(self.hi)[axis] * index) / last

    def components(self, dtype: DType) -> list[jax.Array]:
        """The coordinates as n arrays; the i-th varies only along axis i and broadcasts."""
        columns = []
        for axis, count in enumerate(self.shape):
            along = [1] * self.ndim
            along[axis] = count
            columns.append(jnp.asarray(self.axis(axis, np.dtype(dtype)), dtype).reshape(along))
        return columns

    def state(self, index: Sequence[int]) -> np.ndarray:
        """The state at a node, shape (n,); on the host."""
        return np.array([np.asarray(self.axis(axis))[i] for axis, i in enumerate(index)])

    def nodes(self) -> np.ndarray:
        """All states, shape (*grid, n), on the host: a table for tests and plots, not for solvers."""
        return np.stack(np.meshgrid(*(np.asarray(self.axis(i)) for i in range(self.ndim)), indexing="ij"), axis=-1)

    def inner(self, share: float) -> np.ndarray:
        """The nodes in the middle ``share`` of every axis that is not periodic, bool (*grid); on the host."""
        inside = np.ones(self.shape, bool)
        for axis in range(self.ndim):
            if not self.periodic[axis]:
                nodes, lo, hi = np.asarray(self.axis(axis)), float(self.lo[axis]), float(self.hi[axis])
                # a node on the rim belongs to the middle, for any rounding of its coordinate
                near = np.abs(nodes - (lo + hi) / 2) <= share * (hi - lo) / 2 * (1 + 1e-9)
                inside &= near.reshape([-1 if i == axis else 1 for i in range(self.ndim)])
        return inside

    def volumes(self) -> np.ndarray:
        """The part of the box that belongs to each node, shape (*grid), on the host: half cells at ends that are nodes.

        Their sum is the volume of the box. Sums of node values weighted by them are trapezoidal integrals.
        """
        total = np.ones(())
        for axis, count in enumerate(self.shape):
            gaps = np.diff(np.append(np.asarray(self.axis(axis)), self.hi[axis] if self.periodic[axis] else []))
            # Each gap gives half to the node on either side. A periodic axis has one gap per node, and both slices are
            # the whole axis. This is correct because its gaps are equal.
            share = np.zeros(count)
            share[: len(gaps)] += gaps / 2
            share[-len(gaps) :] += gaps / 2
            total = np.multiply.outer(total, share)
        return total

    @own_settings()
    def wrap(self, x: States) -> jax.Array:
        """States with their periodic entries wrapped into [lo, hi); other entries are unchanged."""
        x = _states(x)
        lo, hi = jnp.asarray(self.lo, x.dtype), jnp.asarray(self.hi, x.dtype)
        return jnp.where(np.array(self.periodic), into_period(x, lo, hi), x)

    def beyond(self, x: States) -> np.ndarray:
        """True for states outside the box by more than rounding; for known numbers only."""
        x, lo, hi = np.asarray(x, float), np.asarray(self.lo, float), np.asarray(self.hi, float)
        slack = 8 * np.finfo(float).eps * np.maximum(hi - lo, np.maximum(abs(lo), abs(hi)))  # as in ``_locate``
        return np.any(((x < lo - slack) | (x > hi + slack)) & ~np.array(self.periodic), axis=-1)

    @own_settings()
    def interpolate(self, values: Array, x: States, *, clamp: bool = False) -> jax.Array:
        """Multilinear interpolation of node values, second order; supports ``jit`` and ``vmap``.

        Args:
          values: shape (*grid, ...).
          x: states, shape (..., n).
          clamp: True uses the nearest point of the box for states outside; False gives NaN there.

        Returns:
          Shape ``x.shape[:-1] + values.shape[n:]``.
        """
        values, x = jnp.asarray(values), _states(x)
        if x.ndim == 0 or x.shape[-1] != self.ndim:
            raise ValueError(f"Grid: got states of shape {x.shape}, wanted (..., {self.ndim}): one entry per axis")
        if values.shape[: self.ndim] != self.shape:
            raise ValueError(f"Grid: got values of shape {values.shape}, wanted {self.shape} first: one per node")
        x = self.wrap(x)
        cells, fractions, inside = zip(*(self._locate(axis, x[..., axis]) for axis in range(self.ndim)), strict=True)
        trailing = (1,) * (values.ndim - self.ndim)  # weights are per state; values may be vectors
        total = jnp.zeros((), x.dtype)
        for corner in np.ndindex(*(2,) * self.ndim):
            weight = jnp.ones((), x.dtype)  # w_c = Π_i (s_i or 1 − s_i)
            for fraction, bit in zip(fractions, corner, strict=True):
                weight = weight * (fraction if bit else 1 - fraction)
            index = tuple((cell + bit) % count for cell, bit, count in zip(cells, corner, self.shape, strict=True))
            weight, at_corner = weight.reshape(weight.shape + trailing), values[index]
            # A corner with weight zero may be infinite (0 · inf); if it is finite it still contributes to derivatives.
            total = total + weight * jnp.where((weight == 0) & ~jnp.isfinite(at_corner), 0, at_corner)
        hidden = jnp.any(jnp.isnan(x), axis=-1) | ((not clamp) & ~jnp.all(jnp.stack(inside), axis=0))
        return jnp.where(hidden.reshape(hidden.shape + trailing), jnp.nan, total)

    def slack(self, axis: int, dtype: DType) -> jax.Array:
        """The rounding error of a position in cells, for coordinates of the size of the ends, with a margin."""
        lo, hi = jnp.asarray(self.lo[axis], dtype), jnp.asarray(self.hi[axis], dtype)
        size = jnp.maximum(1, jnp.maximum(abs(lo), abs(hi)) / (hi - lo))
        return 8 * self.intervals(axis) * jnp.finfo(dtype).eps * size

    def _locate(self, axis: int, x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The node below ``x``, the fraction of the distance to the next node, and True if ``x`` is in the box."""
        lo, hi, last = jnp.asarray(self.lo[axis], x.dtype), jnp.asarray(self.hi[axis], x.dtype), self.intervals(axis)
        place = (x - lo) / (hi - lo)
        if self.stretch[axis] is not None:
            return self._locate_stretched(axis, x, place)
        place = place * last
        slack = self.slack(axis, x.dtype)
        inside = (place >= -slack) & (place <= last + slack)  # NaN counts as outside
        place = jnp.clip(jnp.nan_to_num(place), 0, last)
        # snap to a node, so that an infinite neighbour has weight exactly zero; the derivative is unchanged
        to_node = jax.lax.stop_gradient(jnp.round(place) - place)
        place = place + jnp.where(abs(to_node) <= slack, to_node, 0)
        cell = jnp.minimum(jnp.floor(jax.lax.stop_gradient(place)), last - 1).astype(int)
        return cell, place - cell, inside

    def at_node(self, x: Array) -> jax.Array:
        """The state (n,) with every entry within rounding of a node moved to the node, as in ``interpolate``.

        A function that jumps at a node has the value of the node there.
        """
        x = jnp.asarray(x)
        entries = [x[axis] for axis in range(self.ndim)]
        for axis, entry in enumerate(entries):
            if self.stretch[axis] is not None:  # there ``interpolate`` compares states with the nodes exactly
                continue
            nodes, width = jnp.asarray(self.axis(axis), x.dtype), jnp.asarray(self.spacing(axis), x.dtype)
            index = jnp.clip(jnp.round((entry - nodes[0]) / width), 0, len(nodes) - 1).astype(int)
            way = jax.lax.stop_gradient(nodes[index] - entry)
            # twice the slack of ``interpolate``, whose positions are rounded differently
            near = abs(way) <= 2 * self.slack(axis, x.dtype) * width
            entries[axis] = entry + jnp.where(near, way, 0)
        return jnp.stack(entries)

    def _locate_stretched(self, axis: int, x: jax.Array, place: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Node, fraction and flag on a stretched axis: the cell from φ⁻¹, the fraction from the nodes of the cell."""
        slack = 64 * jnp.finfo(x.dtype).eps  # relative to the whole axis, since ``place`` runs from 0 to 1
        inside = (place >= -slack) & (place <= 1 + slack)
        nodes, last = jnp.asarray(self.axis(axis), x.dtype), self.intervals(axis)
        stretch = self.stretch[axis]
        assert stretch is not None
        guess = last * stretch.fraction(jnp.clip(jnp.nan_to_num(place), 0, 1))
        cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(guess)).astype(int), 0, last - 1)
        # rounding in the inverse map may shift the cell by one, so compare with the coordinates
        cell = jnp.clip(cell + (x >= nodes[cell + 1]) - (x < nodes[cell]), 0, last - 1)
        fraction = (x - nodes[cell]) / (nodes[cell + 1] - nodes[cell])
        fraction = jnp.nan_to_num(fraction)  # no clip here: it would halve the derivative at a node
        return cell, jnp.where((fraction >= 0) & (fraction <= 1), fraction, jnp.clip(fraction, 0, 1)), inside


def check_spacings(grid: Grid, dtype: DType) -> None:
    """Refuse nodes that coincide up to rounding in ``dtype``, because differences of values would be rounding too.

    Raises:
      ValueError: with the axis and its ends.
    """
    for axis, nodes in enumerate(grid._coordinates):
        if isinstance(nodes, np.ndarray):  # not traced, and not too many to be stored
            arguments.check_nodes(nodes, axis, dtype)


def tabulated(grid: Grid) -> Grid:
    """The grid with spacings and coordinates that NumPy computed, as constants for programs on one grid."""
    if any(table is None for table in grid._coordinates):
        return grid
    lo, hi = (tuple(np.asarray(corner)) for corner in (grid.lo, grid.hi))
    tables, spacings = [], []
    for axis, (low, high, table) in enumerate(zip(lo, hi, grid._coordinates, strict=True)):
        tables.append(checked_table(grid._by_formula(axis), np.asarray(table), max(abs(low), abs(high))))
        spacings.append((high - low) / grid.intervals(axis))
    return altered(grid, lo=lo, hi=hi, _coordinates=tuple(tables), _spacings=tuple(spacings))


def with_prescriptions_of(grid: Grid, other: Grid, change: Callable[[Any], Any]) -> Grid:
    """The grid with the prescribed ends of another grid, whose numbers at the nodes are changed by a function."""
    return altered(grid, _faces=jax.tree.map(change, other._faces))


def with_prescriptions(grid: Grid, change: Callable[[Any], Any]) -> Grid:
    """The grid with every prescribed end replaced by a function of it."""
    found = [
        None if pair is None else tuple(None if end is None else change(end) for end in pair) for pair in grid._faces
    ]
    return altered(grid, _faces=tuple(found))


def placed(grid: Grid, layout: Layout) -> Grid:
    """The grid of the nodes that a layout places on this device, with the shape of its arrays."""
    return altered(grid, shape=layout.shape, _layout=layout)


def division(grid: Grid, mesh: Mesh | None) -> Layout:
    """The layout of a grid over the devices of a mesh; one device without a mesh, or if a part would be too small."""
    parts = None if mesh is None else Parts(grid.shape, mesh)
    return parts if parts is not None and parts.fits else grid.layout


def undivided(grid: Grid) -> Grid:
    """The grid of the nodes of all devices."""
    return altered(grid, shape=grid.layout.whole, _layout=None)


def _states(x: Numbers) -> jax.Array:
    """States as a floating-point array; integers become JAX's default float."""
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)
