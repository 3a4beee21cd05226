"""Loops through plant, sensor, observer and control: exact laws, exact paths, separation, a pendulum with one angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from orders import order_of
from refusals import refused
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

import hjbjax as hjb
from hjbjax.feedback.path import PathStatus
from hjbjax.filtering.information_state import GridFilter, zakai
from hjbjax.filtering.observers import ExtendedKalman, Luenberger
from hjbjax.filtering.output_feedback import simulate_output
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.sets import Box

REACH = Box([-50.0], [50.0])
SIGMA, R = 0.5, 0.3


def integrator(x, u):
    return jnp.stack([x[1], u[0]])


def position(x):
    return x[:1]


def quadratic(x, u):
    return x @ x + u @ u


@pytree_dataclass()
class Blind:
    """An observer that believes what it was told: a state that nothing moves."""

    belief: object

    def initial(self):
        return jnp.asarray(self.belief, float)

    def update(self, state, u, dy, dt):
        return state

    def estimate(self, state):
        return state


class Memory:
    """No pytree: counts steps, and adds up what it sees."""

    def initial(self):
        return {"count": jnp.zeros((), int), "seen": jnp.zeros(1), "acted": jnp.zeros(1), "time": jnp.zeros(())}

    def update(self, state, u, dy, dt):
        return {
            "count": state["count"] + 1,
            "seen": state["seen"] + dy,
            "acted": state["acted"] + u * dt,
            "time": state["time"] + dt,
        }

    def estimate(self, state):
        return jnp.concatenate([state["seen"], state["acted"]])


LQ = Problem(integrator, quadratic, REACH, noise=[0.0, SIGMA], discount=0.1)


def options(**changes):
    return {"h": position, "x0": [1.0, 0.0], "duration": 2.0, "dt": 0.1, "key": 0} | changes


# --- plant and record ---


def test_without_noise_plant_cost_and_record_are_of_second_order():
    """An open loop: u = cos t held over 0.25 by a belief that counts the time."""

    def swing(x, u):
        return jnp.stack([x[1], jnp.sin(x[0]) - 0.3 * x[1] + u[0]])

    problem = Problem(swing, quadratic, REACH, discount=0.4)

    def control(state):
        return jnp.cos(state["time"])[None]

    z = np.array([1.0, 0.0, 0.0, 0.0])
    for k in range(8):
        u = np.cos(0.25 * k)

        def rate(t, z, u=u):
            cost = np.exp(-0.4 * t) * (z[0] ** 2 + z[1] ** 2 + u**2)
            return [z[1], np.sin(z[0]) - 0.3 * z[1] + u, cost, z[0] ** 2]

        z = solve_ivp(rate, (0.25 * k, 0.25 * k + 0.25), z, rtol=1e-11, atol=1e-12).y[:, -1]
    errors = []
    for substeps in (4, 8, 16, 32):
        path = simulate_output(
            problem, Memory(), control,
            **options(h=lambda x: x[:1] ** 2, dt=0.25, substeps=substeps, measurement_noise=0.0),
        )  # fmt: skip
        found = np.concatenate([path.states[-1], [path.cost], path.information["seen"]])
        errors.append(np.abs(found - z))
    assert order_of(np.max(errors, axis=1)) == pytest.approx(2, abs=0.15)
    for column in np.transpose(errors):  # one of them may pass through zero, and then falls faster at first
        assert order_of(column) >= 1.85
    assert path.information["count"] == 8
    np.testing.assert_allclose(path.measurements.sum(axis=0), path.information["seen"], rtol=1e-12)
    np.testing.assert_allclose(path.controls[:, 0], np.cos(0.25 * np.arange(8)), rtol=1e-12)


def test_the_law_of_plant_and_record_is_that_of_the_equations():
    """dx = −x dt + σ dw, dy = x dt + r dv: moments of x(T), y(T) and their product over many paths."""
    problem = Problem(lambda x, u: -x, noise=SIGMA)
    path = simulate_output(
        problem, Blind([0.0]), None,
        **options(h=lambda x: x, x0=[1.0], duration=1.0, paths=20_000, measurement_noise=R, substeps=4),
    )  # fmt: skip
    assert path.states.shape == (20_000, 11, 1)
    x, y = path.states[:, -1, 0], path.measurements[..., 0].sum(axis=1)
    e = np.exp(-1.0)
    var_x = SIGMA**2 * (1 - e**2) / 2
    var_y = SIGMA**2 * (1 - 2 * (1 - e) + (1 - e**2) / 2) + R**2
    cov = SIGMA**2 * (1 - e) ** 2 / 2
    for found, exact in ((x.mean(), e), (y.mean(), 1 - e)):
        assert found == pytest.approx(exact, abs=0.01)
    for found, exact in ((x.var(), var_x), (y.var(), var_y), (np.cov(x, y)[0, 1], cov)):
        assert found == pytest.approx(exact, abs=0.05 * max(var_x, exact))
    increments = path.measurements[..., 0] - path.measurements[..., 0].mean(axis=0)
    # noise of one increment and of the next share nothing: what they have in common comes of the state
    assert abs(np.mean(increments[:, 0] * increments[:, 1])) < 5e-4


@pytest.mark.slow
def test_errors_of_a_kalman_filter_have_the_covariance_that_it_says():
    observer = ExtendedKalman(LQ, position, [0.0, 0.0], [0.2, 0.2], measurement_noise=R)
    starts = np.random.default_rng(0).normal(size=(4000, 2)) * np.sqrt(0.2)
    path = simulate_output(
        LQ, observer, lambda state: -jnp.sum(state.mean)[None],
        **options(x0=starts, measurement_noise=R, substeps=8),
    )  # fmt: skip
    error = path.states[:, -1] - path.estimates[:, -1]
    np.testing.assert_allclose(np.cov(error.T), path.information.covariance[0], atol=0.012)
    assert np.max(np.abs(error.mean(axis=0))) < 0.03


@pytest.mark.slow
def test_separation_of_linear_quadratic_and_gaussian():
    """Mean cost a unit time of u = −K x̂: tr(P σσᵀ) + tr(S Kᵀ K), P and S of both Riccati equations."""
    a, b, c = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    spread = np.diag([0.0, SIGMA**2])
    p = solve_continuous_are(a, b, np.eye(2), np.eye(1))
    s = solve_continuous_are(a.T, c.T, spread, R**2 * np.eye(1))
    gain = b.T @ p
    exact = np.trace(p @ spread) + np.trace(s @ gain.T @ gain)
    problem = Problem(integrator, quadratic, REACH, noise=[0.0, SIGMA])
    observer = ExtendedKalman(problem, position, [0.0, 0.0], s, measurement_noise=R)
    path = simulate_output(
        problem, observer, lambda state: -jnp.asarray(gain) @ state.mean,
        **options(x0=[0.0, 0.0], duration=60.0, dt=0.05, paths=60, measurement_noise=R, substeps=2),
    )  # fmt: skip
    # from the origin: the cost of going there from the stationary law, x'Px, is not paid; of 60 units of time
    assert path.cost.mean() / 60 == pytest.approx(exact, rel=0.06)


def test_a_luenberger_observer_finds_the_state_of_a_plant_in_motion():
    problem = Problem(lambda x, u: jnp.stack([x[1], -jnp.sin(x[0])]))
    observer = Luenberger(problem, position, [[6.0], [9.0]], [0.0, 0.0])
    path = simulate_output(problem, observer, None, **options(duration=6.0, dt=0.05, measurement_noise=0.0))
    error = np.max(np.abs(path.states - path.estimates), axis=1)
    assert error[0] == 1.0
    assert error[-1] < 5e-3  # what the mean of y over a step leaves, O(dt²)


# --- ends ---


def test_a_path_ends_in_the_target_and_pays_there():
    """dx = −dt from 1 to the target x ≤ 0.35: τ = .65, cost ∫e^{−t/2} dt + 3 e^{−τ/2}."""
    problem = Problem(
        lambda x, u: -jnp.ones(1), lambda x, u: 1.0, target=lambda x: x[0] - 0.35, exit_cost=3.0, discount=0.5
    )
    path = simulate_output(problem, Memory0(), None, **options(x0=[1.0], measurement_noise=0.0, h=lambda x: x))
    assert path.status is PathStatus.TARGET
    assert path.reached == pytest.approx(0.65, abs=1e-9)
    assert path.cost == pytest.approx(2 * (1 - np.exp(-0.325)) + 3 * np.exp(-0.325), abs=1e-4)
    assert path.information["time"] == pytest.approx(0.65, abs=1e-9)
    assert path.information["seen"][0] == pytest.approx(0.65 * (1 + 0.35) / 2, abs=1e-9)
    np.testing.assert_allclose(path.states[7:], 0.35, atol=1e-9)
    np.testing.assert_allclose(path.times[7:], 0.65, atol=1e-9)
    assert np.all(np.isnan(path.measurements[7:]))
    assert not np.any(np.isnan(path.measurements[:7]))


class Memory0:
    """Adds up what it sees of a plant without control."""

    def initial(self):
        return {"seen": jnp.zeros(1), "time": jnp.zeros(())}

    def update(self, state, u, dy, dt):
        return {"seen": state["seen"] + dy, "time": state["time"] + dt}

    def estimate(self, state):
        return state["seen"]


def test_a_noisy_path_meets_its_target_between_two_steps():
    """P(Brownian motion from 1 is at 0 before 1) = 2 Φ(−1) with two steps in all; looked at their ends it is .24."""
    problem = Problem(lambda x, u: 0 * x, noise=1.0, target=lambda x: x[0])
    path = simulate_output(
        problem, Memory0(), None,
        **options(x0=[1.0], duration=1.0, dt=0.5, substeps=1, paths=20_000, h=lambda x: x),
    )  # fmt: skip
    assert np.mean(path.code == PathStatus.TARGET) == pytest.approx(0.31731, abs=0.012)
    met = path.code == PathStatus.TARGET
    np.testing.assert_allclose(path.states[met, -1], 0, atol=1e-9)


def test_a_record_ends_where_the_path_does():
    """dx = −dt meets x = 0.35 after .65 of the one step: what is seen has the mean ∫x dt and the variance r² .65."""
    problem = Problem(lambda x, u: -jnp.ones(1), target=lambda x: x[0] - 0.35)
    path = simulate_output(
        problem, Memory0(), None,
        **options(x0=[1.0], duration=1.0, dt=1.0, substeps=1, paths=20_000, h=unity, measurement_noise=R),
    )  # fmt: skip
    seen = path.measurements[:, 0, 0]
    np.testing.assert_allclose(path.reached, 0.65, atol=1e-12)
    assert seen.mean() == pytest.approx(0.65, abs=0.01)
    assert seen.var() == pytest.approx(0.65 * R**2, rel=0.05)


def test_the_terminal_cost_is_paid_at_the_end_alone():
    problem = Problem(lambda x, u: -jnp.ones(1), terminal_cost=lambda x: 10 * x[0], discount=0.5)
    path = simulate_output(problem, Memory0(), None, **options(x0=[3.0], h=lambda x: x))
    assert path.status is PathStatus.DURATION
    assert path.cost == pytest.approx(10 * 1.0 * np.exp(-1.0), abs=1e-9)
    assert path.reached == np.inf


def test_a_loop_that_fails_says_so():
    problem = Problem(lambda x, u: x**3)
    with pytest.warns(UserWarning, match="the path stopped before a state or estimate that is not finite"):
        path = simulate_output(problem, Memory0(), None, **options(x0=[4.0], h=lambda x: x))
    assert path.status is PathStatus.NONFINITE
    assert np.all(np.isfinite(path.states))
    with pytest.warns(UserWarning, match="2 of 2 paths stopped where the control is not finite"):
        path = simulate_output(
            LQ, Blind([1.0, 0.0]), lambda x: jnp.sqrt(-x[:1]), **options(paths=2, measurement_noise=R)
        )
    assert np.all(path.code == PathStatus.UNDEFINED)


# --- as values ---


def law(state):
    return -state.mean[:1] - 1.5 * state.mean[1:]


def of_estimate(state):
    return -state[:1] - 1.5 * state[1:]


def test_a_batch_of_keys_is_each_of_them_and_seeds_are_keys():
    observer = Luenberger(LQ, position, [[3.0], [2.0]], [0.5, 0.0])

    def ask(key, **more):
        return simulate_output(LQ, observer, of_estimate, **options(key=key, measurement_noise=R, **more))

    keys = jax.random.split(jax.random.key(7), 3)
    batch, many = ask(keys), ask(jax.random.key(7), paths=3)
    for k in range(3):
        for one, each, same in zip(*(jax.tree.leaves(p) for p in (ask(keys[k]), batch, many)), strict=True):
            np.testing.assert_allclose(one, each[k], rtol=1e-9, atol=1e-12)
            np.testing.assert_array_equal(each, same)
    assert np.ptp(batch.states[:, -1, 0]) > 0.01
    seeded, keyed, old = ask(5), ask(jax.random.key(5)), ask(jax.random.PRNGKey(5))
    np.testing.assert_array_equal(seeded.states, keyed.states)
    np.testing.assert_allclose(old.states, keyed.states)


def test_inside_jit_and_vmap_in_the_type_of_the_start():
    observer = ExtendedKalman(LQ, position, [0.5, 0.0], [0.3, 0.3], measurement_noise=R)

    def end(x0, key):
        path = simulate_output(LQ, observer, law, **options(x0=x0, key=key, measurement_noise=R))
        return path.states[-1], path.cost

    keys = jax.random.split(jax.random.key(1), 2)
    states, costs = jax.jit(jax.vmap(end))(jnp.ones((2, 2), jnp.float32), keys)
    assert (states.shape, states.dtype) == ((2, 2), np.float32)
    assert np.all(np.isfinite(states))
    assert np.all(costs > 0)


@pytest.mark.slow
def test_the_derivative_in_a_gain_that_the_control_closes_over():
    problem = Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, REACH)
    observer = Luenberger(problem, identity, [[2.0]], [0.5])

    def cost(gain):
        return simulate_output(
            problem, observer, lambda s: -gain * s, **options(h=identity, x0=[1.0], measurement_noise=0.0)
        ).cost

    with jax.enable_x64(True):
        slope = float(jax.jacfwd(cost)(0.7))
        assert slope == pytest.approx((cost(0.7 + 1e-4) - cost(0.7 - 1e-4)) / 2e-4, rel=1e-5)
        # inside a jit in which nothing is traced it is a number
        assert float(jax.jit(lambda: jnp.asarray(cost(0.7)))()) == pytest.approx(float(cost(0.7)), rel=1e-12)


def test_a_number_that_h_reads_may_change():
    """A function that computes otherwise is another program."""
    problem = Problem(lambda x, u: 0 * x)
    seen = []
    for c in (1.0, 2.0):
        SCALE["c"] = c
        path = simulate_output(
            problem, Memory0(), None, **options(h=scaled, x0=[1.0], duration=1.0, measurement_noise=0.0)
        )
        seen.append(float(path.information["seen"][0]))
    assert seen == pytest.approx([1.0, 2.0])


def unity(x):
    return jnp.ones(1)


def identity(x):
    return x


SCALE = {"c": 1.0}


def scaled(x):
    return SCALE["c"] * x


def test_the_observer_sees_the_record_and_nothing_else():
    """What the filter of a path says is what ``zakai`` says of its record and its controls."""
    grid = Grid([-3.0], [3.0], (61,))
    problem = Problem(lambda x, u: u - x, controls=Box([-1.0], [1.0]), noise=SIGMA)
    observer = GridFilter(problem, lambda x: x, grid, np.ones(61), measurement_noise=R)
    path = simulate_output(
        problem, observer, lambda s: -jnp.tanh(observer.estimate(s)),
        **options(h=lambda x: x, x0=[0.7], measurement_noise=R),
    )  # fmt: skip
    told = zakai(
        problem, lambda x: x, grid, path.measurements, 0.1, np.ones(61), controls=path.controls, measurement_noise=R
    )
    np.testing.assert_allclose(path.estimates[1:], told.mean, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(path.information.density, told.density[-1], rtol=1e-7, atol=1e-10)


@pytest.mark.slow
def test_a_solution_is_asked_at_the_estimate():
    """Certainty equivalence by a Solution and by hand; an estimate in the target keeps the control before."""
    problem = Problem(lambda x, u: u, lambda x, u: 1.0, Box([-1.0], [1.0]), target=lambda x: jnp.abs(x[0]) - 0.2)
    solution = hjb.solve(problem, Grid([-2.0], [2.0], (41,)))
    observer = Luenberger(problem, lambda x: x, [[2.0]], [0.5])
    by_solution = simulate_output(
        problem, observer, solution, **options(h=lambda x: x, x0=[1.0], measurement_noise=0.0)
    )
    assert by_solution.status is PathStatus.TARGET
    assert by_solution.reached == pytest.approx(0.8, abs=1e-6)
    np.testing.assert_allclose(by_solution.controls[:8], -1.0)
    assert np.min(np.abs(by_solution.estimates)) < 0.2  # for the estimate starts ahead of the plant


@pytest.mark.slow
def test_a_marched_feedback_and_a_greedy_one_act_at_the_estimate_and_at_the_time():
    """An observer that knows the state: the path is that of ``simulate`` under a hold, but for what it integrates."""
    problem = Problem(integrator, lambda x, u: 0.5 * u @ u, Box([-4.0], [4.0]), terminal_cost=lambda x: 5 * (x @ x))
    grid = Grid([-2.0, -3.0], [2.0, 3.0], (41, 41))
    marched = hjb.march(problem, grid, 2.0, times=np.linspace(0, 2, 41))
    observer = ExtendedKalman(problem, lambda x: x, [1.0, 0.0], [0.0, 0.0], measurement_noise=1e-3)
    for feedback in (marched, hjb.greedy_feedback(problem, marched)):
        path = simulate_output(
            problem, observer, feedback, **options(h=lambda x: x, dt=0.05, measurement_noise=0.0, substeps=8)
        )
        known = hjb.simulate(problem, feedback, [1.0, 0.0], 2.0, hold=0.05)
        np.testing.assert_allclose(path.states, known.states, atol=2e-3)
        assert path.cost == pytest.approx(known.cost, abs=5e-3)


# --- a pendulum ---


def pendulum(x, u):
    return jnp.stack([x[1], jnp.sin(x[0]) - 0.05 * x[1] + u[0]])


def angle(x):
    return jnp.stack([jnp.sin(x[0]), jnp.cos(x[0])])


def swing_cost(x, u):
    return 2 * (1 - jnp.cos(x[0])) + 0.5 * x[1] ** 2 + 0.1 * u[0] ** 2


def hanging(x):
    return jnp.exp(-(1 - jnp.cos(x[0] - np.pi)) / 0.1 - x[1] ** 2 / 0.1)


SWING = Problem(pendulum, swing_cost, Box([-0.7], [0.7]), discount=0.05, noise=[0.0, 0.05])
ROUND = Grid([-np.pi, -3.5], [np.pi, 3.5], (80, 81), (True, False))


@pytest.fixture(scope="module")
def swing_up():
    return hjb.solve(SWING, ROUND, tol=1e-2)


@pytest.mark.filterwarnings("ignore:the grid is coarse")
@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize("kind", ["extended Kalman", "grid"])
def test_a_pendulum_swings_up_on_its_angle_alone(swing_up, kind):
    """From 170°, with less torque than gravity and an observer that takes it for hanging at rest."""
    if kind == "grid":
        observer = GridFilter(SWING, angle, ROUND, hanging, measurement_noise=0.03)
    else:
        observer = ExtendedKalman(SWING, angle, [np.pi, 0.0], [0.1, 0.05], measurement_noise=0.03)
    path = simulate_output(
        SWING, observer, swing_up,
        h=angle, x0=[np.deg2rad(170), 0.2], duration=20.0, dt=0.05, key=1, paths=4, measurement_noise=0.03, substeps=2,
    )  # fmt: skip
    late = path.times[0] > 17
    assert np.all(path.code == PathStatus.DURATION)
    assert np.all(np.cos(path.states[:, 0, 0]) < -0.98)
    assert np.all(np.cos(path.states[:, late, 0]) > 0.95)
    off = path.estimates[:, 50:, 0] - path.states[:, 50:, 0]
    assert np.all(np.cos(off) > 0.95)  # angles are compared round the circle: 18°


# --- refusals ---


def closed(problem=LQ, observer=None, control=law, **changes):
    observer = ExtendedKalman(LQ, position, [0.0, 0.0], [1.0, 1.0]) if observer is None else observer
    return simulate_output(problem, observer, control, **options(**changes))


class Grows(Memory):
    def update(self, state, u, dy, dt):
        return state | {"seen": jnp.zeros(2)}


REFUSED = [
    (ValueError, lambda: closed(dt=0.0), "dt = 0.0; wanted a finite number > 0"),
    (ValueError, lambda: closed(duration=np.inf), "duration = inf; wanted a finite number"),
    (ValueError, lambda: closed(duration=1e9), "intervals of 1e+09, wanted at most 1e7"),
    (ValueError, lambda: closed(x0=1.0), "x0 has shape (), wanted (n,)"),
    (ValueError, lambda: closed(x0=[np.nan, 0.0]), "wanted finite numbers"),
    (ValueError, lambda: closed(x0=[0.0]), "drift(x, u) "),
    (ValueError, lambda: closed(key=None), "wanted a JAX random key"),
    (ValueError, lambda: closed(key=jax.random.split(jax.random.key(0), 2), paths=3), "leave out one of them"),
    (ValueError, lambda: closed(x0=np.zeros((3, 2)), paths=2), "got 3 states and 2 paths"),
    (ValueError, lambda: closed(substeps=0), "substeps = 0; wanted a positive integer"),
    (ValueError, lambda: closed(measurement_noise=-1.0), "wanted finite numbers > 0"),
    (ValueError, lambda: closed(h=lambda x: x), "the observer does not take a control of shape (1,)"),
    (ValueError, lambda: closed(control=lambda s: s.mean), "control has shape (2,), wanted (1,)"),
    (ValueError, lambda: closed(observer=Blind([0.0]), control=lambda s: s), "estimate has shape (1,), wanted (2,)"),
    (
        ValueError,
        lambda: closed(observer=Grows(), control=lambda s: s["seen"]),
        "wanted the one that initial()",
    ),
    (ValueError, lambda: closed(grid=Grid([0.0], [1.0], (5,))), "wanted a Grid of 2 axes"),
    (ValueError, lambda: closed(Problem(integrator, controls=REACH, running_max=lambda x: x[0])), "a running_max"),
    (ValueError, lambda: closed(Problem(lambda x, u: -x)), "got a control, but problem.controls is None"),
    (TypeError, lambda: closed(control=None), "control is None, wanted a function of the observer's state"),
    (TypeError, lambda: closed(observer=3), "the observer is a int without initial and update and estimate"),
    (TypeError, lambda: closed(problem=3), "got int, wanted a Problem"),
]


@pytest.mark.parametrize(("kind", "call", "reason"), REFUSED, ids=[reason for *_, reason in REFUSED])
def test_refusals_say_what_is_wrong(kind, call, reason):
    refused(call, reason, kind)
