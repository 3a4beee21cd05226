"""Systems whose brackets decide what feedback can do; all but ``OneWay`` and ``Angle`` move without drift.

one way           ẋ₁ = u, ẋ₂ = x₁²                        Example 4.1: accessible, and no way back
angle             ẋ = u, y = (cos x, sin x)               locally observable, and not globally
unicycle          ẋ = u₁ cos θ, ẏ = u₁ sin θ, θ̇ = u₂      u₁ forward, u₂ turns
car, n trailers   the same, and θ̇_i = (v_{i−1}/d_i) sin(θ_{i−1} − θ_i), v_i = v_{i−1} cos(θ_{i−1} − θ_i)
Pomet             ẋ₁ = u₁, ẋ₂ = x₁u₂, ẋ₃ = u₂             (6.6), stabilised by a feedback of (t, x)
"""

from collections.abc import Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import pytree_dataclass
from hjbjax.problem.types import Array, Control, Number, State
from hjbjax.zoo.ingredients import positive


@pytree_dataclass()
class OneWay:
    """Example 4.1, ẋ₁ = u, ẋ₂ = x₁²: brackets span the plane, and x₂ never falls.

    With |u| ≤ 1 the states that can be reached from the origin are x₂ ≥ |x₁|³/3.

    Args:
      speed: s in ẋ₂ = s x₁²; negative for the system run backwards.
    """

    speed: Number = 1.0

    def drift(self, x: State, u: Control) -> State:
        """(u, s x₁²)."""
        # no control enters ẋ₂, which never changes its sign: the bracket spans that direction, one way only
        return jnp.stack([u[0], self.speed * x[0] * x[0]])

    def frontier(self, x: State) -> Number:
        """x₂ − s|x₁|³/3: ≥ 0 where the origin's forward set is, for s > 0 and |u| ≤ 1."""
        # x₂ = s∫x₁² dt along x₁ that runs straight to its end at |u| = 1, which gathers the least
        return x[1] - self.speed * jnp.abs(x[0]) ** 3 / 3


@pytree_dataclass()
class Angle:
    """ẋ = u on the line with the output (cos x, sin x): observable locally and not globally, as in Example 4.2.

    The outputs tell apart states that are near to each other, and no two that are 2π apart.
    """

    def drift(self, x: State, u: Control) -> State:
        """u."""
        return jnp.stack([u[0]])

    def output(self, x: State) -> jax.Array:
        """(cos x, sin x)."""
        return jnp.stack([jnp.cos(x[0]), jnp.sin(x[0])])


@pytree_dataclass()
class Unicycle:
    """A wheel that rolls and turns on the spot but does not slip, state (x, y, θ), control (forward, turn)."""

    def drift(self, x: State, u: Control) -> State:
        """(u₁ cos θ, u₁ sin θ, u₂)."""
        # along the heading alone: the velocity across it is what a wheel that does not slip forbids
        return jnp.stack([u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]])


# static: their number fixes the dimension of the state, 3 + n
@pytree_dataclass(static=("trailers",))
class CarWithTrailers:
    """A unicycle that pulls n trailers, each hooked to the middle of the axle before it.

    State (x, y, θ₀, …, θ_n), the place and heading of the car and the headings of the trailers; control (forward,
    turn) of the car.

    Args:
      trailers: n, at least 1.
      lengths: d_i, from axle to axle, n numbers or one for all.
    """

    trailers: int = 1
    lengths: Number | Sequence[Number] | Array = 1.0

    def __post_init__(self):
        # True would pass for an int, and be one trailer
        if isinstance(self.trailers, bool) or not isinstance(self.trailers, int) or self.trailers < 1:
            raise ValueError(f"CarWithTrailers: got trailers = {self.trailers!r}, wanted a positive integer")
        if np.ndim(cast(Array, self.lengths)) == 0:
            object.__setattr__(self, "lengths", (self.lengths,) * self.trailers)  # past the lock of a frozen dataclass
        if len(self._lengths) != self.trailers:
            raise ValueError(f"CarWithTrailers.lengths: got {len(self._lengths)} numbers, wanted {self.trailers}")
        positive("CarWithTrailers", lengths=self.lengths)

    @property
    def _lengths(self) -> Sequence[Number]:
        return cast(Sequence[Number], self.lengths)  # one number has become n of them in __post_init__

    def drift(self, x: State, u: Control) -> State:
        """(u₁ cos θ₀, u₁ sin θ₀, u₂, (v_{i−1}/d_i) sin(θ_{i−1} − θ_i), …)."""
        # the speed is the car's, and in the loop that of the axle before trailer i
        speed, rates = u[0], [u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]]
        for i in range(self.trailers):
            bend = x[2 + i] - x[3 + i]  # between the axle before and trailer i
            rates.append(speed * jnp.sin(bend) / self._lengths[i])  # the part across the trailer turns it
            speed = speed * jnp.cos(bend)  # the part along it pulls
        return jnp.stack(rates)


@pytree_dataclass()
class Pomet:
    """Example 6.1: a system that no continuous feedback of the state alone can stabilise, and one of (t, x) that does.

    The state decays only like t^(−1/2).
    """

    def drift(self, x: State, u: Control) -> State:
        """(6.6): (u₁, x₁u₂, u₂)."""
        # (0, ε, 0) is no velocity near the origin: Brockett's condition fails, hence the time in the feedback
        return jnp.stack([u[0], x[0] * u[1], u[1]])

    def feedback(self, t: Number, x: State) -> Control:
        """(6.7): (x₂ sin t − z, −z x₁ cos t − (x₁x₂ + x₃)) with z = x₁ + x₂ cos t; for ``time_varying=True``."""
        z = x[0] + x[1] * jnp.cos(t)
        # dV/dt = z(u₁ − x₂ sin t) + u₂(x₁z cos t + x₁x₂ + x₃): each input turns its own term into minus a square
        return jnp.stack([x[1] * jnp.sin(t) - z, -z * x[0] * jnp.cos(t) - (x[0] * x[1] + x[2])])

    def closed_loop(self, t: Number, x: State) -> State:
        """The drift under the feedback."""
        return self.drift(x, self.feedback(t, x))

    def lyapunov(self, t: Number, x: State) -> Number:
        """(6.8): V = ½(x₁ + x₂ cos t)² + ½x₂² + ½x₃²."""
        z = x[0] + x[1] * jnp.cos(t)
        return 0.5 * (z * z + x[1] * x[1] + x[2] * x[2])

    def lyapunov_rate(self, t: Number, x: State) -> Number:
        """dV/dt along the closed loop, in closed form: −z² − (x₁x₂ + x₃ + x₁ z cos t)²."""
        z = x[0] + x[1] * jnp.cos(t)
        # two squares: the rate is never positive, and vanishes on more than the origin
        rest = x[0] * x[1] + x[2] + x[0] * z * jnp.cos(t)
        return -z * z - rest * rest
