"""The ends of the box: projected, constrained and open, against an oracle in plain NumPy and against closed forms."""

import dataclasses
import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from jax.tree_util import Partial
from plain_chain import hamiltonians, solved, tables

import hjbjax as hjb
from hjbjax.discretisation import edges as ends_of_the_box
from hjbjax.discretisation import stencil
from hjbjax.discretisation.edges import cut
from hjbjax.discretisation.stencil import continued, inward, sparse
from hjbjax.markov_chain import chain

PLAIN = hjb.Upwind(central=False)
SEEDS = st.integers(0, 2**32 - 1)

# --- the argument ---


def test_edges_come_as_a_name_or_one_entry_an_axis():
    def ends(edges, periodic=(False, False)):
        return hjb.Grid([0.0, 0.0], [1.0, 1.0], (5, 5), periodic, edges=edges).edges

    assert ends("constrained") == (("constrained", "constrained"),) * 2
    assert ends(["open", ("projected", "constrained")]) == (("open", "open"), ("projected", "constrained"))
    assert ends("open", (True, False)) == (None, ("open", "open"))
    assert ends((None, "open"), (True, False)) == (None, ("open", "open"))
    grid = hjb.Grid([0.0, 0.0], [1.0, 1.0], (5, 5), edges=("open", ("projected", "constrained")))
    assert grid.sides("open") == [(0, -1), (0, 1)]
    assert grid.sides("constrained") == [(1, 1)]
    assert dataclasses.replace(grid, shape=(9, 9)).edges == grid.edges
    assert stencil.walled(grid).edges == (("projected", "projected"), ("projected", "constrained"))


@pytest.mark.parametrize(
    ("edges", "words"),
    [
        ("constrainde", "did you mean 'constrained'.*"),
        ("free", "wanted one of 'projected', 'constrained', 'open'"),
        (("open", "free"), "got 'free' for axis 1"),
        (("open",), "got .* for 2 axes; wanted a name for all, or one entry per axis"),
        (("open", ("open",) * 3), r"axis 1 has .* wanted a name or a pair \(lower end, upper end\)"),
        (3, "wanted a name for all"),
        ((("open", 3), "open"), "got 3 for axis 0"),
    ],
)
def test_what_is_no_kind_of_end_is_refused(edges, words):
    with pytest.raises(ValueError, match=words):
        hjb.Grid([0.0, 0.0], [1.0, 1.0], (5, 5), edges=edges)


def test_where_no_such_end_can_be():
    with pytest.raises(ValueError, match=r"(?s)axis 0 is periodic and has no ends; got 'open'"):
        hjb.Grid([0.0, 0.0], [1.0, 1.0], (5, 5), (True, False), edges=("open", "open"))
    with pytest.raises(ValueError, match="axis 0 has 2 points; an open end extends V from the last three"):
        hjb.Grid([0.0], [1.0], (2,), edges="open")


def test_edges_are_part_of_a_grids_structure():
    kinds = [hjb.Grid([0.0], [1.0], (5,), edges=edges) for edges in ("projected", "open", "open", None)]
    first, second, third, fourth = (jax.tree.structure(grid) for grid in kinds)
    assert first == fourth != second == third
    seen = []

    @jax.jit
    def count(grid):
        seen.append(grid.edges)
        return grid.lo

    for grid in kinds:
        count(grid)
    assert len(seen) == 2


# --- differences and matrices ---


@pytest.mark.parametrize("stretch", [None, (hjb.Sinh(2.0), None)])
def test_beyond_open_ends_stands_the_parabola(stretch):
    """Exact for x², and the matrix of the jumps is the same operator."""
    grid = hjb.Grid([-1.0, 0.0], [1.0, 2.0], (6, 5), stretch=stretch, edges=("open", ("projected", "open")))
    with jax.enable_x64(True):
        x = grid.nodes()[..., 0]
        first, last = x[0, 0] - (x[1, 0] - x[0, 0]), 2 * x[-1, 0] - x[-2, 0]
        square = jnp.asarray(1 + x - 3 * x**2)
        for step, beyond in ((1, last), (-1, first)):
            moved = np.asarray(continued(square, grid, (step, 0)))
            assert moved[-1 if step > 0 else 0, 0] == pytest.approx(1 + beyond - 3 * beyond**2, abs=1e-12)
        value = np.random.default_rng(0).normal(size=grid.shape)
        for offset in ((1, 0), (-1, 0), (0, 1), (1, 1), (-1, 1)):
            weight = np.random.default_rng(1).normal(size=grid.shape)
            moved = weight * np.asarray(continued(jnp.asarray(value), grid, offset))
            entries = sparse(*inward([offset], [jnp.asarray(weight)], grid), np.zeros(grid.shape), grid)
            np.testing.assert_allclose((entries @ value.ravel()).reshape(grid.shape), moved, atol=1e-12)


