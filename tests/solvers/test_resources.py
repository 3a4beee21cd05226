"""What a solve will take, beside what it took."""

import math

import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.solvers import memory, resources


def test_bytes_alone_cost_nothing_whatever_the_size():
    problem, grid = zoo.manipulator(links=2, shape=(700,) * 4)
    found = hjb.estimate(problem, grid, measure=False)
    assert found.bytes == memory.peak_bytes(
        problem, grid, hjb.PolicyIteration(hjb.Sweeps()), np.float64, high_order=True
    )
    assert not found.fits
    assert math.prod(found.shape) == 700**4
    assert found.free < found.bytes
    # the largest grid that fits takes what is free
    smaller = zoo.manipulator(links=2, shape=(found.largest,) * 4)[1]
    assert hjb.estimate(problem, smaller, measure=False).bytes == pytest.approx(found.free, rel=0.1)
    assert str(found).endswith("steps     not known: nothing was measured")
    assert "IT DOES NOT FIT" in str(found)
    assert "IT DOES NOT FIT" not in str(hjb.estimate(problem, zoo.manipulator(links=2)[1], measure=False))
    half = hjb.estimate(problem, grid, dtype="float32", measure=False)
    assert 0.45 < half.bytes / found.bytes < 0.7  # sweeps keep two arrays in single precision in any case


def test_more_nodes_than_can_be_numbered_do_not_fit(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda mesh=None: 10**15)
    problem, grid = zoo.pendulum(shape=(50_000, 50_001))
    found = hjb.estimate(problem, grid, measure=False)
    assert not found.fits
    assert found.largest == 46_340  # 46341² > 2³¹


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")
@pytest.mark.parametrize(
    ("name", "shape"), [("pendulum", (400, 401)), ("double-integrator", (301, 301)), ("stochastic-lq", (2001,))]
)
def test_steps_and_seconds_are_about_what_they_are(name, shape):
    problem, grid = zoo.catalogue[name].build(shape=shape)
    found = hjb.estimate(problem, grid)
    solution = hjb.solve(problem, grid)
    assert 1 / 4 <= found.steps / solution.steps <= 4
    assert len(solution.stats["levels"]) <= found.programs
    # on a machine with other work, too, and of small solves where a call counts
    assert 1 / 10 <= (found.seconds + 0.02) / (solution.stats["seconds"] + 0.02) <= 10
    assert found.compile_seconds > 0.1


def test_a_question_that_small_grids_do_not_pose_is_said():
    # the target holds one node, which no coarser grid has
    problem = hjb.Problem(
        lambda x, u: u, lambda x, u: 1.0, hjb.Box([-1.0], [1.0]), target=lambda x: abs(x[0] - 0.501) - 1e-3
    )
    found = hjb.estimate(problem, hjb.Grid([-1.0], [1.0], (2001,)))
    assert found.steps is found.seconds is None
    assert "no node lies in the target" in found.note.replace("\n", " ") or "target" in found.note


@pytest.mark.parametrize(
    ("grid", "nodes", "shape"),
    [
        (hjb.Grid([-1.0] * 2, [1.0] * 2, (401, 401)), 10_000, (101, 101)),
        (hjb.Grid([-1.0] * 2, [1.0] * 2, (400, 401), periodic=(True, False)), 10_000, (100, 101)),
        (hjb.Grid([-1.0], [1.0], (10,)), 2, (6,)),
        (hjb.Grid([-1.0], [1.0], (3,)), 1, (3,)),
    ],
)
def test_small_grids_keep_a_node_in_the_middle(grid, nodes, shape):
    assert resources._smaller(grid, nodes).shape == shape


def test_arguments_are_those_of_a_solve():
    problem, grid = zoo.pendulum(shape=(20, 21))
    with pytest.raises(ValueError, match="tol"):
        hjb.estimate(problem, grid, tol=-1)
    with pytest.raises(TypeError, match="method"):
        hjb.estimate(problem, grid, hjb.PolicyIteration)
    with pytest.raises(ValueError, match="dtype"):
        hjb.estimate(problem, grid, dtype="float16")


def test_paths_are_told_by_the_count_of_their_arcs():
    problem, grid = zoo.pendulum(discount=0.5, shape=(20, 21))
    found = hjb.estimate(problem, grid, scheme=hjb.SemiLagrangian(), measure=False)
    solution = hjb.solve(problem, grid, scheme=hjb.SemiLagrangian(), tol=1e-2)
    assert found.bytes == solution.stats["bytes"]
    assert found.programs == 1
    with pytest.raises(ValueError, match="SemiLagrangian"):
        hjb.estimate(zoo.stochastic_lq(shape=(21,))[0], zoo.stochastic_lq(shape=(21,))[1], scheme=hjb.SemiLagrangian())
