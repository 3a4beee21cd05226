"""The exact optimum over a ball of a separable quadratic cost plus piecewise linear gains, one gain per input.

For each combination of the gains' pieces the objective is a quadratic, Σ b_j u_j + c_j u_j². Its optimum is its
stationary point or lies on the sphere, at −(2C + μ)⁻¹b with a multiplier μ ≥ 0 of the radius. Some inputs may instead
be at kinks, and the others use the rest of the ball. All combinations are tried. Each candidate is admissible and is
compared by its own value. ``sign`` is +1 to minimise and −1 to maximise; all numbers are per-node scalars.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hjbjax.discretisation.stencil import PerNode
from hjbjax.hamiltonian.piecewise import Kinked, inverse, inverse_root
from hjbjax.hamiltonian.search import Action, Best, best_of, better, pick

# Steps for the multiplier, monotone and finally quadratic. For a million sets of numbers over 24 orders of magnitude,
# with two or three inputs, the slowest needed eleven steps to 1e-10.
NEWTON = 12


class Branch(NamedTuple):
    """One choice of an input: to follow the slope of a piece (``kink`` None), or to be at a kink."""

    slope: PerNode
    kink: PerNode | None = None


def kinked_ball(
    sign: int,
    radius: PerNode,
    linear: Sequence[PerNode],
    square: Sequence[PerNode],
    pieces: Sequence[Kinked[PerNode] | None],
    *,
    curved: bool,
) -> Action:
    """The optimum over |u| ≤ radius of Σ_j (l_j u_j + q_j u_j² + gain_j(b_j + G_j u_j)), at most one gain per input.

    Exact unless the cost is concave for this player at a node, sign · q_j < 0. Then a quadratic may have a second
    local optimum on the sphere, in the cell of a combination whose best point lies in another cell.

    Args:
      sign: +1 to minimise, −1 to maximise.
      radius: the radius of the ball.
      linear, square: l and q for every input.
      pieces: the gain of every input, or None.
      curved: True if a q may differ from zero.
    """

    def total(action: Action) -> PerNode:
        terms = [b * u + c * u * u if curved else b * u for b, c, u in zip(linear, square, action, strict=True)]
        terms += [p.gain(p.offset + p.slope * u) for p, u in zip(pieces, action, strict=True) if p is not None]
        return sum(terms[1:], start=terms[0])

    branches = [_branches(g, piece) for g, piece in zip(linear, pieces, strict=True)]
    if curved:
        return _best_of_quadratics(sign, radius, square, branches, total)
    best = None
    for choice in itertools.product(*branches):
        action = _linear_optimum(sign, radius, choice)
        challenger = (total(action), action)
        best = challenger if best is None else pick(better(sign, challenger[0], best[0]), challenger, best)
    assert best is not None
    return best[1]


def _branches(linear: PerNode, piece: Kinked[PerNode] | None) -> list[Branch]:
    """The choices of one input."""
    if piece is None:
        return [Branch(linear)]
    kinks = [(k - piece.offset) * inverse(piece.slope) for k in piece.kinks]
    return [Branch(linear + piece.slope * d) for d in piece.derivatives] + [Branch(0.0, u) for u in kinks]


def _linear_optimum(sign: int, radius: PerNode, choice: Sequence[Branch]) -> Action:
    """The optimum of the linear functions of some branches: −sign · r · g/|g| in the inputs that follow slopes."""
    spent = sum((each.kink**2 for each in choice if each.kink is not None), start=jnp.zeros(()))
    shrink, left = _room(radius, spent)
    size = sum((each.slope**2 for each in choice if each.kink is None), start=jnp.zeros(()))
    scale = -sign * left * inverse_root(size)
    return [scale * each.slope if each.kink is None else shrink * each.kink for each in choice]


def _room(radius: PerNode, spent: PerNode) -> tuple[jax.Array, jax.Array]:
    """The factor that moves inputs at kinks onto the sphere if they are outside, and the remaining radius."""
    shrink = jnp.where(spent > radius * radius, radius * inverse_root(spent), 1)
    room = radius * radius - spent
    return shrink, jnp.where(room > 0, jnp.sqrt(jnp.where(room > 0, room, 1)), 0)


def _best_of_quadratics(
    sign: int,
    radius: PerNode,
    square: Sequence[PerNode],
    branches: Sequence[Sequence[Branch]],
    total: Callable[[Action], PerNode],
) -> Action:
    """The best of the optima for all combinations of branches, in a loop, because written out it compiles slowly."""
    centre: Action = [jnp.zeros(())] * len(branches)
    value = jnp.asarray(total(centre))
    start: Best = (value, [jnp.zeros_like(value) for _ in centre], [])
    table = list(itertools.product(*(range(len(each)) for each in branches)))

    def step(best: Best, choice: jax.Array) -> tuple[Best, None]:
        picked = [_picked(options, number) for options, number in zip(branches, choice, strict=True)]
        shrink, left = _room(radius, sum(jnp.where(follows, 0, kink**2) for follows, _, kink in picked))
        free = least_in_ball(
            left,
            [jnp.where(follows, sign * slope, 0) for follows, slope, _ in picked],
            # an input at a kink gets infinite stiffness, so it does not move
            [jnp.where(follows, sign * c, jnp.inf) for c, (follows, _, _) in zip(square, picked, strict=True)],
        )
        action = [jnp.where(follows, u, shrink * kink) for u, (follows, _, kink) in zip(free, picked, strict=True)]
        return best_of(lambda action: (jnp.asarray(total(action)), []), [action], sign, best), None

    return jax.lax.scan(step, start, jnp.array(table))[0][1]


def _picked(options: Sequence[Branch], number: jax.Array) -> tuple[jax.Array, PerNode, PerNode]:
    """For the branch with a traced number: True if it follows a slope, that slope, and its kink."""
    follows = number < sum(each.kink is None for each in options)  # slopes come before kinks
    slope, kink = options[0].slope, jnp.zeros(())
    for k, each in enumerate(options[1:], start=1):
        if each.kink is None:
            slope = jnp.where(number == k, each.slope, slope)
        else:
            kink = jnp.where(number == k, each.kink, kink)
    return follows, slope, kink


def least_in_ball(radius: PerNode, slope: Sequence[PerNode], square: Sequence[PerNode]) -> list[jax.Array]:
    """The minimum of b·u + Σ c_j u_j² over |u| ≤ r: u = −b/(2c + μ); the centre where b = 0 and c ≥ 0.

    1/|u| − 1/r is concave and increasing in μ, so Newton's method from the left rises to the root. If all c are equal
    it is linear, and the first μ is the root. If some c < 0, the minimum is on the sphere, where |u|² is constant:
    subtracting the smallest c from all of them leaves the same minimum, and nothing is concave. An input with c = ∞
    stays at zero.
    """
    there = radius > 0  # False for a ball that is one point, to avoid dividing by its radius
    radius = jnp.where(there, radius, 1)
    least = functools.reduce(jnp.minimum, square)
    concave = least < 0
    curvature = [2 * (c - jnp.minimum(least, 0)) for c in square]
    inner = [-b / jnp.where(k > 0, k, 1) for b, k in zip(slope, curvature, strict=True)]
    # the free minimum counts only if it exists: an input without curvature but with a slope runs to the sphere
    exists = functools.reduce(jnp.logical_and, ((k > 0) | (b == 0) for b, k in zip(slope, curvature, strict=True)))
    inside = exists & (_dot(inner, inner) <= radius * radius) & ~concave
    # b = 0 is common, and has no derivative on the sphere, so compute with other numbers there
    nothing = _dot(slope, slope) <= jnp.finfo(jnp.result_type(*slope)).tiny
    found = _on_sphere(radius, *([jnp.where(nothing, 1, e) for e in each] for each in (slope, curvature)))
    bound = [jnp.where(nothing, 0, u) for u in found]
    # without a slope along the most concave input both directions to the sphere are equally good: use the positive one
    room = jnp.maximum(radius * radius - _dot(bound, bound), 0)
    aside = concave & (room > 1e-6 * radius * radius)
    rest = jnp.where(aside, jnp.sqrt(jnp.where(aside, room, 1)), 0)
    for j, c in enumerate(square):
        bound[j] += jnp.where(c == least, rest, 0)
        rest = jnp.where(c == least, 0, rest)  # one input takes all of the rest
    return [jnp.where(there, jnp.where(inside, i, b), 0) for i, b in zip(inner, bound, strict=True)]


def _on_sphere(radius: PerNode, slope: Sequence[PerNode], curvature: Sequence[PerNode]) -> list[jax.Array]:
    """−b/(k + μ) with the multiplier μ ≥ 0 for which its norm is the radius; μ = 0 if it is shorter; k ≥ 0, b ≠ 0."""
    tiny = jnp.finfo(jnp.result_type(*slope)).tiny
    known = jax.lax.stop_gradient((radius, list(slope), list(curvature)))

    def newton(mu: jax.Array, radius: PerNode, slope: Sequence[PerNode], curvature: Sequence[PerNode]) -> jax.Array:
        parts = [jnp.where(k + mu > 0, k + mu, 1) for k in curvature]
        u = [b / part for b, part in zip(slope, parts, strict=True)]
        norm = jnp.sqrt(jnp.maximum(_dot(u, u), tiny))
        rise = jnp.maximum(sum(v * v / part for v, part in zip(u, parts, strict=True)), tiny)  # −½ d|u|²/dμ
        return jnp.maximum(mu + (norm / radius - 1) * norm * norm / rise, 0)

    # |u| ≥ |b|/(max k + μ) and |u| ≥ |b_j|/(k_j + μ): at this μ the norm is at least r, so Newton's method starts left
    # of the root. Without the second bound, a tiny b_j where k_j is smallest would need more than NEWTON steps
    at, slopes, bends = known
    stiffest = functools.reduce(jnp.maximum, bends)
    mu = functools.reduce(
        jnp.maximum,
        [jnp.abs(b) / at - k for b, k in zip(slopes, bends, strict=True)],
        jnp.sqrt(_dot(slopes, slopes)) / at - stiffest,
    )
    mu = jax.lax.fori_loop(0, NEWTON - 2, lambda _, mu: newton(mu, *known), jnp.maximum(mu, 0))
    for _ in range(2):  # at the root these two steps are enough for its first two derivatives
        mu = newton(mu, radius, slope, curvature)
    return [jnp.asarray(-b / jnp.where(k + mu > 0, k + mu, 1)) for b, k in zip(slope, curvature, strict=True)]


def _dot(a: Sequence[PerNode], b: Sequence[PerNode]) -> jax.Array:
    """Σ a_j b_j."""
    return jnp.asarray(sum(p * q for p, q in zip(a, b, strict=True)))
