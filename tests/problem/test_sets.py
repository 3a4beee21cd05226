"""Admissible sets: what they hold, and what they refuse."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hjbjax import Ball, Box, Finite, Simplex
from hjbjax.problem.sets import extremes, holds, samples, spacing


@pytest.mark.parametrize(
    ("lo", "hi", "words"),
    [
        ([1.0], [-1.0], "no admissible control: input 0 has lo = 1 > hi = -1"),
        ([0.0, 2.0], [1.0, 1.0], "no admissible control: input 1"),
        ([], [], "wanted \\(m,\\) twice"),
        ([0.0], [1.0, 1.0], "wanted \\(m,\\) twice"),
        (0.0, [1.0], "wanted \\(m,\\) twice"),
        ([[0.0]], [[1.0]], "wanted \\(m,\\) twice"),
        ([float("nan")], [1.0], "Box.lo.*wanted finite numbers"),
        ([0.0], [float("-inf")], "Box.hi.*wanted finite numbers, or inf where there is no bound"),
        ([float("inf")], [float("inf")], "Box.lo.*wanted finite numbers, or -inf where there is no bound"),
        ([None], [1.0], "Box.lo.*wanted finite numbers"),
    ],
)
def test_box_refuses(lo, hi, words):
    with pytest.raises(ValueError, match=words):
        Box(lo, hi)


@pytest.mark.parametrize("lo", ["1", ["-1"], [1j], ["a"], [[1.0], [1.0, 2.0]], [{}]])
def test_box_wants_numbers(lo):
    with pytest.raises(TypeError, match="Box.lo: got .* wanted numbers"):
        Box(lo, [1.0])


def test_a_box_of_one_point_is_admissible():
    assert Box([1.0], [1.0]).grid(3).points.tolist() == [[1.0]] * 3


def test_an_infinite_bound_cannot_be_sampled_on_a_grid():
    box = Box([0.0, -1.0], [np.inf, 1.0])
    assert box.unbounded
    assert not Box([0.0], [1.0]).unbounded
    with pytest.raises(ValueError, match=r"Box.grid: got infinite bounds, .* give finite bounds"):
        box.grid(3)


def test_a_set_keeps_its_own_numbers():
    bounds = np.array([1.0])
    box, finite = Box(-bounds, bounds), Finite(bounds[None])
    bounds[0] = 7.0
    assert box.hi.tolist() == [1.0]
    assert finite.points.tolist() == [[1.0]]


@pytest.mark.parametrize(
    ("radius", "dim", "words"),
    [
        (-1.0, 2, "no admissible control: radius = -1 < 0"),
        (float("nan"), 2, "wanted finite numbers"),
        (float("inf"), 2, "wanted finite numbers"),
        ([1.0, 2.0], 2, "wanted one number"),
        (1.0, 0, "wanted a positive integer"),
        (1.0, -1, "wanted a positive integer"),
        (1.0, 2.0, "wanted a positive integer"),
        (1.0, True, "wanted a positive integer"),
        (1.0, "2", "wanted a positive integer"),
    ],
)
def test_ball_refuses(radius, dim, words):
    with pytest.raises(ValueError, match=words):
        Ball(radius, dim)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([], "no admissible control"),
        (np.zeros((0, 2)), "no admissible control"),
        (np.zeros((2, 0)), "no admissible control"),
        ([1.0, 2.0], "wanted \\(K, m\\): one row per control"),
        (3.0, "no admissible control"),
        ([[float("nan")]], "wanted finite numbers"),
    ],
)
def test_finite_refuses(points, words):
    with pytest.raises(ValueError, match=words):
        Finite(points)


def test_dimensions():
    assert (Box([0.0, 0.0], [1.0, 1.0]).dim, Ball(1.0, 3).dim, Finite([[1.0], [2.0]]).dim) == (2, 3, 1)
    assert type(Ball(1.0, np.int64(3)).dim) is int


@pytest.mark.parametrize("num", [0, -1, 2.0, True, "3", (3,), (3, 0), (3, 2.5), None])
def test_box_grid_refuses(num):
    with pytest.raises(ValueError, match="Box.grid: got .* wanted a positive integer or 2 of them"):
        Box([0.0, 0.0], [1.0, 1.0]).grid(num)


@given(st.floats(1e-6, 1e6), st.integers(0, 20))
def test_an_odd_sample_of_a_symmetric_box_holds_an_exact_zero(bound, half):
    points = Box([-bound], [bound]).grid(2 * half + 1).points
    assert half == 0 or points[half, 0] == 0.0
    np.testing.assert_allclose(points, np.linspace([-bound], [bound], 2 * half + 1), rtol=1e-14, atol=1e-14 * bound)


def test_a_sample_of_two_inputs_is_their_product_in_order():
    points = Box([0.0, -1.0], [2.0, 1.0]).grid((3, np.int64(2))).points
    assert points.tolist() == [list(pair) for pair in itertools.product([0.0, 1.0, 2.0], [-1.0, 1.0])]


def test_the_numbers_in_a_set_are_leaves():
    wide = jax.jit(lambda bound: Box([-bound, 0.0], jnp.stack([bound, 1.0])).grid(2).points)
    assert wide(2.0).tolist() == [[-2.0, 0.0], [-2.0, 1.0], [2.0, 0.0], [2.0, 1.0]]
    assert jax.tree.map(lambda leaf: 2 * leaf, Box([-1.0], [1.0])).hi.tolist() == [2.0]
    assert jax.tree.map(lambda leaf: 2 * leaf, Ball(1.5, 2)).radius == 3.0
    assert jax.grad(lambda r: Ball(r, 2).radius ** 2)(3.0) == 6.0


def test_sets_stack_and_unstack():
    boxes = jax.tree.map(lambda *leaves: np.stack(leaves), *(Box([-bound], [bound]) for bound in (1.0, 2.0)))
    assert boxes.dim == 1
    assert jax.vmap(lambda box: box.hi[0] - box.lo[0])(boxes).tolist() == [2.0, 4.0]


# --- the simplex ---


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ((0,), ValueError, "got dim = 0, wanted a positive integer"),
        ((2.0,), ValueError, "got dim = 2.0, wanted a positive integer"),
        ((True,), ValueError, "got dim = True, wanted a positive integer"),
        (([0.5, 0.5],), ValueError, "wanted a positive integer: the number of inputs"),
        ((2, 0.0), ValueError, "got total = 0, wanted a positive number"),
        ((2, -1.0), ValueError, "got total = -1, wanted a positive number"),
        ((2, float("nan")), ValueError, "Simplex.total.*wanted finite numbers"),
        ((2, float("inf")), ValueError, "Simplex.total.*wanted finite numbers"),
        ((2, [1.0, 2.0]), ValueError, "a total of shape \\(2,\\), wanted one number"),
        ((2, "1"), TypeError, "Simplex.total: got .* wanted numbers"),
        ((2, 1.0, 3), TypeError, "got at_most = 3, wanted True or False"),
    ],
)
def test_simplex_refuses(arguments, error, words):
    with pytest.raises(error, match=words):
        Simplex(*arguments)


@pytest.mark.parametrize("num", [0, 1, 2.0, True, [3, 3]])
def test_a_simplex_is_sampled_with_at_least_two_values_per_input(num):
    with pytest.raises(ValueError, match=r"Simplex.grid: got .*, wanted an integer of at least 2"):
        Simplex(3).grid(num)


@pytest.mark.parametrize("at_most", [False, True])
@pytest.mark.parametrize("dim", [1, 2, 3, 5, 12])
@pytest.mark.parametrize("budget", [1, 9, 33, 64])
def test_samples_of_a_simplex(dim, at_most, budget):
    simplex = Simplex(dim, 2.5, at_most)
    points, corners = samples(simplex, budget), extremes(simplex)
    assert len(points) <= max(budget, dim + at_most) + 1
    assert np.all(holds(simplex, points))
    found = {tuple(row) for row in points.tolist()}
    assert {tuple(row) for row in corners.tolist()} <= found
    assert len(found) == len(points)
    assert len(corners) == dim + at_most
    assert np.min(np.linalg.norm(points - 2.5 / (dim + at_most), axis=1)) < 1e-12  # the centre
    assert all(0 < width <= 2.5 for width in spacing(simplex, budget))


def test_the_lattice_of_a_simplex_is_complete():
    rows = [row for row in itertools.product(range(5), repeat=3) if sum(row) <= 4]
    assert Simplex(3, 4.0, at_most=True).grid(5).points.tolist() == [list(row) for row in rows]
    assert Simplex(3, 4.0).grid(5).points.tolist() == [list(row) for row in rows if sum(row) == 4]
    assert Simplex(1, 4.0).grid(5).points.tolist() == [[4.0]]


@pytest.mark.parametrize("total", [1e-6, 1.0, 1e6])
def test_a_simplex_holds_its_points_up_to_rounding(total):
    points = total * np.array([[0.3, 0.7], [1.0, 0.0], [1 + 1e-8, -1e-8], [0.2, 0.3], [0.7, 0.7], [1.1, -0.1]])
    assert holds(Simplex(2, total), points).tolist() == [True, True, True, False, False, False]
    assert holds(Simplex(2, total, at_most=True), points).tolist() == [True, True, True, True, False, False]


def test_the_total_is_a_leaf():
    assert jax.tree.leaves(Simplex(3, 2.0)) == [2.0]
    assert Simplex(3, 2.0, True).freedom == 3
    assert Simplex(3, 2.0).freedom == 2
    jax.jit(lambda total: Simplex(3, total).total)(-1.0)  # not known, not refused
