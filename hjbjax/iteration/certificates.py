"""Bounds on the distance from a value function to the exact solution of the discrete equation.

Discounted: with ρ = max(min(r/β, ψ − V), g − V) at every node (zero where held)

    V + min ρ ≤ V_h ≤ V + max ρ.

Undiscounted with running cost L > 0, exit cost ≥ 0 and V ≥ 0: with L the least running cost at a node,

    V/(1 + η) ≤ V_h ≤ V/(1 − ρ),    ρ = max(r/L)⁺ < 1,   η = max((−r)⁺/L),

because scaling a super- or subsolution scales its generator part and not its cost. Minimum time is L = 1. A
constant may be added to an undiscounted V: where an exit cost is negative all of it is lifted to zero first. A stopping
cost ψ changes little: V ≤ ψ is imposed and where V = ψ nothing bounds V_h from above but ψ itself, so that such nodes
count for η alone.
A factor 1/(1 − ρ) beyond ε^{-1/2}, ε the unit of rounding, is no bound: its 1 − ρ may be rounding of r and L alone,
and it says nothing anyway. Both follow from the comparison principle of a monotone scheme; they bound the algebraic
error and not the error of the grid, hold where the minimum over the actions is exact, and want float64.

An iteration books its progress by them, the least error and residual so far and the steps since either fell, and is
judged by it.
"""

import dataclasses
import enum
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import bellman
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.types import Array, Field, Mask, Number, Scalar
from hjbjax.solution.status import Status

S = TypeVar("S", bound=Any)

GROWTH = 1e6  # a residual that has grown by this factor over its smallest has diverged
PATIENCE = 10  # steps without progress of a residual that is rounding
ROUNDING = 64  # residuals below this many units in the last place of max|V| are rounding
FEW = 4  # such units: steps by the fastest rate of all, as V alone takes them, are small at a slow node long before
# Corrections of a scheme of high order are halved, three times at most, where neither of the last two was smaller than
# all before them and V turned back: that ends limit cycles of the limiter. Halving from the start takes a third more
# steps, and halving on a slow way to the limit took the Dubins car on 41³ nodes 135 steps in place of 33.
LEAST_SHARE, CALM = 0.125, 5
SLOWEST = 0.95  # rate of contraction beyond which steps say nothing of the distance, and the step counts twentyfold
LOST = 4  # roundings of numbers of the size lift · max(factor, 1) in factor · V + shift


class Certificate(enum.Enum):
    """The bound that a problem admits; the value says it in words."""

    ADDITIVE = "from the discount, V + min r/β ≤ V_h ≤ V + max r/β"
    MULTIPLICATIVE = "from the running cost, V/(1 + η) ≤ V_h ≤ V/(1 − ρ)"
    BY_DISCOUNT = "from the discount where that is positive, else from the running cost"
    RESIDUAL = "the high-order equation, whose residual this is, has no comparison principle"
    OPEN = "open ends continue the value from inside, and have no comparison principle"
    NONE = "without discount and positive running cost the residual bounds nothing"


@pytree_dataclass()
class Moves:
    """The sizes of the corrections of a scheme of high order, cost units, and what was concluded from them.

    Args:
      last: the last two, the latest first, as if each was taken whole; infinite where there was none.
      least: the least one before the last two.
      share: the part of a correction that is taken.
      since: steps since ``share`` changed.
    """

    last: jax.Array
    least: Scalar
    share: Scalar
    since: Scalar


TO_THE_END = (Certificate.NONE, Certificate.BY_DISCOUNT)  # of tubes: V falls or climbs until nothing moves


@pytree_dataclass()
class ErrorBound:
    """Bounds on V_h − V, and how far they are from V.

    Args:
      below, above: the bounds on V_h: V + shift where additive, (V + lift) · factor − lift where multiplicative.
      lift: the constant that makes every exit cost non-negative.
      error: the largest |bound − V| over the nodes that count, cost units; without a certificate the size of the
        last correction or of the residual.
      residual: the largest |residual| in cost units.
    """

    below: Scalar
    above: Scalar
    lift: Scalar
    error: Scalar
    residual: Scalar


