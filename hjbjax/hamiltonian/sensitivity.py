"""Derivatives of the optimal actions, by the implicit function theorem.

If the optimum over an input z has a closed form, the formula is differentiated: ends of the set, kinks of the upwinding
and stationary points all move as in the formula. If it was searched, and in a game with coupled players, the inputs
that are free at a node satisfy ∂H/∂z = 0, so that

    dz = −(∂²H/∂z²)⁻¹ d(∂H/∂z),

for both players at once. An input is not free if an end of its box or a kink of H holds it. At an end it moves with the
end. At a kink of the upwinding, f = 0 or with central differences |f| = a/h, it moves so that f stays at the kink. On
the rim of a ball, |z| = R, there is also a multiplier λ with ∂H/∂z + λ z = 0. The largest input of a simplex is the
rest of the total, so the others are exchanged for it. Actions from a finite set do not move, nor does an action on
which H does not depend to second order.
"""

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.players import SAMPLES, Player
from hjbjax.hamiltonian import discrete, optimum
from hjbjax.hamiltonian.discrete import DiscreteHamiltonian
from hjbjax.hamiltonian.search import Action
from hjbjax.problem import sets
from hjbjax.problem.sets import Ball, Box, Simplex
from hjbjax.problem.types import Field

# A minimum found by comparing values is off by about the square root of their rounding error. This number
# times ε^{1/4} is 5e-4 of the sample spacing in float64, and 7e-2 in float32. An input that a Newton step would move
# further counts as held.
STATIONARY = 4

Row: TypeAlias = tuple[dict[int, Any], Any]  # of a linear system at every node: entries by column, right-hand side


@dataclasses.dataclass(frozen=True)
class Input:
    """One input of a player with a continuous set of actions.

    Attributes:
      player: the player.
      index: the number of the input.
      pivots: for every input of a simplex, the nodes where it is the rest of the total. A step of another input there
        is an exchange for the pivot, and a step of the pivot changes the sum.
    """

    player: Player
    index: int
    pivots: tuple[Any, ...] = ()

    @property
    def mine(self) -> bool:
        """True for an input of the control, False for one of the disturbance."""
        return self.player.sign > 0

    def entry(self, u: Action, d: Action) -> Any:
        """The value of the input at the nodes."""
        return (u if self.mine else d)[self.index]

    def moved(self, u: Action, d: Action, step: Any) -> tuple[Action, Action]:
        """Both actions after a step of this input."""
        u, d = list(u), list(d)
        action = u if self.mine else d
        for k, pivot in enumerate(self.pivots):
            action[k] -= jnp.where(pivot & ~self.pivots[self.index], step, 0)
        action[self.index] += step
        return u, d

    def slope(self, function: Callable[[Action, Action], Field], u: Action, d: Action) -> Field:
        """∂/∂z of a function that acts node by node."""
        zero = jnp.zeros_like(self.entry(u, d))
        return jax.jvp(lambda step: function(*self.moved(u, d, step)), (zero,), (jnp.ones_like(zero),))[1]

    def close(self) -> Any:
        """A distance within the rounding error of a minimum found by comparing values, in the units of the input."""
        assert self.player.admissible is not None
        width = sets.spacing(self.player.admissible, SAMPLES)[self.index]
        return jax.lax.stop_gradient(STATIONARY * jnp.finfo(jnp.result_type(width)).eps ** 0.25 * width)


@dataclasses.dataclass(frozen=True)
class Optimum:
    """An optimum at every node: the Hamiltonian to differentiate, the same Hamiltonian frozen, and the actions."""

    moving: DiscreteHamiltonian
    frozen: DiscreteHamiltonian
    u: Action
    d: Action


