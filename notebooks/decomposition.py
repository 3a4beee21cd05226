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
# # Six states as two blocks of three
#
# Two vehicles move along perpendicular roads. Each has a position, a velocity and a motor that answers with a delay.
# Both must be near the crossing at the same time. On one grid with 25 nodes per axis this is 244 million nodes.
# The vehicles do not interact, so `hjb.decompose` solves two grids of 15,625 nodes.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb


def drift(x, u):
    return jnp.stack([x[1], x[2], u[0] - x[2], x[4], x[5], u[1] - x[5]])


def distance(x):
    return jnp.maximum(jnp.abs(x[0]), jnp.abs(x[3])) - 0.5


problem = hjb.reach(drift, hjb.Box([-1.0, -0.5], [1.0, 0.5]), distance)
parts = hjb.decompose(problem, 6)
print(parts)
assert parts.states == ((0, 1, 2), (3, 4, 5))

# %% [markdown]
# Reaching an intersection is not the largest of two tubes, because one vehicle may be there before the other comes. The
# rule "first" takes the best moment for both.

# %%
names = ("x", "velocity x", "force x", "y", "velocity y", "force y")
grid = hjb.Grid([-2.5, -1.2, -1.0] * 2, [2.5, 1.2, 1.0] * 2, (25,) * 6, names=names, edges="linear")
solution = parts.march(grid, 2.0, times=np.linspace(0.0, 2.0, 21))
# the vehicle on the y-axis passes at the speed 1; the other one starts at rest, farther away
x = np.array([1.2, 0.0, 0.0, -0.6, 1.0, 0.0])
alone = [part.value_at(0.0, x[list(own)]) for part, own in zip(solution.parts, parts.states, strict=True)]
print(f"at the end of the horizon {max(alone):.2f}, at the best moment {solution.value_at(0.0, x):.2f}")
assert solution.value_at(0.0, x) <= max(alone) + 1e-9

# %%
nodes = np.linspace(-2.0, 2.0, 61)
plane = np.zeros((61, 61, 6))
plane[..., 0], plane[..., 3] = np.meshgrid(nodes, nodes, indexing="ij")
figure, axis = plt.subplots(figsize=(4.6, 3.8), layout="constrained")
value = solution.value_at(0.0, plane)
shades = axis.contourf(nodes, nodes, value.T, 15)
axis.contour(nodes, nodes, value.T, [0.0], colors="white")
axis.set(xlabel="x", ylabel="y", aspect="equal")
figure.colorbar(shades, label="V from rest")
plt.show()
assert value.min() < 0 < value.max()

# %% [markdown]
# ## A coupling is named
#
# If the second motor also feels the velocity of the first vehicle, the six states are one block.

# %%
coupled = hjb.reach(lambda x, u: drift(x, u).at[5].add(-0.2 * x[1]), hjb.Box([-1.0, -0.5], [1.0, 0.5]), distance)
try:
    hjb.decompose(coupled, 6)
except ValueError as error:
    print(error)
