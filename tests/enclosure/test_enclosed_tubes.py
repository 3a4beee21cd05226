"""The inner set is in the tube and the outer set contains it, by exact answers and by oracles in plain NumPy."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.enclosure.interpolant import Spline
from hjbjax.enclosure.tube_levels import hulls, spline_coefficients
from hjbjax.enclosure.tubes import set_functions

UNIT, HALF = hjb.Box([-1.0], [1.0]), hjb.Box([-0.5], [0.5])


def marched(problem, grid, horizon, count):
    return hjb.march(problem, grid, horizon, times=np.linspace(0.0, horizon, count))


def interval(found, lo, hi, count=4001):
    """Check both sets of a tube that is an interval; returns the largest distance between the sets in cells."""
    x = np.linspace(float(found.grid.lo[0]), float(found.grid.hi[0]), count)[:, None]
    inner, outer, within = found.inner_at(x), found.outer_at(x), (x[:, 0] >= lo) & (x[:, 0] <= hi)
    assert np.all(within[inner])
    assert np.all(outer[within])
    step = float(found.grid.spacing(0))
    ends = [x[inner, 0].min() - x[outer, 0].min(), x[outer, 0].max() - x[inner, 0].max()]
    return max(ends) / step


def size(x):
    return jnp.abs(x[0]) - 0.5


@pytest.mark.parametrize(
    "problem",
    [
        hjb.reach(lambda x, u, d: u + d, UNIT, size, disturbances=HALF),
        hjb.avoid(lambda x, u, d: u + d, HALF, size, disturbances=UNIT),
        hjb.reach(lambda x, u, d: u + d, UNIT, size, disturbances=HALF, tube=False),
        pytest.param(
            hjb.reach(
                lambda x, u, d: u + d, hjb.Finite([[-1.0], [1.0]]), size, disturbances=hjb.Finite([[-0.5], [0.5]])
            ),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["reach", "avoid", "set", "finite"],
)
def test_a_pursuit_on_a_line_is_enclosed(problem):
    """x' = u + d where one player is faster by ½: the tube of |x| ≤ ½ is |x| ≤ ½ + T/2."""
    found = hjb.enclose_tube(problem, marched(problem, hjb.Grid([-2.0], [2.0], (41,)), 1.0, 21))
    assert interval(found, -1.0, 1.0) < 0.2
    assert found.is_free
    assert "empty" not in found.message


@pytest.mark.slow
@pytest.mark.parametrize("tube", [True, False])
def test_a_target_behind_an_obstacle_is_enclosed(tube):
    """At unit speed |x| ≤ ½ is reached from −½ − T on, and up to the obstacle 1 ≤ x ≤ 1.5, which no path may touch."""
    problem = hjb.reach_avoid(lambda x, u: u, UNIT, size, lambda x: jnp.abs(x[0] - 1.25) - 0.25, tube=tube)
    found = hjb.enclose_tube(problem, marched(problem, hjb.Grid([-2.5], [2.5], (101,)), 1.0, 41))
    assert interval(found, -1.5, 1.0) < 1.0


def test_a_nonlinear_drift_is_enclosed_at_another_level():
    """The right end of the tube for V ≤ 0.1 recedes at the speed ½ − 0.4 sin 2x."""
    problem = hjb.reach(lambda x, u, d: 0.4 * jnp.sin(2 * x) + u + d, UNIT, size, disturbances=HALF)
    found = hjb.enclose_tube(problem, marched(problem, hjb.Grid([-2.0], [2.0], (61,)), 1.0, 31), level=0.1)
    speed, end, step = lambda x: 0.5 - 0.4 * np.sin(2 * x), 0.6, 1e-3
    for _ in range(1000):
        end += step * speed(end + step / 2 * speed(end))  # the midpoint rule
    assert interval(found, -end, end) < 0.3


def test_a_level_outside_the_range_of_the_value_has_an_empty_tube():
    """σ was −1.8e308, which overflowed."""
    problem = hjb.reach(lambda x, u: u, UNIT, size)
    solution = marched(problem, hjb.Grid([-2.0], [2.0], (41,)), 0.5, 11)
    found = hjb.enclose_tube(problem, solution, level=-3.0)
    assert np.all(np.isnan(found.inner))
    assert np.all((found.outer > 0) & (found.outer < 100))
    assert not found.outer_at(np.linspace(-2, 2, 50)[:, None]).any()
    assert "the inner set is empty" in found.message


