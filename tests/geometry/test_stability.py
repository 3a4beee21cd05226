"""Stabilisation: the pendulum of section 2, Pomet's feedback of time and state, Brockett's condition, Example 4.1.

The unicycle fails Brockett's condition: B. d'Andréa-Novel, J.-M. Coron and W. Perruquetti, arXiv:1905.11132.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hjbjax as hjb
from hjbjax import geometry, zoo
from hjbjax.geometry import stability
from hjbjax.problem.pytree import pytree_dataclass

pytestmark = pytest.mark.usefixtures("float64")


# The pendulum, section 2


def linear_angle(t, start):
    """θ of (2.7), θ̈ + 3θ̇ + 2θ = 0: a combination of e^{−t} and e^{−2t}."""
    return (2 * start[0] + start[1]) * np.exp(-t) - (start[0] + start[1]) * np.exp(-2 * t)


@pytest.mark.parametrize("start", [[0.2, 0.0], [3.0, 0.0], [-2.5, 4.0]])
@pytest.mark.parametrize("mass", [1.0, 2.5])
def test_the_pendulum_under_28_follows_the_closed_form(mass, start):
    system = zoo.Pendulum(mass=mass)
    torque = system.linearising_torque(jnp.asarray(start))
    printed = -mass * 9.81 * np.sin(start[0]) - 3 * mass * start[1] - 2 * mass * start[0]  # (2.8)
    np.testing.assert_allclose(torque, [printed], rtol=1e-12)
    problem = hjb.Problem(system.drift, None, hjb.Box([-100.0], [100.0]))
    path = hjb.simulate(problem, system.linearising_torque, start, 5.0, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(path.states[:, 0], linear_angle(path.times, start), atol=1e-8)


@pytest.mark.slow
def test_the_linear_controller_follows_it_near_upright_only():
    system = zoo.Pendulum()
    problem = hjb.Problem(system.drift, None, hjb.Box([-100.0], [100.0]))

    def error(angle):
        path = hjb.simulate(problem, system.linear_torque, [angle, 0.0], 5.0, rtol=1e-11, atol=1e-12)
        return np.max(np.abs(path.states[:, 0] - linear_angle(path.times, [angle, 0.0]))) / angle

    assert error(0.01) < 1e-4
    assert error(3.0) > 0.1
    # Alone, without a torque against gravity, −3mθ̇ − 2mθ does not even hold it up.
    path = hjb.simulate(problem, feeble, [3.0, 0.0], 20.0)
    assert abs(path.states[-1, 0]) > 1
    assert abs(9.81 * np.sin(path.states[-1, 0]) - 2 * path.states[-1, 0]) < 1e-4  # at rest where gravity balances


def feeble(x):
    return -3 * x[1:] - 2 * x[:1]


# Example 4.1: accessible, and no way back


def distance(x):
    return jnp.sqrt(x @ x + 1e-12)


@pytest.mark.filterwarnings("ignore:the optimal drift leaves")
@pytest.mark.parametrize("speed", [1.0, -1.0])
@pytest.mark.slow
@pytest.mark.optimised
def test_the_tubes_of_example_41(speed):
    """The least distance to the origin on the way, forwards and backwards in time.

    Backwards it is zero on the forward set of the origin, x₂ ≥ |x₁|³/3; forwards on its mirror image, so that no state
    above the axis comes back. Elsewhere it is at least gap = |x₁|³/3 − x₂, which never falls (nor does the chain's).
    """
    system = zoo.OneWay(speed)
    problem = hjb.Problem(system.drift, None, hjb.Box([-1.0], [1.0]), stopping_cost=distance)
    blurs = []
    for count in (25, 49, 97):
        grid = hjb.Grid([-1.2, -0.6], [1.2, 0.6], (count, count))
        value = hjb.solve(problem, grid, tol=1e-4, scheme=hjb.Upwind()).value
        x1, x2 = np.moveaxis(grid.nodes(), -1, 0)
        gap = np.abs(x1) ** 3 / 3 + speed * x2
        assert np.sum(gap > 0) > 0.4 * gap.size
        # Where the way to x₁ = 0 would leave the box, x₂ stops at its edge.
        assert np.all(value[gap > 0] >= 0.99 * np.minimum(gap[gap > 0], 0.3))
        blurs.append(np.max(value[gap <= 0]))
        if speed > 0:  # above the axis the best is to stay where x₁ = 0, and the distance is x₂
            middle = count // 2
            np.testing.assert_allclose(value[middle, middle:], x2[middle, middle:], atol=2e-6)
        else:
            np.testing.assert_allclose(gap, -zoo.OneWay().frontier(np.stack([x1, x2])), atol=1e-12)
    assert blurs[0] > blurs[1] > blurs[2]
    assert blurs[2] < 0.07  # the first-order chain blurs the edge of the set


# Pomet's system, Example 6.1

POMET = zoo.Pomet()


@jax.jit
def pomet_rates(t, x):
    """dV/dt by differentiation, and by the chapter's identity."""
    by_autodiff = stability.lyapunov_derivative(POMET.lyapunov, POMET.closed_loop, time_varying=True)(t, x)
    return by_autodiff, POMET.lyapunov_rate(t, x)


@given(st.floats(0, 20), st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2))
def test_the_derivative_identity_of_pomet(t, x1, x2, x3):
    with jax.enable_x64(True):
        found, printed = pomet_rates(t, jnp.array([x1, x2, x3]))
    assert abs(found - printed) <= 1e-10
    assert found <= 1e-10


