"""One problem on many devices: two devices on one processor against one device, and outer steps on eight devices.

JAX creates the devices of a processor when it starts, so each mesh is timed in a separate process.
``python -m benchmarks.speed.devices NODES MESH`` solves once per line of its input and prints a row for each. The
processes take turns, and ratios are taken per round. On eight devices only steps are counted, because the machine has
fewer cores.

``python -m benchmarks.speed.devices NODES 2x2x2 planes`` solves three independent double integrators in six dimensions,
and compares V with the sum of the values in the plane.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np

import hjbjax as hjb
from benchmarks import cases
from benchmarks.harness import thresholds
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table

ROOT = Path(__file__).parents[2]
COLUMNS = (
    "shape", "mesh", "seconds", "fastest", "cpu_seconds", "first_seconds", "over_one", "cpu_over_one", "steps",
    "steps_over_one", "difference", "status",
)  # fmt: skip
SIZES, EIGHT, TOL, ACTIONS = (800, 1600), 800, 1e-3, 21
SAMPLE = 40  # compared nodes per axis


class Worker:
    """A process with the devices of a mesh, which solves on request."""

    def __init__(self, nodes: int, mesh: Sequence[int]):
        command, environment = _of_process(nodes, mesh)
        self.process = subprocess.Popen(command, env=environment, stdin=-1, stdout=-1, text=True)  # pipes

    def solve(self) -> dict[str, Any]:
        """The row of one more solve."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write("solve\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"the process ended with exit code {self.process.wait()}")
        return json.loads(answer)

    def end(self) -> None:
        """End the process, and close both pipes."""
        self.process.communicate()


def _of_process(nodes: int, mesh: Sequence[int]) -> tuple[list[str], dict[str, str]]:
    """The command and the environment of a process of this file with the devices of a mesh."""
    devices = str(np.prod(mesh, dtype=int))
    command = [sys.executable, "-m", "benchmarks.speed.devices", str(nodes), "x".join(map(str, mesh))]
    return command, os.environ | {"JAX_NUM_CPU_DEVICES": devices, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}


