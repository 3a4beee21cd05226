"""Optimal growth: how much of the output to consume and how much to invest, with a closed form."""

import jax.numpy as jnp

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import Exact, Scalar, answer, check_positive

LO, HI = 0.2, 1.6  # the box of the capital, in units of the steady state
ROOM = 4.0  # the bounds of consumption: the optimal consumption at the ends of the box, divided and multiplied by this


@pytree_dataclass()
class Ramsey:
    """Capital that is consumed or invested, with the utility c^{1−γ}/(1−γ) of consumption and γ = a.

        dk/dt = A k^a − δ k − c,      ρ V = max_c [ c^{1−a}/(1−a) + (A k^a − δ k − c) V′ ]
        c* = κ k,   κ = (ρ + (1−a) δ)/a,      V = κ^{−a} (k^{1−a}/(1−a) + A/ρ)

    If the relative risk aversion γ equals the share a of capital, optimal consumption is proportional to the capital.
    The capital approaches the steady state (A/(δ + κ))^{1/(1−a)} from every start, so it never leaves a box around it.

    Args:
      productivity: A.
      share: a, the elasticity of the output with respect to capital, between 0 and 1; also the risk aversion γ.
      depreciation: δ.
      discount: ρ.
    """

    productivity: Number = 1.0
    share: Number = 0.36
    depreciation: Number = 0.05
    discount: Number = 0.04

    def __post_init__(self) -> None:
        check_positive(
            "growth", productivity=self.productivity, share=self.share, depreciation=self.depreciation,
            discount=self.discount,
        )  # fmt: skip
        if not is_traced(self.share) and not self.share < 1:
            raise ValueError(f"growth: got share = {self.share!r}, wanted a number between 0 and 1")

    def drift(self, k: State, c: Control) -> State:
        """Output minus depreciation minus consumption."""
        return self.productivity * k**self.share - self.depreciation * k - c

    def reward(self, k: State, c: Control) -> Number:
        """The utility of consumption."""
        return c[0] ** (1 - self.share) / (1 - self.share)

    @property
    def consumption(self) -> Number:
        """κ, the optimal consumption per unit of capital and time."""
        return (self.discount + (1 - self.share) * self.depreciation) / self.share

    @property
    def steady_state(self) -> Number:
        """The capital at which output equals depreciation plus optimal consumption."""
        return (self.productivity / (self.depreciation + self.consumption)) ** (1 / (1 - self.share))

    def value(self, k: State) -> Scalar:
        """The value at one state."""
        rest = 1 - self.share
        earned = jnp.asarray(k)[0] ** rest / rest + self.productivity / self.discount
        return self.consumption**-self.share * earned


@front_door
def growth(
    *,
    productivity: Number = 1.0,
    share: Number = 0.36,
    depreciation: Number = 0.05,
    discount: Number = 0.04,
    shape: tuple[int, ...] = (201,),
) -> tuple[Problem, Grid]:
    """Ramsey's growth: capital in [0.2, 1.6] times the steady state, at constrained ends.

    Args:
      productivity: A, the output of one unit of capital per unit of time.
      share: the share of capital in the output, also the relative risk aversion.
      depreciation: the rate at which capital is lost.
      discount: the discount rate of later utility.
      shape: number of nodes.
    """
    system = Ramsey(productivity, share, depreciation, discount)
    rest, rate = system.steady_state, system.consumption
    consumed = Box([rate * rest * LO / ROOM], [rate * rest * HI * ROOM])
    problem = Problem(
        system.drift,
        controls=consumed,
        reward=system.reward,
        discount=discount,
        control_names=("consumption",),
        control_units=("1/year",),
    )
    # the optimal capital moves towards the steady state, so the constraint is not active
    return problem, Grid([LO * rest], [HI * rest], shape, names=("capital",), edges="constrained")


@front_door
def growth_exact(
    *,
    productivity: Number = 1.0,
    share: Number = 0.36,
    depreciation: Number = 0.05,
    discount: Number = 0.04,
) -> Exact:
    """The value as a function of the capital; 52.43657 at a capital of 5 with the defaults.

    Args:
      productivity: A.
      share: a, equal to the relative risk aversion.
      depreciation: δ.
      discount: ρ.
    """
    return answer(Ramsey(productivity, share, depreciation, discount).value)
