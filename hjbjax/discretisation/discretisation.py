"""A problem discretised on a grid by a scheme, and the base classes of schemes.

``schemes`` shows how to write a custom scheme.
"""

import abc
import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import cut_cells, stencil
from hjbjax.discretisation.interventions import Interventions
from hjbjax.discretisation.landing import Corners, landing_corners
from hjbjax.discretisation.paths import Paths
from hjbjax.discretisation.players import Players, find_players
from hjbjax.discretisation.stencil import Links
from hjbjax.problem import sets
from hjbjax.problem.grid import Grid, placed
from hjbjax.problem.layouts import Layout
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, pytree_dataclass
from hjbjax.tracing import components, dependence


class Scheme(abc.ABC):
    """The base class of schemes, which define the slopes of V in the drift term.

    A scheme is a frozen, hashable value without traced numbers. It defines ``chain`` and ``slopes``; everything else
    has a default.
    """

    @property
    def monotone(self) -> bool:
        """True if the scheme is a Markov chain (``Chain``). Only these schemes give certified solutions."""
        return False

    @property
    def stationary(self) -> bool:
        """True if corrections with the matrix of ``chain`` can drive the residual with these slopes to zero."""
        return True

    @property
    def paths(self) -> Paths | None:
        """The paths that ``solve`` follows instead of using slopes; None by default."""
        return None

    @property
    def even(self) -> bool:
        """True if the scheme requires equal spacings along every axis."""
        return False

    @property
    def subcell(self) -> bool:
        """True if the boundary of a target is resolved between nodes."""
        return False

    @property
    def split(self) -> bool:
        """True if the drifts of two players who drive the same component are upwinded separately, see ``Upwind``."""
        return False

    @property
    def stages(self) -> int:
        """The stages, and the order, of a suitable explicit Runge–Kutta method: 1, 2 or 3."""
        return 2

    @property
    def points(self) -> int:
        """The smallest number of nodes per axis."""
        return 2

    @property
    def blends(self) -> bool:
        """True if ``slopes`` returns the one-sided differences whenever ``Differences.first_order`` is true."""
        return False

    @property
    def in_parts(self) -> bool:
        """True if ``slopes`` reads other nodes through ``stencil`` only, so that devices can share the nodes."""
        return False

    @property
    @abc.abstractmethod
    def chain(self) -> "Chain":
        """A monotone chain, such as ``Upwind()``, for the start, the corrections and the limit of explicit steps."""

    @abc.abstractmethod
    def slopes(self, around: "Differences") -> Sequence[tuple[jax.Array, jax.Array]]:
        """P⁺ and P⁻ along every axis, each (*grid), zero at a wall. Drift f gives max(f, 0) P⁺ + min(f, 0) P⁻."""


class Chain(Scheme):
    """The base class of monotone schemes, which are Markov chains. Drift f and diffusion a along an axis contribute

        [(e + h⁻ f) D⁺ − (e − h⁺ f) D⁻]/(h⁺ + h⁻),    e ≥ max(a, h⁺ f, −h⁻ f),

    where h⁺ and h⁻ are the distances to the two neighbours. e(f) may exceed e(0) by at most h|f|. A chain defines
    ``excess`` and ``kinks``. ``schemes`` explains the treatment of walls and shows an example.
    """

    monotone, stages = True, 1

    @property
    def is_proven(self) -> bool:
        """True if e is large enough for all f and a; otherwise it is checked at the nodes before a solve."""
        return False

    @property
    def one_way(self) -> bool:
        """True if e = max(h⁺ f, −h⁻ f) without noise, so that one of two opposite jumps has rate zero."""
        return False

    @property
    def chain(self) -> "Chain":
        """The chain itself."""
        return self

    def slopes(self, around: "Differences") -> Sequence[tuple[jax.Array, jax.Array]]:
        """The one-sided differences."""
        return around.one_sided

    @abc.abstractmethod
    def excess(self, f: Any, a: Any, link: Links) -> Any:
        """The diffusion e along an axis."""

    @abc.abstractmethod
    def kinks(self, a: Any, slopes: tuple[Any, Any], link: Links) -> tuple[Sequence[Any], Sequence[Any]]:
        """The drifts f, increasing, at which the derivative of the gain jumps, and its derivatives between them.

        There are at most three kinks, and one more derivative than kinks. ``slopes`` are D⁺ and D⁻.
        """


