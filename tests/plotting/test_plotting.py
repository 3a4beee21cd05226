"""The pictures: what is drawn is compared with the solution's numbers, never with pixels."""

import errno
import io
import itertools
import os
import subprocess
import sys
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from pictures import clearance, hatched_nodes, scale_label, texts
from pictures import pictures as plotting

from hjbjax import plotting as on_current_axes
from hjbjax import zoo
from hjbjax.plotting.scales import set_ticks
from hjbjax.plotting.style import legend
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import Labels
from hjbjax.problem.problem import Problem
from hjbjax.problem.pushes import Push
from hjbjax.problem.sets import Ball, Box
from hjbjax.problem.stretching import Sinh
from hjbjax.solution.placement import FileError
from hjbjax.solution.solution import Solution


def made(grid, value, policy=None, **more):
    """A Solution with the given functions of the table of nodes."""
    x = grid.nodes()
    policy = np.zeros((*grid.shape, 1)) if policy is None else policy(x)
    return Solution(grid, value(x), policy, **more)


def plane(shape=(5, 7), **more):
    grid = Grid([-1.0, -2.0], [1.0, 2.0], shape, names=("position", "velocity"), **more)
    return made(grid, lambda x: x[..., 0] ** 2 + 3 * x[..., 1], lambda x: -x[..., 1:])


def line(count=9):
    return made(Grid([-2.0], [2.0], (count,)), lambda x: x[..., 0] ** 2, lambda x: -x)


def volume(shape=(5, 4, 6), periodic=None):
    grid = Grid([0.0, 0.0, 0.0], [1.0, 2.0, 3.0], shape, periodic, names=("a", "b", "c"))
    return made(grid, lambda x: x[..., 0] + 10 * x[..., 1] + 100 * x[..., 2], lambda x: x - 1.0)


def path_of(states, controls=None, times=None):
    states = np.asarray(states, float)
    k = len(states) - 1
    controls = np.zeros((k, 1)) if controls is None else np.asarray(controls, float)
    times = np.linspace(0.0, 1.0, k + 1) if times is None else times
    return SimpleNamespace(times=times, states=states, controls=controls, cost=0.0)


def drawn(mesh):
    """The array of a mesh as (first axis, second axis)."""
    return np.ma.asarray(mesh.get_array()).T


def saved(artists):
    """Draws everything for real: the errors of a picture come late."""
    buffer = io.BytesIO()
    artists[0].get_figure().savefig(buffer, format="png", dpi=40)
    return buffer.getvalue()


def labels(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()] if ax.get_legend() else []


def test_a_value_over_one_axis_is_a_line_through_the_nodes():
    solution = line()
    artists = plotting.value(solution)
    np.testing.assert_array_equal(artists[0].get_xdata(), solution.grid.axis(0))
    np.testing.assert_array_equal(artists[0].get_ydata(), solution.value)
    ax = artists[0].axes
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_xlim(), labels(ax)) == ("x1", "V", (-2.0, 2.0), [])


def test_a_value_over_two_axes_is_a_mesh_of_the_nodes_with_contours():
    solution = plane()
    mesh, contours = plotting.value(solution)
    np.testing.assert_array_equal(drawn(mesh), solution.value)
    ax = mesh.axes
    assert (ax.get_xlabel(), ax.get_ylabel(), scale_label(mesh)) == ("position", "velocity", "V")
    assert ax.get_xlim() == (-1.0, 1.0)
    assert ax.get_ylim() == (-2.0, 2.0)
    assert mesh.get_clim() == (solution.value.min(), solution.value.max())
    assert mesh.get_cmap().name == "viridis"
    assert len(contours.levels) > 3
    assert all(solution.value.min() < level < solution.value.max() for level in contours.levels)
    assert saved([mesh]).startswith(b"\x89PNG")


def test_levels_are_a_count_or_values_and_a_constant_has_none():
    contours = plotting.value(plane(), levels=[9.0, 0.5, -99.0])[1]
    assert contours.levels.tolist() == [0.5]
    contours = plotting.value(plane(), levels=[1.5, 0.5])[1]
    assert contours.levels.tolist() == [0.5, 1.5]
    assert len(plotting.value(plane(), levels=0)) == 1
    flat = made(plane().grid, lambda x: np.full(x.shape[:-1], 4.0))
    assert len(plotting.value(flat)) == 1
    assert saved(plotting.policy(flat))


def test_the_axes_given_are_drawn_on_and_keep_their_figure():
    figure = Figure()
    ax = figure.add_subplot()
    artists = plotting.value(plane(), ax=ax, colorbar=False)
    artists += plotting.switching_curve(plane(), ax=ax)
    artists += plotting.trajectory(path_of([[0.5, 1.0], [0.0, 0.0]]), ax=ax, label="path")
    assert {artist.axes for artist in artists} == {ax}
    assert figure.axes == [ax]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("position", "velocity")
    assert labels(ax) == ["switching curve", "path"]


