"""Systems whose Lie brackets decide which feedback exists; all but ``OneWay`` and ``Angle`` are driftless.

one way           ẋ₁ = u, ẋ₂ = x₁²                        Example 4.1: accessible but not controllable
angle             ẋ = u, y = sin x                        Example 4.2: locally but not globally observable
unicycle          ẋ = u₁ cos θ, ẏ = u₁ sin θ, θ̇ = u₂      u₁ drives forward, u₂ turns
car, n trailers   as the unicycle, with θ̇_i = (v_{i−1}/d_i) sin(θ_{i−1} − θ_i), v_i = v_{i−1} cos(θ_{i−1} − θ_i)
Pomet             ẋ₁ = u₁, ẋ₂ = x₁u₂, ẋ₃ = u₂             (6.6), stabilised by a feedback of (t, x)
"""

from collections.abc import Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, Control, Number, State
from hjbjax.zoo.ingredients import check_positive


@pytree_dataclass()
class OneWay:
    """Example 4.1, ẋ₁ = u, ẋ₂ = x₁²: the brackets span the plane, but x₂ never decreases.

    With |u| ≤ 1 the states reachable from the origin are x₂ ≥ |x₁|³/3.

    Args:
      speed: s in ẋ₂ = s x₁²; a negative s runs the system backwards.
    """

    speed: Number = 1.0

    def drift(self, x: State, u: Control) -> State:
        """(u, s x₁²)."""
        # ẋ₂ has a fixed sign and does not depend on u: the bracket spans this direction, but only one way is possible
        return jnp.stack([u[0], self.speed * x[0] * x[0]])

    def frontier(self, x: State) -> Number:
        """x₂ − s|x₁|³/3: ≥ 0 on the set reachable from the origin, for s > 0 and |u| ≤ 1."""
        # x₂ = s∫x₁² dt is least when x₁ goes straight to its final value at |u| = 1
        return x[1] - self.speed * jnp.abs(x[0]) ** 3 / 3


@pytree_dataclass()
class Angle:
    """Example 4.2, ẋ = u on the line with the output y = sin x: observable locally but not globally.

    At x = π/2 the slope of the output is zero, and its derivative along the input distinguishes nearby states. Two
    states that are 2π apart have the same outputs.
    """

    def drift(self, x: State, u: Control) -> State:
        """u."""
        return jnp.stack([u[0]])

    def output(self, x: State) -> jax.Array:
        """Sin x."""
        return jnp.stack([jnp.sin(x[0])])


@pytree_dataclass()
class Unicycle:
    """A wheel that rolls and turns on the spot without slipping, state (x, y, θ), control (forward, turn)."""

    def drift(self, x: State, u: Control) -> State:
        """(u₁ cos θ, u₁ sin θ, u₂)."""
        # the velocity is along the heading; a sideways velocity would be slip
        return jnp.stack([u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]])


# static, because the number of trailers fixes the dimension 3 + n of the state
@pytree_dataclass(static=("trailers",))
class CarWithTrailers:
    """A unicycle that pulls n trailers, each hooked to the middle of the axle in front of it.

    State (x, y, θ₀, …, θ_n): the position and heading of the car, then the headings of the trailers. Control
    (forward, turn) of the car.

    Args:
      trailers: n, at least 1.
      lengths: d_i, the distances between axles; n numbers, or one number for all.
    """

    trailers: int = 1
    lengths: Number | Sequence[Number] | Array = 1.0

    def __post_init__(self) -> None:
        # bool is a subclass of int, so True would mean one trailer
        if isinstance(self.trailers, bool) or not isinstance(self.trailers, int) or self.trailers < 1:
            raise ValueError(f"CarWithTrailers: got trailers = {self.trailers!r}, wanted a positive integer")
        if np.ndim(cast(Array, self.lengths)) == 0:
            object.__setattr__(self, "lengths", (self.lengths,) * self.trailers)  # the dataclass is frozen
        if len(self._lengths) != self.trailers:
            raise ValueError(f"CarWithTrailers.lengths: got {len(self._lengths)} numbers, wanted {self.trailers}")
        check_positive("CarWithTrailers", lengths=self.lengths)

    @property
    def _lengths(self) -> Sequence[Number]:
        return cast(Sequence[Number], self.lengths)  # __post_init__ has expanded a single number to n numbers

    def drift(self, x: State, u: Control) -> State:
        """(u₁ cos θ₀, u₁ sin θ₀, u₂, (v_{i−1}/d_i) sin(θ_{i−1} − θ_i), …)."""
        # speed is the speed of the axle that pulls trailer i, starting with the car's
        speed, rates = u[0], [u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]]
        for i in range(self.trailers):
            bend = x[2 + i] - x[3 + i]  # the angle between the axle in front and trailer i
            rates.append(speed * jnp.sin(bend) / self._lengths[i])  # the velocity across the trailer turns it
            speed = speed * jnp.cos(bend)  # the velocity along the trailer pulls it
        return jnp.stack(rates)


@pytree_dataclass()
class Pomet:
    """Example 6.1: stabilised by a feedback of (t, x), although no continuous feedback of x stabilises it.

    The state decays only like t^(−1/2).
    """

    def drift(self, x: State, u: Control) -> State:
        """(6.6): (u₁, x₁u₂, u₂)."""
        # (0, ε, 0) is not a velocity near the origin, so Brockett's condition fails and the feedback must depend on t
        return jnp.stack([u[0], x[0] * u[1], u[1]])

    def feedback(self, t: Number, x: State) -> Control:
        """(6.7): (x₂ sin t − z, −z x₁ cos t − (x₁x₂ + x₃)) with z = x₁ + x₂ cos t; use with ``time_varying=True``."""
        z = x[0] + x[1] * jnp.cos(t)
        # dV/dt = z(u₁ − x₂ sin t) + u₂(x₁z cos t + x₁x₂ + x₃): each input makes its own term minus a square
        return jnp.stack([x[1] * jnp.sin(t) - z, -z * x[0] * jnp.cos(t) - (x[0] * x[1] + x[2])])

    def closed_loop(self, t: Number, x: State) -> State:
        """The drift with the feedback inserted."""
        return self.drift(x, self.feedback(t, x))

    def lyapunov(self, t: Number, x: State) -> Number:
        """(6.8): V = ½(x₁ + x₂ cos t)² + ½x₂² + ½x₃²."""
        z = x[0] + x[1] * jnp.cos(t)
        return 0.5 * (z * z + x[1] * x[1] + x[2] * x[2])

    def lyapunov_rate(self, t: Number, x: State) -> Number:
        """dV/dt along the closed loop, −z² − (x₁x₂ + x₃ + x₁ z cos t)²."""
        z = x[0] + x[1] * jnp.cos(t)
        # minus two squares, so V never increases; the rate also vanishes at states other than the origin
        rest = x[0] * x[1] + x[2] + x[0] * z * jnp.cos(t)
        return -z * z - rest * rest
