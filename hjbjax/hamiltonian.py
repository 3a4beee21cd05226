"""The discrete Hamiltonian and its optimum over the admissible sets.

At a node, for one action of each player,

    H(u, d) = L(x, u, d) + Σ_o c_o(x, u, d) (V(x + o) − V(x)),

written with one-sided differences, so that nothing but the value is read from memory: with D⁺, D⁻ along an
axis the gain of a drift component f is [(e + h⁻ f) D⁺ − (e − h⁺ f) D⁻]/(h⁺ + h⁻). As a function of u it has
kinks where f changes sign (and at |f| = a/h under central differences): minimising it is piecewise.

Exact where the drift is affine in u, the cost separable and quadratic, the noise free of u, and the inputs
drive disjoint sets of components (read from the jaxpr, see ``structure``): all ends, kinks and stationary
points are tried. Otherwise samples and a pattern search, and certificates hold for the refined sample.
"""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from hjbjax import chain, sets, slopes, stencil, structure, subcell
from hjbjax.grid import Grid
from hjbjax.minimisers import Action, Kinked, enumerate_actions, kinked_ball, piecewise_input, refine
from hjbjax.problem import Problem
from hjbjax.schemes import Eno2, Limited, Scheme, Upwind, Weno5
from hjbjax.sets import AdmissibleSet, Ball, Box, Finite

SAMPLES = 33  # points of a continuum before refinement


@dataclasses.dataclass(frozen=True)
class Player:
    """What one player may do and how the Hamiltonian depends on it; static, known from the jaxpr.

    Attributes:
      choices: the admissible set, or None.
      sign: +1 minimises, −1 maximises.
      exact: whether the optimum is found exactly rather than by samples.
      driven: for every input the drift components that it drives.
      curved: for every input whether the cost may hold its square.
    """

    choices: AdmissibleSet | None
    sign: int
    exact: bool
    driven: tuple[tuple[int, ...], ...]
    curved: tuple[bool, ...]

    @property
    def weight(self) -> int:
        """About how many evaluations of H one optimisation takes."""
        if self.choices is None:
            return 1
        if isinstance(self.choices, Finite):
            return len(self.choices.points)
        return 3 if self.exact else SAMPLES


@dataclasses.dataclass(frozen=True)
class Setting:
    """Both players and how they meet.

    Attributes:
      control, disturbance: the players.
      separable: whether drift and cost are sums of what each player does, and noise is neither's.
      decoupled: whether they drive different components as well; then the Isaacs condition holds on every grid.
      disturbance_costs: whether the running cost depends on the disturbance.
    """

    control: Player
    disturbance: Player
    separable: bool
    decoupled: bool
    disturbance_costs: bool

    @property
    def exact(self) -> bool:
        """Whether min (max) over the sets is exact, which certificates need."""
        players = (self.control, self.disturbance)
        return all(player.exact or isinstance(player.choices, (Finite, type(None))) for player in players)


def setting(problem: Problem, n: int, dtype: Any) -> Setting:
    """Read from the problem's functions how the Hamiltonian depends on each player."""
    m = 0 if problem.controls is None else problem.controls.dim
    k = 0 if problem.disturbances is None else problem.disturbances.dim
    time = ((None, False),) * problem.time_dependent
    game = ((k, True),) * problem.is_game
    arguments = (*time, (n, False), (m, True), *game)
    drift = structure.dependence(problem.drift, *arguments, dtype=dtype)
    constant = structure.Dependence((structure.CONSTANT,))
    cost = constant if problem.cost is None else structure.dependence(problem.cost, *arguments, dtype=dtype)
    noise = structure.dependence(problem.noise, *arguments, dtype=dtype) if callable(problem.noise) else constant
    inputs_u, inputs_d = range(m), range(m, m + k)
    mine = _player(problem.controls, 1, inputs_u, drift, cost, noise)
    theirs = _player(problem.disturbances, -1, inputs_d, drift, cost, noise)
    separate = not set(drift.driven_by(inputs_u)) & set(drift.driven_by(inputs_d))
    crossed = any(
        entry is None or any(set(term) & set(inputs_u) and set(term) & set(inputs_d) for term in entry)
        for entry in (*drift.entries, *cost.entries)
    )
    separable = not crossed and noise.is_constant
    return Setting(mine, theirs, separable, separate and separable, not cost.free_of(inputs_d))


