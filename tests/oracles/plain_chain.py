"""The chain on a box with projected or constrained ends in plain NumPy: actions are enumerated, node by node.

Nothing here is shared with the package: nodes are arrays of coordinates, actions a list, rates are written out.
"""

import itertools

import numpy as np

LEAST = 1e-9  # of drift, below which nothing leaves


def tables(axes, drift, cost, actions, sigma, constrained):
    """Rates (S, K, 2n), costs (S, K), neighbours (S, 2n) and which actions are admissible (S, K).

    Args:
      axes: for each axis the coordinates of its nodes.
      drift: (x, u) -> (n,), of NumPy vectors.
      cost: (x, u) -> a number.
      actions: for a state the actions to try, (K, m); as many at every node.
      sigma: noise, a number an axis.
      constrained: pairs (axis, −1 or 1) of ends across which no action may lead.
    """
    shape, n = tuple(len(axis) for axis in axes), len(axes)
    number = np.arange(np.prod(shape)).reshape(shape)
    count = len(actions(np.array([axis[0] for axis in axes])))
    rates, costs = np.zeros((number.size, count, 2 * n)), np.zeros((number.size, count))
    neighbours, admissible = np.zeros((number.size, 2 * n), int), np.ones((number.size, count), bool)
    for index in itertools.product(*map(range, shape)):
        row, x = number[index], np.array([axis[i] for axis, i in zip(axes, index, strict=True)])
        tried = actions(x)
        f = np.array([drift(x, u) for u in tried])
        costs[row] = [cost(x, u) for u in tried]
        for i in range(n):
            gaps = np.diff(axes[i])
            up, down = gaps[min(index[i], len(gaps) - 1)], gaps[max(index[i] - 1, 0)]
            for side, (step, gap) in enumerate(((1, up), (-1, down))):
                outward = np.maximum(step * f[:, i], 0)
                at_end = index[i] == (shape[i] - 1 if step > 0 else 0)
                neighbours[row, 2 * i + side] = row
                if at_end:
                    admissible[row] &= (outward <= LEAST) | ((i, step) not in constrained)
                    continue
                there = list(index)
                there[i] += step
                neighbours[row, 2 * i + side] = number[tuple(there)]
                # at the other end all noise goes this way, over half a cell
                cell = gap if index[i] == (0 if step > 0 else shape[i] - 1) else up + down
                rates[row, :, 2 * i + side] = outward / gap + sigma[i] ** 2 / (gap * cell)
    return rates, costs, neighbours, admissible


def solved(rates, costs, neighbours, admissible, discount):
    """V_h by Howard's policy iteration with dense solves, (S,), and the numbers of the actions."""
    nodes = np.arange(len(costs))
    policy = np.argmax(admissible, axis=1)
    for _ in range(200):
        c = rates[nodes, policy]
        matrix = np.diag(discount + c.sum(axis=1))
        np.add.at(matrix, (nodes[:, None], neighbours), -c)
        value = np.linalg.solve(matrix, costs[nodes, policy])
        h = hamiltonians(rates, costs, neighbours, admissible, value)
        best = np.argmin(h, axis=1)
        gain = h[nodes, policy] - h[nodes, best]
        if np.all(gain <= 1e-11 * (1 + np.abs(h[nodes, best]))):
            return value, policy
        policy = np.where(gain > 1e-12 * (1 + np.abs(h[nodes, best])), best, policy)
    raise AssertionError("the oracle's policy iteration went on for 200 steps")


def hamiltonians(rates, costs, neighbours, admissible, value):
    """L + 𝓛V for every node and action, (S, K); infinite where the action is not admissible."""
    jumps = value[neighbours][:, None, :] - value[:, None, None]
    return np.where(admissible, costs + np.sum(rates * jumps, axis=-1), np.inf)
