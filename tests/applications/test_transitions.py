"""Transitions between two stationary equilibria, against an implicit scheme in NumPy that is written out here."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import spsolve

import hjbjax as hjb

WEALTH = hjb.Grid([-0.4], [3.2], (37,), edges="constrained")
A = np.asarray(WEALTH.axis(0))
BETA, BRACKET = 0.05, (-0.05, 0.1)
INCOME, FIND, LOSE = (0.1, 0.2), 0.8, 0.5


def worker(interest, risk=1.0):
    """Huggett's household with two incomes; ``risk`` is the distance of the incomes in units of ``INCOME``."""
    middle, half = sum(INCOME) / 2, risk * (INCOME[1] - INCOME[0]) / 2
    return hjb.Problem(
        lambda x, u, mode: interest * x + middle + (-half, half)[mode] - u, reward=lambda x, u, mode: -1 / u[0],
        controls=hjb.Box([0.01], [1.0]), discount=BETA,
        modes=hjb.Modes(("idle", "busy"), rates=[[0, FIND], [LOSE, 0]]),
    )  # fmt: skip


def bonds(interest, solution, law):
    return jnp.sum(law * A)


def step_back(ahead, interest, dt):
    """V at the beginning of a step and the generator of wealth and income there, as in Achdou et al."""
    h, income, weight = A[1] - A[0], np.array(INCOME)[:, None], BETA / np.expm1(BETA * dt)
    gained = interest * A + income
    switching = csr_array(np.kron([[-FIND, FIND], [LOSE, -LOSE]], np.eye(A.size)))
    v = ahead
    for _ in range(100):
        forward, backward = np.empty_like(v), np.empty_like(v)
        forward[:, :-1] = backward[:, 1:] = np.diff(v, axis=1) / h
        forward[:, -1], backward[:, 0] = gained[:, -1] ** -2.0, gained[:, 0] ** -2.0
        saving, spending = (gained - np.maximum(slope, 1e-9) ** -0.5 for slope in (forward, backward))
        drift = np.where(saving > 0, saving, np.where(spending >= 0, 0, spending))
        up, down = np.maximum(drift, 0).ravel() / h, np.maximum(-drift, 0).ravel() / h
        generator = switching + diags_array([-(up + down), up[:-1], down[1:]], offsets=[0, 1, -1])
        matrix = (BETA + weight) * eye_array(v.size) - generator
        new = spsolve(matrix.tocsc(), -1 / (gained - drift).ravel() + weight * ahead.ravel()).reshape(v.shape)
        change, v = np.abs(new - v).max(), new
        if change < 1e-12 * np.abs(v).max():
            return v, generator
    raise AssertionError("no policy repeats itself")


def population(prices, last, law, dt):
    """Values and laws under a path of prices: backward from the last value, and forward from the first law."""
    values, generators = [last], []
    for price in prices[::-1]:
        v, generator = step_back(values[-1], price, dt)
        values.append(v)
        generators.append(generator)
    laws = [law]
    for generator in generators[::-1]:
        step = (eye_array(law.size) - dt * generator.T).tocsc()
        laws.append(spsolve(step, laws[-1].ravel()).reshape(law.shape))
    return np.stack(values[::-1]), np.stack(laws)


@pytest.fixture(scope="module")
def riskier():
    """The equilibria before and after the two incomes move apart, and the transition."""
    before, after = (
        hjb.equilibrium(lambda r, risk=risk: worker(r, risk), WEALTH, bonds, (-0.05, 0.045), solve_tol=1e-10)
        for risk in (0.7, 1.0)
    )
    return before, after, hjb.transition(worker, bonds, before.law, after, 60.0, BRACKET, steps=30, solve_tol=1e-10)


@pytest.mark.slow
def test_a_transition_after_more_risk_against_an_independent_scheme(riskier):
    before, after, path = riskier
    assert path.status is hjb.Status.CONVERGED
    assert path.error <= 1e-6 * (BRACKET[1] - BRACKET[0])
    assert len(path.history) <= 8
    values, laws = population(path.prices, np.asarray(after.solution.value), np.asarray(before.law), 2.0)
    np.testing.assert_allclose(path.solution.value, values, rtol=1e-7)
    np.testing.assert_allclose(path.laws, laws, rtol=0, atol=1e-7)
    assert np.abs(laws[1:].sum(axis=1) @ A).max() < 1e-6
    np.testing.assert_allclose(path.laws.sum(axis=(1, 2)), 1, rtol=1e-12)
    assert path.laws.min() >= 0
    assert after.price < before.price
    assert path.prices[0] < path.prices[-1]  # everybody saves more at first
    assert path.solution.control_at(2.0, [0.0], mode="idle") == path.solution.policy[1, 0, 4, 0]
    assert path.prices[-1] == pytest.approx(after.price, abs=1e-4)


# --- firms, whose policy is a constant over the states, so that the path is that of two numbers ---

LINE = hjb.Grid([-3.0], [4.0], (36,))
CAPITAL = np.asarray(LINE.axis(0))
DELTA = 1.2


def firm(price, decay=DELTA):
    """Capital decays, is built at the cost u²/2, and earns the price; V is linear in it."""
    return hjb.Problem(
        lambda x, u: u - decay * x, reward=lambda x, u: price * x[0] - u[0] ** 2 / 2, controls=hjb.Box([-9.0], [9.0]),
        noise=0.3, discount=1.0,
    )  # fmt: skip


