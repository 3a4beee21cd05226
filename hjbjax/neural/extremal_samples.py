"""Values and costates along extremals, as data for training and for tests on states that training has not seen."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.indirect_method import pontryagin
from hjbjax.neural.ansatz import target_level
from hjbjax.problem.problem import Problem
from hjbjax.problem.types import State
from hjbjax.solution.clock import Clock
from hjbjax.solution.solution import SolveError

POINTS = 32  # per extremal, at equal distances along it in units of the box
# Of an extremal, whose mesh nodes are the data. With 1e-5 it takes a sixth of the time but has fewer nodes. The worst
# of 100 closed loops of a satellite then costs 2.9 % more than its extremal, with 1e-8 less than 2 %.
TOL = 1e-8


@dataclasses.dataclass
class ExtremalSamples:
    """Points of extremals that begin in a box.

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

    def __post_init__(self) -> None:
        size, n = max(self.capacity, 1) * POINTS, len(self.lo)
        self.times, self.values = np.zeros(size), np.ones(size)
        self.states, self.costates = np.zeros((size, n)), np.zeros((size, n))

    def collect(self, problem: Problem, starts: Iterable[State], clock: Clock) -> None:
        """Add the extremals from those starts that are outside the target, until the clock is over."""
        for start in starts:
            if problem.target is not None and target_level(problem, 0.0, jnp.asarray(start)) <= 0:
                continue
            if clock.over() is not None or len(self.starts) == self.capacity:
                return
            try:
                extremal = pontryagin(problem, np.asarray(start), tol=TOL, **self.options)
            except (SolveError, ValueError):
                self.failed += 1
                continue
            self.starts.append(np.asarray(start))
            self.costs.append(float(extremal.cost))
            self.longest = max(self.longest, float(extremal.horizon))
            states = np.asarray(extremal.states)
            length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(states / (self.hi - self.lo), axis=0), axis=1)))
            # nodes of the mesh, where the collocation is most accurate
            kept = np.unique(np.searchsorted(length, np.linspace(0.0, length[-1], POINTS), side="left"))
            rows = slice(self.count, self.count + len(kept))
            for name in ("times", "states", "values", "costates"):
                getattr(self, name)[rows] = np.asarray(getattr(extremal, name))[kept]
            self.count += len(kept)

    def arrays(self) -> dict[str, Any]:
        """The arrays for a compiled loss; with weight zero if there are no points."""
        names = ("times", "states", "values", "costates")
        return {name: jnp.asarray(getattr(self, name)) for name in names} | {
            "count": jnp.asarray(max(self.count, 1)), "weight": jnp.asarray(float(self.count > 0)),
        }  # fmt: skip
