"""What ``docs/benchmarks.md`` and the README quote of the recorded rows: lines made from ``benchmarks/results``.

Nothing is measured. A test compares their tables with these lines, so that they say what was recorded and
nothing better.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from benchmarks.harness.report import RESULTS

SIZES = ([200, 201], [400, 401], [800, 801], [1600, 1601])
OURS, NUMBA, THEIRS = "hjbjax", "numba", "hj_reachability"
Row = dict[str, Any]


def rows_of(folder: Path, benchmark: str, **wanted: Any) -> list[Row]:
    """The rows of a benchmark that say what is ``wanted``, in order."""
    rows = json.loads((folder / f"{benchmark}.json").read_text(encoding="utf-8"))
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def one(folder: Path, benchmark: str, **wanted: Any) -> Row:
    """The only row that says what is ``wanted``."""
    (row,) = rows_of(folder, benchmark, **wanted)
    return row


def numbers(values: Sequence[float]) -> str:
    """Two significant digits of each: .98; 2.4; 23."""
    return "; ".join(f"{value:.2g}".replace("e+02", "00").removeprefix("0") for value in values)


def of_peers(folder: Path) -> dict[str, Sequence[float]]:
    """One certified solve, beside QuantEcon and the numba solver."""
    ours = [one(folder, "peers", code=OURS, shape=shape) for shape in SIZES]
    numba = [one(folder, "peers", code=NUMBA, shape=shape) for shape in SIZES]
    chain = [row for row in rows_of(folder, "peers", shape=SIZES[0]) if row.get("code", "").startswith("QuantEcon")]
    best = min(chain, key=lambda row: row["seconds"])
    places = "200 x 201, 400 x 401, 800 x 801 and 1600 x 1601"
    return {
        "pendulum on 200 x 201, 21 controls, certified to 1e-3: seconds of the faster of QuantEcon's two methods over "
        "ours; over those of our first call, which compiles": [
            best["ours_is_faster"],
            best["seconds"] / ours[0]["first_seconds"],
        ],
        f"the same, seconds of the numba solver over ours on {places}: below 1 it is the faster": [
            row["ours_is_faster"] for row in numba
        ],
        "the same on 200 x 201 with `method=hjb.Nested()`, since the numba solver starts on coarser grids, too": [
            numba[0]["nested_is_faster"]
        ],
        "the same by seconds of the processor, all threads together": [row["by_cpu_seconds"] for row in numba],
        "seconds of our first call at those sizes": [row["first_seconds"] for row in ours],
        "seconds of the numba solver's, whose functions are of this one problem": [
            row["first_seconds"] for row in numba
        ],
    }


def of_sweeps(folder: Path) -> dict[str, Sequence[float]]:
    """One sweep, beside the numba loop."""
    found = [
        one(folder, "sweep", kernel=kernel, shape=[nodes, nodes], problem="pendulum")["against_numba"]
        for kernel in ("sweep", "step")
        for nodes in (1024, 2048)
    ]
    return {
        "one sweep of 1024² and 2048² nodes in float32, 21 controls: seconds of the numba loop over ours, both on two "
        "threads; the same of a whole step of `solve`, with its certificate": found
    }


def of_growth(folder: Path) -> dict[str, Sequence[float]]:
    """How seconds grow with the nodes."""
    middle, large = (one(folder, "growth", problem="pendulum", shape=shape) for shape in (SIZES[1], SIZES[3]))
    numba = [one(folder, "peers", code=NUMBA, shape=shape)["seconds"] for shape in (SIZES[1], SIZES[3])]
    exponents = [rows_of(folder, "growth", problem=name)[-1]["exponent"] for name in ("dubins", "manipulator")]
    return {
        "seconds on 1600 x 1601 over those on 400 x 401, sixteen times the nodes: ours; the numba solver's": [
            large["seconds"] / middle["seconds"],
            numba[1] / numba[0],
        ],
        "seconds grow like nodes to the power of, on a Dubins car to 101 x 101 x 100 and a two-link arm to "
        "40 x 40 x 41 x 41": exponents,
    }


def of_marches(folder: Path) -> dict[str, Sequence[float]]:
    """Marching, beside hj_reachability."""
    found: dict[str, Sequence[float]] = {}
    shares = []
    for problem in ("Air3D", "4-D car"):
        ours, theirs = (rows_of(folder, "march", problem=problem, who=who) for who in (OURS, THEIRS))
        size = " x ".join(map(str, ours[0]["shape"]))
        found[
            f"{problem} on {size} in float32, by `Upwind`, `Eno2` and `Weno5`: seconds a step of hj_reachability 0.7 "
            "over ours, both on two threads"
        ] = [row["times"] for row in ours]
        shares += [mine["bytes_per_node"] / other["bytes_per_node"] for mine, other in zip(ours, theirs, strict=True)]
    found["our bytes a node over its own there, least and most"] = [min(shares), max(shares)]
    return found


def of_the_rest(folder: Path) -> dict[str, Sequence[float]]:
    """Batches and starts."""
    starts = [
        one(folder, "startup", problem="double-integrator", start=start)["seconds"] for start in ("cold", "cached")
    ]
    batch = one(folder, "batch", code="solve_batch")
    gradients = [row["over_solve"] for row in rows_of(folder, "gradients") if "over_solve" in row]
    return {
        "value and gradient of a solve over the value alone, compiled, of seven questions the least and the most": [
            min(gradients),
            max(gradients),
        ],
        "`solve_batch` of 64 pendulums on 100 x 101, against one solve after the other": [batch["throughput"]],
        "seconds of `hjbjax solve double-integrator` from process start to pictures; with JAX's compile cache": starts,
    }


def lines(folder: Path = RESULTS) -> list[str]:
    """The lines of the table; the README has some of them."""
    parts = (of_peers, of_sweeps, of_growth, of_marches, of_the_rest)
    return [f"| {figure} | {numbers(found)} |" for part in parts for figure, found in part(folder).items()]


@click.command()
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Folder of the rows.")
def command(out: Path) -> None:
    """The table of what was seen, from the recorded rows."""
    click.echo("\n".join(["| figure | seen |", "|---|---|", *lines(out)]))
