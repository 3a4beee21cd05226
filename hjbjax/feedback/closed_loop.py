"""Closed loops and their integration: the path of the system under a feedback, and its cost.

    dx = f(x, u, d) dt + σ(x, u, d) dw,  u = control(x),  d = opponent(x)
    cost = ∫ e^{−βt} L(x, u, d) dt + payment at the end; for a tube an extreme along the path, see ``payments``

The running cost is one more state of the integrator, so it has the accuracy of the path.

Without noise: Tsit5 with adaptive steps, at most one output interval long. A feedback that jumps (bang-bang) makes any
adaptive stepper crawl along its switching curve, so no step is shorter than 2·duration/max_steps. The path then
chatters within f·(that step) of the curve, like a fast sampler. A zero-order hold, as in hardware, is faster there.
With noise: fixed steps in the Itô sense on a virtual Brownian tree. Noise that is a number or a matrix uses SRA1
(strong order 1.5 in a smooth closed loop); noise that is a function uses Euler–Maruyama (strong order ½, weak order 1).
Rejecting steps would bias the law of the path, so ``rtol`` and ``atol`` are ignored.
With pushes the steps are fixed too, without noise those of Euler's method, and the state is pushed after every step,
see ``pushing``.

After every internal step the path is tested for the target, the boundary of the box and the end of the region in which
the players are defined. Bisection of the interpolant locates the crossing, and the path ends just beyond it. A Solution
has no control inside the target, but the stages of the last step need one: they use the control at the last point of
the straight line there at which the players are defined.

With noise a target can also be met between the ends of a step, see ``loop``. The mean time to a target then has order 1
in the step. The boundary of the box is only tested at the ends of steps.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.feedback.loop import Actions, BridgeDraw, Loop, adjusting, are_finite, meeting_flag, onto_edge
from hjbjax.feedback.path import Path, PathStatus
from hjbjax.feedback.payments import is_tube
from hjbjax.feedback.pushing import after_interventions, after_pushes
from hjbjax.feedback.sudden_changes import after_chance
from hjbjax.hamiltonian.derivatives import with_both_modes
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, Control, Key, Number, State

if TYPE_CHECKING:
    import diffrax

# Before an interval: the time, the state with the running cost (n+1), the PathStatus, the steps so far, and for a tube
# the least cost of stopping so far and the largest running maximum, (2,).
Progress: TypeAlias = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]
Beginning: TypeAlias = tuple[Control, Number, State]  # of an interval: the held control, the time and the state
# For each interval: time and state at its end, both actions at its start, and True if the path runs through it.
Rows: TypeAlias = tuple[jax.Array, jax.Array, jax.Array, jax.Array | None, jax.Array]

LOOKS = 16  # evaluations of a tube's functions per output interval; an extreme is off by 1/16² of its change
LEAST_STEPS = 10  # per output interval with noise, where no error estimate shortens a step
TREE = 64  # the shortest step over the tolerance of the Brownian tree, below which w is interpolated
DEEPEST = 2**30  # the largest duration over that tolerance: each halving adds a level of the tree to every step
CHECKPOINTS = 8  # per interval in reverse mode: its steps are computed twice, and three times from 45 steps on
CHANGE = -1  # the code of an interval that ends where the mode changes, after which the path goes on
BRACKET = 4  # units in the last place: the width of the bracket around the time at which a path meets a boundary


@pytree_dataclass(static=("max_steps", "held"))
class Stepping:
    """Tolerances and limits of the integrator's steps.

    Args:
      rtol: relative error of an internal step.
      atol: absolute error of an internal step, in the units of the state and of the cost.
      max_step: the longest internal step, may be inf.
      max_steps: the most internal steps.
      held: True if the control is held from one output time to the next.
    """

    rtol: Number
    atol: Number
    max_step: Number
    max_steps: int
    held: bool


@pytree_dataclass()
class InitialValueProblem:
    """A closed loop with its initial state, its output times and the key of its noise.

    Args:
      loop: the closed loop.
      x0: the state at the first time, shape (n,).
      times: output times, shape (k+1,), increasing.
      key: the key of the Brownian path; None without noise.
    """

    loop: Loop
    x0: State
    times: Array
    key: Key | None


def integrate(ivp: InitialValueProblem, stepping: Stepping) -> tuple[Path, jax.Array]:
    """The path of full length, and a mask (k,) of the intervals through which it runs.

    One diffrax solve per output interval, all in one scan; after the end of a path its intervals have length zero. In
    reverse mode the state at every output time is stored, and the steps of one interval at a time.
    """
    along, back = (functools.partial(_integrated, reverse=reverse) for reverse in (False, True))
    return with_both_modes(along, back)((ivp, stepping))


def _integrated(given: tuple[InitialValueProblem, Stepping], reverse: bool) -> tuple[Path, jax.Array]:
    """The path of full length and its mask, computed by a program for forward or for reverse mode."""
    if reverse and given[0].loop.clock:
        raise ValueError(
            "simulate: a path with jumps or changes of the mode has no derivative in reverse mode, as their number is "
            "not known beforehand; use forward mode, such as jax.jvp or jax.jacfwd"
        )
    interval, first = _intervals(*given, reverse)
    interval = jax.checkpoint(interval, prevent_cse=False) if reverse else interval
    last, rows = jax.lax.scan(interval, first, given[0].times[1:])
    return _path(*given, last, rows)


def blank_record(loop: Loop, x0: np.ndarray, times: np.ndarray) -> tuple[tuple, tuple]:
    """The state before the first interval, except its code, and blank rows for all intervals; NumPy arrays."""
    count, players = len(times) - 1, (loop.problem.controls, loop.problem.disturbances)
    inputs = [0 if admissible is None else admissible.dim for admissible in players]
    controls, disturbances = (np.zeros((count, size), x0.dtype) for size in inputs)
    state = times[0], np.append(x0, 0.0), np.int32(0), np.int32(0), np.zeros(2, x0.dtype)
    shown = controls, None if loop.opponent is None else disturbances
    return state, (np.zeros(count, x0.dtype), np.zeros((count, len(x0)), x0.dtype), *shown, np.zeros(count, bool))


def integrate_part(
    ivp: InitialValueProblem, stepping: Stepping, so_far: tuple[Progress, Rows], done: Number, until: Number
) -> tuple[tuple[Progress, Rows], tuple[Path, jax.Array]]:
    """The path after the intervals from ``done`` to before ``until``, and the record from which to continue.

    Args:
      ivp: the initial-value problem of the whole path.
      stepping: the steps of the whole path.
      so_far: the record, that is the state and the rows of the intervals before; at first ``blank_record``.
      done: the first interval.
      until: the interval after the last one.
    """
    interval, first = _intervals(ivp, stepping)
    state, rows = so_far
    # the first code evaluates the target and the box inside the compiled program, not on the host
    state = jax.tree.map(lambda old, new: jnp.where(done == 0, new, old), state, first)

    def one(k: jax.Array, carry: tuple[Progress, Rows]) -> tuple[Progress, Rows]:
        state, row = interval(carry[0], ivp.times[k + 1])
        return state, jax.tree.map(lambda array, entry: array.at[k].set(entry), carry[1], row)

    # both ends are traced, so that chunks of every length share one compiled program
    state, rows = jax.lax.fori_loop(done, until, one, (state, rows))
    t, y, code, count, extremes = state
    came = jnp.arange(len(ivp.times) - 1) < until
    later, states, controls, disturbances, active = rows
    cut = (code == PathStatus.DURATION) & (until < len(ivp.times) - 1)
    last = t, y, jnp.where(cut, PathStatus.INTERRUPTED, code).astype(code.dtype), count, extremes
    shown = jnp.where(came, later, t), jnp.where(came[:, None], states, y[:-1]), controls, disturbances, active & came
    return (state, rows), _path(ivp, stepping, last, shown)


def _intervals(ivp: InitialValueProblem, stepping: Stepping, reverse: bool = False) -> tuple[Callable, Progress]:
    """One output interval as a step of a scan, and the state (t, y, code, steps, extremes) before the first."""
    loop, x0, start = ivp.loop, ivp.x0, ivp.times[0]
    solve = _solver(ivp, stepping, reverse)

    def interval(state: Progress, end: jax.Array) -> tuple[Progress, Rows]:
        t, y, code, count, extremes = state
        u, d = loop.players(t, y[:-1])
        code = jnp.where((code == PathStatus.DURATION) & ~are_finite((u, d)), PathStatus.UNDEFINED, code)
        active = code == PathStatus.DURATION  # the status of a path that has not ended yet
        times = (t, jnp.where(active, end, t), ivp.times[-1])
        later, moved, result, made, seen = _through_changes(loop, stepping, solve, (start, *times), y, u)
        count = count + made
        code = jnp.where(active, result, code)
        code = jnp.where((code == PathStatus.DURATION) & (count >= stepping.max_steps), PathStatus.MAX_STEPS, code)
        active &= jnp.all(jnp.isfinite(moved))  # otherwise the path ends at the previous output time
        t, y = jnp.where(active, later, t), jnp.where(active, moved, y)
        if is_tube(loop.problem):
            extremes = jnp.where(active, _extremes(loop, start, seen, extremes), extremes)
        shown = jax.tree.map(lambda a: jnp.where(active, a, jnp.nan), (u, d))
        return (t, y, code.astype(jnp.int32), count, extremes), (t, y[:-1], *shown, active)

    y = _begun(loop, start, x0)
    x0 = y[:-1]
    # the target comes last and wins: a start that is in the target and outside the box has reached the target
    code = jnp.where(loop.margin(x0) > 0, PathStatus.DURATION, PathStatus.LEFT_BOX)
    code = jnp.where(loop.target(start, x0) <= 0, PathStatus.TARGET, code).astype(jnp.int32)
    # before any point: no moment to stop, and no maximum
    extremes = jnp.asarray([jnp.inf, -jnp.inf], x0.dtype)
    if is_tube(loop.problem):
        extremes = _extremes(loop, start, (start[None], x0[None]), extremes)
    return interval, (start, y, code, jnp.zeros((), jnp.int32), extremes)


def _begun(loop: Loop, start: Number, x0: State) -> jax.Array:
    """The state and the cost after the interventions at the first time; none are made in the target."""
    y = jnp.append(x0, 0.0)
    if loop.push is None and loop.switch is None:
        return y
    return jnp.where(loop.target(start, x0) <= 0, y, after_interventions(loop, start, y, start))


def _extremes(loop: Loop, start: Number, seen: tuple[Array, Array], before: jax.Array) -> jax.Array:
    """The least cost of stopping so far and the largest running maximum, (2,), after further points of the path.

    Args:
      loop: the closed loop.
      start: the first time of the path, where discounting starts.
      seen: times (k,) and states (k, n), in order.
      before: the two numbers so far.
    """
    problem, (best, most) = loop.problem, before
    times, states = seen

    def along(function: Callable) -> jax.Array:
        return jax.vmap(lambda t, x: loop.number(function, t, x))(times, states)

    if problem.running_max is not None:
        worst = jax.lax.cummax(jnp.maximum(along(problem.running_max), most))
    else:
        worst = jnp.full(times.shape, -jnp.inf, before.dtype)
    if problem.stopping_cost is not None:
        paid = jnp.maximum(loop.discount(times - start) * along(problem.stopping_cost), worst)
        best = jnp.minimum(best, jnp.min(paid))
    return jnp.stack([best, worst[-1]])


def _path(ivp: InitialValueProblem, stepping: Stepping, last: Progress, shown: Rows) -> tuple[Path, jax.Array]:
    """The path, padded to its full length, and a mask of the intervals before its end."""
    loop, x0, start = ivp.loop, ivp.x0, ivp.times[0]
    (t, y, code, count, extremes), (later, states, controls, disturbances, active) = last, shown
    hit, ended = code == PathStatus.TARGET, code == PathStatus.DURATION
    if loop.modes:  # the first mode is the one after the changes at the start, but the first state is ``x0``
        x0 = jnp.asarray(x0).at[0].set(_begun(loop, start, x0)[0])
    times, states = jnp.append(start, later), jnp.concatenate([x0[None], states])
    # a path that leaves the box or fails pays nothing at its end
    due = jnp.where(hit, loop.paid_at_end(t, y[:-1]), loop.paid_at_last(t, y[:-1]))
    due, owes = loop.discount(t - start) * due, hit | (ended & _has_last_payment(loop))
    if is_tube(loop.problem):
        best, most = extremes
        last_chance = jnp.where(owes, jnp.maximum(due, most), jnp.inf)
        stops = loop.problem.stopping_cost is not None
        cost = jnp.minimum(best, last_chance) if stops else jnp.where(owes, last_chance, most)
    else:
        cost = y[-1] + jnp.where(owes, due, 0)
    reached = jnp.where(hit, t, jnp.inf)
    return Path(times, states, controls, disturbances, cost, reached, code, count, held=stepping.held), active


def _has_last_payment(loop: Loop) -> bool:
    """True if there is a payment after the last time, even if it is zero."""
    return loop.due == "V at the horizon" or (loop.due == "terminal cost" and loop.problem.terminal_cost is not None)


def _through_changes(
    loop: Loop, stepping: Stepping, solve: Callable, times: tuple[jax.Array, ...], y: jax.Array, u: Control
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, tuple[jax.Array, jax.Array]]:
    """``_advance`` through all changes of the mode in an interval; the first of the ``times`` is that of the path."""
    start, t, end, last = times
    if not loop.clock:
        return _advance(loop, stepping, solve, (t, end, last), y, u)

    def on(carry: tuple) -> tuple:
        # under vmap a path that has finished its interval is computed too, and must not step beyond the Brownian path
        again = carry[2] == CHANGE
        begun, at = jnp.where(again, carry[0], t), jnp.where(again, carry[1], y)
        now = u if stepping.held else loop.players(begun, at[:-1])[0]
        later, moved, code, more, seen = _advance(loop, stepping, solve, (begun, end, last), at, now)
        changed = code == CHANGE
        after = after_interventions(loop, later, after_chance(loop, later, moved, start), start)
        moved = jnp.where(changed, after, moved)
        # a jump may lead into the target or out of the box
        ended, outside = loop.target(later, moved[:-1]) <= 0, loop.margin(moved[:-1]) <= 0
        code = jnp.where(changed & (later >= end), PathStatus.DURATION, code)
        code = jnp.where(changed & outside, PathStatus.LEFT_BOX, code)
        code = jnp.where(changed & ended, PathStatus.TARGET, code)
        return later, moved, code.astype(jnp.int32), carry[3] + more, seen

    def changes(carry: tuple) -> jax.Array:
        return (carry[2] == CHANGE) & (carry[3] < stepping.max_steps)

    count = LOOKS if _looks(loop, t, end)[0] else 1
    nothing = jnp.broadcast_to(t, (count,)), jnp.broadcast_to(y[:-1], (count, y.size - 1))
    none = jnp.asarray(CHANGE, jnp.int32), jnp.zeros((), jnp.int32), nothing
    t, y, code, made, seen = jax.lax.while_loop(changes, on, (t, y, *none))
    return t, y, jnp.where(code == CHANGE, PathStatus.MAX_STEPS, code), made, seen


def _advance(
    loop: Loop, stepping: Stepping, solve: Callable, times: tuple[jax.Array, ...], y: jax.Array, u: Control
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, tuple[jax.Array, jax.Array]]:
    """The path at the end of an interval, or at the target or the boundary if it meets one of them earlier.

    Returns:
      Time, state with cost, code, steps, and the times (k,) and states (k, n) at which a tube is evaluated.
    """
    import diffrax

    t, end, last = times  # start and end of the interval, and the last of all times
    # under vmap steps of a finished path are computed too, and must not go beyond the Brownian path
    width = jnp.where(end > t, end - t, jnp.where(last > t, last - t, 1))
    if not loop.has_equal_steps:
        step = jnp.minimum(width, stepping.max_step)
    else:
        # equal steps that end on the output time; 1e-6 absorbs a quotient that rounding puts just above an integer
        step = width / jnp.ceil(jnp.maximum(width / stepping.max_step, LEAST_STEPS) - 1e-6)
    beginning = (u, t, y[:-1])
    looks, saved = _looks(loop, t, end)
    solved = solve(
        t0=t, t1=end, dt0=step, y0=jnp.append(y, 1) if _is_bridged(loop) else y, args=beginning, saveat=saved
    )
    (later, *between), (y, *passed) = solved.ts, solved.ys
    later, y, met = later[0], y[0], jnp.zeros((), bool)
    if _is_bridged(loop):
        y, met = y[:-1], (y[-1] < 1) & diffrax.is_event(solved.result)
        y = jnp.append(jnp.where(met, _on_target(loop, stepping, later, y[:-1], beginning), y[:-1]), y[-1])
    target, margin = loop.target(later, y[:-1]), loop.margin(y[:-1])
    # the codes are written from the weakest reason to the strongest; each `where` overrides the earlier ones
    code = jnp.where(met | (target <= margin), PathStatus.TARGET, PathStatus.LEFT_BOX)
    if loop.clock:
        first = loop.until_change(later, y[:-1]) <= jnp.minimum(target, margin)
        code = jnp.where(first & ~met, CHANGE, code)
    if loop.guarded and not stepping.held:
        inside = (target > 0) & (margin > 0) & (code != CHANGE)
        code = jnp.where(inside & ~met & ~are_finite(loop.players(later, y[:-1])), PathStatus.UNDEFINED, code)
    code = jnp.where(diffrax.is_event(solved.result), code, PathStatus.DURATION)
    code = jnp.where(jnp.all(jnp.isfinite(y)), code, PathStatus.NONFINITE)
    # diffrax returns infinity if it runs out of steps, although the state may be finite
    code = jnp.where(diffrax.is_okay(solved.result), code, PathStatus.MAX_STEPS)
    seen = later[None], y[None, :-1]
    if looks:  # after the end of the path, diffrax fills in infinity
        came = (between[0] <= later) & jnp.all(jnp.isfinite(passed[0]), axis=-1)
        seen = jnp.where(came, between[0], later), jnp.where(came[:, None], passed[0][:, : y.size - 1], y[:-1])
        seen = jnp.append(seen[0], later), jnp.concatenate([seen[1], y[None, :-1]])
    return later, y, code, solved.stats["num_steps"].astype(jnp.int32), seen


def _looks(loop: Loop, t: jax.Array, end: jax.Array) -> tuple[bool, "diffrax.SaveAt"]:
    """True if a tube is evaluated between output times, which requires no noise; and what diffrax is to save."""
    import diffrax

    last = diffrax.SubSaveAt(t1=True)
    if not is_tube(loop.problem) or loop.problem.noise is not None:
        return False, diffrax.SaveAt(subs=(last,))
    shares = jnp.arange(1, LOOKS, dtype=t.dtype) / LOOKS
    return True, diffrax.SaveAt(subs=(last, diffrax.SubSaveAt(ts=t + shares * (end - t))))


def _solver(ivp: InitialValueProblem, stepping: Stepping, reverse: bool) -> Callable:
    """diffrax's solve of one interval, with all fixed arguments; its ``args`` are the interval's ``Beginning``.

    ``reverse``: True for checkpoints and reverse mode, False for forward mode.
    """
    import diffrax

    loop, x0, start, duration = ivp.loop, ivp.x0, ivp.times[0], ivp.times[-1] - ivp.times[0]
    n, bridged = len(x0), _is_bridged(loop)  # after the n states come the cost and then the flag of a bridge

    def rate(t: Number, y: Array, beginning: Beginning) -> jax.Array:
        acts = _acting(loop, stepping, t, y[:n], beginning)
        return jnp.pad(loop.rate(t, y[:n], *acts, loop.discount(t - start)), (0, int(bridged)))

    def noise(t: Number, y: Array, beginning: Beginning) -> jax.Array:
        sigma = loop.noise(t, y[:n], *_acting(loop, stepping, t, y[:n], beginning))
        return jnp.pad(sigma, ((0, int(bridged)), (0, 0)))

    def margin(t: Number, y: Array, args: Beginning, **kwargs: object) -> jax.Array:
        inside = jnp.minimum(loop.target(t, y[:n]), loop.margin(y[:n]))
        if loop.clock:
            inside = jnp.minimum(inside, loop.until_change(t, y[:n]))
        if loop.guarded and not stepping.held:  # under a hold the players are only evaluated at the samples
            inside = jnp.where(are_finite(loop.players(t, y[:n])), inside, jnp.minimum(inside, -1))
        return jnp.where(y[-1] < 1, y[-1], inside) if bridged else inside  # below 1 if the step meets the target

    terms: diffrax.AbstractTerm = diffrax.ODETerm(rate)
    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController
    if not loop.has_equal_steps:
        solver = diffrax.Tsit5()
        # force_dtmin accepts the shortest step for any error; half of max_steps such steps reach the end
        controller = diffrax.PIDController(
            rtol=stepping.rtol, atol=stepping.atol, dtmin=2 * duration / stepping.max_steps, dtmax=stepping.max_step,
            force_dtmin=True, norm=_size,
        )  # fmt: skip
    elif loop.problem.noise is None:
        solver, controller = adjusting(diffrax.Euler)(after=_after_steps(ivp, stepping)), diffrax.ConstantStepSize()
    else:
        additive = not callable(loop.problem.noise)
        brownian = _brownian(ivp, stepping.max_step, additive)
        terms = diffrax.MultiTerm(terms, diffrax.ControlTerm(noise, brownian))
        # SRA1 has its order only for additive noise; a function may depend on the state, so it uses Euler
        kind, controller = diffrax.SRA1 if additive else diffrax.Euler, diffrax.ConstantStepSize()
        adjusted = bridged or loop.push is not None
        solver = adjusting(kind)(after=_after_steps(ivp, stepping)) if adjusted else kind()
    event = None
    ends = loop.clock or loop.guarded or loop.ends or (loop.grid is not None and not loop.clamp)
    if ends:  # an event doubles the compile time
        close = BRACKET * jnp.finfo(x0.dtype).eps
        # flip=True: the function falls through zero; "detect" would put a host callback into the compiled program
        event = diffrax.Event(margin, _bisection()(close, close, flip=True), direction=False)
    return functools.partial(
        diffrax.diffeqsolve, terms, solver, stepsize_controller=controller, event=event,
        max_steps=stepping.max_steps, throw=False,
        adjoint=diffrax.RecursiveCheckpointAdjoint(CHECKPOINTS) if reverse else diffrax.ForwardMode(),
    )  # fmt: skip


def _is_bridged(loop: Loop) -> bool:
    """True if a path may meet a target between the ends of a step."""
    return loop.problem.noise is not None and loop.ends


def _acting(loop: Loop, stepping: Stepping, t: Number, x: State, beginning: Beginning) -> Actions:
    """The actions of both players at a stage of a step."""
    u, d = loop.actions(t, x, beginning[1:])
    return (beginning[0] if stepping.held else u), d


def _on_target(loop: Loop, stepping: Stepping, t: Number, x: State, beginning: Beginning) -> State:
    """The state at which a path meets the target, from a point on the straight line between the ends of the step."""
    sigma = loop.noise(t, x, *_acting(loop, stepping, t, x, beginning))[:-1]
    return onto_edge(functools.partial(loop.target, t), x, sigma)


def _after_steps(ivp: InitialValueProblem, stepping: Stepping) -> Callable:
    """The state at the end of a step for ``loop.adjusting``: pushed, and with the flag of a bridge."""
    loop, n, draw, start = ivp.loop, len(ivp.x0), BridgeDraw(ivp.key), ivp.times[0]

    def after(t: Array, later: Array, y: Array, moved: jax.Array, beginning: Beginning) -> jax.Array:
        if loop.push is None:
            pushed = moved
        else:  # also in the target: a bridge may end the path earlier in the step
            pushed = jnp.concatenate([after_pushes(loop, later, moved[: n + 1], start), moved[n + 1 :]])
        if not _is_bridged(loop):
            return pushed
        sigma = loop.noise(t, y[:n], *_acting(loop, stepping, t, y[:n], beginning))[:-1]
        return pushed.at[-1].set(meeting_flag(loop, draw, sigma, (t, y[:n]), (later, moved[:n])))

    return after


def _brownian(ivp: InitialValueProblem, max_step: Number, additive: bool) -> "diffrax.VirtualBrownianTree":
    """The Brownian path of a key, which does not depend on the steps."""
    import diffrax

    loop, x0, times = ivp.loop, ivp.x0, ivp.times
    start, duration = times[0], times[-1] - times[0]
    # Below its tolerance the tree interpolates and is not Brownian. Keep the tolerance far below a step (at most 1/10
    # interval), equal for the whole run so that neighbouring intervals agree on w, and at most 30 levels deep.
    fine = jnp.maximum(jnp.minimum(jnp.min(jnp.diff(times)) / LEAST_STEPS, max_step) / TREE, duration / DEEPEST)
    # SRA1 needs the integral of w over a step in addition to its increment
    area = diffrax.SpaceTimeLevyArea if additive else diffrax.BrownianIncrement
    sources = jax.eval_shape(lambda x: loop.noise(start, x, *loop.players(start, x)), x0).shape[1]
    shape = jax.ShapeDtypeStruct((sources,), x0.dtype)
    return diffrax.VirtualBrownianTree(start, start + duration, fine, shape, ivp.key, levy_area=area)


def _size(error: jax.Array) -> jax.Array:
    """The root mean square of a scaled error; infinite for NaN, because diffrax would make the step length NaN."""
    size = jnp.sqrt(jnp.mean(jnp.square(error)))
    return jnp.where(jnp.isnan(size), jnp.inf, size)


@functools.cache
def _bisection() -> type:
    """A subclass of optimistix's bisection that stops when its bracket is narrow, whatever the value of the function.

    A target function may be steep or jump, so a test of its value would fail or succeed too early. The answer is the
    late end of the bracket, where the function is zero or below.
    """
    import optimistix

    class Bisection(optimistix.Bisection):  # the arguments are optimistix's
        def terminate(
            self, fn: Any, y: Any, args: Any, options: dict[str, Any], state: Any, tags: frozenset[object]
        ) -> tuple[jax.Array, Any]:
            narrow = jnp.abs(state.lower - state.upper) < self.atol + self.rtol * jnp.abs(y)
            return narrow, optimistix.RESULTS.successful

        def postprocess(
            self, fn: Any, y: Any, aux: Any, args: Any, options: dict[str, Any], state: Any, tags: frozenset[object],
            result: Any,
        ) -> tuple[jax.Array, Any, dict[str, Any]]:  # fmt: skip
            return state.upper, aux, {}

    return Bisection
