"""The derivative of a solution with respect to the numbers in the problem and in the grid.

The value V of a converged solve satisfies Φ(V, θ) = 0. At each node Φ is the active one of (H(u, d) − β V)/(Q + β),
ψ − V, g − V and prescribed value − V. With W the weights of the optimal policy ∂Φ/∂V = −(I − W), so

    dV = (I − W)⁻¹ ∂Φ/∂θ dθ.

∂Φ/∂θ is taken through the formulas for the optimal action. These contribute nothing where the action is stationary, but
they do where it is at a bound or at a kink of the upwinding, since both may move with θ. Forward mode takes one linear
solve and reverse mode one transposed solve, independently of the number of steps that led to V. A linear solve that
does not converge makes the derivative NaN; the value is unchanged. The policy is differentiated as the optimum of the
Hamiltonian in V and θ, see ``sensitivity``.

With high-order slopes Φ is not linear in V, and its derivative is not the matrix of a chain. The limited slopes are
then differentiated at fixed actions, and a Krylov method, preconditioned by sweeps with I − W, solves the linear
system.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeAlias

import jax
import jax.numpy as jnp

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import Rates, jump_rates
from hjbjax.hamiltonian import discrete, sensitivity
from hjbjax.hamiltonian.derivatives import once
from hjbjax.hamiltonian.search import Action
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation, with_interventions
from hjbjax.iteration.evaluation import Evaluation, Krylov, direct, evaluate, left_over, relaxed
from hjbjax.iteration.fixed_point import Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Field, Mask, Number, Scalar

Map: TypeAlias = Callable[[Field], Field]  # maps node values to node values
LinearSolve: TypeAlias = Callable[[Map, Field], Field]  # from a matrix-free product and the right-hand side
Actions: TypeAlias = tuple[Action, Action]  # an action of the control and one of the disturbance
Refinement: TypeAlias = tuple[Field, Field, Scalar, Scalar]  # δ, residual, previous size, steps

STEPS = 200  # largest number of refinements of the linear solve in each of its two stages
SLOW = 0.5  # if a refinement leaves more than this fraction of the residual, Krylov takes over
GOAL = 1e3  # in units of the rounding error of the right-hand side
ROUNDING = 64  # in units of the rounding error of the solution, below which no residual can fall
FRACTION = 1e-3  # fraction of the residual to which one run of the Krylov method for high-order slopes reduces it
KRYLOV = 200  # largest number of steps of that run


class Answer(Protocol):
    """A value and its policy, computed without derivatives."""

    @property
    def value(self) -> Field:
        """V, (*grid)."""

    @property
    def policy(self) -> Greedy:
        """The optimal actions at V."""


@pytree_dataclass()
class FixedPoint:
    """The equation Φ(V, θ) = 0 at the nodes, as a pytree with all numbers θ.

    Args:
      on: the problem on its grid.
      obstacles: fixed nodes and constraints.
      lost: the unreachable nodes, to which no action may lead, bool (*grid), or None.
      arriving: an addition to the running cost, such as V/Δt in an implicit step; cost per unit time.
    """

    on: Discretisation
    obstacles: Obstacles
    lost: jax.Array | None = None
    arriving: Number | Field = 0.0

    def residual(self, value: Field, actions: Actions) -> Field:
        """Φ at a value; where V equals a constraint, the constraint is the active branch."""
        on, obstacles = self.on, self.obstacles
        rate = discrete.around(on, value, self.lost).at(*actions) + self.arriving - on.decay * value
        outflow = jax.lax.stop_gradient(jump_rates(on, *actions).total() + on.decay)
        # divided like the equation, so that ∂Φ/∂V = −(I − W); the derivative of the divisor would be multiplied by r =
        # 0
        phi = jnp.where(obstacles.fixed, 0, rate) / jnp.where(outflow > 0, outflow, 1)
        for here, constraint in _active_constraints(obstacles, value):
            phi = jnp.where(here, constraint - value, phi)
        return jnp.where(obstacles.fixed, obstacles.fixed_value - value, phi)


def attach(task: Task, answer: Answer) -> Field:
    """The value of ``answer``, unchanged, as a differentiable function of the problem and of the grid in ``task``.

    Args:
      task: the task as the user posed it, with its tracers.
      answer: the solution of the same task.
    """
    question = FixedPoint(task.on, task.obstacles, task.lost)
    kept, value, policy = jax.lax.stop_gradient((task, answer.value, answer.policy))
    return _solution(value, question, policy, kept.equation(value, policy), kept.method.evaluation or Krylov())


def attach_step(
    on: Discretisation, obstacles: Obstacles, arriving: Field, found: tuple[Field, Greedy, PolicyEquation],
    evaluation: Evaluation,
) -> Field:  # fmt: skip
    """The value after an implicit step, unchanged, as a differentiable function of the step's equation.

    Args:
      on: the problem with the discount of the step, with its tracers.
      obstacles: fixed nodes and constraints at the end of the step.
      arriving: the value before the step divided by its length, cost per unit time.
      found: the value after the step, its policy and the policy's linear equation, without derivatives.
      evaluation: the method of policy evaluation.
    """
    value, policy, equation = found
    return _solution(value, FixedPoint(on, obstacles, None, arriving), policy, equation, evaluation)


@jax.custom_jvp
def _solution(
    value: Field, question: FixedPoint, policy: Greedy, equation: PolicyEquation, evaluation: Evaluation
) -> Field:
    """``value``, with the derivative of the solution of ``question``; computed on demand."""
    return value


@_solution.defjvp
@own_settings()
def _solution_tangent(primals: Any, tangents: Any) -> tuple[Field, Field]:
    """The value, and its tangent by one linear solve; transposition gives one transposed solve."""
    value, question, policy, equation, evaluation = primals
    actions, grid = (list(policy.controls), list(policy.disturbances)), question.on.grid
    equation = _tied_to_constraints(equation, question.obstacles, value)

    def residual(question: FixedPoint) -> Field:
        moved = sensitivity.actions(question.on, value, question.lost, *actions)  # follows ends and kinks that move
        return question.residual(value, moved)

    operator: Map
    if question.on.scheme.monotone:
        operator = functools.partial(_chain_product, equation, grid)
        solvers = _chain_solvers(evaluation, equation, grid)
    else:
        slope = jax.linearize(lambda at: question.residual(at, actions), value)[1]
        operator, solvers = lambda delta: -slope(delta), _high_order_solvers(equation, grid)
    right = jax.jvp(residual, (question,), (tangents[1],))[1]
    # a product, so that its transpose is NaN too
    right = right * jnp.where(jnp.any(_rests_unheld(question, actions, value)), jnp.nan, 1).astype(right.dtype)
    # value, policy and operator are constants here; a second derivative would require theirs
    right = right + once(question, "a solve").astype(right.dtype)
    return value, jax.lax.custom_linear_solve(operator, right, *solvers)


def _rests_unheld(question: FixedPoint, actions: Actions, value: Field) -> jax.Array:
    """The free nodes at which the policy rests without discount, so that the value has no derivative.

    Leaving is equally good there, and the search may find either action first.
    """
    on, obstacles = jax.lax.stop_gradient((question.on, question.obstacles))
    rests = (jump_rates(on, *actions).total() + on.decay <= 0) & ~obstacles.fixed
    for here, _ in _active_constraints(obstacles, value):
        rests &= ~here
    return rests


def attach_policy(task: Task, policy: Greedy, value: Field) -> Greedy:
    """The policy, its numbers unchanged, as a differentiable function of ``value`` and of ``task``.

    Args:
      task: the task as the user posed it, with its tracers.
      policy: the policy of the solution of the same task.
      value: the value with derivatives, from ``attach``.
    """
    acting = task.counted & ~task.obstacles.ended
    controls, disturbances = attach_actions(task.on, (policy.controls, policy.disturbances), value, acting, task.lost)
    return Greedy(jax.lax.stop_gradient(policy.defect), controls, disturbances)


def attach_actions(on: Discretisation, pair: Any, value: Field, acting: Mask, lost: Mask | None = None) -> Any:
    """The optimal actions of both players, their numbers unchanged, as differentiable functions of V and of ``on``.

    Args:
      on: the problem on its grid, with its tracers.
      pair: the components of the control and of the disturbance, each (*grid).
      value: V with derivatives.
      acting: the nodes at which an action is taken; the others have no derivative.
      lost: the nodes to which no action may lead.
    """
    return _moving(*jax.lax.stop_gradient((pair, acting, lost)), on, value)


@jax.custom_jvp
def _moving(pair: Any, acting: Mask, lost: Mask | None, on: Discretisation, value: Field) -> Any:
    """``pair``, with the derivative of the optimum of the Hamiltonian; computed on demand."""
    return pair


@_moving.defjvp
@own_settings()
def _moving_tangent(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """The actions, and their tangents at the nodes where an action is taken."""
    pair, acting, lost, on, value = primals

    def actions(on: Discretisation, value: Field) -> Any:
        moved = sensitivity.actions(on, value, lost, *map(list, pair))
        return tuple(
            tuple(jnp.where(acting, jnp.asarray(new, kept.dtype), kept) for kept, new in zip(*each, strict=True))
            for each in zip(pair, moved, strict=True)
        )

    moved = jax.jvp(actions, (on, value), tangents[3:])[1]
    zero = once((on, value), "a feedback")
    return pair, jax.tree.map(lambda entry: entry + zero.astype(entry.dtype), moved)


def _chain_product(equation: PolicyEquation, grid: Grid, delta: Field) -> Field:
    """(I − W) δ, with the weights W of an equation."""
    return -left_over(PolicyEquation(jnp.zeros_like(delta), equation.weights), grid, delta)


def _chain_solvers(evaluation: Evaluation, equation: PolicyEquation, grid: Grid) -> tuple[LinearSolve, LinearSolve]:
    """The solvers for I − W and for its transpose."""
    if grid.sides("open"):  # the transposed row of a parabola does not belong to a chain, so both matrices are factored
        forward, backward = (_exact(equation, grid, transposed) for transposed in (False, True))
        return lambda _, right: forward(right), lambda _, right: backward(right)

    def solver(of: PolicyEquation) -> LinearSolve:
        return lambda _, right: refined(evaluation, dataclasses.replace(of, source=right), grid)

    return solver(equation), solver(PolicyEquation(equation.source, equation.weights.inflow(grid)))


def _exact(equation: PolicyEquation, grid: Grid, transposed: bool) -> Map:
    """The solver for I − W, or for its transpose, by factorisation."""
    return lambda right: direct(PolicyEquation(right, equation.weights), grid, transposed=transposed)


def _high_order_solvers(equation: PolicyEquation, grid: Grid) -> tuple[LinearSolve, LinearSolve]:
    """The solvers for −∂Φ/∂V and its transpose with high-order slopes, preconditioned by the matrix of the chain."""

    def sweeps(weights: Rates) -> Map:
        return lambda left: relaxed(PolicyEquation(left, weights), grid, 1)

    def solver(precondition: Map) -> LinearSolve:
        def correct(matvec: Map, left: Field) -> Field:
            # GMRES with 20 vectors took 2.4 times as long on 100 x 101 nodes of a pendulum, and twice as long to
            # compile
            delta, _ = jax.scipy.sparse.linalg.bicgstab(
                matvec, left, jnp.zeros_like(left), tol=FRACTION, maxiter=KRYLOV, M=precondition
            )
            # if it breaks down, use a sweep, which is always safe
            gains = jnp.max(jnp.abs(left - matvec(delta))) <= jnp.max(jnp.abs(left))
            return jax.lax.cond(gains, lambda: delta, lambda: precondition(left))

        def solve(matvec: Map, right: Field) -> Field:
            stages = [(functools.partial(correct, matvec), jnp.inf)]
            return solve_in_stages(right, lambda delta: right - matvec(delta), stages)

        return solve

    if grid.sides("open"):
        return solver(_exact(equation, grid, False)), solver(_exact(equation, grid, True))
    return solver(sweeps(equation.weights)), solver(sweeps(equation.weights.inflow(grid)))


def _tied_to_constraints(equation: PolicyEquation, obstacles: Obstacles, value: Field) -> PolicyEquation:
    """The linear equation of a policy, with every node whose value equals a constraint assigned to that constraint.

    Where continuing is as good as the constraint, both branches hold. On a plateau without discount only the constraint
    has a derivative, since a policy may cycle there indefinitely.
    """
    active = [here for here, _ in _active_constraints(obstacles, value)]
    free = jnp.ones(value.shape, bool)
    for here in active:
        free &= ~here
    # a row without weights reads δ = s, the derivative of the constraint
    weights = equation.weights.scaled(jnp.where(free, 1, 0))
    interventions = obstacles.interventions
    goes = active[len(active) - len(interventions.offsets) :]
    weights = with_interventions(weights, interventions, [jnp.logical_and(here, ~obstacles.fixed) for here in goes])
    return dataclasses.replace(equation, weights=weights)


def _active_constraints(obstacles: Obstacles, value: Field) -> list[tuple[Mask, Field]]:
    """The bounds on V at the nodes, each with the nodes at which V equals it: at most one bound per node.

    The interventions come last, in their order. Two of them may be equally good, such as a push before and after a
    change of the mode; the row and the right-hand side of the linear system must then belong to the same one.
    """
    given = [each for each in (obstacles.lower, obstacles.upper) if each is not None]
    left = jnp.ones(value.shape, bool)
    found: list[tuple[Mask, Field]] = []
    for constraint in (*given, *obstacles.interventions.after(value)):
        here = left & _is_constraint(value, constraint)
        left, found = left & ~here, [*found, (here, constraint)]
    return found


def _is_constraint(value: Field, constraint: Field) -> jax.Array:
    """The nodes where the value equals the constraint, up to rounding in a repeated evaluation of it."""
    # relative to both sizes, so that ψ = 0 must match exactly and units do not matter
    size = jnp.abs(value) + jnp.abs(constraint)
    near = jnp.abs(value - constraint) <= 64 * jnp.finfo(value.dtype).eps * size
    return jax.lax.stop_gradient(near & jnp.isfinite(constraint))  # an infinite constraint never binds


def refined(evaluation: Evaluation, equation: PolicyEquation, grid: Grid) -> Field:
    """δ by iterative refinement, to a small multiple of rounding; NaN if it does not get there.

    Sweeps converge slowly if the discount is small and the drift rotates; then Krylov takes over.
    """

    def by(method: Evaluation) -> Map:
        return lambda left: evaluate(method, dataclasses.replace(equation, source=left), grid)

    # the last stage runs to the end, however slowly
    stages = [(by(evaluation), SLOW), (by(Krylov()), jnp.inf)] if evaluation.rough else [(by(evaluation), jnp.inf)]
    return solve_in_stages(equation.source, functools.partial(left_over, equation, grid), stages)


def solve_in_stages(right: Field, left_over: Map, stages: Sequence[tuple[Map, Number]]) -> Field:
    """Solve a linear system by corrections of the residual, in stages; NaN if the goal is not reached.

    Args:
      right: the right-hand side, which sets the scale of rounding.
      left_over: maps δ to its residual.
      stages: pairs of a correction from a residual, and the fraction of the residual above which the next stage starts.
    """
    eps, size = jnp.finfo(right.dtype).eps, jnp.max(jnp.abs(right))

    def goal(delta: Field) -> Scalar:
        # the residual is a difference of numbers of the size of δ, which may be far larger than the right-hand side
        return eps * (GOAL * size + ROUNDING * jnp.max(jnp.abs(delta)))

    def stage(correct: Map, delta: Field, slow: Number) -> Field:
        def refine(carry: Refinement) -> Refinement:
            delta, left, _, count = carry
            before = jnp.max(jnp.abs(left))
            delta = delta + correct(left)
            return delta, left_over(delta), before, count + 1

        def unfinished(carry: Refinement) -> jax.Array:
            delta, left, before, count = carry
            size = jnp.max(jnp.abs(left))
            # comparisons with NaN are false, so NaN ends the loop and the result is NaN
            return (size > goal(delta)) & (count < STEPS) & ~(size > slow * before)

        before, none = jnp.full((), jnp.inf, delta.dtype), jnp.zeros((), jnp.int32)
        start = (delta, left_over(delta), before, none)
        return jax.lax.while_loop(unfinished, refine, start)[0]

    delta = jnp.zeros_like(right)
    for correct, slow in stages:
        delta = stage(correct, delta, slow)
    left = jnp.max(jnp.abs(left_over(delta)))
    return jnp.where(left <= goal(delta), delta, jnp.nan)
