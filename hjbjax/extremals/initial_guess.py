"""Initial guesses of extremals, on which the success of the boundary-value solver depends.

The guess from a solution on a grid is its closed loop, with the interpolated DV as the costate. The guess into a rest
point is the closed loop under the Riccati costate, whose control is clipped to the admissible set. Otherwise the guess
is a line between the ends, a line to the boundary of the target, or a path under the best constant control.

A zero costate is a bad guess. If effort has a cost, a zero costate gives u = 0 and nothing moves. The equations then do
not depend on the final time, so their Jacobian is singular. On the boundary of a target p = ψ_x + ν l_x, and the
condition H = βψ − ψ_t − ν l_t has at most two roots ν, because H is a minimum of functions that are affine in p and
therefore concave in ν. The first positive root gives the costate of a path that arrives from outside.
"""

import dataclasses
import warnings
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing
from hjbjax.feedback.simulation import simulate
from hjbjax.hamiltonian import pointwise
from hjbjax.problem.sets import samples
from hjbjax.problem.types import Array, Control, State
from hjbjax.solution.clock import Clock, Stopped
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status

COLUMNS = 101  # mesh nodes of a guess; the solver adds nodes where necessary
SAMPLES = 400  # number of intervals in which a simulated guess keeps its control constant, because a feedback may jump
FAR = 1e3  # times 1 + |x₀|: a simulation that gets there has diverged
NEWTON = 50  # steps to the boundary of a target; a distance takes one, a squared distance about ten
POWERS = np.arange(-80.0, 81.0)  # exponents of two for ν, whose units are the units of cost divided by the units of l
FINER = np.linspace(0.0, 1.0, 65)  # between two powers, for two digits
BUDGET = 16  # number of constant controls to try


class PathWithCostates(Protocol):
    """A path with costates and cost to go, such as an ``Extremal``."""

    @property
    def times(self) -> Array:
        """Increasing times, shape (k+1,)."""

    @property
    def states(self) -> Array:
        """x at these times, shape (k+1, n)."""

    @property
    def costates(self) -> Array:
        """p at these times, shape (k+1, n)."""

    @property
    def values(self) -> Array:
        """The cost to go at these times, shape (k+1,)."""


@jax.jit
def _rest_loop(bvp: BoundaryValueProblem, x: State) -> jax.Array:
    """ẋ under the costate p̄ + P(x − x̄)."""
    assert bvp.rest is not None
    # the flow of the problem instead of a linear feedback, so that the control is clipped to the admissible set
    p = bvp.rest.costate + bvp.rest.matrix @ (x - bvp.rest.state)
    return bvp.flow(0.0, jnp.concatenate([x, p, jnp.zeros(1, x.dtype)]), bvp.arcs[0])[: bvp.n]


@dataclasses.dataclass(frozen=True)
class _Leaving:
    """The event at which a path reaches the distance ``far`` from the origin, where SciPy ends the integration."""

    far: np.floating
    terminal: bool = True

    def __call__(self, t: float, x: np.ndarray) -> np.floating:
        """Negative inside the ball."""
        return np.linalg.norm(x) - self.far


def into_rest(bvp: BoundaryValueProblem, start: State, duration: float, clock: Clock) -> tuple[np.ndarray, np.ndarray]:
    """Times and columns (x, p, w) under the Riccati costate, or of a line to the rest point if this loop diverges."""
    from scipy.integrate import solve_ivp

    arrays, rest = jax.tree.map(jnp.asarray, bvp), bvp.rest
    assert rest is not None
    times, far = np.linspace(0, duration, COLUMNS), FAR * (1 + np.linalg.norm(start))

    def flow(t: float, x: np.ndarray) -> np.ndarray:
        clock.look()
        return np.asarray(_rest_loop(arrays, x))

    with np.errstate(all="ignore"):
        path = solve_ivp(flow, (0, duration), start, t_eval=times, events=_Leaving(far), rtol=1e-5)
    states = path.y  # (n, COLUMNS), or fewer columns if the loop diverged
    if states.shape[1] < len(times) or not np.all(np.isfinite(states)):
        decay = np.exp(-5 * times / duration)  # e⁻⁵ at the end, 0.7 % of the distance
        states = rest.state[:, None] + (start - rest.state)[:, None] * decay
    # p̄ + P(x − x̄) and w̄ + p̄·y + ½ y'Py along the path, as in the end condition
    off = states - rest.state[:, None]
    bent = rest.matrix @ off
    value = rest.value + rest.costate @ off + 0.5 * np.sum(off * bent, axis=0)
    return times, np.concatenate([states, rest.costate[:, None] + bent, value[None]])


