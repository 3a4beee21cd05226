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
# A pendulum of unit length with a torque at its pivot, as in (2.1) of the chapter. The angle is measured from upright:
#
# $$m\ddot\theta - m g \sin\theta = \tau.$$
#
# Swing it up and hold it upright at the cost $\int \tfrac12(\theta^2 + \dot\theta^2 + \tau^2)\,dt$, without discount.
# The angle is periodic. The value is finite because resting upright costs nothing. Figures 10 to 12 of the chapter,
# with the pendulum (9.4), show the value, the feedback and a stabilising trajectory.

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
plt.show()

# %% [markdown]
# The cost is quadratic in the torque, so the torque is continuous wherever $V$ is smooth, and there is no switching
# curve. It jumps only across the two spirals on which $V$ has a kink. On one side of a spiral it is cheaper to rise
# directly, on the other side to swing back first.

# %% [markdown]
# ## An independent answer: near upright
#
# Near the rest point $\sin\theta \approx \theta$ and the torque is far from its bound. So the value is the quadratic
# form of the Riccati equation, which SciPy solves. For velocity zero, as a function of the angle:

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
# The two curves separate at a kink. Beyond it, it is cheaper to let the pendulum fall and come up on the other side,
# which a linearisation cannot describe. Inside, the difference has two sources: the linearisation of the sine, and the
# grid error, which is estimated in the printout above.

# %%
for angle in (0.2, 0.4):
    print(f"V({angle}, 0): computed {solution.value_at([angle, 0.0]):.3f}, Riccati {riccati.value([angle, 0.0]):.3f}")

# %% [markdown]
# ## Figure 12: a stabilising trajectory
#
# The start is nearly hanging, at rest, and far outside the linear region:

# %%
path = hjb.simulate(problem, solution, x0=[2.8, 0.0], duration=6.0)
print(f"cost of the path {path.cost:.2f}, promised by the value {path.promised:.2f}")
print(f"angle at the end {path.states[-1, 0]:.4f}, velocity {path.states[-1, 1]:.4f}")

plotting.closed_loop(solution, path)
plt.show()

# %% [markdown]
# The cost of the simulated path and the value on the grid are two approximations of the same number. The path uses the
# feedback between the nodes, and the value has the error of the scheme.
#
# ## Pontryagin's costates
#
# A third approximation needs no grid: along an optimal path the costate $\lambda$ of Pontryagin's principle is the
# gradient of the value. The boundary-value problem is solved by collocation, starting from the Riccati feedback.

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
# The chapter prints (9.4) with the input gain $g/m$ instead of $1/m$. Its figures may have been made with this gain, so
# the zoo keeps it as an option, with a bound of 6 on the torque:

# %%
printed, _ = hjb.zoo.pendulum(as_printed=True, shape=(nodes - 1, nodes))
as_printed = hjb.solve(printed, grid)
figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained", sharey=True)
plotting.value(as_printed, ax=axes[0])
plotting.policy(as_printed, ax=axes[1])
plt.show()
