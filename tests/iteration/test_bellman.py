"""Laws of the Bellman operator: order, contraction, shifts, symmetry; and the equation that one policy leaves."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xla
from hypothesis import given, settings
from systems import SEEDS, random_game, random_grid, random_problem

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import fastest_rate
from hjbjax.discretisation.schemes import Upwind
from hjbjax.hamiltonian import discrete
from hjbjax.iteration import bellman
from hjbjax.iteration.bellman import Obstacles
from hjbjax.markov_chain import chain
from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.sets import Ball, Box, Finite

pytestmark = pytest.mark.usefixtures("float64")
UNIT = Box([-1.0], [1.0])
NOISES = ["none", "diagonal", "matrix"]
FEW = [pytest.param("none", marks=pytest.mark.slow), pytest.param("diagonal", marks=pytest.mark.slow), "matrix", "game"]
laws = settings(max_examples=12)
# the old emitters take minutes: every candidate of a minimum reads several neighbours, and more with noise
jitted = functools.partial(jax.jit, compiler_options=xla.with_emitters())


def upwind(problem, grid):
    return Discretisation(problem, grid, Upwind(), np.float64)


@functools.partial(jitted, static_argnames="scheme")
def operator(problem, grid, value, obstacles, scheme=Upwind()):
    """One step of value iteration; and βΔt, by which it contracts."""
    on = Discretisation(problem, grid, scheme, value.dtype)
    outflow = fastest_rate(on) + problem.discount
    greedy = bellman.greedy(on, value, obstacles.fixed)
    return obstacles.impose(value + greedy.defect / outflow), problem.discount / jnp.max(outflow)


def random_rules(rng, grid):
    """A target, an obstacle above and one below, at times crossing."""
    held = rng.random(grid.shape) < 0.1
    stop, floor = rng.normal(1.0, 1.0, grid.shape), rng.normal(-1.5, 1.0, grid.shape)
    return Obstacles(held, np.where(held, rng.normal(size=grid.shape), 0), stop, floor)


def free_rules(grid):
    return Obstacles(np.zeros(grid.shape, bool), np.zeros(grid.shape))


def random_question(rng, kind, n=2):
    grid = random_grid(rng, n)
    if kind == "game":
        return random_game(rng, grid, "diagonal", Finite([[-1.0], [0.3], [1.0]]), Finite([[-0.5], [1.0]])), grid
    return random_problem(rng, grid, kind, UNIT), grid


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*NOISES, "game"])
@given(seed=SEEDS)
@laws
def test_order_is_kept(kind, seed):
    rng = np.random.default_rng(seed)
    problem, grid = random_question(rng, kind)
    obstacles, value = random_rules(rng, grid), rng.normal(size=grid.shape)
    more = value + rng.random(grid.shape) * rng.choice([0.0, 1.0], grid.shape)
    for scheme in (Upwind(central=False), Upwind()):
        below, above = (
            operator(problem, grid, value, obstacles, scheme)[0],
            operator(problem, grid, more, obstacles, scheme)[0],
        )
        assert jnp.all(below <= above + 1e-12)


@pytest.mark.parametrize("kind", FEW)
@given(seed=SEEDS)
@laws
def test_contraction(kind, seed):
    rng = np.random.default_rng(seed)
    problem, grid = random_question(rng, kind)
    obstacles, value, other = random_rules(rng, grid), *rng.normal(size=(2, *grid.shape))
    (first, shrink), (second, _) = operator(problem, grid, value, obstacles), operator(problem, grid, other, obstacles)
    assert jnp.max(jnp.abs(first - second)) <= (1 - shrink) * np.max(np.abs(value - other)) + 1e-12


@pytest.mark.parametrize("kind", FEW)
@given(seed=SEEDS)
@laws
def test_a_constant_shifts_the_rate_by_the_discount(kind, seed):
    rng = np.random.default_rng(seed)
    problem, grid = random_question(rng, kind)
    obstacles, value, shift = free_rules(grid), rng.normal(size=grid.shape), rng.normal()
    before, after = (_rate(problem, grid, v, obstacles.fixed) for v in (value, value + shift))
    assert np.allclose(after, before - problem.discount * shift, rtol=0, atol=1e-10 * (1 + np.max(np.abs(before))))


@jitted
def _rate(problem, grid, value, held):
    return bellman.greedy(upwind(problem, grid), value, held).defect


@given(seed=SEEDS)
@laws
def test_a_larger_control_set_never_costs_more(seed):
    rng = np.random.default_rng(seed)
    grid, value = random_grid(rng, 2), rng.normal(size=(5, 4))
    problem = random_problem(rng, grid, "diagonal")
    wider = Problem(problem.drift, problem.cost, Box([-1.5], [1.2]), noise=problem.noise, discount=problem.discount)
    held = np.zeros(grid.shape, bool)
    assert np.all(np.asarray(_rate(wider, grid, value, held)) <= np.asarray(_rate(problem, grid, value, held)) + 1e-12)


@pytree_dataclass(static=("order",))
class Turned:
    """The same physics with the axes in another order, or mirrored."""

    system: object
    order: object
    sign: object

    def drift(self, x, u):
        f = self.sign * self.system.drift(self._back(x), u)
        return jnp.stack([f[i] for i in self.order])

    def cost(self, x, u):
        return self.system.cost(self._back(x), u)

    def _back(self, x):
        return self.sign * jnp.stack([x[self.order.index(i)] for i in range(len(self.order))])


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, pytest.param(3, marks=pytest.mark.slow)])
@given(seed=SEEDS)
@settings(max_examples=6)
def test_axes_may_be_permuted(n, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    problem = random_problem(rng, grid, "matrix")
    order = tuple((i - 1) % n for i in range(n))
    turned = Turned(problem.drift.args[0], order, np.ones(n))
    permuted = Grid(
        grid.lo[list(order)],
        grid.hi[list(order)],
        tuple(grid.shape[i] for i in order),
        tuple(grid.periodic[i] for i in order),
    )
    again = Problem(turned.drift, turned.cost, UNIT, noise=problem.noise[list(order)], discount=problem.discount)
    value = rng.normal(size=grid.shape)
    here = np.asarray(_rate(problem, grid, value, np.zeros(grid.shape, bool)))
    there = np.asarray(_rate(again, permuted, value.transpose(order), np.zeros(permuted.shape, bool)))
    assert np.allclose(there, here.transpose(order), rtol=0, atol=1e-11 * (1 + np.max(np.abs(here))))


@pytest.mark.slow
@given(seed=SEEDS)
@laws
def test_axes_may_be_mirrored(seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 2, periodic=False)
    problem, sign = random_problem(rng, grid, "matrix"), np.array([-1.0, 1.0])
    mirrored = Turned(problem.drift.args[0], (0, 1), sign)
    flipped = Grid([-grid.hi[0], grid.lo[1]], [-grid.lo[0], grid.hi[1]], grid.shape)
    again = Problem(mirrored.drift, mirrored.cost, UNIT, noise=sign[:, None] * problem.noise, discount=problem.discount)
    value = rng.normal(size=grid.shape)
    here = np.asarray(_rate(problem, grid, value, np.zeros(grid.shape, bool)))
    there = np.asarray(_rate(again, flipped, value[::-1], np.zeros(grid.shape, bool)))
    assert np.allclose(there[::-1], here, rtol=0, atol=1e-10 * (1 + np.max(np.abs(here))))


# --- what holds beside the equation ---


def test_conditions_are_read_at_the_nodes():
    problem = Problem(
        lambda x, u: u,
        None,
        UNIT,
        target=lambda x: abs(x[0]) - 0.5,
        exit_cost=lambda x: 10 * x[0],
        stopping_cost=3.0,
        discount=1.0,
    )
    grid = Grid([-1.0], [1.0], (5,))
    obstacles = bellman.obstacles(upwind(problem, grid))
    assert obstacles.fixed.tolist() == [False, True, True, True, False]
    assert obstacles.fixed_value.tolist() == [0.0, -5.0, 0.0, 5.0, 0.0]
    assert obstacles.upper.tolist() == [3.0] * 5
    assert obstacles.lower is None
    assert obstacles.impose(jnp.array([4.0, 4.0, -9.0, 4.0, -9.0])).tolist() == [3.0, -5.0, 0.0, 5.0, -9.0]


def test_the_floor_wins_over_stopping_and_the_target_over_both():
    held = jnp.array([False, False, True])
    obstacles = Obstacles(
        held, jnp.array([0.0, 0.0, 9.0]), upper=jnp.array([1.0, 1.0, 1.0]), lower=jnp.array([2.0, -1.0, 2.0])
    )
    assert obstacles.impose(jnp.array([5.0, 5.0, 5.0])).tolist() == [2.0, 1.0, 9.0]
    assert obstacles.impose(jnp.array([-5.0, -5.0, -5.0])).tolist() == [2.0, -1.0, 9.0]


@jitted
def _equation(problem, grid, value, obstacles):
    policy = bellman.greedy(upwind(problem, grid), value, obstacles.fixed)
    return policy, bellman.policy_equation(upwind(problem, grid), value, policy, obstacles)


@pytest.mark.parametrize("kind", FEW)
@given(seed=SEEDS)
@laws
def test_the_source_is_the_residual_and_the_weights_are_the_chain(kind, seed):
    rng = np.random.default_rng(seed)
    problem, grid = random_question(rng, kind)
    obstacles, value = random_rules(rng, grid), rng.normal(size=grid.shape)
    policy, equation = jax.device_get(_equation(problem, grid, value, obstacles))
    u, d = (np.stack(side, axis=-1) if side else None for side in (policy.controls, policy.disturbances))
    generator = chain.generator(problem, grid, u, disturbance=d).toarray()
    outflow = -np.diag(generator).reshape(grid.shape) + problem.discount
    step = policy.defect / outflow
    expected = np.maximum(np.minimum(step, obstacles.upper - value), obstacles.lower - value)
    assert np.allclose(equation.source, np.where(obstacles.fixed, 0, expected), rtol=0, atol=1e-12)
    assert np.all(policy.defect[obstacles.fixed] == 0)
    active = ~obstacles.fixed & (step <= obstacles.upper - value) & (step >= obstacles.lower - value)
    total = np.where(active, -np.diag(generator).reshape(grid.shape) / outflow, 0)
    assert np.allclose(equation.weights.total(), total, rtol=1e-12)
    assert all(np.all(w >= 0) for w in equation.weights.values)


@jitted
def _with_rate(problem, grid, value, policy, obstacles, fastest):
    return bellman.policy_equation(upwind(problem, grid), value, policy, obstacles, fastest=fastest)


@jitted
def _with_every_rate(problem, grid, value, policy, obstacles):
    return bellman.policy_equation(upwind(problem, grid), value, policy, obstacles, every_rate=True)


@pytest.mark.parametrize("kind", [pytest.param("none", marks=pytest.mark.slow), "matrix"])
@given(seed=SEEDS)
@settings(max_examples=6)
def test_an_equation_returns_the_fastest_rate_and_accepts_it(kind, seed):
    rng = np.random.default_rng(seed)
    problem, grid = random_question(rng, kind)
    obstacles, value = random_rules(rng, grid), rng.normal(size=grid.shape)
    policy, equation = jax.device_get(_equation(problem, grid, value, obstacles))
    generator = chain.generator(problem, grid, np.stack(policy.controls, axis=-1)).toarray()
    assert equation.fastest == pytest.approx(np.max(-np.diag(generator)) + problem.discount, rel=1e-12)
    again = _with_rate(problem, grid, value, policy, obstacles, equation.fastest)
    np.testing.assert_allclose(again.source, equation.source, rtol=1e-12, atol=1e-15)
    slow = _with_rate(problem, grid, value, policy, obstacles, np.inf)
    assert not np.any(slow.weights.total())  # where all drift counts as rounding, nothing moves


def test_every_rate_counts_where_none_is_rounding():
    problem = Problem(lambda x, u: jnp.where(x > 0.6, 1e6, 1e-10), None, Finite(np.zeros((1, 1))), discount=1e-9)
    grid = Grid([0.0], [1.0], (5,))
    policy = bellman.Greedy(jnp.ones(5), (jnp.zeros(5),), ())
    obstacles, leaving = free_rules(grid), np.array([4e-10, 4e-10, 4e-10, 4e6, 0]) + 1e-9
    found = _with_every_rate(problem, grid, jnp.zeros(5), policy, obstacles)
    assert found.fastest is None
    np.testing.assert_allclose(found.source, 1 / leaving, rtol=1e-12)
    np.testing.assert_allclose(found.weights.total(), 1 - 1e-9 / leaving, rtol=1e-7)
    slow = _with_rate(problem, grid, jnp.zeros(5), policy, obstacles, 4e6)  # beside this one the others are rounding
    np.testing.assert_allclose(slow.source[:3], 1 / 4e6, rtol=1e-12)


@pytest.mark.parametrize("n", [1, pytest.param(2, marks=pytest.mark.slow)])
@given(seed=SEEDS)
@settings(max_examples=6)
def test_the_correction_of_a_policy_is_its_value(n, seed):
    """V + δ with δ from the linear equation is the value under that policy: a dense solve of (β − 𝓛)V = L."""
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, n)
    problem = random_problem(rng, grid, "diagonal")
    value, obstacles = rng.normal(size=grid.shape), free_rules(grid)
    policy, equation = jax.device_get(_equation(problem, grid, value, obstacles))
    u = np.stack(policy.controls, axis=-1)
    generator = chain.generator(problem, grid, u).toarray()
    running = jax.vmap(problem.cost)(grid.nodes().reshape(grid.size, n), u.reshape(grid.size, 1))
    exact = np.linalg.solve(problem.discount * np.eye(grid.size) - generator, np.asarray(running))
    outflow = -np.diag(generator) + problem.discount
    weights = np.eye(grid.size) - (problem.discount * np.eye(grid.size) - generator) / outflow[:, None]
    delta = np.linalg.solve(np.eye(grid.size) - weights, equation.source.ravel())
    assert np.allclose(value.ravel() + delta, exact, rtol=0, atol=1e-9 * (1 + np.max(np.abs(exact))))


@pytest.mark.parametrize(
    "controls",
    [
        Box([-1.0, 0.0], [1.0, 2.0]),
        pytest.param(Ball(1.5, 2), marks=pytest.mark.slow),
        Finite([[0.0, 1.0], [1.0, -1.0]]),
    ],
)
@given(seed=SEEDS)
@settings(max_examples=5)
def test_no_action_is_faster_than_the_fastest_rate(controls, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 2)
    problem = random_problem(rng, grid, "matrix", controls)
    fastest = np.asarray(_fastest(problem, grid))
    for _ in range(10):
        if isinstance(controls, Finite):
            u = controls.points[rng.integers(2)]
        elif isinstance(controls, Box):
            u = rng.uniform(controls.lo, controls.hi)
        else:
            u = 1.5 * (lambda v: v / np.linalg.norm(v))(rng.normal(size=2))
        leaving = -chain.generator(problem, grid, np.broadcast_to(u, (*grid.shape, 2))).diagonal()
        assert np.all(leaving.reshape(grid.shape) <= fastest * (1 + 1e-12))


@jitted
def _fastest(problem, grid):
    return fastest_rate(upwind(problem, grid))


@pytest.mark.slow
@pytest.mark.parametrize("isaacs", ["upper", "lower"])
@given(seed=SEEDS)
@settings(max_examples=5)
def test_the_inner_player_replies_to_the_outer_one(isaacs, seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 2)
    mine, theirs = Finite([[-1.0], [0.3], [1.0]]), Finite([[-0.5], [0.1], [1.0]])
    problem = random_game(rng, grid, "none", mine, theirs, isaacs=isaacs)
    value, other = rng.normal(size=(2, *grid.shape))
    first, reply, tried = jax.device_get(_replies(problem, grid, value, other))
    kept, changed = ("controls", "disturbances") if isaacs == "upper" else ("disturbances", "controls")
    assert np.array_equal(getattr(first, kept)[0], getattr(reply, kept)[0])
    expected = np.max(tried, axis=0) if isaacs == "upper" else np.min(tried, axis=0)
    assert np.allclose(reply.defect, expected, rtol=0, atol=1e-11 * (1 + np.max(np.abs(expected))))
    assert set(np.unique(getattr(reply, changed)[0])) <= set((theirs if isaacs == "upper" else mine).points.ravel())


@jitted
def _replies(problem, grid, value, other):
    held = jnp.zeros(grid.shape, bool)
    first = bellman.greedy(upwind(problem, grid), other, held)
    reply = bellman.respond(upwind(problem, grid), value, held, first)
    tried = []
    for k in range(3):
        name = "disturbances" if problem.isaacs == "upper" else "controls"
        point = (problem.disturbances if problem.isaacs == "upper" else problem.controls).points[k, 0]
        sides = {"controls": first.controls, "disturbances": first.disturbances}
        sides[name] = (jnp.broadcast_to(point, grid.shape),)
        here = discrete.around(upwind(problem, grid), value)
        tried.append(here.at(list(sides["controls"]), list(sides["disturbances"])) - problem.discount * value)
    return first, reply, jnp.stack(tried)
