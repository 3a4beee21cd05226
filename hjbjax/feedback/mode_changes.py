"""Changes of the mode along a path, at random and by choice.

The state of the loop is (i, x, s, n): the mode, the state, a clock with

    ds = −Σ_j λ_ij(x, u, d) dt

that starts from a draw of the exponential law with mean one, and the number of random changes so far. When the clock
reaches zero, the mode changes to j with probability λ_ij/Σ_j λ_ij, and the clock starts again. This is the law of the
changes, without an error of the steps. The n-th change has the n-th draw of the key, so that rounding errors in the
time of a change do not alter the later changes.
The controller changes the mode where V_i = c_ij + V_j at every surrounding node, and pays c_ij.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.loop import Loop, with_entry
from hjbjax.feedback.path import Path
from hjbjax.feedback.payments import Lookup, solution_of
from hjbjax.problem.grid import Grid
from hjbjax.problem.mode_axis import with_modes
from hjbjax.problem.modes import Modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, as_partial, pytree_dataclass
from hjbjax.problem.types import Array, Key, Number

STREAM = 0x6D6F  # folded into the key, so that the draws are independent of the other draws of a path
STATE_COSTS = ("exit_cost", "terminal_cost", "stopping_cost", "target", "switching_costs")


@pytree_dataclass(static=("name",))
class Clocked:
    """A function of a problem whose state begins with the mode, as a function of the state with clock and count."""

    problem: Problem
    name: str

    def __call__(self, *arguments: Any) -> Array:
        """The value at the problem's arguments, with (i, x, s, n) instead of (i, x)."""
        problem, place = self.problem, int(self.problem.time_dependent)
        z = arguments[place][:-2]
        own = (*arguments[:place], z, *arguments[place + 1 :])
        if self.name == "noise":
            t = own[0] if place else 0.0
            sigma = problem.diffusion(z, own[place + 1], own[place + 2] if problem.is_game else None, t)
            return jnp.pad(sigma, ((0, 2), (0, 0)))
        ingredient = getattr(problem, self.name)
        found = ingredient(*own) if callable(ingredient) else ingredient
        if self.name != "drift":
            return found
        leaving = 0.0 if problem.mode_rates is None else jnp.sum(problem.mode_rates(*own))
        return jnp.append(
            jnp.asarray(found, z.dtype), jnp.stack([jnp.asarray(-leaving, z.dtype), jnp.zeros((), z.dtype)])
        )


def refuse_mode(modes: Modes | None, mode: object, name: str) -> None:
    """Refuse a mode of a problem without modes, or its absence in a problem with modes.

    Raises:
      ValueError: names the modes.
    """
    if modes is None and mode is not None:
        raise ValueError(f"{name}: got mode = {mode!r}, but the problem has no modes; leave out mode")
    if modes is not None and mode is None:
        raise ValueError(
            f"{name}: the problem has the modes {modes.names!r}; give the first one, as in mode={modes.names[0]!r}"
        )


def with_first_mode(modes: Modes | None, x0: Any, mode: str | int | None, name: str) -> Any:
    """The initial state that begins with the mode; unchanged without modes."""
    refuse_mode(modes, mode, name)
    if modes is None or mode is None:
        return x0
    xp: Any = jnp if isinstance(x0, jax.Array) else np
    start = xp.asarray(x0)
    number = xp.asarray([modes.number(mode)], start.dtype if start.dtype.kind == "f" else float)
    return xp.concatenate([number, start])


def grid_of_modes(grid: Grid | None, modes: Modes | None) -> Grid | None:
    """A user's grid with the modes as its first axis."""
    return grid if grid is None or modes is None else with_modes(grid, modes.names)


def with_clock(loop: Loop, x0: Any, key: Key | None, count: int) -> tuple[Loop, Any]:
    """The loop and its start with clock and count appended to the state; unchanged without modes.

    Args:
      loop: the loop of a problem whose state begins with the mode.
      x0: its initial state (i, x).
      key: the key of the path.
      count: the number of modes k; zero without modes.
    """
    problem = loop.problem
    if not count:
        return loop, x0
    names = ["drift", *(name for name in ("cost", "mode_rates", *STATE_COSTS) if getattr(problem, name) is not None)]
    names += ["discount"] * callable(problem.discount)
    changed: dict[str, Any] = {name: as_partial(Clocked(problem, name)) for name in names}
    if callable(problem.noise):
        changed["noise"] = as_partial(Clocked(problem, "noise"))
    elif problem.noise is not None:
        changed["noise"] = jnp.pad(problem.diffusion(jnp.zeros(np.shape(x0)), jnp.zeros(0)), ((0, 2), (0, 0)))
    none = jnp.zeros((), x0.dtype)
    longer, start = loop, x0
    for first in (jnp.ones((), x0.dtype) if problem.mode_rates is None else draws(key, none)[1], none):
        longer, start = with_entry(longer, altered(problem, **changed), start, first)
    return dataclasses.replace(longer, modes=count, clock=len(x0), key=key), start


