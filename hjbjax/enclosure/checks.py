"""Checks of the arguments that ``enclose`` and ``enclose_tube`` share."""

from collections.abc import Mapping

from hjbjax.problem.problem import Problem, is_random
from hjbjax.problem.pytree import is_traced
from hjbjax.solution.solution import Solution


def check_types(caller: str, problem: Problem, solution: Solution) -> None:
    """Refuse arguments of other types, and traced numbers."""
    for given, kind in ((problem, Problem), (solution, Solution)):
        if not isinstance(given, kind):
            raise TypeError(f"{caller}: got {type(given).__name__}, wanted a {kind.__name__}")
    if is_traced(problem, solution.value):
        raise ValueError(f"{caller}: got traced numbers; call it outside of jit, vmap and grad")


def check_ingredients(caller: str, problem: Problem, others: Mapping[str, bool], wanted: str) -> None:
    """Refuse a problem with an ingredient for which there is no proof.

    Args:
      caller: the public function.
      problem: the problem.
      others: further ingredients that the caller refuses, with True if the problem has them.
      wanted: the end of the message.

    Raises:
      ValueError: the problem has one of these ingredients, random paths, modes, pushes or growth.
    """
    lacking = {
        "random paths (noise, jumps or modes)": is_random(problem), "modes": problem.modes is not None,
        "pushes": bool(problem.pushes), "growth": problem.growth is not None, **others,
    }  # fmt: skip
    if found := [name for name, is_there in lacking.items() if is_there]:
        raise ValueError(f"{caller}: got {' and '.join(found)}; wanted {wanted}")


def check_ends(caller: str, solution: Solution, advice: str) -> None:
    """Refuse a grid with ends that are neither projected nor periodic."""
    kinds = sorted({kind for pair in solution.grid.edges if pair for kind in pair if kind != "projected"})
    if kinds:
        raise ValueError(f"{caller}: got {' and '.join(kinds)} ends; wanted projected ends or periodic axes{advice}")
