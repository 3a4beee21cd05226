"""Simulated paths of random systems with modes, jumps and noise cost what V promises in the mean."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.feedback.simulation import rollout

SYSTEMS, PATHS, START = 10, 400, 0.5
GRID = hjb.Grid([-2.0], [2.0], (161,))


def draw(seed):
    """The numbers of one system with two modes, whose paths stay inside the box."""
    rng = np.random.default_rng(seed)
    return {
        "pull": rng.uniform(1, 2, 2), "push": rng.uniform(0.3, 1, 2), "weight": rng.uniform(0.5, 2, 2),
        "centre": rng.uniform(-0.5, 0.5, 2), "rates": rng.uniform(0.2, 1.5, (2, 2)), "jump": rng.uniform(0.2, 1, 2),
        "factor": rng.uniform(-0.6, 0.6, 2), "shift": rng.uniform(-0.5, 0.5, 2), "price": rng.uniform(-0.5, 1.0, 2),
        "noise": rng.uniform(0.1, 0.25), "discount": rng.uniform(0.8, 1.5),
    }  # fmt: skip


def problem_of(numbers, noisy):
    pull, push, weight, centre, jump, factor, shift, price = (
        numbers[name] for name in ("pull", "push", "weight", "centre", "jump", "factor", "shift", "price")
    )
    return hjb.Problem(
        lambda x, u, mode: push[mode] * u - pull[mode] * x,
        lambda x, u, mode: weight[mode] * (x[0] - centre[mode]) ** 2 + 0.1 * u[0] ** 2,
        hjb.Box([-1.0], [1.0]),
        noise=numbers["noise"] if noisy else None,
        discount=numbers["discount"],
        modes=hjb.Modes(("one", "other"), rates=numbers["rates"]),
        jumps=[
            hjb.Jump(
                lambda x, u, mode: jump[mode] * (1 + x[0] ** 2),
                lambda x, u, mode: factor[mode] * x + shift[mode],
                cost=lambda x, u, mode: price[mode] + x[0],
            )
        ],
    )


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize("noisy", [False, True])
def test_paths_of_random_systems_cost_what_the_value_promises(noisy):
    systems = [draw(100 * noisy + seed) for seed in range(SYSTEMS)]
    solved = [hjb.solve(problem_of(each, noisy), GRID, tol=1e-5) for each in systems]
    promised = np.array([each.value_at([START], mode="one") for each in solved])
    scale = np.array([np.ptp(each.value) for each in solved])

    def cost(numbers, policy, key):
        def feedback(x, mode):
            return GRID.interpolate(policy[mode], x, clamp=True)

        problem, times = problem_of(numbers, noisy), jnp.linspace(0.0, 12.0, 13)
        return rollout(problem, feedback, jnp.array([START]), times, key=key, mode="one", max_step=0.05).cost

    numbers = jax.tree.map(lambda *leaves: jnp.array(leaves), *systems)
    policies = jnp.array([each.policy for each in solved])
    keys = jax.random.split(jax.random.key(7), PATHS)
    over_keys = jax.vmap(cost, (None, None, 0))
    costs = np.asarray(jax.jit(jax.vmap(over_keys, (0, 0, None)))(numbers, policies, keys))
    spread = 3 * np.std(costs, axis=1) / np.sqrt(PATHS)
    assert np.all(np.abs(np.mean(costs, axis=1) - promised) <= spread + 0.003 * scale)
    assert np.all(spread < 0.1 * scale)
