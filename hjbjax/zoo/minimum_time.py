"""Minimum-time problems in Kružkov's discounted form.

    running cost 1, discount β: V = (1 − e^{−βT})/β        (8.14) for β = 1, T itself for β = 0

    double integrator   ẍ = u/m, |u| ≤ 1         T in closed form, switching curve x₁ = −½m x₂|x₂|
    Zermelo             ẋ = c + s·u, |u| ≤ 1      a boat in a current

The target is the origin. One node resolves it poorly, because the value is only Hölder continuous there, so the
exact value is prescribed within ``radius``. By the dynamic programming principle the value elsewhere does not change.
With ``radius=0`` the target is the origin only.
"""

from collections.abc import Sequence

import jax.numpy as jnp

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.sets import Ball, Box
from hjbjax.problem.types import Array, Control, Number, State
from hjbjax.zoo.ingredients import TIME, Arrival, Disc, Exact, Scalar, answer, check_positive, root, unit_cost


@pytree_dataclass()
class DoubleIntegrator:
    """A mass on a line under a force, state (position, velocity).

    Args:
      mass: m.
    """

    mass: Number = 1.0

    def __post_init__(self) -> None:
        check_positive("DoubleIntegrator", mass=self.mass)

    def drift(self, x: State, u: Control) -> State:
        """(x₂, u/m)."""
        return jnp.stack([x[1], u[0] / self.mass])  # mẍ = u

    def arrival_time(self, x: State) -> Scalar:
        """The least time to rest at the origin under |u| ≤ 1."""
        # the coordinates m·x₁ and m·x₂ make the mass one
        position, velocity = self.mass * x[0], self.mass * x[1]
        # ≥ 0 right of the switching curve: u = −1 until the curve is reached, then u = +1 along it
        side = position + 0.5 * velocity * jnp.abs(velocity)
        sign = jnp.where(side >= 0, 1.0, -1.0)  # left of the curve, mirror the plane; jnp.sign would be 0 on the curve
        # x₂ + 2√(x₁ + ½x₂²), the time of both arcs, with the 2 moved under the root. On the switching curve the root
        # is |velocity|, and ``root`` protects against an argument that rounding makes negative.
        return sign * velocity + root(4 * sign * position + 2 * velocity * velocity)

    def switching_position(self, velocity: Number) -> Number:
        """x₁ on the switching curve x₁ = −½m x₂|x₂|; the optimal force is −1 to its right and +1 to its left."""
        return -0.5 * self.mass * velocity * jnp.abs(velocity)


@pytree_dataclass()
class Boat:
    """A boat in a constant current, state (x₁, x₂), control a velocity in the unit disc.

    Args:
      speed: s, the speed of the boat through the water.
      current: c, the velocity of the water, two numbers.
    """

    speed: Number = 1.0
    current: Sequence[Number] | Array = (0.5, 0.0)

    def __post_init__(self) -> None:
        # the current is not checked: it may be zero or stronger than the boat
        check_positive("Boat", speed=self.speed)

    def drift(self, x: State, u: Control) -> State:
        """c + s·u."""
        return jnp.stack([self.current[0] + self.speed * u[0], self.current[1] + self.speed * u[1]])

    def arrival_time(self, x: State) -> Scalar:
        """The least T with |x + cT| = sT; infinite if a current stronger than the boat carries it past the origin."""
        # the least positive root of (s² − |c|²)T² − 2(x·c)T − |x|² = 0, in the form that does not divide by the
        # leading coefficient, which is zero if boat and current are equally fast
        along = x[0] * self.current[0] + x[1] * self.current[1]
        square = x[0] * x[0] + x[1] * x[1]
        current = self.current[0] * self.current[0] + self.current[1] * self.current[1]
        inside = along * along + (self.speed * self.speed - current) * square
        below = root(inside) - along
        # inside < 0: the disc of radius sT around the drifting boat never contains the origin; below ≤ 0: T is negative
        reachable = (inside >= 0) & (below > 0)
        # the divisor is 1 where unreachable, because JAX differentiates both branches of a where
        time = jnp.where(reachable, square / jnp.where(reachable, below, 1.0), jnp.inf)
        return jnp.where(square == 0, 0.0, time)  # at the origin square = below = 0, which looks unreachable above