# --- constrained ends against the oracle ---


def affine(matrix, gain, shift, x, u):
    return matrix @ x + (gain @ u if gain.ndim == 2 else gain * u) + shift


def quadratic(weights, x, u):
    return weights[0] * jnp.sum(jnp.cos(x)) + weights[1] * jnp.sum(x) + weights[2] * u @ u + weights[3] * jnp.sum(u)


def quartic(weights, x, u):
    return quadratic(weights, x, u) + jnp.sum(u**4)


def nodes_of(grid):
    return [np.asarray(grid.axis(axis)) for axis in range(grid.ndim)]


def random_question(seed, n, cost, controls, *, diagonal=False, sigma=0.0):
    """An affine drift that the controls can turn round at every end, and a cost with terms of all kinds.

    ``diagonal``: each input drives a component of its own, as the functions themselves show.
    """
    rng = np.random.default_rng(seed)
    gain = rng.uniform(1.5, 2.5, n) * rng.choice([-1, 1], n)
    if not diagonal:
        gain = np.diag(gain) + rng.uniform(-0.3, 0.3, (n, n)) * (1 - np.eye(n))
    leaves = rng.uniform(-0.2, 0.2, (n, n)), gain, rng.uniform(-0.3, 0.3, n)
    weights = np.array([*rng.normal(size=2), rng.uniform(0.1, 1), 3 * rng.normal()])
    noise = np.full(n, sigma)
    return hjb.Problem(Partial(affine, *leaves), Partial(cost, weights), controls, noise=noise, discount=0.5)


def oracle(problem, grid, actions):
    drift, cost = problem.drift, problem.cost
    f = functools.partial(_plain_affine, *map(np.asarray, drift.args))
    weights = np.asarray(cost.args[0])
    L = functools.partial(_plain_quadratic, weights, cost.func is quartic)
    sigma = np.broadcast_to(0.0 if problem.noise is None else problem.noise, grid.ndim)
    return tables(nodes_of(grid), f, L, actions, sigma, grid.sides("constrained"))


def _plain_affine(matrix, gain, shift, x, u):
    return matrix @ x + (gain @ u if gain.ndim == 2 else gain * u) + shift


def _plain_quadratic(weights, fourth, x, u):
    total = weights[0] * np.cos(x).sum() + weights[1] * x.sum() + weights[2] * (u**2).sum() + weights[3] * u.sum()
    return total + (u**4).sum() * fourth


def sampled(box, count, problem, ball=False):
    """Samples of a box or a ball, with all points on which a component of the drift vanishes: the walls of the set."""
    matrix, gain, shift = map(np.asarray, problem.drift.args)
    gain = gain if gain.ndim == 2 else np.diag(gain)
    lines = [np.linspace(low, high, count) for low, high in zip(*box, strict=True)]
    base = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, len(lines))
    radius = np.max(box)
    if ball:
        angles = np.linspace(0, 2 * np.pi, 361)
        base = np.concatenate(
            [r * np.stack([np.cos(angles), np.sin(angles)], -1) for r in radius * np.linspace(0, 1, 6)]
        )

    def at(x):
        u = [base]
        for i in range(len(x)):  # moved along each input onto f_i = 0
            for j in range(len(lines)):
                if gain[i, j] == 0:
                    continue
                moved = base.copy()
                moved[:, j] -= (base @ gain[i] + matrix[i] @ x + shift[i]) / gain[i, j]
                u.append(moved)
                if ball:  # on the circle as well
                    rest = np.sqrt(np.maximum(radius**2 - moved[:, j] ** 2, 0))
                    u += [np.where(np.arange(2) == j, moved, sign * rest[:, None]) for sign in (1, -1)]
        if len(x) == 2:
            u.append(np.repeat(np.linalg.solve(gain, -matrix @ x - shift)[None], len(base), 0))
        u = np.concatenate(u)
        outside = np.any((u < box[0]) | (u > box[1]), axis=1)
        outside |= ball & (np.sum(u**2, axis=1) > radius**2 * (1 + 1e-12))
        u[outside] = u[0]
        return u

    return at


LINE = hjb.Grid([-1.0], [1.2], (21,), edges="constrained")
GATHERED = hjb.Grid([-1.0], [1.2], (21,), stretch=(hjb.Sinh(1.5),), edges="constrained")
SQUARE = hjb.Grid([-1.0, -0.5], [1.2, 1.0], (7, 6), edges="constrained")


def assert_at_most_so_much_below(value, known, spacing_error):
    """A continuum is never worse than its samples, and hardly better."""
    assert np.all(value.ravel() <= known + 1e-8)
    assert np.all(value.ravel() >= known - spacing_error)


