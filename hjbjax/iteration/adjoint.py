"""The derivative of a solution with respect to the numbers in the problem and in the grid.

The value V of a converged solve satisfies Φ(V, θ) = 0, node by node the active one of (H(u, d) − β V)/(Q + β),
ψ − V, g − V and given − V. With W the weights of the optimal policy ∂Φ/∂V = −(I − W), so that

    dV = (I − W)⁻¹ ∂Φ/∂θ dθ.

∂Φ/∂θ is taken through the formulas that give the optimal action: where that is stationary they contribute nothing,
and where it sits at a bound or at a kink of the upwinding, both of which may move with θ, they do. Forward mode
takes one linear solve and reverse mode one transposed solve, whatever the number of steps that led to V. A linear solve
that does not come to its end makes the derivative NaN; the value stays as it is. The policy moves with V and θ as the
optimum of the Hamiltonian does, see ``sensitivity``.

With slopes of high order Φ is not linear in V, and its derivative is no chain's: it is taken of the limited slopes as
they stand, at frozen actions, and a Krylov method, preconditioned by sweeps with I − W, solves with it.
"""

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
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation
from hjbjax.iteration.evaluation import Evaluation, Krylov, direct, evaluate, left_over, relaxed
from hjbjax.iteration.fixed_point import Task
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Field, Number, Scalar

Map: TypeAlias = Callable[[Field], Field]  # of node values
LinearSolve: TypeAlias = Callable[[Map, Field], Field]  # of a matrix-free product and the right-hand side
Actions: TypeAlias = tuple[Action, Action]  # of the control and of the disturbance
Refinement: TypeAlias = tuple[Field, Field, Scalar, Scalar]  # δ, its residual, the size of the last one, steps

STEPS = 200  # refinements of the linear solve in each of its two stages, at most
SLOW = 0.5  # a refinement that leaves more than this share of the residual hands over to Krylov's
GOAL = 1e3  # of the rounding unit of the right-hand side
ROUNDING = 64  # of the rounding unit of the solution: below that no residual can be brought
FRACTION = 1e-3  # of the residual, to which one run of the Krylov method goes that solves with slopes of high order
KRYLOV = 200  # its steps, at most


class Answer(Protocol):
    """A value and its policy, found without derivatives."""

    @property
    def value(self) -> Field:
        """V, (*grid)."""

    @property
    def policy(self) -> Greedy:
        """The optimal actions at V."""


@pytree_dataclass()
class FixedPoint:
    """The equation Φ(V, θ) = 0 at the nodes, with all numbers θ in it.

    Args:
      on: the problem on its grid.
      obstacles: fixed nodes and constraints.
      lost: the nodes to which no action may lead, bool (*grid), or None.
      arriving: what comes to the running cost, as V/Δt in an implicit step; cost per unit time.
    """

    on: Discretisation
    obstacles: Obstacles
    lost: jax.Array | None = None
    arriving: Number | Field = 0.0

    def residual(self, value: Field, actions: Actions, bound: jax.Array) -> Field:
        """Φ at a value on frozen branches; ``bound`` says at which nodes a constraint may be the active one."""
        on, obstacles = self.on, self.obstacles
        rate = discrete.around(on, value, self.lost).at(*actions) + self.arriving - on.problem.discount * value
        outflow = jax.lax.stop_gradient(jump_rates(on, *actions).total() + on.problem.discount)
        # divided as the equation is, so that ∂Φ/∂V = −(I − W); a derivative of the divisor would be multiplied by r = 0
        phi = jnp.where(obstacles.fixed, 0, rate) / jnp.where(outflow > 0, outflow, 1)
        for constraint in (obstacles.upper, obstacles.lower):
            if constraint is not None:
                phi = jnp.where(bound & _is_constraint(value, constraint), constraint - value, phi)
        return jnp.where(obstacles.fixed, obstacles.fixed_value - value, phi)


def attach(task: Task, answer: Answer) -> Field:
    """The value of ``answer``, unchanged, as a differentiable function of the problem and of the grid in ``task``.

    Args:
      task: the task as the user gave it, with its tracers.
      answer: the solution of the same task.
    """
    question = FixedPoint(task.on, task.obstacles, task.lost)
    kept, value, policy = jax.lax.stop_gradient((task, answer.value, answer.policy))
    return _solution(value, question, policy, kept.equation(value, policy), kept.method.evaluation or Krylov())


