"""Solves in arrays with room for a finer grid, beside the same in arrays of their own, and what they compile."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.problem.padding import Padding
from hjbjax.solvers import nested
from hjbjax.solvers.setup import prepare_on_host
from hjbjax.solvers.stationary_run import RunInParts
from tests.support.compilation import compiling
from tests.support.over_devices import read_of_others

U = hjb.Box([-1.0], [1.0])
ANGLE = hjb.Grid([-np.pi, -3.0], [np.pi, 3.0], (36, 31), periodic=(True, False))
PLANE = hjb.Grid([-2.0, -2.0], [2.0, 2.0], (34, 31))  # odd intervals along the first axis


def swing(x, u):
    return jnp.stack([x[1], jnp.sin(x[0]) + 2 * u[0]])


def effort(x, u):
    return 1 - jnp.cos(x[0]) + 0.1 * x[1] ** 2 + 0.1 * u @ u


def chase(x, u, d):
    return jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]) + d[0], u[0]])


PROBLEMS = {
    "periodic": lambda: (hjb.Problem(swing, effort, U, discount=0.5), ANGLE),
    # where the coarser grid is so coarse that its slopes grow without end: copies on the ring would part
    "a ring of few nodes": lambda: (
        hjb.Problem(
            lambda x, u: jnp.stack([x[1], 2 * jnp.sin(x[0]) + u[0]]),
            lambda x, u: 1 - jnp.cos(x[0]) + 0.2 * x[1] ** 2 + 0.1 * u @ u, hjb.Box([-1.5], [1.5]), discount=0.1,
        ),
        hjb.Grid([-np.pi, -2.0], [np.pi, 2.0], (28, 27), periodic=(True, False)),
    ),
    "undiscounted, at rest": lambda: zoo.pendulum(shape=(40, 41)),
    "a target between nodes": lambda: (
        hjb.Problem(
            lambda x, u: jnp.stack([x[1], u[0]]), lambda x, u: 1.0 + x[0] ** 2, U, discount=0.2,
            target=lambda x: jnp.linalg.norm(x) - 0.7, exit_cost=lambda x: 0.3 * x[0],
        ),
        PLANE,
    ),
    "nodes that are lost": lambda: (
        hjb.Problem(lambda x, u: jnp.stack([u[0], 1.0 + 0 * x[0]]), lambda x, u: 1.0, U, target=lambda x: 1.0 - x[1]),
        hjb.Grid([-2.0, -2.0], [2.0, 2.0], (33, 33)),
    ),
    "constrained ends": lambda: (
        hjb.Problem(lambda x, u: u - 0.5 * x[::-1], effort, hjb.Box([-1.0] * 2, [1.0] * 2), discount=1.0),
        hjb.Grid([-1.0, -1.0], [1.0, 1.0], (31, 29), edges="constrained"),
    ),
    "obstacles": lambda: (
        hjb.Problem(swing, effort, U, discount=0.5, stopping_cost=lambda x: 1.5 + 0.2 * x[0]), PLANE
    ),
    "a game on three axes": lambda: (
        hjb.Problem(chase, lambda x, u, d: 1.0, U, disturbances=hjb.Box([-0.3], [0.3]), discount=0.3,
                    target=lambda x: jnp.hypot(x[0], x[1]) - 0.9),
        hjb.Grid([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi], (15, 14, 16), periodic=(False, False, True)),
    ),
    "noise": lambda: (hjb.Problem(swing, effort, U, noise=0.2, discount=0.5), ANGLE),
    "noise that calms": lambda: (hjb.Problem(swing, effort, U, noise=2.0, discount=0.5), ANGLE),
    "correlated noise": lambda: (
        hjb.Problem(swing, effort, U, noise=np.array([[0.5, 0.0], [0.2, 0.4]]), discount=0.5), PLANE
    ),
    "a ball of controls": lambda: (
        hjb.Problem(lambda x, u: u, lambda x, u: x @ x + 0.2 * u @ u + 0.1, hjb.Ball(1.0, 2), discount=0.3), PLANE
    ),
    "a line": lambda: (
        hjb.Problem(lambda x, u: u, lambda x, u: x @ x + 0.1 * u @ u, hjb.Finite([[-1.0], [0.0], [1.0]]), discount=1.0),
        hjb.Grid([-1.0], [1.0], (42,)),
    ),
}  # fmt: skip
FEW = ("a target between nodes", "a ring of few nodes")


@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
@pytest.mark.parametrize(
    "name", [name if name in FEW else pytest.param(name, marks=pytest.mark.slow) for name in PROBLEMS]
)
def test_an_answer_does_not_know_of_the_room_around_it(name, monkeypatch):
    tol = 1e-7
    problem, grid = PROBLEMS[name]()
    shared = hjb.solve(problem, grid, tol=tol)
    assert nested.room(grid, hjb.PolicyIteration(hjb.Sweeps()))
    monkeypatch.setattr(nested, "room", lambda grid, method: None)
    own = hjb.solve(problem, grid, tol=tol)
    assert (shared.status, shared.steps) == (own.status, own.steps)
    np.testing.assert_allclose(shared.value, own.value, rtol=0, atol=tol / 100)
    np.testing.assert_allclose(shared.policy, own.policy, rtol=0, atol=1e-8)
    # that of the coarser grid, where sweeps begin elsewhere: both ways are off by the tolerance
    np.testing.assert_allclose(shared.grid_error, own.grid_error, rtol=0, atol=100 * tol)


def test_the_coarser_grid_takes_no_program_of_its_own():
    problem, grid = PROBLEMS["a target between nodes"]()
    with compiling() as programs:
        assert hjb.solve(problem, hjb.Grid(grid.lo, grid.hi, (43, 39))).grid_error is not None
    assert programs.count("jit(run)") == 1


@pytest.mark.parametrize(
    ("grid", "shape"),
    [
        (ANGLE, (72, 40)),
        (PLANE, (34, 47)),
        (hjb.Grid([0.0, -1.0, -np.pi], [1.0, 2.0, np.pi], (7, 8, 9), periodic=(False, False, True)), (13, 8, 18)),
    ],
)
def test_what_a_node_reads_of_others_and_what_is_found_of_all(grid, shape):
    """In larger arrays, and in those of the grid."""
    with jax.enable_x64(True):
        padding = Padding(np.array(grid.shape, np.int32), shape, grid.periodic)
        value = np.random.default_rng(0).normal(size=grid.shape)
        spread = padding.spread((value, value > 0), (True, True))
        read, found = jax.jit(read_of_others)(grid.divided(padding), *spread)
        known, wanted = jax.jit(read_of_others)(grid, value, value > 0)
    here = padding.gathered(read, jax.tree.map(lambda _: True, read))
    for name, arrays in known.items():
        for mine, theirs in zip(jax.tree.leaves(here[name]), jax.tree.leaves(arrays), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-13, atol=1e-13, err_msg=name)
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize(
    ("whole", "shape", "periodic", "fits"),
    [
        ((5, 6), (9, 11), (False, False), True),
        ((5, 6), (10, 11), (True, False), True),
        ((5, 6), (9, 11), (True, False), False),  # no whole number of turns
        ((10, 6), (9, 11), (False, False), False),
    ],
)
def test_which_grids_have_room_in_which_arrays(whole, shape, periodic, fits):
    assert Padding.fits(whole, shape, periodic) is fits


def test_a_cut_solve_returns_nodes_and_no_fillers():
    """Its value is that of a coarser grid, or of the finer one, and never of the arrays around it."""
    problem, grid = PROBLEMS["periodic"]()
    for most in range(1, 6):
        cut = hjb.solve(problem, grid, max_steps=most, throw=False)
        assert cut.value.shape == cut.policy.shape[:-1] == grid.shape
        assert np.all(np.isfinite(cut.value))


def test_a_checkpoint_of_a_coarser_grid_goes_on_in_larger_arrays(tmp_path):
    problem, grid = PROBLEMS["undiscounted, at rest"]()
    whole = hjb.solve(problem, grid)
    file = tmp_path / "kept"
    hjb.solve(problem, grid, checkpoint=hjb.Checkpoint(file, every=1e-9), max_steps=5, throw=False)
    resumed = hjb.solve(problem, grid, checkpoint=file, resume=True)
    np.testing.assert_array_equal(resumed.value, whole.value)
    np.testing.assert_array_equal(resumed.grid_error, whole.grid_error)


def test_patience_is_that_of_the_grid_and_not_of_the_arrays():
    problem, grid = PROBLEMS["periodic"]()
    method = hjb.PolicyIteration(hjb.Sweeps())
    with jax.enable_x64(True):
        on = Discretisation(problem, grid, hjb.Upwind(), np.dtype(float), room=(72, 50))
        task = prepare_on_host(on, method=method, tol=1e-3)[0]
        run = RunInParts(task, np.zeros(grid.shape), 10, on.padding)
    assert run.task.grid.shape == (72, 50)
    assert run.task.grid.parts.patience == method.patience(grid)
