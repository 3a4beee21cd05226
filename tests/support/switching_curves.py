"""How well a feedback meets a switching curve that is known."""

import numpy as np


def furthest_miss(solution):
    """The largest Euclidean distance, in cells, from the exact switching curve to a node with the wrong force."""
    states, force = solution.grid.nodes().reshape(-1, 2), solution.policy.reshape(-1)
    velocity = np.linspace(-1, 1, 20001)
    curve = np.stack([-0.5 * velocity * np.abs(velocity), velocity], axis=-1)
    side = np.sign(states[:, 0] + 0.5 * states[:, 1] * np.abs(states[:, 1]))
    inside = np.isfinite(force) & (np.max(np.abs(states), axis=1) <= 0.9 + 1e-9) & (side != 0)
    wrong = states[inside & (np.sign(force) != -side)]
    away = [np.min(np.hypot(*(curve - state).T)) for state in wrong]
    return max(away, default=0.0) / float(solution.grid.spacing(0))
