"""Simulation with a discount that is not constant: ∫ (β − g) dt along the path is one more entry of the state.

Let z = ∫ (β(x) − g(x, u)) ds. The loop with the state (x, z) has no discount, and its payments are e^{−z} times the
payments of the problem. The integrator therefore only needs to support constant discounts.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.longer_states import with_entries
from hjbjax.feedback.loop import Loop
from hjbjax.feedback.path import Path
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered
from hjbjax.problem.time_change import has_variable_discount
from hjbjax.problem.types import Array, Number, State


def with_integral(loop: Loop, x0: Any) -> tuple[Loop, Any]:
    """The loop and its start with z appended to the state; unchanged with a constant discount and no growth."""
    if not has_variable_discount(loop.problem):
        return loop, x0
    longer, start = with_entries(loop, x0, (0.0,), _rate, _weight)
    undiscounted = altered(longer.problem, discount=0.0, discounted=False, growth=None)
    paid = {"at_horizon": _weighted_value, "push": _weighted_cost}
    seen = {name: getattr(longer, name) for name in paid}
    changed = {name: each and jax.tree_util.Partial(paid[name], each) for name, each in seen.items()}
    return altered(longer, problem=undiscounted, **changed), start


def without_integral(path: Path, problem: Problem) -> tuple[Path, Any]:
    """The path without z, and e^{−z} at every output time."""
    if not has_variable_discount(problem):
        times = path.times - path.times[0]
        return path, np.exp(-np.asarray(problem.discount) * times) if isinstance(times, np.ndarray) else None
    z = path.states[:, -1]
    return dataclasses.replace(path, states=path.states[:, :-1]), np.exp(-z) if isinstance(z, np.ndarray) else None


def _rate(problem: Problem, arguments: tuple) -> Array:
    """dz/dt = β − g."""
    where, discount, growth = arguments[: int(problem.time_dependent) + 1], problem.discount, problem.growth
    rate = jnp.asarray(discount(*where) if callable(discount) else discount)
    return rate if growth is None else rate - jnp.asarray(growth(*arguments))


def _weight(entries: Array) -> Array:
    """The discount factor e^{−z}."""
    return jnp.exp(-entries[-1])


def _weighted_value(function: Callable, t: Number, y: State) -> Array:
    return _weight(y) * function(t, y)


def _weighted_cost(push: Callable, t: Number, y: State) -> Array:
    """The way of a push, with its discounted cost as the last entry."""
    found = push(t, y)
    return found.at[-1].multiply(_weight(y))
