"""The tables of measurements in ``docs/benchmarks.md`` and the README, made from the rows in ``benchmarks/results``.

Nothing is measured here. A test compares both tables with these lines.
"""

import json
from pathlib import Path
from typing import Any

import click

from benchmarks.harness.report import RESULTS
from benchmarks.harness.thresholds import THRESHOLDS

SIZES = ([200, 201], [400, 401], [800, 801], [1600, 1601])
OURS, NUMBA, THEIRS = "hjbjax", "numba", "hj_reachability"
PLACES = tuple(" x ".join(map(str, shape)) for shape in SIZES)
Row = dict[str, Any]
Figures = dict[str, float]  # by case


def rows_of(folder: Path, benchmark: str, **wanted: Any) -> list[Row]:
    """The rows of a benchmark whose entries equal ``wanted``, in order."""
    rows = json.loads((folder / f"{benchmark}.json").read_text(encoding="utf-8"))
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def one(folder: Path, benchmark: str, **wanted: Any) -> Row:
    """The only row of a benchmark whose entries equal ``wanted``."""
    (row,) = rows_of(folder, benchmark, **wanted)
    return row


def number(value: float) -> str:
    """Two significant digits: 0.98, 2.4, 23, 120."""
    return f"{float(f'{value:.2g}'):g}"


def of_peers(folder: Path) -> dict[str, Figures]:
    """Figures of one certified solve, compared with QuantEcon and with the numba solver."""
    ours = [one(folder, "peers", code=OURS, shape=shape) for shape in SIZES]
    numba = [one(folder, "peers", code=NUMBA, shape=shape) for shape in SIZES]
    chain = [row for row in rows_of(folder, "peers", shape=SIZES[0]) if row.get("code", "").startswith("QuantEcon")]
    best = min(chain, key=lambda row: row["seconds"])
    saving = {row["code"]: row["ours_is_faster"] for row in rows_of(folder, "peers", problem="saving")[1:]}
    return {
        "pendulum, 21 controls, certified to 1e-3: seconds of QuantEcon's faster method / ours": {
            f"{PLACES[0]}, compiled": best["ours_is_faster"],
            f"{PLACES[0]}, our first call, which compiles": best["seconds"] / ours[0]["first_seconds"],
        },
        "the same problem: seconds of the numba solver / ours (below 1 numba is faster)": {
            **{place: row["ours_is_faster"] for place, row in zip(PLACES, numba, strict=True)},
            f"{PLACES[0]}, `method=hjb.Nested()` (numba also starts on coarser grids)": numba[0]["nested_is_faster"],
        },
        "the same problem: CPU seconds of the numba solver / ours, all threads": {
            place: row["by_cpu_seconds"] for place, row in zip(PLACES, numba, strict=True)
        },
        "the same problem: seconds of our first call": {
            place: row["first_seconds"] for place, row in zip(PLACES, ours, strict=True)
        },
        "the same problem: seconds of the first call of the numba solver, written for this one problem": {
            place: row["first_seconds"] for place, row in zip(PLACES, numba, strict=True)
        },
        "saving with two incomes, 2 x 2000 nodes, 101 actions: seconds of QuantEcon / ours": {
            code.removeprefix("QuantEcon "): factor for code, factor in saving.items()
        },
    }


def of_sweeps(folder: Path) -> dict[str, Figures]:
    """Figures of one sweep, compared with the numba loop."""
    kernels = {"one sweep": "sweep", "a whole step of `solve` with its certificate": "step"}
    return {
        "pendulum in float32, 21 controls, two threads: seconds of the numba loop / ours": {
            f"{nodes} x {nodes}, {words}": one(
                folder, "sweep", kernel=kernel, shape=[nodes, nodes], problem="pendulum"
            )["against_numba"]
            for words, kernel in kernels.items()
            for nodes in (1024, 2048)
        }
    }


