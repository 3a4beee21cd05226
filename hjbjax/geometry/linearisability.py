"""Geometry of control systems ẋ = f(x) + Σ g_j(x) u_j: brackets, ranks, and exact linearisation by feedback.

Lie derivatives and brackets, reachability and observability, relative degree and linearising feedback are defined in
``brackets``, ``distributions`` and ``feedback_linearisation``, and are all found here. With G_k(x) the span of ad_f^i
g_j(x), i ≤ k, the system is linearised at x by a change of coordinates and a feedback exactly when (§5 with one
input)

    G_{n−1}(x) has dimension n,     G_k is involutive near x for k ≤ n − 2,     G_k has constant dimension near x

With one input the first condition implies the third, and the second is needed for k = n − 2 alone. "Near x" is as in
``feedback_linearisation``, ranks and units are as in ``distributions``; each condition comes with its margin.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.geometry.brackets import (
    Field,
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

Ladders: TypeAlias = tuple[tuple[Array, Array], tuple[Array, Array]]  # members and slopes, and the terms of both


@pytree_dataclass()
class Linearisability:
    """The verdict on linearisation by feedback, with the conditions it follows from.

    Args:
      ranks: the dimensions of G_0, G_1, … at the state, up to the first that is n or to G_{n−1}.
      independence: the n-th singular value of the last of them over the first, in balanced units; above
        ``tolerance`` where it has rank n.
      involutivity: the largest part of a bracket of two fields of a G_k that lies outside G_k, relative to the
        terms the bracket is made of; below ``tolerance`` where all are involutive.
      regular: whether every G_k has the same dimension at all points looked at.
      tolerance: what the margins are compared with.
    """

    ranks: Array
    independence: Number
    involutivity: Number
    regular: bool | Array
    tolerance: Number

    @property
    @front_door
    def independent(self) -> bool | jax.Array:
        """The first condition: G_{n−1} has dimension n; with one input, {ad_f^k g, k ≤ n − 1} is independent."""
        return as_bool(self.independence > self.tolerance)

    @property
    @front_door
    def involutive(self) -> bool | jax.Array:
        """The second condition: G_k is involutive, k ≤ n − 2."""
        return as_bool(self.involutivity <= self.tolerance)

    @property
    @front_door
    def linearisable(self) -> bool | jax.Array:
        """Whether the system is independent, involutive and regular."""
        # with & on arrays: ``and`` would ask a tracer for its truth
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
    """Linearisability near a state: ẋ = f + g u made linear and controllable by coordinates and a feedback (§5).

    Args:
      f: the drift.
      g: the input field, or a sequence of them.
      x: the state, shape (n,).

    Keyword Args:
      radius: how far from x is near, in the units of the state; one number, or one a state, shape (n,).
      samples: how many points near x are looked at.
      tolerance: what counts as zero, relative to what it is made of; ``None`` is √eps.

    Returns:
      A Linearisability, with ``linearisable``, the conditions and their margins.

    Raises:
      ValueError: a field or a radius of the wrong shape, or a derivative that is not finite near x.

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

    # Where G_k is everything the longer brackets add nothing, and with m inputs that can be from k = n/m − 1 on.
    enough = states if is_traced(fields, x, tolerance) else -(-states // max(len(fields) - 1, 1))
    for depth in range(enough, states):
        answer = rule(depth)
        if answer.regular and answer.ranks[-1] == states:
            return answer
    return rule(states)


def _ladders_near(
    functions: tuple[tuple[Field, ...], Array], x: State, tolerance: Number, *, samples: int, depth: int
) -> Ladders:
    """The members of G_0, …, G_{depth − 1} at points near x, and their slopes, and the terms of both."""
    fields, radius = functions
    stacked = [stack_fields(fields[:1]), stack_fields(fields[1:])]

    def at(y):
        return with_terms(lambda copies, z: _ad_ladder(copies[0], copies[1], z), stacked, y, depth)

    return jax.vmap(at)(near(x, radius, samples))


def _linearisability(ladders: Ladders, x: State, tolerance: Number) -> Linearisability:
    """The conditions as far as G_0, …, G_{depth − 1} show them."""
    n, depth = x.shape[0], ladders[0][0].shape[1]
    up_to = jnp.asarray(np.tril(np.ones((depth, depth), bool)))  # which generations are in G_k, k the row

    def at(found, terms):
        # members (depth, m, n), slopes (depth − 1, m, n, n)
        (members, slopes), (_, sizes) = _in_common_units(found, terms)
        # All G_k in one program, with zeros for the later generations: one singular value decomposition to compile.
        spans = jax.vmap(lambda kept: _span_of_some(members, kept, tolerance))(up_to)
        ranks = jnp.sum(jax.vmap(lambda one: one.counted)(spans), axis=-1)
        if depth == 1:
            return ranks, jnp.zeros((), x.dtype), spans.singular_values[-1]
        shorter = jax.tree.map(lambda part: part[:-1], spans)
        outside = jax.vmap(lambda one, kept: _bracket_residue(one, kept, members[:-1], slopes, sizes))
        return ranks, jnp.max(outside(shorter, up_to[:-1, :-1])), spans.singular_values[-1]

    ranks, outside, values = jax.vmap(at)(*ladders)
    # at the state itself, which ``near`` puts first; fewer than n rows have fewer than n singular values
    largest, smallest = values[0, 0], values[0, -1]
    full = values.shape[1] == n
    independence = jnp.where((largest > 0) & full, smallest / jnp.where(largest > 0, largest, 1), 0)
    return Linearisability(ranks[0], independence, jnp.max(outside), jnp.all(ranks == ranks[0]), tolerance)


def _span_of_some(members: Array, kept: Array, tolerance: Number) -> Distribution:
    """The span of the generations that are kept, a mask of shape (depth,)."""
    vectors = jnp.where(kept[:, None, None], members, 0).reshape(-1, members.shape[-1])
    return span(vectors, tolerance, jnp.zeros_like(vectors))


def _in_common_units(
    found: tuple[Array, Array], terms: tuple[Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Members and slopes without rounding, and their terms, in units in which members have length 1."""
    members = without_rounding(found[0], terms[0])
    slopes = without_rounding(found[1], terms[1])
    rows, columns = balance(members.reshape(-1, members.shape[-1]))
    rows = rows.reshape(members.shape[:-1])
    scale = rows[..., None] * columns  # of w; of ∂w/∂x
    bend = scale[: slopes.shape[0], ..., None] / columns
    return (members * scale, slopes * bend), (terms[0] * scale, terms[1] * bend)


def _ad_ladder(
    drifts: Sequence[Callable[[State], jax.Array]], inputs: Sequence[Callable[[State], jax.Array]], x: State
) -> tuple[jax.Array, jax.Array]:
    """ad_f^k g_j(x) for k < count, shape (count, m, n), and their slopes for k < count − 1, with one more axis.

    Args:
      drifts: f, shape (1, n), ``count`` times.
      inputs: the fields g, shape (m, n), the first of which is used.
      x: the state.
    """
    gs = inputs[0]
    if len(drifts) == 1:
        here = gs(x)
        return here[None], jnp.zeros((0, *here.shape, x.shape[0]), x.dtype)

    def ladder(y):
        return (gs(y),)

    def longer(shorter, f):
        def step(y):
            found, changes = along(shorter, y, f(y))  # changes[-1] is (∂w/∂y) f, shape (1, m, n)
            _, bends = along(f, y, found[-1])  # (∂f/∂y) w, shape (m, 1, n)
            return (*found, changes[-1][0] - bends[:, 0])

        return step

    for f in drifts[2:]:
        ladder = longer(ladder, f)
    # The slopes of the last one give the next one, without differentiating once more.
    found, slopes = along(ladder, x, jnp.eye(x.shape[0], dtype=x.dtype))
    slopes = jnp.moveaxis(jnp.stack(slopes), 1, -1)  # (count − 1, m, n, n)
    last = drifts[1]
    _, bends = along(last, x, found[-1])
    # (∂w/∂x) f − (∂f/∂x) w for the last w
    return jnp.stack([*found, slopes[-1] @ last(x)[0] - bends[:, 0]]), slopes


def _bracket_residue(spanned: Distribution, kept: Array, members: Array, slopes: Array, terms: Array) -> jax.Array:
    """The largest part outside of the span of a bracket of two members, relative to the terms of the brackets.

    Args:
      spanned: the span of the generations that are kept.
      kept: a mask of generations, shape (k,).
      members: shape (k, m, n), of length 1.
      slopes: shape (k, m, n, n).
      terms: of the slopes.
    """
    n = members.shape[-1]
    v, dv, made_of = members.reshape(-1, n), slopes.reshape(-1, n, n), terms.reshape(-1, n, n)  # one member a row
    counts = jnp.repeat(kept, members.shape[1], total_repeat_length=len(v))
    products = jnp.einsum("bij,aj->abi", dv, v)  # (∂w/∂x) v
    brackets = products - products.swapaxes(0, 1)
    # zeros past the rank instead of fewer columns: the rank differs from point to point, and this is vmapped over them
    basis = spanned.directions * spanned.counted
    rest = brackets - brackets @ basis @ basis.T
    # what this very bracket is made of: one steep pair must not hide another; slopes that are rounding count as none
    steep = jnp.abs(dv) + ROUNDING * jnp.finfo(v.dtype).eps ** 0.5 * made_of
    parts = jnp.einsum("bij,aj->abi", steep, jnp.abs(v))
    scale, left = (jnp.sqrt(jnp.sum(part * part, axis=-1)) for part in (parts + parts.swapaxes(0, 1), rest))
    return jnp.max(jnp.where(counts[:, None] & counts & (scale > 0), left / jnp.where(scale > 0, scale, 1), 0))
