"""Minimising (or maximising) a function of one action at every node, over each kind of admissible set.

An action is a list of per-node scalars, one an input. Every routine takes an ``objective(action)`` that
returns a pair (value, extra): the value at every node, and whatever is worth keeping of how it came about
(the opponent's answer). ``sign`` is +1 to minimise and −1 to maximise.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Action = list
Objective = Callable[[Action], tuple[jax.Array, list]]

UNROLL = 80  # evaluations written out in one fused kernel; beyond that XLA's compile time grows and its speed falls
CHUNK = 20  # evaluations in one step of the scan that takes over
REFINEMENTS = 24  # halvings of the sample spacing: 2⁻²⁴ of it is below the rounding of float32


def better(sign: int, challenger: Any, incumbent: Any) -> Any:
    """Whether ``challenger`` is strictly better; NaN never is."""
    return challenger < incumbent if sign > 0 else challenger > incumbent


def pick(condition: Any, first: Any, second: Any) -> Any:
    """``where`` on trees whose leaves broadcast against the nodes."""
    return jax.tree.map(lambda p, q: jnp.where(condition, p, q), first, second)


def enumerate_actions(objective: Objective, points: Any, sign: int, *, weight: int = 1) -> tuple[Any, Action, list]:
    """The best of the rows of ``points``, in order; the first of equals wins.

    Args:
      objective: see the module.
      points: shape (K, m).
      sign: +1 to minimise, −1 to maximise.
      weight: how many evaluations one call of ``objective`` stands for.

    Returns:
      The best value, the action there, and the extra there.
    """
    count, inputs = np.shape(points)
    if count * weight <= UNROLL:
        return _best_of(objective, [[points[k, j] for j in range(inputs)] for k in range(count)], sign, None)
    chunk = max(1, CHUNK // weight)
    padded = -(-count // chunk) * chunk
    rows = jnp.concatenate([points, jnp.broadcast_to(points[-1:], (padded - count, inputs))])
    first = _best_of(objective, [[points[0, j] for j in range(inputs)]], sign, None)
    shape = first[0].shape
    best = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, first[0].dtype), shape), first)

    def step(best, block):
        return _best_of(objective, [[block[k, j] for j in range(inputs)] for k in range(chunk)], sign, best), None

    return jax.lax.scan(step, best, rows.reshape(padded // chunk, chunk, inputs))[0]


def _best_of(objective: Objective, actions: Sequence[Action], sign: int, best: Any) -> Any:
    for action in actions:
        value, extra = objective(action)
        chosen = ([jnp.asarray(entry, value.dtype) for entry in action], extra)
        if best is None:
            best = (value, *chosen)
            continue
        optimum = jnp.minimum(best[0], value) if sign > 0 else jnp.maximum(best[0], value)  # a NaN stays one
        best = (optimum, *pick(better(sign, value, best[0]), chosen, best[1:]))
    return best


def refine(
    objective: Objective, best: Any, spacing: Sequence[Any], project: Callable[[Action], Action], sign: int
) -> Any:
    """Pattern search around the best sample: one input at a time, up and down, halving the step.

    Args:
      objective: see the module.
      best: what ``enumerate_actions`` returned.
      spacing: distance between neighbouring samples, one number an input.
      project: maps an action to the nearest admissible one.
      sign: +1 to minimise, −1 to maximise.
    """
    value, action, extra = best
    dtype, shape = value.dtype, value.shape
    best = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, dtype), shape), (value, action, extra))

    def one_round(k, best):
        scale = jnp.asarray(0.5, dtype) ** (k + 1)
        for j, width in enumerate(spacing):
            for direction in (1, -1):
                moved = list(best[1])
                moved[j] = moved[j] + direction * scale * width
                best = _best_of(objective, [project(moved)], sign, best)
        return best

    return jax.lax.fori_loop(0, REFINEMENTS, one_round, best)


def piecewise_input(
    sign: int, lo: Any, hi: Any, linear: Any, square: Any, pieces: Sequence["Kinked"], *, curved: bool
) -> Any:
    """The exact optimum over one input u ∈ [lo, hi] of  l u + q u² + Σ_i gain_i(b_i + G_i u).

    Each gain is linear between its kinks, so the optimum is an end, a kink, or the stationary point of a piece
    clipped to [lo, hi]; all are tried. Concave pieces and G_i = 0 need no special care: every candidate is
    admissible and is judged by its own value.

    Args:
      sign: +1 to minimise, −1 to maximise.
      lo, hi: the bounds of the input.
      linear, square: l and q, per-node scalars.
      pieces: the gains that this input drives.
      curved: whether q may differ from zero.
    """

    def total(u):
        value = linear * u + square * u * u if curved else linear * u
        return sum((piece.gain(piece.offset + piece.slope * u) for piece in pieces), start=value)

    candidates = [lo, hi]
    slopes = []
    for index, piece in enumerate(pieces):
        for position, kink in enumerate(piece.kinks):
            moving = piece.slope != 0
            at = jnp.clip((kink - piece.offset) / jnp.where(moving, piece.slope, 1), lo, hi)
            at = jnp.where(moving, at, lo)
            candidates.append(at)
            others = sum(
                (
                    other.slope * other.derivative(other.offset + other.slope * at)
                    for k, other in enumerate(pieces)
                    if k != index
                ),
                start=linear,
            )
            slopes += [others + piece.slope * d for d in piece.derivatives[position : position + 2]]
    if curved:
        for slope in slopes or [linear]:
            stationary = -slope / (2 * jnp.where(square == 0, 1, square))
            candidates.append(jnp.where(square == 0, lo, jnp.clip(stationary, lo, hi)))
    best_u, best_value = jnp.asarray(candidates[0]), total(candidates[0])
    for u in candidates[1:]:
        value = total(u)
        wins = better(sign, value, best_value)
        best_u, best_value = jnp.where(wins, u, best_u), jnp.where(wins, value, best_value)
    return best_u


class Kinked:
    """A piecewise linear function gain(f) of one drift component f = offset + slope·u, with its kinks in order.

    ``derivatives`` holds the slope of the gain between consecutive kinks: one more than there are kinks.
    """

    def __init__(self, gain: Callable, offset: Any, slope: Any, kinks: Sequence[Any], derivatives: Sequence[Any]):
        self.gain, self.offset, self.slope = gain, offset, slope
        self.kinks, self.derivatives = tuple(kinks), tuple(derivatives)

    def derivative(self, f: Any) -> Any:
        """The slope of the gain at f; at a kink the one above it."""
        result = self.derivatives[0]
        for kink, above in zip(self.kinks, self.derivatives[1:], strict=True):
            result = jnp.where(f >= kink, above, result)
        return result


def ball_directions(gradients: Sequence[Any], radius: Any, sign: int) -> Action:
    """The optimum of g·u over |u| ≤ radius: −sign · radius · g/|g|; the centre where g = 0."""
    norm = jnp.sqrt(sum(g * g for g in gradients))
    scale = -sign * radius / jnp.where(norm == 0, 1, norm)
    return [scale * g for g in gradients]


def kinked_ball(sign: int, radius: Any, linear: Sequence[Any], pieces: Sequence[Kinked | None]) -> Action:
    """The exact optimum over |u| ≤ radius of Σ_j (l_j u_j + gain_j(b_j + G_j u_j)), one gain an input at most.

    On each combination of pieces the objective is linear, so its optimum lies on the sphere, or where some
    inputs sit at kinks and the others on the sphere that is left; all combinations are tried.
    """

    def total(action):
        terms = [g * u for g, u in zip(linear, action, strict=True)]
        terms += [p.gain(p.offset + p.slope * u) for p, u in zip(pieces, action, strict=True) if p is not None]
        return sum(terms[1:], start=terms[0])

    best = None
    for choice in itertools.product(*(_branches(g, piece) for g, piece in zip(linear, pieces, strict=True))):
        fixed = {j: u for j, (kind, u) in enumerate(choice) if kind == "kink"}
        spent = sum((u * u for u in fixed.values()), start=jnp.zeros(()))
        shrink = jnp.minimum(1, radius / jnp.sqrt(jnp.where(spent == 0, 1, spent))) if fixed else 1
        left = jnp.sqrt(jnp.maximum(radius * radius - spent, 0))
        free = ball_directions([g for kind, g in choice if kind == "slope"] or [jnp.zeros(())], left, sign)
        moving = iter(free)
        action = [shrink * fixed[j] if j in fixed else next(moving) for j in range(len(choice))]
        challenger = (total(action), action)
        best = challenger if best is None else pick(better(sign, challenger[0], best[0]), challenger, best)
    assert best is not None
    return best[1]


def _branches(linear: Any, piece: Kinked | None) -> list[tuple[str, Any]]:
    """What one input may do: follow the gradient of a piece, or sit at a kink."""
    if piece is None:
        return [("slope", linear)]
    moving = piece.slope != 0
    kinks = [jnp.where(moving, (k - piece.offset) / jnp.where(moving, piece.slope, 1), 0) for k in piece.kinks]
    return [("slope", linear + piece.slope * d) for d in piece.derivatives] + [("kink", u) for u in kinks]
