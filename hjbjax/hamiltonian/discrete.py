"""The discrete Hamiltonian and its optimum over the admissible sets.

At a node, for one action of each player,

    H(u, d) = L(x, u, d) + Σ_o c_o(x, u, d) (V(x + o) − V(x)),

written with one-sided differences, so that nothing but the value is read from memory: with D⁺, D⁻ along an
axis the gain of a drift component f is [(e + h⁻ f) D⁺ − (e − h⁺ f) D⁻]/(h⁺ + h⁻). As a function of u it has
kinks where f changes sign (and at |f| = a/h under central differences): minimising it is piecewise.

Exact where the drift is affine in u, the cost separable and quadratic, the noise free of u, and the inputs fall into
groups of one or two that drive components of their own, not too many (read from the jaxpr, see ``players``): all
ends, kinks and stationary points are tried. Otherwise samples and a pattern search, and certificates hold for the
refined sample.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax.discretisation import correlated_noise, cut_cells, edges, schemes, stencil
from hjbjax.discretisation.discretisation import Differences, Discretisation
from hjbjax.hamiltonian import search
from hjbjax.hamiltonian.piecewise import Kinked, inverse_root, kinked_ball, piecewise_input, piecewise_pair
from hjbjax.hamiltonian.players import SAMPLES, Player, players_of, shared
from hjbjax.hamiltonian.search import UNROLL, Action, best_of, enumerate_actions, refine
from hjbjax.problem import sets
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Finite
from hjbjax.tracing import components

INNER = 8  # evaluations written out of a search inside a search: with all 33 XLA gets up to five times the lines


@dataclasses.dataclass(frozen=True)
class DiscreteHamiltonian:
    """The Hamiltonian around one value function: coordinates, slopes, and how to evaluate H(u, d).

    Attributes:
      on: the problem on its grid.
      x: the coordinates of the nodes.
      value: V at the nodes.
      up, down: the slopes that drift sees; D⁺ and D⁻, or those of a scheme of higher order.
      links: the distances to the neighbours along every axis.
      bends: D⁺ − D⁻ along every axis, which noise sees, with the mirror image across a wall.
      tried: an action of each player that is a candidate beside the samples; with the actions of the last step
        among them a sampled policy never gets worse.
      slack: for every axis what is rounding of the drift; None without constrained ends and lost nodes.
      lost: for every axis whether the next node up and the next node down are lost; None where none is.
      bare: whether the optimum of H is wanted alone: then its actions take no arrays, and whoever asks for them as well
        has them searched for twice.
    """

    on: Discretisation
    x: list
    value: jax.Array
    up: tuple[jax.Array, ...]
    down: tuple[jax.Array, ...]
    bends: tuple[jax.Array, ...]
    links: tuple[stencil.Links, ...]
    tried: tuple[Action, Action] | None = None
    slack: tuple[Any, ...] | None = None
    lost: tuple[tuple[Any, Any], ...] | None = None
    bare: bool = False

    def asking(self, problem: Problem) -> "DiscreteHamiltonian":
        """The Hamiltonian of another problem around the same value."""
        return dataclasses.replace(self, on=self.on.asking(problem))

    def gain(self, axis: int, f: Any, a: Any) -> Any:
        """[(e + h⁻ f) D⁺ − (e − h⁺ f) D⁻]/(h⁺ + h⁻), or with other slopes; infinite where f leaves a constrained end.

        So every candidate for an optimum is judged by what it may do: the kink at f = 0 is among them. A drift that is
        rounding leads to no lost node, whose value is far above all others.
        """
        # sin π is 1e-16 and not 0: times a lost node's value, 1e8 times all others, that would count
        if self.lost is not None:
            assert self.slack is not None
            f = jnp.where(edges.strays(f, self.lost[axis], self.slack[axis]), 0, f)
        gain = self._free_gain(axis, f, a)
        out = None if self.slack is None else edges.barred(f, self.on.grid, axis, self.slack[axis])
        return gain if out is None else jnp.where(out, jnp.inf, gain)

    def _free_gain(self, axis: int, f: Any, a: Any) -> Any:
        """What ``gain`` is away from constrained ends; with other slopes f⁺ P⁺ + f⁻ P⁻ + a (D⁺ − D⁻)/(h⁺ + h⁻)."""
        # f > 0 sees the node above, f < 0 the one below: every neighbour enters with a weight that is not negative
        upwind = jnp.maximum(f, 0) * self.up[axis] + jnp.minimum(f, 0) * self.down[axis]
        scheme, link = self.on.scheme, self.links[axis]
        if a is None and (scheme.chain.one_way or not scheme.monotone):
            return upwind
        if not scheme.monotone:  # noise is central already: only the drift has slopes of higher order
            # correlated noise may leave a rounding error below zero
            return upwind + jnp.maximum(a, 0) * self.bends[axis] / (link.up + link.down)
        upward, downward = schemes.weights(scheme.chain, f, a, link, self.on.grid, axis)
        return upward * self.up[axis] - downward * self.down[axis]

    def kinks(self, axis: int, a: Any) -> tuple[Sequence[Any], Sequence[Any]]:
        """The drifts along an axis at which the derivative of ``gain`` jumps, and its derivatives between them."""
        scheme, slopes = self.on.scheme, (self.up[axis], self.down[axis])
        if not scheme.monotone or (a is None and scheme.chain.one_way):  # f⁺ P⁺ + f⁻ P⁻ has its kink where f turns
            return (0.0,), slopes[::-1]
        width = 0 if a is None else jnp.maximum(a, 0)
        return schemes.kinks(scheme.chain, width, slopes, self.links[axis], self.on.grid, axis)

    def at(self, u: Action, d: Action) -> Any:
        """H(u, d) at every node, in cost per unit time."""
        a, grid = self.on.diffusion(u, d, self.x), self.on.grid
        first, *others = self.on.drifts(u, d, self.x)
        total = self.on.running_cost(u, d, self.x)
        # axis after axis, so that XLA fuses all of H into one pass over V
        for axis in range(grid.ndim):
            total = total + self.gain(axis, first[axis], correlated_noise.along_axis(a, grid, axis))
            for other in others:
                total = total + self.gain(axis, other[axis], None)
        for (i, j), entry in a.items():
            if i != j:
                total = total + self._diagonal(i, j, entry)
        return jnp.broadcast_to(total, grid.shape)

    def _diagonal(self, i: int, j: int, entry: Any) -> Any:
        """What the jumps along the two diagonals of a pair of axes add for a_ij = ``entry``."""
        grid = self.on.grid
        ends = {
            (p, q): stencil.continued(
                self.value, grid, tuple(p * (k == i) + q * (k == j) for k in range(grid.ndim)), mirror=True
            )
            for p, q in itertools.product((1, -1), repeat=2)
        }
        # for a_ij > 0 the state moves along (1, 1) and (−1, −1), else along (1, −1) and (−1, 1)
        same, opposite = ends[1, 1] + ends[-1, -1], ends[1, -1] + ends[-1, 1]
        scale = 2 * grid.spacing(i) * grid.spacing(j)
        return (
            jnp.maximum(entry, 0) * (same - 2 * self.value) + jnp.maximum(-entry, 0) * (opposite - 2 * self.value)
        ) / scale


def at_rest(on: Discretisation, slopes: jax.Array) -> DiscreteHamiltonian:
    """A Hamiltonian with slopes D⁺ = s_i and D⁻ = −s_i everywhere: H = L + Σ s_i |f_i| and what noise adds.

    With s > 0, shape (n,), its minimum is zero exactly where an action rests at no cost, if the cost is not negative.
    """
    hamiltonian = around(on, jnp.zeros(on.grid.shape, slopes.dtype))
    one = jnp.ones(on.grid.shape, slopes.dtype)
    ups, downs, bends = (tuple(sign * slope * one for slope in slopes) for sign in (1, -1, 2))
    return dataclasses.replace(hamiltonian, up=ups, down=downs, bends=bends)


def around(on: Discretisation, value: jax.Array, lost: jax.Array | None = None) -> DiscreteHamiltonian:
    """Coordinates and differences around ``value``, tied together so that no loop hoists tables out of itself."""
    grid = on.grid
    # without it XLA hoists products of coordinates out of the loop, as arrays of all nodes, one an action
    x, value = jax.lax.optimization_barrier((on.coordinates(), value))
    links = tuple(cut_cells.links(on))
    differences = tuple(stencil.one_sided(value, grid, axis, link) for axis, link in enumerate(links))
    bends = tuple(stencil.bends(*pair, grid, axis) for axis, pair in enumerate(differences))
    slopes = on.scheme.slopes(Differences(on, x, value, links, differences, lost))
    if on.plain is not None:
        slopes = jax.tree.map(lambda first, better: jnp.where(on.plain, first, better), list(differences), list(slopes))
    up, down = zip(*slopes, strict=True)
    # only constrained ends and lost nodes ask what of a drift is rounding, which costs a look at its terms
    careful = lost is not None or grid.sides("constrained")
    slack = tuple(edges.slack(on)) if careful else None
    beside = None if lost is None else edges.beside(lost, grid)
    return DiscreteHamiltonian(on, x, value, up, down, bends, links, slack=slack, lost=beside)


def optimise(hamiltonian: DiscreteHamiltonian, isaacs: str | None = None) -> tuple[jax.Array, Action, Action]:
    """min max of H, or max min, as the problem or ``isaacs`` says: the value, the control and the disturbance."""
    players = players_of(hamiltonian.on)
    if players.disturbance.admissible is None:
        value, u = best_response(hamiltonian, players.control, lambda u: (u, []))
        return value, u, []
    if players.decoupled:  # H is a sum: each optimum is the same whatever the other does, and so any action serves
        start = _any_action(players.disturbance.admissible)
        _, u = best_response(hamiltonian, players.control, lambda u: (u, start))
        value, d = best_response(hamiltonian, players.disturbance, lambda d: (u, d))
        return value, u, d
    if (isaacs or hamiltonian.on.problem.isaacs) == "upper":
        return _nested(hamiltonian, players.control, players.disturbance, lambda u, d: (u, d))
    value, d, u = _nested(hamiltonian, players.disturbance, players.control, lambda d, u: (u, d))
    return value, u, d


def optimum(hamiltonian: DiscreteHamiltonian) -> jax.Array:
    """min max of H, or max min, where nobody asks for the actions: of finitely many none is kept in mind."""
    players = players_of(hamiltonian.on)
    player, admissible = players.control, players.control.admissible
    if players.disturbance.admissible is not None or not isinstance(admissible, Finite):
        return optimise(hamiltonian)[0]
    points = jnp.asarray(admissible.points, hamiltonian.on.dtype)
    return search.optimum(lambda u: hamiltonian.at(u, []), points, player.sign, weight=player.effort)


def best_response(
    hamiltonian: DiscreteHamiltonian, player: Player, join: Callable, most: int = UNROLL
) -> tuple[jax.Array, Action]:
    """One player's optimum against a given action of the other; ``join(mine)`` makes the pair (u, d).

    ``most`` is how many evaluations may be written out, where it samples.
    """
    if player.admissible is None:
        return hamiltonian.at(*join([])), []
    if player.exact:
        action = _exact(hamiltonian, player, join)
    else:
        start = _admissible(hamiltonian, player, join)
        _, action, _ = _sampled(
            hamiltonian, player, lambda action: (hamiltonian.at(*join(action)), []),
            weight=player.effort, most=most, start=start,
        )  # fmt: skip
    if not hamiltonian.bare:
        action = jax.lax.optimization_barrier(action)  # or the search is done twice, for the action and for the value
    return hamiltonian.at(*join(action)), action


def _nested(
    hamiltonian: DiscreteHamiltonian, outer: Player, inner: Player, join: Callable
) -> tuple[jax.Array, Action, Action]:
    """The outer player's optimum, who moves first and knows that the inner one answers."""

    def objective(action):
        return best_response(hamiltonian, inner, lambda reply: join(action, reply), most=INNER)

    if outer.admissible is None:  # a lower game without controls, say: nobody moves first
        value, answer = objective([])
        return value, [], answer
    return _sampled(hamiltonian, outer, objective, weight=inner.weight)


