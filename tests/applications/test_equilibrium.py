"""Equilibria against closed forms, an economy written out in SciPy, and finite differences of the price."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve

import hjbjax as hjb
from hjbjax.applications import root_search
from hjbjax.applications.equilibrium import _shared_out
from hjbjax.solvers.nested_grids import resized

LINE = hjb.Grid([-3.0], [5.0], (41,))


def firm(price, cost=1.0, decay=1.0, discount=1.0):
    """Capital earns the price; V is linear in it, so the policy is a constant."""
    return hjb.Problem(
        lambda x, u: u - decay * x, reward=lambda x, u: price * x[0] - cost * u[0] ** 2 / 2,
        controls=hjb.Box([-9.0], [9.0]), noise=0.4, discount=discount,
    )  # fmt: skip


def clearing(demand, slope):
    """Mean capital minus a linear demand."""
    x = np.asarray(LINE.axis(0))
    return lambda price, solution, law: jnp.sum(law * x) - (demand - slope * price)


def exact_price(demand, slope, cost, decay, discount):
    """u = p/(c (β + δ)) and a mean of u/δ."""
    return demand / (slope + 1 / (cost * decay * (discount + decay)))


@pytest.mark.parametrize(
    ("demand", "slope", "cost", "decay", "discount"),
    [(2.0, 1.0, 1.0, 1.0, 1.0), (1.0, 0.3, 2.0, 0.8, 0.5), (3.0, 2.0, 1.5, 1.2, 0.1)],
)
def test_a_market_of_firms(demand, slope, cost, decay, discount):
    found = hjb.equilibrium(lambda p: firm(p, cost, decay, discount), LINE, clearing(demand, slope), (0.2, 2.5))
    assert found.price == pytest.approx(exact_price(demand, slope, cost, decay, discount), abs=5e-6)
    assert abs(found.excess) < 1e-5
    assert found.law.shape == found.solution.value.shape
    assert len(found.tried) <= 8
    np.testing.assert_array_equal(found.tried[:2, 0], [0.2, 2.5])
    assert f"after {len(found.tried)} solves" in repr(found)


@pytest.mark.parametrize(
    "f", [np.expm1, lambda x: x**3 - 0.4, lambda x: np.exp(-9 * x) - 0.5, lambda x: 1 / (2.001 - x) - 4, np.sin]
)
@pytest.mark.parametrize(("lo", "hi"), [(-1.0, 2.0), (-0.3, 1.9)])
def test_the_search_finds_the_root_that_scipy_finds(f, lo, hi):
    width = 1e-6 * (hi - lo)
    search, count = root_search.begin_search(lo, f(lo), hi, f(hi)), 2
    while not root_search.is_done(search, width):
        x = float(root_search.proposal(search))
        assert lo < x < hi
        search, count = root_search.narrowed(search, x, f(x), width), count + 1
    assert float(root_search.best(search)[0]) == pytest.approx(brentq(f, lo, hi, xtol=1e-14), abs=2.1 * width)
    assert count <= 14


# --- households, with the chain and the policy iteration written out ---

HOUSEHOLDS = hjb.Grid([-1.0, -1.0], [6.0, 1.0], (36, 7), edges="constrained")
WEALTH, INCOME = np.moveaxis(np.asarray(HOUSEHOLDS.nodes()), -1, 0)


def household(interest, sigma=0.4, discount=0.2, mean_reversion=0.5):
    """Huggett's household with risk aversion two and an Ornstein–Uhlenbeck log income."""
    return hjb.Problem(
        lambda x, u: jnp.stack([interest * x[0] + jnp.exp(x[1]) - u[0], -mean_reversion * x[1]]),
        noise=jnp.stack([0.0 * sigma, sigma]), reward=lambda x, u: -1 / u[0], controls=hjb.Box([0.05], [6.0]),
        discount=discount,
    )  # fmt: skip


def demand_for_bonds(interest, solution, law):
    return jnp.sum(law * WEALTH)


