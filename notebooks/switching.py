# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # Systems that switch
#
# A machine wears out while it works, and fails at a rate that grows with the wear. It can be repaired at a fixed price,
# and it can run at two speeds. This notebook computes when to slow down and when to repair, and follows one machine.
#
# The state is the wear x. The modes are *fast*, *slow* and *broken*. The first two are chosen, and changing the gear has a
# small cost. A machine fails at the rate 0.02 + 0.3 x²; a broken one is replaced after some time at random. A repair is a
# decision too: it brings the machine to a fourth mode, *workshop*, in which the wear is taken away.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb

NAMES = ("fast", "slow", "broken", "workshop")


def wear(x, u, mode):
    return jnp.stack([(0.20, 0.06, 0.0, -1.0)[mode] * (1.0 if mode < 3 else jnp.minimum(4 * x[0], 1.0))])


def earnings(x, u, mode):
    return (3.0, 2.0, -2.0, -1.0)[mode]


def rates(x, u):
    fails = 0.02 + 0.3 * x[0] ** 2
    table = jnp.zeros((4, 4))
    return table.at[0, 2].set(fails).at[1, 2].set(0.5 * fails).at[2, 0].set(0.5)


never = np.inf
gears = [[0, 0.05, never, 0.5], [0.05, 0, never, 0.5], [never, never, 0, never], [0.1, 0.1, never, 0]]
machine = hjb.Problem(
    wear, reward=earnings, discount=0.05, modes=hjb.Modes(NAMES, rates=rates, switching_cost=gears)
)
grid = hjb.Grid([0.0], [2.0], (401,), names=("wear",))
solution = hjb.solve(machine, grid)
print(solution)

# %% [markdown]
# The value of each mode falls with the wear. Where two curves have the distance of the cost of a change, the mode is
# changed.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
hjb.plotting.value(solution, ax=left)
x = grid.axis(0)
for number, name in enumerate(NAMES):
    right.plot(x, solution.switching[number], label=name, drawstyle="steps-mid")
right.set(xlabel="wear", ylabel="mode after the change", yticks=range(4), yticklabels=NAMES)
right.legend()
figure

# %%
fast, slow = (solution.switching[number] for number in (0, 1))
print(f"slow down from a wear of {x[fast == 1].min():.2f} on" if np.any(fast == 1) else "never slow down")
print(f"repair from a wear of {x[fast == 3].min():.2f} on")

# %% [markdown]
# One machine over 60 years. The random failures have their exact law; the changes by choice happen where the solution
# has them.

# %%
path = hjb.simulate(machine, solution, [0.0], 60.0, mode="fast", key=3, steps=600)
figure, (upper, lower) = plt.subplots(2, 1, figsize=(8, 4), sharex=True, layout="constrained")
upper.plot(path.times, path.states[:, 0])
upper.set(ylabel="wear")
lower.plot(path.times, path.modes, drawstyle="steps-post", color="C1")
lower.set(xlabel="years", yticks=range(4), yticklabels=NAMES)
figure

# %% [markdown]
# The long-run shares of the modes are a linear solve with the chain of the optimal policy. A policy that changes the mode
# at no time has no rate, so the law is that of a simulation: the shares along many paths.

# %%
shares = np.mean([
    [np.mean(each.modes == number) for number in range(4)]
    for each in (hjb.simulate(machine, solution, [0.0], 200.0, mode="fast", key=key, steps=400) for key in range(8))
], axis=0)  # fmt: skip
for name, share in zip(NAMES, shares, strict=True):
    print(f"{name:9} {share:.0%}")

# %% [markdown]
# ## How much is a better workshop worth?
#
# Values are differentiable with respect to every number, also through the changes of the mode.

# %%
import jax


def worth(price):
    table = jnp.asarray(gears).at[0, 3].set(price).at[1, 3].set(price)
    priced = hjb.Problem(
        wear, reward=earnings, discount=0.05, modes=hjb.Modes(NAMES, rates=rates, switching_cost=table)
    )
    return hjb.solve(priced, grid, tol=1e-6).value[0, 0]


with jax.enable_x64(True):
    slope = jax.grad(worth)(0.5)
    difference = (worth(0.51) - worth(0.49)) / 0.02
print(f"a repair that costs 1 more costs {-slope:.2f} in the long run; by differences {-difference:.2f}")
