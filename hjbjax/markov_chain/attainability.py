"""Which nodes can be brought to the target for certain, read off the graph of the chain.

Without discount the value is finite exactly where some policy reaches the held nodes with probability one (a
proper policy). The largest such set R is a fixed point: take away the nodes from which no path of jumps leads
to the target by actions that keep every jump inside R, until nothing changes. The jumps of sampled actions are found
on the device. The paths are followed on the host by sweeps: one running "or" along an axis follows all jumps of one
direction to their end, so that two or three rounds of sweeps usually find every path, however long it is.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import cut_cells, edges, stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import Rates, jump_rates
from hjbjax.hamiltonian.players import players_of
from hjbjax.markov_chain import tried_actions
from hjbjax.problem import sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Array, Mask, Number, Scalar
from hjbjax.solution.clock import Clock

FEW = 9  # of each player in a game, where all pairs are
WINDING = 30  # rounds of sweeps after which a search takes over: each follows paths round one more corner
SEARCHABLE = 5 * 10**7  # jumps that a search can list: some 60 bytes each
LOOK = 10**7  # nodes times actions between two looks at the clock: about a second


def _open_jumps(
    on: Discretisation, points: Array, count: int, clock: Clock, inside: jax.Array | None, *, least: Number, kinks: bool
) -> Rates:
    """For every jump the nodes, bool (*grid), with an action that makes it and whose jumps all stay ``inside``.

    The first ``count`` actions of ``points`` are tried. Without ``inside`` it is the box. Rates up to ``least`` are
    rounding; with ``kinks`` actions between the samples, at which a component of the drift vanishes, are tried as well.
    """
    known = _no_jumps(on, points)
    some = max(1, LOOK // on.grid.size)
    for first in range(0, count, some):
        clock.enter(f"the jumps of the chain, {first} of {count} actions")
        lot = first, min(first + some, count)
        # the actions beside the samples do not depend on these: once, with the first lot
        known = _more_open_jumps(on, inside, known, points, lot, least=least, kinks=kinks, others=kinks and first == 0)
    return known


@jax.jit  # never run: its trace is kept
def _jumps_of(on: Discretisation, action: Array) -> Rates:
    """The jumps under one action at every node, shape (m,)."""
    return jump_rates(on, list(action))


def _no_jumps(on: Discretisation, points: Array) -> Rates:
    """The jumps that the chain may make, none of them open."""
    # the offsets are those of every action, since they follow from the noise and not from what is done
    offsets = _jumps_of.eval_shape(on, jax.ShapeDtypeStruct(np.shape(points)[1:], on.dtype)).offsets
    return Rates(offsets, tuple(np.zeros(on.grid.shape, bool) for _ in offsets))


@functools.partial(jax.jit, static_argnames=("kinks", "others"))
def _more_open_jumps(
    on: Discretisation,
    inside: jax.Array | None,
    known: Rates,
    points: Array,
    lot: tuple[int, int],
    *,
    least: Number,
    kinks: bool,
    others: bool,
) -> Rates:
    """The jumps that are known to be open and those of a lot of the actions ``points``, from one row to another."""
    # a jump is open once any action makes it, so that the order of the actions, and one tried twice, change nothing
    grid, points = on.grid, jnp.asarray(points, on.dtype)
    mine = players_of(on).control

    def tried(actions, opened):
        for each in actions:
            rates = jump_rates(on, each)
            # an action that a constrained end rules out makes no jump at all, not one to the node itself
            stays = ~edges.inadmissible(on, each)
            if inside is not None:
                stays &= _stays(rates, grid, inside, least)
            opened = tuple(p | ((c > least) & stays) for p, c in zip(opened, rates.values, strict=True))
        return opened

    def also(k, opened):
        action = list(points[k])
        return tried(tried_actions.with_kinks(on, mine, action) if kinks else [action], opened)

    first = tried_actions.beside_samples(on, mine) if others else []
    opened = tried(first, tuple(map(jnp.asarray, known.values)))
    return Rates(known.offsets, jax.lax.fori_loop(*lot, also, opened))


def _stays(rates: Rates, grid: Grid, inside: jax.Array, least: Number) -> jax.Array:
    """The nodes from which all jumps at rates above ``least`` lead ``inside``, bool (*grid)."""
    stays = jnp.ones(grid.shape, bool)
    for offset, c in zip(rates.offsets, rates.values, strict=True):
        # beyond the ends of the box there is no jump: rates that lead out are zero
        stays &= (c <= least) | stencil.neighbour(inside, grid, offset)
    return stays


class Reach(NamedTuple):
    """The nodes from which a set of held nodes is reached under some policy, each bool (*grid).

    Attributes:
      surely: with probability one.
      maybe: with some probability. Without noise the difference is due to the chain: its jumps spread like noise of
        the size of a cell, which may carry it past a target that the path meets.
    """

    surely: Mask
    maybe: Mask


def reached(
    on: Discretisation, held: np.ndarray, *, surely: bool, least: Number = 0.0, clock: Clock | None = None
) -> Reach:
    """The nodes from which the held nodes can be reached; host level, for problems with one player.

    Args:
      on: the chain.
      held: bool (*grid), the nodes to reach.
      surely: find the nodes that reach them with probability one; otherwise both sets are the larger one.
      least: a rate per unit time; up to it jumps are rounding.
      clock: the limits; raises ``Stopped`` where they are exceeded.
    """
    on = on.on_grid(on.grid.walled)  # what goes on beyond an open end is not known to come back
    clock, found, maybe = clock or Clock(), np.zeros(on.grid.shape, bool), np.zeros(on.grid.shape, bool)
    points, few = tried_actions.control_samples(on.problem)
    # few actions are enough for most problems, and what samples do not reach may be reached by the one action that
    # keeps to a way. Each pass is sound: whatever it finds is reached by actions of the set, so that the union is, too
    for count, kinks in dict.fromkeys([(few, False), (len(points), False), (len(points), True)]):
        jumps = functools.partial(_open_jumps, on, points=points, count=count, clock=clock, least=least, kinks=kinks)
        more = _reached_by(jumps, held, surely, on.grid, clock)
        found, maybe = found | more.surely, maybe | more.maybe
        if found.all():
            break
    return Reach(found, maybe)


def _reached_by(open_jumps: Callable[..., Rates], held: np.ndarray, surely: bool, grid: Grid, clock: Clock) -> Reach:
    """The nodes from which the held ones are reached by ``open_jumps(inside=...)``."""

    def staying(inside: jax.Array | None) -> np.ndarray:
        return _backward_reach(held, open_jumps(inside=inside), grid, clock)

    maybe = found = staying(None)
    inside = np.ones(held.shape, bool)
    while surely and not np.array_equal(found, inside):
        inside = found
        # nodes are taken away and never put back, as the largest fixed point wants: at most one round a node
        found = inside & staying(jnp.asarray(inside))
    return Reach(found, maybe)


def forced(on: Discretisation, held: np.ndarray, *, least: Number, clock: Clock) -> np.ndarray:
    """The nodes of a game from which the control reaches the held ones for certain, whatever the disturbance does.

    The largest set R in which some control keeps all jumps inside under every disturbance, and leads on to a nearer
    node; in a lower game, some control for every disturbance. Of a continuum few actions are tried. Arguments are those
    of ``reached``. Costs a step a cell of the longest way, each of all pairs of actions: for games that fail.
    """
    found, on = np.ones(on.grid.shape, bool), on.on_grid(on.grid.walled)
    while True:
        # the outer loop takes nodes away, the inner one starts from the target each time and climbs: a game of reaching
        # while staying inside is the largest fixed point of a least one
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
    """``found`` with the nodes from which the control leads there and stays ``inside``; and if that adds any."""
    problem, grid, dtype = on.problem, on.grid, on.dtype
    us, ds = (
        jnp.asarray(np.zeros((1, 0)) if admissible is None else sets.samples(admissible, FEW), dtype)
        for admissible in (problem.controls, problem.disturbances)
    )
    upper = problem.isaacs == "upper"
    # who moves first is in the outer loop: in the upper game for some u all d, in the lower for all d some u
    outer, inner = (us, ds) if upper else (ds, us)

    def answered(first):
        def also(ok, second):
            u, d = (first, second) if upper else (second, first)
            rates = jump_rates(on, list(u), list(d))
            jumps = zip(rates.offsets, rates.values, strict=True)
            leads = functools.reduce(
                jnp.logical_or, ((c > least) & stencil.neighbour(found, grid, offset) for offset, c in jumps)
            )
            allowed = ~edges.inadmissible(on, list(u), list(d))
            # for every disturbance one jump is enough that leads on, for all of them none may leave
            good = leads & allowed & _stays(rates, grid, inside, least)
            return (ok & good if upper else ok | good), None

        return jax.lax.scan(also, jnp.full(grid.shape, upper), inner)[0]

    def over(ok, first):
        return (ok | answered(first) if upper else ok & answered(first)), None

    new = found | (inside & jax.lax.scan(over, jnp.full(grid.shape, not upper), outer)[0])
    return new, jnp.any(new != found)


def refuge(on: Discretisation, inside: jax.Array | None = None, dearest: Scalar | None = None) -> jax.Array:
    """The nodes from which some actions of both players keep the state off the target for ever, bool (*grid).

    The largest set in which every node has an action whose jumps all stay in it: nodes without one are taken away until
    nothing changes. Empty means that under every policy the target is reached with probability one. Host level.

    Args:
      on: the chain.
      inside: the nodes among which it is sought, bool (*grid); ``None`` is all off the target.
      dearest: actions of a higher running cost do not count; ``None`` for all.
    """
    start = cut_cells.level(on) > 0 if inside is None else inside
    u, d = (
        np.zeros((1, 0)) if admissible is None else np.asarray(sets.samples(admissible, tried_actions.SAMPLES))
        for admissible in (on.problem.controls, on.problem.disturbances)
    )
    pairs = np.concatenate([np.repeat(u, len(d), axis=0), np.tile(d, (len(u), 1))], axis=1)
    count = len(pairs)
    if dearest is not None:  # mostly few actions are cheap anywhere, and every one is tried again and again
        cheap = np.asarray(_cheap_somewhere(on, start, dearest, pairs))
        pairs, count = np.concatenate([pairs[cheap], pairs[~cheap]]), int(np.sum(cheap))
    return _refuge(on, start, dearest, pairs, count)


@jax.jit
def _cheap_somewhere(on: Discretisation, inside: jax.Array, dearest: Scalar, pairs: Array) -> jax.Array:
    """For every pair of actions, or those at the kinks next to it, if it costs at most ``dearest`` at some node."""
    mine = players_of(on).control
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
    """``refuge`` in the set ``start`` by the first ``count`` rows of ``pairs``: the inputs of u, then those of d."""
    mine, pairs = players_of(on).control, jnp.asarray(pairs, on.dtype)
    m = len(mine.driven)

    def shrink(carry):
        inside, _ = carry

        # dear actions are left out where the refuge has to be free of cost
        def kept(action, answer):
            allowed = ~edges.inadmissible(on, action, answer)
            if dearest is not None:
                allowed &= on.running_cost(action, answer) <= dearest
            return allowed & _stays(jump_rates(on, action, answer), on.grid, inside, 0.0)

        def also(k, found):
            for action in tried_actions.with_kinks(on, mine, list(pairs[k, :m])):
                found |= kept(action, list(pairs[k, m:]))
            return found

        found = jnp.zeros(on.grid.shape, bool)
        for action in tried_actions.beside_samples(on, mine):
            # with any disturbance: these are actions of one player, and a game has none
            found |= kept(action, list(pairs[0, m:]))
        found = inside & jax.lax.fori_loop(0, count, also, found)
        return found, jnp.any(found != inside)

    return jax.lax.while_loop(lambda carry: carry[1], shrink, (start, jnp.ones((), bool)))[0]


def _backward_reach(held: np.ndarray, jumps: Rates, grid: Grid, clock: Clock) -> np.ndarray:
    """The nodes with a path of jumps to a held node, bool (*grid)."""
    lines, found, listed = _along_axes(jumps), held, grid.size * len(jumps.offsets) <= SEARCHABLE
    before, rounds = -1, 0
    while before < np.count_nonzero(found) < grid.size:
        clock.enter("the search for nodes that reach the target")
        if rounds == WINDING and listed:
            return _searched(found, jumps, grid)
        before, rounds = int(np.count_nonzero(found)), rounds + 1
        for axis, opened in lines.items():
            found = _swept(found, axis, opened)
    return found


def _along_axes(jumps: Rates) -> dict[int, list[tuple[tuple[int, ...], np.ndarray]]]:
    """For every axis the jumps that lead along it, and along no axis before, as arrays that begin with that axis."""
    lines: dict[int, list] = {}
    for offset, jump in zip(jumps.offsets, jumps.values, strict=True):
        axis = next(axis for axis, step in enumerate(offset) if step)
        turned = offset[axis : axis + 1] + offset[:axis] + offset[axis + 1 :]
        lines.setdefault(axis, []).append((turned, np.ascontiguousarray(np.moveaxis(np.asarray(jump), axis, 0))))
    return lines


def _swept(found: np.ndarray, axis: int, opened: list[tuple[tuple[int, ...], np.ndarray]]) -> np.ndarray:
    """``found`` with the nodes that lead there by any number of equal jumps, one kind of jump after the other."""
    rows = np.array(np.moveaxis(found, axis, 0), order="C")
    sides = tuple(range(rows.ndim - 1))
    for (step, *aside), jump in opened:
        for k in range(len(rows))[:: -1 if step > 0 else 1]:
            ahead = rows[(k + step) % len(rows)]  # no jump leads out of the box: on a periodic axis it leads round
            if any(aside):
                ahead = np.roll(ahead, [-each for each in aside], sides)
            rows[k] |= jump[k] & ahead
    return np.moveaxis(rows, 0, axis)


def _searched(held: np.ndarray, jumps: Rates, grid: Grid) -> np.ndarray:
    """The nodes with a path of jumps to a held node by a breadth-first search, however winding the paths are."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    starts = [np.flatnonzero(held)]
    # the search wants one start: an extra node, numbered last, from which all held ones are one jump away
    ends = [np.full_like(starts[0], grid.size)]  # one more node leads to all held ones
    for offset, jump in zip(jumps.offsets, jumps.values, strict=True):
        # jumps out of held nodes are left out: the run is over there
        leaves = ~held & np.asarray(jump)
        starts.append(np.flatnonzero(leaves))
        ends.append(stencil.numbers(grid, offset)[leaves])
    backward = np.concatenate(ends), np.concatenate(starts)
    # the jumps turned round: from the target to all from which it can be reached
    graph = csr_array((np.ones(len(backward[0])), backward), shape=(grid.size + 1, grid.size + 1))
    found = np.zeros(grid.size + 1, bool)
    found[breadth_first_order(graph, grid.size, directed=True, return_predecessors=False)] = True
    return found[:-1].reshape(grid.shape)