@pytest.mark.parametrize("grid", [pytest.param(LINE, marks=pytest.mark.slow), GATHERED], ids=["uniform", "stretched"])
@pytest.mark.parametrize("sigma", [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
@pytest.mark.filterwarnings("error", "ignore:the box decides V")
def test_one_input_against_the_oracle(grid, sigma):
    for seed in range(3):
        problem = random_question(seed, 1, quadratic, hjb.Box([-1.0], [1.5]), sigma=sigma)
        solution = hjb.solve(problem, grid, scheme=PLAIN, tol=1e-10)
        value, _ = solved(*oracle(problem, grid, sampled(([-1.0], [1.5]), 401, problem)), 0.5)
        assert_at_most_so_much_below(solution.value, value, 1e-4)
        drift = np.array(
            [_plain_affine(*problem.drift.args, x, u) for x, u in zip(grid.nodes(), solution.policy, strict=True)]
        )
        assert drift[0] >= -1e-10
        assert drift[-1] <= 1e-10
        assert not np.any(solution.cut)


@pytest.mark.slow
def test_a_sampled_player_against_the_oracle():
    """A cost of degree four is sampled and refined; the wall of the admissible set is found exactly all the same."""
    problem = random_question(1, 1, quartic, hjb.Box([-1.0], [1.5]))
    solution = hjb.solve(problem, LINE, scheme=PLAIN, tol=1e-10)
    value, _ = solved(*oracle(problem, LINE, sampled(([-1.0], [1.5]), 801, problem)), 0.5)
    assert_at_most_so_much_below(solution.value, value, 1e-4)
    assert "searched" in solution.stats["certificate"]


@pytest.mark.slow
@pytest.mark.emitters
@pytest.mark.parametrize("kind", ["pair", "apart", "ball"])
def test_two_inputs_against_the_oracle(kind):
    for seed in range(2):
        controls = hjb.Ball(1.5, 2) if kind == "ball" else hjb.Box([-1.5, -1.5], [1.5, 1.5])
        problem = random_question(seed, 2, quadratic, controls, diagonal=kind != "pair")
        solution = hjb.solve(problem, SQUARE, scheme=PLAIN, tol=1e-9)
        box = np.array([[-1.5] * 2, [1.5] * 2])
        value, _ = solved(*oracle(problem, SQUARE, sampled(box, 41, problem, ball=kind == "ball")), 0.5)
        assert_at_most_so_much_below(solution.value, value, 5e-3)


FIVE = np.array([[-1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [0.1, 0.3]])


@pytest.mark.slow
@pytest.mark.parametrize("method", [None, hjb.ValueIteration(), hjb.PolicyIteration(hjb.Direct())])
def test_enumerated_controls_against_the_oracle(method):
    """The same set, so the same value; bounds hold it, also at a coarse tolerance."""
    for seed in range(3):
        problem = random_question(seed, 2, quadratic, hjb.Finite(FIVE), sigma=0.2)
        value, policy = solved(*oracle(problem, SQUARE, lambda x: FIVE), 0.5)
        for tol in (1e-2, 1e-9):
            solution = hjb.solve(problem, SQUARE, method=method, scheme=PLAIN, tol=tol)
            lower, upper = solution.bounds
            assert solution.error <= tol
            assert np.all(lower.ravel() <= value + 1e-11)
            assert np.all(upper.ravel() >= value - 1e-11)
        np.testing.assert_array_equal(solution.policy.reshape(-1, 2), FIVE[policy])


@pytest.mark.slow
def test_batches_jit_and_vmap_agree():
    problems = [random_question(seed, 1, quadratic, hjb.Box([-1.0], [1.5])) for seed in (4, 5)]
    wanted = [hjb.solve(problem, LINE, scheme=PLAIN, tol=1e-9).value for problem in problems]
    batch = hjb.solve_batch(problems, LINE, scheme=PLAIN, tol=1e-9)
    for solution, value in zip(batch, wanted, strict=True):
        np.testing.assert_allclose(solution.value, value, atol=2e-9)
    with jax.enable_x64(True):
        stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *problems)
        together = jax.jit(jax.vmap(lambda problem: hjb.solve(problem, LINE, scheme=PLAIN, tol=1e-9).value))(stacked)
        np.testing.assert_allclose(together, wanted, atol=2e-9)


def pushed(x, u):
    return 0.3 * x + 2.0 * u + 0.1


def slope_and_effort(x, u):
    return 3.0 * x[0] + 0.4 * u @ u + u[0]


@pytest.mark.slow
def test_float32_leaves_by_a_rounding_of_float32_at_most():
    problem = hjb.Problem(pushed, slope_and_effort, hjb.Box([-1.0], [1.5]), discount=0.5)
    single = hjb.solve(problem, LINE, tol=1e-3, dtype="float32", scheme=hjb.Upwind())
    np.testing.assert_allclose(single.value, hjb.solve(problem, LINE, tol=1e-9, scheme=hjb.Upwind()).value, atol=2e-3)
    chain.generator(problem, LINE, single.policy)
    with pytest.raises(ValueError, match="leaves the box across a constrained end at 1 nodes"):
        chain.generator(problem, LINE, single.policy - 0.01)


@pytest.mark.slow
def test_the_derivative_at_a_wall_is_that_of_differences():
    """What the control must do at a constrained end moves with the drift."""

    def value(pull):
        problem = hjb.Problem(Partial(pulled, pull), effort, hjb.Box([-3.0], [3.0]), discount=0.5)
        return hjb.solve(problem, LINE, tol=1e-11, scheme=hjb.Upwind()).value[-1]

    with jax.enable_x64(True):
        slope = jax.grad(value)(1.0)
        differences = (value(1.0 + 1e-5) - value(1.0 - 1e-5)) / 2e-5
    assert float(slope) == pytest.approx(float(differences), rel=1e-5)
    assert abs(float(slope)) > 0.1


def pulled(pull, x, u):
    return pull + u


def effort(x, u):
    return -2.0 * x[0] + u @ u


# --- a closed form, units, mirrors ---

CAPITAL_SHARE, DECAY, IMPATIENCE = 0.36, 0.05, 0.04


def growth(x, u):
    return x**CAPITAL_SHARE - DECAY * x - u


def minus_utility(x, u):
    return -(u[0] ** (1 - CAPITAL_SHARE)) / (1 - CAPITAL_SHARE)


@pytest.mark.slow
@pytest.mark.parametrize("most", [pytest.param(2.0, marks=pytest.mark.slow), 20.0, 200.0])
def test_growth_with_constrained_ends(most):
    """With γ = a the optimal consumption is k(ρ + (1 − a)δ)/a; projected ends give any c up to its bound."""
    problem = hjb.Problem(growth, minus_utility, hjb.Box([1e-3], [most]), discount=IMPATIENCE)
    grid = hjb.Grid([1.5], [9.5], (201,), edges="constrained")
    solution = hjb.solve(problem, grid, tol=1e-6, scheme=hjb.Upwind())
    exact = grid.axis(0) * (IMPATIENCE + (1 - CAPITAL_SHARE) * DECAY) / CAPITAL_SHARE
    assert np.max(np.abs(solution.policy[:, 0] / exact - 1)) <= 5e-3
    assert solution.error is None  # the cost is not quadratic, so its minimum is searched and nothing is certified
    for feedback in (solution.control_at, hjb.greedy_feedback(problem, solution)):
        assert growth(1.5, feedback(np.array([1.5]))) >= -1e-12
        assert growth(9.5, feedback(np.array([9.5]))) <= 1e-12
    path = hjb.simulate(problem, solution, [2.0], 100.0)
    assert path.status.name == "DURATION"
    steady = (CAPITAL_SHARE / (IMPATIENCE + DECAY)) ** (1 / (1 - CAPITAL_SHARE))
    assert abs(path.states[-1, 0] - steady) < abs(2.0 - steady) / 20


def test_growth_with_projected_ends_warns_and_says_where():
    problem = hjb.Problem(growth, minus_utility, hjb.Box([1e-3], [2.0]), discount=IMPATIENCE)
    with pytest.warns(hjb.SolveWarning, match=r"(?s)lower end of x1 \(1 of 1 nodes\).*edges='constrained'"):
        solution = hjb.solve(problem, hjb.Grid([1.5], [9.5], (201,)), tol=1e-6, scheme=hjb.Upwind())
    assert solution.cut.tolist() == [[1, 0]]
    assert "V is constant" in solution.stats["box_error"]  # no other end changes it, though every path reaches the end
    assert "drift out of the box, nodes at the ends: x1 (1 lower" in str(solution)


R, MU, SIGMA, GAMMA, RHO = 0.02, 0.06, 0.25, 3.0, 0.06


def log_wealth(x, u):
    return jnp.stack([R + u[0] * (MU - R) - u[1] - 0.5 * u[0] ** 2 * SIGMA**2])


def risk(x, u):
    return jnp.stack([u[0] * SIGMA])


def minus_power_utility(x, u):
    return -((u[1] * jnp.exp(x[0])) ** (1 - GAMMA)) / (1 - GAMMA)


@pytest.mark.slow
@pytest.mark.parametrize(("most", "sign"), [([2.0, 0.5], 1), pytest.param([1.0, 0.3], -1, marks=pytest.mark.slow)])
def test_merton_with_open_ends(most, sign):
    """Share and rate at 0 without exact data at the ends; projected ones are 100 to 200 % off. Also mirrored."""
    problem = hjb.Problem(
        lambda x, u: sign * log_wealth(sign * x, u),
        lambda x, u: minus_power_utility(sign * x, u),
        hjb.Box([0.0, 1e-3], most),
        noise=risk,
        discount=RHO,
    )
    grid = hjb.Grid([-3.0], [3.0], (201,), edges="open")
    solution = hjb.solve(problem, grid, tol=1e-5, scheme=hjb.Upwind())  # V reaches 3e6, and a step rounds by 2e-6
    share = (MU - R) / (GAMMA * SIGMA**2)
    rate = (RHO - (1 - GAMMA) * (R + (MU - R) ** 2 / (2 * GAMMA * SIGMA**2))) / GAMMA
    assert (share, rate) == pytest.approx((0.21333, 0.036178), rel=1e-4)
    np.testing.assert_allclose(solution.policy[100], [share, rate], rtol=0.003)
    assert solution.error is None
    assert "no certificate bounds the error" in " ".join(str(solution).split())


def pushed_faster(rate, x, u):
    return rate * pushed(x, u)


def dearer(rate, x, u):
    return rate * slope_and_effort(x, u)


@pytest.mark.parametrize("edges", ["constrained", pytest.param("open", marks=pytest.mark.slow)])
def test_units_change_nothing_else(edges):
    """Time times 1e6 and cost times 1e9: V is scaled, and neither a status nor a policy knows."""
    grid = hjb.Grid([-1.0], [1.2], (21,), edges=edges)
    solutions = []
    for time, money in ((1.0, 1.0), (1e6, 1e9), (1e-6, 1e-9)):
        problem = hjb.Problem(
            Partial(pushed_faster, time),
            Partial(dearer, time * money),
            hjb.Box([-1.0], [1.5]),
            discount=0.5 * time,
        )
        solutions.append(hjb.solve(problem, grid, tol=1e-8 * money, scheme=hjb.Upwind()))
    for solution, money in zip(solutions[1:], (1e9, 1e-9), strict=True):
        np.testing.assert_allclose(solution.value / money, solutions[0].value, rtol=1e-7)
        np.testing.assert_allclose(solution.policy, solutions[0].policy, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["constrained", pytest.param("open", marks=pytest.mark.slow)])
def test_mirrored_problems_have_mirrored_answers(kind):
    values = []
    for sign, ends in ((1, (kind, "projected")), (-1, ("projected", kind))):
        problem = hjb.Problem(
            lambda x, u, sign=sign: sign * pushed(sign * x, u), lambda x, u, sign=sign: slope_and_effort(sign * x, u),
            hjb.Box([-1.0], [1.5]), discount=0.5, noise=0.1,
        )  # fmt: skip
        grid = hjb.Grid([-1.0], [1.0], (21,), edges=(ends,))
        values.append(hjb.solve(problem, grid, tol=1e-9, scheme=hjb.Upwind()).value[::sign])
    np.testing.assert_allclose(*values, atol=2e-9)


# --- games ---


def shoved(x, u, d):
    return u + d


def contested(x, u, d):
    return 3.0 * x[0] - 2.0 * u[0] * d[0] + u @ u - d @ d


@pytest.mark.slow
def test_a_game_is_kept_in_against_every_disturbance():
    """min_u max_d by enumeration: the control that lets the disturbance push out is not admissible."""
    us, ds = np.linspace(-1, 1, 9)[:, None], np.linspace(-0.5, 0.5, 3)[:, None]
    problem = hjb.Problem(shoved, contested, hjb.Finite(us), disturbances=hjb.Finite(ds), discount=0.5)
    solution = hjb.solve(problem, LINE, scheme=PLAIN, tol=1e-9)
    pairs = np.concatenate([np.repeat(us, len(ds), 0), np.tile(ds, (len(us), 1))], axis=1)
    rates, costs, there, allowed = tables(
        nodes_of(LINE), lambda x, p: p[:1] + p[1:],
        lambda x, p: 3 * x[0] - 2 * p[0] * p[1] + p[0] ** 2 - p[1] ** 2,
        lambda x: pairs, [0.0], LINE.sides("constrained"),
    )  # fmt: skip
    value = np.zeros(LINE.size)
    pace = 0.5 + rates.sum(axis=-1).max()
    for _ in range(6000):
        h = hamiltonians(rates, costs, there, allowed, value).reshape(LINE.size, len(us), len(ds))
        value = value + (h.max(axis=2).min(axis=1) - 0.5 * value) / pace
    np.testing.assert_allclose(solution.value, value, atol=1e-8)
    assert solution.policy[0, 0] >= 0.5
    assert solution.policy[-1, 0] <= -0.5


# --- what has no action, chains, marches ---


def mass(x, u):
    return jnp.stack([x[1], u[0]])


def test_a_node_without_an_admissible_action_is_refused_with_its_state():
    problem = hjb.Problem(mass, lambda x, u: x @ x + u @ u, hjb.Box([-1.0], [1.0]), discount=0.5)
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (5, 5), edges=("constrained", "projected"))
    words = r"(?s)no action is admissible at 4 of 25 nodes, first at node \(0, 0\), x = \[-1., -1.\].*lower end of x1"
    for ask in (
        lambda: hjb.solve(problem, grid, scheme=hjb.Upwind()),
        lambda: hjb.solve_batch([problem], grid, scheme=hjb.Upwind()),
        lambda: hjb.march(problem, grid, 1.0, scheme=hjb.Upwind(split=True)),
    ):
        with pytest.raises(ValueError, match=words) as caught:
            ask()
        assert len(str(caught.value).splitlines()) <= 6


def test_where_the_target_is_no_action_is_wanted():
    """A drift of one beyond the upper end: refused; not where that end is the target."""
    problem = hjb.Problem(lambda x, u: 1 + 0 * u, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]))
    grid = hjb.Grid([0.0], [1.0], (11,), edges="constrained")
    with pytest.raises(ValueError, match="no action is admissible at 1 of 11 nodes"):
        hjb.solve(problem, grid, scheme=hjb.Upwind())
    arriving = dataclasses.replace(problem, target=lambda x: 0.95 - x[0])
    np.testing.assert_allclose(
        hjb.solve(arriving, grid, tol=1e-9, scheme=hjb.Upwind()).value, 1 - grid.axis(0), atol=1e-8
    )


