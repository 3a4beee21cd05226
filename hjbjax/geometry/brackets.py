"""Vector fields, their Lie derivatives and their Lie brackets, by automatic differentiation.

    L_f h = (∂h/∂x) f
    [f, g] = (∂g/∂x) f − (∂f/∂x) g                                         (4.4)
    ad_f⁰ g = g,   ad_f^k g = [f, ad_f^{k−1} g]

A vector field is a function of one state that returns shape (n,). Derivatives are exact up to rounding and have the
dtype of the state. Functions that decide something (``decide``) use float64 and return NumPy arrays; under a tracer
they are traced like any other function.
"""

import functools
from collections.abc import Callable, Sequence
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem import arguments
from hjbjax.problem.pytree import as_partial, cast, front_door, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Control, DType, Number, State
from hjbjax.tracing import checks

S = TypeVar("S")
T = TypeVar("T")
Field: TypeAlias = Callable[[State], State]
Ladder: TypeAlias = Callable[[State], tuple[jax.Array, ...]]  # a function and its derivatives along vector fields


@front_door
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

    def derivative(x: State | Sequence[float]) -> jax.Array:
        # forward mode: one pass through h, without forming its Jacobian
        with own_settings():
            return jax.jvp(in_state_dtype(h), (as_state(x),), (velocity(f)(as_state(x)),))[1]

    return derivative


@front_door
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

    def bracket(x: State | Sequence[float]) -> jax.Array:
        # two directional derivatives instead of two n × n Jacobians
        with own_settings():
            change = jax.jvp(velocity(g), (as_state(x),), (velocity(f)(as_state(x)),))[1]
            return change - jax.jvp(velocity(f), (as_state(x),), (velocity(g)(as_state(x)),))[1]

    return bracket


@front_door
def ad(f: Field, g: Field, k: int) -> Field:
    """ad_f^k g, the k-fold bracket [f, [f, … [f, g]]], as a function of one state.

    Args:
      f: a vector field.
      g: a vector field.
      k: the number of brackets, at least 0.

    Raises:
      ValueError: k is not an integer ≥ 0.

    Example:
      >>> chain = ad(lambda x: jnp.stack([x[1], x[2], 0.0]), lambda x: jnp.array([0.0, 0.0, 1.0]), 2)
      >>> chain(jnp.zeros(3)).tolist()
      [1.0, 0.0, 0.0]
    """
    arguments.count(k, "ad: k", least=0)
    # each bracket evaluates and differentiates the one inside it: for the ball and beam it has 25 operations
    # for k = 0, 1677 for k = 3 and 5695 for k = 4; ``along`` shares the inner evaluation and needs half as many
    for _ in range(k):
        g = lie_bracket(f, g)
    return g


@front_door
def affine_fields(drift: Callable, inputs: int) -> tuple[Field, Sequence[Field]]:
    """The fields f and g_1, …, g_m of a drift f(x) + Σ g_j(x) u_j, such as ``Problem.drift``.

    Args:
      drift: a function (x, u) that is affine in u; affinity is not checked.
      inputs: m.

    Example:
      >>> f, (g,) = affine_fields(lambda x, u: jnp.stack([x[1], jnp.sin(x[0]) + 2 * u[0]]), 1)
      >>> f(jnp.array([0.0, 3.0])).tolist(), g(jnp.zeros(2)).tolist()
      ([3.0, 0.0], [0.0, 2.0])
    """
    arguments.count(inputs, "affine_fields: inputs", least=0)
    held = as_pytree(drift, "affine_fields: drift")
    return _Affine(held, inputs, None), [_Affine(held, inputs, j) for j in range(inputs)]


@pytree_dataclass(static=("inputs", "j"))
class _Affine:
    """x ↦ f(x, 0) if j is None, otherwise x ↦ ∂f/∂u_j; the drift's numbers are leaves."""

    drift: Callable[[State, Control], State]
    inputs: int
    j: int | None

    def __call__(self, x: State | Sequence[float]) -> State:
        with own_settings():
            x = as_state(x)
            zero = jnp.zeros(self.inputs, x.dtype)
            if self.j is None:
                return self.drift(x, zero)
            # exact for an affine drift, while f(x, e_j) − f(x, 0) would lose g_j to rounding if f(x, 0) is large
            return jax.jvp(functools.partial(self.drift, x), (zero,), (zero.at[self.j].set(1),))[1]


