"""The cost and the accuracy of derivatives: value and gradient of a solve against the value only, both compiled.

The gradient is in reverse mode, with respect to all named numbers, and is compared with central differences of fourth
order. An iteration is differentiated at its fixed point, so no steps are stored, and memory does not depend on their
number.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click
import jax
import jax.numpy as jnp
import numpy as np

import hjbjax as hjb
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table
from benchmarks.harness.thresholds import announced
from benchmarks.harness.timing import interleaved

COLUMNS = (
    "problem", "numbers", "shape", "seconds", "grad_seconds", "over_solve", "over_host", "difference", "bytes",
    "status",
)  # fmt: skip
TOL, RELATIVE = 1e-10, 1e-6
MORE_STEPS = 10_000
STEP = 1e-5  # relative: so small that the branches of limited slopes and minima do not change

Question = tuple[hjb.Problem, hjb.Grid]


@dataclasses.dataclass(frozen=True)
class Case:
    """A number of a solution as a function of numbers of its problem."""

    pose: Callable[..., Question]  # from the numbers and N
    at: tuple[float, ...]
    numbers: str
    state: tuple[float, ...]
    read: Callable[[hjb.Problem, hjb.Solution, jax.Array], Any]
    scheme: Any = None
    nodes: int = 100

    def __call__(self, numbers: jax.Array, *, nodes: int, max_steps: int | None = None) -> Any:
        problem, grid = self.pose(*numbers, nodes)
        solution = hjb.solve(problem, grid, scheme=self.scheme, tol=TOL, max_steps=max_steps)
        return self.read(problem, solution, jnp.array(self.state))


def value(problem: hjb.Problem, solution: hjb.Solution, x: jax.Array) -> Any:
    return solution.value_at(x)


def control(problem: hjb.Problem, solution: hjb.Solution, x: jax.Array) -> Any:
    return solution.control_at(x)[0]


def path_cost(problem: hjb.Problem, solution: hjb.Solution, x: jax.Array) -> Any:
    return hjb.simulate(problem, solution.control_at, x, 2.0, steps=40, rtol=1e-9, atol=1e-11).cost


def pendulum(mass: Any, discount: Any, nodes: int) -> Question:
    return hjb.zoo.pendulum(mass=mass, discount=discount, shape=(nodes, nodes + 1))


def stochastic_lq(weight: Any, noise: Any, nodes: int) -> Question:
    return hjb.zoo.stochastic_lq(control_weight=weight, noise=noise, discount=0.5, shape=(4 * nodes + 1,))


def minimum_time(bound: Any, radius: Any, nodes: int) -> Question:
    problem = hjb.Problem(
        lambda x, u: jnp.stack([x[1], u[0]]),
        lambda x, u: 1.0,
        hjb.Box(jnp.stack([-bound]), jnp.stack([bound])),
        target=lambda x: jnp.hypot(x[0], x[1]) - radius,
        exit_cost=0.0,
    )
    return problem, hjb.Grid([-2.0, -2.0], [2.0, 2.0], (nodes, nodes - 1))


def lq_game(gamma: Any, rate: Any, nodes: int) -> Question:
    return hjb.zoo.lq_game(gamma=gamma, rate=rate, discount=0.5, shape=(4 * nodes + 1,))


CASES = {
    "pendulum, monotone": Case(pendulum, (1.2, 0.4), "mass, discount", (0.5, -0.3), value, hjb.Upwind()),
    "pendulum": Case(pendulum, (1.2, 0.4), "mass, discount", (0.5, -0.3), value),
    "stochastic LQ": Case(stochastic_lq, (1.1, 0.4), "weight, noise", (0.4,), value),
    "minimum time": Case(minimum_time, (1.1, 0.41), "control bound, target radius", (0.8, 0.5), value),
    "LQ game": Case(lq_game, (2.0, 0.2), "gamma, rate", (0.7,), value),
    "control_at of the pendulum": Case(pendulum, (1.2, 0.4), "mass, discount", (0.3, -0.2), control),
    "cost of a pendulum's path": Case(pendulum, (1.2, 0.4), "mass, discount", (0.3, -0.2), path_cost, nodes=50),
}


def differences(function: Callable[[np.ndarray], Any], at: np.ndarray) -> np.ndarray:
    """Central differences of fourth order."""

    def slope(e: np.ndarray) -> float:
        near, far = ((float(function(at + k * e)) - float(function(at - k * e))) / (2 * k) for k in (1, 2))
        return (4 * near - far) / 3

    return np.array([slope(step * e) / step for e, step in zip(np.eye(at.size), STEP * np.abs(at), strict=True)])


def memory(case: Case, at: np.ndarray, nodes: int, steps: int) -> int:
    """Bytes of the compiled gradient in addition to its arguments and results."""
    gradient = jax.jit(jax.grad(partial(case, nodes=nodes, max_steps=steps)))
    return int(gradient.lower(at).compile().memory_analysis().temp_size_in_bytes)


def measure(name: str, nodes: int | None, repeats: int) -> dict[str, Any]:
    """The row of one case."""
    case = CASES[name]
    nodes, at = nodes or case.nodes, np.array(case.at)
    problem, grid = case.pose(*case.at, nodes)
    with jax.enable_x64(True):
        function = partial(case, nodes=nodes)
        solve, gradient = jax.jit(function), jax.jit(jax.value_and_grad(function))
        results, timings = interleaved(
            {
                "solve": lambda: solve(at),
                "gradient": lambda: gradient(at),
                "host": lambda: hjb.solve(problem, grid, scheme=case.scheme, tol=TOL, throw=False),
            },
            repeats,
        )
        found, wanted = np.asarray(results["gradient"][1]), differences(solve, at)
        few, many = (memory(case, at, nodes, steps) for steps in (10, MORE_STEPS))
    off = float(np.max(np.abs(found - wanted) / np.abs(wanted)))
    return {
        "shape": list(grid.shape), "nodes": grid.size, "numbers": case.numbers, "tol": TOL,
        **timings["solve"].row, "grad_seconds": timings["gradient"].seconds,
        "grad_compile_seconds": timings["gradient"].compile_seconds,
        "over_solve": timings["gradient"].over(timings["solve"]),
        "over_host": timings["gradient"].over(timings["host"]),
        "gradient": found.tolist(), "differences": wanted.tolist(), "difference": off,
        "bytes": many, "bytes_of_ten_steps": few,
        "status": "OK" if off <= RELATIVE else "DISAGREES",
    }  # fmt: skip


@click.command()
@click.option("--quick", is_flag=True, help="Small grids, one round.")
@click.option("--nodes", type=click.IntRange(8), default=None, help="N of N x (N + 1); 100 if not given, quick 16.")
@click.option("--repeats", type=click.IntRange(1), default=None, help="Rounds; 5 if not given, quick 1.")
@click.option("--only", type=click.Choice(list(CASES)), multiple=True, help="These cases alone.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the file.")
def command(quick: bool, nodes: int | None, repeats: int | None, only: tuple[str, ...], out: Path) -> None:
    """Measure value and gradient of a solve against the value only."""
    nodes, repeats = nodes or (16 if quick else None), repeats or (1 if quick else 5)
    rows: list[dict[str, Any]] = []
    for name in only or CASES:
        about = {"benchmark": "gradients", "problem": name, "dtype": "float64"}
        rows += attempt(lambda name=name: [measure(name, nodes, repeats)], about)
        click.echo(table(rows[-1:], COLUMNS))
    costs = [row["over_solve"] for row in rows if row["status"] == "OK"]
    if costs and not quick and not only:  # on small grids the time is dominated by the call
        rows += announced({"gradient": max(costs)}, "gradients")
    publish(out, "gradients", rows)
