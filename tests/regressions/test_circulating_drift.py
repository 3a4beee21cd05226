"""Drifts that go round and round under a small discount: sweeps carry a value once around at a time."""

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

RING = hjb.Grid([-1.0], [1.0], (21,), (True,))


@pytest.mark.parametrize("discount", [1e-1, 1e-3, 1e-5])
def test_a_ring_is_solved_whatever_the_discount(discount):
    problem = hjb.Problem(lambda x, u: 1 + 0.1 * u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=discount)
    solution = hjb.solve(problem, RING, tol=1e-3, scheme=hjb.Upwind())
    assert solution.status is hjb.Status.CONVERGED
    assert solution.error <= 1e-3
    mean = np.mean(RING.axis(0) ** 2)
    assert abs(solution.value.mean() * discount - mean) <= 0.2 * mean  # the average cost, nearly


def turning(x, u):
    return jnp.stack([x[1], -x[0] + 0.01 * u[0]])


@pytest.mark.slow
def test_an_oscillator_under_a_small_discount():
    problem = hjb.Problem(turning, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1e-4)
    solution = hjb.solve(problem, hjb.Grid([-2.0, -2.0], [2.0, 2.0], (15, 15)), tol=1e-6, scheme=hjb.Upwind())
    assert solution.error <= 1e-6
