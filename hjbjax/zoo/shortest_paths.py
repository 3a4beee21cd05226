"""Shortest paths: the eikonal equation, and a car that cannot turn on the spot.

    eikonal   ẋ = s·u, u in a ball, a box or ±e_i   the least time to the origin is a norm
    Dubins    ẋ = s(cos θ, sin θ), θ̇ = u

Minimum time in the discounted form V = (1 − e^{−βT})/β.
"""

import math

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.sets import Ball, Box, Finite
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import Arrival, Disc, Exact, Scalar, answer, positive, root, unit_cost


# static: it chooses a formula, not a number in one
@pytree_dataclass(static=("norm",))
class SingleIntegrator:
    """A point that moves at will, ẋ = s·u, with u in the unit ball of ``norm``.

    Args:
      speed: s.
      norm: the norm in which the distance to the origin is the time: 1, 2 or infinity.
    """

    speed: Number = 1.0
    norm: float = 2

    def __post_init__(self):
        positive("SingleIntegrator", speed=self.speed)

    def drift(self, x: State, u: Control) -> State:
        """s·u."""
        return self.speed * u  # the set of u, not the drift, carries the norm

    def arrival_time(self, x: State) -> Scalar:
        """‖x‖/s."""
        if self.norm == 1:
            return jnp.sum(jnp.abs(x)) / self.speed
        # at full speed straight to the origin: the time is the norm whose unit ball the velocities fill
        return (root(jnp.sum(x * x)) if self.norm == 2 else jnp.max(jnp.abs(x))) / self.speed


@pytree_dataclass()
class Dubins:
    """A car at constant speed, state (x, y, heading), control the rate of turn.

    Args:
      speed: s.
    """

    speed: Number = 1.0

    def __post_init__(self):
        positive("Dubins", speed=self.speed)

    def drift(self, x: State, u: Control) -> State:
        """(s cos θ, s sin θ, u)."""
        # at full speed always: it can neither stop nor back up
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
        # Euclidean for every norm: only where the exact value is held, not what the distance is
        target=Disc(radius, dim).level,
        exit_cost=exact,
    )
    # odd: a node at the origin, which for radius 0 is the whole target
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
      norm: of ‖x‖: 1, 2 or infinity.
      dim: the number of states.
      speed: s.
      discount: β.
      radius: where the problem holds the value; the answer does not depend on it.
      directions: of the problem in the plane; the answer is that of the ball.
    """
    _unit_ball(norm, dim, directions)  # for its refusals: the answer exists where the problem does
    return answer(Arrival(SingleIntegrator(speed, norm), discount).value)


def _unit_ball(norm: float, dim: int, directions: int | None) -> Ball | Box | Finite:
    """The admissible velocities at unit speed: the unit ball of ``norm``."""
    # for other norms no set of the library is the unit ball
    if norm not in (1, 2, math.inf):
        raise ValueError(f"eikonal: got norm = {norm!r}, wanted 1, 2 or infinity")
    if directions is not None:
        if (dim, norm) != (2, 2):
            raise ValueError(f"eikonal: got directions with dim = {dim} and norm = {norm:g}, wanted 2 and 2")
        angles = 2 * np.pi * np.arange(directions) / directions  # the last is not the first once more
        # between two of n directions a path zigzags, and is longer than straight by up to 1/cos(π/n)
        return Finite(np.stack([np.cos(angles), np.sin(angles)], axis=-1))
    if norm == 1:
        # H is linear in u, so of the unit ball Σ|u_i| ≤ 1 its 2·dim corners are enough
        return Finite(np.concatenate([np.eye(dim), -np.eye(dim)]))
    return Ball(1.0, dim) if norm == 2 else Box([-1.0] * dim, [1.0] * dim)


@front_door
def dubins(
    *,
    speed: Number = 1.0,
    turn: Number = 1.0,
    radius: Number = 0.3,
    discount: Number = 1.0,
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
        # for fastest paths none but −turn, 0 and turn are used: arcs and straight lines
        Box([-turn], [turn]),
        discount=discount,
        target=Disc(radius, 2).level,  # in any heading; with no exact value beside it zero is held there
        control_names=("turning rate",),
        control_units=("rad/s",),
    )
    # the heading is periodic, and its 40 nodes omit π, which is −π
    lo, hi = [-2.0, -2.0, -math.pi], [2.0, 2.0, math.pi]
    grid = Grid(lo, hi, shape, periodic=(False, False, True), names=("x", "y", "heading"), units=("m", "m", "rad"))
    return problem, grid