def test_a_moving_target_is_enclosed():
    """l = |x − 0.3 t| − ½ at unit speed: the tube runs from −½ − 0.7 T to ½ + 1.3 T."""
    problem = hjb.reach(lambda t, x, u: u, UNIT, lambda t, x: jnp.abs(x[0] - 0.3 * t) - 0.5, time_dependent=True)
    found = hjb.enclose_tube(problem, marched(problem, hjb.Grid([-2.5], [3.0], (111,)), 1.0, 41))
    assert interval(found, -1.2, 1.8) < 0.5


@pytest.mark.filterwarnings("ignore:the grid is coarse")  # V is constant in truth, so its range is its error
def test_a_tube_that_meets_the_ends_is_that_of_the_problem_with_walls():
    problem = hjb.reach(lambda x, u: u, UNIT, size)
    found = hjb.enclose_tube(problem, marched(problem, hjb.Grid([-1.0], [1.0], (21,)), 1.0, 11))
    assert not found.is_free
    assert "with walls" in found.message
    assert np.all(found.inner_at([[-1.0], [0.0], [1.0]]))
    assert found.outer_at([[5.0]]).all()
    assert not found.inner_at([[5.0]]).any()


def reached(states, distance, horizon, power, steps=400, switches=81):
    """The least distance of a double integrator under one switch between ± power: by the maximum principle, V."""
    best = np.full(len(states), np.inf)
    for sign in (-power, power):
        for switch in np.linspace(0.0, horizon, switches):
            t = np.linspace(0.0, horizon, steps + 1)[:, None]
            before, after = np.minimum(t, switch), np.maximum(t - switch, 0.0)
            speed = states[:, 1] + sign * (before - after)
            place = states[:, 0] + states[:, 1] * t
            place = place + sign * (before**2 / 2 + before * after - after**2 / 2)
            best = np.minimum(best, distance(np.stack([place, speed])).min(axis=0))
    return best


def disc(x):
    return jnp.sqrt(x[0] ** 2 + x[1] ** 2 + 1e-12) - 0.5


def square(x):
    return jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1])) - 0.5


