"""Timing on a machine that others use too: candidates take turns, and ratios are taken round by round.

A first call stands apart, since it compiles. Load that comes and goes then meets all candidates alike; what one
quotes is the ratio, and the median over the rounds.
"""

import dataclasses
import time
from collections.abc import Callable, Hashable, Mapping
from statistics import median
from typing import Any, TypeVar

import jax

Name = TypeVar("Name", bound=Hashable)
PAUSE = 0.02  # seconds between two candidates: the threads of some runtimes spin on for a few milliseconds


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds of the first call and of every later one, and the processor's seconds of those on all cores."""

    first: float
    rounds: tuple[float, ...]
    busy: tuple[float, ...]

    @property
    def seconds(self) -> float:
        """The median of the later calls."""
        return median(self.rounds)

    @property
    def compile_seconds(self) -> float:
        """How much longer the first call took."""
        return max(0.0, self.first - self.seconds)

    def over(self, other: "Timing") -> float:
        """How many times as long as ``other``: the median over the rounds of the ratio in each."""
        return median(mine / theirs for mine, theirs in zip(self.rounds, other.rounds, strict=True))

    @property
    def row(self) -> dict[str, Any]:
        """The numbers of a row."""
        return {
            "seconds": self.seconds,
            "fastest": min(self.rounds),
            "cpu_seconds": median(self.busy),
            "compile_seconds": self.compile_seconds,
            "repeats": len(self.rounds),
        }


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """What ``call`` returns, ready, and its wall time in seconds."""
    began = time.perf_counter()
    result = jax.block_until_ready(call())
    return result, time.perf_counter() - began


def _nothing() -> None:
    pass


def interleaved(
    candidates: Mapping[Name, Callable[[], Any]], repeats: int, before: Mapping[Name, Callable[[], Any]] | None = None
) -> tuple[dict[Name, Any], dict[Name, Timing]]:
    """Calls every candidate once, then ``repeats`` rounds of all of them in turn.

    Args:
      candidates: by name, what to call.
      repeats: rounds after the first.
      before: by name, what to call before a candidate, outside of its seconds.

    Returns:
      The last result and the timing of every candidate.
    """
    results: dict[Name, Any] = {}
    seconds: dict[Name, list[float]] = {name: [] for name in candidates}
    busy: dict[Name, list[float]] = {name: [] for name in candidates}
    for _ in range(1 + repeats):
        for name, call in candidates.items():
            results[name] = None  # before the next one is made: two of them may not fit
            (before or {}).get(name, _nothing)()
            began = time.process_time()
            results[name], took = timed(call)
            busy[name].append(time.process_time() - began)
            seconds[name].append(took)
            time.sleep(PAUSE)
    return results, {
        name: Timing(first, tuple(rest), tuple(busy[name][1:])) for name, (first, *rest) in seconds.items()
    }
