"""A reward on the target and no price of time: V was the reward, CONVERGED, and the feedback rested for ever."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

GRID = hjb.Grid([-1.2, -0.07], [0.6, 0.07], (31, 31))
REST = "the feedback never arrives from about \\d+% of the nodes where V promises a reward"


def mountain_car(cost, **changes):
    """A car too weak for its hill: it has to swing up to x = 0.45, where it gets 100."""
    return hjb.Problem(
        lambda x, u: jnp.stack([x[1], 0.0015 * u[0] - 0.0025 * jnp.cos(3 * x[0])]), cost, hjb.Box([-1.0], [1.0]),
        target=lambda x: 0.45 - x[0], exit_cost=-100.0, **changes,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the box decides", "ignore:the grid is coarse")
@pytest.mark.parametrize("together", [False, True])
def test_a_feedback_that_rests_is_told(together, monkeypatch):
    monkeypatch.setattr("hjbjax.solvers.batch._fills_with_lanes", lambda: True)
    problem = mountain_car(lambda x, u: 0.1 * u @ u)
    with pytest.warns(hjb.SolveWarning, match=REST):
        (solution,) = hjb.solve_batch([problem], GRID) if together else [hjb.solve(problem, GRID)]
    assert np.min(solution.value_at([-0.5, 0.0])) < -90
    with pytest.warns(hjb.SolveWarning, match="the path costs"):
        # it goes round inside of a cell, which no distance in cells can tell
        hjb.simulate(problem, solution, [-0.5, 0.0], 300.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the box decides", "ignore:the grid is coarse")
@pytest.mark.parametrize("changes", [{"cost": lambda x, u: 1.0}, {"cost": lambda x, u: 0.1 * u @ u, "discount": 0.005}])
def test_a_price_of_time_is_enough(changes):
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="the feedback never")
        hjb.solve(mountain_car(**changes), GRID)
