"""The files of a solved problem, and its report for programs.

    solution.npz    the Solution
    value.png       the value; with the switching curve where the feedback is bang-bang
    policy.png      every input of the feedback; not where there is none
    trajectory.png  a closed loop on the value, and over time

Files are made in a hidden folder beside the old ones and moved over them when they are whole. States of more
than two dimensions are drawn on the plane of the first two axes through the start of the trajectory.
"""

import contextlib
import dataclasses
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from hjbjax import plotting
from hjbjax._version import __version__
from hjbjax.feedback.feedback import greedy_feedback
from hjbjax.feedback.path import Path as Trajectory
from hjbjax.feedback.path import joined
from hjbjax.feedback.simulation import simulate
from hjbjax.plotting.maps import closed_loop_size
from hjbjax.plotting.slices import at_states
from hjbjax.plotting.style import NARROW
from hjbjax.problem import streams
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import Ball
from hjbjax.solution import placement
from hjbjax.solution.solution import Solution, Status
from hjbjax.zoo.ingredients import Exact, Feedback

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILES = ("solution.npz", "value.png", "policy.png", "trajectory.png")
Plain: TypeAlias = "dict[str, Plain] | list[Plain] | str | float | bool | None"  # what JSON has
SAMPLES = 400  # of a bang-bang feedback along its trajectory
DPI = 160
NAME = 40  # characters of a folder's name that a folder next to it repeats


def check_folder(out: Path, force: bool = False) -> None:
    """Refuse a folder that holds results, unless by ``force``, and a path that is no folder.

    Raises:
      OSError: with a line on what to do.
    """
    placement.current_folder()  # without one JAX raises FileNotFoundError where it filters a traceback
    # lexists: a link that leads nowhere is there as well, and writing would go through it
    if os.path.lexists(out) and not out.is_dir():
        raise NotADirectoryError(f"{out} is there and is no folder; give another name")
    for file in FILES:  # a folder or a device of such a name is refused even by force
        placement.check_place(out / file, force=True)
    old = [file for file in FILES if os.path.lexists(out / file)]
    if old and not force:
        raise FileExistsError(f"{out} holds {', '.join(old)} already; give another --out, or --force to replace them")


@contextlib.contextmanager
def staging(out: Path) -> Iterator[Path]:
    """A hidden folder on the file system of ``out``, gone at the end; making it shows that one can write there.

    A killed command leaves the folder behind, and the next command removes it.

    Raises:
      OSError: ``out`` cannot be written.
    """
    whole = Path(placement.absolute(os.fspath(out)))
    # in the nearest folder that exists: moving files is atomic only on one file system, and /tmp may be another
    place = next(folder for folder in (whole, *whole.parents) if os.path.lexists(folder))
    placement.sweep(place)
    folder = place / placement.hidden_name(out.name)
    try:
        try:
            folder.mkdir(mode=0o700)  # nobody else looks into it before it is whole
            missing = whole.relative_to(place).parts
            folder.joinpath(*missing).mkdir(parents=True, exist_ok=True)  # or a name that is too long shows at the end
        except OSError as error:
            raise OSError(f"{out} cannot be written: {error.strerror}; give another folder") from error
        if missing:
            shutil.rmtree(folder / missing[0])
        with placement.claim(folder):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # the next command's sweep takes what could not be removed


def check_writable(out: Path) -> None:
    """Check that files can be written into a folder, which need not exist yet.

    Raises:
      OSError: they cannot.
    """
    with staging(out):
        pass


def publish(folder: Path, out: Path, made: Sequence[str], force: bool = False) -> None:
    """Move whole files into ``out``; an older file that has no successor goes with the result it belonged to.

    Raises:
      OSError: ``out`` cannot be written, or holds results by now.
    """
    if not made:
        return
    out.mkdir(parents=True, exist_ok=True)
    check_folder(out, force)  # again: the solve may have taken long
    for file in FILES:
        if file in made:  # the first is always there: of two commands at once, one is refused before it moves anything
            placement.place(folder / file, out / file, force)
        else:
            (out / file).unlink(missing_ok=True)


def copy(solution: Solution, staging: Path, folder: Path) -> None:
    """Write a solution into a folder, and what had been drawn of it."""
    solution.save(folder / FILES[0])
    for file in FILES[1:]:
        with contextlib.suppress(OSError):
            shutil.copyfile(staging / file, folder / file)


