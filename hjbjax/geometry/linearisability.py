"""Geometry of control systems ẋ = f(x) + Σ g_j(x) u_j: brackets, ranks, and exact linearisation by feedback.

Lie derivatives and brackets, reachability and observability, relative degree and linearising feedback are defined in
``brackets``, ``distributions`` and ``feedback_linearisation``, and are all found here. With G_k(x) the span of ad_f^i
g_j(x), i ≤ k, the system is linearised at x by a change of coordinates and a feedback exactly when (§5 with one
input)

    G_{n−1}(x) has dimension n,     G_k is involutive near x for k ≤ n − 2,     G_k has constant dimension near x

With one input the first condition implies the third, and the second is needed for k = n − 2 alone. "Near x" and the
tolerance are those of ``feedback_linearisation``; each condition comes with its margin.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.geometry.brackets import (
    Field,
    along,
    as_fields,
    decide,
    stack_fields,
)
from hjbjax.geometry.distributions import Distribution, span
from hjbjax.geometry.feedback_linearisation import (
    as_bool,
    near,
)
from hjbjax.problem import arguments
from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.types import Array, Number, State


@pytree_dataclass()
class Linearisability:
    """The verdict on linearisation by feedback, with the conditions it follows from.

    Args:
      ranks: the dimensions of G_0, G_1, … at the state, up to the first that is n or to G_{n−1}.
      independence: the n-th singular value of the last of them over the first; above ``tolerance`` where it has rank n.
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
    def independent(self) -> bool | jax.Array:
        """The first condition: G_{n−1} has dimension n; with one input, {ad_f^k g, k ≤ n − 1} is independent."""
        return as_bool(self.independence > self.tolerance)

    @property
    def involutive(self) -> bool | jax.Array:
        """The second condition: G_k is involutive, k ≤ n − 2."""
        return as_bool(self.involutivity <= self.tolerance)

    @property
    def linearisable(self) -> bool | jax.Array:
        """Whether the system is independent, involutive and regular."""
        # with & on arrays: ``and`` would ask a tracer for its truth
        return as_bool(
            (self.independence > self.tolerance) & (self.involutivity <= self.tolerance) & jnp.asarray(self.regular)
        )


