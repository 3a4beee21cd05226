"""``Weno5()`` for stationary problems: its order, its errors beside ``Limited()``, and what breaks its seven nodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.applications.reference import at_nodes_of, mask_of

U = hjb.Box([-1.0], [1.0])


def inner(x):
    return (jnp.abs(x[0]) <= 0.5) & (jnp.abs(x[1]) <= 0.45)


def error_on_smooth(count, **options):
    problem, grid = zoo.smooth(shape=(count, count))
    solution = hjb.solve(problem, grid, scheme=hjb.Weno5(), tol=1e-12, **options)
    inside = mask_of(inner, grid)
    return np.max(np.abs(solution.value - at_nodes_of(zoo.smooth_exact(), grid, inside))[inside])


@pytest.mark.slow
def test_a_smooth_value_is_met_at_fifth_order():
    errors = [error_on_smooth(count) for count in (21, 41, 81)]
    assert errors[1] <= 1e-7
    assert errors[2] <= 2e-9
    assert np.log2(errors[0] / errors[2]) / 2 >= 4


@pytest.mark.slow
def test_nothing_grows_on_a_finer_grid():
    assert error_on_smooth(161) <= 1e-9


@pytest.mark.slow
def test_on_values_with_kinks_it_is_no_worse_than_second_order():
    problem, fine = zoo.pendulum(shape=(400, 401))
    known = hjb.solve(problem, fine, scheme=hjb.Limited(), tol=1e-4)
    cases = [(problem, zoo.pendulum(shape=(100, 101))[1], known.value_at)]
    cases.append((*zoo.double_integrator(shape=(81, 81)), zoo.double_integrator_exact()))
    for question, grid, exact in cases:
        with jax.enable_x64(True):
            true = np.asarray(jax.vmap(exact)(grid.nodes().reshape(-1, 2))).reshape(grid.shape)
        fifth, second = (
            np.mean(np.abs(hjb.solve(question, grid, scheme=scheme).value - true))
            for scheme in (hjb.Weno5(), hjb.Limited())
        )
        assert fifth <= 1.5 * second


@pytest.mark.slow
def test_a_target_between_the_nodes_is_met():
    """Speed 1 + x²/2 towards |x| ≤ .3, at nodes that never fall on .3: T = √2 (arctan(x/√2) − arctan(.3/√2))."""
    problem = hjb.Problem(
        lambda x, u: u * (1 + x @ x / 2), lambda x, u: 1.0, U, discount=0.0, target=lambda x: jnp.abs(x[0]) - 0.3
    )
    errors = []
    for count in (40, 80):
        grid = hjb.Grid([-2.0], [2.0], (count,))
        solution = hjb.solve(problem, grid, scheme=hjb.Weno5(), tol=1e-10)
        x = np.abs(grid.nodes()[:, 0])
        exact = np.sqrt(2) * (np.arctan(x / np.sqrt(2)) - np.arctan(0.3 / np.sqrt(2)))
        errors.append(np.max(np.abs(solution.value - np.where(x <= 0.3, 0, exact))))
    assert errors[1] < 1e-4
    assert np.log2(errors[0] / errors[1]) > 1.8  # beside the target the slopes are those of Limited()


@pytest.mark.slow
def test_nodes_without_a_value_set_no_slopes():
    """A current of speed 1 from x = 1 on carries off what is there; the rest arrives at 0 as if it were not."""

    def drift(x, u):
        return jnp.where(x[0] > 1.0, 1.5, u[0])[None]

    problem = hjb.Problem(drift, lambda x, u: 1.0, U, target=lambda x: jnp.abs(x[0]) - 0.25)
    grid = hjb.Grid([-2.0], [2.0], (65,))
    with pytest.warns(hjb.SolveWarning, match="cannot reach"):
        solution = hjb.solve(problem, grid, scheme=hjb.Weno5(), tol=1e-10)
    x = grid.nodes()[:, 0]
    assert np.all(np.isinf(solution.value[x > 1]))
    there = x <= 1
    np.testing.assert_allclose(solution.value[there], np.maximum(np.abs(x[there]) - 0.25, 0), atol=1e-8)


@pytest.mark.slow
def test_a_batch_is_its_single_solves():
    problems = [zoo.smooth(discount=beta, shape=(21, 21))[0] for beta in (0.5, 1.5)]
    grid = zoo.smooth(shape=(21, 21))[1]
    batch = hjb.solve_batch(problems, grid, scheme=hjb.Weno5(), tol=1e-8)
    for lane, problem in enumerate(problems):
        alone = hjb.solve(problem, grid, scheme=hjb.Weno5(), tol=1e-8)
        np.testing.assert_allclose(batch[lane].value, alone.value, atol=1e-7)


@pytest.mark.slow
def test_a_game_in_both_precisions():
    game = hjb.Problem(
        lambda x, u, d: u + d, lambda x, u, d: x @ x + u @ u - 2 * d @ d, hjb.Box([-4.0], [4.0]),
        disturbances=hjb.Box([-1.0], [1.0]), discount=1.0,
    )  # fmt: skip
    grid = hjb.Grid([-1.0], [1.0], (41,))
    # V = p x²: p = 1 − p²(1 − 1/2), a quadratic, on which these slopes are exact
    p = np.sqrt(3) - 1
    for dtype, off in (("float64", 1e-7), ("float32", 2e-5)):
        solution = hjb.solve(game, grid, scheme=hjb.Weno5(), dtype=dtype, tol=off / 100 if dtype == "float64" else 1e-5)
        inside = np.abs(grid.nodes()[:, 0]) < 0.5
        assert np.max(np.abs(solution.value - p * grid.nodes()[:, 0] ** 2)[inside]) < off


@pytest.mark.slow
def test_noise_is_seen_at_second_order():
    exact, errors = zoo.bang_bang_exact(noise=0.5**0.5), []
    for count in (41, 81):
        problem, grid = zoo.bang_bang(noise=0.5**0.5, shape=(count,))
        solution = hjb.solve(problem, grid, scheme=hjb.Weno5(), tol=1e-6)
        errors.append(np.max(np.abs(solution.value - at_nodes_of(exact, grid, mask_of(None, grid)))))
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] > 3.5
