"""Check that every node of a grid with constrained ends has an action that keeps the state in the box; host level.

With zero costs and V = 0 the Hamiltonian is zero where such an action exists, and infinite elsewhere.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.players import find_players
from hjbjax.discretisation.schemes import Upwind
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.iteration import bellman
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import DType, Mask


def check_constrained_ends(problem: Problem, grid: Grid, dtype: DType, t: float = 0.0) -> None:
    """Refuse a problem whose drift forces the state out across a constrained end at some node.

    Args:
      problem: the problem; must have passed ``checks.shapes``.
      grid: the grid.
      dtype: the floating-point type for the drift.
      t: the time, if the problem depends on it.

    Raises:
      ValueError: some node has no admissible action; names the first such node and a remedy.
    """
    if not grid.sides("constrained"):
        return
    with own_settings(x64=True):
        # always the chain's own scheme, since the actions that an end forbids depend only on the drift
        stuck = np.asarray(_without_action(Discretisation(problem, grid, Upwind(), np.dtype(dtype), t)))
    if not stuck.any():
        return
    index = tuple(int(i) for i in np.argwhere(stuck)[0])  # report the first only, there may be thousands
    ends = [
        f"the {'upper' if step > 0 else 'lower'} end of {grid.names[axis]}"
        for axis, step in grid.sides("constrained")
        if index[axis] == (grid.shape[axis] - 1 if step > 0 else 0)
    ]
    # without the cost, as in the search above; a cost that is not a polynomial would make the search use samples
    exact = find_players(altered(problem, cost=None), grid.ndim, np.float64).exact
    found = "no action is admissible" if exact else "none of the sampled actions is admissible"
    raise ValueError(
        f"Grid.edges: {found} at {int(stuck.sum())} of {grid.size} nodes, first at node {index}, "
        f"x = {np.array2string(grid.state(index), separator=', ', precision=6)}"
        + (f", t = {t:g}" if problem.time_dependent else "")
        + f":\nevery drift leaves the box across {' or '.join(ends)}, which is constrained. Use controls that can "
        "keep the state in,\nmove that end to where they can, or make it 'projected' or 'open'"
    )


@jax.jit
def _without_action(on: Discretisation) -> Mask:
    """The nodes outside the target without an admissible action, bool (*grid)."""
    # with V = 0 and L = 0 the infinite price of leaving is the only term of H
    free = altered(on.problem, cost=None)
    hamiltonian = discrete.around(on.asking(free), jnp.zeros(on.grid.shape, on.dtype))
    least = optimum.optimise(hamiltonian)[0]
    # on the target the run has ended, so no action is needed
    return ~jnp.isfinite(least) & ~bellman.obstacles(on).fixed
