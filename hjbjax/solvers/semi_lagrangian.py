"""``solve`` by a scheme that follows paths: its checks, its task, its run in chunks of steps, its solution."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import edges
from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.paths import Paths, Plan
from hjbjax.discretisation.schemes import Upwind
from hjbjax.iteration import bellman, certificates
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.evaluation import Sweeps
from hjbjax.iteration.methods import Method
from hjbjax.iteration.progress import HISTORY
from hjbjax.problem.grid import Grid
from hjbjax.problem.labels import COST
from hjbjax.problem.problem import Problem, is_discounted
from hjbjax.problem.pytree import cast
from hjbjax.problem.sets import Finite
from hjbjax.problem.types import DType, Mask, Nodes
from hjbjax.semi_lagrangian import arc_iteration, arcs
from hjbjax.semi_lagrangian.arc_iteration import ArcState, ArcTask
from hjbjax.semi_lagrangian.arcs import Arcs
from hjbjax.semi_lagrangian.scheme import SemiLagrangian
from hjbjax.solution.clock import CUT, Clock, Stopped
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status
from hjbjax.solvers import host_loop, memory
from hjbjax.solvers.contact import contact
from hjbjax.solvers.host_loop import FIRST_NODES, WideJit
from hjbjax.solvers.result import solution_at_start, warn_of_cuts, within_reach
from hjbjax.solvers.setup import check_on_one_state, is_carried_past, warn_unreached
from hjbjax.solvers.stationary_run import StatesInChunks
from hjbjax.well_posedness import node_checks
from hjbjax.well_posedness.attainability import Reach

REPLACEMENT = SemiLagrangian()  # replaces the chain if this is carried past the target
REASON = (
    "It was solved by SemiLagrangian(): the Markov chain of Upwind() and Limited() spreads by about a cell per step "
    "and may be carried past the target, so its expected cost is not finite where the cost of the path is finite."
)
FAILED = (Status.STALLED, Status.DIVERGED, Status.NONFINITE)
WORDS = {
    Certificate.ADDITIVE: "from the discount, V + min r/(1 − e^{−βτ}) ≤ V_h ≤ V + max r/(1 − e^{−βτ})",
    Certificate.MULTIPLICATIVE: "from the running cost, V/(1 + η) ≤ V_h ≤ V/(1 − ρ)",
}


def relaxations(method: Method | None, n: int) -> int:
    """The number of times that a step follows the best arcs, in n dimensions.

    Raises:
      ValueError: the method uses the matrix of a chain, or coarser grids.
    """
    if method is None:
        return Sweeps().relaxations(n)
    if method.coarsest is None and method.relaxes:
        return 1
    # the number of relaxations in the sweeps of a chain
    evaluation = method.filled(Sweeps()).evaluation
    count = None if evaluation is None else evaluation.relaxations(n)
    if method.coarsest is None and count is not None:
        return count
    raise ValueError(
        f"solve: SemiLagrangian() follows arcs and does not have a matrix for {method!r}; use "
        "hjb.PolicyIteration(), PolicyIteration(Sweeps(...)) or ValueIteration(), on one grid"
    )


def arc_bytes(grid: Grid, plan: Plan, dtype: DType) -> int:
    """Bytes for the arcs and the arrays computed from them, from a count of arrays that live at the same time."""
    word = np.dtype(dtype).itemsize
    each = (3 + grid.ndim) * word + 4  # pay, keep, fractions, running cost, cell
    return (each * (plan.count + 2) + 12 * word) * grid.size


def solve_arcs_on_host(
    problem: Problem,
    grid: Grid,
    scheme: Scheme,
    paths: Paths,
    kind: np.dtype,
    *,
    method: Method | None,
    tol: float,
    guess: Nodes | None,
    max_memory: int | None,
    clock: Clock,
) -> Solution:
    """The solution by checks, arcs and steps, in this order, as far as the clock allows; may enable float64."""
    paths.check(problem, grid)
    times = relaxations(method, grid.ndim)
    on = Discretisation(problem, grid, Upwind(), kind)  # for checks that do not involve slopes
    start = None if guess is None else np.asarray(guess, kind)
    try:
        check_on_one_state(problem, grid, scheme)
        plan = paths.plan(problem, grid, kind)
        # before all nodes are checked, which takes minutes on a grid that does not fit
        needed = memory.fitting(arc_bytes(grid, plan, kind), grid, max_memory)
        node_checks.check_values(on, clock)
        with host_loop.with_solution(clock, needed, lambda kept: _partial(on, kept)):
            solution = finish_arcs(_follow(on, scheme, plan, tol, times, start, clock))
    except Stopped as stop:
        return _said(solution_at_start(on, np.zeros(grid.shape) if start is None else start, stop.status), scheme)
    described = "PolicyIteration()" if method is None else method.described(False)
    solution.stats.update(bytes=needed, method=f"{described}, {plan.count} arcs per node")
    return solution


class Followed(NamedTuple):
    """The end of an iteration on arcs.

    Attributes:
      on, scheme, plan: the problem on its grid, the scheme, and the arcs it tries.
      task, state: the task and the last state, on the device.
      code: the status.
      reached: the nodes from which the target is reached; None if there is no target, or the run was cut.
      residuals: the residuals of all steps.
    """

    on: Discretisation
    scheme: Scheme
    plan: Plan
    task: ArcTask
    state: ArcState
    code: Status
    reached: Mask | None
    residuals: np.ndarray


def _follow(
    on: Discretisation, scheme: Scheme, plan: Plan, tol: float, times: int, guess: Nodes | None, clock: Clock
) -> Followed:
    """Compute the arcs of a plan and iterate on them, as far as the clock allows."""
    task, reached = _prepare(on, plan, tol, times, clock)
    run = _Run(task, np.asarray(_start(task)) if guess is None else guess, clock.max_steps)
    code = host_loop.drive(run, clock)
    task, state, problem = run.task, run.state, on.problem
    ends = problem.target is not None and problem.stopping_cost is None
    if reached is None and state.progress.has_begun and ends and code not in CUT:
        reached = np.asarray(_arriving(task, state.number))
    residuals = np.concatenate(run.residuals)[: int(state.progress.evaluations)]
    return Followed(on, scheme, plan, task, state, code, reached, residuals)


def can_replace_chain(problem: Problem, grid: Grid) -> bool:
    """True if ``SemiLagrangian()`` may solve a problem whose chain is carried past the target; evaluates nothing."""
    ends = problem.target is not None and problem.stopping_cost is None and is_discounted(problem) is not True
    try:
        REPLACEMENT.check(problem, grid)
    except ValueError:
        return False
    return ends


def replace_chain(
    on: Discretisation, reach: Reach | None, tol: float, guess: Nodes | None, clock: Clock
) -> Followed | None:
    """The solution on arcs, if the chain may be carried past a target that the paths of the system meet.

    Without noise and discount the chain still spreads like noise of the size of a cell. Where it may miss the target
    under every policy, its expected cost is infinite on every grid, although the true cost may be finite. Arcs do not
    spread.

    Args:
      on: the problem on its grid.
      reach: the nodes that the chain reaches, from ``prepare_on_host``.
      tol: as in ``solve``.
      guess: the caller's guess, or None.
      clock: the limits; raises ``Stopped``.

    Returns:
      The end of the iteration. None if the chain is not carried past the target, or the arcs are no improvement.
    """
    if reach is None or np.asarray(on.problem.discount) > 0 or not is_carried_past(reach):
        return None
    if not can_replace_chain(on.problem, on.grid):
        return None
    on = on.with_scheme(Upwind())
    try:
        plan = REPLACEMENT.plan(on.problem, on.grid, on.dtype)
        memory.fitting(arc_bytes(on.grid, plan, on.dtype), on.grid, None)
        found = _follow(on, REPLACEMENT, plan, tol, relaxations(None, on.grid.ndim), guess, clock)
    except (ValueError, MemoryError):
        return None  # arcs that cost nothing, or too many of them: keep the solution of the chain
    gains = found.reached is None or bool(np.any(found.reached & ~reach.surely))
    return None if found.code in FAILED or not gains else found


def _partial(on: Discretisation, kept: host_loop.Kept | None) -> Solution:
    """The solution of a failed run, from a saved value; else zero."""
    return solution_at_start(on, np.zeros(on.grid.shape) if kept is None else kept[0], Status.INTERRUPTED)


def _prepare(on: Discretisation, plan: Plan, tol: float, times: int, clock: Clock) -> tuple[ArcTask, Mask | None]:
    """The task, and the nodes from which the target is surely reached, if that matters.

    Raises:
      ValueError: values along an arc are not finite, or without a discount an arc costs nothing.
    """
    problem, grid = on.problem, on.grid
    additive = bool(np.asarray(problem.discount) > 0)
    clock.enter(f"the arcs of {' x '.join(map(str, grid.shape))} nodes")
    links, obstacles = _traced(on, plan, running=not additive)
    _check_arcs(on, plan, links, obstacles.fixed)
    reached, counted = None, jnp.ones(grid.shape, bool)
    if not additive and problem.target is not None and problem.stopping_cost is None:
        clock.enter("the search for nodes that reach the target")
        reached = np.asarray(_surely_arriving(links, grid, obstacles.fixed))
        if not reached.all():
            counted = jnp.asarray(reached)
            links = _without(links, grid, counted)
            obstacles = dataclasses.replace(obstacles, fixed=obstacles.fixed | ~counted)
    kind = Certificate.ADDITIVE if additive else Certificate.MULTIPLICATIVE
    return ArcTask(grid, links, obstacles, counted, jnp.asarray(tol, on.dtype), kind, times), reached


@functools.partial(jax.jit, static_argnames="running")
def _traced(on: Discretisation, plan: Plan, *, running: bool) -> tuple[Arcs, bellman.Obstacles]:
    """The arcs of a plan and the prescribed values at the nodes, in the dtype of the solve."""
    on = cast(on, on.dtype)
    obstacles = bellman.obstacles(on)
    return arcs.trace(on, plan, obstacles.fixed, running=running), obstacles


_surely_arriving = jax.jit(arc_iteration.surely_arriving)
_without = jax.jit(arc_iteration.without)
_start = jax.jit(arc_iteration.value_from_above)
_run = WideJit(arc_iteration.run, donate_argnames="state")


@jax.jit
def _faults(links: Arcs, fixed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Per arc: True if its value is not finite from some free node, and true if it costs nothing from some node."""
    along = tuple(range(1, links.pay.ndim))
    broken = jnp.any(~fixed & ~(jnp.isfinite(links.pay) & jnp.isfinite(links.keep)), axis=along)
    free = jnp.zeros(broken.shape, bool)
    if links.running is not None:
        free = jnp.any(~fixed & ~(links.running > 0), axis=along)
    return broken, free


