"""Dataclasses that JAX looks through: round trips, host fields, no validation on the way back."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hjbjax import Ball, Box, Finite, Grid, Problem
from hjbjax.problem.pytree import (
    REMEMBERED,
    altered,
    as_one_program,
    as_partial,
    cast,
    is_traced,
    numbers,
    pytree_dataclass,
    remembered,
    tie,
)


@pytree_dataclass(static=("kind",), host=("history", "note"))
class Record:
    """Leaves, a static field and two host fields."""

    value: object
    scale: object = 1.0
    kind: str = "plain"
    history: list = dataclasses.field(default_factory=list)
    note: str = "none"

    def __post_init__(self):
        if not np.isfinite(self.scale):
            raise ValueError("scale")


@pytree_dataclass()
class Spring:
    """A system whose parameters are leaves."""

    stiffness: object
    mass: object = 1.0

    def drift(self, x, u):
        return jnp.stack([x[1], (u[0] - self.stiffness * x[0]) / self.mass])

    def __call__(self, x):
        return self.stiffness * x


def drift(x, u):
    return jnp.stack([x[1], u[0]])


NODES = [
    Record(np.ones(2), 3.0, "other"),
    Box([-1.0], [1.0]),
    Ball(2.0, 3),
    Finite([[1.0], [2.0]]),
    Grid([0.0], [1.0], (3,), periodic=(True,), names=("angle",)),
    Problem(drift, lambda x, u: x @ x, Box([-1.0], [1.0]), discount=0.5, noise=[0.1, 0.2], isaacs="lower"),
]


@pytest.mark.parametrize("thing", NODES, ids=lambda thing: type(thing).__name__)
def test_round_trip(thing):
    leaves, tree = jax.tree.flatten(thing)
    back = jax.tree.unflatten(tree, leaves)
    assert type(back) is type(thing)
    assert jax.tree.structure(back) == tree == jax.tree.structure(jax.tree.map(lambda leaf: 2 * leaf, thing))
    assert all(new is old for new, old in zip(jax.tree.leaves(back), leaves, strict=True))
    assert [path[0].name for path, _ in jax.tree_util.tree_leaves_with_path(thing)]  # every leaf has a name


@pytest.mark.parametrize("leaf", [None, object(), "text", float("nan"), -1])
@pytest.mark.parametrize("thing", NODES, ids=lambda thing: type(thing).__name__)
def test_rebuilding_validates_nothing(thing, leaf):
    leaves, tree = jax.tree.flatten(thing)
    back = jax.tree.unflatten(tree, [leaf] * len(leaves))
    rest = jax.tree.leaves(back, is_leaf=lambda each: each is None)
    assert type(back) is type(thing)
    assert sum(each is leaf for each in rest) >= len(leaves)


def test_a_constructor_validates():
    with pytest.raises(ValueError, match="scale"):
        Record(0.0, float("nan"))


def test_host_fields_are_dropped_and_come_back_as_their_defaults():
    record = Record(1.0, history=[1, 2], note="mine")
    back, again = (jax.tree.map(lambda leaf: leaf, record) for _ in range(2))
    assert (back.history, back.note) == ([], "none")
    assert back.history is not again.history
    assert (record.history, record.note) == ([1, 2], "mine")


def test_nodes_are_frozen_and_compared_by_identity():
    with pytest.raises(dataclasses.FrozenInstanceError):
        NODES[1].lo = 0.0
    assert Box([0.0], [1.0]) != Box([0.0], [1.0])  # arrays have no single truth value
    assert dataclasses.replace(NODES[1], hi=[5.0]).hi.tolist() == [5.0]


def test_static_fields_recompile_and_leaves_do_not():
    traces = []

    @jax.jit
    def double(record):
        traces.append(record.kind)
        return jax.tree.map(lambda leaf: 2 * leaf, record)

    assert double(Record(1.0)).value == 2.0
    assert double(Record(5.0, scale=4.0)).scale == 8.0
    assert double(Record(5.0, kind="other")).kind == "other"
    assert traces == ["plain", "other"]


def test_a_decorator_refuses_fields_that_are_not_there_and_host_fields_without_default():
    with pytest.raises(TypeError, match="has no field shap"):

        @pytree_dataclass(static=("shap",))
        class Typo:
            shape: tuple

    with pytest.raises(TypeError, match="note: a host field .* needs a default"):

        @pytree_dataclass(host=("note",))
        class NoDefault:
            note: str


def test_a_bound_method_brings_the_fields_along_as_leaves():
    held = as_partial(Spring(3.0, 2.0).drift)
    assert jax.tree.leaves(held) == [3.0, 2.0]
    assert held(jnp.ones(2), jnp.ones(1)).tolist() == [1.0, -1.0]
    traces = []

    @jax.jit
    def rate(function):
        traces.append(function)
        return function(jnp.ones(2), jnp.zeros(1))[1]

    assert [float(rate(as_partial(Spring(k).drift))) for k in (1.0, 2.0, 3.0)] == [-1.0, -2.0, -3.0]
    assert len(traces) == 1
    assert jax.grad(lambda k: as_partial(Spring(k).drift)(jnp.ones(2), jnp.zeros(1))[1])(3.0) == -1.0


def test_a_callable_node_brings_its_fields_along_too():
    held = as_partial(Spring(3.0, 2.0))
    assert jax.tree.leaves(held) == [3.0, 2.0]
    assert held(4.0) == 12.0


def test_other_callables_are_held_as_they_are():
    assert as_partial(None) is None
    assert jax.tree.leaves(as_partial(drift)) == []
    held = as_partial(drift)
    assert as_partial(held) is held
    assert as_partial("x".join)(["a", "b"]) == "axb"  # a bound method of something that is no pytree


def test_what_is_no_function_is_named():
    with pytest.raises(TypeError, match=r"Problem\.cost: got 3\.0, wanted a function"):
        as_partial(3.0, "Problem.cost")


def test_is_traced():
    seen = []
    jax.jit(lambda x: seen.append((is_traced(x), is_traced({"a": [x, 1.0]}), is_traced(1.0, None, drift))))(1.0)
    assert seen == [(True, True, False)]
    assert not is_traced(np.ones(2), jnp.ones(2))


def test_cast_changes_floating_leaves_alone():
    with jax.enable_x64(True):
        tree = cast(
            {"f": 1.0, "a": np.ones(2), "i": 3, "b": True, "n": np.arange(2), "h": jnp.ones(1, "bfloat16")}, "float32"
        )
    assert tree["f"].dtype == tree["a"].dtype == tree["h"].dtype == np.float32
    assert type(tree["i"]) is int
    assert type(tree["b"]) is bool
    assert tree["n"].dtype == np.arange(2).dtype


@pytest.mark.parametrize(
    "value", ["1", "a", ["1.0"], 1j, [1j], [[1.0], [1.0, 2.0]], {}, object(), drift, np.datetime64("2020")]
)
def test_numbers_refuses_what_is_none(value):
    with pytest.raises(TypeError, match="mass: got .* wanted numbers"):
        numbers(value, "mass")


def test_numbers_refuses_an_integer_beyond_floating_point():
    with pytest.raises(ValueError, match=r"mass: got 10+, wanted numbers that fit into float64") as caught:
        numbers(10**400, "mass")
    assert len(str(caught.value)) < 150


def test_numbers_takes_any_nesting_of_numbers_and_tracers():
    assert numbers([True, 2, np.float32(0.5)], "mass").tolist() == [1.0, 2.0, 0.5]
    nested = jax.jit(lambda x: numbers([[x, 0.0], [0.0, 1.0]], "mass"))
    assert nested(3.0).tolist() == [[3.0, 0.0], [0.0, 1.0]]


# --- answers by structure, copies without checks ---


def test_an_answer_is_remembered():
    asked = []

    @remembered
    def shape(tree, unit="m", *, scale=1):
        asked.append(tree)
        return f"{jnp.shape(tree.value)} {unit} {scale}"

    assert shape(Record(np.zeros(2))) == shape(Record(np.zeros(2))) == "(2,) m 1"
    assert len(asked) == 1
    shape(Record(np.ones(2)))  # a number may decide: a power, an index, a branch
    shape(Record(np.zeros(2), kind="other"))
    shape(Record(np.zeros(2, np.float32)))
    assert shape(Record(np.zeros(2)), "s") == "(2,) s 1"
    assert shape(Record(np.zeros(2)), scale=2) == "(2,) m 2"
    assert len(asked) == 6
    with pytest.raises(AttributeError):
        shape(1.0)
    for count in range(REMEMBERED):
        shape(Record(np.zeros(2)), str(count))
    assert shape(Record(np.zeros(2))) == "(2,) m 1"
    assert len(asked) == 8 + REMEMBERED  # with the one that failed: the oldest answer is forgotten


def test_while_traced_nothing_is_remembered():
    asked = []

    @remembered
    def twice(tree):
        asked.append(tree)
        return 2 * tree.value

    doubled = jax.jit(lambda x: twice(Record(x)) + twice(Record(x)))
    assert doubled(1.0) == 4.0
    assert len(asked) == 2


def test_one_program_for_all_numbers_that_are_traced_and_each_that_is_known():
    traces = []

    @as_one_program
    def scaled(record, power, unused=None):
        traces.append(power)
        return Record(power * record.value, scale=record.scale, kind=record.kind), unused

    def ask(x, scale, power):
        result, nothing = scaled(Record(x, scale=scale, kind="other"), power)
        assert nothing is None
        assert result.kind == "other"
        # what was known and comes back is known still
        assert isinstance(result.scale, np.ndarray)
        return result.value * float(result.scale[0])

    for x in (2.0, 3.0):
        assert jax.grad(ask)(x, np.array([5.0]), 2) == 10
        assert jax.vmap(ask, (0, None, None))(jnp.array([x]), np.array([5.0]), 2) == 10 * x
    assert traces == [2, 2]  # of numbers, and of lanes of them
    jax.grad(ask)(2.0, np.array([6.0]), 2)
    jax.grad(ask)(2.0, np.array([5.0]), 3)
    assert traces == [2, 2, 2, 3]
    with jax.checking_leaks():
        assert jax.grad(lambda x: ask(x, np.array([7.0]), 2))(2.0) == 14


def test_a_copy_may_hold_what_the_checks_refuse():
    problem = Problem(lambda x, u: x, running_max=lambda x: x[0])
    changed = altered(problem, discount=1.0)
    assert (changed.discount, problem.discount) == (1.0, 0.0)
    assert changed.drift is problem.drift
    with pytest.raises(ValueError, match="running_max"):
        dataclasses.replace(problem, discount=1.0)


def test_altered_copies_compute_cached_properties_again():
    @pytree_dataclass()
    class Square:
        side: float

        @functools.cached_property
        def area(self):
            return self.side**2

    one = Square(2.0)
    assert (one.area, altered(one, side=3.0).area, one.area) == (4.0, 9.0, 4.0)


def test_a_tied_tree_has_both_derivatives_where_only_one_leaf_moves():
    """A rule of ``custom_jvp`` receives an array of zeros for the leaf that does not move."""

    @jax.custom_jvp
    def product(at):
        return at[0] * at[1]

    @product.defjvp
    def rule(primals, tangents):
        return product(*primals), jax.jvp(lambda at: (lambda x, y: jnp.sin(x) * y)(*tie(at)), primals, tangents)[1]

    for derivative in (jax.grad, jax.jacfwd):
        for form in (derivative, lambda f, d=derivative: jax.jit(d(f))):
            assert form(lambda x: product((x, 2.0)))(0.0) == 2.0
