"""Corrections of a candidate W by the defects along the paths.

Let E solve (β − L^π) E = β s, where L^π is the generator of the Markov chain under a policy π: the discounted mean of s
along the path from each node. Subtracting E from W lowers the defect β W − H by about β s. Without a discount the right
side is the running cost times s, and E is zero on the target. Two uses:

- s is the middle of the range of the defect in each cell: defect correction, which removes most of the discretisation
  error of the node values.
- s is the part of the defect above a level, widened and smoothed: the shift of the bound falls to that level, while the
  bound becomes wider only where paths meet large defects.

Nothing here needs to be exact: the defects of the corrected candidate are bounded again.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from hjbjax.markov_chain import chain
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered

REACH = 2  # a source is widened and then smoothed over this number of cells, so that E is smooth on the grid
SHARE = 40  # on fine grids the reach is this part of an axis, otherwise E falls too steeply across the paths
MARGIN = 1.3  # a source is larger than the defect, because the chain spreads it
MEAN = np.array([1, 3, 6, 7, 6, 3, 1]) / 27  # three means of three neighbours
DIRECT = 2  # states up to which the linear equations are factored


def on_nodes(cells: np.ndarray, grid: Grid, join: Callable[..., Any] = np.mean) -> np.ndarray:
    """Numbers per cell as numbers per node; a periodic axis has one more cell than nodes, and ``join`` combines two."""
    for axis, cyclic in enumerate(grid.periodic):
        if cyclic:
            ends = join(np.take(cells, [0, -1], axis=axis), axis=axis, keepdims=True)
            middle = np.delete(cells, [0, cells.shape[axis] - 1], axis=axis)
            cells = np.concatenate([ends, middle], axis=axis)
    return cells


def solver(problem: Problem, grid: Grid, policy: np.ndarray, rate: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """The solution E of (β − L^π) E = s as a function of s.

    Args:
      problem: the problem.
      grid: the grid.
      policy: the controls of both players at every node, shape (*grid, m + l).
      rate: β at every node, shape (*grid); without a discount one on the target and a small number elsewhere.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import bicgstab, splu

    without = altered(problem, discount=1.0) if callable(problem.discount) else problem
    count = 0 if problem.controls is None else problem.controls.dim
    own, other = policy[..., :count] if count else None, policy[..., count:] if problem.is_game else None
    matrix = (diags_array(rate.ravel()) - chain.generator(without, grid, own, disturbance=other)).tocsc()
    if grid.ndim <= DIRECT:
        factors = splu(matrix)
        return lambda source: factors.solve(source.ravel()).reshape(grid.shape)
    scale = diags_array(1 / matrix.diagonal())

    def solve(source: np.ndarray) -> np.ndarray:
        found, _ = bicgstab(matrix, source.ravel(), rtol=1e-6, maxiter=500, M=scale)
        return found.reshape(grid.shape)

    return solve


def smooth_cover(excess: np.ndarray, grid: Grid) -> np.ndarray:
    """A smooth source that is nowhere smaller than the excess: the mean over neighbours of the largest neighbour."""
    from scipy.ndimage import maximum_filter1d, uniform_filter1d

    for axis, cyclic in enumerate(grid.periodic):
        mode, size = "wrap" if cyclic else "nearest", 2 * max(REACH, excess.shape[axis] // SHARE) + 1
        excess = uniform_filter1d(maximum_filter1d(excess, size, axis, mode=mode), size, axis, mode=mode)
    return MARGIN * excess


def pad(values: np.ndarray, axis: int, count: int, *, cyclic: bool) -> np.ndarray:
    """Values with ``count`` more nodes beyond both ends of an axis: linear extrapolations, or periodic."""
    widths = [(count * (other == axis),) * 2 for other in range(values.ndim)]
    mode: dict[str, Any] = {"mode": "wrap"} if cyclic else {"mode": "reflect", "reflect_type": "odd"}
    return np.pad(values, widths, **mode)


def mollified(values: np.ndarray, grid: Grid) -> np.ndarray:
    """Means over nearby nodes, three on both sides of each; linear functions do not change, also at the ends."""
    from scipy.ndimage import correlate1d

    for axis, cyclic in enumerate(grid.periodic):
        wide = correlate1d(pad(values, axis, 3, cyclic=cyclic), MEAN, axis)
        values = np.take(wide, range(3, wide.shape[axis] - 3), axis=axis)
    return values


def away_from(mask: np.ndarray, grid: Grid) -> np.ndarray:
    """True at the nodes that are neither in a set nor next to it."""
    from scipy.ndimage import maximum_filter1d

    found = mask
    for axis, cyclic in enumerate(grid.periodic):
        found = maximum_filter1d(found, 3, axis, mode="wrap" if cyclic else "nearest")
    return ~found


def nearest_known(numbers: np.ndarray, known: np.ndarray, grid: Grid) -> np.ndarray:
    """Numbers at nodes, with unknown ones replaced by the number of the nearest known node."""
    from scipy.ndimage import distance_transform_edt

    spacings = [float(grid.spacing(axis)) for axis in range(grid.ndim)]
    index = distance_transform_edt(~known, spacings, return_distances=False, return_indices=True)
    return numbers[tuple(index)]
