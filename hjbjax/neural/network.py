"""A fully connected network with tanh as a function of a vector, and its initial weights.

Weights are a tuple of pairs (matrix, bias), one per layer, in NumPy until they are trained. The last layer starts at
zero. An ansatz is then exactly its part without the network.
"""

import itertools
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem import arguments
from hjbjax.problem.types import Array

Weights: TypeAlias = tuple[tuple[Any, Any], ...]


def initial_weights(seed: int, inputs: int, layers: Sequence[int], *, bias: float = 0.0) -> Weights:
    """Random weights with variance 1/fan-in (LeCun), biases of size ``bias``, and a last layer of zeros.

    Without biases the hidden layers are odd functions, and the network first has to learn to be even.
    """
    draw = np.random.default_rng(seed)
    sizes = [inputs, *layers]
    hidden = [
        (draw.normal(size=(before, after)) / np.sqrt(before), np.zeros(after))
        for before, after in itertools.pairwise(sizes)
    ]
    if bias:
        hidden = [(matrix, bias * draw.normal(size=zeros.shape)) for matrix, zeros in hidden]
    return (*hidden, (np.zeros((sizes[-1], 1)), np.zeros(1)))


def evaluate_network(weights: Weights, z: Array) -> jax.Array:
    """The output of the network, a number, for one input of shape (k,)."""
    z = jnp.asarray(z)
    for matrix, bias in weights[:-1]:
        z = jnp.tanh(z @ matrix + bias)
    matrix, bias = weights[-1]
    return (z @ matrix + bias)[0]


def checked_layers(layers: Sequence[int], name: str) -> tuple[int, ...]:
    """The widths of the hidden layers, after checks."""
    if not isinstance(layers, Sequence) or not layers:
        raise ValueError(f"{name}: got layers = {layers!r}, wanted the widths of the hidden layers, such as (64, 64)")
    return tuple(arguments.count(width, f"{name}: layers") for width in layers)
