"""Closed loops: what a feedback does to the system, and what that costs.

    dx = f(x, u, d) dt + σ(x, u, d) dw,  u = feedback(x),  d = disturbance(x)
    cost = ∫ e^{−βt} L(x, u, d) dt  (+ e^{−βτ} exit cost, where the target is reached at τ)

The running cost is one more state of the integrator, so it has the accuracy of the path.

Without noise: Tsit5 with adaptive steps, no longer than the distance of two output times. A feedback that jumps
(bang-bang) makes any adaptive stepper crawl along its switching curve, so no step is shorter than
2·duration/max_steps: there the path chatters within f·(that step) of the curve, as a fast sampler would. For such
a feedback ``hold=dt`` (zero-order hold) is faster, and is what hardware does.
With noise: fixed steps in Itô's sense on a virtual Brownian tree. Noise that is a number or a matrix: SRA1 (strong
order 1.5 in a smooth closed loop); noise that is a function: Euler–Maruyama (strong order ½, weak order 1).
Rejecting steps would bias the law of the path, so ``rtol`` and ``atol`` have no say here.

The target and the edge of the box are looked for at the end of every internal step, and located by bisection of
that step's interpolant.
"""

import enum
import functools
import math
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.grid import Grid
from hjbjax.problem import Problem
from hjbjax.pytree import as_partial, cast, is_traced, node
from hjbjax.sets import Ball, Box


class PathStatus(enum.IntEnum):
    """Why a path ends."""

    DURATION = 0
    TARGET = 1
    LEFT_BOX = 2
    MAX_STEPS = 3
    NONFINITE = 4


_SAYINGS = {
    PathStatus.DURATION: "ran for the whole duration",
    PathStatus.TARGET: "reached the target",
    PathStatus.LEFT_BOX: "stopped where it left the box of the grid; enlarge the grid, or go on with clamp=True",
    PathStatus.MAX_STEPS: "stopped after max_steps internal steps; give hold=dt, or more max_steps",
    PathStatus.NONFINITE: "stopped because the state is no longer finite; look at drift and feedback there",
}


@node(host=("message",))
class Path:
    """A closed loop's history, truncated where it ends.

    Args:
      times: shape (k+1,), from 0; the last is where the path ends.
      states: shape (k+1, n), periodic states unwound (``grid.wrap`` brings them into the grid).
      controls: shape (k, m), the control at the start of each interval; under ``hold`` all through it.
      disturbances: shape (k, l), likewise, or None where there is no opponent.
      cost: discounted running cost, plus the discounted exit cost if the target was reached; with
        ``running_max`` the maximum of that function over the output times instead.
      reached: the time at which the target was reached, or None.
      code: a PathStatus number.
      steps: internal steps of the integrator, rejected ones included.
      message: one line on how the path ended.
    """

    times: Any
    states: Any
    controls: Any
    disturbances: Any
    cost: Any
    reached: Any
    code: Any
    steps: Any
    message: str = ""

    @property
    def status(self) -> PathStatus:
        """Why the path ends."""
        return PathStatus(int(self.code))

    def __str__(self) -> str:
        return self.message


