"""Random piecewise linear gains at a few nodes."""

import jax.numpy as jnp
import numpy as np

NODES = 6


def random_pieces(rng, count, kinks):
    """For each piece: offset, slope, sorted kinks and the slopes between them; some slopes are zero."""
    offset = rng.normal(size=(count, NODES))
    slope = rng.normal(size=(count, NODES)) * rng.choice([0.0, 1.0], (count, NODES), p=[0.2, 0.8])
    at = np.sort(rng.uniform(-1.5, 1.5, (count, kinks, NODES)), axis=1)
    return offset, slope, at, rng.normal(size=(count, kinks + 1, NODES))


def gain(at, derivatives, f):
    """The continuous piecewise linear function that is zero at zero kinks' origin and has these slopes."""
    total = derivatives[0] * f
    for kink, below, above in zip(at, derivatives[:-1], derivatives[1:], strict=True):
        total = total + (above - below) * jnp.maximum(f - kink, 0)
    return total
