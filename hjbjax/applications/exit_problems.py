"""Questions about where and when paths end, as problems: who reaches a set, and how long it takes.

    P(x) = opt E 1{x(τ) in the target, not in the obstacle},      T(x) = opt E τ,       τ = first time in either

are the problem's own equation without running cost (or with cost 1) and with an exit cost of one on the target and zero
on the obstacle. The control minimises and the disturbance maximises, as everywhere: a greatest probability or time is
that of minus the cost. A feedback that is given closes the loop: what is left has no control.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.feedback import GridFeedback, Place, check_kept, is_grid_feedback
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, is_traced, pytree_dataclass
from hjbjax.problem.types import Array, Control, Disturbance, Number, State

T = TypeVar("T", bound=Callable | None)


@pytree_dataclass(static=("marched", "timed"))
class ClosedLoop:
    """A problem's drift and noise under a feedback; where the feedback is NaN, the state stays where it is.

    Args:
      problem: the problem.
      control: a pytree that is called with (x), or with (t, x) if ``marched``, or if a function of the time.
      marched: True where the control takes the time.
      timed: True where the closed loop depends on the time.
    """

    problem: Problem
    control: Callable
    marched: bool
    timed: bool

    def drift(self, *arguments: Array) -> jax.Array:
        """f(x, control(x), d), shape (n,)."""
        t, x, u, d, acts = self._actions(arguments)
        # without an action the state stays, which for a probability is: it never arrives
        return jnp.where(acts, jnp.asarray(self.problem.drift(*self.problem.arguments(x, u, d, t))), 0)

    def noise(self, *arguments: Array) -> jax.Array:
        """σ there, in the shape in which the problem gives it."""
        t, x, u, d, acts = self._actions(arguments)
        # noise is switched off there as well, or it might carry the state into the target by chance
        sigma = self.problem.noise
        return jnp.where(acts, jnp.asarray(sigma(*self.problem.arguments(x, u, d, t)) if callable(sigma) else sigma), 0)

    def _actions(self, arguments: tuple[Array, ...]) -> tuple[Number, State, Control, Disturbance | None, jax.Array]:
        """The time, the state, the control, the disturbance, and True where there is a control."""
        # the problem without controls is called with u of shape (0,) in the control's place
        # a time that is not passed is read by nobody, so any number will do
        t, rest = (arguments[0], arguments[1:]) if self.timed else (0.0, arguments)
        x, d = rest[0], rest[2] if self.problem.is_game else None
        u = jnp.asarray(self.control(t, x) if self.marched else self.control(x))
        acts = ~jnp.any(jnp.isnan(u))
        # zero in place of NaN: also the branch that `where` discards is evaluated, and NaN would reach derivatives
        return t, x, jnp.where(acts, u, 0), d, acts


def close_loop(problem: Problem, feedback: GridFeedback | Callable, horizon: Number | None, name: str) -> Problem:
    """The problem with its control replaced by a feedback, and with none of its costs.

    Args:
      problem: the problem, with controls.
      feedback: a Solution, or a function of x (of t and x if the problem depends on the time).
      horizon: how long it is to act; a marched one must be kept at times that are dense enough up to there.
      name: who asks, for refusals.

    Raises:
      ValueError: there is no control to replace; a marched feedback that is not known up to the horizon.
      TypeError: the feedback cannot be called.
    """
    # without controls the feedback would be ignored, and the answer that of another question
    if problem.controls is None:
        raise ValueError(f"{name}: got a feedback, but problem.controls is None; leave out feedback")
    if not is_grid_feedback(feedback) and not callable(feedback):
        signature = "(t, x)" if problem.time_dependent else "(x)"
        raise TypeError(f"{name}: feedback is {feedback!r}, wanted a Solution or a function {signature}")
    if is_grid_feedback(feedback):
        marched = feedback.times is not None
        # under jit neither the horizon nor the times are known
        if marched and isinstance(horizon, (int, float, np.number)) and not is_traced(feedback.times):
            check_kept(feedback, float(horizon), f"{name}: horizon")
        look: Callable | None = jax.tree_util.Partial(_control, as_partial(feedback.control_at))
    else:
        marched, look = problem.time_dependent, as_partial(feedback)
    assert look is not None
    loop = ClosedLoop(problem, look, marched, marched or problem.time_dependent)
    # where a Solution is NaN the state must stay, also against noise; a function always has a control, and leaves noise
    # that is a number what it is
    looped = problem.noise is not None and (is_grid_feedback(feedback) or callable(problem.noise))
    return Problem(
        # no cost, no controls; the disturbance still plays, against the closed loop
        loop.drift, None, None, disturbances=problem.disturbances,
        noise=loop.noise if looped else problem.noise,
        isaacs=problem.isaacs,
        time_dependent=loop.timed,
    )  # fmt: skip


def exit_problem(
    problem: Problem, target: Callable, obstacle: Callable | None, cost: float, exit_cost: float
) -> Problem:
    """The problem that pays ``cost`` per unit time and ``exit_cost`` on the target where that is no obstacle.

    Args:
      problem: whose drift, noise and players count.
      target: a function ≤ 0 inside.
      obstacle: a function ≤ 0 inside, or None; it ends the path as well, and wins where the two overlap.
      cost: per unit time; 0 for none.
      exit_cost: on the target; 0 for none.
    """
    sets = (target,) if obstacle is None else (target, obstacle)
    # a cost of zero is None: of a function nobody would know that it is zero
    paid = jax.tree_util.Partial(_exit_cost, exit_cost, sets) if exit_cost else None
    return Problem(
        # no discount is passed on: a probability and a time are not discounted
        problem.drift, jax.tree_util.Partial(_constant, cost) if cost else None, problem.controls,
        disturbances=problem.disturbances, noise=problem.noise, target=jax.tree_util.Partial(_nearest, sets),
        exit_cost=paid, isaacs=problem.isaacs, time_dependent=problem.time_dependent,
    )  # fmt: skip


def arrival(problem: Problem, target: Callable, obstacle: Callable | None) -> Problem:
    """The minimum time to the target of a system that stops for ever where it meets the obstacle.

    Its value is finite exactly where the target is reached, and before the obstacle. Arguments are those of
    ``exit_problem``.
    """
    drift = problem.drift if obstacle is None else jax.tree_util.Partial(_stopping, problem.drift, obstacle)
    inside = target if obstacle is None else jax.tree_util.Partial(_outside_of, target, obstacle)
    return Problem(
        drift, jax.tree_util.Partial(_constant, 1.0), problem.controls, target=inside,
        isaacs=problem.isaacs, time_dependent=problem.time_dependent,
    )  # fmt: skip


def tube(problem: Problem, target: Callable, obstacle: Callable | None, *, least: bool) -> Problem:
    """The tube of the states that reach the target, {V ≤ 0}; of those that cannot avoid it, {V ≥ 0}, if ``least``."""
    stop, most = (None, target) if least else (target, obstacle)
    return Problem(
        problem.drift, None, problem.controls, disturbances=problem.disturbances, stopping_cost=stop,
        running_max=None if most is None else jax.tree_util.Partial(complement, most),
        isaacs=problem.isaacs, time_dependent=problem.time_dependent,
    )  # fmt: skip


def _stopping(drift: Callable, obstacle: Callable, *arguments: Array) -> jax.Array:
    """f off the obstacle, and zero in it."""
    rates = jnp.asarray(drift(*arguments))
    return jnp.where(jnp.asarray(obstacle(arguments[0])) <= 0, 0, rates)


def _outside_of(target: Callable, obstacle: Callable, *where: Place) -> jax.Array:
    """A function ≤ 0 in the target where that is not the obstacle."""
    return jnp.maximum(jnp.asarray(target(*where)), -jnp.asarray(obstacle(*where)))


def complement(region: Callable, *where: Place) -> Array:
    """A function ≤ 0 outside of a set, which is given by a function ≤ 0 inside."""
    return -region(*where)


def with_time(function: T, needed: bool) -> T | jax.tree_util.Partial:
    """A function of the state as one of time and state, where that is needed."""
    # a Partial and no lambda: the numbers of the user's function stay leaves
    return jax.tree_util.Partial(_timeless, function) if needed and function is not None else function


def _timeless(function: Callable, t: Number, *arguments: Array) -> Array:
    """A function of the state at any time."""
    return function(*arguments)


def _control(look_up: Callable, *where: Place) -> Array:
    """A solution's control; a node on the edge must not be refused for a rounding."""
    return look_up(*where, clamp=True)


def _constant(value: Number, *arguments: Array) -> jax.Array:
    """The cost per unit time, whatever state and actions are."""
    # the precision in force, float64 only where it is switched on: a float32 solve is not promoted
    return jnp.asarray(value, jnp.result_type(float))


def _nearest(sets: tuple[Callable, ...], *where: Place) -> jax.Array:
    """The smallest of the sets' functions, which is ≤ 0 in their union."""
    distances = [jnp.asarray(each(*where)) for each in sets]
    return distances[0] if len(sets) == 1 else jnp.minimum(*distances)


def _exit_cost(amount: Number, sets: tuple[Callable, ...], *where: Place) -> jax.Array:
    """The amount where the path ends in the target; on a boundary between nodes the nearer set is the one it met."""
    if len(sets) == 1:
        return jnp.asarray(amount, jnp.result_type(float))
    inside, hit = (jnp.asarray(each(*where)) for each in sets)
    # on the boundary rounding decides of the sign of either: then the smaller one tells, and a tie is no success
    return jnp.where((hit <= 0) | (hit <= inside), 0.0, amount)
