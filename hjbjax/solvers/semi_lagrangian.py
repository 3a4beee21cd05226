"""``solve`` by a scheme that follows paths: its refusals, its task, its run in chunks of steps, its solution."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import arcs as paths
from hjbjax.discretisation import edges
from hjbjax.discretisation.arcs import Arcs, Plan
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.schemes import Upwind
from hjbjax.discretisation.semi_lagrangian import PathScheme, SemiLagrangian
from hjbjax.iteration import arc_iteration, bellman, certificates
from hjbjax.iteration.arc_iteration import ArcState, ArcTask
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.evaluation import Sweeps
from hjbjax.iteration.fixed_point import HISTORY
from hjbjax.iteration.methods import Method
from hjbjax.markov_chain import memory, node_checks
from hjbjax.markov_chain.attainability import Reach
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_discounted
from hjbjax.problem.pytree import cast
from hjbjax.problem.sets import Finite
from hjbjax.problem.types import DType, Mask, Nodes
from hjbjax.solution.clock import CUT, Clock, Stopped
from hjbjax.solution.solution import Solution
from hjbjax.solution.status import Status
from hjbjax.solvers import host_loop
from hjbjax.solvers.host_loop import FIRST_NODES, WideJit
from hjbjax.solvers.result import solution_at_start, warn_of_cuts, within_reach
from hjbjax.solvers.setup import check_on_one_state, is_carried_past, warn_unreached
from hjbjax.solvers.stationary_run import StatesInChunks

REPLACEMENT = SemiLagrangian()  # of the chain, where that is carried past the target
REASON = (
    "It was solved by SemiLagrangian(): the Markov chain of Upwind() and Limited() spreads by about a cell per step "
    "and may be carried past the target, so its expected cost is infinite where that of the path is finite."
)
FAILED = (Status.STALLED, Status.DIVERGED, Status.NONFINITE)
WORDS = {
    Certificate.ADDITIVE: "from the discount, V + min r/(1 − e^{−βτ}) ≤ V_h ≤ V + max r/(1 − e^{−βτ})",
    Certificate.MULTIPLICATIVE: "from the running cost, V/(1 + η) ≤ V_h ≤ V/(1 − ρ)",
}


def relaxations(method: Method | None, n: int) -> int:
    """How often a step follows the best arcs, in n dimensions.

    Raises:
      ValueError: a method that solves the equation of a policy by the matrix of a chain, or on coarser grids.
    """
    if method is None:
        return Sweeps().count * 2**n
    if method.coarsest is None and method.relaxes:
        return 1
    # as many as the sweeps of a chain are worth; see ``Sweeps``
    evaluation = method.filled(Sweeps()).evaluation
    if method.coarsest is None and isinstance(evaluation, Sweeps):
        return evaluation.count * 2**n
    raise ValueError(
        f"solve: SemiLagrangian() follows its arcs again and again, and has no matrix for {method!r}; use "
        "hjb.PolicyIteration(), PolicyIteration(Sweeps(...)) or ValueIteration(), on one grid"
    )


def estimate(grid: Grid, plan: Plan, dtype: DType) -> int:
    """Bytes of the arcs and of what is made of them, from a count of the arrays that live at once."""
    word = np.dtype(dtype).itemsize
    each = (3 + grid.ndim) * word + 4  # pay, keep, fractions, running cost, cell
    return (each * (plan.count + 2) + 12 * word) * grid.size


def solve_on_host(
    problem: Problem,
    grid: Grid,
    scheme: PathScheme,
    kind: np.dtype,
    *,
    method: Method | None,
    tol: float,
    guess: Nodes | None,
    max_memory: int | None,
    clock: Clock,
) -> Solution:
    """The solution by checks, arcs and steps, in this order, as far as the clock allows; float64 is on if asked for."""
    scheme.check(problem, grid)
    times = relaxations(method, grid.ndim)
    on = Discretisation(problem, grid, Upwind(), kind)  # what is asked of it has nothing to do with slopes
    start = None if guess is None else np.asarray(guess, kind)
    try:
        check_on_one_state(problem, grid, scheme)
        plan = scheme.plan(problem, grid, kind)
        # before all nodes are looked at, which on a grid that does not fit takes minutes
        needed = memory.fitting(estimate(grid, plan, kind), grid, max_memory)
        node_checks.values(on, clock)
        with host_loop.with_solution(clock, needed, lambda kept: _partial(on, kept)):
            solution = finish(follow(on, scheme, plan, tol, times, start, clock))
    except Stopped as stop:
        return _said(solution_at_start(on, np.zeros(grid.shape) if start is None else start, stop.status), scheme)
    described = "PolicyIteration()" if method is None else method.described(False)
    solution.stats.update(bytes=needed, method=f"{described}, {plan.count} arcs a node")
    return solution


class Followed(NamedTuple):
    """A solve on arcs at the end of its iteration.

    Attributes:
      on, scheme, plan: the problem on its grid, the scheme, and the arcs that it tries.
      task, state: the task and the last state, on the device.
      code: how the iteration ended.
      reached: the nodes from which the target is reached; None where there is nothing to reach, or a run was cut.
      residuals: those of all steps.
    """

    on: Discretisation
    scheme: PathScheme
    plan: Plan
    task: ArcTask
    state: ArcState
    code: Status
    reached: Mask | None
    residuals: np.ndarray


def follow(
    on: Discretisation, scheme: PathScheme, plan: Plan, tol: float, times: int, guess: Nodes | None, clock: Clock
) -> Followed:
    """The arcs of a plan and the iteration on them, as far as the clock allows."""
    task, reached = _prepare(on, plan, tol, times, clock)
    run = _Run(task, np.asarray(_start(task)) if guess is None else guess, clock.max_steps)
    code = host_loop.drive(run, clock)
    task, state, problem = run.task, run.state, on.problem
    ends = problem.target is not None and problem.stopping_cost is None
    if reached is None and int(state.step) >= 0 and ends and code not in CUT:
        reached = np.asarray(_arriving(task, state.number))
    residuals = np.concatenate(run.residuals)[: int(state.step) + 1]
    return Followed(on, scheme, plan, task, state, code, reached, residuals)


def can_replace_chain(problem: Problem, grid: Grid) -> bool:
    """True if ``SemiLagrangian()`` may solve a problem whose chain is carried past the target; reads no values."""
    ends = problem.target is not None and problem.stopping_cost is None and is_discounted(problem) is not True
    try:
        REPLACEMENT.check(problem, grid)
    except ValueError:
        return False
    return ends


def replace_chain(
    on: Discretisation, reach: Reach | None, tol: float, guess: Nodes | None, clock: Clock
) -> Followed | None:
    """The answer on arcs where the chain may be carried past a target that the paths of the system meet.

    Without noise and discount the chain still spreads like noise of the size of a cell. If it may miss the target under
    every policy, its expected cost is infinite, at nodes whose true cost is finite, on every grid. Arcs keep together.

    Args:
      on: the problem on its grid.
      reach: the nodes that the chain reaches, from ``prepare_on_host``.
      tol: as in ``solve``.
      guess: the caller's, or None.
      clock: the limits; raises ``Stopped``.

    Returns:
      The end of the iteration. None where the chain is not carried past the target, or the arcs do no better.
    """
    if reach is None or on.mesh is not None or np.asarray(on.problem.discount) > 0 or not is_carried_past(reach):
        return None
    if not can_replace_chain(on.problem, on.grid):
        return None
    on = dataclasses.replace(on, scheme=Upwind(), cut=None)
    try:
        plan = REPLACEMENT.plan(on.problem, on.grid, on.dtype)
        memory.fitting(estimate(on.grid, plan, on.dtype), on.grid, None)
        found = follow(on, REPLACEMENT, plan, tol, relaxations(None, on.grid.ndim), guess, clock)
    except (ValueError, MemoryError):
        return None  # arcs that cost nothing, or too many of them: the chain's answer stands
    gains = found.reached is None or bool(np.any(found.reached & ~reach.surely))
    return None if found.code in FAILED or not gains else found


def _partial(on: Discretisation, kept: host_loop.Kept | None) -> Solution:
    """The solution of a run that broke, from the value that outlived it; else zero."""
    return solution_at_start(on, np.zeros(on.grid.shape) if kept is None else kept[0], Status.INTERRUPTED)


def _prepare(on: Discretisation, plan: Plan, tol: float, times: int, clock: Clock) -> tuple[ArcTask, Mask | None]:
    """The task, and the nodes from which the target is reached for sure, where that has to be known.

    Raises:
      ValueError: numbers that are not finite on the way of an arc; without a discount an arc that costs nothing.
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
    """The arcs of a plan and what is given at the nodes, in the type of the solve."""
    on = cast(on, on.dtype)
    obstacles = bellman.obstacles(on)
    return paths.trace(on, plan, obstacles.fixed, running=running), obstacles


