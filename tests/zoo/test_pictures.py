"""What the pictures of ready problems show, in numbers: their paths, and the values that are drawn."""

import jax
import numpy as np
import pytest
from pictures import hatched_nodes
from pictures import pictures as plotting

import hjbjax as hjb
from hjbjax import Grid, Problem, Solution, Status, simulate, zoo
from hjbjax.cli import run_folder
from hjbjax.feedback.path import PathStatus, join_paths


def exact_solution(entry, **parameters):
    """A Solution with the exact value at the nodes, what is held in the target, and controls of zero outside of it."""
    problem, grid = entry.build(**parameters)
    parameters.pop("shape", None)
    x = grid.nodes().reshape(-1, grid.ndim)
    with jax.enable_x64(True):
        held = problem.exit_cost if callable(problem.exit_cost) else lambda x: 0.0
        value, level, held = (
            np.asarray(jax.vmap(f)(x)).reshape(grid.shape) for f in (entry.exact(**parameters), problem.target, held)
        )
    value = np.where(level <= 0, held, value)
    controls = 0 if problem.controls is None else problem.controls.dim
    policy = np.where(level[..., None] <= 0, np.nan, np.zeros((*grid.shape, controls)))
    return problem, Solution(grid, value, policy, code=Status.CONVERGED)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:simulate. the path costs")  # the policy is not that of V
def test_the_picture_of_the_moon_landing_coasts_and_burns_and_stands_on_the_ground(tmp_path):
    entry = zoo.catalogue["moon-landing"]
    problem, solution = exact_solution(entry)
    *_, (name, path) = run_folder.make(
        problem, solution, tmp_path, start=entry.start, duration=entry.duration, finish=entry.finish()
    )
    assert name == "trajectory.png"
    assert (tmp_path / name).stat().st_size > 10_000
    height, velocity, mass = path.states[-1]
    fuel = float(entry.exact()(np.array(entry.start)))
    assert (abs(height) < 0.01, abs(velocity) < 1e-6) == (True, True)
    assert path.status == PathStatus.TARGET
    assert path.cost == pytest.approx(1 - mass, abs=1e-6)
    assert fuel - 1e-3 < path.cost < 1.05 * fuel  # sampled along the edge of what can land
    ignition, burn = zoo.Lander().ignition(np.array(entry.start))
    thrust = path.controls[:, 0]
    assert not thrust[path.times[:-1] < 0.9 * float(ignition)].any()
    assert thrust[path.times[:-1] > 1.1 * float(ignition)].mean() > 1.7  # of 2
    assert path.times[-1] == path.reached == pytest.approx(float(ignition + burn), rel=0.05)


@pytest.mark.slow
def test_the_burn_alone_ends_on_the_ground_with_the_least_fuel():
    lander = zoo.Lander()
    start = np.array([1.0, 0.0, 1.0])
    ignition, burn = (float(each) for each in lander.ignition(start))
    problem, feedback = zoo.moon_landing_burn()
    path = simulate(problem, feedback, [1 - 0.5 * ignition**2, -ignition, 1.0], 2.0, rtol=1e-9, atol=1e-10)
    assert path.reached == pytest.approx(burn, abs=1e-5)
    assert path.cost == pytest.approx(float(lander.fuel(start)), abs=1e-5)
    np.testing.assert_allclose(path.states[-1, :2], 0, atol=1e-5)


def test_no_negative_time_is_drawn_outside_the_ball():
    problem, solution = exact_solution(zoo.catalogue["brownian-ball"], shape=(21, 21))
    assert solution.value.min() < -0.4
    picture = plotting.value(solution, target=problem.target)
    drawn = picture[0]
    radius = np.linalg.norm(solution.grid.nodes(), axis=-1)
    inside = radius < 1 - 1e-6
    assert drawn.get_clim()[0] > 0
    outside = hatched_nodes(picture, solution.grid)
    assert outside[radius > 1 + 1e-3].all()
    assert not outside[inside].any()
    assert drawn.axes.get_legend().get_texts()[0].get_text() == "target"
    everything = plotting.value(solution)[0].get_array()
    assert everything.min() < -0.4
    infinite = Solution(solution.grid, np.where(inside, np.inf, solution.value), solution.policy)
    blank = plotting.value(infinite, target=problem.target)
    assert [text.get_text() for text in blank.ax.get_legend().get_texts()] == ["V = ∞", "target"]
    assert hatched_nodes(blank, solution.grid)[inside].all()


