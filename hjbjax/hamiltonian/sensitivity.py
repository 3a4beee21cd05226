"""Derivatives of the optimal actions, by the implicit function theorem.

Where the optimum over an input z is found in closed form, its formula is differentiated as it stands: ends of the set,
kinks of the upwinding and stationary points all move as they do there. Where it was searched, and in a game whose
players meet, the inputs that are free at a node satisfy ∂H/∂z = 0, so that

    dz = −(∂²H/∂z²)⁻¹ d(∂H/∂z),

for both players at once. An input is not free where an end of its box or a kink of H holds it: it moves with the end,
and at a kink of the upwinding, f = 0 or with central differences |f| = a/h, so that f stays there. On the rim of a
ball, |z| = R, a multiplier λ joins, with ∂H/∂z + λ z = 0. Among finitely many actions nothing moves, nor where H does
not depend on the action to second order.
"""

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from hjbjax.discretisation import correlated_noise
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.hamiltonian.discrete import DiscreteHamiltonian
from hjbjax.hamiltonian.players import SAMPLES, Player, players_of
from hjbjax.hamiltonian.search import Action
from hjbjax.problem import sets
from hjbjax.problem.sets import Ball, Box
from hjbjax.problem.types import Field

# A minimum found by comparing values is off by the root of their rounding, times a few: so many times ε^{1/4} is 5e-4
# of the distance between two samples in float64, and 7e-2 in float32. What a Newton step would move further is held.
STATIONARY = 4

Row: TypeAlias = tuple[dict[int, Any], Any]  # of a linear system at every node: entries by column, and the right side


@dataclasses.dataclass(frozen=True)
class Input:
    """One input of a player whose actions are a continuum: ``mine`` says whether it is the control's."""

    player: Player
    index: int

    @property
    def mine(self) -> bool:
        """Whether the control sets it, and not the disturbance."""
        return self.player.sign > 0

    def entry(self, u: Action, d: Action) -> Any:
        """Its value at the nodes."""
        return (u if self.mine else d)[self.index]

    def moved(self, u: Action, d: Action, step: Any) -> tuple[Action, Action]:
        """Both actions after a step of this input."""
        u, d = list(u), list(d)
        (u if self.mine else d)[self.index] += step
        return u, d

    def slope(self, function: Callable[[Action, Action], Field], u: Action, d: Action) -> Field:
        """∂/∂z of a function that acts node by node."""
        zero = jnp.zeros_like(self.entry(u, d))
        return jax.jvp(lambda step: function(*self.moved(u, d, step)), (zero,), (jnp.ones_like(zero),))[1]

    def close(self) -> Any:
        """A distance that is rounding of a minimum found by comparing values, in its own units."""
        assert self.player.admissible is not None
        width = sets.spacing(self.player.admissible, SAMPLES)[self.index]
        return jax.lax.stop_gradient(STATIONARY * jnp.finfo(jnp.result_type(width)).eps ** 0.25 * width)


@dataclasses.dataclass(frozen=True)
class Optimum:
    """An optimum at every node: the Hamiltonian as it may be differentiated, the same frozen, and the actions found."""

    moving: DiscreteHamiltonian
    frozen: DiscreteHamiltonian
    u: Action
    d: Action


def actions(on: Discretisation, value: Field, lost: jax.Array | None, u: Action, d: Action) -> tuple[Action, Action]:
    """The optimal actions as differentiable functions of a value and of all that ``on`` holds.

    Their numbers may differ from ``u`` and ``d`` by rounding, and where several actions are worth the same: what is
    meant are the derivatives.

    Args:
      on: the problem on its grid.
      value: V, (*grid).
      lost: the nodes to which no action may lead, bool (*grid), or None.
      u, d: the actions that were found, each input (*grid).
    """
    players = players_of(on)
    # what says which branch holds is frozen: to first order no node goes over to another one
    kept, u, d = jax.lax.stop_gradient(((on, value), list(u), list(d)))
    at = Optimum(discrete.around(on, value, lost), discrete.around(*kept, lost), u, d)
    control, disturbance = players.control, players.disturbance
    # min max of a function that is no sum: where one moves the other's optimum moves, so both are solved for at once
    if disturbance.admissible is not None and not players.decoupled:
        return _implicit(at, [*_inputs(control), *_inputs(disturbance)])
    return _alone(at, control, lambda mine: (mine, d))[0], _alone(at, disturbance, lambda mine: (u, mine))[1]


