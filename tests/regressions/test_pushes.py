"""Pushes, that is, singular control, against linear programs in plain NumPy and against a closed form."""

import dataclasses

import dense_pushes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.feedback.simulation import rollout

pytestmark = pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
CHAIN = hjb.Upwind(central=False)
LINE = hjb.Grid([0.0], [1.5], (61,))


def assert_is_the_value(found, one, tol, **options):
    exact, after = dense_pushes.exact(one, **options)
    slack = 1e-8 * (1 + np.max(np.abs(exact)))  # of the linear program
    lower, upper = found.bounds
    assert np.all(lower - slack <= exact)
    assert np.all(exact <= upper + slack)
    assert found.error <= tol
    assert np.max(np.abs(found.value - exact)) <= tol + slack
    pushed = np.moveaxis(np.asarray(found.pushing), -1, 0)
    assert np.all(np.abs(after - exact)[pushed] <= 10 * (tol + slack))  # a push is optimal where it is chosen


@pytest.mark.parametrize(
    ("noise", "seeds"),
    [(True, range(1, 4)), *(pytest.param(noise, range(6), marks=pytest.mark.slow) for noise in (True, False))],
)
def test_random_problems_agree_with_a_linear_program(noise, seeds):
    pushed = 0
    for seed in seeds:
        one = dense_pushes.draw(seed)
        found = hjb.solve(dense_pushes.problem(one, noise=noise), one.grid, scheme=CHAIN, tol=1e-8)
        assert_is_the_value(found, one, 1e-8, noise=noise)
        pushed += np.sum(found.pushing)
    assert pushed > 20


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [
        hjb.ValueIteration(), hjb.PolicyIteration(hjb.Direct()), hjb.PolicyIteration(hjb.Krylov()),
        hjb.PolicyIteration(hjb.Sweeps()), hjb.Nested(coarsest=10),
    ],
    ids=repr,
)  # fmt: skip
@pytest.mark.parametrize("noise", [True, False])
def test_every_method_finds_the_same_value_in_two_dimensions(method, noise):
    for seed in range(8):
        one = dense_pushes.draw(50 + seed, (6, 7))
        found = hjb.solve(dense_pushes.problem(one, noise=noise), one.grid, scheme=CHAIN, tol=1e-7, method=method)
        assert_is_the_value(found, one, 1e-7, noise=noise)


@pytest.mark.parametrize("count", [101, pytest.param(402, marks=pytest.mark.slow)])
def test_dividends_are_paid_above_the_exact_barrier(count):
    problem, grid = zoo.dividends(shape=(count,))
    found = hjb.solve(problem, grid, tol=1e-9)
    exact = np.array([float(zoo.dividends_exact()([x])) for x in grid.axis(0)])
    assert found.error <= 1e-9
    assert found.steps <= 12
    assert np.max(np.abs(found.value - exact)) <= 3 * np.max(found.grid_error)
    assert np.max(found.grid_error) <= 0.7 / count  # second order: 0.0036 on 101 nodes
    (barrier,) = found.free_boundary()
    assert abs(barrier - float(zoo.Reserve().barrier)) <= grid.spacing(0)
    paid = np.flatnonzero(found.pushing[:, 0])
    assert np.array_equal(paid, np.arange(paid[0], count))
    assert np.allclose(np.diff(found.value)[paid[0] - 1 :], grid.spacing(0), rtol=1e-12)


@pytest.mark.slow
def test_the_steps_do_not_grow_with_the_nodes():
    problem, grid = zoo.dividends(shape=(4001,))
    assert hjb.solve(problem, grid, tol=1e-7).steps <= 12
    bowl = hjb.Problem(
        lambda x, u: jnp.stack([0.3 * x[1], -0.3 * x[0]]), lambda x, u: x @ x, noise=0.3, discount=0.5,
        pushes=[hjb.Push([1, 0], 0.3), hjb.Push([-1, 0], lambda x: 0.3 + 0.1 * x[1]), hjb.Push([0, -1], 0.5)],
    )  # fmt: skip
    assert hjb.solve(bowl, hjb.Grid([-1, -1], [1, 1], (200, 201)), tol=1e-6).steps <= 12


