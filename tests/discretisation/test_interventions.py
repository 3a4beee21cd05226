"""Interventions: the bound that they put on V, which certificates compare by equality."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hjbjax.discretisation.interventions import Interventions


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_change_of_the_mode_is_exact_where_it_is_best_up_to_rounding(seed, dtype):
    """V of three modes: the last is free, the others are within rounding of changing to it, also where V is near 0."""
    rng = np.random.default_rng(seed)
    free = rng.uniform(-1, 1, 40)
    costs = np.array([-free * (1 + rng.choice([0, 1e-9], 40)), rng.uniform(0, 1, 40)])
    value = np.stack([costs[0] + free, costs[1] + free, free])
    value = value.astype(dtype)
    value[:2] -= rng.choice([0, 2], (2, 40)) * np.finfo(dtype).eps * (np.abs(costs) + np.abs(free)).astype(dtype)
    endless = np.full(40, np.inf)
    table = np.array([[endless, costs[1], endless], [costs[0], endless, endless]])
    with jax.enable_x64(dtype == "float64"):
        jumps = Interventions(((1, 0), (2, 0)), tuple(map(jnp.asarray, table.astype(dtype))), changes=2)
        found = np.asarray(jumps.impose(jnp.asarray(value)))
    assert np.array_equal(found[2], value[2])
    assert np.array_equal(found[:2], table[[1, 0], [0, 1]].astype(dtype) + value[2])
    assert np.allclose(found, value, rtol=0, atol=10 * np.finfo(dtype).eps)
