"""The derivative of a solution with respect to the numbers in the problem and in the grid.

The value V of a converged solve satisfies Φ(V, θ) = 0, node by node the active one of (H(u, d) − β V)/(Q + β),
ψ − V, g − V and given − V. With W the weights of the optimal policy ∂Φ/∂V = −(I − W), so that

    dV = (I − W)⁻¹ ∂Φ/∂θ dθ.

∂Φ/∂θ is taken through the formulas that give the optimal action: where that is stationary they contribute nothing,
and where it sits at a bound or at a kink of the upwinding, both of which may move with θ, they do. Forward mode
takes one linear solve and reverse mode one transposed solve, whatever the number of steps that led to V. A linear solve
that does not come to its end makes the derivative NaN; the value stays as it is. The policy moves with V and θ as the
optimum of the Hamiltonian does, see ``sensitivity``.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import jump_rates
from hjbjax.hamiltonian import discrete, sensitivity
from hjbjax.iteration import bellman
from hjbjax.iteration.bellman import Greedy, PolicyEquation
from hjbjax.iteration.evaluation import Evaluation, Krylov, direct, evaluate, left_over
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Field, Number, Scalar

LinearSolve: TypeAlias = Callable[[object, Field], Field]  # of a matrix-free product, which is not used, and s
Refinement: TypeAlias = tuple[Field, Field, Scalar, Scalar]  # δ, its residual, the size of the last one, steps

STEPS = 200  # refinements of the linear solve in each of its two stages, at most
SLOW = 0.5  # a refinement that leaves more than this share of the residual hands over to Krylov's
GOAL = 1e3  # of the rounding unit of the right-hand side
ROUNDING = 64  # of the rounding unit of the solution: below that no residual can be brought


def attach(task: Task, state: State) -> Field:
    """The value of ``state``, unchanged, as a differentiable function of the problem and of the grid in ``task``.

    Args:
      task: the task as the user gave it, with its tracers.
      state: a converged state of the same task, found without derivatives.
    """
    # the tracers stay in ``task`` alone, for ∂Φ/∂θ; all that the linear solve needs is without derivatives
    task_kept, state = jax.lax.stop_gradient((task, state))
    value = state.value
    equation = jax.lax.stop_gradient(_ties_to_constraints(task_kept, state))
    evaluation = task.method.evaluation or Krylov()

    def solver(weights):
        return lambda _, right: refined(evaluation, PolicyEquation(right, weights), task_kept.grid)

    def matvec(delta):
        return -left_over(PolicyEquation(jnp.zeros_like(delta), equation.weights), task_kept.grid, delta)

    # the transposed row of a parabola belongs to no chain: with open ends both matrices are factored
    weights, solvers = equation.weights, _exact_solvers(equation, task_kept.grid)
    if not task_kept.grid.sides("open"):
        solvers = solver(weights), solver(weights.inflow(task_kept.grid))
    delta = jax.lax.custom_linear_solve(matvec, _residual(task, state, equation), *solvers)
    return _with_derivative(value, delta)


def attach_policy(task: Task, state: State, value: Field) -> State:
    """The state, its numbers unchanged, with a policy that is a differentiable function of ``value`` and of ``task``.

    Args:
      task: the task as the user gave it, with its tracers.
      state: a converged state of the same task, found without derivatives.
      value: its value with derivatives, of ``attach``.
    """
    frozen, policy = jax.lax.stop_gradient((task, state.policy))
    return dataclasses.replace(state, policy=_moving(policy, task.on, value, frozen))


@jax.custom_jvp
def _moving(policy: Greedy, on: Discretisation, value: Field, task: Task) -> Greedy:
    """``policy``, with the derivative of the optimum of the Hamiltonian; formed only where it is asked for."""
    return policy


@_moving.defjvp
def _moving_tangent(primals: Any, tangents: Any) -> tuple[Greedy, Greedy]:
    """The policy, and its tangent at the nodes where an action is taken."""
    policy, on, value, task = primals

    def actions(on: Discretisation, value: Field) -> Greedy:
        moved = sensitivity.actions(on, value, task.lost, list(policy.controls), list(policy.disturbances))
        acting = task.counted & ~task.obstacles.ended
        controls, disturbances = (
            tuple(jnp.where(acting, jnp.asarray(new, kept.dtype), kept) for kept, new in zip(*pair, strict=True))
            for pair in zip((policy.controls, policy.disturbances), moved, strict=True)
        )
        return Greedy(policy.defect, controls, disturbances)

    return policy, jax.jvp(actions, (on, value), tangents[1:3])[1]


@jax.custom_jvp
def _with_derivative(value: Field, delta: Field) -> Field:
    """``value``, with the derivative of ``delta``; the number ``delta`` itself is never computed."""
    return value


@_with_derivative.defjvp
def _with_tangent(primals: tuple[Field, Field], tangents: tuple[Field, Field]) -> tuple[Field, Field]:
    """The value, and the tangent of the correction in place of its own."""
    return primals[0], tangents[1]


def _exact_solvers(equation: PolicyEquation, grid: Grid) -> tuple[LinearSolve, LinearSolve]:
    """The solves of I − W and of its transpose by factorisation; rows of open ends are no jumps to be turned round."""

    def solve(transposed: bool) -> LinearSolve:
        return lambda _, right: direct(PolicyEquation(right, equation.weights), grid, transposed=transposed)

    return solve(False), solve(True)


def _ties_to_constraints(task: Task, state: State) -> PolicyEquation:
    """The linear equation of the policy, in which every node whose value is a constraint's belongs to that.

    Where going on is worth as much both branches hold. On a plateau without discount only this one has a derivative:
    a policy may go round on it for ever.
    """
    equation = task.equation(state.value, state.policy)
    free = jnp.ones(task.grid.shape, bool)
    for constraint in (task.obstacles.upper, task.obstacles.lower):
        if constraint is not None:
            free &= ~_is_constraint(state.value, constraint)
    # a row without weights reads δ = s, the derivative of the constraint itself
    return PolicyEquation(equation.source, equation.weights.scaled(jnp.where(free, 1, 0)), equation.fastest)


def _residual(task: Task, state: State, equation: PolicyEquation) -> Field:
    """Φ at the frozen value and branches, as a function of the problem and of the grid."""
    value, policy = state.value, state.policy
    obstacles = bellman.obstacles(task.on)
    u, d = list(policy.controls), list(policy.disturbances)
    # which node is on which branch does not change with θ, to first order: the masks carry no derivative
    held = jax.lax.stop_gradient(task.obstacles.fixed)
    lost = jax.lax.stop_gradient(task.lost)
    moved = sensitivity.actions(task.on, value, lost, u, d)  # as at an end or at a kink that moves
    rate = jnp.where(held, 0, discrete.around(task.on, value, lost).at(*moved) - task.problem.discount * value)
    outflow = jax.lax.stop_gradient(jump_rates(task.on, u, d).total() + task.problem.discount)
    # divided as the equation is, so that ∂Φ/∂V = −(I − W); a derivative of the divisor would be multiplied by r = 0
    phi = rate / jnp.where(outflow > 0, outflow, 1)
    bound = equation.weights.total() == 0  # rows of the constraints hold no weights
    for constraint in (obstacles.upper, obstacles.lower):
        if constraint is not None:
            phi = jnp.where(bound & _is_constraint(value, constraint), constraint - value, phi)
    return jnp.where(held, obstacles.fixed_value - value, phi)


def _is_constraint(value: Field, constraint: Field) -> jax.Array:
    """The nodes where a value was taken from the constraint, which rounds otherwise whenever it is evaluated anew."""
    # by the size of both, so that ψ = 0 is met exactly and nothing has a unit
    size = jnp.abs(value) + jnp.abs(constraint)
    return jax.lax.stop_gradient(jnp.abs(value - constraint) <= 64 * jnp.finfo(value.dtype).eps * size)


def refined(evaluation: Evaluation, equation: PolicyEquation, grid: Grid) -> Field:
    """δ by iterative refinement, to a small multiple of rounding; NaN where that is not reached.

    Sweeps hardly gain where little is discounted and the drift goes round in circles: there Krylov takes over.
    """
    eps, size = jnp.finfo(equation.source.dtype).eps, jnp.max(jnp.abs(equation.source))

    def goal(delta: Field) -> Scalar:
        # a residual is a difference of numbers of the size of δ, which may be far larger than the right-hand side
        return eps * (GOAL * size + ROUNDING * jnp.max(jnp.abs(delta)))

    def stage(method: Evaluation, delta: Field, slow: Number) -> Field:
        def refine(carry: Refinement) -> Refinement:
            delta, left, _, count = carry
            before = jnp.max(jnp.abs(left))
            delta = delta + evaluate(method, PolicyEquation(left, equation.weights), grid)
            return delta, left_over(equation, grid, delta), before, count + 1

        def unfinished(carry: Refinement) -> jax.Array:
            delta, left, before, count = carry
            size = jnp.max(jnp.abs(left))
            # a NaN is no size > …: it ends the loop, and is a NaN below
            return (size > goal(delta)) & (count < STEPS) & ~(size > slow * before)

        before, none = jnp.full((), jnp.inf, delta.dtype), jnp.zeros((), jnp.int32)
        start = (delta, left_over(equation, grid, delta), before, none)
        return jax.lax.while_loop(unfinished, refine, start)[0]

    delta = jnp.zeros_like(equation.source)
    if evaluation.rough:
        delta = stage(evaluation, delta, SLOW)
        evaluation = Krylov()
    delta = stage(evaluation, delta, jnp.inf)  # to the end, however slowly: nothing follows it
    left = jnp.max(jnp.abs(left_over(equation, grid, delta)))
    return jnp.where(left <= goal(delta), delta, jnp.nan)
