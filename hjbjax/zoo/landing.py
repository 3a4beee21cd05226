"""The Moon landing with the least fuel: ḣ = v, v̇ = −g + u/m, ṁ = −ku, 0 ≤ u ≤ U, from (h, v, m) to h = v = 0.

The optimal thrust is zero, then full. A coast changes neither the mass nor the energy E = ½v² + gh, so the landing
is determined by the burn that starts at mass m and brings E to zero. Let e^{−q} be the fraction of the mass that is
left after the burn. Its duration, initial velocity and initial height, and the equation for q, are

    τ = m(1 − e^{−q})/(kU),   v₁ = gτ − q/k,   h₁ = −v₁τ + ½gτ² − (m/(k²U))(1 − e^{−q}(1 + q)),   ½v₁² + g h₁ = E

and the fuel is m(1 − e^{−q}). A rocket that falls faster than v₁ crashes. The problem on a grid prescribes the value
of this formula in the region v ≤ v₁. A path that lands enters the region where its burn begins, so the value outside
the region does not change.
"""

import jax
import jax.numpy as jnp

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import Exact, Feedback, Scalar, answer, check_positive

NEWTON = 6  # Newton steps for √E, which is nearly linear in q, so convergence is quadratic from the first step
EXACT = 2  # the last steps carry derivatives: one for the first derivative, two for the second


