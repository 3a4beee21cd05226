"""The estimated error against the true one, for default answers to problems with known values.

The problems are the zoo's on three grids each, and ``known_answers``. The estimate is the largest ``grid_error`` plus
the largest ``box_error`` plus the error of the iteration. A row counts if the true error is above a thousandth of the
range of V and an estimate exists. At most one row in twenty may have an estimate below a third of the error, and each
of them must have a warning. Writes ``estimates.json``.
"""

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import jax
import numpy as np

import hjbjax as hjb
from benchmarks.accuracy.accuracy import CASES
from benchmarks.accuracy.known_answers import Known, problems
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table
from hjbjax.applications.reference import at_nodes_of, mask_of

COLUMNS = ("kind", "problem", "shape", "error", "range", "estimate", "ratio", "warned", "verdict", "status")
LEAST, MOST = 1 / 3, 5.0  # ratios outside are "too small" and "too large"
SMALL = 1e-3  # of the range of V: smaller errors do not count
MISSING = "not estimated"  # beginning of the reason for a missing estimate


def row_of(solution: hjb.Solution, exact: np.ndarray, mask: np.ndarray, warned: bool, walls: bool) -> dict[str, Any]:
    """The entries of one answer in the table; ``exact`` and ``mask`` have the shape (*grid)."""
    value = np.asarray(solution.value) if solution.times is None else np.asarray(solution.value)[0]
    true, known = np.abs(value - exact)[mask], exact[mask]
    parts = [0.0 if solution.error is None else min(solution.error, solution.stats["tol"])]
    silent = solution.status is not hjb.Status.CONVERGED
    for name in ("grid_error",) if walls else ("grid_error", "box_error"):
        found = getattr(solution, name)
        if found is not None:
            parts.append(float(np.max((found if solution.times is None else found[0])[mask])))
        elif name == "grid_error" or str(solution.stats.get(name, MISSING)).startswith(MISSING):
            silent = True
    error, extent = float(np.max(true)), float(np.ptp(known)) or float(np.max(np.abs(known)))
    row = {"error": error, "range": extent, "warned": warned, "status": solution.status.name}
    ratio = sum(parts) / error if error > 0 else np.inf
    row |= {"estimate": sum(parts), "ratio": ratio, "counts": error > SMALL * extent and not silent}
    row["verdict"] = "silent" if silent else "exact" if not row["counts"] else _verdict(ratio)
    return row


def _verdict(ratio: float) -> str:
    return "too small" if ratio < LEAST else "too large" if ratio > MOST else "within"


def of_known(case: Known) -> dict[str, Any]:
    """The row of a problem of ``known_answers``."""
    states = np.asarray(case.grid.nodes()).reshape(-1, case.grid.ndim)
    exact = case.exact(states).reshape(case.grid.shape)
    mask = np.ones(len(states), bool) if case.region is None else case.region(states)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solution = case.solved()
    return row_of(solution, exact, mask.reshape(case.grid.shape), bool(caught), case.walls)


def of_zoo(problem: hjb.Problem, grid: hjb.Grid, exact: Any, region: Any) -> dict[str, Any]:
    """The row of a problem of the zoo."""
    mask = mask_of(region, grid)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solution = hjb.solve(problem, grid, throw=False)
    return row_of(solution, at_nodes_of(exact, grid, mask), mask, bool(caught), False)


def measured(quick: bool) -> Iterator[dict[str, Any]]:
    """One row per problem and grid."""
    for case in CASES:
        if quick and case.entry not in ("bang-bang", "merton"):
            continue
        problem, grids, exact = case.build(case.nodes[1:2] if quick else case.nodes[-3:])
        for grid in grids:
            about = {"kind": "zoo", "problem": case.name, "shape": list(grid.shape)}
            yield from attempt(lambda: [of_zoo(problem, grid, exact, case.region)], about)  # noqa: B023
    for known in problems():
        if quick and known.kind not in ("two nodes", "march"):
            continue
        about = {"kind": known.kind, "problem": known.name, "shape": list(known.grid.shape)}
        yield from attempt(lambda: [of_known(known)], about)  # noqa: B023


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per kind of problem: the number of rows that count, and the ratios of estimate and error."""
    found = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        mine = [row for row in rows if row["kind"] == kind]
        ratios = [row["ratio"] for row in mine if row.get("counts")]
        said = {"kind": kind, "rows": len(mine), "silent": sum(row.get("verdict") == "silent" for row in mine)}
        said |= {"count": len(ratios), "too small": sum(row.get("verdict") == "too small" for row in mine)}
        if ratios:
            said |= {"least": min(ratios), "median": float(np.median(ratios)), "most": max(ratios)}
        found.append(said)
    return found


def quoted(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The lines of the summary as a table of the documentation."""
    found = ["| problems | rows | count | too small | smallest ratio | median | largest |"]
    found.append("| --- | --- | --- | --- | --- | --- | --- |")
    for row in summary(rows):
        ratios = [f"{row[key]:.2g}" if key in row else "" for key in ("least", "median", "most")]
        cells = [row["kind"], *(str(row[key]) for key in ("rows", "count", "too small")), *ratios]
        found.append(f"| {' | '.join(cells)} |")
    return found


def verdict(rows: Sequence[dict[str, Any]]) -> str:
    """The share of estimates that are too small, and how many of these came without a warning."""
    counted = [row for row in rows if row.get("counts")]
    small = [row for row in counted if row["verdict"] == "too small"]
    quiet = sum(not row["warned"] for row in small)
    problems_ = len({(row["kind"], row["problem"]) for row in rows})
    return (
        f"{problems_} problems, {len(rows)} rows, {len(counted)} with an error above {SMALL:g} of the range and an "
        f"estimate: {len(small)} estimates too small by more than a factor of 3, {quiet} of them without a warning; "
        f"{sum(row['verdict'] == 'too large' for row in counted)} larger than {MOST:g} times the error"
    )


@click.command()
@click.option("--quick", is_flag=True, help="A few problems, on one grid each.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, out: Path) -> None:
    """Compare estimated and true errors of problems with known answers."""
    rows = []
    for row in measured(quick):
        jax.clear_caches()  # a process cannot map the programs of all problems at once
        rows.append({"benchmark": "estimates", "dtype": "float64", **row})
        click.echo(table(rows[-1:], COLUMNS).splitlines()[-1])
    click.echo(table(rows, COLUMNS))
    click.echo(table(summary(rows), ("kind", "rows", "silent", "count", "too small", "least", "median", "most")))
    click.echo(verdict(rows))
    publish(out, "estimates", rows)