def actions(on: Discretisation, value: Field, lost: jax.Array | None, u: Action, d: Action) -> tuple[Action, Action]:
    """The optimal actions as differentiable functions of a value and of all numbers in ``on``.

    Use the result for its derivatives only. Its numbers may differ from ``u`` and ``d`` by rounding, or because several
    actions are equally good.

    Args:
      on: the problem on its grid.
      value: V, (*grid).
      lost: the nodes to which no action may lead, bool (*grid), or None.
      u, d: the actions that were found, each input (*grid).
    """
    players = on.players
    # the choice of branches is frozen: to first order no node changes its branch
    kept, u, d = jax.lax.stop_gradient(((on, value), list(u), list(d)))
    at = Optimum(discrete.around(on, value, lost), discrete.around(*kept, lost), u, d)
    control, disturbance = players.control, players.disturbance
    # for a coupled min max each optimum moves with the other, so solve for both at once
    if disturbance.admissible is not None and not players.decoupled:
        return _implicit(at, [*_inputs(at, control), *_inputs(at, disturbance)])
    return _alone(at, control, lambda mine: (mine, d))[0], _alone(at, disturbance, lambda mine: (u, mine))[1]


def _alone(at: Optimum, player: Player, join: Callable) -> tuple[Action, Action]:
    """Both actions with the derivatives of one player, whose optimum does not depend on the other's action."""
    if player.exact:
        return join(optimum.best_response(at.moving, player, join)[1])
    return _implicit(at, _inputs(at, player))


def _inputs(at: Optimum, player: Player) -> list[Input]:
    """The inputs that can move by small steps."""
    if isinstance(player.admissible, (Box, Ball, Simplex)):
        pivots = _pivots(player, at) if isinstance(player.admissible, Simplex) else ()
        return [Input(player, j, pivots) for j in range(player.admissible.dim)]
    return []


def _pivots(player: Player, at: Optimum) -> tuple[Any, ...]:
    """For every input of a simplex, the nodes where it is the largest one and the sum is the total, bool."""
    simplex, entries = player.admissible, at.u if player.sign > 0 else at.d
    assert isinstance(simplex, Simplex)
    total, left = jax.lax.stop_gradient(simplex.total), jnp.ones((), bool)
    if simplex.at_most:
        left = sum(entries) >= total - Input(player, 0).close()
    largest, found = functools.reduce(jnp.maximum, entries), []
    for entry in entries:  # the first of equal ones
        found.append(left & (entry == largest))
        left = left & ~found[-1]
    return tuple(found)


def _implicit(at: Optimum, inputs: Sequence[Input]) -> tuple[Action, Action]:
    """Both actions, with derivatives in the entries of ``inputs``."""
    u, d = at.u, at.d
    if not inputs:
        return u, d
    slopes = [each.slope(at.moving.at, u, d) for each in inputs]
    bends = [[b.slope(functools.partial(a.slope, at.frozen.at), u, d) for b in inputs] for a in inputs]
    steps = _solved(_rows(at, inputs, slopes, bends))
    for each, step in zip(inputs, steps, strict=False):  # the multipliers come last
        u, d = each.moved(u, d, step - jax.lax.stop_gradient(step))  # keeps the numbers as they were found
    return u, d


def _rows(at: Optimum, inputs: Sequence[Input], slopes: Sequence[Field], bends: Sequence[Sequence[Field]]) -> list[Row]:
    """The linear system of small steps: one row per input, and one more per ball for its multiplier."""
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
        kinked.append(~ends[a][0] & ~(jnp.abs(slope) < each.close() * jnp.abs(row[a])))  # also True where H is flat
    kinks = _kinks(at, inputs, kinked)
    held = [ended | unsettled for (ended, _), unsettled in zip(ends, kinked, strict=True)]
    for rim in rims.values():  # if a kink holds an input, the rim determines the others
        beside = rim.on & functools.reduce(jnp.logical_or, (kinks.hold(k) for k in rim.entries))
        held = [each & ~beside if k in rim.entries else each for k, each in enumerate(held)]
    rows = [
        kinks.followed(
            a, ({b: jnp.where(held[a], float(a == b), x) for b, x in row.items()}, jnp.where(held[a], end, -g))
        )
        for a, (row, (_, end), g) in enumerate(zip(columns, ends, slopes, strict=True))
    ]
    for place, rim in enumerate(rims.values(), len(inputs)):
        # the rim does not matter if all inputs are held
        free = (~held[k] & ~kinks.hold(k) & (abs(entry) > 0) for k, entry in rim.entries.items())
        on = rim.on & functools.reduce(jnp.logical_or, free)
        around = {k: jnp.where(on, entry, 0) for k, entry in rim.entries.items()} | {place: jnp.where(on, 0.0, 1.0)}
        rows.append((around, jnp.where(on, rim.radius**2 / 2, 0)))
    return rows