@dataclasses.dataclass(frozen=True)
class Iterate:
    """A value function with its policy and the residual of its equation.

    Attributes:
      grid: the nodes.
      value: V, (*grid).
      policy: the greedy policy at V with its rate r, zero where held.
      equation: the correction equation there, whose source is the residual.
      obstacles: held nodes and constraints.
      counted: bool (*grid), the nodes whose error counts (those that reach the target).
    """

    grid: Grid
    value: Field
    policy: Greedy
    equation: PolicyEquation
    obstacles: Obstacles
    counted: Mask | bool


def error_bound(
    kind: Certificate, iterate: Iterate, *, discount: Number, least_cost: Field | None = None, moved: Number = 0
) -> ErrorBound:
    """The certificate of a value.

    Args:
      kind: which bound applies.
      iterate: the value, its policy and their residual.
      discount: β.
      least_cost: L at every node, for the multiplicative bound.
      moved: the size of the last correction, the fallback measure.
    """
    if kind is Certificate.BY_DISCOUNT:
        other = Certificate.NONE if least_cost is None else Certificate.MULTIPLICATIVE
        # β is traced, so that both bounds are made and one is chosen; r/1 in place of r/0 where it is not
        rate = jnp.where(discount > 0, discount, 1)
        with_it, without = (
            error_bound(each, iterate, discount=rate, least_cost=least_cost, moved=moved)
            for each in (Certificate.ADDITIVE, other)
        )
        if other is Certificate.NONE:  # bounds that say nothing
            endless = jnp.full_like(without.residual, jnp.inf)
            without = dataclasses.replace(without, above=endless, lift=endless)
        return jax.tree.map(lambda mine, theirs: jnp.where(discount > 0, mine, theirs), with_it, without)
    residual = iterate.grid.largest(jnp.where(iterate.counted, jnp.abs(iterate.equation.source), 0))
    if kind is Certificate.ADDITIVE:
        below, above = _additive(iterate, discount)
        error = jnp.maximum(jnp.abs(below), jnp.abs(above))
        return ErrorBound(below, above, jnp.zeros_like(residual), error, residual)
    if kind is Certificate.MULTIPLICATIVE:
        assert least_cost is not None
        return _multiplicative(iterate, least_cost, residual)
    return measured(residual, moved)


def measured(residual: Scalar, moved: Number) -> ErrorBound:
    """The error by what is at hand without a bound: the residual, and the size of the last correction."""
    zero = jnp.zeros_like(residual)
    return ErrorBound(zero, zero, zero, jnp.maximum(residual, moved), residual)


def of_relaxation(kind: Certificate, on: Discretisation, value: Field) -> tuple[Field, ErrorBound]:
    """The step of one relaxation at a value, zero where that is given, and the bound on the value.

    The next value is no worse: T is monotone and T V_h = V_h, so that from V − e ≤ V_h ≤ V + e follows
    T V − e ≤ V_h ≤ T V + e. One array is kept beside V, r where e = max |ρ| is made of it and else s; that is what the
    barriers are for: without them H is searched once more for every number, or the rates take an array as well.
    """
    (defect, outflow), given = bellman.relaxation(on, value), bellman.obstacles(on)
    zero = jnp.zeros((), value.dtype)
    if kind is Certificate.ADDITIVE:
        defect = jax.lax.optimization_barrier(defect)
        error = on.grid.largest(jnp.abs(given.clipped(defect / on.problem.discount, value)))
        return given.clipped(defect / outflow, value), ErrorBound(-error, error, zero, error, error)
    step = given.clipped(jax.lax.optimization_barrier(defect / outflow), value)
    residual = on.grid.largest(jnp.abs(step))
    return step, ErrorBound(zero, zero, zero, residual, residual)


def _additive(iterate: Iterate, discount: Number) -> tuple[Scalar, Scalar]:
    """min ρ and max ρ of ρ = max(min(r/β, ψ − V), g − V)."""
    grid, value, policy, obstacles = iterate.grid, iterate.value, iterate.policy, iterate.obstacles
    if obstacles.upper is None and obstacles.lower is None:  # two reductions first, and no array r/β
        return grid.least(policy.defect) / discount, grid.largest(policy.defect) / discount
    shift = policy.defect / discount
    if obstacles.upper is not None:
        shift = jnp.minimum(shift, obstacles.upper - value)
    if obstacles.lower is not None:
        shift = jnp.maximum(shift, obstacles.lower - value)
    # r is zero where held, the obstacles are not: there V is given and exact
    shift = jnp.where(obstacles.fixed, 0, shift)
    return grid.least(shift), grid.largest(shift)


