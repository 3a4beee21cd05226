"""Construct problems about where and when paths end: the probability of reaching a set, and the time it takes.

    P(x) = opt E 1{x(τ) in the target, not in the obstacle},      T(x) = opt E τ,       τ = first time in either

P solves the problem's equation without running cost, with the exit cost one on the target and zero on the obstacle. T
solves it with running cost 1. The control always minimises and the disturbance maximises. The greatest probability or
time is therefore minus the value of a problem with the opposite cost. A given feedback closes the loop and removes the
controls.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.feedback import GridFeedback, Place, check_kept, is_grid_feedback
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, as_partial, is_traced, pytree_dataclass
from hjbjax.problem.types import Array, Control, Disturbance, Number, State

T = TypeVar("T", bound=Callable | None)
OF_CHANGES = ("mode_rates", "intensities", "landings")  # functions that describe changes of the mode, and jumps


@pytree_dataclass(static=("marched", "timed"))
class ClosedLoop:
    """A problem's drift, noise and rates under a feedback; where the feedback is NaN, the state does not move.

    Args:
      problem: the problem.
      control: a pytree called with (x), or with (t, x) if ``marched``.
      marched: True if the control takes the time.
      timed: True if the closed loop depends on time.
    """

    problem: Problem
    control: Callable
    marched: bool
    timed: bool

    def drift(self, *arguments: Array) -> jax.Array:
        """f(x, control(x), d), shape (n,)."""
        t, x, u, d, acts = self._actions(arguments)
        # without an action the state does not move, so it never reaches the target
        return jnp.where(acts, jnp.asarray(self.problem.drift(*self.problem.arguments(x, u, d, t))), 0)

    def noise(self, *arguments: Array) -> jax.Array:
        """The noise σ, in the shape in which the problem gives it."""
        t, x, u, d, acts = self._actions(arguments)
        # without an action, switch the noise off as well, otherwise it might carry the state into the target
        sigma = self.problem.noise
        return jnp.where(acts, jnp.asarray(sigma(*self.problem.arguments(x, u, d, t)) if callable(sigma) else sigma), 0)

    def mode_rates(self, *arguments: Array) -> jax.Array:
        """The rates of changes of the mode, shape (k − 1,)."""
        t, x, u, d, acts = self._actions(arguments)
        return jnp.where(acts, jnp.asarray(self.problem.mode_rates(*self.problem.arguments(x, u, d, t))), 0)

    def intensities(self, *arguments: Array) -> jax.Array:
        """The rates of the jumps of the state, shape (k,)."""
        t, x, u, d, acts = self._actions(arguments)
        return jnp.where(acts, jnp.asarray(self.problem.intensities(*self.problem.arguments(x, u, d, t))), 0)

    def landings(self, *arguments: Array) -> jax.Array:
        """The states after the jumps, shape (k, n)."""
        t, x, u, d, _ = self._actions(arguments)
        return jnp.asarray(self.problem.landings(*self.problem.arguments(x, u, d, t)))

    def _actions(self, arguments: tuple[Array, ...]) -> tuple[Number, State, Control, Disturbance | None, jax.Array]:
        """The time, the state, the control, the disturbance, and True if there is a control."""
        # without controls the problem is called with u of shape (0,); if no time is passed, none is used
        t, rest = (arguments[0], arguments[1:]) if self.timed else (0.0, arguments)
        x, d = rest[0], rest[2] if self.problem.is_game else None
        u = jnp.asarray(self.control(t, x) if self.marched else self.control(x))
        acts = ~jnp.any(jnp.isnan(u))
        # zero instead of NaN, because the branch that `where` discards would carry NaN into derivatives
        return t, x, jnp.where(acts, u, 0), d, acts


def close_loop(problem: Problem, feedback: GridFeedback | Callable, horizon: Number | None, name: str) -> Problem:
    """Replace a problem's control by a feedback, and remove all costs.

    Args:
      problem: the problem, with controls.
      feedback: a Solution, or a function of x (of t and x if the problem depends on time).
      horizon: the duration; a marched feedback must be stored at sufficiently dense times up to it.
      name: the name of the caller, for error messages.

    Raises:
      ValueError: the problem has no control, or a marched feedback is not known up to the horizon.
      TypeError: the feedback is not callable.
    """
    # without controls the feedback would be ignored silently
    if problem.controls is None:
        raise ValueError(f"{name}: got a feedback, but problem.controls is None; leave out feedback")
    if not is_grid_feedback(feedback) and not callable(feedback):
        signature = "(t, x)" if problem.time_dependent else "(x)"
        raise TypeError(f"{name}: feedback is {feedback!r}, wanted a Solution or a function {signature}")
    if is_grid_feedback(feedback):
        marched = feedback.times is not None
        # a traced horizon or traced times cannot be checked
        if marched and isinstance(horizon, (int, float, np.number)) and not is_traced(feedback.times):
            check_kept(feedback, float(horizon), f"{name}: horizon")
        look: Callable | None = jax.tree_util.Partial(_control, as_partial(feedback.control_at))
    else:
        marched, look = problem.time_dependent, as_partial(feedback)
    assert look is not None
    loop = ClosedLoop(problem, look, marched, marched or problem.time_dependent)
    # where a Solution is NaN the state must not move, so the noise is zero there; a function always gives a control, so
    # a constant noise need not change
    looped = problem.noise is not None and (is_grid_feedback(feedback) or callable(problem.noise))
    closed = Problem(
        # no cost and no controls; the disturbance plays against the closed loop
        loop.drift, None, None, disturbances=problem.disturbances,
        noise=loop.noise if looped else problem.noise,
        isaacs=problem.isaacs,
        time_dependent=loop.timed,
    )  # fmt: skip
    random = [name for name in OF_CHANGES if getattr(problem, name) is not None]
    return altered(closed, **{name: as_partial(getattr(loop, name)) for name in random})


def exit_problem(
    problem: Problem, target: Callable, obstacle: Callable | None, cost: float, exit_cost: float
) -> Problem:
    """The problem that pays ``cost`` per unit time, and ``exit_cost`` on the target outside the obstacle.

    Args:
      problem: a problem whose drift, noise and players are used.
      target: a function ≤ 0 inside.
      obstacle: a function ≤ 0 inside, or None; it also ends the path and takes precedence where the two overlap.
      cost: cost per unit time; 0 for none.
      exit_cost: cost on the target; 0 for none.
    """
    sets = (target,) if obstacle is None else (target, obstacle)
    # use None for zero, because a function cannot be recognised as zero
    paid = jax.tree_util.Partial(_exit_cost, exit_cost, sets) if exit_cost else None
    question = Problem(
        # no discount, because probabilities and times are not discounted
        problem.drift, jax.tree_util.Partial(_constant, cost) if cost else None, problem.controls,
        disturbances=problem.disturbances, noise=problem.noise, target=jax.tree_util.Partial(_nearest, sets),
        exit_cost=paid, isaacs=problem.isaacs, time_dependent=problem.time_dependent,
    )  # fmt: skip
    return altered(question, **{name: getattr(problem, name) for name in OF_CHANGES})


def arrival(problem: Problem, target: Callable, obstacle: Callable | None) -> Problem:
    """The minimum time to the target for a system that stops permanently when it meets the obstacle.

    Its value is finite if and only if the target is reached before the obstacle. The arguments are as in
    ``exit_problem``.
    """
    drift = problem.drift if obstacle is None else jax.tree_util.Partial(_stopping, problem.drift, obstacle)
    inside = target if obstacle is None else jax.tree_util.Partial(_outside_of, target, obstacle)
    return Problem(
        drift, jax.tree_util.Partial(_constant, 1.0), problem.controls, target=inside,
        isaacs=problem.isaacs, time_dependent=problem.time_dependent,
    )  # fmt: skip


def tube(problem: Problem, target: Callable, obstacle: Callable | None, *, least: bool) -> Problem:
    """The tube of states that reach the target, {V ≤ 0}, or that cannot avoid it, {V ≥ 0}, if ``least``."""
    stop, most = (None, target) if least else (target, obstacle)
    return Problem(
        problem.drift, None, problem.controls, disturbances=problem.disturbances, stopping_cost=stop,
        running_max=None if most is None else jax.tree_util.Partial(complement, most),
        isaacs=problem.isaacs, time_dependent=problem.time_dependent,
    )  # fmt: skip


def _stopping(drift: Callable, obstacle: Callable, *arguments: Array) -> jax.Array:
    """f outside the obstacle, and zero in it."""
    rates = jnp.asarray(drift(*arguments))
    return jnp.where(jnp.asarray(obstacle(arguments[0])) <= 0, 0, rates)


def _outside_of(target: Callable, obstacle: Callable, *where: Place) -> jax.Array:
    """A function ≤ 0 in the target outside the obstacle."""
    return jnp.maximum(jnp.asarray(target(*where)), -jnp.asarray(obstacle(*where)))


def complement(region: Callable, *where: Place) -> Array:
    """A function ≤ 0 outside a region, for a function ≤ 0 inside."""
    return -region(*where)


def with_time(function: T, needed: bool) -> T | jax.tree_util.Partial:
    """Convert a function of the state to a function of time and state, if needed."""
    # a Partial instead of a lambda keeps the numbers of the user's function as leaves
    return jax.tree_util.Partial(_timeless, function) if needed and function is not None else function


def _timeless(function: Callable, t: Number, *arguments: Array) -> Array:
    """A function of the state with an unused time argument."""
    return function(*arguments)


def _control(look_up: Callable, *where: Place) -> Array:
    """A solution's control, clamped so that rounding does not put a boundary node outside."""
    return look_up(*where, clamp=True)


def _constant(value: Number, *arguments: Array) -> jax.Array:
    """A constant cost per unit time."""
    # the default dtype, which is float64 only if that is enabled, so that a float32 solve is not promoted
    return jnp.asarray(value, jnp.result_type(float))


def _nearest(sets: tuple[Callable, ...], *where: Place) -> jax.Array:
    """The minimum of the sets' functions, ≤ 0 in their union."""
    distances = [jnp.asarray(each(*where)) for each in sets]
    return distances[0] if len(sets) == 1 else jnp.minimum(*distances)


def _exit_cost(amount: Number, sets: tuple[Callable, ...], *where: Place) -> jax.Array:
    """The amount if the path ends in the target; between nodes, the path is taken to end in the nearer set."""
    if len(sets) == 1:
        return jnp.asarray(amount, jnp.result_type(float))
    inside, hit = (jnp.asarray(each(*where)) for each in sets)
    # on the boundary rounding decides both signs, so compare the two; a tie counts as the obstacle
    return jnp.where((hit <= 0) | (hit <= inside), 0.0, amount)
