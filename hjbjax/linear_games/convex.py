"""Convex functions of the state for ``hopf``: ≤ 0 on a ball, a box, an ellipsoid, a half-space or an intersection.

Each is also an ordinary function of one state, for ``reach``, ``avoid`` and ``Problem(terminal_cost=)``. The functions
of sets are largest values of norms and affine functions,

    J(y) = max_i { |M_i y − c_i| − b_i,  a_i·y − b_i }

The Legendre transform J*(p) is the least of Σ z_i·c_i + λ_i b_i over all weights λ ≥ 0 with the sum 1 and vectors
|z_i| ≤ λ_i with p = Σ M_i'z_i + λ_i a_i. The dual point θ = (λ, z) has the barrier Σ log λ_i + log(λ_i² − |z_i|²).
For a smooth J the dual point is the state at which p is the gradient of J.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem import arguments
from hjbjax.problem.pytree import as_partial, is_traced, numbers, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, Numbers, State
from hjbjax.tracing.closures import opened

__all__ = ["ball", "box", "ellipsoid", "half_space", "largest", "smooth"]


@pytree_dataclass(static=("dim",))
class Largest:
    """The largest of norms and affine functions; made by ``ball``, ``box``, ``ellipsoid``, ``half_space``, ``largest``.

    Args:
      dim: the number of states n.
      rows: a_i, shape (k, n).
      offsets: b_i of the affine functions, shape (k,).
      norms: triples (M_i, c_i, b_i) of the norms.
    """

    dim: int
    rows: Any
    offsets: Any
    norms: tuple[tuple[Any, Any, Any], ...] = ()

    @own_settings()
    def __call__(self, x: State) -> jax.Array:
        """J(x) at one state."""
        affine = jnp.asarray(self.rows) @ x - jnp.asarray(self.offsets)
        round_ones = [jnp.linalg.norm(jnp.asarray(m) @ x - c) - b for m, c, b in self.norms]
        return jnp.max(jnp.concatenate([affine, jnp.stack(round_ones)]) if round_ones else affine)

    def magnitude(self, x: State) -> Array:
        """The size of the terms of J(x), whose rounding the value inherits."""
        rows = jnp.concatenate([self.rows, *(m for m, _, _ in self.norms)])
        level = jnp.concatenate([self.offsets, *(c for _, c, _ in self.norms), *(jnp.ravel(b) for *_, b in self.norms)])
        return jnp.max(jnp.abs(rows) @ jnp.abs(x)) + jnp.max(jnp.abs(level))

    @property
    def degree(self) -> int:
        """The number of logarithms of the barrier: the duality gap is this number times μ."""
        return np.shape(self.rows)[0] + 2 * len(self.norms)

    def start(self, x: State) -> tuple[Array, Array]:
        """The middle of the dual points, and the row e of the constraint e·θ = 1."""
        count = np.shape(self.rows)[0] + len(self.norms)
        ones = jnp.ones(count, x.dtype)
        tail = jnp.zeros(sum(np.shape(m)[0] for m, _, _ in self.norms), x.dtype)
        return jnp.concatenate([ones / count, tail]), jnp.concatenate([ones, tail])

    def dual(self, theta: Array, mu: Number) -> tuple[Array, Array, Array]:
        """p(θ), −J*(p) or less, and the barrier times μ, for θ = (weights, and one vector per norm)."""
        k, dtype = np.shape(self.rows)[0], theta.dtype
        weights, at = theta[:k], k + len(self.norms)
        p = weights @ jnp.asarray(self.rows, dtype)
        level = -weights @ jnp.asarray(self.offsets, dtype)
        barrier = jnp.sum(jnp.log(weights))
        for weight, (matrix, center, offset) in zip(theta[k:at], self.norms, strict=True):
            rows = np.shape(matrix)[0]
            z, at = theta[at : at + rows], at + rows
            p = p + z @ jnp.asarray(matrix, dtype)
            level = level - z @ jnp.asarray(center, dtype) - weight * offset
            # the point is inside the cone |z| < weight, and not inside its mirror image
            barrier = barrier + jnp.where(weight > 0, jnp.log(weight * weight - z @ z), jnp.nan)
        return p, level, mu * barrier

    def curvature(self, theta: Array, mu: Number) -> jax.Array:
        """Minus the second derivative of the barrier."""
        return -jax.hessian(lambda theta: self.dual(theta, mu)[2])(theta)


class _WithoutBarrier:
    """A function whose dual point θ is a state, without constraints."""

    @property
    def degree(self) -> int:
        """There is no barrier."""
        return 0

    def start(self, x: State) -> tuple[Array, Array]:
        """The state, and no constraint."""
        return x, jnp.zeros_like(x)

    def magnitude(self, x: State) -> Array:
        """The size of the terms of J(x), whose rounding the value inherits."""
        value, slope = jax.value_and_grad(lambda y: jnp.asarray(self(y), x.dtype))(x)  # type: ignore[operator]
        return jnp.abs(value) + jnp.abs(slope) @ jnp.abs(x)


@pytree_dataclass(static=("dim",))
class Quadratic(_WithoutBarrier):
    """½ (y − c)'Q(y − c) + a·y − b with a positive semidefinite Q.

    Args:
      dim: the number of states n.
      matrix: Q, shape (n, n).
      slope: a, shape (n,), with c = 0.
      offset: b.
    """

    dim: int
    matrix: Any
    slope: Any
    offset: Any

    @own_settings()
    def __call__(self, x: State) -> jax.Array:
        """J(x) at one state."""
        return x @ (jnp.asarray(self.matrix) @ x) / 2 + jnp.asarray(self.slope) @ x - self.offset

    def dual(self, theta: Array, mu: Number) -> tuple[Array, Array, Array]:
        """p(θ) = Qθ + a, the gradient at θ, −J*(p) and zero."""
        bent = jnp.asarray(self.matrix, theta.dtype) @ theta
        return bent + jnp.asarray(self.slope, theta.dtype), -theta @ bent / 2 - self.offset, jnp.zeros((), theta.dtype)

    def curvature(self, theta: Array, mu: Number) -> jax.Array:
        """Q."""
        return jnp.asarray(self.matrix, theta.dtype)


@pytree_dataclass(static=("dim",))
class Differentiable(_WithoutBarrier):
    """A differentiable function that its user declares convex; made by ``smooth``.

    Args:
      dim: the number of states n.
      function: J.
    """

    dim: int
    function: Any

    def __call__(self, x: State) -> Array:
        """J(x) at one state."""
        return self.function(x)

    def dual(self, theta: Array, mu: Number) -> tuple[Array, Array, Array]:
        """p(θ), the gradient at θ, −J*(p) by Fenchel's equality, and zero."""
        value, p = jax.value_and_grad(lambda y: jnp.asarray(self.function(y), theta.dtype))(theta)
        return p, value - p @ theta, jnp.zeros((), theta.dtype)

    def curvature(self, theta: Array, mu: Number) -> jax.Array:
        """The second derivative at θ; its own derivative is left out, as in a Gauss–Newton method."""
        return jax.hessian(lambda y: jnp.asarray(self.function(y), theta.dtype))(theta)


