"""Limited(): second order where the value is smooth, never worse than the plain chain where it is not."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from orders import order_of

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.problem.pytree import pytree_dataclass

PLAIN = hjb.Upwind(central=False)
NOISE = 0.5**0.5


@pytree_dataclass()
class Line:
    """f₀ = ½ sin x, c = 1.2 + .3 sin x and V = 1 − cos x + ¼x⁴: the cost q + u² with q = βV − f₀V' + ¼(cV')²."""

    discount: Any = 0.8

    def gain(self, x):
        return 1.2 + 0.3 * jnp.sin(x)

    def drift(self, x, u):
        return 0.5 * jnp.sin(x) + self.gain(x) * u

    def cost(self, x, u):
        slope = jnp.sin(x[0]) + x[0] ** 3
        best = self.gain(x[0]) * slope
        return self.discount * self.value(x) - 0.5 * jnp.sin(x[0]) * slope + 0.25 * best * best + u[0] * u[0]

    def value(self, x):
        return 1 - jnp.cos(x[0]) + 0.25 * x[0] ** 4


@pytree_dataclass()
class Space:
    """Three states, three inputs with gain 1, V = Σ(cosh x_i − 1) + ¼x₁²x₂² + ¼x₂x₃."""

    discount: Any = 0.5

    def free(self, x):
        return (
            0.3 * x[1] - 0.5 * x[0],
            0.2 * jnp.sin(x[2]) - 0.5 * x[1],
            -0.4 * x[2] - 0.2 * x[0],
        )

    def slope(self, x):
        return (
            jnp.sinh(x[0]) + 0.5 * x[0] * x[1] * x[1],
            jnp.sinh(x[1]) + 0.5 * x[0] * x[0] * x[1] + 0.25 * x[2],
            jnp.sinh(x[2]) + 0.25 * x[1],
        )

    def drift(self, x, u):
        return jnp.stack([f + u[i] for i, f in enumerate(self.free(x))])

    def cost(self, x, u):
        terms = zip(self.free(x), self.slope(x), strict=True)
        return self.discount * self.value(x) - sum(f * p - 0.25 * p * p for f, p in terms) + u @ u

    def value(self, x):
        product = x[0] * x[1]
        bowl = jnp.cosh(x[0]) + jnp.cosh(x[1]) + jnp.cosh(x[2]) - 3
        return bowl + 0.25 * product * product + 0.25 * x[1] * x[2]


def on_a_line(n):
    system = Line()
    problem = hjb.Problem(system.drift, system.cost, hjb.Box([-4.0], [4.0]), discount=system.discount)
    return problem, hjb.Grid([-1.0], [1.0], (n,))


def in_space(n):
    system = Space()
    problem = hjb.Problem(system.drift, system.cost, hjb.Box([-3.0] * 3, [3.0] * 3), discount=system.discount)
    return problem, hjb.Grid([-1.0] * 3, [1.0] * 3, (n,) * 3)


def largest_error(question, exact, where=None, scheme=hjb.Limited(), tol=1e-9):  # noqa: B008
    problem, grid = question
    value = hjb.solve(problem, grid, scheme=scheme, tol=tol).value
    with jax.enable_x64(True):
        known = np.asarray(jax.jit(jax.vmap(exact))(grid.nodes().reshape(-1, grid.ndim))).reshape(grid.shape)
    off = np.abs(value - known)
    return np.max(off if where is None else off[where(grid.nodes())])


def inside(half_width):
    return lambda x: np.max(np.abs(x), axis=-1) <= half_width + 1e-9


# --- smooth values: order 2 ---


@pytest.mark.slow
def test_smooth_nonlinear_problem_is_second_order():
    def inner(x):
        return (np.abs(x[..., 0]) <= 0.5) & (np.abs(x[..., 1]) <= 0.45)

    errors = [largest_error(zoo.smooth(shape=(n, n)), zoo.smooth_exact(), inner) for n in (41, 81, 161)]
    np.testing.assert_allclose(errors, (1.8e-5, 5.1e-6, 1.4e-6), rtol=0.05)  # evaluated independently
    assert errors[1] <= 1e-5
    assert order_of(errors) >= 1.8


@pytest.mark.filterwarnings("ignore:the optimal drift leaves")
@pytest.mark.slow
def test_manufactured_problem_on_a_line_is_second_order():
    errors = [largest_error(on_a_line(n), Line().value, inside(0.5)) for n in (41, 81, 161)]
    assert order_of(errors) >= 1.8
    assert errors[1] <= 0.02 * largest_error(on_a_line(81), Line().value, inside(0.5), PLAIN)


@pytest.mark.slow
@pytest.mark.optimised
def test_manufactured_problem_in_space_is_second_order():
    """On the inner half. From 21 to 41 nodes the limiter still shows: the order is 1.55 there, 1.86 from 61 to 81."""
    counts = (41, 61, 81)
    errors = [largest_error(in_space(n), Space().value, inside(0.5), tol=1e-8) for n in counts]
    assert -np.polyfit(np.log(np.array(counts) - 1), np.log(errors), 1)[0] >= 1.8
    assert errors[0] <= 6e-5
    assert errors[0] <= 0.05 * largest_error(in_space(41), Space().value, inside(0.5), PLAIN, tol=1e-4)


@pytest.mark.slow
def test_slopes_of_a_quadratic_are_exact():
    """LQ on the inner half of the box, where no path is cut off; the plain chain is 1e-1 off."""
    exact = zoo.double_integrator_lq_exact()
    assert largest_error(zoo.double_integrator_lq(shape=(81, 81)), exact, inside(1.0)) <= 1e-6


@pytest.mark.slow
def test_value_with_a_kink_in_its_policy_is_second_order():
    """Bang-bang without noise."""
    errors = [largest_error(zoo.bang_bang(shape=(n,)), zoo.bang_bang_exact()) for n in (41, 81, 161)]
    assert errors[1] <= 5e-4
    assert order_of(errors) >= 1.8
    assert largest_error(zoo.bang_bang(), zoo.bang_bang_exact(), scheme=PLAIN) == pytest.approx(2.879e-2, rel=0.05)


# --- noise, games, stopping ---


@pytest.mark.slow
def test_bang_bang_with_noise():
    """By default central differences where they stay monotone; the limited slopes are of order 2 as well."""
    question, exact = zoo.bang_bang(noise=NOISE, shape=(41,)), zoo.bang_bang_exact(noise=NOISE)
    assert largest_error(question, exact, scheme=hjb.Upwind()) <= 7e-4
    errors = [largest_error(zoo.bang_bang(noise=NOISE, shape=(n,)), exact) for n in (41, 81, 161)]
    assert order_of(errors) >= 1.8
    assert errors[0] <= 0.1 * largest_error(question, exact, scheme=PLAIN)


@pytest.mark.slow
def test_lq_game():
    problem, grid = zoo.lq_game(shape=(101,))
    assert largest_error((problem, grid), zoo.lq_game_exact(), inside(0.5)) <= 1e-8
    assert largest_error((problem, grid), zoo.lq_game_exact(), inside(0.5), PLAIN) >= 1e-3
    assert abs(hjb.solve(problem, grid, scheme=hjb.Limited(), tol=1e-8).isaacs_gap) <= 0.05


@pytest.mark.slow
def test_merton_and_brownian_motion_in_the_square_are_never_worse():
    questions = [
        (zoo.merton(), zoo.merton_exact()),
        (zoo.brownian_exit(dim=2, shape=(21, 21)), zoo.brownian_exit_exact(dim=2)),
        (zoo.stochastic_lq(shape=(51,)), zoo.stochastic_lq_exact()),
    ]
    for question, exact in questions:
        limited, plain = (largest_error(question, exact, scheme=scheme) for scheme in (hjb.Limited(), PLAIN))
        assert limited <= 1.05 * plain + 1e-8


STRIKE, INTEREST, VOLATILITY = 100.0, 0.05, 0.3


def log_drift(x, u):
    return jnp.full_like(x, INTEREST - VOLATILITY**2 / 2)


def minus_exercise(x):
    return -jnp.maximum(STRIKE - jnp.exp(x[0]), 0.0)


def far(x):
    return np.log(500.0) - 1e-6 - x[0]


def minus_put(x):
    """The perpetual put: exercised below S* = K/(1 + σ²/2r) = 52.63158."""
    power = 2 * INTEREST / VOLATILITY**2
    best = STRIKE * power / (1 + power)
    price = jnp.exp(x[0])
    return -jnp.where(price <= best, STRIKE - price, (STRIKE - best) * (price / best) ** -power)


@pytest.mark.slow
def test_perpetual_put():
    exit_cost = float(minus_put(np.log([500.0])))
    options = {"noise": VOLATILITY, "discount": INTEREST, "stopping_cost": minus_exercise}
    problem = hjb.Problem(log_drift, **options, target=far, exit_cost=exit_cost)
    grids = [hjb.Grid([np.log(20.0)], [np.log(500.0)], (n,)) for n in (81, 161)]
    errors = [largest_error((problem, grid), minus_put, scheme=PLAIN) for grid in grids]
    limited = [largest_error((problem, grid), minus_put) for grid in grids]
    assert limited[0] <= 0.1 * errors[0]
    assert limited[1] <= 0.1 * errors[1]
    solution = hjb.solve(problem, grids[0], scheme=hjb.Limited(), tol=1e-7)
    payoff = np.maximum(STRIKE - np.exp(grids[0].nodes()[:, 0]), 0)
    assert np.all(-solution.value >= payoff - 1e-12)


# --- a continuum beats samples ---


def oscillator(x, u):
    return jnp.stack([x[1], u[0] - x[0]])


def effort(x, u):
    return x @ x + u @ u


@pytest.mark.parametrize("scheme", [hjb.Upwind(), hjb.Limited()])
@pytest.mark.slow
def test_a_box_beats_its_samples(scheme):
    box, grid, tol = hjb.Box([-1.0], [1.0]), hjb.Grid([-1.0, -1.0], [1.0, 1.0], (31, 31)), 1e-8
    value = hjb.solve(hjb.Problem(oscillator, effort, box, discount=0.5), grid, scheme=scheme, tol=tol).value
    gains = []
    for count in (11, 21, 41, 81):
        sampled = hjb.Problem(oscillator, effort, box.grid(count), discount=0.5)
        gain = hjb.solve(sampled, grid, scheme=scheme, tol=tol).value - value
        assert np.all(gain >= -2 * tol)
        gains.append(np.mean(gain))
    assert abs(order_of(gains) - 2) <= 0.3
    assert gains[-1] <= 1e-3


# --- what it says ---


@pytest.mark.slow
def test_status_message_and_statistics():
    problem, grid = zoo.bang_bang()
    solution = hjb.solve(problem, grid, scheme=hjb.Limited(), tol=1e-7)
    monotone = hjb.solve(problem, grid, tol=1e-7, scheme=hjb.Upwind())
    assert solution.status is hjb.Status.CONVERGED
    assert solution.bounds is None
    assert "high-order" in solution.stats["certificate"]
    assert "high-order" in str(solution)
    assert solution.residuals[-1] <= 1e-7
    change = np.max(np.abs(solution.value - monotone.value))
    assert solution.stats["from_monotone"] == pytest.approx(change, abs=1e-6)
    assert change > 0.01


def test_a_solve_cut_short_says_so():
    problem, grid = zoo.bang_bang()
    with pytest.raises(hjb.SolveError, match="MAX_STEPS") as caught:
        hjb.solve(problem, grid, scheme=hjb.Limited(), tol=1e-9, max_steps=3)
    assert np.all(np.isfinite(caught.value.solution.value))


def test_the_answer_inside_transformations_is_that_of_the_host():
    problem, grid = zoo.bang_bang()

    def value(tol):
        return hjb.solve(problem, grid, scheme=hjb.Limited(), tol=tol).value

    with jax.enable_x64(True):
        np.testing.assert_allclose(jax.jit(value)(1e-9), value(1e-9), atol=1e-8)