def simulate(
    problem: Problem,
    feedback: Any,
    x0: Any,
    duration: float,
    *,
    steps: int | None = None,
    disturbance: Callable | None = None,
    key: Any = None,
    hold: Any = False,
    grid: Grid | None = None,
    clamp: bool = False,
    rtol: float = 1e-6,
    atol: float = 1e-8,
    max_step: float | None = None,
    max_steps: int = 100_000,
) -> Path:
    """The path of the closed loop from ``x0``, in float64.

    Callables take ``(x)``; they take ``(t, x)`` exactly when ``problem.time_dependent``. Periodic states are
    wrapped into the grid before anything sees them. Called again with the same functions and shapes, it does
    not compile again, whatever the numbers.

    Args:
      problem: the system and its costs.
      feedback: a Solution, or a function that returns the control, shape (m,). ``None`` if there is no control.
      x0: the state at time 0, shape (n,).
      duration: how long to run unless the target is reached before, in units of time.

    Keyword Args:
      steps: number of output intervals; ``None`` is 200, or the sampling intervals under ``hold``.
      disturbance: a function that returns the opponent's d, shape (l,). ``None``: the Solution's own worst case.
      key: a JAX random key or an integer; wanted exactly when the problem has noise.
      hold: the sampling interval of a zero-order hold of the control, in units of time; ``False`` for none.
      grid: the box to stay in, for a feedback that is a function; a Solution brings its own.
      clamp: outside the box, ``False`` ends the path at the edge; ``True`` goes on with what the feedback says at
        the nearest point of the box.
      rtol: relative error of an internal step.
      atol: absolute error of an internal step, in the units of the state and of the cost.
      max_step: the longest internal step. ``None``: one output interval; a tenth of it with noise. A target
        that the path crosses in less time than this may be missed.
      max_steps: no internal step is shorter than 2·duration/max_steps, and no more are made.

    Returns:
      A Path. One that ends early, except in the target, warns and says so in its ``status`` and ``message``.

    Raises:
      ValueError: an argument that is not admissible, or a function that returns the wrong shape.
      TypeError: a feedback or a disturbance that cannot be called.

    Example:
      >>> import jax.numpy as jnp
      >>> from hjbjax import Box, Problem
      >>> problem = Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, Box([-9.0], [9.0]))
      >>> path = simulate(problem, lambda x: -x, [1.0], 20.0)
      >>> round(float(path.cost), 6), path.status.name
      (1.0, 'DURATION')
    """
    if is_traced(problem, x0, duration, key, grid) or (hasattr(feedback, "control_at") and is_traced(feedback)):
        raise ValueError("simulate: got traced values; inside jit, vmap or grad use hjbjax.simulation.rollout")
    grid = _box(feedback, grid)
    x0 = _initial(x0, grid)
    _positive(duration=duration, rtol=rtol, atol=atol, **({} if max_step is None else {"max_step": max_step}))
    times = _times(float(duration), steps, hold)
    _count(max_steps, "max_steps")
    if isinstance(key, (int, np.integer)) and not isinstance(key, bool):
        key = jax.random.key(key)
    _check_key(problem, key)
    # Its import adds to JAX's configuration, which is part of the key of every compiled function: once before, or
    # the second call compiles again.
    import diffrax  # noqa: F401

    with jax.enable_x64(True):
        problem, grid = cast((problem, grid), np.float64)
        control, opponent = cast(_players(problem, feedback, disturbance), np.float64)
        loop = _Loop(problem, control, opponent, grid, bool(clamp))
        _probe(loop, x0)
        if grid is not None and not clamp and not bool(loop.margin(x0) > 0):
            raise ValueError(
                f"simulate: x0 = {x0.tolist()} lies outside the box from {np.asarray(grid.lo).tolist()} to "
                f"{np.asarray(grid.hi).tolist()}, where the feedback is not known; start inside, or give clamp=True"
            )
        step = np.inf if max_step is None else float(max_step)
        held = hold is not False and hold is not None
        path, active = _compiled(loop, x0, times, key, float(rtol), float(atol), step, held, int(max_steps))
        path, active, grid, controls = jax.tree.map(np.asarray, (path, active, grid, problem.controls))
    return _report(path, int(np.sum(active)), controls, grid, problem.noise is None, int(max_steps))


def rollout(
    problem: Problem,
    feedback: Any,
    x0: Any,
    times: Any,
    *,
    disturbance: Callable | None = None,
    key: Any = None,
    hold: bool = False,
    grid: Grid | None = None,
    clamp: bool = False,
    rtol: float = 1e-6,
    atol: float = 1e-8,
    max_step: Any = np.inf,
    max_steps: int = 100_000,
) -> Path:
    """``simulate`` as a pure function, for ``jit``, ``vmap`` (over keys, starts, parameters) and forward derivatives.

    Follows the dtype of ``x0`` and checks no values. The arrays have full length: after the end of the path
    times and states repeat the last one, controls are NaN, and ``reached`` is inf if the target was not.

    Args:
      problem: the system and its costs.
      feedback: as in ``simulate``.
      x0: the state at the first time, shape (n,), floating point.
      times: output times, shape (k+1,), increasing; the first is where discounting starts.

    Keyword Args:
      hold: whether the control is held from one output time to the next. The others are those of ``simulate``.

    Example:
      >>> import jax
      >>> from hjbjax import Problem
      >>> walk = Problem(lambda x, u: 0 * x, noise=1.0)
      >>> keys = jax.random.split(jax.random.key(0), 4)
      >>> jax.vmap(lambda key: rollout(walk, None, jnp.zeros(1), jnp.linspace(0, 1, 3), key=key))(keys).states.shape
      (4, 3, 1)
    """
    x0 = jnp.asarray(x0)
    if not jnp.issubdtype(x0.dtype, jnp.floating):
        raise ValueError(f"rollout: x0 has dtype {x0.dtype}, wanted floating point: the path follows it")
    _check_key(problem, key)
    loop = _Loop(problem, *_players(problem, feedback, disturbance), _box(feedback, grid), bool(clamp))
    _probe(loop, x0)
    return _integrate(loop, x0, jnp.asarray(times, x0.dtype), key, rtol, atol, max_step, hold, max_steps)[0]