_surely_arriving = jax.jit(arc_iteration.surely_arriving)
_without = jax.jit(arc_iteration.without)
_start = jax.jit(arc_iteration.start)
_run = WideJit(arc_iteration.run, donate_argnames="state")


@jax.jit
def _faults(links: Arcs, fixed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Per arc whether from some free node it is worth no finite number, and whether from some it costs nothing."""
    along = tuple(range(1, links.pay.ndim))
    broken = jnp.any(~fixed & ~(jnp.isfinite(links.pay) & jnp.isfinite(links.keep)), axis=along)
    free = jnp.zeros(broken.shape, bool)
    if links.running is not None:
        free = jnp.any(~fixed & ~(links.running > 0), axis=along)
    return broken, free


def _check_arcs(on: Discretisation, plan: Plan, links: Arcs, fixed: jax.Array) -> None:
    """Refuse arcs that are worth no number, and without a discount such that cost nothing."""
    broken, free = (np.asarray(found) for found in _faults(links, fixed))
    if broken.any():
        action = plan.actions[int(np.argmax(broken)) // len(plan.legs)]
        raise ValueError(
            f"solve: on the arcs of the action {np.asarray(action).tolist()} drift, cost, target or exit_cost is NaN "
            "or infinite between the nodes, where SemiLagrangian() evaluates them; define them in the whole box, or "
            "use hjb.Upwind()"
        )
    if free.any():
        action = plan.actions[int(np.argmax(free)) // len(plan.legs)]
        raise ValueError(
            "solve: SemiLagrangian() without discount wants a running cost that is positive off the target, or nothing "
            f"bounds its error; the action {np.asarray(action).tolist()} pays none somewhere. "
            "Give a discount > 0, or use hjb.Upwind()"
        )


class _Run(StatesInChunks):
    """The iteration of a task on arcs."""

    def __init__(self, task: ArcTask, guess: Nodes, limit: int):
        super().__init__(task, arc_iteration.begin(task, guess), _run, guess, limit)

    def first_chunk(self, clock: Clock) -> int:
        """Steps of the first chunk, beside the look at the guess: a step looks at every arc of a node."""
        return int(np.clip(FIRST_NODES / (self.nodes * self.task.arcs.count), 1, HISTORY - 1))


def finish(followed: Followed) -> Solution:
    """The solution at the end of a run: values, first actions of the best arcs, bounds, and the words for them."""
    on, scheme, plan, task, state, code, reached, residuals = followed
    problem, looked, counted = on.problem, int(state.step) >= 0, np.asarray(task.counted)
    state = jax.device_get(state)
    if reached is not None and not reached.all():
        warn_unreached(Reach(reached, reached), undiscounted=task.certificate is not Certificate.ADDITIVE)
    value = np.array(state.value if looked else task.obstacles.impose(jnp.asarray(state.value)))
    value[~counted] = np.inf
    policy = np.array(np.asarray(plan.actions)[state.number // len(plan.legs)])
    leaving = None if code in CUT or not looked else _leaving(on, value, policy, task)
    policy[~counted | np.asarray(task.obstacles.ended) | (not looked)] = np.nan
    best = float(state.best[0])
    message = within_reach(best) if code is Status.STALLED and np.isfinite(best) else code.message
    solution = solution_at_start(on, value, code)
    solution = dataclasses.replace(
        solution, policy=policy, message=message, reached=reached, cut=leaving, steps=max(int(state.step), 0),
        residuals=residuals, enclosure=certificates.enclosure(task.certificate, state.bound) if looked else None,
        discrete=isinstance(problem.controls, Finite),
    )  # fmt: skip
    solution.stats["certificate"] = WORDS[task.certificate] + "; for the arcs that are tried"
    return _said(solution, scheme)


def finish_replacement(followed: Followed) -> Solution:
    """The solution that stands in for the chain's, with the reason in its message."""
    solution = finish(followed)
    solution.stats["method"] = f"PolicyIteration(), {followed.plan.count} arcs a node"
    return dataclasses.replace(solution, message=f"{solution.message} {REASON}")


def _said(solution: Solution, scheme: PathScheme) -> Solution:
    """The solution with the name of the scheme that made it."""
    solution.stats["scheme"] = repr(scheme)
    return solution


def _leaving(on: Discretisation, value: np.ndarray, policy: np.ndarray, task: ArcTask) -> np.ndarray:
    """Numbers of nodes at which the optimal drift is cut off, (n, 2), with a warning where they are most of an end."""
    acting = np.asarray(task.counted & task.obstacles.acting(jnp.asarray(value)))
    u = [np.ascontiguousarray(policy[..., j]) for j in range(policy.shape[-1])]
    cut, ends = edges.cut(on.problem, on.grid, np.where(acting, value, 0), (u, []), acting)
    warn_of_cuts(cut, ends, on.grid)
    return cut


@jax.jit
def _arriving(task: ArcTask, number: jax.Array) -> jax.Array:
    """Those that the best arcs bring there, and where that is not all of them those that any arcs do."""
    chosen = jax.tree.map(lambda entry: entry[None], task.arcs.chosen(number))
    found = arc_iteration.arriving(chosen, task.grid, task.obstacles.fixed)
    return jax.lax.cond(
        jnp.all(found), lambda: found, lambda: arc_iteration.arriving(task.arcs, task.grid, task.obstacles.fixed)
    )
