"""Bounds on the distance from a value function to the exact solution of the discrete equation.

Discounted: with ρ = max(min(r/β, ψ − V), g − V) at every node (zero where held)

    V + min ρ ≤ V_h ≤ V + max ρ.

Undiscounted with running cost L > 0, exit cost ≥ 0 and V ≥ 0: with L the least running cost at a node,

    V/(1 + η) ≤ V_h ≤ V/(1 − ρ),    ρ = max(r/L)⁺ < 1,   η = max((−r)⁺/L),

because scaling a super- or subsolution scales its generator part and not its cost. Minimum time is L = 1. A
constant may be added to an undiscounted V: where an exit cost is negative all of it is lifted to zero first.
Both follow from the comparison principle of a monotone scheme; they bound the algebraic error and not the
error of the grid, hold where the minimum over the actions is exact, and want float64.
"""

import enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.bellman import Conditions, Correction, Greedy
from hjbjax.pytree import is_traced, node


class Certificate(enum.Enum):
    """Which bound a problem admits; the value says so in words."""

    ADDITIVE = "from the discount, V + min r/β ≤ V_h ≤ V + max r/β"
    MULTIPLICATIVE = "from the running cost, V/(1 + η) ≤ V_h ≤ V/(1 − ρ)"
    RESIDUAL = "the second-order equation, whose residual this is, has no comparison principle"
    NONE = "without discount and positive running cost the residual bounds nothing"


@node()
class Gap:
    """How far the bounds are from the value.

    Args:
      below, above: what bounds V_h: V + shift where additive, (V + lift) · factor − lift where multiplicative.
      lift: what makes every exit cost non-negative.
      error: the largest |bound − V| over the nodes that count, cost units; without a certificate the size of the
        last correction or of the residual.
      residual: the largest |residual| in cost units.
    """

    below: jax.Array
    above: jax.Array
    lift: jax.Array
    error: jax.Array
    residual: jax.Array


def gap(
    kind: Certificate,
    value: jax.Array,
    policy: Greedy,
    equation: Correction,
    rules: Conditions,
    *,
    discount: Any,
    least_cost: Any,
    counted: Any,
    moved: Any,
) -> Gap:
    """The certificate of ``value``.

    Args:
      kind: which bound applies.
      value: V.
      policy: the greedy policy at V with its rate r, zero where held.
      equation: the correction equation there, whose source is the residual.
      rules: held nodes and constraints.
      discount: β.
      least_cost: L at every node, for the multiplicative bound.
      counted: bool (*grid), the nodes whose error counts (those that reach the target).
      moved: the size of the last correction, the fallback measure.
    """
    residual = jnp.max(jnp.where(counted, jnp.abs(equation.source), 0))
    free = counted & ~rules.held
    zero = jnp.zeros_like(residual)
    if kind is Certificate.ADDITIVE:
        if rules.stop is None and rules.floor is None:
            below, above = jnp.min(policy.rate) / discount, jnp.max(policy.rate) / discount
        else:
            shift = policy.rate / discount
            if rules.stop is not None:
                shift = jnp.minimum(shift, rules.stop - value)
            if rules.floor is not None:
                shift = jnp.maximum(shift, rules.floor - value)
            shift = jnp.where(rules.held, 0, shift)
            below, above = jnp.min(shift), jnp.max(shift)
        return Gap(below, above, zero, jnp.maximum(jnp.abs(below), jnp.abs(above)), residual)
    if kind is Certificate.MULTIPLICATIVE:
        safe = jnp.where(free & (least_cost > 0), least_cost, 1)
        relative = jnp.where(free, jnp.where(least_cost > 0, policy.rate / safe, jnp.sign(policy.rate) * jnp.inf), 0)
        rho, eta = jnp.maximum(jnp.max(relative), 0), jnp.maximum(jnp.max(-relative), 0)
        below, above = 1 / (1 + eta), jnp.where(rho < 1, 1 / jnp.where(rho < 1, 1 - rho, 1), jnp.inf)
        lift = jnp.maximum(-jnp.min(jnp.where(counted & rules.held, rules.given, 0)), 0)
        lifted = jnp.where(counted, value + lift, 0)
        error = jnp.max(lifted) * jnp.maximum(above - 1, 1 - below)
        error = jnp.where(jnp.all(lifted >= 0), error, jnp.inf) + 0 * residual  # a NaN stays one
        return Gap(below, above, lift, error, residual)
    return Gap(zero, zero, zero, jnp.maximum(residual, moved), residual)


def enclosure(kind: Certificate, measured: Gap) -> Any:
    """Both bounds as affine functions of V: rows lower and upper, columns factor and shift, shape (2, 2).

    ``None`` without a certificate.
    """
    if kind not in (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE):
        return None
    xp: Any = jnp if is_traced(measured) else np
    below, above, lift = (xp.asarray(number) for number in (measured.below, measured.above, measured.lift))

    def line(side: Any) -> Any:
        one = xp.ones_like(side)
        if kind is Certificate.ADDITIVE:
            return xp.stack([one, side])
        endless = xp.isinf(side)
        factor = xp.where(endless, one, side)  # no 0 · inf
        return xp.stack([factor, xp.where(endless, side, lift * (factor - 1))])

    return xp.stack([line(below), line(above)])
