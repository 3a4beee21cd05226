"""Which nodes reach the target, against a plain search over the chain's transition matrices."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import Rates
from hjbjax.markov_chain import chain
from hjbjax.solution.clock import Clock
from hjbjax.well_posedness import attainability, tried_actions

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


def searched(held, jumps, periodic):
    """The nodes with a path of jumps to a held one, one node after the other."""
    found, waiting, shape = held.copy(), list(zip(*np.nonzero(held), strict=True)), held.shape
    while waiting:
        node = waiting.pop()
        for offset, jump in zip(jumps.offsets, jumps.values, strict=True):
            before = [k - step for k, step in zip(node, offset, strict=True)]
            if any(not (0 <= k < n or ring) for k, n, ring in zip(before, shape, periodic, strict=True)):
                continue
            before = tuple(k % n for k, n in zip(before, shape, strict=True))
            if jump[before] and not found[before]:
                found[before] = True
                waiting.append(before)
    return found


def inside_box(jump, offset, periodic):
    """The jumps that lead to a node, as those of a chain do."""
    for axis, (step, ring) in enumerate(zip(offset, periodic, strict=True)):
        places = np.arange(jump.shape[axis]) + step
        leaves = (places < 0) | (places >= jump.shape[axis])
        jump = jump & (ring | ~np.expand_dims(leaves, tuple(k for k in range(jump.ndim) if k != axis)))
    return jump


@pytest.mark.parametrize("winding", [30, 1])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_paths_are_those_of_a_plain_search(monkeypatch, dim, winding):
    """200 random sets of jumps in all; with ``winding`` 1 the search for winding paths has the last word."""
    monkeypatch.setattr(attainability, "WINDING", winding)
    rng = np.random.default_rng(10 * dim + winding)
    for _ in range(34):
        shape, periodic = tuple(rng.integers(2, 9, dim)), rng.random(dim) < 0.4
        every = [offset for offset in itertools.product((-1, 0, 1), repeat=dim) if any(offset)]
        offsets = tuple(every[k] for k in rng.permutation(len(every))[: 2 * dim])
        likely = rng.choice([0.2, 0.5, 0.9])
        values = tuple(inside_box(rng.random(shape) < likely, offset, periodic) for offset in offsets)
        held, jumps = rng.random(shape) < 0.1, Rates(offsets, values)
        grid = hjb.Grid(np.zeros(dim), np.ones(dim), shape, periodic=tuple(map(bool, periodic)))
        found = attainability._backward_reach(held, jumps, grid, Clock())
        np.testing.assert_array_equal(found, searched(held, jumps, periodic))


def test_a_maze_is_searched():
    """A corridor with 40 corners: a round of sweeps turns two of them."""
    grid = hjb.Grid([0.0, 0.0], [1.0, 1.0], (21, 21))
    corridor = np.zeros(grid.shape, bool)
    corridor[::2], corridor[1::4, -1], corridor[3::4, 0] = True, True, True
    offsets = ((1, 0), (-1, 0), (0, 1), (0, -1))
    leads = [np.roll(corridor, [-k for k in offset], (0, 1)) & corridor for offset in offsets]
    values = tuple(inside_box(jump, offset, (False, False)) for jump, offset in zip(leads, offsets, strict=True))
    held = np.zeros(grid.shape, bool)
    held[0, 0] = True
    found = attainability._backward_reach(held, Rates(offsets, values), grid, Clock())
    np.testing.assert_array_equal(found, corridor)


def test_few_actions_come_first():
    problem = hjb.Problem(turning, None, hjb.Box([-1.0, 0.0], [1.0, 3.0]), discount=1.0)
    points, few = tried_actions.control_samples(problem)
    assert {tuple(row) for row in points[:few]} == set(itertools.product((-1.0, 0.0, 1.0), (0.0, 1.5, 3.0)))
    assert len(np.unique(points, axis=0)) == len(points) == 49
    assert tried_actions.control_samples(hjb.Problem(lambda x: x, None, discount=1.0))[1] == 1


@pytest.mark.parametrize("surely", [True, False])
def test_how_often_the_clock_is_looked_at_changes_no_node(monkeypatch, surely):
    problem = hjb.Problem(turning, None, hjb.Finite(MOVES), noise=[0.5, 0.0], discount=1.0)
    held = np.zeros(PLANE.shape, bool)
    held[3, 4] = True
    expected = reached(problem, PLANE, held, surely)
    phases, enter = [], Clock.enter
    monkeypatch.setattr(Clock, "enter", lambda clock, phase: (phases.append(phase), enter(clock, phase)))
    monkeypatch.setattr(attainability, "LOOK", 2 * PLANE.size)
    np.testing.assert_array_equal(reached(problem, PLANE, held, surely), expected)
    assert sum("jumps of the chain" in phase for phase in phases) >= len(MOVES) // 2


def priced(x, u):
    return u[0] * u[0]


@pytest.mark.parametrize("dearest", [pytest.param(None, marks=pytest.mark.slow), 0.0])
def test_a_refuge_is_the_largest_set_that_an_action_keeps_to(dearest):
    """On a line with random moves, against the definition; dear actions do not count."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        drifts, noises = rng.choice([-1.0, 0.0, 1.0], (8, 3)), rng.choice([0.0, 0.0, 0.0, 0.5], (8, 3))
        problem = dataclasses.replace(on_line(drifts, noises), cost=jax.tree_util.Partial(priced))
        start = rng.random(8) < 0.8
        tables = [
            chain.matrix(problem, GRID, np.full((8, 1), u), scheme=hjb.Upwind()).toarray()
            for u in ([0.0] if dearest == 0 else MOVES[:, 0])
        ]
        expected = start
        for _ in range(8):
            stays = [~np.any((table > 0) & ~expected, axis=1) for table in tables]
            expected = expected & np.any(stays, axis=0)
        with jax.enable_x64(True):
            on = Discretisation(problem, GRID, hjb.Upwind(), np.float64)
            price = None if dearest is None else np.float64(dearest)
            found = attainability.refuge(on, np.asarray(start), price)
        np.testing.assert_array_equal(found, expected)


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
