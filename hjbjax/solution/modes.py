"""Solutions of problems with modes: one mode of a solution, states in a mode, and where the mode is changed."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.mode_axis import in_mode, without_modes
from hjbjax.problem.modes import Modes
from hjbjax.problem.pytree import altered, is_traced
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Numbers

SAME = 64  # units in the last place between V and the value after a change of the mode
BY_NODE = (
    "value", "policy", "disturbance", "reached", "grid_error", "box_error", "stopping", "active", "pushing",
)  # fmt: skip


def states_in_mode(grid: Grid, x: Numbers, mode: str | int, name: str) -> Array:
    """States x, shape (..., n), as states (i, x) in one mode, shape (..., n + 1).

    Raises:
      ValueError: the grid has no such mode, or states of the wrong length.
    """
    number, n = mode_number(grid, mode, name), grid.ndim - 1
    xp: Any = jnp if is_traced(x) else np
    states = xp.asarray(x)
    if states.shape[-1:] != (n,):
        raise ValueError(f"{name}: got states of shape {states.shape}, wanted (..., {n}): one entry per state")
    return xp.concatenate([xp.full((*states.shape[:-1], 1), number, states.dtype), states], axis=-1)


def refuse_unknown_modes(grid: Grid, x: Numbers, name: str) -> None:
    """Refuse states without a mode, and states that begin with a number that is not a mode; traced ones pass.

    Raises:
      ValueError: names the modes.
    """
    if not grid.modes or is_traced(x):
        return
    try:
        shape, n = np.shape(x), grid.ndim - 1
    except ValueError:  # rows of different lengths, which the interpolation refuses
        return
    if shape[-1:] == (n,) or not shape:
        raise ValueError(
            f"{name}: got states of shape {shape} without a mode; give it, as in mode={grid.modes[0]!r}: the problem "
            f"has the modes {grid.modes!r}"
        )
    if shape[-1] == n + 1:
        numbers = np.asarray(x)[..., 0]
        if not np.all(np.isin(numbers, np.arange(len(grid.modes)))):
            raise ValueError(
                f"{name}: got states that begin with the mode {numbers.tolist()!r:.60}, wanted whole numbers from 0 to "
                f"{len(grid.modes) - 1}"
            )


def of_one_mode(solution: Any, mode: str | int) -> Any:
    """The solution in one mode; refuses a solution without modes."""
    grid, number = solution.grid, mode_number(solution.grid, mode, "Solution.in_mode")
    lead = np.ndim(solution.value) - grid.ndim  # the kept times of a march

    def part(array: Any) -> Any:
        if array is None:
            return None
        axis = lead if np.shape(array)[lead : lead + grid.ndim] == grid.shape else 0
        return array[(slice(None),) * axis + (number,)]

    changed = {name: part(getattr(solution, name)) for name in BY_NODE}
    if solution.cut is not None:
        changed["cut"] = solution.cut[..., 1:, :]
    problem = None if solution.problem is None else in_mode(solution.problem, number)
    return altered(solution, grid=without_modes(grid), problem=problem, **changed)


def switching_modes(solution: Any) -> np.ndarray | None:
    """The number of the mode after the changes at every node; None if the controller changes no mode."""
    grid, problem = solution.grid, solution.problem
    if not grid.modes:
        return None
    if problem is None:
        raise ValueError(
            "Solution.switching: the problem is not known, as after loading a file; set it with "
            "dataclasses.replace(solution, problem=problem)"
        )
    if problem.modes.switching_cost is None:
        return None
    sign = 1.0 if solution.labels.payoff == "cost" else -1.0
    value = sign * np.asarray(solution.value, np.float64)
    after = np.moveaxis(value, value.ndim - grid.ndim, 0)  # (k, times, *grid of the states)
    costs, count = _costs(solution), len(grid.modes)
    size = np.max(np.abs(value), where=np.isfinite(value), initial=0.0)
    # the rounding errors, and the last residual, below which differences of V mean nothing
    close = SAME * np.finfo(solution.value.dtype).eps * size + (solution.residual or 0.0)
    found = np.empty(after.shape, int)
    for i in range(count):
        bounds = [np.full(after[i].shape, np.inf) if j == i else costs[i, j] + after[j] for j in range(count)]
        best = np.argmin(bounds, axis=0)
        changes = np.min(bounds, axis=0) <= after[i] + close
        found[i] = np.where(changes, best, i)
    return np.moveaxis(found, 0, value.ndim - grid.ndim)


def _costs(solution: Any) -> np.ndarray:
    """c at the nodes, shape (k, k) or (k, k, *grid), or (k, k, times, *grid) of the states."""
    problem, grid, table = solution.problem, without_modes(solution.grid), solution.problem.modes.switching_cost
    if not callable(table):
        return np.asarray(table, np.float64)
    with own_settings(x64=True):
        nodes = jnp.asarray(grid.nodes()).reshape(-1, grid.ndim)

        def at(t: Any) -> jax.Array:
            found = jax.vmap(lambda x: table(*problem.state_arguments(x, t)))(nodes)
            return jnp.moveaxis(found, 0, -1).reshape(*found.shape[1:], *grid.shape)

        if solution.times is None or not problem.time_dependent:
            found = at(0.0)
        else:
            found = jnp.moveaxis(jax.vmap(at)(jnp.asarray(solution.times)), 0, 2)
        return np.asarray(found, np.float64)


def mode_number(grid: Grid, mode: str | int, name: str) -> int:
    """The number of a mode of a grid.

    Raises:
      ValueError: the grid has no modes, or no such mode.
    """
    if not grid.modes:
        raise ValueError(f"{name}: got mode = {mode!r}, but the problem has no modes; leave out mode")
    return Modes(grid.modes).number(mode)
