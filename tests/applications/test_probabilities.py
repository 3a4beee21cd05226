"""Probabilities and exit times against scale functions, reflection, linear algebra and simulated paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from orders import order_of
from scipy.stats import norm
from systems import SEEDS, random_grid, random_problem

import hjbjax as hjb
from hjbjax.applications import exit_problems, probabilities
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import time_stepping
from hjbjax.markov_chain import chain
from hjbjax.problem.pytree import pytree_dataclass

UNIT = hjb.Box([-1.0], [1.0])
SIGMA = 0.7
DEADLY = 2 / SIGMA**2  # of a drift of one: exp(−2μx/σ²) is the scale function


def interval(count, hi=1.0, lo=0.0):
    return hjb.Grid([lo], [hi], (count,))


def carried(x, u):
    return 0.8 + 0 * x


def pushed(x, u):
    return u


def still(x, u):
    return 0 * x


def below_zero(x):
    return x[0]


def above_one(x):
    return 1 - x[0]


def out_of_unit(x):
    return 1 - jnp.abs(x[0])


def ruin(x, mu, length=1.0):
    """The probability of coming to ``length`` before 0 with drift μ."""
    return np.expm1(-mu * DEADLY * x) / np.expm1(-mu * DEADLY * length)


@pytree_dataclass()
class Edge:
    """The half of the space beyond x₀ = place, on the side of the sign."""

    place: object
    sign: object

    def __call__(self, x):
        return self.sign * (self.place - x[0]) - 1e-9


# --- for all times ---


@pytest.mark.slow
@pytest.mark.parametrize(("central", "order"), [(True, 2), pytest.param(False, 1, marks=pytest.mark.slow)])
def test_the_ruin_of_a_gambler(central, order):
    problem, errors = hjb.Problem(carried, noise=SIGMA), []
    for count in (33, 65, 129):
        found = hjb.reach_probability(
            problem, interval(count), above_one, obstacle=below_zero, scheme=hjb.Upwind(central=central)
        )
        errors.append(np.max(np.abs(found.value - ruin(np.asarray(found.grid.axis(0)), 0.8))))
    assert order_of(errors) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("least", [False, True])
@pytest.mark.parametrize("opponent", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_best_and_the_worst_gambler(least, opponent):
    """The drift is at its bound; a disturbance of half the strength is against the control, whatever that wants."""
    push = (lambda x, u, d: u + 0.5 * d) if opponent else pushed
    problem = hjb.Problem(push, controls=UNIT, disturbances=UNIT if opponent else None, noise=SIGMA, discount=0.3)
    found = hjb.reach_probability(problem, interval(65), above_one, obstacle=below_zero, least=least)
    mu = (-1 if least else 1) * (0.5 if opponent else 1.0)
    np.testing.assert_allclose(found.value, ruin(np.asarray(found.grid.axis(0)), mu), rtol=0, atol=2e-4)
    assert np.all(found.policy[1:-1] == (-1 if least else 1))
    assert np.all(np.isnan(found.policy[[0, -1]]))


def beyond(place, sign, x):
    return sign * (place - x[0])


BETWEEN = st.floats(0.05, 0.95)  # of a cell: a link shorter than .01 is made longer


@pytest.mark.slow
@given(st.integers(1, 3), BETWEEN, st.integers(6, 8), BETWEEN)
@settings(max_examples=15)
def test_without_drift_the_chance_is_linear_also_between_the_nodes(k, low, m, high):
    """The boundaries lie between nodes .1 apart; a linear answer has no other error than theirs."""
    lo, hi = 0.1 * (k + low), 0.1 * (m + high)
    target, obstacle = jax.tree_util.Partial(beyond, hi, 1.0), jax.tree_util.Partial(beyond, lo, -1.0)
    found = hjb.reach_probability(
        hjb.Problem(still, noise=SIGMA), interval(11), target, obstacle=obstacle, scheme=hjb.Upwind(subcell=True)
    )
    exact = np.clip((np.asarray(found.grid.axis(0)) - lo) / (hi - lo), 0, 1)
    np.testing.assert_allclose(found.value, exact, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("x", "paid"),
    [(0.4, 0.0), (0.4 + 1e-16, 0.0), (0.3, 0.0), (0.6, 1.0), (0.6 - 1e-16, 1.0), (0.7, 1.0), (0.95, 0.0)],
)
def test_who_ends_on_a_boundary_ends_in_the_set_that_it_met(x, paid):
    """The target is x ≥ .6, the obstacle x ≤ .4 and x ≥ .9; on a boundary rounding decides of the sign."""
    question = exit_problems.exit_problem(
        hjb.Problem(still), lambda x: 0.6 - x[0], lambda x: jnp.minimum(x[0] - 0.4, 0.9 - x[0]), 0.0, 1.0
    )
    with jax.enable_x64(True):
        assert question.exit_cost(jnp.array([x])) == paid


def test_an_obstacle_wins_where_it_covers_the_target():
    """The target x ≥ ½ is covered from ¾ on: started there one has failed, and from below nothing changes."""
    found = hjb.reach_probability(
        hjb.Problem(still, noise=SIGMA), interval(41), lambda x: 0.5 - x[0],
        obstacle=lambda x: jnp.minimum(x[0], 0.75 - x[0]),
    )  # fmt: skip
    x = np.asarray(found.grid.axis(0))
    exact = np.where(x >= 0.75, 0, np.minimum(2 * x, 1))
    np.testing.assert_allclose(found.value, exact, rtol=0, atol=1e-9)


def test_the_exit_time_of_a_random_walk():
    """(1 − x²)/σ²: central differences are exact, and the bound is certified."""
    found = hjb.expected_exit_time(hjb.Problem(still, noise=SIGMA), interval(41, lo=-1.0), out_of_unit)
    np.testing.assert_allclose(found.value, (1 - np.asarray(found.grid.axis(0)) ** 2) / SIGMA**2, rtol=0, atol=1e-9)
    assert found.error <= 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("greatest", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_exit_time_of_who_wants_out_and_of_who_wants_to_stay(greatest):
    """½σ²T'' ± T' = −1 on [0, 1] with T'(0) = 0, T(1) = 0."""
    c, errors = (-DEADLY if greatest else DEADLY), []
    problem = hjb.Problem(pushed, controls=UNIT, noise=SIGMA)
    for count in (33, 65, 129):
        found = hjb.expected_exit_time(problem, interval(count, lo=-1.0), out_of_unit, greatest=greatest)
        x = np.abs(np.asarray(found.grid.axis(0)))
        exact = (-1 if greatest else 1) * ((1 - x) + (np.exp(-c) - np.exp(-c * x)) / c)
        errors.append(np.max(np.abs(found.value - exact)))
        assert found.value.min() >= 0
    assert order_of(errors) == pytest.approx(2, abs=0.15)


def out_of_square(x):
    return 1 - jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1]))


@pytest.mark.slow
def test_the_exit_time_from_a_square():
    errors = []
    for count in (9, 17, 33):
        grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (count, count))
        found = hjb.expected_exit_time(hjb.Problem(still, noise=1.0), grid, out_of_square)
        errors.append(abs(found.value_at([0.0, 0.0]) - 0.5893708182))
    assert order_of(errors) == pytest.approx(2, abs=0.15)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the optimal drift leaves")
@given(SEEDS)
@settings(max_examples=10)
def test_uncontrolled_chains_are_absorbed_as_linear_algebra_says(seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 2, periodic=False)
    base = random_problem(rng, grid, "matrix")
    left, right = np.asarray(grid.lo)[0], np.asarray(grid.hi)[0]
    problem = hjb.Problem(base.drift, None, hjb.Finite([[0.3]]), noise=base.noise)
    found = hjb.reach_probability(problem, grid, Edge(right, 1.0), obstacle=Edge(left, -1.0))
    generator = chain.generator(problem, grid, np.full((*grid.shape, 1), 0.3)).toarray()
    number = np.arange(grid.size).reshape(grid.shape)
    free, won = number[1:-1].ravel(), number[-1]
    exact = np.linalg.solve(generator[np.ix_(free, free)], -generator[np.ix_(free, won)].sum(axis=1))
    np.testing.assert_allclose(found.value[1:-1].ravel(), exact, rtol=0, atol=1e-6)


# --- up to a horizon ---


@pytest.mark.slow
def test_the_reflection_principle():
    """P(min ≤ 0 within T) = 2Φ(−x/√T) from x: second order, at all kept times."""
    problem, errors = hjb.Problem(still, noise=1.0), []
    for count in (65, 129, 257):
        found = hjb.reach_probability(problem, interval(count, 6.0), below_zero, horizon=1.0, times=[0.0, 0.5])
        x = np.asarray(found.grid.axis(0))
        exact = np.stack([2 * norm.cdf(-x), 2 * norm.cdf(-x / np.sqrt(0.5))])
        errors.append(np.max(np.abs(found.value - exact)))
    assert order_of(errors) == pytest.approx(2, abs=0.15)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the optimal drift leaves")
def test_a_target_that_runs_along_with_the_drift():
    """In the frame of dx = dt + dw the target x ≤ t stands still; only the first-order upwind slopes tell."""
    problem = hjb.Problem(lambda t, x, u: jnp.ones(1), noise=1.0, time_dependent=True)
    found = hjb.reach_probability(problem, interval(281, 6.0, -1.0), lambda t, x: x[0] - t, horizon=1.0, step=3e-4)
    x = np.asarray(found.grid.axis(0))
    exact = np.where(x <= 0, 1, 2 * norm.cdf(-x))
    assert np.max(np.abs(found.value[0] - exact)) < 0.015


@pytest.mark.slow
def test_staying_is_not_leaving():
    """P(|w| < 1 up to T) = Σ 4/((2k+1)π) (−1)^k exp(−(2k+1)²π²σ²T/8) cos((2k+1)πx/2)."""
    k = 2 * np.arange(20)[:, None] + 1
    errors = []
    for count in (17, 33, 65):
        grid = interval(count, lo=-1.0)
        kept = hjb.stay_probability(hjb.Problem(still, noise=1.0), grid, lambda x: jnp.abs(x[0]) - 1, horizon=0.5)
        waves = np.cos(k * np.pi * np.asarray(grid.axis(0)) / 2) * np.exp(-(k**2) * np.pi**2 / 16)
        exact = np.sum(4 / (k * np.pi) * np.where(k % 4 == 1, 1, -1) * waves, axis=0)
        errors.append(np.max(np.abs(kept.value[0] - exact)))
    assert order_of(errors) == pytest.approx(2, abs=0.15)


def swing(x, u):
    return jnp.stack([x[1], -x[0] - x[1]])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is coarse")
def test_simulated_paths_arrive_as_often():
    """An oscillator under noise, x ≥ 1 within 2: 20000 Euler paths, three standard errors and the grid's own error."""
    problem, values = hjb.Problem(swing, noise=[0.0, 1.0]), []
    for count in (41, 81):
        grid = hjb.Grid([-3.0, -3.0], [3.0, 3.0], (count, count))
        values.append(hjb.reach_probability(problem, grid, above_one, horizon=2.0).value_at(0.0, [0.0, 0.0]))
    rng, dt = np.random.default_rng(0), 2e-3
    x, v, there = np.zeros(20_000), np.zeros(20_000), np.zeros(20_000, bool)
    for _ in range(1000):
        x, v = x + v * dt, v + (-x - v) * dt + np.sqrt(dt) * rng.normal(size=x.shape)
        there |= x >= 1
    share = np.mean(there)
    noise = 3 * np.sqrt(share * (1 - share) / x.size)
    of_the_grid = abs(values[1] - values[0])  # about the error of the finer one, at first order
    assert abs(values[1] - share) <= noise + of_the_grid
    assert of_the_grid < 0.05


