"""The Hamiltonian of a game over cells: H(x, p) = min over u of max over d of G(x, u, d) = L + f·p, or max min.

If G is a polynomial of u plus a polynomial of d, both optima are formulas, and H is known in either order. Two finite
sets are enumerated. In all other games, and at walls, one player commits: with any controls û and d̂ per cell

    H ≥ min over u of G(x, u, d̂),    H ≤ max over d of G(x, û, d),

also in either order. The bounds of the value that follow are those that the players can guarantee.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from hjbjax.enclosure.cell_functions import NOT_QUADRATIC, Cell, gain
from hjbjax.enclosure.minimum import least_over
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import Box, Finite
from hjbjax.tracing import quadratics as qu
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import Interval
from hjbjax.tracing.taylor_forms import Form

RESPONSES = 3  # rounds of best responses that find û and d̂ if G is not separable
INSIDE = 1 - 1e-12  # a committed control is multiplied by this, so that rounding does not take it out of its ball
Stopped = dict[frozenset[int], np.ndarray]  # coordinates whose motion walls may stop, with True where this matters
Table = list[list[qu.Polynomial]]  # G for every listed control of one player, and every one of the other


@dataclasses.dataclass(frozen=True)
class Inputs:
    """The inputs of one player: its listed controls, or its set and the numbers of its inputs in polynomials.

    Attributes:
      points: the controls of a finite set; ``None`` for another set.
      admissible: the set of the inputs of polynomials; ``None`` if there are none.
      first: the number of the first of these inputs.
    """

    points: np.ndarray | None
    admissible: Any
    first: int

    @property
    def numbers(self) -> range:
        """The numbers of the inputs."""
        return range(self.first, self.first + (0 if self.admissible is None else self.admissible.dim))

    @property
    def count(self) -> int:
        """The number of listed controls; one for another set."""
        return 1 if self.points is None else len(self.points)

    def least(self, terms: qu.Polynomial) -> tuple[Form, list[np.ndarray]]:
        """The minimum of a polynomial over the set, and a minimiser at the centre.

        Raises:
          NotQuadraticError: there is no formula.
        """
        if not set().union(*terms) <= set(self.numbers):
            raise qu.NotQuadraticError
        own = qu.Polynomial({tuple(j - self.first for j in term): each for term, each in terms.items()})
        found, _, near = least_over(self.admissible, own)
        return found, [each * INSIDE if hasattr(self.admissible, "radius") else each for each in near]

    def committed(self, terms: qu.Polynomial, action: Sequence[np.ndarray]) -> qu.Polynomial:
        """A polynomial with numbers for the inputs of this player."""
        total = qu.Polynomial()
        for term, each in terms.items():
            factors = [tf.constant(action[j - self.first]) for j in term if j in self.numbers]
            rest = tuple(j for j in term if j not in self.numbers)
            for factor in factors:
                each = each * factor
            total = total + qu.Polynomial({rest: each})
        return total


def inputs_of(problem: Problem) -> tuple[Inputs, Inputs]:
    """The control and the disturbance."""
    found, first = [], 0
    for admissible in (problem.controls, problem.disturbances):
        if isinstance(admissible, Finite):
            found.append(Inputs(np.asarray(admissible.points, float), None, first))
        else:
            found.append(Inputs(None, admissible, first))
        first += len(found[-1].numbers)
    return found[0], found[1]


def game_defect(cell: Cell, rising: Stopped, falling: Stopped) -> tuple[Interval, np.ndarray]:
    """The range of β W − H, and the controls of both players near the saddle at the centre, (count, m + l).

    Args:
      cell: the candidate.
      rising: sets of coordinates that walls may stop, with True where W may increase outward along all of them.
      falling: the same where W may decrease outward.
    """
    try:
        return _game_defect(cell, rising, falling)
    except qu.NotQuadraticError:
        raise ValueError(NOT_QUADRATIC) from None


def _game_defect(cell: Cell, rising: Stopped, falling: Stopped) -> tuple[Interval, np.ndarray]:
    known = cell.functions
    control, disturbance = inputs_of(known.problem)
    whole, count = known.rate * cell.w, disturbance.count

    def table(without: frozenset[int]) -> Table:
        found = [gain(cost, drift, cell.p, without) for cost, drift in known.options]
        return [found[k : k + count] for k in range(0, len(found), count)]

    gains = table(frozenset())
    actions = _near_saddle(gains, control, disturbance)
    policy = _policy(gains, control, disturbance, actions, cell)
    exact = None if rising or falling else _exact(gains, control, disturbance, known.problem.isaacs)
    if exact is not None:
        return (whole - exact).bounds(known.radii), policy

    def committed(stopped: Stopped, sign: int) -> np.ndarray:
        """An upper bound of β W − H if the disturbance commits, or with sign −1 of H − β W if the control does."""
        best: Any = np.inf
        sides = (control, disturbance) if sign > 0 else (disturbance, control)
        tables = {each: table(each) if sign > 0 else _negated(table(each)) for each in (frozenset[int](), *stopped)}
        for j in range(sides[1].count):
            worst: Any = -np.inf
            for without, rows in tables.items():
                least = tf.minimum(*(sides[0].least(sides[1].committed(row[j], actions[sign]))[0] for row in rows))
                most = ((whole if sign > 0 else -whole) - least).bounds(known.radii).hi
                worst = np.maximum(worst, np.where(stopped[without], most, -np.inf) if without else most)
            best = np.minimum(best, worst)
        return best

    return Interval(-committed(falling, -1), committed(rising, 1)), policy


def _negated(rows: Table) -> Table:
    """Minus G, with the players exchanged."""
    return [[-each for each in column] for column in zip(*rows, strict=True)]


def _exact(rows: Table, control: Inputs, disturbance: Inputs, order: str) -> Form | None:
    """H, or ``None`` if there is no formula."""
    if not len(control.numbers) and not len(disturbance.numbers):
        if order == "upper":
            return tf.minimum(*(-tf.minimum(*(-each[()] for each in row)) for row in rows))
        return -tf.minimum(*(-tf.minimum(*(each[()] for each in column)) for column in zip(*rows, strict=True)))
    if len(rows) > 1 or len(rows[0]) > 1:
        return None
    parts = [
        qu.Polynomial({term: each for term, each in rows[0][0].items() if term and set(term) <= set(player.numbers)})
        for player in (control, disturbance)
    ]
    if sum(map(len, parts)) + (() in rows[0][0]) < len(rows[0][0]):
        return None
    least, most = control.least(parts[0])[0], disturbance.least(-parts[1])[0]
    return rows[0][0].get((), tf.constant(0.0)) + least - most


def _near_saddle(rows: Table, control: Inputs, disturbance: Inputs) -> dict[int, list[np.ndarray]]:
    """Numbers for the inputs of the disturbance (key 1) and of the control (key −1), by best responses."""
    found = {1: [np.zeros(()) for _ in disturbance.numbers], -1: [np.zeros(()) for _ in control.numbers]}
    terms = rows[0][0]
    for _ in range(RESPONSES):
        if len(control.numbers):
            found[-1] = control.least(disturbance.committed(terms, found[1]))[1]
        if len(disturbance.numbers):
            found[1] = disturbance.least(-control.committed(terms, found[-1]))[1]
    return found


def _policy(
    rows: Table, control: Inputs, disturbance: Inputs, actions: dict[int, list[np.ndarray]], cell: Cell
) -> np.ndarray:
    """Both controls at the centre, (count, m + l)."""
    shape, order = np.shape(cell.w.range.lo), cell.functions.problem.isaacs

    def value(terms: qu.Polynomial) -> np.ndarray:
        fixed = disturbance.committed(control.committed(terms, actions[-1]), actions[1])
        return np.broadcast_to(fixed.get((), tf.constant(0.0)).centre.lo, shape)

    values = np.stack([[value(each) for each in row] for row in rows])
    if order == "upper":  # the disturbance answers the control
        u = np.argmin(values.max(axis=1), axis=0)
        d = np.argmax(np.take_along_axis(values, u[None, None], axis=0)[0], axis=0)
    else:
        d = np.argmax(values.min(axis=0), axis=0)
        u = np.argmin(np.take_along_axis(values, d[None, None], axis=1)[:, 0], axis=0)
    inputs = [
        player.points[index] if player.points is not None
        else np.stack([np.broadcast_to(each, shape) for each in actions[key]], axis=-1) if actions[key]
        else np.zeros((*shape, 0))
        for player, index, key in ((control, u, -1), (disturbance, d, 1))
    ]  # fmt: skip
    return np.concatenate(inputs, axis=-1)


def by_vertices(cell: Cell) -> Interval | None:
    """The range of −H if G is affine in the inputs of boxes or has finite sets; ``None`` otherwise.

    H is then a minimum, or a saddle, over the vertices. For one vertex of both players G is as smooth as W, so that its
    range is narrower than the range of H near a kink. For all vertices U and D

        min_d max_u sup(−G) ≥ −H ≥ max_u min_d inf(−G).
    """
    known = cell.functions
    rows = [gain(cost, drift, cell.p) for cost, drift in known.options]
    control, disturbance = inputs_of(known.problem)
    corners = [_corners(player) for player in (control, disturbance)]
    if not rows or any(len(term) > 1 for terms in rows for term in terms) or None in corners:
        return None
    lo: Any = []
    hi: Any = []
    for k in range(0, len(rows), disturbance.count):
        for u in corners[0] or []:
            own = [
                disturbance.committed(control.committed(terms, u), d)
                for terms in rows[k : k + disturbance.count] for d in corners[1] or []
            ]  # fmt: skip
            found = [each.get((), tf.constant(0.0)).bounds(known.radii) for each in own]
            lo.append([-each.hi for each in found])
            hi.append([-each.lo for each in found])
    least = np.max(np.stack([np.min(np.stack(np.broadcast_arrays(*row)), axis=0) for row in lo]), axis=0)
    columns = [np.max(np.stack(np.broadcast_arrays(*each)), axis=0) for each in zip(*hi, strict=True)]
    return Interval(least, np.min(np.stack(columns), axis=0))


def _corners(player: Inputs) -> list[list[np.ndarray]] | None:
    """The vertices of a box, one empty list if there are no inputs, or ``None`` for another set."""
    if player.admissible is None:
        return [[]]
    if not isinstance(player.admissible, Box):
        return None
    ends = zip(np.asarray(player.admissible.lo, float), np.asarray(player.admissible.hi, float), strict=True)
    return [[np.asarray(end) for end in each] for each in itertools.product(*ends)]


def subsets(walls: dict[int, np.ndarray]) -> dict[frozenset[int], np.ndarray]:
    """All sets of walls, with True where every wall of the set has the mark."""
    found: dict[frozenset[int], Any] = {frozenset(): True}
    for axis, mark in walls.items():
        found |= {each | {axis}: old & mark for each, old in found.items()}
    del found[frozenset()]
    return found
