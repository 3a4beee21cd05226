"""Value iteration and policy iteration as one loop.

Every method repeats the same step. At V the greedy policy leaves a residual; the linear equation of that policy gives a
correction δ; V + δ is the next value. The methods differ in how accurately they solve the equation: value iteration
uses its diagonal with the largest rate (monotone, a contraction), modified policy iteration a few Gauss–Seidel sweeps,
policy iteration (Howard; semismooth Newton) a linear solve. For games see ``methods``.

The loop stops by the certificate of the value it returns, not by the size of a step; NaN is never convergence.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.rates import Rates, jump_rates
from hjbjax.iteration import bellman, certificates, methods
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation
from hjbjax.iteration.certificates import Certificate, ErrorBound, Iterate
from hjbjax.iteration.evaluation import Evaluation, evaluate
from hjbjax.iteration.grid_task import GridTask
from hjbjax.iteration.methods import Method
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_constrained
from hjbjax.problem.pytree import altered, is_traced, pytree_dataclass
from hjbjax.problem.types import Field, Nodes, Number, Scalar
from hjbjax.solution.status import Status

HISTORY = 256  # largest number of steps per chunk, whose residuals are recorded


@pytree_dataclass(static=("certificate", "has_lost", "bare", "mesh"))
class Task(GridTask):
    """The constants of a solve: the problem on its grid, the method, and the error bound.

    Args:
      on: the problem on its grid.
      method: the method that computes the correction.
      obstacles: fixed nodes and constraints.
      counted: bool (*grid), the nodes with a finite value.
      least_cost: the least running cost at each node, for the multiplicative certificate; else None.
      outflow: max Q + β at each node, for value iteration and for open ends; else None.
      tol: certified error to reach, cost units.
      certificate: the applicable error bound.
      crossing: the time to cross the box at the largest speeds, if it was computed; else None.
      has_lost: True if nodes that do not count may be next to others, so that no action may lead there.
      bare: True if only V is stored; then ``obstacles`` is empty and recomputed in every step.
      first_order: a truth value, which may be traced: solve the chain of a high-order scheme, so that one program
        serves both; None: always the scheme itself. Only without noise.
      floor: a lower bound on all values, cost units, for a high-order scheme; None if there is none.
      shift: an addition to the discount in high-order corrections, per unit time; None: nothing.
      mesh: the devices over which the nodes are divided during the iteration; None: one device.
    """

    on: Discretisation
    method: Method
    obstacles: Obstacles
    counted: jax.Array
    least_cost: jax.Array | None
    outflow: jax.Array | None
    tol: Scalar
    certificate: Certificate
    crossing: Any = None
    has_lost: bool = False
    bare: bool = False
    first_order: Any = None
    floor: Any = None
    shift: Any = None
    mesh: Mesh | None = None

    @property
    def scheme(self) -> Scheme:
        """The scheme for the derivatives."""
        return self.on.scheme

    def asking(self, problem: Problem) -> "Task":
        """The task with another problem."""
        return dataclasses.replace(self, on=self.on.asking(problem))

    @property
    def is_chain(self) -> Any:
        """True if the chain, which has the certificate, is solved; traced if one program serves both."""
        return self.scheme.monotone if self.first_order is None else self.first_order

    @property
    def of_chain(self) -> "Task":
        """The task of the chain, for a separate program."""
        return dataclasses.replace(self, on=self.on.chain, first_order=None)

    @property
    def lost(self) -> jax.Array | None:
        """The nodes to which no action may lead, bool (*grid), or None."""
        return ~self.counted if self.has_lost else None

    @property
    def counting(self) -> jax.Array | bool:
        """The nodes whose value counts; the constant True if all do, which saves a pass over them."""
        return self.counted if self.has_lost else True

    @property
    def given(self) -> Obstacles:
        """Target and constraints at the nodes, recomputed on use if only V is stored."""
        return bellman.obstacles(self.on) if self.bare else self.obstacles

    @property
    def by_defect(self) -> bool:
        """True if neither a step nor its bound requires the actions, so that they are computed once, at the end."""
        additive = self.certificate is Certificate.ADDITIVE and self.first_order is None
        if not (self.method.by_defect and additive) or self.bare:
            return False
        players = self.on.players
        at_ends = players.control.fastest_at_ends and players.disturbance.fastest_at_ends
        return at_ends and players.exact and self.scheme.monotone

    @property
    def constrained(self) -> bool:
        """True if the problem has a stopping cost or a running maximum."""
        return is_constrained(self.problem)

    def impose(self, value: Field) -> Field:
        """``value`` with fixed values inserted, and with unreachable nodes far above all others."""
        value = self.given.impose(value)
        if not self.has_lost:
            return value
        # 1/√eps above: no minimum selects it, and a difference with it still has half of its digits
        largest = self.layout.largest(jnp.where(self.counted, jnp.abs(value), 0))
        return jnp.where(self.counted, value, largest / jnp.sqrt(jnp.finfo(value.dtype).eps))

    def equation(self, value: Field, policy: Greedy, fastest: Scalar | None = None) -> PolicyEquation:
        """The linear equation of a policy; ``fastest``, its largest Q + β, saves a pass if known."""
        if self.certificate is Certificate.ADDITIVE:  # with a discount no rate counts as rounding
            fastest = jnp.zeros((), value.dtype)
        return bellman.policy_equation(self.on, value, policy, self.obstacles, fastest=fastest)

    def reply(self, value: Field, policy: Greedy) -> Greedy:
        """The inner player's best response to the outer player's policy."""
        return bellman.respond(
            self.on, value, self.obstacles.fixed, policy, lost=self.lost, first_order=self.first_order
        )

    def residual(self, equation: PolicyEquation) -> Scalar:
        """The largest |source| at the counted nodes, in cost units."""
        return self.layout.largest(jnp.where(self.counting, jnp.abs(equation.source), 0))

    def start(self) -> Field:
        """The value without a guess: zero, or without discount ψ, above all fixed points, or g, below them."""
        zero = jnp.zeros(self.grid.shape, self.tol.dtype)
        if not self.constrained or self.certificate is Certificate.ADDITIVE:
            return zero
        limits = [limit for limit in (self.given.lower, self.given.upper) if limit is not None]
        start = functools.reduce(jnp.maximum, limits)
        return jnp.asarray(jnp.broadcast_to(start, self.grid.shape), self.tol.dtype)


@pytree_dataclass()
class State:
    """State of a solve: a value, its greedy policy, its certificate, and the bookkeeping of the loop."""

    value: Field
    policy: Greedy
    fastest: Scalar  # the policy's largest Q + β; zero if every rate counts, infinite before the initial evaluation
    bound: ErrorBound
    step: Scalar
    best: jax.Array  # the least error and the least residual so far, (2,)
    moves: certificates.Moves  # the sizes of the last steps
    since_best: Scalar
    code: Scalar
    history: jax.Array  # residuals of this chunk, (HISTORY,), −1 for unused entries


def begin(task: Task, guess: Nodes) -> State:
    """The state before the evaluation of a guess; this is step −1 of ``run``, so that all steps are one program.

    The guess is copied, since states are donated; ``spread`` copies it on several devices. Nothing is compiled here.
    """
    traced, dtype = is_traced(task, guess), guess.dtype
    xp: Any = jnp if traced else np
    copied: Any = jnp.array if traced else functools.partial(jax.device_put, may_alias=False)
    value: Any = copied(guess) if not task.division.axes else guess
    shape = () if task.bare else task.grid.shape  # of the policy
    players = (None if task.bare else admissible for admissible in (task.problem.controls, task.problem.disturbances))
    inputs = [0 if admissible is None else admissible.dim for admissible in players]
    policy = Greedy(xp.zeros(shape, dtype), *(tuple(xp.zeros(shape, dtype) for _ in range(m)) for m in inputs))
    infinite, code = xp.asarray(xp.inf, dtype), xp.asarray(int(Status.RUNNING), xp.int32)
    bound = ErrorBound(xp.asarray(-infinite), infinite, xp.zeros((), dtype), infinite, infinite)
    counter, first = xp.zeros((), xp.int32), xp.full((), -1, xp.int32)
    history, best = xp.full(HISTORY, -1, dtype), xp.stack([infinite] * 2)  # not NaN, which jax_debug_nans would report
    moves = certificates.Moves(xp.stack([infinite] * 2), infinite, xp.ones((), dtype), counter)
    return State(value, policy, infinite, bound, first, best, moves, counter, code, history)


def run(task: Task, state: State, until: Number) -> State:
    """Step until the state is no longer running or ``until`` steps are done; at most ``HISTORY`` at a time."""
    start = state.step  # the first index of this chunk's history

    def step(state: State) -> State:
        # made loop-variant, otherwise XLA compiles a kernel for every scalar of every action that it can hoist
        controls, grid, count = jax.lax.optimization_barrier((task.problem.controls, task.grid, state.step))
        on = altered(task.on, problem=altered(task.problem, controls=controls), grid=grid)
        return _advance(dataclasses.replace(task, on=on), dataclasses.replace(state, step=count), start)

    state = jax.lax.while_loop(lambda at: (at.code == Status.RUNNING) & (at.step < until), step, state)
    if not task.by_defect:
        return state
    return dataclasses.replace(state, policy=bellman.greedy(task.on, state.value, task.obstacles.fixed))


def _advance(task: Task, state: State, start: Scalar) -> State:
    """One step; it is undone if its numbers are not finite."""
    if task.bare:
        return _relaxed(task, state, start)
    if task.by_defect:
        return _relaxed_by_defect(task, state, start)
    delta = _correction(task, state)
    if not task.scheme.monotone:
        delta = state.moves.share * delta
    value = task.impose(state.value + delta)
    # a node that does not count may change indefinitely
    change = jnp.where(task.counting, value - state.value, 0)
    moved = task.layout.largest(jnp.abs(change))
    if task.certificate is Certificate.OPEN and not task.method.relaxes:
        moved = moved * methods.shift_factor(_shift(task, state), task.problem.discount)
    moves, distance = state.moves, moved
    if not task.scheme.monotone:
        distance = jnp.where(task.is_chain, moved, certificates.distance(task, moves, moved, value))
    policy, fastest, bound = _look(task, value, state.policy, moved=distance, first=state.step < 0)
    if not task.scheme.monotone:
        moves = certificates.moves_after(state, moved, certificates.turns_back(task.layout, change, policy.defect))
    bound = dataclasses.replace(bound, error=jnp.where(_lacks_measure(task, state), jnp.inf, bound.error))
    since = certificates.steps_since_best(state, bound)
    code = certificates.tube_status(task, state, moved, certificates.judged(task, value, bound, state.best, since))
    found = {"value": value, "policy": policy, "fastest": fastest, "moves": moves}
    return certificates.booked(state, start, bound, code, since, **found)


def _relaxed(task: Task, state: State, start: Scalar) -> State:
    """One relaxation of every node, storing only V, with the bound on the value before it."""
    value = task.impose(state.value)  # a guess need not have the fixed values
    step, bound = certificates.of_relaxation(task.certificate, task.on, value)
    since = certificates.steps_since_best(state, bound)
    # the bound on the next value would require an array of its own
    code = certificates.judged(task, state.value, bound, state.best, since)
    after = jnp.where(state.step < 0, value, task.impose(value + step))
    code = certificates.tube_status(task, state, task.layout.largest(jnp.abs(after - state.value)), code)
    return certificates.booked(state, start, bound, code, since, value=after)


def _relaxed_by_defect(task: Task, state: State, start: Scalar) -> State:
    """One relaxation of every node by the previous defect, with the bound on the new value; stores no actions."""
    assert task.outflow is not None
    value = task.impose(state.value + _correction(task, state))
    defect = jnp.where(task.obstacles.fixed, 0, bellman.relaxation(task.on, value, task.outflow)[0])
    policy = dataclasses.replace(state.policy, defect=defect)
    left = PolicyEquation(task.obstacles.clipped(defect / task.outflow, value), Rates((), ()))
    iterate = Iterate(task.layout, value, policy, left, task.obstacles, task.counting)
    bound = certificates.error_bound(task.certificate, iterate, discount=task.problem.discount)
    since = certificates.steps_since_best(state, bound)
    code = certificates.judged(task, value, bound, state.best, since)
    after = certificates.booked(state, start, bound, code, since, value=value)
    return dataclasses.replace(after, policy=policy)  # also for a step that is undone, since ``run`` recomputes it


def nonfinite_nodes(task: Task, state: State) -> jax.Array:
    """The nodes where value or defect are not finite in the step that a NONFINITE state undid, bool (*grid)."""
    if task.bare:
        return ~jnp.isfinite(bellman.relaxation(task.on, task.impose(state.value))[0])
    state = dataclasses.replace(state, step=state.step - 1)
    value = task.impose(state.value + _correction(task, state))
    rate = bellman.greedy(task.on, value, task.obstacles.fixed, lost=task.lost, first_order=task.first_order).defect
    return task.counted & ~(jnp.isfinite(value) & jnp.isfinite(rate))


def _lacks_measure(task: Task, state: State) -> jax.Array:
    """True before the first step if the error is measured by the size of a step, without a certificate."""
    certified = task.certificate in (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE)
    return (state.step < 0) & ~(certified & jnp.asarray(task.is_chain))


def _shift(task: Task, state: State) -> Scalar:
    """κ of the next correction, per unit time, with open ends."""
    assert task.outflow is not None
    return methods.shift(task.layout.largest(task.outflow), state.step)


def _look(
    task: Task, value: Field, incumbent: Greedy, *, moved: Scalar, first: jax.Array
) -> tuple[Greedy, Scalar, ErrorBound]:
    """The greedy policy at a value, its largest Q + β, and the bound on the value's error."""
    problem = task.problem
    policy = bellman.greedy(
        task.on, value, task.obstacles.fixed, incumbent=incumbent, lost=task.lost, first_order=task.first_order
    )
    if problem.stopping_cost is not None and not problem.is_game and task.certificate in certificates.TO_THE_END:
        fixed = task.obstacles.fixed | first  # before the initial evaluation there are no actions to keep
        policy = bellman.improvement(task.on, value, fixed, policy, incumbent)
    left = task.equation(value, policy)
    assert left.fastest is not None
    iterate = Iterate(task.layout, value, policy, left, task.obstacles, task.counting)
    known = {"discount": problem.discount, "least_cost": task.least_cost, "moved": moved}
    bound = certificates.error_bound(task.certificate, iterate, **known)
    if task.first_order is not None:  # the chain's certificate does not apply to another scheme
        measured = certificates.measured(bound.residual, moved)
        bound = jax.tree.map(functools.partial(jnp.where, task.first_order), bound, measured)
    if task.has_lost:
        leaks = bellman.leaks(task.on, policy, task.obstacles.fixed, ~task.counted)
        bound = dataclasses.replace(bound, error=jnp.where(leaks, jnp.inf, bound.error))
    return policy, left.fastest, bound


