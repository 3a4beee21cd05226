"""Files and pictures of an enclosure, and the region in which narrow bounds are wanted."""

import jax.numpy as jnp
import numpy as np
import pytest
from forged_headers import header_of, write_header
from pictures import pictures as plotting

import hjbjax as hjb
from hjbjax.solution.placement import FileError

LINE = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-3.0], [3.0]), discount=1.0)
EXACT = (5**0.5 - 1) / 2  # V = EXACT x²


def near(grid, value):
    return hjb.Solution(grid, value(grid.nodes()), None, code=hjb.Status.CONVERGED)


@pytest.fixture(scope="module")
def found():
    grid = hjb.Grid([-1.0], [1.0], (21,), names=("position",), units=("m",), stretch=(hjb.Sinh(2.0, 0.3),))
    return hjb.enclose(LINE, near(grid, lambda x: EXACT * x[..., 0] ** 2), rounds=2)


@pytest.fixture(scope="module")
def plane():
    problem = hjb.Problem(lambda x, u: u, lambda x, u: 2 + u @ u, hjb.Box([-1.0, -1.0], [1.0, 1.0]), discount=1.0)
    grid = hjb.Grid([0.0, 0.0], [1.0, 2.0], (6, 7), (True, False), names=("a", "b"))
    return hjb.enclose(problem, near(grid, lambda x: 2 + 0.01 * x[..., 1]), rounds=1)


def test_an_enclosure_is_read_from_its_file_bit_by_bit(found, plane, tmp_path):
    for each in (found, plane):
        path = tmp_path / f"{each.grid.ndim}.npz"
        each.save(path)
        again = hjb.Enclosure.load(path)
        states = np.random.default_rng(0).uniform(each.grid.lo, each.grid.hi, (200, each.grid.ndim))
        for name in ("lower", "upper", "remaining", "required"):
            np.testing.assert_array_equal(getattr(again, name), getattr(each, name))
        np.testing.assert_array_equal(again.lower_at(states), each.lower_at(states))
        np.testing.assert_array_equal(again.upper_at(states), each.upper_at(states))
        assert repr(again.grid) == repr(each.grid)
        assert (again.status, again.message, again.stats) == (each.status, each.message, each.stats)
    with pytest.raises(FileExistsError):
        found.save(path)
    with pytest.raises(FileError, match="another kind, hjbjax.Solution, wanted hjbjax.Enclosure"):
        hjb.Enclosure.load(_foreign(tmp_path))


@pytest.mark.parametrize("kind", ["found", "tubes"])
def test_every_entry_of_a_header_is_checked(kind, request, tmp_path):
    """A level that was text failed in ``print``, far from the file."""
    made = request.getfixturevalue(kind)
    one, path = made[0] if kind == "tubes" else made, tmp_path / "run.npz"
    one.save(path)
    header, kinds = header_of(path), type(one).KINDS
    assert set(header) == {*kinds, "format", "version", "arrays"}
    for name in kinds:
        for wrong in (True, 7, 0.5, "word", None, [], {}):
            if type(wrong) not in kinds[name]:
                write_header(path, {**header, name: wrong})
                with pytest.raises(FileError, match=f"its header has {name} = "):
                    type(one).load(path)
        write_header(path, {key: each for key, each in header.items() if key != name})
        with pytest.raises(FileError, match=f"its header has no '{name}'"):
            type(one).load(path)
        for part in header["grid"] if name == "grid" else ():
            write_header(path, {**header, "grid": {**header["grid"], part: 7}})
            with pytest.raises(FileError, match="cannot be read: "):
                type(one).load(path)


def _foreign(folder):
    path = folder / "solution.npz"
    near(hjb.Grid([0.0], [1.0], (3,)), lambda x: x[..., 0]).save(path)
    return path


@pytest.fixture(scope="module")
def tubes():
    """A tube with a free boundary, one with an empty inner set, and one to be avoided on a periodic axis."""
    unit, grid = (
        hjb.Box([-1.0], [1.0]),
        hjb.Grid([-2.0], [2.0], (41,), names=("position",), stretch=(hjb.Sinh(2.0, 0.4),)),
    )
    reach = hjb.reach(lambda x, u: u, unit, lambda x: jnp.abs(x[0]) - 0.5)
    moves = lambda x, u: jnp.stack([jnp.cos(x[1]), u[0]])  # noqa: E731
    avoid = hjb.avoid(moves, unit, lambda x: jnp.abs(x[0]) - 0.5)
    torus = hjb.Grid([-2.0, -np.pi], [2.0, np.pi], (17, 12), periodic=(False, True))
    found = [
        (problem, hjb.march(problem, each, 0.5, times=np.linspace(0, 0.5, count)))
        for problem, each, count in ((reach, grid, 11), (avoid, torus, 6))
    ]
    return [hjb.enclose_tube(*found[0]), hjb.enclose_tube(*found[0], level=-3.0), hjb.enclose_tube(*found[1])]


