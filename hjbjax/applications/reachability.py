"""Reachable sets and tubes, as problems whose cost is a signed distance l (≤ 0 inside).

    reach:        V = min_u max_d min_s l(x(s)),                      the controller gets there from {V ≤ 0}
    avoid:        V = min_u max_d max_s −l(x(s)),                     the disturbance gets it there from {V ≥ 0}
    reach-avoid:  V = min_u max_d min_s max{l(x(s)), max_{r ≤ s} −o(x(r))},  there and never in the obstacle: {V ≤ 0}

with s over [0, T] for a tube and s = T for a set. The control minimises and the disturbance maximises, as everywhere;
these constructors alone know the vocabulary. Where an obstacle covers a part of the target, that part is no success.
The value inherits the range of l, and its zero level does not depend on how l is scaled. ``march`` solves them over a
horizon, ``solve`` for all times (tubes). Source: I. M. Mitchell, A. M. Bayen and C. J. Tomlin, A time-dependent
Hamilton–Jacobi formulation of reachable sets for continuous dynamic games, IEEE Trans. Automat. Contr. 50.
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
    isaacs: str = "upper",  # the disturbance sees the control: no set is larger than the control can guarantee
    time_dependent: bool = False,
) -> Problem:
    """From where the control can bring the state into the target, whatever the disturbance: {V ≤ 0}.

    Args:
      drift: f, as in ``Problem``.
      controls: the admissible set of u, which wants to get there.
      target: the signed distance l(x), ≤ 0 inside; l(t, x) where the problem depends on the time.
      disturbances: the admissible set of d, which wants to keep the state out.
      tube: at some time within the horizon; otherwise exactly at its end.
      forward: where the system can be when it starts in the target: the drift runs backwards.
      isaacs: as in ``Problem``.
      time_dependent: as in ``Problem``; not with ``forward``.

    Returns:
      The problem; V is in the units of l.

    Example:
      >>> import hjbjax as hjb
      >>> problem = hjb.reach(lambda x, u: u, hjb.Box([-1.0], [1.0]), lambda x: jnp.abs(x[0]) - 0.5)
      >>> solution = hjb.march(problem, hjb.Grid([-3.0], [3.0], (61,)), 1.0)
      >>> bool(solution.value_at(0.0, [1.45]) <= 0), bool(solution.value_at(0.0, [1.55]) <= 0)
      (True, False)
    """
    inside = as_partial(target, "reach: target")
    # a tube may stop at any s and pays l there, V ≤ l; a set pays l at the end alone
    stop, end = (inside, None) if tube else (None, inside)
    return Problem(
        # no running cost and no discount: V takes no values but those of l
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
    """From where the control cannot keep the state out of the obstacle, for some disturbance: {V ≥ 0}.

    Args:
      drift: f, as in ``Problem``.
      controls: the admissible set of u, which keeps away.
      obstacle: the signed distance l(x), ≤ 0 inside; l(t, x) where the problem depends on the time.
      disturbances: the admissible set of d, which pursues.
      tube: at no time within the horizon; otherwise not at its end.
      forward: as in ``reach``.
      isaacs: as in ``Problem``.
      time_dependent: as in ``Problem``; not with ``forward``.

    Returns:
      The problem; −V is the least distance that the control can guarantee.
    """
    depth = jax.tree_util.Partial(_negative, as_partial(obstacle, "avoid: obstacle"))
    # −l is largest where the path is deepest in the obstacle: the running maximum keeps it, V ≥ −l
    # a set looks at the end alone: what the path touched on the way does not count
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
    """From where the control can bring the state into the target without ever touching the obstacle: {V ≤ 0}.

    Args:
      drift: f, as in ``Problem``.
      controls: the admissible set of u.
      target: the signed distance of the target, ≤ 0 inside.
      obstacle: the signed distance of the obstacle, ≤ 0 inside; it wins where the two overlap.
      disturbances: the admissible set of d, which wants the opposite.
      tube: at some time within the horizon; otherwise exactly at its end.
      forward: as in ``reach``.
      isaacs: as in ``Problem``.
      time_dependent: as in ``Problem``; not with ``forward``.

    Returns:
      The problem; V is in the units of the distances.
    """
    # Partials: numbers in the distances are leaves, and another radius compiles nothing
    inside, hit = as_partial(target, "reach_avoid: target"), as_partial(obstacle, "reach_avoid: obstacle")
    depth = jax.tree_util.Partial(_negative, hit)
    # both at once: max{·, −o} is outermost, so that l ≤ 0 inside the obstacle is no success
    # the running maximum stays for a set as well: the obstacle counts at all times, the target at the end
    stop, end = (inside, None) if tube else (None, inside)
    return Problem(
        _drift(drift, forward, time_dependent), None, controls, disturbances=disturbances, stopping_cost=stop,
        terminal_cost=end, running_max=depth, isaacs=isaacs, time_dependent=time_dependent,
    )  # fmt: skip


@front_door
def from_hj_reachability(dynamics: Any, distance: Callable, *, tube: bool = True) -> Problem:
    """The reachability problem of a ``Dynamics`` object of the package hj_reachability, by its modes.

    A control that minimises gets ``reach``, one that maximises ``avoid``, whose V is minus theirs. A disturbance of one
    point is a number; one that helps the control becomes a part of it.

    Args:
      dynamics: called with (state, control, disturbance, time); with ``control_mode``, ``disturbance_mode``,
        ``control_space`` and ``disturbance_space``, boxes or balls about zero. It must not depend on the time.
      distance: the signed distance l(x), a function of one state, ≤ 0 inside.
      tube: at some time within the horizon, as their ``backwards_reachable_tube``; otherwise exactly at its end.

    Returns:
      The problem, for ``march``; V at time 0 is theirs, or minus theirs, at minus the horizon.

    Raises:
      TypeError: an object that lacks one of these.
      ValueError: a mode that is neither "min" nor "max", a set that is no box and no ball about zero, a ball of a
        disturbance that helps the control.

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
    m, resting = controls.dim, isinstance(others, Box) and bool(np.all(others.lo == others.hi))
    helping = modes[0] == modes[1] and not resting
    if helping and not (isinstance(controls, Box) and isinstance(others, Box)):
        raise ValueError(
            f"{name}: control and disturbance both {modes[0]}imise, over sets that are not both boxes; turn one mode "
            "round"
        )

    def drift(x: State, u: Control, d: Array | None = None) -> Array:
        d = u[m:] if helping else jnp.asarray(others.lo) if d is None else d  # type: ignore[union-attr]
        return dynamics(x, u[:m], d, 0.0)

    if helping:
        controls = Box(np.append(controls.lo, others.lo), np.append(controls.hi, others.hi))  # type: ignore[union-attr]
    pose = reach if modes[0] == "min" else avoid
    return pose(drift, controls, distance, disturbances=None if resting or helping else others, tube=tube)


def _admissible(space: Any, name: str) -> Box | Ball:
    """A bounded set of hj_reachability as one of ours."""
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


def _drift(drift: Callable, forward: bool, time_dependent: bool) -> Callable:
    """The drift, backwards for a forward set."""
    if not forward:
        return drift  # a backward set: V at x tells of paths that start there
    # x(T) is reached from the target exactly if the target is reached from x(T) with time running backwards
    if time_dependent:
        raise ValueError(
            "forward=True turns the time round, which it cannot do for functions of the time; write drift(T - t, x, u) "
            "and the distances of T - t yourself, with forward=False and the drift's sign changed"
        )
    return jax.tree_util.Partial(_backwards, as_partial(drift, "drift"))


def _backwards(drift: Callable, *arguments: Array) -> jax.Array:
    """The drift with its sign changed."""
    # jnp first: a drift may return a list, which has no minus
    return -jnp.asarray(drift(*arguments))


def _negative(distance: Callable, *arguments: Array) -> Array:
    """A signed distance with its sign changed: ≥ 0 inside."""
    return -distance(*arguments)
