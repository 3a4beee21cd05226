"""Level surfaces in three dimensions as triangles, by marching tetrahedra in NumPy.

Every cell is divided into the six tetrahedra around its diagonal, one for each order of the axes. The field is linear
on each tetrahedron, so its zero set is a triangle or a quadrilateral. No case is ambiguous, and the surface has no
holes. Source: A. Doi and A. Koide, An efficient method of triangulating equi-valued surfaces by using tetrahedral
cells, IEICE Trans. E74 (1991).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

FINEST = 40  # nodes per axis; 40³ give up to 30,000 triangles, which matplotlib draws in about two seconds
LIGHT = np.array([-0.4, -0.55, 0.73])  # direction of the light, in units of the box
AMBIENT = 0.45  # fraction of the colour in the shade


def level_surface(field: np.ndarray, coordinates: Sequence[np.ndarray]) -> np.ndarray:
    """The triangles of the surface where a field is zero, shape (k, 3 corners, 3 coordinates).

    Args:
      field: values on a raster, (M₁, M₂, M₃); cells with a value that is not finite are skipped.
      coordinates: three arrays of coordinates, of lengths M₁, M₂ and M₃.

    Example:
      >>> x = np.linspace(-1, 1, 21)
      >>> ball = np.sqrt(sum(axis**2 for axis in np.meshgrid(x, x, x))) - 0.8
      >>> corners = level_surface(ball, (x, x, x)).reshape(-1, 3)
      >>> bool(abs(np.linalg.norm(corners, axis=1) - 0.8).max() < 0.01)
      True
    """
    shape = np.array(field.shape)
    places = np.stack(np.meshgrid(*coordinates, indexing="ij"), axis=-1)
    inside = field <= 0
    corners = list(itertools.product((0, 1), repeat=3))

    def at(array: np.ndarray, corner: Sequence[int]) -> np.ndarray:
        return array[tuple(slice(c, s - 1 + c) for c, s in zip(corner, shape, strict=True))]

    count = sum(at(inside, corner).astype(int) for corner in corners)
    finite = np.all([at(np.isfinite(field), corner) for corner in corners], axis=0)
    crossed = (count > 0) & (count < 8) & finite
    pieces = []
    for order in itertools.permutations(np.eye(3, dtype=int)):
        tetrahedron = np.cumsum([np.zeros(3, int), *order], axis=0)
        values = np.stack([at(field, corner)[crossed] for corner in tetrahedron], axis=1)  # (k, 4)
        points = np.stack([at(places, corner)[crossed] for corner in tetrahedron], axis=1)  # (k, 4, 3)
        pieces.append(_within(values, points))
    return np.concatenate(pieces)


def _within(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The triangles in tetrahedra with values (k, 4) at their corners (k, 4, 3)."""
    order = np.argsort(values, axis=1)  # corners inside come first
    values, points = np.take_along_axis(values, order, 1), np.take_along_axis(points, order[..., None], 1)
    count = np.sum(values <= 0, axis=1)

    def crossing(chosen: np.ndarray, a: int, b: int) -> np.ndarray:
        low, high = values[chosen, a], values[chosen, b]
        share = (low / (low - high))[:, None]  # low ≤ 0 < high
        return points[chosen, a] + share * (points[chosen, b] - points[chosen, a])

    found = []
    # the edges that cross for one and three corners inside; for two, the quadrilateral gives two triangles
    for number, triangle in (
        (1, ((0, 1), (0, 2), (0, 3))),
        (3, ((0, 3), (1, 3), (2, 3))),
        (2, ((0, 2), (0, 3), (1, 3))),
        (2, ((0, 2), (1, 3), (1, 2))),
    ):
        chosen = count == number
        found.append(np.stack([crossing(chosen, a, b) for a, b in triangle], axis=1))
    return np.concatenate(found)


def lit(triangles: np.ndarray, field: np.ndarray, coordinates: Sequence[np.ndarray], color: Any) -> np.ndarray:
    """The colours of lit triangles, (k, 3), with the gradient of the field as a smooth normal vector."""
    from matplotlib.colors import to_rgb
    from scipy.interpolate import RegularGridInterpolator

    lengths = np.array([line[-1] - line[0] for line in coordinates])
    gradient: Any = np.gradient(np.where(np.isfinite(field), field, 0.0), *coordinates)
    slopes = np.stack(gradient, axis=-1) * lengths
    # evaluate at the centres of the triangles
    normal = RegularGridInterpolator(tuple(coordinates), slopes, bounds_error=False, fill_value=None)(
        triangles.mean(axis=1)
    )
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    shade = AMBIENT + (1 - AMBIENT) * np.clip(normal @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    return np.clip(shade[:, None] * np.array(to_rgb(color)), 0, 1)


def thinned(field: np.ndarray, coordinates: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Interpolate a field to at most ``FINEST`` points per axis, because more triangles would take minutes."""
    lines = [np.asarray(line) for line in coordinates]
    for axis, line in enumerate(lines):
        if len(line) <= FINEST:
            continue
        fewer = np.linspace(line[0], line[-1], FINEST)
        below = np.clip(np.searchsorted(line, fewer, side="right") - 1, 0, len(line) - 2)
        share = ((fewer - line[below]) / np.diff(line)[below]).reshape([-1 if i == axis else 1 for i in range(3)])
        field = (1 - share) * np.take(field, below, axis) + share * np.take(field, below + 1, axis)
        lines[axis] = fewer
    return field, lines
