"""The jumps of a problem as three functions of its arguments: all rates, all landings and all costs.

The solvers only use these functions: ``intensities`` returns the rates λ, shape (k,), for k jumps, ``landings`` the
states after the jumps, shape (k, n), and ``jump_costs`` the costs c, shape (k,). In the mean the jumps cost Σ λ c per
unit time, so a solver adds this to the running cost. Paths pay c at each jump.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered
from hjbjax.problem.rewards import negative
from hjbjax.problem.types import Array

OF_JUMPS = ("intensities", "landings", "jump_costs")


def with_jump_functions(problem: Problem) -> Problem:
    """The problem with its jumps as functions of all arguments; unchanged without jumps.

    Example:
      >>> from hjbjax.problem.jumps import Jump
      >>> mirrored, halved = Jump(2.0, lambda x, u: -x), Jump(lambda x, u: x[0], lambda x, u: x / 2)
      >>> problem = Problem(lambda x, u: 0 * x, jumps=[mirrored, halved])
      >>> found, x = with_jump_functions(problem), 3 * jnp.ones(1)
      >>> found.intensities(x, None).tolist(), found.landings(x, None).tolist()
      ([2.0, 3.0], [[-3.0], [1.5]])
    """
    if not problem.jumps:
        return problem
    rates, landings = ([_function(getattr(jump, name)) for jump in problem.jumps] for name in ("rate", "landing"))
    costs = [jump.cost if jump.reward is None else negative(jump.reward) for jump in problem.jumps]
    paid = None if all(cost is None for cost in costs) else _stacked([_function(cost) for cost in costs])
    return altered(problem, jumps=(), intensities=_stacked(rates), landings=_stacked(landings), jump_costs=paid)


def with_mean_jump_costs(problem: Problem) -> Problem:
    """The problem whose running cost includes the mean cost of the jumps, Σ λ c per unit time."""
    if problem.jump_costs is None:
        return problem
    parts = (problem.intensities, problem.jump_costs, *([] if problem.cost is None else [problem.cost]))
    return altered(problem, cost=jax.tree_util.Partial(_mean_cost, parts), jump_costs=None)


def _function(value: Any) -> jax.tree_util.Partial:
    """A function, or a number as a function; None stands for zero."""
    return value if callable(value) else jax.tree_util.Partial(constant_function, 0.0 if value is None else value)


def constant_function(value: Any, *arguments: Any) -> Any:
    """A constant as a function."""
    return value


def _stacked(functions: list) -> jax.tree_util.Partial:
    """One function that returns the results of all."""
    return jax.tree_util.Partial(_all_of, tuple(functions))


def _all_of(functions: tuple[Callable, ...], *arguments: Any) -> Array:
    """The results of several functions, in one floating-point type."""
    found = [jnp.asarray(function(*arguments)) for function in functions]
    kind = jnp.result_type(*found, float)
    return jnp.stack([each.astype(kind) for each in found])


def _mean_cost(functions: tuple[Callable, ...], *arguments: Any) -> Array:
    """Σ λ c plus the running cost."""
    rates, paid, *running = (jnp.asarray(function(*arguments)) for function in functions)
    return sum(running, start=jnp.sum(rates * paid))
