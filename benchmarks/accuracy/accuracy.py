"""Errors, orders and seconds over the zoo's problems with known answers, for hjbjax and hj_reachability.

Writes ``accuracy.json`` and ``accuracy.png``. Every number is from a second run; compile time is separate.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

import hjbjax as hjb
from benchmarks.cases import inner
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table
from benchmarks.peers import stationary_march
from hjbjax.applications.convergence import fitted_order
from hjbjax.applications.reference import absolute_difference, at_nodes_of, mask_of, mean_spacing
from hjbjax.zoo import catalogue

COLUMNS = ("problem", "scheme", "shape", "h", "error", "mean_error", "order", "seconds", "compile_seconds", "status")
SCHEMES = (hjb.Upwind(), hjb.Limited())
HORIZON, TIME_LIMIT = 40.0, 60.0  # of hj_reachability's march: units of the problem's time, and seconds


@dataclasses.dataclass(frozen=True)
class Case:
    """A problem of the catalogue, the nodes per axis and the region in which errors count.

    If the ends of the box do not prescribe the exact value, they affect V, and errors count on the inner half.
    """

    entry: str
    nodes: tuple[int, ...]
    region: Any = None
    parameters: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        return " ".join([self.entry, *(f"{key}={value:.3g}" for key, value in self.parameters)])

    def build(self, nodes: Sequence[int]) -> tuple[Any, list[Any], Any]:
        """The problem, its grids and its exact value."""
        entry, options = catalogue[self.entry], dict(self.parameters)
        dim = entry.build(**options)[1].ndim
        built = [entry.build(shape=(count,) * dim, **options) for count in nodes]
        return built[0][0], [grid for _, grid in built], entry.exact(**options)  # type: ignore[misc]


LINE, PLANE = (41, 81, 161, 321), (21, 41, 81, 161)
CASES = (
    Case("bang-bang", LINE),
    Case("bang-bang", LINE, parameters=(("noise", 0.5**0.5),)),
    Case("smooth", PLANE, inner),
    Case("double-integrator", PLANE, 0.5),
    Case("double-integrator-lq", PLANE, 0.5),
    Case("zermelo", PLANE, 0.5),
    Case("eikonal", PLANE),
    Case("lq-game", LINE, 0.5),
    Case("stochastic-lq", LINE),
    Case("brownian-exit", LINE, parameters=(("discount", 2.0),)),
    Case("brownian-ball", PLANE),
    Case("merton", LINE),
)


def ours(case: Case, nodes: Sequence[int], scheme: Any, tol: float) -> list[dict[str, Any]]:
    """One row per grid from ``convergence_study``."""
    problem, grids, exact = case.build(nodes)
    study = hjb.convergence_study(problem, grids, exact, scheme=scheme, tol=tol, region=case.region)
    return [{**row, "order": study.order, "mean_order": study.mean_order, "tol": tol} for row in study.rows]


def marched(problem: Any, grids: Sequence[Any], exact: Any, *, tol: float, region: Any = None) -> list[dict[str, Any]]:
    """One row per grid from hj_reachability, or one row with the reason that it cannot solve the problem."""
    if reason := stationary_march.obstacle(problem, grids[0]):
        return [{"status": "SKIPPED", "reason": reason}]
    rows = []
    for grid in grids:
        run = stationary_march.march(problem, grid, exact, tol=tol, horizon=HORIZON, time_limit=TIME_LIMIT)
        mask = mask_of(region, grid)
        off = absolute_difference(run.pop("value"), at_nodes_of(exact, grid, mask))[mask]
        error, mean = float(np.max(off)), float(np.mean(off))
        about = {"shape": list(grid.shape), "nodes": grid.size, "h": mean_spacing(grid), "tol": tol}
        at_rest = run["moved"] <= 0.01 * error and run["status"] in ("SETTLED", "HORIZON")
        rows.append(about | {"error": error, "mean_error": mean, **run, "fitted": at_rest and error > tol})
    settled = [row for row in rows if row["fitted"]]
    for row in rows:
        for name, key in (("order", "error"), ("mean_order", "mean_error")):
            row[name] = fitted_order([each["h"] for each in settled], [each[key] for each in settled])
    return rows


def measure(cases: Sequence[Case], *, quick: bool, tol: float) -> list[dict[str, Any]]:
    """Measure all cases and print the rows of each."""
    rows: list[dict[str, Any]] = []
    for case in cases:
        nodes = case.nodes[:2] if quick else case.nodes
        about = {"benchmark": "accuracy", "problem": case.name, "dtype": "float64", "region": _words(case.region)}
        found = []
        for scheme in SCHEMES:
            label = {"code": "hjbjax", "scheme": type(scheme).__name__, "options": str(scheme)}
            found += attempt(lambda scheme=scheme: ours(case, nodes, scheme, tol), about | label)  # noqa: B023
        label = {"code": "hj_reachability", "scheme": "hj_reachability very_high"}
        found += attempt(lambda: marched(*case.build(nodes), tol=tol, region=case.region), about | label)  # noqa: B023
        click.echo(table([row for row in found if "shape" in row], COLUMNS))
        for row in found:
            if "reason" in row:
                click.echo(f"{row['scheme']}: {row['status'].lower()}: {row['reason']}")
        click.echo()
        rows += found
    return rows


def _words(region: Any) -> str:
    if region is None:
        return "all nodes"
    return "|x1| <= .5, |x2| <= .45" if callable(region) else f"the inner {region:g} of the box"


@click.command()
@click.option("--quick", is_flag=True, help="The two coarsest grids of every problem.")
@click.option("--problem", "names", multiple=True, metavar="NAME", help="Only this problem of the zoo; repeatable.")
@click.option("--tol", type=click.FloatRange(0, 1, min_open=True), default=1e-7, show_default=True)
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, names: tuple[str, ...], tol: float, out: Path) -> None:
    """Errors, orders and seconds over the zoo's problems with known answers."""
    known = sorted({case.entry for case in CASES})
    if unknown := [name for name in names if name not in known]:
        raise click.UsageError(f"got --problem {', '.join(unknown)}, wanted some of {', '.join(known)}")
    cases = [case for case in CASES if not names or case.entry in names]
    rows = measure(cases, quick=quick, tol=tol)
    publish(out, "accuracy", rows)