@pytest.mark.slow
def test_on_axes_that_are_given_nothing_is_shown_and_no_global_state_changes():
    """In an interpreter of its own: pyplot is not even imported, and rcParams stay as they are."""
    code = """
import sys, numpy as np, matplotlib
before = dict(matplotlib.rcParams.copy())  # looking at rcParams['backend'] itself would choose one
from matplotlib.figure import Figure
from hjbjax import plotting
from hjbjax.problem.grid import Grid
from hjbjax.solution.solution import Solution
grid = Grid([-1.0, -1.0], [1.0, 1.0], (5, 5))
solution = Solution(grid, grid.nodes()[..., 0], grid.nodes()[..., :1], residuals=np.array([1.0, 0.1]))
for draw in (plotting.value, plotting.policy, plotting.switching_curve, plotting.residuals):
    draw(solution, ax=Figure().add_subplot()).figure.savefig("/dev/null", format="png")
assert dict(matplotlib.rcParams.copy()) == before
assert "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run(
        [sys.executable, "-W", "error", "-c", code], check=True, timeout=60, env={"PATH": "/usr/bin", "HOME": "/tmp"}
    )


def test_importing_plotting_does_not_import_matplotlib():
    code = "import sys, hjbjax.plotting; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_policy_colours_are_centred_at_zero():
    solution = made(plane().grid, lambda x: x[..., 0], lambda x: x[..., 1:] + 1.0)
    mesh = plotting.policy(solution)[0]
    np.testing.assert_array_equal(drawn(mesh), solution.policy[..., 0])
    assert mesh.get_clim() == (-3.0, 3.0)
    assert np.ptp(mesh.get_cmap()(0.5)[:3]) < 0.02  # the middle is grey
    assert scale_label(mesh) == "u"


@pytest.mark.parametrize("shift", [1.0, 4.0, -4.0])
def test_the_colour_maps_rise_in_lightness(shift):
    """In CIE lightness, for both signs and for one sign: in grey no two controls have the same shade."""
    solution = made(plane().grid, lambda x: x[..., 0], lambda x: x[..., 1:] + shift)
    rgb = plotting.policy(solution)[0].get_cmap()(np.linspace(0, 1, 33))[:, :3]
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(116 * np.cbrt(luminance) - 16) > 0)


def test_a_control_that_jumps_over_one_axis_is_drawn_as_steps():
    grid = Grid([-1.0], [1.0], (21,))
    (line,) = plotting.policy(made(grid, lambda x: x[..., 0], lambda x: -np.sign(x)))
    assert line.get_drawstyle() == "steps-mid"
    (smooth,) = plotting.policy(made(grid, lambda x: x[..., 0], lambda x: -x))
    assert smooth.get_drawstyle() == "default"


def test_value_and_time_have_the_names_of_the_problem():
    problem, grid = zoo.eikonal(shape=(11, 11))
    solution = made(grid, lambda x: x[..., 0], labels=problem.labels)
    assert scale_label(plotting.value(solution)[0]) == "V = (1 − e⁻ᵝᵀ)/β [s]"
    path = path_of([[0.5, 0.0], [0.0, 0.0]])
    assert [ax.get_xlabel() for ax in plotting.closed_loop(solution, path).figure.axes][-1] == "t [s]"


def test_each_input_has_its_picture():
    solution = volume()
    for input in range(3):
        mesh = plotting.policy(solution, input=input, fixed={"c": 0.6})[0]
        np.testing.assert_allclose(drawn(mesh), solution.policy[:, :, 1, input])
        assert scale_label(mesh) == f"u{input + 1}"


@pytest.mark.parametrize("input", [3, -1, True, 1.0, "u1"])
def test_an_input_that_does_not_exist_is_refused(input):
    with pytest.raises(ValueError, match=r"got input=.*, wanted one of 0 to 2"):
        plotting.policy(volume(), input=input, fixed={"c": 0.6})


def test_without_a_control_there_is_no_policy_to_draw():
    with pytest.raises(ValueError, match="the problem has no control"):
        plotting.policy(made(line().grid, lambda x: x[..., 0], lambda x: np.zeros((*x.shape[:-1], 0))))
    with pytest.raises(ValueError, match="has no policy"):
        plotting.policy(Solution(line().grid, line().value, None))


def test_infinite_values_are_masked_and_named():
    solution = plane()
    solution.value[0, :] = np.inf
    picture = plotting.value(solution)
    np.testing.assert_array_equal(hatched_nodes(picture, solution.grid), np.isinf(solution.value))
    assert labels(picture.ax) == ["V = ∞"]
    assert picture[0].get_clim() == (solution.value[1:].min(), solution.value[1:].max())
    np.testing.assert_array_equal(drawn(picture[0])[0], solution.value[1])  # under the hatch what is next to it
    policy = plotting.policy(solution)
    np.testing.assert_array_equal(hatched_nodes(policy, solution.grid), np.isinf(solution.value))
    assert labels(policy.ax) == ["no control"]
    solution.value[3, 3] = np.nan
    picture = plotting.value(solution)
    assert labels(picture.ax) == ["V not finite"]
    np.testing.assert_array_equal(hatched_nodes(picture, solution.grid), ~np.isfinite(solution.value))
    assert saved(picture)


def test_masked_nodes_of_a_line_are_bands_half_a_cell_wide():
    solution = line()  # spacing 1/2
    solution.value[[0, 1, 5]] = np.inf
    curve, *bands = plotting.value(solution)
    np.testing.assert_array_equal(np.ma.getmaskarray(curve.get_ydata()), np.isinf(solution.value))
    extents = [(band.get_x(), band.get_x() + band.get_width()) for band in bands]
    assert extents == [(-2.25, -1.25), (0.25, 0.75)]
    assert labels(curve.axes) == ["V = ∞"]


def test_a_value_without_one_finite_node_is_all_hatched():
    grid = plane().grid
    for entry in (np.inf, np.nan):
        artists = plotting.value(made(grid, lambda x, entry=entry: np.full(x.shape[:-1], entry)))
        assert hatched_nodes(artists, grid).all()
        assert saved(artists)


def test_a_slice_on_a_node_is_that_node_and_between_nodes_the_mean():
    solution = volume()
    np.testing.assert_array_equal(drawn(plotting.value(solution, fixed={"c": 1.2})[0]), solution.value[:, :, 2])
    np.testing.assert_array_equal(drawn(plotting.value(solution, fixed={2: 1.2})[0]), solution.value[:, :, 2])
    between = drawn(plotting.value(solution, fixed={"b": 1.0})[0])
    np.testing.assert_allclose(between, (solution.value[:, 1] + solution.value[:, 2]) / 2, rtol=1e-14)
    artists = plotting.value(solution, fixed={"a": 0.1, "c": 0.6})
    expected = [float(solution.value_at([0.1, b, 0.6])) for b in solution.grid.axis(1)]
    np.testing.assert_allclose(artists[0].get_ydata(), expected, rtol=1e-12)
    assert (artists[0].axes.get_xlabel(), artists[0].axes.get_title(loc="right")) == ("b", "a = 0.1, c = 0.6")


def test_a_slice_of_a_stretched_axis_is_where_value_at_is():
    """Cells are not of one width there: the field x₁ + x₂² cut at x₁ = ½ is ½ + x₂²."""
    grid = Grid([-1.0, -1.0], [1.0, 1.0], (21, 9), stretch=(Sinh(3.0, 0.0), None))
    solution = made(grid, lambda x: x[..., 0] + x[..., 1] ** 2)
    for place in (0.5, -0.83, -1.0, 1.0, 0.0):
        curve, *_ = plotting.value(solution, fixed={0: place})
        np.testing.assert_allclose(curve.get_ydata(), place + np.linspace(-1, 1, 9) ** 2, atol=1e-12)
        np.testing.assert_allclose(curve.get_ydata()[3], solution.value_at([place, -0.25]), atol=1e-12)


def test_bands_on_a_stretched_axis_end_half_way_to_the_next_node():
    grid = Grid([-1.0], [1.0], (9,), stretch=(Sinh(3.0, 0.0),))
    value = np.zeros(9)
    value[[1, 2, 8]] = np.inf
    _, *bands = plotting.value(made(grid, lambda x: value))
    x = grid.nodes()[:, 0]
    found = [(band.get_x(), band.get_x() + band.get_width()) for band in bands]
    wanted = [((x[0] + x[1]) / 2, (x[2] + x[3]) / 2), ((x[7] + x[8]) / 2, x[8] + (x[8] - x[7]) / 2)]
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_over_one_axis_a_target_is_called_one_and_not_a_place_without_a_control():
    problem = Problem(lambda x, u: u, lambda x, u: 1.0, Box([-1.0], [1.0]), target=lambda x: jnp.abs(x[0]) - 0.1)
    for asked, said in ((problem, "target"), (None, "no control")):
        solution = made(line().grid, lambda x: x[..., 0] ** 2, lambda x: np.where(x == 0, np.nan, -x), problem=asked)
        assert labels(plotting.policy(solution).ax) == [said]


def test_a_target_of_one_node_is_an_outlined_band_over_one_axis():
    """Of 201 nodes a cell is narrower than a hatch, so only its outline is visible."""
    problem = Problem(lambda x, u: u, lambda x, u: 1.0, Box([-1.0], [1.0]), target=lambda x: jnp.abs(x[0]) - 1e-9)
    solution = made(
        line(201).grid, lambda x: x[..., 0] ** 2, lambda x: np.where(np.isclose(x, 0), np.nan, -x), problem=problem
    )
    _, band = plotting.policy(solution)
    assert band.get_x() < 0 < band.get_x() + band.get_width() < 0.02
    assert band.get_linewidth() >= 1
    assert band.get_edgecolor()[3] == 1
    (swatch,) = band.axes.get_legend().get_patches()
    assert swatch.get_linewidth() > 0


def test_enumerated_controls_are_cut_at_the_nearest_node():
    grid = volume().grid
    solution = made(grid, lambda x: x[..., 0], lambda x: np.sign(x[..., 2:] - 1.5), discrete=True)
    mesh = plotting.policy(solution, fixed={"c": 1.6})[0]  # nodes at 1.2 and 1.8
    assert set(np.unique(drawn(mesh))) == {1.0}


def test_a_slice_next_to_infinity():
    """On a node its infinite neighbours have no weight; between nodes an infinite one makes the mean infinite."""
    solution = volume()
    solution.value[:, :, 3] = np.inf
    flat = Grid([0.0, 0.0], [1.0, 2.0], (5, 4))
    assert not hatched_nodes(plotting.value(solution, fixed={"c": 1.2}), flat).any()
    assert hatched_nodes(plotting.value(solution, fixed={"c": 1.3}), flat).all()


def test_a_slice_across_the_seam_uses_both_its_sides():
    solution = volume(periodic=(False, False, True))  # nodes at 0, .5, ..., 2.5 of the period 3
    seam = drawn(plotting.value(solution, fixed={"c": 2.75})[0])
    np.testing.assert_allclose(seam, (solution.value[:, :, 5] + solution.value[:, :, 0]) / 2)
    again = drawn(plotting.value(solution, fixed={"c": -0.25})[0])
    np.testing.assert_allclose(again, seam)


def test_a_picture_of_more_than_two_axes_is_refused():
    grid = Grid([0.0] * 5, [1.0] * 5, (2,) * 5)
    solution = made(grid, lambda x: x.sum(-1))
    for draw in (plotting.value, plotting.policy, plotting.switching_curve):
        with pytest.raises(ValueError, match="choose two axes and fix the other three"):
            draw(solution)
        with pytest.raises(ValueError, match="3 are free"):
            draw(solution, fixed={"x1": 0.0, "x2": 0.0})
    assert drawn(plotting.value(solution, fixed={"x1": 0.0, "x3": 1.0, 4: 0.0})[0]).shape == (2, 2)
    with pytest.raises(ValueError, match="choose two axes and fix the other one"):
        plotting.value(volume())


@pytest.mark.parametrize(
    ("fixed", "message"),
    [
        ({"velocty": 0.0}, r"axis 'velocty', wanted one of position, velocity or 0 to 1; did you mean 'velocity'"),
        ({2: 0.0}, "wanted one of position"),
        ({True: 0.0}, "wanted one of position"),
        ({"velocity": 2.5}, r"velocity = 2.5, which is outside the grid, \[-2, 2\]"),
        ({"velocity": np.nan}, "outside the grid"),
        ({"velocity": [0.0, 1.0]}, "wanted one coordinate"),
        ({"velocity": "0"}, "wanted one coordinate"),
        ({"velocity": 0.0, 1: 0.0}, "twice"),
        ({0: 0.0, 1: 0.0}, "every axis is fixed"),
    ],
)
def test_slices_that_make_no_sense_are_refused(fixed, message):
    with pytest.raises(ValueError, match=message):
        plotting.value(plane(), fixed=fixed)


def test_a_periodic_axis_is_closed_at_its_seam():
    solution = plane(shape=(8, 5), periodic=(True, False))
    for mesh, field in (
        (plotting.value(solution)[0], solution.value),
        (plotting.policy(solution)[0], solution.policy[..., 0]),
    ):
        array = drawn(mesh)
        assert array.shape == (9, 5)
        np.testing.assert_array_equal(array[:-1], field)
        np.testing.assert_array_equal(array[-1], field[0])
        assert mesh.axes.get_xlim() == (-1.0, 1.0)
    circle = made(Grid([0.0], [2.0], (4,), periodic=(True,)), lambda x: np.cos(np.pi * x[..., 0]))
    curve = plotting.value(circle)[0]
    assert curve.get_xdata()[-1] == 2.0
    assert curve.get_ydata()[-1] == circle.value[0]


def test_the_switching_curve_lies_where_the_control_changes_sign():
    grid = Grid([-1.0, -1.0], [1.0, 1.0], (41, 41))
    smooth = made(grid, lambda x: x[..., 0], lambda x: x[..., :1] + 2 * x[..., 1:])
    vertices = plotting.switching_curve(smooth)[0].get_paths()[0].vertices
    assert np.ptp(vertices[:, 1]) > 0.9
    np.testing.assert_allclose(vertices[:, 0], -2 * vertices[:, 1], atol=1e-12)
    jump = made(grid, lambda x: x[..., 0], lambda x: np.where(x[..., :1] + x[..., 1:] ** 3 > 0.01, 1.0, -1.0))
    vertices = plotting.switching_curve(jump)[0].get_paths()[0].vertices
    distance = np.abs(vertices[:, 0] + vertices[:, 1] ** 3 - 0.01)
    assert len(vertices) > 40
    assert distance.max() < 2 * 0.05  # in x1 the curve moves at most 3 per unit of x2; cells are .05 wide


@pytest.mark.parametrize("slope", [0.3, 1.0, 2.3])
def test_the_switching_curve_of_a_feedback_that_jumps_is_no_staircase(slope):
    grid = Grid([-1.0, -1.0], [1.0, 1.0], (41, 41))
    jump = made(grid, lambda x: x[..., 0], lambda x: np.where(x[..., 1:] > slope * x[..., :1] + 0.013, 1.0, -1.0))
    curve = plotting.switching_curve(jump)[0].get_paths()[0].vertices
    inner = curve[np.abs(curve).max(axis=1) < 0.8]
    off = (inner[:, 1] - slope * inner[:, 0] - 0.013) / np.hypot(1, slope)
    assert np.abs(off).max() < 0.025  # half a cell
    length = np.linalg.norm(np.diff(inner, axis=0), axis=1).sum()
    assert length < 1.005 * np.linalg.norm(inner[-1] - inner[0])  # a staircase is longer than the line


def test_no_control_is_drawn_where_the_state_stops():
    grid = Grid([-2.0], [2.0], (41,))
    x = grid.axis(0)
    policy = np.where(x < -1.9, 50.0, x)[:, None]  # any number in the stopping set
    solution = Solution(grid, np.maximum(np.abs(x) - 1, 0.0) ** 2, policy, stopping=np.abs(x) >= 1)
    picture = plotting.policy(solution)
    drawn = np.ma.masked_invalid(picture[0].get_ydata()).compressed()
    np.testing.assert_allclose(drawn, x[np.abs(x) < 1])
    assert picture.ax.get_ylim()[1] < 2
    plane = Grid([-2.0, -1.0], [2.0, 1.0], (41, 11))
    both = np.broadcast_to(policy[:, None], (*plane.shape, 1))
    stopping = np.abs(plane.nodes()[..., 0]) >= 1
    solution = Solution(plane, np.where(stopping, 0.0, 1.0), both, stopping=stopping)
    assert np.abs(plotting.policy(solution)[0].get_clim()).max() < 1


def test_switching_points_over_one_axis():
    assert [line.get_xdata()[0] for line in plotting.switching_curve(line(), label=None)] == [0.0]  # a node
    shifted = made(line().grid, lambda x: x[..., 0], lambda x: 0.2 - x)
    found = plotting.switching_curve(shifted, label=None)
    assert [line.get_xdata()[0] for line in found] == pytest.approx([0.2])
    rest = made(line().grid, lambda x: x[..., 0], lambda x: np.where(abs(x) < 0.6, 0.0, 5 * x - abs(x)))
    assert [line.get_xdata()[0] for line in plotting.switching_curve(rest, label=None)] == [0.0]  # zero at three nodes
    touching = made(line().grid, lambda x: x[..., 0], lambda x: (x - 1.0) ** 2 * (x + 1.0))
    found = plotting.switching_curve(touching, label=None)
    assert [line.get_xdata()[0] for line in found] == [-1.0]  # zero at +1 without a change of sign


def test_no_switching_curve_across_masked_nodes():
    solution = line()
    solution.value[4] = np.inf  # the node at 0, where the sign changes
    assert plotting.switching_curve(solution, label=None) == []


def test_a_control_that_keeps_its_sign_has_no_switching_curve():
    solution = made(plane().grid, lambda x: x[..., 0], lambda x: 2.0 + x[..., :1])
    with pytest.raises(ValueError, match="u stays between 1 and 3"):
        plotting.switching_curve(solution)


def test_a_path_in_the_plane():
    path = path_of(np.cumsum(np.ones((6, 3)), 0) * [1, 2, 3])
    curve, start, end = plotting.trajectory(path, axes=(2, 0))
    np.testing.assert_array_equal(curve.get_xydata(), path.states[:, [2, 0]])
    np.testing.assert_array_equal(start.get_xydata()[0], path.states[0, [2, 0]])
    np.testing.assert_array_equal(end.get_xydata()[0], path.states[-1, [2, 0]])
    assert (curve.axes.get_xlabel(), curve.axes.get_ylabel()) == ("x3", "x1")
    curve = plotting.trajectory(path, names=("a", "b", "c"), label="run")[0]
    assert (curve.axes.get_xlabel(), curve.axes.get_ylabel(), labels(curve.axes)) == ("a", "b", ["run"])
    with pytest.raises(ValueError, match="the path has 3 states, wanted two of 0 to 2"):
        plotting.trajectory(path, axes=(0, 3))


def test_a_path_over_time():
    path = path_of(np.arange(8.0).reshape(4, 2))
    *curves, legend = plotting.trajectory(path, axes=None, grid=plane().grid)
    for i, curve in enumerate(curves):
        np.testing.assert_array_equal(curve.get_xdata(), path.times)
        np.testing.assert_array_equal(curve.get_ydata(), path.states[:, i])
    assert [text.get_text() for text in legend.get_texts()] == ["position", "velocity"]
    single = plotting.trajectory(path_of([[1.0], [0.5]]))
    assert (len(single), single[0].axes.get_xlabel(), single[0].axes.get_ylabel()) == (1, "t", "x1")


@pytest.mark.parametrize("unwound", [True, False])
def test_a_path_is_cut_at_the_seam(unwound):
    """Over the top and round again: the line reaches both edges, and no stroke crosses the picture."""
    grid = Grid([-np.pi, -8.0], [np.pi, 8.0], (8, 8), periodic=(True, False))
    angle = np.linspace(2.0, 2.0 + 3 * np.pi, 38)
    rate = np.linspace(5.0, 1.0, 38)
    shown = angle if unwound else (angle + np.pi) % (2 * np.pi) - np.pi
    curve, _, end = plotting.trajectory(path_of(np.stack([shown, rate], 1)), grid=grid)
    x, y = curve.get_xydata().T
    gaps = np.flatnonzero(np.isnan(x))
    assert len(gaps) == 2
    np.testing.assert_allclose(x[gaps - 1], np.pi)
    np.testing.assert_allclose(x[gaps + 1], -np.pi)
    np.testing.assert_allclose(y[gaps - 1], y[gaps + 1])
    np.testing.assert_allclose(y[gaps[0] - 1], np.interp(np.pi, angle, rate))
    pieces = np.split(x, gaps)
    assert max(np.abs(np.diff(piece[np.isfinite(piece)])).max() for piece in pieces) < 0.3
    assert np.nanmax(np.abs(x)) <= np.pi + 1e-12
    np.testing.assert_allclose(end.get_xdata(), [(angle[-1] + np.pi) % (2 * np.pi) - np.pi])
    over_time = plotting.trajectory(path_of(np.stack([shown, rate], 1)), axes=None, grid=grid)[0]
    np.testing.assert_allclose(over_time.get_ydata(), angle)


def test_a_path_on_a_torus_and_one_along_the_seam():
    grid = Grid([0.0, 0.0], [1.0, 1.0], (4, 4), periodic=(True, True))
    curve = plotting.trajectory(path_of([[0.8, 0.9], [1.2, 1.1]]), grid=grid)[0]
    nan = np.nan
    wanted = [[0.8, 0.9], [1, 1], [nan, nan], [0, 0], [0.2, 0.1]]
    np.testing.assert_allclose(curve.get_xydata(), wanted, atol=1e-12)
    curve = plotting.trajectory(path_of([[0.75, 0.5], [1.0, 0.5], [1.25, 0.5]]), grid=grid)[0]
    wanted = [[0.75, 0.5], [1, 0.5], [nan, nan], [0, 0.5], [0.25, 0.5]]
    np.testing.assert_allclose(curve.get_xydata(), wanted, atol=1e-12)


@pytest.mark.parametrize(("held", "style", "last"), [(True, "steps-post", 0.5), (False, "default", np.nan)])
def test_controls_are_steps_where_they_were_held_and_lines_elsewhere(held, style, last):
    """A line ends with the last control that is known: going on level it would bend where the feedback does not."""
    path = path_of(np.zeros((4, 1)), [[1.0], [-1.0], [0.5]], np.array([0.0, 1.0, 3.0, 4.0]))
    path.held = held
    (line,) = plotting.controls(path)
    np.testing.assert_array_equal(line.get_xdata(), path.times)
    np.testing.assert_array_equal(line.get_ydata(), [1.0, -1.0, 0.5, last])
    assert line.get_drawstyle() == style
    assert line.axes.get_ylabel() == "u"


def test_a_control_that_jumps_to_and_fro_is_pale_and_its_mean_is_drawn():
    times = np.linspace(0.0, 4.0, 401)
    flicker = np.where(np.arange(400) % 4 == 0, 1.0, -1.0)  # of which the mean is −½
    flicker[:100] = 1.0
    raw, mean, legend = plotting.controls(path_of(np.zeros((401, 1)), flicker[:, None], times))
    assert raw.get_alpha() < 0.6
    drawn = mean.get_ydata()
    np.testing.assert_allclose(drawn[:90], 1.0, atol=1e-12)
    np.testing.assert_allclose(drawn[110:], -0.5, atol=1e-9)  # the window holds four whole turns
    assert [text.get_text() for text in legend.get_texts()] == ["u", "u, mean over 0.16"]


def test_inputs_have_a_legend():
    *_, legend = plotting.controls(path_of(np.zeros((2, 1)), [[1.0, 2.0]]))
    assert [text.get_text() for text in legend.get_texts()] == ["u1", "u2"]


@pytest.mark.parametrize("solution", [line(), plane(), volume()], ids=["1-D", "2-D", "3-D"])
def test_the_closed_loop_in_one_figure(solution):
    n = solution.grid.ndim
    states = np.linspace(np.full(n, 0.6), np.full(n, 0.1), 7)
    artists = plotting.closed_loop(solution, path_of(states))
    figure = artists[0].get_figure()
    assert saved(artists)
    titles = [ax.get_title(loc="right") for ax in figure.axes]
    assert ("c = 0.6" in titles) == (n == 3)
    assert len([ax for ax in figure.axes if ax.get_xlabel() == "t"]) == 1


@pytest.mark.parametrize("count", [0, 1])
def test_the_closed_loop_of_a_path_that_ends_at_once_or_has_no_control(count):
    states = np.full((1 + count, 2), 0.5)
    assert saved(plotting.closed_loop(plane(), path_of(states, np.zeros((count, 1 - count)))))


def test_residuals_on_a_logarithmic_scale():
    history = np.array([1.0, 0.1, 0.0, np.nan, np.inf, 1e-3])
    curve, band = plotting.residuals(SimpleNamespace(residuals=history))
    np.testing.assert_array_equal(curve.get_xdata(), np.arange(1, 7))
    np.testing.assert_array_equal(np.ma.getmaskarray(curve.get_ydata()), [False, False, True, True, True, False])
    np.testing.assert_array_equal(curve.get_ydata().compressed(), [1.0, 0.1, 1e-3])
    assert (band.get_x(), band.get_width()) == (3.5, 2.0)
    ax = curve.axes
    assert (ax.get_yscale(), ax.get_xlabel(), ax.get_ylabel(), labels(ax)) == (
        "log",
        "step",
        "residual",
        ["not finite"],
    )
    assert saved([curve])
    plotting.residuals(SimpleNamespace(residuals=np.array([1.0, 0.5])), ax=ax, label="other")
    assert labels(ax) == ["not finite", "other"]


def test_without_a_history_there_are_no_residuals():
    with pytest.raises(ValueError, match="has no history"):
        plotting.residuals(line())


def test_a_marched_solution_is_drawn_at_one_of_its_times():
    grid = line().grid
    value = np.arange(3.0)[:, None] * grid.axis(0)
    solution = Solution(grid, value, value[..., None], times=np.array([0.5, 0.25, 0.0]))
    np.testing.assert_array_equal(plotting.value(solution)[0].get_ydata(), value[2])
    artists = plotting.value(solution, time=0.3)
    np.testing.assert_array_equal(artists[0].get_ydata(), value[1])
    assert artists[0].axes.get_title(loc="right") == "t = 0.25"
    np.testing.assert_array_equal(plotting.policy(solution, time=0.5)[0].get_ydata(), value[0])
    with pytest.raises(ValueError, match="stationary"):
        plotting.value(line(), time=0.0)


def test_a_batch_is_refused():
    solution = line()
    with pytest.raises(ValueError, match="draw one lane at a time"):
        plotting.value(Solution(solution.grid, np.stack([solution.value] * 2), solution.policy))


def test_costates_and_the_slopes_of_the_value_lie_on_each_other():
    grid = Grid([-1.0, -1.0], [1.0, 1.0], (9, 9), names=("place", "speed"))
    solution = Solution(grid, np.sum(grid.nodes() ** 2, axis=-1), None, code=1)
    times = np.linspace(0, 1, 6)
    states = np.stack([0.9 - times, 0.5 - times], axis=-1)
    states[-1] = [3.0, 0.0]  # outside the grid nothing is drawn
    extremal = SimpleNamespace(times=times, states=states, costates=2 * states)
    artists = plotting.costates(extremal, solution=solution)
    own, slopes = artists[:2], artists[2:4]
    assert [line.get_label() for line in artists[:4]] == ["λ, place", "λ, speed", "DV, place", "DV, speed"]
    for line, slope in zip(own, slopes, strict=True):
        np.testing.assert_allclose(slope.get_ydata()[:-1], line.get_ydata()[:-1], atol=1e-12)
        assert np.ma.getmaskarray(slope.get_ydata())[-1]
        assert line.get_color() == slope.get_color()
    alone = plotting.costates(extremal)
    assert [line.get_label() for line in alone[:2]] == ["λ, x1", "λ, x2"]
    assert len(alone) == 3


def test_without_axes_every_picture_has_a_new_figure():
    pyplot.close("all")
    empty = pyplot.figure(figsize=(3.0, 3.0))
    first = on_current_axes.value(plane(), colorbar=False)
    assert first.figure is empty  # which the user made for it
    second = on_current_axes.value(plane(), fixed={"velocity": 0.0})
    assert second.figure is not first.figure
    cube = on_current_axes.zero_level_set(made(volume().grid, lambda x: np.sum(x, axis=-1) - 2.0))
    assert cube.ax.name == "3d"
    path = path_of([[0.5, 1.0], [0.0, 0.0]])
    assert on_current_axes.controls(path).ax.name == "rectilinear"
    assert on_current_axes.trajectory(path, ax=second.ax).figure is second.figure
    with pytest.raises(ValueError, match="got three-dimensional axes for a flat picture; leave out ax"):
        on_current_axes.controls(path, ax=cube.ax)
    pyplot.close("all")


def test_a_time_is_in_seconds_if_a_state_is_per_second():
    grid = Grid([-1.0, -2.0], [1.0, 2.0], (3, 3), units=("m", "m/s"))
    path = path_of([[0.5, 1.0], [0.0, 0.0]])
    assert plotting.trajectory(path, axes=None, grid=grid).ax.get_xlabel() == "t [s]"
    assert plotting.trajectory(path, axes=None).ax.get_xlabel() == "t"
    assert plotting.controls(path, solution=made(grid, lambda x: x[..., 0])).ax.get_xlabel() == "t [s]"


def test_a_picture_saves_itself(tmp_path):
    picture = plotting.value(line())
    picture.save(tmp_path / "value.png")
    assert (tmp_path / "value.png").read_bytes().startswith(b"\x89PNG")
    assert repr(picture) == "Picture of 1 artists"


def full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_picture_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    picture = plotting.value(line())
    for name in ("value.png", "folder.png/value.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"old")
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(FileError, match=r"value\.png: cannot be written: No space left on device"):
            picture.save(tmp_path / "value.png")
    with pytest.raises(FileError, match=r"value\.png: cannot be written: there is no folder .*missing"):
        picture.save(tmp_path / "missing" / "value.png")
    with pytest.raises(FileError, match="cannot be written: it is a folder"):
        picture.save(tmp_path / "folder.png")
    with pytest.raises(ValueError, match="Format 'foo' is not supported"):
        picture.save(tmp_path / "value.foo")
    assert sorted(os.listdir(tmp_path)) == ["folder.png", "value.png"]
    assert (tmp_path / "value.png").read_bytes() == b"old"


def test_the_format_of_a_picture(tmp_path):
    picture = plotting.value(line())
    picture.save(os.fspath(tmp_path / "value"))  # with matplotlib's default
    picture.save(tmp_path / "plain.txt", format="svg")
    assert (tmp_path / "value.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "plain.txt").read_bytes()


def test_units_are_on_the_axes_and_the_colour_scale():
    grid = Grid([-np.pi, -2.0], [np.pi, 2.0], (8, 9), periodic=(True, False), names=("a", "b"), units=("rad", "rad/s"))
    labelled = Labels(("torque",), ("N m",))
    solution = made(grid, lambda x: x[..., 1] ** 2, lambda x: x[..., 1:], labels=labelled)
    mesh = plotting.policy(solution)[0]
    assert (mesh.axes.get_xlabel(), mesh.axes.get_ylabel(), scale_label(mesh)) == (
        "a [rad]",
        "b [rad/s]",
        "torque [N m]",
    )
    mesh.axes.figure.draw_without_rendering()
    shown = [tick.get_text() for tick in mesh.axes.get_xticklabels() if abs(tick.get_position()[0]) < 3.2]
    assert shown == ["−π", "−π/2", "0", "π/2", "π"]
    assert mesh.axes.xaxis.get_offset_text().get_text() == ""
    steps = plotting.controls(path_of(np.zeros((2, 1)), [[1.0]]), solution=solution)[0]
    assert steps.axes.get_ylabel() == "torque [N m]"


def test_large_numbers_have_no_offset():
    grid = Grid([1e6], [1e6 + 4], (5,))
    curve = plotting.value(made(grid, lambda x: 1e9 + x[..., 0]))[0]
    curve.axes.figure.draw_without_rendering()
    for axis in (curve.axes.xaxis, curve.axes.yaxis):
        assert axis.get_offset_text().get_text() == ""
        texts = [text.get_text() for text in axis.get_ticklabels()]
        assert len(set(texts)) == len(texts)


@pytest.mark.parametrize(
    ("units", "aspect"), [(("m", "m"), 1.0), (("m", "m/s"), "auto"), ((), "auto"), (("s", "s"), "auto")]
)
def test_positions_have_one_scale_on_both_axes(units, aspect):
    grid = Grid([0.0, 0.0], [1.0, 3.0], (4, 5), units=units)
    assert plotting.value(made(grid, lambda x: x[..., 0])).ax.get_aspect() == aspect


def test_a_target_is_outlined_finer_than_the_nodes():
    grid = Grid([-1.0, -1.0], [1.0, 1.0], (9, 9), units=("m", "m"))
    problem = Problem(lambda x, u: u, lambda x, u: 1.0, Ball(1.0, 2), target=lambda x: jnp.hypot(x[0], x[1]) - 0.6)
    solution = made(grid, lambda x: np.hypot(x[..., 0], x[..., 1]) - 0.6, lambda x: -x, problem=problem)
    for picture in (plotting.value(solution), plotting.policy(solution)):
        (outline,) = [each for each in picture if each.get_zorder() == 2.5]
        points = np.concatenate([path.vertices for path in outline.get_paths()])
        np.testing.assert_allclose(np.linalg.norm(points, axis=-1), 0.6, atol=1e-4)
        np.testing.assert_array_equal(hatched_nodes(picture, grid), solution.value < 0)
        assert labels(picture.ax) == ["target"]


def test_a_feedback_that_jumps_is_drawn_as_cells_and_a_smooth_one_is_not():
    jump = made(plane().grid, lambda x: x[..., 0], lambda x: np.where(x[..., :1] > 0.1, 1.0, -1.0))
    assert plotting.policy(jump)[0]._shading == "flat"
    assert plotting.policy(plane())[0]._shading == "gouraud"


def test_an_input_of_one_sign_has_half_of_the_colours():
    solution = made(plane().grid, lambda x: x[..., 0], lambda x: x[..., :1] + 1.0)
    assert plotting.policy(solution)[0].get_clim() == (0.0, 2.0)
    solution = made(plane().grid, lambda x: x[..., 0], lambda x: x[..., :1] - 1.0)
    assert plotting.policy(solution)[0].get_clim() == (-2.0, 0.0)


def test_rounding_about_zero_is_drawn_as_zero_where_the_range_of_the_control_is_known():
    grid = Grid([-1.0], [1.0], (11,))
    problem = Problem(lambda x, u: u, lambda x, u: 1.0, Box([-3.0], [3.0]))
    solution = made(grid, lambda x: x[..., 0], lambda x: 1e-9 * np.sin(40 * x), problem=problem)
    assert plotting.policy(solution).ax.get_ylim() == pytest.approx((-3.0, 3.0), abs=1e-6)


def test_pictures_ask_of_a_study_what_it_has():
    """By the names of fields and properties: a study takes solves, and its picture is a slow test."""
    from hjbjax.applications.convergence import Study
    from hjbjax.applications.perturbations import Perturbation
    from hjbjax.plotting.style import DRAWN

    for name, kind in (("convergence.study", Study), ("perturbation.study", Perturbation)):
        attributes, _ = DRAWN[name]
        assert {*attributes} <= {*kind.__dataclass_fields__, *dir(kind)}
    with pytest.raises(TypeError, match=r"perturbation: got study = 3, wanted the result of perturbation_study"):
        plotting.perturbation(3)


@pytest.mark.parametrize("draw", ["value", "policy"])
def test_the_stopping_set_is_dotted_up_to_the_free_boundary(draw):
    """V − ψ = (|x| − 1)² outside of the unit ball, ψ = x₁: over one axis bands, over two an area with its outline."""

    def priced(x):
        return x[..., 0] + np.maximum(np.linalg.norm(x, axis=-1) - 1, 0) ** 2

    def inside(grid):
        return np.linalg.norm(grid.nodes(), axis=-1) <= 1

    grid = Grid([-2.0], [2.0], (42,))
    solution = made(grid, priced, stopping=inside(grid))
    picture = getattr(plotting, draw)(solution)
    (band,) = [artist for artist in picture if artist.get_label() == "stop"]
    left, right = band.get_x(), band.get_x() + band.get_width()
    np.testing.assert_allclose([left, right], solution.free_boundary())
    np.testing.assert_allclose([left, right], [-1, 1], atol=0.05)
    assert "stop" in labels(picture.ax)
    saved(picture)
    grid = Grid([-2.0, -2.0], [2.0, 2.0], (41, 42))
    solution = made(grid, priced, stopping=inside(grid))
    picture = getattr(plotting, draw)(solution)
    np.testing.assert_array_equal(hatched_nodes(picture, grid), solution.stopping)
    assert labels(picture.ax) == ["stop"]
    saved(picture)
    nowhere = made(grid, priced, stopping=np.zeros(grid.shape, bool))
    assert labels(getattr(plotting, draw)(nowhere).ax) == []


def test_a_cut_and_a_march_show_their_own_stopping_set():
    grid = Grid([-2.0] * 3, [2.0] * 3, (9, 10, 11))
    radius = np.linalg.norm(grid.nodes(), axis=-1)
    solution = made(grid, lambda x: radius, stopping=radius <= 1.2)
    picture = plotting.value(solution, fixed={2: 0.8})
    plane = Grid([-2.0] * 2, [2.0] * 2, (9, 10))
    np.testing.assert_array_equal(hatched_nodes(picture, plane), (radius <= 1.2)[:, :, 7])
    line = Grid([-2.0], [2.0], (41,))
    x = line.axis(0)
    value = np.stack([np.maximum(abs(x) - end, 0) ** 2 for end in (0.5, 1.0)])
    marched = Solution(line, value, np.zeros((2, 41, 0)), times=np.array([0.0, 1.0]), stopping=value == 0)
    for time, end in ((0.0, 0.5), (1.0, 1.0)):
        (band,) = [artist for artist in plotting.value(marched, time=time) if artist.get_label() == "stop"]
        assert band.get_x() + band.get_width() == pytest.approx(end, abs=0.01)


def test_a_tube_has_no_stopping_set_in_its_picture():
    grid = Grid([-2.0], [2.0], (41,))
    problem = Problem(lambda x, u: u, controls=Box([-1.0], [1.0]), stopping_cost=lambda x: jnp.abs(x[0]))
    solution = made(grid, lambda x: x[..., 0] ** 2, stopping=np.ones(41, bool), problem=problem)
    assert labels(plotting.value(solution).ax) == []


class InModes(SimpleNamespace):
    """Solutions of two modes over one state, in place of one solution with modes."""

    def in_mode(self, number):
        return self.parts[number]


def two_modes(pushed=True):
    grid = Grid([0.0], [1.0], (11,), names=("cash",))
    x = grid.nodes()[:, 0]
    pushes = (Push([-1.0], reward=0.9), Push([1.0], cost=1.1))
    problem = Problem(lambda x, u: u, lambda x, u: 1.0, Box([-1.0], [1.0]), discount=1.0, pushes=pushes)
    masks = ([x > 0.7, x < -1.0], [x > 0.7, x < 0.2])
    parts = [
        Solution(
            grid, x + i, x[:, None], **({"pushing": np.stack(mask, axis=-1), "problem": problem} if pushed else {})
        )
        for i, mask in enumerate(masks)
    ]
    whole = SimpleNamespace(modes=("rich", "poor"), ndim=2, shape=(2, 11), periodic=(False, False))
    return InModes(grid=whole, value=np.zeros((2, 11)), parts=parts)


def test_sets_of_two_modes_have_names_and_colours_of_their_own():
    picture = plotting.value(two_modes())
    handles, names = picture.ax.get_legend_handles_labels()
    assert set(names) == {"rich", "poor", "push cash down, rich", "push cash down, poor", "push cash up, poor"}
    look = dict(zip(names, handles, strict=True))
    for mode in ("rich", "poor"):
        colour = look[mode].get_color()
        assert to_hex(look[f"push cash down, {mode}"].get_edgecolor()) == colour
        assert look[f"push cash down, {mode}"].get_edgecolor()[3] < 0.5  # otherwise it hides the line of its colour
    assert look["rich"].get_color() != look["poor"].get_color()
    assert look["rich"].get_linestyle() != look["poor"].get_linestyle()
    assert len({look[name].get_hatch() for name in names if "push" in name}) == 3
    band = look["push cash down, poor"]
    assert (band.get_x(), band.get_x() + band.get_width()) == pytest.approx((0.75, 1.0), abs=0.051)
    assert saved(picture)


def test_a_push_from_a_file_has_no_direction():
    grid = line().grid
    pushing = grid.nodes() > 1
    assert labels(plotting.value(Solution(grid, grid.nodes()[:, 0], -grid.nodes(), pushing=pushing)).ax) == ["push"]


@pytest.mark.parametrize("ends", [(-0.92, 0.42), (0.0, 1.0), (-1.02, 0.02), (0.0451, 0.0449), (3.0, 61.0)])
@pytest.mark.parametrize("inches", [0.7, 1.2, 4.0])
def test_an_axis_has_three_ticks_or_more(ends, inches):
    figure = Figure(figsize=(5, inches))
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_ylim(*sorted(ends))
    set_ticks(ax.yaxis, False)
    ticks = ax.yaxis.get_major_locator()()
    assert np.count_nonzero((ticks >= min(ends)) & (ticks <= max(ends))) >= 3


def test_a_target_as_thin_as_a_face_of_the_box_is_not_in_the_legend():
    grid = Grid([0.0, 0.0], [1.0, 1.0], (11, 11))
    solution = made(grid, lambda x: x[..., 0])
    for width, shown in ((1e-4, False), (0.1, True)):
        ax = plotting.value(solution, target=lambda x, width=width: x[1] - width).ax
        assert (labels(ax) == ["target"]) == shown


def test_a_target_of_a_few_nodes_is_marked_at_these_nodes():
    grid = Grid([-1.0, -1.0], [1.0, 1.0], (201, 201))
    solution = made(grid, lambda x: np.linalg.norm(x, axis=-1))
    three = [(0.5, -0.01), (0.5, 0.0), (0.5, 0.01)]
    for target, nodes in (
        (lambda x: jnp.sum(x**2) - 1e-9, [(0.0, 0.0)]),
        (lambda x: jnp.maximum(jnp.abs(x[0] - 0.5) - 1e-6, jnp.abs(x[1]) - 0.015), three),
    ):
        picture = plotting.value(solution, target=target)
        assert labels(picture.ax) == ["target"]
        (marks,) = picture.ax.get_lines()
        np.testing.assert_allclose(marks.get_xydata(), nodes, atol=1e-12)
        assert marks.get_linestyle() == "None"
        assert marks.get_markersize() >= 3
        assert saved(picture)
    wide = plotting.value(solution, target=lambda x: jnp.sum(x**2) - 0.01)
    assert not wide.ax.get_lines()


def test_where_the_ends_of_the_box_decide_the_value_is_crossed_out():
    grid = Grid([-1.0, -1.0], [1.0, 1.0], (21, 21))
    x = grid.nodes()[..., 0]
    error = np.where(x > 0.65, 0.05, 0.001)  # of a range of 2
    solution = made(grid, lambda x: x[..., 0], lambda x: -x[..., :1], box_error=error)
    for draw in (plotting.value, plotting.policy):
        picture = draw(solution)
        assert labels(picture.ax) == ["depends on the box"]
        np.testing.assert_array_equal(hatched_nodes(picture, grid), x > 0.65)
    assert labels(plotting.value(made(grid, lambda x: x[..., 0], box_error=error / 100)).ax) == []


def test_a_switching_curve_along_nodes_where_both_signs_are_equally_good():
    """V = x₂² with the feedback −sign(x₂), which is arbitrary on x₂ = 0; on a circle it also switches at the seam."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (41, 1))
    for periodic, top in ((False, 1.0), (True, np.pi)):
        grid = Grid([-1.0, -top], [1.0, top], (41, 40 + (not periodic)), periodic=(False, periodic))

        def feedback(x, top=top):
            free = np.isclose(x[..., 1], 0) | np.isclose(x[..., 1], -top)
            inside = np.where(free, signs, -np.sign(x[..., 1]))[..., None]
            return np.where(x[..., 1:] < -top * 0.999, 1.0, inside) if top == 1.0 else inside

        solution = made(grid, lambda x, top=top: 1 - np.cos(x[..., 1] * np.pi / top), feedback)
        contour = plotting.switching_curve(solution, label=None)[0]
        curves = [curve for curve in contour.get_paths()[0].to_polygons(closed_only=False) if len(curve) > 1]
        heights = np.concatenate([curve[:, 1] for curve in curves])
        inner = heights[np.abs(heights) < top / 2]
        np.testing.assert_allclose(inner, 0, atol=1e-6)
        seam = heights[np.abs(heights) >= top / 2]
        np.testing.assert_allclose(np.abs(seam), top, atol=1e-6)
        assert np.unique(np.sign(seam)).tolist() == [-1, 1] * periodic  # it is drawn at both ends


