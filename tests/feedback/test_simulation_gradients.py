"""Derivatives of a simulated path in both modes: of the plant, of the start, and of the feedback."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

LINE = hjb.Grid([-2.0], [2.0], (41,))
AT = np.array([1.2, 1.1, 0.6, 0.3])


def cost(numbers):
    """The cost of a swing, of a mass, a gain and a start."""
    mass, gain, *x0 = numbers
    problem = hjb.Problem(
        lambda x, u: jnp.stack([x[1], 3 * jnp.sin(x[0]) + u[0] / mass]),
        lambda x, u: 1 - jnp.cos(x[0]) + 0.1 * x[1] ** 2 + 0.1 * u @ u, hjb.Box([-30.0], [30.0]), discount=0.5,
    )  # fmt: skip
    return hjb.simulate(problem, lambda x: -9 * gain * x[:1] - 4 * x[1:], jnp.stack(x0), 2.0, steps=10, rtol=1e-9).cost


def differences(function, at, step=1e-4):
    return np.array([(function(at + e) - function(at - e)) / (2 * step) for e in step * np.eye(len(at))])


@pytest.mark.slow
def test_plant_start_and_feedback_in_both_modes():
    with jax.enable_x64(True):
        backward, forward = (np.asarray(jax.jit(mode(cost))(jnp.asarray(AT))) for mode in (jax.grad, jax.jacfwd))
        np.testing.assert_allclose(backward, forward, rtol=1e-9)
        np.testing.assert_allclose(backward, differences(jax.jit(cost), AT), rtol=1e-6)


@pytest.mark.slow
def test_lanes_are_single_paths():
    with jax.enable_x64(True):
        lanes = jax.jit(jax.vmap(jax.grad(cost)))(jnp.stack([AT, 1.1 * AT]))
        np.testing.assert_allclose(lanes[0], jax.jit(jax.grad(cost))(jnp.asarray(AT)), rtol=1e-9)


def reaching(numbers):
    """The cost of a walk to a target whose edge, price and speed move, and the time at which it is met."""
    radius, price, speed = numbers
    problem = hjb.Problem(
        lambda x, u: speed * u, lambda x, u: 1 + x @ x, hjb.Box([-1.0], [1.0]),
        target=lambda x: jnp.abs(x[0]) - radius, exit_cost=price,
    )  # fmt: skip
    path = hjb.simulate(problem, lambda x: -jnp.tanh(3 * x), [1.5], 4.0, steps=80, rtol=1e-10, atol=1e-12)
    return jnp.stack([path.cost, path.reached])


@pytest.mark.slow
@pytest.mark.emitters  # differences of paths as users' programs round them
def test_a_target_is_met_earlier_or_later():
    """The two modes agree; how exact they are at a target, docs/derivatives.md says."""
    at = np.array([0.4, 0.3, 1.3])
    with jax.enable_x64(True):
        backward, forward = (np.asarray(jax.jit(mode(reaching))(jnp.asarray(at))) for mode in (jax.jacrev, jax.jacfwd))
        np.testing.assert_allclose(backward, forward, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(backward, differences(jax.jit(reaching), at).T, rtol=5e-5, atol=1e-7)


@pytest.mark.slow
def test_the_feedback_of_a_solve_is_followed_through_its_path():
    """Solve and simulate as one function of a weight."""

    def closed_loop(weight):
        problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + weight * u @ u, hjb.Box([-3.0], [3.0]), discount=0.4)
        solution = hjb.solve(problem, LINE, scheme=hjb.Upwind(), tol=1e-12)
        return hjb.simulate(problem, solution, [1.37], 1.0, steps=10, rtol=1e-10, atol=1e-12).cost

    with jax.enable_x64(True):
        found = float(jax.jit(jax.grad(closed_loop))(0.8))
        run = jax.jit(closed_loop)
        wanted = float(run(0.8 + 1e-5) - run(0.8 - 1e-5)) / 2e-5
    assert found == pytest.approx(wanted, rel=1e-5)


@pytest.mark.slow
def test_second_derivatives_of_a_path_are_refused():
    with pytest.raises(NotImplementedError, match="second derivatives of a path"):
        jax.eval_shape(jax.hessian(cost), jnp.asarray(AT))


@pytest.mark.slow
def test_a_known_problem_and_a_traced_one_give_one_path():
    with jax.enable_x64(True):
        assert float(jax.jit(cost)(jnp.asarray(AT))) == pytest.approx(float(cost(AT)), rel=1e-9)
    single = jax.jit(functools.partial(cost))(jnp.asarray(AT, jnp.float32))
    assert single.dtype == jnp.float32
