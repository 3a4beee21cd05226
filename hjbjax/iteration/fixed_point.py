"""Value iteration and policy iteration as one loop.

Every method repeats the same step. At V the greedy policy leaves a residual. The linear equation of that policy gives a
correction δ, and V + δ is the next value. The methods differ in how accurately they solve the equation. Value iteration
divides by the largest diagonal over the actions (monotone, a contraction), modified policy iteration uses a few
Gauss–Seidel sweeps, and policy iteration (Howard; semismooth Newton) uses a linear solve. For games see ``methods``.

The loop stops by the certificate of the value that it returns, not by the size of a step. NaN never converges.

A pass of the loop corrects the last evaluated value and evaluates the result: its policy, its bound and the status. The
first pass evaluates the guess, without a correction. All passes are one program, since a program that only evaluates
takes 0.7 s to compile.
"""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.rates import Rates, jump_rates
from hjbjax.iteration import bellman, certificates, damping, methods, progress
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation
from hjbjax.iteration.certificates import TO_THE_END, Certificate, ErrorBound, Iterate
from hjbjax.iteration.damping import Moves
from hjbjax.iteration.evaluation import Evaluation, evaluate
from hjbjax.iteration.grid_task import GridTask
from hjbjax.iteration.methods import Method
from hjbjax.iteration.progress import Progress, keep_finite
from hjbjax.problem.grid import Grid, undivided
from hjbjax.problem.problem import Problem, is_constrained
from hjbjax.problem.pytree import altered, is_traced, pytree_dataclass
from hjbjax.problem.types import Field, Nodes, Number, Scalar
from hjbjax.solution.status import Status

