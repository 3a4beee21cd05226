"""Controllers from an information state: closed forms, averages in NumPy, separation, gains under the worst noise."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import hjbjax as hjb
from hjbjax.filtering import (
    ExtendedKalman,
    GridFilter,
    RobustGridFilter,
    averaged_hamiltonian,
    certainty_equivalence,
    minimum_stress,
    simulate_output,
)

LINE = hjb.Grid([-6.0], [6.0], (121,))
X = LINE.axis(0)
WIDE = hjb.Box([-50.0], [50.0])
RHO, P = 2.0, 0.7


def seen(x):
    return x


def lag(x, u):
    return u - x


def quadratic(x, u):
    return 0.5 * (x @ x + RHO * u @ u)


def known(grid, value, policy=None):
    """A solution with these node values."""
    return hjb.Solution(grid, value, np.zeros((*grid.shape, 1)) if policy is None else policy)


def normal(grid, mean, deviation):
    """A normal density at the nodes of a line."""
    return np.exp(-(((grid.axis(0) - mean) / deviation) ** 2) / 2)


def filter_of(plant, density, grid=LINE):
    return GridFilter(plant, seen, grid, density)


# --- certainty equivalence ---


def test_certainty_equivalence_is_the_feedback_at_the_estimate_in_and_out_of_a_program():
    plant = hjb.Problem(lag, quadratic, WIDE, noise=0.5)
    observer = ExtendedKalman(plant, seen, [0.4], [0.3], measurement_noise=0.2)
    solution = known(LINE, P / 2 * X**2, -0.35 * X[:, None])
    options = {"h": seen, "x0": [1.0], "duration": 1.0, "dt": 0.1, "key": 3, "measurement_noise": 0.2}
    given_itself = simulate_output(plant, observer, solution, **options)
    for feedback in (solution, lambda x: -0.35 * x):
        control = certainty_equivalence(observer, feedback)
        assert_allclose(jax.jit(control)(observer.initial()), [-0.14], rtol=1e-6)
    path = simulate_output(plant, observer, certainty_equivalence(observer, solution), **options)
    assert_allclose(path.states, given_itself.states, rtol=1e-12)
    assert_allclose(path.controls, -0.35 * path.estimates[:-1], rtol=1e-12)


# --- the averaged Hamiltonian ---


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(st.floats(-2, 2), st.floats(0.3, 0.8), st.floats(0.2, 3.0), st.floats(0.1, 4.0))
def test_of_a_quadratic_the_average_is_certainty_equivalence(mean, deviation, slope, push):
    control, observer = _of_quadratic(slope, push)
    with jax.enable_x64(True):
        density = normal(LINE, mean, deviation)
        state = dataclasses.replace(observer.initial(), density=jnp.asarray(density / np.sum(density * LINE.volumes())))
        # the probabilities at the nodes have the mean up to 1e-12 of what the box cuts off
        assert_allclose(control(state), [-push * slope * mean / RHO], rtol=1e-7, atol=1e-9)
        assert_allclose(control(state), [-push * slope / RHO * observer.estimate(state)[0]], rtol=1e-10, atol=1e-12)


def _of_quadratic(slope, push):
    """The average of H with V = ½ slope x² and drift push u − x; the numbers are leaves."""
    plant = hjb.Problem(functools.partial(_pushed, push), quadratic, WIDE, noise=0.3)
    observer = filter_of(plant, normal(LINE, 0.0, 0.5))
    return averaged_hamiltonian(plant, known(LINE, slope / 2 * X**2), observer), observer


def _pushed(push, x, u):
    return push * u - x


@pytest.mark.slow
def test_noise_that_depends_on_the_control_brings_the_second_derivative():
    # H = ½ρu² + u P x + ½ (s u)² P: u = −P m/(ρ + s² P)
    strength, mean = 0.8, 1.2
    plant = hjb.Problem(lag, quadratic, WIDE, noise=lambda x, u: strength * u)
    observer = filter_of(plant, normal(LINE, mean, 0.5))
    control = averaged_hamiltonian(plant, known(LINE, P / 2 * X**2), observer)
    assert control.exact
    assert_allclose(control(observer.initial()), [-P * mean / (RHO + strength**2 * P)], rtol=1e-5)


TARGET = 2.0
DENSITY = normal(LINE, 1.0, 0.9) + 0.5 * normal(LINE, -2.0, 0.4)
CURVED = np.log(np.cosh(X)) + 0.3 * X
POINTS = np.array([[-1.0], [-0.4], [0.1], [0.3], [0.8]])
COSTS = {  # of one state in NumPy's functions or JAX's, and the set
    "enumerated": (lambda x, u, xp: xp.sin(3 * u) + x * u, hjb.Finite(POINTS)),
    "clipped": (lambda x, u, xp: 0.2 * u**2 + x * u, hjb.Box([-0.3], [1.0])),
    "bang-bang": (lambda x, u, xp: 0.1 * x**2 + 0 * u, hjb.Box([-1.0], [1.0])),
    "searched": (lambda x, u, xp: xp.sin(3 * u) + u**4 + x * u, hjb.Box([-1.0], [1.0])),
    "ball": (lambda x, u, xp: xp.cosh(2 * u) * (1 + 0.1 * x**2), hjb.Ball(0.8, 1)),
}


@pytest.mark.parametrize(
    "kind", [*list(COSTS)[:-2], *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("searched", "ball"))]
)
def test_the_minimum_is_that_of_an_average_in_numpy_with_a_target_left_out(kind):
    cost, admissible = COSTS[kind]
    plant = hjb.Problem(
        lambda x, u: jnp.cos(x) * u - x,
        lambda x, u: cost(x[0], u[0], jnp),
        admissible,
        noise=0.3,
        target=lambda x: TARGET - x[0],
        exit_cost=0.0,
    )
    observer = filter_of(plant, DENSITY)
    control = averaged_hamiltonian(plant, known(LINE, CURVED), observer)
    assert control.exact == (kind in ("clipped", "bang-bang"))
    found = float(control(observer.initial())[0])

    slopes = np.gradient(CURVED, X, edge_order=2)
    weights = np.where(X < TARGET, DENSITY, 0.0)
    weights[[0, -1]] *= 0.5

    def average(u):
        return np.sum(weights * (cost(X, u, np) + (np.cos(X) * u - X) * slopes)) / np.sum(weights)

    fine = POINTS[:, 0] if kind == "enumerated" else np.linspace(*_ends(admissible), 4001)
    values = np.array([average(u) for u in fine])
    assert abs(found - fine[np.argmin(values)]) <= (0 if kind == "enumerated" else np.diff(fine)[0]) + 1e-6
    assert average(found) <= values.min() + 1e-6
    assert_allclose(control.average(observer.initial(), jnp.array([found])), average(found), rtol=1e-5)


def _ends(admissible):
    if isinstance(admissible, hjb.Ball):
        return -admissible.radius, admissible.radius
    return admissible.lo[0], admissible.hi[0]


@pytest.mark.slow
def test_a_law_all_inside_the_target_has_a_control_too_and_grids_may_differ():
    plant = hjb.Problem(lag, quadratic, WIDE, noise=0.3, target=lambda x: 1.0 - x[0], exit_cost=0.0)
    inner = hjb.Grid([0.0], [3.0], (61,))
    density = np.where(inner.axis(0) > 1.2, normal(inner, 2.0, 0.2), 0.0)
    observer = filter_of(plant, density, inner)
    control = averaged_hamiltonian(plant, known(LINE, P / 2 * X**2), observer)
    assert_allclose(control(observer.initial()), -P / RHO * observer.estimate(observer.initial()), rtol=1e-5)


# --- minimum stress ---


@settings(max_examples=6, deadline=None)
@given(st.floats(-1, 1), st.floats(0.2, 1.0), st.floats(0.1, 1.5), st.floats(1.5, 4.0))
def test_of_parabolas_the_worst_case_is_the_coupled_state(estimate, spread, slope, gamma):
    coupling = spread * slope / gamma**2
    with jax.enable_x64(True):
        control = _stressed(slope)
        p = jnp.asarray(-(gamma**2) * (X - estimate) ** 2 / (2 * spread))
        worst = estimate / (1 - coupling)
        assert_allclose(control.worst_case(p), [worst], rtol=1e-9, atol=1e-11)
        assert_allclose(control(p), [-slope * worst], rtol=1e-9, atol=1e-11)
        # the largest of −γ²(x − x̂)²/2Y + ½Px²
        assert_allclose(control.stress(p), slope / 2 * estimate**2 / (1 - coupling), rtol=1e-9, atol=1e-11)


def _stressed(slope):
    plant = hjb.Problem(lag, quadratic, WIDE)
    observer = RobustGridFilter(plant, seen, LINE, lambda x: -x @ x, 2.0)
    return minimum_stress(observer, known(LINE, slope / 2 * X**2, -slope * X[:, None]))


def test_a_controller_that_is_made_inside_a_program_has_a_derivative():
    p, coupling = jnp.asarray(-2 * (X - 0.3) ** 2), 0.7 / 4  # γ = 2, Y = 1

    def control(slope):
        plant, x = hjb.Problem(lag, quadratic, WIDE), jnp.asarray(X)
        observer = RobustGridFilter(plant, seen, LINE, lambda x: -x @ x, 2.0)
        return minimum_stress(observer, known(LINE, slope / 2 * x**2, -slope * x[:, None]))(p)[0]

    value, slope = jax.jit(jax.value_and_grad(control))(0.7)
    assert_allclose([value, slope], [-0.21 / (1 - coupling), -0.3 / (1 - coupling) ** 2], rtol=1e-3)


def test_where_both_together_do_not_hold_the_level_the_worst_case_runs_to_an_end():
    control = _stressed(1.5)
    with jax.enable_x64(True):
        assert abs(control.worst_case(jnp.asarray(-0.5 * (X - 0.1) ** 2))[0]) == 6.0


@pytest.mark.slow
@pytest.mark.parametrize("paths", [None, 2])
def test_a_simulation_tells_that_the_worst_case_ran_to_an_end(paths):
    plant = hjb.Problem(lag, quadratic, WIDE)
    observer = RobustGridFilter(plant, seen, LINE, lambda x: -0.5 * x @ x, 0.9)
    too_much = minimum_stress(observer, known(LINE, 2 * X**2, -X[:, None]))  # p + V is largest at both ends
    asked = {"h": seen, "x0": [0.1], "duration": 0.2, "dt": 0.1, "key": 0, "paths": paths}
    with pytest.warns(UserWarning, match=rf"is at an end of the box on {paths or 1} of {paths or 1} paths"):
        simulate_output(plant, observer, too_much, **asked)
    simulate_output(plant, observer, _stressed(0.1), **asked)  # without a warning, which would be an error


# A plant that is not stable: ẋ = x + u + w, y = 2x + v, ∫ x² + u². No filter feedback holds a gain below 2; Kalman's
# with the regulator's has 3.16.
GAIN, RATE, SENSOR, START = 2.5, 1.0, 2.0, 0.5
DT, STEPS = 0.05, 120
BOX = hjb.Grid([-6.0], [6.0], (121,))


def unstable(x, u):
    return RATE * x + u


def sensed(x):
    return SENSOR * x


def both(x, u):
    return 0.5 * (x @ x + u @ u)


PLANT = hjb.Problem(unstable, both, WIDE)
GAME_P = (RATE + np.sqrt(RATE**2 + 1 - GAIN**-2)) / (1 - GAIN**-2)  # 2aP + 1 = P² (1 − γ⁻²)
REGULATOR = RATE + np.sqrt(RATE**2 + 1)


def robust_loop():
    """The robust filter and the minimum-stress controller of the unstable plant."""
    axis = BOX.axis(0)
    value = known(BOX, GAME_P / 2 * axis**2, -GAME_P * axis[:, None])
    observer = RobustGridFilter(
        PLANT, sensed, BOX, lambda x: -(GAIN**2) * x @ x / (2 * START), GAIN, scheme=hjb.Weno5()
    )
    return observer, minimum_stress(observer, value)


def kalman_loop():
    """Kalman's filter and the regulator's gain."""
    noisy = dataclasses.replace(PLANT, noise=1.0)
    observer = ExtendedKalman(noisy, sensed, [0.0], [START])
    return observer, certainty_equivalence(observer, lambda x: -REGULATOR * x)


@jax.jit
def driven(observer, control, start, w, v):
    """States and controls of the sampled plant under the disturbances w and v, held over each step."""
    grow = np.exp(RATE * DT)

    def step(carry, row):
        x, state = carry
        u = control(state)
        # y over the step is the mean of h(x) + v
        moved = grow * x + (grow - 1) / RATE * (u + row[0])
        mean = (moved - x - (u + row[0]) * DT) / (RATE * DT)
        state = observer.update(state, u, (SENSOR * mean + row[1]) * DT, DT)
        return (moved, state), (x, u)

    _, (x, u) = jax.lax.scan(step, (start, observer.initial()), jnp.stack([w, v], 1)[..., None])
    return x[:, 0], u[:, 0]


def gain_of(observer, control, start, w, v):
    """The root of ∫|z|² over what the disturbances and the initial state pay."""
    with jax.enable_x64(True):
        x, u = map(np.asarray, driven(observer, control, jnp.asarray([start]), jnp.asarray(w), jnp.asarray(v)))
    return np.sqrt(DT * np.sum(x**2 + u**2) / (start**2 / START + DT * np.sum(w**2 + v**2)))


def linear_loop(robust):
    """The largest gain of the linear loop by its Riccati equations, and the disturbances that have it: in NumPy alone.

    The loop maps (x₀/√Y₀, √dt w, √dt v) to √dt (x, u); the worst of all is the map's first right singular vector.
    """
    size = 1 + 2 * STEPS
    unit, level = np.eye(size), GAIN**-2 if robust else 0.0
    x, estimate, y, rows = np.sqrt(START) * unit[0], np.zeros(size), START, []
    for k in range(STEPS):
        w, v = (unit[1 + k + STEPS * which] / np.sqrt(DT) for which in (0, 1))
        u = -GAME_P * estimate / (1 - level * y * GAME_P) if robust else -REGULATOR * estimate
        rows += [x * np.sqrt(DT), u * np.sqrt(DT)]
        inner = 20  # Euler's steps of the continuous loop in each interval
        for _ in range(inner):
            error = SENSOR * (x - estimate) + v
            dx = RATE * x + u + w
            d_estimate = RATE * estimate + u + level * y * estimate + SENSOR * y * error
            y += DT / inner * (2 * RATE * y + 1 + (level - SENSOR**2) * y**2)
            x, estimate = x + DT / inner * dx, estimate + DT / inner * d_estimate
    _, sizes, directions = np.linalg.svd(np.array(rows))
    worst = directions[0] / np.max(np.abs(directions[0]))
    return sizes[0], (worst[0] * np.sqrt(START), worst[1 : 1 + STEPS] / np.sqrt(DT), worst[1 + STEPS :] / np.sqrt(DT))


@pytest.mark.slow
def test_minimum_stress_keeps_the_gain_that_certainty_equivalence_with_kalman_breaks():
    kalman_gain, against_kalman = linear_loop(robust=False)
    stress_gain, against_stress = linear_loop(robust=True)
    assert stress_gain < 0.95 * GAIN < 1.2 * GAIN < kalman_gain
    assert_allclose([stress_gain, kalman_gain], [2.31, 3.16], rtol=0, atol=5e-3)  # as the README has them
    loops = {"kalman": kalman_loop(), "stress": robust_loop()}
    gains = {
        (name, k): gain_of(*loop, *(0.3 * part for part in each))
        for name, loop in loops.items()
        for k, each in enumerate((against_kalman, against_stress))
    }
    # each loop attains its own gain, as NumPy's linear loop has it, against the worst case for it
    assert_allclose([gains["kalman", 0], gains["stress", 1]], [kalman_gain, stress_gain], rtol=2e-3)
    assert gains["stress", 0] < gains["stress", 1]

    # and no disturbance that is drawn does better than the worst
    key = np.random.default_rng(0)
    for _ in range(20):
        slow = np.exp(-np.arange(STEPS) * DT * key.uniform(0, 2))
        drawn = key.normal(), slow * key.normal(size=STEPS), slow * key.normal(size=STEPS)
        assert gain_of(*loops["stress"], *drawn) < stress_gain


NOISE = 0.3  # of both disturbances as white noise


def costs_of(problem, observer, control, **options):
    """The costs of paths under white noise, from the law of x₀ that Kalman's filter is told, the same in every loop."""
    x0 = NOISE * np.sqrt(START) * np.random.default_rng(1).normal(size=(300, 1))
    path = simulate_output(
        problem, observer, control, h=sensed, x0=x0, key=2, measurement_noise=NOISE, **({"duration": 4.0} | options)
    )
    return np.asarray(path.cost)


