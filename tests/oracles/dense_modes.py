"""Policy iteration for switching chains in plain NumPy, with dense matrices and finitely many actions."""

import itertools

import numpy as np


def chain_rows(axes, f, a, node):
    """The jumps of the plain upwind chain from a node: pairs of another node and a rate; noise reflects at the ends."""
    found = []
    for axis, x in enumerate(axes):
        h, i = x[1] - x[0], node[axis]
        for step in (1, -1):
            drift = max(step * f[axis], 0.0) / h
            noise = a[axis] / (2 * h * h)
            inside = 0 <= i + step < len(x)
            if inside:
                there = (*node[:axis], i + step, *node[axis + 1 :])
                found.append((there, drift + noise))
            elif noise > 0:  # the mirror image; drift that leaves is cut off
                found.append(((*node[:axis], i - step, *node[axis + 1 :]), noise))
    return found


def landing_rows(axes, y, node_of, rate):
    """The jumps to the corners of the cell of y, which is moved into the box: pairs of another node and a rate."""
    cells = []
    for x, entry in zip(axes, y, strict=True):
        entry = min(max(entry, x[0]), x[-1])
        k = min(int(np.searchsorted(x, entry, side="right")) - 1, len(x) - 2)
        share = (entry - x[k]) / (x[k + 1] - x[k])
        cells.append([(k, 1 - share), (k + 1, share)])
    for corner in itertools.product(*cells):
        yield node_of(tuple(k for k, _ in corner)), rate * np.prod([share for _, share in corner])


def solve(axes, modes, actions, drift, cost, *, noise=None, rates=None, switching=None, discount=0.0, target=None,
          exit_cost=None, jumps=()):  # fmt: skip
    """V of shape (k, *grid) and the chosen action at every node, −1 − j for a change to mode j.

    ``drift(x, u, i)``, ``cost``, ``noise`` (σ per axis), ``rates`` (k, k) and ``switching`` (k, k) are plain functions;
    ``target(x, i)`` is true where the run ends and pays ``exit_cost(x, i)``. A jump is a triple of ``rate(x, u, i)``,
    ``landing(x, u, i)`` and ``cost(x, u, i)``. The discount is a number or a function of (x, u, i).
    """
    shape = tuple(map(len, axes))
    nodes = [(i, *node) for i in range(modes) for node in itertools.product(*map(range, shape))]
    number = {node: k for k, node in enumerate(nodes)}
    options = []  # for every node the rows (matrix row, right-hand side, name)
    for i, *node in nodes:
        x, k, rows = np.array([axis[j] for axis, j in zip(axes, node, strict=True)]), number[(i, *node)], []
        if target is not None and target(x, i):
            options.append([(np.eye(len(nodes))[k], exit_cost(x, i) if exit_cost else 0.0, 0)])
            continue
        for name, u in enumerate(actions):
            row = np.zeros(len(nodes))
            sigma = np.zeros(len(axes)) if noise is None else np.broadcast_to(noise(x, u, i), len(axes))
            for there, rate in chain_rows(axes, drift(x, u, i), sigma**2, tuple(node)):
                row[k] += rate
                row[number[(i, *there)]] -= rate
            if rates is not None:
                for j, rate in enumerate(rates(x, u)[i]):
                    if j != i:
                        row[k] += rate
                        row[number[(j, *node)]] -= rate
            paid = cost(x, u, i)
            for rate, landing, price in jumps:
                paid += rate(x, u, i) * price(x, u, i)
                row[k] += rate(x, u, i)
                for there, part in landing_rows(axes, landing(x, u, i), lambda node: number[(i, *node)], rate(x, u, i)):  # noqa: B023
                    row[there] -= part
            row[k] += discount(x, u, i) if callable(discount) else discount
            rows.append((row, paid, name))
        if switching is not None:
            for j, paid in enumerate(switching(x)[i]):
                if j != i and np.isfinite(paid):
                    row = np.zeros(len(nodes))
                    row[k], row[number[(j, *node)]] = 1.0, -1.0
                    rows.append((row, paid, -1 - j))
        options.append(rows)
    return _improve(options, (modes, *shape))


def _improve(options, shape):
    chosen = [0] * len(options)
    for _ in range(500):
        matrix = np.array([rows[c][0] for rows, c in zip(options, chosen, strict=True)])
        right = np.array([rows[c][1] for rows, c in zip(options, chosen, strict=True)])
        value, better = np.linalg.solve(matrix, right), list(chosen)
        for k, rows in enumerate(options):
            # relative to the diagonal, so that all rows are in the units of V
            left = [(row @ value - paid) / row[k] for row, paid, _ in rows]
            if max(left) > left[chosen[k]] + 1e-12 * (1 + abs(value[k])):
                better[k] = int(np.argmax(left))
        if better == chosen:
            names = np.array([rows[c][2] for rows, c in zip(options, chosen, strict=True)])
            return value.reshape(shape), names.reshape(shape)
        chosen = better
    raise RuntimeError("policy iteration did not end")
