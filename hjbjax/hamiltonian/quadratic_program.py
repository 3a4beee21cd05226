"""Exact minima over a box or a ball of a convex quadratic plus gains with kinks, for any number of inputs.

In unit variables, v in [-1, 1]^m or |v| <= 1, the objective at a node is

    J(v) = l·v + v·Pv/2 + sum_k jump_k max(a_k·v + c_k, 0),

with one term per kink of a gain. A kink is convex or concave according to the sign of its jump.

- Concave kinks: min(0, jump (a·v + c)) is the smaller of two affine functions, and minima commute. Every choice is
  tried, even if v is then on the other side of the kink. A component with c concave kinks has c + 1 choices.
- Convex kinks: jump max(a·v + c, 0) is the maximum of s (a·v + c) over 0 <= s <= jump, so that each choice is a convex
  program. A primal-dual interior-point method solves it for all nodes at once in 15 to 25 steps. Newton steps on the
  active set follow; they put inputs on their bounds and drifts on their kinks up to rounding.

Convexity gives a lower bound on every program, from its multipliers s and the gradient g at v,

    J >= l·v + v·Pv/2 + s·(Av + c) + min_w g·(w − v),    g = l + Pv + A's,

so the distance of J(v) to the minimum is bounded at every node, even if the iteration did not converge.

If P is not positive semidefinite, a diagonal D makes P + D positive semidefinite. The concave rest, −D v²/2, is
replaced by a tangent at an end of its input, and both ends are tried, then by tangents at the best point. The result
may be a local minimum. The lower bound uses the chord, −D/2.

Derivatives come from the optimality conditions with a fixed active set.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import altered, pytree_dataclass

STEPS = 40  # interior-point steps; most nodes need 15, and the slowest of 100,000 random ones needed 27
POLISH = 3  # Newton steps on the active set: the penalty makes each multiply the error by the square root of rounding
CLOSE = 16  # units of rounding of the largest coefficient at which a node has converged
DESCENTS = 12  # convex programs with tangents at the best point, if a cost is not convex
TANGENTS = 256  # the largest number of choices of tangents and kinks to try
PENALTY = 0.4  # a jump of ε^(−0.4) times the largest slope represents a constraint: 2e6 in float64
NODES = 1 << 14  # nodes per pass, each of which needs about a hundred numbers


@pytree_dataclass()
class Program:
    """The coefficients of J at the nodes, in unit variables.

    Args:
      slope: l, (m, *nodes).
      bend: P, (m, m, *nodes).
      rows: a_k, (K, m, *nodes).
      offsets: c_k, (K, *nodes).
      jumps: (K, *nodes), of either sign; infinite if the kink is a constraint, a_k·v + c_k <= 0.
      sides: (K, *nodes), 1 if a_k·v + c_k increases with the component of the kink, −1 if it decreases.
    """

    slope: jax.Array
    bend: jax.Array
    rows: jax.Array
    offsets: jax.Array
    jumps: jax.Array
    sides: jax.Array


class Point(NamedTuple):
    """A primal-dual point.

    Attributes:
      v: (m, ...).
      s: the multipliers of the kinks, (K, ...).
      slack: the quantities that must not be negative, 1 + v and 1 − v, or (1 − |v|²)/2, and jump − s and s, (S, ...).
        They are separate variables because 1 − v close to zero would have no correct digits.
      dual: their multipliers, (S, ...).
    """

    v: jax.Array
    s: jax.Array
    slack: jax.Array
    dual: jax.Array


class Best(NamedTuple):
    """The best point so far, J there, the concave kinks whose affine part it uses, and the smallest lower bound."""

    point: Point
    value: jax.Array
    on: jax.Array
    bound: jax.Array


def minimise_quadratic(program: Program, axes: tuple[int, ...], *, ball: bool) -> tuple[jax.Array, jax.Array]:
    """The minimum at every node.

    Args:
      program: the coefficients.
      axes: the component of every kink; the kinks of one component are consecutive and in order.
      ball: True for |v| <= 1, False for [-1, 1]^m.

    Returns:
      v, (m, *nodes), and a bound on J(v) minus the minimum, (*nodes), in the units of J; only v has derivatives.
    """
    shape = program.slope.shape[1:]
    flat = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[: leaf.ndim - len(shape)], -1), program)
    solve = functools.partial(_least, axes, ball)
    count = flat.slope.shape[1]
    if count <= NODES:
        v, missed = solve(flat)
    else:
        parts = -(-count // NODES)
        each = -(-count // parts)

        def split(leaf: jax.Array) -> jax.Array:
            fill = [(0, 0)] * (leaf.ndim - 1) + [(0, parts * each - count)]
            return jnp.moveaxis(jnp.pad(leaf, fill, mode="edge").reshape(*leaf.shape[:-1], parts, each), -2, 0)

        v, missed = jax.lax.map(solve, jax.tree.map(split, flat))
        v = jnp.moveaxis(v, 0, -2).reshape(v.shape[1], -1)[:, :count]
        missed = missed.reshape(-1)[:count]
    return v.reshape(-1, *shape), missed.reshape(shape)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _least(axes: tuple[int, ...], ball: bool, program: Program) -> tuple[jax.Array, jax.Array]:
    """``minimise_quadratic`` on flat nodes."""
    scaled, size, _, _ = _scaled(program, ball)
    best = _best(scaled, axes, ball)
    return best.point.v, size * jnp.maximum(best.value - best.bound, 0)


@_least.defjvp
def _derivative(axes: tuple[int, ...], ball: bool, primals: tuple, tangents: tuple) -> tuple:
    """dv by the optimality conditions: inputs on a bound or at a kink stay there, the others stay stationary."""
    (program,), (moves,) = primals, tangents
    scaled, size, width, met = _scaled(program, ball)
    best = _best(scaled, axes, ball)
    (v, s, slack, dual), stiff = best.point, _stiffness(best.value.dtype)
    # the changes in the units of the scaled program, which are constants
    slope, bend, rows, offsets = (
        moves.slope / size, moves.bend / size, moves.rows / width[:, None], moves.offsets / width,
    )  # fmt: skip
    jumps = jnp.where(jnp.isinf(program.jumps), 0, moves.jumps * width / size)
    # a kink that is met and convex has a multiplier; any other kink is an affine term or zero, by choice or everywhere
    convex = met & (scaled.jumps > 0)
    affine = best.on | (~met & (program.offsets / width >= 1))
    whole = jnp.where(jnp.isinf(program.jumps), 0, program.jumps * width / size)
    pull = slope + _times(bend, v) + _back(rows, jnp.where(affine, whole, jnp.where(convex, s, 0)))
    pull = pull + _back(program.rows / width[:, None], jnp.where(affine, jumps, 0))
    beside = jnp.where(convex, jnp.sum(rows * v, 1) + offsets, 0)
    active, kinks = dual > slack, len(s)
    room = jnp.where(convex, jumps, 0)  # a slack jump − s moves with the jump
    place = slice(len(slack) - 2 * kinks, len(slack) - kinks)
    aim = jnp.zeros_like(slack).at[place].set(-stiff * jnp.where(active[place], room, 0))
    held = _convexified(scaled)[0]
    change = _newton(
        held, best.point, (pull, beside, jnp.zeros_like(slack[:1])), jnp.where(active, stiff, 0), aim, ball
    )
    ends = jnp.zeros(v.shape, bool) if ball else active[: len(v)] | active[len(v) : 2 * len(v)]
    distance = size * jnp.maximum(best.value - best.bound, 0)
    return (v, distance), (jnp.where(ends, 0, change.v), jnp.zeros_like(distance))


def is_convex(bend: jax.Array) -> jax.Array:
    """True at the nodes at which a symmetric matrix (m, m, *nodes) is positive semidefinite up to rounding."""
    size = jnp.max(jnp.abs(bend), (0, 1))
    rounding = CLOSE * jnp.finfo(bend.dtype).eps * size
    left, sound = bend, jnp.ones(bend.shape[2:], bool)
    rest = jnp.ones(bend.shape[1:], bool)
    # the pivots of an elimination, the largest first, so that rounding does not grow if the matrix is singular; if one
    # is zero, the rest of its row must be zero
    for _ in range(len(bend)):
        own = jnp.where(rest, jnp.stack([left[j, j] for j in range(len(bend))]), -jnp.inf)
        first = jnp.argmax(own, 0) == jnp.arange(len(bend)).reshape(-1, *(1,) * (bend.ndim - 2))
        pivot, row = jnp.max(own, 0), jnp.where(rest, jnp.sum(jnp.where(first[:, None], left, 0), 0), 0)
        rest = rest & ~first
        flat = pivot <= rounding
        sound &= (pivot >= -rounding) & (~flat | (jnp.max(jnp.abs(row), 0) <= jnp.sqrt(rounding * size) + rounding))
        left = left - jnp.where(flat, 0, row[:, None] * row[None] / jnp.where(flat, 1, pivot))
    return sound


def _scaled(program: Program, ball: bool) -> tuple[Program, jax.Array, jax.Array, jax.Array]:
    """The program in units in which the rows have range one and the largest slope is one, with these units.

    A kink that no v meets is an affine term or zero. A convex kink far away replaces it, with a row of zeros.

    Returns:
      The program, its unit of J (*nodes), its units of the rows (K, *nodes), and a mask of the kinks that some v meets.
    """
    width = jnp.sqrt(jnp.sum(program.rows**2, 1)) if ball else jnp.sum(jnp.abs(program.rows), 1)
    width = jnp.where(width > 0, width, 1)
    rows, offsets, jumps = program.rows / width[:, None], program.offsets / width, program.jumps * width
    endless = jnp.isinf(jumps)
    jumps = jnp.where(endless, 0, jumps)
    slope = program.slope + _back(rows, jnp.where(offsets >= 1, jumps, 0))
    # a constraint may be satisfied on the boundary only, or at no v; then its violation is the least possible
    met = ((jnp.abs(offsets) < 1) | (endless & (offsets >= 1))) & jnp.any(rows != 0, 1)
    size = jnp.maximum(jnp.max(jnp.abs(slope), 0), jnp.max(jnp.abs(program.bend), (0, 1)))
    size = jnp.maximum(size, jnp.max(jnp.where(met & (jumps < 0), -jumps, 0), 0, initial=0))
    # a convex jump is at most a constraint, and may be huge next to an unreachable node, so the rest sets the unit
    size = jnp.where(size > 0, size, jnp.max(jnp.where(met, jumps, 0), 0, initial=0))
    size = jnp.where(size > 0, size, 1)
    most = jnp.finfo(slope.dtype).eps ** -PENALTY
    jumps = jnp.where(endless, jnp.sign(program.jumps) * most, jnp.minimum(jumps / size, most))
    # a jump below rounding changes nothing, and its multiplier would have no room
    met &= jnp.abs(jumps) > jnp.finfo(slope.dtype).eps ** 2
    made = Program(
        slope / size, program.bend / size, jnp.where(met[:, None], rows, 0), jnp.where(met, offsets, -1),
        jnp.where(met, jumps, 1), program.sides,
    )  # fmt: skip
    return made, size, width, met


def _convexified(program: Program) -> tuple[Program, jax.Array]:
    """The program without concave terms, P + D instead of P, and D (m, ...)."""
    shift = jnp.where(is_convex(program.bend), 0, _shift(program.bend))
    concave = program.jumps < 0
    return altered(
        program,
        bend=program.bend + jnp.eye(len(shift), dtype=shift.dtype)[:, :, None] * shift[:, None],
        rows=jnp.where(concave[:, None], 0, program.rows),
        offsets=jnp.where(concave, -1, program.offsets),
        jumps=jnp.where(concave, 1, program.jumps),
    ), shift


def _best(program: Program, axes: tuple[int, ...], ball: bool) -> Best:
    """The best point over all choices of concave terms."""
    convex, shift = _convexified(program)
    concave, steep = program.jumps < 0, shift > 0

    def one(carry: tuple[jax.Array, Best]) -> tuple[jax.Array, Best]:
        number, best = carry
        on, ends = _choice(number, concave, program.sides, steep, axes)
        # after the last choice, use tangents at the best point so far
        on, ends = jnp.where(number < count, on, best.on), jnp.where(number < count, ends, best.point.v)
        affine = jnp.where(on, program.jumps, 0)
        known = program.slope + _back(program.rows, affine)
        point = _solved(altered(convex, slope=known - shift * ends), ball)
        # the lower bound of this choice, with the chord −D/2 instead of the tangent
        g = known + _times(convex.bend, point.v) + _back(convex.rows, point.s)
        reach = jnp.sqrt(jnp.sum(g * g, 0)) if ball else jnp.sum(jnp.abs(g), 0)
        bound = -reach - jnp.sum(point.v * _times(convex.bend, point.v), 0) / 2
        bound += jnp.sum(point.s * convex.offsets + affine * program.offsets, 0) - jnp.sum(shift, 0) / 2
        here = _value(program, point.v)
        wins = here < best.value
        kept = jax.tree.map(lambda new, old: jnp.where(wins, new, old), Best(point, here, on, bound), best)
        return number + 1, kept._replace(bound=jnp.minimum(bound, best.bound))

    count = jnp.ones(concave.shape[1:], jnp.int32)
    for group in _groups(axes):
        count *= 1 + sum(concave[k].astype(jnp.int32) for k in group)
    for each in steep:
        count = jnp.where(each & (count <= TANGENTS // 2), 2 * count, count)
    endless, slacks = jnp.full_like(program.slope[0], jnp.inf), (1 if ball else 2 * len(shift)) + 2 * len(axes)
    empty = (jnp.zeros((rows, *endless.shape), endless.dtype) for rows in (len(shift), len(axes), slacks, slacks))
    start = Best(Point(*empty), endless, jnp.zeros(concave.shape, bool), endless)
    most = jnp.max(jnp.where(jnp.any(steep, 0), count + DESCENTS, count))
    return jax.lax.while_loop(lambda carry: carry[0] < most, one, (jnp.zeros((), jnp.int32), start))[1]


def _groups(axes: tuple[int, ...]) -> list[list[int]]:
    """The kinks of every component."""
    return [[k for k, axis in enumerate(axes) if axis == each] for each in sorted(set(axes))]


def _choice(
    number: jax.Array, concave: jax.Array, sides: jax.Array, steep: jax.Array, axes: tuple[int, ...]
) -> tuple[jax.Array, jax.Array]:
    """The concave kinks whose affine part is used, bool (K, ...), and the ends of the tangents, (m, ...), −1 or 1.

    A digit of ``number`` is the number of concave kinks of one component that are below the drift. The affine part is
    used for kinks with side 1 below the drift, and for kinks with side −1 above it.
    """
    left = jnp.broadcast_to(number, concave.shape[1:])
    on: list[Any] = [None] * len(axes)
    for group in _groups(axes):
        base = 1 + sum(concave[k].astype(jnp.int32) for k in group)
        digit, left, rank = left % base, left // base, jnp.zeros_like(left)
        for k in group:
            on[k] = concave[k] & ((rank < digit) == (sides[k] > 0))
            rank = rank + concave[k].astype(jnp.int32)
    ends = []
    for each in steep:
        ends.append(jnp.where(each & (left % 2 == 1), 1.0, -1.0).astype(sides.dtype))
        left = jnp.where(each, left // 2, left)
    return jnp.stack(on) if on else jnp.zeros(concave.shape, bool), jnp.stack(ends)


def _shift(bend: jax.Array) -> jax.Array:
    """A diagonal D (m, ...) that makes P + D diagonally dominant and therefore positive semidefinite."""
    own = jnp.stack([bend[j, j] for j in range(len(bend))])
    return jnp.maximum(jnp.sum(jnp.abs(bend), 1) - jnp.abs(own) - own, 0)


def _solved(program: Program, ball: bool) -> Point:
    """The minimum of one convex program at every node.

    A node makes interior-point steps until it has converged, then Newton steps on its active set, and then stops.
    """
    dtype = program.slope.dtype
    tolerance, stiff = CLOSE * jnp.finfo(dtype).eps, _stiffness(dtype)

    def step(carry: _Steps) -> _Steps:
        number, point, centring, left, inside = carry
        slack, dual = point.slack, point.dual
        residuals = _residuals(program, point, ball)
        mean = jnp.mean(slack * dual, 0)
        error = functools.reduce(jnp.maximum, [jnp.max(jnp.abs(each), 0, initial=0) for each in residuals])
        # large weights leave residuals of rounding, which the steps on the active set remove
        close = jnp.where(mean < 0.01 * tolerance, 0, jnp.maximum(error, len(slack) * mean)) <= tolerance
        ends = (left == POLISH) & (close | (number >= STEPS))
        settled, active = ends | (left < POLISH), dual > slack
        inside = jax.tree.map(lambda now, before: jnp.where(ends, now, before), point, inside)
        weight = jnp.where(settled, jnp.where(active, stiff, 0), dual / slack)
        target = jnp.where(settled, jnp.where(active, dual - stiff * slack, 0), centring * mean / slack)
        change = _newton(program, point, residuals, weight, target - dual, ball)
        length = jnp.where(settled, 1, jnp.minimum(1, 0.99 * _longest(point, change)))
        # if weights overflow, the step is not finite and the interior-point method ends
        sound = jnp.isfinite(length + jnp.sum(change.v, 0) + jnp.sum(change.dual, 0))
        moved = jax.tree.map(lambda old, new: jnp.where(sound & (left > 0), old + length * new, old), point, change)
        inside = jax.tree.map(lambda now, before: jnp.where(sound | settled, before, now), point, inside)
        # after a long step the next one aims closer to the boundary
        centring = jnp.clip((1 - length) ** 2, 0.01, 0.8)
        return _Steps(number + 1, moved, centring, jnp.where(sound, jnp.maximum(left - settled, 0), 0), inside)

    start = _start(program, ball)
    first = _Steps(jnp.zeros((), jnp.int32), start, jnp.full_like(start.v[0], 0.3),
                   jnp.full(start.v.shape[1:], POLISH, jnp.int32), start)  # fmt: skip
    last = jax.lax.while_loop(lambda carry: jnp.any(carry.left > 0), step, first)
    polished, inside = (_within(each, program.jumps, ball) for each in (last.point, last.inside))
    # a wrong active set gives a worse point; then the interior point is kept
    better = _value(program, polished.v) <= _value(program, inside.v) + tolerance
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), polished, inside)


class _Steps(NamedTuple):
    """The state of ``_solved``: steps made, the point, the centring of the next step, polishing steps left, and the
    last interior point."""

    number: jax.Array
    point: Point
    centring: jax.Array
    left: jax.Array
    inside: Point


def _value(program: Program, v: jax.Array) -> jax.Array:
    """J(v)."""
    bent = jnp.sum(v * (program.slope + _times(program.bend, v) / 2), 0)
    return bent + jnp.sum(program.jumps * jnp.maximum(jnp.sum(program.rows * v, 1) + program.offsets, 0), 0)


def _within(point: Point, jumps: jax.Array, ball: bool) -> Point:
    """The nearest admissible point."""
    length = jnp.sqrt(jnp.sum(point.v**2, 0))
    # an input that rounding keeps off its bound would cross a constrained end
    near = jnp.where(jnp.abs(point.v) >= 1 - 4 * jnp.finfo(point.v.dtype).eps, jnp.sign(point.v), point.v)
    v = point.v / jnp.maximum(length, 1) if ball else jnp.clip(near, -1, 1)
    return point._replace(v=v, s=jnp.clip(point.s, 0, jumps))


def _start(program: Program, ball: bool) -> Point:
    """A point in the middle of the set, with multipliers of the size of the slopes."""
    s = jnp.minimum(program.jumps / 2, 1)
    g = program.slope + _back(program.rows, s)
    one = jnp.ones_like(g)
    if ball:
        slack, dual = [one[:1] / 2], [1 + jnp.sqrt(jnp.sum(g * g, 0, keepdims=True))]
    else:
        slack, dual = [one, one], [jnp.maximum(g, 0) + 1, jnp.maximum(-g, 0) + 1]
    # all products of slack and multiplier are of the same size, even if a jump is huge
    above = (jnp.maximum(program.offsets, 0) + 1) / jnp.maximum(program.jumps - s, 1)
    below = jnp.maximum(-program.offsets, 0) + 1
    return Point(
        jnp.zeros_like(g), s, jnp.concatenate([*slack, program.jumps - s, s]), jnp.concatenate([*dual, above, below])
    )


def _residuals(program: Program, point: Point, ball: bool) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The nonzero residuals: the Lagrangian's slope in v, (m, ...), and two conditions on slacks.

    The second is a·v + c minus its positive and its negative part, (K, ...). The third, (1, ...), is the slack of the
    ball. All other conditions are affine, so every step satisfies them.
    """
    (v, s, slack, dual), m, kinks = point, len(point.v), len(point.s)
    pull = program.slope + _times(program.bend, v) + _back(program.rows, s)
    pull = pull + (dual[0] * v if ball else dual[m : 2 * m] - dual[:m])
    above, below = dual[len(dual) - 2 * kinks : len(dual) - kinks], dual[len(dual) - kinks :]
    bar = (1 - jnp.sum(v * v, 0, keepdims=True)) / 2 - slack[:1] if ball else jnp.zeros_like(slack[:1])
    return pull, jnp.sum(program.rows * v, 1) + program.offsets - above + below, bar


