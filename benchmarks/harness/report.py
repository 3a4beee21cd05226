"""Reports of benchmarks: the environment of a measurement, tables, JSON files and one kind of picture.

A measurement is a flat dictionary; ``stamped`` adds the machine, the versions and the date to each.
"""

import datetime
import importlib.metadata
import importlib.util
import json
import math
import os
import platform
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from benchmarks.harness import charts
from hjbjax.cli import run_folder
from hjbjax.cli.command_line import Failure

RESULTS = charts.RESULTS
PACKAGES = ("jax", "numpy", "scipy", "hj-reachability", "quantecon", "numba", "mdpsolver", "scikit-fmm")


def threads() -> int:
    """The number of threads of XLA on a processor: one per core that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def environment() -> dict[str, Any]:
    """The machine, the versions and the date, for every row."""
    import jax

    import hjbjax

    versions = {"python": platform.python_version(), "hjbjax": hjbjax.__version__}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:  # this package is not installed
            continue
    device = jax.devices()[0]
    return {
        "device": device.platform if device.platform == "cpu" else device.device_kind,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,  # runnable processes at the end
        "versions": versions,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def stamped(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with the environment added to each; entries of a row take precedence."""
    common = environment()
    return [common | row for row in rows]


def table(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> str:
    """The columns of the rows as aligned text; numbers right-aligned, missing entries as a dash."""
    cells = [list(columns), *([_cell(row.get(column)) for column in columns] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    right = [any(_is_number(row.get(column)) for row in rows) for column in columns]
    lines = [
        "  ".join(
            f"{cell:{'>' if to_right else '<'}{width}}"
            for cell, width, to_right in zip(line, widths, right, strict=True)
        )
        for line in cells
    ]
    return "\n".join(line.rstrip() for line in lines)


def write_json(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write the rows as a JSON list, atomically; numbers that are not finite become null, because JSON lacks them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        temporary.write_text(json.dumps(_plain(list(rows)), indent=1, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


class Folder(click.Path):
    """A folder; checked to be writable before anything is measured."""

    def __init__(self) -> None:
        super().__init__(path_type=Path, file_okay=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path."""
        path = super().convert(value, param, ctx)
        try:
            run_folder.check_writable(path)
        except OSError as error:
            self.fail(str(error), param, ctx)
        return path


def put(out: Path, write: Callable[[Path], None]) -> None:
    """Call ``write`` with a folder, or with a new folder if the first one is no longer writable.

    Raises:
      Failure: the first folder is no longer writable; the message names the new one.
    """
    try:
        write(out)
    except OSError as error:
        raise Failure(f"{error}; {run_folder.rescue(out, write)}", 5) from error


def publish(out: Path, name: str, rows: Sequence[dict[str, Any]]) -> None:
    """Write the stamped rows to ``name``.json, and their pictures next to it if ``charts`` has some."""
    rows = stamped(rows)

    def write(folder: Path) -> None:
        write_json(folder / f"{name}.json", rows)
        charts.draw(folder, name, rows)

    put(out, write)
    click.echo(f"{len(rows)} rows in {out / name}.json{', the picture beside it' if name in charts.CHARTS else ''}")


def without(module: str) -> str | None:
    """The reason that a package cannot be measured, or ``None``."""
    if importlib.util.find_spec(module) is not None:
        return None
    return f"{module} is not installed (pip install '.[bench]')"


def attempt(measure: Callable[[], list[dict[str, Any]]], about: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of a measurement, or one row with the error: a benchmark records failures too."""
    try:
        return [about | row for row in measure()]
    except Exception as error:  # any error of a package or a solve is a result
        return [about | {"status": "FAILED", "reason": f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]}]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _cell(value: Any) -> str:
    if value is None or (_is_number(value) and math.isnan(value)):
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}"
    return " x ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
