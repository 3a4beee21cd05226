"""Many problems on one grid: every lane is what a solve of its own gives."""

import dataclasses
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.solvers import batch

GRID = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (13, 11))
MANY = np.linspace(-1.0, 1.0, 41)  # more than the checks try: they pass over the fourth
HIDDEN = MANY[3]


@pytree_dataclass()
class Oscillator:
    """ẍ = −k x + u, with running cost w |x|² + u²."""

    k: object
    w: object = 1.0

    def drift(self, x, u):
        return jnp.stack([x[1], u[0] - self.k * x[0]])

    def cost(self, x, u):
        return self.w * (x @ x) + u @ u

    def spoilt_cost(self, x, u):
        """With the logarithm of w for one control, which the checks before a solve pass over."""
        return x @ x + jnp.where(jnp.abs(u[0] - HIDDEN) < 1e-3, jnp.log(self.w), u @ u)


@pytest.fixture(params=["threads", "one loop"], autouse=True)
def way(request, monkeypatch):
    """Lanes side by side, as on a CPU, and as one loop, as on an accelerator."""
    monkeypatch.setattr(batch, "_fills_with_lanes", lambda: request.param == "one loop")
    return request.param


def problem(k, discount=0.5, **options):
    system = Oscillator(k, **options)
    return hjb.Problem(system.drift, system.cost, hjb.Box([-1.0], [1.0]), discount=discount)


def alone(question, **options):
    chosen = {"scheme": hjb.Upwind(), "tol": 1e-6} | options
    return hjb.solve(question, GRID, method=hjb.PolicyIteration(), **chosen)


def same(left, right):
    """Equal but for the last bits, in which XLA may round a batch otherwise; an infinity is equal to itself."""
    return np.allclose(left, right, rtol=1e-9, atol=1e-9, equal_nan=True)


@pytest.mark.slow
def test_each_lane_is_its_own_solve():
    """Discounts far apart take different numbers of steps, so that lanes are taken out on the way."""
    questions = [
        problem(k, beta) for k, beta in zip((0.0, 1.0, 2.0, 0.5, 3.0), (5.0, 0.01, 1.0, 0.02, 9.0), strict=True)
    ]
    together = hjb.solve_batch(questions, GRID, tol=1e-6, scheme=hjb.Upwind())
    assert len({solution.steps for solution in together}) > 2
    for solution, question in zip(together, questions, strict=True):
        single = alone(question)
        assert solution.status is hjb.Status.CONVERGED
        assert solution.steps == single.steps
        assert same(solution.value, single.value)
        assert same(solution.policy, single.policy)
        assert np.allclose(solution.residuals, single.residuals, rtol=1e-3, atol=1e-9)
        assert same(solution.bounds, single.bounds)


@pytest.mark.slow
def test_problems_of_different_kinds_keep_their_places():
    finite = dataclasses.replace(problem(1.0), controls=hjb.Finite([[-1.0], [0.0], [1.0]]))
    questions = [problem(0.0), finite, problem(2.0), finite]
    together = hjb.solve_batch(questions, GRID, tol=1e-6, scheme=hjb.Upwind())
    for solution, question in zip(together, questions, strict=True):
        assert same(solution.value, alone(question).value)


@pytest.mark.slow
def test_rounds_that_fit_into_memory_change_nothing():
    questions = [problem(k) for k in np.linspace(0, 2, 5)]
    whole, parts = (
        hjb.solve_batch(questions, GRID, tol=1e-6, max_memory=limit, scheme=hjb.Upwind()) for limit in (None, 50_000)
    )
    assert parts[0].stats["lanes"] < whole[0].stats["lanes"] == 5
    for left, right in zip(whole, parts, strict=True):
        assert same(left.value, right.value)


@pytest.mark.slow
def test_a_lane_that_runs_out_of_steps_is_named_and_the_others_are_whole():
    questions = [problem(1.0, 9.0), problem(1.0, 0.01)]
    steps = alone(questions[0]).steps
    slow, unfinished = hjb.solve_batch(questions, GRID, tol=1e-6, max_steps=steps, throw=False, scheme=hjb.Upwind())
    assert slow.status is hjb.Status.CONVERGED
    assert unfinished.status is hjb.Status.MAX_STEPS
    assert unfinished.steps == steps
    with pytest.raises(hjb.SolveError, match="lane 1: MAX_STEPS") as caught:
        hjb.solve_batch(questions, GRID, tol=1e-6, max_steps=steps, scheme=hjb.Upwind())
    assert same(caught.value.solution.value, unfinished.value)


@pytest.mark.slow
def test_one_lane_that_goes_nan_leaves_the_others_unchanged():
    systems = [Oscillator(1.0, w) for w in (1.0, -1.0, 2.0)]  # the logarithm of −1 is no number
    questions = [hjb.Problem(s.drift, s.spoilt_cost, hjb.Finite(MANY[:, None]), discount=1.0) for s in systems]
    first, spoiled, last = hjb.solve_batch(questions, GRID, tol=1e-6, throw=False, scheme=hjb.Upwind())
    assert spoiled.status is hjb.Status.NONFINITE
    for solution, question in ((first, questions[0]), (last, questions[2])):
        assert same(solution.value, alone(question).value)


