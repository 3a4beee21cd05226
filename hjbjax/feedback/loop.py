"""A closed loop at one time and state: what both players do, the drift, the cost, the noise, and where it ends.

With noise a path also meets its target between two steps: a Brownian bridge, drawn once a step.

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
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from hjbjax.feedback.feedback import is_grid_feedback
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, pytree_dataclass
from hjbjax.problem.types import Array, Control, Disturbance, Key, Number, State
from hjbjax.tracing import checks, closures

Event: TypeAlias = tuple[Number, State]  # a point of the path: when, and where
Actions: TypeAlias = tuple[Control, Disturbance | None]  # of both players; no disturbance where there is no opponent

HALVINGS = 30  # of the way back to where the players have an answer: a billionth of an interval
STREAM = 0x6272  # folded into the key, so that the draws share nothing with the Brownian path, which splits it
NEWTON = 3  # steps onto the edge of the target, whose function need not be linear
EDGE = 1e-6  # the least share of a step before or after a meeting: shares of 0 and 1 would be no zero inside it


@pytree_dataclass(static=("clamp", "due"))
class Loop:
    """The closed loop as functions of (t, x).

    Args:
      problem: the system and its costs.
      control: a pytree that is called with (t, x); None where there is no control.
      opponent: a pytree like it for the disturbance; None where nobody acts.
      grid: the Grid in whose box the players are known; None where that is everywhere.
      clamp: outside the box, True goes on with what the players say at its nearest point, False ends the path.
      surplus: ψ − V as a function of (t, x), zero where the path is stopped; None where V stops no path.
      due: what is paid after the last time: "terminal cost", "V at the horizon", or "nothing" of a path cut short.
      at_horizon: V there as a function of (t, x), where it is not what the problem says.
    """

    problem: Problem
    control: Callable | None
    opponent: Callable | None
    grid: Grid | None
    clamp: bool
    surplus: Callable | None = None
    due: str = "terminal cost"
    at_horizon: Callable | None = None

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
        return (self.control is not None or self.opponent is not None) and (self.ends or self.grid is not None)

    @property
    def ends(self) -> bool:
        """True if a path may end at a target, or where V stops it."""
        return self.problem.target is not None or self.surplus is not None

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
        """A function ≤ 0 in the target and where V stops the path; inf where there is neither."""
        level = self.number(jnp.inf if self.problem.target is None else self.problem.target, t, x)
        return level if self.surplus is None else jnp.minimum(level, self.surplus(t, self.wrap(x)))

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

    def paid_at_end(self, t: Number, x: State) -> jax.Array:
        """The cost of ending at (t, x), where ``target`` is ≤ 0: on the target the exit cost, elsewhere ψ."""
        exit_cost = self.number(self.problem.exit_cost, t, x)
        if self.surplus is None:
            return exit_cost
        price = self.number(self.problem.stopping_cost, t, x)
        if self.problem.target is None:
            return price
        return jnp.where(self.number(self.problem.target, t, x) <= 0, exit_cost, price)

    def paid_at_last(self, t: Number, x: State) -> jax.Array:
        """The cost due at (t, x) after the last time; see ``due``."""
        problem = self.problem
        if self.due == "nothing":
            return jnp.zeros((), x.dtype)
        if self.due == "terminal cost":
            return self.number(problem.terminal_cost, t, x)
        if self.at_horizon is not None:
            return jnp.asarray(self.at_horizon(t, self.wrap(x)), x.dtype)
        final = problem.terminal_cost
        if final is None:
            final = problem.running_max if problem.stopping_cost is None else problem.stopping_cost
        paid = self.number(final, t, x)
        return paid if problem.stopping_cost is None else jnp.minimum(paid, self.number(problem.stopping_cost, t, x))


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
    fed = {"x": x0, "u": u, "d": d, "t": x0[0]}
    action, place = problem.arguments("x", "u", "d", "t"), problem.state_arguments("x", "t")
    for name, function, letters, wanted in (
        ("feedback", loop.control, "tx", (m,)),
        ("disturbance", loop.opponent, "tx", (opponents,)),
        ("drift", problem.drift, action, (n,)),
        ("cost", problem.cost, action, ()),
        ("target", problem.target, place, ()),
    ):
        if function is None:
            continue
        ask = functools.partial(_array, function, name, letters)
        try:
            found = jax.eval_shape(ask, *(fed[letter] for letter in letters))
        except ValueError as error:  # anew, or JAX adds some lines on frames of its own
            raise ValueError(str(error)) from error.__cause__
        if jnp.issubdtype(found.dtype, jnp.complexfloating):
            raise ValueError(f"simulate: {name} returned complex numbers, expected real ones, shape {wanted}")
        if found.shape != wanted:
            raise ValueError(
                f"simulate: {name} returned shape {found.shape}, expected {wanted}, for x0 of shape {x0.shape}"
            )


def _array(function: Callable, name: str, letters: Sequence[str], *arguments: Array) -> jax.Array:
    """The function's result as an array; refuses what is none, and what fails or cannot be traced."""
    try:
        result = function(*arguments)
    except Exception as error:
        said = checks.refusal(error, name, dict(zip(letters, map(np.shape, arguments), strict=True)))
        if said is None:  # an exception of the user's own
            raise
        raise ValueError(f"simulate: {said}") from error
    try:
        return jnp.asarray(result)
    except (TypeError, ValueError):
        what = "None; is its return missing?" if result is None else f"a {type(result).__name__}"
        raise ValueError(f"simulate: {name} returned {what}, expected an array of numbers") from None


def random_key(problem: Problem, given: Key | int | None) -> Key | None:
    """The random key, or that of a seed; refuses what is none, one without noise, and noise without one."""
    if problem.noise is not None and given is None:
        raise ValueError("simulate: the problem has noise; give key=jax.random.key(0), or any other seed")
    if problem.noise is None and given is not None:
        raise ValueError("simulate: got a key, but problem.noise is None and nothing is random; leave out key")
    return None if given is None else arguments.random_key(given, "simulate: key")


# --- a noisy path at a target ---


@pytree_dataclass()
class BridgeDraw:
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
      draws: of ``BridgeDraw.at``.
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


def meeting_flag(loop: Loop, draw: BridgeDraw, sigma: Array, begins: Event, ends: Event) -> jax.Array:
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


def timeless(function: Callable, t: Number, x: State) -> Array:
    """A user's function of the state alone, as one of time and state."""
    return function(x)


def settled_loop(loop: Loop, n: int, own: Mapping[str, object]) -> Loop:
    """The loop with the problem's functions, and the user's ``own`` players, looked at now.

    A changed object is seen, and a function that computes as before compiles nothing again.
    """
    players = {name: getattr(loop, name) for name, given in own.items() if given is not None}
    for name, player in players.items():
        if player is not None and player.func is timeless:
            players[name] = Partial(timeless, closures.settled_function(player.args[0], (n,)))
        elif player is not None and not is_grid_feedback(own[name]):
            players[name] = closures.settled_function(player, (), (n,))
    return altered(loop, problem=closures.settled(loop.problem, n), **players)
