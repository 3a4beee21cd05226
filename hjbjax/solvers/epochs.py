"""The host's loop over the kept times of a march, and the solution that comes of it.

Between two kept times the compiled ``run`` is called in chunks of about half a second; progress, Ctrl-C, time
limits and stops at NaN live between two chunks. How long a chunk is changes no bit of the answer.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import correlated_noise, edges
from hjbjax.hamiltonian import discrete
from hjbjax.hamiltonian.players import players_of
from hjbjax.iteration import time_stepping
from hjbjax.iteration.time_stepping import Front, March
from hjbjax.problem.grid import Grid
from hjbjax.problem.sets import Finite
from hjbjax.problem.types import Field, Nodes, Number, Scalar
from hjbjax.solution.clock import CHUNK_SECONDS, CUT, Clock
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status
from hjbjax.solvers.host_loop import ticker
from hjbjax.solvers.result import isaacs_gap, warn_of_cuts, warn_of_gap

CERTIFICATE = "of a march there is none; halve the spacings and the step to see its error"
ADVICE = {
    Status.DIVERGED: "The value blows up: the worst disturbance reached its bound inside the box. A wider box of "
    "disturbances tells how fast; where the bound is meant, give inner=0.",
    Status.NONFINITE: "NaN or infinity appeared in the step after, and the last finite value is kept; check drift "
    "and costs there, or take a shorter step.",
    Status.TIME_LIMIT: "The time ran out; raise time_limit, or march on from the value so far with start=.",
    Status.INTERRUPTED: "It was interrupted and the value so far is kept; march on from it with start=.",
    Status.STALLED: "The policy iteration of an implicit step did not come to its end; take a shorter step.",
}

# not donated: a chunk that ends in NaN is done again from the front before it
_run = jax.jit(time_stepping.run)
_terminal = jax.jit(time_stepping.terminal)


@jax.jit
def _greedy(
    march: March, value: Field, t: Number
) -> tuple[tuple[tuple[Field, ...], tuple[Field, ...]], jax.Array | bool, jax.Array]:
    """The players' actions at the time t, the nodes on the target, and those at which actions matter."""
    u, d = time_stepping.greedy(march, value, t)
    obstacles = march.obstacles_at(t)
    return (u, d), obstacles.ended, obstacles.acting(value)


@jax.jit
def _gap_at(task: March, value: Field, t: Number) -> tuple[Scalar, Scalar]:
    """The largest min max − max min of the H that steps solve, and how much the actions matter.

    No gap where the players drive components of their own, and where each is upwinded by itself.
    """
    # then H is a sum of what each player does, and min max is max min node by node
    if players_of(task.on).decoupled:
        return jnp.zeros(()), jnp.ones(())
    hamiltonian = discrete.around(task.on.at(t), value)
    return isaacs_gap(hamiltonian, ~task.obstacles_at(t).fixed)


def _isaacs_gap(task: March, front: Front, code: Status) -> float | None:
    """The gap at the last time of a march, with a warning where it is large; None without a game, and after a cut."""
    if not task.problem.is_game or code in CUT:
        return None
    gap, matter = (float(number) for number in _gap_at(task, front.value, front.t))
    warn_of_gap(gap, matter, task.problem.isaacs)
    return gap


