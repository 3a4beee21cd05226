"""Where a noisy path meets the target between two steps: a Brownian bridge, drawn once a step.

What a step of length h shows is the path at its ends, and a path that looks in only there is late by about .58 σ√h:
mean times are then off by the order ½. Between its ends a step of Euler's is a Brownian bridge. With the target's
function l ≥ 0 outside, and its distances d = l/|σ'∇l| at the two ends in units of the noise,

    P(the bridge meets the target | both ends outside) = exp(−2 d₀d₁/h),
    τ/(h − τ) ~ inverse Gaussian with mean d₀/|d₁| and shape d₀²/h, where it does; also for d₁ ≤ 0, where it must

is exact for additive noise, a constant drift and a target with a flat edge; else the laws of exit times have the order
1 of Euler's. The noise may act along the edge alone (∇l'σ = 0, as on the velocity with a target in position): then
the path has a slope, and the interpolant of the step says when it meets the target.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.loop import Event, Loop
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, Key, Number, State

STREAM = 0x6272  # folded into the key, so that the draws share nothing with the Brownian path, which splits it
NEWTON = 3  # steps onto the edge of the target, whose function need not be linear
EDGE = 1e-6  # the least share of a step before or after a meeting: shares of 0 and 1 would be no zero inside it


@pytree_dataclass()
class Draw:
    """The draws of one path: a uniform number, another, and a normal one for the step that begins at a time.

    Args:
      key: of the path.
    """

    key: Key | None

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Three numbers; steps begin at different times, whose bits make a key of each."""
        assert self.key is not None  # where there is noise there is a key
        key = jax.random.fold_in(self.key, STREAM)
        for word in jnp.atleast_1d(jax.lax.bitcast_convert_type(t, np.uint32)):  # one of float32, two of float64
            key = jax.random.fold_in(key, word)
        both, normal = jax.random.split(key)
        meets, early = jax.random.uniform(both, (2,), t.dtype)
        return meets, early, jax.random.normal(normal, (), t.dtype)


def slope_along(level: Callable, x: State, sigma: Array) -> tuple[Array, Array]:
    """l and σ'∇l, shape (k,), at a state; a slope that is not finite, as of a norm at 0, counts as none."""
    value, push = jax.linearize(level, x)  # forward: a target's function may hold a loop
    slope = jax.vmap(push)(sigma.T)
    return value, jnp.where(jnp.isfinite(slope), slope, 0.0)


def meeting(draws: tuple[Array, Array, Array], before: Array, after: Array, length: Number) -> tuple[Array, Array]:
    """True if a bridge meets zero, and the share of the step after which it first does.

    Args:
      draws: of ``Draw.at``.
      before: d₀ > 0, the distance at the start in units of the noise, length^½.
      after: d₁, at the end.
      length: h, of the step.
    """
    meets, early, normal = draws
    # −2 d₀d₁/h ≥ 0 where the end is inside: met for sure
    met = meets < jnp.exp(-2 * before * after / length)
    # the inverse Gaussian of Michael, Schucany and Haas: the root of a quadratic in the square of a normal number,
    # written so that nothing cancels for large means; with probability mean/(mean + root) it, else mean²/root
    mean = before / jnp.maximum(jnp.abs(after), jnp.finfo(before.dtype).eps * before)
    spread = 0.5 * mean * length * normal * normal / (before * before)
    root = mean / (1 + spread + jnp.sqrt(spread * (spread + 2)))
    ratio = jnp.where(early * (mean + root) <= mean, root, mean * (mean / root))
    return met, jnp.clip(1 / (1 + 1 / ratio), EDGE, 1 - EDGE)


def onto_edge(level: Callable, x: State, sigma: Array) -> State:
    """The state moved along σσ'∇l, as the noise moves it, until it lies on the edge of the target."""
    for _ in range(NEWTON):
        value, slope = slope_along(level, x, sigma)
        square = slope @ slope
        # where noise does not act across the edge, the state stays
        x = x - jnp.where(square > 0, value / jnp.where(square > 0, square, 1.0), 0.0) * (sigma @ slope)
    return x


def flag(loop: Loop, draw: Draw, sigma: Array, begins: Event, ends: Event) -> jax.Array:
    """The flag at the end of a step that has it 1 at its start: less than 1 where the target is met.

    On the straight line between the two 0 lies where that is: 1 − 1/share at the end.
    """
    (t, x), (later, end) = begins, ends
    (before, first), (after, last) = (
        slope_along(functools.partial(loop.target, when), where, sigma) for when, where in (begins, ends)
    )
    sizes = jnp.sqrt(jnp.stack([first @ first, last @ last]))
    acts = jnp.all(sizes > 0)
    sizes = jnp.where(acts, sizes, 1.0)
    met, share = meeting(draw.at(jnp.asarray(t, x.dtype)), before / sizes[0], after / sizes[1], later - t)
    # a box that is left on the way to a target behind its edge was left first
    way = jnp.where(after <= 0, before / jnp.where(after <= 0, before - after, 1.0), 0.0)
    met &= acts & (loop.margin(x + way * (end - x)) > 0)
    return jnp.where(met, 1 - 1 / share, 1.0).astype(x.dtype)


@functools.cache
def bridging(kind: type) -> type:
    """A solver of diffrax that writes the flag of each step into the last entry of the state at its end."""

    class Bridging(kind):
        flag: Any = None  # no field without a default may come behind those of the base

        def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
            y1, error, dense, state, result = super().step(terms, t0, t1, y0, args, solver_state, made_jump)
            y1 = y1.at[-1].set(self.flag(t0, t1, y0, y1, args))
            # the event is located on the straight line between the ends, which these two solvers interpolate by
            return y1, error, {**dense, "y1": y1}, state, result

    return Bridging
