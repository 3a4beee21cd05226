"""One Bellman sweep: node-controls per second, against a hand-written numba loop and against copying the value.

    V ← V + (min_u H − β V)/(max_u Q + β)        a step of value iteration, once over all nodes

Kernels: ``sweep`` is this line in a separate compiled call, and ``loop`` several of them in one compiled loop.
``improve`` also stores the greedy controls, as policy iteration requires. ``step`` is a whole step of ``solve`` with
``ValueIteration``, including the certificate. ``numba`` is the ``jacobi_sweep`` of the numba solver. ``copy`` reads a
value and writes a multiple of it, the limit set by the memory. The pace max_u Q + β does not change between sweeps, so
both codes get it as an array. Both use all cores. The fraction of the copy bandwidth is the seconds of ``copy`` over
the seconds of the kernel. Both sweeps are compared number by number before anything is timed.
"""

import functools
import math
from pathlib import Path
from typing import Any

import click
import jax
import jax.numpy as jnp
import numpy as np

import hjbjax as hjb
from benchmarks import cases
from benchmarks.harness import thresholds
from benchmarks.harness.footprint import bytes_of
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table, threads, without
from benchmarks.harness.timing import interleaved
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import fastest_rate
from hjbjax.iteration import bellman, fixed_point
from hjbjax.problem.pytree import cast
from hjbjax.solvers import memory, stationary_run
from hjbjax.solvers.setup import prepare_on_host

COLUMNS = (
    "problem", "kernel", "threads", "numba_threads", "shape", "controls", "seconds", "compile_seconds",
    "node_controls_per_second", "node_controls_per_cpu_second", "against_numba", "fraction_of_copy", "bytes_per_node",
    "bytes_beyond", "status",
)  # fmt: skip
SCHEME = hjb.Upwind()
KIND = np.dtype(np.float32)
AGREE = 1e-5  # of the largest |V|: float32, and two orders of summation
LARGE = ((8192, 8192), (512,) * 3, (104,) * 4, (22,) * 6)  # sizes that fill a GPU
LIMIT_ON_CPU = 1 << 24  # nodes; larger sweeps on two cores show nothing new
SIX = (20,) * 6


def greedy(problem: Any, grid: Any, value: jax.Array) -> Any:
    """The greedy policy and r = min H − β V."""
    return bellman.greedy(Discretisation(problem, grid, SCHEME, value.dtype), value, jnp.zeros((), bool))


def sweep(problem: Any, grid: Any, value: jax.Array, outflow: jax.Array) -> jax.Array:
    """V + r/(max Q + β) with r = min H − β V, as in value iteration; no action is stored."""
    return value + bellman.relaxation(Discretisation(problem, grid, SCHEME, value.dtype), value, outflow)[0] / outflow


@functools.partial(jax.jit, donate_argnums=0, keep_unused=True)
def one(old: jax.Array, problem: Any, grid: Any, value: jax.Array, outflow: jax.Array) -> jax.Array:
    """A sweep that overwrites ``old``, as the numba sweep does."""
    return sweep(problem, grid, value, outflow)


@functools.partial(jax.jit, donate_argnums=0, static_argnums=4)
def several(value: jax.Array, problem: Any, grid: Any, outflow: jax.Array, count: int) -> jax.Array:
    """Several sweeps in one compiled loop."""
    return jax.lax.fori_loop(0, count, lambda _, value: sweep(problem, grid, value, outflow), value)


@jax.jit
def improve(problem: Any, grid: Any, value: jax.Array) -> Any:
    """The greedy controls and their residual."""
    return greedy(problem, grid, value)


@functools.partial(jax.jit, donate_argnums=0, keep_unused=True)
def copy(old: jax.Array, value: jax.Array) -> jax.Array:
    """Read one array and write another."""
    return value * jnp.asarray(0.999, value.dtype)


@jax.jit
def paces(problem: Any, grid: Any) -> jax.Array:
    """max_u Q + β at the nodes."""
    return fastest_rate(Discretisation(problem, grid, SCHEME, KIND)) + problem.discount


def started(grid: hjb.Grid) -> jax.Array:
    """A smooth initial value."""
    return jnp.asarray(sum(np.cos(each) for each in jax.device_get(grid.components(KIND))), KIND)


def turning(function: Any, *arrays: jax.Array, count: int) -> Any:
    """Call ``function(old, new)`` ``count`` times; each result is the next ``new``, and both arrays are reused."""
    pair = list(arrays)

    def call():
        for _ in range(count):
            pair[:] = [pair[1], function(*pair)]
        return pair[1]

    return call


