"""Controls whose bounds depend on the state: borrowing limits, capacity, the wealth that can be consumed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from line_problems import dense, draw, positive, wave

import hjbjax as hjb

GRID = hjb.Grid([-2.0], [2.0], (31,))
CHAIN = hjb.Upwind(central=False)
X = GRID.axis(0)


def bounded(line):
    a, b, q, beta, w, low, high = line.a, line.b, line.q, line.beta, line.w, line.lo, line.hi
    return hjb.Problem(
        lambda x, u: wave(a, x, jnp) + wave(b, x, jnp) * u,
        lambda x, u: wave(q, x[0], jnp) + w * u[0] ** 2,
        lambda x: hjb.Box(wave(low, x, jnp), wave(high, x, jnp)),
        noise=line.s,
        discount=lambda x: positive(beta, x[0], jnp),
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_random_problems_agree_with_dense_linear_algebra_and_bounds_hold():
    for seed in range(30):
        line = draw(seed)
        exact, u = dense(line, X)
        found = hjb.solve(bounded(line), GRID, scheme=CHAIN, tol=1e-6)
        lower, upper = found.bounds
        slack = 1e-11 * (1 + np.max(np.abs(exact)))
        assert np.all(lower - slack <= exact), seed
        assert np.all(exact <= upper + slack), seed
        assert found.error <= 1e-6
        assert np.median(np.abs(found.policy[:, 0] - u)) < 1e-6, seed
        assert np.all(found.policy[:, 0] >= wave(line.lo, X) - 1e-15), seed  # two implementations of the sine
        assert np.all(found.policy[:, 0] <= wave(line.hi, X) + 1e-15), seed


def steer(x, u):
    return u - 0.1 * x


def paid(x, u):
    return (x[0] - 1) ** 2 + 0.1 * u[0] ** 2


def speed(x):
    return hjb.Box(-0.2 - 0.1 * x**2, 0.2 + 0.1 * x**2)


@pytest.fixture(scope="module")
def solved():
    problem = hjb.Problem(steer, paid, speed, discount=0.5, control_names=("speed",))
    return problem, hjb.solve(problem, GRID, scheme=CHAIN)


def test_the_policy_is_the_users_and_the_bounds_are_reached_to_the_last_bit(solved):
    problem, found = solved
    assert found.problem is problem
    hi = np.asarray(0.2 + 0.1 * X**2)
    assert np.array_equal(found.policy[3:12, 0], hi[3:12])
    assert hjb.chain.generator(problem, GRID, found.policy).shape == (31, 31)
    assert hjb.estimate(problem, GRID, measure=False).fits


@pytest.mark.slow
def test_a_constant_box_as_a_function_is_the_box():
    given = (hjb.Box([-1.0], [1.0]), lambda x: hjb.Box([-1.0], [1.0]))
    fixed, free = (hjb.solve(hjb.Problem(steer, paid, each, discount=0.5), GRID, scheme=CHAIN) for each in given)
    assert np.allclose(fixed.value, free.value, rtol=1e-12)
    assert np.allclose(fixed.policy, free.policy, atol=1e-9)


@pytest.mark.slow
def test_paths_feedbacks_and_marches_have_the_users_controls(solved):
    problem, found = solved
    path = hjb.simulate(problem, found, [-1.0], 3.0)
    assert path.cost == pytest.approx(path.promised, abs=0.5)
    assert path.controls[0, 0] == pytest.approx(0.3, abs=1e-3)  # interpolated
    greedy = hjb.greedy_feedback(problem, found)
    assert greedy([-1.0])[0] == pytest.approx(0.3, abs=1e-9)
    assert hjb.simulate(problem, greedy, [-1.0], 1.0).status.name == "DURATION"

    def growing(t, x):
        return hjb.Box(-(1 + t) * jnp.ones(1), (1 + t) * jnp.ones(1))

    moving = hjb.Problem(lambda t, x, u: u, lambda t, x, u: (x[0] - 1) ** 2, growing, time_dependent=True)
    marched = hjb.march(moving, GRID, 1.0, times=[0.0, 0.5])
    assert marched.policy[0, 5, 0] == pytest.approx(1.0)
    assert marched.policy[1, 5, 0] == pytest.approx(1.5)


@pytest.mark.slow
def test_derivatives_with_respect_to_the_numbers_of_the_bounds():
    def at(a):
        problem = hjb.Problem(steer, paid, lambda x: hjb.Box(-a - 0.1 * x**2, a + 0.1 * x**2), discount=0.5)
        found = hjb.solve(problem, GRID, scheme=CHAIN, tol=1e-6)
        return found.value[4], found.policy[4, 0]

    slopes = [jax.grad(lambda a, k=k: at(a)[k])(0.2) for k in (0, 1)]
    assert float(slopes[0]) == pytest.approx((at(0.201)[0] - at(0.199)[0]) / 0.002, rel=1e-3)
    assert float(slopes[1]) == pytest.approx(1.0, abs=1e-5)  # the bound itself


@pytest.mark.slow
def test_a_game_with_rewards_under_a_borrowing_limit():
    """Two inputs with their own bounds, a disturbance and rewards; the optimum is at the bounds."""

    def limits(x):
        return hjb.Box(jnp.array([0.0, -0.1]), jnp.stack([0.5 - 0.1 * x[0], 0.2]))

    problem = hjb.Problem(
        lambda x, u, d: u[:1] - u[1:] + 0.1 * d, reward=lambda x, u, d: x[0] - 0.3 * u[1] + 0 * d[0], controls=limits,
        disturbances=hjb.Box([-1.0], [1.0]), discount=1.0,
    )  # fmt: skip
    found = hjb.solve(problem, GRID, scheme=CHAIN, tol=1e-6)
    assert np.allclose(found.policy[5:-5, 0], 0.5 - 0.1 * X[5:-5])
    assert np.allclose(found.policy[5:-5, 1], -0.1)
    assert np.allclose(found.disturbance[5:-5, 0], -1)


@pytest.mark.parametrize(
    ("controls", "said"),
    [
        (lambda x: hjb.Box(x, 0.5 + 0 * x), r"no admissible control at 12 nodes, the first x = \[0.5"),
        (lambda x: hjb.Box(-1 + 0 * x, jnp.log(x)), r"no admissible control at .* x = \[-2.0\]"),
        (lambda x: (x, x + 1), r"controls\(x\) returned .* wanted hjb.Box"),
        (lambda x: hjb.Ball(1.0 + x[0] ** 2, 1), r"controls\(x\) returned .* wanted hjb.Box"),
        (lambda x, u: hjb.Box(x, x), r"controls\(x\) failed on one state"),
    ],
)
def test_bounds_without_a_control_and_other_results_are_refused(controls, said):
    with pytest.raises((ValueError, TypeError), match=said):
        hjb.solve(hjb.Problem(steer, paid, controls, discount=0.5), GRID)


@pytest.mark.slow
def test_a_path_that_may_be_stopped_ends_where_v_says():
    """Bounds that happen to be the same at all states; ``simulate`` refused them where stopping has a cost."""

    def price(x):
        return jnp.sin(3 * x[0]) ** 2

    def stopped(controls):
        return hjb.Problem(lambda x, u: u, lambda x, u: 0.3 + u @ u, controls, discount=0.5, stopping_cost=price)

    problem, fixed = stopped(lambda x: hjb.Box(-1 + 0 * x, 1 + 0 * x)), stopped(hjb.Box([-1.0], [1.0]))
    line = hjb.Grid([-1.5], [1.5], (61,))
    path, other = (hjb.simulate(each, hjb.solve(each, line), [0.6], 5.0) for each in (problem, fixed))
    assert path.status is other.status
    assert path.cost == pytest.approx(other.cost, rel=1e-9)


def test_what_needs_a_fixed_set_says_so():
    problem = hjb.Problem(steer, paid, speed, discount=0.5)
    with pytest.raises(ValueError, match="pontryagin: got bounds of the controls that depend on the state"):
        hjb.pontryagin(problem, [1.0])
    with pytest.raises(ValueError, match="wanted Finite"):
        hjb.chain.transition_arrays(problem, GRID)
    with pytest.raises(ValueError, match="bounds that depend on the state"):
        hjb.filtering.GridFilter(problem, lambda x: x, GRID, lambda x: jnp.exp(-x @ x))
    with pytest.raises(TypeError, match=r"Problem\.disturbances"):
        hjb.Problem(lambda x, u, d: u, paid, hjb.Box([-1.0], [1.0]), disturbances=speed)
