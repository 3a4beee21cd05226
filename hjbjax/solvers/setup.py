"""From a problem on a grid to a task: fixed nodes, counted nodes, certificate and method."""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.rates import fastest_rate
from hjbjax.discretisation.schemes import Limited, Upwind
from hjbjax.hamiltonian.exact import may_miss
from hjbjax.iteration import bellman, certificates
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.evaluation import Direct, Evaluation, Krylov, Sweeps
from hjbjax.iteration.fixed_point import Task
from hjbjax.iteration.methods import Method, Nested, PolicyIteration, ValueIteration
from hjbjax.problem.grid import Grid, division, tabulated
from hjbjax.problem.labels import COST
from hjbjax.problem.layouts import Layout
from hjbjax.problem.problem import Problem, is_constrained, is_discounted
from hjbjax.problem.pytree import altered, cast, known
from hjbjax.problem.types import Mask, Number, Scalar
from hjbjax.solution.clock import Clock
from hjbjax.solution.status import warn
from hjbjax.tracing import checks
from hjbjax.well_posedness import attainability, endless_costs, resting
from hjbjax.well_posedness.attainability import Reach

OPERATIONS = 10_000  # scalar operations per evaluation; XLA takes minutes to compile a dozen such evaluations
DIRECT = 50_000  # largest plane grid with open ends that is solved by sparse LU, at about a second per step
# A sweep receives values of the adjacent part only at the next exchange: 1600 x 1601 nodes on two devices took 19 steps
# of three sweeps and 1.4 s, 14 steps of five and 1.2 s; 800 x 801 nodes take 0.23 s and 0.27 s.
BETWEEN_PARTS, MANY = 5, 10**6  # sweeps, and the number of nodes above which they are used
LINKS = 200_000  # largest grid whose cut links are stored: 34 bytes per node and axis, but half the compile time
NEST = 100_000  # nodes above which compiling coarser grids pays
TOL = 1e-3  # the default tolerance, cost units
COARSEST = 20_000  # nodes of the coarsest grid: for fewer a step takes under a millisecond, but compiling a second


def check_on_one_state(problem: Problem, grid: Grid, scheme: object) -> None:
    """Refuse functions that fail at a single state, and warn of functions that take XLA minutes to compile."""
    checks.shapes(problem, grid, scheme)
    count = checks.operations_of(problem, grid.ndim).single
    if count > OPERATIONS:
        warn(
            f"one evaluation of the problem's functions is {count:,} scalar operations, each an array over the nodes, "
            f"and over more than {OPERATIONS:,} the compiler takes minutes. Write sums as products with one matrix "
            "(W @ x with over 60 entries is one operation), and repetitions as jax.lax.fori_loop or scan"
        )


def choose(
    problem: Problem, grid: Grid, *, traced: bool, method: Method | None = None, divided: bool = False
) -> Method:
    """The method that suits a problem, or the requested method with a suitable evaluation.

    ``divided``: the nodes are divided among several devices, so no host has all of them.

    Large grids are nested. For tubes without discount, whose policies have no unique value, only value iteration
    converges to the right one of many fixed points.
    """
    if method is not None:
        return method.filled(choose_evaluation(problem, grid, divided=divided))
    # a policy that waits at ψ or g at no cost solves its own linear equation with any value
    if is_constrained(problem) and is_discounted(problem) is False:
        return ValueIteration()
    method = PolicyIteration(choose_evaluation(problem, grid, divided=divided))
    # from a cold start a good policy advances by one cell per improvement: N of them on one grid, a few on nested
    # grids; on the zoo's pendulum with 400 x 401 nodes the steps of all levels took 0.2 s instead of 0.9 s
    return Nested(method, COARSEST) if grid.size > NEST and not (traced or grid.sides("open")) else method


def choose_evaluation(problem: Problem, grid: Grid, *, divided: bool = False) -> Evaluation:
    """The evaluation of policies that suits a problem.

    If transport dominates, a few wavefront sweeps evaluate a policy well enough. With noise they are too slow and
    precondition a Krylov method. With modes information travels both ways too: saving on 500 nodes with two incomes
    takes 12 steps of a Krylov method, and 50 of sweeps.
    """
    if grid.sides("open"):  # sweeps do not support extrapolated values; see ``relaxed``
        small = grid.ndim < 3 and grid.size <= DIRECT and not divided
        return Direct() if small else Krylov()
    far = problem.landings is not None  # sweeps do not follow jumps of the state
    if problem.noise is None and not grid.modes and not far:
        return Sweeps(BETWEEN_PARTS) if divided and grid.size > MANY else Sweeps()
    return Krylov()


