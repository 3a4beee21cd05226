"""Discounts that are functions of the state or of the control, for problems without a horizon.

Discounting at the rate β(x) in the time t is discounting at the rate one in the time τ with dτ = β(x) dt. The equation
divided by β(x),

    V = min_u max_d [ L/β + (f/β)·DV + ½ tr((σ/√β)(σ/√β)ᵀ D²V) ],

has the same solution. The same holds for its Markov chain: jump rates are linear in f and σσᵀ, so each row of the chain
is divided by β at its node. The residual becomes r/β, and the additive certificate is V + min r/β ≤ V_h ≤ V + max r/β
with the β of each node. The solvers therefore only need to support constant discounts.

With growth g(x, u) of the payments the discount β − g depends on the control. A solver splits it into its least value
b > 0, which is the constant discount, and the rest β − g − b ≥ 0, which stays under the minimum as minus a growth:

    min_u [ L + f·DV + ... − (β − g − b) V ] = b V.

A minimum that is exact without growth stays exact if g is affine in u. The rows of the chain then lose mass, at the
rate β − g − b, so a constant shift of V changes the residual by at least b per unit, and the bounds are V + min(r, 0)/b
and V + max(r, 0)/b. For an export with one factor for all states, the time τ runs at the rate β − g instead.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.problem.jump_terms import constant_function
from hjbjax.problem.problem import Problem, known_sign
from hjbjax.problem.pytree import altered
from hjbjax.problem.types import Array, Number, State


def in_own_time(problem: Problem) -> Problem:
    """The problem in the time τ, dτ = (β − g) dt, with discount one; unchanged with a constant discount and no growth.

    Where β − g ≤ 0 the functions of the new problem are NaN.

    Example:
      >>> problem = Problem(lambda x, u: x, lambda x, u: 1.0, noise=3.0, discount=lambda x: 4.0 + 0 * x[0])
      >>> scaled, x = in_own_time(problem), jnp.ones(1)
      >>> scaled.discount, float(scaled.drift(x, None)[0]), float(scaled.cost(x, None)), float(scaled.noise(x, None))
      (1.0, 0.25, 0.25, 1.5)
    """
    if not has_variable_discount(problem):
        return problem
    noise, rate = problem.noise, net_discount(problem)
    if noise is not None and not callable(noise):
        noise = jax.tree_util.Partial(constant_function, noise)
    scaled = {
        "drift": _over(problem.drift, rate, 1),
        "noise": None if noise is None else _over(noise, rate, 2),
    }
    for name in ("cost", "mode_rates", "intensities"):
        function = getattr(problem, name)
        scaled[name] = None if function is None else _over(function, rate, 1)
    return altered(problem, discount=1.0, discounted=True, growth=None, **scaled)


def with_least_discount(problem: Problem, least: Number) -> Problem:
    """The problem with the discount ``least``, and the rest of β − g as minus a growth; unchanged without growth."""
    if problem.growth is None:
        return problem
    growth = _least_less(net_discount(problem), least)
    return altered(problem, discount=least, discounted=True, growth=growth)


def net_discount(problem: Problem) -> jax.tree_util.Partial:
    """β(x) − g(x, u, d) as a function of the arguments of the drift, without the time."""
    discount, growth = problem.discount, problem.growth
    if not callable(discount):
        discount = jax.tree_util.Partial(constant_function, discount)
    return _without_growth(discount) if growth is None else _less_growth(discount, growth)


def has_variable_discount(problem: Problem) -> bool:
    """True if the payments are not discounted at a constant rate."""
    return callable(problem.discount) or problem.growth is not None


def with_killing(problem: Problem) -> Problem:
    """The problem of a march, with β(x) as the killing and discount zero; unchanged if its discount is a constant.

    The time τ cannot be used here, because paths reach the horizon at different τ. The equation of a march has the term
    (discount + killing) V, where the killing depends on the state, and g V under the minimum.
    """
    if callable(problem.discount):
        return altered(problem, discount=0.0, discounted=False, killing=problem.discount)
    return problem if problem.growth is None else altered(problem, discounted=known_sign(problem.discount))


# These are closures, not objects, because the search for numbers that a function reads from outside follows closures.


def _without_growth(discount: jax.tree_util.Partial) -> jax.tree_util.Partial:
    """A function of x as a function of (x, u) or (x, u, d)."""
    below: Callable = discount.func

    def rate(theirs: tuple, x: State, *actions: Any) -> Array:
        numbers, others = theirs
        return below(*numbers, x, **others)

    return jax.tree_util.Partial(rate, (discount.args, discount.keywords))


def _less_growth(discount: jax.tree_util.Partial, growth: jax.tree_util.Partial) -> jax.tree_util.Partial:
    """A function of x minus a function of (x, u) or (x, u, d)."""
    first: Callable = discount.func
    second: Callable = growth.func

    def rate(theirs: tuple, mine: tuple, x: State, *actions: Any) -> Array:
        (numbers, others), (known, options) = theirs, mine
        return jnp.asarray(first(*numbers, x, **others)) - jnp.asarray(second(*known, x, *actions, **options))

    leaves = (discount.args, discount.keywords), (growth.args, growth.keywords)
    return jax.tree_util.Partial(rate, *leaves)


def _least_less(net: jax.tree_util.Partial, least: Number) -> jax.tree_util.Partial:
    """A number minus a function of (x, u) or (x, u, d)."""
    below: Callable = net.func

    def growth(number: Number, theirs: tuple, *arguments: Any) -> Array:
        numbers, others = theirs
        return number - jnp.asarray(below(*numbers, *arguments, **others))

    return jax.tree_util.Partial(growth, least, (net.args, net.keywords))


def _over(function: jax.tree_util.Partial, discount: jax.tree_util.Partial, root: int) -> jax.tree_util.Partial:
    """A function of (x, u) or (x, u, d) divided by the ``root``-th root of the net discount, with all leaves."""
    above: Callable = function.func
    below: Callable = discount.func

    def scaled(mine: tuple, theirs: tuple, x: State, *actions: Any) -> Array:
        (known, options), (numbers, others) = mine, theirs
        rate = jnp.asarray(below(*numbers, x, *actions, **others))
        rate = jnp.where(rate > 0, rate, jnp.nan)  # a negative rate would reverse the time
        return jnp.asarray(above(*known, x, *actions, **options)) / (rate if root == 1 else jnp.sqrt(rate))

    leaves = (function.args, function.keywords), (discount.args, discount.keywords)
    return jax.tree_util.Partial(scaled, *leaves)
