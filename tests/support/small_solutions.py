"""Solutions on a few nodes."""

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.solution.solution import Solution

GRID = Grid([-1.0, 0.0], [1.0, 3.0], (5, 4))
RING = Grid([0.0, -1.0], [2 * np.pi, 1.0], (8, 3), (True, False), ("angle", "speed"))


def solution_of(function, grid=GRID, **fields):
    """A solution whose value is ``function`` of the coordinates at the nodes, and whose policy is twice that."""
    value = function(*np.moveaxis(grid.nodes(), -1, 0))
    return Solution(**{"grid": grid, "value": value, "policy": 2 * value[..., None], "code": 1, "steps": 3, **fields})


LINEAR = solution_of(lambda a, b: 1 + 2 * a - b)
