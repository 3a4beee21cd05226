"""A problem with modes as a problem without modes, whose state z = (i, x) begins with the number i of the mode.

On the grid the modes are the first axis, with one node per mode. No drift and no noise acts along it. Instead the chain
jumps along it, from mode i to mode i + d modulo k at the rate λ_{i, i+d}, for d = 1, ..., k − 1. The solvers therefore
only need jumps over several nodes of one axis.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.jump_terms import OF_JUMPS
from hjbjax.problem.jumps import Jump
from hjbjax.problem.modes import Modes
from hjbjax.problem.problem import PAYMENTS, Problem
from hjbjax.problem.pushes import Push, marginal_costs
from hjbjax.problem.pytree import REMEMBERED, altered, as_partial, is_traced
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Array, Number

OF_STATE = ("target", "exit_cost", "terminal_cost", "stopping_cost", "running_max")


def in_mode(problem: Problem, mode: int) -> Problem:
    """The problem in one mode, without changes of the mode."""
    names = ("drift", "cost", "noise", "growth", *OF_STATE, *PAYMENTS, "discount", "controls")
    fixed = {name: _in_mode(each, mode) for name in names if callable(each := getattr(problem, name))}
    jumps = tuple(_jump_in_mode(jump, mode) for jump in problem.jumps)
    pushes = tuple(_push_in_mode(push, mode) for push in problem.pushes)
    return altered(problem, modes=None, jumps=jumps, pushes=pushes, **fixed)


def over_modes(problem: Problem, n: int) -> Problem:
    """The problem whose state begins with the mode, and whose pushes are one function; unchanged without both.

    Args:
      problem: the problem, with costs.
      n: the number of its states, without the mode.

    Example:
      >>> from hjbjax.problem.modes import Modes
      >>> problem = Problem(lambda x, u, mode: (1.0, -2.0)[mode] * x, modes=Modes(("up", "down"), [[0, 3], [4, 0]]))
      >>> joined, z = over_modes(problem, 1), jnp.array([1.0, 5.0])
      >>> joined.drift(z, None).tolist(), joined.mode_rates(z, None).tolist()
      ([0.0, -10.0], [4.0])
    """
    if problem.pushes:
        steps = tuple(push.step for push in problem.pushes)
        problem = altered(problem, pushes=(), push_costs=marginal_costs(problem.pushes), push_steps=steps)
    modes = problem.modes
    if modes is None:
        return problem
    count, place = len(modes.names), int(problem.time_dependent)
    fixed = {
        name: _over(each, count, place)
        for name in ("cost", "growth", *OF_STATE, *OF_JUMPS, "push_costs", "discount", "controls")
        if callable(each := getattr(problem, name))
    }
    rates, costs = modes.rates, modes.switching_cost
    return altered(
        problem,
        modes=None,
        drift=_over(problem.drift, count, place, _after_zero),
        noise=_noise(problem.noise, n, count, place),
        mode_rates=None if rates is None else _table(rates, count, place),
        switching_costs=None if costs is None else _table(costs, count, place),
        push_steps=tuple((axis + 1, step) for axis, step in problem.push_steps),
        **fixed,
    )


def with_modes(grid: Grid, names: Sequence[str]) -> Grid:
    """The grid with the modes as its first axis, periodic, with nodes 0, 1, ..., k − 1; unchanged without names.

    Raises:
      ValueError: the grid has an axis of other modes.
    """
    count = len(names)
    if count and grid.modes and grid.modes != tuple(names):
        raise ValueError(
            f"grid: got a grid with the modes {grid.modes!r}, but the problem has the modes {tuple(names)!r}; wanted "
            "the same modes,\nor a grid without modes, such as the one that was passed to solve"
        )
    if not count or grid.modes:
        return grid
    xp: Any = jnp if is_traced(grid.lo, grid.hi) else np
    lo, hi = (
        xp.concatenate([xp.asarray([end], xp.asarray(corner).dtype), xp.asarray(corner)])
        for end, corner in ((0.0, grid.lo), (float(count), grid.hi))
    )
    changed = {
        "lo": lo, "hi": hi, "shape": (count, *grid.shape), "periodic": (True, *grid.periodic),
        "names": ("mode", *grid.names), "stretch": (None, *grid.stretch), "edges": (None, *grid.edges),
        "units": ("", *grid.units), "modes": tuple(names),
        "_coordinates": (np.arange(count, dtype=np.float64), *grid._coordinates),
        "_faces": (None, *jax.tree.map(lambda end: end[None] if np.ndim(end) else end, grid._faces)),
    }  # fmt: skip
    return altered(grid, **changed)


def without_modes(grid: Grid) -> Grid:
    """The grid of the states without the modes."""
    if not grid.modes:
        return grid
    fields = ("lo", "hi", "shape", "periodic", "names", "stretch", "edges", "units", "_coordinates")
    rest = {name: getattr(grid, name)[1:] for name in fields}
    faces = jax.tree.map(lambda end: end[0] if np.ndim(end) else end, grid._faces[1:])
    return altered(grid, modes=(), _faces=faces, **rest)


def _push_in_mode(push: Push, mode: int) -> Push:
    """A push in one mode."""
    names = [name for name in ("cost", "reward") if callable(getattr(push, name))]
    return altered(push, **{name: _in_mode(getattr(push, name), mode) for name in names})


def _in_mode(function: jax.tree_util.Partial, mode: int) -> jax.tree_util.Partial:
    """A function with its last argument fixed."""
    return jax.tree_util.Partial(_fixed(function.func, mode), (function.args, function.keywords))


def _jump_in_mode(jump: Jump, mode: int) -> Jump:
    """A jump whose functions have their last argument fixed."""
    functions = {name: getattr(jump, name) for name in ("rate", "landing", "cost", "reward")}
    return altered(jump, **{name: _in_mode(each, mode) for name, each in functions.items() if callable(each)})


def _over(
    function: jax.tree_util.Partial, count: int, place: int, then: Callable | None = None
) -> jax.tree_util.Partial:
    """A function of (x, ..., mode) as a function of (z, ...); ``place`` is the position of the state."""
    return jax.tree_util.Partial(_joined(function.func, count, place, then), (function.args, function.keywords))


# Both are closures, not objects, because the search for numbers that a function reads from outside follows closures.
# The same closure for the same function: otherwise every solve would repeat the checks on one state.


@functools.lru_cache(maxsize=REMEMBERED)
def _fixed(below: Callable, mode: int) -> Callable:
    """A function with its last argument fixed, of its leaves and the other arguments."""

    def fixed(leaves: tuple, *arguments: Any) -> Any:
        numbers, options = leaves
        return below(*numbers, *arguments, mode, **options)

    return fixed


@functools.lru_cache(maxsize=REMEMBERED)
def _joined(below: Callable, count: int, place: int, then: Callable | None) -> Callable:
    """A function of (x, ..., mode) as a function of its leaves and (z, ...)."""

    def joined(leaves: tuple, *arguments: Any) -> Any:
        (numbers, options), z = leaves, arguments[place]
        before, after = arguments[:place], arguments[place + 1 :]
        found = chosen(z[0], [below(*numbers, *before, z[1:], *after, mode, **options) for mode in range(count)])
        return found if then is None else then(found, z[1:])

    return joined


def chosen(mode: Number, each: Sequence[Any]) -> Any:
    """The entry of a list that belongs to the mode; of boxes, a box."""
    if isinstance(each[0], Box):
        return Box(chosen(mode, [box.lo for box in each]), chosen(mode, [box.hi for box in each]))
    found = jnp.asarray(each[0])
    for number, entry in enumerate(each[1:], start=1):
        found = jnp.where(mode > number - 0.5, jnp.asarray(entry), found)
    return found


def _after_zero(entries: Array, x: Array) -> Array:
    """The entries, or rows, of the states after a zero for the mode; a number stands for every state."""
    entries = jnp.asarray(entries)
    if entries.ndim == 0:
        entries = entries * jnp.ones(x.shape, entries.dtype)
    return jnp.concatenate([jnp.zeros((1, *entries.shape[1:]), entries.dtype), entries])


def _noise(noise: Any, n: int, count: int, place: int) -> Any:
    """σ of the states as σ of the mode and the states."""
    if noise is None:
        return None
    if callable(noise):
        return _over(noise, count, place, _after_zero)
    xp: Any = jnp if is_traced(noise) else np
    entries = noise * xp.ones(n) if np.ndim(noise) == 0 else xp.asarray(noise)
    return xp.concatenate([xp.zeros((1, *entries.shape[1:]), entries.dtype), entries])


def _table(table: Any, count: int, place: int) -> jax.tree_util.Partial:
    """A table of k x k numbers, or a function that returns it, as a function of z: the entries (i, i + d), d > 0."""
    if not callable(table):
        return jax.tree_util.Partial(_row(None, count, place), table)
    return jax.tree_util.Partial(_row(table.func, count, place), (table.args, table.keywords))


@functools.lru_cache(maxsize=REMEMBERED)
def _row(below: Callable | None, count: int, place: int) -> Callable:
    """The entries (i, i + d), d > 0, of a table as a function of the table, or of its leaves, and (z, ...)."""

    def row(leaves: Any, *arguments: Any) -> Array:
        z, entries = arguments[place], leaves
        if below is not None:
            numbers, options = leaves
            entries = jnp.asarray(below(*numbers, *arguments[:place], z[1:], *arguments[place + 1 :], **options))
        rows = [jnp.stack([entries[i, (i + d) % count] for d in range(1, count)]) for i in range(count)]
        return chosen(z[0], rows)

    return row


def of_mode(function: Any, modes: Modes) -> Any:
    """A user's function of (..., x, mode) as a function of (..., (i, x)); anything that is not one is unchanged."""
    if function is None or hasattr(function, "control_at") or not callable(function):
        return function
    return jax.tree_util.Partial(_of_mode, as_partial(function), np.arange(len(modes.names)))


def _of_mode(function: Callable, numbers: Array, *arguments: Any) -> Array:
    *before, z = arguments
    return chosen(z[0], [function(*before, z[1:], number) for number in range(len(numbers))])


def refuse_modes(problem: Problem) -> None:
    """Refuse a problem with modes, jumps or pushes in a function that does not support them.

    Raises:
      ValueError: the problem has modes, jumps or pushes.
    """
    found = (
        (problem.jumps, f"Problem.jumps: got a problem with {len(problem.jumps)} jumps"),
        (problem.pushes, f"Problem.pushes: got a problem with {len(problem.pushes)} pushes"),
        (problem.modes, f"Problem.modes: got a problem with the modes {problem.modes and problem.modes.names!r}"),
    )
    for present, got in found:
        if present:
            raise ValueError(
                f"{got}, which this function does not take: its equations have no term for sudden changes.\n"
                "Leave them out, or use solve, march, simulate, greedy_feedback or hjb.chain"
            )
