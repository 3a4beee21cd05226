"""Targets whose boundary runs between the nodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hjbjax as hjb
from hjbjax.problem.pytree import pytree_dataclass


@pytree_dataclass()
class Disc:
    """A disc as a target, by its signed distance."""

    radius: float

    def distance(self, x):
        return jnp.sqrt(x @ x) - self.radius


def go(x, u):
    return u


def one(x, u):
    return jnp.ones(())


def minimum_time(radius, dim, discount=0.0, **more):
    controls = hjb.Ball(1.0, dim) if dim > 1 else hjb.Box([-1.0], [1.0])
    return hjb.Problem(go, one, controls, discount=discount, target=Disc(radius).distance, **more)


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(st.floats(0.11, 0.9))
def test_on_a_line_the_distance_is_exact(radius):
    """ẋ = u: T = |x| − r at every node, wherever the boundary lies between two of them."""
    grid = hjb.Grid([-2.0], [2.0], (41,))
    solution = hjb.solve(minimum_time(radius, 1), grid, scheme=hjb.Upwind(subcell=True), tol=1e-9)
    away = np.abs(grid.axis(0))
    wanted = np.where(away > radius, away - radius, 0.0)
    clear = np.abs(away - radius) > 2e-3  # nearer than that the link is not cut further
    np.testing.assert_allclose(solution.value[clear], wanted[clear], atol=2e-3)
    assert np.max(np.abs(solution.value - wanted)) <= 2e-3


def errors(scheme, counts):
    found = []
    for count in counts:
        grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (count, count))
        solution = hjb.solve(minimum_time(0.2, 2, discount=1.0), grid, scheme=scheme, tol=1e-6)
        r = np.linalg.norm(grid.nodes(), axis=-1)
        found.append(np.max(np.abs(solution.value - np.where(r > 0.2, 1 - np.exp(0.2 - r), 0))))
    return found


@pytest.mark.slow
def test_the_plain_scheme_on_a_disc():
    """The table of first-order errors: 2.8e-2 with nodes snapped to zero, 9.2e-3 with exact values inside."""
    (snapped,), (cut,) = errors(hjb.Upwind(), (41,)), errors(hjb.Upwind(subcell=True), (41,))
    assert snapped == pytest.approx(2.8e-2, rel=0.05)
    assert cut <= 9.2e-3


@pytest.mark.slow
def test_second_order_up_to_the_target():
    coarse, fine = errors(hjb.Limited(), (41, 81))
    assert fine <= 3e-4
    assert np.log2(coarse / fine) >= 1.8


def test_an_exit_cost_is_met_where_the_boundary_is():
    """Exit cost x on the target {x ≥ .93}, running cost 1, ẋ = 1: V = .93 + (.93 − x)."""

    problem = hjb.Problem(lambda x, u: jnp.ones(1), one, target=lambda x: 0.93 - x[0], exit_cost=lambda x: x[0])
    grid = hjb.Grid([0.0], [1.0], (11,))
    solution = hjb.solve(problem, grid, scheme=hjb.Upwind(subcell=True), tol=1e-9)
    np.testing.assert_allclose(solution.value[:10], 0.93 + 0.93 - grid.axis(0)[:10], atol=1e-9)


@pytest.mark.slow
def test_certificates_and_derivatives_hold_with_cut_links():

    grid = hjb.Grid([-2.0], [2.0], (41,))
    scheme = hjb.Upwind(subcell=True)

    def at(radius, cost):
        problem = minimum_time(radius, 1, exit_cost=cost)
        return hjb.solve(problem, grid, scheme=scheme, tol=1e-9, method=hjb.PolicyIteration()).value_at(
            jnp.array([1.3])
        )

    with jax.enable_x64(True):
        by_radius, by_cost = jax.grad(at, (0, 1))(0.43, 0.5)
    assert float(by_radius) == pytest.approx(-1.0, abs=1e-6)
    assert float(by_cost) == pytest.approx(1.0, abs=1e-6)
    rough = hjb.solve(minimum_time(0.43, 1), grid, scheme=scheme, tol=0.3, max_steps=8, throw=False)
    lower, upper = rough.bounds
    wanted = np.maximum(np.abs(grid.axis(0)) - 0.43, 0)
    assert np.all(lower <= wanted + 1e-9)
    assert np.all(wanted <= upper + 1e-9)
