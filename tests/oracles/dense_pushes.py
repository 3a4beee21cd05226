"""Random systems with pushes, and their values by linear programming in plain NumPy.

V is the largest function that satisfies V ≤ (L + Σ c V(x + o))/(Q + β) for every action, and V ≤ c h + V(x + h e) for
every push, so it maximises Σ V under these linear constraints.
"""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
from dense_modes import chain_rows
from scipy.optimize import linprog

import hjbjax as hjb


@dataclasses.dataclass(frozen=True)
class Pushed:
    """Linear drift, quadratic cost and pushes at costs that vary with the state, with the numbers of a seed."""

    a: np.ndarray
    b: np.ndarray
    centre: np.ndarray
    spread: np.ndarray
    prices: np.ndarray  # (p, 1 + n): c at x is prices[0] + prices[1:] @ x
    directions: np.ndarray
    discount: float
    actions: np.ndarray
    grid: hjb.Grid


def draw(seed, shape=(9,)):
    rng, n = np.random.default_rng(seed), len(shape)
    axes = [sign * np.eye(n)[axis] for axis in range(n) for sign in (1, -1)]
    # a push earns at one end of the box at most, and there and back always costs something
    prices = np.concatenate([rng.uniform(0.3, 1.0, (2 * n, 1)), rng.uniform(-0.1, 0.1, (2 * n, n))], axis=1)
    prices[1] = -0.8 * prices[0]
    return Pushed(
        rng.normal(size=(n, n)), rng.normal(size=n), rng.uniform(-1, 1, n), rng.uniform(0.1, 0.8, n), prices,
        np.array(axes), rng.uniform(0.2, 1.5), np.sort(rng.uniform(-1, 1, 3)),
        hjb.Grid(-rng.uniform(0.5, 1.0, n), rng.uniform(0.5, 1.0, n), shape),
    )  # fmt: skip


def problem(one, *, noise=True, **others):
    a, b, centre, prices = one.a, one.b, one.centre, one.prices
    pushes = [hjb.Push(e, lambda x, c=c: c[0] + c[1:] @ x) for e, c in zip(one.directions, prices, strict=True)]
    return hjb.Problem(
        lambda x, u: a @ x + b * u[0], lambda x, u: 2 * jnp.sum((x - centre) ** 2) + 0.1 * u[0] ** 2,
        hjb.Finite(one.actions[:, None]), noise=one.spread if noise else None,
        **({"discount": one.discount, "pushes": pushes} | others),
    )  # fmt: skip


def exact(one, *, noise=True):
    """V, and the bounds V(x + h e) + c h by the pushes, (p, *grid), infinite at the ends."""
    axes = [np.asarray(one.grid.axis(axis)) for axis in range(one.grid.ndim)]
    shape = tuple(map(len, axes))
    nodes = list(itertools.product(*map(range, shape)))
    number = {node: k for k, node in enumerate(nodes)}
    place = {node: np.array([axis[i] for axis, i in zip(axes, node, strict=True)]) for node in nodes}
    rows, right, jumps = [], [], []
    for node in nodes:
        x, k = place[node], number[node]
        for u in one.actions:
            row = np.zeros(len(nodes))
            sigma = one.spread if noise else 0 * one.spread
            for there, rate in chain_rows(axes, one.a @ x + one.b * u, sigma**2, node):
                row[k] += rate
                row[number[there]] -= rate
            row[k] += one.discount
            rows.append(row / row[k])
            right.append((2 * np.sum((x - one.centre) ** 2) + 0.1 * u**2) / row[k])
        for p, (e, c) in enumerate(zip(one.directions, one.prices, strict=True)):
            there = tuple(int(i) for i in np.array(node) + e)
            if there in number:
                paid = np.mean([c[0] + c[1:] @ x, c[0] + c[1:] @ place[there]]) * np.sum(np.abs(place[there] - x))
                row = np.zeros(len(nodes))
                row[k], row[number[there]] = 1.0, -1.0
                rows.append(row)
                right.append(paid)
                jumps.append((p, node, there, paid))
    found = linprog(-np.ones(len(nodes)), np.array(rows), right, bounds=(None, None), method="highs-ds")
    value = found.x.reshape(shape)
    after = np.full((len(one.directions), *shape), np.inf)
    for p, node, there, paid in jumps:
        after[(p, *node)] = paid + value[there]
    return value, after
