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
# # Controllability and observability
#
# Section 4 of the chapter. A system without drift, $\dot x = g_1(x)u_1 + g_2(x)u_2$, may reach a full neighbourhood of
# its state although it has fewer inputs than states. By switching between its inputs it moves along the bracket
#
# $$[g_1, g_2] = \frac{\partial g_2}{\partial x} g_1 - \frac{\partial g_1}{\partial x} g_2.$$

# %%
import dataclasses
import warnings

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hjbjax as hjb
from hjbjax import plotting

warnings.simplefilter("ignore", hjb.SolveWarning)  # paths may leave the box here

car = hjb.zoo.Unicycle()
_, (forward, turn) = hjb.geometry.affine_fields(car.drift, inputs=2)
sideways = hjb.geometry.lie_bracket(forward, turn)
origin = jnp.zeros(3)
print(f"[forward, turn] at the origin: {np.asarray(sideways(origin)).round(12).tolist()}")
assert np.allclose(sideways(origin), [0, -1, 0], atol=1e-6)

# %% [markdown]
# ## Figure 6: how a car parks
#
# The car drives forward, turns, drives back and turns back, each for a time $\tau$. It ends next to its start,
# displaced by $\tau^2[g_1, g_2] + O(\tau^3)$. (The chapter prints $\tfrac12\tau^2$, which the numbers below exclude.)

# %%
plan = jnp.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
problem = hjb.Problem(car.drift, controls=hjb.Box([-1.0] * 2, [1.0] * 2))


def hold(u, x):
    return u


def switched(tau):
    """The path of the four pieces, each for a time tau."""
    states = [np.zeros((1, 3))]
    for u in plan:
        constant = jax.tree_util.Partial(hold, u)  # u is a leaf: another u compiles nothing again
        piece = hjb.simulate(problem, constant, states[-1][-1], tau, steps=20)
        states.append(np.asarray(piece.states)[1:])
    return np.concatenate(states)


lengths = (0.4, 0.2, 0.1)
paths = [switched(tau) for tau in lengths]
ends = np.array([path[-1] for path in paths])
figure, ax = plt.subplots(figsize=(5.4, 3.6), layout="constrained")
for tau, path, colour in zip(lengths, paths, plotting.COLOURS, strict=False):
    ax.plot(path[:, 0], path[:, 1], color=colour, label=f"τ = {tau}")
    ax.plot(*path[-1, :2], "o", color=colour)
    ax.plot(0, -(tau**2), "x", color=colour)
ax.set(xlabel="x", ylabel="y", aspect="equal")
ax.legend(title="crosses: τ²[g₁, g₂]", frameon=False)
plt.show()
shares = ends[:, 1] / np.square(lengths)
print("displacement over τ²:", shares.round(4).tolist())
assert np.all(np.diff(np.abs(shares + 1)) < 0)
assert abs(shares[-1] + 1) < 0.06

# %% [markdown]
# ## Ranks
#
# Together with this bracket the fields span all three directions, so the car is controllable. In Example 4.1,
# $\dot x_1 = u$, $\dot x_2 = x_1^2$, the brackets span the plane as well, but $x_2$ never decreases: the system is
# accessible and not controllable. The rank condition shows accessibility only.

# %%
for depth, rank in ((0, 2), (1, 3)):
    reach = hjb.geometry.reachability_distribution(None, [forward, turn], origin, depth)
    print(f"the car, brackets of generation {depth}: rank {reach.rank}")
    assert reach.rank == rank

one_way = hjb.zoo.OneWay()
f, g = hjb.geometry.affine_fields(one_way.drift, inputs=1)
print("Example 4.1:", hjb.geometry.reachability_distribution(f, g, jnp.zeros(2), 3).rank)

reachable = hjb.march(
    hjb.reach(one_way.drift, hjb.Box([-1.0], [1.0]), lambda x: jnp.hypot(x[0], x[1]) - 0.1, forward=True),
    hjb.Grid([-1.5, -0.5], [1.5, 1.5], (121, 81)),
    1.2,
    scheme=hjb.Weno5(),  # the set has two thin tips, which a first-order scheme cuts off
)
figure, ax = plt.subplots(figsize=(5.4, 3.6), layout="constrained")
place = np.linspace(-1.2, 1.2, 101)
ax.plot(place, np.abs(place) ** 3 / 3, "--", color="0.4", label="x₂ = |x₁|³/3")
ax.add_patch(plt.Circle((0, 0), 0.1, fill=False, label="start"))
# without the problem, or the disc would be labelled as a target
plotting.zero_level_set(dataclasses.replace(reachable, problem=None), ax=ax, label="reached by t = 1.2")
ax.set_aspect("equal")
ax.set_title("", loc="right")  # no title: the legend gives the time of the set
plt.show()
assert reachable.value_at(0.0, [1.2, 1.2**3 / 3]) < 0  # straight on at full speed
assert reachable.value_at(0.0, [-1.35, 0.8]) > 0  # too far for speed one
assert reachable.value_at(0.0, [0.0, -0.3]) > 0

# %% [markdown]
# ## Observability
#
# Example 4.2, $\dot x = u$ with the output $y = \sin x$. Away from the tops of the sine the output itself
# distinguishes neighbours. At $x = \pi/2$ it does not, because its slope is zero there, but its derivative along $u$
# does: the rank is full with one Lie derivative. The system is locally observable everywhere. It does not distinguish
# states that are a full turn apart: the rank condition for observability is local.

# %%
angle = hjb.zoo.Angle()
f, g = hjb.geometry.affine_fields(angle.drift, inputs=1)
top = [np.pi / 2]
ranks = [hjb.geometry.observability_codistribution(f, g, angle.output, top, depth).rank for depth in (0, 1)]
here, there = (np.asarray(angle.output(np.array([place]))) for place in (0.3, 0.3 + 2 * np.pi))
print(f"ranks at π/2: {ranks}; a turn apart the outputs differ by {np.abs(here - there).max():.1e}")
assert ranks == [0, 1]
assert np.abs(here - there).max() < 1e-6