@node(static=("clamp",))
class _Loop:
    """The closed loop as functions of (t, x)."""

    problem: Problem
    control: Any
    opponent: Any
    grid: Any
    clamp: bool

    def wrap(self, x):
        return x if self.grid is None else self.grid.wrap(x)

    def seen(self, x):
        """The state as a feedback sees it: in the box."""
        if self.grid is None:
            return x
        x, free = self.grid.wrap(x), np.array(self.grid.periodic)
        inside = jnp.clip(x, jnp.asarray(self.grid.lo, x.dtype), jnp.asarray(self.grid.hi, x.dtype))
        return jnp.where(free, x, inside)

    def u(self, t, x):
        if self.control is None:
            return jnp.zeros(0, x.dtype)
        return jnp.asarray(self.control(*self.problem.state_arguments(self.seen(x), t)), x.dtype)

    def d(self, t, x):
        if self.opponent is None:
            return None
        return jnp.asarray(self.opponent(*self.problem.state_arguments(self.seen(x), t)), x.dtype)

    def rate(self, t, x, u, discounted):
        """Drift, and discounted running cost, as one array of shape (n+1,)."""
        arguments = self.problem.arguments(self.wrap(x), u, self.d(t, x), t)
        cost = 0.0 if self.problem.cost is None else self.problem.cost(*arguments)
        drift = jnp.asarray(self.problem.drift(*arguments), x.dtype)
        return jnp.append(drift, jnp.asarray(discounted * cost, x.dtype))

    def noise(self, t, x, u):
        """σ with a zero row for the cost, shape (n+1, k)."""
        sigma = self.problem.diffusion(self.wrap(x), u, self.d(t, x), t).astype(x.dtype)
        return jnp.pad(sigma, ((0, 1), (0, 0)))

    def target(self, t, x):
        """≤ 0 inside the target."""
        if self.problem.target is None:
            return jnp.asarray(jnp.inf, x.dtype)
        return jnp.asarray(self.problem.target(*self.problem.state_arguments(self.wrap(x), t)), x.dtype)

    def margin(self, x):
        """The distance to the edge of the box over its width, ≤ 0 outside; inf where the path may go anywhere."""
        if self.grid is None or self.clamp:
            return jnp.asarray(jnp.inf, x.dtype)
        x = jnp.asarray(x)
        lo, hi = jnp.asarray(self.grid.lo, x.dtype), jnp.asarray(self.grid.hi, x.dtype)
        inside = jnp.minimum(x - lo, hi - x) / (hi - lo)
        # A path may rest on the edge, where rounding must not push it out.
        slack = 64 * jnp.finfo(x.dtype).eps
        return jnp.min(jnp.where(np.array(self.grid.periodic), jnp.inf, inside)) + slack

    def number(self, value, t, x):
        """A number or a function of the state, as a number."""
        if callable(value):
            value = value(*self.problem.state_arguments(self.wrap(x), t))
        return jnp.asarray(0.0 if value is None else value, x.dtype)


