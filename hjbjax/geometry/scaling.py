"""Zeros and scales of derived quantities: what of a bracket is rounding, and units in which vectors compare.

A bracket, or a derivative of an output, is a sum of products of the fields' values and slopes. The size of these terms
is found by changing every value and slope at random by a part of itself and looking at what the sum does: rounding
moves it by eps of that, and what is no larger counts as zero. A number in a field may be rounding itself, as cos(π/2)
is, and is then changed by a part of the largest number beside it.

Ranks do not depend on the units of states, inputs and time. The scales of rows and columns that leave the entries of a
matrix closest to 1 are found from a least-squares problem for their logarithms (A. R. Curtis and J. K. Reid, IMA J.
Appl. Math. 10, 1972), which any other units give the same answer; a few sweeps then bring columns and rows to length 1.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.types import Array, State

Function: TypeAlias = Callable[[State], jax.Array]
T = TypeVar("T")
Build: TypeAlias = Callable[[Sequence[Sequence[Function]], State], T]  # a pytree of arrays

DRAWS = 8  # random changes; that all of them leave a sum of two terms to a hundredth of its size has a chance of 1e-16
NEGLIGIBLE = 16  # in units of eps: numbers of one vector are no further apart, 3e-15, because of their units
ROUNDING = 128  # in units of eps and of the terms; brackets of five fields, thousands of operations, leave about 10
SWEEPS = 12


def with_terms(build: Build[T], functions: Sequence[Function], x: State, uses: int) -> tuple[T, T]:
    """What ``build`` makes of functions at x, and for each entry the size of the terms that it is made of.

    Args:
      build: takes ``uses`` copies of every function, and the state; copies that stand in one sum at different places
        are changed independently, or else terms that cancel for all functions would cancel in every draw.
      functions: of one state; each returns shape (m, n), fields, or (outputs,).
      x: the state, shape (n,).
      uses: copies of each function.
    """
    part = jnp.finfo(x.dtype).eps ** 0.75  # 2^-39: far above rounding, and its square far below
    sizes = [(function(x), jax.jacfwd(function)(x)) for function in functions]
    sizes = [_changeable(value, slopes) for value, slopes in sizes]
    # a fixed seed: a verdict must not change from call to call, nor between a trace and the host
    random = np.random.default_rng(0)

    def draws(shape):
        # the first is the functions themselves
        spread = random.uniform(-1.0, 1.0, (DRAWS, *shape))
        return jnp.asarray(np.concatenate([np.zeros((1, *shape)), spread]), x.dtype) * part

    places = draws(x.shape)
    changes = [[tuple(draws(size.shape) * size for size in pair) for _ in range(uses)] for pair in sizes]

    def once(place, change):
        copies = [
            [_changed(function, x, *pair) for pair in pairs] for function, pairs in zip(functions, change, strict=True)
        ]
        return build(copies, x * (1 + place))

    found = jax.vmap(once)(places, changes)
    values = jax.tree.map(lambda entry: entry[0], found)
    terms = jax.tree.map(lambda entry: jnp.max(jnp.abs(entry[1:] - entry[0]), axis=0) / part, found)
    return values, terms


def _changeable(value: Array, slopes: Array) -> tuple[jax.Array, jax.Array]:
    """The sizes in which values and slopes may be off: their own, or that of the largest beside them."""
    row = jnp.max(jnp.abs(slopes), axis=-1, keepdims=True)
    if value.ndim == 1:  # outputs, each in its own units
        return jnp.abs(value), _own_or_beside(slopes, row)
    # the smaller of row and column: in other units a whole row, or a whole column, is large
    beside = jnp.minimum(row, jnp.max(jnp.abs(slopes), axis=-2, keepdims=True))
    return _own_or_beside(value, jnp.max(jnp.abs(value), axis=-1, keepdims=True)), _own_or_beside(slopes, beside)


def _own_or_beside(numbers: Array, beside: Array) -> jax.Array:
    """Sizes of numbers, or of those beside them where a number is rounding in comparison."""
    size = jnp.abs(numbers)
    # Zeros are exact. A number this small beside others is cos(π/2) or 0.1 + 0.2 − 0.3 rather than a unit.
    return jnp.where((size > 0) & (size < NEGLIGIBLE * jnp.finfo(size.dtype).eps * beside), beside, size)


def _changed(function: Function, x: State, value: Array, slopes: Array) -> Function:
    """The function plus changes of its value and its slopes at x."""
    return lambda y: function(y) + value + slopes @ (y - x)


def without_rounding(values: Array, terms: Array) -> jax.Array:
    """The values with zeros where they are rounding of their terms."""
    return jnp.where(jnp.abs(values) > ROUNDING * jnp.finfo(values.dtype).eps * terms, values, 0)


def balance(matrix: Array) -> tuple[jax.Array, jax.Array]:
    """Scales (p,) of rows and (n,) of columns after which rows have length 1, and columns alike lengths if they can."""
    there = matrix != 0
    logs = jnp.where(there, jnp.log(jnp.where(there, jnp.abs(matrix), 1)), 0)
    # minimise Σ (logs_ij + r_i + c_j)² over the entries that are there; r is eliminated
    rows, columns = jnp.maximum(jnp.sum(there, axis=1), 1), jnp.sum(there, axis=0)
    share = there / rows[:, None]
    normal = jnp.diag(columns) - there.T @ share
    right = share.T @ jnp.sum(logs, axis=1) - jnp.sum(logs, axis=0)
    c = jnp.linalg.pinv(normal.astype(logs.dtype), rtol=1e-4, hermitian=True) @ right
    r = -jnp.sum(jnp.where(there, logs + c, 0), axis=1) / rows

    def sweep(_, scales):
        r, c = scales
        size = jnp.where(there, jnp.exp(logs + r[:, None] + c), 0)
        c = c - _log_length(size, 0)
        size = jnp.where(there, jnp.exp(logs + r[:, None] + c), 0)
        return r - _log_length(size, 1), c

    r, c = jax.lax.fori_loop(0, SWEEPS, sweep, (r, c))
    return jnp.exp(r), jnp.exp(c)


def _log_length(size: Array, axis: int) -> jax.Array:
    """Logarithms of the lengths of rows or columns; 0 where there is nothing."""
    square = jnp.sum(size * size, axis=axis)
    return jnp.log(jnp.where(square > 0, square, 1)) / 2
