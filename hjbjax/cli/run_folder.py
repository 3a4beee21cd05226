"""The files of a solved problem, and its report as JSON.

    solution.npz    the Solution
    value.png       the value, with the switching curve if the feedback is bang-bang
    policy.png      every input of the feedback, if there are any
    trajectory.png  a closed loop on the value and over time

Files are written to a hidden folder next to the old ones and moved over them when they are complete. Problems with more
than two states are plotted on the plane of the first two axes through the start of the trajectory.
"""

import contextlib
import dataclasses
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

import numpy as np

from hjbjax import plotting
from hjbjax._version import __version__
from hjbjax.feedback.feedback import greedy_feedback
from hjbjax.feedback.path import Path as Trajectory
from hjbjax.feedback.path import join_paths
from hjbjax.feedback.simulation import simulate
from hjbjax.plotting.maps import closed_loop_size
from hjbjax.plotting.modes import name_mode
from hjbjax.plotting.slices import at_states
from hjbjax.plotting.slices import feedback as feedback_of
from hjbjax.plotting.style import NARROW, save_figure
from hjbjax.problem import streams
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST
from hjbjax.problem.mode_axis import in_mode
from hjbjax.problem.problem import Problem, is_random
from hjbjax.problem.sets import Ball, Box, Simplex
from hjbjax.solution import placement
from hjbjax.solution.solution import Solution, Status
from hjbjax.zoo.ingredients import Exact, Feedback

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILES = ("solution.npz", "value.png", "policy.png", "trajectory.png")
Plain: TypeAlias = "dict[str, Plain] | list[Plain] | str | float | bool | None"  # the types of JSON
SAMPLES = 400  # most samples of a bang-bang feedback along its trajectory
FEWEST = 40  # fewest samples; with fewer the path would pass a small target
CONSTANT, NEARLY = 1e-3, 0.99  # relative variation of a constant feedback, and the fraction of its nodes
DPI = 160
NAME = 40  # characters of a folder's name that are repeated in the name of a new folder next to it


def check_folder(out: Path, force: bool = False) -> None:
    """Raise if a folder contains results, unless ``force``, or if the path is not a folder.

    Raises:
      OSError: the folder must not be used; the message has one line with advice.
    """
    placement.current_folder()  # otherwise JAX raises FileNotFoundError when it filters a traceback
    # lexists also finds a broken link, through which files would be written
    if os.path.lexists(out) and not out.is_dir():
        raise NotADirectoryError(f"{out} exists but is not a folder; give another name")
    for file in FILES:  # refuse folders and devices with these names even with force
        placement.check_place(out / file, force=True)
    old = [file for file in FILES if os.path.lexists(out / file)]
    if old and not force:
        raise FileExistsError(f"{out} contains {', '.join(old)} already; give another --out, or --force to replace")


def takes(out: Path, file: str) -> bool:
    """True if the results in the folder ``out`` need the name of a file for one of them or for a parent folder."""
    whole, place = Path(placement.absolute(os.fspath(out))), Path(placement.absolute(file))
    # an existing folder is refused for that reason
    return not os.path.isdir(place) and place in (whole, *whole.parents, *(whole / name for name in FILES))


@contextlib.contextmanager
def staging(out: Path) -> Iterator[Path]:
    """Create a hidden folder on the file system of ``out``, to check that it can be written; remove it at the end.

    A killed command leaves the folder behind, and the next command removes it.

    Raises:
      OSError: ``out`` cannot be written.
    """
    whole = Path(placement.absolute(os.fspath(out)))
    # in the nearest existing folder, because moving files is atomic only on one file system, and /tmp may be another
    place = next(folder for folder in (whole, *whole.parents) if os.path.lexists(folder))
    placement.remove_leftovers(place)
    folder = place / placement.hidden_name(out.name)
    try:
        with contextlib.ExitStack() as claimed:
            try:
                folder.mkdir(mode=0o700)  # private until it is complete
                trial = folder / FILES[0]
                trial.write_bytes(bytes(placement.BLOCK))  # a full disk may still accept folders
                trial.unlink()
                missing = whole.relative_to(place).parts
                folder.joinpath(*missing).mkdir(parents=True, exist_ok=True)  # detects names that are too long now
                if missing:
                    shutil.rmtree(folder / missing[0])
                claimed.enter_context(placement.claim(folder))
            except OSError as error:
                raise OSError(f"{out} cannot be written: {error.strerror}; give another folder") from error
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # the sweep of the next command removes the rest


def check_writable(out: Path) -> None:
    """Check that a folder, which need not exist yet, can be written.

    Raises:
      OSError: it cannot be written.
    """
    with staging(out):
        pass


