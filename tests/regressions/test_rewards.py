"""Problems that maximise rewards: the bits of the problem with minus the rewards as costs, with the opposite sign."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import plotting
from hjbjax.solution import archive
from hjbjax.solvers import setup

GRID = hjb.Grid([-2.0], [2.0], (41,))
BOX = hjb.Box([-1.0], [1.0])


def drift(x, u):
    return u - 0.1 * x


def running(x, u):
    return (x[0] - 1) ** 2 + 0.5 * u[0] ** 2 - 1


def ahead(x):
    return 0.3 * x[0] + 0.2


def minus(function):
    return lambda *arguments: -function(*arguments)


def both(running=running, **more):
    """A problem with costs, and the same with rewards; ends of paths are costs."""
    ends = {name: more.pop(name) for name in ("exit", "terminal", "stopping") if name in more}
    shared = {"controls": BOX, "discount": 0.5} | more
    costs = hjb.Problem(drift, running, **shared, **{f"{name}_cost": paid for name, paid in ends.items()})
    rewards = hjb.Problem(
        drift, reward=minus(running), **shared,
        **{f"{name}_reward": minus(paid) if callable(paid) else -paid for name, paid in ends.items()},
    )  # fmt: skip
    return costs, rewards


def close(one, other):
    """Equal up to rounding: the sign decides which products XLA rounds before it adds them."""
    np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)


def same(cost, reward):
    """The two solutions are each other's negatives, up to rounding."""
    close(cost.value, -reward.value)
    close(cost.policy, reward.policy)
    assert (cost.labels.payoff, reward.labels.payoff) == ("cost", "reward")
    assert (cost.bounds is None) == (reward.bounds is None)
    if cost.bounds is not None:
        close(cost.bounds[0], -reward.bounds[1])
        close(cost.bounds[1], -reward.bounds[0])
        assert cost.error == pytest.approx(reward.error, rel=1e-6, abs=1e-12)
    for name in ("grid_error", "box_error"):
        one, other = getattr(cost, name), getattr(reward, name)
        assert (one is None) == (other is None), name
        if one is not None:
            close(one, other)


@pytest.fixture(scope="module")
def pair():
    """A problem with every kind of end, once with costs and once with rewards, and the solutions of both."""
    costs, rewards = both(target=lambda x: x[0] + 1.5, exit=ahead, stopping=lambda x: 0.4 + 0.0 * x[0])
    return costs, rewards, *(hjb.solve(each, GRID, scheme=hjb.Upwind()) for each in (costs, rewards))


def test_a_reward_is_minus_a_cost(pair):
    same(*pair[2:])
    assert pair[3].problem is pair[1]


@pytest.mark.slow
def test_a_reward_of_second_order_is_minus_a_cost():
    costs, rewards = both()
    same(*(hjb.solve(each, GRID) for each in (costs, rewards)))


@pytest.mark.parametrize(
    "more",
    [
        {"target": lambda x: x[0] + 1.5, "exit": ahead},
        {"target": lambda x: x[0] + 1.5, "exit": 0.5, "discount": 0.0, "running": lambda x, u: 1.0 + u[0] ** 2},
        {"noise": 0.4},
    ],
    ids=["exit", "undiscounted", "noise"],
)
@pytest.mark.slow
def test_every_kind_of_payment_has_the_sign_of_the_rewards(more):
    costs, rewards = both(**more)
    same(*(hjb.solve(each, GRID, scheme=hjb.Upwind()) for each in (costs, rewards)))


@pytest.mark.slow
def test_undiscounted_bounds_of_a_reward_hold_the_value_and_say_so():
    _, rewards = both(lambda x, u: 1.0 + u[0] ** 2, target=lambda x: x[0] + 1.5, discount=0.0)
    found = hjb.solve(rewards, GRID, scheme=hjb.Upwind())
    lower, upper = found.bounds
    assert np.all((lower <= found.value) & (found.value <= upper))
    assert np.all(found.value <= 0)
    assert found.stats["certificate"] == "from the running reward, V/(1 − ρ) ≤ V_h ≤ V/(1 + η)"


@pytest.mark.slow
def test_the_disturbance_minimises_a_reward():
    def game(x, u, d):
        return u + d

    def paid(x, u, d):
        return x[0] ** 2 + 0.5 * u[0] ** 2 - 2 * d[0] ** 2

    box = hjb.Box([-0.5], [0.5])
    costs = hjb.Problem(game, paid, BOX, disturbances=box, discount=1.0)
    rewards = hjb.Problem(game, reward=minus(paid), controls=BOX, disturbances=box, discount=1.0)
    cost, reward = (hjb.solve(each, GRID, scheme=hjb.Upwind()) for each in (costs, rewards))
    same(cost, reward)
    assert np.array_equal(cost.disturbance, reward.disturbance)
    assert cost.isaacs_gap == reward.isaacs_gap


