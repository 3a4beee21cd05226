"""The N^n law: nodes, steps, seconds and bytes per node of a certified solve in one to six dimensions.

A grid with N nodes per axis has N^n nodes. A good method needs constant work and memory per node, so seconds grow like
the number of nodes, with exponent one. The states of the problem are independent, so V and the value of the chain are
sums of n values of one state; every row is checked against this sum. Exponents are fitted as in ``growth``.
"""

from pathlib import Path
from typing import Any

import click
import numpy as np

import hjbjax as hjb
from benchmarks import cases
from benchmarks.harness import footprint
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table
from benchmarks.harness.timing import interleaved
from benchmarks.speed import growth

COLUMNS = (
    "dimension", "shape", "nodes", "steps", "seconds", "compile_seconds", "microseconds_per_node", "bytes_per_node",
    "difference", "exponent", "status",
)  # fmt: skip
SIZES = {
    1: (1001, 10_001, 100_001), 2: (51, 101, 201, 401, 801), 3: (21, 31, 41, 61, 101), 4: (11, 15, 21, 31),
    5: (7, 9, 11, 15), 6: (5, 6, 7, 9),
}  # fmt: skip
QUICK = {1: (11, 21), 2: (7, 11), 3: (4, 5)}
TOL = 1e-3


def measure(dimension: int, nodes: int, repeats: int) -> list[dict[str, Any]]:
    """One row: a solve that compiles, ``repeats`` warm solves, and the check of their value."""
    problem, grid = cases.apart(dimension, nodes)
    line = hjb.solve(*cases.apart(1, nodes), tol=TOL / dimension, scheme=hjb.Upwind()).value
    solutions: list[hjb.Solution] = []

    def call():
        solutions[:] = [hjb.solve(problem, grid, tol=TOL, throw=False, scheme=hjb.Upwind())]

    _, timings = interleaved({"hjbjax": call}, repeats)
    (solution,), timing = solutions, timings["hjbjax"]
    off = float(np.max(np.abs(solution.value - cases.sum_over_axes(line, dimension))))
    status = solution.status.name if off <= 2 * TOL else "DISAGREES"
    row = {"shape": list(grid.shape), "nodes": grid.size, "steps": solution.steps, "difference": off, "status": status}
    row |= timing.row | {"microseconds_per_node": 1e6 * timing.seconds / grid.size, "error": solution.error}
    return [row | {"method": solution.stats["method"]} | footprint.of_solve(problem, grid, TOL)]


@click.command()
@click.option("--quick", is_flag=True, help="Small grids in up to three dimensions, one round.")
@click.option("--dimension", "dimensions", multiple=True, type=click.IntRange(1, 6), help="Only this one; repeatable.")
@click.option("--repeats", type=click.IntRange(1), default=None, help="Warm solves; 3 if not given, quick 1.")
@click.option("--times", type=click.IntRange(1), default=1, help="Factor for the number of nodes, for a GPU.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, dimensions: tuple[int, ...], repeats: int | None, times: int, out: Path) -> None:
    """Measure seconds, steps and bytes per node in one to six dimensions."""
    rows: list[dict[str, Any]] = []
    for dimension, sizes in (QUICK if quick else SIZES).items():
        if dimensions and dimension not in dimensions:
            continue
        mine: list[dict[str, Any]] = []
        about = {"benchmark": "scaling", "problem": "apart", "dtype": "float64", "dimension": dimension, "tol": TOL}
        for nodes in (round(size * times ** (1 / dimension)) for size in sizes):
            again = repeats or (1 if quick else 3)
            mine += attempt(lambda d=dimension, n=nodes, r=again: measure(d, n, r), about)
        growth.fit([row for row in mine if "nodes" in row])
        click.echo(table(mine, COLUMNS) + "\n")
        rows += mine
    rows = [row | {"dimensions": f"{row['dimension']}-D"} for row in rows]
    publish(out, "scaling", rows)
