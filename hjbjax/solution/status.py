"""The ways in which a solve ends, and warnings that point at the line of the user's code."""

import contextlib
import enum
import sys
from collections.abc import Iterator
from contextvars import ContextVar

from hjbjax.problem import streams


class Status(enum.IntEnum):
    """The outcome of a solve; ``.message`` explains it and gives a remedy.

    Example:
      >>> print(Status(3), int(Status.STALLED))
      STALLED 3
    """

    RUNNING = 0
    CONVERGED = 1
    MAX_STEPS = 2
    STALLED = 3
    DIVERGED = 4
    NONFINITE = 5
    INTERRUPTED = 6
    TIME_LIMIT = 7

    @property
    def message(self) -> str:
        """The outcome and the remedy in one sentence."""
        return MESSAGES[self]

    def __str__(self) -> str:
        return self.name  # IntEnum prints the number


MESSAGES = {
    Status.RUNNING: "The solve is still running.",
    Status.CONVERGED: "Converged to the requested tolerance.",
    Status.MAX_STEPS: "Reached max_steps before the tolerance; raise max_steps, or continue with guess=solution.value.",
    Status.STALLED: "The residual stopped decreasing before the tolerance; increase tol or compute in float64.",
    Status.DIVERGED: "The residual grew; check discount and target, or try a better guess or another method.",
    Status.NONFINITE: "NaN or infinity appeared and the last finite value is kept; check drift and cost.",
    Status.INTERRUPTED: "The solve was interrupted and the value so far is kept; continue with guess=solution.value.",
    Status.TIME_LIMIT: "Reached time_limit before the tolerance; raise it, or continue with guess=solution.value.",
}


class SolveWarning(UserWarning):
    """The solve completed, but something about its result deserves attention."""


_unsaid: ContextVar[list[str] | None] = ContextVar("unsaid warnings of a solve in a thread", default=None)


@contextlib.contextmanager
def keeping_warnings() -> Iterator[list[str]]:
    """Context in which ``warn`` appends to a list, because the stack of a thread does not contain the user's code."""
    said: list[str] = []
    token = _unsaid.set(said)
    try:
        yield said
    finally:
        _unsaid.reset(token)


def warn(message: str, category: type[Warning] = SolveWarning) -> None:
    """Warn at the line outside the package that called the public function."""
    said = _unsaid.get()
    if said is not None:
        said.append(message)
        return
    # Python shows a warning once per line; a line inside the package would show it only once per session
    package, frame, level = __name__.split(".")[0], sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] == package:
        frame, level = frame.f_back, level + 1
    streams.warn_safely(message, category, stacklevel=level)