def between_walls(x, u):
    return jnp.stack([u[0] - 0.37, 0.37 - u[0]])


@pytest.mark.parametrize("power", [pytest.param(2, marks=pytest.mark.slow), 4])
def test_a_corner_may_leave_one_action_alone(power):
    """Of two ends each forbids one side of u = .37, and no sample is .37; a cost in u⁴ is sampled."""
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (5, 5), edges="constrained")
    problem = hjb.Problem(between_walls, lambda x, u: jnp.sum(x) + u[0] ** power, hjb.Box([-1.0], [1.0]), discount=1.0)
    solution = hjb.solve(problem, grid, tol=1e-9, scheme=hjb.Upwind())
    assert solution.policy[-1, -1, 0] == pytest.approx(0.37, abs=1e-12)
    assert solution.policy[0, 0, 0] == pytest.approx(0.37, abs=1e-12)
    assert solution.policy[0, 2, 0] >= 0.37


@pytest.mark.slow
def test_exports_hold_admissible_pairs_and_policies_alone():
    problem = random_question(2, 2, quadratic, hjb.Finite(FIVE), sigma=0.2)
    costs, probabilities, states, actions, factor = chain.transition_arrays(problem, SQUARE, scheme=PLAIN)
    *_, allowed = oracle(problem, SQUARE, lambda x: FIVE)
    np.testing.assert_array_equal(np.stack([states, actions]), np.argwhere(allowed).T)
    value = np.zeros(SQUARE.size)
    for _ in range(4000):
        worth = np.full(allowed.shape, np.inf)
        worth[states, actions] = costs + factor * (probabilities @ value)
        value = worth.min(axis=1)
    solution = hjb.solve(problem, SQUARE, scheme=PLAIN, tol=1e-9)
    np.testing.assert_allclose(solution.value.ravel(), value, atol=1e-6)
    rows = chain.generator(problem, SQUARE, solution.policy, scheme=PLAIN)
    assert (rows - np.diag(rows.diagonal())).min() >= 0
    outward = np.broadcast_to(FIVE[np.argmin(allowed.sum(axis=0))], (*SQUARE.shape, 2))
    with pytest.raises(ValueError, match="the policy leaves the box across a constrained end"):
        chain.matrix(problem, SQUARE, outward)