def firm(reward=1.0, income=0.18, **others):
    return hjb.Problem(
        lambda x, u: income + 0 * x, noise=0.25, target=lambda x: x[0], pushes=[hjb.Push([-1.0], reward=reward)],
        **({"discount": 0.1} | others),
    )  # fmt: skip


@pytest.mark.slow
def test_a_batch_and_transformations_give_the_same_values():
    alone = [hjb.solve(firm(reward, income), LINE, tol=1e-9) for reward, income in ((1.0, 0.18), (0.7, 0.1))]
    together = hjb.solve_batch([firm(1.0, 0.18), firm(0.7, 0.1)], LINE, tol=1e-9)
    with jax.enable_x64(True):
        both = jnp.array([[1.0, 0.18], [0.7, 0.1]])
        mapped = jax.vmap(lambda row: hjb.solve(firm(*row), LINE, tol=1e-9))(both)
        values = jax.jit(lambda row: hjb.solve(firm(*row), LINE, tol=1e-9).value)(both[1])
    for k, one in enumerate(alone):
        assert np.allclose(together[k].value, one.value, rtol=0, atol=2e-9)
        assert np.allclose(mapped.value[k], one.value, rtol=0, atol=2e-9)
        assert np.array_equal(mapped.pushing[k], one.pushing)
    assert np.allclose(values, alone[1].value, rtol=0, atol=2e-9)


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    def value(both):
        return hjb.solve(firm(*both), LINE, tol=1e-10).value[jnp.array([10, 50])]  # kept, and paid out

    with jax.enable_x64(True):
        at = jnp.array([0.9, 0.18])
        forward, backward = jax.jacfwd(value)(at), jax.jacrev(value)(at)
        steps = 1e-5 * jnp.eye(2)
        differences = jnp.stack([(value(at + step) - value(at - step)) / 2e-5 for step in steps], axis=-1)
    assert np.allclose(forward, differences, rtol=1e-5)
    assert np.allclose(backward, forward, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("method", [hjb.Explicit(), hjb.Implicit()], ids=["explicit", "implicit"])
def test_a_long_march_ends_at_the_stationary_value(method):
    grid = hjb.Grid([0.0], [1.5], (31,))
    found = hjb.march(
        firm(), grid, 60.0, method=method, scheme=hjb.Upwind(), step=None if method.limited else 0.1, times=[0.0, 60.0]
    )
    stationary = hjb.solve(firm(), grid, scheme=hjb.Upwind(), tol=1e-9)
    assert np.max(np.abs(found.value[0] - stationary.value)) <= 3e-3  # e^{−0.1 · 60} of the value at the end
    assert np.array_equal(found.pushing[0], stationary.pushing)
    assert found.pushing[1, 1:].all()  # at the end all cash is paid out
    assert np.allclose(found.value[1], grid.axis(0), atol=1e-12)


def test_costs_that_depend_on_time_are_paid_at_their_time():
    problem = hjb.Problem(
        lambda t, x, u: 0 * x, time_dependent=True, terminal_cost=lambda t, x: 3 * x[0],
        pushes=[hjb.Push([-1.0], lambda t, x: 2.0 - t)],
    )  # fmt: skip
    found = hjb.march(problem, LINE, 1.0, step=0.25, times=[0.0, 0.5, 1.0])
    x = LINE.axis(0)
    assert np.allclose(found.value, np.ones((3, 1)) * x, atol=1e-12)  # it waits until the price is one
    assert found.pushing[2, 1:].all()


@pytest.mark.slow
def test_a_push_may_lead_to_a_target_without_discount():
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), target=lambda x: x[0], exit_cost=0.25,
        pushes=[hjb.Push([-1.0], lambda x: jnp.where(x[0] > 1, 0.5, jnp.inf))],
    )  # fmt: skip
    found = hjb.solve(problem, LINE, tol=1e-6)
    x = LINE.axis(0)
    exact = 0.25 + np.minimum(x, 1.0) + 0.5 * np.maximum(x - 1.0, 0)
    assert np.max(np.abs(found.value - exact)) <= 0.03 + 1e-6  # the last push ends one node above x = 1
    alone = hjb.solve(dataclasses.replace(problem, pushes=()), LINE, tol=1e-6)
    assert np.allclose(alone.value, 0.25 + x, atol=1e-5)


