"""The first answer of a process: the time from calling ``hjb.solve`` to the value, including compiling.

``python -m benchmarks.speed.first_answer PROBLEM NODES WAY`` solves one problem in a new process and prints its row as
JSON; ``startup`` starts these processes. Seconds of programs come from JAX's own events. "one loop" is the longest
compilation of a loop of steps. It is a lower bound for a first answer on the grid, because every solve has such a loop.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import jax

import hjbjax as hjb
from benchmarks import cases

ROOT = Path(__file__).parents[2]
COMPILED = "/jax/core/compile/backend_compile_duration"
LOOP = "jit(run)"
LIMIT = 60.0  # seconds of a solve: sweeps without coarser grids need more steps on finer grids

Case = Callable[[int], tuple[hjb.Problem, hjb.Grid]]
ZOO: dict[str, Case] = {
    "pendulum": lambda n: hjb.zoo.pendulum(shape=(n - 1, n)),
    "pendulum, discounted": lambda n: hjb.zoo.pendulum(discount=0.1, shape=(n - 1, n)),
    "double integrator": lambda n: hjb.zoo.double_integrator(shape=(n, n)),
    "double integrator, undiscounted": lambda n: hjb.zoo.double_integrator(discount=0.0, shape=(n, n)),
    "double integrator, quadratic": lambda n: hjb.zoo.double_integrator_lq(shape=(n, n)),
    "double integrator, noisy": lambda n: hjb.zoo.double_integrator_lq(noise=0.5, discount=0.5, shape=(n, n)),
    "brownian exit": lambda n: hjb.zoo.brownian_exit(dim=2, shape=(n, n)),
    "brownian ball": lambda n: hjb.zoo.brownian_ball(shape=(n, n)),
    "zermelo": lambda n: hjb.zoo.zermelo(shape=(n, n)),
    "eikonal": lambda n: hjb.zoo.eikonal(shape=(n, n)),
    "van der Pol": lambda n: hjb.zoo.van_der_pol(shape=(n, n)),
    "smooth": lambda n: hjb.zoo.smooth(shape=(n, n)),
}
SAMPLED: dict[str, Case] = {f"pendulum, {k} torques": lambda n, k=k: cases.pendulum(n - 1, k) for k in (21, 31)}
WAYS: dict[str, dict[str, Any]] = {
    "default": {},
    "monotone": {"scheme": hjb.Upwind()},
    "one grid": {"method": hjb.PolicyIteration()},
    "to 1e-3": {"scheme": hjb.Upwind(), "tol": 1e-3},
}


def solve(problem: str, nodes: int, way: str) -> dict[str, Any]:
    """The row of the first solve in this process, and of the same solve again."""
    programs: list[tuple[str, float]] = []

    def note(event, seconds, fun_name="", **_):
        if event == COMPILED:
            programs.append((fun_name, seconds))

    question, grid = (ZOO | SAMPLED)[problem](nodes)
    jax.block_until_ready(jax.device_put(0.0))  # initialise the device before the clock starts
    jax.monitoring.register_event_duration_secs_listener(note)
    seconds, busy = [], []
    for _ in range(2):
        began, before = time.perf_counter(), time.process_time()
        answer = hjb.solve(question, grid, **WAYS[way], time_limit=LIMIT, throw=False)
        seconds.append(time.perf_counter() - began)
        busy.append(time.process_time() - before)
        if len(seconds) == 1:
            compiled = list(programs)
    loops = [took for name, took in compiled if name == LOOP]
    return {
        "shape": list(grid.shape),
        "nodes": grid.size,
        "first_seconds": seconds[0],
        "first_cpu_seconds": busy[0],
        "seconds": seconds[1],
        "programs": len(compiled),
        "compile_seconds": sum(took for _, took in compiled),
        "loops": len(loops),
        "loop_seconds": loops,
        "over_one_loop": seconds[0] / max(loops) if loops else None,
        "error": answer.error,
        "status": answer.status.name,
    }


def apart(problem: str, nodes: int, way: str, **environment: str) -> dict[str, Any]:
    """The row of a solve in a separate process."""
    command = [sys.executable, "-m", __spec__.name, problem, str(nodes), way]
    surroundings = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false", "PYTHONPATH": str(ROOT)} | environment
    done = subprocess.run(command, env=surroundings, cwd=ROOT, check=True, capture_output=True, text=True)
    return {"problem": problem, "way": way} | json.loads(done.stdout.splitlines()[-1])


def middle(problem: str, nodes: int, ways: tuple[str, ...], repeats: int) -> list[dict[str, Any]]:
    """One row per way of solving, from the median first answer; the ways take turns."""
    found: dict[str, list[dict[str, Any]]] = {way: [] for way in ways}
    for _ in range(repeats):
        for way in ways:
            found[way].append(apart(problem, nodes, way))
    rows, others = [], found[ways[0]]
    for runs in found.values():
        row = dict(sorted(runs, key=lambda run: run["first_seconds"])[len(runs) // 2])
        ratios = [mine["first_seconds"] / first["first_seconds"] for mine, first in zip(runs, others, strict=True)]
        warm = [mine["seconds"] / first["seconds"] for mine, first in zip(runs, others, strict=True)]
        row |= {"repeats": repeats, f"over_{ways[0]}": median(ratios), f"warm_over_{ways[0]}": median(warm)}
        rows.append(row)
    return rows


def sizes(problem: str, nodes: int, way: str) -> list[int]:
    """The number of operations of each loop before XLA optimises it, from a process that dumps its programs."""
    with tempfile.TemporaryDirectory() as folder:
        flags = f"--xla_dump_to={folder} --xla_dump_hlo_as_text --xla_dump_hlo_module_re=jit_run"
        apart(problem, nodes, way, XLA_FLAGS=f"{os.environ.get('XLA_FLAGS', '')} {flags}")
        texts = sorted(Path(folder).glob("*jit_run*before_optimizations.txt"))
        return [len(re.findall(r"^ +(?:ROOT )?%?[\w.-]+ = ", text.read_text(), re.MULTILINE)) for text in texts]


if __name__ == "__main__":
    print(json.dumps(solve(sys.argv[1], int(sys.argv[2]), sys.argv[3])))
