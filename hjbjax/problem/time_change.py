"""Discounts that are functions of the state, for problems without a horizon.

A path that is discounted at the rate β(x) counts as much as a path in the time τ with dτ = β(x) dt that is discounted
at the rate one. The equation divided by β(x),

    V = min_u max_d [ L/β + (f/β)·DV + ½ tr((σ/√β)(σ/√β)ᵀ D²V) ],

has the same solution, and so has its Markov chain: jump rates are linear in f and σσᵀ, so every row of the chain is
divided by one number. The residual is then r/β, and the additive certificate V + min r/β ≤ V_h ≤ V + max r/β holds with
the β of each node. The solvers therefore only know discounts that are numbers.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered
from hjbjax.problem.types import Array, State


def in_own_time(problem: Problem) -> Problem:
    """The problem with discount one in the time τ, dτ = β(x) dt; unchanged if its discount is a number.

    Where β(x) ≤ 0 the functions of the new problem are NaN.

    Example:
      >>> problem = Problem(lambda x, u: x, lambda x, u: 1.0, noise=3.0, discount=lambda x: 4.0 + 0 * x[0])
      >>> scaled, x = in_own_time(problem), jnp.ones(1)
      >>> scaled.discount, float(scaled.drift(x, None)[0]), float(scaled.cost(x, None)), float(scaled.noise(x, None))
      (1.0, 0.25, 0.25, 1.5)
    """
    if not callable(problem.discount):
        return problem
    noise = problem.noise
    if noise is not None and not callable(noise):
        noise = jax.tree_util.Partial(_constant, noise)
    scaled = {
        "drift": _over(problem.drift, problem.discount, 1),
        "cost": None if problem.cost is None else _over(problem.cost, problem.discount, 1),
        "noise": None if noise is None else _over(noise, problem.discount, 2),
    }
    return altered(problem, discount=1.0, discounted=True, **scaled)


def with_killing(problem: Problem) -> Problem:
    """The problem whose discount is a function of the state as a killing, for a march; unchanged if it is a number.

    A horizon cannot be reached in the time τ. The killing is the part of β V that is not a number times V.
    """
    if not callable(problem.discount):
        return problem
    return altered(problem, discount=0.0, discounted=False, killing=problem.discount)


def _constant(value: Array, *arguments: Array) -> Array:
    """A number as a function."""
    return value


def _over(function: jax.tree_util.Partial, discount: jax.tree_util.Partial, root: int) -> jax.tree_util.Partial:
    """A function of (x, u) or (x, u, d) over the root of β(x), with the leaves of both.

    It is a closure, not an object, so that the numbers that the functions read from outside are found.
    """
    above: Callable = function.func
    below: Callable = discount.func

    def scaled(mine: tuple, theirs: tuple, x: State, *actions: Any) -> Array:
        (known, options), (numbers, others) = mine, theirs
        rate = jnp.asarray(below(*numbers, x, **others))
        rate = jnp.where(rate > 0, rate, jnp.nan)  # a negative rate would turn the time around
        return jnp.asarray(above(*known, x, *actions, **options)) / (rate if root == 1 else jnp.sqrt(rate))

    leaves = (function.args, function.keywords), (discount.args, discount.keywords)
    return jax.tree_util.Partial(scaled, *leaves)
