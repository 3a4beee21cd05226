"""Systems that switch between modes.

Thermostat      a heater with a cost of switching it on and off
Saving          consumption and saving with an income that changes at random
"""

from typing import Any

from hjbjax.problem.grid import Grid
from hjbjax.problem.modes import Modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import check_positive, two_modes


@pytree_dataclass()
class Thermostat:
    """A room that cools down, with a heater that is off (mode 0) or on (mode 1).

        dx = (−κ (x − x_out) + p·mode) dt + σ dw,    cost (x − x_set)² + q·mode per unit time

    Args:
      leak: κ, per unit time.
      outside: x_out, the temperature outside.
      heating: p, degrees per unit time.
      wanted: x_set.
      fuel: q, cost per unit time.
    """

    leak: Number = 0.2
    outside: Number = 5.0
    heating: Number = 5.0
    wanted: Number = 20.0
    fuel: Number = 1.0

    def drift(self, x: State, u: Control, mode: int) -> State:
        """The rate of change of the temperature."""
        return self.leak * (self.outside - x) + self.heating * mode

    def cost(self, x: State, u: Control, mode: int) -> Number:
        """Discomfort and fuel."""
        return (x[0] - self.wanted) ** 2 + self.fuel * mode


@front_door
def thermostat(
    *,
    leak: Number = 0.2,
    outside: Number = 5.0,
    heating: Number = 5.0,
    wanted: Number = 20.0,
    fuel: Number = 1.0,
    wear: Number = 2.0,
    noise: Number = 1.0,
    discount: Number = 0.1,
    shape: tuple[int, ...] = (201,),
) -> tuple[Problem, Grid]:
    """Hold a temperature with a heater whose switching costs ``wear``: it is switched on and off at two thresholds.

    Args:
      leak: κ, the rate at which the room cools down.
      outside: the temperature outside.
      heating: the power of the heater, degrees per hour.
      wanted: the temperature to hold.
      fuel: the cost of heating per hour.
      wear: the cost of switching, each way.
      noise: σ.
      discount: β.
      shape: number of nodes.

    Example:
      >>> problem, grid = thermostat()
      >>> problem.modes.names, grid.shape
      (('off', 'on'), (201,))
    """
    check_positive("thermostat", leak=leak, heating=heating, wear=wear, discount=discount)
    system = Thermostat(leak, outside, heating, wanted, fuel)
    modes = Modes(("off", "on"), switching_cost=two_modes(wear, wear))
    problem = Problem(system.drift, system.cost, noise=noise, discount=discount, modes=modes, time_unit="h")
    # the temperature continues beyond the box; a wall that reflects the noise would bend V there
    return problem, Grid([10.0], [30.0], shape, names=("temperature",), units=("°C",), edges="open")


@pytree_dataclass()
class Saving:
    """A household with a random income z, poor (mode 0) or rich (mode 1), that may borrow up to a limit.

        da = (z_mode + r a − c) dt,    utility c^{1−γ}/(1−γ)

    Source: S. R. Aiyagari, Q. J. Econ. 109 (1994); M. Huggett, J. Econ. Dyn. Control 17 (1993).

    Args:
      incomes: z, one per mode.
      interest: r.
      aversion: γ > 0, not 1.
    """

    incomes: Any = (0.1, 0.2)
    interest: Number = 0.03
    aversion: Number = 2.0

    def drift(self, a: State, c: Control, mode: int) -> State:
        """The rate of saving."""
        return self.incomes[mode] + self.interest * a - c

    def utility(self, a: State, c: Control, mode: int) -> Number:
        """The utility of consumption per unit time."""
        power = 1 - self.aversion
        return c[0] ** power / power


@front_door
def saving(
    *,
    incomes: tuple[Number, Number] = (0.1, 0.2),
    rates: tuple[Number, Number] = (1.2, 1.2),
    interest: Number = 0.03,
    aversion: Number = 2.0,
    discount: Number = 0.05,
    limit: Number = -0.1,
    most: Number = 2.0,
    shape: tuple[int, ...] = (500,),
) -> tuple[Problem, Grid]:
    """Consume and save with two incomes that alternate at random, above a borrowing limit.

    Args:
      incomes: z of the poor and of the rich, per unit time.
      rates: of becoming rich and of becoming poor, per unit time.
      interest: r, per unit time; below the discount.
      aversion: γ, the relative risk aversion; not 1.
      discount: ρ.
      limit: the least wealth.
      most: the wealth at the upper end of the box, where the drift must point inwards.
      shape: number of nodes.

    Example:
      >>> problem, grid = saving(shape=(50,))
      >>> problem.modes.names, grid.edges
      (('poor', 'rich'), (('constrained', 'constrained'),))
    """
    check_positive("saving", aversion=aversion, discount=discount)
    system = Saving(incomes, interest, aversion)
    problem = Problem(
        system.drift,
        controls=Box([0.2 * incomes[0]], [5 * incomes[1]]),
        reward=system.utility,
        discount=discount,
        modes=Modes(("poor", "rich"), rates=two_modes(*rates)),
        control_names=("consumption",),
        control_units=("1/year",),
    )
    return problem, Grid([limit], [most], shape, names=("wealth",), edges="constrained")
