"""The memory estimate against the measured peak of a separate process, for solves and marches on large grids.

Each process first answers the same question, so that compiling does not count: the programs of a first answer take 0.1
to 0.4 GB more, on a grid of any size. glibc keeps freed arrays of up to 32 MB, unless its threshold is fixed.
"""

import gc
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table

COLUMNS = ("question", "run", "shape", "told", "peak", "told_over_peak", "seconds", "steps", "status")
# question, run, nodes per axis, and number of steps or horizon; in single precision, the pendulums in double
CASES: tuple[tuple[str, str, int, float], ...] = (
    ("quadrotor tube", "march, value alone", 21, 0.02),
    ("quadrotor tube", "march, Upwind", 17, 0.02),
    ("quadrotor tube", "march, Limited", 14, 0.02),
    ("quadrotor tube", "solve, value alone", 21, 3),
    ("quadrotor tube", "solve, value iteration", 17, 3),
    ("quadrotor LQ", "solve from a guess, value alone", 21, 3),
    ("Dubins tube", "march, value alone", 361, 0.02),
    ("Dubins tube", "march, Limited", 201, 0.02),
    ("pendulum", "solve, default", 1600, 50),
    ("pendulum", "solve, Upwind", 1600, 50),
    ("pendulum without discount", "solve, default", 1600, 50),
    ("pendulum without discount", "solve, Upwind", 1600, 50),
    ("pendulum with noise", "solve, default", 1600, 50),
    ("pendulum against a disturbance", "solve, default", 800, 50),
    ("pendulum against a disturbance", "march, Upwind", 800, 0.002),
    ("four pendulums", "solve_batch, default", 800, 50),
)
QUICK = 12  # nodes per axis
THRESHOLD = {"MALLOC_MMAP_THRESHOLD_": "1000000"}  # bytes; the memory of larger arrays is returned when they are freed


