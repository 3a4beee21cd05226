"""A march in chunks of steps from one kept time to the next, and its solution."""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import correlated_noise, edges
from hjbjax.hamiltonian import discrete
from hjbjax.iteration import time_stepping
from hjbjax.iteration.time_stepping import Front, March
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import altered
from hjbjax.problem.types import Field, Nodes, Number, Scalar
from hjbjax.solution.checkpoints import check_alike
from hjbjax.solution.clock import CUT, Clock
from hjbjax.solution.solution import Solution, attach_solution, question
from hjbjax.solution.status import Status
from hjbjax.solvers import host_loop
from hjbjax.solvers.contact import contact, contact_axes
from hjbjax.solvers.host_loop import WideJit
from hjbjax.solvers.result import active_bounds, isaacs_gap, warn_of_gap
from hjbjax.well_posedness import node_checks

CERTIFICATE = "a march has no certificate; halve the spacings and the step to see its error"
ADVICE = {
    Status.DIVERGED: "The value blows up: the worst disturbance reached its bound inside the box. Use a wider box of "
    "disturbances to see how fast; if the bound is part of the problem, pass inner=0.",
    Status.NONFINITE: "NaN or infinity appeared in the next step, and the last finite value is kept; check drift "
    "and cost, or use a shorter step.",
    Status.TIME_LIMIT: "Reached time_limit; raise it, or continue from the value so far with start=.",
    Status.INTERRUPTED: "The march was interrupted and the value so far is kept; continue from it with start=.",
    Status.STALLED: "The policy iteration of an implicit step did not converge; use a shorter step.",
}


# the players' actions, the nodes on the target, the nodes at which actions matter, and the sets of ``contact``
Feedback: TypeAlias = tuple[
    tuple[tuple[Field, ...], tuple[Field, ...]], jax.Array | bool, jax.Array, dict[str, jax.Array]
]


# the front is not donated, because a chunk that ends in NaN is repeated from the front at its start
@WideJit
def _run(march: March, front: Front, until: Number, most: Number) -> Front:
    """``time_stepping.run`` on all devices, each with its own nodes."""

    def here(march: March, front: Front, until: Number, most: Number) -> Front:
        return time_stepping.run(march.on_part(layout), front, until, most)

    layout, front_over = march.division, _front_over_nodes(front)
    over = march.over_nodes(layout.entries), front_over, False, False
    return layout.mapped(here, over, front_over)(march, front, until, most)


@jax.jit
def _greedy(march: March, value: Field, t: Number) -> Feedback:
    """The actions at the time t, the target, the nodes at which actions matter, and the sets of ``contact``."""

    def here(march: March, value: Field, t: Number) -> Feedback:
        part = march.on_part(layout)
        obstacles = part.obstacles_at(t)
        touching = contact(part.problem, part.grid, obstacles, value)
        return time_stepping.greedy_actions(part, value, t), obstacles.ended, obstacles.acting(value), touching

    layout = march.division
    return layout.mapped(here, (march.over_nodes(layout.entries), True, False), True)(march, value, t)


@jax.jit
def _gap_at(task: March, value: Field, t: Number) -> tuple[Scalar, Scalar]:
    """The largest min max − max min of the Hamiltonian of the steps, and the influence of the actions.

    There is no gap if the players drive separate components, or if each is upwinded separately.
    """
    # then H is a sum over the players, and min max equals max min at every node
    if task.on.players.decoupled:
        return jnp.zeros(()), jnp.ones(())
    hamiltonian = discrete.around(task.on.at(t), value)
    return isaacs_gap(hamiltonian, ~task.obstacles_at(t).fixed)


def _isaacs_gap(task: March, front: Front, code: Status) -> float | None:
    """The largest gap over all steps, with a warning if it is large; None without a game, and after a cut."""
    if not task.problem.is_game or task.bare or code in CUT:
        return None
    gap, matter = (float(number) for number in front.gap)
    at_end, matter_there = (float(number) for number in _gap_at(task, front.value, front.t))
    if not at_end <= gap:
        gap, matter = at_end, matter_there
    warn_of_gap(gap, matter, task.problem.isaacs)
    return gap


def _front_over_nodes(front: Front) -> Front:
    """Mark the leaves of a front that have a value at every node."""
    return altered(jax.tree.map(lambda _: False, front), value=True)


