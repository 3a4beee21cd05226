"""Derivatives of the answer of second order: against central differences, and where there is none."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.iteration import adjoint

GRID = hjb.Grid([-np.pi, -6.0], [np.pi, 6.0], (24, 25), periodic=(True, False))
PLACES = jnp.array([[0.4, 0.3], [-1.2, 0.8], [2.5, -1.0]])


def pendulum(mass, *, bound=3.0, weight=0.1):
    return hjb.Problem(
        lambda x, u: jnp.stack([x[1], jnp.sin(x[0]) + u[0] / mass]),
        lambda x, u: 1 - jnp.cos(x[0]) + 0.1 * x[1] ** 2 + weight * u @ u,
        hjb.Box(jnp.stack([-bound]), jnp.stack([bound])), discount=0.5,
    )  # fmt: skip


def answers(mass, scheme=None):
    """Values, controls and costates at some states."""
    solution = hjb.solve(pendulum(mass), GRID, scheme=scheme, tol=1e-12)
    return solution.value_at(PLACES), solution.control_at(PLACES), solution.costate_at(PLACES), solution.code


def slope(function, at, step=1e-5):
    """Central differences of fourth order, entry by entry."""
    near, far = ((function(at + k * step) - function(at - k * step)) / (2 * k * step) for k in (1, 2))
    return (4 * near - far) / 3


@functools.cache
def compiled():
    return jax.jit(answers), jax.jit(jax.jacfwd(lambda mass: answers(mass)[:3]))


@pytest.mark.slow
def test_values_controls_and_costates_move_as_central_differences_do():
    with jax.enable_x64(True):
        answer, forward = compiled()
        assert hjb.Status(int(answer(1.2)[3])) is hjb.Status.CONVERGED
        for k, found in enumerate(forward(1.2)):
            wanted = slope(lambda mass, k=k: answer(mass)[k], 1.2)
            assert np.max(np.abs(wanted)) > 0.01
            np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6 * np.max(np.abs(wanted)))


@pytest.mark.slow
def test_reverse_mode_agrees_and_lanes_are_single_solves():
    with jax.enable_x64(True):
        answer, forward = compiled()
        gradient = jax.jit(jax.vmap(jax.value_and_grad(lambda mass: answers(mass)[0][1])))
        values, found = gradient(jnp.array([1.0, 1.2]))
        for mass, value, each in zip((1.0, 1.2), values, found, strict=True):
            assert float(value) == pytest.approx(float(answer(mass)[0][1]), rel=1e-9)
            assert float(each) == pytest.approx(float(forward(mass)[0][1]), rel=1e-8)
        assert values.dtype == found.dtype == jnp.float64


@pytest.mark.slow
def test_the_answer_is_that_of_the_host():
    host = hjb.solve(pendulum(1.2), GRID, tol=1e-12)
    with jax.enable_x64(True):
        np.testing.assert_allclose(compiled()[0](1.2)[0], host.value_at(PLACES), rtol=0, atol=1e-10)


@pytest.mark.slow
def test_a_derivative_that_is_not_found_is_nan_and_the_value_stays(monkeypatch):
    monkeypatch.setattr(adjoint, "STEPS", 1)
    jax.clear_caches()  # of what the tests before traced with more steps
    with jax.enable_x64(True):
        value, found = jax.jit(jax.value_and_grad(lambda mass: answers(mass)[0][0]))(1.2)
        assert float(value) == pytest.approx(float(compiled()[0](1.2)[0][0]), rel=1e-9)
    assert np.isnan(found)


def test_a_type_is_what_was_asked_for():
    line = hjb.Grid([-1.0], [1.0], (11,))

    def solved(gain, dtype):
        problem = hjb.Problem(lambda x, u: gain * u, lambda x, u: x @ x + u @ u, hjb.Box([-1.0], [1.0]), discount=1.0)
        return hjb.solve(problem, line, dtype=dtype, tol=1e-3, scheme=hjb.Upwind())

    with jax.enable_x64(True):
        single = jax.jit(functools.partial(solved, dtype="float32"))(1.0)
        assert single.value.dtype == single.policy.dtype == jnp.float32
    with pytest.raises(ValueError, match=r"dtype='float64' inside jit, vmap or grad.*enable_x64"):
        jax.jit(functools.partial(solved, dtype="float64"))(1.0)


def double_integrator(bound, radius):
    return hjb.Problem(
        lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: 1.0, hjb.Box(jnp.stack([-bound]), jnp.stack([bound])),
        target=lambda x: jnp.hypot(x[0], x[1]) - radius, exit_cost=0.0,
    )  # fmt: skip


def lq_game(gamma):
    return zoo.lq_game(gamma=gamma, discount=0.3, shape=(41,))


def noisy(noise):
    return hjb.Problem(
        lambda x, u: u - 0.5 * x, lambda x, u: x @ x + u @ u, hjb.Box([-4.0], [4.0]), noise=noise, discount=0.5
    ), hjb.Grid([-2.0], [2.0], (61,))


def minimum_time(bound=1.0, radius=0.4):
    return double_integrator(bound, radius), hjb.Grid([-2.0, -2.0], [2.0, 2.0], (31, 30))


CASES = {
    "minimum time, bound": (lambda p: minimum_time(bound=p), 1.0, [0.8, 0.5]),
    "minimum time, radius": (lambda p: minimum_time(radius=p), 0.41, [0.8, 0.5]),
    "stochastic LQ": (noisy, 0.7, [0.9]),
    "LQ game": (lq_game, 2.0, [0.6]),
}


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [None, hjb.Upwind(subcell=True)], ids=["second order", "chain"])
@pytest.mark.parametrize("name", CASES)
def test_targets_noise_and_games(name, scheme):
    build, at, x = CASES[name]

    def value(parameter):
        return hjb.solve(*build(parameter), scheme=scheme, tol=1e-12).value_at(jnp.array(x))

    with jax.enable_x64(True):
        run = jax.jit(value)
        found, wanted = float(jax.jit(jax.grad(value))(at)), float(slope(run, at))
    assert abs(wanted) > 1e-3
    assert found == pytest.approx(wanted, rel=1e-6)