def along_rays(found, count=64, points=1500):
    """The distance between the sets along rays from the origin, in cells, (count,)."""
    angles, radii = np.linspace(0, 2 * np.pi, count, endpoint=False), np.linspace(0.0, 1.99, points)
    states = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    inner, outer = found.inner_at(states), found.outer_at(states)
    return (outer.sum(axis=0) - inner.sum(axis=0)) * (radii[1] - radii[0]) / float(found.grid.spacing(0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "count", "cells", "rivals"),
    [(disc, 41, 2.0, False), (disc, 81, 2.0, False), (disc, 41, 2.0, True), (square, 41, 6.0, False)],
)
def test_the_tube_of_a_double_integrator_is_enclosed(target, count, cells, rivals):
    """A rival with half of the power on the same axis leaves the control half of its power."""
    problem = hjb.reach(lambda x, u: jnp.stack([x[1], u[0]]), UNIT, target)
    if rivals:
        problem = hjb.reach(lambda x, u, d: jnp.stack([x[1], u[0] + d[0]]), UNIT, target, disturbances=HALF)
    solution = marched(problem, hjb.Grid([-2.0, -2.0], [2.0, 2.0], (count, count)), 1.0, count // 2 + 1)
    found = hjb.enclose_tube(problem, solution)
    states = np.random.default_rng(0).uniform(-2, 2, (4000, 2))
    kind = (lambda x: np.hypot(*x) - 0.5) if target is disc else (lambda x: np.abs(x).max(axis=0) - 0.5)
    value = reached(states, kind, 1.0, 0.5 if rivals else 1.0)
    assert np.all(value[found.inner_at(states)] <= 0.01)  # the oracle samples times and switches
    assert np.all(value[~found.outer_at(states)] > 0)
    assert np.median(along_rays(found)) < cells
    np.testing.assert_array_equal(found.inner <= 0, found.inner_at(found.grid.nodes()))
    np.testing.assert_array_equal(found.outer <= 0, found.outer_at(found.grid.nodes()))


@pytest.mark.slow
def test_the_tube_that_a_double_integrator_cannot_avoid_is_enclosed():
    """Minus the largest over one-switch controls of the least distance bounds V from above."""
    problem = hjb.avoid(lambda x, u: jnp.stack([x[1], u[0]]), UNIT, disc)
    solution = marched(problem, hjb.Grid([-2.0, -2.0], [2.0, 2.0], (61, 61)), 1.0, 31)
    found = hjb.enclose_tube(problem, solution)
    states = np.random.default_rng(0).uniform(-2, 2, (4000, 2))
    t, best = np.linspace(0.0, 1.0, 401)[:, None], np.full(len(states), -np.inf)
    for sign in (-1.0, 1.0):
        for switch in np.linspace(0.0, 1.0, 41):
            before, after = np.minimum(t, switch), np.maximum(t - switch, 0.0)
            speed = states[:, 1] + sign * (before - after)
            place = states[:, 0] + states[:, 1] * t + sign * (before**2 / 2 + before * after - after**2 / 2)
            best = np.maximum(best, (np.hypot(place, speed) - 0.5).min(axis=0))
    assert np.all(best[found.inner_at(states)] <= 0)
    assert np.all(best[~found.outer_at(states)] > -0.01)
    assert np.median(along_rays(found)) < 2


def turned(states, horizon, steps=100, switches=41):
    """The least distance of a Dubins car from a disc under two arcs, left, straight or right: at least V."""
    t, best = np.linspace(0.0, horizon, steps + 1)[:, None], np.full(len(states), np.inf)

    def arc(x, y, angle, turn, time):
        after = angle + turn * time
        if turn == 0:
            return x + time * np.cos(angle), y + time * np.sin(angle), after
        return x + (np.sin(after) - np.sin(angle)) / turn, y - (np.cos(after) - np.cos(angle)) / turn, after

    for first in (-1.0, 0.0, 1.0):
        for second in (-1.0, 0.0, 1.0):
            for switch in np.linspace(0.0, horizon, switches):
                x, y, angle = arc(*states.T, first, np.minimum(t, switch))
                x, y, _ = arc(x, y, angle, second, np.maximum(t - switch, 0.0))
                best = np.minimum(best, (np.hypot(x, y) - 0.5).min(axis=0))
    return best


@pytest.mark.slow
def test_the_tube_of_a_dubins_car_is_enclosed_within_two_cells():
    problem = hjb.reach(lambda x, u: jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]), u[0]]), UNIT, disc)
    grid = hjb.Grid([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi], (49, 49, 48), periodic=(False, False, True))
    found = hjb.enclose_tube(problem, marched(problem, grid, 1.0, 21))
    states = np.random.default_rng(0).uniform([-2, -2, -np.pi], [2, 2, np.pi], (2000, 3))
    value = turned(states, 1.0)
    assert np.all(value[found.inner_at(states)] <= 0.01)
    assert np.all(value[~found.outer_at(states)] > 0)
    angles, radii = np.linspace(0, 2 * np.pi, 24, endpoint=False), np.linspace(0.0, 1.99, 400)
    rays = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    widths = []
    for heading in np.linspace(-np.pi, np.pi, 8, endpoint=False):
        full = np.concatenate([rays, np.full((*rays.shape[:2], 1), heading)], axis=-1)
        widths.append((found.outer_at(full).sum(axis=0) - found.inner_at(full).sum(axis=0)) * (radii[1] - radii[0]))
    assert np.median(widths) < 2 * float(grid.spacing(0))


def hit(states, slope, horizon):
    """True if the straight path (x − t, y + slope t) meets the disc before the horizon."""
    move = np.array([-1.0, slope])
    t = np.clip(-(states @ move) / (move @ move), 0.0, horizon)
    return np.hypot(*(states + t[:, None] * move).T) <= 0.5


@pytest.mark.slow
@pytest.mark.parametrize("finite", [False, True])
def test_a_tube_with_an_edge_is_enclosed_by_its_branches(finite):
    """A craft passes a disc on one of two sides, x' = −1 and y' = u, |u| ≤ ½: it is hit if both straight paths meet it.

    Between them a path stays in front of the disc, because the paths above it and below it do. Both barriers meet at
    an edge. There the level of one spline rises at a rate that does not fall with the mesh: the shift was 9 cells.
    """
    controls = hjb.Finite([[-0.5], [0.5]]) if finite else HALF
    problem = hjb.avoid(lambda x, u: jnp.stack([-1.0 + 0 * x[0], u[0]]), controls, disc)
    solution = marched(problem, hjb.Grid([-1.0, -1.5], [2.5, 1.5], (71, 61)), 1.5, 31)
    found = hjb.enclose_tube(problem, solution)
    states = np.random.default_rng(0).uniform([-1.0, -1.5], [2.5, 1.5], (20_000, 2))
    truth = hit(states, 0.5, 1.5) & hit(states, -0.5, 1.5)
    inner, outer = found.inner_at(states), found.outer_at(states)
    assert np.all(truth[inner])
    assert np.all(outer[truth])
    assert max(found.shifts) < 0.6 * float(found.grid.spacing(0))
    np.testing.assert_array_equal(found.outer <= 0, found.outer_at(found.grid.nodes()))