def work(nodes: int, mesh: Sequence[int]) -> None:
    """Solve the pendulum on a mesh once per line of standard input; print a row for each to standard output."""
    import jax

    problem, grid = cases.pendulum(nodes, ACTIONS)
    axes = ("angle", "velocity")[: len(mesh)]
    devices = jax.make_mesh(tuple(mesh), axes) if np.prod(mesh) > 1 else None
    every = tuple(slice(None, None, -(-count // SAMPLE)) for count in grid.shape)
    for _ in sys.stdin:
        began, before = time.perf_counter(), time.process_time()
        answer = hjb.solve(problem, grid, tol=TOL, scheme=hjb.Upwind(), mesh=devices, throw=False, progress=False)
        row = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - before}
        row |= {"steps": answer.steps, "error": float(answer.error), "status": answer.status.name}
        print(json.dumps(row | {"sample": np.asarray(answer.value)[every].tolist()}), flush=True)


def planes(nodes: int, mesh: Sequence[int]) -> dict[str, Any]:
    """The row of three double integrators on a mesh, compared with the sum of their values in the plane."""
    import jax

    axes = jax.make_mesh(tuple(mesh), ("a", "b", "c")[: len(mesh)])
    one = hjb.solve(*cases.side_by_side(1, nodes), scheme=hjb.Upwind(), tol=TOL / 100, progress=False).value
    began = time.perf_counter()
    problem, grid = cases.side_by_side(3, nodes)
    found = hjb.solve(problem, grid, method=hjb.ValueIteration(policy=False), tol=TOL, mesh=axes, progress=False)
    seconds, truth = time.perf_counter() - began, np.add.outer(np.add.outer(one, one), one)
    off = float(np.max(np.abs(found.value - truth)))
    row = {"problem": "three double integrators", "shape": list(grid.shape), "nodes": grid.size, "mesh": list(mesh)}
    row |= {"tol": TOL, "error": float(found.error), "difference": off, "steps": found.steps, "seconds": seconds}
    # both values belong to one chain, up to their certified errors
    return row | {"status": "DISAGREES" if off > TOL * 1.03 else found.status.name}


def apart(nodes: int, mesh: Sequence[int]) -> list[dict[str, Any]]:
    """The row of ``planes``, from a process with the devices of the mesh."""
    command, environment = _of_process(nodes, mesh)
    done = subprocess.run([*command, "planes"], env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    return [json.loads(done.stdout.splitlines()[-1])]


def measure(nodes: int, meshes: Sequence[Sequence[int]], repeats: int, *, timed: bool) -> list[dict[str, Any]]:
    """One row per mesh, starting with one device; ``repeats`` rounds after the first solves."""
    workers = [Worker(nodes, mesh) for mesh in meshes]
    try:
        rounds = [[worker.solve() for worker in workers] for _ in range(1 + repeats)]
    finally:
        for worker in workers:
            worker.end()
    rows = []
    for place, mesh in enumerate(meshes):
        first, *later = (each[place] for each in rounds)
        last, one = rounds[-1][place], rounds[-1][0]
        off = float(np.max(np.abs(np.array(last["sample"]) - np.array(one["sample"]))))
        row = {"shape": [nodes, nodes + 1], "nodes": nodes * (nodes + 1), "mesh": list(mesh), "tol": TOL}
        row |= {key: last[key] for key in ("steps", "error", "status")}
        row |= {"steps_over_one": last["steps"] / one["steps"], "difference": off, "repeats": len(later)}
        # both answers are within the tolerance of the exact one
        row["status"] = row["status"] if off <= 2 * TOL else "DISAGREES"
        if timed:
            row |= {"first_seconds": first["seconds"], "fastest": min(each["seconds"] for each in later)}
            for key, ratio in (("seconds", "over_one"), ("cpu_seconds", "cpu_over_one")):
                row[key] = median(each[key] for each in later)
                row[ratio] = median(each[place][key] / each[0][key] for each in rounds[1:])
        rows.append(row)
    return rows


@click.command()
@click.option("--quick", is_flag=True, help="A small grid, one round, two devices only.")
@click.option("--nodes", type=click.IntRange(16), multiple=True, help="N of N x (N + 1); 800 and 1600 if not given.")
@click.option("--repeats", type=click.IntRange(1), default=None, help="Rounds; 7 if not given, quick 1.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, nodes: Sequence[int], repeats: int | None, out: Path) -> None:
    """Solve the pendulum to 1e-3 on one, two and eight devices of one processor."""
    sizes, again = nodes or ((48,) if quick else SIZES), repeats or (1 if quick else 7)
    about = {"benchmark": "devices", "problem": "pendulum", "dtype": "float64"}
    rows, figures = [], {}
    for size in sizes:
        found = attempt(lambda size=size: measure(size, [(1,), (2,)], again, timed=True), about)
        rows += found
        if size in SIZES and "over_one" in found[-1]:
            figures[f"devices {size}"] = found[-1]["over_one"]
    if not quick:
        found = attempt(lambda: measure(EIGHT, [(1,), (8,), (4, 2)], 0, timed=False), about)
        rows += found[1:]
        if all("steps_over_one" in row for row in found):
            figures["devices steps"] = max(row["steps_over_one"] for row in found)
    rows += attempt(lambda: apart(6 if quick else 12, (2, 2, 2)), about)
    click.echo(table(rows, COLUMNS))
    rows += thresholds.announced(figures, "devices")
    publish(out, "devices", rows)


if __name__ == "__main__":
    asked = int(sys.argv[1]), tuple(map(int, sys.argv[2].split("x")))
    if sys.argv[3:]:
        print(json.dumps(planes(*asked)))
    else:
        work(*asked)
