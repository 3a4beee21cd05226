"""Exact minima of a convex or concave cost plus piecewise linear gains, over one or two inputs; see ``ball`` for balls.

With upwinding the Hamiltonian has this form in the control if the drift is affine in it and the cost is separable and
quadratic: each drift component contributes a gain with a kink where it changes sign. ``sign`` is +1 to minimise and −1
to maximise. All numbers are per-node scalars.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeAlias, TypeVar

import jax
import jax.numpy as jnp

from hjbjax.discretisation.stencil import PerNode
from hjbjax.hamiltonian.search import better

Pair: TypeAlias = Sequence[PerNode]  # one number per node for each of two inputs
Candidate: TypeAlias = tuple[list[jax.Array], jax.Array]  # an action and its value
Slope = TypeVar("Slope")
UNROLLED = 9  # largest number of cells to write out, which is faster than a loop: two gains with two kinks each


class Kinked(Generic[Slope]):
    """A piecewise linear function gain(f) of one drift component f = offset + slope·u, with its kinks in order.

    ``derivatives`` holds the slope of the gain between consecutive kinks, one more than there are kinks. ``slope`` is
    one number per node, or one for each of two inputs.
    """

    def __init__(
        self,
        gain: Callable[[PerNode], PerNode],
        offset: PerNode,
        slope: Slope,
        kinks: Sequence[PerNode],
        derivatives: Sequence[PerNode],
    ):
        self.gain, self.offset, self.slope = gain, offset, slope
        self.kinks, self.derivatives = tuple(kinks), tuple(derivatives)

    def on_line(self: "Kinked[Pair]", point: Pair, direction: Pair) -> "Kinked[PerNode]":
        """The gain along point + t · direction, as a function of one input t."""
        # f = b + G·(point + t direction): only offset and slope change, because kinks are values of f
        at, along = (sum(g * c for g, c in zip(self.slope, vector, strict=True)) for vector in (point, direction))
        return Kinked(self.gain, self.offset + at, along, self.kinks, self.derivatives)


def inverse(number: PerNode) -> jax.Array:
    """1/number, 0 for zero. Slopes vary along few axes, so a product can be fused where a quotient fills an array."""
    zero = number == 0  # the inner where: 1/0 in the unused branch would give NaN derivatives
    return jnp.where(zero, 0, 1 / jnp.where(zero, 1, number))


def inverse_root(number: PerNode) -> jax.Array:
    """1/√number, 0 for zero, with a derivative of zero there."""
    zero = number == 0  # also because the derivative of a root at zero is infinite
    return jnp.where(zero, 0, 1 / jnp.sqrt(jnp.where(zero, 1, number)))


def piecewise_input(
    sign: int,
    lo: PerNode,
    hi: PerNode,
    linear: PerNode,
    square: PerNode,
    pieces: Sequence[Kinked[PerNode]],
    *,
    curved: bool,
) -> jax.Array:
    """The exact optimum over one input u ∈ [lo, hi] of  l u + q u² + Σ_i gain_i(b_i + G_i u).

    Each gain is linear between its kinks, so the optimum is an end, a kink, or the stationary point of one choice of
    pieces, clipped to [lo, hi]. All are tried, including choices that no u makes, so kinks may coincide. Concave pieces
    and G_i = 0 need no special treatment: every candidate is admissible and is compared by its own value.

    Args:
      sign: +1 to minimise, −1 to maximise.
      lo, hi: the bounds of the input.
      linear, square: l and q, per-node scalars.
      pieces: the gains that this input drives.
      curved: True if q may differ from zero.
    """

    def total(u: PerNode) -> PerNode:
        value = linear * u + square * u * u if curved else linear * u
        return sum((piece.gain(piece.offset + piece.slope * u) for piece in pieces), start=value)

    candidates = [lo, hi]
    for piece in pieces:  # where b + G u meets a kink; with G = 0 the candidate is 0, clipped, which is harmless
        candidates += [jnp.clip((kink - piece.offset) * inverse(piece.slope), lo, hi) for kink in piece.kinks]
    if curved:
        # 0 = l + 2 q u + Σ G_i d_i for each choice of one piece per gain: with K kinks there are (K + 1)^pieces choices
        for choice in itertools.product(*(piece.derivatives for piece in pieces)):
            slope = linear + sum(piece.slope * d for piece, d in zip(pieces, choice, strict=True))
            candidates.append(jnp.clip(-slope * inverse(2 * square), lo, hi))
    # compare by the objective, which does not require the choice of pieces that a candidate belongs to
    best: Candidate = [jnp.asarray(candidates[0])], jnp.asarray(total(candidates[0]))
    for u in candidates[1:]:
        best = _better_of(sign, ([jnp.asarray(u)], total(u)), best)
    return best[0][0]


def piecewise_pair(
    sign: int,
    lo: Pair,
    hi: Pair,
    linear: Pair,
    square: Pair,
    pieces: Sequence[Kinked[Pair]],
    *,
    curved: bool,
) -> list[jax.Array]:
    """The exact optimum over two inputs of  l·u + q₁u₁² + q₂u₂² + Σ_i gain_i(b_i + G_i·u)  in a box.

    Every kink of a gain is a line. These lines divide the box into cells, and the objective is one quadratic in each
    cell. Its optimum in a cell is its stationary point, or is on the boundary, that is on a side of the box or on a
    line, where the problem has a single input. All are tried; every candidate is admissible and compared by its own
    value.

    Args:
      sign: +1 to minimise, −1 to maximise.
      lo, hi: the bounds of the two inputs.
      linear, square: l and q for both, per-node scalars.
      pieces: the gains; their slopes are pairs.
      curved: True if a q may differ from zero.
    """

    def clipped(u: Pair) -> list[jax.Array]:
        return [jnp.clip(v, low, high) for v, low, high in zip(u, lo, hi, strict=True)]

    def total(u: Pair) -> PerNode:
        terms = [b * v + c * v * v if curved else b * v for b, c, v in zip(linear, square, u, strict=True)]
        return sum(
            (p.gain(p.offset + p.slope[0] * u[0] + p.slope[1] * u[1]) for p in pieces), start=terms[0] + terms[1]
        )

    cells = list(itertools.product(*(piece.derivatives for piece in pieces))) if curved else []

    def best_on_line(
        point: Pair, direction: Pair, ends: tuple[PerNode, PerNode], others: Sequence[Kinked[Pair]]
    ) -> list[jax.Array]:
        # l·(x + t v) + Σ q (x + t v)² has the slope Σ (l + 2 q x) v at t = 0 and the coefficient Σ q v² of t²
        slope = sum((b + 2 * c * x) * v for b, c, x, v in zip(linear, square, point, direction, strict=True))
        bend = sum(c * v * v for c, v in zip(square, direction, strict=True))
        restricted = [piece.on_line(point, direction) for piece in others]
        t = piecewise_input(sign, *ends, slope, bend, restricted, curved=curved)
        # the line of a kink may miss the box, and rounding may move a point out of it, so clip
        return clipped([x + t * v for x, v in zip(point, direction, strict=True)])

    def in_cell(derivatives: Sequence[PerNode]) -> list[jax.Array]:
        slopes = [  # the inputs decouple within a cell, where the gains are linear and the cost is separable
            b + sum(piece.slope[j] * d for piece, d in zip(pieces, derivatives, strict=True))
            for j, b in enumerate(linear)
        ]
        return clipped([-s * inverse(2 * c) for s, c in zip(slopes, square, strict=True)])

    def on_kink(index: int, kink: PerNode) -> list[jax.Array]:
        # on its own line a gain is constant and drops out
        others = [other for k, other in enumerate(pieces) if k != index]
        point, direction = _kink_line(pieces[index], kink)
        return best_on_line(point, direction, _within(point, direction, lo, hi), others)

    def on_side(side: tuple) -> list[jax.Array]:
        point, direction, ends = side
        return best_on_line(point, direction, ends, pieces)

    # the four sides of the box, the kinks' lines, and the cells
    sides: list[tuple] = [((0.0, bound), (1.0, 0.0), (lo[0], hi[0])) for bound in (lo[1], hi[1])]
    sides += [((bound, 0.0), (0.0, 1.0), (lo[1], hi[1])) for bound in (lo[0], hi[0])]
    if len(cells) > UNROLLED:
        corner = clipped([lo[0], lo[1]])
        best: Candidate = corner, jnp.asarray(total(corner))
        # one computation for all lines, including the line of the gain itself, along which this gain is constant
        lines = [_kink_line(piece, kink) for piece in pieces for kink in piece.kinks]
        sides += [(tuple(point), tuple(way), _within(point, way, lo, hi)) for point, way in lines]
        for candidate, entries in ((on_side, sides), (in_cell, cells)):
            best = _best_in_loop(sign, total, candidate, entries, best)
        return best[0]
    found = [on_side(side) for side in sides]
    found += [on_kink(index, kink) for index, piece in enumerate(pieces) for kink in piece.kinks]
    found += [in_cell(cell) for cell in cells]
    best = found[0], jnp.asarray(total(found[0]))
    for u in found[1:]:
        best = _better_of(sign, (u, total(u)), best)
    return best[0]


def _better_of(sign: int, new: tuple[list[jax.Array], PerNode], old: Candidate) -> Candidate:
    """The better of two candidates with their values, node by node."""
    wins = better(sign, new[1], old[1])
    return [jnp.where(wins, a, b) for a, b in zip(new[0], old[0], strict=True)], jnp.where(wins, new[1], old[1])


def _best_in_loop(
    sign: int, total: Callable[[list], PerNode], candidate: Callable, entries: Sequence, best: Candidate
) -> Candidate:
    """The best of one candidate and of others with the same computation, in a loop, so that it is compiled once.

    Central differences of two components have three kinks each, which makes 166 candidates. XLA takes minutes to
    compile a program in which all of them are written out.
    """
    shape = jax.eval_shape(lambda: jnp.asarray(total(candidate(entries[0])))).shape
    value = jnp.broadcast_to(best[1], shape)
    u = [jnp.broadcast_to(each, value.shape).astype(value.dtype) for each in best[0]]

    def wide(entry: PerNode) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(entry, value.dtype), value.shape)

    def turn(best: Candidate, entry: Any) -> tuple[Candidate, None]:
        u = [wide(each) for each in candidate(entry)]
        return _better_of(sign, (u, wide(total(u))), best), None

    stacked = jax.tree.map(lambda *each: jnp.stack([wide(one) for one in each]), *entries)
    return jax.lax.scan(turn, (u, value), stacked)[0]


def _kink_line(piece: Kinked[Pair], kink: PerNode) -> tuple[Pair, Pair]:
    """A point and a unit direction of the line b + G·u = kink; the origin and a zero direction if G = 0."""
    g1, g2 = piece.slope
    # unit length, so that t is a distance in the box for any units of G
    shrink = inverse_root(g1 * g1 + g2 * g2)
    g1, g2 = g1 * shrink, g2 * shrink
    away = (kink - piece.offset) * shrink
    return [away * g1, away * g2], [-g2, g1]


def _within(point: Pair, direction: Pair, lo: Pair, hi: Pair) -> tuple[jax.Array, jax.Array]:
    """The range of t in which point + t · direction is in the box; a line that misses the box has one t."""
    first: PerNode = -jnp.inf
    last: PerNode = jnp.inf
    for x, v, low, high in zip(point, direction, lo, hi, strict=True):
        moves = v != 0  # a line along the other axis is only bounded by that axis
        ends = [(bound - x) * inverse(v) for bound in (low, high)]
        first = jnp.maximum(first, jnp.where(moves, jnp.minimum(*ends), -jnp.inf))
        last = jnp.minimum(last, jnp.where(moves, jnp.maximum(*ends), jnp.inf))
    # a zero direction, where G = 0, leaves both ends infinite: use t = 0
    first = jnp.where(jnp.isfinite(first), first, 0)
    return first, jnp.maximum(first, jnp.where(jnp.isfinite(last), last, 0))
