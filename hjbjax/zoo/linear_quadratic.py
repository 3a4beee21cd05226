"""Linear systems with quadratic costs, whose value solves a Riccati equation.

    double integrator   ẍ = u/m,              cost |x|² + u²,           V = x'Px + tr(σσ'P)/β
    stochastic          dx = (ax + u)dt + σ dw, cost qx² + ru², β > 0,  V = px² + σ²p/β
    game                ẋ = ax + u + d,       cost x² + u² − γ²d²,      V = px²

A discount β acts on the quadratic part like the drift A − ½βI. The values hold on the whole space. If trajectories
can leave the box, compare on its inner half, unless the problem prescribes the exact value at its ends.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Disturbance, Number, State
from hjbjax.zoo.ingredients import (
    Disc,
    Exact,
    OutsideCube,
    QuadraticCost,
    QuadraticValue,
    Scalar,
    admissible,
    answer,
    check_positive,
    noise_or_none,
)
from hjbjax.zoo.minimum_time import DoubleIntegrator


@pytree_dataclass()
class LinearScalar:
    """The scalar system ẋ = ax + u, or ẋ = ax + u + d with a disturbance.

    Args:
      rate: a, per unit time.
    """

    rate: Number = 0.0

    def drift(self, x: State, u: Control) -> State:
        """ax + u."""
        return self.rate * x + u

    def contested_drift(self, x: State, u: Control, d: Disturbance) -> State:
        """ax + u + d."""
        # u and d enter in the same way, so they combine to the weight 1 − γ⁻² in the Riccati equation
        return self.rate * x + u + d


@pytree_dataclass()
class GameCost:
    """The cost x² + u² − γ²d² for the attenuation level γ."""

    gamma: Number

    def rate(self, x: State, u: Control, d: Disturbance) -> Number:
        """Cost per unit time."""
        # the disturbance pays for its energy, so V is finite if and only if the L2 gain is below γ
        return jnp.sum(x * x) + jnp.sum(u * u) - self.gamma * self.gamma * jnp.sum(d * d)


@pytree_dataclass()
class ScalarQuadratic:
    """The value p|x|² + c: p is the stabilising root of state + (2a − β)p − (weight)p² = 0, and c = σ²p/β.

    Args:
      state: the weight q of x².
      weight: 1/r for one player with the control weight r, 1 − γ⁻² for the game.
      rate: a.
      discount: β.
      noise: σ.
    """

    state: Number
    weight: Number
    rate: Number
    discount: Number
    noise: Number = 0.0

    @property
    def curvature(self) -> Scalar:
        """The root p, in a form that stays finite when the weight is zero."""
        # the discount is a shift of the drift: 2ap − βp = 2(a − β/2)p
        shifted = self.rate - 0.5 * self.discount
        # q/(√(s² + wq) − s) instead of (√(s² + wq) + s)/w, because the game's weight 1 − γ⁻² is zero at γ = 1
        return self.state / (jnp.sqrt(shifted * shifted + self.weight * self.state) - shifted)

    def value(self, x: State) -> Scalar:
        """The value at one state."""
        x, p = jnp.asarray(x), self.curvature
        # divisors are never zero: JAX differentiates both branches of a where, and 0/0 would make the derivative NaN
        beta = jnp.where(self.discount == 0, 1.0, self.discount)
        # the noise adds ½σ²V″ = σ²p per unit time, which is σ²p/β in total; without noise it is zero for every β
        constant = jnp.where(jnp.asarray(self.noise) == 0, 0.0, self.noise * self.noise * p / beta)
        return p * jnp.sum(x * x) + constant


@front_door
def double_integrator_lq(
    *,
    mass: Number = 1.0,
    control_weight: Number = 1.0,
    noise: Number = 0.0,
    discount: Number = 0.0,
    bound: Number = 8.0,
    shape: tuple[int, ...] = (101, 101),
) -> tuple[Problem, Grid]:
    """Bring a mass to rest at the cost |x|² + r u², on [−2, 2]²; the exact value holds if the bound on u is not active.

    There is no discount by default, because rest at the origin costs nothing. With noise a discount is necessary.

    Args:
      mass: m.
      control_weight: r.
      noise: σ of both position and velocity.
      discount: β.
      bound: the bound on |u|.
      shape: number of nodes per axis; odd numbers put a node at the origin.
    """
    problem = Problem(
        DoubleIntegrator(mass).drift,
        QuadraticCost(1.0, control_weight).rate,
        Box([-bound], [bound]),  # with the defaults the optimal force is −x₁ − √3x₂, at most 5.5 on the box
        noise=noise_or_none(noise),  # σ times the identity
        discount=discount,
        control_names=("force",),
        control_units=("N",),
    )
    return problem, Grid([-2.0, -2.0], [2.0, 2.0], shape, names=("position", "velocity"), units=("m", "m/s"))


@front_door
def double_integrator_lq_exact(
    *, mass: float = 1.0, control_weight: float = 1.0, noise: float = 0.0, discount: float = 0.0, bound: float = 8.0
) -> Exact:
    """x'Px + σ² tr(P)/β, where |u| stays below the bound; computed by SciPy's Riccati solver, so not traceable.

    With the defaults P = [[√3, 1], [1, √3]].

    Args:
      mass: m.
      control_weight: r.
      noise: σ.
      discount: β; positive if there is noise.
      bound: the bound on |u|.

    Raises:
      ValueError: noise without a discount, or the bound is active on [−2, 2]².
    """
    # imported here, because nothing else in this file needs SciPy
    from scipy.linalg import solve_continuous_are

    a = np.array([[0.0, 1.0], [0.0, 0.0]]) - 0.5 * discount * np.eye(2)  # SciPy's equation has no discount
    b = np.array([[0.0], [1.0 / mass]])  # (2, 1), the force acts on the velocity
    matrix = solve_continuous_are(a, b, np.eye(2), control_weight * np.eye(1))
    constant = 0.0  # the noise changes only the constant c of V = x'Px + c: ½ tr(σσ'·2P) = βc
    if noise:
        # without a discount the noise costs ½ tr(σσ'·2P) per unit time indefinitely
        check_positive("double_integrator_lq with noise", discount=discount)
        constant = noise**2 * np.trace(matrix) / discount
    # u = −b'Px/r, largest at two corners of the box
    force = 2.0 * np.sum(np.abs(b.T @ matrix)) / control_weight
    admissible("double_integrator_lq", -bound, bound, " at a corner of the box", force=force)
    return answer(QuadraticValue(matrix, constant).value)


@front_door
def stochastic_lq(
    *,
    rate: Number = 0.0,
    state_weight: Number = 1.0,
    control_weight: Number = 1.0,
    noise: Number = 1.0,
    discount: Number = 1.0,
    bound: Number = 8.0,
    shape: tuple[int, ...] = (201,),
) -> tuple[Problem, Grid]:
    """Hold dx = (ax + u)dt + σ dw near zero at the cost qx² + ru², on [−2, 2].

    The exact value is prescribed at both ends. Otherwise the noise would spread the effect of the boundary.

    Args:
      rate: a.
      state_weight: q.
      control_weight: r.
      noise: σ.
      discount: β > 0.
      bound: the bound on |u|, not active on the box.
      shape: number of nodes.

    Raises:
      ValueError: a weight or the discount is not positive, or the bound is active, so the value at the ends is unknown.
    """
    exact = stochastic_lq_exact(
        rate=rate, state_weight=state_weight, control_weight=control_weight, noise=noise, discount=discount, bound=bound
    )
    problem = Problem(
        LinearScalar(rate).drift,
        QuadraticCost(state_weight, control_weight).rate,
        Box([-bound], [bound]),  # with the defaults |u| = p|x| is at most 1.3
        noise=noise_or_none(noise),
        discount=discount,
        # the ends of the box: the run stops there and pays the cost of continuing on the whole line
        target=OutsideCube(2.0).level,
        exit_cost=exact,
    )
    return problem, Grid([-2.0], [2.0], shape, names=("x",))


@front_door
def stochastic_lq_exact(
    *,
    rate: Number = 0.0,
    state_weight: Number = 1.0,
    control_weight: Number = 1.0,
    noise: Number = 1.0,
    discount: Number = 1.0,
    bound: Number = 8.0,
) -> Exact:
    """px² + σ²p/β on [−2, 2], where u = −px/r is admissible; with the defaults p = (√5 − 1)/2.

    Args:
      rate: a.
      state_weight: q > 0.
      control_weight: r > 0.
      noise: σ.
      discount: β > 0.
      bound: the bound on |u|.

    Raises:
      ValueError: a weight or the discount is not positive, or the bound is active on [−2, 2].
    """
    # without a discount c = σ²p/β is infinite; without q rest costs nothing, and p is 0/0 for 2a > β
    check_positive("stochastic_lq", state_weight=state_weight, control_weight=control_weight, discount=discount)
    quadratic = ScalarQuadratic(state_weight, 1.0 / control_weight, rate, discount, noise)
    if not is_traced(quadratic, bound):
        with jax.ensure_compile_time_eval():  # concrete numbers can be checked inside a jit of the caller, too
            push = 2.0 * quadratic.curvature / control_weight
            admissible("stochastic_lq", -bound, bound, " at the ends of the box", control=push)
    return answer(quadratic.value)


@front_door
def lq_game(
    *,
    gamma: Number = 2.0,
    rate: Number = 0.0,
    discount: Number = 0.0,
    bound: Number = 4.0,
    shape: tuple[int, ...] = (201,),
) -> tuple[Problem, Grid]:
    """Attenuate a disturbance to the level γ: ẋ = ax + u + d, cost x² + u² − γ²d², on [−1, 1].

    The run ends at the origin, where both players rest. Without a discount this makes the value unique.

    Args:
      gamma: the level γ; at or below the least attainable level (1 for a ≥ 0) the value is infinite.
      rate: a.
      discount: β.
      bound: the bound on |u| and |d|; it should not be active.
      shape: number of nodes; an odd number puts a node at the origin.
    """
    problem = Problem(
        LinearScalar(rate).contested_drift,
        GameCost(gamma).rate,
        Box([-bound], [bound]),  # with the defaults u = −px and d = px/γ² are at most 1.2 and 0.3
        disturbances=Box([-bound], [bound]),
        discount=discount,
        # V(0) = 0 selects the value among the solutions V + constant
        target=Disc(0.0, 1).level,  # the node at the origin only
    )
    return problem, Grid([-1.0], [1.0], shape, names=("x",))


@front_door
def lq_game_exact(*, gamma: Number = 2.0, rate: Number = 0.0, discount: Number = 0.0, bound: Number = 4.0) -> Exact:
    """px² with p = 1/(√(α² + 1 − γ⁻²) − α), α = a − β/2, on [−1, 1]; with the defaults p = 2/√3.

    Args:
      gamma: the level γ.
      rate: a.
      discount: β.
      bound: the bound on |u| and |d|.

    Raises:
      ValueError: the level is at or below the least attainable level, so the value is infinite; or u = −px or
        d = px/γ² exceeds the bound.
    """
    check_positive("lq_game", gamma=gamma)
    # traced numbers are not checked; at or below the least attainable level the formula then gives NaN or a wrong root
    if not is_traced(gamma, rate, discount):
        # coefficients of the equation in ``ScalarQuadratic`` with q = 1: 1 + 2·shifted·p − weight·p² = 0
        shifted, weight = rate - 0.5 * discount, 1 - gamma**-2
        # no real root, or no stabilising root
        if shifted**2 + weight < 0 or (weight <= 0 and shifted >= 0):
            raise ValueError(
                f"lq_game_exact: got gamma = {gamma:g}, wanted a level above the least attainable one "
                f"(1 if rate ≥ discount/2); below it the disturbance makes the cost infinite"
            )
    # no noise, so V = px² without a constant
    quadratic = ScalarQuadratic(1.0, 1 - gamma**-2, rate, discount)
    if not is_traced(quadratic, gamma, bound):
        with jax.ensure_compile_time_eval():
            p = quadratic.curvature
            admissible("lq_game", -bound, bound, " at the ends of the box", control=p, disturbance=p / gamma**2)
    return answer(quadratic.value)
