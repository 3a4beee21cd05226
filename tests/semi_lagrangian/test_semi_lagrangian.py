"""SemiLagrangian(): its discrete equation beside a plain one in NumPy, exact answers, certificates, refusals."""

import functools
import itertools
import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from switching_curves import furthest_miss

import hjbjax as hjb
from benchmarks import cases
from hjbjax import zoo

ONE = hjb.Box([-1.0], [1.0])
PLAIN = hjb.Upwind(central=False)
LEGS = (1, 4, 16)


def slide(x, u):
    return u + 0.3


def turn(x, u):
    return jnp.stack([x[1], -x[0] + u[0] * (1 + 0.3 * jnp.cos(x[1]))])


def hold(x, u):
    return 0.0 * x[0] + 1.0


def square(x, u):
    return 1 + x @ x + 0.1 * u[0]


def near(x):
    return jnp.sum(jnp.abs(x)) - 0.3


def forbidden(x):
    return jnp.where(x[0] < 0.4, jnp.inf, 0.2)


def leave(x):
    return 0.2 * jnp.cos(x[0])


# --- an oracle in plain NumPy, one state and one arc after the other ---


def weights(grid, x):
    """The corners around a state and their multilinear weights, as flat numbers and shares."""
    found = [((), 1.0)]
    for axis in range(grid.ndim):
        nodes, periodic = np.asarray(grid.axis(axis)), grid.periodic[axis]
        ends = np.append(nodes, grid.hi[axis]) if periodic else nodes
        k = min(max(int(np.searchsorted(ends, x[axis], side="right")) - 1, 0), len(ends) - 2)
        s = (x[axis] - ends[k]) / (ends[k + 1] - ends[k])
        pairs = ((k, 1 - s), ((k + 1) % len(nodes), s))
        found = [((*index, j), weight * part) for index, weight in found for j, part in pairs]
    return [(np.ravel_multi_index(index, grid.shape), weight) for index, weight in found]


def into(grid, x):
    lo, hi = np.asarray(grid.lo), np.asarray(grid.hi)
    return np.where(grid.periodic, lo + np.mod(x - lo, hi - lo), np.clip(x, lo, hi))


def arc(numbers, grid, x, u, legs, slowest):
    """The cost of an arc of a problem given by NumPy functions, e^{−βτ} or None if it came to the target, its end."""
    f, cost, target, exit_cost, beta = numbers
    time = paid = 0.0
    h = np.array([float(grid.spacing(axis)) for axis in range(grid.ndim)])
    for _ in range(legs):
        a = f(x, u)
        dt = 1 / max(np.max(np.abs(a) / h), slowest)
        b = f(into(grid, x + dt / 2 * a), u)
        c = f(into(grid, x + dt / 2 * b), u)
        d = f(into(grid, x + dt * c), u)
        mean = (a + 2 * b + 2 * c + d) / 6

        def at(s, x=x, dt=dt, a=a, d=d, mean=mean):
            return into(grid, x + dt * ((3 - 2 * s) * s * s * mean + s * (1 - s) ** 2 * a + s * s * (s - 1) * d))

        share, met = 1.0, False
        if target is not None:
            here, there = target(x), target(at(1.0))
            met = there <= 0
            share = here / (here - there) if met else 1.0
        lasts = share * dt
        level = (cost(x, u) + 4 * cost(at(share / 2), u) + cost(at(share), u)) / 6
        paid += math.exp(-beta * time) * level * ((1 - math.exp(-beta * lasts)) / beta if beta else lasts)
        time, x = time + lasts, at(share)
        if met:
            return paid + math.exp(-beta * time) * exit_cost(x), None, x
    return paid, math.exp(-beta * time), x


