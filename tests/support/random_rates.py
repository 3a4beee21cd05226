"""Random generators of Markov chains."""

import numpy as np


def rates(rng, states, scale=1.0):
    """A generator in which some jumps are impossible, shape (states, states)."""
    found = scale * rng.uniform(0, 1, (states, states)) * (rng.uniform(size=(states, states)) < 0.8)
    np.fill_diagonal(found, 0)
    return found - np.diag(found.sum(axis=1))
