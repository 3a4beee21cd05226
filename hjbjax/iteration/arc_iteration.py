"""Value and policy iteration on arcs: V ← min(ψ, min over arcs of Q), and relaxations of the arcs that are best.

With Q = pay + keep · I[V] of every arc (see ``arcs``), r = min Q − V is the residual, in cost units, κ = ``keep`` and

    residual = min(r, ψ − V);    V − max (V − Q)⁺/(1 − κ) ≤ V_h ≤ V + max r/(1 − κ),

on the left over all arcs of all nodes, on the right of the best arc where r > 0: V + ε is a supersolution if one arc of
every node has Q + κ ε ≤ V + ε, and V − ε a subsolution if all arcs have Q − κ ε ≥ V − ε. Without a discount, with the
running cost c > 0 of an arc in place of 1 − κ, likewise V/(1 + η) ≤ V_h ≤ V/(1 − ρ), as in ``certificates``.

A step follows each node's best arc again and again, and then looks at all arcs: modified policy iteration. Value
iteration follows it once. Since an arc leads several cells on, V is told from the target to the ends of the box in as
many relaxations as arcs follow one another.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.arcs import Arcs, widened
from hjbjax.discretisation.rates import Rates
from hjbjax.iteration import certificates
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation
from hjbjax.iteration.certificates import Certificate, ErrorBound, Iterate
from hjbjax.iteration.fixed_point import HISTORY
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import AtNodes, Field, Mask, Nodes, Number, Scalar
from hjbjax.solution.status import Status


@pytree_dataclass(static=("certificate", "relaxations"))
class ArcTask:
    """The constants of a solve on arcs.

    Args:
      grid: the nodes.
      arcs: all that are tried.
      obstacles: fixed nodes and the stopping cost.
      counted: bool (*grid), the nodes with a finite value; from them no arc leads to others.
      tol: certified error to reach, cost units.
      certificate: additive or multiplicative.
      relaxations: how often the best arcs are followed between two looks at all of them.
    """

    grid: Grid
    arcs: Arcs
    obstacles: Obstacles
    counted: jax.Array
    tol: Scalar
    certificate: Certificate
    relaxations: int

    def impose(self, value: Field) -> Field:
        """``value`` with the constraints put in, and zero where it does not count."""
        return jnp.where(self.counted, self.obstacles.impose(value), 0)


@pytree_dataclass()
class ArcState:
    """State of a solve on arcs: a value, its best arcs, its certificate, and the loop's book-keeping."""

    value: Field
    number: AtNodes  # of the best arc from every node
    bound: ErrorBound
    step: Scalar
    best: jax.Array  # the least error and the least residual so far, (2,)
    since_best: Scalar
    code: Scalar
    history: jax.Array  # residuals of this chunk, (HISTORY,), −1 where there was no step


class Look(NamedTuple):
    """All arcs at one value: the least Q, its number, and how far Q lies under V next to what the arc costs."""

    worth: Field
    number: AtNodes
    decline: Field


def begin(task: ArcTask, guess: Nodes) -> ArcState:
    """The state before the first look at a guess, which is step −1 of ``run``; NumPy, so that nothing is compiled."""
    dtype, infinite = guess.dtype, np.asarray(np.inf, guess.dtype)
    numbers: Any = (-infinite, infinite, np.zeros((), dtype), infinite, infinite)
    number: Any = np.zeros(task.grid.shape, np.int32)
    counter = np.zeros((), np.int32)
    first, code = np.full((), -1, np.int32), np.asarray(int(Status.RUNNING), np.int32)
    value = jax.device_put(guess, may_alias=False)  # states are donated
    books: Any = (first, np.full(2, infinite), counter, code, np.full(HISTORY, -1, dtype))
    return ArcState(value, number, ErrorBound(*numbers), *books)