def march_evaluation(problem: Problem, grid: Grid, *, divided: bool = False) -> Evaluation:
    """The evaluation of policies in an implicit step that suits the problem."""
    if grid.sides("open"):
        return choose_evaluation(problem, grid, divided=divided)
    # sweeps follow the drift and are slow if noise spreads information in both directions
    return Sweeps() if problem.noise is None and problem.landings is None else Krylov()


def choose_scheme(on: Discretisation, method: Method) -> Scheme:
    """The scheme that suits a problem; host level.

    It is second order with limited slopes, unless noise makes central differences monotone at every node, which are
    second order and certified. Value iteration is the operator of the chain, and a tube without discount must end where
    V no longer changes, so both use the chain.
    """
    problem, calm = on.problem, Limited().chain
    if not may_raise_order(problem, method, None):
        return Upwind()
    if problem.noise is not None and bool(_central(on.with_scheme(calm))):
        return calm
    return Limited()


def may_raise_order(problem: Problem, method: Method, scheme: Scheme | None) -> bool:
    """True if a scheme of high order may follow the chain; without a ``scheme`` and with noise, the nodes decide."""
    if scheme is not None:
        return not scheme.monotone
    return not (method.relaxes or (is_constrained(problem) and is_discounted(problem) is False))


@jax.jit
def _central(on: Discretisation) -> jax.Array:
    """True if central differences are monotone at all nodes, for every action."""
    on = cast(on, on.dtype)
    return jnp.all(jnp.stack([jnp.all(axis) for axis in on.central_nodes(on.coordinates(), on.links)]))


def prepare(on: Discretisation, *, method: Method, tol: Number, assumptions: "Assumptions") -> Task:
    """The task of a solve, all arrays in its dtype; pure, so that it may be traced, batched and differentiated."""
    on = cast(on, on.dtype)
    on = on.with_links() if stores_links(on) else on
    obstacles, still = _obstacles(on, assumptions)
    # a tube with a traced discount uses relaxations if it is zero, which only the compiled program can decide
    undecided = assumptions.certificate is Certificate.BY_DISCOUNT and is_constrained(on.problem)
    outflow = None
    if method.relaxes or undecided or assumptions.certificate is Certificate.OPEN:
        rate = fastest_rate(on) + on.problem.discount
        outflow = jnp.where(rate > 0, rate, 1)  # 1 where nothing moves, because the sweeps divide by it
    priced = assumptions.costs_certify and still is not None
    return Task(
        on, method, obstacles, jnp.ones(on.grid.shape, bool), still.least if priced and still else None, outflow,
        jnp.asarray(tol, on.dtype), assumptions.certificate, still.crossing if priced and still else None,
        floor=_floor(on, obstacles, still),
    )  # fmt: skip


def stores_links(on: Discretisation) -> bool:
    """True if a program stores the links cut by a target: the grid is small enough."""
    return on.cuts_links and math.prod(on.grid.layout.whole) <= LINKS


def _floor(on: Discretisation, obstacles: bellman.Obstacles, still: resting.Standstill | None) -> Scalar | None:
    """A lower bound on all values: the least payment at the end of a run, if no action earns before it.

    None if the costs of resting were not computed. If an action can earn something there is no such bound, and the
    result is the least finite number; a traced problem decides this at run time.
    """
    if still is None or is_constrained(on.problem):
        return None
    costs, layout = jnp.where(jnp.isfinite(still.least), still.least, 0), on.grid.layout
    small = resting.ROUNDINGS * jnp.finfo(on.dtype).eps * layout.largest(jnp.abs(costs))
    ends = certificates.lowest_end(obstacles, jnp.ones(on.grid.shape, bool), layout)
    # finite, since values are compared with a multiple of it
    return jnp.where(~layout.some(~(costs >= -small)), ends, jnp.finfo(on.dtype).min / 8).astype(on.dtype)


