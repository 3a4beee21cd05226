"""The rest point at which an infinite horizon ends, and the value near it from a Riccati equation.

At a rest point of the Hamiltonian flow f(x̄, ū) = 0 and βp̄ = H_x, where ū minimises H. To second order the value is
w̄ + p̄·y + ½ y'Py with y = x − x̄. With A = f_x, and B = f_u for the inputs that are not at a bound, P solves

    P(A − ½βI) + (A − ½βI)'P + H_xx − (PB + H_xu) H_uu⁻¹ (B'P + H_ux) = 0,        w̄ = L(x̄, ū)/β

The closed loop is ẏ = (A − B H_uu⁻¹(B'P + H_ux)) y. A path may be truncated once it is near the rest point.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.extremals.boundary_value import BoundaryValueProblem, Rest
from hjbjax.hamiltonian import pointwise
from hjbjax.problem.sets import Ball, Box
from hjbjax.problem.types import Array, Control, Costate, State

NEAR = 1e-8  # relative to the terms of ẋ and ṗ: smaller rates count as rest
FREE_OF_CHARGE = 1e-10  # relative to L: a smaller cost at rest counts as zero; rest points are found to about 1e-13
FREE = 1e-9  # relative to the width of its range: an input closer to an end is at a bound


@jax.jit
def _rest_rates(bvp: BoundaryValueProblem, y: Array) -> jax.Array:
    """(ẋ, ṗ) at (x, p), shape (2n,), at time 0, because a problem with infinite horizon is autonomous."""
    # w = 0, because neither ẋ nor ṗ depends on the cost to go
    return bvp.flow(0.0, jnp.append(y, 0.0), bvp.arcs[0])[:-1]


_rest_slopes = jax.jit(jax.jacfwd(_rest_rates, 1))


@jax.jit
def _expansion(bvp: BoundaryValueProblem, x: State, p: Costate) -> dict[str, jax.Array]:
    """The minimising control at a state and costate, H to second order there, and the drift to first order."""
    problem = bvp.problem
    u = pointwise.minimiser(problem, bvp.rule, 0.0, bvp.wrap(x), p)

    def energy(x: State, u: Control) -> jax.Array:
        return bvp.hamiltonian(0.0, x, p, u)

    def drift(x: State, u: Control) -> jax.Array:
        return jnp.asarray(problem.drift(*problem.arguments(bvp.wrap(x), u)), p.dtype)

    # at fixed u, because the Riccati equation minimises over u itself
    (xx, xu), (_, uu) = jax.hessian(energy, (0, 1))(x, u)
    by_state, by_control = jax.jacfwd(drift, (0, 1))(x, u)
    cost = pointwise.running_cost(problem, 0.0, bvp.wrap(x), u)
    return {"u": u, "a": by_state, "b": by_control, "xx": xx, "xu": xu, "uu": uu, "cost": cost}


def find(bvp: BoundaryValueProblem, near: State, costate: Costate) -> tuple[Rest, float]:
    """Find the rest point near a state, and the slowest rate of the closed loop there, per unit time.

    Raises:
      ValueError: there is no rest point, it has a running cost, or the Riccati equation has no stabilising solution.
    """
    from scipy.linalg import LinAlgError, solve_continuous_are
    from scipy.optimize import root

    n = len(near)
    first, states = np.append(near, costate), np.maximum(np.abs(near), np.abs(bvp.start))
    units, terms = (np.where((part > 0) & np.isfinite(part), part, 1) for part in _sizes(bvp, first, states))
    # Powell's hybrid method with exact slopes, in scaled units, because costates may differ by a factor of 1e12
    with np.errstate(all="ignore"):
        found = root(
            lambda z: _on_host(_rest_rates, bvp, z * units) / terms, first / units,
            jac=lambda z: _on_host(_rest_slopes, bvp, z * units) * units / terms[:, None], tol=1e-13,
        ).x * units  # fmt: skip
    left = _share_left(bvp, found, states)
    if not left < NEAR:
        raise ValueError(
            f"pontryagin: found no rest point of the Hamiltonian flow near x = {near.tolist()} (the residual is "
            f"{left:.2g} of its terms); an infinite horizon ends at a rest point: pass rest=, or a horizon"
        )
    x, p = found[:n], found[n:]
    at = {name: np.asarray(part) for name, part in _expansion(bvp, x, p).items()}
    beta = float(bvp.problem.discount)
    # without a discount any cost at rest adds up to infinity, so only rounding counts as zero
    if beta == 0 and abs(at["cost"]) > FREE_OF_CHARGE * _cost_size(bvp, x, at):
        raise ValueError(
            f"pontryagin: the rest point x = {x.tolist()} costs {at['cost']:.3g} per unit time without a discount, so "
            "an infinite horizon costs infinitely much: shift the cost, or add a discount or a horizon"
        )
    free = _free(bvp, at["u"])
    # with e^{−βt/2} absorbed into the state, A becomes A − ½βI and the equation has no discount
    shifted = at["a"] - beta / 2 * np.eye(n)
    try:
        matrix = solve_continuous_are(
            shifted, at["b"][:, free], at["xx"], at["uu"][np.ix_(free, free)], s=at["xu"][:, free]
        )
    except (LinAlgError, ValueError) as error:
        raise ValueError(
            f"pontryagin: the Riccati equation at the rest point x = {x.tolist()} has no stabilising solution "
            f"({error}); pass a horizon, or terminal="
        ) from None
    # A instead of A − ½βI: a discounted value may be finite although the paths diverge and never come to rest
    gain = np.linalg.solve(at["uu"][np.ix_(free, free)], at["b"][:, free].T @ matrix + at["xu"][:, free].T)
    slowest = -float(np.max(np.linalg.eigvals(at["a"] - at["b"][:, free] @ gain).real))
    if not slowest > 0:
        raise ValueError(
            f"pontryagin: with the discount {beta:g} the optimal closed loop does not return to the rest point "
            f"x = {x.tolist()} (its slowest rate is {slowest:.3g}); pass a horizon"
        )
    value = at["cost"] / beta if beta else 0.0
    return Rest(x, p, np.asarray(value), matrix), slowest


def _sizes(bvp: BoundaryValueProblem, y: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of x and p near (x, p), and of the terms of ẋ and ṗ, both of shape (2n,).

    States that are zero at the rest point may be large along the path, and costates may be zero there. They get the
    size that states of the given sizes give them through the slopes within the shortest time constant 1/ρ.

    Args:
      bvp: the boundary-value problem.
      y: (x, p), shape (2n,).
      states: sizes of the states along the path, shape (n,).
    """
    slopes = _on_host(_rest_slopes, bvp, y)
    sizes = np.maximum(np.abs(y), np.append(states, np.zeros(len(states))))
    if not np.all(np.isfinite(slopes)):
        return sizes, sizes
    fastest = np.max(np.abs(np.linalg.eigvals(slopes)), initial=0)
    for _ in range(len(y) if fastest > 0 else 0):
        sizes = np.maximum(sizes, np.abs(slopes) @ sizes / fastest)
    return sizes, np.maximum(np.abs(slopes) @ sizes, fastest * sizes)


