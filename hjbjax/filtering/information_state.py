"""The stochastic information state: the law of the state given a record of measurements.

    dq = 𝓛^{u*} q dt + q hᵀ R⁻¹ dy,   q(0) = p₀,   R = r rᵀ                                           (12.6)

is the Duncan–Mortensen–Zakai equation for dx = f(x, u) dt + σ dw, dy = h(x) dt + r dv. Its solution q is the
unnormalised law of the state. q/∫q is the law (W. M. Wonham; H. J. Kushner; R. L. Stratonovich), and ∫q is the
likelihood of the record relative to pure noise. This module runs the steps of ``grid_filter`` along a record.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.filtering.grid_filter import Density, GridFilter, warn_at_ends
from hjbjax.filtering.measurement import check_length, controls_of, record_of
from hjbjax.markov_chain.forward_equation import MOST, substeps
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_jax, cast, front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, Numbers


@pytree_dataclass()
class InformationState:
    """The law of the state after each increment of a record; a batch of records adds a leading axis to every array.

    Args:
      density: at the nodes, shape (k, *grid), in 1/(units of the states); the initial density is not included.
      mean: shape (k, n), circular along periodic axes.
      covariance: shape (k, n, n).
      mode: shape (k, n), the node at which the density is largest.
      log_likelihood: shape (k,), log ∫q, the log-likelihood of the record so far relative to pure noise.
    """

    density: Any
    mean: Any
    covariance: Any
    mode: Any
    log_likelihood: Any


@front_door
def zakai(
    problem: Problem,
    h: Callable,
    grid: Grid,
    dy: Numbers | Sequence,
    dt: Number,
    initial_density: Callable | Numbers,
    *,
    controls: Numbers | Sequence | None = None,
    measurement_noise: Numbers | Sequence = 1.0,
    normalised: bool = True,
) -> InformationState:
    """The law of the state given a record of increments, on a grid: the Duncan–Mortensen–Zakai equation.

        dq = 𝓛^{u*} q dt + q hᵀ R⁻¹ dy,    q(0) = p₀                                                   (12.6)

    for dx = f(x, u) dt + σ dw and dy = h(x) dt + r dv, R = r rᵀ. The density is ≥ 0 with mass one up to rounding, for
    any dt and record. The mean and covariance of a linear system have order 2 in dt; the ``log_likelihood`` of a noisy
    record has order 1. All have order 2 in the spacing where the law is smooth: by central differences if the noise of
    the axis makes them monotone, a_ii ≥ h|f_i|, and by a limited flux elsewhere. The result holds all k densities; a
    ``GridFilter`` holds only the last.

    Computes in float64. Under a tracer it computes in the type of the record and has forward derivatives (``jacfwd``),
    and outside ``jit`` and ``vmap`` also reverse derivatives (``grad``).
    Along a periodic axis the mean is circular, the angle of the mean of e^{iθ} wrapped into the box. The covariance
    uses differences from this mean, taken the short way round.

    Args:
      problem: the plant; only its drift, controls and noise are used.
      h: the measured function of one state, returns shape (p,).
      grid: the nodes; the box must contain the state.
      dy: the increments of the record, shape (k, p), or (batch, k, p).
      dt: the time between two increments.
      initial_density: a function of one state that returns a number ≥ 0, or (*grid); it need not be normalised.

    Keyword Args:
      controls: the controls applied over the k steps, shape (k, m) or (batch, k, m); ``None`` without controls.
      measurement_noise: r: a number, (p,) or (p, p), in units of y times time^½.
      normalised: True for densities with integral one; False for q itself, which may overflow over long records.

    Returns:
      An ``InformationState`` of NumPy arrays, or of JAX arrays under a tracer.

    Raises:
      ValueError: a record or controls that are not finite or have the wrong shape; dt ≤ 0; arguments that
        ``GridFilter`` refuses; a law that is not finite, for example because dt needs too many sub-steps.
      TypeError: as for ``GridFilter``.

    Warns if the mode is at an end of the box, if the law is narrower than a cell, or if dt is longer than r/(σ|h'|),
    the time in which the noise of the state undoes a measurement. The warning names a sufficient spacing or dt.

    Example:
      >>> rest = Problem(lambda x, u: 0 * x)  # a measured constant with prior variance 1
      >>> grid, record = Grid([-8.0], [8.0], (161,)), np.full((10, 1), 0.2)  # dy over ten steps
      >>> law = zakai(rest, lambda x: x, grid, record, 0.1, lambda x: jnp.exp(-x @ x / 2))
      >>> round(float(law.mean[-1, 0]), 9), round(float(law.covariance[-1, 0, 0]), 9)  # y(1) = 2: 2/(1 + 1)
      (1.0, 0.5)
    """
    name = "zakai"
    observer = GridFilter(problem, h, grid, initial_density, measurement_noise=measurement_noise)
    record = record_of(dy, f"{name}: dy", observer.measurement.dim, batches=True)
    acts = controls_of(controls, f"{name}: controls", problem, np.shape(record)[:-1])
    check_length(dt, f"{name}: dt", "the time between two increments")
    run = _run if record.ndim == 2 else _run_batch  # one record needs no batch axis, which takes time to compile
    if is_traced(observer, record, acts, dt):
        # integers have no derivative, so under ``grad`` the count is a plain number and the loop has a known length,
        # which a reverse derivative needs; under ``jit`` and ``vmap`` the count is traced and the loop stays open
        count = _substeps(observer, record, acts, dt)
        return run(as_jax(observer), record, acts, dt, bool(normalised), None if is_traced(count) else int(count))
    # inside a caller's ``jit`` too, known numbers are computed at once
    with jax.core.eval_context(), own_settings(x64=True):
        answer = run(*cast((observer, record, acts, dt), np.float64), bool(normalised))
        found = jax.tree.map(np.asarray, answer)
    bad = ~np.isfinite(found.mean[..., 0])
    if np.any(bad):
        step = int(np.argwhere(bad)[:, -1].min())
        raise ValueError(
            f"{name}: the law is not finite from step {step} on. Either dt = {dt:g} needs more than {MOST} sub-steps, "
            "or a measurement rules out every state.\nUse a shorter dt, a coarser grid, or a larger measurement_noise."
        )
    warn_at_ends(name, grid, found.mode, float(dt), "the mode of the law")
    densities = found.density if record.ndim == 2 else found.density[0]  # all records of a batch share noise and dt
    observer.warn_if_coarse(name, densities, float(dt))
    return found


@jax.jit
def _substeps(observer: GridFilter, record: Array, acts: Array, dt: Number) -> jax.Array:
    """The largest number of sub-steps that any step of a record needs."""
    on, rows = observer._on(record.dtype), jnp.reshape(acts, (record.size // record.shape[-1], acts.shape[-1]))
    return jnp.max(jax.lax.map(lambda u: substeps(on, u, dt, observer.axes), rows))


def _law(
    observer: GridFilter, record: Array, acts: Array, dt: Number, normalised: bool, most: int | None
) -> InformationState:
    """The information state after each increment of one record (k, p) under controls (k, m)."""
    dtype = record.dtype

    def step(state: Density, row: tuple[Array, Array]) -> tuple[Density, InformationState]:
        state = observer._after(state, row[1], row[0], dt, most)
        # the filter keeps the norm as a logarithm, because a long record would overflow
        factor = 1.0 if normalised else jnp.exp(state.log_likelihood)
        shown = InformationState(
            density=state.density * factor,
            mean=observer.estimate(state),
            covariance=observer.covariance(state),
            mode=observer.mode(state),
            log_likelihood=state.log_likelihood,
        )
        return state, shown

    first = Density(jnp.asarray(observer.prior, dtype), jnp.zeros((), dtype))
    # the backward pass repeats the sub-steps, so that only one density per step is stored
    return jax.lax.scan(step if most is None else jax.checkpoint(step), first, (record, acts))[1]


@jax.jit(static_argnums=(4, 5))
def _run(
    observer: GridFilter, record: Array, acts: Array, dt: Number, normalised: bool, most: int | None = None
) -> InformationState:
    """The law along one record."""
    return _law(observer, record, acts, dt, normalised, most)


@jax.jit(static_argnums=(4, 5))
def _run_batch(
    observer: GridFilter, record: Array, acts: Array, dt: Number, normalised: bool, most: int | None = None
) -> InformationState:
    """The law along each of a batch of records."""
    return jax.vmap(lambda dy, u: _law(observer, dy, u, dt, normalised, most))(record, acts)
