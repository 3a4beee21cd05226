"""What is earned for ever makes the value −∞, whatever the tolerance and the units; what ends does not."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.iteration.certificates import Certificate
from hjbjax.solution.status import Status
from hjbjax.solvers import result

P = jax.tree_util.Partial
U = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([-1.0], [1.0], (21,))
PLANE = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (11, 11))


def drift(speed, x, u):
    return speed * u


def uphill(speed, x, u):
    return speed * (0.5 + 0.2 * u)


def earn(rate, x, u):
    return rate * jnp.where(x[0] > 0.45, -1.0, 1.0)


def target(x):
    return x[0] + 0.8


def goal(x):
    return 0.8 - x[0]


def problem(*, rate=1.0, speed=1.0, move=drift, cost=earn, **changes):
    return hjb.Problem(P(move, speed), P(cost, rate), U, **({"target": target} | changes))


@pytest.mark.filterwarnings("ignore:.*cannot reach the target")
@pytest.mark.parametrize(("rate", "speed"), [(1.0, 1.0), (1e9, 1.0), (1e-9, 1e-6), (1.0, 1e6)])
@pytest.mark.parametrize("tol", [1e-3, 0.8, 11.0])
def test_a_place_to_stay_and_earn(rate, speed, tol):
    question = problem(rate=rate, speed=speed)
    solution = hjb.solve(question, GRID, tol=tol * rate / speed, throw=False, scheme=hjb.Upwind())
    assert solution.status is Status.DIVERGED
    assert "The value is −∞" in solution.message
    assert f"mean cost is {-rate:.3g} per unit time" in solution.message
    assert "discount > 0" in solution.message
    assert "within reach" not in solution.message
    assert solution.error is None


@pytest.mark.slow
@pytest.mark.parametrize("tol", [1e-3, 0.8])
def test_stopping_is_put_off_for_ever(tol):
    question = hjb.Problem(lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: -1.0, U, stopping_cost=lambda x: x @ x)
    with pytest.raises(hjb.SolveError, match="DIVERGED: The value is −∞") as caught:
        hjb.solve(question, PLANE, tol=tol, scheme=hjb.Upwind())
    assert caught.value.solution.value.shape == PLANE.shape


@pytest.mark.slow
def test_a_round_that_pays_on_the_average():
    """On a ring with a constant current: costs of both signs, and their mean decides."""
    ring = hjb.Grid([0.0], [2 * np.pi], (32,), periodic=(True,))

    def swing(mean, x, u):
        return mean + jnp.sin(x[0])

    def on_the_ring(mean):
        question = hjb.Problem(lambda x, u: 1.0 + 0 * u, P(swing, mean), U, stopping_cost=lambda x: 3.0)
        return hjb.solve(question, ring, throw=False, scheme=hjb.Upwind())

    lost, won = on_the_ring(-0.1), on_the_ring(0.1)
    assert lost.status is Status.DIVERGED
    assert "mean cost is -0.1 per unit time" in lost.message
    assert won.status is Status.CONVERGED
    assert won.value.min() > 3.0 - 2.0 - 1e-6  # the best is to earn from π to 2π and to stop there


@pytest.mark.slow
def test_earning_on_a_way_that_ends():
    solution = hjb.solve(
        problem(move=uphill, cost=lambda rate, x, u: -rate, target=goal), GRID, tol=1e-6, scheme=hjb.Upwind()
    )
    assert solution.status is Status.CONVERGED
    assert solution.value_at([-1.0]) == pytest.approx(-1.8 / 0.3)  # as slowly as one can


def test_with_a_discount_it_is_finite():
    solution = hjb.solve(problem(discount=0.5), GRID, tol=1e-6, scheme=hjb.Upwind())
    assert solution.value_at([1.0]) == pytest.approx(-2.0)


@pytest.mark.slow
def test_in_a_batch_only_the_lane_that_earns():
    def level(rate, x, u):
        return rate

    lanes = [problem(cost=level, target=goal, rate=rate) for rate in (1.0, -1.0)]
    first, earns = hjb.solve_batch(lanes, GRID, throw=False, scheme=hjb.Upwind())
    assert first.status is Status.CONVERGED
    assert earns.status is Status.DIVERGED
    assert "−∞" in earns.message


@pytest.mark.parametrize("certificate", list(Certificate))
def test_without_a_certificate_no_tolerance_is_promised(certificate):
    task, progress = SimpleNamespace(certificate=certificate, tol=1e-3), SimpleNamespace(best=np.array([0.4, 0.4]))
    message = result._message(Status.STALLED, task, SimpleNamespace(progress=progress), GRID)
    assert ("a tolerance of 0.8 is within reach" in message) == (certificate.value[:4] == "from")
    assert ("no certificate bounds" in message) == (certificate.value[:4] != "from")
