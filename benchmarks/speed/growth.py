"""Seconds against nodes at a fixed tolerance: a certified solve on finer and finer grids.

If the number of steps does not depend on the grid, seconds are proportional to the nodes, with exponent one. Value
iteration on one grid takes N times as many steps if the grid is N times finer. Seconds are of a whole warm ``solve``,
including checks and coarser grids. The sizes of a problem take turns, and ratios are medians over the rounds. Bytes per
node are the peak of the program on the finest grid, as reported by XLA. Exponents are fitted over grids with at least
``FITTED`` nodes, because fixed costs dominate on smaller grids.
"""

import dataclasses
import functools
import warnings
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np

import hjbjax as hjb
from benchmarks import cases
from benchmarks.harness import footprint, thresholds
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table
from benchmarks.harness.timing import interleaved, timed
from hjbjax.applications.convergence import fitted_order

COLUMNS = (
    "problem", "shape", "nodes", "steps", "seconds", "compile_seconds", "microseconds_per_node", "exponent",
    "bytes_per_node", "error", "status",
)  # fmt: skip
FITTED = 10_000


@dataclasses.dataclass(frozen=True)
class Case:
    """A family of cases by one number, its sizes, its quick sizes, and the tolerance.

    ``repeats`` is the number of warm solves of each size; with ``first_order`` they use ``Upwind()``, not the default.
    """

    name: str
    build: Callable[[int], tuple[hjb.Problem, hjb.Grid]]
    sizes: tuple[int, ...]
    quick: tuple[int, ...]
    tol: float
    repeats: int = 3
    first_order: bool = True


PLANE, QUICK = (100, 200, 400, 800, 1600), (16, 32)
ALIKE: dict[str, Any] = {
    "build": cases.undiscounted_pendulum,
    "sizes": PLANE,
    "quick": QUICK,
    "tol": 1e-3,
    "repeats": 5,
}
CASES = (
    Case("pendulum", cases.pendulum, PLANE, QUICK, 1e-3, repeats=9),
    Case("pendulum undiscounted", **ALIKE),
    Case("pendulum undiscounted, default", **ALIKE, first_order=False),
    Case("dubins", lambda n: cases.dubins(n, 1.0), (24, 50, 100), (10, 12), 1e-3),
    Case("dubins undiscounted", lambda n: cases.dubins(n, 0.0), (24, 50, 100), (10, 12), 1e-3),
    Case("manipulator", cases.manipulator, (14, 20, 28, 40), (4, 6), 1e-2),
)


def first(case: Case, size: int, time_limit: float | None) -> dict[str, Any]:
    """One row: the answer of a solve that compiles, its seconds and its memory."""
    problem, grid = case.build(size)
    solution, seconds = timed(lambda: solve(case, size, time_limit))
    row = {"size": size, "shape": list(grid.shape), "nodes": grid.size, "tol": case.tol, "first_seconds": seconds}
    row |= {"steps": solution.steps, "error": solution.error, "status": solution.status.name}
    row |= {"method": solution.stats["method"], "levels": [list(shape) for shape in solution.stats["levels"]]}
    row["reached"] = 1.0 if solution.reached is None else float(np.mean(solution.reached))
    return row | footprint.of_solve(problem, grid, case.tol)


def solve(case: Case, size: int, time_limit: float | None) -> hjb.Solution:
    """The answer, whatever its status."""
    problem, grid = case.build(size)
    # by default the second-order iteration stops by the error of the grid
    scheme, tol = (hjb.Upwind(), case.tol) if case.first_order else (None, None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hjb.SolveWarning)  # nodes that cannot reach the target
        return hjb.solve(problem, grid, tol=tol, time_limit=time_limit, throw=False, scheme=scheme)


def in_turns(case: Case, rows: list[dict[str, Any]], repeats: int, time_limit: float | None) -> list[dict[str, Any]]:
    """The rows with the seconds of ``repeats`` warm solves; the sizes take turns."""
    calls = {row["size"]: functools.partial(solve, case, row["size"], time_limit) for row in rows}
    _, timings = interleaved(calls, repeats)
    measured = []
    for row in rows:
        timing = dataclasses.replace(timings[row["size"]], first=row["first_seconds"])
        about = {"rounds": list(timing.rounds), "microseconds_per_node": 1e6 * timing.seconds / row["nodes"]}
        measured.append(row | timing.row | about)
    return measured


def fit(rows: list[dict[str, Any]]) -> None:
    """Add the exponent of seconds in nodes to the rows of one problem."""
    counted = [row for row in rows if row["status"] == "CONVERGED" and row["nodes"] >= FITTED]
    exponent = fitted_order([row["nodes"] for row in counted], [row["seconds"] for row in counted])
    for row in rows:
        row["exponent"] = exponent


def judged(rows: list[dict[str, Any]]) -> dict[str, float]:
    """The figures with a threshold that these rows contain."""
    found = {(row["problem"], row["shape"][0]): row for row in rows if row["status"] == "CONVERGED"}
    figures = {}
    for key, name in (("growth", "pendulum"), ("growth undiscounted", "pendulum undiscounted, default")):
        if {(name, 400), (name, 1600)} <= set(found):
            rounds = zip(*(found[name, size]["rounds"] for size in (1600, 400)), strict=True)
            figures[key] = median(large / small for large, small in rounds)
    for key, name, size in (("dubins", "dubins", 101), ("manipulator", "manipulator", 40)):
        if (name, size) in found:
            row = found[name, size]
            figures |= {f"{key} bytes": row["bytes_per_node"], f"{key} exponent": row["exponent"]}
    return figures


@click.command()
@click.option("--quick", is_flag=True, help="Small grids, one round.")
@click.option("--problem", "names", multiple=True, type=click.Choice([case.name for case in CASES]))
@click.option("--repeats", type=click.IntRange(1), default=None, help="Warm solves; the default depends on the case.")
@click.option("--largest", type=click.IntRange(1), default=None, help="Leave out grids with more nodes.")
@click.option(
    "--time-limit", type=click.FloatRange(0, min_open=True), default=600, show_default=True, help="Of a solve."
)
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(
    quick: bool,
    names: tuple[str, ...],
    repeats: int | None,
    largest: int | None,
    time_limit: float | None,
    out: Path,
) -> None:
    """Measure seconds, steps and bytes per node of certified solves on finer and finer grids."""
    rows: list[dict[str, Any]] = []
    for case in CASES:
        if names and case.name not in names:
            continue
        about = {"benchmark": "growth", "problem": case.name, "dtype": "float64"}
        mine: list[dict[str, Any]] = []
        for size in case.quick if quick else case.sizes:
            if largest is None or case.build(size)[1].size <= largest:
                mine += attempt(lambda c=case, s=size: [first(c, s, time_limit)], about)
        known, failed = [row for row in mine if "size" in row], [row for row in mine if "size" not in row]
        again = repeats or (1 if quick else case.repeats)
        mine = failed + attempt(lambda c=case, k=known, r=again: in_turns(c, k, r, time_limit), about)
        fit([row for row in mine if "nodes" in row])
        click.echo(table(mine, COLUMNS) + "\n")
        rows += mine
    figures = judged([row for row in rows if "nodes" in row])
    rows += thresholds.announced(figures, "growth")
    publish(out, "growth", rows)
