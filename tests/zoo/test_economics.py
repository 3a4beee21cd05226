"""The problems of economics and finance, solved: values, policies and free boundaries against their closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo


def exact_at_nodes(exact, grid):
    return np.asarray(jax.jit(jax.vmap(exact))(grid.nodes()))


@pytest.mark.parametrize(
    "numbers",
    [
        {},
        {"share": 0.5, "discount": 0.06, "depreciation": 0.08},
        pytest.param({"share": 0.7, "productivity": 0.5}, marks=pytest.mark.slow),
    ],
)
def test_consumption_is_proportional_to_the_capital(numbers):
    problem, grid = zoo.growth(**numbers)
    solution = hjb.solve(problem, grid)
    system = zoo.Ramsey(**numbers)
    consumed = solution.policy[:, 0] / (float(system.consumption) * grid.axis(0))
    np.testing.assert_allclose(consumed, 1.0, atol=1e-3)
    value = exact_at_nodes(zoo.growth_exact(**numbers), grid)
    assert np.max(np.abs(solution.value - value)) < 1e-4 * np.ptp(value)
    assert solution.stats["box_error"] == "no end of the box assumes anything"


def test_capital_approaches_its_steady_state():
    problem, grid = zoo.growth(shape=(101,))
    path = hjb.simulate(problem, hjb.solve(problem, grid), [3.0], 60.0)
    assert path.states[-1, 0] == pytest.approx(float(zoo.Ramsey().steady_state), rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["merton", "merton-wealth"])
@pytest.mark.parametrize("numbers", [{}, {"aversion": 3.0, "volatility": 0.25, "growth": 0.08}])
def test_share_and_rate_are_those_of_merton(name, numbers):
    entry = zoo.catalogue[name]
    solution = hjb.solve(*entry.build(**numbers))
    system = zoo.Merton(**numbers)
    inner = solution.policy[1:-1]
    np.testing.assert_allclose(inner[:, 0], float(system.share), rtol=0.01)
    np.testing.assert_allclose(inner[:, 1], float(system.consumption), rtol=0.01)
    value = exact_at_nodes(entry.exact(**numbers), solution.grid)
    assert np.max(np.abs(solution.value - value)) < 1e-4 * np.ptp(value)


PUTS = [{}, {"strike": 1.0, "interest": 0.03}, {"strike": 40.0, "interest": 0.08, "volatility": 0.45}]


@pytest.mark.parametrize("numbers", PUTS)
def test_a_perpetual_put(numbers):
    """The value to 1e-4 of the strike, the price of exercise to a tenth of a cell."""
    put = zoo.AmericanPut(**numbers)
    problem, grid = zoo.perpetual_put(**numbers)
    solution = hjb.solve(problem, grid, tol=1e-5 * put.strike)
    np.testing.assert_allclose(
        solution.value, exact_at_nodes(zoo.perpetual_put_exact(**numbers), grid), atol=1e-4 * put.strike
    )
    (found,) = solution.free_boundary()
    assert abs(found - float(put.boundary)) < 0.1 * grid.axis(0)[1]


@pytest.mark.slow
def test_perpetual_puts_in_a_batch_and_in_single_precision():
    lanes = [zoo.perpetual_put(volatility=sigma)[0] for sigma in (0.25, 0.3, 0.4)]
    grid = zoo.perpetual_put()[1]
    for solution, sigma in zip(hjb.solve_batch(lanes, grid), (0.25, 0.3, 0.4), strict=True):
        assert abs(solution.free_boundary()[0] - float(zoo.AmericanPut(volatility=sigma).boundary)) < 0.1
    short = hjb.solve(*zoo.perpetual_put(shape=(101,)), dtype="float32", tol=0.05)
    assert abs(short.free_boundary()[0] - float(zoo.AmericanPut().boundary)) < 0.4
    assert float(short.value_at([100.0])) == pytest.approx(23.21468, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["interest", "volatility", "strike"])
def test_comparative_statics_of_a_perpetual_put(name):
    """The derivative of a solve by a parameter is the derivative of the closed form, up to the spacing.

    The stopping set jumps from node to node, and the derivative keeps it fixed.
    """

    def price(number):
        problem, _ = zoo.perpetual_put(**{name: number})
        return hjb.solve(problem, grid).value_at(x)

    grid, x = zoo.perpetual_put(shape=(1601,))[1], jnp.array([100.0])
    number = zoo.catalogue["perpetual-put"].parameters[name]
    wanted = jax.grad(lambda number: zoo.perpetual_put_exact(**{name: number})(x))(number)
    assert float(jax.grad(price)(number)) == pytest.approx(float(wanted), rel=8e-3)


def binomial_put(put, maturity, spot, steps=1000):
    """An American put by the tree of Cox, Ross and Rubinstein."""
    dt = maturity / steps
    up = np.exp(put.volatility * np.sqrt(dt))
    chance = (np.exp(put.interest * dt) - 1 / up) / (up - 1 / up)
    prices = spot * up ** np.arange(-steps, steps + 1, 2.0)
    values = np.maximum(put.strike - prices, 0)
    for _ in range(steps):
        prices = prices[:-1] * up
        values = np.exp(-put.interest * dt) * (chance * values[1:] + (1 - chance) * values[:-1])
        values = np.maximum(values, put.strike - prices)
    return float(values[0])


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [{}, {"strike": 1.0, "interest": 0.04, "volatility": 0.3}])
def test_an_american_put_agrees_with_a_binomial_tree(numbers):
    put = zoo.AmericanPut(**({"strike": 40.0, "interest": 0.06, "volatility": 0.2} | numbers))
    problem, grid = zoo.american_put(**numbers)
    solution = hjb.solve(problem, grid, tol=1e-4 * put.strike)
    for time in (0.5, 1.0):
        for moneyness in (0.9, 1.0, 1.15):
            spot = moneyness * put.strike
            wanted = binomial_put(put, time, spot)
            assert float(solution.value_at([spot, time])) == pytest.approx(wanted, abs=1e-4 * put.strike)
    if not numbers:
        assert float(solution.value_at([40.0, 1.0])) == pytest.approx(2.31958, abs=2e-3)
    # the price of exercise, one unit of time before maturity and in between, is where the tree starts to wait
    segments = solution.free_boundary().reshape(-1, 2)
    assert np.all(segments[:, 0] <= put.strike * 1.001)
    last = segments[np.argmax(segments[:, 1])]
    assert last[1] == pytest.approx(1.0)
    cell = grid.axis(0)[1]
    early, late = (binomial_put(put, 1.0, last[0] + s * cell) - (put.strike - last[0] - s * cell) for s in (-1, 1))
    assert early < 1e-4 * put.strike < 2e-4 * put.strike < late


@pytest.mark.parametrize(
    "numbers", [{}, {"payout": 0.0}, {"coupon": 3.0, "interest": 0.04, "volatility": 0.35, "payout": 0.03, "tax": 0.1}]
)
def test_owners_default_at_the_boundary_of_leland(numbers):
    firm = zoo.Firm(**numbers)
    problem, grid = zoo.leland(**numbers)
    solution = hjb.solve(problem, grid)
    np.testing.assert_allclose(solution.value, exact_at_nodes(zoo.leland_exact(**numbers), grid), atol=1e-3)
    assert float(np.exp(solution.free_boundary()[0])) == pytest.approx(float(firm.boundary), rel=1e-3)
