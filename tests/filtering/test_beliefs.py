"""Beliefs of hidden chains: Ito's formula on the simplex, bounds and limits of the value, an oracle in plain NumPy."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_rates import rates

import hjbjax as hjb
from hjbjax.filtering import belief_problem
from hjbjax.problem.pytree import pytree_dataclass

SEEDS = st.integers(0, 2**32 - 1)


@pytree_dataclass()
class Chain:
    """Rates and costs affine in the control; their numbers are leaves, so that nothing compiles again."""

    idle: object
    busy: object
    costs: object

    def generator(self, u):
        return jnp.asarray(self.idle) + u[0] * jnp.asarray(self.busy)

    def cost(self, u):
        return jnp.asarray(self.costs)[0] + u[0] * jnp.asarray(self.costs)[1]


def random_chain(rng, states):
    return Chain(rates(rng, states), rates(rng, states, 2.0), rng.uniform(0, 1, (2, states)))


def machine():
    """A machine fails at the rate .2; a repair at the rate 2 costs 2 per unit time while it runs, 0 while it stands."""
    return Chain(
        np.array([[-0.2, 0.2], [0.0, 0.0]]), np.array([[0.0, 0.0], [1.0, -1.0]]), np.array([[0.0, 1.0], [2.0, 0.0]])
    )


SWITCH = hjb.Finite([[0.0], [2.0]])


def posed(chain, h, controls=SWITCH, discount=0.5, **options):
    return belief_problem(chain.generator, h, chain.cost, controls=controls, discount=discount, **options)


def solved(question, tol=1e-7):
    return hjb.solve(question.problem, question.grid, tol=tol, scheme=hjb.Upwind())


def fully_observed(chain, actions, discount):
    """V_i of a controller that sees the state: the best of all policies, each by a linear solve."""
    states = len(chain.idle)
    matrices = [chain.idle + u * chain.busy for u in actions]
    paid = [chain.costs[0] + u * chain.costs[1] for u in actions]
    values = []
    for policy in itertools.product(range(len(actions)), repeat=states):
        rows = np.array([matrices[a][i] for i, a in enumerate(policy)])
        values.append(np.linalg.solve(discount * np.eye(states) - rows, [paid[a][i] for i, a in enumerate(policy)]))
    return np.min(values, axis=0)


# --- the diffusion ---


@jax.jit
def both_generators(question, h, noise, belief, u, weights):
    """Those of a smooth function of π: by the problem of the belief, and by Wonham's equation; and two costs."""
    problem, coordinates = question.problem, question.coordinates

    def smooth(pi):
        return jnp.sin(weights @ pi) + pi[0] * pi[1] ** 2

    def here(x):
        return smooth(coordinates.to_belief(x))

    x, chain = coordinates.from_belief(belief), problem.drift.args[0]
    sigma = problem.diffusion(x, u)
    ours = problem.drift(x, u) @ jax.grad(here)(x) + jnp.trace(sigma @ sigma.T @ jax.hessian(here)(x)) / 2
    gains = belief[:, None] * (h - belief @ h) / noise
    theirs = chain.generator(u).T @ belief @ jax.grad(smooth)(belief)
    theirs += jnp.trace(gains @ gains.T @ jax.hessian(smooth)(belief)) / 2
    return ours, theirs, problem.cost(x, u), belief @ chain.running(u), coordinates.to_belief(x)


@pytest.mark.parametrize(
    ("states", "sensors"),
    [pytest.param(2, 2, marks=pytest.mark.slow), (3, 1), pytest.param(4, 2, marks=pytest.mark.slow)],
)
@given(seed=SEEDS)
@settings(max_examples=15)
def test_itos_formula_on_the_simplex(states, sensors, seed):
    """The generator of any smooth function of π, in the coordinates of the grid and by Wonham's equation."""
    rng = np.random.default_rng(seed)
    chain, h = random_chain(rng, states), rng.normal(size=(states, sensors))
    noise = rng.uniform(0.3, 2, sensors)
    question = posed(chain, h, measurement_noise=noise)
    with jax.enable_x64(True):
        belief = rng.dirichlet(np.ones(states)) * 0.9 + 0.1 / states
        asked = (belief, np.array([2.0]), rng.normal(size=states))
        ours, theirs, cost, expected, back = map(np.asarray, both_generators(question, h, noise, *asked))
    assert ours == pytest.approx(theirs, rel=1e-9, abs=1e-9)
    assert cost == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(back, belief, atol=1e-12)


