"""The order by which two grids estimate the error, on node values in closed form; and at a target of one node."""

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import Grid
from hjbjax.solution import nested_grids

FINE, COARSE = Grid([-1.0] * 2, [1.0] * 2, (41, 41)), Grid([-1.0] * 2, [1.0] * 2, (21, 21))
X = np.stack(np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41), indexing="ij"), -1)
H = 0.05
SMOOTH = np.cos(X[..., 0]) * np.sin(X[..., 1] + 1)
STEADY, SIDES = np.ones((41, 41, 1)), np.where(X[..., :1] + X[..., 1:] > 0.01, 1.0, -1.0)


def change(value, before):
    return nested_grids.apart(value[::2, ::2], before)


def order_of(value, before, chain, policy):
    return nested_grids.order_of_slopes(FINE, COARSE, change(value, before), nested_grids.apart(value, chain), policy)


def answers(error, of_chain):
    """V_h, V_2h with four times the error, and the chain's answer, on the values of ``SMOOTH``."""
    return (SMOOTH + error, (SMOOTH + 4 * error)[::2, ::2]), SMOOTH + of_chain


@pytest.mark.parametrize(("order", "share"), [(1, 0.47), (2, 1.41)])
def test_the_usual_order_is_between_those_of_kinks_and_of_smooth_values(order, share):
    error = H**order * (1 + X[..., 0] ** 2) / 10
    value, before = SMOOTH + error, (SMOOTH + 2**order * error)[::2, ::2]
    found = nested_grids.estimated_error(FINE, COARSE, change(value, before), nested_grids.USUAL)
    np.testing.assert_allclose(found[::2, ::2], share * error[::2, ::2], rtol=0.01)


@pytest.mark.parametrize(
    ("policy", "gain", "broken"), [(SIDES, 1.0, True), (STEADY, 1.0, False), (SIDES, 10.0, False), (SIDES, 0.0, False)]
)
def test_where_slopes_gain_nothing_and_the_policy_jumps_the_order_is_that_of_a_root(policy, gain, broken):
    error = 0.1 * np.abs(X[..., 0])
    (value, before), chain = answers(error, error + gain * 3 * error)
    order = order_of(value, before, chain, policy)
    assert order == (nested_grids.BROKEN if broken else nested_grids.USUAL)


@pytest.mark.parametrize("policy", [None, np.full((41, 41, 1), np.nan), np.zeros((41, 41, 0))])
def test_no_policy_jumps_nowhere(policy):
    error = 0.1 * np.abs(X[..., 0])
    (value, before), chain = answers(error, 4 * error)
    order = order_of(value, before, chain, policy)
    assert order == nested_grids.USUAL
    assert order_of(SMOOTH, SMOOTH[::2, ::2], SMOOTH, SIDES) == order


def test_nodes_without_a_value_or_a_policy_count_for_nothing():
    error = 0.1 * np.abs(X[..., 0])
    (value, before), chain = answers(error, 4 * error)
    lost, policy = X[..., 1] > 0.5, SIDES.copy()
    value[lost], before[lost[::2, ::2]], chain[lost], policy[lost] = np.inf, np.inf, np.inf, np.nan
    order = order_of(value, before, chain, policy)
    assert order == nested_grids.BROKEN
    found = nested_grids.estimated_error(FINE, COARSE, change(value, before), order)
    assert np.all(np.isfinite(found))
    assert np.all(found[lost & (X[..., 1] > 0.6)] == 0)


@pytest.mark.parametrize("strength", [0.8, 1.2])
def test_from_a_point_all_of_the_value_is_off_and_the_estimate_says_so(strength):
    """Minimum time to one node, where the estimate was a tenth to an eighteenth of the error."""

    def time_to_the_origin(states):
        p, v = states[..., 0] / strength, states[..., 1] / strength
        side = np.where(p > -0.5 * v * np.abs(v), 1.0, -1.0)
        return side * v + np.sqrt(np.maximum(4 * side * p + 2 * v * v, 0))

    problem = hjb.Problem(
        lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: 1.0, hjb.Box([-strength], [strength]),
        target=lambda x: jnp.hypot(x[0], x[1]) - 1e-6,
    )  # fmt: skip
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (41, 41))
    with pytest.warns(UserWarning, match="the grid is coarse"):
        solution = hjb.solve(problem, grid)
    states = np.asarray(grid.nodes()).reshape(41, 41, 2)
    near = np.hypot(states[..., 0], states[..., 1]) < 0.5
    error = np.abs(solution.value - time_to_the_origin(states))[near].mean()
    assert error / 3 < solution.grid_error[near].mean() < 3 * error