def _newton(
    program: Program, point: Point, residuals: Sequence[jax.Array], weight: jax.Array, aim: jax.Array, ball: bool
) -> Point:
    """The move with Δdual = aim − weight · Δslack that removes the residuals to first order."""
    v, m, kinks, bars = point.v, len(point.v), len(point.s), len(point.dual) - 2 * len(point.s)
    (pull, beside, bar), root = residuals, 1 / _stiffness(point.v.dtype)
    above, below = slice(bars, bars + kinks), slice(bars + kinks, None)
    both = weight[above] + weight[below]
    # at a kink of the active set neither weight acts: a penalty holds its drift
    soft = 1 / jnp.where(both > 0, both, root)
    beyond = beside - aim[above] + aim[below]
    matrix = program.bend + jnp.sum(program.rows[:, :, None] * program.rows[:, None] * soft[:, None, None], 0)
    right = -pull - _back(program.rows, beyond * soft)
    eye = jnp.asarray(np.eye(m)[:, :, None], v.dtype)
    if ball:
        matrix = matrix + eye * point.dual[0] + weight[0] * v[:, None] * v[None]
        right = right - v * (aim[0] - weight[0] * bar[0])
    else:
        matrix = matrix + eye * (weight[:m] + weight[m : 2 * m])[:, None]
        right = right + aim[:m] - aim[m : 2 * m]
    # keeps pivots positive despite rounding, and nonzero if nothing bends; residuals are recomputed at every step
    matrix = matrix + eye * root**2 * (1 + 4 * matrix)
    dv = jax.lax.custom_linear_solve(
        lambda move: _times(matrix, move), right, lambda _, known: _eliminated(matrix, known), symmetric=True
    )
    ds = (jnp.sum(program.rows * dv, 1) + beyond) * soft
    bars_moved = [bar - jnp.sum(v * dv, 0, keepdims=True)] if ball else [dv, -dv]
    slack = jnp.concatenate([*bars_moved, -ds, ds])
    return Point(dv, ds, slack, aim - weight * slack)


