"""The feedback that minimises the Hamiltonian at the state, against exact values, and beside the interpolated one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.feedback.feedback import greedy_feedback
from hjbjax.feedback.simulation import simulate
from hjbjax.problem.grid import Grid
from hjbjax.problem.mode_axis import with_modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import Box, Finite
from hjbjax.solution.solution import Solution
from hjbjax.solvers.stationary import solve


def exact_at_nodes(grid, exact, policy):
    with jax.enable_x64(True):
        value = np.asarray(jax.vmap(exact)(grid.nodes().reshape(-1, grid.ndim))).reshape(grid.shape)
    return Solution(grid, value, policy)


@pytest.mark.slow
def test_at_a_switching_curve_it_is_nearer_to_the_least_time_than_the_mean_of_two_controls():
    """The double integrator with exact T at the nodes, sampled: what is lost between the nodes, and nothing else."""
    problem, grid = zoo.double_integrator(discount=0.0, shape=(61, 61))
    exact = zoo.double_integrator_exact(discount=0.0)
    x = grid.nodes()
    side = x[..., 0] + 0.5 * x[..., 1] * np.abs(x[..., 1])
    policy = -np.where(side == 0, np.sign(x[..., 1]), np.sign(side))[..., None]
    policy[np.sum(x * x, -1) <= 0.04] = np.nan
    solution = exact_at_nodes(grid, exact, policy)
    greedy = greedy_feedback(problem, solution)
    lost = {"means": 0.0, "greedy": 0.0}
    for x0 in ([1.0, 0.0], [-1.2, 0.5], [1.0, 1.0]):
        for name, feedback in (("means", solution), ("greedy", greedy)):
            path = simulate(problem, feedback, x0, 6.0, hold=0.01)
            assert path.reached is not None
            lost[name] += path.cost - float(exact(np.array(x0)))
            if name == "greedy":  # admissible, and at a bound but where the slope is zero to rounding
                assert set(np.unique(path.controls)) == {-1.0, 1.0}
                assert path.steps < 1500  # no sliding for ever
    assert 0 < lost["greedy"] < 0.35 * lost["means"]


@pytest.mark.slow
@pytest.mark.parametrize("source", ["exact", pytest.param("solved", marks=pytest.mark.slow)])
def test_its_cost_is_nearer_to_the_value_of_the_eikonal_equation(source):
    problem, grid = zoo.eikonal(discount=0.0, shape=(21, 21))
    exact = zoo.eikonal_exact(discount=0.0)
    if source == "solved":
        solution = solve(problem, grid)
    else:
        x = grid.nodes()
        distance = np.linalg.norm(x, axis=-1, keepdims=True)
        solution = exact_at_nodes(grid, exact, np.where(distance > 0.2 + 1e-9, -x / np.maximum(distance, 0.1), np.nan))
    lost = []
    for feedback in (solution, greedy_feedback(problem, solution)):
        paths = [simulate(problem, feedback, x0, 3.0) for x0 in ([0.8, 0.5], [0.9, -0.13], [-0.5, 0.55])]
        assert all(path.reached is not None for path in paths)
        lost.append(sum(path.cost - float(exact(path.states[0])) for path in paths))
        assert max(np.linalg.norm(path.controls, axis=-1).max() for path in paths) < 1 + 1e-9
    means, least = lost
    assert 0 <= least < 0.6 * means


def quadratic(x):
    return x @ jnp.array([[2.0, 0.5], [0.5, 1.0]]) @ x


@pytest.mark.parametrize("noisy", [pytest.param(False, marks=pytest.mark.slow), True])
def test_it_is_the_minimiser_of_a_game_also_where_the_control_drives_the_noise(noisy):
    """V quadratic, so that the differences are exact; u minimises 2u² − .3u + uV₁ + ½σ²(u)V₁₁, and d maximises."""
    grid, x = Grid([-1.0, -1.0], [1.0, 1.0], (11, 11)), np.array([0.23, -0.41])

    def cost(x, u, d):
        return 2 * u[0] ** 2 - 0.3 * u[0] - 3 * d[0] ** 2

    def noise(x, u, d):
        return jnp.stack([0.5 * jnp.sqrt(1 + u[0]), 0.4 + 0 * x[0]])

    sets = {"controls": Box([-0.9], [2.0]), "disturbances": Box([-2.0], [2.0]), "noise": noise if noisy else None}
    problem = Problem(lambda x, u, d: jnp.stack([u[0], d[0]]), cost, **sets)
    nothing = np.zeros((*grid.shape, 1))
    greedy = greedy_feedback(
        problem, dataclasses.replace(exact_at_nodes(grid, quadratic, nothing), disturbance=nothing)
    )
    slopes, bend = [4 * x[0] + x[1], x[0] + 2 * x[1]], 0.125 * 4 if noisy else 0.0
    wanted = -(slopes[0] - 0.3 + bend) / 4
    accuracy = 1e-5 if noisy else 1e-12  # searched, or exact
    assert greedy(x)[0] == pytest.approx(wanted, abs=accuracy)
    assert greedy.disturbance_at(x)[0] == pytest.approx(slopes[1] / 6, abs=accuracy)


@pytest.mark.slow
def test_enumerated_controls_are_members_and_marched_values_are_asked_at_the_time():
    grid, times = Grid([-1.0], [1.0], (21,), periodic=(True,)), np.array([0.0, 1.0])
    place = grid.nodes()[..., 0]
    value = np.stack([np.cos(np.pi * place), -np.cos(np.pi * place)])  # uphill and downhill change places
    problem = Problem(lambda x, u: u, None, Finite([[-1.0], [0.2], [1.0]]))
    greedy = greedy_feedback(problem, Solution(grid, value, np.zeros((2, 21, 1)), times=times, discrete=True))
    assert [greedy(t, [0.31])[0] for t in (0.0, 0.2, 0.8, 1.0)] == [1.0, 1.0, -1.0, -1.0]
    assert greedy(0.0, [0.31 + 2.0])[0] == 1.0  # wrapped
    assert greedy(np.array([0.0, 1.0]), np.array([[0.31], [0.31]])).tolist() == [[1.0], [-1.0]]
    batched = jax.jit(jax.vmap(lambda t, x: greedy(t, x)))(jnp.array([0.1, 0.9]), jnp.array([[-0.4], [-0.4]]))
    assert batched.tolist() == [[-1.0], [1.0]]
    with pytest.warns(UserWarning, match="lie outside the kept times"):
        assert np.isnan(greedy.control_at(2.0, [0.31])).all()


def test_it_is_blind_where_the_value_is_infinite_and_refuses_what_is_no_solution():
    grid = Grid([0.0], [1.0], (11,))
    value = np.where(grid.nodes()[..., 0] > 0.65, np.inf, grid.nodes()[..., 0])
    problem = Problem(lambda x, u: u, lambda x, u: 1.0, Box([-1.0], [1.0]))
    solution = Solution(grid, value, np.zeros((11, 1)))
    greedy = greedy_feedback(problem, solution)
    assert greedy([0.43]).tolist() == [-1.0]
    assert np.isnan(greedy([0.83])).all()
    with pytest.raises(TypeError, match="wanted a Solution"):
        greedy_feedback(problem, lambda x: x)
    with pytest.raises(TypeError, match="wanted a Problem"):
        greedy_feedback(solution, problem)
    with pytest.raises(ValueError, match="nothing to choose"):
        greedy_feedback(Problem(lambda x, u: -x), solution)
    with pytest.raises(ValueError, match="its players differ"):
        greedy_feedback(Problem(lambda x, u: u, None, Box([-1.0] * 2, [1.0] * 2)), solution)
    with pytest.raises(ValueError, match="no batch"):
        greedy_feedback(problem, Solution(grid, np.stack([value, value]), np.zeros((2, 11, 1))))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:simulate. the path costs")  # V is made by hand
def test_it_does_not_leave_across_a_constrained_end():
    """V falls towards both ends; only the upper one is constrained, and the nodes' control vanishes there."""
    grid = Grid([0.0], [1.0], (11,), edges=[("projected", "constrained")])
    x = grid.nodes()
    problem = Problem(lambda x, u: u, lambda x, u: x @ x, Box([-1.0], [1.0]))
    policy = np.where(x > 0.95, 0.0, np.where(x > 0.45, 1.0, -1.0))
    greedy = greedy_feedback(problem, Solution(grid, -((x[:, 0] - 0.5) ** 2), policy))
    assert greedy(np.array([[0.03], [0.3], [0.85], [0.98], [1.0]]))[:, 0].round(9).tolist() == [
        -1.0,
        -1.0,
        1.0,
        0.2,
        0.0,
    ]
    path = simulate(problem, greedy, [0.7], 2.0)
    assert path.status.name == "DURATION"
    assert 0.999 < path.states[-1, 0] <= 1


