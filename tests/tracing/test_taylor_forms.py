"""Ranges of functions over boxes contain their values: every primitive, against mpmath; combinations, against JAX."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hjbjax.tracing import quadratics
from hjbjax.tracing import taylor_forms as tf
from hjbjax.tracing.intervals import Interval, quietly
from hjbjax.tracing.jaxprs import ENTRYWISE, without_repetitions

BOXES, POINTS = 10, 2
lax, mp = jax.lax, mpmath.mp
half_even = lax.RoundingMethod.TO_NEAREST_EVEN


def fmod(x, y):
    return x - y * (mpmath.floor(x / y) if x * y >= 0 else mpmath.ceil(x / y))


def to_integer(x):
    return x.astype(jnp.int32).astype(x.dtype)


# primitive: the function in JAX, the same in mpmath, and the range of its operand
ONE = {
    "abs": (lax.abs, abs, -2, 2),
    "acos": (lax.acos, mpmath.acos, -1, 1),
    "acosh": (lax.acosh, mpmath.acosh, 1, 4),
    "asin": (lax.asin, mpmath.asin, -1, 1),
    "asinh": (lax.asinh, mpmath.asinh, -3, 3),
    "atan": (lax.atan, mpmath.atan, -3, 3),
    "atanh": (lax.atanh, mpmath.atanh, -0.9, 0.9),
    "bessel_i0e": (lax.bessel_i0e, lambda x: mpmath.besseli(0, x) * mpmath.exp(-abs(x)), -3, 3),
    "bessel_i1e": (lax.bessel_i1e, lambda x: mpmath.besseli(1, x) * mpmath.exp(-abs(x)), -3, 3),
    "cbrt": (lax.cbrt, lambda x: mpmath.sign(x) * mpmath.cbrt(abs(x)), -2, 2),
    "ceil": (lax.ceil, mpmath.ceil, -3, 3),
    "cos": (lax.cos, mpmath.cos, -9, 9),
    "cosh": (lax.cosh, mpmath.cosh, -3, 3),
    "digamma": (lax.digamma, mpmath.digamma, 0.1, 4),
    "erf": (lax.erf, mpmath.erf, -3, 3),
    "erf_inv": (lax.erf_inv, mpmath.erfinv, -0.95, 0.95),
    "erfc": (lax.erfc, mpmath.erfc, -3, 3),
    "exp": (lax.exp, mpmath.exp, -3, 3),
    "exp2": (lax.exp2, lambda x: mpmath.mpf(2) ** x, -3, 3),
    "expm1": (lax.expm1, mpmath.expm1, -3, 3),
    "floor": (lax.floor, mpmath.floor, -3, 3),
    "integer_pow": (lambda x: lax.integer_pow(x, 3), lambda x: x**3, -2, 2),
    "lgamma": (lax.lgamma, mpmath.loggamma, 0.1, 4),
    "log": (lax.log, mpmath.log, 0.05, 4),
    "log1p": (lax.log1p, mpmath.log1p, -0.9, 3),
    "logistic": (lax.logistic, lambda x: 1 / (1 + mpmath.exp(-x)), -4, 4),
    "neg": (lax.neg, lambda x: -x, -2, 2),
    "pow": (lambda x: lax.pow(x, 2.5), lambda x: x ** mpmath.mpf("2.5"), 0, 3),
    "round": (lambda x: lax.round(x, half_even), mpmath.nint, -3, 3),
    "rsqrt": (lax.rsqrt, lambda x: 1 / mpmath.sqrt(x), 0.1, 4),
    "sign": (lax.sign, mpmath.sign, -2, 2),
    "sin": (lax.sin, mpmath.sin, -9, 9),
    "sinh": (lax.sinh, mpmath.sinh, -3, 3),
    "sqrt": (lax.sqrt, mpmath.sqrt, 0, 4),
    "square": (lax.square, lambda x: x * x, -2, 2),
    "tan": (lax.tan, mpmath.tan, -3, 3),
    "tanh": (lax.tanh, mpmath.tanh, -4, 4),
    "convert_element_type": (to_integer, lambda x: mpmath.sign(x) * mpmath.floor(abs(x)), -3, 3),
    "stop_gradient": (lax.stop_gradient, lambda x: x, -2, 2),
    "clamp": (lambda x: lax.clamp(-0.5, x, 0.75), lambda x: min(max(x, mpmath.mpf(-0.5)), mpmath.mpf(0.75)), -2, 2),
}  # fmt: skip
TWO = {
    "add": (lax.add, lambda x, y: x + y),
    "sub": (lax.sub, lambda x, y: x - y),
    "mul": (lax.mul, lambda x, y: x * y),
    "div": (lambda x, y: x / (y + 2.5), lambda x, y: x / (y + mpmath.mpf(2.5))),
    "min": (lax.min, min),
    "max": (lax.max, max),
    "atan2": (lax.atan2, mpmath.atan2),
    "rem": (lambda x, y: lax.rem(x, y + 2.5), lambda x, y: fmod(x, y + mpmath.mpf(2.5))),
    "pow": (lambda x, y: lax.pow(x + 2.5, y), lambda x, y: (x + mpmath.mpf(2.5)) ** y),
    "lt": (lambda x, y: (x < y) * 1.0, lambda x, y: mpmath.mpf(x < y)),
    "le": (lambda x, y: (x <= y) * 1.0, lambda x, y: mpmath.mpf(x <= y)),
    "gt": (lambda x, y: (x > y) * 1.0, lambda x, y: mpmath.mpf(x > y)),
    "ge": (lambda x, y: (x >= y) * 1.0, lambda x, y: mpmath.mpf(x >= y)),
    "ne": (lambda x, y: (x != y) * 1.0, lambda x, y: mpmath.mpf(x != y)),
    "eq": (lambda x, y: (x == y) * 1.0, lambda x, y: mpmath.mpf(x == y)),
    "and": (lambda x, y: ((x > 0) & (y > 0)) * 1.0, lambda x, y: mpmath.mpf(x > 0 and y > 0)),
    "or": (lambda x, y: ((x > 0) | (y > 0)) * 1.0, lambda x, y: mpmath.mpf(x > 0 or y > 0)),
    "xor": (lambda x, y: ((x > 0) ^ (y > 0)) * 1.0, lambda x, y: mpmath.mpf((x > 0) != (y > 0))),
    "not": (lambda x, y: (~(x > y)) * 1.0, lambda x, y: mpmath.mpf(not x > y)),
    "select_n": (lambda x, y: jnp.where(x > y, x * y, 3.0), lambda x, y: x * y if x > y else mpmath.mpf(3)),
}
REST = {
    "add_any",
    "copy",
    "copy_p",
    "real",
    "imag",
    "is_finite",
    "nextafter",
    "reduce_precision",
    "log2",
    "one_minus_square",
}
UNKNOWN = {"polynomial"}  # refused by name


def boxes_in(draw, lo, hi):
    """Boxes of two coordinates in [lo, hi]², from narrow to wide, their centres and their half widths."""
    corner = draw.uniform(lo, hi, (2, BOXES, 2))
    corner[1] += (corner[0] - corner[1]) * (1 - draw.choice([1.0, 0.1, 1e-3], (BOXES, 1)))
    low, high = corner.min(axis=0), corner.max(axis=0)
    middle = np.clip((low + high) / 2, low, high)
    radii = np.nextafter(np.maximum(high - middle, middle - low), np.inf)
    return low, high, middle, radii


@quietly
def bounds_of(function, low, high, middle, radii):
    """The range of a function of the two coordinates over every box."""
    ranges = [Interval(low[:, k], high[:, k]) for k in range(2)]
    centres = [Interval(middle[:, k], middle[:, k]) for k in range(2)]
    form = tf.taylor_forms(function, tf.coordinates(ranges, centres, 2)).item()
    found = form.bounds([radii[:, k] for k in range(2)])
    return np.broadcast_to(found.lo, len(low)), np.broadcast_to(found.hi, len(low))


def check_inclusion(function, exact, seed, lo, hi):
    draw = np.random.default_rng(seed)
    low, high, middle, radii = boxes_in(draw, lo, hi)
    least, most = bounds_of(function, low, high, middle, radii)
    mp.prec = 120
    for share in draw.random((POINTS, 2)).round():  # corners
        points = np.where(share, low, high)
        inside = np.clip(low + draw.random((BOXES, 2)) * (high - low), low, high)
        for k in range(BOXES):
            for x in (points[k], inside[k]):
                value = exact(*map(mpmath.mpf, x))
                assert mpmath.mpf(least[k]) <= value <= mpmath.mpf(most[k]), (x, value, least[k], most[k])


@pytest.mark.parametrize("name", ONE)
@given(seed=st.integers(0, 10**6))
@settings(max_examples=1, deadline=None)
def test_a_function_of_one_number_is_in_its_range(name, seed):
    function, exact, lo, hi = ONE[name]
    # a product inside, so that first and second derivatives of the primitive matter
    middle, reach = (lo + hi) / 2, (hi - lo) / 2

    def inner(x, y):
        return middle + reach * (0.75 * x * y + 0.25 * x)

    check_inclusion(lambda x: function(inner(x[0], x[1])), lambda x, y: exact(inner(x, y)), seed, -1, 1)


@pytest.mark.parametrize("name", TWO)
@given(seed=st.integers(0, 10**6))
@settings(max_examples=1, deadline=None)
def test_a_function_of_two_numbers_is_in_its_range(name, seed):
    function, exact = TWO[name]
    check_inclusion(
        lambda x: function(x[0] * x[1] + x[0], x[1] * x[1] - x[0]),
        lambda x, y: exact(x * y + x, y * y - x),
        seed,
        -1,
        1,
    )


def test_every_primitive_of_the_component_evaluator_has_a_rule():
    assert ENTRYWISE - UNKNOWN == tf.ENTRIES
    assert set(ONE) | set(TWO) | REST == tf.ENTRIES


def combination(x):
    """Reductions, products of matrices, branches, updates and constants that are computed."""
    a = jnp.array([[1.0, 0.3], [-0.2, 0.7]]) @ x
    y = x.at[0].add(jnp.sqrt(2.0)).at[1].multiply(jnp.exp(a[0]))
    z = jnp.where(x[0] > 0.1, y @ a, jnp.cumsum(y)[1]) + jax.nn.relu(x[1] - 0.2)
    return jnp.max(jnp.stack([z, a[1], jnp.prod(y)])) + jnp.linalg.norm(x) * jnp.mod(x[1], 0.5)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=5, deadline=None)
def test_a_combination_is_in_its_range(seed):
    draw = np.random.default_rng(seed)
    low, high, middle, radii = boxes_in(draw, -1, 1)
    least, most = bounds_of(combination, low, high, middle, radii)
    with jax.enable_x64(True):
        for _ in range(8):
            points = low + draw.random(low.shape) * (high - low)
            found = np.asarray(jax.vmap(combination)(points))
            assert np.all(least - 1e-14 <= found)
            assert np.all(found <= most + 1e-14)


def test_the_range_of_terms_that_cancel_falls_with_the_third_power_of_the_width():
    def function(x):
        return jnp.sin(3 * x[0] + x[1]) ** 2 + jnp.cos(3 * x[0] + x[1]) ** 2

    middle, widths = np.array([[0.3, -0.2]]), []
    for half in (0.02, 0.01):
        least, most = bounds_of(function, middle - half, middle + half, middle, np.full((1, 2), half * (1 + 1e-12)))
        assert least[0] <= 1 <= most[0]
        widths.append(most[0] - least[0])
    assert widths[1] < widths[0] / 7


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (lambda x: jax.lax.while_loop(lambda y: y[0] < 1, lambda y: y + 1, x)[0], "while"),
        (lambda x: jnp.array([1.0, 2.0])[x[0].astype(int)], "dynamic_slice with an index that depends on the state"),
        (lambda x: (x[0].astype(int) // 2) * 1.0, "an integer division"),
        (lambda x: x[0] * jnp.linalg.inv(jnp.eye(2) + 1.0)[0, 0], "lu"),
    ],
)
def test_a_primitive_without_a_rule_is_refused_by_name(function, name):
    with pytest.raises(ValueError, match=f"uses {name}, for which there is no interval rule"):
        bounds_of(function, *boxes_in(np.random.default_rng(0), -1, 1))


def test_hypot_is_in_its_range_also_at_the_origin():
    """Its program divides by the larger number, which is zero at the origin: the range was infinite."""
    draw = np.random.default_rng(2)
    low, high, middle, radii = boxes_in(draw, -1, 1)
    low[:2], high[:2], middle[:2], radii[:2] = -0.1, 0.2, 0.05, 0.15 * (1 + 1e-12)
    least, most = bounds_of(lambda x: jnp.hypot(x[0], x[1]), low, high, middle, radii)
    for _ in range(50):
        x = low + draw.random(low.shape) * (high - low)
        found = np.sqrt(x[:, 0] ** 2 + x[:, 1] ** 2)
        assert np.all((least - 1e-14 <= found) & (found <= most + 1e-14))
    assert np.all(most[:2] < 0.36)


def test_a_function_of_the_same_name_as_hypot_has_its_own_range():
    @jax.jit
    def hypot(a, b):
        return a + 2 * b

    low, high, middle, radii = boxes_in(np.random.default_rng(2), -1, 1)
    least, most = bounds_of(lambda x: hypot(x[0], x[1]), low, high, middle, radii)
    np.testing.assert_allclose(least, low[:, 0] + 2 * low[:, 1], atol=1e-12)
    np.testing.assert_allclose(most, high[:, 0] + 2 * high[:, 1], atol=1e-12)


def test_repeated_equations_are_evaluated_once():
    def function(x):
        return jnp.stack([jnp.sin(x[0]) * x[1], jnp.sin(x[0]) + x[1], 2.0 * x[0], 3.0 * x[0]])

    closed = jax.make_jaxpr(function)(jnp.ones(2))
    short = without_repetitions(closed)
    names = [[eqn.primitive.name for eqn in each.jaxpr.eqns] for each in (closed, short)]
    assert [each.count("sin") for each in names] == [2, 1]
    assert [each.count("mul") for each in names] == [3, 3]
    x = jnp.array([0.3, -0.7])
    (found,) = jax.core.eval_jaxpr(short.jaxpr, short.consts, x)
    np.testing.assert_array_equal(found, function(x))


def branches(x):
    """A switch whose index depends on the state, also beyond its branches."""
    index = jnp.floor(1.5 * x[0]).astype(int) + 1
    return jax.lax.switch(index, [lambda y: y[1], lambda y: y[0] * y[1], lambda y: 2.0 + y[0]], x)


def test_a_switch_that_depends_on_the_state_is_in_its_range():
    draw = np.random.default_rng(1)
    low, high, middle, radii = boxes_in(draw, -3, 3)
    least, most = bounds_of(branches, low, high, middle, radii)
    with jax.enable_x64(True):
        for _ in range(20):
            found = np.asarray(jax.vmap(branches)(low + draw.random(low.shape) * (high - low)))
            assert np.all((least <= found) & (found <= most))


def test_polynomials_of_the_control_have_their_coefficients():
    x = [tf.constant(2.0), tf.constant(3.0)]

    def function(x, u):
        return (u[0] - x[0]) ** 2 + x[1] * u[1] / 2 + jnp.where(x[0] > 0, u, 0.0) @ u - 1.0

    (found,) = quadratics.quadratics(function, x, 2)
    coefficients = {term: (float(each.range.lo), float(each.range.hi)) for term, each in found.items()}
    for term, wanted in {(): 3.0, (0,): -4.0, (1,): 1.5, (0, 0): 2.0, (1, 1): 1.0}.items():
        low, high = coefficients.pop(term)
        assert low <= wanted <= high <= low + 1e-13
    assert all(low == high == 0 for low, high in coefficients.values())
    with pytest.raises(quadratics.NotQuadraticError):
        quadratics.quadratics(lambda x, u: jnp.sin(u[0]), x, 2)
