"""Bounds on the distance from a value function to the exact solution of the discrete equation.

Discounted: with ρ = max(min(r/β, ψ − V), g − V) at every node (zero at fixed nodes)

    V + min ρ ≤ V_h ≤ V + max ρ.

Undiscounted, with running cost L > 0, exit cost ≥ 0 and V ≥ 0: with L the least running cost at a node,

    V/(1 + η) ≤ V_h ≤ V/(1 − ρ),    ρ = max(r/L)⁺ < 1,   η = max((−r)⁺/L),

because scaling a super- or subsolution scales its generator term but not its cost. For minimum time L = 1. An
undiscounted V may be shifted by a constant; if an exit cost is negative, V is first shifted so that all exit costs are
non-negative. A stopping cost ψ is imposed as V ≤ ψ. Where V = ψ only ψ itself bounds V_h from above, so these nodes
count for η only. A factor 1/(1 − ρ) beyond ε^{-1/2}, with ε the unit of rounding, is discarded: 1 − ρ may then be
rounding of r and L, and the bound would be useless. Both bounds follow from the comparison principle of a monotone
scheme. They bound the algebraic error, not the discretisation error; they are valid if the minimum over the actions is
exact, and require float64.
"""

import dataclasses
import enum
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import bellman
from hjbjax.iteration.bellman import Greedy, Obstacles, PolicyEquation
from hjbjax.problem.layouts import Layout
from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.types import Array, Field, Mask, Number, Scalar

LOST = 4  # roundings of numbers of size lift · max(factor, 1) in factor · V + shift


class Certificate(enum.Enum):
    """The bound that a problem admits; the value describes it in words."""

    ADDITIVE = "from the discount, V + min r/β ≤ V_h ≤ V + max r/β"
    MULTIPLICATIVE = "from the running cost, V/(1 + η) ≤ V_h ≤ V/(1 − ρ)"
    BY_DISCOUNT = "from the discount where it is positive, else from the running cost"
    RESIDUAL = "the high-order equation, whose residual this is, has no comparison principle"
    OPEN = "open ends extrapolate the value, and have no comparison principle"
    NONE = "without discount and positive running cost the residual bounds nothing"


TO_THE_END = (Certificate.NONE, Certificate.BY_DISCOUNT)  # for tubes, V falls or climbs until nothing moves


@pytree_dataclass()
class ErrorBound:
    """Bounds on V_h − V, and how far they are from V.

    Args:
      below, above: the bounds on V_h: V + shift if additive, (V + lift) · factor − lift if multiplicative.
      lift: the constant that makes every exit cost non-negative.
      error: the largest |bound − V| over the counted nodes, cost units; without a certificate the size of the last
        correction or of the residual.
      residual: the largest |residual| in cost units.
    """

    below: Scalar
    above: Scalar
    lift: Scalar
    error: Scalar
    residual: Scalar


@dataclasses.dataclass(frozen=True)
class Iterate:
    """A value function with its policy and the residual of its equation.

    Attributes:
      layout: the layout of the nodes.
      value: V, (*grid).
      policy: the greedy policy at V with its defect r, zero at fixed nodes.
      equation: its correction equation, whose source is the residual.
      obstacles: fixed nodes and constraints.
      counted: bool (*grid), the nodes whose error counts (the nodes that reach the target).
    """

    layout: Layout
    value: Field
    policy: Greedy
    equation: PolicyEquation
    obstacles: Obstacles
    counted: Mask | bool


def error_bound(
    kind: Certificate, iterate: Iterate, *, discount: Number, least_cost: Field | None = None, moved: Number = 0
) -> ErrorBound:
    """The certificate of a value.

    Args:
      kind: the applicable bound.
      iterate: the value, its policy and their residual.
      discount: β.
      least_cost: L at every node, for the multiplicative bound.
      moved: the size of the last correction, the measure without a certificate.
    """
    if kind is Certificate.BY_DISCOUNT:
        other = Certificate.NONE if least_cost is None else Certificate.MULTIPLICATIVE
        # β is traced, so both bounds are computed and one is selected; where β = 0, r/1 replaces r/0
        rate = jnp.where(discount > 0, discount, 1)
        with_it, without = (
            error_bound(each, iterate, discount=rate, least_cost=least_cost, moved=moved)
            for each in (Certificate.ADDITIVE, other)
        )
        if other is Certificate.NONE:  # no usable bounds
            endless = jnp.full_like(without.residual, jnp.inf)
            without = dataclasses.replace(without, above=endless, lift=endless)
        return jax.tree.map(lambda mine, theirs: jnp.where(discount > 0, mine, theirs), with_it, without)
    residual = iterate.layout.largest(jnp.where(iterate.counted, jnp.abs(iterate.equation.source), 0))
    if kind is Certificate.ADDITIVE:
        below, above = _additive(iterate, discount)
        error = jnp.maximum(jnp.abs(below), jnp.abs(above))
        return ErrorBound(below, above, jnp.zeros_like(residual), error, residual)
    if kind is Certificate.MULTIPLICATIVE:
        assert least_cost is not None
        return _multiplicative(iterate, least_cost, residual)
    return measured(residual, jnp.maximum(residual, moved))


