"""Networks: exact linear-quadratic values, stochastic values in closed form, files, feedbacks, limits and refusals."""

import dataclasses
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

import hjbjax as hjb
from hjbjax import neural
from hjbjax.neural import backward_equation, deterministic
from hjbjax.neural.extremal_samples import ExtremalSamples
from hjbjax.problem.settings import own_settings

DRAW = np.random.default_rng(3)
A, B = DRAW.normal(size=(3, 3)) / 2, DRAW.normal(size=(3, 2))
PLANT = hjb.Problem(
    lambda x, u: jnp.asarray(A) @ x + jnp.asarray(B) @ u, lambda x, u: x @ x + u @ u, hjb.Box([-99.0] * 2, [99.0] * 2)
)
CORNERS = [-1.0] * 3, [1.0] * 3
RICCATI = solve_continuous_are(A, B, np.eye(3), np.eye(2))
STATES = DRAW.uniform(-1, 1, (5, 3))
CHEAP = {"layers": (8,), "extremals": 0, "held_out": 0, "steps": 25}


@pytest.fixture(scope="module")
def quadratic():
    return neural.solve(PLANT, *CORNERS, seed=0, **CHEAP)


def test_a_linear_quadratic_value_is_exact(quadratic):
    assert quadratic.status is hjb.Status.CONVERGED
    exact = np.einsum("ki,ij,kj->k", STATES, RICCATI, STATES)
    assert np.allclose(quadratic.value_at(STATES), exact, rtol=1e-9)
    assert np.allclose(quadratic.costate_at(STATES), 2 * STATES @ RICCATI, rtol=1e-9)
    assert np.allclose(quadratic.control_at(STATES), -STATES @ RICCATI @ B, rtol=1e-9)
    assert quadratic.validation["residual"] < 1e-9


def test_held_out_extremals_tell_the_value_from_another_solution(quadratic):
    """The negative solution of the Riccati equation has no residual either."""
    lo, hi = map(np.asarray, CORNERS)
    equation = deterministic.Equation(quadratic.problem, lo, hi, 0.0, 1e-3, quadratic.rule)
    other = dataclasses.replace(quadratic.ansatz, matrix=-2 * solve_continuous_are(-A, B, np.eye(3), np.eye(2)))
    none, some = (ExtremalSamples(lo, hi, capacity, {}) for capacity in (0, 1))
    some.states[:5], some.values[:5], some.count = STATES, np.einsum("ki,ij,kj->k", STATES, RICCATI, STATES), 5
    with own_settings(x64=True):
        places = equation.places(jax.random.key(0), deterministic.HELD_OUT)
        errors = [
            deterministic._held_out_error(equation, ansatz, places, known)
            for ansatz, known in ((other, none), (other, some), (quadratic.ansatz, some))
        ]
    assert errors[0] < 1e-6 < 1 < errors[1]
    assert errors[2] < 1e-6


def test_a_linear_quadratic_value_over_a_horizon_is_exact():
    """V = x'Px + s·x + w with −P' = 1 + A'P + PA − PBB'P − βP, and a constant push in the drift."""
    end, push = np.diag([2.0, 0.5, 1.0]), np.array([0.3, 0.0, -0.2])
    problem = hjb.Problem(
        lambda x, u: PLANT.drift(x, u) + push, PLANT.cost, PLANT.controls, discount=0.2,
        terminal_cost=lambda x: x @ jnp.asarray(end) @ x - x[0],
    )  # fmt: skip
    found = neural.solve(problem, *CORNERS, seed=0, horizon=2.0, **CHEAP)

    def backward(left, row):
        p, s, w = row[:9].reshape(3, 3), row[9:12], row[12]
        change = np.eye(3) + A.T @ p + p @ A - p @ B @ B.T @ p - 0.2 * p
        slope = (A.T - p @ B @ B.T) @ s + 2 * p @ push - 0.2 * s
        return np.r_[change.ravel(), slope, s @ push - s @ B @ B.T @ s / 4 - 0.2 * w]

    start = np.r_[end.ravel(), [-1.0, 0.0, 0.0], 0.0]
    for t in (0.0, 1.3):
        row = solve_ivp(backward, (0, 2.0 - t), start, rtol=1e-10, atol=1e-12).y[:, -1]
        exact = np.einsum("ki,ij,kj->k", STATES, row[:9].reshape(3, 3), STATES) + STATES @ row[9:12] + row[12]
        assert np.allclose(found.value_at(t, STATES), exact, rtol=0, atol=1e-6 * np.max(np.abs(exact)))
    assert found.status is hjb.Status.CONVERGED


