"""Paths that meet the equations and are no answer: through the target, from within it, stationary and no minimum."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo

STALLED, CONVERGED = hjb.Status.STALLED, hjb.Status.CONVERGED
ISLAND = hjb.Problem(
    lambda x, u: u,
    lambda x, u: u @ u,
    hjb.Ball(10.0, 2),
    target=lambda x: x @ x - 0.25,
    exit_cost=100.0,
    terminal_cost=lambda x: 10 * ((x[0] - 1) ** 2 + x[1] ** 2),
)


def without_target(problem):
    return dataclasses.replace(problem, target=None, exit_cost=None)


@pytest.mark.slow
@pytest.mark.parametrize("ends", [{"horizon": 1.0}, {"horizon": 1.0, "terminal": [1.0, 0.0]}], ids=["cost", "state"])
def test_a_path_through_the_target_is_no_answer(ends):
    """The target costs 100, and a path through it would have paid them."""
    extremal = hjb.pontryagin(ISLAND, [-1.0, 0.02], **ends, throw=False)
    assert extremal.status is STALLED
    inside = np.linalg.norm(extremal.states, axis=1) < 0.5
    assert "enters the problem's target at t = " in extremal.message
    entered = float(extremal.message.split("t = ")[1].split(",")[0])
    assert entered == pytest.approx(extremal.times[inside][0], abs=0.05)
    assert "replace(problem, target=None, exit_cost=None)" in extremal.message
    assert hjb.pontryagin(without_target(ISLAND), [-1.0, 0.02], **ends).cost == pytest.approx(extremal.cost)


def test_around_the_target_is_an_answer():
    past = hjb.pontryagin(ISLAND, [-1.0, 0.8], horizon=1.0, terminal=[1.0, 0.8])
    assert past.cost == pytest.approx(4 + 10 * 0.8**2)


def test_a_target_between_two_nodes_of_the_mesh_is_seen():
    """A line at full speed: a strip of width .004 that no node of the mesh lies in."""
    thin = hjb.Problem(
        lambda x, u: u, lambda x, u: u @ u, hjb.Box([-9.0], [9.0]), target=lambda x: jnp.abs(x[0] - 0.5062) - 0.002
    )
    extremal = hjb.pontryagin(thin, [0.0], horizon=1.0, terminal=[1.0], throw=False)
    assert np.min(np.abs(extremal.states[:, 0] - 0.5062)) > 0.002
    assert extremal.status is STALLED
    assert "enters the problem's target at t = 0.5" in extremal.message


@pytest.mark.parametrize(
    ("problem", "x0", "paid"),
    [(zoo.eikonal(discount=0.0)[0], [0.05, 0.05], ""), (ISLAND, [0.1, 0.1], "100;"), (ISLAND, [0.5, 0.0], "100;")],
)
def test_a_start_in_the_target_is_refused(problem, x0, paid):
    with pytest.raises(ValueError, match=r"x0 = .*, in the target, where a run ends at once and costs " + paid):
        hjb.pontryagin(problem, x0)
    with pytest.raises(ValueError, match="in the target"):
        hjb.pontryagin(problem, x0, horizon=1.0)


def test_a_lander_that_crashes_is_refused():
    """It would burn first, fly down below the ground and come back up."""
    with pytest.raises(ValueError, match="in the target"):
        hjb.pontryagin(zoo.moon_landing()[0], [0.2, -1.5, 1.0], terminal=[0.0, 0.0, np.nan])


BREATHING = hjb.Problem(
    lambda t, x, u: u, lambda t, x, u: jnp.cos(t) + u @ u, hjb.Box([-9.0], [9.0]), time_dependent=True
)


@pytest.mark.parametrize(("guess", "end", "status"), [(1.4, np.pi / 2, STALLED), (4.5, 1.5 * np.pi, CONVERGED)])
def test_a_final_time_may_be_the_worst(guess, end, status):
    """J(T) = sin T."""
    free = {"terminal": lambda t, x: 0 * x[0], "horizon": hjb.FreeTime(guess)}
    extremal = hjb.pontryagin(BREATHING, [0.0], **free, throw=False)
    assert extremal.horizon == pytest.approx(end, abs=1e-6)
    assert extremal.status is status
    assert ("the cost as a function of the final time is largest" in extremal.message) == (status is STALLED)


@pytest.mark.parametrize(
    ("dim", "horizon", "ends", "conjugate"),
    [
        (1, 4.0, [0.0], 4.0 - np.pi),
        (1, 3.0, [0.0], None),
        (1, 1.7, None, 1.7 - np.pi / 2),
        (1, 1.5, None, None),
        pytest.param(2, 4.0, [0.0, 0.0], 4.0 - np.pi, marks=pytest.mark.slow),
    ],
)
def test_past_a_conjugate_point(dim, horizon, ends, conjugate):
    """u² − x²: to a given end minimal for less than half a turn, to a free one for a quarter; in two states at once."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: u @ u - x @ x, hjb.Box([-50.0] * dim, [50.0] * dim))
    start = [1.0, 0.5][:dim]
    extremal = hjb.pontryagin(problem, start, horizon=horizon, terminal=ends, throw=False)
    assert extremal.status is (CONVERGED if conjugate is None else STALLED)
    if conjugate is not None:
        assert "an extremal, not a minimum" in extremal.message
        told = float(extremal.message.split("t = ")[1].split(" ")[0])
        assert told == pytest.approx(conjugate, abs=0.02)


