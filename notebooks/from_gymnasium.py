# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From Gymnasium
#
# Three environments of Gymnasium, solved on a grid and then played. An environment becomes a problem in four steps:
#
# 1. **Dynamics.** Write the step of the environment as a drift, the rate of change of the state.
# 2. **Rewards.** Divide a reward per step by the length of a step, so that it is paid per unit of time. Pass it as
#    `reward=`, or pass its negative as the cost.
# 3. **Actions and states.** `hjb.from_gymnasium` translates spaces to sets and grids.
# 4. **Policy.** `solution.predict(state)` returns the action.

# %%
import gymnasium
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting


def play(env, policy, seeds):
    """The mean return of a policy from the seeds 0, 1, ..."""
    returns = []
    for seed in range(seeds):
        seen, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            seen, reward, terminated, truncated, _ = env.step(policy(seen))
            total, over = total + reward, terminated or truncated
        returns.append(total)
    return f"{np.mean(returns):.1f}, at worst {np.min(returns):.1f}, in {seeds} episodes"


# %% [markdown]
# ## Pendulum-v1
#
# The observation is $(\cos\theta, \sin\theta, \dot\theta)$, which is not a box of states. The grid is therefore written
# by hand for $(\theta, \dot\theta)$, with a node upright, and the policy computes $\theta$.

# %%
env = gymnasium.make("Pendulum-v1")
problem = hjb.Problem(
    lambda x, u: jnp.stack([x[1], 15 * jnp.sin(x[0]) + 3 * u[0]]),  # 3g/2l and 3/ml² with g = 10, m = l = 1
    lambda x, u: (x[0] ** 2 + 0.1 * x[1] ** 2 + 0.001 * u[0] ** 2) / 0.05,  # a step takes 0.05 s
    hjb.from_gymnasium(env.action_space),
    control_names=("torque",), control_units=("N m",),
)  # fmt: skip
grid = hjb.Grid(
    [-np.pi, -8.0],
    [np.pi, 8.0],
    (150, 151),
    periodic=(True, False),
    names=("angle", "velocity"),
    units=("rad", "rad/s"),
)
pendulum = hjb.solve(problem, grid, scheme=hjb.Upwind())
print(play(env, lambda seen: pendulum.predict([np.arctan2(seen[1], seen[0]), seen[2]])[0], seeds=20))

figure, ax = plt.subplots(figsize=(6.0, 4.2), layout="constrained")
plotting.value(pendulum, ax=ax)
plt.show()

# %% [markdown]
# ## MountainCarContinuous-v0
#
# The observation is the state, so the grid comes from the observation space. Time counts in steps. The reward is
# −0.1 u² per step and 100 at the goal. Resting in the valley costs nothing, so without a discount a feedback that never
# arrives would be as good as one that arrives late. `hjb.discount_rate` gives the rate for a factor per step.

# %%
env = gymnasium.make("MountainCarContinuous-v0")
problem = hjb.Problem(
    lambda x, u: jnp.stack([x[1], 0.0015 * u[0] - 0.0025 * jnp.cos(3 * x[0])]),
    reward=lambda x, u: -0.1 * u[0] ** 2,
    controls=hjb.from_gymnasium(env.action_space),
    target=lambda x: 0.45 - x[0],
    exit_reward=100.0,
    discount=hjb.discount_rate(0.9999, dt=1.0),
)
grid = hjb.from_gymnasium(env.observation_space, (121, 121), names=("position", "velocity"))
car = hjb.solve(problem, grid, scheme=hjb.Upwind())
print(play(env, lambda seen: car.predict(seen)[0], seeds=20))

# %% [markdown]
# ## CartPole-v1
#
# The two actions 0 and 1 push left and right; the drift gives them their meaning. The space has no bounds for the
# velocities, so `lo` and `hi` give the range that matters, and for the angle the 12 degrees at which an episode ends.
# The environment pays for time only. A quadratic cost keeps cart and pole in the middle.

# %%
env = gymnasium.make("CartPole-v1")


def drift(x, u):
    force, s, c = 10 * (2 * u[0] - 1), jnp.sin(x[2]), jnp.cos(x[2])
    mean = (force + 0.05 * x[3] ** 2 * s) / 1.1
    angular = (9.8 * s - c * mean) / (0.5 * (4 / 3 - 0.1 * c**2 / 1.1))
    return jnp.stack([x[1], mean - 0.05 * angular * c / 1.1, x[3], angular])


problem = hjb.Problem(
    drift,
    lambda x, u: x[0] ** 2 + 0.1 * x[1] ** 2 + 10 * x[2] ** 2 + 0.1 * x[3] ** 2,
    hjb.from_gymnasium(env.action_space),
    discount=0.5,
)
far = [2.4, 3.0, 0.21, 3.0]
grid = hjb.from_gymnasium(env.observation_space, (11, 11, 11, 11), lo=[-x for x in far], hi=far)
cart_pole = hjb.solve(problem, grid)
print(play(env, lambda seen: int(cart_pole.predict(seen)[0][0]), seeds=5))
