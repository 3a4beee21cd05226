"""Cases that once went wrong: tubes from a wrong start, a NaN passed over, ties at rest, arguments of a wrong kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import GRID, problem, refusal

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.problem.pytree import pytree_dataclass


@pytest.mark.parametrize("tol", ["1e-3", None])
def test_tolerance_that_is_no_number(tol):
    refusal((ValueError, TypeError), "tol", repr(tol), tol=tol)


def test_guess_that_is_no_array_of_numbers():
    refusal((ValueError, TypeError), "guess", guess="zeros")
    refusal((ValueError, TypeError), "guess", guess=np.zeros(GRID.shape, complex) + 1j)


@pytest.mark.parametrize("seconds", ["5"])
def test_time_limit_that_is_no_number(seconds):
    refusal((ValueError, TypeError), "time_limit", repr(seconds), "> 0", time_limit=seconds)


@pytest.mark.parametrize("dtype", ["flaot64"])
def test_unknown_dtype(dtype):
    refusal((ValueError, TypeError), "dtype", repr(dtype), "float64", "float32", dtype=dtype)


def test_rest_where_every_action_costs_the_same():
    """At the origin u = 0 rests at no cost, though the cost does not favour it."""
    odd = hjb.Grid([-1.0, -2.0], [1.0, 2.0], (9, 11))
    assert hjb.solve(problem(discount=0.0), odd, tol=1e-2, scheme=hjb.Upwind()).value[4, 5] == 0.0


@pytree_dataclass()
class Burst:
    """A cost that is NaN for one control."""

    center: float

    def cost(self, x, u):
        return x @ x + jnp.where(jnp.abs(u[0] - self.center) < 1e-3, jnp.nan, u[0] ** 2)


def test_nan_in_the_loop_is_never_taken_for_convergence():
    points = np.linspace(-1.0, 1.0, 41)  # more than the checks before a solve try: they pass over the fourth
    hidden = problem(cost=Burst(points[3]).cost, controls=hjb.Finite(points[:, None]))
    with pytest.raises(hjb.SolveError, match="NONFINITE") as caught:
        hjb.solve(hidden, GRID, scheme=hjb.Upwind())
    assert np.all(np.isfinite(caught.value.solution.value))


@pytest.mark.parametrize("change", [{"mass": 2.0}, {"mass": 3.5}])
def test_changing_a_zoo_parameter_compiles_nothing(change, caplog):
    shape = (20, 21)
    hjb.solve(*zoo.pendulum(shape=shape), tol=1.0, scheme=hjb.Upwind())
    with jax.log_compiles(True), caplog.at_level("WARNING"):
        hjb.solve(*zoo.pendulum(shape=shape, **change), tol=1.0, scheme=hjb.Upwind())
    compiled = [record.getMessage() for record in caplog.records if "Compiling" in record.getMessage()]
    assert compiled == []


@pytest.mark.slow
def test_the_lq_game_has_its_known_value():
    exact, errors = zoo.lq_game_exact(), []
    for n in (51, 101, 201):
        problem, grid = zoo.lq_game(shape=(n,))
        solution = hjb.solve(problem, grid, tol=1e-5, scheme=hjb.Upwind())
        x = grid.nodes()
        known = np.array([float(exact(jnp.asarray(one))) for one in x])
        errors.append(np.max(np.abs(solution.value - known)[np.abs(x[:, 0]) <= 0.5]))
    assert errors[-1] <= 0.02
    assert abs(-np.polyfit(range(3), np.log2(errors), 1)[0] - 1) <= 0.15


def along(x, u):
    return jnp.stack([u[0], jnp.ones_like(u[0])])


def block(x):
    """Signed distance to the square |x|, |y| ≤ 1: ≤ 0 inside."""
    return jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1])) - 1


def minus_block(x):
    return -block(x)


BOAT = hjb.Grid([-3.0, -3.0], [3.0, 3.0], (25, 25))  # nodes at multiples of ¼


def test_reach_tube_of_the_floating_boat():
    """The infimum over time of l: the largest solution, reached from ψ; from zero the iteration stays at zero."""
    problem = hjb.Problem(along, controls=hjb.Box([-1.0], [1.0]), stopping_cost=block)
    solution = hjb.solve(problem, BOAT, tol=1e-6, scheme=hjb.Upwind())
    x, y = np.moveaxis(BOAT.nodes(), -1, 0)
    level = np.maximum(np.abs(x), np.abs(y)) - 1
    assert np.all(solution.value <= level + 1e-12)
    assert np.all(solution.value[(np.abs(x) <= 0.5) & (y <= 1)] <= 1e-9)
    past = (y >= 2) & (np.abs(x) < y)
    np.testing.assert_allclose(solution.value[past], (y - 1)[past], atol=1e-9)


def test_avoid_tube_of_the_floating_boat():
    """The supremum over time of −l: the smallest solution, reached from g; from zero nothing would be safe."""
    problem = hjb.Problem(along, controls=hjb.Box([-1.0], [1.0]), running_max=minus_block)
    solution = hjb.solve(problem, BOAT, tol=1e-6, scheme=hjb.Upwind())
    x, y = np.moveaxis(BOAT.nodes(), -1, 0)
    level = 1 - np.maximum(np.abs(x), np.abs(y))
    assert np.all(solution.value >= level - 1e-12)
    assert np.all(solution.value[(y > 1) | (np.abs(x) > 1.5)] < 0)  # past the square, or beside it


@pytest.mark.slow
def test_a_nested_solve_where_the_drift_cancels_at_a_node():
    """A drift of rounding size is no motion: dividing by it sent the value to infinity."""
    problem, grid = zoo.pendulum(as_printed=True, shape=(100, 101))
    nested = hjb.solve(problem, grid, method=hjb.Nested(), scheme=hjb.Upwind())
    plain = hjb.solve(problem, grid, method=hjb.PolicyIteration(), scheme=hjb.Upwind())
    assert np.max(np.abs(nested.value - plain.value)) <= 2e-3


@pytest.mark.slow
def test_a_second_order_game_where_the_drift_cancels_at_a_node():
    problem, grid = zoo.lq_game(shape=(81,))
    solution = hjb.solve(problem, grid, scheme=hjb.Limited(), tol=1e-6)
    exact = jax.vmap(zoo.lq_game_exact())(jnp.asarray(grid.nodes(), jnp.float32))
    assert np.max(np.abs(solution.value - np.asarray(exact))) <= 1e-5