def test_a_value_over_one_axis_is_drawn_up_to_its_ends():
    problem, solution = exact_solution(zoo.catalogue["brownian-exit"], shape=(21,))
    drawn = plotting.value(solution, target=problem.target)
    np.testing.assert_allclose(drawn[0].get_ydata(), 1 - np.linspace(-1, 1, 21) ** 2, atol=1e-12)


def test_a_constant_control_is_drawn_level_and_not_as_its_rounding():
    grid = Grid([0.0], [1.0], (11,))
    wiggle = 0.5 + 1e-5 * np.sin(7 * grid.nodes())
    (line,) = plotting.policy(Solution(grid, wiggle[:, 0], wiggle))
    lo, hi = line.axes.get_ylim()
    assert lo < 0.3
    assert hi > 0.7
    (line,) = plotting.policy(Solution(grid, wiggle[:, 0], -wiggle))
    assert line.axes.get_ylim() == pytest.approx((-0.75, -0.25), abs=1e-4)


@pytest.mark.slow
def test_joined_paths_discount_what_comes_later():
    problem = Problem(lambda x, u: 0 * x + 1, lambda x, u: 1.0, discount=0.5)
    first, then = (simulate(problem, None, [x0], 2.0, steps=4) for x0 in (0.0, 2.0))
    whole = join_paths(first, then, 0.5)
    assert whole.cost == pytest.approx(simulate(problem, None, [0.0], 4.0, steps=8).cost, abs=1e-7)
    np.testing.assert_allclose(whole.times, np.linspace(0, 4, 9))
    np.testing.assert_allclose(whole.states[:, 0], whole.times, atol=1e-9)
    assert whole.controls.shape == (8, 0)
    assert whole.reached is None
    assert "from there ran for the whole duration at t = 4" in whole.message


def test_two_states_with_modes_have_one_panel_per_mode():
    problem = Problem(
        lambda x, u, mode: u - x, lambda x, u, mode: (1.0 + mode) * x @ x, hjb.Box([-1.0, -1.0], [1.0, 1.0]),
        discount=1.0, modes=hjb.Modes(("calm", "wild"), rates=[[0, 1], [1, 0]]), target=lambda x, mode: x @ x - 0.1,
    )  # fmt: skip
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (11, 11))
    solution = hjb.solve(problem, grid, scheme=hjb.Upwind(), tol=1e-3)
    figure = run_folder.plot_values(problem, solution, {}, False)
    titles = [ax.get_title("right") for ax in figure.axes if ax.get_title("right")]
    assert titles == ["mode calm", "mode wild"]
    figure = run_folder.plot_policies(problem, solution, {}, False)
    titles = [ax.get_title("right") for ax in figure.axes if ax.get_title("right")]
    assert titles == ["mode calm", "mode wild"] * 2
    for mode in (1, "wild"):
        assert plotting.value(solution, fixed={"mode": mode}).ax.get_title("right") == "mode wild"
    path = simulate(problem, solution, [0.9, 0.5], 0.1, steps=2, mode="wild", key=0)
    assert plotting.closed_loop(solution, path).figure.axes[0].get_title("right") == "mode wild"
    report = run_folder.json_report(solution, None, [])
    assert report["modes"] == ["calm", "wild"]
    assert report["shape"] == [2, 11, 11]


@pytest.mark.slow
def test_the_files_of_a_problem_with_modes(tmp_path):
    entry = zoo.catalogue["thermostat"]
    problem, grid = entry.build(shape=(51,))
    solution = hjb.solve(problem, grid)
    *_, (name, path) = run_folder.make(
        problem, solution, tmp_path, start=entry.start, duration=2.0, mode=entry.mode
    )  # fmt: skip
    assert name == "trajectory.png"
    assert path.modes[0] == 1  # it is cold, so the heater is switched on at once
    assert sorted(file.name for file in tmp_path.iterdir()) == ["solution.npz", "trajectory.png", "value.png"]
    assert hjb.load(tmp_path / "solution.npz").grid.modes == ("off", "on")