@pytest.mark.parametrize("ask", ["generator", "matrix", "stationary_density", "transition_arrays"])
def test_open_ends_have_no_chain(ask):
    problem = hjb.Problem(lambda x, u: -x, lambda x, u: x @ x, noise=0.5, discount=1.0)
    with pytest.raises(ValueError, match="open ends has no chain"):
        getattr(chain, ask)(problem, hjb.Grid([-1.0], [1.0], (9,), edges="open"))
    for probability in (hjb.reach_probability, hjb.expected_exit_time):
        with pytest.raises(ValueError, match="an open end extrapolates the value"):
            probability(problem, hjb.Grid([-1.0], [1.0], (9,), edges="open"), lambda x: x[0] - 0.5)


@pytest.mark.emitters
@pytest.mark.slow
def test_a_march_with_constrained_ends_against_the_oracle():
    problem = random_question(3, 2, quadratic, hjb.Finite(FIVE), sigma=0.2)
    problem = dataclasses.replace(problem, terminal_cost=lambda x: x[0] - x[1])
    solution = hjb.march(problem, SQUARE, 0.5, scheme=PLAIN, step=0.005, method=hjb.Explicit(1))
    arrays = oracle(problem, SQUARE, lambda x: FIVE)
    value = (SQUARE.nodes()[..., 0] - SQUARE.nodes()[..., 1]).ravel()
    length = -np.expm1(-0.5 * 0.005) / 0.5  # of a step in s, 1 − βs = e^{−βτ}, by which the discount is exact
    for _ in range(100):
        value = value + length * (hamiltonians(*arrays, value).min(axis=1) - 0.5 * value)
    np.testing.assert_allclose(solution.value[0].ravel(), value, atol=1e-12)
    implicit = hjb.march(problem, SQUARE, 0.5, scheme=PLAIN, step=0.005, method=hjb.Implicit(hjb.Direct()))
    assert 1e-6 < np.max(np.abs(implicit.value[0].ravel() - value)) < 0.02
    assert not solution.cut.any()