def oracle(numbers, grid, actions, legs, stop=None, steps=3000):
    """V_h by value iteration on dense rows, and the largest Q − V it leaves."""
    f, _, target, exit_cost, _ = numbers
    nodes = grid.nodes().reshape(-1, grid.ndim)
    h = np.array([float(grid.spacing(axis)) for axis in range(grid.ndim)])
    slowest = 0.1 * max(np.max(np.abs(f(x, u)) / h) for x, u in itertools.product(nodes, actions))
    held = np.array([target is not None and target(x) <= 1e-12 for x in nodes])
    pay, rows = (
        np.zeros((len(nodes), len(actions) * len(legs))),
        np.zeros((len(nodes), len(actions) * len(legs), len(nodes))),
    )
    for i, x in enumerate(nodes):
        for k, (u, count) in enumerate(itertools.product(actions, legs)):
            if not held[i]:
                pay[i, k], keep, end = arc(numbers, grid, x, u, count, slowest)
                for j, weight in () if keep is None else weights(grid, end):
                    rows[i, k, j] += keep * weight
    ending = np.array([exit_cost(x) if inside else 0.0 for x, inside in zip(nodes, held, strict=True)])
    limit = np.full(len(nodes), np.inf) if stop is None else np.array([stop(x) for x in nodes])
    value = np.where(held, ending, 0.0)
    for _ in range(steps):
        value = np.where(held, ending, np.minimum(limit, np.min(pay + rows @ value, axis=1)))
    return value.reshape(grid.shape)