def _admissible(hamiltonian: DiscreteHamiltonian, player: Player, join: Callable) -> Action | None:
    """At constrained ends an action of a sampled control that does not leave, where that can be found exactly."""
    if hamiltonian.slack is None or player.sign < 0:
        return None
    # without the cost H is the gain alone, infinite outside: the least of it is exact where the drift is affine
    free = altered(hamiltonian.on.problem, cost=None)
    alone = players_of(hamiltonian.asking(free).on).control
    return _exact(hamiltonian.asking(free), alone, join) if alone.exact else None


def _sampled(
    hamiltonian: DiscreteHamiltonian,
    player: Player,
    objective: Callable,
    weight: int,
    most: int = UNROLL,
    start: Action | None = None,
) -> Any:
    """The best of samples, refined by a pattern search between them; of finitely many actions the best of all."""
    assert player.admissible is not None
    points = jnp.asarray(sets.samples(player.admissible, SAMPLES), hamiltonian.on.dtype)
    best = enumerate_actions(objective, points, player.sign, weight=weight, most=most)
    if isinstance(player.admissible, Finite):
        return best
    project = _projection(player.admissible)
    # samples may miss a part of the set in which the drift stays inside, or the action of the last step
    if start is not None:
        best = best_of(objective, [start], player.sign, best)
    if hamiltonian.tried is not None:
        best = best_of(objective, [project(hamiltonian.tried[0 if player.sign > 0 else 1])], player.sign, best)
    return refine(objective, best, sets.spacing(player.admissible, SAMPLES), project, player.sign, weight=weight)


