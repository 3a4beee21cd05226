"""What is refused before a solve starts: every row of bad input that a problem on a grid can have."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hjbjax import Box, Finite, Grid, Problem, chain, checks, correlation
from hjbjax.pytree import node
from hjbjax.schemes import Upwind

GRID = Grid([-1.0, -2.0], [1.0, 2.0], (5, 9))
U = Box([-1.0], [1.0])


def drift(x, u):
    return jnp.stack([x[1], u[0]])


def refused(ask, match, grid=GRID, cause=None, **ingredients):
    """The message of the ValueError with which a problem is refused."""
    problem = Problem(**({"drift": drift, "controls": U} | ingredients))
    if ask == "values":
        checks.shapes(problem, grid, Upwind())
    with pytest.raises(ValueError, match=match) as caught:
        getattr(checks, ask)(problem, grid, Upwind(), *["float64"] * (ask == "values"))
    message = str(caught.value)
    assert len(message.splitlines()) <= 6
    assert cause is None or isinstance(caught.value.__cause__, cause)
    return message


def accepted(grid=GRID, dtype="float64", **ingredients):
    problem = Problem(**({"drift": drift, "controls": U} | ingredients))
    checks.shapes(problem, grid, Upwind())
    checks.values(problem, grid, Upwind(), dtype)


def in_disc(x):
    return jnp.linalg.norm(x) - 0.6


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


@node()
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
        (lambda x, u: np.sin(x), "use jnp in place of np", jax.errors.TracerArrayConversionError),
        (lambda x, u: np.array([x[1], u[0]]), "use jnp in place of np", jax.errors.TracerArrayConversionError),
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


# --- values ---


@pytest.mark.parametrize(
    ("ingredients", "match"),
    [
        ({"drift": lambda x, u: x / x[0]}, r"drift\(x, u\) is .* 9 of 45 nodes, first at node \(2, 0\), x = \[0, -2\]"),
        ({"drift": lambda x, u: x / u[0]}, r"drift\(x, u\) is .* 45 of 45 .* with u = \[0\]"),
        ({"cost": lambda x, u: jnp.sqrt(x[1])}, r"cost\(x, u\) is .* 20 of 45 nodes, first at node \(0, 0\)"),
        ({"cost": lambda x, u: 1 / (u[0] - 1)}, r"cost\(x, u\) is .* with u = \[1\]"),
        ({"terminal_cost": lambda x: jnp.log(x[0])}, r"terminal_cost\(x\) is .* 27 of 45"),
        ({"stopping_cost": lambda x: jnp.log(x[0])}, r"stopping_cost\(x\) is .* 27 of 45"),
        ({"running_max": lambda x: jnp.log(x[0])}, r"running_max\(x\) is .* 27 of 45"),
        ({"target": lambda x: jnp.log(x[0])}, r"target\(x\) is .* 27 of 45"),
        ({"target": in_disc, "exit_cost": lambda x: jnp.log(x[1])}, r"exit_cost\(x\) is .* 4 of 45"),
        ({"target": in_disc, "exit_cost": np.inf}, "Problem.exit_cost: got inf, wanted finite"),
        ({"noise": lambda x, u: jnp.sqrt(x)}, r"noise\(x, u\) is NaN"),
        ({"noise": lambda x, u: x[0]}, r"noise\(x, u\) is negative at 18 of 45 nodes.*\n.*≥ 0"),
    ],
)
def test_nodes_at_which_a_function_is_not_what_it_must_be(ingredients, match):
    refused("values", match, **ingredients)


def test_one_bad_action_of_a_finite_set_is_found_and_named():
    points = np.linspace(-1.0, 1.0, 21)[:, None]
    refused("values", r"with u = \[0.3\]", controls=Finite(points), cost=lambda x, u: 1 / jnp.round(u[0] - 0.3, 6))


def test_in_a_game_both_actions_are_named():
    match = r"with u = \[-1\] and d = \[-1, -1\]"
    box = Box([-1.0, -1.0], [1.0, 1.0])
    refused("values", match, drift=lambda x, u, d: jnp.stack([x[1] / (u[0] - d[1]), d[0]]), disturbances=box)


def test_what_is_finite_in_float64_may_overflow_in_float32():
    accepted(cost=lambda x, u: jnp.exp(100 * jnp.abs(x[0])))
    with pytest.raises(ValueError, match=r"cost\(x, u\) is NaN or infinite at 18 of 45"):
        accepted(cost=lambda x, u: jnp.exp(100 * jnp.abs(x[0])), dtype="float32")


def test_an_exit_cost_matters_inside_the_target_alone():
    accepted(target=in_disc, exit_cost=lambda x: jnp.sqrt(0.6 - jnp.linalg.norm(x)))


def test_a_target_that_no_node_meets():
    match = r"no node lies in the target.* least value is 0.1\d+, at node \(2, 4\), x = \[0, 0\]: refine .* or enlarge"
    refused("values", match, target=lambda x: jnp.linalg.norm(x - 0.1) - 0.01)


def test_a_target_that_covers_the_grid():
    refused("values", "all 45 nodes lie in the target", target=lambda x: jnp.linalg.norm(x) - 9)


def test_another_parameter_value_does_not_trace_again():
    count = 0

    @node()
    class Counted:
        rate: object

        def drift(self, x, u):
            nonlocal count
            count += 1
            return self.rate * x

    counts = []
    for rate in (1.0, 2.0, 3.0):
        checks.values(Problem(Counted(rate).drift, controls=U), GRID, Upwind(), "float64")
        counts.append(count)
    assert counts[0] > 0
    assert len(set(counts)) == 1


# --- correlated noise ---


def least(a, grid):
    table = {(i, j): jnp.asarray(a[i, j]) for i in range(len(a)) for j in range(i, len(a))}
    return min(float(chain.along_axis(table, grid, axis)) / a[axis, axis] for axis in range(len(a)))


@pytest.mark.parametrize("sigma", [[[1.0, 0.0], [2.0, 0.0]], [[1.0, 0.0], [0.9, 0.1]], [[1.0, 0.3], [-3.0, 0.2]]])
def test_correlated_noise_is_refused_with_a_shape_that_does(sigma):
    message = refused(
        "values", r"(?s)correlated noise .* 45 of 45 nodes, first at node \(0, 0\)", noise=np.array(sigma)
    )
    shape = eval(message.partition("shape=")[2].partition(")")[0] + ")")
    accepted(noise=np.array(sigma), grid=Grid(GRID.lo, GRID.hi, shape))


def test_correlated_noise_whose_ratio_no_shape_of_this_box_has():
    sigma = np.array([[1.0], [np.sqrt(3.0)]])
    refused("values", r"(?s)spacings are as \[1, 1.73205\] to one another", noise=sigma)
    accepted(noise=sigma, grid=Grid([0.0, 0.0], [1.0, np.sqrt(3.0)], (6, 6)))


def test_correlated_noise_at_some_nodes():
    def noise(x, u):
        return jnp.stack([jnp.stack([x[0], 0.0]), jnp.stack([x[1], 0.1])])

    refused("values", r"(?s)24 of 45 nodes.*representable there", noise=noise)


def test_three_strong_correlations_are_beyond_any_spacing():
    grid = Grid([0.0] * 3, [1.0] * 3, (5, 6, 7))
    strong, weak = (np.linalg.cholesky((1 - r) * np.eye(3) + r) for r in (0.9, 0.3))
    refused("values", r"(?s)No spacing of these axes", grid=grid, drift=lambda x, u: x, noise=strong)
    accepted(grid=grid, drift=lambda x, u: x, noise=weak)


ENTRY = st.floats(0.1, 3.0)


@given(ENTRY, ENTRY, st.floats(-1.0, 1.0), ENTRY)
def test_in_two_dimensions_some_spacing_always_does(s1, s2, r, h):
    a = np.array([[s1 * s1, r * s1 * s2], [r * s1 * s2, s2 * s2]])
    spacings = correlation.spacings(a, [h, 1.0])
    assert spacings is not None
    assert np.prod(spacings) == pytest.approx(h)
    assert least(a, Grid([0.0, 0.0], spacings, (2, 2))) >= -1e-6  # in float32


@given(st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9))
def test_in_three_dimensions_spacings_do_what_they_promise_and_exist_when_equal_ones_do(entries):
    sigma = np.reshape(entries, (3, 3)) + 0.5 * np.eye(3)
    a = sigma @ sigma.T + 1e-3 * np.eye(3)
    spacings = correlation.spacings(a, [1.0, 1.0, 1.0])
    if spacings is not None:
        assert least(a, Grid([0.0] * 3, spacings, (2, 2, 2))) >= -1e-5
    else:
        assert np.any(np.diag(a) < np.sum(np.abs(a), axis=1) - np.diag(a))


def test_axes_without_correlation_keep_their_spacing():
    a = np.array([[1.0, 0.0, 0.9], [0.0, 0.0, 0.0], [0.9, 0.0, 4.0]])
    spacings = correlation.spacings(a, [0.1, 0.3, 0.1])
    np.testing.assert_allclose(spacings, [0.1 / np.sqrt(2), 0.3, 0.1 * np.sqrt(2)])


# --- without discount ---


def test_an_endless_cost_is_refused_with_what_would_end_it():
    with pytest.raises(ValueError, match="no finite solution: discount = 0") as caught:
        checks.ill_posed(Problem(drift, controls=U), has_rest=False)
    message = str(caught.value)
    assert "discount > 0" in message
    assert "target" in message
    assert "rest point" in message
    assert len(message.splitlines()) <= 6


@pytest.mark.parametrize(
    ("ingredients", "has_rest"),
    [
        *(({"discount": 0.1}, False), ({"target": in_disc}, False), ({"stopping_cost": 1.0}, False)),
        *(({"running_max": in_disc}, False), ({}, True)),
    ],
)
def test_what_ends_an_endless_cost(ingredients, has_rest):
    checks.ill_posed(Problem(drift, controls=U, **ingredients), has_rest=has_rest)
