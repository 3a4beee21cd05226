"""The nodes from which the target can be reached with certainty, from the graph of the chain.

Without discount the value is finite at a node if and only if some policy (a proper policy) reaches the fixed nodes from
there with probability one. The set R of these nodes is a largest fixed point: start with all nodes, and remove the
nodes without a path of jumps to the target by actions that keep every jump inside R, until nothing changes. The jumps
of sampled actions are computed on the device. The paths are followed on the host by sweeps: one cumulative "or" along
an axis follows all jumps in one direction to their end, so two or three rounds of sweeps usually find every path,
however long.
"""

import functools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import edges, stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.landing import Landing
from hjbjax.discretisation.rates import Rates, jump_rates
from hjbjax.hamiltonian.search import Action
from hjbjax.problem import sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.layouts import Layout
from hjbjax.problem.types import Array, Mask, Number, Scalar
from hjbjax.solution.clock import Clock
from hjbjax.well_posedness import tried_actions

T = TypeVar("T")
FEW = 9  # actions per player in a game, where all pairs are tried
WINDING = 30  # rounds of sweeps before a graph search takes over; each round follows paths around one more corner
SEARCHABLE = 5 * 10**7  # largest number of jumps for a graph search, at some 60 bytes each
LOOK = 10**7  # nodes times actions between two checks of the clock: about a second


