"""hjbjax: Hamilton–Jacobi–Bellman and Isaacs equations on grids, with JAX."""

from hjbjax._version import __version__
from hjbjax.grid import Grid
from hjbjax.problem import Problem
from hjbjax.sets import Ball, Box, Finite

__all__ = ["Ball", "Box", "Finite", "Grid", "Problem", "__version__"]
