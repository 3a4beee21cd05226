"""Random problems on a line and their dense solution, which shares no code with the package.

    min_u [ q(x) + w u² + (a(x) + b(x) u) V' + ½ s² V'' ] = β(x) V,    lo(x) ≤ u ≤ hi(x),

by first-order upwinding and Howard's iteration with dense linear algebra. Drift out of the box is zero, noise reflects.
"""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Line:
    """Numbers of one random problem; a function is a pair (c₀, c₁) of c₀ + c₁ sin(x), or c₀ exp(c₁ sin x)."""

    a: np.ndarray
    b: np.ndarray
    q: np.ndarray
    w: float
    s: float
    beta: np.ndarray
    lo: np.ndarray
    hi: np.ndarray


def wave(c, x, xp=np):
    return c[0] + c[1] * xp.sin(x)


def positive(c, x, xp=np):
    return c[0] * xp.exp(c[1] * xp.sin(x))


def draw(seed):
    rng = np.random.default_rng(seed)
    return Line(
        rng.normal(size=2), rng.normal(size=2) + np.array([1.5, 0]), rng.normal(size=2),
        rng.uniform(0.2, 1), rng.uniform(0.1, 1),
        np.array([rng.uniform(0.05, 2), rng.normal()]), np.array([-rng.uniform(0.5, 2), rng.uniform(-0.4, 0.4)]),
        np.array([rng.uniform(0.5, 2), rng.uniform(-0.4, 0.4)]),
    )  # fmt: skip


def dense(line, nodes, lo=None, hi=None, beta=None):
    """The value of the chain and its policy at equally spaced nodes; bounds and β at the nodes, or from the line."""
    a, b, q = (wave(c, nodes) for c in (line.a, line.b, line.q))
    lo = wave(line.lo, nodes) if lo is None else lo
    hi = wave(line.hi, nodes) if hi is None else hi
    beta = positive(line.beta, nodes) if beta is None else beta
    lo, hi, beta = (np.broadcast_to(each, nodes.shape) for each in (lo, hi, beta))
    h, n = nodes[1] - nodes[0], len(nodes)
    value, u = np.zeros(n), np.clip(0, lo, hi)
    for _ in range(200):
        value = np.linalg.solve(np.diag(beta) - generator(a + b * u, line.s, h), q + line.w * u**2)
        up, down = np.append(np.diff(value), 0) / h, np.append(0, np.diff(value)) / h
        # the stationary points on either side of the kink where the drift vanishes, the kink, and the ends
        tried = np.stack([u, lo, hi, -a / b, -b * up / (2 * line.w), -b * down / (2 * line.w), 0 * u])
        tried = np.clip(tried, lo, hi)
        drift = a + b * tried
        gains = line.w * tried**2 + np.maximum(drift, 0) * up + np.minimum(drift, 0) * down
        best = np.take_along_axis(tried, np.argmin(gains, axis=0)[None], axis=0)[0]
        gain = gains[0] - np.min(gains, axis=0)
        if np.max(gain) <= 1e-13 * (1 + np.max(np.abs(value)) / h):
            return value, u
        u = best
    raise AssertionError("Howard's iteration did not end")


def generator(drift, s, h):
    """The generator of the chain with this drift, (n, n)."""
    n, spread = len(drift), s**2 / 2 / h**2
    matrix = np.zeros((n, n))
    for i, f in enumerate(drift):
        for step, push in ((1, max(f, 0) / h), (-1, max(-f, 0) / h)):
            inside = 0 <= i + step < n
            matrix[i, i + step if inside else i - step] += spread + (push if inside else 0)
            matrix[i, i] -= spread + (push if inside else 0)
    return matrix