class Slices:
    """The values and actions at the kept times, filled from the last to the first: NumPy arrays, allocated once."""

    def __init__(self, task: March, kept: np.ndarray):
        problem, shape, dtype = task.problem, task.grid.shape, np.dtype(task.horizon.dtype)
        sizes = [
            admissible.dim if admissible is not None else 0 for admissible in (problem.controls, problem.disturbances)
        ]
        self.times = np.array(kept)
        self.value = np.empty((len(kept), *shape), dtype)
        self.policy, self.disturbance = (np.empty((len(kept), *shape, size), dtype) for size in sizes)
        self.cut, self.ends = (np.zeros((len(kept), len(shape), 2), int) for _ in range(2))
        self.first = len(kept)  # of the filled ones; it counts down, as the march goes backward in time

    def keep(self, task: March, value: Field, t: Number, *, feedback: bool = True) -> None:
        """Fill the next slice; the policy is NaN on the target, and everywhere without ``feedback``."""
        # one program for all kept times: the time is an argument
        answer = jax.device_get(_greedy(task, value, t)) if feedback else None
        self.first -= 1
        self.times[self.first] = float(t)
        self.value[self.first] = value
        if answer is None:
            self.policy[self.first] = self.disturbance[self.first] = np.nan
            return
        (u, d), ended, acting = answer
        found = edges.cut(task.problem, task.grid, self.value[self.first], list(u), list(d), acting, t)
        self.cut[self.first], self.ends[self.first] = found
        for array, action in ((self.policy, u), (self.disturbance, d)):
            for j, entry in enumerate(action):
                array[self.first, ..., j] = np.where(ended, np.nan, entry)  # the run is over there: no action


def drive(task: March, kept: np.ndarray, start: Nodes | None, clock: Clock) -> tuple[Slices, Front, Status]:
    """The slices at the kept times, the last front and its status; ends at a code, at the time limit, or at Ctrl-C."""
    dtype, slices, chunk = np.dtype(task.horizon.dtype), Slices(task, kept), 1
    start = None if start is None else jnp.asarray(start, dtype)
    front = time_stepping.begin(task, _terminal(task.on.at(task.horizon), start))
    code = Status.RUNNING if bool(jnp.all(jnp.isfinite(front.value))) else Status.NONFINITE
    with ticker(clock.progress, float(task.horizon), "march") as show:
        try:
            code = _stop_status(clock, code)
            if code is Status.RUNNING:
                clock.phase = "compiling the steps"
                # no steps: it compiles, so that the first chunk is timed without that
                jax.block_until_ready(_run(task, front, jnp.asarray(0, dtype), 0))
            for t in kept[::-1]:
                until = jnp.asarray(t, dtype)
                while code is Status.RUNNING and float(front.t) > float(until):
                    code = _stop_status(clock, code)
                    if code is Status.RUNNING:
                        clock.phase = f"step {int(front.steps)}"
                        front, code, chunk = _chunk(task, front, until, chunk, clock)
                        show(float(task.horizon) - float(front.t), int(front.steps))
                # at the last kept time nothing is missing any more, and a time limit that passes now takes nothing away
                code = _stop_status(clock, code, arrived=t == kept[0])
                if code is not Status.RUNNING:
                    break
                slices.keep(task, front.value, front.t)
        except KeyboardInterrupt:  # the second one, or by a handler of the user's own
            clock.interrupted, code = True, Status.INTERRUPTED
        except Exception as error:
            if slices.first > 0:
                # without a feedback: its program calls the function that raised once more
                slices.keep(task, front.value, front.t, feedback=False)
            error.solution = assemble(task, task.grid, slices, front, Status.INTERRUPTED)  # type: ignore[attr-defined]
            raise
    # after a cut nothing is compiled, and the feedback has its program only if a slice was kept before
    if code is not Status.RUNNING and slices.first > 0 and bool(jnp.all(jnp.isfinite(front.value))):
        slices.keep(task, front.value, front.t, feedback=code not in CUT or slices.first < len(kept))  # how far it came
    return slices, front, Status.CONVERGED if code is Status.RUNNING else code


def _stop_status(clock: Clock, code: Status, *, arrived: bool = False) -> Status:
    """The code of a front, or the status by which the clock stops it; one that has arrived is only interrupted."""
    cut = clock.over()
    # how it ended comes before the clock: a march that blew up did so, however late it is
    if code is not Status.RUNNING or cut is None or (arrived and cut is Status.TIME_LIMIT):
        return code
    return cut


