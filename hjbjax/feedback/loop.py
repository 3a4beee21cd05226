"""A closed loop at one time and state: both players, the drift, the cost, the noise, and the end of a path.

With noise a path can also meet its target between the ends of a step. A step of length h only computes the path at its
ends. A test only there finds the target too late by about 0.58 σ√h, so mean times would have order ½. Between its ends
an Euler step is a Brownian bridge, which is sampled once per step. With the target's function l ≥ 0 outside, and its
distances d = l/|σ'∇l| at the two ends in units of the noise,

    P(the bridge meets the target | both ends outside) = exp(−2 d₀d₁/h),
    τ/(h − τ) ~ inverse Gaussian with mean d₀/|d₁| and shape d₀²/h if it meets the target; also if d₁ ≤ 0

is exact for additive noise, constant drift and a target with a flat boundary. Otherwise the laws of exit times have the
order 1 of the Euler scheme. If the noise acts only along the boundary (∇l'σ = 0, for example noise on the velocity and
a target in position), the path has a slope, and the interpolant of the step locates the target.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.feedback import is_grid_feedback
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, changes_at_random, is_random
from hjbjax.problem.pytree import altered, pytree_dataclass
from hjbjax.problem.types import Array, Control, Disturbance, Key, Number, State
from hjbjax.tracing import checks, closures

Event: TypeAlias = tuple[Number, State]  # a point of the path: its time and its state
Actions: TypeAlias = tuple[Control, Disturbance | None]  # of both players; no disturbance without an opponent

HALVINGS = 30  # bisections for the last point of a path at which the players are defined: to a billionth of an interval
STREAM = 0x6272  # folded into the key, so that the draws are independent of the Brownian path, which splits the key
NEWTON = 3  # steps onto the boundary of the target, whose function need not be linear
EDGE = 1e-6  # the smallest share of a step before or after a meeting; shares of 0 and 1 would give no zero inside it


@pytree_dataclass(static=("clamp", "due", "modes", "clock"))
class Loop:
    """The closed loop as functions of (t, x).

    Args:
      problem: the system and its costs.
      control: a pytree that is called with (t, x); None if there is no control.
      opponent: a callable pytree for the disturbance; None without an opponent.
      grid: the Grid in whose box the players are known; None if they are known everywhere.
      clamp: outside the box, True continues with the players at the nearest point of the box, False ends the path.
      surplus: ψ − V as a function of (t, x), zero where the path is stopped; None if V stops no path.
      due: the payment after the last time: "terminal cost", "V at the horizon", or "nothing" for a shortened path.
      at_horizon: V at the horizon as a function of (t, x), if the problem does not define it.
      switch: min_j (c_ij + V_j) − V_i and its terms as a function of (t, x); None if V changes no mode.
      modes: the number of modes; zero without modes. See ``sudden_changes``.
      clock: the position of the clock in the state, which is zero when the mode or the state changes at random. Zero
        without sudden changes.
      key: the key of the random changes.
      push: the way to the boundary of the push region and its cost, (n + 1,), as a function of (t, x); None without
        pushes. See ``pushing``.
    """

    problem: Problem
    control: Callable | None
    opponent: Callable | None
    grid: Grid | None
    clamp: bool
    surplus: Callable | None = None
    due: str = "terminal cost"
    at_horizon: Callable | None = None
    switch: Callable | None = None
    modes: int = 0
    clock: int = 0
    key: Key | None = None
    push: Any = None

    @property
    def has_equal_steps(self) -> bool:
        """True if the steps of the integrator do not adapt: with noise, and with pushes, which act between steps."""
        return self.problem.noise is not None or self.push is not None

    def wrap(self, x: State) -> State:
        """The state with its periodic entries wrapped into the box."""
        return x if self.grid is None else self.grid.wrap(x)

    def players(self, t: Number, x: State) -> Actions:
        """The control, shape (m,), and the disturbance, shape (l,), or None; NaN where they are undefined."""
        u = jnp.zeros(0, x.dtype) if self.control is None else self._ask(self.control, t, x)
        return u, None if self.opponent is None else self._ask(self.opponent, t, x)

    def actions(self, t: Number, x: State, since: Event) -> Actions:
        """The players at (t, x), or, if they are undefined there, at the last point where they are defined.

        Args:
          t: the time.
          x: the state, which a stage of a step may place inside the target.
          since: an earlier time and state at which the players are defined.
        """
        now = self.players(t, x)
        if not self.guarded:
            return now

        def halve(_: int, way: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            known, lost = way  # shares of the path: the players are defined at the first, and not at the second
            middle = (known + lost) / 2
            there = self._between(since, (t, x), middle)
            good = (self.target(*there) > 0) & are_finite(self.players(*there))
            return jnp.where(good, middle, known), jnp.where(good, lost, middle)

        def before() -> Actions:
            ends = jnp.zeros((), x.dtype), jnp.ones((), x.dtype)
            known, _ = jax.lax.fori_loop(0, HALVINGS, halve, ends)
            return self.players(*self._between(since, (t, x), known))

        # a branch rather than `where`: without vmap, halvings are only computed at the few stages beyond a boundary
        return jax.lax.cond((self.target(t, x) > 0) & are_finite(now), lambda: now, before)

    def _between(self, since: Event, now: Event, share: jax.Array) -> Event:
        """The point at a given share of the straight line between two events."""
        (t, x), (later, end) = since, now
        return t + share * (later - t), x + share * (end - x)

    @property
    def guarded(self) -> bool:
        """True if the players may be undefined somewhere: inside a target, or outside a grid."""
        return (self.control is not None or self.opponent is not None) and (self.ends or self.grid is not None)

    @property
    def ends(self) -> bool:
        """True if a path may end at a target, or where V stops it."""
        return self.problem.target is not None or self.surplus is not None

    def _ask(self, player: Callable, t: Number, x: State) -> jax.Array:
        """A player's action at (t, x); the player receives the state in the box."""
        if self.grid is not None:
            # a stage of a step may be beyond the boundary at which the path is about to end
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
        # the cost is the last state of the integrator; noise affects it only through the path
        return jnp.pad(sigma, ((0, 1), (0, 0)))

    def target(self, t: Number, x: State) -> jax.Array:
        """A function ≤ 0 in the target and where V stops the path; inf if there is neither."""
        level = self.number(jnp.inf if self.problem.target is None else self.problem.target, t, x)
        if self.surplus is None:
            return level
        # V knows ψ at the nodes only; between them stopping may still be forbidden
        left = jnp.where(jnp.isfinite(self.price(t, x)), self.surplus(t, self.wrap(x)), jnp.inf)
        return jnp.minimum(level, left)

    def price(self, t: Number, x: State) -> jax.Array:
        """The cost ψ of stopping at (t, x), or at a node that x meets up to rounding."""
        return self.number(self.problem.stopping_cost, t, self.at_node(x))

    def at_node(self, x: State) -> State:
        """The state in the box, moved to a node of the grid that it meets up to rounding."""
        return x if self.grid is None else self.grid.at_node(self.wrap(x))

    def until_change(self, t: Number, x: State) -> jax.Array:
        """A function ≤ 0 where the mode or the state changes suddenly; inf if neither does."""
        left = jnp.asarray(jnp.inf, x.dtype)
        if changes_at_random(self.problem):
            left = x[self.clock]
        return left if self.switch is None else jnp.minimum(left, self.switch(t, self.wrap(x))[0])

    def margin(self, x: State) -> jax.Array:
        """The distance to the boundary of the box over its width, ≤ 0 outside; inf if the path is not limited."""
        if self.grid is None or self.clamp:
            return jnp.asarray(jnp.inf, x.dtype)
        lo, hi = self._corners(x)
        inside = jnp.minimum(x - lo, hi - x) / (hi - lo)  # relative to the width, so that units do not matter
        # rounding must not push a path that rests on the boundary outside: 64 units in the last place, 1.4e-14 of the
        # width in float64, exceed the rounding of a step by far and are still negligible
        slack = 64 * jnp.finfo(x.dtype).eps
        return jnp.min(jnp.where(np.array(self.grid.periodic), jnp.inf, inside)) + slack

    def number(self, value: Number | Callable | None, t: Number, x: State) -> jax.Array:
        """The number at (t, x) given by a number, a function of the state, or None for zero."""
        if callable(value):
            value = value(*self.problem.state_arguments(self.wrap(x), t))
        return jnp.asarray(0.0 if value is None else value, x.dtype)

    def paid_at_end(self, t: Number, x: State) -> jax.Array:
        """The cost of ending at (t, x), where ``target`` is ≤ 0: the exit cost on the target, ψ elsewhere."""
        exit_cost = self.number(self.problem.exit_cost, t, x)
        if self.surplus is None:
            return exit_cost
        price = self.price(t, x)
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
    """True if every entry of both players' actions is finite; a feedback is NaN where it is undefined."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(each)) for each in jax.tree.leaves(actions)]))


def check_shapes(loop: Loop, x0: Array) -> None:
    """Trace every function of the loop once, abstractly, and compare the shapes with the required shapes."""
    problem, n = loop.problem, x0.shape[0]
    m = 0 if problem.controls is None else problem.controls.dim
    opponents = 0 if problem.disturbances is None else problem.disturbances.dim
    # zeros, and a number of the state's type for the time: only shapes and types are evaluated
    u, d = np.zeros(m, x0.dtype), np.zeros(opponents, x0.dtype)
    fed = {"x": x0, "u": u, "d": d, "t": x0[0]}
    action, place = problem.arguments("x", "u", "d", "t"), problem.state_arguments("x", "t")
    for name, function, letters, wanted in (
        ("feedback", loop.control, "tx", (m,)),
        ("disturbance", loop.opponent, "tx", (opponents,)),
        ("drift", problem.drift, action, (n,)),
        (problem.payoff, problem.cost, action, ()),
        ("target", problem.target, place, ()),
    ):
        if function is None:
            continue
        ask = functools.partial(_array, function, name, letters)
        try:
            found = jax.eval_shape(ask, *(fed[letter] for letter in letters))
        except ValueError as error:  # raise a new error, otherwise JAX adds lines about its own frames
            raise ValueError(str(error)) from error.__cause__
        if jnp.issubdtype(found.dtype, jnp.complexfloating):
            raise ValueError(f"simulate: {name} returned complex numbers, expected real ones, shape {wanted}")
        if found.shape != wanted:
            raise ValueError(
                f"simulate: {name} returned shape {found.shape}, expected {wanted}, for x0 of shape {x0.shape}"
            )


def _array(function: Callable, name: str, letters: Sequence[str], *arguments: Array) -> jax.Array:
    """The function's result as an array; refuses other results, and functions that fail or cannot be traced."""
    try:
        result = function(*arguments)
    except Exception as error:
        said = checks.refusal(error, name, dict(zip(letters, map(np.shape, arguments), strict=True)))
        if said is None:  # an exception from the user's code
            raise
        raise ValueError(f"simulate: {said}") from error
    try:
        return jnp.asarray(result)
    except (TypeError, ValueError):
        what = "None; is its return missing?" if result is None else f"a {type(result).__name__}"
        raise ValueError(f"simulate: {name} returned {what}, expected an array of numbers") from None