def _player(
    choices: AdmissibleSet | None,
    sign: int,
    inputs: range,
    drift: structure.Dependence,
    cost: structure.Dependence,
    noise: structure.Dependence,
) -> Player:
    driven = tuple(drift.driven_by([j]) for j in inputs)
    curved = tuple(cost.has_square([j]) for j in inputs)
    disjoint = all(not set(p) & set(q) for p, q in itertools.combinations(driven, 2))
    suits = drift.affine_in(inputs) and cost.separable_quadratic_in(inputs) and noise.free_of(inputs) and disjoint
    if isinstance(choices, Ball):
        suits = suits and choices.dim <= 3 and not any(curved) and all(len(components) <= 1 for components in driven)
    return Player(choices, sign, suits and isinstance(choices, (Box, Ball)), driven, curved)


@dataclasses.dataclass(frozen=True)
class Local:
    """The Hamiltonian around one value function: coordinates, slopes, and how to evaluate H(u, d).

    Attributes:
      up, down: the slopes that drift sees; D⁺ and D⁻, or those of a scheme of higher order.
      links: the distances to the neighbours along every axis.
      bends: D⁺ − D⁻ along every axis, which noise sees.
    """

    problem: Problem
    grid: Grid
    scheme: Scheme
    dtype: Any
    t: Any
    x: list
    value: jax.Array
    up: tuple[jax.Array, ...]
    down: tuple[jax.Array, ...]
    bends: tuple[jax.Array, ...]
    links: tuple[stencil.Links, ...]

    def gain(self, axis: int, f: Any, a: Any) -> Any:
        """[(e + h⁻ f) D⁺ − (e − h⁺ f) D⁻]/(h⁺ + h⁻); with other slopes f⁺ P⁺ + f⁻ P⁻ + a (D⁺ − D⁻)/(h⁺ + h⁻)."""
        upwind = jnp.maximum(f, 0) * self.up[axis] + jnp.minimum(f, 0) * self.down[axis]
        if a is None:
            return upwind
        link = self.links[axis]
        h_up, h_down = link.up, link.down
        if not isinstance(self.scheme, Upwind):
            return upwind + jnp.maximum(a, 0) * self.bends[axis] / (h_up + h_down)
        e = chain.excess(f, a, self.grid, axis, self.scheme, link)
        upward, downward = (e + h_down * f) / (h_up + h_down), (e - h_up * f) / (h_up + h_down)
        return upward * self.up[axis] - downward * self.down[axis]

    def at(self, u: Action, d: Action) -> Any:
        """H(u, d) at every node, in cost per unit time."""
        d_or_none = d if self.problem.is_game else None
        f = chain.drift(self.problem, self.x, u, d_or_none, self.t, self.dtype)
        a = chain.diffusion(self.problem, self.x, u, d_or_none, self.t, self.dtype)
        total = chain.running_cost(self.problem, self.x, u, d_or_none, self.t, self.dtype)
        for axis in range(self.grid.ndim):
            total = total + self.gain(axis, f[axis], chain.along_axis(a, self.grid, axis))
        for (i, j), entry in a.items():
            if i != j:
                total = total + self._diagonal(i, j, entry)
        return jnp.broadcast_to(total, self.grid.shape)

    def _diagonal(self, i: int, j: int, entry: Any) -> Any:
        ends = {
            (p, q): stencil.neighbour(
                self.value, self.grid, tuple(p * (k == i) + q * (k == j) for k in range(self.grid.ndim))
            )
            for p, q in itertools.product((1, -1), repeat=2)
        }
        same, opposite = ends[1, 1] + ends[-1, -1], ends[1, -1] + ends[-1, 1]
        scale = 2 * self.grid.spacing(i) * self.grid.spacing(j)
        return (
            jnp.maximum(entry, 0) * (same - 2 * self.value) + jnp.maximum(-entry, 0) * (opposite - 2 * self.value)
        ) / scale


def at_rest(problem: Problem, grid: Grid, *, scheme: Scheme, dtype: Any) -> Local:
    """A Hamiltonian with slopes D⁺ = 1 and D⁻ = −1 everywhere: H = L + Σ |f_i| and what noise adds.

    Its minimum is zero exactly where an action rests at no cost, if the cost is not negative.
    """
    here = local(problem, grid, jnp.zeros(grid.shape, dtype), scheme=scheme)
    one = jnp.ones(grid.shape, dtype)
    ups, downs, bends = ((sign * one,) * grid.ndim for sign in (1, -1, 2))
    return dataclasses.replace(here, up=ups, down=downs, bends=bends)


