"""Minima over a simplex, against oracles in NumPy: sorting, and lattices that are refined around their best points."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from scipy.optimize import minimize
from torus import SHAPE, SPACING, found

import hjbjax as hjb
from hjbjax.hamiltonian import pointwise
from hjbjax.hamiltonian.simplex import least_in_simplex, project
from hjbjax.problem import sets

pytestmark = pytest.mark.usefixtures("float64")


SLOWLY = [
    pytest.param(*case, marks=pytest.mark.slow) for case in [(1, True), (2, False), (3, False), (3, True), (5, False)]
]

# --- formulas ---


def sorted_projection(u, total, at_most):
    """The projection of one point as in the literature: sort, and find the number of positive entries."""
    if at_most and np.sum(np.maximum(u, 0)) <= total:
        return np.maximum(u, 0)
    down = np.sort(u)[::-1]
    means = (np.cumsum(down) - total) / np.arange(1, len(u) + 1)
    return np.maximum(u - means[np.flatnonzero(down > means)[-1]], 0)


@pytest.mark.parametrize("total", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(("n", "at_most"), list(itertools.product((1, 2, 3, 6), (False, True))))
def test_projection(n, at_most, total):
    points = total * np.random.default_rng(n).normal(size=(100, n))
    points[::7] = np.round(points[::7] / total) * total  # equal entries
    simplex = hjb.Simplex(n, total, at_most)
    found = np.stack(project(simplex, list(points.T)), -1)
    wanted = np.array([sorted_projection(u, total, at_most) for u in points])
    np.testing.assert_allclose(found, wanted, atol=1e-14 * total)
    assert np.all(sets.holds(simplex, found))


@pytest.mark.parametrize("at_most", [False, True])
def test_separable_minima_satisfy_their_conditions(at_most):
    """Also without curvature in some inputs: positive inputs have the same slope, and no other has a smaller one."""
    rng = np.random.default_rng(0)
    linear, square = rng.normal(size=(2, 4, 500))
    square = np.abs(square) * rng.choice([0.0, 1.0], square.shape)
    simplex = hjb.Simplex(4, 0.7, at_most)
    u = np.stack(least_in_simplex(simplex, list(linear), list(square)))
    assert np.all(sets.holds(simplex, u.T))
    slope = linear + 2 * square * u
    least = np.min(slope, 0)
    multiplier = np.where(at_most & (least > -1e-12), 0, least)
    np.testing.assert_allclose(np.where(u > 1e-9, slope - multiplier, 0), 0, atol=1e-12)
    assert np.all(slope >= multiplier - 1e-12)
    full = np.abs(np.sum(u, 0) - 0.7) < 1e-12
    assert np.all(full | (multiplier == 0))


def test_derivatives_of_the_projection_follow_the_total():
    u = jnp.array([0.9, 0.3, -0.8])
    moves = jax.jacobian(lambda total: jnp.stack(project(hjb.Simplex(3, total), list(u))))(1.0)
    assert moves.tolist() == [0.5, 0.5, 0.0]


@pytest.mark.slow
@pytest.mark.parametrize(("n", "at_most"), [(2, True), *SLOWLY])
def test_minima_at_one_point(n, at_most):
    """Exact formulas and a search agree with SciPy; a search has the derivative in the total."""
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    slope, bend = rng.normal(size=n), root @ root.T / n + 0.1 * np.eye(n)
    total = 2.0
    sums = {"type": "ineq" if at_most else "eq", "fun": lambda u, total: total - np.sum(u)}
    for separable in (True, False):
        square = np.diag(np.diag(bend)) if separable else bend

        def least(total, square=square, separable=separable):
            def energy(u):
                return slope @ u + u @ square @ u

            return pointwise.least(hjb.Simplex(n, total, at_most), energy, separable, np.float64)

        def oracle(total, square=square):
            return minimize(
                lambda u: slope @ u + u @ square @ u, np.full(n, total / (n + 1)), bounds=[(0, None)] * n,
                jac=lambda u: slope + 2 * square @ u, constraints=[{**sums, "args": (total,)}], options={"ftol": 1e-15},
            ).x  # fmt: skip

        np.testing.assert_allclose(least(total), oracle(total), atol=2e-6)
        moves = (oracle(total + 1e-3) - oracle(total - 1e-3)) / 2e-3
        np.testing.assert_allclose(jax.jvp(least, (total,), (1.0,))[1], moves, atol=1e-3)


# --- the discrete Hamiltonian ---


def drift(p, x, u):
    return p["b"] + p["G"] @ u


def cost(p, x, u):
    return p["l"] @ u + u @ p["Q"] @ u


def drawn(seed, n):
    """Numbers of a problem with n inputs, a convex cost and two shared components, and a value at the nodes."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n)) * rng.choice([0.0, 1.0], (n, 1), p=[0.3, 0.7]) * (rng.random() < 0.8)
    gain = rng.normal(size=(2, n)) * rng.choice([0.0, 1.0], (2, n), p=[0.3, 0.7])
    numbers = {"b": 0.5 * rng.normal(size=2), "G": gain, "l": rng.normal(size=n), "Q": root.T @ root}
    return numbers, rng.normal(size=SHAPE), rng.uniform(0.1, 0.6, 2)


