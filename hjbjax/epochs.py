"""The host's loop over the kept times of a march, and the solution that comes of it.

Between two kept times the compiled ``run`` is called in chunks of about half a second; progress, Ctrl-C, time
limits and stops at NaN live between two chunks. How long a chunk is changes no bit of the answer.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import hamiltonian, marching, players
from hjbjax.driver import CHUNK_SECONDS, Clock, noting_interrupts, ticker
from hjbjax.grid import Grid
from hjbjax.marching import Explicit, Front, Implicit, March
from hjbjax.sets import Finite
from hjbjax.solution import Solution
from hjbjax.status import Status

CERTIFICATE = "of a march there is none; halve the spacings and the step to see its error"

_run = jax.jit(marching.run)
_terminal = jax.jit(marching.terminal, static_argnames="dtype")


@jax.jit
def _greedy(march: March, value: jax.Array, t: Any) -> tuple:
    return marching.greedy(march, value, t), march.rules_at(t, value.dtype).ended


@jax.jit
def _isaacs_gap(task: March, value: jax.Array, t: Any) -> jax.Array:
    """max over the nodes of min max − max min; zero where the two players are separate terms."""
    how = players.setting(task.problem, task.grid.ndim, value.dtype)
    if how.separable:
        return jnp.zeros(())
    here = hamiltonian.local(task.problem, task.grid, value, scheme=task.scheme, t=t)
    upper, lower = (hamiltonian.optimise(here, how, isaacs=which)[0] for which in ("upper", "lower"))
    return jnp.max(jnp.where(task.rules_at(t, value.dtype).held, 0, upper - lower))


class Slices:
    """What is kept, filled from the last time to the first: NumPy arrays, allocated once."""

    def __init__(self, task: March, kept: np.ndarray):
        problem, shape, dtype = task.problem, task.grid.shape, np.dtype(task.horizon.dtype)
        sizes = [choices.dim if choices is not None else 0 for choices in (problem.controls, problem.disturbances)]
        self.times = np.array(kept)
        self.value = np.empty((len(kept), *shape), dtype)
        self.policy, self.disturbance = (np.empty((len(kept), *shape, size), dtype) for size in sizes)
        self.first = len(kept)

    def keep(self, task: March, value: jax.Array, t: Any) -> None:
        """The next slice; the policy is NaN on the target."""
        (u, d), ended = jax.device_get(_greedy(task, value, t))
        self.first -= 1
        self.times[self.first] = float(t)
        self.value[self.first] = value
        for array, action in ((self.policy, u), (self.disturbance, d)):
            for j, entry in enumerate(action):
                array[self.first, ..., j] = np.where(ended, np.nan, entry)


def drive(task: March, kept: np.ndarray, start: Any, clock: Clock) -> tuple[Slices, Front, Status]:
    """From kept time to kept time in chunks; stops at a code, at the time limit, or at Ctrl-C."""
    dtype, slices, chunk = np.dtype(task.horizon.dtype), Slices(task, kept), 1
    start = None if start is None else jnp.asarray(start, dtype)
    front = marching.begin(task, _terminal(task.problem, task.grid, task.horizon, dtype, start))
    code = Status.RUNNING if bool(jnp.all(jnp.isfinite(front.value))) else Status.NONFINITE
    with ticker(clock.progress, float(task.horizon), "march") as show, noting_interrupts(clock):
        try:
            jax.block_until_ready(_run(task, front, jnp.asarray(0, dtype), 0))  # compiles
            for t in kept[::-1]:
                until = jnp.asarray(t, dtype)
                while code is Status.RUNNING and float(front.t) > float(until):
                    code = _stopped(clock)
                    if code is Status.RUNNING:
                        front, code, chunk = _chunk(task, front, until, chunk, clock)
                        show(float(task.horizon) - float(front.t), int(front.steps))
                if code is not Status.RUNNING:
                    break
                slices.keep(task, front.value, front.t)
        except KeyboardInterrupt:
            code = Status.INTERRUPTED
    if code is not Status.RUNNING and slices.first > 0 and bool(jnp.all(jnp.isfinite(front.value))):
        slices.keep(task, front.value, front.t)  # how far it came
    return slices, front, Status.CONVERGED if code is Status.RUNNING else code


def _stopped(clock: Clock) -> Status:
    if clock.interrupted:
        return Status.INTERRUPTED
    return Status.TIME_LIMIT if clock.elapsed() >= clock.seconds else Status.RUNNING


def _chunk(task: March, front: Front, until: Any, chunk: int, clock: Clock) -> tuple[Front, Status, int]:
    """One chunk of steps; one that ends in numbers that are not finite is taken back to the last step before."""
    began = time.perf_counter()
    after = jax.block_until_ready(_run(task, front, until, chunk))
    took, done = time.perf_counter() - began, int(after.steps) - int(front.steps)
    clock.stepping += took
    code = Status(int(after.code))
    if code is Status.NONFINITE:
        after = _run(task, front, until, done - 1)
    chunk = int(np.clip(done * CHUNK_SECONDS / max(took, 1e-4), 1, 8 * chunk))
    return after, code, chunk


def assemble(task: March, grid: Grid, slices: Slices, front: Front, code: Status) -> Solution:
    """What was kept, and how it went, as a solution on the user's ``grid``."""
    problem = task.problem
    kept = slice(slices.first, None)
    return Solution(
        grid,
        slices.value[kept],
        slices.policy[kept],
        slices.disturbance[kept] if problem.is_game else None,
        code=int(code),
        steps=int(front.steps),
        isaacs_gap=float(_isaacs_gap(task, front.value, front.t)) if problem.is_game else None,
        times=slices.times[kept],
        discrete=isinstance(problem.controls, Finite),
        discrete_disturbance=isinstance(problem.disturbances, Finite),
        message=_message(task, front, code),
        stats={
            "method": _describe(task.method),
            "scheme": repr(task.scheme),
            "device": str(jax.devices()[0].device_kind),
            "dtype": str(slices.value.dtype),
            "certificate": CERTIFICATE,
            "versions": {"jax": jax.__version__, "numpy": np.__version__},
        },
    )


def _message(task: March, front: Front, code: Status) -> str:
    t, horizon = float(front.t), float(task.horizon)
    if code is Status.CONVERGED:
        return f"Marched from t = {horizon:g} to t = {t:g}."
    what = {
        Status.DIVERGED: "The value blows up: the worst disturbance reached its bound inside the box. A wider box of "
        "disturbances tells how fast; where the bound is meant, give inner=0.",
        Status.NONFINITE: "NaN or infinity appeared in the step after, and the last finite value is kept; check drift "
        "and costs there, or take a shorter step.",
        Status.TIME_LIMIT: "The time ran out; raise time_limit, or march on from the value so far with start=.",
        Status.INTERRUPTED: "It was interrupted and the value so far is kept; march on from it with start=.",
        Status.STALLED: "The policy iteration of an implicit step did not come to its end; take a shorter step.",
    }
    return f"The march stopped at t = {t:.6g} on its way from {horizon:g}. {what.get(code, code.message)}"


def _describe(method: Explicit | Implicit) -> str:
    """The method as one would write it."""
    if isinstance(method, Explicit):
        return f"Explicit(stages={method.stages}, fraction={float(method.fraction):g})"
    return f"Implicit({method.evaluation!r}, tol={float(method.tol):g})"
