"""Closed loops whose state has further entries, such as a clock or an integral along the path.

A loop of (x, y) moves x as before and y by dy = r(x, u, d) dt. The players and the functions of the problem do not see
y. Its payments may be multiplied by a weight w(y), for example by a discount factor.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.loop import Loop
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, as_partial, pytree_dataclass
from hjbjax.problem.types import Array, Number, State

BEYOND = 1e30  # an end of the box that an entry of the state never reaches
PAYMENTS = ("cost", "exit_cost", "terminal_cost", "stopping_cost", "switching_costs", "jump_costs")
UNPAID = ("drift", "target", "growth", "mode_rates", "intensities", "landings")
SEEN = ("control", "opponent", "surplus", "at_horizon", "switch", "push")  # functions of the loop, of (t, x)

Motion = Callable[[Problem, tuple], Array]  # r, from a problem and the arguments of its functions


@pytree_dataclass(static=("name", "count", "motion", "weight"))
class OfLongerState:
    """A function of a problem as a function of the longer state.

    Args:
      problem: the problem of the shorter state.
      name: the name of the function, or of the number.
      count: the number of further entries, which come last.
      motion: r.
      weight: w; None for one.
    """

    problem: Problem
    name: str
    count: int
    motion: Motion
    weight: Callable | None

    def __call__(self, *arguments: Any) -> Array:
        """The value at the problem's arguments, with (x, y) instead of x."""
        problem, place = self.problem, int(self.problem.time_dependent)
        x, more = arguments[place][: -self.count], arguments[place][-self.count :]
        own = (*arguments[:place], x, *arguments[place + 1 :])
        if self.name == "noise":
            t = own[0] if place else 0.0
            sigma = problem.diffusion(x, own[place + 1], own[place + 2] if problem.is_game else None, t)
            return jnp.pad(sigma, ((0, self.count), (0, 0)))
        ingredient = getattr(problem, self.name)
        found = ingredient(*own) if callable(ingredient) else ingredient
        if self.name == "drift":
            return jnp.append(jnp.asarray(found, x.dtype), self.motion(problem, own).astype(x.dtype))
        if self.weight is None or self.name not in PAYMENTS:
            return found
        return self.weight(more) * jnp.asarray(found, x.dtype)


def with_entries(
    loop: Loop, x0: Any, first: Sequence, motion: Motion, weight: Callable | None = None
) -> tuple[Loop, Any]:
    """The loop and its start, with the state extended by entries that have no bounds.

    Args:
      loop: the loop.
      x0: its start.
      first: the further entries at the start.
      motion: r, a module-level function, because it is part of the compiled program.
      weight: w(y), the factor of all payments, also a module-level function; None for one.
    """
    problem, grid, count = loop.problem, loop.grid, len(first)
    names = [name for name in (*UNPAID, *PAYMENTS) if getattr(problem, name) is not None]
    names += [name for name in ("discount", "noise") if callable(getattr(problem, name))]
    changed: dict[str, Any] = {name: as_partial(OfLongerState(problem, name, count, motion, weight)) for name in names}
    if "noise" not in changed and problem.noise is not None:  # a matrix keeps the higher order for additive noise
        changed["noise"] = jnp.pad(problem.diffusion(jnp.zeros(np.shape(x0)), jnp.zeros(0)), ((0, count), (0, 0)))
    if grid is not None:
        lo, hi = (
            jnp.append(jnp.asarray(corner), jnp.full(count, end))
            for corner, end in ((grid.lo, -BEYOND), (grid.hi, BEYOND))
        )
        grid = Grid(lo, hi, (*grid.shape, *(2,) * count), (*grid.periodic, *(False,) * count))
    seen: dict[str, Any] = {name: _of_shorter(getattr(loop, name), count) for name in SEEN}
    xp: Any = np if isinstance(x0, np.ndarray) and not any(isinstance(each, jax.Array) for each in first) else jnp
    start = xp.append(x0, xp.asarray(first, x0.dtype))
    return dataclasses.replace(loop, problem=altered(problem, **changed), grid=grid, **seen), start


def _of_shorter(function: Callable | None, count: int) -> jax.tree_util.Partial | None:
    """A function of (t, x) as a function of (t, (x, y))."""
    return None if function is None else as_partial(_OfStart(as_partial(function), count))


@pytree_dataclass(static=("count",))
class _OfStart:
    """A function of (t, x) as a function of (t, (x, y)), with ``count`` entries in y."""

    function: Any
    count: int

    def __call__(self, t: Number, state: State) -> Array:
        return self.function(t, state[: -self.count])
