"""The violation of Isaacs' condition on a grid: min max minus max min of the Hamiltonian at the nodes."""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.hamiltonian import discrete, optimum
from hjbjax.problem import sets
from hjbjax.problem.sets import AdmissibleSet
from hjbjax.problem.types import Array, Field, Mask, Scalar


def isaacs_gap(hamiltonian: discrete.DiscreteHamiltonian, free: Mask) -> tuple[Scalar, Scalar]:
    """The largest min max − max min over the ``free`` nodes, and the influence of the actions there, per unit time.

    The influence is the largest difference of H between two pairs of actions, out of nine representatives per player.
    """
    upper, lower = minmax_and_maxmin(hamiltonian)
    return gap_between(hamiltonian, free, upper, lower), weight_of_actions(hamiltonian, free, upper, lower)


def minmax_and_maxmin(hamiltonian: discrete.DiscreteHamiltonian) -> tuple[Field, Field]:
    """min max and max min of H at the nodes."""
    upper, lower = (optimum.optimise(hamiltonian, isaacs=which)[0] for which in ("upper", "lower"))
    return upper, lower


def gap_between(hamiltonian: discrete.DiscreteHamiltonian, free: Mask, upper: Field, lower: Field) -> Scalar:
    """The largest min max − max min over the ``free`` nodes."""
    return hamiltonian.on.grid.layout.largest(jnp.where(free, upper - lower, 0))


def weight_of_actions(hamiltonian: discrete.DiscreteHamiltonian, free: Mask, upper: Field, lower: Field) -> Scalar:
    """The influence of the actions over the ``free`` nodes, per unit time, see ``isaacs_gap``."""
    problem, dtype = hamiltonian.on.problem, hamiltonian.on.dtype
    sets_of = (problem.controls, problem.disturbances)
    mine, theirs = (jnp.asarray(_representatives(admissible), dtype) for admissible in sets_of)

    def compare(extremes: tuple[Field, Field], pair: jax.Array) -> tuple[tuple[Field, Field], None]:
        total = hamiltonian.at(list(mine[pair[0]]), list(theirs[pair[1]]))
        total = jnp.where(jnp.isfinite(total), total, upper)  # actions that an end of the box forbids
        return (jnp.minimum(extremes[0], total), jnp.maximum(extremes[1], total)), None

    pairs = jnp.asarray([(i, j) for i in range(len(mine)) for j in range(len(theirs))])
    # one pair at a time: all 81 at once would store 81 arrays
    (least, most), _ = jax.lax.scan(compare, (lower, upper), pairs)
    size = 1e3 * jnp.finfo(dtype).eps * (jnp.abs(least) + jnp.abs(most))  # a gap below rounding means nothing
    return hamiltonian.on.grid.layout.largest(jnp.where(free, most - least + size, 0))


def _representatives(admissible: AdmissibleSet | None) -> Array:
    """At most nine actions of a player, shape (K, m), including the first and the last of its samples."""
    if admissible is None:
        return np.zeros((1, 0))
    points = sets.samples(admissible, 9)
    # a finite set may have thousands of points
    return points[np.unique(np.linspace(0, len(points) - 1, 9).round().astype(int))]
