"""The zoo is checked in float64, at random states."""

import jax.numpy as jnp
import numpy as np
import pytest


@pytest.fixture(autouse=True)
def _float64(float64):
    pass


@pytest.fixture
def sample_state():
    """A random state of a grid's box, away from its faces."""

    def sample(grid, seed, shrink=0.9):
        middle, half = (np.add(grid.hi, grid.lo)) / 2, (np.subtract(grid.hi, grid.lo)) / 2
        return jnp.asarray(middle + shrink * half * np.random.default_rng(seed).uniform(-1, 1, grid.ndim))

    return sample