def test_a_switching_curve_is_straight_where_the_control_is_off_by_a_cell():
    """On a fine grid: the feedback switches up to 0.8 cells off x₂ = x₁ / 2, in waves of 12 cells."""
    grid = Grid([-1.0, -1.0], [1.0, 1.0], (201, 201))

    def feedback(x):
        edge = x[..., :1] / 2 + 0.008 * np.sin(2 * np.pi * x[..., :1] / 0.12)
        return np.where(x[..., 1:] > edge, -1.0, 1.0)

    contour = plotting.switching_curve(made(grid, lambda x: x[..., 0], feedback), label=None)[0]
    curve = contour.get_paths()[0].vertices
    inner = curve[np.abs(curve[:, 0]) < 0.95]
    assert len(inner) > 150
    assert np.abs(inner[:, 1] - inner[:, 0] / 2).max() < 0.005  # half a cell


@pytest.mark.parametrize("draw", ["value", "policy"])
@pytest.mark.parametrize("top", [1.0, np.pi])
def test_texts_are_apart_by_the_width_of_a_stroke(draw, top):
    """Both axes and the colour bar have a tick at their ends, where labels are closest."""
    grid = Grid([-1.0, -top], [1.0, top], (41, 40), periodic=(False, True), units=("", "rad" if top > 1 else ""))
    name = Labels(value="V = E[(1 − e⁻ᵝᵀ)/β]")
    solution = made(grid, lambda x: (x[..., 0] + 1) / 2, lambda x: np.sign(x[..., :1] + 0.01), labels=name)
    figure = getattr(plotting, draw)(solution).figure
    figure.set_dpi(100)
    for (one, box), (other, second) in itertools.combinations(texts(figure), 2):
        assert clearance(box, second) > 2, (one, other)


