"""Closed loops and their integration: what a feedback does to the system, and what that costs.

    dx = f(x, u, d) dt + σ(x, u, d) dw,  u = control(x),  d = opponent(x)
    cost = ∫ e^{−βt} L(x, u, d) dt  (+ e^{−βτ} exit cost, where the target is reached at τ; else e^{−βT} terminal cost)

The running cost is one more state of the integrator, so it has the accuracy of the path.

Without noise: Tsit5 with adaptive steps, no longer than the distance of two output times. A feedback that jumps
(bang-bang) makes any adaptive stepper crawl along its switching curve, so no step is shorter than
2·duration/max_steps: there the path chatters within f·(that step) of the curve, as a fast sampler would. For such
a feedback a zero-order hold is faster, and is what hardware does.
With noise: fixed steps in Itô's sense on a virtual Brownian tree. Noise that is a number or a matrix: SRA1 (strong
order 1.5 in a smooth closed loop); noise that is a function: Euler–Maruyama (strong order ½, weak order 1).
Rejecting steps would bias the law of the path, so ``rtol`` and ``atol`` have no say here.

The target and the edge of the box are looked for at the end of every internal step, and located by bisection of
that step's interpolant.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.path import Path, PathStatus
from hjbjax.problem import Problem
from hjbjax.pytree import node

FEWEST = 10  # intervals between kept times that a marched feedback must have over a path


def check_kept(solution: Any, duration: float, name: str) -> float:
    """Refuse a marched feedback that is not known well enough up to the duration.

    Args:
      solution: a marched solution, its times known numbers.
      duration: how long it is to act, from t = 0.
      name: who asks and what it calls the duration, for refusals.

    Returns:
      The horizon up to which it was marched.

    Raises:
      ValueError: the kept times end before, or are too far apart.
    """
    times = np.asarray(solution.times, np.float64)
    horizon = float(getattr(solution, "stats", {}).get("horizon", times[-1]))
    if duration > horizon * (1 + 1e-9):
        raise ValueError(f"{name} = {duration:g} goes beyond the horizon {horizon:g} of the solution; shorten it")
    between = np.concatenate([[0.0], times[(times > 0) & (times < duration)], [duration]])
    gap = float(np.max(np.diff(between)))
    if times[0] > 0 or times[-1] < duration * (1 - 1e-9) or gap > duration / FEWEST * (1 + 1e-9):
        raise ValueError(
            f"{name} = {duration:g}, but the solution was marched and kept at {times.size} times from {times[0]:g} to "
            f"{times[-1]:g}; a feedback up to t = {duration:g} wants all of that covered,\n"
            f"at most {duration / FEWEST:g} apart: march(..., times=np.linspace(0, {horizon:g}, 41))"
        )
    return horizon


@node(static=("clamp",))
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

    def u(self, t, x):
        """The control, shape (m,)."""
        return jnp.zeros(0, x.dtype) if self.control is None else self._ask(self.control, t, x)

    def d(self, t, x):
        """The disturbance, shape (l,), or None."""
        return None if self.opponent is None else self._ask(self.opponent, t, x)

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

    def rate(self, t, x, u, discount):
        """Drift, and running cost times ``discount``, as one array of shape (n+1,)."""
        arguments = self.problem.arguments(self.wrap(x), u, self.d(t, x), t)
        cost = 0.0 if self.problem.cost is None else self.problem.cost(*arguments)
        drift = jnp.asarray(self.problem.drift(*arguments), x.dtype)
        return jnp.append(drift, jnp.asarray(discount * cost, x.dtype))

    def noise(self, t, x, u):
        """σ with a zero row for the cost, shape (n+1, k)."""
        sigma = self.problem.diffusion(self.wrap(x), u, self.d(t, x), t).astype(x.dtype)
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


@node(static=("max_steps", "held"))
class Stepping:
    """How the integrator steps.

    Args:
      rtol: relative error of an internal step.
      atol: absolute error of an internal step, in the units of the state and of the cost.
      max_step: the longest internal step, may be inf.
      max_steps: the most internal steps.
      held: whether the control is held from one output time to the next.
    """

    rtol: Any
    atol: Any
    max_step: Any
    max_steps: int
    held: bool


def integrate(loop: Loop, x0: Any, times: Any, key: Any, stepping: Stepping) -> tuple[Path, Any]:
    """The path of full length, and for each interval whether the path runs through it, shape (k,).

    One diffrax solve an output interval, all in one scan; a path that has ended gets intervals of length zero.
    """
    start = times[0]
    solve = _solver(loop, x0, times, key, stepping)

    def interval(state, end):
        t, y, code, count = state
        active = code == PathStatus.DURATION
        u, d = loop.u(t, y[:-1]), loop.d(t, y[:-1])
        later, moved, result, made = _advance(loop, solve, t, jnp.where(active, end, t), y, u, stepping)
        count = count + made
        code = jnp.where(active, result, code)
        code = jnp.where((code == PathStatus.DURATION) & (count >= stepping.max_steps), PathStatus.MAX_STEPS, code)
        active &= code != PathStatus.NONFINITE  # such a path ends at the last output time before
        t, y = jnp.where(active, later, t), jnp.where(active, moved, y)
        shown = jax.tree.map(lambda a: jnp.where(active, a, jnp.nan), (u, d))
        return (t, y, code.astype(jnp.int32), count), (t, y[:-1], *shown, active)

    code = jnp.where(loop.margin(x0) > 0, PathStatus.DURATION, PathStatus.LEFT_BOX)
    code = jnp.where(loop.target(start, x0) <= 0, PathStatus.TARGET, code).astype(jnp.int32)
    first = (start, jnp.append(x0, 0.0), code, jnp.zeros((), jnp.int32))
    (t, y, code, count), (later, states, controls, disturbances, active) = jax.lax.scan(interval, first, times[1:])
    hit = code == PathStatus.TARGET
    times, states = jnp.append(start, later), jnp.concatenate([x0[None], states])
    ended = code == PathStatus.DURATION
    if loop.problem.running_max is None:
        exit_cost, final = (loop.number(c, t, y[:-1]) for c in (loop.problem.exit_cost, loop.problem.terminal_cost))
        due = jnp.where(hit, exit_cost, jnp.where(ended, final, 0))
        cost = y[-1] + loop.discount(t - start) * due
    else:
        cost = jnp.max(jax.vmap(lambda t, x: loop.number(loop.problem.running_max, t, x))(times, states))
        if loop.problem.terminal_cost is not None:
            final = loop.number(loop.problem.terminal_cost, t, y[:-1])
            cost = jnp.where(ended, jnp.maximum(cost, final), cost)
    return Path(times, states, controls, disturbances, cost, jnp.where(hit, t, jnp.inf), code, count), active


def _advance(loop, solve, t, end, y, u, stepping):
    """From ``t`` to ``end``, or to the target or the edge if they come first: (time, y, code, steps)."""
    import diffrax

    width = jnp.where(end > t, end - t, 1)  # of an ended path: any positive number
    if loop.problem.noise is None:
        step = jnp.minimum(width, stepping.max_step)
    else:
        step = width / jnp.ceil(jnp.maximum(width / stepping.max_step, 10) - 1e-6)
    solved = solve(t0=t, t1=end, dt0=step, y0=y, args=u)
    later, y = solved.ts[0], solved.ys[0]
    code = jnp.where(loop.target(later, y[:-1]) <= loop.margin(y[:-1]), PathStatus.TARGET, PathStatus.LEFT_BOX)
    code = jnp.where(diffrax.is_event(solved.result), code, PathStatus.DURATION)
    code = jnp.where(diffrax.is_okay(solved.result), code, PathStatus.MAX_STEPS)
    code = jnp.where(jnp.all(jnp.isfinite(y)), code, PathStatus.NONFINITE)
    return later, y, code, solved.stats["num_steps"].astype(jnp.int32)


def _solver(loop, x0, times, key, stepping) -> Callable:
    """diffrax's solve with all that does not change from interval to interval; ``args`` is the control at ``t0``."""
    import diffrax

    start, duration = times[0], times[-1] - times[0]

    def act(t, y, held):
        return held if stepping.held else loop.u(t, y[:-1])

    def rate(t, y, held):
        return loop.rate(t, y[:-1], act(t, y, held), loop.discount(t - start))

    def noise(t, y, held):
        return loop.noise(t, y[:-1], act(t, y, held))

    def margin(t, y, args, **kwargs):
        return jnp.minimum(loop.target(t, y[:-1]), loop.margin(y[:-1]))

    terms: Any = diffrax.ODETerm(rate)
    solver: Any
    controller: Any
    if loop.problem.noise is None:
        solver = diffrax.Tsit5()
        controller = diffrax.PIDController(
            rtol=stepping.rtol, atol=stepping.atol, dtmin=2 * duration / stepping.max_steps, dtmax=stepping.max_step,
            force_dtmin=True,
        )  # fmt: skip
    else:
        additive = not callable(loop.problem.noise)
        brownian = _brownian(loop, x0, times, key, stepping.max_step, additive)
        terms = diffrax.MultiTerm(terms, diffrax.ControlTerm(noise, brownian))
        solver, controller = diffrax.SRA1() if additive else diffrax.Euler(), diffrax.ConstantStepSize()
    event = None
    if loop.problem.target is not None or (loop.grid is not None and not loop.clamp):  # it doubles the compile time
        close = 4 * jnp.finfo(x0.dtype).eps
        # flip=True: the function falls through zero. "detect" would put a host callback into the compiled run.
        event = diffrax.Event(margin, _bisection()(close, close, flip=True), direction=False)
    return functools.partial(
        diffrax.diffeqsolve, terms, solver, stepsize_controller=controller, event=event,
        saveat=diffrax.SaveAt(t1=True), adjoint=diffrax.ForwardMode(), max_steps=stepping.max_steps, throw=False,
    )  # fmt: skip


