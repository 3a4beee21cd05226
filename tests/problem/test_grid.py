"""The box of nodes: exact coordinates, wrapping, interpolation, and refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hjbjax import Grid, Sinh
from hjbjax.problem.grid import tabulated
from hjbjax.problem.pytree import altered

finite = st.floats(-1e3, 1e3, allow_subnormal=False)  # XLA flushes subnormal numbers to zero
PLANE = Grid(lo=[-1.0, 0.0], hi=[2.0, 4.0], shape=(5, 4))
CYLINDER = Grid(lo=[-np.pi, -1.0], hi=[np.pi, 1.0], shape=(8, 3), periodic=(True, False))
on_plane = jax.jit(PLANE.interpolate, static_argnames="clamp")
on_cylinder = jax.jit(CYLINDER.interpolate, static_argnames="clamp")


def refuses(error, words, lo=(0.0, 0.0), hi=(1.0, 1.0), shape=(3, 3), **options):
    with pytest.raises(error, match=words):
        Grid(lo, hi, shape, **options)


@pytest.mark.parametrize(
    ("lo", "hi", "words"),
    [
        ([0.0, 1.0], [1.0, 1.0], "axis 1 runs from 1 to 1"),
        ([2.0, 0.0], [1.0, 1.0], "axis 0 runs from 2 to 1"),
        ([float("nan"), 0.0], [1.0, 1.0], "axis 0 .* wanted finite lo < hi"),
        ([0.0, 0.0], [1.0, float("inf")], "axis 1 .* wanted finite lo < hi"),
        (["a", 0.0], [1.0, 1.0], "Grid.lo"),
        (["0", "0"], [1.0, 1.0], "Grid.lo"),
        ([0.0, 0.0], None, "Grid.hi"),
        (0.0, 1.0, "Grid.lo"),
        ([[0.0, 0.0]], [1.0, 1.0], "Grid.lo"),
        ([], [], "Grid.lo"),
    ],
)
def test_bounds_are_refused(lo, hi, words):
    refuses((TypeError, ValueError), words, lo=lo, hi=hi)


@pytest.mark.parametrize(
    "options",
    [
        {"lo": (0.0,)},
        {"hi": (1.0, 1.0, 1.0)},
        {"shape": (3, 3, 3)},
        {"periodic": (True,)},
        {"names": ("angle",)},
        {"stretch": (None,)},
    ],
)
def test_lengths_that_differ_are_named(options):
    lengths = {"lo": 2, "hi": 2, "shape": 2, "periodic": 2, "names": 2, "stretch": 2}
    lengths.update({name: len(value) for name, value in options.items()})
    if "shape" in options:  # what is left out follows the shape
        lengths.update(periodic=3, names=3, stretch=3)
    named = "of lengths {lo}, {hi}, {shape}, {periodic}, {names} and {stretch}".format(**lengths)
    refuses(ValueError, named, **options)


@pytest.mark.parametrize(
    ("shape", "error", "words"),
    [
        ((1, 3), ValueError, "axis 0 has 1 points; wanted at least 2"),
        ((3, 0), ValueError, "axis 1 has 0 points"),
        ((3, -5), ValueError, "axis 1 has -5 points"),
        ((3, 3.0), TypeError, "axis 1 has 3.0 points; wanted an integer"),
        ((float("inf"), 3), TypeError, "axis 0 has inf points"),
        ((True, 3), TypeError, "axis 0 has True points"),
        ((np.True_, 3), TypeError, "axis 0"),
        (("3", 3), TypeError, "axis 0 has '3' points"),
        ("33", TypeError, "wanted a tuple of integers"),
        (3, TypeError, "wanted a tuple of integers"),
        (None, TypeError, "wanted a tuple of integers"),
    ],
)
def test_sizes_are_refused(shape, error, words):
    refuses(error, words, shape=shape)


@pytest.mark.parametrize("periodic", [(-1, 0), (0, 1), ("yes", "no"), (None, True), -1, 1, True, "10", {0}])
def test_periodic_is_one_bool_an_axis_and_nothing_else(periodic):
    refuses((TypeError, ValueError), r"Grid.periodic.* as in \(True, False\)", periodic=periodic)


@pytest.mark.parametrize("periodic", [[True, False], (np.True_, np.False_), np.array([True, False])])
def test_periodic_is_accepted_in_any_sequence(periodic):
    grid = Grid([0.0, 0.0], [1.0, 1.0], [4, np.int64(3)], periodic=periodic)
    assert grid.periodic == (True, False)
    assert grid.shape == (4, 3)
    assert all(type(count) is int for count in grid.shape)


def test_sizes_do_not_overflow():
    assert Grid([0.0] * 7, [1.0] * 7, (2000,) * 7).size == 2000**7


def test_a_grid_keeps_its_own_numbers():
    lo = np.array([0.0])
    grid = Grid(lo, [1.0], (3,))
    lo[0] = 5.0
    assert grid.lo.tolist() == [0.0]


@given(st.floats(1e-6, 1e6), st.integers(1, 500))
def test_the_middle_of_a_symmetric_axis_is_exactly_zero(bound, half):
    assert Grid([-bound], [bound], (2 * half + 1,)).axis(0)[half] == 0.0
    assert Grid([-bound], [bound], (2 * half,), periodic=(True,)).axis(0)[half] == 0.0


@given(st.integers(1, 300), st.integers(1, 300), st.integers(-20, 20))
def test_a_node_at_zero_is_exactly_zero(below, above, exponent):
    h = 2.0**exponent
    assert Grid([-below * h], [above * h], (below + above + 1,)).axis(0)[below] == 0.0


@given(finite, st.floats(1e-3, 1e3), st.integers(2, 200))
def test_ends_and_spacing(lo, length, count):
    ordinary, ring = Grid([lo], [lo + length], (count,)), Grid([lo], [lo + length], (count,), periodic=(True,))
    scale = 1e-15 * (abs(lo) + length)
    np.testing.assert_allclose(ordinary.axis(0)[[0, -1]], [lo, lo + length], rtol=0, atol=scale)
    np.testing.assert_allclose(ring.axis(0)[-1] + ring.spacing(0), lo + length, rtol=0, atol=4 * scale)
    np.testing.assert_allclose(np.diff(ordinary.axis(0)), ordinary.spacing(0), rtol=0, atol=4 * scale)


def test_components_broadcast_to_the_nodes():
    with jax.enable_x64(True):
        components = np.broadcast_arrays(*CYLINDER.components(np.float64))
    np.testing.assert_array_equal(np.stack(components, axis=-1), CYLINDER.nodes())
    np.testing.assert_array_equal(CYLINDER.state((3, 1)), CYLINDER.nodes()[3, 1])
    assert [component.shape for component in CYLINDER.components(np.float32)] == [(8, 1), (1, 3)]


def test_coordinates_follow_the_bounds_under_grad():
    spread = jax.grad(lambda hi: Grid(jnp.zeros(1), hi[None], (3,)).components(jnp.float32)[0].sum())
    assert spread(2.0) == 1.5  # 0 + hi/2 + hi


@given(finite, st.floats(1e-2, 1e3), st.lists(finite, min_size=4, max_size=4))
def test_wrap_is_into_the_period_and_only_once(lo, length, states):
    grid = Grid([lo], [lo + length], (4,), periodic=(True,))
    with jax.enable_x64(True):
        states = np.array(states)[:, None]
        wrapped = np.asarray(grid.wrap(states))
        assert np.all((wrapped >= lo) & (wrapped < grid.hi))
        np.testing.assert_array_equal(grid.wrap(wrapped), wrapped)
        turns = (states - wrapped) / (grid.hi - grid.lo)
        # Subtracting a state from the ends, of size lo, and dividing by the length rounds this much.
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-14 * (abs(lo) + 1e3 + length) / length)


def test_wrap_leaves_ordinary_axes_and_states_inside_alone():
    states = np.array([[1e-30, 5.0], [-np.pi, -7.0]])
    with jax.enable_x64(True):
        np.testing.assert_array_equal(CYLINDER.wrap(states), states)
        np.testing.assert_allclose(CYLINDER.wrap([4, 1]), [4 - 2 * np.pi, 1], rtol=1e-15)  # integers are numbers too
        below = Grid([0.0], [1.0], (2,), periodic=(True,)).wrap(np.array([-1e-20]))
    assert below.tolist() == [0.0]  # the remainder alone would give 1, which is outside


@given(st.lists(finite, min_size=4, max_size=4), st.lists(st.floats(0, 1), min_size=6, max_size=6))
def test_interpolation_is_exact_on_multilinear_functions(coefficients, places):
    def multilinear(x):
        a, b, c, d = coefficients
        return a + b * x[..., 0] + c * x[..., 1] + d * x[..., 0] * x[..., 1]

    states = PLANE.lo + np.reshape(places, (3, 2)) * (PLANE.hi - PLANE.lo)
    with jax.enable_x64(True):
        values = on_plane(multilinear(PLANE.nodes()), states)
    np.testing.assert_allclose(values, multilinear(states), rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("grid", [PLANE, CYLINDER, Grid([1000.1], [1001.1], (11,)), Grid([-0.3], [0.9], (8,))])
def test_interpolation_at_a_node_is_the_node(grid, dtype):
    values = np.random.default_rng(0).normal(size=grid.shape).astype(dtype)
    with jax.enable_x64(dtype == np.float64):
        at_nodes = jax.jit(grid.interpolate)(values, grid.nodes().astype(dtype))
        assert at_nodes.dtype == dtype
    np.testing.assert_array_equal(at_nodes, values)


def test_an_infinite_neighbour_stays_out_of_a_node():
    grid = Grid([-0.3], [0.9], (8,))
    on_line = jax.jit(grid.interpolate)
    for index in range(8):
        values = np.where(np.arange(8) == index, 1.0, np.inf)
        assert on_line(values, grid.state((index,))) == 1.0
    assert on_line(values, np.array([0.85])) == np.inf


def test_interpolation_crosses_the_seam_of_a_periodic_axis():
    values = np.zeros((8, 3))
    values[0], values[7] = 1.0, 3.0
    with jax.enable_x64(True):
        seam = on_cylinder(values, np.array([[np.pi - np.pi / 8, 0.0], [-np.pi - np.pi / 8, 0.5]]))
    np.testing.assert_allclose(seam, [2.0, 2.0], rtol=1e-14)


def test_outside_is_nan_or_the_nearest_point_as_asked():
    values, outside = PLANE.nodes()[..., 0], np.array([[3.0, 1.0], [-1.1, 1.0], [0.0, 4.5], [0.0, np.inf]])
    assert np.all(np.isnan(on_plane(values, outside)))
    np.testing.assert_allclose(on_plane(values, outside, clamp=True), [2.0, -1.0, 0.0, 0.0], atol=1e-6)
    assert np.isnan(on_plane(values, np.array([np.nan, 1.0]), clamp=True))
    assert np.isnan(on_cylinder(np.zeros((8, 3)), np.array([np.inf, 0.0]), clamp=True))  # no angle at all


def test_interpolation_carries_trailing_axes_and_batches():
    values = np.stack([PLANE.nodes()[..., 0], PLANE.nodes()[..., 1], np.ones(PLANE.shape)], axis=-1)
    states = np.array([[[0.5, 1.0]], [[2.0, 4.0]]])
    expected = np.concatenate([states, np.ones((2, 1, 1))], axis=-1)
    np.testing.assert_allclose(on_plane(values, states), expected, rtol=1e-6)
    mapped = jax.jit(jax.vmap(lambda x: on_plane(values, x)))(states)
    np.testing.assert_allclose(mapped, expected, rtol=1e-6)
    assert PLANE.interpolate(np.ones(PLANE.shape, int), [1, 1]) == 1.0  # integers and lists, and without jit


def test_the_derivative_is_the_slope_of_the_cell_and_at_a_node_of_the_cell_to_its_right():
    grid, values = Grid([-1.0], [1.0], (5,)), np.array([0.0, 1.0, 3.0, 6.0, 10.0])
    slope = jax.jit(jax.vmap(jax.grad(lambda x: grid.interpolate(values, x[None]))))
    np.testing.assert_allclose(slope(jnp.array([-0.7, 0.3, 0.0, 0.5])), [2.0, 6.0, 6.0, 8.0], rtol=1e-5)


@pytest.mark.parametrize(("values", "states"), [((5, 4), (3,)), ((5, 4), ()), ((4, 5), (2,)), ((5,), (2,))])
def test_interpolation_refuses_shapes(values, states):
    with pytest.raises(ValueError, match="Grid: got"):
        PLANE.interpolate(np.zeros(values), np.zeros(states))


def test_names():
    assert Grid([0.0, 0.0], [1.0, 1.0], (2, 2)).names == ("x1", "x2")
    assert Grid([0.0], [1.0], (2,), names=("angle",)).names == ("angle",)


def test_the_inner_share_of_a_box():
    grid = Grid([-1.0, 0.0, 0.0], [1.0, 4.0, 1.0], (5, 9, 4), (False, False, True))
    inside = grid.inner(0.5)
    assert inside.shape == grid.shape
    assert np.any(inside, axis=(1, 2)).tolist() == [False, True, True, True, False]
    assert np.flatnonzero(np.any(inside, axis=(0, 2))).tolist() == [2, 3, 4, 5, 6]
    assert np.all(inside[2, 4])  # a periodic axis has no edge to keep away from
    assert grid.inner(1.0).all()


def test_a_tabulated_grid_has_the_nodes_and_spacings_of_its_corners():
    """Also where the corners were changed alone, by whoever rebuilds the tree: then the tables are those of the old."""
    grid = Grid([-1.0, 0.0], [1.0, 2.0], (5, 7), stretch=(Sinh(2.0), None))
    for each in (grid, altered(grid, lo=np.array([-3.0, 0.5])), tabulated(grid)):
        found, wanted = tabulated(each), Grid(each.lo, each.hi, each.shape, stretch=each.stretch)
        assert tuple(found.spacing(axis) for axis in range(2)) == tuple(wanted.spacing(axis) for axis in range(2))
        for axis in range(2):
            np.testing.assert_allclose(found._coordinates[axis], wanted.axis(axis), rtol=0, atol=1e-15)