def separated_cost(duration):
    """The mean cost of the linear regulator with Kalman's estimate, in continuous time."""

    def rates(t, state):
        known, error, _ = state  # variances of the estimate and of its error
        pulled = (SENSOR * error / NOISE) ** 2
        return [
            2 * (RATE - REGULATOR) * known + pulled,
            2 * RATE * error + NOISE**2 - pulled,
            ((1 + REGULATOR**2) * known + error) / 2,
        ]

    return solve_ivp(rates, (0, duration), [0.0, NOISE**2 * START, 0.0], rtol=1e-9, atol=1e-12).y[2, -1]


@pytest.mark.slow
def test_the_averaged_hamiltonian_attains_the_cost_of_separation():
    plant = dataclasses.replace(PLANT, noise=NOISE)
    grid = hjb.Grid([-2.5], [2.5], (81,))
    variance = NOISE**2 * START
    observer = GridFilter(plant, sensed, grid, lambda x: jnp.exp(-x @ x / (2 * variance)), measurement_noise=NOISE)
    kalman = ExtendedKalman(plant, sensed, [0.0], [variance], measurement_noise=NOISE)
    averaged = averaged_hamiltonian(plant, known(grid, REGULATOR / 2 * grid.axis(0) ** 2), observer)
    costs = costs_of(plant, observer, averaged, dt=0.025)
    error = np.std(costs) / np.sqrt(len(costs))
    assert abs(np.mean(costs) - separated_cost(4.0)) < 3 * error
    assert error < 0.05 * np.mean(costs)
    # on each path the cost is that of Kalman's estimate, to the accuracy of the grid
    beside = costs_of(plant, kalman, certainty_equivalence(kalman, lambda x: -REGULATOR * x), dt=0.025)
    assert_allclose(costs, beside, rtol=0.05)
    assert abs(np.mean(costs - beside)) < 0.005 * np.mean(beside)


