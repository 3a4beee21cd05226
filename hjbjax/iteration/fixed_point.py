"""Many steps: value iteration and policy iteration as one loop.

Every method repeats the same step. At V the greedy policy leaves a residual; the linear equation of that
policy gives a correction δ; V + δ is the next value. What differs is how well the equation is solved: value
iteration takes its diagonal with the largest rate (monotone, a contraction), modified policy iteration a few
Gauss–Seidel sweeps, policy iteration (Howard; semismooth Newton) solves it. In a game see ``methods``.

The loop stops by the certificate of the value it returns, not by the size of a step; a NaN is never convergence.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.rates import Rates, jump_rates
from hjbjax.hamiltonian.players import players_of
from hjbjax.iteration import bellman, certificates, methods
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation
from hjbjax.iteration.certificates import Certificate, ErrorBound, Iterate
from hjbjax.iteration.evaluation import Evaluation, evaluate
from hjbjax.iteration.methods import Method
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_constrained
from hjbjax.problem.pytree import altered, is_traced, pytree_dataclass
from hjbjax.problem.types import Field, Nodes, Number, Scalar
from hjbjax.solution.status import Status

HISTORY = 256  # steps whose residuals one chunk can record


@pytree_dataclass(static=("certificate", "has_lost", "bare"))
class Task:
    """The constants of a solve: the problem on its grid, the method, and how its error is bounded.

    Args:
      on: the problem on its grid.
      method: how the correction is made.
      obstacles: fixed nodes and constraints.
      counted: bool (*grid), nodes that have a finite value.
      least_cost: the least running cost at each node, for the multiplicative certificate; else None.
      outflow: max Q + β at each node, for value iteration and for open ends; else None.
      tol: certified error to reach, cost units.
      certificate: which bound on the error applies.
      crossing: the time that it takes to cross the box at the largest speeds, where that was asked for; else None.
      has_lost: true if nodes that do not count may lie beside others, so that no action may lead there.
      bare: true if nothing but V is kept; then ``obstacles`` hold nothing and are made anew in every step.
      first_order: a truth value, which may be traced: with a scheme of high order its chain is solved, so that one
        program serves both; None: always the scheme itself. Without noise only.
      floor: a bound that no value can be less than, cost units, for a scheme of high order; None where there is none.
      shift: what is added to the discount in a correction by slopes of high order, per unit time; None: nothing.
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

    @property
    def problem(self) -> Problem:
        """The question."""
        return self.on.problem

    @property
    def grid(self) -> Grid:
        """The nodes."""
        return self.on.grid

    @property
    def scheme(self) -> Scheme:
        """The scheme of the derivatives."""
        return self.on.scheme

    def asking(self, problem: Problem) -> "Task":
        """The task of another problem, all else as it is."""
        return dataclasses.replace(self, on=self.on.asking(problem))

    @property
    def is_chain(self) -> Any:
        """True if the chain is solved, to which the certificate belongs; traced where one program serves both."""
        return self.scheme.monotone if self.first_order is None else self.first_order

    @property
    def of_chain(self) -> "Task":
        """The task of the chain, in a program of its own."""
        return dataclasses.replace(self, on=self.on.chain, first_order=None)

    @property
    def lost(self) -> jax.Array | None:
        """The nodes to which no action may lead, bool (*grid), or None."""
        return ~self.counted if self.has_lost else None

    @property
    def counting(self) -> jax.Array | bool:
        """The nodes whose value is judged; a known truth where all are, which costs no pass over them."""
        return self.counted if self.has_lost else True

    @property
    def given(self) -> Obstacles:
        """Target and constraints at the nodes, made where they are used if nothing but V is kept."""
        return bellman.obstacles(self.on) if self.bare else self.obstacles

    @property
    def by_defect(self) -> bool:
        """True if neither a step nor its bound needs the actions, so that they are found once, at the last value."""
        additive = self.certificate is Certificate.ADDITIVE and self.first_order is None
        if not (self.method.by_defect and additive) or self.bare:
            return False
        players = players_of(self.on)
        at_ends = players.control.fastest_at_ends and players.disturbance.fastest_at_ends
        return at_ends and players.exact and self.scheme.monotone

    @property
    def constrained(self) -> bool:
        """True if the problem has a stopping cost or a running maximum."""
        return is_constrained(self.problem)

    def impose(self, value: Field) -> Field:
        """``value`` with the given values put in, and with nodes that are lost far above all others."""
        value = self.given.impose(value)
        if not self.has_lost:
            return value
        # 1/√eps above: no minimum chooses it, and a difference with it still has half of its digits
        largest = self.grid.largest(jnp.where(self.counted, jnp.abs(value), 0))
        return jnp.where(self.counted, value, largest / jnp.sqrt(jnp.finfo(value.dtype).eps))

    def equation(self, value: Field, policy: Greedy, fastest: Scalar | None = None) -> PolicyEquation:
        """The linear equation of a policy; ``fastest``, its largest Q + β, spares a pass where it is known."""
        if self.certificate is Certificate.ADDITIVE:  # no rate is only rounding: there is a discount
            fastest = jnp.zeros((), value.dtype)
        return bellman.policy_equation(self.on, value, policy, self.obstacles, fastest=fastest)

    def reply(self, value: Field, policy: Greedy) -> Greedy:
        """The inner player's best answer to the outer player's policy."""
        return bellman.respond(
            self.on, value, self.obstacles.fixed, policy, lost=self.lost, first_order=self.first_order
        )

    def residual(self, equation: PolicyEquation) -> Scalar:
        """The largest |source| at the nodes that count, in cost units."""
        return self.grid.largest(jnp.where(self.counting, jnp.abs(equation.source), 0))

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
    """State of a solve: a value, its greedy policy, its certificate, and the loop's book-keeping."""

    value: Field
    policy: Greedy
    fastest: Scalar  # the policy's largest Q + β; zero where every rate counts, infinite before the look at a guess
    bound: ErrorBound
    step: Scalar
    best: jax.Array  # the least error and the least residual so far, (2,): either one is progress
    moves: certificates.Moves  # the sizes of the last steps
    since_best: Scalar
    code: Scalar
    history: jax.Array  # residuals of this chunk, (HISTORY,), −1 where there was no step


