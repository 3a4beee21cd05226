"""The chain of a controlled diffusion as numbers in NumPy, written anew: an oracle shares no code with the package.

A ``Model`` holds numbers at the S nodes (in C order): drift b + G u + E d, cost q + l·u + s·u² + k·d, covariance a, and
what ends a path. On axis i with h⁺ and h⁻ to the neighbours, f = f_i and α = a_ii − Σ_j |a_ij| h_i/h_j it jumps at

    c⁺ = (e + h⁻ f)/(h⁺ (h⁺ + h⁻)),   c⁻ = (e − h⁺ f)/(h⁻ (h⁺ + h⁻)),   e = max(α, h⁺ f, −h⁻ f),

and along the diagonals of a pair of axes at |a_ij|/(2 h_i h_j) in the two directions that the sign of a_ij picks. At an
end of the axis, with n the drift outwards, it jumps inwards alone, at max(α/h − n, 0)/h: the noise of both directions.
A diagonal jump out of the box ends where a mirror on the end node shows its end.
"""

import dataclasses
import itertools

import numpy as np

EPS = np.finfo(float).eps
UP, DOWN = 0, 1  # the jumps of axis i are numbers 2i + UP and 2i + DOWN


@dataclasses.dataclass(frozen=True)
class Actions:
    """What one player may choose: "none", "finite" (points), "box" (lo, hi) or "ball" (a radius, two inputs or one)."""

    kind: str
    points: np.ndarray = None
    lo: np.ndarray = None
    hi: np.ndarray = None
    radius: float = 0.0
    dim: int = 0

    def nearest(self, u):
        """Points of the set close to ``u``: any point of it is a fair candidate."""
        if self.kind == "box":
            return np.clip(u, self.lo, self.hi)
        length = np.sqrt(np.sum(u * u, axis=-1, keepdims=True))
        return u * np.minimum(1, self.radius / np.where(length > 0, length, 1))


@dataclasses.dataclass(frozen=True)
class Model:
    """A problem as numbers at the nodes; see the head of this file. ``None`` leaves an ingredient out."""

    axes: list  # coordinates along every axis
    periodic: tuple
    b: np.ndarray  # (S, n)
    q: np.ndarray  # (S,)
    controls: Actions
    G: np.ndarray  # (S, n, m)
    l: np.ndarray  # (m,)  # noqa: E741
    s: np.ndarray  # (m,)
    discount: float
    a: np.ndarray = None  # (S, n, n)
    disturbances: Actions = None
    E: np.ndarray = None  # (S, n, k)
    k: np.ndarray = None  # (k,)
    lower: bool = False  # max min in place of min max
    held: np.ndarray = None  # (S,) bool
    given: np.ndarray = None  # (S,), the value there
    stop: np.ndarray = None  # (S,)
    floor: np.ndarray = None  # (S,)
    rest: np.ndarray = None  # (S,) bool, where it costs nothing to stay for ever
    periods: tuple = None  # the length of every periodic axis
    constrained: tuple = ()  # (axis, step) of the sides that no action may cross

    @property
    def shape(self):
        return tuple(len(axis) for axis in self.axes)


