"""Checks of the robust filter's arguments, made before anything is compiled."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import schemes
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast, is_traced, numbers
from hjbjax.problem.rewards import refuse_rewards
from hjbjax.problem.settings import own_settings
from hjbjax.tracing import checks, components


def check_question(problem: object, grid: object, scheme: Any) -> None:
    """Refuse a problem without a robust information state on the grid."""
    if not isinstance(problem, Problem) or not isinstance(grid, Grid):
        raise TypeError(
            f"robust_filter: got {type(problem).__name__}, {type(grid).__name__}; wanted a Problem and a Grid"
        )
    refuse_rewards(problem, "robust_filter", "the disturbance of the filter maximises the cost minus ½γ²|w|²")
    if problem.is_game or problem.time_dependent:
        what = "an opponent" if problem.is_game else "functions that depend on time"
        raise ValueError(
            f"robust_filter: got a problem with {what}, wanted drift (x, u) and cost (x, u). The disturbance of the "
            "filter is w, which pays ½γ²|w|²; remove the other one."
        )
    checks.refuse_prescribed(grid, "robust_filter", "which prescribe V and not the information state p")
    if grid.sides("open"):
        raise ValueError(
            "robust_filter: got a grid with open ends, through which unknown values of p would flow in; choose "
            "edges='projected' or 'constrained'"
        )
    schemes.check_scheme(scheme, "robust_filter: scheme", grid)
    checks.of_one_state(
        Problem(problem.drift, problem.cost, problem.controls), grid.ndim, "the number of axes of the grid"
    )
    for axis, count in enumerate(grid.shape):
        if count < scheme.points:
            raise ValueError(
                f"robust_filter: axis {axis} has {count} points; {type(scheme).__name__} needs at least {scheme.points}"
            )


def initial_values(initial: Any, grid: Grid) -> Any:
    """p₀ at the nodes; refused if it is not finite."""
    values: Any
    if callable(initial):
        checks.function_of(initial, "robust_filter: initial", (), x=(grid.ndim,))
        with own_settings(x64=True):
            x = cast(grid, np.float64).components(np.float64)
            values = components.scalar(initial, x, dtype=np.dtype(np.float64))
            values = jnp.broadcast_to(values, grid.shape)
            values = values if is_traced(values) else np.asarray(values)
    else:
        values = numbers(initial, "robust_filter: initial")
    if np.shape(values) != grid.shape:
        raise ValueError(f"robust_filter: initial has shape {np.shape(values)}, wanted {grid.shape}: one per node")
    if not is_traced(values) and not np.all(np.isfinite(values)):
        bad = np.asarray(values)[~np.isfinite(values)][0]
        raise ValueError(
            f"robust_filter: initial is {bad} at some node, wanted finite numbers, because slopes are differences.\n"
            "For a state known to be in a set use a steep −γ² dist²/(2Y) outside it, with √Y a few spacings."
        )
    return values


def gains(problem: Problem, sigma: Any, n: int) -> Any:
    """The square roots of diag σσᵀ, shape (n,)."""
    given = problem.noise if sigma is None else sigma
    if callable(given):
        raise ValueError(
            "robust_filter: got a noise that is a function of the state, wanted numbers; pass sigma=, a number, (n,) "
            "or (n, k)"
        )
    array: Any = numbers(1.0 if given is None else given, "robust_filter: sigma")
    if array.ndim > 2 or (array.ndim and array.shape[0] != n):
        raise ValueError(f"robust_filter: sigma has shape {array.shape}, wanted (), ({n},) or ({n}, k)")
    if is_traced(array):
        if array.ndim == 2:
            raise ValueError("robust_filter: inside a transformation sigma must be a number or one per axis, (n,)")
        return jnp.broadcast_to(array, (n,))
    if not np.all(np.isfinite(array)) or (array.ndim < 2 and np.any(array < 0)):
        raise ValueError(f"robust_filter: sigma = {arguments.shown(array.tolist())}; wanted finite numbers ≥ 0")
    if array.ndim < 2:
        return np.broadcast_to(array, (n,)).copy()
    a = array @ array.T
    size = np.sqrt(np.outer(np.diag(a), np.diag(a)))
    if np.any(np.abs(a - np.diag(np.diag(a))) > 16 * np.finfo(float).eps * size):
        raise ValueError(
            f"robust_filter: sigma = {arguments.shown(array.tolist())} has σσᵀ = {arguments.shown(a.tolist())}, wanted "
            "a diagonal one: each column of σ acts on one axis. Rotate the axes of the state so that it does."
        )
    return np.sqrt(np.diag(a))