def _share_left(bvp: BoundaryValueProblem, y: np.ndarray, states: np.ndarray) -> float:
    """The largest |ẋ| or |ṗ| at (x, p) relative to its terms; infinite if a nonzero rate has no terms."""
    rates, terms = np.abs(_on_host(_rest_rates, bvp, y)), _sizes(bvp, y, states)[1]
    with np.errstate(all="ignore"):
        return float(np.max(np.where(rates == 0, 0, rates / terms)))


def _cost_size(bvp: BoundaryValueProblem, rest: State, at: dict[str, np.ndarray]) -> float:
    """The size of L, in cost units per unit time, at the start and from its quadratic part near the rest point."""
    x, u = np.maximum(np.abs(rest), np.abs(bvp.start)), np.abs(at["u"])
    squares = x @ np.abs(at["xx"]) @ x + u @ np.abs(at["uu"]) @ u
    start = pointwise.running_cost(bvp.problem, 0.0, bvp.wrap(jnp.asarray(bvp.start)), jnp.asarray(at["u"]))
    return max(abs(float(start)), float(squares) / 2)


def _on_host(
    function: Callable[[BoundaryValueProblem, Array], jax.Array], bvp: BoundaryValueProblem, y: Array
) -> np.ndarray:
    """The result of a compiled function as a NumPy array, for SciPy."""
    return np.asarray(function(bvp, y))


def _free(bvp: BoundaryValueProblem, u: np.ndarray) -> np.ndarray:
    """The indices of the inputs that are not at a bound.

    Raises:
      ValueError: all inputs are at a bound, so no control is available near the rest point.
    """
    admissible = bvp.problem.controls
    if isinstance(admissible, Ball):  # one constraint for all inputs: on the sphere no input is free
        inside = np.full(len(u), np.linalg.norm(u) < admissible.radius * (1 - FREE))
    else:
        assert isinstance(admissible, Box)  # enumerated controls jump, so there is no Riccati equation
        room = FREE * (np.asarray(admissible.hi) - np.asarray(admissible.lo))
        inside = (u > admissible.lo + room) & (u < admissible.hi - room)
    if not inside.any():
        raise ValueError(
            f"pontryagin: at the rest point the control {u.tolist()} is at its bound, where the Riccati equation does "
            "not hold; pass a horizon"
        )
    return np.flatnonzero(inside)
