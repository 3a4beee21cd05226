"""How far ``solution.grid_error`` is from the error: default solves of the zoo's problems with known answers.

On three grids each, the largest estimate over the largest true error, and the means likewise, over the nodes where
errors count. A case counts where its error is above the tolerance; of the ratios nine in ten are to lie between 1/3
and 5 and none under 1/10. Writes ``estimates.json``.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

import hjbjax as hjb
from benchmarks.accuracy.accuracy import CASES, Case
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table
from hjbjax.applications.reference import at_nodes_of, mask_of

COLUMNS = ("problem", "shape", "scheme", "error", "estimate", "ratio", "mean_ratio", "status")
LEAST, MOST = 1 / 3, 5.0
TOL = 1e-6


def estimated(case: Case, nodes: Sequence[int]) -> list[dict[str, Any]]:
    """One row a grid."""
    problem, grids, exact = case.build(nodes)
    rows = []
    for grid in grids:
        solution, mask = hjb.solve(problem, grid, tol=TOL, throw=False), mask_of(case.region, grid)
        true = np.abs(np.asarray(solution.value) - at_nodes_of(exact, grid, mask))[mask]
        found = np.full(1, np.nan) if solution.grid_error is None else solution.grid_error[mask]
        row = {"shape": list(grid.shape), "nodes": grid.size, "scheme": solution.stats["scheme"], "tol": TOL}
        row |= {"error": float(true.max()), "estimate": float(np.max(found)), "status": solution.status.name}
        row |= {"ratio": row["estimate"] / row["error"], "mean_ratio": float(np.mean(found) / true.mean())}
        rows.append(row | {"counts": row["error"] > TOL})
    return rows


def verdict(rows: Sequence[dict[str, Any]]) -> str:
    """The share of ratios within the bounds, and the least and the largest of all."""
    ratios = np.array([row["ratio"] for row in rows if row.get("counts")])
    within = np.sum((ratios >= LEAST) & (ratios <= MOST))
    return (
        f"estimate over error between {LEAST:.2g} and {MOST:g} in {within} of {len(ratios)} cases, "
        f"between {ratios.min():.2g} and {ratios.max():.3g} in all"
    )


@click.command()
@click.option("--quick", is_flag=True, help="The second coarsest grid of every problem on a line.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, out: Path) -> None:
    """The estimated error of the grid beside the true one, over the zoo's problems with known answers."""
    rows: list[dict[str, Any]] = []
    for case in CASES:
        if quick and case.entry not in ("bang-bang", "merton"):
            continue
        nodes = case.nodes[1:2] if quick else case.nodes[-3:]
        about = {"benchmark": "estimates", "problem": case.name, "dtype": "float64"}
        rows += attempt(lambda: estimated(case, nodes), about)  # noqa: B023
    click.echo(table(rows, COLUMNS))
    click.echo(verdict(rows))
    publish(out, "estimates", rows)
