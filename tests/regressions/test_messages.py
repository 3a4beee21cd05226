"""What is said where something is wrong: the argument, the value, what is wanted, the place."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import hjbjax as hjb
from hjbjax.feedback.path import Path
from hjbjax.solution.status import Status

U = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([-1.0], [1.0], (21,))


ANSWER = hjb.Solution(GRID, GRID.nodes()[:, 0] ** 2, -GRID.nodes())
PATH = Path(np.zeros(2), np.zeros((2, 1)), np.zeros((1, 1)), None, 0.0, None, 0, 1)


PLANE = hjb.Solution(hjb.Grid([-1.0] * 2, [1.0] * 2, (3, 3)), np.zeros((3, 3)), None)
MARCHED = hjb.Solution(GRID, np.zeros((2, 21)), None, times=np.array([0.0, 1.0]))


def still(x):
    return 0 * x


def written(x, u):
    rates = np.zeros(2)
    rates[0], rates[1] = x[1], u[0]
    return rates


def cost(x, u):
    return x @ x + u @ u


def problem(drift=lambda x, u: u, cost=cost, **changes):
    return hjb.Problem(drift, cost, U, **({"discount": 1.0} | changes))


# --- where a NaN appeared ---


def between(x, u):
    """NaN for a control that no survey tries, wanted where x > .3."""
    return jnp.where((jnp.abs(u[0] + 0.613) < 0.1) & (x[0] > 0.3), jnp.nan, (u[0] + 0.613) ** 2)


@pytest.mark.parametrize(
    "method", [None, hjb.ValueIteration(), pytest.param(hjb.ValueIteration(policy=False), marks=pytest.mark.slow)]
)
def test_a_nan_on_the_way_is_placed(method):
    solution = hjb.solve(problem(cost=between), GRID, method=method, throw=False, scheme=hjb.Upwind())
    assert solution.status is Status.NONFINITE
    assert "NaN or infinity appeared at the guess and the last finite value is kept" in solution.message
    assert "at 7 of 21 nodes, first at node (14,), x = [0.4]" in solution.message
    assert np.all(np.isfinite(solution.value))


def test_a_nan_in_a_later_step_is_placed():
    """x² from a guess of 1e200 overflows when the policy is improved."""
    solution = hjb.solve(problem(), GRID, guess=np.linspace(0, 1e200, 21), throw=False, scheme=hjb.Upwind())
    assert solution.status is Status.NONFINITE
    assert "appeared at the guess" in solution.message or "appeared in step" in solution.message
    assert "first at node (" in solution.message


@pytest.mark.parametrize("discount", [1e-300, 5e-324])
def test_a_discount_that_is_next_to_nothing(discount):
    solution = hjb.solve(problem(discount=discount), GRID, throw=False, scheme=hjb.Upwind())
    if solution.status is Status.NONFINITE:
        assert f"discount = {discount:.3g} is so small" in solution.message
        assert "check drift" not in solution.message
    assert solution.status is not Status.CONVERGED or solution.error <= 1e-3


# --- arguments ---


@pytest.mark.parametrize("given", [problem(), None, 3])
def test_a_batch_is_a_list(given):
    with pytest.raises(TypeError, match=r"solve_batch: got .*; wanted a list of problems, such as \[problem\]"):
        hjb.solve_batch(given, GRID, scheme=hjb.Upwind())


def test_no_node_in_the_middle():
    far = hjb.Grid([-3.0, -2.0], [3.0, 2.0], (601, 600), periodic=(True, False))
    move = lambda x, u: jnp.stack([x[1], jnp.sin(x[0]) + u[0]])  # noqa: E731
    small = hjb.Grid(far.lo, far.hi, (9, 8), far.periodic)
    with pytest.raises(ValueError, match=r"(?s)no finite solution.*middle of the box.*shape=\(8, 7\) puts one there"):
        hjb.solve(problem(move, discount=0.0), small, scheme=hjb.Upwind())


@pytest.mark.parametrize(
    ("lo", "hi", "count"), [(1e16, 1e16 + 4, 101), (-1.0, -1.0 + 4e-16, 3), (0.0, 5e-324, 3), (1e9, 1e9 + 1e-4, 1001)]
)
def test_nodes_that_coincide(lo, hi, count):
    with pytest.raises(ValueError, match="axis 1 has .* points between .* rounding of its coordinates in float64"):
        hjb.Grid([0.0, lo], [1.0, hi], (3, count))


def test_nodes_that_coincide_when_stretched_or_in_single_precision():
    with pytest.raises(ValueError, match="rounding of its coordinates"):
        hjb.Grid([1e6], [1e6 + 1], (100_001,), stretch=[hjb.Sinh(30.0)])
    fine = hjb.Grid([1e6], [1e6 + 1], (101,))
    doors = (
        lambda: hjb.solve(problem(), fine, dtype="float32", scheme=hjb.Upwind()),
        lambda: hjb.march(problem(), fine, 1.0, dtype="float32", scheme=hjb.Upwind(split=True)),
        lambda: hjb.solve_batch([problem()], fine, dtype="float32", scheme=hjb.Upwind()),
    )
    for door in doors:
        with pytest.raises(ValueError, match="rounding of its coordinates in float32"):
            door()


def test_ordinary_grids_pass():
    hjb.Grid([1e5], [1e5 + 1], (1001,))
    hjb.Grid([-1e-12], [1e-12], (1001,))
    hjb.Grid([-1e30], [1e30], (1001,), stretch=[hjb.Sinh(8.0)])


# --- words that are nearly right ---


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda: hjb.Problem(lambda x, u: u, cots=cost), r"Problem\(\) got .* 'cots': did you mean cost\?"),
        (lambda: hjb.Problem(lambda x, u: u, running_cost=cost), r"'running_cost': did you mean cost\?"),
        (lambda: hjb.Grid(low=[-1.0], hi=[1.0], shape=(3,)), r"Grid\(\) got .* 'low': did you mean lo\?"),
        (lambda: hjb.solve(problem(), GRID, toll=1e-3), r"solve\(\) got .* 'toll': did you mean tol\?"),
        (lambda: hjb.march(problem(), GRID, 1.0, tymes=[0.0]), r"march\(\) got .* 'tymes': did you mean times\?"),
        (lambda: hjb.simulate(problem(), lambda x: -x, [0.5], durations=1.0), r"did you mean duration\?"),
        (lambda: hjb.pontryagin(problem(), [0.5], horizont=1.0), r"did you mean horizon\?"),
        (lambda: hjb.Box([-1.0], [1.0], xyzzy=1), r"Box\(\) got .* 'xyzzy': wanted one of hi, lo$"),
        # as other packages say it
        (lambda: hjb.Problem(dynamics=lambda x, u: u), r"'dynamics': did you mean drift\?"),
        (lambda: hjb.solve(problem(), GRID, tolerance=1e-3), r"'tolerance': did you mean tol\?"),
        (lambda: hjb.march(problem(), GRID, T=1.0), r"march\(\) got .* 'T': did you mean horizon\?"),
        (lambda: hjb.Grid([-1.0], [1.0], num=(3,)), r"'num': did you mean shape\?"),
        (lambda: hjb.reach(lambda x, u: u, U, goal=lambda x: x[0]), r"reach\(\) got .* 'goal': did you mean target\?"),
        (lambda: hjb.filtering.zakai(problem(), None, grd=GRID), r"zakai\(\) got .* 'grd': did you mean grid\?"),
        (lambda: hjb.plotting.value(None, axs=1), r"got solution = None"),
        (lambda: hjb.plotting.value(ANSWER, axs=1), r"value\(\) got .* 'axs': did you mean ax\?"),
        (lambda: hjb.plotting.closed_loop(ANSWER, PATH, fig=1), r"'fig': did you mean figure\?"),
        (lambda: hjb.geometry.affine_fields(lambda x, u: u, input=1), r"affine_fields\(\) .*did you mean inputs\?"),
        (lambda: hjb.geometry.relative_degree(None, None, None, [0.0], sample=3), r"did you mean samples\?"),
        (lambda: hjb.geometry.reachability_distribution(None, still, [0.0], dept=1), r"did you mean depth\?"),
        (lambda: hjb.stability.brockett_check(None, still, [0.0], tolerence=1), r"did you mean tolerance\?"),
        (lambda: hjb.march(problem(), GRID, 1.0, save_at=[0.0]), r"'save_at': did you mean times\?"),
        (lambda: hjb.plotting.animation(MARCHED, intervall=9), r"animation\(\) .*did you mean interval\?"),
        (lambda: hjb.plotting.animation(MARCHED, hjb.plotting.value, level=9), r"did you mean levels\?"),
    ],
)
def test_a_misspelt_keyword_is_told_from_the_right_one(ask, said):
    with pytest.raises(TypeError, match=said):
        ask()


def test_a_misspelt_name_of_the_package_is_told_from_the_right_one():
    with pytest.raises(AttributeError, match="has no attribute 'slove'") as caught:
        hjb.slove  # noqa: B018
    assert (caught.value.name, caught.value.obj) == ("slove", hjb)  # of which Python makes "did you mean 'solve'?"
    assert "solve" in dir(hjb)
    assert not [name for name in dir(hjb) if name not in hjb.__all__]


def test_bounds_without_a_box_are_told_how_to_become_one():
    with pytest.raises(TypeError, match=r"Problem.controls: got \(-1.0, 1.0\), wanted .*: hjb.Box\(-1.0, 1.0\)$"):
        hjb.Problem(lambda x, u: u, cost, (-1.0, 1.0))
    np.testing.assert_array_equal(hjb.Box(-1.0, 1.0).hi, [1.0])
    assert hjb.Box(-1.0, 1.0).dim == 1
    with pytest.raises(ValueError, match=r"got lo of shape \(\) and hi of shape \(1,\)"):
        hjb.Box(-1.0, [1.0])
    with pytest.raises(TypeError, match=r"wanted both bounds, as in hjb.Box\(-2.0, 1.0\)$"):
        hjb.Box((-2.0, 1.0))


@pytest.mark.parametrize(
    ("drift", "cure"),
    [
        (lambda x, u: jnp.stack([x[1], u]), r"u\[0\] is the number$"),
        (lambda x, u: jnp.stack([x[:, 1], u[:, 0]], -1), r"x is one state, without an axis for a batch"),
        (lambda x, u: np.stack([x[1], u[0]]), "use jnp instead of np"),
        (lambda x, u: written(x, u), r"setting an array element[\s\S]*use jnp.stack\(\[...\]\)$"),
    ],
)
def test_a_drift_of_the_wrong_shape_or_kind_is_told_what_to_change(drift, cure):
    with pytest.raises(ValueError, match=rf"^drift\(x, u\) [\s\S]*{cure}") as caught:
        hjb.solve(problem(drift), hjb.Grid([-1.0] * 2, [1.0] * 2, (11, 11)))
    assert len(str(caught.value).splitlines()) <= 6
    with pytest.raises(ValueError, match=rf"^simulate: drift [\s\S]*{cure}"):
        hjb.simulate(problem(drift), lambda x: -x[:1], [0.5, 0.5], 1.0)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda V: hjb.plotting.value(PLANE, ax=Figure().add_subplot(), target=V), r"^target\(x\) "),
        (lambda V: hjb.lyapunov_check(V, lambda x: -x, hjb.Box([-1.0] * 2, [1.0] * 2)), r"^V\(x\) "),
        (lambda V: hjb.simulate(problem(), lambda x: [V(x)], [0.5], 1.0), "^simulate: feedback "),
        (lambda V: hjb.filtering.ExtendedKalman(problem(), lambda x: V(x)[None], [0.0], [1.0]), r"h\(x\) "),
    ],
    ids=["target", "Lyapunov", "feedback", "measurement"],
)
def test_other_functions_of_the_user_are_told_what_to_change_too(ask, said):
    for function, cure in (
        (lambda x: np.hypot(x[0], x[0]), "use jnp instead of np"),
        (lambda x: math.exp(x[0]), "needs a traced value as a number: use jnp instead of np, math"),
        (lambda x: x[0] if x[0] > 0 else -x[0], "use jnp.where"),
    ):
        with pytest.raises(ValueError, match=said + r"[\s\S]*" + cure) as caught:
            ask(function)
        assert len(str(caught.value).splitlines()) <= 6


def test_functions_of_another_shape_are_refused_where_nothing_else_would_tell():
    """A rate of one state beside two was broadcast, and a truth value ≤ 0 is outside where one means inside."""
    square = hjb.Box([-1.0] * 2, [1.0] * 2)
    with pytest.raises(ValueError, match=r"f\(x\) returned shape \(1,\), expected \(2,\) for one state"):
        hjb.lyapunov_check(lambda x: x @ x, lambda x: -x[:1], square)
    with pytest.raises(ValueError, match=r"V\(t, x\) returned shape \(2,\), expected one number"):
        hjb.lyapunov_check(lambda t, x: x, lambda t, x: -x, square, times=[0.0, 1.0])
    with pytest.raises(ValueError, match=r"a vector field returned shape \(1,\), expected \(2,\)"):
        hjb.geometry.lie_bracket(lambda x: x, lambda x: x[:1])(jnp.zeros(2))
    for target, returned in ((lambda x: x, r"shape \(2,\)"), (lambda x: x[0] < 0, "bool numbers")):
        with pytest.raises(ValueError, match=rf"target\(x\) returned {returned}, expected one number"):
            hjb.plotting.value(PLANE, ax=Figure().add_subplot(), target=target)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda: hjb.simulate(ANSWER, problem(), [0.5], 1.0), "simulate: got Solution, wanted a Problem, and then"),
        (lambda: hjb.estimate(GRID, problem()), "estimate: got Grid, Problem; wanted a Problem and a Grid"),
        (lambda: hjb.chain.generator(GRID, problem()), "generator: got Grid, Problem; wanted a Problem and a Grid"),
        (lambda: hjb.attenuation(GRID, 1.0, U), "attenuation: got Grid, wanted a Problem"),
        (lambda: hjb.solve_batch([problem(), 3], GRID), "solve_batch: lane 1 is 3; wanted only problems"),
        (lambda: hjb.Grid([0.0], [1.0], (3,), stretch="sinh"), "Grid.stretch: got 'sinh', wanted one entry per axis"),
        (
            lambda: hjb.Grid([0.0], [1.0], (3,), stretch=hjb.Sinh(3.0)),
            r"wanted one entry per axis, as in \(hjb.Sinh\(3.0\)",
        ),
        (lambda: hjb.Grid([0.0], [1.0], (3,), names=None), "Grid.names: got None, wanted one name per axis"),
        (
            lambda: hjb.hinf_level(lambda gamma: problem(), U, 0.1, 8.0),
            "hinf_level: got Box for the grid, wanted a Grid",
        ),
        (lambda: hjb.reach(written, U, None), "reach: target: got None, wanted a function of one state"),
        (lambda: hjb.avoid(written, U, None), "avoid: obstacle: got None, wanted a function of one state"),
        (lambda: hjb.reach_avoid(written, U, still, None), "reach_avoid: obstacle: got None, wanted a function"),
    ],
)
def test_arguments_that_changed_places_are_told(ask, said):
    with pytest.raises(TypeError, match=said):
        ask()


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda: hjb.simulate(problem(), still, [0.5], 1.0, steps=10**13), "simulate: steps = 10+, wanted at most 1e7"),
        (lambda: hjb.simulate(problem(), still, [0.5], 1.0, hold=1e-13), "wanted at most 1e7"),
        (lambda: robust(lambda x: x), r"robust_filter: initial\(x\) returned shape \(1,\), expected one number"),
        (lambda: zakai(lambda x: x), r"GridFilter: initial_density\(x\) returned shape \(1,\), expected one number"),
    ],
)
def test_what_numpy_and_jax_would_say_is_said_in_the_words_of_the_user(ask, said):
    with pytest.raises(ValueError, match=said):
        ask()


def robust(initial):
    plant = hjb.Problem(lambda x, u: u - x, lambda x, u: x @ x, U, noise=0.5)
    return hjb.filtering.robust_filter(plant, still, GRID, np.zeros((2, 1)), 0.1, initial, gamma=2.0)


def zakai(density):
    plant = hjb.Problem(lambda x, u: -x, None, None, noise=0.5)
    return hjb.filtering.zakai(plant, still, GRID, np.zeros((2, 1)), 0.1, density)


def test_a_march_refuses_its_arguments_before_it_looks_at_the_problem():
    with pytest.raises(ValueError, match="march: inner = -1; wanted the fraction"):
        hjb.march(problem(lambda x, u: jnp.zeros(3)), GRID, 1.0, inner=-1)


def test_a_batch_names_the_lane_of_a_refusal():
    with pytest.raises(ValueError, match=r"lane 1: drift\(x, u\) returned shape \(3,\), expected \(1,\)"):
        hjb.solve_batch([problem(), problem(lambda x, u: jnp.zeros(3))], GRID, scheme=hjb.Upwind())


def test_a_vector_field_in_numpy_is_told_what_to_change():
    with pytest.raises(ValueError, match="passes a traced value to NumPy: use jnp instead of np"):
        hjb.geometry.lie_bracket(lambda x: np.array([x[1], 0.0]), lambda x: x)(jnp.zeros(2))


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda: hjb.plotting.value(problem()), "value: got solution = Problem.*wanted the Solution of solve or march"),
        (lambda: hjb.plotting.trajectory(ANSWER), "trajectory: got path = Solution.*wanted the Path of simulate"),
        (lambda: hjb.plotting.closed_loop(PATH, ANSWER), "closed_loop: got solution = Path"),
        (lambda: hjb.plotting.value(ANSWER, ax=Figure()), r"a figure as ax, wanted axes on it: ax=figure.add_subplot"),
        (lambda: hjb.plotting.policy(ANSWER, ax=Figure().subplots(1, 2)), r"got 2 axes as ax.*as in ax=ax\[0\]"),
        (lambda: hjb.plotting.residuals(PATH), "residuals: got solution = Path.*wanted the Solution of solve"),
        (lambda: hjb.plotting.residuals(ANSWER, ax=Figure()), "residuals: got a figure as ax"),
        (lambda: hjb.plotting.convergence(ANSWER), "convergence: got study = Solution.*result of convergence_study"),
        (lambda: hjb.plotting.estimates(PATH), "estimates: got path = Path.*wanted the OutputPath of simulate_output"),
        (lambda: hjb.plotting.trajectory(PATH, grid=ANSWER), "trajectory: got grid = Solution.*wanted a Grid"),
        (lambda: hjb.plotting.animation(MARCHED, "value"), "got draw = 'value', wanted a function"),
    ],
)
def test_what_cannot_be_drawn_is_told_from_what_can(ask, said):
    with pytest.raises(TypeError, match=said):
        ask()


def test_a_path_is_one_line_and_a_missing_file_is_what_python_calls_it(tmp_path):
    path = hjb.simulate(problem(), lambda x: -x, [0.5], 1.0)
    assert repr(path) == "Path(DURATION at t = 1, 201 times, cost 0.158369)"  # ½(1 − e⁻³)/3
    with pytest.raises(FileNotFoundError, match=r"none.npz: cannot be read: No such file"):
        hjb.load(tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("drift", "said"),
    [
        (lambda x, u: [u[0]], r"drift\(x, u\) returned a list of 1"),
        (lambda x, u: jnp.zeros(3), r"drift\(x, u\) returned shape \(3,\), expected \(1,\)"),
        (lambda x, u: u if x[0] > 0 else -u, "use jnp.where"),
        (lambda x, u: x[2:3], None),
        (lambda x, u: jnp.stack([u[3]]), "reads entry 3 of u"),
    ],
    ids=["list", "shape", "if", "slice", "index"],
)
@pytest.mark.parametrize(
    "door",
    [
        lambda asked: hjb.solve(asked, GRID, method=hjb.ValueIteration(policy=False)),
        lambda asked: hjb.estimate(asked, GRID, hjb.ValueIteration(policy=False)),
        lambda asked: hjb.estimate(asked, GRID, measure=False),
        lambda asked: hjb.march(asked, GRID, 1.0),
        lambda asked: hjb.march(asked, GRID, 1.0, policy=False, dtype="float32"),
        lambda asked: hjb.solve_batch([asked], GRID, method=hjb.ValueIteration(policy=False)),
    ],
    ids=["solve", "estimate", "bytes", "march", "alone", "batch"],
)
def test_a_bad_drift_is_told_by_every_front_door_that_reads_it(door, drift, said):
    with pytest.raises(ValueError, match=said or "drift"):
        door(problem(drift))


def test_warnings_name_the_line_that_called():
    """Python shows a warning once a line: inside the package every later one would be missing."""
    with pytest.warns(UserWarning, match="simulate: the path") as path:
        hjb.simulate(problem(), lambda x: x + 1, [0.9], 2.0, steps=4, grid=GRID)  # out of the box
    with pytest.warns(UserWarning, match="value_at: 1 of 1 states lie outside") as lookup:
        ANSWER.value_at([2.0])
    assert {each.filename for each in [*path, *lookup]} == {__file__}


# --- the name of the function that was called ---

TARGET = {"target": lambda x: jnp.abs(x[0]) - 0.1}


@pytest.mark.parametrize(
    ("ask", "name"),
    [
        (lambda: hjb.solve_batch([problem()], GRID, tol=-1), "solve_batch"),
        (lambda: hjb.solve_batch([problem()], GRID, max_steps=0), "solve_batch"),
        (lambda: hjb.solve_batch([problem(terminal_cost=lambda x: x @ x)], GRID), "solve_batch"),
        (lambda: hjb.estimate(problem(), GRID, tol=-1), "estimate"),
        (lambda: hjb.estimate(problem(), None), "estimate"),
        (lambda: hjb.expected_exit_time(problem(), GRID, **TARGET, tol=-1), "expected_exit_time"),
        (lambda: hjb.reach_probability(problem(), GRID, **TARGET, horizon=-1), "reach_probability"),
        (lambda: hjb.stay_probability(problem(), GRID, TARGET["target"], horizon=-1), "stay_probability"),
        (lambda: hjb.stay_probability(None, GRID, TARGET["target"]), "stay_probability"),
        (lambda: hjb.convergence_study(problem(), [GRID, GRID], tol=-1), "convergence_study"),
        (lambda: hjb.hinf_level(lambda gamma: problem(), GRID, 0.5, 2.0, scheme="Weno5"), "hinf_level"),
        (lambda: hjb.solve(problem(), GRID, tol=-1), "solve"),
    ],
)
def test_a_refusal_names_the_function_that_was_called(ask, name):
    with pytest.raises((ValueError, TypeError)) as caught:
        ask()
    assert str(caught.value).startswith(f"{name}: ")
