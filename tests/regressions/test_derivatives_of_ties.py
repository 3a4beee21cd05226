"""Derivatives where two interventions are equally good.

In an expensive mode the controller may push first and change the mode then, or the other way round. Both cost the same.
The linear system of the derivative once took the row of one intervention and the right-hand side of the other: with
noise and two random changes of the mode dV/dc was 3.06 instead of 4.06. A march had no derivative in reverse mode.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

GRID, START = hjb.Grid([0.0], [1.0], (6,)), np.array([0.7])


def two_ways(prices, **horizon):
    """A problem with V = c + p x in the expensive mode: change the mode, and push the state to zero."""
    change, push = prices
    return hjb.Problem(
        lambda x, u, mode: 0 * x, lambda x, u, mode: (3.0 * x[0], 100.0)[mode], discount=1.0,
        modes=hjb.Modes(("cheap", "expensive"), switching_cost=change * jnp.array([[0.0, 1.0], [1.0, 0.0]])),
        pushes=[hjb.Push([-1.0], cost=push)], **horizon,
    )  # fmt: skip


def solved(prices):
    return hjb.solve(two_ways(prices), GRID, scheme=hjb.Upwind(), tol=1e-9).value_at(START, mode="expensive")


def marched(prices):
    problem = two_ways(prices, terminal_cost=lambda x, mode: 50.0 * x[0] + 100.0 * mode)
    return hjb.march(problem, GRID, 0.5, scheme=hjb.Upwind(), step=0.1).value_at(0.0, START, mode="expensive")


@pytest.mark.parametrize("value", [solved, pytest.param(marched, marks=pytest.mark.slow)])
def test_order_of_push_and_change_of_mode(value):
    with jax.enable_x64(True):
        program = jax.jit(jax.value_and_grad(value))
        for change, push in ((0.3, 0.7), (0.21, 1.9)):
            found, slopes = program(jnp.array([change, push]))
            np.testing.assert_allclose(found, change + 0.7 * push, rtol=1e-9)
            np.testing.assert_allclose(slopes, [1.0, 0.7], rtol=1e-9)
