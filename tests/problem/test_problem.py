"""The question: its ingredients, their checks, and its life as a pytree."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hjbjax import Ball, Box, Problem
from hjbjax.problem.pytree import pytree_dataclass

U, D = Box([-1.0], [1.0]), Ball(1.0, 1)


@pytree_dataclass()
class Pendulum:
    """A parametrised system, as a user would write one."""

    mass: object
    gravity: object = 9.81

    def drift(self, x, u):
        return jnp.stack([x[1], self.gravity * jnp.sin(x[0]) + u[0] / self.mass])

    def cost(self, x, u):
        return 0.5 * (x @ x + u @ u)


def drift(x, u):
    return jnp.stack([x[1], u[0]])


def cost(x, u):
    return 0.5 * (x @ x + u @ u)


@pytest.mark.parametrize(
    "name", ["drift", "cost", "target", "running_max", "controls", "disturbances", "terminal_cost", "noise", "discount"]
)
@pytest.mark.parametrize("value", ["text", {"a": 1}, object()])
def test_something_of_the_wrong_kind_is_named(name, value):
    with pytest.raises(TypeError, match=f"Problem.{name}: got"):
        Problem(**{"drift": drift, name: value})


@pytest.mark.parametrize("name", ["drift", "cost", "target", "running_max"])
def test_a_number_is_no_function(name):
    with pytest.raises(TypeError, match=f"Problem.{name}: got 3.0, wanted a function"):
        Problem(**{"drift": drift, name: 3.0})


def test_a_drift_is_needed():
    with pytest.raises(TypeError, match="Problem.drift: got None"):
        Problem(None)


@pytest.mark.parametrize("discount", [-0.1, float("nan"), float("inf"), [0.1], np.zeros(2)])
def test_discount_is_refused(discount):
    with pytest.raises(ValueError, match=r"Problem.discount: got .* wanted a finite number ≥ 0"):
        Problem(drift, cost, U, discount=discount)


@pytest.mark.parametrize(
    ("noise", "words"),
    [
        (-0.1, "wanted numbers ≥ 0"),
        ([0.1, -0.1], "wanted numbers ≥ 0"),
        (float("nan"), "not a number"),
        ([[0.1, float("nan")]], "not a number"),
        (float("inf"), "wanted finite numbers"),
        (np.zeros((1, 2, 3)), r"got shape \(1, 2, 3\), wanted a number, \(n,\) or \(n, k\)"),
    ],
)
def test_noise_is_refused(noise, words):
    with pytest.raises(ValueError, match=f"Problem.noise: .*{words}"):
        Problem(drift, cost, U, noise=noise)


@pytest.mark.parametrize("name", ["exit_cost", "terminal_cost", "stopping_cost"])
@pytest.mark.parametrize("value", [float("nan"), [1.0, 2.0]])
def test_a_cost_at_the_end_is_a_function_or_one_number(name, value):
    with pytest.raises(ValueError, match=f"Problem.{name}"):
        Problem(drift, cost, U, target=lambda x: x[0], **{name: value})


@pytest.mark.parametrize("options", [{"cost": cost}, {"discount": 0.1}, {"cost": cost, "discount": 0.1}])
def test_a_running_maximum_stands_alone(options):
    with pytest.raises(ValueError, match=r"Problem.running_max: .* leave out cost, pushes and discount"):
        Problem(drift, controls=U, running_max=lambda x: x[0], **options)


def test_an_exit_cost_needs_a_target():
    with pytest.raises(ValueError, match="Problem.exit_cost: there is no target"):
        Problem(drift, cost, U, exit_cost=1.0)


@pytest.mark.parametrize("isaacs", ["uper", None, True, ["upper"]])
def test_isaacs_is_upper_or_lower(isaacs):
    with pytest.raises(ValueError, match="Problem.isaacs: got .* wanted 'upper'"):
        Problem(drift, cost, U, isaacs=isaacs)


@pytest.mark.parametrize("flag", ["no", 1, None])
def test_time_dependent_is_a_bool(flag):
    with pytest.raises(TypeError, match="Problem.time_dependent"):
        Problem(drift, cost, U, time_dependent=flag)


def test_the_rule_for_arguments_reads_the_problem_alone():
    plain, game = Problem(drift, cost, U), Problem(drift, cost, U, disturbances=D)
    timed = Problem(drift, cost, U, disturbances=D, time_dependent=True)
    assert plain.arguments("x", "u", "d", "t") == ("x", "u")
    assert game.arguments("x", "u", "d", "t") == ("x", "u", "d")
    assert timed.arguments("x", "u", "d", "t") == ("t", "x", "u", "d")
    assert plain.state_arguments("x", "t") == ("x",)
    assert timed.state_arguments("x", "t") == ("t", "x")
    assert (plain.is_game, game.is_game) == (False, True)


@pytest.mark.parametrize(
    ("noise", "sigma"),
    [
        (None, np.zeros((2, 0))),
        (0.5, [[0.5, 0.0], [0.0, 0.5]]),
        ([0.5, 0.25], [[0.5, 0.0], [0.0, 0.25]]),
        ([[0.5], [-0.25]], [[0.5], [-0.25]]),
        (lambda x, u: x[0] * u[0], [[6.0, 0.0], [0.0, 6.0]]),
        (lambda x, u: x, [[2.0, 0.0], [0.0, 4.0]]),
    ],
)
def test_every_spelling_of_noise_is_one_matrix(noise, sigma):
    found = Problem(drift, cost, U, noise=noise).diffusion(jnp.array([2.0, 4.0]), jnp.array([3.0]))
    np.testing.assert_array_equal(found, sigma)


def test_numbers_become_floats_and_nothing_is_shared_with_the_caller():
    sigma = np.array([1.0, 2.0])
    problem = Problem(drift, cost, U, discount=1, noise=sigma, target=lambda x: x[0], exit_cost=2)
    sigma[0] = 9.0
    assert type(problem.discount) is float
    assert type(problem.exit_cost) is float
    assert problem.noise.tolist() == [1.0, 2.0]


def test_replace_checks_again():
    problem = Problem(drift, cost, U, discount=0.5)
    assert dataclasses.replace(problem, discount=0.25).discount == 0.25
    with pytest.raises(ValueError, match=r"Problem\.discount"):
        dataclasses.replace(problem, discount=-1.0)


def speed(problem):
    return problem.drift(jnp.array([0.0, 0.0]), jnp.array([1.0]))[1]


def pendulum(mass):
    return Problem(Pendulum(mass).drift, Pendulum(mass).cost, U, discount=0.1)


def test_vmap_over_the_parameters_of_stacked_problems():
    masses = np.array([1.0, 2.0, 4.0], np.float32)
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(pendulum(float(mass)) for mass in masses))
    np.testing.assert_allclose(jax.vmap(speed)(stacked), 1 / masses)
    np.testing.assert_allclose(jax.vmap(lambda mass: speed(pendulum(mass)))(masses), 1 / masses)
    np.testing.assert_allclose(jax.vmap(speed)(jax.vmap(pendulum)(masses)), 1 / masses)


def test_the_derivative_in_a_parameter_and_one_trace_for_all_of_its_values():
    traces = []

    @jax.jit
    def traced_speed(problem):
        traces.append(problem)
        return speed(problem)

    assert [float(traced_speed(pendulum(mass))) for mass in (1.0, 2.0, 4.0)] == [1.0, 0.5, 0.25]
    assert len(traces) == 1
    assert jax.grad(lambda mass: speed(pendulum(mass)))(2.0) == -0.25


def test_every_number_may_be_traced():
    @jax.jit
    def build(x):
        problem = Problem(
            drift,
            cost,
            Box([-x], [x]),
            noise=[[x, 0.0], [0.0, 1.0]],
            discount=x,
            target=lambda state: state[0],
            exit_cost=x,
            terminal_cost=x,
            stopping_cost=x,
        )
        return problem.diffusion(jnp.zeros(2), jnp.zeros(1)).sum() + problem.discount + problem.exit_cost

    assert build(2.0) == 7.0
    with pytest.raises(ValueError, match=r"Problem\.running_max"):  # a traced discount may well be positive
        jax.jit(lambda x: Problem(drift, running_max=lambda state: x, discount=x).discount)(1.0)
