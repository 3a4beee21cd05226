"""Paths found without a guess: to targets, from rest, either way round a circle; and the ways out where none is."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import hjbjax as hjb
from hjbjax import zoo

CONVERGED = hjb.Status.CONVERGED


def integrator(x, u):
    return jnp.append(x[1], u)


@pytest.mark.parametrize(("start", "unit"), [(1.0, 1.0), (0.3, 1.0), (1e4, 1e4)])
def test_to_a_target_without_a_guess_of_the_costate(start, unit):
    """1 + u² a unit time, discounted: from rest, u = 0 under a costate of zero, nothing tells how long it takes."""
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: 1 + u @ u, hjb.Box([-9.0], [9.0]), target=lambda x: x[0], discount=0.7 / unit
    )
    extremal = hjb.pontryagin(problem, [start], horizon=hjb.FreeTime(unit))
    # βV = min 1 + u² + pu = 1 − p²/4 with V = 0 at the edge, so p = 2 there; and V'' = −2β
    slope = 2 - 1.4 * start / unit
    assert 1 - slope**2 / 4 == pytest.approx(0.7 / unit * extremal.cost, abs=1e-6)
    assert extremal.costates[-1, 0] == pytest.approx(2, abs=1e-6)
    assert abs(extremal.states[-1, 0]) < 1e-6 * unit


@pytest.mark.slow
def test_to_a_target_that_no_input_reaches_directly():
    """Over a length of 1 from rest with 1 + u²: u falls linearly to 0, p₁ = ν, T⁴ = 9, at the cost 4T/3."""
    problem = hjb.Problem(integrator, lambda x, u: 1 + u @ u, hjb.Box([-9.0], [9.0]), target=lambda x: x[0])
    extremal = hjb.pontryagin(problem, [1.0, 0.0])
    assert extremal.horizon == pytest.approx(np.sqrt(3), abs=1e-6)
    assert extremal.cost == pytest.approx(4 / np.sqrt(3), abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_the_brachistochrone_from_rest(unit):
    """A cycloid x = a(θ − sin θ), y = a(1 − cos θ), in the time θ √(a/g); no line is a path, for the speed stays 0."""

    def drift(x, u):
        return jnp.stack([x[2] * jnp.sin(u[0]), x[2] * jnp.cos(u[0]), unit * 9.81 * jnp.cos(u[0])])

    problem = hjb.Problem(drift, lambda x, u: jnp.ones(()), hjb.Box([-0.5], [3.0]))
    extremal = hjb.pontryagin(problem, [0.0, 0.0, 0.0], terminal=[unit, unit / 2, np.nan])
    theta = brentq(lambda a: (a - np.sin(a)) / (1 - np.cos(a)) - 2, 1.0, 6.0)
    assert extremal.cost == pytest.approx(theta * np.sqrt(0.5 / (1 - np.cos(theta)) / 9.81), abs=1e-6)


@pytest.mark.slow
def test_either_way_round_the_circle():
    problem, grid = zoo.pendulum(shape=(8, 9))
    down, up = (hjb.pontryagin(problem, [2.8, 0.0], grid=grid, rest=[rest, 0.0]) for rest in (0.0, 2 * np.pi))
    assert up.cost < 0.7 * down.cost
    for side in (1, -1):
        best = hjb.pontryagin(problem, [2.8 * side, 0.0], grid=grid)
        assert best.cost == pytest.approx(up.cost, rel=1e-6)
        np.testing.assert_allclose(best.states[-1], [2 * np.pi * side, 0], atol=1e-3)


FUEL = {"horizon": 3.0, "terminal": [0.0, 0.0], "throw": False}


@pytest.mark.slow
def test_a_cost_with_kinks_names_the_way_out_which_works():
    """|u| to rest at the origin in a time of 3: thrust, coast, brake, at the cost 3 − √5."""
    kinked = hjb.Problem(integrator, lambda x, u: jnp.abs(u[0]), hjb.Box([-1.0], [1.0]))
    failed = hjb.pontryagin(kinked, [1.0, 0.0], **FUEL)
    assert failed.status is not CONVERGED
    assert "in u[0] cost and drift are piecewise linear" in failed.message
    assert "u = u⁺ − u⁻" in failed.message
    split = hjb.Problem(
        lambda x, u: integrator(x, u[:1] - u[1:]), lambda x, u: jnp.sum(u), hjb.Box([0.0, 0.0], [1.0, 1.0])
    )
    listed = dataclasses.replace(kinked, controls=hjb.Finite([[-1.0], [0.0], [1.0]]))
    for problem in (split, listed):
        assert hjb.pontryagin(problem, [1.0, 0.0], **FUEL).cost == pytest.approx(3 - np.sqrt(5), abs=1e-6)


@pytest.mark.slow
def test_a_cost_of_the_length_of_u_names_the_way_out():
    problem = hjb.Problem(lambda x, u: jnp.concatenate([x[2:], u]), lambda x, u: jnp.linalg.norm(u), hjb.Ball(1.0, 2))
    failed = hjb.pontryagin(problem, [1.0, 0.0, 0.0, 0.3], horizon=4.0, terminal=np.zeros(4), throw=False)
    assert "a size times a direction" in failed.message


@pytest.mark.slow
def test_a_start_without_slopes_is_named():
    """The fall from rest in the height alone: √(2gy) has no slope at y = 0."""
    problem = hjb.Problem(lambda x, u: u * jnp.sqrt(x), lambda x, u: 1 + u @ u, hjb.Box([0.1], [3.0]))
    failed = hjb.pontryagin(problem, [0.0], terminal=[1.0], throw=False)
    assert failed.status is not CONVERGED
    assert "at x0 = [0.0] drift or cost has no finite derivative" in failed.message


@pytest.mark.slow
def test_an_end_on_a_kink_of_the_exit_cost_names_the_way_out():
    """Every path of least time ends on the switching curve, and there the value held on the disc has no slope."""
    problem, _ = zoo.double_integrator()
    failed = hjb.pontryagin(problem, [1.0, 0.0], throw=False)
    assert failed.status is not CONVERGED
    assert "pass it as terminal=" in failed.message
    assert "replace(problem, target=None, exit_cost=None)" in failed.message
