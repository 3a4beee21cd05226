"""Bounds on the values of games hold for exact values, close with the mesh, and use the order of the players."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import hjbjax as hjb
from tests.enclosure.test_enclose import check, in_box, near, wave

UNIT, HALF = hjb.Box([-1.0], [1.0]), hjb.Box([-0.5], [0.5])


def to_zero(x):
    """V of x' = u + d with |u| ≤ 1, |d| ≤ ½, the cost x² and the discount 1: x goes to zero at the speed c = ½."""
    a, c = jnp.abs(x[0]), 0.5
    return a**2 - 2 * c * a + 2 * c**2 - 2 * c**2 * jnp.exp(-a / c)


ENDS = [hjb.Finite([[-1.0], [0.0], [1.0]]), hjb.Finite([[-0.5], [0.5]])]


@pytest.mark.parametrize(
    ("controls", "disturbances", "order"),
    [
        (UNIT, HALF, "upper"),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in [
                (UNIT, HALF, "lower"),
                (ENDS[0], HALF, "upper"),
                (UNIT, ENDS[1], "upper"),
                (hjb.Ball(1.0, 1), HALF, "lower"),
            ]
        ),
    ],
)  # fmt: skip
def test_the_value_of_a_pursuit_to_zero_is_enclosed(controls, disturbances, order):
    problem = hjb.Problem(
        lambda x, u, d: u + d, lambda x, u, d: x @ x, controls, disturbances=disturbances, discount=1.0, isaacs=order
    )
    widths = []
    for count in (41, 81):
        grid = hjb.Grid([-1.0], [1.0], (count,))
        found = hjb.enclose(problem, near(grid, to_zero))
        widths.append(check(found, to_zero, [-1.0], [1.0]))
    assert widths[1] < 0.6 * widths[0]
    assert widths[1] < 0.01


def random_game(seed, n):
    """A random game on the torus with its exact value: L = q + |u|²/2 − |d|²/2, with products of x, u and d in f."""
    draw = np.random.default_rng(seed)
    value, fields = wave(draw, n), [wave(draw, n) for _ in range(3 * n)]
    reach, push = draw.uniform(0.3, 2.0), draw.uniform(0.1, 1.0)

    def drift(x, u, d):
        parts = [
            0.3 * fields[k](x)
            + (1 + 0.2 * jnp.sin(fields[n + k](x))) * u[k]
            + 0.5 * jnp.cos(fields[2 * n + k](x)) * d[k]
            for k in range(n)
        ]  # fmt: skip
        return jnp.stack(parts)

    def cost(x, u, d):
        still = jnp.zeros(n)
        slope = jax.grad(value)(x)
        gain, other = (jax.jacfwd(drift, k)(x, still, still).T @ slope for k in (1, 2))
        rest = drift(x, still, still) @ slope + in_box(reach)(gain) - in_box(push)(-other)
        return 0.7 * value(x) - rest + u @ u / 2 - d @ d / 2

    sets = (hjb.Box([-r] * n, [r] * n) for r in (reach, push))
    return hjb.Problem(drift, cost, next(sets), disturbances=next(sets), discount=0.7), value


@pytest.mark.slow
@pytest.mark.parametrize(("n", "seeds"), [(1, range(5)), (2, range(1, 3))])
def test_the_values_of_random_games_are_enclosed(n, seeds):
    for seed in seeds:
        problem, value = random_game(seed, n)
        widths = []
        for count in (24, 48):
            grid = hjb.Grid([0.0] * n, [1.0] * n, (count,) * n, periodic=(True,) * n)
            widths.append(check(hjb.enclose(problem, near(grid, value, 1e-3), rounds=3), value, [0.0] * n, [1.0] * n))
        assert widths[1] < 0.6 * widths[0]


