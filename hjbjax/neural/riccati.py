"""The linear-quadratic value over a horizon, by the Riccati equation of the expansion about a fixed state x̄.

    V₂(t, x) = w + p·y + ½ y'Py,    y = x − x̄

With H(t, x, p) = min_u [L + f·p] and its derivatives at (t, x̄, p),

    −w' = H − βw,    −p' = H_x + P H_p − βp,    −P' = H_xx + H_xp P + P H_px + P H_pp P − βP

backward from the value and the derivatives of the terminal cost ψ at T. V₂ is exact if H is a quadratic polynomial of
(x, p) and ψ of x. Otherwise the third derivative of V, times H_p, is missing in P'.

SciPy integrates the equation with order 8. Its steps are divided, and V₂ is a cubic Hermite polynomial in time between
the resulting nodes. The derivatives at the nodes are those of the equation, so that V₂ solves it there.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.hamiltonian import pointwise
from hjbjax.hamiltonian.pointwise import Rule
from hjbjax.neural.ansatz import terminal_cost
from hjbjax.problem.problem import Problem
from hjbjax.problem.types import Array, Costate, Number, State

ACCURACY = 1e-11  # relative, of one step
DIVISIONS = 16  # nodes per step: the time derivative between the nodes is exact to about 1e-7
MOST = 2000  # steps; a solution that escapes to infinity takes more


class Coefficients(NamedTuple):
    """V₂ − V₂(T) over time.

    Attributes:
      nodes: the times, increasing from 0 to T, shape (k,).
      change: (w, p, P) minus their values at T, in one row per node, shape (k, 1 + n + n²).
      rates: the time derivatives of these rows.
    """

    nodes: np.ndarray
    change: np.ndarray
    rates: np.ndarray


def coefficients(problem: Problem, rule: Rule, center: State, horizon: float) -> Coefficients | None:
    """The solution of the Riccati equation, or None if it has none over the whole horizon.

    Args:
      problem: the settled problem.
      rule: the method for the minimum of H; there is no solution if the control jumps.
      center: x̄, shape (n,).
      horizon: T, in units of time.
    """
    from scipy.integrate import DOP853

    if rule.jumps:
        return None
    center = jnp.asarray(center)
    end = np.asarray(_at_end(problem, center, horizon))
    if not np.all(np.isfinite(end)):
        return None

    def backward(left: float, row: np.ndarray) -> np.ndarray:
        return -np.asarray(_rates(problem, rule, horizon - left, center, row))

    solver = DOP853(backward, 0.0, end, horizon, rtol=ACCURACY, atol=ACCURACY * (1e-3 + np.abs(end)))
    times, rows = [np.zeros(1)], [end[None]]
    with np.errstate(all="ignore"):
        for _ in range(MOST):
            solver.step()
            if solver.status == "failed" or not np.all(np.isfinite(solver.y)):
                return None
            within = np.linspace(solver.t_old, solver.t, DIVISIONS + 1)[1:]
            times.append(within)
            rows.append(solver.dense_output()(within).T)
            if solver.status == "finished":
                break
        else:
            return None
    left, found = np.concatenate(times), np.concatenate(rows)
    rates = np.stack([-backward(*each) for each in zip(left, found, strict=True)])
    return Coefficients((horizon - left)[::-1], (found - end)[::-1], rates[::-1])


@jax.jit
def _at_end(problem: Problem, center: State, horizon: Number) -> jax.Array:
    """(w, p, P) at T in one row: the value and the derivatives of ψ."""

    def psi(x: State) -> jax.Array:
        return terminal_cost(problem, horizon, x)

    return jnp.concatenate([psi(center)[None], jax.grad(psi)(center), jax.hessian(psi)(center).reshape(-1)])


def _rates_of(problem: Problem, rule: Rule, t: Number, center: State, row: Array) -> jax.Array:
    """(w', p', P') in one row."""
    n = center.shape[0]
    value, p, matrix = row[0], row[1 : 1 + n], row[1 + n :].reshape(n, n)

    def slopes(x: State, p: Costate) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        # H is least in u, so the derivative of u contributes nothing to the first derivatives, but to the second
        u = pointwise.minimiser(problem, rule, t, x, p)
        found, by_both = jax.value_and_grad(pointwise.hamiltonian, (2, 3))(problem, t, x, p, u)
        return found, by_both

    least, (by_x, by_p) = slopes(center, p)
    (xx, xp), (px, pp) = jax.jacfwd(lambda x, p: slopes(x, p)[1], (0, 1))(center, p)
    beta = problem.discount
    second = xx + xp @ matrix + matrix @ px + matrix @ pp @ matrix - beta * matrix
    return -jnp.concatenate(
        [(least - beta * value)[None], by_x + matrix @ by_p - beta * p, (second + second.T).reshape(-1) / 2]
    )


_rates = jax.jit(_rates_of, static_argnums=1)
