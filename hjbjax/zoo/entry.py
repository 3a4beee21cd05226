"""One line of the catalogue: a ready problem, its answer where one is known, and a path worth drawing."""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.zoo.ingredients import Exact, Feedback


@dataclasses.dataclass(frozen=True)
class Entry:
    """A ready problem under its name.

    Args:
      name: the name on the command line, with hyphens.
      summary: one line.
      build: ``build(**parameters) -> (problem, grid)``.
      exact: ``exact(**parameters) -> value``, a function of one state that ``jit`` and ``vmap`` accept; it takes
        the keywords of ``build`` except ``shape``. ``None`` where no answer is known.
      start: the initial state of the picture of a trajectory.
      duration: its length, in units of time.
      finish: ``finish(**parameters) -> (problem, feedback)``, with the keywords of ``exact``, where the target holds
        the cost of what follows: the system with its true end, and the exact feedback until there. ``None`` where
        nothing is to follow.

    Example:
      >>> from hjbjax import zoo
      >>> entry = zoo.catalogue["bang-bang"]
      >>> problem, grid = entry.build(discount=2.0)
      >>> float(entry.exact(discount=2.0)([0.0]))
      0.0
    """

    name: str
    summary: str
    build: Callable[..., tuple[Problem, Grid]]
    exact: Callable[..., Exact] | None = None
    start: tuple[float, ...] = ()
    duration: float = 5.0
    finish: Callable[..., tuple[Problem, Feedback]] | None = None

    @property
    def parameters(self) -> dict[str, Any]:  # numbers, tuples of them, truth values or None
        """The keywords of ``build`` with their defaults."""
        # of the function itself: the command line offers exactly what it takes
        return {name: argument.default for name, argument in inspect.signature(self.build).parameters.items()}

    def initial_state(self, ndim: int) -> tuple[float, ...]:
        """``start`` in ``ndim`` dimensions: cut, or filled up with zeros, where a parameter chose another number."""
        # zero is the target, or the middle of the box, in the entries whose dimension a parameter chooses
        return (self.start + (0.0,) * ndim)[:ndim]