def test_a_path_that_leaves_the_plane_is_called_a_projection():
    solution = volume()
    for last, name in ((0.0, "path"), (1.0, "path, projected")):
        states = np.linspace([0.1, 0.1, 0.0], [0.9, 0.9, last], 5)
        picture = plotting.closed_loop(solution, path_of(states, np.zeros((4, 3))))
        plane = picture.figure.axes[0]
        assert labels(plane) == [name, "start", "end"]


def test_states_of_different_units_have_axes_of_their_own_and_so_has_the_mode():
    grid = Grid([0.0] * 3, [1.0] * 3, (5, 5, 5), names=("x", "y", "angle"), units=("m", "m", "rad"))
    solution = made(grid, lambda x: x[..., 0], lambda x: x[..., :2])
    path = path_of(np.linspace([0.0, 0.1, 0.2], [1.0, 0.9, 0.5], 7), np.zeros((6, 2)))
    picture = plotting.closed_loop(solution, path)
    plane, *panels = [ax for ax in picture.figure.axes if ax.get_label() != "<colorbar>"]
    assert labels(plane) == ["path, projected", "start", "end"]
    assert [ax.get_ylabel() for ax in panels] == ["state", "angle\n[rad]", "control"]
    assert [labels(ax) for ax in panels] == [["x [m]", "y [m]"], [], ["u1", "u2"]]
    assert [ax.get_xlabel() for ax in panels] == ["", "", "t"]
    strokes = [drawn.get_linestyle() for drawn in panels[0].get_lines()]
    assert strokes == ["-", "--"]
    assert saved(picture)