@pytree_dataclass(static=("dim",))
class Conjugated(_WithoutBarrier):
    """A convex function with its Legendre transform, both from the user; made by ``smooth``. Its dual point is p.

    Args:
      dim: the number of states n.
      function: J.
      transform: J*.
    """

    dim: int
    function: Any
    transform: Any

    def __call__(self, x: State) -> Array:
        """J(x) at one state."""
        return self.function(x)

    def start(self, x: State) -> tuple[Array, Array]:
        """A subgradient at the state, and no constraint."""
        return jax.grad(lambda y: jnp.asarray(self.function(y), x.dtype))(x), jnp.zeros_like(x)

    def dual(self, theta: Array, mu: Number) -> tuple[Array, Array, Array]:
        """p, −J*(p) and zero."""
        return theta, -jnp.asarray(self.transform(theta), theta.dtype), jnp.zeros((), theta.dtype)

    def curvature(self, theta: Array, mu: Number) -> jax.Array:
        """The second derivative of J*."""
        return jax.hessian(lambda p: jnp.asarray(self.transform(p), theta.dtype))(theta)


ConvexFunction: TypeAlias = Largest | Quadratic | Differentiable | Conjugated


def ball(center: Numbers | Sequence, radius: Number) -> Largest:
    """The signed distance to a ball, |x − center| − radius.

    Args:
      center: shape (n,).
      radius: a number.

    Example:
      >>> float(ball([1.0, 0.0], 0.5)(np.array([3.0, 0.0])))
      1.5
    """
    middle = _vector(center, "convex.ball: center")
    n = len(middle)
    return Largest(n, np.zeros((0, n)), np.zeros(0), ((np.eye(n), middle, _number(radius, "convex.ball: radius")),))


