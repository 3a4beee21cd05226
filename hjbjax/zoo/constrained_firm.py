"""Investment, cash and external finance of a firm, by Bolton, Chen and Wang.

Source: P. Bolton, H. Chen and N. Wang, A Unified Theory of Tobin's q, Corporate Investment, Financing, and Risk
Management, Journal of Finance 66 (2011), 1545-1578, equations (7) to (20) and table I.
"""

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.modes import Modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pushes import Push
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import check_positive

MOST_CASH = 0.3  # upper end of the grid, above the payout boundary
NEVER = 1e3  # a loss per unit of time and capital that no firm accepts for any time


@pytree_dataclass()
class ConstrainedFirm:
    """A firm with the capital K and the cash W = w K, which it cannot borrow.

        dK = (i − δ) K dt,    dW = K (μ dt + σ dZ) − (i + θi²/2) K dt + (r − λ) W dt − payouts + equity raised

    Its value is K p(w), so the state is the cash-capital ratio w, and the value per unit of capital has the discount r
    minus the growth i − δ of the capital:

        r p = max_i [ (i − δ)(p − w p′) + ((r − λ) w + μ − i − θi²/2) p′ ] + ½σ² p″

    Cash above the payout boundary is paid out, p′ = 1 there. Without frictions the value per unit of capital is q + w
    with q = 1 + θ i, where i is ``first_best``.

    Args:
      interest: r, per unit of time, like all rates.
      depreciation: δ.
      productivity: μ, the mean revenue per unit of capital.
      volatility: σ of the revenue.
      adjustment: θ, the cost θi²/2 of the investment i per unit of capital.
      carrying: λ, the cost of holding cash.
      liquidation: l, the value of the capital in liquidation.
    """

    interest: Number = 0.06
    depreciation: Number = 0.1007
    productivity: Number = 0.18
    volatility: Number = 0.09
    adjustment: Number = 1.5
    carrying: Number = 0.01
    liquidation: Number = 0.9

    def __post_init__(self) -> None:
        check_positive(
            "firm", interest=self.interest, volatility=self.volatility, adjustment=self.adjustment,
            carrying=self.carrying, liquidation=self.liquidation,
        )  # fmt: skip
        square = self._square
        if not is_traced(square) and not np.all(np.asarray(square) > 0):
            raise ValueError(
                f"firm: productivity = {self.productivity} is so large that the value without frictions is infinite; "
                "wanted productivity < interest + depreciation + adjustment (interest + depreciation)²/2"
            )

    @property
    def _square(self) -> Number:
        """The square of the difference between r + δ and the first-best investment."""
        used = self.interest + self.depreciation
        return used * used - 2 * (self.productivity - used) / self.adjustment

    @property
    def first_best(self) -> Number:
        """The investment per unit of capital without frictions, equation (7)."""
        return self.interest + self.depreciation - self._below

    @property
    def _below(self) -> Number:
        """The difference between r + δ and the first-best investment."""
        return jnp.sqrt(self._square) if is_traced(self) else np.sqrt(self._square)

    @property
    def investments(self) -> Box:
        """The investments that may be optimal: below the first best and above −(1 + w)/θ, since p/p′ > 0.

        The upper end is half-way to r + δ, where the discount r − (i − δ) is zero.
        """
        xp = jnp if is_traced(self) else np
        most, least = self.first_best + self._below / 2, -(1 + MOST_CASH) / self.adjustment
        return Box(xp.stack([xp.asarray(least, float)]), xp.stack([xp.asarray(most, float)]))

    def drift(self, x: State, u: Control) -> State:
        """The mean change of the cash-capital ratio, equation (12)."""
        earned = (self.interest - self.carrying) * x + self.productivity
        return earned - u - self.adjustment * u * u / 2 - (u - self.depreciation) * x

    def growth(self, x: State, u: Control) -> Number:
        """The growth rate of the capital."""
        return u[0] - self.depreciation

    def cash(self, x: State) -> Number:
        """w, ≤ 0 if the firm is out of cash."""
        return x[0]