QUESTIONS = {
    "a line to a target": (
        lambda: (
            hjb.Problem(slide, hold, ONE, discount=0.5, target=near, exit_cost=leave),
            hjb.Grid([-1.0], [1.5], (14,)),
        ),
        (lambda x, u: u + 0.3, lambda x, u: 1.0, lambda x: np.sum(np.abs(x)) - 0.3, lambda x: 0.2 * np.cos(x[0]), 0.5),
        None,
    ),
    "a plane, walls and a long stay": (
        lambda: (hjb.Problem(turn, square, ONE, discount=0.7), hjb.Grid([-1.0, -1.2], [1.1, 1.0], (7, 8))),
        (
            lambda x, u: np.array([x[1], -x[0] + u[0] * (1 + 0.3 * np.cos(x[1]))]),
            lambda x, u: 1 + x @ x + 0.1 * u[0], None, None, 0.7,
        ),
        None,
    ),
    "round an axis, stopping, no discount": (
        lambda: (
            hjb.Problem(slide, hold, ONE, target=near, stopping_cost=lambda x: 0.4 + 0.0 * x[0]),
            hjb.Grid([-1.0], [1.5], (12,), periodic=(True,)),
        ),
        (lambda x, u: u + 0.3, lambda x, u: 1.0, lambda x: np.sum(np.abs(x)) - 0.3, lambda x: 0.0, 0.0),
        lambda x: 0.4,
    ),
    "round an axis, no stopping in a part": (
        lambda: (
            hjb.Problem(slide, hold, ONE, discount=0.6, stopping_cost=forbidden),
            hjb.Grid([-1.0], [1.5], (12,), periodic=(True,)),
        ),
        (lambda x, u: u + 0.3, lambda x, u: 1.0, None, None, 0.6),
        lambda x: np.inf if x[0] < 0.4 else 0.2,
    ),
    "a plane with a periodic axis, no stopping in a part": (
        lambda: (
            hjb.Problem(turn, square, ONE, discount=0.7, stopping_cost=forbidden),
            hjb.Grid([-1.0, -1.2], [1.1, 1.0], (7, 8), periodic=(False, True)),
        ),
        (
            lambda x, u: np.array([x[1], -x[0] + u[0] * (1 + 0.3 * np.cos(x[1]))]),
            lambda x, u: 1 + x @ x + 0.1 * u[0], None, None, 0.7,
        ),
        lambda x: np.inf if x[0] < 0.4 else 0.2,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", QUESTIONS)
def test_the_discrete_equation_is_that_of_an_independent_oracle(name):
    question, numbers, stop = QUESTIONS[name]
    problem, grid = question()
    corners = [np.array([-1.0]), np.array([1.0])]
    known = oracle(numbers, grid, corners, LEGS, stop)
    for method in (None, hjb.ValueIteration()):
        solution = hjb.solve(problem, grid, scheme=hjb.SemiLagrangian(), method=method, tol=1e-9)
        assert np.max(np.abs(solution.value - known)) <= 2e-9
        assert solution.error <= 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("discount", [0.0, 0.8])
def test_certificates_hold_wherever_a_run_is_stopped(discount):
    problem, grid = zoo.double_integrator(discount=discount, shape=(31, 31))
    scheme = hjb.SemiLagrangian(cells=6)
    options = {"scheme": scheme, "method": hjb.PolicyIteration(hjb.Sweeps(1)), "throw": False}
    exact = hjb.solve(problem, grid, scheme=scheme, tol=1e-10).value
    bounds = []
    for steps in (2, 5, 9):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", hjb.SolveWarning)  # of ends at which an unfinished policy leaves the box
            solution = hjb.solve(problem, grid, tol=1e-9, max_steps=steps, **options)
        lower, upper = solution.bounds
        assert np.all(lower <= exact + 1e-9)
        assert np.all(exact <= upper + 1e-9)
        bounds.append(solution.error)
    assert bounds[-1] < bounds[0]
    guessed = hjb.solve(problem, grid, tol=1e-6, guess=exact + 0.01 * np.cos(np.arange(31)), **options)
    assert np.max(np.abs(guessed.value - exact)) <= guessed.error + 1e-9 <= 2e-6


@pytest.mark.parametrize("sign", [1, pytest.param(-1, marks=pytest.mark.slow)])
def test_certificates_hold_where_nothing_is_held(sign):
    """Without a target every node may have a residual of one sign, and V_h lie on one side of V everywhere."""
    problem, grid = QUESTIONS["a plane, walls and a long stay"][0]()
    options = {"scheme": hjb.SemiLagrangian(), "tol": 1e-10, "throw": False}
    exact = hjb.solve(problem, grid, **options).value
    rng = np.random.default_rng(5)
    for size in (0.01, 0.1, 1.0):
        guess = exact - sign * size * (1 + rng.uniform(size=grid.shape))
        for steps in (1, 2):
            method = hjb.PolicyIteration(hjb.Sweeps(1))
            lower, upper = hjb.solve(problem, grid, guess=guess, max_steps=steps, method=method, **options).bounds
            assert np.all(lower <= exact + 1e-9)
            assert np.all(exact <= upper + 1e-9)


@pytest.mark.slow
def test_one_dimension_is_exact():
    """(|x| − r)/(1 − c sgn x): straight arcs, and the boundary between two nodes."""
    problem = hjb.Problem(slide, hold, ONE, target=lambda x: jnp.abs(x[0]) - 0.21)
    solution = hjb.solve(problem, hjb.Grid([-1.0], [1.0], (41,)), scheme=hjb.SemiLagrangian(), tol=1e-9)
    x = solution.grid.nodes()[:, 0]
    assert solution.value == pytest.approx(np.maximum(np.abs(x) - 0.21, 0) / np.where(x > 0, 0.7, 1.3), abs=1e-12)
    single = hjb.solve(problem, solution.grid, scheme=hjb.SemiLagrangian(), tol=1e-4, dtype="float32")
    assert single.value.dtype == np.float32
    assert single.value == pytest.approx(solution.value, abs=1e-5)


def known_at(exact, grid):
    with jax.enable_x64(True):
        return np.asarray(jax.jit(jax.vmap(exact))(grid.nodes().reshape(-1, grid.ndim))).reshape(grid.shape)


@pytest.mark.parametrize(("radius", "most"), [(0.0, 6e-3), (0.2, 8e-4)])
def test_eikonal(radius, most):
    """A target of one node, which long arcs leap over, and a disc between the nodes; 64 directions.

    The chain with cut links is off by 1.7e-2 and by 7e-3.
    """
    problem, grid = zoo.eikonal(shape=(41, 41), radius=radius)
    known = known_at(zoo.eikonal_exact(radius=radius), grid)
    solution = hjb.solve(problem, grid, scheme=hjb.SemiLagrangian(), tol=1e-6)
    assert np.max(np.abs(solution.value - known)) <= most


@functools.cache
def integrated(which, scheme):
    problem, grid = cases.double_integrator(161) if which == "held" else zoo.double_integrator(shape=(161, 161))
    return hjb.solve(problem, grid, scheme=scheme, tol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["held", "disc"])
def test_double_integrator_has_a_fifth_of_the_error_of_the_chain(which):
    """With exact values on {T ≤ ½} and on the edge, and on the zoo's larger box with a disc of radius .2."""
    solution, plain = integrated(which, hjb.SemiLagrangian()), integrated(which, PLAIN)
    known = known_at(zoo.double_integrator_exact(), solution.grid)
    assert np.mean(np.abs(solution.value - known)) <= 0.2 * np.mean(np.abs(plain.value - known))
    assert solution.status is hjb.Status.CONVERGED
    assert solution.error <= 1e-4


@pytest.mark.slow
def test_double_integrator_switches_within_two_cells():
    assert furthest_miss(integrated("held", hjb.SemiLagrangian())) <= 2
    assert furthest_miss(integrated("held", PLAIN)) > 5


def test_smooth_controls_are_sampled():
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-4.0], [4.0]), discount=1.0)
    solution = hjb.solve(problem, hjb.Grid([-2.0], [2.0], (81,)), scheme=hjb.SemiLagrangian(), tol=1e-6)
    x = solution.grid.nodes()[:, 0]
    assert solution.value == pytest.approx((5**0.5 - 1) / 2 * x * x, abs=5e-3)
    assert len(np.unique(solution.policy)) > 10


