"""Maxima between the nodes: exact for quadratics; at ends, beside impossible states, across a seam."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hjbjax as hjb
from hjbjax.filtering import sup_pairing

SEEDS = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize("n", [pytest.param(1, marks=pytest.mark.slow), 2, pytest.param(3, marks=pytest.mark.slow)])
@given(seed=SEEDS)
@settings(max_examples=25)
def test_maxima_of_quadratics_are_exact(n, seed):
    rng = np.random.default_rng(seed)
    grid = hjb.Grid([-1.0] * n, [1.0] * n, (9,) * n, stretch=(hjb.Sinh(1.5), None, None)[:n])
    root = rng.normal(size=(n, n))
    bend, centre, top = root @ root.T + 0.3 * np.eye(n), rng.uniform(-0.5, 0.5, n), rng.normal()
    off = grid.nodes() - centre
    psi = rng.normal(size=grid.shape)
    values = top - 0.5 * np.einsum("...i,ij,...j", off, bend, off)
    value, state = sup_pairing(values - psi, psi, grid)
    best = np.unravel_index(np.argmax(values), grid.shape)
    # the quadratic is taken as far as the neighbours of the largest node; beyond, axis by axis
    cells = [np.diff(np.asarray(grid.axis(i)))[best[i] - 1 : best[i] + 1] for i in range(n)]
    near = all(-d[0] <= c <= d[1] for c, d in zip(centre - grid.state(best), cells, strict=True))
    if near:
        assert value == pytest.approx(top, abs=1e-9)
        np.testing.assert_allclose(state, centre, atol=1e-8)
    assert values.max() - 1e-12 <= value <= top + 1e-9 if near else value >= values.max() - 1e-12


def test_maxima_at_ends_beside_impossible_states_and_across_a_seam():
    grid = hjb.Grid([0.0], [1.0], (11,))
    x = np.asarray(grid.axis(0))
    assert [float(each) for each in (*sup_pairing(2 * x, 1.0, grid)[:1], sup_pairing(2 * x, 1.0, grid)[1][0])] == [3, 1]
    lone = np.where(np.arange(11) == 4, 1.0, -np.inf)
    value, state = sup_pairing(lone, 0.0, grid)
    assert (float(value), float(state[0])) == (1.0, pytest.approx(0.4))
    ring = hjb.Grid([-np.pi], [np.pi], (40,), (True,))
    wave = np.cos(np.asarray(ring.axis(0)) - np.pi + 0.03)
    value, state = sup_pairing(wave, 0.0, ring)
    assert float(value) == pytest.approx(1, abs=1e-5)
    assert float(state[0]) == pytest.approx(np.pi - 0.03, abs=1e-3)
    with pytest.raises(ValueError, match=r"sup_pairing: psi has shape \(3,\), wanted \(11,\)"):
        sup_pairing(x, np.zeros(3), grid)
