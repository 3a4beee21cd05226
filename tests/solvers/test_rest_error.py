"""Rest points between the nodes: both grids may have the same nearest node, and then comparing them shows nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

partial = jax.tree_util.Partial
# c between the nodes of [-1, 1] with 41 and 81 nodes, at and near the middle of an interval, by a node of either parity
CENTRES = (0.012, 0.02, 0.0249, 0.03, 0.06, 0.07)


def drift(x, u):
    return u


def distance(centre, power, sign, x, u):
    return sign * jnp.sum(jnp.abs(x - centre) ** power)


def value(far, power, discount):
    """∫ exp(−βt) (y − t)^p dt over 0 ≤ t ≤ y, by the midpoint rule in s with y − t = s²."""
    s = np.sqrt(far)[..., None] * (np.arange(4000) + 0.5) / 4000
    rest = np.exp(-discount * (far[..., None] - s**2)) * s ** (2 * power) * 2 * s
    return np.mean(rest, axis=-1) * np.sqrt(far)


@pytest.mark.filterwarnings("ignore:the grid is coarse")
@pytest.mark.parametrize("power", [1.0, 0.5])
@pytest.mark.parametrize("sign", [1.0, pytest.param(-1.0, marks=pytest.mark.slow)])
def test_an_estimate_sees_a_rest_point_between_nodes(power, sign):
    for count in (41, 81):
        grid = hjb.Grid([-1.0], [1.0], (count,))
        for centre in CENTRES:
            paid = {"cost" if sign > 0 else "reward": partial(distance, centre, power, sign)}
            problem = hjb.Problem(drift, controls=hjb.Box([-1.0], [1.0]), discount=0.1, **paid)
            solution = hjb.solve(problem, grid)
            error = np.max(np.abs(solution.value - sign * value(np.abs(grid.axis(0) - centre), power, 0.1)))
            assert np.max(solution.grid_error) >= 0.33 * error
            if power == 1.0:  # the two nearest nodes of a root may be equally far, and their errors very different
                assert np.max(solution.grid_error) <= 3 * error


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is coarse")
@pytest.mark.parametrize("centre", [(0.0249, 0.02), (0.0, 0.06)])
def test_it_sees_one_in_the_plane(centre):
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (41, 41))
    problem = hjb.Problem(
        drift, partial(distance, np.array(centre), 1.0, 1.0), hjb.Box([-1.0] * 2, [1.0] * 2), discount=0.1
    )
    solution = hjb.solve(problem, grid)
    exact = sum(value(np.abs(grid.nodes()[..., i] - centre[i]), 1.0, 0.1) for i in range(2))
    error = np.max(np.abs(solution.value - exact))
    assert 0.33 * error <= np.max(solution.grid_error) <= 3 * error


def test_a_rest_point_on_a_node_and_a_cost_without_a_kink_add_nothing():
    grid = hjb.Grid([-1.0], [1.0], (41,))
    for centre, power in ((0.0, 1.0), (0.05, 1.0), (0.0, 2.0)):
        problem = hjb.Problem(drift, partial(distance, centre, power, 1.0), hjb.Box([-1.0], [1.0]), discount=1.0)
        assert np.max(hjb.solve(problem, grid).grid_error) <= 0.02


def test_a_cost_that_falls_between_nodes_but_is_not_least_there_adds_nothing():
    grid = hjb.Grid([-1.0], [3.0], (41,))  # rests at x = u = 1, where the cost still falls in x for this u
    problem = hjb.Problem(
        lambda x, u: u - x, lambda x, u: (x[0] - 2) ** 2 + u @ u, hjb.Box([-3.0], [3.0]), discount=0.1
    )
    p = (-2.1 + np.sqrt(2.1**2 + 4)) / 2  # V = p x² + q x + r by the Riccati equation
    q = -4 / (0.1 + 1 + p)
    r = (4 - q**2 / 4) / 0.1
    x, solution = grid.axis(0), hjb.solve(problem, grid)
    inside = np.abs(x - 1) < 1
    error = np.max(np.abs(solution.value - (p * x**2 + q * x + r))[inside])
    assert error <= np.max(solution.grid_error[inside]) + 1e-3
    assert np.max(solution.grid_error[inside]) <= 0.2


def test_a_cost_may_be_undefined_between_nodes():
    grid = hjb.Grid([-1.0], [1.0], (42,))  # zero is between two nodes, also on the coarser grid
    problem = hjb.Problem(drift, lambda x, u: x[0] ** 3 / x[0] + 0 * u[0], hjb.Box([-1.0], [1.0]), discount=1.0)
    solution = hjb.solve(problem, grid)
    error = np.max(np.abs(solution.value - value(np.abs(grid.axis(0)), 2.0, 1.0)))
    assert error <= 3 * np.max(solution.grid_error) <= 0.02


def wave(amplitude, centre, x):
    return -amplitude * jnp.prod(jnp.cos(3 * (x - centre)))


def pushed(speed, wind, x, u):
    return wind * jnp.cos(x) + speed * u


def narrow(value, speed, wind, weight, discount, x, u):
    """The running cost for which ``value`` solves β V = min{L + f V′} with |u| ≤ 1."""
    slope = jax.grad(value)(x)
    best = jnp.clip(-speed * slope / (2 * weight), -1, 1)
    least = jnp.sum(speed * best * slope + weight * best**2)
    return discount * value(x) - wind * jnp.cos(x) @ slope - least + weight * u @ u


def manufactured(axes, centre, wind, amplitude, unit=1.0):
    exact, speed, weight, discount = partial(wave, unit * amplitude, np.array(centre)), 1.7, 0.5 * unit, 0.12
    return exact, hjb.Problem(
        partial(pushed, speed, wind),
        partial(narrow, exact, speed, wind, weight, discount),
        hjb.Box([-1.0] * axes, [1.0] * axes),
        discount=discount,
    )


@pytest.mark.filterwarnings("ignore:the grid is coarse")
@pytest.mark.parametrize("unit", [1.0, 1e5])
@pytest.mark.parametrize("wind", [0.0, 0.3])
@pytest.mark.parametrize("centre", [0.03, 0.05, 0.079])
def test_it_sees_a_narrow_minimum_that_no_path_of_the_grid_stays_at(centre, wind, unit):
    """V is smooth, but L/β at rest rises by more than the range of V from its minimum to the nearest node."""
    grid = hjb.Grid([0.0], [2 * np.pi], (40,), periodic=(True,))
    exact, problem = manufactured(1, [centre], wind, 2.0, unit)
    solution = hjb.solve(problem, grid, tol=1e-4 * unit)
    error = np.abs(solution.value - jax.vmap(exact)(grid.nodes()))
    assert error.max() > 0.2 * unit
    assert 1 / 3 < solution.grid_error.max() / error.max() < 3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is coarse")
@pytest.mark.parametrize("centre", [(0.03, 0.05), (0.079, 0.079)])
def test_it_sees_a_narrow_minimum_in_the_plane(centre):
    grid = hjb.Grid([0.0, 0.0], [2 * np.pi, 2 * np.pi], (40, 36), periodic=(True, True))
    exact, problem = manufactured(2, centre, 0.3, 2.0)
    solution = hjb.solve(problem, grid)
    error = np.abs(solution.value - jax.vmap(jax.vmap(exact))(grid.nodes()))
    assert error.max() > 0.2
    assert 1 / 3 < solution.grid_error.max() / error.max() < 3


def test_it_warns_without_a_coarser_grid():
    grid = hjb.Grid([0.0], [2 * np.pi], (10,), periodic=(True,))
    exact, problem = manufactured(1, [0.2], 0.0, 2.0)
    with pytest.warns(hjb.SolveWarning, match="the grid is coarse"):
        solution = hjb.solve(problem, grid)
    assert np.max(np.abs(solution.value - jax.vmap(exact)(grid.nodes()))) > 0.4
    assert solution.grid_error is None