def income_chain(sigma, mean_reversion):
    """The upwind chain of the log income, (7, 7); noise reflects on the last nodes."""
    z = np.linspace(-1, 1, 7)
    h, f = z[1] - z[0], -mean_reversion * z
    up, down = (np.maximum(s * f, 0) / h + sigma**2 / (2 * h**2) for s in (1, -1))
    up[0] += sigma**2 / (2 * h**2)
    down[-1] += sigma**2 / (2 * h**2)
    up[-1] = down[0] = 0.0
    return np.diag(up[:-1], 1) + np.diag(down[1:], -1) - np.diag(up + down)


def bonds_by_scipy(interest, sigma, discount, mean_reversion):
    """The mean wealth by Achdou et al.: implicit upwind steps for V, then the null vector of the adjoint."""
    da, count = 0.2, 36
    gained = interest * WEALTH + np.exp(INCOME)
    others = csr_array(np.kron(np.eye(count), income_chain(sigma, mean_reversion)))
    v = -1 / gained / discount
    for _ in range(200):
        forward, backward = np.empty_like(v), np.empty_like(v)
        forward[:-1] = backward[1:] = np.diff(v, axis=0) / da
        forward[-1], backward[0] = gained[-1] ** -2.0, gained[0] ** -2.0  # neither saves nor borrows at an end
        saving, spending = gained - forward**-0.5, gained - backward**-0.5
        at_rest = (saving <= 0) & (spending >= 0)
        drift = np.where(saving > 0, saving, np.where(at_rest, 0, spending))
        up, down = np.maximum(drift, 0) / da, np.maximum(-drift, 0) / da
        generator = others + diags_array([-(up + down).ravel(), up.ravel()[:-7], down.ravel()[7:]], offsets=[0, 7, -7])
        matrix = (discount * diags_array(np.ones(v.size)) - generator).tocsc()
        new = spsolve(matrix, -1 / (gained - drift).ravel()).reshape(v.shape)
        change, v = np.abs(new - v).max(), new
        if change < 1e-12 * np.abs(v).max():
            break
    balance = generator.T.toarray()
    balance[0] = 1.0
    law = np.linalg.solve(balance, np.eye(v.size)[0])
    return law @ WEALTH.ravel()


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "discount", "mean_reversion"), [(0.4, 0.2, 0.5), (0.3, 0.2, 0.4)])
def test_the_interest_that_clears_a_market_for_bonds(sigma, discount, mean_reversion):
    found = hjb.equilibrium(
        lambda r: household(r, sigma, discount, mean_reversion), HOUSEHOLDS, demand_for_bonds, (0.05, 0.17),
        scheme=hjb.Upwind(central=False),
    )  # fmt: skip
    exact = brentq(bonds_by_scipy, 0.05, 0.17, (sigma, discount, mean_reversion), xtol=1e-9)
    assert found.price == pytest.approx(exact, abs=1e-6)
    assert len(found.tried) <= 12
    assert found.law[0].sum() > 0.01  # at the borrowing limit


# --- two incomes, as modes ---

LADDER = hjb.Grid([-0.5], [5.0], (56,), edges="constrained")
RUNGS = np.asarray(LADDER.axis(0))


def worker(interest, low=0.1, find=1.5, lose=1.0):
    """Huggett's household, with a job or without one."""
    income = jnp.stack([low + 0.0 * interest, 0.2 + 0.0 * interest])
    return hjb.Problem(
        lambda x, u, mode: interest * x + income[mode] - u, reward=lambda x, u, mode: -1 / u[0],
        controls=hjb.Box([0.01], [1.0]), discount=0.05, modes=hjb.Modes(("idle", "busy"), rates=[[0, find], [lose, 0]]),
    )  # fmt: skip


def bonds_of_workers(interest, low, find, lose):
    """The mean wealth with two incomes, as in ``bonds_by_scipy``."""
    h, income = RUNGS[1] - RUNGS[0], np.array([[low], [0.2]])
    gained = interest * RUNGS + income
    switching = csr_array(np.kron([[-find, find], [lose, -lose]], np.eye(56)))
    v = -1 / gained / 0.05
    for _ in range(200):
        forward, backward = np.empty_like(v), np.empty_like(v)
        forward[:, :-1] = backward[:, 1:] = np.diff(v, axis=1) / h
        forward[:, -1], backward[:, 0] = gained[:, -1] ** -2.0, gained[:, 0] ** -2.0
        saving, spending = (gained - np.maximum(slope, 1e-9) ** -0.5 for slope in (forward, backward))  # V may be flat
        drift = np.where(saving > 0, saving, np.where(spending >= 0, 0, spending))
        up, down = np.maximum(drift, 0).ravel() / h, np.maximum(-drift, 0).ravel() / h
        generator = switching + diags_array([-(up + down), up[:-1], down[1:]], offsets=[0, 1, -1])
        new = spsolve((0.05 * diags_array(np.ones(112)) - generator).tocsc(), -1 / (gained - drift).ravel())
        change, v = np.abs(new - v.ravel()).max(), new.reshape(v.shape)
        if change < 1e-12 * np.abs(v).max():
            break
    balance = generator.T.toarray()
    balance[0] = 1.0
    return np.linalg.solve(balance, np.eye(112)[0]) @ np.tile(RUNGS, 2)