@pytree_dataclass(static=("scheme", "dtype"))
class Discretisation:
    """A problem on a grid, discretised by a scheme, in one floating-point type and at one time.

    The methods evaluate the problem's functions at all nodes at once. An action is a list of its components, each a
    number or an array that broadcasts over the nodes; results have the same form.

    Args:
      problem: the problem.
      grid: the grid.
      scheme: the scheme for the derivatives.
      dtype: the floating-point type of all node values.
      t: the time, used if the problem depends on it.
    """

    problem: Problem
    grid: Grid
    scheme: Scheme
    dtype: Any
    t: Any = 0.0
    _links: tuple[Links, ...] | None = dataclasses.field(init=False, repr=False, default=None)  # see ``with_links``

    def __post_init__(self) -> None:
        # jnp.float32 and "float32" hash differently from np.dtype, so each would compile its own program
        object.__setattr__(self, "dtype", np.dtype(self.dtype))

    @property
    def chain(self) -> "Discretisation":
        """The discretisation by the scheme's monotone chain."""
        return self.with_scheme(self.scheme.chain)

    def with_scheme(self, scheme: Scheme) -> "Discretisation":
        """The discretisation by another scheme."""
        same = scheme.subcell == self.scheme.subcell
        return altered(self, scheme=scheme) if same else dataclasses.replace(self, scheme=scheme)

    def at(self, t: Any) -> "Discretisation":
        """The discretisation at another time."""
        return dataclasses.replace(self, t=t)

    def asking(self, problem: Problem) -> "Discretisation":
        """The discretisation of another problem."""
        same = problem.target is self.problem.target and problem.exit_cost is self.problem.exit_cost
        return altered(self, problem=problem) if same else dataclasses.replace(self, problem=problem)

    def on_grid(self, grid: Grid) -> "Discretisation":
        """The discretisation on another grid."""
        return dataclasses.replace(self, grid=grid)

    def on_part(self, layout: Layout) -> "Discretisation":
        """The discretisation of the nodes of one device, inside ``shard_map`` if they are divided."""
        return altered(self, grid=placed(self.grid, layout))

    @functools.cached_property
    def players(self) -> Players:
        """The players; if their drifts are upwinded separately, they are decoupled on the grid."""
        found = find_players(self.problem, self.grid.ndim, self.dtype)
        return dataclasses.replace(found, decoupled=found.decoupled or self.apart)

    @property
    def level(self) -> jax.Array:
        """l at every node, (*grid), with an exact zero where it is zero up to rounding; ≤ 0 in the target."""
        # the function of a target may return integers
        return cut_cells.level(jnp.asarray(self.at_nodes(self.problem.target), self.dtype), self.grid)

    @property
    def cuts_links(self) -> bool:
        """True if links may end on the boundary of a target between two nodes."""
        return self.scheme.subcell and self.problem.target is not None

    @property
    def links(self) -> tuple[Links, ...]:
        """The links along every axis, cut at the boundary of the target if the scheme has ``subcell``."""
        if not self.cuts_links:
            return tuple(stencil.grid_links(self.grid, axis) for axis in range(self.grid.ndim))
        if self._links is not None:
            return self._links

        def exit_cost(x: list) -> jax.Array:
            return components.of_state(self.problem, self.problem.exit_cost, x, self.t, self.dtype)

        return cut_cells.links(self.coordinates(), self.level, exit_cost, self.grid)

    def with_links(self) -> "Discretisation":
        """The discretisation with its links stored instead of computed on every use."""
        return altered(self, _links=self.links)

    def coordinates(self) -> list:
        """The n coordinates of all nodes, each of a shape that broadcasts to (*grid)."""
        return self.grid.components(self.dtype)

    def drift(self, u: list, d: list | None = None, x: list | None = None) -> list:
        """The n components of f at the nodes, or at ``x``."""
        return list(components.components(self.problem.drift, *self._arguments(u, d, x), dtype=self.dtype))

    @property
    def apart(self) -> bool:
        """True if each player's drift is upwinded separately: the scheme has ``split``, and both drive some component.

        Drift and cost must then be sums over the players, f = f(x, u, 0) + [f(x, 0, d) − f(x, 0, 0)]. At constrained
        ends the admissible actions depend on the sum.
        """
        if not (self.scheme.split and self.problem.is_game) or self.grid.sides("constrained"):
            return False
        found = dependence.influence(self.problem, self.grid.ndim, self.dtype)
        return found.separable and found.meet

    def drifts(self, u: list, d: list | None = None, x: list | None = None) -> list[list]:
        """The parts of the drift that are upwinded separately: the whole drift, or one part per player.

        The noise goes with the first part. Components that the disturbance does not drive are exactly zero in the
        second part.
        """
        if not self.apart:
            return [self.drift(u, d, x)]
        found = dependence.influence(self.problem, self.grid.ndim, self.dtype)
        driven, zero = found.drift.driven_by(found.disturbance), jnp.zeros((), self.dtype)
        # any input splits a sum of two functions, so zero need not be admissible
        no_u, no_d = ([zero] * len(inputs) for inputs in (found.control, found.disturbance))
        still, pushed = self.drift(no_u, no_d, x), self.drift(no_u, d, x)
        # exactly zero where the disturbance does not act: the sign of a rounding error, pushed − still = 1e-17, would
        # choose the upwind side
        theirs = [pushed[i] - still[i] if i in driven else zero for i in range(self.grid.ndim)]
        return [self.drift(u, no_d, x), theirs]

    def running_cost(self, u: list, d: list | None = None, x: list | None = None) -> Any:
        """L, in cost per unit time; zero if the problem has no cost."""
        if self.problem.cost is None:
            return jnp.zeros((), self.dtype)
        return components.scalar(self.problem.cost, *self._arguments(u, d, x), dtype=self.dtype)

    def diffusion(self, u: list, d: list | None = None, x: list | None = None) -> dict[tuple[int, int], Any]:
        """The entries a_ij, i ≤ j, of a = σσᵀ, except entries that are zero by construction."""
        noise, n = self.problem.noise, self.grid.ndim
        if noise is None:  # an empty dict instead of zeros, which would cost a pass over the nodes
            return {}
        if callable(noise):
            sigma = components.components(noise, *self._arguments(u, d, x), dtype=self.dtype)
        else:
            places = self.coordinates() if x is None else x
            sigma = components.components(lambda x: jnp.asarray(noise, self.dtype), places, dtype=self.dtype)
        if sigma.ndim < 2:  # one number, or one per axis: independent noise, a diagonal a
            spread = np.broadcast_to(sigma, (n,))
            return {(i, i): spread[i] * spread[i] for i in self.grid.state_axes}
        # σ of shape (n, k): a_ij = Σ_l σ_il σ_jl is symmetric, so i ≤ j suffices
        pairs = itertools.combinations_with_replacement(self.grid.state_axes, 2)
        return {(i, j): sum(p * q for p, q in zip(sigma[i], sigma[j], strict=True)) for i, j in pairs}

    def mode_rates(self, u: list, d: list | None = None, x: list | None = None) -> list:
        """The rates of jumps over 1, ..., k − 1 modes; empty without random changes of the mode."""
        rates = self.problem.mode_rates
        return [] if rates is None else list(components.components(rates, *self._arguments(u, d, x), dtype=self.dtype))

    def growth(self, u: list, d: list | None = None, x: list | None = None) -> list:
        """The growth rate of the payments, one entry; empty without growth."""
        growth = self.problem.growth
        if growth is None:
            return []
        return [components.scalar(growth, *self._arguments(u, d, x), dtype=self.dtype)]

    def intensities(self, u: list, d: list | None = None, x: list | None = None) -> list:
        """The rates of the jumps of the state; empty without jumps."""
        rates = self.problem.intensities
        return [] if rates is None else list(components.components(rates, *self._arguments(u, d, x), dtype=self.dtype))

    def landings(self, u: list, d: list | None = None, x: list | None = None) -> list[Corners]:
        """The corners between which each jump of the state lands; empty without jumps."""
        if self.problem.landings is None:
            return []
        found = components.components(self.problem.landings, *self._arguments(u, d, x), dtype=self.dtype)
        return [landing_corners(self.grid, list(y), self.dtype) for y in found]

    def switching_costs(self) -> list:
        """The costs of changing the mode by 1, ..., k − 1, each (*grid); empty if the controller cannot change it."""
        costs = self.problem.switching_costs
        if costs is None:
            return []
        where = self.problem.state_arguments(self.coordinates(), self.t)
        found = components.components(costs, *where, dtype=self.dtype)
        return [jnp.broadcast_to(jnp.asarray(cost, self.dtype), self.grid.shape) for cost in found]

    def interventions(self) -> Interventions:
        """The changes of the mode and the pushes that the controller may choose, with their costs at the nodes.

        A push costs the mean of c at both nodes times their distance. No push leads across an end of the box.
        """
        grid, problem = self.grid, self.problem
        costs = self.switching_costs()
        offsets = [stencil.unit(grid, 0, number) for number in range(1, len(costs) + 1)]
        changes, steps = len(costs), problem.push_steps
        if steps:
            where = problem.state_arguments(self.coordinates(), self.t)
            marginal = components.components(problem.push_costs, *where, dtype=self.dtype)
        for (axis, step), price in zip(steps, marginal if steps else (), strict=True):
            price, offset = jnp.broadcast_to(jnp.asarray(price, self.dtype), grid.shape), stencil.unit(grid, axis, step)
            link = stencil.grid_links(grid, axis)
            length = jnp.asarray(link.up if step > 0 else link.down, self.dtype)
            paid = (price + stencil.neighbour(price, grid, offset)) / 2 * length
            costs.append(jnp.where(stencil.on_edge(grid, axis, step), jnp.inf, paid))
            offsets.append(offset)
        once = len(steps) == 1 and not changes and not grid.periodic[steps[0][0]]
        return Interventions(tuple(offsets), tuple(costs), changes, once)

    @property
    def decay(self) -> Any:
        """The factor of V in the equation: the constant discount plus any killing, which is at the nodes, (*grid)."""
        killing = self.problem.killing
        return self.problem.discount if killing is None else self.problem.discount + self.at_nodes(killing)

    def noisy_walls(self, x: list) -> list[dict[int, jax.Array]]:
        """The nodes where noise reflects, for every axis and the steps −1 and 1 across its walls: bool, one slice each.

        There ∂V/∂n = 0, and slopes must use the mirror image. A parabola through the last three nodes would be unstable
        next to such a wall: the slope at the last inner node would not be limited, and noise couples this node to the
        value on the wall. Under drift towards the wall with a < h f both values would grow like e^{0.15 f t/h}.
        """
        found: list[dict[int, jax.Array]] = [{} for _ in range(self.grid.ndim)]
        if self.problem.noise is None:
            return found
        pairs = self._probes()
        for axis, step in itertools.product(range(self.grid.ndim), (-1, 1)):
            if self.grid.periodic[axis] or not stencil.has_wall(self.grid, axis, step):
                continue
            ends = [stencil.slices(c, self.grid, axis, step) if i == axis else c for i, c in enumerate(x)]
            noise = [self.diffusion(u, d, ends).get((axis, axis), jnp.zeros((), self.dtype)) for u, d in pairs]
            found[axis][step] = functools.reduce(jnp.logical_or, [a > 0 for a in noise])
        return found

    def central_nodes(self, x: list, links: Sequence[Links]) -> list[Any]:
        """For every axis the nodes where central differences are monotone under all representative actions, bool."""
        # must not depend on the action, otherwise the kinks of H would move with the action
        found: list[Any] = [True] * self.grid.ndim
        for u, d in self._probes():
            f, a = self.drift(u, d, x), self.diffusion(u, d, x)
            for axis in self.grid.state_axes:
                left, link = stencil.noise_along(a, self.grid, axis), links[axis]
                found[axis] &= left >= jnp.maximum(link.up, link.down) * jnp.abs(f[axis])
        return found

    def _probes(self) -> list[tuple[list, list]]:
        """Representative pairs of actions of both players."""
        mine, theirs = (sets.probes(each, self.dtype) for each in (self.problem.controls, self.problem.disturbances))
        return list(itertools.product(mine, theirs))

    def at_nodes(self, ingredient: Any) -> jax.Array:
        """A function of the state, or a number, at every node, shape (*grid); zero for None."""
        found = components.of_state(self.problem, ingredient, self.coordinates(), self.t, self.dtype)
        return jnp.broadcast_to(found, self.grid.shape)

    def _arguments(self, u: list, d: list | None, x: list | None) -> tuple:
        return self.problem.arguments(self.coordinates() if x is None else x, u, d, self.t)