def start(task: ArcTask) -> Field:
    """A value from above, from which relaxations descend, with the constraints put in.

    From below every node would first take the shortest arc, which pays least at once, and V climb by a cell a
    relaxation. Under a discount there is a constant V with min Q ≤ V: the largest over the nodes of min pay/(1 − keep).
    Without one, and so without such a constant, as many arcs as the axes have nodes, each at the dearest node.
    """
    arcs, free = task.arcs, task.counted & ~task.obstacles.fixed
    least = jnp.full(task.grid.shape, jnp.inf, arcs.pay.dtype)

    def also(k: Scalar, least: Field) -> Field:
        one = arcs.one(k)
        return jnp.minimum(least, one.pay / (1 - one.keep) if one.running is None else one.running)

    least = jax.lax.fori_loop(0, arcs.count, also, least)
    dearest = jnp.max(jnp.where(free & jnp.isfinite(least), least, -jnp.inf))
    if arcs.running is not None:
        ends = jnp.max(jnp.where(jnp.isfinite(arcs.pay), arcs.pay, -jnp.inf))
        dearest = sum(task.grid.shape) * dearest + jnp.maximum(ends, 0)
    value = jnp.where(jnp.isfinite(dearest), dearest, 0)  # where all is given there is nothing to start from
    return task.impose(jnp.full(task.grid.shape, value))


def run(task: ArcTask, state: ArcState, until: Number) -> ArcState:
    """Steps until the state is no longer running or ``until`` steps are done; at most ``HISTORY`` at a time."""
    start = state.step

    def goes_on(at: ArcState) -> jax.Array:
        return (at.code == Status.RUNNING) & (at.step < until)

    return jax.lax.while_loop(goes_on, lambda at: _advance(task, at, start), state)


def look(task: ArcTask, value: Field) -> Look:
    """The best arc from every node; the first of equals."""
    wide, shape = widened(value, task.grid), task.grid.shape

    def also(k: Scalar, best: Look) -> Look:
        arcs = task.arcs.one(k)
        worth = arcs.worth(wide, task.grid)
        better, unit = worth < best.worth, _unit(arcs)
        decline = jnp.maximum(best.decline, jnp.where(unit > 0, (value - worth) / jnp.where(unit > 0, unit, 1), 0))
        return Look(jnp.where(better, worth, best.worth), jnp.where(better, k, best.number), decline)

    none = Look(jnp.full(shape, jnp.inf, value.dtype), jnp.zeros(shape, jnp.int32), jnp.zeros(shape, value.dtype))
    return jax.lax.fori_loop(0, task.arcs.count, also, none)


def _unit(arcs: Arcs) -> jax.Array:
    """What r is divided by in the certificate: 1 − e^{−βτ}, or without a discount the running cost of an arc.

    Of an arc that ends on the target all of Q is paid, with the exit cost, if that is not negative: next to a target
    the running cost alone may be as small as the rounding of V.
    """
    if arcs.running is None:
        return 1 - arcs.keep
    ends = (arcs.keep == 0) & jnp.isfinite(arcs.pay)  # infinite: an arc that leads to a lost node
    return jnp.where(ends, jnp.maximum(arcs.running, arcs.pay), arcs.running)


def _advance(task: ArcTask, state: ArcState, start: Scalar) -> ArcState:
    """One step: the best arcs relaxed, then a look at all of them; a step to numbers that are not finite is undone."""
    value = _relaxed(task, state)
    found = look(task, value)
    bound = _bound(task, value, found)
    since = certificates.steps_since_best(state, bound)
    code = _judge(task, value, bound, since)
    return certificates.booked(state, start, bound, code, since, value=value, number=found.number)


def _relaxed(task: ArcTask, state: ArcState) -> Field:
    """V with every node's best arc followed some times; of a guess, which was not looked at yet, V itself."""
    arcs = task.arcs.chosen(state.number)

    def follow(_: Scalar, value: Field) -> Field:
        return task.impose(arcs.worth(widened(value, task.grid), task.grid))

    times = jnp.where(state.step < 0, 0, task.relaxations)
    return jax.lax.fori_loop(0, times, follow, task.impose(state.value))