def _longest(point: Point, change: Point) -> jax.Array:
    """The longest step that keeps slacks and multipliers nonnegative."""
    limits = [
        jnp.min(jnp.where(move < 0, -start / jnp.where(move < 0, move, -1), jnp.inf), 0)
        for start, move in ((point.slack, change.slack), (point.dual, change.dual))
    ]
    return jnp.minimum(*limits)


def _stiffness(dtype: Any) -> float:
    """The penalty that holds an active set, relative to coefficients of one."""
    return float(jnp.finfo(dtype).eps) ** -0.5


def _times(matrix: jax.Array, v: jax.Array) -> jax.Array:
    """P v."""
    return jnp.sum(matrix * v[None], 1)


def _back(rows: jax.Array, s: jax.Array) -> jax.Array:
    """Σ_k s_k a_k."""
    return jnp.sum(rows * s[:, None], 0)


def _eliminated(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """The solution of a positive definite system (m, m, ...) by Gauss–Jordan elimination, which needs no pivots."""
    tiny = jnp.finfo(right.dtype).tiny

    def clear(j: Any, table: jax.Array) -> jax.Array:
        row = jax.lax.dynamic_index_in_dim(table, j, 0, keepdims=False)
        row = row / jnp.maximum(jax.lax.dynamic_index_in_dim(row, j, 0, keepdims=False), tiny)
        column = jax.lax.dynamic_index_in_dim(table, j, 1, keepdims=False)
        own = (jnp.arange(len(right)) == j)[:, None, None]
        return jnp.where(own, row[None], table - column[:, None] * row[None])

    return jax.lax.fori_loop(0, len(right), clear, jnp.concatenate([matrix, right[:, None]], 1))[:, -1]