def ball(x):
    """The signed distance to a ball, also where it has no gradient."""
    return jnp.sqrt(x @ x + 1e-30) - 0.4


def to_ball(paid):
    return hjb.Problem(
        lambda x, u: u, lambda x, u: paid(x) + u @ u, hjb.Box([-50.0] * 3, [50.0] * 3), target=ball, exit_cost=0.5
    )


def test_a_cost_proportional_to_the_distance_from_a_target_is_exact(tmp_path):
    """The speed s costs (1 + s²)/s per unit of length, at least 2."""
    found = neural.solve(to_ball(lambda x: 1.0), *CORNERS, seed=0, **CHEAP)
    length = np.linalg.norm(STATES, axis=1, keepdims=True)
    assert np.min(length) > 0.4
    assert np.allclose(found.value_at(STATES), 0.5 + 2 * (length[:, 0] - 0.4), rtol=1e-6)
    assert np.allclose(found.control_at(STATES), -STATES / length, atol=1e-6)
    assert found.value_at([0.1, 0.0, -0.2]) == 0.5
    assert found.status is hjb.Status.CONVERGED
    found.save(tmp_path / "value")
    with pytest.raises(ValueError, match="target is missing"):
        neural.NeuralSolution.load(tmp_path / "value").value_at(STATES)


def test_it_is_a_feedback(quadratic):
    path = hjb.simulate(PLANT, quadratic, STATES[0], 20.0)
    assert abs(path.cost / quadratic.value_at(STATES[0]) - 1) < 1e-4
    assert np.allclose(hjb.greedy_feedback(PLANT, quadratic)(STATES), quadratic(STATES), rtol=1e-9)
    # another plant with the same value: half of the control has twice the effect
    stronger = hjb.Problem(lambda x, u: PLANT.drift(x, 2 * u), lambda x, u: PLANT.cost(x, 2 * u), PLANT.controls)
    assert np.allclose(2 * hjb.greedy_feedback(stronger, quadratic)(STATES), quadratic(STATES), rtol=1e-9)
    slopes = jax.jit(jax.vmap(jax.grad(quadratic.value_at)))(jnp.asarray(STATES))
    assert np.allclose(slopes, quadratic.costate_at(STATES), rtol=1e-4)


def test_outside_the_box_only_the_control_is_known(quadratic):
    assert np.isnan(quadratic.value_at([2.0, 0.0, 0.0]))
    assert np.isfinite(quadratic.value_at([2.0, 0.0, 0.0], extrapolate=True))
    assert np.all(np.isfinite(quadratic.control_at([2.0, 0.0, 0.0])))


def test_a_file_brings_it_back(quadratic, tmp_path):
    quadratic.save(tmp_path / "value")
    back = neural.NeuralSolution.load(tmp_path / "value")
    assert np.array_equal(back.value_at(STATES), quadratic.value_at(STATES))
    assert back.validation == quadratic.validation
    with pytest.raises(ValueError, match="the problem is missing"):
        back.control_at(STATES)
    again = neural.NeuralSolution.load(tmp_path / "value", PLANT)
    assert np.array_equal(again.control_at(STATES), quadratic.control_at(STATES))


def noisy(noise=0.5):
    return hjb.Problem(
        lambda x, u: u, lambda x, u: u @ u, hjb.Box([-np.inf] * 2, [np.inf] * 2), noise=noise,
        terminal_cost=lambda x: x @ x,
    )  # fmt: skip


