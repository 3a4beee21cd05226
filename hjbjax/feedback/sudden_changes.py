"""Sudden changes along a path: jumps of the state, and changes of the mode at random and by choice.

The state of the loop is (i, x, s, n): the mode, if there are modes, the state, a clock with

    ds = −Σ_j λ_j(x, u, d) dt

that starts from a draw of the exponential law with mean one, and the number of random changes so far. The sum is over
the jumps of the state and the changes to other modes. When the clock reaches zero, the change j happens with
probability λ_j/Σ λ, and the clock starts again. This is the law of the changes, without an error of the steps. The n-th
change has the n-th draw of the key, so that rounding errors in the time of a change do not alter the later changes.
The controller changes the mode where V_i = c_ij + V_j at every surrounding node, and pays c_ij.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.longer_states import with_entries
from hjbjax.feedback.loop import Loop
from hjbjax.feedback.path import Path
from hjbjax.feedback.payments import Lookup, solution_of
from hjbjax.problem.grid import Grid
from hjbjax.problem.mode_axis import with_modes
from hjbjax.problem.modes import Modes
from hjbjax.problem.problem import Problem, changes_at_random
from hjbjax.problem.types import Array, Key, Number

STREAM = 0x6D6F  # folded into the key, so that the draws are independent of the other draws of a path


def rates_of_changes(problem: Problem, arguments: tuple, dtype: Any) -> Array:
    """The rates of the changes to the next modes, then of the jumps of the state, one vector."""
    functions = [each for each in (problem.mode_rates, problem.intensities) if each is not None]
    return jnp.concatenate([jnp.zeros(0, dtype), *(jnp.asarray(each(*arguments), dtype) for each in functions)])


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


def has_clock(problem: Problem, modes: int) -> bool:
    """True if a path may change suddenly; ``modes`` is the number of modes, zero without modes."""
    return bool(modes) or problem.intensities is not None


def with_clock(loop: Loop, x0: Any, key: Key | None, count: int) -> tuple[Loop, Any]:
    """The loop and its start with clock and count appended to the state; unchanged without sudden changes.

    Args:
      loop: the loop of a problem whose state begins with the mode, if there are modes.
      x0: its initial state (i, x).
      key: the key of the path.
      count: the number of modes k; zero without modes.
    """
    problem = loop.problem
    if not has_clock(problem, count):
        return loop, x0
    none = np.zeros((), x0.dtype)
    clock = draws(key, jnp.asarray(none))[1] if changes_at_random(problem) else np.ones((), x0.dtype)
    longer, start = with_entries(loop, x0, (clock, none), _motion)
    return dataclasses.replace(longer, modes=count, clock=len(x0), key=key), start


def _motion(problem: Problem, arguments: tuple) -> Array:
    """The rates of change of clock and count."""
    dtype = arguments[int(problem.time_dependent)].dtype
    return jnp.stack([-jnp.sum(rates_of_changes(problem, arguments, dtype)), jnp.zeros((), dtype)])


def draws(key: Key | None, n: jax.Array) -> tuple[Array, Array]:
    """A uniform number, and a number of the exponential law with mean one, for the n-th change."""
    assert key is not None  # a problem with random changes has a key
    which, when = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, STREAM), n.astype(np.uint32)))
    return jax.random.uniform(which, (), n.dtype), jax.random.exponential(when, (), n.dtype)


def after_chance(loop: Loop, t: jax.Array, y: jax.Array, start: Number) -> jax.Array:
    """The state and the running cost after the random change that is due at the time t.

    Args:
      loop: the loop.
      t: the time.
      y: the state of the loop, then the running cost.
      start: the first time of the path, where discounting starts.
    """
    if not changes_at_random(loop.problem):
        return y
    x, paid = _after_chance(loop, t, y[:-1])
    return jnp.append(x, y[-1] + loop.discount(t - start) * paid)


def after_choice(loop: Loop, t: Number, y: jax.Array, start: Number) -> jax.Array:
    """The state and the running cost after the change of the mode that the controller makes at the time t."""
    if loop.switch is None:
        return y
    x, problem = y[:-1], loop.problem
    surplus = loop.switch(t, loop.wrap(x))
    costs = jnp.asarray(problem.switching_costs(*problem.state_arguments(loop.at_node(x), t)), x.dtype)
    number, due = 1 + jnp.argmin(surplus[1:]), surplus[0] <= 0
    cost = y[-1] + jnp.where(due, loop.discount(jnp.asarray(t - start, x.dtype)) * costs[number - 1], 0)
    return jnp.append(jnp.where(due, _in_mode(loop, x, number), x), cost)


def _after_chance(loop: Loop, t: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The state after the random change that is due at the time t, if one is, and the cost of the jump."""
    problem = loop.problem
    arguments = problem.arguments(loop.wrap(x), *loop.players(t, x), t)
    edges, count = jnp.cumsum(jnp.maximum(rates_of_changes(problem, arguments, x.dtype), 0)), x[loop.clock + 1] + 1
    which, clock = draws(loop.key, count)
    number = jnp.minimum(jnp.searchsorted(edges, which * edges[-1], side="right"), len(edges) - 1)
    changed, paid = _in_mode(loop, x, number + 1) if loop.modes else x, jnp.zeros((), x.dtype)
    if problem.intensities is not None:
        jump = number - (0 if problem.mode_rates is None else loop.modes - 1)
        first, after = int(loop.modes > 0), jnp.asarray(problem.landings(*arguments), x.dtype)[jnp.maximum(jump, 0)]
        changed = jnp.where(jump >= 0, x.at[first : first + len(after)].set(after), changed)
        if problem.jump_costs is not None:
            costs = jnp.asarray(problem.jump_costs(*arguments), x.dtype)
            paid = jnp.where(jump >= 0, costs[jnp.maximum(jump, 0)], 0)
    changed = changed.at[loop.clock : loop.clock + 2].set(jnp.stack([clock, count]))
    due = x[loop.clock] <= 0
    return jnp.where(due, changed, x), jnp.where(due, paid, 0)


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


def without_clock(path: Path, problem: Problem, count: int) -> Path:
    """The path without clock and count; its states begin with the mode, if there are modes."""
    return dataclasses.replace(path, states=path.states[:, :-2]) if has_clock(problem, count) else path


def with_modes_apart(path: Path, count: int) -> Path:
    """The path with the modes in a field of their own; unchanged without modes."""
    if not count:
        return path
    xp: Any = np if isinstance(path.states, np.ndarray) else jnp
    modes = xp.rint(path.states[..., 0]).astype(int)
    return dataclasses.replace(path, states=path.states[..., 1:], modes=modes)
