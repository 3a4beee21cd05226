"""Discounts that are functions of the state, for public functions whose solvers only know numbers."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.schemes import Upwind
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, cast, is_traced
from hjbjax.problem.rewards import costs_of
from hjbjax.problem.settings import own_settings
from hjbjax.problem.time_change import in_own_time, with_killing
from hjbjax.problem.types import Scalar
from hjbjax.solution.solution import Solution
from hjbjax.tracing import checks
from hjbjax.tracing.closures import settled

P = ParamSpec("P")
T = TypeVar("T")


def with_own_time(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator of a public function of (problem or problems, grid, ...) without a horizon.

    Problems whose discount is a number pass through unchanged. The solutions keep the user's problems.
    """
    return _with_numbers(function, _in_own_time)


def with_killings(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator of a public function of (problem, grid, horizon, ...); otherwise like ``with_own_time``."""
    return _with_numbers(function, _with_killing)


def _with_numbers(function: Callable[P, T], convert: Callable[[Problem, Grid, str], Problem]) -> Callable[P, T]:
    """A public function that receives problems whose discounts are numbers."""
    parameters = inspect.signature(function)
    first, second = list(parameters.parameters)[:2]

    @functools.wraps(function)
    def called(*arguments: P.args, **options: P.kwargs) -> Any:
        asked: Any = arguments[0] if arguments else options.get(first)
        problems = [asked] if isinstance(asked, Problem) else asked if isinstance(asked, list) else []
        if not any(isinstance(each, Problem) and callable(each.discount) for each in problems):
            return function(*arguments, **options)
        try:
            given: dict[str, Any] = dict(parameters.bind(*arguments, **options).arguments)
        except TypeError:
            return function(*arguments, **options)  # refuses its arguments
        if isinstance(given[second], Grid):
            made = [
                convert(costs_of(each), given[second], function.__name__) if isinstance(each, Problem) else each
                for each in problems
            ]
            given[first] = made[0] if isinstance(asked, Problem) else made
        try:
            found: Any = function(**given)  # type: ignore[call-arg]
        except BaseException as error:
            _restore(error, problems)
            raise
        if isinstance(found, list):
            return [_of_problem(*each) for each in zip(found, problems, strict=True)]
        return _of_problem(found, problems[0])

    return called


def _of_problem(found: Any, problem: Problem) -> Any:
    """A solution with the user's problem; other results unchanged."""
    known = isinstance(found, Solution) and found.problem is not None
    return altered(found, problem=problem) if known else found


def _restore(error: BaseException, problems: list[Problem]) -> None:
    """Give the partial solutions of an exception the user's problems."""
    reported: Any = error
    solution, solutions = getattr(error, "solution", None), getattr(error, "solutions", ())
    if solutions:
        restored = tuple(_of_problem(*each) for each in zip(solutions, problems, strict=True))
        reported.solution = next(new for old, new in zip(solutions, restored, strict=True) if old is solution)
        reported.solutions = restored
    elif isinstance(solution, Solution) and len(problems) == 1:
        reported.solution = _of_problem(solution, problems[0])


def _in_own_time(problem: Problem, grid: Grid, name: str) -> Problem:
    """The problem in its own time, after a check of its functions, and of β at the nodes."""
    if not callable(problem.discount) or problem.time_dependent:  # a function of time is refused
        return problem
    checks.of_one_state(problem, grid.ndim, "the number of axes of the grid")
    _check_rate(problem, grid, name)
    return in_own_time(problem)


def _with_killing(problem: Problem, grid: Grid, name: str) -> Problem:
    """The problem of a march, whose functions the march checks."""
    return with_killing(problem)


def _check_rate(problem: Problem, grid: Grid, name: str) -> None:
    """Refuse a discount that is not positive and finite at every node; host level."""
    ready = settled(problem, grid.ndim)
    if is_traced(ready, grid):  # the values are unknown; where β ≤ 0 the solution is NaN
        return
    with jax.core.eval_context(), own_settings(x64=True):
        known = cast((ready, grid), np.float64)
        least, where, faulty = jax.device_get(_least(Discretisation(*known, Upwind(), np.dtype(np.float64))))
    if not faulty:
        return
    x = grid.state(tuple(int(i) for i in np.unravel_index(int(where), grid.shape)))
    raise ValueError(
        f"{name}: discount(x) is {least:.6g} at x = {np.asarray(x).tolist()}, the first of {int(faulty)} nodes where "
        "it is not a positive number; wanted discount(x) > 0 everywhere:\n"
        "without a horizon the discount bounds the value. Use jnp.maximum(discount, a small rate), or march over a "
        "horizon"
    )


@jax.jit
def _least(on: Discretisation) -> tuple[Scalar, Scalar, Scalar]:
    """β at the first node where it is not positive and finite, the flat index of the node, and the number of nodes."""
    rate = on.at_nodes(on.problem.discount)
    faulty = ~((rate > 0) & (rate < jnp.inf))
    where = jnp.argmax(faulty)
    return rate.reshape(-1)[where], where, jnp.sum(faulty)