START = np.array([1.0, -0.5])
STOCHASTIC = {"seed": 1, "intervals": 10, "steps": 100, "batch": 32, "layers": (16,), "rate": 0.02}


@pytest.fixture(scope="module")
def diffusion():
    return neural.deep_bsde(noisy(), START, 1.0, **STOCHASTIC)


def test_a_stochastic_value_in_closed_form(diffusion, tmp_path):
    """P' = P² backwards from 1 gives P = 1/(1 + T − t), and V = P |x|² + σ² n log(1 + T − t)."""
    exact = START @ START / 2 + 0.25 * 2 * np.log(2)
    found = diffusion.validation
    assert abs(found["value"] - exact) < 3 * found["standard_error"] + 2 * found["time_error"] + 0.01
    assert found["unexplained"] < 0.1
    # u = −½ DV and noise ½: half of the largest −H_pp : σσᵀ = ½ : ¼, times the variance of Y
    assert np.isclose(found["excess"], found["standard_error"] ** 2 * backward_equation.FRESH, rtol=1e-6)
    assert abs(diffusion.value_at(0.0, START) - found["value"]) < 1e-9
    near = START + 0.1 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    off = diffusion.value_at(0.0, near) - np.sum(near**2, axis=1) / 2 - 0.25 * 2 * np.log(2)
    assert np.max(np.abs(off)) < 0.03
    assert abs(np.mean(off)) < found["near_error"] + 0.01
    x = np.array([0.3, -0.2])
    assert abs(diffusion.value_at(1.0, x) - x @ x) < 1e-12
    assert np.allclose(diffusion.control_at(0.5, x), -x / 1.5, atol=0.15)
    diffusion.save(tmp_path / "value")
    back = neural.NeuralSolution.load(tmp_path / "value", noisy())
    assert np.array_equal(back.control_at(0.5, x), diffusion.control_at(0.5, x))


@pytest.mark.slow
def test_the_excess_covers_a_feedback_that_is_not_optimal():
    """Few time steps for a fast plant: V = x'Px + w, −P' = 1 + A'P + PA − PBB'P − βP, −w' = σ² tr P − βw."""
    n, noise, horizon, discount = 8, 0.3, 0.8, 0.4
    draw = np.random.default_rng(5)
    a, b, x = draw.normal(size=(n, n)) / 4, draw.normal(size=(n, 3)), np.linspace(-0.5, 0.5, n)
    problem = hjb.Problem(
        lambda x, u: jnp.asarray(a) @ x + jnp.asarray(b) @ u, lambda x, u: x @ x + u @ u,
        hjb.Box([-np.inf] * 3, [np.inf] * 3), noise=noise, discount=discount, terminal_cost=lambda x: 2 * x @ x,
    )  # fmt: skip

    def backward(left, row):
        p = row[:-1].reshape(n, n)
        change = np.eye(n) + a.T @ p + p @ a - p @ b @ b.T @ p - discount * p
        return np.r_[change.ravel(), noise**2 * np.trace(p) - discount * row[-1]]

    row = solve_ivp(backward, (0, horizon), np.r_[2 * np.eye(n).ravel(), 0.0], rtol=1e-9, atol=1e-11).y[:, -1]
    exact = x @ row[:-1].reshape(n, n) @ x + row[-1]
    found = neural.deep_bsde(problem, x, horizon, seed=3, steps=150, intervals=12, layers=(32,), rate=0.01).validation
    assert found["value"] - exact > 2 * found["error"]
    assert found["value"] - exact < found["error"] + found["excess"]
    assert found["excess"] < 10 * (found["value"] - exact)


@pytest.mark.parametrize(
    ("bent", "noise", "ratio"),
    [(np.diag([2.0, 0.0]), np.diag([0.5, 0.0]), 4.0), (np.diag([0.0, 1.0]), np.diag([0.5, 0.0]), np.inf)],
)
def test_noise_that_misses_a_curved_direction_gives_no_excess(bent, noise, ratio):
    assert backward_equation._largest_ratio(bent, noise) == pytest.approx(ratio)


