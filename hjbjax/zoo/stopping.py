"""Optimal stopping in finance: when to exercise a put, and when the owners of a firm stop paying its debt.

The price follows a geometric Brownian motion under the risk-neutral measure. The value is a reward, and it is optimal
to stop below a free boundary, at which the value leaves the payoff smoothly.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import Exact, Scalar, answer, check_positive

FACE = 1 - 1e-6  # nodes at an end of the box are exact only up to rounding


@pytree_dataclass()
class AmericanPut:
    """The right to sell an asset at the strike K at any time.

        dS = r S dt + σ S dw,     min{ r P − r S P′ − ½σ²S² P″,  P − (K − S)⁺ } = 0

    Without maturity (a perpetual put) it is exercised as soon as S ≤ S*:

        P = K − S for S ≤ S*,  P = (K − S*)(S/S*)^{−k} above,     k = 2r/σ²,   S* = k K/(1 + k)

    Args:
      strike: K.
      interest: r.
      volatility: σ.
    """

    strike: Number = 100.0
    interest: Number = 0.05
    volatility: Number = 0.3

    def __post_init__(self) -> None:
        check_positive("put", strike=self.strike, interest=self.interest, volatility=self.volatility)

    def drift(self, x: State, u: Control) -> State:
        """The growth of the price; of a price and a time to maturity, the latter falls at the rate one."""
        return jnp.concatenate([self.interest * x[:1], -jnp.ones_like(x[1:])])

    def noise(self, x: State, u: Control) -> State:
        """σS; the time to maturity has no noise."""
        return jnp.concatenate([self.volatility * x[:1], jnp.zeros_like(x[1:])])

    def payoff(self, x: State) -> Number:
        """(K − S)⁺."""
        return jnp.maximum(self.strike - x[0], 0.0)

    def far_away(self, x: State) -> Number:
        """Four strikes minus the price: ≤ 0 at the upper end of the box of the perpetual put."""
        return 4 * FACE * self.strike - x[0]

    def is_mature(self, x: State) -> Number:
        """The time to maturity, or the distance to a price of three strikes, where the put is worth nothing."""
        return jnp.minimum(x[1], 3 * FACE * self.strike - x[0])

    @property
    def boundary(self) -> Number:
        """S*, the price at or below which the perpetual put is exercised."""
        power = 2 * self.interest / (self.volatility * self.volatility)
        return power * self.strike / (1 + power)

    def value(self, x: State) -> Scalar:
        """The value of the perpetual put at one price."""
        price, stop = jnp.asarray(x)[0], self.boundary
        power = 2 * self.interest / (self.volatility * self.volatility)
        # the larger of both prices, so that the unused branch is finite at a price of zero
        waiting = (self.strike - stop) * (jnp.maximum(price, stop) / stop) ** -power
        return jnp.where(price <= stop, self.strike - price, waiting)


@front_door
def perpetual_put(
    *, strike: Number = 100.0, interest: Number = 0.05, volatility: Number = 0.3, shape: tuple[int, ...] = (401,)
) -> tuple[Problem, Grid]:
    """A put without maturity: price in [0, 4 K].

    The exact value is prescribed at the upper end, where a wall would reflect the price.

    Args:
      strike: K, the price at which the asset may be sold.
      interest: r, the riskless rate, per unit of time.
      volatility: σ of the price.
      shape: number of nodes.
    """
    put = AmericanPut(strike, interest, volatility)
    problem = Problem(
        put.drift, noise=put.noise, discount=interest, stopping_reward=put.payoff, target=put.far_away,
        exit_reward=put.value, time_unit="year",
    )  # fmt: skip
    return problem, Grid([0.0], [4 * strike], shape, names=("price",))


@front_door
def perpetual_put_exact(*, strike: Number = 100.0, interest: Number = 0.05, volatility: Number = 0.3) -> Exact:
    """The value as a function of the price; 23.21468 at a price of 100 with the defaults.

    Args:
      strike: K.
      interest: r.
      volatility: σ.
    """
    return answer(AmericanPut(strike, interest, volatility).value)


@front_door
def american_put(
    *,
    strike: Number = 40.0,
    interest: Number = 0.06,
    volatility: Number = 0.2,
    maturity: Number = 1.0,
    shape: tuple[int, ...] = (201, 41),
) -> tuple[Problem, Grid]:
    """A put with a maturity: price in [0, 3 K], and the time to maturity as a second state.

    The value at maturity is the payoff. No closed form is known; a binomial tree gives 2.3196 at a price of 40, one
    unit of time before maturity, with the defaults.

    Args:
      strike: K, the price at which the asset may be sold.
      interest: r, the riskless rate, per unit of time.
      volatility: σ of the price.
      maturity: the longest time to maturity.
      shape: number of nodes per axis.
    """
    check_positive("american_put", maturity=maturity)
    put = AmericanPut(strike, interest, volatility)
    problem = Problem(
        put.drift, noise=put.noise, discount=interest, stopping_reward=put.payoff, target=put.is_mature,
        exit_reward=put.payoff, time_unit="year",
    )  # fmt: skip
    names, units = ("price", "time to maturity"), ("", "year")
    return problem, Grid([0.0, 0.0], [3 * strike, maturity], shape, names=names, units=units)


@pytree_dataclass()
class Firm:
    """Equity of a firm with perpetual debt, whose owners pay the coupons until they choose to default.

    The assets A pay out δA per unit time, and the owners receive δA − (1−τ)C after the coupon C and its tax shield. At
    default they receive nothing. With a = (1−τ)C/r the equity E and the default boundary A_B are

        dA = (r − δ) A dt + σ A dw,     min{ r E − (δA − (1−τ)C) − (r−δ) A E′ − ½σ²A² E″,  E } = 0
        E = A − a + (a − A_B)(A/A_B)^{−k},   A_B = a k/(1 + k),   ½σ²k(k + 1) = (r − δ) k + r

    The state is the logarithm of the assets, in which the coefficients are constant. For δ = 0 the boundary is Leland's
    (1994), (1−τ)C/(r + σ²/2).

    Args:
      coupon: C, per unit of time.
      interest: r.
      volatility: σ of the assets.
      payout: δ ≥ 0.
      tax: τ, in [0, 1).
    """

    coupon: Number = 6.0
    interest: Number = 0.06
    volatility: Number = 0.2
    payout: Number = 0.02
    tax: Number = 0.35

    def __post_init__(self) -> None:
        check_positive("leland", coupon=self.coupon, interest=self.interest, volatility=self.volatility)
        for name, most in (("payout", np.inf), ("tax", 1.0)):
            number = getattr(self, name)
            if not is_traced(number) and not np.all((np.asarray(number) >= 0) & (np.asarray(number) < most)):
                raise ValueError(f"leland: got {name} = {number!r}, wanted a number in [0, {most:g})")

    def drift(self, z: State, u: Control) -> State:
        """The mean growth rate of the logarithm of the assets."""
        growth = self.interest - self.payout - 0.5 * self.volatility * self.volatility
        return growth + 0 * z

    def noise(self, z: State, u: Control) -> State:
        """σ."""
        return self.volatility + 0 * z

    def reward(self, z: State, u: Control) -> Number:
        """The payout after coupon and tax shield; negative in bad times."""
        return self.payout * jnp.exp(z[0]) - (1 - self.tax) * self.coupon

    def far_away(self, z: State) -> Number:
        """The distance to four default boundaries, the upper end of the box; ≤ 0 there."""
        return jnp.log(4 * FACE * self.boundary) - z[0]

    @property
    def power(self) -> Number:
        """k, the positive root of ½σ²k(k + 1) = (r − δ) k + r."""
        half = 0.5 * self.volatility * self.volatility
        middle = half - self.interest + self.payout
        return (-middle + jnp.sqrt(middle * middle + 4 * half * self.interest)) / (2 * half)

    @property
    def boundary(self) -> Number:
        """A_B, the value of the assets at which the owners default."""
        return self.power / (1 + self.power) * (1 - self.tax) * self.coupon / self.interest

    def value(self, z: State) -> Scalar:
        """The equity at one logarithm of the assets."""
        debt = (1 - self.tax) * self.coupon / self.interest
        assets = jnp.exp(jnp.asarray(z)[0])
        above = jnp.maximum(assets, self.boundary)
        return above - debt + (debt - self.boundary) * (above / self.boundary) ** -self.power


@front_door
def leland(
    *,
    coupon: Number = 6.0,
    interest: Number = 0.06,
    volatility: Number = 0.2,
    payout: Number = 0.02,
    tax: Number = 0.35,
    shape: tuple[int, ...] = (401,),
) -> tuple[Problem, Grid]:
    """Endogenous default: assets from half to four times the default boundary, in logarithms.

    The exact value is prescribed at the upper end. Without a payout it carries the value of the assets, which the
    owners receive only in the limit.

    Args:
      coupon: C, the interest on the debt per unit of time.
      interest: r, the riskless rate.
      volatility: σ of the assets.
      payout: the rate at which the assets pay out.
      tax: the tax rate, from which coupons are deductible.
      shape: number of nodes.
    """
    firm = Firm(coupon, interest, volatility, payout, tax)
    problem = Problem(
        firm.drift, reward=firm.reward, noise=firm.noise, discount=interest, stopping_reward=0.0,
        target=firm.far_away, exit_reward=firm.value, time_unit="year",
    )  # fmt: skip
    with jax.ensure_compile_time_eval():  # numbers, if the parameters are numbers, also inside a jit of the caller
        boundary = jnp.log(firm.boundary) if is_traced(firm) else np.log(float(firm.boundary))
    lo, hi = boundary + np.log(0.5), boundary + np.log(4.0)
    return problem, Grid([lo], [hi], shape, names=("log assets",))


@front_door
def leland_exact(
    *,
    coupon: Number = 6.0,
    interest: Number = 0.06,
    volatility: Number = 0.2,
    payout: Number = 0.02,
    tax: Number = 0.35,
) -> Exact:
    """The equity as a function of the logarithm of the assets.

    Args:
      coupon: C.
      interest: r.
      volatility: σ.
      payout: δ.
      tax: τ.
    """
    return answer(Firm(coupon, interest, volatility, payout, tax).value)
