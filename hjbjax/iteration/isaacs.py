"""How far Isaacs' condition fails on a grid: min max against max min of the Hamiltonian, node by node."""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.hamiltonian import discrete, optimum
from hjbjax.problem import sets
from hjbjax.problem.sets import AdmissibleSet
from hjbjax.problem.types import Array, Field, Mask, Scalar


def isaacs_gap(hamiltonian: discrete.DiscreteHamiltonian, free: Mask) -> tuple[Scalar, Scalar]:
    """The largest min max − max min over the ``free`` nodes, and how much the actions matter there, per unit time.

    How much they matter is the largest difference of H between two pairs of them, of nine representatives a player.
    """
    upper, lower = extremes(hamiltonian)
    return gap_between(hamiltonian, free, upper, lower), weight_of_actions(hamiltonian, free, upper, lower)


def extremes(hamiltonian: discrete.DiscreteHamiltonian) -> tuple[Field, Field]:
    """min max and max min of H at the nodes."""
    upper, lower = (optimum.optimise(hamiltonian, isaacs=which)[0] for which in ("upper", "lower"))
    return upper, lower


def gap_between(hamiltonian: discrete.DiscreteHamiltonian, free: Mask, upper: Field, lower: Field) -> Scalar:
    """The largest min max − max min over the ``free`` nodes."""
    return hamiltonian.on.grid.largest(jnp.where(free, upper - lower, 0))


def weight_of_actions(hamiltonian: discrete.DiscreteHamiltonian, free: Mask, upper: Field, lower: Field) -> Scalar:
    """How much the actions matter over the ``free`` nodes, per unit time."""
    problem, dtype = hamiltonian.on.problem, hamiltonian.on.dtype
    sets_of = (problem.controls, problem.disturbances)
    mine, theirs = (jnp.asarray(_representatives(admissible), dtype) for admissible in sets_of)

    def compare(extremes: tuple[Field, Field], pair: jax.Array) -> tuple[tuple[Field, Field], None]:
        total = hamiltonian.at(list(mine[pair[0]]), list(theirs[pair[1]]))
        total = jnp.where(jnp.isfinite(total), total, upper)  # an action that an end of the box rules out
        return (jnp.minimum(extremes[0], total), jnp.maximum(extremes[1], total)), None

    pairs = jnp.asarray([(i, j) for i in range(len(mine)) for j in range(len(theirs))])
    # one pair at a time: all 81 at once would be 81 arrays of the nodes
    (least, most), _ = jax.lax.scan(compare, (lower, upper), pairs)
    size = 1e3 * jnp.finfo(dtype).eps * (jnp.abs(least) + jnp.abs(most))  # no gap is less than rounding
    return hamiltonian.on.grid.largest(jnp.where(free, most - least + size, 0))


def _representatives(admissible: AdmissibleSet | None) -> Array:
    """At most nine actions of a player, shape (K, m), the first and the last of its samples among them."""
    if admissible is None:
        return np.zeros((1, 0))
    points = sets.samples(admissible, 9)
    # a finite set may have thousands of points
    return points[np.unique(np.linspace(0, len(points) - 1, 9).round().astype(int))]
