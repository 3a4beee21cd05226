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
# # Feedback linearisation
#
# Section 5 of the chapter: if an output $y$ has relative degree $r$, its $r$-th derivative is
# $L_f^r h + L_g L_f^{r-1} h\,u$, and the feedback $u = \alpha(x) + \beta(x)v$ makes it equal to $v$. If $r$ is smaller
# than the number of states, the rest of the system is its zero dynamics.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.linalg import expm

import hjbjax as hjb
from hjbjax import plotting

# %% [markdown]
# ## A flexible joint
#
# A link driven through a spring has four states. Its angle has relative degree four, so there are no zero dynamics.

# %%
arm = hjb.zoo.FlexibleJoint()
f, g = hjb.geometry.affine_fields(arm.drift, inputs=1)
degree = hjb.geometry.relative_degree(f, g, arm.output, jnp.zeros(4))
print(degree.message)
assert degree.degree == 4

# %% [markdown]
# ## Figure 7: a linear system from v to z
#
# In the coordinates $z = (h, L_f h, L_f^2 h, L_f^3 h)$ the feedback turns the joint into the chain of integrators
# (5.4), from the new input $v$ to $z$:
#
# ```text
#  v   +---------------+   u   +---------+   x   +------+   z
# ---->| α(x) + β(x) v |------>| x' = f  |---+-->| Φ(x) |------>     z₁' = z₂, z₂' = z₃, z₃' = z₄, z₄' = v
#      +---------------+       |  + g u  |   |   +------+
#             ^                +---------+   |
#             +------------------------------+
# ```
#
# A linear feedback $v = -Kz$ then places the poles, here at −1, −2, −3 and −4, and the path follows the matrix
# exponential however large the angles are.

# %%
alpha, beta, coordinates = hjb.geometry.linearising_feedback(f, g, arm.output, jnp.zeros(4))
gains = np.poly([-1, -2, -3, -4])[:0:-1]


def linear(x):
    return alpha(x) + beta(x) @ -(jnp.asarray(gains) @ coordinates(x))[None]


joint = hjb.Problem(arm.drift, controls=hjb.Box([-1e4], [1e4]))
bent = hjb.simulate(joint, linear, [0.5, 0.0, 0.5, 0.0], 4.0, rtol=1e-8, atol=1e-8)
z = np.asarray(jax.jit(jax.vmap(coordinates))(bent.states))
companion = np.eye(4, k=1)
companion[3] = -gains
expected = np.array([expm(companion * t) @ z[0] for t in bent.times])
print(f"largest distance of z from the linear system {np.abs(z - expected).max():.1e}")
assert np.abs(z - expected).max() < 1e-3

# %% [markdown]
# ## A system that cannot be linearised
#
# The ball on a beam is different: its relative degree is not defined where the beam is level, and no change of
# coordinates makes it linear.

# %%
beam = hjb.zoo.BallAndBeam()
f, g = hjb.geometry.affine_fields(beam.drift, inputs=1)
verdict = hjb.geometry.is_feedback_linearisable(f, g, jnp.array([0.1, 0.0, 0.1, 0.1]))
print(f"linearisable: {bool(verdict.linearisable)}, involutive: {bool(verdict.involutive)}")
assert not verdict.linearisable

# %% [markdown]
# ## A manipulator follows a path
#
# For a planar arm, $M(q)\ddot q + C(q, \dot q) + G(q) = \tau$, the computed torque
# $\tau = M(q)a + C(q, \dot q) + G(q)$ makes each joint a double integrator. With
# $a = \ddot q^* - k_1(\dot q - \dot q^*) - k_2(q - q^*)$ the error decays as if there were neither inertia nor gravity.
# Here the joint angles of two links follow sine and cosine, from a start that is half a radian off.

# %%
links = hjb.zoo.Manipulator(links=2)
problem = hjb.Problem(
    links.drift, controls=hjb.Box([-200.0] * 2, [200.0] * 2), control_names=("torque 1", "torque 2"),
    control_units=("N m",) * 2,
)  # fmt: skip


def wanted(t):
    return jnp.stack([0.8 * jnp.sin(t), 0.8 * jnp.cos(t)])


def tracking(t, x):
    q, w = x[:2], x[2:]
    speed, acceleration = jnp.stack([0.8 * jnp.cos(t), -0.8 * jnp.sin(t)]), -wanted(t)
    return links.computed_torque(q, w, acceleration - 3 * (w - speed) - 2 * (q - wanted(t)))


start = [0.5, 0.8, 0.8, 0.0]
path = hjb.simulate(problem, tracking, start, 8.0, time_varying=True, rtol=1e-8, atol=1e-8)
error = path.states[:, 0] - 0.8 * np.sin(path.times)
exact = 0.5 * (2 * np.exp(-path.times) - np.exp(-2 * path.times))
print(f"largest distance of the error from its formula {np.abs(error - exact).max():.1e}")
assert np.abs(error - exact).max() < 1e-4

figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
for joint in (0, 1):
    colour = plotting.COLOURS[joint]
    axes[0].plot(path.times, path.states[:, joint], color=colour, label=f"joint {joint + 1}")
    reference = 0.8 * (np.sin(path.times), np.cos(path.times))[joint]
    axes[0].plot(path.times, reference, "--", color="black", linewidth=0.8, label="wanted" if joint else None)
axes[0].set(xlabel="t [s]", ylabel="angle [rad]")
axes[0].legend(frameon=False)
axes[1].set_xlabel("t [s]")
names = [f"torque {joint + 1} [N m]" for joint in (0, 1)]
plotting.controls(path, ax=axes[1], names=names)
plt.show()