def wave(x):
    return jnp.sin(x[0] - 0.5)


def carried(x, u):
    return jnp.ones_like(x)


@pytest.mark.parametrize(
    ("scheme", "method", "most"),
    [
        pytest.param(hjb.Upwind(), hjb.Explicit(), 2e-2, marks=pytest.mark.slow),
        pytest.param(hjb.Upwind(), hjb.Implicit(), 2e-2, marks=pytest.mark.slow),
        (hjb.Limited(), hjb.Explicit(), 3e-4),
        pytest.param(hjb.Eno2(), hjb.Explicit(), 4e-4, marks=pytest.mark.slow),
        pytest.param(hjb.Weno5(), hjb.Explicit(), 6e-5, marks=pytest.mark.slow),
    ],
    ids=["upwind", "implicit", "limited", "eno2", "weno5"],
)
def test_a_wave_leaves_through_an_open_end(scheme, method, most):
    """A drift of one carries V(½, x) = sin(x − ½) out of the box; at t = 0 it is sin x.

    What comes from a way of ½ beyond the end is a parabola there: off by ½³/6 at most at the end.
    """
    grid = hjb.Grid([0.0], [3.0], (61,), edges="open")
    problem = hjb.Problem(carried, terminal_cost=wave)
    solution = hjb.march(problem, grid, 0.5, scheme=scheme, method=method, step=0.01)
    exact = np.sin(grid.axis(0))
    off = np.abs(solution.value[0] - exact)
    assert np.max(off[:44]) <= most
    assert np.max(off) <= 1.15 * 0.5**3 / 6 + most
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hjb.SolveWarning)
        walled = hjb.march(problem, stencil.walled(grid), 0.5, scheme=scheme, method=method, step=0.01)
    assert np.abs(walled.value[0] - exact)[-1] > 0.2
    assert walled.cut.tolist() == [[[0, 1]]]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [hjb.Upwind(), pytest.param(hjb.Limited(), marks=pytest.mark.slow)])
