"""The exact optimum of the discrete Hamiltonian over a box, a ball or a simplex, from pieces of a problem's functions.

The drift is affine in the player's inputs and the cost quadratic (see ``players``), so derivatives at zero give all
coefficients. From them ``piecewise``, ``ball`` and ``quadratic_program`` find the optimum of each group of inputs.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation import stencil
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.players import Player, shared
from hjbjax.discretisation.stencil import PerNode
from hjbjax.hamiltonian import quadratic_program
from hjbjax.hamiltonian.ball import kinked_ball
from hjbjax.hamiltonian.discrete import DiscreteHamiltonian
from hjbjax.hamiltonian.piecewise import Kinked, piecewise_input, piecewise_pair
from hjbjax.hamiltonian.quadratic_program import Program
from hjbjax.hamiltonian.search import Action
from hjbjax.hamiltonian.simplex import least_in_simplex, project
from hjbjax.problem import sets
from hjbjax.problem.grid import Grid
from hjbjax.problem.sets import Ball, Box, Simplex, refuse_unbounded
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Verdict
from hjbjax.tracing import components

ROUNDING = 16  # rounding units of the total: a smaller remainder of the total counts as zero


@dataclasses.dataclass(frozen=True)
class _Part:
    """One player's part of H: l·u + Σ_jk Q_jk u_j u_k and the gains of the components that it drives.

    Attributes:
      hamiltonian: H, around a value.
      player: the player.
      linear: l_j, per-node scalars.
      quadratic: Q_jk by pairs j <= k, for a product j < k the coefficient of u_j u_k; zeros are left out.
      offsets: the components of the drift without this player.
      slopes: for every input the components of ∂f/∂u_j.
      noise: the entries of a that are included in these gains.
    """

    hamiltonian: DiscreteHamiltonian
    player: Player
    linear: Sequence[PerNode]
    quadratic: dict[tuple[int, ...], PerNode]
    offsets: Sequence[PerNode]
    slopes: Sequence[Any]
    noise: dict[tuple[int, int], Any]

    def square(self, j: int) -> PerNode:
        """Q_jj."""
        return self.quadratic.get((j, j), jnp.zeros((), self.hamiltonian.on.dtype))

    def gain(self, axis: int, group: Sequence[int]) -> Kinked:
        """The gain of one component as a function of some inputs; for one input, its slope is a number per node."""
        left = stencil.noise_along(self.noise, self.hamiltonian.on.grid, axis)
        slope = [self.slopes[j][axis] for j in group]
        return Kinked(
            lambda f: self.hamiltonian.gain(axis, f, left), self.offsets[axis], slope[0] if len(group) == 1 else slope,
            *self.hamiltonian.kinks(axis, left),
        )  # fmt: skip


def exact_optimum(hamiltonian: DiscreteHamiltonian, player: Player, join: Callable) -> Action:
    """One player's optimum over its set against the other's action; ``join(mine)`` makes the pair (u, d)."""
    if isinstance(player.admissible, Simplex) and player.admissible.freedom == 0:
        return [jnp.asarray(player.admissible.total, hamiltonian.on.dtype)]
    part = _part(hamiltonian, player, join)
    action: Action = [jnp.zeros((), hamiltonian.on.dtype)] * len(player.driven)
    if isinstance(player.admissible, Ball) and not any(player.programs):
        return _in_ball(part)
    if isinstance(player.admissible, Simplex):
        return _in_simplex(part)
    for group, program in zip(player.groups, player.programs, strict=True):
        found = _programmed(part, group)[0] if program else _in_box(part, group)
        for j, u in zip(group, found, strict=True):
            action[j] = u
    return action


def optimum_error(hamiltonian: DiscreteHamiltonian, player: Player, join: Callable) -> jax.Array:
    """A bound on the distance of H at the ``exact_optimum`` to the true optimum, (*nodes), in cost per unit time.

    The bound follows from convexity for quadratic programs, and is zero up to rounding if the cost is convex for this
    player. All other optima are exact formulas.
    """
    part = _in_free_inputs(_part(hamiltonian, player, join))
    groups = [group for group, program in zip(part.player.groups, player.programs, strict=True) if program]
    bounds = (_programmed(part, group)[1] for group in groups)
    return sum(bounds, start=jnp.zeros(hamiltonian.value.shape, hamiltonian.on.dtype))


def _part(hamiltonian: DiscreteHamiltonian, player: Player, join: Callable) -> _Part:
    """The coefficients of a player's part of H."""
    assert isinstance(player.admissible, (Box, Ball, Simplex))
    on, count = hamiltonian.on, player.admissible.dim
    # at zero even if zero is not admissible: the offset and slopes there determine an affine drift
    u, d = join([jnp.zeros((), on.dtype)] * count)
    arguments = on.problem.arguments(hamiltonian.x, u, d, on.t)
    parts = on.drifts(u, d, hamiltonian.x)
    # if drifts are upwinded separately, the noise belongs to the control's part
    number = 0 if player.sign > 0 else len(parts) - 1
    noise = on.diffusion(u, d, hamiltonian.x) if number == 0 else {}
    slopes = [
        components.components(player.derivative(on.problem, on.problem.drift, j), *arguments, dtype=on.dtype)
        for j in range(count)
    ]
    linear, quadratic = _cost_coefficients(on, player, arguments)
    # the gain of a jump, of a change of the mode, or of growth is affine in the inputs, like its rate
    problem, grown = on.problem, (hamiltonian.value,)
    gains = (problem.mode_rates, hamiltonian.gaps), (problem.intensities, hamiltonian.landed), (problem.growth, grown)
    for rates, gaps in gains if player.switches else ():
        for j in range(count if gaps and rates is not None else 0):
            found = components.components(player.derivative(problem, rates, j), *arguments, dtype=on.dtype)
            linear[j] = linear[j] + _dot(list(found.reshape(-1)), gaps or ())
    return _Part(hamiltonian, player, linear, quadratic, parts[number], slopes, noise)


