"""Conversion of solutions between costs and rewards.

The solvers minimise costs. ``with_rewards`` makes a public function accept problems with rewards: it negates the guess
and the prescribed ends on the way in, and the value and its bounds on the way out. The labels of a solution say whether
its value is a cost or a reward. Functions that use a value, such as ``simulate``, convert it with ``in_costs``.
"""

import inspect
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.arguments import with_calls_by_name
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST, REWARD
from hjbjax.problem.mode_axis import with_modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, is_traced
from hjbjax.problem.rewards import costs_of, negative, negative_ends
from hjbjax.solution.solution import Solution, change_solutions

P = ParamSpec("P")
T = TypeVar("T")
GUESSES = ("guess", "start")  # arguments of the solvers that hold a value V
WORDS = {  # for V ≤ 0 the two factors change places
    "running cost, V/(1 + η) ≤ V_h ≤ V/(1 − ρ)": "running reward, V/(1 − ρ) ≤ V_h ≤ V/(1 + η)",
    "positive running cost": "negative running reward",
    "running cost": "running reward",
}


def in_costs(solution: Solution) -> Solution:
    """The solution with its value and bounds as costs, with the opposite sign if they were rewards."""
    if solution.labels.payoff == COST:
        return solution
    problem = None if solution.problem is None else costs_of(solution.problem)
    return _negative(solution, COST, solution.grid and negative_ends(solution.grid), problem)


def in_rewards(solution: Solution, grid: Grid, problem: Problem | None = None) -> Solution:
    """A solver's solution with its value as a reward, on the user's grid."""
    if solution.labels.payoff == REWARD:
        return solution
    known = None if is_traced(problem) else problem
    own = negative_ends(solution.grid) if grid is None else with_modes(grid, solution.grid.modes)
    found = _negative(solution, REWARD, own, known)
    if isinstance(sentence := found.stats.get("certificate"), str):
        words = next(((old, new) for old, new in WORDS.items() if old in sentence), ("", ""))
        found.stats["certificate"] = sentence.replace(*words)
    return found


def _negative(solution: Solution, payoff: str, grid: Grid, problem: Problem | None) -> Solution:
    """The solution with the opposite sign of its value, and with its bounds exchanged."""
    enclosure = solution.enclosure
    if enclosure is not None:  # −(factor · V + shift) = factor · (−V) − shift, and the bounds change places
        xp: Any = jnp if is_traced(enclosure) else np
        rows = xp.asarray(enclosure)[..., ::-1, :]
        enclosure = xp.stack([rows[..., 0], 0 - rows[..., 1]], axis=-1)
    value = solution.value if is_traced(solution.value) else np.asarray(solution.value)
    labels = solution.labels._replace(payoff=payoff)
    return altered(
        solution, value=0 - value, enclosure=enclosure, labels=labels, grid=grid, problem=problem,
        stats=dict(solution.stats),
    )  # fmt: skip


def with_rewards(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator of a public function of (problem or problems, grid, ...) that returns solutions of these problems.

    Calls without rewards pass through unchanged.
    """
    first, second = list(inspect.signature(function).parameters)[:2]

    def call(function: Callable[..., Any], given: dict[str, Any]) -> Any:
        asked = given[first]
        if not isinstance(asked, Problem) and isinstance(asked, Iterable):
            given[first] = asked = list(asked)  # read once, because it may be a generator
        problems = asked if isinstance(asked, list) else [asked]
        rewarded = [isinstance(each, Problem) and each.payoff == REWARD for each in problems]
        if not any(rewarded):
            return function(**given)
        grid = given[second]
        if isinstance(grid, Grid):
            _refuse_mixed_ends(function.__name__, grid, all_rewarded=all(rewarded))
            given[second] = negative_ends(grid)
        given |= {name: negative(_as_numbers(given[name])) for name in GUESSES if name in given}
        try:
            found = function(**given)
        except BaseException as error:
            _turn(error, problems, rewarded, grid)
            raise
        if isinstance(found, Solution):
            return in_rewards(found, grid, asked)
        return [_turned(*each, grid) for each in zip(found, problems, rewarded, strict=True)]

    return with_calls_by_name(function, call)


def _turned(solution: Solution, problem: Problem, rewarded: bool, grid: Grid) -> Solution:
    """The solution of one of several problems in the sign of its payments."""
    return in_rewards(solution, grid, problem) if rewarded else solution


def _turn(error: BaseException, problems: list[Problem], rewarded: list[bool], grid: Grid) -> None:
    """Give the partial solutions of an exception the sign of the rewards."""

    def turned(solution: Solution, lane: int | None) -> Solution:
        if lane is not None:
            return _turned(solution, problems[lane], rewarded[lane], grid)
        if solution.problem is None or solution.problem.payoff != REWARD:
            return solution
        return in_rewards(solution, grid, problems[0] if len(problems) == 1 else solution.problem)

    change_solutions(error, turned)


def _as_numbers(values: Any) -> Any:
    """A guess as an array; anything that is not an array of numbers is left for the solver to refuse."""
    if values is None or is_traced(values):
        return values
    try:
        array = np.asarray(values)
        return array.astype(float) if array.dtype.kind == "u" else array
    except ValueError:
        return values


def _refuse_mixed_ends(name: str, grid: Grid, *, all_rewarded: bool) -> None:
    """Refuse prescribed ends if some problems have costs and others rewards: their values would be both."""
    if not all_rewarded and grid.prescribed("dirichlet", "neumann", "robin"):
        raise ValueError(
            f"{name}: got problems with costs and problems with rewards on a grid with prescribed ends, whose numbers "
            "are costs or rewards;\nsolve the two kinds separately"
        )