def _chunk(task: March, front: Front, until: Scalar, chunk: int, clock: Clock) -> tuple[Front, Status, int]:
    """The front after one chunk of steps, its status, and the steps of the next chunk.

    A chunk that ends in numbers that are not finite is taken back to the last step before.
    """
    began = time.perf_counter()
    after = jax.block_until_ready(_run(task, front, until, chunk))
    took, done = time.perf_counter() - began, int(after.steps) - int(front.steps)
    clock.stepping += took
    code = Status(int(after.code))
    if code is Status.NONFINITE:
        after = _run(task, front, until, done - 1)  # the steps are the same ones, so that it ends just before the last
    # a chunk of a step or two is timed badly, hence not more than eight times as many steps
    chunk = int(np.clip(done * CHUNK_SECONDS / max(took, 1e-4), 1, 8 * chunk))
    return after, code, chunk


def assemble(task: March, grid: Grid, slices: Slices, front: Front, code: Status) -> Solution:
    """The solution of a march on the user's ``grid``: its slices, and how it went."""
    problem = task.problem
    kept = slice(slices.first, None)
    if len(slices.cut[kept]):
        # at the earliest time, where an end that is cut off has worked its way furthest into the box
        warn_of_cuts(slices.cut[kept][0], slices.ends[kept][0], grid)
    return Solution(
        grid,
        slices.value[kept],
        slices.policy[kept],
        slices.disturbance[kept] if problem.is_game else None,
        code=int(code),
        steps=int(front.steps),
        isaacs_gap=_isaacs_gap(task, front, code),
        times=slices.times[kept],
        cut=slices.cut[kept],
        discrete=isinstance(problem.controls, Finite),
        discrete_disturbance=isinstance(problem.disturbances, Finite),
        message=_message(task, front, code),
        stats={
            "method": task.method.described(),
            "scheme": repr(task.on.scheme),
            "device": str(jax.devices()[0].device_kind),
            "dtype": str(slices.value.dtype),
            "certificate": CERTIFICATE,
            "versions": {"jax": jax.__version__, "numpy": np.__version__},
        },
    )


def _message(task: March, front: Front, code: Status) -> str:
    """The sentence that says how far a march came, and what to do about it."""
    t, horizon = float(front.t), float(task.horizon)
    if code is Status.CONVERGED:
        return f"Marched from t = {horizon:g} to t = {t:g}."
    what = ADVICE.get(code, code.message)
    # a march stalls for one of three reasons, and what to do differs: noise without a chain, rates without a bound,
    # or a policy iteration that did not end, as ADVICE has it
    if code is Status.STALLED and int(front.seen.lacking) >= 0:
        what = _noise_message(task, front)
    elif code is Status.STALLED and task.method.limited:
        what = f"No step is short enough for rates up to {float(front.seen.fastest):.3g}; use method=hjb.Implicit()."
    return f"The march stopped at t = {t:.6g} on its way from {horizon:g}. {what}"


def _noise_message(task: March, front: Front) -> str:
    """The message on noise that is correlated more than the spacings allow: where, when, and what would do."""
    grid, t = task.grid, front.seen.t
    index = tuple(int(i) for i in np.unravel_index(int(front.seen.lacking), grid.shape))
    players, *_ = jax.device_get(_greedy(task, front.value, t))
    x, (u, d) = grid.state(index), (np.array([entry[index] for entry in action]) for action in players)
    sigma = np.asarray(task.problem.diffusion(x, u, d, float(t)), dtype=float)
    played = [f"{letter} = {action.tolist()}" for letter, action in zip("ud", (u, d), strict=True) if action.size]
    return (
        "noise: correlated noise that the chain cannot represent with non-negative probabilities at "
        f"t = {float(t):.6g}, node {index}, x = {np.asarray(x).tolist()}{''.join(', ' + each for each in played)}.\n"
        + correlated_noise.advice(sigma @ sigma.T, grid, everywhere=False)
    )