def test_at_a_wall_it_sees_the_mirror_image():
    """w(u − 1)² + ½u²V″ with V = cos πx, even about both walls: u = 2w/(2w + V″), on the walls as inside."""
    grid = Grid([0.0], [1.0], (81,))
    problem = Problem(lambda x, u: 0 * x, lambda x, u: 9 * (u[0] - 1) ** 2, Box([0.0], [3.0]), noise=lambda x, u: u)
    solution = exact_at_nodes(grid, lambda x: jnp.cos(jnp.pi * x[0]), np.ones((81, 1)))
    x = np.array([0.0, 0.004, 0.3, 0.7, 0.996, 1.0])
    found = [float(greedy_feedback(problem, solution)(jnp.array([place]))[0]) for place in x]
    np.testing.assert_allclose(found, 18 / (18 - np.pi**2 * np.cos(np.pi * x)), rtol=0.02)


# --- sudden changes ---


def machine(rate=lambda x, u: jnp.array([[0.0, 0.3], [0.0, 0.0]]) + u[0] * jnp.array([[0.0, 0.0], [1.0, 0.0]]), **more):
    """Effort repairs a broken machine, and may damage what it makes."""
    return hjb.Problem(
        lambda x, u, mode: (0.5, -0.5)[mode] * (1 - x) + 0.2 * u, controls=hjb.Box([0.0], [2.0]), discount=0.2,
        reward=lambda x, u, mode: (1.0, 0.0)[mode] * x[0] - 0.4 * u[0] ** 2,
        modes=hjb.Modes(("works", "broken"), rates=rate), **more,
    )  # fmt: skip


