"""The stochastic information state: the law of the state given a record of what was measured.

    dq = 𝓛^{u*} q dt + q hᵀ R⁻¹ dy,   q(0) = p₀,   R = r rᵀ                                           (12.6)

is the Duncan–Mortensen–Zakai equation for dx = f(x, u) dt + σ dw, dy = h(x) dt + r dv. Its solution is the unnormalised
law of the state; q/∫q is the law itself (W. M. Wonham; H. J. Kushner; R. L. Stratonovich), and ∫q the likelihood of the
record against that of noise alone. ``grid_filter`` makes the steps, here they are made along a record.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.filtering.grid_filter import Density, GridFilter
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast, is_traced, numbers, pytree_dataclass
from hjbjax.problem.types import Array, Number, Numbers


@pytree_dataclass()
class InformationState:
    """The law of the state after each increment of a record; a batch of records has its axis in front of all.

    Args:
      density: at the nodes, shape (k, *grid), in 1/(units of the states); the initial one is not among them.
      mean: shape (k, n), circular along periodic axes.
      covariance: shape (k, n, n).
      mode: shape (k, n), the node at which the density is largest.
      log_likelihood: shape (k,), log ∫q, of the record so far against that of noise alone.
    """

    density: Any
    mean: Any
    covariance: Any
    mode: Any
    log_likelihood: Any


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

    for dx = f(x, u) dt + σ dw and dy = h(x) dt + r dv, R = r rᵀ. Positive, and of mass one up to rounding, whatever dt
    and the record; of second order in dt, in the spacing of second order where the noise of an axis makes central
    differences monotone, a_ii ≥ h|f_i|, and first elsewhere. All k densities are kept; a ``GridFilter`` keeps the last.
    In float64; under a tracer in the type of the record, with forward derivatives (``jacfwd``).

    Along a periodic axis the mean is the circular one, the angle of the mean of e^{iθ}, brought into the box, and the
    covariance that of the differences from it the short way round.

    Args:
      problem: the plant: its drift, controls and noise matter.
      h: the measured function of one state, returns shape (p,).
      grid: the nodes, whose box holds the state.
      dy: the increments of the record, shape (k, p), or (batch, k, p).
      dt: the time between two of them.
      initial_density: a function of one state that returns a number ≥ 0, or (*grid); it need not be normalised.

    Keyword Args:
      controls: held over the k steps, shape (k, m), or (batch, k, m); ``None`` without controls.
      measurement_noise: r: a number, (p,) or (p, p), in units of y times time^½.
      normalised: whether densities have integral one; else q itself, which may overflow over long records.

    Returns:
      An ``InformationState`` of NumPy arrays, of JAX's under a tracer.

    Raises:
      ValueError: a record or controls that are not finite or of the wrong shape, dt ≤ 0, and what ``GridFilter``
        refuses.
      TypeError: as ``GridFilter``.

    Example:
      >>> rest = Problem(lambda x, u: 0 * x)  # a constant that is measured, of prior variance 1
      >>> grid, record = Grid([-8.0], [8.0], (161,)), np.full((10, 1), 0.2)  # dy over ten steps
      >>> law = zakai(rest, lambda x: x, grid, record, 0.1, lambda x: jnp.exp(-x @ x / 2))
      >>> round(float(law.mean[-1, 0]), 9), round(float(law.covariance[-1, 0, 0]), 9)  # y(1) = 2: 2/(1 + 1)
      (1.0, 0.5)
    """
    name = "zakai"
    observer = GridFilter(problem, h, grid, initial_density, measurement_noise=measurement_noise)
    record = numbers(dy, f"{name}: dy")
    acts = _record_of_controls(record, controls, problem, observer.measurement.dim, name)
    if not is_traced(dt) and not (np.ndim(dt) == 0 and np.isfinite(dt) and dt > 0):
        raise ValueError(f"{name}: dt = {dt!r}; wanted a finite number > 0, the time between two increments")
    run = _run if record.ndim == 2 else _run_batch  # one record needs no batch axis, which takes time to compile
    if is_traced(observer, record, acts, dt):
        return run(observer, record, acts, dt, bool(normalised))
    # inside somebody's ``jit`` as well, what is known is computed here and now
    with jax.core.eval_context(), jax.enable_x64(True):
        answer = run(*cast((observer, record, acts, dt), np.float64), bool(normalised))
        return jax.tree.map(np.asarray, answer)


def _law(observer: GridFilter, record: Array, acts: Array, dt: Number, normalised: bool) -> InformationState:
    """The information state after each increment of one record (k, p) under controls (k, m)."""
    dtype = record.dtype

    def step(state: Density, row: tuple[Array, Array]) -> tuple[Density, InformationState]:
        state = observer.update(state, row[1], row[0], dt)
        # the filter keeps the norm apart, in its logarithm, or a long record would overflow
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
    return jax.lax.scan(step, first, (record, acts))[1]


@jax.jit(static_argnums=4)
def _run(observer: GridFilter, record: Array, acts: Array, dt: Number, normalised: bool) -> InformationState:
    """The law along one record."""
    return _law(observer, record, acts, dt, normalised)


@jax.jit(static_argnums=4)
def _run_batch(observer: GridFilter, record: Array, acts: Array, dt: Number, normalised: bool) -> InformationState:
    """The law along each of a batch of records."""
    return jax.vmap(lambda dy, u: _law(observer, dy, u, dt, normalised))(record, acts)


def _record_of_controls(record: Any, controls: Any, problem: Problem, p: int, name: str) -> Any:
    """The controls as a record of the shape of ``record``, once both are known to be what they should be."""
    if np.ndim(record) not in (2, 3) or np.shape(record)[-1] != p or 0 in np.shape(record):
        raise ValueError(
            f"{name}: dy has shape {np.shape(record)}, wanted (k, {p}), or (batch, k, {p}): one row a step, one column "
            "a measured quantity"
        )
    m = 0 if problem.controls is None else problem.controls.dim
    if controls is None and m > 0:
        raise ValueError(f"{name}: controls is None, but the problem has {m}; give what was applied, shape (k, {m})")
    wanted = (*np.shape(record)[:-1], m)
    acts = np.zeros(wanted) if controls is None else numbers(controls, f"{name}: controls")
    if np.shape(acts) == wanted[1:] and len(wanted) == 3:  # one record of controls for all of the batch
        acts = jnp.broadcast_to(acts, wanted) if is_traced(acts) else np.broadcast_to(acts, wanted)
    if np.shape(acts) != wanted:
        raise ValueError(f"{name}: controls has shape {np.shape(acts)}, wanted {wanted}: one row for each of dy")
    for what, array in (("dy", record), ("controls", acts)):
        bad = 0 if is_traced(array) else int(np.sum(~np.isfinite(array)))
        if bad:
            raise ValueError(f"{name}: {what} has {bad} entries that are not finite, wanted numbers")
    return acts
