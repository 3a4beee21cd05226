"""A solution between its nodes: exact where it can be, honest where there is nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_solutions import GRID, LINEAR, RING, solution_of

from hjbjax.problem.grid import Grid
from hjbjax.solution.solution import Solution

# Between the nodes

number = st.floats(-3, 3)


@given(*[number] * 4, st.floats(0, 1), st.floats(0, 1))
def test_multilinear_functions_are_exact(a, b, c, d, s, t):
    solution = solution_of(lambda x, y: a + b * x + c * y + d * x * y)
    x, y = -1 + 2 * s, 3 * t
    exact = a + b * x + c * y + d * x * y
    np.testing.assert_allclose(solution.value_at([x, y]), exact, rtol=0, atol=1e-13)
    np.testing.assert_allclose(solution.control_at([x, y]), [2 * exact], rtol=0, atol=2e-13)


@settings(max_examples=30)
@given(st.lists(number, min_size=8, max_size=8), st.lists(st.floats(0, 1), min_size=3, max_size=3))
def test_multilinear_functions_are_exact_in_three_dimensions(coefficients, place):
    grid = Grid([0.0, -1.0, 2.0], [1.0, 1.0, 5.0], (3, 4, 2))

    def function(x, y, z):
        terms = (1, x, y, z, x * y, y * z, z * x, x * y * z)
        return sum(coefficient * term for coefficient, term in zip(coefficients, terms, strict=True))

    solution = solution_of(function, grid)
    x = grid.lo + (grid.hi - grid.lo) * np.array(place)
    np.testing.assert_allclose(solution.value_at(x), function(*x), rtol=0, atol=1e-11)


@given(st.floats(0, 1), st.floats(0, 1), st.integers(0, 99))
def test_the_answer_stays_within_the_range_of_the_nodes(s, t, seed):
    values = np.random.default_rng(seed).normal(size=GRID.shape)
    answer = solution_of(lambda a, b: values).value_at([-1 + 2 * s, 3 * t])
    assert values.min() - 1e-14 <= answer <= values.max() + 1e-14


@given(st.floats(-50, 50), st.floats(-1, 1), st.integers(-3, 3))
def test_a_periodic_axis_goes_round(angle, speed, turns):
    solution = solution_of(lambda a, b: np.sin(a) + b, RING)
    here, there = solution.value_at([[angle, speed], [angle + 2 * np.pi * turns, speed]])
    np.testing.assert_allclose(here, there, rtol=0, atol=1e-12)


def test_nodes_are_met_exactly():
    random = np.random.default_rng(0)
    for grid in (GRID, RING):
        value, policy = random.normal(size=grid.shape), random.normal(size=(*grid.shape, 2))
        solution = Solution(grid, value, policy)
        assert np.array_equal(solution.value_at(grid.nodes()), value)
        assert np.array_equal(solution.control_at(grid.nodes()), policy)


def test_host_answers_are_float64_numpy():
    for x in ([0.1, 1], (0, 1), np.array([0.1, 1.0], np.float32), jnp.array([0.1, 1.0]), np.array([0, 1])):
        answer = LINEAR.value_at(x)
        assert isinstance(answer, np.float64)
        assert isinstance(LINEAR.control_at(x), np.ndarray)
        assert LINEAR.control_at(x).dtype == np.float64
    assert LINEAR.value_at([0.1, 1.0]) == pytest.approx(0.2, abs=1e-15)
    assert LINEAR.value_at(np.zeros((3, 0, 2))).shape == (3, 0)
    assert LINEAR.value_at(np.zeros((2, 3, 2))).shape == (2, 3)
    assert LINEAR.control_at(np.zeros((2, 3, 2))).shape == (2, 3, 1)
    assert LINEAR.control_at(np.zeros((2, 3, 2))).flags.writeable
    single = Solution(GRID, jnp.asarray(LINEAR.value), jnp.asarray(LINEAR.policy))  # as jit hands it out
    assert single.value_at([0.1, 1.0]).dtype == np.float64


def test_a_query_leaves_no_trace_of_float64():
    LINEAR.value_at([0.1, 1.0])
    assert jnp.ones(()).dtype == jnp.float32


@pytest.mark.filterwarnings("ignore:.*outside the grid, where")
def test_outside_is_nan_or_clamped():
    outside = [[-1.5, 1.0], [0.0, 3.0001], [-1.5, 9.0], [np.inf, 1.0]]
    assert np.all(np.isnan(LINEAR.value_at(outside)))
    assert np.all(np.isnan(LINEAR.control_at(outside)))
    nearest = [[-1.0, 1.0], [0.0, 3.0], [-1.0, 3.0], [1.0, 1.0]]
    np.testing.assert_allclose(LINEAR.value_at(outside, clamp=True), LINEAR.value_at(nearest), rtol=0, atol=1e-14)
    np.testing.assert_allclose(LINEAR.control_at(outside, clamp=True), LINEAR.control_at(nearest), rtol=0, atol=1e-14)
    for query in (LINEAR.value_at, LINEAR.control_at):
        assert np.all(np.isnan(query([np.nan, 1.0], clamp=True)))
    ring = solution_of(lambda a, b: a + b, RING)
    for query in (ring.value_at, ring.control_at):
        assert np.all(np.isnan(query([np.inf, 0.0], clamp=True)))  # an infinite angle is no place


def test_infinite_values_do_not_spread_to_finite_nodes():
    value = np.arange(5.0)
    value[3:] = np.inf
    solution = Solution(Grid([0.0], [4.0], (5,)), value, value[:, None])
    np.testing.assert_array_equal(solution.value_at([[1.5], [2.0], [2.1], [3.5]]), [1.5, 2.0, np.inf, np.inf])


@pytest.mark.parametrize(
    ("x", "error", "reason"),
    [
        ([0.0], ValueError, r"states of shape \(1,\), wanted \(..., 2\)"),
        ([[0.0, 1.0, 2.0]], ValueError, r"states of shape \(1, 3\)"),
        (0.0, ValueError, r"states of shape \(\)"),
        ("here", TypeError, "wanted real numbers"),
        (None, TypeError, "wanted real numbers"),
        ([1j, 0.0], TypeError, "states of type complex128"),
        ([[0.0, 1.0], [0.0]], TypeError, "wanted real numbers"),
        ([True, False], TypeError, "states of type bool"),
    ],
)
def test_states_that_are_none(x, error, reason):
    for name in ("value_at", "control_at"):
        with pytest.raises(error, match=rf"Solution.{name}: got .*{reason}") as caught:
            getattr(LINEAR, name)(x)
        assert len(str(caught.value).splitlines()) <= 6


def test_what_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"Solution.disturbance_at: .* no disturbance: the problem is not a game"):
        LINEAR.disturbance_at([0.0, 1.0])
    with pytest.raises(ValueError, match=r"Solution.control_at: .* no policy"):
        solution_of(lambda a, b: a, policy=None).control_at([0.0, 1.0])
    marched = Solution(GRID, np.zeros((3, 5, 4)), np.zeros((3, 5, 4, 1)), times=np.arange(3.0))
    for query in (marched.value_at, marched.control_at):
        with pytest.raises(ValueError, match=r"got 1 arguments; this solution is marched over times: call \w+\(t, x\)"):
            query([0.0, 1.0])
    with pytest.raises(ValueError, match=r"got 2 arguments; this solution is stationary: call value_at\(x\)"):
        LINEAR.value_at(0.0, [0.0, 1.0])


# Controls


def test_no_control_is_an_empty_control():
    solution = solution_of(lambda a, b: a, policy=np.zeros((5, 4, 0)))
    assert solution.control_at([0.0, 1.0]).shape == (0,)
    assert solution.control_at(np.zeros((7, 2))).shape == (7, 0)


def test_disturbances_are_interpolated():
    solution = solution_of(lambda a, b: a, disturbance=GRID.nodes())
    np.testing.assert_allclose(solution.disturbance_at([0.3, 1.7]), [0.3, 1.7], rtol=0, atol=1e-15)


def test_undefined_controls_do_not_count():
    policy = np.array([[1.0], [3.0], [np.nan], [np.nan], [5.0]])
    solution = Solution(Grid([0.0], [4.0], (5,)), np.zeros(5), policy)
    x = np.array([[0.5], [1.0], [1.01], [1.99], [2.0], [2.5], [3.0], [3.2], [4.0]])
    expected = [2.0, 3.0, 3.0, 3.0, np.nan, np.nan, np.nan, 5.0, 5.0]
    np.testing.assert_allclose(solution.control_at(x)[:, 0], expected, rtol=0, atol=1e-14)
    taken = Solution(solution.grid, solution.value, policy, discrete=True).control_at(x)[:, 0]
    np.testing.assert_array_equal(taken, [1.0, 3.0, 3.0, 3.0, np.nan, np.nan, np.nan, 5.0, 5.0])


def test_a_control_with_one_undefined_input_is_undefined():
    policy = np.array([[1.0, 1.0], [np.nan, 2.0], [3.0, 3.0]])
    solution = Solution(Grid([0.0], [2.0], (3,)), np.zeros(3), policy)
    np.testing.assert_allclose(solution.control_at([0.9]), [1.0, 1.0])
    assert np.all(np.isnan(solution.control_at([1.0])))


@given(st.floats(-1, 1), st.floats(0, 3))
def test_enumerated_controls_come_from_the_nearest_node(a, b):
    random = np.random.default_rng(3)
    policy = random.normal(size=(5, 4, 2))
    solution = solution_of(lambda x, y: x, policy=policy, discrete=True)
    place = np.array([(a + 1) * 2, b])
    taken = solution.control_at([a, b])
    off = np.abs(place - np.round(place))
    assert np.any(np.all(policy == taken, axis=-1))  # bit for bit a control of the set
    if np.all(off < 0.499):
        np.testing.assert_array_equal(taken, policy[tuple(np.round(place).astype(int))])


@pytest.mark.filterwarnings("ignore:.*outside the grid, where")
def test_the_nearest_node_round_the_corner():
    ring = Grid([0.0], [1.0], (4,), (True,))
    solution = Solution(ring, np.zeros(4), np.arange(4.0)[:, None], discrete=True)
    x = np.array([[0.9], [-0.1], [0.8], [0.125], [5.3], [-0.2]])
    np.testing.assert_array_equal(solution.control_at(x)[:, 0], [0, 0, 3, 0, 1, 3])
    box = Solution(Grid([0.0], [3.0], (4,)), np.zeros(4), np.arange(4.0)[:, None], discrete=True)
    np.testing.assert_array_equal(box.control_at([[3.2], [2.6]])[:, 0], [np.nan, 3])
    np.testing.assert_array_equal(box.control_at([[3.2], [-7]], clamp=True)[:, 0], [3, 0])


def test_enumerated_disturbances_too():
    grid = Grid([0.0], [1.0], (2,))
    fields = {"value": np.zeros(2), "policy": np.array([[-1.0], [1.0]]), "disturbance": np.array([[-1.0], [1.0]])}
    solution = Solution(grid, **fields, discrete_disturbance=True)
    assert solution.disturbance_at([0.6]).tolist() == [1.0]
    assert solution.control_at([0.6]) == pytest.approx(0.2)


# Transformations

X = np.array([[0.3, 1.2], [-0.7, 2.9], [5.0, 0.0]])


@pytest.mark.filterwarnings("ignore:.*outside the grid, where")
@pytest.mark.parametrize("discrete", [False, True])
def test_jit_and_vmap_agree_with_the_host(discrete):
    random = np.random.default_rng(1)
    fields = {"policy": random.normal(size=(5, 4, 2)), "disturbance": random.normal(size=(5, 4, 1))}
    solution = solution_of(lambda a, b: np.cos(a) * b, discrete=discrete, discrete_disturbance=discrete, **fields)
    for name in ("control_at",) if discrete else ("value_at", "disturbance_at"):
        host = getattr(solution, name)(X)
        for dtype, tolerance in ((np.float32, 2e-6), (np.float64, 1e-14)):
            with jax.enable_x64(dtype == np.float64):
                x = jnp.asarray(X, dtype)
                ways = [
                    jax.jit(jax.vmap(getattr(solution, name)))(x),
                    jax.jit(lambda solution, x, name=name: getattr(solution, name)(x))(solution, x),
                ]
                for way in ways:
                    assert way.dtype == dtype
                    np.testing.assert_allclose(way, host, rtol=0, atol=tolerance)


def test_the_answer_has_the_tracers_dtype():
    with jax.enable_x64(True):
        assert jax.jit(LINEAR.value_at)(jnp.zeros(2, np.float32)).dtype == np.float32
        assert jax.jit(LINEAR.value_at)(jnp.zeros(2, np.float64)).dtype == np.float64
        assert jax.jit(LINEAR.value_at)(jnp.zeros(2, int)).dtype == np.float64
    assert jax.jit(LINEAR.value_at)(jnp.zeros(2, int)).dtype == np.float32
    assert jax.jit(lambda a: LINEAR.value_at([a, 1.0]))(0.5) == 1.0


def test_a_concrete_query_inside_jit_is_a_constant():
    seen = []

    @jax.jit
    def shifted(y):
        seen.append((LINEAR.value_at([0.1, 1.0]), LINEAR.control_at([0.1, 1.0])))
        return y + seen[0][0]

    assert shifted(1.0) == pytest.approx(1.2)
    assert isinstance(seen[0][0], np.float64)
    assert seen[0][1].dtype == np.float64


def test_slopes_between_the_nodes():
    slope = jax.grad(LINEAR.value_at)(jnp.array([0.3, 1.2]))
    np.testing.assert_allclose(slope, [2.0, -1.0], rtol=1e-5)
    jacobian = jax.jacobian(LINEAR.control_at)(jnp.array([0.3, 1.2]))
    np.testing.assert_allclose(jacobian, [[4.0, -2.0]], rtol=1e-5)
    policy = LINEAR.policy.copy()
    policy[3, :] = np.nan
    gaps = Solution(GRID, LINEAR.value, policy)
    assert np.all(np.isfinite(jax.jacobian(gaps.control_at)(jnp.array([0.3, 1.2]))))


def test_grad_with_respect_to_the_node_values():
    def value_there(value):
        return Solution(GRID, value, None).value_at([0.25, 1.5])

    weights = jax.grad(value_there)(jnp.asarray(LINEAR.value))
    expected = np.zeros((5, 4))
    expected[2:4, 1:3] = 0.25
    np.testing.assert_allclose(weights, expected, atol=1e-6)
