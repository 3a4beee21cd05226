"""A certified solve against other solvers on one chain: the pendulum, K torques, discount 0.1; and saving.

The hand-written numba solver (``peers.numba_pendulum``) solves only this problem. QuantEcon and mdpsolver
(``peers.decision``) get the exported chain; building it does not count. These three run on one thread, and hjbjax on
all threads of XLA, so each row also has the number of threads, the CPU seconds and their ratio. mdpsolver gets half the
nodes per axis and one round, because it takes minutes on the whole chain. All stop at the same tolerance. The benchmark
checks that two values differ by at most twice the tolerance.

The second problem is consumption and saving with two incomes (``zoo.saving``) and 101 levels of consumption, against
QuantEcon on the exported chain with a state for every node and income.

First calls, which compile, are reported for every solver. Ours is the first call of this process, and two more after
clearing JAX's caches; numba's is compiling and one solve. The numba solver uses coarser grids at every size, and hjbjax
only if that pays for another program; at the smallest size it also runs with nested grids. hj_reachability would march
this problem for thousands of steps, so it is in ``python -m benchmarks accuracy`` instead.
"""

import functools
import time
from pathlib import Path
from statistics import median
from typing import Any

import click
import jax
import numpy as np

import hjbjax as hjb
from benchmarks import cases
from benchmarks.harness import thresholds
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table, threads, without
from benchmarks.harness.timing import interleaved, timed
from benchmarks.peers import decision

PAIRS = 2_000_000  # of state and action; a larger chain takes gigabytes
OURS, NESTED, NUMBA, MDP = "hjbjax", "hjbjax, nested grids", "numba", "mdpsolver"
COLUMNS = (
    "code", "threads", "shape", "controls", "seconds", "cpu_seconds", "fastest", "compile_seconds", "first_seconds",
    "first_cpu_seconds", "ours_is_faster", "nested_is_faster", "by_cpu_seconds", "difference", "build_seconds",
    "status",
)  # fmt: skip
ABOUT = {"benchmark": "peers", "problem": "pendulum", "dtype": "float64"}


def our_first(solve: Any, times: int) -> dict[str, float]:
    """Median seconds and CPU seconds of first calls of ``solve``, which compile each time."""
    seconds, busy = [], []
    for _ in range(times):
        jax.clear_caches()
        before = time.process_time()
        seconds.append(timed(lambda: solve().value)[1])
        busy.append(time.process_time() - before)
    return {"first_seconds": median(seconds), "first_cpu_seconds": median(busy)}


@functools.cache
def handwritten() -> tuple[Any, float]:
    """The compiled numba solver, and the seconds for compiling."""
    from benchmarks.peers import numba_pendulum

    return numba_pendulum.solve, timed(lambda: numba_pendulum.solve(8, 3, 0.1, 1e-3)[0])[1]


def measure(nodes: int, actions: int, tol: float, repeats: int, *, chain: bool, first: int) -> list[dict[str, Any]]:
    """Rows of hjbjax and the numba solver at one size, and of QuantEcon if ``chain``."""
    problem, grid = cases.pendulum(nodes, actions)
    ours = {OURS: functools.partial(hjb.solve, problem, grid, tol=tol, scheme=hjb.Upwind())}
    if chain:  # the smallest size, at which coarser grids are not the default
        ours[NESTED] = functools.partial(ours[OURS], method=hjb.Nested())
    cold = {name: our_first(solve, first) for name, solve in ours.items()}
    solutions: dict[str, hjb.Solution] = {}

    def call(name):
        solutions[name] = ours[name]()
        return solutions[name].value

    calls: dict[str, Any] = {name: functools.partial(call, name) for name in ours}
    missing, build = [], {}
    if (reason := without("numba")) is None:
        theirs, compiling = handwritten()
        calls[NUMBA] = lambda: theirs(nodes, actions, float(problem.discount), tol)[0]
        cold[NUMBA] = {"compile_seconds": compiling}
    else:
        missing.append({"code": NUMBA, "status": "SKIPPED", "reason": reason})
    if chain and (reason := without("quantecon")) is None:
        made, took = timed(lambda: decision.quantecon(hjb.chain.transition_arrays(problem, grid), tol))
        calls |= made
        build = dict.fromkeys(made, took)
    elif chain:
        missing.append({"code": "QuantEcon", "status": "SKIPPED", "reason": reason})
    rows = _rows(calls, interleaved(calls, repeats), build)
    for row in rows:
        row |= cold.get(row["code"], {})
        if (solution := solutions.get(row["code"])) is not None:
            row |= {"status": solution.status.name, "steps": solution.steps, "error": solution.error}
            row |= {"method": solution.stats["method"], "compile_seconds": row["first_seconds"] - row["seconds"]}
        elif row["code"] == NUMBA:
            row["first_seconds"] = row["compile_seconds"] + row["seconds"]
    return [_about(grid, actions, tol) | row for row in (*rows, *missing)]


def beside_mdpsolver(nodes: int, actions: int, tol: float) -> list[dict[str, Any]]:
    """One round of mdpsolver, which takes minutes at sizes that take the others seconds."""
    problem, grid = cases.pendulum(nodes, actions)
    if reason := without("mdpsolver"):
        return [_about(grid, actions, tol) | {"code": MDP, "status": "SKIPPED", "reason": reason}]
    make = lambda: decision.mdpsolver(hjb.chain.transition_arrays(problem, grid), tol)  # noqa: E731
    (afresh, solve), took = timed(make)
    calls = {OURS: lambda: hjb.solve(problem, grid, tol=tol, scheme=hjb.Upwind()).value, MDP: solve}
    rows = _rows(calls, interleaved(calls, 1, {MDP: afresh}), {MDP: took})
    return [_about(grid, actions, tol) | row for row in rows[1:]]


