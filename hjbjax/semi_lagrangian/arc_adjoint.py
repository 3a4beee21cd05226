"""The derivative of a solution on arcs with respect to the numbers in the problem and in the grid.

The value V of a converged solve satisfies, at every free node,

    Φ(V, θ) = pay(θ) + keep(θ) I[V](y(θ)) − V = 0

for the best arc of the node, with fixed action and length. Let row x of W contain the weights ``keep`` · I of the best
arc of node x. Then ∂Φ/∂V = −(I − W), so dV = (I − W)⁻¹ ∂Φ/∂θ dθ: one linear solve in forward mode and one transposed
solve in reverse mode. The iteration δ ← right + W δ converges, because the best arcs lead to the target or discount V.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.paths import Plan
from hjbjax.hamiltonian.derivatives import once
from hjbjax.iteration import bellman
from hjbjax.iteration.adjoint import Map, solve_in_stages
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import AtNodes, Field, Mask, Scalar
from hjbjax.semi_lagrangian import arcs
from hjbjax.semi_lagrangian.arcs import Arcs, widened

FOLLOWED = 32  # arcs followed between two evaluations of the residual


@pytree_dataclass(static=("legs",))
class ArcEquation:
    """The equation of the best arcs, as a pytree with all numbers θ.

    Args:
      on: the problem on its grid.
      actions: the actions of the plan, (A, m).
      legs: the lengths of its arcs, R integers.
      number: the best arc of every node, integers (*grid).
      fixed: bool (*grid), the nodes with prescribed values, including unreachable nodes.
      counted: bool (*grid), the nodes with a finite value.
    """

    on: Discretisation
    actions: Any
    legs: tuple[int, ...]
    number: AtNodes
    fixed: Mask
    counted: Mask

    def best(self) -> Arcs:
        """The best arc of every node."""
        return arcs.trace_chosen(self.on, Plan(self.actions, np.array(self.legs, np.int32)), self.number, self.fixed)

    def residual(self, value: Field) -> Field:
        """Φ at a value, cost units, (*grid)."""
        grid, given = self.on.grid, jnp.where(self.counted, bellman.obstacles(self.on).fixed_value, 0)
        worth = self.best().worth(widened(value, grid), grid)
        return jnp.where(self.fixed, jnp.where(self.counted, given - value, 0), worth - value)


@jax.custom_jvp
def attach_arcs(value: Field, equation: ArcEquation) -> Field:
    """``value``, unchanged, as a differentiable function of the numbers in ``equation``, which it solves."""
    return value


@attach_arcs.defjvp
@own_settings()
def _attach_tangent(primals: Any, tangents: Any) -> tuple[Field, Field]:
    """The value, and its tangent by one linear solve; transposition gives one transposed solve."""
    value, equation = primals
    grid, best = equation.on.grid, jax.lax.stop_gradient(equation.best())

    def weighted(delta: Field) -> Field:
        """W δ."""
        return jnp.where(equation.fixed, 0, best.keep * best.read(widened(delta, grid), grid))

    def operator(delta: Field) -> Field:
        """(I − W) δ."""
        return delta - weighted(delta)

    right = jax.jvp(lambda question: question.residual(value), (equation,), (tangents[1],))[1]
    # value and operator are constants here; a second derivative would require their derivatives
    right = right + once(equation, "a solve").astype(right.dtype)
    return value, jax.lax.custom_linear_solve(operator, right, _solve, _solve)


def _solve(matvec: Map, right: Field) -> Field:
    """Solve (I − W) δ = right, or the transposed system."""

    def follow(left: Field) -> Field:
        def once_more(_: Scalar, delta: Field) -> Field:
            return delta + (left - matvec(delta))

        return jax.lax.fori_loop(0, FOLLOWED, once_more, jnp.zeros_like(left))

    return solve_in_stages(right, functools.partial(_left_over, matvec, right), [(follow, jnp.inf)])


def _left_over(matvec: Map, right: Field, delta: Field) -> Field:
    """The residual of δ."""
    return right - matvec(delta)
