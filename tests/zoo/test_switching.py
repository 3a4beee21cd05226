"""Consumption and saving with two incomes, and a thermostat, against schemes in plain NumPy and SciPy."""

import dense_modes
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

import hjbjax as hjb

INCOMES, RATES, INTEREST, DISCOUNT = np.array([0.1, 0.2]), (1.2, 0.9), 0.03, 0.05


def implicit_scheme(wealth, aversion):
    """Value, consumption and law by the implicit upwind scheme of macroeconomics, from the first-order condition.

    The ends are state constraints: there the household consumes at least its income.
    """
    count, step = len(wealth), wealth[1] - wealth[0]
    income = INCOMES[:, None] + INTEREST * wealth
    power = 1 - aversion

    def utility(c):
        return c**power / power

    rows = [[-RATES[0], RATES[0]], [RATES[1], -RATES[1]]]
    jumps = sp.kron(np.array(rows), sp.eye(count))
    value = utility(income) / DISCOUNT
    for _ in range(200):
        rise = np.diff(value, axis=1) / step
        forward = np.concatenate([rise, (income[:, -1:]) ** -aversion], axis=1)
        backward = np.concatenate([(income[:, :1]) ** -aversion, rise], axis=1)
        up, down = forward ** (-1 / aversion), backward ** (-1 / aversion)
        gains, losses = income - up > 0, income - down < 0
        better = utility(up) + forward * (income - up) >= utility(down) + backward * (income - down)
        saves, spends = gains & (~losses | better), losses & ~(gains & better)
        saves[:, -1], spends[:, 0] = False, False
        consumption = np.where(saves, up, np.where(spends, down, income))
        drift = income - consumption
        ahead, back = np.maximum(drift, 0) / step, np.maximum(-drift, 0) / step
        blocks = [sp.diags([-(f + b), b[1:], f[:-1]], [0, -1, 1]) for f, b in zip(ahead, back, strict=True)]
        generator = sp.block_diag(blocks) + jumps
        new = spsolve((DISCOUNT * sp.eye(2 * count) - generator).tocsc(), utility(consumption).ravel())
        new = new.reshape(2, count)
        change, value = np.max(np.abs(new - value)), new
        if change < 1e-12 * np.max(np.abs(value)):
            break
    matrix = generator.T.tolil()
    matrix[0] = 1.0
    law = spsolve(matrix.tocsc(), np.eye(2 * count)[0]).reshape(2, count)
    return value, consumption, law


@pytest.mark.slow
@pytest.mark.parametrize(
    ("aversion", "count"), [(2.0, 100), pytest.param(1.5, 500, marks=pytest.mark.slow)], ids=["100", "500"]
)
def test_saving_is_the_answer_of_an_implicit_scheme(aversion, count):
    problem, grid = hjb.zoo.saving(rates=RATES, aversion=aversion, shape=(count,))
    found = hjb.solve(problem, grid, scheme=hjb.Upwind(), tol=1e-8)
    value, consumption, law = implicit_scheme(grid.axis(0), aversion)
    assert np.max(np.abs(found.value - value)) < 1e-6
    assert np.max(np.abs(found.policy[..., 0] - consumption)) < 1e-6
    masses = hjb.chain.stationary_law(problem, grid, found.policy)
    assert np.max(np.abs(masses - law)) < 1e-6
    assert masses[0, 0] > 0.01  # poor households at the borrowing limit


def dense_thermostat(temperatures, wear):
    """The value and the choices of a dense program with walls at the ends."""
    return dense_modes.solve(
        [temperatures], 2, [0.0], lambda x, u, i: 0.2 * (5.0 - x) + 5.0 * i, lambda x, u, i: (x[0] - 20) ** 2 + i,
        noise=lambda x, u, i: 1.0, switching=lambda x: np.array([[0, wear], [wear, 0]]), discount=0.1,
    )  # fmt: skip


def test_the_box_of_the_thermostat_has_no_walls():
    """Up to its ends the value is that of a box twice as wide."""
    problem, grid = hjb.zoo.thermostat(shape=(41,))
    found = hjb.solve(problem, grid, scheme=hjb.Upwind(central=False), tol=1e-9)
    wide, _ = dense_thermostat(np.linspace(0.0, 40.0, 81), wear=2.0)
    assert np.max(np.abs(found.value - wide[:, 20:61])) < 0.05  # of a range of 89


@pytest.mark.parametrize("wear", [0.3, 2.0])
def test_the_thermostat_is_the_answer_of_a_dense_program(wear):
    problem, grid = hjb.zoo.thermostat(wear=wear, noise=1.0, shape=(41,))
    grid = hjb.Grid(grid.lo, grid.hi, grid.shape)  # with walls, as in the dense program
    found = hjb.solve(problem, grid, scheme=hjb.Upwind(central=False), tol=1e-9)
    exact, choices = dense_thermostat(grid.axis(0), wear)
    assert np.max(np.abs(found.value - exact)) < 1e-8
    assert np.array_equal(found.switching, np.where(choices < 0, -1 - choices, [[0], [1]]))
    off, on = found.switching
    x = grid.axis(0)
    assert np.all(np.diff(off) <= 0)  # one threshold each
    assert np.all(np.diff(on) <= 0)
    assert x[off == 1].max() < 20 < x[on == 0].min()


@pytest.mark.slow
def test_quantecon_finds_the_same_value():
    markov = pytest.importorskip("quantecon.markov")
    problem, grid = hjb.zoo.saving(shape=(60,))
    problem = hjb.Problem(
        problem.drift, controls=problem.controls.grid(31), reward=problem.reward, discount=problem.discount,
        modes=problem.modes,
    )  # fmt: skip
    found = hjb.solve(problem, grid, scheme=hjb.Upwind(), tol=1e-8)
    rewards, chances, states, actions, factor = hjb.chain.transition_arrays(problem, grid)
    process = markov.DiscreteDP(rewards, chances, factor, states, actions)
    theirs = process.solve("policy_iteration", max_iter=1000).v
    assert np.max(np.abs(theirs.reshape(2, 60) - found.value)) < 1e-6
