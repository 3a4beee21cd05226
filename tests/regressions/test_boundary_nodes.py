"""A node on the boundary of a target belongs to it in every program that asks, and a seam is no other place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.markov_chain import chain

TWO = hjb.Finite([[-1.0], [1.0]])
partial = jax.tree_util.Partial


def straight(x, u):
    return u


def one(x, u):
    return 1.0


def around_zero(radius, x):
    return jnp.linalg.norm(x) - radius


def timed(radius, controls=TWO):
    return hjb.Problem(straight, one, controls, target=partial(around_zero, radius), discount=1.0)


@pytest.mark.parametrize("dtype", [None, "float32"])
@pytest.mark.parametrize("half", [1.0, 2.0, 3.0, 0.3])
def test_nodes_on_the_boundary_are_held(half, dtype):
    grid = hjb.Grid([-half], [half], (41,))
    for cells in (2, 6, 10, 14):
        value = hjb.solve(timed(cells * half / 20), grid, tol=1e-4, dtype=dtype, scheme=hjb.Upwind()).value
        assert np.array_equal(value == 0, np.abs(np.arange(-20, 21)) <= cells), cells


@pytest.mark.slow
def test_all_programs_hold_the_same_nodes():
    grid, problem = hjb.Grid([-2.0], [2.0], (41,)), timed(0.3)
    value = hjb.solve(problem, grid, tol=1e-9, scheme=hjb.Upwind()).value
    with jax.enable_x64(True):
        given = jax.jit(lambda problem, grid: hjb.solve(problem, grid, tol=1e-9, scheme=hjb.Upwind()).value)(
            problem, grid
        )
        closed_over = jax.jit(lambda problem: hjb.solve(problem, grid, tol=1e-9, scheme=hjb.Upwind()).value)(problem)
        lanes = jax.vmap(lambda radius: hjb.solve(timed(radius), grid, tol=1e-9, scheme=hjb.Upwind()).value)(
            jnp.array([0.3, 0.4])
        )
    costs, transitions, states, _, factor = chain.transition_arrays(problem, grid)
    pairs = costs + factor * transitions @ value
    exported = np.array([pairs[states == node].min() for node in range(41)])
    for other in (
        given,
        closed_over,
        lanes[0],
        hjb.solve_batch([problem], grid, tol=1e-9, scheme=hjb.Upwind())[0].value,
        exported,
    ):
        assert np.allclose(other, value, atol=1e-8)
    assert np.allclose(hjb.march(problem, grid, 40.0, scheme=hjb.Upwind(split=True)).value[0], value, atol=1e-6)


@pytest.mark.parametrize("half", [1.0, 10.0, 0.3])
def test_a_circle_through_nodes(half):
    """Where √(x² + y²) − r is some rounding: a relative whose target itself rounds, whatever the coordinates do."""
    grid = hjb.Grid([-half, -half], [half, half], (41, 41))
    problem = timed(half / 2, hjb.Finite([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))
    i, j = np.meshgrid(np.arange(-20, 21), np.arange(-20, 21), indexing="ij")
    assert np.array_equal(hjb.solve(problem, grid, tol=1e-3, scheme=hjb.Upwind()).value == 0, i * i + j * j <= 100)


def test_a_steep_target_does_not_grow():
    """What rounding does is taken from the slopes near by, not from values of 10¹⁷ elsewhere."""
    problem = hjb.Problem(straight, one, TWO, target=lambda x: jnp.exp(10 * jnp.abs(x[0])) - 5.0, discount=1.0)
    grid = hjb.Grid([-4.0], [4.0], (81,))
    assert np.array_equal(
        hjb.solve(problem, grid, scheme=hjb.Upwind()).value == 0, np.exp(10 * np.abs(grid.axis(0))) <= 5
    )


@pytest.mark.slow
@pytest.mark.parametrize("stretch", [None, (hjb.Sinh(2.0),)])
def test_the_corners_of_a_grid_have_derivatives(stretch):
    """Coordinates are data, and follow the corners all the same."""
    problem = hjb.Problem(straight, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)

    def value(lo):
        return hjb.solve(problem, hjb.Grid([lo], [2.0], (41,), stretch=stretch), tol=1e-10, scheme=hjb.Upwind()).value[
            10
        ]

    def of_grid(grid):
        return hjb.solve(problem, grid, tol=1e-10, scheme=hjb.Upwind()).value[10]

    with jax.enable_x64(True):
        slope = jax.grad(value)(-2.0)
        by_leaf = jax.grad(of_grid)(hjb.Grid([-2.0], [2.0], (41,), stretch=stretch)).lo[0]
    difference = (value(-2.0 + 1e-5) - value(-2.0 - 1e-5)) / 2e-5
    assert np.isclose(slope, difference, rtol=1e-4)
    assert np.isclose(by_leaf, slope, rtol=1e-9)


@pytest.mark.slow
def test_an_exit_cost_behind_the_seam_is_that_before_it():
    h = 2 * np.pi / 40
    grid = hjb.Grid([0.0], [2 * np.pi], (40,), periodic=(True,))

    def near(x):
        return jnp.abs(jnp.mod(x[0] + h + jnp.pi, 2 * jnp.pi) - jnp.pi) - 0.6 * h

    def value(exit_cost, mirrored=False):
        target = (lambda x: near(2 * np.pi - x)) if mirrored else near
        problem = hjb.Problem(straight, one, hjb.Box([-1.0], [1.0]), target=target, exit_cost=exit_cost)
        return hjb.solve(problem, grid, scheme=hjb.Upwind(subcell=True), tol=1e-9).value

    plain, wrapped = value(lambda x: 0.1 * x[0]), value(lambda x: 0.1 * jnp.mod(x[0], 2 * jnp.pi))
    assert np.allclose(plain, wrapped, atol=1e-9)
    plain, wrapped = (value(cost, True) for cost in (lambda x: 0.1 * x[0], lambda x: 0.1 * jnp.mod(x[0], 2 * jnp.pi)))
    assert np.allclose(plain, wrapped, atol=1e-9)


@pytest.mark.parametrize("far", [pytest.param(1e12, marks=pytest.mark.slow), 1e20])
def test_a_jump_of_the_level_holds_no_node_beside_it(far):
    def level(x):
        return jnp.where(x[0] > 1.05, far, x[0] - 0.05)

    problem = hjb.Problem(straight, one, hjb.Box([-1.0], [1.0]), target=level)
    grid = hjb.Grid([0.0], [2.0], (21,))
    assert np.allclose(hjb.solve(problem, grid, tol=1e-6, scheme=hjb.Upwind()).value, grid.axis(0), atol=1e-5)
