"""The command ``hjbjax``: solve a ready problem, list the problems, show all of them on a page, check the installation.

``solve`` writes ``solution.npz``, ``value.png``, ``policy.png`` and ``trajectory.png`` into a folder and prints a
summary. Invalid arguments are refused in one line before anything is compiled. Files are written to a hidden folder
next to the old ones, and moved over them when they are complete. If the folder cannot be written after the solve, the
files go to a new folder, which the last line names.

Exit codes: 0 done, 1 a check of ``doctor`` failed, 2 usage, 3 not converged, 4 diverged or not finite, 5 file,
6 memory, 7 a process of ``launch`` died, 130 interrupted (Ctrl-C or SIGTERM), 141 the reader closed the pipe.
"""

import contextlib
import dataclasses
import json
import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

from hjbjax._version import __version__
from hjbjax.cli import interrupts
from hjbjax.cli import launch as processes_of
from hjbjax.cli.command_line import (
    Failure,
    Name,
    Number,
    OneLineGroup,
    Place,
    Shape,
    catalogue,
    check_jax,
    names_of,
    parameters_of,
    print_text,
    say,
    text_of,
)  # fmt: skip
from hjbjax.problem import streams
from hjbjax.solution.clock import interruptible

if TYPE_CHECKING:  # heavy modules are imported by the command that needs them
    from hjbjax.cli.gallery import Card
    from hjbjax.feedback.path import Path as Trajectory
    from hjbjax.problem.grid import Grid
    from hjbjax.problem.problem import Problem
    from hjbjax.solution.solution import Solution
    from hjbjax.zoo.entry import Entry

FILES = ("solution.npz", "value.png", "policy.png", "trajectory.png")
CODES = {"CONVERGED": 0, "DIVERGED": 4, "NONFINITE": 4, "INTERRUPTED": 130}  # 3, not converged, for any other status
METHODS = {"value-iteration": "ValueIteration", "policy-iteration": "PolicyIteration"}
SCHEMES = {"upwind": "Upwind", "limited": "Limited", "weno5": "Weno5", "semi-lagrangian": "SemiLagrangian"}
PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "diffrax", "optax", "matplotlib", "tqdm", "click")