def _integrate(loop, x0, times, key, rtol, atol, max_step, held, max_steps):
    """One diffrax solve an output interval, all in one scan; a path that has ended gets intervals of length zero."""
    beta = jnp.asarray(loop.problem.discount, x0.dtype)
    start, duration = times[0], times[-1] - times[0]
    # Below its tolerance the tree interpolates, which is not Brownian: keep that far below a step (of 1/10 interval
    # or less), but one for the whole run, so that neighbouring intervals agree on w, and at most 30 levels deep.
    fine = jnp.maximum(jnp.minimum(jnp.min(jnp.diff(times)) / 10, max_step) / 64, duration / 2**30)

    def status(t, x):
        code = jnp.where(loop.margin(x) > 0, PathStatus.DURATION, PathStatus.LEFT_BOX)
        return jnp.where(loop.target(t, x) <= 0, PathStatus.TARGET, code).astype(jnp.int32)

    def interval(state, end):
        t, y, code, count = state
        active = code == PathStatus.DURATION
        u, d = loop.u(t, y[:-1]), loop.d(t, y[:-1])
        act = (lambda s, x: u) if held else loop.u

        def rate(s, y, args):
            return loop.rate(s, y[:-1], act(s, y[:-1]), jnp.exp(-beta * (s - start)))

        def noise(s, y, args):
            return loop.noise(s, y[:-1], act(s, y[:-1]))

        end = jnp.where(active, end, t)
        settings = (key, rtol, atol, max_step, max_steps, start, duration, fine)
        last, y, result, made = _advance(loop, rate, noise, t, end, y, settings)
        lost = result == PathStatus.NONFINITE  # then the path ends at the last output time before
        last, y, active = jnp.where(lost, t, last), jnp.where(lost, state[1], y), active & ~lost
        code, count = jnp.where(state[2] == PathStatus.DURATION, result, code), count + made
        code = jnp.where((code == PathStatus.DURATION) & (count >= max_steps), PathStatus.MAX_STEPS, code)
        t = jnp.where(active, last, t)
        shown = jax.tree.map(lambda a: jnp.where(active, a, jnp.nan), (u, d))
        return (t, y, code.astype(jnp.int32), count), (t, y[:-1], *shown, active)

    first = (start, jnp.append(x0, 0.0), status(start, x0), jnp.zeros((), jnp.int32))
    (t, y, code, count), (later, states, controls, disturbances, active) = jax.lax.scan(interval, first, times[1:])
    hit, x = code == PathStatus.TARGET, y[:-1]
    states = jnp.concatenate([x0[None], states])
    times = jnp.append(start, later)
    cost = y[-1] + jnp.where(hit, jnp.exp(-beta * (t - start)) * loop.number(loop.problem.exit_cost, t, x), 0)
    if loop.problem.running_max is not None:
        cost = jnp.max(jax.vmap(lambda t, x: loop.number(loop.problem.running_max, t, x))(times, states))
    return Path(times, states, controls, disturbances, cost, jnp.where(hit, t, jnp.inf), code, count), active


def _advance(loop, rate, noise, t, end, y, settings):
    """From ``t`` to ``end``, or to the target or the edge if they come first: (time, y, code, steps)."""
    import diffrax

    key, rtol, atol, max_step, max_steps, start, duration, fine = settings
    width = jnp.where(end > t, end - t, duration)  # of an ended path: any positive number
    terms: Any = diffrax.ODETerm(rate)
    solver: Any = diffrax.Tsit5()
    controller: Any = diffrax.ConstantStepSize()
    if loop.problem.noise is None:
        longest = jnp.minimum(width, max_step)
        shortest = 2 * duration / max_steps
        controller = diffrax.PIDController(rtol=rtol, atol=atol, dtmin=shortest, dtmax=longest, force_dtmin=True)
    else:
        longest = width / jnp.ceil(jnp.maximum(width / max_step, 10) - 1e-6)
        additive = not callable(loop.problem.noise)
        area = diffrax.SpaceTimeLevyArea if additive else diffrax.BrownianIncrement
        sources = jax.eval_shape(noise, t, y, None).shape[1]
        path = diffrax.VirtualBrownianTree(
            start, start + duration, fine, jax.ShapeDtypeStruct((sources,), y.dtype), key, levy_area=area
        )
        terms = diffrax.MultiTerm(terms, diffrax.ControlTerm(noise, path))
        solver = diffrax.SRA1() if additive else diffrax.Euler()

    def margin(t, y, args, **kwargs):
        return jnp.minimum(loop.target(t, y[:-1]), loop.margin(y[:-1]))

    close = 4 * jnp.finfo(y.dtype).eps
    # flip=True: the function falls through zero. "detect" would put a host callback into the compiled run.
    event = diffrax.Event(margin, _bisection()(close, close, flip=True), direction=False)
    watched = loop.problem.target is not None or (loop.grid is not None and not loop.clamp)
    solved = diffrax.diffeqsolve(
        terms, solver, t, end, longest, y,
        saveat=diffrax.SaveAt(t1=True), stepsize_controller=controller,
        event=event if watched else None,  # an event costs half the compile time

        adjoint=diffrax.ForwardMode(), max_steps=max_steps, throw=False,
    )  # fmt: skip
    last, y = solved.ts[0], solved.ys[0]
    x = y[:-1]
    stopped = diffrax.is_event(solved.result)
    ended = jnp.where(loop.target(last, x) <= loop.margin(x), PathStatus.TARGET, PathStatus.LEFT_BOX)
    code = jnp.where(stopped, ended, PathStatus.DURATION)
    code = jnp.where(stopped | diffrax.is_successful(solved.result), code, PathStatus.MAX_STEPS)
    code = jnp.where(jnp.all(jnp.isfinite(y)), code, PathStatus.NONFINITE)
    return last, y, code, solved.stats["num_steps"].astype(jnp.int32)


