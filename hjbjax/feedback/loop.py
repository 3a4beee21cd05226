"""A closed loop at one time and state: what both players do, the drift, the cost, the noise, and where it ends."""

import functools
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, Control, Disturbance, Number, State

Event: TypeAlias = tuple[Number, State]  # a point of the path: when, and where
Actions: TypeAlias = tuple[Control, Disturbance | None]  # of both players; no disturbance where there is no opponent

HALVINGS = 30  # of the way back to where the players have an answer: a billionth of an interval


@pytree_dataclass(static=("clamp",))
class Loop:
    """The closed loop as functions of (t, x).

    Args:
      problem: the system and its costs.
      control: a pytree that is called with (t, x); None where there is no control.
      opponent: a pytree like it for the disturbance; None where nobody acts.
      grid: the Grid in whose box the players are known; None where that is everywhere.
      clamp: outside the box, True goes on with what the players say at its nearest point, False ends the path.
    """

    problem: Problem
    control: Callable | None
    opponent: Callable | None
    grid: Grid | None
    clamp: bool

    def wrap(self, x: State) -> State:
        """The state with its periodic entries in the box."""
        return x if self.grid is None else self.grid.wrap(x)

    def players(self, t: Number, x: State) -> Actions:
        """The control, shape (m,), and the disturbance, shape (l,), or None; NaN where they have no answer."""
        u = jnp.zeros(0, x.dtype) if self.control is None else self._ask(self.control, t, x)
        return u, None if self.opponent is None else self._ask(self.opponent, t, x)

    def actions(self, t: Number, x: State, since: Event) -> Actions:
        """The players at (t, x); where they have no answer, as in the target, that of the last place which has one.

        Args:
          t: the time.
          x: the state, which a stage of a step may put into the target.
          since: a time and a state before, where the players have an answer.
        """
        now = self.players(t, x)
        if not self.guarded:
            return now

        def halve(_: int, way: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            known, lost = way  # shares of the way: the players answer at the first, and do not at the second
            middle = (known + lost) / 2
            there = self._between(since, (t, x), middle)
            good = (self.target(*there) > 0) & are_finite(self.players(*there))
            return jnp.where(good, middle, known), jnp.where(good, lost, middle)

        def before() -> Actions:
            ends = jnp.zeros((), x.dtype), jnp.ones((), x.dtype)
            known, _ = jax.lax.fori_loop(0, HALVINGS, halve, ends)
            return self.players(*self._between(since, (t, x), known))

        # a branch and no `where`: but under vmap the halvings are paid only at the few stages beyond a boundary
        return jax.lax.cond((self.target(t, x) > 0) & are_finite(now), lambda: now, before)

    def _between(self, since: Event, now: Event, share: jax.Array) -> Event:
        """The point at a share of the straight way from one event to another."""
        (t, x), (later, end) = since, now
        return t + share * (later - t), x + share * (end - x)

    @property
    def guarded(self) -> bool:
        """True if there is a place where the players need not have an answer: inside a target, or on a grid."""
        return (self.control is not None or self.opponent is not None) and (
            self.problem.target is not None or self.grid is not None
        )

    def _ask(self, player: Callable, t: Number, x: State) -> jax.Array:
        """A player's action at (t, x); the player sees the state in the box."""
        if self.grid is not None:
            # a stage of a step may lie beyond the edge at which the path is about to end
            x, (lo, hi) = self.grid.wrap(x), self._corners(x)
            x = jnp.where(np.array(self.grid.periodic), x, jnp.clip(x, lo, hi))
        return jnp.asarray(player(t, x), x.dtype)

    def _corners(self, x: State) -> tuple[jax.Array, jax.Array]:
        """The lower and the upper corner of the box in the dtype of the state, each of shape (n,)."""
        assert self.grid is not None
        return jnp.asarray(self.grid.lo, x.dtype), jnp.asarray(self.grid.hi, x.dtype)

    def discount(self, elapsed: Array) -> jax.Array:
        """e^{−βt} after the time ``elapsed``."""
        return jnp.exp(-jnp.asarray(self.problem.discount, elapsed.dtype) * elapsed)

    def rate(self, t: Number, x: State, u: Control, d: Disturbance | None, discount: Number) -> jax.Array:
        """Drift, and running cost times ``discount``, as one array of shape (n+1,)."""
        arguments = self.problem.arguments(self.wrap(x), u, d, t)
        cost = 0.0 if self.problem.cost is None else self.problem.cost(*arguments)
        drift = jnp.asarray(self.problem.drift(*arguments), x.dtype)
        return jnp.append(drift, jnp.asarray(discount * cost, x.dtype))

    def noise(self, t: Number, x: State, u: Control, d: Disturbance | None) -> jax.Array:
        """σ with a zero row for the cost, shape (n+1, k)."""
        sigma = self.problem.diffusion(self.wrap(x), u, d, t).astype(x.dtype)
        # the cost is the last state of the integrator; it feels the noise through the path alone
        return jnp.pad(sigma, ((0, 1), (0, 0)))

    def target(self, t: Number, x: State) -> jax.Array:
        """The target's function at (t, x), ≤ 0 inside; inf where there is no target."""
        return self.number(jnp.inf if self.problem.target is None else self.problem.target, t, x)

    def margin(self, x: State) -> jax.Array:
        """The distance to the edge of the box over its width, ≤ 0 outside; inf where the path may go anywhere."""
        if self.grid is None or self.clamp:
            return jnp.asarray(jnp.inf, x.dtype)
        lo, hi = self._corners(x)
        inside = jnp.minimum(x - lo, hi - x) / (hi - lo)  # over the width, so that axes of any units compare
        # A path may rest on the edge, where rounding must not push it out: 64 units in the last place, 1.4e-14 of the
        # width in float64, is far above the rounding of a step and far below what anybody would call outside.
        slack = 64 * jnp.finfo(x.dtype).eps
        return jnp.min(jnp.where(np.array(self.grid.periodic), jnp.inf, inside)) + slack

    def number(self, value: Number | Callable | None, t: Number, x: State) -> jax.Array:
        """The number that a number (None is zero) or a function of the state stands for at (t, x)."""
        if callable(value):
            value = value(*self.problem.state_arguments(self.wrap(x), t))
        return jnp.asarray(0.0 if value is None else value, x.dtype)


def are_finite(actions: Actions) -> jax.Array:
    """True if every entry of both players' actions is finite: a feedback says NaN where it has no answer."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(each)) for each in jax.tree.leaves(actions)]))


def check_shapes(loop: Loop, x0: Array) -> None:
    """Trace every function of the loop once, abstractly, and compare the shapes it returns with those wanted."""
    problem, n = loop.problem, x0.shape[0]
    m = 0 if problem.controls is None else problem.controls.dim
    opponents = 0 if problem.disturbances is None else problem.disturbances.dim
    # zeros, and a number of the state's type for the time: nothing is computed, only shapes and types are asked for
    u, d = np.zeros(m, x0.dtype), np.zeros(opponents, x0.dtype)
    players, state = (x0[0], x0), problem.arguments(x0, u, d, x0[0])
    for name, function, fed, wanted in (
        ("feedback", loop.control, players, (m,)),
        ("disturbance", loop.opponent, players, (opponents,)),
        ("drift", problem.drift, state, (n,)),
        ("cost", problem.cost, state, ()),
        ("target", problem.target, problem.state_arguments(x0, x0[0]), ()),
    ):
        if function is None:
            continue
        try:
            found = jax.eval_shape(functools.partial(_array, function, name), *fed)
        except jax.errors.JAXTypeError as error:
            raise ValueError(
                f"simulate: {name} cannot be traced: use jnp.where instead of if, and jnp instead of numpy"
            ) from error
        if jnp.issubdtype(found.dtype, jnp.complexfloating):
            raise ValueError(f"simulate: {name} returned complex numbers, expected real ones, shape {wanted}")
        if found.shape != wanted:
            raise ValueError(
                f"simulate: {name} returned shape {found.shape}, expected {wanted}, for x0 of shape {x0.shape}"
            )


def _array(function: Callable, name: str, *arguments: Array) -> jax.Array:
    """The function's result as an array; refuses what is none."""
    result = function(*arguments)
    try:
        return jnp.asarray(result)
    except jax.errors.JAXTypeError:  # a tracer where NumPy or Python wants a number
        raise
    except (TypeError, ValueError):
        what = "None; is its return missing?" if result is None else f"a {type(result).__name__}"
        raise ValueError(f"simulate: {name} returned {what}, expected an array of numbers") from None
