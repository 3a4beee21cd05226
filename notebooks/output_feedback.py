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
# # Output feedback
#
# The state $x$ is not measured. The measurement is
#
# $$dy = h(x)\,dt + r\,dv,$$
#
# and the control is a function of an *information state*, which an observer computes from the record. Section 12 of the
# chapter has three information states, in the loops of its figures 13 to 15: the estimate of an observer (12.3), the
# law of the state given the record (12.6), and the robust information state (12.10).

# %%
import warnings

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.linalg import expm

import hjbjax as hjb
from hjbjax import filtering, plotting

warnings.simplefilter("ignore", hjb.SolveWarning)  # coarse grids are accurate enough here

# %% [markdown]
# ## Figure 13: an estimate in the loop
#
# ```text
#        +-------+   x   +--------+   y
#   +--->| plant |------>| sensor |------+
#   |    +-------+       +--------+      |
#   | u                                  v
#   |    +----------+    x̂     +----------+
#   +----|  u*(x̂)   |<----------| observer |
#        +----------+           +----------+
# ```
#
# The simplest observer is Luenberger's (12.3), a copy of the plant that is corrected by the measurement error. The
# control (12.4) is the optimal feedback at the estimate. For a mass of which only the position is measured, the error
# obeys $\dot e = (A - GC)e$, whatever the control is; the gain places its poles at −2 and −3.


# %%
def mass(x, u):
    return jnp.stack([x[1], u[0]])


def position(x):
    return x[:1]


free = hjb.Problem(mass, controls=hjb.Box([-8.0], [8.0]))
luenberger = filtering.Luenberger(free, position, [[5.0], [6.0]], [0.0, 0.0])
held = filtering.simulate_output(
    free,
    luenberger,
    lambda x: -x[:1] - np.sqrt(3) * x[1:],
    h=position,
    x0=[1.0, 0.5],
    duration=6.0,
    dt=0.05,
    key=0,
    measurement_noise=0.0,
)
error = held.estimates - held.states
expected = np.array([expm(np.array([[-5.0, 1.0], [-6.0, 0.0]]) * t) @ error[0] for t in held.times])
print(f"the error follows the linear system up to {np.abs(error - expected).max():.1e}")
assert np.abs(error - expected).max() < 0.01
assert np.abs(held.states[-1]).max() < 0.1

# %% [markdown]
# ## A pendulum that is seen by an encoder
#
# Only the angle of a pendulum is measured. The torque is at most 0.7 times the largest torque of gravity, so the
# pendulum has to be swung up. The value function is computed as if the state were known, and an extended Kalman filter
# estimates the state. The loop consists of plant, sensor, observer, and the optimal feedback at the estimate.


# %%
def pendulum(x, u):  # the angle from upright, and its rate
    return jnp.stack([x[1], jnp.sin(x[0]) + u[0]])


def effort(x, u):
    return 2 * (1 - jnp.cos(x[0])) + 0.5 * x[1] ** 2 + 0.1 * u[0] ** 2


def angle(x):  # the measurement of an encoder
    return jnp.stack([jnp.sin(x[0]), jnp.cos(x[0])])


plant = hjb.Problem(pendulum, effort, hjb.Box([-0.7], [0.7]), discount=0.05, noise=[0.0, 0.05])
grid = hjb.Grid([-np.pi, -3.5], [np.pi, 3.5], (80, 81), periodic=(True, False), names=("angle", "rate"))
solution = hjb.solve(plant, grid, tol=1e-2)
observer = filtering.ExtendedKalman(plant, angle, [np.pi, 0.0], [0.1, 0.05], measurement_noise=0.03)
path = filtering.simulate_output(
    plant, observer, solution,
    h=angle, x0=[np.deg2rad(170), 0.2], duration=20.0, dt=0.05, key=1, measurement_noise=0.03, substeps=2,
)  # fmt: skip
figure, ax = plt.subplots(figsize=(8, 3), layout="constrained")
plotting.estimates(path, grid=grid, ax=ax)
plt.show()

# %% [markdown]
# The pendulum ends upright, and the error of the estimated angle stays within a few degrees.

# %%
assert np.all(np.cos(path.states[path.times > 17, 0]) > 0.95)
assert np.max(np.abs(np.sin(path.estimates[50:, 0] - path.states[50:, 0]))) < 0.3

