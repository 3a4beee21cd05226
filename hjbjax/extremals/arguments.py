"""The arguments of ``pontryagin``: checks before anything compiles, and conversion to float64 arrays."""

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem
from hjbjax.extremals.necessary_conditions import Extremal
from hjbjax.problem.arguments import positive
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, check_constant_discount
from hjbjax.problem.pytree import as_partial
from hjbjax.problem.sets import Simplex, refuse_unbounded
from hjbjax.problem.types import Array, Number
from hjbjax.solution.solution import Solution


def check_problem(problem: object, tol: float, max_nodes: int, time_limit: float | None) -> None:
    """Raise if the problem is not a deterministic optimal control problem, or if a limit is not admissible."""
    if not isinstance(problem, Problem):
        raise TypeError(f"pontryagin: got problem = {problem!r}, wanted a Problem")
    for name, why in (
        ("noise", "pontryagin solves deterministic problems; solve it on a grid"),
        ("disturbances", "a game has a saddle point, not a minimum; solve it on a grid"),
        ("stopping_cost", "stopping is not an end condition of (8.7); solve it on a grid"),
        ("stopping_reward", "stopping is not an end condition of (8.7); solve it on a grid"),
        ("running_max", "a running maximum is not an integral; solve it on a grid"),
    ):
        if getattr(problem, name) is not None:
            raise ValueError(f"pontryagin: got a problem with {name}, wanted one without: {why}")
    check_constant_discount(problem, "pontryagin")
    if callable(problem.controls):
        raise ValueError(
            "pontryagin: got bounds of the controls that depend on the state, wanted a fixed set; solve it on a grid"
        )
    if problem.controls is None:
        raise ValueError("pontryagin: got a problem without controls, wanted a Box, a Ball or a Finite to choose from")
    if isinstance(problem.controls, Simplex):
        raise ValueError(
            "pontryagin: got controls in a Simplex, wanted a Box, a Ball or a Finite: the conditions have no\n"
            "multiplier for the sum of the controls; solve the problem on a grid, or enumerate Simplex.grid(num)"
        )
    refuse_unbounded(problem.controls, "pontryagin", "the guess starts from samples between them")
    if not (np.ndim(tol) == 0 and 0 < tol < 1):
        raise ValueError(f"pontryagin: got tol = {tol!r}, wanted a number between 0 and 1")
    if isinstance(max_nodes, bool) or not isinstance(max_nodes, (int, np.integer)) or max_nodes < 1:
        raise ValueError(f"pontryagin: got max_nodes = {max_nodes!r}, wanted a positive integer")
    if time_limit is not None:
        positive(time_limit, "pontryagin: time_limit", "in seconds", endless=True)


def check_guess(guess: object, n: int, horizon: object) -> None:
    """Raise if the guess has the wrong type or cannot be followed from x₀."""
    if guess is not None and not isinstance(guess, (Solution, Extremal)):
        raise TypeError(f"pontryagin: got guess = {guess!r}, wanted a Solution, an Extremal or None")
    if not isinstance(guess, Solution):
        return
    if guess.grid.ndim != n:
        raise ValueError(
            f"pontryagin: got a guess on a grid of {guess.grid.ndim} axes, wanted {n}, the length of x0; "
            "pass the Solution of this problem, or no guess"
        )
    # the guess is the closed loop of the solution over an unknown time, but a marched feedback ends at its last time
    if guess.times is not None and horizon is None:
        raise ValueError(
            "pontryagin: got a time-dependent Solution as the guess and no horizon, but its feedback ends at "
            f"t = {float(guess.times[-1]):g};\npass horizon=, or FreeTime() to search for it, or a stationary Solution"
        )


def check_grid(grid: object, n: int) -> None:
    """Raise if the grid does not have one axis per state."""
    if grid is None:
        return
    if not isinstance(grid, Grid):
        raise TypeError(f"pontryagin: got grid = {grid!r}, wanted a Grid or None")
    if grid.ndim != n:
        raise ValueError(
            f"pontryagin: got a grid of {grid.ndim} axes, wanted {n}, the length of x0; give one axis per state"
        )


def check_start(bvp: BoundaryValueProblem) -> None:
    """Raise if the path starts in the target."""
    problem, start = bvp.problem, jnp.asarray(bvp.start)
    if problem.target is None or float(bvp.level(0.0, start)) > 0:
        return
    paid = float(dataclasses.replace(bvp, final=problem.exit_cost).psi(0.0, start))
    raise ValueError(
        f"pontryagin: got x0 = {bvp.start.tolist()}, in the target, where a run ends at once and costs {paid:.6g};\n"
        "start outside, or remove the target: dataclasses.replace(problem, target=None, exit_cost=None)"
    )


def state_of_numbers(value: object, name: str) -> np.ndarray:
    """One finite number per state in float64; only ``terminal`` may contain NaN."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"pontryagin: got {name} = {value!r}, wanted one number per state") from None
    if array.ndim != 1 or array.size == 0 or (name != "terminal" and not np.all(np.isfinite(array))):
        raise ValueError(f"pontryagin: got {name} = {value!r}, wanted shape (n,): one finite number per state")
    return array


def end_states(
    terminal: Callable | Array | Sequence[float] | None, n: int
) -> tuple[tuple[bool, ...], np.ndarray, Callable | None]:
    """A mask of the prescribed end states, their values, and the terminal cost."""
    if terminal is None or callable(terminal):
        return (False,) * n, np.zeros(n), None if terminal is None else as_partial(terminal)
    ends = state_of_numbers(terminal, "terminal")
    if len(ends) != n or np.any(np.isinf(ends)) or np.all(np.isnan(ends)):
        raise ValueError(
            f"pontryagin: got terminal = {ends.tolist()}, wanted {n} numbers, NaN for a state that is free at the end, "
            "and at least one state that is prescribed"
        )
    # the zeros of free states are never read
    return tuple(bool(given) for given in ~np.isnan(ends)), np.nan_to_num(ends), None


def fixed_horizon(horizon: Number) -> float:
    """Check a prescribed horizon and return it as a float."""
    if isinstance(horizon, (bool, str)) or np.ndim(horizon) or not (np.isfinite(horizon) and horizon > 0):
        raise ValueError(f"pontryagin: got horizon = {horizon!r}, wanted a finite number > 0, FreeTime() or None")
    return float(horizon)
