"""Closed loops against exact paths, exact costs and exact laws."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from hjbjax.feedback.path import PathStatus
from hjbjax.feedback.simulation import rollout, simulate
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.sets import Box

ROOT3 = math.sqrt(3.0)
A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
GAIN = np.array([[1.0, ROOT3]])
TRACES = []


@pytree_dataclass()
class Answer:
    """What simulate asks of a Solution: policy and disturbance at the nodes, looked up between them."""

    grid: Grid
    policy: object
    disturbance: object = None
    times: object = None

    def control_at(self, x, *, clamp=False):
        return self.grid.interpolate(self.policy, x, clamp=clamp)

    def disturbance_at(self, x, *, clamp=False):
        return self.grid.interpolate(self.disturbance, x, clamp=clamp)


def integrator(x, u):
    return u


def double_integrator(x, u):
    return jnp.stack([x[1], u[0]])


def quadratic(x, u):
    TRACES.append(1)
    return x @ x + u @ u


def one(x, u):
    return 1.0


def state_feedback(x):
    return -jnp.asarray(GAIN) @ x


def toward_zero(x):
    return -jnp.sign(x)


LQ = Problem(double_integrator, quadratic, Box([-9.0], [9.0]))
UNIT = Box([-1.0], [1.0])


def test_lq_path_and_cost_are_exact_and_a_second_call_compiles_nothing():
    TRACES.clear()
    for x0 in ([1.0, 0.0], [-0.3, 0.8]):
        path = simulate(LQ, state_feedback, x0, 30.0)
        exact = np.stack([expm((A - B @ GAIN) * t) @ x0 for t in path.times])
        np.testing.assert_allclose(path.states, exact, atol=1e-6)
        np.testing.assert_allclose(path.controls, -(exact @ GAIN.T)[:-1], atol=3e-6)
        assert path.cost == pytest.approx(x0 @ np.array([[ROOT3, 1], [1, ROOT3]]) @ x0, abs=1e-6)
        assert (path.status, path.reached, path.disturbances) == (PathStatus.DURATION, None, None)
        assert path.times.shape == (201,)
        assert path.states.dtype == np.float64
        seen = len(TRACES) if x0[0] == 1.0 else seen  # noqa: F821
    assert len(TRACES) == seen + 1, "the second call may probe the cost once; more means that it compiled again"


@pytest.mark.slow
def test_forward_derivative_of_the_cost_is_the_gradient_of_the_value():
    with jax.enable_x64(True):
        times = jnp.linspace(0.0, 25.0, 101)
        gradient = jax.jacfwd(lambda x0: rollout(LQ, state_feedback, x0, times).cost)(jnp.array([1.0, -0.5]))
    np.testing.assert_allclose(gradient, 2 * np.array([[ROOT3, 1], [1, ROOT3]]) @ [1.0, -0.5], atol=1e-5)


def test_discounted_cost_of_lq():
    p = (math.sqrt(5.0) - 1) / 2
    problem = Problem(integrator, quadratic, Box([-9.0], [9.0]), discount=1.0)
    path = simulate(problem, lambda x: -p * x, [2.0], 3.0, steps=50)
    assert not path.held
    assert path.cost == pytest.approx(4 * p * (1 - math.exp(-(1 + 2 * p) * 3)), abs=1e-6)


def test_zero_order_hold_is_the_exact_discrete_system():
    hold, x = 0.3, np.array([1.0, -0.5])
    path = simulate(LQ, state_feedback, x, 1.0, hold=hold)
    np.testing.assert_allclose(path.times, [0.0, 0.3, 0.6, 0.9, 1.0], atol=1e-12)
    assert path.held
    for k, dt in enumerate(np.diff(path.times)):
        u = -GAIN @ x
        np.testing.assert_allclose(path.controls[k], u, atol=1e-9)
        x = np.array([[1, dt], [0, 1]]) @ x + np.array([dt**2 / 2, dt]) * u
        np.testing.assert_allclose(path.states[k + 1], x, atol=1e-9)


def test_path_stops_at_the_target_and_pays_there():
    def disc(x):  # that the function jumps must not matter
        return jnp.where(jnp.abs(x[0]) > 0.25, 1.0, -1e-3)

    problem = Problem(integrator, one, UNIT, discount=0.5, target=disc, exit_cost=2.0)
    path = simulate(problem, toward_zero, [1.0], 5.0, steps=7)
    assert path.status == PathStatus.TARGET
    assert path.reached == pytest.approx(0.75, abs=1e-9)
    assert path.times[-1] == path.reached
    assert path.times.shape == (3,)
    assert path.states.shape == (3, 1)
    assert path.controls.shape == (2, 1)
    assert path.states[-1, 0] == pytest.approx(0.25, abs=1e-9)
    left = math.exp(-0.375)
    assert path.cost == pytest.approx((1 - left) / 0.5 + 2 * left, abs=1e-7)
    inside = simulate(problem, toward_zero, [0.1], 5.0, steps=7)
    assert (inside.reached, inside.cost, inside.states.tolist(), inside.controls.shape) == (0.0, 2.0, [[0.1]], (0, 1))
    short = simulate(problem, toward_zero, [1.0], 0.5, steps=7)
    assert short.reached is None
    assert short.status == PathStatus.DURATION
    assert short.times[-1] == 0.5


def exact_minimum_time_policy(grid):
    x = grid.nodes()
    side = x[..., 0] + 0.5 * x[..., 1] * np.abs(x[..., 1])
    return -np.where(side == 0, np.sign(x[..., 1]), np.sign(side))[..., None]


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"hold": 0.01}])
def test_interpolated_bang_bang_feedback_takes_the_minimum_time(options):
    grid = Grid([-2.0, -2.0], [2.0, 2.0], (101, 101))
    problem = Problem(double_integrator, one, UNIT, target=lambda x: jnp.sqrt(x @ x) - 0.05)
    path = simulate(problem, Answer(grid, exact_minimum_time_policy(grid)), [1.0, 0.0], 5.0, **options)
    assert path.status == PathStatus.TARGET
    assert 1.9 < path.reached < 2.1  # the disc is entered before 2, the smeared switch costs a little
    assert np.all(np.abs(path.controls) <= 1 + 1e-12)


def test_sliding_on_a_switching_line_ends_in_bounded_work():
    problem = Problem(double_integrator, one, UNIT)
    path = simulate(problem, lambda x: -jnp.sign(x[:1] + x[1:]), [0.5, 0.0], 5.0, max_steps=20_000)
    assert path.status == PathStatus.DURATION
    assert path.steps < 20_000
    assert "hold=dt" in path.message
    x = path.states[path.times > 1.5]  # on the line x1 + x2 = 0 the state decays like e^{-t}
    assert np.max(np.abs(x.sum(axis=1))) < 2e-3
    np.testing.assert_allclose(x[-1, 0] / x[0, 0], math.exp(-(5.0 - path.times[path.times > 1.5][0])), rtol=0.05)


def test_periodic_states_are_wrapped_before_cost_and_feedback_see_them():
    grid = Grid([0.0], [1.0], (8,), periodic=(True,))
    problem = Problem(lambda x, u: jnp.ones(1), lambda x, u: x[0], UNIT)
    path = simulate(problem, lambda x: x, [0.03], 2.5, steps=40, grid=grid)
    assert path.states[-1, 0] == pytest.approx(2.53, abs=1e-9)
    assert path.status == PathStatus.DURATION
    np.testing.assert_allclose(path.controls[:, 0], np.mod(path.times[:-1] + 0.03, 1.0), atol=1e-9)
    assert path.cost == pytest.approx(2 * 0.5 + (0.53**2 - 0.03**2) / 2, abs=1e-4)


@pytest.mark.slow
def test_leaving_the_box_stops_at_the_edge_or_takes_the_nearest_point():
    grid = Grid([-1.0], [1.0], (5,))
    away = Answer(grid, np.linspace(0.0, 1.0, 5)[:, None] + 0.5)
    problem = Problem(integrator, one, Box([-2.0], [2.0]))
    with pytest.warns(UserWarning, match="left the box"):
        path = simulate(problem, away, [0.0], 3.0, steps=30, rtol=1e-10, atol=1e-12)
    edge = 2 * math.log(1.5)  # x' = 1 + x/2
    assert path.status == PathStatus.LEFT_BOX
    assert path.reached is None
    assert path.times[-1] == pytest.approx(edge, abs=1e-7) == path.cost
    assert path.states[-1, 0] == pytest.approx(1.0, abs=1e-9)
    assert path.controls.shape == (path.times.size - 1, 1)
    path = simulate(problem, away, [0.0], 3.0, steps=30, rtol=1e-10, atol=1e-12, clamp=True)
    assert path.status == PathStatus.DURATION
    assert "left the box" in path.message
    assert path.states[-1, 0] == pytest.approx(1 + 1.5 * (3 - edge), abs=1e-6)
    with pytest.raises(ValueError, match="outside the box"):
        simulate(problem, away, [1.5], 3.0)


@pytest.mark.slow
def test_worst_case_disturbance_of_a_solution_pays_the_value_of_the_game():
    gamma2, grid = 4.0, Grid([-2.0], [2.0], (9,))
    p = 1 / math.sqrt(1 - 1 / gamma2)
    problem = Problem(
        lambda x, u, d: u + d,
        lambda x, u, d: x @ x + u @ u - gamma2 * d @ d,
        Box([-9.0], [9.0]),
        disturbances=Box([-9.0], [9.0]),
    )
    answer = Answer(grid, -p * grid.nodes(), p / gamma2 * grid.nodes())
    worst = simulate(problem, answer, [1.5], 20.0)
    assert worst.cost == pytest.approx(p * 1.5**2, abs=1e-6)
    np.testing.assert_allclose(worst.disturbances, p / gamma2 * worst.states[:-1], atol=1e-9)
    given = simulate(problem, answer, [1.5], 20.0, disturbance=lambda x: p / gamma2 * x)
    assert given.cost == pytest.approx(worst.cost, abs=1e-8)
    calm = simulate(problem, Answer(grid, answer.policy, 0 * answer.disturbance), [1.5], 20.0)
    assert calm.cost == pytest.approx(1.5**2 * (1 + p**2) / (2 * p), abs=1e-6)
    assert calm.cost < worst.cost
    assert not np.any(calm.disturbances)


def test_time_goes_first_exactly_when_the_problem_says_so():
    problem = Problem(
        lambda t, x, u: u + jnp.cos(t), lambda t, x, u: t * u[0], UNIT, time_dependent=True,
        target=lambda t, x: 2 - x[0] + 0 * t, exit_cost=lambda t, x: t + x[0],
    )  # fmt: skip
    path = simulate(problem, lambda t, x: t[None] - jnp.cos(t), [0.0], 5.0, steps=10)  # x = t²/2
    assert path.reached == pytest.approx(2.0, abs=1e-6)
    running = 8 / 3 - (2 * math.sin(2) + math.cos(2) - 1)
    assert path.cost == pytest.approx(running + 4.0, abs=1e-5)


def test_running_maximum_is_the_cost_where_the_problem_has_one():
    problem = Problem(lambda x, u: jnp.stack([x[1], -x[0]]), running_max=lambda x: x[0])
    path = simulate(problem, None, [0.0, 1.0], 4.0, steps=400)
    assert path.cost == pytest.approx(1.0, abs=1e-4)
    assert path.controls.shape == (400, 0)


@pytest.mark.slow
def test_ornstein_uhlenbeck_has_its_mean_and_variance():
    theta, sigma, count = 1.5, 0.7, 2000
    problem = Problem(lambda x, u: -theta * x, lambda x, u: x @ x, noise=sigma, discount=0.5)
    with jax.enable_x64(True):
        times, keys = jnp.linspace(0.0, 1.0, 6), jax.random.split(jax.random.key(3), count)
        one_path = jax.jit(jax.vmap(lambda key: rollout(problem, None, jnp.ones(1), times, key=key)))
        paths = jax.tree.map(np.asarray, one_path(keys))
    decay = np.exp(-theta * np.asarray(times))
    variance = sigma**2 * (1 - decay**2) / (2 * theta)
    x = paths.states[..., 0]
    assert np.all(np.abs(x.mean(axis=0) - decay) <= 4 * np.sqrt(variance / count) + 1e-12)
    assert np.all(np.abs(x.var(axis=0) - variance) <= 4 * variance * math.sqrt(2 / count) + 1e-12)
    t = np.linspace(0.0, 1.0, 2001)
    second = np.exp(-2 * theta * t) + sigma**2 * (1 - np.exp(-2 * theta * t)) / (2 * theta)
    expected = np.trapezoid(np.exp(-0.5 * t) * second, t)
    assert abs(paths.cost.mean() - expected) < 4 * paths.cost.std() / math.sqrt(count)


@pytest.mark.slow
def test_state_dependent_noise_is_taken_in_the_sense_of_ito():
    count, sigma = 2000, 0.5  # geometric Brownian motion: Itô's mean stays 1, Stratonovich's would be e^{σ²/2}
    problem = Problem(lambda x, u: 0 * x, noise=lambda x, u: sigma * x)
    with jax.enable_x64(True):
        times, keys = jnp.linspace(0.0, 1.0, 6), jax.random.split(jax.random.key(5), count)
        end = np.asarray(jax.vmap(lambda key: rollout(problem, None, jnp.ones(1), times, key=key).states[-1, 0])(keys))
    assert abs(np.mean(end) - 1) < 4 * math.sqrt(math.expm1(sigma**2) / count)
    assert abs(np.mean(end) - math.exp(sigma**2 / 2)) > 4 * math.sqrt(math.expm1(sigma**2) / count)


@pytest.mark.slow
def test_a_key_is_one_brownian_path_whatever_the_steps():
    problem = Problem(lambda x, u: 0 * x, noise=np.array([[1.0, 0.5], [0.0, 2.0]]))
    longest = (None, 0.01)
    ends = [simulate(problem, None, [0.0, 1.0], 2.0, steps=4, key=7, max_step=step).states[-1] for step in longest]
    np.testing.assert_allclose(*ends, atol=1e-10)
    again = simulate(problem, None, [0.0, 1.0], 2.0, steps=4, key=jax.random.key(7)).states[-1]
    assert again.tolist() == ends[0].tolist()
    other = simulate(problem, None, [0.0, 1.0], 2.0, steps=4, key=8).states[-1]
    assert np.all(np.abs(other - ends[0]) > 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param("additive", marks=pytest.mark.slow), "multiplicative"])
@pytest.mark.optimised
def test_variance_of_an_ornstein_uhlenbeck_path_over_4000_keys(kind):
    """dx = −θx dt + σ dw, or σx dw: eight states a path, so that 3 % are four standard deviations of the estimate."""
    theta, sigma = 0.25, 0.5
    noise = sigma if kind == "additive" else lambda x, u: sigma * x
    problem = Problem(lambda x, u: -theta * x, noise=noise)
    with jax.enable_x64(True):
        times, keys = jnp.linspace(0.0, 1.0, 6), jax.random.split(jax.random.key(15), 4000)
        run = jax.jit(jax.vmap(lambda key: rollout(problem, None, jnp.ones(8), times, key=key).states))
        x = np.asarray(run(keys))[:, 1:]
        times = np.asarray(times)[1:]
    decay = np.exp(-2 * theta * times)
    exact = {"additive": sigma**2 * (1 - decay) / (2 * theta), "multiplicative": decay * np.expm1(sigma**2 * times)}
    np.testing.assert_allclose(x.var(axis=(0, 2)), exact[kind], rtol=0.03)
    np.testing.assert_allclose(x.mean(axis=(0, 2)), np.sqrt(decay), rtol=0.02)


def times_to_the_target(problem, x0, end, steps, seed=1, count=4000):
    """Of paths without a feedback, all of which arrive: costs, which count the time, and last states."""
    keys, times = jax.random.split(jax.random.key(seed), count), jnp.linspace(0, end, steps + 1)
    paths = jax.jit(jax.vmap(lambda key: rollout(problem, None, jnp.asarray(x0), times, key=key)))(keys)
    assert np.mean(np.asarray(paths.code) == PathStatus.TARGET) > 0.999
    return np.asarray(paths.cost), np.asarray(paths.states[:, -1]), np.asarray(paths.reached)


def within(times, mean, errors=3):
    return abs(times.mean() - mean) < errors * times.std() / math.sqrt(len(times))


BROWNIAN = Problem(lambda x, u: 0 * x, lambda x, u: jnp.ones(()), noise=1.0, target=lambda x: 1 - jnp.abs(x[0]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps", "count"),
    [(50, 1000), pytest.param(50, 4000, marks=pytest.mark.slow), pytest.param(200, 2000, marks=pytest.mark.slow)],
)
@pytest.mark.optimised
def test_a_brownian_motion_meets_its_target_on_time(steps, count):
    """E τ = 1 and E τ² = 5/3 from 0 to |x| = 1; seen at the ends of steps alone E τ is 1.14 and 1.07.

    The standard error is .013 for 4000 paths.
    """
    cost, states, reached = times_to_the_target(BROWNIAN, [0.0], 8.0, steps, count=count)
    assert within(cost, 1.0)
    assert within(cost**2, 5 / 3)
    arrived = np.isfinite(reached)
    np.testing.assert_allclose(cost[arrived], reached[arrived], rtol=1e-6)
    np.testing.assert_allclose(np.abs(states[arrived]), 1.0, rtol=1e-6)
    assert abs(np.mean(states)) < 3 / math.sqrt(count)


@pytest.mark.slow
def test_paths_side_by_side_may_be_over_in_any_unit_of_time():
    """A path that is over must ask for no w beyond the last time: it asked for that of a tenth of a unit later."""
    keys = jax.random.split(jax.random.key(1), 20)
    for unit in (1.0, 1e-4):
        problem = Problem(lambda x, u: 0 * x, noise=unit**-0.5, target=lambda x: 1 - x[0] ** 2)
        times = unit * np.linspace(0, 1.5, 11)
        with jax.enable_x64(True):
            run = jax.vmap(lambda key, p=problem, t=times: rollout(p, None, jnp.zeros(1), t, key=key).reached)
            reached = np.asarray(jax.jit(run)(keys)) / unit
        assert 5 < np.sum(reached <= 1.5) < 20
        assert np.all((reached > 0.05) | np.isinf(reached))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["additive", "function"])
@pytest.mark.optimised
def test_an_ornstein_uhlenbeck_process_leaves_its_interval_on_time(kind):
    """dx = −θx dt + σ dw from 0 to |x| = 1: E τ = (2/σ²)∫₀¹ e^{θy²/σ²} ∫₀^y e^{−θz²/σ²} dz dy."""
    theta, sigma = 1.0, 1.0
    y = np.linspace(0, 1, 2001)
    inner = np.concatenate(
        [
            [0],
            np.cumsum((np.exp(-theta * y**2 / sigma**2)[1:] + np.exp(-theta * y**2 / sigma**2)[:-1]) / 2 * np.diff(y)),
        ]
    )
    mean = 2 / sigma**2 * np.trapezoid(np.exp(theta * y**2 / sigma**2) * inner, y)
    noise = sigma if kind == "additive" else lambda x, u: sigma + 0 * x
    problem = Problem(lambda x, u: -theta * x, lambda x, u: 1.0, noise=noise, target=lambda x: 1 - x[0] ** 2)
    assert within(times_to_the_target(problem, [0.0], 12.0, 50, count=2000)[0], mean)


@pytest.mark.slow
@pytest.mark.optimised
def test_a_brownian_motion_in_the_plane_leaves_the_disc_on_time_and_on_its_edge():
    """E τ = (1 − |x|²)/2 in the disc; E of the exit cost x₁² + x₁ is harmonic: ½ + x₁ + ½(x₁² − x₂²) at the start."""
    start = [0.3, -0.4]
    problem = Problem(
        lambda x, u: 0 * x, noise=1.0, target=lambda x: 1 - jnp.sqrt(x @ x), exit_cost=lambda x: x[0] ** 2 + x[0]
    )
    cost, states, reached = times_to_the_target(problem, start, 4.0, 40, count=2000)
    arrived = np.isfinite(reached)
    assert within(reached[arrived], (1 - 0.25) / 2)
    assert within(cost, 0.5 + 0.3 + 0.5 * (0.09 - 0.16))
    np.testing.assert_allclose(np.linalg.norm(states[arrived], axis=-1), 1.0, atol=1e-5)


@pytest.mark.slow
def test_noise_that_does_not_act_across_the_edge_leaves_the_interpolant_to_say_when():
    """ẋ₁ = 1 with noise in x₂ alone: the target x₁ ≥ .77 is met at t = .77."""
    problem = Problem(
        lambda x, u: jnp.stack([1.0 + 0 * x[0], 0 * x[0]]), noise=np.diag([0.0, 1.0]), target=lambda x: 0.77 - x[0]
    )
    path = simulate(problem, None, [0.0, 0.0], 2.0, steps=5, key=0)
    assert path.status == PathStatus.TARGET
    assert path.reached == pytest.approx(0.77, abs=1e-12)


def test_faults_end_the_path_with_a_status_and_a_warning():
    bang = Problem(lambda x, u: x**2, one)
    with pytest.warns(UserWarning, match="a state that is not finite"):
        path = simulate(bang, None, [1.0], 2.0, steps=20)  # 1/(1 − t)
    assert path.status == PathStatus.NONFINITE
    assert np.all(np.isfinite(path.states))
    assert np.isfinite(path.cost)
    assert 0.8 < path.times[-1] <= 1.0
    assert path.controls.shape[0] == path.times.size - 1
    with pytest.warns(UserWarning, match="max_steps"):
        path = simulate(LQ, state_feedback, [1.0, 0.0], 2.0, steps=20, max_steps=15)
    assert path.status == PathStatus.MAX_STEPS
    assert path.times[-1] == pytest.approx(1.5)


GAME = Problem(lambda x, u, d: u + d, None, UNIT, disturbances=UNIT)
PLAIN = Problem(integrator, quadratic, UNIT)
NOISY = Problem(integrator, quadratic, UNIT, noise=0.1)
BOX2 = Grid([-1.0, -1.0], [1.0, 1.0], (3, 3))


@pytest.mark.parametrize(
    ("problem", "feedback", "x0", "options", "match"),
    [
        (LQ, state_feedback, [1.0, np.nan], {}, "finite"),
        (LQ, state_feedback, [[1.0, 0.0]], {}, "shape"),
        (LQ, state_feedback, "here", {}, "one number per state"),
        (LQ, state_feedback, [0.5], {"grid": BOX2}, r"\(1,\), wanted \(2,\)"),
        (PLAIN, toward_zero, [1.0, 2.0], {"feedback": lambda x: x[:1]}, r"cost returned|drift returned shape \(1,\)"),
        (PLAIN, toward_zero, [1.0], {"duration": 0.0}, "duration"),
        (PLAIN, toward_zero, [1.0], {"duration": math.nan}, "duration"),
        (PLAIN, toward_zero, [1.0], {"duration": math.inf}, "duration"),
        (PLAIN, toward_zero, [1.0], {"steps": 0}, "steps"),
        (PLAIN, toward_zero, [1.0], {"steps": 2.5}, "steps"),
        (PLAIN, toward_zero, [1.0], {"hold": 0}, "hold"),
        (PLAIN, toward_zero, [1.0], {"hold": -0.1}, "hold"),
        (PLAIN, toward_zero, [1.0], {"hold": True}, "hold = True; wanted a finite number > 0, the sampling interval"),
        (PLAIN, toward_zero, [1.0], {"hold": 1e-12}, "1e7"),
        (PLAIN, toward_zero, [1.0], {"hold": 0.1, "steps": 20}, "leave out steps"),
        (PLAIN, toward_zero, [1.0], {"rtol": 0.0}, "rtol"),
        (PLAIN, toward_zero, [1.0], {"atol": math.nan}, "atol"),
        (PLAIN, toward_zero, [1.0], {"max_step": -1.0}, "max_step"),
        (PLAIN, toward_zero, [1.0], {"max_steps": 0}, "max_steps"),
        (PLAIN, toward_zero, [1.0], {"key": 0}, "nothing is random"),
        (PLAIN, toward_zero, [1.0], {"disturbance": toward_zero}, "disturbances is None"),
        (NOISY, toward_zero, [1.0], {}, "give key"),
        (NOISY, toward_zero, [1.0], {"key": "a"}, r"key is 'a', wanted one random key: key=jax.random.key\(0\)"),
        (NOISY, toward_zero, [1.0], {"key": True}, "key is True"),
        (NOISY, toward_zero, [1.0], {"key": 1.5}, "key is 1.5"),
        (NOISY, toward_zero, [1.0], {"key": 2**70}, "fits 64 bits"),
        (NOISY, toward_zero, [1.0], {"key": jax.random.split(jax.random.key(0), 3)}, r"shape \(3,\)"),
        (PLAIN, lambda x: None, [1.0], {}, "feedback returned None; is its return missing"),
        (PLAIN, lambda x: "left", [1.0], {}, "feedback returned a str"),
        (PLAIN, lambda x: {"u": x}, [1.0], {}, "feedback returned a dict"),
        (PLAIN, lambda x: 1j * x, [1.0], {}, "feedback returned complex"),
        (Problem(integrator, lambda x, u: None, UNIT), toward_zero, [1.0], {}, "cost returned None"),
        (GAME, toward_zero, [1.0], {"disturbance": lambda x: None}, "disturbance returned None"),
        (GAME, toward_zero, [1.0], {}, "give disturbance="),
        (GAME, toward_zero, [1.0], {"disturbance": lambda x: x[0]}, r"disturbance returned shape \(\)"),
        (PLAIN, lambda x: x[0], [1.0], {}, r"feedback returned shape \(\), expected \(1,\)"),
        (PLAIN, lambda x: -x if x[0] > 0 else x, [1.0], {}, "jnp.where"),
        (PLAIN, lambda x: np.sign(np.asarray(x)), [1.0], {}, "use jnp instead of np"),
        (LQ, Answer(BOX2, np.zeros((4, 3, 3, 1)), times=np.arange(4.0)), [0.5, 0.5], {}, "marched"),
    ],
)
def test_bad_input_is_refused_before_anything_is_compiled(problem, feedback, x0, options, match):
    options = {"feedback": feedback, "duration": 1.0, **options}
    with pytest.raises(ValueError, match=match):
        simulate(problem, x0=x0, **options)


def by_time(t, x):
    return jnp.cos(t)[None] - 0 * x


@pytest.mark.slow
def test_a_feedback_may_depend_on_time_though_the_problem_does_not():
    """ẋ = cos t gives x = sin t and the cost ∫ sin² + cos² = T; a hold keeps the control of the interval's start."""
    path = simulate(PLAIN, by_time, [0.0], 2.0, time_varying=True, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(path.states[:, 0], np.sin(path.times), atol=1e-8)
    assert path.cost == pytest.approx(2.0, abs=1e-8)
    held = simulate(PLAIN, by_time, [0.0], 2.0, time_varying=True, hold=0.5)
    np.testing.assert_allclose(np.diff(held.states[:, 0]), 0.5 * np.cos(held.times[:-1]), atol=1e-8)
    game = Problem(lambda x, u, d: u + d, None, UNIT, disturbances=UNIT)
    quiet = simulate(game, by_time, [0.0], 2.0, time_varying=True, disturbance=lambda t, x: -by_time(t, x))
    np.testing.assert_allclose(quiet.states, 0, atol=1e-12)
    traced = jax.jit(lambda x0: rollout(PLAIN, by_time, x0, jnp.linspace(0, 2, 5), time_varying=True).states)
    np.testing.assert_allclose(traced(jnp.zeros(1))[:, 0], np.sin(np.linspace(0, 2, 5)), atol=1e-5)


def test_time_varying_is_a_choice_of_two():
    with pytest.raises(TypeError, match="time_varying is 1"):
        simulate(PLAIN, by_time, [0.0], 1.0, time_varying=1)
    with pytest.raises(TypeError, match=r"function \(t, x\)"):
        simulate(PLAIN, 3, [0.0], 1.0, time_varying=True)


def test_what_cannot_be_called_is_a_type_error():
    with pytest.raises(TypeError, match="wanted a Solution or a function"):
        simulate(PLAIN, [-1.0], [1.0], 1.0)
    with pytest.raises(TypeError, match="wanted a Solution or a function"):
        simulate(PLAIN, None, [1.0], 1.0)
    with pytest.raises(ValueError, match="rollout"):
        jax.jit(lambda duration: simulate(PLAIN, toward_zero, [1.0], duration).cost)(1.0)