def test_a_tube_is_read_from_its_file_bit_by_bit(tubes, tmp_path):
    for k, each in enumerate(tubes):
        path = tmp_path / f"{k}.npz"
        each.save(path)
        again = hjb.TubeEnclosure.load(path)
        states = np.random.default_rng(0).uniform(each.grid.lo, each.grid.hi, (500, each.grid.ndim))
        for name in ("inner", "outer", "shifts", "thresholds"):
            np.testing.assert_array_equal(getattr(again, name), getattr(each, name))
        np.testing.assert_array_equal(again.inner_at(states), each.inner_at(states))
        np.testing.assert_array_equal(again.outer_at(states), each.outer_at(states))
        assert repr(again) == repr(each)
        assert repr(again.grid) == repr(each.grid)
        for name in ("level", "is_free", "message", "stats", "above"):
            assert getattr(again, name) == getattr(each, name)
    with pytest.raises(FileError, match="another kind, hjbjax.Solution, wanted hjbjax.TubeEnclosure"):
        hjb.TubeEnclosure.load(_foreign(tmp_path))


def test_the_picture_of_a_tube_has_both_sets(tubes):
    inner, outer, _, between = plotting.enclosure(tubes[0])
    np.testing.assert_array_equal(inner.get_ydata(), tubes[0].inner)
    np.testing.assert_array_equal(outer.get_ydata(), tubes[0].outer)
    assert inner.axes.get_xlabel() == "position"
    (x,) = [each[:, 0] for each in (np.concatenate([path.vertices for path in between.get_paths()]),)]
    unproved = tubes[0].outer_at(x[:, None]) & ~tubes[0].inner_at(x[:, None])
    assert np.mean(unproved) > 0.9  # the ends of the areas may be a little outside
    assert len(plotting.enclosure(tubes[1])) == 4
    inner, outer, area = plotting.enclosure(tubes[2])
    for line, function in ((inner, tubes[2].inner_at), (outer, tubes[2].outer_at)):
        points = np.concatenate([path.vertices for path in line.get_paths()])
        near = points[np.abs(points[:, 0]) < 1.9]
        spread = [function(near + side * np.array([0.2, 0.0])) for side in (-1, 1)]
        assert np.all(spread[0] != spread[1])
    assert len(area.get_paths()) > 0


def test_the_largest_required_shift_is_that_of_the_first_candidate(found):
    for required, bound, sign in zip(found.required, found.bounds, (1, -1), strict=True):
        assert -sign * np.max(required) == bound.levels[0].values[0]


def test_the_picture_over_one_axis_has_both_bounds_and_the_width(found):
    lower, upper, _, width, below, above = plotting.enclosure(found)
    np.testing.assert_array_equal(lower.get_ydata(), found.lower)
    np.testing.assert_array_equal(upper.get_ydata(), found.upper)
    np.testing.assert_array_equal(width.get_ydata(), found.width)
    for line, required in zip((below, above), found.required, strict=True):
        np.testing.assert_array_equal(line.get_ydata(), np.maximum(required, 0))
    assert lower.axes.get_xlabel() == "position [m]"
    assert (lower.axes.get_ylabel(), width.axes.get_ylabel()) == ("V", "width")
    assert len(plotting.enclosure(found, ax=lower.axes)) == 3


def test_the_picture_over_two_axes_marks_the_cells_that_widen_the_bounds(plane):
    lower, upper, mesh, *dots = plotting.enclosure(plane, colorbar=False)
    np.testing.assert_array_equal(lower.levels, upper.levels)
    np.testing.assert_array_equal(np.ma.asarray(mesh.get_array()).T[:-1], plane.width)  # closed at the seam
    for marks, required in zip(dots, plane.required, strict=True):
        places = np.column_stack(marks.get_data())
        wanted = plane.grid.nodes()[required >= 0.5 * np.max(required)]
        assert {tuple(each) for each in wanted} <= {tuple(each) for each in places}
    cut = plotting.enclosure(plane, fixed={"b": 1.0})[0]
    np.testing.assert_allclose(cut.get_ydata()[:-1], plane.lower[:, 3])
    with pytest.raises(TypeError, match="the Enclosure of enclose"):
        plotting.enclosure(plane.grid)


def test_corrections_end_once_the_bounds_are_narrow_in_the_region():
    """V bends at the wall at −1, and not in the region."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: (x[0] - 0.9) ** 2 + u @ u, hjb.Box([-2.0], [2.0]), discount=1.0)
    grid = hjb.Grid([-1.0], [1.0], (41,))
    solution = near(grid, lambda x: 0.6 * (x[..., 0] - 0.9) ** 2)
    whole = hjb.enclose(problem, solution, tol=2e-3)
    part = hjb.enclose(problem, solution, region=([-0.5], [0.5]), tol=2e-3)
    inside = np.abs(np.asarray(grid.axis(0))) <= 0.5
    masked = hjb.enclose(problem, solution, region=inside, tol=2e-3)
    np.testing.assert_array_equal(part.lower, masked.lower)
    assert part.stats["corrections"] <= whole.stats["corrections"]
    assert part.status is hjb.Status.CONVERGED
    assert "in the region" in part.message
    assert np.all(part.lower <= whole.upper)
    assert np.all(whole.lower <= part.upper)


@pytest.mark.parametrize(
    ("region", "reason"),
    [(np.ones(4, bool), "wanted a pair of corners"), ([[3.0], [4.0]], "contains no node"), (1.0, "wanted a pair")],
)
def test_a_region_that_is_not_one_is_refused(region, reason):
    solution = near(hjb.Grid([-1.0], [1.0], (9,)), lambda x: x[..., 0] ** 2)
    with pytest.raises(ValueError, match=reason):
        hjb.enclose(LINE, solution, region=region)
