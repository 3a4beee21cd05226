"""Problems over a simplex of controls: closed forms, dense value iteration, games, and every front door."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from scipy.optimize import linprog

import hjbjax as hjb
from hjbjax.cli.listing import _actions as in_words
from hjbjax.tracing.closures import digest

CARRIED = pytest.mark.filterwarnings("ignore:the box decides V", "ignore:the optimal drift leaves the box")


# --- closed forms ---

COVARIANCE, EXCESS = np.array([[0.09, 0.02], [0.02, 0.04]]), np.array([0.11, 0.07])
ROOT, RATE, IMPATIENCE = np.linalg.cholesky(COVARIANCE), 0.01, 0.1


def merton(simplex):
    """Merton's problem with log utility, in z = log wealth, with a tenth of the wealth consumed per year."""

    def drift(z, u):
        return jnp.array([RATE + EXCESS @ u[:2] - 0.5 * u[:2] @ COVARIANCE @ u[:2] - IMPATIENCE])

    return hjb.Problem(
        drift, controls=simplex, reward=lambda z, u: z[0] + np.log(IMPATIENCE), discount=IMPATIENCE,
        noise=lambda z, u: (u[:2] @ ROOT)[None],
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "simplex", [hjb.Simplex(3), pytest.param(hjb.Simplex(2, at_most=True), marks=pytest.mark.slow)]
)
def test_no_cash_is_held_where_borrowing_is_forbidden(simplex):
    """Merton's shares without bounds, Σ⁻¹(μ − r), are 0.94 and 1.28. With Σ π = 1 they are 2/3 and 1/3."""
    grid = hjb.Grid([-1.0], [1.0], (21,), edges="linear")
    solution = hjb.solve(merton(simplex), grid, scheme=hjb.Upwind(), tol=1e-9)
    shares = np.array([2 / 3, 1 / 3])
    np.testing.assert_allclose(solution.policy[:, :2], np.broadcast_to(shares, (21, 2)), atol=1e-6)
    growth = RATE + EXCESS @ shares - 0.5 * shares @ COVARIANCE @ shares
    exact = (np.log(IMPATIENCE) + growth / IMPATIENCE - 1) / IMPATIENCE
    assert float(solution.value_at([0.0])) == pytest.approx(exact, abs=1e-6)
    assert solution.bounds is None  # the noise depends on the shares, so the minimum is searched


@pytest.mark.slow
@CARRIED
def test_one_server_empties_the_dearest_queue_first():
    """The cμ rule: one server with an effort u₁ + u₂ ≤ 1 for two queues, ẋᵢ = −μᵢuᵢ, with holding costs cᵢxᵢ."""
    price, speed, discount, errors = np.array([1.0, 2.0]), np.array([3.0, 1.0]), 0.5, []

    def drained(x, c, m):  # ∫ c (x − m t) e^{−βt} dt until the queue is empty, and the discount then
        end = x / m
        left = np.exp(-discount * end)
        return c * (x / discount - m * (1 - left) / discount**2), left

    problem = hjb.Problem(lambda x, u: -speed * u, lambda x, u: price @ x, hjb.Simplex(2, at_most=True), discount=0.5)
    for count in (21, 41):
        grid = hjb.Grid([0.0, 0.0], [1.0, 1.0], (count, count))
        solution = hjb.solve(problem, grid, scheme=hjb.Upwind(), tol=1e-8)
        assert solution.bounds is not None
        x = grid.nodes()
        first, left = drained(x[..., 0], price[0], speed[0])
        second = drained(x[..., 1], price[1], speed[1])[0]
        exact = first + (1 - left) * price[1] * x[..., 1] / discount + left * second
        errors.append(np.max(np.abs(solution.value - exact)))
        # c₁μ₁ = 3 > c₂μ₂ = 2
        np.testing.assert_allclose(solution.policy[1:], np.broadcast_to([1.0, 0.0], (count - 1, count, 2)), atol=1e-12)
        np.testing.assert_allclose(solution.policy[0, 1:], np.broadcast_to([0.0, 1.0], (count - 1, 2)), atol=1e-12)
    assert errors[1] < 0.02
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.slow
@pytest.mark.parametrize("isaacs", ["upper", "lower"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_matrix_games(isaacs, seed):
    """min max u·Ad over mixed strategies is the value of a linear program, in both orders."""
    payoff = np.random.default_rng(seed).normal(size=(3, 4))
    program = linprog(
        [0, 0, 0, 1], A_ub=np.c_[payoff.T, -np.ones(4)], b_ub=np.zeros(4), A_eq=[[1, 1, 1, 0]], b_eq=[1],
        bounds=[(0, None)] * 3 + [(None, None)],
    )  # fmt: skip
    cost = Partial(lambda A, x, u, d: u @ A @ d, payoff)
    game = {"disturbances": hjb.Simplex(4), "isaacs": isaacs}
    problem = hjb.Problem(lambda x, u, d: -x, cost, hjb.Simplex(3), discount=1.0, **game)
    solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (5,)), scheme=hjb.Upwind(), tol=1e-9)
    np.testing.assert_allclose(solution.value, program.fun, atol=1e-6)
    assert solution.bounds is None


