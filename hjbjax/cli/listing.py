"""The output of ``hjbjax list``: all ready problems, or the details of one."""

import inspect
import re
import textwrap
from collections.abc import Iterator

import numpy as np

from hjbjax import zoo
from hjbjax.problem.grid import Grid
from hjbjax.problem.modes import Modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pushes import Push
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Simplex
from hjbjax.zoo.entry import Entry

WIDTH = 100  # columns; narrower terminals wrap the lines
ARGUMENT = re.compile(r"  (\w+): (.*)")  # an entry of Args in a docstring, whose continuation lines are indented more


def overview() -> Iterator[str]:
    """Two lines per problem: name and summary; states with units, grid, and a note if an exact answer is known."""
    width = max(map(len, zoo.catalogue))
    for entry in zoo.catalogue.values():
        problem, grid = entry.build()
        yield f"{entry.name:<{width}}  {entry.summary}"
        answer = "" if entry.exact is None else "; exact answer known"
        modes = "" if problem.modes is None else f" in each of the modes {', '.join(problem.modes.names)}"
        yield f"{'':<{width}}  {', '.join(_with_units(grid.names, grid.units))}; {_sizes(grid)} nodes{modes}{answer}"


def details(entry: Entry) -> Iterator[str]:
    """Summary, states, actions, grid and exact answer of one problem, and its parameters with defaults and meanings."""
    problem, grid = entry.build()
    yield f"{entry.name}: {entry.summary}"
    yield ""
    for label, text in _facts(entry, problem, grid):
        yield from textwrap.wrap(f"{label:<14}{text}", WIDTH, initial_indent="  ", subsequent_indent=" " * 16)
    meanings, defaults = _meanings(entry), entry.parameters
    settings = {key: f"--set {key}={_as_setting(default)}" for key, default in defaults.items() if key != "shape"}
    settings["shape"] = f"--shape {_sizes(grid, 'x')}"
    width = max(map(len, settings.values()))
    yield ""
    for key, setting in settings.items():
        # never wrap a default, so that it can be copied
        indent = f"  {setting:<{width}}  "
        lines = textwrap.wrap(meanings.get(key, ""), WIDTH - len(indent)) or [""]
        yield (indent + lines[0]).rstrip()
        yield from (" " * len(indent) + line for line in lines[1:])


def _facts(entry: Entry, problem: Problem, grid: Grid) -> Iterator[tuple[str, str]]:
    """The facts of a problem, as pairs of label and text."""
    ends = zip(_with_units(grid.names, grid.units), grid.lo, grid.hi, grid.periodic, strict=True)
    states = (f"{name} from {lo:.4g} to {hi:.4g}{', periodic' * bool(round_)}" for name, lo, hi, round_ in ends)
    yield "states", "; ".join(states)
    if problem.modes is not None:
        yield "modes", f"{', '.join(problem.modes.names)}; {_changes(problem.modes)}"
    if problem.pushes:
        yield "pushes", ", ".join(_direction(push, grid) for push in problem.pushes)
    yield "controls", _actions(problem.controls, problem.control_names, problem.control_units)
    if problem.disturbances is not None:
        yield "disturbances", _actions(problem.disturbances, (), ())
    yield "grid", f"{_sizes(grid)} nodes"
    yield "ends by", "a target" if problem.target is not None else "nothing: the horizon is infinite"
    yield "exact answer", "none is known" if entry.exact is None else "known, and compared with"


def _changes(modes: Modes) -> str:
    """The kinds of changes of the mode, in words."""
    words = {"at random": modes.rates, "by choice": modes.switching_cost}
    return "changed " + " and ".join(word for word, table in words.items() if table is not None)


def _direction(push: Push, grid: Grid) -> str:
    """The direction of a push in words."""
    axis, step = push.step
    return f"{grid.names[axis]} {'up' if step > 0 else 'down'}"


def _actions(admissible: AdmissibleSet | None, names: tuple[str, ...], units: tuple[str, ...]) -> str:
    """The admissible actions in words."""
    if admissible is None:
        return "none"
    count = admissible.dim
    names = tuple(names) or tuple("u" if count == 1 else f"u{i + 1}" for i in range(count))
    called = _with_units(names, tuple(units) or ("",) * count)
    if isinstance(admissible, Box):
        bounds = zip(called, np.ravel(admissible.lo), np.ravel(admissible.hi), strict=True)
        return "; ".join(f"{name} from {lo:.4g} to {hi:.4g}" for name, lo, hi in bounds)
    if isinstance(admissible, Ball):
        return f"({', '.join(called)}) of length {float(admissible.radius):.4g} at most"
    if isinstance(admissible, Simplex):
        word = "of sum at most" if admissible.at_most else "of sum"
        return f"({', '.join(called)}) ≥ 0 {word} {float(admissible.total):.4g}"
    return f"({', '.join(called)}), one of a finite number"


def _with_units(names: tuple[str, ...], units: tuple[str, ...]) -> list[str]:
    """Names followed by their units, as in "angle [rad]"."""
    return [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]


def _sizes(grid: Grid, between: str = " x ") -> str:
    """The number of nodes per axis, as in "41 x 81"."""
    return between.join(map(str, grid.shape))


def _meanings(entry: Entry) -> dict[str, str]:
    """The meanings of the parameters, from the section Args of the docstring."""
    found: dict[str, str] = {}
    key = None
    for line in (inspect.getdoc(entry.build) or "").partition("Args:\n")[2].splitlines():
        if match := ARGUMENT.fullmatch(line):
            key, text = match.groups()
            found[key] = text.replace("``", "")
        elif key is not None and line.startswith("    "):
            found[key] += " " + line.strip().replace("``", "")
        else:  # the next section
            break
    return found


def _as_setting(value: object) -> str:
    """A parameter's value in the form that --set accepts; three dots if it depends on other parameters."""
    if isinstance(value, bool):
        return str(value).lower()
    return "..." if value is None else ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
