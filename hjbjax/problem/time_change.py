"""Discounts that are functions of the state, for problems without a horizon.

Discounting at the rate β(x) in the time t is discounting at the rate one in the time τ with dτ = β(x) dt. The equation
divided by β(x),

    V = min_u max_d [ L/β + (f/β)·DV + ½ tr((σ/√β)(σ/√β)ᵀ D²V) ],

has the same solution. The same holds for its Markov chain: jump rates are linear in f and σσᵀ, so each row of the chain
is divided by β at its node. The residual becomes r/β, and the additive certificate is V + min r/β ≤ V_h ≤ V + max r/β
with the β of each node. The solvers therefore only need to support constant discounts.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.problem.jump_terms import constant
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered
from hjbjax.problem.types import Array, State


def in_own_time(problem: Problem) -> Problem:
    """The problem in the time τ, dτ = β(x) dt, with discount one; unchanged if its discount is a constant.

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
        noise = jax.tree_util.Partial(constant, noise)
    scaled = {
        "drift": _over(problem.drift, problem.discount, 1),
        "cost": None if problem.cost is None else _over(problem.cost, problem.discount, 1),
        "noise": None if noise is None else _over(noise, problem.discount, 2),
        "mode_rates": None if problem.mode_rates is None else _over(problem.mode_rates, problem.discount, 1),
        "intensities": None if problem.intensities is None else _over(problem.intensities, problem.discount, 1),
    }
    return altered(problem, discount=1.0, discounted=True, **scaled)


def with_killing(problem: Problem) -> Problem:
    """The problem of a march, with β(x) as the killing and discount zero; unchanged if its discount is a constant.

    The time τ cannot be used here, because paths reach the horizon at different τ. The equation of a march has the term
    (discount + killing) V, where the killing depends on the state.
    """
    if not callable(problem.discount):
        return problem
    return altered(problem, discount=0.0, discounted=False, killing=problem.discount)


def _over(function: jax.tree_util.Partial, discount: jax.tree_util.Partial, root: int) -> jax.tree_util.Partial:
    """A function of (x, u) or (x, u, d) divided by the ``root``-th root of β(x), with the leaves of both functions.

    It is a closure, not an object, because the search for numbers that a function reads from outside follows closures.
    """
    above: Callable = function.func
    below: Callable = discount.func

    def scaled(mine: tuple, theirs: tuple, x: State, *actions: Any) -> Array:
        (known, options), (numbers, others) = mine, theirs
        rate = jnp.asarray(below(*numbers, x, **others))
        rate = jnp.where(rate > 0, rate, jnp.nan)  # a negative rate would reverse the time
        return jnp.asarray(above(*known, x, *actions, **options)) / (rate if root == 1 else jnp.sqrt(rate))

    leaves = (function.args, function.keywords), (discount.args, discount.keywords)
    return jax.tree_util.Partial(scaled, *leaves)