def _obstacles(on: Discretisation, assumptions: "Assumptions") -> tuple[bellman.Obstacles, resting.Standstill | None]:
    """The obstacles, including rest points, and where the system can rest, if this matters to the problem."""
    obstacles, problem = bellman.obstacles(on), on.problem
    if on.scheme.subcell and problem.exit_cost is not None:
        ends = (meets for link in on.links for meets in (link.meets_up, link.meets_down))
        met = [on.grid.layout.least(jnp.where(*meets, 0)) for meets in ends if meets]
        # a lower bound on V must not exceed any exit cost, also where the boundary is between the nodes
        obstacles = dataclasses.replace(obstacles, least_exit=jnp.minimum(jnp.min(jnp.stack(met)), 0))
    if not (assumptions.may_rest or assumptions.costs_certify):
        return obstacles, None
    still = resting.standstill(on)
    if not assumptions.may_rest:
        return obstacles, still
    # with a discount the equation has one solution and no rest node is fixed; the discount may be traced
    return dataclasses.replace(obstacles, fixed=obstacles.fixed | (still.rests & (problem.discount == 0))), still


BOUNDING = (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE, Certificate.BY_DISCOUNT)


@dataclasses.dataclass(frozen=True)
class Assumptions:
    """Facts about a problem that follow from its structure.

    Attributes:
      certificate: the applicable error bound.
      exact: True if the minimum over the actions is exact; otherwise there are no bounds.
      may_rest: True if only rest points at zero cost can make the value finite (no discount, no constraint).
      costs_certify: True if a positive running cost gives a bound although there is no discount.
    """

    certificate: Certificate
    exact: bool
    may_rest: bool
    costs_certify: bool = False

    @property
    def sentence(self) -> str:
        """The argument that certifies the error, or the reason why there is none."""
        if self.certificate in BOUNDING and not self.exact:
            return "no bounds: the optimum over the actions is searched, and may be missed"
        return self.certificate.value


def assumptions_of(on: Discretisation) -> Assumptions:
    """The assumptions from the structure of the problem; a traced discount leaves the certificate undecided."""
    if on.grid.sides("open"):
        # extrapolated values do not belong to a chain, so none of the bounds holds
        return dataclasses.replace(assumptions_of(on.on_grid(stencil.walled(on.grid))), certificate=Certificate.OPEN)
    problem = on.problem
    players, discounted = on.players, is_discounted(problem)
    if discounted:
        return Assumptions(Certificate.ADDITIVE, players.exact, may_rest=False)
    fits = problem.running_max is None and problem.cost is not None and not players.disturbance_costs
    fits &= not on.grid.sides("neumann")  # a prescribed slope acts as a cost at the end, which may be negative
    kind = Certificate.MULTIPLICATIVE if fits else Certificate.NONE
    may_rest = not is_constrained(problem) and problem.cost is not None
    return Assumptions(Certificate.BY_DISCOUNT if discounted is None else kind, players.exact, may_rest, fits)


@functools.partial(jax.jit, static_argnames=("assumptions", "layout"))
def _prepare_jit(on: Discretisation, method: Method, tol: Number, *, assumptions: Assumptions, layout: Layout) -> Task:
    """``prepare`` for the nodes of all devices at once."""

    def here(on: Discretisation, method: Method, tol: Number) -> Task:
        made = prepare(on.on_part(layout), method=method, tol=tol, assumptions=assumptions)
        return altered(made, on=altered(made.on, grid=on.grid))  # the same on every device

    marks: Any = None
    if layout.axes:
        # traced inside shard_map here too: constants of the user's functions are cached, and belong to its mesh
        part = jax.eval_shape(layout.mapped(here, False, False), on, method, tol)
        marks = part.over_nodes(layout.shape)
    return layout.mapped(here, False, marks)(on, method, tol)


def prepared(
    on: Discretisation, *, method: Method, tol: Number, assumptions: Assumptions, mesh: Mesh | None = None
) -> Task:
    """The task of ``prepare`` at host level, with spacings and coordinates as constants of the program."""
    layout = division(on.grid, mesh)
    there, how = layout.copied((on.on_grid(tabulated(on.grid)), method))
    made = _prepare_jit(there, how, tol, assumptions=assumptions, layout=layout)
    if layout.axes:
        made = layout.gathered(made, made.over_nodes(layout.entries))
    grid = jax.tree.map(lambda leaf: np.asarray(leaf, on.dtype), on.grid)
    return altered(made, on=altered(made.on, grid=grid), mesh=mesh)