def _in_ball(part: _Part) -> Action:
    """The optimum over a ball whose inputs drive one component each."""
    admissible, player = part.player.admissible, part.player
    assert isinstance(admissible, Ball)
    gains = [part.gain(axes[0], [j]) if axes else None for j, axes in enumerate(player.driven)]
    squares = [part.square(j) for j in range(admissible.dim)]
    return kinked_ball(player.sign, admissible.radius, part.linear, squares, gains, curved=any(player.curved))


def _in_box(part: _Part, group: Sequence[int]) -> Action:
    """The optimum over one input of a box, or over two inputs without a product in the cost."""
    admissible, player = part.player.admissible, part.player
    assert isinstance(admissible, Box)
    pieces = [part.gain(i, group) for i in shared(player.driven, group)]
    ends = sets.finite_ends(admissible, part.hamiltonian.on.dtype)
    lo, hi, slope = ([each[j] for j in group] for each in (*ends, part.linear))
    bend, curved = [part.square(j) for j in group], any(player.curved[j] for j in group)
    if len(group) == 1:
        return [piecewise_input(player.sign, lo[0], hi[0], slope[0], bend[0], pieces, curved=curved)]
    return piecewise_pair(player.sign, lo, hi, slope, bend, pieces, curved=curved)


def _in_simplex(part: _Part) -> Action:
    """The optimum over a simplex."""
    admissible, player, (group,) = part.player.admissible, part.player, part.player.groups
    assert isinstance(admissible, Simplex)
    if admissible.freedom > 1 and not player.programs[0]:
        linear, square = ([player.sign * each for each in entries] for entries in _separable(part))
        return list(least_in_simplex(admissible, linear, square))
    if not admissible.at_most:
        found = _in_simplex(_in_free_inputs(part))
        rest = admissible.total - sum(found)
        # rounding of the sum, for which the last input must not be negative
        return [*found, jnp.where(rest > ROUNDING * jnp.finfo(rest.dtype).eps * admissible.total, rest, 0)]
    if player.programs[0]:
        return _programmed(part, group)[0]
    (slope,), (bend,) = _separable(part)
    pieces = [part.gain(i, group) for i in player.driven[0]]
    zero, total = (jnp.asarray(end, part.hamiltonian.on.dtype) for end in (0, admissible.total))
    return [piecewise_input(player.sign, zero, total, slope, bend, pieces, curved=player.curved[0])]


