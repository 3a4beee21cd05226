"""The base class of the paths that a scheme follows: it plans the arcs from every node, and checks the problem."""

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
        """K = A R. Arcs are numbered action by action, and by increasing length for each action."""
        return len(self.actions) * len(self.legs)


class Paths(abc.ABC):
    """The paths that a stationary solve follows instead of using slopes; a frozen and hashable value."""

    @abc.abstractmethod
    def check(self, problem: Problem, grid: Grid) -> None:
        """Refuse a problem or a grid that these paths do not support.

        Raises:
          ValueError: not supported; the message names an alternative.
        """

    @abc.abstractmethod
    def plan(self, problem: Problem, grid: Grid, dtype: DType) -> Plan:
        """The arcs to try."""