def theirs(problem: Any, grid: hjb.Grid, points: np.ndarray, count: int) -> Any:
    """The sweeps of the numba solver, called in the same way."""
    from benchmarks.peers.numba_pendulum import jacobi_sweep

    pair = [np.empty(grid.shape, KIND), np.array(started(grid))]
    outflow, discount = np.array(paces(*cast((problem, grid), KIND))), float(problem.discount)

    def call():
        for _ in range(count):
            jacobi_sweep(pair[1], pair[0], points, discount, outflow)
            pair.reverse()
        return pair[1]

    return call


def largest_difference(problem: Any, grid: hjb.Grid, points: np.ndarray) -> float:
    """max |W − W'| / max |V| after one sweep of each code from one value, with one pace in both."""
    from benchmarks.peers.numba_pendulum import jacobi_sweep

    value = started(grid)
    wanted, case = np.empty(grid.shape, KIND), cast((problem, grid), KIND)
    outflow = paces(*case)
    jacobi_sweep(np.array(value), wanted, points, float(problem.discount), np.array(outflow))
    found = sweep(*case, value, outflow)
    moved = np.max(np.abs(wanted - value))
    off = float(np.max(np.abs(np.asarray(found) - wanted)) / np.max(np.abs(value)))
    if not off <= AGREE < moved:
        raise ValueError(f"the sweeps differ by {off:.2g} of the value, and one moves it by {moved:.2g}")
    return off


def candidates(problem: Any, grid: hjb.Grid, count: int) -> dict[str, Any]:
    """The timed functions at one size, ``count`` sweeps per call."""
    case = cast((problem, grid), KIND)
    outflow, value = paces(*case), started(grid)
    again, looping = jnp.copy, [started(grid)]

    def looped():
        looping[0] = several(looping[0], *case, outflow, count)
        return looping[0]

    def improvements():
        for _ in range(count):
            found = improve(*case, value)
        return found

    return {
        "sweep": turning(lambda old, new: one(old, *case, new, outflow), again(value), again(value), count=count),
        "loop": looped,
        "improve": improvements,
        "copy": turning(copy, again(value), again(value), count=count),
    }


def whole_steps(problem: Any, grid: hjb.Grid, count: int) -> Any:
    """Steps of ``solve`` with value iteration, run as its host loop does."""
    method = hjb.ValueIteration()
    task, _, _ = prepare_on_host(Discretisation(problem, grid, SCHEME, KIND), method=method, tol=1e-30)
    states = [stationary_run.run(task, fixed_point.start(task, started(grid)), 1)]

    def call():
        states[0] = stationary_run.run(task, states[0], int(states[0].progress.evaluations) + count)
        return states[0].value

    return call