def test_the_time_that_passes_at_most():
    """E min(τ, T) grows with T up to the exit time."""
    problem, grid = hjb.Problem(still, noise=1.0), interval(33, lo=-1.0)
    found = hjb.expected_exit_time(problem, grid, out_of_unit, horizon=5.0, times=[0.0, 4.0, 4.9])
    assert np.all(np.diff(found.value[:, 1:-1], axis=0) < 0)
    exact = 1 - np.asarray(grid.axis(0)) ** 2
    np.testing.assert_allclose(found.value[0], exact, rtol=0, atol=5e-3)
    assert found.value_at(4.9, [0.0]) == pytest.approx(0.1, abs=1e-3)


# --- under a feedback ---


def near_the_middle(x):
    return jnp.abs(x[0] - 0.4) - 0.3


def home(x):
    return -x


@pytest.mark.slow
def test_a_feedback_makes_an_ornstein_uhlenbeck_process():
    """u = −x: the scale function is ∫ exp(x²/σ²); as a function, and as a Solution that plays it."""
    grid = interval(81)
    x = np.asarray(grid.axis(0))
    z = np.linspace(0, 1, 8001)
    scale = np.concatenate([[0], np.cumsum(np.exp(((z[1:] + z[:-1]) / 2 / SIGMA) ** 2))])
    exact = np.interp(x, z, scale / scale[-1])
    problem = hjb.Problem(pushed, controls=UNIT, noise=SIGMA)
    solved = hjb.Solution(grid, np.zeros(81), -x[:, None])
    for feedback in (home, solved):
        found = hjb.reach_probability(problem, grid, above_one, obstacle=below_zero, feedback=feedback)
        np.testing.assert_allclose(found.value, exact, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_the_policy_attains_what_the_value_says():
    problem, grid = hjb.Problem(pushed, controls=UNIT, noise=SIGMA), interval(41)
    best = hjb.reach_probability(problem, grid, above_one, obstacle=below_zero)
    again = hjb.reach_probability(problem, grid, above_one, obstacle=below_zero, feedback=best)
    np.testing.assert_allclose(again.value, best.value, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is coarse")
def test_a_policy_that_changes_with_the_time_attains_it_too():
    problem, grid = hjb.Problem(pushed, controls=UNIT, noise=SIGMA), interval(41)
    times = np.linspace(0, 0.2, 41)
    kept = hjb.stay_probability(problem, grid, near_the_middle, horizon=0.2, times=times)
    kept_again = hjb.stay_probability(problem, grid, near_the_middle, horizon=0.2, feedback=kept)
    np.testing.assert_allclose(kept_again.value[0], kept.value[0], rtol=0, atol=1e-3)


@pytest.mark.slow
def test_a_disturbance_plays_against_a_feedback():
    """u = 1 given, |d| ≤ ½ against it: a drift of ½; and where the control's least is asked, d helps instead."""
    problem = hjb.Problem(lambda x, u, d: u + 0.5 * d, controls=UNIT, disturbances=UNIT, noise=SIGMA)
    for least, mu in ((False, 0.5), (True, 1.5)):
        found = hjb.reach_probability(
            problem, interval(65), above_one, obstacle=below_zero, feedback=lambda x: jnp.ones(1), least=least
        )
        np.testing.assert_allclose(found.value, ruin(np.asarray(found.grid.axis(0)), mu), rtol=0, atol=4e-4)


@pytest.mark.slow
def test_where_a_solution_has_no_action_the_state_stays():
    """A policy that ends at .5 never brings anyone to 1."""
    grid = interval(41)
    policy = np.where(np.asarray(grid.axis(0)) >= 0.5, np.nan, 1.0)[:, None]
    problem = hjb.Problem(pushed, controls=UNIT, noise=SIGMA)
    found = hjb.reach_probability(problem, grid, above_one, feedback=hjb.Solution(grid, np.zeros(41), policy))
    assert np.all(found.value[:-1] == 0)
    assert found.value[-1] == 1


@pytest.mark.filterwarnings("ignore:the optimal drift leaves")
@pytest.mark.slow
@pytest.mark.optimised
@given(SEEDS)
@settings(max_examples=10)
def test_any_feedback_lies_between_the_least_and_the_greatest(seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 2, periodic=False)
    problem = random_problem(rng, grid, "diagonal")
    there, away = Edge(np.asarray(grid.hi)[0], 1.0), Edge(np.asarray(grid.lo)[0], -1.0)
    policy = hjb.Solution(grid, np.zeros(grid.shape), rng.uniform(-1, 1, (*grid.shape, 1)))
    with jax.enable_x64(True):  # one step for all three, so that one monotone scheme is compared with itself
        step = min(0.3, 0.99 * float(time_stepping.stable(Discretisation(problem, grid, hjb.Upwind(), np.float64))))
    least, some, most = (
        hjb.reach_probability(problem, grid, there, obstacle=away, horizon=0.3, step=step, **choice).value[0]
        for choice in ({"least": True}, {"feedback": policy}, {})
    )
    assert np.all((least >= 0) & (most <= 1))
    assert np.all(least <= some + 1e-9)
    assert np.all(some <= most + 1e-9)


# --- where paths need not end ---


def calm_in_the_middle(x, u):
    return jnp.where(jnp.abs(x) <= 0.275, 0.0, 1.0)


@pytest.mark.parametrize(
    ("options", "atol"),
    [({}, 1e-5), ({"tol": 1e-2}, 1e-5), pytest.param({"dtype": "float32", "tol": 1e-2}, 1e-3, marks=pytest.mark.slow)],
)
def test_who_may_stay_for_ever_need_not_arrive(options, atol):
    """Noise only beyond the nodes ±¼: what is inside stays; from outside one comes to rest there, or to ±1."""
    grid = interval(41, lo=-1.0)
    found = hjb.reach_probability(hjb.Problem(still, noise=calm_in_the_middle), grid, out_of_unit, **options)
    x = np.abs(np.asarray(grid.axis(0)))
    np.testing.assert_allclose(found.value, np.clip((x - 0.25) / 0.75, 0, 1), rtol=0, atol=atol)
    assert found.reached is None


@pytest.mark.slow
@pytest.mark.parametrize("least", [False, True])
def test_without_noise_the_answer_is_yes_or_no(least):
    """ẋ = u, |u| ≤ 1: who wants to gets there, who does not stays where he is."""
    problem = hjb.Problem(pushed, controls=UNIT)
    found = hjb.reach_probability(problem, interval(41, lo=-1.0), out_of_unit, least=least)
    inside = found.value[1:-1]
    np.testing.assert_allclose(inside, 0.0 if least else 1.0, rtol=0, atol=1e-6)


def test_a_greatest_time_without_end_is_refused():
    with pytest.raises(ValueError, match=r"greatest time is infinite: at 39 of 41 nodes some action keeps"):
        hjb.expected_exit_time(hjb.Problem(pushed, controls=UNIT), interval(41, lo=-1.0), out_of_unit, greatest=True)


def test_in_a_game_the_greatest_time_without_end_is_a_possibility():
    """ẋ = u + 2 d: who wants out can push twice as hard, and both together can stay."""
    problem = hjb.Problem(lambda x, u, d: u + 2 * d, controls=UNIT, disturbances=UNIT)
    with pytest.raises(ValueError, match=r"may be infinite: at 39 of 41 nodes some actions of both players keep"):
        hjb.expected_exit_time(problem, interval(41, lo=-1.0), out_of_unit, greatest=True)


# --- transformations ---


def drifting(mu, x, u):
    return mu + 0 * x


def chance(mu, horizon=None, **options):
    problem = hjb.Problem(jax.tree_util.Partial(drifting, mu), noise=SIGMA)
    found = hjb.reach_probability(problem, interval(33), above_one, obstacle=below_zero, horizon=horizon, **options)
    return found.value_at(*([] if horizon is None else [0.0]), jnp.array([0.5]))


@pytest.mark.slow
def test_a_probability_can_be_compiled_and_differentiated():
    """d/dμ of (1 − e^{−kμ/2})/(1 − e^{−kμ}) = 1/(1 + e^{−kμ/2})."""
    with jax.enable_x64(True):
        exact = 1 / (1 + np.exp(-DEADLY * 0.8 / 2))
        ours = chance(0.8)
        assert ours == pytest.approx(exact, abs=1e-3)
        assert float(jax.jit(chance)(0.8)) == pytest.approx(ours, abs=1e-5)
        slope = float(jax.jit(jax.grad(chance))(0.8))
        assert slope == pytest.approx(DEADLY / 2 * exact * (1 - exact), abs=2e-3)
        soon = {"horizon": 0.2, "step": 5e-4}
        assert float(jax.jit(lambda mu: chance(mu, **soon))(0.8)) == pytest.approx(chance(0.8, **soon), abs=1e-9)
        slope = float(jax.jit(jax.grad(lambda mu: chance(mu, **soon)))(0.8))
        assert slope == pytest.approx((chance(0.81, **soon) - chance(0.79, **soon)) / 0.02, rel=1e-3)


# --- refusals ---


@pytest.mark.parametrize(
    ("changes", "error", "reason"),
    [
        ({"target": None}, ValueError, r"reach_probability: there is nothing to reach: pass target="),
        ({"target": 1.0}, TypeError, r"reach_probability: target: got 1.0, wanted a function"),
        ({"target": lambda x: x[0] + 9}, ValueError, r"target: no node lies in the target"),
        ({"problem": 1}, TypeError, r"got int, wanted a Problem"),
        ({"grid": 1}, TypeError, r"got Problem, int; wanted a Problem and a Grid"),
        ({"feedback": 1.0}, TypeError, r"feedback is 1.0, wanted a Solution or a function \(x\)"),
        ({"problem": hjb.Problem(still, noise=1.0), "feedback": home}, ValueError, r"problem.controls is None; leave"),
        ({"scheme": "upwind"}, TypeError, r"scheme is 'upwind'"),
        (
            {"problem": hjb.Problem(lambda t, x, u: u, None, UNIT, time_dependent=True)},
            ValueError,
            r"time-dependent problem has no stationary value; it needs a finite horizon",
        ),
    ],
)
def test_bad_questions_are_refused(changes, error, reason):
    arguments = {
        "problem": hjb.Problem(pushed, controls=UNIT, noise=SIGMA),
        "grid": interval(11),
        "target": below_zero,
    } | changes
    with pytest.raises(error, match=reason) as caught:
        hjb.reach_probability(**arguments)
    assert len(str(caught.value).splitlines()) <= 6


@pytest.mark.parametrize(
    ("times", "reason"),
    [
        ([0.0], r"_probability: horizon = 5 goes beyond the horizon 0 of the solution"),
        ([0.0, 5.0], r"_probability: horizon = 5, but the solution was marched and stored at 2 times"),
        (np.linspace(1, 5, 41), r"stored at 41 times from 1 to 5"),
    ],
)
def test_a_marched_feedback_that_is_not_known_up_to_the_horizon_is_refused(times, reason):
    grid, problem = interval(5), hjb.Problem(pushed, controls=UNIT, noise=SIGMA)
    policy = hjb.Solution(grid, np.zeros((len(times), 5)), np.ones((len(times), 5, 1)), times=np.asarray(times))
    for ask, target in ((hjb.reach_probability, above_one), (hjb.stay_probability, near_the_middle)):
        with pytest.raises(ValueError, match=reason):
            ask(problem, grid, target, feedback=policy, horizon=5.0)


@pytest.mark.parametrize("ask", [hjb.reach_probability, hjb.expected_exit_time])
def test_a_grid_that_does_not_fit_is_refused_before_any_node_is_looked_at(ask, monkeypatch):
    def looked(*arguments, **options):
        raise AssertionError

    monkeypatch.setattr(probabilities.node_checks, "check_values", looked)
    options = {"greatest": True} if ask is hjb.expected_exit_time else {}
    with pytest.raises(MemoryError, match=r"41 nodes need about"):
        ask(hjb.Problem(pushed, controls=UNIT), interval(41), above_one, max_memory=100, **options)


@pytest.mark.slow
def test_a_partial_answer_is_a_probability_too():
    problem = hjb.Problem(pushed, controls=UNIT, noise=SIGMA)
    with pytest.raises(hjb.SolveError, match=r"MAX_STEPS") as caught:
        hjb.stay_probability(
            problem, interval(21), lambda x: jnp.abs(x[0] - 0.5) - 0.5, method=hjb.ValueIteration(), max_steps=3
        )
    assert np.all((caught.value.solution.value >= 0) & (caught.value.solution.value <= 1))
