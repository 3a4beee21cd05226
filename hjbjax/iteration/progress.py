"""The record of an iteration: the number of evaluated values, the least error and residual, and the status.

An iteration evaluates a guess and then one value per step. Each evaluation measures the error and the residual of a
value. It counts as progress if the error or the residual is smaller than in all earlier evaluations.
"""

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.iteration.certificates import ErrorBound
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import DType, Number, Scalar
from hjbjax.solution.status import Status

S = TypeVar("S")

HISTORY = 256  # largest number of evaluations per chunk; the residual of each is recorded
GROWTH = 1e6  # an iteration diverges if its residual exceeds the smallest one by this factor
PATIENCE = 10  # steps without progress before the iteration stops, if the residual is rounding
ROUNDING = 64  # units in the last place of max|V|; a smaller residual is rounding


@pytree_dataclass()
class Progress:
    """The record of an iteration.

    Args:
      evaluations: the number of evaluated values: the guess, and one per step.
      best: the least error and the least residual so far, (2,).
      since_best: the number of evaluations since either of them decreased.
      code: the status.
      history: the residuals of this chunk, (HISTORY,); unused entries are −1.
    """

    evaluations: Scalar
    best: jax.Array
    since_best: Scalar
    code: Scalar
    history: jax.Array

    @property
    def steps(self) -> int:
        """The number of steps after the evaluation of the guess; for concrete numbers."""
        return max(int(self.evaluations) - 1, 0)

    @property
    def has_begun(self) -> bool:
        """True if the guess has been evaluated; for concrete numbers."""
        return int(self.evaluations) > 0

    def is_running(self, until: Number) -> jax.Array:
        """True if the status is RUNNING and fewer than ``until`` values have been evaluated."""
        return (self.code == Status.RUNNING) & (self.evaluations < until)

    def measure(self, bound: ErrorBound, chunk: Scalar) -> "Progress":
        """Count an evaluation and record its residual; ``chunk`` is the number of evaluations before this chunk."""
        since = jnp.where(jnp.any(_measures(bound) < self.best), 0, self.since_best + 1)
        history = self.history.at[self.evaluations - chunk].set(bound.residual)
        return dataclasses.replace(self, evaluations=self.evaluations + 1, since_best=since, history=history)

    def judge(self, bound: ErrorBound, code: Scalar) -> "Progress":
        """Record the status after an evaluation, and its error and residual unless they are not finite."""
        best = jnp.fmin(self.best, _measures(bound))  # fmin ignores NaN
        return dataclasses.replace(self, code=code, best=jnp.where(code == Status.NONFINITE, self.best, best))


def no_progress(dtype: DType, xp: Any = np) -> Progress:
    """The record before the first evaluation; by default in NumPy, so that nothing is compiled."""
    counter, code = xp.zeros((), xp.int32), xp.asarray(int(Status.RUNNING), xp.int32)
    # infinite rather than NaN, which jax_debug_nans would report
    return Progress(counter, xp.full(2, xp.inf, dtype), counter, code, xp.full(HISTORY, -1, dtype))


def no_bound(dtype: DType, xp: Any = np) -> ErrorBound:
    """The error bound of a value that has not been evaluated: infinite."""
    infinite = xp.asarray(xp.inf, dtype)
    return ErrorBound(-infinite, infinite, xp.zeros((), dtype), infinite, infinite)


def keep_finite(code: Scalar, after: S, before: S) -> S:
    """The state after a step, or the state before it if the step produced numbers that are not finite."""
    return jax.tree.map(lambda new, old: jnp.where(code == Status.NONFINITE, old, new), after, before)


def _measures(bound: ErrorBound) -> jax.Array:
    """Error and residual, (2,)."""
    return jnp.stack([bound.error, bound.residual])
