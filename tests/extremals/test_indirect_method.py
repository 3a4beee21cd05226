"""Pontryagin's principle against exact solutions, and what the solve says of itself."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.hamiltonian import pointwise

RIDER = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-9.0], [9.0]))


def without_target(problem):
    """The problem whose paths may cross the target, on which the zoo holds the value for its grids."""
    return dataclasses.replace(problem, target=None, exit_cost=None)


def exact(function, x):
    with jax.enable_x64(True):
        return float(function(jnp.asarray(x, float)))


def passes(extremal, tolerance=1e-6):
    """Converged, its Hamiltonian constant and least at every time."""
    check = extremal.optimality_check
    assert extremal.status is hjb.Status.CONVERGED
    assert check.drift < tolerance * (1 + check.scale)
    assert check.gap < tolerance * (1 + check.scale)
    assert np.all(np.diff(extremal.times) > 0)
    assert len(extremal.controls) == len(extremal.times) - 1
    return True


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [{}, {"mass": 1.5, "discount": 0.6, "control_weight": 2.0}], ids=str)
def test_an_infinite_horizon_is_riccati(parameters):
    problem, _ = zoo.double_integrator_lq(**parameters)
    start = np.array([1.0, -0.5])
    beta, mass, weight = (parameters.get(k, d) for k, d in (("discount", 0.0), ("mass", 1.0), ("control_weight", 1.0)))
    shifted = np.array([[0.0, 1.0], [0.0, 0.0]]) - 0.5 * beta * np.eye(2)
    matrix = solve_continuous_are(shifted, np.array([[0.0], [1 / mass]]), np.eye(2), weight * np.eye(1))
    extremal = hjb.pontryagin(problem, start, tol=1e-10, max_nodes=20_000)
    assert passes(extremal)
    assert extremal.cost == pytest.approx(start @ matrix @ start, abs=1e-8)
    np.testing.assert_allclose(extremal.costates, 2 * extremal.states @ matrix, atol=1e-7)
    np.testing.assert_allclose(extremal.optimality_check.hamiltonian, 0, atol=1e-8)
    np.testing.assert_allclose(
        extremal.values, np.einsum("ki,ij,kj->k", extremal.states, matrix, extremal.states), atol=1e-7
    )


def test_a_finite_horizon_is_tanh():
    extremal = hjb.pontryagin(RIDER, [0.8], horizon=1.5)
    assert passes(extremal)
    assert extremal.cost == pytest.approx(np.tanh(1.5) * 0.64, abs=1e-8)
    left = 1.5 - extremal.times
    np.testing.assert_allclose(extremal.costates[:, 0], 2 * np.tanh(left) * extremal.states[:, 0], atol=1e-7)
    np.testing.assert_allclose(extremal.controls[:, 0], -extremal.costates[:-1, 0] / 2, atol=1e-12)
    assert extremal.horizon == 1.5


def test_a_terminal_cost_and_another_in_its_place():
    """Hopf and Lax: ½|u|² and ½w|x|² at the end make w|x|²/(2(1 + wT))."""

    def end(x):
        return 0.5 * x @ x

    problem = hjb.Problem(lambda x, u: u, lambda x, u: 0.5 * u @ u, hjb.Box([-9.0], [9.0]), terminal_cost=end)
    assert hjb.pontryagin(problem, [1.0], horizon=2.0).cost == pytest.approx(1 / 6, abs=1e-8)
    stiffer = hjb.pontryagin(problem, [1.0], horizon=2.0, terminal=lambda x: 2 * (x @ x))
    assert stiffer.cost == pytest.approx(2 / 9, abs=1e-8)
    home = hjb.pontryagin(problem, [1.0], horizon=2.0, terminal=[0.0])
    assert home.cost == pytest.approx(1 / 4, abs=1e-8)
    np.testing.assert_allclose(home.states[:, 0], 1 - home.times / 2, atol=1e-8)


@given(st.floats(0.2, 3.0), st.floats(0.3, 3.0))
@settings(max_examples=8)
def test_a_free_final_time(start, guess):
    """Time and effort, 1 + u²: at full unit speed, whatever the distance."""
    extremal = hjb.pontryagin(HURRY, [start], terminal=[0.0], horizon=hjb.FreeTime(guess), tol=1e-10)
    assert passes(extremal)
    assert extremal.horizon == pytest.approx(start, abs=1e-8)
    assert extremal.cost == pytest.approx(2 * start, abs=1e-8)
    np.testing.assert_allclose(extremal.costates, 2.0, atol=1e-8)


HURRY = hjb.Problem(lambda x, u: u, lambda x, u: 1 + u @ u, hjb.Box([-9.0], [9.0]))


def test_what_depends_on_time():
    """Against the Riccati equation integrated backward; H is no constant, and the check knows by how much."""

    def drift(t, x, u):
        return jnp.cos(t) * x + u

    def cost(t, x, u):
        return (1 + t) * x @ x + u @ u

    problem = hjb.Problem(drift, cost, hjb.Box([-9.0], [9.0]), discount=0.3, time_dependent=True)
    extremal = hjb.pontryagin(problem, [1.0], horizon=2.0, tol=1e-9)

    def riccati(s, p):
        t = 2.0 - s
        return (1 + t) + (2 * np.cos(t) - 0.3) * p - p * p

    matrix = solve_ivp(riccati, (0, 2), [0.0], rtol=1e-11, atol=1e-12, dense_output=True).sol
    assert passes(extremal)
    assert extremal.cost == pytest.approx(matrix(2.0)[0], abs=1e-7)
    np.testing.assert_allclose(
        extremal.costates[:, 0], 2 * matrix(2 - extremal.times)[0] * extremal.states[:, 0], atol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.5, -0.3])
def test_a_target_that_moves(speed):
    """To x ≥ 1 + ct at 1 + u²: in 1/(u − c), at the cost (1 + u²)/(u − c), which is least for u = c + √(c² + 1)."""
    problem = hjb.Problem(
        lambda t, x, u: u,
        lambda t, x, u: 1 + u @ u,
        hjb.Box([-9.0], [9.0]),
        target=lambda t, x: 1 + speed * t - x[0],
        time_dependent=True,
    )
    extremal = hjb.pontryagin(problem, [0.0], guess=hjb.pontryagin(HURRY, [0.0], terminal=[1.5]))
    best = speed + np.sqrt(speed**2 + 1)
    assert passes(extremal)
    np.testing.assert_allclose(extremal.controls, best, atol=1e-7)
    assert extremal.horizon == pytest.approx(1 / (best - speed), abs=1e-7)
    assert extremal.cost == pytest.approx(2 * best, abs=1e-7)
    np.testing.assert_allclose(extremal.optimality_check.hamiltonian, -2 * best * speed, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("discount", [0.0, 1.0])
@pytest.mark.parametrize("start", [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (-0.7, -1.3)])
def test_least_time_of_the_double_integrator(start, discount):
    problem = without_target(zoo.double_integrator(discount=discount)[0])
    extremal = hjb.pontryagin(problem, start, terminal=[0.0, 0.0])
    assert passes(extremal)
    time = exact(zoo.DoubleIntegrator().arrival_time, start)
    assert extremal.horizon == pytest.approx(time, abs=1e-6)
    assert extremal.cost == pytest.approx(exact(zoo.double_integrator_exact(discount=discount), start), abs=1e-6)
    sign = -np.sign(extremal.controls[0, 0])
    assert extremal.switches == pytest.approx([(time + sign * start[1]) / 2], abs=1e-6)
    np.testing.assert_array_equal(np.abs(extremal.controls), 1)


@pytest.mark.slow
def test_from_the_switching_curve_there_is_no_switch():
    problem = without_target(zoo.double_integrator(discount=0.0)[0])
    extremal = hjb.pontryagin(problem, [-0.5, 1.0], terminal=[0.0, 0.0])
    assert passes(extremal)
    assert extremal.horizon == pytest.approx(1, abs=1e-6)
    assert len(extremal.switches) == 0
    np.testing.assert_array_equal(extremal.controls, -1)


def test_enumerated_controls_jump_as_well():
    problem = hjb.Problem(
        zoo.DoubleIntegrator().drift, lambda x, u: jnp.ones(()), hjb.Finite([[-1.0], [0.0], [0.5], [1.0]])
    )
    extremal = hjb.pontryagin(problem, [1.0, 0.0], terminal=[0.0, 0.0])
    assert passes(extremal)
    assert extremal.horizon == pytest.approx(2, abs=1e-6)
    assert extremal.switches == pytest.approx([1], abs=1e-6)


@pytest.mark.slow
def test_one_input_jumps_and_one_does_not():
    """Home in x takes a time of 1 at full speed; y has as much, at the cost ¼."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: 1 + u[1] ** 2, hjb.Box([-1.0, -5.0], [1.0, 5.0]))
    extremal = hjb.pontryagin(problem, [1.0, 0.5], terminal=[0.0, 0.0])
    assert passes(extremal)
    assert extremal.cost == pytest.approx(1.25, abs=1e-6)
    np.testing.assert_allclose(extremal.controls, [[-1.0, -0.5]] * len(extremal.controls), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "start", [(1.0, 0.0, 1.0), *(pytest.param(x, marks=pytest.mark.slow) for x in ((1.0, -0.5, 1.0), (0.6, 0.4, 0.8)))]
)
def test_the_moon_landing(start):
    problem = without_target(zoo.moon_landing()[0])
    extremal = hjb.pontryagin(problem, start, terminal=[0.0, 0.0, np.nan])
    with jax.enable_x64(True):
        ignition, burn = zoo.Lander().ignition(start)
        fuel = float(zoo.moon_landing_exact()(start))
    assert passes(extremal)
    assert extremal.cost == pytest.approx(fuel, abs=1e-6)
    assert extremal.switches == pytest.approx([float(ignition)], abs=1e-6)
    assert extremal.horizon == pytest.approx(float(ignition + burn), abs=1e-6)
    np.testing.assert_allclose(extremal.states[-1], [0, 0, start[2] - fuel], atol=1e-6)
    coasting = extremal.times[:-1] < extremal.switches[0] - 1e-9
    np.testing.assert_array_equal(extremal.controls[:, 0], np.where(coasting, 0, 2))
    with jax.enable_x64(True):
        slope = jax.grad(zoo.moon_landing_exact())(jnp.asarray(start))
    np.testing.assert_allclose(extremal.costates[0], slope, atol=1e-6)