@pytree_dataclass()
class Lander:
    """A rocket above the ground, state (h, v, m), control the upward thrust u.

    Args:
      thrust: U, larger than g·m, otherwise the rocket cannot hover.
      consumption: k, mass per unit of thrust and time.
      gravity: g.

    Example:
      >>> round(float(Lander().fuel(jnp.array([1.0, 0.0, 1.0]))), 4)
      0.4102
    """

    thrust: Number = 2.0
    consumption: Number = 0.3
    gravity: Number = 1.0

    def __post_init__(self) -> None:
        check_positive("Lander", thrust=self.thrust, consumption=self.consumption, gravity=self.gravity)

    def drift(self, x: State, u: Control) -> State:
        """(v, −g + u/m, −ku)."""
        return jnp.stack([x[1], -self.gravity + u[0] / x[2], -self.consumption * u[0]])

    def fuel_rate(self, x: State, u: Control) -> Number:
        """ku, mass per unit of time."""
        return self.consumption * u[0]

    def _ignition_point(self, q: Number, mass: Number) -> tuple[Number, Number, Number]:
        """Duration, initial velocity and initial height of the burn that leaves the fraction e^{−q} of the mass."""
        left, k = jnp.exp(-q), self.consumption
        duration = mass * (1 - left) / (k * self.thrust)
        # rocket equation: the exhaust speed is 1/k, so burning down to the fraction e^{−q} adds the velocity q/k
        velocity = self.gravity * duration - q / k
        # ∫(τ − s)·U/m(s) ds: the height gained by the thrust without gravity, from rest
        climbed = mass * (1 - left * (1 + q)) / (k * k * self.thrust)
        return duration, velocity, -velocity * duration + 0.5 * self.gravity * duration * duration - climbed

    def _log_ratio(self, x: State) -> Number:
        """The exponent q; zero at rest on the ground."""
        height, velocity, mass = x[0], x[1], x[2]
        energy = 0.5 * velocity * velocity + self.gravity * height
        resting = energy <= 0
        energy = jnp.where(resting, 1.0, energy)  # √0 has no derivative, and JAX differentiates both branches
        pull = self.thrust / mass
        # with constant mass E = v²/2 · U/(U − gm); a lighter rocket needs less. The divisor is at least a tenth of
        # the thrust, otherwise the initial guess is infinite when full thrust barely carries the weight
        q = self.consumption * jnp.sqrt(2 * energy * pull / jnp.maximum(pull - self.gravity, 0.1 * pull))
        for step in range(NEWTON):  # fixed count: a loop until convergence has no reverse-mode derivative
            if step == NEWTON - EXACT:
                # at the solution, one Newton step carries the first derivative of the implicit function, two the second
                q = jax.lax.stop_gradient(q)
            duration, first, start = self._ignition_point(q, mass)
            needed = 0.5 * first * first + self.gravity * start
            # ∂E/∂q = v₁ ∂v₁/∂q + g ∂h₁/∂q, with ∂τ/∂q, ∂v₁/∂q and ∂h₁/∂q in this order
            longer = mass * jnp.exp(-q) / (self.consumption * self.thrust)
            faster = self.gravity * longer - 1 / self.consumption
            higher = (
                -faster * duration - first * longer + self.gravity * duration * longer - q * longer / self.consumption
            )
            slope = first * faster + self.gravity * higher
            # Newton step for √needed − √energy, because √E is nearly linear in q and E is not; expanded by √needed
            q = q - 2 * (needed - jnp.sqrt(needed * energy)) / slope
        return jnp.where(resting, 0.0, q)

    def fuel(self, x: State) -> Scalar:
        """The least fuel to land, m(1 − e^{−q}); not meaningful for a rocket that falls too fast to land."""
        x = jnp.asarray(x)
        return x[2] * (1 - jnp.exp(-self._log_ratio(x)))

    def margin(self, x: State) -> Number:
        """v − v₁: positive while coasting, 0 where the burn must begin, negative if the rocket will crash."""
        return x[1] - self._ignition_point(self._log_ratio(x), x[2])[1]

    def least_fuel(self, x: State) -> Scalar:
        """The least fuel to land; infinite if the rocket will crash or is below the ground."""
        x = jnp.asarray(x)
        # rounding, in units of the exhaust speed 1/k: states where the burn begins and states at rest can land
        slack = 64 * jnp.finfo(jnp.result_type(x, jnp.float32)).eps
        exhaust = 1 / self.consumption
        late = self.margin(x) < -slack * (jnp.abs(x[1]) + exhaust)
        below = x[0] < -slack * (jnp.abs(x[0]) + exhaust * exhaust / self.gravity)
        return jnp.where(late | below, jnp.inf, self.fuel(x))

    def sinking(self, x: State) -> Number:
        """−v: reaches 0 at the end of the burn, where the rocket stands still."""
        return -x[1]

    def burn(self, x: State) -> Control:
        """Full thrust."""
        return jnp.full(1, self.thrust, jnp.result_type(x))  # in the state's precision

    def ignition(self, x: State) -> tuple[Number, Number]:
        """The time until the engine starts, and the duration of the burn."""
        x = jnp.asarray(x)
        # a coast changes v at the rate −g but neither mass nor energy, so v₁ stays the same
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

    The target is the set where a soft landing requires full thrust, or more than full thrust; the value is prescribed
    there. The solver finds the coast; a path ends where the engine starts, and ``moon_landing_burn`` continues it to
    the ground. To find the burn with ``pontryagin``, remove the target,
    ``dataclasses.replace(problem, target=None, exit_cost=None)``, and pass ``terminal=[0, 0, nan]``. ``pontryagin``
    does not know about the ground, so check h ≥ 0 along the path. States that rise close to the upper boundary h = 1.5
    leave the box.

    Args:
      thrust: U, the maximal thrust.
      consumption: k.
      gravity: g.
      shape: number of nodes in height, velocity and mass.
    """
    lander = Lander(thrust, consumption, gravity)
    problem = Problem(
        lander.drift,
        lander.fuel_rate,
        Box([0.0], [thrust]),  # the solver has to find that only the two extremes are optimal
        target=lander.margin,
        exit_cost=answer(lander.fuel),
        control_names=("thrust",),
    )
    return problem, Grid([0.0, -2.0, 0.3], [1.5, 0.5, 1.0], shape, names=("height", "velocity", "mass"))


@front_door
def moon_landing_burn(
    *, thrust: Number = 2.0, consumption: Number = 0.3, gravity: Number = 1.0
) -> tuple[Problem, Feedback]:
    """Build the final burn, which starts where the problem on the grid ends: full thrust until the rocket stands still.

    Args:
      thrust: U.
      consumption: k.
      gravity: g.

    Returns:
      The problem, whose target is v = 0, and the feedback.
    """
    lander = Lander(thrust, consumption, gravity)
    problem = Problem(
        lander.drift, lander.fuel_rate, Box([0.0], [thrust]), target=lander.sinking, control_names=("thrust",)
    )
    return problem, answer(lander.burn)


@front_door
def moon_landing_exact(*, thrust: Number = 2.0, consumption: Number = 0.3, gravity: Number = 1.0) -> Exact:
    """m(1 − e^{−q}) for the burn that dissipates the energy ½v² + gh; infinite where no landing is possible.

    In these states ``Lander.margin`` is negative, and ``moon_landing`` prescribes the number ``Lander.fuel`` instead.

    Args:
      thrust: U.
      consumption: k.
      gravity: g.
    """
    return answer(Lander(thrust, consumption, gravity).least_fuel)
