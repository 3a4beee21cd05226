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
# # Robust control
#
# Section 11 of the chapter: the disturbance is an opponent instead of noise. A feedback has gain at most $\gamma$ if
#
# $$\int |z|^2\,dt \le \gamma^2 \int |d|^2\,dt + 2V(x_0)$$
#
# for all disturbances $d$. The smallest such $V$ is the value of a game and solves Isaacs' equation, as in (11.6),
#
# $$0 = \min_u\max_d\,[\,DV\cdot(f + d) + \tfrac12|z|^2 - \tfrac12\gamma^2|d|^2\,].$$

# %%
import warnings

import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting

warnings.simplefilter("ignore", hjb.SolveWarning)

plant = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-4.0], [4.0]))
grid = hjb.Grid([-1.5], [1.5], (61,))  # wider than the picture, because the drift is cut off at the ends


def game(gamma):
    return hjb.attenuation(plant, gamma, disturbances=hjb.Box([-4.0], [4.0]))


# %% [markdown]
# ## The price of a smaller gain
#
# For $\dot x = -x + u + d$ the value is $\tfrac12 P x^2$ with $P^2(1 - \gamma^{-2}) + 2P = 1$. A smaller gain requires
# a larger value and a stiffer feedback. Below $\gamma = 1/\sqrt2$ no feedback achieves it.

# %%
shown = np.abs(grid.axis(0)) < 1 + 1e-9
x = grid.axis(0)[shown]
figure, ax = plt.subplots(figsize=(5.4, 3.4), layout="constrained")
for gamma, colour in zip((0.75, 0.85, 2.0), plotting.COLOURS, strict=False):
    solution = hjb.march(game(gamma), grid, 12.0)
    weight = 1 - gamma**-2
    p = (np.sqrt(1 + weight) - 1) / weight
    error = abs(float(solution.value_at(0.0, [0.5])) - 0.5 * p * 0.25)
    print(f"γ = {gamma}: V(½) off by {error:.1e}, feedback u(½) = {solution.control_at(0.0, [0.5])[0]:.3f}")
    assert error < 2e-3
    ax.plot(x, solution.value[0][shown], color=colour, label=f"γ = {gamma}")
    ax.plot(x, 0.5 * p * x**2, ":", color="black", linewidth=2.5, label="exact" if gamma == 2.0 else None)
ax.set(xlabel="x", ylabel="V")
ax.legend(frameon=False)
plt.show()

# %% [markdown]
# ## The least gain
#
# `hinf_level` finds it by bisection: $V$ settles above the least gain, and grows without bound below it.

# %%
level = hjb.hinf_level(game, hjb.Grid([-1.0], [1.0], (21,)), lo=0.6, hi=0.9)
print(f"least gain {level.gamma:.3f}, by the Riccati equation {0.5**0.5:.3f}")
assert abs(level.gamma - 0.5**0.5) < 0.015