def _brownian(loop, x0, times, key, max_step, additive):
    """The Brownian path of a key, the same whatever the steps."""
    import diffrax

    start, duration = times[0], times[-1] - times[0]
    # Below its tolerance the tree interpolates, which is not Brownian: keep that far below a step (of 1/10 interval
    # or less), but one for the whole run, so that neighbouring intervals agree on w, and at most 30 levels deep.
    fine = jnp.maximum(jnp.minimum(jnp.min(jnp.diff(times)) / 10, max_step) / 64, duration / 2**30)
    area = diffrax.SpaceTimeLevyArea if additive else diffrax.BrownianIncrement
    sources = jax.eval_shape(lambda x: loop.noise(start, x, loop.u(start, x)), x0).shape[1]
    shape = jax.ShapeDtypeStruct((sources,), x0.dtype)
    return diffrax.VirtualBrownianTree(start, start + duration, fine, shape, key, levy_area=area)


@functools.cache
def _bisection() -> Any:
    """optimistix's bisection, stopped by the width of its bracket alone: a target function may be steep, or jump."""
    import optimistix

    class Bisection(optimistix.Bisection):
        def terminate(self, fn, y, args, options, state, tags):
            narrow = jnp.abs(state.lower - state.upper) < self.atol + self.rtol * jnp.abs(y)
            return narrow, optimistix.RESULTS.successful

    return Bisection
