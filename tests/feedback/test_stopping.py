"""Paths of problems that may be stopped at a cost: they end where V says so, and cost what V promised."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.feedback.simulation import rollout

GRID = hjb.Grid([-1.5], [1.5], (151,))


def stopped(**parts):
    """Running costs on the way, a hilly price of stopping."""
    return hjb.Problem(
        lambda x, u: u, lambda x, u: 0.3 + u @ u, hjb.Box([-1.0], [1.0]), discount=0.5,
        stopping_cost=lambda x: jnp.sin(3 * x[0]) ** 2, **parts,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("greedy", [False, True])
def test_a_path_stops_where_v_is_the_price(greedy):
    """At once in a valley, on a slope after the way to where going on no longer pays: it ran on, and paid for that."""
    problem = stopped()
    solution = hjb.solve(problem, GRID)
    feedback = hjb.greedy_feedback(problem, solution) if greedy else solution
    at_once, later = (hjb.simulate(problem, feedback, [x], 20.0) for x in (1.02, 0.6))
    assert at_once.times.tolist() == [0.0]
    assert at_once.cost == pytest.approx(np.sin(3.06) ** 2, rel=1e-12)
    assert later.status.name == "TARGET"
    assert 0.5 < later.reached < 1.2
    assert later.cost == pytest.approx(later.promised, abs=1e-3)


@pytest.mark.slow
def test_a_target_keeps_its_own_price():
    """A target at the right end is free; from there on V is the way to it or the price of stopping."""
    problem = stopped(target=lambda x: 1.0 - x[0], exit_cost=-0.4)
    solution = hjb.solve(problem, GRID)
    for x, way in ((0.75, True), (-1.02, False)):
        path = hjb.simulate(problem, solution, [x], 20.0)
        assert (float(path.states[-1, 0]) > 0.99) == way
        assert path.cost == pytest.approx(path.promised, abs=5e-3)


@pytest.mark.slow
def test_a_rollout_stops_as_well():
    problem = stopped()
    solution = hjb.solve(problem, GRID)
    with jax.enable_x64(True):
        times = jnp.linspace(0.0, 3.0, 31)
        path = jax.jit(lambda x: rollout(problem, solution, x, times))(jnp.array([0.6]))
    assert float(path.cost) == pytest.approx(float(solution.value_at([0.6])), abs=1e-3)


@pytest.mark.slow
@pytest.mark.optimised
def test_noisy_paths_stop_and_cost_what_v_promises_in_the_mean():
    """Those that ran on, as if nothing could be stopped, cost twice as much."""
    problem = stopped(noise=0.4)
    solution = hjb.solve(problem, hjb.Grid([-2.0], [2.0], (101,)))
    keys, times = jax.random.split(jax.random.key(2), 400), np.linspace(0.0, 8.0, 41)
    with jax.enable_x64(True):
        run = jax.vmap(lambda key: rollout(problem, solution, jnp.array([0.55]), times, key=key))
        paths = jax.jit(run)(keys)
    assert np.all(np.asarray(paths.code) == 1)  # TARGET
    cost = np.asarray(paths.cost)
    mean, deviation = cost.mean(), cost.std() / np.sqrt(len(cost))
    assert abs(mean - float(solution.value_at([0.55]))) < 4 * deviation < 0.04
