"""Slopes of higher order against polynomials fitted node by node, by NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from numpy.polynomial import Polynomial
from systems import SEEDS

from hjbjax.discretisation import slopes
from hjbjax.problem.grid import Grid

SHAPE = (9, 7)
GRID = Grid([0.0, -1.0], [2.0, 3.0], SHAPE, (True, False))
BOTH = jax.jit(lambda values: (slopes.eno2(values, GRID), slopes.weno5(values, GRID)))


LINEAR = Grid([0.0, -1.0], [2.0, 3.0], SHAPE, (True, False), edges=(None, ("projected", "linear")))
AT_A_LINEAR_END = jax.jit(lambda values: (slopes.eno2(values, LINEAR), slopes.weno5(values, LINEAR)))


def line_through(values, axis, index, reach, degree=2):
    """The values from ``reach`` nodes before to ``reach`` after, wrapped or continued by polynomials.

    These are the parabola through the first three values and the polynomial of this degree through the last ones.
    """
    row = np.take(values, index[1 - axis], axis=1 - axis)
    places = index[axis] + np.arange(-reach, reach + 1)
    if GRID.periodic[axis]:
        return row[places % len(row)]
    first = Polynomial.fit(np.arange(3), row[:3], 2)
    last = Polynomial.fit(np.arange(-1 - degree, 0), row[-1 - degree :], degree)
    inside = (places >= 0) & (places < len(row))
    return np.where(
        inside, row[np.clip(places, 0, len(row) - 1)], np.where(places < 0, first(places), last(places - len(row)))
    )


def derivative(nodes, values, at):
    return Polynomial.fit(nodes, values, len(nodes) - 1).deriv()(at)


def weighted(v, typical, h):
    """The slope at the middle of seven values, from below: three cubics and their smoothness on the cell below."""
    nodes = np.arange(-3, 3) * h
    fits = [Polynomial.fit(nodes[k : k + 4], v[k : k + 4], 3).convert() for k in range(3)]
    rough = []
    for fit in fits:
        first, second = fit.deriv(2), fit.deriv(3)
        square = h * (first**2).integ() + h**3 * (second**2).integ()
        rough.append((square(0.0) - square(-h)) / typical**2)
    # the shares with which the three make the slope of the quintic through all six
    columns = np.array([np.pad([fit_row(k, j) for j in range(4)], (k, 2 - k)) for k in range(3)])
    quintic = np.array([derivative(np.arange(-3, 3), np.eye(6)[j], 0.0) for j in range(6)])
    shares = np.linalg.lstsq(columns.T, quintic, rcond=None)[0]
    np.testing.assert_allclose(shares, [0.1, 0.6, 0.3], atol=1e-9)
    weights = shares / (1e-6 + np.array(rough)) ** 2
    return weights @ [fit.deriv()(0.0) for fit in fits] / weights.sum()


def fit_row(k, j):
    return derivative(np.arange(-3 + k, 1 + k), np.eye(4)[j], 0.0)


def smoother(v, h):
    """The slope at the middle of five values, from below: of two parabolas the one that bends less."""
    left = Polynomial.fit(np.array([-2, -1, 0]) * h, v[:3], 2)
    right = Polynomial.fit(np.array([-1, 0, 1]) * h, v[1:4], 2)
    flatter = right if abs(right.deriv(2)(0.0)) < abs(left.deriv(2)(0.0)) else left
    return flatter.deriv()(0.0)


@pytest.mark.slow
@given(SEEDS)
def test_slopes_are_those_of_fitted_polynomials(seed):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=SHAPE) * 10.0 ** rng.integers(-6, 6)
    index = tuple(int(rng.integers(count)) for count in SHAPE)
    with jax.enable_x64(True):
        second, fifth = jax.device_get(BOTH(jnp.asarray(values)))
    extent = values.max() - values.min()
    for axis in range(2):
        h = float(GRID.spacing(axis))
        typical = extent / float(GRID.hi[axis] - GRID.lo[axis])
        v7, v5 = line_through(values, axis, index, 3), line_through(values, axis, index, 2)
        edge = not GRID.periodic[axis]
        at_top, at_bottom = edge and index[axis] == SHAPE[axis] - 1, edge and index[axis] == 0
        close = {"rtol": 1e-7, "atol": 1e-7 * extent / h}
        up, down = (side[index] for side in fifth[axis])
        np.testing.assert_allclose(down, 0 if at_bottom else weighted(v7[:6], typical, h), **close)
        np.testing.assert_allclose(up, 0 if at_top else -weighted(v7[:0:-1], typical, h), **close)
        up, down = (side[index] for side in second[axis])
        np.testing.assert_allclose(down, 0 if at_bottom else smoother(v5[:4], h), **close)
        np.testing.assert_allclose(up, 0 if at_top else -smoother(v5[:0:-1], h), **close)


@pytest.mark.slow
@given(SEEDS)
def test_beyond_a_linear_end_the_value_is_a_line(seed):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=SHAPE) * 10.0 ** rng.integers(-6, 6)
    index = int(rng.integers(SHAPE[0])), SHAPE[1] - 1 - int(rng.integers(3))
    with jax.enable_x64(True):
        second, fifth = jax.device_get(AT_A_LINEAR_END(jnp.asarray(values)))
    extent, h = values.max() - values.min(), float(GRID.spacing(1))
    typical = extent / float(GRID.hi[1] - GRID.lo[1])
    v7, v5 = (line_through(values, 1, index, reach, degree=1) for reach in (3, 2))
    found = [side[index] for side in (*second[1], *fifth[1])]
    wanted = [-smoother(v5[:0:-1], h), smoother(v5[:4], h)]
    wanted += [-weighted(v7[:0:-1], typical, h), weighted(v7[:6], typical, h)]
    np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-7 * extent / h)


@pytest.mark.parametrize("scheme", [slopes.eno2, slopes.weno5])
def test_out_of_a_linear_end_the_slope_is_that_of_the_last_two_nodes(scheme):
    x, grid = np.linspace(-1.0, 1.0, 9), Grid([-1.0], [1.0], (9,), edges="linear")
    with jax.enable_x64(True):
        ((up, down),) = jax.device_get(scheme(jnp.asarray(np.where(x == x[-1], 7.0, x)), grid))
    np.testing.assert_allclose(down[0], 1.0, rtol=1e-12)
    np.testing.assert_allclose(up[-1], (7.0 - x[-2]) / 0.25, rtol=0.02)  # a fifth-order slope blends further nodes in


@pytest.mark.parametrize("lo", [-1.0, 1.25, -5.25])  # two and a half cells from its top a far ghost bends less
@pytest.mark.parametrize("scheme", [slopes.eno2, slopes.weno5])
def test_a_parabola_has_its_own_slopes(scheme, lo):
    x, grid = np.linspace(lo, lo + 4, 9), Grid([lo], [lo + 4], (9,))
    with jax.enable_x64(True):
        ((up, down),) = jax.device_get(scheme(jnp.asarray(x**2), grid))
    np.testing.assert_allclose(up[:-1], 2 * x[:-1], atol=1e-12)
    np.testing.assert_allclose(down[1:], 2 * x[1:], atol=1e-12)
    assert up[-1] == 0
    assert down[0] == 0


def test_a_constant_is_flat():
    ((up, down),) = slopes.weno5(jnp.full(9, 3.0), Grid([-1.0], [3.0], (9,)))
    assert not np.any(up)
    assert not np.any(down)


def test_the_derivative_of_smooth_slopes_is_finite_in_single_precision():
    """Where V is a line the sum of the weights is about ε⁴, whose square is zero in float32."""
    x, bump = np.linspace(-1.0, 1.0, 9), np.exp(-((np.linspace(-1.0, 1.0, 9)) ** 2))
    grid = Grid([-1.0], [1.0], (9,))

    def slope(a, dtype):
        ((up, down),) = slopes.weno5(jnp.asarray(x, dtype) + a * jnp.asarray(bump, dtype), grid)
        return up + 2 * down

    with jax.enable_x64(True):
        exact = jax.jit(jax.jacfwd(lambda a: slope(a, "float64")))(jnp.zeros((), "float64"))
        for jacobian in (jax.jacfwd, jax.jacrev):
            found = jax.jit(jacobian(lambda a: slope(a, "float32")))(jnp.zeros((), "float32"))
            np.testing.assert_allclose(found, exact, rtol=1e-4, atol=1e-4)
