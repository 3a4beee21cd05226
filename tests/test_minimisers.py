"""Minimisers against brute force: scans of the admissible set, one node at a time."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from systems import SEEDS

from hjbjax.minimisers import UNROLL, Kinked, enumerate_actions, kinked_ball, piecewise_input, refine

NODES = 6
laws = settings(max_examples=30)


@pytest.fixture(autouse=True, scope="module")
def _float64():
    with jax.enable_x64(True):
        yield


def wavy(parameters, action):
    """A function of two inputs with many minima at every node."""
    p, q, r = parameters
    u, v = action
    return jnp.sin(p * u + q) + jnp.cos(r * v - u) + 0.1 * p * v


@functools.partial(jax.jit, static_argnames=("sign", "weight"))
def enumerated(parameters, points, sign, weight):
    def objective(action):
        return wavy(parameters, action), [action[0] + 2 * action[1]]

    return enumerate_actions(objective, points, sign, weight=weight)


@pytest.mark.parametrize("count", [UNROLL, UNROLL + 21])
@pytest.mark.parametrize("weight", [1, 7])
@given(seed=SEEDS)
@settings(max_examples=5)
def test_every_way_of_enumerating_finds_the_same(count, weight, seed):
    rng = np.random.default_rng(seed)
    parameters, points = rng.normal(size=(3, NODES)), rng.uniform(-2, 2, (count, 2))
    table = np.array([wavy(parameters, point) for point in points])
    for sign in (1, -1):
        value, action, extra = jax.device_get(enumerated(parameters, points, sign, weight))
        best = np.argmin(sign * table, axis=0)
        assert np.allclose(value, np.take_along_axis(table, best[None], 0)[0], rtol=1e-12, atol=1e-12)
        assert np.array_equal(np.stack(action, axis=-1), points[best])
        assert np.allclose(extra[0], action[0] + 2 * action[1], rtol=1e-14)


@pytest.mark.parametrize("count", [5, UNROLL + 6])
def test_the_first_of_equals_wins(count):
    """⌊|k − 2|/2⌋ is 1, 0, 0, 0, 1, 1, 2, 2, ...: the least is first at 1, the largest at 0 or at the last pair."""

    def objective(action):
        return jnp.floor(abs(action[0] - 2) / 2) * jnp.ones(3), []

    points = jnp.arange(float(count))[:, None]
    assert enumerate_actions(objective, points, 1)[1][0].tolist() == [1.0] * 3
    assert enumerate_actions(objective, points, -1)[1][0].tolist() == [0.0 if count == 5 else count - 2.0] * 3


@pytest.mark.parametrize("count", [3, UNROLL + 6])
def test_a_nan_surfaces_where_it_is_and_nowhere_else(count):
    points = jnp.arange(float(count))[:, None]
    spoiled = jnp.array([False, True])

    def objective(action):
        return jnp.where(spoiled & (action[0] == 1), jnp.nan, action[0]), []

    for sign, best in ((1, 0.0), (-1, count - 1.0)):
        value = enumerate_actions(objective, points, sign)[0]
        assert value[0] == best
        assert jnp.isnan(value[1])


@given(seed=SEEDS)
@laws
def test_refinement_ends_at_the_minimum_of_a_smooth_function(seed):
    rng = np.random.default_rng(seed)
    centre, tilt = rng.uniform(-1.5, 1.5, (2, NODES)), rng.uniform(-0.5, 0.5, NODES)
    for sign in (1, -1):
        value, action = jax.device_get(_refined(centre, tilt, sign))
        clipped = np.clip(centre, -1, 1)
        if np.all(tilt == 0) or np.all(clipped == centre):
            assert np.allclose(np.stack(action), clipped, atol=1e-5)
        scan = np.linspace(-1, 1, 201)
        u, v = np.meshgrid(scan, scan, indexing="ij")
        p, q = u[..., None] - centre[0], v[..., None] - centre[1]
        assert np.all(sign * value <= np.min(p * p + q * q + tilt * p * q, axis=(0, 1)) + 1e-9)


@functools.partial(jax.jit, static_argnames="sign")
def _refined(centre, tilt, sign):
    def objective(action):
        p, q = action[0] - centre[0], action[1] - centre[1]
        return sign * (p * p + q * q + tilt * p * q), []

    points = jnp.stack(jnp.meshgrid(*(jnp.linspace(-1, 1, 5),) * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    best = enumerate_actions(objective, points, sign)
    value, action, _ = refine(objective, best, [0.5, 0.5], lambda action: [jnp.clip(u, -1, 1) for u in action], sign)
    return value, action


# --- piecewise linear gains ---


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


def test_slope_above_a_kink_counts_at_the_kink():
    piece = Kinked(abs, 0.0, 1.0, (0.0,), (-1.0, 1.0))
    assert [float(piece.derivative(f)) for f in (-1.0, 0.0, 2.0)] == [-1.0, 1.0, 1.0]


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
