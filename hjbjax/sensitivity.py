"""The derivative of a solution with respect to the numbers in the problem and in the grid.

The value V of a converged solve satisfies Φ(V, θ) = 0, node by node the active one of (H(u, d) − β V)/(Q + β),
ψ − V, g − V and given − V. With W the weights of the optimal policy ∂Φ/∂V = −(I − W), so that

    dV = (I − W)⁻¹ ∂Φ/∂θ dθ.

∂Φ/∂θ is taken through the formulas that give the optimal action: where that is stationary they contribute nothing,
and where it sits at a bound or at a kink of the upwinding, both of which may move with θ, they do. Forward mode
takes one linear solve and reverse mode one transposed solve, whatever the number of steps that led to V.
"""

from typing import Any

import jax
import jax.numpy as jnp

from hjbjax import bellman, chain, iteration, relaxation
from hjbjax.bellman import Correction
from hjbjax.grid import Grid
from hjbjax.iteration import PolicyIteration, State, Task
from hjbjax.relaxation import Evaluation, Krylov

STEPS = 200  # refinements of the linear solve; each gains at least a digit with the default evaluations


def attach(task: Task, state: State) -> jax.Array:
    """The value of ``state``, unchanged, as a differentiable function of the problem and of the grid in ``task``.

    Args:
      task: the task as the user gave it, with its tracers.
      state: a converged state of the same task, found without derivatives.
    """
    task_kept, state = jax.lax.stop_gradient((task, state))
    value = state.value
    equation = jax.lax.stop_gradient(iteration.equation(task_kept, value, state.policy))
    evaluation = task.method.evaluation if isinstance(task.method, PolicyIteration) else Krylov()

    def solver(weights):
        return lambda _, right: refined(evaluation, Correction(right, weights), task_kept.grid)

    def matvec(delta):
        return -relaxation.left_over(Correction(jnp.zeros_like(delta), equation.weights), task_kept.grid, delta)

    weights = equation.weights
    delta = jax.lax.custom_linear_solve(
        matvec, _residual(task, state, equation), solver(weights), solver(weights.inflow(task_kept.grid))
    )
    return value + (delta - jax.lax.stop_gradient(delta))


def _residual(task: Task, state: State, equation: Correction) -> jax.Array:
    """Φ at the frozen value and branches, as a function of the problem and of the grid."""
    problem, grid, value, policy = task.problem, task.grid, state.value, state.policy
    rules = bellman.conditions(problem, grid, value.dtype)
    u, d = list(policy.controls), list(policy.disturbances)
    held = jax.lax.stop_gradient(task.rules.held)
    rate = bellman.greedy(problem, grid, value, held, scheme=task.scheme, incumbent=policy).rate
    scheme = task.scheme.chain
    total = chain.rates(problem, grid, u, d, scheme=scheme, dtype=value.dtype).total()
    pace = jax.lax.stop_gradient(total + problem.discount)
    phi = rate / jnp.where(pace > 0, pace, 1)
    bound = equation.weights.total() == 0  # rows of the constraints hold no weights
    if rules.stop is not None:
        phi = jnp.where(bound & (value >= jax.lax.stop_gradient(rules.stop)), rules.stop - value, phi)
    if rules.floor is not None:
        phi = jnp.where(bound & (value <= jax.lax.stop_gradient(rules.floor)), rules.floor - value, phi)
    return jnp.where(held, rules.given - value, phi)


def refined(evaluation: Evaluation, equation: Correction, grid: Grid) -> jax.Array:
    """Iterative refinement until the residual is a small multiple of rounding or ``STEPS`` corrections are done."""
    goal = 1e3 * jnp.finfo(equation.source.dtype).eps * jnp.max(jnp.abs(equation.source))

    def refine(carry: Any) -> Any:
        delta, left, count = carry
        delta = delta + relaxation.solve(evaluation, Correction(left, equation.weights), grid)
        return delta, relaxation.left_over(equation, grid, delta), count + 1

    def unfinished(carry: Any) -> Any:
        return (jnp.max(jnp.abs(carry[1])) > goal) & (carry[2] < STEPS)

    start = (jnp.zeros_like(equation.source), equation.source, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, refine, start)[0]
