"""The estimate of the error from two grids, on node values in closed form; and at a target of one node."""

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import Grid
from hjbjax.solvers import grid_error
from hjbjax.solvers.grid_error import TwoGrids

FINE, COARSE = Grid([-1.0] * 2, [1.0] * 2, (41, 41)), Grid([-1.0] * 2, [1.0] * 2, (21, 21))
X = np.stack(np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41), indexing="ij"), -1)
H = 0.05
SMOOTH = np.cos(X[..., 0]) * np.sin(X[..., 1] + 1)
NONE_HELD = np.zeros((41, 41), bool)


def answers(error, order, gain=None, exact=SMOOTH, **options):
    """V_h with an error, V_2h with 2^q times the error, and the chain's answer, ``gain`` away."""
    chain = None if gain is None else exact + error + gain
    before = (exact + 2**order * error)[::2, ::2]
    return TwoGrids(FINE, COARSE, exact + error, before, options.pop("held", NONE_HELD), chain, **options)


@pytest.mark.parametrize(("order", "gain"), [(2, None), (2, 1.0), (1, 0.01)])
def test_the_order_is_measured_by_what_the_slopes_gain(order, gain):
    error = H**order * (1 + X[..., 0] ** 2) / 10
    found = grid_error.estimate_error(answers(error, order, gain))
    np.testing.assert_allclose(found[::2, ::2], error[::2, ::2], rtol=0.02)


def test_between_the_orders_the_estimate_is_between():
    error = H * (1 + X[..., 0] ** 2) / 10
    change = error[::2, ::2]
    found = grid_error.estimate_error(answers(error, 1, 5 * error))[::2, ::2]  # a fifth of what the slopes gained
    assert np.all((found > change / 3) & (found < change))


def test_where_both_schemes_are_one_the_order_is_that_of_central_differences():
    error = H**2 * (1 + X[..., 0] ** 2) / 10
    found = grid_error.estimate_error(answers(error, 2, 1e-6 * error))
    np.testing.assert_allclose(found[::2, ::2], error[::2, ::2], rtol=0.02)


def test_next_to_a_kink_the_order_is_one():
    bent = np.abs(X[..., 0] - 0.01) + 0.2 * X[..., 1] ** 2
    found = grid_error.estimate_error(answers(np.full((41, 41), 1e-3), 1, exact=bent))
    far = np.abs(X[..., 0]) > 6 * H
    np.testing.assert_allclose(found[20], 1e-3, rtol=0.25)  # the kink is not at a node
    np.testing.assert_allclose(found[far], 1e-3 / 3, rtol=0.05)


@pytest.mark.parametrize("smeared", [0.0, 1.0])
def test_a_jump_is_off_by_its_height(smeared):
    """Over as many cells on both grids, so that no difference of the two measures it."""

    def step(x, h):
        return np.tanh(x / (smeared * h)) if smeared else np.sign(x)

    line = np.linspace(-1, 1, 41) - 0.01
    value = np.broadcast_to(5 * step(line, H)[:, None], (41, 41)) + 0.1 * SMOOTH
    before = np.broadcast_to(5 * step(line[::2], 2 * H)[:, None], (21, 21)) + 0.1 * SMOOTH[::2, ::2]
    found = grid_error.estimate_error(TwoGrids(FINE, COARSE, value, before, NONE_HELD))
    assert np.min(found[20]) > 10 / 3
    assert np.max(found[np.abs(X[..., 0]) > 10 * H]) < 0.01


def test_a_steep_value_is_not_a_jump():
    for steep in (np.exp(4 * X[..., 0]), 30 * np.abs(X[..., 0] - 0.01), np.hypot(X[..., 0], X[..., 1])):
        found = grid_error.estimate_error(TwoGrids(FINE, COARSE, steep, steep[::2, ::2], NONE_HELD))
        assert np.max(found) < 1e-12


def test_v_may_jump_to_a_prescribed_value():
    held = np.hypot(X[..., 0], X[..., 1]) < 0.3
    value = np.where(held, 5.0, SMOOTH)
    found = grid_error.estimate_error(TwoGrids(FINE, COARSE, value, value[::2, ::2], held))
    assert np.max(found) < 1e-12


def test_infinite_values_have_no_error_and_spoil_none():
    lost = X[..., 1] > 0.5
    error = np.full((41, 41), H**2 / 10)
    finite = answers(error, 2)
    value, before = np.where(lost, np.inf, finite.value), np.where(lost[::2, ::2], np.inf, finite.before)
    found = grid_error.estimate_error(TwoGrids(FINE, COARSE, value, before, NONE_HELD))
    assert np.all(found[lost] == 0)
    np.testing.assert_allclose(found[X[..., 1] < 0.4], error[0, 0], rtol=1e-6)


def test_a_chain_of_two_states_is_exact_and_angles_go_round():
    fine = Grid([0.0, 0.0], [2 * np.pi, 1.0], (40, 2), periodic=(True, False))
    coarse = Grid([0.0, 0.0], [2 * np.pi, 1.0], (20, 2), periodic=(True, False))
    wave = np.sin(np.arange(40) * np.pi / 20)[:, None] + np.array([0.0, 3.0])
    found = grid_error.estimate_error(TwoGrids(fine, coarse, wave, (wave + 3e-3)[::2], np.zeros((40, 2), bool)))
    np.testing.assert_allclose(found, 1e-3, rtol=0.02)


def test_the_order_is_at_most_that_of_the_scheme():
    error = np.full((41, 41), 1e-3)
    found = grid_error.estimate_error(answers(error, 0.5, highest=grid_error.LEAST))
    np.testing.assert_allclose(found, error, rtol=1e-6)


@pytest.mark.filterwarnings("ignore:the grid is coarse")
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
    solution = hjb.solve(problem, grid)
    states = np.asarray(grid.nodes()).reshape(41, 41, 2)
    near = np.hypot(states[..., 0], states[..., 1]) < 0.5
    error = np.abs(solution.value - time_to_the_origin(states))[near].mean()
    assert error / 3 < solution.grid_error[near].mean() < 3 * error
