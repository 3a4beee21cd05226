"""Conversion of a solution to a header and arrays for result files, and to named arrays for other tools."""

from typing import TYPE_CHECKING, Any

import numpy as np

from hjbjax.problem import labels as labelling
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import Labels
from hjbjax.problem.mode_axis import with_modes
from hjbjax.problem.stretching import Sinh
from hjbjax.solution import numpy_feedback
from hjbjax.solution.files import Expected, FileError, check_kinds
from hjbjax.solution.modes import switching_modes
from hjbjax.solution.status import Status

if TYPE_CHECKING:  # an optional dependency, imported on use
    import xarray

FORMAT, VERSION = "hjbjax.Solution", 1  # the version is incremented when an older hjbjax would misread a file
KINDS: dict[str, tuple[type, ...]] = {  # types in the header of a file, as JSON returns them
    "code": (int,),
    "steps": (int,),
    "isaacs_gap": (float, type(None)),
    "monotone_error": (float, type(None)),
    "discrete": (bool,),
    "discrete_disturbance": (bool,),
    "message": (str,),
    "stats": (dict,),
}
GRID: dict[str, tuple[type, ...]] = {"shape": (list, tuple), "periodic": (list, tuple), "names": (list, tuple)}


def about_grid(grid: Grid) -> dict[str, Any]:
    """The entries of a header that describe a grid, except its corners, which are arrays."""
    return {
        "shape": grid.shape,
        "periodic": grid.periodic,
        "edges": grid.edges,
        "names": grid.names,
        "units": grid.units,
        "modes": grid.modes,
        "stretch": [s and [float(s.strength), float(s.center)] for s in grid.stretch],
    }


def grid_of(about: dict[str, Any], lo: np.ndarray, hi: np.ndarray) -> Grid:
    """The grid with a description from a header and corners from a file; ``Grid`` checks its own arguments."""
    stretch = tuple(pair and Sinh(*pair) for pair in about["stretch"])
    modes, edges = (
        tuple(about.get("modes", ())),
        about.get("edges", "projected"),
    )  # in older files all ends are projected
    if not all(isinstance(mode, str) for mode in modes):  # the other names are checked by ``Grid``
        raise FileError(f"its modes are {modes}, wanted text")
    rest = slice(1 if modes else 0, None)  # without the axis of modes
    return with_modes(Grid(
        lo[rest], hi[rest], tuple(about["shape"])[rest], about["periodic"][rest],
        tuple(about["names"])[rest], stretch[rest], edges if isinstance(edges, str) else edges[rest],
        tuple(about.get("units", ()))[rest],  # missing in older files, like the labels
    ), modes)  # fmt: skip