def _multiplicative(iterate: Iterate, least_cost: Field, residual: Scalar) -> ErrorBound:
    """V/(1 + η) ≤ V_h ≤ V/(1 − ρ), of a V lifted until no exit cost is negative."""
    value, policy, obstacles, counted = iterate.value, iterate.policy, iterate.obstacles, iterate.counted
    grid, costs = iterate.grid, least_cost > 0
    free = counted & ~obstacles.fixed
    # where nothing is paid any rate that is left is infinitely much next to the cost; r = 0 makes a NaN of sign · ∞,
    # and ``priced`` says no there anyway
    rate = jnp.where(costs, policy.defect / jnp.where(costs, least_cost, 1), jnp.sign(policy.defect) * jnp.inf)
    relative = jnp.where(free, rate, 0)
    # where V = ψ nothing bounds V_h from above but ψ, which is imposed
    rising = relative if obstacles.upper is None else jnp.where(value < obstacles.upper, relative, 0)
    rho, eta = jnp.maximum(grid.largest(rising), 0), jnp.maximum(grid.largest(-relative), 0)
    # as numbers: of truth values XLA would make two passes
    priced = grid.largest(jnp.asarray(free & ~costs, value.dtype)) == 0
    sound = priced & (1 - rho > jnp.sqrt(jnp.finfo(rho.dtype).eps))  # a V flat somewhere has r = L up to rounding
    below, above = 1 / (1 + eta), jnp.where(sound, 1 / jnp.where(sound, 1 - rho, 1), jnp.inf)
    lift = jnp.maximum(-lowest_end(obstacles, counted, grid), 0)
    apart = jnp.where(jnp.isinf(above), 0, jnp.maximum(above - 1, 1 - below))  # no 0 · inf
    least, most = (grid.least(jnp.where(counted, value, jnp.inf)), grid.largest(jnp.where(counted, value, -jnp.inf)))
    # the scaling argument wants V ≥ 0; without that there is no bound
    bounded = jnp.isfinite(above) & (least + lift >= 0)
    error = jnp.where(bounded, jnp.maximum(most + lift, 0) * apart, jnp.inf) + 0 * residual  # a NaN stays one
    return ErrorBound(below, above, jnp.where(priced, lift, jnp.inf), error, residual)


def widened(
    kind: Certificate, bound: ErrorBound, missed: tuple[Field, Field], *, discount: Number, least_cost: Field | None
) -> ErrorBound:
    """The bounds with what the control and the disturbance may miss of their optima, (*grid) each, cost per unit time.

    With H as it was found, min max H is at least H less what the control missed, and at most H and what the disturbance
    missed, so that r is off by no more.
    """
    if kind is Certificate.BY_DISCOUNT:
        other = Certificate.NONE if least_cost is None else Certificate.MULTIPLICATIVE
        rate = jnp.where(discount > 0, discount, 1)
        with_it, without = (
            widened(each, bound, missed, discount=rate, least_cost=least_cost) for each in (Certificate.ADDITIVE, other)
        )
        return jax.tree.map(lambda mine, theirs: jnp.where(discount > 0, mine, theirs), with_it, without)
    mine, theirs = missed
    if kind is Certificate.ADDITIVE:
        below, above = bound.below - jnp.max(mine) / discount, bound.above + jnp.max(theirs) / discount
    elif kind is Certificate.MULTIPLICATIVE:
        assert least_cost is not None
        # bounds with a free node that pays nothing are endless already
        shares = [
            jnp.max(jnp.where(least_cost > 0, each / jnp.where(least_cost > 0, least_cost, 1), 0)) for each in missed
        ]
        below, inverse = 1 / (1 / bound.below + shares[0]), 1 / bound.above - shares[1]
        above = jnp.where(inverse > 0, 1 / jnp.where(inverse > 0, inverse, 1), jnp.inf)
    else:
        return bound
    return dataclasses.replace(bound, below=below, above=above)


def lowest_end(obstacles: Obstacles, counted: Mask | bool, grid: Grid) -> Scalar:
    """The least payment at the end of a run, at most zero: exit costs, between nodes as well, and ψ."""
    lowest = grid.least(jnp.where(counted & obstacles.fixed, obstacles.fixed_value, 0))
    lowest = jnp.minimum(lowest, obstacles.least_exit)
    # ψ is paid where one stops, which may be anywhere
    return (
        lowest if obstacles.upper is None else jnp.minimum(lowest, grid.least(jnp.where(counted, obstacles.upper, 0)))
    )


