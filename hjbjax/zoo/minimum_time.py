"""Minimum time, in the discounted form of Kružkov.

    1 discounted at the rate β until the target: V = (1 − e^{−βT})/β        (8.14) for β = 1, T itself for β = 0

    double integrator   ẍ = u/m, |u| ≤ 1         T in closed form, switching on x₁ = −½m x₂|x₂|
    Zermelo             ẋ = c + s·u, |u| ≤ 1      the boat in a current

The target is the origin. A single node resolves it poorly (the value is only Hölder there), so the exact value is
held within ``radius``: by the dynamic programming principle the value elsewhere does not change. ``radius=0``
leaves the origin alone as the target.
"""

from collections.abc import Sequence

import jax.numpy as jnp

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.sets import Ball, Box
from hjbjax.problem.types import Array, Control, Number, State
from hjbjax.zoo.ingredients import Arrival, Disc, Exact, Scalar, answer, positive, root, unit_cost


@pytree_dataclass()
class DoubleIntegrator:
    """A mass on a line under a force, state (position, velocity).

    Args:
      mass: m.
    """

    mass: Number = 1.0

    def __post_init__(self):
        positive("DoubleIntegrator", mass=self.mass)

    def drift(self, x: State, u: Control) -> State:
        """(x₂, u/m)."""
        return jnp.stack([x[1], u[0] / self.mass])  # mẍ = u

    def arrival_time(self, x: State) -> Scalar:
        """The least time to rest at the origin under |u| ≤ 1."""
        # in the coordinates m·x₁ and m·x₂ the mass is one
        position, velocity = self.mass * x[0], self.mass * x[1]
        # ≥ 0 right of the switching curve: first −1 until the curve is met, then +1 along it
        side = position + 0.5 * velocity * jnp.abs(velocity)
        sign = jnp.where(side >= 0, 1.0, -1.0)  # left of the curve the plane is mirrored; no jnp.sign, which is 0 on it
        # On the switching curve the root is |velocity|; rounding must not make its argument negative.
        # x₂ + 2√(x₁ + ½x₂²), the two arcs together, with the 2 under the root
        return sign * velocity + root(4 * sign * position + 2 * velocity * velocity)

    def switching_position(self, velocity: Number) -> Number:
        """x₁ on the switching curve x₁ = −½m x₂|x₂|; to its right the best force is −1, to its left +1."""
        return -0.5 * self.mass * velocity * jnp.abs(velocity)


@pytree_dataclass()
class Boat:
    """A boat in a constant current, state (x₁, x₂), control a velocity in the unit disc.

    Args:
      speed: s, of the boat through the water.
      current: c, of the water, two numbers.
    """

    speed: Number = 1.0
    current: Sequence[Number] | Array = (0.5, 0.0)

    def __post_init__(self):
        # of the current nothing is asked: it may be zero, or stronger than the boat
        positive("Boat", speed=self.speed)

    def drift(self, x: State, u: Control) -> State:
        """c + s·u."""
        return jnp.stack([self.current[0] + self.speed * u[0], self.current[1] + self.speed * u[1]])

    def arrival_time(self, x: State) -> Scalar:
        """The least T with |x + cT| = sT; infinite where a current stronger than the boat carries it past."""
        # the roots of (s² − |c|²)T² − 2(x·c)T − |x|² = 0, the least positive one, written without that leading term,
        # which is zero where boat and current are equally fast
        along = x[0] * self.current[0] + x[1] * self.current[1]
        square = x[0] * x[0] + x[1] * x[1]
        current = self.current[0] * self.current[0] + self.current[1] * self.current[1]
        inside = along * along + (self.speed * self.speed - current) * square
        below = root(inside) - along
        # inside < 0: the disc of radius sT around the drifting boat never holds the origin; below ≤ 0: only in the past
        reachable = (inside >= 0) & (below > 0)
        # a divisor of 1 where out of reach: the branch not taken is differentiated too
        time = jnp.where(reachable, square / jnp.where(reachable, below, 1.0), jnp.inf)
        return jnp.where(square == 0, 0.0, time)  # at the origin both are 0, which reads as out of reach above


@front_door
def double_integrator(
    *, mass: Number = 1.0, discount: Number = 1.0, radius: Number = 0.2, shape: tuple[int, ...] = (101, 101)
) -> tuple[Problem, Grid]:
    """Bring a mass to rest at the origin in the least time, |u| ≤ 1, on [−2, 2]²; figures 8 and 9 of the chapter.

    For ``pontryagin`` all the way to the origin leave the target out,
    ``dataclasses.replace(problem, target=None, exit_cost=None)``, and give ``terminal=[0, 0]``.

    Args:
      mass: m.
      discount: β; 1 is S = 1 − e^{−T} of (8.14), 0 is T itself.
      radius: the exact value is held within it; 0 leaves the node at the origin alone.
      shape: nodes; odd numbers put one at the origin.
    """
    exact = double_integrator_exact(mass=mass, discount=discount, radius=radius)
    problem = Problem(
        DoubleIntegrator(mass).drift,
        unit_cost,
        # the closed form is for |u| ≤ 1: a stronger force is a smaller mass
        Box([-1.0], [1.0]),
        discount=discount,
        target=Disc(radius, 2).level,
        exit_cost=exact,
        control_names=("force",),
        control_units=("N",),
    )
    return problem, Grid([-2.0, -2.0], [2.0, 2.0], shape, names=("position", "velocity"), units=("m", "m/s"))


@front_door
def double_integrator_exact(*, mass: Number = 1.0, discount: Number = 1.0, radius: Number = 0.2) -> Exact:
    """(1 − e^{−βT})/β with x₂ + √(4x₁ + 2x₂²) for T to the right of the switching curve, mirrored to its left.

    Args:
      mass: m.
      discount: β.
      radius: where the problem holds the value; the answer does not depend on it.
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
      speed: s, of the boat through the water.
      current: c, of the water, two numbers; where it is the stronger, states downstream never arrive.
      discount: β.
      radius: the exact value is held within it; 0 leaves the node at the origin alone.
      shape: nodes; odd numbers put one at the origin.
    """
    # the exit cost as well, which does not depend on the radius
    exact = zermelo_exact(speed=speed, current=current, discount=discount, radius=radius)
    problem = Problem(
        Boat(speed, current).drift,
        unit_cost,
        Ball(1.0, 2),
        discount=discount,
        target=Disc(radius, 2).level,
        exit_cost=exact,
        control_names=("course east", "course north"),
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
      discount: β; where T is infinite the value is 1/β.
      radius: where the problem holds the value; the answer does not depend on it.
    """
    return answer(Arrival(Boat(speed, current), discount).value)
