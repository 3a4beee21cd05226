"""Value and policy iteration on arcs: V ← min(ψ, min over arcs of Q), and relaxations along the best arcs.

For every arc Q = pay + keep · I[V] (see ``arcs``). With the residual r = min Q − V in cost units, and κ = ``keep``,

    residual = min(r, ψ − V);    V − max (V − Q)⁺/(1 − κ) ≤ V_h ≤ V + max r/(1 − κ),

where the lower bound uses all arcs of all nodes, and the upper bound uses the best arc of each node with r > 0. The
reason is that V + ε is a supersolution if one arc of every node has Q + κ ε ≤ V + ε, and V − ε is a subsolution if all
arcs have Q − κ ε ≥ V − ε. Without a discount the bounds are V/(1 + η) ≤ V_h ≤ V/(1 − ρ) as in ``certificates``, with
the running cost c > 0 of an arc instead of 1 − κ.

A step follows each node's best arc several times and then evaluates all arcs, which is modified policy iteration. Value
iteration follows it once. An arc crosses several cells, so information travels from the target to the ends of the box
in few relaxations, one per arc of the path.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.rates import Rates
from hjbjax.iteration import certificates, progress
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation
from hjbjax.iteration.certificates import Certificate, ErrorBound, Iterate
from hjbjax.iteration.progress import Progress, keep_finite
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import AtNodes, Field, Mask, Nodes, Number, Scalar
from hjbjax.semi_lagrangian.arcs import Arcs, widened
from hjbjax.solution.status import Status


@pytree_dataclass(static=("certificate", "relaxations"))
class ArcTask:
    """The constants of a solve on arcs.

    Args:
      grid: the grid.
      arcs: all arcs to try.
      obstacles: fixed nodes and the stopping cost.
      counted: bool (*grid), the nodes with a finite value; no arc leads from them to other nodes.
      tol: the certified error to reach, cost units.
      certificate: additive or multiplicative.
      relaxations: the number of times that the best arcs are followed between two evaluations of all arcs.
    """

    grid: Grid
    arcs: Arcs
    obstacles: Obstacles
    counted: jax.Array
    tol: Scalar
    certificate: Certificate
    relaxations: int

    def impose(self, value: Field) -> Field:
        """``value`` with the constraints imposed, and zero at nodes that do not count."""
        return jnp.where(self.counted, self.obstacles.impose(value), 0)


@pytree_dataclass()
class ArcState:
    """State of a solve on arcs: the last evaluated value, or the guess, and the record of the loop.

    Args:
      value: V, (*grid).
      number: the number of the best arc from every node, (*grid).
      bound: the bound on the error of V.
      progress: the number of evaluations, the status and the residuals.
    """

    value: Field
    number: AtNodes
    bound: ErrorBound
    progress: Progress


class _Look(NamedTuple):
    """An evaluation of all arcs: the least Q, the number of its arc, and the largest (V − Q)⁺/``_unit`` of an arc."""

    worth: Field
    number: AtNodes
    decline: Field


def start(task: ArcTask, guess: Nodes) -> ArcState:
    """The state of a guess, which the first pass of ``run`` evaluates; nothing is compiled."""
    number: Any = np.zeros(task.grid.shape, np.int32)
    value = jax.device_put(guess, may_alias=False)  # states are donated
    return ArcState(value, number, progress.no_bound(guess.dtype), progress.no_progress(guess.dtype))


def value_from_above(task: ArcTask) -> Field:
    """A value above the solution, from which relaxations descend, with the constraints imposed.

    If V started below, every node would first choose the shortest arc, because it costs least, and the correct values
    would spread by one cell per relaxation. With a discount the start is a constant V with min Q ≤ V: the maximum over
    the nodes of min pay/(1 − keep). Without a discount there is no such constant. The start is then the cost of one arc
    at the most expensive node, times the number of nodes summed over the axes.
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
    value = jnp.where(jnp.isfinite(dearest), dearest, 0)  # if all nodes are fixed there is nothing to start from
    return task.impose(jnp.full(task.grid.shape, value))


def run(task: ArcTask, state: ArcState, until: Number) -> ArcState:
    """Step until the state is not running or ``until`` values are evaluated; at most ``HISTORY`` at a time."""
    chunk = state.progress.evaluations
    return jax.lax.while_loop(lambda at: at.progress.is_running(until), lambda at: _advance(task, at, chunk), state)


def look(task: ArcTask, value: Field) -> _Look:
    """The best arc from every node; the first one on ties."""
    wide, shape = widened(value, task.grid), task.grid.shape

    def also(k: Scalar, best: _Look) -> _Look:
        arcs = task.arcs.one(k)
        worth = arcs.worth(wide, task.grid)
        better, unit = worth < best.worth, _unit(arcs)
        decline = jnp.maximum(best.decline, jnp.where(unit > 0, (value - worth) / jnp.where(unit > 0, unit, 1), 0))
        return _Look(jnp.where(better, worth, best.worth), jnp.where(better, k, best.number), decline)

    none = _Look(jnp.full(shape, jnp.inf, value.dtype), jnp.zeros(shape, jnp.int32), jnp.zeros(shape, value.dtype))
    return jax.lax.fori_loop(0, task.arcs.count, also, none)


