"""Every method against every other, against sparse direct solves, and against solvers written by others."""

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.markov_chain import chain

TOL = 1e-5
METHODS = [
    hjb.ValueIteration(),
    hjb.PolicyIteration(hjb.Sweeps(2)),
    hjb.PolicyIteration(hjb.Krylov()),
    hjb.PolicyIteration(hjb.Direct()),
]


def swing(x, u):
    return jnp.stack([x[1], jnp.sin(x[0]) - 0.3 * x[1] + u[0]])


def effort(x, u):
    return x @ x + 0.5 * u @ u


def unit_drift(x, u):
    return u


def energies(x, u, d):
    return x @ x + u @ u - 4.0 * d @ d


def pushed(x, u, d):
    return jnp.stack([x[1], -x[0] + u[0] + d[0]])


def pursuit(x, u, d):
    """The evader's position relative to a faster pursuer, who is the control and wants to capture."""
    return 1.5 * u + d


def unit_cost(x, u, d):
    return 1.0


def near(x):
    return jnp.max(jnp.abs(x)) - 0.25


def square(x, u):
    return x @ x


def way_out(x):
    return 0.3 + 0.2 * x[0]


FOUR = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
PLANE = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (15, 17))
QUESTIONS = {
    "one player": (hjb.Problem(swing, effort, hjb.Box([-1.0], [1.0]), discount=0.5), PLANE),
    "with noise": (hjb.Problem(swing, effort, hjb.Box([-1.0], [1.0]), noise=[0.3, 0.6], discount=0.5), PLANE),
    "stopping": (
        hjb.Problem(unit_drift, square, hjb.Finite(FOUR), noise=0.2, discount=0.5, stopping_cost=way_out),
        PLANE,
    ),
    "minimum time": zoo.eikonal(discount=0.0, shape=(15, 17)),
    "game on a line": zoo.lq_game(shape=(31,), discount=0.4),
    "game in the plane": (
        hjb.Problem(
            pushed, energies, hjb.Box([-1.0], [1.0]), disturbances=hjb.Box([-0.5], [0.5]), noise=0.2, discount=0.5
        ),
        PLANE,
    ),
    "pursuit": (
        hjb.Problem(pursuit, unit_cost, hjb.Finite(FOUR), disturbances=hjb.Finite(FOUR), discount=1.0, target=near),
        PLANE,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.emitters if name == "pursuit" else ()) for name in QUESTIONS],
)
@pytest.mark.filterwarnings("ignore:the Isaacs condition fails")
def test_all_methods_agree_and_their_bounds_hold_the_discrete_solution(name):
    problem, grid = QUESTIONS[name]
    scheme = hjb.Upwind(split=problem.is_game)  # players that are upwinded by themselves have exact optima
    truth = hjb.solve(problem, grid, method=METHODS[-1], tol=1e-10, scheme=scheme).value
    values = []
    for method in METHODS:
        solution = hjb.solve(problem, grid, method=method, tol=TOL, scheme=scheme)
        lower, upper = solution.bounds
        slack = 1e-10 * (1 + np.max(np.abs(truth)))  # the truth has an error of its own
        assert np.all(lower - slack <= truth), method
        assert np.all(truth <= upper + slack), method
        assert solution.error <= TOL, method
        values.append(solution.value)
    for value in values:
        assert np.max(np.abs(value - values[0])) <= 2 * TOL


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("one player", marks=pytest.mark.slow),
        "with noise",
        pytest.param("minimum time", marks=pytest.mark.slow),
    ],
)
def test_the_direct_solution_solves_the_linear_system_of_its_policy(name):
    """(I − P) V = Δt (L − β V) off the target, with the exported transition matrix and SciPy's solver."""
    from scipy.sparse import diags_array, eye_array
    from scipy.sparse.linalg import spsolve

    problem, grid = QUESTIONS[name]
    solution = hjb.solve(problem, grid, method=METHODS[-1], tol=1e-10, scheme=hjb.Upwind())
    generator = chain.generator(problem, grid, np.nan_to_num(solution.policy))
    states = grid.nodes().reshape(-1, grid.ndim)
    actions = np.nan_to_num(solution.policy).reshape(len(states), -1)
    costs = np.array([float(problem.cost(x, u)) for x, u in zip(states, actions, strict=True)])
    free = np.ones(len(states), bool)
    if problem.target is not None:
        free = np.array([float(problem.target(jnp.asarray(x))) > 0 for x in states])
    held = np.where(free, 0.0, solution.value.reshape(-1))
    matrix = diags_array(free.astype(float)) @ (problem.discount * eye_array(len(states)) - generator)
    matrix = matrix + diags_array((~free).astype(float))
    value = spsolve(matrix.tocsc(), np.where(free, costs, held))
    np.testing.assert_allclose(solution.value.reshape(-1), value, rtol=0, atol=1e-8 * (1 + np.max(np.abs(value))))