def is_feedback_linearisable(
    f: Field,
    g: Field | Sequence[Field],
    x: State | Sequence[float],
    *,
    radius: float = 0.1,
    samples: int = 16,
    tolerance: Number | None = None,
) -> Linearisability:
    """Linearisability near a state: ẋ = f + g u made linear and controllable by coordinates and a feedback (§5).

    Args:
      f: the drift.
      g: the input field, or a sequence of them.
      x: the state, shape (n,).

    Keyword Args:
      radius: how far from x is near, in the units of the state.
      samples: how many points near x are looked at.
      tolerance: what counts as zero, relative to what it is made of; ``None`` is √eps.

    Returns:
      A Linearisability, with ``linearisable``, the conditions and their margins.

    Raises:
      ValueError: a field of the wrong shape, or a derivative that is not finite near x.

    Example:
      >>> pendulum = lambda x: jnp.stack([x[1], jnp.sin(x[0])])
      >>> is_feedback_linearisable(pendulum, lambda x: jnp.array([0.0, 1.0]), [0.5, 0.0]).linearisable
      True
    """
    arguments.count(samples, "is_feedback_linearisable: samples", least=0)
    fields = as_fields(f, g)
    settings = {"radius": float(radius), "samples": int(samples)}
    states = np.shape(x)[0] if np.ndim(x) else 1
    # Where G_k is everything the longer brackets add nothing, and with m inputs that can be from k = n/m − 1 on.
    enough = states if is_traced(fields, x, tolerance) else -(-states // max(len(fields) - 1, 1))
    for depth in range(enough, states):
        answer = decide(_linearisability, fields, x, tolerance, **settings, depth=depth)
        if answer.regular and answer.ranks[-1] == states:
            return answer
    return decide(_linearisability, fields, x, tolerance, **settings, depth=states)


def _linearisability(
    fields: tuple[Field, ...], x: State, tolerance: Number, *, radius: float, samples: int, depth: int
) -> Linearisability:
    """The conditions as far as G_0, …, G_{depth − 1} show them."""
    n = x.shape[0]
    # with P points: members (P, depth, m, n), slopes (P, depth − 1, m, n, n)
    members, slopes = jax.vmap(lambda y: _ad_ladder(fields, y, depth))(near(x, radius, samples))
    # In a unit of time in which no bracket is longer than the fields themselves: stiff systems look like others.
    sizes = jnp.sqrt(jnp.sum(members[0] ** 2, axis=(1, 2)))
    # |ad_f^k g| ~ rate^k |g| in the user's unit of time; the rate is the largest k-th root
    grown = jnp.where(sizes[0] > 0, sizes[1:] / jnp.where(sizes[0] > 0, sizes[0], 1), 0) ** (1 / jnp.arange(1, depth))
    rate = jnp.max(grown, initial=0)
    powers = jnp.where(rate > 0, rate, 1) ** jnp.arange(depth)
    members = members / powers[:, None, None]
    slopes = slopes / powers[:-1, None, None, None]

    def at(members, slopes):
        spans = [span(members[: k + 1].reshape(-1, n), tolerance) for k in range(depth)]
        outside = [_bracket_residue(spans[k], members[: k + 1], slopes[: k + 1]) for k in range(depth - 1)]
        ranks = jnp.stack([one.counted.sum() for one in spans])
        return ranks, jnp.max(jnp.stack(outside)) if outside else jnp.zeros((), x.dtype)

    ranks, outside = jax.vmap(at)(members, slopes)
    # at the state itself, which ``near`` puts first; fewer than n rows have fewer than n singular values
    values = span(members[0].reshape(-1, n), tolerance).singular_values
    full = values.shape[0] == n
    independence = jnp.where((values[0] > 0) & full, values[-1] / jnp.where(values[0] > 0, values[0], 1), 0)
    return Linearisability(ranks[0], independence, jnp.max(outside), jnp.all(ranks == ranks[0]), tolerance)


def _ad_ladder(fields: tuple[Field, ...], x: State, count: int) -> tuple[jax.Array, jax.Array]:
    """ad_f^k g_j(x) for k < count, shape (count, m, n), and their slopes for k < count − 1, with one more axis."""
    f, gs = stack_fields(fields[:1]), stack_fields(fields[1:])
    if count == 1:
        return gs(x)[None], jnp.zeros((0, len(fields) - 1, x.shape[0], x.shape[0]), x.dtype)

    def ladder(y):
        return (gs(y),)

    def longer(shorter):
        def step(y):
            found, changes = along(shorter, y, f(y))  # changes[-1] is (∂w/∂y) f, shape (1, m, n)
            _, bends = along(f, y, found[-1])  # (∂f/∂y) w, shape (m, 1, n)
            return (*found, changes[-1][0] - bends[:, 0])

        return step

    for _ in range(count - 2):
        ladder = longer(ladder)
    # The slopes of the last one give the next one, without differentiating once more.
    found, slopes = along(ladder, x, jnp.eye(x.shape[0], dtype=x.dtype))
    slopes = jnp.moveaxis(jnp.stack(slopes), 1, -1)  # (count − 1, m, n, n)
    _, bends = along(f, x, found[-1])
    # (∂w/∂x) f − (∂f/∂x) w for the last w
    return jnp.stack([*found, slopes[-1] @ f(x)[0] - bends[:, 0]]), slopes


def _bracket_residue(spanned: Distribution, members: Array, slopes: Array) -> jax.Array:
    """The largest part outside of the span of a bracket of two members, relative to the terms of the brackets."""
    n = members.shape[-1]
    v, dv = members.reshape(-1, n), slopes.reshape(-1, n, n)  # of all members of G_k, one a row
    terms = jnp.einsum("bij,aj->abi", dv, v)  # (∂w/∂x) v
    brackets = terms - terms.swapaxes(0, 1)
    # zeros past the rank instead of fewer columns: the rank differs from point to point, and this is vmapped over them
    basis = spanned.directions * spanned.counted
    rest = brackets - brackets @ basis @ basis.T
    length, slope = jnp.sqrt(jnp.sum(v * v, axis=-1)), jnp.sqrt(jnp.sum(dv * dv, axis=(-1, -2)))
    # The fields themselves are in the scale, so that slopes that are all rounding count as none.
    scale = jnp.max(length) * (2 * jnp.max(slope) + jnp.max(length))
    return jnp.max(jnp.sqrt(jnp.sum(rest * rest, axis=-1))) / jnp.where(scale > 0, scale, 1)
