"""Observers: estimates of the state from measurements, step by step.

    dx = f(x, u) dt + σ dw,    dy = h(x) dt + r dv

An observer has an information state, any pytree of arrays. It receives only the control over a step and the increment
dy of the record. Steps may differ in length. ``update`` with ``dy=None`` predicts. ``correct`` processes a sample
y = h(x) + s v at one time, so a sensor that is sampled at irregular times t_k is

    state = observer.update(state, u, None, t_k − t_{k−1})
    state = observer.correct(state, y_k, measurement_noise=s)

A step with affine drift is exact for any length. For dξ = (F ξ + g) dt + dw with W dt the covariance of dw, the step is

    Φ = e^{F t},    s = ∫₀ᵗ e^{F σ} g dσ,    Q = ∫₀ᵗ e^{F σ} W e^{Fᵀ σ} dσ.

These are Taylor series on a short piece, followed by doublings,

    s(2t) = s + Φ s,    Q(2t) = Q + Φ Q Φᵀ,    Φ(2t) = Φ².

They only add covariances, so no step is too long. C. F. Van Loan's exponential of [−F, W; 0, Fᵀ] instead contains
e^{−F t}, which overflows for a stiff system.

A custom observer is an object with three methods, see ``output_loop.Observer``. Make it a pytree
(``pytree_dataclass``), so that changing its numbers does not recompile.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.filtering.measurement import Measurement, check_step, check_vector, measurement, plant, sample_of
from hjbjax.filtering.output_loop import Observer
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, front_door, is_traced, numbers, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Control, Number, Numbers, State

__all__ = ["ExtendedKalman", "Gaussian", "Luenberger", "Observer", "affine_flow"]

SHORT = 0.25  # |F| t of the short piece: the terms of the series of Q then fall like ½^j/j!
TERMS = 14  # terms of the series: the remainder is ½^15/15!, 2e-17
DOUBLINGS = 64  # at most: a piece 2^64 times shorter than the step is below rounding
ROUNDINGS = 64  # units of eps: the rounding error allowed in the symmetry and the zero eigenvalues of a covariance


@pytree_dataclass()
class Gaussian:
    """A normal law of the state.

    Args:
      mean: shape (n,).
      covariance: shape (n, n).
    """

    mean: Any
    covariance: Any


@pytree_dataclass()
class ExtendedKalman:
    """The extended Kalman–Bucy filter: the law of the state, approximated by a normal law.

        dx̂ = f(x̂, u) dt + K (dy − h(x̂) dt),    Ṗ = A P + P Aᵀ + σσᵀ − K R Kᵀ,    K = P Cᵀ R⁻¹,  R = r rᵀ

    with A = ∂f/∂x and C = ∂h/∂x at the estimate. Each step linearises f and h about the estimate at its start. The law
    of the state and of dy at its end is then normal with known moments. P is conditioned on dy by the congruence
    P⁺ = [I, −K] S [I, −K]ᵀ, so it is symmetric without negative eigenvalues for any dt. Sensors that agree up to
    rounding are averaged. For a linear plant the result is the exact law given the increments, which agrees with the
    Kalman–Bucy filter up to O(dt²).

    Noise that depends on the state is evaluated at the estimate. Angles are not wrapped: measure their sine and cosine.

    Args:
      problem: the plant; only its drift, controls and noise are used.
      h: the measured function of one state, returns shape (p,).
      mean: the mean at t = 0, shape (n,).
      covariance: the covariance at t = 0, shape (n, n), or (n,) for independent entries.

    Keyword Args:
      measurement_noise: r in dy = h(x) dt + r dv: a number, (p,) or (p, p).

    Raises:
      ValueError: a game, a problem that depends on time, a matrix that is not a covariance, an h or a noise of the
        wrong shape.
      TypeError: an argument that is not a Problem, an h that cannot be called, entries that are not numbers.

    Example:
      >>> filter = ExtendedKalman(Problem(lambda x, u: -x, noise=1.0), lambda x: x, [0.0], [0.5], measurement_noise=0.1)
      >>> state = filter.update(filter.initial(), jnp.zeros(0), jnp.ones(1), 1.0)
      >>> filter.estimate(state).shape, bool(state.covariance[0, 0] < 0.5)
      ((1,), True)

    Source: R. E. Kalman and R. S. Bucy, New results in linear filtering and prediction theory (1961).
    """

    plant: Problem
    measurement: Measurement
    mean: Any
    covariance: Any

    @front_door
    def __init__(
        self,
        problem: Problem,
        h: Callable,
        mean: Numbers | Sequence[float],
        covariance: Numbers | Sequence,
        *,
        measurement_noise: Numbers | Sequence = 1.0,
    ):
        name = "ExtendedKalman"
        start = _start(mean, f"{name}: mean")
        n = start.shape[0]
        fields = {
            "plant": plant(problem, n, name),
            "measurement": measurement(h, n, measurement_noise, name),
            "mean": start,
            "covariance": _covariance(covariance, n, f"{name}: covariance"),
        }
        for field, value in fields.items():
            object.__setattr__(self, field, value)  # frozen, because compiled programs depend on the fields

    @front_door
    def initial(self) -> Gaussian:
        """The law at t = 0."""
        mean = jnp.asarray(self.mean, jnp.result_type(float))
        return Gaussian(mean, jnp.asarray(self.covariance, mean.dtype))

    @front_door
    def update(self, state: Gaussian, u: Control, dy: Array | None, dt: Number) -> Gaussian:
        """The law after applying the control u (m,) for dt and measuring the increment dy (p,), or None."""
        mean, p = state.mean, self.measurement.dim
        check_vector(mean, "ExtendedKalman.update: the mean", len(self.mean), "one entry per state")
        check_step("ExtendedKalman.update", self.plant, p, (u, dy, dt))
        n, dtype = mean.shape[0], mean.dtype
        u, dt = jnp.asarray(u, dtype), jnp.asarray(dt, dtype)

        def rates(x: State) -> jax.Array:  # dx/dt, then dy/dt in units of the noise of y
            drift = jnp.asarray(self.plant.drift(x, u), dtype)
            return jnp.concatenate([drift, self.measurement.whitened(self.measurement.at(x))])

        sigma = self.plant.diffusion(mean, u).astype(dtype)
        noise = jnp.eye(n + p, dtype=dtype).at[:n, :n].set(sigma @ sigma.T)
        # the slopes in y are zero: the measurement does not act on the plant
        slopes = jnp.pad(jax.jacfwd(rates)(mean), ((0, 0), (0, p)))
        transition, shift, spread = affine_flow(slopes, rates(mean), noise, dt, states=n)
        predicted, flow = mean + shift[:n], transition[:, :n]
        if dy is None:
            covariance = flow[:n] @ state.covariance @ flow[:n].T + spread[:n, :n]
            return Gaussian(predicted, (covariance + covariance.T) / 2)
        innovation = self.measurement.whitened(jnp.asarray(dy, dtype)) - shift[n:]
        # in units of its noise the covariance of dy is at least dt
        return _conditioned(Gaussian(predicted, state.covariance), innovation, flow, spread, dt)

    @front_door
    def correct(self, state: Gaussian, y: Array, *, measurement_noise: Numbers | Sequence) -> Gaussian:
        """The law after a sample y = h(x) + s v, shape (p,), at one time, with h linear about the mean.

        Args:
          state: the law before.
          y: the sample, shape (p,), in the units of h.

        Keyword Args:
          measurement_noise: s, a number, (p,) or (p, p), in the units of h: standard deviations.

        Raises:
          ValueError: a sample or a noise of the wrong shape, or not finite.

        Example:
          >>> filter = ExtendedKalman(Problem(lambda x, u: -x, noise=1.0), lambda x: x, [0.0], [1.0])
          >>> state = filter.correct(filter.initial(), np.ones(1), measurement_noise=1.0)
          >>> round(float(state.mean[0]), 5), round(float(state.covariance[0, 0]), 5)
          (0.5, 0.5)
        """
        name, mean = "ExtendedKalman.correct", state.mean
        check_vector(mean, f"{name}: the mean", len(self.mean), "one entry per state")
        sampled = sample_of(self.measurement, y, measurement_noise, name)
        n, p, dtype = mean.shape[0], sampled.dim, mean.dtype

        def seen(x: State) -> jax.Array:
            return sampled.whitened(sampled.at(x))

        flow = jnp.concatenate([jnp.eye(n, dtype=dtype), jax.jacfwd(seen)(mean)])
        spread = jnp.zeros((n + p, n + p), dtype).at[n:, n:].set(jnp.eye(p, dtype=dtype))
        innovation = sampled.whitened(jnp.asarray(y, dtype)) - seen(mean)
        return _conditioned(state, innovation, flow, spread, jnp.ones((), dtype))

    @front_door
    def estimate(self, state: Gaussian) -> State:
        """The mean, shape (n,)."""
        return state.mean


@pytree_dataclass()
class Luenberger:
    """The Luenberger observer, a copy of the plant corrected by the measurement error.

        dx̂/dt = f(x̂, u) + G(x̂) (y − h(x̂))                                                     (12.3)

    with y = dy/dt constant over a step. One exponential Euler step in Rosenbrock's form: exact if the right-hand side
    is affine, otherwise of order 2, and stable for any gain and dt for which the error equation is stable.

    Args:
      problem: the plant; only its drift is used.
      h: the measured function of one state, returns shape (p,).
      gain: G, shape (n, p), per unit time, in units of x per unit of y, or a function of the estimate that returns
        this matrix.
      start: x̂ at t = 0, shape (n,).
    Raises:
      ValueError: a game, a problem that depends on time, an h or a gain of the wrong shape.
      TypeError: an argument that is not a Problem, an h that cannot be called, entries that are not numbers.

    Example:
      >>> observer = Luenberger(Problem(lambda x, u: -x), lambda x: x, [[3.0]], [0.0])
      >>> estimate = observer.update(observer.initial(), jnp.zeros(0), 1.0 * jnp.ones(1), 1.0)  # y = 1
      >>> round(float(estimate[0]), 4)  # ¾ (1 − e⁻⁴)
      0.7363
    """

    plant: Problem
    measurement: Measurement
    gain: Any
    start: Any

    @front_door
    def __init__(
        self, problem: Problem, h: Callable, gain: Callable | Numbers | Sequence, start: Numbers | Sequence[float]
    ):
        name = "Luenberger"
        first = _start(start, f"{name}: start")
        n = first.shape[0]
        fields = {
            "plant": plant(problem, n, name),
            "measurement": measurement(h, n, 0.0, name, perfect=True),
            "start": first,
        }
        fields["gain"] = _gain(gain, (n, fields["measurement"].dim), name)
        for field, value in fields.items():
            object.__setattr__(self, field, value)

    @front_door
    def initial(self) -> State:
        """x̂ at t = 0, shape (n,)."""
        return jnp.asarray(self.start, jnp.result_type(float))

    @front_door
    def update(self, state: State, u: Control, dy: Array | None, dt: Number) -> State:
        """x̂ after applying the control u (m,) for dt and measuring the increment dy (p,), or None."""
        check_vector(state, "Luenberger.update: the estimate", len(self.start), "one entry per state")
        check_step("Luenberger.update", self.plant, self.measurement.dim, (u, dy, dt))
        n, dtype = state.shape[0], state.dtype
        dt = jnp.asarray(dt, dtype)
        u = jnp.asarray(u, dtype)
        y = None if dy is None else jnp.asarray(dy, dtype) / dt  # the mean of y over the step

        def rate(x: State) -> jax.Array:
            if y is None:
                return jnp.asarray(self.plant.drift(x, u), dtype)
            gain = jnp.asarray(self.gain(x) if callable(self.gain) else self.gain, dtype)
            return jnp.asarray(self.plant.drift(x, u), dtype) + gain @ (y - self.measurement.at(x))

        _, shift, _ = affine_flow(jax.jacfwd(rate)(state), rate(state), jnp.zeros((n, n), dtype), dt, states=n)
        return state + shift

    @front_door
    def estimate(self, state: State) -> State:
        """x̂ itself."""
        return state


def _conditioned(law: Gaussian, innovation: Array, flow: Array, spread: Array, least: Array) -> Gaussian:
    """The law of the state given the measurement.

    Args:
      law: the predicted mean, shape (n,), and the covariance P before the step, shape (n, n).
      innovation: the measurement minus its mean, in units of its noise, shape (p,).
      flow: the rows of the state and of the measurement, shape (n + p, n). Their covariance is flow P flowᵀ + spread.
      spread: the covariance of the added noise, shape (n + p, n + p).
      least: the variance of the measurement noise.
    """
    n = len(law.mean)
    joint = flow @ law.covariance @ flow.T + spread
    sizes = jnp.sqrt(jnp.maximum(jnp.diagonal(joint)[n:], least))
    p = len(sizes)
    correlation = joint[n:, n:] / jnp.outer(sizes, sizes)
    if p > 1:  # the correlation of sensors that agree up to rounding is singular; regularising it averages them
        correlation = correlation + ROUNDINGS * p * jnp.finfo(joint.dtype).eps * jnp.eye(p, dtype=joint.dtype)
    gain = jnp.linalg.solve(correlation, joint[n:, :n] / sizes[:, None]).T / sizes
    # a sum of two congruences; the usual difference of covariances can become negative for nearly exact sensors
    keep = jnp.concatenate([jnp.eye(n, dtype=joint.dtype), -gain], axis=1)
    carried = keep @ flow
    covariance = carried @ law.covariance @ carried.T + keep @ spread @ keep.T
    return Gaussian(law.mean + gain @ innovation, (covariance + covariance.T) / 2)


def affine_flow(matrix: Array, source: Array, noise: Array, dt: Number, *, states: int) -> tuple[Array, Array, Array]:
    """Φ, s and Q after the time dt, shapes (k, k), (k,) and (k, k), see the top of the module.

    Args:
      matrix: F, shape (k, k); only its first ``states`` columns may be nonzero.
      source: g, shape (k,).
      noise: W, shape (k, k), symmetric and nonnegative.
      dt: the length of the step, in units of time.
      states: the number of entries that feed back. The others are integrals of these entries, so their units do not
        affect the number of doublings or the rounding.
    """
    inner = jnp.abs(matrix[:states, :states])
    # both norms bound the spectral radius; take the smaller, as the units of the states may differ widely
    rate = jnp.minimum(jnp.max(jnp.sum(inner, axis=0)), jnp.max(jnp.sum(inner, axis=1)))
    halvings = jnp.ceil(jnp.log2(jnp.maximum(rate * dt / SHORT, 1)))
    halvings = jnp.where(jnp.isfinite(halvings), jnp.clip(halvings, 0, DOUBLINGS), 0)
    piece = dt * jnp.exp2(-halvings)

    def add(j: int, carry: tuple) -> tuple:
        # t^j F^j/j!, t^{j+1} F^j g/(j+1)!, and the terms of Q with the recursion T_{j+1} = F T_j + T_j Fᵀ
        sums, (power, push, spread) = carry[:3], carry[3]
        half = matrix @ spread
        power, push, spread = (
            matrix @ power * (piece / j), matrix @ push * (piece / (j + 1)), (half + half.T) * (piece / (j + 1))
        )  # fmt: skip
        return sums[0] + power, sums[1] + push, sums[2] + spread, (power, push, spread)

    first = jnp.eye(len(source), dtype=matrix.dtype), piece * source, piece * noise
    transition, shift, covariance, _ = jax.lax.fori_loop(1, TERMS, add, (*first, first))

    def double(_: int, carry: tuple) -> tuple:
        transition, shift, covariance = carry
        return (
            transition @ transition,
            shift + transition @ shift,
            covariance + transition @ covariance @ transition.T,
        )

    return jax.lax.fori_loop(0, halvings.astype(jnp.int32), double, (transition, shift, covariance))


def _start(given: Numbers | Sequence[float], name: str) -> Any:
    """A state, shape (n,), of finite numbers."""
    state = numbers(given, name)
    if np.ndim(state) != 1 or np.size(state) == 0 or (not is_traced(state) and not np.all(np.isfinite(state))):
        raise ValueError(f"{name} is {given!r}, wanted finite numbers of shape (n,), one per state")
    return state


def _covariance(given: Numbers | Sequence, n: int, name: str) -> Any:
    """A covariance, shape (n, n), symmetric and without negative eigenvalues."""
    matrix = numbers(given, name)
    if np.shape(matrix) not in ((n,), (n, n)):
        raise ValueError(f"{name} has shape {np.shape(matrix)}, wanted ({n}, {n}), or ({n},) for independent entries")
    if is_traced(matrix):
        return jnp.diag(matrix) if matrix.ndim == 1 else matrix
    matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
    variances = np.diag(matrix)
    slack = ROUNDINGS * n * np.finfo(np.float64).eps
    ok = bool(np.all(np.isfinite(matrix)) and np.all(variances >= 0))
    if ok:  # check correlations, which have no units; an entry with variance zero must have no correlations
        scale = np.sqrt(np.where(variances > 0, variances, 1))
        correlation = matrix / np.outer(scale, scale)
        ok = bool(np.all(np.abs(correlation - correlation.T) <= slack) and np.linalg.eigvalsh(correlation)[0] >= -slack)
    if not ok:
        raise ValueError(
            f"{name} is {given!r}, wanted a symmetric matrix of finite numbers without negative eigenvalues"
        )
    return (matrix + matrix.T) / 2


def _gain(given: Callable | Numbers | Sequence, wanted: tuple[int, int], name: str) -> Any:
    """G as a matrix or as a function of the estimate that returns a matrix."""
    if callable(given):
        function: Any = as_partial(given, f"{name}: gain")
        with own_settings(x64=True):
            shape = jax.eval_shape(lambda x: jnp.asarray(function(x)), np.zeros(wanted[0])).shape
    else:
        function = numbers(given, f"{name}: gain")
        shape = np.shape(function)
        if not is_traced(function) and not np.all(np.isfinite(function)):
            raise ValueError(f"{name}: gain is {given!r}, wanted finite numbers")
    if shape != wanted:
        raise ValueError(f"{name}: gain has shape {shape}, wanted (n, p) = {wanted}: one column per measured quantity")
    return function