def begin(task: Task, guess: Nodes) -> State:
    """The state before the first look at a guess; step −1 of ``run`` is that look, so that all is one program.

    The guess is copied, since states are donated; that of parts by ``spread``. At host level nothing is compiled.
    """
    traced, dtype = is_traced(task, guess), guess.dtype
    xp: Any = jnp if traced else np
    copied: Any = jnp.array if traced else functools.partial(jax.device_put, may_alias=False)
    value: Any = copied(guess) if task.on.parts is None else guess
    shape = () if task.bare else task.grid.shape  # of the policy
    players = (None if task.bare else admissible for admissible in (task.problem.controls, task.problem.disturbances))
    inputs = [0 if admissible is None else admissible.dim for admissible in players]
    policy = Greedy(xp.zeros(shape, dtype), *(tuple(xp.zeros(shape, dtype) for _ in range(m)) for m in inputs))
    infinite, code = xp.asarray(xp.inf, dtype), xp.asarray(int(Status.RUNNING), xp.int32)
    bound = ErrorBound(xp.asarray(-infinite), infinite, xp.zeros((), dtype), infinite, infinite)
    counter, first = xp.zeros((), xp.int32), xp.full((), -1, xp.int32)
    history, best = xp.full(HISTORY, -1, dtype), xp.stack([infinite] * 2)  # no NaN, a fault to jax_debug_nans
    moves = certificates.Moves(xp.stack([infinite] * 2), infinite, xp.ones((), dtype), counter)
    return State(value, policy, infinite, bound, first, best, moves, counter, code, history)


def run(task: Task, state: State, until: Number) -> State:
    """Steps until the state is no longer running or ``until`` steps are done; at most ``HISTORY`` at a time."""
    start = state.step  # the first place of this chunk's history

    def step(state):
        # loop variant, or XLA compiles a kernel for every scalar of every action that it can hoist
        controls, grid, count = jax.lax.optimization_barrier((task.problem.controls, task.grid, state.step))
        on = dataclasses.replace(task.on, problem=altered(task.problem, controls=controls), grid=grid)
        return advance(dataclasses.replace(task, on=on), dataclasses.replace(state, step=count), start)

    state = jax.lax.while_loop(lambda at: (at.code == Status.RUNNING) & (at.step < until), step, state)
    if not task.by_defect:
        return state
    return dataclasses.replace(state, policy=bellman.greedy(task.on, state.value, task.obstacles.fixed))


