"""Derivatives of the policy of a solve: against central differences, on both sides of every bound, kink and rim."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import hjbjax as hjb

LINE, SQUARE = hjb.Grid([-1.0], [1.0], (25,)), hjb.Grid([-1.0, -1.0], [1.0, 1.0], (13, 12))
PLACES = {
    1: jnp.linspace(-0.97, 0.93, 11)[:, None],
    2: jnp.array([[0.3, 0.2], [-0.47, 0.11], [0.9, -0.85], [0.6, 0.6]]),
}


def exact(gain, weight, bound, discount):
    """Affine drift and quadratic cost: the action has a formula."""
    return hjb.Problem(
        lambda x, u: gain * u - x, lambda x, u: 3 * x @ x + weight * u @ u, hjb.Box(-bound[None], bound[None]),
        discount=discount,
    )  # fmt: skip


def searched(gain, weight, bound, discount):
    """A drift that is not affine and a quartic cost: the action is searched; beside the origin a kink holds it."""
    return hjb.Problem(
        lambda x, u: gain * jnp.sin(u) - x, lambda x, u: 3 * x @ x + weight * (u[0] ** 4 + u @ u),
        hjb.Box(-bound[None], bound[None]), discount=discount,
    )  # fmt: skip


def noisy(gain, weight, bound, discount):
    """With noise in both the value and the weights of central differences."""
    problem = searched(gain, weight, bound, discount)
    return hjb.Problem(problem.drift, problem.cost, problem.controls, noise=0.3 * gain, discount=discount)


def game(gain, weight, bound, discount):
    """Players who meet in one component: both are free at most nodes."""
    return hjb.Problem(
        lambda x, u, d: gain * u + 0.5 * d - x, lambda x, u, d: 3 * x @ x + weight * u @ u - 2 * d @ d,
        hjb.Box(-bound[None], bound[None]), disturbances=hjb.Box([-0.6], [0.6]), discount=discount,
    )  # fmt: skip


def ball(gain, weight, bound, discount):
    """Two inputs that meet in the cost, inside of a ball and on its rim."""
    return hjb.Problem(
        lambda x, u: gain * u + 0.2 * x[::-1], lambda x, u: x @ x + weight * u @ u + 0.1 * u[0] * u[1],
        hjb.Ball(0.6 * bound, 2), discount=discount,
    )  # fmt: skip


def feedback(make, grid, numbers):
    """The actions at some places, as a function of the numbers of a problem."""
    solution = hjb.solve(make(*numbers), grid, scheme=hjb.Upwind(), tol=1e-11)
    return solution.control_at(PLACES[grid.ndim])


def check(make, grid, step, atol, bound=0.8):
    """Derivatives in both modes against central differences; none of the numbers leaves all actions where they are."""
    with jax.enable_x64(True):
        numbers = jnp.array([1.3, 0.6, bound, 0.7])
        act = jax.jit(functools.partial(feedback, make, grid))
        forward = np.asarray(jax.jit(jax.jacfwd(functools.partial(feedback, make, grid)))(numbers))
        found = np.stack([(act(numbers + e) - act(numbers - e)) / (2 * step) for e in step * np.eye(4)], axis=-1)
        np.testing.assert_allclose(forward, found, rtol=0, atol=atol)
        assert np.all(np.max(np.abs(found), axis=(0, 1)) > 0.01)
        assert np.ptp(np.asarray(act(numbers))) > 0.4
        return np.asarray(act(numbers)), forward


@pytest.mark.slow
def test_an_action_with_a_formula():
    act, jacobian = check(exact, LINE, 1e-5, 1e-7)
    held = np.abs(np.abs(act[:, 0]) - 0.8) < 1e-12
    assert np.any(held)
    assert np.any(~held)
    np.testing.assert_allclose(np.abs(jacobian[held, 0]), [[0.0, 0.0, 1.0, 0.0]] * np.sum(held), atol=1e-12)


@pytest.mark.slow
def test_an_action_that_was_searched():
    check(
        searched, LINE, 1e-4, 2e-4, bound=0.45
    )  # a search by values finds 1e-8 of an action, and differences magnify that


@pytest.mark.slow
@pytest.mark.parametrize(("make", "grid"), [(noisy, LINE), (game, LINE), (ball, SQUARE)])
def test_noise_games_and_balls(make, grid):
    check(make, grid, 1e-4, 5e-4, bound=0.45)


@pytest.mark.slow
def test_reverse_mode_agrees_and_finitely_many_actions_do_not_move():
    with jax.enable_x64(True):
        numbers = jnp.array([1.3, 0.6, 0.8, 0.7])

        def imitation(make, numbers):
            return jnp.sum((feedback(make, LINE, numbers) - 0.1) ** 2)

        loss = functools.partial(imitation, exact)
        backward, forward = jax.jit(jax.grad(loss))(numbers), jax.jit(jax.jacfwd(loss))(numbers)
        np.testing.assert_allclose(backward, forward, rtol=1e-9)

        def enumerated(*numbers):
            return hjb.Problem(
                lambda x, u: numbers[0] * u - x, lambda x, u: 3 * x @ x + numbers[1] * u @ u,
                hjb.Box([-0.8], [0.8]).grid(5), discount=numbers[3],
            )  # fmt: skip

        assert not np.any(jax.jit(jax.grad(functools.partial(imitation, enumerated)))(numbers))


def noisy_by_choice(gain, weight, bound, discount):
    """Noise that grows with the action: a kink of central differences, |f| = a/h, holds it at the outer nodes."""
    return hjb.Problem(
        lambda x, u: u - 0.35 * gain * x, lambda x, u: x @ x + 0.6 * weight * u @ u, hjb.Box(-bound[None], bound[None]),
        noise=lambda x, u: 0.1 * gain + 0.2 * u * u, discount=discount,
    )  # fmt: skip


def noise_alone(gain, weight, bound, discount):
    """An action that drives nothing but the noise: a kink holds it at every other node."""
    return hjb.Problem(
        lambda x, u: -0.7 * gain * x, lambda x, u: 2 * weight * x @ x + 0.001 * jnp.sin(3 * u[0]) - 0.01 * u[0],
        hjb.Box(-bound[None], bound[None]), noise=lambda x, u: 0.1 + 0.08 * u, discount=discount,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("make", [searched, noisy_by_choice, noise_alone])
def test_a_value_follows_the_kinks_that_hold_searched_actions(make):
    """Where a kink of the upwinding holds an action, the value moves with it: derivatives were 1 % and .2 % off."""

    def value(make, numbers):
        return hjb.solve(make(*numbers), LINE, scheme=hjb.Upwind(), tol=1e-11).value_at(PLACES[1])

    with jax.enable_x64(True):
        numbers, step = jnp.array([1.3, 0.6, 0.8, 0.7]), 1e-4
        solve = jax.jit(functools.partial(value, make))
        forward = np.asarray(jax.jit(jax.jacfwd(functools.partial(value, make)))(numbers))
        found = np.stack([(solve(numbers + e) - solve(numbers - e)) / (2 * step) for e in step * np.eye(4)], axis=-1)
        np.testing.assert_allclose(forward, found, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_a_weight_of_the_cost_is_recovered_from_what_an_expert_does():
    """Twenty paths of the closed loop; Adam on the squared distance of the actions, from three times the weight."""
    grid, weight = hjb.Grid([-1.5, -1.5], [1.5, 1.5], (31, 31)), 0.7

    def question(weight):
        return hjb.Problem(
            lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: x[0] ** 2 + weight * x[1] ** 2 + 0.5 * u @ u,
            hjb.Box([-2.0], [2.0]), discount=0.3,
        )  # fmt: skip

    expert = hjb.solve(question(weight), grid, scheme=hjb.Upwind(), tol=1e-8)
    states = [np.random.default_rng(3).uniform(-0.8, 0.8, (20, 2))]
    for _ in range(40):
        x = states[-1]
        states.append(x + 0.05 * np.stack([x[:, 1], expert.control_at(x)[:, 0]], axis=-1))
    seen = np.concatenate(states)
    actions = expert.control_at(seen)

    with jax.enable_x64(True):

        def loss(weight):
            imitator = hjb.solve(question(weight), grid, scheme=hjb.Upwind(), tol=1e-8)
            return jnp.mean((imitator.control_at(seen) - actions) ** 2)

        slope = jax.jit(jax.grad(loss))
        found, rule = jnp.array(3 * weight), optax.adam(optax.cosine_decay_schedule(0.2, 120))
        state = rule.init(found)
        for _ in range(120):
            step, state = rule.update(slope(found), state)
            found = optax.apply_updates(found, step)
    assert abs(float(found) - weight) < 0.02 * weight
