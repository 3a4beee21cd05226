"""``Solution.box_error``: how far V moves with another assumption at the ends of the box, against known answers."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

import hjbjax as hjb

WARNED = "the box decides V"


def solved(problem, grid, **options):
    """The solution without its warnings, and the warnings about the box."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solution = hjb.solve(problem, grid, **options)
    return solution, [str(each.message) for each in said if WARNED in str(each.message)]


def geometric(sigma=0.2, discount=0.02, price=1.0):
    """Geometric Brownian motion with cost −price · x: V = −price · x/discount on the half-line."""
    return hjb.Problem(lambda x, u: 0 * x, lambda x, u: -price * x[0], noise=lambda x, u: sigma * x, discount=discount)


@pytest.mark.parametrize(("sigma", "discount", "top"), [(0.2, 0.02, 1.0), (0.3, 0.05, 4.0), (0.15, 0.04, 1e3)])
def test_noise_that_reflects(sigma, discount, top):
    """V = −x/β, while reflection at the upper end makes V flat there."""
    grid = hjb.Grid([0.0], [top], (101,))
    solution, said = solved(geometric(sigma, discount), grid)
    true = np.abs(solution.value + grid.axis(0) / discount)
    middle = slice(30, None)
    np.testing.assert_allclose(solution.box_error[middle], true[middle], rtol=0.1)
    assert len(said) == 1
    assert "upper end of x1" in said[0]
    assert "lower end" not in said[0]


@pytest.mark.slow
def test_drift_that_is_cut():
    """A firm sells the capital that it does not have: V(0) = −10, where −10/9 is right."""
    firm = hjb.Problem(
        lambda k, i: i - 0.1 * k,
        lambda k, i: -(0.2 * k[0] - i[0] - 0.5 * i[0] ** 2),
        hjb.Box([-5.0], [5.0]),
        discount=0.05,
    )
    grid = hjb.Grid([0.0], [5.0], (201,))
    solution, said = solved(firm, grid)
    true = np.abs(solution.value + 10 / 9 + 4 / 3 * grid.axis(0))
    np.testing.assert_array_less(true / 3, solution.box_error)
    np.testing.assert_array_less(solution.box_error, 3 * true)
    assert "the lower end of x1" in said[0]
    constrained, said = solved(firm, hjb.Grid([0.0], [5.0], (201,), edges="constrained"))
    np.testing.assert_allclose(constrained.value, -10 / 9 - 4 / 3 * grid.axis(0), atol=1e-5)
    assert constrained.box_error is None
    assert not said


@pytest.mark.slow
def test_open_ends_assume_a_parabola():
    """V = e^y/0.04 is no parabola: the answer is 26 % off at the upper end, on every grid."""
    problem = hjb.Problem(lambda y, u: 0 * y - 0.01125, lambda y, u: jnp.exp(y[0]), noise=0.25, discount=0.06)
    grid = hjb.Grid([-3.0], [3.0], (201,), edges="open")
    solution, said = solved(problem, grid)
    true = np.abs(solution.value - np.exp(grid.axis(0)) / 0.04)
    upper = slice(100, None)
    np.testing.assert_array_less(true[upper] / 3, solution.box_error[upper])
    np.testing.assert_array_less(solution.box_error[upper], 3 * true[upper])
    assert said


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_linear_quadratic_problems_on_the_whole_space(n):
    """Next to the ends, where optimal paths leave the box, the estimate is the error; in the middle both are small."""
    a = np.array([[0.0, 1.0], [0.0, 0.0]])[-n:, -n:] + 0.3 * np.eye(n)
    b = np.eye(n)[:, -1:]
    p = solve_continuous_are(a - 0.25 * np.eye(n), b, np.eye(n), np.eye(1))
    problem = hjb.Problem(lambda x, u: a @ x + b @ u, lambda x, u: x @ x + u @ u, hjb.Box([-9.0], [9.0]), discount=0.5)
    grid = hjb.Grid([-1.0] * n, [1.0] * n, (61,) * n)
    solution, _ = solved(problem, grid)
    if n == 1:  # the optimal drift points inwards at both ends
        assert solution.box_error is None
        assert "no optimal path" in solution.stats["box_error"]
        return
    x = grid.nodes()
    true = np.abs(solution.value - np.einsum("...i,ij,...j", x, p, x))
    large = true > 0.1 * np.ptp(solution.value)
    assert np.mean(large) > 0.01
    ratio = solution.box_error[large] / true[large]
    assert np.mean((ratio > 1 / 3) & (ratio < 3)) > 0.9
    assert np.max(solution.box_error[grid.inner(0.2)]) < 0.01 * np.ptp(solution.value)


@pytest.mark.slow
@pytest.mark.filterwarnings(f"ignore:{WARNED}")
@pytest.mark.parametrize("time", [1e-6, pytest.param(1e6, marks=pytest.mark.slow)])
def test_units(time):
    """Other units of time and cost change nothing but the units."""
    cost = 1e9
    plain = hjb.solve(geometric(), hjb.Grid([0.0], [0.5], (41,)), throw=False)
    other = hjb.Problem(
        lambda x, u: 0 * x, lambda x, u: -cost * x[0], noise=lambda x, u: 0.2 * x / np.sqrt(time), discount=0.02 / time
    )
    scaled = hjb.solve(other, hjb.Grid([0.0], [0.5], (41,)), tol=1e-3 * cost * time)
    np.testing.assert_allclose(scaled.box_error, cost * time * plain.box_error, rtol=1e-6)


@pytest.mark.slow
def test_ends_that_cannot_matter():
    """None, and the reason: periodic, constrained without noise, never reached, held by a target."""
    ring = hjb.Problem(lambda x, u: u, lambda x, u: 1 - jnp.cos(x[0]), hjb.Box([-1.0], [1.0]), discount=1.0)
    around = hjb.solve(ring, hjb.Grid([-np.pi], [np.pi], (40,), periodic=(True,)))
    walled = hjb.solve(ring, hjb.Grid([-2.0], [2.0], (41,), edges="constrained"))
    inwards = hjb.solve(ring, hjb.Grid([-2.0], [2.0], (41,)))
    held = hjb.Problem(lambda x, u: 0 * x, lambda x, u: 1.0, noise=1.0, target=lambda x: 1 - jnp.abs(x[0]))
    exits = hjb.solve(held, hjb.Grid([-1.0], [1.0], (41,)))
    for solution, reason in ((around, "assumes"), (walled, "assumes"), (inwards, "no optimal path"), (exits, "no opt")):
        assert solution.box_error is None
        assert reason in solution.stats["box_error"]
        assert solution.stats["box_error"] in str(solution)


@pytest.mark.filterwarnings(f"ignore:.*{WARNED}")
def test_batches_files_and_the_screen(tmp_path):
    """Every lane has its own estimate; files and the screen have it as well."""
    grid = hjb.Grid([0.0], [1.0], (51,))
    problems = [geometric(discount=beta) for beta in (0.02, 0.05)]
    lanes = hjb.solve_batch(problems, grid)
    for problem, lane in zip(problems, lanes, strict=True):
        np.testing.assert_allclose(lane.box_error, hjb.solve(problem, grid).box_error, rtol=1e-9)
    lanes[0].save(tmp_path / "lane.npz")
    np.testing.assert_array_equal(hjb.load(tmp_path / "lane.npz").box_error, lanes[0].box_error)
    assert f"box error        about {np.max(lanes[0].box_error):.3g}" in str(lanes[0])
    assert "box_error" in lanes[0].to_xarray()
