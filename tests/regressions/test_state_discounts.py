"""Discounts that are functions of the state: mortality, hazard and short rates."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from line_problems import dense, draw, positive, wave
from scipy.integrate import solve_bvp

import hjbjax as hjb

GRID = hjb.Grid([-2.0], [2.0], (31,))
BOX = hjb.Box([-1.0], [1.0])
CHAIN = hjb.Upwind(central=False)
X = GRID.axis(0)


def steer(x, u):
    return u - 0.3 * x


def paid(x, u):
    return (x[0] - 0.5) ** 2 + 0.5 * u[0] ** 2


def mortal(x):
    return 0.3 + 0.5 * x[0] ** 2


def line_problem(line, rewards):
    """The problem of a line with constant bounds."""
    a, b, q, beta, w = line.a, line.b, line.q, line.beta, line.w

    def cost(x, u):
        return wave(q, x[0], jnp) + w * u[0] ** 2

    paid = {"reward": lambda x, u: -cost(x, u)} if rewards else {"cost": cost}
    return hjb.Problem(
        lambda x, u: wave(a, x, jnp) + wave(b, x, jnp) * u, controls=hjb.Box([line.lo[0]], [line.hi[0]]),
        noise=line.s, discount=lambda x: positive(beta, x[0], jnp), **paid,
    )  # fmt: skip


@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
@pytest.mark.parametrize("rewards", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["costs", "rewards"])
def test_random_problems_agree_with_dense_linear_algebra_and_bounds_hold(rewards):
    for seed in range(15):
        line = draw(seed + 100 * rewards)
        exact, _ = dense(line, X, lo=line.lo[0], hi=line.hi[0])
        exact = -exact if rewards else exact
        found = hjb.solve(line_problem(line, rewards), GRID, scheme=CHAIN, tol=1e-6, progress=False)
        lower, upper = found.bounds
        slack = 1e-11 * (1 + np.max(np.abs(exact)))
        assert np.all(lower - slack <= exact), seed
        assert np.all(exact <= upper + slack), seed
        assert np.max(np.abs(found.value - exact)) <= found.error + slack, seed
        assert found.error <= 1e-6


@pytest.mark.slow
def test_a_constant_function_is_the_number():
    number, function = (
        hjb.solve(hjb.Problem(steer, paid, BOX, noise=0.4, discount=each), GRID, scheme=CHAIN)
        for each in (0.5, lambda x: 0.5 + 0 * x[0])
    )
    assert np.allclose(number.value, function.value, rtol=1e-12)
    assert np.allclose(number.policy, function.policy, rtol=1e-10)
    assert callable(function.problem.discount)


def test_a_number_compiles_to_the_program_that_it_had():
    """The discount of a problem with a number is a leaf, and no function of the state is in the program."""
    problem = hjb.Problem(steer, paid, BOX, discount=0.5)
    assert problem.killing is None
    assert jax.tree.leaves(problem)[-1] == 0.5
    assert jax.tree.structure(problem) == jax.tree.structure(dataclasses.replace(problem, discount=0.7))


def perpetuity(grid, **more):
    """A console that pays one per unit time while the short rate follows Vasicek's equation, reflected at the ends."""
    return hjb.Problem(
        lambda r, u: 0.5 * (0.05 - r), reward=lambda r, u: 1.0 + 0 * r[0], noise=0.01, discount=lambda r: r[0], **more
    )


@pytest.mark.slow
def test_a_perpetuity_under_vasiceks_short_rate_solves_its_ode():
    grid = hjb.Grid([0.02], [0.08], (121,))
    found = hjb.solve(perpetuity(grid), grid)

    def ode(r, y):
        return np.stack([y[1], 2 / 0.01**2 * (r * y[0] - 1 - 0.5 * (0.05 - r) * y[1])])

    nodes = grid.axis(0)
    guess = np.stack([np.full(121, 20.0), np.zeros(121)])
    exact = solve_bvp(ode, lambda a, b: np.array([a[1], b[1]]), nodes, guess, tol=1e-8).sol(nodes)[0]
    assert np.max(np.abs(found.value - exact)) < 2e-3 * 20
    assert np.max(np.abs(found.value - exact)) <= 3 * np.max(found.grid_error) + 1e-3


