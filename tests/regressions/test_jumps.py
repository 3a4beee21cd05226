"""Jumps of the state at random times, against dense dynamic programs in plain NumPy and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_jumps
from random_modes import CHAIN, METHODS, assert_certified
from scipy.linalg import expm
from scipy.special import factorial

import hjbjax as hjb
from hjbjax.feedback.simulation import rollout

pytestmark = pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
KINDS = {"noise": {}, "no noise": {"noise": False}, "landings that the control steers": {"steered": True}}


@pytest.mark.parametrize(
    ("kind", "count"),
    [("landings that the control steers", 1), pytest.param("noise", 1, marks=pytest.mark.slow)]
    + [pytest.param("no noise", 1, marks=pytest.mark.slow)]
    + [pytest.param(kind, 2, marks=pytest.mark.slow) for kind in KINDS],
)
def test_random_problems_agree_with_a_dense_dynamic_program(kind, count):
    for seed in range(3):
        one = random_jumps.draw(seed, count=count)
        exact = random_jumps.exact(one, **KINDS[kind])
        found = hjb.solve(random_jumps.problem(one, **KINDS[kind]), one.grid, scheme=CHAIN, tol=1e-8)
        assert found.value.shape == exact.shape
        assert_certified(found, exact, seed)
        assert found.error <= 1e-8
        assert np.max(np.abs(found.value - exact)) <= 1e-8, seed


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("shape", "count"), [((9,), 1), ((5, 6), 1), ((3, 4, 3), 1), ((4, 5), 3)])
def test_two_hundred_certificates_hold(kind, shape, count):
    for seed in range(17):
        one = random_jumps.draw(100 + seed, shape, count)
        exact = random_jumps.exact(one, **KINDS[kind])
        found = hjb.solve(random_jumps.problem(one, **KINDS[kind]), one.grid, scheme=CHAIN, tol=1e-5)
        assert_certified(found, exact, seed)
        assert found.error <= 1e-5, seed


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_every_method_finds_the_same_value(method):
    for seed, kind in enumerate(KINDS.values()):
        one = random_jumps.draw(seed, (5, 6))
        exact = random_jumps.exact(one, **kind)
        found = hjb.solve(random_jumps.problem(one, **kind), one.grid, scheme=CHAIN, tol=1e-7, method=method)
        assert np.max(np.abs(found.value - exact)) <= 1e-7


def test_a_batch_and_a_transformation_give_the_same_values():
    ones = [random_jumps.draw(seed) for seed in range(3)]
    problems, grid = [random_jumps.problem(one) for one in ones], ones[0].grid
    alone = [hjb.solve(each, grid, scheme=CHAIN, tol=1e-8).value for each in problems]
    together = [each.value for each in hjb.solve_batch(problems, grid, scheme=CHAIN, tol=1e-8)]
    assert np.allclose(together, alone, rtol=0, atol=2e-8)

    def value(discount):
        return hjb.solve(random_jumps.problem(ones[0], discount=discount), grid, scheme=CHAIN, tol=1e-8).value

    with jax.enable_x64(True):
        mapped = jax.vmap(value)(jnp.array([ones[0].base.discount, 0.7]))
    assert np.allclose(mapped[0], alone[0], rtol=0, atol=2e-8)
    assert np.allclose(mapped[1], random_jumps.exact(ones[0], discount=0.7), rtol=0, atol=2e-8)


def falling(rate, depth, **others):
    """A reserve that is filled at a price, and falls by a share at random times, which has a price too."""
    return hjb.Problem(
        lambda x, u: u - 0.1 * x,
        lambda x, u: (x[0] - 1.5) ** 2 + 0.5 * u @ u,
        hjb.Box([0.0], [1.0]),
        jumps=[hjb.Jump(rate, lambda x, u: (1 - depth) * x, cost=lambda x, u: 0.2 * x[0])],
        **({"discount": 0.5} | others),
    )


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [CHAIN, pytest.param(None, marks=pytest.mark.slow)], ids=["chain", "default"])
def test_derivatives_are_those_of_differences(scheme):
    grid = hjb.Grid([0.0], [2.0], (41,))

    def values(numbers):
        found = hjb.solve(falling(*numbers), grid, scheme=scheme, tol=1e-9).value
        return jnp.stack([found[3], found[20], found[37]])

    with jax.enable_x64(True):
        at = jnp.array([0.4, 0.313])
        forward, backward = jax.jacfwd(values)(at), jax.jacrev(values)(at)
        steps = 1e-5 * jnp.eye(2)
        differences = jnp.stack([(values(at + e) - values(at - e)) / 2e-5 for e in steps], axis=-1)
    assert np.allclose(forward, differences, rtol=1e-5)
    assert np.allclose(backward, forward, rtol=1e-9)


@pytest.mark.parametrize(
    "method", [hjb.Explicit(), pytest.param(hjb.Implicit(), marks=pytest.mark.slow)], ids=["explicit", "implicit"]
)
def test_a_march_without_choice_is_a_matrix_exponential(method):
    problem = hjb.Problem(
        lambda x, u: -0.5 * x, lambda x, u: x[0] ** 2, noise=0.3, discount=0.1, terminal_cost=lambda x: x[0],
        jumps=[hjb.Jump(0.8, lambda x, u: -0.9 * x, cost=0.4), hjb.Jump(lambda x, u: 1 + x[0], lambda x, u: x + 0.37)],
    )  # fmt: skip
    grid = hjb.Grid([-1.0], [1.0], (13,))
    found = hjb.march(problem, grid, 0.5, scheme=CHAIN, method=method, step=1e-4, times=[0.0, 0.5])
    generator = hjb.chain.generator(problem, grid, scheme=CHAIN).toarray()
    x = grid.axis(0)
    whole = np.zeros((14, 14))
    whole[:13, :13], whole[:13, 13] = generator - 0.1 * np.eye(13), x**2 + 0.8 * 0.4
    exact = (expm(0.5 * whole) @ np.append(x, 1.0))[:13]
    assert np.max(np.abs(found.value[0] - exact)) < 2e-3 * np.max(np.abs(exact))


def test_the_generator_has_the_rates_of_the_jumps():
    problem = hjb.Problem(
        lambda x, u: 0 * x, jumps=[hjb.Jump(2.0, lambda x, u: x + 1.25), hjb.Jump(3.0, lambda x, u: 0 * x)]
    )
    generator = hjb.chain.generator(problem, hjb.Grid([0.0], [4.0], (5,))).toarray()
    expected = np.zeros((5, 5))
    for i in range(5):  # beyond the upper end the jump lands on it
        for j, rate in zip((i + 1, i + 2), (1.5, 0.5), strict=True):
            expected[i, min(j, 4)] += rate
        expected[i, 0] += 3.0
        expected[i, i] -= 5.0
    assert np.allclose(generator, expected)


@pytest.mark.slow
def test_a_value_without_a_policy_has_a_box_error():
    problem = hjb.Problem(
        lambda x, u: -x, lambda x, u: x @ x, noise=0.4, discount=1.0, jumps=[hjb.Jump(0.5, lambda x, u: x / 2)]
    )
    grid = hjb.Grid([-1.0], [1.0], (11,))
    value, policy = (
        hjb.solve(problem, grid, scheme=CHAIN, tol=1e-6, method=hjb.ValueIteration(policy=each))
        for each in (False, True)
    )
    assert np.allclose(value.box_error, policy.box_error, atol=1e-5)


def test_a_periodic_jump_wraps():
    problem = hjb.Problem(lambda x, u: 0 * x, jumps=[hjb.Jump(1.0, lambda x, u: x - 2.5)])
    generator = hjb.chain.generator(problem, hjb.Grid([0.0], [4.0], (4,), (True,))).toarray()
    assert np.allclose(generator + np.eye(4), [[0, 0.5, 0.5, 0], [0, 0, 0.5, 0.5], [0.5, 0, 0, 0.5], [0.5, 0.5, 0, 0]])


@pytest.mark.slow
@pytest.mark.parametrize("beta", [0.3, 1.0])
def test_ruin_at_a_constant_rate_is_a_discount(beta):
    # a jump into the target at the rate λ: (β + λ) V = L + λ g
    problem = hjb.Problem(
        lambda x, u: 0 * x, lambda x, u: 2.0, discount=beta, target=lambda x: x[0] - 0.05, exit_cost=7.0,
        jumps=[hjb.Jump(0.25, lambda x, u: 0 * x, cost=1.0)],
    )  # fmt: skip
    found = hjb.solve(problem, hjb.Grid([0.0], [1.0], (11,)), tol=1e-10)
    assert np.allclose(found.value[1:], (2.0 + 0.25 * (7.0 + 1.0)) / (beta + 0.25), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_jump_is_the_only_way_to_a_target():
    # drift away from the target, without discount: E τ = 1/λ, and only the control u = 1 makes the jump possible
    problem = hjb.Problem(
        lambda x, u: 0.2 + 0 * x, lambda x, u: 1.0, hjb.Finite([[0.0], [1.0]]), target=lambda x: x[0] - 0.05,
        jumps=[hjb.Jump(lambda x, u: 0.5 * u[0], lambda x, u: 0 * x)],
    )  # fmt: skip
    grid = hjb.Grid([0.0], [1.0], (11,))
    assert np.allclose(hjb.solve(problem, grid, tol=1e-9).value[1:], 2.0, atol=1e-8)
    surely = hjb.expected_exit_time(problem, grid, lambda x: x[0] - 0.05)
    assert np.allclose(surely.value[1:], 2.0, atol=1e-6)


def test_a_jump_into_a_trap_is_a_value_of_infinity():
    # from the upper half the state may jump to a place that drift does not leave
    problem = hjb.Problem(
        lambda x, u: jnp.where(x > 3.4, 0.0, -1.0), lambda x, u: 1.0, target=lambda x: x[0] - 0.05,
        jumps=[hjb.Jump(lambda x, u: jnp.where(x[0] > 2.05, 0.5, 0.0), lambda x, u: 3.8 + 0 * x)],
    )  # fmt: skip
    found = hjb.solve(problem, hjb.Grid([0.0], [4.0], (41,)), scheme=CHAIN)
    assert np.all(np.isfinite(found.value[:21]))
    assert np.all(np.isinf(found.value[21:]))


@pytest.mark.slow
def test_linear_value_with_jumps_and_open_ends_is_exact():
    # β V = x + λ (V(x + 1) − V(x)) with V = x/β + λ/β²
    problem = hjb.Problem(
        lambda x, u: 0 * x, lambda x, u: x[0], discount=0.5, jumps=[hjb.Jump(0.3, lambda x, u: x + 1)]
    )
    exact = hjb.Grid([0.0], [3.0], (7,)).axis(0) / 0.5 + 0.3 / 0.25
    for edges in ("linear", ((hjb.Neumann(2.0), hjb.Neumann(2.0)),)):
        grid = hjb.Grid([0.0], [3.0], (7,), edges=edges)
        found = hjb.solve(problem, grid, scheme=CHAIN, tol=1e-10)
        assert np.allclose(found.value, exact, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_crash_lowers_the_share_of_a_fund_as_its_equation_says():
    # V is linear in the logarithm of wealth; 0.05 − 0.04 u = 0.1 · 0.3/(1 − 0.3 u)
    problem = hjb.Problem(
        lambda z, u: 0.02 + 0.05 * u - 0.02 * u**2, noise=lambda z, u: 0.2 * u, controls=hjb.Box([0.0], [3.0]),
        reward=lambda z, u: z[0], discount=0.1, jumps=[hjb.Jump(0.1, lambda z, u: z + jnp.log(1 - 0.3 * u))],
    )  # fmt: skip
    found = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (41,), edges="linear"))
    share = (0.055 - np.sqrt(0.055**2 - 4 * 0.012 * 0.02)) / 0.024
    growth = 0.02 + 0.05 * share - 0.02 * share**2 + 0.1 * np.log(1 - 0.3 * share)
    assert found.control_at([0.0])[0] == pytest.approx(share, abs=1e-6)
    assert found.value_at([0.0]) == pytest.approx(growth / 0.1**2, rel=1e-9)


@pytest.mark.slow
def test_the_probability_of_ruin_is_that_of_erlang():
    # claims of size one at the rate λ, premiums at the rate c: the ladder formula for the probability of survival
    rate, premium, top = 0.5, 0.7, 6.0

    def survival(x):
        k = np.arange(int(x + 1e-12) + 1)
        q = rate / premium * (k - x)
        return np.sum(q**k / factorial(k) * np.exp(-q))

    problem = hjb.Problem(lambda x, u: premium + 0 * x, jumps=[hjb.Jump(rate, lambda x, u: x - 1.0)])
    errors = []
    for count in (131, 261):
        grid = hjb.Grid([-0.5], [top], (count,))
        half = grid.spacing(0) / 2
        found = hjb.reach_probability(problem, grid, lambda x: x[0] + half, obstacle=lambda x: top - half / 2 - x[0])  # noqa: B023
        x = grid.axis(0)
        exact = [1 - survival(each) / survival(top) if each >= 0 else 1 for each in x + 1e-12]
        errors.append(np.max(np.abs(found.value - exact)))
    assert errors[0] < 0.009
    assert errors[1] < 0.55 * errors[0]


def test_a_path_jumps_pays_and_ends_in_the_target():
    problem = hjb.Problem(
        lambda x, u: 0.1 + 0 * x, lambda x, u: 1.0, target=lambda x: x[0] - 0.5,
        jumps=[hjb.Jump(3.0, lambda x, u: 0 * x, cost=5.0)],
    )  # fmt: skip
    path = hjb.simulate(problem, None, [2.0], 50.0, key=2)
    assert path.status.name == "TARGET"
    assert path.states[-1] == 0
    assert path.states[-2] == pytest.approx(2.0 + 0.1 * path.times[-2], abs=1e-6)
    assert path.cost == pytest.approx(path.reached + 5.0, abs=1e-6)
    grid = hjb.Grid([1.0], [3.0], (21,))
    away = hjb.Problem(lambda x, u: 0 * x, jumps=[hjb.Jump(3.0, lambda x, u: x + 9)])
    with pytest.warns(UserWarning, match="left the box"):
        left = hjb.simulate(away, None, [2.0], 50.0, key=2, grid=grid)
    assert left.status.name == "LEFT_BOX"


def mean_cost(problem, found, start, **others):
    """The mean cost of 300 paths of length 16 and three standard errors."""
    times = jnp.linspace(0.0, 16.0, 9)

    def cost(key):
        return rollout(problem, found, jnp.array(start), times, key=key, clamp=True, **others).cost

    costs = jax.jit(jax.vmap(cost))(jax.random.split(jax.random.key(0), 300))
    return float(np.mean(costs)), 3 * float(np.std(costs)) / np.sqrt(300)


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize("depth", [0.2, 0.6])
def test_paths_cost_what_the_value_promises_in_the_mean(depth):
    problem = falling(0.7, depth)
    found = hjb.solve(problem, hjb.Grid([0.0], [2.0], (201,)))
    mean, spread = mean_cost(problem, found, [1.2])
    assert abs(mean - found.value_at([1.2])) <= spread + 0.002 * np.ptp(found.value)


def test_mistakes_are_refused():
    still, line = lambda x, u: 0 * x, hjb.Grid([0.0], [1.0], (5,))
    with pytest.raises(TypeError, match=r"wanted a list, as in \[hjb.Jump"):
        hjb.Problem(still, jumps=hjb.Jump(1.0, still))
    with pytest.raises(ValueError, match="finite number ≥ 0"):
        hjb.Jump(-1.0, still)
    with pytest.raises(TypeError, match="the state after the jump"):
        hjb.Jump(1.0, 0.5)

    def solve(*arguments, grid=line):
        return hjb.solve(hjb.Problem(still, discount=1.0, jumps=[hjb.Jump(*arguments)]), grid)

    with pytest.raises(ValueError, match=r"Problem.jumps\[0\].landing: landing\(x, u\) returned shape \(2,\)"):
        solve(1.0, lambda x, u: jnp.zeros(2))
    with pytest.raises(ValueError, match=r"Jump.rate\(x, u\) is negative at 2 of 5 nodes"):
        solve(lambda x, u: x[0] - 0.5, still)
    with pytest.raises(ValueError, match=r"Jump.landing\(x, u\) is NaN or infinite"):
        solve(1.0, lambda x, u: 1 / x)
    with pytest.raises(ValueError, match="across a constrained"):
        solve(1.0, lambda x, u: x + 0.5, grid=hjb.Grid([0.0], [1.0], (5,), edges="constrained"))
    with pytest.raises(ValueError, match="a problem with jumps"):
        hjb.solve(hjb.Problem(still, discount=1.0, jumps=[hjb.Jump(1.0, still)]), line, scheme=hjb.SemiLagrangian())
    with pytest.raises(ValueError, match="which this function does not take"):
        hjb.pontryagin(falling(1.0, 0.5), [0.0], horizon=1.0)


def test_files_and_costs_in_rewards(tmp_path):
    costs = falling(0.4, 0.3)
    rewards = hjb.Problem(
        costs.drift,
        controls=costs.controls,
        discount=0.5,
        reward=lambda x, u: -costs.cost(x, u),
        jumps=list(costs.jumps),
    )
    grid = hjb.Grid([0.0], [2.0], (21,))
    spent, earned = (hjb.solve(each, grid, scheme=CHAIN, tol=1e-9) for each in (costs, rewards))
    assert np.allclose(earned.value, -spent.value, rtol=0, atol=1e-8)  # the cost of a jump is subtracted
    assert earned.problem is rewards
    spent.save(tmp_path / "jumps.npz")
    assert np.array_equal(hjb.load(tmp_path / "jumps.npz").value, spent.value)


@pytest.mark.slow
def test_rewards_of_jumps_are_minus_costs():
    grid, sale = hjb.Grid([0.0], [2.0], (21,)), {"controls": hjb.Box([0.0], [1.0]), "discount": 0.5}
    drift, land = lambda x, u: u - 0.1 * x, lambda x, u: 0.5 * x
    costs = hjb.Problem(drift, lambda x, u: u[0] ** 2, jumps=[hjb.Jump(0.6, land, lambda x, u: -3 * x[0])], **sale)
    rewards = hjb.Problem(
        drift, reward=lambda x, u: -(u[0] ** 2), jumps=[hjb.Jump(0.6, land, reward=lambda x, u: 3 * x[0])], **sale
    )
    spent, earned = (hjb.solve(each, grid, scheme=CHAIN, tol=1e-9).value for each in (costs, rewards))
    assert np.max(earned) > 1
    assert np.allclose(earned, -spent, rtol=0, atol=1e-8)
    only = hjb.Problem(drift, jumps=[hjb.Jump(0.6, land, reward=1.0)], **sale)
    assert np.allclose(hjb.solve(only, grid, scheme=CHAIN, tol=1e-9).value, 0.6 / 0.5, rtol=0, atol=1e-8)
    with pytest.raises(ValueError, match="both cost and reward"):
        hjb.Jump(1.0, land, 1.0, reward=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("change", ["discount", "controls"])
def test_a_discount_and_bounds_of_the_state_that_are_constant_change_nothing(change):
    grid, plain = hjb.Grid([0.0], [2.0], (21,)), falling(0.4, 0.3)
    others = {"discount": 0.5, "controls": plain.controls}
    others[change] = {"discount": lambda x: 0.5 + 0 * x[0], "controls": lambda x: hjb.Box(0 * x, 1 + 0 * x)}[change]
    problem = hjb.Problem(plain.drift, plain.cost, jumps=list(plain.jumps), **others)
    first, second = (hjb.solve(each, grid, scheme=CHAIN, tol=1e-9).value for each in (plain, problem))
    assert np.allclose(first, second, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_dividends_of_an_insurer_are_those_of_the_best_barrier():
    # claims of one size; dividends at once; every barrier is one linear system, and the best is found by trying all
    premium, spread, rate, claim, beta = 0.8, 0.3, 0.4, 0.7, 0.1
    problem = hjb.Problem(
        lambda x, u: premium + 0 * x, noise=spread, discount=beta, target=lambda x: x[0] - 1e-9, exit_reward=0.0,
        pushes=[hjb.Push([-1.0], reward=1.0)], jumps=[hjb.Jump(rate, lambda x, u: x - claim, cost=0.1)],
    )  # fmt: skip
    grid = hjb.Grid([0.0], [4.0], (201,))
    found = hjb.solve(problem, grid, scheme=CHAIN, tol=1e-7)
    x, h, n = grid.axis(0), grid.spacing(0), 201
    below = np.minimum((np.maximum(x - claim, 0) / h + 1e-9).astype(int), n - 2)
    share = (np.maximum(x - claim, 0) - x[below]) / h
    best, chosen = -np.inf, 0
    for barrier in range(20, 180):
        matrix, right = np.eye(n), np.where(np.arange(n) > barrier, h, 0.0)
        for i in range(1, n):
            if i > barrier:
                matrix[i, i - 1] = -1.0
                continue
            up, down = premium / h + spread**2 / (2 * h**2), spread**2 / (2 * h**2)
            matrix[i, i - 1 : i + 2] = -down, beta + rate + up + down, -up
            matrix[i, below[i]] -= rate * (1 - share[i])
            matrix[i, below[i] + 1] -= rate * share[i]
            right[i] = -rate * 0.1
        value = np.linalg.solve(matrix, right)
        if value[100] > best:
            best, chosen, exact = value[100], barrier, value
    assert np.max(np.abs(found.value - exact)) <= 1e-6
    assert found.free_boundary()[0] == pytest.approx(x[chosen], abs=h)
    assert found.box_error is None  # nothing is assumed beyond the target, nor where the reserve is paid out


def test_a_rate_that_is_zero_up_to_rounding_is_not_negative():
    # 0.3 − 0.2 − 0.1 = −3e-17 under one action
    problem = hjb.Problem(
        lambda x, u: 0 * x, lambda x, u: x[0] + u[0] ** 2, hjb.Finite([[-0.1], [0.0]]), discount=1.0,
        jumps=[hjb.Jump(lambda x, u: 0.3 - 0.2 + u[0], lambda x, u: 0 * x)],
    )  # fmt: skip
    assert hjb.solve(problem, hjb.Grid([0.0], [1.0], (5,)), scheme=CHAIN).status.name == "CONVERGED"
