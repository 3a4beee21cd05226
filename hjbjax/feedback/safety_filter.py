"""A safety filter: the nominal control inside a tube, the tube's own at its boundary.

    u(x) = nominal(x) where V(x) ≤ −margin, and the action that minimises the Hamiltonian of V elsewhere.

V is the value of ``avoid``, ``reach_avoid`` or ``reach``, whose control can keep what V ≤ 0 promises, whatever the
disturbance does: not to come into the obstacle, or to come to the target. As long as V < 0 every action keeps that
promise for a moment, so that a filter interferes no earlier than it must. Between the nodes V is known up to the change
over a cell, which is what the margin is for. The safe action is that of the nearest node: where V has a ridge, as
straight ahead of an obstacle, going left and going right are both safe, and their mean is not.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.feedback import GridFeedback, Place, is_grid_feedback
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status


@pytree_dataclass()
class Filter:
    """A feedback that leaves a nominal one alone where that is safe; called with (x), of a marched tube with (t, x).

    Args:
      tube: the Solution whose V tells what is safe.
      nominal: the control to leave alone, called with the same arguments.
      margin: how far below zero V must be.
    """

    tube: Solution
    nominal: Callable
    margin: Number

    def __call__(self, *where: Place) -> jax.Array:
        """The control, shape (m,)."""
        with own_settings():
            wanted = jnp.asarray(self.nominal(*where))
            wanted = wanted.astype(jnp.result_type(wanted, float))  # or integers would cut off the safe action
            acts = self.acts(*where)
            # clamped: outside the grid the nearest point's action is a better guess than NaN, which would end a path
            safe = jnp.asarray(self.tube.control_at(*self._arguments(where), clamp=True), wanted.dtype)
            return jnp.where(acts, safe, wanted)

    def acts(self, *where: Place) -> jax.Array:
        """True where the filter takes over."""
        with own_settings():
            # the negation and no `>`: where V is NaN nothing is known to be safe, and the filter takes over
            return ~(jnp.asarray(self.tube.value_at(*self._arguments(where), clamp=True)) <= -self.margin)

    def _arguments(self, where: tuple[Place, ...]) -> tuple[Place, ...]:
        """The arguments of the tube's lookups: a stationary one does not want the time."""
        return where[-1:] if self.tube.times is None else where


