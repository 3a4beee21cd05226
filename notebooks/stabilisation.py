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
# # Stabilisation: Brockett's condition and Pomet's feedback
#
# Section 6 of the chapter. If a continuous feedback of the state makes the origin asymptotically stable, then the
# velocities $f(x, u)$ near the origin cover a neighbourhood of zero (Brockett's condition). A car that cannot move
# sideways violates this condition, and so does Pomet's system (6.6),
#
# $$\dot x_1 = u_1, \qquad \dot x_2 = x_1 u_2, \qquad \dot x_3 = u_2.$$

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting

system = hjb.zoo.Pomet()
_, fields = hjb.geometry.affine_fields(system.drift, inputs=2)
reach = hjb.geometry.reachability_distribution(None, fields, jnp.zeros(3), 1)
verdict = hjb.stability.brockett_check(None, fields, jnp.zeros(3))
print(f"rank {reach.rank}: controllable. Brockett's condition is {verdict.message}")
assert reach.rank == 3
assert verdict.message.startswith("violated")

# %% [markdown]
# ## A feedback of time and state
#
# A feedback that also depends on time can stabilise the system. Pomet's feedback (6.7) has the Lyapunov function (6.8),
# $V = \tfrac12(x_1 + x_2\cos t)^2 + \tfrac12 x_2^2 + \tfrac12 x_3^2$, which never increases. A search over states and
# times finds no counterexample.

# %%
report = hjb.lyapunov_check(
    system.lyapunov, system.closed_loop, hjb.Box([-1.0] * 3, [1.0] * 3), times=[0.0, 2 * np.pi], samples=512
)
print(f"largest dV/dt that was found: {report.rate:.1e}")
assert report.holds

problem = hjb.Problem(system.drift, controls=hjb.Box([-9.0] * 2, [9.0] * 2))
path = hjb.simulate(problem, system.feedback, [0.3, 0.8, -0.5], 60.0, time_varying=True)
energy = np.array([float(system.lyapunov(t, x)) for t, x in zip(path.times, path.states, strict=True)])
figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
plotting.trajectory(path, ax=axes[0], axes=None)
axes[1].semilogy(path.times, energy, color=plotting.COLOURS[0])
axes[1].set(xlabel="t", ylabel="V")
plt.show()
assert np.all(np.diff(energy) < 1e-6)
assert energy[-1] < 0.1 * energy[0]

# %% [markdown]
# $V$ falls like $1/t$, and the state like $t^{-1/2}$. No feedback that is smooth in the state can make the decay
# exponential.
