"""The command ``hjbjax``: solve a ready problem, list them, look at the machine.

``solve`` writes ``solution.npz``, ``value.png``, ``policy.png`` and ``trajectory.png`` into a folder and prints
one screen. What can be refused is refused in one line before anything is compiled. Files are made in a hidden
folder beside the old ones and moved over them when they are whole.

Exit codes: 0 done, 1 a check of ``doctor`` failed, 2 usage, 3 not converged, 4 diverged or not finite, 5 file,
6 memory, 130 interrupted (Ctrl-C or SIGTERM).
"""

import contextlib
import difflib
import json
import math
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import click

from hjbjax._version import __version__

FILES = ("solution.npz", "value.png", "policy.png", "trajectory.png")
CODES = {"CONVERGED": 0, "DIVERGED": 4, "NONFINITE": 4, "INTERRUPTED": 130}  # any other status: 3, not converged
METHODS = {"value-iteration": "ValueIteration", "policy-iteration": "PolicyIteration"}
SCHEMES = {"upwind": "Upwind", "limited": "Limited", "eno2": "Eno2", "weno5": "Weno5"}
PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "diffrax", "optax", "matplotlib", "tqdm", "click")


class Failure(click.ClickException):
    """A refusal or a fault: one line and an exit code."""

    def __init__(self, message: Any, exit_code: int = 2):
        super().__init__(" ".join(str(message).split()))
        self.exit_code = exit_code  # type: ignore[misc]


class OneLineGroup(click.Group):
    """A group whose errors are one line on stderr, without the usage block."""

    def main(
        self,
        args: Any = None,
        prog_name: Any = None,
        complete_var: Any = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        """Runs a command and, unless ``standalone_mode`` is off, ends the process with its exit code."""
        if not standalone_mode:
            return super().main(args, prog_name, complete_var, False, **extra)
        try:
            code = super().main(args, prog_name, complete_var, False, **extra)
        except click.ClickException as error:
            click.echo(f"hjbjax: {' '.join(error.format_message().split())}", err=True)
            code = error.exit_code
        except (click.Abort, KeyboardInterrupt):
            click.echo("hjbjax: interrupted", err=True)
            code = 130
        if code == 130 and sys.stdout is sys.__stdout__:  # a process of our own
            for stream in filter(None, (sys.stdout, sys.stderr)):
                stream.flush()
            os._exit(code)  # JAX may still be at work, which the usual exit waits for, or crashes on
        sys.exit(code if isinstance(code, int) else 0)


class Number(click.ParamType):
    """A finite number above zero; click's own types let NaN and infinity through."""

    name = "number"

    def __init__(self, kind: type = float):
        self.kind = kind

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """The number, or a usage error."""
        number = _finite(str(value), self.kind)
        if number is None or number <= 0:
            self.fail(f"got {value!r}, wanted a {'whole' if self.kind is int else 'finite'} number > 0", param, ctx)
        return number


class Shape(click.ParamType):
    """Numbers of nodes with an x between them, as in 200x201."""

    name = "NxN"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, ...]:
        """One integer an axis, or a usage error."""
        counts = [_finite(part, int) for part in str(value).lower().split("x")]
        if any(count is None or count < 2 for count in counts):
            self.fail(f"got {value!r}, wanted whole numbers of at least 2, one an axis, as in 200x201", param, ctx)
        return tuple(counts)


class Name(click.ParamType):
    """One of some names; an unknown one gets the list and the nearest."""

    name = "name"

    def __init__(self, what: str, allowed: Callable[[], Iterable[str]]):
        self.what, self.allowed = what, allowed

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """The name, or a usage error."""
        if value not in (names := list(self.allowed())):
            self.fail(_unknown(self.what, value, names), param, ctx)
        return value


def _finite(text: str, kind: type) -> Any:
    """``text`` as a finite number of a kind; ``None`` if it is none."""
    try:
        number = kind(text)
    except ValueError:
        return None
    return number if kind is int or math.isfinite(number) else None


def _unknown(what: str, got: str, allowed: Iterable[str]) -> str:
    names = list(allowed)
    near = difflib.get_close_matches(got.lower().replace("_", "-"), names, 1) or difflib.get_close_matches(
        got, names, 1
    )
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"unknown {what} {got!r}; there are {', '.join(names)}{hint}"


