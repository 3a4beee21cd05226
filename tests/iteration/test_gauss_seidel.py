"""The wavefront against a loop over the nodes, and what its shears do."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xla
from equations import LAYOUTS, SHAPES, ids, make_grid, random_equation
from hypothesis import given, settings
from systems import SEEDS

from hjbjax.iteration import gauss_seidel

pytestmark = pytest.mark.usefixtures("float64")


def passes(count, rounds, slab=None):
    """The slices in the order in which they are swept, a list for every time that seams are looked across."""
    if slab is None:
        return [range(count), range(count)[::-1]] * rounds
    slabs = [range(first, min(first + slab, count)) for first in range(0, count, slab)]
    sweeps_each = max(2 * rounds - 1, 3)
    upwards = [d for part in slabs for k in range(sweeps_each) for d in part[:: 1 - 2 * (k % 2)]]
    downwards = [d for part in slabs[::-1] for k in range(sweeps_each) for d in part[:: 2 * (k % 2) - 1]]
    return [upwards, downwards]


def by_a_loop(dense, source, grid, rounds, slab=None):
    """Every order by hyperplanes: newest values, but across seams beyond the first axis those before the pass."""
    number, indices = np.arange(grid.size), np.indices(grid.shape)
    delta = np.zeros(grid.size)
    for index in range(2 ** (grid.ndim - 1)):
        flips = [False, *((index >> axis) & 1 for axis in range(grid.ndim - 1))]
        along = [n - 1 - i if flip else i for i, n, flip in zip(indices, grid.shape, flips, strict=True)]
        plane = np.ravel(sum(along) % grid.shape[0])
        for slices in passes(grid.shape[0], rounds, slab):
            old = delta.copy()
            for here in itertools.chain.from_iterable(np.flatnonzero(plane == d) for d in slices):
                next_to = np.ones(grid.size, bool)
                for axis in range(1, grid.ndim):
                    apart = np.abs(indices[axis].ravel() - indices[axis].ravel()[here])
                    next_to &= (apart < grid.shape[axis] - 1) | (not grid.periodic[axis])
                known = np.where(next_to, delta, old)
                delta[here] += source[here] - dense[here] @ np.where(number == here, delta, known)
    return delta.reshape(grid.shape)


@functools.partial(jax.jit, static_argnames="rounds")
def sweeps(equation, grid, rounds):
    return gauss_seidel.sweep(equation, grid, rounds)


@pytest.mark.parametrize(
    "shape", [(9,), (6, 5), (4, 7), (3, 14), (4, 3, 5), pytest.param((3, 4, 3, 3), marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("periodic", ["", "0", "1", "02", "123"])
@given(seed=SEEDS)
@settings(max_examples=2)
def test_equals_a_loop_over_the_nodes(shape, periodic, seed):
    flags = tuple(str(axis) in periodic for axis in range(len(shape)))
    rng, grid = np.random.default_rng(seed), make_grid(len(shape), flags, shape)
    equation, dense, _ = random_equation(rng, grid)
    expected = by_a_loop(dense, np.ravel(equation.source), grid, 2)
    assert np.allclose(sweeps(equation, grid, 2), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("shape", "periodic", "rounds"), [((7, 5), "", 1), ((8, 4), "01", 3), ((5, 3, 4), "2", 2)])
def test_slabs_equal_a_loop_over_the_nodes(shape, periodic, rounds, monkeypatch):
    monkeypatch.setattr(gauss_seidel, "SLAB", 2)
    flags = tuple(str(axis) in periodic for axis in range(len(shape)))
    grid = make_grid(len(shape), flags, shape)
    equation, dense, _ = random_equation(np.random.default_rng(0), grid)
    monkeypatch.setattr(gauss_seidel, "CACHE", 8 * grid.size * (2 + 2 * grid.ndim) - 1)  # less than all takes
    found = jax.jit(lambda equation: gauss_seidel.sweep(equation, grid, rounds))(equation)
    in_slabs, in_turns = (by_a_loop(dense, np.ravel(equation.source), grid, rounds, slab) for slab in (2, None))
    assert np.allclose(found, in_slabs, rtol=0, atol=1e-12)
    assert not np.allclose(found, in_turns, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "cache", [pytest.param(gauss_seidel.CACHE, marks=pytest.mark.slow), 2**11]
)  # the second is less than all takes, and a slab fits
def test_one_signed_weight_does_for_two_of_which_one_is_zero(cache, monkeypatch):
    grid = make_grid(3, (True, False, True))
    monkeypatch.setattr(gauss_seidel, "SLAB", 1)
    monkeypatch.setattr(gauss_seidel, "CACHE", cache)
    # the new emitters of fusions round the two alike, to the last bit
    sweep = jax.jit(lambda equation: gauss_seidel.sweep(equation, grid, 2), compiler_options=xla.with_emitters())
    for seed in range(8):
        rng = np.random.default_rng(seed)
        equation, _, _ = random_equation(rng, grid)
        values = list(equation.weights.values)
        for axis in range(grid.ndim):
            up = rng.random(grid.shape) < 0.5
            values[2 * axis : 2 * axis + 2] = jnp.where(up, values[2 * axis], 0), jnp.where(up, 0, values[2 * axis + 1])
        two = dataclasses.replace(equation, weights=dataclasses.replace(equation.weights, values=tuple(values)))
        one = dataclasses.replace(two, weights=dataclasses.replace(two.weights, one_way=True))
        assert jnp.array_equal(sweep(one), sweep(two))


@pytest.mark.parametrize(("n", "flags"), LAYOUTS, ids=ids)
def test_a_shear_puts_hyperplanes_into_slices_and_can_be_undone(n, flags):
    values = np.random.default_rng(0).normal(size=SHAPES[n])
    arrays = gauss_seidel._arrays_of(make_grid(n, flags))
    shear, undo = (
        jax.jit(lambda values, flips, function=function: function(values, flips, arrays))
        for function in (gauss_seidel._sheared, gauss_seidel._from_planes)
    )
    for flips in itertools.product((0, 1), repeat=n - 1):
        sheared = np.asarray(shear(values, list(flips)))
        flipped = np.flip(values, [axis + 1 for axis, flip in enumerate(flips) if flip])
        for index in np.ndindex(*values.shape):
            assert sheared[(sum(index) % values.shape[0], *index[1:])] == flipped[index]
        padded = np.pad(sheared, arrays.margins, constant_values=np.nan)
        assert np.array_equal(undo(padded, list(flips)), values)
