"""Many steps: value iteration and policy iteration as one loop.

Every method repeats the same step. At V the greedy policy leaves a residual; the linear equation of that
policy gives a correction δ; V + δ is the next value. What differs is how well the equation is solved: value
iteration takes its diagonal with the largest rate (monotone, a contraction), modified policy iteration a few
Gauss–Seidel sweeps, policy iteration (Howard; semismooth Newton) solves it. In a game the outer player's policy
is kept while the inner player's problem is improved (Hoffman–Karp); improving both at once may cycle.

The loop stops by the certificate of the value it returns, not by the size of a step, and tests finiteness: a
NaN residual is never taken for convergence.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import bellman, certificates, hamiltonian, players, relaxation
from hjbjax.bellman import Conditions, Correction, Greedy
from hjbjax.certificates import Certificate, Gap
from hjbjax.grid import Grid
from hjbjax.problem import Problem
from hjbjax.pytree import altered, is_traced, node
from hjbjax.relaxation import Evaluation, Sweeps
from hjbjax.schemes import Limited, Scheme
from hjbjax.status import Status

FULL_STEPS = 10  # corrections of a limited scheme before they are halved, which ends limit cycles of the limiter
HISTORY = 256  # steps whose residuals one chunk can record
GROWTH = 1e6  # a residual that has grown by this factor over its smallest has diverged
PATIENCE = 10  # steps without progress of a residual that is rounding
ROUNDING = 64  # residuals below this many units in the last place of max|V| are rounding


@node()
class ValueIteration:
    """V ← max(g, min(ψ, V + (min max H − β V)/(max_u Q + β))): monotone, converges from every guess.

    The error falls by 1/(1 + βΔt) a step: many cheap steps. For reference, for games, and where memory rules.
    """


@node(static=("replies",))
class PolicyIteration:
    """Improve the policy, evaluate it, repeat; the evaluation is what distinguishes the methods of this family.

    Args:
      evaluation: ``Sweeps(count)`` is modified policy iteration; ``Krylov()`` and ``Direct()`` are Howard's.
      replies: in a game, the inner player's improvements for each of the outer player's, at most.
    """

    evaluation: Evaluation = Sweeps()
    replies: int = 20


@node(static=("coarsest",))
class Nested:
    """Solve on coarser grids first, and start each finer one from the interpolated answer.

    From a cold start the count of policy improvements grows with N, one cell of good policy an improvement; from
    the coarser grid's answer it stays at a few. Host level only: every level is compiled on its own.

    Args:
      inner: what runs on each level.
      coarsest: do not go on to grids with fewer nodes than this.
    """

    inner: PolicyIteration = PolicyIteration()
    coarsest: int = 2000


Method = ValueIteration | PolicyIteration | Nested


@node(static=("scheme", "certificate"))
class Task:
    """All that stays the same during a solve.

    Args:
      problem, grid: the question.
      method: how the correction is made.
      rules: held nodes and constraints.
      counted: bool (*grid), nodes that have a finite value.
      least_cost: the least running cost at each node, for the multiplicative certificate; else None.
      pace: max Q + β at each node for value iteration; else None.
      tol: certified error to reach, cost units.
      scheme, certificate: static choices.
    """

    problem: Problem
    grid: Grid
    method: Method
    rules: Conditions
    counted: jax.Array
    least_cost: jax.Array | None
    pace: jax.Array | None
    tol: Any
    scheme: Scheme
    certificate: Certificate


@node()
class State:
    """Where the iteration stands: a value, its greedy policy, its certificate, and the loop's book-keeping.

    ``fastest`` is the policy's largest Q + β, zero where every rate counts (under a discount), infinite before the look
    at a guess.
    """

    value: jax.Array
    policy: Greedy
    fastest: jax.Array
    gap: Gap
    step: jax.Array
    best: jax.Array
    since_best: jax.Array
    code: jax.Array
    history: jax.Array


def begin(task: Task, guess: Any) -> State:
    """The state before the first look at a guess; step −1 of ``run`` is that look, so that all is one program.

    The guess is copied, since states are donated. At host level there is nothing to compile.
    """
    traced = is_traced(task, guess)
    xp: Any = jnp if traced else np
    value = jnp.array(guess) if traced else jax.device_put(guess, may_alias=False)
    dtype, shape = guess.dtype, task.grid.shape
    inputs = [0 if choices is None else choices.dim for choices in (task.problem.controls, task.problem.disturbances)]
    policy = Greedy(xp.zeros(shape, dtype), *(tuple(xp.zeros(shape, dtype) for _ in range(m)) for m in inputs))
    infinite = xp.asarray(xp.inf, dtype)
    gap = Gap(-infinite, infinite, xp.zeros((), dtype), infinite, infinite)
    counter = xp.zeros((), xp.int32)
    code = xp.asarray(int(Status.RUNNING), xp.int32)
    history = xp.full(HISTORY, xp.nan, dtype)
    return State(value, policy, infinite, gap, counter - 1, xp.stack([infinite] * 2), counter, code, history)


def run(task: Task, state: State, until: Any) -> State:
    """Steps until the state is no longer running or ``until`` steps are done; at most ``HISTORY`` at a time."""
    start = state.step

    def goes_on(state):
        return (state.code == Status.RUNNING) & (state.step < until)

    def step(state):
        # loop variant, or XLA compiles a kernel for every scalar of every action that it can hoist
        controls, grid, count = jax.lax.optimization_barrier((task.problem.controls, task.grid, state.step))
        here = dataclasses.replace(task, problem=altered(task.problem, controls=controls), grid=grid)
        return advance(here, dataclasses.replace(state, step=count), start)

    return jax.lax.while_loop(goes_on, step, state)


def advance(task: Task, state: State, start: Any) -> State:
    """One step; a step that ends in numbers that are not finite is taken back."""
    stay = jnp.zeros_like(state.value)
    delta = jax.lax.cond(state.step < 0, lambda: stay, lambda: _correct(task, state))
    if isinstance(task.scheme, Limited):
        delta = jnp.where(state.step < FULL_STEPS, 1.0, 0.5).astype(delta.dtype) * delta
    value = task.rules.impose(state.value + delta)
    policy, fastest, measured = _look(
        task, value, state.policy, moved=jnp.max(jnp.abs(jnp.where(task.counted, value - state.value, 0)))
    )
    measured = dataclasses.replace(measured, error=jnp.where(_unmeasured(task, state), jnp.inf, measured.error))
    measures = jnp.stack([measured.error, measured.residual])
    since = jnp.where(jnp.any(measures < state.best), 0, state.since_best + 1)
    code = _judge(task, value, measured, state.best, since)
    history = state.history.at[state.step - start].set(measured.residual)
    best = jnp.fmin(state.best, measures)
    new = State(value, policy, fastest, measured, state.step + 1, best, since, code, history)
    old = dataclasses.replace(state, step=new.step, since_best=since, code=code, history=history)
    return jax.tree.map(lambda after, before: jnp.where(code == Status.NONFINITE, before, after), new, old)


def _unmeasured(task: Task, state: State) -> Any:
    """Without a certificate a step must have been taken before its size says anything."""
    return (state.step < 0) & (task.certificate in (Certificate.NONE, Certificate.RESIDUAL))


def _look(task: Task, value: jax.Array, incumbent: Greedy, moved: jax.Array) -> tuple[Greedy, jax.Array, Gap]:
    problem, grid, scheme = task.problem, task.grid, task.scheme
    policy = bellman.greedy(problem, grid, value, task.rules.held, scheme=scheme, incumbent=incumbent)
    left = equation(task, value, policy)
    measured = certificates.gap(
        task.certificate,
        value,
        policy,
        left,
        task.rules,
        discount=problem.discount,
        least_cost=task.least_cost,
        counted=task.counted,
        moved=moved,
    )
    return policy, left.fastest, measured


def _judge(task: Task, value: jax.Array, measured: Gap, best: jax.Array, since: jax.Array) -> jax.Array:
    finite = jnp.isfinite(measured.residual)
    matters = (since >= PATIENCE) | (measured.residual > GROWTH * best[1])  # else it changes no answer below
    size = jax.lax.cond(
        matters, lambda: jnp.max(jnp.where(task.counted, jnp.abs(value), 0)), lambda: jnp.zeros_like(best[1])
    )
    rounding = ROUNDING * jnp.finfo(value.dtype).eps * size
    patience = jnp.where(measured.residual <= rounding, PATIENCE, 100 + 4 * sum(task.grid.shape))
    code = jnp.where(since >= patience, Status.STALLED, Status.RUNNING)
    code = jnp.where(measured.residual > GROWTH * jnp.maximum(best[1], rounding), Status.DIVERGED, code)
    code = jnp.where(measured.error <= task.tol, Status.CONVERGED, code)
    return jnp.where(finite, code, Status.NONFINITE).astype(jnp.int32)


def _correct(task: Task, state: State) -> jax.Array:
    if isinstance(task.method, ValueIteration):
        assert task.pace is not None
        return state.policy.rate / task.pace
    assert isinstance(task.method, PolicyIteration)
    if task.problem.is_game:
        return _hoffman_karp(task, state)
    left = equation(task, state.value, state.policy, state.fastest)
    return relaxation.solve(task.method.evaluation, left, task.grid)


def equation(task: Task, value: jax.Array, policy: Greedy, fastest: Any = None) -> Correction:
    """The linear equation of a policy; ``fastest``, its largest Q + β, spares a pass where it is known and wanted."""
    if task.certificate is Certificate.ADDITIVE:  # no rate is only rounding: there is a discount
        fastest = jnp.zeros((), value.dtype)
    return bellman.correction(task.problem, task.grid, value, policy, task.rules, scheme=task.scheme, fastest=fastest)


def _hoffman_karp(task: Task, state: State) -> jax.Array:
    """The inner player's problem against the outer player's frozen policy, to a tenth of the outer residual."""
    assert isinstance(task.method, PolicyIteration)
    evaluation, replies, held = task.method.evaluation, task.method.replies, task.rules.held
    target = 0.1 * state.gap.residual

    def reply(carry):
        value, policy, _, count = carry
        value = task.rules.impose(value + relaxation.solve(evaluation, equation(task, value, policy), task.grid))
        policy = bellman.respond(task.problem, task.grid, value, held, policy, scheme=task.scheme)
        left = jnp.max(jnp.where(task.counted, jnp.abs(equation(task, value, policy).source), 0))
        return value, policy, left, count + 1

    def unfinished(carry):
        return (carry[2] > target) & (carry[3] < replies)

    start = (state.value, state.policy, jnp.asarray(jnp.inf, state.value.dtype), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, reply, start)[0] - state.value


def rest_nodes(problem: Problem, grid: Grid, *, scheme: Scheme, dtype: Any) -> tuple[jax.Array, jax.Array]:
    """Where the system can rest at no cost, bool (*grid), and the least running cost at every node.

    Rest is up to rounding, since sin π is not zero in floating point. At V = 0 the Hamiltonian is the cost.
    """
    how = players.setting(problem, grid.ndim, dtype)
    nowhere = hamiltonian.local(problem, grid, jnp.zeros(grid.shape, dtype), scheme=scheme)
    least = hamiltonian.optimise(nowhere, how)[0]
    effort = hamiltonian.optimise(hamiltonian.at_rest(problem, grid, scheme=scheme, dtype=dtype), how)[0]
    size = 1 + sum(grid.hi[axis] - grid.lo[axis] for axis in range(grid.ndim))
    small = 1e3 * jnp.finfo(dtype).eps * size
    return (jnp.abs(effort) <= small) & (jnp.abs(least) <= small), least
