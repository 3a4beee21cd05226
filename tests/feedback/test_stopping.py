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


@pytest.mark.slow
@pytest.mark.parametrize("forbidden", [np.inf, 5.0])
@pytest.mark.parametrize("place", [0.5, 0.51])
@pytest.mark.parametrize("start", [0.0, 0.47, 0.49])
def test_a_path_stops_on_the_allowed_side_of_a_jump(forbidden, place, start):
    """x' = 1: stop at the first node where it is cheap. The path met the node up to rounding and paid infinity."""
    problem = hjb.Problem(
        lambda x, u: 1 + 0 * u, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), discount=0.5,
        stopping_cost=lambda x: jnp.where(x[0] < place, forbidden, 0.3),
    )  # fmt: skip
    grid = hjb.Grid([-1.0], [1.0], (41,))
    path = hjb.simulate(problem, hjb.solve(problem, grid), [start], 3.0)
    node = 0.5 if place == 0.5 else 0.55
    decay = np.exp(-0.5 * (node - start))
    assert path.status.name == "TARGET"
    assert path.cost == pytest.approx((1 - decay) / 0.5 + 0.3 * decay, rel=1e-8)


@pytest.mark.slow
def test_no_path_stops_inside_a_forbidden_strip_between_nodes():
    """ψ = ∞ on (0.51, 0.54), between nodes at which stopping is optimal."""
    problem = hjb.Problem(
        lambda x, u: 1 + 0 * u, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), discount=0.5,
        stopping_cost=lambda x: jnp.where(jnp.abs(x[0] - 0.525) < 0.015, jnp.inf, 0.3),
    )  # fmt: skip
    path = hjb.simulate(problem, hjb.solve(problem, hjb.Grid([-1.0], [1.0], (41,))), [0.52], 3.0)
    decay = np.exp(-0.5 * 0.02)
    assert path.states[-1, 0] == pytest.approx(0.54, abs=1e-6)
    assert path.cost == pytest.approx((1 - decay) / 0.5 + 0.3 * decay, rel=1e-5)


@pytest.mark.slow
def test_a_mode_is_not_changed_where_that_costs_infinity():
    """x' = 1: a change from mode a, with cost 2, to mode b, without cost, is allowed from x = 0.5 on."""

    def price(x):
        return jnp.array([[0.0, jnp.inf], [jnp.inf, 0.0]]).at[0, 1].set(jnp.where(x[0] < 0.5, jnp.inf, 0.1))

    problem = hjb.Problem(
        lambda x, u, mode: 1 + 0 * u, lambda x, u, mode: jnp.where(mode == 0, 2.0, 0.0), hjb.Box([-1.0], [1.0]),
        discount=0.5, modes=hjb.Modes(("a", "b"), switching_cost=price),
    )  # fmt: skip
    solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (41,)))
    for start in (0.0, 0.47):
        path = hjb.simulate(problem, solution, [start], 10.0, mode="a", clamp=True)
        decay = np.exp(-0.5 * (0.5 - start))
        assert path.cost == pytest.approx((1 - decay) / 0.25 + 0.1 * decay, rel=1e-8)
