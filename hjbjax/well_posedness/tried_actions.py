"""The actions to try when only the jumps of an action matter, not its cost.

They are samples of the set, and the actions between them at which a jump vanishes: a set of actions whose jumps all
lead to the right nodes may be thinner than the spacing of the samples.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.players import Player
from hjbjax.problem import sets
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Simplex
from hjbjax.problem.types import Array, Mask
from hjbjax.tracing import components

COMBINATIONS = 32  # largest number of combinations of kinks tried with one action
SAMPLES = 33  # number of samples of a continuum


def control_samples(problem: Problem) -> tuple[Array, int]:
    """Samples of the control, shape (count, m), and the number of those to try first, which often suffice.

    In the first ones every input has its least, middle or greatest value. A problem without a control has one action
    without inputs.
    """
    if problem.controls is None:
        return np.zeros((1, 0)), 1
    points = np.asarray(sets.samples(problem.controls, SAMPLES))
    values = [np.unique(column) for column in points.T]
    outer = np.all([np.isin(c, v[[0, len(v) // 2, -1]]) for c, v in zip(points.T, values, strict=True)], axis=0)
    return np.concatenate([points[outer], points[~outer]]), int(np.sum(outer))


def with_kinks(on: Discretisation, player: Player, action: list) -> list[list]:
    """An action, and copies with some inputs moved to where a component of the drift vanishes; each input (*grid).

    Only there may a jump vanish that all samples make. If the drift is not affine in the inputs there are none. For a
    single input the kinks do not depend on the action; see ``beside_samples``.
    """
    found = [action]
    if not _knows_kinks(on, player) or len(player.driven) == 1:
        return found
    if isinstance(player.admissible, Simplex):
        return found + _exchanged(on, player, action)
    for j, driven in enumerate(player.driven):
        # every input multiplies the count by one plus the number of components it drives: six inputs with one each give
        # 64
        if len(found) * (1 + len(driven)) > COMBINATIONS:
            break
        for base in tuple(found):
            for kink in _kinks(on, player, base, j):
                moved = [kink if k == j else entry for k, entry in enumerate(base)]
                # a kink outside the set is replaced by the sample itself, which changes nothing
                found.append(_where(_contains(player.admissible, moved), moved, base))
    return found


def beside_samples(on: Discretisation, player: Player) -> list[list]:
    """The actions to try once, in addition to all samples; each input (*grid).

    A single input takes the values at which a component of the drift vanishes; for a ball see ``_of_a_ball``.
    """
    if not _knows_kinks(on, player):
        return []
    if isinstance(player.admissible, Simplex):
        return [] if player.admissible.freedom == 0 else _on_edges(on, player.admissible, player)
    found = _of_a_ball(on, player.admissible, player) if isinstance(player.admissible, Ball) else []
    if len(player.driven) > 1:
        return found
    assert isinstance(player.admissible, (Box, Ball))
    some = [jnp.asarray(sets.samples(player.admissible, 1)[0, 0], on.dtype)]
    return found + [_where(_contains(player.admissible, [kink]), [kink], some) for kink in _kinks(on, player, some, 0)]


def _knows_kinks(on: Discretisation, player: Player) -> bool:
    """True if the drift is affine in a control of a box or a ball, without a disturbance."""
    return player.exact and not on.problem.is_game


def _of_a_ball(on: Discretisation, ball: Ball, player: Player) -> list[list]:
    """The actions of a ball in which some inputs let their components vanish and one input is as large as possible.

    Each input u_j drives its own component f_j. Among the actions with given signs of all f_j, the action with the
    largest |f_k| has some inputs S at their kinks, f_S = 0, the other inputs zero, and the remaining radius in u_k.
    """
    none, radius = [jnp.zeros((), on.dtype)] * ball.dim, ball.radius
    # inputs of a ball drive at most one component each, so a kink does not depend on the other inputs
    kinks = [_kinks(on, player, none, j) or [none[j]] for j in range(len(none))]
    found: list[list] = []
    for count in range(len(none)):
        if len(found) >= COMBINATIONS:
            break
        for still in itertools.combinations(range(len(none)), count):
            # the remainder of |u|² ≤ r² for the input that goes furthest
            room = radius**2 - sum((kinks[j][0] ** 2 for j in still), start=none[0])
            for k, way in itertools.product(sorted(set(range(len(none))) - set(still)), (-1, 1)):
                action = [kinks[j][0] if j in still else entry for j, entry in enumerate(none)]
                # at nodes without such an action the room is negative, and its root would be NaN
                action[k] = way * jnp.sqrt(jnp.maximum(room, 0))
                found.append(_where(room >= 0, action, none))
    return found


def _on_edges(on: Discretisation, simplex: Simplex, player: Player) -> list[list]:
    """The actions on the edges of a simplex at which a component vanishes; at other nodes a vertex."""
    found: list[list] = []
    for vertex in np.asarray(sets.extremes(simplex)):
        found += _exchanged(on, player, [jnp.asarray(entry, on.dtype) for entry in vertex])[: COMBINATIONS - len(found)]
    return found


def _exchanged(on: Discretisation, player: Player, action: list) -> list[list]:
    """An action of a simplex with one input exchanged for another, or for the rest of the total, where f_i vanishes."""
    simplex, count, found = player.admissible, len(player.driven), []
    assert isinstance(simplex, Simplex)
    offset = on.drift(action)
    arguments = on.problem.arguments(on.coordinates(), action, None, 0.0)
    slopes = [
        components.components(player.derivative(on.problem, on.problem.drift, j), *arguments, dtype=on.dtype)
        for j in range(count)
    ]
    pairs = [*itertools.combinations(range(count), 2), *((j, count) for j in range(count) if simplex.at_most)]
    for j, k in pairs:  # the last k is the rest of the total
        for i in sorted({*player.driven[j], *(player.driven[k] if k < count else ())}):
            slope = slopes[j][i] - (slopes[k][i] if k < count else 0)
            step = jnp.where(slope != 0, -offset[i] / jnp.where(slope != 0, slope, 1), 0)
            moved = [u + step * (index == j) - step * (index == k) for index, u in enumerate(action)]
            found.append(_where(_contains(simplex, moved), moved, action))
    return found[:COMBINATIONS]


def _kinks(on: Discretisation, player: Player, base: list, j: int) -> list[jax.Array]:
    """The values of input j, each (*grid), at which a component that it drives vanishes, given the other inputs.

    The current value of the input where no component vanishes.
    """
    problem = on.problem
    # f_i is affine in u_j: f_i = offset_i + slope_i u_j vanishes at −offset_i/slope_i
    at_zero = [jnp.zeros((), on.dtype) if k == j else entry for k, entry in enumerate(base)]
    offset = on.drift(at_zero)
    arguments = problem.arguments(on.coordinates(), at_zero, None, 0.0)
    slope = components.components(player.derivative(problem, problem.drift, j), *arguments, dtype=on.dtype)
    return [
        # where a slope vanishes, divide by one and discard the result
        jnp.where(slope[i] != 0, -offset[i] / jnp.where(slope[i] != 0, slope[i], 1), base[j])
        for i in player.driven[j]
    ]


def _where(condition: Mask, action: list, otherwise: list) -> list[jax.Array]:
    """Select one of two actions at each node."""
    return [jnp.where(condition, new, old) for new, old in zip(action, otherwise, strict=True)]


def _contains(admissible: AdmissibleSet | None, action: list) -> Mask:
    """The nodes at which an action is in its box or ball."""
    if isinstance(admissible, Ball):
        return sum(u * u for u in action) <= admissible.radius**2
    if isinstance(admissible, Simplex):
        room = admissible.total * (1 + sets.SLACK) - sum(action)
        return functools.reduce(jnp.logical_and, (u >= 0 for u in action), room >= 0)
    assert isinstance(admissible, Box)  # kinks are used only for exact minima, over these sets
    return functools.reduce(
        jnp.logical_and, ((u >= admissible.lo[j]) & (u <= admissible.hi[j]) for j, u in enumerate(action))
    )
