"""Admissible sets of controls and disturbances.

``Box``, ``Ball`` and ``Simplex`` are continuous sets and are minimised over as such; ``Finite`` is enumerated. The
numbers in a set are leaves, so a wider box does not recompile.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import is_traced, known, numbers, pytree_dataclass
from hjbjax.problem.types import Array, DType, Number
from hjbjax.problem.words import shown

SPREAD = 4.0  # samples of an unbounded input are sinh(4 s), 0 ≤ s ≤ 1: up to 27 beyond its finite bound, or zero
SLACK = 1e-6  # relative to the size of a set: eight roundings of float32, in which a control may have been computed


def _finite_numbers(value: object, name: str) -> Array:
    """Numbers as an array; refused if not finite, because H may be −∞ everywhere over an unbounded set."""
    array = numbers(value, name)
    if isinstance(array, np.ndarray) and not np.all(np.isfinite(array)):
        raise ValueError(f"{name}: got {shown(value)}, wanted finite numbers: bound the set")
    return array


def _bounds(value: object, name: str, infinite: float) -> Array:
    """Bounds as an array; refused if NaN, or infinite with the sign that leaves nothing."""
    array = numbers(value, name)
    if isinstance(array, np.ndarray) and np.any(np.isnan(array) | (np.isinf(array) & (array != infinite))):
        raise ValueError(f"{name}: got {shown(value)}, wanted finite numbers, or {infinite:g} where there is no bound")
    return array


def _is_count(value: object) -> bool:
    """True if a value is a positive integer; booleans do not count."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and int(value) >= 1


@pytree_dataclass(static=("unbounded",))
class Box:
    """The box lo ≤ u ≤ hi.

    A bound may be infinite if the optimum is found by a formula: the drift affine in this input, the noise independent
    of it, and the cost quadratic in it with a positive curvature. Consumption and effort then need no invented limit.
    Solvers refuse infinite bounds elsewhere.

    Args:
      lo: lower bounds, shape (m,), in the units of each input; for one input, a number is enough.
      hi: upper bounds, in the same form.

    Raises:
      ValueError: the bounds differ in length, are NaN, or leave no admissible control.

    Example:
      >>> Box([-1.0], [1.0]).grid(3).points.tolist()
      [[-1.0], [0.0], [1.0]]
    """

    lo: Any
    hi: Any = None
    # static, because the programs for finite bounds must not change; False if the numbers are traced
    unbounded: bool = dataclasses.field(init=False, default=False, repr=False)

    def __post_init__(self) -> None:
        if self.hi is None:
            pair = np.shape(self.lo) == (2,)
            cure = f"Box({self.lo[0]!r}, {self.lo[1]!r})" if pair else "Box([-1.0], [1.0])"
            raise TypeError(f"Box: got only lo = {self.lo!r}, wanted both bounds, as in hjb.{cure}")
        lo, hi = _bounds(self.lo, "Box.lo", -np.inf), _bounds(self.hi, "Box.hi", np.inf)
        if np.ndim(lo) == np.ndim(hi) == 0:
            lo, hi = lo.reshape(1), hi.reshape(1)
        if np.ndim(lo) != 1 or np.shape(lo) != np.shape(hi) or np.size(lo) == 0:
            raise ValueError(f"Box: got lo of shape {np.shape(lo)} and hi of shape {np.shape(hi)}, wanted (m,) twice")
        if isinstance(lo, np.ndarray) and isinstance(hi, np.ndarray) and np.any(lo > hi):
            axis = int(np.argmax(lo > hi))
            raise ValueError(f"Box: no admissible control: input {axis} has lo = {lo[axis]:g} > hi = {hi[axis]:g}")
        object.__setattr__(self, "lo", lo)
        object.__setattr__(self, "hi", hi)
        known = [bound for bound in (lo, hi) if isinstance(bound, np.ndarray)]
        object.__setattr__(self, "unbounded", any(bool(np.any(np.isinf(bound))) for bound in known))

    @property
    def dim(self) -> int:
        """The number of inputs m."""
        return np.shape(self.lo)[-1]

    def grid(self, num: int | Sequence[int]) -> "Finite":
        """The box sampled with ``num`` equally spaced values per input, including the ends, as a finite set.

        Values are (lo·(M−k) + hi·k)/M, so that an odd number on a symmetric box includes an exact zero.
        """
        counts = tuple(num) if isinstance(num, (Sequence, np.ndarray)) else (num,) * self.dim
        if len(counts) != self.dim or not all(_is_count(n) for n in counts):
            raise ValueError(f"Box.grid: got {num!r}, wanted a positive integer or {self.dim} of them")
        if self.unbounded:
            raise ValueError(f"Box.grid: got infinite bounds, {self}, which cannot be sampled; give finite bounds")
        # indices k, shape (K, m), in the order of nested loops: the last input changes fastest
        rows = np.array(list(itertools.product(*(range(int(n)) for n in counts))), dtype=np.float64)
        last = np.maximum(np.asarray(counts, dtype=np.float64) - 1, 1)  # a single value is lo, not 0/0
        return Finite((known(self.lo) * (last - rows) + known(self.hi) * rows) / last)


