"""The pursuit with a rudder that breaks, against its exact value where the rudder does not matter."""

import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.cli import gallery


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [{}, {"speed": 2.0, "evasion": 0.5, "discount": 0.5, "failure": 1.0}])
def test_without_a_rudder_the_boat_keeps_its_course(numbers):
    problem, grid = zoo.pursuit(**numbers, shape=(121, 120))
    solution = hjb.solve(problem, grid, tol=1e-5)
    straight = zoo.adrift_exact(**{name: number for name, number in numbers.items() if name != "failure"})
    nodes = grid.nodes().reshape(-1, 2)
    exact = np.array([float(straight(x)) for x in nodes]).reshape(grid.shape)
    steers, broken = solution.value
    assert np.mean(np.abs(broken - exact)) < 5e-4
    assert np.quantile(np.abs(broken - exact), 0.99) < 5e-3
    # the swimmer ahead of a boat on course is caught on this course, with and without a rudder
    on_course = np.argmin(np.abs(grid.axis(1)))
    ahead = grid.axis(0) > 0
    np.testing.assert_allclose(steers[ahead, on_course], exact[ahead, on_course], atol=2e-3)
    # a rudder only helps, above all on a course across
    assert np.all(steers <= broken + 1e-5)
    across = [1.0, np.pi / 2]
    assert solution.value_at(across, mode="steers") < solution.value_at(across, mode="broken") - 0.02


@pytest.mark.slow
def test_at_the_tolerance_of_pictures_the_rudder_turns_towards_the_swimmer_at_every_node():
    """By symmetry. With the default tolerance it is wrong next to the axes of symmetry, where V is nearly constant."""
    problem, grid = zoo.pursuit(shape=gallery.drawn_shape((81, 80)))
    solution = hjb.solve(problem, grid, tol=gallery.TOL)
    lead, course = np.moveaxis(grid.nodes(), -1, 0)
    turns = (np.abs(lead) > 0.25) & (np.abs(np.sin(course)) > 1e-6)  # on and against the course both ways are as good
    rudder = solution.in_mode("steers").policy[..., 0]
    np.testing.assert_array_equal(rudder[turns], -np.sign(lead * np.sin(course))[turns])


def test_a_swimmer_faster_than_the_boat_is_refused():
    with pytest.raises(ValueError, match="below that of the boat"):
        zoo.pursuit(evasion=1.0)
    assert float(zoo.adrift_exact()([0.1, 3.0])) == 0.0
    assert float(zoo.adrift_exact()([1.0, 0.0])) == pytest.approx(1 - np.exp(-0.8 / 0.6))
    assert float(zoo.adrift_exact()([1.0, np.pi])) == 1.0