@dataclasses.dataclass(frozen=True)
class _Look:
    """The view of a solve at one of its values that is passed to a method."""

    task: Task
    state: State

    @property
    def grid(self) -> Grid:
        """The grid."""
        return self.task.grid

    def equation(self) -> PolicyEquation:
        """The linear equation of the greedy policy, whose rates are known."""
        return self.task.equation(self.state.value, self.state.policy, self.state.fastest)

    def relaxed(self) -> Field:
        """r/(Q + β) for the fastest action; without ``outflow`` the policy's own rate is used."""
        task, policy, players = self.task, self.state.policy, self.task.on.players
        assert task.outflow is not None
        if players.control.fastest_at_ends and players.disturbance.fastest_at_ends:
            return policy.defect / task.outflow
        chosen = jump_rates(task.on, list(policy.controls), list(policy.disturbances)).total()
        return policy.defect / jnp.maximum(task.outflow, chosen + task.problem.discount)

    def evaluated(self, evaluation: Evaluation, replies: int) -> Field:
        """The correction of policy iteration: solves the policy's linear equation, in a game the inner problem."""
        task, state = self.task, self.state
        if task.certificate is Certificate.OPEN:  # also in a game: steps in time improve both players at once
            later = altered(task.problem, discount=task.problem.discount + _shift(task, state))
            return evaluate(evaluation, task.asking(later).equation(state.value, state.policy), task.grid)
        if task.problem.is_game:
            outer, goal = (state.value, state.policy), methods.inner_goal(state.bound.residual, state.best[1])
            return methods.evaluated(task, *outer, evaluation, goal=goal, replies=replies) - state.value
        if task.shift is not None:  # a time step of length 1/κ: see ``solvers.order.sharpened``
            later = altered(task.problem, discount=task.problem.discount + task.shift)
            return evaluate(
                evaluation, task.asking(later).equation(state.value, state.policy, state.fastest), task.grid
            )
        return evaluate(evaluation, self.equation(), task.grid)


def _correction(task: Task, state: State) -> Field:
    """The correction δ of the method, cost units, (*grid); zero in step −1, which only evaluates the guess."""
    stay = jnp.zeros_like(state.value)
    if task.method.relaxes:  # one pass, while a cond would take two
        return jnp.where(state.step < 0, stay, _by_method(task, state))
    return jax.lax.cond(state.step < 0, lambda: stay, lambda: _by_method(task, state))


def _by_method(task: Task, state: State) -> Field:
    """The correction δ of the method in any step after −1."""
    look = _Look(task, state)
    if task.method.relaxes or task.outflow is None or task.certificate is Certificate.OPEN:
        return task.method.correct(look)
    return jax.lax.cond(  # with a traced discount: without a discount the policies of a tube have no value
        jnp.asarray(task.problem.discount > 0), lambda: task.method.correct(look), look.relaxed
    )