def along(function: Callable[[State], T], x: State, directions: Array) -> tuple[T, T]:
    """The value at x, and the derivatives along p directions of shape (p, n), with a leading axis of length p.

    One evaluation gives both, so the program of k nested calls grows only like 2^k.
    """
    # out_axes None: the value does not depend on the direction, so it is computed once instead of p times
    return jax.vmap(lambda v: jax.jvp(function, (x,), (v,)), out_axes=(None, 0))(directions)


def velocity(field: Field) -> Field:
    """The field in the dtype of the state; raises ValueError if it does not return the shape of the state."""

    def call(x: State) -> jax.Array:
        rates = in_state_dtype(field)(x)
        # a number or shape (n, 1) would broadcast to brackets of the right shape with wrong entries
        if rates.shape != x.shape:
            raise ValueError(
                f"a vector field returned shape {rates.shape}, expected {x.shape}: one rate per state, for one state"
            )
        return rates

    return call


def stack_fields(fields: Sequence[Field]) -> Callable[[State], jax.Array]:
    """Combine several fields into one function that returns shape (m, n)."""
    return lambda x: jnp.stack([velocity(field)(x) for field in fields])


def root_eps(dtype: DType) -> float:
    """The default tolerance of ranks, √eps: 1.5e-8 in float64."""
    # above the rounding of a bracket (1e-12) and below clear ranks (0.1 for a car with trailers)
    return float(jnp.finfo(dtype).eps) ** 0.5


def rounding_of_terms(dtype: DType) -> float:
    """The default tolerance relative to terms, 1024 eps: 2e-13 in float64."""
    # five derivatives leave rounding below 100 eps, and a true feedthrough of 1e-8 should count
    return 1024 * float(jnp.finfo(dtype).eps)


def decide(
    derive: Callable[..., T],
    judge: Callable[[T, State, Number], S],
    functions: tuple,
    x: State | Sequence[float],
    tolerance: Number | None,
    default: Callable[[DType], float] = root_eps,
    **static: int | bool,
) -> S:
    """Evaluate a verdict on derivatives, in float64 on the host, or in the dtype of the state under a tracer.

    Args:
      derive: ``derive(functions, x, tolerance, **static)``, compiled again for every system.
      judge: ``judge(derivatives, x, tolerance)``, compiled once for all systems with the same number of states and
        inputs, because scales and singular values take as long to compile as the derivatives for four states.
      functions: a pytree of functions of one state.
      x: the state, shape (n,).
      tolerance: numbers below it count as zero; ``None`` is the default.
      default: the default tolerance as a function of the dtype.
      static: the static arguments of ``derive``.
    """
    if is_traced(functions, x, tolerance):
        x = as_state(x)
        allowed = default(x.dtype) if tolerance is None else tolerance
        return judge(derive(functions, x, allowed, **static), x, allowed)
    # always float64: in float32 √eps is 3.5e-4, which would change ranks
    with own_settings(x64=True):
        state = np.asarray(x, np.float64)
        if state.ndim != 1 or not np.all(np.isfinite(state)):
            raise ValueError(f"got x = {x!r}, wanted finite numbers of shape (n,): one state")
        allowed = default(np.float64) if tolerance is None else float(tolerance)
        if not 0 < allowed < 1:
            raise ValueError(f"got tolerance = {tolerance!r}, wanted a number between 0 and 1")
        try:
            found = compiled(derive, tuple(static.items()))(cast(functions, np.float64), state, allowed)
        except jax.errors.JAXTypeError as error:
            # for example an ``if`` on a state, or a NumPy function of a state
            raise ValueError("a field cannot be traced: use jnp.where instead of if, jnp instead of numpy") from error
        answer = compiled(judge, ())(found, state, allowed)
        # a field may close over a traced value although field and state are concrete; the answer then stays traced
        answer = jax.tree.map(lambda leaf: leaf if is_traced(leaf) else np.asarray(leaf), answer)
    numbers = [leaf for leaf in jax.tree.leaves((found, answer)) if not is_traced(leaf)]
    if not all(np.all(np.isfinite(leaf)) for leaf in numbers):
        place, cure = ("at or near", ": choose another x, or a smaller radius=") if "samples" in static else ("at", "")
        raise ValueError(
            f"a derivative of the fields is not finite {place} x = {state.tolist()}; the fields must be smooth "
            f"there{cure}"
        )
    return answer


