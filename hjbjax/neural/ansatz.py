"""Values that contain a network and meet the data of a problem exactly, for any weights.

    rest point    V(x) = V₂(y) + |y|² N(y)             y = x − x̄, N(0) = 0
    horizon       V(t, x) = ψ(x) + V₂(t, y) − V₂(T, y) + (1 − t/T) (c + s N(t, x, ψ(x)))
    target        V(x) = ψ(x) + s max(l(x), 0) exp N(x)

V₂ = w̄ + p̄·y + ½ y'Py is the linear-quadratic solution at the rest point x̄. The network changes neither the value nor
the first two derivatives there, and |·|² is the norm of P itself, so the network is a relative correction. Under a
horizon T the value is the terminal cost ψ at t = T, and V₂ is the linear-quadratic solution at the center of the
states, see ``riccati``. The terminal cost is also an input of the network, which then needs few weights for a value
that is similar to a smoother ψ. With a target l ≤ 0 the value is the exit cost ψ on it, and larger outside.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.neural.network import Weights, evaluate_network
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, Number, Scalar, State

FLOOR = 0.01  # the least eigenvalue of the norm of the correction relative to the largest, in units of the box


@pytree_dataclass(static=("quadratic",))
class RestAnsatz:
    """The value near a rest point, with a network.

    Args:
      weights: the weights of the network.
      state: the rest point x̄, shape (n,).
      costate: p̄, shape (n,).
      value: w̄.
      matrix: P, shape (n, n).
      norm: the matrix of |y|², positive definite, shape (n, n).
      size: half the widths of the box, shape (n,).
      quadratic: False leaves out P. The network, times the mean of |y|², is then all of V beyond the first order.
    """

    weights: Weights
    state: Any
    costate: Any
    value: Any
    matrix: Any
    norm: Any
    size: Any
    quadratic: bool = True

    def __call__(self, problem: Problem | None, t: Number, x: State) -> Scalar:
        """V at one state."""
        y = x - self.state
        first, zero = self.value + self.costate @ y, jnp.zeros_like(y)
        shape = evaluate_network(self.weights, y / self.size)
        if self.quadratic:
            beyond = shape - evaluate_network(self.weights, zero)
            return jnp.asarray(first + y @ (self.matrix @ y) / 2 + (y @ (self.norm @ y)) * beyond)
        at_rest, slope = jax.jvp(lambda z: evaluate_network(self.weights, z), (zero,), (y / self.size,))
        scale = jnp.sum(jnp.diagonal(self.norm) * self.size**2) / 3
        return jnp.asarray(first + scale * (shape - at_rest - slope))


def norm_of(matrix: np.ndarray, size: np.ndarray) -> np.ndarray:
    """½ |P| as a positive definite matrix: the absolute eigenvalues in units of the box, with a floor."""
    sizes, vectors = np.linalg.eigh(matrix * np.outer(size, size) / 2)
    largest = float(np.max(np.abs(sizes), initial=0.0)) or 1.0
    scaled = (vectors * np.maximum(np.abs(sizes), FLOOR * largest)) @ vectors.T
    return scaled / np.outer(size, size)


@pytree_dataclass()
class HorizonAnsatz:
    """The value over a horizon, with a network.

    Args:
      weights: the weights of the network.
      horizon: T, in units of time.
      center: the middle of the states, shape (n,).
      size: the spread of the states, shape (n,).
      middle: the middle of ψ.
      spread: the spread of ψ.
      scale: s, the size of the difference of V and ψ.
      offset: c.
      fading: 1 if ψ fades linearly from T to 0, where noise makes V smoother than ψ; 0 if it does not.
      nodes: the times of the two arrays below, shape (k,); ``None`` without V₂.
      change: (w, p, P) of V₂ minus their values at T, in one row per node, shape (k, 1 + n + n²).
      rates: the time derivatives of these rows.
    """

    weights: Weights
    horizon: Any
    center: Any
    size: Any
    middle: Any
    spread: Any
    scale: Any
    offset: Any
    fading: Any = 0.0
    nodes: Any = None
    change: Any = None
    rates: Any = None

    def __call__(self, problem: Problem, t: Number, x: State) -> Scalar:
        """V at one time and state."""
        paid = terminal_cost(problem, self.horizon, x)
        left = 1 - jnp.asarray(t, x.dtype) / self.horizon
        inputs = jnp.concatenate(
            [jnp.stack([2 * left - 1, (paid - self.middle) / self.spread]), (x - self.center) / self.size]
        )
        change = 0.0 if self.nodes is None else self._quadratic_change(jnp.asarray(t, x.dtype), x - self.center)
        beyond = self.offset + self.scale * evaluate_network(self.weights, inputs) - self.fading * paid
        return paid + change + left * beyond

    def _quadratic_change(self, t: Array, y: State) -> jax.Array:
        """V₂(t, y) − V₂(T, y), with cubic polynomials in time between the nodes."""
        n = y.shape[0]
        nodes, values, rates = (jnp.asarray(each, y.dtype) for each in (self.nodes, self.change, self.rates))
        i = jnp.clip(jnp.searchsorted(nodes, t, method="compare_all") - 1, 0, nodes.shape[0] - 2)
        h = nodes[i + 1] - nodes[i]
        s = (t - nodes[i]) / h
        risen, bent = s * s * (3 - 2 * s), s * (1 - s)
        row = values[i] + risen * (values[i + 1] - values[i])
        row = row + h * bent * ((1 - s) * rates[i] - s * rates[i + 1])
        return row[0] + row[1 : 1 + n] @ y + y @ (row[1 + n :].reshape(n, n) @ y) / 2


@pytree_dataclass()
class TargetAnsatz:
    """The cost to a target, with a network.

    Args:
      weights: the weights of the network.
      center: the middle of the box, shape (n,).
      size: half the widths of the box, shape (n,).
      scale: s, the cost per unit of l.
    """

    weights: Weights
    center: Any
    size: Any
    scale: Any

    def __call__(self, problem: Problem, t: Number, x: State) -> Scalar:
        """V at one state, whose gradient on the boundary of the target is the limit from outside."""
        paid = problem.exit_cost
        if callable(paid):
            paid = paid(*problem.state_arguments(x, t))
        inside = target_level(problem, t, x)
        outside = inside + jax.lax.stop_gradient(jnp.maximum(inside, 0) - inside)
        growth = jnp.exp(evaluate_network(self.weights, (x - self.center) / self.size))
        return jnp.asarray(0.0 if paid is None else paid, x.dtype) + self.scale * outside * growth


def target_level(problem: Problem, t: Number, x: State) -> jax.Array:
    """l, which is ≤ 0 in the target, at one state; 1 without a target."""
    if problem.target is None:
        return jnp.ones((), x.dtype)
    return jnp.asarray(problem.target(*problem.state_arguments(x, t)), x.dtype)


def terminal_cost(problem: Problem, t: Number, x: State) -> jax.Array:
    """ψ at one state; zero without a terminal cost."""
    paid = problem.terminal_cost
    if callable(paid):
        paid = paid(*problem.state_arguments(x, t))
    return jnp.asarray(0.0 if paid is None else paid, x.dtype)