def rescue(out: Path, fill: Callable[[Path], object]) -> str:
    """Put results that ``out`` does not take into a new folder next to it, else among temporary files; where, in words.

    Args:
      out: the folder that was to hold them.
      fill: writes them into a folder.
    """
    for parent in (lambda: placement.absolute(os.fspath(out.parent)), tempfile.gettempdir):
        with contextlib.suppress(OSError):
            folder = Path(tempfile.mkdtemp(prefix=f"{out.name[:NAME]}-", dir=parent()))
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
) -> Iterator[tuple[str, Trajectory | None]]:
    """The files, made one by one: the name of each and, with the last, the trajectory that it shows.

    An interrupted solve is saved and not drawn; one that did not converge gets no trajectory. ``finish`` is the
    problem and the feedback by which a trajectory goes on from the target, where that holds the rest of the cost.

    Raises:
      OSError: a file cannot be written.
    """

    solution.save(folder / "solution.npz")  # first: what took the longest is safe before anything is drawn
    yield "solution.npz", None
    if solution.status == Status.INTERRUPTED:
        return
    fixed = dict(enumerate(start[2:], 2))  # axes from the third on, cut where the trajectory starts
    jumps = is_bang_bang(problem, solution)
    # figures of our own, which pyplot would keep, and would have to be imported for
    value = plotting.value(solution, ax=axes(), fixed=fixed, target=problem.target)
    with_curve(value, solution, fixed, jumps).save(folder / "value.png", dpi=DPI)
    yield "value.png", None
    if problem.controls is not None:
        policies(solution, fixed, jumps).savefig(folder / "policy.png", dpi=DPI)
        yield "policy.png", None
    path = None
    if solution.status == Status.CONVERGED:  # a loop closed with a half-done feedback would be taken for the answer
        path = closed_path(problem, solution, start, duration, jumps, finish)
    if path is not None:
        figure = figure_of(closed_loop_size(solution.grid))
        loop = plotting.closed_loop(solution, path, fixed=fixed, target=problem.target, figure=figure)
        loop.save(folder / "trajectory.png", dpi=DPI)
        yield "trajectory.png", path


def figure_of(size: tuple[float, float]) -> "Figure":
    """A figure that no global registry knows."""
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def axes() -> "Axes":
    """Axes on such a figure."""
    return plotting.styled(figure_of(NARROW).add_subplot())


def is_bang_bang(problem: Problem, solution: Solution) -> bool:
    """True where the feedback jumps: it is enumerated, or nine of ten of its entries lie on a bound."""
    lo, hi = getattr(problem.controls, "lo", None), getattr(problem.controls, "hi", None)
    if solution.discrete or lo is None or hi is None:
        return solution.discrete
    # nine of ten: nodes at rest and on the switching curve itself may hold anything between
    policy, near = _finite_controls(solution), 1e-6 * (hi - lo)
    return policy.size > 0 and bool(np.mean((policy <= lo + near) | (policy >= hi - near)) > 0.9)


def _is_direction(problem: Problem, solution: Solution) -> bool:
    """True where the feedback is a direction: nine of ten of its controls lie on the sphere around a ball."""
    if not isinstance(problem.controls, Ball):
        return False
    policy = _finite_controls(solution)
    return policy.size > 0 and bool(np.mean(np.linalg.norm(policy, axis=-1) > problem.controls.radius * 0.999999) > 0.9)


def _finite_controls(solution: Solution) -> np.ndarray:
    """The controls of the nodes where there is one, (k, m)."""
    policy = np.asarray(solution.policy)
    return policy[np.all(np.isfinite(policy), axis=-1)]


