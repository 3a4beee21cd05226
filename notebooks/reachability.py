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
# # Reachability for robots
#
# Which states can be brought to a target, and from which states is an obstacle unavoidable? Sets are given by signed
# distances, and the answers are zero level sets of a value: `reach` for the first question, `avoid` for the second.

# %%
import warnings

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting

warnings.simplefilter("ignore", hjb.SolveWarning)
names, units = ("x", "y", "heading"), ("m", "m", "rad")
box = {"periodic": (False, False, True), "names": names, "units": units}


def disc(x):
    return jnp.hypot(x[0], x[1]) - 1.0


# %% [markdown]
# ## A car that cannot turn on the spot
#
# Dubins' car drives at speed 1 and turns at a rate of at most 1. From which states does it reach the disc within two
# seconds?


# %%
def car(x, u):
    return jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]), u[0]])


grid = hjb.Grid([-4.0, -4.0, -jnp.pi], [4.0, 4.0, jnp.pi], (31, 31, 24), **box)
tube = hjb.march(hjb.reach(car, hjb.Box([-1.0], [1.0]), disc), grid, 2.0, scheme=hjb.Limited(split=True))
assert tube.value_at(0.0, [-2.5, 0.0, 0.0]) < 0  # towards the disc, 1.5 away from it
assert tube.value_at(0.0, [2.5, 0.0, 0.0]) > 0  # away from the disc

figure = plt.figure(figsize=(10, 4.4), layout="constrained")
plotting.zero_level_set(tube, ax=figure.add_subplot(1, 2, 1, projection="3d"))
plotting.zero_level_set(tube, ax=figure.add_subplot(1, 2, 2), fixed={"heading": 0.0})
plt.show()

# %% [markdown]
# ## Air3D: two aircraft
#
# In this classical game the evader, at the origin of a moving frame, turns to keep the pursuer five units away. Both
# fly at speed 5 and turn at a rate of at most 1. `avoid` gives the states in which the pursuer wins, which are shaded.


# %%
def relative(x, u, d):
    return jnp.stack([-5 + 5 * jnp.cos(x[2]) + u[0] * x[1], 5 * jnp.sin(x[2]) - u[0] * x[0], d[0] - u[0]])


turns = hjb.Box([-1.0], [1.0])
game = hjb.avoid(relative, turns, lambda x: jnp.hypot(x[0], x[1]) - 5.0, disturbances=turns)
airspace = hjb.Grid([-6.0, -10.0, 0.0], [20.0, 10.0, 2 * jnp.pi], (41, 31, 24), **box)
unsafe = hjb.march(game, airspace, 2.8, scheme=hjb.Upwind(split=True))
assert unsafe.value_at(0.0, [8.0, 0.0, jnp.pi]) > 0  # head on at 8 the pursuer wins
assert unsafe.value_at(0.0, [18.0, 0.0, 0.0]) < 0  # side by side, far away, nobody is caught

figure = plt.figure(figsize=(10, 4.4), layout="constrained")
plotting.zero_level_set(unsafe, ax=figure.add_subplot(1, 2, 1, projection="3d"), color=plotting.COLOURS[1])
plotting.zero_level_set(unsafe, ax=figure.add_subplot(1, 2, 2), fixed={"heading": np.pi}, color=plotting.COLOURS[1])
plt.show()

# %% [markdown]
# ## A safety filter
#
# A pilot constantly pushes a mass towards a wall. The filter passes the pilot's control through as long as braking
# still prevents the crash, and takes over one cell before it would be too late.


# %%
def mass(x, u):
    return jnp.stack([x[1], u[0]])


force = hjb.Box([-1.0], [1.0])
wall = hjb.avoid(mass, force, lambda x: 2.0 - x[0])
plane = hjb.Grid([-1.0, -2.0], [2.5, 2.0], (71, 61), names=("position", "velocity"), units=("m", "m/s"))
barrier = hjb.solve(wall, plane)
kept = hjb.least_restrictive(barrier, lambda x: jnp.ones(1))
pushed = hjb.simulate(wall, kept, [0.0, 0.0], 4.0, hold=0.01)
careless = hjb.simulate(wall, lambda x: jnp.ones(1), [0.0, 0.0], 2.1, hold=0.01)
print(f"the filter stops at {pushed.states[:, 0].max():.2f}, the pilot alone passes {careless.states[:, 0].max():.2f}")
assert pushed.states[:, 0].max() < 2.0 < careless.states[:, 0].max()

figure, ax = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
plotting.zero_level_set(barrier, ax=ax, color=plotting.COLOURS[1], label="cannot stop")
plotting.trajectory(careless, ax=ax, grid=plane, color=plotting.COLOURS[3], label="pilot alone")
plotting.trajectory(pushed, ax=ax, grid=plane, color=plotting.COLOURS[0], label="with filter")
plt.show()