def flown(turns, switches, count, place, speed=5.0, horizon=0.8):
    """The positions on paths of two arcs, (count, turns, turns, switches, *place[0].shape, 2).

    Args:
      turns: the rates of turn.
      switches: the times at which the second arc begins.
      count: the number of times from zero to the horizon.
      place: coordinates and heading at time zero.
    """
    t = np.linspace(0.0, horizon, count).reshape(-1, *(1,) * 3)
    first, second = np.reshape(turns, (-1, 1, 1)), np.reshape(turns, (1, -1, 1))
    before, after = np.minimum(t, switches), np.maximum(t - switches, 0.0)
    fill = (..., *(None,) * np.ndim(place[0]))
    x, y, heading = place
    for turn, time in ((first, before), (second, after)):
        turned, half = (turn * time)[fill], (turn * time / 2)[fill]
        chord = speed * time[fill] * np.sinc(half / np.pi)
        x, y, heading = x + chord * np.cos(heading + half), y + chord * np.sin(heading + half), heading + turned
    return np.stack([x, y], axis=-1)


def relative(x, u, d):
    """Mitchell's Air3D: a pursuer seen by an evader; both fly at speed 5 and turn at a rate of at most one."""
    return jnp.stack([-5 + 5 * jnp.cos(x[2]) + u[0] * x[1], 5 * jnp.sin(x[2]) - u[0] * x[0], d[0] - u[0]])


@pytest.mark.slow
def test_the_tube_of_two_aircraft_is_enclosed_within_two_cells():
    """Against an evader that only turns, and a pursuer that does, paths of two arcs bound the least distance."""
    problem = hjb.avoid(relative, UNIT, lambda x: jnp.sqrt(x[0] ** 2 + x[1] ** 2 + 1e-12) - 5.0, disturbances=UNIT)
    grid = hjb.Grid([-7.5, -9.0, 0.0], [14.5, 9.0, 2 * np.pi], (31, 27, 26), periodic=(False, False, True))
    found = hjb.enclose_tube(problem, marched(problem, grid, 0.8, 15))
    states = np.random.default_rng(0).uniform(grid.lo, grid.hi, (600, 3))
    pursuer = flown([-1.0, 0.0, 1.0], np.linspace(0.0, 0.8, 9), 33, states.T)
    evader = flown([-1.0, 0.0, 1.0], np.linspace(0.0, 0.8, 9), 33, np.zeros(3))[..., None, :]
    turning = lambda paths, k: paths[:, k, k, :1][:, None, None]  # noqa: E731 - one rate of turn without a switch
    least = lambda apart: np.hypot(apart[..., 0], apart[..., 1]).min(axis=0)  # noqa: E731
    # the pursuer finds its best path against each turn of the evader
    caught = [least(pursuer - turning(evader, k)).min(axis=(0, 1, 2)) for k in (0, 2)]
    assert np.all(np.max(caught, axis=0)[found.inner_at(states)] <= 5.02)
    # the evader finds its best path against each turn of the pursuer
    passed = [least(evader - turning(pursuer, k)).max(axis=(0, 1, 2)) for k in (0, 1, 2)]
    assert np.all(np.min(passed, axis=0)[~found.outer_at(states)] >= 4.98)
    angles, radii = np.linspace(0, 2 * np.pi, 24, endpoint=False), np.linspace(0.0, 14.0, 1000)
    rays = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    widths = []
    for heading in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        full = np.concatenate([rays, np.full((*rays.shape[:2], 1), heading)], axis=-1)
        between = found.outer_at(full) & ~found.inner_at(full) & np.all(np.abs(full) <= grid.hi, axis=-1)
        between &= np.all(full >= grid.lo, axis=-1)
        widths.append(between.sum(axis=0) * (radii[1] - radii[0]))
    assert np.median(widths) < 2 * float(grid.spacing(1))
    assert found.is_free


def test_values_at_nodes_that_rounding_may_move_prove_nothing():
    """The functions at the nodes used the other end of the range of W."""
    grid = hjb.Grid([0.0, 0.0], [1.0, 1.0], (4, 4))
    values = 1e8 + np.random.default_rng(0).normal(size=grid.shape)
    spline, state = Spline.on(grid), np.array([[0.0, 1 / 3]])
    x = hjb.Grid([0.0], [1.0], (4,))
    w = spline.at(state).values(values)
    assert w.hi > w.lo
    middle = float((w.lo + w.hi)[0] / 2)
    inner, outer = set_functions(x, spline, values[None], np.array([[middle], [-middle]]), False)
    assert inner[1] > 0
    assert outer[1] < 0