def measured(residual: Scalar, error: Scalar) -> ErrorBound:
    """The measures of a value without a bound: its residual and the estimate of its error."""
    zero = jnp.zeros_like(residual)
    return ErrorBound(zero, zero, zero, error, residual)


def of_relaxation(kind: Certificate, on: Discretisation, value: Field) -> tuple[Field, ErrorBound]:
    """The step of one relaxation at a value, zero at fixed nodes, and the bound on the value.

    The next value is not worse: T is monotone and T V_h = V_h, so V − e ≤ V_h ≤ V + e implies T V − e ≤ V_h ≤ T V + e.
    Only one array is stored besides V: r if e = max |ρ| is computed from it, else s. The barriers are needed for this:
    without them H is evaluated once more for every number, or the rates take an array too.
    """
    (defect, outflow), given = bellman.relaxation(on, value), bellman.obstacles(on)
    zero = jnp.zeros((), value.dtype)
    if kind is Certificate.ADDITIVE:
        defect = jax.lax.optimization_barrier(defect)
        error = on.grid.layout.largest(jnp.abs(_shift(given, defect / on.problem.discount, value)))
        return given.clipped(defect / outflow, value), ErrorBound(-error, error, zero, error, error)
    step = given.clipped(jax.lax.optimization_barrier(defect / outflow), value)
    residual = on.grid.layout.largest(jnp.abs(step))
    return step, ErrorBound(zero, zero, zero, residual, residual)


def _additive(iterate: Iterate, discount: Number) -> tuple[Scalar, Scalar]:
    """The minimum and maximum of ρ = max(min(r/β, ψ − V), g − V)."""
    layout, value, policy, obstacles = iterate.layout, iterate.value, iterate.policy, iterate.obstacles
    if obstacles.upper is None and obstacles.lower is None and not obstacles.interventions:
        return layout.least(policy.defect) / discount, layout.largest(policy.defect) / discount  # without an array r/β
    shift = _shift(obstacles, policy.defect / discount, value)
    return layout.least(shift), layout.largest(shift)


def _shift(obstacles: Obstacles, shift: Field, value: Field) -> Field:
    """max(min(r/β, ψ − V), g − V) from r/β, (*grid); zero at fixed nodes, where V is exact.

    An intervention counts only where V = M V, since adding a constant to V does not reduce M V − V.
    """
    if obstacles.interventions:
        after = obstacles.interventions.least(value)
        shift = jnp.where(value < after, shift, jnp.minimum(shift, after - value))
    if obstacles.upper is not None:
        shift = jnp.minimum(shift, obstacles.upper - value)
    if obstacles.lower is not None:
        shift = jnp.maximum(shift, obstacles.lower - value)
    return jnp.where(obstacles.fixed, 0, shift)


def _multiplicative(iterate: Iterate, least_cost: Field, residual: Scalar) -> ErrorBound:
    """V/(1 + η) ≤ V_h ≤ V/(1 − ρ) for V shifted so that no exit cost is negative."""
    value, policy, obstacles, counted = iterate.value, iterate.policy, iterate.obstacles, iterate.counted
    layout, costs = iterate.layout, least_cost > 0
    free = counted & ~obstacles.fixed
    # where L = 0 any defect is infinite relative to the cost; r = 0 gives NaN from sign · ∞, but ``priced`` is false
    # then anyway
    rate = jnp.where(costs, policy.defect / jnp.where(costs, least_cost, 1), jnp.sign(policy.defect) * jnp.inf)
    relative = jnp.where(free, rate, 0)
    # where V = ψ only ψ, which is imposed, bounds V_h from above, and likewise where V = M V
    ceiling = obstacles.ceiling(value)
    rising = relative if ceiling is None else jnp.where(value < ceiling, relative, 0)
    rho, eta = jnp.maximum(layout.largest(rising), 0), jnp.maximum(layout.largest(-relative), 0)
    # as numbers: for booleans XLA would make two passes
    priced = layout.largest(jnp.asarray(free & ~costs, value.dtype)) == 0
    sound = priced & (1 - rho > jnp.sqrt(jnp.finfo(rho.dtype).eps))  # where V is flat, r = L up to rounding
    below, above = 1 / (1 + eta), jnp.where(sound, 1 / jnp.where(sound, 1 - rho, 1), jnp.inf)
    if obstacles.interventions.pushes:  # the bound for scaled V requires c ≥ 0
        least_push = functools.reduce(jnp.minimum, map(jnp.min, obstacles.interventions.costs))
        sound, priced = sound & (least_push >= 0), priced & (least_push >= 0)
    lift = jnp.maximum(-lowest_end(obstacles, counted, layout), 0)
    apart = jnp.where(jnp.isinf(above), 0, jnp.maximum(above - 1, 1 - below))  # avoids 0 · inf
    least, most = layout.least(jnp.where(counted, value, jnp.inf)), layout.largest(jnp.where(counted, value, -jnp.inf))
    # the scaling argument requires V ≥ 0; otherwise there is no bound
    bounded = jnp.isfinite(above) & (least + lift >= 0)
    error = jnp.where(bounded, jnp.maximum(most + lift, 0) * apart, jnp.inf) + 0 * residual  # keeps NaN
    return ErrorBound(below, above, jnp.where(priced, lift, jnp.inf), error, residual)


