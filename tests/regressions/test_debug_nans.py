"""``jax_debug_nans``: what a user turns on who looks for a NaN of their own must find none of ours."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

U = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([-1.0], [1.0], (21,))


def drift(x, u):
    return u


def cost(x, u):
    return x @ x + u @ u


PLAIN = hjb.Problem(drift, cost, U, discount=1.0)
TO_TARGET = hjb.Problem(drift, lambda x, u: 1.0, U, target=lambda x: jnp.abs(x[0]) - 0.25)
LOST = hjb.Problem(lambda x, u: jnp.where(x > 0.5, 0.3, u), lambda x, u: 1.0, U, target=lambda x: x[0] + 0.5)


@pytest.fixture(autouse=True)
def looking():
    with jax.debug_nans(True):
        yield


@pytest.mark.filterwarnings("ignore:.*cannot reach the target")
@pytest.mark.parametrize("problem", [PLAIN, TO_TARGET, LOST], ids=["plain", "target", "lost"])
def test_solve(problem):
    solution = hjb.solve(problem, GRID, scheme=hjb.Upwind())
    assert solution.status is hjb.Status.CONVERGED
    assert not np.any(np.isnan(solution.residuals))


def test_value_iteration_of_a_tube():
    tube = hjb.reach(drift, U, lambda x: jnp.abs(x[0]) - 0.3)
    assert hjb.solve(tube, GRID, scheme=hjb.Upwind()).status is hjb.Status.CONVERGED


def test_solve_batch():
    problems = [hjb.Problem(drift, cost, U, discount=discount) for discount in (1.0, 2.0)]
    assert all(
        solution.status is hjb.Status.CONVERGED for solution in hjb.solve_batch(problems, GRID, scheme=hjb.Upwind())
    )


@pytest.mark.parametrize("method", [hjb.Explicit(), hjb.Implicit()])
def test_march(method):
    solution = hjb.march(TO_TARGET, GRID, 0.5, method=method, scheme=hjb.Upwind(split=True))
    assert np.all(np.isnan(solution.policy[0, 8:13]))  # on the target there is no control


def test_simulate_past_the_target():
    path = hjb.simulate(TO_TARGET, lambda x: -jnp.sign(x), [0.9], 3.0)
    assert path.status.name == "TARGET"


@pytest.mark.slow
def test_a_nan_of_the_users_own_is_found():
    with pytest.raises(ValueError, match="cost.* is NaN or infinite at 10 of 21 nodes"):
        hjb.solve(hjb.Problem(drift, lambda x, u: jnp.sqrt(x[0]), U, discount=1.0), GRID, scheme=hjb.Upwind())
