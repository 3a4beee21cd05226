"""The optimum over the controls at the nodes of a small torus."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.hamiltonian import discrete, exact, optimum
from hjbjax.problem.pytree import cast

SHAPE = (4, 3)
GRID = hjb.Grid([0.0, 0.0], [1.0, 1.0], SHAPE, periodic=(True, True))
SPACING = np.array([1 / 4, 1 / 3])


@functools.partial(jax.jit, static_argnames="dtype")
def found(problem, value, dtype=np.float64):
    """H, the optimal controls, and the possible error of the optimum."""
    on = cast(Discretisation(problem, GRID, hjb.Upwind(), dtype), dtype)
    hamiltonian = discrete.around(on, jnp.asarray(value, dtype))
    best, u, _ = optimum.optimise(hamiltonian)
    missed = exact.optimum_error(hamiltonian, hamiltonian.on.players.control, lambda u: (u, []))
    return best, jnp.stack([jnp.broadcast_to(each, SHAPE) for each in u], -1), missed
