"""One implicit Euler step backward in time by policy iteration.

With V at t + Δt known, W = V(·, t) solves the stationary problem

    min{ max{ (β + 1/Δt) W − V/Δt − min max H(t, W),  W − ψ },  W − g } = 0,

that is, with discount β + 1/Δt and V/Δt added to the running cost: any Δt, monotone, order 1. A step ends when the
additive certificate of that problem is small enough, or the residual is rounding. In a game the inner player's
problem is solved against the outer player's policy (Hoffman–Karp), since improving both at once may cycle.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.discretisation.schemes import Scheme
from hjbjax.iteration import bellman, certificates, relaxation
from hjbjax.iteration.bellman import Conditions, Correction, Greedy
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.relaxation import Evaluation
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, node

ROUNDING = 16  # residuals below this many units in the last place of max|V| are rounding
REPLIES = 20  # of the inner player to one policy of the outer one, at most


@node(static=("scheme",))
class Step:
    """The stationary problem of one step.

    Args:
      problem: the problem with discount β + 1/Δt.
      grid, scheme: the chain.
      rules: held nodes and constraints at t.
      arriving: V/Δt, what is added to the running cost.
      t: the time of W.
    """

    problem: Problem
    grid: Grid
    scheme: Scheme
    rules: Conditions
    arriving: jax.Array
    t: Any

    def equation(self, value: jax.Array, policy: Greedy) -> Correction:
        """The linear equation of a policy at ``value``."""
        return bellman.correction(self.problem, self.grid, value, policy, self.rules, scheme=self.scheme, t=self.t)

    def complete(self, policy: Greedy) -> Greedy:
        """A policy of the problem with its rate, V/Δt included."""
        return dataclasses.replace(policy, rate=jnp.where(self.rules.held, 0, policy.rate + self.arriving))

    def improved(self, value: jax.Array) -> Greedy:
        """The greedy policy at ``value``."""
        held = self.rules.held
        return self.complete(bellman.greedy(self.problem, self.grid, value, held, scheme=self.scheme, t=self.t))

    def reply(self, value: jax.Array, policy: Greedy) -> Greedy:
        """The inner player's answer to the outer player's policy."""
        held = self.rules.held
        return self.complete(
            bellman.respond(self.problem, self.grid, value, held, policy, scheme=self.scheme, t=self.t)
        )


def advance(
    problem: Problem,
    grid: Grid,
    rules: Conditions,
    value: jax.Array,
    t: Any,
    dt: Any,
    *,
    scheme: Scheme,
    evaluation: Evaluation,
    tol: Any,
    max_steps: int,
) -> tuple[jax.Array, Greedy, jax.Array]:
    """W at the time t from V = ``value`` at t + Δt, its policy, and whether it is known to ``tol`` or to rounding.

    Args:
      problem, grid, scheme: the chain.
      rules: held nodes and constraints at t.
      value: V, shape (*grid).
      t: the time of the result.
      dt: Δt > 0.
      evaluation: how a policy is evaluated.
      tol: bound on the algebraic error of the step, cost units.
      max_steps: policy improvements, at most.
    """
    shifted = altered(problem, discount=problem.discount + 1 / dt)  # a problem refuses it beside a running maximum
    step = Step(shifted, grid, scheme, rules, value / dt, t)

    def look(value):
        policy = step.improved(value)
        equation = step.equation(value, policy)
        measured = certificates.gap(
            Certificate.ADDITIVE, value, policy, equation, rules, discount=shifted.discount, least_cost=None,
            counted=True, moved=0,
        )  # fmt: skip
        rounding = ROUNDING * jnp.finfo(value.dtype).eps * jnp.max(jnp.abs(value))
        return policy, measured.residual, (measured.error <= tol) | (measured.residual <= rounding)

    def unfinished(carry):
        _, _, residual, done, count = carry
        return ~done & (count < max_steps) & jnp.isfinite(residual)

    def improve(carry):
        value, policy, residual, _, count = carry
        value = _evaluated(step, value, policy, residual, evaluation)
        return value, *look(value), count + 1

    start = rules.impose(value)
    carry = (start, *look(start), jnp.zeros((), jnp.int32))
    value, policy, _, done, _ = jax.lax.while_loop(unfinished, improve, carry)
    return value, policy, done


def _evaluated(step: Step, value: jax.Array, policy: Greedy, residual: Any, evaluation: Evaluation) -> jax.Array:
    """The value of the (outer player's) policy, roughly; in a game to a tenth of the residual."""

    def solved(value, policy):
        delta = relaxation.solve(evaluation, step.equation(value, policy), step.grid)
        return step.rules.impose(value + delta)

    if not step.problem.is_game:
        return solved(value, policy)

    def reply(carry):
        value, policy, _, count = carry
        value = solved(value, policy)
        policy = step.reply(value, policy)
        return value, policy, jnp.max(jnp.abs(step.equation(value, policy).source)), count + 1

    def unfinished(carry):
        return (carry[2] > 0.1 * residual) & (carry[3] < REPLIES)

    start = (value, policy, jnp.asarray(jnp.inf, value.dtype), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, reply, start)[0]