def _alone(at: Optimum, player: Player, join: Callable) -> tuple[Action, Action]:
    """Both actions with the derivatives of a player's who need not know the other's."""
    if player.exact:
        return join(optimum.best_response(at.moving, player, join)[1])
    return _implicit(at, _inputs(player))


def _inputs(player: Player) -> list[Input]:
    """The inputs that may move by small steps."""
    if isinstance(player.admissible, (Box, Ball)):
        return [Input(player, j) for j in range(player.admissible.dim)]
    return []


def _implicit(at: Optimum, inputs: Sequence[Input]) -> tuple[Action, Action]:
    """Both actions with the derivatives of ``inputs``."""
    u, d = at.u, at.d
    if not inputs:
        return u, d
    slopes = [each.slope(at.moving.at, u, d) for each in inputs]
    bends = [[b.slope(functools.partial(a.slope, at.frozen.at), u, d) for b in inputs] for a in inputs]
    steps = _solved(_rows(at, inputs, slopes, bends))
    for each, step in zip(inputs, steps, strict=False):  # the multipliers come last
        u, d = each.moved(u, d, step - jax.lax.stop_gradient(step))  # the numbers as they were found
    return u, d


def _rows(at: Optimum, inputs: Sequence[Input], slopes: Sequence[Field], bends: Sequence[Sequence[Field]]) -> list[Row]:
    """The linear system of small steps: a row an input, and one more a ball for its multiplier."""
    rims = {mine: _rim(at, inputs, slopes, mine) for mine in (True, False) if _in_ball(inputs, mine)}
    columns, ends, kinked = [], [], []
    for a, each in enumerate(inputs):
        entry, row, slope = each.entry(at.u, at.d), dict(enumerate(bends[a])), jax.lax.stop_gradient(slopes[a])
        if each.mine in rims:
            rim = rims[each.mine]
            slope, row[a] = slope + rim.multiplier * entry, row[a] + rim.multiplier
            row[len(inputs) + list(rims).index(each.mine)] = jnp.where(rim.on, entry, 0)
        columns.append(row)
        ends.append(_end(each, entry))
        kinked.append(~ends[a][0] & ~(jnp.abs(slope) < each.close() * jnp.abs(row[a])))  # also where H is flat
    kinks = _kinks(at, inputs, kinked)
    held = [ended | unsettled for (ended, _), unsettled in zip(ends, kinked, strict=True)]
    for rim in rims.values():  # beside an input that a kink holds the rim holds the others
        beside = rim.on & functools.reduce(jnp.logical_or, (kinks.hold(k) for k in rim.entries))
        held = [each & ~beside if k in rim.entries else each for k, each in enumerate(held)]
    rows = [
        kinks.followed(
            a, ({b: jnp.where(held[a], float(a == b), x) for b, x in row.items()}, jnp.where(held[a], end, -g))
        )
        for a, (row, (_, end), g) in enumerate(zip(columns, ends, slopes, strict=True))
    ]
    for place, rim in enumerate(rims.values(), len(inputs)):
        # the rim says nothing of inputs that are all held
        free = (~held[k] & ~kinks.hold(k) & (abs(entry) > 0) for k, entry in rim.entries.items())
        on = rim.on & functools.reduce(jnp.logical_or, free)
        around = {k: jnp.where(on, entry, 0) for k, entry in rim.entries.items()} | {place: jnp.where(on, 0.0, 1.0)}
        rows.append((around, jnp.where(on, rim.radius**2 / 2, 0)))
    return rows


def _end(each: Input, entry: Any) -> tuple[Any, Any]:
    """The nodes where an end of its box holds an input, and the end there."""
    admissible = each.player.admissible
    if not isinstance(admissible, Box):
        return jnp.zeros(jnp.shape(entry), bool), jnp.zeros_like(entry)
    lo, hi, close = admissible.lo[each.index], admissible.hi[each.index], each.close()
    low, high = entry <= jax.lax.stop_gradient(lo) + close, entry >= jax.lax.stop_gradient(hi) - close
    return low | high, jnp.where(low, lo, jnp.where(high, hi, 0))


@dataclasses.dataclass(frozen=True)
class Rim:
    """Where an action is on the rim of its ball, the multiplier there, and the action's entries by input."""

    on: Any
    multiplier: Any
    entries: dict[int, Any]
    radius: Any


def _in_ball(inputs: Sequence[Input], mine: bool) -> bool:
    return any(each.mine == mine and isinstance(each.player.admissible, Ball) for each in inputs)


