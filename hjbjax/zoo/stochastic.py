"""Problems with noise whose value is known.

    Brownian exit   dx = σ dw until it leaves a cube or a ball, cost 1
    bang-bang       dx = u dt + ε dw, |u| ≤ 1, cost x²

Both are held at the exact value where the box ends, so that the answer is exact at every node.
"""

import jax.numpy as jnp
import numpy as np

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import Exact, OutsideBall, OutsideCube, Scalar, answer, noise_or_none, positive, unit_cost

TERMS = 200  # of the series for the square, whose tail falls like k⁻³ at the worst place: 1e-6 there, 1e-15 inside


def no_drift(x: State, u: Control) -> State:
    """Zero: only the noise moves the state."""
    return jnp.zeros_like(x)  # the solver passes a u of shape (0,)


@pytree_dataclass(static=("dim",))
class CubeExit:
    """The discounted time for which σ dw stays in the cube |x_i| < R; one and two dimensions.

    On the interval V = (1 − cosh κx/cosh κR)/β with κ = √(2β)/σ, and (R² − x²)/σ² for β = 0. On the square the
    difference from the interval's value is expanded in cosines along the longer coordinate.
    """

    noise: Number
    discount: Number
    half_width: Number
    dim: int

    def __post_init__(self):
        # of the discount nothing is asked: 0 is the mean exit time itself
        positive("brownian_exit", noise=self.noise, half_width=self.half_width)

    def value(self, x: State) -> Scalar:
        """The value at one state; zero outside the cube, where the run has ended."""
        scaled = jnp.abs(jnp.asarray(x)) / self.half_width  # even in every coordinate, so on [0, 1]
        outside = jnp.max(scaled) > 1
        # outside the formula of the interval is negative and that of the square overflows, so it is asked inside alone
        return jnp.where(outside, 0.0, self._inside(jnp.where(outside, 0.0, scaled)))

    def _inside(self, scaled: State) -> Scalar:
        """The value at the coordinates |x_i|/R ≤ 1."""
        # with R as the length and R²/σ² as the time one number κ is left
        time = (self.half_width / self.noise) ** 2
        kappa = jnp.sqrt(2 * self.discount * time)
        if self.dim == 1:
            return time * _interval(scaled[0], kappa)
        # Along y = max the factor cosh μy/cosh μ would not decay; along the smaller coordinate it does.
        across, along = jnp.max(scaled), jnp.min(scaled)
        odd = np.arange(1, 2 * TERMS, 2)  # cos(½πk x) vanishes at ±1 for odd k
        wave = 0.5 * np.pi * odd  # (TERMS,), as all that follows
        sign = np.where(odd % 4 == 1, 1.0, -1.0)
        rate = jnp.sqrt(wave**2 + kappa**2)
        # the interval's value in cosines: 1 = Σ 2·sign/wave·cos, divided by ½(wave² + κ²) of the operator
        amplitude = 4 * sign / (wave * (wave**2 + kappa**2))
        # cosh(rate·along)/cosh(rate) by decaying exponentials: the largest rate is 627, and float32 ends at e^88
        decay = jnp.exp(rate * (along - 1)) * (1 + jnp.exp(-2 * rate * along)) / (1 + jnp.exp(-2 * rate))
        return time * (_interval(across, kappa) - jnp.sum(amplitude * jnp.cos(wave * across) * decay))


def _interval(x: Number, kappa: Number) -> Scalar:
    """2(1 − cosh κx/cosh κ)/κ², as (1 − x²) times factors that are 1 at κ = 0 and never cancel or overflow."""
    near, far = 0.5 * kappa * (1 - x), 0.5 * kappa * (1 + x)  # their sum is κ
    # cosh κ − cosh κx = 2 sinh near · sinh far, and 1/cosh κ brings the e^{−κ} that the factors share
    return (1 - x * x) * _sinhc(near) * _sinhc(far) * 2 / (1 + jnp.exp(-2 * kappa))


def _sinhc(z: Number) -> Scalar:
    """e^{−z} sinh(z)/z."""
    small = jnp.where(z == 0, 1.0, z)  # any divisor but zero: the branch not taken is differentiated too
    return jnp.where(z == 0, 1.0, -jnp.expm1(-2 * small) / (2 * small))


@pytree_dataclass(static=("dim",))
class BallExit:
    """The mean time for which σ dw stays in the ball |x| < R: (R² − |x|²)/(nσ²)."""

    noise: Number
    radius: Number
    dim: int

    def __post_init__(self):
        positive("brownian_ball", noise=self.noise, radius=self.radius)

    def value(self, x: State) -> Scalar:
        """The value at one state; outside the ball the formula goes on and is negative."""
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
    """How long a Brownian motion stays in the cube |x_i| < half_width: no control, cost 1.

    Args:
      dim: the number of states.
      noise: σ.
      discount: β; 0 is the mean exit time.
      half_width: R.
      shape: nodes; ``None`` is 101 in one dimension, 41 an axis in more.
    """
    # first: of a half width ≤ 0 the grid would complain of its corners
    positive("brownian_exit", noise=noise, half_width=half_width)
    problem = Problem(no_drift, unit_cost, noise=noise, discount=discount, target=OutsideCube(half_width).level)
    # odd numbers put a node at the centre
    shape = ((101,) if dim == 1 else (41,) * dim) if shape is None else shape
    return problem, Grid([-half_width] * dim, [half_width] * dim, shape, units=("m",) * dim)