FEW = 4  # replaces ``progress.ROUNDING`` if a solve stores only V, because its steps are small at slow nodes


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
      crossing: the time to cross the box at the largest speeds; None if it was not computed.
      has_lost: True if nodes that do not count may be next to nodes that count; no action may then lead to them.
      bare: True if only V is stored; then ``obstacles`` is empty and recomputed in every step.
      first_order: true to solve the chain of a high-order scheme instead of the scheme. It may be traced, so that one
        program solves both. None: always the scheme itself. Only without noise.
      floor: a lower bound on all values, cost units, for a high-order scheme; None if there is none.
      shift: an addition to the discount in high-order corrections, per unit time; None for zero.
      weights: the weights of the largest and of the mean change in the norm of high-order steps and residuals, (2,),
        each ``tol`` over the tolerance for it; None for the chain.
      mesh: the devices over which the nodes are divided during the iteration; None for one device.
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
    weights: Any = None
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
        """True if the chain, which has the certificate, is solved; traced if one program solves both."""
        return self.scheme.monotone if self.first_order is None else self.first_order

    @property
    def of_chain(self) -> "Task":
        """The task of the chain, for a separate program."""
        return dataclasses.replace(self, on=self.on.chain, first_order=None, weights=None)

    @property
    def lost(self) -> jax.Array | None:
        """The nodes to which no action may lead, bool (*grid), or None."""
        return ~self.counted if self.has_lost else None

    @property
    def counting(self) -> jax.Array | bool:
        """The nodes whose value counts, bool (*grid); the constant True if all count, which saves a pass."""
        return self.counted if self.has_lost else True

    @property
    def given(self) -> Obstacles:
        """Target and constraints at the nodes, recomputed on use if only V is stored."""
        return bellman.obstacles(self.on) if self.bare else self.obstacles

    @property
    def by_defect(self) -> bool:
        """True if neither a step nor its bound requires the actions, which are then computed once, at the end."""
        additive = self.certificate is Certificate.ADDITIVE and self.first_order is None
        if not (self.method.by_defect and additive) or self.bare:
            return False
        players = self.on.players
        at_ends = players.control.fastest_at_ends and players.disturbance.fastest_at_ends
        return at_ends and players.exact and self.scheme.monotone

    @property
    def keeps_actions(self) -> bool:
        """True if a policy keeps its actions where others are as good, which keeps a proper policy proper."""
        problem = self.problem
        return problem.stopping_cost is not None and not problem.is_game and self.certificate in TO_THE_END

    @property
    def constrained(self) -> bool:
        """True if the problem has a stopping cost or a running maximum."""
        return is_constrained(self.problem)

    def impose(self, value: Field) -> Field:
        """``value`` with fixed values inserted, and with unreachable nodes far above all others."""
        value = self.given.impose(value)
        if not self.has_lost:
            return value
        # larger by 1/√eps: no minimum selects it, and differences with it keep half of their digits
        largest = self.layout.largest(jnp.where(self.counted, jnp.abs(value), 0))
        return jnp.where(self.counted, value, largest / jnp.sqrt(jnp.finfo(value.dtype).eps))

    @property
    def every_rate(self) -> bool:
        """True if no rate of the chain counts as rounding, because the discount bounds the value."""
        return self.certificate is Certificate.ADDITIVE

    def equation(self, value: Field, policy: Greedy, fastest: Scalar | None = None) -> PolicyEquation:
        """The linear equation of a policy; a known ``fastest``, the policy's largest Q + β, saves a pass."""
        return bellman.policy_equation(
            self.on, value, policy, self.obstacles, fastest=fastest, every_rate=self.every_rate
        )

    def reply(self, value: Field, policy: Greedy) -> Greedy:
        """The inner player's best response to the outer player's policy."""
        return bellman.respond(
            self.on, value, self.obstacles.fixed, policy, lost=self.lost, first_order=self.first_order
        )

    def size(self, value: Field) -> Scalar:
        """The largest |V| at the counted nodes."""
        if not jnp.ndim(self.counting):  # all nodes count, so no array of |V| is needed
            return jnp.maximum(self.layout.largest(value), -self.layout.least(value))
        return self.layout.largest(jnp.where(self.counting, jnp.abs(value), 0))

    def residual(self, equation: PolicyEquation) -> Scalar:
        """The largest |source| at the counted nodes, in cost units."""
        return self.layout.largest(jnp.where(self.counting, jnp.abs(equation.source), 0))

    def norm(self, change: Field) -> Scalar:
        """The norm of a change of V, cost units: its largest size, or a weighted one of high-order iterations."""
        size = jnp.abs(change)
        largest = self.layout.largest(size)
        if self.weights is None:
            return largest
        mean = self.layout.total(size) / math.prod(self.layout.whole)
        return jnp.maximum(self.weights[0] * largest, self.weights[1] * mean)

    def start(self) -> Field:
        """The value without a guess: zero, or without a discount ψ (above all fixed points) or g (below them)."""
        zero = jnp.zeros(self.grid.shape, self.tol.dtype)
        if not self.constrained or self.certificate is Certificate.ADDITIVE:
            return zero
        limits = [limit for limit in (self.given.lower, self.given.upper) if limit is not None]
        start = functools.reduce(jnp.maximum, limits)
        return jnp.asarray(jnp.broadcast_to(start, self.grid.shape), self.tol.dtype)


@pytree_dataclass()
class State:
    """State of a solve: the last evaluated value with its policy and bound, or the guess, and the record of the loop.

    Args:
      value: V, (*grid).
      policy: the greedy policy at V.
      fastest: the largest Q + β of the policy, per unit time; None if no rate counts as rounding.
      bound: the bound on the error of V.
      moves: the sizes of the last corrections.
      progress: the number of evaluations, the status and the residuals.
    """

    value: Field
    policy: Greedy
    fastest: Scalar | None
    bound: ErrorBound
    moves: Moves
    progress: Progress