@pytest.mark.slow
def test_pushes_and_changes_of_the_mode_work_together():
    problem = hjb.Problem(
        lambda x, u, mode: 0 * x, lambda x, u, mode: (4.0, 1.0)[mode] * x[0], discount=0.5,
        modes=hjb.Modes(("bad", "good"), switching_cost=[[0, 0.3], [np.inf, 0]]),
        pushes=[hjb.Push([-1.0], lambda x, mode: (jnp.inf, 1.0)[mode])],
    )  # fmt: skip
    found = hjb.solve(problem, LINE, tol=1e-9)
    x = LINE.axis(0)
    good = np.minimum(x, 2 * x)  # push to zero at a cost of one per unit, or wait at 2 x
    assert np.allclose(found.value[1], good, atol=1e-8)
    assert np.allclose(found.value[0], np.minimum(8 * x, 0.3 + good), atol=1e-8)
    assert found.pushing.shape == (2, 61, 1)
    assert found.pushing[1, 1:].all()
    assert not found.pushing[0].any()
    assert found.in_mode("good").pushing.shape == (61, 1)


@pytest.mark.slow
def test_a_game_has_the_value_of_its_worst_case():
    def one(**others):
        return hjb.Problem(
            *others.pop("functions"), discount=0.5, noise=0.3,
            pushes=[hjb.Push([-1.0], 0.4), hjb.Push([1.0], 0.7)], **others,
        )  # fmt: skip

    grid = hjb.Grid([-1.0], [1.0], (41,))
    game = one(functions=(lambda x, u, d: d, lambda x, u, d: x @ x), disturbances=hjb.Box([-0.2], [0.2]))
    found = hjb.solve(game, grid, scheme=CHAIN, tol=1e-8)
    fixed = one(functions=(lambda x, u: 0.2 * jnp.sign(x - 0.02), lambda x, u: x @ x))
    assert found.error <= 1e-8
    less = hjb.solve(fixed, grid, scheme=CHAIN, tol=1e-8)
    assert np.all(less.value <= found.value + 1e-7)
    assert found.pushing[1:4, 1].all()
    assert found.pushing[-4:-1, 0].all()


@pytest.mark.slow
def test_single_precision_and_the_second_order_scheme():
    single = hjb.solve(firm(), LINE, dtype=np.float32, tol=1e-4)
    double = hjb.solve(firm(), LINE, tol=1e-9)
    assert np.max(np.abs(single.value - double.value)) <= 2e-5
    calm = hjb.Problem(  # push at a cost of one, or let the state decay
        lambda x, u: -x, lambda x, u: 3 * x[0] ** 2, discount=1.0, pushes=[hjb.Push([-1.0], 1.0)]
    )
    found = hjb.solve(calm, LINE, scheme=hjb.Limited(), tol=1e-7)
    x = LINE.axis(0)  # V = x² up to the barrier at V′ = 1, then x − 1/4
    assert np.max(np.abs(found.value - np.where(x < 0.5, x**2, x - 0.25))) <= 2e-3
    assert abs(found.free_boundary()[0] - 0.5) <= LINE.spacing(0)


