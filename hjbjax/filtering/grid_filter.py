"""Grid filter: the law of the state given the measurements, for any drift, noise and h.

A step of length dt of the Duncan–Mortensen–Zakai equation is split symmetrically (G. Strang),

    q ← e^{ℓ/2} q,    q ← e^{𝓛* dt} q,    q ← e^{ℓ/2} q,    ℓ = hᵀR⁻¹dy − ½ hᵀR⁻¹h dt.

The factors are exact for a state that does not move. The middle step conserves mass and keeps q ≥ 0 for any dt and any
record, see ``markov_chain.forward_equation``. The splitting has order 2 in dt along a smooth record. The likelihood of
a noisy record has order 1, because an increment does not show when within its interval the noise arrived. In space the
order is 2 where the law is smooth, by central differences or a limited flux, see ``markov_chain.transport``. The
factors are multiplied as logarithms after subtracting the largest product, so nothing overflows or vanishes. The
subtracted logarithms add up to the log-likelihood.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import correlated_noise
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import jump_rates
from hjbjax.discretisation.schemes import Upwind
from hjbjax.filtering import resolution
from hjbjax.filtering.measurement import Measurement, check_step, measurement, plant, sample_of
from hjbjax.markov_chain import forward_equation, transport
from hjbjax.markov_chain.decision_process import refuse
from hjbjax.markov_chain.forward_equation import advanced, cells
from hjbjax.problem import sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import cast, front_door, is_traced, numbers, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Control, DType, Field, Number, Numbers, State
from hjbjax.solution.status import warn
from hjbjax.tracing import checks, components


@pytree_dataclass()
class Density:
    """The law of the state on a grid, and the likelihood of the record so far.

    Args:
      density: at the nodes, (*grid), in 1/(units of the states); ``sum(density * grid.volumes())`` is 1.
      log_likelihood: log ∫q, the log-likelihood of the record relative to pure noise.
    """

    density: Any
    log_likelihood: Any


@pytree_dataclass(static=("axes",))
class GridFilter:
    """The law of the state given the measurements, on a grid: an ``Observer`` for any drift, noise and h.

    One update is a step of the Duncan–Mortensen–Zakai equation (12.6), see ``zakai``. The information state is a
    ``Density``. The box must contain the state of the plant, with room to spare. A step costs 2⌈dt max Q⌉ passes over
    the nodes, where Q = Σ |f_i|/h_i + a_ii/h_i² is the rate at which the chain leaves a node. |f_i|/h_i counts twice
    along axes with little or no noise, where the flux is limited.

    Args:
      problem: the plant; only its drift, controls and noise are used.
      h: the measured function of one state, returns shape (p,).
      grid: the nodes.
      initial_density: the density of the state at t = 0, a function of one state that returns a number ≥ 0, or (*grid).
        It need not be normalised.

    Keyword Args:
      measurement_noise: r in dy = h(x) dt + r dv: a number, (p,) or (p, p).

    Raises:
      ValueError: a game, a problem that depends on time, open ends, functions that have the wrong shape or are not
        finite at a node, noise that the chain cannot represent, or an initial density that is negative or zero.
      TypeError: an argument that is not a Problem or a Grid, or an h that cannot be called.

    Warns outside ``jit`` and ``vmap`` if the law is narrower than a cell or if dt is longer than r/(σ|h'|). The warning
    names a sufficient spacing or dt.

    Example:
      >>> grid = Grid([-3.0], [3.0], (61,))
      >>> filter = GridFilter(Problem(lambda x, u: -x, noise=1.0), lambda x: x, grid, lambda x: jnp.exp(-x @ x))
      >>> state = filter.update(filter.initial(), jnp.zeros(0), 0.1 * jnp.ones(1), 0.1)  # y = 1
      >>> bool(0 < filter.estimate(state)[0] < 0.1), round(float(jnp.sum(state.density * grid.volumes())), 5)
      (True, 1.0)
    """

    plant: Problem
    grid: Grid
    measurement: Measurement
    signal: Any  # r⁻¹ h at the nodes, (p, *grid)
    prior: Any  # the density at t = 0, (*grid)
    volumes: Any  # volumes of the nodes, (*grid)
    cells: Any  # cells of the chain's law, (*grid)
    axes: tuple[int, ...]  # where the noise is too small for central differences, see ``markov_chain.transport``

    @front_door
    def __init__(
        self,
        problem: Problem,
        h: Callable,
        grid: Grid,
        initial_density: Callable | Numbers,
        *,
        measurement_noise: Numbers | Sequence = 1.0,
    ):
        name = "GridFilter"
        if not isinstance(grid, Grid):
            raise TypeError(f"{name}: got {type(grid).__name__} for the grid, wanted a Grid")
        checks.refuse_prescribed(grid, name, "which prescribe V and not the law of the state")
        if grid.sides("open"):
            raise ValueError(
                f"{name}: got a grid with open ends, where mass would leave; choose edges='projected', and a box with "
                "room for the state"
            )
        system = plant(problem, grid.ndim, name)
        measured = measurement(h, grid.ndim, measurement_noise, name)
        # numbers that are known inside ``jit`` are computed at once, not traced
        with own_settings(x64=True), jax.ensure_compile_time_eval():
            on = Discretisation(*cast((system, grid), np.float64), Upwind(), np.dtype(np.float64))
            axes = tuple(range(grid.ndim)) if is_traced(system, grid) else _check_rates(on, name)
            fields = {
                "plant": system,
                "grid": grid,
                "measurement": measured,
                "signal": signal(on, cast(measured, np.float64), name),
                "prior": _prior(on, initial_density, name),
                "volumes": grid.volumes(),
                "cells": cells(on),
                "axes": axes,
            }
        for field, value in fields.items():
            object.__setattr__(self, field, value)

    @front_door
    def initial(self) -> Density:
        """The law at t = 0, with likelihood one."""
        density = jnp.asarray(self.prior, jnp.result_type(float))
        return Density(density, jnp.zeros((), density.dtype))

    @front_door
    def update(self, state: Density, u: Control, dy: Array | None, dt: Number) -> Density:
        """The law after applying the control u (m,) for dt and measuring the increment dy (p,), or None."""
        self.check_state(state)
        check_step("GridFilter.update", self.plant, self.measurement.dim, (u, dy, dt))
        after = self._after(state, u, dy, dt)
        if dy is not None and not is_traced(self, after):
            self.warn_if_coarse("GridFilter.update", np.asarray(after.density)[None], float(dt))
        return after

    @front_door
    def correct(self, state: Density, y: Array, *, measurement_noise: Numbers | Sequence) -> Density:
        """The law after a sample y = h(x) + s v, shape (p,), at one time: Bayes' rule.

        Args:
          state: the law before.
          y: the sample, shape (p,), in the units of h.

        Keyword Args:
          measurement_noise: s, a number, (p,) or (p, p), standard deviations in the units of h.

        Raises:
          ValueError: a sample or a noise of the wrong shape, or not finite.
        """
        name = "GridFilter.correct"
        self.check_state(state)
        sampled = sample_of(self.measurement, y, measurement_noise, name)
        dtype = state.density.dtype
        # the signal is r⁻¹ h: convert it back to h, then to units of s
        h = jnp.tensordot(jnp.asarray(self.measurement.root, dtype), jnp.asarray(self.signal, dtype), 1)
        signal = sampled.whitened(h.reshape(len(h), -1)).reshape(h.shape)
        seen = sampled.whitened(jnp.asarray(y, dtype))
        exponent = jnp.tensordot(seen, signal, 1) - jnp.sum(signal**2, axis=0) / 2
        probability, gained = _weighed(self.probability(state), exponent)
        after = Density(self._density(probability), state.log_likelihood + gained)
        if not is_traced(self, after):
            self.warn_if_coarse(name, np.asarray(after.density)[None], 0.0)
        return after

    def warn_if_coarse(self, name: str, densities: np.ndarray, dt: float) -> None:
        """Warn if a law is narrower than a cell, or if the noise of the state undoes a measurement within a step.

        Args:
          name: the function the user called.
          densities: the law at some times, shape (k, *grid).
          dt: the time between two measurements, or 0 for a sample.
        """
        with own_settings(x64=True), jax.ensure_compile_time_eval():
            masses = np.asarray(densities, np.float64) * np.asarray(self.cells)
            laws = masses / np.sum(masses, axis=tuple(range(1, masses.ndim)), keepdims=True)
            resolution.warn_if_coarse(name, self._on(np.dtype(np.float64)), np.asarray(self.signal), laws, dt)

    def _after(self, state: Density, u: Control, dy: Array | None, dt: Number, most: int | None = None) -> Density:
        """The law one step later, with ``most`` sub-steps if their number must be known beforehand."""
        dtype = state.density.dtype
        dt, u = jnp.asarray(dt, dtype), jnp.asarray(u, dtype)
        if dy is None:
            moved = advanced(self._on(dtype), self.probability(state), u, dt, most, axes=self.axes)
            return Density(self._density(moved), state.log_likelihood)
        signal = jnp.asarray(self.signal, dtype)
        seen = self.measurement.whitened(jnp.asarray(dy, dtype))
        # half of ℓ before the state moves, half after
        half = (jnp.tensordot(seen, signal, 1) - jnp.sum(signal**2, axis=0) * (dt / 2)) / 2
        probability, before = _weighed(self.probability(state), half)
        probability = advanced(self._on(dtype), probability, u, dt, most, axes=self.axes)
        probability, after = _weighed(probability, half)
        return Density(self._density(probability), state.log_likelihood + before + after)

    @front_door
    def estimate(self, state: Density) -> State:
        """The mean, shape (n,); along periodic axes the circular mean, inside the box. See ``zakai``."""
        return forward_equation.mean(self.grid, self.probability(state))

    @front_door
    def covariance(self, state: Density) -> jax.Array:
        """The covariance about the estimate, shape (n, n)."""
        return forward_equation.covariance(self.grid, self.probability(state))

    @front_door
    def probability(self, state: Density) -> Field:
        """The probability of each node, shape (*grid), with sum 1: the density times the cell of the node."""
        self.check_state(state)
        mass = state.density * jnp.asarray(self.cells, state.density.dtype)
        return mass / jnp.sum(mass)

    @front_door
    def mode(self, state: Density) -> State:
        """The node at which the density is largest, shape (n,)."""
        return forward_equation.mode(self.grid, state.density)

    def check_state(self, state: Density) -> None:
        """Refuse the state of another filter or of another grid."""
        if not isinstance(state, Density) or np.shape(state.density) != self.grid.shape:
            got = f"shape {np.shape(state.density)}" if isinstance(state, Density) else f"a {type(state).__name__}"
            raise ValueError(f"GridFilter: got {got} for the state, wanted a Density of shape {self.grid.shape}")

    def _on(self, dtype: DType) -> Discretisation:
        return Discretisation(*cast((self.plant, self.grid), dtype), Upwind(), dtype)

    def _density(self, probability: Field) -> Field:
        density = probability / jnp.asarray(self.cells, probability.dtype)
        return density / jnp.sum(density * jnp.asarray(self.volumes, probability.dtype))


def warn_at_ends(name: str, grid: Grid, places: Array, dt: float, what: str) -> None:
    """Warn if an estimate is at an end of the box, where the filter cannot follow the state.

    Args:
      name: the function the user called.
      grid: the nodes.
      places: the estimates along a record, shape (..., k, n).
      dt: the time between two estimates.
      what: the name of the estimate.
    """
    if not np.any(off := at_ends(grid, places)):
        return
    *_, step, axis = np.argwhere(off)[np.argmin(np.argwhere(off)[:, -2])]
    warn(
        f"{name}: {what} is at an end of the box on axis {axis} after {np.sum(np.any(off, axis=-1))} of "
        f"{off[..., 0].size} measurements, first at t = {(step + 1) * dt:.6g}.\n"
        "The filter knows nothing beyond the box. If the state can leave it, use a larger box; otherwise ignore this.",
        UserWarning,
    )


def at_ends(grid: Grid, places: Array) -> np.ndarray:
    """True where a state is at an end of the box of an axis, shape (..., n)."""
    lo, hi = np.asarray(grid.lo), np.asarray(grid.hi)
    return ((np.asarray(places) <= lo) | (np.asarray(places) >= hi)) & ~np.asarray(grid.periodic)


def states_of(grid: Grid) -> Array:
    """The states of all nodes, shape (*grid, n), in JAX's type."""
    dtype = np.dtype(jnp.result_type(float))
    return jnp.stack([jnp.broadcast_to(part, grid.shape) for part in cast(grid, dtype).components(dtype)], axis=-1)


def check_within(known: Grid, asked: Grid, name: str) -> None:
    """Refuse a filter whose grid extends beyond the grid of the solution."""
    if known.ndim != asked.ndim or known.periodic != asked.periodic:
        raise ValueError(
            f"{name}: the solution's grid has {known.ndim} axes, periodic {known.periodic}, and the filter's grid has "
            f"{asked.ndim}, periodic {asked.periodic}; wanted the same axes"
        )
    if is_traced(known, asked):
        return
    boxes = [np.asarray(end, np.float64) for end in (known.lo, known.hi, asked.lo, asked.hi)]
    slack = 64 * np.finfo(np.float64).eps * (boxes[1] - boxes[0])  # the two boxes may be rounded differently
    if np.any(boxes[2] < boxes[0] - slack) or np.any(boxes[3] > boxes[1] + slack):
        raise ValueError(
            f"{name}: the filter's box from {boxes[2].tolist()} to {boxes[3].tolist()} leaves the solution's box from "
            f"{boxes[0].tolist()} to {boxes[1].tolist()}, outside which V is not known; solve on a larger box"
        )


def _weighed(probability: Field, exponent: Field) -> tuple[Field, jax.Array]:
    """Probabilities times e^exponent, normalised, and the logarithm of their sum before normalising."""
    positive = probability > 0
    # subtract the largest product, not the largest factor: there may be no mass where the factor is large
    logarithm = jnp.where(positive, jnp.log(jnp.where(positive, probability, 1)) + exponent, -jnp.inf)
    largest = jax.lax.stop_gradient(jnp.max(logarithm))
    weight = jnp.exp(logarithm - largest)
    total = jnp.sum(weight)
    return weight / total, largest + jnp.log(total)


def signal(on: Discretisation, measured: Measurement, name: str) -> Any:
    """r⁻¹ h at the nodes, shape (p, *grid); refused if it is not finite."""
    entries = components.components(measured.h, on.coordinates(), dtype=on.dtype)
    h = jnp.stack([jnp.broadcast_to(entry, on.grid.shape) for entry in entries])
    refuse("h(x) is not finite", ~jnp.all(jnp.isfinite(h), axis=0), on.grid, name)
    white = measured.whitened(h.reshape(len(h), -1)).reshape(h.shape)
    return white if is_traced(white) else np.asarray(white)


def _prior(on: Discretisation, given: Callable | Numbers, name: str) -> Any:
    """The initial density, shape (*grid), of integral one."""
    if callable(given):
        checks.function_of(given, f"{name}: initial_density", (), x=(on.grid.ndim,))
    density = on.at_nodes(given) if callable(given) else numbers(given, f"{name}: initial_density")
    if np.shape(density) != on.grid.shape:
        raise ValueError(
            f"{name}: initial_density has shape {np.shape(density)}, wanted the shape of the grid, {on.grid.shape}, or "
            "a function of one state"
        )
    if is_traced(density):
        return density / jnp.sum(density * on.grid.volumes())
    density = np.asarray(density)
    refuse("initial_density is not a finite number ≥ 0", ~(np.isfinite(density) & (density >= 0)), on.grid, name)
    if not np.any(density):
        raise ValueError(
            f"{name}: initial_density is zero at every node, wanted mass on at least one. A peak narrower than the "
            "spacing may fall between two nodes."
        )
    density = density / np.max(density)  # before the sum, which could overflow
    return density / np.sum(density * on.grid.volumes())


def _check_rates(on: Discretisation, name: str) -> tuple[int, ...]:
    """Refuse drift or noise that is not finite at a node, and correlated noise that the chain cannot represent.

    Returns:
      The axes whose noise is too small for central differences, at some node and some control.
    """
    largest = np.zeros(on.grid.ndim)
    for u in sets.probes(on.problem.controls, on.dtype)[:3]:
        leaving, lacking, upwinded = _look(on, u)
        refuse("a jump rate, made of drift and noise, is not finite", ~jnp.isfinite(leaving), on.grid, name)
        refuse("the noise is correlated more than the spacings allow", lacking, on.grid, name)
        largest = np.maximum(largest, np.asarray(upwinded))
    return tuple(int(axis) for axis in np.flatnonzero(largest))


@jax.jit
def _look(on: Discretisation, u: list) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Q at every node, the nodes at which correlated noise leaves a negative rate, and the upwinded rates per axis."""
    short = correlated_noise.lacking(on, on.diffusion(u))
    lacking = jnp.broadcast_to(jnp.zeros((), bool) if short is None else short, on.grid.shape)
    return jump_rates(on, u).total(), lacking, transport.largest_rates(on, u)
