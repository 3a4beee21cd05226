"""Games whose players drive one component, upwinded by the sum of their drifts or each alone, against plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import chain

pytestmark = pytest.mark.filterwarnings(
    "ignore:the optimal drift leaves the box", "ignore:.*the Isaacs condition fails"
)

GRID = hjb.Grid([-1.0], [1.0], (21,))
H = 0.1
X = np.linspace(-1, 1, 21)
US, DS = np.array([-1.0, 0.3, 1.0]), np.array([-0.7, 0.0, 0.7])
DISCOUNT = 0.8


def game(unit=1.0, noise=None, **changes):
    """The time in another unit: rates and costs per time are ``unit`` times as large."""
    fields = {"controls": hjb.Finite(US[:, None]), "disturbances": hjb.Finite(DS[:, None])} | changes
    return hjb.Problem(
        lambda x, u, d: unit * (u + d + 0.3 * x),
        lambda x, u, d: unit * (x @ x + 0.2 * u @ u - 0.3 * d @ d),
        discount=unit * DISCOUNT,
        noise=None if noise is None else np.sqrt(unit) * noise,
        **fields,
    )


def tables(split, noise=0.0):
    """Rates up and down, (u, d, x), and running cost, with drift out of the box taken away."""
    u, d = US[:, None, None], DS[None, :, None]
    parts = (u + 0 * d + 0.3 * X, d + 0 * u + 0 * X) if split else (u + d + 0.3 * X,)
    up, down = (sum(np.maximum(sign * f, 0) for f in parts) / H for sign in (1, -1))
    cell = H * np.where(np.abs(X) < 1, 2 * H, H)  # at a wall half a cell, and all of the noise goes inwards
    up, down = up + noise**2 / cell, down + noise**2 / cell
    up[..., -1], down[..., 0] = 0, 0
    return up, down, X**2 + 0.2 * u**2 - 0.3 * d**2


def value_iteration(split, isaacs="upper", noise=0.0):
    up, down, cost = tables(split, noise)
    value, dt = np.zeros(21), 1 / (np.max(up + down) + DISCOUNT)
    for _ in range(20_000):
        h = cost + up * (np.append(value[1:], 0) - value) + down * (np.append(0, value[:-1]) - value)
        best = np.min(np.max(h, axis=1), axis=0) if isaacs == "upper" else np.max(np.min(h, axis=0), axis=0)
        step = dt * (best - DISCOUNT * value)
        value = value + step
        if np.max(np.abs(step)) < 1e-14:
            break
    return value


@pytest.mark.slow
@pytest.mark.parametrize("isaacs", ["upper", "lower"])
@pytest.mark.parametrize("split", [False, True])
@pytest.mark.parametrize("method", [hjb.ValueIteration(), hjb.PolicyIteration(), hjb.PolicyIteration(hjb.Direct())])
def test_a_solve_finds_the_value_of_the_chain_that_the_scheme_says(method, split, isaacs):
    scheme = hjb.Upwind(central=False, split=split)
    solution = hjb.solve(game(isaacs=isaacs), GRID, scheme=scheme, method=method, tol=1e-9)
    known = value_iteration(split, isaacs)
    np.testing.assert_allclose(solution.value, known, atol=2e-9)
    assert np.all(solution.bounds[0] <= known + 1e-11)
    assert np.all(known <= solution.bounds[1] + 1e-11)
    assert (solution.isaacs_gap < 1e-12) == split


def test_the_two_chains_differ_and_the_split_one_has_one_value():
    assert np.max(np.abs(value_iteration(True) - value_iteration(False))) > 0.01
    np.testing.assert_allclose(value_iteration(True), value_iteration(True, "lower"), atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-6, 1e5])
def test_it_knows_no_unit_of_time(unit):
    scheme = hjb.Upwind(split=True)
    found, known = (hjb.solve(game(each), GRID, scheme=scheme, tol=1e-9).value for each in (unit, 1.0))
    np.testing.assert_allclose(found, known, atol=1e-8)


@pytest.mark.slow
def test_noise_goes_with_one_player():
    scheme = hjb.Upwind(central=False, split=True)
    solution = hjb.solve(game(noise=0.4), GRID, scheme=scheme, tol=1e-9)
    np.testing.assert_allclose(solution.value, value_iteration(True, noise=0.4), atol=2e-9)


def test_boxes_are_exact_and_certified():
    """min max over intervals against the corners and what is between them, sampled densely."""
    problem = game(controls=hjb.Box([-1.0], [1.0]), disturbances=hjb.Box([-0.7], [0.7]))
    solution = hjb.solve(problem, GRID, scheme=hjb.Upwind(split=True), tol=1e-9)
    assert "sample" not in solution.stats["certificate"]
    value = solution.value
    up, down = (np.append(np.diff(value), 0) / H, np.append(0, np.diff(value)) / H)

    def gain(f):
        return np.maximum(f, 0) * up + np.minimum(f, 0) * down

    u, d = np.linspace(-1, 1, 4001)[:, None], np.linspace(-0.7, 0.7, 4001)[:, None]
    mine, theirs = np.min(gain(u + 0.3 * X) + 0.2 * u**2, axis=0), np.max(gain(d) - 0.3 * d**2, axis=0)
    np.testing.assert_allclose(DISCOUNT * value, X**2 + mine + theirs, atol=1e-5)


def test_the_exported_generator_is_that_of_both_players():
    scheme, (up, down, _) = hjb.Upwind(split=True), tables(split=True)
    policy, disturbance = np.full((21, 1), US[2]), np.full((21, 1), DS[0])
    found = chain.generator(game(), GRID, policy, disturbance=disturbance, scheme=scheme).toarray()
    np.testing.assert_allclose(np.diag(found, 1), up[2, 0, :-1], atol=1e-12)
    np.testing.assert_allclose(np.diag(found, -1), down[2, 0, 1:], atol=1e-12)


@pytest.mark.slow
def test_float32_batches_jit_and_derivatives():
    scheme, known = hjb.Upwind(split=True), hjb.solve(game(), GRID, scheme=hjb.Upwind(split=True), tol=1e-9).value
    single = hjb.solve(game(), GRID, scheme=scheme, dtype="float32", tol=1e-4).value
    np.testing.assert_allclose(single, known, atol=2e-4)
    lanes = hjb.solve_batch([game(), game(noise=0.4)][:1] * 2, GRID, scheme=scheme, tol=1e-9)
    np.testing.assert_allclose(lanes[1].value, known, atol=2e-9)

    def middle(weight):
        problem = hjb.Problem(
            lambda x, u, d: u + d, lambda x, u, d: x @ x + 0.2 * u @ u - weight * d @ d, hjb.Finite(US[:, None]),
            disturbances=hjb.Finite(DS[:, None]), discount=DISCOUNT,
        )  # fmt: skip
        return hjb.solve(problem, GRID, scheme=scheme, tol=1e-10).value[7]

    with jax.enable_x64(True):
        slope = jax.jit(jax.grad(middle))(0.31)
    assert slope == pytest.approx((middle(0.31 + 1e-5) - middle(0.31 - 1e-5)) / 2e-5, rel=1e-4, abs=1e-6)


@pytest.mark.slow
def test_players_who_cannot_be_told_apart_are_upwinded_by_their_sum():
    problem = hjb.Problem(
        lambda x, u, d: u * (1 + 0.5 * d), lambda x, u, d: x @ x, hjb.Finite(US[:, None]),
        disturbances=hjb.Finite(DS[:, None]), discount=DISCOUNT,
    )  # fmt: skip
    split, whole = (hjb.solve(problem, GRID, scheme=hjb.Upwind(split=each)).value for each in (True, False))
    np.testing.assert_array_equal(split, whole)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is coarse")
def test_a_march_of_long_duration_comes_to_the_stationary_value():
    """By explicit and by implicit steps: one Hamiltonian in solve and in march."""
    problem = game()
    for scheme in (hjb.Upwind(), hjb.Upwind(split=True)):
        known = hjb.solve(problem, GRID, scheme=scheme, tol=1e-9).value
        for method in (hjb.Explicit(), hjb.Implicit()):
            found = hjb.march(problem, GRID, 30.0, scheme=scheme, method=method, step=0.03).value[0]
            np.testing.assert_allclose(found, known, atol=1e-6)


@pytest.mark.slow
def test_two_axes_one_of_them_shared():
    """x is driven by both, y by the control: what the disturbance does not drive is exactly zero in its part."""
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (9, 8))
    problem = hjb.Problem(
        lambda x, u, d: jnp.stack([u[0] + d[0], 0.5 * u[0] - x[1]]), lambda x, u, d: x @ x, hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-0.5], [0.5]), discount=1.0,
    )  # fmt: skip
    solution = hjb.solve(problem, grid, scheme=hjb.Upwind(split=True), tol=1e-8)
    policy, disturbance = (np.nan_to_num(each) for each in (solution.policy, solution.disturbance))
    moves = chain.generator(problem, grid, policy, disturbance=disturbance, scheme=hjb.Upwind(split=True))
    cost = np.sum(grid.nodes() ** 2, axis=-1).ravel()
    left = cost + moves @ solution.value.ravel() - solution.value.ravel()
    assert np.max(np.abs(left)) < 1e-6
    assert solution.isaacs_gap == 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach the target")
def test_a_target_that_is_kept_off_is_reached_in_the_end_where_players_are_upwinded_apart():
    """f = u + d, |u| ≤ 1 towards the target, |d| ≤ 3/2 away from it; T_k − T_{k−1} = h + 3/2 (T_{k+1} − T_k)."""
    grid = hjb.Grid([0.0], [1.0], (11,))
    problem = hjb.Problem(
        lambda x, u, d: u + d, lambda x, u, d: 1.0, hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.5], [1.5]), target=lambda x: x[0],
    )  # fmt: skip
    whole = hjb.solve(problem, grid, scheme=hjb.Upwind())
    np.testing.assert_array_equal(np.isinf(whole.value), np.arange(11) > 0)
    steps = [H]
    for _ in range(9):
        steps.insert(0, H + 1.5 * steps[0])
    split = hjb.solve(problem, grid, scheme=hjb.Upwind(split=True), tol=1e-8)
    np.testing.assert_allclose(split.value, np.concatenate([[0], np.cumsum(steps)]), rtol=1e-8)