def advance(task: Task, state: State, start: Scalar) -> State:
    """One step; a step that ends in numbers that are not finite is taken back."""
    if task.bare:
        return _relaxed(task, state, start)
    if task.by_defect:
        return _relaxed_by_defect(task, state, start)
    delta = _correction(task, state)
    if not task.scheme.monotone:
        delta = state.moves.share * delta
    value = task.impose(state.value + delta)
    # a node that does not count may move for ever
    change = jnp.where(task.counting, value - state.value, 0)
    moved = task.grid.largest(jnp.abs(change))
    if task.certificate is Certificate.OPEN and not task.method.relaxes:
        moved = moved * methods.shift_factor(_shift(task, state), task.problem.discount)
    moves, distance = state.moves, moved
    if not task.scheme.monotone:
        distance = jnp.where(task.is_chain, moved, certificates.distance(task, moves, moved, value))
    policy, fastest, bound = _look(task, value, state.policy, moved=distance, first=state.step < 0)
    if not task.scheme.monotone:
        moves = certificates.moves_after(state, moved, certificates.turns_back(task.grid, change, policy.defect))
    bound = dataclasses.replace(bound, error=jnp.where(_lacks_measure(task, state), jnp.inf, bound.error))
    since = certificates.steps_since_best(state, bound)
    code = certificates.at_rest(task, state, moved, certificates.judged(task, value, bound, state.best, since))
    found = {"value": value, "policy": policy, "fastest": fastest, "moves": moves}
    return certificates.booked(state, start, bound, code, since, **found)


def _relaxed(task: Task, state: State, start: Scalar) -> State:
    """One relaxation of every node, of which nothing is kept beside V, with the bound on the value before it."""
    value = task.impose(state.value)  # a guess need not respect what is given
    step, bound = certificates.of_relaxation(task.certificate, task.on, value)
    since = certificates.steps_since_best(state, bound)
    # of the next value it would want an array of its own
    code = certificates.judged(task, state.value, bound, state.best, since)
    after = jnp.where(state.step < 0, value, task.impose(value + step))
    code = certificates.at_rest(task, state, task.grid.largest(jnp.abs(after - state.value)), code)
    return certificates.booked(state, start, bound, code, since, value=after)


def _relaxed_by_defect(task: Task, state: State, start: Scalar) -> State:
    """One relaxation of every node by the defect before it, with the bound on the value after it; no action is kept."""
    assert task.outflow is not None
    value = task.impose(state.value + _correction(task, state))
    defect = jnp.where(task.obstacles.fixed, 0, bellman.relaxation(task.on, value, task.outflow)[0])
    policy = dataclasses.replace(state.policy, defect=defect)
    left = PolicyEquation(task.obstacles.clipped(defect / task.outflow, value), Rates((), ()))
    iterate = Iterate(task.grid, value, policy, left, task.obstacles, task.counting)
    bound = certificates.error_bound(task.certificate, iterate, discount=task.problem.discount)
    since = certificates.steps_since_best(state, bound)
    code = certificates.judged(task, value, bound, state.best, since)
    after = certificates.booked(state, start, bound, code, since, value=value)
    return dataclasses.replace(after, policy=policy)  # of a step that is taken back, too: ``run`` makes it anew


def broken(task: Task, state: State) -> jax.Array:
    """The nodes where value or rate are not finite in the step that a NONFINITE state took back, bool (*grid)."""
    if task.bare:
        return ~jnp.isfinite(bellman.relaxation(task.on, task.impose(state.value))[0])
    state = dataclasses.replace(state, step=state.step - 1)
    value = task.impose(state.value + _correction(task, state))
    rate = bellman.greedy(task.on, value, task.obstacles.fixed, lost=task.lost, first_order=task.first_order).defect
    return task.counted & ~(jnp.isfinite(value) & jnp.isfinite(rate))


def _lacks_measure(task: Task, state: State) -> jax.Array:
    """True before the first step where the error is measured by the size of a step, without a certificate."""
    certified = task.certificate in (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE)
    return (state.step < 0) & ~(certified & jnp.asarray(task.is_chain))


def _shift(task: Task, state: State) -> Scalar:
    """κ of the next correction, per unit time, at open ends."""
    assert task.outflow is not None
    return methods.shift(task.grid.largest(task.outflow), state.step)