def _bound(task: ArcTask, value: Field, found: Look) -> ErrorBound:
    """The certificate of a value."""
    obstacles, free = task.obstacles, task.counted & ~task.obstacles.fixed
    left = jnp.where(free, found.worth - value, 0)
    best = task.arcs.chosen(found.number)
    # as the defect of a chain whose discount, or whose running cost, is one
    defect = jnp.where(left > 0, left / _unit(best), -found.decline)
    residual = left if obstacles.upper is None else jnp.where(free, jnp.minimum(left, obstacles.upper - value), 0)
    iterate = Iterate(
        task.grid, value, Greedy(jnp.where(free, defect, 0), (), ()), PolicyEquation(residual, Rates((), ())),
        obstacles, task.counted,
    )  # fmt: skip
    one = jnp.ones((), value.dtype)
    bound = certificates.error_bound(
        task.certificate, iterate, discount=one, least_cost=jnp.broadcast_to(one, value.shape)
    )
    if task.certificate is not Certificate.ADDITIVE:
        return bound
    # that the best arcs all lead upwards says nothing of how far the others do
    return dataclasses.replace(bound, below=jnp.minimum(bound.below, 0))


def _judge(task: ArcTask, value: Field, bound: ErrorBound, since: Scalar) -> Scalar:
    """The status after a step; each line overrules those before it."""
    size = jnp.max(jnp.where(task.counted, jnp.abs(value), 0))
    rounding = certificates.ROUNDING * jnp.finfo(value.dtype).eps * size
    # a policy goes on by an arc a step, and a wave of better ones may cross the box four times
    patience = jnp.where(bound.residual <= rounding, certificates.PATIENCE, 100 + 4 * sum(task.grid.shape))
    code = jnp.where(since >= patience, Status.STALLED, Status.RUNNING)
    code = jnp.where(bound.error <= task.tol, Status.CONVERGED, code)
    return jnp.where(jnp.isfinite(bound.residual), code, Status.NONFINITE).astype(jnp.int32)


def arriving(arcs: Arcs, grid: Grid, held: Mask, inside: AtNodes | None = None) -> AtNodes:
    """The nodes that some choice of arcs may bring to the target, without leaving ``inside``, bool (*grid).

    Of the corners between which an arc ends one is nearer, and all are inside.
    """
    zero = jnp.zeros(grid.shape, arcs.pay.dtype)
    outside = widened(zero if inside is None else zero + ~inside, grid)

    def grow(pair: tuple[AtNodes, AtNodes]) -> tuple[AtNodes, AtNodes]:
        near, _ = pair
        nearer = widened(zero + near, grid)

        def also(k: Scalar, found: AtNodes) -> AtNodes:
            each = arcs.one(k)
            leads = (each.read(outside, grid) == 0) & (each.read(nearer, grid) > 0)
            return found | leads | (each.keep == 0)

        return jax.lax.fori_loop(0, arcs.count, also, near), near

    # the second of the pair is the set before, empty at first: it grows until nothing is new
    start = jnp.asarray(held), jnp.zeros(grid.shape, bool)
    return _until_still(grow, grow(start))


def surely_arriving(arcs: Arcs, grid: Grid, held: Mask) -> AtNodes:
    """The nodes from which some choice of arcs is sure to come to the target in the end, bool (*grid).

    The largest set X from all of whose nodes one may arrive without leaving X.
    """
    everywhere = jnp.ones(grid.shape, bool)

    def shrink(pair: tuple[AtNodes, AtNodes]) -> tuple[AtNodes, AtNodes]:
        return arriving(arcs, grid, held, pair[0]), pair[0]

    return _until_still(shrink, shrink((everywhere, everywhere)))


def _until_still(step: Callable, pair: tuple[AtNodes, AtNodes]) -> AtNodes:
    """The first of a pair of sets, the newer one and the one before it, once a step changes nothing more."""
    return jax.lax.while_loop(lambda pair: jnp.any(pair[0] != pair[1]), step, pair)[0]


def without(arcs: Arcs, grid: Grid, counted: Mask) -> Arcs:
    """The arcs with those that lead to nodes that do not count made infinitely dear."""
    lost = widened(jnp.where(counted, 0.0, 1.0).astype(arcs.pay.dtype), grid)

    def each(one: Arcs) -> tuple[jax.Array, jax.Array]:
        leads = (one.read(lost, grid) > 0) & (one.keep > 0)
        return jnp.where(leads, jnp.inf, one.pay), jnp.where(leads, 0, one.keep)

    pay, keep = jax.lax.map(each, arcs)
    return dataclasses.replace(arcs, pay=pay, keep=keep)
