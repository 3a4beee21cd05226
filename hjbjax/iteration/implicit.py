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

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import bellman, certificates
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.evaluation import Evaluation, evaluate
from hjbjax.problem.pytree import altered, pytree_dataclass

ROUNDING = 16  # residuals below this many units in the last place of max|V| are rounding
REPLIES = 20  # of the inner player to one policy of the outer one, at most


@pytree_dataclass()
class Step:
    """The stationary problem of one step.

    Args:
      on: the problem with discount β + 1/Δt on its grid at the time of W.
      rules: held nodes and constraints at that time.
      arriving: V/Δt, what is added to the running cost.
    """

    on: Discretisation
    obstacles: Obstacles
    arriving: jax.Array

    def equation(self, value: jax.Array, policy: Greedy) -> PolicyEquation:
        """The linear equation of a policy at ``value``."""
        return bellman.policy_equation(self.on, value, policy, self.obstacles)

    def complete(self, policy: Greedy) -> Greedy:
        """A policy of the problem with its rate, V/Δt included."""
        return dataclasses.replace(policy, defect=jnp.where(self.obstacles.fixed, 0, policy.defect + self.arriving))

    def improved(self, value: jax.Array) -> Greedy:
        """The greedy policy at ``value``."""
        return self.complete(bellman.greedy(self.on, value, self.obstacles.fixed))

    def reply(self, value: jax.Array, policy: Greedy) -> Greedy:
        """The inner player's answer to the outer player's policy."""
        return self.complete(bellman.respond(self.on, value, self.obstacles.fixed, policy))


def advance(
    on: Discretisation,
    obstacles: Obstacles,
    value: jax.Array,
    dt: Any,
    *,
    evaluation: Evaluation,
    tol: Any,
    max_steps: int,
) -> tuple[jax.Array, Greedy, jax.Array]:
    """W at the time t from V = ``value`` at t + Δt, its policy, and whether it is known to ``tol`` or to rounding.

    Args:
      on: the chain at the time t of the result.
      rules: held nodes and constraints at t.
      value: V, shape (*grid).
      dt: Δt > 0.
      evaluation: how a policy is evaluated.
      tol: bound on the algebraic error of the step, cost units.
      max_steps: policy improvements, at most.
    """
    # not by Problem(...), which refuses a discount beside a running maximum
    shifted = altered(on.problem, discount=on.problem.discount + 1 / dt)
    step = Step(on.asking(shifted), obstacles, value / dt)

    def look(value):
        policy = step.improved(value)
        equation = step.equation(value, policy)
        bound = certificates.error_bound(
            Certificate.ADDITIVE, value, policy, equation, obstacles, discount=shifted.discount, least_cost=None,
            counted=True, moved=0,
        )  # fmt: skip
        rounding = ROUNDING * jnp.finfo(value.dtype).eps * jnp.max(jnp.abs(value))
        return policy, bound.residual, (bound.error <= tol) | (bound.residual <= rounding)

    def unfinished(carry):
        _, _, residual, done, count = carry
        return ~done & (count < max_steps) & jnp.isfinite(residual)

    def improve(carry):
        value, policy, residual, _, count = carry
        value = _evaluated(step, value, policy, residual, evaluation)
        return value, *look(value), count + 1

    start = obstacles.impose(value)
    carry = (start, *look(start), jnp.zeros((), jnp.int32))
    value, policy, _, done, _ = jax.lax.while_loop(unfinished, improve, carry)
    return value, policy, done


def _evaluated(step: Step, value: jax.Array, policy: Greedy, residual: Any, evaluation: Evaluation) -> jax.Array:
    """The value of the (outer player's) policy, roughly; in a game to a tenth of the residual."""

    def solved(value, policy):
        delta = evaluate(evaluation, step.equation(value, policy), step.on.grid)
        return step.obstacles.impose(value + delta)

    if not step.on.problem.is_game:
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
