"""Error against seconds for schemes of high order, on the pendulum, the double integrator and a smooth value.

The exact value of the pendulum (gain 1/m) is unknown. Its errors are relative, at ``STATES``, against Limited() on a
grid twice as fine as the finest measured grid. If the first-order chain does not reach an error, its seconds are
extrapolated from its fitted order and the fitted growth of its seconds. On the double integrator (minimum time in
Kružkov's form on [−1, 1]², exact values on {T ≤ ½} and at the ends), seconds are compared with hj_reachability's
"very_high" at equal mean error, and on the zoo's smooth problem at equal largest error. SemiLagrangian() is compared
with the first-order chain on the same nodes of the double integrator.

Writes ``precision.json`` and ``precision.png``. Our seconds are medians of whole solves that take turns. The seconds of
hj_reachability are from a second march. Compile time is separate.
"""

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

import hjbjax as hjb
from benchmarks import cases
from benchmarks.accuracy import accuracy
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table
from benchmarks.harness.timing import interleaved

COLUMNS = ("problem", "scheme", "shape", "error", "seconds", "compile_seconds", "status")
PLAIN, LIMITED = hjb.Upwind(central=False), hjb.Limited()
FIFTH = hjb.Weno5()
PATHS = hjb.SemiLagrangian()
HELD = hjb.Limited(subcell=False)  # the target is a level set of time and not a signed distance
STATES = ((0.5, 0.0), (np.pi / 4, 0.0), (1.5, -1.0), (2.8, 1.5), (-2.0, -2.0))
PENDULUM, DOUBLE_INTEGRATOR, SMOOTH = (50, 100, 200, 400), (21, 41, 81, 161, 321), (21, 41, 81, 161)
LEVELS = 25  # errors at which seconds are compared
REPEATS = 15
SIDE_BY_SIDE, LEAST_ERROR, MOST_SECONDS = 161, 0.3, 3.0  # nodes per axis of the double integrator, and the thresholds
TOL, SMALL = 1e-4, 1e-12


def pendulum(nodes: Sequence[int]) -> list[dict[str, Any]]:
    """One row per scheme and grid; the error is the mean relative error at ``STATES``."""

    def grid(count: int) -> Any:
        return hjb.zoo.pendulum(shape=(count, count + 1))[1]

    problem = hjb.zoo.pendulum()[0]
    fine = hjb.solve(problem, grid(2 * max(nodes)), scheme=LIMITED, tol=TOL)
    known = np.array([fine.value_at(state) for state in STATES])
    rows, asked = [], []
    for scheme in (PLAIN, LIMITED, FIFTH):
        study = hjb.convergence_study(problem, [grid(count) for count in nodes], fine, scheme=scheme, tol=TOL)
        for row, solution in zip(study.rows, study.solutions, strict=True):
            values = np.array([solution.value_at(state) for state in STATES])
            relative = np.abs(values / known - 1)
            label = {"problem": "pendulum", "code": "hjbjax", "scheme": _name(scheme), "tol": TOL}
            rows.append(row | label | {"error": float(np.mean(relative)), "relative": relative.tolist()})
            asked.append((solution.grid, scheme))
    return with_seconds(rows, problem, asked)


def double_integrator(nodes: Sequence[int]) -> list[dict[str, Any]]:
    """One row per code, scheme and grid; the error is the mean over the box."""
    exact = hjb.zoo.double_integrator_exact()
    problem, grids = cases.double_integrator(nodes[0])[0], [cases.double_integrator(n)[1] for n in nodes]
    rows, asked = [], []
    for scheme in (PLAIN, HELD, PATHS):
        label = {"code": "hjbjax", "scheme": _name(scheme), "tol": TOL}
        study = hjb.convergence_study(problem, grids, exact, scheme=scheme, tol=TOL)
        rows += [label | row for row in study.rows]
        asked += [(grid, scheme) for grid in grids]
    rows = with_seconds(rows, problem, asked)
    affordable = [grid for grid in grids if grid.shape[0] <= 161]
    rows += _theirs(accuracy.marched(problem, affordable, exact, tol=TOL))
    return [row | {"problem": "double integrator", "error": row.get("mean_error")} for row in rows]


def smooth(nodes: Sequence[int]) -> list[dict[str, Any]]:
    """One row per code, scheme and grid; the error is the largest in the region that the ends do not affect."""
    problem, exact = hjb.zoo.smooth()[0], hjb.zoo.smooth_exact()
    grids, rows, asked = [hjb.zoo.smooth(shape=(n, n))[1] for n in nodes], [], []
    for scheme in (LIMITED, FIFTH):
        label = {"code": "hjbjax", "scheme": _name(scheme), "tol": SMALL}
        study = hjb.convergence_study(problem, grids, exact, scheme=scheme, tol=SMALL, region=cases.inner)
        rows += [label | row for row in study.rows]
        asked += [(grid, scheme) for grid in grids]
    rows = with_seconds(rows, problem, asked, SMALL)
    # settled to a hundredth of the error on its finest grid
    rows += _theirs(accuracy.marched(problem, grids[:3], exact, tol=1e-9, region=cases.inner))
    return [row | {"problem": "smooth"} for row in rows]


