"""Steps in time: the discount, the clock, functions of the time, steps that are too long, and what all steps show."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb

LINE = hjb.Grid([-1.0], [1.0], (101,))
UNIT = hjb.Box([-1.0], [1.0])
PAIR = hjb.Finite([[-1.0], [1.0]])


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"scheme": hjb.Upwind()}, marks=pytest.mark.slow),
        pytest.param({"method": hjb.Explicit(4)}, marks=pytest.mark.slow),
        pytest.param({"method": hjb.Implicit()}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_the_discount_is_integrated_exactly(options):
    """One step whatever the horizon: V(1) was 0.505 and, by ``Upwind()``, 0.1."""
    problem = hjb.Problem(lambda x, u: 0 * x, None, discount=1.0, terminal_cost=lambda x: x @ x)
    for horizon in (0.9, 3.0):
        solution = hjb.march(problem, LINE, horizon, **options)
        assert solution.value_at(0.0, [1.0]) == pytest.approx(np.exp(-horizon), abs=1e-7)


@pytest.mark.parametrize(
    ("stages", "order"),
    [(1, 1), pytest.param(2, 2, marks=pytest.mark.slow), (3, 3), pytest.param(4, 3, marks=pytest.mark.slow)],
)
def test_a_discount_keeps_the_order_in_time(stages, order):
    """ẋ = −x, cost x and discount 2 on two nodes, whose equation is linear: by half as long steps."""
    problem = hjb.Problem(lambda x, u: -x, lambda x, u: x[0] ** 2, discount=2.0, terminal_cost=lambda x: 2 * x[0])
    grid, exact = hjb.Grid([0.0], [1.0], (11,)), None
    found = []
    for step in (0.04, 0.02, 0.0005):
        solution = hjb.march(problem, grid, 0.4, step=step, method=hjb.Explicit(stages), scheme=hjb.Upwind())
        found.append(solution.value[0])
    exact = found.pop()
    coarse, fine = (np.max(np.abs(value - exact)) for value in found)
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [1e4, 1e5])
def test_a_long_clock_in_single_precision(horizon):
    """At 1e5 the clock, which float32 rounds to 0.008, made 896,657 steps to |V| = 7583."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, UNIT)
    solution = hjb.march(problem, hjb.Grid([-1.0], [1.0], (401,)), horizon, times=[horizon - 1], dtype="float32")
    assert solution.steps == 223
    assert solution.value_at(horizon - 1, [1.0]) == pytest.approx(1 / 3, abs=1e-5)


def accrued(cost, **options):
    """V of a cost of the time alone."""
    problem = hjb.Problem(lambda t, x, u: 0 * x, lambda t, x, u: cost(t), time_dependent=True)
    return float(hjb.march(problem, LINE, 1.0, **options).value_at(0.0, [0.0]))


def fast(t):
    return 1 + jnp.cos(200 * jnp.pi * t)


def pulse(t):
    return jnp.where(jnp.abs(t - 0.5003) < 0.002, 250.0, 0.0)


@pytest.mark.parametrize(
    "scheme",
    [None, pytest.param(hjb.Upwind(), marks=pytest.mark.slow), pytest.param(hjb.Weno5(), marks=pytest.mark.slow)],
    ids=str,
)
def test_an_oscillation_between_the_steps_is_seen(scheme):
    """It is 2 at every hundredth of the horizon: V was 2, by ``Weno5()`` 0.667."""
    assert accrued(fast, scheme=scheme) == pytest.approx(1, abs=0.01)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*change faster than steps of")
def test_a_pulse_between_the_steps_is_seen():
    assert accrued(pulse) == pytest.approx(1, abs=0.05)


def test_a_given_step_that_misses_functions_of_the_time_is_told():
    with pytest.warns(UserWarning, match="change within steps of step = 0.01"):
        accrued(fast, step=0.01)


@pytest.mark.slow
def test_smooth_functions_of_the_time_take_a_hundred_steps():
    problem = hjb.Problem(lambda t, x, u: 0 * x, lambda t, x, u: 1 + jnp.cos(2 * jnp.pi * t), time_dependent=True)
    assert hjb.march(problem, LINE, 1.0).steps == 100


