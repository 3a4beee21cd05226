"""Stochastic problems with a known value.

    Brownian exit   dx = σ dw until it leaves a cube or a ball, cost 1
    bang-bang       dx = u dt + ε dw, |u| ≤ 1, cost x²

The exact value is prescribed on the boundary of the box, so the closed form holds at every node.
"""

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, is_traced, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import (
    TIME,
    Exact,
    OutsideBall,
    OutsideCube,
    Scalar,
    answer,
    check_positive,
    noise_or_none,
    unit_cost,
)

TERMS = 200  # terms of the series for the square; the remainder is 1e-15 inside and at most 1e-6 at the sides


def no_drift(x: State, u: Control) -> State:
    """Zero drift; only the noise moves the state."""
    return jnp.zeros_like(x)  # the solver passes a u of shape (0,)


@pytree_dataclass(static=("dim",))
class CubeExit:
    """The discounted time during which σ dw stays in the cube |x_i| < R, in one or two dimensions.

    On the interval V = (1 − cosh κx/cosh κR)/β with κ = √(2β)/σ, and V = (R² − x²)/σ² for β = 0. On the square, the
    difference from this value is a cosine series along the larger coordinate.
    """

    noise: Number
    discount: Number
    half_width: Number
    dim: int

    def __post_init__(self) -> None:
        # the discount is not checked: 0 gives the mean exit time
        check_positive("brownian_exit", noise=self.noise, half_width=self.half_width)

    def value(self, x: State) -> Scalar:
        """The value at one state; zero outside the cube, where the run has ended."""
        scaled = jnp.abs(jnp.asarray(x)) / self.half_width  # V is even in every coordinate, so [0, 1] suffices
        outside = jnp.max(scaled) > 1
        # evaluate inside only: outside, the formula is negative on the interval and overflows on the square
        return jnp.where(outside, 0.0, self._inside(jnp.where(outside, 0.0, scaled)))

    def _inside(self, scaled: State) -> Scalar:
        """The value at the coordinates |x_i|/R ≤ 1."""
        # with R as unit of length and R²/σ² as unit of time, one parameter κ remains
        time = (self.half_width / self.noise) ** 2
        kappa = jnp.sqrt(2 * self.discount * time)
        if self.dim == 1:
            return time * _interval(scaled[0], kappa)
        # the factor cosh(rate·y)/cosh(rate) decays along the smaller coordinate, but not along the larger one
        across, along = jnp.max(scaled), jnp.min(scaled)
        odd = np.arange(1, 2 * TERMS, 2)  # cos(½πk x) vanishes at ±1 for odd k
        wave = 0.5 * np.pi * odd  # shape (TERMS,), like all arrays below
        sign = np.where(odd % 4 == 1, 1.0, -1.0)
        rate = jnp.sqrt(wave**2 + kappa**2)
        # cosine coefficients of the interval's value: 1 = Σ 2·sign/wave·cos, divided by the operator's ½(wave² + κ²)
        amplitude = 4 * sign / (wave * (wave**2 + kappa**2))
        # cosh(rate·along)/cosh(rate) from decaying exponentials: rate reaches 627, and float32 overflows at e^88
        decay = jnp.exp(rate * (along - 1)) * (1 + jnp.exp(-2 * rate * along)) / (1 + jnp.exp(-2 * rate))
        return time * (_interval(across, kappa) - jnp.sum(amplitude * jnp.cos(wave * across) * decay))


def _interval(x: Number, kappa: Number) -> Scalar:
    """2(1 − cosh κx/cosh κ)/κ² as (1 − x²) times factors that are 1 at κ = 0 and neither cancel nor overflow."""
    near, far = 0.5 * kappa * (1 - x), 0.5 * kappa * (1 + x)  # their sum is κ
    # cosh κ − cosh κx = 2 sinh near · sinh far, and 1/cosh κ = 2e^{−κ}/(1 + e^{−2κ}) scales both factors
    return (1 - x * x) * _sinhc(near) * _sinhc(far) * 2 / (1 + jnp.exp(-2 * kappa))


def _sinhc(z: Number) -> Scalar:
    """e^{−z} sinh(z)/z."""
    small = jnp.where(z == 0, 1.0, z)  # nonzero, because JAX differentiates both branches of a where
    return jnp.where(z == 0, 1.0, -jnp.expm1(-2 * small) / (2 * small))


@pytree_dataclass(static=("dim",))
class BallExit:
    """The mean time during which σ dw stays in the ball |x| < R: (R² − |x|²)/(nσ²)."""

    noise: Number
    radius: Number
    dim: int

    def __post_init__(self) -> None:
        check_positive("brownian_ball", noise=self.noise, radius=self.radius)

    def value(self, x: State) -> Scalar:
        """The value at one state; outside the ball the same formula, which is negative there."""
        x = jnp.asarray(x)
        # ½σ²ΔV = −1, since Δ|x|² = 2n
        return (self.radius * self.radius - jnp.sum(x * x)) / (self.dim * self.noise * self.noise)


