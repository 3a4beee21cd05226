"""Wonham's filter and closed loops of hidden chains: Bayes by enumeration, laws, what control of a belief is worth."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_rates import rates
from scipy.linalg import expm

import hjbjax as hjb
from hjbjax.filtering import Observer, WonhamFilter, belief_problem, simulate_hidden
from hjbjax.filtering.hidden_chain import transition_matrix

SEEDS = st.integers(0, 2**32 - 1)


# --- the filter ---

compiled_matrix = jax.jit(transition_matrix)


@given(seed=SEEDS)
@settings(max_examples=30)
def test_transition_matrices_are_those_of_scipy_and_never_negative(seed):
    rng = np.random.default_rng(seed)
    generator, dt = rates(rng, 3, 10 ** rng.uniform(-3, 3)), 10 ** rng.uniform(-3, 1)
    with jax.enable_x64(True):
        ours = np.asarray(compiled_matrix(generator, dt))
    np.testing.assert_allclose(ours, expm(generator * dt), atol=1e-11)
    assert np.all(ours >= 0)
    np.testing.assert_allclose(ours.sum(axis=1), 1, atol=1e-14)


@jax.jit
def _step(generator, h, prior, noise, dy, dt):
    observer = WonhamFilter(generator, h, prior, measurement_noise=noise)
    return observer.update(observer.initial(), jnp.zeros(0), dy, dt)


@given(seed=SEEDS)
@settings(max_examples=20)
def test_a_step_is_bayes_rule(seed):
    """P(x₁ | dy) by enumeration of where the chain was at both half steps."""
    rng = np.random.default_rng(seed)
    generator, h, noise = rates(rng, 3, 3.0), rng.normal(size=(3, 2)), rng.uniform(0.2, 2, 2)
    prior, dt = rng.dirichlet(np.ones(3)), 10 ** rng.uniform(-3, 0)
    dy = h[1] * dt + np.sqrt(dt) * noise * rng.normal(size=2)
    half = expm(generator * dt / 2)
    exponent = -np.sum(((dy - h * dt) / noise) ** 2, axis=1) / (2 * dt)
    likelihood = np.exp(exponent - exponent.max())
    wanted = np.zeros(3)
    for before, within, after in itertools.product(range(3), repeat=3):
        wanted[after] += prior[before] * half[before, within] * likelihood[within] * half[within, after]
    with jax.enable_x64(True):
        found = _step(generator, h, prior, noise, dy, dt)
    np.testing.assert_allclose(found, wanted / wanted.sum(), rtol=1e-9, atol=1e-12)


def test_overwhelming_evidence_neither_overflows_nor_contradicts_what_is_impossible():
    stays = np.zeros((3, 3))
    observer = WonhamFilter(stays, [0.0, 100.0, 200.0], [0.5, 0.5, 0.0], measurement_noise=1e-3)
    assert isinstance(observer, Observer)
    found = observer.update(observer.initial(), jnp.zeros(0), jnp.array([20.0]), 0.1)  # as of the third
    np.testing.assert_allclose(found, [0, 1, 0], atol=1e-12)


def test_steps_of_half_the_length_have_a_quarter_of_the_error():
    """A smooth record: the splitting is of second order."""
    generator = np.array([[-1.0, 1.0], [2.0, -2.0]])
    ends = []
    with jax.enable_x64(True):
        observer = WonhamFilter(generator, [1.0, -1.0], [0.7, 0.3], measurement_noise=0.5)
        update = jax.jit(observer.update)
        for count in (8, 16, 32, 256):
            edges, belief = np.linspace(0, 1, count + 1), observer.initial()
            for dy in np.diff(np.sin(3 * edges)):
                belief = update(belief, jnp.zeros(0), jnp.array([dy]), 1 / count)
            ends.append(float(belief[0]))
    errors = np.abs(np.array(ends[:3]) - ends[3])
    assert -np.polyfit(range(3), np.log2(errors), 1)[0] == pytest.approx(2, abs=0.2)


# --- the closed loop ---

IDLE, BUSY = np.array([[-0.2, 0.2], [0.0, 0.0]]), np.array([[0.0, 0.0], [1.0, -1.0]])
SENSOR, NOISE, DISCOUNT = [1.0, 0.0], 1.0, 0.3


def repaired(u):
    return jnp.asarray(IDLE) + u[0] * jnp.asarray(BUSY)


def price(u):
    """A stop costs 1 per unit time; repairs at the rate 2 cost 2.4, whether or not there is something to repair."""
    return jnp.stack([1.2 * u[0], 1 + 1.2 * u[0]])


OBSERVER = WonhamFilter(repaired, SENSOR, [0.5, 0.5], measurement_noise=NOISE)


def never(belief):
    return jnp.zeros(1)


def test_simulated_chains_have_the_law_of_the_chain_and_beliefs_are_calibrated():
    keys = jax.random.split(jax.random.key(0), 4000)
    path = simulate_hidden(OBSERVER, lambda belief: jnp.array([0.5]), price, duration=2.0, dt=0.1, key=keys)
    law = np.array([0.5, 0.5]) @ expm((IDLE + 0.5 * BUSY) * 2.0)
    off = np.sqrt(law[0] * law[1] / 4000)
    assert abs(np.mean(path.hidden[:, -1] == 0) - law[0]) < 4 * off
    # E[1{x = 0} | π] = π: the martingale tested against 1, π and a threshold
    last = path.beliefs[:, -1, 0]
    assert last.std() > 0.1
    miss = (path.hidden[:, -1] == 0) - last
    for weight in (np.ones(4000), last, last > 0.5):
        assert abs(np.mean(miss * weight)) < 4 * np.std(miss * weight) / np.sqrt(4000)
    assert np.all(path.beliefs >= 0)
    np.testing.assert_allclose(path.beliefs.sum(axis=-1), 1, atol=1e-12)


@pytest.mark.slow
def test_one_key_is_one_lane_and_an_integer_is_a_key():
    options = {"duration": 1.0, "dt": 0.1, "discount": DISCOUNT}
    many = simulate_hidden(OBSERVER, never, price, key=jax.random.split(jax.random.key(3), 2), **options)
    one = simulate_hidden(OBSERVER, never, price, key=jax.random.split(jax.random.key(3), 2)[1], **options)
    np.testing.assert_allclose(many.beliefs[1], one.beliefs, atol=1e-12)
    assert many.cost[1] == pytest.approx(float(one.cost), abs=1e-12)
    assert (one.times.shape, one.hidden.shape, one.controls.shape, one.measurements.shape) == (
        (11,),
        (11,),
        (10, 1),
        (10, 1),
    )
    known = simulate_hidden(OBSERVER, never, price, key=3, start=1, **options)
    assert known.hidden[0] == 1
    again = simulate_hidden(OBSERVER, never, price, key=jax.random.key(3), start=1, **options)
    np.testing.assert_array_equal(known.beliefs, again.beliefs)


@pytest.mark.slow
def test_costs_of_a_fixed_control_are_those_of_the_chain():
    """(β − A)⁻¹ c from the prior, less what is left after the duration."""
    keys = jax.random.split(jax.random.key(1), 4000)
    path = simulate_hidden(
        OBSERVER, lambda b: jnp.array([1.0]), price, duration=4.0, dt=0.1, key=keys, discount=DISCOUNT
    )
    generator, cost = IDLE + BUSY, np.array([1.2, 2.2])
    endless = np.linalg.solve(DISCOUNT * np.eye(2) - generator, cost)
    wanted = np.array([0.5, 0.5]) @ (endless - np.exp(-DISCOUNT * 4) * expm(generator * 4) @ endless)
    assert abs(path.cost.mean() - wanted) < 4 * path.cost.std() / np.sqrt(4000)
    free = simulate_hidden(OBSERVER, never, lambda u: jnp.ones(2), duration=4.0, dt=0.1, key=0)
    assert float(free.cost) == pytest.approx(4, rel=1e-12)


@pytest.mark.slow
def test_the_control_of_the_belief_beats_certainty_equivalence_and_costs_its_value():
    """Repairs pay where the machine is likely to stand; who trusts the likelier state starts too late or too soon."""
    machine = belief_problem(
        repaired, SENSOR, price, controls=hjb.Finite([[0.0], [2.0]]), discount=DISCOUNT, measurement_noise=NOISE
    )
    solution = hjb.solve(machine.problem, machine.grid, tol=1e-6)

    def of_belief(belief):
        return solution.control_at(machine.coordinates.from_belief(belief), clamp=True)

    seen = np.array([0.0, 2.0])  # of who sees the state: run while it runs, repair while it stands
    values = {}
    for policy in itertools.product((0.0, 2.0), repeat=2):
        rows = np.array([(IDLE + u * BUSY)[i] for i, u in enumerate(policy)])
        paid = np.array([np.asarray(price([u]))[i] for i, u in enumerate(policy)])
        values[policy] = np.linalg.solve(DISCOUNT * np.eye(2) - rows, paid)
    assert all(np.all(values[tuple(seen)] <= each + 1e-12) for each in values.values())

    def equivalent(belief):  # as if the likelier state were the state
        return jnp.asarray(seen)[jnp.argmax(belief)][None]

    keys = jax.random.split(jax.random.key(2), 600)
    options = {"duration": 15.0, "dt": 0.1, "key": keys, "discount": DISCOUNT}
    optimal = simulate_hidden(OBSERVER, of_belief, price, **options).cost
    naive = simulate_hidden(OBSERVER, equivalent, price, **options).cost
    gain = naive - optimal  # of the same draws
    assert gain.mean() > 3 * gain.std() / np.sqrt(len(keys))
    promised = float(solution.value_at([0.5]))
    # held for dt the control loses a little, and e^{−4.5} of the cost comes after the duration
    assert abs(optimal.mean() - promised) < 4 * optimal.std() / np.sqrt(len(keys)) + 0.06


def worn(u):
    """Good, worn, failed: the second wears faster, and a repair makes all of them new."""
    wear = np.array([[-0.3, 0.2, 0.1], [0.0, -0.4, 0.4], [0.0, 0.0, 0.0]])
    return jnp.asarray(wear) + u[0] * jnp.array([[0.0, 0.0, 0.0], [0.5, -0.5, 0.0], [1.0, 0.0, -1.0]])


def worn_price(u):
    return jnp.array([0.0, 0.4, 1.5]) + u[0] * jnp.array([1.0, 1.0, 0.2])


@functools.cache
def worn_machine():
    """The problem of the beliefs about it, and its solution."""
    question = belief_problem(
        worn, [1.0, 0.4, 0.0], worn_price, controls=hjb.Finite([[0.0], [2.0]]), discount=0.5, measurement_noise=0.7,
        nodes=161,
    )  # fmt: skip
    return question, hjb.solve(question.problem, question.grid, tol=1e-5, scheme=hjb.Upwind())


@pytest.mark.slow
@pytest.mark.parametrize("prior", [[0.8, 0.1, 0.1], [0.2, 0.3, 0.5]])
@pytest.mark.optimised
def test_three_states_cost_in_simulation_what_the_value_in_logarithms_promises(prior):
    """Ito's terms and all: paths of the chain and of its filter know nothing of the coordinates."""
    question, solution = worn_machine()

    def of_belief(belief):
        return solution.control_at(question.coordinates.from_belief(belief), clamp=True)

    observer = WonhamFilter(worn, [1.0, 0.4, 0.0], prior, measurement_noise=0.7)
    keys = jax.random.split(jax.random.key(5), 4000)
    cost = simulate_hidden(observer, of_belief, worn_price, duration=16.0, dt=0.02, key=keys, discount=0.5).cost
    promised = float(solution.value_at(question.coordinates.from_belief(np.array(prior))))
    assert abs(cost.mean() - promised) < 4 * cost.std() / np.sqrt(4000) + 0.01


