"""Feedback linearisability of control systems ẋ = f(x) + Σ g_j(x) u_j.

Let G_k(x) be the span of ad_f^i g_j(x) for i ≤ k. The system can be linearised at x by a change of coordinates and a
feedback if and only if (§5 for one input)

    G_{n−1}(x) has dimension n,     G_k is involutive near x for k ≤ n − 2,     G_k has constant dimension near x

With one input the first condition implies the third, and the second is needed only for k = n − 2. "Near x" is defined
in ``feedback_linearisation``, ranks and units in ``distributions``. Each condition is reported with its margin.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.geometry.brackets import (
    Field,
    Ladder,
    along,
    as_bool,
    as_fields,
    as_half_widths,
    decide,
    near,
    stack_fields,
)
from hjbjax.geometry.distributions import Distribution, span
from hjbjax.geometry.scaling import ROUNDING, balance, with_terms, without_rounding
from hjbjax.problem import arguments
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.types import Array, Number, State

Ladders: TypeAlias = tuple[tuple[Array, Array], tuple[Array, Array]]  # members and slopes, and the terms of each


@pytree_dataclass()
class Linearisability:
    """The result of ``is_feedback_linearisable``: the three conditions and their margins.

    Args:
      ranks: the dimensions of G_0, G_1, … at the state, up to the first one of dimension n, or up to G_{n−1}.
      independence: the ratio of the n-th to the first singular value of the last G_k, in balanced units; above
        ``tolerance`` if it has rank n.
      involutivity: the largest part of a bracket of two fields of a G_k that is outside G_k, relative to the terms of
        the bracket; at most ``tolerance`` if all G_k are involutive.
      regular: True if every G_k has the same dimension at all sampled points.
      tolerance: compare the margins with it.
    """

    ranks: Array
    independence: Number
    involutivity: Number
    regular: bool | Array
    tolerance: Number

    @property
    @front_door
    def independent(self) -> bool | jax.Array:
        """The first condition: G_{n−1} has dimension n. With one input: the ad_f^k g, k ≤ n − 1, are independent."""
        return as_bool(self.independence > self.tolerance)

    @property
    @front_door
    def involutive(self) -> bool | jax.Array:
        """The second condition: G_k is involutive for k ≤ n − 2."""
        return as_bool(self.involutivity <= self.tolerance)

    @property
    @front_door
    def linearisable(self) -> bool | jax.Array:
        """True if the system is independent, involutive and regular."""
        # & works for traced arrays, ``and`` does not
        return as_bool(
            (self.independence > self.tolerance) & (self.involutivity <= self.tolerance) & jnp.asarray(self.regular)
        )


@front_door
def is_feedback_linearisable(
    f: Field,
    g: Field | Sequence[Field],
    x: State | Sequence[float],
    *,
    radius: float | Array = 0.1,
    samples: int = 16,
    tolerance: Number | None = None,
) -> Linearisability:
    """Check whether coordinates and a feedback make ẋ = f + g u linear and controllable near a state (§5).

    Args:
      f: the drift.
      g: the input field, or a sequence of them.
      x: the state, shape (n,).

    Keyword Args:
      radius: half width of the neighbourhood of x, in the units of the state; one number, or shape (n,).
      samples: number of points sampled near x.
      tolerance: numbers below it, relative to their terms, count as zero; ``None`` is √eps.

    Returns:
      A Linearisability, with ``linearisable``, the conditions and their margins.

    Raises:
      ValueError: a field or the radius has the wrong shape, or a derivative is not finite near x.

    Example:
      >>> pendulum = lambda x: jnp.stack([x[1], jnp.sin(x[0])])
      >>> is_feedback_linearisable(pendulum, lambda x: jnp.array([0.0, 1.0]), [0.5, 0.0]).linearisable
      True
    """
    arguments.count(samples, "is_feedback_linearisable: samples", least=0)
    fields = as_fields(f, g)
    states = np.shape(x)[0] if np.ndim(x) else 1
    half_widths = as_half_widths(radius, states, "is_feedback_linearisable")

    def rule(depth: int) -> Linearisability:
        return decide(
            _ladders_near, _linearisability, (fields, half_widths), x, tolerance, samples=int(samples), depth=depth
        )

    # once G_k has dimension n, longer brackets add nothing; with m inputs this is possible from k = n/m − 1 on
    enough = states if is_traced(fields, x, tolerance) else -(-states // max(len(fields) - 1, 1))
    for depth in range(enough, states):
        answer = rule(depth)
        if answer.regular and answer.ranks[-1] == states:
            return answer
    return rule(states)


def _ladders_near(
    functions: tuple[tuple[Field, ...], Array], x: State, tolerance: Number, *, samples: int, depth: int
) -> Ladders:
    """The members of G_0, …, G_{depth − 1} at points near x, their slopes, and the terms of both."""
    fields, radius = functions
    stacked = [stack_fields(fields[:1]), stack_fields(fields[1:])]

    def at(y: State) -> Ladders:
        return with_terms(lambda copies, z: _ad_ladder(copies[0], copies[1], z), stacked, y, depth)

    return jax.vmap(at)(near(x, radius, samples))


def _linearisability(ladders: Ladders, x: State, tolerance: Number) -> Linearisability:
    """Evaluate the conditions on G_0, …, G_{depth − 1}."""
    n, depth = x.shape[0], ladders[0][0].shape[1]
    up_to = jnp.asarray(np.tril(np.ones((depth, depth), bool)))  # row k: the generations contained in G_k

    def at(found: tuple[Array, Array], terms: tuple[Array, Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        # members (depth, m, n), slopes (depth − 1, m, n, n)
        (members, slopes), (_, sizes) = _in_common_units(found, terms)
        # all G_k in one program, with zeros for later generations, so that only one SVD is compiled
        spans = jax.vmap(lambda kept: _span_of_some(members, kept, tolerance))(up_to)
        ranks = jnp.sum(jax.vmap(lambda one: one.counted)(spans), axis=-1)
        if depth == 1:
            return ranks, jnp.zeros((), x.dtype), spans.singular_values[-1]
        shorter = jax.tree.map(lambda part: part[:-1], spans)
        outside = jax.vmap(lambda one, kept: _bracket_residue(one, kept, members[:-1], slopes, sizes))
        return ranks, jnp.max(outside(shorter, up_to[:-1, :-1])), spans.singular_values[-1]

    ranks, outside, values = jax.vmap(at)(*ladders)
    # values at the state itself, which ``near`` puts first; fewer than n rows have fewer than n singular values
    largest, smallest = values[0, 0], values[0, -1]
    full = values.shape[1] == n
    independence = jnp.where((largest > 0) & full, smallest / jnp.where(largest > 0, largest, 1), 0)
    return Linearisability(ranks[0], independence, jnp.max(outside), jnp.all(ranks == ranks[0]), tolerance)


def _span_of_some(members: Array, kept: Array, tolerance: Number) -> Distribution:
    """The span of the generations selected by a mask of shape (depth,)."""
    vectors = jnp.where(kept[:, None, None], members, 0).reshape(-1, members.shape[-1])
    return span(vectors, tolerance, jnp.zeros_like(vectors))


def _in_common_units(
    found: tuple[Array, Array], terms: tuple[Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Members and slopes without rounding, and their terms, in units that give members length 1."""
    members = without_rounding(found[0], terms[0])
    slopes = without_rounding(found[1], terms[1])
    rows, columns = balance(members.reshape(-1, members.shape[-1]))
    rows = rows.reshape(members.shape[:-1])
    scale = rows[..., None] * columns  # the scale of members; the next line has the scale of slopes
    bend = scale[: slopes.shape[0], ..., None] / columns
    return (members * scale, slopes * bend), (terms[0] * scale, terms[1] * bend)


