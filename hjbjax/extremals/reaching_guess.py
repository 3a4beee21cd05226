"""First guesses that come to the end: straight at the edge of a target, and under the best constant control.

A costate of zero is the worst of guesses: where effort costs u is zero under it, nothing moves, and whatever the final
time is, the equations say the same: their Jacobian is singular. At the edge of a target p = ψ_x + ν l_x, and H = βψ −
ψ_t − ν l_t has at most two roots ν, since H is a minimum of functions that are affine in p, so concave in ν. The first
positive one is the costate of a path that comes from outside.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem, Closing
from hjbjax.extremals.initial_guess import COLUMNS, straight_line
from hjbjax.hamiltonian import pointwise
from hjbjax.problem.sets import samples
from hjbjax.problem.types import Array, Control, State

NEWTON = 50  # steps to the edge of a target, on which a distance needs one, and its square some ten
POWERS = np.arange(-80.0, 81.0)  # of two: values of ν, whose units are those of cost over those of l
FINER = np.linspace(0.0, 1.0, 65)  # between two of them, to two digits
BUDGET = 16  # constant controls that are tried


def toward_target(bvp: BoundaryValueProblem, duration: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and columns (x, p, w) straight to the edge of the target; None where no ν is found.

    Args:
      bvp: closed by a target, with the law of the minimum.
      duration: of the path.
    """
    arrays = jax.tree.map(jnp.asarray, bvp)
    edge = _edge(arrays, bvp.start, duration)
    at = _conditions_of_nu(arrays, edge, duration, np.exp2(POWERS))
    below = np.flatnonzero((at[:-1] > 0) & (at[1:] <= 0))
    if not len(below):  # no input reaches l directly, say; nothing is known of ν
        return None
    between = np.exp2(POWERS[below[0]]) * (1 + FINER)
    nu = between[np.argmin(np.abs(_conditions_of_nu(arrays, edge, duration, between)))]
    costate, paid = (np.asarray(part) for part in _end_of(arrays, edge, duration, nu))
    times = np.linspace(0, duration, COLUMNS)
    states = bvp.start[:, None] + (edge - bvp.start)[:, None] * times / duration
    constant = np.repeat(np.append(costate, paid)[:, None], COLUMNS, 1)
    return times, np.concatenate([states, constant])


def under_constant_control(bvp: BoundaryValueProblem, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and columns (x, p, w) under the constant control that comes nearest to the end, with the line's costates.

    From rest a line need not be a path at all: a body without speed stays where it is, whatever its heading.

    Args:
      bvp: closed by end states or a target.
      duration: the longest that the path may take. It stops where it is nearest, and is slowed down if T is given.
    """
    assert bvp.problem.controls is not None
    arrays, times = jax.tree.map(jnp.asarray, bvp), np.linspace(0, duration, COLUMNS)
    tried = np.asarray(samples(bvp.problem.controls, BUDGET), float)
    paths, levels = (np.asarray(part) for part in _paths(arrays, tried, times))  # (controls, COLUMNS, n)
    if bvp.closing is Closing.TARGET:
        away = np.abs(levels)
    else:
        # a speed and a length: each in units of how far it gets at all
        off = (paths - bvp.ends)[..., np.array(bvp.held)]
        size = np.nanmax(np.where(np.isfinite(off), np.abs(off), 0), axis=(0, 1))
        away = np.linalg.norm(off / np.where(size > 0, size, 1), axis=-1)
    away = np.where(np.isfinite(away), away, np.inf)
    away[:, 0] = np.inf  # a path takes time
    which, last = np.unravel_index(np.argmin(away), away.shape)
    if not np.isfinite(away[which, last]):
        return straight_line(bvp, duration)
    times = times[: last + 1] * (1.0 if bvp.free else duration / times[last])
    line = straight_line(bvp, float(times[-1]))[1][bvp.n :, : last + 1]
    return times, np.concatenate([paths[which, : last + 1].T, line])


def _edge(bvp: BoundaryValueProblem, start: State, duration: float) -> np.ndarray:
    """A state where l = 0, by Newton's method along the slopes of l; the last one that is finite."""
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
    """l and its slope."""
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

    def one(nu):
        p = _end_of(bvp, x, t, nu)[0]
        u = pointwise.minimiser(bvp.problem, bvp.rule, t, bvp.wrap(x), p)
        return bvp.hamiltonian(t, x, p, u) - bvp.problem.discount * paid + waiting + nu * sliding

    return jax.vmap(one)(nu)


@jax.jit
def _paths(bvp: BoundaryValueProblem, tried: Array, times: Array) -> tuple[jax.Array, jax.Array]:
    """States under constant controls by the Runge–Kutta method of order 4, and l along them; zeros without a target."""

    def drift(t: Array, x: State, u: Control) -> jax.Array:
        return jnp.asarray(bvp.problem.drift(*bvp.problem.arguments(bvp.wrap(x), u, t=t)), x.dtype)

    def path(u):
        def step(x, span):
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