def noise_key(problem: Problem, given: Key | int | None) -> Key | None:
    """The random key, from a key or a seed; refuses a key without noise, and noise without a key."""
    if is_random(problem) and given is None:
        what = "noise" if problem.noise is not None else "random changes of the mode"
        raise ValueError(f"simulate: the problem has {what}; give key=jax.random.key(0), or any other seed")
    if not is_random(problem) and given is not None:
        raise ValueError("simulate: got a key, but problem.noise is None and nothing is random; leave out key")
    return None if given is None else arguments.random_key(given, "simulate: key")


# --- a noisy path at a target ---


@pytree_dataclass()
class BridgeDraw:
    """The draws of one path: two uniform numbers and a normal number for the step that begins at a given time.

    Args:
      key: the random key of the path.
    """

    key: Key | None

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Three numbers; the bits of the time at which a step begins make the key of the step."""
        assert self.key is not None  # a noisy problem has a key
        key = jax.random.fold_in(self.key, STREAM)
        for word in jnp.atleast_1d(jax.lax.bitcast_convert_type(t, np.uint32)):  # one for float32, two for float64
            key = jax.random.fold_in(key, word)
        both, normal = jax.random.split(key)
        meets, early = jax.random.uniform(both, (2,), t.dtype)
        return meets, early, jax.random.normal(normal, (), t.dtype)


def slope_along(level: Callable, x: State, sigma: Array) -> tuple[Array, Array]:
    """l and σ'∇l, shape (k,), at a state; a slope that is not finite, such as a norm's at 0, counts as zero."""
    value, push = jax.linearize(level, x)  # forward mode, because a target's function may contain a loop
    slope = jax.vmap(push)(sigma.T)
    return value, jnp.where(jnp.isfinite(slope), slope, 0.0)


def meeting(draws: tuple[Array, Array, Array], before: Array, after: Array, length: Number) -> tuple[Array, Array]:
    """True if a bridge meets zero, and the share of the step at which it first does.

    Args:
      draws: the numbers of ``BridgeDraw.at``.
      before: d₀ > 0, the distance at the start in units of the noise, length^½.
      after: d₁, the distance at the end.
      length: h, the length of the step.
    """
    meets, early, normal = draws
    # −2 d₀d₁/h ≥ 0 if the end is inside the target, so it is met for sure
    met = meets < jnp.exp(-2 * before * after / length)
    # the inverse Gaussian of Michael, Schucany and Haas: the root of a quadratic in the square of a normal number,
    # written without cancellation for large means; take it with probability mean/(mean + root), otherwise mean²/root
    mean = before / jnp.maximum(jnp.abs(after), jnp.finfo(before.dtype).eps * before)
    spread = 0.5 * mean * length * normal * normal / (before * before)
    root = mean / (1 + spread + jnp.sqrt(spread * (spread + 2)))
    ratio = jnp.where(early * (mean + root) <= mean, root, mean * (mean / root))
    return met, jnp.clip(1 / (1 + 1 / ratio), EDGE, 1 - EDGE)


def onto_edge(level: Callable, x: State, sigma: Array) -> State:
    """The state moved along σσ'∇l, the direction of the noise, onto the boundary of the target."""
    for _ in range(NEWTON):
        value, slope = slope_along(level, x, sigma)
        square = slope @ slope
        # the state stays if the noise does not act across the boundary
        x = x - jnp.where(square > 0, value / jnp.where(square > 0, square, 1.0), 0.0) * (sigma @ slope)
    return x


