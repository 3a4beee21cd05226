"""Sweeps, Krylov and direct solves of δ = s + Σ_o w_o δ(x + o) against dense linear algebra."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from systems import SEEDS

from hjbjax import relaxation, stencil
from hjbjax.bellman import Correction
from hjbjax.chain import Rates
from hjbjax.grid import Grid
from hjbjax.relaxation import Direct, Krylov, Sweeps

SHAPES = {1: (9,), 2: (6, 5), 3: (4, 3, 5), 4: (3, 4, 2, 3)}
LAYOUTS = [(n, flags) for n in (1, 2) for flags in itertools.product((False, True), repeat=n)]
LAYOUTS += [(3, (False,) * 3), (3, (False, True, False)), (3, (False, False, True)), (3, (True, True, False))]
LAYOUTS += [(4, (False,) * 4), (4, (True, False, True, False)), (4, (False, True, True, True))]
ids = ["".join("p" if flag else "-" for flag in flags) for _, flags in LAYOUTS]


@pytest.fixture(autouse=True, scope="module")
def _float64():
    with jax.enable_x64(True):
        yield


def make_grid(n, flags, shape=None):
    return Grid([0.0] * n, [1.0] * n, shape or SHAPES[n], flags)


def random_equation(rng, grid, leak=0.1, diagonal=False):
    """Substochastic weights with a leak, some nodes held (no weights), and the dense matrix I − W."""
    offsets = [stencil.unit(grid, axis, step) for axis in range(grid.ndim) for step in (1, -1)]
    if diagonal:
        offsets += [(1, 1), (-1, -1)]
    weights = [rng.uniform(0, 1, grid.shape) * rng.choice([0.0, 1.0], grid.shape) for _ in offsets]
    for offset, w in zip(offsets, weights, strict=True):
        for axis, step in enumerate(offset):
            if step:
                w[np.broadcast_to(stencil.on_edge(grid, axis, step), grid.shape)] = 0
    total = sum(weights)
    scale = np.where(rng.random(grid.shape) < 0.1, 0, (1 - leak) / np.where(total > 0, total, 1))
    weights = [w * scale for w in weights]
    source = rng.normal(size=grid.shape)
    dense = stencil.sparse(offsets, [-w for w in weights], np.ones(grid.shape), grid).toarray()
    equation = Correction(jnp.asarray(source), Rates(tuple(offsets), tuple(map(jnp.asarray, weights))))
    return equation, dense, np.linalg.solve(dense, source.ravel()).reshape(grid.shape)


@functools.partial(jax.jit, static_argnames="rounds")
def sweeps(equation, grid, rounds):
    return relaxation.gauss_seidel(equation, grid, rounds)


@pytest.mark.parametrize(("n", "flags"), LAYOUTS, ids=ids)
@given(seed=SEEDS)
@settings(max_examples=4)
def test_rounds_of_sweeps_converge_to_the_dense_solve(n, flags, seed):
    rng, grid = np.random.default_rng(seed), make_grid(n, flags)
    equation, dense, exact = random_equation(rng, grid)
    delta = sweeps(equation, grid, 150)  # a pass takes away a tenth, a round is two passes at least: 0.9³⁰⁰ = 2e-14
    assert np.allclose(delta, exact, rtol=0, atol=1e-11 * np.max(np.abs(exact)))
    guess = rng.normal(size=grid.size)
    left = (np.ravel(equation.source) - dense @ guess).reshape(grid.shape)
    found = relaxation.left_over(equation, grid, jnp.asarray(guess.reshape(grid.shape)))
    assert np.allclose(found, left, rtol=0, atol=1e-13 * np.max(np.abs(left)))


def one_round(dense, source, grid, signs):
    """Forward and backward through the folded hyperplanes by a loop: newest values, but old ones across the fold."""
    number = np.arange(grid.size).reshape(grid.shape)
    plane = sum(s * i for s, i in zip((1, *signs), np.indices(grid.shape), strict=True)) % grid.shape[0]
    order, plane = np.argsort(plane.ravel(), kind="stable"), plane.ravel()
    delta = np.zeros(number.size)
    for pass_ in (order, order[::-1]):
        old = delta.copy()
        for here in pass_:
            known = np.where(np.abs(plane - plane[here]) <= 1, delta, old)
            delta[here] += source.ravel()[here] - dense[here] @ np.where(np.arange(delta.size) == here, delta, known)
    return delta.reshape(grid.shape)


@functools.partial(jax.jit, static_argnames="signs")
def _wavefront(equation, grid, signs):
    return relaxation._wavefront(equation.source, equation.weights, grid, signs)


@pytest.mark.parametrize("shape", [(9,), (6, 5), (4, 7), (4, 3, 5), (3, 4, 2, 3)])
@pytest.mark.parametrize("periodic", [False, True])
@given(seed=SEEDS)
@settings(max_examples=2)
def test_the_wavefront_equals_a_loop_over_the_nodes(shape, periodic, seed):
    """Every order of the sweep; only the first axis may be periodic, the seams of the others are cut."""
    n = len(shape)
    rng, grid = np.random.default_rng(seed), make_grid(n, (periodic,) + (False,) * (n - 1), shape)
    equation, dense, _ = random_equation(rng, grid)
    for signs in itertools.product((1, -1), repeat=n - 1):
        expected = one_round(dense, np.asarray(equation.source), grid, signs)
        assert np.allclose(_wavefront(equation, grid, signs), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("n", "flags"), LAYOUTS, ids=ids)
def test_shears_undo_each_other(n, flags):
    values = jnp.asarray(np.random.default_rng(0).normal(size=SHAPES[n]))
    for signs in itertools.product((1, -1), repeat=n - 1):
        sheared = relaxation._shear(values, signs)
        for index in np.ndindex(*values.shape):
            plane = (index[0] + sum(s * i for s, i in zip(signs, index[1:], strict=True))) % values.shape[0]
            assert sheared[(plane, *index[1:])] == values[index]
        assert jnp.array_equal(relaxation._shear(sheared, tuple(-s for s in signs)), values)


@functools.partial(jax.jit, static_argnames="method_type")
def solved(equation, grid, method_type):
    method = {"krylov": Krylov(fraction=1e-12), "direct": Direct(), "sweeps": Sweeps(3)}[method_type]
    return relaxation.solve(method, equation, grid)


@pytest.mark.parametrize(
    ("n", "flags"),
    [(1, (True,)), (2, (False, True)), pytest.param(4, (False, True, False, True), marks=pytest.mark.slow)],
)
@given(seed=SEEDS)
@settings(max_examples=4)
def test_krylov_and_direct_equal_the_dense_solve(n, flags, seed):
    rng, grid = np.random.default_rng(seed), make_grid(n, flags)
    equation, _, exact = random_equation(rng, grid, leak=0.01)
    size = np.max(np.abs(exact))
    assert np.allclose(solved(equation, grid, "direct"), exact, rtol=0, atol=1e-12 * size)
    assert np.allclose(solved(equation, grid, "krylov"), exact, rtol=0, atol=1e-9 * size)


@given(seed=SEEDS)
@settings(max_examples=4)
def test_diagonal_jumps_are_relaxed_and_solved(seed):
    rng, grid = np.random.default_rng(seed), make_grid(2, (True, False))
    equation, dense, exact = random_equation(rng, grid, diagonal=True)
    size = np.max(np.abs(exact))
    assert np.allclose(solved(equation, grid, "direct"), exact, rtol=0, atol=1e-12 * size)
    assert np.allclose(solved(equation, grid, "krylov"), exact, rtol=0, atol=1e-9 * size)
    assert np.array_equal(sweeps(equation, grid, 2), _jacobi(equation, grid, 32))
    delta = np.zeros(grid.size)
    for _ in range(32):
        delta += 0.5 * (np.ravel(equation.source) - dense @ delta)
    assert np.allclose(np.ravel(_jacobi(equation, grid, 32)), delta, rtol=0, atol=1e-12 * size)
    assert np.allclose(_jacobi(equation, grid, 2000), exact, rtol=0, atol=1e-11 * size)


@functools.partial(jax.jit, static_argnames="count")
def _jacobi(equation, grid, count):
    return relaxation.jacobi(equation, grid, count)


def test_sweeps_run_in_single_precision_and_return_the_type_they_got():
    grid = make_grid(2, (False, False))
    equation, _, _ = random_equation(np.random.default_rng(0), grid)
    delta = solved(equation, grid, "sweeps")
    assert delta.dtype == np.float64
    assert np.array_equal(delta, delta.astype(np.float32))
    assert np.allclose(delta, sweeps(equation, grid, 3), rtol=0, atol=1e-5)


@pytest.mark.parametrize("method", ["krylov", "direct"])
def test_an_equation_without_a_solution_is_relaxed(method):
    """Two nodes that feed each other for ever: I − W is singular, and the answer stays finite."""
    grid = make_grid(1, (False,), (2,))
    ones = jnp.ones(2)
    weights = Rates(((1,), (-1,)), (jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])))
    assert np.all(np.isfinite(solved(Correction(ones, weights), grid, method)))


def test_single_precision_goes_through_the_direct_solve():
    grid = make_grid(2, (True, False))
    equation, _, exact = random_equation(np.random.default_rng(4), grid)
    single = jax.tree.map(lambda leaf: leaf.astype(np.float32), equation)
    delta = solved(single, grid, "direct")
    assert delta.dtype == np.float32
    assert np.allclose(delta, exact, rtol=0, atol=1e-5 * np.max(np.abs(exact)))


def test_a_batch_is_solved_lane_by_lane():
    grid = make_grid(1, (False,))
    lanes = [random_equation(np.random.default_rng(seed), grid) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(equation for equation, _, _ in lanes))
    for method in ("direct", "krylov"):
        found = jax.vmap(lambda equation, method=method: solved(equation, grid, method))(stacked)
        assert np.allclose(found, np.stack([exact for *_, exact in lanes]), rtol=0, atol=1e-9)