def attach_step(
    on: Discretisation, obstacles: Obstacles, arriving: Field, found: tuple[Field, Greedy, PolicyEquation],
    evaluation: Evaluation,
) -> Field:  # fmt: skip
    """The value after an implicit step, unchanged, as a differentiable function of the question that it answers.

    Args:
      on: the problem with the discount of the step, with its tracers.
      obstacles: fixed nodes and constraints at the end of the step.
      arriving: the value before the step over its length, cost per unit time.
      found: the value after it, its policy and the linear equation of that, without derivatives.
      evaluation: how a policy is evaluated.
    """
    value, policy, equation = found
    return _solution(value, FixedPoint(on, obstacles, None, arriving), policy, equation, evaluation)


@jax.custom_jvp
def _solution(
    value: Field, question: FixedPoint, policy: Greedy, equation: PolicyEquation, evaluation: Evaluation
) -> Field:
    """``value``, with the derivative of the solution of ``question``; formed only where it is asked for."""
    return value


@_solution.defjvp
@own_settings()
def _solution_tangent(primals: Any, tangents: Any) -> tuple[Field, Field]:
    """The value, and its tangent by one linear solve; transposed, by one transposed solve."""
    value, question, policy, equation, evaluation = primals
    actions, grid = (list(policy.controls), list(policy.disturbances)), question.on.grid
    equation = _tied_to_constraints(equation, question.obstacles, value)
    bound = equation.weights.total() == 0  # rows of the constraints hold no weights

    def residual(question: FixedPoint) -> Field:
        moved = sensitivity.actions(question.on, value, question.lost, *actions)  # as at an end or at a kink that moves
        return question.residual(value, moved, bound)

    operator: Map
    if question.on.scheme.monotone:
        operator = functools.partial(_chain_product, equation, grid)
        solvers = _chain_solvers(evaluation, equation, grid)
    else:
        slope = jax.linearize(lambda at: question.residual(at, actions, bound), value)[1]
        operator, solvers = lambda delta: -slope(delta), _high_order_solvers(equation, grid)
    right = jax.jvp(residual, (question,), (tangents[1],))[1]
    # a product, whose transpose is NaN as well
    right = right * jnp.where(jnp.any(_rests_unheld(question, actions, value)), jnp.nan, 1).astype(right.dtype)
    # the value, the policy and the operator are constants here, whose own derivatives a second one would need
    right = right + once(question, "a solve").astype(right.dtype)
    return value, jax.lax.custom_linear_solve(operator, right, *solvers)


def _rests_unheld(question: FixedPoint, actions: Actions, value: Field) -> jax.Array:
    """The nodes at which the policy rests at no discount, although their value is not given: it has no derivative.

    Leaving is worth as much there, and which of the two the search found first is chance.
    """
    on, obstacles = jax.lax.stop_gradient((question.on, question.obstacles))
    rests = (jump_rates(on, *actions).total() + on.problem.discount <= 0) & ~obstacles.fixed
    for constraint in (obstacles.upper, obstacles.lower):
        if constraint is not None:
            rests &= ~_is_constraint(value, constraint)
    return rests


def attach_policy(task: Task, policy: Greedy, value: Field) -> Greedy:
    """The policy, its numbers unchanged, as a differentiable function of ``value`` and of ``task``.

    Args:
      task: the task as the user gave it, with its tracers.
      policy: that of the solution of the same task.
      value: its value with derivatives, of ``attach``.
    """
    frozen, policy = jax.lax.stop_gradient((task, policy))
    return _moving(policy, task.on, value, frozen)


@jax.custom_jvp
def _moving(policy: Greedy, on: Discretisation, value: Field, task: Task) -> Greedy:
    """``policy``, with the derivative of the optimum of the Hamiltonian; formed only where it is asked for."""
    return policy


@_moving.defjvp
@own_settings()
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

    moved = jax.jvp(actions, (on, value), tangents[1:3])[1]
    zero = once((on, value), "a feedback")
    return policy, jax.tree.map(lambda entry: entry + zero.astype(entry.dtype), moved)


def _chain_product(equation: PolicyEquation, grid: Grid, delta: Field) -> Field:
    """(I − W) δ, with W the weights of an equation."""
    return -left_over(PolicyEquation(jnp.zeros_like(delta), equation.weights), grid, delta)


