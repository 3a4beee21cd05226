"""The default scheme: second order from a certified monotone answer, and how far that is from the exact value."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.applications.reference import at_nodes_of, mask_of
from hjbjax.solvers import second_order
from tests.support.compilation import compiling

U = hjb.Box([-1.0], [1.0])


def steer(x, u):
    return u


def square(x, u):
    return x @ x + u @ u


def line(discount=1.0, **options):
    """Functions of the module, so that problems with other numbers share compiled programs."""
    return hjb.Problem(steer, square, U, discount=discount, **options)


@pytest.mark.slow
def test_it_is_the_limited_answer_with_the_certificate_of_the_monotone_one():
    problem, grid = zoo.smooth(shape=(25, 25))
    solution, sharp, first = (
        hjb.solve(problem, grid, scheme=scheme, tol=1e-5) for scheme in (None, hjb.Limited(), hjb.Upwind(subcell=True))
    )
    # to rounding: its program serves the monotone answer, too
    np.testing.assert_allclose(solution.value, sharp.value, rtol=0, atol=1e-12)
    assert solution.error is None  # nothing certifies the second order
    assert solution.monotone_error == pytest.approx(sharp.monotone_error, rel=1e-6)
    assert sharp.monotone_error <= 1e-5
    # another program: its sweeps in single precision may be rounded otherwise
    assert first.error == pytest.approx(sharp.monotone_error, rel=1e-6)
    assert first.monotone_error is None
    assert first.grid_error is sharp.grid_error is None  # who names a scheme gets that, and nothing beside
    assert np.max(np.abs(solution.value - first.value)) == pytest.approx(solution.stats["from_monotone"], rel=1e-9)


# name, nodes of an axis, the share of the box in which errors count, parameters
KNOWN = [
    ("bang-bang", 81, None, {}),
    ("bang-bang", 41, None, {"noise": 0.5**0.5}),
    ("smooth", 41, 0.5, {}),
    ("zermelo", 81, 0.5, {}),
    ("brownian-exit", 41, None, {"discount": 2.0}),
]
SLOW = [
    ("smooth", 81, 0.5, {}),
    ("eikonal", 161, None, {}),
    ("double-integrator", 161, 0.5, {}),
    ("zermelo", 161, 0.5, {}),
    ("merton", 80, None, {}),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count", "share", "parameters"), [*KNOWN, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)]
)
def test_the_estimate_is_of_the_size_of_the_error(name, count, share, parameters):
    entry = zoo.catalogue[name]
    dim = entry.build(**parameters)[1].ndim
    problem, grid = entry.build(shape=(count,) * dim, **parameters)
    mask = mask_of(share, grid)
    # the double integrator is off by a tenth of the range, but at the nodes of one kink only: no reason to warn
    solution = hjb.solve(problem, grid, tol=1e-6)
    true = np.max(np.abs(solution.value - at_nodes_of(entry.exact(**parameters), grid, mask))[mask])
    assert solution.grid_error.shape == grid.shape
    assert true / 3 <= np.max(solution.grid_error[mask]) <= 5 * true


@pytest.mark.slow
@pytest.mark.parametrize("count", [31, 41, 51])
def test_a_slow_way_to_the_limit_is_not_halved(count):
    """A few nodes next to the disc move by equal steps. When these were halved, 41 nodes per axis took 135 steps."""
    problem, grid = zoo.dubins(shape=(count, count, count - 1))
    assert hjb.solve(problem, grid).steps <= 40


def test_each_grid_is_solved_once_by_each_scheme(iterations):
    hjb.solve(line(), hjb.Grid([-1.0], [1.0], (41,)))
    # on the coarser grid first for an estimate of the error of the grid, then up to a tenth of it
    assert iterations == [("Upwind", (41,)), ("Upwind", (21,)), *[("Limited", (21,))] * 2, ("Limited", (41,))]


def test_one_program_serves_the_chain_and_the_second_order():
    grid = hjb.Grid([-1.0], [1.0], (43,))
    with compiling() as programs:
        solution = hjb.solve(line(), grid)
    assert programs.count("jit(run)") == 2  # one per grid
    chain = hjb.solve(line(), grid, scheme=hjb.Upwind(subcell=True))
    assert solution.monotone_error == pytest.approx(chain.error, rel=1e-6)
    assert solution.stats["from_monotone"] == pytest.approx(np.max(np.abs(solution.value - chain.value)), rel=1e-6)


@pytest.mark.slow
def test_where_noise_makes_central_differences_monotone_nothing_is_run_twice(iterations):
    solution = hjb.solve(line(noise=0.5), hjb.Grid([-1.0], [1.0], (41,)))
    assert iterations == [("Upwind", (41,)), ("Upwind", (21,))]
    assert solution.error <= 1e-3
    assert np.max(solution.grid_error) > 0
    iterations.clear()
    hjb.solve(line(noise=0.05), hjb.Grid([-1.0], [1.0], (41,)))  # h |f| = .05 is more than ε² = .0025
    assert iterations[-1] == ("Limited", (41,))


@pytest.mark.parametrize(
    ("problem", "method"),
    [
        (line(), hjb.ValueIteration()),
        (hjb.Problem(steer, None, U, stopping_cost=lambda x: x @ x - 0.1), None),
    ],
    ids=["value iteration", "tube"],
)
def test_value_iteration_and_tubes_stay_with_the_chain(problem, method):
    solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (21,)), method=method)
    assert solution.stats["scheme"] == repr(hjb.Upwind())
    assert solution.monotone_error is None


@pytest.mark.slow
def test_transformations_give_the_answer_of_the_host():
    grid = hjb.Grid([-1.0], [1.0], (21,))

    def at(discount):
        return hjb.solve(line(discount), grid, dtype="float32").value_at(jnp.array([0.5]))

    assert float(jax.jit(at)(1.0)) == pytest.approx(float(at(1.0)), abs=1e-4)


@pytest.fixture
def failing(monkeypatch):
    """A second-order iteration that ends STALLED."""
    iterate = second_order.iterate

    def stalled(task, *rest, **options):
        state, code, residuals = iterate(task, *rest, **options)
        return state, code if task.is_chain else hjb.Status.STALLED, residuals

    monkeypatch.setattr(second_order, "iterate", stalled)


def test_where_the_second_order_does_not_converge_the_monotone_answer_stands(failing):
    problem, grid = line(), hjb.Grid([-1.0], [1.0], (41,))
    solution = hjb.solve(problem, grid)
    first = hjb.solve(problem, grid, scheme=hjb.Upwind(subcell=True))
    assert solution.status is hjb.Status.CONVERGED
    assert solution.message.endswith("is of first order, since the second-order iteration ended with STALLED.")
    np.testing.assert_allclose(solution.value, first.value, rtol=1e-14, atol=1e-15)  # another program rounds otherwise
    assert solution.error == pytest.approx(first.error, rel=1e-6)
    with pytest.raises(hjb.SolveError, match="STALLED"):  # who asks for it is told
        hjb.solve(problem, grid, scheme=hjb.Limited())


def pulled(x, u, d):
    return u + d


def charged(x, u, d):
    return x @ x + u @ u - d @ d


PLAYED = {
    "formula": line(),
    "stopping": line(stopping_cost=lambda x: 0.3 + 0 * x[0]),
    "search": hjb.Problem(lambda x, u: jnp.sin(2 * u), square, U, discount=1.0),
    "game": hjb.Problem(pulled, charged, U, disturbances=hjb.Box([-0.3], [0.3]), discount=1.0),
}


@pytest.mark.parametrize("name", ["formula", *(pytest.param(name, marks=pytest.mark.slow) for name in [*PLAYED][1:])])
def test_the_monotone_answer_that_stands_has_its_policy(name, failing):
    """The policy is not stored during the second-order iteration if it follows from V."""
    problem, grid = PLAYED[name], hjb.Grid([-1.0], [1.0], (41,))
    first = hjb.solve(problem, grid, scheme=hjb.Upwind(subcell=True))
    lanes = hjb.solve_batch([problem, problem], grid)
    for solution in (hjb.solve(problem, grid), *lanes):
        assert "second-order iteration ended with STALLED" in solution.message or solution in lanes
        for actions, expected in ((solution.policy, first.policy), (solution.disturbance, first.disturbance)):
            assert (actions is None) == (expected is None)
            if actions is not None:
                np.testing.assert_allclose(actions, expected, atol=2e-3)


@pytest.mark.slow
def test_a_limit_that_only_the_first_order_keeps_to():
    problem, grid = zoo.smooth(shape=(25, 25))
    first = hjb.solve(problem, grid, scheme=hjb.Upwind(subcell=True), tol=1e-9)
    after = hjb.solve(problem, grid, scheme=hjb.Limited(), tol=1e-9)
    assert after.steps > first.steps
    solution = hjb.solve(problem, grid, tol=1e-9, max_steps=first.steps)
    assert solution.status is hjb.Status.CONVERGED
    assert "ended with MAX_STEPS" in solution.message
    np.testing.assert_allclose(solution.value, first.value, rtol=1e-14, atol=1e-15)  # another program rounds otherwise


@pytest.mark.slow
def test_a_coarse_grid_warns():
    problem, grid = zoo.pendulum(shape=(24, 25))
    with pytest.warns(
        hjb.SolveWarning,
        match=r"the grid is coarse for this problem: its error is above a tenth of the range of V at \d+% of",
    ):
        hjb.solve(problem, grid)


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [{}, {"noise": 0.5**0.5}])
def test_an_odd_number_of_intervals_has_no_half(parameters):
    entry = zoo.catalogue["bang-bang"]
    problem, grid = entry.build(shape=(80,), **parameters)  # 40 on the coarser grid, whose nodes are others
    solution = hjb.solve(problem, grid, tol=1e-6)
    true = np.max(np.abs(solution.value - at_nodes_of(entry.exact(**parameters), grid, np.ones(80, bool))))
    assert true / 3 <= np.max(solution.grid_error) <= 5 * true


def test_the_screen_says_both_errors_and_files_keep_them(tmp_path):
    solution = hjb.solve(line(), hjb.Grid([-1.0], [1.0], (41,)))
    text, first, off = str(solution), solution.monotone_error, solution.grid_error
    said = f"residual at most 0.001 at high order; of the monotone start at most {first:.3g}"
    assert f" algebraic error {said} " in " ".join(text.split())  # on two lines
    assert f"  grid error       about {np.max(off):.3g}, {np.mean(off):.3g} in the mean" in text
    solution.save(tmp_path / "run.npz")
    again = hjb.load(tmp_path / "run.npz")
    np.testing.assert_array_equal(again.grid_error, solution.grid_error)
    assert again.monotone_error == solution.monotone_error
    assert str(again) == text


@pytest.mark.slow
def test_nodes_that_do_not_reach_the_target_have_no_estimate():
    problem = hjb.Problem(
        lambda x, u: jnp.where(x[0] > 0.5, 1.0, u[0])[None], lambda x, u: 1.0, U, target=lambda x: jnp.abs(x[0]) - 0.1
    )
    with pytest.warns(hjb.SolveWarning, match="cannot reach the target"):
        solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (41,)))
    assert np.isinf(solution.value).any()
    assert np.all(solution.grid_error[np.isinf(solution.value)] == 0)


def test_lanes_are_solves():
    grid = hjb.Grid([-1.0], [1.0], (41,))
    problems = [line(discount) for discount in (0.5, 1.0, 4.0)]
    for found, problem in zip(hjb.solve_batch(problems, grid), problems, strict=True):
        alone = hjb.solve(problem, grid)
        np.testing.assert_allclose(found.value, alone.value, rtol=0, atol=1e-12)
        assert found.monotone_error == pytest.approx(alone.monotone_error)
        assert found.stats["scheme"] == alone.stats["scheme"] == repr(hjb.Limited())
        np.testing.assert_allclose(found.grid_error, alone.grid_error, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_lanes_with_enough_noise_keep_their_certificates():
    grid = hjb.Grid([-1.0], [1.0], (41,))
    loud, quiet = hjb.solve_batch([line(noise=0.5), line(noise=0.05)], grid)
    assert loud.error <= 1e-3
    assert quiet.error is None
    assert quiet.monotone_error <= 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "scheme"),
    [(None, hjb.Limited(split=True)), pytest.param(hjb.Implicit(), hjb.Upwind(split=True), marks=pytest.mark.slow)],
    ids=["explicit", "implicit"],
)
def test_marches(method, scheme):
    problem, grid = line(), hjb.Grid([-1.0], [1.0], (41,))
    found, named = (hjb.march(problem, grid, 0.5, method=method, **each) for each in ({}, {"scheme": scheme}))
    np.testing.assert_array_equal(found.value, named.value)
    assert found.stats["scheme"] == repr(scheme)


@pytest.mark.slow
def test_a_path_says_what_the_value_promised():
    problem, grid = zoo.smooth(shape=(41, 41))
    solution = hjb.solve(problem, grid, tol=1e-6)
    path = hjb.simulate(problem, solution, [0.5, -0.3], 30.0)
    assert path.promised == solution.value_at([0.5, -0.3])
    assert path.cost == pytest.approx(path.promised, abs=3 * np.max(solution.grid_error))
    assert f"cost {path.cost:.6g} (V promised {path.promised:.6g})" in path.message
    greedy = hjb.simulate(problem, hjb.greedy_feedback(problem, solution), [0.5, -0.3], 1.0)
    assert greedy.promised == path.promised
    assert hjb.simulate(problem, lambda x: -x[:1], [0.5, -0.3], 1.0).promised is None
