"""The arguments of ``pontryagin``: refusals before anything compiles, and plain arrays in float64."""

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem
from hjbjax.extremals.necessary_conditions import Extremal
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial
from hjbjax.problem.types import Array, Number
from hjbjax.solution.solution import Solution


def check_problem(problem: object, tol: float, max_nodes: int) -> None:
    """Refuse a problem that is no optimal control problem without noise, and limits that are no limits."""
    if not isinstance(problem, Problem):
        raise TypeError(f"pontryagin: got problem = {problem!r}, wanted a Problem")
    for name, why in (
        ("noise", "the principle here is the deterministic one; solve it on a grid"),
        ("disturbances", "a game has a saddle, not a minimum; solve it on a grid"),
        ("stopping_cost", "stopping is no end condition of (8.7); solve it on a grid"),
        ("running_max", "a running maximum is no integral; solve it on a grid"),
    ):
        if getattr(problem, name) is not None:
            raise ValueError(f"pontryagin: got a problem with {name}, wanted one without: {why}")
    if problem.controls is None:
        raise ValueError("pontryagin: got a problem without controls, wanted a Box, a Ball or a Finite to choose from")
    if not (np.ndim(tol) == 0 and 0 < tol < 1):
        raise ValueError(f"pontryagin: got tol = {tol!r}, wanted a number between 0 and 1")
    if isinstance(max_nodes, bool) or not isinstance(max_nodes, (int, np.integer)) or max_nodes < 1:
        raise ValueError(f"pontryagin: got max_nodes = {max_nodes!r}, wanted a positive integer")


def check_guess(guess: object, n: int, horizon: object) -> None:
    """Refuse a guess of another kind, or one that cannot be followed from x₀."""
    if guess is not None and not isinstance(guess, (Solution, Extremal)):
        raise TypeError(f"pontryagin: got guess = {guess!r}, wanted a Solution, an Extremal or None")
    if not isinstance(guess, Solution):
        return
    if guess.grid.ndim != n:
        raise ValueError(
            f"pontryagin: got a guess on a grid of {guess.grid.ndim} axes, wanted {n}, the length of x0; "
            "give the Solution of this problem, or no guess"
        )
    # its closed loop is followed for as long as it takes, and past its last time it has no feedback
    if guess.times is not None and horizon is None:
        raise ValueError(
            "pontryagin: got a marched Solution as the guess, and no horizon: its feedback is known up to "
            f"t = {float(guess.times[-1]):g} only;\ngive horizon=, or FreeTime() to seek it, or a Solution of solve"
        )


def check_grid(grid: object, n: int) -> None:
    """Refuse a grid that is not of these states."""
    if grid is None:
        return
    if not isinstance(grid, Grid):
        raise TypeError(f"pontryagin: got grid = {grid!r}, wanted a Grid or None")
    if grid.ndim != n:
        raise ValueError(
            f"pontryagin: got a grid of {grid.ndim} axes, wanted {n}, the length of x0; give one axis a state"
        )


def check_start(bvp: BoundaryValueProblem) -> None:
    """Refuse a start from which nothing runs."""
    problem, start = bvp.problem, jnp.asarray(bvp.start)
    if problem.target is None or float(bvp.level(0.0, start)) > 0:
        return
    paid = float(dataclasses.replace(bvp, final=problem.exit_cost).psi(0.0, start))
    raise ValueError(
        f"pontryagin: got x0 = {bvp.start.tolist()}, in the target, where a run ends at once and costs {paid:.6g}; "
        "start outside, or leave the target out: dataclasses.replace(problem, target=None, exit_cost=None)"
    )


def state_of_numbers(value: object, name: str) -> np.ndarray:
    """One finite number a state in float64; NaN is admissible in ``terminal`` alone."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"pontryagin: got {name} = {value!r}, wanted one number a state") from None
    if array.ndim != 1 or array.size == 0 or (name != "terminal" and not np.all(np.isfinite(array))):
        raise ValueError(f"pontryagin: got {name} = {value!r}, wanted shape (n,): one finite number a state")
    return array


def end_states(
    terminal: Callable | Array | Sequence[float] | None, n: int
) -> tuple[tuple[bool, ...], np.ndarray, Callable | None]:
    """A mask of the end states that are given, their values, and the terminal cost."""
    if terminal is None or callable(terminal):
        return (False,) * n, np.zeros(n), None if terminal is None else as_partial(terminal)
    ends = state_of_numbers(terminal, "terminal")
    if len(ends) != n or np.any(np.isinf(ends)) or np.all(np.isnan(ends)):
        raise ValueError(
            f"pontryagin: got terminal = {ends.tolist()}, wanted {n} numbers, NaN for a state that is free at the end, "
            "and at least one that is not"
        )
    # the 0 of a free state is read nowhere
    return tuple(bool(given) for given in ~np.isnan(ends)), np.nan_to_num(ends), None


def fixed_horizon(horizon: Number) -> float:
    """A horizon that is given, checked."""
    if isinstance(horizon, (bool, str)) or np.ndim(horizon) or not (np.isfinite(horizon) and horizon > 0):
        raise ValueError(f"pontryagin: got horizon = {horizon!r}, wanted a finite number > 0, FreeTime() or None")
    return float(horizon)