def _systems() -> Iterable[str]:
    from hjbjax import zoo

    return zoo.catalogue


def _offered(table: dict[str, str]) -> Callable[[], Iterable[str]]:
    """The names in a table of choices that this version has."""

    def names() -> Iterable[str]:
        import hjbjax

        return [name for name, choice in table.items() if hasattr(hjbjax, choice)]

    return names


@click.group(cls=OneLineGroup, invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="hjbjax")
@click.pass_context
def main(context: click.Context) -> None:
    """Hamilton-Jacobi-Bellman and Isaacs equations on grids."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


@main.command("list")
@click.argument("name", required=False, type=Name("problem", _systems))
def list_problems(name: str | None) -> None:
    """List the ready problems; of one NAME, its parameters."""
    from hjbjax import zoo

    if name is None:
        width = max(map(len, zoo.catalogue))
        for entry in zoo.catalogue.values():
            click.echo(f"{entry.name:<{width}}  {entry.summary}")
        return
    entry = zoo.catalogue[name]
    click.echo(f"{entry.name}: {entry.summary}")
    for key, default in entry.parameters.items():
        if key != "shape":
            click.echo(f"  --set {key}={_written(default)}")


@main.command()
@click.argument("name", type=Name("problem", _systems))
@click.option("--shape", type=Shape(), help="Nodes along each axis, as in 200x201.")
@click.option("--set", "settings", multiple=True, metavar="NAME=VALUE", help="A parameter; may be given several times.")
@click.option("--method", type=Name("method", _offered(METHODS)), help=f"{' or '.join(METHODS)}; chosen if not given.")
@click.option("--scheme", type=Name("scheme", _offered(SCHEMES)), help="The discretisation; upwind if not given.")
@click.option("--tol", type=Number(), help="Certified bound on the algebraic error, in cost units.")
@click.option("--max-steps", type=Number(int), help="Stop after so many steps.")
@click.option("--time-limit", type=Number(), help="Stop after so many seconds.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the results; the problem's name if not given.")
@click.option("--force", is_flag=True, help="Replace results that are there already.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of the screen.")
def solve(
    name: str, shape: Any, settings: tuple[str, ...], out: Path | None, force: bool, as_json: bool, **options: Any
) -> None:
    """Solve the ready problem NAME; write solution.npz, value.png, policy.png and trajectory.png."""
    from hjbjax import results, zoo

    entry = zoo.catalogue[name]
    parameters = _parameters(entry, settings)
    out = Path(name) if out is None else out
    with _failing(OSError, 2, "--out: "):
        results.check_folder(out, force)
    problem, grid = _build(entry, parameters, shape)
    path, made = None, []
    with contextlib.ExitStack() as stack:
        with _failing(OSError, 2, "--out: "):
            staging = stack.enter_context(results.staging(out))
        stack.enter_context(_one_line_warnings())
        stack.enter_context(_interruptible())
        solution = _solve(problem, grid, options)
        with _failing(OSError, 5, "the results could not be written: "):
            try:
                start = entry.initial_state(grid.ndim)
                for file, drawn in results.make(problem, solution, staging, start=start, duration=entry.duration):
                    made.append(file)
                    path = drawn
            finally:  # what is whole is kept
                results.publish(staging, out, made, force)
    files = [out / file for file in made]
    off = None
    with contextlib.suppress(ValueError):  # no answer is known for these parameters
        off = None if entry.exact is None else results.difference(entry.exact(**parameters), solution)
    if as_json:
        about = {"problem": name, "parameters": parameters, "exact_difference": off}
        click.echo(json.dumps(results.report(solution, path, files, **about)))
    else:
        click.echo(str(solution))
        if off is not None:
            click.echo(f"off the exact answer by at most {off:.3g} on the inner half of the box")
        if path is not None:
            click.echo(f"path: {path}")
        click.echo(f"wrote {', '.join(map(str, files))}")
    if code := CODES.get(solution.status.name, 3):
        raise Failure(f"{solution.status.name}: {solution.message or solution.status.message}", code)


@contextlib.contextmanager
def _failing(kind: type[Exception], exit_code: int, prefix: str = "") -> Iterator[None]:
    """An error of a kind as one line and an exit code."""
    try:
        yield
    except kind as error:
        raise Failure(f"{prefix}{error}", exit_code) from error


# ------------------------------------------------------------------------------------- before the solve


def _parameters(entry: Any, settings: tuple[str, ...]) -> dict[str, Any]:
    """The values of --set, each of the kind of its default."""
    defaults = {key: value for key, value in entry.parameters.items() if key != "shape"}
    chosen: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = (part.strip() for part in setting.partition("="))
        if not equals or not key or not text:
            raise Failure(f"--set: got {setting!r}, wanted NAME=VALUE, as in --set {next(iter(defaults))}=2")
        if key == "shape":
            raise Failure("--set: the shape has an option of its own: --shape 200x201")
        if key not in defaults:
            raise Failure("--set: " + _unknown(f"parameter of {entry.name}", key, defaults))
        if key in chosen:
            raise Failure(f"--set: {key} is given twice")
        chosen[key] = _value_of(key, text, defaults[key])
    return chosen


def _value_of(key: str, text: str, default: Any) -> Any:
    if isinstance(default, bool):
        if text.lower() not in ("true", "false"):
            raise Failure(f"--set: got {key}={text}, wanted true or false")
        return text.lower() == "true"
    parts = text.split(",")
    kind = int if isinstance(default, int) else float
    numbers = tuple(_finite(part, kind) for part in parts)
    if default is None and len(parts) == 1 and (whole := _finite(text, int)) is not None:
        numbers = (whole,)  # what has no default may be a count
    if None in numbers or (isinstance(default, tuple) and len(parts) != len(default)):
        wanted = "a whole number" if kind is int else "a finite number"
        if isinstance(default, tuple):
            wanted = f"{len(default)} finite numbers with commas between them"
        raise Failure(f"--set: got {key}={text}, wanted {wanted}")
    if len(parts) > 1 and isinstance(default, (int, float)):
        raise Failure(f"--set: got {key}={text}, wanted one number")
    return numbers if len(parts) > 1 else numbers[0]


def _written(value: Any) -> str:
    """A parameter's value as --set takes it."""
    if isinstance(value, bool):
        return str(value).lower()
    return "..." if value is None else ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _build(entry: Any, parameters: dict[str, Any], shape: tuple[int, ...] | None) -> tuple[Any, Any]:
    try:
        problem, grid = entry.build(**parameters)
        if shape is None:
            return problem, grid
        if len(shape) != grid.ndim:
            example = "x".join(map(str, grid.shape))
            raise ValueError(
                f"--shape: got {len(shape)} sizes, but {entry.name} has {grid.ndim} axes "
                f"({', '.join(grid.names)}); give one size an axis, as in {example}"
            )
        return entry.build(**parameters, shape=shape)
    except (ValueError, TypeError) as error:
        raise Failure(error) from error
    except MemoryError as error:
        raise Failure(error, 6) from error


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C and SIGTERM alike: the solver keeps what it has for either.

    A shell starts background jobs with SIGINT ignored, so SIGTERM must not go by way of SIGINT.
    """

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    try:
        old = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not the main thread: signals are another's business
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, old)


@contextlib.contextmanager
def _one_line_warnings() -> Iterator[None]:
    def show(message: Any, *_: Any, **__: Any) -> None:
        click.echo(f"hjbjax: warning: {' '.join(str(message).split())}", err=True)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield


# ------------------------------------------------------------------------------------- solve and write


def _solve(problem: Any, grid: Any, options: dict[str, Any]) -> Any:
    import jax

    import hjbjax as hjb

    given = {key: value for key, value in options.items() if value is not None}
    for key, table in (("method", METHODS), ("scheme", SCHEMES)):
        if key in given:
            given[key] = getattr(hjb, table[given[key]])()
    try:
        return hjb.solve(problem, grid, throw=False, **given)
    except (ValueError, TypeError) as error:
        raise Failure(error) from error
    except MemoryError as error:
        raise Failure(error, 6) from error
    except jax.errors.JaxRuntimeError as error:
        raise Failure(error, 6 if "RESOURCE_EXHAUSTED" in str(error) else 4) from error


@main.command()
def doctor() -> None:
    """Check versions, devices, float64, a tiny solve, memory, pictures and the current folder."""
    from hjbjax.doctor import examine

    failed = 0
    for name, well, found in examine():
        click.echo(f"{'ok  ' if well else 'FAIL'}  {name:<10}  {found}")
        failed += not well
    if failed:
        raise Failure(f"{failed} of the checks failed", 1)
