"""The Moon landing with the least fuel: ḣ = v, v̇ = −g + u/m, ṁ = −ku, 0 ≤ u ≤ U, from (h, v, m) to h = v = 0.

The best thrust is none, then all. On a coast neither the mass nor the energy E = ½v² + gh changes, so the burn that
starts at mass m and brings E to zero is all there is to find. With e^{−q} the share of the mass that is left,

    τ = m(1 − e^{−q})/(kU),   v₁ = gτ − q/k,   h₁ = −v₁τ + ½gτ² − (m/(k²U))(1 − e^{−q}(1 + q)),   ½v₁² + g h₁ = E

are its duration, its first velocity and height, and the equation for q; the fuel is m(1 − e^{−q}). Who falls faster
than v₁ crashes. On a grid the value is held there, at the number that the same formula gives: a path that lands meets
the edge of that region where its burn begins, so the value elsewhere does not change.
"""

import jax
import jax.numpy as jnp

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import Exact, Feedback, Scalar, answer, positive

NEWTON = 6  # steps for the square root of E, which is nearly linear in q: quadratic from the first on
EXACT = 2  # of them, the last ones, carry derivatives: the first and the second


@pytree_dataclass()
class Lander:
    """A rocket above the ground, state (h, v, m), its thrust u upwards.

    Args:
      thrust: U, above g·m or it cannot hold itself.
      consumption: k, mass per unit of thrust and time.
      gravity: g.

    Example:
      >>> round(float(Lander().fuel(jnp.array([1.0, 0.0, 1.0]))), 4)
      0.4102
    """

    thrust: Number = 2.0
    consumption: Number = 0.3
    gravity: Number = 1.0

    def __post_init__(self):
        positive("Lander", thrust=self.thrust, consumption=self.consumption, gravity=self.gravity)

    def drift(self, x: State, u: Control) -> State:
        """(v, −g + u/m, −ku)."""
        return jnp.stack([x[1], -self.gravity + u[0] / x[2], -self.consumption * u[0]])

    def fuel_rate(self, x: State, u: Control) -> Number:
        """ku, mass per unit of time."""
        return self.consumption * u[0]

    def _ignition_point(self, q: Number, mass: Number) -> tuple[Number, Number, Number]:
        """Duration, first velocity and first height of the burn that leaves the share e^{−q} of a mass."""
        left, k = jnp.exp(-q), self.consumption
        duration = mass * (1 - left) / (k * self.thrust)
        # the rocket equation: a burn to the share e^{−q} gives q/k, with 1/k the speed of the exhaust
        velocity = self.gravity * duration - q / k
        # ∫(τ − s)·U/m(s) ds: what thrust alone would lift the rocket by, from rest
        climbed = mass * (1 - left * (1 + q)) / (k * k * self.thrust)
        return duration, velocity, -velocity * duration + 0.5 * self.gravity * duration * duration - climbed

    def _log_ratio(self, x: State) -> Number:
        """q; zero at rest on the ground."""
        height, velocity, mass = x[0], x[1], x[2]
        energy = 0.5 * velocity * velocity + self.gravity * height
        resting = energy <= 0
        energy = jnp.where(resting, 1.0, energy)  # √0 has no derivative, and the branch not taken is differentiated too
        pull = self.thrust / mass
        # with a constant mass E = v²/2 · U/(U − gm), and a lighter rocket needs less; where full thrust hardly holds
        # its weight the divisor stays a tenth of the thrust, or the first guess would be infinite
        q = self.consumption * jnp.sqrt(2 * energy * pull / jnp.maximum(pull - self.gravity, 0.1 * pull))
        for step in range(NEWTON):  # a fixed number: a loop until convergence would have no reverse derivative
            if step == NEWTON - EXACT:
                # at the solution one step of Newton's carries the implicit function's derivative, a second the next one
                q = jax.lax.stop_gradient(q)
            duration, first, start = self._ignition_point(q, mass)
            needed = 0.5 * first * first + self.gravity * start
            # ∂E/∂q = v₁ ∂v₁/∂q + g ∂h₁/∂q
            # ∂τ/∂q, ∂v₁/∂q and ∂h₁/∂q in turn
            longer = mass * jnp.exp(-q) / (self.consumption * self.thrust)
            faster = self.gravity * longer - 1 / self.consumption
            higher = (
                -faster * duration - first * longer + self.gravity * duration * longer - q * longer / self.consumption
            )
            slope = first * faster + self.gravity * higher
            # Newton's step for √needed − √energy, times √needed above and below: √E is nearly linear in q, E is not
            q = q - 2 * (needed - jnp.sqrt(needed * energy)) / slope
        return jnp.where(resting, 0.0, q)

    def fuel(self, x: State) -> Scalar:
        """The least fuel to land, m(1 − e^{−q}); for a rocket that falls too fast the number that the formula gives."""
        x = jnp.asarray(x)
        return x[2] * (1 - jnp.exp(-self._log_ratio(x)))

    def margin(self, x: State) -> Number:
        """v − v₁: how much faster it may yet fall; 0 where the burn has to begin, below it crashes."""
        return x[1] - self._ignition_point(self._log_ratio(x), x[2])[1]

    def least_fuel(self, x: State) -> Scalar:
        """The least fuel to land; infinite for a state that crashes, or is below the ground already."""
        x = jnp.asarray(x)
        # rounding, in units of the exhaust's speed 1/k: a state where the burn begins lands, and so does one at rest
        slack = 64 * jnp.finfo(jnp.result_type(x, jnp.float32)).eps
        exhaust = 1 / self.consumption
        late = self.margin(x) < -slack * (jnp.abs(x[1]) + exhaust)
        below = x[0] < -slack * (jnp.abs(x[0]) + exhaust * exhaust / self.gravity)
        return jnp.where(late | below, jnp.inf, self.fuel(x))

    def sinking(self, x: State) -> Number:
        """−v: 0 where the rocket stands still, at the end of the burn."""
        return -x[1]

    def burn(self, x: State) -> Control:
        """Full thrust."""
        return jnp.full(1, self.thrust, jnp.result_type(x))  # in the state's precision

    def ignition(self, x: State) -> tuple[Number, Number]:
        """When the engine starts, and how long it burns."""
        x = jnp.asarray(x)
        # a coast changes v at the rate −g, and neither mass nor energy, so that v₁ waits where it is
        return self.margin(x) / self.gravity, self._ignition_point(self._log_ratio(x), x[2])[0]


