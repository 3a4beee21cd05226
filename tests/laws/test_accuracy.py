"""Solutions against exact answers: errors of the plain chain, fitted orders, and problems on which it is exact."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from orders import order_of

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.zoo.ingredients import OutsideCube

PLAIN = hjb.Upwind(central=False)
NOISE = 0.5**0.5  # ε² = ½


def exact_at_nodes(exact, grid):
    """An answer of one state at all nodes, in float64."""
    with jax.enable_x64(True):
        states = grid.nodes().reshape(-1, grid.ndim)
        return np.asarray(jax.jit(jax.vmap(exact))(states)).reshape(grid.shape)


def largest_error(question, exact, where=None, **options):
    problem, grid = question
    solution = hjb.solve(problem, grid, **({"tol": 1e-7, "scheme": hjb.Upwind()} | options))
    off = np.abs(solution.value - exact_at_nodes(exact, grid))
    return np.max(off if where is None else off[where(grid.nodes())])


# --- errors of the first-order chain, evaluated independently ---


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "scheme", "known", "order"),
    [
        (0.0, PLAIN, (5.577e-2, 2.879e-2, 1.462e-2), 1),
        pytest.param(NOISE, PLAIN, (4.581e-2, 2.358e-2, 1.198e-2), 1, marks=pytest.mark.slow),
        (NOISE, hjb.Upwind(), (6.05e-4, 1.52e-4, 3.79e-5), 2),
    ],
    ids=["no noise", "noise, upwind", "noise, central where monotone"],
)
def test_bang_bang_errors_and_order(noise, scheme, known, order):
    exact = zoo.bang_bang_exact(noise=noise)
    errors = [largest_error(zoo.bang_bang(noise=noise, shape=(n,)), exact, scheme=scheme) for n in (41, 81, 161)]
    np.testing.assert_allclose(errors, known, rtol=0.05)
    assert abs(order_of(errors) - order) <= 0.15


RADIUS = 0.2
CIRCLE = hjb.Finite(np.stack([np.cos(np.arange(64) * np.pi / 32), np.sin(np.arange(64) * np.pi / 32)], axis=-1))


def velocity(x, u):
    return u


def unit_cost(x, u):
    return 1.0


def distance(x):
    return jnp.sqrt(x @ x) - RADIUS


def arrival(x):
    """1 − e^{−T} with T the distance from the disc, continued into it with T < 0."""
    return -jnp.expm1(-distance(x))


@functools.cache
def eikonal_error(n):
    problem = hjb.Problem(velocity, unit_cost, CIRCLE, discount=1.0, target=distance, exit_cost=arrival)
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (n, n))
    return largest_error((problem, grid), arrival, scheme=PLAIN, tol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.optimised
def test_eikonal_errors_and_order(count):
    errors = [eikonal_error(n) for n in (41, 81, 161)[:count]]
    np.testing.assert_allclose(errors, (9.2e-3, 4.5e-3, 2.3e-3)[:count], rtol=0.05)
    assert abs(order_of(errors) - 1) <= 0.15


@pytest.mark.slow
def test_smooth_nonlinear_problem_errors_and_order():
    def inner(x):
        return (np.abs(x[..., 0]) <= 0.5) & (np.abs(x[..., 1]) <= 0.45)

    exact = zoo.smooth_exact()
    errors = [largest_error(zoo.smooth(shape=(n, n)), exact, inner, tol=1e-6) for n in (41, 81, 161)]
    np.testing.assert_allclose(errors, (3.15e-2, 1.58e-2, 7.9e-3), rtol=0.05)
    assert abs(order_of(errors) - 1) <= 0.15


@pytest.mark.slow
def test_minimum_time_of_the_double_integrator_with_one_target_node():
    """T = −log(1 − S) at (1, 0), where it is 2 exactly: slow convergence, since T is only Hölder."""
    times = []
    for n in (41, 81):
        problem, grid = zoo.double_integrator(radius=0.0, shape=(n, n))
        times.append(-np.log1p(-float(hjb.solve(problem, grid, tol=1e-5, scheme=hjb.Upwind()).value_at([1.0, 0.0]))))
    np.testing.assert_allclose(times, (2.65, 2.60), atol=0.005)


# --- problems on which the first-order scheme is exact ---


def slowing(x, u):
    return u * (1 - jnp.abs(x))


def toll(x, u):
    return 3 * (1 - jnp.abs(x[0]))


@pytest.mark.slow
def test_slowing_down_is_exact():
    problem = hjb.Problem(slowing, toll, hjb.Box([-1.0], [1.0]), discount=1.0)
    for shape in ((21,), (22,)):  # with and without a node on the kink
        grid = hjb.Grid([-1.0], [1.0], shape)
        x = grid.nodes()[:, 0]
        away = np.ones(shape, bool) if shape[0] % 2 else np.abs(x) > grid.spacing(0)
        off = np.abs(hjb.solve(problem, grid, tol=1e-11, scheme=hjb.Upwind()).value - 1.5 * (1 - np.abs(x)))
        assert np.max(off[away]) <= 1e-10


@pytest.mark.parametrize("dim", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("discount", [0.0, 1.0])
def test_moving_along_the_axes_is_exact(dim, discount):
    problem, grid = zoo.eikonal(norm=1, dim=dim, discount=discount, radius=0.0, shape=(11,) * dim)
    solution = hjb.solve(problem, grid, tol=1e-10, scheme=hjb.Upwind())
    steps = np.sum(np.abs(np.indices(grid.shape) - 5), axis=0)
    h = 0.2
    # each step costs h; discounted the chain's step is V = (h + V')/(1 + βh)
    wanted = h * steps if discount == 0 else 1 - (1 + h) ** -steps.astype(float)
    np.testing.assert_allclose(solution.value, wanted, rtol=0, atol=1e-9)
    here = tuple(np.array([8, 4, 6][:dim]))
    axis = int(np.argmax(np.abs(solution.policy[here])))
    assert np.sign(solution.policy[here][axis]) == -np.sign(here[axis] - 5)


@pytest.mark.parametrize("dim", [1, *(pytest.param(dim, marks=pytest.mark.slow) for dim in (2, 3, 4))])
def test_brownian_exit_from_a_ball_is_exact_in_any_dimension(dim):
    question = zoo.brownian_ball(dim=dim, noise=0.7, shape=(9,) * dim)
    assert largest_error(question, zoo.brownian_ball_exact(dim=dim, noise=0.7), tol=1e-10) <= 1e-9


@pytest.mark.slow
def test_discounted_brownian_exit_is_second_order():
    exact = zoo.brownian_exit_exact(discount=2.0)
    errors = [largest_error(zoo.brownian_exit(discount=2.0, shape=(n,)), exact, tol=1e-10) for n in (21, 41, 81)]
    assert abs(order_of(errors) - 2) <= 0.15
    assert errors[-1] <= 1e-4


@pytest.mark.slow
def test_brownian_exit_from_the_square():
    problem, grid = zoo.brownian_exit(dim=2, shape=(41, 41))
    assert float(hjb.solve(problem, grid, tol=1e-9, scheme=hjb.Upwind()).value_at([0.0, 0.0])) == pytest.approx(
        0.5893708182, abs=3e-4
    )


RESTORING = np.array([[-1.0, 0.5], [0.0, -2.0]])
MIXING = np.array([[1.0, 0.2], [-0.4, 0.9]])


def restoring(x, u):
    return jnp.asarray(RESTORING, x.dtype) @ x


def restoring_on_a_line(x, u):
    return -1.5 * x


def square(x, u):
    return x @ x


def quadratic_value(drift, sigma, discount):
    """x'Px + tr(σσ'P)/λ with λP = I + A'P + PA, solved as a linear system."""
    n = len(drift)
    eye = np.eye(n)
    operator = discount * np.eye(n * n) - np.kron(eye, drift.T) - np.kron(drift.T, eye)
    matrix = np.linalg.solve(operator, eye.reshape(-1)).reshape(n, n)
    return matrix, np.trace(sigma @ sigma.T @ matrix) / discount


