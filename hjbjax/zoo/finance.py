"""Finance problems with a known value.

    Merton          consumption and investment with constant relative risk aversion

A utility to be maximised enters as a cost with the opposite sign.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import Exact, OutsideCube, Scalar, admissible, answer, check_positive

SHARES = 0.0, 1.0  # no short selling, no borrowing
RATES = 0.01, 0.1  # bounds of the consumption rate k; at k = 0 the cost is infinite for γ > 1


@pytree_dataclass()
class Merton:
    """Consume and invest over an infinite horizon with the utility C^{1−γ}/(1−γ); the cost is minus the utility.

    The state is the logarithm z of the wealth W. The controls are the share π in the risky asset and the consumption
    rate k = C/W.

        dz = (r + π(μ − r) − k − ½π²σ²) dt + πσ dw,     V = −k*^{−γ} e^{(1−γ)z}/(1−γ)
        π* = (μ − r)/(γσ²),  k* = (ρ − (1−γ)(r + (μ−r)²/(2γσ²)))/γ

    The noise depends on the control. In the logarithm of wealth the noise does not depend on the state.

    Args:
      interest: r.
      growth: μ, the growth rate of the risky asset.
      volatility: σ.
      aversion: γ > 0, not 1.
      discount: ρ.
    """

    interest: Number = 0.03
    growth: Number = 0.07
    volatility: Number = 0.2
    aversion: Number = 2.0
    discount: Number = 0.05

    def __post_init__(self) -> None:
        check_positive("merton", volatility=self.volatility, aversion=self.aversion, discount=self.discount)
        # C^{1−γ}/(1−γ) divides by zero at γ = 1; its limit up to a constant, log C, is a different problem
        if not is_traced(self.aversion) and np.any(np.asarray(self.aversion) == 1):
            raise ValueError("merton: got aversion = 1 (logarithmic utility), wanted another number > 0")

    def drift(self, x: State, u: Control) -> State:
        """The mean growth rate of the logarithm of wealth."""
        spread = u[0] * self.volatility  # πσ
        # −½π²σ² is the Itô correction of the logarithm; it makes the growth concave in π
        growth = self.interest + u[0] * (self.growth - self.interest) - u[1] - 0.5 * spread * spread
        return jnp.stack([growth])

    def noise(self, x: State, u: Control) -> State:
        """πσ."""
        return jnp.stack([u[0] * self.volatility])  # shape (n,), the diagonal of σ

    def cost(self, x: State, u: Control) -> Number:
        """Minus the utility of the consumption k·e^z."""
        power = 1 - self.aversion
        # (k·e^z)^{1−γ} through the logarithm, so that one exponential replaces the power of a product
        return -jnp.exp(power * (x[0] + jnp.log(u[1]))) / power

    @property
    def share(self) -> Number:
        """π*, the optimal share in the risky asset."""
        # independent of wealth and of the discount
        return (self.growth - self.interest) / (self.aversion * self.volatility * self.volatility)

    @property
    def consumption(self) -> Number:
        """k*, the optimal consumption per unit of wealth and time."""
        premium = self.growth - self.interest
        # the riskless rate that is equivalent to the optimal portfolio: r + (μ−r)²/(2γσ²)
        certain = self.interest + premium * premium / (2 * self.aversion * self.volatility * self.volatility)
        # k* ≤ 0 means that the utility of waiting grows faster than the discount; the value is then not finite
        return (self.discount - (1 - self.aversion) * certain) / self.aversion

    def value(self, x: State) -> Scalar:
        """The value at one state, valid if the optimal controls are admissible and k* > 0."""
        power = 1 - self.aversion
        # homogeneous of degree 1 − γ in wealth, like the utility, so exponential in the logarithm of wealth
        return -(self.consumption**-self.aversion) * jnp.exp(power * jnp.asarray(x)[0]) / power

    def check(self) -> None:
        """Check that the optimal controls are in the box of controls, so that ``value`` is the value of the problem.

        Raises:
          ValueError: the optimal share or the optimal consumption is outside the box.
        """
        if is_traced(self):
            return
        with jax.ensure_compile_time_eval():  # concrete numbers can be checked inside a jit of the caller, too
            admissible("merton", *SHARES, share=self.share)
            admissible("merton", *RATES, consumption=self.consumption)


@front_door
def merton(
    *,
    interest: Number = 0.03,
    growth: Number = 0.07,
    volatility: Number = 0.2,
    aversion: Number = 2.0,
    discount: Number = 0.05,
    shape: tuple[int, ...] = (101,),
) -> tuple[Problem, Grid]:
    """Consume and invest: log-wealth in [−1, 1], share in [0, 1], consumption rate in [0.01, 0.1].

    The exact value is prescribed at both ends. Otherwise the noise would spread the effect of the boundary.

    Args:
      interest: r, the rate of the safe asset, per unit of time.
      growth: μ, the mean rate of the risky asset.
      volatility: σ of the risky asset.
      aversion: γ, the relative risk aversion; not 1.
      discount: ρ, the discount rate of later consumption.
      shape: number of nodes.

    Raises:
      ValueError: the optimal share or consumption is outside the box, so the value at the ends is unknown.
    """
    system = Merton(interest, growth, volatility, aversion, discount)
    system.check()
    problem = Problem(
        system.drift,
        system.cost,
        # with the defaults π* = 0.5 and k* = 0.045 are inside, so the bounds are not active
        Box(*zip(SHARES, RATES, strict=True)),
        noise=system.noise,
        discount=discount,
        target=OutsideCube(1.0).level,
        # the value of continuing on the whole line, known from the closed form
        exit_cost=system.value,
        control_names=("share at risk", "consumption"),
        control_units=("", "1/year"),
    )
    return problem, Grid([-1.0], [1.0], shape, names=("log wealth",))


@front_door
def merton_exact(
    *,
    interest: Number = 0.03,
    growth: Number = 0.07,
    volatility: Number = 0.2,
    aversion: Number = 2.0,
    discount: Number = 0.05,
) -> Exact:
    """The value as a function of log-wealth, on the whole line; 493.8271605 at wealth 1 with the defaults.

    Args:
      interest: r.
      growth: μ.
      volatility: σ.
      aversion: γ, not 1.
      discount: ρ.

    Raises:
      ValueError: the optimal share is outside [0, 1], or the optimal consumption is outside [0.01, 0.1].
    """
    system = Merton(interest, growth, volatility, aversion, discount)
    system.check()
    return answer(system.value)


@pytree_dataclass()
class Wealth:
    """Merton's problem in the level W of wealth instead of its logarithm; the utility is a reward.

        dW = W (r + π(μ − r) − k) dt + W πσ dw,     V = k*^{−γ} W^{1−γ}/(1−γ)

    The controls are again the share π and the consumption rate k, so the optimal ones are constants. Drift and noise
    are proportional to the wealth.

    Args:
      system: the numbers of the problem.
    """

    system: Merton

    def drift(self, x: State, u: Control) -> State:
        """The mean growth of the wealth."""
        system = self.system
        return x * (system.interest + u[0] * (system.growth - system.interest) - u[1])

    def noise(self, x: State, u: Control) -> State:
        """W πσ."""
        return x * (u[0] * self.system.volatility)

    def reward(self, x: State, u: Control) -> Number:
        """The utility of the consumption k·W."""
        return 0 - self.system.cost(jnp.log(x), u)

    def outside(self, x: State) -> Number:
        """≤ 0 at the ends of the box, 1/2 and 2."""
        return (2 - 0.5) / 2 * (1 - 1e-6) - jnp.abs(x[0] - (2 + 0.5) / 2)

    def value(self, x: State) -> Scalar:
        """The value at one level of wealth."""
        return 0 - self.system.value(jnp.log(jnp.asarray(x)))


@front_door
def merton_wealth(
    *,
    interest: Number = 0.03,
    growth: Number = 0.07,
    volatility: Number = 0.2,
    aversion: Number = 2.0,
    discount: Number = 0.05,
    shape: tuple[int, ...] = (151,),
) -> tuple[Problem, Grid]:
    """Consume and invest, in levels: wealth in [1/2, 2], share in [0, 1], consumption rate in [0.01, 0.1].

    The exact value is prescribed at both ends, as in ``merton``.

    Args:
      interest: r, the rate of the safe asset, per unit of time.
      growth: μ, the mean rate of the risky asset.
      volatility: σ of the risky asset.
      aversion: γ, the relative risk aversion; not 1.
      discount: ρ, the discount rate of later consumption.
      shape: number of nodes.

    Raises:
      ValueError: the optimal share or consumption is outside the box, so the value at the ends is unknown.
    """
    system = Merton(interest, growth, volatility, aversion, discount)
    system.check()
    wealth = Wealth(system)
    problem = Problem(
        wealth.drift,
        reward=wealth.reward,
        controls=Box(*zip(SHARES, RATES, strict=True)),
        noise=wealth.noise,
        discount=discount,
        target=wealth.outside,
        exit_reward=wealth.value,
        control_names=("share at risk", "consumption"),
        control_units=("", "1/year"),
    )
    return problem, Grid([0.5], [2.0], shape, names=("wealth",))


@front_door
def merton_wealth_exact(
    *,
    interest: Number = 0.03,
    growth: Number = 0.07,
    volatility: Number = 0.2,
    aversion: Number = 2.0,
    discount: Number = 0.05,
) -> Exact:
    """The value as a function of wealth; −493.8271605 at wealth 1 with the defaults.

    Args:
      interest: r.
      growth: μ.
      volatility: σ.
      aversion: γ, not 1.
      discount: ρ.

    Raises:
      ValueError: the optimal share is outside [0, 1], or the optimal consumption is outside [0.01, 0.1].
    """
    system = Merton(interest, growth, volatility, aversion, discount)
    system.check()
    return answer(Wealth(system).value)