@pytest.mark.slow
def test_a_march_starts_from_rewards_and_ends_with_them():
    costs, rewards = both(terminal=ahead)
    times = np.linspace(0, 1, 6)
    cost, reward = (hjb.march(each, GRID, 1.0, times=times) for each in (costs, rewards))
    same(cost, reward)
    assert np.allclose(reward.value[-1], -0.3 * GRID.axis(0) - 0.2)
    plain = both()
    further = [
        hjb.march(each, GRID, 0.5, start=start) for each, start in zip(plain, (ahead_at(1), ahead_at(-1)), strict=True)
    ]
    same(*further)


def ahead_at(sign):
    return sign * (0.3 * GRID.axis(0) + 0.2)


def test_a_batch_may_hold_both_and_a_guess_has_the_sign_of_the_rewards(pair):
    costs, rewards, *_ = pair
    cost, reward = hjb.solve_batch([costs, rewards], GRID, scheme=hjb.Upwind())
    same(cost, reward)
    with pytest.raises(hjb.SolveError) as stopped:
        hjb.solve(rewards, GRID, scheme=hjb.Upwind(), max_steps=1, tol=1e-12)
    partial = stopped.value.solution
    assert partial.labels.payoff == "reward"
    assert partial.problem is rewards
    again = hjb.solve(rewards, GRID, scheme=hjb.Upwind(), guess=reward.value)
    assert again.steps <= 2
    assert np.allclose(again.value, reward.value)
    with pytest.raises(hjb.SolveError) as stopped:
        hjb.solve_batch([costs, rewards], GRID, scheme=hjb.Upwind(), max_steps=1, tol=1e-12)
    assert [each.labels.payoff for each in stopped.value.solutions] == ["cost", "reward"]
    assert stopped.value.solution is stopped.value.solutions[0]


@pytest.mark.slow
def test_derivatives_jit_and_vmap_have_the_sign_of_the_rewards():
    def value(sign, a):
        if sign > 0:
            problem = hjb.Problem(drift, lambda x, u: a * running(x, u), BOX, discount=0.5)
        else:
            problem = hjb.Problem(drift, reward=lambda x, u: -a * running(x, u), controls=BOX, discount=0.5)
        return hjb.solve(problem, GRID, scheme=hjb.Upwind())

    slopes = [jax.grad(lambda a, sign=sign: value(sign, a).value.sum())(2.0) for sign in (1, -1)]
    assert float(slopes[0]) == pytest.approx(-float(slopes[1]), rel=1e-6)
    lanes = jax.jit(jax.vmap(lambda a: value(-1, a)))(jnp.array([1.0, 2.0]))
    assert lanes.labels.payoff == "reward"
    host = value(-1, 2.0)
    assert np.allclose(lanes.value[1], host.value, atol=1e-5)
    assert np.allclose(lanes.bounds[0][1], host.bounds[0], atol=1e-4)


@pytest.mark.slow
def test_a_path_earns_what_the_value_promises():
    costs, rewards = both(target=lambda x: x[0] + 1.5, exit=ahead)
    cost, reward = (hjb.solve(each, GRID) for each in (costs, rewards))
    spent, earned = (hjb.simulate(p, s, [1.0], 5.0) for p, s in ((costs, cost), (rewards, reward)))
    assert earned.reward == -spent.cost
    assert earned.promised == -spent.promised
    assert earned.reward == pytest.approx(earned.promised, abs=0.2)
    assert "reward" in repr(earned)
    assert f"reward {earned.reward:.6g} (V promised" in earned.message
    greedy = [hjb.greedy_feedback(p, s).control_at([0.7]) for p, s in ((costs, cost), (rewards, reward))]
    assert np.array_equal(*greedy)
    rolled = jax.jit(lambda x: hjb.simulate(rewards, lambda x: -x, x, 1.0).reward)(jnp.ones(1))
    assert float(rolled) == pytest.approx(hjb.simulate(rewards, lambda x: -x, [1.0], 1.0).reward, rel=1e-4)


@pytest.mark.slow
def test_a_path_that_earns_less_than_promised_is_reported_as_such():
    _, rewards = both()
    solved = hjb.solve(rewards, GRID)
    wrong = dataclasses.replace(solved, value=solved.value + 100)
    with pytest.warns(
        hjb.SolveWarning, match=r"the path earns .* with the reward that V predicts .* does not achieve V"
    ):
        hjb.simulate(rewards, wrong, [1.0], 1.0)


@pytest.mark.slow
def test_a_path_stops_where_stopping_pays():
    costs, rewards = both(stopping=ahead)
    spent, earned = (hjb.simulate(each, hjb.solve(each, GRID), [-0.5], 9.0) for each in (costs, rewards))
    assert earned.times[-1] == spent.times[-1]
    assert earned.reward == pytest.approx(-spent.cost, rel=1e-12)


