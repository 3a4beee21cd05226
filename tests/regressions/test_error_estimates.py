"""Estimates of the error that were many times too small, and a bound that said nothing."""

import numpy as np
import pytest

import hjbjax as hjb
from benchmarks.accuracy import known_answers as known


def solved(case, **options):
    """The solution, its error and the estimate, the largest over the nodes that count."""
    states = np.asarray(case.grid.nodes()).reshape(-1, case.grid.ndim)
    counts = np.ones(len(states), bool) if case.region is None else case.region(states)
    solution = hjb.solve(case.problem, case.grid, **options)
    counts = counts.reshape(case.grid.shape)
    error = np.abs(solution.value - case.exact(states).reshape(case.grid.shape))[counts]
    return solution, np.max(error), solution.grid_error is not None and np.max(solution.grid_error[counts])


def past_a_disc(nodes):
    return known.past(
        0.3, known.disc_at((0.0, 0.0), 0.3), lambda x, way: known._hit_disc(x, way, (0.0, 0.0), 0.3), "", nodes
    )


@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_v_jumps_where_a_flow_passes_a_target():
    _, error, estimate = solved(past_a_disc(41))
    assert error > 3
    assert error / 3 < estimate < 3 * error


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
@pytest.mark.parametrize("shape", [(31, 121), (51, 51)])
def test_a_coarser_grid_keeps_a_target_of_one_node(shape):
    _, error, estimate = solved(known.pushed(shape, 1.5, 1e-6, 1.0))
    assert error > 0.1
    assert error / 3 < estimate


@pytest.mark.slow
@pytest.mark.parametrize("controls", [hjb.Ball(1.0, 2), hjb.Box([-1.0, -1.0], [1.0, 1.0])])
def test_distances_to_a_box_are_of_first_order(controls):
    def distance(x):
        outside = np.maximum(np.abs(x - np.array([0.3, -0.2])) - np.array([0.33, 0.21]), 0)
        return np.hypot(*outside.T) if isinstance(controls, hjb.Ball) else np.max(outside, axis=1)

    case = known.to("", known.box_at((0.3, -0.2), (0.33, 0.21)), distance, known.plane(41), controls)
    _, error, estimate = solved(case)
    assert error / 3 < estimate < 3 * error


@pytest.mark.slow
def test_what_the_iteration_left_is_part_of_the_estimate():
    _, error, estimate = solved(known.swirl(0.1))
    assert error < 3 * estimate


@pytest.mark.filterwarnings("ignore:the box decides V:hjbjax.SolveWarning")
def test_a_layer_that_is_thinner_than_a_cell():
    _, error, estimate = solved(known.reflected(0.01, 0.01, 0.05, 101), tol=1e-6)
    assert error / 3 < estimate < 3 * error


@pytest.mark.slow
def test_an_axis_of_two_nodes_is_a_chain_of_two_states():
    _, error, estimate = solved(known.income(41, 0.3, True), tol=1e-9)
    assert error < 1e-7
    assert estimate < 1e-6


def test_the_screen_quotes_no_bound_above_the_range_of_v():
    grid = hjb.Grid([0.0], [1.0], (5,))
    for bound, quoted in ((0.5, True), (3.31e4, False)):
        solution = hjb.Solution(
            grid, np.linspace(0, 3, 5), np.zeros((5, 1)), code=0, steps=1, monotone_error=bound, stats={"tol": 1e-3}
        )
        assert ("of the monotone start" in str(solution)) is quoted
        assert "residual at most 0.001 at high order" in str(solution)


def test_without_a_coarser_grid_the_solution_says_why_there_is_no_estimate():
    solution = hjb.solve(known.ornstein(2, 9).problem, hjb.Grid([-1.0], [1.0], (9,)))
    assert solution.grid_error is None
    assert solution.stats["grid_error"] == "not estimated: it takes at least 11 intervals per axis"
    assert "grid error       not estimated: it takes" in str(solution)