@pytest.mark.slow
def test_each_controller_is_best_at_what_it_is_made_for():
    plant = dataclasses.replace(PLANT, noise=NOISE)
    kalman = ExtendedKalman(plant, sensed, [0.0], [NOISE**2 * START], measurement_noise=NOISE)
    loops = {"kalman": (kalman, certainty_equivalence(kalman, lambda x: -REGULATOR * x)), "stress": robust_loop()}
    costs = {name: costs_of(plant, *loop, dt=DT) for name, loop in loops.items()}
    gains = {name: linear_loop(robust=name == "stress")[0] for name in loops}
    more = costs["stress"] - costs["kalman"]
    assert np.mean(more) > 3 * np.std(more) / np.sqrt(len(more))
    assert gains["stress"] < GAIN < gains["kalman"]


def coupled_states(count, dt):
    """Controls, a record, and x̄ after each step of it, by the filter's Riccati equation."""
    t = dt * np.arange(count)
    controls, record = 0.3 * np.sin(2 * t), 1.2 * np.cos(4 * t)

    def rates(t, state, u, y):
        estimate, spread = state
        return [
            RATE * estimate + u + spread / GAIN**2 * estimate + SENSOR * spread * (y - SENSOR * estimate),
            2 * RATE * spread + 1 + (GAIN**-2 - SENSOR**2) * spread**2,
        ]

    state, found = [0.0, START], []
    for u, y in zip(controls, record, strict=True):
        state = solve_ivp(rates, (0, dt), state, args=(u, y), rtol=1e-11, atol=1e-13).y[:, -1]
        found.append(state[0] / (1 - state[1] * GAME_P / GAIN**2))
    return controls, record, np.array(found)


