"""Many problems at once: ``solve_batch`` of pendulums of different mass, against one ``solve`` after the other.

Both compile once, because masses are leaves. Both use the same method and the default scheme, and the values agree.
On a CPU each core solves one lane at a time; on a GPU all lanes run together.
"""

from pathlib import Path
from typing import Any

import click
import numpy as np

import hjbjax as hjb
from benchmarks import cases
from benchmarks.harness import thresholds
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table
from benchmarks.harness.timing import interleaved

COLUMNS = (
    "code", "shape", "lanes", "seconds", "compile_seconds", "solves_per_second", "throughput", "difference", "status",
)  # fmt: skip
TOL = 1e-3
MASSES = (0.5, 2.0)


def measure(nodes: int, lanes: int, repeats: int) -> list[dict[str, Any]]:
    """Two rows: the batch, and the same problems one by one."""
    problems, (_, grid) = [], cases.pendulum(nodes, None)
    for mass in np.geomspace(*MASSES, lanes):
        problems.append(cases.pendulum(nodes, None, float(mass))[0])
    solutions: dict[str, list[hjb.Solution]] = {}

    def together():
        solutions["solve_batch"] = hjb.solve_batch(problems, grid, tol=TOL, throw=False)

    def apart():
        solutions["solve"] = [hjb.solve(problem, grid, tol=TOL, throw=False) for problem in problems]

    _, timings = interleaved({"solve_batch": together, "solve": apart}, repeats)
    pairs = zip(solutions["solve_batch"], solutions["solve"], strict=True)
    off = max(float(np.max(np.abs(first.value - second.value))) for first, second in pairs)
    rows = []
    for name, timing in timings.items():
        statuses = {solution.status.name for solution in solutions[name]}
        status = "DISAGREES" if not off <= 2 * TOL else statuses.pop() if len(statuses) == 1 else "MIXED"
        row = {"code": name, "shape": list(grid.shape), "nodes": grid.size, "lanes": lanes, "difference": off}
        row |= timing.row | {"solves_per_second": lanes / timing.seconds, "tol": TOL, "status": status}
        row["steps"] = max(solution.steps for solution in solutions[name])
        rows.append(row | {"throughput": timings["solve"].over(timing)})
    return rows


@click.command()
@click.option("--quick", is_flag=True, help="Four lanes on a small grid, one round.")
@click.option("--lanes", type=click.IntRange(1), default=None, help="Problems; 64 if not given, quick 4.")
@click.option("--nodes", type=click.IntRange(8), default=None, help="N of N x (N + 1); 100 if not given, quick 16.")
@click.option("--repeats", type=click.IntRange(1), default=None, help="Rounds; 3 if not given, quick 1.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, lanes: int | None, nodes: int | None, repeats: int | None, out: Path) -> None:
    """Measure solve_batch of pendulums of different mass against one solve after the other."""
    lanes, nodes, again = lanes or (4 if quick else 64), nodes or (16 if quick else 100), repeats or (1 if quick else 3)
    about = {"benchmark": "batch", "problem": "pendulum", "dtype": "float64"}
    rows = attempt(lambda: measure(nodes, lanes, again), about)
    click.echo(table(rows, COLUMNS))
    figures = {}
    if "throughput" in rows[0] and (rows[0]["shape"], lanes) == ([100, 101], 64):
        figures["batch"] = rows[0]["throughput"]
    rows += thresholds.announced(figures, "batch")
    publish(out, "batch", rows)
