"""Which nodes reach the target, against a plain search over the chain's transition matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.markov_chain import attainability, chain
from hjbjax.solution.clock import Clock

MOVES = np.array([[-1.0], [0.0], [1.0]])
GRID = hjb.Grid([0.0], [7.0], (8,))
PLANE = hjb.Grid([0.0, 0.0], [3.0, 4.0], (4, 5))


def looked_up(table, x, u):
    """The entry of a table at node x ∈ {0, …, 7} under action u ∈ {−1, 0, 1}, without indexing by tracers."""
    total = 0.0
    for node in range(8):
        for k in range(3):
            total = total + jnp.where((jnp.abs(x[0] - node) < 0.5) & (jnp.abs(u[0] - k + 1) < 0.5), table[node, k], 0.0)
    return total


def table_drift(table, x, u):
    return looked_up(table, x, u)[None]


def on_line(drifts, noises):
    return hjb.Problem(
        jax.tree_util.Partial(table_drift, drifts),
        None,
        hjb.Finite(MOVES),
        noise=jax.tree_util.Partial(looked_up, noises),
        discount=1.0,
    )


def reached(problem, grid, held, surely):
    with jax.enable_x64(True):
        return attainability.reached(
            Discretisation(problem, grid, hjb.Upwind(), np.float64), held, surely=surely
        ).surely


def brute(problem, grid, held, surely):
    """The greatest set of nodes from which some policy arrives (with probability one), by definition."""
    held = held.reshape(-1)
    tables = [
        chain.matrix(problem, grid, np.broadcast_to(u, (*grid.shape, len(u))), scheme=hjb.Upwind()).toarray()
        for u in np.asarray(problem.controls.points)
    ]
    jumps = [(table > 0) & ~np.eye(grid.size, dtype=bool) for table in tables]
    inside = np.ones(grid.size, bool)
    while True:
        found = held.copy()
        for _ in range(grid.size):
            for jump in jumps:
                stays = ~np.any(jump & ~inside, axis=1)
                found |= inside & stays & np.any(jump & found, axis=1)
        if not surely or np.array_equal(found, inside):
            return found.reshape(grid.shape)
        inside = found


@pytest.mark.slow
@settings(max_examples=60)
@given(
    st.lists(st.lists(st.sampled_from([-1.0, 0.0, 1.0]), min_size=3, max_size=3), min_size=8, max_size=8),
    st.lists(st.lists(st.sampled_from([0.0, 0.0, 0.5]), min_size=3, max_size=3), min_size=8, max_size=8),
    st.lists(st.booleans(), min_size=8, max_size=8),
    st.booleans(),
)
def test_reached_nodes_on_a_line(drifts, noises, held, surely):
    problem, held = on_line(np.array(drifts), np.array(noises)), np.array(held)
    expected = brute(problem, GRID, held, surely)
    np.testing.assert_array_equal(reached(problem, GRID, held, surely), expected)
    assert np.all(expected[held])


def turning(x, u):
    return jnp.stack([u[0] * (x[1] - 2.0), 1.0 + 0.0 * x[0]])


@pytest.mark.parametrize("surely", [True, False])
@pytest.mark.parametrize("noise", [None, [0.5, 0.0]])
@pytest.mark.parametrize("corner", [(0, 4), (3, 4), (2, 3)])
def test_reached_nodes_in_the_plane(corner, noise, surely):
    problem = hjb.Problem(turning, None, hjb.Finite(MOVES), noise=noise, discount=1.0)
    held = np.zeros(PLANE.shape, bool)
    held[corner] = True
    found = reached(problem, PLANE, held, surely)
    np.testing.assert_array_equal(found, brute(problem, PLANE, held, surely))
    assert not found[:, corner[1] + 1 :].any()  # everything moves upwards


@pytest.mark.parametrize("long", [4, 0])
@pytest.mark.parametrize("surely", [True, False])
def test_paths_followed_on_the_device_are_those_of_the_search(monkeypatch, surely, long):
    """With ``long`` = 0 no path is short enough, and the search has the last word."""
    problem = hjb.Problem(turning, None, hjb.Finite(MOVES), noise=[0.5, 0.0], discount=1.0)
    held = np.zeros(PLANE.shape, bool)
    held[3, 4] = True
    searched = reached(problem, PLANE, held, surely)
    monkeypatch.setattr(attainability, "LARGE", 0)
    monkeypatch.setattr(attainability, "LONG", long)
    np.testing.assert_array_equal(reached(problem, PLANE, held, surely), searched)
    with jax.enable_x64(True):
        jumps = attainability._open_jumps(Discretisation(problem, PLANE, hjb.Upwind(), np.float64), None, Clock())
        found = attainability._reach_on_device(held, jumps, PLANE, Clock(), long * sum(PLANE.shape))
    if long:
        np.testing.assert_array_equal(found, attainability._reach_on_host(held, jumps, PLANE))
    else:
        assert found is None


@pytest.mark.parametrize("surely", [True, False])
def test_how_often_the_clock_is_looked_at_changes_no_node(monkeypatch, surely):
    """Some actions, and some jumps of the paths, at a time; where no host could list the jumps, to their very end."""
    problem = hjb.Problem(turning, None, hjb.Finite(MOVES), noise=[0.5, 0.0], discount=1.0)
    held = np.zeros(PLANE.shape, bool)
    held[3, 4] = True
    searched = reached(problem, PLANE, held, surely)
    phases, enter = [], Clock.enter
    monkeypatch.setattr(Clock, "enter", lambda clock, phase: (phases.append(phase), enter(clock, phase)))
    monkeypatch.setattr(attainability, "LARGE", 0)
    monkeypatch.setattr(attainability, "LOOK", 2 * PLANE.size)
    monkeypatch.setattr(attainability, "LONG", 0)
    monkeypatch.setattr(attainability, "SEARCHABLE", 0)
    monkeypatch.setattr(attainability, "_reach_on_host", None)
    np.testing.assert_array_equal(reached(problem, PLANE, held, surely), searched)
    assert sum("jumps of the chain" in phase for phase in phases) >= len(MOVES) // 2
    assert sum("paths of" in phase for phase in phases) > 2


def test_certain_arrival_is_more_than_possible_arrival():
    """Noise carries the state either way, and only one end is the target: an absorbing trap waits at the other."""
    noises = np.full((8, 3), 0.5)
    noises[0] = 0.0  # the trap
    problem, held = on_line(np.zeros((8, 3)), noises), np.arange(8) == 7
    np.testing.assert_array_equal(reached(problem, GRID, held, False), np.arange(8) > 0)
    np.testing.assert_array_equal(reached(problem, GRID, held, True), held)


def thin(inputs, unit):
    """Beside currents that lead away for ever only actions with f₁ ≤ 0 ≤ f₂ will do, a thousandth of the ball."""
    across = np.array([0.28, 0.96]) * 0.9995 * unit

    def drift(x, u):
        right, down = (jnp.where(beyond, 20 * unit, 0.0) for beyond in (x[0] > 0.6, x[1] < -0.6))
        return jnp.stack([across[0] + u[0] + right, u[1] - across[1] - down, *(u[k] for k in range(2, inputs))])

    def corner(x):
        return jnp.maximum(x[0] + 0.9, 0.9 - x[1]) - 0.2

    problem = hjb.Problem(drift, lambda x, u: 1.0, hjb.Ball(unit, inputs), discount=0.0, target=corner)
    grid = hjb.Grid([-1.0] * inputs, [1.0] * inputs, (5,) * inputs)
    x = grid.nodes()
    return problem, grid, (x[..., 0] <= 0.6) & (x[..., 1] >= -0.6)


@pytest.mark.slow
@pytest.mark.parametrize(("inputs", "unit"), [(2, 1e-6), (2, 1.0), (3, 1e3)])
def test_a_part_of_a_ball_thinner_than_its_samples(inputs, unit):
    problem, grid, known = thin(inputs, unit)
    held = np.array([problem.target(x) <= 0 for x in grid.nodes().reshape(-1, inputs)]).reshape(grid.shape)
    np.testing.assert_array_equal(reached(problem, grid, held, surely=True), known)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach the target")
def test_the_long_way_through_a_thin_part_of_a_ball_is_found_in_a_batch_as_well():
    """From zero the iteration waits at rest, at a cost; the answers under a vanishing discount lead it on its way."""
    problem, grid, known = thin(2, 1.0)
    alone = hjb.solve(problem, grid, scheme=hjb.Upwind())
    (lane,) = hjb.solve_batch([problem], grid, scheme=hjb.Upwind())
    np.testing.assert_array_equal(np.isfinite(lane.value), known)
    np.testing.assert_allclose(lane.value[known], alone.value[known], atol=lane.error + alone.error, rtol=0)
    assert len(lane.residuals) == int(lane.steps) + 1


def test_nothing_is_reached_but_the_held_nodes():
    problem = on_line(np.zeros((8, 3)), np.zeros((8, 3)))
    np.testing.assert_array_equal(reached(problem, GRID, np.arange(8) == 3, True), np.arange(8) == 3)


def test_a_periodic_axis_leads_around():
    ring = hjb.Grid([0.0], [8.0], (8,), periodic=[True])
    problem, held = on_line(np.ones((8, 3)), np.zeros((8, 3))), np.arange(8) == 3
    assert reached(problem, ring, held, True).all()
    np.testing.assert_array_equal(reached(problem, GRID, held, True), np.arange(8) <= 3)
