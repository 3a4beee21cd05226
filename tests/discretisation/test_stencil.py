"""Neighbours, differences and sparse layouts against loops over the nodes."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hjbjax.discretisation import stencil
from hjbjax.problem.grid import Grid
from hjbjax.problem.stretching import Sinh

pytestmark = pytest.mark.usefixtures("float64")
GRIDS = [
    Grid([0.0], [1.0], (5,)),
    Grid([0.0], [1.0], (4,), (True,)),
    Grid([0.0, -1.0], [1.0, 2.0], (4, 3), (False, True)),
    Grid([0.0, -1.0], [1.0, 2.0], (2, 2), (True, False)),
    Grid([0.0, -1.0, 0.0], [1.0, 2.0, 0.5], (3, 4, 2), (True, False, True)),
    Grid([0.0] * 4, [1.0] * 4, (2, 3, 2, 3), (False, False, True, True)),
]
ids = [f"{grid.shape}{grid.periodic}" for grid in GRIDS]


def reached(grid, index, offset):
    """The index of x + offset, or None beyond an edge; and the index with each axis clipped at its edge."""
    moved = [i + step for i, step in zip(index, offset, strict=True)]
    wrapped = [i % n if p else i for i, n, p in zip(moved, grid.shape, grid.periodic, strict=True)]
    clipped = tuple(min(max(i, 0), n - 1) for i, n in zip(wrapped, grid.shape, strict=True))
    return (clipped if list(clipped) == wrapped else None), clipped


@pytest.mark.parametrize("grid", GRIDS, ids=ids)
def test_neighbours(grid):
    values = np.random.default_rng(0).normal(size=grid.shape)
    offsets = list(itertools.product((-1, 0, 1), repeat=grid.ndim))

    @jax.jit
    def neighbours(values):
        return [[stencil.neighbour(values, grid, each, ghost=ghost) for ghost in (True, False)] for each in offsets]

    for offset, pair in zip(offsets, neighbours(jnp.asarray(values)), strict=True):
        ghost, bare = map(np.asarray, pair)
        for index in np.ndindex(*grid.shape):
            end, clipped = reached(grid, index, offset)
            assert ghost[index] == values[clipped]
            assert bare[index] == (0 if end is None else values[end])


@pytest.mark.parametrize("grid", GRIDS, ids=ids)
def test_edges_and_differences(grid):
    values = np.random.default_rng(1).normal(size=grid.shape)
    for axis in range(grid.ndim):
        h = grid.spacing(axis)
        link = stencil.grid_links(grid, axis)
        assert (link.up, link.down, link.meets_up, link.meets_down) == (h, h, None, None)
        up, down = map(np.asarray, stencil.one_sided(jnp.asarray(values), grid, axis))
        for index in np.ndindex(*grid.shape):
            above, below = (reached(grid, index, stencil.unit(grid, axis, step))[1] for step in (1, -1))
            assert np.isclose(up[index], (values[above] - values[index]) / h, rtol=1e-14)
            assert np.isclose(down[index], (values[index] - values[below]) / h, rtol=1e-14)
        for step in (1, -1):
            mask = np.broadcast_to(stencil.on_edge(grid, axis, step), grid.shape)
            for index in np.ndindex(*grid.shape):
                assert mask[index] == (reached(grid, index, stencil.unit(grid, axis, step))[0] is None)


def test_units_are_one_step_along_one_axis():
    assert stencil.unit(GRIDS[4], 1, -1) == (0, -1, 0)


@pytest.mark.parametrize("grid", GRIDS, ids=ids)
def test_sparse_equals_dense_loops(grid):
    rng = np.random.default_rng(2)
    offsets = [offset for offset in itertools.product((-1, 0, 1), repeat=grid.ndim) if any(offset)]
    number, dense = np.arange(grid.size).reshape(grid.shape), np.zeros((grid.size, grid.size))
    diagonal, values = rng.normal(size=grid.shape), []
    for offset in offsets:
        entries = rng.normal(size=grid.shape) * rng.choice([0, 1], grid.shape)
        for index in np.ndindex(*grid.shape):
            end = reached(grid, index, offset)[0]
            if end is None:
                entries[index] = 0
            else:
                dense[number[index], number[end]] += entries[index]
        values.append(entries)
    dense += np.diag(diagonal.ravel())
    matrix = stencil.sparse(offsets, values, diagonal, grid)
    assert matrix.format == "csr"
    assert np.allclose(matrix.toarray(), dense, rtol=1e-14, atol=1e-14)


def test_sparse_stores_what_is_not_zero():
    grid = Grid([0.0], [1.0], (4,))
    entries = np.array([1.0, 0.0, 2.0, 0.0])
    matrix = stencil.sparse([(1,)], [entries], np.ones(4), grid)
    assert matrix.nnz == 6


def test_differences_on_a_stretched_axis_divide_by_their_own_distance():
    grid = Grid([0.0, 0.0], [1.0, 2.0], (3, 6), stretch=(None, Sinh(2.0, 0.5)))
    x = np.asarray(grid.axis(1))
    values = np.random.default_rng(5).normal(size=grid.shape)
    up, down = map(np.asarray, stencil.one_sided(jnp.asarray(values), grid, 1))
    slopes = np.diff(values, axis=1) / np.diff(x)
    assert np.ptp(np.diff(x)) > 0.01
    assert np.allclose(up, np.pad(slopes, ((0, 0), (0, 1))), rtol=1e-13)
    assert np.allclose(down, np.pad(slopes, ((0, 0), (1, 0))), rtol=1e-13)