def local(problem: Problem, grid: Grid, value: jax.Array, *, scheme: Scheme, t: Any = 0.0) -> Local:
    """Coordinates and differences around ``value``, tied together so that no loop hoists tables out of itself."""
    x, value = jax.lax.optimization_barrier((grid.components(value.dtype), value))
    links = tuple(subcell.links(problem, grid, subcell=scheme.subcell, dtype=value.dtype, t=t))
    differences = [stencil.one_sided(value, grid, axis, link) for axis, link in enumerate(links)]
    bends = tuple(up - down for up, down in differences)
    if isinstance(scheme, Weno5):
        differences = slopes.weno5(value, grid)
    elif isinstance(scheme, Eno2):
        differences = slopes.eno2(value, grid)
    elif isinstance(scheme, Limited):
        differences = _limited(problem, grid, x, differences, links, t)
    up, down = zip(*differences, strict=True)
    return Local(problem, grid, scheme, value.dtype, t, x, value, up, down, bends, links)


def _limited(problem: Problem, grid: Grid, x: list, differences: list, links: tuple, t: Any) -> list:
    """Limited slopes; central ones where noise keeps those monotone, a_ii ≥ h |f_i| for all actions."""
    found = [stencil.limited(up, down, grid, axis, links[axis]) for axis, (up, down) in enumerate(differences)]
    if problem.noise is None:
        return found
    dtype = differences[0][0].dtype
    calm: list = [True] * grid.ndim
    for u, d in itertools.product(sets.probes(problem.controls, dtype), sets.probes(problem.disturbances, dtype)):
        other = d if problem.is_game else None
        f = chain.drift(problem, x, u, other, t, dtype)
        a = chain.diffusion(problem, x, u, other, t, dtype)
        for axis, link in enumerate(links):
            left = chain.along_axis(a, grid, axis)
            calm[axis] &= left >= jnp.maximum(link.up, link.down) * jnp.abs(f[axis])
    for axis, ((up, down), link) in enumerate(zip(differences, links, strict=True)):
        inner = calm[axis] & ~(stencil.on_edge(grid, axis, 1) | stencil.on_edge(grid, axis, -1))
        middle = (link.down * up + link.up * down) / (link.up + link.down)
        found[axis] = (jnp.where(inner, middle, found[axis][0]), jnp.where(inner, middle, found[axis][1]))
    return found


def optimise(here: Local, how: Setting, isaacs: str | None = None) -> tuple[jax.Array, Action, Action]:
    """min max of H, or max min, as the problem or ``isaacs`` says: the value, the control and the disturbance."""
    if how.disturbance.choices is None:
        value, u = best_response(here, how.control, lambda u: (u, []))
        return value, u, []
    if how.decoupled:
        start = _any_action(how.disturbance.choices)
        _, u = best_response(here, how.control, lambda u: (u, start))
        value, d = best_response(here, how.disturbance, lambda d: (u, d))
        return value, u, d
    if (isaacs or here.problem.isaacs) == "upper":
        return _nested(here, how.control, how.disturbance, lambda u, d: (u, d))
    value, d, u = _nested(here, how.disturbance, how.control, lambda d, u: (u, d))
    return value, u, d


def best_response(here: Local, player: Player, join: Callable) -> tuple[jax.Array, Action]:
    """One player's optimum against a given action of the other; ``join(mine)`` makes the pair (u, d)."""
    if player.choices is None or player.exact:
        action = [] if player.choices is None else _exact(here, player, join)
        return here.at(*join(action)), action
    value, action, _ = _sampled(here, player, lambda action: (here.at(*join(action)), []), weight=1)
    return value, action


def _nested(here: Local, outer: Player, inner: Player, join: Callable) -> tuple[jax.Array, Action, Action]:
    def objective(action):
        return best_response(here, inner, lambda reply: join(action, reply))

    if outer.choices is None:
        value, answer = objective([])
        return value, [], answer
    return _sampled(here, outer, objective, weight=inner.weight)