@pytest.mark.slow
def test_a_target_that_is_only_touched():
    """Least time 3.05; the path that ends at (−.2, 0), along the edge of the disc, takes 4.1."""
    extremal = hjb.pontryagin(zoo.double_integrator(discount=0.0)[0], [1.5, 0.5], throw=False)
    assert extremal.status is not CONVERGED or extremal.cost == pytest.approx(3.0495, abs=1e-3)


@pytest.mark.parametrize("unit", [1.0, 1e-8])
def test_a_gap_is_one_in_every_unit_of_cost(unit):
    """Bang, then singular: the optimum is a third of a unit."""
    problem = hjb.Problem(lambda x, u: u, lambda x, u: unit * x[0] ** 2, hjb.Box([-1.0], [1.0]))
    extremal = hjb.pontryagin(problem, [1.0], horizon=3.0, throw=False)
    assert extremal.status is not CONVERGED or extremal.cost == pytest.approx(unit / 3, rel=1e-3)


@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_a_rest_that_costs_is_refused_in_every_unit_of_cost(unit):
    problem = hjb.Problem(lambda x, u: u, lambda x, u: unit * (1 + x @ x + u @ u), hjb.Box([-9.0], [9.0]))
    with pytest.raises(ValueError, match="per unit time without a discount"):
        hjb.pontryagin(problem, [1.0])


def test_a_start_at_rest():
    problem, _ = zoo.double_integrator_lq()
    assert hjb.pontryagin(problem, [0.0, 0.0]).cost == pytest.approx(0, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [pytest.param(1e-9, marks=pytest.mark.slow), 1e6])
def test_lengths_in_any_unit(unit):
    """tanh(T) x², and least time 2 √(x/a): a length of 1e-9 is below every absolute tolerance."""
    calm = hjb.Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, hjb.Box([-9 * unit], [9 * unit]))
    extremal = hjb.pontryagin(calm, [0.8 * unit], horizon=1.5)
    assert extremal.cost == pytest.approx(np.tanh(1.5) * (0.8 * unit) ** 2, rel=1e-6)
    pushed = hjb.Problem(lambda x, u: jnp.append(x[1], u), lambda x, u: jnp.ones(()), hjb.Box([-unit], [unit]))
    quick = hjb.pontryagin(pushed, [unit, 0.0], terminal=[0.0, 0.0])
    assert quick.cost == pytest.approx(2, abs=1e-6)
    assert quick.switches == pytest.approx([1], abs=1e-6)


@pytest.mark.slow
def test_an_infinite_horizon_in_a_small_unit():
    problem, _ = zoo.double_integrator_lq(bound=1e-8)
    assert hjb.pontryagin(problem, [1e-9, 0.0]).cost == pytest.approx(np.sqrt(3) * 1e-18, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "units", [(1.0, 1.0, 1.0, 1.0), (1e6, 1e-6, 1.0, 1.0), (1e-6, 1e6, 1e3, 1e6), (1.0, 1.0, 1e-6, 1e-9)], ids=str
)
def test_a_rest_in_any_units(units):
    """A damped pendulum held at 0.2: states, time and cost in other units have the same rest, cost, and refusals."""
    sizes, time, cost = np.array(units[:2]), units[2], units[3]

    def drift(x, u, gravity=0.0):
        z = x / sizes
        return sizes * jnp.stack([z[1], gravity + jnp.sin(z[0]) - 0.3 * z[1] + u[0]]) / time

    def running(x, u):
        z = x / sizes
        return cost / time * (3 * (z[0] - 0.2) ** 2 + 0.5 * z[1] ** 2 + (u[0] + jnp.sin(0.2)) ** 2)

    problem = hjb.Problem(drift, running, hjb.Box([-5.0], [5.0]))
    near = sizes * np.array([0.1, 0.3])
    assert hjb.pontryagin(problem, sizes * np.array([1.5, 0.0]), rest=near).cost == pytest.approx(7.80215844 * cost)
    held = hjb.pontryagin(problem, sizes * np.array([0.2, 0.0]), rest=near)
    assert abs(held.cost) < 1e-20 * cost
    falling = dataclasses.replace(problem, drift=lambda x, u: drift(x, u, 9.0))
    with pytest.raises(ValueError, match="no rest point of the Hamiltonian flow"):
        hjb.pontryagin(falling, sizes * np.array([1.5, 0.0]))