def test_a_line_in_the_whole_space(scheme):
    """dx = (.3 x + u) dt, cost x + ½u²: V = a x − ½a², a = 1/(1 − .3), is straight: open ends have it to the digits."""
    problem = hjb.Problem(tilting, line_cost, hjb.Box([-4.0], [4.0]), discount=1.0)
    for stretch in (None, (hjb.Sinh(2.0),)):
        grid = hjb.Grid([-1.0], [1.0], (21,), stretch=stretch, edges="open")
        solution = hjb.solve(problem, grid, scheme=scheme, tol=1e-9)
        np.testing.assert_allclose(solution.value, grid.axis(0) / 0.7 - 0.5 / 0.49, atol=1e-7)


def tilting(x, u):
    return 0.3 * x + u


def line_cost(x, u):
    return x[0] + 0.5 * u @ u


@pytest.mark.slow
@pytest.mark.parametrize("evaluation", [hjb.Direct(), hjb.Krylov()])
def test_linear_quadratic_control_in_the_whole_space(evaluation):
    """V = xᵀPx + ¼ tr P of the Riccati equation, by both solvers to the tolerance; with projected ends .65 off."""
    from scipy.linalg import solve_continuous_are

    a = np.array([[0.2, 0.3], [-0.3, 0.1]])
    problem = hjb.Problem(
        Partial(affine, a, np.eye(2), np.zeros(2)), lambda x, u: x @ x + u @ u, hjb.Box([-8.0] * 2, [8.0] * 2),
        discount=1.0, noise=0.5,
    )  # fmt: skip
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (15, 13), edges="open")
    riccati = solve_continuous_are(a - 0.5 * np.eye(2), np.eye(2), np.eye(2), np.eye(2))
    solution = hjb.solve(problem, grid, method=hjb.PolicyIteration(evaluation), tol=1e-6, scheme=hjb.Upwind())
    x = grid.nodes()
    exact = np.einsum("...i,ij,...j", x, riccati, x) + 0.25 * np.trace(riccati)
    np.testing.assert_allclose(solution.value, exact, atol=1e-6)


def test_sweeps_are_refused_at_open_ends():
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
    grid = hjb.Grid([-1.0], [1.0], (9,), edges="open")
    with pytest.raises(ValueError, match=r"Sweeps.*open ends.*Direct"):
        hjb.solve(problem, grid, method=hjb.PolicyIteration(hjb.Sweeps()), scheme=hjb.Upwind())


