"""Two roads to one costate: DV of the solution on a grid along the path, and Pontryagin's λ.

The grid's own error is how much its value along the path moves when the spacing is halved.
"""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import hjbjax as hjb
from hjbjax import zoo

PROBLEMS = {"pendulum": (zoo.pendulum, (200, 201)), "van-der-pol": (zoo.van_der_pol, (241, 241))}


@functools.cache
def solved(name, halved):
    build, shape = PROBLEMS[name]
    problem, grid = build(shape=tuple((n - n % 2) // 2 + n % 2 for n in shape) if halved else shape)
    return problem, hjb.solve(problem, grid, scheme=hjb.Limited(), tol=1e-5)


def agree(name, start):
    (problem, fine), (_, coarse) = (solved(name, halved) for halved in (False, True))
    extremal = hjb.pontryagin(problem, start, guess=fine, tol=1e-6)
    check = extremal.optimality_check
    assert extremal.status is hjb.Status.CONVERGED
    assert max(check.drift, check.gap) < 1e-6 * check.scale
    states = fine.grid.wrap(extremal.states)
    error = np.max(np.abs(fine.value_at(states) - coarse.value_at(states)))
    assert np.max(np.abs(fine.value_at(states) - extremal.values)) <= error
    assert float(fine.value_at(start)) == pytest.approx(extremal.cost, abs=error, rel=0)
    assert float(fine.value_at(start)) == pytest.approx(extremal.cost, rel=5e-4)
    sizes = np.linalg.norm(extremal.costates, axis=1)
    counted = sizes > 0.01 * np.max(sizes)
    off = np.linalg.norm(fine.costate_at(states) - extremal.costates, axis=1)
    assert np.max(off[counted] / sizes[counted]) < 0.02
    assert np.max(off) < 0.02 * np.max(sizes)
    return extremal


@pytest.mark.slow
@pytest.mark.parametrize("start", [(2.0, 0.0), (0.5, -1.0)])
def test_van_der_pol(start):
    extremal = agree("van-der-pol", start)
    assert np.max(np.abs(extremal.controls)) == pytest.approx(1)  # the bound is met on the way


@pytest.mark.slow
@pytest.mark.parametrize(
    ("start", "turns"),
    [((0.5, 0.0), 0), ((2.8, 0.0), 0), pytest.param((-2.0, -2.0), -1, marks=pytest.mark.slow)],
)
def test_the_pendulum(start, turns):
    """Lifted straight up; swung to and fro across the seam at ±π; and all the way round."""
    extremal = agree("pendulum", start)
    np.testing.assert_allclose(extremal.states[-1], [2 * np.pi * turns, 0], atol=1e-4)
    assert np.all(np.abs(np.diff(extremal.states[:, 0])) < 0.5)  # no jump where the angle is wrapped
    assert len(extremal.switches) == 0


@pytest.mark.slow
def test_going_round_costs_what_another_code_says():
    """The number of ``test_limited_pendulum``, which follows the extremals from many first guesses of its own."""
    problem, solution = solved("pendulum", False)
    extremal = hjb.pontryagin(problem, [np.pi / 4, 0.0], guess=solution)
    assert extremal.cost == pytest.approx(13.3240, abs=1e-3)


@pytest.mark.slow
def test_a_finite_horizon():
    """A marched solution: its DV at every time along the path, and as the first guess."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-9.0], [9.0]))
    grid, times = hjb.Grid([-1.5], [1.5], (121,)), np.linspace(0, 1.5, 31)
    marched = hjb.march(problem, grid, 1.5, times=times, scheme=hjb.Weno5())
    extremal = hjb.pontryagin(problem, [1.0], horizon=1.5, guess=marched)
    assert extremal.cost == pytest.approx(np.tanh(1.5), abs=1e-8)
    slopes = marched.costate_at(extremal.times, extremal.states)
    np.testing.assert_allclose(slopes, extremal.costates, atol=0.02 * np.max(extremal.costates))


@pytest.mark.slow
def test_least_time_from_the_solution_on_a_grid():
    """To rest at the origin; the grid's feedback chatters where the extremal switches once."""
    problem, grid = zoo.double_integrator(shape=(41, 41))
    solution = hjb.solve(problem, grid, tol=1e-4, scheme=hjb.Upwind())
    to_rest = dataclasses.replace(problem, target=None, exit_cost=None)
    extremal = hjb.pontryagin(to_rest, [1.0, 0.0], terminal=[0.0, 0.0], guess=solution)
    assert extremal.cost == pytest.approx(1 - np.exp(-2), abs=1e-6)
    assert extremal.switches == pytest.approx([1], abs=1e-6)


@pytest.mark.slow
def test_a_loop_as_the_guess_of_a_free_time_without_end_states():
    """At full unit speed until a final cost of 2x² pays no more, at x = ½."""
    grid = hjb.Grid([-3.0], [3.0], (25,))
    x = grid.nodes()
    solution = hjb.Solution(grid, 2 * np.abs(x[..., 0]), -np.sign(x), code=1)
    problem = hjb.Problem(lambda x, u: u, lambda x, u: 1 + u @ u, hjb.Box([-9.0], [9.0]))
    free = {"horizon": hjb.FreeTime(2.0), "terminal": lambda x: 2 * x @ x}
    extremal = hjb.pontryagin(problem, [1.0], guess=solution, **free)
    assert (extremal.horizon, extremal.cost) == pytest.approx((0.5, 1.5), abs=1e-7)


@pytest.mark.slow
def test_a_loop_as_the_guess_where_the_start_is_at_rest_and_the_end_has_to_be():
    """Over d = 1 − x(T) in T = √(6d) at the cost 4/3 T; where to stop is up to the final cost 10x²."""
    grid = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (9, 9))
    x = grid.nodes()
    solution = hjb.Solution(grid, np.sum(x**2, -1), -np.sum(x, -1, keepdims=True), code=1)
    problem = hjb.Problem(
        lambda x, u: jnp.stack([x[1], u[0]]),
        lambda x, u: 1 + u @ u,
        hjb.Box([-9.0], [9.0]),
        terminal_cost=lambda x: 10 * x[0] ** 2,
    )
    ends = {"horizon": hjb.FreeTime(3.0), "terminal": [np.nan, 0.0]}
    extremal = hjb.pontryagin(problem, [1.0, 0.0], guess=solution, **ends)
    far = brentq(lambda d: 2 / 3 * np.sqrt(6 / d) - 20 * (1 - d), 0.5, 1.0)
    assert extremal.horizon == pytest.approx(np.sqrt(6 * far), abs=1e-6)
    assert extremal.cost == pytest.approx(4 / 3 * np.sqrt(6 * far) + 10 * (1 - far) ** 2, abs=1e-6)