@front_door
def brownian_exit_exact(
    *, dim: int = 1, noise: Number = 1.0, discount: Number = 0.0, half_width: Number = 1.0
) -> Exact:
    """(1 − x²)/σ² on the interval (−1, 1), .58937083 at the centre of the square for σ = 1; zero outside.

    Args:
      dim: the number of states, 1 or 2.
      noise: σ.
      discount: β.
      half_width: R.

    Raises:
      ValueError: more than two dimensions.
    """
    if dim not in (1, 2):
        raise ValueError(f"brownian_exit_exact: got dim = {dim}, wanted 1 or 2; brownian_ball is known in any")
    return answer(CubeExit(noise, discount, half_width, dim).value)


@front_door
def brownian_ball(
    *, dim: int = 2, noise: Number = 1.0, radius: Number = 1.0, shape: tuple[int, ...] | None = None
) -> tuple[Problem, Grid]:
    """How long on average a Brownian motion stays in the ball |x| < radius: no control, cost 1.

    Nodes outside the ball are held at the answer's continuation, so that the sphere needs not pass through nodes.

    Args:
      dim: the number n of states.
      noise: σ.
      radius: R.
      shape: nodes; ``None`` is 41 an axis.
    """
    problem = Problem(
        no_drift,
        unit_cost,
        noise=noise,
        target=OutsideBall(radius).level,  # the corners of the box, too
        # no discount: with one the answer would be a Bessel function
        exit_cost=brownian_ball_exact(dim=dim, noise=noise, radius=radius),
    )
    return problem, Grid([-radius] * dim, [radius] * dim, (41,) * dim if shape is None else shape, units=("m",) * dim)


@front_door
def brownian_ball_exact(*, dim: int = 2, noise: Number = 1.0, radius: Number = 1.0) -> Exact:
    """(R² − |x|²)/(nσ²) in the ball; outside it goes on, negative, as ``brownian_ball`` holds it there.

    Args:
      dim: the number n of states.
      noise: σ.
      radius: R.
    """
    return answer(BallExit(noise, radius, dim).value)


@pytree_dataclass()
class BangBang:
    """Hold dx = u dt + ε dw, |u| ≤ 1, near zero at the cost x² discounted at the rate λ: u = −sgn x.

        V = x²/λ − 2|x|/λ² + 2/λ³ + ε²/λ² − (2/(λ²μ)) e^{−μ|x|},   μ = 2λ/(1 + √(1 + 2ε²λ))

    Args:
      discount: λ.
      noise: ε.
    """

    discount: Number = 1.0
    noise: Number = 0.0

    def __post_init__(self):
        # every term of V divides by λ; the noise may be zero
        positive("bang_bang", discount=self.discount)

    def drift(self, x: State, u: Control) -> State:
        """The control itself."""
        return u

    def cost(self, x: State, u: Control) -> Number:
        """x²."""
        # nothing is paid for u: the equation is linear in it, and its best value is at an end of the set
        return jnp.sum(x * x)

    def value(self, x: State) -> Scalar:
        """The value at one state of the whole line."""
        rate, variance = self.discount, self.noise * self.noise
        # the positive root of ½ε²μ² + μ − λ = 0, in the form that has the limit λ at ε = 0
        mu = 2 * rate / (1 + jnp.sqrt(1 + 2 * variance * rate))
        distance = jnp.abs(jnp.asarray(x)[0])
        # what u = −sgn x would cost if it went straight on through zero
        parabola = distance * distance / rate - 2 * distance / rate**2 + 2 / rate**3 + variance / rate**2
        # the exponential makes the slope vanish at zero, where the control changes sign
        return parabola - 2 / (rate**2 * mu) * jnp.exp(-mu * distance)


@front_door
def bang_bang(*, discount: Number = 1.0, noise: Number = 0.0, shape: tuple[int, ...] = (81,)) -> tuple[Problem, Grid]:
    """Hold a point near zero with |u| ≤ 1 at the cost x², on [−2, 2] with the ends held at the exact value.

    Args:
      discount: λ > 0.
      noise: ε.
      shape: nodes.
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
    """The value on the whole line, with noise or without; see ``BangBang``.

    Args:
      discount: λ > 0.
      noise: ε.
    """
    return answer(BangBang(discount, noise).value)