def _end(each: Input, entry: Any) -> tuple[Any, Any]:
    """The nodes at which an end of its box, or zero in a simplex, holds an input, and the end."""
    admissible = each.player.admissible
    if isinstance(admissible, Simplex):
        pivot = each.pivots[each.index]
        return pivot | (entry <= each.close()), jnp.where(pivot, admissible.total, 0)  # the pivot moves with the total
    if not isinstance(admissible, Box):
        return jnp.zeros(jnp.shape(entry), bool), jnp.zeros_like(entry)
    lo, hi, close = admissible.lo[each.index], admissible.hi[each.index], each.close()
    low, high = entry <= jax.lax.stop_gradient(lo) + close, entry >= jax.lax.stop_gradient(hi) - close
    return low | high, jnp.where(low, lo, jnp.where(high, hi, 0))


@dataclasses.dataclass(frozen=True)
class Rim:
    """The nodes at which an action is on the rim of its ball, the multiplier, and the action's entries by input."""

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
    """Kinks of the upwinding: the distance of drifts beyond them, its slope in each input, and the inputs they hold."""

    passed: Sequence[Any]  # f, or f ∓ a/h, with derivatives
    slopes: Sequence[Sequence[Any]]  # the ∂/∂z of ``passed``, one row per kink
    holds: Sequence[Sequence[Any]]  # one row per input; a kink holds at most one input of a node

    def hold(self, a: int) -> Any:
        """The nodes at which some kink holds an input, bool."""
        return functools.reduce(jnp.logical_or, self.holds[a], jnp.zeros((), bool))

    def followed(self, a: int, row: Row) -> Row:
        """The row of an input, replaced where a kink holds it so that the drift stays at the kink."""
        columns, side = row
        for beyond, slopes, here in zip(self.passed, self.slopes, self.holds[a], strict=True):
            columns = {b: jnp.where(here, slopes[b] if b < len(slopes) else 0, value) for b, value in columns.items()}
            side = jnp.where(here, -beyond, side)
        return columns, side


def _kinks(at: Optimum, inputs: Sequence[Input], kinked: Sequence[Any]) -> Kinks:
    """The kinks of the components that an input drives; for each player if drifts are upwinded separately."""
    driven = {i for each in inputs for i in each.player.driven[each.index]}
    if callable(at.moving.on.problem.noise):  # a may change with an input that does not drive f
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
    """The distance of the drift along some axes beyond each of the kinks of its gain, (*grid) each."""
    on, found = hamiltonian.on, []
    for number, part in enumerate(on.drifts(u, d)):
        noise = {} if number else on.diffusion(u, d)  # if drifts are upwinded separately, it belongs to the first
        for axis in sorted(axes):
            left = stencil.noise_along(noise, on.grid, axis)
            found += [part[axis] - kink for kink in hamiltonian.kinks(axis, left)[0]]
    return [jnp.broadcast_to(jnp.asarray(beyond, on.dtype), on.grid.shape) for beyond in found]


def _solved(rows: Sequence[Row]) -> list[Any]:
    """The unknowns of a small linear system at every node."""
    right = jnp.stack([side for _, side in rows], axis=-1)
    entries = [[columns.get(b, 0.0) for b in range(len(rows))] for columns, _ in rows]
    # a few unknowns at each of many nodes: batched elimination, or a division for one unknown
    matrix = jnp.stack(
        [jnp.stack([jnp.broadcast_to(entry, right.shape[:-1]) for entry in row], axis=-1) for row in entries], axis=-2
    )
    if len(rows) == 1:
        return [right[..., 0] / matrix[..., 0, 0]]
    return list(jnp.moveaxis(jnp.linalg.solve(matrix, right[..., None])[..., 0], -1, 0))