@pytest.mark.slow
def test_a_ball_and_the_edge_of_a_target():
    problem, _ = zoo.zermelo(discount=0.4)
    start, value = [1.0, -1.0], zoo.zermelo_exact(discount=0.4)
    home = hjb.pontryagin(without_target(problem), start, terminal=[0.0, 0.0])
    disc = hjb.pontryagin(problem, start)
    for extremal in (home, disc):
        assert passes(extremal)
        assert extremal.cost == pytest.approx(exact(value, start), abs=1e-6)
        np.testing.assert_allclose(np.linalg.norm(extremal.controls, axis=1), 1)
    assert np.linalg.norm(disc.states[-1]) == pytest.approx(0.2, abs=1e-7)
    with jax.enable_x64(True):
        slopes = jax.vmap(jax.grad(value))(jnp.asarray(disc.states))
    np.testing.assert_allclose(disc.costates, slopes, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("way", [1, -1])
def test_across_a_seam(way):
    """The cost 2 − 2 cos x is smooth there, so that one collocation over the seam is right as well."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: 2 - 2 * jnp.cos(x[0]) + u @ u, hjb.Box([-9.0], [9.0]))
    grid = hjb.Grid([-np.pi], [np.pi], (8,), (True,))
    straight = {"horizon": 2.0, "terminal": [way * 4.0]}
    parted = hjb.pontryagin(problem, [way * 2.0], grid=grid, **straight)
    whole = hjb.pontryagin(problem, [way * 2.0], **straight)
    assert passes(parted)
    assert parted.cost == pytest.approx(whole.cost, abs=1e-7)
    np.testing.assert_allclose(parted.costates[[0, -1]], whole.costates[[0, -1]], atol=1e-6)
    np.testing.assert_allclose(parted.states[[0, -1], 0], [2 * way, 4 * way], atol=1e-9)
    assert np.any(np.abs(parted.states[:, 0] - way * np.pi) < 1e-9)


def test_a_target_behind_a_seam_is_not_crossed():
    """From 2.5 up to an arc around −2.5 = 3.78: its near edge is an end, and its far edge is reached through it."""
    grid = hjb.Grid([-np.pi], [np.pi], (8,), (True,))
    arc = dataclasses.replace(HURRY, target=lambda x: jnp.abs(x[0] + 2.5) - 0.2)
    near, far = (hjb.pontryagin(HURRY, [2.5], terminal=[2 * np.pi + end]) for end in (-2.7, -2.3))
    extremal = hjb.pontryagin(arc, [2.5], guess=near, grid=grid)
    assert passes(extremal)
    assert extremal.horizon == pytest.approx(2 * np.pi - 5.2, abs=1e-8)
    through = hjb.pontryagin(arc, [2.5], guess=far, grid=grid, throw=False)
    assert through.status is hjb.Status.STALLED
    assert "crosses the target before its end" in through.message


def test_a_failed_solve_says_so():
    """Against ẋ = −x no force below ½ gets beyond ½."""
    slow = hjb.Problem(lambda x, u: u - x, lambda x, u: u @ u, hjb.Box([-0.5], [0.5]))
    with pytest.raises(hjb.SolveError, match="the boundary-value problem was not solved") as raised:
        hjb.pontryagin(slow, [0.0], horizon=1.0, terminal=[2.0])
    partial = raised.value.solution
    assert partial.status in (hjb.Status.DIVERGED, hjb.Status.MAX_STEPS)
    assert partial.states.shape == (len(partial.times), 1)
    kept = hjb.pontryagin(slow, [0.0], horizon=1.0, terminal=[2.0], throw=False)
    assert kept.status is partial.status
    assert str(kept).startswith(f"{kept.status}: the boundary-value problem was not solved")
    assert repr(kept).startswith(f"Extremal({kept.status}")


def test_too_few_nodes_are_named():
    extremal = hjb.pontryagin(RIDER, [0.8], horizon=1.5, max_nodes=10, throw=False)
    assert extremal.status is hjb.Status.MAX_STEPS
    assert "raise max_nodes" in extremal.message


def test_a_bang_bang_problem_without_a_way_says_so():
    slow = hjb.Problem(lambda x, u: u - x, lambda x, u: jnp.ones(()), hjb.Box([-0.5], [0.5]))
    extremal = hjb.pontryagin(slow, [0.0], terminal=[2.0], throw=False)
    assert extremal.status is not hjb.Status.CONVERGED
    assert "not solved" in extremal.message


def test_an_extremal_is_a_guess():
    problem = without_target(zoo.double_integrator(discount=0.0)[0])
    first = hjb.pontryagin(problem, [1.0, 0.0], terminal=[0.0, 0.0])
    second = hjb.pontryagin(problem, [1.1, 0.1], terminal=[0.0, 0.0], guess=first)
    assert second.cost == pytest.approx(exact(zoo.DoubleIntegrator().arrival_time, [1.1, 0.1]), abs=1e-6)
    calm = hjb.pontryagin(RIDER, [0.8], horizon=1.5)
    assert hjb.pontryagin(RIDER, [0.9], horizon=1.6, guess=calm).cost == pytest.approx(0.81 * np.tanh(1.6), abs=1e-8)


def test_an_extremal_is_a_pytree():
    extremal = hjb.pontryagin(RIDER, [0.8], horizon=1.5)
    doubled = jax.tree.map(lambda leaf: 2 * leaf, extremal)
    assert doubled.cost == 2 * extremal.cost
    assert doubled.message == ""
    assert dataclasses.is_dataclass(extremal.optimality_check)


GAME = hjb.Problem(
    lambda x, u, d: u + d, lambda x, u, d: x @ x, hjb.Box([-1.0], [1.0]), disturbances=hjb.Box([-1.0], [1.0])
)
NOISY = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), noise=0.1, discount=1.0)
PUSHED = hjb.Problem(lambda x, u: u, lambda x, u: 1 + x @ x + u @ u, hjb.Box([-1.0], [1.0]))
IDLE = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
ADRIFT = hjb.Problem(lambda x, u: 2 + u, lambda x, u: x @ x + u @ u, hjb.Box([-1.0], [1.0]), discount=1.0)
HELD = hjb.Problem(lambda x, u: x + u, lambda x, u: (u[0] - 1) ** 2 + 0 * x[0], hjb.Box([1.0], [2.0]))

DOUBLED = hjb.Problem(lambda x, u: jnp.append(u, u), lambda x, u: u @ u, hjb.Box([-1.0], [1.0]))
VECTOR = hjb.Problem(lambda x, u: u, lambda x, u: u * u, hjb.Box([-1.0], [1.0]))
PLANE = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (5, 5), (True, True))
FLAT = hjb.Solution(PLANE, np.zeros((5, 5)), np.zeros((5, 5, 1)), code=1)
LINE = hjb.Grid([-2.0], [2.0], (5,))
MARCHED = hjb.Solution(LINE, np.zeros((3, 5)), np.zeros((3, 5, 1)), code=1, times=np.linspace(0, 2, 3))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: hjb.pontryagin(GAME, [1.0]), ValueError, "with disturbances, wanted one without"),
        (lambda: hjb.pontryagin(NOISY, [1.0]), ValueError, "with noise, wanted one without"),
        (lambda: hjb.pontryagin(RIDER, [[1.0]]), ValueError, "one finite number per state"),
        (lambda: hjb.pontryagin(RIDER, ["a"]), TypeError, "one number per state"),
        (lambda: hjb.pontryagin(RIDER, [1.0, 2.0]), ValueError, r"shape \(1,\), .*: n = 2 is the length of x0"),
        (lambda: hjb.pontryagin(DOUBLED, [1.0]), ValueError, r"drift\(x, u\) returned shape \(2,\), expected \(1,\)"),
        (lambda: hjb.pontryagin(RIDER, [1.0], horizon=1.0, terminal=lambda x: x), ValueError, r"returned shape \(1,\)"),
        (lambda: hjb.pontryagin(VECTOR, [1.0]), ValueError, r"cost\(x, u\) returned shape \(1,\), expected \(\)"),
        (lambda: hjb.pontryagin(RIDER, [1.0], rest=[0.0, 0.0]), ValueError, "rest = .0.0, 0.0., wanted shape .1,."),
        (lambda: hjb.pontryagin(RIDER, [1.0], grid=PLANE), ValueError, "a grid of 2 axes, wanted 1, the length of x0"),
        (lambda: hjb.pontryagin(RIDER, [1.0], grid=3), TypeError, "grid = 3, wanted a Grid or None"),
        (lambda: hjb.pontryagin(RIDER, [1.0], guess=FLAT), ValueError, "on a grid of 2 axes, wanted 1, the length of"),
        (lambda: hjb.pontryagin(RIDER, [1.0], guess=MARCHED), ValueError, "Solution as the guess and no horizon"),
        (lambda: hjb.pontryagin(RIDER, [1.0], guess=MARCHED, terminal=[0.0]), ValueError, "ends at t = 2;\n"),
        (lambda: hjb.pontryagin(RIDER, [1.0], horizon=-1.0), ValueError, "horizon = -1.0, wanted"),
        (lambda: hjb.pontryagin(RIDER, [1.0], terminal=[np.nan]), ValueError, "at least one state that is prescribed"),
        (lambda: hjb.pontryagin(RIDER, [1.0], terminal=lambda x: x @ x), ValueError, "a terminal cost and no horizon"),
        (lambda: hjb.pontryagin(RIDER, [1.0], guess=3), TypeError, "guess = 3, wanted a Solution"),
        (lambda: hjb.pontryagin(RIDER, [1.0], tol=0.0), ValueError, "tol = 0.0"),
        (lambda: hjb.pontryagin(RIDER, [1.0], max_nodes=0), ValueError, "max_nodes = 0"),
        (lambda: hjb.pontryagin(PUSHED, [1.0]), ValueError, "costs 1 per unit time without a discount"),
        (lambda: hjb.pontryagin(HELD, [1.0]), ValueError, "at its bound, where the Riccati equation does not"),
        (lambda: hjb.pontryagin(ADRIFT, [1.0]), ValueError, "no rest point of the Hamiltonian flow near x = .0.0."),
        (lambda: hjb.pontryagin(IDLE, [1.0]), ValueError, "controls that jump, without a Riccati equation"),
        (lambda: hjb.FreeTime(0.0), ValueError, "guess = 0.0, wanted a finite number > 0"),
    ],
)
def test_refusals(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_tracers_are_refused():
    with pytest.raises(ValueError, match="it runs on the host"):
        jax.jit(lambda x: hjb.pontryagin(RIDER, x).cost)(jnp.ones(1))


# The minimum at one state


def tilted(x, u):
    return jnp.stack([x[1] * u[0], u[1] - u[0]])


QUADRATIC = (tilted, lambda x, u: 0.5 * u[0] ** 2 + 2 * u[1] ** 2 + x[0] * u[0])
COUPLED = (tilted, lambda x, u: u[0] ** 2 + u[1] ** 2 + u[0] * u[1] + jnp.cosh(u[1]))
AFFINE = (tilted, lambda x, u: 1 + x[0] * u[0])
CONCAVE = (tilted, lambda x, u: 0.5 * u[0] ** 2 - 2 * u[1] ** 2 + x[0] * u[0])
SETS = {"box": hjb.Box([-1.0, -0.5], [0.7, 1.0]), "ball": hjb.Ball(0.9, 2)}


@pytest.mark.parametrize(
    ("functions", "exactly", "admissible"),
    [
        *itertools.product((QUADRATIC, AFFINE, CONCAVE), [True], SETS),
        (COUPLED, False, "ball"),
        pytest.param(COUPLED, False, "box", marks=pytest.mark.slow),
    ],
)
def test_no_sample_beats_the_minimiser(functions, exactly, admissible):
    problem = hjb.Problem(*functions, SETS[admissible])
    rule = pointwise.rule_of(problem, 2)
    assert rule.exact == exactly
    assert rule.jumps == (admissible == "box" and functions is AFFINE)
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        tried = rng.uniform(-1, 1, (4000, 2))
        if admissible == "ball":
            tried *= 0.9 / np.maximum(1, np.linalg.norm(tried, axis=1, keepdims=True))
        else:
            tried = np.clip(tried, *(np.asarray(end) for end in (SETS["box"].lo, SETS["box"].hi)))

        @jax.jit
        def compare(x, p):
            u = pointwise.minimiser(problem, rule, 0.0, x, p)
            energy = lambda u: pointwise.hamiltonian(problem, 0.0, x, p, u)  # noqa: E731
            return u, energy(u), jnp.min(jax.vmap(energy)(jnp.asarray(tried)))

        for x, p in rng.normal(size=(25, 2, 2)):
            u, least, sampled = compare(x, p)
            assert least <= sampled + 1e-12
            if admissible == "ball":
                assert np.linalg.norm(u) <= 0.9 * (1 + 1e-9)
            else:
                assert np.all((u >= SETS["box"].lo) & (u <= SETS["box"].hi))


@pytest.mark.parametrize(
    "functions", [QUADRATIC, pytest.param(COUPLED, marks=pytest.mark.slow)], ids=["exact", "searched"]
)
def test_the_minimiser_is_differentiable(functions):
    """So that Newton's method in the collocation has its true slopes."""
    problem = hjb.Problem(*functions, hjb.Ball(2.0, 2))
    rule = pointwise.rule_of(problem, 2)
    x, p, h = np.array([0.3, 0.8]), np.array([0.5, -0.4]), 1e-5
    with jax.enable_x64(True):
        find = jax.jit(lambda p: pointwise.minimiser(problem, rule, 0.0, x, p))
        slopes = jax.jacfwd(find)(p)
        for j, step in enumerate(h * np.eye(2)):
            np.testing.assert_allclose(slopes[:, j], (find(p + step) - find(p - step)) / (2 * h), atol=1e-6)
