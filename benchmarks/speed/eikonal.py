"""The eikonal equation against fast marching (scikit-fmm), in the plane and in space.

    s(|x|) |∇V| = 1 outside the ball |x| ≤ r,  V = 0 on it,  s(ρ) = 1/(1 + ρ²),  V = ρ − r + (ρ³ − r³)/3,  ρ = |x|.

Both get the same nodes and the same signed distance |x| − r. The peer is ``skfmm.travel_time`` of second order, which
visits every node once, in the order of V, on one thread; ours is ``solve`` by default, on all cores, with its estimate
of the error of the grid, and ``solve`` with ``Upwind(subcell=True)``, which is certified. ``at_equal_nodes`` is the
peer's seconds over ours. ``at_equal_error`` is the seconds that the peer takes to reach our largest error, over ours:
seconds and errors between two measured grids are interpolated in logarithms; "extrapolated" marks an error below all of
the peer's. Errors are taken at all nodes outside of the ball.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click
import jax.numpy as jnp
import numpy as np

import hjbjax as hjb
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table, without
from benchmarks.harness.timing import interleaved

COLUMNS = (
    "dim", "solver", "shape", "nodes", "seconds", "cpu_seconds", "compile_seconds", "error", "mean_error",
    "at_equal_nodes", "at_equal_error", "extrapolated", "status",
)  # fmt: skip
RADIUS = 0.25
SIZES = {2: (51, 101, 201, 401, 801), 3: (21, 41, 81)}
QUICK = {2: (21, 41), 3: (11,)}
PEER = "scikit-fmm"
OURS: dict[str, dict[str, Any]] = {"hjbjax": {}, "hjbjax, first order": {"scheme": hjb.Upwind(subcell=True)}}


def exact(radius: np.ndarray) -> np.ndarray:
    """V at a distance from the origin; zero in the ball."""
    return np.maximum(radius - RADIUS + (radius**3 - RADIUS**3) / 3, 0)


def norm(x: Any) -> Any:
    """|x|, with a derivative at the origin."""
    return jnp.sqrt(x @ x + 1e-30)


def question(dim: int, count: int) -> tuple[hjb.Problem, hjb.Grid]:
    """The problem and the grid on [−1, 1]^dim."""
    problem = hjb.Problem(
        lambda x, u: u / (1 + x @ x), lambda x, u: 1.0, hjb.Ball(1.0, dim), target=lambda x: norm(x) - RADIUS
    )
    return problem, hjb.Grid([-1.0] * dim, [1.0] * dim, (count,) * dim)


def candidates(problem: hjb.Problem, grid: hjb.Grid, radius: np.ndarray) -> dict[str, Callable[[], np.ndarray]]:
    """Our values and the peer's, by name; ``radius`` is |x| at the nodes."""
    import skfmm

    distance, speed, spacing = radius - RADIUS, 1 / (1 + radius**2), float(grid.spacing(0))

    def ours(options: dict[str, Any]) -> np.ndarray:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", hjb.SolveWarning)  # coarse grids
            return hjb.solve(problem, grid, **options).value

    def peer() -> np.ndarray:
        return np.asarray(skfmm.travel_time(distance, speed, dx=spacing, order=2))

    return {name: lambda o=options: ours(o) for name, options in OURS.items()} | {PEER: peer}


def rows_of(dim: int, count: int, repeats: int) -> list[dict[str, Any]]:
    """The rows of one grid."""
    problem, grid = question(dim, count)
    radius = np.linalg.norm(grid.nodes(), axis=-1)
    found, timings = interleaved(candidates(problem, grid, radius), repeats)
    outside = radius > RADIUS
    rows = []
    for name, value in found.items():
        errors = np.abs(value - exact(radius))[outside]
        row = {"solver": name, "shape": list(radius.shape), "nodes": radius.size, "status": "DONE"}
        row |= {"error": float(np.max(errors)), "mean_error": float(np.mean(errors))}
        if name in OURS:
            row["at_equal_nodes"] = timings[PEER].over(timings[name])
        rows.append(row | timings[name].row)
    return rows


def seconds_for(error: float, peers: Sequence[dict[str, Any]]) -> tuple[float, bool]:
    """The peer's seconds for an error, and True if that lies below all errors it was measured with.

    ``peers`` are its rows on at least two grids. An error above all of them costs what the coarsest grid costs.
    """
    measured = sorted((row["error"], row["seconds"]) for row in peers)
    if error >= measured[-1][0]:
        return measured[-1][1], False
    above = next(i for i in range(1, len(measured)) if measured[i][0] > error)
    (fine, slow), (rough, fast) = measured[above - 1], measured[above]
    share = math.log(error / rough) / math.log(fine / rough)
    return fast * (slow / fast) ** share, error < measured[0][0]


def compare(rows: list[dict[str, Any]]) -> None:
    """Add the ratio at equal error to our rows of one dimension."""
    peers = [row for row in rows if row.get("solver") == PEER]
    for row in rows:
        if len(peers) > 1 and row.get("solver") in OURS:
            seconds, row["extrapolated"] = seconds_for(row["error"], peers)
            row["at_equal_error"] = seconds / row["seconds"]


@click.command()
@click.option("--quick", is_flag=True, help="Small grids, two rounds.")
@click.option("--repeats", type=click.IntRange(1), default=7, show_default=True, help="Rounds after the first call.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, repeats: int, out: Path) -> None:
    """Solve the eikonal equation beside scikit-fmm, at equal nodes and at equal error."""
    if (reason := without("skfmm")) is not None:
        publish(out, "eikonal", [{"benchmark": "eikonal", "dtype": "float64", "status": "SKIPPED", "reason": reason}])
        return
    rows: list[dict[str, Any]] = []
    for dim, sizes in (QUICK if quick else SIZES).items():
        about, mine = {"benchmark": "eikonal", "dim": dim, "dtype": "float64"}, []
        for count in sizes:
            mine += attempt(lambda d=dim, c=count: rows_of(d, c, 2 if quick else repeats), about)
        compare(mine)
        click.echo(table(mine, COLUMNS) + "\n")
        rows += mine
    publish(out, "eikonal", rows)
