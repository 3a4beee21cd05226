"""The result of ``hinf_level``: the least gain, all trials, and a check that the feedback stabilises.

The check simulates the closed loop without a disturbance from the corners of an inner box.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.applications.l2_gain import Saturation
from hjbjax.feedback.path import PathStatus
from hjbjax.feedback.simulation import rollout
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, State
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status
from hjbjax.tracing.closures import settled

LOOKS = 8  # output intervals of a path, of which only the last state is used
RTOL, ATOL = 1e-4, 1e-6  # tolerances of the paths; an unstable mode grows at any tolerance
NEARER = 0.5  # largest ratio of final to initial spread along each axis; a mode at rest has the ratio 1


@dataclasses.dataclass(frozen=True, eq=False)
class Growth:
    """A march from V = 0 whose time is doubled repeatedly.

    Args:
      values: V_T at up to three times, the latest last, each of shape (*grid).
      time: the last T.
      seconds: the wall time so far.
    """

    values: tuple[np.ndarray, ...]
    time: float = 0.0
    seconds: float = 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """The result for one γ.

    Args:
      gamma: γ.
      feasible: True if the value settled.
      reason: "settled", "saturated", "growing" or "not finite"; "interrupted" and "out of time" are not verdicts.
      time: the time T of the march.
      growth: the relative growth of V over the last doubling of T, the larger one of the inner box and the whole box.
      value: the largest V in the inner box.
      saturation: the distance of the worst disturbance from its bound at the end.
      solution: V_T and both feedbacks as a stationary solution, with the status of the last march.
      march: the values of the march, from which it can continue.
    """

    gamma: float
    feasible: bool
    reason: str
    time: float
    growth: float
    value: float
    saturation: Saturation
    solution: Solution
    march: Growth


@dataclasses.dataclass(frozen=True, eq=False)
class Level:
    """The least γ found feasible, and all trials; ``print`` shows the table.

    Args:
      gamma: γ, the upper end of the bracket.
      bracket: the largest γ not shown to be feasible, and the least feasible γ; 0 and infinity if there is none.
      trials: all trials, ordered by γ.
      status: CONVERGED, or INTERRUPTED or TIME_LIMIT if the search was cut short.
      stabilises: False if the feedback at ``gamma`` does not bring the state back without a disturbance. The plant then
        has an unstable mode that the cost does not detect, and the level of a stabilising feedback is higher or does
        not exist. None if this was not checked.
    """

    gamma: float
    bracket: tuple[float, float]
    trials: tuple[Trial, ...]
    status: Status = Status.CONVERGED
    stabilises: bool | None = None

    @property
    def solution(self) -> Solution:
        """The value and the feedbacks at ``gamma``; without a feasible γ, the solution of the last trial."""
        return next((trial for trial in self.trials if trial.gamma == self.gamma), self.trials[-1]).solution

    @property
    def saturated(self) -> float:
        """The largest γ that is infeasible because a disturbance reached its bound, not because V grew; 0 if none.

        If it is the lower end of the bracket, the level may be due to the plant or to the sets. If V is unbounded at
        the level itself, any set of disturbances saturates just above the level.
        """
        return max((trial.gamma for trial in self.trials if trial.reason == "saturated"), default=0.0)

    def __repr__(self) -> str:
        return f"Level(gamma={self.gamma:.6g}, bracket=({self.bracket[0]:.6g}, {self.bracket[1]:.6g}))"

    def __str__(self) -> str:
        lines = [f"least level {self.gamma:.4g}, not shown at {self.bracket[0]:.4g}"]
        if self.stabilises is False:
            lines.append("feasible, but the feedback does not stabilise: without a disturbance it does not come back")
        if self.saturated:
            lines.append(f"at gamma = {self.saturated:.4g} and below saturation decided, not growth")
        lines.append(f"{'gamma':>9} {'':<11} {'time':>7} {'growth':>8} {'V':>9} {'|d|/bound':>9}")
        for one in self.trials:
            lines.append(
                f"{one.gamma:>9.4g} {one.reason:<11} {one.time:>7.3g} {one.growth:>8.1e} {one.value:>9.3g} "
                f"{one.saturation.largest:>9.2f}"
            )
        return "\n".join(lines)


def comes_back(problem: Problem, solution: Solution, inner: float, duration: float) -> bool:
    """True if all paths from the corners of the inner box stay in the box and end closer together than they began.

    No rest point is needed. An unstable mode in the box would make paths leave it or keep them apart, and a neutral
    mode would keep their distance constant.

    Args:
      problem: the game; its disturbance is set to zero.
      solution: its stationary solution with the feedback.
      inner: the fraction of the grid's box, around its centre.
      duration: the duration of the paths, in units of time.
    """
    grid = solution.grid
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=grid.ndim)))
    half = 0.5 * (np.asarray(grid.hi) - np.asarray(grid.lo))
    starts = np.asarray(grid.lo) + half + inner * half * signs  # (2^n, n)
    times = np.linspace(0.0, duration, LOOKS + 1)
    # float64, and functions marked so that ``jit`` reuses the programs of an earlier call
    with own_settings(x64=True):
        found = _ends(*cast((settled(problem, grid.ndim), solution, starts, times), np.float64))
    codes, ends = map(np.asarray, found)
    if np.any(codes != PathStatus.DURATION):
        return False
    return bool(np.all(_spread(grid, ends) <= NEARER * _spread(grid, starts)))


@jax.jit
def _ends(problem: Problem, solution: Solution, starts: Array, times: Array) -> tuple[Array, Array]:
    """Simulate the undisturbed paths from states (k, n) and return their codes and last states."""
    assert problem.disturbances is not None
    nothing = jnp.zeros(problem.disturbances.dim, starts.dtype)

    def end(start: State) -> tuple[Array, Array]:
        path = rollout(problem, solution, start, times, disturbance=lambda x: nothing, rtol=RTOL, atol=ATOL)
        return path.code, path.states[-1]

    return jax.vmap(end)(starts)


def _spread(grid: Grid, states: np.ndarray) -> np.ndarray:
    """The largest distance from the first state along each axis, shape (n,), the short way round a periodic axis."""
    width = np.asarray(grid.hi) - np.asarray(grid.lo)
    apart = states - states[0]
    turns = np.where(np.array(grid.periodic), np.round(apart / width), 0)
    return np.max(np.abs(apart - width * turns), axis=0)
