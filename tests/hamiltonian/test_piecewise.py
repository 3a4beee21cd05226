"""Exact minima of quadratics plus piecewise linear gains, against scans of the admissible set."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from systems import SEEDS

from hjbjax.hamiltonian.piecewise import Kinked, kinked_ball, piecewise_input, piecewise_pair

NODES = 6


@pytest.fixture(autouse=True, scope="module")
def _float64():
    with jax.enable_x64(True):
        yield


def random_pieces(rng, count, kinks):
    """For each piece: offset, slope, sorted kinks and the slopes between them; some slopes are zero."""
    offset = rng.normal(size=(count, NODES))
    slope = rng.normal(size=(count, NODES)) * rng.choice([0.0, 1.0], (count, NODES), p=[0.2, 0.8])
    at = np.sort(rng.uniform(-1.5, 1.5, (count, kinks, NODES)), axis=1)
    return offset, slope, at, rng.normal(size=(count, kinks + 1, NODES))


def gain(at, derivatives, f):
    """The continuous piecewise linear function that is zero at zero kinks' origin and has these slopes."""
    total = derivatives[0] * f
    for kink, below, above in zip(at, derivatives[:-1], derivatives[1:], strict=True):
        total = total + (above - below) * jnp.maximum(f - kink, 0)
    return total


def pieces_of(offset, slope, at, derivatives):
    return [
        Kinked(functools.partial(gain, k, d), b, s, list(k), list(d))
        for b, s, k, d in zip(offset, slope, at, derivatives, strict=True)
    ]


def total(pieces, linear, square, u):
    return linear * u + square * u * u + sum(gain(k, d, b + s * u) for b, s, k, d in zip(*pieces, strict=True))


@functools.partial(jax.jit, static_argnames=("sign", "curved"))
def best_input(sign, pieces, linear, square, lo, hi, curved):
    u = piecewise_input(sign, lo, hi, linear, square, pieces_of(*pieces), curved=curved)
    scan = lo + (hi - lo) * jnp.linspace(0, 1, 1001)[:, None]
    return u, total(pieces, linear, square, u), total(pieces, linear, square, scan)


@pytest.mark.parametrize(("count", "kinks"), [(0, 0), (1, 1), (2, 1), (3, 1), (1, 3), (2, 3)])
@pytest.mark.parametrize("curved", [False, True])
@given(seed=SEEDS)
@settings(max_examples=15)
def test_one_input_is_optimal_over_a_scan(count, kinks, curved, seed):
    rng = np.random.default_rng(seed)
    pieces = random_pieces(rng, count, kinks)
    linear = rng.normal(size=NODES)
    square = rng.normal(size=NODES) * rng.choice([0.0, 1.0], NODES) if curved else np.zeros(NODES)
    lo, hi = -rng.uniform(0, 2), rng.uniform(0, 2)
    for sign in (1, -1):
        u, value, scan = map(np.asarray, best_input(sign, pieces, linear, square, lo, hi, curved))
        assert np.all((lo <= u) & (u <= hi))
        assert np.all(sign * value <= np.min(sign * scan, axis=0) + 1e-12)


@functools.partial(jax.jit, static_argnames=("sign", "curved"))
def best_pair(sign, pieces, slopes, linear, square, lo, hi, curved):
    offset, _, at, derivatives = pieces
    made = [
        Kinked(functools.partial(gain, k, d), b, tuple(g), list(k), list(d))
        for b, g, k, d in zip(offset, slopes, at, derivatives, strict=True)
    ]

    def value(u):
        gains = sum(p.gain(p.offset + p.slope[0] * u[0] + p.slope[1] * u[1]) for p in made)
        return gains + sum(b * v + c * v * v for b, c, v in zip(linear, square, u, strict=True))

    u = piecewise_pair(sign, lo, hi, list(linear), list(square), made, curved=curved)
    grid = jnp.linspace(0, 1, 101)
    scan = [lo[j] + (hi[j] - lo[j]) * grid.reshape([-1 if k == j else 1 for k in range(2)] + [1]) for j in range(2)]
    return jnp.stack(jnp.broadcast_arrays(*u)), value(u), value(scan)