@pytest.mark.slow
def test_a_decaying_stock_under_mortality_in_closed_form():
    """x' = −x/2 with utility x: V(x) = ∫ x e^{−t/2} exp(−ρ t − s x² (1 − e^{−t})) dt."""
    rho, slope = 0.1, 0.2
    problem = hjb.Problem(lambda x, u: -0.5 * x, reward=lambda x, u: x[0], discount=lambda x: rho + slope * x[0] ** 2)
    found = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (201,)))
    t = np.linspace(0, 60, 60001)
    at = np.array([-0.8, 0.3, 1.0])
    weights = np.exp(-0.5 * t - rho * t - slope * at[:, None] ** 2 * (1 - np.exp(-t)))
    exact = at * np.sum((weights[:, 1:] + weights[:, :-1]) / 2, axis=1) * (t[1] - t[0])
    assert np.allclose(found.value_at(at[:, None]), exact, atol=2e-3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_consumption_under_mortality_in_closed_form():
    """Log utility under mortality β(z) at the age z: the share 1/B(z) of the wealth is consumed, B' = β B − 1.

    At the largest age the age stays, so that B = 1/β there. The states are the age and the logarithm of the wealth.
    """
    ages = np.linspace(0, 10, 81)
    problem = hjb.Problem(
        lambda x, u: jnp.stack([1.0 + 0 * u[0], 0.03 - u[0]]), controls=hjb.Box([0.05], [0.5]),
        reward=lambda x, u: jnp.log(u[0]) + x[1], discount=lambda x: 0.1 + 0.02 * x[0],
    )  # fmt: skip
    grid = hjb.Grid([0.0, -1.0], [10.0, 1.0], (81, 11), edges=("projected", "open"))
    found = hjb.solve(problem, grid)
    fine = np.linspace(10, 0, 100001)
    b = np.empty_like(fine)
    b[0] = 1 / 0.3
    for k in range(100000):  # backwards in the age
        b[k + 1] = b[k] - (fine[0] - fine[1]) * ((0.1 + 0.02 * fine[k]) * b[k] - 1)
    exact = 1 / np.interp(ages, fine[::-1], b[::-1])
    assert np.max(np.abs(found.policy[:, 5, 0] - exact)) < 2e-3
    assert np.max(exact) - np.min(exact) > 0.08  # the old consume a larger share


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_marches_discount_by_the_state_and_the_time():
    """A bond under a short rate that is frozen: V = exp(−r T); negative rates are allowed; also β(t, x)."""
    grid = hjb.Grid([-0.5], [0.5], (11,))
    bond = hjb.Problem(lambda r, u: 0 * r, discount=lambda r: r[0], terminal_reward=1.0)
    for method, step, close in ((None, None, 1e-4), (hjb.Implicit(), 0.01, 4e-3)):
        found = hjb.march(bond, grid, 1.0, method=method, step=step)
        assert np.allclose(found.value[0], np.exp(-grid.axis(0)), atol=close)
        assert callable(found.problem.discount)
    moving = hjb.Problem(lambda t, r, u: 0 * r, discount=lambda t, r: r[0] * t, terminal_cost=1.0, time_dependent=True)
    assert np.allclose(hjb.march(moving, grid, 1.0).value[0], np.exp(-grid.axis(0) / 2), atol=1e-3)
    slope = jax.grad(lambda a: hjb.march(
        hjb.Problem(lambda r, u: 0 * r, discount=lambda r: a + r[0], terminal_cost=1.0), grid, 1.0, step=0.01
    ).value[0, 5])(0.3)  # fmt: skip
    assert float(slope) == pytest.approx(-np.exp(-0.3), abs=1e-3)


@pytest.mark.slow
def test_derivatives_with_respect_to_the_numbers_of_the_discount():
    def value(a):
        problem = hjb.Problem(steer, paid, BOX, discount=lambda x: a + 0.5 * x[0] ** 2)
        return hjb.solve(problem, GRID, scheme=CHAIN, tol=1e-6).value[4]

    assert float(jax.grad(value)(0.3)) == pytest.approx((value(0.301) - value(0.299)) / 0.002, rel=1e-3)
    lanes = jax.vmap(value)(jnp.array([0.3, 0.4]))
    assert np.allclose(lanes, [value(0.3), value(0.4)], atol=1e-5)
    with pytest.raises(jax.errors.JaxRuntimeError, match="NaN"):  # negative somewhere
        jax.jit(value)(-0.5)


def test_a_batch_holds_numbers_and_functions():
    problems = [hjb.Problem(steer, paid, BOX, noise=0.4, discount=each) for each in (0.5, lambda x: 0.5 + 0 * x[0])]
    number, function = hjb.solve_batch(iter(problems), GRID, scheme=CHAIN)
    assert np.allclose(number.value, function.value, rtol=1e-12)
    assert function.problem is problems[1]
    with pytest.raises(hjb.SolveError) as stopped:
        hjb.solve_batch(problems, GRID, scheme=CHAIN, tol=1e-14, max_steps=1)
    assert stopped.value.solutions[1].problem is problems[1]


@pytest.mark.slow
@pytest.mark.parametrize("rewards", [False, True], ids=["costs", "rewards"])
def test_a_path_is_discounted_by_the_integral_along_it(rewards):
    given = {"reward": lambda x, u: -paid(x, u)} if rewards else {"cost": paid}
    problem = hjb.Problem(steer, controls=BOX, discount=mortal, **given)
    found = hjb.solve(problem, hjb.Grid([-2.0], [2.0], (161,)))
    path = hjb.simulate(problem, found, [1.5], 30.0)
    total = path.reward if rewards else path.cost
    assert path.states.shape == (201, 1)
    assert total == pytest.approx(path.promised, abs=0.01)
    assert hjb.simulate(problem, found, [1.5], 1.0).status.name == "DURATION"  # V promises the rest, without a warning
    # x' = −x: ∫ x² e^{−∫ (0.3 + 0.5 x²)} dt
    alone = hjb.Problem(lambda x, u: -x, lambda x, u: x[0] ** 2, discount=mortal, terminal_cost=2.0)
    t = np.linspace(0, 3, 30001)
    weights = np.exp(-0.3 * t - 0.25 * (1 - np.exp(-2 * t)))
    running = np.exp(-2 * t) * weights
    exact = np.sum((running[1:] + running[:-1]) / 2) * t[1] + 2 * weights[-1]
    assert hjb.simulate(alone, None, [1.0], 3.0).cost == pytest.approx(exact, rel=1e-5)


@pytest.mark.slow
def test_the_chain_counts_its_own_time_so_one_factor_serves_all_states():
    actions = hjb.Finite([[-1.0], [0.0], [1.0]])
    problem = hjb.Problem(steer, paid, actions, noise=0.4, discount=mortal)
    costs, moves, _, _, factor = hjb.chain.transition_arrays(problem, GRID, scheme=CHAIN)
    value = np.zeros(GRID.size)
    for _ in range(2000):
        value = np.min((costs + factor * (moves @ value)).reshape(-1, 3), axis=1)
    found = hjb.solve(problem, GRID, scheme=CHAIN, tol=1e-8)
    assert np.allclose(found.value, value, atol=1e-6)
    generator = hjb.chain.generator(problem, GRID, found.policy)
    plain = hjb.chain.generator(dataclasses.replace(problem, discount=1.0), GRID, found.policy)
    assert np.array_equal(generator.toarray(), plain.toarray())  # in the time of the system


@pytest.mark.parametrize(
    ("discount", "said"),
    [
        (lambda x: x[0], r"discount\(x\) is -2 at x = \[-2.0\], the first of 16 nodes"),
        (lambda x: jnp.where(x[0] > 1, jnp.nan, 1.0), r"discount\(x\) is nan"),
        (lambda x: jnp.abs(x[0]) + jnp.where(x[0] < 0, jnp.inf, 0.0), r"discount\(x\) is inf"),
        (lambda x: x, r"discount\(x\) returned shape \(1,\), expected \(\)"),
        (lambda x, u: 1.0, r"discount does not take the arguments that the problem passes, discount\(x\)"),
        (lambda x: "much", r"discount\(x\) returned 'much'"),
    ],
)
def test_a_discount_that_is_not_positive_or_not_a_number_is_refused(discount, said):
    with pytest.raises(ValueError, match=said):
        hjb.solve(hjb.Problem(steer, paid, BOX, discount=discount), GRID)


def test_what_needs_a_number_says_so():
    problem = hjb.Problem(steer, paid, BOX, discount=mortal)
    with pytest.raises(ValueError, match="pontryagin: got a discount that is a function"):
        hjb.pontryagin(problem, [1.0])
    with pytest.raises(ValueError, match="running_max"):
        hjb.Problem(steer, None, BOX, running_max=lambda x: x[0], discount=mortal)
    moving = hjb.Problem(lambda t, x, u: u, controls=BOX, discount=lambda t, x: 1.0 + t, time_dependent=True)
    with pytest.raises(ValueError, match="time-dependent problem has no stationary value"):
        hjb.solve(moving, GRID)
    assert hjb.estimate(problem, GRID, measure=False).fits