def test_nodes_that_cannot_arrive_are_infinite():
    """A current of speed 1.5 carries the boat past the target: states downstream have no finite time."""
    problem = hjb.Problem(
        lambda x, u: jnp.stack([1.5 + u[0], u[1]]), hold, hjb.Ball(1.0, 2), target=lambda x: jnp.hypot(x[0], x[1]) - 0.3
    )
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (21, 21))
    with pytest.warns(hjb.SolveWarning, match="cannot reach the target"):
        solution = hjb.solve(problem, grid, scheme=hjb.SemiLagrangian(cells=8, actions=16), tol=1e-6)
    assert np.all(np.isinf(solution.value[~solution.reached]))
    assert np.all(np.isfinite(solution.value[solution.reached]))
    assert not solution.reached[15:, 10].any()
    assert solution.reached[:10, 10].all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot reach the target")
@pytest.mark.parametrize("scheme", [hjb.SemiLagrangian(), hjb.Upwind()])
def test_infinite_values_beside_finite_ones_are_not_mixed(scheme):
    """Time to a strip by motion in one direction round an axis; nodes beside the strip never arrive."""
    problem = hjb.Problem(
        lambda x, u: jnp.stack([0 * x[0], u[0]]), lambda x, u: 1.0, hjb.Box([0.0], [1.0]),
        target=lambda x: jnp.maximum(jnp.abs(x[0]) - 0.51, jnp.abs(x[1]) - 0.1),
    )  # fmt: skip
    grid = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (21, 20), periodic=(False, True))
    solution = hjb.solve(problem, grid, scheme=scheme, tol=1e-9)
    x, y = np.moveaxis(grid.nodes(), -1, 0)
    time = np.where(np.abs(y) < 0.11, 0.0, np.mod(-0.1 - y, 2))
    exact = np.where(np.abs(x) < 0.51, time, np.inf)
    np.testing.assert_allclose(solution.value, exact, atol=1e-8)
    between = [float(solution.value_at([x, 0.33])) for x in (-0.55, -0.5, -0.42, 0.5, 0.58)]
    np.testing.assert_allclose(between, [np.inf, 1.57, 1.57, 1.57, np.inf], atol=1e-8)


# --- what it is not for ---


def rest(**more):
    return hjb.Problem(slide, square, ONE, **({"discount": 1.0} | more))