def along_loop(bvp: BoundaryValueProblem, solution: Solution, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and columns (x, p, w) of the closed loop of a solution, or of a line if the closed loop does not move."""
    grid, marched = solution.grid, solution.times is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the times already show an early end
        # clamped, because off the grid the control of the nearest point is still a usable guess
        try:
            path = simulate(bvp.problem, solution, bvp.start, duration, hold=duration / SAMPLES, clamp=True)
        except KeyboardInterrupt:
            raise Stopped(Status.INTERRUPTED) from None
    times, states = path.times, path.states
    # with prescribed end states and a free time the loop does not stop: truncate it where it is closest to them
    if not bvp.problem.target and bvp.free and any(bvp.held):
        nearest = int(np.argmin(np.linalg.norm((states - bvp.ends)[:, np.array(bvp.held)], axis=1)))
        if nearest:  # otherwise the prescribed states are closest at the start
            times, states = times[: nearest + 1], states[: nearest + 1]
    if len(times) == 1:  # the path starts in the target
        return straight_line(bvp, duration)
    # keep about half of the 400 intervals, because the solver never coarsens a mesh
    kept = np.unique(np.linspace(0, len(times) - 1, 2 * COLUMNS).astype(int))
    times, states = times[kept], states[kept]
    inside = np.asarray(grid.wrap(states))  # the path is unwound, the grid is not
    where = (times, inside) if marched else (inside,)
    costates, values = solution.costate_at(*where, clamp=True), solution.value_at(*where, clamp=True)
    # V is infinite and DV undefined at nodes from which the target is unreachable
    return times, np.nan_to_num(np.concatenate([states, costates, values[:, None]], axis=1).T, posinf=0.0, neginf=0.0)


def straight_line(bvp: BoundaryValueProblem, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and columns (x, p, w) along a line to the prescribed end states; at rest in x₀ if there are none."""
    times = np.linspace(0, duration, COLUMNS)
    held = np.array(bvp.held)
    # the vector from the end to x₀ in the prescribed states; the other states stay constant
    gap = np.where(held, bvp.start - np.where(held, bvp.ends, 0), 0) if held.any() else np.zeros(bvp.n)
    length = np.linalg.norm(gap)
    states = bvp.start[:, None] - gap[:, None] * times / duration
    # along the line, with p·ẋ = −1, as in H = 1 + p·ẋ = 0 for least time
    if held.any():
        costate = gap * duration / length**2 if length else gap
    else:
        costate = np.asarray(jax.grad(bvp.psi, 1)(jnp.asarray(duration), jnp.asarray(bvp.start)))
    costates = np.repeat(np.nan_to_num(costate)[:, None], len(times), 1)
    return times, np.concatenate([states, costates, np.zeros((1, len(times)))])


def from_extremal(bvp: BoundaryValueProblem, extremal: PathWithCostates) -> tuple[np.ndarray, np.ndarray]:
    """Times and columns (x, p, w) of another extremal, with its start moved to x₀."""
    if np.shape(extremal.states)[1] != bvp.n:
        raise ValueError(f"pontryagin: the guess has {np.shape(extremal.states)[1]} states, wanted {bvp.n}")
    # empty arcs repeat a time, but a mesh must increase
    times, kept = np.unique(extremal.times, return_index=True)
    states, costates, values = (part[kept].T for part in (extremal.states, extremal.costates, extremal.values[:, None]))
    # the shift of the start decays linearly, so that the end still meets its conditions
    moved = (bvp.start - states[:, 0])[:, None] * (1 - times / times[-1]) if times[-1] > 0 else 0.0
    return times, np.concatenate([states + moved, costates, values])


def arc_order(
    bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """The values of the jumping inputs in order along the path, shape (k, m), and their start times, shape (k,).

    Args:
      bvp: the boundary-value problem of a mixture.
      times: increasing.
      columns: (x, p, w) at these times.
      least: the fraction of the time that an arc must last; a shorter arc is replaced by the arc before it.
    """
    which = np.asarray(_dominant_value(bvp, times, columns))
    # runs of one value; remove short runs, then merge neighbours with equal values
    begins = np.flatnonzero(np.append(True, which[1:] != which[:-1]))
    lasting = np.diff(np.append(times[begins], times[-1])) >= least * (times[-1] - times[0])
    begins = begins[lasting]
    begins = begins[np.append(True, which[begins[1:]] != which[begins[:-1]])] if len(begins) else np.zeros(1, int)
    # a switch is between the last sample of one value and the first sample of the next; take the middle
    starts = np.append(times[0], 0.5 * (times[begins[1:]] + times[begins[1:] - 1]))
    return switching_values(bvp)[which[begins]], starts


def switching_values(bvp: BoundaryValueProblem) -> np.ndarray:
    """The values between which the control jumps, shape (K, m)."""
    return np.asarray(_corners(bvp))


@jax.jit
def _corners(bvp: BoundaryValueProblem) -> jax.Array:
    return pointwise.corners(bvp.problem, bvp.rule)


@jax.jit
def _dominant_value(bvp: BoundaryValueProblem, times: Array, columns: Array) -> jax.Array:
    """The index of the value with the largest weight at every time."""

    def one(t: Array, z: Array) -> jax.Array:
        x, p, _ = bvp.split(z)
        return jnp.argmax(bvp.mixture(t, x, p, bvp.arcs[0])[1])

    return jax.vmap(one, (0, 1))(times, columns)


def hamiltonian_size(bvp: BoundaryValueProblem, times: np.ndarray, columns: np.ndarray) -> float:
    """The typical size of the terms of the Hamiltonian along a guess, the initial ε of the smoothing."""
    # 1 if all terms are zero, because the mixture divides by ε
    return float(np.mean(_sizes(bvp, times, columns))) or 1.0


@jax.jit
def _sizes(bvp: BoundaryValueProblem, times: Array, columns: Array) -> jax.Array:
    """The larger of the spread and the mean size of H over the values of the jumping inputs, at every time."""

    def one(t: Array, z: Array) -> jax.Array:
        x, p, _ = bvp.split(z)
        values = pointwise.corners(bvp.problem, bvp.rule)
        energies = jax.vmap(
            lambda value: bvp.hamiltonian(t, x, p, pointwise.at_corner(bvp.problem, bvp.rule, t, bvp.wrap(x), p, value))
        )(values)
        return jnp.maximum(jnp.max(energies) - jnp.min(energies), jnp.mean(jnp.abs(energies)))

    return jax.vmap(one, (0, 1))(times, columns)


def toward_target(bvp: BoundaryValueProblem, duration: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and columns (x, p, w) along a line to the boundary of the target; None if no ν is found.

    Args:
      bvp: a problem that ends at a target, with the law of the minimum.
      duration: the duration of the path.
    """
    arrays = jax.tree.map(jnp.asarray, bvp)
    edge = _edge(arrays, bvp.start, duration)
    at = _conditions_of_nu(arrays, edge, duration, np.exp2(POWERS))
    below = np.flatnonzero((at[:-1] > 0) & (at[1:] <= 0))
    if not len(below):  # for example if no input affects l directly
        return None
    between = np.exp2(POWERS[below[0]]) * (1 + FINER)
    nu = between[np.argmin(np.abs(_conditions_of_nu(arrays, edge, duration, between)))]
    costate, paid = (np.asarray(part) for part in _end_of(arrays, edge, duration, nu))
    times = np.linspace(0, duration, COLUMNS)
    states = bvp.start[:, None] + (edge - bvp.start)[:, None] * times / duration
    constant = np.repeat(np.append(costate, paid)[:, None], COLUMNS, 1)
    return times, np.concatenate([states, constant])


def under_constant_control(bvp: BoundaryValueProblem, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and columns (x, p, w) under the constant control that comes closest to the end, with the line's costates.

    A line may be far from any path: a body at rest cannot move along it without first gaining speed.

    Args:
      bvp: a problem that ends at prescribed states or at a target.
      duration: the longest duration of the path. It stops where it is closest, and is stretched in time if T is fixed.
    """
    assert bvp.problem.controls is not None
    arrays, times = jax.tree.map(jnp.asarray, bvp), np.linspace(0, duration, COLUMNS)
    tried = np.asarray(samples(bvp.problem.controls, BUDGET), float)
    paths, levels = (np.asarray(part) for part in _paths(arrays, tried, times))  # (controls, COLUMNS, n)
    if bvp.closing is Closing.TARGET:
        away = np.abs(levels)
    else:
        # every state in units of its largest deviation, because speeds and lengths have different units
        off = (paths - bvp.ends)[..., np.array(bvp.held)]
        size = np.nanmax(np.where(np.isfinite(off), np.abs(off), 0), axis=(0, 1))
        away = np.linalg.norm(off / np.where(size > 0, size, 1), axis=-1)
    away = np.where(np.isfinite(away), away, np.inf)
    away[:, 0] = np.inf  # exclude the start
    which, last = np.unravel_index(np.argmin(away), away.shape)
    if not np.isfinite(away[which, last]):
        return straight_line(bvp, duration)
    times = times[: last + 1] * (1.0 if bvp.free else duration / times[last])
    line = straight_line(bvp, float(times[-1]))[1][bvp.n :, : last + 1]
    return times, np.concatenate([paths[which, : last + 1].T, line])


def _edge(bvp: BoundaryValueProblem, start: State, duration: float) -> np.ndarray:
    """A state with l = 0 by Newton's method along the gradient of l, or the last finite iterate."""
    x = np.asarray(start, float)
    for _ in range(NEWTON):
        level, slope = (np.asarray(part) for part in _level(bvp, x, duration))
        with np.errstate(all="ignore"):
            step = level * slope / (slope @ slope)
        if not np.all(np.isfinite(step)) or np.all(x - step == x):
            break
        x = x - step
    return x


@jax.jit
def _level(bvp: BoundaryValueProblem, x: State, t: Array) -> tuple[jax.Array, jax.Array]:
    """The target function l and its gradient."""
    return jax.value_and_grad(bvp.level, 1)(t, x)


@jax.jit
def _end_of(bvp: BoundaryValueProblem, x: State, t: Array, nu: Array) -> tuple[jax.Array, jax.Array]:
    """ψ_x + ν l_x, and ψ."""
    paid, slope = jax.value_and_grad(bvp.psi, 1)(t, x)
    return slope + nu * jax.grad(bvp.level, 1)(t, x), paid


def _conditions_of_nu(bvp: BoundaryValueProblem, x: State, t: float, nu: np.ndarray) -> np.ndarray:
    """H − βψ + ψ_t + ν l_t for every ν."""
    return np.asarray(_free_time(bvp, x, t, nu))


@jax.jit
def _free_time(bvp: BoundaryValueProblem, x: State, t: Array, nu: Array) -> jax.Array:
    paid, waiting = jax.value_and_grad(bvp.psi, 0)(t, x)
    sliding = jax.grad(bvp.level, 0)(t, x)

    def one(nu: Array) -> jax.Array:
        p = _end_of(bvp, x, t, nu)[0]
        u = pointwise.minimiser(bvp.problem, bvp.rule, t, bvp.wrap(x), p)
        return bvp.hamiltonian(t, x, p, u) - bvp.problem.discount * paid + waiting + nu * sliding

    return jax.vmap(one)(nu)


@jax.jit
def _paths(bvp: BoundaryValueProblem, tried: Array, times: Array) -> tuple[jax.Array, jax.Array]:
    """States under constant controls by the classical Runge–Kutta method, and l along them (zero without a target)."""

    def drift(t: Array, x: State, u: Control) -> jax.Array:
        return jnp.asarray(bvp.problem.drift(*bvp.problem.arguments(bvp.wrap(x), u, t=t)), x.dtype)

    def path(u: Control) -> tuple[jax.Array, jax.Array]:
        def step(x: State, span: jax.Array) -> tuple[State, State]:
            t, h = span[0], span[1] - span[0]
            k1 = drift(t, x, u)
            k2 = drift(t + h / 2, x + h / 2 * k1, u)
            k3 = drift(t + h / 2, x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + drift(t + h, x + h * k3, u))
            return x, x

        spans = jnp.stack([times[:-1], times[1:]], axis=1)
        states = jnp.concatenate([bvp.start[None], jax.lax.scan(step, bvp.start, spans)[1]])
        levels = jnp.zeros(len(times)) if bvp.problem.target is None else jax.vmap(bvp.level)(times, states)
        return states, levels

    return jax.vmap(path)(tried)
