"""Zero level sets: where the curves run, projections, stacks, and pictures that move."""

import sys
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from pictures import covers
from pictures import pictures as plotting

import hjbjax as hjb
from hjbjax.plotting import level_sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import Labels
from hjbjax.solution.placement import FileError

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


def test_a_surface_over_three_of_four_axes_names_the_cut():
    grid = Grid([-1.0] * 4, [1.0] * 4, (5,) * 4, names=("x", "y", "z", "speed"), units=("", "", "", "m/s"))
    picture = plotting.zero_level_set(solution(ball(0.6, grid), grid), fixed={"speed": 0.25})
    assert picture.ax.get_title(loc="right") == "speed = 0.25 m/s"


def test_three_axes_make_a_closed_surface():
    picture = plotting.zero_level_set(solution(ball(0.6)), label="ball")
    assert picture.ax.get_zlabel() == "z"
    assert [text.get_text() for text in picture.ax.get_legend().get_texts()] == ["ball"]
    x = np.asarray(BALL.axis(0))
    triangles = plotting.level_surface(ball(0.6), (x, x, x))
    assert len(picture[0].get_facecolor()) == len(triangles)
    np.testing.assert_allclose(np.linalg.norm(triangles, axis=-1), 0.6, atol=0.01)
    a, b, c = np.moveaxis(triangles, 1, 0)
    normals = np.cross(b - a, c - a)
    assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(4 * np.pi * 0.36, rel=0.01)
    # of a closed surface the divergence theorem gives the volume, with every triangle turned outwards
    outwards = np.sign(np.sum(normals * a, axis=1))
    assert np.sum(outwards * np.sum(normals * a, axis=1)) / 6 == pytest.approx(4 / 3 * np.pi * 0.216, rel=0.02)
    colours = picture[0].get_facecolor()
    assert set(np.unique(colours[:, 3]).round(3)) == {0.55}  # it can be seen through
    assert np.ptp(colours[:, :3].sum(axis=1)) > 0.3  # and is brighter towards the light


def test_a_surface_is_closed_at_a_periodic_seam_and_cut_along_a_fourth_axis(monkeypatch):
    found = []

    def spy(*arguments):
        found.append(plotting.level_surface(*arguments))
        return found[0]

    monkeypatch.setattr(level_sets, "level_surface", spy)
    grid = Grid([-1.0, -1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0], (9, 9, 6, 5), periodic=(False, False, True, False))
    x = grid.nodes()
    tube = solution(np.hypot(x[..., 0], x[..., 1]) - 0.4 - 0.4 * x[..., 3], grid)
    plotting.zero_level_set(tube, fixed={3: 0.5})
    corners = found[0].reshape(-1, 3)
    assert corners[:, 2].min() == 0.0
    assert corners[:, 2].max() == 1.0  # up to the seam
    np.testing.assert_allclose(np.linalg.norm(corners[:, :2], axis=1), 0.6, atol=0.04)


def test_a_surface_that_can_be_turned_is_a_page_of_its_own(tmp_path):
    pytest.importorskip("plotly")
    grid = Grid([-1.0] * 3, [1.0] * 3, (15,) * 3, names=("x", "y", "z"), units=("m", "m", "s"))
    turned = Grid([-1.0, -1.0, -np.pi], [1.0, 1.0, np.pi], (5, 5, 6), (False, False, True))
    axis = plotting.turning_surface(solution(ball(0.6, turned), turned)).figure.layout.scene.zaxis
    assert axis.ticktext == ("−π", "−π/2", "0", "π/2", "π")
    scene = plotting.turning_surface(solution(ball(0.6, grid), grid), inside="below")
    (mesh,) = scene.figure.data
    vertices = np.stack([mesh.x, mesh.y, mesh.z], axis=-1)
    # chords of cells cut off as much as (√3/7)²/(8 · 0.6) of the radius
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=-1), 0.6, atol=0.0128)
    # a closed surface of triangles: Euler's V − E + F = 2, with 3F = 2E
    assert len(vertices) - len(mesh.i) / 2 == 2
    assert scene.figure.layout.scene.xaxis.title.text == "x [m]"
    scene.save(tmp_path / "ball.html")
    assert "x [m]" in (tmp_path / "ball.html").read_text(encoding="utf-8")
    with pytest.raises(FileError, match="ball.html: cannot be written: there is no folder"):
        scene.save(tmp_path / "missing" / "ball.html")
    with pytest.raises(ValueError, match="2 axes are free, wanted three"):
        plotting.turning_surface(solution(ball(0.6, grid), grid), fixed={"x": 0.0})


def test_without_plotly_it_is_told_how_to_come_by_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly", None)
    with pytest.raises(ImportError, match=r"pip install 'hjbjax\[plot3d\]'"):
        plotting.turning_surface(solution(ball(0.6)))


def test_a_closed_loop_goes_on_an_empty_figure_of_pyplots():
    plane = Grid([-1.0] * 2, [1.0] * 2, (5, 5))
    answer = hjb.Solution(plane, np.sum(plane.nodes() ** 2, -1), -plane.nodes()[..., :1])
    path = SimpleNamespace(times=np.array([0.0, 1.0]), states=np.full((2, 2), 0.5), controls=np.zeros((1, 1)))
    pyplot.close("all")
    empty = pyplot.figure(figsize=(12, 4))
    assert hjb.plotting.closed_loop(answer, path).figure is empty
    assert hjb.plotting.closed_loop(answer, path).figure is not empty


def test_what_an_avoid_problem_is_about_is_shaded_without_being_told():
    plane = Grid([-1.0, -1.0], [1.0, 1.0], (21, 21))
    inside_out = solution(-ball(0.6, plane), plane)
    inside_out.labels = Labels(inside="above")
    _, filled = plotting.zero_level_set(inside_out)
    assert covers(filled, [[0.0, 0.0], [0.9, 0.9]]).tolist() == [True, False]
    told = plotting.zero_level_set(inside_out, inside="below")
    assert covers(told[1], [[0.0, 0.0], [0.9, 0.9]]).tolist() == [False, True]


def test_the_sets_of_a_problem_of_reachability_are_outlined():
    plane = Grid([-1.0, -1.0], [1.0, 1.0], (21, 21))
    problem = hjb.reach_avoid(
        lambda x, u: u, hjb.Ball(1.0, 2), lambda x: jnp.hypot(x[0], x[1]) - 0.3, lambda x: 0.8 - x[1]
    )
    about = solution(ball(0.6, plane), plane)
    about.problem = problem
    picture = plotting.zero_level_set(about)
    assert [text.get_text() for text in picture.ax.get_legend().get_texts()] == ["target", "obstacle"]
    target, obstacle = picture.ax.get_legend().legend_handles
    assert to_hex(obstacle.get_facecolor()) == hjb.plotting.GREY  # a solid area, while a target is an outline
    assert not hasattr(target, "get_facecolor")
    outlines = [each for each in picture if each.get_zorder() == 2.5]
    np.testing.assert_allclose(radii(outlines[0]), 0.3, atol=1e-3)
    np.testing.assert_allclose(outlines[1].get_paths()[0].vertices[:, 1], 0.8, atol=1e-9)


def test_flat_axes_for_a_surface_are_refused():
    with pytest.raises(ValueError, match="flat axes for three free states"):
        plotting.zero_level_set(solution(ball(0.6)), ax=Figure().add_subplot())


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
