"""Linear systems with quadratic costs: the Riccati equation knows the answer.

    double integrator   ẍ = u/m,              cost |x|² + u²,           V = x'Px + tr(σσ'P)/β
    stochastic          dx = (ax + u)dt + σ dw, cost qx² + ru², β > 0,  V = px² + σ²p/β
    game                ẋ = ax + u + d,       cost x² + u² − γ²d²,      V = px²

A discount β acts on the quadratic part like the drift A − ½βI. The answers hold on the whole space: where the box
is left, compare on its inner half, unless the problem holds its ends at the exact value.
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
    noise_or_none,
    positive,
)
from hjbjax.zoo.minimum_time import DoubleIntegrator


@pytree_dataclass()
class LinearScalar:
    """The scalar system ẋ = ax + u, or ẋ = ax + u + d with an opponent.

    Args:
      rate: a, per unit time.
    """

    rate: Number = 0.0

    def drift(self, x: State, u: Control) -> State:
        """ax + u."""
        return self.rate * x + u

    def contested_drift(self, x: State, u: Control, d: Disturbance) -> State:
        """ax + u + d."""
        # u and d enter alike: in the Riccati equation they combine to the one weight 1 − γ⁻²
        return self.rate * x + u + d


@pytree_dataclass()
class GameCost:
    """The cost x² + u² − γ²d² of the attenuation level γ."""

    gamma: Number

    def rate(self, x: State, u: Control, d: Disturbance) -> Number:
        """Cost per unit time."""
        # what the disturbance spends is counted against it: V is finite if and only if the gain is below γ
        return jnp.sum(x * x) + jnp.sum(u * u) - self.gamma * self.gamma * jnp.sum(d * d)


@pytree_dataclass()
class ScalarQuadratic:
    """The value p|x|² + c, with p the stabilising root of state + (2a − β)p − (weight)p² = 0 and c = σ²p/β.

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
        """The root p, written so that it stays finite where the weight vanishes."""
        # βp on the left takes β/2 from the drift on the right, 2ap − βp = 2(a − β/2)p
        shifted = self.rate - 0.5 * self.discount
        # q/(√(s² + wq) − s) in place of (√(s² + wq) + s)/w: the game's weight 1 − γ⁻² is zero at γ = 1
        return self.state / (jnp.sqrt(shifted * shifted + self.weight * self.state) - shifted)

    def value(self, x: State) -> Scalar:
        """The value at one state."""
        x, p = jnp.asarray(x), self.curvature
        # no divisor is ever zero: derivatives pass through both branches of a where, and 0/0 makes them NaN
        beta = jnp.where(self.discount == 0, 1.0, self.discount)
        # ½σ²V″ = σ²p is paid per unit time for ever, worth σ²p/β now; none without noise, whatever β is
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
    """Bring a mass to rest at the cost |x|² + r u², on [−2, 2]²; its answer holds where the bound on u is slack.

    Undiscounted by default: rest at the origin costs nothing. With noise it needs a discount.

    Args:
      mass: m.
      control_weight: r.
      noise: σ, on position and velocity alike.
      discount: β.
      bound: on |u|.
      shape: nodes; odd numbers put one at the origin.
    """
    problem = Problem(
        DoubleIntegrator(mass).drift,
        QuadraticCost(1.0, control_weight).rate,
        Box([-bound], [bound]),  # with the defaults the best force is −x₁ − √3x₂, at most 5.5 on the box
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
    """x'Px + σ² tr(P)/β where |u| stays below the bound, at least on [−2, 2]², by SciPy's Riccati solver; host level.

    With the defaults P = [[√3, 1], [1, √3]].

    Args:
      mass: m.
      control_weight: r.
      noise: σ.
      discount: β, positive where there is noise.
      bound: on |u|.

    Raises:
      ValueError: noise without a discount, or a bound that binds on the box.
    """
    # here: no other answer of this file needs it
    from scipy.linalg import solve_continuous_are

    a = np.array([[0.0, 1.0], [0.0, 0.0]]) - 0.5 * discount * np.eye(2)  # SciPy's equation knows no discount
    b = np.array([[0.0], [1.0 / mass]])  # (2, 1), the force acts on the velocity
    matrix = solve_continuous_are(a, b, np.eye(2), control_weight * np.eye(1))
    constant = 0.0  # of V = x'Px + c the noise changes c alone: ½ tr(σσ'·2P) = βc
    if noise:
        # undiscounted, noise would cost ½ tr(σσ'·2P) per unit time for ever
        positive("double_integrator_lq with noise", discount=discount)
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

    The ends are held at the exact value: noise would otherwise carry the effect of a wall into the box.

    Args:
      rate: a.
      state_weight: q.
      control_weight: r.
      noise: σ.
      discount: β > 0.
      bound: on |u|, slack on the box.
      shape: nodes.

    Raises:
      ValueError: a weight or a discount that is not positive; a bound that binds, so that the ends have no exact value.
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
        # the ends of the box alone; there the run ends, and pays what it would cost to go on
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
    """px² + σ²p/β on [−2, 2], whose ends hold it, where u = −px/r is admissible; with the defaults p = (√5 − 1)/2.

    Args:
      rate: a.
      state_weight: q > 0.
      control_weight: r > 0.
      noise: σ.
      discount: β > 0.
      bound: on |u|.

    Raises:
      ValueError: a weight or a discount that is not positive, or a bound that binds on the box.
    """
    # 1/r weighs p², and c = σ²p/β is infinite without a discount; without q rest costs nothing and p is 0/0 for 2a > β
    positive("stochastic_lq", state_weight=state_weight, control_weight=control_weight, discount=discount)
    quadratic = ScalarQuadratic(state_weight, 1.0 / control_weight, rate, discount, noise)
    if not is_traced(quadratic, bound):
        with jax.ensure_compile_time_eval():  # known numbers are looked at within somebody's jit, too
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

    The run ends at the origin, where both players rest; undiscounted, that is what makes the answer unique.

    Args:
      gamma: the level γ; at or below the least attainable one (1 for a ≥ 0) the value is infinite.
      rate: a.
      discount: β.
      bound: on |u| and |d|, to be slack.
      shape: nodes; an odd number puts one at the origin.
    """
    problem = Problem(
        LinearScalar(rate).contested_drift,
        GameCost(gamma).rate,
        Box([-bound], [bound]),  # with the defaults u = −px and d = px/γ² are at most 1.2 and .3
        disturbances=Box([-bound], [bound]),
        discount=discount,
        # no exit cost: V(0) = 0, and of all the solutions V + constant that one is singled out
        target=Disc(0.0, 1).level,  # the node at the origin alone
    )
    return problem, Grid([-1.0], [1.0], shape, names=("x",))


@front_door
def lq_game_exact(*, gamma: Number = 2.0, rate: Number = 0.0, discount: Number = 0.0, bound: Number = 4.0) -> Exact:
    """px² with p = 1/(√(α² + 1 − γ⁻²) − α), α = a − β/2, on [−1, 1]; with the defaults p = 2/√3.

    Args:
      gamma: the level γ.
      rate: a.
      discount: β.
      bound: on |u| and |d|.

    Raises:
      ValueError: the level is at or below the least one that can be attained, so there is no finite value; or u = −px
        or d = px/γ² is beyond the bound.
    """
    positive("lq_game", gamma=gamma)
    # of traced numbers no sign is known: below the level the formula then gives NaN or a wrong root
    if not is_traced(gamma, rate, discount):
        # the coefficients of the equation of ``ScalarQuadratic`` with q = 1: 1 + 2·shifted·p − weight·p² = 0
        shifted, weight = rate - 0.5 * discount, 1 - gamma**-2
        # no real root, or one that does not stabilise: the Riccati equation loses its solution at this level
        if shifted**2 + weight < 0 or (weight <= 0 and shifted >= 0):
            raise ValueError(
                f"lq_game_exact: got gamma = {gamma:g}, wanted a level above the least attainable one "
                f"(1 where rate ≥ discount/2): below it the disturbance makes the cost infinite"
            )
    # no noise, hence no constant: V = px²
    quadratic = ScalarQuadratic(1.0, 1 - gamma**-2, rate, discount)
    if not is_traced(quadratic, gamma, bound):
        with jax.ensure_compile_time_eval():
            p = quadratic.curvature
            admissible("lq_game", -bound, bound, " at the ends of the box", control=p, disturbance=p / gamma**2)
    return answer(quadratic.value)