@pytest.mark.slow
def test_derivatives_and_batches_with_open_ends():
    def tilted(rate, x, u):
        return rate * x + u

    def question(rate):
        return hjb.Problem(Partial(tilted, rate), lambda x, u: x[0] + 0.5 * u @ u, hjb.Box([-4.0], [4.0]), discount=1.0)

    grid = hjb.Grid([-1.0], [1.0], (21,), edges="open")

    def at_one(rate):
        return hjb.solve(question(rate), grid, tol=1e-9, scheme=hjb.Upwind()).value[-1]

    def exact(rate):  # V = s x − s²/2 with s = 1/(1 − rate)
        return 1 / (1 - rate) - 0.5 / (1 - rate) ** 2

    with jax.enable_x64(True):
        for derivative in (jax.jacfwd, jax.grad):
            assert float(derivative(at_one)(0.4)) == pytest.approx(float(jax.grad(exact)(0.4)), rel=1e-5)
    batch = hjb.solve_batch([question(rate) for rate in (0.3, 0.4)], grid, tol=1e-9, scheme=hjb.Upwind())
    assert [solution.value[-1] for solution in batch] == pytest.approx([exact(0.3), exact(0.4)], abs=1e-6)


# --- what is cut ---


def test_what_is_cut_is_kept_in_the_file(tmp_path):
    grid = hjb.Grid([-1.0], [1.2], (21,), edges=(("projected", "constrained"),))
    problem = hjb.Problem(pushed, slope_and_effort, hjb.Box([-1.0], [1.5]), discount=0.5)
    with pytest.warns(hjb.SolveWarning, match="lower end of x1"):
        solution = hjb.solve(problem, grid, scheme=hjb.Upwind())
    solution.save(tmp_path / "run.npz")
    again = hjb.load(tmp_path / "run.npz")
    assert again.grid.edges == grid.edges
    assert again.cut.tolist() == solution.cut.tolist() == [[1, 0]]


def test_where_nobody_earns_by_it_nothing_is_cut():
    """A flat value and actions that cost nothing: which way the drift points there is chance."""
    problem = hjb.Problem(pushed, lambda x, u: 1.0, hjb.Box([-1.0], [1.5]), discount=0.5)
    assert not hjb.solve(problem, hjb.Grid([-1.0], [1.2], (21,)), scheme=hjb.Upwind()).cut.any()


@pytest.mark.parametrize("dtype", [None, pytest.param("float32", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("bound", "current"), [(1.0, 0.0), (1.0, -2e5), (1e6, 0.0)])
def test_what_leaves_is_told_by_the_drift_there(bound, current, dtype):
    """Neither a fast current at the other end nor fast actions make a step across the end rounding."""
    problem = hjb.Problem(
        jax.tree_util.Partial(lambda current, x, u: u + jnp.where(x > 0.95, current, 0.0), current),
        lambda x, u: (u[0] + 1) ** 2,
        hjb.Box([-bound], [bound]),
        discount=1.0,
    )
    grid = hjb.Grid([0.0], [1.0], (11,), edges=(("constrained", "projected"),))
    solution = hjb.solve(
        problem, grid, dtype=dtype, tol=1e-2, method=hjb.PolicyIteration(hjb.Direct()), scheme=hjb.Upwind()
    )
    assert abs(solution.value[0] - 1) <= 1e-2  # standing still costs 1 a unit time


@pytest.mark.slow
def test_many_nodes_are_counted_in_blocks(monkeypatch):
    rng, grid = np.random.default_rng(0), hjb.Grid([-1.0] * 3, [1.0] * 3, (5, 6, 7), periodic=(False, True, False))
    problem = hjb.Problem(lambda x, u: jnp.stack([x[1] + u[0], x[2], x[0] * u[0]]), None, hjb.Box([-1.0], [1.0]))
    value, u, acting = rng.normal(size=grid.shape), rng.normal(size=grid.shape), rng.random(grid.shape) < 0.7
    whole = cut(problem, grid, value, ([u], []), acting)
    monkeypatch.setattr(ends_of_the_box, "BLOCK", 16)
    for one, other in zip(cut(problem, grid, value, ([u], []), acting), whole, strict=True):
        np.testing.assert_array_equal(one, other)
    x1, x2, x3 = np.meshgrid(*(grid.axis(i) for i in range(3)), indexing="ij")
    drift = (x1 * 0 + x2 + u, x3, x1 * u)
    for axis in (0, 2):
        for side, (end, sign) in enumerate(((0, -1), (-1, 1))):
            out = acting & (sign * drift[axis] > 1e-9)
            assert whole[0][axis, side] == np.take(out, end, axis).sum()
            assert whole[1][axis, side] == np.take(acting, end, axis).sum()
    assert not whole[1][1].any()
