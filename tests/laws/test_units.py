"""Time in another unit and cost in another one rescale the value, and change nothing else."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.problem.pytree import pytree_dataclass

UNITS = [(1e6, 1e9), (1e-6, 1e-9)]
GRID = hjb.Grid([-1.5, -1.5], [1.5, 1.5], (13, 11))

pytestmark = pytest.mark.filterwarnings(
    "ignore:the optimal drift leaves the box", "ignore:.*the Isaacs condition fails", "ignore:.*cannot reach the target"
)


@pytree_dataclass(static=("function",))
class Times:
    """A function of a problem times a number, which is a leaf: all units share one compiled program."""

    function: Callable
    factor: float

    def __call__(self, *arguments):
        return self.factor * self.function(*arguments)


@dataclasses.dataclass(frozen=True)
class Units:
    """A problem in units of ``time`` and of ``cost``; numbers are those of the first units."""

    time: float = 1.0
    cost: float = 1.0

    def paid(self, function, rate=1.0):
        return None if function is None else Times(function, self.cost * rate)

    def problem(self, drift, cost, controls, *, discount=0.0, noise=None, exit_cost=None, **ends):
        ends = {name: self.paid(end) if name != "target" else end for name, end in ends.items() if callable(end)} | {
            name: end for name, end in ends.items() if not callable(end)
        }
        return hjb.Problem(
            Times(drift, self.time), self.paid(cost, self.time), controls,
            discount=self.time * discount, noise=None if noise is None else np.sqrt(self.time) * noise,
            exit_cost=self.paid(exit_cost), **ends,
        )  # fmt: skip


def swing(x, u):
    return jnp.stack([x[1], u[0] - jnp.sin(x[0])])


def push(x, u):
    return jnp.stack([x[1], u[0]])


def chase(x, u, d):
    return jnp.stack([x[1] + d[0], u[0] - 0.4 * d[0]])


def square(x, u):
    return x @ x + 0.3 * u @ u


def one(x, u):
    return 1.0


def away(x):
    return jnp.linalg.norm(x) - 0.4


BOX = hjb.Box([-1.0], [1.0])

QUESTIONS = {
    "discounted": {"drift": swing, "cost": square, "controls": BOX, "discount": 0.4},
    "noisy": {"drift": swing, "cost": square, "controls": BOX, "discount": 0.4, "noise": np.array([0.3, 0.5])},
    "finite": {"drift": swing, "cost": square, "controls": hjb.Finite([[-1.0], [0.2], [1.0]]), "discount": 0.4},
    "ball": {"drift": lambda x, u: u - 0.1 * x, "cost": lambda x, u: 1.0 + x @ x, "controls": hjb.Ball(1.0, 2),
             "target": away},
    "minimum time": {"drift": push, "cost": one, "controls": BOX, "target": away},
    "exit cost": {"drift": push, "cost": one, "controls": BOX, "target": away, "exit_cost": lambda x: x[0] - 0.5},
    "rest": {"drift": lambda x, u: u, "cost": square, "controls": hjb.Box([-1.0, -1.0], [1.0, 1.0])},
    "stopping": {"drift": swing, "cost": square, "controls": BOX, "discount": 0.1, "stopping_cost": lambda x: 1 + x[0]},
    "tube": {"drift": swing, "cost": None, "controls": BOX, "stopping_cost": away},
    "kept off": {"drift": swing, "cost": None, "controls": BOX, "running_max": away},
    "game": {"drift": chase, "cost": lambda x, u, d: x @ x + u @ u - d @ d, "controls": BOX, "discount": 0.3,
             "disturbances": hjb.Box([-0.3], [0.3])},
    "pursuit": {"drift": lambda x, u, d: u + d, "cost": lambda x, u, d: 1.0, "controls": hjb.Ball(1.0, 2),
                "disturbances": hjb.Ball(0.4, 2), "target": away},
    "noise to a target": {"drift": push, "cost": one, "controls": BOX, "target": away, "noise": 0.4},
}  # fmt: skip


def asked(name, units):
    return units.problem(**QUESTIONS[name])


def same(found, known, cost):
    """Values within tolerances of each other, and infinite at the same nodes."""
    finite = np.isfinite(known)
    np.testing.assert_array_equal(np.isfinite(found), finite)
    np.testing.assert_allclose(found[finite] / cost, known[finite], atol=2e-6, rtol=1e-6)


def some(names, fast):
    """The ``fast`` ones by default, the others among the slow tests."""
    return [name if name in fast else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.slow
@pytest.mark.parametrize("name", some(QUESTIONS, ["noisy", "minimum time", "rest", "tube", "pursuit"]))
def test_a_solve_knows_no_units(name):
    known = hjb.solve(asked(name, Units()), GRID, tol=1e-6, scheme=hjb.Upwind())
    for time, cost in UNITS:
        found = hjb.solve(asked(name, Units(time, cost)), GRID, tol=1e-6 * cost, scheme=hjb.Upwind())
        same(found.value, known.value, cost)
        assert found.stats["certificate"] == known.stats["certificate"]
        assert abs(found.steps - known.steps) <= 2 + known.steps // 20  # a rounding decides when it is enough
        if known.error is not None and np.isfinite(known.error):
            assert found.error <= 1e-6 * cost or known.error > 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", some(["discounted", "minimum time", "rest", "tube", "game"], ["minimum time"]))
def test_nor_does_a_second_order_solve_or_a_batch(name):
    problems = [asked(name, Units(*units)) for units in [(1.0, 1.0), UNITS[0]]]
    known = hjb.solve(problems[0], GRID, scheme=hjb.Limited(), tol=1e-6, throw=False)
    for problem, (_, cost) in zip(problems[1:], UNITS[:1], strict=True):
        found = hjb.solve(problem, GRID, scheme=hjb.Limited(), tol=1e-6 * cost, throw=False)
        assert found.status is known.status
        same(found.value, known.value, cost)
        (lane,) = hjb.solve_batch([problem], GRID, tol=1e-6 * cost, scheme=hjb.Upwind())
        same(lane.value, hjb.solve(problems[0], GRID, tol=1e-6, scheme=hjb.Upwind()).value, cost)


@pytest.mark.slow
@pytest.mark.parametrize("method", [hjb.Explicit(), hjb.Implicit()])
@pytest.mark.parametrize(
    "name", some(["discounted", "noisy", "minimum time", "stopping", "kept off", "game"], ["noisy", "game"])
)
def test_nor_does_a_march(name, method):
    known = hjb.march(
        asked(name, Units()), GRID, 1.0, method=method, times=[0.0, 0.5], inner=0, scheme=hjb.Upwind(split=True)
    )
    for time, cost in UNITS:
        tuned = hjb.Implicit(tol=1e-6 * cost) if isinstance(method, hjb.Implicit) else method
        found = hjb.march(
            asked(name, Units(time, cost)),
            GRID,
            1.0 / time,
            method=tuned,
            times=[0.0, 0.5 / time],
            inner=0,
            scheme=hjb.Upwind(split=True),
        )
        assert found.steps == known.steps
        np.testing.assert_allclose(found.value / cost, known.value, rtol=1e-6, atol=1e-5)


@pytest.mark.slow
def test_nor_does_an_implicit_march_of_small_costs():
    """Without a tolerance of the user's it is a part of what V spans: 1e-6 was all of it, and 83 % of V was missing."""
    options = {"method": hjb.Implicit(), "step": 0.05, "scheme": hjb.Upwind(split=True)}
    known = hjb.march(asked("noisy", Units()), GRID, 1.0, **options).value
    found = hjb.march(asked("noisy", Units(1.0, 1e-7)), GRID, 1.0, **options).value
    np.testing.assert_allclose(found / 1e-7, known, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_nor_does_a_solve_in_float32():
    known = hjb.solve(asked("discounted", Units()), GRID, tol=1e-4, dtype="float32", scheme=hjb.Upwind()).value
    for time, cost in UNITS:
        found = hjb.solve(
            asked("discounted", Units(time, cost)), GRID, tol=1e-4 * cost, dtype="float32", scheme=hjb.Upwind()
        ).value
        np.testing.assert_allclose(found / np.float32(cost), known, atol=3e-4)
