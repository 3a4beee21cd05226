"""Steps that are short enough for the actions that they chose, and noise that the chain can represent all along."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.discretisation.rates import jump_rates
from hjbjax.iteration import time_stepping

UNIT = hjb.Box([-1.0], [1.0])
LINE = hjb.Grid([-1.0], [1.0], (41,))
PLANE = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (7, 7))


def peak(u):
    """1 at u = .3, less than .02 at every sample."""
    return 1 / (1 + 4000 * (u[0] - 0.3) ** 2)


def pulled(x, u):
    return -jnp.sign(x) * peak(u)


def square(x, *actions):
    return x @ x


QUESTIONS = {
    "drift": hjb.Problem(pulled, square, UNIT),
    "drift, ball": hjb.Problem(pulled, square, hjb.Ball(1.0, 1)),
    "noise": hjb.Problem(lambda x, u: 0 * x, lambda x, u: -(x @ x), UNIT, noise=lambda x, u: 0.2 * jnp.sqrt(peak(u))),
    "game": hjb.Problem(lambda x, u, d: pulled(x, u) + 0.1 * d, square, UNIT, disturbances=UNIT),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if "ball" in name else name for name in QUESTIONS]
)
def test_no_step_is_longer_than_the_fastest_action_that_it_chose_allows(name):
    problem = QUESTIONS[name]
    found = hjb.march(problem, LINE, 0.5, scheme=hjb.Upwind(split=True))
    fine = hjb.march(problem, LINE, 0.5, step=2e-3, scheme=hjb.Upwind(split=True))
    assert found.steps >= 100
    for solution in (found, fine):  # no cost but the running one, which lies in [0, 1] or in [−1, 0]
        low, high = sorted([0.0, 0.5 * np.sign(np.sum(solution.value))])
        assert low <= np.min(solution.value)
        assert np.max(solution.value) <= high
    np.testing.assert_allclose(found.value, fine.value, rtol=0, atol=0.02)


def test_a_slow_run_of_samples_is_not_slowed_down():
    """Where the fastest action is at an end of the set nothing is looked at on the way."""
    problem = hjb.Problem(lambda x, u: -jnp.sign(x) * u, square, UNIT)
    found = hjb.march(problem, LINE, 0.5, scheme=hjb.Upwind(split=True))
    assert found.steps == np.ceil(0.5 / (0.9 * LINE.spacing(0)))


@pytest.mark.filterwarnings("ignore:the optimal drift leaves")
@pytest.mark.filterwarnings("ignore:the grid is coarse")
@pytest.mark.parametrize(
    ("scheme", "stages"),
    [
        (hjb.Upwind(), 2),
        pytest.param(hjb.Limited(), None, marks=pytest.mark.slow),
        pytest.param(hjb.Upwind(), 3, marks=pytest.mark.slow),
    ],
)
def test_a_drift_that_switches_on_within_a_step_is_not_outrun(scheme, stages):
    """At rest the limit is endless and a step a hundredth of the horizon; within one the rate becomes 800."""

    def drift(t, x, u):
        return jnp.where(t < 0.905, 40.0, 0.0) * jnp.sign(x)

    problem = hjb.Problem(drift, terminal_cost=lambda t, x: jnp.cos(3 * x[0]), time_dependent=True)
    found = hjb.march(problem, LINE, 1.0, times=[0.9], scheme=scheme, method=hjb.Explicit(stages=stages)).value
    assert np.max(np.abs(found)) <= 1 + (0 if isinstance(scheme, hjb.Upwind) else 0.02)


@pytest.mark.slow
def test_value_iteration_does_not_outrun_a_fast_action_between_the_samples():
    problem = hjb.Problem(pulled, square, UNIT, discount=1.0)
    by_policy = hjb.solve(problem, LINE, tol=1e-6, scheme=hjb.Upwind())
    by_value = hjb.solve(problem, LINE, tol=1e-6, method=hjb.ValueIteration(), scheme=hjb.Upwind())
    np.testing.assert_allclose(by_value.value, by_policy.value, rtol=0, atol=2e-6)
    assert np.all(np.diff(by_value.residuals) <= 1e-12)  # a contraction


# --- noise ---


def turned(t, x, u):
    """Noise of one axis before t = ¼, and of both together from then on, which equal spacings cannot represent."""
    late = jnp.where(t > 0.25, 1.0, 0.0)
    return jnp.array([[0.2, 0.0], [late, 1 - late]])


TURNED = hjb.Problem(
    lambda t, x, u: 0 * x, noise=turned, terminal_cost=lambda t, x: x[0] ** 2, time_dependent=True
)  # fmt: skip


def swung(x, u):
    """Correlation that vanishes at all samples of u."""
    r = 0.999 * jnp.sin(4 * jnp.pi * u[0])
    return jnp.stack([jnp.stack([1.0, 0 * r]), jnp.stack([3 * r, jnp.asarray(0.1)])])


SWUNG = hjb.Problem(lambda x, u: -x, lambda x, u: x[0] * x[1], UNIT, noise=swung, discount=1.0)


@pytest.mark.parametrize(
    "method",
    [
        hjb.Explicit(),
        pytest.param(hjb.Explicit(stages=2), marks=pytest.mark.slow),
        pytest.param(hjb.Implicit(), marks=pytest.mark.slow),
    ],
)
def test_a_march_stops_where_its_noise_cannot_be_represented(method):
    """The noise is fine at t = 0, where a problem is looked at before it starts."""
    with pytest.raises(hjb.SolveError, match="correlated noise that the chain cannot represent") as caught:
        hjb.march(TURNED, PLANE, 0.5, method=method, scheme=hjb.Upwind(split=True))
    assert "node (0, 0), x = [-2.0, -2.0]" in str(caught.value)
    assert "Use Grid(..., shape=" in str(caught.value)
    assert caught.value.solution.status is hjb.Status.STALLED
    early = hjb.march(TURNED, PLANE, 0.2, method=method, scheme=hjb.Upwind(split=True))
    assert early.value_at(0.0, [0.0, 0.0]) == pytest.approx(0.008, abs=1e-3)


def test_a_march_keeps_what_it_came_to_before_the_noise_turned():
    """Backward from ½: representable until ¼."""
    problem = hjb.Problem(
        lambda t, x, u: 0 * x, noise=lambda t, x, u: turned(jnp.where(t == 0, 0, 0.5 - t), x, u),
        terminal_cost=lambda t, x: x[0] ** 2, time_dependent=True,
    )  # fmt: skip
    stopped = hjb.march(problem, PLANE, 0.5, throw=False, scheme=hjb.Upwind(split=True))
    assert stopped.status is hjb.Status.STALLED
    assert stopped.times[0] == pytest.approx(0.25, abs=0.02)
    assert np.all(np.isfinite(stopped.value))


@pytest.mark.slow
@pytest.mark.parametrize(
    "ask",
    [
        lambda: hjb.solve(SWUNG, PLANE, scheme=hjb.Upwind()),
        pytest.param(lambda: hjb.solve_batch([SWUNG], PLANE, scheme=hjb.Upwind()), marks=pytest.mark.slow),
        pytest.param(lambda: hjb.march(SWUNG, PLANE, 0.1, scheme=hjb.Upwind(split=True)), marks=pytest.mark.slow),
    ],
    ids=["solve", "solve_batch", "march"],
)
def test_noise_between_the_sampled_controls_is_looked_at_under_the_policy(ask):
    with pytest.raises((ValueError, hjb.SolveError), match=r"cannot represent[^\n]*u = \[[-.\d]+\]"):
        ask()


@functools.partial(jax.jit, static_argnames="dtype")
def rates(problem, u, d, dtype):
    return jump_rates(Discretisation(problem, LINE, hjb.Upwind(split=True), dtype), u, d).total()


@pytest.mark.parametrize("name", QUESTIONS)
def test_no_action_is_faster_than_what_a_march_sees(name):
    """The rate under an action is at most that of the whole set where that is known, and is what stands in Seen."""
    problem = QUESTIONS[name]
    u, d = [jnp.asarray(0.3)], [jnp.asarray(1.0)] if problem.is_game else []
    fast = float(jnp.max(rates(problem, u, d, np.float32)))
    assert fast * float(time_stepping.stable(Discretisation(problem, LINE, hjb.Upwind(split=True), np.float32))) > 1.2