def misses(observer, control, dt=0.05, count=20):
    """The largest errors of x̄ and of u along a record."""
    controls, record, wanted = coupled_states(count, dt)

    def step(p, row):
        p = observer.update(p, row[0], row[1] * dt, dt)
        return p, (control.worst_case(p)[0], control(p)[0])

    with jax.enable_x64(True):
        _, found = jax.lax.scan(step, observer.initial(), jnp.stack([controls, record], 1)[..., None])
        worst, u = map(np.asarray, found)
    return np.max(np.abs(worst - wanted)), np.max(np.abs(u + GAME_P * wanted))


def stress_on(grid, scheme, value):
    observer = RobustGridFilter(PLANT, sensed, grid, lambda x: -(GAIN**2) * x @ x / (2 * START), GAIN, scheme=scheme)
    return observer, minimum_stress(observer, value)


@pytest.mark.slow
def test_along_a_record_the_worst_case_is_the_coupled_state_to_second_order():
    errors = []
    for count in (61, 121, 241):
        grid = hjb.Grid([-3.0], [3.0], (count,))
        x = grid.axis(0)
        value = known(grid, GAME_P / 2 * x**2, -GAME_P * x[:, None])
        errors.append(misses(*stress_on(grid, hjb.Limited(), value))[0])
    assert_allclose(-np.polyfit(np.log([1, 2, 4]), np.log(errors), 1)[0], 2, atol=0.15)


