"""The Hamiltonian at one state and costate, and the control that minimises it.

    H(t, x, p, u) = L(t, x, u) + f(t, x, u)·p,      u*(t, x, p) = argmin of H over the admissible set

Unlike on a grid there is no upwinding, so H has no kinks in u. The dependence of H on u is read from the jaxpr
(``dependence``) and selects the method:

    Finite                            enumerated
    Box, separable quadratic in u     the stationary point clipped, input by input; an end if H is affine or concave
    Ball, separable quadratic         −(2C + μ)⁻¹b with the multiplier μ ≥ 0 of the radius, by Newton's method
    Simplex, separable and convex     max(−l − τ, 0)/(2q) with the multiplier τ of the sum
    anything else                     samples, a pattern search, and Newton steps in the inputs that are not at a bound

If H is affine in an input of a box, u* jumps between the ends: that input is ``jumping``. Between enumerated controls
u* jumps too. Otherwise u* is a differentiable function of (x, p), except where the set of active bounds changes.
"""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.hamiltonian.ball import least_in_ball
from hjbjax.hamiltonian.search import Action, enumerate_actions, refine
from hjbjax.hamiltonian.simplex import least_in_simplex
from hjbjax.hamiltonian.simplex import project as onto_simplex
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Finite, Simplex, finite_ends, samples, spacing
from hjbjax.problem.types import Control, Costate, DType, Number, Scalar, State
from hjbjax.tracing import dependence

BUDGET = 64  # samples that start a search


@dataclasses.dataclass(frozen=True)
class Rule:
    """The method for the minimum of H, read from the jaxpr; hashable, so that it may be a static argument.

    Attributes:
      exact: True if the formulas above hold; False if a search is needed.
      jumping: the inputs of a box in which H is affine.
      finite: True if the controls are enumerated.
    """

    exact: bool
    jumping: tuple[int, ...] = ()
    finite: bool = False

    @property
    def jumps(self) -> bool:
        """True if u* is not a continuous function of the costate."""
        return self.finite or bool(self.jumping)


def rule_of(problem: Problem, n: int) -> Rule:
    """The rule for a problem's H, from the jaxprs of its drift and cost."""
    if isinstance(problem.controls, Finite):
        return Rule(exact=True, finite=True)
    assert problem.controls is not None
    inputs = tuple(range(problem.controls.dim))
    lengths = [(None, False)] * problem.time_dependent + [(n, False), (len(inputs), True)]
    functions = [problem.drift] if problem.cost is None else [problem.drift, problem.cost]
    found = [dependence.dependence(function, *lengths, dtype=jnp.result_type(float)) for function in functions]
    if not all(each.separable_quadratic_in(inputs) for each in found):
        return Rule(exact=False)
    # if neither function has a square of the input, H is affine in it: bang-bang
    straight = tuple(j for j in inputs if not any(each.has_square((j,)) for each in found))
    # over a ball the minimum of an affine H, −r b/|b|, turns with b and does not jump
    return Rule(exact=True, jumping=straight if isinstance(problem.controls, Box) else ())


def quadratic_with_noise(problem: Problem, n: int) -> tuple[bool, bool]:
    """True if L + f·p + ½ tr(σσᵀ M) is a separable quadratic in u for all p and M; and True if the noise depends on u.

    For a problem without an opponent and without a time.
    """
    dtype = np.dtype(np.float64)
    found = dependence.influence(problem, n, dtype)
    functions, noisy = [found.drift, found.cost], not found.noise.is_constant
    if noisy:
        covariance = jax.tree_util.Partial(_covariance, problem)
        functions.append(dependence.dependence(covariance, (n, False), (len(found.control), True), dtype=dtype))
    return all(each.separable_quadratic_in(found.control) for each in functions), noisy


def _covariance(problem: Problem, x: State, u: Control) -> jax.Array:
    """σσᵀ at one state."""
    sigma = problem.diffusion(x, u)
    return sigma @ sigma.T