def prepare_on_host(
    on: Discretisation, *, method: Method, tol: float, clock: Clock | None = None, mesh: Mesh | None = None
) -> tuple[Task, Assumptions, Reach | None]:
    """The task of ``prepare``, with the checks that require values: if and where there is a finite solution.

    It checks the clock between its phases and may raise ``Stopped``.

    Returns:
      The task, the assumptions, and the nodes that reach the target (None if there is no target).

    Raises:
      ValueError: there is no finite solution.
    """
    clock, problem, grid = clock or Clock(), on.problem, on.grid
    clock.enter(f"the preparation of {' x '.join(map(str, grid.shape))} nodes")
    assumptions = assumptions_of(on)
    if may_miss(on):
        assumptions = dataclasses.replace(assumptions, exact=False)
    if is_bare(method):
        return *_bare(on, method, tol, assumptions, mesh), None
    task = prepared(on, method=method, tol=tol, assumptions=assumptions, mesh=mesh)
    priced = assumptions.certificate is Certificate.MULTIPLICATIVE
    # where L = 0 the bound by the running cost fails, and a run may rest, or cycle, indefinitely at no cost
    if (priced and not _costs_positive(task)) or problem.cost is None:
        task = _with_refuge(task)
        assumptions = dataclasses.replace(
            assumptions, may_rest=not is_constrained(problem) and not problem.discount > 0
        )
    if priced and problem.is_game and not _costs_positive(task) and not method.relaxes:
        # policies that continue indefinitely at no cost have any value; the required one is the limit of long horizons
        task = prepared(on, method=ValueIteration(), tol=tol, assumptions=assumptions, mesh=mesh)
    if priced and not _costs_positive(task):
        assumptions = dataclasses.replace(assumptions, certificate=Certificate.NONE)
        task = dataclasses.replace(task, certificate=Certificate.NONE, least_cost=None)
    held = np.asarray(task.obstacles.fixed)
    undiscounted = problem.discount == 0
    if undiscounted:
        _refuse_earning_pushes(task)
    endless_costs.ill_posed(problem, bool(assumptions.may_rest and held.any()), grid)
    # a game is searched only if it fails, because all pairs of actions are expensive; a constraint makes all values
    # finite
    if problem.is_game or is_constrained(problem) or not held.any():
        return task, assumptions, None
    reach = attainability.reached(
        task.on, held, surely=undiscounted, least=_least_rate(task), clock=clock, layout=task.division
    )
    if undiscounted and not reach.surely.all():
        task = _finite_part(task, reach.surely)
    return task, assumptions, reach


def _refuse_earning_pushes(task: Task) -> None:
    """Refuse pushes that earn in a problem without discount, whose value no residual bounds."""
    pushes = task.obstacles.interventions
    if pushes.pushes and min(float(jnp.min(cost)) for cost in pushes.costs) < 0:
        raise ValueError(
            "solve: got a push that earns (a reward, or a negative cost) in a problem without discount; without it the "
            "rewards may\naccumulate forever, and no residual bounds the value. Give discount > 0, or march over a "
            "finite horizon"
        )


def is_bare(method: Method) -> bool:
    """True if the method stores only V."""
    return method.relaxes and not method.policy


def _bare(
    on: Discretisation, method: Method, tol: float, assumptions: Assumptions, mesh: Mesh | None
) -> tuple[Task, Assumptions]:
    """The task and the assumptions of a solve that stores only V, without an array of the nodes."""
    additive = assumptions.certificate is Certificate.ADDITIVE
    if not (additive or is_constrained(on.problem)) or on.grid.sides("open"):
        raise ValueError(
            "ValueIteration(policy=False) stores only V. It has no error bound without a discount, and converges on "
            "its own only for tubes. Use discount > 0 and no open ends, or remove policy=False"
        )
    certificate = Certificate.ADDITIVE if additive else Certificate.NONE
    on, nothing = cast(on, on.dtype), bellman.Obstacles(jnp.zeros((), bool), jnp.zeros((), on.dtype))
    task = Task(
        on, method, nothing, jnp.ones((), bool), None, None, jnp.asarray(tol, on.dtype), certificate, bare=True,
        mesh=mesh,
    )  # fmt: skip
    return task, dataclasses.replace(assumptions, certificate=certificate, may_rest=False)


