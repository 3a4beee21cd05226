"""The answer of ``hinf_level``: the least gain, what was tried for it, and whether its feedback stabilises."""

import dataclasses

from hjbjax.applications.l2_gain import Saturation
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """The verdict on one γ, and what it rests on.

    Args:
      gamma: γ.
      feasible: True where the value settled.
      reason: "settled", "saturated", "growing" or "not finite"; "interrupted" or "out of time" is no verdict.
      time: the time T that was marched.
      growth: what V grew by over the last doubling of T, over its size, in the inner box.
      value: the largest V there.
      saturation: how near the worst disturbance came to its bound at the end.
      solution: V_T and both feedbacks, as a stationary solution; its status is that of the last march.
    """

    gamma: float
    feasible: bool
    reason: str
    time: float
    growth: float
    value: float
    saturation: Saturation
    solution: Solution


@dataclasses.dataclass(frozen=True, eq=False)
class Level:
    """The least γ found feasible, and all that was tried; ``print`` shows the table.

    Args:
      gamma: γ, the upper end of the bracket.
      bracket: the largest γ not shown to be feasible, and the least that is; 0 and infinity before there is one.
      trials: everything tried, by γ.
      status: CONVERGED; of a search that was cut short, INTERRUPTED or TIME_LIMIT.
      stabilises: False where the feedback at ``gamma`` does not bring the state back without a disturbance: an unstable
        mode that the cost does not see. The level of a stabilising feedback is then higher, or there is none. None
        where this was not looked at.
    """

    gamma: float
    bracket: tuple[float, float]
    trials: tuple[Trial, ...]
    status: Status = Status.CONVERGED
    stabilises: bool | None = None

    @property
    def solution(self) -> Solution:
        """The value and the feedbacks at ``gamma``; without a feasible γ those of the last trial."""
        return next((trial for trial in self.trials if trial.gamma == self.gamma), self.trials[-1]).solution

    @property
    def saturated(self) -> float:
        """The largest γ at which a disturbance on its bound decided, and not growth; 0 where none did.

        As the lower end of the bracket it leaves open whether the level is that of the plant or that of the sets: where
        V grows without bound at the level, disturbances of any size saturate just above it.
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
