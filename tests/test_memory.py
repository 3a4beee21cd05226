"""The estimate before a solve, what is free, and the largest grid that fits."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax import driver, iteration, memory
from hjbjax.preparation import judge, prepare
from hjbjax.pytree import cast

METHODS = [
    hjb.ValueIteration(),
    hjb.PolicyIteration(hjb.Sweeps()),
    hjb.PolicyIteration(hjb.Krylov()),
]


def drift(x, u):
    return jnp.stack([x[1], u[0]])


def cost(x, u):
    return x @ x + u @ u


PROBLEM = hjb.Problem(drift, cost, hjb.Box([-1.0], [1.0]), noise=0.3, discount=1.0)


def square(n):
    return hjb.Grid([-1.0, -1.0], [1.0, 1.0], (n, n))


@pytest.mark.parametrize("method", METHODS)
def test_the_estimate_is_proportional_to_nodes_and_word(method):
    one = memory.estimate(PROBLEM, square(10), method, np.float64)
    assert isinstance(one, int)
    assert memory.estimate(PROBLEM, square(20), method, np.float64) == 4 * one
    assert one / 2 <= memory.estimate(PROBLEM, square(10), method, np.float32) < one
    assert memory.estimate(PROBLEM, square(100_000_000), method, np.float64) == 10**14 * one  # Python integers


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("noise", [None, 0.3])
@pytest.mark.parametrize("n", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_the_estimate_is_what_the_compiled_loop_needs(n, noise, method):
    """By XLA's own account of the program that a solve runs."""
    problem = hjb.Problem(
        lambda x, u: jnp.concatenate([x[1:], u]), cost, hjb.Box([-1.0], [1.0]), noise=noise, discount=1.0
    )
    grid = hjb.Grid([-1.0] * n, [1.0] * n, ({2: 121, 3: 41}[n],) * n)
    with jax.enable_x64(True):
        problem, grid = cast((problem, grid), np.float64)
        verdict = judge(problem, grid, np.float64)
        options = {"method": method, "scheme": hjb.Upwind(), "tol": 1e-3, "dtype": np.float64, "verdict": verdict}
        task = jax.eval_shape(lambda p, g: prepare(p, g, **options), problem, grid)
        state = jax.eval_shape(iteration.begin, task, jax.ShapeDtypeStruct(grid.shape, np.float64))
        found = driver.run.lower(task, state, 1).compile().memory_analysis()
    together = found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes
    ratio = memory.estimate(problem, grid, method, np.float64) / (together - found.alias_size_in_bytes)
    assert 0.95 <= ratio <= 1.4


def test_policies_and_evaluations_take_memory():
    value, sweeps, krylov = (memory.estimate(PROBLEM, square(10), method, np.float64) for method in METHODS)
    assert max(value, sweeps) < krylov
    game = hjb.Problem(
        lambda x, u, d: drift(x, u) + d,
        lambda x, u, d: cost(x, u) - d @ d,
        hjb.Box([-1.0], [1.0]),
        disturbances=hjb.Box([-1.0, -1.0], [1.0, 1.0]),
        discount=1.0,
    )
    assert memory.estimate(game, square(10), METHODS[0], np.float64) > value


@pytest.mark.parametrize("method", METHODS)
def test_the_largest_grid_that_is_named_fits_and_the_next_does_not(method):
    limit = 10**9
    with pytest.raises(MemoryError, match=r"max_memory") as caught:
        memory.require(PROBLEM, square(20_000), method, np.float64, limit)
    largest = int(re.search(r"N = (\d+)", str(caught.value))[1])
    assert memory.require(PROBLEM, square(largest), method, np.float64, limit) <= limit
    with pytest.raises(MemoryError):
        memory.require(PROBLEM, square(largest + 1), method, np.float64, limit)


@pytest.mark.parametrize("ndim", [1, 2, 3, 5])
def test_the_largest_indexable_grid_that_is_named_is_indexable(ndim):
    lo, hi = [-1.0] * ndim, [1.0] * ndim
    with pytest.raises(MemoryError, match="32-bit") as caught:
        memory.require(PROBLEM, hjb.Grid(lo, hi, (2**31,) * ndim), METHODS[0], np.float64, 10**30)
    largest = int(re.search(r"N = (\d+)", str(caught.value))[1])
    assert largest**ndim < memory.INDEXABLE <= (largest + 1) ** ndim
    memory.require(PROBLEM, hjb.Grid(lo, hi, (largest,) * ndim), METHODS[0], np.float64, 10**30)


def test_what_is_free_is_known_here():
    free = memory.available()
    assert isinstance(free, int)
    assert free > 10**6


def test_nobody_says_what_is_free(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: None)
    needed = memory.estimate(PROBLEM, square(30_000), METHODS[0], np.float64)
    assert memory.require(PROBLEM, square(30_000), METHODS[0], np.float64, None) == needed


@pytest.mark.parametrize("method", [*METHODS[:2], pytest.param(METHODS[2], marks=pytest.mark.slow)])
def test_the_estimate_is_near_what_the_compiler_reports(method):
    """Between half and four times the peak of the compiled step."""
    import jax

    from hjbjax import iteration, preparation

    grid = square(64)
    with jax.enable_x64(True):
        task, _, _ = preparation.prepare_on_host(
            PROBLEM, grid, method=method, scheme=hjb.Upwind(), tol=1e-3, dtype=np.dtype(np.float64)
        )
        state = jax.eval_shape(iteration.begin, task, jnp.zeros(grid.shape))
        analysis = jax.jit(iteration.run).lower(task, state, 1).compile().memory_analysis()
    peak = analysis.argument_size_in_bytes + analysis.output_size_in_bytes + analysis.temp_size_in_bytes
    estimate = memory.estimate(PROBLEM, grid, method, np.float64)
    assert peak / 4 <= estimate <= 4 * peak
    assert estimate >= peak / 2