class Slices:
    """The values and actions at the kept times, filled from the last to the first: NumPy arrays, allocated once."""

    def __init__(self, task: March, kept: np.ndarray):
        problem, shape, dtype = task.problem, task.grid.shape, np.dtype(task.horizon.dtype)
        players = (None, None) if task.bare else (problem.controls, problem.disturbances)
        sizes = [admissible.dim if admissible is not None else 0 for admissible in players]
        self.times = np.array(kept)
        self.value = np.empty((len(kept), *shape), dtype)
        self.policy, self.disturbance = (np.empty((len(kept), *shape, size), dtype) for size in sizes)
        self.cut, self.ends = (np.zeros((len(kept), len(shape), 2), int) for _ in range(2))
        sets = {} if task.bare else contact_axes(problem)
        self.touching: dict[str, Any] = {
            name: np.zeros((len(kept), *shape, *more), bool) for name, more in sets.items()
        }
        self.first = len(kept)  # index of the first filled slice; decreases, as the march goes backward in time

    def keep(self, task: March, value: Nodes, moment: float, answer: Any) -> None:
        """Fill the next slice; the policy is NaN on the target, and everywhere without an ``answer``."""
        t = np.asarray(moment, self.value.dtype)
        place = self.first - 1
        self.value[place] = value
        if answer is None:
            self.policy[place] = self.disturbance[place] = np.nan
        else:
            (u, d), ended, acting, touching = answer
            for name, mask in touching.items():
                self.touching[name][place] = mask
            found = edges.cut(task.problem, task.grid, self.value[place], (list(u), list(d)), acting, t)
            self.cut[place], self.ends[place] = found
            for array, action in ((self.policy, u), (self.disturbance, d)):
                for j, entry in enumerate(action):
                    array[place, ..., j] = np.where(ended, np.nan, entry)  # the run has ended there, without an action
        self.times[place] = moment
        self.first = place  # last, so that an interrupt does not leave a partly filled slice

    def _arrays(self) -> list[np.ndarray]:
        """All arrays, with the kept times as their leading axis."""
        own = [self.times, self.value, self.policy, self.disturbance, self.cut, self.ends]
        return own + list(self.touching.values())

    def saved(self) -> list[np.ndarray]:
        """The filled slices, and their number."""
        filled = slice(self.first, None)
        arrays = self._arrays()
        # copies: saved data must not change when the march continues
        return [np.array(len(self.times) - self.first), *(array[filled].copy() for array in arrays)]

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Restore saved slices.

        Raises:
          ValueError: the arrays do not match the number of slices they contain.
        """
        filled, *own = arrays
        check_alike([filled], [np.array(0)])
        if not 0 <= filled <= len(self.times):
            raise ValueError(f"it counts {filled} slices of {len(self.times)}")
        self.first = len(self.times) - int(filled)
        whole = self._arrays()
        check_alike(own, [array[self.first :] for array in whole])
        for array, entries in zip(whole, own, strict=True):
            array[self.first :] = entries

    def misses(self, t: float) -> bool:
        """True if the current time t of the march is not among the kept times."""
        return self.first > 0 and (self.first == len(self.times) or t < self.times[self.first])

    @property
    def length(self) -> float:
        """The time from the last filled slice to the next."""
        return float(self.times[self.first] - self.times[self.first - 1])


def drive_march(
    task: March, horizon: float, kept: np.ndarray, start: Nodes | None, clock: Clock
) -> tuple[Slices, Front, Status]:
    """The slices at the kept times, the last front and its status; ends at a code, the time limit, or Ctrl-C."""
    start = None if start is None else jnp.asarray(start, np.dtype(task.horizon.dtype))
    front, finite = _front_at_horizon(task, start, horizon - kept[-1])
    run = MarchRun(task, front, kept)
    del front  # free the value at the horizon, which is not needed after the first steps
    status = host_loop.drive(run, clock) if finite else Status.NONFINITE
    slices, front = run.slices, run.gathered()
    # after a cut nothing is compiled, and the program of the feedback exists only if a slice was kept before
    if status is not Status.CONVERGED and slices.misses(run.time) and bool(jnp.all(jnp.isfinite(front.value))):
        run.store(feedback=status not in CUT or slices.first < len(kept))  # the last time reached
    return slices, front, status


@jax.jit
def _front_at_horizon(task: March, start: Field | None, left: Number) -> tuple[Front, Scalar]:
    """The front at the horizon, and true if V is finite there."""
    value = time_stepping.terminal(task.on.at(task.horizon), start)
    return time_stepping.begin(task, value, left), jnp.all(jnp.isfinite(value))


class MarchRun:
    """A march from one kept time to the next: its front, and the slices kept so far."""

    limit, longest = np.inf, 10**9  # of steps: unlimited
    passing = False

    def __init__(self, task: March, front: Front, kept: np.ndarray):
        self.task, self.slices = task, Slices(task, kept)
        self.layout, self._over = task.division, _front_over_nodes(front)
        over = task.over_nodes(task.grid.shape), self._over
        self._divided, self.front = self.layout.spread((task, front), over)
        self.nodes, self.name = task.grid.size, f"{' x '.join(map(str, task.grid.shape))} nodes"
        form = "{desc}: {percentage:3.0f}% |{bar}| t {n:.3g} of {total:.3g}{postfix} [{elapsed}<{remaining}]"
        self.bar = {"desc": "march", "total": float(task.horizon), "bar_format": form}

    @property
    def steps(self) -> int:
        """The number of completed steps."""
        return int(self.front.steps)

    @property
    def time(self) -> float:
        """The current time of the march."""
        if self._is_kept:
            return float(self.slices.times[self.slices.first])
        left, rest = (float(number) for number in np.asarray(self.front.left))
        return float(self.slices.times[self.slices.first - 1]) + left + rest if self.slices.first else 0.0

    @property
    def until(self) -> Scalar:
        """The next kept time, in the dtype of the values."""
        return jnp.asarray(self.slices.times[self.slices.first - 1], np.dtype(self.task.horizon.dtype))

    def compile(self) -> None:
        """Call the program with zero steps."""
        jax.block_until_ready(_run(self._divided, self.front, jnp.zeros_like(self.until), 0))

    def first_chunk(self, clock: Clock) -> int:
        """One step, since none has been timed."""
        return 1

    def advance(self, count: int) -> Status:
        """Take at most ``count`` steps towards the next kept time.

        A chunk that ends in values that are not finite is undone back to the last finite step.
        """
        after = jax.block_until_ready(_run(self._divided, self.front, self.until, count))
        status = Status(int(after.code))
        if status is Status.NONFINITE:
            # the steps are identical, so the chunk ends just before the bad one
            after = _run(self._divided, self.front, self.until, int(after.steps) - self.steps - 1)
        self.front = after
        return status

    def between(self, status: Status, clock: Clock) -> Status:
        """Store the slices at the times that the front has reached; CONVERGED after the last of them."""
        slices = self.slices
        while status is Status.RUNNING and slices.first > 0 and float(np.asarray(self.front.left)[0]) <= 0:
            if not self._is_kept:
                cut = clock.over()
                # at the last kept time the march is complete, so a time limit that passes now is ignored
                if cut is not None and not (slices.first == 1 and cut is Status.TIME_LIMIT):
                    return cut
                self.store()
            if slices.first > 0:
                self.front = altered(self.front, left=self._clock(slices.length))
        return Status.CONVERGED if status is Status.RUNNING and slices.first == 0 else status

    @property
    def _is_kept(self) -> bool:
        """True if the front is at the last slice, because an interrupt came before its clock was reset."""
        times, first = self.slices.times, self.slices.first
        at_end = float(np.asarray(self.front.left)[0]) <= 0 and first < len(times)
        return at_end and self.slices.value.dtype.type(times[first]) == np.asarray(self.front.t)

    def _clock(self, left: float) -> Any:
        """The clock of a front at the beginning of an interval."""
        return self.layout.spread(jnp.asarray([left, 0], self.slices.value.dtype), False)

    def gathered(self) -> Front:
        """The front, with values at all nodes."""
        return self.layout.gathered(self.front, self._over)

    def store(self, *, feedback: bool = True) -> None:
        """Store the value at the front, and its feedback, as the next slice."""
        front, answer = self.gathered(), None
        if feedback and not self.task.bare:
            # one program for all kept times: the time is an argument
            answer = _greedy(self._divided, self.front.value, self.front.t)
            answer = jax.device_get(self.layout.gathered(answer, jax.tree.map(lambda _: True, answer)))
        self.slices.keep(self.task, front.value, self.time, answer)
        if self.task.checks_cut:
            self._keep_cut(self.front)

    def _keep_cut(self, front: Front) -> None:
        """Record the counts of cut-off drift since the previous kept time, if larger, and reset them."""
        place = self.slices.first
        np.maximum(self.slices.cut[place], np.asarray(front.cut), out=self.slices.cut[place])
        self.front = altered(self.front, cut=jnp.zeros_like(front.cut))

    def saved(self) -> list[Any]:
        """The stored slices, and the front."""
        return [*self.slices.saved(), *jax.tree.leaves(self.gathered())]

    def restore(self, arrays: list[np.ndarray]) -> None:
        """Continue from a saved front.

        Raises:
          ValueError: the arrays are not a front of this march and its slices.
        """
        count = len(self.slices.saved())
        check_alike(arrays[count:], jax.tree.leaves(self.gathered()))
        front = jax.tree.unflatten(jax.tree.structure(self.front), map(jnp.asarray, arrays[count:]))
        # with NaN in either the march would never end
        if not (0 <= front.t <= self.task.horizon and np.all(np.isfinite(front.left))):
            raise ValueError(
                f"its time is {front.t}, wanted one in [0, {self.task.horizon}], and {front.left} are left"
            )
        Status(int(front.code))
        self.slices.restore(arrays[:count])
        self.front = self.layout.spread(front, self._over)

    def show(self, bar: Any) -> None:
        """Advance the progress bar, which shows the problem's own time."""
        bar.update(float(self.task.horizon) - self.time - bar.n)
        bar.set_postfix_str(f"{self.steps} steps", refresh=False)

    def keep(self, error: Exception) -> None:
        """Attach the solution so far to an exception; data in other processes is inaccessible."""
        if not self.layout.is_local:
            return
        if self.slices.misses(self.time):
            # without a feedback, whose program would call the failed function again
            self.store(feedback=False)
        solution = assemble(self.task, self.task.grid, self.slices, self.gathered(), Status.INTERRUPTED)
        attach_solution(error, solution)