@pytest.mark.slow
@pytest.mark.parametrize(("low", "find", "lose"), [(0.1, 1.5, 1.0), (0.12, 0.8, 0.6)])
def test_huggetts_economy_with_two_incomes(low, find, lose):
    found = hjb.equilibrium(
        lambda r: worker(r, low, find, lose), LADDER, lambda r, solution, law: jnp.sum(law * RUNGS), (-0.01, 0.045)
    )
    assert found.law.shape == found.solution.value.shape == (2, 56)
    np.testing.assert_allclose(found.law.sum(axis=1), np.array([lose, find]) / (find + lose), rtol=1e-9)
    assert found.law[0, 0] > 0.01  # the idle at the borrowing limit
    assert found.law[1, 0] < found.law[0, 0]
    assert found.price == pytest.approx(brentq(bonds_of_workers, -0.01, 0.045, (low, find, lose), xtol=1e-10), abs=1e-6)
    assert len(found.tried) <= 12


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:equilibrium. the grid is coarse")
def test_the_error_of_the_grid_is_estimated():
    """The interest on many nodes is close to the exact one; the chain is of first order, so the error is large."""
    found = {}
    for count in (56, 111, 881):
        ladder = hjb.Grid([-0.5], [5.0], (count,), edges="constrained")
        rungs = np.asarray(ladder.axis(0))
        found[count] = hjb.equilibrium(worker, ladder, lambda r, _, law, x=rungs: np.sum(law * x), (-0.01, 0.0498))
    exact = found[881].price + found[881].grid_error
    for count in (56, 111):
        error = abs(found[count].price - exact)
        assert 0.4 * error < found[count].grid_error < 1.5 * error
    assert f"grid error about {found[56].grid_error:.2g}" in repr(found[56])


@pytest.mark.parametrize(
    ("fine", "coarse"),
    [
        (hjb.Grid([-1.0], [2.0], (7,)), (4,)),
        (hjb.Grid([-1.0, 0.0], [2.0, 1.0], (9, 8), stretch=(hjb.Sinh(2.0), None)), (5, 4)),
    ],
)
def test_a_law_of_a_coarse_grid_keeps_its_means(fine, coarse):
    rough = resized(fine, coarse)
    law = np.random.default_rng(1).random(coarse)
    moved = _shared_out(law, rough, fine)
    assert moved.shape == fine.shape
    assert moved.min() >= 0
    for f in (lambda x: 1.0 + 0 * x[..., 0], lambda x: x[..., 0], lambda x: x[..., -1]):
        np.testing.assert_allclose(np.sum(moved * f(fine.nodes())), np.sum(law * f(rough.nodes())), rtol=1e-12)


def test_a_law_on_a_circle_is_shared_out_across_the_seam():
    fine, rough = (hjb.Grid([0.0], [1.0], (count,), periodic=(True,)) for count in (4, 3))
    np.testing.assert_allclose(_shared_out(np.array([0.0, 0.0, 1.0]), rough, fine), [0, 0, 1 / 3, 2 / 3], atol=1e-15)


# --- derivatives ---


def price_of_capital(p):
    """The price of the firms' market as a function of four parameters, two of them outside of the problem."""
    demand, slope, cost, decay = p
    return hjb.equilibrium(lambda price: firm(price, cost, decay), LINE, clearing(demand, slope), (0.2, 2.5)).price