@functools.cache
def _bisection() -> Any:
    """optimistix's bisection, stopped by the width of its bracket alone: a target function may be steep, or jump."""
    import optimistix

    class Bisection(optimistix.Bisection):
        def terminate(self, fn, y, args, options, state, tags):
            narrow = jnp.abs(state.lower - state.upper) < self.atol + self.rtol * jnp.abs(y)
            return narrow, optimistix.RESULTS.successful

    return Bisection


_compiled = jax.jit(_integrate, static_argnums=(7, 8))


def _players(problem: Problem, feedback: Any, disturbance: Any) -> tuple[Any, Any]:
    """Feedback and disturbance as pytrees that can be called with the problem's state arguments."""
    if getattr(feedback, "times", None) is not None:
        raise ValueError(
            "simulate: the solution was marched over times, and simulate closes loops with stationary solutions; "
            "give the feedback as a function (t, x) of a problem with time_dependent=True"
        )
    if not problem.is_game and disturbance is not None:
        raise ValueError(
            "simulate: got a disturbance, but problem.disturbances is None; give the problem an admissible set"
        )
    opponent = disturbance
    if problem.disturbances is not None and disturbance is None:
        if getattr(feedback, "disturbance", None) is None or not hasattr(feedback, "disturbance_at"):
            raise ValueError(
                "simulate: the problem has disturbances, and only a Solution of it knows the worst case; "
                f"give disturbance=, a function {_signature(problem)} that returns shape ({problem.disturbances.dim},)"
            )
        opponent = jax.tree_util.Partial(_from_solution, as_partial(feedback.disturbance_at))
    control = feedback
    if hasattr(feedback, "control_at"):
        control = jax.tree_util.Partial(_from_solution, as_partial(feedback.control_at))
    for name, function in (("feedback", control), ("disturbance", opponent)):
        none_wanted = problem.controls is None if name == "feedback" else not problem.is_game
        if not callable(function) and not (function is None and none_wanted):
            raise TypeError(f"simulate: {name} is {function!r}, wanted a Solution or a function {_signature(problem)}")
    return (None if problem.controls is None else as_partial(control)), as_partial(opponent)


def _from_solution(look_up: Callable, *arguments: Any) -> Any:
    """A stationary solution's answer; the state comes clamped, and must not be refused for a rounding."""
    return look_up(arguments[-1], clamp=True)


def _signature(problem: Problem) -> str:
    return "(t, x)" if problem.time_dependent else "(x)"


def _box(feedback: Any, grid: Any) -> Any:
    """The grid given, or the Solution's own."""
    own = getattr(feedback, "grid", None) if hasattr(feedback, "control_at") else None
    if grid is not None and not isinstance(grid, Grid):
        raise TypeError(f"simulate: grid is {grid!r}, wanted a Grid or None")
    if grid is not None and own is not None and grid is not own:
        raise ValueError("simulate: the solution brings its own grid; leave out grid=")
    return own if grid is None else grid


def _initial(x0: Any, grid: Grid | None) -> np.ndarray:
    try:
        state = np.asarray(x0, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"simulate: x0 is {x0!r}, wanted one number a state") from None
    if state.ndim != 1 or state.size == 0 or (grid is not None and state.size != grid.ndim):
        wanted = "(n,)" if grid is None else f"({grid.ndim},)"
        raise ValueError(f"simulate: x0 has shape {state.shape}, wanted {wanted}: one number a state")
    if not np.all(np.isfinite(state)):
        raise ValueError(f"simulate: x0 is {state.tolist()}, wanted finite numbers")
    return state


def _times(duration: float, steps: Any, hold: Any) -> np.ndarray:
    """The output times; under a hold, the sampling instants."""
    if hold is False or hold is None:
        count = 200 if steps is None else steps
        _count(count, "steps")
        return np.linspace(0.0, duration, int(count) + 1)
    if isinstance(hold, bool):
        raise ValueError("simulate: hold is True, wanted the sampling interval, as in hold=0.05")
    _positive(hold=hold)
    if steps is not None:
        raise ValueError(f"simulate: got steps = {steps} and hold = {hold}; leave out steps: the output is every hold")
    count = max(1, duration / float(hold) - 1e-9)
    if count > 10**7:
        raise ValueError(
            f"simulate: hold = {hold} makes {count:.3g} intervals of duration {duration:g}, wanted at most 1e7"
        )
    return np.append(np.arange(math.ceil(count)) * float(hold), duration)