@functools.lru_cache(maxsize=256)
def compiled(rule: Callable[..., T], static: tuple[tuple[str, int | bool], ...]) -> Callable[..., T]:
    """A rule as one program, with its static arguments."""
    # jit caches programs by the identity of the function, and a new partial in every call would compile again
    return jax.jit(functools.partial(rule, **dict(static)))


def as_pytree(function: Callable, name: str = "function") -> jax.tree_util.Partial:
    """A function as a pytree; if it is a bound method, the numbers of its object are leaves."""
    held = as_partial(function, name)
    if held is None:
        raise TypeError(f"{name}: got None, wanted a function of one state")
    return held


def as_fields(f: Field | None, gs: Field | Sequence[Field]) -> tuple[jax.tree_util.Partial, ...]:
    """The drift (if any) and the input fields as pytrees."""
    drift = () if f is None else (f,)
    return tuple(as_pytree(field) for field in (*drift, *([gs] if callable(gs) else gs)))


def stack_outputs(h: Callable[[State], Array | Number]) -> Callable[[State], jax.Array]:
    """The outputs as a function that returns shape (outputs,)."""
    return lambda x: jnp.atleast_1d(in_state_dtype(h)(x))


def output_derivatives(drifts: Sequence[Callable[[State], jax.Array]], h: Callable[[State], jax.Array]) -> Ladder:
    """x ↦ (h, L_f h, L_f L_f h, …), each of shape (outputs,), with one derivative per drift f of shape (1, n)."""

    def outputs(x: State) -> tuple[jax.Array, ...]:
        return (h(x),)

    def longer(shorter: Ladder, f: Callable[[State], jax.Array]) -> Ladder:
        def step(x: State) -> tuple[jax.Array, ...]:
            found, changes = along(shorter, x, f(x))
            return (*found, changes[-1][0])  # [0] selects the only direction, f

        return step

    ladder: Ladder = outputs
    for f in drifts:
        ladder = longer(ladder, f)
    return ladder


def as_half_widths(radius: float | Array, states: int, name: str) -> np.ndarray:
    """The half widths of the neighbourhood, shape (n,)."""
    widths = np.asarray(radius, np.float64)
    if widths.shape not in ((), (states,)) or not np.all(np.isfinite(widths) & (widths >= 0)):
        raise ValueError(f"{name}: got radius = {radius!r}, wanted a finite number ≥ 0, or {states} of them")
    return np.array(np.broadcast_to(widths, states))


def near(x: State, radius: Array, samples: int) -> jax.Array:
    """The state and points around it, shape (samples + 1, n)."""
    # fixed seed, so that the verdict is the same in every call, traced or not
    spread = np.random.default_rng(0).uniform(-1.0, 1.0, (samples, x.shape[0]))
    spread = np.concatenate([np.zeros((1, x.shape[0])), spread])
    return jnp.asarray(x) + jnp.asarray(spread, x.dtype) * jnp.asarray(radius, x.dtype)


def as_bool(verdict: bool | Array) -> bool | jax.Array:
    """A verdict as a bool, unless it is traced."""
    return verdict if isinstance(verdict, jax.core.Tracer) else bool(verdict)


def as_state(x: State | Sequence[float]) -> jax.Array:
    """The state as a floating-point array."""
    # JAX does not differentiate with respect to integers, but [0, 1] is a valid state
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)


def in_state_dtype(function: Callable[[State], Array | Number]) -> Callable[[State], jax.Array]:
    """The function with its result as an array in the dtype of the state."""

    def call(x: State) -> jax.Array:
        try:
            return jnp.asarray(function(x), x.dtype)
        except jax.errors.JAXTypeError as error:
            said = checks.cure(error)
            if said is None:
                raise
            raise ValueError(
                f"a function of the state {said}.\nIt is differentiated with respect to x of shape {x.shape}"
            ) from error

    return call