def _projection(admissible: Box | Ball) -> Callable[[Action], Action]:
    """The map of an action onto its set: a step of the search may leave it."""
    if isinstance(admissible, Box):
        return lambda action: [jnp.clip(u, admissible.lo[j], admissible.hi[j]) for j, u in enumerate(action)]

    def onto_ball(action):
        shrink = jnp.minimum(1, admissible.radius * inverse_root(sum(u * u for u in action)))
        return [shrink * u for u in action]

    return onto_ball


def _any_action(admissible: AdmissibleSet) -> Action:
    """Some action of the set; zero need not be one."""
    if isinstance(admissible, Ball):
        return [jnp.zeros(())] * admissible.dim
    first = admissible.lo if isinstance(admissible, Box) else admissible.points[0]
    return [first[j] for j in range(admissible.dim)]


def _exact(hamiltonian: DiscreteHamiltonian, player: Player, join: Callable) -> Action:
    """The exact optimum over a box or a ball; see ``piecewise`` for why the candidates suffice."""
    admissible = player.admissible
    assert isinstance(admissible, (Box, Ball))
    problem, dtype = hamiltonian.on.problem, hamiltonian.on.dtype
    # at zero even if that is not admissible: an affine drift is known by its offset and its slopes there
    zero = [jnp.zeros((), dtype)] * admissible.dim
    u, d = join(zero)
    arguments = problem.arguments(hamiltonian.x, u, d, hamiltonian.on.t)
    parts = hamiltonian.on.drifts(u, d, hamiltonian.x)
    # where drifts are upwinded apart, the noise goes with the control's
    part = 0 if player.sign > 0 else len(parts) - 1
    noise = hamiltonian.on.diffusion(u, d, hamiltonian.x) if part == 0 else {}
    slopes = [
        components.components(player.derivative(problem, problem.drift, j), *arguments, dtype=dtype)
        for j in range(admissible.dim)
    ]
    linear, square = zip(
        *(_cost_coefficients(hamiltonian, player, arguments, j) for j in range(admissible.dim)), strict=True
    )

    def piece(i: int, group: Sequence[int]) -> Kinked:
        slope = [slopes[j][i] for j in group]
        return _kinked(hamiltonian, noise, i, parts[part][i], slope[0] if len(group) == 1 else slope)

    if isinstance(admissible, Ball):
        single = [[piece(i, [j]) for i in player.driven[j]] for j in range(admissible.dim)]
        return kinked_ball(player.sign, admissible.radius, linear, [p[0] if p else None for p in single])
    action = list(zero)
    for group in player.groups:
        pieces = [piece(i, group) for i in shared(player.driven, group)]
        lo, hi, slope, bend = ([each[j] for j in group] for each in (admissible.lo, admissible.hi, linear, square))
        curved = any(player.curved[j] for j in group)
        if len(group) == 1:
            found = [piecewise_input(player.sign, lo[0], hi[0], slope[0], bend[0], pieces, curved=curved)]
        else:
            found = piecewise_pair(player.sign, lo, hi, slope, bend, pieces, curved=curved)
        for j, u in zip(group, found, strict=True):
            action[j] = u
    return action


