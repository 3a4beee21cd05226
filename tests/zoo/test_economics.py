"""The problems of economics and finance, solved: values, policies and free boundaries against their closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from binomial_tree import binomial_put
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [{}, {"strike": 1.0, "interest": 0.04, "volatility": 0.3}])
def test_an_american_put_agrees_with_a_binomial_tree(numbers):
    put = zoo.AmericanPut(**({"strike": 40.0, "interest": 0.06, "volatility": 0.2} | numbers))
    problem, grid = zoo.american_put(**numbers)
    solution = hjb.solve(problem, grid, tol=1e-4 * put.strike)
    tree = functools.partial(binomial_put, put.strike, put.interest, put.volatility, steps=1000)
    for time in (0.5, 1.0):
        for moneyness in (0.9, 1.0, 1.15):
            spot = moneyness * put.strike
            wanted = tree(time, spot)
            assert float(solution.value_at([spot, time])) == pytest.approx(wanted, abs=1e-4 * put.strike)
    if not numbers:
        assert float(solution.value_at([40.0, 1.0])) == pytest.approx(2.31958, abs=2e-3)
    # the price of exercise, one unit of time before maturity and in between, is where the tree starts to wait
    segments = solution.free_boundary().reshape(-1, 2)
    assert np.all(segments[:, 0] <= put.strike * 1.001)
    last = segments[np.argmax(segments[:, 1])]
    assert last[1] == pytest.approx(1.0)
    cell = grid.axis(0)[1]
    early, late = (tree(1.0, last[0] + s * cell) - (put.strike - last[0] - s * cell) for s in (-1, 1))
    assert early < 1e-4 * put.strike < 2e-4 * put.strike < late


@pytest.mark.slow
@pytest.mark.parametrize(
    "numbers", [{}, {"payout": 0.0}, {"coupon": 3.0, "interest": 0.04, "volatility": 0.35, "payout": 0.03, "tax": 0.1}]
)
def test_owners_default_at_the_boundary_of_leland(numbers):
    firm = zoo.Firm(**numbers)
    problem, grid = zoo.leland(**numbers)
    solution = hjb.solve(problem, grid)
    np.testing.assert_allclose(solution.value, exact_at_nodes(zoo.leland_exact(**numbers), grid), atol=1e-3)
    assert float(np.exp(solution.free_boundary()[0])) == pytest.approx(float(firm.boundary), rel=1e-3)


def shot(firm, barrier):
    """p and p′ of a firm that pays out above the barrier, on the way down to zero cash, by SciPy; functions of w."""
    r, delta, mu, theta = firm.interest, firm.depreciation, firm.productivity, firm.adjustment

    def rest(w, p, slope):
        """The equation without the term of the noise, at the best investment."""
        i = (p / slope - w - 1) / theta
        flow = (r - firm.carrying) * w + mu - i - theta * i**2 / 2
        return (i - delta) * (p - w * slope) + flow * slope - r * p

    def ode(w, y):
        return [y[1], -2 / firm.volatility**2 * rest(w, *y)]

    least = brentq(lambda q: rest(barrier, barrier + q, 1.0), 0.5, 1 + theta * float(firm.first_best))
    return solve_ivp(ode, (barrier, 0.0), [barrier + least, 1.0], rtol=1e-11, atol=1e-13, dense_output=True).sol


@pytest.mark.slow
def test_a_firm_is_liquidated_as_in_bolton_chen_and_wang():
    problem, grid = zoo.liquidation()
    found, firm = hjb.solve(problem, grid), zoo.ConstrainedFirm()
    assert abs(float(firm.first_best) - 0.151) < 5e-4  # as published, like all numbers with two digits
    assert abs(1 + firm.adjustment * float(firm.first_best) - 1.23) < 5e-3
    barrier = brentq(lambda w: shot(firm, w)(0.0)[0] - firm.liquidation, 0.15, 0.28)
    exact, w = shot(firm, barrier), grid.axis(0)
    kept = np.minimum(w, barrier)
    assert np.max(np.abs(found.value - (exact(kept)[0] + w - kept))) <= 2e-3
    (paid,) = found.free_boundary()
    assert abs(barrier - 0.22) < 5e-3
    assert abs(paid - barrier) <= grid.spacing(0)
    assert abs(exact(0.0)[1] - 30) < 0.5
    assert abs(found.costate_at([0.0])[0] - exact(0.0)[1]) <= 0.2
    assert found.policy[1, 0] < -0.6
    assert abs(found.control_at([paid])[0] - 0.106) < 1e-3


@pytest.mark.slow
def test_a_firm_issues_equity_as_in_bolton_chen_and_wang():
    firm, problem, grid = zoo.ConstrainedFirm(), *zoo.refinancing()
    found, w = hjb.solve(problem, grid), grid.axis(0)

    def issued(barrier):
        """p on a fine grid of cash, and the best issue."""
        fine = np.linspace(0.0, barrier, 4001)
        p = shot(firm, barrier)(fine)[0]
        net = p - 0.01 - 1.06 * fine
        return p, net.max() - p[0], fine[np.argmax(net)]

    barrier = brentq(lambda b: issued(b)[1], 0.16, 0.22)
    p, _, raised = issued(barrier)
    kept = np.minimum(w, barrier)
    exact = np.interp(kept, np.linspace(0.0, barrier, 4001), p) + w - kept
    assert np.max(np.abs(found.value[0] - exact)) <= 1e-4
    paying, issuing = found.in_mode("operating").pushing[:, 0], found.in_mode("issuing").pushing[:, 1]
    assert abs(w[np.flatnonzero(paying)[0]] - barrier) <= 1.5 * grid.spacing(0)
    assert abs(w[np.flatnonzero(issuing)[-1] + 1] - raised) <= 1.5 * grid.spacing(0)
    assert abs(barrier - 0.19) < 5e-3
    assert abs(raised - 0.06) < 5e-3
    assert abs(found.costate_at([0.0], mode="operating")[0] - 1.7) < 0.05
    assert abs(found.control_at([barrier], mode="operating")[0] - 0.11) < 2e-3
    assert found.switching[0, 0] == 1  # without cash it issues at once
    path = hjb.simulate(problem, found, [0.02], 3.0, mode="operating", key=3)
    assert path.status.name == "DURATION"
    assert np.all(path.states[:, 0] <= barrier + grid.spacing(0))


def free_of_trade(investor):
    """The ends of the interval without trade, and the value there as a function of the share.

    By shooting: q = V′ follows the equation from a purchase at the lower end, with q and q′ those of the marginal cost.
    The lower end is right if q then just touches the marginal cost of a sale.
    """
    r, a, sigma, rho = investor.interest, investor.growth, investor.volatility, investor.discount
    buy, sell = investor.buying, investor.selling

    def value(z, q, slope):
        """V from the equation, with the best consumption 1/(1/ρ − z q)."""
        k = 1 / (1 / rho - z * q)
        reward = np.log(k) + (r + z * (a - r) - k - sigma**2 * z**2 / 2) / rho
        drift = z * (1 - z) * (a - r - sigma**2 * z) + k * z
        return (reward + drift * q + 0.5 * (sigma * z * (1 - z)) ** 2 * slope) / rho

    def ode(z, y):
        v, q = y
        return [q, (v - value(z, q, 0.0)) * rho / (0.5 * (sigma * z * (1 - z)) ** 2)]

    def path(low):
        q = buy / (rho * (1 + buy * low))
        start = [value(low, q, -(buy**2) / (rho * (1 + buy * low) ** 2)), q]
        return solve_ivp(ode, (low, 0.99), start, rtol=1e-11, atol=1e-12, dense_output=True).sol

    def above(low):
        """q less the marginal cost of a sale: its least distance, and where."""
        z, found = np.linspace(low, 0.99, 20_001), path(low)
        gap = found(z)[1] + sell / (rho * (1 - sell * z))
        least = np.argmin(gap[: np.argmax(gap < -0.5 * sell / rho) or None])
        return gap[least], z[least]

    share = investor.share
    low = brentq(lambda low: above(low)[0], 0.3 * share, 0.99 * share, xtol=1e-10)
    return low, above(low)[1], lambda z: path(low)(z)[0]


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [{}, {"buying": 0.03, "selling": 0.002}, {"growth": 0.08, "discount": 0.1}])
def test_an_investor_trades_outside_of_the_interval_of_the_equation(numbers):
    investor = zoo.Portfolio(**numbers)
    low, high, value = free_of_trade(investor)
    problem, grid = zoo.transaction_costs(**numbers)
    solution = hjb.solve(problem, grid)
    np.testing.assert_allclose(solution.free_boundary(), [low, high], atol=np.diff(grid.axis(0))[0])
    waits = (grid.axis(0) > low) & (grid.axis(0) < high)
    np.testing.assert_allclose(solution.value[waits], value(grid.axis(0)[waits]), atol=1e-3)
    assert low < investor.share < high


def test_an_investor_who_would_borrow_is_refused():
    with pytest.raises(ValueError, match="share of stock without costs"):
        zoo.transaction_costs(growth=0.2)
    with pytest.raises(ValueError, match="below 1"):
        zoo.transaction_costs(selling=1.5)
