"""Simulation: ``simulate`` with checks and a report, and ``rollout``, its integration as a pure function."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.posing import over_checked_modes
from hjbjax.feedback.closed_loop import InitialValueProblem, Stepping, blank_record, integrate, integrate_part
from hjbjax.feedback.discounting import with_integral, without_integral
from hjbjax.feedback.feedback import ROUNDING, GridFeedback, check_kept, is_grid_feedback, lookups, without_grid
from hjbjax.feedback.loop import Loop, check_shapes, noise_key, settled_loop, timeless
from hjbjax.feedback.path import Interrupted, Path, PathStatus, truncate
from hjbjax.feedback.payments import broken_promise, promise, surplus, value_at_horizon
from hjbjax.feedback.pushing import push_table
from hjbjax.feedback.sudden_changes import (
    grid_of_modes,
    switching_surplus,
    with_clock,
    with_first_mode,
    with_modes_apart,
    without_clock,
)
from hjbjax.problem import arguments
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST
from hjbjax.problem.mode_axis import of_mode, without_modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, cast, front_door, is_traced
from hjbjax.problem.rewards import costs_of
from hjbjax.problem.settings import own_settings
from hjbjax.problem.state_bounds import with_any_control
from hjbjax.problem.types import Key, Number, Numbers
from hjbjax.solution.clock import CHUNK_SECONDS, Clock, noting_interrupts
from hjbjax.solution.status import warn
from hjbjax.tracing.closures import OF_ACTION, OF_STATE, RATES, holds_tracers, opened, settled

Feedback: TypeAlias = GridFeedback | Callable | None  # None where there is no control

INTERVALS = 200  # output intervals, by default
MOST_INTERVALS = 10**7  # 80 MB per state

_jit_part = jax.jit(integrate_part, donate_argnames="so_far")  # overwrites the rows of all intervals in place


@front_door
def simulate(
    problem: Problem,
    feedback: Feedback,
    x0: Numbers | Sequence[float],
    duration: float,
    *,
    mode: str | int | None = None,
    steps: int | None = None,
    disturbance: Callable | None = None,
    time_varying: bool = False,
    key: Key | int | None = None,
    hold: float | None = False,
    grid: Grid | None = None,
    clamp: bool = False,
    rtol: float = 1e-6,
    atol: float = 1e-8,
    max_step: float | None = None,
    max_steps: int = 100_000,
) -> Path:
    """The path of the closed loop from ``x0``, in float64; inside ``jit``, ``vmap`` and ``grad`` it is a ``rollout``.

    Callables take ``(x)``, or ``(t, x)`` if ``problem.time_dependent``; feedback and disturbance also take ``(t, x)``
    if ``time_varying``. Periodic states are wrapped into the grid before they are passed to any function. Another call
    with the same functions and shapes does not compile again, for any numbers.

    Args:
      problem: the system and its costs or rewards.
      feedback: a Solution, a ``greedy_feedback``, a solution without a grid, as of ``hopf`` and ``neural``, or a
        function that returns the control, shape (m,). ``None`` if there is no control. With a Solution of a problem
        with a stopping cost, the path ends and pays ψ where stopping is optimal, that is where V = ψ at all surrounding
        nodes. Without a running cost, pushes, changes of the mode by choice, and noise it continues, and its cost is
        the cost of the best moment to stop. A marched Solution must be stored at enough times: at least ten over the
        duration. A path as long as the horizon pays at its end what ``march`` assumed there: ``start``, the terminal
        cost, else ψ, else g. If the feedback is a function, the terminal cost is paid at the end. With pushes it must
        be a Solution, which knows where they are optimal. A path that starts in the push region jumps to its boundary
        at once, after the first entry of ``states``. Later it is moved back to the boundary after every internal step.
        The steps have equal lengths, as with noise: the law of the path has order ½ in the step, and the mean cost has
        order 1.
      x0: the state at time 0, shape (n,).
      duration: the length of the path unless it reaches the target earlier, in units of time.

    Keyword Args:
      mode: the mode at time 0, its name or its number, if and only if the problem has modes. Functions then take the
        number of the mode last. The mode changes at random at the rates of the problem, and a Solution changes it where
        that is optimal.
      steps: number of output intervals; ``None`` is 200, or the sampling intervals under ``hold``.
      disturbance: a function that returns the opponent's d, shape (l,). Default: the worst case of the Solution.
      time_varying: True if feedback and disturbance take ``(t, x)`` although the problem does not depend on time.
      key: a JAX random key or an integer; required if and only if the problem has noise, or random changes of the mode.
      hold: the sampling interval of a zero-order hold of the control, in units of time; ``False`` for none.
      grid: the box of a feedback that is a function; a Solution has its own grid.
      clamp: outside the box, ``False`` ends the path at the boundary; ``True`` continues with the feedback at the
        nearest point of the box.
      rtol: relative error of an internal step.
      atol: absolute error of an internal step, in the units of the state and of the cost.
      max_step: the longest internal step. Default: one output interval, or a tenth of it with noise. The path may
        miss a target that it crosses in less time than this. With noise a target can also be met between the ends of a
        step, by a draw of the Brownian bridge: mean times have order 1 in this step.
      max_steps: the largest number of internal steps; none is shorter than 2·duration/max_steps.

    Returns:
      A Path, with ``.cost``, and ``.reward`` for a problem with rewards. If it ends early, except in the target, it
      warns, and ``status`` and ``message`` say why. It also warns if its cost or reward differs from V by many times
      the estimated error.

    Raises:
      ValueError: an argument that is not admissible, or a function that returns the wrong shape.
      TypeError: a feedback or a disturbance that cannot be called.
      KeyboardInterrupt: Ctrl-C; once the path has begun, ``.path`` is the Path so far.

    Example:
      >>> from hjbjax import Box, Problem
      >>> problem = Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, Box([-9.0], [9.0]))
      >>> path = simulate(problem, lambda x: -x, [1.0], 20.0)
      >>> round(float(path.cost), 6), path.status.name
      (1.0, 'DURATION')
    """
    if is_traced(duration, hold):
        raise ValueError(
            "simulate: duration and hold set the output times and must be known numbers, not traced ones; "
            "hjbjax.feedback.simulation.rollout takes traced times"
        )
    if not isinstance(problem, Problem):
        raise TypeError(f"simulate: got {type(problem).__name__}, wanted a Problem, and then its feedback")
    feedback, time_varying = without_grid(feedback, time_varying)
    problem, modes = costs_of(problem), problem.modes
    duration = float(arguments.positive(duration, "simulate: duration", "in units of time"))
    due = _due(feedback, duration)
    if _is_traced(problem, feedback, disturbance, x0, key, grid, rtol, atol, max_step):
        options: Any = {
            "disturbance": disturbance, "time_varying": time_varying, "grid": grid, "clamp": clamp, "mode": mode,
        }  # fmt: skip
        times, held = _times(duration, steps, None if hold is False else hold), hold is not None and hold is not False
        return rollout(
            problem, feedback, jnp.asarray(x0, jnp.result_type(float)), times, key=noise_key(problem, key), hold=held,
            rtol=rtol, atol=atol, max_step=max_step, max_steps=max_steps, due=due, **options,
        )  # fmt: skip
    hold = None if hold is False else hold
    times = _times(duration, steps, hold)
    stepping = _stepping(rtol, atol, max_step, max_steps, held=hold is not None)
    # importing diffrax changes JAX's configuration, which is part of the key of every compiled function; do it before
    # the first compilation, otherwise the second call compiles again
    import diffrax  # noqa: F401

    clock = Clock()
    with noting_interrupts(clock), own_settings(x64=True):
        problem, feedback, disturbance, grid = _over_modes(problem, feedback, disturbance, grid, np.size(x0))
        key = noise_key(problem, key)
        loop = _close(problem, feedback, disturbance, grid, clamp, time_varying, due)
        start = _initial_state(with_first_mode(modes, x0, mode, "simulate"), loop.grid)
        loop = dataclasses.replace(loop, problem=with_any_control(problem, start.size))
        loop = settled_loop(loop, start.size, {"control": feedback, "opponent": disturbance})
        loop = cast(loop, np.float64)  # a float32 solution also closes the loop in float64, like the integration
        check_shapes(loop, start)
        _check_start(loop, start)
        count = 0 if modes is None else len(modes.names)
        begun = InitialValueProblem(*with_integral(*with_clock(loop, start, key, count)), times, key)
        path, active = _in_chunks(begun, stepping, clock)
        path, active, grid, controls = jax.tree.map(np.asarray, (path, active, loop.grid, loop.problem.controls))
        path, weights = without_integral(path, problem)
        path = without_clock(path, problem, count)
        path = dataclasses.replace(path, promised=_promised(problem, feedback, start), payoff=problem.payoff)
        path = truncate(path, int(np.sum(active)), max_steps, grid, controls, problem.noise is not None)
        broken = broken_promise(
            problem, feedback, path, float(weights[len(path.times) - 1]),
            to_horizon=due == "V at the horizon", worst_case=disturbance is None,
        )  # fmt: skip
        path = with_modes_apart(path, count)
        if broken is not None:
            warn(f"simulate: {broken}")
        if clock.interrupted:
            raise Interrupted(path)
    return path


_margin = jax.jit(Loop.margin)


def _stepping(rtol: Number, atol: Number, max_step: Number | None, max_steps: int, *, held: bool) -> Stepping:
    """The tolerances and limits of the steps, after checks."""
    return Stepping(
        rtol=float(arguments.positive(rtol, "simulate: rtol")),
        atol=float(arguments.positive(atol, "simulate: atol")),
        max_step=np.inf if max_step is None else float(arguments.positive(max_step, "simulate: max_step")),
        max_steps=arguments.count(max_steps, "simulate: max_steps"),
        held=held,
    )


def _check_start(loop: Loop, start: np.ndarray) -> None:
    """Refuse a start outside the box in which the feedback is known."""
    if loop.grid is None or _margin(loop, start) > 0:
        return
    grid = without_modes(loop.grid)
    lo, hi = np.asarray(grid.lo).tolist(), np.asarray(grid.hi).tolist()
    raise ValueError(
        f"simulate: x0 = {start[-grid.ndim :].tolist()} is outside the box from {lo} to {hi}, where the feedback is "
        "not known; start inside, or pass clamp=True"
    )


def _is_traced(problem: Problem, *others: Any) -> bool:
    """True if some number is a tracer, including the numbers that functions close over."""
    names = (*OF_ACTION, *OF_STATE, *RATES)
    tables = [] if problem.modes is None else [problem.modes.rates, problem.modes.switching_cost]
    functions = [getattr(problem, name) for name in names]
    paid = [each for push in problem.pushes for each in (push.cost, push.reward)]
    functions += [each for each in (*tables, *paid, *others) if callable(each)]
    return is_traced(problem, *others) or any(map(holds_tracers, functions))


def _in_chunks(ivp: InitialValueProblem, stepping: Stepping, clock: Clock) -> tuple[Path, jax.Array]:
    """The path, computed in chunks of output intervals of about half a second, until it ends or Ctrl-C is pressed."""
    so_far = blank_record(ivp.loop, np.asarray(ivp.x0), np.asarray(ivp.times))
    count, done, chunk = len(ivp.times) - 1, 0, 1
    if clock.interrupted:
        raise KeyboardInterrupt("simulate: interrupted before the path began")
    so_far, answer = _jit_part(ivp, stepping, so_far, 0, 0)  # no interval: compile before the first timing
    ending = PathStatus.INTERRUPTED  # the status of a path with intervals left
    while ending is PathStatus.INTERRUPTED and done < count and not clock.interrupted:
        began, until = clock.elapsed(), min(done + chunk, count)
        so_far, answer = _jit_part(ivp, stepping, so_far, done, until)
        ending = PathStatus(int(answer[0].code))
        pace = max(clock.elapsed() - began, 1e-4) / (until - done)  # seconds per interval; the clock may be coarse
        # at most eight times the previous number, because the next intervals may be slower than a quick one
        chunk = int(np.clip(CHUNK_SECONDS / pace, 1, 8 * chunk))
        done = until
    return answer


def rollout(
    problem: Problem,
    feedback: Feedback,
    x0: Numbers | Sequence[float],
    times: Numbers | Sequence[float],
    *,
    mode: str | int | None = None,
    disturbance: Callable | None = None,
    time_varying: bool = False,
    key: Key | None = None,
    hold: bool = False,
    grid: Grid | None = None,
    clamp: bool = False,
    rtol: Number = 1e-6,
    atol: Number = 1e-8,
    max_step: Number | None = None,
    max_steps: int = 100_000,
    due: str | None = None,
) -> Path:
    """``simulate`` as a pure function, for ``jit``, ``vmap`` (over keys, starts, parameters), ``grad`` and ``jvp``.

    Follows the dtype of ``x0`` and does not check values. The arrays have full length: after the end of the path
    times and states repeat the last entry, controls are NaN, and ``reached`` is inf if the target was not reached.

    Args:
      problem: the system and its costs.
      feedback: as in ``simulate``.
      x0: the state at the first time, shape (n,), floating point.
      times: output times, shape (k+1,), increasing; discounting starts at the first.

    Keyword Args:
      mode: as in ``simulate``.
      disturbance: as in ``simulate``, like ``time_varying``.
      key: a JAX random key; required if and only if the problem has noise, or random changes of the mode.
      hold: True if the control is held from one output time to the next.
      grid: as in ``simulate``, like ``clamp``, ``rtol``, ``atol``, ``max_step`` and ``max_steps``.
      due: the payment after the last time: "terminal cost", "V at the horizon" of a march, or "nothing". Default: the
        terminal cost for a function, V at the horizon for a marched feedback, nothing for a stationary one.

    Returns:
      A Path of JAX arrays without a message.

    Raises:
      ValueError: a state of integers, or a function that returns the wrong shape.
      TypeError: a feedback or a disturbance that cannot be called.

    Example:
      >>> import jax
      >>> from hjbjax import Problem
      >>> walk = Problem(lambda x, u: 0 * x, noise=1.0)
      >>> keys = jax.random.split(jax.random.key(0), 4)
      >>> jax.vmap(lambda key: rollout(walk, None, jnp.zeros(1), jnp.linspace(0, 1, 3), key=key))(keys).states.shape
      (4, 3, 1)
    """
    feedback, time_varying = without_grid(feedback, time_varying)
    start = jnp.asarray(x0)
    if not jnp.issubdtype(start.dtype, jnp.floating):
        raise ValueError(f"rollout: x0 has dtype {start.dtype}, wanted floating point: the path follows it")
    key = noise_key(problem, key)
    # numbers that functions close over become leaves, because derivative rules only cover leaves
    modes = problem.modes
    problem, feedback, disturbance, grid = _over_modes(costs_of(problem), feedback, disturbance, grid, start.size)
    start = jnp.asarray(with_first_mode(modes, start, mode, "rollout"))
    problem = settled(with_any_control(problem, start.size), start.size, start.dtype)
    if due is None:
        due = "V at the horizon" if _is_marched(feedback) else "terminal cost"
    loop = _close(problem, feedback, disturbance, grid, clamp, time_varying, due)
    moment = [jax.ShapeDtypeStruct(shape, start.dtype) for shape in ((), start.shape)]
    loop = dataclasses.replace(loop, control=opened(loop.control, *moment), opponent=opened(loop.opponent, *moment))
    check_shapes(loop, start)
    stepping = Stepping(rtol, atol, np.inf if max_step is None else max_step, max_steps, hold)
    count = 0 if modes is None else len(modes.names)
    begun = InitialValueProblem(
        *with_integral(*with_clock(loop, start, key, count)), jnp.asarray(times, start.dtype), key
    )
    path, _ = without_integral(integrate(begun, stepping)[0], problem)
    path = with_modes_apart(without_clock(path, problem, count), count)
    return dataclasses.replace(path, payoff=problem.payoff)


def _over_modes(
    problem: Problem, feedback: Feedback, disturbance: Callable | None, grid: Grid | None, n: int
) -> tuple[Problem, Feedback, Callable | None, Grid | None]:
    """The arguments for states that begin with the mode, with jumps and pushes as functions, if the problem has any."""
    modes = problem.modes
    if (modes is not None or problem.jumps) and problem.running_max is not None:
        raise ValueError("simulate: got running_max with modes or jumps; the cost of such a path is not computed")
    if modes is None:
        return over_checked_modes(problem, n), feedback, disturbance, grid
    players = (of_mode(player, modes) for player in (feedback, disturbance))
    return over_checked_modes(problem, n), *players, grid_of_modes(grid, modes)


def _close(
    problem: Problem,
    feedback: Feedback,
    disturbance: Callable | None,
    grid: Grid | None,
    clamp: bool,
    time_varying: bool,
    due: str,
) -> Loop:
    """The loop through a Solution, which has its own grid and worst case, or through functions."""
    if disturbance is not None and not problem.is_game:
        raise ValueError(
            "simulate: got a disturbance, but problem.disturbances is None; give the problem an admissible set"
        )
    control, opponent = None if is_grid_feedback(feedback) else feedback, disturbance
    if is_grid_feedback(feedback):
        if grid is not None and grid is not feedback.grid:  # passing the solution's own grid is allowed
            raise ValueError("simulate: the solution has its own grid; leave out grid=")
        grid = feedback.grid
        control, worst = lookups(feedback)
        if problem.is_game and disturbance is None and feedback.disturbance is not None:
            opponent = worst
    if grid is not None and not isinstance(grid, Grid):
        raise TypeError(f"simulate: grid is {grid!r}, wanted a Grid or None")
    if not isinstance(time_varying, bool):
        raise TypeError(f"simulate: time_varying is {time_varying!r}, wanted True or False")
    signature = "(t, x)" if problem.time_dependent or time_varying else "(x)"
    if problem.disturbances is not None and opponent is None:
        raise ValueError(
            "simulate: the problem has disturbances, and only a Solution of it knows the worst case; "
            f"give disturbance=, a function {signature} that returns shape ({problem.disturbances.dim},)"
        )
    for name, function, optional in (("feedback", control, problem.controls is None), ("disturbance", opponent, True)):
        if not callable(function) and not (function is None and optional):
            raise TypeError(f"simulate: {name} is {function!r}, wanted a Solution or a function {signature}")
    if not (problem.time_dependent or time_varying):  # from here on all players take (t, x); lookups already do
        control, opponent = (
            jax.tree_util.Partial(timeless, as_partial(player)) if player is not None and player is given else player
            for player, given in ((control, feedback), (opponent, disturbance))
        )
    control = None if problem.controls is None else as_partial(control)
    return Loop(
        problem, control, as_partial(opponent), grid, bool(clamp), surplus(problem, feedback), due,
        value_at_horizon(feedback) if due == "V at the horizon" else None, switching_surplus(problem, feedback),
        push=push_table(problem, feedback),
    )  # fmt: skip


def _promised(problem: Problem, feedback: Feedback, start: np.ndarray) -> float | None:
    """V at the start in the sign of the problem's payments, if the feedback has a Solution."""
    cost = promise(feedback, start)
    return cost if cost is None or problem.payoff == COST else 0 - cost


