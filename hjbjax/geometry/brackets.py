"""Vector fields, their Lie derivatives and their Lie brackets, by automatic differentiation.

    L_f h = (∂h/∂x) f
    [f, g] = (∂g/∂x) f − (∂f/∂x) g                                         (4.4)
    ad_f⁰ g = g,   ad_f^k g = [f, ad_f^{k−1} g]

A vector field is a function of one state that returns shape (n,). Derivatives are exact up to rounding, and follow
the dtype of their argument. What decides something from them (``decide``) does so in float64 and returns NumPy
arrays; under a tracer it is traced like anything else.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem import arguments
from hjbjax.problem.pytree import as_partial, cast, is_traced, pytree_dataclass

Field = Callable[[Any], Any]


def lie_derivative(f: Field, h: Callable) -> Callable:
    """L_f h, the rate of h along f, as a function of one state.

    Args:
      f: a vector field.
      h: a function of one state that returns an array of any shape.

    Example:
      >>> energy = lambda x: 0.5 * (x @ x)
      >>> float(lie_derivative(lambda x: jnp.stack([x[1], -x[0] - x[1]]), energy)(jnp.array([1.0, 2.0])))
      -4.0
    """

    def derivative(x):
        return jax.jvp(floating(h), (as_state(x),), (floating(f)(as_state(x)),))[1]

    return derivative


def lie_bracket(f: Field, g: Field) -> Field:
    """[f, g] = (∂g/∂x) f − (∂f/∂x) g, the sign of (4.4), as a function of one state.

    Args:
      f: a vector field.
      g: a vector field.

    Example:
      >>> turn, drive = lambda x: jnp.array([0.0, 0.0, 1.0]), lambda x: jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]), 0.0])
      >>> lie_bracket(drive, turn)(jnp.zeros(3)).tolist()
      [0.0, -1.0, 0.0]
    """

    def bracket(x):
        change = jax.jvp(floating(g), (as_state(x),), (floating(f)(as_state(x)),))[1]
        return change - jax.jvp(floating(f), (as_state(x),), (floating(g)(as_state(x)),))[1]

    return bracket


def ad(f: Field, g: Field, k: int) -> Field:
    """ad_f^k g, the k-fold bracket [f, [f, … [f, g]]], as a function of one state.

    Args:
      f: a vector field.
      g: a vector field.
      k: how many brackets, at least 0.

    Raises:
      ValueError: k is not an integer ≥ 0.

    Example:
      >>> chain = ad(lambda x: jnp.stack([x[1], x[2], 0.0]), lambda x: jnp.array([0.0, 0.0, 1.0]), 2)
      >>> chain(jnp.zeros(3)).tolist()
      [1.0, 0.0, 0.0]
    """
    arguments.count(k, "ad: k", least=0)
    for _ in range(k):
        g = lie_bracket(f, g)
    return g


def affine_fields(drift: Callable, inputs: int) -> tuple[Field, Sequence[Field]]:
    """The fields f and g_1, …, g_m of a drift f(x) + Σ g_j(x) u_j, such as ``Problem.drift``.

    Args:
      drift: a function (x, u), affine in u; that it is affine is not checked.
      inputs: m.

    Example:
      >>> f, (g,) = affine_fields(lambda x, u: jnp.stack([x[1], jnp.sin(x[0]) + 2 * u[0]]), 1)
      >>> f(jnp.array([0.0, 3.0])).tolist(), g(jnp.zeros(2)).tolist()
      ([3.0, 0.0], [0.0, 2.0])
    """
    arguments.count(inputs, "affine_fields: inputs", least=0)
    held = as_partial(drift, "affine_fields: drift")
    return _Affine(held, inputs, None), [_Affine(held, inputs, j) for j in range(inputs)]


@pytree_dataclass(static=("inputs", "j"))
class _Affine:
    """x ↦ f(x, 0), or with j the rate of f(x, u) with u_j; the drift's numbers stay leaves."""

    drift: Any
    inputs: int
    j: int | None

    def __call__(self, x):
        x = as_state(x)
        zero = jnp.zeros(self.inputs, x.dtype)
        if self.j is None:
            return self.drift(x, zero)
        return jax.jvp(functools.partial(self.drift, x), (zero,), (zero.at[self.j].set(1),))[1]


def along(function: Callable, x: Any, directions: Any) -> Any:
    """The value at x, and the derivatives along directions, shape (p, n), with a leading axis of length p.

    One evaluation gives both, so that the program of k nested ones grows like 2^k and no faster.
    """
    return jax.vmap(lambda v: jax.jvp(function, (x,), (v,)), out_axes=(None, 0))(directions)


def stacked(fields: Sequence[Field]) -> Callable:
    """Several fields as one function that returns shape (m, n)."""

    def every(x):
        rows = [floating(field)(x) for field in fields]
        for row in rows:
            if row.shape != x.shape:
                raise ValueError(
                    f"a vector field returned shape {row.shape}, expected {x.shape}: one rate a state, for one state"
                )
        return jnp.stack(rows)

    return every


def decide(rule: Callable, functions: tuple, x: Any, tolerance: Any, **static: Any) -> Any:
    """``rule(functions, x, tolerance, **static)``: in float64 at the host, in its own dtype under a tracer."""
    if is_traced(functions, x, tolerance):
        x = as_state(x)
        return rule(functions, x, jnp.finfo(x.dtype).eps ** 0.5 if tolerance is None else tolerance, **static)
    with jax.enable_x64(True):
        state = np.asarray(x, np.float64)
        if state.ndim != 1 or not np.all(np.isfinite(state)):
            raise ValueError(f"got x = {x!r}, wanted finite numbers of shape (n,): one state")
        allowed = 2.0**-26 if tolerance is None else float(tolerance)
        if not 0 < allowed < 1:
            raise ValueError(f"got tolerance = {tolerance!r}, wanted a number between 0 and 1")
        try:
            answer = _compiled(rule, tuple(static.items()))(cast(functions, np.float64), state, allowed)
        except jax.errors.JAXTypeError as error:
            raise ValueError("a field cannot be traced: use jnp.where instead of if, jnp instead of numpy") from error
        answer = jax.tree.map(lambda leaf: leaf if is_traced(leaf) else np.asarray(leaf), answer)
    numbers = [leaf for leaf in jax.tree.leaves(answer) if not is_traced(leaf)]
    if not all(np.all(np.isfinite(leaf)) for leaf in numbers):
        raise ValueError(
            f"a derivative of the fields is not finite at or near x = {state.tolist()}: they must be smooth there"
        )
    return answer


@functools.lru_cache(maxsize=256)
def _compiled(rule, static):
    return jax.jit(functools.partial(rule, **dict(static)))


def as_fields(gs: Any) -> list[Field]:
    """A sequence of fields from one or several."""
    return [gs] if callable(gs) else list(gs)


def as_state(x: Any) -> Any:
    """A state as a floating-point array."""
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)


def floating(function: Callable) -> Callable:
    """The function with a list, an integer or a constant of its own dtype made an array in that of the state."""

    def call(x):
        return jnp.asarray(function(x), x.dtype)

    return call
