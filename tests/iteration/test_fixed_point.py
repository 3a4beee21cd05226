"""The status after an evaluation: converged, stalled, diverged, not finite, or running; and the record of a solve."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import fixed_point, progress
from hjbjax.iteration.certificates import ErrorBound
from hjbjax.problem.grid import tabulated
from hjbjax.solution.status import Status
from hjbjax.solvers.setup import prepare_on_host

pytestmark = pytest.mark.usefixtures("float64")
GRID = hjb.Grid([-1.0], [1.0], (11,))
LARGE = 1e6  # the size of the value, whose rounding is 64 eps of it
RECORD = progress.no_progress(np.float64)
ROUNDING = progress.ROUNDING * np.finfo(np.float64).eps * LARGE


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
        record = dataclasses.replace(RECORD, best=jnp.stack([nearest, best]), since_best=since)
        return fixed_point.status_after(task, jnp.full(11, -LARGE), measured, record)

    residuals = (0.0, 0.9 * ROUNDING, 1.1 * ROUNDING, 1.0, 0.9e6 * ROUNDING, 1.1e6 * ROUNDING, 1e7, np.inf, np.nan)
    seen = set()
    for residual, error, *before in itertools.product(
        residuals, (1e-4, 1.0, np.nan), (0.0, ROUNDING / 10, 2.0, np.inf), (1e-7, 1.0, np.inf), (0, 9, 10, 143, 144)
    ):
        found = Status(int(assumptions_of(residual, error, *before)))
        assert found is expected(residual, error, *before, 1e-3), (residual, error, *before)
        seen.add(found)
    assert len(seen) == 5


def test_a_state_counts_its_evaluations_from_zero():
    """The first pass evaluates the guess as it is; a program of no pass changes nothing."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    on = Discretisation(problem, GRID, hjb.Upwind(), np.float64)
    task, _, _ = prepare_on_host(on, method=hjb.ValueIteration(), tol=1e-9)
    guess, run = np.linspace(0.0, 1.0, 11), jax.jit(fixed_point.run)
    state = fixed_point.start(task, guess)
    for evaluations in range(4):
        state = run(task, state, evaluations)
        record = state.progress
        assert (int(record.evaluations), record.steps) == (evaluations, max(evaluations - 1, 0))
        assert record.has_begun == (evaluations > 0)
        assert np.count_nonzero(record.history >= 0) == min(evaluations, 1)  # of the last chunk
        assert np.array_equal(state.value, guess) == (evaluations < 2)
        assert np.isfinite(state.bound.error) == (evaluations > 0)
    together = run(task, fixed_point.start(task, guess), 3)
    np.testing.assert_array_equal(together.value, state.value)
    np.testing.assert_array_equal(together.progress.history[2], record.history[0])


def test_a_guess_is_measured_by_its_residual_only_where_a_certificate_bounds_its_error():
    """Without one the error is also the size of the last step, and a guess has none."""
    for discount, bounded in ((1.0, True), (0.0, False)):
        stop = None if bounded else lambda x: 2.0 + x[0]
        problem = hjb.Problem(
            lambda x, u: u, lambda x, u: 0 * x[0], hjb.Box([-1.0], [1.0]), discount=discount, stopping_cost=stop
        )
        on = Discretisation(problem, GRID, hjb.Upwind(), np.float64)
        task, _, _ = prepare_on_host(on, method=hjb.PolicyIteration(hjb.Sweeps()), tol=1e-9)
        state = jax.jit(fixed_point.run)(task, fixed_point.start(task, np.zeros(11)), 1)
        assert np.isfinite(state.bound.residual)
        assert np.isfinite(state.bound.error) == bounded


def pushed(x, u, d):
    return jnp.stack([jnp.cos(x[1]) + 0.5 * d[0], u[0]])


def quadratic(x, u, d):
    return x @ x + u @ u - d @ d


def test_chunks_of_value_iteration_change_no_bit():
    """The actions are computed at the end of a chunk, with a defect that differs by rounding from the loop's."""
    box, grid = hjb.Box([-1.0], [1.0]), hjb.Grid([-2.0, -2.0], [2.0, 2.0], (21, 20), periodic=(False, True))
    problem = hjb.Problem(pushed, quadratic, box, discount=1.0, disturbances=box)
    on = Discretisation(problem, tabulated(grid), hjb.Upwind(), np.float64)
    task, _, _ = prepare_on_host(on, method=hjb.ValueIteration(), tol=1e-12)
    assert task.by_defect
    run = jax.jit(fixed_point.run)
    whole = run(task, fixed_point.start(task, np.zeros(grid.shape)), 101)
    state = fixed_point.start(task, np.zeros(grid.shape))
    for until in (1, 2, 10, 11, 74, 101):
        state = run(task, state, until)
    np.testing.assert_array_equal(state.value, whole.value)
