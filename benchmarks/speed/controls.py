"""Seconds against the number K of controls, and against the error: the picture of Chow and Tsitsiklis.

They showed that a value function of n states and m inputs takes of the order of 1/ε^{2n+m} operations for an error of
ε if only continuity is known: from each of 1/ε^n states, 1/ε^m controls may lead to any of 1/ε^n states. A Markov chain
jumps to neighbours only, which takes nodes times controls, 1/ε^{n+m} with K and N proportional to 1/ε. An exact minimum
over the continuum (drift affine in u, cost quadratic) removes m as well: 1/ε^n.

``number``: one grid with more and more controls; the error is the difference from the continuum. ``error``: the smooth
problem of the zoo, whose value is known, on finer and finer grids, with K = N (``sampled``) and with the continuum
(``exact``). Source: C.-S. Chow, J. N. Tsitsiklis, The complexity of dynamic programming (1989).
"""

import dataclasses
from pathlib import Path
from typing import Any

import click
import numpy as np

import hjbjax as hjb
from benchmarks import cases
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table
from benchmarks.harness.timing import interleaved
from hjbjax.applications.convergence import fitted_order
from hjbjax.applications.reference import at_nodes_of, mask_of

COLUMNS = (
    "part", "minimum", "shape", "controls", "steps", "seconds", "compile_seconds", "error", "exponent", "bound",
    "status",
)  # fmt: skip
TOL = 1e-5  # well below the errors of the grids


def solved(problems: dict[str, tuple[Any, Any]], repeats: int) -> dict[str, tuple[hjb.Solution, dict[str, Any]]]:
    """The solution and the timing of each problem, all in turn."""
    solutions: dict[str, hjb.Solution] = {}

    def call(name):
        solutions[name] = hjb.solve(*problems[name], tol=TOL, throw=False, scheme=hjb.Upwind())

    _, timings = interleaved({name: lambda name=name: call(name) for name in problems}, repeats)  # type: ignore[misc]
    return {name: (solutions[name], timings[name].row) for name in problems}


def by_number(nodes: int, counts: tuple[int, ...], repeats: int) -> list[dict[str, Any]]:
    """More and more torques on one grid of the pendulum, and the continuum."""
    asked = {str(count): cases.pendulum(nodes, count) for count in counts}
    found = solved(asked | {"exact": cases.pendulum(nodes, None)}, repeats)
    limit = found["exact"][0].value
    rows = []
    for name, (solution, timing) in found.items():
        off = None if name == "exact" else float(np.max(np.abs(solution.value - limit)))
        count = None if name == "exact" else int(name)
        minimum = "exact" if count is None else "sampled"
        rows.append(_row("number", minimum, solution, timing) | {"error": off, "controls": count})
    return _with_exponent(rows[:-1], "controls", 1.0) + rows[-1:]


def by_error(sizes: tuple[int, ...], repeats: int) -> list[dict[str, Any]]:
    """Finer and finer grids of the smooth problem: N controls on N nodes per axis, against the continuum."""
    entry = hjb.zoo.catalogue["smooth"]
    rows: list[dict[str, Any]] = []
    for nodes in sizes:
        problem, grid = entry.build(shape=(nodes, nodes))
        sampled = dataclasses.replace(problem, controls=problem.controls.grid(nodes))
        mask = mask_of(cases.inner, grid)
        exact = at_nodes_of(entry.exact(), grid, mask)  # type: ignore[misc]
        for name, (solution, timing) in solved({"sampled": (sampled, grid), "exact": (problem, grid)}, repeats).items():
            error = float(np.max(np.abs(solution.value - exact)[mask]))
            count = nodes if name == "sampled" else None
            rows.append(_row("error", name, solution, timing) | {"error": error, "controls": count})
    states, inputs = grid.ndim, problem.controls.dim
    parts = [[row for row in rows if row["minimum"] == name] for name in ("sampled", "exact")]
    return [row for part in parts for row in _with_exponent(part, "error", -float(2 * states + inputs))]


def _row(part: str, minimum: str, solution: hjb.Solution, timing: dict[str, Any]) -> dict[str, Any]:
    about = {"part": part, "minimum": minimum, "shape": list(solution.grid.shape), "nodes": solution.grid.size}
    return about | timing | {"steps": solution.steps, "status": solution.status.name, "tol": TOL}


def _with_exponent(rows: list[dict[str, Any]], key: str, bound: float) -> list[dict[str, Any]]:
    """The rows with the fitted exponent of seconds in ``key``, and its theoretical bound."""
    done = [row for row in rows if row["status"] == "CONVERGED" and row[key]]
    exponent = fitted_order([row[key] for row in done], [row["seconds"] for row in done])
    return [row | {"exponent": exponent, "bound": bound} for row in rows]


@click.command()
@click.option("--quick", is_flag=True, help="Small grids, one round.")
@click.option("--repeats", type=click.IntRange(1), default=None, help="Rounds; 3 if not given, quick 1.")
@click.option("--nodes", type=click.IntRange(8), default=None, help="N of N x (N + 1), for the part by number.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, repeats: int | None, nodes: int | None, out: Path) -> None:
    """Measure seconds against the number of controls and against the error."""
    again = repeats or (1 if quick else 3)
    about = {"benchmark": "controls", "dtype": "float64"}
    counts, sizes = ((5, 9), (11, 21)) if quick else ((11, 21, 41, 81, 161, 321), (21, 41, 81, 161))
    nodes = nodes or (16 if quick else 100)
    rows = attempt(lambda: by_number(nodes, counts, again), about | {"problem": "pendulum, one grid"})
    rows += attempt(lambda: by_error(sizes, again), about | {"problem": "smooth, finer grids"})
    click.echo(table(rows, COLUMNS))
    publish(out, "controls", rows)