def _cost_coefficients(hamiltonian: DiscreteHamiltonian, player: Player, arguments: tuple, j: int) -> tuple[Any, Any]:
    """l_j and q_j of a cost l_j u + q_j u² + ... by differentiation at zero."""
    cost, none = hamiltonian.on.problem.cost, jnp.zeros((), hamiltonian.on.dtype)
    if cost is None:
        return none, none
    slope = player.derivative(hamiltonian.on.problem, cost, j)
    linear = components.scalar(slope, *arguments, dtype=hamiltonian.on.dtype)
    if not player.curved[j]:  # known to be linear: the second derivative would be traced to find a zero
        return linear, none
    return linear, components.scalar(
        player.derivative(hamiltonian.on.problem, slope, j), *arguments, dtype=hamiltonian.on.dtype
    ) / 2


def _kinked(
    hamiltonian: DiscreteHamiltonian, noise: dict[tuple[int, int], Any], axis: int, offset: Any, slope: Any
) -> Kinked:
    """The gain of one component as a function of an input: offset, slope, and where its derivative jumps."""
    left = correlated_noise.along_axis(noise, hamiltonian.on.grid, axis)
    return Kinked(lambda f: hamiltonian.gain(axis, f, left), offset, slope, *hamiltonian.kinks(axis, left))