def test_the_seed_repeats_it(diffusion):
    again = neural.deep_bsde(noisy(), START, 1.0, **STOCHASTIC)
    assert np.array_equal(again.history, diffusion.history)
    assert again.validation == diffusion.validation


@pytest.mark.slow
def test_a_guess_continues(diffusion):
    further = neural.deep_bsde(noisy(), START, 1.0, guess=diffusion, **STOCHASTIC | {"steps": 25})
    # a little more than the least loss, because V at the start was set to the estimate after the training
    assert 0.98 < further.history[0] / min(diffusion.history) < 1.05
    assert further.history[0] < 0.25 * diffusion.history[0]


@pytest.mark.parametrize("method", ["fit", "deep_bsde"])
def test_ctrl_c_keeps_the_best_weights(method, monkeypatch):
    """A signal during the third step, as from a keyboard; a shell may start the tests with it ignored."""
    calls = []

    def interrupt(x):
        calls.append(1)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return x

    def loss(p):
        return jax.pure_callback(interrupt, jax.ShapeDtypeStruct((), np.float64), jax.lax.stop_gradient(p)) * 0 + p**2

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        if method == "fit":
            found = hjb.fit(loss, 1.0, steps=50)
            assert len(found.history) < 50
            assert found.parameters < 1
        else:
            usual = backward_equation.train
            monkeypatch.setattr(
                backward_equation,
                "train",
                lambda loss, measure, *rest, **options: usual(
                    loss, lambda weights: interrupt(measure(weights)), *rest, **options
                ),
            )
            found = neural.deep_bsde(noisy(), START, 1.0, **STOCHASTIC)
            assert len(found.history) == 3
    finally:
        signal.signal(signal.SIGINT, before)
    assert found.status is hjb.Status.INTERRUPTED


def test_a_time_limit(diffusion):
    ended = neural.deep_bsde(noisy(), START, 1.0, time_limit=1e-9, **STOCHASTIC)
    assert ended.status is hjb.Status.TIME_LIMIT
    assert len(ended.history) == 1


def test_what_is_not_supported_is_refused():
    with pytest.raises(ValueError, match="with noise that does not depend on the control"):
        neural.deep_bsde(noisy(noise=None), START, 1.0, seed=0)
    quartic = hjb.Problem(lambda x, u: u, lambda x, u: jnp.sum(u**4), hjb.Box([-1.0] * 2, [1.0] * 2), noise=1.0)
    with pytest.raises(ValueError, match="no formula"):
        neural.deep_bsde(quartic, START, 1.0, seed=0)
    with pytest.raises(ValueError, match="noise"):
        neural.solve(noisy(), [-1.0] * 2, [1.0] * 2, seed=0)
    with pytest.raises(ValueError, match="target together with a horizon"):
        neural.solve(to_ball(lambda x: 1.0), CORNERS[0], CORNERS[1], seed=0, horizon=1.0)
    with pytest.raises(ValueError, match="random states of the box are in the target"):
        neural.solve(to_ball(lambda x: 1.0), [-0.1] * 3, [0.1] * 3, seed=0)
    with pytest.raises(ValueError, match="lo must be smaller"):
        neural.solve(PLANT, CORNERS[1], CORNERS[0], seed=0, **CHEAP)
    with pytest.raises(ValueError, match="rest point"):
        neural.solve(PLANT, [0.5] * 3, [1.0] * 3, seed=0, **CHEAP)


