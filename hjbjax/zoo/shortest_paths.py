"""Shortest paths: the eikonal equation, and a car that cannot turn on the spot.

    eikonal   ẋ = s·u, u in a ball, a box or ±e_i   the least time to the origin is a norm
    Dubins    ẋ = s(cos θ, sin θ), θ̇ = u

Both are minimum-time problems in the discounted form V = (1 − e^{−βT})/β.
"""

import math

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.sets import Ball, Box, Finite
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import TIME, Arrival, Disc, Exact, Scalar, answer, check_positive, root, unit_cost


# static, because the norm selects a formula
@pytree_dataclass(static=("norm",))
class SingleIntegrator:
    """A point that moves in any direction, ẋ = s·u, with u in the unit ball of ``norm``.

    Args:
      speed: s.
      norm: the norm that gives the time to the origin, 1, 2 or infinity.
    """

    speed: Number = 1.0
    norm: float = 2

    def __post_init__(self) -> None:
        check_positive("SingleIntegrator", speed=self.speed)

    def drift(self, x: State, u: Control) -> State:
        """s·u."""
        return self.speed * u  # the norm enters through the set of u, not through the drift

    def arrival_time(self, x: State) -> Scalar:
        """‖x‖/s."""
        if self.norm == 1:
            return jnp.sum(jnp.abs(x)) / self.speed
        # straight to the origin at full speed: the time is the norm whose unit ball contains the velocities
        return (root(jnp.sum(x * x)) if self.norm == 2 else jnp.max(jnp.abs(x))) / self.speed


@pytree_dataclass()
class Dubins:
    """A car at constant speed, state (x, y, heading), control the turning rate.

    Args:
      speed: s.
    """

    speed: Number = 1.0

    def __post_init__(self) -> None:
        check_positive("Dubins", speed=self.speed)

    def drift(self, x: State, u: Control) -> State:
        """(s cos θ, s sin θ, u)."""
        # the speed is fixed, so the car can neither stop nor reverse
        return jnp.stack([self.speed * jnp.cos(x[2]), self.speed * jnp.sin(x[2]), u[0]])


@front_door
def eikonal(
    *,
    norm: float = 2,
    dim: int = 2,
    speed: Number = 1.0,
    discount: Number = 1.0,
    radius: Number = 0.2,
    directions: int | None = None,
    shape: tuple[int, ...] | None = None,
) -> tuple[Problem, Grid]:
    """Find the shortest path to the origin, on [−1, 1]^dim.

    Args:
      norm: 2 for u in the unit ball, infinity for the box |u_i| ≤ 1, 1 for u = ±e_i.
      dim: the number of states.
      speed: s.
      discount: β.
      radius: the exact value is prescribed within this radius; with 0 only the node at the origin is the target.
      directions: with norm 2 in the plane, the number of directions on the circle that replace the unit ball.
      shape: number of nodes per axis; ``None`` is 81 per axis.

    Raises:
      ValueError: the norm is not 1, 2 or infinity, or directions are given outside the plane.
    """
    exact = eikonal_exact(norm=norm, dim=dim, speed=speed, discount=discount, radius=radius, directions=directions)
    problem = Problem(
        SingleIntegrator(speed, norm).drift,
        unit_cost,
        _unit_ball(norm, dim, directions),
        discount=discount,
        # Euclidean for every norm, because it only selects the nodes with the prescribed exact value
        target=Disc(radius, dim).level,
        exit_cost=exact,
        value_name=f"V = {TIME} [s]",
        time_unit="s",
    )
    # an odd number puts a node at the origin, which is the whole target for radius 0
    return problem, Grid([-1.0] * dim, [1.0] * dim, (81,) * dim if shape is None else shape, units=("m",) * dim)


@front_door
def eikonal_exact(
    *,
    norm: float = 2,
    dim: int = 2,
    speed: Number = 1.0,
    discount: Number = 1.0,
    radius: Number = 0.2,
    directions: int | None = None,
) -> Exact:
    """(1 − e^{−βT})/β with T = ‖x‖/s.

    Args:
      norm: the norm ‖·‖, 1, 2 or infinity.
      dim: the number of states.
      speed: s.
      discount: β.
      radius: accepted because ``eikonal`` takes it; the value does not depend on it.
      directions: accepted because ``eikonal`` takes it; the value is the one for the unit ball.
    """
    _unit_ball(norm, dim, directions)  # refuse the same arguments as eikonal
    return answer(Arrival(SingleIntegrator(speed, norm), discount).value)


def _unit_ball(norm: float, dim: int, directions: int | None) -> Ball | Box | Finite:
    """The admissible velocities at unit speed, the unit ball of ``norm``."""
    # for other norms the library has no set that is the unit ball
    if norm not in (1, 2, math.inf):
        raise ValueError(f"eikonal: got norm = {norm!r}, wanted 1, 2 or infinity")
    if directions is not None:
        if (dim, norm) != (2, 2):
            raise ValueError(f"eikonal: got directions with dim = {dim} and norm = {norm:g}, wanted 2 and 2")
        angles = 2 * np.pi * np.arange(directions) / directions  # without 2π, which would repeat the first direction
        # a path between two neighbouring directions zigzags and is longer than a straight line by up to 1/cos(π/n)
        return Finite(np.stack([np.cos(angles), np.sin(angles)], axis=-1))
    if norm == 1:
        # H is linear in u, so the 2·dim corners of the unit ball Σ|u_i| ≤ 1 are enough
        return Finite(np.concatenate([np.eye(dim), -np.eye(dim)]))
    return Ball(1.0, dim) if norm == 2 else Box([-1.0] * dim, [1.0] * dim)


@front_door
def dubins(
    *,
    speed: Number = 1.0,
    turn: Number = 1.0,
    radius: Number = 0.3,
    discount: Number = 1.0,
    shape: tuple[int, ...] = (41, 40, 40),
) -> tuple[Problem, Grid]:
    """Drive a Dubins car to a disc around the origin in the least time, with any heading, on [−2, 2]² × [−π, π).

    The value is discontinuous where the car just fails to turn into the disc. No exact value is provided.

    Args:
      speed: s.
      turn: the bound on |θ̇|; the tightest circle has radius s/turn.
      radius: the radius of the disc.
      discount: β.
      shape: number of nodes per axis; an even number in y puts the switch at y = 0 between two nodes.
    """
    problem = Problem(
        Dubins(speed).drift,
        unit_cost,
        # the fastest paths use only −turn, 0 and turn: arcs and straight lines
        Box([-turn], [turn]),
        discount=discount,
        target=Disc(radius, 2).level,  # with any heading; the default exit cost is zero
        control_names=("turning rate",),
        control_units=("rad/s",),
        value_name=f"V = {TIME} [s]",
    )
    # the heading is periodic, so its 40 nodes include −π but not π
    lo, hi = [-2.0, -2.0, -math.pi], [2.0, 2.0, math.pi]
    grid = Grid(lo, hi, shape, periodic=(False, False, True), names=("x", "y", "heading"), units=("m", "m", "rad"))
    return problem, grid