@given(seed=SEEDS)
@settings(max_examples=15)
def test_no_drift_leads_out_of_the_interval_and_no_noise(seed):
    rng = np.random.default_rng(seed)
    question = posed(random_chain(rng, 2), rng.normal(size=2))
    for u, (end, inward) in itertools.product((0.0, 0.7, 2.0), ((0.0, 1), (1.0, -1))):
        x = jnp.array([end])
        assert inward * float(question.problem.drift(x, jnp.array([u]))[0]) >= 0
        assert float(question.problem.noise(x, jnp.array([u]))[0]) == 0


# --- the value ---


@functools.cache
def machine_values():
    """V of the machine on 401 nodes by the noise of its sensor, from hardly any to hardly anything seen."""
    return {r: solved(posed(machine(), [1.0, 0.0], measurement_noise=r, nodes=401)).value for r in (0.01, 0.1, 1, 100)}


@pytest.mark.slow
def test_the_better_it_sees_the_less_it_pays_and_between_full_and_no_observation():
    values = machine_values()
    pi = np.linspace(0, 1, 401)
    seen = np.stack([pi, 1 - pi], axis=1) @ fully_observed(machine(), (0.0, 2.0), 0.5)
    blind = solved(posed(machine(), [0.0, 0.0], nodes=401)).value
    ordered = [seen, *(values[r] for r in sorted(values)), blind]
    for better, worse in itertools.pairwise(ordered):
        assert np.all(better <= worse + 2e-3)  # the error of the grid, where the two are equal
    assert np.max(values[0.1] - values[0.01]) > 0.05


def test_a_perfect_sensor_is_full_observation():
    """At every belief, and at the corners, as r goes to zero; from above."""
    exact = fully_observed(machine(), (0.0, 2.0), 0.5)[::-1]  # at π₁ = 0 the machine stands
    gaps = []
    for r in (0.2, 0.05, 0.0125):
        solution = solved(posed(machine(), [1.0, 0.0], measurement_noise=r, nodes=801))
        gaps.append(solution.value[[0, -1]] - exact)
    gaps = np.array(gaps)
    assert np.all(gaps > 0)
    assert np.all(np.diff(gaps, axis=0) < 0)
    assert np.all(gaps[-1] < 0.03 * exact)


