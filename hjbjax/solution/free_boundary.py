"""The boundary of a set of nodes, such as the stopping set, between the nodes.

At the boundary of the stopping set V touches ψ. Let w = |V − ψ|, with ψ continued into the other side by the parabola
through the last three nodes of the set, where V = ψ. If V leaves ψ smoothly, w is a parabola whose vertex is the
boundary (smooth pasting). The chain sets w to zero at the last node of the set, which shifts w by O(h²) but not its
vertex, so the minimum of the cubic through this node and the next three is accurate to O(h²). It lies within half a
cell of the last node. If V leaves ψ at an angle, the boundary is the zero of the parabola through the next three nodes,
or of the line through two. The parabola through the next three nodes distinguishes the two cases: at an angle its
vertex is far away. Where neither applies, next to an end of the box or to infinite values, the boundary is the middle
of the cell.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from hjbjax.problem.grid import Grid

NEAR = 0.75  # cells from the last node of the set to the vertex: half a cell, up to O(h²)
FAR = 1.5  # cells from there back to the vertex of the parabola through the nodes outside; it is further at an angle


def points_of(coordinates: np.ndarray, values: np.ndarray, inside: np.ndarray, period: float | None) -> np.ndarray:
    """The ends of a set along one axis, increasing.

    Args:
      coordinates: the nodes, (N,), increasing.
      values: V at the nodes, (N,).
      inside: True for nodes of the set, (N,).
      period: the length of a periodic axis; None for any other axis.

    Returns:
      Shape (k,).
    """
    return np.sort([place for _, place in _crossings(coordinates, values[None], inside[None], period)])


def segments_of(
    coordinates: Sequence[np.ndarray], values: np.ndarray, inside: np.ndarray, periods: Sequence[float | None]
) -> np.ndarray:
    """The boundary of a set over two axes as straight segments, one or two per cell, as contour lines are drawn.

    Arguments as for ``points_of``, with two axes of nodes (N₁, N₂).

    Returns:
      Shape (k, 2, 2): segments, their two ends, and the coordinates of an end.
    """
    # the boundary crosses the link from node (i, j) along an axis at a place on that axis
    crossings: list[dict[tuple[int, int], np.ndarray]] = []
    for axis in (0, 1):
        lines = np.moveaxis(values, axis, -1), np.moveaxis(inside, axis, -1)
        found = {}
        for (line, node), place in _crossings(coordinates[axis], *lines, periods[axis]):
            other = coordinates[1 - axis][line]
            found[(node, line) if axis == 0 else (line, node)] = np.array(
                [place, other] if axis == 0 else [other, place]
            )
        crossings.append(found)
    segments: list[tuple[np.ndarray, np.ndarray]] = []
    cells = [n if period is not None else n - 1 for n, period in zip(inside.shape, periods, strict=True)]
    for i, j in _mixed_cells(inside, cells):
        right, top = (i + 1) % inside.shape[0], (j + 1) % inside.shape[1]
        # the sides of the cell in the order of a walk around it, each moved by a period if it is beyond the seam
        sides = [
            _moved(crossings[0].get((i, j)), 0, 0.0),
            _moved(crossings[1].get((right, j)), 0, 0.0 if right else periods[0] or 0.0),
            _moved(crossings[0].get((i, top)), 1, 0.0 if top else periods[1] or 0.0),
            _moved(crossings[1].get((i, j)), 0, 0.0),
        ]
        ends = [side for side in sides if side is not None]
        if len(ends) == 4 and inside[i, j]:  # opposite corners inside: two segments, each cuts off one of them
            ends = ends[-1:] + ends[:-1]
        segments += list(zip(ends[::2], ends[1::2], strict=True))
    return np.array(segments).reshape(-1, 2, 2)


def boundary_of(grid: Grid, value: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The boundary of a set of nodes on a grid with one or two axes; see ``points_of`` and ``segments_of``.

    Raises:
      ValueError: modes, more than two axes, or arrays that do not have the shape of the grid.
    """
    if grid.modes:
        raise ValueError(
            f"Solution.free_boundary: got a solution with the modes {', '.join(grid.modes)}; every mode has its own.\n"
            f"Write solution.in_mode({grid.modes[0]!r}).free_boundary()"
        )
    if grid.ndim > 2:
        raise ValueError(
            f"Solution.free_boundary: got a grid with {grid.ndim} axes, wanted one or two.\n"
            "Take a section: the mask Solution.stopping has an entry for every node"
        )
    if value.shape != grid.shape or inside.shape != grid.shape:
        raise ValueError(
            f"Solution.free_boundary: got values of shape {value.shape} and a set of shape {inside.shape} on a grid of "
            f"shape {grid.shape}; pass one solution of a batch, and one mask with an entry for every node"
        )
    axes = [np.asarray(grid.axis(axis), float) for axis in range(grid.ndim)]
    lengths = np.asarray(grid.hi, float) - np.asarray(grid.lo, float)
    periods = [float(length) if cyclic else None for length, cyclic in zip(lengths, grid.periodic, strict=True)]
    if grid.ndim == 1:
        return points_of(axes[0], value, inside, periods[0])
    return segments_of(axes, value, inside, periods)