def _ad_ladder(
    drifts: Sequence[Callable[[State], jax.Array]], inputs: Sequence[Callable[[State], jax.Array]], x: State
) -> tuple[jax.Array, jax.Array]:
    """ad_f^k g_j(x), k < count, shape (count, m, n), and their slopes for k < count − 1, (count − 1, m, n, n).

    Args:
      drifts: ``count`` copies of f, which returns shape (1, n).
      inputs: copies of the fields g, which return shape (m, n); only the first is used.
      x: the state.
    """
    gs = inputs[0]
    if len(drifts) == 1:
        here = gs(x)
        return here[None], jnp.zeros((0, *here.shape, x.shape[0]), x.dtype)

    def inputs_themselves(y: State) -> tuple[jax.Array, ...]:
        return (gs(y),)

    def longer(shorter: Ladder, f: Callable[[State], jax.Array]) -> Ladder:
        def step(y: State) -> tuple[jax.Array, ...]:
            found, changes = along(shorter, y, f(y))  # changes[-1] is (∂w/∂y) f, shape (1, m, n)
            _, bends = along(f, y, found[-1])  # (∂f/∂y) w, shape (m, 1, n)
            return (*found, changes[-1][0] - bends[:, 0])

        return step

    ladder: Ladder = inputs_themselves
    for f in drifts[2:]:
        ladder = longer(ladder, f)
    # the slopes of the last member give the next member without another derivative
    found, changes = along(ladder, x, jnp.eye(x.shape[0], dtype=x.dtype))
    slopes = jnp.moveaxis(jnp.stack(changes), 1, -1)  # (count − 1, m, n, n)
    last = drifts[1]
    _, bends = along(last, x, found[-1])
    # (∂w/∂x) f − (∂f/∂x) w for the last w
    return jnp.stack([*found, slopes[-1] @ last(x)[0] - bends[:, 0]]), slopes


def _bracket_residue(spanned: Distribution, kept: Array, members: Array, slopes: Array, terms: Array) -> jax.Array:
    """The largest part of a bracket of two members outside the span, relative to the terms of this bracket.

    Args:
      spanned: the span of the selected generations.
      kept: a mask of generations, shape (k,).
      members: shape (k, m, n), of length 1.
      slopes: shape (k, m, n, n).
      terms: the terms of the slopes.
    """
    n = members.shape[-1]
    v, dv, made_of = members.reshape(-1, n), slopes.reshape(-1, n, n), terms.reshape(-1, n, n)  # one member per row
    counts = jnp.repeat(kept, members.shape[1], total_repeat_length=len(v))
    products = jnp.einsum("bij,aj->abi", dv, v)  # (∂w/∂x) v
    brackets = products - products.swapaxes(0, 1)
    # zeros beyond the rank instead of fewer columns, because this is vmapped over points whose ranks differ
    basis = spanned.directions * spanned.counted
    rest = brackets - brackets @ basis @ basis.T
    # terms per bracket, so that one steep pair does not hide another; slopes that are rounding add little
    steep = jnp.abs(dv) + ROUNDING * jnp.finfo(v.dtype).eps ** 0.5 * made_of
    parts = jnp.einsum("bij,aj->abi", steep, jnp.abs(v))
    scale, left = (jnp.sqrt(jnp.sum(part * part, axis=-1)) for part in (parts + parts.swapaxes(0, 1), rest))
    return jnp.max(jnp.where(counts[:, None] & counts & (scale > 0), left / jnp.where(scale > 0, scale, 1), 0))
