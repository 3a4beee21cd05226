"""Steps short enough for functions of time, found by sampling these between the times that a march would use.

A march evaluates its functions at the ends of its steps. Over a hundred steps of T = 1 the cost 1 + cos(200πt) is 2 at
each of them, and a pulse of width 0.004 is at none. Before a march the functions are therefore sampled in some states,
192 times in each of a hundred equal parts of the horizon. With ḡ their trapezoidal rule on the ends of the steps,

    Σ over steps |∫ g dt − ḡ Δt| ≤ 0.002 ∫ |g| dt        for drift, cost and noise,
    no excursion beyond both ends of a step by more than 0.02 (max g − min g)  for target, ψ and running maximum

determine the number of steps, up to 64, for each part of the horizon; for smooth functions it is one.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem import sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import AdmissibleSet
from hjbjax.problem.types import Array, DType
from hjbjax.solution.status import warn

PARTS = 100  # parts of the horizon, each at least one step long
CUTS = (1, 2, 4, 8, 16, 32, 64)  # numbers of steps per part
PLACES = 6  # states, each with its own actions
INTEGRATED = ("drift", "cost", "noise", "growth", "killing")  # the last is a function of the state
INSIDE = 2  # samples inside the shortest steps, at random, since an oscillation could fit between regular samples
INTEGRAL, LEVEL = 2e-3, 2e-2
WARNS = 2e-2  # relative error of the integral with the shortest steps
PULSES = 16  # shortest steps with an excursion of a level; more than this are not a single pulse


@dataclasses.dataclass(frozen=True)
class Resolution:
    """The steps required by the functions of time, and the remaining errors.

    Attributes:
      lengths: the longest step in each part of the horizon, shape (PARTS,), from t = 0 on.
      errors: the relative error of the integrals for each number of steps per part, shape (len(CUTS),).
      left: the relative error with these lengths.
      unsteady: True if the levels change faster than the shortest steps.
    """

    lengths: np.ndarray
    errors: np.ndarray
    left: float
    unsteady: bool


def resolution(problem: Problem, grid: Grid, horizon: float, dtype: DType) -> Resolution:
    """The steps that a problem's functions of time require; host level."""
    finest = PARTS * CUTS[-1]
    ends = np.linspace(0.0, horizon, finest + 1)
    random = np.random.default_rng(0)
    shares = random.uniform(size=(finest, INSIDE))
    inside = ends[:-1, None] + horizon / finest * shares
    times = np.concatenate([ends, inside.ravel()])
    found = _sample(problem, *_places(problem, grid, random, dtype), jnp.asarray(times, dtype))
    errors, deviations, pulses = np.zeros((len(CUTS), PARTS)), np.zeros((len(CUTS), PARTS)), 0
    for name, seen in found.items():
        values = np.asarray(seen, float)
        values = np.where(np.isfinite(values), values, 0.0)
        at_ends, between = values[: finest + 1], values[finest + 1 :].reshape(finest, INSIDE, *values.shape[1:])
        if name in INTEGRATED:
            np.maximum(errors, _of_integral(at_ends, between, shares), out=errors)
        else:
            found_here, count = _of_level(at_ends, between)
            np.maximum(deviations, found_here, out=deviations)
            pulses = max(pulses, count)
    cuts = np.maximum(_enough_for_integrals(errors), _enough_for_levels(deviations))
    # a step may begin in one part and end in the one before it
    cuts = np.maximum(cuts, np.append(cuts[:1], cuts[:-1]))
    left = float(np.sum(errors[cuts, np.arange(PARTS)]))
    return Resolution(horizon / PARTS / np.array(CUTS)[cuts], errors.sum(axis=1), left, pulses > PULSES)


def warn_of_fast_changes(found: Resolution, horizon: float, step: float | None) -> None:
    """Warn of functions that change faster than the steps, or than the given step."""
    if step is None:
        if found.left > WARNS or found.unsteady:
            warn(
                f"the functions of time change faster than steps of {horizon / PARTS / CUTS[-1]:.3g}, the shortest "
                "used for them; pass a shorter step=, or replace oscillating functions by their mean"
            )
        return
    place = sum(cut <= horizon / PARTS / step * (1 + 1e-9) for cut in CUTS) - 1
    error, shortest = float(found.errors[max(place, 0)]), float(np.min(found.lengths))
    if error > WARNS and shortest < step:
        warn(
            f"the functions of time change within steps of step = {step:.3g}: they are off by "
            f"{error:.0%} of their integral; remove step, or use at most {shortest:.3g}"
        )