def contents(solution: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a solution.

    Raises:
      ValueError: the arrays do not fit the grid, for example the arrays of a batch.
    """
    grid = solution.grid
    header = {
        "format": FORMAT,
        "version": VERSION,
        "grid": about_grid(grid),
        "labels": solution.labels,
        "marched": None if solution.times is None else int(np.shape(solution.times)[0]),
        "isaacs_gap": np.asarray(solution.isaacs_gap).tolist(),
        "monotone_error": np.asarray(solution.monotone_error).tolist(),
        "code": np.asarray(solution.code).tolist(),
        "steps": np.asarray(solution.steps).tolist(),
        **{name: getattr(solution, name) for name in ("discrete", "discrete_disturbance", "message", "stats")},
    }
    arrays = {}
    for name, wanted in plan(header).items():
        array = getattr(grid if name in ("lo", "hi") else solution, name)
        if array is None:  # optional arrays that are missing come back as None
            continue
        arrays[name] = array = np.asarray(array)
        if complaint := wanted.complaint(array.shape, array.dtype.str):
            raise ValueError(f"Solution.save: {name} {complaint}; save the solutions of a batch one at a time")
    return header, arrays


def feedback_contents(solution: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of the file of ``Solution.export``, whose format ``numpy_feedback`` describes."""
    grid, labels = solution.grid, solution.labels
    header = {
        "format": numpy_feedback.FORMAT, "version": numpy_feedback.VERSION, "names": grid.names, "units": grid.units,
        "modes": grid.modes, "controls": labels.controls, "control_units": labels.control_units,
    }  # fmt: skip
    known = solution.problem is not None and bool(grid.modes)
    arrays = {
        "lo": grid.lo,
        "hi": grid.hi,
        "periodic": np.array(grid.periodic),
        "uniform": np.array([stretch is None for stretch in grid.stretch]),
        **{f"nodes{axis}": grid.axis(axis) for axis in range(grid.ndim)},
        "value": solution.value,
        "control": solution.policy,
        "disturbance": solution.disturbance,
        "enumerated": np.array([solution.discrete, solution.discrete_disturbance]),
        "switching": switching_modes(solution) if known else None,
        "times": solution.times,
    }
    found = {name: np.asarray(array) for name, array in arrays.items() if array is not None}
    return {**header, "arrays": sorted(found)}, found


def shape_of(about: dict[str, Any]) -> tuple[int, ...]:
    """The shape of a grid with a description from a header; refused before the sizes of arrays are computed."""
    check_kinds(about, GRID, "its grid")
    shape = tuple(about["shape"])
    if not all(type(count) is int and count >= 2 for count in shape):
        raise FileError(f"its grid has shape {shape}")
    return shape


def plan(header: dict) -> dict[str, Expected]:
    """Shapes and dtypes of the arrays in a file; they follow from the grid in its header."""
    check_kinds(header, {"grid": (dict,), "marched": (int, type(None))})
    shape, marched = shape_of(header["grid"]), header["marched"]
    # None: any number of inputs or residuals; the kept times of a marched solution are the leading axis
    many, lead = (None,), () if marched is None else (marched,)
    controls = Expected((lead + shape + many, many * len(lead) + shape + many))
    return {
        "lo": Expected(((len(shape),),), optional=False),
        "hi": Expected(((len(shape),),), optional=False),
        "value": Expected((lead + shape,), optional=False),
        "policy": controls,
        "disturbance": controls,
        "enclosure": Expected(((2, 2),)),
        "reached": Expected((shape, lead + shape), (np.bool_,)),
        "stopping": Expected((lead + shape,), (np.bool_,)),
        "active": Expected((lead + shape,), (np.bool_,)),
        "pushing": Expected((lead + shape + many,), (np.bool_,)),
        "grid_error": Expected((shape, lead + shape)),
        "box_error": Expected((shape, lead + shape)),
        "residuals": Expected((many,)),
        "cut": Expected(((*lead, len(shape), 2),), (np.int64, np.int32)),
        **({} if marched is None else {"times": Expected((lead,), optional=False)}),
    }


def fields(header: dict, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The arguments of ``Solution`` from the header and the arrays of a file."""
    grid = grid_of(header["grid"], arrays.pop("lo"), arrays.pop("hi"))
    labels = labelling.of_file(header.get("labels", Labels()))
    header = {"monotone_error": None, **header}  # missing in older files
    check_kinds(header, KINDS)
    Status(header["code"])  # raises if there is no such status
    return {"policy": None, **arrays, "grid": grid, "labels": labels, **{name: header[name] for name in KINDS}}


def dataset(solution: Any) -> "xarray.Dataset":
    """A solution as an xarray dataset with the names and units of its states and controls.

    Raises:
      ImportError: xarray is not installed.
    """
    try:
        import xarray
    except ModuleNotFoundError:
        raise ImportError("Solution.to_xarray needs xarray: pip install 'hjbjax[io]'") from None
    grid, labels, marched = solution.grid, solution.labels, solution.times is not None
    own = ["value", "grid_error", "box_error", "reached", "stopping", "active", "pushing", "time"]
    own += ["control", "disturbance"]
    names = [f"state {name}" if name in own else name for name in grid.names]
    lead = ("time",) if marched else ()
    found: dict[str, Any] = {"value": ((*lead, *names), solution.value, {"long_name": labels.long_name})}
    described = {
        "grid_error": "estimated error of the grid",
        "box_error": "estimated error of the ends of the box",
        "reached": "the target can be reached",
        "stopping": "it is optimal to stop",
        "active": "the running maximum is attained",
    }
    for name, about in described.items():
        array = getattr(solution, name)
        if array is not None:
            found[name] = ([*lead, *names][-np.ndim(array) :], array, {"long_name": about})
    for j in range(0 if solution.pushing is None else np.shape(solution.pushing)[-1]):
        pushed = {"long_name": f"push {j} is optimal"}
        found[f"pushing {j}"] = ((*lead, *names), np.asarray(solution.pushing)[..., j], pushed)
    for kind, array in (("control", solution.policy), ("disturbance", solution.disturbance)):
        count = 0 if array is None else np.shape(array)[-1]
        for j in range(count):
            word, unit = _input(labels, kind, j, count)
            taken = word in found or word in names
            found[f"{kind} {word}" if taken else word] = ((*lead, *names), array[..., j], {"units": unit, "kind": kind})
    axes = {name: (name, grid.axis(i), {"units": grid.units[i]}) for i, name in enumerate(names)}
    times = {"time": ("time", solution.times)} if marched else {}
    kept = {key: str(value) for key, value in solution.stats.items() if isinstance(value, (str, int, float))}
    said = {"status": solution.status.name, "steps": int(solution.steps), "message": solution.message, **kept}
    return xarray.Dataset(found, {**axes, **times}, said)


def netcdf(found: "xarray.Dataset") -> bytes:
    """A dataset as the bytes of a netCDF file.

    A slash in a name would mean a path of groups in netCDF; it is written as the fraction slash, ⁄.

    Raises:
      ImportError: h5netcdf is not installed.
    """
    try:
        import h5netcdf
        import h5py
        from xarray.backends import H5NetCDFStore
    except ModuleNotFoundError:
        raise ImportError("Solution.to_netcdf needs h5netcdf: pip install 'hjbjax[io]'") from None
    found = found.rename({name: name.replace("/", "⁄") for name in map(str, found.variables) if "/" in name})
    # HDF5 ends the process if it cannot close a file, for example on a full disk. It therefore writes into memory,
    # where closing never fails. netCDF's own library requires tracked attribute order.
    with h5py.File("memory", "w", driver="core", backing_store=False, track_order=True) as image:
        with h5netcdf.File(image, "w") as file:
            # without xarray's lock, which Ctrl-C may leave locked; no other thread uses this file
            found.dump_to_store(H5NetCDFStore(file, lock=False))
        image.flush()
        return image.id.get_file_image()


def _input(labels: Labels, kind: str, j: int, count: int) -> tuple[str, str]:
    """Name and unit of a control or a disturbance."""
    if kind == "disturbance":
        return ("d" if count == 1 else f"d{j + 1}"), ""
    unit = labels.control_units[j] if j < len(labels.control_units) else ""
    return labels.controls[j] if j < len(labels.controls) else "u" if count == 1 else f"u{j + 1}", unit