def _look(
    task: Task, value: Field, incumbent: Greedy, *, moved: Scalar, first: jax.Array
) -> tuple[Greedy, Scalar, ErrorBound]:
    """The greedy policy at a value, its largest Q + β, and the bound on the value's error."""
    problem = task.problem
    policy = bellman.greedy(
        task.on, value, task.obstacles.fixed, incumbent=incumbent, lost=task.lost, first_order=task.first_order
    )
    if problem.stopping_cost is not None and not problem.is_game and task.certificate in certificates.TO_THE_END:
        fixed = task.obstacles.fixed | first  # nobody has chosen the actions before the first look
        policy = bellman.improvement(task.on, value, fixed, policy, incumbent)
    left = task.equation(value, policy)
    assert left.fastest is not None
    iterate = Iterate(task.grid, value, policy, left, task.obstacles, task.counting)
    known = {"discount": problem.discount, "least_cost": task.least_cost, "moved": moved}
    bound = certificates.error_bound(task.certificate, iterate, **known)
    if task.first_order is not None:  # the chain's certificate is no other scheme's
        measured = certificates.measured(bound.residual, moved)
        bound = jax.tree.map(functools.partial(jnp.where, task.first_order), bound, measured)
    if task.has_lost:
        leaks = bellman.leaks(task.on, policy, task.obstacles.fixed, ~task.counted)
        bound = dataclasses.replace(bound, error=jnp.where(leaks, jnp.inf, bound.error))
    return policy, left.fastest, bound


@dataclasses.dataclass(frozen=True)
class Look:
    """A solve at one of its values, as a method sees it."""

    task: Task
    state: State

    @property
    def grid(self) -> Grid:
        """The nodes."""
        return self.task.grid

    def equation(self) -> PolicyEquation:
        """The linear equation of the greedy policy, whose rates are known."""
        return self.task.equation(self.state.value, self.state.policy, self.state.fastest)

    def relaxed(self) -> Field:
        """r/(Q + β) of the fastest action, which the policy shows where it is not known beforehand."""
        task, policy, players = self.task, self.state.policy, players_of(self.task.on)
        assert task.outflow is not None
        if players.control.fastest_at_ends and players.disturbance.fastest_at_ends:
            return policy.defect / task.outflow
        chosen = jump_rates(task.on, list(policy.controls), list(policy.disturbances)).total()
        return policy.defect / jnp.maximum(task.outflow, chosen + task.problem.discount)

    def evaluated(self, evaluation: Evaluation, replies: int) -> Field:
        """The correction of policy iteration: by the linear equation of the policy, in a game by the inner problem."""
        task, state = self.task, self.state
        if task.certificate is Certificate.OPEN:  # in a game, too: steps in time improve both players at once
            later = altered(task.problem, discount=task.problem.discount + _shift(task, state))
            return evaluate(evaluation, task.asking(later).equation(state.value, state.policy), task.grid)
        if task.problem.is_game:
            outer, goal = (state.value, state.policy), methods.inner_goal(state.bound.residual, state.best[1])
            return methods.evaluated(task, *outer, evaluation, goal=goal, replies=replies) - state.value
        if task.shift is not None:  # a step in time of length 1/κ: see ``solvers.order.sharpened``
            later = altered(task.problem, discount=task.problem.discount + task.shift)
            return evaluate(
                evaluation, task.asking(later).equation(state.value, state.policy, state.fastest), task.grid
            )
        return evaluate(evaluation, self.equation(), task.grid)


def _correction(task: Task, state: State) -> Field:
    """δ of the method, cost units, (*grid); zero in step −1, which only looks at the guess."""
    stay = jnp.zeros_like(state.value)
    if task.method.relaxes:  # one pass, where a choice of programs would be two
        return jnp.where(state.step < 0, stay, _by_method(task, state))
    return jax.lax.cond(state.step < 0, lambda: stay, lambda: _by_method(task, state))


def _by_method(task: Task, state: State) -> Field:
    """δ of the method in any other step."""
    look = Look(task, state)
    if task.method.relaxes or task.outflow is None or task.certificate is Certificate.OPEN:
        return task.method.correct(look)
    return jax.lax.cond(  # a tube whose discount is traced: without one its policies have no value of their own
        jnp.asarray(task.problem.discount > 0), lambda: task.method.correct(look), look.relaxed
    )