def _crossings(
    coordinates: np.ndarray, values: np.ndarray, inside: np.ndarray, period: float | None
) -> list[tuple[tuple[int, int], float]]:
    """The places where lines (lines, N) cross the boundary: line, lower node of the link, and coordinate."""
    count = len(coordinates)
    after = np.roll(inside, -1, axis=1)
    changes = inside != after
    if period is None:
        changes[:, -1] = False
    found = []
    for line, node in np.argwhere(changes).tolist():
        # walk from the set outwards: three nodes inside, then three nodes outside
        step = 1 if inside[line, node] else -1
        last = node if step == 1 else node + 1
        walk = [last + k * step for k in range(-2, 4)]
        turns = [index // count if period is not None else 0 for index in walk]
        there = [0 <= index < count or period is not None for index in walk]
        rows = [index % count for index in walk]
        x = np.array([coordinates[row] + (period or 0.0) * turn for row, turn in zip(rows, turns, strict=True)])
        v, known = values[line, rows], np.array(there) & np.isfinite(values[line, rows])
        found.append(((line, node), _place(step * x, v, known & (inside[line, rows] == [1, 1, 1, 0, 0, 0])) * step))
    return found


def _place(x: np.ndarray, v: np.ndarray, known: np.ndarray) -> float:
    """The boundary between the third and the fourth of six nodes with increasing x; the first three are in the set."""
    middle = float((x[2] + x[3]) / 2)
    if not known[2:5].all():
        return middle
    inner, outer = (list(itertools.takewhile(lambda i: known[i], nodes)) for nodes in ((2, 1, 0), (3, 4, 5)))
    gap = np.abs(v[outer] - _newton(x[inner], v[inner], x[outer]))
    near = x[3] - x[2]
    if _vertex(x[outer], gap) > x[2] - FAR * near:
        vertex = _minimum((x[[2, *outer]] - x[2]) / near, np.array([0.0, *gap]))
        if abs(vertex) <= NEAR:
            return float(x[2] + near * vertex)
    slope = (gap[1] - gap[0]) / (x[4] - x[3])
    if slope <= 0:
        return middle
    root = np.array([np.clip(x[3] - gap[0] / slope, x[2], x[3])])
    steeper = slope + (x[3] - x[4]) * _bend(x[outer], gap)  # the slope of the parabola at the first node outside
    if steeper > 0:  # one step of Newton's method from the zero of the line to the zero of the parabola
        root = root - _newton(x[outer], gap, root) / (steeper + 2 * _bend(x[outer], gap) * (root - x[3]))
    return float(np.clip(root, x[2], x[3])[0])


def _bend(x: np.ndarray, w: np.ndarray) -> float:
    """Half the second derivative of the parabola through three points; zero for two."""
    if len(x) < 3:
        return 0.0
    return float(((w[2] - w[1]) / (x[2] - x[1]) - (w[1] - w[0]) / (x[1] - x[0])) / (x[2] - x[0]))


def _vertex(x: np.ndarray, w: np.ndarray) -> float:
    """The place of the minimum of the parabola through three points; −∞ if it has none, ∞ for two points."""
    if len(x) < 3:
        return np.inf
    bend = _bend(x, w)
    return (x[0] + x[1]) / 2 - (w[1] - w[0]) / (x[1] - x[0]) / (2 * bend) if bend > 0 else -np.inf


def _minimum(t: np.ndarray, w: np.ndarray) -> float:
    """The minimum of the cubic through four points that is next to the vertex of the parabola through the first three.

    With three points it is that vertex.
    """
    vertex = _vertex(t[:3], w[:3])
    if not abs(vertex) <= NEAR or len(t) < 4:
        return vertex
    _, *slope = np.linalg.solve(np.vander(t, increasing=True), w) * np.arange(4)
    roots = np.roots(slope[::-1])
    real = roots[np.isreal(roots)].real
    nearest = real[np.argmin(np.abs(real - vertex))] if real.size else vertex
    return float(nearest if abs(nearest - vertex) < 0.5 else vertex)


def _newton(x: np.ndarray, v: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The polynomial through at most three points, at other places."""
    table = [v]
    for order in range(1, len(x)):
        table.append(np.diff(table[-1]) / (x[order:] - x[:-order]))
    weight, found = np.ones(len(at)), np.zeros(len(at))
    for order, row in enumerate(table):
        found = found + row[0] * weight
        weight = weight * (at - x[order])
    return found


def _mixed_cells(inside: np.ndarray, cells: Sequence[int]) -> list[list[int]]:
    """The cells with corners on both sides, by their lower corners."""
    corners = [np.roll(inside, (-a, -b), axis=(0, 1)) for a, b in itertools.product((0, 1), (0, 1))]
    mixed = np.any(corners, axis=0) & ~np.all(corners, axis=0)
    return np.argwhere(mixed[: cells[0], : cells[1]]).tolist()


def _moved(point: np.ndarray | None, axis: int, shift: float) -> np.ndarray | None:
    """A point moved along one axis."""
    if point is None or not shift:
        return point
    moved = point.copy()
    moved[axis] += shift
    return moved