def test_a_picture_of_one_mode_names_it_once():
    solution = two_modes(pushed=False)
    ax = plotting.value(solution, fixed={"mode": 1}).ax
    assert ax.get_title("right") == "mode poor"
    plotting.policy(solution, fixed={"mode": 1}, ax=ax)
    assert ax.get_title("right") == "mode poor"


def test_the_mode_of_a_path_is_drawn_under_its_states():
    solution = two_modes(pushed=False)
    path = path_of([[0.1], [0.5], [0.9]], np.zeros((2, 1)))
    path.modes = np.array([1, 1, 0])
    picture = plotting.closed_loop(solution, path)
    *_, lowest = picture.figure.axes
    assert lowest.get_ylabel() == "mode"
    assert [tick.get_text() for tick in lowest.get_yticklabels()] == ["rich", "poor"]
    assert lowest.get_lines()[0].get_ydata().tolist() == [1, 1, 0]


def test_a_legend_of_long_names_stays_in_the_figure():
    figure = Figure(figsize=(5.4, 4.2), layout="constrained")
    ax = figure.add_subplot()
    for name in ("operating", "push cash down, operating", "issuing", "push cash up, issuing"):
        ax.plot([0, 1], [0, 1], label=name)
    box = legend(ax)
    figure.canvas.draw()
    assert box.get_window_extent().x1 <= figure.bbox.x1


