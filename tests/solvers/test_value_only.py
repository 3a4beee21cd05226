"""Value iteration and marches that keep nothing but V: the values of those that keep their policies, in less memory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.iteration import fixed_point, time_stepping
from hjbjax.problem.pytree import cast
from hjbjax.solvers import finite_horizon, march_run, memory, setup, stationary_run

pytestmark = pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")  # coarse grids, drift that is cut off
U = hjb.Box([-1.0], [1.0])
BARE = hjb.ValueIteration(policy=False)
PLANE = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (21, 20), periodic=(False, True))


def ahead(x, u):
    return jnp.concatenate([x[1:], u])


def sideways(x, u):
    return jnp.stack([jnp.cos(x[1]), u[0]])


def effort(x, u):
    return x @ x + u @ u


def disc(x):
    return x @ x - 0.5


def pushed(x, u, d):
    return jnp.stack([jnp.cos(x[1]) + 0.5 * d[0], u[0]])


QUESTIONS = {
    "discounted": hjb.Problem(sideways, effort, U, discount=1.0),
    "exit": hjb.Problem(sideways, effort, U, discount=1.0, target=disc, exit_cost=3.0),
    "stopping": hjb.Problem(sideways, effort, U, discount=1.0, stopping_cost=lambda x: 2.0 + x[0]),
    "noise": hjb.Problem(sideways, effort, U, discount=1.0, noise=0.3),
    "reach": hjb.reach(sideways, U, disc),
    "avoid": hjb.avoid(sideways, U, disc),
    "sampled": hjb.Problem(lambda x, u: sideways(x, jnp.sin(2 * u)), effort, U, discount=1.0),
    "game": hjb.avoid(pushed, U, disc, disturbances=U),
}
SLOW = ("sampled", "game")
ASKED = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in QUESTIONS]


@pytest.mark.slow
@pytest.mark.parametrize("name", ASKED)
def test_the_value_is_that_of_a_solve_with_its_policy(name):
    problem, tol = QUESTIONS[name], 1e-6
    known = hjb.solve(problem, PLANE, method=hjb.ValueIteration(), tol=tol)
    found = hjb.solve(problem, PLANE, method=BARE, tol=tol)
    assert found.status is hjb.Status.CONVERGED
    # both are certified to tol, or are at the end where nothing moves
    np.testing.assert_allclose(found.value, known.value, rtol=1e-12, atol=2 * tol if problem.discount else 1e-12)
    for absent in ("policy", "disturbance", "cut", "isaacs_gap", "reached"):
        assert getattr(found, absent) is None
    assert found.stats["method"] == "ValueIteration(policy=False)"
    assert len(found.residuals) == found.steps + 1
    if problem.discount and name != "sampled":  # whose minima are searched, so that nothing bounds what is missed
        exact = hjb.solve(problem, PLANE, scheme=hjb.Upwind(), tol=1e-10).value
        lower, upper = found.bounds
        assert found.error <= tol
        assert np.all(lower <= exact + 1e-10)
        assert np.all(exact - 1e-10 <= upper)
    else:
        assert found.bounds is None


@pytest.mark.slow
def test_every_bound_on_the_way_holds():
    problem = QUESTIONS["stopping"]
    exact = hjb.solve(problem, PLANE, scheme=hjb.Upwind(), tol=1e-10).value
    for steps in (1, 2, 5, 20):
        found = hjb.solve(problem, PLANE, method=BARE, max_steps=steps, tol=1e-9, throw=False)
        assert found.status is hjb.Status.MAX_STEPS
        assert np.max(np.abs(found.value - exact)) <= found.error + 1e-10
        known = hjb.solve(problem, PLANE, method=hjb.ValueIteration(), max_steps=steps, tol=1e-9, throw=False)
        np.testing.assert_allclose(found.value, known.value, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reach", "exit", "noise"])
@pytest.mark.parametrize("scheme", [hjb.Upwind(split=True), hjb.Limited(split=True)], ids=lambda s: type(s).__name__)
def test_a_march_without_policies_comes_to_the_same_values(name, scheme):
    problem, options = QUESTIONS[name], {"times": (0.0, 0.2), "scheme": scheme}
    known, found = (hjb.march(problem, PLANE, 0.4, policy=policy, **options) for policy in (True, False))
    np.testing.assert_allclose(found.value, known.value, rtol=1e-12, atol=1e-12)
    assert known.policy is not None
    assert found.policy is found.cut is None
    assert found.steps == known.steps


@pytest.mark.slow
def test_what_comes_of_it_is_saved_loaded_printed_and_controls(tmp_path):
    problem = QUESTIONS["discounted"]
    found = hjb.solve(problem, PLANE, method=BARE, tol=1e-6)
    found.save(tmp_path / "run.npz")
    np.testing.assert_array_equal(hjb.load(tmp_path / "run.npz").value, found.value)
    assert "ValueIteration(policy=False)" in str(found)
    known = hjb.solve(problem, PLANE, method=hjb.ValueIteration(), tol=1e-6)
    x = np.array([0.3, -0.4])
    controls = [hjb.greedy_feedback(problem, each)(x) for each in (found, known)]
    np.testing.assert_allclose(*controls, atol=1e-4)
    with pytest.raises(ValueError, match="policy"):
        found.control_at(x)


def test_it_goes_on_from_a_checkpoint_and_lane_by_lane(tmp_path):
    problem = QUESTIONS["discounted"]
    options = {"method": BARE, "tol": 1e-6, "checkpoint": hjb.Checkpoint(tmp_path / "run", every=1e-9)}
    hjb.solve(problem, PLANE, max_steps=3, throw=False, **options)
    whole = hjb.solve(problem, PLANE, method=BARE, tol=1e-6)
    resumed = hjb.solve(problem, PLANE, resume=True, **options)
    np.testing.assert_array_equal(resumed.value, whole.value)
    (lane,) = hjb.solve_batch([problem], PLANE, method=BARE, tol=1e-6)
    np.testing.assert_array_equal(lane.value, whole.value)


@pytest.mark.parametrize(
    "problem",
    [
        hjb.Problem(sideways, lambda x, u: 1.0, U, target=disc),
        hjb.Problem(sideways, effort, U),
    ],
    ids=["time", "rest"],
)
def test_where_v_alone_tells_no_bound_it_is_refused(problem):
    with pytest.raises(ValueError, match=r"ValueIteration\(policy=False\) stores only V.*Use discount > 0"):
        hjb.solve(problem, PLANE, method=BARE)


def test_what_is_no_choice_is_refused():
    with pytest.raises(TypeError, match="ValueIteration: policy is 1; wanted True or False"):
        hjb.ValueIteration(policy=1)
    with pytest.raises(TypeError, match="march: policy is 'no'; wanted True or False"):
        hjb.march(QUESTIONS["reach"], PLANE, 1.0, policy="no")


# --- memory: by XLA's own account of the programs ---


def box(n, count):
    return hjb.Grid([-1.0] * n, [1.0] * n, (count,) * n)


def peak(lowered):
    found = lowered.compile().memory_analysis()
    total = found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes
    return total - found.alias_size_in_bytes


@pytest.mark.parametrize(("n", "count"), [(2, 400), pytest.param(5, 8, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "problem",
    [hjb.reach(ahead, U, disc), hjb.Problem(ahead, effort, U, discount=1.0)],
    ids=["tube", "discounted"],
)
def test_a_solve_takes_twelve_bytes_a_node_beyond_the_value(n, count, problem):
    kind, grid = np.dtype(np.float32), box(n, count)
    with jax.enable_x64(False):
        on = Discretisation(problem, grid, hjb.Upwind(), kind)
        task, *_ = setup.prepare_on_host(on, method=BARE, tol=1e-3)
        state = jax.eval_shape(fixed_point.start, task, jax.ShapeDtypeStruct(grid.shape, kind))
        taken = peak(stationary_run.run.lower(task, state, 1)) / grid.size
    assert taken <= 4 + (8 if n > 4 else 12) + 0.2
    # and where it began, which is kept until the end
    assert memory.peak_bytes(problem, grid, BARE, kind) / grid.size == pytest.approx(taken + 4, rel=0.1)
    assert memory.peak_bytes(problem, grid, hjb.ValueIteration(), kind) > memory.peak_bytes(problem, grid, BARE, kind)


@pytest.mark.parametrize(("n", "count"), [(2, 400), pytest.param(5, 8, marks=pytest.mark.slow)])
@pytest.mark.parametrize("policy", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "scheme",
    [hjb.Upwind(), pytest.param(hjb.Limited(), marks=pytest.mark.slow), hjb.Weno5()],
    ids=lambda s: type(s).__name__,
)
def test_the_steps_of_a_march_take_what_is_told_beforehand(n, count, policy, scheme):
    problem, grid, kind = hjb.reach(ahead, U, disc), box(n, count), np.dtype(np.float32)
    with jax.enable_x64(False):
        on = Discretisation(*cast((problem, grid), kind), scheme, kind)
        task = finite_horizon._prepare(on, 1.0, hjb.Explicit(), None, None, policy=policy)
        front = jax.eval_shape(time_stepping.begin, task, jax.ShapeDtypeStruct(grid.shape, kind), 1.0)
        taken = peak(march_run._run.lower(task, front, jnp.zeros((), kind), 1)) / grid.size
        filling = peak(march_run._greedy.lower(task, front.value, jnp.zeros((), kind))) / grid.size
    told = [memory.of_steps(on, k, hjb.Explicit(), policy=policy) / grid.size for k in (1, 3)]
    assert told[1] - told[0] == pytest.approx(2 * 4 * (1 + policy), abs=0.01)  # of whole bytes
    # a slice is filled when its time has come; with its policy, of one control, and then nothing is stepped
    assert told[0] == pytest.approx(max(taken, filling + 8 if policy else 8), rel=0.2)
    if not policy and scheme.monotone:
        assert taken <= 4 + 8 + 4 * (n <= 4) + 0.2


def test_a_bare_hamiltonian_has_the_same_optimum():
    from hjbjax.hamiltonian import discrete, optimum

    problem, kind = QUESTIONS["discounted"], np.dtype(np.float32)
    on = Discretisation(*cast((problem, PLANE), kind), hjb.Upwind(), kind)
    value = jnp.asarray(np.random.default_rng(0).normal(size=PLANE.shape), kind)
    around = discrete.around(on, value)
    for one, other in zip(
        optimum.optimise(around)[:2], optimum.optimise(dataclasses.replace(around, bare=True))[:2], strict=True
    ):
        np.testing.assert_array_equal(one, other)