@pytest.mark.parametrize(
    ("count", "kinks"),
    [(1, 1), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((2, 1), (3, 1), (2, 3)))],
)
@pytest.mark.parametrize("curved", [False, True])
@given(seed=SEEDS)
@settings(max_examples=15)
def test_two_inputs_are_optimal_over_a_scan(count, kinks, curved, seed):
    """Gains convex and concave, costs curved either way or not at all, inputs that drive nothing, parallel kinks."""
    rng = np.random.default_rng(seed)
    pieces = random_pieces(rng, count, kinks)
    slopes = rng.normal(size=(count, 2, NODES)) * rng.choice([0.0, 1.0], (count, 2, NODES), p=[0.2, 0.8])
    slopes[-1, :, 0] = slopes[0, :, 0]
    linear = rng.normal(size=(2, NODES))
    square = rng.normal(size=(2, NODES)) * rng.choice([0.0, 1.0], (2, NODES)) if curved else np.zeros((2, NODES))
    lo, hi = -rng.uniform(0, 2, 2), rng.uniform(0, 2, 2)
    for sign in (1, -1):
        u, value, scan = map(np.asarray, best_pair(sign, pieces, slopes, linear, square, lo, hi, curved))
        assert np.all((lo[:, None] <= u) & (u <= hi[:, None]))
        assert np.all(sign * value <= np.min(sign * scan, axis=(0, 1)) + 1e-11)


@pytest.mark.parametrize("count", [2, 3])
@given(seed=SEEDS)
@settings(max_examples=15)
def test_kinks_that_coincide_hide_no_stationary_point(count, seed):
    """Without drift of its own every component turns at u = 0: no choice of pieces is next to one kink alone."""
    rng = np.random.default_rng(seed)
    offset, slope, at, derivatives = random_pieces(rng, count, 1)
    pieces = (0 * offset, slope, 0 * at, derivatives)
    linear, square = rng.normal(size=NODES), rng.uniform(0.1, 1, NODES)
    _, value, scan = map(np.asarray, best_input(1, pieces, linear, square, -1.5, 1.5, True))
    assert np.all(value <= np.min(scan, axis=0) + 1e-12)
    slopes = rng.normal(size=(count, 2, NODES))
    twice = np.stack([linear, -linear]), np.stack([square, square])
    _, value, scan = map(np.asarray, best_pair(1, pieces, slopes, *twice, -np.ones(2), np.ones(2), True))
    assert np.all(value <= np.min(scan, axis=(0, 1)) + 1e-11)


@functools.partial(jax.jit, static_argnames="sign")
def best_in_ball(sign, pieces, linear, radius, directions):
    made = [Kinked(functools.partial(gain, k, d), b, s, list(k), list(d)) for b, s, k, d in zip(*pieces, strict=True)]
    made[-1] = None  # an input that drives nothing

    def value(action):
        result = sum(slope * u for slope, u in zip(linear, action, strict=True))
        return result + sum(p.gain(p.offset + p.slope * u) for p, u in zip(made[:-1], action[:-1], strict=True))

    action = kinked_ball(sign, radius, list(linear), made)
    around = [radius * directions[:, j, None] for j in range(len(linear))]
    return jnp.stack(action), value(action), value(around)


@pytest.mark.parametrize(("dim", "kinks"), [(1, 1), (2, 1), (3, 1), (2, 3)])
@given(seed=SEEDS)
@settings(max_examples=15)
def test_a_ball_is_optimal_over_a_scan(dim, kinks, seed):
    rng = np.random.default_rng(seed)
    pieces, linear, radius = random_pieces(rng, dim, kinks), rng.normal(size=(dim, NODES)), rng.uniform(0, 2)
    sphere = rng.normal(size=(2000, dim))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    directions = np.concatenate([sphere, sphere * rng.uniform(0, 1, (2000, 1)) ** (1 / dim), np.zeros((1, dim))])
    for sign in (1, -1):
        action, value, scan = map(np.asarray, best_in_ball(sign, pieces, linear, radius, directions))
        assert np.all(np.linalg.norm(action, axis=0) <= radius * (1 + 1e-12))
        assert np.all(sign * value <= np.min(sign * scan, axis=0) + 1e-9)
