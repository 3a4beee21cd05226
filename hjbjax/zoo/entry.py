"""One entry of the catalogue: a ready problem, its exact value if known, and an initial state for a trajectory."""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.zoo.ingredients import Exact, Feedback


@dataclasses.dataclass(frozen=True)
class Entry:
    """A ready problem and its name.

    Args:
      name: the name on the command line, with hyphens.
      summary: one line.
      build: ``build(**parameters) -> (problem, grid)``.
      exact: ``exact(**parameters) -> value``, a function of one state that works under ``jit`` and ``vmap``. It takes
        the keywords of ``build`` except ``shape``. ``None`` if no exact value is known.
      start: the initial state of the trajectory in the gallery.
      duration: the length of this trajectory, in units of time.
      mode: the mode in which it starts, for a problem with modes.
      finish: ``finish(**parameters) -> (problem, feedback)`` with the keywords of ``exact``, for a problem whose target
        prescribes the cost of a final phase. It returns the problem of the final phase, which ends where the full
        problem ends, and its exact feedback. ``None`` if there is no final phase.
      kinked: True if optimal paths follow kinks of the value, where the gallery uses ``SemiLagrangian()``.

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
    kinked: bool = False
    mode: str | None = None

    @property
    def parameters(self) -> dict[str, Any]:  # numbers, tuples of numbers, booleans or None
        """The keywords of ``build`` with their defaults."""
        # read from the signature, so the command line offers exactly the keywords that the function accepts
        return {name: argument.default for name, argument in inspect.signature(self.build).parameters.items()}

    def initial_state(self, ndim: int) -> tuple[float, ...]:
        """``start`` in ``ndim`` dimensions, truncated or padded with zeros if a parameter changed the dimension."""
        # in every entry with a variable dimension, zero is the target or the centre of the box
        return (self.start + (0.0,) * ndim)[:ndim]