@pytest.mark.slow
@pytest.mark.optimised
def test_a_hundred_states():
    """V_t + ΔV − |∇V|² = 0 with ψ = log(½(1 + |x|²)): V(0, 0) = 4.59016, by E, Han and Jentzen (2017)."""
    problem = hjb.Problem(
        lambda x, u: 2 * u, lambda x, u: u @ u, hjb.Box([-np.inf] * 100, [np.inf] * 100), noise=np.sqrt(2.0),
        terminal_cost=lambda x: jnp.log(0.5 * (1 + x @ x)),
    )  # fmt: skip
    found = neural.deep_bsde(problem, np.zeros(100), 1.0, seed=0)
    assert found.status is hjb.Status.CONVERGED
    print(f"V = {found.validation['value']:.4f}")
    assert abs(found.validation["value"] / 4.59016 - 1) < 0.005
    # e^{−V} solves a linear equation, so V is the logarithm of a mean over normal numbers, also at other states
    draw = np.random.default_rng(0)
    ends, near = np.sqrt(2.0) * draw.normal(size=(40000, 100)), draw.normal(size=(8, 100)) / 10
    exact = [-np.log(np.mean(2 / (1 + np.sum((x + ends) ** 2, axis=1)))) for x in near]
    assert np.max(np.abs(found.value_at(0.0, near) / exact - 1)) < 0.01


def relative(error, exact):
    return np.linalg.norm(error) / np.linalg.norm(exact)


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize(
    ("options", "error"), [({"held_out": 1}, 1e-6), ({"held_out": 4, "quadratic": False, "layers": (128,)}, 0.01)]
)
def test_a_linear_quadratic_value_in_ten_states(options, error):
    """By the ansatz, and by the network without its quadratic part."""
    draw = np.random.default_rng(0)
    a, b = draw.normal(size=(10, 10)) / 4 - 0.5 * np.eye(10), draw.normal(size=(10, 3))
    problem = hjb.Problem(
        lambda x, u: jnp.asarray(a) @ x + jnp.asarray(b) @ u, lambda x, u: x @ x + u @ u,
        hjb.Box([-500.0] * 3, [500.0] * 3),
    )  # fmt: skip
    found = neural.solve(problem, [-1.0] * 10, [1.0] * 10, seed=0, **options)
    states = draw.uniform(-1, 1, (1000, 10))
    exact = np.einsum("ki,ij,kj->k", states, solve_continuous_are(a, b, np.eye(10), np.eye(3)), states)
    off = relative(found.value_at(states) - exact, exact)
    print(f"relative error {off:.2g}")
    assert off < error


@pytest.mark.slow
@pytest.mark.optimised
def test_a_manufactured_value_in_six_states():
    """The cost q(x) + |u|² with x' = f(x) + u has the value V if q = −f·DV + ¼ |DV|²."""
    matrix = np.random.default_rng(3).normal(size=(6, 6)) / 2

    def value(x):
        return jnp.sum(jnp.log(1 + x**2)) + 0.5 * x @ x + 0.3 * (1 - jnp.cos(x @ jnp.asarray(matrix) @ x))

    def free(x):
        return -x + 0.5 * jnp.roll(x, 1) * jnp.cos(x)

    def paid(x):
        slope = jax.grad(value)(x)
        return 0.25 * slope @ slope - free(x) @ slope

    problem = hjb.Problem(lambda x, u: free(x) + u, lambda x, u: paid(x) + u @ u, hjb.Box([-50.0] * 6, [50.0] * 6))
    found = neural.solve(problem, [-1.0] * 6, [1.0] * 6, seed=0, layers=(96, 96), steps=5000, extremals=24, held_out=0)
    states = np.random.default_rng(1).uniform(-1, 1, (2000, 6))
    exact = np.asarray(jax.vmap(value)(states))
    off = relative(found.value_at(states) - exact, exact)
    print(f"relative error {off:.2g}")
    assert off < 0.01
    assert found.status is hjb.Status.CONVERGED


