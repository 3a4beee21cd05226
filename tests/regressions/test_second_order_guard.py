"""The second-order answer beside the certified monotone one: false solutions at rest nodes, and where to stop."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.solvers import host_solve

HANGING = [np.pi - 1e-9, 0.0]
# torque, nodes, V(hanging); the monotone scheme on 1600 x 1601 nodes gives 43.4 for the torque 2, and falls
SWINGS = [(2.0, (60, 61), 47.25)]
MORE = [
    (2.0, (100, 101), 42.69), (3.0, (60, 61), 35.08), (2.0, (200, 201), 42.73), (1.5, (60, 61), 67.6),
    (2.5, (100, 101), 37.62), (3.0, (200, 201), 34.88),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
@pytest.mark.parametrize(
    ("torque", "shape", "known"), [*SWINGS, *(pytest.param(*each, marks=pytest.mark.slow) for each in MORE)]
)
def test_a_pendulum_of_several_swings_does_not_slide_off_its_rest_node(torque, shape, known):
    """Undiscounted: it ended at V = -29 for costs that are not negative, CONVERGED."""
    solution = hjb.solve(*zoo.pendulum(torque=torque, shape=shape), tol=1e-3)
    assert solution.status is hjb.Status.CONVERGED
    assert "first order" not in solution.message
    assert solution.value.min() == 0
    assert float(solution.value_at(HANGING)) == pytest.approx(known, rel=1e-3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
@pytest.mark.parametrize(("time", "cost"), [(1e6, 1e9), (1e-6, 1e-9)])
def test_units_of_time_and_cost_do_not_matter(time, cost):
    problem, grid = zoo.pendulum(torque=2.0, shape=(60, 61))
    scaled = hjb.Problem(
        lambda x, u: problem.drift(x, u) / time, lambda x, u: cost * problem.cost(x, u) / time, problem.controls
    )
    solution = hjb.solve(scaled, grid, tol=1e-3 * cost)
    assert float(solution.value_at(HANGING)) / cost == pytest.approx(47.25, rel=1e-3)


@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_an_answer_that_contradicts_the_certified_one_is_not_returned(monkeypatch):
    second_order = host_solve.second_order

    def slid(*arguments, **options):
        sharp = second_order(*arguments, **options)
        return sharp._replace(state=dataclasses.replace(sharp.state, value=sharp.state.value - 1000))

    problem, grid = zoo.pendulum(torque=2.0, shape=(60, 61))
    monotone = hjb.solve(problem, grid, scheme=hjb.Upwind(subcell=True))
    monkeypatch.setattr(host_solve, "second_order", slid)
    solution = hjb.solve(problem, grid)
    assert "first order, since the second-order answer differs from this certified one by up to" in solution.message
    np.testing.assert_allclose(solution.value, monotone.value, atol=2e-3)


@pytest.mark.slow
def test_the_iteration_stops_by_the_distance_to_its_limit():
    """Steps contract by 0.8 and less: the last one was at most tol, and V off by twice that."""

    def cost(x, u):
        gradient, drift = 2 * x, jnp.stack([3 * x[1], -3 * x[0] - x[1]])
        return 0.5 * x @ x - drift @ gradient + gradient @ gradient / 4 - 0.01 + u @ u

    problem = hjb.Problem(
        lambda x, u: jnp.stack([3 * x[1] + u[0], -3 * x[0] - x[1] + u[1]]), cost, hjb.Box([-4.0] * 2, [4.0] * 2),
        noise=jnp.array([0.0, 0.1]), discount=0.5, target=lambda x: 0.999 - jnp.max(jnp.abs(x)),
        exit_cost=lambda x: x @ x,
    )  # fmt: skip
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (41, 41))
    solution = hjb.solve(problem, grid, tol=1e-3)
    exact = np.sum(grid.nodes() ** 2, axis=-1)  # slopes of second order are exact on it
    assert np.max(np.abs(solution.value - exact)) <= 0.5e-3
