"""Minimum time, in the discounted form of Kružkov.

    1 discounted at the rate β until the target: V = (1 − e^{−βT})/β        (8.14) for β = 1, T itself for β = 0

    double integrator   ẍ = u/m, |u| ≤ 1                    T in closed form, switching on x₁ = −½m x₂|x₂|
    Zermelo             ẋ = c + s·u, |u| ≤ 1                 the boat in a current
    eikonal             ẋ = s·u, u in a ball, a box or ±e_i  T is a norm
    Dubins              ẋ = s(cos θ, sin θ), θ̇ = u           the car that cannot turn on the spot

The target is the origin. A single node resolves it poorly (the value is only Hölder there), so that the problems
with a known answer hold it within ``radius``: by the dynamic programming principle the value elsewhere does not
change. ``radius=0`` leaves the origin alone as the target.
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from hjbjax.grid import Grid
from hjbjax.problem import Problem
from hjbjax.pytree import node
from hjbjax.sets import Ball, Box, Finite
from hjbjax.zoo.ingredients import Arrival, Disc, answer, positive, unit_cost


@node()
class DoubleIntegrator:
    """A mass on a line under a force, state (position, velocity).

    Args:
      mass: m.
    """

    mass: Any = 1.0

    def __post_init__(self):
        positive("DoubleIntegrator", mass=self.mass)

    def drift(self, x: Any, u: Any) -> Any:
        """(x₂, u/m)."""
        return jnp.stack([x[1], u[0] / self.mass])

    def arrival_time(self, x: Any) -> Any:
        """The least time to rest at the origin under |u| ≤ 1."""
        position, velocity = self.mass * x[0], self.mass * x[1]
        side = position + 0.5 * velocity * jnp.abs(velocity)
        sign = jnp.where(side >= 0, 1.0, -1.0)
        # On the switching curve the root is |velocity|; rounding must not make its argument negative.
        return sign * velocity + jnp.sqrt(jnp.maximum(4 * sign * position + 2 * velocity * velocity, 0.0))

    def switching_position(self, velocity: Any) -> Any:
        """x₁ on the switching curve x₁ = −½m x₂|x₂|; to its right the best force is −1, to its left +1."""
        return -0.5 * self.mass * velocity * jnp.abs(velocity)


@node()
class Boat:
    """A boat in a constant current, state (x₁, x₂), control a velocity in the unit disc.

    Args:
      speed: s, of the boat through the water.
      current: c, of the water, two numbers.
    """

    speed: Any = 1.0
    current: Any = (0.5, 0.0)

    def __post_init__(self):
        positive("Boat", speed=self.speed)

    def drift(self, x: Any, u: Any) -> Any:
        """c + s·u."""
        return jnp.stack([self.current[0] + self.speed * u[0], self.current[1] + self.speed * u[1]])

    def arrival_time(self, x: Any) -> Any:
        """The least T with |x + cT| = sT; infinite where a current stronger than the boat carries it past."""
        along = x[0] * self.current[0] + x[1] * self.current[1]
        square = x[0] * x[0] + x[1] * x[1]
        current = self.current[0] * self.current[0] + self.current[1] * self.current[1]
        inside = along * along + (self.speed * self.speed - current) * square
        below = jnp.sqrt(jnp.maximum(inside, 0.0)) - along
        reachable = (inside >= 0) & (below > 0)
        time = jnp.where(reachable, square / jnp.where(reachable, below, 1.0), jnp.inf)
        return jnp.where(square == 0, 0.0, time)


@node(static=("norm",))
class SingleIntegrator:
    """A point that moves at will, ẋ = s·u, with u in the unit ball of the norm dual to ``norm``.

    Args:
      speed: s.
      norm: the norm in which the distance to the origin is the time: 1, 2 or infinity.
    """

    speed: Any = 1.0
    norm: float = 2

    def __post_init__(self):
        positive("SingleIntegrator", speed=self.speed)

    def drift(self, x: Any, u: Any) -> Any:
        """s·u."""
        return self.speed * u

    def arrival_time(self, x: Any) -> Any:
        """‖x‖/s."""
        if self.norm == 1:
            return jnp.sum(jnp.abs(x)) / self.speed
        return (jnp.sqrt(jnp.sum(x * x)) if self.norm == 2 else jnp.max(jnp.abs(x))) / self.speed


@node()
class Dubins:
    """A car at constant speed, state (x, y, heading), control the rate of turn.

    Args:
      speed: s.
    """

    speed: Any = 1.0

    def __post_init__(self):
        positive("Dubins", speed=self.speed)

    def drift(self, x: Any, u: Any) -> Any:
        """(s cos θ, s sin θ, u)."""
        return jnp.stack([self.speed * jnp.cos(x[2]), self.speed * jnp.sin(x[2]), u[0]])


def double_integrator(
    *, mass: Any = 1.0, discount: Any = 1.0, radius: Any = 0.2, shape: tuple[int, ...] = (101, 101)
) -> tuple[Problem, Grid]:
    """Bring a mass to rest at the origin in the least time, |u| ≤ 1, on [−2, 2]²; figures 8 and 9 of the chapter.

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
        Box([-1.0], [1.0]),
        discount=discount,
        target=Disc(radius, 2).level,
        exit_cost=exact,
    )
    return problem, Grid([-2.0, -2.0], [2.0, 2.0], shape, names=("position", "velocity"))