def _chain_solvers(evaluation: Evaluation, equation: PolicyEquation, grid: Grid) -> tuple[LinearSolve, LinearSolve]:
    """The solves of I − W and of its transpose."""
    if grid.sides("open"):  # the transposed row of a parabola belongs to no chain: both matrices are factored
        forward, backward = (_exact(equation, grid, transposed) for transposed in (False, True))
        return lambda _, right: forward(right), lambda _, right: backward(right)

    def solver(weights: Rates) -> LinearSolve:
        return lambda _, right: refined(evaluation, PolicyEquation(right, weights), grid)

    return solver(equation.weights), solver(equation.weights.inflow(grid))


def _exact(equation: PolicyEquation, grid: Grid, transposed: bool) -> Map:
    """The solve of I − W, or of its transpose, by factorisation."""
    return lambda right: direct(PolicyEquation(right, equation.weights), grid, transposed=transposed)


def _high_order_solvers(equation: PolicyEquation, grid: Grid) -> tuple[LinearSolve, LinearSolve]:
    """The solves of −∂Φ/∂V and of its transpose for slopes of high order, preconditioned by the matrix of the chain."""

    def sweeps(weights: Rates) -> Map:
        return lambda left: relaxed(PolicyEquation(left, weights), grid, 1)

    def solver(precondition: Map) -> LinearSolve:
        def correct(matvec: Map, left: Field) -> Field:
            # by GMRES with 20 vectors it took 2.4 times as long on 100 x 101 nodes of a pendulum, and to compile 2
            delta, _ = jax.scipy.sparse.linalg.bicgstab(
                matvec, left, jnp.zeros_like(left), tol=FRACTION, maxiter=KRYLOV, M=precondition
            )
            # it may break down: then a sweep, which always makes sense
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
    """The linear equation of a policy, in which every node whose value is a constraint's belongs to that.

    Where going on is worth as much both branches hold. On a plateau without discount only this one has a derivative:
    a policy may go round on it for ever.
    """
    free = jnp.ones(value.shape, bool)
    for constraint in (obstacles.upper, obstacles.lower):
        if constraint is not None:
            free &= ~_is_constraint(value, constraint)
    # a row without weights reads δ = s, the derivative of the constraint itself
    return PolicyEquation(equation.source, equation.weights.scaled(jnp.where(free, 1, 0)), equation.fastest)


def _is_constraint(value: Field, constraint: Field) -> jax.Array:
    """The nodes where a value was taken from the constraint, which rounds otherwise whenever it is evaluated anew."""
    # by the size of both, so that ψ = 0 is met exactly and nothing has a unit
    size = jnp.abs(value) + jnp.abs(constraint)
    return jax.lax.stop_gradient(jnp.abs(value - constraint) <= 64 * jnp.finfo(value.dtype).eps * size)


def refined(evaluation: Evaluation, equation: PolicyEquation, grid: Grid) -> Field:
    """δ by iterative refinement, to a small multiple of rounding; NaN where that is not reached.

    Sweeps hardly gain where little is discounted and the drift goes round in circles: there Krylov takes over.
    """

    def by(method: Evaluation) -> Map:
        return lambda left: evaluate(method, PolicyEquation(left, equation.weights), grid)

    # to the end, however slowly, with the last of them: nothing follows it
    stages = [(by(evaluation), SLOW), (by(Krylov()), jnp.inf)] if evaluation.rough else [(by(evaluation), jnp.inf)]
    return solve_in_stages(equation.source, functools.partial(left_over, equation, grid), stages)


def solve_in_stages(right: Field, left_over: Map, stages: Sequence[tuple[Map, Number]]) -> Field:
    """The solution of a linear system by corrections of what is left, one kind after the other; NaN if not reached.

    Args:
      right: the right-hand side, which sets the size of rounding.
      left_over: from δ to the residual that it leaves.
      stages: a correction from a residual, and the share of it that may be left before the next kind takes over.
    """
    eps, size = jnp.finfo(right.dtype).eps, jnp.max(jnp.abs(right))

    def goal(delta: Field) -> Scalar:
        # a residual is a difference of numbers of the size of δ, which may be far larger than the right-hand side
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
            # a NaN is no size > …: it ends the loop, and is a NaN below
            return (size > goal(delta)) & (count < STEPS) & ~(size > slow * before)

        before, none = jnp.full((), jnp.inf, delta.dtype), jnp.zeros((), jnp.int32)
        start = (delta, left_over(delta), before, none)
        return jax.lax.while_loop(unfinished, refine, start)[0]

    delta = jnp.zeros_like(right)
    for correct, slow in stages:
        delta = stage(correct, delta, slow)
    left = jnp.max(jnp.abs(left_over(delta)))
    return jnp.where(left <= goal(delta), delta, jnp.nan)
