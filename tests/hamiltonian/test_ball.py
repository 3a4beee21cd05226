"""Exact minima over a ball of quadratics plus piecewise linear gains, against scans of the ball."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from piecewise_gains import NODES, gain, random_pieces
from scipy.optimize import minimize
from systems import SEEDS

import hjbjax as hjb
from hjbjax.discretisation.players import combinations
from hjbjax.hamiltonian.ball import kinked_ball, least_in_ball
from hjbjax.hamiltonian.piecewise import Kinked

pytestmark = pytest.mark.usefixtures("float64")


@functools.partial(jax.jit, static_argnames=("sign", "curved"))
def best_in_ball(sign, pieces, linear, square, radius, directions, curved):
    made = [Kinked(functools.partial(gain, k, d), b, s, list(k), list(d)) for b, s, k, d in zip(*pieces, strict=True)]
    made[-1] = None  # an input that drives nothing

    def value(action):
        result = sum(b * u + c * u * u for b, c, u in zip(linear, square, action, strict=True))
        return result + sum(p.gain(p.offset + p.slope * u) for p, u in zip(made[:-1], action[:-1], strict=True))

    action = kinked_ball(sign, radius, list(linear), list(square), made, curved=curved)
    around = [radius * directions[:, j, None] for j in range(len(linear))]
    return jnp.stack(action), value(action), value(around)


@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize(
    ("dim", "kinks"), [(2, 1), *(pytest.param(*each, marks=pytest.mark.slow) for each in [(1, 1), (3, 1), (2, 3)])]
)
@given(seed=SEEDS)
@settings(max_examples=15)
def test_a_ball_is_optimal_over_a_scan(dim, kinks, curved, seed):
    """Gains convex and concave, squares of very different size, some of them zero, and balls of one point."""
    rng = np.random.default_rng(seed)
    pieces, linear = random_pieces(rng, dim, kinks), rng.normal(size=(dim, NODES))
    radius = rng.uniform(0, 2) * rng.choice([0.0, 1.0], p=[0.1, 0.9])
    square = np.zeros((dim, NODES))
    if curved:
        square = 10.0 ** rng.uniform(-3, 2, (dim, NODES)) * rng.choice([0.0, 1.0], (dim, NODES), p=[0.2, 0.8])
        linear *= rng.choice([0.0, 1.0], (dim, NODES), p=[0.2, 0.8])
    sphere = rng.normal(size=(2000, dim))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    directions = np.concatenate([sphere, sphere * rng.uniform(0, 1, (2000, 1)) ** (1 / dim), np.zeros((1, dim))])
    for sign in (1, -1):
        action, value, scan = map(
            np.asarray, best_in_ball(sign, pieces, linear, sign * square, radius, directions, curved)
        )
        assert np.all(np.linalg.norm(action, axis=0) <= radius * (1 + 1e-12))
        assert np.all(sign * value <= np.min(sign * scan, axis=0) + 1e-9)


@pytest.mark.parametrize(
    "units", [pytest.param(1.0, marks=pytest.mark.slow), pytest.param(1e-7, marks=pytest.mark.slow), 1e6]
)
def test_the_least_quadratic_in_a_ball_against_scipy(units):
    """Of one cell the optimum to rounding, also where the quadratic is concave, where b = 0, and of any size."""
    rng = np.random.default_rng(5)
    for dim in (1, 2, 3, 4):
        slope, square = rng.normal(size=(2, dim, 40))
        slope[:, :5], slope[0, 5:10], square[:, 10:20] = 0, 0, np.abs(square[:, 10:20])
        found = np.stack(jax.jit(least_in_ball)(0.7, list(slope * units), list(square * units)))

        assert np.all(np.linalg.norm(found, axis=0) <= 0.7 * (1 + 1e-12))
        inside = {"type": "ineq", "fun": lambda u: 0.49 - u @ u, "jac": lambda u: -2 * u}
        for b, c, mine in zip(slope.T, square.T, found.T, strict=True):

            def value(u, b=b, c=c):
                return b @ u + c @ u**2

            # a local search from many starts: the global optimum is among what it finds
            starts = rng.normal(size=(12, dim))
            starts *= 0.6 / np.linalg.norm(starts, axis=1, keepdims=True)
            ends = (
                minimize(
                    value, start, jac=lambda u, b=b, c=c: b + 2 * c * u, constraints=inside, options={"ftol": 1e-12}
                ).x
                for start in starts
            )
            best = min(value(u * min(1, 0.7 / max(np.linalg.norm(u), 1e-12))) for u in ends)
            assert value(mine) <= best + 1e-7


def test_the_optimum_in_a_ball_has_two_derivatives():
    """min (b·u + Σ c u²) has the gradient u and a Hessian, inside the ball and on its sphere, against differences."""

    def least(b):
        u = jnp.stack(least_in_ball(0.5, list(b), [0.3, 1.0, 2.0]))
        return b @ u + jnp.array([0.3, 1.0, 2.0]) @ u**2

    value, gradient, bend = jax.jit(least), jax.jit(jax.grad(least)), jax.jit(jax.hessian(least))
    for b in (np.array([0.1, -0.2, 0.3]), np.array([1.0, -2.0, 3.0]), np.array([0.02, 4.0, 1.0])):
        h = 1e-4 * np.eye(3)
        np.testing.assert_allclose(gradient(b), [(value(b + e) - value(b - e)) / 2e-4 for e in h], atol=1e-8)
        differences = [(gradient(b + e) - gradient(b - e)) / 2e-4 for e in h]
        np.testing.assert_allclose(bend(b), differences, atol=1e-7)


@pytest.mark.parametrize("curved", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_slopes_of_an_optimum_are_its_actions(curved):
    """∂/∂b of min (b·u + ...) is u, by the formulas' own derivatives: finite also where inputs sit at kinks."""
    rng = np.random.default_rng(3)
    pieces, linear = random_pieces(rng, 3, 1), rng.normal(size=(3, NODES))
    square = 10.0 ** rng.uniform(-2, 1, (3, NODES)) if curved else np.zeros((3, NODES))
    linear[:, 0] = 0  # a node at which nothing pulls but the gains

    def total(linear, radius):
        return jnp.sum(best_in_ball(1, pieces, linear, square, radius, np.zeros((1, 3)), curved)[1])

    action = best_in_ball(1, pieces, linear, square, 0.8, np.zeros((1, 3)), curved)[0]
    slope, room = jax.grad(total, argnums=(0, 1))(linear, 0.8)
    np.testing.assert_allclose(slope, action, atol=1e-9)
    differences = (total(linear, 0.8 + 1e-6) - total(linear, 0.8 - 1e-6)) / 2e-6
    assert float(room) == pytest.approx(float(differences), abs=1e-7)


def pushed(x, u):
    return 0.3 * jnp.sin(x) + u


def question(weight):
    return hjb.Problem(pushed, lambda x, u: jnp.sum(jnp.cos(x)) + weight * jnp.sum(u * u), hjb.Ball(1.0, 2), discount=1)


def test_a_certificate_says_where_the_optimum_may_be_missed():
    """Effort that costs: exact; that is earned: a quadratic on the sphere may have a second optimum."""
    grid = hjb.Grid([-np.pi] * 2, [np.pi] * 2, (9, 9), periodic=[True, True])
    for weight, sampled in ((0.5, False), (-0.1, True)):
        solution = hjb.solve(question(weight), grid, scheme=hjb.Upwind())
        assert ("searched" in solution.stats["certificate"]) == sampled
        assert (solution.bounds is None) == sampled


def test_how_many_combinations_are_tried():
    assert (combinations([2, 2, 2]), combinations([4, 4]), combinations([1, 2])) == (27, 49, 3)
