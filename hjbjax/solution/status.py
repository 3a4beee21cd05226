"""The ways in which a solve ends."""

import enum


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
