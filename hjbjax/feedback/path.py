"""The result of a simulation: a path, why it ends, and the line that says so."""

import enum
from typing import Any

import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, holds
from hjbjax.problem.streams import encodable
from hjbjax.problem.types import Array
from hjbjax.solution.status import warn

MANY = 1000  # internal steps, beside an eighth of those allowed: more of them tell of a feedback that jumps


class PathStatus(enum.IntEnum):  # of integers, since compiled programs and vmap know no others
    """Why a path ends."""

    DURATION = 0
    TARGET = 1
    LEFT_BOX = 2
    MAX_STEPS = 3
    NONFINITE = 4
    UNDEFINED = 5
    INTERRUPTED = 6

    @property
    def message(self) -> str:
        """The end and advice in words that follow 'the path'."""
        return MESSAGES[self]


MESSAGES = {
    PathStatus.DURATION: "ran for the whole duration",
    PathStatus.TARGET: "reached the target",
    PathStatus.LEFT_BOX: "stopped where it left the box of the grid; enlarge the grid, or go on with clamp=True",
    PathStatus.MAX_STEPS: "stopped after max_steps internal steps; give hold=dt, or more max_steps",
    PathStatus.NONFINITE: "stopped before a step to no finite state; drift, cost or feedback are not finite ahead",
    PathStatus.UNDEFINED: "stopped where the feedback has no control (NaN): the target may be out of reach from there",
    PathStatus.INTERRUPTED: "was interrupted",
}


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a simulation: ``.path`` is the Path so far."""

    def __init__(self, path: "Path"):
        super().__init__(f"simulate: the path {path.message}; .path is the path so far")
        self.path = path


@pytree_dataclass(static=("held",), host=("message",))
class Path:
    """A closed loop's history, truncated where it ends.

    Args:
      times: shape (k+1,), from 0; the last is where the path ends.
      states: shape (k+1, n), periodic states unwound (``grid.wrap`` brings them into the grid).
      controls: shape (k, m), the control at the start of each interval; under ``hold`` all through it.
      disturbances: shape (k, l), likewise, or None where there is no opponent.
      cost: discounted running cost, plus what is due at the end: the discounted exit cost on the target, ψ where V = ψ,
        and what ``march`` assumed at the horizon. Of a tube the cost of the best moment to stop: the least ψ on the
        way, the largest ``running_max``, or with both the least of max{ψ, largest ``running_max`` so far}.
      reached: the time at which the target was reached, or None.
      code: a PathStatus number.
      steps: internal steps of the integrator, rejected ones included.
      message: one line on how the path ended.
      promised: V at the start, where the feedback is a Solution or comes of one. The cost in the mean, with what is
        paid after a path that is cut short, up to errors of the grid and the integrator. Else None.
      held: whether each control was held through its interval, so that a picture shows steps.
    """

    times: Any  # NumPy arrays and numbers of `simulate`, JAX's of `rollout`, with more axes under vmap
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

    @property
    def status(self) -> PathStatus:
        """Why the path ends."""
        return PathStatus(int(self.code))

    def __repr__(self) -> str:
        if is_traced(self) or np.ndim(self.code):
            return f"Path(states of shape {np.shape(self.states)})"
        end, rows = float(self.times[-1]), len(self.times)
        return f"Path({self.status.name} at t = {end:.6g}, {rows} times, cost {float(self.cost):.6g})"

    def __str__(self) -> str:
        return encodable(self.message)  # a terminal may lack a letter, and print would raise


def joined(first: Path, then: Path, discount: float) -> Path:
    """Two paths in one, the second from where and when the first ends, with the running cost of both.

    Args:
      first: a path that pays nothing where it ends.
      then: a path from its last state.
      discount: β of the problem.
    """
    end = first.times[-1]
    # the second path discounts from its own start, which is e^{−β end} of what it counts for the whole
    cost, steps = float(first.cost + np.exp(-discount * end) * then.cost), first.steps + then.steps
    said = (
        f"{first.status.message} at t = {end:.6g}; from there {then.status.message} at t = {end + then.times[-1]:.6g}"
    )
    both = first.disturbances is None or then.disturbances is None
    return Path(
        times=np.concatenate([first.times, end + then.times[1:]]),
        states=np.concatenate([first.states, then.states[1:]]),
        # the state in which one ends and the other begins is there once, the controls of intervals all
        controls=np.concatenate([first.controls, then.controls]),
        disturbances=None if both else np.concatenate([first.disturbances, then.disturbances]),
        cost=cost,
        reached=None if then.reached is None else end + then.reached,
        code=then.code,
        steps=steps,
        message=f"{said}; cost {cost:.6g}{_beside(first.promised)}; {steps} internal steps",
        promised=first.promised,
        held=first.held or then.held,
    )


def _beside(promised: float | None) -> str:
    """The words for what V promised, behind the cost."""
    return "" if promised is None else f" (V promised {promised:.6g})"


def truncate(
    path: Path, count: int, max_steps: int, grid: Grid | None, controls: AdmissibleSet | None, noisy: bool
) -> Path:
    """A path of full length cut where it ends, with its message; one that ends early outside the target warns.

    Args:
      path: NumPy arrays over all output times.
      count: the number k of intervals before the end.
      max_steps: the most internal steps that it could make.
      grid: the box that the feedback is known in, if there is one.
      controls: the admissible set of the problem, or None.
      noisy: True where the steps were fixed in advance, so that their number says nothing of the loop.
    """
    status, times, states = path.status, path.times[: count + 1], path.states[: count + 1]
    applied = path.controls[:count]
    where = f"t = {times[-1]:.6g}"
    if status in (PathStatus.NONFINITE, PathStatus.UNDEFINED):  # the state is what one looks at to find the fault
        where += f", x = [{', '.join(f'{entry:.4g}' for entry in states[-1])}]"
    said = [
        f"{status.message} at {where}",
        f"cost {float(path.cost):.6g}{_beside(path.promised)}",
        f"{int(path.steps)} internal steps",
    ]
    # only with clamp=True does a path go on outside; its states are unwound, so that a periodic entry may leave the box
    if grid is not None and status != PathStatus.LEFT_BOX:
        outside = np.any(((states < grid.lo) | (states > grid.hi)) & ~np.array(grid.periodic), axis=-1)
        if outside.any():
            said.append(f"left the box at t = {times[np.argmax(outside)]:.6g}: controls there are the nearest point's")
    if not noisy and path.steps > max(MANY, max_steps / 8):
        said.append("the feedback jumps or the loop is stiff: hold=dt is faster")
    if _are_inadmissible(controls, applied):
        said.append("controls outside the problem's admissible set were applied as they are")
    if status not in (PathStatus.DURATION, PathStatus.TARGET, PathStatus.INTERRUPTED):  # that is raised
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
    )


def _are_inadmissible(controls: AdmissibleSet | None, applied: Array) -> bool:
    """True if a control lies outside a box or a ball by more than rounding; a finite set is not looked at."""
    return isinstance(controls, (Box, Ball)) and not np.all(holds(controls, applied))