@pytest.mark.parametrize("noise", [pytest.param(None, marks=pytest.mark.slow), 0.4])
def test_quantecon_agrees_on_the_exported_chain(noise):
    from quantecon.markov import DiscreteDP

    torques = hjb.Box([-2.0], [2.0]).grid(9)
    problem = hjb.Problem(swing, effort, torques, noise=noise, discount=0.3)
    grid = hjb.Grid([-np.pi, -3.0], [np.pi, 3.0], (16, 15), periodic=(True, False))
    costs, probabilities, states, actions, factor = chain.transition_arrays(problem, grid)
    process = DiscreteDP(-costs, probabilities, factor, states, actions)
    result = process.solve(method="policy_iteration", max_iter=200)
    solution = hjb.solve(problem, grid, tol=1e-9, scheme=hjb.Upwind())
    np.testing.assert_allclose(solution.value.reshape(-1), -result.v, rtol=0, atol=1e-8)


def two_masses(x, u):
    return jnp.stack([x[1], u[0], x[3], u[1]])


def one_mass(x, u):
    return jnp.stack([x[1], u[0]])


@pytest.mark.slow
def test_quantecon_agrees_on_an_economy_with_modes_and_jumps():
    """Saving with two incomes, and wealth that may lose half of its value."""
    from quantecon.markov import DiscreteDP

    saving = hjb.Problem(
        lambda a, c, mode: (0.1, 0.2)[mode] + 0.03 * a - c, reward=lambda a, c, mode: -1 / c[0], discount=0.05,
        controls=hjb.Finite(np.linspace(0.02, 0.4, 30)[:, None]),
        modes=hjb.Modes(("poor", "rich"), rates=[[0, 1.2], [1.2, 0]]),
        jumps=[hjb.Jump(0.2, lambda a, c, mode: a / 2, cost=lambda a, c, mode: 0.1 * c[0])],
    )  # fmt: skip
    grid = hjb.Grid([-0.1], [2.0], (64,), edges="constrained")
    solution = hjb.solve(saving, grid, scheme=hjb.Upwind(), tol=1e-9)
    rewards, probabilities, states, actions, factor = chain.transition_arrays(saving, grid)
    found = DiscreteDP(rewards, probabilities, factor, states, actions).solve("policy_iteration", max_iter=1000)
    np.testing.assert_allclose(solution.value.ravel(), found.v, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_two_decoupled_masses_in_four_dimensions():
    box, short = hjb.Box([-1.0, -1.0], [1.0, 1.0]), hjb.Box([-1.0], [1.0])
    shape = (9, 8)
    alone = hjb.solve(
        hjb.Problem(one_mass, effort, short, discount=0.5),
        hjb.Grid([-1.0, -1.5], [1.0, 1.0], shape),
        tol=1e-7,
        scheme=hjb.Upwind(),
    )
    grid = hjb.Grid([-1.0, -1.5] * 2, [1.0, 1.0] * 2, shape * 2)
    together = hjb.solve(hjb.Problem(two_masses, effort, box, discount=0.5), grid, tol=1e-7, scheme=hjb.Upwind())
    wanted = alone.value[:, :, None, None] + alone.value[None, None]
    np.testing.assert_allclose(together.value, wanted, rtol=0, atol=4e-7)


@pytest.mark.slow
@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_noise_in_any_dimension_is_the_sum_of_its_axes(dim):
    def solved(n):
        problem = hjb.Problem(unit_drift, effort, hjb.Box([-1.0] * n, [1.0] * n), noise=0.5, discount=1.0)
        return hjb.solve(problem, hjb.Grid([-1.0] * n, [1.2] * n, (9,) * n), tol=1e-7, scheme=hjb.Upwind()).value

    line = solved(1)
    wanted = sum(np.expand_dims(line, tuple(k for k in range(dim) if k != axis)) for axis in range(dim))
    np.testing.assert_allclose(solved(dim), np.broadcast_to(wanted, (9,) * dim), rtol=0, atol=1e-6)


# --- games ---


def quarrel(x, u, d):
    return (u - d) ** 2


def position(x, u, d):
    return x[0]


@pytest.mark.slow
@pytest.mark.parametrize("method", [hjb.ValueIteration(), hjb.PolicyIteration(hjb.Direct())])
def test_upper_and_lower_values_of_a_game_without_value(method):
    grid, solutions = hjb.Grid([-1.0], [1.0], (21,)), {}
    for isaacs in ("upper", "lower"):
        box = hjb.Box([-1.0], [1.0])
        problem = hjb.Problem(quarrel, position, box, disturbances=box, discount=1.0, isaacs=isaacs)
        with pytest.warns(hjb.SolveWarning, match=rf"(?s)Isaacs.*{isaacs}"):
            solutions[isaacs] = hjb.solve(problem, grid, method=method, tol=1e-5, scheme=hjb.Upwind())
        # V is increasing, so min max (u − d)² V' = V' (u = 0) and max min = 0 (u = d)
        assert solutions[isaacs].isaacs_gap == pytest.approx(1.0, rel=0.2)
    upper, lower = solutions["upper"].value, solutions["lower"].value
    assert np.all(upper >= lower - 2e-5)
    np.testing.assert_allclose(lower, grid.nodes()[:, 0], atol=2e-5)  # nobody moves: x/β
    # moving right at unit speed: V = (L + V⁺/h)/(β + 1/h), and at rest at the right end
    wanted, h = [1.0], grid.spacing(0)
    for x in grid.nodes()[-2::-1, 0]:
        wanted.append((x + wanted[-1] / h) / (1 + 1 / h))
    np.testing.assert_allclose(upper, wanted[::-1], atol=2e-5)


def apart(x, u, d):
    return jnp.stack([u[0], d[0]])


def tug(x, u, d):
    return x[0] ** 2 - x[1] ** 2 + 0.1 * u[0] ** 2 - 0.1 * d[0] ** 2


@pytest.mark.slow
def test_a_decoupled_game_has_no_gap():
    box, values = hjb.Box([-1.0], [1.0]), []
    for isaacs in ("upper", "lower"):
        problem = hjb.Problem(apart, tug, box, disturbances=box, discount=1.0, isaacs=isaacs)
        solution = hjb.solve(problem, hjb.Grid([-1.0] * 2, [1.0] * 2, (11, 11)), tol=1e-6, scheme=hjb.Upwind())
        assert abs(solution.isaacs_gap) <= 1e-9
        values.append(solution.value)
    np.testing.assert_allclose(values[0], values[1], atol=2e-6)
    np.testing.assert_allclose(values[0], -values[0].T, atol=2e-6)  # the players' roles are mirror images
    assert solution.disturbance.shape == (11, 11, 1)


# --- constraints and tubes ---


def test_precedence_of_target_running_maximum_and_stopping_cost():
    """Where g > ψ, g wins: a goal inside an obstacle is no success; a target beats both."""

    def goal(x):
        return jnp.abs(x[0] - 0.5) - 0.2

    def obstacle(x):
        return 0.3 - jnp.abs(x[0] - 0.5)

    def bay(x):
        return x[0] + 0.9

    options = {"controls": hjb.Box([-1.0], [1.0]), "stopping_cost": goal, "running_max": obstacle}
    grid = hjb.Grid([-1.0], [1.0], (21,))
    value = hjb.solve(hjb.Problem(unit_drift, **options), grid, tol=1e-6, scheme=hjb.Upwind()).value
    x = grid.nodes()[:, 0]
    g, psi = 0.3 - np.abs(x - 0.5), np.abs(x - 0.5) - 0.2
    assert np.any(g > psi)
    np.testing.assert_allclose(value[g > psi], g[g > psi], atol=1e-12)
    assert np.all(value >= g - 1e-12)
    assert np.all(value[g <= psi] <= psi[g <= psi] + 1e-12)
    held = hjb.solve(
        hjb.Problem(unit_drift, **options, target=bay, exit_cost=-7.0), grid, tol=1e-6, scheme=hjb.Upwind()
    )
    np.testing.assert_array_equal(held.value[x + 0.9 <= 0], -7.0)
    assert np.all(np.isnan(held.policy[x + 0.9 <= 0]))


# --- states that never arrive ---


def drifting_right(x, u):
    return 1.0 + 0.5 * u


def pay_time(x, u):
    return 1.0


def in_the_middle(x):
    return jnp.abs(x[0]) - 0.05


@pytest.mark.slow
def test_states_that_cannot_reach_the_target():
    problem = hjb.Problem(drifting_right, pay_time, hjb.Box([-1.0], [1.0]), target=in_the_middle)
    grid = hjb.Grid([-1.0], [1.0], (21,))
    with pytest.warns(hjb.SolveWarning, match=r"47\.6 % of the nodes cannot reach the target.*inf"):
        solution = hjb.solve(problem, grid, tol=1e-8, scheme=hjb.Upwind())
    x = grid.nodes()[:, 0]
    lost = x > 0.01
    np.testing.assert_array_equal(solution.reached, ~lost)
    np.testing.assert_array_equal(solution.value[lost], np.inf)
    np.testing.assert_array_equal(np.stack(solution.bounds)[:, lost], np.inf)
    assert np.all(np.isnan(solution.policy[lost]))
    np.testing.assert_allclose(solution.value[~lost], -x[~lost] / 1.5, atol=1e-8)
    assert np.isfinite(solution.error)


@pytest.mark.slow
def test_discounted_states_that_never_arrive_keep_their_value():
    problem = hjb.Problem(drifting_right, pay_time, hjb.Box([-1.0], [1.0]), target=in_the_middle, discount=0.5)
    grid = hjb.Grid([-1.0], [1.0], (21,))
    with pytest.warns(hjb.SolveWarning, match=r"47\.6 % .*discounted cost of never arriving"):
        solution = hjb.solve(problem, grid, tol=1e-8, scheme=hjb.Upwind())
    np.testing.assert_allclose(solution.value[grid.nodes()[:, 0] > 0.01], 2.0, atol=1e-8)
    assert np.all(np.isfinite(solution.policy[grid.nodes()[:, 0] > 0.01]))


def swept(x, u):
    return u + jnp.stack([1.5 + 0 * x[0], 0 * x[0]])


def disc(x):
    return jnp.sqrt(x @ x) - 0.4


def cost_of_time(x, u):
    return 1.0


@pytest.mark.slow
def test_a_current_stronger_than_the_boat():
    problem = hjb.Problem(swept, cost_of_time, hjb.Ball(1.0, 2), target=disc)
    grid = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (21, 21))
    with pytest.warns(hjb.SolveWarning, match="cannot reach the target"):
        solution = hjb.solve(problem, grid, tol=1e-5, scheme=hjb.Upwind())
    x, y = np.moveaxis(grid.nodes(), -1, 0)
    assert not np.any(solution.reached[x > 0.5])  # downstream of the target nobody comes back
    assert np.all(solution.reached[(x < -1) & (np.abs(y) < 0.3)])
    np.testing.assert_array_equal(np.isinf(solution.value), ~solution.reached)
    assert np.max(solution.value[solution.reached]) < 1e3
