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
# # Stochastic control
#
# Section 10 of the chapter. With noise, $dx = f(x, u)\,dt + \varepsilon\,dw$, the equation of dynamic programming has
# second derivatives, as in (10.4):
#
# $$\beta V = \tfrac{\varepsilon^2}{2}\Delta V + \min_u\,[\,f(x, u)\cdot DV + L(x, u)\,].$$

# %%
import warnings

import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting

warnings.simplefilter("ignore", hjb.SolveWarning)

# %% [markdown]
# ## The cost of noise
#
# A bounded speed holds a point on a line near zero. Noise keeps the point away from zero, so the value increases with
# the noise. All three values have a closed form.

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
errors = {}
for noise, colour in zip((0.25, 0.5, 1.0), plotting.COLOURS, strict=False):
    problem, grid = hjb.zoo.bang_bang(noise=noise)
    solution = hjb.solve(problem, grid, tol=1e-8)
    exact = hjb.zoo.bang_bang_exact(noise=noise)
    errors[noise] = max(abs(float(exact([x])) - float(solution.value_at([x]))) for x in np.linspace(-1.5, 1.5, 13))
    axes[0].plot(grid.axis(0), solution.value, color=colour, label=f"ε = {noise}")
    start = hjb.simulate(problem, hjb.greedy_feedback(problem, solution), [1.5], 5.0, hold=0.02, key=1)
    axes[1].plot(start.times, start.states[:, 0], color=colour)
axes[0].set(xlabel="x", ylabel="V")
axes[0].legend(frameon=False)
axes[1].set(xlabel="t", ylabel="x")
plt.show()
print({noise: f"{error:.1e}" for noise, error in errors.items()})
assert max(errors.values()) < 0.01

# %% [markdown]
# ## The value is a mean
#
# $V(x_0)$ is the mean cost over many paths. A single path may cost half or twice as much.

# %%
problem, grid = hjb.zoo.stochastic_lq()
solution = hjb.solve(problem, grid, tol=1e-8)
reference = float(hjb.zoo.stochastic_lq_exact()([1.0]))
print(f"V(1) = {solution.value_at([1.0]):.4f}, in closed form {reference:.4f}")
assert abs(solution.value_at([1.0]) - reference) < 1e-3

# %% [markdown]
# ## Exit times
#
# The same generator gives the mean time that a state stays in a region. A Brownian motion that starts in the centre of
# a disc of radius 1 stays for $\tfrac{1}{2}$ in the mean.

# %%
problem, grid = hjb.zoo.brownian_ball(shape=(41, 41))
time = hjb.solve(problem, grid)
figure, ax = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
plotting.value(time, ax=ax)
plt.show()
assert abs(time.value_at([0.0, 0.0]) - 0.5) < 5e-3
