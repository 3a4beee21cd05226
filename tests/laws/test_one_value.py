"""One value, however it is asked for: ``solve``, batches, ``jit``, ``vmap`` and ``march`` over a long horizon."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import hjbjax as hjb

LINE = hjb.Grid([-2.0], [2.0], (21,))
PLANE = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (9, 9))
U, FEW = hjb.Box([-1.0], [1.0]), hjb.Finite([[-1.0], [0.0], [1.0]])
TOL = 1e-8


def slow_then_fixed(x, u):
    return jnp.where(jnp.abs(x) < 1.5, 0.5 * u, 0.0)


def carried_away(x, u):
    return jnp.where(x > 1.1, 2.0, 1.0) * jnp.where(x > 1.1, 1.0, u)


def steered(x, u):
    return u - 0.3 * jnp.sin(2 * x)


def integrator(x, u):
    return jnp.stack([x[1], u[0]])


def ball(r, x):
    return jnp.max(jnp.abs(x)) - r


def beside(r, x):
    return jnp.abs(x[0] - 1.0) - r


def both_ends(r, x):
    return 1.95 - jnp.abs(x[0])


def fee(r, x):
    return 3 * r * x[0]


def stop(r, x):
    return 2 * r + jnp.cos(2 * x[0])


def unit(x, u):
    return 1.0


def square(x, u):
    return x @ x + 0.5 * u @ u


def contested(x, u, d):
    """Each player drives a component of its own: there both fronts upwind alike."""
    return jnp.stack([u[0] - 0.3 * jnp.sin(2 * x[1]), 0.5 * d[0] - 0.4 * x[0]])


def toll(x, u, d):
    return x @ x + 0.2 * u[0] - 0.1 * d[0]


@dataclasses.dataclass(frozen=True)
class Question:
    """A problem with one number r in it, its grid, and how a march asks for the same."""

    make: object
    grid: hjb.Grid = LINE
    horizon: float = 60.0
    starts: str = ""  # the ingredient that is the terminal cost as well


def tube(problem):
    return dataclasses.replace(problem, terminal_cost=None)


ENDED = {"discount": 1.0, "target": None}
QUESTIONS = {
    "reach": Question(lambda r: tube(hjb.reach(slow_then_fixed, U, Partial(ball, r))), starts="stopping_cost"),
    "avoid": Question(lambda r: tube(hjb.avoid(steered, U, Partial(beside, r))), starts="running_max"),
    "reach-avoid": Question(
        lambda r: tube(hjb.reach_avoid(integrator, FEW, Partial(ball, r), Partial(beside, 0.3))), PLANE,
        starts="stopping_cost",
    ),
    "minimum time, lost nodes": Question(lambda r: hjb.Problem(carried_away, unit, U, target=Partial(ball, r))),
    "discounted target": Question(
        lambda r: hjb.Problem(steered, square, U, discount=0.5, target=Partial(ball, r), exit_cost=Partial(fee, r))
    ),
    "noise": Question(lambda r: hjb.Problem(steered, square, U, discount=0.5, noise=r)),
    "game": Question(lambda r: hjb.Problem(contested, toll, U, disturbances=hjb.Box([-r], [r]), discount=0.5), PLANE),
    "periodic": Question(
        lambda r: hjb.Problem(steered, lambda x, u: r * jnp.cos(x[0]) + 0.1 * u @ u, U, discount=0.5),
        hjb.Grid([-np.pi], [np.pi], (20,), (True,)),
    ),
    "stopping": Question(
        lambda r: hjb.Problem(steered, unit, U, stopping_cost=Partial(stop, r)), starts="stopping_cost"
    ),
    "rest point": Question(lambda r: hjb.Problem(lambda x, u: u * r, square, U)),
    "exits of both signs": Question(
        lambda r: hjb.Problem(steered, unit, FEW, target=Partial(both_ends, r), exit_cost=Partial(fee, r))
    ),
    "plane, uncontrolled exit": Question(
        lambda r: hjb.Problem(
            lambda x, u: -x, lambda x, u: 1.0, noise=np.array([[0.9, 0.0], [0.3, 0.9]]),
            target=lambda x: 0.9 - jnp.max(jnp.abs(x)), exit_cost=Partial(fee, r),
        ), PLANE,
    ),
}  # fmt: skip
CHEAP = ("reach", "minimum time, lost nodes", "exits of both signs")
NAMES = [name if name in CHEAP else pytest.param(name, marks=pytest.mark.slow) for name in QUESTIONS]
R = (0.5, 0.6)


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True), warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=hjb.SolveWarning)  # that some nodes are lost
        yield


def agree(name, found, value, tolerance=1e-6):
    finite = np.isfinite(value)
    assert np.any(finite)
    np.testing.assert_allclose(np.asarray(found)[finite], value[finite], atol=tolerance, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_one_value_however_it_is_asked_for(name):
    question = QUESTIONS[name]
    make, grid = question.make, question.grid
    values = [hjb.solve(make(r), grid, tol=TOL, scheme=hjb.Upwind()).value for r in R]
    assert np.any(values[0] != values[1])  # the number matters
    lost = ~np.isfinite(values[0])

    for solution, value in zip(
        hjb.solve_batch([make(r) for r in R], grid, tol=TOL, scheme=hjb.Upwind()), values, strict=True
    ):
        np.testing.assert_array_equal(np.isfinite(solution.value), np.isfinite(value))
        agree("solve_batch", solution.value, value)

    def traced(r):
        solution = hjb.solve(make(r), grid, tol=TOL, scheme=hjb.Upwind())
        return solution.value, solution.code

    value, code = jax.jit(traced)(R[0])
    agree("jit", value, values[0])
    some, codes = jax.vmap(traced)(jnp.array(R))
    for lane, value in zip(some, values, strict=True):
        agree("vmap", lane, value)
    for ended, found in ((code, value), (codes[0], some[0])):  # what is lost is never drawn as if it meant something
        assert ended == hjb.Status.CONVERGED or (np.any(lost) and not np.all(np.isfinite(found)[lost]))

    start = getattr(make(R[0]), question.starts) if question.starts else None
    marched = hjb.march(
        dataclasses.replace(make(R[0]), terminal_cost=start), grid, question.horizon, scheme=hjb.Upwind(split=True)
    )
    agree("march", marched.value[0], values[0], 1e-5)
    assert np.all(marched.value[0][lost] >= 0.5 * question.horizon)  # not arrived: the toll of the whole time