@pytest.mark.slow
def test_the_path_of_pomet_falls_like_one_over_the_root_of_time():
    problem = hjb.Problem(POMET.drift, None, hjb.Box([-9.0, -9.0], [9.0, 9.0]))
    start = [1.0, 1.0, 0.5]
    path = hjb.simulate(
        problem, POMET.feedback, start, 4000.0, time_varying=True, steps=4000, rtol=1e-9, atol=1e-12, max_steps=10**6
    )
    heights = np.asarray(jax.vmap(POMET.lyapunov)(jnp.asarray(path.times), jnp.asarray(path.states)))
    assert np.all(np.diff(heights) <= 1e-9)
    # The size over a period swings; its mean over windows of many periods shows the power.
    size = np.linalg.norm(path.states, axis=1)
    late = path.times >= 100
    slope = np.polyfit(np.log(path.times[late]), np.log(size[late]), 1)[0]
    assert slope == pytest.approx(-0.5, abs=0.05)


@pytest.mark.slow
def test_the_lyapunov_function_of_pomet_survives_the_search():
    region = hjb.Box([-1.0] * 3, [1.0] * 3)
    report = hjb.lyapunov_check(POMET.lyapunov, POMET.closed_loop, region, times=(0.0, 2 * np.pi))
    assert report.holds
    assert report.rate <= 1e-9
    assert "no violation" in str(report)
    # Of the loop with the feedback frozen at t = 1 it is none.
    frozen = hjb.lyapunov_check(
        lambda x: POMET.lyapunov(1.0, x), lambda x: POMET.drift(x, POMET.feedback(1.0, x)), region
    )
    assert not frozen.decreasing
    assert frozen.rate > 0.1


# The search


def oscillator(x):
    return jnp.stack([x[1], -x[0] - (1 - x[0] ** 2) * x[1]])


def energy(x):
    return 0.5 * (x @ x)


@pytest.mark.slow
def test_the_worst_point_is_found():
    """dV/dt = −(1 − x₁²) x₂², largest at a corner of the box, and in the disc of radius 2 where x₁² = 5/2."""
    box = hjb.lyapunov_check(energy, oscillator, hjb.Box([-2.0, -2.0], [2.0, 2.0]))
    assert not box.holds
    assert box.rate == 12.0
    np.testing.assert_allclose(np.abs(box.worst_state), 2)
    assert "violated: dV/dt = 12 at x = [" in str(box)
    disc = hjb.lyapunov_check(energy, oscillator, hjb.Ball(2.0, 2))
    assert disc.rate == pytest.approx(1.5 * 1.5, rel=1e-6)
    np.testing.assert_allclose(disc.worst_state**2, [2.5, 1.5], rtol=1e-3)
    assert hjb.lyapunov_check(energy, oscillator, hjb.Ball(1.0, 2)).holds


@given(st.floats(-0.8, 0.8), st.floats(-0.8, 0.8))
@pytest.mark.slow
def test_a_narrow_violation_is_climbed_to(a, b):
    """A bump of width 0.15 in dV/dt, which is negative elsewhere."""
    report = hjb.lyapunov_check(Bump(a, b).level, Bump(a, b).decay, hjb.Box([-1.0, -1.0], [1.0, 1.0]))
    inside = a * a + b * b
    peak = -inside * (1 - 3)  # the bump turns −|x|² into +2|x|² at its centre
    if inside > 0.05:
        assert not report.decreasing
        assert report.rate >= 0.99 * peak


@pytree_dataclass()
class Bump:
    a: object
    b: object

    def level(self, x):
        return 0.5 * (x @ x)

    def decay(self, x):
        away = ((x[0] - self.a) ** 2 + (x[1] - self.b) ** 2) / 0.15**2
        return -x * (1 - 3 * jnp.exp(-away))


