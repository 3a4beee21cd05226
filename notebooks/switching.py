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
# # Systems that switch
#
# A machine wears out while it works, the faster it runs the more, and fails at a rate that grows with the wear. It
# can be sent to the workshop at a fixed price. This notebook computes how fast to run it and when to send it to the
# workshop, and follows one machine.
#
# The state is the wear x, and the control is the pace u. A working machine earns 4u − u² and fails at the rate 0.02 +
# 0.3 x². A broken machine is mended after some time at random, but stays worn. The workshop takes the wear away;
# going there is a decision.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb

NAMES = ("works", "broken", "workshop")


def wear(x, u, mode):
    return (0.2 * u, 0.0 * u, -4.0 * x)[mode]


def earnings(x, u, mode):
    return (4 * u[0] - u[0] ** 2, -2.0, -1.0)[mode]


def rates(x, u):
    return jnp.zeros((3, 3)).at[0, 1].set(0.02 + 0.3 * x[0] ** 2).at[1, 0].set(0.5)


def machine(price):
    never = jnp.inf  # only a working machine goes to the workshop, and only from there it returns by choice
    costs = jnp.array([[0.0, never, 1.0], [never, 0.0, never], [0.1, never, 0.0]]).at[0, 2].set(price)
    modes = hjb.Modes(NAMES, rates=rates, switching_cost=costs)
    return hjb.Problem(
        wear, reward=earnings, controls=hjb.Box([0.0], [2.0]), discount=0.05, modes=modes, control_names=("pace",)
    )


grid = hjb.Grid([0.0], [2.0], (401,), names=("wear",))
solution = hjb.solve(machine(1.0), grid)
print(solution)

# %% [markdown]
# The value of each mode falls with the wear. Where those of a working machine and of the workshop differ by the price
# of going there, the machine is sent to the workshop. Close to this wear it runs faster, since the workshop takes the
# wear away in any case.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
hjb.plotting.value(solution, ax=left)
hjb.plotting.policy(solution.in_mode("works"), ax=right)
plt.show()

# %%
x, works = grid.axis(0), solution.switching[0]
limit = x[works == 2].min()
print(f"to the workshop from a wear of {limit:.2f} on; the pace before is", end=" ")
print(f"{solution.control_at([0.0], mode='works')[0]:.2f} when new and", end=" ")
print(f"{solution.control_at([limit - 0.02], mode='works')[0]:.2f} at last")

# %% [markdown]
# One machine over 40 years. The random failures have their exact law; the changes by choice happen where the solution
# has them.

# %%
path = hjb.simulate(machine(1.0), solution, [0.0], 40.0, mode="works", key=3, steps=800)
figure, (upper, lower) = plt.subplots(2, 1, figsize=(8, 3.6), sharex=True, layout="constrained")
upper.plot(path.times, path.states[:, 0])
upper.set(ylabel="wear")
lower.plot(path.times, path.modes, drawstyle="steps-post", color="C1")
lower.set(xlabel="years", yticks=range(3), yticklabels=NAMES)
plt.show()

# %% [markdown]
# ## What does a dearer workshop cost?
#
# Values are differentiable with respect to every number, also through the changes of the mode.


# %%
def worth(price):
    return hjb.solve(machine(price), grid, tol=1e-6).value[0, 0]


with jax.enable_x64(True):
    slope = jax.grad(worth)(1.0)
    difference = (worth(1.01) - worth(0.99)) / 0.02
print(f"a workshop that costs 1 more costs {-slope:.2f} in the long run; by differences {-difference:.2f}")
assert np.isclose(slope, difference, rtol=0.02)
