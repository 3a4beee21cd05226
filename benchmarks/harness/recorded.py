"""Markdown tables of every recorded row, one section per benchmark, made from ``benchmarks/results``.

Nothing is measured here. ``quoted`` selects the figures for the documentation from the same rows.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from benchmarks.harness.report import RESULTS

SHARED = ("benchmark", "versions", "date", "device", "cores", "load", "status")  # written once, above the table
LONGEST = 60  # rows of a table; the JSON file contains the others

Row = dict[str, Any]


def cell(value: Any) -> str:
    """A figure as a table shows it: three digits, shapes with crosses, a dash if missing."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, list):
        return " x ".join(map(cell, value)) if len(value) < 7 else f"{len(value)} numbers"
    return str(value).replace("|", "\\|")


def section(name: str, rows: Sequence[Row]) -> list[str]:
    """The table of one benchmark, with the machine and the versions above it."""
    first = rows[0]
    versions = ", ".join(f"{package} {number}" for package, number in first.get("versions", {}).items())
    dates = sorted({row["date"][:10] for row in rows if row.get("date")})
    columns = [key for key in dict.fromkeys(key for row in rows for key in row) if key not in SHARED]
    columns = [key for key in columns if not any(isinstance(row.get(key), dict) for row in rows)]
    failed = sorted({row["status"] for row in rows if row.get("status") not in (None, "CONVERGED", "OK", "MET")})
    return [
        f"## {name}",
        "",
        f"`python -m benchmarks {name}`, {' to '.join(dict.fromkeys((dates[0], dates[-1])))}, on "
        f"{first.get('device')} with {first.get('cores')} cores; {versions}."
        + (f" Also rows that ended {', '.join(failed)}." if failed else ""),
        "",
        "| " + " | ".join(key.replace("_", " ") for key in columns) + " |",
        "|" + "---|" * len(columns),
        *("| " + " | ".join(cell(row.get(key)) for key in columns) + " |" for row in rows[:LONGEST]),
        "",
        *(
            [f"And {len(rows) - LONGEST} rows more in `benchmarks/results/{name}.json`.", ""]
            if len(rows) > LONGEST
            else []
        ),
    ]


def markdown(folder: Path = RESULTS) -> str:
    """The tables of all recorded benchmarks, ordered by name."""
    lines: list[str] = []
    for path in sorted(folder.glob("*.json")):
        lines += section(path.stem, json.loads(path.read_text(encoding="utf-8")))
    return "\n".join(lines)


def write(path: Path) -> None:
    """Write the tables to a file, which is not touched if they have not changed, so a second build has less to do."""
    text = markdown()
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


@click.command()
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Folder of the rows.")
def command(out: Path) -> None:
    """Print every recorded row as Markdown tables."""
    click.echo(markdown(out))