def _open_jumps(
    on: Discretisation,
    points: Array,
    count: int,
    clock: Clock,
    inside: np.ndarray | None,
    *,
    least: Number,
    kinks: bool,
    layout: Layout,
) -> Rates:
    """For every jump, the nodes with an action that makes this jump and whose jumps all stay ``inside``, bool (*grid).

    Tries the first ``count`` actions of ``points``. ``inside=None`` means the box. Rates up to ``least`` count as
    rounding. With ``kinks``, the actions between samples at which a component of the drift vanishes are tried too.
    """
    none, some = _no_jumps(on, points), max(1, LOOK // on.grid.size)
    known, places = layout.spread(none, _over_nodes(none)), layout.spread(inside, _over_nodes(inside))
    on = layout.copied(on)
    for first in range(0, count, some):
        clock.enter(f"the jumps of the chain, {first} of {count} actions")
        lot = first, min(first + some, count)
        # these additional actions do not depend on the samples, so they are tried once, with the first batch
        others = kinks and first == 0
        known = _more_open_jumps(on, places, known, points, lot, least, kinks=kinks, others=others, layout=layout)
    return layout.gathered(known, _over_nodes(known))


def _over_nodes(tree: T) -> T:
    """A tree of the same structure that marks every leaf as one value per node."""
    return jax.tree.map(lambda _: True, tree)


@jax.jit  # only traced, and executed for jumps of the state
def _jumps_of(on: Discretisation, action: Array) -> Rates:
    """The jumps under one action at every node, shape (m,)."""
    return jump_rates(on, list(action))


def _no_jumps(on: Discretisation, points: Array) -> Rates:
    """The possible jumps of the chain, none of them open; landings must not depend on the action."""
    # the offsets depend on the noise, not on the action
    offsets = _jumps_of.eval_shape(on, jax.ShapeDtypeStruct(np.shape(points)[1:], on.dtype)).offsets
    none: Any = np.zeros(on.grid.shape, bool)
    far: tuple[Landing, ...] = ()
    if on.problem.landings is not None:
        found = _jumps_of(on, jnp.asarray(points[0], on.dtype)).landings
        far = tuple(Landing(np.asarray(landing.nodes), none) for landing in found)
    return Rates(offsets, (none,) * len(offsets), landings=far)


@functools.partial(jax.jit, static_argnames=("kinks", "others", "layout"))
def _more_open_jumps(
    on: Discretisation,
    inside: jax.Array | None,
    known: Rates,
    points: Array,
    lot: tuple[int, int],
    least: Number,
    *,
    kinks: bool,
    others: bool,
    layout: Layout,
) -> Rates:
    """``_opened`` for the nodes of all devices."""

    def here(on: Discretisation, *arguments: Any) -> Rates:
        return _opened(on.on_part(layout), *arguments, kinks=kinks, others=others)

    divided = _over_nodes(known)
    marks = (False, _over_nodes(inside), divided, False, False, False)
    return layout.mapped(here, marks, divided)(on, inside, known, points, lot, least)


def _opened(
    on: Discretisation,
    inside: jax.Array | None,
    known: Rates,
    points: Array,
    lot: tuple[int, int],
    least: Number,
    *,
    kinks: bool,
    others: bool,
) -> Rates:
    """The jumps known to be open, and those opened by a range (first, last) of the actions ``points``."""
    # a jump is open once any action makes it, so order and repetition of actions do not matter
    grid, points = on.grid, jnp.asarray(points, on.dtype)
    mine = on.players.control

    def tried(actions: Iterable[Action], opened: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        for each in actions:
            rates = jump_rates(on, each)
            # an action that a constrained end forbids makes no jump at all, not even to the node itself
            stays = ~edges.inadmissible(on, each)
            if inside is not None:
                stays &= _stays(rates, grid, inside, least)
            opened = tuple(p | ((c > least) & stays) for p, c in zip(opened, _all_rates(rates), strict=True))
        return opened

    def also(k: Scalar, opened: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        action = list(points[k])
        return tried(tried_actions.with_kinks(on, mine, action) if kinks else [action], opened)

    first = tried_actions.beside_samples(on, mine) if others else []
    opened = jax.lax.fori_loop(*lot, also, tried(first, tuple(map(jnp.asarray, _all_rates(known)))))
    count = len(known.offsets)
    far = zip(known.landings, opened[count:], strict=True)
    return Rates(known.offsets, opened[:count], landings=tuple(Landing(each.nodes, mask) for each, mask in far))


def _all_rates(rates: Rates) -> list[jax.Array]:
    """The rates of jumps to neighbours, then of jumps to other nodes."""
    return [*rates.values, *(landing.rate for landing in rates.landings)]


def _stays(rates: Rates, grid: Grid, inside: jax.Array, least: Number) -> jax.Array:
    """The nodes from which all jumps at rates above ``least`` lead ``inside``, bool (*grid)."""
    stays = jnp.ones(grid.shape, bool)
    for c, ahead in rates.jumps(grid):
        # no jump leaves the box: rates that lead out are zero
        stays &= (c <= least) | ahead(inside)
    return stays


class Reach(NamedTuple):
    """The nodes from which a set of fixed nodes is reached under some policy, each bool (*grid).

    Attributes:
      surely: with probability one.
      maybe: with positive probability. Without noise the difference is due to the chain, whose jumps spread like noise
        of the size of a cell, which may carry it past a target on the path.
    """

    surely: Mask
    maybe: Mask


def reached(
    on: Discretisation,
    held: np.ndarray,
    *,
    surely: bool,
    least: Number = 0.0,
    clock: Clock | None = None,
    layout: Layout | None = None,
) -> Reach:
    """The nodes from which the fixed nodes can be reached; host level, for problems with one player.

    Args:
      on: the chain.
      held: bool (*grid), the nodes to reach.
      surely: also compute the nodes that reach them with probability one; otherwise both sets in the result are the
        nodes that may reach them.
      least: a rate per unit time; jumps at rates up to it count as rounding.
      clock: the limits; raises ``Stopped`` when they are exceeded.
      layout: the devices that compute the jumps, each at its own nodes; None for one device.
    """
    on = on.on_grid(stencil.walled(on.grid))  # a path that leaves through an open end may not return
    clock, found, maybe = clock or Clock(), np.zeros(on.grid.shape, bool), np.zeros(on.grid.shape, bool)
    if on.players.control.lands:  # the jumps of an action are not a set of nodes that all actions share
        steered = forced(on, held, least=least, clock=clock)
        return Reach(steered, steered)
    points, few = tried_actions.control_samples(on.problem)
    # A few actions suffice for most problems. Nodes that samples do not reach may be reached by an action that keeps
    # exactly to a path. Every pass uses admissible actions only, so the union of the passes is also reachable.
    for count, kinks in dict.fromkeys([(few, False), (len(points), False), (len(points), True)]):
        jumps = functools.partial(
            _open_jumps, on, points=points, count=count, clock=clock, least=least, kinks=kinks,
            layout=layout or on.grid.layout,
        )  # fmt: skip
        more = _reached_by(jumps, _interventions(on), held, surely, on.grid, clock)
        found, maybe = found | more.surely, maybe | more.maybe
        if found.all():
            break
    return Reach(found, maybe)


def _interventions(on: Discretisation) -> Rates:
    """The interventions that the controller may choose, as jumps, bool (*grid) each."""
    if on.problem.switching_costs is None and not on.problem.push_steps:
        return Rates((), ())
    found = _interventions_jit(on)
    return Rates(found.offsets, tuple(np.asarray(cost) < np.inf for cost in found.costs))


_interventions_jit = jax.jit(Discretisation.interventions)


def _led_inside(changes: Rates, inside: np.ndarray | None, grid: Grid) -> list[np.ndarray]:
    """The interventions that lead ``inside``, bool (*grid) each."""
    if inside is None:
        return list(changes.values)
    return [
        each & np.asarray(stencil.neighbour(jnp.asarray(inside), grid, offset))
        for offset, each in zip(changes.offsets, changes.values, strict=True)
    ]


def _reached_by(
    open_jumps: Callable[..., Rates], changes: Rates, held: np.ndarray, surely: bool, grid: Grid, clock: Clock
) -> Reach:
    """The nodes from which the fixed nodes are reached by ``open_jumps(inside=...)`` and by interventions."""

    def staying(inside: np.ndarray | None) -> np.ndarray:
        jumps = open_jumps(inside=inside)
        leading = (*jumps.values, *_led_inside(changes, inside, grid))
        jumps = Rates((*jumps.offsets, *changes.offsets), leading, landings=jumps.landings)
        return _backward_reach(held, jumps, grid, clock)

    maybe = found = staying(None)
    inside = np.ones(held.shape, bool)
    while surely and not np.array_equal(found, inside):
        inside = found
        # a removed node never comes back, so there is at most one round per node
        found = inside & staying(inside)
    return Reach(found, maybe)


def forced(on: Discretisation, held: np.ndarray, *, least: Number, clock: Clock) -> np.ndarray:
    """The nodes of a game from which the control reaches the fixed nodes surely, whatever the disturbance does.

    This is the largest set R in which some control keeps all jumps inside R and leads to a nearer node under every
    disturbance. In a lower game the control may depend on the disturbance. A continuum is sampled by few actions.
    Arguments as for ``reached``. Takes one step per cell of the longest path, each over all pairs of actions, so use it
    for failing games.
    """
    found, on = np.ones(on.grid.shape, bool), on.on_grid(stencil.walled(on.grid))
    while True:
        # The outer loop removes nodes; the inner loop starts from the target each time and adds nodes. Reaching a set
        # while staying inside another is a greatest fixed point of a least fixed point.
        inside, nearer, more = found, jnp.asarray(held), True
        while more:
            clock.enter("the search for nodes from which the target can be forced")
            nearer, more = _controllable_predecessors(on, inside, nearer, least)
        found = np.asarray(nearer)
        if np.array_equal(found, inside):
            return found


@jax.jit
def _controllable_predecessors(
    on: Discretisation, inside: jax.Array, found: jax.Array, least: Number
) -> tuple[jax.Array, Scalar]:
    """``found`` plus the nodes from which the control leads there and stays ``inside``, and a flag if any was added."""
    grid, before = on.grid, found
    for offset, cost in zip((known := on.interventions()).offsets, known.costs, strict=True):
        found |= inside & (cost < jnp.inf) & stencil.neighbour(found, grid, offset)

    def leads(u: Action, d: Action) -> jax.Array:
        # for every disturbance one jump must lead on, and none may leave
        rates = jump_rates(on, u, d)
        nearer = functools.reduce(jnp.logical_or, [(c > least) & ahead(found) for c, ahead in rates.jumps(grid)])
        return nearer & _stays(rates, grid, inside, least)

    new = found | (inside & _enforced(on, leads))
    return new, jnp.any(new != before)


def _enforced(on: Discretisation, holds: Callable[[Action, Action], jax.Array]) -> jax.Array:
    """The nodes at which the control can make ``holds(u, d)`` true whatever the disturbance does, bool (*grid)."""
    problem, shape = on.problem, on.grid.shape
    us, ds = (
        jnp.asarray(np.zeros((1, 0)) if admissible is None else sets.samples(admissible, FEW), on.dtype)
        for admissible in (problem.controls, problem.disturbances)
    )
    upper = problem.isaacs == "upper"
    # the player who moves first is in the outer loop: upper game: some u for all d, lower game: for all d some u
    outer, inner = (us, ds) if upper else (ds, us)

    def answered(first: jax.Array) -> jax.Array:
        def also(ok: jax.Array, second: jax.Array) -> tuple[jax.Array, None]:
            u, d = (list(each) for each in ((first, second) if upper else (second, first)))
            good = holds(u, d) & ~edges.inadmissible(on, u, d)
            return (ok & good if upper else ok | good), None

        return jax.lax.scan(also, jnp.full(shape, upper), inner)[0]

    def over(ok: jax.Array, first: jax.Array) -> tuple[jax.Array, None]:
        return (ok | answered(first) if upper else ok & answered(first)), None

    return jax.lax.scan(over, jnp.full(shape, not upper), outer)[0]


@jax.jit
def held_by_control(on: Discretisation, inside: jax.Array, dearest: Scalar) -> jax.Array:
    """The nodes of a game from which the control stays ``inside`` indefinitely at a running cost ≤ ``dearest``.

    This is the largest set in which every node has a control whose jumps all stay in the set under every disturbance.
    In a lower game the control may depend on the disturbance. A continuum is sampled by few actions. Bool (*grid).
    """

    def shrink(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        before = carry[0]

        def stays(u: Action, d: Action) -> jax.Array:
            return (on.running_cost(u, d) <= dearest) & _stays(jump_rates(on, u, d), on.grid, before, 0.0)

        found = before & _enforced(on, stays)
        return found, jnp.any(found != before)

    return jax.lax.while_loop(lambda carry: carry[1], shrink, (inside, jnp.ones((), bool)))[0]


def refuge(on: Discretisation, inside: jax.Array | None = None, dearest: Scalar | None = None) -> jax.Array:
    """The nodes from which some actions of both players avoid the target indefinitely, bool (*grid).

    This is the largest set in which every node has an action whose jumps all stay in the set: nodes without one are
    removed until nothing changes. If it is empty, every policy reaches the target with probability one. Host level.

    Args:
      on: the chain.
      inside: search among these nodes, bool (*grid); ``None`` means all nodes outside the target.
      dearest: ignore actions with a higher running cost; ``None`` allows all.
    """
    start = on.level > 0 if inside is None else inside
    u, d = (
        np.zeros((1, 0)) if admissible is None else np.asarray(sets.samples(admissible, tried_actions.SAMPLES))
        for admissible in (on.problem.controls, on.problem.disturbances)
    )
    pairs = np.concatenate([np.repeat(u, len(d), axis=0), np.tile(d, (len(u), 1))], axis=1)
    count = len(pairs)
    if dearest is not None:  # usually only few actions are cheap at any node, so select them once
        cheap = np.asarray(_cheap_somewhere(on, start, dearest, pairs))
        pairs, count = np.concatenate([pairs[cheap], pairs[~cheap]]), int(np.sum(cheap))
    return _refuge(on, start, dearest, pairs, count)


@jax.jit
def _cheap_somewhere(on: Discretisation, inside: jax.Array, dearest: Scalar, pairs: Array) -> jax.Array:
    """For every pair of actions: True if it, or an action at a kink next to it, costs at most ``dearest`` somewhere."""
    mine = on.players.control
    m = len(mine.driven)

    def cheap(pair: jax.Array) -> jax.Array:
        u, d = list(pair[:m]), list(pair[m:])
        costs = [on.running_cost(action, d) for action in tried_actions.with_kinks(on, mine, u)]
        return functools.reduce(jnp.logical_or, (jnp.any(inside & (cost <= dearest)) for cost in costs))

    return jax.lax.map(cheap, jnp.asarray(pairs, on.dtype))


@jax.jit
def _refuge(
    on: Discretisation, start: jax.Array, dearest: Scalar | None, pairs: Array, count: int | Scalar
) -> jax.Array:
    """``refuge`` in the set ``start`` for the first ``count`` rows of ``pairs``, with the inputs of u, then of d."""
    mine, pairs = on.players.control, jnp.asarray(pairs, on.dtype)
    m = len(mine.driven)

    def shrink(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        inside, _ = carry

        # expensive actions are excluded if the refuge has to be free of cost
        def kept(action: Action, answer: Action) -> jax.Array:
            allowed = ~edges.inadmissible(on, action, answer)
            if dearest is not None:
                allowed &= on.running_cost(action, answer) <= dearest
            return allowed & _stays(jump_rates(on, action, answer), on.grid, inside, 0.0)

        def also(k: Scalar, found: jax.Array) -> jax.Array:
            for action in tried_actions.with_kinks(on, mine, list(pairs[k, :m])):
                found |= kept(action, list(pairs[k, m:]))
            return found

        found = jnp.zeros(on.grid.shape, bool)
        for action in tried_actions.beside_samples(on, mine):
            # for a single player only, since a game has no such additional actions
            found |= kept(action, list(pairs[0, m:]))
        found = inside & jax.lax.fori_loop(0, count, also, found)
        return found, jnp.any(found != inside)

    return jax.lax.while_loop(lambda carry: carry[1], shrink, (start, jnp.ones((), bool)))[0]


def _backward_reach(held: np.ndarray, jumps: Rates, grid: Grid, clock: Clock) -> np.ndarray:
    """The nodes with a path of jumps to a fixed node, bool (*grid)."""
    lines, found, listed = _along_axes(jumps), held, grid.size * len(jumps.offsets) <= SEARCHABLE
    before, rounds = -1, 0
    while before < np.count_nonzero(found) < grid.size:
        clock.enter("the search for nodes that reach the target")
        if rounds == WINDING and listed:
            return _searched(found, jumps, grid)
        before, rounds = int(np.count_nonzero(found)), rounds + 1
        for axis, opened in lines.items():
            found = _swept(found, axis, opened)
        for landing in jumps.landings:
            found = found | (np.asarray(landing.rate) & found.reshape(-1)[np.asarray(landing.nodes)])
    return found


def _along_axes(jumps: Rates) -> dict[int, list[tuple[tuple[int, ...], np.ndarray]]]:
    """The jumps grouped by the first axis along which they move, as arrays with that axis in front."""
    lines: dict[int, list] = {}
    for offset, jump in zip(jumps.offsets, jumps.values, strict=True):
        axis = next(axis for axis, step in enumerate(offset) if step)
        turned = offset[axis : axis + 1] + offset[:axis] + offset[axis + 1 :]
        lines.setdefault(axis, []).append((turned, np.ascontiguousarray(np.moveaxis(np.asarray(jump), axis, 0))))
    return lines


def _swept(found: np.ndarray, axis: int, opened: list[tuple[tuple[int, ...], np.ndarray]]) -> np.ndarray:
    """``found`` plus the nodes that lead there by any number of equal jumps, for one kind of jump after the other."""
    rows = np.array(np.moveaxis(found, axis, 0), order="C")
    sides = tuple(range(rows.ndim - 1))
    for (step, *aside), jump in opened:
        for k in range(len(rows))[:: -1 if step > 0 else 1]:
            ahead = rows[(k + step) % len(rows)]  # no jump leaves the box; on a periodic axis it wraps around
            if any(aside):
                ahead = np.roll(ahead, [-each for each in aside], sides)
            rows[k] |= jump[k] & ahead
    return np.moveaxis(rows, 0, axis)


def _searched(held: np.ndarray, jumps: Rates, grid: Grid) -> np.ndarray:
    """The nodes with a path of jumps to a fixed node, by breadth-first search, for long winding paths."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    starts = [np.flatnonzero(held)]
    # the search requires a single start: an extra last node, from which all fixed nodes are one jump away
    ends = [np.full_like(starts[0], grid.size)]  # the extra node leads to all fixed nodes
    for offset, jump in zip(jumps.offsets, jumps.values, strict=True):
        # jumps out of fixed nodes are omitted, because the run has ended there
        leaves = ~held & np.asarray(jump)
        starts.append(np.flatnonzero(leaves))
        ends.append(stencil.neighbour_numbers(grid, offset)[leaves])
    for landing in jumps.landings:
        leaves = ~held & np.asarray(landing.rate)
        starts.append(np.flatnonzero(leaves))
        ends.append(np.asarray(landing.nodes)[leaves])
    backward = np.concatenate(ends), np.concatenate(starts)
    # the reversed jumps lead from the target to all nodes that can reach it
    graph = csr_array((np.ones(len(backward[0])), backward), shape=(grid.size + 1, grid.size + 1))
    found = np.zeros(grid.size + 1, bool)
    found[breadth_first_order(graph, grid.size, directed=True, return_predecessors=False)] = True
    return found[:-1].reshape(grid.shape)