def hamiltonian(problem: Problem, t: Number, x: State, p: Costate, u: Control | None) -> Scalar:
    """H(t, x, p, u) in cost units per unit time; ``x`` in the form that the problem's functions take."""
    arguments = problem.arguments(x, u, t=t)
    return running_cost(problem, t, x, u) + jnp.asarray(problem.drift(*arguments), p.dtype) @ p


def running_cost(problem: Problem, t: Number, x: State, u: Control | None) -> Scalar:
    """L(t, x, u) in cost per unit time; zero if the problem has no cost."""
    return jnp.asarray(0.0 if problem.cost is None else problem.cost(*problem.arguments(x, u, t=t)), x.dtype)


def corners(problem: Problem, rule: Rule) -> jax.Array:
    """The values between which u* jumps, shape (K, m); NaN in inputs of a box that do not jump."""
    if isinstance(problem.controls, Finite):
        return jnp.asarray(problem.controls.points)
    assert isinstance(problem.controls, Box)
    ends = [(problem.controls.lo[j], problem.controls.hi[j]) for j in rule.jumping]
    rows = []
    for choice in itertools.product(*ends):
        at = dict(zip(rule.jumping, choice, strict=True))
        rows.append(jnp.stack([jnp.asarray(at.get(j, jnp.nan), float) for j in range(problem.controls.dim)]))
    return jnp.stack(rows)


def at_corner(problem: Problem, rule: Rule, t: Number, x: State, p: Costate, corner: Control) -> Any:
    """The control with its jumping inputs as in ``corner``, and the others at their minimum."""
    if rule.finite or len(rule.jumping) == np.shape(corner)[-1]:
        return corner
    # H is separable in its inputs, so the minimum of the others does not depend on the corner
    chosen = jnp.array([j in rule.jumping for j in range(np.shape(corner)[-1])])
    return jnp.where(chosen, corner, minimiser(problem, rule, t, x, p))


def minimiser(problem: Problem, rule: Rule, t: Number, x: State, p: Costate) -> jax.Array:
    """The control u* that minimises H, shape (m,)."""
    assert problem.controls is not None
    return least(problem.controls, lambda u: hamiltonian(problem, t, x, p, u), rule.exact, p.dtype)


def least(
    admissible: AdmissibleSet, energy: Callable[[jax.Array], jax.Array], quadratic: bool, dtype: DType
) -> jax.Array:
    """The admissible u, shape (m,), that minimises a function of u.

    Args:
      admissible: the set.
      energy: the function of u (m,).
      quadratic: True if it is a sum of quadratic polynomials of one input each, so that the formulas hold.
      dtype: the type of u.
    """
    if isinstance(admissible, Finite):
        points = jnp.asarray(admissible.points, dtype)
        return points[jnp.argmin(jax.vmap(energy)(points))]
    if not quadratic:
        return _searched(admissible, energy, dtype)
    # gradient and second derivatives at zero are the coefficients
    zero = jnp.zeros(admissible.dim, dtype)
    slope, square = jax.grad(energy)(zero), jnp.diagonal(jax.hessian(energy)(zero)) / 2
    if isinstance(admissible, Box):
        lo, hi = (jnp.asarray(bound, dtype) for bound in finite_ends(admissible, dtype))
        return _in_box(lo, hi, slope, square)
    if isinstance(admissible, Simplex):
        return jax.lax.cond(
            jnp.all(square >= 0),
            lambda: jnp.stack(least_in_simplex(admissible, list(slope), list(square))),
            lambda: _searched(admissible, energy, dtype),  # a concave cost has local minima at all vertices
        )
    return jnp.stack(least_in_ball(jnp.asarray(admissible.radius, dtype), list(slope), list(square)))


def _in_box(lo: Control, hi: Control, slope: Control, square: Control) -> jax.Array:
    """The minimum of b·u + Σ c_j u_j², input by input."""
    convex = square > 0
    inner = jnp.clip(-slope / jnp.where(convex, 2 * square, 1), lo, hi)
    # affine or concave: the better end, or the lower one if both are equally good
    end = jnp.where(slope * lo + square * lo * lo <= slope * hi + square * hi * hi, lo, hi)
    return jnp.where(convex, inner, end)


