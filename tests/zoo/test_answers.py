"""The answers of the zoo against their own equations, and against numbers known from elsewhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hjbjax import zoo
from hjbjax.problem.rewards import costs_of
from hjbjax.problem.sets import Ball, Finite

WITH_ANSWER = [entry for entry in zoo.catalogue.values() if entry.exact is not None]


def name_of(entry):
    return entry.name


def equation_residual(problem, value, x, candidates, opponents=None):
    """β V − min_u max_d [L + f·DV + ½ tr(σσ' D²V)] at one state, over the candidates given.

    The largest of this, V − ψ, and −c − DV·e for every push.

    A reward is minus a cost.
    """
    if problem.payoff == "reward":
        problem, reward = costs_of(problem), value
        value = lambda x: -reward(x)  # noqa: E731
    slope, curvature = jax.grad(value)(x), jax.hessian(value)(x)

    def rate(u, d):
        inputs = problem.arguments(x, u, d)
        sigma = problem.diffusion(*inputs)
        diffusive = 0.5 * jnp.sum((sigma @ sigma.T) * curvature) if sigma.shape[1] else 0.0
        cost = 0.0 if problem.cost is None else problem.cost(*inputs)
        return cost + problem.drift(*inputs) @ slope + diffusive

    if opponents is None:
        best = jnp.min(jax.vmap(lambda u: rate(u, None))(candidates))
    else:
        best = jnp.min(jnp.max(jax.vmap(lambda u: jax.vmap(lambda d: rate(u, d))(opponents))(candidates), axis=1))
    residual = problem.discount * value(x) - best
    for push in problem.pushes:
        paid = push.cost if push.reward is None else -push.reward
        residual = jnp.maximum(residual, -paid - slope @ jnp.asarray(push.direction, float))
    if problem.stopping_cost is None:
        return residual
    price = problem.stopping_cost(x) if callable(problem.stopping_cost) else problem.stopping_cost
    return jnp.maximum(residual, value(x) - price)


def equation_residuals(problem, value, states, candidates, opponents=None):
    return jax.lax.map(lambda x: equation_residual(problem, value, x, candidates, opponents), states)


def directions(count):
    angles = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


ANSWERS = [
    ("bang-bang", {}, 1e-12),
    ("bang-bang", {"noise": 0.5**0.5, "discount": 0.7}, 1e-12),
    ("stochastic-lq", {}, 1e-5),
    ("stochastic-lq", {"rate": 0.3, "control_weight": 2.0, "state_weight": 1.5, "discount": 0.4}, 1e-5),
    ("double-integrator-lq", {}, 1e-5),
    ("double-integrator-lq", {"mass": 1.5, "discount": 0.6, "noise": 0.4, "control_weight": 2.0}, 1e-5),
    ("lq-game", {}, 1e-4),
    ("lq-game", {"gamma": 1.5, "rate": -0.4, "discount": 0.3}, 1e-4),
    ("brownian-exit", {}, 1e-11),
    ("brownian-exit", {"noise": 0.8, "discount": 0.5, "half_width": 1.3}, 1e-11),
    ("brownian-exit", {"dim": 2}, 1e-7),
    ("brownian-exit", {"dim": 2, "noise": 0.7, "discount": 1.1}, 1e-7),
    ("brownian-ball", {"dim": 3, "noise": 0.8}, 1e-12),
    ("double-integrator", {}, 1e-10),
    ("double-integrator", {"discount": 0.0, "mass": 1.7}, 1e-10),
    ("zermelo", {}, 1e-5),
    ("zermelo", {"speed": 1.2, "current": (-0.3, 0.6), "discount": 0.0}, 1e-5),
    ("eikonal", {}, 1e-5),
    ("eikonal", {"norm": 1, "dim": 3, "discount": 0.5}, 1e-12),
    ("eikonal", {"norm": np.inf, "speed": 2.0}, 1e-12),
    ("moon-landing", {}, 1e-10),
    ("moon-landing", {"thrust": 2.5, "consumption": 0.4, "gravity": 1.2}, 1e-10),
    ("smooth", {}, 1e-5),
    ("smooth", {"discount": 1.5}, 1e-5),
    ("merton", {}, 1e-10),
    ("merton", {"growth": 0.06, "aversion": 3.0, "interest": 0.02}, 1e-10),
    ("merton-wealth", {}, 1e-10),
    ("merton-wealth", {"growth": 0.06, "aversion": 3.0, "interest": 0.02}, 1e-10),
    ("growth", {}, 1e-10),
    ("growth", {"productivity": 0.8, "share": 0.6, "depreciation": 0.1, "discount": 0.07}, 1e-10),
    ("perpetual-put", {}, 1e-10),
    ("perpetual-put", {"strike": 40.0, "interest": 0.02, "volatility": 0.5}, 1e-10),
    ("dividends", {}, 1e-10),
    ("dividends", {"income": 0.5, "volatility": 1.2, "discount": 0.05}, 1e-10),
    ("leland", {}, 1e-10),
    ("leland", {"coupon": 3.0, "interest": 0.04, "volatility": 0.35, "payout": 0.0, "tax": 0.2}, 1e-10),
]


def candidate_controls(name, problem, parameters):
    if problem.controls is None:
        return np.zeros((1, 0))
    if isinstance(problem.controls, Finite):
        return problem.controls.points
    if name == "growth":  # the best consumption depends on the capital
        share = zoo.Ramsey(**parameters).consumption
        return share * np.linspace(*problem.controls.grid(2).points[:, 0] / share, 400_001)[:, None]
    if name in ("merton", "merton-wealth"):
        known = {k: v for k, v in parameters.items() if k != "shape"}
        system = zoo.Merton(**known)
        best = [[float(system.share), float(system.consumption)]]
        return np.concatenate([best, problem.controls.grid((41, 37)).points])
    if isinstance(problem.controls, Ball):
        return directions(2000)
    if problem.is_game:
        return problem.controls.grid(1001).points
    return problem.controls.grid(
        3 if name in ("bang-bang", "double-integrator", "eikonal", "moon-landing") else 4001
    ).points


@pytest.mark.parametrize(("name", "parameters", "tolerance"), ANSWERS)
def test_the_answer_satisfies_its_equation(name, parameters, tolerance, sample_state):
    entry = zoo.catalogue[name]
    problem, grid = entry.build(**parameters)
    value = entry.exact(**parameters)
    candidates = candidate_controls(name, problem, parameters)
    opponents = problem.disturbances.grid(1001).points if problem.is_game else None
    states = jnp.stack([sample_state(grid, seed) for seed in range(12)])
    if name == "moon-landing":  # who falls too fast has no landing, and a value that is held
        states = states[jax.jit(jax.vmap(problem.target))(states) > 0]
        assert len(states) > 4
    if name == "brownian-ball":
        states = states * 0.5
    residual = jax.jit(equation_residuals)(problem, value, states, candidates, opponents)
    scale = np.maximum(1.0, np.abs(jax.jit(jax.vmap(value))(states)))
    assert np.max(np.abs(residual) / scale) < tolerance


@pytest.mark.parametrize("entry", WITH_ANSWER, ids=name_of)
def test_a_wrong_answer_does_not_satisfy_the_equation(entry, sample_state):
    """The check above can fail: a value one per cent too steep does."""
    problem, grid = entry.build()
    value = entry.exact()
    candidates = candidate_controls(entry.name, problem, {})
    opponents = problem.disturbances.grid(1001).points if problem.is_game else None
    x = sample_state(grid, 5, shrink=0.6)
    # Nothing is paid while the rocket coasts or the owner of a put waits, so that these equations are homogeneous, and
    # a multiple of the value solves them.
    bent = {"moon-landing": lambda y: 0.01 * y[1], "perpetual-put": lambda y: 1e-4 * y[0] ** 2}
    more = bent.get(entry.name, lambda y: 0.0)
    wrong = lambda y: 1.01 * value(y) + more(y)  # noqa: E731
    off = jax.jit(lambda x: equation_residual(problem, wrong, x, candidates, opponents))(x)
    assert abs(off) > 1e-3 * min(1.0, abs(float(jax.jit(value)(x))))


@pytest.mark.parametrize("entry", WITH_ANSWER, ids=name_of)
def test_the_answer_meets_the_exit_cost(entry):
    problem, grid = entry.build()
    if problem.target is None:
        return
    nodes = grid.nodes().reshape(-1, grid.ndim)
    inside = nodes[np.asarray(jax.jit(jax.vmap(problem.target))(nodes)) <= 0]
    paid = problem.exit_cost if problem.payoff == "cost" else problem.exit_reward
    given = paid if callable(paid) else lambda x: paid or 0.0
    found, wanted = jax.jit(jax.vmap(lambda x: (entry.exact()(x), given(x))))(inside)
    if entry.name == "moon-landing":  # a number is held where no landing is possible
        found = jnp.where(jnp.isinf(found), wanted, found)
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_known_numbers():
    time = zoo.double_integrator_exact(discount=0.0)
    assert float(time([1.0, 0.0])) == pytest.approx(2.0, abs=1e-14)
    assert float(time([0.0, 1.0])) == pytest.approx(1 + 2**0.5, abs=1e-14)
    assert float(time([1.0, 1.0])) == pytest.approx(3.4494897428, abs=1e-10)
    assert float(time([-0.5, 1.0])) == pytest.approx(1.0, abs=1e-7)
    assert float(zoo.double_integrator_exact()([1.0, 0.0])) == pytest.approx(1 - np.exp(-2))
    assert float(zoo.stochastic_lq_exact()([1.0])) == pytest.approx(2 * 0.6180339887, abs=1e-9)
    assert float(zoo.lq_game_exact()([1.0])) == pytest.approx(1.1547005384, abs=1e-10)
    assert float(zoo.merton_exact()([0.0])) == pytest.approx(493.8271605, abs=1e-7)
    assert float(zoo.Merton().share) == pytest.approx(0.5)
    assert float(zoo.Merton().consumption) == pytest.approx(0.045)
    assert float(zoo.merton_wealth_exact()([1.0])) == pytest.approx(-493.8271605, abs=1e-7)
    assert float(zoo.perpetual_put_exact()([100.0])) == pytest.approx(23.21468, abs=5e-6)
    assert float(zoo.AmericanPut().boundary) == pytest.approx(52.63158, abs=5e-6)
    # without payout: Leland (1994)
    assert float(zoo.Firm(payout=0.0).boundary) == pytest.approx(0.65 * 6.0 / (0.06 + 0.02), rel=1e-12)
    assert float(zoo.growth_exact()([5.0])) == pytest.approx(52.4365730, abs=1e-6)
    assert float(zoo.Ramsey().consumption) == pytest.approx(0.2, rel=1e-12)
    assert float(zoo.brownian_exit_exact(dim=2)([0.0, 0.0])) == pytest.approx(0.589370826, abs=1e-9)
    matrix = jax.hessian(zoo.double_integrator_lq_exact())(jnp.zeros(2)) / 2
    np.testing.assert_allclose(matrix, [[3**0.5, 1], [1, 3**0.5]], atol=1e-12)


@pytest.mark.parametrize("discount", [0.0, 0.9])
def test_the_square_agrees_with_its_double_eigenseries(discount):
    x, noise = np.array([0.35, -0.2]), 0.8
    k = np.arange(1, 4001, 2)
    coefficient = 4 / (np.pi * k) * np.where(k % 4 == 1, 1.0, -1.0)
    wave = np.pi * k / 2
    rows = coefficient * np.cos(wave * x[0])
    columns = coefficient * np.cos(wave * x[1])
    rates = discount + 0.5 * noise**2 * (wave[:, None] ** 2 + wave[None, :] ** 2)
    series = rows @ (1 / rates) @ columns
    value = zoo.brownian_exit_exact(dim=2, noise=noise, discount=discount)
    assert float(value(x)) == pytest.approx(series, abs=1e-6)
    assert float(value(x[::-1])) == pytest.approx(float(value(x)), abs=1e-14)


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_least_time_is_two_arcs(position, velocity):
    """Full force to the switching curve, then along it: integrated piece by piece in closed form."""
    system = zoo.DoubleIntegrator()
    time = float(system.arrival_time(jnp.array([position, velocity])))
    side = position - float(system.switching_position(velocity))
    sign = -1.0 if side >= 0 else 1.0
    # v + s t₁ − s t₂ = 0 and t₁ + t₂ = T
    first, second = (time - sign * velocity) / 2, (time + sign * velocity) / 2
    assert first >= -1e-7
    assert second >= -1e-7
    middle = position + velocity * first + 0.5 * sign * first**2
    speed = velocity + sign * first
    end = middle + speed * second - 0.5 * sign * second**2
    assert end == pytest.approx(0.0, abs=1e-6)
    assert speed - sign * second == pytest.approx(0.0, abs=1e-12)
    assert middle == pytest.approx(float(system.switching_position(speed)), abs=1e-6)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_a_boat_arrives_when_the_water_brought_it_within_reach(a, b, east, north):
    boat = zoo.Boat(1.0, (east, north))
    time = float(boat.arrival_time(jnp.array([a, b])))
    assert time >= 0
    if np.isfinite(time):
        assert np.hypot(a + east * time, b + north * time) == pytest.approx(time, rel=1e-6, abs=1e-9)
    else:
        # The distance from the drifting origin stays above what the boat covers.
        later = np.linspace(0, 50, 5001)
        assert np.all(np.hypot(a + east * later, b + north * later) > later - 1e-6)


def test_the_discounted_time_of_the_unreachable_is_one():
    assert float(zoo.zermelo_exact(current=(2.0, 0.0))([1.0, 0.0])) == 1.0
    assert float(zoo.zermelo_exact(current=(2.0, 0.0))([-1.0, 0.0])) == pytest.approx(1 - np.exp(-1 / 3))
    assert float(zoo.zermelo_exact()([0.0, 0.0])) == 0.0


@pytest.mark.parametrize("discount", [1e-3, 1e-6, 1e-9])
def test_a_small_discount_tends_to_none(discount):
    for exact in (zoo.double_integrator_exact, zoo.zermelo_exact):
        x = [0.7, -0.4]
        assert float(exact(discount=discount)(x)) == pytest.approx(float(exact(discount=0.0)(x)), rel=4 * discount)
    one = float(zoo.brownian_exit_exact(discount=discount)([0.3]))
    assert one == pytest.approx(1 - 0.3**2, rel=2 * discount)


def test_a_damped_game_is_solvable_below_one():
    """With enough damping the disturbance is attenuated below 1: the least level is 1/√(1 + a²)."""
    value = zoo.lq_game_exact(gamma=0.8, rate=-1.0)
    problem, _ = zoo.lq_game(gamma=0.8, rate=-1.0)
    opponents = problem.disturbances.grid(2001).points
    candidates = problem.controls.grid(2001).points
    residual = jax.jit(lambda x: equation_residual(problem, value, x, candidates, opponents))(np.array([0.6]))
    assert abs(residual) < 1e-4


def test_who_crashes_has_no_least_fuel():
    """Where the margin is negative the formula of the burn gives a number, .451 here, that no path can have."""
    lander, exact = zoo.Lander(), zoo.moon_landing_exact()
    crashes = jnp.array([0.2, -1.5, 1.0])
    assert float(lander.margin(crashes)) < 0 < float(lander.fuel(crashes)) < 1
    assert float(exact(crashes)) == float(exact([-0.1, 1.0, 1.0])) == np.inf
    start = jnp.array([1.0, 0.0, 1.0])
    ignition = float(lander.ignition(start)[0])
    edge = [1 - 0.5 * ignition**2, -ignition, 1.0]  # by rounding on either side of where the burn begins
    assert float(exact(edge)) == pytest.approx(float(lander.fuel(start)), rel=1e-6)
    assert float(exact([0.0, 0.0, 0.7])) == 0.0
    assert np.all(np.isfinite(jax.grad(exact)(start)))


@pytest.mark.parametrize("dim", [1, 2])
def test_nobody_stays_in_a_cube_that_he_has_left(dim):
    value = zoo.brownian_exit_exact(dim=dim)
    for x in ([1.5] * dim, [0.2] * (dim - 1) + [3.0], [40.0] * dim):
        assert float(value(x)) == 0.0
        assert not np.any(np.asarray(jax.grad(value)(jnp.array(x))))
    assert float(value([1.0] * dim)) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    "answer",
    [
        lambda number: zoo.double_integrator_exact(mass=number),
        lambda number: zoo.zermelo_exact(speed=number),
        lambda number: zoo.eikonal_exact(speed=number),
    ],
)
def test_derivatives_at_the_corner_of_a_distance(answer):
    """They were NaN at the origin, and so was every derivative of a solve that holds the answer there."""
    for state in (jnp.zeros(2), jnp.array([0.3, -0.2])):
        slope = jax.grad(lambda number, x=state: answer(number)(x))(1.1)
        assert jnp.isfinite(slope)
        assert (slope == 0) == (not jnp.any(state))