@dataclasses.dataclass(frozen=True)
class Differences:
    """The input of ``Scheme.slopes``: V at the nodes, its differences between nodes, and the nodes where noise acts.

    Attributes:
      on: the problem on its grid.
      x: the coordinates of the nodes.
      value: V, (*grid).
      links: the distances to the neighbours along every axis.
      one_sided: D⁺ and D⁻ along every axis, each (*grid); zero across a wall.
      unreachable: the nodes whose stored value is far above all others, bool (*grid); None if there are none.
      first_order: true if the slopes must be the one-sided differences; a bool that may be traced, or None for false.
        Only schemes with ``blends`` read it, which saves an array per slope.
    """

    on: Discretisation
    x: list
    value: jax.Array
    links: tuple[Links, ...]
    one_sided: tuple[tuple[jax.Array, jax.Array], ...]
    unreachable: jax.Array | None = None
    first_order: jax.Array | None = None

    @property
    def grid(self) -> Grid:
        """The grid, for ``stencil`` and ``slopes``."""
        return self.on.grid

    @functools.cached_property
    def reflecting(self) -> list[dict[int, jax.Array]]:
        """The nodes where noise reflects, see ``Discretisation.noisy_walls``."""
        return self.on.noisy_walls(self.x)

    @functools.cached_property
    def central(self) -> list[Any] | None:
        """For every axis the nodes where central differences are monotone for all actions; None without noise."""
        return None if self.on.problem.noise is None else self.on.central_nodes(self.x, self.links)
