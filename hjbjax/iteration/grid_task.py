"""The base class of the tasks of solves and of marches: a discretisation, and the devices that hold its nodes."""

from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.problem.grid import Grid, division
from hjbjax.problem.layouts import Layout
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered

T = TypeVar("T", bound="GridTask")


class GridTask:
    """The base class of tasks on the nodes of a grid.

    Attributes:
      on: the problem on its grid.
      mesh: the devices over which the nodes are divided during the iteration; None for one device.
    """

    on: Discretisation
    mesh: Mesh | None

    @property
    def problem(self) -> Problem:
        """The problem."""
        return self.on.problem

    @property
    def grid(self) -> Grid:
        """The grid."""
        return self.on.grid

    @property
    def layout(self) -> Layout:
        """The layout of the task's arrays, which reduces over all nodes."""
        return self.grid.layout

    @property
    def division(self) -> Layout:
        """The layout of the iteration: parts over the mesh; one device without a mesh, or if the grid is too small."""
        return division(self.grid, self.mesh)

    def on_part(self: T, layout: Layout) -> T:
        """The task on the nodes of one device, inside ``shard_map`` if they are divided."""
        return altered(self, on=self.on.on_part(layout))

    def over_nodes(self: T, shape: tuple[int, ...]) -> T:
        """A tree of bools, True for leaves with a value at every node, that is, leaves of this ``shape``."""

        def mark(leaf: Any) -> bool:
            return np.shape(leaf) == shape

        # leaves of the problem and the grid may have this shape by chance, so they are False
        marked = jax.tree.map(mark, altered(self, on=altered(self.on, problem=None, grid=None)))
        problem, grid = jax.tree.map(lambda _: False, (self.problem, self.grid))
        return altered(marked, on=altered(marked.on, problem=problem, grid=grid))
