"""Random systems that switch between modes, for the library and for plain NumPy."""

import dataclasses

import dense_modes
import jax.numpy as jnp
import numpy as np

import hjbjax as hjb

NAMES = ("low", "middle", "high", "highest")
CHAIN = hjb.Upwind(central=False)
METHODS = (
    hjb.ValueIteration(), hjb.PolicyIteration(hjb.Direct()), hjb.PolicyIteration(hjb.Krylov()),
    hjb.PolicyIteration(hjb.Sweeps()), hjb.Nested(coarsest=10),
)  # fmt: skip


def assert_certified(found, exact, seed):
    """The exact value is within the certified bounds, up to rounding."""
    lower, upper = found.bounds
    slack = 1e-11 * (1 + np.max(np.abs(exact)))
    assert np.all(lower - slack <= exact), seed
    assert np.all(exact <= upper + slack), seed


@dataclasses.dataclass(frozen=True)
class Switching:
    """Linear drift and quadratic cost in every mode, with the numbers of a seed."""

    a: np.ndarray
    b: np.ndarray
    weight: np.ndarray
    centre: np.ndarray
    spread: np.ndarray
    rates: np.ndarray
    steered: np.ndarray  # rates per u², in addition
    costs: np.ndarray
    discount: float
    actions: np.ndarray
    grid: hjb.Grid

    @property
    def count(self):
        return len(self.a)


def draw(seed, shape=(7,), count=2):
    rng, n = np.random.default_rng(seed), len(shape)
    costs = rng.uniform(0.05, 1.5, (count, count))
    costs[rng.random((count, count)) < 0.3] = np.inf
    return Switching(
        rng.normal(size=(count, n, n)), rng.normal(size=(count, n)), rng.uniform(0.2, 2, count),
        rng.normal(size=(count, n)), rng.uniform(0.05, 0.8, (count, n)),
        rng.uniform(0, 3, (count, count)) * (rng.random((count, count)) < 0.8), rng.uniform(0, 1, (count, count)),
        costs, rng.uniform(0.1, 1.5), np.sort(rng.uniform(-1, 1, 3)),
        hjb.Grid(-rng.uniform(0.5, 2, n), rng.uniform(0.5, 2, n), shape),
    )  # fmt: skip


def problem(one, *, noise=True, rates=True, steered=False, switching=True, **others):
    a, b, weight, centre, spread = one.a, one.b, one.weight, one.centre, one.spread
    table, more = one.rates, one.steered
    modes = hjb.Modes(
        NAMES[: one.count],
        rates=(lambda x, u: table + more * u[0] ** 2) if steered else one.rates if rates else None,
        switching_cost=one.costs if switching else None,
    )
    return hjb.Problem(
        lambda x, u, mode: a[mode] @ x + b[mode] * u[0],
        lambda x, u, mode: weight[mode] * jnp.sum((x - centre[mode]) ** 2) + 0.1 * u[0] ** 2,
        hjb.Finite(one.actions[:, None]),
        noise=(lambda x, u, mode: spread[mode] + 0 * x) if noise else None,
        modes=modes,
        **({"discount": one.discount} | others),
    )


def exact(one, *, noise=True, rates=True, steered=False, switching=True, **others):
    """V and the choices by dense policy iteration."""
    table = (lambda x, u: one.rates + one.steered * u**2) if steered else (lambda x, u: one.rates) if rates else None
    return dense_modes.solve(
        [np.asarray(one.grid.axis(axis)) for axis in range(one.grid.ndim)], one.count, one.actions,
        lambda x, u, i: one.a[i] @ x + one.b[i] * u,
        lambda x, u, i: one.weight[i] * np.sum((x - one.centre[i]) ** 2) + 0.1 * u**2,
        noise=(lambda x, u, i: one.spread[i]) if noise else None, rates=table,
        switching=(lambda x: one.costs) if switching else None, **({"discount": one.discount} | others),
    )  # fmt: skip
