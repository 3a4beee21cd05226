"""The way of a solve on the host: coarser grids, vanishing discounts, rest nodes that one had better leave."""

import dataclasses
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.finiteness import resting
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.iteration.methods import Method, PolicyIteration
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import altered
from hjbjax.problem.types import Mask, Nodes
from hjbjax.solution import transfer
from hjbjax.solution.clock import Clock, Stopped
from hjbjax.solution.status import Status
from hjbjax.solvers.host_loop import drive
from hjbjax.solvers.setup import Assumptions, assumptions_of, forced_only, held_jit, linear_solve, prepare_jit

VANISHING = (2.0, 0.2, 0.02)  # discounts on the way to none, over one by the time that crossing the box takes
FURTHER = ((2e-3, 2e-4), (2e-5, 2e-6), (2e-7, 2e-8))  # where parts of the box are that much slower than the fastest
FAILED = (Status.STALLED, Status.DIVERGED, Status.NONFINITE)
# the last of the answers is a guess, and need not be exact
WARM_STEPS = 60  # improvements for each of them


def start(
    on: Discretisation, method: Method, tol: float, guess: Nodes | None, clock: Clock
) -> tuple[Nodes | None, list[tuple[int, ...]]]:
    """The guess for the finest grid: the user's, or the answer of the coarser grids, and the shapes of those.

    Where the clock says stop on the way, the answer so far on the finest grid, interpolated by NumPy, which compiles
    nothing; None if there is none.
    """
    if guess is not None or method.coarsest is None:
        return guess, []
    grids = levels(on, method, clock)
    value: Nodes | None = None
    if clock.over() is not None:
        return None, []
    for coarse, fine in itertools.pairwise(grids):
        clock.phase = f"the preparation of {' x '.join(map(str, coarse.shape))} nodes"
        level = on.on_grid(coarse)
        # without the checks of the host: a coarser grid gives a guess, and is no reason to refuse or to warn
        task = prepare_jit(level, method=method.inner, tol=tol, assumptions=assumptions_of(level))
        state, _, _ = drive(task, warm(task, value, clock), clock)
        if clock.over() is not None:
            return transfer.prolong(np.asarray(state.value), coarse, on.grid), []
        value = transfer.prolong(state.value, coarse, fine)
    return value, [coarse.shape for coarse in grids[:-1]]


def levels(on: Discretisation, method: Method, clock: Clock) -> list[Grid]:
    """The grids of a nested solve, coarsest first; a coarser grid that loses the target or rest point is left out."""
    assert method.coarsest is not None
    grids, assumptions = [on.grid], assumptions_of(on)
    needs_held = on.problem.target is not None or assumptions.may_rest
    while (smaller := transfer.coarser(grids[0])) is not None and smaller.size >= method.coarsest:
        if clock.over() is not None:
            break
        clock.phase = f"the choice of coarser grids, {' x '.join(map(str, smaller.shape))} nodes"
        # without a held node an undiscounted problem has no finite value to start from
        if needs_held and not held_jit(on.on_grid(smaller), assumptions=assumptions).any():
            break
        grids.insert(0, smaller)
    return grids


def warm(task: Task, guess: Nodes | None, clock: Clock) -> Nodes:
    """The guess; without one zero, or without discount a start that leads to the right one of many fixed points.

    A stopping cost or a running maximum is itself the start: ψ lies above all fixed points and g below. Otherwise
    the answers for a discount that vanishes lead the way: from below an undiscounted problem is full of policies
    that stay where they are at a cost; those of a small discount move to the target.
    """
    if guess is not None:
        return guess
    value = task.start() if task.constrained else jnp.asarray(np.zeros(task.grid.shape, task.tol.dtype))
    return _vanishing(task, value, VANISHING, clock) if _needs_a_way(task) else value


def _needs_a_way(task: Task) -> bool:
    """True if the iteration from zero may be caught by policies that stay where they are, at a cost."""
    return task.certificate is Certificate.MULTIPLICATIVE and not task.constrained