def widen_bounds(
    kind: Certificate, bound: ErrorBound, missed: tuple[Field, Field], *, discount: Number, least_cost: Field | None
) -> ErrorBound:
    """The bounds widened by the errors of the two players' optima, (*grid) each, cost per unit time.

    min max H is at least the computed H minus the control's error, and at most H plus the disturbance's error. The
    error of r is therefore bounded by the same numbers.
    """
    if kind is Certificate.BY_DISCOUNT:
        other = Certificate.NONE if least_cost is None else Certificate.MULTIPLICATIVE
        rate = jnp.where(discount > 0, discount, 1)
        with_it, without = (
            widen_bounds(each, bound, missed, discount=rate, least_cost=least_cost)
            for each in (Certificate.ADDITIVE, other)
        )
        return jax.tree.map(lambda mine, theirs: jnp.where(discount > 0, mine, theirs), with_it, without)
    mine, theirs = missed
    if kind is Certificate.ADDITIVE:
        below, above = bound.below - jnp.max(mine) / discount, bound.above + jnp.max(theirs) / discount
    elif kind is Certificate.MULTIPLICATIVE:
        assert least_cost is not None
        # with a free node that pays nothing the bounds are infinite already
        shares = [
            jnp.max(jnp.where(least_cost > 0, each / jnp.where(least_cost > 0, least_cost, 1), 0)) for each in missed
        ]
        below, inverse = 1 / (1 / bound.below + shares[0]), 1 / bound.above - shares[1]
        above = jnp.where(inverse > 0, 1 / jnp.where(inverse > 0, inverse, 1), jnp.inf)
    else:
        return bound
    return dataclasses.replace(bound, below=below, above=above)


def lowest_end(obstacles: Obstacles, counted: Mask | bool, layout: Layout) -> Scalar:
    """The least payment at the end of a run, at most zero: exit costs, also between nodes, and ψ."""
    lowest = layout.least(jnp.where(counted & obstacles.fixed, obstacles.fixed_value, 0))
    lowest = jnp.minimum(lowest, obstacles.least_exit)
    # ψ is paid on stopping, which is possible anywhere
    if obstacles.upper is None:
        return lowest
    return jnp.minimum(lowest, layout.least(jnp.where(counted, obstacles.upper, 0)))


def affine_bounds(kind: Certificate, bound: ErrorBound, discount: Number | None = None) -> Any:
    """Both bounds as affine functions of V: rows lower and upper, columns factor and shift, shape (2, 2).

    (V + lift) · factor − lift cancels where V is near −lift, as on a target with a negative exit cost. The shift is
    rounded outwards by the possible loss. ``None`` without a certificate.
    """
    if kind is Certificate.BY_DISCOUNT:
        assert discount is not None
        with_it, without = (affine_bounds(each, bound) for each in (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE))
        return jnp.where(discount > 0, with_it, without)
    if kind not in (Certificate.ADDITIVE, Certificate.MULTIPLICATIVE):
        return None
    # NumPy if the numbers are known: JAX would round doubles to its default type, and compile
    xp: Any = jnp if is_traced(bound) else np
    below, above, lift = (xp.asarray(number) for number in (bound.below, bound.above, bound.lift))

    def line(side: Array, outwards: int) -> Array:
        one = xp.ones_like(side)
        if kind is Certificate.ADDITIVE:
            return xp.stack([one, side])
        endless = xp.isinf(side) | xp.isinf(lift)
        factor, lifted = xp.where(endless, one, side), xp.where(endless, 0 * one, lift)  # avoids 0 · inf
        lost = LOST * xp.finfo(side.dtype).eps * lifted * xp.maximum(factor, 1) * (factor != 1)
        return xp.stack([factor, xp.where(endless, outwards * xp.inf, lifted * (factor - 1) + outwards * lost)])

    return xp.stack([line(below, -1), line(above, 1)])