def _is_marched(feedback: object) -> TypeGuard[GridFeedback]:
    """True for a feedback that is stored at several times."""
    return is_grid_feedback(feedback) and feedback.times is not None


def _due(feedback: Feedback, duration: float) -> str:
    """The payment at the end of a path: V at the horizon of a march, if the path is as long as the horizon; see
    ``Loop``.

    Raises:
      ValueError: a marched feedback that is not stored at enough times up to the duration.
    """
    if not _is_marched(feedback):
        return "terminal cost"
    horizon = check_kept(feedback, duration, "simulate: duration")
    # V at the horizon is due at the horizon, not at the end of a shorter path
    return "nothing" if duration < horizon * (1 - ROUNDING) else "V at the horizon"


def _initial_state(x0: object, grid: Grid | None) -> np.ndarray:
    """The initial state, shape (n,), float64, after checks."""
    try:
        state = np.asarray(x0, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"simulate: x0 is {x0!r}, wanted one number per state") from None
    if state.ndim != 1 or state.size == 0 or (grid is not None and state.size != grid.ndim):
        wanted = "(n,)" if grid is None else f"({grid.ndim},)"
        raise ValueError(f"simulate: x0 has shape {state.shape}, wanted {wanted}: one number per state")
    if not np.all(np.isfinite(state)):
        raise ValueError(f"simulate: x0 is {state.tolist()}, wanted finite numbers")
    return state


def _times(duration: float, steps: int | None, hold: float | None) -> np.ndarray:
    """The output times, or the sampling times under a hold."""
    if hold is None:
        count = INTERVALS if steps is None else arguments.count(steps, "simulate: steps")
        if count > MOST_INTERVALS:
            raise ValueError(f"simulate: steps = {arguments.shown(steps)}, wanted at most 1e7")
        return np.linspace(0.0, duration, 1 + count)
    hold = float(arguments.positive(hold, "simulate: hold", "the sampling interval in units of time"))
    if steps is not None:
        raise ValueError(f"simulate: got steps = {steps} and hold = {hold}; leave out steps: the output is every hold")
    held = max(1, duration / hold - 1e-9)  # otherwise rounding could add an interval of length zero at the end
    if held > MOST_INTERVALS:  # probably a hold in another unit than the duration
        raise ValueError(f"simulate: hold = {hold} makes {held:.3g} intervals of {duration:g}, wanted at most 1e7")
    return np.append(np.arange(math.ceil(held)) * hold, duration)  # the last interval may be shorter