def sweeps_per_call(grid: hjb.Grid) -> int:
    """The number of sweeps for which a call takes much longer than starting it."""
    return min(32, max(1, (1 << 23) // grid.size))


def against_numba(nodes: int, actions: int, repeats: int) -> list[dict[str, Any]]:
    """All kernels on nodes x nodes of the pendulum."""
    problem, grid = cases.pendulum(nodes, actions)
    grid = hjb.Grid(grid.lo, grid.hi, (nodes, nodes), periodic=grid.periodic)
    points = np.ascontiguousarray(problem.controls.points[:, 0], KIND)
    count = sweeps_per_call(grid)
    calls = candidates(problem, grid, count) | {"step": whole_steps(problem, grid, count)}
    about: dict[str, Any] = {}
    if (reason := without("numba")) is None:
        import numba

        about = {
            "numba_threads": numba.get_num_threads(),
            "threads": threads(),
            "difference": largest_difference(problem, grid, points),
        }
        calls = {"numba": theirs(problem, grid, points, count)} | calls
    _, timings = interleaved(calls, repeats)
    rows = [_row(kernel, grid, actions, count, timings) | about for kernel in calls]
    return rows if reason is None else [*rows, {"kernel": "numba", "status": "SKIPPED", "reason": reason}]


def by_dimension(shape: tuple[int, ...], actions: int, repeats: int) -> list[dict[str, Any]]:
    """The kernels in any dimension, on the chain of integrators, with their memory."""
    problem, grid = cases.integrators(shape, actions)
    count = sweeps_per_call(grid)
    calls = candidates(problem, grid, count)
    _, timings = interleaved(calls, repeats)
    return [_row(kernel, grid, actions, count, timings) | footprint(kernel, problem, grid) for kernel in calls]


def _row(kernel: str, grid: hjb.Grid, actions: int, count: int, timings: dict[str, Any]) -> dict[str, Any]:
    timing = timings[kernel]
    row = {"kernel": kernel, "shape": list(grid.shape), "nodes": grid.size, "controls": actions} | timing.row
    row |= {key: row[key] / count for key in ("seconds", "fastest", "cpu_seconds")} | {"sweeps_per_call": count}
    row |= {"fraction_of_copy": timings["copy"].over(timing), "status": "DONE"}
    row["copy_bytes_per_second"] = 2 * KIND.itemsize * grid.size * count / timings["copy"].seconds
    if kernel != "copy":
        row["node_controls_per_second"] = grid.size * actions / row["seconds"]
        row["node_controls_per_cpu_second"] = grid.size * actions / row["cpu_seconds"]
    if "numba" in timings and kernel != "copy":
        row["against_numba"] = timings["numba"].over(timing)
        row["fastest_against_numba"] = min(timings["numba"].rounds) / min(timing.rounds)
    return row


def footprint(kernel: str, problem: Any, grid: hjb.Grid, dtype: Any = KIND) -> dict[str, Any]:
    """Bytes per node as reported by XLA: in total, and in addition to the two values of a sweep.

    Nothing is allocated: the arrays are shapes.
    """
    case = cast((problem, grid), dtype)
    values = jax.ShapeDtypeStruct(grid.shape, dtype)
    if kernel == "sweep":
        lowered = jax.jit(sweep).lower(*case, values, values)
    elif kernel == "improve":
        lowered = improve.lower(*case, values)
    else:
        return {}
    per_node = bytes_of(lowered) / grid.size
    return {"bytes_per_node": per_node, "bytes_beyond": per_node - 2 * np.dtype(dtype).itemsize}


def in_six_dimensions() -> list[dict[str, Any]]:
    """Memory of a sweep on 20^6 nodes in addition to the old and the new value, in both precisions."""
    rows = []
    for dtype in (np.float32, np.float64):
        with jax.enable_x64(dtype is np.float64):
            problem, grid = cases.integrators(SIX)
            row = {"kernel": "sweep", "shape": list(SIX), "nodes": grid.size, "controls": 3, "status": "DONE"}
            rows.append(row | {"dtype": np.dtype(dtype).name} | footprint("sweep", problem, grid, np.dtype(dtype)))
    return rows


def fitted(shape: tuple[int, ...]) -> tuple[int, ...]:
    """The shape, or the largest similar shape that fits this machine."""
    free = memory.available()
    most = math.inf if free is None else free / (8 * KIND.itemsize)  # values, pace and controls, doubled
    if jax.devices()[0].platform == "cpu":
        most = min(most, LIMIT_ON_CPU)
    scale = min(1.0, most / math.prod(shape)) ** (1 / len(shape))
    return tuple(max(4, math.floor(count * scale)) for count in shape)


def judged(rows: list[dict[str, Any]]) -> dict[str, float]:
    """The figures with a threshold that these rows contain."""
    figures = {}
    for row in rows:
        if row.get("kernel") in ("sweep", "step") and row.get("controls") == 21 and "against_numba" in row:
            figures[f"{row['kernel']} {row['shape'][0]}"] = row["against_numba"]
        if row.get("shape") == list(SIX) and row["problem"] == "memory":
            figures["sweep 6-D"] = max(figures.get("sweep 6-D", 0.0), row["bytes_beyond"])
    return {name: value for name, value in figures.items() if name in thresholds.THRESHOLDS}


@click.command()
@click.option("--quick", is_flag=True, help="Small grids, two rounds.")
@click.option("--repeats", type=click.IntRange(1), default=None, help="Rounds; 9 if not given, quick 2.")
@click.option("--controls", type=click.IntRange(2), default=21, show_default=True, help="Of the pendulum.")
@click.option("--few", type=click.IntRange(2), default=3, show_default=True, help="Controls in the other dimensions.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, repeats: int | None, controls: int, few: int, out: Path) -> None:
    """Measure node-controls per second of one sweep, against numba and against the copy bandwidth."""
    repeats = repeats or (2 if quick else 9)
    plane = (64, 96) if quick else (1024, 2048)
    shapes = ((96, 96), (16,) * 3, (9,) * 4, (5,) * 6) if quick else tuple(map(fitted, LARGE))
    parts = [
        *(("pendulum", functools.partial(against_numba, nodes, controls, repeats)) for nodes in plane),
        *(("integrators", functools.partial(by_dimension, shape, few, repeats)) for shape in shapes),
        ("memory", in_six_dimensions),
    ]
    rows: list[dict[str, Any]] = []
    for problem, measure in parts:
        found = attempt(measure, {"benchmark": "sweep", "problem": problem, "dtype": KIND.name})
        click.echo(table(found, COLUMNS) + "\n")
        rows += found
    figures = judged(rows)
    rows += thresholds.announced(figures, "sweep")
    publish(out, "sweep", rows)