def publish(folder: Path, out: Path, made: Sequence[str], force: bool = False) -> None:
    """Move complete files into ``out``, and remove old files that have no successor.

    Raises:
      OSError: ``out`` cannot be written, or contains results by now.
    """
    if not made:
        return
    out.mkdir(parents=True, exist_ok=True)
    check_folder(out, force)  # check again, because the solve may have taken long
    for file in FILES:
        if file in made:  # if two commands run at once, one of them fails at the first file
            placement.place(folder / file, out / file, force)
        else:
            (out / file).unlink(missing_ok=True)


def reason_of(error: OSError, staging: Path, out: Path) -> str:
    """The file and the reason of an error, without the hidden folder, which is gone when the user reads the message."""
    file = error.filename2 or error.filename  # the destination, if a move failed
    reason = error.strerror or str(error)
    named = f"{file}: {reason}" if file else reason
    return named.replace(f"{staging}{os.sep}", f"{out}{os.sep}")


def copy(solution: Solution, staging: Path, folder: Path) -> None:
    """Write a solution and its finished plots into a folder."""
    solution.save(folder / FILES[0])
    for file in FILES[1:]:
        with contextlib.suppress(OSError):
            shutil.copyfile(staging / file, folder / file)


def rescue(out: Path, fill: Callable[[Path], object]) -> str:
    """Save results in a new folder next to ``out``, or in the temporary folder, and return a message with its name.

    Args:
      out: the folder that could not be written.
      fill: a function that writes the results into a folder.
    """

    def beside() -> str:
        return os.path.dirname(placement.absolute(os.fspath(out)))

    for parent in (beside, tempfile.gettempdir):
        with contextlib.suppress(OSError):
            folder = Path(tempfile.mkdtemp(prefix=f"{out.name[:NAME] or 'hjbjax'}-", dir=parent()))
            try:
                fill(folder)
            except OSError:
                shutil.rmtree(folder, ignore_errors=True)
                raise
            return f"they are in {folder}"
    return "no other folder could be written either"


def make(
    problem: Problem,
    solution: Solution,
    folder: Path,
    *,
    start: Sequence[float],
    duration: float,
    finish: tuple[Problem, Feedback] | None = None,
    mode: str | None = None,
) -> Iterator[tuple[str, Trajectory | None]]:
    """Write the files one by one; yield the name of each file, and the trajectory with the last one.

    An interrupted solve is saved but not plotted, and a solve that has not converged has no trajectory. ``finish`` is
    the problem and the feedback of the final phase inside the target, if the exit cost is the cost of that phase, and
    ``mode`` the mode in which the trajectory starts.

    Raises:
      OSError: a file cannot be written.
    """

    solution.save(folder / "solution.npz")  # first, because the solution is the most expensive result
    yield "solution.npz", None
    if solution.status == Status.INTERRUPTED:
        return
    fixed = dict(enumerate(start[2:], 2))  # cut all axes from the third on at the start of the trajectory
    jumps = is_bang_bang(problem, solution)
    # figures without pyplot, which is slow to import and would keep them
    save_figure(plot_values(problem, solution, fixed, jumps), folder / "value.png", dpi=DPI)
    yield "value.png", None
    if problem.controls is not None:
        save_figure(plot_policies(problem, solution, fixed, jumps), folder / "policy.png", dpi=DPI)
        yield "policy.png", None
    path = None
    if solution.status == Status.CONVERGED:  # a closed loop with an unfinished feedback would be misleading
        path = closed_path(problem, solution, start, duration, jumps, finish, mode)
    if path is not None:
        figure = figure_of(closed_loop_size(solution, path))
        loop = plotting.closed_loop(solution, path, fixed=fixed, target=target_in(problem, mode), figure=figure)
        loop.save(folder / "trajectory.png", dpi=DPI)
        yield "trajectory.png", path


def figure_of(size: tuple[float, float]) -> "Figure":
    """A figure outside pyplot's registry."""
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def is_bang_bang(problem: Problem, solution: Solution) -> bool:
    """True if the feedback jumps: it is enumerated, or 90 % of its entries are at a bound."""
    box = problem.controls
    if solution.discrete or not isinstance(box, (Box, Simplex)):
        return solution.discrete
    # 90 %, because nodes at rest and on the switching curve may have any value
    if isinstance(box, Box) and box.unbounded:
        return False
    lo, hi = (0.0, box.total) if isinstance(box, Simplex) else (box.lo, box.hi)
    policy, near = _finite_controls(solution), 1e-6 * (hi - lo)
    return policy.size > 0 and bool(np.mean((policy <= lo + near) | (policy >= hi - near)) > 0.9)


