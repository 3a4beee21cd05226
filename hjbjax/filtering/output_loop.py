"""The loop through plant, sensor, observer and control, as a pure function of a start and a key.

    dx = f(x, u) dt + σ dw,    dy = h(x) dt + r dv,    u = control(information state), held from one update to the next

Between updates the plant makes sub-steps τ with Platen's predictor–corrector scheme in the Itô sense,

    x̃ = x + f(x) τ + σ(x) Δw,    x ← x + ½ (f(x) + f(x̃)) τ + σ(x) Δw,

which has weak order 1, and order 2 without noise. The trapezoidal rule at the same points integrates dy and the running
cost. With noise a target can also be met within a sub-step, see ``hjbjax.feedback.loop``.
"""

import functools
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from hjbjax.feedback.loop import BridgeDraw, Loop, meeting_flag, onto_edge
from hjbjax.feedback.path import PathStatus
from hjbjax.filtering.measurement import Measurement
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, Control, Key, Number, State


@runtime_checkable
class Observer(Protocol):
    """A state estimator in discrete steps: pure functions, for ``jit``, ``vmap`` and ``lax.scan``.

    Example:
      >>> @pytree_dataclass()
      ... class LowPass:  # uses the measurement as the state, smoothed over a time
      ...     time: float
      ...     def initial(self):
      ...         return jnp.zeros(1)
      ...     def update(self, state, u, dy, dt):
      ...         return state + (1 - jnp.exp(-dt / self.time)) * (dy / dt - state)
      ...     def estimate(self, state):
      ...         return state
      >>> isinstance(LowPass(0.5), Observer)
      True
    """

    def initial(self) -> Any:
        """The information state at t = 0, any pytree of arrays."""

    def update(self, state: Any, u: Control, dy: Array, dt: Number) -> Any:
        """The information state after applying the control u (m,) for dt and measuring the increment dy (p,).

        The observers of ``hjbjax.filtering`` take ``dy=None`` for a prediction, a step without a measurement.
        """

    def estimate(self, state: Any) -> State:
        """The point estimate of x, shape (n,)."""


@runtime_checkable
class GridObserver(Observer, Protocol):
    """An observer on a grid, whose periodic axes are the periodic states of the loop."""

    @property
    def grid(self) -> Grid:
        """The nodes."""


@pytree_dataclass()
class OutputPath:
    """The history of a loop closed through an observer; a batch of paths adds a leading axis to every array.

    Arrays have full length: after the end of a path, times, states and estimates repeat the last entry, and controls
    and measurements are NaN.

    Args:
      times: shape (k+1,), from 0.
      states: the states of the plant, shape (k+1, n), with periodic states unwound.
      controls: the control over each interval, shape (k, m).
      measurements: the increment dy over each interval, shape (k, p).
      estimates: the observer's estimates, shape (k+1, n); the first one precedes all measurements.
      information: the last information state of the observer.
      cost: ∫ e^{−βt} L dt, plus the discounted exit cost if the target was reached, else the discounted terminal cost.
        For a problem with rewards it is minus ``reward``.
      reached: the time at which the target was reached; inf if it was not.
      code: a PathStatus number.
    """

    times: Any
    states: Any
    controls: Any
    measurements: Any
    estimates: Any
    information: Any
    cost: Any
    reached: Any
    code: Any

    @property
    def reward(self) -> Any:
        """The discounted reward, minus the cost."""
        return 0 - self.cost

    @property
    def held(self) -> bool:
        """True: each control is constant through its interval."""
        return True

    @property
    def status(self) -> PathStatus:
        """The reason for the end of a single path."""
        return PathStatus(int(self.code))


@runtime_checkable
class Judge(Protocol):
    """A control that examines the paths made with it."""

    def judge(self, path: OutputPath) -> None:
        """Warn if the result of ``simulate_output`` is not to be trusted."""


@pytree_dataclass()
class OutputLoop:
    """Plant, sensor, observer and control.

    Args:
      plant: the plant and its costs, as a loop without players.
      measurement: the sensor.
      initial: the observer's function ``initial``, a callable pytree like the next two.
      update: the observer's function ``update``.
      estimate: the observer's function ``estimate``.
      control: a pytree that is called with the time, the information state and the previous control.
    """

    plant: Loop
    measurement: Measurement
    initial: Callable
    update: Callable
    estimate: Callable
    control: Callable