def enclosure(kind: Certificate, bound: ErrorBound, discount: Number | None = None) -> Any:
    """Both bounds as affine functions of V: rows lower and upper, columns factor and shift, shape (2, 2).

    (V + lift) · factor − lift cancels where V is near −lift, as on a target with a negative exit cost; the shift is
    rounded outwards by what that costs. ``None`` without a certificate.
    """
    if kind is Certificate.BY_DISCOUNT:
        assert discount is not None
        with_it, without = (enclosure(each, bound) for each in (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE))
        return jnp.where(discount > 0, with_it, without)
    if kind not in (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE):
        return None
    # NumPy where the numbers are known: JAX would round doubles to its default type, and compile
    xp: Any = jnp if is_traced(bound) else np
    below, above, lift = (xp.asarray(number) for number in (bound.below, bound.above, bound.lift))

    def line(side: Array, outwards: int) -> Array:
        one = xp.ones_like(side)
        if kind is Certificate.ADDITIVE:
            return xp.stack([one, side])
        endless = xp.isinf(side) | xp.isinf(lift)
        factor, lifted = xp.where(endless, one, side), xp.where(endless, 0 * one, lift)  # no 0 · inf
        lost = LOST * xp.finfo(side.dtype).eps * lifted * xp.maximum(factor, 1) * (factor != 1)
        return xp.stack([factor, xp.where(endless, outwards * xp.inf, lifted * (factor - 1) + outwards * lost)])

    return xp.stack([line(below, -1), line(above, 1)])


def steps_since_best(state: Any, bound: ErrorBound) -> Scalar:
    """The steps without progress, this one among them: neither error nor residual is less than ever before."""
    return jnp.where(jnp.any(_measures(bound) < state.best), 0, state.since_best + 1)


def moves_after(state: Any, moved: Scalar, turned: jax.Array) -> Moves:
    """The sizes of the corrections after a step of size ``moved``; a look at a guess is not a step.

    Corrections that no longer shrink are halved where they turn back, as in a cycle, and whole again where they go on
    in one direction, as on a slow way to the limit.
    """
    old = state.moves
    whole = moved / old.share
    last, least = jnp.stack([whole, old.last[0]]), jnp.minimum(old.least, old.last[1])
    stuck = (jnp.minimum(whole, old.last[0]) >= least) & (old.since >= CALM)
    fitting = jnp.where(turned, jnp.maximum(old.share / 2, LEAST_SHARE), jnp.minimum(2 * old.share, 1))
    new = Moves(last, least, jnp.where(stuck, fitting, old.share), jnp.where(stuck, 0, old.since + 1))
    return jax.tree.map(lambda after, before: jnp.where(state.step < 0, before, after), new, old)


def turns_back(grid: Grid, change: Field, defect: Field) -> jax.Array:
    """True if a correction went too far: where V changed most, its equation now asks for the opposite change.

    Args:
      grid: the nodes.
      change: of V in the last step, zero at nodes that do not count, cost units, (*grid).
      defect: the residual at the new V, positive where V is to rise, cost per unit time, (*grid).
    """
    most = jnp.abs(change) > grid.largest(jnp.abs(change)) / 2
    onwards = jnp.where(most, jnp.sign(change) * defect, 0)
    return grid.largest(-onwards) > grid.largest(onwards)


def distance(task: Any, moves: Moves, moved: Scalar, value: Field) -> Scalar:
    """The distance from V to the limit of its iteration, cost units: step/(1 − ρ), with the measured contraction ρ.

    Args:
      task: a ``fixed_point.Task``.
      moves: the corrections before the last one.
      moved: the size of the last one, as it was taken.
      value: V after it.
    """
    step, before = moved / moves.share, moves.last
    known = jnp.isfinite(before) & (before > 0)
    # over one step and over two: two eigenvalues of opposite signs make every other step short
    ratios = jnp.where(known, step / jnp.where(known, before, 1), 0) ** jnp.array([1.0, 0.5], step.dtype)
    rate = jnp.where(jnp.isfinite(before[0]), jnp.max(ratios), SLOWEST)
    rate = jnp.clip(rate, 0, SLOWEST)
    # steps of the size of rounding do not contract, and lead nowhere
    rounding = FEW * jnp.finfo(value.dtype).eps * _size(task.grid, value, task.counting)
    return moved + jnp.maximum(moved - rounding, 0) * rate / (1 - rate)