@pytest.mark.slow
def test_with_a_marched_value_of_the_game_it_is_the_coupled_state_too():
    grid = hjb.Grid([-3.0], [3.0], (31,))
    game = hjb.attenuation(dataclasses.replace(PLANT, controls=hjb.Box([-30.0], [30.0])), GAIN, hjb.Box([-6.0], [6.0]))
    value = hjb.march(game, grid, 6.0, scheme=hjb.Weno5())
    found = misses(*stress_on(grid, hjb.Weno5(), value))
    assert max(found) < 1e-4


# --- refusals ---

MARCHED = hjb.Solution(LINE, np.zeros((3, 121)), np.zeros((3, 121, 1)), times=np.linspace(0, 1, 3))
QUIET = hjb.Problem(lag, quadratic, WIDE, noise=0.3)
FILTER = filter_of(QUIET, normal(LINE, 0.0, 0.5))
ROBUST = RobustGridFilter(QUIET, seen, LINE, lambda x: -x @ x, 2.0)
FLAT = known(LINE, 0 * X)


@pytest.mark.parametrize(
    ("kind", "call", "reason"),
    [
        (TypeError, lambda: certainty_equivalence(3, lag), r"certainty_equivalence: got int, wanted an Observer"),
        (TypeError, lambda: certainty_equivalence(FILTER, 3), r"got int, wanted a Solution or a function of the state"),
        (ValueError, lambda: certainty_equivalence(FILTER, MARCHED), r"got a marched solution, wanted a stationary"),
        (TypeError, lambda: averaged_hamiltonian(QUIET, FLAT, ROBUST), r"got RobustGridFilter, wanted a GridFilter"),
        (ValueError, lambda: averaged_hamiltonian(QUIET, MARCHED, FILTER), r"averaged_hamiltonian: got a marched"),
        (
            ValueError,
            lambda: averaged_hamiltonian(hjb.Problem(lambda x, u: -x), FLAT, FILTER),
            r"got a problem with no controls, wanted one player",
        ),
        (
            ValueError,
            lambda: averaged_hamiltonian(hjb.attenuation(QUIET, 2.0, WIDE), FLAT, FILTER),
            r"got a problem with disturbances, wanted one player .* use minimum_stress",
        ),
        (
            ValueError,
            lambda: averaged_hamiltonian(QUIET, known(hjb.Grid([-1.0], [1.0], (5,)), np.zeros(5)), FILTER),
            r"the filter's box from \[-6.0\] to \[6.0\] leaves the solution's box from \[-1.0\] to \[1.0\]",
        ),
        (
            ValueError,
            lambda: minimum_stress(ROBUST, known(hjb.Grid([-6.0], [6.0], (120,), periodic=(True,)), np.zeros(120))),
            r"wanted the same axes",
        ),
        (TypeError, lambda: minimum_stress(FILTER, FLAT), r"got GridFilter, wanted a RobustGridFilter"),
        (
            ValueError,
            lambda: minimum_stress(ROBUST, known(LINE, np.where(X > 5.95, np.inf, 0.0))),
            r"V is not finite at 1 nodes of the filter, the first \[6\.?\], where p \+ V has no maximum",
        ),
        (
            ValueError,
            lambda: averaged_hamiltonian(QUIET, known(LINE, np.where(X > 5.95, np.nan, 0.0)), FILTER),
            r"averaged_hamiltonian: V is NaN at 1 nodes",
        ),
        (
            ValueError,
            lambda: averaged_hamiltonian(QUIET, FLAT, FILTER)(ROBUST.initial()),
            r"GridFilter: got a ArrayImpl for the state, wanted a Density",
        ),
        (
            ValueError,
            lambda: minimum_stress(ROBUST, FLAT)(FILTER.initial()),
            r"minimum_stress: got a Density for p, wanted shape \(121,\)",
        ),
        (ValueError, lambda: minimum_stress(ROBUST, FLAT).stress(jnp.zeros(5)), r"minimum_stress: got \(5,\) for p"),
    ],
)
def test_what_does_not_fit_is_refused(kind, call, reason):
    with pytest.raises(kind, match=reason):
        call()


def test_a_law_that_is_none_has_no_control():
    control = averaged_hamiltonian(QUIET, FLAT, FILTER)
    broken = dataclasses.replace(FILTER.initial(), density=jnp.full(121, jnp.nan))
    assert np.isnan(control(broken)).all()
    assert np.isfinite(control(FILTER.initial())).all()
