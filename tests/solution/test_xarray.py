"""Solutions as arrays with names, for other tools."""

import io
import os
import subprocess
import sys

import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo

xarray = pytest.importorskip("xarray")


def solved():
    problem, grid = zoo.pendulum(discount=0.5, shape=(12, 13))
    return hjb.solve(problem, grid, throw=False, max_steps=3, scheme=hjb.Upwind())


def test_axes_and_arrays_have_names_and_units():
    solution = solved()
    found = solution.to_xarray()
    assert dict(found.sizes) == {"angle": 12, "velocity": 13}
    assert found["angle"].attrs["units"] == "rad"
    np.testing.assert_array_equal(found["value"], solution.value)
    np.testing.assert_array_equal(found["torque"], solution.policy[..., 0])
    assert found["torque"].attrs == {"units": "N m", "kind": "control"}
    assert found.attrs["status"] == "MAX_STEPS"
    # between the nodes as here, inside of a cell
    at = {"angle": solution.grid.axis(0)[3], "velocity": 0.77}
    linear = found["value"].interp(**at)
    assert float(linear) == pytest.approx(float(solution.value_at(list(at.values()))), rel=1e-12)


@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_a_march_has_a_time_a_game_both_players_and_no_name_is_lost():
    problem = hjb.Problem(
        lambda x, u, d: u + 0.5 * d, lambda x, u, d: x @ x + u @ u - d @ d, hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.0], [1.0]), control_names=("value",),
    )  # fmt: skip
    grid = hjb.Grid([-1.0], [1.0], (9,), names=("time",))
    marched = hjb.march(problem, grid, 0.2, times=[0.0, 0.1, 0.2], scheme=hjb.Upwind(split=True))
    found = marched.to_xarray()
    assert found["value"].dims == ("time", "state time")
    assert set(found.data_vars) == {"value", "box_error", "control value", "d"}
    np.testing.assert_array_equal(found["time"], [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(found["d"], marched.disturbance[..., 0])


def test_a_file_for_other_tools_is_whole_or_not_there(tmp_path, monkeypatch):
    pytest.importorskip("h5netcdf")
    solution, path = solved(), tmp_path / "run.nc"
    solution.to_netcdf(path)
    with xarray.open_dataset(path, engine="h5netcdf") as found:
        np.testing.assert_array_equal(found["value"], solution.value)
        assert found["velocity"].attrs["units"] == "rad/s"
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="force=True"):
        solution.to_netcdf(path)

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(hjb.FileError, match="No space left"):
            solution.to_netcdf(path, force=True)
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["run.nc"]
    solution.to_netcdf(path, force=True)
    assert io.BytesIO(path.read_bytes()).read(4) == b"\x89HDF"


LIMITED = """
import gc, resource, sys
import numpy as np
import hjbjax as hjb
grid = hjb.Grid([0.0], [1.0], (4001,))
solution = hjb.Solution(grid, np.zeros(4001), np.zeros((4001, 1)), code=1)
resource.setrlimit(resource.RLIMIT_FSIZE, (16384, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
try:
    solution.to_netcdf(sys.argv[1])
except hjb.FileError as error:
    print(error)
gc.collect()
"""


@pytest.mark.skipif(os.name != "posix", reason="limits of file sizes are POSIX's")
def test_a_disk_that_is_full_during_the_write_does_not_end_the_process(tmp_path):
    """HDF5 ends it with SIGSEGV if it cannot close a file, in the destructor of the file."""
    pytest.importorskip("h5netcdf")
    command = [sys.executable, "-c", LIMITED, str(tmp_path / "run.nc")]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (process.returncode, process.stderr) == (0, "")
    assert process.stdout == f"{tmp_path / 'run.nc'}: cannot be written: File too large\n"
    assert list(tmp_path.iterdir()) == []


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5netcdf", None)
    with pytest.raises(ImportError, match=r"^Solution.to_netcdf needs h5netcdf: pip install 'hjbjax\[io\]'"):
        solved().to_netcdf(tmp_path / "run.nc")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("package", ["xarray", "h5netcdf"])
def test_a_package_that_cannot_be_loaded_is_not_called_missing(package, tmp_path, monkeypatch):
    """Its own reason is raised, for example that memory ran out."""
    (tmp_path / f"{package}.py").write_text("raise ImportError('failed to map segment from shared object')")
    monkeypatch.delitem(sys.modules, package, raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=r"^failed to map segment"):
        solved().to_netcdf(tmp_path / "run.nc")


def test_a_slash_in_a_name_makes_no_group(tmp_path):
    pytest.importorskip("h5netcdf")
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (9,), names=("v/ω",)), scheme=hjb.Upwind())
    solution.to_netcdf(tmp_path / "run.nc")
    with xarray.open_dataset(tmp_path / "run.nc", engine="h5netcdf") as found:
        assert found["value"].dims == ("v⁄ω",)


@pytest.mark.slow
def test_a_batch_has_no_one_grid():
    import jax

    def value(discount):
        problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=discount)
        return hjb.solve(problem, hjb.Grid([-1.0], [1.0], (9,)), scheme=hjb.Upwind())

    batch = jax.vmap(value)(np.array([1.0, 2.0]))
    with pytest.raises(ValueError, match="a traced solution or a batch"):
        batch.to_xarray()