@pytest.mark.parametrize("order", ["upper", pytest.param("lower", marks=pytest.mark.slow)])
def test_the_order_of_two_finite_sets_counts(order):
    """f = u d + b, L = q + 0.3 u d, u, d = ±1, |V'| < 0.3: H is q + b V' ± (V' + 0.3), + for min max."""
    whole, side = wave(np.random.default_rng(3), 1), 1 if order == "upper" else -1
    value, points = lambda x: 0.01 * whole(x), np.array([-1.0, 1.0])

    def cost(x, u, d):
        slope = jax.grad(value)(x)[0]
        saddle = 0.2 * jnp.sin(2 * jnp.pi * x[0]) * slope + side * (slope + 0.3)
        return value(x) - saddle + 0.3 * u[0] * d[0]

    pair = hjb.Finite(points[:, None])
    problem = hjb.Problem(
        lambda x, u, d: u * d + 0.2 * jnp.sin(2 * jnp.pi * x), cost, pair, disturbances=pair, discount=1.0, isaacs=order
    )
    widths = []
    for count in (64, 128):
        grid = hjb.Grid([0.0], [1.0], (count,), periodic=(True,))
        widths.append(check(hjb.enclose(problem, near(grid, value)), value, [0.0], [1.0]))
    assert widths[1] < 0.5 * widths[0]


def test_players_that_drive_the_same_component_are_enclosed_by_commitments():
    """L has the product u d, so that there is no formula; the exact saddle is that of free u and d."""
    value = wave(np.random.default_rng(4), 1)
    matrix = np.array([[1.0, 0.5], [0.5, -1.0]])  # the second derivatives of L in (u, d)
    inverse = np.linalg.inv(matrix)

    def cost(x, u, d):
        slope = jax.grad(value)(x)[0] * jnp.array([1.0, 0.4])
        both = jnp.concatenate([u, d])
        return value(x) + slope @ inverse @ slope / 2 + both @ matrix @ both / 2

    wide = hjb.Box([-40.0], [40.0])
    problem = hjb.Problem(lambda x, u, d: u + 0.4 * d, cost, wide, disturbances=wide, discount=1.0)
    widths = []
    for count in (32, 64):
        grid = hjb.Grid([0.0], [1.0], (count,), periodic=(True,))
        widths.append(check(hjb.enclose(problem, near(grid, value)), value, [0.0], [1.0]))
    assert widths[1] < 0.5 * widths[0]


@pytest.mark.slow
def test_the_bounds_of_a_linear_quadratic_game_close_in_the_inner_half_of_a_large_box():
    rate, a, b, e, gamma = (
        1.0,
        np.array([[0.0, 1.0], [0.0, 0.0]]),
        np.array([[0.0], [1.0]]),
        np.array([[0.0], [0.6]]),
        1.5,
    )
    p = scipy.linalg.solve_continuous_are(
        a - rate / 2 * np.eye(2), np.hstack([b, e]), np.eye(2), np.diag([1.0, -(gamma**2)])
    )
    problem = hjb.Problem(
        lambda x, u, d: jnp.stack([x[1], u[0] + 0.6 * d[0]]), lambda x, u, d: x @ x + u @ u - gamma**2 * d @ d,
        hjb.Box([-30.0], [30.0]), disturbances=hjb.Box([-10.0], [10.0]), discount=rate,
    )  # fmt: skip
    widths = []
    for count in (51, 101):
        grid = hjb.Grid([-4.0, -4.0], [4.0, 4.0], (count, count))
        found = hjb.enclose(problem, near(grid, lambda x: x @ p @ x))
        widths.append(check(found, lambda x: x @ p @ x, [-2.0, -2.0], [2.0, 2.0], 20_000))
    assert np.log2(widths[0] / widths[1]) > 1.5
    assert widths[1] < 0.01


def test_the_time_to_catch_a_slower_evader_is_enclosed():
    """x' = u + d with |u| ≤ 1 and |d| ≤ ½ until |x| ≤ 0.2: V = 2 (|x| − 0.2)."""
    problem = hjb.Problem(
        lambda x, u, d: u + d, lambda x, u, d: 1.0, UNIT, disturbances=HALF, target=lambda x: jnp.abs(x[0]) - 0.2
    )
    exact = lambda x: jnp.maximum(2 * (jnp.abs(x[0]) - 0.2), 0.0)  # noqa: E731
    found = hjb.enclose(problem, near(hjb.Grid([-1.0], [1.0], (41,)), exact))
    check(found, exact, [-1.0], [1.0])
    assert np.max(found.width) < 1e-9


def test_what_has_no_formula_in_a_game_is_refused():
    problem = hjb.Problem(lambda x, u, d: jnp.sin(u) + d, lambda x, u, d: x @ x, UNIT, disturbances=HALF, discount=1.0)
    with pytest.raises(ValueError, match="a game whose drift or cost is not a quadratic polynomial"):
        hjb.enclose(problem, near(hjb.Grid([-1.0], [1.0], (11,)), to_zero))