def _vanishing(task: Task, value: Nodes, discounts: tuple[float, ...], clock: Clock) -> Nodes:
    """The last of the answers for some discounts, over one by the time of a crossing, one after the other."""
    for discount in discounts:
        # the number alone: structure and certificate stay, and the program of the solve itself serves on the way
        problem = altered(task.problem, discount=jnp.asarray(discount / task.crossing, task.tol.dtype))
        value = drive(task.asking(problem), value, clock, most=WARM_STEPS)[0].value
    return value


class Settled(NamedTuple):
    """A task at the end of its iteration, as it came to be on the way: its last state, its status, its residuals."""

    task: Task
    assumptions: Assumptions
    reached: Mask | None
    state: State
    code: Status
    residuals: np.ndarray


def may_go_on(task: Task, assumptions: Assumptions, state: State, code: Status) -> bool:
    """True if a run that ended so may have to go on: rest nodes to be left, a game or a way that failed."""
    if code is Status.CONVERGED:
        return assumptions.may_rest and float(np.min(np.asarray(state.value), initial=0)) < 0
    return code in FAILED and (task.problem.is_game or _needs_a_way(task))


def settle(task: Task, assumptions: Assumptions, reached: Mask | None, guess: Nodes | None, clock: Clock) -> Settled:
    """The end of a solve with rest nodes held; those that it had better leave are released, and it goes on.

    Held, their value is an upper bound of the one sought, from which the iteration only descends: a released node that
    was too low would stay so, since resting costs nothing. A game that does not converge is asked from where its target
    can be forced at all, and solved there. Sweeps that come to a halt, as they do where the drift goes round and round
    under a small discount, give way to a linear solve.
    """
    value = warm(task, guess, clock)
    state, code, residuals = drive(task, value, clock)
    if _needs_a_way(task):
        for discounts in FURTHER:  # a policy that stays where it is and pays, since the way takes too long for these
            if code not in FAILED:
                break
            value = _vanishing(task, value, discounts, clock)
            state, code, residuals = drive(task, value, clock)
    evaluation = task.method.evaluation
    # a sweep follows the drift from the target on; on a circle there is no first node, and under a discount β Δt ≪ 1 it
    # takes some 1/(β Δt) rounds
    if code is Status.STALLED and evaluation is not None and evaluation.rough:
        task = dataclasses.replace(task, method=PolicyIteration(linear_solve(task.grid)))
        state, code, residuals = drive(task, state.value, clock)
    if code in FAILED:
        try:
            fewer, forced = forced_only(task, clock)
        except Stopped as stop:
            return Settled(task, assumptions, reached, state, stop.status, residuals)
        # where the disturbance can keep the state from the target V is infinite, and the iteration climbs without end
        if forced is not None and not forced.all():
            task, reached = fewer, forced
            # anew, since the value so far is that of the climb
            state, code, residuals = drive(task, warm(task, None, clock), clock)
    while code is Status.CONVERGED and may_go_on(task, assumptions, state, code):
        pays = _leaving_pays(task, state.value)
        if not np.any(np.asarray(pays)):
            break
        # the bound by the least running cost wants it positive wherever V is not held, and at rest it is zero
        assumptions = dataclasses.replace(assumptions, certificate=Certificate.NONE)
        task = dataclasses.replace(
            task, obstacles=resting.release(task.obstacles, pays), certificate=Certificate.NONE, least_cost=None
        )
        state, code, more = drive(task, state.value, clock)
        residuals = np.concatenate([residuals, more])
    return Settled(task, assumptions, reached, state, code, residuals)


@jax.jit
def _leaving_pays(task: Task, value: jax.Array) -> jax.Array:
    """The held rest nodes that it pays to leave, bool (*grid)."""
    return resting.leaving_pays(task.on.chain, task.obstacles, task.counted, value)
