"""``grid_error`` of marches: the error of the spacing and of the step in time, against closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.solvers import horizon_samples

SMALL = 1e-3  # of the range of V: smaller errors do not count, as in the benchmark of estimates
UNIT = hjb.Box([-1.0], [1.0])
TIMES = [0.0, 0.5]


@dataclasses.dataclass(frozen=True)
class Case:
    """A problem with a known value: ``exact(t, x)`` of coordinates (N,) at the horizon 1."""

    problem: hjb.Problem
    grid: hjb.Grid
    exact: object
    walls: bool = False


def line(lo, hi, count, **options):
    return hjb.Grid([lo], [hi], (count,), **options)


def waiting(t, x):
    return quad(lambda s: np.sin(3 * s) * np.exp(-2 * (s - t)), t, 1)[0] * (1 + x**2)


def from_moving_obstacle(t, x):
    later = np.linspace(t, 1, 801)
    ways = [np.min(np.abs(x[:, None] + side * (later - t) + 1.5 - 2 * later) - 0.5, axis=1) for side in (-1, 1)]
    return -np.maximum(*ways)


CASES = {
    "heat": Case(
        hjb.Problem(lambda x, u: 0 * x, None, noise=0.7, terminal_cost=lambda x: jnp.cos(2 * x[0])),
        line(-np.pi, np.pi, 40, periodic=(True,)),
        lambda t, x: np.cos(2 * x) * np.exp(-0.98 * (1 - t)),
    ),
    "heat with walls": Case(
        hjb.Problem(lambda x, u: 0 * x, None, noise=0.4, terminal_cost=lambda x: jnp.cos(jnp.pi * x[0])),
        line(0.0, 1.0, 21),
        lambda t, x: np.cos(np.pi * x) * np.exp(-0.08 * np.pi**2 * (1 - t)),
        walls=True,
    ),
    "controlled heat": Case(
        hjb.Problem(lambda x, u: u, lambda x, u: 0.5 * u @ u, hjb.Box([-6.0], [6.0]), noise=1.0,
                    terminal_cost=lambda x: 0.5 * x @ x),
        line(-2.0, 2.0, 41, edges="open"),
        lambda t, x: x**2 / 2 / (2 - t) + 0.5 * np.log(2 - t),
    ),
    "Riccati": Case(
        hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-5.0], [5.0])),
        line(-2.0, 2.0, 41),
        lambda t, x: np.tanh(1 - t) * x**2,
    ),
    "discounting": Case(
        hjb.Problem(lambda x, u: 0 * x, None, discount=1.0, terminal_cost=lambda x: x @ x),
        line(-1.0, 1.0, 41),
        lambda t, x: np.exp(t - 1) * x**2,
    ),
    "cost of the time": Case(
        hjb.Problem(lambda t, x, u: 0 * x, lambda t, x, u: jnp.sin(3 * t) * (1 + x[0] ** 2), discount=2.0,
                    time_dependent=True),
        line(-1.0, 1.0, 41),
        waiting,
    ),
    "tube": Case(
        hjb.avoid(lambda x, u, d: d, hjb.Box([-0.5], [0.5]), lambda x: jnp.abs(x[0]) - 0.3, disturbances=UNIT),
        line(-2.0, 2.0, 81),
        lambda t, x: 0.3 - np.maximum(np.abs(x) - (1 - t), 0),
    ),
    "moving obstacle": Case(
        hjb.avoid(lambda t, x, u: u, UNIT, lambda t, x: jnp.abs(x[0] + 1.5 - 2 * t) - 0.5, time_dependent=True),
        line(-4.0, 3.0, 71, edges="linear"),
        from_moving_obstacle,
    ),
    "jump": Case(
        hjb.Problem(lambda x, u: 0 * x + 1, None, terminal_cost=lambda x: jnp.where(x[0] > 0.123, 1.0, 0.0)),
        line(-2.0, 2.0, 81, edges="open"),
        lambda t, x: np.where(x + 1 - t > 0.123, 1.0, 0.0),
    ),
    # the kink is 0.3 h beside a node, and V = 0 at every state from which it can be reached
    "valley between nodes": Case(
        hjb.Problem(lambda x, u: u, None, UNIT, terminal_cost=lambda x: jnp.abs(x[0] - 0.115)),
        line(-2.0, 2.0, 81, edges="open"),
        lambda t, x: np.maximum(np.abs(x - 0.115) - (1 - t), 0),
    ),
    # the jump is just before a node, and the way to its lower side 0.98 h shorter than on the grid
    "way to a jump": Case(
        hjb.Problem(lambda x, u: u, lambda x, u: 0.3 * jnp.abs(u[0]), UNIT,
                    terminal_cost=lambda x: jnp.where(x[0] > 0.149, 1.0, 0.0)),
        line(-2.0, 2.0, 81, edges="open"),
        lambda t, x: np.where(x > 1.149 - t, 1.0, 0.3 * np.maximum(x - 0.149, 0)),
    ),
    "jump with noise": Case(
        hjb.Problem(lambda x, u: 0 * x, None, noise=0.3, terminal_cost=lambda x: jnp.where(x[0] > 0.123, 1.0, 0.0)),
        line(-2.0, 2.0, 81),
        lambda t, x: norm.cdf((x - 0.123) / 0.3 / np.sqrt(1 - t)),
    ),
}  # fmt: skip
WAYS = {
    "default": {},
    "upwind": {"scheme": hjb.Upwind()},
    "weno": {"scheme": hjb.Weno5()},
    "euler": {"method": hjb.Explicit(1)},
    "four stages": {"method": hjb.Explicit(4)},
    "implicit": {"method": hjb.Implicit()},
}
QUICK = [("Riccati", "default"), ("tube", "default")]
CHOSEN = [
    pytest.param(name, way, marks=[] if (name, way) in QUICK else pytest.mark.slow) for name in CASES for way in WAYS
]


@pytest.mark.filterwarnings("ignore:the grid is coarse", "ignore:the box decides", "ignore:.*Isaacs condition")
@pytest.mark.parametrize(("name", "way"), CHOSEN)
def test_the_error_is_at_most_three_times_the_estimate(name, way):
    case = CASES[name]
    solution = hjb.march(case.problem, case.grid, 1.0, times=TIMES, **WAYS[way])
    assert solution.grid_error.shape == solution.value.shape
    x, estimate = case.grid.axis(0), solution.grid_error
    if solution.box_error is not None and not case.walls:
        estimate = estimate + solution.box_error
    for i, t in enumerate(TIMES):
        error = np.abs(solution.value[i] - case.exact(t, x))
        counts = error <= 3 * estimate[i] + SMALL * np.ptp(solution.value)
        assert np.mean(counts) >= 0.95


@pytest.mark.parametrize("way", ["default", "implicit"])
def test_the_estimate_has_the_size_of_the_error(way):
    """The error of implicit steps is that of the spacing and of the time alike."""
    case = CASES["Riccati"]
    step = {"step": 0.1} if way == "implicit" else {}
    solution = hjb.march(case.problem, case.grid, 1.0, times=TIMES, **WAYS[way], **step)
    for i, t in enumerate(TIMES):
        error = np.max(np.abs(solution.value[i] - case.exact(t, case.grid.axis(0))))
        assert error / 3 < np.max(solution.grid_error[i]) < 3 * error


def test_times_between_which_there_are_few_steps():
    """The coarse march keeps every second one, or its steps could not be longer."""
    case, times = CASES["Riccati"], np.linspace(0, 1, 51)
    solution = hjb.march(case.problem, case.grid, 1.0, times=times, method=hjb.Implicit(), step=0.02)
    assert solution.steps == 50
    error = np.abs(solution.value - np.array([case.exact(t, case.grid.axis(0)) for t in times]))
    assert np.mean(error <= 3 * solution.grid_error + SMALL * np.ptp(solution.value)) > 0.95
    assert np.max(solution.grid_error) < 3 * np.max(error)
    assert not np.any(solution.grid_error[-1])


def test_a_jump_between_times_of_the_coarse_march():
    """Close to the horizon there are too few steps for a time of its own, and the next one has the jump elsewhere."""
    case, times = CASES["jump"], [0.0, 0.5, 0.9]
    with pytest.warns(hjb.SolveWarning, match="the grid is coarse"):
        solution = hjb.march(case.problem, case.grid, 1.0, times=times, scheme=hjb.Upwind())
    for i, t in enumerate(times):
        error = np.abs(solution.value[i] - case.exact(t, case.grid.axis(0)))
        assert np.max(error) > 0.1
        assert np.all(error <= 3 * solution.grid_error[i] + 0.02)


def test_a_minimum_between_nodes_costs_its_height():
    """The node next to the kink of the terminal cost is 0.3 h away, on the coarser grid too."""
    case = CASES["valley between nodes"]
    solution = hjb.march(case.problem, case.grid, 1.0, scheme=hjb.Upwind())
    x = case.grid.axis(0)
    flat = np.abs(x - 0.115) < 0.5
    error = solution.value[0][flat]
    np.testing.assert_allclose(error, 0.015, rtol=0.01)
    assert np.all(solution.grid_error[0][flat] >= error / 3)
    assert np.all(solution.grid_error[0][flat] <= 3 * error)


def test_other_samples_hold_what_a_cell_hides():
    with jax.enable_x64(True):
        assert horizon_samples.other_samples(*_samples(lambda x: jnp.cos(2 * x[0]) + x[0] ** 3)) is None
        changed = horizon_samples.other_samples(*_samples(lambda x: jnp.abs(x[0] - 0.13)))
    x = np.linspace(-2, 2, 41)
    # the interpolant of |x − 0.13| is 0.03 above the kink between 0.1 and 0.2, for twice the spacing
    np.testing.assert_allclose(changed, np.abs(x - 0.13) - 0.06 * np.isin(np.arange(41), [21, 22]), atol=1e-6)


def _samples(terminal_cost):
    """The arguments of ``other_samples`` on 41 nodes."""
    grid = line(-2.0, 2.0, 81)
    task = hjb.Problem(lambda x, u: u, None, UNIT, terminal_cost=terminal_cost)
    return Discretisation(task, grid, hjb.Upwind(), np.dtype(float)), None, line(-2.0, 2.0, 41), 4.0


def test_no_estimate_has_a_reason():
    small = hjb.march(CASES["Riccati"].problem, line(-2.0, 2.0, 9), 1.0)
    assert small.grid_error is None
    assert "intervals per axis" in small.stats["grid_error"]
    assert small.stats["grid_error"] in str(small)
    single = hjb.march(CASES["discounting"].problem, line(-1.0, 1.0, 41), 1.0, method=hjb.Implicit(), step=2.0)
    assert "one step" in single.stats["grid_error"]


def test_files_and_the_screen_have_it(tmp_path):
    case = CASES["Riccati"]
    solution = hjb.march(case.problem, case.grid, 1.0, times=TIMES)
    solution.save(tmp_path / "march.npz")
    np.testing.assert_array_equal(hjb.load(tmp_path / "march.npz").grid_error, solution.grid_error)
    assert f"grid error       about {np.max(solution.grid_error):.3g}" in str(solution)


def test_a_coarse_march_warns():
    case = CASES["jump"]
    with pytest.warns(hjb.SolveWarning, match="above a tenth of the range of V at .* of the nodes"):
        hjb.march(case.problem, line(-2.0, 2.0, 41, edges="open"), 1.0)


@pytest.mark.parametrize("way", ["default", pytest.param("upwind", marks=pytest.mark.slow), "weno"])
@pytest.mark.parametrize("edges", [pytest.param("open", marks=pytest.mark.slow), "linear"])
def test_an_end_that_optimal_paths_leave_by_has_an_error(edges, way):
    """x' = u, |u| ≤ 1, and a terminal cost ψ that falls to the right: V = ψ(x + T − t), also beyond the end."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: 0.0, UNIT, terminal_cost=lambda x: 1 / (1 + jnp.exp(3 * x[0])))
    grid = line(-1.0, 1.0, 41, edges=edges)
    solution = hjb.march(problem, grid, 0.5, **WAYS[way])
    error = np.abs(solution.value[0] - 1 / (1 + np.exp(3 * (grid.axis(0) + 0.5))))
    assert solution.box_error is not None, solution.stats["box_error"]
    estimate = solution.grid_error[0] + solution.box_error[0]
    wrong = error > 0.01 * np.ptp(solution.value[0])
    assert np.any(wrong)
    assert np.all(estimate[wrong] > error[wrong] / 3)
