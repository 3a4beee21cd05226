"""Values of one grid at the nodes of another."""

import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.solvers import nested_grids


def test_nodes_that_both_grids_have_keep_their_bits():
    fine = hjb.Grid([0.0, 0.0], [1.0, 2.0], (13, 9))
    coarse = nested_grids.coarser(fine, 4)
    assert coarse.shape == (7, 5)
    values = np.random.default_rng(1).normal(size=fine.shape)
    np.testing.assert_array_equal(nested_grids.restrict(values, fine, coarse), values[::2, ::2])


def test_a_cubic_is_met_between_the_nodes():
    fine = hjb.Grid([-1.0, 0.0], [1.0, 3.0], (14, 16))
    coarse = nested_grids.coarser(fine, 4)
    assert coarse.shape == (8, 9)

    def cubic(grid):
        x, y = np.moveaxis(grid.nodes(), -1, 0)
        return x**3 - 2 * x * y**2 + y**3 - 1

    np.testing.assert_allclose(nested_grids.restrict(cubic(fine), fine, coarse), cubic(coarse), rtol=0, atol=1e-12)


def test_a_period_has_no_end():
    fine = hjb.Grid([0.0], [2 * np.pi], (41,), periodic=(True,))
    coarse = nested_grids.coarser(fine)
    assert coarse.shape == (21,)
    found = nested_grids.restrict(np.sin(fine.nodes()[:, 0]), fine, coarse)
    np.testing.assert_allclose(found, np.sin(coarse.nodes()[:, 0]), rtol=0, atol=2e-5)  # (3/128) h⁴, h = 2π/41


def test_back_and_forth():
    fine = hjb.Grid([0.0, -1.0], [1.0, 1.0], (11, 12))
    coarse = nested_grids.coarser(fine, 4)
    plane = fine.nodes() @ [2.0, -3.0] + 1
    np.testing.assert_allclose(
        nested_grids.prolong(nested_grids.restrict(plane, fine, coarse), coarse, fine), plane, rtol=0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("shape", "nested", "wanted"),
    [
        ((41, 41), False, (21, 21)),
        ((42, 60), False, (22, 31)),  # an odd number of intervals is rounded up
        ((31, 121), False, (11, 61)),  # half of 30 intervals has no node at the middle
        ((51, 51), False, (27, 27)),
        ((51, 51), True, (11, 11)),
        ((60, 60), True, None),  # 59 intervals have no divisor
        ((41, 2), False, (21, 2)),  # a chain of two states stays
        ((41, 9), False, None),
    ],
)
def test_the_grid_that_tells_the_error_keeps_the_held_node(shape, nested, wanted):
    grid, held = hjb.Grid([-1.0, -1.0], [1.0, 1.0], shape), np.zeros(shape, bool)
    if all(count % 2 for count in shape):
        held[shape[0] // 2, shape[1] // 2] = True
    coarse = nested_grids.comparison_grid(grid, held, np.zeros(shape, bool) if nested else None)
    assert (None if coarse is None else coarse.shape) == wanted


def test_a_second_target_is_not_lost_either():
    grid, held = hjb.Grid([0.0], [1.0], (41,)), np.zeros(41, bool)
    held[[0, 13, 40]] = True
    coarse = nested_grids.comparison_grid(grid, held)
    assert coarse is None or np.min(np.abs(np.asarray(coarse.axis(0)) - 13 / 40)) < 1e-9
    held[13:20] = True  # a wide one is on any grid
    assert nested_grids.comparison_grid(grid, held).shape == (21,)


def test_a_target_among_unreachable_nodes_is_not_lost():
    held = np.zeros(15, bool)
    held[7] = True  # the middle of 14 intervals is not a node of 7
    assert nested_grids.comparison_grid(hjb.Grid([-1.0], [1.0], (15,)), held, ~held) is None


def test_the_tip_of_a_disc_is_kept_with_the_disc():
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (41, 41))
    x = np.asarray(grid.nodes()).reshape(41, 41, 2)
    disc = np.hypot(x[..., 0] - 0.4, x[..., 1] + 0.55) < 0.2 + 1e-9  # its tips lie between coarse nodes
    assert nested_grids.comparison_grid(grid, disc).shape == (21, 21)
