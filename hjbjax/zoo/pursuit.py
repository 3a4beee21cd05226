"""A boat in pursuit of a swimmer, whose rudder breaks at a random time."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.modes import Modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Disturbance, Number, State
from hjbjax.zoo.ingredients import TIME, Exact, Scalar, answer, check_positive, discounted_time, two_modes


@pytree_dataclass()
class Chase:
    """A boat that turns at most at the rate ω against a swimmer who flees along a shore.

    The state is the lead y of the swimmer along the shore and the angle φ between the boat's course and the shore. With
    |u| ≤ ω and |d| ≤ v < w

        y′ = d − w cos φ,    φ′ = u while the rudder works and 0 after it breaks.

    The boat catches the swimmer when |y| ≤ ℓ. A boat without a rudder needs T = (|y| − ℓ)/(± w cos φ − v), with the
    sign of y, and never arrives if the denominator is not positive.

    Args:
      speed: w of the boat.
      turn: ω.
      evasion: v, the speed of the swimmer.
      reach: ℓ.
    """

    speed: Number = 1.0
    turn: Number = 1.0
    evasion: Number = 0.4
    reach: Number = 0.2

    def __post_init__(self) -> None:
        check_positive("pursuit", speed=self.speed, turn=self.turn, evasion=self.evasion, reach=self.reach)
        if not is_traced(self.speed, self.evasion) and self.evasion >= self.speed:
            raise ValueError(
                f"pursuit: got evasion = {self.evasion}, wanted a speed below that of the boat, {self.speed}"
            )

    def drift(self, x: State, u: Control, d: Disturbance, mode: int) -> State:
        """The rates of change of the lead and of the course; mode 1 is a boat with a broken rudder."""
        return jnp.stack([d[0] - self.speed * jnp.cos(x[1]), (u[0], 0 * u[0])[mode]])

    def cost(self, x: State, u: Control, d: Disturbance, mode: int) -> Number:
        """One per unit of time."""
        return jnp.ones((), jnp.result_type(x))

    def capture(self, x: State, mode: int) -> Number:
        """|y| − ℓ, ≤ 0 where the swimmer is caught."""
        return jnp.abs(x[0]) - self.reach

    def drifting_time(self, x: State) -> Scalar:
        """The time until a boat without a rudder catches the swimmer; infinite if it does not."""
        lead, course = jnp.asarray(x)
        gap, closing = jnp.abs(lead) - self.reach, jnp.sign(lead) * self.speed * jnp.cos(course) - self.evasion
        arrives = closing > 0
        return jnp.where(gap <= 0, 0.0, jnp.where(arrives, gap / jnp.where(arrives, closing, 1.0), jnp.inf))


@pytree_dataclass()
class Adrift:
    """The discounted time (1 − e^{−βT})/β until a boat without a rudder catches the swimmer.

    Args:
      system: the boat and the swimmer.
      discount: β.
    """

    system: Chase
    discount: Number = 1.0

    def value(self, x: State) -> Scalar:
        """The value at one state."""
        return discounted_time(self.system.drifting_time(x), self.discount)


@front_door
def pursuit(
    *,
    speed: Number = 1.0,
    turn: Number = 1.0,
    evasion: Number = 0.4,
    reach: Number = 0.2,
    failure: Number = 0.2,
    discount: Number = 1.0,
    shape: tuple[int, ...] = (81, 80),
) -> tuple[Problem, Grid]:
    """Catch a swimmer with a boat whose rudder breaks at random, after which the boat keeps its course.

    V is the expected discounted time (1 − e^{−βT})/β until the capture, which the swimmer maximises. ``Adrift`` has its
    exact value in the mode "broken".

    Args:
      speed: w of the boat.
      turn: ω, the largest rate of turn of the boat.
      evasion: v, the speed of the swimmer, below w.
      reach: ℓ, the distance at which the swimmer is caught.
      failure: the rate at which the rudder breaks, per unit of time.
      discount: β.
      shape: number of nodes per axis.

    Example:
      >>> problem, grid = pursuit()
      >>> problem.modes.names, problem.is_game, grid.periodic
      (('steers', 'broken'), True, (False, True))
    """
    check_positive("pursuit", failure=failure, discount=discount)
    boat = Chase(speed, turn, evasion, reach)
    xp: Any = jnp if is_traced(turn, evasion) else np
    problem = Problem(
        boat.drift, boat.cost, Box(xp.asarray([-turn]), xp.asarray([turn])),
        disturbances=Box(xp.asarray([-evasion]), xp.asarray([evasion])), discount=discount, target=boat.capture,
        modes=Modes(("steers", "broken"), rates=two_modes(failure, 0.0)), control_names=("rudder",),
        value_name=f"V = E[{TIME}]",
    )  # fmt: skip
    grid = Grid(
        [-3.0, -np.pi], [3.0, np.pi], shape, periodic=(False, True), names=("lead", "course"), units=("", "rad")
    )
    return problem, grid


@front_door
def adrift_exact(*, speed: Number = 1.0, evasion: Number = 0.4, reach: Number = 0.2, discount: Number = 1.0) -> Exact:
    """The value of ``pursuit`` in the mode "broken" as a function of the lead and the course.

    Args:
      speed: w of the boat.
      evasion: v, the speed of the swimmer.
      reach: ℓ.
      discount: β.
    """
    return answer(Adrift(Chase(speed, 1.0, evasion, reach), discount).value)