@pytree_dataclass(static=("dim",))
class Ball:
    """The Euclidean ball |u| ≤ radius in R^dim.

    Args:
      radius: at least 0, in the units of the inputs, which must all be the same.
      dim: the number of inputs m.

    Raises:
      ValueError: the radius is negative or not finite, or the dimension is not a positive integer.
    """

    radius: Any
    dim: int

    def __post_init__(self) -> None:
        radius = _finite_numbers(self.radius, "Ball.radius")
        if not _is_count(self.dim):
            raise ValueError(f"Ball: got dim = {self.dim!r}, wanted a positive integer")
        if np.ndim(radius) != 0:
            raise ValueError(f"Ball: got a radius of shape {np.shape(radius)}, wanted one number")
        if isinstance(radius, np.ndarray) and radius < 0:
            raise ValueError(f"Ball: no admissible control: radius = {float(radius):g} < 0")
        object.__setattr__(self, "radius", radius)
        object.__setattr__(self, "dim", int(self.dim))


@pytree_dataclass(static=("dim", "at_most"))
class Simplex:
    """The simplex u_i ≥ 0, u_1 + ... + u_dim = total: shares of a portfolio, or one effort divided among tasks.

    With ``at_most=True`` the sum may be smaller, u_1 + ... + u_dim ≤ total: the rest is cash, or idle.

    Args:
      dim: the number of inputs m.
      total: the sum, positive, in the units of the inputs, which must all be the same.
      at_most: True if the sum may be smaller than the total.

    Raises:
      ValueError: the total is not one positive finite number, or the dimension is not a positive integer.
      TypeError: ``at_most`` is not a bool.

    Example:
      >>> Simplex(2).grid(3).points.tolist()
      [[0.0, 1.0], [0.5, 0.5], [1.0, 0.0]]
    """

    dim: int
    total: Any = 1.0
    at_most: bool = False

    def __post_init__(self) -> None:
        if not _is_count(self.dim):
            raise ValueError(f"Simplex: got dim = {self.dim!r}, wanted a positive integer: the number of inputs")
        if not isinstance(self.at_most, (bool, np.bool_)):
            raise TypeError(f"Simplex: got at_most = {self.at_most!r}, wanted True or False; the sum is total=")
        total = _finite_numbers(self.total, "Simplex.total")
        if np.ndim(total) != 0:
            raise ValueError(f"Simplex: got a total of shape {np.shape(total)}, wanted one number")
        if isinstance(total, np.ndarray) and total <= 0:
            raise ValueError(f"Simplex: got total = {float(total):g}, wanted a positive number: no inputs are left")
        object.__setattr__(self, "dim", int(self.dim))
        object.__setattr__(self, "total", total)
        object.__setattr__(self, "at_most", bool(self.at_most))

    @property
    def freedom(self) -> int:
        """The number of inputs that can be chosen independently: the others follow from the sum."""
        return self.dim if self.at_most else self.dim - 1

    def grid(self, num: int) -> "Finite":
        """The simplex sampled with ``num`` equally spaced values per input, including 0 and the total, as a finite set.

        The set has (num + m − 2)!/((num − 1)! (m − 1)!) points for m inputs; with ``at_most`` replace m by m + 1.
        """
        if not _is_count(num) or int(num) < 2:
            raise ValueError(f"Simplex.grid: got {num!r}, wanted an integer of at least 2: the values per input")
        return Finite(known(self.total) * _lattice(self, int(num) - 1))


