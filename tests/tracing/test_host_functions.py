"""Functions of a problem that call NumPy through ``jax.pure_callback``: doubles arrive and come back as doubles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.problem.settings import own_settings
from hjbjax.tracing import host_functions

U = hjb.Box([-1.0], [1.0])
GRID = hjb.Grid([-1.0], [1.0], (9,))
AT = np.array([1 / 3, 0.7])


def on_host(x):
    assert x.dtype == np.float64
    return np.sin(np.asarray(x))


def sine(x):
    return jax.pure_callback(on_host, jax.ShapeDtypeStruct(x.shape, x.dtype), x, vmap_method="expand_dims")


FORMS = {
    "plain": sine,
    "jit": jax.jit(sine),
    "remat": jax.checkpoint(sine),
    "cond": lambda x: jax.lax.cond(x[0] > 2, lambda y: y, sine, x),
    "scan": lambda x: jax.lax.scan(lambda y, _: (sine(y), None), x, None, length=1)[0],
    "while": lambda x: jax.lax.while_loop(lambda pair: pair[1] < 1, lambda pair: (sine(pair[0]), pair[1] + 1), (x, 0))[
        0
    ],
    "vmap": lambda x: jax.vmap(sine)(x[:, None])[:, 0],
    "constant": lambda x: x * 0 + sine(jnp.asarray(AT)),
}


@pytest.mark.parametrize("form", FORMS)
def test_doubles_are_not_rounded_on_their_way(form):
    with own_settings(x64=True):
        closed = jax.make_jaxpr(FORMS[form])(AT)
        called = jax.jit(lambda x: host_functions.evaluate_with_host_calls(closed.jaxpr, closed.consts, x)[0])
        np.testing.assert_array_equal(called(AT), np.sin(AT))


@pytest.mark.filterwarnings("ignore:the primitive 'pure_callback'")
@pytest.mark.slow
def test_a_solve_and_a_path_with_a_drift_in_numpy():
    called, known = (
        hjb.Problem(lambda x, u, f=f: u - f(x), lambda x, u: x @ x + u @ u, U, discount=1.0) for f in (sine, jnp.sin)
    )
    values = [hjb.solve(each, GRID, scheme=hjb.Upwind(), tol=1e-9).value for each in (called, known)]
    np.testing.assert_allclose(*values, atol=1e-12)
    paths = [hjb.simulate(each, lambda x: -x, [0.5], 0.2, steps=4).states for each in (called, known)]
    np.testing.assert_allclose(*paths, atol=1e-12)


def test_results_of_another_type_are_refused():
    def rounded(x):
        return np.asarray(x, np.float32)

    def function(x):
        return jax.pure_callback(rounded, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    with own_settings(x64=True):
        closed = jax.make_jaxpr(function)(AT)
        with pytest.raises(Exception, match="returned float32 numbers, wanted float64"):
            jax.block_until_ready(host_functions.evaluate_with_host_calls(closed.jaxpr, closed.consts, jnp.asarray(AT)))
