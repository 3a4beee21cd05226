"""The result of a simulation: a path, the reason for its end, and a one-line message."""

import dataclasses
import enum
from typing import Any

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST
from hjbjax.problem.pytree import is_traced, pytree_dataclass, with_ways_out
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Simplex, holds
from hjbjax.problem.streams import encodable
from hjbjax.problem.types import Array
from hjbjax.problem.words import OF_PATH
from hjbjax.solution.status import warn

MANY = 1000  # internal steps: with more, and more than an eighth of max_steps, the feedback probably jumps


class PathStatus(enum.IntEnum):  # integers, because compiled programs and vmap support no other type
    """The reason why a path ends."""

    DURATION = 0
    TARGET = 1
    LEFT_BOX = 2
    MAX_STEPS = 3
    NONFINITE = 4
    UNDEFINED = 5
    INTERRUPTED = 6

    @property
    def message(self) -> str:
        """The end of the path, and advice, in words that follow 'the path'."""
        return MESSAGES[self]


MESSAGES = {
    PathStatus.DURATION: "ran for the whole duration",
    PathStatus.TARGET: "reached the target",
    PathStatus.LEFT_BOX: "stopped where it left the box of the grid; enlarge the grid, or continue with clamp=True",
    PathStatus.MAX_STEPS: "stopped after max_steps internal steps; use hold=dt, or a larger max_steps",
    PathStatus.NONFINITE: "stopped before a step to a state that is not finite; drift, cost or feedback are not finite",
    PathStatus.UNDEFINED: "stopped where the feedback has no control (NaN); the target may be unreachable from there",
    PathStatus.INTERRUPTED: "was interrupted",
}


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a simulation: ``.path`` is the Path so far."""

    def __init__(self, path: "Path"):
        super().__init__(f"simulate: the path {path.message}; .path is the path so far")
        self.path = path


@with_ways_out(OF_PATH)
@pytree_dataclass(static=("held", "payoff"), host=("message",))
class Path:
    """The history of a closed loop, truncated at its end.

    Args:
      times: shape (k+1,), from 0 to the end of the path.
      states: shape (k+1, n), periodic states unwound (``grid.wrap`` brings them into the grid).
      controls: shape (k, m), the control at the start of each interval; with ``hold``, throughout the interval.
      disturbances: shape (k, l), like controls, or None if there is no opponent.
      cost: discounted running cost plus the payment at the end: the discounted exit cost on the target, ψ where V = ψ,
        and what ``march`` assumed at the horizon. For a tube, the cost of the best moment to stop: the least ψ on the
        way, the largest ``running_max``, or with both the least of max{ψ, largest ``running_max`` so far}. For a
        problem with rewards it is minus ``reward``.
      reached: the time at which the target was reached, or None.
      code: a PathStatus number.
      steps: internal steps of the integrator, including rejected ones.
      message: one line on how the path ended.
      promised: V at the start if the feedback has a Solution, otherwise None. V is the mean cost, including the cost
        after the end of a short path, up to errors of the grid and the integrator.
      held: True if each control was constant through its interval, so that plots show steps.
      payoff: "cost" or "reward", the payments of the problem.
      modes: shape (k+1,), the number of the mode at every time; None for a problem without modes.
    """

    times: Any  # NumPy arrays and numbers from `simulate`; JAX arrays from `rollout`, with more axes under vmap
    states: Any
    controls: Any
    disturbances: Any
    cost: Any
    reached: Any
    code: Any
    steps: Any
    message: str = ""
    promised: Any = None
    held: bool = False
    payoff: str = COST
    modes: Any = None

    @property
    def reward(self) -> Any:
        """The discounted reward of the path, minus its cost; the value of the problem is the largest mean reward."""
        return 0 - self.cost

    @property
    def total(self) -> str:
        """The cost or the reward in words, with V at the start if it is known."""
        paid = float(self.cost if self.payoff == COST else self.reward)
        return f"{self.payoff} {paid:.6g}" + ("" if self.promised is None else f" (V promised {self.promised:.6g})")

    @property
    def status(self) -> PathStatus:
        """The reason why the path ends."""
        return PathStatus(int(self.code))

    def __repr__(self) -> str:
        if is_traced(self) or np.ndim(self.code):
            return f"Path(states of shape {np.shape(self.states)})"
        end, rows = float(self.times[-1]), len(self.times)
        paid = dataclasses.replace(self, promised=None).total
        return f"Path({self.status.name} at t = {end:.6g}, {rows} times, {paid})"

    def __str__(self) -> str:
        return encodable(self.message)  # a terminal may lack a character, and print would raise


def join_paths(first: Path, then: Path, discount: float) -> Path:
    """Two consecutive paths as one, with the running cost of both.

    Args:
      first: a path that pays nothing at its end.
      then: a path that starts from the last state of the first.
      discount: β of the problem.
    """
    end = first.times[-1]
    # the second path discounts from its own start, so its cost is multiplied by e^{−β end}
    cost, steps = float(first.cost + np.exp(-discount * end) * then.cost), first.steps + then.steps
    said = (
        f"{first.status.message} at t = {end:.6g}; from there {then.status.message} at t = {end + then.times[-1]:.6g}"
    )
    both = first.disturbances is None or then.disturbances is None
    return Path(
        times=np.concatenate([first.times, end + then.times[1:]]),
        states=np.concatenate([first.states, then.states[1:]]),
        # the state between the two paths appears once, the controls of all intervals are kept
        controls=np.concatenate([first.controls, then.controls]),
        disturbances=None if both else np.concatenate([first.disturbances, then.disturbances]),
        cost=cost,
        reached=None if then.reached is None else end + then.reached,
        code=then.code,
        steps=steps,
        message=f"{said}; {dataclasses.replace(first, cost=cost).total}; {steps} internal steps",
        promised=first.promised,
        held=first.held or then.held,
        payoff=first.payoff,
    )


def truncate(
    path: Path, count: int, max_steps: int, grid: Grid | None, controls: AdmissibleSet | None, noisy: bool
) -> Path:
    """A path of full length truncated at its end, with its message; warns if it ends early outside the target.

    Args:
      path: NumPy arrays over all output times.
      count: the number k of intervals before the end.
      max_steps: the largest number of internal steps allowed.
      grid: the box in which the feedback is known, or None.
      controls: the admissible set of the problem, or None.
      noisy: True if the steps were fixed in advance, so that their number says nothing about the loop.
    """
    status, times, states = path.status, path.times[: count + 1], path.states[: count + 1]
    applied = path.controls[:count]
    where = f"t = {times[-1]:.6g}"
    if status in (PathStatus.NONFINITE, PathStatus.UNDEFINED):  # the state helps to find the fault
        where += f", x = [{', '.join(f'{entry:.4g}' for entry in states[-1])}]"
    said = [
        f"{status.message} at {where}",
        path.total,
        f"{int(path.steps)} internal steps",
    ]
    # a path continues outside only with clamp=True; its periodic states are unwound, so they may leave the box
    if grid is not None and status != PathStatus.LEFT_BOX:
        outside = np.any(((states < grid.lo) | (states > grid.hi)) & ~np.array(grid.periodic), axis=-1)
        if outside.any():
            said.append(f"left the box at t = {times[np.argmax(outside)]:.6g}: controls there are the nearest point's")
    if not noisy and path.steps > max(MANY, max_steps / 8):
        said.append("the feedback jumps or the loop is stiff: hold=dt is faster")
    if _are_inadmissible(controls, applied):
        said.append("controls outside the problem's admissible set were applied as they are")
    if status not in (PathStatus.DURATION, PathStatus.TARGET, PathStatus.INTERRUPTED):  # an interrupt is raised
        warn(f"simulate: the path {said[0]}", UserWarning)
    return Path(
        times=times,
        states=states,
        controls=applied,
        disturbances=None if path.disturbances is None else path.disturbances[:count],
        cost=float(path.cost),
        reached=float(path.reached) if status == PathStatus.TARGET else None,
        code=int(path.code),
        steps=int(path.steps),
        message="; ".join(said),
        promised=path.promised,
        held=path.held,
        payoff=path.payoff,
    )


def _are_inadmissible(controls: AdmissibleSet | None, applied: Array) -> bool:
    """True if a control is outside its set by more than rounding; finite sets are not checked."""
    return isinstance(controls, (Box, Ball, Simplex)) and not np.all(holds(controls, applied))