def double_integrator_exact(*, mass: Any = 1.0, discount: Any = 1.0, radius: Any = 0.2) -> Any:
    """(1 − e^{−βT})/β with x₂ + √(4x₁ + 2x₂²) for T to the right of the switching curve, mirrored to its left."""
    return answer(Arrival(DoubleIntegrator(mass), discount).value)


def zermelo(
    *,
    speed: Any = 1.0,
    current: Any = (0.5, 0.0),
    discount: Any = 1.0,
    radius: Any = 0.2,
    shape: tuple[int, ...] = (101, 101),
) -> tuple[Problem, Grid]:
    """Steer a boat through a constant current to the origin in the least time, on [−2, 2]²."""
    exact = zermelo_exact(speed=speed, current=current, discount=discount, radius=radius)
    problem = Problem(
        Boat(speed, current).drift,
        unit_cost,
        Ball(1.0, 2),
        discount=discount,
        target=Disc(radius, 2).level,
        exit_cost=exact,
    )
    return problem, Grid([-2.0, -2.0], [2.0, 2.0], shape, names=("east", "north"))


def zermelo_exact(*, speed: Any = 1.0, current: Any = (0.5, 0.0), discount: Any = 1.0, radius: Any = 0.2) -> Any:
    """(1 − e^{−βT})/β with T = |x|²/(√((x·c)² + (s² − |c|²)|x|²) − x·c)."""
    return answer(Arrival(Boat(speed, current), discount).value)


def eikonal(
    *,
    norm: float = 2,
    dim: int = 2,
    speed: Any = 1.0,
    discount: Any = 1.0,
    radius: Any = 0.2,
    directions: int | None = None,
    shape: tuple[int, ...] | None = None,
) -> tuple[Problem, Grid]:
    """The shortest way to the origin, on [−1, 1]^dim.

    Args:
      norm: 2 for u in the unit ball, infinity for the box |u_i| ≤ 1, 1 for u = ±e_i.
      dim: the number of states.
      speed: s.
      discount: β.
      radius: the exact value is held within it; 0 leaves the node at the origin alone.
      directions: in the plane with norm 2, as many directions around the circle instead of the ball.
      shape: nodes; ``None`` is 81 an axis.

    Raises:
      ValueError: a norm other than 1, 2 and infinity, or directions outside the plane.
    """
    exact = eikonal_exact(norm=norm, dim=dim, speed=speed, discount=discount, radius=radius, directions=directions)
    problem = Problem(
        SingleIntegrator(speed, norm).drift,
        unit_cost,
        _unit_ball(norm, dim, directions),
        discount=discount,
        target=Disc(radius, dim).level,
        exit_cost=exact,
    )
    return problem, Grid([-1.0] * dim, [1.0] * dim, (81,) * dim if shape is None else shape)


def eikonal_exact(
    *,
    norm: float = 2,
    dim: int = 2,
    speed: Any = 1.0,
    discount: Any = 1.0,
    radius: Any = 0.2,
    directions: int | None = None,
) -> Any:
    """(1 − e^{−βT})/β with T = ‖x‖/s."""
    _unit_ball(norm, dim, directions)
    return answer(Arrival(SingleIntegrator(speed, norm), discount).value)


def _unit_ball(norm: float, dim: int, directions: int | None) -> Ball | Box | Finite:
    if norm not in (1, 2, math.inf):
        raise ValueError(f"eikonal: got norm = {norm!r}, wanted 1, 2 or infinity")
    if directions is not None:
        if (dim, norm) != (2, 2):
            raise ValueError(f"eikonal: got directions with dim = {dim} and norm = {norm:g}, wanted 2 and 2")
        angles = 2 * np.pi * np.arange(directions) / directions
        return Finite(np.stack([np.cos(angles), np.sin(angles)], axis=-1))
    if norm == 1:
        return Finite(np.concatenate([np.eye(dim), -np.eye(dim)]))
    return Ball(1.0, dim) if norm == 2 else Box([-1.0] * dim, [1.0] * dim)


def dubins(
    *,
    speed: Any = 1.0,
    turn: Any = 1.0,
    radius: Any = 0.3,
    discount: Any = 1.0,
    shape: tuple[int, ...] = (41, 41, 40),
) -> tuple[Problem, Grid]:
    """Drive a Dubins car to a disc around the origin in the least time, in any heading, on [−2, 2]² × [−π, π).

    The value jumps where the car just fails to turn in; no answer is kept beside it.

    Args:
      speed: s.
      turn: the bound on |θ̇|; the car turns on circles of radius s/turn.
      radius: of the disc.
      discount: β.
      shape: nodes.
    """
    problem = Problem(
        Dubins(speed).drift,
        unit_cost,
        Box([-turn], [turn]),
        discount=discount,
        target=Disc(radius, 2).level,
    )
    lo, hi = [-2.0, -2.0, -math.pi], [2.0, 2.0, math.pi]
    return problem, Grid(lo, hi, shape, periodic=(False, False, True), names=("x", "y", "heading"))