def _sampled(here: Local, player: Player, objective: Callable, weight: int) -> Any:
    assert player.choices is not None
    points = jnp.asarray(sets.samples(player.choices, SAMPLES), here.dtype)
    best = enumerate_actions(objective, points, player.sign, weight=weight)
    if isinstance(player.choices, Finite):
        return best
    return refine(objective, best, sets.spacing(player.choices, SAMPLES), _projection(player.choices), player.sign)


def _projection(choices: Box | Ball) -> Callable[[Action], Action]:
    if isinstance(choices, Box):
        return lambda action: [jnp.clip(u, choices.lo[j], choices.hi[j]) for j, u in enumerate(action)]

    def onto_ball(action):
        norm = jnp.sqrt(sum(u * u for u in action))
        shrink = jnp.minimum(1, choices.radius / jnp.where(norm == 0, 1, norm))
        return [shrink * u for u in action]

    return onto_ball


def _any_action(choices: AdmissibleSet) -> Action:
    if isinstance(choices, Ball):
        return [jnp.zeros(())] * choices.dim
    first = choices.lo if isinstance(choices, Box) else choices.points[0]
    return [first[j] for j in range(choices.dim)]


def _exact(here: Local, player: Player, join: Callable) -> Action:
    """The exact optimum over a box or a ball; see ``minimisers`` for why the candidates suffice."""
    choices = player.choices
    assert isinstance(choices, (Box, Ball))
    zero = [jnp.zeros((), here.dtype)] * choices.dim
    linear, square, pieces = [], [], []
    for j in range(choices.dim):
        b, slopes = jax.jvp(
            lambda s, j=j: _driven(here, player, join, zero, j, s), (zero[0],), (jnp.ones_like(zero[0]),)
        )
        slope, bend = _cost_coefficients(here, player, join, zero, j)
        linear.append(slope)
        square.append(bend)
        pieces.append([_kinked(here, join(zero), i, b[i], slopes[i]) for i in player.driven[j]])
    if isinstance(choices, Ball):
        return kinked_ball(player.sign, choices.radius, linear, [p[0] if p else None for p in pieces])
    return [
        piecewise_input(
            player.sign, choices.lo[j], choices.hi[j], linear[j], square[j], pieces[j], curved=player.curved[j]
        )
        for j in range(choices.dim)
    ]


def _driven(here: Local, player: Player, join: Callable, zero: Action, j: int, s: Any) -> dict[int, Any]:
    u, d = join([s if k == j else u for k, u in enumerate(zero)])
    f = chain.drift(here.problem, here.x, u, d if here.problem.is_game else None, here.t, here.dtype)
    return {i: f[i] for i in player.driven[j]}


def _cost_coefficients(here: Local, player: Player, join: Callable, zero: Action, j: int) -> tuple[Any, Any]:
    """l_j and q_j of a cost l_j u + q_j u² + ... by differentiation at zero."""
    one = jnp.ones_like(zero[0])

    def cost(s):
        u, d = join([s if k == j else u for k, u in enumerate(zero)])
        return chain.running_cost(here.problem, here.x, u, d if here.problem.is_game else None, here.t, here.dtype)

    def slope(s):
        return jax.jvp(cost, (s,), (one,))[1]

    if not player.curved[j]:
        return slope(zero[0]), jnp.zeros_like(one)
    linear, twice = jax.jvp(slope, (zero[0],), (one,))
    return linear, twice / 2


def _kinked(here: Local, base: tuple[Action, Action], axis: int, offset: Any, slope: Any) -> Kinked:
    u, d = base
    a = chain.diffusion(here.problem, here.x, u, d if here.problem.is_game else None, here.t, here.dtype)
    left = chain.along_axis(a, here.grid, axis)
    up, down = here.up[axis], here.down[axis]

    def gain(f):
        return here.gain(axis, f, left)

    if left is None or not isinstance(here.scheme, Upwind) or not here.scheme.central:
        return Kinked(gain, offset, slope, (0.0,), (down, up))
    h_up, h_down = here.links[axis].up, here.links[axis].down
    edge = stencil.on_edge(here.grid, axis, 1) | stencil.on_edge(here.grid, axis, -1)
    width = jnp.maximum(left, 0)
    middle = (h_down * up + h_up * down) / (h_up + h_down)
    kinks = (jnp.where(edge, 0, -width / h_down), 0.0, jnp.where(edge, 0, width / h_up))
    return Kinked(gain, offset, slope, kinks, (down, jnp.where(edge, down, middle), jnp.where(edge, up, middle), up))
