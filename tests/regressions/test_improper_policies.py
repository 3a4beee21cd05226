"""Minimum cost to a target through policies that never get there: no method gives up on a solvable problem."""

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

GRID = hjb.Grid([-1.5], [1.5], (31,))
A, C, E = (
    (1.8761627402153747, -0.05962284528421602, 5.727542962144423),
    (1000.0, 0.01, 3.499479068438235),
    (1546.37, -5.15),
)


def drift(x, u):
    return A[0] * u * (1 + 0.3 * jnp.sin(3 * x)) + A[1] * jnp.sin(2 * x + A[2])


def cost(x, u):
    return C[0] * (C[1] + (1 - u[0] * 0.5) * jnp.abs(jnp.sin(C[2] * x[0])))


def question():
    return hjb.Problem(
        drift, cost, hjb.Finite([[-1.0], [0.0], [1.0]]), noise=lambda x, u: 0.0 * x,
        target=lambda x: jnp.abs(x[0]) - 0.2, exit_cost=lambda x: E[0] + E[1] * x[0],
    )  # fmt: skip


def by_value_iteration():
    """The chain without noise, in NumPy, from above."""
    x, h = GRID.axis(0), 0.1
    held = np.abs(x) <= 0.2 + 1e-12
    value = np.where(held, E[0] + E[1] * x, 1e7)
    for _ in range(400):
        best = value.copy()
        for u in (-1.0, 0.0, 1.0):
            f = A[0] * u * (1 + 0.3 * np.sin(3 * x)) + A[1] * np.sin(2 * x + A[2])
            toll = C[0] * (C[1] + (1 - u * 0.5) * np.abs(np.sin(C[2] * x)))
            ahead = np.where(f > 0, np.append(value[1:], np.inf), np.append(np.inf, value[:-1]))
            best = np.minimum(best, ahead + toll * h / np.abs(f))
        value = np.where(held, value, best)
    return value


@pytest.mark.parametrize(
    "method", [None, hjb.PolicyIteration(hjb.Direct()), pytest.param(hjb.ValueIteration(), marks=pytest.mark.slow)]
)
def test_every_method_comes_to_the_value(method):
    solution = hjb.solve(question(), GRID, method=method, tol=1e-3, scheme=hjb.Upwind())
    exact = by_value_iteration()
    assert solution.status is hjb.Status.CONVERGED
    assert np.max(np.abs(solution.value - exact)) <= solution.error + 1e-9 * np.max(exact)
