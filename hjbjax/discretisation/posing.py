"""Decorators of public functions for problems with modes, jumps, pushes, growth, or data that depend on the state.

These data are the bounds of the controls and the discount.

The solvers support fixed sets of controls and constant discounts, modes as the first entry of the state, and all jumps
and all pushes as functions. A decorated function receives such a problem, and its grid, instead of the user's. In the
solutions that it returns, the controls and the problem are the user's again. The grid keeps its axis of modes.
"""

import functools
import inspect
import itertools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.schemes import Upwind
from hjbjax.problem import sets
from hjbjax.problem.arguments import with_calls_by_name
from hjbjax.problem.grid import Grid
from hjbjax.problem.jump_terms import with_jump_functions, with_mean_jump_costs
from hjbjax.problem.mode_axis import in_mode, of_mode, over_modes, with_modes, without_modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, cast, is_traced
from hjbjax.problem.rewards import costs_of
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import bounds_at, control_of, in_unit_box, with_any_control
from hjbjax.problem.time_change import (
    has_variable_discount,
    in_own_time,
    net_discount,
    with_killing,
    with_least_discount,
)
from hjbjax.problem.types import Array, Scalar
from hjbjax.solution.solution import Solution, change_solutions
from hjbjax.tracing import checks, components
from hjbjax.tracing.closures import holds_tracers, settled, settled_function

P = ParamSpec("P")
T = TypeVar("T")