# %% [markdown]
# ## Figure 14: the law of the state
#
# ```text
#        +-------+   x   +--------+   y
#   +--->| plant |------>| sensor |------+
#   |    +-------+       +--------+      |
#   | u                                  v
#   |    +----------+    σ     +-------------------+
#   +----|   u(σ)   |<---------| law of the state  |
#        +----------+          | given the record  |
#                              +-------------------+
# ```
#
# If the sensor measures $x^2$, two states fit every record. A Kalman filter follows one of them. The law on a grid,
# from the Duncan–Mortensen–Zakai equation (12.6), contains both until the drift distinguishes them.

# %%
line = hjb.Grid([-3.0], [3.0], (241,))
walk = hjb.Problem(lambda x, u: 0.4 - 0.2 * x, noise=0.4)
blind = filtering.simulate_output(
    walk, filtering.ExtendedKalman(walk, lambda x: x**2, [-1.0], [0.5], measurement_noise=0.2), None,
    h=lambda x: x**2, x0=[-1.2], duration=6.0, dt=0.05, key=5, measurement_noise=0.2,
)  # fmt: skip
law = filtering.zakai(
    walk, lambda x: x**2, line, blind.measurements, 0.05, lambda x: jnp.exp(-x @ x / 2), measurement_noise=0.2
)
figure, ax = plt.subplots(figsize=(8, 3), layout="constrained")
ax.pcolormesh(blind.times[1:], line.axis(0), np.sqrt(law.density.T), cmap="Greys", shading="nearest")
ax.plot(blind.times, blind.states[:, 0], color=plotting.COLOURS[0], label="state")
ax.plot(blind.times, blind.estimates[:, 0], "--", color=plotting.COLOURS[1], label="extended Kalman filter")
ax.set(xlabel="t", ylabel="x")
ax.legend(loc="lower right", title="grey: the law on the grid", frameon=False)
plt.show()
mass = law.density @ line.volumes()
assert np.max(np.abs(mass - 1)) < 1e-10
assert law.density.min() >= 0

# %% [markdown]
# ## Figure 15: the robust information state and its gain
#
# ```text
#    w   +-------+   x   +--------+   y
#  ----->| plant |------>| sensor |<----- v
#   +--->|       |       +--------+------+
#   | u  +-------+                       v
#   |    +-------------+    p    +------------------+
#   +----| u*(x̄), where |<--------| worst cost so far |
#        | p + V is max |         |  given the record |
#        +-------------+         +------------------+
# ```
#
# For $\dot x = x + u + w$, $y = 2x + v$ with cost $\tfrac12\int x^2 + u^2$, the Kalman filter with the regulator's gain
# is optimal for white noise. The minimum-stress controller acts as if the state were the maximiser of $p + V$, where
# $p$ is the robust information state for $\gamma = 2.5$ and $V$ the value of the game. It guarantees
# $\int |z|^2 \le \gamma^2 \int |w|^2 + |v|^2$ for all disturbances. The third controller minimises the Hamiltonian
# averaged over the law of the state.
#
# The largest gain of a loop is the largest singular value of its response to unit disturbances in each interval.

# %%
gamma, noise, dt, steps = 2.5, 0.3, 0.1, 60
box = hjb.Grid([-4.0], [4.0], (81,))


def tank(noise=None):
    return hjb.Problem(lambda x, u: x + u, lambda x, u: 0.5 * (x @ x + u @ u), hjb.Box([-30.0], [30.0]), noise=noise)


def sensor(x):
    return 2 * x


regulator = 1 + np.sqrt(2)
kalman = filtering.ExtendedKalman(tank(noise), sensor, [0.0], [0.5 * noise**2], measurement_noise=noise)
robust = filtering.RobustGridFilter(tank(), sensor, box, lambda x: -(gamma**2) * x @ x, gamma)
lawful = filtering.GridFilter(tank(noise), sensor, box, lambda x: jnp.exp(-x @ x / noise**2), measurement_noise=noise)
game = hjb.march(hjb.attenuation(tank(), gamma, hjb.Box([-8.0], [8.0])), box, 6.0, scheme=hjb.Weno5())
x = box.axis(0)
known = hjb.Solution(box, regulator / 2 * x**2, -regulator * x[:, None])
controllers = {
    "certainty equivalence": (kalman, filtering.certainty_equivalence(kalman, lambda x: -regulator * x)),
    "averaged Hamiltonian": (lawful, filtering.averaged_hamiltonian(tank(noise), known, lawful)),
    "minimum stress": (robust, filtering.minimum_stress(robust, game)),
}