@front_door
def double_integrator(
    *, mass: Number = 1.0, discount: Number = 1.0, radius: Number = 0.2, shape: tuple[int, ...] = (101, 101)
) -> tuple[Problem, Grid]:
    """Bring a mass to rest at the origin in the least time, |u| ≤ 1, on [−2, 2]²; figures 8 and 9 of the chapter.

    To solve with ``pontryagin`` all the way to the origin, remove the target,
    ``dataclasses.replace(problem, target=None, exit_cost=None)``, and pass ``terminal=[0, 0]``.

    Args:
      mass: m.
      discount: β; 1 gives S = 1 − e^{−T} of (8.14), 0 gives T itself.
      radius: the exact value is prescribed within this radius; with 0 only the node at the origin is the target.
      shape: number of nodes per axis; odd numbers put a node at the origin.
    """
    exact = double_integrator_exact(mass=mass, discount=discount, radius=radius)
    problem = Problem(
        DoubleIntegrator(mass).drift,
        unit_cost,
        # the closed form is for |u| ≤ 1; a stronger force is equivalent to a smaller mass
        Box([-1.0], [1.0]),
        discount=discount,
        target=Disc(radius, 2).level,
        exit_cost=exact,
        control_names=("force",),
        control_units=("N",),
        value_name=f"V = {TIME} [s]",
    )
    return problem, Grid([-2.0, -2.0], [2.0, 2.0], shape, names=("position", "velocity"), units=("m", "m/s"))


@front_door
def double_integrator_exact(*, mass: Number = 1.0, discount: Number = 1.0, radius: Number = 0.2) -> Exact:
    """(1 − e^{−βT})/β with T = x₂ + √(4x₁ + 2x₂²) right of the switching curve, mirrored left of it (mass 1).

    Args:
      mass: m.
      discount: β.
      radius: accepted because ``double_integrator`` takes it; the value does not depend on it.
    """
    return answer(Arrival(DoubleIntegrator(mass), discount).value)


@front_door
def zermelo(
    *,
    speed: Number = 1.0,
    current: Sequence[Number] | Array = (0.5, 0.0),
    discount: Number = 1.0,
    radius: Number = 0.2,
    shape: tuple[int, ...] = (101, 101),
) -> tuple[Problem, Grid]:
    """Steer a boat through a constant current to the origin in the least time, on [−2, 2]².

    Args:
      speed: s, the speed of the boat through the water.
      current: c, the velocity of the water, two numbers; if it exceeds s, states downstream never arrive.
      discount: β.
      radius: the exact value is prescribed within this radius; with 0 only the node at the origin is the target.
      shape: number of nodes per axis; odd numbers put a node at the origin.
    """
    # also the exit cost; it does not depend on the radius
    exact = zermelo_exact(speed=speed, current=current, discount=discount, radius=radius)
    problem = Problem(
        Boat(speed, current).drift,
        unit_cost,
        Ball(1.0, 2),
        discount=discount,
        target=Disc(radius, 2).level,
        exit_cost=exact,
        control_names=("course east", "course north"),
        value_name=f"V = {TIME} [s]",
        time_unit="s",
    )
    return problem, Grid([-2.0, -2.0], [2.0, 2.0], shape, names=("east", "north"), units=("m", "m"))


@front_door
def zermelo_exact(
    *, speed: Number = 1.0, current: Sequence[Number] | Array = (0.5, 0.0), discount: Number = 1.0, radius: Number = 0.2
) -> Exact:
    """(1 − e^{−βT})/β with T = |x|²/(√((x·c)² + (s² − |c|²)|x|²) − x·c).

    Args:
      speed: s.
      current: c.
      discount: β; where T is infinite, the value is 1/β.
      radius: accepted because ``zermelo`` takes it; the value does not depend on it.
    """
    return answer(Arrival(Boat(speed, current), discount).value)