@pytest.mark.parametrize(
    ("level", "positive"),
    [
        (lambda x: x @ x, True),
        pytest.param(lambda x: jnp.sum(x**4), True, marks=pytest.mark.slow),
        pytest.param(lambda x: jnp.sum(x**6) + 3.0, True, marks=pytest.mark.slow),
        (lambda x: x[0] ** 2, False),
        (lambda x: x[0] ** 2 - 0.1 * x[1] ** 2, False),
        pytest.param(lambda x: (x[0] - x[1]) ** 2 + (x @ x) ** 2 * (x @ x - 0.5), False, marks=pytest.mark.slow),
    ],
)
def test_a_function_that_is_not_positive_is_found_out(level, positive):
    report = hjb.lyapunov_check(level, lambda x: -x, hjb.Box([-1.0, -1.0], [1.0, 1.0]))
    assert report.positive == positive
    if not positive:
        assert "V − V(x_e)" in str(report)
        assert report.lowest < 1e-6


def test_another_equilibrium():
    region, rest = hjb.Box([0.0, 0.0], [2.0, 2.0]), np.array([1.0, 0.5])
    closed_loop = {"V": lambda x: (x - rest) @ (x - rest), "f": lambda x: rest - x, "region": region}
    assert hjb.lyapunov_check(**closed_loop, equilibrium=rest).holds
    with pytest.raises(ValueError, match="f is not zero at the equilibrium"):
        hjb.lyapunov_check(**closed_loop)


@pytest.mark.parametrize(
    ("call", "kind", "words"),
    [
        (lambda: hjb.lyapunov_check(energy, oscillator, [-1, 1]), TypeError, "wanted a Box or a Ball"),
        (lambda: hjb.lyapunov_check(energy, oscillator, hjb.Ball(1.0, 2), times=3.0), ValueError, "times is 3.0"),
        (lambda: hjb.lyapunov_check(energy, oscillator, hjb.Ball(1.0, 2), samples=0), ValueError, "samples is 0"),
        (lambda: hjb.lyapunov_check(energy, oscillator, hjb.Ball(1.0, 2), tolerance=2), ValueError, "tolerance is 2"),
        (lambda: hjb.lyapunov_check(energy, oscillator, hjb.Ball(1.0, 2), equilibrium=[0.0]), ValueError, "(1,)"),
        (lambda: hjb.lyapunov_check(lambda x: jnp.log(x[0]), oscillator, hjb.Ball(1.0, 2)), ValueError, "not finite"),
        (lambda: stability.brockett_check(oscillator, lambda x: x, [1.0, 0.0]), ValueError, "no input keeps"),
    ],
)
def test_bad_input_is_refused(call, kind, words):
    with pytest.raises(kind) as refusal:
        call()
    assert words in str(refusal.value)


# Brockett's condition


@pytest.mark.parametrize(
    ("system", "states"),
    [(zoo.Unicycle(), 3), (zoo.Pomet(), 3), (zoo.CarWithTrailers(), 4), (zoo.CarWithTrailers(2), 5)],
)
def test_no_continuous_feedback_of_the_state_stabilises_them(system, states):
    _, gs = geometry.affine_fields(system.drift, 2)
    verdict = stability.brockett_check(None, gs, np.zeros(states))
    assert verdict.satisfied is False
    assert verdict.rank == 2
    assert f"2 independent fields move {states} states" in verdict.message


@pytest.mark.slow
def test_brocketts_condition_is_met_or_left_open():
    f, gs = geometry.affine_fields(zoo.BallAndBeam().drift, 1)
    assert stability.brockett_check(f, gs, np.zeros(4)).satisfied is True
    f, gs = geometry.affine_fields(zoo.Pendulum().drift, 1)
    assert stability.brockett_check(f, gs, [0.7, 0.0]).satisfied is True  # held there by a torque
    f, gs = geometry.affine_fields(zoo.OneWay().drift, 1)
    open_case = stability.brockett_check(f, gs, np.zeros(2))
    assert open_case.satisfied is None
    assert "rank 1 of 2" in open_case.message
    square = stability.brockett_check(
        None, [lambda x: jnp.array([1.0, 0.0]), lambda x: jnp.array([0.0, 1.0])], [0.0, 0.0]
    )
    assert square.satisfied is True
    dependent = [lambda x: jnp.array([1.0, 0.0, 0.0])] * 2
    assert stability.brockett_check(None, dependent, np.zeros(3)).satisfied is None