@pytree_dataclass()
class Finite:
    """A finite set, enumerated in order; the first of several equally good points wins.

    Args:
      points: the K admissible values, shape (K, m).

    Raises:
      ValueError: the set is empty or the points are not rows of numbers.
    """

    points: Any

    def __post_init__(self) -> None:
        points = _finite_numbers(self.points, "Finite.points")
        if np.ndim(points) == 1 and np.size(points) > 0:  # ambiguous: three controls, or one control of three inputs
            raise ValueError(
                f"Finite: got points of shape {np.shape(points)}, wanted (K, m): one row per control,\n"
                "as in hjb.Finite([[-1.0], [0.0], [1.0]]) for one input"
            )
        if np.ndim(points) != 2 or 0 in np.shape(points):
            raise ValueError(f"Finite: no admissible control: got points of shape {np.shape(points)}, wanted (K, m)")
        object.__setattr__(self, "points", points)

    @property
    def dim(self) -> int:
        """The number of inputs m."""
        return np.shape(self.points)[-1]


@pytree_dataclass(static=("dim",))
class AnyControl:
    """All of R^dim, to evaluate a problem at a given control, where the admissible set does not matter.

    Args:
      dim: the number of inputs m.
    """

    dim: int


AdmissibleSet: TypeAlias = Box | Ball | Simplex | Finite


def samples(admissible: AdmissibleSet, budget: int) -> Array:
    """Representative points of a set, shape (K, m) with K about ``budget``; all points of a finite set.

    A box has an odd number of values per input, so that its ends and its middle are included. A ball has its centre and
    directions on two spheres, at equal angles in the plane and along axes and diagonals in higher dimensions. A simplex
    has a lattice that includes its vertices, and its centre.
    """
    if isinstance(admissible, Finite):
        return admissible.points
    if isinstance(admissible, Box):
        per_input = _values_an_input(admissible, budget)
        return _spread(admissible, per_input) if admissible.unbounded else admissible.grid(per_input).points
    if isinstance(admissible, Simplex):
        return known(admissible.total) * _unit_simplex(admissible, budget)
    unit = _unit_ball(admissible.dim, budget)
    return known(admissible.radius) * unit