def _is_direction(problem: Problem, solution: Solution) -> bool:
    """True if the feedback is a direction: 90 % of its controls are on the sphere of a ball."""
    if not isinstance(problem.controls, Ball):
        return False
    policy = _finite_controls(solution)
    return policy.size > 0 and bool(np.mean(np.linalg.norm(policy, axis=-1) > problem.controls.radius * 0.999999) > 0.9)


def _finite_controls(solution: Solution) -> np.ndarray:
    """The controls of the nodes that have one, (k, m)."""
    policy = np.asarray(solution.policy)
    return policy[np.all(np.isfinite(policy), axis=-1)]


def closed_path(
    problem: Problem,
    solution: Solution,
    start: Sequence[float],
    duration: float,
    jumps: bool,
    finish: tuple[Problem, Feedback] | None,
    mode: str | None = None,
) -> Trajectory | None:
    """The path of the closed loop, followed by the final phase inside the target.

    If the control jumps or is a direction, the mean of two controls is not optimal, so the Hamiltonian is minimised at
    every state. Over one state the mean is the control that holds the state at a switching point, so it is used. A
    control that jumps is sampled, because an adaptive integrator is very slow along a switching curve.
    On a curve along which the path slides, the side of a state is known only up to a cell, so the control chatters if
    it is sampled several times per cell. A second simulation holds it for the time in which the path crosses a cell.
    """
    # a fixed key, so that the same path is drawn every time
    options: dict[str, Any] = {"key": 0} if is_random(problem) else {}
    if mode is not None:
        options["mode"] = mode
    jumps = jumps and (solution.discrete or len(solution.grid.state_axes) > 1)
    if jumps:
        options["hold"] = duration / SAMPLES
    sharp = jumps or _is_direction(problem, solution)
    feedback = greedy_feedback(problem, solution) if sharp else solution
    if finish is not None:  # otherwise the cost of the final phase would be paid twice
        problem = dataclasses.replace(problem, exit_cost=None)
    try:
        path = simulate(problem, feedback, start, duration, **options)
        if jumps and not is_random(problem):
            options["hold"] = crossing_time(path, solution.grid, duration)
            path = simulate(problem, feedback, start, duration, **options)
        if finish is None or path.reached is None:
            return path
        rest_problem, rest_feedback = finish
        rest = simulate(rest_problem, rest_feedback, path.states[-1], duration)
        return join_paths(path, rest, float(np.asarray(problem.discount)))
    except ValueError as error:  # for example a start outside a box that parameters made smaller
        streams.warn_safely(f"no trajectory.png: {error}", UserWarning, stacklevel=2)
        return None


def crossing_time(path: Trajectory, grid: Grid, duration: float) -> float:
    """The median time in which a path crosses a cell of the grid, between ``duration`` / 400 and ``duration`` / 40."""
    spacings = np.array([float(grid.spacing(axis)) for axis in grid.state_axes])
    cells = np.max(np.abs(np.diff(np.asarray(path.states), axis=0)) / spacings, axis=-1)
    moves = cells > 0
    times = np.diff(np.asarray(path.times))[moves] / cells[moves]
    return float(np.clip(np.median(times), duration / SAMPLES, duration / FEWEST)) if times.size else duration / SAMPLES


class _Part(NamedTuple):
    """The solution of one plot: of all modes over one state, otherwise of one mode."""

    mode: str
    solution: Solution
    target: Callable | None


def _parts(problem: Problem, solution: Solution) -> list[_Part]:
    """The solutions to plot side by side."""
    modes = solution.grid.modes
    if not modes:
        return [_Part("", solution, problem.target)]
    if len(solution.grid.state_axes) == 1:  # the plot has one line per mode
        return [_Part("", solution, None)]
    return [_Part(name, solution.in_mode(name), target_in(problem, name)) for name in modes]


def target_in(problem: Problem, mode: str | None) -> Callable | None:
    """The target as a function of the state, in the given mode of a problem with modes."""
    return problem.target if problem.modes is None else in_mode(problem, problem.modes.number(mode or 0)).target


def plot_values(problem: Problem, solution: Solution, fixed: dict[int, float], jumps: bool) -> "Figure":
    """The value; with modes over two states one plot per mode, side by side."""
    parts = _parts(problem, solution)
    figure, axes_of_parts = _panels(len(parts))
    for ax, part in zip(axes_of_parts, parts, strict=True):
        drawn = plotting.value(part.solution, ax=ax, fixed=fixed, target=part.target)
        with_curve(drawn, part.solution, fixed, jumps)
        if part.mode:
            name_mode(ax, part.mode)
    return figure


