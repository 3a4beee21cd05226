"""One-line messages of the command, and the types of its arguments: numbers, shapes, names."""

import contextlib
import difflib
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import click

from hjbjax.cli import interrupts
from hjbjax.problem import streams

if TYPE_CHECKING:
    from hjbjax.zoo.entry import Entry

N = TypeVar("N", int, float)
UNREAD = 141  # 128 + SIGPIPE, by convention of shells the exit code of a program whose reader has closed the pipe


class Failure(click.ClickException):
    """An error with one line and an exit code."""

    def __init__(self, message: str | Exception, exit_code: int = 2):
        super().__init__(str(message))
        self.exit_code = exit_code  # type: ignore[misc]


class OneLineGroup(click.Group):
    """A group whose errors are one line on stderr, without the usage block."""

    def make_context(self, *arguments: Any, **options: Any) -> click.Context:
        """Parse the arguments of the group, which may print its help."""
        with _own_endings():
            return super().make_context(*arguments, **options)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command of the group."""
        with _own_endings():
            return super().invoke(ctx)

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        """Run a command, and end the process with its exit code unless ``standalone_mode`` is off."""
        if not standalone_mode:
            return super().main(args, prog_name, complete_var, False, **extra)
        try:
            # in standalone mode click would print a usage block and end the process itself
            code = super().main(args, prog_name, complete_var, False, **extra)
        except _Unread:
            code = UNREAD
            streams.let_go(sys.stdout)
        except click.ClickException as error:
            say(_for_a_parameter(error) or error.format_message())
            code = error.exit_code
        except (click.Abort, KeyboardInterrupt):
            say("interrupted", after="\n" * streams.is_terminal(sys.stderr))  # ends the line with ^C
            code = interrupts.CODE
        except OSError as error:  # standard output on a full disk; the commands handle errors of their own files
            code = 5
            streams.let_go(sys.stdout)
            say(f"the output could not be written: {error.strerror or error}")
        code = code if isinstance(code, int) else 0  # a command that ends well returns None
        if (code == interrupts.CODE or _is_joined()) and sys.stdout is sys.__stdout__:  # not inside another program
            # os._exit does not flush
            for stream in (sys.stdout, sys.stderr):
                streams.Expendable(stream).flush()
            os._exit(code)  # JAX may still be at work, and a normal exit would wait for it or crash
        streams.flush_or_let_go(sys.stderr)  # otherwise the exit code is 120 on a full disk
        sys.exit(code)


def _is_joined() -> bool:
    """True in a process of a launch that failed before it left the launch; a normal exit would wait for the others."""
    if "jax" not in sys.modules:
        return False
    try:
        from jax import distributed
    except ImportError:  # JAX could not start
        return False
    return distributed.is_initialized()


class _Unread(click.ClickException):
    """The reader of standard output has closed the pipe, as ``head`` does."""


@contextlib.contextmanager
def _own_endings() -> Iterator[None]:
    """Replace two exceptions that click would handle badly, with an empty line or with exit code 1."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise click.Abort from error
    except BrokenPipeError as error:
        raise _Unread("") from error


def _for_a_parameter(error: click.ClickException) -> str | None:
    """The message if a parameter of a problem was passed as an option of the command; None for other errors."""
    if not isinstance(error, click.NoSuchOption):
        return None
    name = error.option_name.lstrip("-").replace("-", "_")
    try:
        known = any(name in entry.parameters for entry in catalogue().values())
    except Failure:  # JAX cannot start
        return None
    if not known:
        return None
    return f"No such option '{error.option_name}'. Set a parameter of a problem with --set, as in --set {name}=VALUE."


def say(line: str, *, after: str = "") -> None:
    """Write one line on standard error, if it is open."""
    stream = streams.Expendable(sys.stderr)
    # join the lines of an exception's text, because scripts rely on one line
    stream.write(f"{after}{streams.encodable(streams.plain(f'hjbjax: {line}'), sys.stderr)}\n")
    stream.flush()


def print_text(text: str, *, newline: bool = True) -> None:
    """Write a text on standard output, if it is open, in the characters of its encoding.

    Raises:
      OSError: the disk is full, or the reader has closed the pipe.
    """
    if streams.is_open(sys.stdout):
        click.echo(streams.encodable(text), nl=newline)


def text_of(path: str | os.PathLike[str]) -> str:
    """A path as text of one line, with unprintable characters escaped."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in os.fspath(path))


class Place(click.Path):
    """A path; null bytes and empty paths are usage errors."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path."""
        if "\0" in os.fspath(value):
            self.fail(f"{os.fspath(value)!r} contains a null byte, which is not allowed in a path", param, ctx)
        if not os.fspath(value):  # from an unset variable in a script; "." is the current folder
            self.fail("got an empty path, wanted a name", param, ctx)
        return super().convert(value, param, ctx)


