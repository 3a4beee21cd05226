"""Functions whose forward and reverse derivatives come from two programs.

A loop of unknown length, such as an integrator with adaptive steps, has forward derivatives. Reverse mode needs another
loop, with checkpoints, which has no forward mode. Here one function gets both. With L the derivative at a point, the
first program computes L a and the second Lᵀ y, the two halves of

    [ I  0] [a]   [b]                   [I  −Lᵀ] [a]
    [−L  I] [y] = [c]    and of         [0    I] [y].

JAX's ``custom_linear_solve`` calls one of them at a time and knows how to batch both.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.settings import own_settings


def with_both_modes(forward: Callable[[Any], Any], backward: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The function of a pytree computed by ``forward``, with the reverse derivatives of ``backward``.

    Args:
      forward: a function of a pytree with forward derivatives.
      backward: a program for the same numbers with reverse derivatives.

    Returns:
      The function. Its second derivatives raise ``NotImplementedError``.

    Example:
      >>> halve = lambda x: jax.lax.while_loop(lambda y: y > 1, lambda y: y / 2, x)  # has no reverse mode
      >>> both = with_both_modes(halve, lambda x: jax.lax.fori_loop(0, 3, lambda _, y: y / 2, x))
      >>> float(jax.grad(both)(8.0)), float(jax.jvp(both, (8.0,), (1.0,))[1])
      (0.125, 0.125)
    """

    @jax.custom_jvp
    def function(arguments: Any) -> Any:
        return forward(arguments)

    @function.defjvp
    @own_settings()
    def tangent(primals: Any, tangents: Any) -> Any:
        leaves, structure = jax.tree.flatten(primals[0])
        moves = jax.tree.leaves(tangents[0])
        real = [i for i, leaf in enumerate(leaves) if _is_real(leaf)]

        def of_numbers(program: Callable[[Any], Any]) -> Callable:
            def restricted(numbers: list) -> list:
                given = list(leaves)
                for i, number in zip(real, numbers, strict=True):
                    given[i] = number
                return [
                    each for each in jax.tree.leaves(program(jax.tree.unflatten(structure, given))) if _is_real(each)
                ]

            return restricted

        numbers = [jnp.asarray(leaves[i]) for i in real]
        answer = forward(primals[0])
        results, shape = jax.tree.flatten(answer)
        moved = iter(_product(of_numbers(forward), of_numbers(backward), numbers, [moves[i] for i in real]))
        along = [next(moved) if _is_real(each) else np.zeros(np.shape(each), jax.dtypes.float0) for each in results]
        return answer, jax.tree.unflatten(shape, along)

    return function


def _product(forward: Callable, backward: Callable, numbers: list, moves: list) -> list:
    """L a for a = ``moves``: by forward mode of one program, transposed by reverse mode of the other."""

    # one program each, even under ``grad`` without ``jit``; the caller's checks for infinity then see the derivative
    # but not the bounds inside an integrator
    @jax.jit
    def push(move: list) -> list:
        return jax.jvp(forward, (numbers,), (move,))[1]

    @jax.jit
    def pull(weights: list) -> list:
        return jax.vjp(backward, numbers)[1](weights)[0]

    def solve(_: Callable, right: tuple) -> tuple:
        return right[0], jax.tree.map(jnp.add, right[1], push(right[0]))

    def transposed(_: Callable, right: tuple) -> tuple:
        return jax.tree.map(jnp.add, right[0], pull(right[1])), right[1]

    def operator(x: tuple) -> tuple:
        # never evaluated, and without a loop of unknown length, which could not be transposed here; JAX only
        # differentiates it, for second derivatives
        return jax.tree.map(lambda entry: entry + once(numbers, "a path").astype(entry.dtype), x)

    # JAX transposes a right-hand side only as a whole, so each entry, even a zero, must depend on the moves
    zero = sum(jnp.where(False, jnp.sum(move), 0.0) for move in moves)
    right = [(move + zero).astype(number.dtype) for move, number in zip(moves, numbers, strict=True)]
    nothing = [jnp.broadcast_to(zero, each.shape).astype(each.dtype) for each in jax.eval_shape(forward, numbers)]
    return jax.lax.custom_linear_solve(operator, (right, nothing), solve, transposed)[1]


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def once(numbers: Any, what: str) -> jax.Array:
    """Zero, with a derivative that is refused: added to a first derivative it refuses the second one of ``what``.

    Raises:
      NotImplementedError: if it is differentiated.
    """
    return jnp.zeros(())


@once.defjvp
def _refuse(what: str, primals: Any, tangents: Any) -> Any:
    """Refuse the derivative."""
    raise NotImplementedError(f"second derivatives of {what} are not available; use differences of first derivatives")


def _is_real(leaf: Any) -> bool:
    """True for floating-point numbers, which have derivatives."""
    return jnp.issubdtype(jnp.result_type(leaf), jnp.floating) if not _is_key(leaf) else False


def _is_key(leaf: Any) -> bool:
    """True for typed random keys, whose dtype is not a NumPy type."""
    return jax.dtypes.issubdtype(getattr(leaf, "dtype", np.dtype(int)), jax.dtypes.prng_key)