def _separable(part: _Part) -> tuple[list[PerNode], list[PerNode]]:
    """l_j and Q_jj of all inputs."""
    return list(part.linear), [part.square(j) for j in range(len(part.linear))]


def _in_free_inputs(part: _Part) -> _Part:
    """The part of H in all inputs but the last one of a simplex, which is the rest of the total; other sets unchanged.

    The first inputs are nonnegative and have at most this total, so they belong to a simplex of another kind.
    """
    player, admissible = part.player, part.player.admissible
    if not isinstance(admissible, Simplex) or admissible.at_most:
        return part
    total, count = jnp.asarray(admissible.total, part.hamiltonian.on.dtype), admissible.freedom
    last, bends = part.slopes[count], [[_bend(part, j, k) for k in range(count + 1)] for j in range(count + 1)]
    quadratic: dict[tuple[int, ...], PerNode] = {}
    for j, k in itertools.combinations_with_replacement(range(count), 2):
        bend = bends[j][k] - bends[j][count] - bends[count][k] + bends[count][count]
        quadratic[j, k] = bend / 2 if j == k else bend
    curved = bool(part.quadratic)
    driven = tuple(shared(player.driven, (j, count)) for j in range(count))
    reduced = dataclasses.replace(
        player, admissible=Simplex(count, total, at_most=True), driven=driven, groups=(tuple(range(count)),),
        curved=(curved,) * count, products=frozenset(itertools.combinations(range(count), 2) if curved else ()),
    )  # fmt: skip
    return _Part(
        part.hamiltonian,
        reduced,
        # at u = (0, ..., 0, total)
        [
            part.linear[j] - part.linear[count] + total * (bends[j][count] - bends[count][count])
            for j in range(count)
        ],
        quadratic if curved else {},
        [offset + total * slope for offset, slope in zip(part.offsets, last, strict=True)],
        [[slope - other for slope, other in zip(part.slopes[j], last, strict=True)] for j in range(count)],
        part.noise,
    )  # fmt: skip


def _programmed(part: _Part, group: Sequence[int]) -> tuple[Action, jax.Array]:
    """The optimum over a group of inputs as a quadratic program, and a bound on its error."""
    admissible = part.player.admissible
    assert isinstance(admissible, (Box, Ball, Simplex))
    program, axes = _program(part, group, [part.gain(i, group) for i in shared(part.player.driven, group)])
    v, distance = quadratic_program.minimise_quadratic(program, axes, ball=isinstance(admissible, Ball))
    if isinstance(admissible, Ball):
        return [admissible.radius * each for each in v], distance
    if isinstance(admissible, Simplex):
        inside = [jnp.where(each == 1, 1, jnp.where(each == -1, 0, (1 + each) / 2)) for each in v]
        return list(project(admissible, [admissible.total * each for each in inside])), distance
    action = []
    for j, each in zip(group, v, strict=True):
        lo, hi = admissible.lo[j], admissible.hi[j]
        inside = (lo + hi) / 2 + (hi - lo) / 2 * each
        action.append(jnp.where(each == 1, hi, jnp.where(each == -1, lo, inside)))  # the exact bounds at the ends
    return action, distance


