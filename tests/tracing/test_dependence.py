"""How functions depend on the control, read from the jaxpr."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hjbjax.problem.pytree import as_partial, pytree_dataclass
from hjbjax.tracing import dependence

MATRIX = np.array([[1.0, 2.0], [0.5, -1.0]])
ARGUMENTS = ((3, False), (2, True))  # a state of three entries, a control of two


def found(function, arguments=ARGUMENTS):
    return dependence.dependence(as_partial(function), *arguments, dtype="float32")


def verdict(function):
    """constant, affine, separable (quadratic), quadratic or nonlinear: the strongest that was proved."""
    result = found(function)
    if result.is_constant:
        return "constant"
    if result.affine_in([0, 1]):
        return "affine"
    if result.separable_quadratic_in([0, 1]):
        return "separable"
    return "nonlinear" if any(isinstance(t, frozenset) for entry in result.entries for t in entry) else "quadratic"


@jax.custom_jvp
def own_rule(u):
    """u, with the derivative zero."""
    return 1.0 * u


own_rule.defjvp(lambda primals, tangents: (own_rule(*primals), 0 * tangents[0]))


@jax.custom_vjp
def own_transpose(u):
    """u, with the derivative zero in reverse mode."""
    return 1.0 * u


own_transpose.defvjp(lambda u: (own_transpose(u), None), lambda _, bar: (0 * bar,))


def test_the_type_of_a_trace_does_not_depend_on_the_caller():
    types = []

    def drift(x, u):
        types.extend((x.dtype, u.dtype))
        return u

    dependence.dependence(as_partial(drift), *ARGUMENTS, dtype=np.float64)
    assert types == [np.float64] * 2


VERDICTS = {
    "state alone": (lambda x, u: jnp.linalg.norm(x) * jnp.sin(x), "constant"),
    "number": (lambda x, u: 1.0, "constant"),
    "affine": (lambda x, u: jnp.stack([x[1], jnp.sin(x[0]) + u[0] / x[2] - u[1]]), "affine"),
    "bilinear in state and control": (lambda x, u: x[:2] * u, "affine"),
    "matmul": (lambda x, u: MATRIX.astype(x.dtype) @ u + x[:2], "affine"),
    "state-dependent matmul": (lambda x, u: jnp.outer(x, x[:2]) @ u, "affine"),
    "einsum": (lambda x, u: jnp.einsum("ij,j,k->ik", jnp.asarray(MATRIX, x.dtype), u, x), "affine"),
    "where by the state": (lambda x, u: jnp.where(x[0] > 0, u, -2 * u), "affine"),
    "cond by the state": (lambda x, u: jax.lax.cond(x[0] > 0, lambda v: v, lambda v: 3 * v, u), "affine"),
    "set, concatenate, cumsum": (lambda x, u: jnp.cumsum(jnp.concatenate([u, x]).at[3].add(u[1])), "affine"),
    "mean": (lambda x, u: jnp.mean(u), "affine"),
    "integer_pow": (lambda x, u: jnp.sum(u**2) + u[0], "separable"),
    "square": (lambda x, u: jnp.sum(jnp.square(u)) + x @ x, "separable"),
    "u @ u": (lambda x, u: 0.5 * (x @ x + u @ u), "separable"),
    "u * u": (lambda x, u: x[0] * u[0] * u[0], "separable"),
    "jit inside": (lambda x, u: jax.jit(lambda v: v @ v)(u), "separable"),
    "weighted squares": (lambda x, u: u @ jnp.diag(x[:2]) @ u, "quadratic"),  # 0 · u0 u1 is not seen to vanish
    "product of inputs": (lambda x, u: u[0] * u[1], "quadratic"),
    "quadratic form": (lambda x, u: u @ MATRIX.astype(x.dtype) @ u, "quadratic"),
    "square of a sum": (lambda x, u: (u[0] + u[1]) ** 2, "quadratic"),
    "abs": (lambda x, u: jnp.abs(u[0]), "nonlinear"),
    "where by the control": (lambda x, u: jnp.where(u[0] > 0, x[0], x[1]), "nonlinear"),
    "where by the control, affine cases": (lambda x, u: jnp.where(u[0] > 0, u[0], -u[0]), "nonlinear"),
    "cond by the control": (lambda x, u: jax.lax.cond(u[0] > 0, lambda v: v, lambda v: 3 * v, u), "nonlinear"),
    "division by the control": (lambda x, u: x[0] / (2 + u[0]), "nonlinear"),
    "cube": (lambda x, u: u[0] ** 3, "nonlinear"),
    "square of a square": (lambda x, u: (u[0] ** 2) ** 2, "nonlinear"),
    "quadratic times linear": (lambda x, u: u[0] ** 2 * u[1], "nonlinear"),
    "norm": (lambda x, u: jnp.linalg.norm(u), "nonlinear"),
    "maximum": (lambda x, u: jnp.max(u), "nonlinear"),
    "clip": (lambda x, u: jnp.clip(u, -1, 1), "nonlinear"),
    "rounding": (lambda x, u: u.astype(int) * 1.0, "nonlinear"),
    "relu": (lambda x, u: jax.nn.relu(u), "nonlinear"),
    "softplus of a scalar": (lambda x, u: jax.nn.softplus(u[0]), "nonlinear"),
    "stop_gradient": (lambda x, u: jax.lax.stop_gradient(u), "nonlinear"),
    "derivative rule of its own": (lambda x, u: own_rule(u), "nonlinear"),
    "transposed rule of its own": (lambda x, u: own_transpose(u), "nonlinear"),
    "own rules of the state": (
        lambda x, u: own_rule(x)[:2] * u + own_transpose(x)[0] + jax.lax.stop_gradient(x[1]) + jax.nn.relu(x[2]),
        "affine",
    ),
    "sixteen bits": (lambda x, u: u.astype(jnp.float16), "nonlinear"),
    "thirty-two bits": (lambda x, u: u.astype(jnp.float32), "affine"),
    "comparison": (lambda x, u: (u[0] > x[0]) * 1.0, "nonlinear"),
}


@pytest.mark.filterwarnings("ignore:the primitive 'custom_vjp_call'")
@pytest.mark.parametrize("name", VERDICTS)
def test_verdict(name):
    function, expected = VERDICTS[name]
    assert verdict(function) == expected


@pytest.mark.filterwarnings("ignore::hjbjax.FallbackWarning")
def test_what_has_no_rule_is_constant_only_where_the_control_has_no_part():
    def solved(x, u):
        return jnp.stack([jnp.sort(x)[0] + u[0], jnp.arange(4.0)[u[0].astype(int)]])

    assert found(solved).entries == (frozenset({(), (0,)}), frozenset({frozenset({0})}))


@pytest.mark.parametrize("name", [name for name, (_, expected) in VERDICTS.items() if expected == "affine"])
def test_what_is_called_affine_has_no_curvature(name):
    function = VERDICTS[name][0]
    x, u, v = jnp.array([0.3, -1.2, 0.8]), jnp.array([0.4, -0.7]), jnp.array([-1.5, 2.0])
    middle = function(x, (u + v) / 2)
    np.testing.assert_allclose(middle, (jnp.asarray(function(x, u)) + function(x, v)) / 2, rtol=1e-5, atol=1e-6)


def test_which_entries_each_input_drives():
    result = found(lambda x, u: jnp.stack([x[1], u[0] + x[0], u[1] ** 2, jnp.abs(u[0])]))
    assert result.driven_by([0]) == (1, 3)
    assert result.driven_by([1]) == (2,)
    assert not result.free_of([0])
    assert found(lambda x, u: x * u[0]).free_of([1])


def test_squares_are_found_input_by_input():
    result = found(lambda x, u: u[0] ** 2 + u[0] * u[1])
    assert result.has_square([0])
    assert not result.has_square([1])
    assert result.affine_in([1])
    assert not result.affine_in([0])
    assert not result.separable_quadratic_in([0, 1])


def test_what_is_no_polynomial_is_known_by_its_inputs():
    result = found(lambda x, u: jnp.stack([jnp.abs(u[0]) + u[1] ** 2, jnp.sin(u[0]) * u[1], u[1] + x[0]]))
    assert not result.affine_in([0])
    assert not result.affine_in([1])
    assert result.has_square([1])
    assert not result.has_square([0])
    assert result.crosses([0], [1])
    mixed = found(lambda x, u: jnp.abs(u[0]) + u[1])
    assert mixed.affine_in([1])
    assert mixed.separable_quadratic_in([1])
    assert not mixed.crosses([0], [1])


def test_inputs_are_numbered_through_both_players():
    game = ((None, False), (3, False), (2, True), (1, True))  # t, x, u, d
    result = found(lambda t, x, u, d: jnp.stack([t * u[1], d[0] * u[0], d[0] ** 2]), game)
    assert result.entries == (frozenset({(1,)}), frozenset({(0, 2)}), frozenset({(2, 2)}))
    assert result.affine_in([0, 1])


def test_a_control_without_entries():
    assert found(lambda x, u: x + jnp.sum(u), ((3, False), (0, True))).is_constant


@pytree_dataclass()
class Power:
    """(u₀ − ½)^p with p a number of the problem: what it is decides what can be proved."""

    exponent: object

    def __call__(self, x, u):
        return (u[0] - 0.5) ** self.exponent


def test_numbers_decide_what_is_proved():
    assert found(Power(2)).separable_quadratic_in([0])
    assert not found(Power(4)).separable_quadratic_in([0])
    assert found(Power(2)).separable_quadratic_in([0])
