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
# # Pontryagin's principle and dynamic programming
#
# Section 8 of the chapter has two methods for an optimal control. Dynamic programming solves a partial differential
# equation for the value of every state. Pontryagin's principle, (8.4) to (8.7), is a boundary-value problem along one
# path. Its costate $\lambda$ is the gradient of the value along the path.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting

# %% [markdown]
# ## A mass at a quadratic cost
#
# A force moves a mass to the origin at the cost $\tfrac12\int |x|^2 + u^2\,dt$. The problem is linear-quadratic, so the
# value is $\tfrac12 x^\top P x$ with $P$ from the Riccati equation.


# %%
def drift(x, u):
    return jnp.stack([x[1], u[0]])


def cost(x, u):
    return 0.5 * (x @ x + u @ u)


names, units = ("position", "velocity"), ("m", "m/s")
problem = hjb.Problem(
    drift, cost, hjb.Box([-8.0], [8.0]), terminal_cost=lambda x: 2.5 * x @ x, control_names=("force",)
)
grid = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (61, 61), names=names, units=units, edges="open")
solution = hjb.march(problem, grid, 3.0, times=np.linspace(0, 3, 31))
start = [1.0, 0.0]
extremal = hjb.pontryagin(problem, start, horizon=3.0)
print(f"cost by dynamic programming {solution.value_at(0.0, start):.4f}, by Pontryagin {extremal.cost:.4f}")
assert abs(solution.value_at(0.0, start) - extremal.cost) < 0.01

# %% [markdown]
# ## The principle of optimality
#
# Dynamic programming rests on (8.10): an optimal path remains optimal from every later state. So the cost paid up to a
# time $r$ plus the value of the state at that time is the same number for all $r$, and it is larger for another
# control:
#
# $$V(x_0, 0) = \inf_u [\int_0^r L(x, u)\,dt + V(x(r), r)].$$

# %%
sums = {}
for name, control in {"optimal": solution, "twice as strong": lambda t, x: 2 * solution.control_at(t, x)}.items():
    varying = {} if control is solution else {"time_varying": True}
    path = hjb.simulate(problem, control, start, 3.0, steps=60, **varying)
    rates = 0.5 * (np.sum(path.states[:-1] ** 2, axis=1) + np.sum(path.controls**2, axis=1))
    paid = np.append(0.0, np.cumsum(rates * np.diff(path.times)))
    sums[name] = paid + solution.value_at(path.times, path.states, clamp=True)
    shown = ", ".join(f"{each:.3f}" for each in sums[name][[0, 15, 30, 45]])
    print(f"{name:16} cost up to r plus V at r = 0, 0.75, 1.5, 2.25: {shown}")
assert np.ptp(sums["optimal"]) < 0.1
assert sums["twice as strong"][30] > sums["optimal"][30] + 0.1

# %% [markdown]
# ## Costates and gradients
#
# The costates (solid) and the gradient of the value along the same path (dashed):

# %%
figure, ax = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
plotting.costates(extremal, solution=solution, ax=ax)
plt.show()
times = np.asarray(extremal.times)
slopes = np.asarray(solution.costate_at(times, extremal.states, clamp=True))
inner = times < 2.9
difference = np.abs(slopes - extremal.costates)[inner].max()
print(f"largest difference {difference:.3f} of costates up to {np.abs(extremal.costates).max():.2f}")
assert difference < 0.05

# %% [markdown]
# ## Strengths of the two methods
#
# The extremal is accurate to many digits and needs no grid, whatever the number of states. But it is one path from one
# state, and its control is a function of time. The value function gives a feedback for every state, which reacts to
# disturbances. After a disturbance the open loop does not return to the origin.

# %%
pushed = [1.0, 0.5]
closed = hjb.simulate(problem, solution, pushed, 3.0)
opened = hjb.simulate(
    problem, lambda t, x: jnp.stack([jnp.interp(t, times[:-1], np.asarray(extremal.controls)[:, 0])]), pushed, 3.0,
    time_varying=True,
)  # fmt: skip
figure, ax = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
plotting.value(solution, ax=ax, time=0.0)
plotting.trajectory(closed, ax=ax, grid=grid, label="feedback")
plotting.trajectory(opened, ax=ax, grid=grid, color=plotting.COLOURS[3], label="open loop")
plt.show()
ends = [float(np.linalg.norm(path.states[-1])) for path in (closed, opened)]
print(f"distance from the origin at the end: feedback {ends[0]:.2f}, open loop {ends[1]:.2f}")
assert ends[0] < 0.3 * ends[1]