# --- refusals ---


def simulated(control=never, cost=price, observer=OBSERVER):
    return simulate_hidden(observer, control, cost, duration=1.0, dt=0.1, key=0)


@pytest.mark.parametrize(
    ("build", "reason"),
    [
        (lambda: WonhamFilter(IDLE, SENSOR, [-0.1, 1.1]), r"prior = \[-0.1, 1.1\]; wanted \(S,\) numbers ≥ 0"),
        (lambda: WonhamFilter(IDLE, SENSOR, [0.0, 0.0]), r"not all zero"),
        (lambda: WonhamFilter(-IDLE, SENSOR, [0.5, 0.5]), r"has the rate -0.2 from state 0 to 1"),
        (lambda: WonhamFilter(IDLE, SENSOR, [0.2, 0.3, 0.5]), r"generator has shape \(2, 2\), wanted \(3, 3\)"),
        (lambda: WonhamFilter(IDLE, [1.0, 2.0, 3.0], [0.5, 0.5]), r"h has shape \(3,\), wanted \(2,\) or \(2, p\)"),
        (lambda: WonhamFilter(IDLE, SENSOR, [0.5, 0.5], measurement_noise=0.0), r"measurement_noise = 0.0"),
        (lambda: simulate_hidden(OBSERVER, never, price, duration=-1.0, dt=0.1, key=0), r"duration = -1.0"),
        (
            lambda: simulate_hidden(OBSERVER, never, price, duration=1.0, dt=2.0, key=0),
            r"dt = 2.0; wanted .* at most 1",
        ),
        (
            lambda: simulate_hidden(OBSERVER, never, price, duration=1.0, dt=0.1, key=0, start=2),
            r"start = 2; wanted a state",
        ),
        (
            lambda: simulate_hidden(OBSERVER, never, lambda u: u[0], duration=1.0, dt=0.1, key=0),
            r"cost returns shape \(\)",
        ),
        (
            lambda: simulate_hidden(OBSERVER, lambda b: 0.0, price, duration=1.0, dt=0.1, key=0),
            r"control returns shape \(\)",
        ),
        (lambda: simulate_hidden(OBSERVER, never, price, duration=1.0, dt=0.1, key=0, discount=-1), r"discount = -1"),
        (lambda: WonhamFilter(np.nan * IDLE, SENSOR, [0.5, 0.5]), r"the generator = .* wanted finite numbers"),
        (lambda: WonhamFilter(IDLE[:1], SENSOR, [0.5, 0.5]), r"the generator has shape \(1, 2\), wanted \(S, S\)"),
        (lambda: WonhamFilter(IDLE, [1.0, np.nan], [0.5, 0.5]), r"h = \[1.0, nan\], wanted finite numbers"),
        (lambda: simulated(cost=lambda u: jnp.array([jnp.nan, 1.0])), r"cost at u = .* is \[nan, 1.0\]"),
        (lambda: simulated(lambda belief: jnp.where(belief[:1] < 2, jnp.nan, 0)), r"the generator at|control returned"),
        (lambda: simulated(observer=WonhamFilter(lambda u: -IDLE, SENSOR, [0.5, 0.5])), r"the generator .* rate -0.2"),
        (
            lambda: simulated(observer=WonhamFilter(IDLE, lambda u: jnp.ones(3), [0.5, 0.5])),
            r"h returns shape \(3, 1\)",
        ),
    ],
)
def test_what_cannot_be_filtered_or_simulated_is_refused(build, reason):
    with pytest.raises(ValueError, match=reason) as caught:
        build()
    assert len(str(caught.value).splitlines()) <= 6


@pytest.mark.parametrize("key", [None, True, 1.5, "a", 2**70, jnp.zeros(2), jnp.zeros((2, 2), jnp.uint32)[None]])
def test_what_is_no_key_is_refused(key):
    with pytest.raises(ValueError, match="simulate_hidden: key is .*, wanted a .*JAX random key"):
        simulate_hidden(OBSERVER, never, price, duration=1.0, dt=0.5, key=key)
