"""Random systems whose state jumps, for the library and for plain NumPy."""

import dataclasses

import dense_modes
import jax.numpy as jnp
import numpy as np
import random_modes

import hjbjax as hjb


@dataclasses.dataclass(frozen=True)
class Jumping:
    """Two jumps of a random system with modes; landings are affine in the state, and may leave the box."""

    base: random_modes.Switching
    rates: np.ndarray  # (2, k)
    slopes: np.ndarray  # of the rates in x₁², (2,)
    matrices: np.ndarray  # (2, n, n)
    shifts: np.ndarray  # (2, n)
    pushes: np.ndarray  # of the landing in u, (2, n)
    prices: np.ndarray  # (2, n)

    @property
    def grid(self):
        return self.base.grid


def draw(seed, shape=(7,), count=1):
    rng, n = np.random.default_rng(1000 + seed), len(shape)
    return Jumping(
        random_modes.draw(seed, shape, count), rng.uniform(0, 2, (2, count)), rng.uniform(0, 1, 2),
        0.7 * rng.normal(size=(2, n, n)), 0.7 * rng.normal(size=(2, n)), 0.5 * rng.normal(size=(2, n)),
        rng.normal(size=(2, n)),
    )  # fmt: skip


def _jumps(one, xp, *, steered):
    """Triples of rate, landing and cost, functions of (x, u, i)."""

    def jump(k):
        # arrays in the closures, not the object, so that all draws share one compiled program
        base, slope, matrix, shift = one.rates[k], one.slopes[k : k + 1], one.matrices[k], one.shifts[k]
        push, price = one.pushes[k], one.prices[k]

        def rate(x, u, i):
            return base[i] + slope[0] * x[0] ** 2 + (0.3 * u**2 if steered else 0.0)

        def landing(x, u, i):
            return matrix @ x + shift * (1 + 0.2 * i) + (push * u if steered else 0.0)

        return rate, landing, lambda x, u, i: xp.sum(price * x)

    return [jump(0), jump(1)]


def problem(one, *, noise=True, steered=False, **others):
    modes, base = one.base.count > 1, one.base
    a, b, weight, centre, spread = base.a, base.b, base.weight, base.centre, base.spread

    def of(function):
        return (lambda x, u, mode: function(x, u[0], mode)) if modes else (lambda x, u: function(x, u[0], 0))

    return hjb.Problem(
        of(lambda x, u, i: a[i] @ x + b[i] * u),
        of(lambda x, u, i: weight[i] * jnp.sum((x - centre[i]) ** 2) + 0.1 * u**2),
        hjb.Finite(base.actions[:, None]),
        noise=of(lambda x, u, i: spread[i] + 0 * x) if noise else None,
        modes=hjb.Modes(random_modes.NAMES[: base.count], rates=base.rates) if modes else None,
        jumps=[hjb.Jump(*map(of, triple)) for triple in _jumps(one, jnp, steered=steered)],
        **({"discount": base.discount} | others),
    )


def exact(one, *, noise=True, steered=False, **others):
    """V by dense policy iteration, (*grid), or (k, *grid) with modes."""
    base = one.base
    rates = (lambda x, u: base.rates) if base.count > 1 else None
    value, _ = dense_modes.solve(
        [np.asarray(one.grid.axis(axis)) for axis in range(one.grid.ndim)], base.count, base.actions,
        lambda x, u, i: base.a[i] @ x + base.b[i] * u,
        lambda x, u, i: base.weight[i] * np.sum((x - base.centre[i]) ** 2) + 0.1 * u**2,
        noise=(lambda x, u, i: base.spread[i]) if noise else None, rates=rates, jumps=_jumps(one, np, steered=steered),
        **({"discount": base.discount} | others),
    )  # fmt: skip
    return value if base.count > 1 else value[0]