def _ends(admissible: Box | Ball | Simplex, group: Sequence[int]) -> tuple[list[Any], list[Any]]:
    """The middle and half the width of each input's range; a ball is the unit ball times its radius."""
    if isinstance(admissible, Simplex):
        return [admissible.total / 2] * len(group), [admissible.total / 2] * len(group)
    if isinstance(admissible, Ball):
        return [0.0] * len(group), [admissible.radius] * len(group)
    pairs = [(admissible.lo[j], admissible.hi[j]) for j in group]
    return [(lo + hi) / 2 for lo, hi in pairs], [(hi - lo) / 2 for lo, hi in pairs]


def _program(part: _Part, group: Sequence[int], gains: Sequence[Kinked]) -> tuple[Program, tuple[int, ...]]:
    """The coefficients of a group's part of H in unit variables, u = middle + half v, and each kink's component."""
    admissible, sign = part.player.admissible, part.player.sign
    assert isinstance(admissible, (Box, Ball, Simplex))
    middle, half = _ends(admissible, group)
    bend = [[sign * _bend(part, j, k) for k in group] for j in group]
    slope = [sign * part.linear[j] + _dot(row, middle) for j, row in zip(group, bend, strict=True)]
    rows, offsets, jumps, sides, axes = [], [], [], [], []
    for axis, gain in zip(shared(part.player.driven, group), gains, strict=True):
        own = gain.slope if len(group) > 1 else [gain.slope]
        start = gain.offset + _dot(own, middle)
        base, found = _jumps(part.hamiltonian.on.grid, axis, gain)
        slope = [s + sign * base * g for s, g in zip(slope, own, strict=True)]
        for kink, jump, side in found:
            rows.append([side * g * h for g, h in zip(own, half, strict=True)])
            offsets.append(side * (start - kink))
            jumps.append(sign * jump)
            sides.append(side)
            axes.append(axis)
    if isinstance(admissible, Simplex):  # Σ u ≤ total as a kink that is a constraint, which belongs to no component
        rows.append([1.0] * len(group))
        offsets.append(len(group) - 2.0)
        jumps.append(jnp.inf)
        sides.append(1)
        axes.append(-1)

    shape, dtype = part.hamiltonian.value.shape, part.hamiltonian.on.dtype

    def stacked(entries: Sequence) -> jax.Array:
        if isinstance(entries, list):
            return jnp.stack([stacked(each) for each in entries])
        return jnp.broadcast_to(jnp.asarray(entries, dtype), shape)

    return Program(
        stacked([s * h for s, h in zip(slope, half, strict=True)]),
        stacked([[b * h * w for b, w in zip(row, half, strict=True)] for row, h in zip(bend, half, strict=True)]),
        stacked(rows) if rows else jnp.zeros((0, len(group), *shape), dtype),
        *(stacked(each) if each else jnp.zeros((0, *shape), dtype) for each in (offsets, jumps, sides)),
    ), tuple(axes)  # fmt: skip


def _jumps(grid: Grid, axis: int, gain: Kinked) -> tuple[PerNode, list[tuple[Any, Any, Any]]]:
    """A gain as base · f + Σ jump max(side (f − kink), 0): the base and the triples (kink, jump, side).

    The base is the smallest slope of all pieces. Next to an unreachable node one slope is huge. As the base it would
    cancel all digits of the others. A piece that leaves through a constrained end has an infinite jump.
    """
    barred = _barred(grid, axis, gain)
    sizes = [jnp.where(out, jnp.inf, jnp.abs(d)) for out, d in zip(barred, gain.derivatives, strict=True)]
    base, number, least = gain.derivatives[0], jnp.zeros((), int), sizes[0]
    for k, (size, derivative) in enumerate(zip(sizes[1:], gain.derivatives[1:], strict=True), start=1):
        base, number = jnp.where(size < least, derivative, base), jnp.where(size < least, k, number)
        least = jnp.minimum(size, least)
    found = []
    for k, kink in enumerate(gain.kinks):
        below, above = gain.derivatives[k], gain.derivatives[k + 1]
        if below is above and not grid.sides("constrained"):
            continue
        jump = jnp.where(barred[k] ^ barred[k + 1], jnp.inf, jnp.where(barred[k], 0, above - below))
        found.append((kink, jump, jnp.where(number <= k, 1, -1)))
    return base, found