def closed_path(
    problem: Problem,
    solution: Solution,
    start: Sequence[float],
    duration: float,
    jumps: bool,
    finish: tuple[Problem, Feedback] | None,
) -> Trajectory | None:
    """The path of the closed loop, with the stretch that follows inside the target.

    Where the control jumps or is a direction, the mean of two is optimal for neither: there the Hamiltonian is
    minimised at the state. One that jumps is sampled: an adaptive stepper crawls along its switching curve.
    """
    # one key for ever: the command draws the same path twice, and a picture can be reproduced
    options: dict[str, Any] = {} if problem.noise is None else {"key": 0}
    if jumps:
        options["hold"] = duration / SAMPLES
    sharp = jumps or _is_direction(problem, solution)
    feedback = greedy_feedback(problem, solution) if sharp else solution
    if finish is not None:  # or the cost of the rest would be paid twice, as exit cost and on the way
        problem = dataclasses.replace(problem, exit_cost=None)
    try:
        path = simulate(problem, feedback, start, duration, **options)
        if finish is None or path.reached is None:
            return path
        rest_problem, rest_feedback = finish
        rest = simulate(rest_problem, rest_feedback, path.states[-1], duration)
        return joined(path, rest, float(np.asarray(problem.discount)))
    except ValueError as error:  # a start outside the box that parameters made smaller: no reason to lose the rest
        streams.warn(f"no trajectory.png: {error}", UserWarning, stacklevel=2)
        return None


def policies(solution: Solution, fixed: dict[int, float], jumps: bool) -> "Figure":
    """One picture an input, side by side."""
    count = solution.policy.shape[-1]
    figure = figure_of((NARROW[0] * max(1, count), NARROW[1]))
    if count == 0:
        figure.text(0.5, 0.5, "this problem has no control", ha="center", va="center", color="0.4")
        return figure
    for input, ax in enumerate(figure.subplots(1, count, squeeze=False)[0]):
        drawn = plotting.policy(solution, input=input, fixed=fixed, ax=plotting.styled(ax))
        with_curve(drawn, solution, fixed, jumps, input)
    return figure


def with_curve(
    picture: plotting.Picture, solution: Solution, fixed: dict[int, float], jumps: bool, input: int = 0
) -> plotting.Picture:
    """A picture with the switching curve, where there is one."""
    # an enumerated control is no number that changes its sign; over one axis the jump is in the line itself
    if jumps and not solution.discrete and solution.grid.ndim > 1:
        with contextlib.suppress(ValueError):  # the control keeps its sign
            plotting.switching_curve(solution, input=input, fixed=fixed, ax=picture.ax)
    return picture


def difference(exact: Exact, solution: Solution) -> float | None:
    """The largest |V − exact| on the inner half of the box, where its edge is not felt.

    Args:
      exact: the value as a function of one state.
      solution: the solution of ``solve``.

    Returns:
      The difference in cost units; ``None`` if nothing there is finite.
    """
    grid = solution.grid
    index = []
    for axis in range(grid.ndim):
        lo, hi, nodes = grid.lo[axis], grid.hi[axis], np.asarray(grid.axis(axis))
        # the half around the middle; a periodic axis has no edge, and all of it counts
        inner = np.abs(nodes - (lo + hi) / 2) <= (hi - lo) / 4
        index.append(np.arange(len(nodes)) if grid.periodic[axis] else np.flatnonzero(inner))  # type: ignore[index]
    corner = np.ix_(*index)
    states = grid.nodes()[corner]  # (k₁, …, k_n, n)
    # in chunks, as series and Newton's steps at every node at once would need many times the memory of the value
    wanted = at_states(exact, states)
    with np.errstate(invalid="ignore"):  # ∞ − ∞ where neither reaches the target
        off = np.abs(np.asarray(solution.value)[corner] - wanted)
    off = off[np.isfinite(off)]  # ∞ − ∞ where both say out of reach
    return float(off.max()) if off.size else None


def report(solution: Solution, path: Trajectory | None, files: Sequence[Path], **about: Any) -> dict[str, Any]:
    """The answer as JSON has it: without arrays of nodes, and null for infinity and NaN, which JSON lacks."""
    numbers = ("steps", "residual", "error", "monotone_error", "isaacs_gap", "stats")
    off = None if solution.grid_error is None else float(np.nanmax(solution.grid_error))
    trajectory = path and {
        "start": path.states[0],
        "end": path.states[-1],
        "duration": path.times[-1],
        "cost": path.cost,
        "promised": path.promised,
        "status": path.status.name,
        "message": path.message,
    }
    answer = {
        **about,
        "shape": solution.grid.shape,
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
    """Numbers, arrays and names as JSON has them."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic) or hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