@front_door
def least_restrictive(solution: Solution, nominal: GridFeedback | Callable, *, margin: float | None = None) -> Filter:
    """A feedback that leaves the nominal control alone until the tube's boundary, and then does what is safe.

    u(x) = nominal(x) where V(x) ≤ −margin, else the tube's action. For ``simulate``, ``jit`` and ``vmap``. A
    stationary tube guards for ever. A marched one guards up to its horizon, and wants to be called with (t, x): in
    ``simulate`` by ``time_varying=True``, kept at times dense enough.

    Args:
      solution: a tube of ``avoid``, ``reach_avoid`` or ``reach``: V < 0 is safe, and V ≥ 0 is not. Outside the grid its
        nearest point is asked.
      nominal: a function that returns the control, shape (m,), or a Solution; takes (x), or (t, x) if the filter is
        called so.
      margin: how far below zero V must be for the nominal control, in the units of V. ``None`` is the largest change
        of V over one cell across its zero level, so that the filter takes over a cell ahead of the boundary.

    Returns:
      A function of the state, shape (m,), that is a pytree; its ``acts(x)`` tells where it takes over.

    Raises:
      TypeError: no Solution, or a nominal control that cannot be called.
      ValueError: a solution of another problem than a tube; a tube without controls, that did not converge, is nowhere
        safe, or was marched and kept at one time only; a margin that is negative or NaN.

    Example:
      >>> import hjbjax as hjb
      >>> def braking(x, u):                                # a wall at x ≥ 0, |acceleration| ≤ 1
      ...     return jnp.stack([x[1], u[0]])
      >>> problem = hjb.avoid(braking, hjb.Box([-1.0], [1.0]), lambda x: -x[0])
      >>> tube = hjb.solve(problem, hjb.Grid([-3.0, -2.0], [1.0, 2.0], (41, 41)))
      >>> guarded = hjb.least_restrictive(tube, lambda x: jnp.ones(1))
      >>> guarded(jnp.array([-2.5, 1.0])).tolist(), guarded(jnp.array([-0.5, 1.0])).tolist()  # ½v² from the wall
      ([1.0], [-1.0])
    """
    if not isinstance(solution, Solution):
        raise TypeError(f"least_restrictive: got {type(solution).__name__}, wanted the Solution of a tube")
    if solution.problem is not None and not _is_tube(solution.problem):
        raise ValueError(
            "least_restrictive: got the solution of another problem than a tube; its V ≤ 0 does not say what is safe. "
            "Give that of hjb.avoid(...), hjb.reach_avoid(...) or hjb.reach(...), with tube=True"
        )
    control = _nominal(nominal)
    if solution.times is not None and np.size(solution.times) < 2:
        raise ValueError(
            "least_restrictive: the tube was marched and kept at one time only, as if it were the same at all others; "
            "keep more of them, as in march(..., times=np.linspace(0, horizon, 41))"
        )
    if solution.policy is None or np.shape(solution.policy)[-1] == 0:
        raise ValueError("least_restrictive: the tube has no controls, so that there is nothing to take over with")
    tube = Solution(
        solution.grid,
        solution.value,
        solution.policy,
        code=solution.code,
        times=solution.times,
        discrete=True,
        labels=solution.labels,
    )  # discrete: the nearest node's action
    if margin is not None and not is_traced(margin) and not (np.isfinite(margin) and margin >= 0):
        raise ValueError(f"least_restrictive: margin = {margin!r}; wanted a finite number ≥ 0, in the units of V")
    # inside a transformation V is no known number: its jump and its status cannot be looked at
    if is_traced(solution, margin):
        if margin is None:
            raise ValueError("least_restrictive: inside jit, vmap and grad give margin=, a number in the units of V")
        return Filter(tube, control, margin)
    _check_tube(tube)
    margin = _jump(solution.grid, np.asarray(solution.value)) if margin is None else float(margin)
    if not np.any(np.asarray(solution.value) <= -margin):
        raise ValueError(
            f"least_restrictive: nothing is safe by the margin {margin:.3g}: the least V is "
            f"{np.min(np.asarray(solution.value)):.3g}; give a smaller margin, a larger box or a finer grid"
        )
    return Filter(tube, control, margin)


def _is_tube(problem: Problem) -> bool:
    """True if V is an extreme of a signed distance along the path, whose sign says what is safe."""
    priced = problem.cost is not None or problem.noise is not None or problem.target is not None
    extreme = problem.running_max is not None or problem.stopping_cost is not None
    undiscounted = is_traced(problem.discount) or not np.any(np.asarray(problem.discount))
    return extreme and undiscounted and not priced


def _nominal(nominal: GridFeedback | Callable) -> Callable:
    """The nominal control as a pytree."""
    if is_grid_feedback(nominal):
        look = as_partial(nominal.control_at)
        return jax.tree_util.Partial(_control_at if nominal.times is None else _control_at_time, look)
    if not callable(nominal):
        raise TypeError(f"least_restrictive: nominal is {nominal!r}, wanted a function of the state or a Solution")
    control = as_partial(nominal)
    assert control is not None
    return control


def _control_at(look_up: Callable, *where: Place) -> Array:
    """A stationary solution's control at the state, whatever the time."""
    return look_up(where[-1], clamp=True)


def _control_at_time(look_up: Callable, *where: Place) -> Array:
    """A marched solution's control at (t, x)."""
    return look_up(*where, clamp=True)


def _check_tube(tube: Solution) -> None:
    """Refuse a tube that did not converge."""
    if tube.status is not Status.CONVERGED:
        raise ValueError(
            f"least_restrictive: the tube ended as {tube.status!r}, so that it promises nothing; "
            "solve it to its end first"
        )


def _jump(grid: Grid, value: np.ndarray) -> float:
    """The largest change of V between neighbours on different sides of its zero level; 0 where there is none."""
    first, largest = value.ndim - grid.ndim, 0.0  # the axes of the grid come last, after that of the kept times
    for axis in range(grid.ndim):
        following = np.roll(value, -1, axis=first + axis)
        crosses = (value < 0) != (following < 0)
        if not grid.periodic[axis]:
            np.moveaxis(crosses, first + axis, 0)[-1] = False  # the last node's neighbour by `roll` is the first
        largest = max(largest, float(np.max(np.where(crosses, np.abs(following - value), 0))))
    return largest
