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
# # Swinging up a pendulum
#
# A pendulum with a torque at its pivot, its angle measured from upright, as in (2.1) of the chapter at unit length:
#
# $$m\ddot\theta - m g \sin\theta = \tau.$$
#
# It is to be swung up and held there at the cost $\int \tfrac12(\theta^2 + \dot\theta^2 + \tau^2)\,dt$, without
# discount. The angle lives on a circle; upright at rest costs nothing, and that is what makes the value finite.
# Figures 10 to 12 of the chapter, with the pendulum (9.4), show the value, the feedback and a stabilising trajectory.

# %%
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting

nodes = 201  # velocities; odd, so that rest is a node

# %%
problem, grid = hjb.zoo.pendulum(shape=(nodes - 1, nodes))
solution = hjb.solve(problem, grid)
print(solution)

# %% [markdown]
# ## Figure 10: the value

# %%
figure, ax = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
plotting.value(solution, ax=ax)
plt.show()

# %% [markdown]
# ## Figure 11: the feedback

# %%
figure, ax = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
plotting.policy(solution, ax=ax)
plotting.switching_curve(solution, ax=ax)
plt.show()

# %% [markdown]
# ## An independent answer: near upright
#
# Close to the rest point $\sin\theta \approx \theta$, the torque is far from its bound, and the value is the quadratic
# form of the Riccati equation, which SciPy solves. At rest, along the angle:

# %%
riccati = hjb.zoo.pendulum_near_upright()
angles = np.linspace(-1.0, 1.0, 41)
rest = np.stack([angles, np.zeros_like(angles)], axis=-1)
quadratic = np.array([float(riccati.value(x)) for x in rest])

figure, ax = plt.subplots(figsize=(5.4, 3.2), layout="constrained")
ax.plot(angles, [solution.value_at(x) for x in rest], color=plotting.COLOURS[0], label="computed")
ax.plot(angles, quadratic, "--", color=plotting.COLOURS[1], label="Riccati")
ax.set(xlabel="angle [rad]", ylabel="V(angle, 0)")
ax.legend(loc="lower left", frameon=False)
plt.show()

# %% [markdown]
# They part at a kink: from there on it is cheaper to let the pendulum fall through and to come up on the other side,
# which no linearisation knows of. Inside, the difference is the sine against its tangent and the error of the grid,
# whose estimate the screen above shows.

# %%
for angle in (0.2, 0.4):
    print(f"V({angle}, 0): computed {solution.value_at([angle, 0.0]):.3f}, Riccati {riccati.value([angle, 0.0]):.3f}")

# %% [markdown]
# ## Figure 12: a stabilising trajectory
#
# From nearly hanging, far outside the linear region, at rest:

# %%
path = hjb.simulate(problem, solution, x0=[2.8, 0.0], duration=6.0)
print(f"cost of the path {path.cost:.2f}, promised by the value {path.promised:.2f}")
print(f"angle at the end {path.states[-1, 0]:.4f}, velocity {path.states[-1, 1]:.4f}")

plotting.closed_loop(solution, path)
plt.show()

# %% [markdown]
# The cost that the simulated path really pays and the value computed on the grid are two roads to one number. The path
# uses the feedback between the nodes; the value carries the error of the scheme.
#
# ## Pontryagin's costates
#
# A third road needs no grid: along an optimal path the costate $\lambda$ of Pontryagin's principle is the gradient of
# the value. Its boundary-value problem is solved by collocation, from the Riccati feedback as the first guess.

# %%
start = [0.5, 0.0]
extremal = hjb.pontryagin(problem, start, grid=grid)
print(extremal)
print(f"V{tuple(start)}: on the grid {solution.value_at(start):.4f}, Pontryagin {extremal.cost:.4f}")

figure, ax = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
plotting.costates(extremal, solution=solution, ax=ax)
ax.set_xlim(0, 4)
plt.show()

# %% [markdown]
# ## As printed
#
# The chapter prints (9.4) with the input gain $g/m$ in place of $1/m$. The figures there may have been made with it, so
# the zoo keeps it, with a bound of 6 on the torque:

# %%
printed, _ = hjb.zoo.pendulum(as_printed=True, shape=(nodes - 1, nodes))
as_printed = hjb.solve(printed, grid)
figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained", sharey=True)
plotting.value(as_printed, ax=axes[0])
plotting.policy(as_printed, ax=axes[1])
plt.show()