def on_nodes(x, u):
    return jnp.where(jnp.abs(5 * x[0] - jnp.round(5 * x[0])) < 1e-6, 1.0, jnp.nan)


LINE = hjb.Grid([-1.0], [1.0], (11,))
REFUSED = {
    "noise": (lambda: hjb.solve(rest(noise=0.1), LINE, scheme=hjb.SemiLagrangian()), "noise.*Upwind"),
    "a game": (
        lambda: hjb.solve(
            hjb.Problem(lambda x, u, d: u + d, None, ONE, disturbances=ONE, discount=1.0), LINE,
            scheme=hjb.SemiLagrangian(),
        ),
        "game.*Upwind",
    ),
    "a running maximum": (
        lambda: hjb.solve(hjb.Problem(slide, None, ONE, running_max=near), LINE, scheme=hjb.SemiLagrangian()),
        "running_max",
    ),
    "open ends": (
        lambda: hjb.solve(rest(), hjb.Grid([-1.0], [1.0], (11,), edges="open"), scheme=hjb.SemiLagrangian()),
        "open ends",
    ),
    "constrained ends": (
        lambda: hjb.solve(rest(), hjb.Grid([-1.0], [1.0], (11,), edges="constrained"), scheme=hjb.SemiLagrangian()),
        "constrained ends",
    ),
    "rest points": (lambda: hjb.solve(rest(discount=0.0), LINE, scheme=hjb.SemiLagrangian()), "requires a target"),
    "costs that vanish": (
        lambda: hjb.solve(
            hjb.Problem(slide, lambda x, u: jnp.maximum(x[0], 0), ONE, target=lambda x: near(x - 0.6)), LINE,
            scheme=hjb.SemiLagrangian(),
        ),
        "running cost that is positive",
    ),
    "between the nodes": (
        lambda: hjb.solve(
            hjb.Problem(slide, on_nodes, ONE, discount=1.0), LINE, scheme=hjb.SemiLagrangian(cells=3),
        ),
        "between the nodes",
    ),
    "other methods": (
        lambda: hjb.solve(rest(), LINE, scheme=hjb.SemiLagrangian(), method=hjb.PolicyIteration(hjb.Krylov())),
        "not have a matrix",
    ),
    "coarser grids": (lambda: hjb.solve(rest(), LINE, scheme=hjb.SemiLagrangian(), method=hjb.Nested()), "one grid"),
    "transformations": (
        lambda: jax.jit(lambda b: hjb.solve(rest(discount=b), LINE, scheme=hjb.SemiLagrangian()).value)(1.0),
        "host level only",
    ),
    "no cells": (lambda: hjb.SemiLagrangian(cells=0), "cells"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_refusals_say_why(name):
    ask, words = REFUSED[name]
    with pytest.raises(ValueError, match=f"(?s){words}"):
        ask()


def test_other_front_doors_offer_what_they_take():
    with pytest.raises(TypeError, match=r"SemiLagrangian\(.*wanted"):
        hjb.march(rest(), LINE, 1.0, scheme=hjb.SemiLagrangian())
    with pytest.raises(TypeError, match=r"SemiLagrangian\(.*wanted"):
        hjb.solve_batch([rest()], LINE, scheme=hjb.SemiLagrangian())


def test_memory_is_told_before_anything_is_compiled():
    with pytest.raises(MemoryError, match="GB"):
        hjb.solve(*zoo.eikonal(shape=(101, 101)), scheme=hjb.SemiLagrangian(), max_memory=10_000_000)


@pytest.mark.slow
def test_a_solution_says_what_it_is_and_goes_through_files(tmp_path):
    solution = hjb.solve(rest(), LINE, scheme=hjb.SemiLagrangian(cells=3))
    assert "SemiLagrangian(cells=3" in str(solution)
    assert "e^{−βτ}" in solution.stats["certificate"]
    assert solution.grid_error is None
    solution.save(tmp_path / "run.npz")
    assert np.array_equal(hjb.load(tmp_path / "run.npz").value, solution.value)