def test_files_and_pictures_say_that_the_value_is_a_reward(pair, tmp_path):
    found = pair[3]
    found.save(tmp_path / "v.npz")
    loaded = hjb.load(tmp_path / "v.npz")
    assert loaded.labels == found.labels
    assert np.array_equal(loaded.value, found.value)
    assert plotting.value(found)[0].axes.get_ylabel() == "V, reward"
    header = archive.contents(found)[0] | {"labels": [*found.labels[:3], "profit"]}
    with pytest.raises(ValueError, match="profit"):
        archive.fields(header, archive.contents(found)[1])


def test_a_checkpoint_of_rewards_is_resumed_with_the_same_bits(pair, tmp_path):
    _, rewards, _, whole = pair
    with pytest.raises(hjb.SolveError):
        hjb.solve(rewards, GRID, scheme=hjb.Upwind(), max_steps=1, checkpoint=tmp_path / "c")
    again = hjb.solve(rewards, GRID, scheme=hjb.Upwind(), checkpoint=tmp_path / "c", resume=True)
    assert np.array_equal(again.value, whole.value)


def test_quantecon_gets_rewards():
    costs, rewards = both(controls=hjb.Finite([[-1.0], [0.0], [1.0]]))
    spent, earned = (hjb.chain.transition_arrays(each, GRID) for each in (costs, rewards))
    assert np.array_equal(spent[0], -earned[0])
    assert np.array_equal(spent[1].toarray(), earned[1].toarray())
    paid, moves, states, _, factor = earned
    value, solved = np.zeros(GRID.size), hjb.solve(rewards, GRID, scheme=hjb.Upwind(), tol=1e-9)
    for _ in range(3000):
        value = np.max((paid + factor * (moves @ value)).reshape(-1, 3), axis=1)
    assert np.array_equal(states, np.repeat(np.arange(GRID.size), 3))
    assert np.allclose(value, solved.value, atol=1e-6)


@pytest.mark.slow
def test_what_cannot_arrive_earns_minus_infinity():
    problem = hjb.Problem(
        lambda x, u: jnp.abs(u), reward=lambda x, u: -1.0, controls=BOX, target=lambda x: jnp.abs(x[0] - 1) - 0.5
    )
    with pytest.warns(hjb.SolveWarning, match="their value is -inf"):
        found = hjb.solve(problem, GRID)
    assert np.isneginf(found.value[-1])
    assert np.isfinite(found.value[0])


def test_a_reward_without_end_is_infinite_and_says_so():
    problem = hjb.Problem(lambda x, u: u, reward=lambda x, u: 1.0 - u[0] ** 2 + 0 * x[0], controls=BOX)
    with pytest.raises((hjb.SolveError, ValueError), match="reward"):
        hjb.solve(problem, GRID)


@pytest.mark.slow
def test_prescribed_ends_are_rewards():
    def on(sign):
        return hjb.Grid([0.0], [1.0], (21,), edges=((hjb.Dirichlet(sign * 2.0), hjb.Neumann(sign * 0.5)),))

    costs, rewards = both(noise=0.5)
    cost, reward = (hjb.solve(p, on(sign), scheme=hjb.Upwind()) for p, sign in ((costs, 1), (rewards, -1)))
    assert np.array_equal(cost.value, -reward.value)
    assert reward.value[0] == -2.0
    with pytest.raises(ValueError, match="costs and problems with rewards"):
        hjb.solve_batch([costs, rewards], on(1))


def test_replacing_a_number_keeps_the_rewards():
    _, rewards = both()
    other = dataclasses.replace(rewards, discount=0.7)
    assert other.payoff == "reward"
    assert other.reward is rewards.reward
    assert other.cost is None
    assert jax.tree.structure(jax.tree.map(lambda leaf: leaf, rewards)) == jax.tree.structure(rewards)


def test_a_new_lambda_of_the_same_reward_does_not_compile_again():
    def problem(a):
        return hjb.Problem(drift, reward=lambda x, u: a * x[0] - u[0] ** 2, controls=BOX, discount=0.5)

    hjb.solve(problem(1.0), GRID, scheme=hjb.Upwind())
    before = setup._prepare_jit._cache_size()
    hjb.solve(problem(2.0), GRID, scheme=hjb.Upwind())
    assert setup._prepare_jit._cache_size() == before


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"cost": running, "reward": running}, "cost together with reward"),
        ({"reward": running, "terminal_cost": 1.0}, "terminal_cost together with reward"),
        ({"cost": running, "exit_reward": 1.0, "target": ahead}, "cost together with exit_reward"),
        ({"reward": running, "running_max": ahead}, "leave out running_max"),
        ({"stopping_reward": ahead, "running_max": ahead}, "leave out running_max"),
        ({"reward": running, "exit_reward": 1.0}, "no target to pay it on"),
        ({"reward": 3.0}, "Problem.reward"),
        ({"terminal_reward": float("nan")}, "Problem.terminal_reward"),
    ],
)
def test_costs_and_rewards_do_not_mix(given, said):
    with pytest.raises((ValueError, TypeError), match=said):
        hjb.Problem(drift, controls=BOX, **given)


