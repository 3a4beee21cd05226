"""Marches against hj_reachability with equal schemes: seconds per step, memory, and agreement of the zero levels.

Both codes march backward over the same short horizon, on the same grid, in the same precision, with equal order in
space and time and with all threads of XLA. Each code uses the same fraction of its own stability limit, and its seconds
are divided by its own number of steps. hj_reachability bounds the rates per axis, which gives 0.5 % more steps in
Air3D, and its last step is shorter but costs the same.

Seconds and ratios are medians over several runs that take turns, without compile time. Memory is reported by XLA for
the compiled step. Writes ``march.json``.
"""

import itertools
import time
from pathlib import Path
from typing import Any

import click
import jax
import jax.numpy as jnp
import numpy as np

import hjbjax as hjb
from benchmarks.harness.report import RESULTS, Folder, attempt, publish, table, threads, without
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import time_stepping
from hjbjax.solvers import finite_horizon

COLUMNS = (
    "problem",
    "scheme",
    "who",
    "threads",
    "shape",
    "steps",
    "ms_per_step",
    "times",
    "bytes_per_node",
    "compile_seconds",
    "differs",
)
SCHEMES = {"low": hjb.Upwind(split=True), "medium": hjb.Eno2(), "very_high": hjb.Weno5()}
FRACTION = 0.75  # of the stability limit, hj_reachability's own
UNIT = hjb.Box([-1.0], [1.0])
ABOUT = {"benchmark": "march", "dtype": "float32"}


def collision(x: Any, u: Any, d: Any) -> Any:
    """Air3D in hj_reachability's own terms."""
    return jnp.stack([-5 + 5 * jnp.cos(x[2]) + u[0] * x[1], 5 * jnp.sin(x[2]) - u[0] * x[0], d[0] - u[0]])


def car(x: Any, u: Any) -> Any:
    """A car with position, speed and heading, which steers and accelerates."""
    return jnp.stack([x[2] * jnp.cos(x[3]), x[2] * jnp.sin(x[3]), u[0], u[1]])


def disc(radius: float) -> Any:
    return lambda x: jnp.sqrt(x[0] ** 2 + x[1] ** 2) - radius


def cases(scale: float) -> dict[str, tuple[Any, Any]]:
    """The problems and their grids; ``scale`` thins the nodes."""

    def shape(*counts):
        return tuple(max(8, round(count * scale)) for count in counts)

    pi = np.pi
    air = hjb.Grid([-6.0, -10.0, 0.0], [20.0, 10.0, 2 * pi], shape(101, 79, 100), (False, False, True))
    road = hjb.Grid([-5.0, -5.0, -1.0, -pi], [5.0, 5.0, 1.0, pi], shape(40, 40, 50, 50), (False,) * 3 + (True,))
    return {
        "Air3D": (hjb.avoid(collision, UNIT, disc(5.0), disturbances=UNIT), air),
        "4-D car": (hjb.reach(car, hjb.Box([-1.0, -1.0], [1.0, 1.0]), disc(1.0)), road),
    }


def ours(problem: Any, grid: Any, scheme: Any, steps: int) -> tuple[Any, float, float, float]:
    """A function that marches ``steps`` steps, its horizon, bytes per node and seconds to compile."""
    began = time.perf_counter()
    dtype = np.dtype(np.float32)
    on = Discretisation(problem, grid, scheme, dtype)
    task = finite_horizon._prepare(on, 1e3, hjb.Explicit(fraction=FRACTION), None, None, policy=True)
    start = time_stepping.begin(task, time_stepping.terminal(task.on.at(task.horizon)), task.horizon)
    until = jnp.asarray(0.0, dtype)
    compiled = jax.jit(time_stepping.run).lower(task, start, until, steps).compile()
    seconds = time.perf_counter() - began
    return lambda: compiled(task, start, until, steps).value, float(task.limit), _bytes(compiled, grid), seconds


def theirs(problem: Any, grid: Any, accuracy: str, duration: float) -> tuple[Any, float, float, int]:
    """The same for hj_reachability over the same horizon, and its number of steps."""
    import hj_reachability as hj

    began = time.perf_counter()
    game = problem.is_game
    sets = [
        hj.sets.Box(jnp.asarray(each.lo), jnp.asarray(each.hi))
        for each in (problem.controls, problem.disturbances or UNIT)
    ]

    class Affine(hj.ControlAndDisturbanceAffineDynamics):
        def __init__(self):
            super().__init__("max" if game else "min", "min", *sets)

        def open_loop_dynamics(self, state, time):
            zero = jnp.zeros(problem.controls.dim)
            return problem.drift(state, zero, jnp.zeros(1)) if game else problem.drift(state, zero)

        def control_jacobian(self, state, time):
            zero = jnp.zeros(problem.controls.dim)
            return jax.jacfwd(lambda u: problem.drift(state, u, jnp.zeros(1)) if game else problem.drift(state, u))(
                zero
            )

        def disturbance_jacobian(self, state, time):
            if not game:
                return jnp.zeros((grid.ndim, 1))
            return jax.jacfwd(lambda d: problem.drift(state, jnp.zeros(problem.controls.dim), d))(jnp.zeros(1))

    lattice = hj.Grid.from_lattice_parameters_and_boundary_conditions(
        hj.sets.Box(jnp.asarray(grid.lo), jnp.asarray(grid.hi)),
        grid.shape,
        periodic_dims=tuple(axis for axis in range(grid.ndim) if grid.periodic[axis]),
    )
    settings = hj.SolverSettings.with_accuracy(
        accuracy, hamiltonian_postprocessor=hj.solver.backwards_reachable_tube, CFL_number=FRACTION
    )
    distance = jnp.linalg.norm(lattice.states[..., :2], axis=-1) - (5.0 if game else 1.0)
    dynamics = Affine()

    def march():
        return hj.step(settings, dynamics, lattice, 0.0, distance, -duration, progress_bar=False)

    compiled = hj.step.lower(settings, dynamics, lattice, 0.0, distance, -duration, progress_bar=False).compile()
    jax.block_until_ready(march())
    seconds = time.perf_counter() - began
    return march, _bytes(compiled, grid), seconds, _count(settings, dynamics, lattice, distance, -duration)


