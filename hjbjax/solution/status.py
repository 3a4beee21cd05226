"""The ways in which a solve ends, and its warnings, which name the line of the user's."""

import contextlib
import enum
import sys
from collections.abc import Iterator
from contextvars import ContextVar

from hjbjax.problem import streams


class Status(enum.IntEnum):
    """The end of a solve; ``.message`` says what happened and what to do.

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
        """The event and the remedy, in one sentence."""
        return MESSAGES[self]

    def __str__(self) -> str:
        return self.name  # what IntEnum prints is the bare number


MESSAGES = {
    Status.RUNNING: "The solve has not ended; let it run on.",
    Status.CONVERGED: "The residual meets the tolerance; nothing is left to do.",
    Status.MAX_STEPS: "The steps ran out above the tolerance; raise max_steps, or go on from here with guess=.",
    Status.STALLED: "The residual stopped falling above the tolerance; loosen tol or compute in float64.",
    Status.DIVERGED: "The residual grew; check discount and target, take a better guess or another method.",
    Status.NONFINITE: "NaN or infinity appeared and the last finite value is kept; check drift and cost there.",
    Status.INTERRUPTED: "The solve was interrupted and the value so far is kept; go on from it with guess=.",
    Status.TIME_LIMIT: "The time ran out above the tolerance; raise time_limit, or go on from here with guess=.",
}


class SolveWarning(UserWarning):
    """The solve went through, and something about its answer deserves attention."""


_unsaid: ContextVar[list[str] | None] = ContextVar("unsaid warnings of a solve in a thread", default=None)


@contextlib.contextmanager
def keeping_warnings() -> Iterator[list[str]]:
    """Context in which ``warn`` writes into a list: in a thread no line of the user's is to be found."""
    said: list[str] = []
    token = _unsaid.set(said)
    try:
        yield said
    finally:
        _unsaid.reset(token)


def warn(message: str, category: type[Warning] = SolveWarning) -> None:
    """Warn at the line outside of the package from which the front door was called."""
    said = _unsaid.get()
    if said is not None:
        said.append(message)
        return
    # the line of the user's: Python shows a warning once a line, which inside the package would be once for ever
    package, frame, level = __name__.split(".")[0], sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] == package:
        frame, level = frame.f_back, level + 1
    streams.warn(message, category, stacklevel=level)