DAMAGE = [hjb.Jump(lambda x, u, mode: 0.3 * u[0], lambda x, u, mode: x / 2, cost=lambda x, u, mode: 0.1 * u[0])]


@pytest.fixture(scope="module")
def machines():
    problem = machine(jumps=DAMAGE, growth=lambda x, u, mode: -0.05 * u[0])
    return problem, hjb.solve(problem, hjb.Grid([0.0], [2.0], (41,)), tol=1e-6)


@pytest.mark.slow
def test_a_greedy_feedback_weighs_sudden_changes(machines):
    """The control maximises the Hamiltonian with the gains from a repair, a jump and the growth, over dense samples."""
    problem, solution = machines
    feedback = hjb.greedy_feedback(problem, solution)
    efforts = np.linspace(0, 2, 20_001)
    for mode, name in enumerate(problem.modes.names):
        for x in (0.33, 1.02, 1.71):
            v, other, after = (solution.value_at([y], mode=m) for y, m in ((x, mode), (x, 1 - mode), (x / 2, mode)))
            p = solution.costate_at([x], mode=mode)[0]
            gains = (1.0, 0.0)[mode] * x - 0.4 * efforts**2 + p * ((0.5, -0.5)[mode] * (1 - x) + 0.2 * efforts)
            gains += (
                (0.3, efforts)[mode] * (other - v) + 0.3 * efforts * (after - v - 0.1 * efforts) - 0.05 * efforts * v
            )
            found = feedback([x], mode=name)
            assert found[0] == pytest.approx(efforts[np.argmax(gains)], abs=2e-4)
            np.testing.assert_array_equal(found, feedback(np.array([mode, x])))
    assert abs(feedback([1.0], mode="broken")[0] - solution.control_at([1.0], mode="broken")[0]) < 0.05


@pytest.mark.slow
def test_simulate_takes_a_greedy_feedback_with_modes(machines):
    problem, solution = machines
    path = hjb.simulate(problem, hjb.greedy_feedback(problem, solution), [1.0], 10.0, mode="broken", key=2, steps=50)
    assert set(path.modes) == {0, 1}
    where = np.flatnonzero(path.modes == 1)[1:-1]
    wanted = hjb.greedy_feedback(problem, solution).control_at(path.states[where], mode="broken")
    np.testing.assert_allclose(path.controls[where], wanted, atol=1e-6)


def test_what_a_greedy_feedback_with_modes_refuses():
    problem, grid = machine(), with_modes(Grid([0.0], [2.0], (5,)), ("works", "broken"))
    solution = Solution(grid, np.zeros((2, 5)), np.zeros((2, 5, 1)))
    with pytest.raises(ValueError, match="got jumps whose landing depends on an action") as caught:
        hjb.greedy_feedback(machine(jumps=[hjb.Jump(1.0, lambda x, u, mode: x - u)]), solution)
    assert "pass the solution itself" in str(caught.value)
    with pytest.raises(ValueError, match=r"modes \('works', 'broken'\) and a solution with \(\)"):
        hjb.greedy_feedback(problem, solution.in_mode("works"))
    with pytest.raises(ValueError, match="without a mode"):
        hjb.greedy_feedback(problem, solution)([1.0])
