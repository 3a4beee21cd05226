"""A closed loop at one time and state: what both players do, the drift, the cost, the noise, and where it ends."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass

HALVINGS = 30  # of the way back to where the players have an answer: a billionth of an interval


@pytree_dataclass(static=("clamp",))
class Loop:
    """The closed loop as functions of (t, x).

    Args:
      problem: the system and its costs.
      control: a pytree that is called with (t, x); None where there is no control.
      opponent: likewise, for the disturbance.
      grid: the Grid in whose box the players are known; None where that is everywhere.
      clamp: outside the box, whether to go on with what the players say at its nearest point.
    """

    problem: Problem
    control: Any
    opponent: Any
    grid: Any
    clamp: bool

    def wrap(self, x):
        """The state with its periodic entries in the box."""
        return x if self.grid is None else self.grid.wrap(x)

    def players(self, t, x):
        """The control, shape (m,), and the disturbance, shape (l,), or None; NaN where they have no answer."""
        u = jnp.zeros(0, x.dtype) if self.control is None else self._ask(self.control, t, x)
        return u, None if self.opponent is None else self._ask(self.opponent, t, x)

    def actions(self, t, x, since):
        """The players at (t, x); where they have none, as in the target, those of the last place that has.

        Args:
          t: the time.
          x: the state, which a stage of a step may put into the target.
          since: a time and a state before, where the players have an answer.
        """
        now = self.players(t, x)
        if not self.guarded:
            return now

        def halve(_, way):
            known, lost = way
            middle = (known + lost) / 2
            there = self._between(since, (t, x), middle)
            good = (self.target(*there) > 0) & defined(self.players(*there))
            return jnp.where(good, middle, known), jnp.where(good, lost, middle)

        def before():
            ends = jnp.zeros((), x.dtype), jnp.ones((), x.dtype)
            known, _ = jax.lax.fori_loop(0, HALVINGS, halve, ends)
            return self.players(*self._between(since, (t, x), known))

        return jax.lax.cond((self.target(t, x) > 0) & defined(now), lambda: now, before)

    def _between(self, since, now, share):
        return tuple(a + share * (b - a) for a, b in zip(since, now, strict=True))

    @property
    def guarded(self):
        """Whether there is a place where the players need not have an answer: inside a target, or on a grid."""
        return (self.control is not None or self.opponent is not None) and (
            self.problem.target is not None or self.grid is not None
        )

    def _ask(self, player, t, x):
        """A player sees the state in the box."""
        if self.grid is not None:
            x, (lo, hi) = self.grid.wrap(x), self._corners(x)
            x = jnp.where(np.array(self.grid.periodic), x, jnp.clip(x, lo, hi))
        return jnp.asarray(player(t, x), x.dtype)

    def _corners(self, x):
        return jnp.asarray(self.grid.lo, x.dtype), jnp.asarray(self.grid.hi, x.dtype)

    def discount(self, elapsed):
        """e^{−βt} after the time ``elapsed``."""
        return jnp.exp(-jnp.asarray(self.problem.discount, elapsed.dtype) * elapsed)

    def rate(self, t, x, u, d, discount):
        """Drift, and running cost times ``discount``, as one array of shape (n+1,)."""
        arguments = self.problem.arguments(self.wrap(x), u, d, t)
        cost = 0.0 if self.problem.cost is None else self.problem.cost(*arguments)
        drift = jnp.asarray(self.problem.drift(*arguments), x.dtype)
        return jnp.append(drift, jnp.asarray(discount * cost, x.dtype))

    def noise(self, t, x, u, d):
        """σ with a zero row for the cost, shape (n+1, k)."""
        sigma = self.problem.diffusion(self.wrap(x), u, d, t).astype(x.dtype)
        return jnp.pad(sigma, ((0, 1), (0, 0)))

    def target(self, t, x):
        """≤ 0 inside the target; inf where there is none."""
        return self.number(jnp.inf if self.problem.target is None else self.problem.target, t, x)

    def margin(self, x):
        """The distance to the edge of the box over its width, ≤ 0 outside; inf where the path may go anywhere."""
        if self.grid is None or self.clamp:
            return jnp.asarray(jnp.inf, x.dtype)
        lo, hi = self._corners(x)
        inside = jnp.minimum(x - lo, hi - x) / (hi - lo)
        # A path may rest on the edge, where rounding must not push it out.
        slack = 64 * jnp.finfo(x.dtype).eps
        return jnp.min(jnp.where(np.array(self.grid.periodic), jnp.inf, inside)) + slack

    def number(self, value, t, x):
        """A number (None is zero) or a function of the state, as a number."""
        if callable(value):
            value = value(*self.problem.state_arguments(self.wrap(x), t))
        return jnp.asarray(0.0 if value is None else value, x.dtype)


def defined(actions: Any) -> Any:
    """Whether every entry of the players' actions is finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(each)) for each in jax.tree.leaves(actions)]))
