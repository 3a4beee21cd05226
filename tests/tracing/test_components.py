"""Functions of one state on a grid, by components: against vmap over the table of all states."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from component_functions import by_components, by_vmap, steep
from hypothesis import given
from hypothesis import strategies as st

from hjbjax import Grid
from hjbjax.tracing import components, interpreter

RISE = np.arange(16.0).reshape(4, 4) / 7
TABLE = np.linspace(-1.5, 1.5, 9)
GRID = Grid([-1.0, -1.1, -0.9, -1.3], [1.0, 1.2, 1.3, 1.4], (3, 4, 2, 5))


@jax.custom_vjp
def steeper(x):
    return jnp.sin(x)


steeper.defvjp(lambda x: (steeper(x), x), lambda x, g: (3 * jnp.cos(x) * g,))


def energy(x, p):
    return 0.5 * p * jnp.sum(x**2) * jnp.cos(x[0] - x[1])


# One state of four entries and a parameter p; what users write.
COMPONENTS = {
    "stack": lambda x, p: jnp.stack([x[1], p * jnp.sin(x[0])]),
    "array": lambda x, p: jnp.array([[x[1], -p * x[0]], [0.0, 1]]),
    "slices": lambda x, p: p * x[1:] - x[:-1] + x[::-1][:3] + x[::2][1],
    "negative index": lambda x, p: p * x[-1] * x[-2],
    "unpacking": lambda x, p: (lambda a, b, c, d: jnp.stack([p * a * b, c / (2 + d)]))(*x),
    "fancy index": lambda x, p: p * x[jnp.array([1, 0, 1])] + x[np.array([0, 2, -1])],
    "mask": lambda x, p: p * x[np.array([True, False, True, False])],
    "take": lambda x, p: p * jnp.take(x, jnp.array([0, 3])) + x.at[jnp.array([1, 7])].get(mode="fill", fill_value=2.0),
    "set": lambda x, p: x.at[1].set(p * x[0] ** 2).at[2:].set(3.0),
    "add": lambda x, p: x.at[1].add(p * x[0]).at[jnp.array([2, 2, 0])].add(x[:3]),
    "multiply": lambda x, p: x.at[1:3].multiply(p).at[0].min(0.1).at[3].max(x[0]),
    "matmul": lambda x, p: jnp.asarray(RISE, x.dtype) @ x + (p * jnp.eye(4, dtype=x.dtype)) @ x,
    "numpy matmul": lambda x, p: p * (RISE.astype(x.dtype) @ x),
    "quadratic form": lambda x, p: x @ (p * jnp.asarray(RISE, x.dtype)) @ x + jnp.vdot(x, x),
    "einsum": lambda x, p: jnp.einsum("i,ij,k->jk", x, p * jnp.asarray(RISE, x.dtype), x),
    "batched": lambda x, p: jnp.einsum("bi,bi->b", jnp.outer(x, x), p + jnp.outer(x, x)),
    "norm": lambda x, p: jnp.linalg.norm(x - 3 * p) + jnp.linalg.norm(x, 1) + jnp.linalg.norm(x, jnp.inf),
    "where": lambda x, p: jnp.where(x > 0, p * x, -2 * x) + jnp.where(x[0] > 0, x, jnp.zeros(4, x.dtype)),
    "clip": lambda x, p: jnp.clip(p * x, -0.5, 0.5) + jnp.maximum(x, p),
    "join": lambda x, p: jnp.concatenate([x[2:], p * x[:1]]) + jnp.roll(x, 1)[:3] + jnp.flip(x)[1:],
    "outer": lambda x, p: jnp.outer(x, p * x) + jnp.kron(x[:2], x[2:])[0] + jnp.tril(jnp.outer(x, x)),
    "cross": lambda x, p: p * jnp.cross(x[:3], x[1:]) + jnp.diagonal(jnp.outer(x, x))[:3],
    "shapes": lambda x, p: p * jnp.tile(x.reshape(2, 2).T, (1, 2)) + jnp.repeat(x[:2], 2) + jnp.pad(x[:2], 1),
    "split": lambda x, p: p * jnp.split(x, 2)[1] + jnp.stack(list(x)[::2]) + jnp.hstack([x[0], x[1]]),
    "cumulative": lambda x, p: jnp.cumsum(p * x) + jnp.cumprod(x) + jax.lax.cummax(x, reverse=True),
    "reductions": lambda x, p: (
        jnp.mean(p * x) + jnp.var(x) + jnp.prod(x) + x.max() - jnp.min(x) + jnp.trace(jnp.outer(x, x))
    ),
    "empty": lambda x, p: p * (jnp.sum(x[:0]) + jnp.prod(x[:0]) + x[:0] @ x[:0]),
    "logic": lambda x, p: p * (jnp.any(x > 0) & ~jnp.isnan(x[0])) + jnp.all(x < 1).astype(x.dtype),
    "elementary": lambda x, p: jnp.exp(p * x) + jnp.log1p(x**2) + jnp.arctan2(x[0], x) + jnp.abs(x) ** 1.5 + x**-2.0,
    "remainders": lambda x, p: jnp.mod(p * x, 1.0) + jnp.round(x) + jnp.floor(x) + jnp.sign(x) + x // 1,
    "jax.nn": lambda x, p: (
        jax.nn.relu(p * x) + jax.nn.softplus(x) + jax.nn.silu(x) + jax.nn.softmax(x) + jax.nn.gelu(x)
    ),
    "logsumexp": lambda x, p: jax.nn.logsumexp(p * x) + jnp.logaddexp(x[0], x[1]),
    "cond": lambda x, p: jax.lax.cond(x[0] > 0, lambda v: p * v, lambda v: -v, x),
    "switch": lambda x, p: jax.lax.switch(1, [lambda v: v, lambda v: p * jnp.sin(v)], x),
    "custom_jvp of a scalar": lambda x, p: steep(p * x[0]),
    "custom_jvp of a vector": lambda x, p: steep(p * x) + steep(x),
    "vmap inside": lambda x, p: jax.vmap(lambda row: jnp.sin(row @ x))(p * jnp.asarray(RISE, x.dtype)),
    "jit inside": lambda x, p: jax.jit(lambda a, q: jnp.sin(q * a) * a)(x, p),
    "checkpoint inside": lambda x, p: jax.checkpoint(lambda a: jnp.cos(p * a) @ a)(x),
    "grad inside": lambda x, p: jax.grad(energy)(x, p),
    "grad of a gather": lambda x, p: jax.grad(lambda q: energy(q[np.array([3, 1, 1])], p))(x),
    "slope of tanh": lambda x, p: jax.grad(lambda q: jnp.sum(jnp.tanh(p * q)))(x),
    "sinc": lambda x, p: jnp.sinc(p * x),
    "hessian inside": lambda x, p: jax.hessian(energy)(x, p) @ x,
    "jvp inside": lambda x, p: jax.jvp(lambda q: energy(q, p), (x,), (x[::-1],))[1],
    "integers": lambda x, p: 2 * x + 1 - p * jnp.array([1, 0, 2, 0]) + np.arange(4),
    "constant": lambda x, p: p * jnp.ones(2, x.dtype),
    "number": lambda x, p: 1.0,
}
NODEWISE = {
    "sort": lambda x, p: jnp.sort(p * x),
    "argmax": lambda x, p: p * x[jnp.argmax(x)],
    "select": lambda x, p: jnp.select([x < 0, x < 1], [-p * x, x**2], 3.0),
    "solve": lambda x, p: jnp.linalg.solve(jnp.eye(4, dtype=x.dtype) * 3 + p * jnp.outer(x, x), x),
    "interp": lambda x, p: p * jnp.interp(x[0], jnp.asarray(TABLE, x.dtype), jnp.asarray(TABLE**2, x.dtype)),
    "scan": lambda x, p: jax.lax.scan(lambda c, _: (c + 0.1 * jnp.sin(p * c), None), x, None, length=3)[0],
    "while": lambda x, p: jax.lax.while_loop(lambda c: c[0] < 1, lambda c: c + 1, x),
    "custom_vjp": lambda x, p: steeper(p * x),
}
WRITTEN = COMPONENTS | NODEWISE
DIFFERENTIATED = (  # every kind of rule, and every kind of fallback
    *("array", "fancy index", "take", "set", "add", "multiply", "matmul", "einsum", "norm", "where", "clip", "join"),
    *("cumulative", "reductions", "elementary", "jax.nn", "logsumexp", "cond", "custom_jvp of a scalar"),
    *("custom_jvp of a vector", "checkpoint inside", "grad inside", "hessian inside", "argmax", "solve", "custom_vjp"),
)


def both(function, grid, dtype):
    """Either way, as one compiled function of a parameter."""
    return jax.jit(lambda p: tuple(way(lambda x: function(x, p), grid, dtype) for way in (by_components, by_vmap)))


@pytest.fixture(autouse=True)
def fresh_warnings():
    interpreter._warn_once.cache_clear()


@pytest.mark.parametrize("dtype", [pytest.param("float32", marks=pytest.mark.slow), "float64"])
@pytest.mark.parametrize("name", COMPONENTS)
def test_components_are_what_vmap_gives_without_a_warning(name, dtype):
    tolerance = 2e-5 if dtype == "float32" else 1e-12
    with jax.enable_x64(dtype == "float64"):
        got, expected = both(lambda x, p: jnp.asarray(WRITTEN[name](x, p)), GRID, dtype)(np.asarray(0.7, dtype))
        assert got.dtype == expected.dtype
        np.testing.assert_allclose(got, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", NODEWISE)
def test_what_has_no_rule_falls_back_and_says_so_once(name):
    with jax.enable_x64(True):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            got, expected = both(WRITTEN[name], GRID, "float64")(0.7)
            again, _ = both(WRITTEN[name], GRID, "float64")(0.7)
        said = [str(warning.message) for warning in caught if warning.category is interpreter.FallbackWarning]
        assert said
        assert len(set(said)) == len(said) == len(caught)
        np.testing.assert_allclose(got, expected, rtol=1e-12)
        np.testing.assert_array_equal(got, again)


@pytest.mark.filterwarnings("ignore::hjbjax.FallbackWarning")
@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_derivatives_by_a_parameter_are_those_of_vmap(name):
    with jax.enable_x64(True):
        weights = np.random.default_rng(0).standard_normal((1000,))

        def loss(p, way):
            result = way(lambda x: WRITTEN[name](x, p), GRID, "float64")
            return jnp.sum(jnp.resize(weights, result.shape) * result)

        got, expected = (jax.jit(jax.grad(loss), static_argnums=1)(0.7, way) for way in (by_components, by_vmap))
        assert expected != 0
        np.testing.assert_allclose(got, expected, rtol=1e-10)


@pytest.mark.parametrize("function", [steep, jax.nn.relu, jax.nn.softplus])
def test_forward_mode_keeps_the_functions_own_derivative(function):
    def slope(way):
        run = jax.jit(lambda p: jax.jvp(lambda q: way(lambda x: function(q * x), GRID, "float64"), (p,), (1.0,))[1])
        return run(0.7)

    with jax.enable_x64(True):
        got, expected = slope(by_components), slope(by_vmap)
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.filterwarnings("ignore::hjbjax.FallbackWarning")
@pytest.mark.parametrize(
    "name", ["stack", "matmul", "set", "add", "cond", "custom_jvp of a vector", "grad inside", "solve"]
)
def test_components_under_vmap_over_a_parameter(name):
    with jax.enable_x64(True):
        p, way = np.array([0.7, -0.2, 1.3]), both(WRITTEN[name], GRID, "float64")
        got, _ = jax.vmap(way)(p)
        expected = np.stack([way(p)[1] for p in p])
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_every_dimension_runs_the_same_code(n):
    grid = Grid([-1.0] * n, [2.0] * n, (4, 3, 5, 2)[:n], periodic=[i % 2 == 1 for i in range(n)])

    def function(x):
        return jnp.concatenate([jnp.cumsum(jnp.sin(x)), jnp.sum(x**2)[None], jnp.linalg.norm(x[1:])[None]])

    with jax.enable_x64(True):
        got, expected = both(lambda x, p: p * function(x), grid, "float64")(1.0)
        np.testing.assert_allclose(got, expected, rtol=1e-13)


def test_an_entry_varies_along_its_own_axes_alone():
    grid = Grid([-1.0, -1.0], [1.0, 1.0], (5, 7))
    entries = components.components(
        lambda x: jnp.stack([jnp.sin(x[0]), jax.nn.softplus(x)[1], x[0] * x[1], jnp.float32(3)]),
        grid.components("float32"),
        dtype="float32",
    )
    assert [np.shape(entry) for entry in entries] == [(5, 1), (1, 7), (5, 7), ()]


def test_several_arguments_and_numbers_for_vectors():
    x = GRID.components("float32")
    entries = components.components(
        lambda t, x, u: jnp.stack([t * x[0] + u[0], u[1] * u[0]]), 2.0, x, [x[1], 3.0], dtype="float32"
    )
    np.testing.assert_allclose(entries[0], 2 * x[0] + x[1])
    np.testing.assert_allclose(entries[1], 3 * x[1])


def test_a_scalar_function_must_return_a_scalar():
    x = GRID.components("float32")
    assert components.scalar(lambda x: x[0], x, dtype="float32").shape == (3, 1, 1, 1)
    with pytest.raises(ValueError, match=r"returned shape \(4,\), expected a scalar"):
        components.scalar(lambda x: x, x, dtype="float32")


PAIR = Grid([-1.0, -1.0], [1.0, 1.0], (3, 4))


@jax.jit
def both_ways(matrix, shift, threshold):
    def function(x):
        moved = matrix @ x + shift
        chosen = jnp.where(moved > threshold, moved, x[::-1])
        return jax.lax.cond(chosen[0] < threshold, lambda v: v.at[0].add(1.0), jnp.cumsum, chosen)

    return by_components(function, PAIR, "float64"), by_vmap(function, PAIR, "float64")


NUMBERS = st.floats(-1e3, 1e3, width=32)


@given(st.lists(NUMBERS, min_size=4, max_size=4), st.lists(NUMBERS, min_size=2, max_size=2), NUMBERS)
def test_any_parameters_give_what_vmap_gives(matrix, shift, threshold):
    with jax.enable_x64(True):
        got, expected = both_ways(np.reshape(matrix, (2, 2)), np.array(shift), threshold + 1e-7)
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)