@pytest.mark.slow
def test_derivatives_of_a_price_in_both_modes_and_in_lanes():
    p = np.array([2.0, 1.0, 1.2, 0.9])
    steps = 1e-6 * np.eye(4)
    exact = [(exact_price(*(p + e), 1.0) - exact_price(*(p - e), 1.0)) / 2e-6 for e in steps]
    with jax.enable_x64(True):
        price, reverse = jax.jit(jax.value_and_grad(price_of_capital))(p)
        np.testing.assert_allclose(reverse, exact, rtol=1e-4)
        assert float(price) == pytest.approx(float(price_of_capital(p)), abs=1e-9)  # the search of the host
        np.testing.assert_allclose(jax.jacfwd(price_of_capital)(p), reverse, rtol=1e-7)
        lanes = jax.vmap(price_of_capital)(np.stack([p, 1.1 * p]))
        np.testing.assert_allclose(lanes, [price_of_capital(p), price_of_capital(1.1 * p)], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_derivative_of_an_interest_by_the_risk():
    def interest(sigma):
        return hjb.equilibrium(
            lambda r: household(r, sigma), HOUSEHOLDS, demand_for_bonds, (0.05, 0.17), tol=1e-9, solve_tol=1e-11
        ).price

    with jax.enable_x64(True):
        slope = jax.jacfwd(interest)(0.4)
    assert float(slope) == pytest.approx(float(interest(0.4001) - interest(0.3999)) / 2e-4, rel=1e-3)


@pytest.mark.slow
def test_a_bracket_without_a_root_is_nan_inside_a_program():
    def price(demand):
        return hjb.equilibrium(firm, LINE, clearing(demand, 1.0), (0.2, 2.5)).price

    with jax.enable_x64(True):
        assert np.isnan(jax.jit(price)(50.0))


# --- refusals ---


@pytest.mark.parametrize(
    ("changes", "kind", "reason"),
    [
        (
            {"bracket": (1.5, 2.5)},
            ValueError,
            r"excess is 0.25 at the price 1.5 and 1.75 at 2.5; wanted opposite signs",
        ),
        ({"bracket": (2.0, 1.0)}, ValueError, r"the bracket is \(2.0, 1.0\); wanted two finite prices lo < hi"),
        ({"bracket": 1.0}, ValueError, r"the bracket is 1.0; wanted two finite prices"),
        ({"problem_of": 3}, TypeError, "problem_of is 3; wanted a function"),
        ({"problem_of": lambda p: p}, TypeError, r"problem_of\(0.2\) returned 0.2, wanted a Problem"),
        ({"excess": lambda p, s, law: law}, TypeError, r"an array of shape \(41,\), wanted one real number"),
        ({"excess": lambda p, s, law: None}, TypeError, r"returned None, wanted one real number"),
        ({"excess": lambda p, s, law: np.nan}, ValueError, "the excess is nan at the price 0.2; wanted a number"),
        ({"tol": 0.0}, ValueError, "tol = 0.0; wanted a number > 0"),
        ({"solve_tol": -1.0}, ValueError, "solve_tol = -1.0; wanted a finite number > 0"),
    ],
)
def test_refusals(changes, kind, reason):
    given = {"problem_of": firm, "grid": LINE, "excess": clearing(2.0, 1.0), "bracket": (0.2, 2.5)} | changes
    with pytest.raises(kind, match=reason) as caught:
        hjb.equilibrium(**given)
    assert len(str(caught.value).splitlines()) <= 6
    assert str(caught.value).startswith("equilibrium: ")


def test_single_precision_inside_a_program_is_refused():
    with pytest.raises(ValueError, match="got 32-bit numbers inside jit"):
        jax.jit(lambda demand: hjb.equilibrium(firm, LINE, clearing(demand, 1.0), (0.2, 2.5)).price)(2.0)


def test_an_error_names_the_price_at_which_it_occurred():
    def unstable(price):  # without noise capital may rest at several nodes
        return hjb.Problem(lambda x, u: 0 * x + u, reward=lambda x, u: price * x[0], controls=hjb.Box([0.0], [0.0]),
                           discount=1.0)  # fmt: skip

    with pytest.raises(ValueError, match="41 recurrent classes") as caught:
        hjb.equilibrium(unstable, LINE, clearing(2.0, 1.0), (0.2, 2.5))
    assert "at the price 0.2" in caught.value.__notes__[0]