# --- dense value iteration ---


def random_problem(seed, n, *, at_most=False, total=1.0):
    rng = np.random.default_rng(seed)
    gain, price, root = rng.normal(size=(2, n)), rng.normal(size=n), rng.normal(size=(n, n))
    bend = root.T @ root / n
    numbers = {"gain": gain / total, "price": price / total, "bend": bend / total**2}
    drift = Partial(lambda p, x, u: p["gain"] @ u - 0.5 * x, numbers)
    cost = Partial(lambda p, x, u: x @ x + p["price"] @ u + 0.3 * x[0] * (p["price"] @ u) + u @ p["bend"] @ u, numbers)
    return hjb.Problem(drift, cost, hjb.Simplex(n, total, at_most), discount=1.0), (gain, price, bend)


def dense_values(numbers, actions, grid):
    """Value iteration in NumPy over a list of actions, with drifts out of the box set to zero."""
    gain, price, bend = numbers
    x, value, (rows, columns) = grid.nodes(), np.zeros(grid.shape), grid.shape
    u = actions[:, None, None]
    f = u @ gain.T - 0.5 * x
    paid = np.sum(x**2, -1) + u @ price * (1 + 0.3 * x[..., 0]) + np.sum((u @ bend) * u, -1)
    index = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1)
    last = np.array(grid.shape) - 1
    f = np.where(((index == 0) & (f < 0)) | ((index == last) & (f > 0)), 0, f)
    h = np.array([grid.spacing(axis) for axis in range(2)])
    rates = np.abs(f) / h
    for _ in range(1000):
        total = paid.copy()
        for axis in range(2):
            places = np.arange(grid.shape[axis])
            below, above = (np.take(value, places + step, axis, mode="clip") for step in (-1, 1))
            total += rates[..., axis] * np.where(f[..., axis] > 0, above, below)
        new = np.min(total / (1 + np.sum(rates, -1)), axis=0)
        if np.max(np.abs(new - value)) < 1e-9:
            return new
        value = new
    raise AssertionError("value iteration did not converge")


@CARRIED
@pytest.mark.parametrize(
    ("n", "at_most", "count"), [(2, False, 401), *(pytest.param(*c, marks=pytest.mark.slow) for c in
                                                  [(3, False, 61), (2, True, 61), (4, False, 25), (3, True, 25)])]
)  # fmt: skip
def test_values_are_those_of_dense_actions(n, at_most, count):
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (9, 8))
    for seed in range(5):
        problem, numbers = random_problem(seed, n, at_most=at_most)
        solution = hjb.solve(problem, grid, scheme=hjb.Upwind(), tol=1e-8)
        lower, upper = (np.asarray(each) for each in solution.bounds)
        dense = dense_values(numbers, np.asarray(problem.controls.grid(count).points), grid)
        assert np.max(lower - dense) < 1e-7  # fewer actions cannot be better
        assert np.max(dense - upper) < 0.5 / count  # kinks lie between the actions