def saving(nodes: int, actions: int, tol: float, repeats: int) -> list[dict[str, Any]]:
    """Rows of hjbjax and of QuantEcon for saving with two incomes on ``nodes`` levels of wealth."""
    problem, grid = cases.saving(nodes, actions)
    about = {"problem": "saving", "shape": [2, nodes], "nodes": 2 * nodes, "controls": actions, "tol": tol}
    if reason := without("quantecon"):
        return [about | {"code": "QuantEcon", "status": "SKIPPED", "reason": reason}]
    rewards, *chain = hjb.chain.transition_arrays(problem, grid)
    made, took = timed(lambda: decision.quantecon((-rewards, *chain), tol))
    theirs = {name: (lambda solve=solve: -solve()) for name, solve in made.items()}
    calls = {OURS: lambda: hjb.solve(problem, grid, tol=tol, scheme=hjb.Upwind()).value, **theirs}
    return [about | row for row in _rows(calls, interleaved(calls, repeats), dict.fromkeys(made, took))]


def _about(grid: hjb.Grid, actions: int, tol: float) -> dict[str, Any]:
    return {"shape": list(grid.shape), "nodes": grid.size, "controls": actions, "tol": tol}


def _rows(calls: Any, measured: Any, build: dict[str, float]) -> list[dict[str, Any]]:
    results, timings = measured
    ours = np.asarray(results[OURS])
    rows = [{"code": OURS, "status": "DONE", "threads": threads()} | timings[OURS].row]
    for code in list(calls)[1:]:
        off = float(np.max(np.abs(np.asarray(results[code]).reshape(ours.shape) - ours)))
        row = {"code": code, "status": "DONE", "difference": off, "ours_is_faster": timings[code].over(timings[OURS])}
        row |= {"by_cpu_seconds": timings[code].row["cpu_seconds"] / rows[0]["cpu_seconds"]}
        row |= {"threads": threads() if code == NESTED else 1, "first_seconds": timings[code].first}
        if NESTED in timings and code != NESTED:
            row["nested_is_faster"] = timings[code].over(timings[NESTED])
        rows.append(row | {"build_seconds": build.get(code)} | timings[code].row)
    return rows


def checked(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows; a value that is off by more than both tolerances is marked DISAGREES."""
    for row in rows:
        if not row.get("difference", 0.0) <= 2 * row.get("tol", 0.0):
            row["status"] = "DISAGREES"
    return rows


def judged(rows: list[dict[str, Any]]) -> dict[str, float]:
    """The figures with a threshold that these rows contain."""
    figures = {}
    done = [row for row in rows if row["status"] == "DONE" and row["controls"] == 21 and row["tol"] == 1e-3]
    chain = [row for row in done if row["code"].startswith("QuantEcon") and row["shape"] == [200, 201]]
    if chain:
        best = min(chain, key=lambda row: row["seconds"])
        mine = next(row for row in rows if row["code"] == OURS and row["shape"] == [200, 201])
        figures |= {"quantecon": best["ours_is_faster"], "quantecon cold": best["seconds"] / mine["first_seconds"]}
    hand = {f"numba {row['shape'][0]}": row["ours_is_faster"] for row in done if row["code"] == NUMBA}
    hand |= {
        f"numba {row['shape'][0]} nested": row["nested_is_faster"]
        for row in done
        if row["code"] == NUMBA and "nested_is_faster" in row
    }
    return figures | {name: value for name, value in hand.items() if name in thresholds.THRESHOLDS}


@click.command()
@click.option("--quick", is_flag=True, help="Small grids, one round.")
@click.option("--nodes", multiple=True, type=click.IntRange(8), help="N, even, of N x (N + 1); repeatable.")
@click.option("--repeats", type=click.IntRange(1), default=None, help="Rounds; 5 if not given, quick 1.")
@click.option("--controls", type=click.IntRange(2), default=21, show_default=True)
@click.option("--tol", type=click.FloatRange(0, min_open=True), default=1e-3, show_default=True)
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, nodes: tuple[int, ...], repeats: int | None, controls: int, tol: float, out: Path) -> None:
    """Measure a certified solve against QuantEcon, mdpsolver and a hand-written numba solver on one chain."""
    sizes = nodes or ((26, 52) if quick else (200, 400, 800, 1600))
    rows: list[dict[str, Any]] = []
    for place, count in enumerate(sizes):
        chain = not place and count * (count + 1) * controls <= PAIRS
        rounds = repeats or (1 if quick else 5 if count < 800 else 3)
        first = 1 if quick or place else 3
        found = attempt(
            lambda n=count, r=rounds, c=chain, f=first: measure(n, controls, tol, r, chain=c, first=f), ABOUT
        )
        if chain:
            found += attempt(lambda n=count: beside_mdpsolver(n // 4 * 2, controls, tol), ABOUT)
        rows += checked(found)
        click.echo(table(found, COLUMNS))
        click.echo("\n".join(f"{row['status'].lower()}: {row['reason']}" for row in found if "reason" in row))
    found = attempt(lambda: saving(50 if quick else 2000, 101, tol, repeats or (1 if quick else 5)), ABOUT)
    click.echo(table(checked(found), COLUMNS))
    figures = judged(rows)
    rows += found
    rows += thresholds.announced(figures, "peers")
    publish(out, "peers", rows)
