"""An index beyond its array is refused where it can be known, and nothing else is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import U, drift, refused

import hjbjax as hjb
from hjbjax import zoo
from hjbjax.discretisation.posing import with_mode_axis
from hjbjax.tracing import checks, indices

ALONG = hjb.Grid([-1.0, -1.0], [1.0, 1.0], (5, 5))
TABLE = np.array([1.0, 2.0, 3.0])
X = jax.ShapeDtypeStruct((2,), np.float64)

BEYOND = {
    "x[2]": (lambda x, u: jnp.stack([x[2], u[0]]), "entry 2 of x, whose shape is (2,); there are 0 to 1"),
    "x[-3]": (lambda x, u: jnp.stack([x[-3], u[0]]), "entry -3 (from the end) of x"),
    "u[7]": (lambda x, u: jnp.stack([x[1], u[7]]), "entry 7 of u, whose shape is (1,); there are 0 to 0"),
    "at set": (lambda x, u: x.at[5].set(u[0]), "entry 5 of x"),
    "at add": (lambda x, u: x.at[-3].add(u[0]), "entry -3 (from the end) of x"),
    "list": (lambda x, u: x[jnp.array([1, 2])] + u, "entry 2 of x"),
    "numpy": (lambda x, u: x[np.array([0, -4])] + u, "entry -4 (from the end) of x"),
    "take": (lambda x, u: jnp.take(x, jnp.array([0, 3]), mode="clip") + u, "entry 3 of x"),
    "dynamic": (lambda x, u: jax.lax.dynamic_slice(x, (1,), (2,)) + u, "entries 1 to 2 of x"),
    "update": (lambda x, u: jax.lax.dynamic_update_slice(x, u, (2,)), "entry 2 of x"),
    "jit": (lambda x, u: jax.jit(lambda x: jnp.stack([x[3], x[0]]))(x) + u, "entry 3 of x"),
    "branch": (lambda x, u: jax.lax.cond(x[0] > 0, lambda: x + x[4], lambda: x) + u, "entry 4 of"),
    "vmap": (lambda x, u: jax.vmap(lambda i: x[i])(jnp.arange(3))[:2] + u, "entry 2 of x"),
    "loop": (lambda x, u: jax.lax.fori_loop(0, 3, lambda i, s: s + x[i], 0.0) + x + u, "entry 2 of x"),
    "scan": (lambda x, u: jax.lax.scan(lambda s, i: (s + x[i], s), 0.0, jnp.arange(4))[0] + x + u, "entry 2 of x"),
    "matrix": (lambda x, u: jnp.outer(x, x)[2, 0] + x + u, "entry 2 of an array of shape (2, 2) along axis 0"),
    "table": (lambda x, u: x + u + jnp.asarray(TABLE)[3], "entry 3 of an array of shape (3,)"),
}
WITHIN = {
    "last": lambda x: x[-1] + x[-2] + x[1],
    "slices": lambda x: x[1:5].sum() + x[-7:].sum(),  # as NumPy has them
    "at": lambda x: x.at[1].set(2.0).at[-1].add(1.0).at[0].multiply(3.0)[0],
    "table": lambda x: jnp.asarray(TABLE)[jnp.floor(x[0]).astype(int)],
    "interp": lambda x: jnp.interp(x[0], TABLE, TABLE),
    "loop": lambda x: jax.lax.fori_loop(0, 2, lambda i, s: s + x[i], 0.0),
    "backwards": lambda x: jax.lax.scan(lambda s, i: (s + x[i], s), 0.0, jnp.arange(2), reverse=True)[0],
    # after the 64 turns that are followed the counter is 37, which is not its last value
    "long loop": lambda x: x[jax.lax.fori_loop(0, 100, lambda k, i: i - 1, 101)],
    "sorted": lambda x: jnp.sort(x)[1] + jnp.argmax(x),
    "solve": lambda x: jnp.linalg.solve(jnp.outer(x, x) + jnp.eye(2), x)[1],
    "roll": lambda x: jnp.roll(x, 3)[0] + jnp.diff(x)[0] + jnp.diag(x)[1, 1] + jnp.cross(jnp.append(x, 1.0), TABLE)[2],
    "stand-in": lambda x: x.at[jnp.array([0, 7])].get(mode="fill", fill_value=2.0).sum(),
    "where": lambda x: x[jnp.where(x[0] > 0, 1, 0)],
    "while": lambda x: jax.lax.while_loop(lambda c: c[0] < 2, lambda c: (c[0] + 1, c[1] + x[c[0]]), (0, 0.0))[1],
}


@pytest.mark.parametrize("name", BEYOND)
def test_beyond(name):
    function, words = BEYOND[name]
    message = refused("shapes", r"^drift\(x, u\) reads ", drift=function)
    assert words in message


@pytest.mark.parametrize("name", WITHIN)
def test_within(name):
    with jax.enable_x64(True):
        assert indices.first_outside(jax.make_jaxpr(WITHIN[name])(X), ("x",)) is None


@pytest.mark.parametrize("name", ["cost", "target", "stopping_cost", "running_max", "noise"])
def test_every_ingredient(name):
    def function(x, *rest):
        return x[2] - 0.5

    refused("shapes", rf"^{name}\(x.* reads entry 2 of x, whose shape is \(2,\)", **{name: function})


def test_every_player_and_the_time():
    question = {"drift": lambda t, x, u, d: drift(x, u) + d[1], "time_dependent": True}
    refused("shapes", "entry 1 of d, whose shape is \\(1,\\)", disturbances=hjb.Box([-1.0], [1.0]), **question)


def test_every_front_door():
    wrong = hjb.Problem(BEYOND["x[2]"][0], lambda x, u: x @ x, U, discount=1.0)
    doors = {
        "solve": lambda: hjb.solve(wrong, ALONG, scheme=hjb.Upwind()),
        "march": lambda: hjb.march(wrong, ALONG, 1.0, scheme=hjb.Upwind(split=True)),
        "solve_batch": lambda: hjb.solve_batch([wrong], ALONG, scheme=hjb.Upwind()),
        "pontryagin": lambda: hjb.pontryagin(wrong, [1.0, 0.0], horizon=1.0),
        "jit": lambda: jax.jit(
            lambda k: hjb.solve(hjb.Problem(wrong.drift, None, U, discount=k), ALONG, scheme=hjb.Upwind()).value
        )(1.0),
        "chain": lambda: hjb.chain.generator(wrong, ALONG, np.zeros((5, 5, 1))),
    }
    for door in doors.values():
        with pytest.raises(ValueError, match="reads entry 2 of"):
            door()


@pytest.mark.parametrize("name", list(zoo.catalogue))
def test_the_zoo_stays_within(name):
    with_mode_axis()(checks.shapes)(*zoo.catalogue[name].build(), hjb.Upwind())