# --- units, transformations ---


@CARRIED
@pytest.mark.parametrize("total", [1e-6, 1e6])
@pytest.mark.parametrize("n", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
def test_units_of_the_inputs_change_nothing(n, total):
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (9, 8))
    one, other = (
        hjb.solve(random_problem(0, n, total=size)[0], grid, scheme=hjb.Upwind(), tol=1e-8) for size in (1.0, total)
    )
    np.testing.assert_allclose(other.value, one.value, atol=1e-7)
    np.testing.assert_allclose(np.asarray(other.policy) / total, one.policy, atol=1e-7)


def line_problem(total, n=2, gain=0.6):
    spread = np.linspace(-1.0, 1.0, n)
    return hjb.Problem(
        Partial(lambda g, x, u: g * jnp.array([spread @ u]) - 0.5 * x, gain), lambda x, u: x @ x + 0.1 * u @ u,
        hjb.Simplex(n, total), discount=1.0,
    )  # fmt: skip


@pytest.mark.slow
@CARRIED
@pytest.mark.parametrize("n", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_derivatives_in_the_total(n):
    grid = hjb.Grid([-1.0], [1.0], (21,))

    @jax.jit
    def value(total):
        return hjb.solve(line_problem(total, n), grid, scheme=hjb.Upwind(), tol=1e-12).value_at(jnp.array([0.3]))

    with jax.enable_x64(True):
        h = 1e-4
        wanted = (value(1.5 + h) - value(1.5 - h)) / (2 * h)
        assert abs(float(wanted)) > 0.01
        assert float(jax.grad(value)(1.5)) == pytest.approx(float(wanted), abs=1e-7)
        assert float(jax.jvp(value, (1.5,), (1.0,))[1]) == pytest.approx(float(wanted), abs=1e-7)


@CARRIED
@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 3])
def test_derivatives_of_searched_actions(n):
    """The drift is quadratic in u, so the minimum is searched; shares of the total trade places at the optimum."""
    grid = hjb.Grid([-1.0], [1.0], (21,))

    @jax.jit
    def answer(total, k):
        # with n = 3 the drift does not vanish, since a search is not precise enough for differences along a kink
        drift = Partial(lambda k, x, u: jnp.array([u[0] - 0.5 * x[0] + n - 2 + k * jnp.sum(u**2)]), k)
        problem = hjb.Problem(drift, lambda x, u: x @ x + u @ u + u[-1], hjb.Simplex(n, total), discount=1.0)
        solution = hjb.solve(problem, grid, scheme=hjb.Upwind(), tol=1e-12)
        return solution.value[3:18:7], solution.policy[3:18:7]

    with jax.enable_x64(True):
        point, h = (1.0, 0.15), 1e-3  # V has a kink in its slope here: differences are off by 0.06 h
        moves = jax.jacfwd(answer, (0, 1))(*point)
        for place in range(2):
            ahead, behind = (answer(*(p + s * h * (i == place) for i, p in enumerate(point))) for s in (1, -1))
            for (name, atol), move, plus, minus in zip(
                (("value", 1e-4), ("policy", 1e-3)), [each[place] for each in moves], ahead, behind, strict=True
            ):
                np.testing.assert_allclose(move, (plus - minus) / (2 * h), atol=atol, err_msg=name)


@pytest.mark.slow
@CARRIED
def test_lanes_of_a_batch():
    grid, totals = hjb.Grid([-1.0], [1.0], (21,)), [0.5, 1.0, 2.0]
    lanes = hjb.solve_batch([line_problem(total) for total in totals], grid, scheme=hjb.Upwind(), tol=1e-8)
    single = [hjb.solve(line_problem(total), grid, scheme=hjb.Upwind(), tol=1e-8) for total in totals]
    for lane, alone in zip(lanes, single, strict=True):
        np.testing.assert_allclose(lane.value, alone.value, atol=1e-7)
        assert lane.bounds is not None