def of_growth(folder: Path) -> dict[str, Figures]:
    """Growth of the seconds with the number of nodes."""
    middle, large = (one(folder, "growth", problem="pendulum", shape=shape) for shape in (SIZES[1], SIZES[3]))
    numba = [one(folder, "peers", code=NUMBA, shape=shape)["seconds"] for shape in (SIZES[1], SIZES[3])]
    exponents = [rows_of(folder, "growth", problem=name)[-1]["exponent"] for name in ("dubins", "manipulator")]
    return {
        f"pendulum: seconds on {PLACES[3]} / seconds on {PLACES[1]}, 16 times the nodes": {
            "ours": large["seconds"] / middle["seconds"],
            "the numba solver": numba[1] / numba[0],
        },
        "exponent p of seconds = C nodes^p": {
            "Dubins car, up to 101 x 101 x 100": exponents[0],
            "two-link arm, up to 40 x 40 x 41 x 41": exponents[1],
        },
    }


def of_marches(folder: Path) -> dict[str, Figures]:
    """Figures of marches, compared with hj_reachability."""
    found: dict[str, Figures] = {}
    shares = []
    for problem in ("Air3D", "4-D car"):
        ours, theirs = (rows_of(folder, "march", problem=problem, who=who) for who in (OURS, THEIRS))
        size = " x ".join(map(str, ours[0]["shape"]))
        found[f"{problem} on {size} in float32, two threads: seconds per step of hj_reachability 0.7 / ours"] = {
            f"`{name}`": row["times"] for name, row in zip(("Upwind", "Eno2", "Weno5"), ours, strict=True)
        }
        shares += [mine["bytes_per_node"] / other["bytes_per_node"] for mine, other in zip(ours, theirs, strict=True)]
    found["the same marches: our bytes per node / those of hj_reachability"] = {
        "smallest": min(shares),
        "largest": max(shares),
    }
    return found


def of_the_rest(folder: Path) -> dict[str, Figures]:
    """Figures of gradients, batches and starts."""
    starts = [
        one(folder, "startup", problem="double-integrator", start=start)["seconds"] for start in ("cold", "cached")
    ]
    batch = one(folder, "batch", code="solve_batch")
    gradients = [row["over_solve"] for row in rows_of(folder, "gradients") if "over_solve" in row]
    return {
        "seconds of value and gradient / seconds of the value, compiled, seven problems": {
            "smallest": min(gradients),
            "largest": max(gradients),
        },
        "seconds of 64 solves one by one / seconds of `solve_batch`": {"pendulums on 100 x 101": batch["throughput"]},
        "seconds of `hjbjax solve double-integrator`, from process start to pictures": {
            "nothing cached": starts[0],
            "with JAX's compile cache": starts[1],
        },
    }


def lines(folder: Path = RESULTS) -> list[str]:
    """The lines of the table; the README has some of them."""
    parts = (of_peers, of_sweeps, of_growth, of_marches, of_the_rest)
    figures = {figure: cases for part in parts for figure, cases in part(folder).items()}
    return [
        f"| {figure} | {case} | {number(value)} |" for figure, cases in figures.items() for case, value in cases.items()
    ]


def missed(folder: Path = RESULTS) -> list[str]:
    """The lines of the table of missed thresholds."""
    found = []
    for path in sorted(folder.glob("*.json")):
        for row in rows_of(folder, path.stem, status="MISSED"):
            threshold = next((each for each in THRESHOLDS.values() if each.figure == row["figure"]), None)
            sign = "" if threshold is None else "at most " if threshold.most else "at least "
            found.append(f"| {row['figure']} | {number(row['measured'])} | {sign}{number(row['floor'])} |")
    return found


@click.command()
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Folder of the rows.")
def command(out: Path) -> None:
    """Print the tables of measurements and of missed thresholds from the recorded rows."""
    click.echo("\n".join(["| figure | case | measured |", "|---|---|---|", *lines(out)]))
    click.echo("\n".join(["", "| figure | measured | threshold |", "|---|---|---|", *missed(out)]))