@click.group(cls=OneLineGroup, invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="hjbjax")
@click.pass_context
def main(context: click.Context) -> None:
    """Hamilton-Jacobi-Bellman and Isaacs equations on grids."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


@main.command("list", short_help="List the ready problems, or the details of one.")
@click.argument("name", required=False, type=Name("problem", catalogue))
def list_problems(name: str | None) -> None:
    """List the ready problems with their states, or the details of NAME with its parameters."""
    known = catalogue()
    check_jax()
    from hjbjax.cli import listing

    for line in listing.overview() if name is None else listing.details(known[name]):
        print_text(line)


@main.command(short_help="Solve a problem and plot the result.")
@click.argument("name", type=Name("problem", catalogue))
@click.option("--shape", type=Shape(), help="Nodes per axis, as in 200x201.")
@click.option("--set", "settings", multiple=True, metavar="NAME=VALUE", help="Set a parameter; can be repeated.")
@click.option("--method", type=Name("method", names_of(METHODS)), help=f"{' or '.join(METHODS)}; default: automatic.")
@click.option("--scheme", type=Name("scheme", names_of(SCHEMES)), help="The discretisation; default: second order.")
@click.option("--tol", type=Number(), help="Certified bound on the algebraic error, in cost units.")
@click.option("--max-steps", type=Number(int), help="Maximal number of steps.")
@click.option("--time-limit", type=Number(), help="Time limit in seconds.")
@click.option("--checkpoint", type=Place(), help="File that stores the progress every minute.")
@click.option("--resume", is_flag=True, help="Continue from the checkpoint if it exists.")
@click.option("--devices", type=Shape(least=1), help="Split the nodes: devices along each axis, as in 2 or 4x2.")
@click.option("--dry-run", is_flag=True, help="Only estimate bytes, programs, steps and seconds.")
@click.option("--out", type=Place(), help="Folder of the results; default: the problem's name.")
@click.option("--force", is_flag=True, help="Replace existing results.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of the summary.")
@click.option("--no-cache", is_flag=True, help="Do not store compiled programs in the user's cache folder.")
def solve(
    name: str,
    shape: tuple[int, ...] | None,
    settings: tuple[str, ...],
    out: Path | None,
    force: bool,
    as_json: bool,
    no_cache: bool,
    dry_run: bool,
    devices: tuple[int, ...] | None,
    **options: Any,
) -> None:
    """Solve the ready problem NAME; write solution.npz, value.png, policy.png and trajectory.png."""
    entry = catalogue()[name]
    from hjbjax.cli import run_folder
    from hjbjax.solvers import compile_cache

    processes_of.arrive()
    parameters = parameters_of(entry, settings)
    if dry_run:
        check_jax()
        _estimate(*_build(entry, parameters, shape), options, as_json=as_json)
        processes_of.leave()
        return
    out = Path(name) if out is None else out
    if processes_of.rank() == 0:  # before the processes meet: a later failure would wait for the others
        _check_places(out, force, options["checkpoint"], options["resume"])
    options["mesh"] = processes_of.mesh_of(devices)
    check_jax()
    if processes_of.rank() > 0:  # only the first process of a launch writes files and prints
        with interrupts.raising_interrupts(), interruptible():
            _solve(*_build(entry, parameters, shape), options)
            processes_of.leave()
        return
    problem, grid = _build(entry, parameters, shape)
    with contextlib.ExitStack() as stack:  # removes the hidden folder at the end, even after an interrupt
        stack.enter_context(interrupts.raising_interrupts())
        with _one_line_error(OSError, 2, "--out: "):
            staging = stack.enter_context(run_folder.staging(out))
        stack.enter_context(_one_line_warnings())
        stack.enter_context(interruptible())
        if not no_cache:
            compile_cache.keep_for_the_command()
        solution = _solve(problem, grid, options)
        processes_of.leave()  # drawing may take longer than JAX lets the other processes wait
        files, path = _write(entry, parameters, problem, solution, staging, out, force)
    off = None
    with contextlib.suppress(ValueError), _one_line_warnings():  # ValueError: no exact value for these parameters
        off = None if entry.exact is None else run_folder.difference(entry.exact(**parameters), solution)
    if as_json:
        about = {"problem": name, "parameters": parameters, "exact_difference": off}
        print_text(json.dumps(run_folder.json_report(solution, path, files, **about)))
    else:
        print_text(str(solution))
        if off is not None:
            print_text(f"off the exact answer by at most {off:.3g} on the inner half of the box")
        if path is not None:
            print_text(f"path: {path}")
        without = "" if problem.controls is not None else "; no policy.png, as there are no controls"
        print_text(f"wrote {', '.join(map(text_of, files))}{without}")
    if (failure := solution.stats.get("checkpoint", "written")) != "written":
        raise Failure(failure, 5)
    _raise_unless_converged(solution)


def _raise_unless_converged(solution: "Solution") -> None:
    """Raise a Failure with the exit code of the status unless it is CONVERGED."""
    if code := CODES.get(solution.status.name, 3):
        raise Failure(f"{solution.status.name}: {solution.message or solution.status.message}", code)


@main.command(short_help="Run a command in several processes.", context_settings={"ignore_unknown_options": True})
@click.option("--processes", type=Number(int), default=2, show_default=True, help="Number of processes on this host.")
@click.option("--heartbeat", type=Number(int), default=10, show_default=True, help="Seconds until one counts as dead.")
@click.argument("words", nargs=-1, required=True, metavar="-- COMMAND")
def launch(processes: int, heartbeat: int, words: tuple[str, ...]) -> None:
    """Run a command in processes that split its nodes, as in "hjbjax launch --processes 2 -- solve pendulum"."""
    processes_of.check_launch(words, processes, heartbeat)
    # a process takes ten seconds to start, so refuse here what every process would refuse
    given = solve.make_context("solve", list(words[1:]), parent=click.get_current_context().parent).params
    from hjbjax.cli import run_folder

    out = given["out"] or Path(given["name"])
    entry = catalogue()[given["name"]]
    with processes_of.without_accelerators():
        problem, grid = _build(entry, parameters_of(entry, given["settings"]), given["shape"])
    if not given["dry_run"]:
        processes_of.check_devices(given["devices"], processes)
        if processes > 1 or given["devices"]:
            _check_parts(problem, grid, given["devices"] or (processes,), given["scheme"])
        _check_places(out, *(given[key] for key in ("force", "checkpoint", "resume")))
        with _one_line_error(OSError, 2, "--out: "):
            run_folder.check_writable(out)
        if given["checkpoint"] is not None:
            with _one_line_error(OSError, 5, "--checkpoint: "):
                _try_checkpoint(given["checkpoint"])
    with interrupts.raising_interrupts():
        code = processes_of.start_processes(words, processes, heartbeat, out / FILES[0])
    if code:
        raise SystemExit(code)


def _check_parts(problem: "Problem", grid: "Grid", devices: tuple[int, ...], scheme: str | None) -> None:
    """Raise Failure if the nodes are too many, or cannot be divided over the devices."""
    from hjbjax.problem import arguments
    from hjbjax.tracing import checks

    choices = _given({"scheme": scheme}).values()
    with _one_line_error(ValueError, 2), _one_line_error(MemoryError, 6):
        arguments.check_count(grid.shape)
        checks.check_division(problem, grid, devices, "solve", *choices)


def _try_checkpoint(checkpoint: Path) -> None:
    """Raise OSError if a checkpoint cannot be read or written, or if another run is using it."""
    from hjbjax.solution import checkpoints, files, placement
    from hjbjax.solution.locked_file import LockedFile

    path = placement.absolute(files.with_suffix(os.fspath(checkpoint)))
    with contextlib.closing(LockedFile(path)) as file:
        if file.take():
            checkpoints.check_file(path)
    with placement.new_file(path):
        pass


def _check_places(out: Path, force: bool, checkpoint: Path | None, resume: bool) -> None:
    """Raise Failure if the folder of results or the checkpoint must not be replaced."""
    from hjbjax.cli import run_folder
    from hjbjax.solution import files
    from hjbjax.solution.placement import FileError, check_place

    with _one_line_error(OSError, 2, "--out: "):
        run_folder.check_folder(out, force)
    if resume and checkpoint is None:
        raise Failure("--resume continues from a checkpoint; add --checkpoint FILE")
    if checkpoint is None:
        return
    place = files.with_suffix(os.fspath(checkpoint))
    if run_folder.takes(out, place):
        raise Failure(f"--checkpoint: {place} is a name that --out {out} needs; give another one")
    if resume or not os.path.lexists(place):
        return
    with _one_line_error(FileError, 5, "--checkpoint: "):
        check_place(place, force=True)
    raise Failure(f"--checkpoint: {place} already exists; add --resume to continue from it")


@contextlib.contextmanager
def _one_line_error(
    kind: type[Exception] | tuple[type[Exception], ...], exit_code: int, prefix: str = ""
) -> Iterator[None]:
    """Turn errors of the given kinds into one line and an exit code."""
    try:
        yield
    except kind as error:
        raise Failure(f"{prefix}{error}", exit_code) from error


# ------------------------------------------------------------------------------------- before the solve


def _build(entry: "Entry", parameters: dict[str, Any], shape: tuple[int, ...] | None) -> tuple["Problem", "Grid"]:
    """The problem and its grid; errors give one line."""
    try:
        problem, grid = entry.build(**parameters)  # with the default shape first, to know the number of axes
        if shape is None:
            return problem, grid
        if len(shape) != grid.ndim:
            example = "x".join(map(str, grid.shape))
            raise ValueError(
                f"--shape: got {len(shape)} sizes, but {entry.name} has {grid.ndim} axes "
                f"({', '.join(grid.names)}); give one size per axis, as in {example}"
            )
        return entry.build(**parameters, shape=shape)
    except (ValueError, TypeError) as error:
        raise Failure(error) from error
    except MemoryError as error:
        raise Failure(error, 6) from error


@contextlib.contextmanager
def _one_line_warnings() -> Iterator[None]:
    """Show warnings as one line each, without the source line that Python adds.

    JAX repeats a warning about its cache for every program. Only the first one is shown.
    """
    from hjbjax.solvers import compile_cache

    faults: set[str] = set()

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        fault, said = compile_cache.fault_in(" ".join(str(message).split()))
        if fault not in faults:
            say(f"warning: {said}")
        if fault is not None:
            faults.add(fault)

    with warnings.catch_warnings():
        # always, because by default a warning is shown once per line of code, and PYTHONWARNINGS may change that
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield


# ------------------------------------------------------------------------------------- solve and write


def _given(options: dict[str, Any]) -> dict[str, Any]:
    """The arguments of ``solve`` for the given options."""
    import hjbjax as hjb

    # leave out options that were not given, so that the defaults of solve apply
    given = {key: value for key, value in options.items() if value is not None and value is not False}
    for key, table in (("method", METHODS), ("scheme", SCHEMES)):
        if key in given:
            given[key] = getattr(hjb, table[given[key]])()
    return given


def _estimate(problem: "Problem", grid: "Grid", options: dict[str, Any], *, as_json: bool) -> None:
    """Show an estimate of the solve; exit code 6 if it does not fit."""
    import hjbjax as hjb

    asked = {key: value for key, value in _given(options).items() if key in ("method", "scheme", "tol")}
    with _one_line_error((ValueError, TypeError), 2), _one_line_warnings():
        found = hjb.estimate(problem, grid, **asked)
    print_text(json.dumps(dataclasses.asdict(found)) if as_json else str(found))
    if not found.fits:
        what = "the free memory" if found.numbered else "32-bit indices"
        raise Failure(f"the solve does not fit into {what}", 6)


def _solve(problem: "Problem", grid: "Grid", options: dict[str, Any]) -> "Solution":
    """The solution, converged or not; errors of the solver give one line and an exit code."""
    import jax

    import hjbjax as hjb
    from hjbjax.solvers.memory import is_exhausted

    given = _given(options)
    try:
        # throw=False, so that a result that has not converged is saved and drawn as well; the exit code shows it
        return hjb.solve(problem, grid, throw=False, **given)
    except (ValueError, TypeError, FileExistsError) as error:
        raise Failure(error) from error
    except hjb.FileError as error:
        raise Failure(error, 5) from error
    except MemoryError as error:
        raise Failure(error, 6) from error
    except jax.errors.JaxRuntimeError as error:  # XLA has one type for all errors, and a code in the text
        raise Failure(error, 6 if is_exhausted(error) else 4) from error


def _write(
    entry: "Entry",
    parameters: dict[str, Any],
    problem: "Problem",
    solution: "Solution",
    staging: Path,
    out: Path,
    force: bool,
) -> tuple[list[Path], "Trajectory | None"]:
    """Draw a solution and write all files into a folder, or into a new folder if this one can no longer be written.

    Returns:
      The files, and the trajectory if there is one.

    Raises:
      Failure: a file could not be written.
    """
    from hjbjax.cli import run_folder

    made: list[str] = []
    path, published = None, False
    start = entry.initial_state(len(solution.grid.state_axes))
    finish = None if entry.finish is None else entry.finish(**parameters)
    loop: dict[str, Any] = {"start": start, "mode": entry.mode, "duration": entry.duration, "finish": finish}
    try:
        try:
            for file, drawn in run_folder.make(problem, solution, staging, **loop):  # each file is complete on return
                made.append(file)
                path = drawn
        finally:  # keep the complete files
            run_folder.publish(staging, out, made, force)
            published = bool(made)
    except OSError as error:
        reason = run_folder.reason_of(error, staging, out)
        if published:
            raise Failure(f"{reason}; written: {', '.join(text_of(out / file) for file in made)}", 5) from error
        kept = run_folder.rescue(out, lambda folder: run_folder.copy(solution, staging, folder))
        raise Failure(f"the results could not be written: {reason}; {kept}", 5) from error
    return [out / file for file in made], path


@main.command(short_help="Show all ready problems on a page.")
@click.option("--out", type=Place(), required=True, help="Folder of the page index.html.")
@click.option("--only", multiple=True, type=Name("problem", catalogue), help="Only this problem; can be repeated.")
@click.option("--force", is_flag=True, help="Replace an existing page.")
@click.option("--no-cache", is_flag=True, help="Do not store compiled programs in the user's cache folder.")
def gallery(out: Path, only: tuple[str, ...], force: bool, no_cache: bool) -> None:
    """Solve every ready problem on a small grid and write one page with plots, numbers and errors."""
    known = catalogue()
    check_jax()
    from hjbjax.cli import gallery as pages
    from hjbjax.cli import run_folder
    from hjbjax.solvers import compile_cache

    with _one_line_error(OSError, 2, "--out: "):
        pages.check_page_folder(out, force)
    cards: list[pages.Card] = []
    with contextlib.ExitStack() as stack:
        stack.enter_context(interrupts.raising_interrupts())
        with _one_line_error(OSError, 2, "--out: "):
            staging = stack.enter_context(run_folder.staging(out))
        stack.enter_context(_one_line_warnings())
        stack.enter_context(interruptible())
        if not no_cache:
            compile_cache.keep_for_the_command()
        names = [name for name in known if name in only or not only]
        try:
            for number, name in enumerate(names, 1):
                line = f"{number:>2}/{len(names)}  {name:<20}  "
                print_text(line, newline=False)
                cards.append(pages.card(known[name]))
                # on a terminal the progress of the solve has overwritten the line
                print_text((f"\r{line}" if streams.is_terminal(sys.stdout) else "") + cards[-1].status)
        finally:  # keep the finished cards, even after an interrupt
            if cards:
                _publish_page(cards, staging, out, force)
    print_text(f"wrote {text_of(out / pages.PAGE)}")
    if failed := [card.name for card in cards if card.status != "CONVERGED"]:
        raise Failure(f"not converged: {', '.join(failed)}", 3)


def _publish_page(cards: "list[Card]", staging: Path, out: Path, force: bool) -> None:
    """Write the page of the cards into a folder, or into a new folder if this one can no longer be written."""
    from hjbjax.cli import gallery as pages
    from hjbjax.cli import run_folder

    try:
        pages.publish_page(cards, staging, out, force)
    except OSError as error:
        kept = run_folder.rescue(out, lambda folder: pages.write_page(cards, folder))
        reason = run_folder.reason_of(error, staging, out)
        raise Failure(f"the page could not be written: {reason}; {kept}", 5) from error


@main.command(short_help="Check versions and devices.")
def doctor() -> None:
    """Check versions, devices, float64, a tiny solve, memory, pictures and the current folder."""
    from hjbjax.cli.doctor import examine

    failed = 0
    for name, well, found in examine():
        print_text(f"{'ok  ' if well else 'FAIL'}  {name:<10}  {found}")
        failed += not well
    if failed:
        raise Failure(f"{failed} of the checks failed", 1)
