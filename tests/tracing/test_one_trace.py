"""How often Python runs a function of the user's: a trace costs more than a small solve."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

GRID = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (11, 12))
TRACES = 3  # at most: to see what it computes, once more in another floating-point type, and one to spare


class Counted:
    """A drift that counts its calls, which no one can know beforehand."""

    def __init__(self, function):
        self.function, self.calls = function, 0

    def __call__(self, *arguments):
        self.calls += 1
        return self.function(*arguments)


def pendulum(x, u):
    return jnp.stack([x[1], jnp.sin(x[0]) + jnp.sum(u)])


def cost(x, u):
    return x @ x + u @ u


def question(drift, **changes):
    return hjb.Problem(drift, cost, **{"controls": hjb.Box([-1.0], [1.0]), "discount": 0.3} | changes)


def box(dim):
    return hjb.Box([-1.0] * dim, [1.0] * dim)


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("dim", "noise"),
    [(1, 0.3), pytest.param(2, None, marks=pytest.mark.slow), pytest.param(2, 0.3, marks=pytest.mark.slow)],
)
def test_a_solve_traces_the_drift_at_most_three_times(dim, noise, dtype):
    drift = Counted(pendulum)
    solution = hjb.solve(question(drift, controls=box(dim), noise=noise), GRID, dtype=dtype, scheme=hjb.Upwind())
    assert solution.status is hjb.Status.CONVERGED
    assert 1 <= drift.calls <= TRACES


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(hjb.ValueIteration(), marks=pytest.mark.slow),
        hjb.PolicyIteration(hjb.Direct()),
        pytest.param(hjb.Nested(), marks=pytest.mark.slow),
    ],
)
def test_so_does_a_solve_by_every_method(method):
    drift = Counted(pendulum)
    grid = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (81, 80)) if isinstance(method, hjb.Nested) else GRID
    hjb.solve(question(drift), grid, method=method, tol=0.1, scheme=hjb.Upwind())
    assert drift.calls <= TRACES


@pytest.mark.slow
def test_so_does_a_game():
    drift = Counted(lambda x, u, d: jnp.stack([x[1] + d[0], u[0] - x[0]]))
    problem = hjb.Problem(
        drift, lambda x, u, d: x @ x + u @ u - 2 * d @ d, box(1), disturbances=hjb.Box([-0.1], [0.1]), discount=0.5
    )
    hjb.solve(problem, GRID, scheme=hjb.Upwind())
    assert drift.calls <= TRACES


@pytest.mark.parametrize("method", [None, pytest.param(hjb.Implicit(), marks=pytest.mark.slow)])
@pytest.mark.parametrize("scheme", [hjb.Upwind(), pytest.param(hjb.Weno5(), marks=pytest.mark.slow)])
def test_so_does_a_march(scheme, method):
    if method is not None and not scheme.monotone:
        return
    drift = Counted(pendulum)
    hjb.march(question(drift), GRID, 0.3, scheme=scheme, method=method)
    assert drift.calls <= TRACES


def test_so_does_a_batch():
    drift = Counted(pendulum)
    hjb.solve_batch([question(drift, discount=each) for each in (0.3, 1.0)], GRID, scheme=hjb.Upwind())
    assert drift.calls <= TRACES + 1  # every lane is looked at


@pytest.mark.slow
def test_so_does_a_derivative():
    drift = Counted(pendulum)
    slope = jax.grad(
        lambda discount: hjb.solve(question(drift, discount=discount), GRID, scheme=hjb.Upwind()).value[3, 4]
    )(0.3)
    assert np.isfinite(slope)
    assert drift.calls <= TRACES


def test_a_second_solve_looks_once_whether_the_function_is_as_it_was():
    drift = Counted(pendulum)
    hjb.solve(question(drift), GRID, scheme=hjb.Upwind())
    before = drift.calls
    hjb.solve(question(drift), GRID, scheme=hjb.Upwind())
    assert drift.calls == before + 1


@pytest.mark.slow
def test_a_function_that_changed_is_traced_anew():
    drift = Counted(pendulum)
    first = hjb.solve(question(drift), GRID, scheme=hjb.Upwind()).value
    drift.function = lambda x, u: 2 * pendulum(x, u)
    assert np.max(np.abs(hjb.solve(question(drift), GRID, scheme=hjb.Upwind()).value - first)) > 0.01