@pytest.mark.slow
def test_the_value_is_concave_and_of_second_order_in_the_nodes():
    for value in machine_values().values():
        assert np.max(np.diff(value, 2)) < 1e-6
    coarse = {n: solved(posed(machine(), [1.0, 0.0], nodes=n)).value for n in (26, 51, 101, 801)}
    errors = [np.max(np.abs(coarse[n] - coarse[801][:: 800 // (n - 1)])) for n in (26, 51, 101)]
    assert -np.polyfit(range(3), np.log2(errors), 1)[0] >= 1.5


@pytest.mark.slow
@given(seed=SEEDS)
@settings(max_examples=8)
def test_random_chains_lie_between_full_and_no_observation(seed):
    rng = np.random.default_rng(seed)
    chain, pi = random_chain(rng, 2), np.linspace(0, 1, 101)
    value = solved(posed(chain, np.array([1.0, 0.0]), nodes=101)).value
    blind = solved(posed(chain, np.array([0.0, 0.0]), nodes=101)).value
    seen = np.stack([pi, 1 - pi], axis=1) @ fully_observed(chain, (0.0, 2.0), 0.5)
    slack = 2e-3 * np.ptp(blind) + 1e-6
    assert np.all(value >= seen - slack)
    assert np.all(value <= blind + slack)
    # upwinding adds noise where drift rules, whose gain concavity is: bent up nowhere by more than rounding
    assert np.max(np.diff(value, 2)) <= 1e-6


@pytest.mark.slow
def test_a_sensor_that_costs_is_switched_on_only_where_it_pays():
    """Dual control: h(u) = u₂ (1, 0) at a price; worth nothing where the state is known."""
    base = machine()
    question = belief_problem(
        base.generator,
        lambda u: u[1] * jnp.array([3.0, 0.0]),
        lambda u: base.cost(u) + 0.05 * u[1],
        controls=hjb.Finite([[0.0, 0.0], [0.0, 1.0], [2.0, 0.0], [2.0, 1.0]]),
        discount=0.5,
    )
    solution = solved(question)
    watches = solution.policy[:, 1] > 0.5
    assert watches.any()
    assert not watches[0]  # known to stand: repaired, unseen
    free = solved(posed(base, [3.0, 0.0])).value
    blind = solved(posed(base, [0.0, 0.0])).value
    assert np.all(free <= solution.value + 1e-6)
    assert np.all(solution.value <= blind + 2e-3)
    assert np.max(blind - solution.value) > 0.05


@pytest.mark.slow
def test_the_value_has_derivatives_in_the_numbers_of_the_chain():
    """In the failure rate and in the noise of the sensor, against differences."""

    def worth(rate, noise):
        base = machine()
        idle = jnp.stack([jnp.stack([-rate, rate]), jnp.zeros(2)])
        question = posed(Chain(idle, base.busy, base.costs), [1.0, 0.0], measurement_noise=noise, nodes=51)
        return hjb.solve(question.problem, question.grid, tol=1e-9, throw=False, scheme=hjb.Upwind()).value[25]

    with jax.enable_x64(True):
        slopes = jax.grad(worth, argnums=(0, 1))(0.2, 1.0)
        step = 1e-4
        rate = (worth(0.2 + step, 1.0) - worth(0.2 - step, 1.0)) / (2 * step)
        noise = (worth(0.2, 1.0 + step) - worth(0.2, 1.0 - step)) / (2 * step)
    assert float(slopes[0]) == pytest.approx(float(rate), rel=1e-3)
    assert float(slopes[1]) == pytest.approx(float(noise), rel=1e-3)


# --- another way to the answer ---


def discrete_value(chain, h, r, actions, discount, dt, count):
    """A belief grid, steps dt, Bayes' rule at Gauss–Hermite points of dy, linear interpolation, value iteration."""
    from scipy.linalg import expm

    pi = np.linspace(0, 1, count)
    points, weights = np.polynomial.hermite_e.hermegauss(9)
    weights = weights / weights.sum()
    tables = []
    for u in actions:
        moved = np.stack([pi, 1 - pi], axis=1) @ expm((chain.idle + u * chain.busy) * dt)
        paid = np.stack([pi, 1 - pi], axis=1) @ (chain.costs[0] + u * chain.costs[1]) * dt
        branches = []
        for state, (point, weight) in itertools.product((0, 1), zip(points, weights, strict=True)):
            dy = h[state] * dt + r * np.sqrt(dt) * point
            likely = moved * np.exp((h * dy - h**2 * dt / 2) / r**2)
            branches.append((weight * moved[:, state], likely[:, 0] / likely.sum(axis=1)))
        tables.append((paid, branches))
    value = np.zeros(count)
    for _ in range(20_000):
        after = [p + np.exp(-discount * dt) * sum(w * np.interp(to, pi, value) for w, to in b) for p, b in tables]
        new = np.min(after, axis=0)
        if np.max(np.abs(new - value)) < 1e-6:
            return new
        value = new
    raise AssertionError("value iteration did not end")


def test_a_discretised_decision_problem_has_the_same_value():
    chain, h = machine(), np.array([1.0, 0.0])
    values = {}
    for dt in (0.0125, 0.00625):
        values[dt] = discrete_value(chain, h, 0.5, (0.0, 2.0), 0.5, dt, 801)
    ours = solved(posed(chain, h, measurement_noise=0.5, nodes=801)).value
    # held longer, controls and looks cost more, in proportion to dt
    limit = 2 * values[0.00625] - values[0.0125]
    np.testing.assert_allclose(ours, limit, atol=1.5e-3)
    assert np.max(np.abs(ours - limit)) < 0.25 * np.max(np.abs(ours - values[0.0125]))


# --- three states ---


def worn():
    """Good, worn, failed; what is repaired is good again."""
    idle = np.array([[-0.3, 0.2, 0.1], [0.0, -0.4, 0.4], [0.0, 0.0, 0.0]])
    busy = np.array([[0.0, 0.0, 0.0], [0.5, -0.5, 0.0], [1.0, 0.0, -1.0]])
    return Chain(idle, busy, np.array([[0.0, 0.4, 1.5], [1.0, 1.0, 0.2]]))


@pytest.mark.slow
def test_three_states_between_full_and_no_observation_and_on_edges_those_of_two():
    chain = worn()
    question = posed(chain, [1.0, 0.4, 0.0], measurement_noise=0.7, nodes=41)
    solution = solved(question, tol=1e-5)
    beliefs = np.random.default_rng(0).dirichlet([2, 2, 2], 50)
    values = solution.value_at(question.coordinates.from_belief(beliefs), clamp=True)
    seen = beliefs @ fully_observed(chain, (0.0, 2.0), 0.5)
    assert np.all(values > seen)
    blind = posed(chain, [1.0, 0.4, 0.0], measurement_noise=1e3, nodes=41)
    unseen = solved(blind, tol=1e-5).value_at(blind.coordinates.from_belief(beliefs), clamp=True)
    assert np.all(values < unseen + 0.02)
    assert np.mean(unseen - values) > 0.02


@pytest.mark.slow
def test_a_third_state_that_is_as_the_second_changes_nothing():
    """Two equal states are one: V(π₁, π₂ + π₃) of the chain of two."""
    two = machine()
    both = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.5]])  # leave the first for either of the others
    lump = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    three = Chain(*(lump @ each @ both for each in (two.idle, two.busy)), two.costs @ lump.T)
    fix = [each - np.diag(each.sum(axis=1)) for each in (three.idle, three.busy)]
    for matrix in fix:  # jumps between the twins are as good as none
        matrix[[1, 2], [2, 1]] = 0
        matrix[np.arange(3), np.arange(3)] = 0
        matrix[np.arange(3), np.arange(3)] = -matrix.sum(axis=1)
    three = Chain(*fix, three.costs)
    question = posed(three, [1.0, 0.0, 0.0], nodes=(81, 41), floor=1e-3)
    solution = solved(question, tol=1e-5)
    simple = solved(posed(two, [1.0, 0.0], nodes=401))
    errors = []
    for first in (0.2, 0.5, 0.8):
        x = question.coordinates.from_belief(np.array([first, (1 - first) / 2, (1 - first) / 2]))
        errors.append(float(solution.value_at(x)) - float(simple.value_at([first])))
    assert np.max(np.abs(errors)) < 0.03


# --- refusals ---


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"generator": [[1.0, -1.0], [0.0, 0.0]]}, r"has the rate -1 from state 0 to 1; wanted rates ≥ 0"),
        ({"generator": [[-1.0, 2.0], [0.0, 0.0]]}, r"has a row 0 that sums to 1, wanted zero"),
        ({"generator": [[-1.0, 1.0 + 1e-9], [0.0, 0.0]]}, r"has a row 0 that sums to 1e-09, wanted zero"),
        ({"generator": [-1.0, 2.0]}, r"generator returns shape \(2,\), wanted \(S, S\)"),
        ({"generator": [[np.nan, 1.0], [0.0, 0.0]]}, r"generator is not finite"),
        ({"h": [1.0, 2.0, 3.0]}, r"h has shape \(3,\), wanted \(2,\) or \(2, 3\)"),
        ({"cost": lambda u: u[0]}, r"cost has shape \(\), wanted \(2,\)"),
        ({"discount": 0.0}, r"discount = 0.0; wanted a finite number > 0, per unit time"),
        ({"measurement_noise": 0.0}, r"measurement_noise = 0.0; wanted finite numbers > 0"),
        ({"measurement_noise": [1.0, 1.0]}, r"measurement_noise has shape \(2,\), wanted \(\) or \(1,\)"),
        ({"nodes": (11, 11)}, r"nodes = \(11, 11\); wanted a count or 1 of them"),
        ({"nodes": 2}, r"nodes = 2; wanted an integer of at least 3"),
        ({"floor": 0.0}, r"floor = 0.0; wanted a number between 0 and 1"),
    ],
)
def test_what_is_no_hidden_chain_is_refused(changes, reason):
    chain = machine()
    given = {"generator": chain.generator, "h": [1.0, 0.0], "cost": chain.cost} | changes
    options = {"discount": 0.5, "controls": SWITCH} | {
        k: v for k, v in given.items() if k not in ("generator", "h", "cost")
    }
    with pytest.raises(ValueError, match="belief_problem: .*" + reason) as caught:
        belief_problem(given["generator"], given["h"], given["cost"], **options)
    assert len(str(caught.value).splitlines()) <= 6


def test_sensors_without_common_axes_are_refused_with_the_way_out():
    chain = worn()
    with pytest.raises(ValueError, match="no common axes, wanted .* that commute. With 3 states"):
        posed(chain, lambda u: jnp.stack([1 + u[0], 1 - u[0], 0 * u[0]]))
