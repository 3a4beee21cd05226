"""How a step is judged: converged, stalled, diverged, not finite, or on."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import certificates
from hjbjax.iteration.certificates import ErrorBound
from hjbjax.solution.status import Status
from hjbjax.solvers.setup import prepare_on_host

GRID = hjb.Grid([-1.0], [1.0], (11,))
LARGE = 1e6  # the size of the value, whose rounding is 64 eps of it
ROUNDING = certificates.ROUNDING * np.finfo(np.float64).eps * LARGE


@pytest.fixture(autouse=True, scope="module")
def _float64():
    with jax.enable_x64(True):
        yield


def expected(residual, error, best, nearest, since, tol):
    """The rules one after the other; later ones win."""
    code = Status.RUNNING
    if since >= (10 if residual <= ROUNDING else 100 + 4 * 11):
        code = Status.STALLED
    bounded = (
        np.isfinite(nearest) and error <= 1e6 * nearest
    )  # a better policy may leave more than one that stops at once
    if residual > 1e6 * max(best, ROUNDING) and not bounded:
        code = Status.DIVERGED
    if error <= tol:
        code = Status.CONVERGED
    return code if np.isfinite(residual) else Status.NONFINITE


def test_every_rule_of_a_verdict():
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    on = Discretisation(problem, GRID, hjb.Upwind(), np.float64)
    task, _, _ = prepare_on_host(on, method=hjb.PolicyIteration(), tol=1e-3)

    @jax.jit
    def assumptions_of(residual, error, best, nearest, since):
        measured = ErrorBound(-error, error, jnp.zeros(()), error, residual)
        return certificates.judged(task, jnp.full(11, -LARGE), measured, jnp.stack([nearest, best]), since)

    residuals = (0.0, 0.9 * ROUNDING, 1.1 * ROUNDING, 1.0, 0.9e6 * ROUNDING, 1.1e6 * ROUNDING, 1e7, np.inf, np.nan)
    seen = set()
    for residual, error, *before in itertools.product(
        residuals, (1e-4, 1.0, np.nan), (0.0, ROUNDING / 10, 2.0, np.inf), (1e-7, 1.0, np.inf), (0, 9, 10, 143, 144)
    ):
        found = Status(int(assumptions_of(residual, error, *before)))
        assert found is expected(residual, error, *before, 1e-3), (residual, error, *before)
        seen.add(found)
    assert len(seen) == 5
