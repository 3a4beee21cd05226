"""What is refused on one state, before anything is allocated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import GRID, U, accepted, drift, in_disc, refused

from hjbjax import Grid, Problem
from hjbjax.discretisation.schemes import Upwind
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.tracing import checks

# --- shapes ---


@pytest.mark.parametrize(
    ("function", "match"),
    [
        (lambda x, u: jnp.zeros(3), r"drift\(x, u\) returned shape \(3,\), expected \(2,\)"),
        (lambda x, u: x[0], r"drift\(x, u\) returned shape \(\), expected \(2,\)"),
        (lambda x, u: [x[1], u[0]], r"returned a list of 2, expected .* \(2,\): use jnp.stack"),
        (lambda x, u: (x[1], u[0]), r"returned a tuple of 2, .* use jnp.stack"),
        (lambda x, u: None, "returned None"),
        (lambda x, u: "fast", "returned 'fast'"),
        (lambda x, u: 1j * x, "returned complex128 numbers"),
        (lambda x, u: jnp.array([1, 0]), "returned int64 numbers"),
        (lambda x, u: object(), "an object of type object"),
    ],
)
def test_a_drift_that_returns_something_else(function, match):
    refused("shapes", match, drift=function)


@pytest.mark.parametrize("name", ["cost", "target", "exit_cost", "terminal_cost", "stopping_cost", "running_max"])
def test_what_must_be_a_scalar(name):
    other = {"target": in_disc} if name == "exit_cost" else {}
    refused("shapes", rf"{name}\(x.*\) returned shape \(2,\), expected \(\)", **{name: lambda x, *u: 2 * x}, **other)
    refused("shapes", rf"{name}\(x.*\) returned bool numbers", **{name: lambda x, *u: x[0] < 0.1}, **other)


def test_a_target_by_comparison_is_told_to_be_a_distance():
    refused("shapes", "distance ≤ 0 inside", target=lambda x: jnp.linalg.norm(x) < 0.1)


def test_plain_numbers_are_numbers():
    accepted(cost=lambda x, u: 1, target=lambda x: jnp.where(in_disc(x) < 0, -1, 1), exit_cost=lambda x: 0)


@pytest.mark.parametrize("noise", [[1.0, 2.0, 3.0], np.ones((3, 2)), lambda x, u: jnp.ones((2, 2, 2))])
def test_noise_of_the_wrong_shape(noise):
    refused("shapes", r"noise.* returned shape .*, expected \(\), \(2,\) or \(2, k\)", noise=noise)


@pytest.mark.parametrize("noise", [0.1, [0.1, 0.2], np.eye(2), np.ones((2, 0)), lambda x, u: jnp.abs(x), np.eye(2, 3)])
def test_noise_of_every_right_shape(noise):
    accepted(noise=noise)


@pytest.mark.parametrize(
    ("ingredients", "match"),
    [
        ({"drift": lambda x: x}, r"drift\(x, u\): too many positional.*\n.*d only with disturbances"),
        ({"drift": lambda x, u, d: x}, r"drift\(x, u\): missing a required argument: 'd'"),
        ({"drift": lambda x, u: x, "disturbances": U}, r"drift\(x, u, d\).*\n.*d because disturbances are given"),
        ({"drift": lambda x, u: x, "time_dependent": True}, r"drift\(t, x, u\).*\n.*t first because time_dependent"),
        ({"target": lambda x, u: x[0]}, r"target\(x\): missing a required argument: 'u'"),
        ({"cost": lambda: 1.0}, r"cost\(x, u\)"),
    ],
)
def test_a_wrong_number_of_arguments(ingredients, match):
    refused("shapes", match, cause=TypeError, **ingredients)


def test_arguments_of_games_and_time():
    accepted(drift=lambda t, x, u, d: jnp.stack([t + d[0], u[0]]), disturbances=U, time_dependent=True)


@pytree_dataclass()
class Damped:
    rate: object

    def drift(self, x, u):
        return jnp.stack([x[1], u[0] - self.rate * x[1]])


def test_a_bound_method_and_defaults_are_called_as_they_are():
    accepted(drift=Damped(0.1).drift, cost=lambda x, u, weight=2.0: weight * u @ u)


@pytest.mark.parametrize(
    ("function", "match", "cause"),
    [
        (lambda x, u: x if x[0] > 0 else -x, "use jnp.where", jax.errors.TracerBoolConversionError),
        (lambda x, u: max(x[0], 0.0) * x, "use jnp.where", jax.errors.TracerBoolConversionError),
        (lambda x, u: x[x > 0], "use jnp.where", jax.errors.NonConcreteBooleanIndexError),
        (lambda x, u: np.sin(x), "use jnp instead of np", jax.errors.TracerArrayConversionError),
        (lambda x, u: np.array([x[1], u[0]]), "use jnp instead of np", jax.errors.TracerArrayConversionError),
        (lambda x, u: float(x[0]) * x, "use jnp", jax.errors.ConcretizationTypeError),
        (lambda x, u: [1.0, 2.0][jnp.argmax(x)] * x, r"jnp.asarray\(table\)", jax.errors.TracerIntegerConversionError),
        (lambda x, u: x @ u @ u, "failed on one state, with x of shape .*\n.*dot_general", TypeError),
        (lambda x, u: x.__setitem__(0, 1.0), "immutable", TypeError),
    ],
)
def test_code_that_cannot_be_traced(function, match, cause):
    refused("shapes", rf"(?s)drift\(x, u\).*{match}", drift=function, cause=cause)


def test_a_users_own_exception_comes_through_with_a_note():
    with pytest.raises(ZeroDivisionError) as caught:
        checks.shapes(Problem(lambda x, u: 1 / 0, controls=U), GRID, Upwind())
    assert any("raised by drift(x, u)" in text for text in caught.value.__notes__)


def test_no_control_means_an_empty_u():
    refused("shapes", r"u of shape \(0,\)", controls=None)
    accepted(drift=lambda x, u: -x, controls=None)


def test_a_scheme_says_how_many_points_it_needs():
    class Wide:
        points = 7

    with pytest.raises(ValueError, match="axis 0 has 5 points; Wide needs at least 7"):
        checks.shapes(Problem(drift, controls=U), GRID, Wide())


def test_shapes_needs_no_memory():
    checks.shapes(Problem(lambda x, u: -x, controls=U), Grid([0.0] * 5, [1.0] * 5, (200,) * 5), Upwind())