@front_door
def brownian_exit(
    *,
    dim: int = 1,
    noise: Number = 1.0,
    discount: Number = 0.0,
    half_width: Number = 1.0,
    shape: tuple[int, ...] | None = None,
) -> tuple[Problem, Grid]:
    """The mean exit time of a Brownian motion from the cube |x_i| < half_width: no control, cost 1.

    Args:
      dim: the number of states.
      noise: σ.
      discount: β; 0 gives the mean exit time.
      half_width: R.
      shape: number of nodes per axis; ``None`` is 101 in one dimension, 41 per axis otherwise.
    """
    # check first, otherwise a half width ≤ 0 would be reported as a wrong corner of the grid
    check_positive("brownian_exit", noise=noise, half_width=half_width)
    exact_time = not is_traced(discount) and discount == 0
    problem = Problem(
        no_drift, unit_cost, noise=noise, discount=discount, target=OutsideCube(half_width).level,
        value_name=f"V = E[{'T' if exact_time else TIME}] [s]", time_unit="s",
    )  # fmt: skip
    # odd numbers put a node at the centre
    shape = ((101,) if dim == 1 else (41,) * dim) if shape is None else shape
    return problem, Grid([-half_width] * dim, [half_width] * dim, shape, units=("m",) * dim)


@front_door
def brownian_exit_exact(
    *, dim: int = 1, noise: Number = 1.0, discount: Number = 0.0, half_width: Number = 1.0
) -> Exact:
    """(1 − x²)/σ² on the interval (−1, 1), 0.58937083 at the centre of the square for σ = 1; zero outside.

    Args:
      dim: the number of states, 1 or 2.
      noise: σ.
      discount: β.
      half_width: R.

    Raises:
      ValueError: ``dim`` is larger than 2.
    """
    if dim not in (1, 2):
        raise ValueError(f"brownian_exit_exact: got dim = {dim}, wanted 1 or 2 (brownian_ball: any)")
    return answer(CubeExit(noise, discount, half_width, dim).value)


@front_door
def brownian_ball(
    *, dim: int = 2, noise: Number = 1.0, radius: Number = 1.0, shape: tuple[int, ...] | None = None
) -> tuple[Problem, Grid]:
    """The mean exit time of a Brownian motion from the ball |x| < radius: no control, cost 1.

    Nodes outside the ball have the continuation of the formula as value, so the sphere need not pass through nodes.

    Args:
      dim: the number n of states.
      noise: σ.
      radius: R.
      shape: number of nodes per axis; ``None`` is 41 per axis.
    """
    problem = Problem(
        no_drift,
        unit_cost,
        noise=noise,
        target=OutsideBall(radius).level,  # includes the corners of the box
        # no discount: with a discount the value would be a Bessel function
        exit_cost=brownian_ball_exact(dim=dim, noise=noise, radius=radius),
        value_name="V = E[T] [s]",
        time_unit="s",
    )
    return problem, Grid([-radius] * dim, [radius] * dim, (41,) * dim if shape is None else shape, units=("m",) * dim)


@front_door
def brownian_ball_exact(*, dim: int = 2, noise: Number = 1.0, radius: Number = 1.0) -> Exact:
    """(R² − |x|²)/(nσ²) in the ball, continued outside it with negative values, as in ``brownian_ball``.

    Args:
      dim: the number n of states.
      noise: σ.
      radius: R.
    """
    return answer(BallExit(noise, radius, dim).value)


@pytree_dataclass()
class BangBang:
    """Hold dx = u dt + ε dw, |u| ≤ 1, near zero at the cost x², discounted at the rate λ; the optimum is u = −sgn x.

        V = x²/λ − 2|x|/λ² + 2/λ³ + ε²/λ² − (2/(λ²μ)) e^{−μ|x|},   μ = 2λ/(1 + √(1 + 2ε²λ))

    Args:
      discount: λ.
      noise: ε.
    """

    discount: Number = 1.0
    noise: Number = 0.0

    def __post_init__(self) -> None:
        # every term of V divides by λ; the noise may be zero
        check_positive("bang_bang", discount=self.discount)

    def drift(self, x: State, u: Control) -> State:
        """The control itself."""
        return u

    def cost(self, x: State, u: Control) -> Number:
        """x²."""
        # no cost of u, so the equation is linear in u and the optimum is at an end of the interval
        return jnp.sum(x * x)

    def value(self, x: State) -> Scalar:
        """The value at one state, on the whole line."""
        rate, variance = self.discount, self.noise * self.noise
        # the positive root of ½ε²μ² + μ − λ = 0, in the form with the limit λ at ε = 0
        mu = 2 * rate / (1 + jnp.sqrt(1 + 2 * variance * rate))
        distance = jnp.abs(jnp.asarray(x)[0])
        # the cost if u = −sgn x continued straight through zero
        parabola = distance * distance / rate - 2 * distance / rate**2 + 2 / rate**3 + variance / rate**2
        # the exponential makes the slope zero at x = 0, where the control switches
        return parabola - 2 / (rate**2 * mu) * jnp.exp(-mu * distance)


@front_door
def bang_bang(*, discount: Number = 1.0, noise: Number = 0.0, shape: tuple[int, ...] = (81,)) -> tuple[Problem, Grid]:
    """Hold a point near zero with |u| ≤ 1 at the cost x², on [−2, 2] with the exact value prescribed at both ends.

    Args:
      discount: λ > 0.
      noise: ε.
      shape: number of nodes.
    """
    system = BangBang(discount, noise)
    problem = Problem(
        system.drift,
        system.cost,
        Box([-1.0], [1.0]),
        noise=noise_or_none(noise),
        discount=discount,
        target=OutsideCube(2.0).level,
        exit_cost=system.value,
    )
    return problem, Grid([-2.0], [2.0], shape, names=("x",))


@front_door
def bang_bang_exact(*, discount: Number = 1.0, noise: Number = 0.0) -> Exact:
    """The value on the whole line, with or without noise; see ``BangBang``.

    Args:
      discount: λ > 0.
      noise: ε.
    """
    return answer(BangBang(discount, noise).value)