def plot_policies(problem: Problem, solution: Solution, fixed: dict[int, float], jumps: bool) -> "Figure":
    """One plot per input and, over two states, per mode, side by side; without constant feedbacks if others vary."""
    inputs = [(part, input) for input in range(solution.policy.shape[-1]) for part in _parts(problem, solution)]
    inputs = [each for each in inputs if constant_input(each[0].solution, each[1], fixed) is None] or inputs
    figure, axes_of_inputs = _panels(len(inputs))
    if not inputs:
        figure.text(0.5, 0.5, "this problem has no control", ha="center", va="center", color="0.4")
    for ax, (part, input) in zip(axes_of_inputs, inputs, strict=True):
        drawn = plotting.policy(part.solution, input=input, fixed=fixed, ax=ax)
        with_curve(drawn, part.solution, fixed, jumps, input)
        if part.mode:
            name_mode(ax, part.mode)
    return figure


def constant_input(solution: Solution, input: int, fixed: dict[int, float]) -> float | None:
    """The number that one input of the feedback has at nearly all nodes of a cut, of every mode; ``None`` if it varies.

    Its picture would have one colour, or be a horizontal line.
    """
    modes = solution.grid.modes
    parts = [solution.in_mode(mode) for mode in modes] if modes else [solution]
    known = np.concatenate([feedback_of(part, input, fixed, None)[0].values.compressed() for part in parts])
    if known.size == 0:
        return None
    middle = float(np.median(known))
    return middle if float(np.mean(np.abs(known - middle) <= CONSTANT * abs(middle))) > NEARLY else None


def _panels(count: int) -> tuple["Figure", list["Axes"]]:
    """A figure with ``count`` plots side by side."""
    figure = figure_of((NARROW[0] * max(1, count), NARROW[1]))
    if not count:
        return figure, []
    return figure, [plotting.styled(ax) for ax in figure.subplots(1, count, squeeze=False)[0]]


def with_curve(
    picture: plotting.Picture, solution: Solution, fixed: dict[int, float], jumps: bool, input: int = 0
) -> plotting.Picture:
    """Add the switching curve to a plot, if there is one."""
    # enumerated controls have no sign, and over one axis the jump is visible in the line
    if jumps and not solution.discrete and len(solution.grid.state_axes) > 1:
        with contextlib.suppress(ValueError):  # the control does not change sign
            plotting.switching_curve(solution, input=input, fixed=fixed, ax=picture.ax)
    return picture


def difference(exact: Exact, solution: Solution) -> float | None:
    """The largest |V − exact| on the inner half of the box, away from the effect of its boundary.

    Args:
      exact: the value as a function of one state.
      solution: the solution of ``solve``.

    Returns:
      The difference in cost units; ``None`` if no difference there is finite.
    """
    grid = solution.grid
    index = []
    for axis in range(grid.ndim):
        lo, hi, nodes = grid.lo[axis], grid.hi[axis], np.asarray(grid.axis(axis))
        # the half around the centre; all of a periodic axis, which has no boundary
        inner = np.abs(nodes - (lo + hi) / 2) <= (hi - lo) / 4
        index.append(np.arange(len(nodes)) if grid.periodic[axis] else np.flatnonzero(inner))
    corner = np.ix_(*index)
    states = grid.nodes()[corner]  # (k₁, …, k_n, n)
    # in chunks, because evaluating the series or Newton steps at all nodes at once takes much memory
    wanted = at_states(exact, states)
    with np.errstate(invalid="ignore"):  # ∞ − ∞ where both are unreachable
        off = np.abs(np.asarray(solution.value)[corner] - wanted)
    off = off[np.isfinite(off)]  # drop ∞ − ∞
    return float(off.max()) if off.size else None


def json_report(solution: Solution, path: Trajectory | None, files: Sequence[Path], **about: Any) -> dict[str, Any]:
    """The result for JSON: without arrays over the nodes, and with null for infinity and NaN."""
    numbers = ("steps", "residual", "error", "monotone_error", "isaacs_gap", "stats")
    off = None if solution.grid_error is None else float(np.nanmax(solution.grid_error))
    trajectory = path and {
        "start": path.states[0],
        "end": path.states[-1],
        "duration": path.times[-1],
        path.payoff: path.cost if path.payoff == COST else path.reward,
        "promised": path.promised,
        "status": path.status.name,
        "message": path.message,
    }
    answer = {
        **about,
        "shape": solution.grid.shape,
        "modes": solution.grid.modes,
        "status": solution.status.name,
        "message": solution.message or solution.status.message,
        **{name: getattr(solution, name) for name in numbers},
        "grid_error": off,
        "trajectory": trajectory,
        "files": [str(file) for file in files],
        "version": __version__,
    }
    return cast(dict[str, Any], _plain(answer))


def _plain(value: object) -> Plain:
    """Convert numbers, arrays and names to JSON types."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic) or hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
