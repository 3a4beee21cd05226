"""What breaks a run from outside: memory that runs out on the way, a callback of the user's that raises.

The exception goes through, with what was there before it as ``.solution``; one for memory becomes a ``MemoryError``
that says what was needed and what is free.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import TypeAlias

import jax
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Nodes
from hjbjax.solution.clock import Clock
from hjbjax.solution.solution import Solution
from hjbjax.solvers import memory

CALLBACK = "CpuCallback error"  # how JAX heads the exception of a callback, whatever its type

Kept: TypeAlias = tuple[np.ndarray, Grid]  # node values that outlived an exception, and their grid


def keep(error: Exception, grid: Grid, *values: Callable[[], Nodes]) -> None:
    """Attach to an exception the first of some node values that can still be read: a broken run takes its own along."""
    for value in values:
        # a buffer that was donated, or that waits for the program that failed, raises when it is read
        with contextlib.suppress(Exception):
            error.kept = np.asarray(value()), grid  # type: ignore[attr-defined]
            return


@contextlib.contextmanager
def with_solution(clock: Clock, needed: int, partial: Callable[[Kept | None], Solution | None]) -> Iterator[None]:
    """Let exceptions of the runtime leave with the solution so far.

    Args:
      clock: how far the run came.
      needed: the estimate of its memory, in bytes.
      partial: from what ``keep`` noted, or None, to the solution so far.

    Raises:
      MemoryError: memory ran out.
    """
    try:
        yield
    except Exception as error:
        # XLA reports memory that ran out by a status in the text, NumPy by the type
        starved = isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)
        # a refusal of the package's own says all there is to say, and has no value beside it
        if not (starved or isinstance(error, jax.errors.JaxRuntimeError) or CALLBACK in str(error)):
            raise
        solution = getattr(error, "solution", None)
        if solution is None:
            with contextlib.suppress(MemoryError):  # too little is left even for that
                solution = partial(getattr(error, "kept", None))
        where = f"It came as far as {clock.phase}; the value so far is .solution of this exception."
        if starved:
            raise _memory_error(error, needed, where, solution) from error
        error.solution = solution  # type: ignore[attr-defined]
        error.add_note(where)
        raise


def _memory_error(error: Exception, needed: int, where: str, solution: Solution | None) -> MemoryError:
    """The report of memory that ran out: what was needed, what is free now, and the solution so far."""
    # the first line alone: the runtime may append a list of all its buffers
    free, said = memory.available(), (str(error).strip() or type(error).__name__).splitlines()[0][:200]
    left = "" if free is None else f", {free / 1e9:.3g} GB are free now"
    report = MemoryError(
        f"memory ran out: {said}\nThe run was estimated at {needed / 1e9:.3g} GB{left}. Take fewer nodes or "
        f"dtype='float32'; {memory.NO_GRID}.\n{where}"
    )
    report.solution = solution  # type: ignore[attr-defined]
    return report