def judged(task: Any, value: Field, bound: ErrorBound, best: jax.Array, since: Scalar) -> Scalar:
    """The status of a ``fixed_point.Task`` after a step; each line overrules those before it."""
    longest = task.method.patience(task.grid.whole)
    climbs = task.constrained or task.method.relaxes
    to_the_end = climbs and task.certificate in (*TO_THE_END, Certificate.OPEN)
    if to_the_end:  # a front moves V by a spacing times its slope a step past every node
        longest = jnp.maximum(longest, 100 + 4 * task.grid.whole.size)

    def converged(code: Any, tol: Scalar) -> Scalar:
        code = jnp.where(bound.error <= tol, Status.CONVERGED, code)
        return jnp.where(jnp.isfinite(bound.residual), code, Status.NONFINITE).astype(jnp.int32)

    def by_size() -> Scalar:
        rounding, tol = ROUNDING * jnp.finfo(value.dtype).eps * _size(task.grid, value, task.counting), task.tol
        if to_the_end:  # whatever the tolerance
            tol = jnp.where(task.problem.discount > 0, tol, FEW / ROUNDING * rounding if task.bare else rounding)
        # a residual that is rounding has nowhere to go: ten steps tell, in place of the thousands of a slow climb
        patience = jnp.where(bound.residual <= rounding, PATIENCE, longest)
        halted: Any = Status.STALLED
        if to_the_end and task.bare:  # of many terms more than a few units may remain
            halted = jnp.where((bound.residual <= rounding) & ~(task.problem.discount > 0), Status.CONVERGED, halted)
        code = jnp.where(since >= patience, halted, Status.RUNNING)
        grew = bound.residual > GROWTH * jnp.maximum(best[1], rounding)
        bounded = jnp.isfinite(best[0]) & (bound.error <= GROWTH * best[0])
        grew &= ~bounded  # a better policy may leave more than one that stops at once
        return converged(jnp.where(grew, Status.DIVERGED, code), tol)

    if to_the_end:
        return by_size()
    # else the size of V changes no answer; a choice of programs, whose answer the selects that follow do not find anew
    matters = (since >= jnp.minimum(PATIENCE, longest)) | (bound.residual > GROWTH * best[1])
    return jax.lax.cond(matters, by_size, lambda: converged(Status.RUNNING, task.tol))


def at_rest(task: Any, state: Any, moved: Scalar, code: Scalar) -> Scalar:
    """The status after a step; a tube that moved nowhere is at its end, whatever a slow node's residual is.

    That residual is over the node's own rate, and the step over the fastest one: less than the last place of V.
    """
    if not (task.constrained and task.method.relaxes and task.certificate in TO_THE_END):
        return code
    ends = (moved == 0) & (state.step >= 0) & (code != Status.NONFINITE) & ~(task.problem.discount > 0)
    return jnp.where(ends, int(Status.CONVERGED), code).astype(code.dtype)


def _size(grid: Grid, value: Field, counted: Mask | bool) -> Scalar:
    """max |V| over the nodes that count."""
    if not jnp.ndim(counted):  # all of them: no array of |V|
        return jnp.maximum(grid.largest(value), -grid.least(value))
    return grid.largest(jnp.where(counted, jnp.abs(value), 0))


def booked(state: S, start: Scalar, bound: ErrorBound, code: Scalar, since: Scalar, **found: Any) -> S:
    """The state after a step, with what it found; where that is not finite the state before, with the step booked.

    Args:
      state: before the step, with the books of ``State``.
      start: the step with which this chunk began.
      bound: on the error after it.
      code: the status after it.
      since: of ``steps_since_best``.
      found: what else the state holds.
    """
    # counted and recorded even where it is taken back: ``broken`` makes that step again
    history = state.history.at[state.step - start].set(bound.residual)
    old = dataclasses.replace(state, step=state.step + 1, since_best=since, code=code, history=history)
    best = jnp.fmin(state.best, _measures(bound))  # fmin, which a NaN does not win
    new = dataclasses.replace(old, bound=bound, best=best, **found)
    return jax.tree.map(lambda after, before: jnp.where(code == Status.NONFINITE, before, after), new, old)


def _measures(bound: ErrorBound) -> jax.Array:
    """Error and residual, (2,): less of either is progress."""
    return jnp.stack([bound.error, bound.residual])