def held_at(matrix, constant, n):
    def exact(x):
        return x @ jnp.asarray(matrix, x.dtype) @ x + constant

    return {"target": OutsideCube(1.0).level, "exit_cost": exact}, exact


def test_ornstein_uhlenbeck_is_exact():
    theta, sigma, discount = 1.5, 0.8, 0.6
    known, exact = held_at(np.eye(1) / (discount + 2 * theta), sigma**2 / (discount * (discount + 2 * theta)), 1)
    problem = hjb.Problem(restoring_on_a_line, square, noise=sigma, discount=discount, **known)
    assert largest_error((problem, hjb.Grid([-1.0], [1.0], (41,))), exact, tol=1e-10) <= 1e-9


def test_correlated_noise_is_exact_on_quadratics():
    matrix, constant = quadratic_value(RESTORING, MIXING, 0.7)
    assert abs((MIXING @ MIXING.T)[0, 1]) > 0.2  # correlated indeed
    known, exact = held_at(matrix, constant, 2)
    problem = hjb.Problem(restoring, square, noise=MIXING, discount=0.7, **known)
    assert largest_error((problem, hjb.Grid([-1.0, -1.0], [1.0, 1.0], (21, 23))), exact, tol=1e-10) <= 1e-9


@pytest.mark.slow
def test_stochastic_lq_is_exact_up_to_its_bound():
    exact = zoo.stochastic_lq_exact(noise=1.0)
    assert largest_error(zoo.stochastic_lq(noise=1.0, shape=(101,)), exact, tol=1e-10) <= 1e-9