def forced_only(task: Task, clock: Clock) -> tuple[Task, Mask | None]:
    """The task of a game that did not converge, without the nodes from which the target cannot be forced.

    Returns:
      The task and the remaining nodes; ``None`` if forcing does not matter.
    """
    held = np.asarray(task.obstacles.fixed)
    if not task.problem.is_game or task.constrained or np.asarray(task.problem.discount) > 0 or not held.any():
        return task, None
    # an opponent who avoids the target, and pays for it, may leave a finite cost
    if task.certificate is not Certificate.MULTIPLICATIVE:
        return task, None
    reached = attainability.forced(task.on, held, least=_least_rate(task), clock=clock)
    if reached.all():
        return task, reached
    warn_unreached(Reach(reached, reached), task.problem.payoff, undiscounted=True)
    return _finite_part(task, reached), reached


def _with_refuge(task: Task) -> Task:
    """The task with nodes fixed at zero where a run may continue indefinitely without paying, as at rest nodes.

    In a game the control must be able to enforce this, and a target may be worth more, so there must be none.
    """
    game = task.problem.is_game
    if (game and task.problem.target is not None) or task.constrained or np.asarray(task.problem.discount) > 0:
        return task
    # on the target the run has ended; elsewhere it could continue at the least cost of all actions
    free = ~np.broadcast_to(np.asarray(task.obstacles.ended), task.grid.shape)
    least = np.zeros(task.grid.shape) if task.least_cost is None else np.asarray(task.least_cost)
    small = resting.ROUNDINGS * np.finfo(task.tol.dtype).eps * np.max(np.abs(least))
    # if something can be earned, cycling at no cost need not be optimal
    if np.any(least[free] < -small):
        return task
    search = attainability.held_by_control if game else attainability.refuge
    found = search(task.on, jnp.asarray((least <= small) & free), jnp.asarray(small, task.tol.dtype))
    return dataclasses.replace(task, obstacles=dataclasses.replace(task.obstacles, fixed=task.obstacles.fixed | found))


def _costs_positive(task: Task) -> bool:
    """True if the running cost is positive at all free nodes."""
    return bool(np.all(np.asarray(task.least_cost)[~np.asarray(task.obstacles.fixed)] > 0))


def _least_rate(task: Task) -> Number:
    """The jump rate that counts as rounding relative to the fastest motion on the grid; zero if unknown."""
    if task.crossing is None:
        return np.zeros((), task.tol.dtype)
    # the sum of the nodes over all axes, over the time of a crossing: the jump rate of the fastest motion
    return resting.ROUNDINGS * jnp.finfo(task.tol.dtype).eps * sum(task.grid.shape) / known(task.crossing)


def _finite_part(task: Task, reached: Mask) -> Task:
    """The task on the nodes with a finite value; other nodes get a larger value, so no optimal action leads there."""
    lost = ~jnp.asarray(reached)
    left = task.obstacles.interventions.avoiding(lost)
    obstacles = dataclasses.replace(task.obstacles, fixed=task.obstacles.fixed | lost, interventions=left)
    return dataclasses.replace(task, obstacles=obstacles, counted=task.counted & jnp.asarray(reached), has_lost=True)


def is_carried_past(reach: Reach) -> bool:
    """True if some nodes reach the target with positive probability, but not with probability one under any policy."""
    return bool(np.any(reach.maybe & ~reach.surely))


def warn_unreached(reach: Reach, payoff: str, *, undiscounted: bool) -> None:
    """Warn of nodes from which the target is not reached, or not surely, and explain their value."""
    never, passed = (100 * float(np.mean(each)) for each in (~reach.maybe, reach.maybe & ~reach.surely))
    infinite = "inf" if payoff == COST else "-inf"
    what = f"their value is {infinite}" if undiscounted else f"their value is the discounted {payoff} of never arriving"
    if not passed:
        warn(f"{never:.3g} % of the nodes cannot reach the target: {what}; see Solution.reached")
        return
    none = f"{never:.3g} % of the nodes cannot reach the target under any control, and " if never else ""
    warn(
        f"{none}from {passed:.3g} % of the nodes the Markov chain may be carried past the target under every control, "
        f"so its expected {payoff} is {'' if payoff == COST else 'minus '}infinite: {what}; see Solution.reached. "
        "Without noise a path may still arrive from there: use scheme=hjb.SemiLagrangian(), or a discount > 0"
    )
