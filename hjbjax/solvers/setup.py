"""From a problem on a grid to a task: what is held, what counts, which certificate applies, which method runs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import cut_cells, schemes
from hjbjax.discretisation.discretisation import Discretisation, Scheme
from hjbjax.discretisation.rates import fastest_rate
from hjbjax.discretisation.schemes import Limited, Upwind
from hjbjax.hamiltonian.exact import may_miss
from hjbjax.hamiltonian.players import players_of
from hjbjax.iteration import bellman, certificates
from hjbjax.iteration.certificates import Certificate
from hjbjax.iteration.evaluation import Direct, Evaluation, Krylov, Sweeps
from hjbjax.iteration.fixed_point import Task
from hjbjax.iteration.methods import Method, Nested, PolicyIteration, ValueIteration
from hjbjax.markov_chain import attainability, resting
from hjbjax.markov_chain.attainability import Reach
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem, is_constrained, is_discounted
from hjbjax.problem.pytree import altered, cast, known
from hjbjax.problem.types import Mask, Number, Scalar
from hjbjax.solution.clock import Clock
from hjbjax.solution.status import warn
from hjbjax.tracing import checks

OPERATIONS = 10_000  # of one evaluation: XLA takes minutes over a program in which there are a dozen such
DIRECT = 50_000  # nodes up to which a plane with open ends is solved by sparse LU: about a second a step
# A sweep hears of the part beside at the next exchange alone: 1600 x 1601 nodes on two devices took 19 steps of three
# sweeps and 1.4 s, 14 steps of five and 1.2 s; 800 x 801 nodes take .23 s and .27 s.
BETWEEN_PARTS, MANY = 5, 10**6  # sweeps, and the nodes beyond which there are so many
NEST = 100_000  # nodes beyond which compiling coarser grids pays
COARSEST = 20_000  # nodes up to which none is worth it: a step takes under a millisecond, and its program a second


def check_on_one_state(problem: Problem, grid: Grid, scheme: object) -> None:
    """Refuse functions that one state shows to be wrong, and warn of such as XLA takes minutes to compile."""
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
    """The method that suits a problem, or the one that was asked for with the evaluation that does.

    ``divided``: the nodes lie on several devices, and no host has them all at once.

    Large grids are nested. Tubes without discount have policies without a value of their own: there value iteration
    alone keeps to the extreme one of many fixed points.
    """
    if method is not None:
        return method.filled(choose_evaluation(problem, grid, traced=traced, divided=divided))
    # a policy that waits at ψ or g for nothing solves its own linear equation with any value
    if is_constrained(problem) and is_discounted(problem) is False:
        return ValueIteration()
    method = PolicyIteration(choose_evaluation(problem, grid, traced=traced, divided=divided))
    # from a cold start a good policy spreads by one cell an improvement: N of them on one grid, a few on nested ones;
    # on the zoo's pendulum with 400 x 401 nodes the steps of all levels took .2 s in place of .9
    return Nested(method, COARSEST) if grid.size > NEST and not (traced or grid.sides("open")) else method


def choose_evaluation(problem: Problem, grid: Grid, *, traced: bool, divided: bool = False) -> Evaluation:
    """The evaluation of policies that suits a problem.

    Where transport rules, a few wavefront sweeps evaluate a policy well enough. Where there is noise they are too slow
    and precondition a Krylov method; on a line a direct solve costs nothing.
    """
    if grid.sides("open"):  # what is continued from inside is no matter for sweeps; see relaxation
        small = grid.ndim < 3 and grid.size <= DIRECT and not divided
        return Direct() if small else Krylov()
    if problem.noise is None:
        return Sweeps(BETWEEN_PARTS) if divided and grid.size > MANY else Sweeps()
    return Krylov() if traced or divided else linear_solve(grid)


def march_evaluation(problem: Problem, grid: Grid, *, divided: bool = False) -> Evaluation:
    """The evaluation of policies in an implicit step that suits the problem."""
    if grid.sides("open"):
        return choose_evaluation(problem, grid, traced=False, divided=divided)
    # sweeps follow the drift and are slow where noise spreads news both ways
    return Sweeps() if problem.noise is None else Krylov()


def choose_scheme(on: Discretisation, method: Method) -> Scheme:
    """The scheme that suits a problem; host level.

    Of second order, by limited slopes, unless noise lets central differences be monotone at every node, which are of
    second order and certified. Value iteration is the chain's own operator, and a tube without discount must end where
    V no longer changes: both stay with the chain.
    """
    problem, calm = on.problem, Limited().chain
    if method.relaxes or (is_constrained(problem) and is_discounted(problem) is False):
        return Upwind()
    if problem.noise is not None and bool(_central(dataclasses.replace(on, scheme=calm))):
        return calm
    return Limited()


@jax.jit
def _central(on: Discretisation) -> jax.Array:
    """True if central differences are monotone at all nodes, whatever the action."""
    on = cast(on, on.dtype)
    calm = schemes.calm(on, on.coordinates(), cut_cells.links(on))
    return jnp.all(jnp.stack([jnp.all(axis) for axis in calm]))


def linear_solve(grid: Grid) -> Direct | Krylov:
    """The linear solver that evaluates a policy where sweeps are too slow; host level."""
    return Direct() if grid.ndim == 1 else Krylov()


def prepare(on: Discretisation, *, method: Method, tol: Number, assumptions: "Assumptions") -> Task:
    """The task of a solve, all arrays in its type; pure, so that it may be traced, batched and differentiated."""
    on = cut_cells.kept(cast(on, on.dtype))
    obstacles, still = _obstacles(on, assumptions)
    # a tube with a traced discount takes relaxations if that is zero, which only the compiled program will see
    undecided = assumptions.certificate is Certificate.BY_DISCOUNT and is_constrained(on.problem)
    outflow = None
    if method.relaxes or undecided or assumptions.certificate is Certificate.OPEN:
        rate = fastest_rate(on) + on.problem.discount
        outflow = jnp.where(rate > 0, rate, 1)  # it is divided by, also where nothing moves
    priced = assumptions.costs_certify and still is not None
    return Task(
        on, method, obstacles, jnp.ones(on.grid.shape, bool), still.least if priced and still else None, outflow,
        jnp.asarray(tol, on.dtype), assumptions.certificate, still.crossing if priced and still else None,
        floor=_floor(on, obstacles, still),
    )  # fmt: skip


def _floor(on: Discretisation, obstacles: bellman.Obstacles, still: resting.Standstill | None) -> Scalar | None:
    """A bound that no value can be less than: the least payment at the end of a run, where no action earns on the way.

    None where it was not asked at which cost the system can rest. The least number that there is where something can
    be earned: it may be traced whether that is so.
    """
    if still is None or is_constrained(on.problem):
        return None
    costs = jnp.where(jnp.isfinite(still.least), still.least, 0)
    small = resting.ROUNDINGS * jnp.finfo(on.dtype).eps * jnp.max(jnp.abs(costs))
    ends = certificates.lowest_end(obstacles, jnp.ones(on.grid.shape, bool), on.grid)
    # finite, since a value is compared with a multiple of it
    return jnp.where(jnp.all(costs >= -small), ends, jnp.finfo(on.dtype).min / 8).astype(on.dtype)


def _obstacles(on: Discretisation, assumptions: "Assumptions") -> tuple[bellman.Obstacles, resting.Standstill | None]:
    """The obstacles, rest points among them, and where the system can rest, if that matters to the problem."""
    obstacles, problem = bellman.obstacles(on), on.problem
    if on.scheme.subcell and problem.exit_cost is not None:
        links = cut_cells.links(on)
        met = [jnp.min(jnp.where(*meets, 0)) for link in links for meets in (link.meets_up, link.meets_down) if meets]
        # a lower bound on V has to lie below every exit cost, also where the boundary runs between the nodes
        obstacles = dataclasses.replace(obstacles, least_exit=jnp.minimum(jnp.min(jnp.stack(met)), 0))
    if not (assumptions.may_rest or assumptions.costs_certify):
        return obstacles, None
    still = resting.standstill(on)
    if not assumptions.may_rest:
        return obstacles, still
    # under a discount the equation has one solution and nothing need be held; which of both holds may be traced
    return dataclasses.replace(obstacles, fixed=obstacles.fixed | (still.rests & (problem.discount == 0))), still


BOUNDING = (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE, Certificate.BY_DISCOUNT)


@dataclasses.dataclass(frozen=True)
class Assumptions:
    """Facts on a problem that are known before its numbers are looked at.

    Attributes:
      certificate: which bound on the error applies.
      exact: true if the minimum over the actions is exact; there are no bounds otherwise.
      may_rest: true if rest points at zero cost close the problem (no discount, no constraint).
      costs_certify: true if without discount the running cost gives a bound, where it is positive.
    """

    certificate: Certificate
    exact: bool
    may_rest: bool
    costs_certify: bool = False

    @property
    def sentence(self) -> str:
        """The argument by which the error is certified, or the reason that it is not."""
        if self.certificate in BOUNDING and not self.exact:
            return "no bounds: the optimum over the actions is searched, and may be missed"
        return self.certificate.value


def assumptions_of(on: Discretisation) -> Assumptions:
    """The assumptions from the structure of the problem; a discount that is traced leaves the certificate open."""
    if on.grid.sides("open"):
        # what is continued from inside makes no chain, so that none of the bounds holds
        return dataclasses.replace(assumptions_of(on.on_grid(on.grid.walled)), certificate=Certificate.OPEN)
    problem = on.problem
    players, discounted = players_of(on), is_discounted(problem)
    if discounted:
        return Assumptions(Certificate.ADDITIVE, players.exact, may_rest=False)
    fits = problem.running_max is None and problem.cost is not None and not players.disturbance_costs
    fits &= not on.grid.sides("neumann")  # a slope is a cost at the end, which may be negative
    kind = Certificate.MULTIPLICATIVE if fits else Certificate.NONE
    may_rest = not is_constrained(problem) and problem.cost is not None
    return Assumptions(Certificate.BY_DISCOUNT if discounted is None else kind, players.exact, may_rest, fits)


_prepare_jit = jax.jit(prepare, static_argnames="assumptions")


def prepared(on: Discretisation, *, method: Method, tol: Number, assumptions: Assumptions) -> Task:
    """The task of ``prepare`` at host level, by a program that takes spacings and coordinates as they are."""
    made = _prepare_jit(on.settled, method=method, tol=tol, assumptions=assumptions)
    return altered(made, on=altered(made.on, grid=jax.tree.map(lambda leaf: np.asarray(leaf, on.dtype), on.grid)))


def prepare_on_host(
    on: Discretisation, *, method: Method, tol: float, clock: Clock | None = None
) -> tuple[Task, Assumptions, Reach | None]:
    """The task of ``prepare`` with the checks that need values: that there is a finite solution, and where.

    It checks the clock between its phases and may raise ``Stopped``.

    Returns:
      The task, the assumptions, and the nodes that reach the target (None where there is nothing to reach).

    Raises:
      ValueError: there is no finite solution.
    """
    clock, problem, grid = clock or Clock(), on.problem, on.grid
    clock.enter(f"the preparation of {' x '.join(map(str, grid.shape))} nodes")
    assumptions = assumptions_of(on)
    if may_miss(on):
        assumptions = dataclasses.replace(assumptions, exact=False)
    if is_bare(method):
        return *_bare(on, method, tol, assumptions), None
    task = prepared(on, method=method, tol=tol, assumptions=assumptions)
    priced = assumptions.certificate is Certificate.MULTIPLICATIVE
    # where L = 0 the bound by the running cost fails, and a run may go round for ever at no cost as well as rest
    if (priced and not _costs_positive(task)) or problem.cost is None:
        task = _with_refuge(task)
        assumptions = dataclasses.replace(
            assumptions, may_rest=not is_constrained(problem) and not problem.discount > 0
        )
    if priced and problem.is_game and not _costs_positive(task) and not method.relaxes:
        # policies that go on for ever at no cost have any value: the one sought is the limit of those of long horizons
        task = prepared(on, method=ValueIteration(), tol=tol, assumptions=assumptions)
    if priced and not _costs_positive(task):
        assumptions = dataclasses.replace(assumptions, certificate=Certificate.NONE)
        task = dataclasses.replace(task, certificate=Certificate.NONE, least_cost=None)
    held = np.asarray(task.obstacles.fixed)
    undiscounted = problem.discount == 0
    checks.ill_posed(problem, bool(assumptions.may_rest and held.any()), grid)
    # a game is asked when it fails: all pairs of actions are dear; and a constraint gives every node a finite value
    if problem.is_game or is_constrained(problem) or not held.any():
        return task, assumptions, None
    reach = attainability.reached(task.on, held, surely=undiscounted, least=_least_rate(task), clock=clock)
    if undiscounted and not reach.surely.all():
        task = _finite_part(task, reach.surely)
    return task, assumptions, reach


def is_bare(method: Method) -> bool:
    """True if the method keeps nothing but V."""
    return method.relaxes and not method.policy


def _bare(on: Discretisation, method: Method, tol: float, assumptions: Assumptions) -> tuple[Task, Assumptions]:
    """The task and the assumptions of a solve that keeps nothing but V: without an array of the nodes."""
    additive = assumptions.certificate is Certificate.ADDITIVE
    if not (additive or is_constrained(on.problem)) or on.grid.sides("open"):
        raise ValueError(
            "ValueIteration(policy=False) keeps V alone, which tells no bound without a discount and ends by itself "
            "for tubes; give discount > 0 and no open ends, or leave policy=False out"
        )
    certificate = Certificate.ADDITIVE if additive else Certificate.NONE
    on, nothing = cast(on, on.dtype), bellman.Obstacles(jnp.zeros((), bool), jnp.zeros((), on.dtype))
    task = Task(on, method, nothing, jnp.ones((), bool), None, None, jnp.asarray(tol, on.dtype), certificate, bare=True)
    return task, dataclasses.replace(assumptions, certificate=certificate, may_rest=False)


def forced_only(task: Task, clock: Clock) -> tuple[Task, Mask | None]:
    """The task of a game that did not converge, without the nodes from which the target cannot be forced.

    Returns:
      The task and the nodes that are left; ``None`` where that is no question.
    """
    held = np.asarray(task.obstacles.fixed)
    if not task.problem.is_game or task.constrained or np.asarray(task.problem.discount) > 0 or not held.any():
        return task, None
    # who keeps away from the target, and pays for it, may leave a finite cost
    if task.certificate is not Certificate.MULTIPLICATIVE:
        return task, None
    reached = attainability.forced(task.on, held, least=_least_rate(task), clock=clock)
    if reached.all():
        return task, reached
    warn_unreached(Reach(reached, reached), undiscounted=True)
    return _finite_part(task, reached), reached


def _with_refuge(task: Task) -> Task:
    """The task with the nodes held at zero among which a run may go on for ever and pay nothing, as where it rests."""
    if task.problem.is_game or task.constrained or np.asarray(task.problem.discount) > 0:
        return task
    # on the target the run is over; everywhere else it could go on at the least cost of all actions
    free = ~np.broadcast_to(np.asarray(task.obstacles.ended), task.grid.shape)
    least = np.zeros(task.grid.shape) if task.least_cost is None else np.asarray(task.least_cost)
    small = resting.ROUNDINGS * np.finfo(task.tol.dtype).eps * np.max(np.abs(least))
    # where something can be earned it is no matter of course that going round for nothing is optimal
    if np.any(least[free] < -small):
        return task
    found = attainability.refuge(task.on, jnp.asarray((least <= small) & free), jnp.asarray(small, task.tol.dtype))
    return dataclasses.replace(task, obstacles=dataclasses.replace(task.obstacles, fixed=task.obstacles.fixed | found))


def _costs_positive(task: Task) -> bool:
    """True if the running cost is positive wherever the value is not given."""
    return bool(np.all(np.asarray(task.least_cost)[~np.asarray(task.obstacles.fixed)] > 0))


def _least_rate(task: Task) -> Number:
    """The rate up to which jumps are rounding beside those of the fastest motion on the grid; zero if unknown."""
    if task.crossing is None:
        return np.zeros((), task.tol.dtype)
    # nodes of all axes over the time of a crossing: the rate of jumps of the fastest motion
    return resting.ROUNDINGS * jnp.finfo(task.tol.dtype).eps * sum(task.grid.shape) / known(task.crossing)


def _finite_part(task: Task, reached: Mask) -> Task:
    """The task on the nodes with a finite value; the others are held above, so that no optimal action goes there."""
    obstacles = dataclasses.replace(task.obstacles, fixed=task.obstacles.fixed | ~jnp.asarray(reached))
    return dataclasses.replace(task, obstacles=obstacles, counted=task.counted & jnp.asarray(reached), has_lost=True)


def is_carried_past(reach: Reach) -> bool:
    """True if from some nodes the chain reaches the target with some probability, but under no policy surely."""
    return bool(np.any(reach.maybe & ~reach.surely))


def warn_unreached(reach: Reach, *, undiscounted: bool) -> None:
    """Warn of nodes from which the target is not reached, or not surely; and say what their value is."""
    never, passed = (100 * float(np.mean(each)) for each in (~reach.maybe, reach.maybe & ~reach.surely))
    what = "their value is inf" if undiscounted else "their value is the discounted cost of never arriving"
    if not passed:
        warn(f"{never:.3g} % of the nodes cannot reach the target: {what}; see Solution.reached")
        return
    none = f"{never:.3g} % of the nodes cannot reach the target under any control, and " if never else ""
    warn(
        f"{none}from {passed:.3g} % of the nodes the Markov chain may be carried past the target under every control, "
        f"so its expected cost is infinite: {what}; see Solution.reached. Without noise a path may still arrive from "
        "there: use scheme=hjb.SemiLagrangian(), or a discount > 0"
    )
