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
# # Ten states without a grid: the Hopf formula
#
# Five carts are coupled by springs and dampers in a chain; a motor acts on the first and on the last. From which states
# can the motors bring all carts near rest within three seconds? Ten states are too many for a grid. The dynamics are
# linear and the target is convex, so the generalised Hopf formula gives the value by one convex problem per state.

# %%
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb

carts = 5
chain = 2 * np.eye(carts) - np.eye(carts, k=1) - np.eye(carts, k=-1)
A = np.block([[np.zeros((carts, carts)), np.eye(carts)], [-chain, -0.3 * chain]])
B = np.zeros((2 * carts, 2))
B[carts, 0] = B[-1, 1] = 1.0

target = hjb.convex.ball(np.zeros(2 * carts), 0.3)
problem = hjb.reach(lambda x, u: A @ x + B @ u, hjb.Box([-1.0] * 2, [1.0] * 2), target, tube=False)
solution = hjb.hopf(problem, 3.0, intervals=60)
start = np.r_[0.9, 0.6, 0.0, -0.6, 0.9, np.zeros(carts)]
lower, upper = solution.bounds_at(0.0, start)
print(f"V = {solution.value_at(0.0, start):.4f}, enclosed by {lower:.4f} and {upper:.4f}")
assert upper - lower < 0.01

# %% [markdown]
# ## The closed loop
#
# The control at each moment is the minimiser of $p\cdot Bu$ for the costate $p$ of the current state. With a sampling
# interval of 0.05 s the path ends near the value that the formula predicts. The rest is the effect of the sampling.

# %%
path = hjb.simulate(problem, solution.control_at, start, 3.0, time_varying=True, hold=0.05)
figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
axes[0].plot(path.times, path.states[:, :carts], label=[f"cart {i + 1}" for i in range(carts)])
axes[0].set(xlabel="t [s]", ylabel="position [m]")
for motor, (style, name) in enumerate((("-", "first cart"), ("--", "last cart"))):
    axes[1].step(path.times[:-1], path.controls[:, motor], style, where="post", label=name)
axes[1].set(xlabel="t [s]", ylabel="force [N]")
for axis in axes:
    axis.legend(frameon=False)
plt.show()
print(f"cost of the path {float(path.cost):.4f}")
assert abs(float(path.cost) - solution.value_at(0.0, start)) < 0.05

# %% [markdown]
# ## A slice of the reachable set
#
# The value on a plane through the ten-dimensional state: the positions of the first and the last cart, all others zero.

# %%
positions = np.linspace(-3.0, 3.0, 41)
states = np.zeros((41, 41, 2 * carts))
states[..., 0], states[..., carts - 1] = np.meshgrid(positions, positions, indexing="ij")
value = solution.value_at(0.0, states)
figure, axis = plt.subplots(figsize=(4.6, 3.8), layout="constrained")
shades = axis.contourf(positions, positions, value.T, np.arange(-0.35, 1.1, 0.1))  # not the minimum, −0.3
axis.contour(positions, positions, value.T, [0.0], colors="white")
axis.plot([], [], color="white", label="V = 0")  # contours have no label
axis.legend(loc="lower left", labelcolor="white", frameon=False)
axis.set(xlabel="position of the first cart [m]", ylabel="position of the last cart [m]", aspect="equal")
figure.colorbar(shades, label="V [m]", ticks=np.arange(-0.2, 1.1, 0.2))
plt.show()
assert value.min() < 0 < value.max()
