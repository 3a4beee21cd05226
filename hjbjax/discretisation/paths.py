"""The base class of schemes' paths: which arcs to try from every node, and for which problems."""

import abc

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, DType


@pytree_dataclass()
class Plan:
    """The arcs to try from every node: every action with every length.

    Args:
      actions: (A, m).
      legs: the numbers of legs of the arcs, increasing integers, (R,).
    """

    actions: Array
    legs: Array

    @property
    def count(self) -> int:
        """K = A R: the arcs of the first action, by increasing length, then those of the next."""
        return len(self.actions) * len(self.legs)


class Paths(abc.ABC):
    """The paths that a stationary solve follows instead of using slopes; a frozen and hashable value."""

    @abc.abstractmethod
    def check(self, problem: Problem, grid: Grid) -> None:
        """Refuse a problem, or a grid, without such paths.

        Raises:
          ValueError: names an alternative.
        """

    @abc.abstractmethod
    def plan(self, problem: Problem, grid: Grid, dtype: DType) -> Plan:
        """The arcs to try."""