def box(lo: Numbers | Sequence, hi: Numbers | Sequence) -> Largest:
    """The largest of lo_i − x_i and x_i − hi_i: ≤ 0 in the box, outside the distance in the maximum norm.

    Args:
      lo: lower corner, shape (n,).
      hi: upper corner, shape (n,).

    Raises:
      ValueError: the corners have different lengths, or a lower bound is above the upper bound.
    """
    low, high = _vector(lo, "convex.box: lo"), _vector(hi, "convex.box: hi")
    known = not is_traced(low, high)
    if np.shape(low) != np.shape(high) or (known and np.any(low > high)):
        raise ValueError(f"convex.box: got lo = {lo} and hi = {hi}, wanted corners of the same length with lo ≤ hi")
    eye = np.eye(len(low))
    xp: Any = np if known else jnp
    return Largest(len(low), np.concatenate([eye, -eye]), xp.concatenate([high, -low]))


def ellipsoid(center: Numbers | Sequence, matrix: Numbers | Sequence) -> Largest:
    """The square root of (x − center)' matrix⁻¹ (x − center), minus 1: ≤ 0 in the ellipsoid.

    Args:
      center: shape (n,).
      matrix: symmetric and positive definite, shape (n, n); a multiple r² of the identity is the ball of radius r.

    Raises:
      ValueError: the matrix is not symmetric and positive definite.
    """
    middle, shape = _vector(center, "convex.ellipsoid: center"), numbers(matrix, "convex.ellipsoid: matrix")
    n = len(middle)
    if np.shape(shape) != (n, n):
        raise ValueError(f"convex.ellipsoid: got a matrix of shape {np.shape(shape)}, wanted ({n}, {n}), like center")
    if not is_traced(shape):
        sizes = np.linalg.eigvalsh(shape)
        if not np.allclose(shape, shape.T, rtol=1e-9, atol=0) or sizes[0] <= 0:
            raise ValueError(f"convex.ellipsoid: got {shape.tolist()}, wanted a symmetric positive definite matrix")
    xp: Any = jnp if is_traced(shape, middle) else np
    # |M(x − c)|² = (x − c)' matrix⁻¹ (x − c) for the inverse M of the Cholesky factor
    root = xp.linalg.inv(xp.linalg.cholesky(shape))
    return Largest(n, np.zeros((0, n)), np.zeros(0), ((root, root @ middle, 1.0),))


def half_space(normal: Numbers | Sequence, offset: Number = 0.0) -> Largest:
    """The affine function normal·x − offset.

    Args:
      normal: shape (n,); with length 1 the function is the signed distance.
      offset: a number.
    """
    row = _vector(normal, "convex.half_space: normal")
    xp: Any = jnp if is_traced(row, offset) else np
    bound = xp.reshape(xp.asarray(_number(offset, "convex.half_space: offset")), (1,))
    return Largest(len(row), row[None], bound)