def _positive(**numbers: Any) -> None:
    for name, value in numbers.items():
        if isinstance(value, (bool, str)) or np.ndim(value) or not (np.isfinite(value) and value > 0):
            raise ValueError(f"simulate: {name} is {value!r}, wanted a finite number > 0")


def _count(value: Any, name: str) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"simulate: {name} is {value!r}, wanted a positive integer")


def _check_key(problem: Problem, key: Any) -> None:
    if problem.noise is not None and key is None:
        raise ValueError("simulate: the problem has noise; give key=jax.random.key(0), or any other seed")
    if problem.noise is None and key is not None:
        raise ValueError("simulate: got a key, but problem.noise is None and nothing is random; leave out key")


def _probe(loop: _Loop, x0: Any) -> None:
    """Trace every function of the loop once, abstractly, and compare the shapes it returns with those wanted."""
    problem, n = loop.problem, x0.shape[0]
    t, sets = x0[0], (problem.controls, problem.disturbances)
    m, opponents = (0 if choices is None else choices.dim for choices in sets)
    u, d = jnp.zeros(m, x0.dtype), jnp.zeros(opponents, x0.dtype) if problem.is_game else None
    players, state = problem.state_arguments(x0, t), problem.arguments(x0, u, d, t)
    for name, function, arguments, wanted in (
        ("feedback", loop.control, players, (m,)),
        ("disturbance", loop.opponent, players, (opponents,)),
        ("drift", problem.drift, state, (n,)),
        ("cost", problem.cost, state, ()),
        ("target", problem.target, players, ()),
    ):
        if function is None:
            continue
        try:
            found = jax.eval_shape(lambda *a, function=function: jnp.asarray(function(*a)), *arguments)
        except jax.errors.JAXTypeError as error:
            raise ValueError(
                f"simulate: {name} cannot be traced: use jnp.where instead of if, and jnp instead of numpy"
            ) from error
        if found.shape != wanted:
            raise ValueError(
                f"simulate: {name} returned shape {found.shape}, expected {wanted}, for x0 of shape {x0.shape}"
            )


def _report(path: Path, count: int, admissible: Any, grid: Any, adaptive: bool, max_steps: int) -> Path:
    """The path cut where it ends, with its line; a path that ends early outside the target warns."""
    status, ended = path.status, float(path.times[count])
    said = [
        f"{_SAYINGS[status]} at t = {ended:.6g}",
        f"cost {float(path.cost):.6g}",
        f"{int(path.steps)} internal steps",
    ]
    states, controls = path.states[: count + 1], path.controls[:count]
    if grid is not None:
        outside = np.any(((states < grid.lo) | (states > grid.hi)) & ~np.array(grid.periodic), axis=-1)
        if status != PathStatus.LEFT_BOX and outside.any():
            said.append(
                f"left the box at t = {path.times[np.argmax(outside)]:.6g}: controls there are the nearest point's"
            )
    if adaptive and path.steps > max(1000, max_steps / 8):
        said.append("the feedback jumps or the loop is stiff: hold=dt is faster")
    if _inadmissible(admissible, controls):
        said.append("controls outside the problem's admissible set were applied as they are")
    if status not in (PathStatus.DURATION, PathStatus.TARGET):
        warnings.warn(f"simulate: the path {said[0]}", UserWarning, stacklevel=3)
    return Path(
        times=path.times[: count + 1],
        states=states,
        controls=controls,
        disturbances=None if path.disturbances is None else path.disturbances[:count],
        cost=float(path.cost),
        reached=float(path.reached) if status == PathStatus.TARGET else None,
        code=int(path.code),
        steps=int(path.steps),
        message="; ".join(said),
    )


def _inadmissible(controls: Any, applied: np.ndarray) -> bool:
    if isinstance(controls, Box):
        slack = 1e-9 * (1 + np.abs(controls.lo) + np.abs(controls.hi))
        return bool(np.any((applied < controls.lo - slack) | (applied > controls.hi + slack)))
    return isinstance(controls, Ball) and bool(np.any(np.linalg.norm(applied, axis=-1) > controls.radius * (1 + 1e-9)))
