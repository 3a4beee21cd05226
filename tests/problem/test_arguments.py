"""What no argument may be, said once and by the argument's name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.problem import arguments, words

NO_NUMBERS = [0, 0.0, -1, -1e-300, float("nan"), float("inf"), True, np.True_, None, "1", [1.0], np.ones(1), 10**400]
NO_COUNTS = [0, -1, 2.0, float("nan"), float("inf"), True, np.True_, None, "7", [3], np.float64(3)]
POSITIVE = {
    "Krylov: fraction": lambda value: hjb.Krylov(fraction=value),
    "Implicit: tol": lambda value: hjb.Implicit(tol=value),
    "Explicit: fraction": lambda value: hjb.Explicit(fraction=value),
}
COUNTS = {
    "Sweeps: count": lambda value: hjb.Sweeps(value),
    "Krylov: max_steps": lambda value: hjb.Krylov(max_steps=value),
    "PolicyIteration: replies": lambda value: hjb.PolicyIteration(replies=value),
    "Nested: coarsest": lambda value: hjb.Nested(coarsest=value),
    "Implicit: max_steps": lambda value: hjb.Implicit(max_steps=value),
}


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for name in POSITIVE for value in NO_NUMBERS if name != "Implicit: tol" or value is not None],
    ids=lambda each: repr(each)[:24],
)
def test_numbers_inside_methods(name, value):
    with pytest.raises(ValueError, match=f"{name} = .*; wanted a .*number > 0") as caught:
        POSITIVE[name](value)
    assert repr(value)[:20] in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("value", NO_COUNTS, ids=repr)
@pytest.mark.parametrize("name", COUNTS)
def test_counts_inside_methods(name, value):
    with pytest.raises(ValueError, match=f"{name} = .*; wanted a positive integer") as caught:
        COUNTS[name](value)
    assert repr(value) in str(caught.value)


@pytest.mark.parametrize("value", [1.0 + 1e-9, 2])
def test_fractions_end_at_one(value):
    for name in ("Krylov: fraction", "Explicit: fraction"):
        with pytest.raises(ValueError, match=f"{name} = {value}; wanted a number > 0 and at most 1"):
            POSITIVE[name](value)


@pytest.mark.parametrize("stages", [0, 5, True, 1.5, "2"])
def test_stages(stages):
    with pytest.raises(ValueError, match="stages = .*, wanted 1, 2, 3, 4, a Tableau or None"):
        hjb.Explicit(stages)


@pytest.mark.parametrize("value", [1, 1.0, np.float32(1), np.int64(1), np.array(1.0), jnp.float32(1)], ids=repr)
def test_every_kind_of_number_will_do(value):
    for make in POSITIVE.values():
        make(value)
    arguments.positive(value, "x")
    if isinstance(value, (int, np.integer)):
        for make in COUNTS.values():
            make(value)


def test_tracers_pass():
    assert jax.jit(lambda tol: hjb.Implicit(tol=tol).tol + hjb.Krylov(fraction=tol).fraction)(0.5) == 1.0


@pytest.mark.parametrize("evaluation", ["x", hjb.Sweeps, hjb.Upwind(), hjb.PolicyIteration()], ids=repr)
def test_evaluations_are_named(evaluation):
    wanted = r"wanted hjb.Sweeps\(...\), hjb.Krylov\(...\) or hjb.Direct\(\)"
    with pytest.raises(TypeError, match="PolicyIteration: evaluation is .*; " + wanted):
        hjb.PolicyIteration(evaluation)
    with pytest.raises(TypeError, match="Implicit: evaluation is .*; " + wanted):
        hjb.Implicit(evaluation)


@pytest.mark.parametrize("inner", [hjb.Nested(), hjb.Sweeps(), None, "x", hjb.PolicyIteration], ids=repr)
def test_what_is_nested(inner):
    with pytest.raises(TypeError, match="Nested: inner is .*; wanted hjb.PolicyIteration"):
        hjb.Nested(inner)


def test_an_endless_limit_is_one():
    arguments.positive(float("inf"), "time_limit", endless=True)
    for value in (float("nan"), -float("inf"), True, "inf"):
        with pytest.raises(ValueError, match="time_limit"):
            arguments.positive(value, "time_limit", endless=True)


def test_long_values_are_cut():
    assert len(words.shown(list(range(10**4)))) <= words.SHOWN
    assert words.shown("two\nlines") == "'two\\nlines'"
    assert "\n" not in words.shown(np.eye(9))
