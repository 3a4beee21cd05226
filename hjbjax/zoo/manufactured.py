"""Problems constructed from a chosen value, to measure orders of convergence.

    smooth   ẋ₁ = −x₁ + x₂,  ẋ₂ = −½x₁ − ½x₂(1 − c²) + c·u,  c = 2 + cos 2x₁,  |u| ≤ 6,  cost q(x) + u²

Let f₀ be the drift at u = 0. The choice q = βV − f₀·DV + ¼c²V₂² makes V the value, with the control u = −½cV₂. A
linear-quadratic problem cannot measure orders, because schemes with slope limiters are exact on quadratics.
"""

import jax.numpy as jnp

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import front_door, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.types import Control, Number, State
from hjbjax.zoo.ingredients import Exact, Scalar, answer


@pytree_dataclass()
class Smooth:
    """A nonlinear problem with the value V = cosh x₁ − 1 + x₂² + ¼x₁²x₂².

    Args:
      discount: β.
    """

    discount: Number = 0.5

    def drift(self, x: State, u: Control) -> State:
        """The drift above."""
        gain = self.gain(x)  # between 1 and 3, so the control acts at every state
        return jnp.stack([x[1] - x[0], -0.5 * x[0] - 0.5 * x[1] * (1 - gain * gain) + gain * u[0]])

    def gain(self, x: State) -> Number:
        """The input gain c = 2 + cos 2x₁."""
        return 2 + jnp.cos(2 * x[0])

    def cost(self, x: State, u: Control) -> Number:
        """The cost q(x) + u² that makes V the value."""
        free, slope = self.drift(x, jnp.zeros_like(u)), self.slope(x)
        # u² + cV₂u has its minimum −¼c²V₂² at u = −½cV₂; q compensates for it
        best = self.gain(x) * slope[1]
        return (
            # βV = q + f₀·DV − ¼c²V₂², solved for q
            self.discount * self.value(x) - (free[0] * slope[0] + free[1] * slope[1]) + 0.25 * best * best + u[0] * u[0]
        )

    def value(self, x: State) -> Scalar:
        """The chosen value."""
        x = jnp.asarray(x)
        product = x[0] * x[1]
        # cosh is not a polynomial, so no scheme is exact by chance; the minimum of V is 0 at the origin
        return jnp.cosh(x[0]) - 1 + x[1] * x[1] + 0.25 * product * product

    def slope(self, x: State) -> tuple[Scalar, Scalar]:
        """DV, the two derivatives of the value."""
        return jnp.sinh(x[0]) + 0.5 * x[0] * x[1] * x[1], 2 * x[1] + 0.5 * x[0] * x[0] * x[1]


@front_door
def smooth(*, discount: Number = 0.5, shape: tuple[int, ...] = (81, 81)) -> tuple[Problem, Grid]:
    """Build a smooth nonlinear problem on [−1, 1]² with a known value; compare on |x₁| ≤ 0.5, |x₂| ≤ 0.45.

    Args:
      discount: β.
      shape: number of nodes per axis.
    """
    system = Smooth(discount)
    # |½cV₂| is at most 3 on the box, so the bound on u is never active and V is the value
    problem = Problem(system.drift, system.cost, Box([-6.0], [6.0]), discount=discount)
    return problem, Grid([-1.0, -1.0], [1.0, 1.0], shape)


@front_door
def smooth_exact(*, discount: Number = 0.5) -> Exact:
    """The value cosh x₁ − 1 + x₂² + ¼x₁²x₂² for any discount, valid where |½cV₂| ≤ 6, for example on [−1, 1]²."""
    return answer(Smooth(discount).value)
