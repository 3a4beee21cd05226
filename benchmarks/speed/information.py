"""The cost of feedback from an information state, against state feedback: section 13.2 of the chapter.

A feedback of n measured states is a table of O(1/h^n) numbers on a grid of spacing h. If the states are not measured,
the controller feeds back a function on that grid (p or a density). With each of its 1/h^n values resolved to h, the
table of the controller has O((1/h)^(1/h^n)) entries. ``formula`` rows contain these two counts and no measurement.

``measured`` rows solve the control problem of a belief with S hidden states (the 1/h^n cells of the formula) on N nodes
per axis (its 1/h). The table has N^(S−1) entries, with S − 1 because beliefs sum to one; the table of a controller that
measures the state has S entries. Seconds are of a whole warm ``solve``. Bytes are the table of value and action; bytes
per node are the peak of the program. ``error`` is the largest difference from the finest grid with the same number of
hidden states, at beliefs of at least 0.05 in every state. With more than two hidden states the grid is in the
logarithms of π and needs far more nodes for the same error.
"""

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import click
import jax
import jax.numpy as jnp
import numpy as np

import hjbjax as hjb
from benchmarks.harness import footprint
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table
from benchmarks.harness.timing import interleaved
from hjbjax.applications.convergence import fitted_order
from hjbjax.filtering import BeliefProblem, belief_problem

COLUMNS = (
    "part", "states", "inverse_h", "hidden", "shape", "state_feedback", "information", "nodes", "table_bytes",
    "bytes_per_node", "steps", "seconds", "compile_seconds", "error", "exponent", "status",
)  # fmt: skip
SIZES = {2: (11, 21, 41, 81, 161, 321), 3: (11, 21, 41, 81, 161), 4: (9, 13, 19, 27)}
QUICK = {2: (11, 21), 3: (7, 9)}
TOL = 1e-6  # well below the errors of the grids
LEAST = 0.05  # belief in every state where errors count; the grid cuts off the faces
WORD = 8  # bytes of a float64


@dataclasses.dataclass(frozen=True)
class Machine:
    """A machine that wears from state to state and is renewed by a repair; its output is measured with noise."""

    hidden: int

    def generator(self, u: Any) -> jax.Array:
        """Wear at the rate 0.4, repair at the rate u."""
        wear = 0.4 * (np.eye(self.hidden, k=1) - np.diag([1.0] * (self.hidden - 1) + [0.0]))
        renewed = np.zeros((self.hidden, self.hidden))
        renewed[:, 0] = 1
        return jnp.asarray(wear) + u[0] * jnp.asarray(renewed - np.eye(self.hidden))

    def cost(self, u: Any) -> jax.Array:
        """The lost output, from 0 when new to 1 when worn, and the cost of the repair."""
        return jnp.linspace(0.0, 1.0, self.hidden) + 0.3 * u[0]

    def posed(self, nodes: int) -> BeliefProblem:
        """The control problem of its belief."""
        return belief_problem(
            self.generator, np.linspace(1.0, 0.0, self.hidden), self.cost,
            controls=hjb.Finite([[0.0], [2.0]]), discount=0.5, measurement_noise=0.5, nodes=nodes,
        )  # fmt: skip


def formula() -> list[dict[str, Any]]:
    """The counts of the chapter: entries of a table of state feedback, and of a gridded information state."""
    rows = []
    for states, inverse in itertools.product((1, 2), (2, 3, 4, 10)):
        cells = inverse**states
        rows.append(
            {
                "part": "formula", "states": states, "inverse_h": inverse, "hidden": cells, "state_feedback": cells,
                "information": float(inverse) ** cells, "status": "COUNTED",
            }
        )  # fmt: skip
    return rows


def measured(hidden: int, sizes: tuple[int, ...], repeats: int) -> list[dict[str, Any]]:
    """Finer and finer grids for one number of hidden states."""
    questions = {nodes: Machine(hidden).posed(nodes) for nodes in sizes}
    solutions: dict[int, hjb.Solution] = {}

    def call(nodes):
        question = questions[nodes]
        solutions[nodes] = hjb.solve(question.problem, question.grid, tol=TOL, scheme=hjb.Upwind(), throw=False)

    _, timings = interleaved({nodes: lambda nodes=nodes: call(nodes) for nodes in sizes}, repeats)  # type: ignore[misc]
    beliefs = LEAST + (1 - hidden * LEAST) * np.random.default_rng(0).dirichlet(np.ones(hidden), 500)
    at = {nodes: _values(questions[nodes], solutions[nodes], beliefs) for nodes in sizes}
    rows = []
    for nodes in sizes:
        question, solution = questions[nodes], solutions[nodes]
        error = None if nodes == sizes[-1] else float(np.max(np.abs(at[nodes] - at[sizes[-1]])))
        actions = question.problem.controls.dim
        about = {
            "part": "measured", "hidden": hidden, "inverse_h": nodes, "shape": list(question.grid.shape),
            "nodes": question.grid.size, "state_feedback": hidden, "information": float(nodes) ** hidden,
            "table_bytes": WORD * (1 + actions) * question.grid.size, "error": error, "steps": solution.steps,
            "status": solution.status.name, "tol": TOL,
        }  # fmt: skip
        rows.append(about | timings[nodes].row | footprint.of_solve(question.problem, question.grid, TOL))
    return _with_exponents(rows)


def _values(question: BeliefProblem, solution: hjb.Solution, beliefs: np.ndarray) -> np.ndarray:
    """V at some beliefs."""
    with jax.enable_x64(True):
        return np.asarray(solution.value_at(question.coordinates.from_belief(beliefs), clamp=True))


def _with_exponents(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with the fitted exponent of the nodes in the error, by grids of at most half the finest's intervals."""
    # on finer grids the difference from the finest grid is much smaller than the error
    finest = rows[-1]["inverse_h"] - 1
    known = [row for row in rows if row["status"] == "CONVERGED" and 2 * (row["inverse_h"] - 1) <= finest]
    exponent = fitted_order([row["error"] for row in known], [row["nodes"] for row in known])
    return [row | {"exponent": exponent if math.isfinite(exponent) else None} for row in rows]


@click.command()
@click.option("--quick", is_flag=True, help="Small grids, one round.")
@click.option("--repeats", type=click.IntRange(1), default=None, help="Rounds; 3 if not given, quick 1.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder of the files.")
def command(quick: bool, repeats: int | None, out: Path) -> None:
    """Measure nodes, bytes, seconds and errors of beliefs on grids; print the counts of section 13.2."""
    again = repeats or (1 if quick else 3)
    about = {"benchmark": "information", "dtype": "float64"}
    rows = attempt(formula, about | {"problem": "formula"})
    for hidden, sizes in (QUICK if quick else SIZES).items():
        name = {"problem": f"{hidden} hidden states"}
        rows += attempt(lambda s=hidden, n=sizes: measured(s, n, again), about | name)
    click.echo(table(rows, COLUMNS))
    publish(out, "information", rows)
