"""Names and units of states and controls: checked, static, and carried from the problem to a file and back."""

import jax
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.problem.labels import Labels, of_file


def labelled():
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-3.0], [3.0]), discount=1.0, control_names=("speed",),
        control_units=("m/s",), value_name="V = 1 − e⁻ᵀ", time_unit="s",
    )  # fmt: skip
    return problem, hjb.Grid([-1.0], [1.0], (11,), names=("place",), units=("m",))


def test_a_solution_carries_the_words_to_its_file_and_back(tmp_path):
    problem, grid = labelled()
    solution = hjb.solve(problem, grid)
    assert solution.labels == Labels(("speed",), ("m/s",), value="V = 1 − e⁻ᵀ", time_unit="s")
    assert solution.problem is not None
    assert "place [m]: 11 = 11 nodes" in str(solution)
    solution.save(tmp_path / "run.npz")
    again = hjb.load(tmp_path / "run.npz")
    assert (again.labels, again.grid.labels, again.problem) == (solution.labels, ("place [m]",), None)


def test_words_of_an_older_file_are_read():
    assert of_file([["speed"], ["m/s"], "below"]) == Labels(("speed",), ("m/s",))
    assert of_file([["speed"], ["m/s"], "below", "reward"]) == Labels(("speed",), ("m/s",), payoff="reward")


def test_words_are_static_and_the_problem_stays_on_the_host():
    problem, grid = labelled()
    solution = hjb.Solution(grid, np.zeros(11), np.zeros((11, 1)), labels=problem.labels, problem=problem)
    again = jax.tree.map(lambda leaf: leaf, solution)
    assert (again.labels, again.grid.units, again.problem) == (problem.labels, ("m",), None)


def test_the_tube_of_avoid_says_on_which_side_it_is():
    assert hjb.avoid(lambda x, u: u, hjb.Box([-1.0], [1.0]), lambda x: x[0]).labels.inside == "above"
    assert hjb.reach(lambda x, u: u, hjb.Box([-1.0], [1.0]), lambda x: x[0]).labels.inside == "below"


@pytest.mark.parametrize(
    ("options", "error", "reason"),
    [
        ({"control_names": ("a", "b")}, ValueError, r"Problem.control_names: got .*2 texts for 1; wanted one for each"),
        ({"control_units": "N m"}, TypeError, r"Problem.control_units: got 'N m', wanted a tuple of texts"),
        ({"value_name": None}, TypeError, r"Problem.value_name: got None, wanted a text"),
        ({"time_unit": ("s",)}, TypeError, r"Problem.time_unit: got \('s',\), wanted a text"),
        ({"inside": "under"}, ValueError, r"Problem.inside: got 'under', wanted 'below'"),
    ],
)
def test_words_that_do_not_fit_are_refused(options, error, reason):
    with pytest.raises(error, match=reason):
        hjb.Problem(lambda x, u: u, None, hjb.Box([-1.0], [1.0]), **options)


def test_units_of_another_number_than_axes_are_refused():
    with pytest.raises(ValueError, match=r"Grid.units: got \('m',\), 1 texts for 2"):
        hjb.Grid([0.0, 0.0], [1.0, 1.0], (3, 3), units=("m",))
