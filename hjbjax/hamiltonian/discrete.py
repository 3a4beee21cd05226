"""The discrete Hamiltonian around one value function.

At a node, for one action of each player,

    H(u, d) = L(x, u, d) + Σ_o c_o(x, u, d) (V(x + o) − V(x)) + g(x, u, d) V(x),

written with one-sided differences, so that only the value is read from memory. With D⁺, D⁻ along an axis the gain of a
drift component f is [(e + h⁻ f) D⁺ − (e − h⁺ f) D⁻]/(h⁺ + h⁻). As a function of u it has kinks where f changes sign
(and at |f| = a/h with central differences), so its minimisation is piecewise (see ``optimum``).
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.discretisation import edges, schemes, stencil
from hjbjax.discretisation.discretisation import Differences, Discretisation
from hjbjax.discretisation.slopes import along_states as slopes_along
from hjbjax.hamiltonian.search import Action
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import tie


@dataclasses.dataclass(frozen=True)
class DiscreteHamiltonian:
    """The Hamiltonian around one value function: coordinates, slopes, and the evaluation of H(u, d).

    Attributes:
      on: the problem on its grid.
      x: the coordinates of the nodes.
      value: V at the nodes.
      up, down: the slopes used by the drift: D⁺ and D⁻, or the slopes of a scheme of higher order.
      links: the distances to the neighbours along every axis.
      gaps: the values of V after a change of the mode by 1, ..., k − 1, minus V; empty without random changes.
      landed: the values of V after each jump of the state, minus V; None if the landings depend on an action.
      bends: D⁺ − D⁻ along every axis, used by the noise, with the mirror image across a wall.
      tried: an action of each player that is a candidate in addition to the samples. With the actions of the last step
        as candidates a sampled policy never gets worse.
      slack: for every axis the size of drifts that count as rounding; None without constrained ends and lost nodes.
      lost: for every axis, True where the next node up and the next node down are unreachable; None if none is.
      bare: True if only the optimum of H is needed. Then its actions are not stored in arrays; if they are requested
        too, they are searched for twice.
    """

    on: Discretisation
    x: list
    value: jax.Array
    up: tuple[jax.Array, ...]
    down: tuple[jax.Array, ...]
    bends: tuple[jax.Array, ...]
    links: tuple[stencil.Links, ...]
    gaps: tuple[jax.Array, ...] = ()
    landed: tuple[jax.Array, ...] | None = ()
    tried: tuple[Action, Action] | None = None
    slack: tuple[Any, ...] | None = None
    lost: tuple[tuple[Any, Any], ...] | None = None
    bare: bool = False

    def asking(self, problem: Problem) -> "DiscreteHamiltonian":
        """The Hamiltonian of another problem around the same value."""
        return dataclasses.replace(self, on=self.on.asking(problem))

    def gain(self, axis: int, f: Any, a: Any) -> Any:
        """[(e + h⁻ f) D⁺ − (e − h⁺ f) D⁻]/(h⁺ + h⁻), or with other slopes; infinite if f leaves a constrained end.

        A candidate for the optimum, such as the kink at f = 0, must therefore also be admissible. A drift of the size
        of rounding does not lead to an unreachable node, whose value is far above all others.
        """
        # sin π is 1e-16 instead of 0; times the value of an unreachable node, 1e8 times all others, it would matter
        if self.lost is not None:
            assert self.slack is not None
            f = jnp.where(edges.strays(f, self.lost[axis], self.slack[axis]), 0, f)
        gain = self._free_gain(axis, f, a)
        out = None if self.slack is None else edges.barred(f, self.on.grid, axis, self.slack[axis])
        return gain if out is None else jnp.where(out, jnp.inf, gain)

    def _free_gain(self, axis: int, f: Any, a: Any) -> Any:
        """The gain away from constrained ends; with other slopes f⁺ P⁺ + f⁻ P⁻ + a (D⁺ − D⁻)/(h⁺ + h⁻)."""
        # f > 0 uses the node above, f < 0 the node below, so every neighbour has a nonnegative weight
        upwind = jnp.maximum(f, 0) * self.up[axis] + jnp.minimum(f, 0) * self.down[axis]
        scheme, link = self.on.scheme, self.links[axis]
        if a is None and (scheme.chain.one_way or not scheme.monotone):
            return upwind
        if not scheme.monotone:  # the noise term is central already: only the drift has slopes of higher order
            # correlated noise may leave a rounding error below zero
            return upwind + jnp.maximum(a, 0) * self.bends[axis] / (link.up + link.down)
        upward, downward = schemes.weights(scheme.chain, f, a, link, self.on.grid, axis)
        return upward * self.up[axis] - downward * self.down[axis]

    def kinks(self, axis: int, a: Any) -> tuple[Sequence[Any], Sequence[Any]]:
        """The drifts along an axis at which the derivative of ``gain`` jumps, and its derivatives between them."""
        scheme, slopes = self.on.scheme, (self.up[axis], self.down[axis])
        if not scheme.monotone or (a is None and scheme.chain.one_way):  # f⁺ P⁺ + f⁻ P⁻ has its kink at f = 0
            return (0.0,), slopes[::-1]
        width = 0 if a is None else jnp.maximum(a, 0)
        return schemes.kinks(scheme.chain, width, slopes, self.links[axis], self.on.grid, axis)

    def at(self, u: Action, d: Action) -> Any:
        """H(u, d) at every node, in cost per unit time."""
        a, grid = self.on.diffusion(u, d, self.x), self.on.grid
        first, *others = self.on.drifts(u, d, self.x)
        total = self.on.running_cost(u, d, self.x)
        # one axis after the other, so that XLA fuses all of H into one pass over V
        for axis in grid.state_axes:
            total = total + self.gain(axis, first[axis], stencil.noise_along(a, grid, axis))
            for other in others:
                total = total + self.gain(axis, other[axis], None)
        for (i, j), entry in a.items():
            if i != j:
                total = total + self._diagonal(i, j, entry)
        for rate, gap in zip(self.on.mode_rates(u, d, self.x) if self.gaps else [], self.gaps, strict=True):
            total = total + rate * gap
        landed = landed_gaps(self.on, self.value, u, d, self.x) if self.landed is None else self.landed
        for rate, gap in zip(self.on.intensities(u, d, self.x) if landed else [], landed, strict=True):
            total = total + rate * gap
        for rate in self.on.growth(u, d, self.x):
            total = total + rate * self.value
        return jnp.broadcast_to(total, grid.shape)

    def _diagonal(self, i: int, j: int, entry: Any) -> Any:
        """The contribution of jumps along the two diagonals of a pair of axes for a_ij = ``entry``."""
        grid = self.on.grid
        ends = {
            (p, q): stencil.continued(
                self.value, grid, tuple(p * (k == i) + q * (k == j) for k in range(grid.ndim)), mirror=True
            )
            for p, q in itertools.product((1, -1), repeat=2)
        }
        # for a_ij > 0 the state moves along (1, 1) and (−1, −1), otherwise along (1, −1) and (−1, 1)
        same, opposite = ends[1, 1] + ends[-1, -1], ends[1, -1] + ends[-1, 1]
        scale = 2 * grid.spacing(i) * grid.spacing(j)
        return (
            jnp.maximum(entry, 0) * (same - 2 * self.value) + jnp.maximum(-entry, 0) * (opposite - 2 * self.value)
        ) / scale


def landed_gaps(on: Discretisation, value: jax.Array, u: Action, d: Action, x: list) -> tuple[jax.Array, ...]:
    """V after each jump of the state, minus V, under these actions; (*grid) each."""
    # stored, because XLA would otherwise gather the corners again wherever a gap is used
    return jax.lax.optimization_barrier(tuple(found.interpolate(value) - value for found in on.landings(u, d, x)))


def at_rest(on: Discretisation, slopes: jax.Array) -> DiscreteHamiltonian:
    """A Hamiltonian with slopes D⁺ = s_i and D⁻ = −s_i everywhere: H = L + Σ s_i |f_i| plus the noise terms.

    With s > 0, shape (n,), its minimum is zero if and only if some action rests at no cost, provided that the cost is
    not negative.
    """
    hamiltonian = around(on, jnp.zeros(on.grid.shape, slopes.dtype))
    one = jnp.ones(on.grid.shape, slopes.dtype)
    ups, downs, bends = (tuple(sign * slope * one for slope in slopes) for sign in (1, -1, 2))
    return dataclasses.replace(hamiltonian, up=ups, down=downs, bends=bends, gaps=(), landed=())


def around(
    on: Discretisation, value: jax.Array, lost: jax.Array | None = None, first_order: jax.Array | None = None
) -> DiscreteHamiltonian:
    """The Hamiltonian around ``value``, with coordinates and differences behind one barrier.

    ``lost`` and ``first_order`` as in ``Differences``.
    """
    grid = on.grid
    # otherwise XLA hoists products of coordinates out of the loop, one array of all nodes per action
    x, value = tie((on.coordinates(), value))
    links = on.links
    differences = tuple(slopes_along(grid, lambda axis: stencil.one_sided(value, grid, axis, links[axis])))
    bends = tuple(stencil.bends(*pair, grid, axis) for axis, pair in enumerate(differences))
    jumps = range(1, len(grid.modes)) if on.problem.mode_rates is not None else ()
    gaps = tuple(stencil.neighbour(value, grid, stencil.unit(grid, 0, number)) - value for number in jumps)
    landed = _landed_without_action(on, value, x)
    slopes = on.scheme.slopes(Differences(on, x, value, links, differences, lost, first_order))
    if first_order is not None and not on.scheme.blends:
        choose = functools.partial(jnp.where, first_order)
        slopes = jax.tree.map(choose, list(differences), list(slopes))
    up, down = (list(side) for side in zip(*slopes, strict=True))
    for axis, step, end in grid.prescribed("neumann") if on.problem.noise is None else ():
        # drift that leaves uses the prescribed slope; with the mirror image it would jump and return at once
        side = up if step > 0 else down
        side[axis] = jnp.where(stencil.on_edge(grid, axis, step), jnp.asarray(end.slope, on.dtype), side[axis])
    # only constrained ends and unreachable nodes need the rounding of a drift, which requires its separate terms
    careful = lost is not None or grid.sides("constrained")
    slack = tuple(edges.slack(on)) if careful else None
    beside = None if lost is None else edges.beside(lost, grid)
    return DiscreteHamiltonian(
        on, x, value, tuple(up), tuple(down), bends, links, gaps, landed, slack=slack, lost=beside
    )


def _landed_without_action(on: Discretisation, value: jax.Array, x: list) -> tuple[jax.Array, ...] | None:
    """``landed_gaps`` if the landings do not depend on any action, otherwise None."""
    if on.problem.landings is None:
        return ()
    players = on.players.both
    if any(player.lands for player in players):
        return None
    u, d = ([jnp.zeros((), on.dtype)] * len(player.driven) for player in players)
    return landed_gaps(on, value, u, d, x)
