"""A safety filter: the nominal control inside a tube, the tube's own control near its boundary.

    u(x) = nominal(x) where V(x) ≤ −margin, and the action that minimises the Hamiltonian of V elsewhere.

V is the value of ``avoid``, ``reach_avoid`` or ``reach``. From a state with V ≤ 0 the tube's control avoids the
obstacle or reaches the target, for any disturbance. Where V < 0 every action is safe for a moment, so the filter need
not act earlier. Between the nodes V is known up to its change over one cell, which is the reason for the margin. The
safe action is the one at the nearest node, not an interpolated one: on a ridge of V, for example straight ahead of an
obstacle, turning left and turning right are both safe, but their mean is not.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.feedback import GridFeedback, Place, is_grid_feedback
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, has_interventions
from hjbjax.problem.pytree import as_partial, front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status


@pytree_dataclass()
class Filter:
    """A feedback that changes a nominal control only near the tube's boundary; called with (x), or (t, x) if marched.

    Args:
      tube: the Solution whose V defines the safe set.
      nominal: the nominal control, called with the same arguments.
      margin: the nominal control is used where V ≤ −margin.
    """

    tube: Solution
    nominal: Callable
    margin: Number

    def __call__(self, *where: Place) -> jax.Array:
        """The control, shape (m,)."""
        with own_settings():
            wanted = jnp.asarray(self.nominal(*where))
            wanted = wanted.astype(jnp.result_type(wanted, float))  # integers would truncate the safe action
            acts = self.acts(*where)
            # clamped: outside the grid the action of the nearest point is better than NaN, which would end a path
            safe = jnp.asarray(self.tube.control_at(*self._arguments(where), clamp=True), wanted.dtype)
            return jnp.where(acts, safe, wanted)

    def acts(self, *where: Place) -> jax.Array:
        """True where the filter replaces the nominal control."""
        with own_settings():
            # a negation, so that the filter also acts where V is NaN and nothing is known to be safe
            return ~(jnp.asarray(self.tube.value_at(*self._arguments(where), clamp=True)) <= -self.margin)

    def _arguments(self, where: tuple[Place, ...]) -> tuple[Place, ...]:
        """The arguments of the tube's lookups: without the time for a stationary tube."""
        return where[-1:] if self.tube.times is None else where


@front_door
def least_restrictive(solution: Solution, nominal: GridFeedback | Callable, *, margin: float | None = None) -> Filter:
    """A feedback that leaves the nominal control unchanged until the tube's boundary, and then keeps the state safe.

    u(x) = nominal(x) where V(x) ≤ −margin, else the tube's action. It works with ``simulate``, ``jit`` and ``vmap``. A
    stationary tube protects indefinitely. A marched tube protects up to its horizon and is called with (t, x), in
    ``simulate`` by ``time_varying=True``; store it at times that are dense enough.

    Args:
      solution: a tube of ``avoid``, ``reach_avoid`` or ``reach``: V < 0 is safe, and V ≥ 0 is not. States outside the
        grid use its nearest point.
      nominal: a function that returns the control, shape (m,), or a Solution; takes (x), or (t, x) if the filter is
        called with (t, x).
      margin: the nominal control is used where V ≤ −margin, in the units of V. Default: the largest change of V over
        one cell across its zero level, so that the filter acts one cell ahead of the boundary.

    Returns:
      A function of the state, shape (m,), that is a pytree; its ``acts(x)`` is True where it replaces the nominal
      control.

    Raises:
      TypeError: an argument that is not a Solution, or a nominal control that cannot be called.
      ValueError: a solution of a problem that is not a tube; a tube that has modes, has no controls, did not converge,
        is safe nowhere, or was marched and stored at only one time; a margin that is negative or NaN.

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
            "least_restrictive: got the solution of a problem that is not a tube; its V ≤ 0 does not mean safe. "
            "Pass the solution of hjb.avoid(...), hjb.reach_avoid(...) or hjb.reach(...), with tube=True"
        )
    if solution.grid.modes:
        raise ValueError(
            f"least_restrictive: got a tube with the modes {solution.grid.modes!r}, but a filter is a function of the "
            "state only; pass the tube of one mode, solution.in_mode(...), if the mode is known"
        )
    control = _nominal(nominal)
    if solution.times is not None and np.size(solution.times) < 2:
        raise ValueError(
            "least_restrictive: the tube was marched and stored at one time only; "
            "store more times, for example march(..., times=np.linspace(0, horizon, 41))"
        )
    if solution.policy is None or np.shape(solution.policy)[-1] == 0:
        raise ValueError("least_restrictive: the tube has no controls, so the filter has no safe action")
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
    # inside a transformation V is not a known number, so its jump and its status cannot be checked
    if is_traced(solution, margin):
        if margin is None:
            raise ValueError("least_restrictive: inside jit, vmap and grad give margin=, a number in the units of V")
        return Filter(tube, control, margin)
    _check_tube(tube)
    margin = _jump(solution.grid, np.asarray(solution.value)) if margin is None else float(margin)
    if not np.any(np.asarray(solution.value) <= -margin):
        raise ValueError(
            f"least_restrictive: nothing is safe by the margin {margin:.3g}: the smallest V is "
            f"{np.min(np.asarray(solution.value)):.3g}; use a smaller margin, a larger box or a finer grid"
        )
    return Filter(tube, control, margin)


def _is_tube(problem: Problem) -> bool:
    """True if V is an extreme of a signed distance along the path, whose sign decides safety."""
    random = problem.noise is not None or bool(problem.jumps)
    priced = random or problem.cost is not None or problem.target is not None or has_interventions(problem)
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
    """A stationary solution's control at the state, for any time."""
    return look_up(where[-1], clamp=True)


def _control_at_time(look_up: Callable, *where: Place) -> Array:
    """A marched solution's control at (t, x)."""
    return look_up(*where, clamp=True)


def _check_tube(tube: Solution) -> None:
    """Refuse a tube that did not converge."""
    if tube.status is not Status.CONVERGED:
        raise ValueError(
            f"least_restrictive: the tube ended with {tube.status!r}, so it guarantees nothing; "
            "solve it until it converges"
        )


def _jump(grid: Grid, value: np.ndarray) -> float:
    """The largest change of V between neighbours on different sides of its zero level; 0 if there are none."""
    first, largest = value.ndim - grid.ndim, 0.0  # the axes of the grid come last, after the axis of the stored times
    for axis in range(grid.ndim):
        following = np.roll(value, -1, axis=first + axis)
        crosses = (value < 0) != (following < 0)
        if not grid.periodic[axis]:
            np.moveaxis(crosses, first + axis, 0)[-1] = False  # `roll` makes the first node the last node's neighbour
        largest = max(largest, float(np.max(np.where(crosses, np.abs(following - value), 0))))
    return largest