def test_the_hulls_of_the_coefficients_contain_the_spline():
    draw = np.random.default_rng(0)
    grid = hjb.Grid([0.0, 0.0], [2.0, 1.0], (7, 8), periodic=(False, True), stretch=(hjb.Sinh(2.0, 0.4), None))
    values, spline = draw.normal(size=grid.shape), Spline.on(grid)
    least, most = hulls(values, grid)
    assert np.all(most >= spline.range(values).hi - 1e-11)
    assert np.all(least <= 1e-11 + spline.range(values).lo)


def test_the_hulls_contain_the_spline_at_corners():
    """There the coefficients continue along several axes."""
    draw = np.random.default_rng(0)
    for shape in ((5, 8), (4, 5, 5)):
        zero = np.zeros(len(shape))
        grid = hjb.Grid(zero, zero + 1, shape)
        for _ in range(10):
            values, spline = draw.integers(-3, 4, shape).astype(float), Spline.on(grid)
            least, most = hulls(values, grid)
            states = np.round(8 * draw.uniform(size=(3000, len(shape)))) / 8
            index, found = spline.index(states), spline.at(states).values(values)
            assert np.all(least[index] <= found.hi)
            assert np.all(found.lo <= most[index])


def test_wrong_values_next_to_a_wall_do_not_exclude_its_states():
    """W is large at the lower end at t = 0 only, where the target is, because the value next to it is small."""
    problem = hjb.reach(lambda x, u: u, hjb.Box([-0.1], [0.1]), lambda x: x[0] + 0.5)
    solution = marched(problem, hjb.Grid([-1.0], [1.0], (9,)), 1.0, 6)
    coefficients = np.repeat(20 * np.linspace(-1, 0, 6)[:, None], 9, axis=1)
    coefficients[0, 1] -= 200
    values, mesh = coefficients, hjb.Grid([0.0, -1.0], [1.0, 1.0], (6, 9), edges=("open", "projected"))
    for _ in range(60):  # the values with these coefficients
        values = values + (coefficients - spline_coefficients(values, mesh))
    found = hjb.enclose_tube(problem, dataclasses.replace(solution, value=values))
    assert np.all(found.outer_at(np.linspace(-1, -0.41, 60)[:, None]))


@pytest.mark.parametrize(("where", "number"), [((-1, slice(None)), 1e307), ((0, 0), -1.7e308), ((-1, 3), -1.7e308)])
def test_values_whose_sums_may_overflow_are_refused(where, number):
    """They gave wrong inner and outer sets."""
    problem = hjb.reach(lambda x, u: u, UNIT, size)
    solution = marched(problem, hjb.Grid([-1.0], [1.0], (9,)), 0.5, 6)
    values = np.array(solution.value, float)
    values[where] = number
    with pytest.raises(ValueError, match="not below 1e"):
        hjb.enclose_tube(problem, dataclasses.replace(solution, value=values))


def test_tubes_without_a_proof_are_refused():
    grid, problem = hjb.Grid([-2.0], [2.0], (41,)), hjb.reach(lambda x, u: u, UNIT, size)
    solution = marched(problem, grid, 1.0, 5)
    with pytest.raises(ValueError, match="got a solution with 2 times"):
        hjb.enclose_tube(problem, marched(problem, grid, 1.0, 2))
    with pytest.raises(ValueError, match="a running cost"):
        hjb.enclose_tube(hjb.Problem(lambda x, u: u, lambda x, u: 1.0, UNIT), solution)
    with pytest.raises(ValueError, match="noise"):
        hjb.enclose_tube(hjb.Problem(lambda x, u: u, None, UNIT, noise=0.1, stopping_cost=size), solution)
    with pytest.raises(MemoryError):
        hjb.enclose_tube(problem, solution, max_memory=1000)
    with pytest.raises(ValueError, match="depth"):
        hjb.enclose_tube(problem, solution, depth=-1)
    with pytest.raises(ValueError, match="level"):
        hjb.enclose_tube(problem, solution, level=np.nan)
    ends = marched(problem, hjb.Grid([-2.0], [2.0], (41,), edges="open"), 1.0, 5)
    with pytest.raises(ValueError, match="open ends"):
        hjb.enclose_tube(problem, ends)