def _rim(at: Optimum, inputs: Sequence[Input], slopes: Sequence[Field], mine: bool) -> Rim:
    """The rim of one player's ball: λ = −z·∂H/∂z / |z|²."""
    entries = {k: each.entry(at.u, at.d) for k, each in enumerate(inputs) if each.mine == mine}
    first = inputs[next(iter(entries))]
    assert isinstance(first.player.admissible, Ball)
    radius = first.player.admissible.radius
    size = sum(entry**2 for entry in entries.values())
    on = jnp.sqrt(size) >= jax.lax.stop_gradient(radius) - first.close()
    pull = sum(jax.lax.stop_gradient(slopes[k]) * entry for k, entry in entries.items())
    return Rim(on, jnp.where(on, -pull / jnp.where(on, size, 1), 0), entries, radius)


@dataclasses.dataclass(frozen=True)
class Kinks:
    """Kinks of the upwinding: how far beyond them drifts are, what that is in every input, and where one holds it."""

    passed: Sequence[Any]  # f, or f ∓ a/h, with derivatives
    slopes: Sequence[Sequence[Any]]  # its ∂/∂z, a row a kink
    holds: Sequence[Sequence[Any]]  # a row an input; a kink holds one input of a node at most

    def hold(self, a: int) -> Any:
        """The nodes where some kink holds an input, bool."""
        return functools.reduce(jnp.logical_or, self.holds[a], jnp.zeros((), bool))

    def followed(self, a: int, row: Row) -> Row:
        """The row of an input, which moves so that the drift stays at the kink where one holds it."""
        columns, side = row
        for beyond, slopes, here in zip(self.passed, self.slopes, self.holds[a], strict=True):
            columns = {b: jnp.where(here, slopes[b] if b < len(slopes) else 0, value) for b, value in columns.items()}
            side = jnp.where(here, -beyond, side)
        return columns, side


def _kinks(at: Optimum, inputs: Sequence[Input], kinked: Sequence[Any]) -> Kinks:
    """The kinks of the components that an input drives, of each player by itself where they are upwinded apart."""
    driven = {i for each in inputs for i in each.player.driven[each.index]}
    if callable(at.moving.on.problem.noise):  # a may move with an input that does not drive f
        driven = set(range(at.moving.on.grid.ndim))
    kept = _passed(at.moving, driven, at.u, at.d)

    def kink(k: int, u: Action, d: Action) -> Any:
        return _passed(at.frozen, driven, u, d)[k]

    slopes = [[each.slope(functools.partial(kink, k), at.u, at.d) for each in inputs] for k in range(len(kept))]
    taken = [jnp.zeros(at.moving.on.grid.shape, bool)] * len(kept)
    holds: list[list[Any]] = []
    for a, (each, here) in enumerate(zip(inputs, kinked, strict=True)):
        holds.append([])
        for k, (beyond, slope) in enumerate(zip(kept, slopes, strict=True)):
            near = here & ~taken[k] & (jnp.abs(jax.lax.stop_gradient(beyond)) < each.close() * jnp.abs(slope[a]))
            holds[a].append(near)
            taken[k], here = taken[k] | near, here & ~near
    return Kinks(kept, slopes, holds)


def _passed(hamiltonian: DiscreteHamiltonian, axes: Collection[int], u: Action, d: Action) -> list[Any]:
    """By how much the drift along some axes is beyond each of the kinks of its gain, (*grid) each."""
    on, found = hamiltonian.on, []
    for number, part in enumerate(on.drifts(u, d)):
        noise = {} if number else on.diffusion(u, d)  # where drifts are upwinded apart, it goes with the first
        for axis in sorted(axes):
            left = correlated_noise.along_axis(noise, on.grid, axis)
            found += [part[axis] - kink for kink in hamiltonian.kinks(axis, left)[0]]
    return [jnp.broadcast_to(jnp.asarray(beyond, on.dtype), on.grid.shape) for beyond in found]


def _solved(rows: Sequence[Row]) -> list[Any]:
    """The unknowns of a small linear system at every node."""
    right = jnp.stack([side for _, side in rows], axis=-1)
    entries = [[columns.get(b, 0.0) for b in range(len(rows))] for columns, _ in rows]
    # a few unknowns at each of many nodes: batched elimination, and a division where there is one
    matrix = jnp.stack(
        [jnp.stack([jnp.broadcast_to(entry, right.shape[:-1]) for entry in row], axis=-1) for row in entries], axis=-2
    )
    if len(rows) == 1:
        return [right[..., 0] / matrix[..., 0, 0]]
    return list(jnp.moveaxis(jnp.linalg.solve(matrix, right[..., None])[..., 0], -1, 0))