def problem_of(numbers, admissible, sigma=None):
    return hjb.Problem(Partial(drift, numbers), Partial(cost, numbers), admissible, noise=sigma, discount=1.0)


def hamiltonians(numbers, value, sigma, u):
    """H at every node for actions (..., n) of every node, in NumPy; the shape of u is (*SHAPE, ..., n)."""
    f, a = numbers["b"] + u @ numbers["G"].T, np.zeros(2) if sigma is None else sigma**2
    total = u @ numbers["l"] + np.sum((u @ numbers["Q"]) * u, -1)
    for axis, h in enumerate(SPACING):
        up, down = (np.roll(value, -1, axis) - value) / h, (value - np.roll(value, 1, axis)) / h
        up, down = (each.reshape(SHAPE + (1,) * (u.ndim - 3)) for each in (up, down))
        e = np.maximum(a[axis], h * np.abs(f[..., axis]))
        total = total + ((e + h * f[..., axis]) * up - (e - h * f[..., axis]) * down) / (2 * h)
    return total


@functools.cache
def lattice(n, at_most, intervals):
    rows = itertools.product(range(intervals + 1), repeat=n)
    keep = [row for row in rows if sum(row) == intervals or (at_most and sum(row) < intervals)]
    return np.array(keep) / intervals


def scanned(numbers, value, sigma, simplex, intervals):
    """The least H over a lattice, and over smaller lattices around the best point of the one before."""
    unit = lattice(simplex.dim, simplex.at_most, intervals) * simplex.total
    centre, size, best = np.zeros((*SHAPE, 1, simplex.dim)), 1.0, np.full(SHAPE, np.inf)
    for _ in range(24):
        u = centre + size * unit
        here = hamiltonians(numbers, value, sigma, u)
        place = np.argmin(here, -1)[..., None, None]
        best = np.minimum(best, np.min(here, -1))
        winner, size = np.take_along_axis(u, place, -2), 0.6 * size
        # a smaller copy of the simplex around the best point, shifted into the simplex
        centre = np.maximum(winner - size * simplex.total / simplex.dim, 0)
        spare = (1 - size) * simplex.total - np.sum(centre, -1, keepdims=True)
        centre = np.where(
            spare < 0, centre * (1 + spare / np.maximum(np.sum(centre, -1, keepdims=True), 1e-300)), centre
        )
        if not simplex.at_most:
            centre = centre + np.maximum(spare, 0) * winner / simplex.total
    return best


CASES = [(2, False, False, 1.0)]
SLOW = [
    (3, False, False, 1.0),
    (2, True, True, 1.0),
    (3, True, False, 1e3),
    (3, False, True, 1e-3),
    (4, False, False, 1.0),
    (5, False, False, 1.0),
]
CASES += [pytest.param(*case, marks=pytest.mark.slow) for case in SLOW]


@pytest.mark.parametrize(("n", "at_most", "noisy", "total"), CASES)
def test_no_point_is_better_than_the_minimum(n, at_most, noisy, total):
    """A hundred random problems, twelve nodes each, with one compiled program."""
    simplex, off = hjb.Simplex(n, total, at_most), []
    for seed in range(100):
        numbers, value, sigma = drawn(seed, n)
        numbers |= {"G": numbers["G"] / total, "l": numbers["l"] / total, "Q": numbers["Q"] / total**2}
        sigma = sigma if noisy else None
        best, u, missed = map(np.asarray, found(problem_of(numbers, simplex, sigma), value))
        assert np.all(sets.holds(simplex, u))
        assert np.all(u >= 0)
        size = np.max(np.abs(value)) / np.min(SPACING)
        # at a vertex the sum and an upper bound are active together, which leaves their multipliers fewer digits
        assert np.max(missed) < 1e-9 * size
        np.testing.assert_allclose(hamiltonians(numbers, value, sigma, u), best, atol=1e-13 * size)
        off.append((best - scanned(numbers, value, sigma, simplex, {2: 40, 3: 24, 4: 12, 5: 8}[n])) / size)
    assert np.max(off) < 1e-11
    assert np.median(off) > -1e-4  # the oracle is close
