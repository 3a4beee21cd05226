"""Waiting time for the first answer, measured in separate processes that take turns.

* import: importing hjbjax and using its first name, which imports the rest, compared with importing jax.
* pictures: ``hjbjax solve`` from the start of the process to its pictures. ``cold`` compiles all (``--no-cache``);
  ``cached`` uses the compiled programs of an earlier process, in a cache folder of the benchmark.
* pendulum: the default answer and the monotone answer, with the programs that they compile.
* chain: the monotone answer including compiling, against QuantEcon's warm solve of the exported chain.
* zoo: twelve problems by default, and by policy iteration on one grid.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import click

import hjbjax as hjb
from benchmarks.harness import thresholds
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table, without
from benchmarks.harness.timing import timed
from benchmarks.peers import decision
from benchmarks.speed import first_answer

ROOT = Path(__file__).parents[2]
PARTS = ("import", "pictures", "pendulum", "chain", "zoo")
COLUMNS = {
    "import": ("start", "seconds", "fastest", "cpu_seconds", "repeats", "over_jax", "status"),
    "pictures": ("problem", "start", "seconds", "fastest", "cpu_seconds", "repeats", "pictures", "status"),
    "pendulum": (
        "shape", "way", "first_seconds", "first_cpu_seconds", "seconds", "programs", "compile_seconds", "loops",
        "over_one_loop", "over_monotone", "warm_over_monotone", "operations", "status",
    ),
    "chain": ("shape", "problem", "first_seconds", "theirs", "their_seconds", "ours_is_faster", "difference", "status"),
    "zoo": (
        "problem", "shape", "way", "first_seconds", "seconds", "programs", "over_default", "warm_over_default", "status"
    ),
}  # fmt: skip
USED = {"jax": "jit", "hjbjax": "solve"}  # a name of each package
HOMES = ("XDG_CACHE_HOME", "HOME", "LOCALAPPDATA")  # variables that locate the cache folder on different platforms


def process(command: list[str], environment: dict[str, str]) -> tuple[float, float]:
    """Seconds and CPU seconds of a process."""
    began, before = time.perf_counter(), os.times()
    subprocess.run(command, env=environment, check=True, capture_output=True)
    seconds, after = time.perf_counter() - began, os.times()
    return seconds, after.children_user + after.children_system - before.children_user - before.children_system


def one(problem: str, shape: str | None, cache: str | None) -> tuple[float, float, int]:
    """Seconds and CPU seconds of the process, and the pictures that it wrote."""
    kept = {key: value for key, value in os.environ.items() if "COMPILATION_CACHE" not in key}
    environment = kept | {"MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)}
    if cache is not None:
        environment |= dict.fromkeys(HOMES, cache)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "hjbjax", "solve", problem, "--out", str(out)]
        command += [] if shape is None else ["--shape", shape]
        command += ["--no-cache"] if cache is None else []
        return *process(command, environment), len(list(out.glob("*.png")))


def measure(problem: str, shape: str | None, repeats: int) -> list[dict[str, Any]]:
    """Two rows; cold and cached processes take turns after one that fills the cache."""
    with tempfile.TemporaryDirectory() as cache:
        filling, *_ = one(problem, shape, cache)
        found: dict[str, list[tuple[float, float, int]]] = {"cold": [], "cached": []}
        for _ in range(repeats):
            found["cold"].append(one(problem, shape, None))
            found["cached"].append(one(problem, shape, cache))
    rows = []
    for start, runs in found.items():
        seconds, busy, pictures = zip(*runs, strict=True)
        row = {"start": start, "seconds": median(seconds), "fastest": min(seconds), "repeats": repeats}
        row["cpu_seconds"] = median(busy)
        row |= {"problem": problem, "shape": shape or "default", "pictures": min(pictures)}
        rows.append(row | {"filling_seconds": filling, "status": "DONE"})
    return rows


def importing(repeats: int) -> list[dict[str, Any]]:
    """Two rows; an uncounted round writes the bytecode, as an installation does."""
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    runs: dict[str, list[tuple[float, float]]] = {"jax": [], "hjbjax": []}
    for _ in range(repeats + 1):
        for name, found in runs.items():
            code = f"import {name}; {name}.{USED[name]}"  # hjbjax imports its modules with the first name
            found.append(process([sys.executable, "-c", code], kept | {"PYTHONPATH": str(ROOT)}))
    rows = []
    for name, (_, *found) in runs.items():
        seconds, busy = zip(*found, strict=True)
        ratios = [mine / theirs for (mine, _), (theirs, _) in zip(found, runs["jax"][1:], strict=True)]
        row = {"start": f"import {name}", "seconds": median(seconds), "fastest": min(seconds), "repeats": repeats}
        rows.append(row | {"cpu_seconds": median(busy), "over_jax": median(ratios), "status": "DONE"})
    return rows


def pendulum(nodes: int, repeats: int) -> list[dict[str, Any]]:
    """The default and the monotone answer; one more process counts the operations of each loop."""
    rows = first_answer.middle("pendulum", nodes, ("monotone", "default"), repeats)
    for row in rows:
        row["operations"] = first_answer.sizes("pendulum", nodes, row["way"])
    return rows


def chain(nodes: int, actions: int, repeats: int) -> list[dict[str, Any]]:
    """Our first answer against the faster method of QuantEcon, whose compiling does not count."""
    if reason := without("quantecon"):
        return [{"status": "SKIPPED", "reason": reason}]
    name, tol = f"pendulum, {actions} torques", 1e-3
    problem, grid = first_answer.SAMPLED[name](nodes)
    ours = first_answer.middle(name, nodes, ("to 1e-3",), repeats)[0]
    value = hjb.solve(problem, grid, tol=tol, scheme=hjb.Upwind()).value
    best: dict[str, Any] = {"their_seconds": float("inf")}
    for method, solve in decision.quantecon(hjb.chain.transition_arrays(problem, grid), tol).items():
        solve()  # compiles
        answer, took = min((timed(solve) for _ in range(repeats)), key=lambda run: run[1])
        if took < best["their_seconds"]:
            off = float(abs(answer.reshape(grid.shape) - value).max())
            best = {"theirs": method, "their_seconds": took, "difference": off}
    status = ours["status"] if best["difference"] <= 2 * tol else "DISAGREES"
    ratio = best["their_seconds"] / ours["first_seconds"]
    return [ours | best | {"ours_is_faster": ratio, "status": status}]


@click.command()
@click.option("--quick", is_flag=True, help="Small grids, one round, one problem of the zoo.")
@click.option("--part", multiple=True, type=click.Choice(PARTS), help="What to measure; repeatable, all if not given.")
@click.option("--repeats", type=click.IntRange(1), default=None, help="Rounds; 3 if not given, quick 1.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, part: tuple[str, ...], repeats: int | None, out: Path) -> None:
    """Measure the first answer: importing, compiling, and from process start to pictures."""
    rounds, shape = repeats or (1 if quick else 3), "15x15" if quick else None
    sizes, chains = ((21,), ((27, 21),)) if quick else ((101, 201, 401, 801), ((161, 31), (201, 21)))
    problems = list(first_answer.ZOO)[:1] if quick else list(first_answer.ZOO)
    ways = ("default", "one grid")
    measures: dict[str, list[Any]] = {
        "import": [lambda: importing(rounds + 2)],
        "pictures": [lambda p=p: measure(p, shape, rounds) for p in ("double-integrator", "pendulum")[: 2 - quick]],
        "pendulum": [lambda n=n: pendulum(n, rounds) for n in sizes],
        "chain": [lambda n=n, k=k: chain(n, k, rounds) for n, k in chains],
        "zoo": [lambda p=p, n=n: first_answer.middle(p, n, ways, 1) for p in problems for n in sizes if n != 201],
    }
    rows: list[dict[str, Any]] = []
    for name in part or PARTS:
        about = {"benchmark": "startup", "part": name, "dtype": "float64"}
        found = [row for each in measures[name] for row in attempt(each, about)]
        click.echo(f"{name}\n{table(found, COLUMNS[name])}\n")
        click.echo("\n".join(f"{row['status'].lower()}: {row['reason']}" for row in found if "reason" in row))
        rows += found
    rows += thresholds.announced({} if quick else judged(rows), "startup")
    publish(out, "startup", rows)


def judged(rows: list[dict[str, Any]]) -> dict[str, float]:
    """The figures with a threshold that these rows contain."""
    figures: dict[str, float] = {}
    for row in rows:
        if row["part"] == "import" and row.get("start") == "import hjbjax":
            figures["import"] = row["over_jax"]
        elif row["part"] == "pictures" and row.get("problem") == "double-integrator":
            figures[f"{row['start']} start"] = row["seconds"]
        elif row["part"] == "pendulum" and row.get("way") == "default" and row["over_one_loop"]:
            nodes = row["shape"][1]
            found = {
                "first pendulum": "over_one_loop",
                "cold default": "over_monotone",
                "warm default": "warm_over_monotone",
            }
            figures |= {f"{name} {nodes}": row[key] for name, key in found.items()}
            figures["programs"] = max(figures.get("programs", 0), row["programs"])
        elif row["part"] == "chain" and "ours_is_faster" in row:
            figures[f"quantecon cold {row['shape'][0]}"] = row["ours_is_faster"]
    slower = [row["over_default"] for row in rows if row["part"] == "zoo" and row.get("way") == "one grid"]
    figures |= {"one grid": min(slower)} if slower else {}
    return {name: value for name, value in figures.items() if name in thresholds.THRESHOLDS}
