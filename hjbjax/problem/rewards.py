"""Problems with rewards as problems with costs: max ∫ e^{−βt} r dt = −min ∫ e^{−βt} (−r) dt.

The solvers only minimise costs. A public function that accepts rewards first replaces them by costs, which are minus
the rewards. At the end it gives its results the sign of the rewards, see ``solution.rewards``. The numbers in the
rewards are leaves of the costs.
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
from hjbjax.problem.pytree import REMEMBERED, altered


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


@functools.lru_cache(maxsize=REMEMBERED)
def _negative_function(function: Callable) -> Callable:
    """Minus a function.

    It is a closure, not an object, because the search for numbers that a function reads from outside follows closures.
    The same closure for the same function: otherwise every solve would repeat the checks on one state.
    """

    # messages show the signature of ``__wrapped__``; an object without a name is shown as ``reward``
    @functools.wraps(function, assigned=("__name__",), updated=())
    def reward(*arguments: Any, **options: Any) -> Any:
        return _negative_number(function(*arguments, **options))

    return reward


def _negative_number(number: Any) -> Any:
    """Minus real numbers; anything else is returned unchanged, so that the checks can quote what the user wrote."""
    if isinstance(number, (bool, str)) or not isinstance(number, (int, float, np.ndarray, np.number, jax.Array)):
        return number
    kind = jnp.result_type(number)
    if jnp.issubdtype(kind, jnp.unsignedinteger) or not jnp.issubdtype(kind, jnp.number):
        return number
    return 0 - number  # not −number, which would turn 0.0 into −0.0


def negative_ends(grid: Grid) -> Grid:
    """The grid with the opposite sign of the values and slopes prescribed at its ends; growth rates do not change."""

    def changed(end: Any) -> Any:
        names = [each.name for each in dataclasses.fields(end) if each.name != "rate"]
        return altered(end, **{name: 0 - getattr(end, name) for name in names})

    return with_prescriptions(grid, changed) if grid.prescribed() else grid


def refuse_rewards(problem: Problem | None, name: str, why: str) -> None:
    """Refuse a problem with rewards in a function that only supports costs, with the reason ``why``.

    Raises:
      ValueError: the problem has rewards.
    """
    if problem is not None and problem.payoff == REWARD:
        raise ValueError(
            f"{name}: got a problem with rewards, wanted costs: {why}.\n"
            "Write the problem with cost= instead of reward=, minus the reward."
        )