def meeting_flag(loop: Loop, draw: BridgeDraw, sigma: Array, begins: Event, ends: Event) -> jax.Array:
    """The flag at the end of a step, less than 1 if the step meets the target; the flag at its start is 1.

    The flag at the end is 1 − 1/share, so that the straight line between the two values is 0 at the meeting.
    """
    (t, x), (later, end) = begins, ends
    (before, first), (after, last) = (
        slope_along(functools.partial(loop.target, when), where, sigma) for when, where in (begins, ends)
    )
    sizes = jnp.sqrt(jnp.stack([first @ first, last @ last]))
    acts = jnp.all(sizes > 0)
    sizes = jnp.where(acts, sizes, 1.0)
    met, share = meeting(draw.at(jnp.asarray(t, x.dtype)), before / sizes[0], after / sizes[1], later - t)
    # if the path leaves the box before it meets a target outside, it left the box first
    way = jnp.where(after <= 0, before / jnp.where(after <= 0, before - after, 1.0), 0.0)
    met &= acts & (loop.margin(x + way * (end - x)) > 0)
    return jnp.where(met, 1 - 1 / share, 1.0).astype(x.dtype)


@functools.cache
def adjusting(kind: type) -> type:
    """A diffrax solver that changes the state at the end of each step, by pushes and by the flag of a bridge."""

    class Adjusting(kind):
        after: Any = None  # a field after the base class's fields needs a default

        def step(
            self, terms: Any, t0: Number, t1: Number, y0: jax.Array, args: Any, solver_state: Any, made_jump: Any
        ) -> tuple[jax.Array, Any, dict[str, Any], Any, Any]:
            y1, error, dense, state, result = super().step(terms, t0, t1, y0, args, solver_state, made_jump)
            y1 = self.after(t0, t1, y0, y1, args)
            # the event is located on the straight line between the ends, the interpolant of all of these solvers
            return y1, error, {**dense, "y1": y1}, state, result

    return Adjusting


def timeless(function: Callable, t: Number, x: State) -> Array:
    """A user's function of the state, called with time and state."""
    return function(x)


def settled_loop(loop: Loop, n: int, own: Mapping[str, object]) -> Loop:
    """The loop with the problem's functions, and the user's ``own`` players, in their current state.

    Changes of an object are noticed, and a function that computes the same as before is not compiled again.
    """
    players = {name: getattr(loop, name) for name, given in own.items() if given is not None}
    for name, player in players.items():
        if player is not None and not is_grid_feedback(own[name]):
            players[name] = closures.settled_function(player, (), (n,))
    return altered(loop, problem=closures.settled(loop.problem, n), **players)