def start(task: Task, guess: Nodes) -> State:
    """The state of a guess, which the first pass of ``run`` evaluates.

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
    moves = Moves(xp.full(2, xp.inf, dtype), xp.asarray(xp.inf, dtype), xp.ones((), dtype), xp.zeros((), xp.int32))
    fastest = None if task.every_rate else xp.zeros((), dtype)
    return State(value, policy, fastest, progress.no_bound(dtype, xp), moves, progress.no_progress(dtype, xp))


def run(task: Task, state: State, until: Number) -> State:
    """Step until the state is not running or ``until`` values are evaluated; at most ``HISTORY`` at a time."""
    chunk = state.progress.evaluations

    def step(state: State) -> State:
        # made loop-variant, otherwise XLA compiles a kernel for every scalar of every action that it can hoist
        variant = task.problem.controls, task.grid, state.progress.evaluations
        controls, grid, count = jax.lax.optimization_barrier(variant)
        on = altered(task.on, problem=altered(task.problem, controls=controls), grid=grid)
        state = dataclasses.replace(state, progress=dataclasses.replace(state.progress, evaluations=count))
        return _advance(dataclasses.replace(task, on=on), state, chunk)

    state = jax.lax.while_loop(lambda at: at.progress.is_running(until), step, state)
    if not task.by_defect:
        return state
    policy = bellman.greedy(task.on, state.value, task.obstacles.fixed)
    # the next chunk continues with the defect of the steps; the defect of the actions may differ by rounding
    return dataclasses.replace(state, policy=dataclasses.replace(policy, defect=state.policy.defect))


def _advance(task: Task, state: State, chunk: Scalar) -> State:
    """One step, or the evaluation of the guess; it is undone if its numbers are not finite."""
    if task.bare:
        return _relaxed(task, state, chunk)
    if task.by_defect:
        return _relaxed_by_defect(task, state, chunk)
    first = _is_first(state)
    delta = _correction(task, state)
    if not task.scheme.monotone:
        delta = state.moves.share * delta
    value = task.impose(state.value + delta)
    # a node that does not count may change indefinitely
    change = jnp.where(task.counting, value - state.value, 0)
    moved = task.norm(change)
    if task.certificate is Certificate.OPEN and not task.method.relaxes:
        moved = moved * methods.shift_factor(_shift(task, state), task.problem.discount)
    moved = jnp.where(first, jnp.inf, moved)  # the guess was not reached by a step, so its distance cannot be estimated
    moves, distance = state.moves, moved
    if not task.scheme.monotone:
        rounding = FEW * jnp.finfo(value.dtype).eps * task.size(value)
        distance = jnp.where(task.is_chain, moved, moves.distance(moved, rounding))
    policy, fastest, bound = _evaluate(task, value, state.policy, moved=distance, first=first)
    if not task.scheme.monotone:
        moves = moves.after(moved, damping.turns_back(task.layout, change, policy.defect))
    measured = state.progress.measure(bound, chunk)
    code = status_after(task, value, bound, measured, moved)
    after = State(value, policy, fastest, bound, moves, measured.judge(bound, code))
    return keep_finite(code, after, dataclasses.replace(state, progress=after.progress))


def _relaxed(task: Task, state: State, chunk: Scalar) -> State:
    """One relaxation of every node that stores only V; the bound belongs to the value before the relaxation."""
    value = task.impose(state.value)  # a guess need not have the fixed values
    step, bound = certificates.of_relaxation(task.certificate, task.on, value)
    # the bound on the value after it would require another array
    first, measured = _is_first(state), state.progress.measure(bound, chunk)
    after = jnp.where(first, value, task.impose(value + step))
    moved = jnp.where(first, jnp.inf, task.layout.largest(jnp.abs(after - state.value)))
    code = status_after(task, state.value, bound, measured, moved)
    found = dataclasses.replace(state, value=after, bound=bound, progress=measured.judge(bound, code))
    return keep_finite(code, found, dataclasses.replace(state, progress=found.progress))


def _relaxed_by_defect(task: Task, state: State, chunk: Scalar) -> State:
    """One relaxation of every node by the previous defect, with the bound on the new value; stores no actions."""
    assert task.outflow is not None
    value = task.impose(state.value + _correction(task, state))
    defect = jnp.where(task.obstacles.fixed, 0, bellman.relaxation(task.on, value, task.outflow)[0])
    policy = dataclasses.replace(state.policy, defect=defect)
    left = PolicyEquation(task.obstacles.clipped(defect / task.outflow, value), Rates((), ()))
    iterate = Iterate(task.layout, value, policy, left, task.obstacles, task.counting)
    bound = certificates.error_bound(task.certificate, iterate, discount=task.problem.discount)
    measured = state.progress.measure(bound, chunk)
    code = status_after(task, value, bound, measured)
    found = dataclasses.replace(state, value=value, bound=bound, progress=measured.judge(bound, code))
    after = keep_finite(code, found, dataclasses.replace(state, progress=found.progress))
    return dataclasses.replace(after, policy=policy)  # also for a step that is undone, since no step follows


def _is_first(state: State) -> jax.Array:
    """True if the value is the guess, which has not been evaluated."""
    return state.progress.evaluations == 0


def status_after(task: Task, value: Field, bound: ErrorBound, measured: Progress, moved: Number = np.inf) -> Scalar:
    """The status after an evaluation; later lines override earlier ones.

    Args:
      task: the task.
      value: a value of the size of V, (*grid).
      bound: the bound of the evaluated value.
      measured: the record with this evaluation, and the least error and residual before it.
      moved: the largest change of V; infinite if there was no step.
    """
    longest: Number = task.method.patience(undivided(task.grid))
    climbs = task.constrained or task.method.relaxes
    to_the_end = climbs and task.certificate in (*TO_THE_END, Certificate.OPEN)
    if to_the_end:  # a front changes V at one node after the other, by the spacing times the slope
        longest = jnp.maximum(longest, 100 + 4 * math.prod(task.layout.whole))
    best, since = measured.best, measured.since_best

    def converged(code: Any, tol: Scalar) -> Scalar:
        code = jnp.where(bound.error <= tol, Status.CONVERGED, code)
        return jnp.where(jnp.isfinite(bound.residual), code, Status.NONFINITE).astype(jnp.int32)

    def by_size() -> Scalar:
        rounding, tol = progress.ROUNDING * jnp.finfo(value.dtype).eps * task.size(value), task.tol
        if to_the_end:  # regardless of the tolerance
            few = FEW / progress.ROUNDING * rounding if task.bare else rounding
            tol = jnp.where(task.problem.discount > 0, tol, few)
        # a residual that is rounding cannot fall further: ten steps suffice, instead of thousands for a slow climb
        patience = jnp.where(bound.residual <= rounding, progress.PATIENCE, longest)
        halted: Any = Status.STALLED
        if to_the_end and task.bare:  # sums of many terms may leave more than a few units in the last place
            halted = jnp.where((bound.residual <= rounding) & ~(task.problem.discount > 0), Status.CONVERGED, halted)
        code = jnp.where(since >= patience, halted, Status.RUNNING)
        grew = bound.residual > progress.GROWTH * jnp.maximum(best[1], rounding)
        bounded = jnp.isfinite(best[0]) & (bound.error <= progress.GROWTH * best[0])
        grew &= ~bounded  # a better policy may leave a larger residual than one that stops at once
        return converged(jnp.where(grew, Status.DIVERGED, code), tol)

    if not to_the_end:
        # the size of V is computed only if it matters; in a cond, which later selects do not recompute
        matters = (since >= jnp.minimum(progress.PATIENCE, longest)) | (bound.residual > progress.GROWTH * best[1])
        return jax.lax.cond(matters, by_size, lambda: converged(Status.RUNNING, task.tol))
    return _status_of_tube(task, moved, by_size())


def _status_of_tube(task: Task, moved: Number, code: Scalar) -> Scalar:
    """The status after a step. A tube in which no value moved has converged, even if a slow node has a residual.

    The residual is relative to the node's own rate and the step to the fastest rate, so the step of a slow node may be
    below the last place of V.
    """
    if not (task.constrained and task.method.relaxes and task.certificate in TO_THE_END):
        return code
    ends = (moved == 0) & (code != Status.NONFINITE) & ~(task.problem.discount > 0)
    return jnp.where(ends, int(Status.CONVERGED), code).astype(code.dtype)


def nonfinite_nodes(task: Task, state: State) -> jax.Array:
    """The nodes where value or defect are not finite in the step that a NONFINITE state undid, bool (*grid)."""
    if task.bare:
        return ~jnp.isfinite(bellman.relaxation(task.on, task.impose(state.value))[0])
    before = dataclasses.replace(state.progress, evaluations=state.progress.evaluations - 1)
    state = dataclasses.replace(state, progress=before)
    if task.by_defect:  # the stored defect belongs to the undone step
        state = dataclasses.replace(state, policy=bellman.greedy(task.on, state.value, task.obstacles.fixed))
    value = task.impose(state.value + _correction(task, state))
    rate = bellman.greedy(task.on, value, task.obstacles.fixed, lost=task.lost, first_order=task.first_order).defect
    return task.counted & ~(jnp.isfinite(value) & jnp.isfinite(rate))


def _shift(task: Task, state: State) -> Scalar:
    """κ of the next correction, per unit time, with open ends."""
    assert task.outflow is not None
    return methods.shift(task.layout.largest(task.outflow), jnp.maximum(state.progress.evaluations - 1, 0))


def _evaluate(
    task: Task, value: Field, incumbent: Greedy, *, moved: Scalar, first: jax.Array
) -> tuple[Greedy, Scalar | None, ErrorBound]:
    """The greedy policy at a value, its largest Q + β, and the bound on the value's error."""
    problem = task.problem
    policy = bellman.greedy(
        task.on, value, task.obstacles.fixed, incumbent=incumbent, lost=task.lost, first_order=task.first_order
    )
    if task.keeps_actions:
        fixed = task.obstacles.fixed | first  # there are no actions to keep
        policy = bellman.improvement(task.on, value, fixed, policy, incumbent)
    left = task.equation(value, policy)
    iterate = Iterate(task.layout, value, policy, left, task.obstacles, task.counting)
    known = {"discount": problem.discount, "least_cost": task.least_cost, "moved": moved}
    bound = certificates.error_bound(task.certificate, iterate, **known)
    if task.weights is not None:
        residual = task.norm(jnp.where(task.counting, left.source, 0))
        measured = certificates.measured(bound.residual, jnp.maximum(residual, moved))
        # the chain's certificate does not apply to another scheme
        shared = task.first_order is not None
        bound = jax.tree.map(functools.partial(jnp.where, task.first_order), bound, measured) if shared else measured
    if task.has_lost:
        leaks = bellman.leaks(task.on, policy, task.obstacles.fixed, ~task.counted)
        bound = dataclasses.replace(bound, error=jnp.where(leaks, jnp.inf, bound.error))
    return policy, left.fastest, bound