class Chain:
    """The jumps of a model: where they lead, and at which rates under given actions."""

    def __init__(self, model):
        self.model, shape, n = model, model.shape, len(model.shape)
        number = np.arange(np.prod(shape)).reshape(shape)
        index = np.indices(shape).reshape(n, -1)
        self.size, self.n = number.size, n
        self.h = np.zeros((n, 2, self.size))
        self.edge = np.zeros((n, 2, self.size), bool)
        for i, nodes in enumerate(model.axes):
            gaps = np.diff(nodes)
            if model.periodic[i]:
                wrap = nodes[0] + model.periods[i] - nodes[-1]
                up, down = np.append(gaps, wrap), np.append(wrap, gaps)
            else:
                up, down = np.append(gaps, gaps[-1]), np.append(gaps[0], gaps)
                self.edge[i, UP], self.edge[i, DOWN] = index[i] == len(nodes) - 1, index[i] == 0
            self.h[i, UP], self.h[i, DOWN] = up[index[i]], down[index[i]]
        self.mean = [(model.periods[i] if p else x[-1] - x[0]) / (len(x) - (0 if p else 1))
                     for i, (x, p) in enumerate(zip(model.axes, model.periodic, strict=True))]  # fmt: skip

        def go(*steps):
            moved = [(index[i] + step) % shape[i] for i, step in enumerate(steps)]
            return number[tuple(moved)]

        def unit(i, step):
            return go(*[step * (j == i) for j in range(n)])

        self.leads = [unit(i, step) for i in range(n) for step in (1, -1)]
        self.fixed = [np.zeros(self.size) for _ in self.leads]  # rates of what slides along an edge
        self.alpha = None if model.a is None else np.stack([model.a[:, i, i] for i in range(n)])
        for i, j in itertools.combinations(range(n), 2) if model.a is not None else ():
            self._diagonals(i, j, index, number)
        if self.alpha is not None:
            self.representable = bool(np.all(self.alpha >= -64 * EPS * np.stack([model.a[:, i, i] for i in range(n)])))
            self.alpha = np.maximum(self.alpha, 0)

    def _diagonals(self, i, j, index, number):
        entry = self.model.a[:, i, j]
        if not np.any(entry):
            return
        self.alpha[i] = self.alpha[i] - np.abs(entry) * self.mean[i] / self.mean[j]
        self.alpha[j] = self.alpha[j] - np.abs(entry) * self.mean[j] / self.mean[i]
        for step_i, step_j in itertools.product((1, -1), repeat=2):
            rate = np.maximum(entry * step_i * step_j, 0) / (2 * self.mean[i] * self.mean[j])
            place = list(index)
            for k, step in ((i, step_i), (j, step_j)):
                last, there = self.model.shape[k] - 1, index[k] + step
                wrapped, mirrored = there % (last + 1), last - np.abs(last - np.abs(there))
                place[k] = wrapped if self.model.periodic[k] else mirrored
            self.leads.append(number[tuple(place)])
            self.fixed.append(rate)

    def drift(self, u, d=None):
        """f (..., S, n) under actions of shape (..., S, m)."""
        f = self.model.b + np.einsum("snm,...sm->...sn", self.model.G, u)
        size = np.abs(self.model.b) + np.einsum("snm,...sm->...sn", np.abs(self.model.G), np.abs(u))
        if d is not None:
            f = f + np.einsum("snm,...sm->...sn", self.model.E, d)
            size = size + np.einsum("snm,...sm->...sn", np.abs(self.model.E), np.abs(d))
        return np.where(np.abs(f) <= 8 * EPS * size, 0, f)  # what cancels is at rest

    def cost(self, u, d=None):
        model = self.model
        total = model.q + u @ model.l + (u * u) @ model.s
        return total if d is None else total + d @ model.k

    def rates(self, f):
        """All jump rates (J, ..., S) for drifts (..., S, n)."""
        found = [np.broadcast_to(rate, f.shape[:-1]) for rate in self.fixed]
        for i in range(self.n):
            up, down, v = self.h[i, UP], self.h[i, DOWN], f[..., i]
            alpha = 0 if self.alpha is None else self.alpha[i]
            e = np.maximum(alpha, np.maximum(up * v, -down * v))
            rise, fall = np.maximum(e + down * v, 0) / (up + down), np.maximum(e - up * v, 0) / (up + down)
            rise = np.where(self.edge[i, DOWN], np.maximum(alpha / up + v, 0), rise)
            fall = np.where(self.edge[i, UP], np.maximum(alpha / down - v, 0), fall)
            found[2 * i + UP] = found[2 * i + UP] + np.where(self.edge[i, UP], 0, rise / up)
            found[2 * i + DOWN] = found[2 * i + DOWN] + np.where(self.edge[i, DOWN], 0, fall / down)
        return np.stack(found)

    def forbidden(self, f):
        """Where an action would leave through a side that no action may cross."""
        bad = np.zeros(f.shape[:-1], bool)
        for i, step in self.model.constrained:
            bad |= self.edge[i, UP if step > 0 else DOWN] & (step * f[..., i] > 0)
        return bad

    def hamiltonian(self, value, u, d=None, slope_only=False):
        """L + Σ c (V(x') − V(x)) for actions (..., S, m); infinite where a jump leads to an infinite value."""
        f = self.drift(u, d)
        rates, total = self.rates(f), self.cost(u, d)
        for lead, rate in zip(self.leads, rates, strict=True):
            with np.errstate(invalid="ignore"):
                total = total + np.where(rate > 0, rate * (value[lead] - value), 0)
        return np.where(self.forbidden(f), np.inf, total)

    def matrix(self, u, d=None):
        """The generator as a dense matrix under one action a node."""
        rates, rows = self.rates(self.drift(u, d)), np.arange(self.size)
        dense = np.zeros((self.size, self.size))
        for lead, rate in zip(self.leads, rates, strict=True):
            np.add.at(dense, (rows, lead), rate)
            np.add.at(dense, (rows, rows), -rate)
        return dense

    def kinks(self, i):
        """Where the Hamiltonian may bend as a function of the i-th component of the drift, (3, S)."""
        none = np.zeros(self.size)
        if self.alpha is None:
            return none[None]
        return np.stack([none, self.alpha[i] / self.h[i, UP], -self.alpha[i] / self.h[i, DOWN]])

    def slopes(self, value, i):
        """What the Hamiltonian may gain per unit of the i-th component: up, down and central differences, (3, S)."""
        value = np.where(np.isfinite(value), value, 0)
        up, down = self.h[i, UP], self.h[i, DOWN]
        rise = np.where(self.edge[i, UP], 0, (value[self.leads[2 * i + UP]] - value) / up)
        fall = np.where(self.edge[i, DOWN], 0, (value - value[self.leads[2 * i + DOWN]]) / down)
        if self.alpha is None:
            return np.stack([rise, fall])
        return np.stack([rise, fall, (down * rise + up * fall) / (up + down)])