def response(observer, control, disturbances):
    """√dt (x, u) of the loop under x₀, w and v, shape (1 + 2 steps,), each over its price."""
    start, (w, v), grow = disturbances[0] * np.sqrt(0.5), disturbances[1:].reshape(2, -1) / np.sqrt(dt), np.exp(dt)

    def step(carry, row):
        x, state = carry
        u = control(state)[0]
        push = u + row[0]
        moved = grow * x + (grow - 1) * push
        seen = 2 * (moved - x - push * dt) / dt + row[1]  # the mean of y over the interval
        return (moved, observer.update(state, u[None], seen[None] * dt, dt)), jnp.stack([x, u])

    (_, _), rows = jax.lax.scan(step, (start, observer.initial()), jnp.stack([w, v], axis=1))
    return np.sqrt(dt) * rows.ravel()


figures = {}
for name, (observer, control) in controllers.items():
    paths = filtering.simulate_output(
        tank(noise), observer, control, h=sensor, x0=[0.2], duration=6.0, dt=dt, key=0, paths=300,
        measurement_noise=noise,
    )  # fmt: skip
    with jax.enable_x64(True):
        size = 0.3  # of a disturbance: the loops are linear up to the grid's error, and stay in the box
        columns = jax.lax.map(
            lambda row, parts=(observer, control): response(*parts, row), size * jnp.eye(1 + 2 * steps), batch_size=32
        )
    gain = np.linalg.svd(np.asarray(columns).T / size, compute_uv=False)[0]
    figures[name] = paths.cost.mean(), paths.cost.std() / np.sqrt(300), gain
    print(f"{name:22} mean cost {figures[name][0]:.3f} ± {figures[name][1]:.3f}, largest gain {gain:.2f}")

# %% [markdown]
# Each controller is best at its own criterion: the first two have the lowest mean cost, and only the third keeps the
# gain below 2.5. One path of the third: the state, and the worst state that fits the record.

# %%
figure, ax = plt.subplots(figsize=(8, 3), layout="constrained")
plotting.estimates(jax.tree.map(lambda entry: entry[0], paths), ax=ax, names=("x",))
plt.show()
cost = {name: row[0] for name, row in figures.items()}
gains = {name: row[2] for name, row in figures.items()}
assert gains["minimum stress"] < gamma < gains["certainty equivalence"]
assert cost["certainty equivalence"] < cost["minimum stress"]
assert abs(cost["averaged Hamiltonian"] - cost["certainty equivalence"]) < 0.05 * cost["certainty equivalence"]

# %% [markdown]
# ## Two hidden states: dual control
#
# A machine either works or is broken, and fails at the rate 0.3. Its sound is a noisy measurement of its state. A
# repair runs at the rate $u$ and costs even if nothing is broken. The belief $\pi$ that the machine works is a
# diffusion, and its control is a stationary problem with degenerate noise. A better sensor lowers the value. With
# perfect measurement of the state the value is the straight line below all curves.


# %%
def repaired(u):
    return jnp.stack([jnp.stack([-0.3, 0.3]), jnp.stack([u[0], -u[0]])])


def price(u):  # per unit time, for the states 'works' and 'broken'
    return jnp.stack([2 * u[0], 2.0 + u[0]])


figure, ax = plt.subplots(figsize=(5, 3.5), layout="constrained")
values = {}
for r, colour in zip((4.0, 1.0, 0.3), plotting.COLOURS, strict=False):
    machine = filtering.belief_problem(
        repaired, [1.0, -1.0], price, controls=hjb.Finite([[0.0], [2.0]]), discount=0.3, measurement_noise=r
    )
    belief = hjb.solve(machine.problem, machine.grid, tol=1e-6)
    values[r] = belief.value
    ax.plot(machine.grid.axis(0), belief.value, color=colour, label=f"r = {r:g}")
ax.set(xlabel="belief that it works", ylabel="cost")
ax.legend(frameon=False)
plt.show()
for value in values.values():
    assert np.max(np.diff(value, 2)) < 1e-6  # concave
assert np.all(values[0.3] <= values[1.0] + 1e-6)
assert np.all(values[1.0] <= values[4.0] + 1e-6)