class Number(click.ParamType):
    """A finite number above zero; click's types accept NaN and infinity."""

    name = "number"

    def __init__(self, kind: type[float] = float):
        self.kind = kind

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, or a usage error."""
        number = finite(str(value), self.kind)  # click also converts defaults, which are numbers
        if number is None or number <= 0:
            self.fail(f"got {value!r}, wanted a {'whole' if self.kind is int else 'finite'} number > 0", param, ctx)
        return number


class Shape(click.ParamType):
    """Numbers of nodes or of devices separated by x, as in 200x201."""

    name = "NxN"

    def __init__(self, least: int = 2):
        self.least, self.example = least, "200x201" if least > 1 else "4x2"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        """One integer per axis, or a usage error."""
        counts = [finite(part, int) for part in str(value).lower().split("x")]
        if any(count is None or count < self.least for count in counts):
            wanted = f"whole numbers of at least {self.least}, one per axis, as in {self.example}"
            self.fail(f"got {value!r}, wanted {wanted}", param, ctx)
        return tuple(count for count in counts if count is not None)  # the filter is for the type checker


class Name(click.ParamType):
    """One of several names; the error for an unknown name lists them and suggests the closest."""

    name = "name"

    def __init__(self, what: str, allowed: Callable[[], Iterable[str]]):
        self.what, self.allowed = what, allowed

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name, or a usage error."""
        if (word := str(value)) not in (names := list(self.allowed())):
            self.fail(unknown(self.what, word, names), param, ctx)
        return word


def finite(text: str, kind: type[N]) -> N | None:
    """Parse ``text`` as a finite number of the given kind; ``None`` if it is not one."""
    try:
        number = kind(text)
    except ValueError:
        return None
    # an integer of 400 digits is finite, but math.isfinite would overflow when it converts it to a float
    return number if kind is int or math.isfinite(number) else None


def unknown(what: str, got: str, allowed: Iterable[str]) -> str:
    """The message for an unknown name, with the allowed names and the closest one."""
    names = list(allowed)
    # first with hyphens, for names of problems in Python spelling; then unchanged, because parameters have underscores
    near = difflib.get_close_matches(got.lower().replace("_", "-"), names, 1) or difflib.get_close_matches(
        got, names, 1
    )
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"unknown {what} {got!r}; there are {', '.join(names)}{hint}"


def parameters_of(entry: "Entry", settings: tuple[str, ...]) -> dict[str, Any]:
    """Parse the values of --set, each to the type of its default."""
    defaults = {key: value for key, value in entry.parameters.items() if key != "shape"}
    chosen: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = (part.strip() for part in setting.partition("="))
        if not equals or not key or not text:
            raise Failure(f"--set: got {setting!r}, wanted NAME=VALUE, as in --set {next(iter(defaults))}=2")
        if key == "shape":
            raise Failure("--set: the shape has its own option, --shape 200x201")
        if key not in defaults:
            raise Failure("--set: " + unknown(f"parameter of {entry.name}", key, defaults))
        if key in chosen:
            raise Failure(f"--set: {key} was given twice")
        chosen[key] = _value_of(key, text, defaults[key])
    return chosen


def _value_of(key: str, text: str, default: object) -> bool | float | tuple[float, ...]:
    """Parse the text of one --set to the type of its default."""
    if isinstance(default, bool):  # before int, because bool is a subclass of int
        if text.lower() not in ("true", "false"):
            raise Failure(f"--set: got {key}={text}, wanted true or false")
        return text.lower() == "true"
    parts = text.split(",")
    kind = int if isinstance(default, int) else float
    numbers = tuple(finite(part, kind) for part in parts)
    if default is None and len(parts) == 1 and (whole := finite(text, int)) is not None:
        numbers = (whole,)  # a parameter without a default may be a count
    if None in numbers or (isinstance(default, tuple) and len(parts) != len(default)):
        wanted = "a whole number" if kind is int else "a finite number"
        if isinstance(default, tuple):
            wanted = f"{len(default)} finite numbers separated by commas"
        raise Failure(f"--set: got {key}={text}, wanted {wanted}")
    if len(parts) > 1 and isinstance(default, (int, float)):
        raise Failure(f"--set: got {key}={text}, wanted one number")
    known = cast(tuple[float, ...], numbers)  # None was handled above
    return known if len(parts) > 1 else known[0]


def catalogue() -> "dict[str, Entry]":
    """The ready problems by name; a function, so that the zoo is imported only when a name is checked.

    Raises:
      Failure: JAX cannot be imported.
    """
    with starting_jax():
        from hjbjax import zoo
    return zoo.catalogue


def check_jax() -> None:
    """Start JAX.

    Raises:
      Failure: JAX finds no device.
    """
    with starting_jax():
        import jax

        jax.devices()


@contextlib.contextmanager
def starting_jax() -> Iterator[None]:
    """Context in which JAX starts; a broken installation or a bad environment variable gives a one-line error.

    Raises:
      Failure: with JAX's reason.
    """
    try:
        yield
    except Exception as error:  # even AssertionError without a text, for JAX_PLATFORMS=cuda without CUDA
        platforms = os.environ.get("JAX_PLATFORMS")
        bare = type(error).__name__ + (f" with JAX_PLATFORMS={platforms!r}" if platforms else "")
        reason = " ".join(str(error).split()) or bare
        raise Failure(f"JAX cannot start: {reason}; 'hjbjax doctor' says more") from error


def names_of(table: dict[str, str]) -> Callable[[], Iterable[str]]:
    """The names in a table of choices that this version of the package has."""

    def names() -> Iterable[str]:
        import hjbjax

        return [name for name, choice in table.items() if hasattr(hjbjax, choice)]

    return names