def _unit(arcs: Arcs) -> jax.Array:
    """The divisor of r in the certificate: 1 − e^{−βτ}, or without a discount the running cost of an arc.

    For an arc that ends on the target it is Q, which includes the exit cost (if that is not negative), because next to
    a target the running cost may be as small as the rounding error of V.
    """
    if arcs.running is None:
        return 1 - arcs.keep
    ends = (arcs.keep == 0) & jnp.isfinite(arcs.pay)  # ``pay`` is infinite for an arc to an unreachable node
    return jnp.where(ends, jnp.maximum(arcs.running, arcs.pay), arcs.running)


def _advance(task: ArcTask, state: ArcState, chunk: Scalar) -> ArcState:
    """One step: relax along the best arcs, then evaluate all arcs; undo the step if its numbers are not finite."""
    value = _relaxed(task, state)
    found = look(task, value)
    bound = _bound(task, value, found)
    measured = state.progress.measure(bound, chunk)
    code = _status_after(task, value, bound, measured.since_best)
    after = ArcState(value, found.number, bound, measured.judge(bound, code))
    return keep_finite(code, after, dataclasses.replace(state, progress=after.progress))


def _relaxed(task: ArcTask, state: ArcState) -> Field:
    """V after following every node's best arc several times; for a guess, which has no best arcs, ``impose`` only."""
    arcs = task.arcs.chosen(state.number)

    def follow(_: Scalar, value: Field) -> Field:
        return task.impose(arcs.worth(widened(value, task.grid), task.grid))

    times = jnp.where(state.progress.evaluations == 0, 0, task.relaxations)
    return jax.lax.fori_loop(0, times, follow, task.impose(state.value))


def _bound(task: ArcTask, value: Field, found: _Look) -> ErrorBound:
    """The certificate of a value."""
    obstacles, free = task.obstacles, task.counted & ~task.obstacles.fixed
    left = jnp.where(free, found.worth - value, 0)
    best = task.arcs.chosen(found.number)
    # scaled like the defect of a chain whose discount or running cost is one
    defect = jnp.where(left > 0, left / _unit(best), -found.decline)
    residual = left if obstacles.upper is None else jnp.where(free, jnp.minimum(left, obstacles.upper - value), 0)
    iterate = Iterate(
        task.grid.layout, value, Greedy(jnp.where(free, defect, 0), (), ()), PolicyEquation(residual, Rates((), ())),
        obstacles, task.counted,
    )  # fmt: skip
    one = jnp.ones((), value.dtype)
    bound = certificates.error_bound(
        task.certificate, iterate, discount=one, least_cost=jnp.broadcast_to(one, value.shape)
    )
    if task.certificate is not Certificate.ADDITIVE:
        return bound
    # the lower bound depends on all arcs, not only on the best ones, so it must not exceed V
    return dataclasses.replace(bound, below=jnp.minimum(bound.below, 0))


def _status_after(task: ArcTask, value: Field, bound: ErrorBound, since: Scalar) -> Scalar:
    """The status after an evaluation; later lines override earlier ones."""
    size = jnp.max(jnp.where(task.counted, jnp.abs(value), 0))
    rounding = progress.ROUNDING * jnp.finfo(value.dtype).eps * size
    # a policy advances by one arc per step, and a wave of improvements may cross the box four times
    patience = jnp.where(bound.residual <= rounding, progress.PATIENCE, 100 + 4 * sum(task.grid.shape))
    code = jnp.where(since >= patience, Status.STALLED, Status.RUNNING)
    code = jnp.where(bound.error <= task.tol, Status.CONVERGED, code)
    return jnp.where(jnp.isfinite(bound.residual), code, Status.NONFINITE).astype(jnp.int32)


def arriving(arcs: Arcs, grid: Grid, held: Mask, inside: AtNodes | None = None) -> AtNodes:
    """The nodes from which some choice of arcs may reach the target without leaving ``inside``, bool (*grid).

    The last arc ends on the target. Every other arc ends in a cell whose corners are all inside and one of which is
    such a node.
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

    # iterate until the set stops growing; the second of the pair is the previous set, initially empty
    start = jnp.asarray(held), jnp.zeros(grid.shape, bool)
    return _until_still(grow, grow(start))


def surely_arriving(arcs: Arcs, grid: Grid, held: Mask) -> AtNodes:
    """The nodes from which some choice of arcs surely reaches the target, bool (*grid).

    This is the largest set X from whose nodes the target may be reached without leaving X.
    """
    everywhere = jnp.ones(grid.shape, bool)

    def shrink(pair: tuple[AtNodes, AtNodes]) -> tuple[AtNodes, AtNodes]:
        return arriving(arcs, grid, held, pair[0]), pair[0]

    return _until_still(shrink, shrink((everywhere, everywhere)))


def _until_still(step: Callable, pair: tuple[AtNodes, AtNodes]) -> AtNodes:
    """Iterate a pair of sets, the new one and the previous one, until nothing changes; return the new one."""
    return jax.lax.while_loop(lambda pair: jnp.any(pair[0] != pair[1]), step, pair)[0]


def without(arcs: Arcs, grid: Grid, counted: Mask) -> Arcs:
    """The arcs, with infinite cost for arcs to nodes that do not count."""
    lost = widened(jnp.where(counted, 0.0, 1.0).astype(arcs.pay.dtype), grid)

    def each(one: Arcs) -> tuple[jax.Array, jax.Array]:
        leads = (one.read(lost, grid) > 0) & (one.keep > 0)
        return jnp.where(leads, jnp.inf, one.pay), jnp.where(leads, 0, one.keep)

    pay, keep = jax.lax.map(each, arcs)
    return dataclasses.replace(arcs, pay=pay, keep=keep)