def _theirs(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{"code": "hj_reachability", "scheme": "hj_reachability very_high"} | row for row in rows]


def with_seconds(
    rows: list[dict[str, Any]], problem: Any, asked: Sequence[tuple[Any, Any]], tol: float = TOL
) -> list[dict[str, Any]]:
    """The rows with the wall time of a whole warm solve, one grid and scheme per row.

    The time is the median of ``REPEATS`` solves; the rows take turns.
    """
    calls = {
        number: functools.partial(hjb.solve, problem, grid, scheme=scheme, tol=tol)
        for number, (grid, scheme) in enumerate(asked)
    }
    _, timings = interleaved(calls, REPEATS)
    return [row | {"seconds": timings[number].seconds} for number, row in enumerate(rows)]


def _name(scheme: Any) -> str:
    return "plain upwind" if scheme == PLAIN else f"{type(scheme).__name__}()"


def would_need(rows: Sequence[dict[str, Any]], error: float) -> float:
    """Seconds for an error that the rows do not reach, extrapolated from their fitted order and growth of seconds."""
    h, errors, seconds = (np.log([row[key] for row in rows]) for key in ("h", "error", "seconds"))
    order, offset = np.polyfit(h, errors, 1)
    growth, start = np.polyfit(h, seconds, 1)
    return float(np.exp(start + growth * (math.log(error) - offset) / order))


def advantage(rows: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]]) -> tuple[float, float] | None:
    """Smallest and largest ratio of the others' seconds to ours over the errors that both reach, by log-linear fits."""

    def curve(points: Sequence[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
        ordered = sorted((row["error"], row["seconds"]) for row in points)
        return tuple(np.log(np.array(ordered)).T)  # type: ignore[return-value]

    ours, theirs = curve(rows), curve(others)
    low, high = max(ours[0][0], theirs[0][0]), min(ours[0][-1], theirs[0][-1])
    if not low < high:
        return None
    at = np.linspace(low, high, LEVELS)
    ratios = np.exp(np.interp(at, *theirs) - np.interp(at, *ours))
    return float(ratios.min()), float(ratios.max())


def verdicts(rows: Sequence[dict[str, Any]]) -> list[str]:
    """One sentence per figure."""

    def of(problem: str, scheme: str) -> list[dict[str, Any]]:
        return [
            row for row in rows if (row.get("problem"), row.get("scheme")) == (problem, scheme) and row.get("error")
        ]

    said = []
    plain, limited = of("pendulum", "plain upwind"), of("pendulum", "Limited()")
    here = [row for row in limited if row["shape"][0] == 100]
    if plain and here:
        factor = would_need(plain, here[0]["error"]) / here[0]["seconds"]
        said.append(
            f"pendulum: Limited() on 100 x 101 is {here[0]['error']:.2%} off; by its fitted order and growth the plain "
            f"scheme would need {factor:.3g} times its time (threshold 50)"
        )
    pairs = [("double integrator", "Limited()", other, 1) for other in ("plain upwind", "hj_reachability very_high")]
    for problem, scheme, other, least in [*pairs, ("smooth", _name(FIFTH), "hj_reachability very_high", 10)]:
        ours, theirs = of(problem, scheme), of(problem, other)
        if ours and theirs and (found := advantage(ours, theirs)):
            said.append(
                f"{problem}: {other} takes {found[0]:.3g} to {found[1]:.3g} times the time of {scheme} at the same "
                f"error (threshold {least})"
            )
    ours, theirs = (
        [row for row in of("double integrator", scheme) if row["shape"][0] == SIDE_BY_SIDE]
        for scheme in (_name(PATHS), "plain upwind")
    )
    if ours and theirs:
        errors, seconds = (ours[0][key] / theirs[0][key] for key in ("error", "seconds"))
        said.append(
            f"double integrator: {_name(PATHS)} on {SIDE_BY_SIDE} x {SIDE_BY_SIDE} has {errors:.3g} times the mean "
            f"error of plain upwind (threshold {LEAST_ERROR}) in {seconds:.3g} times its seconds (threshold "
            f"{MOST_SECONDS})"
        )
    return said


@click.command()
@click.option("--quick", is_flag=True, help="Coarse grids only.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, out: Path) -> None:
    """Measure error against seconds, at first and second order, on the pendulum and the double integrator."""
    about = {"benchmark": "precision", "dtype": "float64"}
    rows = attempt(lambda: pendulum(PENDULUM[:2] if quick else PENDULUM), about)
    rows += attempt(lambda: double_integrator(DOUBLE_INTEGRATOR[:2] if quick else DOUBLE_INTEGRATOR), about)
    rows += attempt(lambda: smooth(SMOOTH[:2] if quick else SMOOTH), about)
    click.echo(table(rows, COLUMNS))
    for sentence in verdicts(rows):
        click.echo(sentence)
    publish(out, "precision", rows)
