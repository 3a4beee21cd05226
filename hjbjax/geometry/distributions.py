"""Distributions: what vector fields and their brackets, or outputs and their derivatives, span at a state.

    reachability       span of the fields and their brackets [X_k, [… [X_2, X_1]]]           (4.5)
    observability      span of d(L_{X_1} … L_{X_k} h_j)                                      (4.11)

with X_i out of f, g_1, …, g_m. Right-nested brackets are enough: they span the whole Lie algebra. A rank is decided by
singular values in units in which vectors and states compare (``scaling``), without what is rounding: those above
``tolerance`` times the largest count, and the tolerance is √eps of the dtype (1.5e-8 in float64) unless given. It is
the rank at one state.

Cost: the program of depth k holds 2^k derivatives, and the number of brackets grows like (number of fields)^k.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.geometry.brackets import Field, along, as_fields, as_pytree, decide, stack_fields, stack_outputs
from hjbjax.geometry.scaling import balance, with_terms, without_rounding
from hjbjax.problem import arguments
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.types import Array, Number, State

Generations: TypeAlias = tuple[Sequence[Array], Sequence[Array]]  # vectors of each, (members, n), and their terms


@pytree_dataclass()
class Distribution:
    """The span of vectors at one point, and how clear its rank is.

    Args:
      vectors: what spans it, shape (p, n).
      directions: orthonormal; the first k span what the k largest singular values belong to, shape (n, min(n, p)).
      singular_values: of the directions of ``vectors``, each scaled to length 1 in units in which the states compare;
        falling, shape (min(n, p),).
      tolerance: what counts, as a part of the largest singular value.
    """

    vectors: Array
    directions: Array
    singular_values: Array
    tolerance: Number

    @property
    @front_door
    def counted(self) -> Array:
        """A mask of the singular values that count towards the rank, shape (min(n, p),)."""
        # strictly above, so that fields that all vanish have rank 0
        return self.singular_values > self.tolerance * self.singular_values[0]

    @property
    @front_door
    def rank(self) -> int | jax.Array:
        """The number of singular values that count; an int outside of a trace."""
        rank = self.counted.sum()
        return rank if is_traced(rank) else int(rank)

    @property
    @front_door
    def basis(self) -> Array:
        """An orthonormal basis in columns, shape (n, rank); under a tracer all directions, with zeros past the rank."""
        # a traced rank is no shape, and a projection B Bᵀ is the same with columns of zeros
        if is_traced(self.singular_values):
            return self.directions * self.counted
        return self.directions[:, : self.rank]

    @property
    @front_door
    def margin(self) -> Number:
        """The smallest singular value that counts over the largest; compare with ``tolerance``."""
        return self._largest_ratio(jnp.where(self.counted, self.singular_values, jnp.inf).min())

    @property
    @front_door
    def residue(self) -> Number:
        """The largest singular value that does not count over the largest; compare with ``tolerance``."""
        return self._largest_ratio(jnp.where(self.counted, 0.0, self.singular_values).max())

    def _largest_ratio(self, value: Array) -> Number:
        largest = self.singular_values[0]
        # over a safe 1 where all fields vanish: a ``where`` after 0/0 keeps NaN out of the value and not of a gradient;
        # ``value`` is infinite where it is the least of no singular values at all
        ratio = jnp.where((largest > 0) & jnp.isfinite(value), value / jnp.where(largest > 0, largest, 1.0), 0.0)
        return ratio if is_traced(ratio) else float(ratio)


@front_door
def reachability_distribution(
    f: Field | None,
    gs: Field | Sequence[Field],
    x: State | Sequence[float],
    depth: int,
    *,
    tolerance: Number | None = None,
) -> Distribution:
    """The span of f, the g_j and their brackets at a state (4.5).

    The first generation holds the brackets of two fields, generation k those of a field with one of generation
    k − 1. Rank n says that the states reachable from x in any time fill an open set (accessibility), and without
    drift that x is locally controllable. It never falls with the depth.

    Args:
      f: the drift; ``None`` for a system without drift.
      gs: the input fields, a sequence of functions or one function.
      x: the state, shape (n,).
      depth: generations of brackets, 0 for the fields alone.

    Keyword Args:
      tolerance: which part of the largest singular value counts; ``None`` is √eps.

    Returns:
      A Distribution, with ``rank``, ``basis``, ``margin`` and ``residue``.

    Raises:
      ValueError: a depth that is no integer ≥ 0, a field of the wrong shape, or a number that is not finite.

    Example:
      >>> parabola = lambda x: jnp.stack([0.0, x[0] ** 2])      # with the input field below: Example 4.1
      >>> push = lambda x: jnp.array([1.0, 0.0])
      >>> [reachability_distribution(parabola, push, [0.0, 5.0], depth).rank for depth in (0, 1, 2)]
      [1, 1, 2]
    """
    arguments.count(depth, "reachability_distribution: depth", least=0)
    fields = as_fields(f, gs)
    return decide(_reach, _span_of_generations, fields, x, tolerance, depth=int(depth))


@front_door
def observability_codistribution(
    f: Field | None,
    gs: Field | Sequence[Field],
    h: Callable,
    x: State | Sequence[float],
    depth: int,
    *,
    tolerance: Number | None = None,
) -> Distribution:
    """The span of the differentials of the outputs and of their Lie derivatives at a state (4.11).

    Rank n says that states near x are told apart by their outputs under suitable inputs (local observability);
    it says nothing of states far from each other.

    Args:
      f: the drift; ``None`` for a system without drift.
      gs: the input fields, a sequence of functions or one function; empty without inputs.
      h: the output, a function of one state that returns one number or shape (outputs,).
      x: the state, shape (n,).
      depth: how many Lie derivatives, 0 for the outputs alone; n − 1 is enough for a rank that is constant near x.

    Keyword Args:
      tolerance: which part of the largest singular value counts; ``None`` is √eps.

    Returns:
      A Distribution of covectors.

    Raises:
      ValueError: a depth that is no integer ≥ 0, a field of the wrong shape, or a number that is not finite.

    Example:
      >>> swing = lambda x: jnp.stack([x[1], jnp.sin(x[0])])
      >>> observability_codistribution(swing, [], lambda x: x[0], [0.3, 0.0], 1).rank
      2
    """
    arguments.count(depth, "observability_codistribution: depth", least=0)
    fields = as_fields(f, gs)
    return decide(_observe, _span_of_generations, (fields, as_pytree(h)), x, tolerance, depth=int(depth))


def _reach(fields: tuple[Field, ...], x: State, tolerance: Number, *, depth: int) -> Generations:
    """The fields and ``depth`` generations of brackets, and their terms."""

    def build(copies, y):
        (first, *others) = copies[0]

        def generations(state):
            return (first(state),)

        for field in others:
            generations = _with_brackets(field, generations)
        return generations(y)

    return with_terms(build, [stack_fields(fields)], x, depth + 1)


def _with_brackets(
    fields: Callable[[State], jax.Array], generations: Callable[[State], tuple[jax.Array, ...]]
) -> Callable[[State], tuple[jax.Array, ...]]:
    """The generations and one more: the brackets of every field with every member of the last one."""

    def longer(x):
        found, changes = along(generations, x, fields(x))  # (∂Y/∂x) X is changes[-1], shape (fields, members, n)
        _, bends = along(fields, x, found[-1])  # (∂X/∂x) Y, shape (members, fields, n)
        brackets = changes[-1] - bends.swapaxes(0, 1)  # [X, Y] by (4.4), every field X with every member Y
        return (*found, brackets.reshape(-1, x.shape[0]))

    return longer


def _observe(functions: tuple[tuple[Field, ...], Callable], x: State, tolerance: Number, *, depth: int) -> Generations:
    """The differentials of the outputs and of ``depth`` generations of their Lie derivatives, and their terms."""
    fields, h = functions
    depth = depth if fields else 0

    def build(copies, y):
        outputs, *others = copies

        def generations(state):
            return (outputs[0](state),)

        for field in others[0][:depth] if others else ():
            generations = _with_derivatives(field, generations)
        # one Jacobian of all generations, each (members, n): taken of each alone it would evaluate the shorter again
        return jax.jacfwd(generations)(y)

    stacked = [stack_outputs(h), stack_fields(fields)] if fields else [stack_outputs(h)]
    return with_terms(build, stacked, x, max(depth, 1))


def _with_derivatives(
    fields: Callable[[State], jax.Array], generations: Callable[[State], tuple[jax.Array, ...]]
) -> Callable[[State], tuple[jax.Array, ...]]:
    """The generations and one more: the derivatives of the last one along every field."""

    def longer(x):
        found, changes = along(generations, x, fields(x))
        return (*found, changes[-1].reshape(-1))  # from (fields, members)

    return longer


def _span_of_generations(generations: Generations, x: State, tolerance: Number) -> Distribution:
    """The Distribution of all generations, with the directions of the first ones that have the highest rank."""
    values, terms = generations
    vectors, sizes = jnp.concatenate(values), jnp.concatenate(terms)
    # Many long brackets near one direction make the others small beside it: what shorter ones span stays spanned.
    ends = np.cumsum([len(generation) for generation in values])
    first = jnp.asarray(np.arange(ends[-1]) < ends[:, None])
    spans = jax.vmap(lambda kept: span(jnp.where(kept[:, None], vectors, 0), tolerance, sizes))(first)
    counted = jax.vmap(lambda one: one.counted)(spans)
    best = jnp.argmax(jnp.sum(counted, axis=-1))
    # what any of them shows beside that rank, and does not count, is the residue of the verdict
    shares = spans.singular_values / jnp.where(spans.singular_values[:, :1] > 0, spans.singular_values[:, :1], 1)
    chosen = spans.singular_values[best]
    beside = jnp.where(counted, 0, shares).max(axis=0) * chosen[0]
    counts = jnp.arange(len(chosen)) < jnp.sum(counted[best])
    return Distribution(
        vectors, spans.directions[best], jnp.where(counts, chosen, beside), jnp.asarray(tolerance, vectors.dtype)
    )


def span(vectors: Array, tolerance: Number, terms: Array) -> Distribution:
    """The Distribution of row vectors made of terms of the sizes given, both of shape (p, n)."""
    kept = without_rounding(vectors, terms)
    rows, columns = balance(kept)
    # singular values and not a QR decomposition: they say how far the rank is from another one
    scaled, values, _ = jnp.linalg.svd((rows[:, None] * kept * columns).T, full_matrices=False)
    # Back in the units of the states: QR keeps the span of the first columns, however many of them count.
    directions, _ = jnp.linalg.qr(scaled / columns[:, None])
    return Distribution(vectors, directions, values, jnp.asarray(tolerance, vectors.dtype))