@pytree_dataclass()
class Refinancing:
    """The firm of ``ConstrainedFirm`` that may also issue equity, at the cost φ + γm for raising m per unit of capital.

    An issue with a fixed cost is a change to the mode "issuing" at the cost φ, a push of the cash upward at the cost
    1 + γ per unit, and a change back at no cost. Staying in this mode, or without cash, is never worth it. At any time
    the firm may be liquidated for l + w.

    Args:
      firm: the firm.
      fixed: φ, per unit of capital.
      proportional: γ.
    """

    firm: ConstrainedFirm
    fixed: Number
    proportional: Number

    def drift(self, x: State, u: Control, mode: int) -> State:
        """The mean change of the cash-capital ratio."""
        return self.firm.drift(x, u)

    def growth(self, x: State, u: Control, mode: int) -> Number:
        """The growth rate of the capital."""
        return self.firm.growth(x, u)

    def reward(self, x: State, u: Control, mode: int) -> Number:
        """A large loss in the mode "issuing", and without cash."""
        return -NEVER * (jnp.where(x[0] <= 1e-9, 1.0, 0.0), 1.0)[mode]

    def liquidated(self, x: State, mode: int) -> Number:
        """l + w."""
        return self.firm.liquidation + x[0]

    def payout(self, x: State, mode: int) -> Number:
        """One, but not while issuing."""
        return (1.0, -jnp.inf)[mode]

    def issue(self, x: State, mode: int) -> Number:
        """1 + γ, only while issuing."""
        return (jnp.inf, 1.0 + self.proportional)[mode]


@front_door
def liquidation(
    *,
    interest: Number = 0.06,
    depreciation: Number = 0.1007,
    productivity: Number = 0.18,
    volatility: Number = 0.09,
    adjustment: Number = 1.5,
    carrying: Number = 0.01,
    liquidation: Number = 0.9,
    shape: tuple[int, ...] = (301,),
) -> tuple[Problem, Grid]:
    """Investment and payout of a firm that is liquidated when it runs out of cash, case I of Bolton, Chen and Wang.

    They report the payout boundary 0.22, a marginal value of cash of 30 and disinvestment of over 60 % per year as the
    cash runs out, and investment of 10.6 % at the payout boundary, compared with 15.1 % in the first best.

    Args:
      interest: r.
      depreciation: δ.
      productivity: μ.
      volatility: σ.
      adjustment: θ.
      carrying: λ, the cost of holding cash.
      liquidation: l.
      shape: number of nodes, for cash-capital ratios from 0 to 0.3.
    """
    firm = ConstrainedFirm(interest, depreciation, productivity, volatility, adjustment, carrying, liquidation)
    problem = Problem(
        firm.drift, controls=firm.investments, noise=volatility, discount=interest, growth=firm.growth,
        target=firm.cash, exit_reward=liquidation, pushes=[Push([-1.0], reward=1.0)],
        control_names=("investment",), control_units=("1/year",),
    )  # fmt: skip
    return problem, Grid([0.0], [MOST_CASH], shape, names=("cash",))


@front_door
def refinancing(
    *,
    interest: Number = 0.06,
    depreciation: Number = 0.1007,
    productivity: Number = 0.18,
    volatility: Number = 0.09,
    adjustment: Number = 1.5,
    carrying: Number = 0.01,
    liquidation: Number = 0.9,
    fixed: Number = 0.01,
    proportional: Number = 0.06,
    shape: tuple[int, ...] = (301,),
) -> tuple[Problem, Grid]:
    """Investment, payout and equity issues of a firm, case II of Bolton, Chen and Wang, in two modes.

    They report the payout boundary 0.19, issues that raise the cash to 0.06, a marginal value of cash of 1.7 as the
    cash runs out, and investment of 11 % at the payout boundary.

    Args:
      interest: r.
      depreciation: δ.
      productivity: μ.
      volatility: σ.
      adjustment: θ.
      carrying: λ, the cost of holding cash.
      liquidation: l.
      fixed: φ > 0, the fixed cost of an issue per unit of capital.
      proportional: γ, the cost per unit of equity raised.
      shape: number of nodes, for cash-capital ratios from 0 to 0.3.
    """
    check_positive("refinancing", fixed=fixed, proportional=proportional)
    firm = ConstrainedFirm(interest, depreciation, productivity, volatility, adjustment, carrying, liquidation)
    issues = Refinancing(firm, fixed, proportional)
    costs = jnp.stack([jnp.zeros(2), jnp.zeros(2)]).at[0, 1].set(fixed) if is_traced(fixed) else [[0, fixed], [0, 0]]
    problem = Problem(
        issues.drift, reward=issues.reward, controls=firm.investments, noise=volatility, discount=interest,
        growth=issues.growth, stopping_reward=issues.liquidated,
        modes=Modes(("operating", "issuing"), switching_cost=costs),
        pushes=[Push([-1.0], reward=issues.payout), Push([1.0], issues.issue)],
        control_names=("investment",), control_units=("1/year",),
    )  # fmt: skip
    return problem, Grid([0.0], [MOST_CASH], shape, names=("cash",))
