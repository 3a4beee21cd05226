"""Infinite costs of states: no stopping where ψ = ∞, and refusals, on the host and inside transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

GRID = hjb.Grid([-1.0], [1.0], (41,))
HORIZON, STEP, BETA = 0.5, 0.02, 0.8
MARCH = {"scheme": hjb.Upwind(), "method": hjb.Explicit(1), "step": STEP}


def _forbidden(price):
    """Stopping at a price, except in the middle of the box."""
    return lambda x: jnp.where(jnp.abs(x[0]) < 0.5, jnp.inf, 0.3 * price)


def _problem(price=1.0, **others):
    given = {"stopping_cost": _forbidden(price), "terminal_cost": lambda x: x @ x} | others
    return hjb.Problem(lambda x, u: u, lambda x, u: price + 0.1 * u @ u, hjb.Box([-1.0], [1.0]), **given)


def _by_hand(steps, dt, discount=0.0, value=None):
    """V after explicit steps of the upwind chain with the actions −1, 0 and 1, between which no minimum lies."""
    x = np.linspace(-1, 1, 41)
    h, stop = x[1] - x[0], np.where(np.abs(x) < 0.5, np.inf, 0.3)
    value = np.minimum(x**2, stop) if value is None else value
    for _ in range(steps):
        up, down = np.append(value[1:], value[-1]), np.append(value[0], value[:-1])
        slopes = np.stack([(down - value) / h, (up - value) / h])
        # 1 + u²/10 + |u| min(slopes) over |u| ≤ 1
        p = np.minimum(np.min(slopes, axis=0), 0)
        u = np.minimum(-p / 0.2, 1)
        value = np.minimum(value + dt * (1 + 0.1 * u**2 + u * p - discount * value), stop)
    return value


@pytest.mark.slow
def test_no_stopping_in_a_march():
    """The host, ``jit`` and ``vmap`` march alike, and like a scheme written by hand."""
    exact = _by_hand(25, STEP)
    assert np.max(exact) > 0.45
    np.testing.assert_allclose(hjb.march(_problem(), GRID, HORIZON, **MARCH).value[0], exact, atol=1e-12)

    def value(price):
        return hjb.march(_problem(price), GRID, HORIZON, **MARCH).value[0]

    with jax.enable_x64(True):
        np.testing.assert_allclose(jax.jit(value)(1.0), exact, atol=1e-12)
        np.testing.assert_allclose(jax.vmap(value)(jnp.ones(2)), [exact, exact], atol=1e-12)


@pytest.mark.slow
def test_no_stopping_in_a_solve():
    exact = _by_hand(4000, 0.02, BETA, np.zeros(41))
    given = {"terminal_cost": None, "discount": BETA}

    def value(price):
        return hjb.solve(_problem(price, **given), GRID, scheme=hjb.Upwind(), tol=1e-9).value

    for found in (value(1.0), hjb.solve_batch([_problem(**given)] * 2, GRID, scheme=hjb.Upwind(), tol=1e-9)[1].value):
        np.testing.assert_allclose(found, exact, atol=1e-8)
    with jax.enable_x64(True):
        np.testing.assert_allclose(jax.vmap(value)(jnp.ones(2))[1], exact, atol=1e-8)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"terminal_cost": None}, r"stopping_cost\(x\) is NaN or infinite at 19 of 41"),
        ({"terminal_cost": None, "discount": 0.3}, "V is NaN or infinite at 19 of 41 nodes at the horizon"),
        ({"terminal_cost": lambda x: jnp.where(x[0] > 0.52, jnp.inf, 0.0)}, r"terminal_cost\(x\) is NaN or infinite"),
        ({"stopping_cost": lambda x: jnp.where(x[0] > 0.52, -jnp.inf, 1.0)}, r"stopping_cost\(x\) is NaN or infinite"),
    ],
)
def test_refused_costs_are_nan_inside_a_transformation(changes, reason):
    with pytest.raises(ValueError, match=reason):
        hjb.march(_problem(**changes), GRID, HORIZON, **MARCH)
    found = jax.vmap(lambda price: hjb.march(_problem(price, **changes), GRID, HORIZON, **MARCH).value)(jnp.ones(2))
    assert np.all(np.isnan(found))
