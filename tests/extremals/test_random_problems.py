"""Random smooth problems: no extremal that converged costs less than the value, nor has a conjugate point inside.

On a circle, ẋ = g(x) + u at the cost q(x) + r u², to a free end with a smooth cost or to a given one. Two oracles that
share no code with the boundary-value problem: the value by ``march`` on two grids, whose difference is its error; and
Jacobi's equation along the path, integrated here.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hjbjax as hjb
from hjbjax.problem.pytree import pytree_dataclass

CONVERGED = hjb.Status.CONVERGED
BOUND = 6.0
NODES = 48  # of the coarser circle
STEEP = 60.0  # of the end cost that stands in for a given end: less than it, so that its value is a lower bound


@pytree_dataclass()
class Circle:
    """g = a + b sin x, q = k (1 − cos wx) with k of either sign, and the end cost m (1 − cos(x − c))."""

    a: object
    b: object
    k: object
    w: object
    r: object
    m: object
    c: object

    def drift(self, x, u):
        return self.a + self.b * jnp.sin(x) + u

    def cost(self, x, u):
        return self.k * (1 - jnp.cos(self.w * x[0])) + self.r * (u @ u)

    def end(self, x):
        return self.m * (1 - jnp.cos(x[0] - self.c))

    def problem(self, free=True):
        end = self.end if free else None
        return hjb.Problem(self.drift, self.cost, hjb.Box([-BOUND], [BOUND]), terminal_cost=end)


def draw(seed):
    """A problem, its start, its horizon and whether its end is free."""
    random = np.random.default_rng(seed)
    free = bool(seed % 2)
    numbers = {
        "a": random.uniform(-0.5, 0.5),
        "b": random.uniform(-1, 1),
        "k": random.uniform(-3, 3),
        "w": float(random.integers(1, 3)),
        "r": random.uniform(0.3, 2),
        "m": random.uniform(-2, 4) if free else STEEP,
        "c": random.uniform(-np.pi, np.pi),
    }
    # the start is a node: between nodes a value has the error of its interpolation as well
    return Circle(**numbers), int(random.integers(NODES)), random.uniform(0.5, 3.0), free


def lower_bound(circle, node, horizon):
    """The value at the start, and how far it moves between two grids, anywhere."""
    found = []
    for nodes in (NODES, 2 * NODES):
        grid = hjb.Grid([-np.pi], [np.pi], (nodes,), (True,))
        found.append(
            np.asarray(hjb.march(circle.problem(), grid, horizon, scheme=hjb.Weno5()).value).reshape(-1, nodes)[0]
        )
    return found[1][2 * node], np.max(np.abs(found[1][::2] - found[0]))


def has_conjugate_point(circle, extremal, free):
    """Whether the neighbours X of the path that meet the end cross before the start, by X' and P' of the flow of H."""
    times, x, p = extremal.times, extremal.states[:, 0], extremal.costates[:, 0]

    def flow(t, z):
        at, costate = np.interp(t, times, x), np.interp(t, times, p)
        along = circle.b * np.cos(at)
        bend = circle.k * circle.w**2 * np.cos(circle.w * at) - costate * circle.b * np.sin(at)
        return np.array([along * z[0] - z[1] / (2 * circle.r), -bend * z[0] - along * z[1]])

    end = [1.0, circle.m * np.cos(x[-1] - circle.c)] if free else [0.0, 1.0]
    # a given end is itself a crossing: looked at from a little before it, and up to a little after the start
    path = solve_ivp(flow, (times[-1], 0), end, rtol=1e-8, atol=1e-12, dense_output=True)
    inner = np.linspace(0.995 if not free else 1.0, 0.005, 400) * times[-1]
    neighbours = path.sol(inner)[0]
    return bool(np.any(np.sign(neighbours) != np.sign(neighbours[0])))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is coarse")  # the error is measured
def test_no_extremal_is_below_the_value_or_past_a_conjugate_point():
    first = int.from_bytes(np.random.SeedSequence().entropy.to_bytes(16, "little")[:4], "little")
    print(f"seeds from {first}")
    counts = {"converged": 0, "refused": 0, "best": 0}
    for seed in range(first, first + 100):
        circle, node, horizon, free = draw(seed)
        start = -np.pi + 2 * np.pi * node / NODES
        ends = {} if free else {"terminal": [circle.c]}
        extremal = hjb.pontryagin(circle.problem(free), [start], horizon=horizon, **ends, throw=False)
        if extremal.status is not CONVERGED:
            counts["refused"] += 1
            continue
        counts["converged"] += 1
        if np.max(np.abs(extremal.controls)) < 0.999 * BOUND:
            assert not has_conjugate_point(circle, extremal, free), seed
        value, error = lower_bound(circle, node, horizon)
        assert extremal.cost >= value - 2 * error - 1e-6, (seed, float(extremal.cost), value, error)
        counts["best"] += free and extremal.cost <= value + 2 * error + 1e-6
    print(counts)
    assert counts["converged"] >= 50
