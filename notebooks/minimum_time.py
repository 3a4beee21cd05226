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
# # Minimum time
#
# A force of at most one brings a mass on a line to rest at the origin as fast as possible:
#
# $$\dot x_1 = x_2, \qquad \dot x_2 = u, \qquad |u| \le 1.$$
#
# The least time $T(x)$ is known in closed form, and has a kink along the switching curve
# $x_1 = -\tfrac12 x_2|x_2|$. The chapter solves the discounted problem (8.14), whose value
#
# $$S(x) = 1 - e^{-T(x)}$$
#
# stays below one and satisfies $S = 1 + \min_u f(x,u)\cdot DS$ away from the origin. Figures 8 and 9 of the chapter
# show $S$ and the feedback. This notebook compares both with the exact answer.

# %%
import warnings

import jax
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting

warnings.simplefilter("ignore", hjb.SolveWarning)  # the coarse grid is studied below

nodes = 201  # per axis; odd, so that the origin is a node

# %% [markdown]
# The zoo contains the problem and its exact answer. $S$ is only Hölder continuous at the origin, so a target of one
# node is inaccurate. The problem therefore prescribes the exact value on a small disc around the origin.

# %%
problem, grid = hjb.zoo.double_integrator(shape=(nodes, nodes))
solution = hjb.solve(problem, grid, tol=1e-4)
print(solution)

# %% [markdown]
# ## Figure 8: the value, and the exact one

# %%
with jax.enable_x64(True):
    exact = np.asarray(jax.vmap(hjb.zoo.double_integrator_exact())(grid.nodes().reshape(-1, 2))).reshape(grid.shape)

levels = np.linspace(0.1, 0.9, 9)
figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained", sharex=True, sharey=True)
plotting.value(solution, ax=axes[0], levels=levels)
axes[0].set_title("computed")
for values, style, name in ((exact, "-", "exact"), (np.asarray(solution.value), ":", "computed")):
    color = "black" if name == "exact" else plotting.COLOURS[1]
    axes[1].contour(grid.axis(0), grid.axis(1), values.T, levels, colors=color, linestyles=style, linewidths=1.4)
    axes[1].plot([], [], style, color=color, label=name)  # contours have no label
axes[1].set_title("contour lines 0.1, 0.2, …, 0.9", pad=20)
axes[1].legend(loc="lower left", bbox_to_anchor=(0.0, 0.98), ncols=2, frameon=False)
axes[1].set_xlabel(grid.labels[0])
plt.show()

# %% [markdown]
# The printout above shows two errors. The error of the iteration has a bound. The distance to $S$ is estimated from a
# coarser grid. The scheme rounds the kink off, and optimal paths run along the kink, so this error converges slowly.
# The errors on finer grids, on the inner half of the box, which the boundary does not affect:

# %%
for count in (nodes // 4 + 1, nodes // 2 + 1, nodes):
    coarse_problem, coarse = hjb.zoo.double_integrator(shape=(count // 2 * 2 + 1,) * 2)
    inner = coarse.nodes()[np.all(np.abs(coarse.nodes()) <= 1.0, axis=-1)]
    with jax.enable_x64(True):
        truth = np.asarray(jax.vmap(hjb.zoo.double_integrator_exact())(inner))
    error = np.abs(hjb.solve(coarse_problem, coarse).value_at(inner) - truth)
    print(f"{coarse.shape[0]:4} nodes an axis: largest error {error.max():.3f}, mean {error.mean():.3f}")
print(f"S(1, 0): computed {solution.value_at([1.0, 0.0]):.3f}, exact {1 - np.exp(-2.0):.3f}")

# %% [markdown]
# ## How smooth the value is
#
# From rest at distance $x_1$ the least time is $T = 2\sqrt{x_1}$. So $S$ is continuous at the origin, but no better
# than Hölder continuous with the exponent ½: its slope is infinite there. No grid resolves that, which is the reason
# for the disc. The exponent, fitted to the computed values outside of it:

# %%
distances = np.array([0.05, 0.1, 0.2])
least = -np.log1p(-np.array([solution.value_at([x, 0.0]) for x in distances]))
exponent = np.polyfit(np.log(distances), np.log(least), 1)[0]
print(f"T grows like the distance to the power {exponent:.2f}")
assert abs(exponent - 0.5) < 0.05

# %% [markdown]
# ## Figure 9: the feedback and its switching curve
#
# The computed feedback switches slightly too early: with the numerical diffusion of the chain it pays to brake early.

# %%
velocity = np.linspace(-2.0, 2.0, 201)
figure, ax = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
plotting.policy(solution, ax=ax)
ax.plot(-0.5 * velocity * abs(velocity), velocity, "--", color=plotting.COLOURS[1], label="exact")
plotting.switching_curve(solution, ax=ax, label="computed switching curve")
plt.show()

# %% [markdown]
# ## The closed loop
#
# From rest at one the least time is two: full force towards the origin for one unit of time, then full force back. The
# path stops on the disc where the exact value is prescribed.
#
# Between the nodes `control_at` is a mean, and the mean of two opposite full forces is not a full force.
# `greedy_feedback` minimises the Hamiltonian at the state instead. The control jumps, so it is sampled every 0.01 time
# units. The cost of the path equals the computed value, including the early braking of Figure 9.

# %%
feedback = hjb.greedy_feedback(problem, solution)
path = hjb.simulate(problem, feedback, x0=[1.0, 0.0], duration=4.0, hold=0.01)
arrival = path.times[-1] + float(np.ravel(hjb.zoo.DoubleIntegrator().arrival_time(path.states[-1]))[0])
print(f"arrives after {arrival:.3f}; the least time is 2")

figure, ax = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
plotting.value(solution, ax=ax, levels=levels)
plotting.trajectory(path, ax=ax)
plt.show()
