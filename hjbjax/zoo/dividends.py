"""Dividends: when a firm pays out its cash, and reflects it at the barrier above which it pays everything."""

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pushes import Push
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import Exact, Scalar, answer, check_positive


@pytree_dataclass()
class Reserve:
    """The cash of a firm that earns μ with the volatility σ, pays dividends, and is ruined at zero.

        dx = μ dt + σ dw − dD,     max{ ½σ² V″ + μ V′ − ρ V,  1 − V′ } = 0,     V(0) = 0

    With the roots a > 0 > b of ½σ² r² + μ r − ρ = 0 it pays everything above the barrier x*:

        V = (e^{ax} − e^{bx})/(a e^{ax*} − b e^{bx*}) for x ≤ x*,  V = μ/ρ + x − x* above,   x* = 2 log(−b/a)/(a − b)

    Args:
      income: μ, per unit of time.
      volatility: σ of the income.
      discount: ρ, per unit of time.
    """

    income: Number = 0.18
    volatility: Number = 0.25
    discount: Number = 0.1

    def __post_init__(self) -> None:
        check_positive("dividends", income=self.income, volatility=self.volatility, discount=self.discount)

    def drift(self, x: State, u: Control) -> State:
        """μ."""
        return self.income + 0 * x

    def ruin(self, x: State) -> Number:
        """The cash, ≤ 0 in ruin."""
        return x[0]

    @property
    def roots(self) -> tuple[Number, Number]:
        """The positive and the negative root of ½σ² r² + μ r − ρ = 0."""
        square = self.volatility * self.volatility
        width = jnp.sqrt(self.income * self.income + 2 * self.discount * square)
        # the form without cancellation for a small discount
        return 2 * self.discount / (self.income + width), -(self.income + width) / square

    @property
    def barrier(self) -> Number:
        """x*, above which all cash is paid out."""
        up, down = self.roots
        return 2 * jnp.log(-down / up) / (up - down)

    def value(self, x: State) -> Scalar:
        """The value of the firm at one amount of cash."""
        (up, down), cash = self.roots, jnp.asarray(x)[0]
        kept = jnp.minimum(cash, self.barrier)
        slope = up * jnp.exp(up * self.barrier) - down * jnp.exp(down * self.barrier)
        return (jnp.exp(up * kept) - jnp.exp(down * kept)) / slope + cash - kept


@front_door
def dividends(
    *, income: Number = 0.18, volatility: Number = 0.25, discount: Number = 0.1, shape: tuple[int, ...] = (401,)
) -> tuple[Problem, Grid]:
    """Dividends until ruin: cash from zero to twice the barrier, pushed down at a reward of one per unit.

    Args:
      income: μ, the mean income per unit of time.
      volatility: σ of the income.
      discount: ρ, the discount rate of the owners.
      shape: number of nodes.
    """
    firm = Reserve(income, volatility, discount)
    problem = Problem(
        firm.drift, noise=volatility, discount=discount, target=firm.ruin, pushes=[Push([-1.0], reward=1.0)],
        time_unit="year",
    )  # fmt: skip
    with jax.ensure_compile_time_eval():  # numbers, if the parameters are numbers, also inside a jit of the caller
        barrier = firm.barrier if is_traced(firm) else np.asarray(float(firm.barrier))
    return problem, Grid([0.0], [2 * barrier], shape, names=("cash",))


@front_door
def dividends_exact(*, income: Number = 0.18, volatility: Number = 0.25, discount: Number = 0.1) -> Exact:
    """The value of the firm as a function of its cash; it is μ/ρ = 1.8 at the barrier, 0.73990 with the defaults.

    Args:
      income: μ.
      volatility: σ.
      discount: ρ.
    """
    return answer(Reserve(income, volatility, discount).value)