@pytest.mark.parametrize(
    ("reward", "said"),
    [
        (lambda x, u: jnp.stack([x[0], u[0]]), r"reward\(x, u\) returned shape \(2,\)"),
        (lambda x, u: None, r"reward\(x, u\) returned None"),
        (lambda x, u: [x[0]], r"reward\(x, u\) returned a list"),
        (lambda x, u: x[0] > 0, r"reward\(x, u\) returned bool numbers"),
        (lambda x: x[0], r"reward does not take the arguments that the problem passes, reward\(x, u\)"),
        (lambda x, u: jnp.log(x[0]), r"reward\(x, u\) is NaN or infinite at"),
        (lambda x, u: x[5], r"reward\(x, u\) reads"),
    ],
)
def test_messages_name_the_reward(reward, said):
    problem = hjb.Problem(drift, reward=reward, controls=BOX, discount=1.0)
    with pytest.raises(ValueError, match=said):
        hjb.solve(problem, GRID)


def test_what_is_about_costs_refuses_rewards():
    _, rewards = both()
    for ask in (
        lambda: hjb.attenuation(rewards, 2.0, BOX),
        lambda: hjb.hinf_level(
            lambda gamma: dataclasses.replace(rewards, disturbances=BOX, drift=lambda x, u, d: u + d), GRID, 1.0, 2.0
        ),
        lambda: hjb.filtering.RobustGridFilter(rewards, lambda x: x, GRID, lambda x: -x @ x, 2.0),
    ):
        with pytest.raises(ValueError, match="got a problem with rewards, wanted costs"):
            ask()
    with pytest.raises(ValueError, match="terminal_reward belongs to a finite horizon"):
        hjb.solve(dataclasses.replace(rewards, terminal_reward=1.0), GRID)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_questions_without_payments_ignore_rewards():
    inside = {"target": lambda x: jnp.abs(x[0]) - 0.3, "noise": 0.3}
    costs, rewards = both(**inside)
    cost, reward = (hjb.reach_probability(each, GRID, horizon=1.0, scheme=hjb.Upwind()) for each in (costs, rewards))
    assert np.array_equal(cost.value, reward.value)
    assert reward.labels.payoff == "cost"
    assert hjb.estimate(rewards, GRID, measure=False) == hjb.estimate(costs, GRID, measure=False)


@pytest.mark.slow
def test_pontryagin_maximises_with_the_costate_of_the_reward():
    def utility(x, u):
        return -(x @ x + u @ u)

    wide = hjb.Box([-9.0], [9.0])
    rewards = hjb.Problem(lambda x, u: u, reward=utility, controls=wide)
    best = hjb.pontryagin(rewards, [1.0])
    assert best.reward == pytest.approx(-1, abs=1e-7)
    assert best.costates[0] == pytest.approx(-2, abs=1e-5)
    assert best.values[0] == pytest.approx(-1, abs=1e-6)
    assert "of reward -1" in best.message
    # with a scrap value x at the horizon: p = 1 at the end
    final = hjb.pontryagin(rewards, [0.0], horizon=1.0, terminal=lambda x: x[0])
    assert final.costates[-1] == pytest.approx(1, abs=1e-6)
    assert final.reward > 0
    again = hjb.pontryagin(rewards, [0.0], horizon=1.0, terminal=lambda x: x[0], guess=final)
    assert again.reward == pytest.approx(final.reward)


@pytest.mark.slow
def test_optimal_growth_with_log_utility_in_closed_form():
    """Brock and Mirman in continuous time: k' = A k − c, log utility, V = (log ρ + (A − ρ)/ρ + log k)/ρ, c = ρ k."""
    gain, rho = 0.08, 0.05
    problem = hjb.Problem(  # in x = log k, with the share c/k as the control
        lambda x, u: gain - u, controls=hjb.Box([0.01], [0.15]), discount=rho,
        reward=lambda x, u: jnp.log(u[0]) + x[0],
    )  # fmt: skip
    grid = hjb.Grid([-3.0], [3.0], (61,), edges="open")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hjb.SolveWarning)
        found = hjb.solve(problem, grid)
    x = grid.axis(0)
    exact = (np.log(rho) + (gain - rho) / rho + x) / rho
    assert np.max(np.abs(found.value - exact)[20:41]) < 0.1
    assert np.max(np.abs(found.policy[20:41] - rho)) < 2e-3
    assert found.value[30] < found.value[40]  # more capital is worth more