def _places(problem: Problem, grid: Grid, random: np.random.Generator, dtype: DType) -> tuple[Any, Any, Any]:
    """States (K, n) and actions of both players (K, m), (K, l)."""
    lo, hi = np.asarray(grid.lo, float), np.asarray(grid.hi, float)
    states = lo + (hi - lo) * random.uniform(size=(PLACES, grid.ndim))

    def actions(admissible: AdmissibleSet | None) -> np.ndarray:
        points = np.zeros((1, 0)) if admissible is None else np.asarray(sets.samples(admissible, PLACES))
        return np.take(points, random.integers(len(points), size=PLACES), axis=0)

    x, u, d = (jnp.asarray(each, dtype) for each in (states, actions(problem.controls), actions(problem.disturbances)))
    return x, u, d


@jax.jit
def _sample(problem: Problem, x: Array, u: Array, d: Array, times: Array) -> dict[str, jax.Array]:
    """The problem's functions at all times and places, each of shape (times, places, entries)."""
    acting = {name: getattr(problem, name) for name in INTEGRATED[:-1]}
    levels = {name: getattr(problem, name) for name in (INTEGRATED[-1], "target", "stopping_cost", "running_max")}

    def at(t: Array, x: Array, u: Array, d: Array) -> dict[str, jax.Array]:
        action, state = problem.arguments(x, u, d, t), problem.state_arguments(x, t)
        asked = [(name, each, action) for name, each in acting.items()]
        asked += [(name, each, state) for name, each in levels.items()]
        return {
            name: jnp.ravel(jnp.asarray(function(*given), x.dtype)) for name, function, given in asked
            if callable(function)
        }  # fmt: skip

    return jax.vmap(lambda t: jax.vmap(lambda x, u, d: at(t, x, u, d))(x, u, d))(times)


def _of_integral(at_ends: np.ndarray, between: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """The error of the trapezoidal rule in each part for each number of steps, relative to the integral of |g|."""
    finest, shortest = len(between), 1.0 / len(between)
    # the trapezoidal rule on the shortest steps, and a random sample of its error, which is zero where g is linear
    shares = shares[..., None, None]
    straight = (1 - shares) * at_ends[:-1, None] + shares * at_ends[1:, None]
    means = (at_ends[1:] + at_ends[:-1]) / 2 + (between - straight).mean(axis=1)
    # one scale per entry over all places, otherwise a place where it nearly vanishes would dominate
    size = np.max(np.abs(means).mean(axis=0), axis=0)
    scale = np.where(size > 0, size, np.inf)
    rows = []
    for cut in CUTS:
        width = CUTS[-1] // cut
        corners = at_ends[::width]
        exact = means.reshape(finest // width, width, *means.shape[1:]).mean(axis=1)
        off = np.abs(exact - (corners[1:] + corners[:-1]) / 2) * shortest * width
        rows.append(np.max(off.reshape(PARTS, cut, *off.shape[1:]).sum(axis=1) / scale, axis=(1, 2)))
    return np.stack(rows)


def _of_level(at_ends: np.ndarray, between: np.ndarray) -> tuple[np.ndarray, int]:
    """The largest excursion beyond both ends of a step, relative to the range, per part; and their number."""
    finest = len(between)
    extent = max(float(np.ptp(at_ends)), float(np.ptp(between)))
    if extent == 0:
        return np.zeros((len(CUTS), PARTS)), 0
    rows = []
    for cut in CUTS:
        width = CUTS[-1] // cut
        corners = at_ends[::width]
        first, last = corners[:-1, None], corners[1:, None]
        lowest, highest = np.minimum(first, last), np.maximum(first, last)
        inside = between.reshape(finest // width, width * between.shape[1], *between.shape[2:])
        off = np.maximum(np.maximum(lowest - inside, inside - highest), 0) / extent
        rows.append(np.max(off.reshape(PARTS, -1), axis=1))
    return np.stack(rows), int(np.sum(np.max(off.reshape(finest, -1), axis=1) > LEVEL))


def _enough_for_integrals(errors: np.ndarray) -> np.ndarray:
    """The index into ``CUTS`` for each part with which the error of the integrals is small enough."""
    chosen, parts = np.zeros(PARTS, int), np.arange(PARTS)
    while np.sum(errors[chosen, parts]) > INTEGRAL:
        now = np.where(chosen < len(CUTS) - 1, errors[chosen, parts], 0)
        if np.max(now) <= INTEGRAL / PARTS / 10:  # shorter steps do not help
            break
        chosen += now >= np.max(now) / 2
    return chosen


def _enough_for_levels(deviations: np.ndarray) -> np.ndarray:
    """The index into ``CUTS`` for each part with which the levels are resolved."""
    good = deviations <= LEVEL
    return np.where(good.any(axis=0), np.argmax(good, axis=0), len(CUTS) - 1)