def _barred(grid: Grid, axis: int, gain: Kinked) -> list[Any]:
    """For every piece of a gain, the nodes at which its drifts leave through a constrained end, bool."""
    barred: list[Any] = [np.zeros((), bool)] * len(gain.derivatives)
    for _, step in (each for each in grid.sides("constrained") if each[0] == axis):
        edge = stencil.on_edge(grid, axis, step)
        for k, kink in enumerate(gain.kinks):
            piece = k + 1 if step > 0 else k
            barred[piece] = barred[piece] | (edge & (step * kink >= 0))
    return barred


def _bend(part: _Part, j: int, k: int) -> PerNode:
    """∂²L/∂u_j∂u_k."""
    return 2 * part.square(j) if j == k else part.quadratic.get((min(j, k), max(j, k)), 0.0)


def _dot(a: Sequence[PerNode], b: Sequence[PerNode]) -> PerNode:
    """Σ a_j b_j."""
    return sum(p * q for p, q in zip(a, b, strict=True))


def _cost_coefficients(
    on: Discretisation, player: Player, arguments: tuple
) -> tuple[list[Any], dict[tuple[int, ...], Any]]:
    """l_j and Q_jk of a cost l·u + Σ Q_jk u_j u_k + ... by differentiation at zero; zeros of Q are left out."""
    cost, count = on.problem.cost, len(player.driven)
    if cost is None:
        return [jnp.zeros((), on.dtype)] * count, {}
    slopes = [player.derivative(on.problem, cost, j) for j in range(count)]
    linear: list[Any] = [components.scalar(slope, *arguments, dtype=on.dtype) for slope in slopes]
    # second derivatives of a linear input are known to be zero, so do not trace them
    pairs = [(j, j) for j in range(count) if player.curved[j]] + sorted(player.products)
    quadratic: dict[tuple[int, ...], Any] = {
        (j, k): components.scalar(player.derivative(on.problem, slopes[j], k), *arguments, dtype=on.dtype)
        / (2 if j == k else 1)
        for j, k in pairs
    }
    return linear, quadratic


def needs_convexity(on: Discretisation) -> bool:
    """True if a player's optimum is exact only for a cost that is convex for a minimiser, concave for a maximiser."""
    return any(_needs_convexity(player) for player in on.players.both)


def may_miss(on: Discretisation) -> Verdict | bool:
    """True if an optimum that counts as exact may be wrong at a node, because the cost is not convex there."""
    return needs_convexity(on) and _is_concave(on)


def _needs_convexity(player: Player) -> bool:
    """True if a player's optimum over a ball or by quadratic programs has a quadratic cost."""
    quadratic = any(player.curved) or bool(player.products)
    if isinstance(player.admissible, Simplex):
        return player.exact and quadratic and (any(player.programs) or player.admissible.freedom > 1)
    return player.exact and quadratic and (any(player.programs) or isinstance(player.admissible, Ball))


