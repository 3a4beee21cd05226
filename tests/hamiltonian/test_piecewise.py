"""Exact minima of quadratics plus piecewise linear gains, against scans of the admissible set."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from piecewise_gains import NODES, gain, random_pieces
from systems import SEEDS

from hjbjax.hamiltonian.piecewise import Kinked, piecewise_input, piecewise_pair

pytestmark = pytest.mark.usefixtures("float64")


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


@pytest.mark.parametrize(
    ("count", "kinks"),
    [(0, 0), (2, 3), *(pytest.param(*each, marks=pytest.mark.slow) for each in [(1, 1), (2, 1), (3, 1), (1, 3)])],
)
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


@pytest.mark.parametrize("count", [2, pytest.param(3, marks=pytest.mark.slow)])
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
