"""Problems with rewards as problems with costs: max ∫ e^{−βt} r dt = −min ∫ e^{−βt} (−r) dt.

The solvers minimise and do not distinguish the two. A public function that takes a problem with rewards replaces the
rewards by costs, minus the rewards, before anything else, and gives its results the sign of the rewards at the end; see
``solution.rewards``. The costs keep the numbers of the rewards as leaves.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid, with_prescriptions
from hjbjax.problem.labels import REWARD
from hjbjax.problem.problem import PAYMENTS, Problem
from hjbjax.problem.pytree import altered


def costs_of(problem: Problem) -> Problem:
    """The problem with minus the rewards as costs; a problem with costs is returned unchanged.

    Example:
      >>> problem = Problem(lambda x, u: u, reward=lambda x, u: -x @ x, terminal_reward=2.0)
      >>> costs = costs_of(problem)
      >>> costs.terminal_cost, float(costs.cost(jnp.ones(2), jnp.zeros(2)))
      (-2.0, 2.0)
    """
    if all(getattr(problem, reward) is None for reward in PAYMENTS):
        return problem
    paid = {cost: negative(getattr(problem, reward)) for reward, cost in PAYMENTS.items()}
    return altered(problem, **paid, **dict.fromkeys(PAYMENTS))


def negative(payment: Any) -> Any:
    """Minus a payment: a function, a number, node values, or None."""
    if payment is None:
        return None
    if isinstance(payment, jax.tree_util.Partial):
        return jax.tree_util.Partial(_negative_function(payment.func), *payment.args, **payment.keywords)
    if callable(payment):
        return _negative_function(payment)
    return _negative_number(payment)


def _negative_function(function: Callable) -> Callable:
    """Minus a function.

    It is a closure, not an object, so that the numbers that the function reads from outside are found.
    """

    # ``__wrapped__`` is the signature that messages show; an object without a name is called reward
    @functools.wraps(function, assigned=("__name__",), updated=())
    def reward(*arguments: Any, **options: Any) -> Any:
        return _negative_number(function(*arguments, **options))

    return reward


def _negative_number(number: Any) -> Any:
    """Minus real numbers; anything else is returned unchanged, to be refused by the checks in the user's words."""
    if isinstance(number, (bool, str)) or not isinstance(number, (int, float, np.ndarray, np.number, jax.Array)):
        return number
    kind = jnp.result_type(number)
    if jnp.issubdtype(kind, jnp.unsignedinteger) or not jnp.issubdtype(kind, jnp.number):
        return number
    return 0 - number  # not −number: minus zero is zero


def negative_ends(grid: Grid) -> Grid:
    """The grid with minus the values and slopes that are prescribed at its ends; a growth rate has no sign."""

    def changed(end: Any) -> Any:
        names = [each.name for each in dataclasses.fields(end) if each.name != "rate"]
        return altered(end, **{name: 0 - getattr(end, name) for name in names})

    return with_prescriptions(grid, changed) if grid.prescribed() else grid


def refuse_rewards(problem: Problem | None, name: str, why: str) -> None:
    """Refuse a problem with rewards on behalf of a function that is about costs, with the reason.

    Raises:
      ValueError: the problem has rewards.
    """
    if problem is not None and problem.payoff == REWARD:
        raise ValueError(
            f"{name}: got a problem with rewards, wanted costs: {why}.\n"
            "Write the problem with cost= instead of reward=, minus the reward."
        )
