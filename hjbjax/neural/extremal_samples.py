"""Values and costates along extremals, as data for training and for tests on states that training has not seen."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.indirect_method import Extremal, pontryagin
from hjbjax.neural.ansatz import target_level
from hjbjax.problem.problem import Problem
from hjbjax.solution.checkpoints import check_alike
from hjbjax.solution.clock import Clock
from hjbjax.solution.solution import SolveError
from hjbjax.solution.status import Status

POINTS = 32  # per extremal, at equal distances along it in units of the box
# Of an extremal, whose mesh nodes are the data. With 1e-5 it takes a sixth of the time but has fewer nodes. The worst
# of 100 closed loops of a satellite then costs 2.9 % more than its extremal, with 1e-8 less than 2 %.
TOL = 1e-8
NAMES = ("times", "states", "values", "costates")  # of the arrays


@dataclasses.dataclass
class ExtremalSamples:
    """Points of extremals that begin in a box; also a part of a checkpoint.

    Args:
      lo: lower corner of the box.
      hi: upper corner.
      capacity: the largest number of extremals; arrays have this size, so that more extremals do not recompile.
      options: keyword arguments of ``pontryagin``.
      starts: the starts of the extremals.
      costs: their costs.
      longest: the longest of their horizons.
      count: the number of points.
      failed: the number of starts without an extremal.
      tried: the number of starts so far.
    """

    lo: np.ndarray
    hi: np.ndarray
    capacity: int
    options: dict[str, Any]
    starts: list[np.ndarray] = dataclasses.field(default_factory=list)
    costs: list[float] = dataclasses.field(default_factory=list)
    longest: float = 0.0
    count: int = 0
    failed: int = 0
    tried: int = 0
    passing: ClassVar[bool] = False

    def __post_init__(self) -> None:
        size, n = max(self.capacity, 1) * POINTS, len(self.lo)
        self.times, self.values = np.zeros(size), np.ones(size)
        self.states, self.costates = np.zeros((size, n)), np.zeros((size, n))

    def collect_all(self, problem: Problem, starts: np.ndarray, clock: Clock) -> None:
        """``collect`` as a part of its own in the journal of the clock, if any."""
        journal = clock.journal
        if journal is None:
            self.collect(problem, starts, clock)
        elif journal.enter(self) is None:
            self.collect(problem, starts, clock, keep=lambda: journal.keep(self))
            journal.leave(self, clock.over() or Status.CONVERGED)

    def collect(
        self,
        problem: Problem,
        starts: np.ndarray,
        clock: Clock,
        *,
        earlier: int = 0,
        keep: Callable[[], object] = lambda: None,
    ) -> None:
        """Add the extremals from those starts that are outside the target, until the clock is over.

        Args:
          problem: the settled problem.
          starts: the starts, shape (k, n); those that were tried before are skipped.
          clock: the limits.
          earlier: the number of starts of earlier calls.
          keep: called after each start.
        """
        for start in starts[self.tried - earlier :]:
            if clock.over() is not None or len(self.starts) == self.capacity:
                return
            if problem.target is None or target_level(problem, 0.0, jnp.asarray(start)) > 0:
                try:
                    extremal = pontryagin(problem, np.asarray(start), tol=TOL, **self.options)
                except (SolveError, ValueError):
                    extremal = None
                if clock.interrupted:  # this start is not complete
                    return
                self._add(np.asarray(start), extremal)
            self.tried += 1
            keep()

    def _add(self, start: np.ndarray, extremal: Extremal | None) -> None:
        """Add the points of an extremal; without one the start has failed."""
        if extremal is None:
            self.failed += 1
            return
        self.starts.append(start)
        self.costs.append(float(extremal.cost))
        self.longest = max(self.longest, float(extremal.horizon))
        states = np.asarray(extremal.states)
        length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(states / (self.hi - self.lo), axis=0), axis=1)))
        # nodes of the mesh, where the collocation is most accurate
        kept = np.unique(np.searchsorted(length, np.linspace(0.0, length[-1], POINTS), side="left"))
        rows = slice(self.count, self.count + len(kept))
        for name in NAMES:
            getattr(self, name)[rows] = np.asarray(getattr(extremal, name))[kept]
        self.count += len(kept)

    def saved(self) -> list[Any]:
        """The state as arrays, whose shapes depend on the capacity only."""
        found = len(self.starts)
        starts, costs = np.zeros((self.capacity, len(self.lo))), np.zeros(self.capacity)
        starts[:found], costs[:found] = np.reshape(self.starts, (found, len(self.lo))), self.costs
        numbers = np.array([found, self.count, self.failed, self.tried])
        return [numbers, np.asarray(self.longest), starts, costs, *(getattr(self, name) for name in NAMES)]

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Continue from the arrays of ``saved``.

        Raises:
          ValueError: the arrays are not a state of these samples.
        """
        check_alike(arrays, self.saved())
        (found, *numbers), longest, starts, costs, *points = arrays
        if not (0 <= found <= self.capacity and 0 <= numbers[0] <= len(self.times) and min(numbers) >= 0):
            raise ValueError(f"it has {found} extremals with {numbers[0]} points")
        self.count, self.failed, self.tried = map(int, numbers)
        self.longest, self.starts, self.costs = float(longest), list(starts[:found]), costs[:found].tolist()
        for name, each in zip(NAMES, points, strict=True):
            setattr(self, name, np.array(each))

    def arrays(self) -> dict[str, Any]:
        """The arrays for a compiled loss; with weight zero if there are no points."""
        return {name: jnp.asarray(getattr(self, name)) for name in NAMES} | {
            "count": jnp.asarray(max(self.count, 1)), "weight": jnp.asarray(float(self.count > 0)),
        }  # fmt: skip