def supply(price, solution, law):
    return jnp.sum(law * CAPITAL) - (2 - price)


@pytest.fixture(scope="module")
def market():
    return [hjb.equilibrium(lambda p, d=d: firm(p, d), LINE, supply, (0.5, 3.0), tol=1e-9) for d in (1.0, DELTA)]


def saddle_path(mean, dt, demand):
    """Prices from the implicit steps of q = V' = u backward, and of the mean capital m forward, as one linear system.

    (1 + w + δ) q_n = p_n + w q_{n+1},  (1 + δ Δt) m_{n+1} = m_n + Δt q_n,  p_n = D_n − m_{n+1},  w = 1/(e^Δt − 1).
    """
    steps = len(demand)
    w, rest = 1 / np.expm1(dt), 2 / (1 + DELTA * (1 + DELTA))  # the value of q for ever
    system, right = np.zeros((2 * steps, 2 * steps)), np.zeros(2 * steps)
    for n in range(steps):
        q, m = n, steps + n  # m_{n+1}
        system[q, q], system[q, m], right[q] = 1 + w + DELTA, 1.0, demand[n]
        system[m, m], system[m, q] = 1 + DELTA * dt, -dt
        if n + 1 < steps:
            system[q, q + 1] = -w
        else:
            right[q] += w * DELTA * rest
        if n:
            system[m, m - 1] = -1.0
        else:
            right[m] = mean
    return demand - np.linalg.solve(system, right)[steps:]


def test_prices_of_a_market_of_firms_are_the_saddle_path(market):
    before, after = market
    path = hjb.transition(firm, supply, before.law, after, 8.0, (0.5, 3.0), steps=32)
    mean = float(np.sum(before.law * CAPITAL))
    np.testing.assert_allclose(path.prices, saddle_path(mean, 0.25, np.full(32, 2.0)), rtol=0, atol=2e-5)
    # the continuous path approaches the rest at the stable eigenvalue
    slowest = np.linalg.eigvals([[-DELTA, 1.0], [1.0, 1 + DELTA]]).real.min()
    exact = after.price - (mean - (2 - after.price)) * np.exp(slowest * path.times[1:])
    np.testing.assert_allclose(path.prices, exact, rtol=0, atol=0.03)
    assert repr(path).startswith("Transition(CONVERGED after")


@pytest.mark.slow
def test_an_economy_at_rest_stays_there(market):
    _, after = market
    path = hjb.transition(firm, supply, after.law, after, 4.0, (0.5, 3.0), steps=8)
    np.testing.assert_allclose(path.prices, after.price, rtol=0, atol=1e-6)
    np.testing.assert_allclose(path.laws, np.broadcast_to(after.law, path.laws.shape), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_shock_that_fades(market):
    """The demand is higher by e^{−2t}; the same linear system with this demand gives the prices."""
    _, after = market

    def demanded(t, price, solution, law):
        return supply(price, solution, law) - jnp.exp(-2 * t)

    path = hjb.transition(
        lambda t, p: firm(p), demanded, after.law, after, 8.0, (0.5, 3.5), steps=16, time_dependent=True
    )
    wanted = saddle_path(2 - after.price, 0.5, 2 + np.exp(-2 * path.times[:-1]))
    np.testing.assert_allclose(path.prices, wanted, rtol=0, atol=2e-5)


@pytest.mark.parametrize(
    ("changes", "kind", "reason"),
    [
        ({"horizon": 0.0}, ValueError, "transition: horizon = 0.0; wanted a finite number > 0"),
        ({"steps": 2.5}, ValueError, "transition: steps = 2.5; wanted a positive integer"),
        ({"law": np.ones(3)}, ValueError, r"transition: got a law of shape \(3,\), wanted \(36,\)"),
        ({"bracket": (1.0, 0.5)}, ValueError, r"transition: the bracket is \(1.0, 0.5\)"),
        ({"bracket": (2.5, 3.0)}, ValueError, r"new equilibrium is 1.45055, outside of the bracket \[2.5, 3.0\]"),
        ({"guess": [1.0]}, ValueError, r"a guess of shape \(1,\), wanted \(4,\): one finite price per step"),
        ({"problem_of": lambda p: p}, TypeError, "problem_of returned .*, wanted a Problem"),
        ({"excess": lambda p, s, law: law}, TypeError, r"excess returned an array of shape \(36,\), wanted one number"),
    ],
)
def test_refusals(market, changes, kind, reason):
    _, after = market
    given = {
        "problem_of": firm, "excess": supply, "law": after.law, "after": after, "horizon": 1.0, "bracket": (0.5, 3.0),
        "steps": 4,
    } | changes  # fmt: skip
    with pytest.raises(kind, match=reason) as caught:
        hjb.transition(**given)
    assert len(str(caught.value).splitlines()) <= 6


@pytest.mark.slow
def test_a_narrow_bracket_and_a_short_horizon(market):
    before, after = market
    with pytest.raises(hjb.SolveError, match=r"STALLED: .* prices are at an end of the bracket") as caught:
        hjb.transition(firm, supply, before.law, after, 1.0, (after.price - 0.01, 3.0), steps=4)
    assert caught.value.solution.status is hjb.Status.STALLED
    with pytest.warns(hjb.SolveWarning, match="Use a longer horizon"):
        hjb.transition(firm, supply, before.law, after, 1.0, (0.5, 3.0), steps=4)