# --- front doors ---


def test_a_checkpoint_tells_sets_apart():
    def problem_of(controls):
        return hjb.Problem(lambda x, u: u[:1], lambda x, u: x @ x, controls, discount=1.0)

    sets = [hjb.Simplex(2), hjb.Simplex(2, at_most=True), hjb.Simplex(2, 2.0), hjb.Ball(1.0, 2), hjb.Simplex(3)]
    digests = [digest(problem_of(controls), 1) for controls in sets]
    assert len(set(digests)) == len(sets)
    assert digest(problem_of(hjb.Simplex(2)), 1) == digests[0]


def test_pontryagin_refuses_a_simplex():
    with pytest.raises(ValueError, match=r"pontryagin: got controls in a Simplex, wanted a Box, a Ball or a Finite"):
        hjb.pontryagin(line_problem(1.0), [0.5], horizon=1.0)


def test_arrays_of_a_chain_need_samples():
    grid = hjb.Grid([-1.0], [1.0], (5,))
    with pytest.raises(ValueError, match=r"got controls in a Simplex, wanted Finite: sample it, .* Simplex.grid"):
        hjb.chain.transition_arrays(line_problem(1.0), grid)


def test_paths_say_where_a_control_is_outside_of_a_simplex():
    def message(u):
        return hjb.simulate(line_problem(1.0), lambda x: jnp.array(u), [0.5], 0.1).message

    assert "outside the problem's admissible set" in message([0.7, 0.7])
    assert "outside the problem's admissible set" not in message([0.3, 0.7])


def test_the_command_describes_a_simplex():
    assert in_words(hjb.Simplex(2), ("a", "b"), ()) == "(a, b) ≥ 0 of sum 1"
    assert in_words(hjb.Simplex(2, 3.0, at_most=True), ("a", "b"), ()) == "(a, b) ≥ 0 of sum at most 3"


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [hjb.Upwind(), hjb.SemiLagrangian()])
def test_times_to_a_target(scheme):
    """Minimum time of ẋ = −(3u₁, u₂): both queues are empty after x₁/3 + x₂, since the effort is shared."""
    problem = hjb.Problem(
        lambda x, u: -jnp.array([3.0, 1.0]) * u, lambda x, u: 1.0, hjb.Simplex(2), target=lambda x: jnp.sum(x) - 0.05
    )
    solution = hjb.solve(problem, hjb.Grid([0.0, 0.0], [1.0, 1.0], (21, 21)), scheme=scheme)
    # the state leaves first the quickest way, and the target is a triangle around the origin
    for x in itertools.product((0.5, 1.0), repeat=2):
        assert float(solution.value_at(list(x))) == pytest.approx(x[0] / 3 + x[1] - 0.05, abs=0.03)


@pytest.mark.slow
def test_constrained_ends_leave_admissible_effort():
    """Two queues with arrivals 0.5 and 0.2 that may not overflow: the effort has to serve both where both are full."""
    problem = hjb.Problem(
        lambda x, u: jnp.array([0.5, 0.2]) - u, lambda x, u: x @ x, hjb.Simplex(2, at_most=True),
        discount=0.5,
    )  # fmt: skip
    grid = hjb.Grid([0.0, 0.0], [1.0, 1.0], (11, 11), edges="constrained")
    solution = hjb.solve(problem, grid, scheme=hjb.Upwind())
    policy = np.asarray(solution.policy)
    assert np.all(policy[-1, :, 0] >= 0.5 - 1e-9)
    assert np.all(policy[:, -1, 1] >= 0.2 - 1e-9)
    assert np.all(policy[0, :, 0] <= 0.5 + 1e-9)
    assert np.all(np.sum(policy, -1) <= 1 + 1e-12)
    assert solution.bounds is not None
