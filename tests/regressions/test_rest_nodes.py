"""Nodes where the system can rest at no cost: which they are, in any units, and whether leaving them pays."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import problem

import hjbjax as hjb

U = hjb.Box([-1.0], [1.0])
LINE = hjb.Grid([-2.0], [2.0], (41,))
PLANE = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (41, 41))
partial = jax.tree_util.Partial


def straight(x, u):
    return u


def square(x, u):
    return x[0] ** 2


def ends(x):
    return 2 - jnp.abs(x[0])


def paying(reward):
    return hjb.Problem(straight, square, U, target=ends, exit_cost=-reward)


def by_value_iteration(reward):
    """V of the chain with u = ±1, and rest where x = 0, in NumPy."""
    x, h = LINE.axis(0), 0.1
    value = np.where(np.abs(x) > 1.95, -reward, 0.0)
    for _ in range(4000):
        moved = np.minimum(value[:-2], value[2:]) + h * x[1:-1] ** 2
        moved = np.where(np.abs(x[1:-1]) < 1e-9, np.minimum(moved, 0), moved)
        value[1:-1] = moved
    return value


@pytest.mark.parametrize("reward", [10.0, 2.5, 2.0])
def test_a_rest_node_is_left_where_that_pays(reward):
    """The way out costs 2.47: a reward of 2.5 is worth it and one of 2 is not."""
    exact = by_value_iteration(reward)
    alone = hjb.solve(paying(reward), LINE, tol=1e-6, scheme=hjb.Upwind())
    together = hjb.solve_batch([paying(10.0), paying(reward)], LINE, tol=1e-6, scheme=hjb.Upwind())[1]
    for solution in (alone, together):
        assert solution.status is hjb.Status.CONVERGED
        assert np.allclose(solution.value, exact, atol=1e-5)
        assert solution.error is None or np.max(np.abs(solution.value - exact)) <= solution.error + 1e-9
    assert (exact[20] < 0) == (alone.error is None)  # who leaves has no bound, and who rests has one


def test_a_traced_solve_leaves_a_rest_node_where_that_pays():
    with jax.enable_x64(True):
        solve = jax.jit(lambda problem: hjb.solve(problem, LINE, tol=1e-6, scheme=hjb.Upwind()))
        leaves, stays = solve(paying(10.0)), solve(paying(2.0))
    for solution, reward in ((leaves, 10.0), (stays, 2.0)):
        assert int(solution.code) == hjb.Status.CONVERGED
        assert np.max(np.abs(np.asarray(solution.value) - by_value_iteration(reward))) <= 1e-5
    assert np.isinf(leaves.error)  # nothing certifies it
    assert stays.error <= 1e-6


def carried(x, u):
    return jnp.where(x > 1.0, 1.0, u)


def earning(x, u):
    return jnp.where(x[0] > 1.0, -20.0, x[0] ** 2)


@pytest.mark.slow
def test_a_rest_node_is_left_for_a_place_that_earns():
    problem = hjb.Problem(carried, earning, U, target=lambda x: 1.55 - x[0])
    solution = hjb.solve(problem, hjb.Grid([-1.0], [2.0], (31,)), tol=1e-6, scheme=hjb.Upwind())
    gains = [0.1 * k for k in range(1, 11)]  # the squares on the way from 0 to 1, then 5 cells at -2 a cell
    assert np.isclose(solution.value_at([0.0]), sum(0.1 * x**2 for x in [0.0, *gains]) - 10.0, atol=1e-5)


def pushed(x, u):
    return jnp.stack([x[1], u[0]])


def quadratic(scale, x, u):
    return scale * (x @ x + 0.1 * u @ u)


def fast(rate, x, u):
    return rate * jnp.stack([x[1], u[0]])


@pytest.mark.parametrize(
    ("cost", "rate", "dtype"),
    [
        pytest.param(1e-3, 1.0, "float32", marks=pytest.mark.slow),
        pytest.param(1e-4, 1.0, "float32", marks=pytest.mark.slow),
        (1e-13, 1.0, None),
        (1e9, 1e6, None),
        (1.0, 1e-6, None),
        pytest.param(1e9, 1e6, "float32", marks=pytest.mark.slow),
    ],
)
def test_rest_is_told_by_like_beside_like(cost, rate, dtype):
    """Cost and time in other units scale V and change nothing else."""
    standard = hjb.solve(hjb.Problem(pushed, partial(quadratic, 1.0), U), PLANE, tol=1e-4, scheme=hjb.Upwind())
    problem = hjb.Problem(partial(fast, rate), partial(quadratic, cost * rate), U)
    solution = hjb.solve(problem, PLANE, tol=(1e-4 if dtype is None else 1e-2) * cost, dtype=dtype, scheme=hjb.Upwind())
    assert np.max(np.abs(solution.value / cost - standard.value)) <= solution.error / cost + standard.error + 1e-6
    assert np.count_nonzero(solution.value == 0) == 1


@pytest.mark.slow
@pytest.mark.parametrize("noise", [[[1.0], [1.0]], [[0.5], [-0.5]]])
def test_correlated_noise_leaves_no_rest(noise):
    """On equal spacings all of it moves along diagonals, and nothing along the axes."""
    cost, push = (lambda x, u: x @ x + u @ u), hjb.Box([-1.0] * 2, [1.0] * 2)
    problem = hjb.Problem(straight, cost, push, noise=np.array(noise))
    with pytest.raises(ValueError, match="no finite solution"):
        hjb.solve(problem, hjb.Grid([-1.0, -1.0], [1.0, 1.0], (11, 11)), scheme=hjb.Upwind())


def damped(x, u):
    return x[0] + jnp.abs(u[0])


@pytest.mark.slow
def test_noise_that_the_control_switches_off_leaves_rest():
    problem = hjb.Problem(straight, square, U, noise=lambda x, u: jnp.stack([u[0]]) * jnp.ones((1, 1)))
    solution = hjb.solve(problem, LINE, tol=1e-4, scheme=hjb.Upwind())
    assert solution.value[20] == 0
    assert np.all(np.delete(solution.value, 20) > 0)


def valley(x, u):
    """Nothing is paid in [1.2, 1.8]."""
    return jnp.maximum(jnp.abs(x[0] - 1.5) - 0.3, 0.0)


@pytest.mark.filterwarnings("ignore:the feedback never arrives")  # V is the same all over the valley
@pytest.mark.parametrize("exit_cost", [5.0, 0.1, pytest.param(-3.0, marks=pytest.mark.slow)])
def test_going_back_and_forth_at_no_cost_is_a_rest(exit_cost):
    """Both actions move, so that no node rests: without a hold any constant between 0 and the way out is a solution."""
    grid, step = hjb.Grid([0.0], [2.0], (21,)), 0.1
    problem = hjb.Problem(
        straight, valley, hjb.Finite([[-1.0], [1.0]]), target=lambda x: x[0] - 0.05, exit_cost=exit_cost
    )
    solution = hjb.solve(problem, grid, tol=1e-6, scheme=hjb.Upwind())
    x, value = grid.axis(0), np.full(21, 1e3)
    pay = step * np.maximum(np.abs(x - 1.5) - 0.3, 0)
    value[0], value[12:19] = exit_cost, 0.0
    for _ in range(100):  # from above, where the valley is worth nothing or less
        up, down = np.append(value[1:], value[-1] + 1e3), np.append(1e3, value[:-1])
        value[1:] = np.minimum(value, np.minimum(up, down) + pay)[1:]
    assert solution.status is hjb.Status.CONVERGED
    assert np.allclose(solution.value, value, atol=1e-5)


def test_nothing_paid_on_the_way_and_a_price_at_the_end():
    """Without a running cost who can stay away from a target that costs something pays nothing."""
    problem = hjb.Problem(straight, None, hjb.Finite([[-1.0], [1.0]]), target=lambda x: x[0] - 0.05, exit_cost=4.0)
    solution = hjb.solve(problem, hjb.Grid([0.0], [2.0], (21,)), tol=1e-6, scheme=hjb.Upwind())
    assert solution.value[0] == 4.0
    assert np.allclose(solution.value[1:], 0.0, atol=1e-9)


@pytest.mark.slow
def test_a_solve_that_failed_is_no_number_and_neither_is_its_derivative():
    def value(reward, **options):
        problem = hjb.Problem(straight, square, U, target=ends, exit_cost=-reward)
        return hjb.solve(problem, LINE, tol=1e-6, scheme=hjb.Upwind(), **options).value[20]

    with jax.enable_x64(True):
        found = jax.value_and_grad(value)(10.0)
        failed = jax.value_and_grad(functools.partial(value, max_steps=1))(10.0)
        partial = jax.jit(functools.partial(value, max_steps=1, throw=False))(10.0)
    assert found[0] == pytest.approx(by_value_iteration(10.0)[20], abs=1e-5)
    assert np.isnan(found[1])  # resting is worth as much as leaving, once V is known
    assert np.isnan(failed).all()
    assert np.isfinite(partial)


@pytest.mark.slow
@pytest.mark.parametrize("cost", [-1.0, 0.0])
def test_a_traced_solve_certifies_nothing_where_nothing_is_paid(cost):
    """Without discount and a positive running cost there is no bound, and an error of zero least of all."""

    def solved(cost):
        drift, toll = (lambda x, u: -1.0 - 0.5 * u * u), partial(lambda c, x, u: c + 0 * x[0], cost)
        return hjb.solve(hjb.Problem(drift, toll, U, target=lambda x: x[0] + 1.0), LINE, scheme=hjb.Upwind())

    host = solved(cost)
    with jax.enable_x64(True):
        solution = jax.jit(solved)(cost)
    assert np.isinf(solution.error)
    assert host.error is host.bounds is None
    np.testing.assert_allclose(solution.value, host.value, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("exit_cost", [-1.0, 1.0])
def test_a_game_that_may_go_on_at_no_cost(exit_cost):
    """With u = 0 nothing is paid while the disturbance moves the state, so that every constant is a solution."""

    def fuel(x, u, d):
        return jnp.abs(u[0])

    problem = hjb.Problem(
        lambda x, u, d: u + 0.3 * d, fuel, U, disturbances=U, target=lambda x: x[0] + 1.0, exit_cost=exit_cost
    )
    solution = hjb.solve(problem, LINE, tol=1e-6, scheme=hjb.Upwind())
    h, value = 0.1, np.zeros(41)
    held = LINE.axis(0) <= -1.0 + 1e-9
    value[held] = exit_cost
    for _ in range(20_000):
        up, down = (np.append(value[1:], value[-1]) - value) / h, (value - np.append(value[0], value[:-1])) / h
        best = np.full(41, np.inf)
        for u in (-1.0, -0.3, 0.0, 0.3, 1.0):
            worst = np.full(41, -np.inf)
            for d in (-1.0, -u / 0.3 if abs(u) <= 0.3 else 1.0, 1.0):
                f = u + 0.3 * d
                worst = np.maximum(worst, np.maximum(f, 0) * up + np.minimum(f, 0) * down)
            best = np.minimum(best, abs(u) + worst)
        value = np.where(held, exit_cost, value + 0.07 * best)
    assert solution.status is hjb.Status.CONVERGED
    assert np.max(np.abs(solution.value - value)) <= 1e-3


def test_rest_where_every_action_costs_the_same():
    """At the origin u = 0 rests at no cost, though the cost does not favour it."""
    odd = hjb.Grid([-1.0, -2.0], [1.0, 2.0], (9, 11))
    assert hjb.solve(problem(discount=0.0), odd, tol=1e-2, scheme=hjb.Upwind()).value[4, 5] == 0.0


# --- staying near a state by one action after the other ---

NARROW = hjb.Grid([-1.0], [1.0], (41,))
SHOVE = hjb.Box([-0.5], [0.5])


def near_rest(x, *actions):
    return jnp.maximum(jnp.abs(x[0]) - 0.3, 0) ** 2


def up_to_the_wall(x, *actions):
    return 1 - x[0]


def game_by_value_iteration(cost, controls, shoves):
    """The limit of long horizons of the upwind chain of f = u + d with projected ends, in NumPy."""
    h, value, limit = 0.05, np.zeros(41), 1.5
    for _ in range(4000):
        up, down = np.append(np.diff(value), 0) / h, np.append(0, np.diff(value)) / h
        f = np.add.outer(controls, shoves)[..., None]
        moved = np.maximum(f, 0) * up + np.minimum(f, 0) * down
        value = value + h / limit * (cost + moved.max(1).min(0))
    return value


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cost", "controls", "shoves"),
    [
        (near_rest, U, SHOVE),
        (near_rest, hjb.Finite([[-1.0], [1.0]]), hjb.Finite([[-0.5], [0.5]])),
        (up_to_the_wall, U, SHOVE),
        (near_rest, hjb.Finite([[-1.0], [1.0]]), None),
    ],
)
def test_a_set_of_nodes_is_held_at_no_cost(cost, controls, shoves):
    """The control keeps the state where nothing is paid; games of this kind were refused as endless."""
    drift = (lambda x, u: u) if shoves is None else (lambda x, u, d: u + d)
    problem = hjb.Problem(drift, cost, controls, disturbances=shoves)
    solution = hjb.solve(problem, NARROW, tol=1e-9, scheme=hjb.Upwind())
    paid = np.array([float(cost(x)) for x in NARROW.nodes()])
    exact = game_by_value_iteration(paid, [-1.0, 0.0, 1.0], [0.0] if shoves is None else [-0.5, 0.0, 0.5])
    np.testing.assert_allclose(solution.value, exact, atol=1e-8)


@pytest.mark.parametrize("isaacs", ["upper", pytest.param("lower", marks=pytest.mark.slow)])
def test_a_stronger_disturbance_holds_no_nodes(isaacs):
    """In a lower game the control answers; |d| ≤ 1.2 moves the state out of every set all the same."""
    strong = hjb.Box([-1.2], [1.2])
    problem = hjb.Problem(lambda x, u, d: u + d, near_rest, U, disturbances=strong, isaacs=isaacs)
    with pytest.raises(
        ValueError, match=r"(?s)on this grid there is no finite solution.*because the disturbance moves"
    ):
        hjb.solve(problem, NARROW, scheme=hjb.Upwind())


def test_switching_at_a_node_is_not_a_rest():
    """The system rests at 0 by switching at no cost, V = |x|³/3; the chain pays for every switch."""
    problem = hjb.Problem(straight, square, hjb.Finite([[-1.0], [1.0]]))
    with pytest.raises(ValueError, match=r"(?s)on this grid there is no finite solution.*because every action") as said:
        hjb.solve(problem, NARROW)
    assert len(str(said.value).splitlines()) <= 6
