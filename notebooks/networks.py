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
# # A hundred states: a network for a stochastic problem
#
# The control moves $x$ with $dx = 2u\,dt + \sqrt2\,dw$ in 100 dimensions, costs $|u|^2$, and pays
# $\psi = \log\frac12(1 + |x|^2)$ at time 1. Its value solves $V_t + \Delta V - |\nabla V|^2 = 0$. At the origin it is
# 4.59016 (W. E, J. Han and A. Jentzen, 2017).

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb

n = 100
problem = hjb.Problem(
    lambda x, u: 2 * u,
    lambda x, u: u @ u,
    hjb.Box([-np.inf] * n, [np.inf] * n),
    noise=np.sqrt(2.0),
    terminal_cost=lambda x: jnp.log(0.5 * (1 + x @ x)),
)
solution = hjb.neural.deep_bsde(problem, np.zeros(n), 1.0, seed=0, steps=400)
print(f"V = {solution.validation['value']:.2f}")
assert abs(solution.validation["value"] / 4.59016 - 1) < 0.005

# %% [markdown]
# ## The same value by a transformation
#
# The substitution $w = e^{-V}$ makes the equation linear, so $V = -\log E[e^{-\psi(x + \sqrt{2(1 - t)}\,z)}]$ with
# normal numbers $z$. The network is trained on paths from the origin. The picture compares both along such states.

# %%
draw = np.random.default_rng(0)
times = np.linspace(0.0, 1.0, 21)
z = draw.normal(size=(4000, n))
states = np.sqrt(2 * times)[:, None] * draw.normal(size=(21, n))


def exact(t, x):
    ends = x + np.sqrt(2 * (1 - t)) * z
    return -np.log(np.mean(2 / (1 + np.sum(ends**2, axis=1))))


reference = np.array([exact(t, x) for t, x in zip(times, states, strict=True)])
found = solution.value_at(times, states, extrapolate=True)
figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
axes[0].plot(times, reference, label="transformation")
axes[0].plot(times, found, "o", markersize=4, label="network")
axes[0].set(xlabel="t", ylabel="V along random states")
axes[0].legend()
axes[1].semilogy(25 * np.arange(len(solution.history)), solution.history)
axes[1].set(xlabel="step", ylabel="held-out error")
plt.show()
assert np.max(np.abs(found / reference - 1)) < 0.02
