"""Distributions: the span of vector fields and their brackets, or of outputs and their derivatives, at a state.

    reachability       span of the fields and their brackets [X_k, [… [X_2, X_1]]]           (4.5)
    observability      span of d(L_{X_1} … L_{X_k} h_j)                                      (4.11)

with X_i among f, g_1, …, g_m. Right-nested brackets are enough, because they span the whole Lie algebra. The rank at
one state is the number of singular values above ``tolerance`` times the largest one, √eps of the dtype by default
(1.5e-8 in float64). Rounding is removed and units are balanced before (see ``scaling``).

Cost: the program of depth k holds 2^k derivatives, and the number of brackets grows like (number of fields)^k.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.geometry.brackets import Field, Ladder, along, as_fields, as_pytree, decide, stack_fields, stack_outputs
from hjbjax.geometry.scaling import Copies, balance, with_terms, without_rounding
from hjbjax.problem import arguments
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.types import Array, Number, State

Generations: TypeAlias = tuple[Sequence[Array], Sequence[Array]]  # vectors (members, n) and terms, per generation


@pytree_dataclass()
class Distribution:
    """The span of vectors at one point, and how clear its rank is.

    Args:
      vectors: the spanning vectors, shape (p, n).
      directions: orthonormal columns, shape (n, min(n, p)); the first k belong to the k largest singular values.
      singular_values: the singular values of ``vectors`` in balanced units, in decreasing order, shape (min(n, p),).
      tolerance: singular values above this fraction of the largest one count.
    """

    vectors: Array
    directions: Array
    singular_values: Array
    tolerance: Number

    @property
    @front_door
    def counted(self) -> Array:
        """A mask of the singular values that count towards the rank, shape (min(n, p),)."""
        # strictly above, so that the rank is 0 if all fields are zero
        return self.singular_values > self.tolerance * self.singular_values[0]

    @property
    @front_door
    def rank(self) -> int | jax.Array:
        """The number of singular values that count; an int outside a trace."""
        rank = self.counted.sum()
        return rank if is_traced(rank) else int(rank)

    @property
    @front_door
    def basis(self) -> Array:
        """An orthonormal basis in columns, shape (n, rank); under a tracer all columns, zero beyond the rank."""
        # a traced rank cannot be a shape, and the projection B Bᵀ is the same with columns of zeros
        if is_traced(self.singular_values):
            return self.directions * self.counted
        return self.directions[:, : self.rank]

    @property
    @front_door
    def margin(self) -> Number:
        """The ratio of the smallest singular value that counts to the largest; compare with ``tolerance``."""
        return self._largest_ratio(jnp.where(self.counted, self.singular_values, jnp.inf).min())

    @property
    @front_door
    def residue(self) -> Number:
        """The ratio of the largest singular value that does not count to the largest; compare with ``tolerance``."""
        return self._largest_ratio(jnp.where(self.counted, 0.0, self.singular_values).max())

    def _largest_ratio(self, value: Array) -> Number:
        largest = self.singular_values[0]
        # divide by 1 if all fields are zero, because a ``where`` after 0/0 keeps NaN out of the value but not out of
        # the gradient; ``value`` is infinite if no singular value counts
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

    Generation 1 consists of the brackets of two fields, and generation k of the brackets of a field with a member of
    generation k − 1. Rank n means that the states reachable from x contain an open set (accessibility). Without drift
    it also means that x is locally controllable. The rank never decreases with the depth.

    Args:
      f: the drift; ``None`` for a system without drift.
      gs: the input fields, a sequence of functions or one function.
      x: the state, shape (n,).
      depth: number of generations of brackets; 0 for the fields only.

    Keyword Args:
      tolerance: singular values above this fraction of the largest one count; ``None`` is √eps.

    Returns:
      A Distribution, with ``rank``, ``basis``, ``margin`` and ``residue``.

    Raises:
      ValueError: the depth is not an integer ≥ 0, a field has the wrong shape, or a number is not finite.

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

    Rank n means that suitable inputs distinguish x from nearby states by their outputs (local observability). It says
    nothing about states that are far apart.

    Args:
      f: the drift; ``None`` for a system without drift.
      gs: the input fields, a sequence of functions or one function; empty without inputs.
      h: the output, a function of one state that returns one number or shape (outputs,).
      x: the state, shape (n,).
      depth: number of Lie derivatives; 0 for the outputs only. n − 1 is enough if the rank is constant near x.

    Keyword Args:
      tolerance: singular values above this fraction of the largest one count; ``None`` is √eps.

    Returns:
      A Distribution of covectors.

    Raises:
      ValueError: the depth is not an integer ≥ 0, a field has the wrong shape, or a number is not finite.

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

    def build(copies: Copies, y: State) -> tuple[jax.Array, ...]:
        (first, *others) = copies[0]

        def fields_themselves(state: State) -> tuple[jax.Array, ...]:
            return (first(state),)

        generations: Ladder = fields_themselves
        for field in others:
            generations = _with_brackets(field, generations)
        return generations(y)

    return with_terms(build, [stack_fields(fields)], x, depth + 1)


def _with_brackets(fields: Callable[[State], jax.Array], generations: Ladder) -> Ladder:
    """Append one generation: the brackets of every field with every member of the last generation."""

    def longer(x: State) -> tuple[jax.Array, ...]:
        found, changes = along(generations, x, fields(x))  # (∂Y/∂x) X is changes[-1], shape (fields, members, n)
        _, bends = along(fields, x, found[-1])  # (∂X/∂x) Y, shape (members, fields, n)
        brackets = changes[-1] - bends.swapaxes(0, 1)  # [X, Y] by (4.4), every field X with every member Y
        return (*found, brackets.reshape(-1, x.shape[0]))

    return longer


def _observe(functions: tuple[tuple[Field, ...], Callable], x: State, tolerance: Number, *, depth: int) -> Generations:
    """The differentials of the outputs and of ``depth`` generations of their Lie derivatives, and their terms."""
    fields, h = functions
    depth = depth if fields else 0

    def build(copies: Copies, y: State) -> tuple[jax.Array, ...]:
        outputs, *others = copies

        def outputs_themselves(state: State) -> tuple[jax.Array, ...]:
            return (outputs[0](state),)

        generations: Ladder = outputs_themselves
        for field in others[0][:depth] if others else ():
            generations = _with_derivatives(field, generations)
        # one Jacobian of all generations, because separate Jacobians would evaluate the shorter ones again
        return jax.jacfwd(generations)(y)

    stacked = [stack_outputs(h), stack_fields(fields)] if fields else [stack_outputs(h)]
    return with_terms(build, stacked, x, max(depth, 1))


def _with_derivatives(fields: Callable[[State], jax.Array], generations: Ladder) -> Ladder:
    """Append one generation: the derivatives of the last generation along every field."""

    def longer(x: State) -> tuple[jax.Array, ...]:
        found, changes = along(generations, x, fields(x))
        return (*found, changes[-1].reshape(-1))  # from (fields, members)

    return longer


def _span_of_generations(generations: Generations, x: State, tolerance: Number) -> Distribution:
    """The Distribution of all generations, with the directions of the first generations that reach the highest rank."""
    values, terms = generations
    vectors, sizes = jnp.concatenate(values), jnp.concatenate(terms)
    # many long brackets near one direction make other vectors relatively small; keep the span of the shorter brackets
    ends = np.cumsum([len(generation) for generation in values])
    first = jnp.asarray(np.arange(ends[-1]) < ends[:, None])
    spans = jax.vmap(lambda kept: span(jnp.where(kept[:, None], vectors, 0), tolerance, sizes))(first)
    counted = jax.vmap(lambda one: one.counted)(spans)
    best = jnp.argmax(jnp.sum(counted, axis=-1))
    # the residue of the verdict is the largest singular value, over all spans, that does not count
    shares = spans.singular_values / jnp.where(spans.singular_values[:, :1] > 0, spans.singular_values[:, :1], 1)
    chosen = spans.singular_values[best]
    beside = jnp.where(counted, 0, shares).max(axis=0) * chosen[0]
    counts = jnp.arange(len(chosen)) < jnp.sum(counted[best])
    return Distribution(
        vectors, spans.directions[best], jnp.where(counts, chosen, beside), jnp.asarray(tolerance, vectors.dtype)
    )


def span(vectors: Array, tolerance: Number, terms: Array) -> Distribution:
    """The Distribution of row vectors and the sizes of their terms, both of shape (p, n)."""
    kept = without_rounding(vectors, terms)
    rows, columns = balance(kept)
    # singular values instead of a QR decomposition, because they show how clear the rank is
    scaled, values, _ = jnp.linalg.svd((rows[:, None] * kept * columns).T, full_matrices=False)
    # return to the units of the states; QR preserves the span of the first k columns for every k
    directions, _ = jnp.linalg.qr(scaled / columns[:, None])
    return Distribution(vectors, directions, values, jnp.asarray(tolerance, vectors.dtype))
