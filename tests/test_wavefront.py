"""The wavefront against a loop over the nodes, and what its shears do."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equations import LAYOUTS, SHAPES, ids, make_grid, random_equation
from hypothesis import given, settings
from systems import SEEDS

from hjbjax import wavefront


@pytest.fixture(autouse=True, scope="module")
def _float64():
    with jax.enable_x64(True):
        yield


def by_a_loop(dense, source, grid, rounds):
    """Every order, forward and backward by hyperplanes: newest values, but across folds and seams those before."""
    number, indices = np.arange(grid.size), np.indices(grid.shape)
    delta = np.zeros(grid.size)
    for index in range(2 ** (grid.ndim - 1)):
        flips = [False, *((index >> axis) & 1 for axis in range(grid.ndim - 1))]
        along = [n - 1 - i if flip else i for i, n, flip in zip(indices, grid.shape, flips, strict=True)]
        plane = np.ravel(sum(along) % grid.shape[0])
        order = np.argsort(plane, kind="stable")
        for sweep in (order, order[::-1]) * rounds:
            old = delta.copy()
            for here in sweep:
                next_to = np.abs(plane - plane[here]) <= 1
                for axis in range(1, grid.ndim):
                    apart = np.abs(indices[axis].ravel() - indices[axis].ravel()[here])
                    next_to &= (apart < grid.shape[axis] - 1) | (not grid.periodic[axis])
                known = np.where(next_to, delta, old)
                delta[here] += source[here] - dense[here] @ np.where(number == here, delta, known)
    return delta.reshape(grid.shape)


@functools.partial(jax.jit, static_argnames="rounds")
def sweeps(equation, grid, rounds):
    return wavefront.gauss_seidel(equation, grid, rounds)


@pytest.mark.parametrize("shape", [(9,), (6, 5), (4, 7), (4, 3, 5), pytest.param((3, 4, 3, 3), marks=pytest.mark.slow)])
@pytest.mark.parametrize("periodic", ["", "0", "1", "02", "123"])
@given(seed=SEEDS)
@settings(max_examples=2)
def test_equals_a_loop_over_the_nodes(shape, periodic, seed):
    flags = tuple(str(axis) in periodic for axis in range(len(shape)))
    rng, grid = np.random.default_rng(seed), make_grid(len(shape), flags, shape)
    equation, dense, _ = random_equation(rng, grid)
    expected = by_a_loop(dense, np.ravel(equation.source), grid, 2)
    assert np.allclose(sweeps(equation, grid, 2), expected, rtol=0, atol=1e-12)


@given(seed=SEEDS)
@settings(max_examples=4)
def test_one_signed_weight_does_for_two_of_which_one_is_zero(seed):
    rng, grid = np.random.default_rng(seed), make_grid(3, (True, False, True))
    equation, _, _ = random_equation(rng, grid)
    values = list(equation.weights.values)
    for axis in range(grid.ndim):
        up = rng.random(grid.shape) < 0.5
        values[2 * axis : 2 * axis + 2] = jnp.where(up, values[2 * axis], 0), jnp.where(up, 0, values[2 * axis + 1])
    two = dataclasses.replace(equation, weights=dataclasses.replace(equation.weights, values=tuple(values)))
    one = dataclasses.replace(two, weights=dataclasses.replace(two.weights, one_way=True))
    assert jnp.array_equal(sweeps(one, grid, 2), sweeps(two, grid, 2))


@pytest.mark.parametrize(("n", "flags"), LAYOUTS, ids=ids)
def test_a_shear_puts_hyperplanes_into_slices_and_can_be_undone(n, flags):
    values = jnp.asarray(np.random.default_rng(0).normal(size=SHAPES[n]))
    for flips in itertools.product((0, 1), repeat=n - 1):
        sheared = wavefront._sheared(values, [jnp.int32(flip) for flip in flips])
        flipped = np.flip(values, [axis + 1 for axis, flip in enumerate(flips) if flip])
        for index in np.ndindex(*values.shape):
            assert sheared[(sum(index) % values.shape[0], *index[1:])] == flipped[index]
        assert jnp.array_equal(wavefront._sheared(sheared, [jnp.int32(flip) for flip in flips], back=True), values)
