"""``decompose``: find the blocks of a problem, and solve each on its own grid."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hjbjax.decomposition.combination import BlockSolution
from hjbjax.decomposition.separation import SUM
from hjbjax.decomposition.subsystems import FIRST, Blocks, block_problem, find_blocks
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.types import Number
from hjbjax.solvers.finite_horizon import march
from hjbjax.solvers.stationary import solve
from hjbjax.tracing import checks, closures

TIMES = 51  # kept times of a march whose blocks must be inside at the same moment


@front_door
def decompose(problem: Problem, states: int, *, bound: bool = False) -> "Decomposition":
    """Find blocks of states that do not interact, from the traces of drift, costs, noise, targets and sets.

    The value of the problem follows from the values of the blocks if costs are sums, if targets and obstacles are
    maxima (intersections) or minima (unions) of signed distances, one for each block.

    Args:
      problem: the problem.
      states: the number of states n.

    Keyword Args:
      bound: accept a bound of V, and let blocks share states, controls and disturbances. The union of targets of one
        player remains exact. Default: blocks that share an input are one block, and a bound is refused.

    Returns:
      A Decomposition, whose ``solve`` and ``march`` solve the blocks.

    Raises:
      ValueError: the problem does not separate; the message names the coupling.

    Example:
      >>> import jax.numpy as jnp
      >>> from hjbjax import Box
      >>> drift = lambda x, u: jnp.stack([x[1], u[0], x[3], u[1]])
      >>> costs = lambda x, u: x @ x + u @ u
      >>> decompose(Problem(drift, costs, Box([-1.0] * 2, [1.0] * 2), discount=1.0), 4).states
      ((0, 1), (2, 3))
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"decompose: got {type(problem).__name__}, wanted a Problem")
    n = arguments.count(states, "decompose: states")
    checks.of_one_state(problem, n, "states")
    known = closures.settled(problem, n)
    return Decomposition(problem, known, n, find_blocks(known, n, bound=bound))


@pytree_dataclass(static=("count", "blocks"))
class Decomposition:
    """The blocks of a problem; made by ``decompose``.

    Args:
      problem: the whole problem.
      known: the same problem with its numbers as leaves.
      count: the number of states.
      blocks: states, controls and disturbances of every block, and the rule that puts their values together.
    """

    problem: Problem
    known: Problem
    count: int
    blocks: Blocks

    @property
    def states(self) -> tuple[tuple[int, ...], ...]:
        """The numbers of the states of every block."""
        return tuple(each.states for each in self.blocks.blocks)

    @property
    def controls(self) -> tuple[tuple[int, ...], ...]:
        """The numbers of the controls of every block."""
        return tuple(each.controls for each in self.blocks.blocks)

    @property
    def rule(self) -> str:
        """ "sum", "max", "min", or "first": the least over time of the largest, for a tube into an intersection."""
        return self.blocks.rule

    @property
    def bound(self) -> str | None:
        """ "lower" or "upper" if the combined value is only this bound of V."""
        return self.blocks.bound

    @property
    def problems(self) -> tuple[Problem, ...]:
        """The problems of the blocks. For the rule "first" each is to be inside at the end of the horizon."""
        return tuple(block_problem(self.known, self.blocks, i, self.count) for i in range(len(self.blocks.blocks)))

    def grids(self, grid: Grid | Sequence[Grid]) -> tuple[Grid, ...]:
        """The grids of the blocks.

        Args:
          grid: one grid over all states, which is never filled; or one grid per block.

        Raises:
          ValueError: a grid with another number of axes.
        """
        if not isinstance(grid, Grid):
            each = tuple(grid)
            axes = [len(own) for own in self.states]
            if [one.ndim for one in each] != axes:
                raise ValueError(f"Decomposition: got grids of {[one.ndim for one in each]} axes, wanted {axes}")
            return each
        if grid.ndim != self.count:
            raise ValueError(f"Decomposition: got a grid of {grid.ndim} axes, wanted {self.count}, or one per block")
        if grid.prescribed():
            raise ValueError("Decomposition: got prescribed ends on the whole grid; pass one grid per block")
        return tuple(_subgrid(grid, own) for own in self.states)

    def solve(self, grid: Grid | Sequence[Grid], **options: Any) -> BlockSolution:
        """Solve every block with ``hjb.solve``.

        Args:
          grid: as in ``grids``.
          options: keyword arguments of ``hjb.solve``.

        Raises:
          ValueError: the rule is "first", which needs a horizon.
        """
        if self.rule == FIRST:
            raise ValueError(
                "Decomposition.solve: a tube into an intersection needs all moments; use march(grid, horizon)"
            )
        found = [solve(problem, own, **options) for problem, own in zip(self.problems, self.grids(grid), strict=True)]
        return self._combined(found)

    def march(
        self, grid: Grid | Sequence[Grid], horizon: Number, *, times: Sequence[float] | None = None, **options: Any
    ) -> BlockSolution:
        """March every block with ``hjb.march``.

        Args:
          grid: as in ``grids``.
          horizon: T, in units of time.
          times: the kept times, as in ``hjb.march``. For the rule "first" these are the moments between which values
            are interpolated; default: 51 of them.
          options: other keyword arguments of ``hjb.march``.

        Raises:
          ValueError: the rule is "first" and the problem depends on time.
        """
        if self.rule == FIRST:
            if self.problem.time_dependent:
                raise ValueError(
                    "Decomposition.march: got a tube into an intersection with time_dependent=True, wanted False"
                )
            times = np.linspace(0.0, float(horizon), TIMES).tolist() if times is None else [*times]
            if times[-1] < float(horizon):
                times = [*times, float(horizon)]
        found = [
            march(problem, own, horizon, times=times, **options)
            for problem, own in zip(self.problems, self.grids(grid), strict=True)
        ]
        return self._combined(found)

    def _combined(self, found: Sequence[Any]) -> BlockSolution:
        """The solutions of the blocks as one."""
        side = self.problem.payoff if self.rule == SUM else COST
        return BlockSolution(
            tuple(found), self.rule, self.bound, self.states, self.controls,
            tuple(each.disturbances for each in self.blocks.blocks), self.problem.labels._replace(payoff=side),
            self.count, problem=self.problem,
        )  # fmt: skip

    def __repr__(self) -> str:
        names = " | ".join(", ".join(f"x[{i}]" for i in own) for own in self.states)
        return f"Decomposition({self.rule} over {names}{'' if self.bound is None else f', {self.bound} bound'})"


def _subgrid(grid: Grid, axes: Sequence[int]) -> Grid:
    """The grid of some axes."""
    own = np.array(axes, int)
    return Grid(
        np.asarray(grid.lo)[own], np.asarray(grid.hi)[own], tuple(grid.shape[i] for i in axes),
        periodic=tuple(grid.periodic[i] for i in axes), names=tuple(grid.names[i] for i in axes),
        stretch=tuple(grid.stretch[i] for i in axes), edges=[grid.edges[i] for i in axes],
        units=tuple(grid.units[i] for i in axes),
    )  # fmt: skip
