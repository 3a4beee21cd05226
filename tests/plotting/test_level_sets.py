"""Zero level sets: where the curves run, projections, stacks, and pictures that move."""

from types import SimpleNamespace

import numpy as np
import pytest

from hjbjax import plotting
from hjbjax.problem.grid import Grid

BALL = Grid([-1.0] * 3, [1.0] * 3, (21,) * 3, names=("x", "y", "z"))


def solution(values, grid=BALL, times=None):
    return SimpleNamespace(grid=grid, value=values, times=times, policy=None)


def ball(radius, grid=BALL):
    return np.linalg.norm(grid.nodes(), axis=-1) - radius


def radii(artist):
    """The distances from the origin of the points of a contour."""
    return np.concatenate([np.linalg.norm(path.vertices, axis=-1) for path in artist.get_paths()])


def test_a_slice_of_a_ball_is_a_disc():
    curve, filled = plotting.zero_level_set(solution(ball(0.6)), fixed={"z": 0.3})
    np.testing.assert_allclose(radii(curve), np.sqrt(0.36 - 0.09), atol=0.02)
    assert curve.axes.get_xlabel() == "x"
    assert "z = 0.3" in curve.axes.get_title(loc="right")
    assert filled.axes is curve.axes


def test_the_projection_of_a_ball_has_its_radius():
    curve = plotting.zero_level_set(solution(ball(0.6)), project=["z"], fill=False)[0]
    np.testing.assert_allclose(radii(curve), 0.6, atol=0.02)
    outside = plotting.zero_level_set(solution(-ball(0.6)), project=[2], fill=False, inside="above")[0]
    np.testing.assert_allclose(radii(outside), 0.6, atol=0.02)


def test_three_axes_make_a_stack():
    stack = plotting.zero_level_set(solution(ball(0.6)), label="ball")
    assert len(stack) == 11  # the planes at |z| < .6
    assert stack[0].axes.get_zlabel() == "z"


def test_an_empty_set_draws_nothing():
    assert plotting.zero_level_set(solution(ball(0.6) + 1), fixed={"z": 0.0}) == []


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"inside": "under"}, "got inside = 'under'"),
        ({"project": ["x", "y"]}, "fewer than two axes"),
        ({"fixed": {"x": 0.0, "y": 0.0}}, "one axis is free"),
        ({"project": ["w"]}, "got axis 'w'"),
    ],
)
def test_bad_input_is_refused(options, reason):
    with pytest.raises(ValueError, match=reason):
        plotting.zero_level_set(solution(ball(0.6)), **options)


def test_an_animation_has_a_frame_a_time(tmp_path):
    plane = Grid([-1.0, -1.0], [1.0, 1.0], (21, 21))
    values = np.stack([ball(radius, plane) for radius in (0.8, 0.5, 0.2)])
    moving = plotting.animation(solution(values, plane, np.array([0.0, 0.5, 1.0])))
    assert list(moving.new_frame_seq()) == [1.0, 0.5, 0.0]
    moving.save(tmp_path / "tube.gif", writer="pillow")
    assert (tmp_path / "tube.gif").stat().st_size > 1000
    with pytest.raises(ValueError, match="the solution is stationary"):
        plotting.animation(solution(ball(0.5, plane), plane))
