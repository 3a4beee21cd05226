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
# # Feedback holds a pendulum up
#
# Section 2 of the chapter: a pendulum with a torque at its pivot. The angle is measured from upright:
#
# $$m\ddot\theta - m g\sin\theta = \tau. \qquad (2.1)$$
#
# Figure 3 of the chapter shows the pendulum. Below it falls without a torque, one feedback cancels gravity, and a
# second one stabilises it. Figures 4 and 5 of the chapter are the block diagrams of these two loops.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting

problem, grid = hjb.zoo.pendulum()
system = hjb.zoo.Pendulum()
start, duration = [0.6, 0.0], 5.0

# %% [markdown]
# ## Figure 3: the pendulum

# %%
figure, ax = plt.subplots(figsize=(2.6, 2.6), layout="constrained")
tip = np.array([np.sin(0.6), np.cos(0.6)])
ax.plot([0, 0], [0, 1.15], ":", color="0.5")
ax.plot([0, tip[0]], [0, tip[1]], color="black")
ax.plot(*tip, "o", color=plotting.COLOURS[0], markersize=14)
ax.plot(0, 0, "o", color="black", markersize=5)
arc = np.linspace(0, 0.6, 20)
ax.plot(0.45 * np.sin(arc), 0.45 * np.cos(arc), color=plotting.COLOURS[1])
ax.text(0.14, 0.52, "θ", color=plotting.COLOURS[1], fontsize=12)
ax.text(tip[0] + 0.12, tip[1], "m", color=plotting.COLOURS[0], fontsize=12, va="center")
ax.annotate("", (0.22, -0.12), (-0.22, -0.12), arrowprops={"arrowstyle": "->", "connectionstyle": "arc3,rad=0.6"})
ax.text(0, -0.42, "τ", fontsize=12, ha="center")
ax.annotate("", (tip[0], tip[1] - 0.55), tip, arrowprops={"arrowstyle": "->", "color": "0.5"})
ax.text(tip[0] + 0.06, tip[1] - 0.5, "m g", color="0.5", fontsize=12)
ax.set(xlim=(-0.6, 1.0), ylim=(-0.5, 1.25), aspect="equal")
ax.set_axis_off()
plt.show()

# %% [markdown]
# ## Without a torque
#
# Upright is an unstable equilibrium: the linearisation has the eigenvalues $\pm\sqrt g$. A pendulum that is released
# near upright swings through the hanging position and back. Its energy $\tfrac12\dot\theta^2 + g\cos\theta$ is
# constant.

# %%
fall = hjb.simulate(problem, lambda x: jnp.zeros(1), start, duration, rtol=1e-8, atol=1e-8)
energy = 0.5 * fall.states[:, 1] ** 2 + 9.81 * np.cos(fall.states[:, 0])
print(f"energy at the start {energy[0]:.4f}, at the end {energy[-1]:.4f}")
assert np.ptp(energy) < 1e-4

figure, ax = plt.subplots(figsize=(5.4, 3.2), layout="constrained")
plotting.trajectory(fall, ax=ax, axes=None, grid=grid)
plt.show()

# %% [markdown]
# ## Figure 4: the loop that cancels gravity
#
# The inner loop (2.6) makes the system from the new input $v$ to the angle linear, $m\ddot\theta = v$:
#
# ```text
#  v     +---+   τ    +----------+  θ, θ'
# ----->( + )-------->| pendulum |----+---->
#         ^           +----------+    |
#         |   +-----------------+     |
#         +---|   - m g sin θ   |<----+
#             +-----------------+
# ```
#
# It does not stabilise anything. With $v = 0$ the angle grows linearly.

# %%
floating = hjb.simulate(
    problem, lambda x: jnp.stack([-9.81 * jnp.sin(x[0])]), [0.6, 0.2], duration, rtol=1e-8, atol=1e-8
)
away = np.abs(floating.states[:, 0] - (0.6 + 0.2 * floating.times)).max()
print(f"largest distance from a straight line {away:.1e}")
assert away < 1e-6

# %% [markdown]
# ## Figure 5: the stabilised loop
#
# An outer loop adds friction and a spring, $v = -k_1\dot\theta - k_2\theta$. Together they are the torque (2.8):
#
# ```text
#          +---+   τ    +----------+  θ, θ'
#        ( + )--------->| pendulum |----+------>
#          ^ ^          +----------+    |
#          | |   +-----------------+    |
#          | +---|   - m g sin θ   |<---+
#          |     +-----------------+    |
#          |   v +-----------------+    |
#          +-----|  - k₁ θ' - k₂ θ |<---+
#                +-----------------+
# ```
#
# $$\tau = -m g\sin\theta - k_1\dot\theta - k_2\theta.$$
#
# With $k_1 = 3m$ and $k_2 = 2m$ the angle obeys $\ddot\theta + 3\dot\theta + 2\theta = 0$. Starting at rest at
# $\theta_0$, it is $\theta_0(2e^{-t} - e^{-2t})$.


# %%
def held(x):
    return jnp.stack([-9.81 * jnp.sin(x[0]) - 3 * x[1] - 2 * x[0]])


path = hjb.simulate(problem, held, start, duration, rtol=1e-8, atol=1e-8)
exact = 0.6 * (2 * np.exp(-path.times) - np.exp(-2 * path.times))
print(f"largest distance from the formula {np.abs(path.states[:, 0] - exact).max():.1e}")
assert np.abs(path.states[:, 0] - exact).max() < 1e-5

figure, ax = plt.subplots(figsize=(5.4, 3.2), layout="constrained")
plotting.trajectory(path, ax=ax, axes=None, grid=grid)
plt.show()

# %% [markdown]
# ## In the plane of angle and velocity
#
# The same two paths, drawn over the vector field of the closed loop.

# %%
angles, rates = np.meshgrid(np.linspace(-np.pi, np.pi, 21), np.linspace(-6, 6, 21))
accelerations = -3 * rates - 2 * angles
figure, ax = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
ax.streamplot(angles, rates, rates, accelerations, color="0.8", linewidth=0.7, density=0.8, arrowsize=0.7)
plotting.trajectory(fall, ax=ax, grid=grid, color=plotting.COLOURS[0], label="no torque")
plotting.trajectory(path, ax=ax, grid=grid, color=plotting.COLOURS[1], label="feedback")
ax.set(xlim=(-np.pi, np.pi), ylim=(-7, 7))
plt.show()