@pytest.mark.slow
@pytest.mark.optimised
def test_a_manufactured_value_over_a_horizon():
    """In four states, with the cost q(t, x) + |u|², x' = f(x) + u and q = −V_t − f·DV + ¼ |DV|²."""
    matrix, horizon = np.random.default_rng(3).normal(size=(4, 4)) / 2, 1.5

    def value(t, x):
        swelling = (1 + 0.5 * jnp.cos(2 * t)) * jnp.sum(jnp.log(1 + x**2))
        return swelling + 0.5 * x @ x + 0.3 * (1 - jnp.cos(x @ jnp.asarray(matrix) @ x + t))

    def free(x):
        return -x + 0.5 * jnp.roll(x, 1) * jnp.cos(x)

    def paid(t, x):
        rate, slope = jax.grad(value, (0, 1))(t, x)
        return 0.25 * slope @ slope - free(x) @ slope - rate

    problem = hjb.Problem(
        lambda t, x, u: free(x) + u, lambda t, x, u: paid(t, x) + u @ u, hjb.Box([-50.0] * 4, [50.0] * 4),
        terminal_cost=lambda t, x: value(horizon, x), time_dependent=True,
    )  # fmt: skip
    options = {"seed": 0, "horizon": horizon, "steps": 2500, "extremals": 8, "held_out": 0}
    found = neural.solve(problem, [-1.0] * 4, [1.0] * 4, **options)
    draw = np.random.default_rng(1)
    times, states = draw.uniform(0, horizon, 2000), draw.uniform(-1, 1, (2000, 4))
    exact = np.asarray(jax.vmap(value)(times, states))
    assert relative(found.value_at(times, states) - exact, exact) < 0.02
    assert np.allclose(found.value_at(horizon, states), jax.vmap(value, (None, 0))(horizon, states), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.optimised
def test_a_manufactured_cost_to_a_target_in_five_states():
    """The cost ¼ |DV|² + |u|² with x' = u has the value V, which is zero on the target."""

    def value(x):
        return ball(x) * (1.5 + 0.3 * x[0] + 0.2 * jnp.sin(x[1] + x[2]))

    def paid(x):
        slope = jax.grad(value)(x)
        return 0.25 * slope @ slope

    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: paid(x) + u @ u, hjb.Box([-50.0] * 5, [50.0] * 5), target=ball
    )  # fmt: skip
    found = neural.solve(problem, [-1.0] * 5, [1.0] * 5, seed=0, steps=600, extremals=16, held_out=4)
    assert found.status is hjb.Status.CONVERGED
    states = np.random.default_rng(1).uniform(-1, 1, (2000, 5))
    states = states[np.linalg.norm(states, axis=1) > 0.4]
    exact = np.asarray(jax.vmap(value)(states))
    assert relative(found.value_at(states) - exact, exact) < 0.03
    assert abs(found.validation["excess_cost"]) < 0.01


@pytest.mark.slow
@pytest.mark.optimised
def test_a_satellite_turns_as_cheaply_as_its_extremals():
    """Attitude by Rodrigues parameters and rates; 100 held-out states."""
    inertia = np.array([[4.0, 0.2, 0.1], [0.2, 3.0, 0.3], [0.1, 0.3, 2.0]])
    inverse = np.linalg.inv(inertia)

    def drift(x, u):
        s, w = x[:3], x[3:]
        turning = 0.25 * ((1 - s @ s) * w + 2 * jnp.cross(s, w) + 2 * s * (s @ w))
        return jnp.concatenate([turning, jnp.asarray(inverse) @ (jnp.cross(jnp.asarray(inertia) @ w, w) + u)])

    def cost(x, u):
        return 2 * x[:3] @ x[:3] + 0.5 * x[3:] @ x[3:] + 0.5 * u @ u

    problem = hjb.Problem(drift, cost, hjb.Box([-20.0] * 3, [20.0] * 3))
    corner = np.array([0.8] * 3 + [1.0] * 3)
    found = neural.solve(problem, -corner, corner, seed=0, held_out=104)
    print(
        f"relative excess of the cost: mean {found.validation['excess_cost']:.2g}, "
        f"largest {found.validation['worst_excess']:.2g}; {found.validation['failed']:.0f} starts failed"
    )
    assert found.validation["failed"] <= 10
    assert abs(found.validation["excess_cost"]) < 0.02
    assert found.validation["worst_excess"] < 0.02
