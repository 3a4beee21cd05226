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
from scipy.integrate import solve_ivp

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

# %% [markdown]
# ## Small noise and weak disturbances
#
# With noise of strength $\varepsilon$ the value of the stochastic problem approaches the value without noise, and its
# feedback approaches the optimal feedback, with a difference of order $\varepsilon^2$, as in (10.6). With a high price
# $\gamma^2$ of the disturbance the robust controller approaches it too, with a difference of order $\gamma^{-2}$, as in
# (11.7). `perturbation_study` measures both orders; here for a cost of fourth degree, which has no closed form.

# %%
stiff = hjb.Problem(
    lambda x, u: u, lambda x, u: 0.5 * (x @ x + u @ u) + x[0] ** 4, hjb.Box([-8.0], [8.0]), discount=1.0
)
study = hjb.perturbation_study(
    stiff, hjb.Grid([-1.5], [1.5], (81,)), noises=[0.1, 0.2, 0.4], gammas=[5.0, 10.0, 20.0],
    disturbances=hjb.Box([-1.0], [1.0]), region=0.5,
)  # fmt: skip
figure, ax = plt.subplots(figsize=(5.4, 3.6), layout="constrained")
plotting.perturbation(study, ax=ax)
plt.show()
for series in (study.noise, study.gain):
    assert abs(series.order - 2) < 0.2
    assert abs(series.feedback_order - 2) < 0.2

# %% [markdown]
# ## Risk-sensitive control
#
# Between the two stands a controller that weighs bad outcomes of the noise more than good ones. It minimises
# $\tfrac1\theta \log E \exp(\theta \int L\,dt)$ with a risk aversion $\theta$. Its equation is the equation of the game
# with noise: the logarithm adds $\tfrac12\theta\varepsilon^2|DV|^2$, which is what a disturbance with the price
# $\gamma^2 = 1/(\theta\varepsilon^2)$ adds. So `attenuation` of the plant with noise solves it:

# %%
noise, aversion = 0.5, 1.0
noisy = hjb.Problem(lambda x, u: u - x, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-4.0], [4.0]), noise=noise)
careful = hjb.march(
    hjb.attenuation(noisy, (aversion * noise**2) ** -0.5, disturbances=hjb.Box([-4.0], [4.0])),
    hjb.Grid([-2.5], [2.5], (101,)), 3.0,
)  # fmt: skip


def closed_form(aversion, x=0.5):
    """½ P x² + q by the Riccati equation of the risk-sensitive problem."""
    weight = 1 - aversion * noise**2
    rates = solve_ivp(
        lambda t, y: [1 - 2 * y[0] - weight * y[0] ** 2, 0.5 * noise**2 * y[0]], (0, 3), [0, 0], rtol=1e-9, atol=1e-12
    )
    return 0.5 * rates.y[0, -1] * x**2 + rates.y[1, -1]


print(f"V(½) = {careful.value_at(0.0, [0.5]):.5f}, in closed form {closed_form(aversion):.5f}")
print(f"without risk aversion {closed_form(0.0):.5f}")
assert abs(careful.value_at(0.0, [0.5]) - closed_form(aversion)) < 1e-4
