"""Rounding and units of derived quantities: which entries of a bracket are zero, and how to compare vectors.

A bracket, or a derivative of an output, is a sum of products of the fields' values and slopes. To find the size of
these terms, every value and slope is perturbed by a small random fraction of itself. The change of the sum, divided by
this fraction, is the size of the terms. Rounding changes the sum by eps times this size, and a sum of that magnitude
counts as zero. A number in a field may itself be rounding, such as cos(π/2). It is then perturbed by a fraction of the
largest number in the same row or column.

Ranks must not depend on the units of states, inputs and time. ``balance`` finds the scales of rows and columns that
make the entries of a matrix closest to 1, by least squares for their logarithms (A. R. Curtis and J. K. Reid, IMA J.
Appl. Math. 10, 1972). The result is the same in all units. A few sweeps then bring columns and rows to length 1.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.types import Array, Scalar, State

Function: TypeAlias = Callable[[State], jax.Array]
T = TypeVar("T")
Copies: TypeAlias = Sequence[Sequence[Function]]  # the perturbed copies of every function
Build: TypeAlias = Callable[[Copies, State], T]  # a pytree of arrays

DRAWS = 8  # random perturbations; the chance that all change a sum of two terms by less than 1 % of its size is 1e-16
NEGLIGIBLE = 16  # times eps: entries of a vector differ by units, but not by a factor of 3e-15
ROUNDING = 128  # times eps and the terms; brackets of five fields with thousands of operations give about 10
SWEEPS = 12


def with_terms(build: Build[T], functions: Sequence[Function], x: State, uses: int) -> tuple[T, T]:
    """Evaluate ``build`` at x, and the size of the terms of each entry of its result.

    Args:
      build: takes ``uses`` copies of every function, and the state. The copies are perturbed independently, otherwise
        terms that cancel for all functions would cancel for every perturbation.
      functions: functions of one state that return fields, shape (m, n), or outputs, shape (outputs,).
      x: the state, shape (n,).
      uses: number of copies of each function.
    """
    part = jnp.finfo(x.dtype).eps ** 0.75  # 2^-39 in float64: far above rounding, and its square is far below rounding
    sizes = [(function(x), jax.jacfwd(function)(x)) for function in functions]
    sizes = [_changeable(value, slopes) for value, slopes in sizes]
    # fixed seed, so that the verdict is the same in every call, traced or not
    random = np.random.default_rng(0)

    def draws(shape: tuple[int, ...]) -> jax.Array:
        # the first draw is zero and evaluates the functions themselves
        spread = random.uniform(-1.0, 1.0, (DRAWS, *shape))
        return jnp.asarray(np.concatenate([np.zeros((1, *shape)), spread]), x.dtype) * part

    places = draws(x.shape)
    changes = [[tuple(draws(size.shape) * size for size in pair) for _ in range(uses)] for pair in sizes]

    def once(place: jax.Array, change: Sequence[Sequence[tuple[jax.Array, ...]]]) -> T:
        copies = [
            [_changed(function, x, *pair) for pair in pairs] for function, pairs in zip(functions, change, strict=True)
        ]
        return build(copies, x * (1 + place))

    found = jax.vmap(once)(places, changes)
    values = jax.tree.map(lambda entry: entry[0], found)
    terms = jax.tree.map(lambda entry: jnp.max(jnp.abs(entry[1:] - entry[0]), axis=0) / part, found)
    return values, terms


def _changeable(value: Array, slopes: Array) -> tuple[jax.Array, jax.Array]:
    """The possible errors of values and slopes: their own size, or the size of the largest number next to them."""
    row = jnp.max(jnp.abs(slopes), axis=-1, keepdims=True)
    if value.ndim == 1:  # outputs; each has its own units
        return jnp.abs(value), _own_or_beside(slopes, row)
    # the smaller of row and column, because in other units a whole row or a whole column may be large
    beside = jnp.minimum(row, jnp.max(jnp.abs(slopes), axis=-2, keepdims=True))
    return _own_or_beside(value, jnp.max(jnp.abs(value), axis=-1, keepdims=True)), _own_or_beside(slopes, beside)


def _own_or_beside(numbers: Array, beside: Array) -> jax.Array:
    """The sizes of numbers. A number that is only rounding compared with the size in ``beside`` gets that size."""
    size = jnp.abs(numbers)
    # zeros are exact; a number this small is cos(π/2) or 0.1 + 0.2 − 0.3 and not an effect of units
    return jnp.where((size > 0) & (size < NEGLIGIBLE * jnp.finfo(size.dtype).eps * beside), beside, size)


def _changed(function: Function, x: State, value: Array, slopes: Array) -> Function:
    """The function plus perturbations of its value and its slopes at x."""
    return lambda y: function(y) + value + slopes @ (y - x)


def without_rounding(values: Array, terms: Array) -> jax.Array:
    """The values, with zero where a value is only rounding of its terms."""
    return jnp.where(jnp.abs(values) > ROUNDING * jnp.finfo(values.dtype).eps * terms, values, 0)


def balance(matrix: Array) -> tuple[jax.Array, jax.Array]:
    """Scales of rows (p,) and columns (n,) that make rows of length 1, and columns of equal length if possible."""
    there = matrix != 0
    logs = jnp.where(there, jnp.log(jnp.where(there, jnp.abs(matrix), 1)), 0)
    # minimise Σ (logs_ij + r_i + c_j)² over the nonzero entries, with r eliminated
    rows, columns = jnp.maximum(jnp.sum(there, axis=1), 1), jnp.sum(there, axis=0)
    share = there / rows[:, None]
    normal = jnp.diag(columns) - there.T @ share
    right = share.T @ jnp.sum(logs, axis=1) - jnp.sum(logs, axis=0)
    c = jnp.linalg.pinv(normal.astype(logs.dtype), rtol=1e-4, hermitian=True) @ right
    r = -jnp.sum(jnp.where(there, logs + c, 0), axis=1) / rows

    def sweep(_: Scalar, scales: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        r, c = scales
        size = jnp.where(there, jnp.exp(logs + r[:, None] + c), 0)
        c = c - _log_length(size, 0)
        size = jnp.where(there, jnp.exp(logs + r[:, None] + c), 0)
        return r - _log_length(size, 1), c

    r, c = jax.lax.fori_loop(0, SWEEPS, sweep, (r, c))
    return jnp.exp(r), jnp.exp(c)


def _log_length(size: Array, axis: int) -> jax.Array:
    """Logarithms of the lengths of rows or columns; 0 for a row or column of zeros."""
    square = jnp.sum(size * size, axis=axis)
    return jnp.log(jnp.where(square > 0, square, 1)) / 2
