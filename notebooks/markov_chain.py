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
# # The chain on the grid
#
# Section 13 of the chapter: a particle that jumps between the nodes of a grid replaces the state. It jumps to
# neighbours with the probabilities (13.3), so that it moves on average as the system does. The value of the chain
# converges to the value of the system, even if that has kinks.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Image
from matplotlib.animation import FuncAnimation

import hjbjax as hjb
from hjbjax import plotting

# %% [markdown]
# ## Figure 16: the particle
#
# A mass is brought to rest in the least time. The generator of the optimal chain is a matrix. A particle starts at rest
# at one; its exponential waiting times and its jumps are drawn at random.

# %%
count = 41
problem, grid = hjb.zoo.double_integrator(shape=(count, count), radius=0.2)
solution = hjb.solve(problem, grid, scheme=hjb.Upwind(), tol=1e-6)
matrix = hjb.chain.generator(problem, grid, solution.policy).tocsr()
rows = np.asarray(matrix.sum(axis=1)).ravel()
print(f"rows of the generator sum to {np.abs(rows).max():.1e} at most")
assert np.abs(rows).max() < 1e-9 * abs(matrix.diagonal()).max()

random = np.random.default_rng(0)
node, t = np.ravel_multi_index((3 * (count - 1) // 4, (count - 1) // 2), grid.shape), 0.0
visited, clock = [node], [t]
states = grid.nodes().reshape(-1, 2)
while np.linalg.norm(states[node]) > 0.2 and len(visited) < 400:
    row = matrix[[node]]  # a matrix with one row
    jumps = row.indices != node
    targets, rates = row.indices[jumps], row.data[jumps]
    t += random.exponential(1 / rates.sum())
    node = random.choice(targets, p=rates / rates.sum())
    visited.append(node)
    clock.append(t)
places = states[visited]
print(f"{len(places) - 1} jumps in a time of {t:.2f}; the least time is about 2")
assert np.linalg.norm(places[-1]) <= 0.2
assert np.abs(np.diff(places, axis=0)).max() < 0.1 + 1e-9  # only to neighbours

figure, ax = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
plotting.value(solution, ax=ax)
ax.plot(*states.T, ".", color="white", markersize=0.8, alpha=0.5)
(line,) = ax.plot(*places.T, color=plotting.COLOURS[1], linewidth=1)
(dot,) = ax.plot(*places[-1:].T, "o", color=plotting.COLOURS[1])
plt.show()

# %% [markdown]
# The same particle as an animation:


# %%
def frame(k):
    line.set_data(*places[: k + 1].T)
    dot.set_data(*places[k : k + 1].T)
    return line, dot


moving = FuncAnimation(figure, frame, frames=np.linspace(0, len(places) - 1, 41).astype(int), interval=120)
with tempfile.TemporaryDirectory() as folder:
    moving.save(f"{folder}/particle.webp", writer="pillow", dpi=80)
    film = Path(f"{folder}/particle.webp").read_bytes()
Image(film, format="webp")

# %% [markdown]
# ## Complexity
#
# With $n$ states and $N$ nodes per axis a grid has $N^n$ nodes. Halving the spacing multiplies the number of nodes by
# $2^n$ and halves the error of the monotone chain. This is the curse of dimensionality. A value iteration that also
# samples $m$ inputs needs $O(1/\varepsilon^{2n+m})$ operations for the error $\varepsilon$. Policy iteration with the
# exact minimum needs fewer: the work per node hardly depends on the grid. The table fits the exponent.

# %%
rows = []
for nodes in (21, 41, 81):
    problem, fine = hjb.zoo.smooth(shape=(nodes, nodes))
    found = hjb.solve(problem, fine, scheme=hjb.Upwind(), tol=1e-8)
    exact = hjb.zoo.smooth_exact()
    places = ([0.5, 0.25], [-0.5, 0.5], [0.25, -0.75])
    error = max(abs(float(found.value_at(x)) - float(exact(np.array(x)))) for x in places)
    rows.append((error, fine.size * found.steps))
    print(f"{nodes:3} nodes per axis, {fine.size:5} in all: error {error:.1e}, {rows[-1][1]:7,} visits of a node")
power = np.polyfit(np.log([1 / error for error, _ in rows]), np.log([work for _, work in rows]), 1)[0]
print(f"work grows like 1/error to the power {power:.1f}; the bound for n = 2, m = 1 is 5")
assert rows[2][0] < 0.6 * rows[1][0] < 0.4 * rows[0][0]
assert power < 5

# %% [markdown]
# The same error in other dimensions takes the following numbers of nodes, for a spacing $h$ with $1/h$ nodes per axis.
# An information state $\sigma$ is a function on the grid. A table of $V(\sigma)$ that resolves its values at all
# $1/h^n$ nodes with $1/h$ values each has $(1/h)^{1/h^n}$ entries, which exceeds any memory for $n = 1$ and ten nodes
# per axis. This is why output feedback above uses $V(x)$ of the known state, and $V(\sigma)$ only for two or three
# hidden states, where $\sigma$ has one or two numbers.

# %%
for n in (1, 2, 3, 4):
    for count in (4, 10):
        digits = count**n * np.log10(count)
        print(f"n = {n}, 1/h = {count:2}: {count**n:6,} nodes for V(x), a number of {digits:,.0f} digits for V(σ)")
