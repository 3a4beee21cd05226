"""The double integrator's minimum time by Limited(): half the error of the plain chain, and the switching curve."""

import functools
import warnings

import jax
import numpy as np
import pytest
from switching_curves import furthest_miss

import hjbjax as hjb
from benchmarks import cases
from hjbjax import zoo

pytestmark = pytest.mark.slow  # 161 x 161 nodes, and every problem twice
PLAIN = hjb.Upwind(central=False)


@functools.cache
def solved(n, scheme):
    exact = zoo.double_integrator_exact()
    problem, grid = cases.double_integrator(n)
    solution = hjb.solve(problem, grid, scheme=scheme, tol=1e-6)
    with jax.enable_x64(True):
        known = jax.jit(jax.vmap(exact))(grid.nodes().reshape(-1, 2))
    return solution, np.abs(solution.value - np.asarray(known).reshape(n, n))


@pytest.mark.parametrize("n", [41, 81, 161])
def test_mean_error_against_the_plain_chain(n):
    """The value has a square root at the switching curve, so that halving the error is what can be had.

    Values are held at the nodes inside: the level set of the time is no distance to cut links by.
    """
    plain, limited = np.mean(solved(n, PLAIN)[1]), np.mean(solved(n, hjb.Limited(subcell=False))[1])
    assert limited <= {41: 0.8, 81: 0.6, 161: 0.6}[n] * plain
    if n == 161:
        assert plain == pytest.approx(8.47e-3, rel=0.02)  # evaluated independently
        assert limited == pytest.approx(4.15e-3, rel=0.02)


def test_largest_error_is_smaller_too():
    assert np.max(solved(161, hjb.Limited())[1]) <= 0.7 * np.max(solved(161, PLAIN)[1])


def test_switching_curve():
    limited, plain = furthest_miss(solved(161, hjb.Limited())[0]), furthest_miss(solved(161, PLAIN)[0])
    assert limited <= 6
    assert limited <= 0.6 * plain


def test_status_and_words():
    solution, _ = solved(161, hjb.Limited())
    assert solution.status is hjb.Status.CONVERGED
    assert solution.bounds is None
    assert "high-order" in solution.stats["certificate"]
    assert "Limited" in solution.stats["scheme"]
    change = np.max(np.abs(solution.value - solved(161, hjb.Upwind(subcell=True))[0].value))
    assert solution.stats["from_monotone"] == pytest.approx(change, abs=1e-5)
    assert change > 0.01


KINKED = {
    "the ball": {"norm": 2},
    "the box": {"norm": float("inf")},
    "along the axes": {"norm": 1},
    "to one node": {"norm": 2, "radius": 0.0},
    "along the axes to one node": {"norm": 1, "radius": 0.0},
    "without discount": {"norm": 2, "discount": 0.0},
}


def errors(question, exact, where=1.0):
    """The largest error of the plain chain and of Limited() on |x_i| ≤ where."""
    problem, grid = question
    with jax.enable_x64(True):
        known = np.asarray(jax.jit(jax.vmap(exact))(grid.nodes().reshape(-1, grid.ndim))).reshape(grid.shape)
    inner = np.max(np.abs(grid.nodes()), axis=-1) <= where + 1e-9
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hjb.SolveWarning)  # states that are carried away, in the current
        values = [hjb.solve(problem, grid, scheme=scheme, tol=1e-8).value for scheme in (PLAIN, hjb.Limited())]
    return [np.max(np.abs(value - known)[inner & np.isfinite(known)]) for value in values]


@pytest.mark.parametrize("name", KINKED)
def test_shortest_paths_are_never_worse(name):
    plain, limited = errors(zoo.eikonal(shape=(41, 41), **KINKED[name]), zoo.eikonal_exact(**KINKED[name]))
    assert limited <= 1.05 * plain + 1e-8
    assert limited <= 0.6 * plain  # and indeed better


@pytest.mark.parametrize("discount", [0.0, 1.0])
@pytest.mark.parametrize("radius", [0.0, 0.2])
def test_minimum_time_in_a_larger_box_is_never_worse(discount, radius):
    options = {"discount": discount, "radius": radius}
    plain, limited = errors(
        zoo.double_integrator(shape=(41, 41), **options), zoo.double_integrator_exact(**options), where=1
    )
    assert limited <= 1.05 * plain + 1e-8


def test_boat_in_a_current_is_never_worse():
    plain, limited = errors(zoo.zermelo(shape=(41, 41)), zoo.zermelo_exact(), where=1)
    assert limited <= 0.3 * plain