@pytree_dataclass()
class CertaintyEquivalence:
    """The control of a feedback at the estimate; the previous control where the feedback has none.

    Args:
      estimate: the observer's function.
      feedback: a pytree that is called with (t, x), as ``feedback.lookups`` returns it.
      grid: the box in which the feedback is known.
    """

    estimate: Callable
    feedback: Callable
    grid: Grid

    def __call__(self, t: Number, information: Any, before: Control) -> Control:
        """The control, shape (m,)."""
        x = jnp.asarray(self.estimate(information))
        u = jnp.asarray(self.feedback(t, self.grid.wrap(x)), before.dtype)
        # an estimate may be in the target, where a solution has no control, although the state is outside
        return jnp.where(jnp.isnan(u), before, u)


def of_information(function: Callable, t: Number, information: Any, before: Control) -> Control:
    """A user's function of the information state, with the arguments of a controller."""
    return jnp.asarray(function(information), before.dtype)


def no_control(t: Number, information: Any, before: Control) -> Control:
    """A controller for a plant without controls."""
    return before


def output_path(loop: OutputLoop, x0: State, times: Array, key: Key, *, substeps: int) -> OutputPath:
    """The path from x0 over the output times, shape (k+1,), with ``substeps`` steps of the plant per interval."""
    plant, dtype, count = loop.plant, x0.dtype, len(times) - 1
    brownian, bridge = jax.random.split(key)
    m = 0 if plant.problem.controls is None else plant.problem.controls.dim
    draw, shakes = BridgeDraw(bridge), (substeps, _sources(plant, x0, m) + loop.measurement.dim)

    def interval(carry: tuple, row: tuple) -> tuple[tuple, tuple]:
        t, z, information, before, code = carry
        k, end = row
        u = loop.control(t, information, before)
        code = jnp.where((code == PathStatus.DURATION) & ~jnp.all(jnp.isfinite(u)), PathStatus.UNDEFINED, code)
        active = code == PathStatus.DURATION
        end = jnp.where(active, end, t + (end - times[k]))
        shake = jax.random.normal(jax.random.fold_in(brownian, k), shakes, dtype)
        later, moved, dy, met = _advanced(loop, draw, (t, z), u, end, shake)
        told = jax.tree.map(
            lambda new, old: jnp.asarray(new, jnp.result_type(old)),
            loop.update(information, u, dy, later - t),
            information,
        )
        # an estimate that is not finite gives no control
        sound = jnp.all(jnp.isfinite(moved)) & jnp.all(jnp.isfinite(loop.estimate(told)))
        code = jnp.where(active & ~sound, PathStatus.NONFINITE, jnp.where(active & met, PathStatus.TARGET, code))
        runs = active & sound
        t, z, information, before = jax.tree.map(
            lambda new, old: jnp.where(runs, new, old), (later, moved, told, u), (t, z, information, before)
        )
        shown = jnp.where(runs, u, jnp.nan), jnp.where(runs, dy, jnp.nan)
        estimate = jnp.asarray(loop.estimate(information), dtype)
        return (t, z, information, before, code), (t, z[:-1], *shown, estimate)

    information = jax.tree.map(jnp.asarray, loop.initial())
    begins = jnp.where(plant.target(times[0], x0) <= 0, PathStatus.TARGET, PathStatus.DURATION).astype(jnp.int32)
    nobody = jnp.full(m, jnp.nan, dtype)  # there is no control before the first one
    first = (times[0], jnp.append(x0, 0.0), information, nobody, begins)
    last, (later, states, controls, records, estimates) = jax.lax.scan(interval, first, (jnp.arange(count), times[1:]))
    t, z, final, _, code = last
    hit, problem = code == PathStatus.TARGET, plant.problem
    owed = jnp.where(code == PathStatus.DURATION, plant.number(problem.terminal_cost, t, z[:-1]), 0)
    owed = jnp.where(hit, plant.number(problem.exit_cost, t, z[:-1]), owed)
    return OutputPath(
        times=jnp.append(times[0], later),
        states=jnp.concatenate([x0[None], states]),
        controls=controls,
        measurements=records,
        estimates=jnp.concatenate([jnp.asarray(loop.estimate(information), dtype)[None], estimates]),
        information=final,
        cost=z[-1] + plant.discount(t - times[0]) * owed,
        reached=jnp.where(hit, t, jnp.inf),
        code=code,
    )


