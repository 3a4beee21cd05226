"""The value of a policy in a game: the inner player's problem is solved against the outer player's policy.

The inner player answers, the answer is evaluated, and so on until the residual of that problem is a tenth of the outer
one's; then the outer player improves. Improving both at once may cycle. After A. J. Hoffman and R. M. Karp.
"""

from typing import Protocol

import jax
import jax.numpy as jnp

from hjbjax.iteration.bellman import Greedy, PolicyEquation
from hjbjax.iteration.evaluation import Evaluation, evaluate
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Field, Number, Scalar

SHARE = 0.1  # of the outer residual: a better answer to a policy that is about to change is work for nothing


class Question(Protocol):
    """A stationary problem, or one step in time, whose policies are to be evaluated."""

    @property
    def grid(self) -> Grid:
        """The nodes."""

    def equation(self, value: Field, policy: Greedy) -> PolicyEquation:
        """The linear equation of a policy for a correction of ``value``."""

    def reply(self, value: Field, policy: Greedy) -> Greedy:
        """The inner player's best answer to the outer player's policy, with the defect that it leaves."""

    def impose(self, value: Field) -> Field:
        """``value`` with the fixed values put in and the constraints respected."""

    def residual(self, equation: PolicyEquation) -> Scalar:
        """The largest |source| at the nodes that count, in cost units."""


def evaluated(
    question: Question, value: Field, policy: Greedy, evaluation: Evaluation, *, residual: Number, replies: int
) -> Field:
    """The value of the outer player's policy from its inner player's problem.

    Args:
      question: the game.
      value: V, (*grid).
      policy: both players' greedy actions at V.
      evaluation: how the linear equation of a pair of policies is solved.
      residual: that of the outer problem at V, of which a tenth is the goal.
      replies: at most so many answers of the inner player.
    """

    def reply(carry):
        value, policy, _, count = carry
        delta = evaluate(evaluation, question.equation(value, policy), question.grid)
        value = question.impose(value + delta)
        policy = question.reply(value, policy)
        # the answer at the new value leaves a residual of the inner problem alone: the outer policy is kept
        return value, policy, question.residual(question.equation(value, policy)), count + 1

    def unfinished(carry):
        return (carry[2] > SHARE * residual) & (carry[3] < replies)

    # infinite: the outer player's policy is evaluated once at least, against the answer that it was found with
    start = (value, policy, jnp.asarray(jnp.inf, value.dtype), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, reply, start)[0]  # the policy is found anew by whoever asks
