"""Pictures of estimates and of densities: what is drawn is what was computed."""

from types import SimpleNamespace

import numpy as np
import pytest
from pictures import pictures as plotting

from hjbjax.problem.grid import Grid
from hjbjax.problem.stretching import Sinh

TIMES = np.array([0.0, 0.5, 1.0, 1.0])  # a path that ended at 1
PATH = SimpleNamespace(
    times=TIMES,
    states=np.array([[0.0, 1.0], [4.0, 2.0], [7.0, 3.0], [7.0, 3.0]]),
    estimates=np.array([[0.1, 0.0], [-2.2, 1.5], [0.8, 3.0], [0.8, 3.0]]),
    measurements=np.array([[1.0], [2.0], [np.nan]]),
)


def test_states_and_estimates_are_drawn_in_pairs():
    artists = plotting.estimates(PATH, names=("a", "b"), measurements=True)
    lines = artists[:5]
    assert [line.get_label() for line in lines] == ["a", "a, estimated", "b", "b, estimated", "dy/dt"]
    np.testing.assert_array_equal(lines[2].get_ydata(), PATH.states[:, 1])
    np.testing.assert_array_equal(lines[3].get_ydata(), PATH.estimates[:, 1])
    np.testing.assert_allclose(lines[4].get_ydata()[:2], [2.0, 4.0])
    assert np.ma.getmaskarray(lines[4].get_ydata())[2]
    assert lines[0].get_color() == lines[1].get_color() != lines[2].get_color()


def test_an_estimate_on_a_circle_is_drawn_beside_the_state():
    grid = Grid([-np.pi, 0.0], [np.pi, 4.0], (8, 5), (True, False), names=("angle", "rate"))
    line, estimate, _ = plotting.estimates(PATH, grid=grid, components=[0])
    assert line.axes.get_ylabel() == "angle"
    np.testing.assert_allclose(estimate.get_ydata(), PATH.estimates[:, 0] + 2 * np.pi * np.array([0, 1, 1, 1]))


def test_a_density_is_integrated_over_the_axes_that_are_not_shown():
    grid = Grid([0.0, -1.0, 0.0], [2.0, 1.0, 1.0], (5, 4, 9), (False, True, False), stretch=(Sinh(2.0), None, None))
    x, z = (np.asarray(grid.axis(i)) for i in (0, 2))
    values = np.multiply.outer(np.multiply.outer(1 + x, np.ones(4) / 2), 2 * z) / 4  # marginals (1 + x)/4, ½, 2z
    line, _, mark = plotting.density(values, grid, axes=[2], state=[0.0, 0.0, 0.25], estimate=[0.0, 0.0, 0.5])
    np.testing.assert_allclose(line.get_ydata(), 2 * z, rtol=1e-12)
    assert mark.get_linestyle() == "--"
    mesh, ring = plotting.density(values, grid, axes=[1, 0], state=[0.5, 2.5, 0.0], colorbar=False)
    # rows of a mesh go upwards: the second axis, closed at its seam
    np.testing.assert_allclose(np.asarray(mesh.get_array()).reshape(5, 5), np.broadcast_to((1 + x) / 8, (5, 5)))
    assert (float(ring.get_xdata()[0]), float(ring.get_ydata()[0])) == (0.5, 0.5)  # 2.5 round a circle of length 2


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        (
            lambda: plotting.estimates(SimpleNamespace(**vars(PATH) | {"states": np.zeros((2, 4, 2))})),
            "wanted one path",
        ),
        (lambda: plotting.estimates(PATH, components=[2]), "the path has states 0 to 1"),
        (lambda: plotting.density(np.zeros(3), Grid([0.0], [1.0], (4,))), "got values of shape"),
        (lambda: plotting.density(np.zeros(4), Grid([0.0], [1.0], (4,)), axes=[1]), "wanted one or two of 0 to 0"),
    ],
)
def test_what_cannot_be_drawn_is_refused(call, reason):
    with pytest.raises(ValueError, match=reason):
        call()