def _sources(plant: Loop, x0: State, m: int) -> int:
    """The number of Wiener processes that drive a plant with m inputs."""
    u = jax.ShapeDtypeStruct((m,), x0.dtype)
    return jax.eval_shape(lambda x, u: plant.noise(0.0, x, u, None), x0, u).shape[1]


def _advanced(
    loop: OutputLoop, draw: BridgeDraw, begins: tuple[Array, Array], u: Control, end: Array, shake: Array
) -> tuple[Array, Array, Array, Array]:
    """Time, state with cost, increment dy, and True if the target was met, at the end of an interval or at the target.

    ``shake`` holds unit normal numbers, one row per sub-step: first for the noise of the plant, then for that in y.
    """
    plant, measured, (t, z), p = loop.plant, loop.measurement, begins, loop.measurement.dim
    dtype, tau, sources = z.dtype, (end - t) / len(shake), shake.shape[1] - p
    normal = jnp.sqrt(tau) * shake
    root = jnp.asarray(measured.root, dtype)

    def rate(t: Array, z: Array) -> tuple[Array, Array]:
        x = z[:-1]
        return plant.rate(t, x, u, None, plant.discount(t)), measured.at(plant.wrap(x))

    def substep(carry: tuple, draws: Array) -> tuple[tuple, None]:
        t, z, dy, met = carry
        sigma = plant.noise(t, z[:-1], u, None)
        push, error = sigma @ draws[:sources], root @ draws[sources:]
        slope, seen = rate(t, z)
        guessed, seen_then = rate(t + tau, z + tau * slope + push)
        moved = z + tau / 2 * (slope + guessed) + push
        hit, share = _meeting(plant, draw, sigma[:-1], (t, z[:-1]), (t + tau, moved[:-1]))
        # shorten the sub-step if the target is met in it: the record and its noise end there
        later = t + share * tau
        further = dy + share * tau / 2 * (seen + seen_then) + jnp.sqrt(share) * error
        new = (later, _on_target(plant, sigma, later, z + share * (moved - z), hit), further, hit)
        return jax.tree.map(lambda new, old: jnp.where(met, old, new), new, carry), None

    start = (t, z, jnp.zeros(p, dtype), jnp.zeros((), bool))
    (later, moved, dy, met), _ = jax.lax.scan(substep, start, normal)
    return jnp.where(met, later, end), moved, dy, met


def _meeting(plant: Loop, draw: BridgeDraw, sigma: Array, begins: tuple, ends: tuple) -> tuple[Array, Array]:
    """True if a sub-step meets the target, and the share of the sub-step at which it does; otherwise 1."""
    if plant.problem.target is None:
        return jnp.zeros((), bool), jnp.ones((), ends[1].dtype)
    before, after = plant.target(*begins), plant.target(*ends)
    hit = after <= 0
    # the zero of the target function on the straight line, if the function is linear
    share = jnp.where(hit, before / jnp.where(hit, before - after, 1), 1).astype(ends[1].dtype)
    if plant.problem.noise is not None:
        flag = meeting_flag(plant, draw, sigma, begins, ends)  # 1 − 1/share if the bridge meets the target
        bridged = flag < 1
        hit, share = hit | bridged, jnp.where(bridged, 1 / jnp.where(bridged, 1 - flag, 1), share)
    return hit, share


def _on_target(plant: Loop, sigma: Array, t: Array, z: Array, hit: Array) -> Array:
    """The state with cost, moved along the noise onto the boundary of the target if the sub-step meets it."""
    if plant.problem.target is None or plant.problem.noise is None:
        return z
    edge = onto_edge(functools.partial(plant.target, t), z[:-1], sigma[:-1])
    return jnp.where(hit, jnp.append(edge, z[-1]), z)