@pytest.mark.slow
def test_stretched_and_periodic_axes():
    grid = hjb.Grid([0.0], [1.5], (61,), stretch=(hjb.Sinh(2.0, 0.4),))
    found = hjb.solve(firm(), grid, tol=1e-9)
    exact = np.array([float(zoo.dividends_exact()([x])) for x in grid.axis(0)])
    assert np.max(np.abs(found.value - exact)) <= 2e-3
    circle = hjb.Grid([0.0], [1.0], (40,), periodic=(True,))
    angle = hjb.Problem(
        lambda x, u: 0 * x, lambda x, u: 1 - jnp.cos(2 * np.pi * x[0]), discount=1.0, pushes=[hjb.Push([1.0], 0.5)]
    )
    found = hjb.solve(angle, circle, tol=1e-9)
    x = circle.axis(0)
    wait = 1 - np.cos(2 * np.pi * x)
    exact = np.min([np.roll(wait, -k) + 0.5 * k / 40 for k in range(40)], axis=0)
    assert np.allclose(found.value, exact, atol=1e-8)


def test_a_solution_keeps_its_push_region_in_files_and_arrays(tmp_path):
    found = hjb.solve(firm(), LINE, tol=1e-8)
    found.save(tmp_path / "firm.npz")
    loaded = hjb.load(tmp_path / "firm.npz")
    assert np.array_equal(loaded.pushing, found.pushing)
    assert np.array_equal(loaded.free_boundary(), found.free_boundary())
    assert "pushing" in str(found)


@pytest.mark.slow
def test_simulated_means_agree_with_the_value():
    found = hjb.solve(firm(), LINE, tol=1e-8)
    keys = jax.random.split(jax.random.key(3), 1000)
    with jax.enable_x64(True):
        times = jnp.linspace(0.0, 50.0, 101)  # ten steps of 0.05 between two of them
        run = jax.jit(jax.vmap(lambda key, x: rollout(firm(), found, x, times, key=key).reward, (0, None)))
        for start in (0.4, 1.2):
            earned = np.asarray(run(keys, jnp.array([start])))
            noise = 3 * np.std(earned) / np.sqrt(len(keys))
            # the step costs 0.005 at a length of 0.1, and the time after 50 earns e^{−5} of the value
            assert abs(np.mean(earned) - found.value_at([start])) <= noise + 0.005 + 0.014


@pytest.mark.slow
def test_a_path_jumps_to_the_barrier_and_stays_below():
    found = hjb.solve(firm(), LINE, tol=1e-8)
    path = hjb.simulate(firm(), found, [1.2], 3.0, key=1)
    first = LINE.axis(0)[np.flatnonzero(found.pushing[:, 0])[0] - 1]  # the first node that keeps its cash
    assert path.states[0, 0] == 1.2
    assert np.all(path.states[1:, 0] <= first + 1e-9)
    assert path.reward >= 1.2 - first
    nothing = hjb.Problem(lambda x, u: -x, lambda x, u: 3 * x[0] ** 2, discount=1.0, pushes=[hjb.Push([-1.0], 1.0)])
    path = hjb.simulate(nothing, hjb.solve(nothing, LINE, tol=1e-7), [1.5], 10.0)
    assert abs(path.cost - 1.25) <= 0.01


@pytest.mark.slow
def test_a_path_with_a_discount_that_depends_on_the_state():
    found = hjb.solve(firm(), LINE, tol=1e-8)
    rate = dataclasses.replace(firm(), discount=lambda x: 0.1 + 0 * x[0])
    again = hjb.simulate(rate, hjb.solve(rate, LINE, tol=1e-8), [1.2], 3.0, key=1)
    assert abs(again.reward - hjb.simulate(firm(), found, [1.2], 3.0, key=1).reward) <= 1e-3


def regimes(*, noise=None, rates=None, discount=0.5):
    """Two regimes; a change from the second to the first and all pushes are choices."""
    return hjb.Problem(
        lambda x, u, mode: (0.3, -0.2)[mode] + 0 * x, lambda x, u, mode: (1.0, 4.0)[mode] * x[0] ** 2,
        noise=noise, discount=discount, modes=hjb.Modes(("calm", "wild"), rates, [[0, np.inf], [0.4, 0]]),
        pushes=[
            hjb.Push([-1.0], lambda x, mode: (1.0, 0.6)[mode]), hjb.Push([1.0], lambda x, mode: (0.5, 1.4)[mode])
        ],
    )  # fmt: skip