@jax.jit
def _is_concave(on: Discretisation) -> Verdict:
    """True if a cost is not convex for its player at some node, and the optimum requires convexity."""
    players, found = on.players, jnp.zeros((), bool)
    u, d = ([jnp.zeros((), on.dtype)] * len(player.driven) for player in players.both)
    arguments = on.problem.arguments(on.coordinates(), u, d, on.t)
    for player in filter(_needs_convexity, players.both):
        _, quadratic = _cost_coefficients(on, player, arguments)
        for group, program in zip(player.groups, player.programs, strict=True):
            if not program and isinstance(player.admissible, Box):
                continue
            bend = [
                [quadratic.get((min(j, k), max(j, k)), 0.0) * player.sign * (1 + (j == k)) for k in group]
                for j in group
            ]
            if program and isinstance(player.admissible, Simplex) and not player.admissible.at_most:
                # convex along the simplex, as a function of all inputs but the last one
                edge = bend[-1]
                bend = [[b - row[-1] - e + edge[-1] for b, e in zip(row[:-1], edge, strict=False)] for row in bend[:-1]]
            rows = [jnp.stack([jnp.broadcast_to(entry, on.grid.shape) for entry in row]) for row in bend]
            found |= ~jnp.all(quadratic_program.is_convex(jnp.stack(rows)))
    return found


# --- infinite bounds ---


def check_unbounded(on: Discretisation, *, relaxes: bool = False) -> None:
    """Refuse infinite bounds of an input whose optimum is not found by a formula, or may be infinite; host level.

    ``relaxes``: the method needs the largest rate of all actions, as value iteration does.

    Raises:
      ValueError: the optimum is searched, or is a quadratic program; the cost has no positive curvature in the input;
        or the method needs the largest rate.
    """
    if relaxes:
        for admissible in (on.problem.controls, on.problem.disturbances):
            refuse_unbounded(admissible, "ValueIteration()", "its steps divide by the largest rate of all actions")
    for name, player in zip(("controls", "disturbances"), on.players.both, strict=True):
        if not isinstance(player.admissible, Box) or not player.admissible.unbounded:
            continue
        lo, hi = np.asarray(player.admissible.lo), np.asarray(player.admissible.hi)
        inputs = [int(j) for j in np.flatnonzero(np.isinf(lo) | np.isinf(hi))]
        reason = _unanswered(on, player, inputs)
        if reason:
            raise ValueError(
                f"Problem.{name}: got infinite bounds, {player.admissible}, but {reason}.\n"
                "Give finite bounds, or a drift affine and a cost quadratic with positive curvature in the input,\n"
                "without products with other inputs"
            )


def _unanswered(on: Discretisation, player: Player, inputs: list[int]) -> str | None:
    """The reason why the optimum over some inputs needs their bounds; None if there is none."""
    programs = {j for group, program in zip(player.groups, player.programs, strict=True) for j in group if program}
    word = "cost" if player.sign > 0 else "gain of the disturbance"
    if not player.exact or not on.players.exact:
        return "the optimum is searched between the bounds"
    if programs & set(inputs):
        return f"the optimum over input {min(programs & set(inputs))} is a quadratic program with other inputs"
    straight = [j for j in inputs if not player.curved[j]]
    if straight:
        return f"the {word} is affine in input {straight[0]}, so the optimum is infinite"
    with own_settings(x64=True):
        curvature = np.asarray(_curvature(on, player.sign > 0))
    for j in inputs:
        flat = ~(player.sign * curvature[j] > 0)
        if flat.any():
            first = tuple(int(i) for i in np.argwhere(flat)[0])
            return (
                f"the {word} has no curvature in input {j} at {int(flat.sum())} nodes, the first "
                f"x = {np.asarray(on.grid.state(first)).tolist()}"
            )
    return None


@functools.partial(jax.jit, static_argnames="control")
def _curvature(on: Discretisation, control: bool) -> jax.Array:
    """The coefficient of the square of each input of one player in the cost, (m, *grid)."""
    u, d = ([jnp.zeros((), on.dtype)] * len(player.driven) for player in on.players.both)
    player = on.players.control if control else on.players.disturbance
    _, quadratic = _cost_coefficients(on, player, on.problem.arguments(on.coordinates(), u, d, on.t))
    zero = jnp.zeros((), on.dtype)
    return jnp.stack([jnp.broadcast_to(quadratic.get((j, j), zero), on.grid.shape) for j in range(len(player.driven))])
