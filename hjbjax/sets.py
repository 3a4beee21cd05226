"""Admissible sets of controls and disturbances.

``Box`` and ``Ball`` are continua and are minimised as continua; ``Finite`` is enumerated. The numbers in a
set are leaves: a wider box is no recompile.
"""

import itertools
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

from hjbjax.pytree import node


def _numbers(value: Any, name: str) -> Any:
    """``value`` as a float64 array while it is concrete; a tracer as it is."""
    if isinstance(value, jax.core.Tracer):
        return value
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        if isinstance(value, Sequence) and any(isinstance(entry, jax.core.Tracer) for entry in value):
            return jax.numpy.stack([jax.numpy.asarray(entry) for entry in value])
        raise TypeError(f"{name}: got {value!r}, wanted numbers") from None
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name}: got {value!r}, wanted finite numbers: bound the set")
    return array


@node()
class Box:
    """The box lo ≤ u ≤ hi.

    Args:
      lo: lower bounds, shape (m,), in the units of each input.
      hi: upper bounds, shape (m,).

    Raises:
      ValueError: the bounds differ in length, are not finite, or leave no admissible control.

    Example:
      >>> Box([-1.0], [1.0]).grid(3).points.tolist()
      [[-1.0], [0.0], [1.0]]
    """

    lo: Any
    hi: Any

    def __post_init__(self):
        lo, hi = _numbers(self.lo, "Box.lo"), _numbers(self.hi, "Box.hi")
        if np.ndim(lo) != 1 or np.shape(lo) != np.shape(hi) or np.size(lo) == 0:
            raise ValueError(f"Box: got lo of shape {np.shape(lo)} and hi of shape {np.shape(hi)}, wanted (m,) twice")
        if isinstance(lo, np.ndarray) and isinstance(hi, np.ndarray) and np.any(lo > hi):
            axis = int(np.argmax(lo > hi))
            raise ValueError(f"Box: no admissible control: input {axis} has lo = {lo[axis]:g} > hi = {hi[axis]:g}")
        object.__setattr__(self, "lo", lo)
        object.__setattr__(self, "hi", hi)

    @property
    def dim(self) -> int:
        """The number of inputs m."""
        return np.shape(self.lo)[-1]

    def grid(self, num: int | Sequence[int]) -> "Finite":
        """The box sampled with ``num`` equally spaced values an input, ends included, as a finite set.

        Values are (lo·(M−k) + hi·k)/M, so that an odd number on a symmetric box holds an exact zero.
        """
        counts = (num,) * self.dim if isinstance(num, int) else tuple(num)
        if len(counts) != self.dim or any(isinstance(n, bool) or n != int(n) or n < 1 for n in counts):
            raise ValueError(f"Box.grid: got {num!r}, wanted a positive integer or {self.dim} of them")
        rows = np.array(list(itertools.product(*(range(int(n)) for n in counts))), dtype=np.float64)
        last = np.maximum(np.asarray(counts, dtype=np.float64) - 1, 1)
        return Finite((self.lo * (last - rows) + self.hi * rows) / last)


@node(static=("dim",))
class Ball:
    """The Euclidean ball |u| ≤ radius in R^dim.

    Raises:
      ValueError: the radius is negative or not finite, or the dimension is not a positive integer.
    """

    radius: Any
    dim: int

    def __post_init__(self):
        radius = _numbers(self.radius, "Ball.radius")
        if isinstance(self.dim, bool) or not isinstance(self.dim, int) or self.dim < 1:
            raise ValueError(f"Ball: got dim = {self.dim!r}, wanted a positive integer")
        if np.ndim(radius) != 0:
            raise ValueError(f"Ball: got a radius of shape {np.shape(radius)}, wanted one number")
        if isinstance(radius, np.ndarray) and radius < 0:
            raise ValueError(f"Ball: no admissible control: radius = {float(radius):g} < 0")
        object.__setattr__(self, "radius", radius)


@node()
class Finite:
    """The finite set of the rows of ``points``, shape (K, m); enumerated, in order, the first of equals wins.

    Raises:
      ValueError: the set is empty or the points are not rows of numbers.
    """

    points: Any

    def __post_init__(self):
        points = _numbers(self.points, "Finite.points")
        if np.ndim(points) == 1 and np.size(points) > 0:
            raise ValueError(f"Finite: got points of shape {np.shape(points)}, wanted (K, m): one row a control")
        if np.ndim(points) != 2 or 0 in np.shape(points):
            raise ValueError(f"Finite: no admissible control: got points of shape {np.shape(points)}, wanted (K, m)")
        object.__setattr__(self, "points", points)

    @property
    def dim(self) -> int:
        """The number of inputs m."""
        return np.shape(self.points)[-1]


AdmissibleSet: TypeAlias = Box | Ball | Finite