def _check_arcs(on: Discretisation, plan: Plan, links: Arcs, fixed: jax.Array) -> None:
    """Refuse arcs whose value is not finite, and without a discount arcs that cost nothing."""
    word, costs = on.problem.labels.word, on.problem.payoff == COST
    broken, free = (np.asarray(found) for found in _faults(links, fixed))
    if broken.any():
        action = plan.actions[int(np.argmax(broken)) // len(plan.legs)]
        raise ValueError(
            f"solve: on the arcs of the action {np.asarray(action).tolist()} drift, {word('cost')}, target or "
            f"{word('exit_cost')} is NaN or infinite between the nodes, where SemiLagrangian() evaluates them; define "
            "them in the whole box, or use hjb.Upwind()"
        )
    if free.any():
        action = plan.actions[int(np.argmax(free)) // len(plan.legs)]
        raise ValueError(
            f"solve: SemiLagrangian() without discount requires a running {word('cost')} that is "
            f"{'positive' if costs else 'negative'} off the target, or no bound on its error exists; the action "
            f"{np.asarray(action).tolist()} costs nothing somewhere. "
            "Add a discount > 0, or use hjb.Upwind()"
        )


class _Run(StatesInChunks):
    """The iteration of a task on arcs."""

    def __init__(self, task: ArcTask, guess: Nodes, limit: int):
        super().__init__(task, arc_iteration.start(task, guess), _run, guess, limit)

    def first_chunk(self, clock: Clock) -> int:
        """Evaluations of the first chunk, of the guess and of some steps; each evaluates every arc of a node."""
        return 1 + int(np.clip(FIRST_NODES / (self.nodes * self.task.arcs.count), 1, HISTORY - 1))


def finish_arcs(followed: Followed) -> Solution:
    """The solution at the end of a run: values, first actions of the best arcs, bounds, and their description."""
    on, scheme, plan, task, state, code, reached, residuals = followed
    problem, looked, counted = on.problem, state.progress.has_begun, np.asarray(task.counted)
    state = jax.device_get(state)
    if reached is not None and not reached.all():
        endless = task.certificate is not Certificate.ADDITIVE
        warn_unreached(Reach(reached, reached), problem.payoff, undiscounted=endless)
    value = np.array(state.value if looked else task.obstacles.impose(jnp.asarray(state.value)))
    value[~counted] = np.inf
    policy = np.array(np.asarray(plan.actions)[state.number // len(plan.legs)])
    leaving = None if code in CUT or not looked else _leaving(on, value, policy, task)
    policy[~counted | np.asarray(task.obstacles.ended) | (not looked)] = np.nan
    touching = {} if leaving is None else jax.device_get(contact(problem, on.grid, task.obstacles, value))
    best = float(np.asarray(state.progress.best)[0])
    message = within_reach(best) if code is Status.STALLED and np.isfinite(best) else problem.labels.word(code.message)
    solution = solution_at_start(on, value, code)
    solution = dataclasses.replace(
        solution, policy=policy, message=message, reached=reached, cut=leaving, steps=state.progress.steps,
        residuals=residuals, enclosure=certificates.affine_bounds(task.certificate, state.bound) if looked else None,
        discrete=isinstance(problem.controls, Finite), **touching,
    )  # fmt: skip
    solution.stats["certificate"] = WORDS[task.certificate] + "; over the arcs of the scheme"
    return _said(solution, scheme)


def finish_replacement(followed: Followed) -> Solution:
    """The solution that replaces the chain's, with the reason in its message."""
    solution = finish_arcs(followed)
    solution.stats["method"] = f"PolicyIteration(), {followed.plan.count} arcs per node"
    reason = followed.on.problem.labels.word(REASON)
    return dataclasses.replace(solution, message=f"{solution.message} {reason}")


def _said(solution: Solution, scheme: Scheme) -> Solution:
    """The solution with the name of its scheme."""
    solution.stats["scheme"] = repr(scheme)
    return solution


def _leaving(on: Discretisation, value: np.ndarray, policy: np.ndarray, task: ArcTask) -> np.ndarray:
    """The number of nodes at which the optimal drift is cut off, (n, 2), with a warning if it is large."""
    acting = np.asarray(task.counted & task.obstacles.acting(jnp.asarray(value)))
    u = [np.ascontiguousarray(policy[..., j]) for j in range(policy.shape[-1])]
    cut, ends = edges.cut(on.problem, on.grid, np.where(acting, value, 0), (u, []), acting)
    warn_of_cuts(cut, ends, on.grid)
    return cut


@jax.jit
def _arriving(task: ArcTask, number: jax.Array) -> jax.Array:
    """The nodes from which the best arcs reach the target; if some are missing, the nodes from which any arcs do."""
    chosen = jax.tree.map(lambda entry: entry[None], task.arcs.chosen(number))
    found = arc_iteration.arriving(chosen, task.grid, task.obstacles.fixed)
    return jax.lax.cond(
        jnp.all(found), lambda: found, lambda: arc_iteration.arriving(task.arcs, task.grid, task.obstacles.fixed)
    )
