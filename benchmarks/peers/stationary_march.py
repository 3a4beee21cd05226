"""hj_reachability on stationary problems: its WENO scheme marches V_t + H = 0 backwards until V is stationary.

The Hamiltonian is H = min_u [L + f·DV] − βV. After every step V is set to its exact value in the target, so both codes
solve the same equation on the same nodes. The adapter covers problems of one player without noise, with drift affine in
u and cost affine or convex quadratic in each u_i separately.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.sets import Ball, Box

PERIOD = 1.0  # time units of the problem between two checks of V


def obstacle(problem: Any, grid: Any) -> str | None:
    """The reason that this adapter cannot solve a problem, or ``None``."""
    try:
        import hj_reachability  # noqa: F401
    except ImportError:
        return "hj-reachability is not installed (pip install '.[bench]')"
    if problem.noise is not None:
        return "noise: hj_reachability has no second derivatives"
    if problem.is_game:
        return "a game: this adapter has one player"
    if problem.stopping_cost is not None or problem.running_max is not None or problem.cost is None:
        return "this adapter has no constraints, and needs a running cost"
    if not isinstance(problem.controls, (Box, Ball)):
        return "this adapter minimises over a Box or a Ball"
    if any(each is not None for each in grid.stretch):
        return "hj_reachability has uniform grids"
    return None


def best(problem: Any, x: Any, p: Any) -> Any:
    """The control that minimises L + f·p, from first and second derivatives at u = 0."""
    zero = jnp.zeros(problem.controls.dim, p.dtype)
    slope = p @ jax.jacfwd(lambda u: problem.drift(x, u))(zero) + jax.grad(lambda u: _cost(problem, x, u))(zero)
    if isinstance(problem.controls, Ball):
        length = jnp.sqrt(jnp.sum(slope * slope))
        return -problem.controls.radius * slope / jnp.where(length > 0, length, 1.0)
    curve = jnp.diagonal(jax.hessian(lambda u: _cost(problem, x, u))(zero))
    free = jnp.where(curve > 0, -slope / jnp.where(curve > 0, curve, 1.0), -jnp.sign(slope) * jnp.inf)
    return jnp.clip(jnp.where(jnp.isnan(free), 0.0, free), problem.controls.lo, problem.controls.hi)


def rate(problem: Any, x: Any, value: Any, p: Any) -> Any:
    """H = min_u [L + f·p] − βV at one state."""
    u = best(problem, x, p)
    return _cost(problem, x, u) + p @ problem.drift(x, u) - problem.discount * value


def march(
    problem: Any, grid: Any, exact: Any, *, accuracy: str = "very_high", tol: float, horizon: float, time_limit: float
) -> dict[str, Any]:
    """March twice; the second run is measured.

    Returns:
      value: node values, shape (*grid).
      seconds: of the second march; compile_seconds: the additional seconds of the first.
      status: SETTLED if V changes by at most ``tol`` over a unit of time; otherwise HORIZON or TIME_LIMIT.
      moved: the change of V over the last unit of time; WENO slopes need not become stationary.
    """
    with jax.enable_x64(True):
        settings, dynamics, lattice, start = _prepared(problem, grid, exact, accuracy)
        first = _run(settings, dynamics, lattice, start, tol, horizon, time_limit)
        if first["status"] == "TIME_LIMIT":  # one march is enough; its seconds include compiling
            return first | {"compile_seconds": None}
        second = _run(settings, dynamics, lattice, start, tol, horizon, time_limit)
    return second | {"compile_seconds": max(0.0, first["seconds"] - second["seconds"])}


def _cost(problem: Any, x: Any, u: Any) -> Any:
    return jnp.asarray(problem.cost(x, u), x.dtype) + 0.0 * jnp.sum(u)  # so that a constant cost has derivatives


def _run(settings, dynamics, lattice, value, tol, horizon, time_limit) -> dict[str, Any]:
    import hj_reachability as hj

    begin, now, status = time.perf_counter(), 0.0, "HORIZON"
    while now < horizon:
        later = hj.step(settings, dynamics, lattice, -now, value, -(now + PERIOD), progress_bar=False)
        moved, value, now = float(jnp.max(jnp.abs(later - value))), later, now + PERIOD
        if not moved > tol:  # also stops at NaN
            status = "SETTLED" if moved <= tol else "NONFINITE"
            break
        if time.perf_counter() - begin > time_limit:
            status = "TIME_LIMIT"
            break
    return {"value": np.asarray(value), "seconds": time.perf_counter() - begin, "status": status, "moved": moved}


def _prepared(problem: Any, grid: Any, exact: Any, accuracy: str) -> tuple[Any, Any, Any, Any]:
    import hj_reachability as hj

    class Stationary(hj.Dynamics):
        def __call__(self, state, control, disturbance, time):
            return problem.drift(state, control)

        def optimal_control_and_disturbance(self, state, time, grad_value):
            return best(problem, state, grad_value), jnp.zeros(1)

        def hamiltonian(self, state, time, value, grad_value):
            return rate(problem, state, value, grad_value)

        def partial_max_magnitudes(self, state, time, value, grad_value_box):
            controls = problem.controls
            ball = isinstance(controls, Ball)
            largest = (
                jnp.full(controls.dim, controls.radius) if ball else jnp.maximum(abs(controls.lo), abs(controls.hi))
            )
            zero = jnp.zeros(controls.dim, state.dtype)
            gain = jax.jacfwd(lambda u: problem.drift(state, u))(zero)
            return jnp.abs(problem.drift(state, zero)) + jnp.abs(gain) @ largest

    periodic = tuple(axis for axis in range(grid.ndim) if grid.periodic[axis])
    lattice = hj.Grid.from_lattice_parameters_and_boundary_conditions(
        hj.sets.Box(jnp.asarray(grid.lo), jnp.asarray(grid.hi)), grid.shape, periodic_dims=periodic
    )
    states = jnp.asarray(grid.nodes()).reshape(-1, grid.ndim)
    inside = jnp.zeros(grid.shape, bool)
    if problem.target is not None:
        inside = (jax.vmap(problem.target)(states) <= 0).reshape(grid.shape)
    known = jnp.where(inside, jax.vmap(exact)(states).reshape(grid.shape), 0.0)
    settings = hj.SolverSettings.with_accuracy(accuracy, value_postprocessor=lambda t, v: jnp.where(inside, known, v))
    return settings, Stationary("min", "max", None, None), lattice, known
