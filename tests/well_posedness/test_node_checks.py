"""What is refused at the nodes: NaN, empty targets, noise that the chain cannot represent."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_problems import GRID, U, accepted, in_disc, refused

from hjbjax import Box, Finite, Grid, Problem
from hjbjax.discretisation import correlated_noise, stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.schemes import Upwind
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.well_posedness import node_checks


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

    @pytree_dataclass()
    class Counted:
        rate: object

        def drift(self, x, u):
            nonlocal count
            count += 1
            return self.rate * x

    counts = []
    for rate in (1.0, 2.0, 3.0):
        node_checks.check_values(Discretisation(Problem(Counted(rate).drift, controls=U), GRID, Upwind(), "float64"))
        counts.append(count)
    assert counts[0] > 0
    assert len(set(counts)) == 1


# --- correlated noise ---


def least(a, grid):
    table = {(i, j): jnp.asarray(a[i, j]) for i in range(len(a)) for j in range(i, len(a))}
    return min(float(stencil.noise_along(table, grid, axis)) / a[axis, axis] for axis in range(len(a)))


@pytest.mark.parametrize("sigma", [[[1.0, 0.0], [2.0, 0.0]], [[1.0, 0.0], [0.9, 0.1]], [[1.0, 0.3], [-3.0, 0.2]]])
def test_correlated_noise_is_refused_with_a_shape_that_does(sigma):
    message = refused(
        "values", r"(?s)correlated noise .* 45 of 45 nodes, first at node \(0, 0\)", noise=np.array(sigma)
    )
    shape = eval(message.partition("shape=")[2].partition(")")[0] + ")")
    accepted(noise=np.array(sigma), grid=Grid(GRID.lo, GRID.hi, shape))


def test_correlated_noise_whose_ratio_no_shape_of_this_box_has():
    sigma = np.array([[1.0], [np.sqrt(3.0)]])
    refused("values", r"(?s)spacings have the ratios \[1, 1.73205\]", noise=sigma)
    accepted(noise=sigma, grid=Grid([0.0, 0.0], [1.0, np.sqrt(3.0)], (6, 6)))


def test_correlated_noise_at_some_nodes():
    def noise(x, u):
        return jnp.stack([jnp.stack([x[0], 0.0]), jnp.stack([x[1], 0.1])])

    # near x₀ = 0 the noise of the second axis is all that is left of a, so that no spacing does at all nodes
    refused("values", r"(?s)24 of 45 nodes.*No spacings were found that satisfy this at all nodes", noise=noise)


def spread(a, now):
    return correlated_noise.dominance(a), now, np.sqrt(np.where(np.diag(a) > 0, np.diag(a), 1))


def test_advice_holds_at_all_nodes():
    """The ratio of spacings that the first node at fault asks for was not enough for the others."""

    def noise(x, u):
        return jnp.stack([jnp.stack([1.0 + 0 * x[0], 0.0]), jnp.stack([0.5 + 0.1 * x[0] * x[1], 0.9])])

    grid = Grid([-1.0, -2.0], [1.0, 2.0], (61, 9))
    message = refused("values", r"(?s)Use Grid.*representable at all of its nodes", grid=grid, noise=noise)
    shape = eval(message.partition("shape=")[2].partition(")")[0] + ")")
    accepted(noise=noise, grid=Grid(grid.lo, grid.hi, shape))


@pytest.mark.parametrize(("power", "name"), [(1.0, "log S"), (0.5, "√S"), (1.5, "∫ dS/√a_00")])
def test_noise_that_no_spacing_fits_is_constant_in_another_coordinate(power, name):
    def noise(x, u):
        return jnp.stack([jnp.stack([x[0] ** power, 0.0]), jnp.stack([0.5, 0.5])])

    grid = Grid([0.5, -1.0], [4.0, 1.0], (11, 11), names=("S", "r"))
    refused("values", rf"(?s)all nodes. Take \({name}, r\) as the state", grid=grid, noise=noise)


def test_coordinates_of_another_problem_are_not_advised():
    def noise(x, u):
        return jnp.stack([jnp.stack([x[0], 0.0]), jnp.stack([0.5 * x[0] * x[1], 0.5])])

    refused("values", r"(?s)all nodes. Rotate the", grid=Grid([0.5, 0.1], [4.0, 1.0], (11, 11)), noise=noise)


def test_three_strong_correlations_are_beyond_any_spacing():
    grid = Grid([0.0] * 3, [1.0] * 3, (5, 6, 7))
    strong, weak = (np.linalg.cholesky((1 - r) * np.eye(3) + r) for r in (0.9, 0.3))
    refused("values", r"(?s)No spacings of these axes", grid=grid, drift=lambda x, u: x, noise=strong)
    accepted(grid=grid, drift=lambda x, u: x, noise=weak)


ENTRY = st.floats(0.1, 3.0)


@given(ENTRY, ENTRY, st.floats(-1.0, 1.0), ENTRY)
def test_in_two_dimensions_some_spacing_always_does(s1, s2, r, h):
    a = np.array([[s1 * s1, r * s1 * s2], [r * s1 * s2, s2 * s2]])
    spacings = correlated_noise.spacings(*spread(a, [h, 1.0]))
    assert spacings is not None
    assert np.prod(spacings) == pytest.approx(h)
    assert least(a, Grid([0.0, 0.0], spacings, (2, 2))) >= -1e-6  # in float32


@given(st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9))
def test_in_three_dimensions_spacings_do_what_they_promise_and_exist_when_equal_ones_do(entries):
    sigma = np.reshape(entries, (3, 3)) + 0.5 * np.eye(3)
    a = sigma @ sigma.T + 1e-3 * np.eye(3)
    spacings = correlated_noise.spacings(*spread(a, [1.0, 1.0, 1.0]))
    if spacings is not None:
        assert least(a, Grid([0.0] * 3, spacings, (2, 2, 2))) >= -1e-5
    else:
        assert np.any(np.diag(a) < np.sum(np.abs(a), axis=1) - np.diag(a))


def test_axes_without_correlation_keep_their_spacing():
    a = np.array([[1.0, 0.0, 0.9], [0.0, 0.0, 0.0], [0.9, 0.0, 4.0]])
    spacings = correlated_noise.spacings(*spread(a, [0.1, 0.3, 0.1]))
    np.testing.assert_allclose(spacings, [0.1 / np.sqrt(2), 0.3, 0.1 * np.sqrt(2)])