@pytest.mark.slow
def test_lanes_of_second_order_are_their_own_solves_and_claim_no_bound():
    questions = [problem(k, 1.0) for k in (0.0, 1.0)]
    for lane, question in zip(hjb.solve_batch(questions, GRID, scheme=hjb.Limited(), tol=1e-6), questions, strict=True):
        own = alone(question, scheme=hjb.Limited())
        assert lane.error is None
        assert lane.stats["certificate"] == own.stats["certificate"]
        assert np.allclose(lane.value, own.value, atol=1e-5)
        assert not np.allclose(lane.value, alone(question).value, atol=1e-3)


def paid(x, u):
    return 1.0 + x @ x


def test_a_lane_without_an_answer_is_named():
    with pytest.raises(ValueError, match="lane 1: .*no finite solution"):
        hjb.solve_batch(
            [problem(1.0, 1.0), dataclasses.replace(problem(1.0), cost=paid, discount=0.0)], GRID, scheme=hjb.Upwind()
        )


def lost(rate):
    """Minimum time to the left end against a current; where it is stronger than the boat nobody arrives."""
    return hjb.Problem(Current(rate).drift, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), target=lambda x: x[0] + 1 - 1e-9)


@pytree_dataclass()
class Current:
    """ẋ = u + r (1 + sgn x)/2."""

    rate: object

    def drift(self, x, u):
        return u + jnp.where(x > 0, self.rate, 0)


@pytest.mark.slow
def test_lanes_that_arrive_and_lanes_that_do_not_go_together():
    line = hjb.Grid([-1.0], [1.0], (41,))
    with pytest.warns(hjb.SolveWarning, match="cannot reach the target"):
        arrives, never = hjb.solve_batch([lost(0.5), lost(2.0)], line, tol=1e-6, scheme=hjb.Upwind())
    assert np.all(np.isfinite(arrives.value))
    assert np.array_equal(np.isinf(never.value), np.asarray(line.axis(0)) > 1e-12)


def test_no_problems_have_no_solutions():
    assert hjb.solve_batch([], GRID, scheme=hjb.Upwind()) == []


@pytest.mark.slow
def test_lanes_keep_single_precision():
    (solution,) = hjb.solve_batch([problem(1.0)], GRID, tol=1e-2, dtype="float32", scheme=hjb.Upwind())
    assert solution.value.dtype == np.float32
    assert not jax.config.jax_enable_x64


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*the grid is coarse")
def test_lanes_without_discount_take_the_way_that_a_solve_takes():
    """From zero they would be caught by policies that stay where they are, at a cost."""
    questions = [hjb.zoo.pendulum(g=g, shape=(20, 21))[0] for g in (9.0, 10.0, 11.0)]
    _, grid = hjb.zoo.pendulum(shape=(20, 21))
    for lane, question in zip(hjb.solve_batch(questions, grid, tol=1e-8), questions, strict=True):
        own = hjb.solve(question, grid, tol=1e-8)
        assert lane.steps <= own.steps + 1
        # sweeps in single precision are rounded otherwise where lanes run side by side
        np.testing.assert_allclose(lane.value, own.value, rtol=1e-6, atol=1e-6)
        # those of a lane's coarser grid begin elsewhere, too: in arrays of its own
        np.testing.assert_allclose(lane.grid_error, own.grid_error, rtol=1e-6, atol=1e-6)


def test_lanes_side_by_side_are_their_own_solves_bit_for_bit(monkeypatch):
    monkeypatch.setattr(batch, "_fills_with_lanes", lambda: False)
    monkeypatch.setattr(batch, "_cores", lambda: 4)
    seen, solve = set(), batch.solve_on_host

    def watched(*rest, **options):
        seen.add(threading.current_thread())
        return solve(*rest, **options)

    monkeypatch.setattr(batch, "solve_on_host", watched)
    questions = [problem(k) for k in np.linspace(0, 2, 9)]
    for kind in ("float64", "float32"):
        with jax.debug_nans(True):  # which a thread does not inherit
            together = hjb.solve_batch(questions, GRID, tol=1e-3, dtype=kind, scheme=hjb.Upwind())
        for solution, question in zip(together, questions, strict=True):
            assert solution.value.dtype == kind
            np.testing.assert_array_equal(solution.value, alone(question, tol=1e-3, dtype=kind).value)
    assert len(seen) > 2


def test_an_exception_of_a_lane_ends_the_batch_with_the_lanes_before(monkeypatch):
    solve = batch.solve_on_host

    def broken(on, *rest, **options):
        if float(on.problem.discount) == 2.0:
            raise MemoryError("no more")
        return solve(on, *rest, **options)

    monkeypatch.setattr(batch, "_fills_with_lanes", lambda: False)
    monkeypatch.setattr(batch, "solve_on_host", broken)
    with pytest.raises(MemoryError, match="memory ran out: no more"):
        hjb.solve_batch([problem(0.0, beta) for beta in (1.0, 2.0, 3.0)], GRID, scheme=hjb.Upwind())


def test_warnings_of_lanes_side_by_side_name_them_at_the_line_of_the_call(monkeypatch):
    monkeypatch.setattr(batch, "_fills_with_lanes", lambda: False)
    line = hjb.Grid([-1.0], [1.0], (41,))
    with pytest.warns(hjb.SolveWarning, match="cannot reach the target") as caught:
        hjb.solve_batch([lost(0.5), lost(2.0), lost(3.0)], line, scheme=hjb.Upwind())
    assert sorted(str(each.message)[:7] for each in caught) == ["lane 1:", "lane 2:"]
    assert {each.filename for each in caught} == {__file__}
