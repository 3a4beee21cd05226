"""``solve`` under jit, vmap and grad beside ``solve`` and ``solve_batch``: one path, and so one answer."""

import inspect
import signal
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.solvers import transformed
from hjbjax.solvers.stationary_run import StationaryRun

# name, nodes of each axis
QUICK = [("bang-bang", (41,))]
SIZES = {1: (61,), 2: (31, 31), 3: (11, 12, 13)}
ON_A_RING = {"pendulum": (30, 31), "manipulator": (30, 31)}  # with a node at rest
TABLE = [(name, ON_A_RING.get(name, SIZES[len(entry.start)])) for name, entry in zoo.catalogue.items()]


def posed(name, shape):
    """A problem of the zoo on a small grid."""
    make = zoo.catalogue[name].build
    assert "shape" in inspect.signature(make).parameters
    return make(shape=shape)


def agree(name, shape):
    """All ways to an answer, to 1e-8 of its range in 64 bits and to rounding in 32."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hjb.SolveWarning)
        problem, grid = posed(name, shape)
        alone = hjb.solve(problem, grid, throw=False)
        lane = hjb.solve_batch([problem], grid, throw=False)[0]
        known = alone.status is hjb.Status.CONVERGED

        def value(problem):
            return hjb.solve(problem, grid).value

        stacked = jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * 2), problem)
        with jax.enable_x64(True):
            stacked = jax.tree.map(lambda leaf: np.stack([np.asarray(leaf, float)] * 2), problem)
            ways = {"jit": jax.jit(value)(problem), "vmap": jax.vmap(value)(stacked)[1]}
        single = np.asarray(jax.jit(value)(jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), problem)))
    finite = np.isfinite(alone.value)
    size = np.ptp(alone.value[finite])
    np.testing.assert_allclose(lane.value[finite], alone.value[finite], rtol=0, atol=1e-8 * size)
    for way, found in ways.items():
        found = np.asarray(found)
        if not known:
            assert np.all(np.isnan(found)), way
            continue
        np.testing.assert_array_equal(np.isfinite(found), finite)
        np.testing.assert_allclose(found[finite], alone.value[finite], rtol=0, atol=1e-8 * size, err_msg=way)
    if known:
        np.testing.assert_allclose(single[finite], alone.value[finite], rtol=0, atol=1e-3 * size)


@pytest.mark.parametrize(("name", "shape"), QUICK)
def test_a_small_problem_has_one_answer(name, shape):
    agree(name, shape)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "shape"), TABLE)
def test_every_problem_of_the_zoo_has_one_answer(name, shape):
    agree(name, shape)


GRID, AT = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (21, 21)), np.array([0.63, 0.21])


def game(bound):
    return hjb.Problem(
        lambda x, u, d: jnp.stack([u[0] + d[0], u[1] - 0.2 * x[0]]), lambda x, u, d: 1 + 0.5 * x[1] ** 2,
        hjb.Ball(bound, 2), disturbances=hjb.Finite([[-0.3], [0.3]]), target=lambda x: jnp.sqrt(x @ x + 1e-12) - 0.31,
    )  # fmt: skip


@pytest.mark.parametrize("by", ["grad", "vmap"])
def test_an_interrupt_on_the_host_is_one_for_the_caller(by, monkeypatch):
    """It came out as an error of XLA's with the interrupt in its text."""

    def pressed(*_):
        raise KeyboardInterrupt

    def value(rate):
        problem = hjb.Problem(lambda x, u: rate * u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
        return hjb.solve(problem, hjb.Grid([-1.0], [1.0], (9,))).value[3]

    monkeypatch.setattr(transformed, "_solved", pressed)
    with pytest.raises(KeyboardInterrupt):
        jax.grad(value)(0.5) if by == "grad" else jax.vmap(value)(jnp.ones(2))


@pytest.mark.parametrize("door", ["solve", "march"])
@pytest.mark.parametrize("option", [{"checkpoint": "run.npz"}, {"resume": True}])
def test_a_checkpoint_inside_a_transformation_is_refused(door, option):
    """It was ignored, and a run of hours had no file."""
    line = hjb.Grid([-1.0], [1.0], (9,))

    def value(weight):
        problem = hjb.Problem(lambda x, u: weight * u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
        found = hjb.solve(problem, line, **option) if door == "solve" else hjb.march(problem, line, 1.0, **option)
        return found.value.sum()

    with pytest.raises(ValueError, match=f"^{door}: checkpoint= and resume= work at host level only"):
        jax.grad(value)(1.0)


def test_ctrl_c_in_the_steps_of_one_lane_ends_all_lanes_and_is_not_an_answer(monkeypatch):
    """The caller's loop would go on with NaN, after the other lanes have run to their ends."""
    line = hjb.Grid([-1.0], [1.0], (9,))
    pressed = []

    def advance(run, count):
        if not pressed:
            pressed.append(signal.raise_signal(signal.SIGINT))
        return usual(run, count)

    def value(weight):
        problem = hjb.Problem(lambda x, u: weight * u, lambda x, u: x @ x, hjb.Box([-1.0], [1.0]), discount=1.0)
        return hjb.solve(problem, line, method=hjb.ValueIteration(), scheme=hjb.Upwind(), tol=1e-9).value[0]

    usual = StationaryRun.advance
    monkeypatch.setattr(StationaryRun, "advance", advance)
    with pytest.raises(KeyboardInterrupt):
        jax.vmap(value)(np.array([0.5, 1.0, 2.0]))


@pytest.mark.slow
def test_the_value_of_a_game_and_its_derivative():
    """It was DIVERGED in its first step, and returned (186, 6.5e14)."""

    def value(bound):
        return hjb.solve(game(bound), GRID, tol=1e-6).value_at(AT)

    with jax.enable_x64(True):
        found, slope = jax.value_and_grad(value)(1.0)
    assert float(found) == pytest.approx(float(value(1.0)), rel=1e-9)
    assert float(slope) == pytest.approx(float(value(1 + 1e-4) - value(1 - 1e-4)) / 2e-4, rel=1e-3)


def swing(x, u):
    return jnp.stack([x[1], jnp.sin(x[0]) + 2 * u[0]])


def effort(x, u):
    return 1 - jnp.cos(x[0]) + 0.1 * x[1] ** 2 + 0.1 * u @ u


def at_rest(price, **options):
    problem = hjb.Problem(swing, lambda x, u: price * effort(x, u), hjb.Box([-1.0], [1.0]))
    grid = hjb.Grid([-np.pi, -3.0], [np.pi, 3.0], (24, 25), periodic=(True, False))
    return hjb.solve(problem, grid, **options)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
def test_an_answer_that_did_not_converge_is_no_number_unless_it_is_asked_for():
    def read(price, **options):
        return at_rest(price, **options).value_at(jnp.array([1.0, 0.5]))

    with jax.enable_x64(True):
        value, slope = jax.value_and_grad(read)(1.5)
        failed = jax.value_and_grad(lambda price: read(price, max_steps=2))(1.5)
        partial = jax.jit(lambda price: at_rest(price, max_steps=2, throw=False))(1.5)
        lanes = jax.vmap(read)(jnp.array([0.5, 1.0, 1.5, 2.0]))
    assert float(slope) == pytest.approx(float(value) / 1.5, rel=1e-3)  # V is linear in the price
    np.testing.assert_allclose(lanes, float(value) * np.array([0.5, 1.0, 1.5, 2.0]) / 1.5, rtol=1e-3)
    assert np.isnan(failed).all()
    assert hjb.Status(int(partial.code)) is hjb.Status.MAX_STEPS
    known = at_rest(1.5, max_steps=2, throw=False)
    assert known.status is hjb.Status.MAX_STEPS
    np.testing.assert_allclose(partial.value, known.value, rtol=0, atol=1e-12)