def assemble(task: March, grid: Grid, slices: Slices, front: Front, code: Status) -> Solution:
    """The solution of a march on the user's ``grid``, from its slices and its outcome."""
    problem = task.problem
    kept = slice(slices.first, None)
    return Solution(
        grid,
        slices.value[kept],
        None if task.bare else slices.policy[kept],
        slices.disturbance[kept] if problem.is_game and not task.bare else None,
        code=int(code),
        steps=int(front.steps),
        isaacs_gap=_isaacs_gap(task, front, code),
        times=slices.times[kept],
        cut=None if task.bare else slices.cut[kept],
        **{name: masks[kept] for name, masks in slices.touching.items()},
        **question(problem),
        message=_message(task, front, code),
        stats={
            "method": task.method.described(),
            "scheme": repr(task.on.scheme),
            "device": str(jax.devices()[0].device_kind),
            "dtype": str(slices.value.dtype),
            "certificate": CERTIFICATE,
            **active_bounds(
                task.on, None if task.bare else slices.policy[kept][0], f" at t = {slices.times[kept][0]:g}"
            ),
            "versions": {"jax": jax.__version__, "numpy": np.__version__},
        },
    )


def _message(task: March, front: Front, code: Status) -> str:
    """The message with the time that a march reached, and a remedy."""
    t, horizon = float(front.t), float(task.horizon)
    if code is Status.CONVERGED:
        return f"Marched from t = {horizon:g} to t = {t:g}."
    what = task.problem.labels.word(ADVICE.get(code, code.message))
    # a march stalls for one of three reasons with different remedies: noise without a chain, unbounded rates, or a
    # policy iteration that did not converge, which ADVICE covers
    if code is Status.STALLED and int(front.seen.lacking) >= 0:
        what = _noise_message(task, front)
    elif code is Status.STALLED and task.method.limited:
        what = f"No step is short enough for rates up to {float(front.seen.fastest):.3g}; use method=hjb.Implicit()."
    return f"The march stopped at t = {t:.6g} on its way from {horizon:g}. {what}"


def _noise_message(task: March, front: Front) -> str:
    """The message for noise that is correlated more than the spacings allow: place, time, and remedy."""
    grid, t = task.grid, front.seen.t
    index = tuple(int(i) for i in np.unravel_index(int(front.seen.lacking), grid.shape))
    players, *_ = jax.device_get(_greedy(task, front.value, t))
    x, (u, d) = grid.state(index), (np.array([entry[index] for entry in action]) for action in players)
    sigma = np.asarray(task.problem.diffusion(x, u, d, float(t)), dtype=float)
    played = [f"{letter} = {action.tolist()}" for letter, action in zip("ud", (u, d), strict=True) if action.size]
    return (
        "noise: correlated noise that the chain cannot represent with non-negative probabilities at "
        f"t = {float(t):.6g}, node {index}, x = {np.asarray(x).tolist()}{''.join(', ' + each for each in played)}.\n"
        + correlated_noise.advice(task.on.at(t), sigma @ sigma.T, node_checks.representatives(task.problem, u, d))
    )
