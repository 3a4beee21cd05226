"""Host callbacks from compiled programs, with numbers of any width.

The thread of a callback ignores ``jax.enable_x64``, so JAX would round doubles on the way. They are therefore sent as
pairs of 32-bit words.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

T = TypeVar("T")
WORD = np.dtype(np.uint32)


def call_on_host(function: Callable[..., Any], result: T, *arrays: Any, vmap_method: str) -> T:
    """The result of a function of NumPy arrays, called on the host while the program runs.

    Args:
      function: takes NumPy arrays and returns a tree of arrays like ``result``.
      result: the shapes and types of the result, a tree of ``jax.ShapeDtypeStruct``.
      arrays: the arguments; only traced ones need to be passed, others can be closed over.
      vmap_method: of ``jax.pure_callback``. With "expand_dims" the function is called once for a whole batch, and
        arguments and results have leading axes, of length 1 for arguments that do not vary.
    """
    leaves, structure = jax.tree.flatten(result)
    kinds = [np.dtype(array.dtype) for array in arrays]

    def on_host(*words: Any) -> tuple[np.ndarray, ...]:
        found = function(*(_numbers(np.asarray(word), kind) for word, kind in zip(words, kinds, strict=True)))
        return tuple(
            _words(np.asarray(leaf, like.dtype)) for leaf, like in zip(jax.tree.leaves(found), leaves, strict=True)
        )

    shapes = [jax.ShapeDtypeStruct(*_shape_in_words(leaf.shape, leaf.dtype)) for leaf in leaves]
    sent = [jax.lax.bitcast_convert_type(array, WORD) if _is_wide(array.dtype) else array for array in arrays]
    words = jax.pure_callback(on_host, tuple(shapes), *sent, vmap_method=vmap_method)
    received = [
        jax.lax.bitcast_convert_type(word, like.dtype) if _is_wide(like.dtype) else word
        for word, like in zip(words, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, received)


def _is_wide(dtype: Any) -> bool:
    """True for 64-bit numbers, which are sent as two words on an additional axis."""
    return np.dtype(dtype).itemsize > WORD.itemsize


def _shape_in_words(shape: Sequence[int], dtype: Any) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of numbers as they are sent."""
    return ((*shape, 2), WORD) if _is_wide(dtype) else (tuple(shape), np.dtype(dtype))


def _numbers(words: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """The numbers as received."""
    return np.ascontiguousarray(words).view(dtype)[..., 0] if _is_wide(dtype) else words


def _words(numbers: np.ndarray) -> np.ndarray:
    """The numbers as they are sent."""
    if not _is_wide(numbers.dtype):
        return numbers
    return np.array(numbers)[..., None].view(WORD)  # ``ascontiguousarray`` would add an axis to a single number