@click.command()
@click.option("--quick", is_flag=True, help="Small grids, on which compiling dominates: no verdict.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, out: Path) -> None:
    """Run each large grid in a separate process, and print estimated and measured memory."""
    rows: list[dict[str, Any]] = []
    for question, run, count, length in CASES[:2] if quick else CASES:
        dtype = "float64" if "pendulum" in question else "float32"
        about = {"benchmark": "memory", "question": question, "run": run, "dtype": dtype}
        rows += attempt(lambda case=(question, run, QUICK if quick else count, length): [apart(*case)], about)
        click.echo(f"{question}, {run}: {rows[-1].get('told_over_peak') or rows[-1].get('reason')}", err=True)
    click.echo(table(rows, COLUMNS))
    publish(out, "memory", rows)


def apart(question: str, run: str, count: int, length: float) -> dict[str, Any]:
    """The row of one run in a separate process."""
    command = [sys.executable, "-m", "benchmarks.accuracy.memory", question, run, str(count), str(length)]
    folder, environment = Path(__file__).parents[2], {**os.environ, **THRESHOLD}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    return json.loads(done.stdout.splitlines()[-1])


def here(question: str, run: str, count: int, length: float) -> dict[str, Any]:
    """The row of one run in this process; on a CPU a batch solves as many lanes at a time as there are cores."""
    ask = of_pendulum if "pendulum" in question else answer
    ask(question, run, count, length)
    gc.collect()
    before = status("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from now on
    found = ask(question, run, count, length)
    peak, lanes = status("VmHWM") - before, found if isinstance(found, list) else [found]
    solution, told = lanes[0], sum(int(each.stats["bytes"]) for each in lanes[: os.cpu_count()])
    return {
        "shape": list(solution.grid.shape), "nodes": solution.grid.size, "told": told / 1e9, "peak": peak / 1e9,
        "told_bytes_per_node": told / solution.grid.size, "peak_bytes_per_node": peak / solution.grid.size,
        "told_over_peak": told / peak, "seconds": solution.stats["seconds"], "steps": int(solution.steps),
        "status": "OK" if solution.status.name in ("CONVERGED", "MAX_STEPS") else solution.status.name,
    }  # fmt: skip


def status(name: str) -> int:
    """Bytes of an entry in this process's Linux status file."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1]) * 1024


def answer(question: str, run: str, count: int, length: float) -> Any:
    """The solution of a question with ``count`` nodes per axis; angles have an even number."""
    import warnings

    import jax.numpy as jnp
    import numpy as np

    import hjbjax as hjb

    warnings.simplefilter("ignore")  # drift is cut off, and grids are coarse
    even = count + count % 2

    def disc(x):
        return jnp.hypot(x[0], x[1]) - 0.5

    if question.startswith("quadrotor"):
        quadrotor = hjb.zoo.PlanarQuadrotor()
        drift, controls = quadrotor.drift, hjb.Box([0.0, -0.4], [2 * quadrotor.hover, 0.4])
        shape, periodic = (count, count, even, *[count] * 3), (False, False, True, *[False] * 3)
        grid = hjb.Grid([-2.0, -2.0, -np.pi, *[-4.0] * 3], [2.0, 2.0, np.pi, *[4.0] * 3], shape, periodic)
    else:
        drift, controls = hjb.zoo.Dubins().drift, hjb.Box([-1.0], [1.0])
        grid = hjb.Grid([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi], (count, count, even), periodic=(False, False, True))
    problem = hjb.reach(drift, controls, disc)
    if question.endswith("LQ"):
        problem = hjb.Problem(drift, lambda x, u: x @ x + u @ u, controls, discount=1.0)
    options: dict[str, Any] = {"dtype": "float32", "throw": False, "progress": False}
    if run.startswith("march"):
        scheme = hjb.Limited() if run.endswith("Limited") else hjb.Upwind()
        return hjb.march(problem, grid, length, scheme=scheme, policy=not run.endswith("alone"), **options)
    if "guess" in run:
        options["guess"] = np.ones(grid.shape, np.float32)
    method = hjb.ValueIteration(policy=not run.endswith("alone"))
    return hjb.solve(problem, grid, method=method, max_steps=int(length), **options)


def of_pendulum(question: str, run: str, count: int, length: float) -> Any:
    """The solution of the zoo's pendulum on count x (count + 1) nodes, or the solutions of a batch."""
    import dataclasses
    import warnings

    import hjbjax as hjb
    from benchmarks import cases

    warnings.simplefilter("ignore")
    if question.endswith("without discount"):
        problem, grid = cases.undiscounted_pendulum(count)
    else:
        problem, grid = cases.pendulum(count, None)
    if question.endswith("noise"):
        problem = dataclasses.replace(problem, noise=(0.1, 0.2))
    if question.endswith("disturbance"):
        drift, cost = problem.drift, problem.cost
        problem = dataclasses.replace(
            problem, drift=lambda x, u, d: drift(x, u + d), cost=lambda x, u, d: cost(x, u),
            disturbances=hjb.Box([-0.1], [0.1]),
        )  # fmt: skip
    scheme = hjb.Upwind() if run.endswith("Upwind") else None
    if run.startswith("march"):
        return hjb.march(problem, grid, length, scheme=scheme, throw=False, progress=False)
    options: dict[str, Any] = {"scheme": scheme, "max_steps": int(length), "throw": False, "progress": False}
    if question.startswith("four"):
        rates = [problem.discount * (1 + lane / 10) for lane in range(4)]
        lanes = [dataclasses.replace(problem, discount=rate) for rate in rates]
        return hjb.solve_batch(lanes, grid, **options)
    return hjb.solve(problem, grid, **options)


def main(arguments: Sequence[str]) -> None:
    question, run, count, length = arguments
    print(json.dumps(here(question, run, int(count), float(length))))


if __name__ == "__main__":
    main(sys.argv[1:])
