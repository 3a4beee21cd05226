"""A stationary solve on the host: checks of nodes, preparation, coarser grids and steps, as the clock allows.

The public functions and JAX transformations share this code, so their results agree.
"""

import dataclasses
from typing import Any

import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.hamiltonian import exact
from hjbjax.iteration.methods import Method
from hjbjax.problem.types import Nodes
from hjbjax.solution.clock import Clock, Stopped
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status
from hjbjax.solvers import coarse_levels, semi_lagrangian
from hjbjax.solvers.box_error import with_box_error
from hjbjax.solvers.coarser_answer import coarser_answer
from hjbjax.solvers.order import staged
from hjbjax.solvers.result import finish, solution_at_start, with_grid_error
from hjbjax.solvers.second_order import better_of, second_order
from hjbjax.solvers.semi_lagrangian import Followed
from hjbjax.solvers.settle import Settled, settle
from hjbjax.solvers.setup import COARSEST, choose_scheme, prepare_on_host, warn_unreached
from hjbjax.well_posedness import admissibility, node_checks


@dataclasses.dataclass(frozen=True)
class Choices:
    """The choices that the caller left open.

    Attributes:
      scheme: the scheme.
      method: the method.
      levels: coarser grids.
      tol: the tolerance, so that a second-order iteration may stop by the grid error.
    """

    scheme: bool
    method: bool
    levels: bool
    tol: bool

    @property
    def both(self) -> bool:
        """True if scheme and method may be replaced together."""
        return self.scheme and self.method

    @property
    def to_grid_error(self) -> bool:
        """True if a second-order solution may stop at a fraction of the estimated error of the grid."""
        return self.scheme and self.tol


def solve_on_host(
    on: Discretisation,
    method: Method,
    tol: float,
    guess: Nodes | None,
    clock: Clock,
    choices: Choices,
    mesh: Mesh | None = None,
) -> Solution:
    """The solution, with an estimate of the grid error if the caller left the scheme open.

    Arguments as for ``settled_on_host``.
    """
    try:
        settled, about = settled_on_host(on, method, tol, guess, clock, choices, mesh)
    except Stopped as stop:
        return solution_at_start(stop.reached[0], stop.reached[1], stop.status)
    if isinstance(settled, Followed):
        return semi_lagrangian.finish_replacement(settled)
    solution = finish(settled, on.grid)
    # value iteration and tubes, whose targets consist of nodes, have no estimate
    if choices.scheme and settled.task.scheme.subcell and solution.status is Status.CONVERGED:
        solution = with_grid_error(solution, settled, settled.coarser or coarser_answer(settled, clock))
    if solution.status is Status.CONVERGED:
        solution = with_box_error(solution, settled, clock)
    solution.stats.update(about)
    return solution


def settled_on_host(
    on: Discretisation,
    method: Method,
    tol: float,
    guess: Nodes | None,
    clock: Clock,
    choices: Choices,
    mesh: Mesh | None = None,
) -> tuple[Settled | Followed, dict[str, Any]]:
    """The end of the iteration, and statistics about it.

    Args:
      on: the problem on its grid.
      method: the method, maybe on nested grids.
      tol: as in ``solve``.
      guess: initial node values, or None.
      clock: the limits.
      choices: the choices that the caller left open.
      mesh: the devices over which the nodes are divided; None: one device.

    Raises:
      Stopped: the clock stopped the solve before the first step; ``reached`` is the discretisation and the start.
    """
    problem, grid = on.problem, on.grid
    start: Nodes | None = None if guess is None else np.asarray(guess, on.dtype)
    try:
        # from cheap to expensive: all nodes, the ends of the box, then everything that is compiled for the grid
        exact.check_unbounded(on, relaxes=method.inner.relaxes)
        node_checks.check_values(on, clock, mesh)
        admissibility.check_constrained_ends(problem, grid, on.dtype)
        sharpen = choices.scheme
        if sharpen:
            on = on.with_scheme(choose_scheme(on, method))
            sharpen = on.scheme.subcell  # value iteration and tubes must start from the chain, also on a coarser grid
        task, assumptions, reach = prepare_on_host(on.chain, method=method.inner, tol=tol, clock=clock, mesh=mesh)
        may_follow = choices.both and mesh is None  # arcs read nodes far away
        followed = semi_lagrangian.replace_chain(on, reach, tol, start, clock) if may_follow else None
    except Stopped as stop:
        raise Stopped(stop.status, (on, np.zeros(grid.shape) if start is None else np.array(start))) from None
    if followed is not None:
        return followed, {}
    if reach is not None and not reach.surely.all():
        warn_unreached(reach, problem.payoff, undiscounted=bool(problem.discount == 0))
    reached = None if reach is None else reach.surely
    asked_again = sharpen and choices.levels and grid.size > COARSEST and not grid.sides("open")
    start, shapes, coarser = coarse_levels.first_guess(task, on.scheme, method, start, clock, asked_again=asked_again)
    task = staged(task, on.scheme)
    settled = settle(task, assumptions, reached, start, clock)
    del start  # an array of all nodes
    if settled.task is task:  # the nodes with prescribed values are those of the coarser grid
        settled = settled._replace(coarser=coarser)
    about: dict[str, Any] = {"levels": [*shapes, grid.shape]}
    if not on.scheme.monotone and (settled.code is Status.CONVERGED or not sharpen):
        settled = settled.without_actions()
        sharp = second_order(settled, on.scheme, clock, to_grid_error=choices.to_grid_error)
        settled = better_of(settled, sharp, clock, sharpen=sharpen)
    if type(settled.task.method.evaluation) is not type(method.evaluation):
        about["method"] = settled.task.method.described(problem.is_game)
    return settled.of_chain(), about