def draws(key: Key | None, n: jax.Array) -> tuple[Array, Array]:
    """A uniform number, and a number of the exponential law with mean one, for the n-th change."""
    assert key is not None  # a problem with random changes has a key
    which, when = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, STREAM), n.astype(np.uint32)))
    return jax.random.uniform(which, (), n.dtype), jax.random.exponential(when, (), n.dtype)


def after_changes(loop: Loop, t: jax.Array, y: jax.Array, start: Number) -> jax.Array:
    """The state and the running cost after the changes of the mode that are due at the time t.

    Args:
      loop: the loop with its clock.
      t: the time.
      y: the state of the loop, then the running cost.
      start: the first time of the path, where discounting starts.
    """
    x, cost, problem = y[:-1], y[-1], loop.problem
    if problem.mode_rates is not None:
        rates = problem.mode_rates(*problem.arguments(loop.wrap(x), *loop.players(t, x), t))
        edges = jnp.cumsum(jnp.maximum(jnp.asarray(rates, x.dtype), 0))
        count = x[loop.clock + 1] + 1
        which, clock = draws(loop.key, count)
        number = 1 + jnp.minimum(jnp.searchsorted(edges, which * edges[-1], side="right"), len(edges) - 1)
        changed = _in_mode(loop, x, number).at[loop.clock : loop.clock + 2].set(jnp.stack([clock, count]))
        x = jnp.where(x[loop.clock] <= 0, changed, x)
    if loop.switch is not None:
        for _ in range(loop.modes - 1):  # a cheapest path of changes has at most k − 1 of them
            surplus = loop.switch(t, loop.wrap(x))
            number = 1 + jnp.argmin(surplus[1:])
            costs = jnp.asarray(problem.switching_costs(*problem.state_arguments(loop.wrap(x), t)), x.dtype)
            due = surplus[0] <= 0
            cost = cost + jnp.where(due, loop.discount(t - start) * costs[number - 1], 0)
            x = jnp.where(due, _in_mode(loop, x, number), x)
    return jnp.append(x, cost)


def _in_mode(loop: Loop, x: jax.Array, number: jax.Array) -> jax.Array:
    """The state after a change of the mode by ``number``, modulo the number of modes."""
    return x.at[0].set((x[0] + number.astype(x.dtype)) % loop.modes)


def switching_surplus(problem: Problem, feedback: object) -> Lookup | None:
    """min_j (c_ij + V_j) − V_i between the nodes, and its terms, (k,); None if the controller changes no mode.

    The first entry is zero or less where the mode is changed.
    """
    solution = solution_of(feedback)
    if problem.switching_costs is None or solution is None:
        return None
    value, grid = jnp.asarray(solution.value), solution.grid
    axis = value.ndim - grid.ndim
    size = jnp.max(jnp.where(jnp.isfinite(value), jnp.abs(value), 0))
    rounding = 16 * jnp.finfo(value.dtype).eps * size + (solution.residual or 0.0)  # as in ``Solution.switching``
    costs = _costs_at_nodes(problem, grid, value.dtype, solution.times)
    terms = [cost + jnp.roll(value, -k, axis) - value - rounding for k, cost in enumerate(costs, start=1)]
    terms = [jnp.where(jnp.isnan(term), jnp.inf, term) for term in terms]
    least = jnp.min(jnp.stack(terms), axis=0)
    return Lookup(grid, jnp.stack([least, *terms], axis=-1), solution.times)


def _costs_at_nodes(problem: Problem, grid: Grid, dtype: Any, times: Any) -> list[Array]:
    """The costs of changing the mode by 1, ..., k − 1, (*grid) each, in a time-dependent march (times, *grid)."""
    nodes = jnp.stack(jnp.broadcast_arrays(*grid.components(dtype)), axis=-1).reshape(-1, grid.ndim)

    def at(t: Number) -> Array:
        found = jax.vmap(lambda z: problem.switching_costs(*problem.state_arguments(z, t)))(nodes)
        return jnp.moveaxis(jnp.asarray(found, dtype).reshape(*grid.shape, -1), -1, 0)

    if times is None or not problem.time_dependent:
        return list(at(0.0))
    return list(jnp.moveaxis(jax.vmap(at)(jnp.asarray(times, dtype)), 1, 0))


def without_clock(path: Path, count: int) -> Path:
    """The path without clock and count; its states begin with the mode."""
    return dataclasses.replace(path, states=path.states[:, :-2]) if count else path


def with_modes_apart(path: Path, count: int) -> Path:
    """The path with the modes in a field of their own; unchanged without modes."""
    if not count:
        return path
    xp: Any = np if isinstance(path.states, np.ndarray) else jnp
    modes = xp.rint(path.states[..., 0]).astype(int)
    return dataclasses.replace(path, states=path.states[..., 1:], modes=modes)
