"""Growth of the payments, with which the discount depends on the control, against dense linear algebra and formulas."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_jumps

import hjbjax as hjb
from hjbjax.feedback.simulation import rollout

pytestmark = pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
CHAIN = hjb.Upwind(central=False)
GRID = hjb.Grid([-1.0], [1.0], (31,))
BOX = hjb.Box([-1.0], [1.0])


def drawn(seed, shape, count):
    """A random problem with modes and jumps, the growth of its payments, and its value by dense policy iteration."""
    one = random_jumps.draw(seed, shape, count)
    rng, beta = np.random.default_rng(seed), one.base.discount
    c = beta * rng.uniform(-1, 0.9, 2) / 2  # the net discount is at least 5 % of β, or larger than β
    curve = beta * rng.uniform(0, 1, 1)

    def growth(x, u, i):
        return c[0] * (1 - 0.1 * i) + c[1] * u - curve[0] * x[0] ** 2

    def of(x, u, mode=0):
        return growth(x, u[0], mode)

    exact = random_jumps.exact(one, steered=True, discount=lambda x, u, i: beta - growth(x, u, i))
    return one, (of if count > 1 else lambda x, u: of(x, u)), exact


def assert_bounds_hold(found, exact, tol):
    slack = 1e-10 * (1 + np.max(np.abs(exact)))
    lower, upper = found.bounds
    assert np.all(lower - slack <= exact)
    assert np.all(exact <= upper + slack)
    assert found.error <= tol
    assert np.max(np.abs(found.value - exact)) <= found.error + slack


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_random_problems_agree_with_dense_linear_algebra(count):
    for seed in range(8):
        one, growth, exact = drawn(seed, (7,), count)
        problem = random_jumps.problem(one, steered=True, growth=growth)
        assert_bounds_hold(hjb.solve(problem, one.grid, scheme=CHAIN, tol=1e-7), exact, 1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [hjb.ValueIteration(), hjb.PolicyIteration(hjb.Direct()), hjb.PolicyIteration(hjb.Krylov()),
    hjb.PolicyIteration(hjb.Sweeps()), hjb.Nested(coarsest=10), hjb.ValueIteration(policy=False)], ids=repr,
)  # fmt: skip
def test_every_method_finds_the_same_value(method):
    for seed in range(4):
        one, growth, exact = drawn(20 + seed, (5, 4), 2)
        problem = random_jumps.problem(one, steered=True, growth=growth)
        found = hjb.solve(problem, one.grid, scheme=CHAIN, tol=1e-6, method=method)
        assert np.max(np.abs(found.value - exact)) <= 1e-6 + 1e-9 * np.max(np.abs(exact))


def steer(x, u):
    return u - 0.5 * x


def paid(x, u):
    return (x[0] - 0.3) ** 2 + 0.4 * u[0] ** 2


def quadratic(slope=0.3, level=0.1, discount=0.6, **others):
    return hjb.Problem(
        steer, paid, BOX, noise=0.3, discount=discount, growth=lambda x, u: level + slope * u[0] * x[0], **others
    )


@pytest.mark.slow
def test_the_minimum_over_a_box_stays_exact_if_growth_is_affine():
    found = hjb.solve(quadratic(), GRID, scheme=CHAIN, tol=1e-8)
    actions = hjb.Finite(np.linspace(-1, 1, 401)[:, None])
    tried = hjb.solve(dataclasses.replace(quadratic(), controls=actions), GRID, scheme=CHAIN, tol=1e-8)
    assert found.error <= 1e-8
    assert np.all(found.value <= tried.value + 2e-8)
    assert np.all(tried.value - found.value <= 1e-5)  # the curvature times the squared spacing of the actions
    assert np.max(np.abs(found.policy - tried.policy)) <= 0.006


@pytest.mark.slow
def test_constant_growth_is_less_discount():
    chance = hjb.solve(quadratic(0.0, -0.25, lambda x: 0.35 + 0 * x[0]), GRID, scheme=CHAIN, tol=1e-9)
    number = hjb.solve(hjb.Problem(steer, paid, BOX, noise=0.3, discount=0.6), GRID, scheme=CHAIN, tol=1e-9)
    assert np.allclose(chance.value, number.value, rtol=0, atol=2e-9)
    assert chance.problem.growth is not None
    none = hjb.solve(quadratic(0.0, -0.6, 0.0), GRID, scheme=CHAIN, tol=1e-9)  # only a hazard, no discount
    assert np.allclose(none.value, number.value, rtol=0, atol=2e-9)


@pytest.mark.slow
def test_a_state_in_proportion_to_which_all_is_paid_may_be_left_out():
    """dK = K (u/2 − 0.1) dt, paid per K: V(K, x) = K v(x), by two solves of a chain that moves along x only."""
    v = hjb.solve(
        hjb.Problem(steer, paid, BOX, discount=0.7, growth=lambda x, u: u[0] / 2 - 0.1), GRID, scheme=CHAIN, tol=1e-9
    )
    both = hjb.Problem(
        lambda z, u: jnp.stack([z[0] * (u[0] / 2 - 0.1), u[0] - 0.5 * z[1]]),
        lambda z, u: z[0] * ((z[1] - 0.3) ** 2 + 0.4 * u[0] ** 2), BOX, discount=0.7,
    )  # fmt: skip
    grid = hjb.Grid([1.0, -1.0], [2.0, 1.0], (5, 31), edges=("open", "projected"))
    found = hjb.solve(both, grid, scheme=CHAIN, tol=1e-9)
    assert np.allclose(found.value, np.asarray(grid.axis(0))[:, None] * v.value, rtol=1e-6)


@pytest.mark.slow
def test_a_batch_and_transformations_give_the_same_values():
    numbers = np.array([[0.3, 0.1], [-0.2, -0.3]])
    alone = [hjb.solve(quadratic(*row), GRID, scheme=CHAIN, tol=1e-9) for row in numbers]
    together = hjb.solve_batch([quadratic(*row) for row in numbers], GRID, scheme=CHAIN, tol=1e-9)
    with jax.enable_x64(True):
        mapped = jax.vmap(lambda row: hjb.solve(quadratic(*row), GRID, scheme=CHAIN, tol=1e-9))(jnp.asarray(numbers))
        compiled = jax.jit(lambda row: hjb.solve(quadratic(*row), GRID, scheme=CHAIN, tol=1e-9).value)(numbers[1])
    for k, one in enumerate(alone):
        assert np.allclose(together[k].value, one.value, rtol=0, atol=2e-9)
        assert np.allclose(mapped.value[k], one.value, rtol=0, atol=2e-9)
    assert np.allclose(compiled, alone[1].value, rtol=0, atol=2e-9)
    short = hjb.solve(quadratic(), GRID, scheme=CHAIN, tol=1e-4, dtype="float32")
    assert np.allclose(short.value, alone[0].value, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [CHAIN, None])
def test_derivatives_are_those_of_differences(scheme):
    def value(row):
        return hjb.solve(quadratic(*row), GRID, scheme=scheme, tol=1e-10).value[jnp.array([4, 25])]

    with jax.enable_x64(True):
        at = jnp.array([0.3, 0.1, 0.6])
        forward, backward = jax.jacfwd(value)(at), jax.jacrev(value)(at)
        steps = 1e-5 * jnp.eye(3)
        differences = jnp.stack([(value(at + step) - value(at - step)) / 2e-5 for step in steps], axis=-1)
    assert np.allclose(forward, differences, rtol=1e-4, atol=1e-6)
    assert np.allclose(backward, forward, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("method", [hjb.Explicit(), hjb.Implicit()], ids=["explicit", "implicit"])
def test_a_long_march_ends_at_the_stationary_value(method):
    stationary = hjb.solve(quadratic(), GRID, scheme=CHAIN, tol=1e-9)
    for discount in (0.6, lambda x: 0.6 + 0 * x[0]):
        found = hjb.march(quadratic(discount=discount), GRID, 40.0, method=method, scheme=CHAIN)
        assert np.max(np.abs(found.value[0] - stationary.value)) <= 1e-4
    moving = hjb.Problem(
        lambda t, x, u: u, lambda t, x, u: 0.0, BOX, growth=lambda t, x, u: t * u[0], terminal_cost=1.0,
        time_dependent=True,
    )  # fmt: skip
    # the control shrinks the payment at the rate t
    found = hjb.march(moving, GRID, 1.0, method=method, scheme=CHAIN, step=None if method.limited else 0.002)
    assert np.allclose(found.value[0], np.exp(-0.5), atol=6e-3)
    with jax.enable_x64(True):
        run = jax.jit(
            lambda slope: hjb.march(quadratic(slope), GRID, 0.5, method=method, scheme=CHAIN, step=0.01).value
        )
        alone = hjb.march(quadratic(0.3), GRID, 0.5, method=method, scheme=CHAIN, step=0.01)
        assert np.allclose(run(0.3), alone.value, atol=1e-6)


def test_an_implicit_step_that_is_too_long_for_the_growth_is_refused():
    rising = hjb.Problem(steer, paid, BOX, discount=lambda x: -5.0 + 0 * x[0])
    with pytest.raises(ValueError, match=r"step = 0.5 is too long for a discount of -5 .*\n?.*at most 0.1"):
        hjb.march(rising, GRID, 2.0, method=hjb.Implicit(), step=0.5)
    growing = hjb.Problem(steer, paid, BOX, growth=lambda x, u: 4.0 + u[0])
    with pytest.raises(ValueError, match=r"step = 0.5 is too long for a discount of -5 "):
        hjb.march(growing, GRID, 2.0, method=hjb.Implicit(), step=0.5)


@pytest.mark.slow
def test_a_game_with_growth():
    """min max over u, d of growth times V, where V is the number 1/(β − g) for a running cost of one."""
    problem = hjb.Problem(
        lambda x, u, d: 0 * x, lambda x, u, d: 1.0, BOX, disturbances=hjb.Box([-1.0], [1.0]), discount=1.0,
        growth=lambda x, u, d: 0.2 * u[0] + 0.3 * d[0],
    )  # fmt: skip
    found = hjb.solve(problem, GRID, scheme=CHAIN, tol=1e-9)
    assert np.allclose(found.value, 1 / (1.0 + 0.2 - 0.3), atol=1e-8)


def test_the_exported_chain_has_one_factor_for_all_states_and_actions():
    problem = dataclasses.replace(quadratic(), controls=hjb.Finite([[-1.0], [0.0], [1.0]]))
    costs, moves, _, _, factor = hjb.chain.transition_arrays(problem, GRID, scheme=CHAIN)
    value = np.zeros(GRID.size)
    for _ in range(3000):
        value = np.min((costs + factor * (moves @ value)).reshape(-1, 3), axis=1)
    found = hjb.solve(problem, GRID, scheme=CHAIN, tol=1e-9)
    assert np.allclose(found.value, value, atol=1e-7)
    plain = dataclasses.replace(problem, growth=None)
    assert np.array_equal(
        hjb.chain.generator(problem, GRID, found.policy).toarray(),
        hjb.chain.generator(plain, GRID, found.policy).toarray(),
    )


def test_a_path_weighs_its_payments_by_the_growth():
    problem = hjb.Problem(
        lambda x, u: -x, lambda x, u: x[0], discount=0.5, growth=lambda x, u: 0.3 * x[0], terminal_cost=2.0
    )
    t = np.linspace(0, 3, 30001)
    weights = np.exp(-0.5 * t + 0.3 * (1 - np.exp(-t)))  # x = e^{−t}
    exact = np.trapezoid(np.exp(-t) * weights, t) + 2 * weights[-1]
    assert hjb.simulate(problem, None, [1.0], 3.0).cost == pytest.approx(exact, rel=1e-5)


@pytest.mark.slow
def test_means_of_paths_agree_with_the_value():
    grid = hjb.Grid([-1.0], [1.0], (161,))
    found, keys = hjb.solve(quadratic(), grid, tol=1e-6), jax.random.split(jax.random.key(2), 400)
    with jax.enable_x64(True):
        times = jnp.linspace(0.0, 20.0, 81)
        run = jax.vmap(lambda key: rollout(quadratic(), found, jnp.array([0.2]), times, key=key, clamp=True).cost)
        costs = np.asarray(jax.jit(run)(keys))
    assert abs(np.mean(costs) - found.value_at([0.2])) <= 3 * np.std(costs) / 20 + 0.01


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hjb.solve(quadratic(1.0), GRID), r"discount - growth\(x, u\) is -0.5 at x = \[-1.0\]"),
        (lambda: hjb.solve(quadratic(level=np.nan), GRID), "growth"),
        (lambda: hjb.solve(dataclasses.replace(quadratic(), growth=lambda x, u: x), GRID), r"returned shape \(1,\)"),
        (lambda: hjb.solve(dataclasses.replace(quadratic(), growth=lambda x: x[0]), GRID), "growth"),
        (lambda: hjb.Problem(steer, running_max=lambda x: x[0], growth=lambda x, u: 0.0), "growth"),
        (lambda: hjb.pontryagin(quadratic(), [0.5]), "pontryagin"),
        (lambda: hjb.solve(dataclasses.replace(quadratic(), noise=None), GRID, scheme=hjb.SemiLagrangian()), "growth"),
    ],
)  # fmt: skip
def test_refusals(make, message):
    with pytest.raises(ValueError, match=message):
        make()