@pytest.mark.slow
def test_lq_on_the_inner_half_is_first_order():
    def inner(x):
        return np.max(np.abs(x), axis=-1) <= 1

    exact = zoo.double_integrator_lq_exact()
    errors = [largest_error(zoo.double_integrator_lq(shape=(n, n)), exact, inner, tol=1e-4) for n in (21, 41, 81)]
    assert errors[-1] <= 0.5
    assert abs(order_of(errors) - 1) <= 0.15


# --- constraints ---

STRIKE, INTEREST, VOLATILITY = 100.0, 0.05, 0.3


def price_drift(x, u):
    return INTEREST * x


def price_noise(x, u):
    return VOLATILITY * x


def minus_exercise(x):
    """The holder minimises −payoff."""
    return -jnp.maximum(STRIKE - x[0], 0.0)


def log_drift(x, u):
    return jnp.full_like(x, INTEREST - VOLATILITY**2 / 2)


def minus_exercise_of_log(x):
    return -jnp.maximum(STRIKE - jnp.exp(x[0]), 0.0)


def put_exact(price):
    """P = (K − S*)(S/S*)^{−2r/σ²} above the exercise price S* = K/(1 + σ²/2r)."""
    power = 2 * INTEREST / VOLATILITY**2
    best = STRIKE * power / (1 + power)
    return np.where(price <= best, STRIKE - price, (STRIKE - best) * (price / best) ** -power)


@pytest.mark.slow
def test_perpetual_put_on_a_log_price_grid():
    assert float(put_exact(100.0)) == pytest.approx(23.21468, abs=1e-5)
    lo, hi = np.log(20.0), np.log(500.0)
    errors = []
    for n in (81, 161, 321):
        problem = hjb.Problem(
            log_drift,
            noise=VOLATILITY,
            discount=INTEREST,
            stopping_cost=minus_exercise_of_log,
            target=lambda x: hi - 1e-6 - x[0],
            exit_cost=-float(put_exact(500.0)),
        )
        grid = hjb.Grid([lo], [hi], (n,))
        solution = hjb.solve(problem, grid, tol=1e-7, scheme=hjb.Upwind())
        prices = np.exp(grid.nodes()[:, 0])
        errors.append(np.max(np.abs(-solution.value - put_exact(prices))))
        payoff = np.maximum(STRIKE - prices, 0)
        exercised = prices[(-solution.value <= payoff + 1e-9) & (payoff > 0)]
        assert abs(np.log(exercised.max() / 52.63158)) <= 2 * grid.spacing(0)
        assert np.all(-solution.value >= payoff - 1e-12)
    assert errors[-1] <= 0.02
    assert order_of(errors) >= 0.85  # the free boundary lies between nodes: between first and second order
