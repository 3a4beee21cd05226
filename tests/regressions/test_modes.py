"""Modes: systems that switch at random or by choice, against dense dynamic programs in plain NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_modes
from random_modes import CHAIN, METHODS, NAMES, assert_certified
from scipy.linalg import expm

import hjbjax as hjb
from hjbjax.feedback.simulation import rollout
from hjbjax.problem.mode_axis import with_modes

pytestmark = pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
LINE = hjb.Grid([-2.0], [2.0], (41,))
KINDS = {
    "random changes": {"switching": False},
    "changes by choice": {"rates": False},
    "both": {},
    "both, without noise": {"noise": False},
    "rates that the control steers": {"steered": True},
}


QUICK = ("both",)


@pytest.mark.parametrize(
    "kind", [*QUICK, *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS if kind not in QUICK)]
)
def test_random_problems_agree_with_a_dense_dynamic_program(kind):
    for seed in range(6):
        one = random_modes.draw(seed)
        exact, choices = random_modes.exact(one, **KINDS[kind])
        found = hjb.solve(random_modes.problem(one, **KINDS[kind]), one.grid, scheme=CHAIN, tol=1e-8)
        assert found.value.shape == (2, 7)
        assert found.policy.shape == (2, 7, 1)
        assert_certified(found, exact, seed)
        assert found.error <= 1e-8
        assert np.max(np.abs(found.value - exact)) <= 1e-8, seed
        if KINDS[kind].get("switching", True):
            own = np.arange(2)[:, None] + 0 * choices
            assert np.array_equal(found.switching, np.where(choices < 0, -1 - choices, own)), seed


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("shape", "count"), [((9,), 3), ((5, 6), 2), ((4, 5), 4), ((3, 4, 3), 2)])
def test_five_hundred_certificates_hold(kind, shape, count):
    for seed in range(25):
        one = random_modes.draw(100 + seed, shape, count)
        exact, _ = random_modes.exact(one, **KINDS[kind])
        found = hjb.solve(random_modes.problem(one, **KINDS[kind]), one.grid, scheme=CHAIN, tol=1e-5)
        assert_certified(found, exact, seed)
        assert found.error <= 1e-5, seed


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_every_method_finds_the_same_value(method):
    for seed, kind in enumerate(KINDS.values()):
        one = random_modes.draw(seed, (5, 6), 3)
        exact, _ = random_modes.exact(one, **kind)
        found = hjb.solve(random_modes.problem(one, **kind), one.grid, scheme=CHAIN, tol=1e-7, method=method)
        assert np.max(np.abs(found.value - exact)) <= 1e-7


@pytest.mark.slow
def test_a_batch_and_a_transformation_give_the_same_values():
    ones = [random_modes.draw(seed) for seed in range(3)]
    problems = [random_modes.problem(one) for one in ones]
    grid = ones[0].grid
    alone = [hjb.solve(each, grid, scheme=CHAIN, tol=1e-8).value for each in problems]
    together = [each.value for each in hjb.solve_batch(problems, grid, scheme=CHAIN, tol=1e-8)]
    assert np.allclose(together, alone, rtol=0, atol=2e-8)

    def value(discount):
        return hjb.solve(random_modes.problem(ones[0], discount=discount), grid, scheme=CHAIN, tol=1e-8).value

    with jax.enable_x64(True):
        discounts = jnp.array([ones[0].discount, 0.7])
        mapped = jax.vmap(value)(discounts)
    assert np.allclose(mapped[0], alone[0], rtol=0, atol=2e-8)
    other, _ = random_modes.exact(ones[0], discount=0.7)
    assert np.allclose(mapped[1], other, rtol=0, atol=2e-8)


def plant(rates, price=0.9, **others):
    """A leaking tank in one mode and an unstable one in the other; leaving the second has a price."""
    return hjb.Problem(
        lambda x, u, mode: u - (0.3, -0.4)[mode] * x,
        lambda x, u, mode: (1 + mode) * (x @ x) + 0.1 * u @ u,
        hjb.Box([-1.0], [1.0]),
        modes=hjb.Modes(("calm", "wild"), rates=rates, switching_cost=jnp.array([[0.0, jnp.inf], [price, 0.0]])),
        **({"discount": 0.5} | others),
    )


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [CHAIN, pytest.param(None, marks=pytest.mark.slow)], ids=["chain", "default"])
def test_derivatives_are_those_of_differences(scheme):
    def values(rate):
        table = jnp.array([[0.0, 1.0], [0.0, 0.0]]) * rate + jnp.array([[0.0, 0.0], [0.8, 0.0]])
        found = hjb.solve(plant(table, 0.4 + rate), LINE, scheme=scheme, tol=1e-9).value
        return jnp.stack([found[1, 30], found[0, 30], found[1, 38]])  # the first node changes the mode

    with jax.enable_x64(True):
        forward, backward = jax.jacfwd(values)(0.5), jax.jacrev(values)(0.5)
        differences = (values(0.5 + 1e-5) - values(0.5 - 1e-5)) / 2e-5
    assert np.allclose(forward, differences, rtol=1e-6)
    assert np.allclose(backward, forward, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [hjb.Explicit(), pytest.param(hjb.Implicit(), marks=pytest.mark.slow)], ids=["explicit", "implicit"]
)
def test_a_march_without_choice_is_a_matrix_exponential(method):
    rates = np.array([[0.0, 0.7, 0.2], [0.0, 0.0, 1.5], [0.4, 0.3, 0.0]])
    problem = hjb.Problem(
        lambda x, u, mode: (0.2, -0.5, 0.1)[mode] * x,
        lambda x, u, mode: (1.0, 0.0, 2.0)[mode] + x[0] ** 2,
        noise=lambda x, u, mode: (0.3, 0.0, 0.6)[mode],
        modes=hjb.Modes(NAMES[:3], rates=rates),
        terminal_cost=lambda x, mode: x[0] * (mode - 1.0),
        discount=0.1,
    )
    grid = hjb.Grid([-1.0], [1.0], (13,))
    found = hjb.march(problem, grid, 0.5, scheme=CHAIN, method=method, step=1e-4, times=[0.0, 0.5])
    generator = hjb.chain.generator(problem, grid, scheme=CHAIN).toarray()
    x = grid.axis(0)
    paid = np.concatenate([base + x**2 for base in (1.0, 0.0, 2.0)])
    last = np.concatenate([x * (mode - 1.0) for mode in range(3)])
    whole = np.zeros((40, 40))
    whole[:39, :39], whole[:39, 39] = generator - 0.1 * np.eye(39), paid
    exact = (expm(0.5 * whole) @ np.append(last, 1.0))[:39].reshape(3, 13)
    assert np.max(np.abs(found.value[0] - exact)) < 2e-3 * np.max(np.abs(exact))
    assert np.allclose(found.value[-1].ravel(), last)


def test_the_generator_has_the_rates_of_the_modes():
    one = random_modes.draw(3)
    policy = np.full((2, 7, 1), one.actions[1])
    generator = hjb.chain.generator(random_modes.problem(one, switching=False), one.grid, policy).toarray()
    assert np.allclose(np.diag(generator[:7, 7:]), one.rates[0, 1])
    assert np.allclose(np.diag(generator[7:, :7]), one.rates[1, 0])
    assert np.allclose(generator.sum(axis=1), 0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("price", [0.3, 1.0, 3.0])
def test_a_machine_that_fails_is_a_two_state_chain(price):
    # nothing moves: β V_i = L_i + λ_ij (V_j − V_i), and a repair by choice costs c
    fails, mends, beta = 0.2, 0.5, 0.1
    modes = hjb.Modes(("works", "broken"), rates=[[0, fails], [mends, 0]])
    problem = hjb.Problem(lambda x, u, mode: 0 * x, lambda x, u, mode: 1.0 * mode, discount=beta, modes=modes)
    grid = hjb.Grid([0.0], [1.0], (3,))
    matrix = np.array([[beta + fails, -fails], [-mends, beta + mends]])
    exact = np.linalg.solve(matrix, [0.0, 1.0])
    assert np.allclose(hjb.solve(problem, grid, tol=1e-10).value, exact[:, None], rtol=0, atol=1e-9)
    bought = hjb.Modes(("works", "broken"), rates=[[0, fails], [mends, 0]], switching_cost=[[0, np.inf], [price, 0]])
    found = hjb.solve(altered(problem, bought), grid, tol=1e-10)
    repaired = fails * price / beta  # V_0 with V_1 = V_0 + c: β V_0 = λ c
    cheaper = repaired < exact[0]
    expected = [repaired, repaired + price] if cheaper else exact
    assert cheaper == (price < 1.2)
    assert np.allclose(found.value, np.transpose([expected]), rtol=0, atol=1e-9)
    assert np.all(found.switching == [[0], [0 if cheaper else 1]])


def altered(problem, modes):
    return hjb.Problem(
        problem.drift, problem.cost, problem.controls, discount=problem.discount, modes=modes, target=problem.target
    )


@pytest.mark.slow
def test_rewards_are_minus_costs_and_switching_costs_are_paid_from_them():
    one = random_modes.draw(1)
    costs = random_modes.problem(one)
    rewards = hjb.Problem(
        costs.drift, controls=costs.controls, noise=costs.noise, discount=costs.discount, modes=costs.modes,
        reward=lambda x, u, mode: -costs.cost(x, u, mode),
    )  # fmt: skip
    spent, earned = (hjb.solve(each, one.grid, scheme=CHAIN, tol=1e-8) for each in (costs, rewards))
    assert np.allclose(earned.value, -spent.value, rtol=0, atol=2e-8)
    assert np.array_equal(earned.switching, spent.switching)
    assert earned.problem is rewards


def test_discounts_and_bounds_depend_on_the_mode():
    # a constant cost L_i at a rate β_i(x) without motion: V = L/β, coupled by the changes
    rate = np.array([[0, 0.3], [0.6, 0]])
    problem = hjb.Problem(
        lambda x, u, mode: 0 * x + 0 * u,
        lambda x, u, mode: u[0] * (1.0 + mode),
        lambda x, mode: hjb.Box(1.0 + mode + 0 * x, 5.0 + 0 * x),
        discount=lambda x, mode: (0.1, 0.4)[mode] + 0.05 * x[0] ** 2,
        modes=hjb.Modes(("a", "b"), rates=rate),
    )
    found = hjb.solve(problem, LINE, scheme=CHAIN, tol=1e-8)
    for x, value, u in zip(LINE.axis(0), found.value.T, found.policy[..., 0].T, strict=True):
        beta = np.array([0.1, 0.4]) + 0.05 * x**2
        matrix = np.diag(beta + rate.sum(axis=1)) - rate
        assert np.allclose(value, np.linalg.solve(matrix, [1.0, 4.0]), rtol=0, atol=2e-8)
        assert u.tolist() == [1.0, 2.0]


def test_a_target_is_reached_by_changing_the_mode():
    # in the first mode the state stands still, in the second it moves left; only the second reaches the target
    problem = hjb.Problem(
        lambda x, u, mode: (0.0, -1.0)[mode] + 0 * x,
        lambda x, u, mode: 1.0,
        target=lambda x, mode: x[0] + 2.0,
        modes=hjb.Modes(("park", "drive"), switching_cost=[[0, 0.25], [0.1, 0]]),
    )
    found = hjb.solve(problem, LINE, scheme=CHAIN, tol=1e-9)
    x = LINE.axis(0)
    assert np.allclose(found.value[1], x + 2, atol=1e-9)
    assert np.allclose(found.value[0, 1:], x[1:] + 2.25, atol=1e-9)
    assert np.all(found.switching[0, 1:] == 1)
    assert np.all(found.switching[1] == 1)


@pytest.mark.slow
def test_a_game_with_modes():
    def drift(x, u, d, mode):
        return u + (0.5, 0.2)[mode] * d

    problem = hjb.Problem(
        drift, lambda x, u, d, mode: x @ x + (1 + mode) * u @ u, hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.0], [1.0]), discount=0.5, modes=hjb.Modes(("weak", "strong"), rates=[[0, 1], [2, 0]]),
    )  # fmt: skip
    found = hjb.solve(problem, LINE, scheme=CHAIN, tol=1e-8)
    stronger = hjb.solve(problem.__class__(
        lambda x, u, d: drift(x, u, d, 0), lambda x, u, d: x @ x + u @ u, hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.0], [1.0]), discount=0.5,
    ), LINE, scheme=CHAIN, tol=1e-8)  # fmt: skip
    calmer = hjb.solve(hjb.Problem(
        lambda x, u, d: drift(x, u, d, 1), lambda x, u, d: x @ x + 2 * u @ u, hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.0], [1.0]), discount=0.5,
    ), LINE, scheme=CHAIN, tol=1e-8)  # fmt: skip
    low, high = np.minimum(stronger.value, calmer.value), np.maximum(stronger.value, calmer.value)
    assert found.isaacs_gap is not None
    assert np.all((found.value > np.min(low) - 1e-7) & (found.value < np.max(high) + 1e-7))
    # fast changes average the two modes
    fast = hjb.Modes(("weak", "strong"), rates=[[0, 1e6], [2e6, 0]])
    mean = hjb.solve(altered_game(problem, fast), LINE, scheme=CHAIN, tol=1e-6)
    assert np.max(np.abs(mean.value[0] - mean.value[1])) < 1e-4


def altered_game(problem, modes):
    return hjb.Problem(
        problem.drift, problem.cost, problem.controls, disturbances=problem.disturbances, discount=problem.discount,
        modes=modes,
    )  # fmt: skip


@pytest.fixture(scope="module")
def solved():
    problem = plant([[0, 0.5], [0.8, 0]])
    return problem, hjb.solve(problem, hjb.Grid([-2.0], [2.0], (101,)), tol=1e-6)


def test_values_between_the_nodes_know_their_mode(solved):
    _, found = solved
    x = np.array([[0.3], [-1.1]])
    one = found.in_mode("wild")
    assert one.grid.shape == (101,)
    assert one.value.shape == (101,)
    assert np.array_equal(found.value_at(x, mode="wild"), one.value_at(x))
    assert np.array_equal(found.value_at(x, mode=1), found.value_at(np.insert(x, 0, 1.0, axis=1)))
    assert np.array_equal(found.control_at(x, mode="wild"), one.control_at(x))
    assert np.allclose(found.costate_at(x, mode="calm"), found.in_mode(0).costate_at(x), rtol=1e-12)


def test_files_keep_the_modes(solved, tmp_path):
    _, found = solved
    found.save(tmp_path / "modes.npz")
    again = hjb.load(tmp_path / "modes.npz")
    assert again.grid.modes == ("calm", "wild")
    assert np.array_equal(again.value, found.value)
    assert np.array_equal(again.value_at([0.3], mode="wild"), found.value_at([0.3], mode="wild"))
    assert "modes calm, wild x x1: 2 x 101 = 202 nodes" in str(again)


@pytest.mark.slow
def test_a_path_changes_its_mode_where_that_is_optimal(solved):
    problem, found = solved
    where = np.flatnonzero(found.switching[1] == 0)
    start = found.grid.axis(1)[where[len(where) // 2]]
    path = hjb.simulate(problem, found, [start], 2.0, mode="wild", key=0)
    assert path.modes[0] == 0  # at once
    assert path.modes.shape == path.times.shape
    assert path.states.shape == (len(path.times), 1)
    assert path.cost >= 0.9
    with pytest.raises(ValueError, match="give key="):
        hjb.simulate(problem, found, [start], 2.0, mode="wild")
    with pytest.raises(ValueError, match="give the first one, as in mode='calm'"):
        hjb.simulate(problem, found, [start], 2.0, key=0)


@pytest.mark.slow
def test_random_changes_have_their_law():
    # no motion: the number of changes and the share of time in a mode are those of the two-state chain
    rates = np.array([[0.0, 0.7], [1.3, 0.0]])
    problem = hjb.Problem(
        lambda x, u, mode: 0 * x, lambda x, u, mode: 1.0 * mode, modes=hjb.Modes(("a", "b"), rates=rates)
    )
    times = jnp.linspace(0.0, 2.0, 9)

    def run(key):
        path = rollout(problem, None, jnp.zeros(1), times, key=key, mode="a")
        return path.modes, path.cost

    modes, costs = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(1), 2000))
    exact = [expm(t * (rates - np.diag(rates.sum(axis=1))))[0, 1] for t in np.asarray(times)]
    share, exact = np.mean(modes, axis=0), np.array(exact)
    assert np.all(np.abs(share - exact) <= 4 * np.sqrt(exact * (1 - exact) / 2000) + 1e-12)
    total = np.trapezoid([expm(t * (rates - np.diag(rates.sum(1))))[0, 1] for t in np.linspace(0, 2, 401)], dx=0.005)
    assert abs(np.mean(costs) - total) < 4 * np.std(costs) / np.sqrt(2000)


@pytest.mark.slow
def test_rounding_of_a_time_of_change_does_not_alter_the_later_changes():
    def modes(rate):
        chances = hjb.Modes(("a", "b", "c"), rates=rate * (1 - np.eye(3)))
        problem = hjb.Problem(lambda x, u, mode: 0 * x, modes=chances)
        return hjb.simulate(problem, None, [0.0], 9.0, mode="a", key=3).modes

    assert np.array_equal(modes(1.0), modes(1.0 + 1e-6))
    assert len(set(modes(1.0))) == 3


def mean_cost(problem, found, start, seed):
    """The mean cost of 400 paths and three standard errors."""
    times = jnp.linspace(0.0, 12.0, 61)

    def cost(key):
        options = {"mode": "low", "clamp": True, "max_step": 0.02}
        return rollout(problem, found, jnp.array(start), times, key=key, **options).cost

    costs = jax.jit(jax.vmap(cost))(jax.random.split(jax.random.key(seed), 400))
    return float(np.mean(costs)), 3 * float(np.std(costs)) / 20


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize("kind", ["both, without noise", "both"])
def test_paths_cost_what_the_value_promises_in_the_mean(kind):
    one = random_modes.draw(len(kind), (161,))
    one = dataclasses.replace(one, a=-np.abs(one.a), discount=0.8 + one.discount)  # paths stay in the box
    problem = random_modes.problem(one, **KINDS[kind])
    found, start = hjb.solve(problem, one.grid), [0.3 * float(one.grid.lo[0])]
    mean, spread = mean_cost(problem, found, start, 0)
    assert abs(mean - found.value_at(start, mode="low")) <= spread + 0.01 * np.ptp(found.value)


def test_a_grid_with_modes_is_refused_by_a_problem_without_them(solved):
    _, found = solved
    plain = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    for solve in (hjb.solve, lambda problem, grid: hjb.solve_batch([problem], grid)):
        with pytest.raises(ValueError, match="but a problem without modes"):
            solve(plain, found.grid)
    assert hjb.solve(plain, found.in_mode("calm").grid).status.name == "CONVERGED"


def test_mistakes_are_refused_with_the_mode(solved):
    fine = {"modes": hjb.Modes(("a", "b"), rates=[[0, 1], [1, 0]]), "discount": 1.0}
    with pytest.raises(ValueError, match=r"in mode 'b': drift\(x, u\) returned shape \(2,\)"):
        hjb.solve(hjb.Problem(lambda x, u, mode: jnp.zeros(1 + mode), **fine), LINE)
    with pytest.raises(ValueError, match=r"wanted \(2, 2\): a row and a column per mode"):
        hjb.Modes(("a", "b"), rates=[[0, 1]])
    with pytest.raises(ValueError, match="at least two different names"):
        hjb.Modes(("a", "a"))
    with pytest.raises(ValueError, match="numbers ≥ 0"):
        hjb.Modes(("a", "b"), rates=[[0, -1], [1, 0]])
    flat = hjb.Modes(("a", "b"), rates=lambda x, u: x[0] * jnp.ones(2))
    with pytest.raises(ValueError, match=r"Modes.rates: rates\(x, u\) returned shape \(2,\)"):
        hjb.solve(hjb.Problem(lambda x, u, mode: 0 * x, modes=flat, discount=1.0), LINE)
    with pytest.raises(ValueError, match="wanted one of"):
        solved[1].value_at([0.0], mode="c")
    with pytest.raises(ValueError, match="which this function does not take"):
        hjb.filtering.GridFilter(
            hjb.Problem(lambda x, u, mode: 0 * x, noise=1.0, **fine),
            lambda x: x,
            LINE,
            initial_density=lambda x: 1.0,
            measurement_noise=1.0,
        )
    free = hjb.Modes(("a", "b"), switching_cost=[[0, 0], [0, 0]])
    with pytest.raises(ValueError, match="round trip"):
        hjb.solve(hjb.Problem(lambda x, u, mode: 0 * x, modes=free, discount=1.0), LINE)
    negative = hjb.Modes(("a", "b"), rates=lambda x, u: jnp.array([[0.0, 1.0], [1.0, 0.0]]) * x[0])
    with pytest.raises(ValueError, match=r"Modes.rates.*negative"):
        hjb.solve(hjb.Problem(lambda x, u, mode: 0 * x, modes=negative, discount=1.0), LINE)


def drifting(modes, **others):
    """The state stands still in the first mode and moves to the right in the second."""
    return hjb.Problem(
        lambda x, u, mode: (0.0, 1.0)[mode] + 0 * x, noise=lambda x, u, mode: (0.0, 0.5)[mode] + 0 * x, modes=modes,
        **others,
    )  # fmt: skip


@pytest.mark.slow
def test_probabilities_count_random_changes_of_the_mode():
    # from the last node before the target the drive moves on at the rate 1/h or breaks down at the rate λ, for good
    grid, rate = hjb.Grid([-1.0], [1.0], (7,)), 0.2
    problem = drifting(hjb.Modes(("park", "drive"), rates=[[0, 0], [rate, 0]]))
    found = hjb.reach_probability(problem, grid, lambda x, mode: 0.9 - x[0], obstacle=lambda x, mode: x[0] + 0.9)
    ahead = (1 / grid.spacing(0)) / (1 / grid.spacing(0) + rate)
    assert np.allclose(found.value[1, 2:], ahead ** np.arange(4, -1, -1), rtol=0, atol=1e-6)
    assert np.all(found.value[0, :-1] == 0)
    still = hjb.Problem(lambda x, u, mode: 0 * x, modes=problem.modes)
    driving = hjb.stay_probability(still, grid, lambda x, mode: 0.5 - mode + 0 * x[0], horizon=1.0, step=1e-3)
    assert np.allclose(driving.value[0, 1], np.exp(-rate), rtol=0, atol=1e-3)


@pytest.mark.slow
def test_a_feedback_sees_the_changes_of_the_mode():
    # nothing moves until the mode changes into the target: E τ = 1/λ(u)
    problem = hjb.Problem(
        lambda x, u, mode: 0 * x, controls=hjb.Box([1.0], [2.0]), target=lambda x, mode: 0.5 - mode + 0 * x[0],
        modes=hjb.Modes(("works", "broken"), rates=lambda x, u: jnp.array([[0.0, 0.25], [0.0, 0.0]]) * u[0]),
    )  # fmt: skip
    grid = hjb.Grid([0.0], [1.0], (3,))
    for options, time in (({"feedback": lambda x, mode: jnp.ones(1)}, 4.0), ({}, 2.0)):
        found = hjb.expected_exit_time(problem, grid, **options)
        assert np.allclose(found.value, [[time] * 3, [0.0] * 3])


def test_tables_without_changes_by_choice_are_refused():
    problem, grid = plant([[0, 0.5], [0.8, 0]]), hjb.Grid([-2.0], [2.0], (5,))
    zeros = np.zeros((2, 5, 1))
    for function in (hjb.chain.generator, hjb.chain.matrix, hjb.chain.stationary_density):
        with pytest.raises(ValueError, match="got modes with a switching_cost"):
            function(problem, grid, zeros)
    few = dataclasses.replace(problem, controls=hjb.Finite([[-1.0], [1.0]]))
    with pytest.raises(ValueError, match="transition_arrays: got modes with a switching_cost"):
        hjb.chain.transition_arrays(few, grid)
    for function in (hjb.reach_probability, hjb.expected_exit_time):
        with pytest.raises(ValueError, match=f"{function.__name__}: got modes with a switching_cost"):
            function(problem, grid, lambda x, mode: x[0])


def test_functions_that_do_not_know_modes_refuse_them():
    problem, grid = plant([[0, 0.5], [0.8, 0]]), hjb.Grid([-2.0], [2.0], (5,))
    with pytest.raises(ValueError, match="got a problem with the modes"):
        hjb.attenuation(problem, 2.0, hjb.Box([-1.0], [1.0]))
    with pytest.raises(ValueError, match="got a problem with the modes"):
        hjb.perturbation_study(problem, grid, noises=[0.1, 0.2], gammas=[3.0, 4.0], disturbances=hjb.Box([-1.0], [1.0]))
    tube = hjb.Problem(
        lambda x, u, mode: u, None, hjb.Box([-1.0], [1.0]), running_max=lambda x, mode: x[0],
        modes=hjb.Modes(("a", "b"), rates=[[0, 1], [1, 0]]),
    )  # fmt: skip
    found = hjb.march(tube, grid, 0.1, times=np.linspace(0, 0.1, 3), scheme=CHAIN)
    with pytest.raises(ValueError, match="got a tube with the modes"):
        hjb.least_restrictive(found, lambda t, x: 0 * x)


def test_a_grid_of_other_modes_is_refused(solved):
    _, found = solved
    other = hjb.Modes(("park", "drive"), rates=np.ones((2, 2)))
    with pytest.raises(ValueError, match="got a grid with the modes"):
        hjb.solve(drifting(other, discount=1.0), found.grid)


def test_states_without_a_mode_or_with_an_unknown_one_are_refused(solved):
    _, found = solved
    with pytest.raises(ValueError, match="without a mode; give it, as in mode='calm'"):
        found.value_at([0.3])
    with pytest.raises(ValueError, match=r"got states of shape \(2,\), wanted \(..., 1\)"):
        found.value_at([1.0, 0.3], mode="wild")
    for number in (2.0, 0.5, -1.0):
        with pytest.raises(ValueError, match="begin with the mode"):
            found.value_at([number, 0.3])


@pytest.mark.slow
def test_a_convergence_study_compares_every_mode():
    problem = dataclasses.replace(plant([[0, 0.5], [0.8, 0]]), noise=0.5)
    grids = [hjb.Grid([-2.0], [2.0], (n,)) for n in (5, 9, 17)]
    study = hjb.convergence_study(problem, grids, region=lambda x, mode: jnp.abs(x[0]) < 1.5)
    assert np.allclose(study.h, [1.0, 0.5, 0.25])
    assert study.solutions[0].value.shape == (2, 5)
    assert np.all(np.diff(study.errors) < 0)


@pytest.mark.slow
def test_no_change_leads_to_a_mode_that_never_arrives():
    problem = hjb.Problem(
        lambda x, u, mode: (u, 0 * u)[mode], lambda x, u, mode: 1.0, hjb.Box([-1.0], [1.0]),
        target=lambda x, mode: (x[0], 1.0 + 0 * x[0])[mode],
        modes=hjb.Modes(("goes", "stuck"), switching_cost=[[0, 0.1], [np.inf, 0]]),
    )  # fmt: skip
    grid = hjb.Grid([0.0], [1.0], (11,))
    found = hjb.solve(problem, grid)
    assert np.allclose(found.value[0], grid.axis(0), atol=1e-6)
    assert np.all(np.isinf(found.value[1]))


@pytest.mark.parametrize("x64", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_large_value_is_compared_in_float64(x64):
    """V_a = 1000 + x and V_b = 1000: from x = 0 at speed 1 the controller pays 1 for the change at x = 1, and rests."""
    modes = hjb.Modes(("a", "b"), switching_cost=[[0.0, 1.0], [1.0, 0.0]])
    problem = hjb.Problem(lambda x, u, mode: 0 * x + 1.0 - mode, lambda x, u, mode: 1.0, discount=1.0, modes=modes)
    grid = hjb.Grid([0.0], [2.0], (3,))
    value = np.stack([1000.0 + grid.axis(0), np.full(3, 1000.0)])
    solution = hjb.Solution(with_modes(grid, modes.names), value, None)
    with jax.enable_x64(x64):
        path = hjb.simulate(problem, solution, [0.0], 1.5, mode="a")
    assert path.modes[-1] == 1
    assert abs(path.states[-1, 0] - 1.0) < 1e-9
