"""Reachable sets and tubes, as problems whose cost is a signed distance l (≤ 0 inside).

    reach:        V = min_u max_d min_s l(x(s)),                      the control can reach the target from {V ≤ 0}
    avoid:        V = min_u max_d max_s −l(x(s)),                     the disturbance can force a hit from {V ≥ 0}
    reach-avoid:  V = min_u max_d min_s max{l(x(s)), max_{r ≤ s} −o(x(r))},  reach without touching o from {V ≤ 0}

with s over [0, T] for a tube and s = T for a set. The control always minimises and the disturbance maximises.
The part of a target that an obstacle covers does not count. The value inherits the range of l, and its zero level does
not depend on the scale of l. ``march`` solves the problems over a horizon, ``solve`` for all times (tubes only).
Source: I. M. Mitchell, A. M. Bayen and C. J. Tomlin, A time-dependent Hamilton–Jacobi formulation of reachable sets
for continuous dynamic games, IEEE Trans. Automat. Contr. 50.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, front_door
from hjbjax.problem.sets import AdmissibleSet, Ball, Box
from hjbjax.problem.types import Array, Control, State


@front_door
def reach(
    drift: Callable,
    controls: AdmissibleSet | None,
    target: Callable,
    *,
    disturbances: AdmissibleSet | None = None,
    tube: bool = True,
    forward: bool = False,
    isaacs: str = "upper",  # the disturbance chooses after the control, so the set is what the control can guarantee
    time_dependent: bool = False,
) -> Problem:
    """Construct the problem whose {V ≤ 0} contains the states that the control can bring into the target.

    Args:
      drift: f, as in ``Problem``.
      controls: the admissible set of u, which tries to reach the target.
      target: the signed distance l(x), ≤ 0 inside; l(t, x) if the problem depends on time.
      disturbances: the admissible set of d, which tries to prevent it.
      tube: reach the target at some time within the horizon; otherwise exactly at its end.
      forward: the states that the system can reach from the target instead; the drift runs backward.
      isaacs: as in ``Problem``.
      time_dependent: as in ``Problem``; not with ``forward``.

    Returns:
      The problem; V has the units of l.

    Example:
      >>> import hjbjax as hjb
      >>> problem = hjb.reach(lambda x, u: u, hjb.Box([-1.0], [1.0]), lambda x: jnp.abs(x[0]) - 0.5)
      >>> solution = hjb.march(problem, hjb.Grid([-3.0], [3.0], (61,)), 1.0)
      >>> bool(solution.value_at(0.0, [1.45]) <= 0), bool(solution.value_at(0.0, [1.55]) <= 0)
      (True, False)
    """
    inside = _distance(target, "reach: target")
    # for a tube, stopping at any s pays l, so V ≤ l; for a set only the end pays l
    stop, end = (inside, None) if tube else (None, inside)
    return Problem(
        # without running cost and discount V is always a value of l
        _drift(drift, forward, time_dependent), None, controls, disturbances=disturbances, stopping_cost=stop,
        terminal_cost=end, isaacs=isaacs, time_dependent=time_dependent,
    )  # fmt: skip


@front_door
def avoid(
    drift: Callable,
    controls: AdmissibleSet | None,
    obstacle: Callable,
    *,
    disturbances: AdmissibleSet | None = None,
    tube: bool = True,
    forward: bool = False,
    isaacs: str = "upper",
    time_dependent: bool = False,
) -> Problem:
    """Construct the problem whose {V ≥ 0} contains the states that some disturbance can force into the obstacle.

    Args:
      drift: f, as in ``Problem``.
      controls: the admissible set of u, which tries to avoid the obstacle.
      obstacle: the signed distance l(x), ≤ 0 inside; l(t, x) if the problem depends on time.
      disturbances: the admissible set of d, which tries to hit it.
      tube: a hit at any time within the horizon counts; otherwise only at its end.
      forward: as in ``reach``.
      isaacs: as in ``Problem``.
      time_dependent: as in ``Problem``; not with ``forward``.

    Returns:
      The problem; −V is the least distance that the control can guarantee.
    """
    depth = jax.tree_util.Partial(_negative, _distance(obstacle, "avoid: obstacle"))
    # −l is largest where the path is deepest in the obstacle. For a tube the running maximum records it, so V ≥ −l; for
    # a set only the end counts
    most, end = (depth, None) if tube else (None, depth)
    return Problem(
        _drift(drift, forward, time_dependent), None, controls, disturbances=disturbances, running_max=most,
        terminal_cost=end, isaacs=isaacs, time_dependent=time_dependent, inside="above",
    )  # fmt: skip


@front_door
def reach_avoid(
    drift: Callable,
    controls: AdmissibleSet | None,
    target: Callable,
    obstacle: Callable,
    *,
    disturbances: AdmissibleSet | None = None,
    tube: bool = True,
    forward: bool = False,
    isaacs: str = "upper",
    time_dependent: bool = False,
) -> Problem:
    """Construct the problem whose {V ≤ 0} contains the states that can reach the target without touching the obstacle.

    Args:
      drift: f, as in ``Problem``.
      controls: the admissible set of u.
      target: the signed distance of the target, ≤ 0 inside.
      obstacle: the signed distance of the obstacle, ≤ 0 inside; it takes precedence where the two overlap.
      disturbances: the admissible set of d, which tries to prevent it.
      tube: reach the target at some time within the horizon; otherwise exactly at its end.
      forward: as in ``reach``.
      isaacs: as in ``Problem``.
      time_dependent: as in ``Problem``; not with ``forward``.

    Returns:
      The problem; V has the units of the distances.
    """
    # Partials keep the numbers of the distances as leaves, so that another radius does not recompile
    inside, hit = _distance(target, "reach_avoid: target"), _distance(obstacle, "reach_avoid: obstacle")
    depth = jax.tree_util.Partial(_negative, hit)
    # max{·, −o} is the outer operation, so l ≤ 0 inside the obstacle does not count; it is a running maximum for a set
    # as well, because the obstacle counts at all times
    stop, end = (inside, None) if tube else (None, inside)
    return Problem(
        _drift(drift, forward, time_dependent), None, controls, disturbances=disturbances, stopping_cost=stop,
        terminal_cost=end, running_max=depth, isaacs=isaacs, time_dependent=time_dependent,
    )  # fmt: skip


@front_door
def from_hj_reachability(dynamics: Any, distance: Callable, *, tube: bool = True) -> Problem:
    """Convert a ``Dynamics`` object of the package hj_reachability to a reachability problem, according to its modes.

    A control that minimises gives ``reach``. A control that maximises gives ``avoid``, whose V is minus the value of
    hj_reachability. A disturbance set with one point becomes a constant. A disturbance that helps the control becomes a
    part of the control.

    Args:
      dynamics: called with (state, control, disturbance, time); it has ``control_mode``, ``disturbance_mode``,
        ``control_space`` and ``disturbance_space``, boxes or balls around zero. It must not depend on time.
      distance: the signed distance l(x), a function of one state, ≤ 0 inside.
      tube: reach at some time within the horizon, like their ``backwards_reachable_tube``; otherwise only at its end.

    Returns:
      The problem, for ``march``; V at time 0 is their value, or minus their value, at minus the horizon.

    Raises:
      TypeError: the object lacks one of these attributes.
      ValueError: a mode is neither "min" nor "max", a set is neither a box nor a ball around zero, or a disturbance
        that helps the control has a ball.

    Example:
      >>> import hjbjax as hjb
      >>> from types import SimpleNamespace
      >>> class Chase:  # as hj_reachability has it
      ...     control_mode, disturbance_mode = "max", "min"
      ...     control_space, disturbance_space = (SimpleNamespace(lo=[-r], hi=[r]) for r in (1.0, 2.0))
      ...     def __call__(self, state, control, disturbance, time):
      ...         return control + disturbance
      >>> problem = hjb.from_hj_reachability(Chase(), lambda x: jnp.abs(x[0]) - 0.5)
      >>> solution = hjb.march(problem, hjb.Grid([-4.0], [4.0], (161,)), 1.0)
      >>> round(float(solution.value_at(0.0, [1.2])), 2)  # caught; theirs is -0.3
      0.3
    """
    name = "from_hj_reachability"
    parts = ("control_mode", "disturbance_mode", "control_space", "disturbance_space")
    if lacking := [each for each in parts if not hasattr(dynamics, each)]:
        raise TypeError(
            f"{name}: got {type(dynamics).__name__} without {', '.join(lacking)}, wanted a Dynamics of hj_reachability"
        )
    modes = dynamics.control_mode, dynamics.disturbance_mode
    if not set(modes) <= {"min", "max"}:
        raise ValueError(f"{name}: got the modes {modes}, wanted 'min' or 'max'")
    controls = _admissible(dynamics.control_space, f"{name}: control_space")
    others = _admissible(dynamics.disturbance_space, f"{name}: disturbance_space")
    m, fixed = controls.dim, None
    if isinstance(others, Box) and np.all(others.lo == others.hi):
        fixed = others.lo
    helping = modes[0] == modes[1] and fixed is None
    if helping and not (isinstance(controls, Box) and isinstance(others, Box)):
        raise ValueError(
            f"{name}: control and disturbance both {modes[0]}imise, over sets that are not both boxes; reverse one "
            "mode, or use two boxes"
        )

    def drift(x: State, u: Control, d: Array | None = None) -> Array:
        d = u[m:] if helping else jnp.asarray(fixed) if d is None else d
        return dynamics(x, u[:m], d, 0.0)

    if helping:
        assert isinstance(controls, Box)
        assert isinstance(others, Box)
        controls = Box(np.append(controls.lo, others.lo), np.append(controls.hi, others.hi))
    pose = reach if modes[0] == "min" else avoid
    return pose(drift, controls, distance, disturbances=None if helping or fixed is not None else others, tube=tube)


def _admissible(space: Any, name: str) -> Box | Ball:
    """Convert a bounded set of hj_reachability."""
    if hasattr(space, "radius") and hasattr(space, "center"):
        center = np.asarray(space.center)
        if np.any(center):
            raise ValueError(
                f"{name}: got a ball about {center.tolist()}, wanted one about zero; shift the drift instead"
            )
        return Ball(float(space.radius), len(center))
    if not (hasattr(space, "lo") and hasattr(space, "hi")):
        raise ValueError(f"{name}: got a {type(space).__name__}, wanted a box, with lo and hi, or a ball about zero")
    return Box(np.asarray(space.lo, float), np.asarray(space.hi, float))


def _distance(function: Callable | None, name: str) -> jax.tree_util.Partial:
    """A signed distance, which must be a function."""
    held = as_partial(function, name)
    if held is None:
        raise TypeError(f"{name}: got None, wanted a function of one state")
    return held


def _drift(drift: Callable, forward: bool, time_dependent: bool) -> Callable:
    """The drift, reversed for a forward set."""
    if not forward:
        return drift  # a backward set: V at x concerns paths that start at x
    # x(T) can be reached from the target if and only if the target can be reached from x(T) with reversed time
    if time_dependent:
        raise ValueError(
            "forward=True reverses time, which is not possible for time-dependent functions; write drift(T - t, x, u) "
            "with the opposite sign and the distances of T - t yourself, and use forward=False"
        )
    return jax.tree_util.Partial(_backwards, as_partial(drift, "drift"))


def _backwards(drift: Callable, *arguments: Array) -> jax.Array:
    """The drift with its sign changed."""
    # asarray first, because a drift may return a list
    return -jnp.asarray(drift(*arguments))


def _negative(distance: Callable, *arguments: Array) -> Array:
    """A signed distance with the opposite sign: ≥ 0 inside."""
    return -distance(*arguments)


def depth(function: Any) -> Any:
    """The signed distance l of a function −l that ``avoid`` or ``reach_avoid`` made; None for another function."""
    made_here = isinstance(function, jax.tree_util.Partial) and function.func is _negative
    return function.args[0] if made_here else None