def _values_an_input(box: Box, budget: int) -> int:
    """The m-th root of the budget, made odd; at least both ends and the middle."""
    return max(3, round(budget ** (1 / box.dim)) // 2 * 2 + 1)


def _spread(box: Box, per_input: int) -> Array:
    """Values of a box with infinite bounds, ``per_input`` for each input, shape (K, m).

    They lie closest together near a finite bound, or near zero, and span several powers of ten. Their optimum is never
    used: they show checks what the functions do for small and for large actions.
    """
    xp: Any = jnp if is_traced(box.lo, box.hi) else np
    lo, hi = xp.asarray(box.lo), xp.asarray(box.hi)
    share = np.linspace(0, 1, per_input)[:, None]
    from_lo, from_hi, both = (np.sinh(SPREAD * each) for each in (share, 1 - share, 2 * share - 1))
    below, above = xp.isfinite(lo), xp.isfinite(hi)
    low, high = xp.where(below, lo, 0), xp.where(above, hi, 0)
    one_sided = xp.where(below, low + from_lo, xp.where(above, high - from_hi, both))
    values = xp.where(below & above, low * (1 - share) + high * share, one_sided)
    rows = np.array(list(itertools.product(range(per_input), repeat=box.dim)))
    return values[rows, np.arange(box.dim)]


def finite_ends(box: Box, dtype: DType) -> tuple[Any, Any]:
    """lo and hi as finite numbers; infinite ones are so large that a convex quadratic is never least there."""
    if not box.unbounded:
        return box.lo, box.hi
    largest = float(np.finfo(dtype).max) ** 0.25  # its square times a coefficient must be finite
    lo, hi = (jnp.clip(jnp.asarray(bound, dtype), -largest, largest) for bound in (box.lo, box.hi))
    return lo, hi


def at_bounds(admissible: Box | Simplex, u: np.ndarray) -> np.ndarray:
    """The number of controls, rows of u (K, m), at the lower and at the upper bound of each input, shape (m, 2)."""
    if isinstance(admissible, Simplex):
        lo, hi = np.zeros(admissible.dim), np.full(admissible.dim, np.asarray(admissible.total))
    else:
        lo, hi = np.asarray(admissible.lo), np.asarray(admissible.hi)
    slack = SLACK * _size(lo, hi)
    return np.stack([np.sum(u <= lo + slack, axis=0), np.sum(u >= hi - slack, axis=0)], axis=-1)


def _size(lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """The size of a box along each input: of its finite bounds and their distance."""
    sizes = np.stack([np.abs(lo), np.abs(hi), hi - lo])
    return np.max(np.where(np.isfinite(sizes), sizes, 0), axis=0)


def is_unbounded(admissible: object) -> bool:
    """True for a box with infinite bounds."""
    return isinstance(admissible, Box) and admissible.unbounded


def refuse_unbounded(admissible: AdmissibleSet | None, caller: str, why: str) -> None:
    """Refuse a box with infinite bounds in a function that requires bounds, with the reason."""
    if is_unbounded(admissible):
        raise ValueError(
            f"{caller}: got infinite bounds, {admissible}; wanted finite bounds: {why}.\n"
            "Give bounds that are wide enough not to matter"
        )


def _unit_ball(dim: int, budget: int) -> np.ndarray:
    """Points of the unit ball, shape (K, dim)."""
    if dim == 1:  # an odd number of points, so that −1, 0 and 1 are among them
        return np.linspace(-1.0, 1.0, budget // 2 * 2 + 1)[:, None]
    if dim == 2:  # half of the budget per circle, in multiples of four so that the axes are among the directions
        angles = np.arange(max(8, budget // 8 * 4)) * (2 * np.pi / max(8, budget // 8 * 4))
        sphere = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    else:  # 3^dim − 1 directions for any budget: 26, 80, 242, ...
        signs = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=dim)))
        signs = signs[np.any(signs != 0, axis=1)]
        sphere = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    # centre, half way and rim: the size |u| of any control is within ¼ of some sample's size
    return np.concatenate([np.zeros((1, dim)), 0.5 * sphere, sphere])


def _unit_simplex(simplex: Simplex, budget: int) -> np.ndarray:
    """At most ``budget`` points of a lattice on the simplex with total 1, and its centre, shape (K, m).

    The first and the last point are vertices.
    """
    points, parts = _lattice(simplex, _intervals(simplex, budget)), simplex.freedom + 1
    centre = np.full((1, simplex.dim), 1 / parts)
    if np.any(np.all(np.abs(points - centre) < SLACK, axis=1)):
        return points
    middle = len(points) // 2
    return np.concatenate([points[:middle], centre, points[middle:]])


def _intervals(simplex: Simplex, budget: int) -> int:
    """The largest number of intervals per edge with at most ``budget`` lattice points, at least one."""
    rest = simplex.freedom
    intervals = 1
    while rest and math.comb(intervals + 1 + rest, rest) <= budget:
        intervals += 1
    return intervals


def _lattice(simplex: Simplex, intervals: int) -> np.ndarray:
    """The points of the simplex with total 1 whose inputs are multiples of 1/intervals, in order, shape (K, m)."""
    # stars and bars: the gaps between ``rest`` bars among ``intervals`` stars
    rest = simplex.freedom
    rows = list(itertools.combinations(range(intervals + rest), rest))
    bars = np.array(rows, np.int64).reshape(len(rows), rest)
    edges = np.concatenate([np.full((len(bars), 1), -1), bars, np.full((len(bars), 1), intervals + rest)], axis=1)
    return (np.diff(edges, axis=1) - 1)[:, : simplex.dim] / intervals


def holds(admissible: AdmissibleSet, u: Array) -> np.ndarray:
    """True for each control (..., m) inside a set of known numbers, up to rounding in float32; shape (...)."""
    if isinstance(admissible, Box):
        lo, hi = np.asarray(admissible.lo), np.asarray(admissible.hi)
        slack = SLACK * _size(lo, hi)
        return np.all((u >= lo - slack) & (u <= hi + slack), axis=-1)
    if isinstance(admissible, Ball):
        return np.linalg.norm(u, axis=-1) <= np.asarray(admissible.radius) * (1 + SLACK)
    if isinstance(admissible, Simplex):
        total = np.asarray(admissible.total)
        off = np.sum(u, axis=-1) - total
        return np.all(u >= -SLACK * total, axis=-1) & ((off if admissible.at_most else np.abs(off)) <= SLACK * total)
    points = np.asarray(admissible.points)
    slack = SLACK * np.max(np.abs(points), axis=0)
    return np.any(np.all(np.abs(u[..., None, :] - points) <= slack, axis=-1), axis=-1)


def extremes(admissible: AdmissibleSet) -> Array:
    """Points whose convex hull contains the set, shape (K, m): a bound for the maximum of a convex function of u."""
    if isinstance(admissible, Finite):
        return admissible.points
    if isinstance(admissible, Box):
        return _spread(admissible, 2) if admissible.unbounded else admissible.grid(2).points
    if isinstance(admissible, Simplex):
        return known(admissible.total) * _lattice(admissible, 1)
    # the 2^m corners of the cube around the ball, because no polytope inside the ball contains it
    return admissible.radius * np.array(list(itertools.product((-1.0, 1.0), repeat=admissible.dim)))


def ranges(admissible: AdmissibleSet) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and the largest number of each input, shape (m,); infinite where a box has no bound."""
    if isinstance(admissible, Box):
        return np.asarray(admissible.lo, float), np.asarray(admissible.hi, float)
    corners = np.asarray(extremes(admissible), float)
    return corners.min(axis=0), corners.max(axis=0)


def probes(admissible: AdmissibleSet | None, dtype: DType) -> list[list]:
    """Actions, lists of m numbers, that bound the maximum of a convex function of u, plus a few samples."""
    if admissible is None:
        return [[]]  # one action without entries, so that loops over actions run once
    points = jnp.asarray(extremes(admissible), dtype)
    if not isinstance(admissible, Finite):
        # a function that is not convex may be larger inside; samples prove nothing, but cost little
        points = jnp.concatenate([points, jnp.asarray(samples(admissible, 9), dtype)])
    return [[points[k, j] for j in range(points.shape[1])] for k in range(points.shape[0])]


def spacing(admissible: AdmissibleSet, budget: int) -> list[Number]:
    """The distance between neighbouring ``samples``, one number per input."""
    if isinstance(admissible, Ball):
        return [admissible.radius / 2] * admissible.dim  # from the centre to the half-way sphere, and on to the rim
    if isinstance(admissible, Simplex):
        return [admissible.total / _intervals(admissible, budget)] * admissible.dim
    assert isinstance(admissible, Box)
    per_input = _values_an_input(admissible, budget)
    if admissible.unbounded:
        return list(np.ptp(np.asarray(_spread(admissible, per_input)), axis=0) / (per_input - 1))
    return [(admissible.hi[j] - admissible.lo[j]) / (per_input - 1) for j in range(admissible.dim)]
