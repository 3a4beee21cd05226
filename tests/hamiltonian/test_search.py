"""Minimisers against brute force: scans of the admissible set, one node at a time."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from systems import SEEDS

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.players import find_players
from hjbjax.hamiltonian import discrete
from hjbjax.hamiltonian.optimum import optimise
from hjbjax.hamiltonian.search import UNROLL, enumerate_actions, optimum, refine

pytestmark = pytest.mark.usefixtures("float64")
NODES = 6
laws = settings(max_examples=30)


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


@pytest.mark.slow
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
        alone = optimum(functools.partial(wavy, parameters), points, sign, weight=weight)
        assert np.allclose(alone, value, rtol=1e-12, atol=1e-12)


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
        alone = optimum(lambda action: objective(action)[0], points, sign)
        assert value[0] == alone[0] == best
        assert jnp.isnan(value[1])
        assert jnp.isnan(alone[1])


@pytest.mark.parametrize("worst", [jnp.inf, -jnp.inf])
def test_an_action_that_may_not_be_taken_is_not_taken(worst):
    points = jnp.arange(4.0)[:, None]
    sign = 1 if worst > 0 else -1
    found = optimum(lambda action: jnp.where(action[0] < 2, worst, action[0]) * jnp.ones(2), points, sign)
    assert found.tolist() == [2.0 if sign > 0 else 3.0] * 2


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


@pytest.mark.parametrize("sign", [1, -1])
def test_moves_one_by_one_are_those_of_a_round(sign):
    """What is compiled once and made many times finds the same action, to the last bit."""
    points = jnp.asarray(np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 2), -1).reshape(-1, 2))
    peak = jnp.linspace(-0.9, 0.9, 7)

    def objective(action):
        return sign * ((action[0] - peak) ** 2 + jnp.abs(action[1] - peak**2) + 0.3 * action[0] * action[1]), []

    def found(weight):
        best = enumerate_actions(objective, points, sign, weight=weight, most=weight)
        return refine(objective, best, [0.5, 0.5], lambda a: [jnp.clip(u, -1, 1) for u in a], sign, weight=weight)

    together, apart = found(1), found(100)
    for one, other in zip(jax.tree.leaves(together), jax.tree.leaves(apart), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_search_inside_a_search_is_compiled_in_few_places():
    """With all samples of the inner player written out at every place of the outer one XLA got 4,958 lines."""
    problem = hjb.Problem(
        lambda x, u, d: jnp.maximum(u, 0) + jnp.maximum(d, 0) * jnp.cos(x),
        lambda x, u, d: x @ x + 0.1 * u @ u,
        hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.0], [1.0]),
        discount=1.0,
    )
    grid = hjb.Grid([-1.0], [1.0], (11,))
    players = find_players(problem, 1, jnp.float32)
    assert not players.control.exact
    assert not players.disturbance.exact

    def best(value):
        return optimise(discrete.around(Discretisation(problem, grid, hjb.Upwind(), value.dtype), value))

    assert len(jax.jit(best).lower(jnp.zeros(11)).as_text().splitlines()) < 1500


def test_a_search_goes_along_a_kink_of_two_inputs():
    """|u + v/2 - s| + (u - p)² + (v - q)²: one input at a time stopped where it met the kink, up to .04 too high."""
    draws = np.random.default_rng(3)
    s, (p, q) = jnp.asarray(draws.uniform(-0.3, 0.3, 40)), jnp.asarray(draws.uniform(-0.4, 0.4, (2, 40)))

    def objective(action):
        u, v = action
        return jnp.abs(u + v / 2 - s) + (u - p) ** 2 + (v - q) ** 2, []

    points = jnp.stack(jnp.meshgrid(*[jnp.linspace(-1, 1, 5)] * 2, indexing="ij"), -1).reshape(-1, 2)
    best = enumerate_actions(objective, points, 1)
    value, _, _ = refine(objective, best, [0.5, 0.5], lambda action: [jnp.clip(u, -1, 1) for u in action], 1)
    off = np.abs(p + q / 2 - s)  # of the parabola's own minimum; less than 5/8 are held by the kink
    least = np.where(off < 0.625, off**2 / 1.25, off - 0.3125)
    assert np.all(value >= least - 1e-12)
    np.testing.assert_allclose(value, least, rtol=0, atol=5e-3)
    assert np.median(value - least) < 1e-3
