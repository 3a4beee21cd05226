"""Grids that do not fit: refused in every front door before anything of their size is allocated or compiled."""

import functools
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

import hjbjax as hjb
from hjbjax.cli import main as command
from hjbjax.problem.arguments import INDEXABLE

U = hjb.Box([-1.0], [1.0])
GRIDS = [
    hjb.Grid([-1.0], [1.0], (INDEXABLE,)),
    hjb.Grid([-1.0] * 2, [1.0] * 2, (46_341, 46_342), periodic=(True, False)),
    hjb.Grid([-1.0] * 6, [1.0] * 6, (36,) * 6),
    hjb.Grid([-1.0] * 2, [1.0] * 2, (2**40, 2**40)),  # more than 2⁶³, where JAX 0.10 aborts the interpreter
]


def ahead(x, u):
    return jnp.concatenate([x[1:], u])


def effort(x, u):
    return x @ x + u @ u


def posed(discount=1.0, controls=U):
    return hjb.Problem(ahead, effort, controls, discount=discount)


def traced(door, **options):
    """A front door inside a transformation, whose shapes alone are looked at."""
    return lambda grid: jax.eval_shape(lambda beta: door(posed(beta), grid, **options).value, 1.0)


DOORS = {
    "solve": lambda grid: hjb.solve(posed(), grid, max_memory=10**40),
    "single": lambda grid: hjb.solve(posed(), grid, dtype="float32", max_memory=10**40),
    "tube": lambda grid: hjb.solve(hjb.reach(ahead, U, lambda x: x[0]), grid, max_memory=10**40),
    "paths": lambda grid: hjb.solve(posed(), grid, scheme=hjb.SemiLagrangian(), max_memory=10**40),
    "march": lambda grid: hjb.march(posed(), grid, 1.0, max_memory=10**40),
    "implicit": lambda grid: hjb.march(posed(), grid, 1.0, method=hjb.Implicit(), max_memory=10**40),
    "batch": lambda grid: hjb.solve_batch([posed(), posed()], grid, max_memory=10**40),
    "traced solve": traced(hjb.solve),
    "traced march": traced(functools.partial(hjb.march, horizon=1.0, step=0.1)),
    "generator": lambda grid: hjb.chain.generator(posed(), grid, np.zeros(1)),
    "arrays": lambda grid: hjb.chain.transition_arrays(posed(controls=hjb.Finite([[1.0]])), grid),
}


@pytest.mark.parametrize("grid", GRIDS, ids=lambda grid: f"{grid.ndim}-D")
@pytest.mark.parametrize("door", DOORS)
def test_more_nodes_than_indices_are_refused(door, grid):
    tracemalloc.start()
    try:
        with pytest.raises(MemoryError, match=r"nodes; 32-bit indices number fewer than 2,147,483,648") as caught:
            DOORS[door](grid)
        assert tracemalloc.get_traced_memory()[1] < 10**7
    finally:
        tracemalloc.stop()
    assert f"{grid.size:,}" in str(caught.value)
    assert len(str(caught.value).splitlines()) <= 6


@pytest.mark.parametrize("grid", GRIDS, ids=lambda grid: f"{grid.ndim}-D")
def test_an_estimate_says_that_they_cannot_be_numbered(grid, monkeypatch):
    monkeypatch.setattr(hjb.solvers.resources.memory, "available", lambda mesh=None: 10**40)
    found = hjb.estimate(posed(), grid, measure=False)
    assert not found.numbered
    assert not found.fits
    assert found.largest**grid.ndim < INDEXABLE <= (found.largest + 1) ** grid.ndim
    assert f"= {grid.size:,}: 32-bit indices number fewer than 2,147,483,648" in str(found)


def test_a_dry_run_of_such_a_grid_ends_with_six(tmp_path, monkeypatch):
    monkeypatch.setattr(hjb, "estimate", functools.partial(hjb.estimate, measure=False))
    monkeypatch.chdir(tmp_path)
    ended = CliRunner().invoke(command.main, ["solve", "stochastic-lq", "--shape", "2147483648", "--dry-run"])
    assert ended.exit_code == 6
    assert "32-bit indices number fewer" in ended.output
    ended = CliRunner().invoke(command.main, ["solve", "stochastic-lq", "--shape", "2147483648"])
    assert ended.exit_code == 6
    assert "32-bit indices number fewer" in ended.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("scheme", [None, hjb.Upwind(), hjb.SemiLagrangian()], ids=str)
def test_what_does_not_fit_is_refused_before_the_nodes_are_looked_at(scheme, monkeypatch):
    from hjbjax.well_posedness import node_checks

    monkeypatch.setattr(node_checks, "check_values", None)
    grid = hjb.Grid([-1.0] * 2, [1.0] * 2, (40_000, 40_001))
    with pytest.raises(MemoryError, match=r"40000 x 40001 = 1,600,040,000 nodes need about .* GB are free"):
        hjb.solve(posed(), grid, scheme=scheme, max_memory=10**9)
    with pytest.raises(MemoryError, match="need about"):
        hjb.solve_batch([posed()], grid, max_memory=10**9)
    with pytest.raises(MemoryError, match="need about"):
        hjb.march(posed(), grid, 1.0, max_memory=10**9)
