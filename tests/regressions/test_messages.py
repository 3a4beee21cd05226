"""What is said where something is wrong: the argument, the value, what is wanted, the place."""

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.solution.status import Status

U = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([-1.0], [1.0], (21,))


def cost(x, u):
    return x @ x + u @ u


def problem(drift=lambda x, u: u, cost=cost, **changes):
    return hjb.Problem(drift, cost, U, **({"discount": 1.0} | changes))


# --- where a NaN appeared ---


def between(x, u):
    """NaN for a control that no survey tries, wanted where x > .3."""
    return jnp.where((jnp.abs(u[0] + 0.613) < 0.1) & (x[0] > 0.3), jnp.nan, (u[0] + 0.613) ** 2)


@pytest.mark.parametrize("method", [None, hjb.ValueIteration()])
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
    with pytest.raises(TypeError, match=r"solve_batch: got .*; wanted a list of problems, as in \[problem\]"):
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