@front_door
def moon_landing(
    *,
    thrust: Number = 2.0,
    consumption: Number = 0.3,
    gravity: Number = 1.0,
    shape: tuple[int, ...] = (41, 51, 9),
) -> tuple[Problem, Grid]:
    """Land on the Moon with the least fuel, on [0, 1.5] × [−2, 0.5] × [0.3, 1]; 0 ≤ u ≤ thrust.

    The value is held where a soft landing takes full thrust or more; the grid has to find the coast, and a path on it
    ends where the engine starts: ``moon_landing_burn`` goes on from there to the ground. Give ``pontryagin`` the
    problem without its target, ``dataclasses.replace(problem, target=None, exit_cost=None)``, and the end
    ``terminal=[0, 0, nan]``, and it finds the burn as well; that one knows no ground, so look at h ≥ 0 along the path.
    Close to the ceiling, rising, the box is left.

    Args:
      thrust: U, the largest.
      consumption: k.
      gravity: g.
      shape: nodes in height, velocity and mass.
    """
    lander = Lander(thrust, consumption, gravity)
    problem = Problem(
        lander.drift,
        lander.fuel_rate,
        Box([0.0], [thrust]),  # all between as well: that none or all is best, the solver has to find
        target=lander.margin,
        exit_cost=answer(lander.fuel),
        control_names=("thrust",),
    )
    return problem, Grid([0.0, -2.0, 0.3], [1.5, 0.5, 1.0], shape, names=("height", "velocity", "mass"))


@front_door
def moon_landing_burn(
    *, thrust: Number = 2.0, consumption: Number = 0.3, gravity: Number = 1.0
) -> tuple[Problem, Feedback]:
    """The burn that follows where the grid's problem ends: full thrust until the rocket stands, on the ground.

    Args:
      thrust: U.
      consumption: k.
      gravity: g.

    Returns:
      The problem, which ends where v = 0, and the feedback.
    """
    lander = Lander(thrust, consumption, gravity)
    problem = Problem(
        lander.drift, lander.fuel_rate, Box([0.0], [thrust]), target=lander.sinking, control_names=("thrust",)
    )
    return problem, answer(lander.burn)


@front_door
def moon_landing_exact(*, thrust: Number = 2.0, consumption: Number = 0.3, gravity: Number = 1.0) -> Exact:
    """m(1 − e^{−q}), with q of the burn that takes away the energy ½v² + gh; infinite where no landing is possible.

    There, where ``Lander.margin`` is negative, ``moon_landing`` holds the number of ``Lander.fuel``, no answer.

    Args:
      thrust: U.
      consumption: k.
      gravity: g.
    """
    return answer(Lander(thrust, consumption, gravity).least_fuel)
