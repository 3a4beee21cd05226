"""Which nodes can be brought to the target for certain, read off the graph of the chain.

Without discount the value is finite exactly where some policy reaches the held nodes with probability one (a
proper policy). The largest such set R is a fixed point: take away the nodes from which no path of jumps leads
to the target by actions that keep every jump inside R, until nothing changes. Jumps under sampled actions are
found on the device, paths by a breadth-first search on the host, or on large grids on the device as well.
"""

import functools
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
SMALL = 20_000  # nodes up to which NumPy follows paths in less time than SciPy's graphs take to import
LARGE = 200_000  # nodes beyond which paths are first followed on the device, all at once
LONG = 4  # times the nodes of all axes together: jumps of a path that are followed there
SEARCHABLE = 5 * 10**7  # jumps that a search on the host can list: some 60 bytes each
LOOK = 10**7  # nodes times actions, or times jumps of a path, between two looks at the clock: about a second


def _open_jumps(
    on: Discretisation, inside: jax.Array | None, clock: Clock, *, least: Number = 0.0, kinks: bool = False
) -> Rates:
    """For every jump the nodes, bool (*grid), with an action that makes it and whose jumps all stay ``inside``.

    Without ``inside`` it is the box. Rates up to ``least`` are rounding; with ``kinks`` actions between the samples, at
    which a component of the drift vanishes, are tried as well.
    """
    points = tried_actions.control_samples(on.problem)
    known = _no_jumps(on, points)
    count, some = len(points), max(1, LOOK // on.grid.size)
    for first in range(0, count, some):
        clock.enter(f"the jumps of the chain, {first} of {count} actions")
        last = min(first + some, count)
        # always as many actions, the last lot overlapping the one before: another number would be another program
        lot = points[max(last - some, 0) : last]
        # the actions between the samples of a ball do not depend on these: once, with the first lot
        known = _more_open_jumps(on, inside, known, lot, least=least, kinks=kinks, outmost=kinks and first == 0)
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


@functools.partial(jax.jit, static_argnames=("kinks", "outmost"))
def _more_open_jumps(
    on: Discretisation,
    inside: jax.Array | None,
    known: Rates,
    points: Array,
    *,
    least: Number = 0.0,
    kinks: bool = False,
    outmost: bool = False,
) -> Rates:
    """The jumps that are known to be open and those of the actions ``points``, shape (count, m)."""
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

    first = tried_actions.of_a_ball(on, mine) if outmost else []
    opened = tried(first, tuple(map(jnp.asarray, known.values)))
    return Rates(known.offsets, jax.lax.fori_loop(0, len(points), also, opened))


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
    for kinks in (False, True):  # what samples do not reach may be reached by the one action that keeps to a way
        # each pass is sound: whatever it finds is reached by actions of the set, so that the union is, too
        more = _reached_by_samples(on, held, surely, clock, least=least, kinks=kinks)
        found, maybe = found | more.surely, maybe | more.maybe
        if found.all():
            break
    return Reach(found, maybe)


def _reached_by_samples(
    on: Discretisation, held: np.ndarray, surely: bool, clock: Clock, *, least: Number, kinks: bool
) -> Reach:
    """The nodes from which the held ones are reached by the actions that are tried."""

    def staying(inside: jax.Array | None) -> np.ndarray:
        return _backward_reach(held, _open_jumps(on, inside, clock, least=least, kinks=kinks), on.grid, clock)

    maybe = found = staying(None)
    inside = np.ones(on.grid.shape, bool)
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


@jax.jit
def refuge(on: Discretisation, inside: jax.Array | None = None, dearest: Scalar | None = None) -> jax.Array:
    """The nodes from which some actions of both players keep the state off the target for ever, bool (*grid).

    The largest set in which every node has an action whose jumps all stay in it: nodes without one are taken away until
    nothing changes. Empty means that under every policy the target is reached with probability one.

    Args:
      on: the chain.
      inside: the nodes among which it is sought, bool (*grid); ``None`` is all off the target.
      dearest: actions of a higher running cost do not count; ``None`` for all.
    """
    problem, grid, dtype = on.problem, on.grid, on.dtype
    u, d = (
        jnp.asarray(np.zeros((1, 0)) if admissible is None else sets.samples(admissible, tried_actions.SAMPLES), dtype)
        for admissible in (problem.controls, problem.disturbances)
    )
    mine, start = players_of(on).control, cut_cells.level(on) > 0 if inside is None else inside

    def shrink(carry):
        inside, _ = carry

        # dear actions are left out where the refuge has to be free of cost
        def kept(action, answer):
            allowed = ~edges.inadmissible(on, action, answer)
            if dearest is not None:
                allowed &= on.running_cost(action, answer) <= dearest
            return allowed & _stays(jump_rates(on, action, answer), grid, inside, 0.0)

        def also(found, pair):
            for action in tried_actions.with_kinks(on, mine, list(u[pair[0]])):
                found |= kept(action, list(d[pair[1]]))
            return found, None

        pairs = jnp.stack(jnp.meshgrid(jnp.arange(len(u)), jnp.arange(len(d)), indexing="ij"), -1).reshape(-1, 2)
        found = jnp.zeros(grid.shape, bool)
        for action in tried_actions.of_a_ball(on, mine):
            # with any disturbance: kinks and a ball's outmost actions are those of one player, and a game has none
            found |= kept(action, list(d[0]))
        found = inside & jax.lax.scan(also, found, pairs)[0]
        return found, jnp.any(found != inside)

    return jax.lax.while_loop(lambda carry: carry[1], shrink, (start, jnp.ones((), bool)))[0]


def _backward_reach(held: np.ndarray, jumps: Rates, grid: Grid, clock: Clock) -> np.ndarray:
    """The nodes with a path of jumps to a held node, bool (*grid)."""
    # a pass over all nodes costs little on the device, and a path has as many as it has jumps: long ones, as in a maze,
    # are left to the search, whose list of jumps has to fit into memory
    if grid.size > LARGE:
        listed = grid.size * len(jumps.offsets) <= SEARCHABLE
        found = _reach_on_device(held, jumps, grid, clock, LONG * sum(grid.shape) if listed else grid.size)
        if found is not None:
            return found
    clock.enter("the search for nodes that reach the target")
    found = _reach_in_passes(held, jumps, LONG * sum(grid.shape)) if grid.size <= SMALL else None
    return _reach_on_host(held, jumps, grid) if found is None else found


def _reach_on_device(held: np.ndarray, jumps: Rates, grid: Grid, clock: Clock, most: int) -> np.ndarray | None:
    """Nodes that lead to a held one, all at once on the device; None if their paths have more than ``most`` jumps."""
    found, more, some = jnp.asarray(held), True, max(1, LOOK // grid.size)  # jumps between two looks at the clock
    for step in range(0, most, some):
        clock.enter(f"the search for nodes that reach the target, paths of {step} jumps")
        found, more = _predecessors(found, jumps, grid, min(some, most - step))
        if not more:
            return np.asarray(found)
    return None


@jax.jit
def _predecessors(found: jax.Array, jumps: Rates, grid: Grid, most: int | Scalar) -> tuple[jax.Array, Scalar]:
    """``found`` with the nodes that lead there in ``most`` jumps; and if there may be more."""

    def step(carry):
        found, _, count = carry
        more = found
        for offset, jump in zip(jumps.offsets, jumps.values, strict=True):
            # with what this pass has found so far, so that one pass may follow several jumps
            more |= jump & stencil.neighbour(more, grid, offset)
        return more, jnp.any(more != found), count + 1

    def goes_on(carry):
        return carry[1] & (carry[2] < most)

    found, more, _ = jax.lax.while_loop(goes_on, step, (found, jnp.ones((), bool), 0))
    return found, more


def _reach_in_passes(held: np.ndarray, jumps: Rates, most: int) -> np.ndarray | None:
    """Nodes that lead to a held one, all at once in NumPy; None if their paths have more than ``most`` jumps."""
    found, axes = held, tuple(range(held.ndim))
    opened = [(offset, np.asarray(jump)) for offset, jump in zip(jumps.offsets, jumps.values, strict=True)]
    for _ in range(most):
        more = found
        for offset, jump in opened:
            more = more | (jump & np.roll(more, [-step for step in offset], axes))  # no jump leads out of the box
        if np.array_equal(more, found):
            return found
        found = more
    return None


def _reach_on_host(held: np.ndarray, jumps: Rates, grid: Grid) -> np.ndarray:
    """The nodes with a path of jumps to a held node by a breadth-first search, however long the paths are."""
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