def test_the_edge_of_a_bang_bang_feedback_is_no_staircase():
    """The feedback is −1 inside a circle of radius 1.23, on cells of 0.1; the edge is within half a cell of it."""
    grid = Grid([-2.0, -2.0], [2.0, 2.0], (41, 41))
    solution = made(grid, lambda x: x[..., 0], lambda x: np.where((x**2).sum(-1) < 1.23**2, -1.0, 1.0)[..., None])
    mesh, edge = plotting.policy(solution)
    inner, outer = (path.to_polygons() for path in edge.get_paths())
    assert len(inner) == len(outer) == 2  # rings around the circle
    radius = np.linalg.norm(np.concatenate(inner), axis=-1)
    near = radius[np.abs(radius - 1.23) < 0.1]
    assert near.size > 40
    assert np.abs(near - 1.23).max() < 0.05
    assert [tuple(colour) for colour in edge.get_facecolor()] == [mesh.cmap(0.0), mesh.cmap(1.0)]
    off = made(grid, lambda x: x[..., 0], lambda x: np.sign(np.round(x[..., :1] * 0.9)))  # zero in between
    assert len(plotting.policy(off)) == 1


def test_a_short_axis_of_an_angle_has_few_ticks():
    for inches, count in ((0.9, 3), (4.0, 7)):
        ax = Figure(figsize=(5, inches)).add_axes((0, 0, 1, 1))
        ax.set_ylim(0.5 * np.pi, 2 * np.pi)
        set_ticks(ax.yaxis, True)
        ticks = ax.yaxis.get_major_locator()()
        assert np.count_nonzero((ticks > 0.49 * np.pi) & (ticks < 2.01 * np.pi)) <= count
