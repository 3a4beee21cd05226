"""The way of a solve on the host: coarser grids, vanishing discounts, rest nodes that one had better leave.

And from the monotone answer to the second-order one, and from that to the one on the next coarser grid, which tells the
error of the grid.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import cut_cells
from hjbjax.discretisation.discretisation import Scheme
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.evaluation import Krylov
from hjbjax.iteration.fixed_point import State, Task
from hjbjax.iteration.methods import Method, PolicyIteration
from hjbjax.markov_chain import resting
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import altered, known
from hjbjax.problem.types import Mask, Nodes
from hjbjax.solution import grid_error, nested_grids
from hjbjax.solution.clock import Clock, Stopped
from hjbjax.solution.status import Status
from hjbjax.solvers.setup import Assumptions, assumptions_of, forced_only, linear_solve, prepared
from hjbjax.solvers.stationary_run import iterate

VANISHING = (2.0, 0.2, 0.02)  # discounts on the way to none, over one by the time that crossing the box takes
FURTHER = ((2e-3, 2e-4), (2e-5, 2e-6), (2e-7, 2e-8))  # where parts of the box are that much slower than the fastest
AHEAD = 2.0  # of the time that a crossing takes, a step in time of a scheme of high order is one half
FAILED = (Status.STALLED, Status.DIVERGED, Status.NONFINITE)
# the last of the answers is a guess, and need not be exact
WARM_STEPS = 60  # improvements for each of them
LITTLE = 0.1  # of the range of V: by so much the second order may change it without being questioned
TOO_FEW = f"not estimated: it takes at least {2 * nested_grids.FEWEST_TELLING - 1} intervals per axis"
LOSES = "not estimated: no coarser grid keeps the fixed and the unreachable nodes"
OVER = "not estimated: the limits of the solve were reached"
UNSETTLED = "not estimated: the solve on the coarser grid ended {}"


def start(
    task: Task, scheme: Scheme, method: Method, guess: Nodes | None, clock: Clock, *, asked_again: bool
) -> tuple[Nodes | None, list[tuple[int, ...]]]:
    """The guess for the finest grid: the user's, or the answer of the coarser grids, and the shapes of those.

    Where the clock says stop on the way, the answer so far on the finest grid; None if there is none.

    Args:
      task: that of the chain on the finest grid.
      scheme: of the answer that is wanted there.
      method: as chosen, maybe of nested grids.
      guess: the user's, or None.
      clock: the limits.
      asked_again: whether the next coarser grid will tell the error of the grid: its program is compiled in any case.
    """
    # a tube without discount has many fixed points: from its constraint the iteration comes to the one that is sought
    if guess is not None or (task.constrained and not np.asarray(task.problem.discount) > 0):
        return guess, []
    value: Nodes | None = None
    # with noise, or without a certificate, the schemes have programs of their own
    asked_again &= scheme.monotone or staged(task, scheme) is not task
    coarser = levels(task, method, clock, asked_again=asked_again)
    if coarser:
        coarser[-1] = staged(coarser[-1], scheme)  # the one that is asked again
    grids = [*(level.grid for level in coarser), task.grid]
    for level, finer in zip(coarser, grids[1:], strict=True):
        state, _, _ = iterate(level, warm(level, value, clock), clock)
        if clock.over() is not None:
            return nested_grids.prolong(_finite(level, state), level.grid, task.grid), []
        value = nested_grids.prolong(_finite(level, state), level.grid, finer)
    return value, [grid.shape for grid in grids[:-1]]


def _finite(task: Task, state: State) -> np.ndarray:
    """The value, at lost nodes the largest of the others: what is far above all of them would spoil its neighbours."""
    value, counted = np.asarray(state.value), np.asarray(task.counted)
    return np.where(counted, value, np.max(value[counted])) if task.has_lost else value


def staged(task: Task, scheme: Scheme) -> Task:
    """The task of the chain, in the program of a scheme of high order where that can be: without noise, certified."""
    fits = task.problem.noise is None and min(task.grid.shape) >= scheme.points
    certified = task.certificate in (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE)
    if scheme.monotone or not (fits and certified):
        return task
    return _at_order(dataclasses.replace(task, on=dataclasses.replace(task.on, scheme=scheme)), first=True)


def _at_order(task: Task, *, first: bool) -> Task:
    """The task of a scheme of high order, or that of its chain in the same program, which differ in numbers alone."""
    return dataclasses.replace(sharpened(task, first=first), first_order=np.asarray(first))


def sharpened(task: Task, *, first: bool = False) -> Task:
    """The task with what the iteration of slopes of high order needs, and its chain does not (``first``).

    Without a discount these slopes have false solutions. The artificial diffusion of upwinding, with which rest nodes
    are reached, is gone. Where the slopes overshoot, a policy goes round a rest node and pays nothing, or less: V + c
    with c < 0 then solves the equation at all nodes but the rest node and its neighbours. The floor holds V up: it is
    zero where costs are not negative, and V is small next to a rest node. Corrections overshoot as well, since the
    error of one is carried along a whole path. Each is an implicit step in time of length 1/κ instead, half of what a
    crossing takes. With noise the error is not carried far, and whole corrections take fewer steps.
    """
    obstacles, shift = task.obstacles, None
    if task.floor is not None:
        floor = jnp.finfo(task.tol.dtype).min / 8 if first else task.floor
        obstacles = dataclasses.replace(obstacles, lower=jnp.asarray(floor, task.tol.dtype))
    if task.crossing is not None and task.problem.noise is None and not task.problem.is_game:
        shift = jnp.asarray(0 if first else AHEAD / task.crossing, task.tol.dtype)
    return dataclasses.replace(task, obstacles=obstacles, shift=shift)


def levels(task: Task, method: Method, clock: Clock, *, asked_again: bool) -> list[Task]:
    """The tasks on coarser grids, coarsest first, down to the nodes that the method names.

    ``asked_again``: the next coarser grid in any case, if it can tell the error of the grid.
    """
    found: list[Task] = []
    smaller = (_telling(task) if asked_again else None) or below(task.grid, method)
    while smaller is not None and clock.over() is None:
        clock.phase = f"the preparation of {' x '.join(map(str, smaller.shape))} nodes"
        level = on_coarser(task, smaller)
        if level is None:
            break
        found.insert(0, level)
        smaller = below(smaller, method)
    return found


def below(grid: Grid, method: Method) -> Grid | None:
    """The next coarser grid, if it has as many nodes as the method wants of the coarsest."""
    smaller = nested_grids.coarser(grid)
    return None if smaller is None or method.coarsest is None or smaller.size < method.coarsest else smaller


def warm(task: Task, guess: Nodes | None, clock: Clock) -> Nodes:
    """The guess; without one zero, or without discount a start that leads to the right one of many fixed points.

    A stopping cost or a running maximum is itself the start: ψ lies above all fixed points and g below. Otherwise
    the answers for a discount that vanishes lead the way: from below an undiscounted problem is full of policies
    that stay where they are at a cost; those of a small discount move to the target.
    """
    if guess is not None:
        return guess
    value = task.start() if task.constrained else jnp.asarray(np.zeros(task.grid.shape, task.tol.dtype))
    return _vanishing(task, value, VANISHING, clock) if needs_a_way(task) else value


def needs_a_way(task: Task) -> bool:
    """True if the iteration from zero may be caught by policies that stay where they are, at a cost."""
    return task.certificate is Certificate.MULTIPLICATIVE and not task.constrained


def _vanishing(task: Task, value: Nodes, discounts: tuple[float, ...], clock: Clock) -> Nodes:
    """The last of the answers for some discounts, over one by the time of a crossing, one after the other."""
    for discount in discounts:
        value = iterate(under(task, discount), value, clock, most=WARM_STEPS)[0].value
    return value


def under(task: Task, discount: float) -> Task:
    """The task under a discount, over one by the time of a crossing."""
    # the number alone: structure and certificate stay, and the program of the solve itself serves on the way
    return task.asking(altered(task.problem, discount=np.asarray(discount / known(task.crossing), task.tol.dtype)))


class Settled(NamedTuple):
    """A task at the end of its iteration, as it came to be on the way: its last state, its status, its residuals."""

    task: Task
    assumptions: Assumptions
    reached: Mask | None
    state: State
    code: Status
    residuals: np.ndarray
    origin: "Settled | None" = None  # the monotone answer from which one of second order started
    note: str = ""  # what else there is to say


def may_go_on(task: Task, assumptions: Assumptions, state: State, code: Status) -> bool:
    """True if a run that ended so may have to go on: rest nodes to be left, a game or a way that failed."""
    if code is Status.CONVERGED:
        return assumptions.may_rest and float(np.min(np.asarray(state.value), initial=0)) < 0
    return code in FAILED and (task.problem.is_game or needs_a_way(task))


def settle(task: Task, assumptions: Assumptions, reached: Mask | None, guess: Nodes | None, clock: Clock) -> Settled:
    """The end of a solve with rest nodes held; those that it had better leave are released, and it goes on.

    Held, their value is an upper bound of the one sought, from which the iteration only descends: a released node that
    was too low would stay so, since resting costs nothing. A game that does not converge is asked from where its target
    can be forced at all, and solved there. Sweeps that come to a halt, as they do where the drift goes round and round
    under a small discount, give way to a linear solve.
    """
    value = warm(task, guess, clock)
    state, code, residuals = iterate(task, value, clock)
    if needs_a_way(task):
        for discounts in FURTHER:  # a policy that stays where it is and pays, since the way takes too long for these
            if code not in FAILED:
                break
            value = _vanishing(task, value, discounts, clock)
            state, code, residuals = iterate(task, value, clock)
    evaluation = task.method.evaluation
    # a sweep follows the drift from the target on; on a circle there is no first node, and under a discount β Δt ≪ 1 it
    # takes some 1/(β Δt) rounds
    if code is Status.STALLED and evaluation is not None and evaluation.rough:
        solver = linear_solve(task.grid) if task.on.mesh is None else Krylov()
        task = dataclasses.replace(task, method=PolicyIteration(solver))
        state, code, residuals = iterate(task, state.value, clock)
    if code in FAILED:
        try:
            fewer, forced = forced_only(task, clock)
        except Stopped as stop:
            return Settled(task, assumptions, reached, state, stop.status, residuals)
        # where the disturbance can keep the state from the target V is infinite, and the iteration climbs without end
        if forced is not None and not forced.all():
            task, reached = fewer, forced
            # anew, since the value so far is that of the climb
            state, code, residuals = iterate(task, warm(task, None, clock), clock)
    while code is Status.CONVERGED and may_go_on(task, assumptions, state, code):
        pays = _leaving_pays(task, state.value)
        if not np.any(np.asarray(pays)):
            break
        # the bound by the least running cost wants it positive wherever V is not held, and at rest it is zero
        assumptions = dataclasses.replace(assumptions, certificate=Certificate.NONE)
        task = dataclasses.replace(
            task, obstacles=resting.release(task.obstacles, pays), certificate=Certificate.NONE, least_cost=None
        )
        state, code, more = iterate(task, state.value, clock)
        residuals = np.concatenate([residuals, more])
    return Settled(task, assumptions, reached, state, code, residuals)


def raised(task: Task, assumptions: Assumptions, scheme: Scheme) -> tuple[Task, Assumptions]:
    """The task and the assumptions of a scheme of high order behind a monotone one, whose certificates it has not."""
    # the matrix stays that of the chain, the residual is of the better slopes: defect correction
    on = dataclasses.replace(task.on, scheme=scheme)
    task = dataclasses.replace(task, certificate=Certificate.RESIDUAL, on=on, first_order=None)
    return sharpened(task), dataclasses.replace(assumptions, certificate=Certificate.RESIDUAL)


def running(settled: Settled) -> Task:
    """The task of an answer of high order as its program has it: that of the monotone answer, where both share one."""
    if settled.origin is None or settled.origin.task.first_order is None:
        return settled.task
    return _at_order(settled.origin.task, first=False)


def second_order(settled: Settled, scheme: Scheme, clock: Clock) -> Settled:
    """The answer by a scheme of high order, from the monotone one.

    The monotone answer stays beside it; where it was stopped before its first look that stands, with the reason.
    """
    over = clock.over()
    if over is not None:
        return settled._replace(code=over)
    task, assumptions = raised(settled.task, settled.assumptions, scheme)
    sharp = settled._replace(task=task, assumptions=assumptions, origin=settled)
    state, ended, residuals = iterate(running(sharp), settled.state.value, clock)
    if int(state.step) < 0:
        return settled._replace(code=ended)
    return sharp._replace(state=state, code=ended, residuals=residuals)


def better_of(settled: Settled, sharp: Settled, clock: Clock, *, sharpen: bool) -> Settled:
    """The second-order answer, or the monotone one with a note, where the caller left the choice (``sharpen``).

    The monotone answer stands where the second-order iteration did not converge, or moved V further than the error of
    the grid explains.
    """
    if not sharpen:
        return sharp
    if sharp.code is not Status.CONVERGED:
        # what was cut by hand has not come to its end; a time limit leaves the monotone answer whole
        code = sharp.code if sharp.code is Status.INTERRUPTED else settled.code
        note = f"It is of first order: the second-order iteration ended {sharp.code.name}."
        return settled._replace(code=code, note=note)
    contradiction = _contradiction(settled, sharp, clock)
    return sharp if contradiction is None else settled._replace(note=contradiction)


def _contradiction(settled: Settled, sharp: Settled, clock: Clock) -> str | None:
    """The note on a second-order answer that contradicts the certified monotone one; None if it does not.

    The error of the monotone answer is its change from the next coarser grid over 2^q − 1, with the least order q = ½.
    Nothing is computed where the second order changed little.
    """
    before, after = _finite(settled.task, settled.state), _finite(sharp.task, sharp.state)
    moved = float(np.max(nested_grids.apart(before, after)))
    if moved <= LITTLE * float(np.ptp(before)):
        return None
    found = coarser_answer(settled, clock)
    if found.grid is None or found.value is None:
        return None
    coarse, value = found.grid, found.value
    change = nested_grids.apart(nested_grids.restrict(before, settled.task.grid, coarse), value)
    explained = float(np.max(change)) / (nested_grids.ratio_of(settled.task.grid, coarse) ** grid_error.LEAST - 1)
    if moved <= explained + float(settled.task.tol):
        return None
    return (
        f"It is of first order: the second-order answer differs from this certified one by up to {moved:.3g}, of which "
        f"the grid explains {explained:.3g}."
    )


def plainly(settled: Settled) -> Settled:
    """An answer of the chain, told as such, whatever program it comes from."""
    task = settled.task
    return settled if task.first_order is None else settled._replace(task=task.of_chain)


class CoarserAnswer(NamedTuple):
    """The answer on the coarser grid that tells the error of the finer one, or the reason that there is none."""

    grid: Grid | None
    value: np.ndarray | None = None
    reason: str = ""


def coarser_answer(settled: Settled, clock: Clock) -> CoarserAnswer:
    """The answer on the next coarser grid, by the scheme of ``settled`` and from its value."""
    task, fine = running(settled), settled.task.grid
    coarse = _telling(task)
    if coarse is None:
        few = nested_grids.telling(fine, np.zeros(fine.shape, bool)) is None
        return CoarserAnswer(None, reason=TOO_FEW if few else LOSES)
    if clock.over() is not None:
        return CoarserAnswer(None, reason=OVER)
    if (level := on_coarser(task, coarse)) is None:
        return CoarserAnswer(None, reason=LOSES)
    value = _finite(task, settled.state)  # infinite values are imposed again by the unreachable nodes
    state, code, _ = iterate(level, nested_grids.restrict(value, fine, coarse).astype(value.dtype), clock)
    if code is not Status.CONVERGED:
        return CoarserAnswer(None, reason=UNSETTLED.format(code.name))
    return CoarserAnswer(coarse, np.where(np.asarray(level.counted), np.asarray(state.value), np.inf))


def _telling(task: Task) -> Grid | None:
    """The coarser grid that tells the error of the grid of a task; None where there is none."""
    # which nodes cannot reach the target is known of nodes of the finer grid only
    fixed = np.broadcast_to(np.asarray(task.obstacles.fixed), task.grid.shape)
    return nested_grids.telling(task.grid, fixed, nested=task.has_lost)


def on_coarser(task: Task, coarse: Grid) -> Task | None:
    """The task on a coarser grid; None where that is another question."""
    fine = task.grid
    strides = [divmod(fine.intervals(axis), coarse.intervals(axis)) for axis in range(fine.ndim)]
    # the rate of the fastest action is not that of the coarser grid
    if task.outflow is None and not any(rest for _, rest in strides):
        # what is known of the nodes is known of every second one
        every = tuple(slice(None, None, stride) for stride, _ in strides)
        # without those of the problem and the grid, which may have the shape of the nodes by chance
        bare: Any = dataclasses.replace(task, on=None)  # type: ignore[arg-type]
        known = jax.tree.map(lambda leaf: np.asarray(leaf)[every] if np.shape(leaf) == fine.shape else leaf, bare)
        on = task.on.on_grid(coarse)
        made = dataclasses.replace(known, on=_kept(on) if cut_cells.keeps(on) else on)
    elif task.has_lost:  # which nodes cannot reach the target is not known of other ones
        return None
    else:
        level = task.on.chain.on_grid(coarse)
        made = prepared(level, method=task.method, tol=task.tol, assumptions=assumptions_of(level))
        on = dataclasses.replace(task.on.on_grid(coarse), cut=made.on.cut)
        made = dataclasses.replace(made, on=on, certificate=task.certificate)
        if task.first_order is not None:
            made = _at_order(made, first=bool(np.asarray(task.first_order)))
        elif not task.scheme.monotone:
            made = sharpened(made)
    held, kept = (bool(np.any(np.asarray(each.obstacles.fixed))) for each in (task, made))
    return None if held and not kept else made


_kept = jax.jit(cut_cells.kept)


@jax.jit
def _leaving_pays(task: Task, value: jax.Array) -> jax.Array:
    """The held rest nodes that it pays to leave, bool (*grid)."""
    return resting.leaving_pays(task.on.chain, task.obstacles, task.counted, value)
