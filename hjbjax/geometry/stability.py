"""Stability: Lyapunov functions and Brockett's necessary condition.

``lyapunov_check`` searches a region for violations of a Lyapunov function; it is defined in ``lyapunov``.

Brockett's condition: if a continuous state feedback makes x_e asymptotically stable, then the image of (x, u) ↦ f(x, u)
contains a neighbourhood of zero. A driftless system with m < n fields that are independent at x_e violates it: in
coordinates in which the first m rows of the fields are invertible, (0, ε) is not in the image. Source: M. D.
Kvalheim and D. E. Koditschek, Necessary conditions for feedback stabilization and safety, arXiv:2106.00215, which
states Brockett's theorem of 1983.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.geometry.brackets import Field, as_fields, decide, near, stack_fields
from hjbjax.geometry.distributions import Distribution, span
from hjbjax.geometry.lyapunov import LyapunovReport, lyapunov_check, lyapunov_derivative
from hjbjax.geometry.scaling import Copies, balance, with_terms, without_rounding
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.types import Array, Number, State

__all__ = ["BrockettVerdict", "LyapunovReport", "brockett_check", "lyapunov_check", "lyapunov_derivative"]


@pytree_dataclass(static=("message",))
class BrockettVerdict:
    """The result of ``brockett_check``.

    Args:
      satisfied: ``False`` excludes a continuous stabilising state feedback, ``True`` does not guarantee one, ``None``
        is undecided.
      rank: the rank of (∂f/∂x, ∂f/∂u) at the state.
      margin: the ratio of the smallest singular value that counts towards the rank to the largest one.
      message: the reason in words.
    """

    satisfied: bool | None
    rank: int
    margin: float
    message: str


@front_door
def brockett_check(
    f: Field | None, gs: Field | Sequence[Field], x: State | Sequence[float], *, tolerance: Number | None = None
) -> BrockettVerdict:
    """Check Brockett's necessary condition for a continuous feedback u(x) that stabilises a rest point asymptotically.

    The check uses first derivatives at x, so it can be undecided. If there is no drift, or if the drift is zero near x,
    it uses the fields themselves. Otherwise it uses the rank of (∂f/∂x, ∂f/∂u): rank n satisfies the condition.

    Args:
      f: the drift; ``None`` for a system without drift.
      gs: the input fields, a sequence of functions or one function.
      x: the state to be stabilised, shape (n,), where some input keeps the system at rest.

    Keyword Args:
      tolerance: singular values above this fraction of the largest one count; ``None`` is √eps.

    Returns:
      A BrockettVerdict, with ``satisfied`` and a ``message``.

    Raises:
      ValueError: no input keeps the system at rest at x, or a field has the wrong shape or is not finite there.

    Example:
      >>> drive = lambda x: jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]), 0.0])
      >>> turn = lambda x: jnp.array([0.0, 0.0, 1.0])
      >>> print(brockett_check(None, [drive, turn], jnp.zeros(3)).message)
      violated: 2 independent fields move 3 states without drift; no continuous u(x) makes this state stable
    """
    fields = as_fields(f, gs)
    linear, unbalanced, driftless = decide(_linearisation, _rank_and_rest, fields, x, tolerance, drift=f is not None)
    n, m, rank = linear.vectors.shape[1], len(fields) - (f is not None), int(linear.rank)
    # about √eps of float64, because x often comes from a root finder or a rounded formula
    if unbalanced > 1e-8:
        raise ValueError(
            f"brockett_check: no input keeps the system at rest at x = {np.asarray(x).tolist()}: "
            f"the part of the drift outside the span of the fields is {unbalanced:.2g} of its size"
        )
    satisfied: bool | None
    # if the linearisation is onto, the inverse function theorem gives a neighbourhood of zero in the image of f
    if rank == n:
        satisfied, reason = True, "satisfied: the linearisation moves the state in every direction"
    # see the module's docstring; fields that are dependent at x may be independent nearby, so they decide nothing
    elif driftless and rank == m:
        fields_and_states = f"{m} independent fields move {n} states without drift"
        satisfied, reason = False, f"violated: {fields_and_states}; no continuous u(x) makes this state stable"
    else:
        satisfied, reason = None, f"undecided: the linearisation has rank {rank} of {n}, and higher orders decide"
    return BrockettVerdict(satisfied, rank, float(linear.margin), reason)


def _linearisation(
    fields: tuple[Field, ...], x: State, tolerance: Number, *, drift: bool
) -> tuple[tuple[Array, Array], tuple[Array, Array] | None, jax.Array]:
    """The fields and the ∂f_k/∂x at x, each with the size of its terms, and whether the drift is zero near x."""
    field = stack_fields(fields)
    # without drift, u = 0 keeps every state at rest, and then ∂f/∂x = Σ u_j ∂g_j/∂x is zero
    if not drift:
        return with_terms(lambda copies, y: copies[0][0](y), [field], x, 1), None, jnp.asarray(True)

    def build(copies: Copies, y: State) -> tuple[jax.Array, jax.Array]:
        return copies[0][0](y), jax.jacfwd(copies[0][0])(y)

    (values, slopes), (sizes, bends) = with_terms(build, [field], x, 1)
    around = jax.vmap(lambda y: field(y)[0])(near(x, np.full(x.shape[0], 0.1), 16))
    return (values, sizes), (slopes, bends), jnp.all(around == 0)


def _rank_and_rest(
    found: tuple[tuple[Array, Array], tuple[Array, Array] | None, Array], x: State, tolerance: Number
) -> tuple[Distribution, Array, Array]:
    """(∂f/∂x, ∂f/∂u) at x for the best balancing input, the unbalanced fraction of the drift, and ``driftless``."""
    (values, sizes), derivatives, driftless = found
    if derivatives is None:
        return span(values, tolerance, sizes), jnp.zeros((), x.dtype), driftless
    u, left = _balancing_input(without_rounding(values, sizes))
    # the rows are the columns of ∂f/∂x + Σ u_j ∂g_j/∂x, then the fields
    inputs = jnp.append(1.0, u).astype(x.dtype)
    slopes = jnp.einsum("k,kij->ji", inputs, derivatives[0])
    bends = jnp.einsum("k,kij->ji", jnp.abs(inputs), derivatives[1])
    vectors, terms = jnp.concatenate([slopes, values[1:]]), jnp.concatenate([bends, sizes[1:]])
    return span(vectors, tolerance, terms), left, driftless


def _balancing_input(vectors: Array) -> tuple[jax.Array, jax.Array]:
    """The input that best balances the drift ``vectors[0]``, shape (m,), and the unbalanced fraction of the drift."""
    rows, columns = balance(vectors)
    scaled = rows[:, None] * vectors * columns  # length 1, so the units of states and fields do not matter
    f, gs = scaled[0], scaled[1:].T
    # least squares, because the balancing input may not be unique; the residual shows if there is none
    u, *_ = jnp.linalg.lstsq(gs, -f)
    return u * rows[1:] / rows[0], jnp.sqrt(jnp.sum((f + gs @ u) ** 2))
