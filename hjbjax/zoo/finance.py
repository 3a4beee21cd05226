"""Problems of finance whose value is known.

    Merton          consumption and investment with constant relative risk aversion

A utility to be maximised is minus a cost.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import Exact, OutsideCube, Scalar, admissible, answer, positive

SHARES = 0.0, 1.0  # no short sale, no credit
RATES = 0.01, 0.1  # of consumption; at k = 0 the cost is infinite for γ > 1


@pytree_dataclass()
class Merton:
    """Consume and invest for ever with the utility C^{1−γ}/(1−γ); the cost is minus the utility.

    The state is the logarithm z of wealth, the controls are the share π in the risky asset and the rate of
    consumption k = C/W:

        dz = (r + π(μ − r) − k − ½π²σ²) dt + πσ dw,     V = −k*^{−γ} e^{(1−γ)z}/(1−γ)
        π* = (μ − r)/(γσ²),  k* = (ρ − (1−γ)(r + (μ−r)²/(2γσ²)))/γ

    so that the noise is controlled, and noise and value are scale-free where wealth itself would span decades.

    Args:
      interest: r.
      growth: μ, of the risky asset.
      volatility: σ.
      aversion: γ > 0, not 1.
      discount: ρ.
    """

    interest: Number = 0.03
    growth: Number = 0.07
    volatility: Number = 0.2
    aversion: Number = 2.0
    discount: Number = 0.05

    def __post_init__(self):
        positive("merton", volatility=self.volatility, aversion=self.aversion, discount=self.discount)
        # C^{1−γ}/(1−γ) divides by zero there; its limit, less a constant, is log C, another problem
        if not is_traced(self.aversion) and np.any(np.asarray(self.aversion) == 1):
            raise ValueError("merton: got aversion = 1 (logarithmic utility), wanted another number > 0")

    def drift(self, x: State, u: Control) -> State:
        """The mean growth of the logarithm of wealth."""
        spread = u[0] * self.volatility  # πσ
        # −½π²σ² is Itô's correction of the logarithm: it makes growth concave in π, though wealth's is linear
        growth = self.interest + u[0] * (self.growth - self.interest) - u[1] - 0.5 * spread * spread
        return jnp.stack([growth])

    def noise(self, x: State, u: Control) -> State:
        """πσ."""
        return jnp.stack([u[0] * self.volatility])  # (n,): the diagonal of σ

    def cost(self, x: State, u: Control) -> Number:
        """Minus the utility of the consumption k·e^z."""
        power = 1 - self.aversion
        # (k·e^z)^{1−γ} by its logarithm: one exponential in place of a power of a product
        return -jnp.exp(power * (x[0] + jnp.log(u[1]))) / power

    @property
    def share(self) -> Number:
        """π*, the best share in the risky asset."""
        # Merton's share: it depends neither on wealth nor on the discount
        return (self.growth - self.interest) / (self.aversion * self.volatility * self.volatility)

    @property
    def consumption(self) -> Number:
        """k*, the best consumption per unit of wealth and time."""
        premium = self.growth - self.interest
        # the riskless rate that is worth as much as the best portfolio: r + (μ−r)²/(2γσ²)
        certain = self.interest + premium * premium / (2 * self.aversion * self.volatility * self.volatility)
        # k* ≤ 0 means that the utility of waiting outgrows the discount: the value is not finite
        return (self.discount - (1 - self.aversion) * certain) / self.aversion

    def value(self, x: State) -> Scalar:
        """The value at one state, while the best controls are admissible and k* > 0."""
        power = 1 - self.aversion
        # homogeneous of degree 1 − γ in wealth, as the utility is, hence the exponential in its logarithm
        return -(self.consumption**-self.aversion) * jnp.exp(power * jnp.asarray(x)[0]) / power

    def check(self) -> None:
        """Refuse parameters for which ``value`` is not that of the box of controls.

        Raises:
          ValueError: the best share or the best consumption lies outside of it.
        """
        if is_traced(self):
            return
        with jax.ensure_compile_time_eval():  # known numbers are looked at within somebody's jit, too
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
    """Consume and invest: log-wealth on [−1, 1], share in [0, 1], consumption rate in [.01, .1].

    The ends are held at the exact value: the noise would carry the effect of a wall into the whole box.

    Args:
      interest: r, of the safe asset, per unit of time.
      growth: μ, the mean rate of the risky asset.
      volatility: σ, of the risky asset.
      aversion: γ, to risk, relative to wealth; not 1.
      discount: ρ, of later consumption.
      shape: nodes.

    Raises:
      ValueError: the best share or consumption lies outside the box, so that the ends have no exact value.
    """
    system = Merton(interest, growth, volatility, aversion, discount)
    system.check()
    problem = Problem(
        system.drift,
        system.cost,
        # with the defaults π* = .5 and k* = .045, both inside: the bounds are slack
        Box(*zip(SHARES, RATES, strict=True)),
        noise=system.noise,
        discount=discount,
        target=OutsideCube(1.0).level,
        # at the ends the value of going on without the box, which the exact answer knows
        exit_cost=system.value,
        control_names=("share at risk", "consumption"),
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
    """The value as a function of log-wealth, any of it; 493.8271605 at wealth 1 with the defaults.

    Args:
      interest: r.
      growth: μ.
      volatility: σ.
      aversion: γ, not 1.
      discount: ρ.

    Raises:
      ValueError: the best share lies outside [0, 1], or the best consumption outside [.01, .1].
    """
    system = Merton(interest, growth, volatility, aversion, discount)
    system.check()
    return answer(system.value)