@pytest.mark.slow
def test_the_gap_is_the_largest_of_all_steps():
    """An opponent who counts from 0.3 to 0.6 alone: the gap was that of the last time, 0."""
    problem = hjb.Problem(
        lambda t, x, u, d: 0 * x, lambda t, x, u, d: u[0] * d[0] * jnp.where((t > 0.3) & (t < 0.6), 1.0, 0.0), PAIR,
        disturbances=PAIR, time_dependent=True,
    )  # fmt: skip
    with pytest.warns(UserWarning, match="Isaacs condition fails"):
        solution = hjb.march(problem, LINE, 1.0)
    assert solution.isaacs_gap == pytest.approx(2.0)


@pytest.mark.filterwarnings("ignore:the grid is coarse", "ignore:the box decides")
@pytest.mark.parametrize("method", [hjb.Explicit(), pytest.param(hjb.Implicit(), marks=pytest.mark.slow)])
def test_what_is_cut_is_counted_in_all_steps(method):
    """Drift that leaves the box from 0.3 to 0.6 only: nothing was cut off at the kept times."""
    pulled = hjb.Problem(
        lambda t, x, u: 0.1 * u + jnp.where((t > 0.3) & (t < 0.6), 2.0, 0.0), lambda t, x, u: x @ x, UNIT,
        time_dependent=True,
    )  # fmt: skip
    line = hjb.Grid([-1.0], [1.0], (41,))
    assert hjb.march(pulled, line, 1.0, times=[0.0, 1.0], method=method).cut.tolist() == [[[0, 1]], [[0, 0]]]
    kept = hjb.march(pulled, line, 1.0, times=[0.0, 0.2, 0.8, 1.0], method=method)
    assert kept.cut[:, 0, 1].tolist() == [0, 1, 0, 0]


def there(speed, step, **options):
    problem = hjb.Problem(lambda x, u: speed * u, lambda x, u: x @ x, UNIT)
    return hjb.march(problem, LINE, 1.0, step=step, **options).value_at(0.0, [0.5])


@pytest.mark.slow
def test_a_step_above_the_limit_is_nan_in_transformations():
    """The host refuses it; V was 1.5e31 and said to be converged."""
    assert np.isnan(jax.jit(lambda a: there(a, 0.03))(1.0))
    assert np.isnan(jax.grad(lambda a: there(a, 0.03))(1.0))
    lanes = jax.vmap(lambda a: there(a, 0.03))(jnp.array([1.0, 0.1]))
    assert np.isnan(lanes).tolist() == [True, False]
    assert np.isfinite(jax.jit(lambda a: there(a, 0.03, throw=False))(1.0))
    assert jax.jit(lambda a: there(a, 0.01))(1.0) == pytest.approx(0.0417, abs=1e-3)


@pytest.mark.slow
def test_a_bounded_disturbance_is_answered_alike_on_the_host_and_in_transformations():
    """A cost −d² with |d| ≤ 0.3 was DIVERGED on the host."""

    def value(weight):
        problem = hjb.Problem(
            lambda x, u, d: u + d, lambda x, u, d: weight * x @ x - d @ d, UNIT, disturbances=hjb.Box([-0.3], [0.3])
        )
        return hjb.march(problem, LINE, 1.0, step=0.01).value_at(0.0, [0.5])

    assert value(1.0) == pytest.approx(float(jax.jit(value)(1.0)), rel=1e-5)


def test_a_kept_time_may_be_a_rounding_beyond_the_horizon():
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, UNIT)
    assert hjb.march(problem, LINE, 0.3, times=np.arange(4) * 0.1).times[-1] == 0.3


@pytest.mark.slow
def test_an_implicit_march_over_next_to_no_time():
    problem = hjb.Problem(lambda x, u: u, lambda x, u: x @ x, UNIT)
    solution = hjb.march(problem, LINE, 1e-300, method=hjb.Implicit())
    assert np.max(np.abs(solution.value)) < 1e-299


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the box decides V")
def test_implicit_steps_settle_where_one_control_steers_the_noise():
    """The search went to and fro between two actions that are nearly as good: STALLED at t = 0.4."""
    problem = hjb.Problem(
        lambda y, u: jnp.stack([0.03 + 0.05 * u[0] - u[1] - 0.02 * u[0] ** 2]), lambda y, u: jnp.exp(-y[0]) / u[1],
        hjb.Box([0.0, 0.05], [1.5, 3.0]), noise=lambda y, u: 0.2 * u[0], terminal_cost=lambda y: jnp.exp(-y[0]),
    )  # fmt: skip
    solution = hjb.march(problem, hjb.Grid([-1.0], [1.0], (21,)), 1.0, step=0.05, method=hjb.Implicit(), throw=False)
    assert solution.status is hjb.Status.CONVERGED
