"""Transaction costs: when an investor with logarithmic utility trades, and how much."""

from typing import Any

import jax.numpy as jnp

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pushes import Push
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import check_positive


@pytree_dataclass()
class Portfolio:
    """Consume C and hold a stock and a bond, where a purchase costs the share λ of its size, and a sale the share μ.

    The utility is E ∫₀^∞ e^{−ρt} log C dt = (log W)/ρ + V(z), with the wealth W and the share z of W in stock. With
    k = C/W, and between two trades,

        dz = [z(1−z)(α − r − σ²z) + k z] dt + σ z(1−z) dw,
        V(z) = max E ∫₀^∞ e^{−ρt} [ log k + (r + z(α−r) − k − ½σ²z²)/ρ ] dt.

    A trade that raises z by dz multiplies W by 1 − λ dz/(1 + λz); one that lowers it, by 1 − μ dz/(1 − μz).
    Source: M. H. A. Davis and A. R. Norman, Math. Oper. Res. 15 (1990), who use powers as well as the logarithm.

    Args:
      interest: r of the bond.
      growth: α, the growth rate of the stock.
      volatility: σ of the stock.
      discount: ρ.
      buying: λ.
      selling: μ, less than 1.
    """

    interest: Number = 0.03
    growth: Number = 0.07
    volatility: Number = 0.3
    discount: Number = 0.05
    buying: Number = 0.01
    selling: Number = 0.01

    def __post_init__(self) -> None:
        check_positive(
            "transaction_costs",
            volatility=self.volatility, discount=self.discount, buying=self.buying, selling=self.selling,
        )  # fmt: skip
        if not is_traced(self.selling) and self.selling >= 1:
            raise ValueError(f"transaction_costs: got selling = {self.selling}, wanted a share of the sale below 1")
        if not is_traced(self.share) and not 0 < self.share < 1:
            raise ValueError(
                f"transaction_costs: got parameters whose share of stock without costs, (α − r)/σ², is "
                f"{float(self.share):.4g}, wanted one between 0 and 1: there is no short selling and no borrowing"
            )

    @property
    def share(self) -> Any:
        """(α − r)/σ², the share of stock without transaction costs."""
        return (self.growth - self.interest) / (self.volatility * self.volatility)

    def drift(self, z: State, k: Control) -> State:
        """The rate of change of the share of stock."""
        excess = self.growth - self.interest - self.volatility * self.volatility * z
        return z * (1 - z) * excess + k * z

    def noise(self, z: State, k: Control) -> State:
        """σ z(1−z)."""
        return self.volatility * z * (1 - z)

    def reward(self, z: State, k: Control) -> Number:
        """The utility of consumption and of the growth of wealth, per unit of time."""
        stock, spread = z[0], self.volatility * z[0]
        wealth = self.interest + stock * (self.growth - self.interest) - k[0] - 0.5 * spread * spread
        return jnp.log(k[0]) + wealth / self.discount

    def purchase(self, z: State) -> Number:
        """The loss of V per unit by which z is raised."""
        return self.buying / (self.discount * (1 + self.buying * z[0]))

    def sale(self, z: State) -> Number:
        """The loss of V per unit by which z is lowered."""
        return self.selling / (self.discount * (1 - self.selling * z[0]))


@front_door
def transaction_costs(
    *,
    interest: Number = 0.03,
    growth: Number = 0.07,
    volatility: Number = 0.3,
    discount: Number = 0.05,
    buying: Number = 0.01,
    selling: Number = 0.01,
    shape: tuple[int, ...] = (401,),
) -> tuple[Problem, Grid]:
    """Consume and invest with proportional transaction costs: the investor trades only outside of an interval.

    The state is the share of wealth in stock; ``Solution.free_boundary()`` is the interval without trade.

    Args:
      interest: r of the bond.
      growth: α, the growth rate of the stock.
      volatility: σ of the stock.
      discount: ρ.
      buying: λ, the cost of a purchase per unit of its size.
      selling: μ, the cost of a sale per unit of its size.
      shape: number of nodes.

    Example:
      >>> problem, grid = transaction_costs(shape=(101,))
      >>> [push.direction for push in problem.pushes]
      [(1,), (-1,)]
    """
    investor = Portfolio(interest, growth, volatility, discount, buying, selling)
    problem = Problem(
        investor.drift,
        # 1/k = 1/ρ − z V′, and V′ lies between the marginal costs of both trades
        controls=Box([discount * (1 - selling)], [discount * (1 + buying)]),
        reward=investor.reward,
        noise=investor.noise,
        discount=discount,
        pushes=[Push([1.0], investor.purchase), Push([-1.0], investor.sale)],
        control_names=("consumption",),
        control_units=("1/year",),
    )
    return problem, Grid([0.0], [1.0], shape, names=("share",))