def without_horizon(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator of a public function of (problem or problems, grid, ...) without a horizon.

    Problems without modes, jumps, pushes and growth, with a constant discount, and with a fixed set of controls or no
    control, pass through unchanged.
    """
    return _posing(function, _with_least_discount)


def in_time_of_discount(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator like ``without_horizon`` that gives all states and controls the discount one."""
    return _posing(function, _in_own_time)


def with_horizon(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator like ``without_horizon``, for a public function of (problem, grid, horizon, ...)."""
    return _posing(function, _with_killing)


def _posing(function: Callable[P, T], discounting: Callable[[Problem, Grid, str], Problem]) -> Callable[P, T]:
    """Decorate a public function; ``discounting`` makes the discount of each problem constant."""
    first, second = list(inspect.signature(function).parameters)[:2]
    name = function.__name__

    def posed(problem: Problem, grid: Grid) -> Problem:
        return discounting(_with_fixed_set(problem, grid, name), grid, name)

    def call(function: Callable[..., Any], given: dict[str, Any]) -> Any:
        asked, grid = given[first], given[second]
        problems = [asked] if isinstance(asked, Problem) else asked if isinstance(asked, list) else []
        _refuse_other_modes(problems, grid, name)
        if not any(map(_needs_posing, problems)):
            return function(**given)
        if isinstance(grid, Grid):
            n = without_modes(grid).ndim
            joined = [for_solvers(each, n) if _is_joined(each) else each for each in problems]
            given[second] = grid = _grid_of_all(grid, problems, name)
            made = [posed(each, grid) if _needs_posing(each) else each for each in joined]
            given[first] = made[0] if isinstance(asked, Problem) else made
        try:
            found = function(**given)
        except BaseException as error:
            change_solutions(error, lambda solution, lane: _restored(solution, problems, lane))
            raise
        if isinstance(found, list):
            return [_of_user(*each) for each in zip(found, problems, strict=True)]
        return _of_user(found, problems[0])

    return with_calls_by_name(function, call)


def with_mode_axis(*of_state: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorator of a public function of (problem, grid, ...): a problem with modes gets the mode as its first state.

    The function also receives the grid with an axis of modes, and jumps and pushes as functions. Problems without
    modes, jumps and pushes pass through unchanged.

    Args:
      *of_state: names of arguments that are functions of the state, which the user writes with the mode last.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        first, second = list(inspect.signature(function).parameters)[:2]

        def call(function: Callable[..., Any], given: dict[str, Any]) -> Any:
            problem, grid = given[first], given[second]
            if _is_joined(problem) and isinstance(grid, Grid):
                given[first] = for_solvers(problem, without_modes(grid).ndim)
            if _has_modes(problem) and isinstance(grid, Grid):
                given[second] = with_modes(grid, problem.modes.names)
                given |= {name: of_mode(given[name], problem.modes) for name in of_state if name in given}
            return function(**given)

        return with_calls_by_name(function, call)

    return decorate


def _needs_posing(problem: object) -> bool:
    """True for a problem with modes, jumps, pushes or growth, or with bounds or a discount that depend on the state."""
    if not isinstance(problem, Problem):
        return False
    return _is_joined(problem) or has_variable_discount(problem) or callable(problem.controls)


def _has_modes(problem: object) -> bool:
    """True for a problem with modes."""
    return isinstance(problem, Problem) and problem.modes is not None


def for_solvers(problem: Problem, n: int) -> Problem:
    """The problem with costs, the mode as its first state, and the mean costs of its jumps in the running cost."""
    return with_mean_jump_costs(over_checked_modes(costs_of(problem), n))


def _is_joined(problem: object) -> bool:
    """True for a problem with modes, jumps or pushes, which ``over_checked_modes`` changes."""
    return _has_modes(problem) or (isinstance(problem, Problem) and bool(problem.jumps or problem.pushes))


def _refuse_other_modes(problems: list[Problem], grid: object, name: str) -> None:
    """Refuse a grid with modes for a problem of a user without modes: it would be solved with x = (mode, x)."""
    if not (isinstance(grid, Grid) and grid.modes):
        return
    for problem in (each for each in problems if isinstance(each, Problem)):
        if problem.modes is None and problem.mode_rates is None and problem.switching_costs is None:
            raise ValueError(
                f"{name}: got a grid with the modes {grid.modes!r}, but a problem without modes; wanted a grid of the "
                "states only,\nsuch as the one that was passed with the modes, or solution.in_mode(...).grid"
            )


def _grid_of_all(grid: Grid, problems: list[Problem], name: str) -> Grid:
    """The grid with the modes of the problems, which must be the same."""
    found = {() if each.modes is None else each.modes.names for each in problems if isinstance(each, Problem)}
    if len(found) > 1:
        raise ValueError(f"{name}: got problems with the modes {sorted(found)}; wanted the same modes in all of them")
    (names,) = found
    return with_modes(grid, names) if names else grid


def _of_user(found: Any, problem: Problem) -> Any:
    """A solution with the controls and the problem of the user; other results unchanged."""
    if not isinstance(found, Solution):
        return found
    changed: dict[str, Any] = {} if found.problem is None else {"problem": problem}
    if callable(problem.controls) and found.policy is not None:
        bounds = _bounds(over_modes(problem, without_modes(found.grid).ndim), found.grid, found.times)
        policy = control_of(bounds, found.policy)
        changed["policy"] = policy.astype(found.policy.dtype)
    return altered(found, **changed)


def _restored(solution: Solution, problems: list[Problem], lane: int | None) -> Solution:
    """A partial solution with the user's controls and problem; unchanged if it may belong to several problems."""
    if lane is None and len(problems) > 1:
        return solution
    return _of_user(solution, problems[lane or 0])


# --- controls ---


def _with_fixed_set(problem: Problem, grid: Grid, name: str) -> Problem:
    """Check the functions and the bounds of a problem, and return it with costs and with a fixed set of controls."""
    problem = costs_of(problem)
    checks.of_one_state(with_any_control(problem, grid.ndim), grid.ndim, "the number of axes of the grid")
    if not callable(problem.controls):
        return problem
    fixed = in_unit_box(problem, grid.ndim)
    bounds = _bounds(problem, grid, None)
    if not is_traced(bounds):  # if traced, the functions are NaN there, which a check on the host refuses later
        faulty = np.any(~np.isfinite(bounds[0]) | ~np.isfinite(bounds[1]), axis=-1)
        if faulty.any():
            index = tuple(int(i) for i in np.argwhere(faulty)[0])
            raise ValueError(
                f"{name}: no admissible control at {int(faulty.sum())} nodes, the first x = "
                f"{np.asarray(grid.state(index)).tolist()}: controls(x) is not a box with finite lo ≤ hi there;\n"
                "use jnp.maximum(lo, hi) for hi, or a box where the bounds are ordered"
            )
    return fixed


def _bounds(problem: Problem, grid: Grid, times: Any) -> tuple[Array, Array]:
    """lo and hi at the nodes, (*grid, m), or at all kept times, (k, *grid, m); NumPy if all numbers are known."""
    timed = problem.time_dependent
    shapes = problem.state_arguments((grid.ndim,), ())
    ready = settled_function(problem.controls, *shapes)
    moments = (0.0 if times is None else times) if timed else None
    if is_traced(ready, grid, times) or holds_tracers(problem.controls):
        return _at_all(problem.controls, grid.nodes(), moments)
    with jax.core.eval_context(), own_settings(x64=True):
        known = cast((ready, np.asarray(grid.nodes()), moments), np.float64)
        return jax.tree.map(np.asarray, _at_all_jit(*known))


def _at_all(controls: Callable, nodes: Array, moments: Any) -> tuple[Array, Array]:
    """The bounds at the nodes, (*grid, n), and at ``moments``: None, one time or several."""
    flat = jnp.reshape(nodes, (-1, nodes.shape[-1]))

    def at_nodes(*t: Any) -> tuple[Array, Array]:
        found = jax.vmap(lambda x: bounds_at(controls, *t, x))(flat)
        return jax.tree.map(lambda bound: jnp.reshape(bound, (*nodes.shape[:-1], -1)), found)

    if moments is None:
        return at_nodes()
    return jax.vmap(at_nodes)(moments) if jnp.ndim(moments) else at_nodes(moments)


_at_all_jit = jax.jit(_at_all)


# --- discounts ---


def _in_own_time(problem: Problem, grid: Grid, name: str) -> Problem:
    """Check β − g at the nodes, and return the problem in the time τ with dτ = (β − g) dt."""
    if problem.time_dependent or not has_variable_discount(problem):  # a function of time is refused
        return problem
    _check_rate(problem, grid, name)
    return in_own_time(problem)


def _with_least_discount(problem: Problem, grid: Grid, name: str) -> Problem:
    """Check β − g at the nodes, and return the problem with a constant discount, and with growth ≤ 0 if it has any."""
    if problem.growth is None or problem.time_dependent:
        return _in_own_time(problem, grid, name)
    return with_least_discount(problem, _check_rate(problem, grid, name))


def _with_killing(problem: Problem, grid: Grid, name: str) -> Problem:
    """The problem of a march, with β(x) as the killing; the march itself checks its functions at the nodes."""
    return with_killing(problem)


def _check_rate(problem: Problem, grid: Grid, name: str) -> Any:
    """The least β − g over nodes and controls; refuse a discount that is not positive and finite at every node."""
    ready = settled(problem, grid.ndim)
    if is_traced(ready, grid):  # the values are unknown; where β ≤ 0 the solution is NaN
        if problem.growth is None:
            return None
        least, _, faulty = _least(Discretisation(ready, grid, Upwind(), np.dtype(jnp.result_type(float))))
        # the value does not depend on the split into a discount and a growth, so neither does its derivative
        return jax.lax.stop_gradient(jnp.where(faulty > 0, jnp.nan, least))
    with jax.core.eval_context(), own_settings(x64=True):
        known = cast((ready, grid), np.float64)
        least, where, faulty = jax.device_get(_least(Discretisation(*known, Upwind(), np.dtype(np.float64))))
    if not faulty:
        return float(least)
    x = grid.state(tuple(int(i) for i in np.unravel_index(int(where), grid.shape)))
    if problem.growth is not None:
        raise ValueError(
            f"{name}: discount - growth(x, u) is {least:.6g} at x = {np.asarray(x).tolist()} for some admissible "
            f"control, the first of {int(faulty)} nodes where it is not a positive number;\n"
            "wanted discount > growth for all admissible controls: otherwise the payments may grow faster than they "
            "are discounted.\nNarrow the controls, or march over a horizon"
        )
    raise ValueError(
        f"{name}: discount(x) is {least:.6g} at x = {np.asarray(x).tolist()}, the first of {int(faulty)} nodes where "
        "it is not a positive number; wanted discount(x) > 0 everywhere:\n"
        "without a horizon the discount bounds the value. Use jnp.maximum(discount, a small rate), or march over a "
        "horizon"
    )


@jax.jit
def _least(on: Discretisation) -> tuple[Scalar, Scalar, Scalar]:
    """β − g at the first node where it is not positive and finite, its flat index, and the number of these nodes.

    If there is no such node, the first number is the least β − g.
    """
    problem = on.problem
    if problem.growth is None:
        rate = on.at_nodes(problem.discount)
    else:
        sets_of, net = (problem.controls, problem.disturbances), net_discount(problem)
        found = [
            components.scalar(net, *problem.arguments(on.coordinates(), u, d), dtype=on.dtype)
            for u, d in itertools.product(*(sets.probes(each, on.dtype) for each in sets_of))
        ]
        rate = jnp.broadcast_to(functools.reduce(jnp.minimum, found), on.grid.shape)
    faulty = ~((rate > 0) & (rate < jnp.inf))
    where = jnp.where(jnp.any(faulty), jnp.argmax(faulty), jnp.argmin(rate))
    return rate.reshape(-1)[where], where, jnp.sum(faulty)


# --- modes ---


def over_checked_modes(problem: Problem, n: int) -> Problem:
    """The problem whose state begins with the mode, and whose jumps and pushes are functions.

    The functions are checked in every mode on one state.

    Raises:
      ValueError: a function of the wrong shape, in some mode, or a push whose direction has another length.
    """
    modes = problem.modes
    _check_pushes(problem, n)
    if modes is None:
        checks.jumps_of_one_state(with_any_control(problem, n), n)
        return over_modes(with_jump_functions(problem), n)
    for number, name in enumerate(modes.names):
        try:
            one = with_any_control(altered(in_mode(problem, number), pushes=()), n)
            checks.jumps_of_one_state(one, n)
            checks.of_one_state(altered(one, jumps=()), n, "the number of axes of the grid")
        except ValueError as error:
            raise ValueError(f"in mode {name!r}: {error}") from error
    sizes = {
        "x": (n,),
        "u": (one.controls.dim if one.controls else 0,),
        "d": (problem.disturbances.dim if problem.disturbances else 0,),
    }
    letters = {"rates": problem.arguments("x", "u", "d", "t"), "switching_cost": problem.state_arguments("x", "t")}
    for name, names in letters.items():
        if callable(table := getattr(modes, name)):
            shapes = {letter: sizes.get(letter, ()) for letter in names}
            checks.function_of(table, f"Modes.{name}: {name}", (len(modes.names),) * 2, **shapes)
    return over_modes(with_jump_functions(problem), n)


def _check_pushes(problem: Problem, n: int) -> None:
    """Check directions and costs of the pushes on one state, in every mode."""
    for push in problem.pushes:
        if len(push.direction) != n:
            raise ValueError(
                f"Push.direction: got {list(push.direction)}, wanted {n} entries, one per axis without the modes"
            )
    shapes = {letter: (n,) if letter == "x" else () for letter in problem.state_arguments("x", "t")}
    each = [problem] if problem.modes is None else [in_mode(problem, mode) for mode in range(len(problem.modes.names))]
    for push in itertools.chain(*(one.pushes for one in each)):
        for name in ("cost", "reward"):
            if callable(paid := getattr(push, name)):
                checks.function_of(paid, f"Push.{name}: {name}", (), **shapes)