def largest(functions: Sequence[Largest]) -> Largest:
    """The largest of several functions of this module: ≤ 0 on the intersection of their sets.

    Args:
      functions: results of ``ball``, ``box``, ``ellipsoid``, ``half_space`` or ``largest``, in the same dimension.

    Raises:
      ValueError: there are no functions, or their dimensions differ.
      TypeError: a function of another kind.
    """
    each = list(functions)
    if wrong := [one for one in each if not isinstance(one, Largest)]:
        raise TypeError(f"convex.largest: got {wrong[0]!r:.80}, wanted balls, boxes, ellipsoids and half-spaces")
    if len({one.dim for one in each}) != 1:
        dims = [one.dim for one in each]
        raise ValueError(f"convex.largest: got functions of {dims} states, wanted at least one, all of the same number")
    xp: Any = jnp if is_traced(each) else np
    rows = xp.concatenate([one.rows for one in each])
    return Largest(
        each[0].dim, rows, xp.concatenate([one.offsets for one in each]), sum((one.norms for one in each), ())
    )


def smooth(function: Callable, states: int, *, conjugate: Callable | None = None) -> Differentiable | Conjugated:
    """Declare that a function is convex, and differentiable unless its Legendre transform is given.

    The bounds of ``hopf`` are wrong if the declaration is.

    Args:
      function: J, a function of one state.
      states: the number of states n.

    Keyword Args:
      conjugate: the Legendre transform J*(p) = max_x [p·x − J(x)], which must be differentiable and finite for all p.
        Then J may have kinks, such as |x|² + |x₁|.

    Raises:
      ValueError: at a random state x, J(x) + J*(p) differs from p·x with the gradient p of J.
    """
    n = arguments.count(states, "convex.smooth: states")
    own = _settled(function, n, "convex.smooth: function")
    if conjugate is None:
        return Differentiable(n, own)
    found = Conjugated(n, own, _settled(conjugate, n, "convex.smooth: conjugate"))
    if not is_traced(found):
        _check_transform(found)
    return found


def _settled(function: Callable, n: int, name: str) -> Any:
    """A function of (n,) numbers as a pytree, with traced numbers among its leaves."""
    held = as_partial(function, name)
    if held is None:
        raise TypeError(f"{name}: got None, wanted a function of one state")
    shape = jax.ShapeDtypeStruct((n,), jnp.result_type(float))
    return opened(held, shape)


def _check_transform(found: Conjugated) -> None:
    """Refuse a Legendre transform that does not meet Fenchel's equality at some random states."""
    for x in np.random.default_rng(0).normal(size=(4, found.dim)):
        with own_settings(x64=True):
            p = found.start(jnp.asarray(x))[0]
            at_state, at_costate, product = float(found(jnp.asarray(x))), float(found.transform(p)), float(p @ x)
        if not abs(at_state + at_costate - product) <= 1e-6 * (abs(at_state) + abs(at_costate) + abs(product)):
            raise ValueError(
                f"convex.smooth: at x = {x.tolist()} with the gradient p of J, J(x) + J*(p) is\n"
                f"{at_state + at_costate:.6g}, wanted p·x = {product:.6g}: this is not the Legendre transform of J"
            )


def _vector(value: Numbers | Sequence, name: str) -> Any:
    """One number per state."""
    array: Any = numbers(value, name)
    if np.ndim(array) != 1 or np.size(array) == 0:
        raise ValueError(f"{name}: got shape {np.shape(array)}, wanted (n,): one number per state")
    return array


def _number(value: Number, name: str) -> Any:
    """One finite number."""
    number = numbers(value, name)
    if np.ndim(number) != 0 or (not is_traced(number) and not math.isfinite(number)):
        raise ValueError(f"{name}: got {value!r}, wanted one finite number")
    return number
