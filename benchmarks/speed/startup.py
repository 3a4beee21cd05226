"""From process start to pictures: ``hjbjax solve double-integrator`` in a process of its own.

``cold`` compiles everything, by ``--no-cache``; ``cached`` finds what an earlier process left in the user's folder for
caches, here one of the benchmark's own.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import click

from benchmarks.harness import thresholds
from benchmarks.harness.report import RESULTS, attempt, publish, table

ROOT = Path(__file__).parents[2]
COLUMNS = ("start", "seconds", "fastest", "cpu_seconds", "repeats", "pictures", "status")
HOMES = ("XDG_CACHE_HOME", "HOME", "LOCALAPPDATA")  # where a user's caches are, on one platform or another


def one(problem: str, shape: str | None, cache: str | None) -> tuple[float, float, int]:
    """Seconds of the process, the processor's seconds on all cores, and the pictures it left."""
    kept = {key: value for key, value in os.environ.items() if "COMPILATION_CACHE" not in key}
    environment = kept | {"MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)}
    if cache is not None:
        environment |= dict.fromkeys(HOMES, cache)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "hjbjax", "solve", problem, "--out", str(out)]
        command += [] if shape is None else ["--shape", shape]
        command += ["--no-cache"] if cache is None else []
        began, before = time.perf_counter(), os.times()
        subprocess.run(command, env=environment, check=True, capture_output=True)
        seconds, after = time.perf_counter() - began, os.times()
        busy = after.children_user + after.children_system - before.children_user - before.children_system
        return seconds, busy, len(list(out.glob("*.png")))


def measure(problem: str, shape: str | None, repeats: int) -> list[dict[str, Any]]:
    """Two rows; cold and cached processes take turns, after one that fills the cache."""
    with tempfile.TemporaryDirectory() as cache:
        filling, *_ = one(problem, shape, cache)
        found: dict[str, list[tuple[float, float, int]]] = {"cold": [], "cached": []}
        for _ in range(repeats):
            found["cold"].append(one(problem, shape, None))
            found["cached"].append(one(problem, shape, cache))
    rows = []
    for start, runs in found.items():
        seconds, busy, pictures = zip(*runs, strict=True)
        row = {"start": start, "seconds": median(seconds), "fastest": min(seconds), "repeats": repeats}
        row["cpu_seconds"] = median(busy)
        rows.append(row | {"pictures": min(pictures), "filling_seconds": filling, "status": "DONE"})
    return rows


@click.command()
@click.option("--quick", is_flag=True, help="A small grid, one round.")
@click.option("--problem", default="double-integrator", show_default=True, help="A ready problem of the zoo.")
@click.option("--repeats", type=click.IntRange(1), default=None, help="Rounds; 3 if not given, quick 1.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Folder of the files.")
def command(quick: bool, problem: str, repeats: int | None, out: Path) -> None:
    """From process start to pictures, cold and with the compile cache."""
    about = {"benchmark": "startup", "problem": problem, "dtype": "float64", "shape": "15x15" if quick else "default"}
    shape = about["shape"] if quick else None
    rows = attempt(lambda: measure(problem, shape, repeats or (1 if quick else 3)), about)
    click.echo(table(rows, COLUMNS))
    figures = {}
    if not quick and problem == "double-integrator" and rows[0]["status"] == "DONE":
        figures = {f"{row['start']} start": row["seconds"] for row in rows}
    rows += thresholds.announced(figures, "startup")
    publish(out, "startup", rows)
