"""Checks of the arguments that ``enclose`` and ``enclose_tube`` share."""

from collections.abc import Mapping

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_random
from hjbjax.solution.solution import Solution
from hjbjax.tracing.closures import refuse_traced


def check_types(caller: str, problem: Problem, solution: Solution) -> None:
    """Refuse arguments of other types, and traced numbers."""
    for given, kind in ((problem, Problem), (solution, Solution)):
        if not isinstance(given, kind):
            raise TypeError(f"{caller}: got {type(given).__name__}, wanted a {kind.__name__}")
    refuse_traced(caller, problem, solution.value)


def check_ingredients(
    caller: str, problem: Problem, grid: Grid, others: Mapping[str, bool], wanted: str, advice: str = ""
) -> None:
    """Refuse a problem with an ingredient, or a grid with ends, for which there is no proof.

    Args:
      caller: the public function.
      problem: the problem.
      grid: its grid.
      others: further ingredients that the caller refuses, with True if the problem has them.
      wanted: the end of the message about an ingredient.
      advice: the end of the message about the ends.

    Raises:
      ValueError: the problem has one of these ingredients, random paths, modes, pushes or growth; or an end of the
        grid is neither projected nor periodic.
    """
    lacking = {
        "random paths (noise, jumps or modes)": is_random(problem), "modes": problem.modes is not None,
        "pushes": bool(problem.pushes), "growth": problem.growth is not None, **others,
    }  # fmt: skip
    if found := [name for name, is_there in lacking.items() if is_there]:
        raise ValueError(f"{caller}: got {' and '.join(found)}; wanted {wanted}")
    kinds = sorted({kind for pair in grid.edges if pair for kind in pair if kind != "projected"})
    if kinds:
        raise ValueError(f"{caller}: got {' and '.join(kinds)} ends; wanted projected ends or periodic axes{advice}")