WIDE = hjb.Grid([-2.0], [2.0], (201,))


@pytest.mark.slow
def test_a_path_with_modes_and_pushes_costs_its_value():
    problem = regimes()
    found = hjb.solve(problem, WIDE, tol=1e-8)
    for start, mode, first in ((-1.3, "wild", 0), (1.9, "wild", 1), (-1.7, "calm", 0), (0.9, "calm", 0)):
        path = hjb.simulate(problem, found, [start], 20.0, mode=mode)
        assert abs(path.cost - found.value_at([start], mode=mode)) <= 0.01
        assert path.modes[0] == first  # after the changes and pushes at the start
        assert path.states[0, 0] == start


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize("discount", [0.5, lambda x, mode: (0.4, 0.5)[mode] + 0.1 * x[0] ** 2])
def test_means_with_modes_and_pushes_agree_with_the_value(discount):
    problem = regimes(noise=0.3, rates=[[0, 0.4], [0.6, 0]], discount=discount)
    found, times = hjb.solve(problem, WIDE, tol=1e-7), jnp.linspace(0.0, 16.0, 41)
    keys = jax.random.split(jax.random.key(3), 400)
    with jax.enable_x64(True):
        run = jax.jit(
            jax.vmap(lambda key, x: rollout(problem, found, x, times, key=key, mode=1, max_step=0.02).cost, (0, None))
        )
        for start in (-1.3, 1.2):
            costs = np.asarray(run(keys, jnp.array([start])))
            spread = 3 * np.std(costs) / np.sqrt(len(keys))
            assert abs(np.mean(costs) - found.value_at([start], mode=1)) <= spread + 0.01


def bowl(pushes, **others):
    return hjb.Problem(lambda x, u: 0 * x, lambda x, u: x @ x, pushes=pushes, **({"discount": 0.5} | others))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hjb.Push([1.0, 1.0], 1.0), "wanted one entry 1 or -1"),
        (lambda: hjb.Push([1.0]), "got neither cost nor reward"),
        (lambda: hjb.Push([1.0], 1.0, reward=1.0), "got both cost and reward"),
        (lambda: hjb.Push([1.0], reward=np.inf), "infinity only as a cost"),
        (lambda: bowl([hjb.Push([1.0], 1.0), hjb.Push([1.0], 2.0)]), "different directions"),
        (lambda: hjb.solve(bowl([hjb.Push([1.0, 0.0], 1.0)]), LINE), "wanted 1 entries"),
        (lambda: hjb.solve(bowl([hjb.Push([1.0], lambda x: x)]), LINE), r"cost\(x\) returned shape \(1,\)"),
        (
            lambda: hjb.solve(bowl([hjb.Push([1.0], -1.0), hjb.Push([-1.0], 0.5)]), LINE),
            r"a round trip of pushes costs nothing or earns, at x = \[0\]",
        ),
        (lambda: hjb.solve(bowl([hjb.Push([1.0], 1.0), hjb.Push([-1.0], reward=1.0)]), LINE), "costs nothing or earns"),
        (lambda: hjb.solve(bowl([hjb.Push([1.0], lambda x: jnp.log(x[0] - 1.0))]), LINE), "NaN"),
        (lambda: hjb.solve(firm(discount=0.0), LINE), "a push that earns"),
        (lambda: hjb.chain.generator(firm(), LINE), "got a problem with pushes"),
        (lambda: hjb.solve(bowl([hjb.Push([1.0], 1.0)]), LINE, scheme=hjb.SemiLagrangian()), "a problem with pushes"),
        (lambda: hjb.simulate(firm(), None, [1.0], 1.0, key=0), "only a Solution of it knows"),
        (lambda: hjb.Problem(lambda x, u: x, running_max=lambda x: x[0], pushes=[hjb.Push([1.0], 1.0)]), "pushes"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_push_that_is_not_in_a_list_is_refused():
    with pytest.raises(TypeError, match="wanted a list"):
        bowl(hjb.Push([1.0], 1.0))