def _count(settings: Any, dynamics: Any, lattice: Any, values: Any, until: float) -> int:
    """The number of steps of hj_reachability's integrator from 0 to a time."""

    def more(state):
        return jnp.abs(until - state[0]) > 0

    def one(state):
        return (*settings.time_integrator(settings, dynamics, lattice, *state[:2], until), state[2] + 1)

    start = jnp.asarray(0.0, values.dtype), values, 0
    return int(jax.jit(lambda state: jax.lax.while_loop(more, one, state)[2])(start))


def _bytes(compiled: Any, grid: Any) -> float:
    """Bytes per node of scratch, arguments and result of a compiled function."""
    memory = compiled.memory_analysis()
    total = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    return total / grid.size


def measure(problem: Any, grid: Any, accuracy: str, steps: int, runs: int) -> list[dict[str, Any]]:
    """One row per code; only ours if hj_reachability is not installed."""
    scheme = SCHEMES[accuracy]
    mine, dt, my_bytes, my_compile = ours(problem, grid, scheme, steps)
    marches, counts = [mine], [steps]
    reason = without("hj_reachability")
    if reason is None:
        # slightly shorter: with equal limits, rounding must not add an almost empty step
        other, their_bytes, their_compile, their_steps = theirs(problem, grid, accuracy, steps * dt * (1 - 1e-4))
        marches, counts = [mine, other], [steps, their_steps]
    seconds, values = np.zeros((runs, len(marches))), [np.zeros(0)] * len(marches)
    for turn, who in itertools.product(range(runs), range(len(marches))):
        began = time.perf_counter()
        values[who] = jax.block_until_ready(marches[who]())
        seconds[turn, who] = (time.perf_counter() - began) / counts[who]
    taken, times = 1e3 * np.median(seconds, axis=0), float(np.median(seconds[:, -1] / seconds[:, 0]))
    about = {"scheme": repr(scheme).split("(")[0], "shape": grid.shape, "threads": threads(), "status": "DONE"}
    row = {"who": "hjbjax", "steps": steps, "ms_per_step": taken[0], "bytes_per_node": my_bytes,
           "compile_seconds": my_compile}  # fmt: skip
    if reason is not None:
        return [about | row, about | {"who": "hj_reachability", "status": "SKIPPED", "reason": reason}]
    sign = -1 if problem.is_game else 1  # avoid: unsafe where V ≥ 0
    about["differs"] = float(np.mean((sign * np.asarray(values[0]) <= 0) != (np.asarray(values[1]) <= 0)))
    peer = {"who": "hj_reachability", "steps": counts[1], "ms_per_step": taken[1], "times": 1.0,
            "bytes_per_node": their_bytes, "compile_seconds": their_compile}  # fmt: skip
    return [about | row | {"times": times}, about | peer]


@click.command(help=__doc__)
@click.option("--quick", is_flag=True, help="Small grids, two steps, one run.")
@click.option("--scale", default=1.0, help="Thins the grids: 1 is 101 x 79 x 100 and 40 x 40 x 50 x 50.")
@click.option("--steps", default=6, help="Our time steps in one run.")
@click.option("--runs", default=5, help="Runs of each, in turn.")
@click.option("--problem", "wanted", default=None, help="Air3D or 4-D car; both without.")
@click.option("--out", type=Folder(), default=RESULTS, help="Folder for march.json.")
def command(quick: bool, scale: float, steps: int, runs: int, wanted: str | None, out: Path) -> None:
    if quick:
        scale, steps, runs = 0.1, 2, 1
    rows: list[dict[str, Any]] = []
    for name, (problem, grid) in cases(scale).items():
        if wanted in (None, name):
            for accuracy in SCHEMES:
                rows += attempt(lambda: measure(problem, grid, accuracy, steps, runs), ABOUT | {"problem": name})  # noqa: B023
    click.echo(table(rows, COLUMNS))
    for row in rows:
        if "reason" in row:
            click.echo(f"{row['problem']}: {row['reason']}")
    publish(out, "march", rows)