def _searched(admissible: AdmissibleSet | None, energy: Callable[[jax.Array], jax.Array], dtype: DType) -> jax.Array:
    """The minimum of H by samples, a pattern search, and Newton's method in the free inputs.

    The last Newton step provides the derivative of the implicit function, which the search does not have.
    """
    assert isinstance(admissible, (Box, Ball, Simplex))

    def project(action: Action) -> Action:
        if isinstance(admissible, Simplex):
            return onto_simplex(admissible, action)
        u = jnp.stack(action)
        if isinstance(admissible, Ball):
            # 1e-300 keeps the quotient finite at the centre, which does not move
            return list(u * jnp.minimum(1, admissible.radius / jnp.maximum(jnp.linalg.norm(u), 1e-300)))
        return list(jnp.clip(u, admissible.lo, admissible.hi))

    def objective(action: Action) -> tuple[jax.Array, list]:
        return energy(jnp.stack([jnp.asarray(entry, dtype) for entry in action])), []

    best = enumerate_actions(objective, jnp.asarray(samples(admissible, BUDGET), dtype), 1)
    u = jnp.stack(refine(objective, best, spacing(admissible, BUDGET), project, 1)[1])
    # each step starts from a number without a derivative, so only the last step has one
    for _ in range(3):
        u = jax.lax.stop_gradient(u)
        if isinstance(admissible, Simplex):
            u = _with_total(admissible, u)
        matrix, slope = _of_free_inputs(admissible, u, jax.grad(energy)(u), jax.hessian(energy)(u))
        # away from a minimum Newton's step may lead uphill; then the result of the search is kept
        convex = jnp.all(jnp.linalg.eigvalsh(jax.lax.stop_gradient(matrix)) > 0)
        step = jnp.linalg.solve(matrix, slope)
        moved = jnp.stack(project(list(u - step)))
        if isinstance(admissible, Simplex):  # on its boundary the projection has a kink: zeros stay, others move on
            change = u - step - jax.lax.stop_gradient(u - step)
            moved = jax.lax.stop_gradient(moved)
            moved = moved + jnp.where(moved > 0, change, 0)
        u = jnp.where(convex, moved, u)
    return u


def _with_total(simplex: Simplex, u: jax.Array) -> jax.Array:
    """The same numbers, with a derivative by which the positive inputs share a change of the total."""
    some, full = _positive(simplex, u)
    change = simplex.total - jax.lax.stop_gradient(simplex.total)
    return u + jnp.where(full, some * change / jnp.maximum(jnp.sum(some), 1), 0)


def _positive(simplex: Simplex, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """1 for the positive inputs and 0 for the others, and True if the sum is the total."""
    known, total = jax.lax.stop_gradient((u, simplex.total))
    return (known > 1e-6 * total).astype(u.dtype), (jnp.sum(known) >= total * (1 - 1e-6)) | (not simplex.at_most)


def _of_free_inputs(
    admissible: Box | Ball | Simplex, u: jax.Array, gradient: jax.Array, bend: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The matrix and the gradient of Newton's step in the directions that no bound blocks."""
    eye = jnp.eye(admissible.dim, dtype=u.dtype)
    if isinstance(admissible, Simplex):
        some, full = _positive(admissible, u)
        # the projection onto these directions, which keep the sum if it is the total
        along = jnp.diag(some) - jnp.where(full, jnp.outer(some, some) / jnp.maximum(jnp.sum(some), 1), 0)
        return along @ bend @ along + eye - along, along @ gradient
    # an input at its bound stays there: its row becomes a row of the identity with a zero right-hand side
    if isinstance(admissible, Ball):
        free = jnp.full(admissible.dim, jnp.linalg.norm(u) < admissible.radius * (1 - 1e-6))
    else:
        room = 1e-6 * (admissible.hi - admissible.lo)
        free = (u > admissible.lo + room) & (u < admissible.hi - room)
    return jnp.where(free[:, None] & free[None, :], bend, eye), jnp.where(free, gradient, 0)
