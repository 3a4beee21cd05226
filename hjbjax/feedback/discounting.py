"""Simulation with a discount that is a function of the state: ∫ β dt along the path is one more state.

Let z = ∫ β(x(s)) ds. The loop with the state (x, z) has no discount, and its payments are e^{−z} times the payments of
the problem. The integrator therefore only needs to support constant discounts.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.loop import Loop, with_entry
from hjbjax.feedback.path import Path
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, as_partial, pytree_dataclass
from hjbjax.problem.types import Array, Number, State

PAYMENTS = ("cost", "exit_cost", "terminal_cost", "stopping_cost", "switching_costs", "jump_costs")
UNPAID = ("target", "mode_rates", "intensities", "landings")  # functions that are no payments


@pytree_dataclass(static=("name",))
class Weighted:
    """A function of a problem as a function of the state (x, z); payments are multiplied by e^{−z}."""

    problem: Problem
    name: str

    def __call__(self, *arguments: Any) -> Array:
        """The value at the problem's arguments, with (x, z) instead of x."""
        problem, place = self.problem, int(self.problem.time_dependent)
        x, z = arguments[place][:-1], arguments[place][-1]
        own = (*arguments[:place], x, *arguments[place + 1 :])
        if self.name == "drift":
            rate = jnp.asarray(problem.discount(*own[: place + 1]), x.dtype)
            return jnp.append(jnp.asarray(problem.drift(*own), x.dtype), rate)
        if self.name == "noise":
            t = own[0] if place else 0.0
            sigma = problem.diffusion(x, own[place + 1], own[place + 2] if problem.is_game else None, t)
            return jnp.pad(sigma, ((0, 1), (0, 0)))
        ingredient = getattr(problem, self.name)
        found = ingredient(*own) if callable(ingredient) else ingredient
        return found if self.name in UNPAID else jnp.exp(-z) * jnp.asarray(found, x.dtype)


def with_integral(loop: Loop, x0: Any) -> tuple[Loop, Any]:
    """The loop and its start with z appended to the state; unchanged if the discount is a constant."""
    problem = loop.problem
    if not callable(problem.discount):
        return loop, x0
    names = ["drift", *(name for name in (*UNPAID, *PAYMENTS) if getattr(problem, name) is not None)]
    changed: dict[str, Any] = {name: as_partial(Weighted(problem, name)) for name in names}
    if callable(problem.noise):
        changed["noise"] = as_partial(Weighted(problem, "noise"))
    elif problem.noise is not None:  # a matrix keeps the higher order of the integrator for additive noise
        changed["noise"] = jnp.pad(problem.diffusion(jnp.zeros(np.shape(x0)), jnp.zeros(0)), ((0, 1), (0, 0)))
    longer, start = with_entry(loop, altered(problem, discount=0.0, discounted=False, **changed), x0, 0.0)
    last = None if loop.at_horizon is None else jax.tree_util.Partial(_weighted_look, as_partial(loop.at_horizon))
    return dataclasses.replace(longer, at_horizon=last), start


def without_integral(path: Path, problem: Problem) -> tuple[Path, Any]:
    """The path without z, and e^{−∫ β dt} at every output time."""
    if not callable(problem.discount):
        times = path.times - path.times[0]
        return path, np.exp(-np.asarray(problem.discount) * times) if isinstance(times, np.ndarray) else None
    z = path.states[:, -1]
    return dataclasses.replace(path, states=path.states[:, :-1]), np.exp(-z) if isinstance(z, np.ndarray) else None


def _weighted_look(function: Callable, t: Number, y: State) -> Array:
    return jnp.exp(-y[-1]) * function(t, y[:-1])
