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
# # Inverse optimal control and design
#
# A cart is observed while an optimal control brings it to rest. Its mass and one weight of the cost are recovered from
# six noisy paths. Then the strength of a motor is chosen so that its price and the value together are least.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb


def posed(p):
    return hjb.Problem(
        lambda x, u: jnp.stack([x[1], u[0] / p["mass"]]),
        lambda x, u: p["weight"] * x[0] ** 2 + 0.5 * x[1] ** 2 + u @ u,
        hjb.Box([-6.0], [6.0]),
    )


grid = hjb.Grid([-2.5, -2.5], [2.5, 2.5], (33, 33))
truth = posed({"mass": 1.5, "weight": 2.0})
fine = hjb.Grid([-2.5, -2.5], [2.5, 2.5], (41, 41))
feedback = hjb.solve(truth, fine)
draw = np.random.default_rng(0)
starts = draw.uniform(-0.7, 0.7, (6, 2))
paths = [hjb.simulate(truth, feedback, start, 4.0, steps=20) for start in starts]
seen = [
    (path.times, *(values + 0.03 * np.nanstd(values) * draw.normal(size=values.shape) for values in pair))
    for path in paths
    for pair in [(path.states, path.controls)]
]

# %% [markdown]
# Every step of Adam solves the problem and simulates all paths. Its step lengths are relative to the parameters.

# %%
found = hjb.fit_trajectories(posed, grid, seen, {"mass": 1.0, "weight": 1.0}, steps=50)
print(found)
assert abs(found.parameters["mass"] - 1.5) < 0.15
assert abs(found.parameters["weight"] - 2.0) < 0.2

figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
axes[0].semilogy(found.history)
axes[0].set(xlabel="step", ylabel="loss")
fitted = posed(found.parameters)
again = hjb.simulate(fitted, hjb.solve(fitted, fine), starts[0], 4.0, steps=20)
axes[1].plot(seen[0][0], seen[0][1], "o", markersize=3)
axes[1].set_prop_cycle(None)
axes[1].plot(again.times, again.states)
axes[1].set(xlabel="t", ylabel="position, velocity")
plt.show()

# %% [markdown]
# ## Design
#
# A motor of strength b moves x with $\dot x = b u$ at the cost $x^2 + u^2$, so $V = x^2/b$. Strength costs 4 per unit.
# From $x = 1$ the best strength is ½, where the sum is 4.

# %%
best = hjb.design(
    lambda b: hjb.Problem(lambda x, u: b * u, lambda x, u: x @ x + u @ u, hjb.Box([-9.0], [9.0])),
    hjb.Grid([-1.5], [1.5], (61,)),
    lambda solution, b: solution.value_at(jnp.array([1.0])) + 4 * b,
    0.8,
    steps=40,
)
print(f"strength {float(best.parameters):.3f}, value and price {best.loss:.3f}")
assert abs(best.parameters - 0.5) < 0.005
