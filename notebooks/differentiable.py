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
# # A solver that can be differentiated
#
# Numbers in a problem are leaves of a pytree. A value and the feedback at a state can be differentiated with respect to
# them, so you can optimise a design or imitate a controller by gradient methods.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting

grid = hjb.Grid([-2.0], [2.0], (61,))


def regulated(weight, strength=1.0):
    """A line with friction, at the cost ½(x² + weight u²)."""
    return hjb.Problem(
        lambda x, u: -0.5 * x + strength * u, lambda x, u: 0.5 * (x @ x + weight * (u @ u)), hjb.Box([-9.0], [9.0]),
        discount=0.5,
    )  # fmt: skip


# %% [markdown]
# ## The derivative of a value
#
# How much is a stronger motor worth? The closed form for comparison is $V = \tfrac12 P x^2$ with
# $\tfrac32 P + s^2P^2/w = 1$.


# %%
def value(strength):
    return hjb.solve(regulated(1.0, strength), grid, tol=1e-8).value_at([1.0])


def exact(strength):
    return 0.5 * (jnp.sqrt(1.5**2 + 4 * strength**2) - 1.5) / (2 * strength**2)


with jax.enable_x64(True):
    slope, wanted = float(jax.grad(value)(1.0)), float(jax.grad(exact)(1.0))
print(f"dV/ds = {slope:.4f}, in closed form {wanted:.4f}")
assert abs(slope - wanted) < 0.03 * abs(wanted)

# %% [markdown]
# ## Imitation
#
# We observe the controls of an expert at a few states. Which weight on the control does the expert use? `control_at` is
# differentiable, so the Gauss–Newton method finds the weight.

# %%
places = np.array([[0.5], [1.0], [1.5]])
hidden = 0.4
seen = np.asarray(hjb.solve(regulated(hidden), grid, tol=1e-8).control_at(places))


def steered(logarithm):
    return hjb.solve(regulated(jnp.exp(logarithm)), grid, tol=1e-8).control_at(places)[:, 0]


guesses = [0.0]
with jax.enable_x64(True):
    look = jax.jit(lambda logarithm: (steered(logarithm), jax.jacrev(steered)(logarithm)))
    for _ in range(6):
        controls, slopes = map(np.asarray, look(guesses[-1]))
        off = controls - seen[:, 0]
        guesses.append(float(guesses[-1] - (slopes @ off) / (slopes @ slopes)))
weights = np.exp(guesses)
print("weights on the way:", weights.round(4).tolist())
figure, ax = plt.subplots(figsize=(5.4, 3.2), layout="constrained")
ax.plot(weights, "o-", color=plotting.COLOURS[0], label="found")
ax.axhline(hidden, linestyle="--", color="0.4", label="hidden")
ax.set(xlabel="step of Gauss and Newton", ylabel="weight")
ax.legend(frameon=False)
plt.show()
assert abs(weights[-1] - hidden) < 1e-3
