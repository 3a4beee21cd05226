"""Timing on a shared machine: candidates take turns, and ratios are taken per round.

Changing load then affects all candidates equally. Quote the ratio, as the median over the rounds. First calls are
separate, because they compile.
"""

import dataclasses
import time
from collections.abc import Callable, Hashable, Mapping
from statistics import median
from typing import Any, TypeVar

import jax

Name = TypeVar("Name", bound=Hashable)
PAUSE = 0.02  # seconds between two candidates: threads of some runtimes keep spinning for a few milliseconds


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds of the first call and of every later call, and CPU seconds of the later calls on all cores."""

    first: float
    rounds: tuple[float, ...]
    busy: tuple[float, ...]

    @property
    def seconds(self) -> float:
        """The median of the later calls."""
        return median(self.rounds)

    @property
    def compile_seconds(self) -> float:
        """The additional seconds of the first call."""
        return max(0.0, self.first - self.seconds)

    def over(self, other: "Timing") -> float:
        """The ratio to ``other``: the median over the rounds."""
        return median(mine / theirs for mine, theirs in zip(self.rounds, other.rounds, strict=True))

    @property
    def row(self) -> dict[str, Any]:
        """The entries of a row."""
        return {
            "seconds": self.seconds,
            "fastest": min(self.rounds),
            "cpu_seconds": median(self.busy),
            "compile_seconds": self.compile_seconds,
            "repeats": len(self.rounds),
        }


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """The result of ``call``, ready, and its wall time in seconds."""
    began = time.perf_counter()
    result = jax.block_until_ready(call())
    return result, time.perf_counter() - began


def _nothing() -> None:
    pass


def interleaved(
    candidates: Mapping[Name, Callable[[], Any]], repeats: int, before: Mapping[Name, Callable[[], Any]] | None = None
) -> tuple[dict[Name, Any], dict[Name, Timing]]:
    """Call every candidate once, and then all of them in turn for ``repeats`` rounds.

    Args:
      candidates: functions to call, by name.
      repeats: rounds after the first.
      before: functions to call before a candidate, outside of its seconds, by name.

    Returns:
      The last result and the timing of every candidate.
    """
    results: dict[Name, Any] = {}
    seconds: dict[Name, list[float]] = {name: [] for name in candidates}
    busy: dict[Name, list[float]] = {name: [] for name in candidates}
    for _ in range(1 + repeats):
        for name, call in candidates.items():
            results[name] = None  # free the old result first: two results may not fit in memory
            (before or {}).get(name, _nothing)()
            began = time.process_time()
            results[name], took = timed(call)
            busy[name].append(time.process_time() - began)
            seconds[name].append(took)
            time.sleep(PAUSE)
    return results, {
        name: Timing(first, tuple(rest), tuple(busy[name][1:])) for name, (first, *rest) in seconds.items()
    }