@dataclasses.dataclass(frozen=True)
class _At:
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
        """r/(Q + β), with the largest rate: of the actions behind ``outflow``, or of the policy if it is larger."""
        task, policy, players = self.task, self.state.policy, self.task.on.players
        assert task.outflow is not None
        if players.control.fastest_at_ends and players.disturbance.fastest_at_ends:
            return policy.defect / task.outflow
        chosen = jump_rates(task.on, list(policy.controls), list(policy.disturbances)).total()
        return policy.defect / jnp.maximum(task.outflow, chosen + task.problem.discount)

    def evaluated(self, evaluation: Evaluation, replies: int) -> Field:
        """The correction of policy iteration, by the policy's linear equation, or by the inner problem of a game."""
        task, state = self.task, self.state
        if task.certificate is Certificate.OPEN:  # also in a game, where steps in time improve both players at once
            later = altered(task.problem, discount=task.problem.discount + _shift(task, state))
            return evaluate(evaluation, task.asking(later).equation(state.value, state.policy), task.grid)
        if task.problem.is_game:
            outer, goal = (state.value, state.policy), methods.inner_goal(state.bound.residual, state.progress.best[1])
            return methods.evaluated(task, *outer, evaluation, goal=goal, replies=replies) - state.value
        if task.shift is not None:  # a time step of length 1/κ: see ``solvers.order.sharpened``
            later = altered(task.problem, discount=task.problem.discount + task.shift)
            return evaluate(
                evaluation, task.asking(later).equation(state.value, state.policy, state.fastest), task.grid
            )
        return evaluate(evaluation, self.equation(), task.grid)


def _correction(task: Task, state: State) -> Field:
    """The correction δ of the method, cost units, (*grid); zero for a guess, which has no policy."""
    stay, first = jnp.zeros_like(state.value), _is_first(state)
    if task.method.relaxes:  # a cond would take two passes over the nodes instead of one
        return jnp.where(first, stay, _by_method(task, state))
    return jax.lax.cond(first, lambda: stay, lambda: _by_method(task, state))


def _by_method(task: Task, state: State) -> Field:
    """The correction δ of the method for an evaluated value."""
    here = _At(task, state)
    if task.method.relaxes or task.outflow is None or task.certificate is Certificate.OPEN:
        return task.method.correct(here)
    return jax.lax.cond(  # with a traced discount: without a discount the policies of a tube have no value
        jnp.asarray(task.problem.discount > 0), lambda: task.method.correct(here), here.relaxed
    )
