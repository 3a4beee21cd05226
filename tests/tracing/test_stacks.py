"""Long vectors, which stay one array over the nodes: against vmap; small ones go on by components."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from component_functions import by_components, by_vmap, steep

from hjbjax import Grid
from hjbjax.tracing import components, stacks
from hjbjax.tracing.operations import Operations, operations

GRID = Grid([-1.0, -1.1, -0.9], [1.0, 1.2, 1.3], (3, 4, 2))
RNG = np.random.default_rng(1)
WIDE, SQUARE = RNG.normal(size=(32, 3)) / 2, RNG.normal(size=(32, 32)) / 6
CUBE = RNG.normal(size=(5, 4, 3))


def hidden(x, p):
    """A vector of 32 entries of a state and a parameter."""
    return jnp.tanh(p * WIDE.astype(x.dtype) @ x + 0.1)


LONG = {
    "network": lambda x, p: WIDE.T.astype(x.dtype) @ jnp.tanh(SQUARE.astype(x.dtype) @ hidden(x, p) + p),
    "row times matrix": lambda x, p: hidden(x, p) @ SQUARE.astype(x.dtype),
    "matrix of the state": lambda x, p: jnp.outer(hidden(x, p), x).T @ hidden(x, p),
    "form of a vector": lambda x, p: hidden(x, p) @ SQUARE.astype(x.dtype) @ hidden(x, p),
    "sum of products": lambda x, p: jnp.sum(p * SQUARE.astype(x.dtype) * hidden(x, p), axis=-1),
    "sum of products with the state": lambda x, p: jnp.sum(p * WIDE.astype(x.dtype) * x, axis=-1),
    "einsum to the left": lambda x, p: jnp.einsum("i,kji->jk", p * x, CUBE.astype(x.dtype)),
    "einsum to the right": lambda x, p: jnp.einsum("kji,i->kj", p * CUBE.astype(x.dtype), x),
    "rows of matrices": lambda x, p: jnp.einsum("aij,abj->bia", CUBE.astype(x.dtype), p * jnp.ones((5, 20, 3)) * x),
    "activations": lambda x, p: jax.nn.softmax(jax.nn.relu(hidden(x, p)) + jax.nn.silu(hidden(x, p))),
    "normalised": lambda x, p: (hidden(x, p) - jnp.mean(hidden(x, p))) / jnp.linalg.norm(hidden(x, p)),
    "where": lambda x, p: jnp.where(hidden(x, p) > 0.1, hidden(x, p), jnp.where(x[0] > 0, p, x[1])),
    "moved": lambda x, p: jnp.concatenate([hidden(x, p)[::-1], p * x]).reshape(5, 7).T[1:].at[2, 3].set(x[0]),
    "parts": lambda x, p: hidden(x, p)[:20] * hidden(x, p)[np.arange(20)] + hidden(x, p)[4],
    "cumulative": lambda x, p: jnp.cumsum(hidden(x, p)) + jnp.maximum(hidden(x, p), x[0]).max(),
    "radial basis": lambda x, p: p * jnp.exp(-jnp.sum((x - WIDE.astype(x.dtype)) ** 2, axis=-1)) @ WIDE.astype(x.dtype),
    "own derivative": lambda x, p: steep(hidden(x, p))[:18],
    "cond": lambda x, p: jax.lax.cond(x[0] > 0, lambda h: p * h, jnp.sin, hidden(x, p)),
    "known branch": lambda x, p: jax.lax.switch(1, [jnp.sin, lambda h: p * h], hidden(x, p)),
    "jacobian": lambda x, p: jax.jacfwd(lambda y: SQUARE.astype(x.dtype) @ hidden(y, p))(x),
    "gradient": lambda x, p: jax.grad(lambda y: jnp.sum(jnp.tanh(SQUARE.astype(x.dtype) @ hidden(y, p))))(x),
    "of a parameter alone": lambda x, p: x * jnp.sum(jnp.tanh(SQUARE.astype(x.dtype) @ (p * jnp.ones(32, x.dtype)))),
}


@pytest.mark.parametrize("name", LONG)
def test_long_vectors_are_what_vmap_gives_with_their_derivatives(name):
    weights = RNG.normal(size=97)

    @jax.jit
    @jax.jacfwd
    def slopes(p):
        return tuple(jnp.sum(jnp.resize(weights, r.shape) * r) for r in results(p))

    @jax.jit
    def results(p):
        return tuple(way(lambda x: LONG[name](x, p), GRID, "float64") for way in (by_components, by_vmap))

    with jax.enable_x64(True):
        got, expected = results(0.7)
        assert got.shape == expected.shape
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-13)
        got, expected = slopes(0.7)
        assert expected != 0
        np.testing.assert_allclose(got, expected, rtol=1e-10)


def test_float32_stays_float32_and_vmap_over_a_parameter_is_one_program():
    def values(p, way):
        return way(lambda x: LONG["network"](x, p), GRID, "float32")

    p = np.array([0.7, -0.2], np.float32)
    got = jax.jit(jax.vmap(lambda p: values(p, by_components)))(p)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, np.stack([values(q, by_vmap) for q in p]), rtol=3e-6, atol=1e-6)


def test_reverse_mode_reaches_every_weight():
    def loss(matrix, way):
        return jnp.sum(way(lambda x: jnp.tanh(matrix @ hidden(x, 0.7))[:2] * x[0], GRID, "float64") ** 2)

    with jax.enable_x64(True):
        got, expected = (jax.jit(jax.grad(loss), static_argnums=1)(SQUARE, way) for way in (by_components, by_vmap))
    np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-14)


def equations(function):
    """The primitives that a function of a state becomes, in order."""

    def at_nodes(*x):
        return [jnp.asarray(entry) for entry in components.components(function, list(x), dtype="float64").flat]

    return [eqn.primitive.name for eqn in jax.make_jaxpr(at_nodes)(*GRID.components("float64")).jaxpr.eqns]


def test_a_layer_is_one_product_and_one_operation_on_all_its_entries():
    with jax.enable_x64(True):
        names = equations(lambda x: LONG["network"](x, 1.0))
    assert names.count("dot_general") == 3
    assert names.count("tanh") == 2
    assert len(names) < 40


@pytest.mark.parametrize("n", [2, 3, 7])
def test_small_products_are_still_sums_of_products(n):
    matrix = RNG.normal(size=(n, n))
    with jax.enable_x64(True):
        names = equations(lambda x: jnp.sin(matrix @ jnp.resize(x, n)) @ matrix)
    assert "dot_general" not in names
    assert names.count("mul") == 2 * n * n
    assert names.count("sin") == n


def test_a_row_that_is_repeated_is_stacked_once():
    row = [jnp.arange(3.0), jnp.float32(2.0)]
    value = stacks.object_array([*row, *row, *row], (3, 2))
    stack = stacks.stacked(value, "float32")
    assert stack.nodes == (3,)
    np.testing.assert_array_equal(stack.array, np.tile(np.stack([np.arange(3.0), np.full(3, 2.0)]), (3, 1, 1)))
    assert [[entry.tolist() for entry in each] for each in stack.entries()] == [[[0, 1, 2], [2, 2, 2]]] * 3


COUNTED = {
    "arithmetic": (lambda x: 2 * x + jnp.sin(x[0]), Operations(3 + 1 + 3)),
    "product": (lambda x: CUBE[0, :3] @ x, Operations(2 * 9)),
    "constants": (lambda x: jnp.sum(jnp.sin(SQUARE)) * x[1], Operations(1)),
    "loop": (lambda x: jax.lax.fori_loop(0, 900, lambda _, y: jnp.sin(y), x), Operations(1)),
    "written out": (lambda x: sum(jnp.sin(k * x[0]) for k in range(40)), Operations(40 + 40 + 40)),
    "layer": (lambda x: jnp.tanh(WIDE @ x)[:3] * x, Operations(3, whole=3)),
}


@pytest.mark.parametrize("name", COUNTED)
def test_operations_are_counted_before_anything_is_evaluated(name):
    function, expected = COUNTED[name]
    with jax.enable_x64(True):
        assert operations(jax.make_jaxpr(function)(jax.ShapeDtypeStruct((3,), "float64"))) == expected
