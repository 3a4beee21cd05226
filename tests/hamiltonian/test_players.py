"""What is known of each player: derivative rules that lie, who moves first, and which disturbance may blow up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.players import find_players
from hjbjax.solvers.setup import assumptions_of

LINE = hjb.Grid([-2.0], [2.0], (21,))
UNIT = hjb.Box([-1.0], [1.0])
SEARCHED = "no bounds: the optimum over the actions is searched, and may be missed"


@jax.custom_jvp
def timid(u):
    """u, with a derivative that is too small."""
    return 1.0 * u


timid.defjvps(lambda tangent, answer, u: 0.1 * tangent)


def value_of(drift, cost, controls=UNIT):
    problem = hjb.Problem(drift, cost, controls, discount=1.0)
    return hjb.solve(problem, LINE, tol=1e-6, scheme=hjb.Upwind()).value_at([1.5])


@pytest.fixture(scope="module")
def plain():
    """V(1.5) of drift u and cost x² + u²/10."""
    return value_of(lambda x, u: u, lambda x, u: x @ x + 0.1 * u @ u)


@pytest.mark.parametrize(
    ("drift", "cost", "controls"),
    [
        pytest.param(
            lambda x, u: jax.lax.stop_gradient(u), lambda x, u: x @ x + 0.1 * u @ u, UNIT, marks=pytest.mark.slow
        ),
        pytest.param(lambda x, u: timid(u), lambda x, u: x @ x + 0.1 * u @ u, UNIT, marks=pytest.mark.slow),
        pytest.param(
            lambda x, u: u, lambda x, u: x @ x + 0.1 * timid(u) @ jax.lax.stop_gradient(u), UNIT, marks=pytest.mark.slow
        ),
        (lambda x, u: timid(u), lambda x, u: x @ x + 0.1 * u @ u, hjb.Ball(1.0, 1)),
    ],
    ids=["stop_gradient", "custom_jvp", "cost", "ball"],
)
def test_a_derivative_rule_of_the_users_moves_no_optimum(drift, cost, controls, plain):
    assert value_of(drift, cost, controls) == pytest.approx(plain, abs=3e-6)


@pytest.mark.slow
def test_a_derivative_rule_of_the_users_moves_no_worst_disturbance():
    def march(seen):
        problem = hjb.Problem(
            lambda x, u, d: -x + seen(d), lambda x, u, d: x @ x - d @ d, disturbances=hjb.Box([-2.0], [2.0])
        )
        return hjb.march(problem, LINE, 0.5, inner=0, step=0.01, scheme=hjb.Upwind(split=True)).value

    np.testing.assert_allclose(march(timid), march(lambda d: d), rtol=0, atol=1e-7)


# --- who moves first ---


def meeting(x, u, d):
    return jnp.stack([3 * (u[0] - u[1]) + 0.2 * d[0], u[0] + u[1] - 0.9])


def apart(x, u, d):
    return jnp.stack([u[0] - u[1], d[0]])


def apart_of_three(x, u, d):
    return jnp.stack([u[0] - u[1] + 0.5 * u[2], d[0]])


def effort(x, u, d):
    return (u[0] + u[2]) ** 2 + u[1] ** 2 - d[0] ** 2


def along(x, u, d):
    return 5 * jnp.abs(x[0]) + 0.3 * u[0]


def crossed(x, u, d):
    return x @ x + u[0] * d[0]


SQUARE = hjb.Box([-1.0, -1.0], [0.93, 1.0])
CORNERS = hjb.Finite([[-1.0, -1.0], [0.93, -1.0], [0.93, 1.0]])


@pytest.mark.parametrize(
    ("drift", "cost", "controls", "disturbances", "isaacs", "exact"),
    [
        (meeting, along, SQUARE, UNIT, "upper", False),
        (meeting, along, SQUARE, UNIT, "lower", False),
        (meeting, along, hjb.Ball(1.0, 2), UNIT, "upper", False),
        (meeting, along, CORNERS, UNIT, "upper", True),  # the first player's actions are all tried
        (meeting, along, CORNERS, UNIT, "lower", False),
        (meeting, along, SQUARE, hjb.Finite([[-1.0], [1.0]]), "lower", True),
        (meeting, along, None, UNIT, "upper", True),
        (apart, along, SQUARE, UNIT, "upper", True),  # each drives a component of its own
        (apart_of_three, effort, hjb.Box([-1.0] * 3, [1.0] * 3), UNIT, "upper", True),
        (apart_of_three, effort, hjb.Ball(1.0, 3), UNIT, "lower", True),
        (apart, crossed, SQUARE, UNIT, "upper", False),  # but here they meet in the cost
        (apart, crossed, SQUARE, UNIT, "lower", False),
    ],
)
def test_the_certificate_says_where_the_first_player_is_sampled(drift, cost, controls, disturbances, isaacs, exact):
    if controls is None:
        problem = hjb.Problem(
            lambda x, u, d: jnp.stack([0.2 * d[0], -x[0]]), lambda x, u, d: x @ x, disturbances=disturbances,
            isaacs=isaacs, discount=1.0,
        )  # fmt: skip
    else:
        problem = hjb.Problem(drift, cost, controls, disturbances=disturbances, isaacs=isaacs, discount=1.0)
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (7, 7))
    assumed = assumptions_of(Discretisation(problem, grid, hjb.Upwind(), np.float64))
    assert (assumed.sentence == SEARCHED) is not exact


def test_a_player_whose_part_is_no_polynomial_leaves_the_other_exact():
    problem = hjb.Problem(
        lambda x, u, d: jnp.stack([jnp.sin(u[0]), d[0]]), lambda x, u, d: jnp.abs(u[0]) - d[0] ** 2,
        UNIT, disturbances=UNIT, discount=1.0,
    )  # fmt: skip
    players = find_players(problem, 2, np.float64)
    assert players.decoupled
    assert players.disturbance.exact
    assert not players.control.exact


# --- which disturbance may blow up ---


def shared(x, u, d):
    return u + d


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the optimal drift leaves")  # where it is cheap to go left
@pytest.mark.parametrize(
    "cost",
    [
        lambda x, u, d: x @ x + jnp.abs(u[0]),
        lambda x, u, d: jnp.abs(x[0]) + jnp.cos(u[0]),
        lambda x, u, d: x @ x + jnp.exp(u[0]) + 0.1 * d[0],
    ],
    ids=["abs", "cos", "linear in d"],
)
def test_a_bounded_disturbance_is_no_blow_up(cost):
    problem = hjb.Problem(shared, cost, UNIT, disturbances=hjb.Box([-0.3], [0.3]))
    assert hjb.march(problem, LINE, 0.5, scheme=hjb.Upwind(split=True)).status is hjb.Status.CONVERGED


@pytest.mark.slow
def test_a_disturbance_with_a_square_is_watched_whatever_the_control_costs():
    problem = hjb.Problem(
        shared, lambda x, u, d: 9 * x @ x + jnp.abs(u[0]) - 0.1 * d @ d, UNIT, disturbances=hjb.Box([-9.0], [9.0])
    )
    found = hjb.march(problem, LINE, 1.0, inner=0.5, throw=False, scheme=hjb.Upwind(split=True))
    assert found.status is hjb.Status.DIVERGED


# --- Isaacs' condition ---

PAIR = hjb.Finite([[-1.0], [1.0]])


@pytest.mark.parametrize("size", [1e9, 1e-9])
def test_a_failing_condition_of_isaacs_is_told_beside_what_the_actions_matter(size):
    """min max of cos 3(u − d) over signs is 1, max min cos 6: all that the actions matter, however large a cost is."""
    problem = hjb.Problem(
        lambda x, u, d: -x, jax.tree_util.Partial(differing, np.array([30.0, 1.0]) * size),
        PAIR, disturbances=PAIR, discount=1.0,
    )  # fmt: skip
    with pytest.warns(
        hjb.SolveWarning, match=r"Isaacs condition fails.*100% of the influence of the actions"
    ) as caught:
        solution = hjb.solve(problem, LINE, tol=1e-3 * size, scheme=hjb.Upwind())
    assert caught[0].filename == __file__
    assert solution.isaacs_gap == pytest.approx((1 - np.cos(6)) * size, rel=1e-6)


def differing(weights, x, u, d):
    return weights[0] + weights[1] * jnp.cos(3 * (u[0] - d[0]))


def test_a_march_tells_it_too():
    problem = hjb.Problem(
        lambda x, u, d: -x, jax.tree_util.Partial(differing, np.array([0.0, 1.0])), PAIR, disturbances=PAIR
    )
    with pytest.warns(hjb.SolveWarning, match=r"Isaacs condition fails") as caught:
        hjb.march(problem, LINE, 0.5, scheme=hjb.Upwind(split=True))
    assert caught[0].filename == __file__


@pytest.mark.slow
def test_what_upwinding_leaves_is_no_failure():
    """f = u + d/2 and a kink of V at 0: a gap of first order, two hundredths of what the actions matter."""
    problem = hjb.Problem(
        lambda x, u, d: u + 0.5 * d, lambda x, u, d: jnp.abs(x[0]), UNIT, disturbances=PAIR, discount=1.0
    )
    assert 0 < hjb.solve(problem, LINE, tol=1e-6, scheme=hjb.Upwind()).isaacs_gap < 0.2
