"""Which nodes can be brought to the target for certain, read off the graph of the chain.

Without discount the value is finite exactly where some policy reaches the held nodes with probability one (a
proper policy). The largest such set R is a fixed point: take away the nodes from which no path of jumps leads
to the target by actions that keep every jump inside R, until nothing changes. Jumps under sampled actions are
found on the device, paths by a breadth-first search on the host, or on large grids on the device as well.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import chain, fields, sets, stencil
from hjbjax.chain import Rates
from hjbjax.grid import Grid
from hjbjax.problem import Problem
from hjbjax.schemes import Upwind

SAMPLES = 33  # actions of a continuum that are tried
LARGE = 200_000  # nodes beyond which paths are first followed on the device, all at once
LONG = 4  # times the nodes of all axes together: jumps of a path that are followed there


@functools.partial(jax.jit, static_argnames=("scheme", "dtype"))
def _open_jumps(problem: Problem, grid: Grid, inside: jax.Array | None, scheme: Upwind, dtype: Any) -> Rates:
    """For every jump whether some action makes it while all jumps of that action stay ``inside``; None is the box."""
    points = sets.samples(problem.controls, SAMPLES) if problem.controls is not None else np.zeros((1, 0))
    start = chain.rates(problem, grid, list(jnp.asarray(points[0], dtype)), None, scheme=scheme, dtype=dtype)

    def also(known, action):
        rates = chain.rates(problem, grid, list(action), None, scheme=scheme, dtype=dtype)
        stays = True if inside is None else _stays(rates, grid, inside)
        return tuple(p | ((c > 0) & stays) for p, c in zip(known, rates.values, strict=True)), None

    none = tuple(jnp.zeros(grid.shape, bool) for _ in start.offsets)
    return Rates(start.offsets, jax.lax.scan(also, none, jnp.asarray(points, dtype))[0])


def _stays(rates: Rates, grid: Grid, inside: jax.Array) -> jax.Array:
    """Where all jumps that have a rate lead ``inside``, bool (*grid)."""
    stays = jnp.ones(grid.shape, bool)
    for offset, c in zip(rates.offsets, rates.values, strict=True):
        stays &= (c <= 0) | stencil.neighbour(inside, grid, offset)
    return stays


def reached(problem: Problem, grid: Grid, held: np.ndarray, *, scheme: Upwind, dtype: Any, surely: bool) -> np.ndarray:
    """The nodes from which the held nodes can be reached; host level, for problems with one player.

    Args:
      problem, grid, scheme, dtype: the chain.
      held: bool (*grid), the nodes to reach.
      surely: with probability one rather than with some probability.

    Returns:
      bool (*grid).
    """
    found = _leads_to(held, _open_jumps(problem, grid, None, scheme, dtype), grid)
    inside = np.ones(grid.shape, bool)
    while surely and not np.array_equal(found, inside):
        inside = found
        found = inside & _leads_to(held, _open_jumps(problem, grid, jnp.asarray(inside), scheme, dtype), grid)
    return found


@functools.partial(jax.jit, static_argnames=("scheme", "dtype"))
def refuge(problem: Problem, grid: Grid, *, scheme: Upwind, dtype: Any) -> jax.Array:
    """The nodes from which some actions of both players keep the state off the target for ever, bool (*grid).

    The largest set in which every node has an action whose jumps all stay in it: nodes without one are taken away until
    nothing changes. Empty means that under every policy the target is reached with probability one.
    """
    u, d = (
        jnp.asarray(np.zeros((1, 0)) if choices is None else sets.samples(choices, SAMPLES), dtype)
        for choices in (problem.controls, problem.disturbances)
    )
    level = fields.of_state(problem, problem.target, grid.components(dtype), 0.0, dtype)

    def shrink(carry):
        inside, _ = carry

        def also(found, pair):
            rates = chain.rates(problem, grid, list(u[pair[0]]), list(d[pair[1]]), scheme=scheme, dtype=dtype)
            return found | _stays(rates, grid, inside), None

        pairs = jnp.stack(jnp.meshgrid(jnp.arange(len(u)), jnp.arange(len(d)), indexing="ij"), -1).reshape(-1, 2)
        found = inside & jax.lax.scan(also, jnp.zeros(grid.shape, bool), pairs)[0]
        return found, jnp.any(found != inside)

    start = jnp.broadcast_to(level > 0, grid.shape)
    return jax.lax.while_loop(lambda carry: carry[1], shrink, (start, jnp.ones((), bool)))[0]


def _leads_to(held: np.ndarray, jumps: Rates, grid: Grid) -> np.ndarray:
    """Nodes with a path of jumps to a held node."""
    if grid.size > LARGE:
        found, settled = _spread(jnp.asarray(held), jumps, grid)
        if settled:
            return np.asarray(found)
    return _searched(held, jumps, grid)


@jax.jit
def _spread(held: jax.Array, jumps: Rates, grid: Grid) -> tuple[jax.Array, jax.Array]:
    """Nodes that lead to a held one by paths of not too many jumps, and whether these are all there are."""

    def further(carry):
        found, _, step = carry
        more = found
        for offset, jump in zip(jumps.offsets, jumps.values, strict=True):
            more |= jump & stencil.neighbour(more, grid, offset)
        return more, jnp.any(more != found), step + 1

    def goes_on(carry):
        return carry[1] & (carry[2] < LONG * sum(grid.shape))

    found, unsettled, _ = jax.lax.while_loop(goes_on, further, (held, jnp.ones((), bool), 0))
    return found, ~unsettled


def _searched(held: np.ndarray, jumps: Rates, grid: Grid) -> np.ndarray:
    """The same by a breadth-first search, however long the paths are."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    starts = [np.flatnonzero(held)]
    ends = [np.full_like(starts[0], grid.size)]  # one more node leads to all held ones
    for offset, jump in zip(jumps.offsets, jumps.values, strict=True):
        leaves = ~held & np.asarray(jump)
        starts.append(np.flatnonzero(leaves))
        ends.append(stencil.numbers(grid, offset)[leaves])
    backward = np.concatenate(ends), np.concatenate(starts)
    graph = csr_array((np.ones(len(backward[0])), backward), shape=(grid.size + 1, grid.size + 1))
    found = np.zeros(grid.size + 1, bool)
    found[breadth_first_order(graph, grid.size, directed=True, return_predecessors=False)] = True
    return found[:-1].reshape(grid.shape)
