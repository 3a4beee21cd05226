"""Verdicts on vector fields do not depend on units: ranks, relative degree, Lyapunov functions, Brockett's rule."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from linear_plants import Linear

import hjbjax as hjb
from hjbjax import geometry, zoo
from hjbjax.geometry import stability
from hjbjax.geometry.distributions import _reach, _span_of_generations

pytestmark = pytest.mark.usefixtures("float64")


def motor(inductance):
    """A DC motor, state (angle, speed, current), of 1 Ω, k = 0.1 and J = 0.01."""
    a = np.array([[0.0, 1.0, 0.0], [0.0, -0.1, 10.0], [0.0, -0.1 / inductance, -1.0 / inductance]])
    return Linear(a, np.array([0.0, 0.0, 1.0 / inductance]), np.array([1.0, 0.0, 0.0]))


# Ranks


@pytest.mark.slow
@pytest.mark.parametrize("inductance", [1e-3, 1e-6, 1e-9])
def test_a_stiff_motor_is_controllable_at_every_depth(inductance):
    plant = motor(inductance)
    ranks = [geometry.reachability_distribution(plant.drift, plant.push, np.zeros(3), depth).rank for depth in range(5)]
    assert ranks == [1, 2, 3, 3, 3]
    seen = geometry.observability_codistribution(plant.drift, plant.push, plant.output, np.zeros(3), 2)
    assert seen.rank == 3
    assert min(seen.margin, geometry.reachability_distribution(plant.drift, plant.push, np.zeros(3), 2).margin) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("stiffness", "inertia"), [(1e4, 1e-2), (1e6, 1e-4), (1e9, 1e-6)])
def test_a_stiff_joint_is_controllable_and_observable(stiffness, inertia):
    arm = zoo.FlexibleJoint(stiffness=stiffness, motor=inertia)
    f, gs = geometry.affine_fields(arm.drift, 1)
    for state in (np.zeros(4), [2.0, -1.0, 1.5, 0.7]):
        assert geometry.reachability_distribution(f, gs, state, 3).rank == 4
        assert geometry.observability_codistribution(f, gs, arm.output, state, 3).rank == 4


def invertible(random, states):
    """A matrix of integers with an inverse of integers, and that inverse."""
    there, back = np.eye(states), np.eye(states)
    for _ in range(2 * states):
        i, j = random.choice(states, 2, replace=False)
        shear = np.eye(states)
        shear[i, j] = random.integers(-1, 2)
        there = shear @ there
        shear[i, j] *= -1
        back = back @ shear
    return there, back


@pytest.mark.parametrize("seed", range(12))
def test_linear_systems_have_the_exact_rank_of_kalman_in_any_units(seed):
    """Against SymPy on integers; then every state, time and input in units up to 1e12 apart."""
    random, n = np.random.default_rng(seed), 4
    reached = n if seed % 2 else random.integers(1, n)
    a, b = random.integers(-3, 4, (n, n)).astype(float), random.integers(-2, 3, n).astype(float)
    a[reached:, :reached], b[reached:] = 0, 0
    there, back = invertible(random, n)
    a, b = there @ a @ back, there @ b
    c = random.integers(-2, 3, n).astype(float)
    exact, push, row = (sympy.Matrix(m.astype(int).tolist()) for m in (a, b[:, None], c[None]))
    kalman = sympy.Matrix.hstack(*[exact**k * push for k in range(n)]).rank()
    seen = sympy.Matrix.vstack(*[row * exact**k for k in range(n)]).rank()
    for spread in (0, 3, 6):
        units = 10 ** random.uniform(-spread, spread, n)
        time, size = 10 ** random.uniform(-spread, spread, 2)
        plant = Linear(time * units[:, None] * a / units, size * units * b, c / units)
        rank = geometry.reachability_distribution(plant.drift, plant.push, np.zeros(n), n - 1).rank
        observed = geometry.observability_codistribution(plant.drift, [], plant.output, np.zeros(n), n - 1).rank
        assert (rank, observed) == (kalman, seen), spread


@pytest.mark.slow
def test_what_is_out_of_reach_stays_out_of_reach():
    # Two equal pendulums under one torque move alike; a mode by itself does not move; cos(π/2) is rounding.
    pair = geometry.affine_fields(lambda x, u: jnp.stack([x[1], jnp.sin(x[0]) + u[0], x[3], jnp.sin(x[2]) + u[0]]), 1)
    for state in (np.zeros(4), [0.3, 0.1, 0.3, 0.1]):
        assert geometry.reachability_distribution(*pair, state, 4).rank == 2
    assert geometry.reachability_distribution(*pair, [0.3, 0.1, -0.4, 0.2], 4).rank == 4
    alone = geometry.affine_fields(lambda x, u: jnp.stack([x[1], u[0], -x[2], jnp.cos(np.pi / 2) * u[0]]), 1)
    assert geometry.reachability_distribution(*alone, np.zeros(4), 3).rank == 2


@pytest.mark.slow
@pytest.mark.parametrize("units", [[1.0, 1.0, 1.0], [1e6, 1e-3, 1e-7]])
def test_brocketts_integrator_needs_one_bracket_in_any_units(units):
    units = np.array(units)
    gs = [
        lambda x: units * jnp.stack([1.0, 0.0, -x[1] / units[1]]),
        lambda x: units * jnp.stack([0.0, 1.0, x[0] / units[0]]),
    ]
    ranks = [geometry.reachability_distribution(None, gs, units * [0.3, -2.0, 1.0], depth).rank for depth in (0, 1, 2)]
    assert ranks == [2, 3, 3]


@pytest.mark.slow
def test_ranks_in_float32_are_those_of_float64():
    plant = motor(1e-3)
    for depth, rank in ((1, 2), (2, 3), (4, 3)):
        fields = (plant.drift, plant.push)
        with jax.enable_x64(False):

            def span(x, fields=fields, depth=depth):
                return _span_of_generations(_reach(fields, x, 3e-4, depth=depth), x, 3e-4)

            found = jax.jit(span)(jnp.zeros(3, jnp.float32)).counted
        assert int(found.sum()) == rank


# Relative degree


@pytest.mark.parametrize(
    "rate", [1.0, pytest.param(1e-3, marks=pytest.mark.slow), pytest.param(1e-5, marks=pytest.mark.slow), 1e-9]
)
def test_a_chain_of_integrators_has_its_relative_degree_in_any_units(rate):
    f, g = (lambda x: rate * jnp.stack([x[1], x[2], 0.0])), (lambda x: jnp.array([0.0, 0.0, 1.0]))
    degree = geometry.relative_degree(f, g, lambda x: x[0], np.zeros(3))
    assert degree.degree == 3
    assert degree.margin > 0.1
    assert degree.residue < degree.tolerance


def test_a_weak_feedthrough_counts():
    f, g = (lambda x: jnp.stack([x[1], -x[0] - x[1]])), (lambda x: jnp.array([0.0, 1.0]))
    assert geometry.relative_degree(f, g, lambda x: x[0] + 1e-8 * x[1], np.zeros(2)).degree == 1
    lost = geometry.relative_degree(f, g, lambda x: 0 * x[0], np.zeros(2))
    assert "no input above the tolerance reaches output 0" in lost.message


@pytest.mark.slow
@pytest.mark.parametrize("inductance", [1e-3, 1e-6])
def test_the_verdicts_on_a_motor_agree(inductance):
    plant = motor(inductance)
    assert geometry.relative_degree(plant.drift, plant.push, plant.output, np.zeros(3)).degree == 3
    assert geometry.is_feedback_linearisable(plant.drift, plant.push, np.zeros(3)).linearisable


@pytest.mark.slow
@pytest.mark.parametrize(("stiffness", "inertia"), [(1e4, 1e-2), (1e6, 1e-4)])
def test_the_verdicts_on_a_stiff_joint_agree(stiffness, inertia):
    arm = zoo.FlexibleJoint(stiffness=stiffness, motor=inertia)
    f, gs = geometry.affine_fields(arm.drift, 1)
    for state in (np.zeros(4), np.array([2.0, -1.0, 1.5, 0.7])):
        assert geometry.relative_degree(f, gs, arm.output, state).degree == 4
        verdict = geometry.is_feedback_linearisable(f, gs, state)
        assert verdict.linearisable
        assert verdict.independence > 0.1


def test_near_may_be_another_distance_for_every_state():
    """The gain vanishes for x₁ > 1e-4: x₁ is a length in kilometres, x₂ a rate."""
    f = lambda x: jnp.stack([x[1], 0.0])  # noqa: E731
    g = lambda x: jnp.stack([0.0, jnp.where(x[0] > 1e-4, 0.0, 1.0)])  # noqa: E731
    x = np.array([0.0, 1.0])
    assert not geometry.is_feedback_linearisable(f, g, x).linearisable
    assert geometry.is_feedback_linearisable(f, g, x, radius=[1e-5, 0.1]).linearisable
    kink = lambda x: jnp.where(x[0] > 1e-4, x[1], x[0])  # noqa: E731
    assert geometry.relative_degree(f, lambda x: jnp.array([0.0, 1.0]), kink, x).degrees.tolist() == [1]
    assert geometry.relative_degree(f, lambda x: jnp.array([0.0, 1.0]), kink, x, radius=[1e-5, 1.0]).degree == 2
    for radius in ([0.1] * 3, -1.0, np.nan):
        with pytest.raises(ValueError, match="radius"):
            geometry.is_feedback_linearisable(f, g, x, radius=radius)


# Lyapunov functions


@pytest.mark.slow
@pytest.mark.parametrize("widths", [[1.0, 1.0], [1e-5, 1.0], [1e6, 1e-6]])
def test_a_definite_function_is_not_violated_by_its_units(widths):
    """V = Σ (x_i / w_i)²; and a small one that is positive, though by 1e-11 of V beside it."""
    widths = np.array(widths)
    box = hjb.Box(-widths, widths)
    for weak in (1.0, 1e-11):
        weights = np.array([1.0, weak]) / widths**2
        report = hjb.lyapunov_check(lambda x, weights=weights: weights @ (x * x), lambda x: -x, box, samples=256)
        assert report.holds
        assert report.lowest > 0
    flat = hjb.lyapunov_check(lambda x: (x[0] / widths[0] - x[1] / widths[1]) ** 2, lambda x: -x, box, samples=256)
    assert not flat.positive
    assert abs(flat.lowest) < 1e-14
    saddle = hjb.lyapunov_check(
        lambda x: (x[0] / widths[0]) ** 2 - 1e-6 * (x[1] / widths[1]) ** 2, lambda x: -x, box, samples=256
    )
    assert saddle.lowest < 0
    assert not saddle.positive


@pytest.mark.parametrize(
    ("level", "positive"),
    [
        (lambda x: 3 + jnp.sum(x**8), True),  # at 0.01 by 1e-16, below the digits of 3
        pytest.param(lambda x: 1 + 1e-20 * (x @ x), True, marks=pytest.mark.slow),
        pytest.param(lambda x: 3 - jnp.sum(x**8), False, marks=pytest.mark.slow),
        (lambda x: 3 + x[0] ** 8, False),
        pytest.param(lambda x: 3 + jnp.maximum(x @ x - 0.09, 0) ** 2, False, marks=pytest.mark.slow),
        (lambda x: 3 + (x @ x) * (x @ x - 0.25) ** 2, False),
    ],
)
def test_a_flat_function_is_told_from_one_that_is_zero(level, positive):
    report = hjb.lyapunov_check(level, lambda x: -x, hjb.Box([-1.0, -1.0], [1.0, 1.0]), samples=256)
    assert report.positive == positive


@pytest.mark.slow
@pytest.mark.parametrize(
    ("region", "equilibrium", "words"),
    [
        (hjb.Ball(1.0, 2), [3.0, 3.0], "wanted a state in"),
        (hjb.Box([-1.0, -1.0], [1.0, 1.0]), [0.0, 1.5], "wanted a state in"),
        (hjb.Ball(1.0, 2), [0.5, 0.0], "f is not zero"),
        (hjb.Ball(1.0, 2), [np.nan, 0.0], "wanted a state in"),
    ],
)
def test_an_equilibrium_must_be_one(region, equilibrium, words):
    with pytest.raises(ValueError, match=words):
        hjb.lyapunov_check(lambda x: x @ x, lambda x: -x, region, equilibrium=equilibrium, samples=16)


# Brockett's condition


@pytest.mark.slow
def test_brocketts_condition_in_other_words_and_units():
    def drive(size):
        return [
            lambda x: size * jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]), 0.0]),
            lambda x: jnp.array([0.0, 0.0, 1.0]),
        ]

    for size in (1.0, 1e9, 1e-9):
        assert stability.brockett_check(None, drive(size), np.zeros(3)).satisfied is False
        assert stability.brockett_check(lambda x: 0 * x, drive(size), np.zeros(3)).satisfied is False
        # a drift that is zero at the state alone may help
        assert stability.brockett_check(lambda x: x[0] ** 3 * x, drive(size), np.zeros(3)).satisfied is None
    f, gs = geometry.affine_fields(zoo.FlexibleJoint(stiffness=1e6, motor=1e-4).drift, 1)
    assert stability.brockett_check(f, gs, np.zeros(4)).satisfied is True
    unmoved = [lambda x: jnp.array([1.0, 1.0, 0.0])]
    with pytest.raises(ValueError, match="no input keeps"):
        stability.brockett_check(lambda x: jnp.array([1.0, 1.0 + 1e-6, 0.0]), unmoved, np.zeros(3))


def test_a_neighbourhood_in_which_a_field_is_not_smooth_names_its_radius():
    root = lambda x: jnp.stack([x[1], jnp.sqrt(x[0])])  # noqa: E731
    push = lambda x: jnp.array([0.0, 1.0])  # noqa: E731
    with pytest.raises(ValueError, match="not finite at or near .* a smaller radius="):
        geometry.relative_degree(root, push, lambda x: x[0], [0.05, 0.0])
    assert geometry.relative_degree(root, push, lambda x: x[0], [0.05, 0.0], radius=0.01).degree == 2
