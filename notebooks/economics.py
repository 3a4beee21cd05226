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
# # Growth, a portfolio, and a put
#
# Three problems of economics, each with a known answer. The equation of dynamic programming is the same as in control;
# utility and payoffs are rewards, which are maximised.

# %%
import warnings

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import norm

import hjbjax as hjb
from hjbjax import plotting

warnings.simplefilter("ignore", hjb.SolveWarning)

# %% [markdown]
# ## How much of the capital to eat
#
# Capital grows at the rate $k^{0.36} - 0.05k$ minus consumption $c$. Utility is $c^{0.64}/0.64$, discounted at 4 %. For
# these numbers the optimal consumption is exactly proportional to the capital.

# %%
capital = hjb.Problem(
    lambda k, c: k**0.36 - 0.05 * k - c, controls=hjb.Box([1e-3], [20.0]), discount=0.04,
    reward=lambda k, c: c[0] ** 0.64 / 0.64, control_names=("consumption",),
)  # fmt: skip
grid = hjb.Grid([1.5], [9.5], (201,), names=("capital",), edges="constrained")
growth = hjb.solve(capital, grid)
share = (0.04 + 0.64 * 0.05) / 0.36
figure, ax = plt.subplots(figsize=(5.4, 3.2), layout="constrained")
plotting.policy(growth, ax=ax)[0].set_label("computed")
ax.plot([1.5, 9.5], [1.5 * share, 9.5 * share], ":", color="black", linewidth=2.5, label="exact")
ax.legend(frameon=False)
plt.show()
print(f"eat {growth.control_at([5.0])[0]:.3f} of a capital of 5; exactly {5 * share:.3f}")
assert abs(growth.control_at([5.0])[0] - 5 * share) < 0.01

# %% [markdown]
# ## Merton's portfolio
#
# Wealth earns interest, or a higher and risky return. With constant relative risk aversion the optimal risky share does
# not depend on wealth, so the picture shows a constant.

# %%
problem, grid = hjb.zoo.merton()
portfolio = hjb.solve(problem, grid)
figure, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
for input, ax in enumerate(axes):
    plotting.policy(portfolio, input=input, ax=ax)
plt.show()
best = hjb.zoo.Merton()
print(f"share at risk {portfolio.control_at([0.0])[0]:.3f}, by Merton's formula {float(best.share):.3f}")
assert abs(portfolio.control_at([0.0])[0] - best.share) < 0.01

# %% [markdown]
# ## An American put
#
# The right to sell at 1 may be exercised at any time. This is a problem of optimal stopping in the logarithm of the
# price, and the value of the put is at least the payoff. The European put, exercised at the end only, has the formula
# of Black and Scholes.

# %%
rate, sigma, horizon = 0.06, 0.3, 1.0


def payoff(x):
    return jnp.maximum(1 - jnp.exp(x[0]), 0.0)


def price(early):
    return hjb.Problem(
        lambda x, u: jnp.stack([rate - sigma**2 / 2 + 0 * x[0]]), noise=sigma, discount=rate, terminal_reward=payoff,
        stopping_reward=payoff if early else None,
    )  # fmt: skip


line = hjb.Grid([-2.0], [2.0], (201,), names=("log price",))
times = np.linspace(0, horizon, 21)
marched, held = (hjb.march(price(early), line, horizon, times=times) for early in (True, False))
american, european = marched.value[0], held.value[0]
spot = np.exp(line.axis(0))
d = (np.log(spot) + (rate - sigma**2 / 2) * horizon) / (sigma * np.sqrt(horizon))
formula = np.exp(-rate * horizon) * norm.cdf(-d) - spot * norm.cdf(-d - sigma * np.sqrt(horizon))
inner = np.abs(line.axis(0)) < 1
print(f"European put against Black and Scholes: largest difference {np.abs(european - formula)[inner].max():.1e}")
print(f"the right to sell early is worth {(american - european)[inner].max():.4f} at most")
assert np.abs(european - formula)[inner].max() < 2e-3
assert np.all(american >= european - 1e-6)

figure, ax = plt.subplots(figsize=(5.4, 3.2), layout="constrained")
ax.plot(spot, american, color=plotting.COLOURS[0], label="American")
ax.plot(spot, european, color=plotting.COLOURS[1], label="European")
ax.plot(spot, formula, ":", color="black", label="Black and Scholes")
ax.set(xlim=(0.4, 2.0), ylim=(0, 0.6), xlabel="price", ylabel="value of the put")
ax.legend(frameon=False)
plt.show()

# %% [markdown]
# The put is exercised below a price that rises to 1 at the end: the free boundary, between the nodes. Without an end
# the boundary is the constant $k/(1+k)$ with $k = 2r/\sigma^2$.

# %%
lowest = [float(np.exp(marched.free_boundary(time=t)[0])) for t in times[:-1]]
perpetual = float(hjb.zoo.AmericanPut(1.0, rate, sigma).boundary)
print(f"exercise below {lowest[0]:.3f} at the beginning, below {lowest[-1]:.3f} near the end")
assert np.all(np.diff(lowest) > 0)
assert perpetual < lowest[0] < lowest[-1] < 1

figure, ax = plt.subplots(figsize=(5.4, 3.2), layout="constrained")
ax.plot(times[:-1], lowest, color=plotting.COLOURS[0], label="exercise below")
ax.axhline(perpetual, linestyle=":", color="black", label="without an end")
ax.set(xlim=(0, horizon), ylim=(0.5, 1.0), xlabel="time", ylabel="price")
ax.legend(frameon=False)
plt.show()
