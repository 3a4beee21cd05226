"""The jump rates of the Kushner–Dupuis Markov chain of a controlled diffusion.

On axis i with spacing h (h⁺ up, h⁻ down), drift f_i and diffusion a = σσᵀ the chain leaves a node at the rates

    c_i^+ = (e_i + h⁻ f_i) / (h⁺ (h⁺ + h⁻)),     c_i^- = (e_i − h⁺ f_i) / (h⁻ (h⁺ + h⁻))

where e_i = a_ii + h⁺ f_i⁺ + h⁻ f_i⁻ for the plain upwind chain, with f⁺ = max(f, 0) and f⁻ = max(−f, 0). This gives
c_i^± = f_i^±/h + a_ii/(2h²) on a uniform grid. With central differences wherever they are monotone, e_i = max(a_ii,
h⁺ f_i, −h⁻ f_i). Correlated noise causes diagonal jumps: a pair i, j gives c^{±(e_i + e_j)} = a_ij⁺/(2 h_i h_j) and
c^{±(e_i − e_j)} = a_ij⁻/(2 h_i h_j), and reduces a_ii by |a_ij| h_i/h_j.

With Q = Σ c and Δt = 1/max_u Q, the transition probabilities are c Δt, and the self-transition is 1 − Q Δt (the chapter
prints (13.3) without the "1 −"). At a wall, outward drift is cut off and noise reflects on the node: the chain moves
inwards at the rate (e(n⁺) − h n)/h², with n the outward drift, see ``schemes``. A diagonal jump across a wall goes to
its mirror image.
Source: H. J. Kushner and P. Dupuis, Numerical Methods for Stochastic Control Problems in Continuous Time.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import schemes, stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.landing import Landing
from hjbjax.problem import sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.pytree import pytree_dataclass, tie
from hjbjax.problem.types import Array

Offset = tuple[int, ...]


@pytree_dataclass(static=("offsets", "one_way"))
class Rates:
    """The matrix-free generator of the chain under a policy: (𝓛V)(x) = Σ_o c_o(x) (V(x + o) − V(x)).

    Args:
      offsets: the jumps o, each a tuple of −1, 0, 1, one entry per axis; along an axis of modes up to k − 1.
      values: for each offset the rates c_o ≥ 0 per unit time, shape (*grid); none leads out of the box.
      one_way: True if at most one of two opposite jumps has a positive rate, as without noise.
      landings: the jumps to other nodes than neighbours, with their rates.
      ending: the rate at which paths end without a payment, (*grid): minus the growth of the payments. None for zero.
    """

    offsets: tuple[Offset, ...]
    values: tuple[Any, ...]
    one_way: bool = False
    landings: tuple[Landing, ...] = ()
    ending: Any = None

    def total(self) -> Any:
        """Q = Σ_o c_o plus the rate of ending, at which the chain leaves each node, shape (*grid)."""
        ending = [] if self.ending is None else [self.ending]
        first, *others = (*self.values, *(landing.rate for landing in self.landings), *ending)
        return sum(others, start=first)  # start=0 would cost one more array

    def jumps(self, grid: Grid, *, continued: bool = False) -> Iterator[tuple[Any, Callable[[Any], Any]]]:
        """For every jump its rate, and the function that reads node values at its end.

        Args:
          grid: the grid.
          continued: beyond the ends of the box read V as it continues there; otherwise the value of the last node.
        """
        move = stencil.continued if continued else stencil.neighbour
        for offset, c in zip(self.offsets, self.values, strict=True):
            yield c, functools.partial(move, grid=grid, offset=offset)
        for landing in self.landings:
            yield landing.rate, landing.ahead

    def apply(self, grid: Grid, values: jax.Array) -> jax.Array:
        """𝓛V for node values V, shape (*grid); cost per unit time."""
        # differences first: c V(x + o) and c V(x) are both large for small h, while their difference is not
        terms = [c * (ahead(values) - values) for c, ahead in self.jumps(grid, continued=True)]
        return sum(terms[1:], start=terms[0])

    def products(self, grid: Grid, values: jax.Array, *, change: bool = False) -> list[jax.Array]:
        """The terms c V(y), one per jump, (*grid); zero beyond the ends of the box, unless V continues there.

        Args:
          grid: the grid.
          values: V, or a change of V.
          change: ``values`` are a change of V, which is continued beyond open ends.
        """
        pairs = zip(self.offsets, self.values, strict=True)
        if change and grid.sides("open"):
            terms = [c * stencil.continued(values, grid, offset, change=True) for offset, c in pairs]
        else:
            terms = [c * stencil.neighbour(values, grid, offset, ghost=False) for offset, c in pairs]
        return terms + [landing.product(values) for landing in self.landings]

    def scaled(self, factor: Any) -> "Rates":
        """Every rate times ``factor``, shape (*grid) or a number."""
        values, landings = (factor * c for c in self.values), (each.weighed(factor) for each in self.landings)
        ending = None if self.ending is None else factor * self.ending
        return dataclasses.replace(self, values=tuple(values), landings=tuple(landings), ending=ending)

    def kept(self, mask: Any) -> "Rates":
        """The rates where ``mask`` is true, bool (*grid), and zero elsewhere, also instead of NaN; on the host too."""
        xp: Any = np if isinstance(self.values[0], np.ndarray) and isinstance(mask, np.ndarray) else jnp
        values = (xp.where(mask, c, 0) for c in self.values)
        landings = (dataclasses.replace(each, rate=xp.where(mask, each.rate, 0)) for each in self.landings)
        return dataclasses.replace(self, values=tuple(values), landings=tuple(landings))

    def inflow(self, grid: Grid) -> "Rates":
        """The off-diagonal part of the transposed generator, as rates from x + o into x."""
        opposite = [tuple(-step for step in offset) for offset in self.offsets]
        arriving = [
            stencil.neighbour(c, grid, offset, ghost=False) for offset, c in zip(opposite, self.values, strict=True)
        ]
        return Rates(tuple(opposite), tuple(arriving), landings=tuple(each.reversed() for each in self.landings))


def jump_rates(on: Discretisation, u: list, d: list | None = None, *, speed: float = 1.0) -> Rates:
    """The jump rates under a policy of the scheme's monotone chain.

    Args:
      on: the discretisation; only drift and noise of its problem are used.
      u: the m components of the control, each broadcasting to (*grid).
      d: the components of the disturbance, in a game.
      speed: a factor of the drift.
    """
    grid = on.grid
    x, u, d = tie((on.coordinates(), u, d))  # otherwise loops keep drift that u does not change
    first, *others = _drifts(on, u, d, x, speed)
    table = _table(on, first, on.diffusion(u, d, x))
    for other in others:  # jumps of either chain
        for offset, rate in _table(on, other, {}).items():
            table[offset] = table[offset] + rate
    for number, rate in enumerate(on.mode_rates(u, d, x), start=1):
        table[stencil.unit(grid, 0, number)] = rate
    values = tuple(jnp.broadcast_to(jnp.asarray(rate, on.dtype), grid.shape) for rate in table.values())
    landings = tuple(
        Landing(nodes, rate * weight)
        for rate, found in zip(on.intensities(u, d, x), on.landings(u, d, x), strict=True)
        for nodes, weight in zip(found.nodes, found.weights, strict=True)
    )
    one_way = on.problem.noise is None and on.scheme.chain.one_way and not others
    ending = next((jnp.broadcast_to(-growth, grid.shape) for growth in on.growth(u, d, x)), None)
    return Rates(tuple(table), values, one_way, landings, ending)


def _drifts(on: Discretisation, u: Any, d: Any, x: Any, speed: float) -> list[list]:
    """The parts of the drift times ``speed``."""
    found = on.drifts(u, d, x)
    return found if speed == 1 else [[speed * f for f in drift] for drift in found]


def _table(on: Discretisation, f: list, a: dict[tuple[int, int], Any]) -> dict[Offset, Any]:
    """The rate of every jump for drift f and diffusion a."""
    grid, links = on.grid, on.chain.links
    table: dict[Offset, Any] = {}
    for axis in grid.state_axes:
        link = links[axis]
        left = stencil.noise_along(a, grid, axis)
        upward, downward = schemes.weights(on.scheme.chain, f[axis], left, link, grid, axis)
        for step, weight, length in ((1, upward, link.up), (-1, downward, link.down)):
            beyond = stencil.wall(grid, axis, step)
            # a product, because XLA stores quotients that several expressions read
            table[stencil.unit(grid, axis, step)] = jnp.where(beyond, 0, weight * (1 / length))
        for step in (step for i, step in grid.sides("neumann") if i == axis):
            _reflect(table, grid, axis, step, noisy=on.problem.noise is not None)
    for (i, j), entry in a.items():
        if i != j:
            _add_diagonal_jumps(table, entry, grid, i, j)
    return table


def _reflect(table: dict[Offset, Any], grid: Grid, axis: int, step: int, *, noisy: bool) -> None:
    """Redirect jumps beyond an end with a prescribed slope to the mirror image inside; without noise drop them.

    The prescribed slope acts as a payment, which is not part of the rates.
    """
    outwards, inwards = (stencil.unit(grid, axis, sign * step) for sign in (1, -1))
    beyond = stencil.on_edge(grid, axis, step)
    rate = table[outwards]
    if noisy:
        table[inwards] = table[inwards] + jnp.where(beyond, rate, 0)
    table[outwards] = jnp.where(beyond, 0, rate)


def fastest_rate(on: Discretisation, speed: float = 1.0) -> jax.Array:
    """max over the actions of Q at every node, (*grid): with Δt = 1/(Q + β) value iteration is monotone.

    If the drift is affine in u, Q is convex in u, so the corners of the sets suffice; samples are added for other
    drifts. ``speed`` is a factor of the drift.
    """
    result = jnp.zeros(on.grid.shape, on.dtype)
    us, ds = (list(sets.probes(each, on.dtype)) for each in (on.problem.controls, on.problem.disturbances))
    if on.apart:  # Q is a sum over the players; pairs of probes would double the compile time
        mine = (_table(on, _drifts(on, u, ds[0], None, speed)[0], on.diffusion(u, ds[0])) for u in us)
        theirs = (_table(on, _drifts(on, us[0], d, None, speed)[1], {}) for d in ds)
        tables = ([sum(table.values()) for table in each] for each in (mine, theirs))
        pairs = itertools.product(us, ds)
        switching = [
            sum([*on.mode_rates(u, d), *on.intensities(u, d), *(-each for each in on.growth(u, d))], start=result)
            for u, d in pairs
        ]
        return functools.reduce(jnp.maximum, switching) + sum(functools.reduce(jnp.maximum, each) for each in tables)
    for u, d in itertools.product(us, ds):
        result = jnp.maximum(result, jump_rates(on, u, d, speed=speed).total())
    return result


def largest_rate(on: Discretisation, speed: float = 1.0) -> jax.Array:
    """max of Q over actions and nodes, a number, without an array of the nodes; ``speed`` is a factor of the drift."""
    pairs = list(
        itertools.product(*(sets.probes(each, on.dtype) for each in (on.problem.controls, on.problem.disturbances)))
    )
    if on.apart or len(pairs) == 1:
        return on.grid.layout.largest(fastest_rate(on, speed))
    us, ds = ([jnp.stack(list(entries)) for entries in zip(*each, strict=True)] for each in zip(*pairs, strict=True))

    def larger(k: Any, largest: jax.Array) -> jax.Array:
        # one action at a time: for all at once XLA keeps common terms, 17 arrays for a quadrotor in six dimensions
        u, d = ([entry[k] for entry in entries] for entries in (us, ds))
        return jnp.maximum(largest, on.grid.layout.largest(jump_rates(on, u, d, speed=speed).total()))

    return jax.lax.fori_loop(0, len(pairs), larger, jnp.zeros((), on.dtype))


def _reflecting(grid: Grid, axis: int, step: int) -> Array:
    """The nodes at an end where a diagonal jump lands on the mirror image."""
    return (
        stencil.on_edge(grid, axis, step) if (axis, step) not in grid.sides("open") else stencil.wall(grid, axis, step)
    )


def _add_diagonal_jumps(table: dict[Offset, Any], entry: Any, grid: Grid, i: int, j: int) -> None:
    """Add the diagonal jumps of a pair of axes; a jump out of the box goes to the mirror image (noise reflects)."""
    scale = 2 * grid.spacing(i) * grid.spacing(j)
    pairs = list(itertools.product((1, -1), repeat=2))
    # a_ij⁺ along the diagonal, a_ij⁻ across it
    rate = {(p, q): jnp.maximum(entry * (p * q), 0) / scale for p, q in pairs}
    for p, q in pairs:  # first across the walls of axis i, then of axis j; both at a corner
        off = _reflecting(grid, i, p)
        rate[-p, q], rate[p, q] = rate[-p, q] + jnp.where(off, rate[p, q], 0), jnp.where(off, 0, rate[p, q])
    for p, q in pairs:
        off = _reflecting(grid, j, q)
        rate[p, -q], rate[p, q] = rate[p, -q] + jnp.where(off, rate[p, q], 0), jnp.where(off, 0, rate[p, q])
    for p, q in pairs:
        table[tuple(p * (k == i) + q * (k == j) for k in range(grid.ndim))] = rate[p, q]
